r"""What EPnP and REPPnP share: control points, the matrix of the projection equations, its null space, alignment.

A point is written as :math:`p_i = \sum_j a_{ij} c_j`. Lepetit et al. take four control points and barycentric
coordinates :math:`a_i`. Here :math:`c_0` is the centroid and :math:`c_1, c_2, c_3` are *vectors* from it, so that
:math:`a_{i0} = 1`. Both describe the same affine maps; with vectors the coordinates can be made orthonormal,
:math:`\sum_i w_i a_i a_i^\top = I`, and nothing that is computed from them depends on the axes of the world.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.types import Correspondences, Pose

__all__ = [
    "ControlPoints",
    "align",
    "control_points",
    "normal_matrix",
    "smallest_eigenvectors",
]


class ControlPoints(NamedTuple):
    r"""The world points in coordinates of their own.

    Attributes:
        points: the centroid and three vectors from it, of one standard deviation each, shape :math:`(B, 4, 3)`.
            Planar points have 0 as the third vector.
        coordinates: :math:`a`, with ``coordinates @ points`` the world points and
            :math:`\sum_i w_i a_i a_i^\top = I`, shape :math:`(B, N, 4)`. Planar points have 0 as the last one.
        weights: the weights of the pairs, with the sum 1, shape :math:`(B, N)`.
        planar: whether the points lie in one plane, bool, shape :math:`(B,)`.
        ok: whether there are at least three points that do not lie on a line, bool, shape :math:`(B,)`.
    """

    points: Tensor
    coordinates: Tensor
    weights: Tensor
    planar: Tensor
    ok: Tensor


def control_points(corr: Correspondences, *, planar_ratio: float = 1e-3) -> ControlPoints:
    """Choose the control points by the weighted Gram-Schmidt process on the coordinates of the world points.

    Args:
        corr: normalised correspondences. Pairs with the weight 0 do not matter.
        planar_ratio: points whose extent across their plane is less than this share of that in it are planar.

    Returns:
        The :class:`ControlPoints`.
    """
    weights = corr.weights.mT.contiguous()  # (N, B)
    total = weights.sum(0)
    weights = weights / torch.where(total > 0, total, 1.0)
    world = corr.world_points.permute(2, 1, 0).contiguous()  # (3, N, B)
    centroid = (world * weights).sum(1)  # (3, B)
    rest = world - centroid[:, None]
    tiny = torch.finfo(rest.dtype).tiny ** 0.5
    vectors, coordinates, found = [centroid], [torch.ones_like(weights)], []
    limit = torch.zeros_like(total)
    line_ratio = torch.finfo(rest.dtype).eps ** 0.5
    for ratio in (line_ratio, planar_ratio, 0.0):
        variance = (rest.square() * weights).sum(1)  # (3, B)
        largest, position = variance.max(0)  # (B,)
        there = largest > limit
        inverse = torch.where(there, torch.where(there, largest, 1.0).rsqrt(), 0.0)
        axis = rest.gather(0, position.expand(1, *weights.shape))[0] * inverse  # (N, B)
        vector = (rest * (weights * axis)).sum(1)  # (3, B)
        rest = rest - vector[:, None] * axis
        vectors.append(vector)
        coordinates.append(axis)
        found.append(there)
        limit = (largest.detach() * ratio**2).clamp(min=tiny)
    return ControlPoints(
        torch.stack(vectors, 1).permute(2, 1, 0),
        torch.stack(coordinates).permute(2, 1, 0),
        weights.mT,
        ~found[2],
        found[1],
    )


def normal_matrix(control: ControlPoints, plane_points: Tensor) -> Tensor:
    r"""The matrix :math:`M^\top W M` of the projection equations, cheaply.

    :math:`M` has the rows :math:`(a_i, 0, -u_i a_i)` and :math:`(0, a_i, -v_i a_i)`. Its unknowns are the x, then the
    y, then the z of the control points in the camera frame.

    Args:
        control: the control points.
        plane_points: :math:`(u, v)`, pixels divided by the focal length, :math:`(B, N, 2)`.

    Returns:
        Shape :math:`(B, 12, 12)`.
    """
    a = control.coordinates
    u, v = plane_points.unbind(-1)
    weighted = a * control.weights[..., None]
    scaled = torch.cat((a, a * u[..., None], a * v[..., None], a * (u * u + v * v)[..., None]), -1)
    gram, first, second, both = (weighted.mT @ scaled).chunk(4, -1)  # (B, 4, 4) each
    zero = torch.zeros_like(gram)
    return torch.cat(
        (
            torch.cat((gram, zero, -first), -1),
            torch.cat((zero, gram, -second), -1),
            torch.cat((-first, -second, both), -1),
        ),
        -2,
    )


class _SmallestEigenvectors(torch.autograd.Function):
    @staticmethod
    def forward(matrix: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        values, vectors = torch.linalg.eigh(matrix)
        return values[:, :count].clone(), vectors[..., :count].clone(), values, vectors

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(output[2], output[3])
        ctx.save_for_backward(output[2], output[3])

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        values, vectors = ctx.saved_tensors
        count = gradients[0].shape[-1]
        gap = values[:, None, :count] - values[:, :, None]  # (B, D, count): of the vector minus of the other
        largest = values.abs().amax(-1)[:, None, None]
        distinct = gap.abs() > 16 * torch.finfo(gap.dtype).eps * largest
        inner = torch.where(distinct, vectors.mT @ gradients[1] / torch.where(distinct, gap, 1.0), 0.0)
        kept = vectors[..., :count]
        gradient = vectors @ inner @ kept.mT + (kept * gradients[0][:, None]) @ kept.mT
        return 0.5 * (gradient + gradient.mT), None


def smallest_eigenvectors(matrix: Tensor, count: int) -> tuple[Tensor, Tensor]:
    r"""The smallest eigenvalues of symmetric matrices and their eigenvectors.

    Args:
        matrix: symmetric, :math:`(B, D, D)`.
        count: how many.

    Returns:
        Eigenvalues :math:`(B, K)`, ascending, and eigenvectors :math:`(B, D, K)`. Their gradient is right where the
        eigenvalues differ, and finite everywhere.
    """
    values, vectors, _, _ = _SmallestEigenvectors.apply(matrix, count)
    return values, vectors


def _product(a: Tensor, b: Tensor) -> Tensor:
    """The matrix product of small matrices whose entries come first, (R, K, *) and (K, C, *)."""
    total = a[:, 0, None] * b[0]
    for k in range(1, a.shape[1]):
        total = torch.addcmul(total, a[:, k, None], b[k])
    return total


def _cofactors(matrix: Tensor) -> Tensor:
    """Cofactors, (3, 3, *): the rows are the cross products of the rows of ``matrix``."""
    m = [row.unbind(0) for row in matrix.unbind(0)]
    entries = []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        for k, l in ((1, 2), (2, 0), (0, 1)):
            entries.append(torch.addcmul(m[i][k] * m[j][l], m[i][l], m[j][k], value=-1))
    return torch.stack(entries).unflatten(0, (3, 3))


class _NearestRotation(torch.autograd.Function):
    @staticmethod
    def forward(matrix: Tensor) -> tuple[Tensor, Tensor]:
        eps = torch.finfo(matrix.dtype).eps
        size = matrix.abs().amax((0, 1))
        there = size > torch.finfo(matrix.dtype).tiny ** 0.25
        scaled = matrix / torch.where(there, size, 1.0)
        cofactors = _cofactors(scaled)
        determinant = (scaled[0] * cofactors[0]).sum(0)
        mean = scaled.square().sum((0, 1)) / 3.0
        minors = cofactors.square().sum((0, 1))
        radius = (mean * mean - minors / 3.0).clamp(min=eps * eps).sqrt()
        cosine = (mean * (mean * mean - 0.5 * minors) + 0.5 * determinant * determinant) / radius**3
        largest = (mean + 2.0 * radius * (cosine.clamp(-1.0, 1.0).acos() / 3.0).cos()).sqrt().clamp(min=eps)
        upright = scaled + cofactors / largest
        first = largest + determinant / (largest * largest)
        second = (0.5 * (upright.square().sum((0, 1)) - first * first)).clamp(min=0.0).sqrt()
        unique = there & (second > 64 * eps * first)
        second = torch.where(unique, second, 1.0)
        gram = _product(upright.transpose(0, 1), upright)
        a = second.reciprocal() + second / (first * (first + second))
        b = -(first * second * (first + second)).reciprocal()
        eye = torch.eye(3, dtype=matrix.dtype, device=matrix.device).view(3, 3, *(1,) * (matrix.ndim - 2))
        rotation = _product(upright, torch.addcmul(a * eye, b, gram))
        for _ in range(2):
            gram = _product(rotation.transpose(0, 1), rotation)
            rotation = _product(rotation, 1.5 * eye - 0.5 * gram)
        return torch.where(unique, rotation, eye), unique


def nearest_rotation(matrix: Tensor) -> tuple[Tensor, Tensor]:
    return _NearestRotation.forward(matrix)


def align(source: Tensor, target: Tensor, weights: Tensor) -> tuple[Pose, Tensor]:
    r"""The similarity that moves points onto others best, by least squares (orthogonal Procrustes).

    Args:
        source: :math:`(B, K, 3)`.
        target: :math:`(B, K, 3)`.
        weights: at least 0, :math:`(B, K)`.

    Returns:
        The rigid motion with ``target ~ R source + t``, and the scale ``s`` of ``target ~ s R (source - mean) + mean``.
    """
    share = (weights / weights.sum(-1, keepdim=True).clamp(min=torch.finfo(weights.dtype).tiny))[..., None]
    source_mean, target_mean = (share * source).sum(1), (share * target).sum(1)
    centred = source - source_mean[:, None]
    covariance = (target - target_mean[:, None]).mT @ (share * centred)  # (B, 3, 3)
    U, S, Vh = torch.linalg.svd(covariance)
    sign = torch.ones_like(S)
    sign[:, 2] = (torch.linalg.det(U) * torch.linalg.det(Vh)).sign()
    rotation = (U * sign[:, None]) @ Vh
    scale = (S * sign).sum(-1) / (share * centred.square()).sum((1, 2))
    translation = target_mean - (rotation @ source_mean[..., None])[..., 0]
    return Pose(rotation, translation), scale
