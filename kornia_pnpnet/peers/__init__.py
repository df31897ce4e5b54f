"""Solvers of other libraries behind the signature of our solvers, to compare both on the same problems.

A library is imported when one of its solvers is made.
"""

from kornia_pnpnet.peers.base import PeerPose, PeerSolver
from kornia_pnpnet.peers.libraries import KorniaRs, OpenCVPnP, OpenCVRansac, OpenCVUsac, PoseLib, PyColmap

__all__ = ["KorniaRs", "OpenCVPnP", "OpenCVRansac", "OpenCVUsac", "PeerPose", "PeerSolver", "PoseLib", "PyColmap"]
