"""What type checkers see, and what :mod:`kornia_pnpnet` imports at the first use of each name."""

from .covariance import pose_covariance as pose_covariance
from .diagnosis import Diagnosis as Diagnosis, diagnose as diagnose
from .frame import Normalize as Normalize
from .likelihood import monte_carlo_pose_loss as monte_carlo_pose_loss
from .losses import PoseLoss as PoseLoss, SetLoss as SetLoss
from .measurements import depth_points as depth_points, heatmap_keypoints as heatmap_keypoints
from .metrics import pose_errors as pose_errors, success as success, success_rate as success_rate
from .pretrained import shipped_weights as shipped_weights
from .problem import Hypotheses as Hypotheses, Noise as Noise, Problem as Problem, Starts as Starts
from .propose.mlp import MLPInit as MLPInit
from .propose.p3p import p3p as p3p
from .propose.set import SetInit as SetInit
from .refine.lm import Refinement as Refinement, RobustWeightedLM as RobustWeightedLM
from .refine.terms import gravity_prior as gravity_prior
from .registry import create_solver as create_solver, list_solvers as list_solvers, solve_pnp as solve_pnp
from .result import (
    Alternatives as Alternatives,
    PnPResult as PnPResult,
    Pose as Pose,
    PosePrior as PosePrior,
    Problems as Problems,
    Status as Status,
)
from .solver import PnPNet as PnPNet

__version__: str
