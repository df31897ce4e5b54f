"""Peers: solvers of other libraries with the call signature of PnPNet, for comparisons on the same problems.

The constructor of a solver imports the solver's library.
"""

from kornia_pnpnet.peers.base import PeerPose, PeerSolver
from kornia_pnpnet.peers.libraries import KorniaRs, OpenCVPnP, OpenCVRansac, OpenCVUsac, PoseLib, PyColmap

__all__ = ["KorniaRs", "OpenCVPnP", "OpenCVRansac", "OpenCVUsac", "PeerPose", "PeerSolver", "PoseLib", "PyColmap"]
