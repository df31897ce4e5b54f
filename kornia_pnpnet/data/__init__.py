"""Sources of problems: synthetic ones and real scenes.

``points`` has the priors of world points, ``noise`` the noise model, ``outliers`` the kinds of outliers, ``synthetic``
the source made of them, ``mixtures`` several sources in one, ``colmap`` and ``scenes`` real scenes, ``stream`` the
batches that other processes draw. A new source is one more class with ``batch_size`` and ``batch(index)``.
"""

from kornia_pnpnet.data.colmap import Scene, View, load_colmap, load_matches, load_scene
from kornia_pnpnet.data.mixtures import MixedProblems, VaryingSize
from kornia_pnpnet.data.outliers import OutlierDraw, OutlierMix
from kornia_pnpnet.data.points import BoxPoints, ObjectPoints, PointPrior, SlabPoints
from kornia_pnpnet.data.scenes import SceneProblems
from kornia_pnpnet.data.synthetic import SyntheticProblems

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
