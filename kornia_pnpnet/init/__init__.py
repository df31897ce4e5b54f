"""Initialisers: from normalised correspondences to a first guess of the pose.

A new initialiser is one new file here: a module that maps :class:`~kornia_pnpnet.types.Correspondences` to a
:class:`~kornia_pnpnet.types.Guess`.
"""

from kornia_pnpnet.init.epnp import EPnP
from kornia_pnpnet.init.mlp import MLPInit
from kornia_pnpnet.init.ransac import P3P, RANSAC, MinimalSolver, SubsetSolver, p3p
from kornia_pnpnet.init.reppnp import REPPnP
from kornia_pnpnet.init.set import SetInit

__all__ = ["P3P", "RANSAC", "EPnP", "MLPInit", "MinimalSolver", "REPPnP", "SetInit", "SubsetSolver", "p3p"]
