"""Sources of problems: synthetic problems and real scenes.

A source is a class with ``batch_size`` and ``batch(index)``. Constructors raise ``BaseError`` when a number or a range
is out of bounds.
"""

from kornia_pnpnet.data.colmap import load_scene
from kornia_pnpnet.data.mixtures import MixedPoints, MixedProblems, VaryingSize
from kornia_pnpnet.data.outliers import OutlierKind, OutlierMix
from kornia_pnpnet.data.points import (
    BoxPoints,
    DepthMaps,
    DrivePoints,
    FacadePoints,
    ObjectPoints,
    PointPrior,
    RoomPoints,
    SlabPoints,
)
from kornia_pnpnet.data.scenes import Scene, SceneProblems, View
from kornia_pnpnet.data.synthetic import CameraProblems, SyntheticProblems

__all__ = [
    "BoxPoints",
    "CameraProblems",
    "DepthMaps",
    "DrivePoints",
    "FacadePoints",
    "MixedPoints",
    "MixedProblems",
    "ObjectPoints",
    "OutlierKind",
    "OutlierMix",
    "PointPrior",
    "RoomPoints",
    "Scene",
    "SceneProblems",
    "SlabPoints",
    "SyntheticProblems",
    "VaryingSize",
    "View",
    "load_scene",
]
