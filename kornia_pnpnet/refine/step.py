r"""One iteration of robust weighted Levenberg-Marquardt as pure functions: residual, weight, solve, move.

Source: R. Sheffer and A. Wiesel, "PnP-Net: A hybrid Perspective-n-Point Network", 2020, section 3; the damping by the
diagonal is D. Marquardt's (1963).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from operator import and_
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from kornia_pnpnet.core.linalg import factorise, relative, substitute
from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.geometry import (
    NormalEquations,
    Projection,
    additive_tangent_map,
    change_tangent,
    move,
    normal_equations,
    pixel_covariance,
    pixel_variance,
    project,
    retract_additive,
)
from kornia_pnpnet.types import Correspondences, Noise, Pose

__all__ = [
    "LMStep",
    "iterate",
    "lm_step",
    "pixel_precision",
    "robust_weights",
    "solve_damped",
    "sq_standardised",
    "weighted_equations",
]

# Logarithm of a likelihood ratio. The residuals' own variance factor replaces 1 where it is e³ times as likely.
_BELIEVED = 3.0
# The smallest variance factor: residuals of exact data would give 0.
_LEAST_FACTOR = 1e-4
# The iterations multiply a variance factor below 1 by this: where the noise is known so well, a kernel of a third of
# the width separates inliers from near misses better. Tuned with the weights of `pnpnet-set`, on synthetic problems.
NARROWER = 0.1

#: Robust weight by squared residual and shape, see :class:`~kornia_pnpnet.refine.kernels.RobustKernel`.
KernelWeight: TypeAlias = Callable[[Tensor, Tensor], Tensor]


class LMStep(NamedTuple):
    r"""What one iteration returns.

    Attributes:
        pose: the pose after the step.
        solved: whether the damped normal equations could be solved (if not, the step is zero), bool, :math:`(B,)`.
    """

    pose: Pose
    solved: Tensor


def iterate(
    pairs: Correspondences,
    pose: Pose,
    step: Tensor,
    damping: Tensor,
    shape: Tensor,
    estimated: Tensor | None,
    *,
    kernel_weight: KernelWeight,
    additive: bool = False,
) -> LMStep:
    r"""Run one iteration: project, weigh the pairs by their residuals, solve for the step, move.

    Args:
        pairs: normalised correspondences; their noise is known for every pair or for none.
        pose: pose before the iteration.
        step: :math:`\gamma`, a scalar.
        damping: :math:`\lambda`, a scalar or :math:`(B,)`.
        shape: shape of the kernel, a scalar.
        estimated: problems whose noise is an estimate that the residuals may correct, bool :math:`(B, 1)`; ``None``:
            no problem.
        kernel_weight: the robust kernel's weight.
        additive: update the rotation vector additively, as in the paper.

    Returns:
        The moved pose and whether the equations could be solved.
    """
    projection = project(pose, pairs)
    weights = _weights(projection, pairs, kernel_weight, shape, estimated)
    return lm_step(pairs, pose, projection, weights, step, damping, additive=additive)


def weighted_equations(
    pairs: Correspondences, pose: Pose, shape: Tensor, estimated: Tensor | None, kernel_weight: KernelWeight
) -> NormalEquations:
    """The normal equations of :func:`iterate` at a pose, before damping."""
    projection = project(pose, pairs)
    weights = _weights(projection, pairs, kernel_weight, shape, estimated)
    return normal_equations(projection, _relative(weights, projection))


def lm_step(
    corr: Correspondences,
    pose: Pose,
    projection: Projection,
    weights: Tensor | Symmetric2,
    step: Tensor,
    damping: Tensor,
    *,
    additive: bool = False,
) -> LMStep:
    r"""Solve the damped normal equations and move the pose.

    .. math:: \beta \leftarrow \beta - \gamma\,(J^\top W J + \lambda\,\mathrm{diag}(J^\top W J))^{-1} J^\top W r

    with :math:`r` projection minus measurement, so that the step that reduces the residual is the negative one.

    Args:
        corr: normalised correspondences.
        pose: the pose to improve.
        projection: :func:`~kornia_pnpnet.geometry.project` of ``pose``.
        weights: weight of each pair, :math:`(B, N)`, or 2×2 matrices with entries of that shape. Points behind the
            camera do not count. The step does not depend on a common factor.
        step: :math:`\gamma`, a scalar.
        damping: :math:`\lambda`, a scalar or :math:`(B,)`.
        additive: update the rotation vector additively as in the paper, instead of by the retraction.

    Returns:
        The moved pose and whether the equations could be solved.
    """
    equations = normal_equations(projection, _relative(weights, projection))
    if additive:
        equations = change_tangent(equations, additive_tangent_map(pose))
    delta, solved = solve_damped(equations, damping)
    factor = solved * (-step / corr.focal)
    delta = [factor * x for x in delta]
    return LMStep(retract_additive(pose, torch.stack(delta).mT) if additive else move(pose, delta), solved)


def solve_damped(equations: NormalEquations, damping: Tensor) -> tuple[list[Tensor], Tensor]:
    r"""Solve :math:`(H + \lambda\,\mathrm{diag}(H))\,\delta = g` for a batch of positive semi-definite :math:`H`.

    An LDLᵀ factorisation written out entry by entry, so that it compiles, exports and differentiates like the rest.
    The test of the pivots does not depend on units.

    Args:
        equations: :math:`H` and :math:`g` of any size, entry by entry.
        damping: :math:`\lambda \ge 0`, a scalar or :math:`(B,)`.

    Returns:
        The entries of the solution, each :math:`(B,)`, and whether there is a solution, bool :math:`(B,)`. Where a
        pivot vanishes, values and gradients are finite but meaningless.

    Example:
        >>> four, eight = torch.tensor([4.0]), torch.tensor([8.0])
        >>> solve_damped(NormalEquations(((four,), (0 * four, four)), (eight, four)), torch.tensor(1.0))
        ([tensor([1.]), tensor([0.5000])], tensor([True]))
    """
    factor = 1.0 + damping
    rows = [[*row[:-1], row[-1] * factor] for row in equations.hessian]
    diagonal = [row[-1] for row in rows]
    limits = torch.finfo(diagonal[0].dtype)
    smallest, infinite = torch.full_like(damping, limits.tiny), torch.full_like(damping, torch.inf)
    good: list[Tensor] = []

    def inverse(k: int, pivot: Tensor) -> Tensor:
        good.append(torch.add(pivot, diagonal[k], alpha=-10.0 * limits.eps) > smallest)
        return torch.where(good[-1], pivot, infinite).reciprocal()

    lower, scaled = factorise(rows, list(equations.gradient), inverse)
    return substitute(lower, scaled), reduce(and_, good)


def pixel_precision(projection: Projection, noise: Noise, focal: Tensor) -> Tensor | Symmetric2:
    """Weight of a pixel by its noise: the inverse of the variance, or of the covariance where there is any.

    Args:
        projection: :func:`~kornia_pnpnet.geometry.project` of a pose.
        noise: noise of each pair.
        focal: the focal length in pixels, a scalar.

    Returns:
        A number for each pair, :math:`(B, N)`, or a 2×2 matrix with entries of that shape.
    """
    if not noise.covariances:
        return pixel_variance(projection, noise, focal).reciprocal()
    at = projection.rotation, projection.plane_points, projection.inv_depth
    return pixel_covariance(*at, noise, focal).inverse()


def sq_standardised(projection: Projection, corr: Correspondences, most: Tensor | None = None) -> Tensor:
    """Squared residuals in variances of their pixel where the noise is known, else in square pixels.

    Where noise has covariances this is the squared Mahalanobis distance.

    Args:
        projection: :func:`~kornia_pnpnet.geometry.project` of a pose.
        corr: normalised correspondences; their noise is known for every pair or for none.
        most: square pixels, a scalar. Larger squared residuals count as this much, and so does a point behind the
            camera. With covariances this many square pixels have the mean precision of both coordinates.

    Returns:
        Shape :math:`(B, N)`.
    """
    noise, sq_residual = corr.noise, projection.sq_residual
    variance = None if noise is None or noise.covariances else pixel_variance(projection, noise, corr.focal)
    if noise is not None and noise.covariances:
        precision = pixel_precision(projection, noise, corr.focal)
        assert isinstance(precision, Symmetric2)
        sq_residual = precision.form(*projection.residual)
        most = None if most is None else 0.5 * most * (precision.uu + precision.vv)
    if most is not None:
        sq_residual = torch.where(projection.in_front, sq_residual.minimum(most), most)
    return sq_residual if variance is None else sq_residual / variance


def robust_weights(
    sq_residual: Tensor,
    projection: Projection,
    weights: Tensor,
    kernel_weight: KernelWeight,
    shape: Tensor,
    estimated: Tensor | None,
    narrower: float = 1.0,
) -> Tensor:
    """Robust weights by residuals; where the noise is an estimate, the residuals correct it first.

    Args:
        sq_residual: what :func:`sq_standardised` returned, :math:`(B, N)`.
        projection: the projection that it is of.
        weights: weight of each pair before its residual was looked at, at most 1, :math:`(B, N)`.
        kernel_weight: the robust kernel's weight.
        shape: shape of the kernel, a scalar.
        estimated: see :func:`iterate`.
        narrower: multiplies variance factors below 1.

    Returns:
        Shape :math:`(B, N)`.
    """
    plain = kernel_weight(sq_residual, shape)
    if estimated is None:
        return plain
    within = torch.where(projection.in_front, plain, 0.0)
    factor = _variance_factor(sq_residual, within, weights, estimated)
    return kernel_weight(sq_residual / torch.where(factor < 1.0, narrower * factor, 1.0), shape)


def _weights(
    projection: Projection,
    pairs: Correspondences,
    kernel_weight: KernelWeight,
    shape: Tensor,
    estimated: Tensor | None,
) -> Tensor | Symmetric2:
    """Weight of each pair in the normal equations: prior weight, inverse variance or covariance, robust weight."""
    if pairs.noise is None:
        return pairs.weights * kernel_weight(projection.sq_residual, shape)
    precision = pixel_precision(projection, pairs.noise, pairs.focal)
    if isinstance(precision, Tensor):
        sq_residual = projection.sq_residual * precision
    else:
        sq_residual = precision.form(*projection.residual)
    robust = robust_weights(sq_residual, projection, pairs.weights, kernel_weight, shape, estimated, NARROWER)
    return map_tensors(lambda x: pairs.weights * x * robust, precision)


def _relative(weights: Tensor | Symmetric2, projection: Projection) -> Tensor | Symmetric2:
    """Weights relative to the heaviest row of the Jacobian, so that products of tiny weights do not vanish."""
    size = weights if isinstance(weights, Tensor) else weights.uu + weights.vv
    size = size * projection.inv_depth * projection.inv_depth
    return map_tensors(lambda x: relative(x, size), weights)


def _variance_factor(sq_residual: Tensor, kernel_weight: Tensor, weights: Tensor, estimated: Tensor) -> Tensor:
    r"""Factor by which the residuals say that the noise's variance is smaller than estimated, at most 1, (B, 1).

    The a posteriori variance factor of an adjustment: the weighted sum of squared residuals by the degrees of freedom.
    It replaces 1 where its likelihood ratio against 1 is beyond chance. Only pairs deep within the kernel count.

    Args:
        sq_residual: squared residuals in variances, :math:`(B, N)`.
        kernel_weight: robust weight at these residuals, at most 1, :math:`(B, N)`.
        weights: weight of each pair, at most 1, :math:`(B, N)`.
        estimated: where the factor may differ from 1, bool (B, 1).
    """
    weights = weights * kernel_weight.square().square()
    freedom = (2.0 * weights.sum(-1, keepdim=True) - 6.0).clamp(min=1.0)
    factor = ((weights * sq_residual).sum(-1, keepdim=True) / freedom).clamp(min=_LEAST_FACTOR)
    log_ratio = 0.5 * freedom * (factor - 1.0 - factor.log())
    return torch.where(estimated & (factor < 1.0) & (log_ratio > _BELIEVED), factor, 1.0)
