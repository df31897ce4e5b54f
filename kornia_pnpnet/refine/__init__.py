"""Refinement: robust weighted Levenberg-Marquardt, its step, its kernels and its learned parameters."""

from kornia_pnpnet.refine.kernels import KERNELS, RobustKernel
from kornia_pnpnet.refine.lm import BoundedParameter, LMStart, LMStep, RobustWeightedLM, explains, lm_step, solve_damped

__all__ = [
    "KERNELS",
    "BoundedParameter",
    "LMStart",
    "LMStep",
    "RobustKernel",
    "RobustWeightedLM",
    "explains",
    "lm_step",
    "solve_damped",
]
