"""Training: the loop, its checkpoints, validation, and the results file and model card of a run."""

from kornia_pnpnet.training.checkpoint import TrainingError
from kornia_pnpnet.training.loop import fit, train_briefly
from kornia_pnpnet.training.results import FitReport, ValidationResult, validate
from kornia_pnpnet.training.run import TrainSettings, describe_shares

__all__ = [
    "FitReport",
    "TrainSettings",
    "TrainingError",
    "ValidationResult",
    "describe_shares",
    "fit",
    "train_briefly",
    "validate",
]
