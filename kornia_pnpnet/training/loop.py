"""The training loop on one process or several. Lightning Fabric handles devices and processes.

During a run, the weight of the loss terms of refined poses rises from 0 to 1. Steps whose loss or gradient is not
finite are skipped. A run that is stopped and continued gives the same numbers as a run without a stop.
"""

from __future__ import annotations

import json
import logging
import math
import shutil
import timeit
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch
from kornia.core.check import KORNIA_CHECK
from lightning_fabric import Fabric
from torch import nn
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from kornia_pnpnet.core.checks import are_rising, check_numbers, check_positive, check_whole
from kornia_pnpnet.core.environment import peak_resident_bytes
from kornia_pnpnet.core.files import atomic_open
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.data.stream import ProblemSource, stream_batches
from kornia_pnpnet.losses import LossTerms, PoseLoss, SetLoss
from kornia_pnpnet.propose.mlp import MLPInit
from kornia_pnpnet.refine.lm import RobustWeightedLM
from kornia_pnpnet.result import Problems
from kornia_pnpnet.solver import PnPNet
from kornia_pnpnet.training.checkpoint import (
    CHECKPOINT_NAME,
    HISTORY_NAME,
    History,
    StageClock,
    TrainingError,
    load_checkpoint,
    stop_on_signal,
)
from kornia_pnpnet.training.results import FitReport, validate

__all__ = ["TrainSettings", "fit", "train_briefly"]

_log = logging.getLogger(__name__)

# Stages of an update. The stage "rest" consists of learning curves and checkpoints, and in a report of the whole run
# also of validations.
_STAGES = ("data", "forward", "backward", "optimizer", "rest")
_REFINES = "with refinement"  # label of the progress bar
# Columns of the learning curves, without the columns of validations.
_COLUMNS = ["update", *LossTerms._fields, "ramp", "lr", "grad_norm", "skipped", "updates_per_second"]
_COLUMNS += [*(f"{stage}_share" for stage in _STAGES), "peak_memory_mib"]
# Maps each column of a validation, without its prefix ``val/<set>/``, to an attribute of ValidationResult.
_CURVES = {
    "success": "success.rate",
    "rotation_error_deg": "median_rotation_error_deg",
    "translation_error": "median_translation_error",
    "init_rotation_error_deg": "first_stage_median_rotation_error_deg",
    "init_translation_error": "first_stage_median_translation_error",
}


@dataclass(frozen=True)
class TrainSettings:
    """Numerical settings of a training run.

    Attributes:
        updates: number of updates of the whole run.
        lr: Adam's learning rate for the network.
        lr_refine: Adam's learning rate for the hyperparameters of the refinement.
        warmup: number of updates over which the learning rates rise linearly.
        final_lr: factor that multiplies the learning rates at the end of the cosine decay. 1 means no decay.
        clip: largest norm of a gradient. Longer gradients are scaled to this norm. Infinity means no clipping.
        ramp: start and end of the ramp, as shares of the run. During the ramp, the weight of the loss terms of refined
            poses rises linearly from 0 to 1.
        max_skipped: largest number of skipped steps. A larger number ends the run with an error.
        log_every: number of updates between rows of the learning curves.
        validate_every: number of updates between validations.
        checkpoint_every: number of updates between checkpoints.

    Raises:
        BaseError: for a number out of range, or a ramp that ends before its start.
    """

    updates: int
    lr: float = 3e-3
    lr_refine: float = 1e-2
    warmup: int = 200
    final_lr: float = 0.02
    clip: float = 1.0
    ramp: tuple[float, float] = (0.8, 0.81)
    max_skipped: int = 100
    log_every: int = 100
    validate_every: int = 1000
    checkpoint_every: int = 500

    def __post_init__(self) -> None:
        check_whole(1, **{name: getattr(self, name) for name in ("log_every", "validate_every", "checkpoint_every")})
        check_whole(0, updates=self.updates, warmup=self.warmup, max_skipped=self.max_skipped)
        check_numbers(0.0, lr=self.lr, lr_refine=self.lr_refine)
        check_positive(clip=self.clip, or_infinite=True)
        check_numbers(0.0, 1.0, final_lr=self.final_lr)
        KORNIA_CHECK(are_rising(self.ramp, 0.0), f"ramp must be two shares, the second not smaller, got {self.ramp}.")

    def lr_factor(self, update: int) -> float:
        """Factor that multiplies the learning rates: a linear warm-up times a cosine from 1 to ``final_lr``."""
        cosine = 0.5 * (1.0 + math.cos(math.pi * min(1.0, update / max(1, self.updates))))
        return min(1.0, (update + 1) / max(1, self.warmup)) * (self.final_lr + (1.0 - self.final_lr) * cosine)

    def ramp_factor(self, update: int) -> float:
        """Weight of the loss terms of refined poses at an update, from 0 to 1."""
        start, end = (share * self.updates for share in self.ramp)
        return 0.0 if update < start else 1.0 if update >= end else (update - start) / (end - start)


def fit(
    model: PnPNet,
    data: ProblemSource,
    validation: Mapping[str, Problems],
    loss: PoseLoss | SetLoss,
    settings: TrainSettings,
    folder: str | Path,
    *,
    fabric: Fabric | None = None,
    identity: Mapping[str, Any] | None = None,
    data_workers: int = 0,
    resume: bool = False,
    progress: bool = True,
) -> FitReport:
    r"""Train a solver.

    The call writes ``last.ckpt``, ``history.csv`` and ``tensorboard/`` into ``folder``. After SIGTERM or Ctrl-C a
    checkpoint is saved and the call returns. A step whose loss or gradient is not finite is skipped and counted.

    Args:
        model: the solver, trained in place.
        data: source of the problems. Update ``i + 1`` uses batch ``i``.
        validation: problems of the validation sets, by the name of the set.
        loss: loss that compares results with true poses.
        settings: numerical settings of the run.
        folder: folder of the run.
        fabric: a launched Lightning Fabric. ``None`` means one process on the CPU.
        identity: plain data that describe the run, for example the configuration of the data. A run can be continued
            only with the same ``identity`` and the same settings, except ``max_skipped`` and the numbers of updates
            between rows, validations and checkpoints. ``settings.updates`` may grow; the learning rates and the
            ramp then follow the schedule of the longer run.
        data_workers: number of worker processes per training process. The workers draw the next batches.
        resume: continue from the checkpoint in ``folder`` if it exists.
        progress: show a progress bar.

    Raises:
        TrainingError: when ``folder`` holds a checkpoint but ``resume`` is false; when the checkpoint is damaged, or
            its settings, solver options or ``identity`` differ from those of this call; or when more than
            ``settings.max_skipped`` steps were skipped.
    """
    fabric = fabric or Fabric(accelerator="cpu", devices=1)
    if fabric.device.type == "cuda":  # another run of this process may have used more memory
        torch.cuda.reset_peak_memory_stats(fabric.device)
    checkpoint = Path(folder) / CHECKPOINT_NAME
    described = {"settings": asdict(settings), "model": model.config(), **(identity or {})}
    described = json.loads(json.dumps(described))  # JSON turns tuples into lists
    start, skipped, state = 0, 0, None
    if checkpoint.exists():
        if not resume:
            raise TrainingError(f"{checkpoint} exists: pass resume=true to continue, or choose another folder.")
        state = load_checkpoint(checkpoint, described)
        start, skipped, planned = state["update"], state["skipped"], state["identity"]["settings"]["updates"]
        if planned < settings.updates:
            lr, ramp = settings.lr * settings.lr_factor(start), settings.ramp_factor(start)
            _log.warning(
                f"The run becomes longer: {settings.updates} updates instead of {planned}. From update {start} on, the "
                f"schedule is that of the longer run: learning rate {lr:.2g}, ramp of the refinement {ramp:.2g}."
            )
        model.load_state_dict(state["model"])

    groups = []
    for module, lr in ((model.init, settings.lr), (model.refine, settings.lr_refine)):
        if module is not None and (trained := [p for p in module.parameters() if p.requires_grad]):
            groups.append({"params": trained, "lr": lr, "initial_lr": lr})
    optimizer = torch.optim.Adam(groups, fused=True)
    solver, fabric_optimizer = fabric.setup(model, optimizer)
    solver.mark_forward_method("with_starts")
    if state is not None:  # loaded after `setup`, so that Adam's state is on the device of the parameters
        optimizer.load_state_dict(state["optimizer"])
    model.train()

    validation = {name: problems.map(lambda x: x.to(fabric.device)) for name, problems in validation.items()}
    columns = [*_COLUMNS, *(f"val/{name}/{column}" for name in validation for column in _CURVES)]
    history = History(Path(folder), columns, start) if fabric.is_global_zero else None
    # Updates with refinement are much slower than earlier updates, so the progress bar restarts when refinement starts.
    alone = min(settings.updates, math.ceil(settings.ramp[0] * settings.updates))
    phase = ("network alone", alone) if start < alone else (_REFINES, settings.updates)
    bar = tqdm(None, *phase, initial=start, disable=not progress or history is None, unit="update", smoothing=0.0)
    batches = stream_batches(data, start, settings.updates, data_workers)
    clock = StageClock(*_STAGES)
    update, interrupted, logged = start, False, (start, dict(clock.seconds))

    def report(since: int, before: Mapping[str, float]) -> FitReport:
        """Report the work after the update ``since``. ``before`` has the seconds of each stage up to this update."""
        clock.lap("rest")
        spent = {stage: seconds - before[stage] for stage, seconds in clock.seconds.items()}
        whole = sum(spent.values())
        on_gpu = fabric.device.type == "cuda"
        peak_bytes = torch.cuda.max_memory_allocated(fabric.device) if on_gpu else peak_resident_bytes()
        return FitReport(
            start=since,
            update=update,
            skipped=skipped,
            interrupted=interrupted,
            seconds=whole,
            updates_per_second=(update - since) / whole,
            time_shares={stage: seconds / whole for stage, seconds in spent.items()},
            peak_memory_mib=peak_bytes / 2**20,
        )

    with stop_on_signal() as stop, closing(batches), bar, logging_redirect_tqdm():
        for update, batch in enumerate(batches, start + 1):
            problems, share = _own_part(batch, fabric)
            clock.lap("data")
            if update - 1 == bar.total:
                bar.reset(settings.updates)
                bar.initial = bar.n = update - 1
                bar.set_description(_REFINES)
            factor, ramp = settings.lr_factor(update - 1), settings.ramp_factor(update - 1)
            for group in optimizer.param_groups:
                group["lr"] = group["initial_lr"] * factor
            terms = LossTerms(*(share * x for x in _compare(solver, loss, problems, ramp)))
            # Training on several processes needs a gradient of every parameter. The loss therefore gets a zero term
            # with the parameters of the refinement, which have no effect before the ramp.
            unused = sum(p.sum() for p in model.refine.parameters() if p.requires_grad)
            clock.lap("forward")
            optimizer.zero_grad()
            fabric.backward(terms.total + 0.0 * unused)
            clock.lap("backward")
            norm = nn.utils.clip_grad_norm_(model.parameters(), settings.clip)
            # All processes must take the same branch, even if only one process has a bad loss or got a signal.
            flags = torch.stack((~(terms.total + norm).isfinite(), torch.tensor(stop.is_set(), device=fabric.device)))
            bad, stopped = (torch.as_tensor(fabric.all_reduce(flags.float(), reduce_op="sum")) > 0).tolist()
            if bad:
                skipped += 1
                if fabric.is_global_zero:
                    _log.warning("update %s: loss or gradient not finite, step skipped (%s so far)", update, skipped)
                if skipped > settings.max_skipped:
                    raise TrainingError(
                        f"{skipped} steps up to update {update} had a loss or a gradient that is not finite, more than "
                        f"max_skipped = {settings.max_skipped}. Lower the learning rate or check the data."
                    )
            else:
                fabric_optimizer.step()
            clock.lap("optimizer")
            bar.update()

            finished = update == settings.updates
            interrupted = stopped and not finished
            validates = finished or update % settings.validate_every == 0
            if validates or update % settings.log_every == 0:
                values = torch.as_tensor(fabric.all_reduce(torch.stack(terms).detach(), reduce_op="mean"))
                if history is not None:
                    interval = report(*logged)
                    row = {"update": update, **dict(zip(LossTerms._fields, values.tolist(), strict=True))}
                    if ramp == 0.0:  # results are not refined before the ramp
                        row = {name: value for name, value in row.items() if not name.startswith("refined")}
                    row |= {"ramp": ramp, "lr": settings.lr * factor, "grad_norm": norm.item(), "skipped": skipped}
                    row |= {name: getattr(interval, name) for name in ("updates_per_second", "peak_memory_mib")}
                    row |= {f"{stage}_share": share for stage, share in interval.time_shares.items()}
                    if validates:
                        bar.set_postfix_str("validating")
                        model.eval()
                        results = validate(model, validation)
                        model.train()
                        for name, result in results.items():
                            row |= {f"val/{name}/{key}": attrgetter(field)(result) for key, field in _CURVES.items()}
                        rates = ", ".join(f"{name} {100 * x.success.rate:.1f} %" for name, x in results.items())
                        bar.set_postfix_str(rates)
                        _log.info("%s; success: %s", interval, rates)
                    history.write(row)
                    clock.lap("rest")
                    logged = update, dict(clock.seconds)
            if finished or interrupted or update % settings.checkpoint_every == 0:
                if fabric.is_global_zero:
                    content = {"update": update, "skipped": skipped, "identity": described}
                    content |= {"model": model.state_dict(), "optimizer": optimizer.state_dict()}
                    with atomic_open(checkpoint, "wb") as file:
                        torch.save(content, file)
                fabric.barrier()
            clock.lap("rest")
            if interrupted:
                break
    if history is not None:
        history.board.close()
    model.eval()
    return report(start, dict.fromkeys(_STAGES, 0.0))


def _own_part(batch: Problems, fabric: Fabric) -> tuple[Problems, float]:
    """Take this process's part of a batch. Also return the factor of its mean loss in the mean of all processes.

    A batch cannot always be shared equally. A process without a problem gets one with the factor 0.
    """
    own = slice(fabric.global_rank, None, fabric.world_size)
    number = len(batch.inliers[own])
    problems = batch.map(lambda x: x[own if number else slice(1)].to(fabric.device))
    return problems, number * fabric.world_size / len(batch.inliers)


def _compare(solver: Any, loss: PoseLoss | SetLoss, problems: Problems, ramp: float) -> LossTerms:
    options = {**problems.known, "first_stage_only": ramp == 0.0}
    if isinstance(loss, SetLoss):
        result, guess = solver.with_starts(*problems[:3], **options)
        return loss(result, problems, ramp, guess)
    return loss(solver(*problems[:3], **options), problems, ramp)


def train_briefly(seconds: float, folder: str | Path, *, progress: bool = True) -> Path:
    """Train a new 9-pair PnP-Net for about ``seconds``, and return the path of the learning curves (CSV).

    The number of updates follows from a short measurement of the machine's speed. An earlier run in ``folder`` is
    replaced. Raise ``BaseError`` when ``seconds`` is not a positive number.
    """
    check_positive(seconds=seconds)
    folder = Path(folder)
    for name in (CHECKPOINT_NAME, HISTORY_NAME):
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / "tensorboard", ignore_errors=True)
    with torch.device("cpu"), torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(0)
        model = PnPNet(MLPInit(9), RobustWeightedLM(5))
    data = SyntheticProblems(n=9, batch_size=250, seed=0, outliers=OutlierMix())
    validation = {
        "none": SyntheticProblems(n=9, batch_size=500, seed=900_001).batch(0),
        "uniform": SyntheticProblems(n=9, batch_size=500, seed=900_002, outliers=OutlierMix()).batch(0),
    }
    loss = PoseLoss(saturation=0.02)

    def try_update(ramp: float) -> None:
        _compare(model, loss, data.batch(0), ramp).total.backward()

    alone = TrainSettings(0).ramp[0]  # share of the run before the refinement starts
    fast, slow = (timeit.timeit(partial(try_update, ramp), number=10) / 10 for ramp in (0.0, 1.0))
    updates = max(100, round(seconds / (alone * fast + (1.0 - alone) * slow)) // 100 * 100)
    rows = updates // 20
    settings = TrainSettings(updates, warmup=100, log_every=rows, validate_every=rows, checkpoint_every=updates)
    fit(model, data, validation, loss, settings, folder, progress=progress)
    return folder / HISTORY_NAME
