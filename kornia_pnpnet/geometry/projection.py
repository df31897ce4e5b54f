r"""Projection, residuals and the normal equations of their Jacobian."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from kornia_pnpnet.core.linalg import dot
from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.types import Correspondences, Noise, Pose

__all__ = [
    "MIN_DEPTH_RATIO",
    "NormalEquations",
    "Projection",
    "RadialTerms",
    "distort",
    "normal_equations",
    "pixel_covariance",
    "pixel_variance",
    "project",
    "radial_stretch",
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
        rotation: rotation from the world to the camera, :math:`(B, 3, 3, 1)`, in a rig that of each pair's camera,
            :math:`(B, 3, 3, N)`.
        rig: rotation from the rig to the camera of each pair, :math:`(B, 3, 3, N)`; ``None``: the pose is the camera's.
    """

    residual: tuple[Tensor, Tensor]
    in_front: Tensor
    rotated: tuple[Tensor, Tensor, Tensor]
    plane_points: tuple[Tensor, Tensor]
    inv_depth: Tensor
    scaled_residual: tuple[Tensor, Tensor]
    rotation: Tensor
    rig: Tensor | None = None

    @property
    def sq_residual(self) -> Tensor:
        """Squared length of the residual in square pixels, shape :math:`(B, N)`."""
        u, v = self.residual
        return torch.addcmul(u * u, v, v)


class NormalEquations(NamedTuple):
    r"""The damped Gauss-Newton system before damping, entry by entry: every tensor is of shape :math:`(B,)`.

    Attributes:
        hessian: the rows of :math:`J^\top W J` up to the diagonal, the entries :math:`H_{ij}` with :math:`i \ge j`.
        gradient: :math:`J^\top W r`, 6 entries, or 7 with an unknown focal length.
    """

    hessian: Sequence[Sequence[Tensor]]
    gradient: Sequence[Tensor]


class RadialTerms(NamedTuple):
    r"""Radial distortion of the points of a projection, :math:`d = 1 + k_1 \rho^2 + k_2 \rho^4`.

    Attributes:
        stretch: :math:`d`, shape :math:`(B, N)`.
        slope: twice the derivative of :math:`d` by :math:`\rho^2 = p^2 + q^2`, shape :math:`(B, N)`.
        depth: :math:`z`, any positive number for points behind the camera, shape :math:`(B, N)`.
        terms: number of coefficients.
    """

    stretch: Tensor
    slope: Tensor
    depth: Tensor
    terms: int


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
    t0, t1, t2 = pose.translation[..., None].unbind(1)
    rotation, to_camera = pose.rotation[..., None], None
    if corr.rig is not None:
        to_camera = corr.rig.rotation.movedim(1, -1)  # (B, 3, 3, N)
        shift = corr.rig.translation.unbind(-1)
        cameras = [row.unbind(1) for row in to_camera.unbind(1)]
        y0, y1, y2 = [torch.addcmul(torch.addcmul(i * y0, j, y1), k, y2) for i, j, k in cameras]
        t0, t1, t2 = [
            torch.addcmul(torch.addcmul(torch.addcmul(s, i, t0), j, t1), k, t2)
            for (i, j, k), s in zip(cameras, shift, strict=True)
        ]
        rotation = (to_camera[:, :, :, None] * rotation[:, None]).sum(2)
    x, y, z = (r + t for r, t in zip((y0, y1, y2), (t0, t1, t2), strict=True))
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
    return Projection(residual, in_front, (y0, y1, y2), plane_points, inv_depth, scaled, rotation, to_camera)


def radial_stretch(p: Tensor, q: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """The ``stretch`` and the ``slope`` of :class:`RadialTerms` at points (B, N) of the plane z = 1.

    Args:
        p: horizontal coordinate, shape :math:`(B, N)`.
        q: vertical coordinate, shape :math:`(B, N)`.
        coefficients: :math:`k_1` and, with two, :math:`k_2`, shape :math:`(B, K)`.
    """
    square = torch.addcmul(p * p, q, q)
    stretch, slope = torch.ones_like(square), torch.zeros_like(square)
    for k, coefficient in enumerate(coefficients[..., None].unbind(1)):
        stretch = stretch + coefficient * square ** (k + 1)
        slope = slope + 2.0 * (k + 1) * coefficient * square**k
    return stretch, slope


def distort(projection: Projection, corr: Correspondences, coefficients: Tensor) -> tuple[Projection, RadialTerms]:
    r"""Compare distorted projections :math:`f d (p, q)` with distorted pixels.

    Args:
        projection: what :func:`project` returned.
        corr: the correspondences, their pixels distorted.
        coefficients: See radial_stretch.

    Returns:
        The projection with the residuals of distorted pixels, and what :func:`normal_equations` needs beside it.

    Example:
        >>> points = torch.tensor([[[1.0, 2.0, 4.0]]])
        >>> corr = Correspondences(points, torch.zeros(1, 1, 2), torch.ones(1, 1), torch.tensor(100.0))
        >>> projection = project(Pose(torch.eye(3)[None], torch.zeros(1, 3)), corr)
        >>> distort(projection, corr, torch.tensor([[0.32]]))[0].residual
        (tensor([[27.5000]]), tensor([[55.]]))
    """
    p, q = projection.plane_points
    stretch, slope = radial_stretch(p, q, coefficients)
    u, v = corr.img_points.unbind(-1)
    residual = corr.focal * stretch * p - u, corr.focal * stretch * q - v
    depth = torch.where(projection.in_front, projection.inv_depth, 1.0).reciprocal()
    scaled = residual[0] * depth, residual[1] * depth
    terms = RadialTerms(stretch, slope, depth, coefficients.shape[1])
    return projection._replace(residual=residual, scaled_residual=scaled), terms


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
        rotation: rotation from the world to the camera, :math:`(*, 3, 3, 1)` or :math:`(*, 3, 3, N)`.
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
        first, second, third = (row.unbind(-2) for row in rotation.unbind(-3))
        a = [scale * torch.addcmul(i, p, k, value=-1) for i, k in zip(first, third, strict=True)]
        b = [scale * torch.addcmul(j, q, k, value=-1) for j, k in zip(second, third, strict=True)]
        of_a, of_b = noise.world_cov.times(a), noise.world_cov.times(b)
        uu, uv, vv = dot(a, of_a), dot(b, of_a), dot(b, of_b)
    if noise.img_cov is None:
        return Symmetric2(torch.addcmul(uu, noise.img, noise.img), uv, torch.addcmul(vv, noise.img, noise.img))
    return Symmetric2(uu + noise.img_cov.uu, uv + noise.img_cov.uv, vv + noise.img_cov.vv)


def normal_equations(
    projection: Projection,
    weights: Tensor | Symmetric2,
    *,
    free_focal: bool = False,
    radial: RadialTerms | None = None,
) -> NormalEquations:
    r"""The normal equations of the residuals by the six pose parameters, and by the focal length where it is unknown.

    With :math:`y = R x`, :math:`p = x/z`, :math:`q = y/z` of the camera point, and the tangent :math:`(\omega, v)` of
    :func:`retract`, the Jacobian of a pair, divided by the focal length, is

    .. math:: J = \frac1z \begin{pmatrix}
        -p y_2 & y_3 + p y_1 & -y_2 & 1 & 0 & -p \\
        -y_3 - q y_2 & q y_1 & y_1 & 0 & 1 & -q \end{pmatrix}.

    In a rig the Jacobian of each camera is turned into the axes of the rig. The seventh parameter is that of
    :func:`dolly_zoom`, with the column :math:`\tfrac1z (p y_3, q y_3)^\top`.

    Args:
        projection: what :func:`project` returned at the pose.
        free_focal: whether there is a seventh parameter.
        radial: radial distortion, whose coefficients are the last parameters.
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
    if free_focal:
        columns.append((p * y3, q * y3))
    if radial is not None:
        columns = [_distorted(column, radial, p, q) for column in columns]
        square = torch.addcmul(p * p, q, q)
        if free_focal:  # the focal length stretches the distorted pixel, the dolly moves the point
            moved = radial.stretch * y3 - radial.slope * square * (radial.depth - y3)
            columns[6] = p * moved, q * moved
        powers = [radial.depth * square ** (k + 1) for k in range(radial.terms)]
        columns += [(p * x, q * x) for x in powers]
    if projection.rig is not None:
        columns = _of_rig(columns, projection.rig) + columns[6:]
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
    hessian += [[inner(weighted[i], columns[j]) for j in range(i + 1)] for i in range(5, len(columns))]
    return NormalEquations(hessian, [inner(column, projection.scaled_residual) for column in weighted])


def _distorted(column: _Column, radial: RadialTerms, p: Tensor, q: Tensor) -> _Column:
    """A column for pixels after radial distortion, whose derivative is d I + 2 d' (p, q) (p, q)^T."""
    u, v = column
    along = radial.slope * _plus(_times(p, u), _times(q, v))
    return _plus(_times(radial.stretch, u), along * p), _plus(_times(radial.stretch, v), along * q)


def _of_rig(columns: list[_Column], to_camera: Tensor) -> list[_Column]:
    r"""Columns by the tangent of the rig's pose from those by the tangents of the cameras' poses.

    A turn and a shift of the rig are a turn and a shift of each camera, expressed in the camera's axes.
    """
    cameras = [row.unbind(1) for row in to_camera.unbind(1)]  # (B, N) each
    turned: list[_Column] = []
    for block in (columns[:3], columns[3:6]):
        for k in range(3):
            entries = []
            for row in range(2):
                terms = [_times(cameras[j][k], block[j][row]) for j in range(3)]
                entries.append(_plus(_plus(terms[0], terms[1]), terms[2]))
            turned.append((entries[0], entries[1]))
    return turned


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
