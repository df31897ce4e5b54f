r"""What EPnP and REPPnP share: coordinates of the world points in a frame of their own, and orthogonal Procrustes.

A world point is written as :math:`p_i = \sum_j a_{ij} c_j`, and so is the same point in the camera frame, with the
same :math:`a_{ij}` and unknown :math:`c_j`. Lepetit et al. take four control points and barycentric coordinates. Here
:math:`c_0` is the centroid and :math:`c_1, c_2, c_3` are *vectors* from it, so that :math:`a_{i0} = 1`. The affine maps
that both describe are the same; but with vectors the coordinates can be made orthonormal,
:math:`\sum_i w_i a_i a_i^\top = I`, and what is computed from them need not depend on the axes of the world.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.types import Correspondences, Pose

__all__ = ["ControlPoints", "align", "control_points", "nearest_rotation", "small_product"]

# Points are planar when their extent across the plane is below this share of that along it, a thousandth.
_PLANAR_RATIO = 1e-3


class ControlPoints(NamedTuple):
    r"""The world points in coordinates of their own.

    The tensors lie in memory with the problems last, see :func:`control_points`.

    Attributes:
        points: the centroid and three vectors from it, shape :math:`(B, 4, 3)`. The vectors are a square root of the
            covariance of the points. Planar points have 0 as the third.
        coordinates: :math:`a`, with ``coordinates @ points`` the world points and
            :math:`\sum_i w_i a_i a_i^\top = I`, shape :math:`(B, N, 4)`. Planar points have 0 as the last one.
        weights: the weights of the pairs, with the sum 1, shape :math:`(B, N)`.
        planar: whether the points lie in one plane (or on a line), bool, shape :math:`(B,)`.
        ok: whether the points span more than a line, bool, shape :math:`(B,)`.
    """

    points: Tensor
    coordinates: Tensor
    weights: Tensor
    planar: Tensor
    ok: Tensor


def control_points(corr: Correspondences) -> ControlPoints:
    r"""Choose the control points by weighted Gram-Schmidt on the coordinates of the world points.

    The axis along which the points spread most comes first, what it explains is taken from the others, and so on. The
    principal directions of the paper would be the same but for an orthogonal transform of :math:`c_1, c_2, c_3`,
    which costs an eigendecomposition and has no gradient where two extents are equal.

    Results are views of tensors with the problems in the last dimension: elementwise operations on those are several
    times faster than on problems in the first.

    Args:
        corr: normalised correspondences. Pairs with the weight 0 do not matter.

    Returns:
        The :class:`ControlPoints`.

    Example:
        >>> world = torch.tensor([[[4.0, 0, 0], [-4, 0, 0], [0, 2, 0], [0, -2, 0]]])
        >>> corr = Correspondences(world, torch.zeros(1, 4, 2), torch.ones(1, 4), torch.tensor(1.0))
        >>> control = control_points(corr)
        >>> control.planar, torch.allclose(control.coordinates @ control.points, world)
        (tensor([True]), True)
    """
    weights = corr.weights.mT.contiguous()  # (N, B)
    total = weights.sum(0)
    weights = weights / torch.where(total > 0, total, 1.0)
    world = corr.world_points.permute(2, 1, 0).contiguous()  # (3, N, B)
    centroid = (world * weights).sum(1)  # (3, B)
    rest = world - centroid[:, None]
    # Below these an axis is rounding: the first is absolute, the others relative to the extent of the one before.
    limit = torch.full_like(total, torch.finfo(rest.dtype).tiny ** 0.5)
    line_ratio = torch.finfo(rest.dtype).eps ** 0.5
    vectors, coordinates, found = [centroid], [torch.ones_like(weights)], []
    for ratio in (line_ratio, _PLANAR_RATIO, 1.0):
        variance = (rest.square() * weights).sum(1)  # (3, B)
        largest, position = variance.max(0)
        there = largest > limit
        inverse = torch.where(there, torch.where(there, largest, 1.0).rsqrt(), 0.0)
        axis = rest.gather(0, position.expand(1, *weights.shape))[0] * inverse  # (N, B)
        vector = (rest * (weights * axis)).sum(1)  # (3, B)
        rest = rest - vector[:, None] * axis
        vectors.append(vector)
        coordinates.append(axis)
        found.append(there)
        limit = torch.where(there, (largest.detach() * ratio**2).maximum(limit), torch.inf)
    return ControlPoints(
        torch.stack(vectors, 1).permute(2, 1, 0),
        torch.stack(coordinates).permute(2, 1, 0),
        weights.mT,
        ~found[2],
        found[1],
    )


def small_product(a: Tensor, b: Tensor) -> Tensor:
    r"""Product of small matrices with the problems last, written out: several times faster than a batched ``matmul``.

    Args:
        a: shape :math:`(R, K, *)`.
        b: shape :math:`(K, C, *)`.

    Returns:
        Shape :math:`(R, C, *)`.
    """
    (first, *others), (row, *rows) = a.unbind(1), b.unbind(0)
    total = first[:, None] * row
    for column, row in zip(others, rows, strict=True):
        total = torch.addcmul(total, column[:, None], row)
    return total


def _cofactors(matrix: Tensor) -> Tensor:
    """Cofactors of matrices (3, 3, *): their rows are the cross products of the rows."""
    m = [row.unbind(0) for row in matrix.unbind(0)]
    turns = ((1, 2), (2, 0), (0, 1))
    entries = [torch.addcmul(m[i][k] * m[j][n], m[i][n], m[j][k], value=-1) for i, j in turns for k, n in turns]
    return torch.stack(entries).unflatten(0, (3, 3))


def _turn(a: Tensor, b: Tensor) -> Tensor:
    r"""The vector :math:`v` with :math:`[v]_\times = a^\top b - b^\top a`, (3, *), of matrices (3, 3, *)."""
    product = small_product(a.transpose(0, 1), b)
    return torch.stack([product[j, i] - product[i, j] for i, j in ((1, 2), (2, 0), (0, 1))])


class _NearestRotation(torch.autograd.Function):
    @staticmethod
    def forward(matrix: Tensor) -> tuple[Tensor, Tensor]:
        eps = torch.finfo(matrix.dtype).eps
        size = matrix.abs().amax((0, 1))
        there = size > torch.finfo(matrix.dtype).tiny ** 0.25
        scaled = matrix / torch.where(there, size, 1.0)
        # The largest singular value: the squares of all three are the roots of x³ - 3 mean x² + minors x - det².
        cofactors = _cofactors(scaled)
        determinant = (scaled[0] * cofactors[0]).sum(0)
        mean = scaled.square().sum((0, 1)) / 3.0
        minors = cofactors.square().sum((0, 1))
        radius = (mean * mean - minors / 3.0).clamp(min=eps * eps).sqrt()
        cosine = (mean * (mean * mean - 0.5 * minors) + 0.5 * determinant * determinant) / radius**3
        largest = (mean + 2.0 * radius * (cosine.clamp(-1.0, 1.0).acos() / 3.0).cos()).sqrt().clamp(min=eps)
        # With singular values s₁ ≥ s₂ ≥ |s₃|, the last with the sign of the determinant, the matrix plus its cofactors
        # over s₁ has the same singular vectors and the values first = s₁ + s₂s₃/s₁ and, twice, second = s₂ + s₃, all
        # positive. Of two distinct values the inverse square root is a polynomial of degree 1.
        upright = scaled + cofactors / largest
        first = largest + determinant / (largest * largest)
        square, minors = first * first, _cofactors(upright).square().sum((0, 1))  # of the two: 2 first² second² + second⁴
        second = (minors / (square + torch.addcmul(minors, square, square).sqrt())).sqrt()
        unique = there & (second > eps**0.75 * first)  # what Newton-Schulz below can repair
        second = torch.where(unique, second, 1.0)
        constant = second.reciprocal() + second / (first * (first + second))
        linear = -(first * second * (first + second)).reciprocal()
        eye = torch.eye(3, dtype=matrix.dtype, device=matrix.device).view(3, 3, *(1,) * (matrix.ndim - 2))
        gram = small_product(upright.transpose(0, 1), upright)
        rotation = small_product(upright, torch.addcmul(constant * eye, linear, gram))
        for _ in range(2):  # Newton-Schulz: what rounding left of the deviation from orthogonality
            gram = small_product(rotation.transpose(0, 1), rotation)
            rotation = small_product(rotation, 1.5 * eye - 0.5 * gram)
        return torch.where(unique, rotation, eye), unique

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(inputs[0], *output)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        # M = R S turns by dR = R [w], with (tr S - S) w the vector of Rᵀ dM - dMᵀ R.
        matrix, rotation, unique = ctx.saved_tensors
        inner = small_product(rotation.transpose(0, 1), matrix)
        inner = 0.5 * (inner + inner.transpose(0, 1))
        size = inner.abs().amax((0, 1))
        inner = inner / torch.where(unique, size, 1.0)
        eye = torch.eye(3, dtype=matrix.dtype, device=matrix.device).view(3, 3, *(1,) * (matrix.ndim - 2))
        normal = (inner[0, 0] + inner[1, 1] + inner[2, 2]) * eye - inner
        normal = torch.where(unique, normal, eye)
        cofactors = _cofactors(normal)
        determinant = (normal[0] * cofactors[0]).sum(0)
        usable = unique & (determinant > torch.finfo(matrix.dtype).tiny)
        turn = (cofactors * _turn(rotation, gradients[0])).sum(1) / torch.where(usable, determinant * size, 1.0)
        x, y, z = torch.where(usable, turn, 0.0).unbind(0)
        zero = torch.zeros_like(x)
        cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero)).unflatten(0, (3, 3))
        return small_product(rotation, cross)


def nearest_rotation(matrix: Tensor) -> tuple[Tensor, Tensor]:
    r"""The rotations :math:`R` that maximise :math:`\mathrm{tr}(R^\top M)`: orthogonal Procrustes in closed form.

    No LAPACK: a singular value decomposition of a thousand 3 by 3 matrices takes six times as long.

    Args:
        matrix: :math:`M` with the problems last, shape :math:`(3, 3, *)`.

    Returns:
        The rotations, :math:`(3, 3, *)`, and whether they are unique, bool, :math:`(*)`: where they are not (the
        second singular value is 0 or that of a reflection) the identity without gradient.

    Example:
        >>> rotation, unique = nearest_rotation(torch.diag(torch.tensor([3.0, 2.0, 0.0])))
        >>> torch.allclose(rotation, torch.eye(3), atol=1e-6), unique
        (True, tensor(True))
    """
    rotation, unique = _NearestRotation.apply(matrix)
    return rotation, unique


def align(source: Tensor, target: Tensor, weights: Tensor) -> tuple[Pose, Tensor]:
    r"""Move points onto others by a similarity, best by weighted least squares.

    Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.

    Args:
        source: shape :math:`(B, K, 3)`.
        target: shape :math:`(B, K, 3)`.
        weights: at least 0, shape :math:`(B, K)`.

    Returns:
        The motion :math:`(R, t)` and the scale :math:`s`, shape :math:`(B,)`. Rigidly the points move best by
        :math:`R x + t`, with a scale by :math:`s R (x - \bar x) + \bar y`, where the bars are weighted means.

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
