r"""Projection, residual, Jacobian and retraction: the calculus under every refiner, on kornia's conversions.

Convention: ``x_cam = R x_world + t``; the camera looks along +z; pixels are those of a camera with one focal length
and the principal point 0 (see :mod:`kornia_pnpnet.normalize`). A point is *in front* when its depth is more than
:data:`MIN_DEPTH_RATIO` of its distance, a test that does not depend on the unit of the world.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.geometry.conversions import (
    axis_angle_to_rotation_matrix,
    convert_points_from_homogeneous,
    rotation_matrix_to_axis_angle,
)
from kornia.geometry.liegroup import So3
from torch import Tensor

from kornia_pnpnet.types import Correspondences, Pose

__all__ = [
    "MIN_DEPTH_RATIO",
    "Linearization",
    "Projection",
    "additive_tangent_map",
    "linearize",
    "project",
    "retract",
    "retract_additive",
    "rotation_angle",
    "transform",
]

#: A point with ``z <= MIN_DEPTH_RATIO * |x|`` counts as behind the camera. It bounds ``|x / z|`` by 1000.
MIN_DEPTH_RATIO = 1e-3


class Projection(NamedTuple):
    r"""Where the points fall, and what the Jacobian needs of it.

    Attributes:
        residual: projection minus measurement in pixels, 0 for points behind the camera, shape :math:`(B, N, 2)`.
        in_front: whether the point is in front of the camera, bool, shape :math:`(B, N)`.
        rotated: the points in the camera's axes before translation, :math:`R x`, shape :math:`(B, N, 3)`.
        cam_points: the points in the camera frame, (0, 0, 1) for those behind, shape :math:`(B, N, 3)`.
        plane_points: :math:`(x/z, y/z)`, shape :math:`(B, N, 2)`.
    """

    residual: Tensor
    in_front: Tensor
    rotated: Tensor
    cam_points: Tensor
    plane_points: Tensor


class Linearization(NamedTuple):
    r"""Residual and Jacobian of every pixel coordinate, both divided by the focal length.

    Attributes:
        residual: first all horizontal, then all vertical coordinates, shape :math:`(B, 2N)`.
        jacobian: its derivative by the tangent :math:`(\omega, v)`, transposed, shape :math:`(B, 6, 2N)`.
    """

    residual: Tensor
    jacobian: Tensor


def transform(pose: Pose, world_points: Tensor) -> Tensor:
    r"""Move points to the camera frame.

    Args:
        pose: world-to-camera pose, :math:`(B, 3, 3)` and :math:`(B, 3)`.
        world_points: shape :math:`(B, N, 3)`.

    Returns:
        :math:`R x + t`, shape :math:`(B, N, 3)`.
    """
    return world_points @ pose.rotation.mT + pose.translation[:, None]


def project(pose: Pose, corr: Correspondences) -> Projection:
    r"""Project the points of normalised correspondences and compare them with their pixels.

    Points behind the camera are replaced *before* the division, so that neither values nor gradients can overflow.

    Args:
        pose: world-to-camera pose in the frame of ``corr``.
        corr: normalised correspondences.

    Returns:
        The :class:`Projection`; its residual is :math:`f (x/z, y/z) - b` in pixels.

    Example:
        >>> points = torch.tensor([[[1.0, 2.0, 4.0]]])
        >>> corr = Correspondences(points, torch.zeros(1, 1, 2), torch.ones(1, 1), torch.tensor(100.0))
        >>> project(Pose(torch.eye(3)[None], torch.zeros(1, 3)), corr).residual
        tensor([[[25., 50.]]])
    """
    rotated = corr.world_points @ pose.rotation.mT  # (B, N, 3)
    cam_points = rotated + pose.translation[:, None]
    # Compared without a square root, whose gradient is infinite at 0.
    sq_ratio = MIN_DEPTH_RATIO * MIN_DEPTH_RATIO
    depth = cam_points[..., 2]
    in_front = (depth > 0) & (depth.square() > sq_ratio * cam_points.detach().square().sum(-1))
    axis = torch.eye(3, dtype=cam_points.dtype, device=cam_points.device)[2]
    safe = torch.where(in_front[..., None], cam_points, axis)
    plane_points = convert_points_from_homogeneous(safe, eps=0.0)  # (B, N, 2)
    residual = torch.where(in_front[..., None], corr.focal * plane_points - corr.img_points, 0.0)
    return Projection(residual, in_front, rotated, safe, plane_points)


def linearize(projection: Projection, focal: Tensor, tangent_map: Tensor | None = None) -> Linearization:
    r"""Analytic Jacobian of the residual by the six pose parameters.

    With :math:`y = R x`, :math:`p = x/z`, :math:`q = y/z` of the camera point, and the tangent
    :math:`(\omega, v)` of :func:`retract`, the rows divided by the focal length are
    :math:`\tfrac1z [-p y_y,\; y_z + p y_x,\; -y_y,\; 1,\; 0,\; -p]` and
    :math:`\tfrac1z [-y_z - q y_y,\; q y_x,\; y_x,\; 0,\; 1,\; -q]`.

    Args:
        projection: what :func:`project` returned at the pose.
        focal: the focal length in pixels, a scalar.
        tangent_map: :math:`(B, 3, 3)`, the derivative of :math:`\omega` by other rotation parameters, for
            :func:`retract_additive` the left Jacobian of SO(3).

    Returns:
        Residual and transposed Jacobian, in units of the focal length.
    """
    y0, y1, y2 = projection.rotated.unbind(-1)  # (B, N) each
    p, q = projection.plane_points.unbind(-1)
    inv_z = projection.cam_points[..., 2].reciprocal()
    zero = torch.zeros_like(inv_z)
    row_u = torch.stack((-p * y1, y2 + p * y0, -y1, torch.ones_like(p), zero, -p), 1) * inv_z[:, None]  # (B, 6, N)
    row_v = torch.stack((-y2 - q * y1, q * y0, y0, zero, torch.ones_like(q), -q), 1) * inv_z[:, None]
    jacobian = torch.cat((row_u, row_v), 2)
    if tangent_map is not None:
        jacobian = torch.cat((tangent_map.mT @ jacobian[:, :3], jacobian[:, 3:]), 1)
    residual = projection.residual.mT.flatten(1) / focal
    return Linearization(residual, jacobian)


def retract(pose: Pose, delta: Tensor) -> Pose:
    r"""Move a pose along a tangent vector, :math:`(\exp([\omega]_\times) R,\; t + v)`.

    Rotation and translation move apart, so that with a centred world a turn leaves the centroid where it is: the
    two stay well separated in the normal equations however far the points are.

    Args:
        pose: rotation :math:`(B, 3, 3)`, translation :math:`(B, 3)`.
        delta: :math:`(\omega, v)`, radians and world units, shape :math:`(B, 6)`.

    Returns:
        The moved pose.

    Example:
        >>> pose = Pose(torch.eye(3)[None], torch.zeros(1, 3))
        >>> retract(pose, torch.tensor([[0.0, 0.0, 0.0, 1.0, 2.0, 3.0]])).translation
        tensor([[1., 2., 3.]])
    """
    return Pose(
        axis_angle_to_rotation_matrix(delta[:, :3]) @ pose.rotation,
        pose.translation + delta[:, 3:],
    )


def retract_additive(pose: Pose, delta: Tensor) -> Pose:
    r"""The paper's update: add to the rotation vector :math:`\theta s` and to :math:`t`.

    Args:
        pose: rotation :math:`(B, 3, 3)`, translation :math:`(B, 3)`.
        delta: change of rotation vector and translation, shape :math:`(B, 6)`.

    Returns:
        The moved pose.
    """
    rotation_vector = rotation_matrix_to_axis_angle(pose.rotation) + delta[:, :3]
    return Pose(axis_angle_to_rotation_matrix(rotation_vector), pose.translation + delta[:, 3:])


def additive_tangent_map(pose: Pose) -> Tensor:
    r"""Derivative of the tangent rotation of :func:`retract` by the rotation vector of :func:`retract_additive`.

    Args:
        pose: rotation :math:`(B, 3, 3)`.

    Returns:
        The left Jacobian of SO(3) at the rotation vector of the pose, shape :math:`(B, 3, 3)`.
    """
    return So3.left_jacobian(rotation_matrix_to_axis_angle(pose.rotation))


def rotation_angle(rotation_a: Tensor, rotation_b: Tensor) -> Tensor:
    r"""Angle between two rotations.

    :math:`\mathrm{atan2}(\|\tfrac12 \mathrm{vee}(D - D^\top)\|, \tfrac12(\mathrm{tr} D - 1))` of
    :math:`D = A B^\top`, which equals :math:`\arccos((\mathrm{tr} D - 1)/2)` but keeps its digits near 0, where the
    arc cosine loses half of them. Not differentiable at exactly 0; use :mod:`kornia_pnpnet.losses` to train.

    Args:
        rotation_a: shape :math:`(*, 3, 3)`.
        rotation_b: shape :math:`(*, 3, 3)`.

    Returns:
        The angle in radians, in [0, π], shape :math:`(*)`.
    """
    diff = rotation_a @ rotation_b.mT
    sine = 0.5 * So3.vee(diff - diff.mT).norm(dim=-1)
    cosine = 0.5 * (diff.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0)
    return torch.atan2(sine, cosine)
