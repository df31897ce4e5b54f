"""What type checkers see, and what :mod:`kornia_pnpnet` imports at the first use of each name."""

from .confidence import Calibration as Calibration, fit_confidence as fit_confidence
from .covariance import pose_covariance as pose_covariance
from .init import MLPInit as MLPInit, SetInit as SetInit, p3p as p3p
from .likelihood import monte_carlo_pose_loss as monte_carlo_pose_loss
from .losses import PoseLoss as PoseLoss, SetLoss as SetLoss
from .measurements import depth_points as depth_points, heatmap_keypoints as heatmap_keypoints
from .metrics import pose_errors as pose_errors, success as success, success_rate as success_rate
from .normalize import Normalize as Normalize
from .pretrained import shipped_weights as shipped_weights
from .refine import RobustWeightedLM as RobustWeightedLM, gravity_prior as gravity_prior
from .registry import create_solver as create_solver, list_solvers as list_solvers, solve_pnp as solve_pnp
from .solver import PnPNet as PnPNet
from .types import (
    Alternatives as Alternatives,
    Correspondences as Correspondences,
    Guess as Guess,
    Hypotheses as Hypotheses,
    Noise as Noise,
    PnPResult as PnPResult,
    Pose as Pose,
    PosePrior as PosePrior,
    Problems as Problems,
    Refinement as Refinement,
    Status as Status,
)

__version__: str
