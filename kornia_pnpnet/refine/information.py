r"""The one place where noise becomes information: the precision of each pixel, and its correction by the residuals."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import torch
from torch import Tensor

from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.problem import LEAST_NOISE, MIN_PAIRS, Noise, Problem, Starts
from kornia_pnpnet.refine.residual import Projection, pixel_covariance, pixel_variance

__all__ = [
    "KernelWeight",
    "complete_noise",
    "corrected_noise",
    "information",
    "is_unknown",
    "larger_sigma",
    "outlier_area",
    "pixel_precision",
    "sq_standardised",
]

# Logarithm of a likelihood ratio. A variance factor that the residuals show replaces 1 where it is e³ times as likely.
_BELIEVED = 3.0
# Exponents of 4: the variance factors of noise above the estimate. A kernel that is too narrow hides such noise.
_FACTORS = range(8)
# The standard deviation of the noise may be proportional to one of these powers of the confidence. The powers are
# compared at variance factors of these exponents of 4.
_POWERS = (0.0, -1.0, -2.0, -3.0)
_POWER_FACTORS = range(-5, 8)
# Lower confidences are raised to this, so that the pair keeps some weight.
_LEAST_CONFIDENCE = 0.05
# The noise may depend on the confidence only where a larger share of the pairs are inliers.
_MOST = 0.5
# Rounds of expectation and maximisation for the share of the inliers at each factor; lower bound of this share.
_ROUNDS, _LEAST_SHARE = 2, 0.02
# The smallest variance factor: residuals of exact data would give 0.
_LEAST_FACTOR = 1e-4
# Ratio of the standard deviation that the residuals show to its estimate. Iterations by residual correct smaller
# ratios; with larger ones they start too far from the minimum.
_LARGER = 4.0
# A pair is an inlier if its final weight is at least this fraction of its initial weight.
_INLIER = 0.25
# The residuals of fewer inliers than this say little of a pose that was fitted to them: with 6 to 9 pairs a second
# solution by their noise succeeds as often as the first (seeds 3117 and 3120 of SyntheticProblems).
_FEWEST = 7
# Ratio of the residuals at the true pose to the residuals at the pose that was fitted to them.
_FITTED = 1.1
# Sigmas are proportional to the inverse of this power of the confidences. On keypoints of networks the power is near 1;
# a larger one is better where pairs of low confidence are outliers.
_POWER = 1.5
# Median of the length of a residual of unit variance in both coordinates.
_MEDIAN = math.sqrt(2.0 * math.log(2.0))

#: Robust weight by squared residual and shape, see :class:`~kornia_pnpnet.refine.kernels.RobustKernel`.
KernelWeight: TypeAlias = Callable[[Tensor, Tensor], Tensor]


def complete_noise(problem: Problem, starts: Starts) -> Noise | None:
    """Noise of every pair: sigmas of the initialiser, or the caller's with 0 where unknown; covariances of the caller.

    ``None`` where neither knows any noise.
    """
    noise = starts.noise
    if noise is None and problem.noise is not None:
        noise = map_tensors(lambda x: x.nan_to_num(0.0), problem.noise)
    if noise is None:
        return None
    given = noise if problem.noise is None else problem.noise  # an initialiser estimates no covariances
    least = noise.img.maximum(LEAST_NOISE * problem.focal)
    return noise._replace(img=least, img_cov=given.img_cov, world_cov=given.world_cov)


def is_unknown(problem: Problem) -> Tensor:
    """Problems for which the caller gave no sigma, neither of a pixel nor of a point, bool (B, 1)."""
    known = torch.zeros_like(problem.weights[:, :1], dtype=torch.bool)
    for sigma in () if problem.noise is None else problem.noise.sigmas[:2]:
        known = known | sigma.isfinite().any(1, keepdim=True)
    return ~known


def pixel_precision(projection: Projection, problem: Problem, noise: Noise) -> Tensor | Symmetric2:
    """Inverse of the variance of each pixel, (B, N), or of the covariance where there is any."""
    if not noise.covariances:
        return pixel_variance(projection, noise).reciprocal()
    return pixel_covariance(projection, problem, noise).inverse()


def sq_standardised(projection: Projection, problem: Problem, most: Tensor) -> Tensor:
    """Squared residuals in variances of their pixel where the noise is known, else in square pixels, bounded.

    Args:
        projection: the points at a state.
        problem: the problem; its noise is known for every pair or for none.
        most: upper bound of a squared residual and its value behind the camera, in square pixels, a scalar or (B, 1).
            With covariances these square pixels have the mean precision of both coordinates.

    Returns:
        Shape :math:`(B, N)`.
    """
    if problem.noise is None or not problem.noise.covariances:
        sq_residual = torch.where(projection.in_front, projection.sq_residual.minimum(most), most)
        return sq_residual if problem.noise is None else sq_residual / pixel_variance(projection, problem.noise)
    precision = pixel_precision(projection, problem, problem.noise)
    assert isinstance(precision, Symmetric2)
    most = 0.5 * most * (precision.uu + precision.vv)
    return torch.where(projection.in_front, precision.form(*projection.residual.mT.unbind()).minimum(most), most)


def information(projection: Projection, problem: Problem) -> tuple[Tensor, Tensor | Symmetric2]:
    """Squared residuals in the unit of the robust kernel, and the information of the pixels.

    Args:
        projection: the points at a state.
        problem: the problem; its noise is known for every pair or for none.

    Returns:
        Squared residuals in variances, in square pixels where no noise is known, (B, N); the inverse variance of a
        pixel, (B, N) or (B, 1), or the inverse of its covariance.
    """
    if problem.noise is None:  # unknown noise counts as one pixel of the caller
        return projection.sq_residual, problem.img_scale.square().reciprocal()[:, None]
    precision = pixel_precision(projection, problem, problem.noise)
    if isinstance(precision, Tensor):
        return projection.sq_residual * precision, precision
    return precision.form(*projection.residual.mT.unbind()), precision


def corrected_noise(
    projection: Projection, problem: Problem, kernel_weight: KernelWeight, shape: Tensor, outlier_area: Tensor
) -> tuple[Noise, Tensor]:
    r"""The noise that the residuals show, where an initialiser estimated it.

    Noise above the estimate: inliers have Gaussian residuals with the variance times a factor, outliers have pixels
    anywhere in an area. The power of 4 with the largest likelihood replaces 1 where it is :math:`e^3` times as likely.
    The share of inliers is estimated for each factor, and the three pairs that any pose fits do not count.

    Noise below the estimate: the a posteriori variance factor of an adjustment, which is the weighted sum of squared
    residuals over the degrees of freedom, of the pairs deep within the kernel. It replaces 1 where its likelihood ratio
    is beyond chance.

    Args:
        projection: the points at a state.
        problem: the problem; its noise is known for every pair, its weights are at most about 1.
        kernel_weight: the robust kernel's weight, at most 1.
        shape: shape of the kernel, a scale.
        outlier_area: See :func:`outlier_area`, 0 where the caller gave the noise, (B, 1).

    Returns:
        The noise, with sigmas at least as large as estimated, and a factor of the kernel's shape, at most 1, (B, 1).
        Noise below the estimate makes only the kernel narrower.
    """
    noise, weights, area = problem.noise, problem.weights, outlier_area
    assert noise is not None
    sq_residual, precision = information(projection, problem)
    assert isinstance(precision, Tensor)
    if problem.confidence is not None:
        factor = _information_factor(sq_residual, precision, projection, problem, area)
        sq_residual, precision = sq_residual * factor, precision * factor
        noise = map_tensors(lambda sigma: sigma * factor.rsqrt(), noise)
    with torch.no_grad():
        there = weights > 0
        likelihood, _ = _log_likelihoods(sq_residual, precision, projection.in_front & there, there, area, _FACTORS)
        best = likelihood.max(0)
        believed = (area[:, 0] > 0) & (best.values > likelihood[0] + _BELIEVED)
        above = torch.where(believed, _powers_of_4(_FACTORS, sq_residual)[best.indices], 1.0)[:, None]
    sq_residual = sq_residual / above
    within = torch.where(projection.in_front, kernel_weight(sq_residual, shape), 0.0)
    deep = weights * within.square().square()
    freedom = (2.0 * deep.sum(-1, keepdim=True) - 6.0).clamp(min=1.0)
    below = ((deep * sq_residual).sum(-1, keepdim=True) / freedom).clamp(min=_LEAST_FACTOR)
    log_ratio = 0.5 * freedom * (below - 1.0 - below.log())
    lowered = (area > 0) & (below < 1.0) & (log_ratio > _BELIEVED)
    variance = above * torch.where(lowered, below, 1.0)
    larger = variance.detach().clamp(min=1.0).sqrt()
    return map_tensors(lambda sigma: larger * sigma, noise), variance.clamp(max=1.0).sqrt()


@torch.no_grad()
def larger_sigma(projection: Projection, problem: Problem, estimate: Noise, inlier_weights: Tensor) -> Tensor:
    """Standard deviation of the pixels that the inliers show, where it is much larger than estimated, else 0.

    With confidences, pairs of low confidence get larger sigmas than others.

    Args:
        projection: the points at the pose that was found.
        problem: the problem.
        estimate: the estimated noise.
        inlier_weights: final weight of each pair relative to its weight before the refinement, :math:`(B, N)`.

    Returns:
        In pixels of the problem, shape :math:`(B, N)`.
    """
    residual = projection.sq_residual.sqrt()
    expected = torch.hypot(estimate.img, (projection.focal * projection.inv_depth).mT * estimate.world)
    inlier = inlier_weights > _INLIER

    def median(values: Tensor) -> Tensor:
        return torch.where(inlier, values, torch.nan).nanmedian(1).values

    sigma = _FITTED / _MEDIAN * median(residual)
    many = inlier.sum(1) >= (_MOST * (inlier_weights > 0).sum(1)).clamp(min=_FEWEST)
    sigma = torch.where(many & (sigma > _LARGER * median(expected)), sigma, 0.0).nan_to_num(0.0, posinf=0.0)[:, None]
    if problem.confidence is None:
        return sigma.expand_as(residual)
    doubt = -problem.confidence.nan_to_num(0.5).clamp(min=_LEAST_CONFIDENCE).log()
    mean = (inlier * doubt).sum(1, keepdim=True) / inlier.sum(1, keepdim=True).clamp(min=1)
    return sigma * (_POWER * (doubt - mean)).exp()


def outlier_area(problem: Problem) -> Tensor:
    """Area in which pixels of outliers lie: a square with the variance of the usual pixels, in px², (B, 1)."""
    there = (problem.usual_weights > 0).to(problem.weights)[..., None]
    share = there / there.sum(1, keepdim=True).clamp(min=1.0)
    places = problem.places.detach()
    variance = (share * (places - (share * places).sum(1, keepdim=True)).square()).sum((1, 2))[:, None]
    return 6.0 * variance + torch.finfo(variance.dtype).tiny


def _powers_of_4(exponents: range, like: Tensor) -> Tensor:
    """Powers of 4, (F,), made on the device: a CUDA graph cannot capture a copy from the CPU."""
    return 4.0 ** torch.arange(exponents.start, exponents.stop, dtype=like.dtype, device=like.device)


def _log_likelihoods(
    sq_residual: Tensor,
    precision: Tensor,
    in_front: Tensor,
    there: Tensor,
    outlier_area: Tensor,
    exponents: range,
) -> tuple[Tensor, Tensor]:
    """Log-likelihood of the residuals at each variance factor, and the number of inliers, (F, B) each."""
    grid = _powers_of_4(exponents, sq_residual)
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
def _information_factor(
    sq_residual: Tensor, precision: Tensor, projection: Projection, problem: Problem, outlier_area: Tensor
) -> Tensor:
    r"""Factor of each pair's precision where the residuals show that noise grows as the confidence falls, (B, N).

    The keypoints of a network are often less accurate where their confidence is low, but a matcher's ratio says nothing
    of the noise. So the standard deviation is proportional to a power of the confidence, or independent of it. A power
    replaces 0 where it is :math:`e^3` times as likely by the mixture of :func:`_log_likelihoods`, and most pairs are
    inliers. Among many outliers, near misses would pass for noisy inliers.
    """
    assert problem.confidence is not None
    there = problem.weights > 0
    known = there & problem.confidence.isfinite()
    log = torch.where(known, problem.confidence.clamp(min=_LEAST_CONFIDENCE).log(), 0.0)
    log = torch.where(known, log - log.sum(-1, keepdim=True) / known.sum(-1, keepdim=True).clamp(min=1), 0.0)
    factors = torch.stack([torch.exp(-2.0 * power * log) for power in _POWERS])  # their geometric mean is 1
    seen = projection.in_front & there, there, outlier_area, _POWER_FACTORS
    found = [_log_likelihoods(sq_residual * x, precision * x, *seen) for x in factors]
    likelihoods, inliers = (torch.stack(x) for x in zip(*found, strict=True))  # (K, F, B)
    variance = likelihoods.max(1)
    best = variance.values.max(0)  # of the powers, (B,)
    inliers = inliers.gather(1, variance.indices[:, None])[:, 0].gather(0, best.indices[None])[0]
    believed = (best.values > variance.values[0] + _BELIEVED) & (inliers > _MOST * there.sum(-1))
    believed = believed & (outlier_area[:, 0] > 0)
    index = torch.where(believed, best.indices, 0)[None, :, None]
    return factors.gather(0, index.expand(1, *log.shape))[0]
