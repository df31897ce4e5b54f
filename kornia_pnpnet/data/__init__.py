"""Sources of problems: synthetic ones, and real scenes."""

from kornia_pnpnet.data.colmap import Scene, View, load_colmap, load_matches, load_scene
from kornia_pnpnet.data.outliers import OutlierDraw, OutlierMix
from kornia_pnpnet.data.scenes import SceneProblems
from kornia_pnpnet.data.synthetic import (
    BoxPoints,
    MixedProblems,
    ObjectPoints,
    PointPrior,
    SlabPoints,
    SyntheticProblems,
    VaryingSize,
)

__all__ = [
    "BoxPoints",
    "MixedProblems",
    "ObjectPoints",
    "OutlierDraw",
    "OutlierMix",
    "PointPrior",
    "Scene",
    "SceneProblems",
    "SlabPoints",
    "SyntheticProblems",
    "VaryingSize",
    "View",
    "load_colmap",
    "load_matches",
    "load_scene",
]
