"""Linear algebra of small matrices by elementwise operations. The batch is usually the last dimension.

For 1000 3×3 matrices, an operation on one entry of each matrix takes about 1 µs, and a call of LAPACK takes about 1 ms.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import reduce
from operator import and_
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.nn import functional

from kornia_pnpnet.core.performance import are_few, compiling, exporting, records

# Number of Jacobi sweeps. Two sweeps of random matrices give a median error of eigenvalues below 1e-9 times the norm.
_SWEEPS = 2
# Smallest pivot, in units in the last place of the diagonal entry. A smaller pivot is treated as a rounding error.
_PIVOT = 10.0
# Largest number of matrices that LAPACK decomposes. For one matrix, LAPACK takes 104 µs and the closed form 400 µs; for
# 128 matrices, both take the same time; for 1000 matrices, LAPACK takes five times as long as the closed form.
_MOST_BY_LAPACK = 128


def dot(a: Iterable[Tensor], b: Iterable[Tensor]) -> Tensor:
    """Sum of products: ``a[0] * b[0] + a[1] * b[1] + …``. All products must have the same shape."""
    (first, second), *others = zip(a, b, strict=True)
    total = first * second
    for x, y in others:
        total.addcmul_(x, y)
    return total


class _BoundedGradient(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(values: Tensor, limit: float) -> Tensor:
        return values.view_as(values)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, float], output: Tensor) -> None:
        ctx.limit = inputs[1]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        norm = gradient.flatten(1).norm(dim=1).view(-1, *(1,) * (gradient.ndim - 1))
        bounded = gradient * (ctx.limit / norm.clamp(min=ctx.limit))
        return torch.where(norm.isfinite(), bounded, 0.0), None


def bound_gradient(values: Tensor, limit: float) -> Tensor:
    """Return ``values`` (B, *) unchanged. Limit each problem's gradient in norm, and set non-finite gradients to 0."""
    bounded: Tensor = _BoundedGradient.apply(values, limit)  # type: ignore[no-untyped-call]
    return bounded


def gate(value: Tensor, live: Tensor, finite: Tensor, fill: float | Tensor) -> Tensor:
    """Keep values (B, *) where ``finite`` (B,) is true, and gradients where ``live`` (B,) is true.

    Problems that are not finite get the value ``fill``, a number or a tensor with the shape of one problem.
    """
    shape = (-1,) + (1,) * (value.ndim - 1)
    if torch.is_grad_enabled() or forward_ad._current_level >= 0:  # forward mode works in `no_grad`, too
        value = torch.where(live.view(shape), value, value.detach())
    return torch.where(finite.view(shape), value, fill).contiguous()


def half_turn(axis: Tensor) -> Tensor:
    """Rotations (*, 3, 3) by 180 degrees about axes (*, 3) of any length."""
    axis = functional.normalize(axis, dim=-1)
    return 2.0 * axis[..., :, None] * axis[..., None, :] - torch.eye(3, dtype=axis.dtype, device=axis.device)


def lengths(vectors: Tensor) -> Tensor:
    """Lengths (*) of vectors (*, K). No square overflows or underflows, and the gradient at 0 is 0."""
    limits = torch.finfo(vectors.dtype)
    unit = vectors.detach().abs().amax(-1, keepdim=True).clamp(limits.tiny**0.5, limits.max)
    return unit[..., 0] * ((vectors / unit).square().sum(-1) + limits.tiny).sqrt()


def relative(values: Tensor, size: Tensor) -> Tensor:
    """Divide values (*, N) by the largest ``size`` of the last dimension, or by 1 if this largest size is 0."""
    largest = size.amax(-1, keepdim=True)
    return values / torch.where(largest > 0, largest, 1.0)


def small_product(a: Tensor, b: Tensor) -> Tensor:
    """Multiply small matrices (R, K, *) and (K, C, *). A batched ``matmul`` is several times slower."""
    (column, row), *others = zip(a.unsqueeze(2).unbind(1), b.unbind(0), strict=True)  # (R, 1, *) and (C, *)
    total = column * row
    for column, row in others:
        total = torch.addcmul(total, column, row)
    return total


def _cofactors(matrix: Tensor) -> Tensor:
    """Cofactors of matrices (3, 3, *): each row is the cross product of the other two rows of the matrix."""
    m = [row.unbind(0) for row in matrix.unbind(0)]
    turns = ((1, 2), (2, 0), (0, 1))
    entries = [torch.addcmul(m[i][k] * m[j][n], m[i][n], m[j][k], value=-1) for i, j in turns for k, n in turns]
    return torch.stack(entries).unflatten(0, (3, 3))


def _eye(like: Tensor) -> Tensor:
    """The identity (3, 3, 1, …), for matrices (3, 3, *)."""
    return torch.eye(3, dtype=like.dtype, device=like.device).view(3, 3, *(1,) * (like.ndim - 2))


def _rotation_by_svd(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`nearest_rotation` by LAPACK, without gradient."""
    limits = torch.finfo(matrix.dtype)
    flat = matrix.reshape(3, 3, -1).permute(2, 0, 1)
    size = torch.linalg.vector_norm(flat, torch.inf, (1, 2), keepdim=True)  # (B, 1, 1)
    sound = size.clamp(limits.tiny**0.5, limits.max) == size  # LAPACK raises an error for NaN
    left, values, right = torch.linalg.svd(torch.where(sound, flat, 0.0))
    rotation = torch.bmm(left, right)
    proper = torch.linalg.det(rotation)[:, None, None]  # 1 or -1
    rotation = torch.baddbmm(rotation, left[..., 2:] * (proper - 1.0), right[:, 2:])
    first, second, third = values[..., None, None].unbind(1)
    third = third * proper
    unique = sound & (second + third > limits.eps**0.75 * (first + second * third / first))
    rotation = torch.where(unique, rotation, torch.eye(3, dtype=matrix.dtype, device=matrix.device))
    return rotation.permute(1, 2, 0).reshape(matrix.shape), unique.reshape(matrix.shape[2:])


def _rotation_in_closed_form(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`nearest_rotation` entry by entry, without gradient."""
    eps = torch.finfo(matrix.dtype).eps
    size = matrix.abs().amax((0, 1))
    nonzero = size > torch.finfo(matrix.dtype).tiny ** 0.5  # the gradient of smaller matrices would overflow
    scaled = torch.where(nonzero, matrix, 0.0) / torch.where(nonzero, size, 1.0)
    # The squares of the singular values are the roots of x³ - 3 `mean` x² + `minors` x - det². Viète's formula gives
    # the largest root.
    cofactors = _cofactors(scaled)
    determinant = (scaled[0] * cofactors[0]).sum(0)
    mean = scaled.square().sum((0, 1)) / 3.0
    minors = cofactors.square().sum((0, 1))
    radius = (mean * mean - minors / 3.0).clamp(min=eps * eps).sqrt()
    cosine = (mean * (mean * mean - 0.5 * minors) + 0.5 * determinant * determinant) / radius**3
    largest = (mean + 2.0 * radius * (cosine.clamp(-1.0, 1.0).acos() / 3.0).cos()).sqrt()
    # The stack makes a compiler compute both values once per matrix, not once per entry.
    largest, determinant = torch.stack((largest, determinant))
    # `upright` is M + C / s₁, where C holds the cofactors of M (s₁: see `nearest_rotation`). M and `upright` have equal
    # singular vectors. The singular values of `upright` are first = s₁ + s₂s₃/s₁ (once) and second = s₂ + s₃ (twice).
    # G = `upright`ᵀ `upright` has two distinct eigenvalues, so that G^(-1/2) = `constant` I + `linear` G.
    upright = scaled + cofactors / largest
    first = largest + determinant / (largest * largest)
    square = first * first
    minors = _cofactors(upright).square().sum((0, 1))  # equals 2 first² second² + second⁴
    second = (minors / (square + torch.addcmul(minors, square, square).sqrt())).sqrt()
    unique = second > eps**0.75 * first  # otherwise the Newton-Schulz iteration does not converge
    second = torch.where(unique, second, 1.0)
    constant = second.reciprocal() + second / (first * (first + second))
    linear = -(first * second * (first + second)).reciprocal()
    constant, linear = torch.stack((constant, linear))
    eye = _eye(matrix)
    gram = small_product(upright.transpose(0, 1), upright)
    rotation = small_product(upright, torch.addcmul(constant * eye, linear, gram))
    for _ in range(2):  # the Newton-Schulz iteration removes rounding errors of the orthogonality
        gram = small_product(rotation.transpose(0, 1), rotation)
        rotation = small_product(rotation, 1.5 * eye - 0.5 * gram)
    return torch.where(unique, rotation, eye), unique


def _turned(change: Tensor, matrix: Tensor, rotation: Tensor, unique: Tensor) -> Tensor:
    """First-order change of the nearest rotation if the matrix changes by ``change``."""
    # Let M = R S with symmetric S. Then dR = R hat(w), where w solves (tr(S) I - S) w = vee(Rᵀ dM - dMᵀ R). The right
    # side is the sum of the cross products of the rows of dM and R.
    inner = small_product(rotation.transpose(0, 1), matrix)
    size = inner.abs().amax((0, 1))
    inner = inner / torch.where(unique, size, 1.0)
    eye = _eye(matrix)
    normal = torch.where(unique, (inner[0, 0] + inner[1, 1] + inner[2, 2]) * eye - inner, eye)
    cofactors = _cofactors(normal)
    determinant = torch.where(unique, (normal[0] * cofactors[0]).sum(0) * size, 1.0)
    turn = torch.linalg.cross(change, rotation, dim=1).sum(0)
    turn = torch.where(unique, (cofactors * turn).sum(1) / determinant, 0.0)
    return torch.linalg.cross(rotation, turn[None], dim=1)


class _NearestRotation(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(matrix: Tensor) -> tuple[Tensor, Tensor]:
        few = are_few(matrix) and matrix.numel() <= 9 * _MOST_BY_LAPACK
        return _rotation_by_svd(matrix) if few else _rotation_in_closed_form(matrix)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(inputs[0], *output)
        ctx.save_for_forward(inputs[0], *output)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        # The linear map from dM to dR is symmetric. The same map takes the gradient for R to the gradient for M.
        return _turned(gradients[0], *ctx.saved_tensors)


class _NearestRotationForward(_NearestRotation):
    """``_NearestRotation`` plus forward-mode differentiation. ``torch.compile`` cannot trace this class."""

    @staticmethod
    def jvp(ctx: Any, change: Tensor) -> tuple[Tensor, None]:
        # PyTorch requires that a tangent has the memory layout of its value.
        return torch.zeros_like(ctx.saved_tensors[1]) + _turned(change, *ctx.saved_tensors), None


def nearest_rotation(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Find the rotations R (3, 3, *) that maximise tr(Rᵀ M) for matrices M (3, 3, *) (orthogonal Procrustes).

    The second result tells which rotations are unique, bool (*). Let s₁ ≥ s₂ ≥ |s₃| be the singular values of M, where
    s₃ has the sign of the determinant. R is unique if s₂ + s₃ > 0. Otherwise R is the identity, without gradient.
    """
    function = _NearestRotation if compiling() else _NearestRotationForward
    rotation, unique = function.apply(matrix)  # type: ignore[no-untyped-call]
    return rotation, unique


def align(source: Tensor, target: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Find the rigid motion and the similarity that best map ``source`` to ``target`` (B, K, 3), with weights (B, K).

    Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.

    Returns:
        The rotation R (B, 3, 3) and the translation t (B, 3) of the rigid motion ``R x + t``, and the scale (B,) of the
        similarity. The similarity has the same rotation but another translation.
    """
    total = weights.sum(-1, keepdim=True)
    share = (weights / (total + (total == 0)))[..., None]
    source_mean, target_mean = (share * source).sum(1), (share * target).sum(1)
    centred = source - source_mean[:, None]
    weighted = share * centred
    covariance = torch.bmm((target - target_mean[:, None]).mT, weighted)  # (B, 3, 3)
    rotation = nearest_rotation(covariance.permute(1, 2, 0))[0].permute(2, 0, 1).contiguous()
    mean_square = (weighted * centred).sum((1, 2))
    scale = (rotation * covariance).sum((1, 2)) / (mean_square + (mean_square == 0))
    return rotation, target_mean - torch.bmm(rotation, source_mean[..., None])[..., 0], scale


def span_a_plane(centred: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
    """Tell whether points span more than a line, and whether by more than rounding errors, bool (B,) each.

    ``centred`` holds points (3, N, B) minus their mean. Coordinates before centring are at most 1, and padding is 0.
    ``share`` (B,) is the inverse of the number of points.
    """
    # The sum of the principal 2×2 minors of the covariance is (trace² - sum of squared entries) / 2. This sum divided
    # by the trace approximates the second largest eigenvalue, which is only a rounding error for points on a line.
    eps = torch.finfo(centred.dtype).eps
    covariance = (centred[:, None] * centred).sum(2) * share  # (3, 3, B)
    trace, squares = covariance.diagonal().sum(-1), covariance.square().sum((0, 1))
    along = (1.0 - 16.0 * eps) * trace
    return along * trace > squares, (along - 2.0 * (64.0 * eps) ** 2) * trace > squares


def solve_leading(
    matrix: Iterable[Sequence[Tensor]], rhs: Iterable[Tensor], sizes: Sequence[int]
) -> list[list[Tensor]]:
    """Solve systems for several leading blocks of a positive semi-definite matrix by one factorisation L D Lᵀ.

    ``sizes`` has the sizes of the blocks. Entries of ``matrix`` above the diagonal are not read. Each pivot is raised
    slightly, so that the solution of a singular system is finite if ``rhs`` lies in the range of the matrix.
    """
    rows, rest = [list(row) for row in matrix], list(rhs)
    diagonal = [row[k] for k, row in enumerate(rows)]
    floor, ridge = torch.finfo(rest[0].dtype).tiny, 16.0 * torch.finfo(rest[0].dtype).eps

    def inverse(k: int, pivot: Tensor) -> Tensor:
        return torch.add(pivot, diagonal[k], alpha=ridge).clamp(min=floor).reciprocal()

    lower, scaled = factorise(rows, rest, inverse)
    return [substitute(lower, scaled[:size]) for size in sizes]


def factorise(
    rows: list[list[Tensor]], rest: list[Tensor], inverse: Callable[[int, Tensor], Tensor]
) -> tuple[dict[tuple[int, int], Tensor], list[Tensor]]:
    """Factorise symmetric matrices as L D Lᵀ, entry by entry, and solve L D y = b.

    ``rows`` (the lower triangle) and ``rest`` (the entries of b) are overwritten. ``inverse(index, pivot)`` must return
    a finite inverse of a pivot, even if the pivot is 0. Returns the entries of L below its unit diagonal, keyed by
    (row, column), and the entries of y.
    """
    count = len(rest)
    lower, inverses = {}, []
    for k in range(count):
        inverses.append(inverse(k, rows[k][k]))
        for i in range(k + 1, count):
            factor = lower[i, k] = rows[i][k] * inverses[k]
            for j in range(k + 1, i + 1):
                rows[i][j] = torch.addcmul(rows[i][j], factor, rows[j][k], value=-1)
            rest[i] = torch.addcmul(rest[i], factor, rest[k], value=-1)
    return lower, [x * y for x, y in zip(rest, inverses, strict=True)]


def substitute(lower: Mapping[tuple[int, int], Tensor], scaled: Iterable[Tensor]) -> list[Tensor]:
    """Solve Lᵀ x = b, where L is from :func:`factorise`. If b is shorter than L, the leading block of L is used."""
    solution = list(scaled)
    for i in range(len(solution) - 1, 0, -1):
        for k in range(i):
            solution[k] = torch.addcmul(solution[k], lower[i, k], solution[i], value=-1)
    return solution


def solve_positive(matrix: Tensor, right: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """Solve (H + damping diag(H)) x = g for positive semi-definite H (K, K, B) and g (K, B).

    LAPACK takes 0.2 times as long as the entrywise LDLᵀ for one system, and 1.5 times as long for 1000 systems.

    Returns:
        The solutions (K, B), and whether each system is solved, bool (B,). A system is solved if each pivot exceeds a
        multiple of the rounding error of its diagonal entry. Otherwise the solution is 0, and gradients are finite.
    """
    limits = torch.finfo(right.dtype)
    least = limits.tiny**0.5  # the gradient divides by the square of a pivot
    eye = torch.eye(len(right), dtype=right.dtype, device=right.device)
    damped = torch.addcmul(matrix, matrix, eye[..., None] * damping)
    if not are_few(right):
        rows = [[*row[: i + 1]] for i, row in enumerate(damped.unbind())]
        diagonal = [row[-1] for row in rows]
        smallest, infinite = torch.full_like(diagonal[0], least), torch.full_like(diagonal[0], torch.inf)
        good: list[Tensor] = []

        def inverse(k: int, pivot: Tensor) -> Tensor:
            good.append(torch.add(pivot, diagonal[k], alpha=-_PIVOT * limits.eps) > smallest)
            return torch.where(good[-1], pivot, infinite).reciprocal()

        lower, scaled = factorise(rows, list(right.unbind()), inverse)
        solved = reduce(and_, good)
        return torch.where(solved, torch.stack(substitute(lower, scaled)), 0.0), solved
    batched = plain = damped.permute(2, 0, 1)
    if differentiated := records(batched) or records(right) or forward_ad.unpack_dual(batched).tangent is not None:
        plain = batched.detach()
    factor, info = torch.linalg.cholesky_ex(plain)
    factored, original = (x.diagonal(dim1=1, dim2=2) for x in (factor, plain))
    pivots = factored.square().add(original, alpha=-_PIVOT * limits.eps)
    solved = (pivots > least).all(1) & (info == 0)  # NaN compares false
    # Gradients of a failed factorisation are NaN. If gradients are needed, the matrices are factorised again. The
    # identity replaces each matrix whose factorisation failed.
    if differentiated:
        factor = torch.linalg.cholesky_ex(torch.where(solved[:, None, None], batched, eye)).L
    solution = torch.cholesky_solve(right.mT[..., None], factor)[..., 0].mT
    return torch.where(solved, solution, 0.0), solved


def signed(size: Tensor, sign: Tensor) -> Tensor:
    """Give positive numbers the signs of other numbers."""
    return torch.where(sign < 0, -size, size) if exporting() else size.copysign(sign)  # ONNX has no `copysign`


def eigenvectors(matrix: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Approximate eigenvalues (B,), ascending, and orthonormal eigenvectors (3, B) of symmetric matrices (3, 3, B)."""
    a = [list(row.unbind(0)) for row in matrix.unbind(0)]
    one, zero = torch.ones_like(a[0][0]), torch.zeros_like(a[0][0])
    vectors = [torch.stack([one if i == j else zero for i in range(3)]) for j in range(3)]
    tiny = torch.finfo(matrix.dtype).tiny
    for p, q, r in _SWEEPS * ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
        twice, difference = a[p][q] + a[p][q], a[q][q] - a[p][p]
        root = torch.addcmul(difference * difference, twice, twice).sqrt() + tiny
        tangent = twice / (difference + signed(root, difference))
        cosine = torch.addcmul(one, tangent, tangent).rsqrt()
        sine = tangent * cosine
        shift = tangent * a[p][q]
        a[p][p], a[q][q] = a[p][p] - shift, a[q][q] + shift
        a[p][q] = a[q][p] = zero
        (low, high), (first, second) = (
            (torch.addcmul(cosine * x, sine, y, value=-1), torch.addcmul(cosine * y, sine, x))
            for x, y in ((a[r][p], a[r][q]), (vectors[p], vectors[q]))
        )
        a[r][p] = a[p][r] = low
        a[r][q] = a[q][r] = high
        vectors[p], vectors[q] = first, second
    pairs = [torch.cat((a[i][i][None], vectors[i])) for i in range(3)]
    for i, j in ((0, 1), (1, 2), (0, 1)):
        swap = pairs[i][0] > pairs[j][0]
        pairs[i], pairs[j] = torch.where(swap, pairs[j], pairs[i]), torch.where(swap, pairs[i], pairs[j])
    return [(pair[0], pair[1:]) for pair in pairs]


def solve_symmetric(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve positive definite systems (B, 3, 3). For few systems, LAPACK takes half as long as cofactors."""
    if are_few(matrix):
        return torch.linalg.solve_ex(matrix, right).result
    a, b, c = matrix.unbind(1)
    adjugate = torch.stack((torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)), -1)
    return (adjugate @ right) / (a * adjugate[..., 0]).sum(-1)[:, None, None]
