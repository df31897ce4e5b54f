"""The settings of a training run, its state, and what one update does to it."""

from __future__ import annotations

import json
import logging
import math
import resource
import sys
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch
from kornia.core.check import KORNIA_CHECK
from lightning_fabric import Fabric
from torch import nn

from kornia_pnpnet.core.checks import check_numbers, check_positive, check_whole
from kornia_pnpnet.core.files import atomic_open
from kornia_pnpnet.losses import LossTerms, PoseLoss, SetLoss
from kornia_pnpnet.result import Problems
from kornia_pnpnet.solver import PnPNet
from kornia_pnpnet.training.checkpoint import CHECKPOINT_NAME, History, StageClock, TrainingError, load_checkpoint
from kornia_pnpnet.training.results import FitReport, validate

__all__ = ["Run", "TrainSettings", "describe_shares"]

_log = logging.getLogger(__name__)

# Parts of an update. The rest is between updates: rows of the learning curves, validations, checkpoints.
_STAGES = ("data", "forward", "backward", "optimizer", "rest")
# Columns of the learning curves, after ``val/<set>/``, and the field that each column shows.
_CURVES = {
    "success": "success.rate",
    "rotation_error_deg": "median_rotation_error_deg",
    "translation_error": "median_translation_error",
    "init_rotation_error_deg": "first_stage_median_rotation_error_deg",
    "init_translation_error": "first_stage_median_translation_error",
}


@dataclass(frozen=True)
class TrainSettings:
    """Numbers of a training run.

    Attributes:
        updates: number of updates of the whole run.
        lr: Adam's learning rate for the network.
        lr_refine: Adam's learning rate for the hyperparameters of the refinement.
        warmup: number of updates over which the learning rates rise linearly.
        final_lr: factor of the learning rates at the end of the cosine decay; 1 keeps the rates constant.
        clip: largest norm of the gradient; infinity does not clip.
        ramp: shares of the run at which the refined terms of the loss begin to count, and count in full.
        max_skipped: largest number of skipped steps; one more ends the run.
        log_every: updates between rows of the learning curves.
        validate_every: updates between validations.
        checkpoint_every: updates between checkpoints.

    Raises:
        BaseError: for a number that is out of range, or a ramp that falls.
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
        """Check the numbers."""
        check_whole(
            1, log_every=self.log_every, validate_every=self.validate_every, checkpoint_every=self.checkpoint_every
        )
        check_whole(0, updates=self.updates, warmup=self.warmup, max_skipped=self.max_skipped)
        check_numbers(0.0, lr=self.lr, lr_refine=self.lr_refine)
        check_positive(clip=self.clip, or_infinite=True)
        check_numbers(0.0, 1.0, final_lr=self.final_lr)
        rises = len(self.ramp) == 2 and 0.0 <= self.ramp[0] <= self.ramp[1] < math.inf
        KORNIA_CHECK(rises, f"ramp must be two shares, the second not smaller, got {self.ramp}.")

    def lr_factor(self, update: int) -> float:
        """Factor of the learning rates at an update: a linear warm-up times a cosine from 1 to ``final_lr``."""
        cosine = 0.5 * (1.0 + math.cos(math.pi * min(1.0, update / max(1, self.updates))))
        return min(1.0, (update + 1) / max(1, self.warmup)) * (self.final_lr + (1.0 - self.final_lr) * cosine)

    def ramp_factor(self, update: int) -> float:
        """Weight of the refined terms at an update, from 0 to 1."""
        start, end = (share * self.updates for share in self.ramp)
        return 0.0 if update < start else 1.0 if update >= end else (update - start) / (end - start)


class Run:
    """State of a run: solver, optimizer, update, learning curves, clock. A checkpoint in the folder is continued.

    A checkpoint is only continued by the same run: settings, the whole configuration of the solver, and ``identity``
    must be equal.
    """

    def __init__(
        self,
        model: PnPNet,
        loss: PoseLoss | SetLoss,
        validation: Mapping[str, Problems],
        settings: TrainSettings,
        folder: Path,
        fabric: Fabric,
        identity: Mapping[str, Any],
        resume: bool,
    ) -> None:
        self.model, self.loss, self.settings, self.fabric = model, loss, settings, fabric
        # Tuples become lists, as in a checkpoint.
        self.identity = json.loads(json.dumps({"settings": asdict(settings), "model": model.config(), **identity}))
        self.checkpoint = folder / CHECKPOINT_NAME
        self.update, self.skipped, self.interrupted = 0, 0, False
        self.rates = ""  # success rates of the last validation, for the progress bar
        state = None
        if self.checkpoint.exists():
            if not resume:
                raise TrainingError(
                    f"{self.checkpoint} exists: pass resume=true to continue, or choose another folder."
                )
            state = load_checkpoint(self.checkpoint, self.identity)
            self.update, self.skipped = state["update"], state["skipped"]
            model.load_state_dict(state["model"])
        self.start = self.update

        groups = []
        for part, lr in ((model.init, settings.lr), (model.refine, settings.lr_refine)):
            if part is not None and (trained := [p for p in part.parameters() if p.requires_grad]):
                groups.append({"params": trained, "lr": lr, "initial_lr": lr})
        self.optimizer = torch.optim.Adam(groups, fused=True)
        self.solver, self.fabric_optimizer = fabric.setup(model, self.optimizer)
        self.solver.mark_forward_method("with_starts")
        if state is not None:  # after the parameters are on their device, so that Adam's state follows them
            self.optimizer.load_state_dict(state["optimizer"])

        self.validation = {name: problems.map(lambda x: x.to(fabric.device)) for name, problems in validation.items()}
        columns = ["update", *LossTerms._fields, "ramp", "lr", "grad_norm", "skipped", "updates_per_second"]
        columns += [*(f"{stage}_share" for stage in _STAGES), "peak_memory_mib"]
        columns += [f"val/{name}/{column}" for name in validation for column in _CURVES]
        self.history = History(folder, columns, self.start) if fabric.is_global_zero else None
        model.train()
        self.clock = StageClock(*_STAGES)
        self._logged = self.start, dict(self.clock.seconds)

    @property
    def finished(self) -> bool:
        """Whether all updates are done."""
        return self.update >= self.settings.updates

    def _terms(self, problems: Problems, ramp: float) -> LossTerms:
        """Solve the problems and compare the results with the true poses."""
        inputs = problems.world_points, problems.img_points, problems.intrinsics
        options = {**problems.known, "first_stage_only": ramp == 0.0}
        if isinstance(self.loss, SetLoss):
            result, guess = self.solver.with_starts(*inputs, **options)
            return self.loss(result, problems, ramp, guess)
        return self.loss(self.solver(*inputs, **options), problems, ramp)

    def step(self, problems: Problems, stop: threading.Event) -> dict[str, Any]:
        """One update, skipped when loss or gradient is not finite; returns the values for the learning curves."""
        factor, ramp = self.settings.lr_factor(self.update), self.settings.ramp_factor(self.update)
        for group in self.optimizer.param_groups:
            group["lr"] = group["initial_lr"] * factor
        terms = self._terms(problems, ramp)
        # The zero keeps the refiner in the graph before the ramp: processes expect gradients of every parameter.
        unused = sum(p.sum() for p in self.model.refine.parameters() if p.requires_grad) if ramp == 0.0 else 0.0
        self.clock.lap("forward")
        self.optimizer.zero_grad()
        self.fabric.backward(terms.total + 0.0 * unused)
        self.clock.lap("backward")
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), self.settings.clip)
        # All processes must take the same branch, whichever process saw the bad number or the signal.
        bad, stopped = self._any(not bool(torch.isfinite(terms.total + norm)), stop.is_set())
        self.update += 1
        if bad:
            self._count_skipped()
        else:
            self.fabric_optimizer.step()
        self.clock.lap("optimizer")
        self.interrupted = stopped and not self.finished
        return {**terms._asdict(), "ramp": ramp, "lr": self.settings.lr * factor, "grad_norm": norm}

    def _any(self, *flags: bool) -> list[bool]:
        """Tell for each flag whether it is set on at least one process."""
        if self.fabric.world_size == 1:
            return list(flags)
        counts = torch.tensor(flags, dtype=torch.float32, device=self.fabric.device)
        return (torch.as_tensor(self.fabric.all_reduce(counts, reduce_op="sum")) > 0).tolist()

    def _count_skipped(self) -> None:
        self.skipped += 1
        most = self.settings.max_skipped
        if self.fabric.is_global_zero:
            _log.warning("update %s: loss or gradient not finite, step skipped (%s so far)", self.update, self.skipped)
        if self.skipped > most:
            raise TrainingError(
                f"{self.skipped} steps had a loss or a gradient that is not finite, more than max_skipped = {most}, up "
                f"to update {self.update}. Lower the learning rate or check the data."
            )

    def log(self, step: dict[str, Any], validates: bool) -> None:
        """Append what :meth:`step` returned to the learning curves, with a validation or without."""
        values = torch.stack([step[name].detach() for name in LossTerms._fields])
        if self.fabric.world_size > 1:
            values = torch.as_tensor(self.fabric.all_reduce(values, reduce_op="mean"))
        if self.history is None:
            return
        self.clock.lap("rest")
        update, seconds = self._logged
        elapsed, shares = self.clock.since(seconds)
        speed = (self.update - update) / elapsed
        row = {"update": self.update, **step, **dict(zip(LossTerms._fields, values.tolist(), strict=True))}
        if step["ramp"] == 0.0:  # nothing was refined yet
            row = {name: value for name, value in row.items() if not name.startswith("refined")}
        row |= {"grad_norm": step["grad_norm"].item(), "skipped": self.skipped, "updates_per_second": speed}
        row |= {f"{stage}_share": share for stage, share in shares.items()}
        row["peak_memory_mib"] = self._peak_memory_mib()
        if validates:
            self.model.eval()
            results = validate(self.model, self.validation)
            self.model.train()
            for name, result in results.items():
                row |= {f"val/{name}/{column}": attrgetter(field)(result) for column, field in _CURVES.items()}
            self.rates = ", ".join(f"{name} {100 * result.success.rate:.1f} %" for name, result in results.items())
            work = f"{speed:.1f} updates/s ({describe_shares(shares)}); {row['peak_memory_mib']:.0f} MiB"
            _log.info("update %s: success %s; %s", self.update, self.rates, work)
        self.history.write(row)
        self.clock.lap("rest")
        self._logged = self.update, dict(self.clock.seconds)

    def save(self) -> None:
        """Write the checkpoint."""
        if self.fabric.is_global_zero:
            content = {"update": self.update, "skipped": self.skipped, "identity": self.identity}
            content |= {"model": self.model.state_dict(), "optimizer": self.optimizer.state_dict()}
            with atomic_open(self.checkpoint, "wb") as file:
                torch.save(content, file)
        self.fabric.barrier()

    def report(self) -> FitReport:
        """Close the learning curves and sum up."""
        if self.history is not None:
            self.history.board.close()
        self.model.eval()
        self.clock.lap("rest")
        seconds, shares = self.clock.since()
        speed, memory = (self.update - self.start) / seconds, self._peak_memory_mib()
        return FitReport(self.start, self.update, self.skipped, self.interrupted, seconds, speed, shares, memory)

    def _peak_memory_mib(self) -> float:
        if self.fabric.device.type == "cuda":
            return torch.cuda.max_memory_allocated(self.fabric.device) / 2**20
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (2**20 if sys.platform == "darwin" else 2**10)  # bytes on macOS, KiB elsewhere


def describe_shares(shares: Mapping[str, float]) -> str:
    """Shares of the time as a line of a log, for example ``"data 1 %, forward 40 %"``."""
    return ", ".join(f"{stage} {100 * share:.0f} %" for stage, share in shares.items())
