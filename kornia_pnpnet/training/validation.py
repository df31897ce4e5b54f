"""Success and errors of a solver on validation sets: one summary for learning curves, results files and model cards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter

import torch
from torch import nn

from kornia_pnpnet.metrics import SuccessRate, pose_errors, success, success_rate
from kornia_pnpnet.result import Problems

__all__ = ["CURVES", "ValidationResult", "validate"]

#: Columns of the learning curves, after ``val/<set>/``, and the field that each column shows.
CURVES = {
    "success": "success.rate",
    "rotation_error_deg": "median_rotation_error_deg",
    "translation_error": "median_translation_error",
    "init_rotation_error_deg": "first_stage_median_rotation_error_deg",
    "init_translation_error": "first_stage_median_translation_error",
}


@dataclass(frozen=True)
class ValidationResult:
    """Success (rotation error below 1°, translation error below 0.2) and errors on one validation set.

    ``first_stage`` stands for the initial poses, the other fields for the refined poses. Translations are in the unit
    of the world.
    """

    success: SuccessRate
    first_stage_success: SuccessRate
    median_rotation_error_deg: float
    median_translation_error: float
    first_stage_median_rotation_error_deg: float
    first_stage_median_translation_error: float

    def curves(self, name: str) -> dict[str, float]:
        """The columns of the learning curves for a set of this name."""
        return {f"val/{name}/{column}": attrgetter(field)(self) for column, field in CURVES.items()}


@torch.no_grad()
def validate(model: nn.Module, validation: Mapping[str, Problems]) -> dict[str, ValidationResult]:
    """Solve fixed problems, given by the name of their set, and summarise the errors on each set.

    Raises:
        ValueError: when a set has no problems.
    """
    results = {}
    for name, problems in validation.items():
        result = model(problems.world_points, problems.img_points, problems.intrinsics, **problems.known)
        refined, first = (pose_errors(pose, problems.pose) for pose in (result.pose, result.init))
        rates = success_rate(success(refined)), success_rate(success(first))
        medians = (part.median().item() for part in (*refined, *first))
        results[name] = ValidationResult(*rates, *medians)
    return results
