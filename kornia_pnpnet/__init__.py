"""A camera's pose from 2D-3D correspondences of which some are wrong, as a batched, differentiable PyTorch layer."""

from kornia_pnpnet.init import MLPInit
from kornia_pnpnet.lm import RobustWeightedLM
from kornia_pnpnet.losses import PoseLoss
from kornia_pnpnet.metrics import pose_errors, success, success_rate
from kornia_pnpnet.model import PnPNet, shipped_weights
from kornia_pnpnet.normalize import Normalize
from kornia_pnpnet.registry import create_solver, list_solvers
from kornia_pnpnet.types import Correspondences, Guess, Hypotheses, PnPResult, Pose, Problems, Refinement

__version__ = "0.1.0"

__all__ = [
    "Correspondences",
    "Guess",
    "Hypotheses",
    "MLPInit",
    "Normalize",
    "PnPNet",
    "PnPResult",
    "Pose",
    "PoseLoss",
    "Problems",
    "Refinement",
    "RobustWeightedLM",
    "__version__",
    "create_solver",
    "list_solvers",
    "pose_errors",
    "shipped_weights",
    "success",
    "success_rate",
]
