"""RANSAC: drawing samples, solving them, scoring their poses.

``ransac`` has the initialiser and ``search`` its rounds; ``minimal`` the contract of a minimal solver; ``p3p`` the
solver of three pairs, on ``law_of_cosines``; ``sampling`` the sampling rule; ``scoring`` the scoring rules.
"""

from kornia_pnpnet.init.ransac.minimal import MinimalSolver, SubsetSolver
from kornia_pnpnet.init.ransac.p3p import P3P, p3p
from kornia_pnpnet.init.ransac.ransac import RANSAC, search_on

__all__ = ["P3P", "RANSAC", "MinimalSolver", "SubsetSolver", "p3p", "search_on"]
