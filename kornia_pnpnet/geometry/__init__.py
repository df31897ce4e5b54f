r"""Projection, residual, Jacobian, retraction and alignment, on kornia's conversions.

Convention: ``x_cam = R x_world + t``; the camera looks along +z; pixels are those of a camera with one focal length
and the principal point 0 (see :mod:`kornia_pnpnet.normalize`). A point is *in front* when its depth is more than
``MIN_DEPTH_RATIO`` of its distance, a test that does not depend on the unit of the world.
"""

from kornia_pnpnet.geometry.projection import (
    MIN_DEPTH_RATIO,
    NormalEquations,
    Projection,
    RadialTerms,
    distort,
    normal_equations,
    pixel_covariance,
    pixel_variance,
    project,
    radial_stretch,
    transform,
)
from kornia_pnpnet.geometry.tangent import (
    additive_tangent_map,
    change_tangent,
    dolly_zoom,
    gate_pose,
    move,
    retract,
    retract_additive,
    rotation_angle,
)

__all__ = [
    "MIN_DEPTH_RATIO",
    "NormalEquations",
    "Projection",
    "RadialTerms",
    "additive_tangent_map",
    "align",
    "change_tangent",
    "distort",
    "dolly_zoom",
    "gate_pose",
    "move",
    "pixel_covariance",
    "pixel_variance",
    "normal_equations",
    "project",
    "radial_stretch",
    "retract",
    "retract_additive",
    "rotation_angle",
    "span_a_plane",
    "transform",
]
