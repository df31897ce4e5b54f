r"""How a pose moves: retractions, their tangents, and the angle between rotations."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, rotation_matrix_to_axis_angle
from kornia.geometry.liegroup import So3
from torch import Tensor

from kornia_pnpnet.core.linalg import gate
from kornia_pnpnet.geometry.projection import NormalEquations
from kornia_pnpnet.types import Pose

__all__ = [
    "additive_tangent_map",
    "change_tangent",
    "dolly_zoom",
    "gate_pose",
    "move",
    "retract",
    "retract_additive",
    "rotation_angle",
]


def change_tangent(equations: NormalEquations, tangent_map: Tensor) -> NormalEquations:
    r"""Express normal equations in other rotation parameters.

    Args:
        equations: by the tangent :math:`(\omega, v)`.
        tangent_map: derivative :math:`M` of :math:`\omega` by the other parameters, :math:`(B, 3, 3)`, for
            :func:`retract_additive` the :func:`additive_tangent_map`.

    Returns:
        The system with the rotation's blocks multiplied by :math:`M^\top` and :math:`M`.
    """
    h, g = equations
    turn = torch.stack([torch.stack([h[max(i, j)][min(i, j)] for j in range(3)], -1) for i in range(3)], -1)
    cross = torch.stack([torch.stack(list(row[:3]), -1) for row in h[3:]], -2)  # (B, 3, 3), of v by omega
    turn, cross = tangent_map.mT @ turn @ tangent_map, cross @ tangent_map
    rotation = (torch.stack(list(g[:3]), -1)[:, None] @ tangent_map)[:, 0]
    rows = [list(row.unbind(-1)[: i + 1]) for i, row in enumerate(turn.unbind(1))]
    rows += [[*row.unbind(-1), *old[3:]] for row, old in zip(cross.unbind(1), h[3:], strict=True)]
    return NormalEquations(rows, [*rotation.unbind(-1), *g[3:]])


def retract(pose: Pose, delta: Tensor) -> Pose:
    r"""Move a pose along a tangent vector, :math:`(\mathrm{cay}(\omega) R,\; t + v)`.

    Rotation and translation move independently. With a centred world a rotation then leaves the centroid in place, so
    that both stay well separated in the normal equations at any distance of the points. The rotation is Cayley's,
    :math:`\mathrm{cay}(\omega) = (I - \tfrac12[\omega]_\times)^{-1}(I + \tfrac12[\omega]_\times)`, which agrees with
    the exponential to second order, rotates by :math:`2 \arctan(|\omega|/2)`, at most half a turn, and needs neither
    trigonometry nor a branch at 0.

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
    return move(pose, delta.unbind(-1))


def move(pose: Pose, delta: Sequence[Tensor]) -> Pose:
    """:func:`retract` by the six entries of the tangent vector, each of shape :math:`(B,)`."""
    a, b, c = (0.5 * i for i in delta[:3])
    r = pose.rotation.permute(1, 2, 0).unbind(0)  # rows of the matrix, (3, B) each

    def cross(m: Sequence[Tensor], plus: Sequence[Tensor] | None = None) -> list[Tensor]:
        """The cross product of (a, b, c) with each column, plus something."""
        pairs = ((b, m[2], c, m[1]), (c, m[0], a, m[2]), (a, m[1], b, m[0]))
        first = [i * j if plus is None else torch.addcmul(plus[n], i, j) for n, (i, j, _, _) in enumerate(pairs)]
        return [torch.addcmul(x, k, m, value=-1) for x, (_, _, k, m) in zip(first, pairs, strict=True)]

    once = cross(r)
    factor = 2.0 / torch.addcmul(torch.addcmul(torch.addcmul(torch.ones_like(a), a, a), b, b), c, c)
    rows = [torch.addcmul(i, factor, j) for i, j in zip(r, cross(once, once), strict=True)]
    return Pose(torch.stack(rows).permute(2, 0, 1), pose.translation + torch.stack(tuple(delta[3:])).mT)


def dolly_zoom(pose: Pose, zoom: Tensor) -> Pose:
    r"""Move a pose as the focal length grows by :math:`e^\varepsilon`: the depth of the origin grows with it.

    The origin, which is the centroid of a centred world, keeps its pixel and the scale at which it is seen. A change of
    the focal length and a shift along the axis, which look alike from far away, are then well separated parameters.

    Args:
        pose: rotation :math:`(B, 3, 3)`, translation :math:`(B, 3)`.
        zoom: :math:`\varepsilon`, shape :math:`(B,)`.

    Returns:
        The pose that goes with the focal length times :math:`e^\varepsilon`.

    Example:
        >>> pose = Pose(torch.eye(3)[None], torch.tensor([[1.0, 0.0, 2.0]]))
        >>> dolly_zoom(pose, torch.tensor([2.0]).log()).translation
        tensor([[1., 0., 4.]])
    """
    x, y, z = pose.translation.unbind(-1)
    return pose._replace(translation=torch.stack((x, y, z * zoom.exp())).mT)


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

    Example:
        >>> quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        >>> torch.rad2deg(rotation_angle(quarter, torch.eye(3)))
        tensor(90.)
    """
    diff = rotation_a @ rotation_b.mT
    sine = 0.5 * So3.vee(diff - diff.mT).norm(dim=-1)
    cosine = 0.5 * (diff.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0)
    return torch.atan2(sine, cosine)


def gate_pose(pose: Pose, ok: Tensor, finite: Tensor) -> Pose:
    """``core.linalg.gate`` for a pose; the identity fills."""
    eye = torch.eye(3, dtype=pose.rotation.dtype, device=pose.rotation.device)
    return Pose(gate(pose.rotation, ok, finite, eye), gate(pose.translation, ok, finite, 0.0))
