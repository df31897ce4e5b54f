"""The training loop: data, model, loss, schedule, checkpoint, resume, on one process or many.

Lightning Fabric carries devices and processes; what is here is what is ours: the ramp of the loss, steps that are
skipped when they are not finite, and a run that can be stopped at any moment and continued to the same numbers.
"""

from __future__ import annotations

import logging
import math
import resource
import shutil
import sys
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from kornia.core.check import KORNIA_CHECK
from lightning_fabric import Fabric
from torch import Tensor, nn
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from kornia_pnpnet.core.checks import check_numbers, check_positive, check_whole
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.data.stream import ProblemSource, stream_batches
from kornia_pnpnet.init import MLPInit
from kornia_pnpnet.losses import LossTerms, PoseLoss, SetLoss
from kornia_pnpnet.metrics import pose_errors, success, success_rate
from kornia_pnpnet.refine import RobustWeightedLM
from kornia_pnpnet.solver import PnPNet
from kornia_pnpnet.training.checkpoint import (
    CHECKPOINT_NAME,
    HISTORY_NAME,
    History,
    StageClock,
    TrainingError,
    load_checkpoint,
    save_checkpoint,
    stop_on_signal,
)
from kornia_pnpnet.types import Problems

__all__ = ["FitReport", "TrainSettings", "describe_shares", "fit", "train_briefly", "validate"]

_log = logging.getLogger(__name__)

# Parts of an update, and what is between updates: rows of the history, validations, checkpoints.
_STAGES = ("data", "forward", "backward", "optimizer", "rest")


@dataclass(frozen=True)
class TrainSettings:
    """Numbers of a training run.

    Attributes:
        updates: how many updates in all.
        lr: Adam's learning rate of the network.
        lr_refine: that of the refiner's few hyperparameters, which have far to go.
        warmup: updates over which the learning rate rises linearly.
        final_lr: share of the learning rate that is left at the end of the cosine; 1 keeps it constant.
        clip: largest norm of the gradient; infinite does not clip.
        ramp: shares of the run at which the refined terms of the loss begin to count and count in full.
        max_skipped: the run stops when more steps than this had to be skipped.
        log_every: updates between rows of the history.
        validate_every: updates between validations.
        checkpoint_every: updates between checkpoints.
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
        """Check the numbers.

        Raises:
            BaseError: for intervals below 1, negative numbers of updates, rates that are none, or a ramp that falls.
        """
        check_whole(
            1,
            log_every=self.log_every,
            validate_every=self.validate_every,
            checkpoint_every=self.checkpoint_every,
        )
        check_whole(0, updates=self.updates, warmup=self.warmup, max_skipped=self.max_skipped)
        check_numbers(0.0, lr=self.lr, lr_refine=self.lr_refine)
        check_positive(clip=self.clip, or_infinite=True)
        check_numbers(0.0, 1.0, final_lr=self.final_lr)
        rises = len(self.ramp) == 2 and 0.0 <= self.ramp[0] <= self.ramp[1] < math.inf
        KORNIA_CHECK(rises, f"ramp must be two shares that do not fall, got {self.ramp}.")

    def lr_factor(self, update: int) -> float:
        """Warm-up, then a cosine from 1 to ``final_lr``."""
        cosine = 0.5 * (1.0 + math.cos(math.pi * min(1.0, update / max(1, self.updates))))
        return min(1.0, (update + 1) / max(1, self.warmup)) * (self.final_lr + (1.0 - self.final_lr) * cosine)

    def ramp_factor(self, update: int) -> float:
        """Weight of the refined terms at an update, from 0 to 1."""
        start, end = (share * self.updates for share in self.ramp)
        return 0.0 if update < start else 1.0 if update >= end else (update - start) / (end - start)


@dataclass(frozen=True)
class FitReport:
    """What a call of :func:`fit` did.

    Attributes:
        start: updates done by earlier calls.
        update: updates done in all.
        skipped: steps skipped because the loss or the gradient was not finite.
        interrupted: whether a signal ended the call early; the checkpoint is saved.
        seconds: wall-clock time of this call.
        updates_per_second: of this call.
        time_shares: how ``seconds`` divides among waiting for data, forward, backward, optimizer, and the rest.
        peak_memory_mib: largest resident memory of this process (of the GPU where one is used).
    """

    start: int
    update: int
    skipped: int
    interrupted: bool
    seconds: float
    updates_per_second: float
    time_shares: dict[str, float]
    peak_memory_mib: float


def _peak_memory_mib(device: torch.device) -> float:
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)  # bytes there, KiB here


def _share(problems: Problems, fabric: Fabric) -> Problems:
    """Every ``world_size``-th problem: the batches of all processes together are the batch of one."""
    part = slice(fabric.global_rank, None, fabric.world_size)
    return problems.map(lambda x: x[part].to(fabric.device))


@torch.no_grad()
def validate(model: nn.Module, validation: Mapping[str, Problems]) -> dict[str, float]:
    """Success rates and median errors on fixed problems.

    Args:
        model: a solver.
        validation: problems by name.

    Returns:
        ``val/<name>/success`` and the median errors of the refined pose and of the first guess.
    """
    report = {}
    for name, problems in validation.items():
        result = model(*problems[:3], **problems.sigmas)
        errors = pose_errors(result.pose, problems.pose)
        first = pose_errors(result.init, problems.pose)
        report[f"val/{name}/success"] = success_rate(success(errors)).rate
        report[f"val/{name}/rotation_error_deg"] = errors.rotation_error_deg.median().item()
        report[f"val/{name}/translation_error"] = errors.translation_error.median().item()
        report[f"val/{name}/init_rotation_error_deg"] = first.rotation_error_deg.median().item()
        report[f"val/{name}/init_translation_error"] = first.translation_error.median().item()
    return report


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

    Writes ``last.ckpt``, ``history.csv`` and ``tensorboard/`` into ``folder``. SIGTERM and Ctrl-C save and return. A
    step whose loss or gradient is not finite is skipped, counted and reported.

    Args:
        model: the solver, trained in place.
        data: its batch ``i`` is used for update ``i``.
        validation: fixed problems by name.
        loss: compares results with true poses.
        settings: the numbers of the run.
        folder: where the run lives.
        fabric: the launched engine; one process on the CPU when ``None``.
        identity: what else must be the same when the run is continued, such as the configuration of data and loss, as
            plain data.
        data_workers: processes, for each process that trains, that draw the next batches meanwhile. The numbers are
            the same for any; see :func:`~kornia_pnpnet.data.stream.stream_batches`.
        resume: continue from ``folder``'s checkpoint when there is one.
        progress: show a progress bar.

    Returns:
        What was done.

    Raises:
        TrainingError: when ``folder`` holds a checkpoint and ``resume`` is false, when the checkpoint is damaged or of
            other settings, or when more than ``settings.max_skipped`` steps were not finite.
        BaseError: when the batch cannot be shared equally among the processes.
    """
    if fabric is None:
        fabric = Fabric(accelerator="cpu", devices=1)
    KORNIA_CHECK(
        data.batch_size % fabric.world_size == 0,
        f"A batch of {data.batch_size} cannot be shared equally among {fabric.world_size} processes.",
    )
    folder = Path(folder)
    checkpoint = folder / CHECKPOINT_NAME
    own = _plain({"settings": asdict(settings), "model": model.config(), **(identity or {})})
    start, skipped = 0, 0
    state = None
    if checkpoint.exists():
        if not resume:
            raise TrainingError(f"{checkpoint} exists: pass resume=true to continue it, or choose another folder.")
        state = load_checkpoint(checkpoint, own)
        start, skipped = state["update"], state["skipped"]
        model.load_state_dict(state["model"])

    parts = ((model.init, settings.lr), (model.refine, settings.lr_refine))
    trained = [([p for p in part.parameters() if p.requires_grad], lr) for part, lr in parts if part is not None]
    groups = [{"params": params, "lr": lr, "initial_lr": lr} for params, lr in trained if params]
    optimizer = torch.optim.Adam(groups, fused=True)
    parameters = [p for params, _ in trained for p in params]
    solver, fabric_optimizer = fabric.setup(model, optimizer)
    solver.mark_forward_method("with_guess")
    if state is not None:  # now that the parameters are on their device, so that Adam's state follows them
        for group in state["optimizer"]["param_groups"]:
            group["fused"] = True  # how a step is computed is this code's choice, not the checkpoint's
        optimizer.load_state_dict(state["optimizer"])
    validation = {name: problems.map(lambda x: x.to(fabric.device)) for name, problems in validation.items()}
    best_names = ["success", "rotation_error_deg", "translation_error"]
    best_names += ["init_rotation_error_deg", "init_translation_error"]
    columns = ["update", *LossTerms._fields, "ramp", "lr", "grad_norm", "skipped", "updates_per_second"]
    columns += [f"{stage}_share" for stage in _STAGES]
    columns += ["peak_memory_mib", *(f"val/{name}/{metric}" for name in validation for metric in best_names)]
    history = None
    if fabric.is_global_zero:
        folder.mkdir(parents=True, exist_ok=True)
        history = History(folder, columns, start)

    def save(update: int) -> None:
        if fabric.is_global_zero:
            content = {"update": update, "skipped": skipped, "identity": own}
            save_checkpoint(checkpoint, {**content, "model": model.state_dict(), "optimizer": optimizer.state_dict()})
        fabric.barrier()

    model.train()
    clock = StageClock(*_STAGES)
    logged_update, logged_seconds = start, dict(clock.seconds)
    update = start
    interrupted = False
    bar = tqdm(total=settings.updates, initial=start, disable=not (progress and fabric.is_global_zero), unit="update")
    batches = stream_batches(data, start, settings.updates, data_workers)
    with stop_on_signal() as stop, closing(batches), bar, logging_redirect_tqdm():
        while update < settings.updates and not interrupted:
            factor = settings.lr_factor(update)
            for group in optimizer.param_groups:
                group["lr"] = group["initial_lr"] * factor
            ramp = settings.ramp_factor(update)
            clock.lap("rest")
            problems = _share(next(batches), fabric)
            clock.lap("data")
            inputs = {**problems.sigmas, "first_stage_only": ramp == 0.0}
            if isinstance(loss, SetLoss):
                result, guess = solver.with_guess(*problems[:3], **inputs)
                terms = loss(result, problems, ramp, guess)
            else:
                terms = loss(solver(*problems[:3], **inputs), problems, ramp)
            # The zero keeps the refiner in the graph before the ramp: processes expect gradients of every parameter.
            unused = sum(p.sum() for p in model.refine.parameters() if p.requires_grad) if ramp == 0.0 else 0.0
            clock.lap("forward")
            optimizer.zero_grad()
            fabric.backward(terms.total + 0.0 * unused)
            clock.lap("backward")
            norm = nn.utils.clip_grad_norm_(parameters, settings.clip)
            # All processes must take the same branch, whoever saw the bad number or the signal.
            bad, interrupted = _agree(fabric, not bool(torch.isfinite(terms.total + norm)), stop.is_set())
            if bad:
                skipped += 1
                if fabric.is_global_zero:
                    _log.warning("update %s: loss or gradient not finite, step skipped (%s so far)", update, skipped)
            else:
                fabric_optimizer.step()
            clock.lap("optimizer")
            update += 1
            bar.update()
            finished = update == settings.updates
            interrupted = interrupted and not finished

            if skipped > settings.max_skipped:
                raise TrainingError(
                    f"{skipped} steps had a loss or a gradient that is not finite, more than max_skipped = "
                    f"{settings.max_skipped}, up to update {update}. Lower the learning rate or look at the data."
                )
            validates = finished or update % settings.validate_every == 0
            if finished or update % settings.log_every == 0 or validates:
                means = _mean(fabric, torch.stack([term.detach() for term in terms]))
                if history is not None:
                    clock.lap("rest")
                    shares = clock.shares(logged_seconds)
                    elapsed = sum(clock.seconds.values()) - sum(logged_seconds.values())
                    rate = (update - logged_update) / max(elapsed, 1e-9)
                    row: dict[str, float] = {"update": update, **dict(zip(terms._fields, means, strict=True))}
                    if ramp == 0.0:  # nothing was refined yet
                        row = {name: value for name, value in row.items() if not name.startswith("refined")}
                    row |= {"ramp": ramp, "lr": settings.lr * factor, "grad_norm": norm.item(), "skipped": skipped}
                    row |= {"updates_per_second": rate, **{f"{stage}_share": shares[stage] for stage in _STAGES}}
                    row["peak_memory_mib"] = _peak_memory_mib(fabric.device)
                    if validates:
                        model.eval()
                        report = validate(model, validation)
                        model.train()
                        row |= report
                        rates = {name: f"{100 * report[f'val/{name}/success']:.1f} %" for name in validation}
                        found = ", ".join(f"{name} {share}" for name, share in rates.items())
                        speed = f"{rate:.1f} updates/s ({describe_shares(shares)})"
                        _log.info("update %s: success %s; %s; %.0f MiB", update, found, speed, row["peak_memory_mib"])
                        bar.set_postfix(rates)
                    history.write(row)
                    clock.lap("rest")
                    logged_update, logged_seconds = update, dict(clock.seconds)
            if finished or interrupted or update % settings.checkpoint_every == 0:
                save(update)
    if history is not None:
        history.close()
    model.eval()
    clock.lap("rest")
    seconds = sum(clock.seconds.values())
    rate = (update - start) / max(seconds, 1e-9)
    memory = _peak_memory_mib(fabric.device)
    return FitReport(start, update, skipped, interrupted, seconds, rate, clock.shares(), memory)


def describe_shares(shares: Mapping[str, float]) -> str:
    """Shares of the time as a line of a log, for example ``"data 1 %, forward 40 %"``."""
    return ", ".join(f"{stage} {100 * share:.0f} %" for stage, share in shares.items())


def _plain(value: Any) -> Any:
    """Tuples as lists: what a checkpoint gives back."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value


def _mean(fabric: Fabric, values: Tensor) -> list[float]:
    """The mean of each value over all processes."""
    if fabric.world_size > 1:
        values = torch.as_tensor(fabric.all_reduce(values, reduce_op="mean"))
    return values.tolist()


def _agree(fabric: Fabric, *flags: bool) -> list[bool]:
    """Whether each flag is set on any process."""
    if fabric.world_size == 1:
        return list(flags)
    counts = fabric.all_reduce(torch.tensor(flags, dtype=torch.float32, device=fabric.device), reduce_op="sum")
    return (torch.as_tensor(counts) > 0).tolist()


def train_briefly(seconds: float, folder: str | Path, *, progress: bool = True) -> Path:
    """Train a new PnP-Net for n = 9 for about so many seconds, to show that training works here.

    Args:
        seconds: how long, roughly; the speed of this machine is measured first.
        folder: where the run is kept; a run that is already there is replaced.
        progress: show a progress bar.

    Returns:
        The path of the learning curves, a CSV file.

    Raises:
        BaseError: when ``seconds`` is not a positive number.
    """
    check_positive(seconds=seconds)
    folder = Path(folder)
    for name in (CHECKPOINT_NAME, HISTORY_NAME):
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / "tensorboard", ignore_errors=True)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = PnPNet(MLPInit(9), RobustWeightedLM(5))
    data = SyntheticProblems(n=9, batch_size=250, seed=0, outliers=OutlierMix())
    validation = {
        "none": SyntheticProblems(n=9, batch_size=500, seed=900_001).batch(0),
        "uniform": SyntheticProblems(n=9, batch_size=500, seed=900_002, outliers=OutlierMix()).batch(0),
    }
    loss = PoseLoss(saturation=0.02)

    def seconds_per_update(ramp: float) -> float:
        began = time.perf_counter()
        for index in range(10):
            problems = data.batch(index)
            result = model(*problems[:3], first_stage_only=ramp == 0.0)
            loss(result, problems, ramp).total.backward()
        return (time.perf_counter() - began) / 10

    alone = TrainSettings(0).ramp[0]  # the share of the run in which the network learns alone
    expected = alone * seconds_per_update(0.0) + (1.0 - alone) * seconds_per_update(1.0)
    updates = max(100, round(seconds / expected) // 100 * 100)
    settings = TrainSettings(
        updates, warmup=100, log_every=updates // 20, validate_every=updates // 20, checkpoint_every=updates
    )
    fit(model, data, validation, loss, settings, folder, progress=progress)
    return folder / HISTORY_NAME
