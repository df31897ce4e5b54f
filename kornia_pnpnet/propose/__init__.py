"""Initialisers: from normalised correspondences to a first guess of the pose.

A new initialiser is one new file here: a module that maps :class:`~kornia_pnpnet.problem.Problem` to a
:class:`~kornia_pnpnet.problem.Starts`.
"""

from kornia_pnpnet.propose.epnp import EPnP
from kornia_pnpnet.propose.mlp import MLPInit
from kornia_pnpnet.propose import P3P, RANSAC, MinimalSolver, SubsetSolver, p3p
from kornia_pnpnet.propose.reppnp import REPPnP
from kornia_pnpnet.propose.set import SetInit

__all__ = ["P3P", "RANSAC", "EPnP", "MLPInit", "MinimalSolver", "REPPnP", "SetInit", "SubsetSolver", "p3p"]
