r"""Projection, residual, Jacobian, retraction and alignment, on kornia's conversions.

Convention: ``x_cam = R x_world + t``; the camera looks along +z; pixels are those of a camera with one focal length
and the principal point 0 (see :mod:`kornia_pnpnet.normalize`). A point is *in front* when its depth is more than
:data:`MIN_DEPTH_RATIO` of its distance, a test that does not depend on the unit of the world.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, rotation_matrix_to_axis_angle
from kornia.geometry.liegroup import So3
from torch import Tensor

from kornia_pnpnet.core.linalg import dot, nearest_rotation
from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.types import Correspondences, Noise, Pose

__all__ = [
    "MIN_DEPTH_RATIO",
    "NormalEquations",
    "Projection",
    "additive_tangent_map",
    "align",
    "change_tangent",
    "move",
    "pixel_covariance",
    "pixel_variance",
    "normal_equations",
    "project",
    "retract",
    "retract_additive",
    "rotation_angle",
    "span_a_plane",
    "transform",
]

# Two rows of a column of the Jacobian; an entry that is the same for all pairs is a plain number.
_Column: TypeAlias = tuple[Any, Any]

#: A point with ``z <= MIN_DEPTH_RATIO * |x|`` counts as behind the camera. It bounds ``|x / z|`` by 1000.
MIN_DEPTH_RATIO = 1e-3


class Projection(NamedTuple):
    r"""Points projected at a pose, coordinate by coordinate: tensors of shape :math:`(B, N)`.

    Attributes:
        residual: projection minus measurement in pixels, horizontal and vertical. Where ``in_front`` is false the
            residual is finite but meaningless.
        in_front: whether the point is in front of the camera, bool.
        rotated: the points in the camera's axes before translation, :math:`y = R x`, three coordinates.
        plane_points: :math:`(x/z, y/z)`, 0 for points behind the camera.
        inv_depth: :math:`1/z`, 0 for points behind the camera.
        scaled_residual: the residual times the depth.
        rotation: the rotation of the pose, :math:`(B, 3, 3)`.
    """

    residual: tuple[Tensor, Tensor]
    in_front: Tensor
    rotated: tuple[Tensor, Tensor, Tensor]
    plane_points: tuple[Tensor, Tensor]
    inv_depth: Tensor
    scaled_residual: tuple[Tensor, Tensor]
    rotation: Tensor

    @property
    def sq_residual(self) -> Tensor:
        """Squared length of the residual in square pixels, shape :math:`(B, N)`."""
        u, v = self.residual
        return torch.addcmul(u * u, v, v)


class NormalEquations(NamedTuple):
    r"""The damped Gauss-Newton system before damping, entry by entry: every tensor is of shape :math:`(B,)`.

    Attributes:
        hessian: the rows of :math:`J^\top W J` up to the diagonal, the 21 entries :math:`H_{ij}` with :math:`i \ge j`.
        gradient: :math:`J^\top W r`, 6 entries.
    """

    hessian: Sequence[Sequence[Tensor]]
    gradient: Sequence[Tensor]


def transform(pose: Pose, world_points: Tensor) -> Tensor:
    r"""Move points to the camera frame.

    Args:
        pose: world-to-camera pose, :math:`(B, 3, 3)` and :math:`(B, 3)`.
        world_points: shape :math:`(B, N, 3)`.

    Returns:
        :math:`R x + t`, shape :math:`(B, N, 3)`.

    Example:
        >>> pose = Pose(torch.eye(3)[None], torch.tensor([[0.0, 0.0, 5.0]]))
        >>> transform(pose, torch.tensor([[[1.0, 2.0, 3.0]]]))
        tensor([[[1., 2., 8.]]])
    """
    return world_points @ pose.rotation.mT + pose.translation[:, None]


def project(pose: Pose, corr: Correspondences) -> Projection:
    r"""Project the points of normalised correspondences and compare them with their pixels.

    The depth of points behind the camera is replaced *before* the division, so that neither values nor gradients can
    overflow.

    Args:
        pose: world-to-camera pose in the frame of ``corr``.
        corr: normalised correspondences.

    Returns:
        The :class:`Projection`; its residual is :math:`f (x/z, y/z) - b` in pixels.

    Example:
        >>> points = torch.tensor([[[1.0, 2.0, 4.0]]])
        >>> corr = Correspondences(points, torch.zeros(1, 1, 2), torch.ones(1, 1), torch.tensor(100.0))
        >>> project(Pose(torch.eye(3)[None], torch.zeros(1, 3)), corr).residual
        (tensor([[25.]]), tensor([[50.]]))
    """
    a, b, c = corr.world_points.unbind(-1)  # (B, N) each, and the pose (B, 1) each
    matrix = [row.unbind(1) for row in pose.rotation[..., None].unbind(1)]
    y0, y1, y2 = (torch.addcmul(torch.addcmul(i * a, j, b), k, c) for i, j, k in matrix)
    x, y, z = (r + t for r, t in zip((y0, y1, y2), pose.translation[..., None].unbind(1), strict=True))
    # z |z| > ratio² |x|² tests the sign and the ratio at once, without a square root, whose gradient is infinite at 0.
    margin = z * z.abs()
    for coordinate in (x, y, z):
        margin = torch.addcmul(margin, coordinate, coordinate, value=-MIN_DEPTH_RATIO * MIN_DEPTH_RATIO)
    in_front = margin > 0
    inv_depth = torch.where(in_front, z, torch.inf).reciprocal()
    u, v = corr.img_points.unbind(-1)
    scaled = torch.addcmul(corr.focal * x, u, z, value=-1), torch.addcmul(corr.focal * y, v, z, value=-1)
    residual = scaled[0] * inv_depth, scaled[1] * inv_depth
    plane_points = x * inv_depth, y * inv_depth
    return Projection(residual, in_front, (y0, y1, y2), plane_points, inv_depth, scaled, pose.rotation)


def pixel_variance(projection: Projection, noise: Noise, focal: Tensor) -> Tensor:
    r"""Variance of a pixel coordinate, from the noise of the pixel and of the world point.

    A shift of the point by :math:`d` moves its pixel by :math:`J d` with :math:`J = \tfrac fz [I_2 \mid -(p, q)^\top]`,
    :math:`p = x/z`, :math:`q = y/z`. The mean over both coordinates is returned:
    :math:`\sigma_\mathrm{img}^2 + \sigma_\mathrm{world}^2 \, \mathrm{tr}(J J^\top) / 2`, where the trace is
    :math:`(f/z)^2 (2 + p^2 + q^2)`.

    Args:
        projection: what :func:`project` returned.
        noise: standard deviations, :math:`(B, N)`.
        focal: the focal length in pixels, a scalar.

    Returns:
        Shape :math:`(B, N)`. Behind the camera it is the variance of the pixel alone.

    Example:
        >>> points = torch.tensor([[[0.0, 0.0, 4.0]]])
        >>> corr = Correspondences(points, torch.zeros(1, 1, 2), torch.ones(1, 1), torch.tensor(100.0))
        >>> projection = project(Pose(torch.eye(3)[None], torch.zeros(1, 3)), corr)
        >>> pixel_variance(projection, Noise(torch.tensor([[3.0]]), torch.tensor([[0.04]])), corr.focal)
        tensor([[10.]])
    """
    p, q = projection.plane_points
    moved = focal * noise.world * projection.inv_depth
    sides = torch.addcmul(torch.addcmul(torch.ones_like(p), p, p, value=0.5), q, q, value=0.5)
    return torch.addcmul(noise.img * noise.img, moved * moved, sides)


def pixel_covariance(
    rotation: Tensor, plane_points: Sequence[Tensor], inv_depth: Tensor, noise: Noise, focal: Tensor
) -> Symmetric2:
    r"""Covariance of a pixel, from the noise of the pixel and of the world point.

    It is :math:`\Sigma_\mathrm{img} + J R\,\Sigma_\mathrm{world} R^\top J^\top` with :math:`J` of
    :func:`pixel_variance`. A standard deviation stands for a multiple of the identity.

    Args:
        rotation: rotation of the pose, :math:`(*, 3, 3)`.
        plane_points: :math:`(p, q)`, two tensors :math:`(*, N)`; see :class:`Projection`.
        inv_depth: :math:`1/z`, shape :math:`(*, N)`.
        noise: noise of each pair.
        focal: the focal length in pixels, a scalar.

    Returns:
        Entries of shape :math:`(*, N)`. Where the inverse depth is 0 they are the covariance of the pixel alone.
    """
    p, q = plane_points
    scale = focal * inv_depth
    if noise.world_cov is None:
        moved = (scale * noise.world).square()
        uu, uv, vv = torch.addcmul(moved, moved * p, p), moved * p * q, torch.addcmul(moved, moved * q, q)
    else:
        first, second, third = (row.unbind(-2) for row in rotation[..., None].unbind(-3))
        a = [scale * torch.addcmul(i, p, k, value=-1) for i, k in zip(first, third, strict=True)]
        b = [scale * torch.addcmul(j, q, k, value=-1) for j, k in zip(second, third, strict=True)]
        of_a, of_b = noise.world_cov.times(a), noise.world_cov.times(b)
        uu, uv, vv = dot(a, of_a), dot(b, of_a), dot(b, of_b)
    if noise.img_cov is None:
        return Symmetric2(torch.addcmul(uu, noise.img, noise.img), uv, torch.addcmul(vv, noise.img, noise.img))
    return Symmetric2(uu + noise.img_cov.uu, uv + noise.img_cov.uv, vv + noise.img_cov.vv)


def normal_equations(projection: Projection, weights: Tensor | Symmetric2) -> NormalEquations:
    r"""The normal equations of the residuals by the six pose parameters.

    With :math:`y = R x`, :math:`p = x/z`, :math:`q = y/z` of the camera point, and the tangent :math:`(\omega, v)` of
    :func:`retract`, the Jacobian of a pair, divided by the focal length, is

    .. math:: J = \frac1z \begin{pmatrix}
        -p y_2 & y_3 + p y_1 & -y_2 & 1 & 0 & -p \\
        -y_3 - q y_2 & q y_1 & y_1 & 0 & 1 & -q \end{pmatrix}.

    Args:
        projection: what :func:`project` returned at the pose.
        weights: weight of each pair, :math:`(B, N)`, or 2×2 matrices with entries of that shape. Points behind the
            camera do not count.

    Returns:
        :math:`J^\top W J` and :math:`J^\top W r` with :math:`J` divided by the focal length and :math:`r` in pixels.
    """
    y1, y2, y3 = projection.rotated
    p, q = projection.plane_points
    minus_p, minus_q, minus_y2 = -p, -q, -y2
    # Columns of z J: an entry in the row of u and one in the row of v. The factor 1/z² goes into the weights, and with
    # it the residual is the one times the depth.
    columns: list[_Column] = [
        (minus_p * y2, -torch.addcmul(y3, q, y2)),
        (torch.addcmul(y3, p, y1), q * y1),
        (minus_y2, y1),
        (1.0, 0.0),
        (0.0, 1.0),
        (minus_p, minus_q),
    ]
    weights = map_tensors(lambda w: w * projection.inv_depth * projection.inv_depth, weights)
    uu, uv, vv = (weights, 0.0, weights) if isinstance(weights, Tensor) else weights
    total = uu.sum(1)
    zero = torch.zeros_like(total)
    weighted: list[_Column] = [
        (_plus(_times(u, uu), _times(v, uv)), _plus(_times(u, uv), _times(v, vv))) for u, v in columns
    ]

    def inner(a: _Column, b: _Column) -> Tensor:
        """Sum over pairs and rows of the products of two columns, (B,)."""
        (a_u, a_v), (b_u, b_v) = a, b
        if type(a_u) is type(a_v) is type(b_u) is type(b_v):
            return torch.addcmul(a_u * b_u, a_v, b_v).sum(1)
        products = [x for x in (_times(a_u, b_u), _times(a_v, b_v)) if type(x) is not float]
        if not products:
            return zero
        return total if products[0] is uu else products[0].sum(1)

    # The products of the last column with the two constant ones are its weighted entries.
    hessian = [[inner(weighted[j], columns[i]) for j in range(i + 1)] for i in range(5)]
    hessian.append([inner(weighted[5], column) for column in columns])
    return NormalEquations(hessian, [inner(column, projection.scaled_residual) for column in weighted])


def _times(a: Any, b: Any) -> Any:
    """A product in which a factor that is known to be 0 or 1 costs nothing."""
    if type(a) is float:
        return b if a == 1.0 else 0.0
    if type(b) is float:
        return a if b == 1.0 else 0.0
    return a * b


def _plus(a: Any, b: Any) -> Any:
    """A sum in which a term that is known to be 0 costs nothing."""
    return b if type(a) is float else a if type(b) is float else a + b


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


def align(source: Tensor, target: Tensor, weights: Tensor) -> tuple[Pose, Tensor]:
    r"""Find the rigid motion and the scale that move points onto other points, by weighted least squares.

    Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.

    Args:
        source: points :math:`x`, shape :math:`(B, K, 3)`.
        target: points :math:`y`, shape :math:`(B, K, 3)`.
        weights: at least 0, shape :math:`(B, K)`.

    Returns:
        The motion :math:`(R, t)` and the scale :math:`s`, shape :math:`(B,)`. The best rigid motion is
        :math:`R x + t`, the best similarity :math:`s R (x - \bar x) + \bar y`, where the bars are weighted means.

    Example:
        >>> points = torch.tensor([[[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 2]]])
        >>> pose, scale = align(points, 3.0 * points + 1.0, torch.ones(1, 4))
        >>> pose.translation, scale
        (tensor([[2., 2., 2.]]), tensor([3.]))
    """
    total = weights.sum(-1, keepdim=True)
    share = (weights / torch.where(total > 0, total, 1.0))[..., None]
    source_mean, target_mean = (share * source).sum(1), (share * target).sum(1)
    centred = source - source_mean[:, None]
    covariance = (target - target_mean[:, None]).mT @ (share * centred)  # (B, 3, 3)
    rotation = nearest_rotation(covariance.permute(1, 2, 0))[0].permute(2, 0, 1).contiguous()
    mean_square = (share * centred.square()).sum((1, 2))
    scale = (rotation * covariance).sum((1, 2)) / torch.where(mean_square > 0, mean_square, 1.0)
    translation = target_mean - (rotation @ source_mean[..., None])[..., 0]
    return Pose(rotation, translation), scale


def span_a_plane(centred: Tensor, share: Tensor, size: Tensor) -> Tensor:
    """Whether points span more than a line, so that there are at least three.

    Args:
        centred: the points minus their mean, 0 for padding, (3, N, B).
        share: one over the number of points, (B,).
        size: the largest coordinate before the points were centred, (B,). Where it is 0 or NaN the result is false.

    Returns:
        bool of shape (B,).
    """
    # The second largest variance is about the sum of the principal minors of the covariance, (trace² - sum of squares)
    # / 2, over the trace. For points on a line only rounding remains.
    eps = torch.finfo(centred.dtype).eps
    covariance = (centred[:, None] * centred).sum(2) * (share / (size * size))  # (3, 3, B) in the unit of the size
    trace = covariance.diagonal().sum(-1)
    return ((1.0 - 16.0 * eps) * trace - 2.0 * (64.0 * eps) ** 2) * trace > covariance.square().sum((0, 1))
