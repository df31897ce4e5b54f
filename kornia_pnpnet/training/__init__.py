"""Training: the loop, its checkpoints, validation, and the results file and model card of a run."""

from kornia_pnpnet.training.checkpoint import TrainingError
from kornia_pnpnet.training.loop import TrainSettings, fit, train_briefly
from kornia_pnpnet.training.results import FitReport, ValidationResult, validate

__all__ = [
    "FitReport",
    "TrainSettings",
    "TrainingError",
    "ValidationResult",
    "fit",
    "train_briefly",
    "validate",
]
