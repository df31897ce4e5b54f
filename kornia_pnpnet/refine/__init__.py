"""Refinement: robust weighted Levenberg-Marquardt.

``lm`` has the module, its stages and its loop; ``step`` one iteration as pure functions; ``kernels`` the robust kernels
(a new kernel is one entry there); ``parameters`` values that are learned within bounds; ``verdict`` whether a pose is
to be believed.
"""

from kornia_pnpnet.refine.kernels import KERNELS, RobustKernel
from kornia_pnpnet.refine.lm import RobustWeightedLM
from kornia_pnpnet.refine.parameters import BoundedParameter
from kornia_pnpnet.refine.prior import gravity_prior
from kornia_pnpnet.refine.stages import LMStart, Stage, State
from kornia_pnpnet.refine.step import LMStep, lm_step, solve_damped
from kornia_pnpnet.refine.verdict import explains

__all__ = [
    "KERNELS",
    "BoundedParameter",
    "LMStart",
    "LMStep",
    "RobustKernel",
    "RobustWeightedLM",
    "Stage",
    "State",
    "explains",
    "gravity_prior",
    "lm_step",
    "solve_damped",
]
