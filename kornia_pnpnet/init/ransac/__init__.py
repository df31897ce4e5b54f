"""RANSAC: minimal samples (P3P), how they are drawn, scored and searched."""

from kornia_pnpnet.init.ransac.p3p import P3P, p3p
from kornia_pnpnet.init.ransac.ransac import RANSAC, SubsetSolver

__all__ = ["P3P", "RANSAC", "SubsetSolver", "p3p"]
