"""The numbers of a training run."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kornia.core.check import KORNIA_CHECK

from kornia_pnpnet.core.checks import check_numbers, check_positive, check_whole

__all__ = ["TrainSettings"]


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
