"""Training: the loop, its checkpoints, and the results file and model card of a run."""

from kornia_pnpnet.training.checkpoint import TrainingError
from kornia_pnpnet.training.loop import FitReport, TrainSettings, describe_shares, fit, train_briefly, validate

__all__ = ["FitReport", "TrainSettings", "TrainingError", "describe_shares", "fit", "train_briefly", "validate"]
