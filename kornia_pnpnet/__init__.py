"""Camera poses from 2D-3D correspondences with outliers, as a batched, differentiable PyTorch layer."""

from kornia_pnpnet.covariance import pose_covariance
from kornia_pnpnet.init import MLPInit, SetInit, p3p
from kornia_pnpnet.likelihood import monte_carlo_pose_loss
from kornia_pnpnet.losses import PoseLoss, SetLoss
from kornia_pnpnet.metrics import pose_errors, success, success_rate
from kornia_pnpnet.normalize import Normalize
from kornia_pnpnet.pretrained import shipped_weights
from kornia_pnpnet.refine import RobustWeightedLM
from kornia_pnpnet.registry import create_solver, list_solvers, solve_pnp
from kornia_pnpnet.solver import PnPNet
from kornia_pnpnet.types import Correspondences, Guess, Hypotheses, Noise, PnPResult, Pose, Problems, Refinement, Status

__version__ = "0.1.0"

__all__ = [
    "Correspondences",
    "Guess",
    "Hypotheses",
    "MLPInit",
    "Noise",
    "Normalize",
    "PnPNet",
    "PnPResult",
    "Pose",
    "PoseLoss",
    "Problems",
    "Refinement",
    "RobustWeightedLM",
    "SetInit",
    "SetLoss",
    "Status",
    "__version__",
    "create_solver",
    "list_solvers",
    "monte_carlo_pose_loss",
    "p3p",
    "pose_covariance",
    "pose_errors",
    "shipped_weights",
    "solve_pnp",
    "success",
    "success_rate",
]
