r"""One iteration of robust weighted Levenberg-Marquardt as pure functions: residual, weight, solve, move.

Source: R. Sheffer and A. Wiesel, "PnP-Net: A hybrid Perspective-n-Point Network", 2020, section 3; the damping by the
diagonal is D. Marquardt's (1963).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce
from operator import and_
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from kornia_pnpnet.core.linalg import factorise, relative, substitute
from kornia_pnpnet.core.performance import per_problem
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
from kornia_pnpnet.refine.prior import add_prior
from kornia_pnpnet.types import MIN_PAIRS, Correspondences, FramedPrior, Noise, Pose

__all__ = [
    "LMStep",
    "corrected_residuals",
    "iterate",
    "lm_step",
    "outlier_area",
    "pixel_precision",
    "solve_damped",
    "sq_standardised",
    "variance_factor",
    "weighted_equations",
]

# Logarithm of a likelihood ratio. The residuals' own variance factor replaces 1 where it is e³ times as likely.
_BELIEVED = 3.0
# Variance factors that are compared before. Noise above the estimate needs them: a kernel that is too narrow hides it.
_FACTORS = tuple(4.0**k for k in range(8))
# Powers of the confidence that the standard deviation of the noise may be proportional to, and the variance factors at
# which they are compared: noise of the geometric mean's confidence may be below the estimate.
_POWERS = (0.0, -1.0, -2.0, -3.0)
_POWER_FACTORS = tuple(4.0**k for k in range(-5, 8))
# Lower confidences count as this much, so that the pair keeps some weight.
_LEAST_CONFIDENCE = 0.05
# Share of the pairs that are inliers above which the noise may depend on the confidence.
_MOST = 0.5
# Rounds of expectation and maximisation for the share of the inliers at each factor; bounds of the share.
_ROUNDS, _LEAST_SHARE = 2, 0.02
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
    outlier_area: Tensor | None,
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
        outlier_area: see :class:`~kornia_pnpnet.refine.stages.LMStart`, :math:`(B, 1)`; ``None``: for no problem.
        kernel_weight: the robust kernel's weight.
        additive: update the rotation vector additively, as in the paper.

    Returns:
        The moved pose and whether the equations could be solved.
    """
    step, damping = (per_problem(x, pairs.weights[:, 0]) for x in (step, damping))
    shape = per_problem(shape, pairs.weights[:, :1])
    projection = project(pose, pairs)
    weights = _weights(projection, pairs, kernel_weight, shape, outlier_area)
    return lm_step(pairs, pose, projection, weights, step, damping, additive=additive, prior=pairs.prior)


def weighted_equations(
    pairs: Correspondences, pose: Pose, shape: Tensor, outlier_area: Tensor | None, kernel_weight: KernelWeight
) -> NormalEquations:
    """The normal equations of :func:`iterate` at a pose, before damping."""
    projection = project(pose, pairs)
    weights = _weights(projection, pairs, kernel_weight, shape, outlier_area)
    return _equations(projection, weights, pose, pairs.prior, pairs.focal)


def lm_step(
    corr: Correspondences,
    pose: Pose,
    projection: Projection,
    weights: Tensor | Symmetric2,
    step: Tensor,
    damping: Tensor,
    *,
    additive: bool = False,
    prior: FramedPrior | None = None,
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
        prior: another term of the cost; the weights are then inverse square pixels.

    Returns:
        The moved pose and whether the equations could be solved.
    """
    equations = _equations(projection, weights, pose, prior, corr.focal)
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


def variance_factor(
    sq_residual: Tensor,
    precision: Tensor,
    projection: Projection,
    weights: Tensor,
    kernel_weight: KernelWeight,
    shape: Tensor,
    outlier_area: Tensor,
    narrower: float = 1.0,
) -> Tensor:
    r"""Factor by which the residuals say that the variance of the noise differs from its estimate.

    First from above: inliers have Gaussian residuals with the variance times a factor, outliers have pixels anywhere in
    an area. The factor among powers of 4 with the largest likelihood replaces 1 where it is :math:`e^3` times as
    likely; the share of inliers is estimated for each, and the three pairs that any pose fits do not count. Then the a
    posteriori variance factor of the pairs deep within the kernel may lower it.

    Args:
        sq_residual: what :func:`sq_standardised` returned, :math:`(B, N)`.
        precision: inverse of the estimated variance of each pixel, :math:`(B, N)`.
        projection: the projection that the residuals are of.
        weights: weight of each pair before its residual was looked at, at most 1, :math:`(B, N)`.
        kernel_weight: the robust kernel's weight.
        shape: shape of the kernel, a scalar.
        outlier_area: see :class:`~kornia_pnpnet.refine.stages.LMStart`, :math:`(B, 1)`.
        narrower: multiplies the factor where the a posteriori variance factor lowers it.

    Returns:
        Positive, 1 where the noise is no estimate, shape :math:`(B, 1)`.
    """
    above = _factor_above(sq_residual, precision, projection.in_front & (weights > 0), weights > 0, outlier_area)
    sq_residual = sq_residual / above
    within = torch.where(projection.in_front, kernel_weight(sq_residual, shape), 0.0)
    below = _factor_below(sq_residual, within, weights, outlier_area > 0)
    return above * torch.where(below < 1.0, narrower * below, 1.0)


def corrected_residuals(
    projection: Projection,
    pairs: Correspondences,
    kernel_weight: KernelWeight,
    shape: Tensor,
    outlier_area: Tensor | None,
) -> tuple[Tensor, Noise | None]:
    """Squared residuals in the variances that they show, and the noise with sigmas no smaller than estimated.

    Args:
        projection: :func:`~kornia_pnpnet.geometry.project` of a pose.
        pairs: normalised correspondences, with the weights that :func:`variance_factor` takes.
        kernel_weight: the robust kernel's weight.
        shape: shape of the kernel, a scalar.
        outlier_area: see :func:`iterate`.

    Returns:
        The residuals, :math:`(B, N)`, and the noise, without gradient of the correction.
    """
    sq_residual, noise = sq_standardised(projection, pairs), pairs.noise
    if outlier_area is None or noise is None:
        return sq_residual, noise
    precision = pixel_variance(projection, noise, pairs.focal).reciprocal()
    if pairs.confidence is not None:
        worth = _worth_of_confidence(sq_residual, precision, projection, pairs, outlier_area)
        sq_residual, precision = sq_residual * worth, precision * worth
        noise = map_tensors(lambda sigma: sigma * worth.rsqrt(), noise)
    seen = sq_residual, precision, projection, pairs.weights
    factor = variance_factor(*seen, kernel_weight, shape, outlier_area)
    larger = factor.detach().clamp(min=1.0).sqrt()
    return sq_residual / factor, map_tensors(lambda sigma: larger * sigma, noise)


def outlier_area(corr: Correspondences) -> Tensor:
    """Area of a square with the variance of the pixels that are near: where pixels of outliers lie, (B, 1)."""
    there = (corr.near_weights > 0).to(corr.weights)
    share = there / there.sum(-1, keepdim=True).clamp(min=1.0)
    variance = torch.zeros_like(share[:, :1])
    for pixels in corr.img_points.detach().unbind(-1):
        mean = (share * pixels).sum(-1, keepdim=True)
        variance = variance + (share * (pixels - mean).square()).sum(-1, keepdim=True)
    return 6.0 * variance + torch.finfo(variance.dtype).tiny


def _weights(
    projection: Projection,
    pairs: Correspondences,
    kernel_weight: KernelWeight,
    shape: Tensor,
    outlier_area: Tensor | None,
) -> Tensor | Symmetric2:
    """Weight of each pair in the normal equations: prior weight, inverse variance or covariance, robust weight."""
    if pairs.noise is None:
        robust = pairs.weights * kernel_weight(projection.sq_residual, shape)
        return robust if pairs.prior is None else robust / pairs.prior.pixel.square()[:, None]
    precision = pixel_precision(projection, pairs.noise, pairs.focal)
    if isinstance(precision, Tensor):
        sq_residual = projection.sq_residual * precision
        if outlier_area is not None:
            if pairs.confidence is not None:
                worth = _worth_of_confidence(sq_residual, precision, projection, pairs, outlier_area)
                sq_residual, precision = sq_residual * worth, precision * worth
            seen = sq_residual, precision, projection, pairs.weights
            factor = variance_factor(*seen, kernel_weight, shape, outlier_area, NARROWER)
            sq_residual = sq_residual / factor
            if pairs.prior is not None:  # a common factor does not matter to the pairs alone
                precision = precision / factor.clamp(min=1.0)
    else:
        sq_residual = precision.form(*projection.residual)
    robust = pairs.weights * kernel_weight(sq_residual, shape)
    return map_tensors(lambda x: x * robust, precision)


def _equations(
    projection: Projection, weights: Tensor | Symmetric2, pose: Pose, prior: FramedPrior | None, focal: Tensor
) -> NormalEquations:
    """Normal equations of the pairs and of the prior.

    Weights are relative to the heaviest row of the Jacobian, so that products of tiny weights do not vanish.
    """
    size = weights if isinstance(weights, Tensor) else weights.uu + weights.vv
    size = size * projection.inv_depth * projection.inv_depth
    equations = normal_equations(projection, map_tensors(lambda x: relative(x, size), weights))
    if prior is None:
        return equations
    largest = size.detach().amax(1)
    return add_prior(equations, prior, pose, torch.where(largest > 0, largest, 1.0), focal)


@torch.no_grad()
def _factor_above(
    sq_residual: Tensor, precision: Tensor, in_front: Tensor, there: Tensor, outlier_area: Tensor
) -> Tensor:
    """Variance factor of the largest likelihood among those from 1 on, (B, 1), see :func:`variance_factor`."""
    likelihood, _ = _log_likelihoods(sq_residual, precision, in_front, there, outlier_area, _FACTORS)
    best = likelihood.max(0)
    believed = (outlier_area[:, 0] > 0) & (best.values > likelihood[0] + _BELIEVED)
    factors = torch.tensor(_FACTORS, dtype=sq_residual.dtype, device=sq_residual.device)
    return torch.where(believed, factors[best.indices], 1.0)[:, None]


def _log_likelihoods(
    sq_residual: Tensor,
    precision: Tensor,
    in_front: Tensor,
    there: Tensor,
    outlier_area: Tensor,
    factors: Sequence[float],
) -> tuple[Tensor, Tensor]:
    """Log-likelihood of the residuals at each variance factor and the number of inliers, (F, B) each."""
    grid = torch.tensor(factors, dtype=sq_residual.dtype, device=sq_residual.device)
    # Densities of a pixel, relative to that of an inlier without a residual whose factor is 1.
    inlier = torch.exp(sq_residual * (-0.5 / grid)[:, None, None]) * in_front / grid[:, None, None]
    outlier = (2.0 * math.pi / (precision * outlier_area)).clamp(max=1.0)  # (B, N)
    count = there.sum(-1, keepdim=True).clamp(min=1)
    share: Tensor | float = 0.5
    for _ in range(_ROUNDS):
        inliers = (share * inlier / (share * inlier + (1.0 - share) * outlier)).sum(-1, keepdim=True)  # (F, B, 1)
        share = (inliers / count).clamp(_LEAST_SHARE, 1.0 - _LEAST_SHARE)
    likelihood = torch.where(there, (share * inlier + (1.0 - share) * outlier).log(), 0.0).sum(-1)  # (F, B)
    return likelihood + grid.log()[:, None] * inliers[..., 0].clamp(max=MIN_PAIRS), inliers[..., 0]


@torch.no_grad()
def _worth_of_confidence(
    sq_residual: Tensor, precision: Tensor, projection: Projection, pairs: Correspondences, outlier_area: Tensor
) -> Tensor:
    r"""Factor of each pair's precision where the residuals say that noise grows as the confidence falls, (B, N).

    The keypoints of a network are often less accurate where it is less sure; a matcher's ratio says nothing of the
    noise. So the standard deviation may be proportional to a power of the confidence, or independent of it. A power
    replaces 0 where it is :math:`e^3` times as likely, by the mixture of :func:`variance_factor`, and most of the pairs
    are inliers: among many outliers, near misses would pass for noisy inliers.
    """
    assert pairs.confidence is not None
    there = pairs.weights > 0
    known = there & pairs.confidence.isfinite()
    log = torch.where(known, pairs.confidence.clamp(min=_LEAST_CONFIDENCE).log(), 0.0)
    log = torch.where(known, log - log.sum(-1, keepdim=True) / known.sum(-1, keepdim=True).clamp(min=1), 0.0)
    worths = torch.stack([torch.exp(-2.0 * power * log) for power in _POWERS])  # their geometric mean is 1
    seen = projection.in_front & there, there, outlier_area, _POWER_FACTORS
    found = [_log_likelihoods(sq_residual * w, precision * w, *seen) for w in worths]
    likelihoods, inliers = (torch.stack(x) for x in zip(*found, strict=True))  # (K, F, B)
    factor = likelihoods.max(1)
    best = factor.values.max(0)  # of the powers, (B,)
    inliers = inliers.gather(1, factor.indices[:, None])[:, 0].gather(0, best.indices[None])[0]
    believed = (best.values > factor.values[0] + _BELIEVED) & (inliers > _MOST * there.sum(-1))
    believed = believed & (outlier_area[:, 0] > 0)
    index = torch.where(believed, best.indices, 0)[None, :, None]
    return worths.gather(0, index.expand(1, *log.shape))[0]


def _factor_below(sq_residual: Tensor, kernel_weight: Tensor, weights: Tensor, estimated: Tensor) -> Tensor:
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
