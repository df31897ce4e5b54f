"""Noise of the pairs: the precision of each pixel, and estimation of the noise from residuals."""

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
    "NARROWER",
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

# Logarithm of a likelihood ratio. An estimated variance factor is used only if the residuals are more than e³ times as
# likely with this factor as with the factor 1.
_BELIEVED = 3.0
# Exponents of 4. These powers of 4 are the candidate variance factors for noise above the estimate.
_FACTORS = range(8)
# Candidate exponents p: the standard deviation of the noise is proportional to confidence**p.
_POWERS = (0.0, -1.0, -2.0, -3.0)
# Exponents of 4. The likelihoods of `_POWERS` are computed at these powers of 4 as variance factors.
_POWER_FACTORS = range(-5, 8)
# Lower confidences are raised to this value, so that their pairs keep some weight.
_LEAST_CONFIDENCE = 0.05
# Share of inliers among the pairs. With a smaller share, `_information_factor` is 1 and `larger_sigma` is 0.
_MOST = 0.5
# Expectation-maximisation estimates the ratio of inliers to pairs. Number of its rounds, and least ratio.
_ROUNDS, _LEAST_SHARE = 2, 0.02
#: Factor of a variance factor below 1 in the iterations. A kernel of a third of the width separates inliers from near
#: misses better: without it success falls by 0.5 to 0.7 points on the scene `lund_door`. Tuned on synthetic problems.
NARROWER = 0.1
# Lower bound of a variance factor. Exact data would give the factor 0.
_LEAST_FACTOR = 1e-4
# Ratio of the standard deviation of the residuals to the estimated standard deviation. Below this ratio,
# `corrected_noise` corrects the estimate. Above this ratio, the iterations by residual start too far from the minimum,
# and `larger_sigma` returns the noise for a second solution.
_LARGER = 4.0
# A pair is an inlier if its final weight is at least this fraction of its initial weight.
_INLIER = 0.25
# Inliers. With fewer inliers `larger_sigma` is 0. A pose fits few inliers closely, so that their residuals say little
# about the noise. With 6 to 9 pairs, a second solution with the noise of `larger_sigma` succeeds as often as the first
# solution (seeds 3117 and 3120 of SyntheticProblems).
_FEWEST = 7
# Typical ratio of the residuals at the true pose to the residuals at the fitted pose.
_FITTED = 1.1
# `larger_sigma` makes sigmas proportional to confidence**-_POWER. An exponent of about 1 fits the noise of keypoints
# that a network detected. A larger exponent gives better poses when pairs of low confidence are outliers.
_POWER = 1.5
# Median length of a Gaussian residual with unit variance in each coordinate.
_MEDIAN = math.sqrt(2.0 * math.log(2.0))

#: Robust weight from squared residual and shape of the kernel, see :class:`~kornia_pnpnet.refine.kernels.RobustKernel`.
KernelWeight: TypeAlias = Callable[[Tensor, Tensor], Tensor]


def complete_noise(problem: Problem, starts: Starts) -> Noise | None:
    """Combine the noise from the caller and the noise from the initialiser, so that the noise of every pair is known.

    The result is ``None`` if neither gave noise. The sigmas are from the initialiser. If the initialiser gave no noise,
    the sigmas are from the caller, and unknown sigmas become 0. The covariances are from the caller.
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
    """Find problems for which the caller gave no sigma of any pixel or world point, bool (B, 1)."""
    known = torch.zeros_like(problem.weights[:, :1], dtype=torch.bool)
    for sigma in () if problem.noise is None else problem.noise.sigmas[:2]:
        known = known | sigma.isfinite().any(1, keepdim=True)
    return ~known


def pixel_precision(projection: Projection, problem: Problem, noise: Noise) -> Tensor | Symmetric2:
    """Inverse variance of each pixel, (B, N), or inverse covariance if the noise has covariances."""
    if not noise.covariances:
        return pixel_variance(projection, noise).reciprocal()
    return pixel_covariance(projection, problem, noise).inverse()


def sq_standardised(projection: Projection, problem: Problem, most: Tensor) -> Tensor:
    """Compute squared residuals with an upper bound, in variances of their pixel or, without noise, in square pixels.

    Args:
        projection: the points of the problem projected at a state.
        problem: the problem. Its noise is known for every pair or for none.
        most: upper bound of a squared residual in square pixels, a scalar or (B, 1). Points behind the camera have this
            residual. With covariances the bound is multiplied by the mean precision of both coordinates.

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
    """Compute squared residuals in the unit of the robust kernel, and the information of the pixels.

    Args:
        projection: the points of the problem projected at a state.
        problem: the problem, with known noise of every pair or without noise.

    Returns:
        First, squared residuals (B, N), in variances of their pixel or, without noise, in square pixels. Second, the
        inverse variance of each pixel, (B, N) or, without noise, (B, 1). Covariances give inverse covariances instead.
    """
    if problem.noise is None:  # without noise, sigma is one pixel of the caller
        return projection.sq_residual, problem.img_scale.square().reciprocal()[:, None]
    precision = pixel_precision(projection, problem, problem.noise)
    if isinstance(precision, Tensor):
        return projection.sq_residual * precision, precision
    return precision.form(*projection.residual.mT.unbind()), precision


def corrected_noise(
    projection: Projection,
    problem: Problem,
    kernel_weight: KernelWeight,
    shape: Tensor,
    outlier_area: Tensor,
    narrower: float = 1.0,
) -> tuple[Noise, Tensor]:
    """Correct the initialiser's estimate of the noise by the residuals.

    *Noise above the estimate.* The residuals of inliers are Gaussian with the estimated variance times a factor. The
    pixels of outliers are uniformly distributed in ``outlier_area``. The candidate factors are powers of 4. The share
    of inliers is estimated for each factor. The most likely factor is used if its likelihood is more than :math:`e^3`
    times the likelihood of the factor 1. The likelihood omits three inliers, because a pose can fit any three pairs.

    *Noise below the estimate.* The factor is the weighted sum of squared residuals divided by the degrees of freedom
    (the a posteriori variance factor). Only pairs with small residuals have large weights in the sum. The factor is
    used if it is below 1 and its likelihood is more than :math:`e^3` times the likelihood of the factor 1.

    If the residuals depend on the confidence, the noise is first adapted to the confidence.

    Args:
        projection: the points of the problem projected at a state.
        problem: the problem, with known noise of every pair. The mean of its positive weights is 1.
        kernel_weight: the robust weight, at most 1.
        shape: shape of the kernel, a scale.
        outlier_area: the result of :func:`outlier_area`, or 0 for a problem whose noise the caller gave, (B, 1).
        narrower: multiplies a variance factor below 1.

    Returns:
        First, the corrected noise. Second, a factor of at most 1 for the kernel's shape, (B, 1). If the noise is below
        the estimate, the kernel becomes narrower, but the sigmas do not decrease.
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
    variance = above * torch.where(lowered, narrower * below, 1.0)
    larger = variance.detach().clamp(min=1.0).sqrt()
    return map_tensors(lambda sigma: larger * sigma, noise), variance.clamp(max=1.0).sqrt()


@torch.no_grad()
def larger_sigma(projection: Projection, problem: Problem, estimate: Noise, inlier_weights: Tensor) -> Tensor:
    """Estimate the standard deviation of the pixels from the residuals of the inliers.

    The result is 0 unless the residuals show much larger noise than ``estimate``. With confidences, pairs of low
    confidence get larger sigmas than pairs of high confidence.

    Args:
        projection: the points of the problem projected at the final pose.
        problem: the problem.
        estimate: the noise that was estimated before the refinement.
        inlier_weights: final weight of each pair relative to its weight before the refinement, :math:`(B, N)`.

    Returns:
        Standard deviations in pixels of the problem, shape :math:`(B, N)`.
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
    """Area of the square in which pixels of outliers are assumed to be uniformly distributed, in px², (B, 1).

    The square has the size that gives the variance of the pixels of usual pairs (see ``Problem.usual``).
    """
    there = (problem.usual_weights > 0).to(problem.weights)[..., None]
    share = there / there.sum(1, keepdim=True).clamp(min=1.0)
    places = problem.places.detach()
    variance = (share * (places - (share * places).sum(1, keepdim=True)).square()).sum((1, 2))[:, None]
    return 6.0 * variance + torch.finfo(variance.dtype).tiny


def _powers_of_4(exponents: range, like: Tensor) -> Tensor:
    """Powers of 4, (F,), computed on the device: a CUDA graph cannot capture a copy from the CPU."""
    return 4.0 ** torch.arange(exponents.start, exponents.stop, dtype=like.dtype, device=like.device)


def _log_likelihoods(
    sq_residual: Tensor,
    precision: Tensor,
    in_front: Tensor,
    there: Tensor,
    outlier_area: Tensor,
    exponents: range,
) -> tuple[Tensor, Tensor]:
    """Log-likelihood (F, B) of the residuals at each variance factor, and the estimated number (F, B) of inliers."""
    grid = _powers_of_4(exponents, sq_residual)
    # Densities of a pixel, divided by the density of an inlier with residual 0 and variance factor 1.
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
    """Factor of each pair's precision, (B, N), if the residuals show that the noise depends on the confidence, else 1.

    Keypoints of a network are often less accurate at low confidence, but the confidence of a matcher says nothing about
    the noise. The standard deviation is therefore either constant or proportional to a power of the confidence. A power
    is used if its likelihood (see :func:`_log_likelihoods`) is more than :math:`e^3` times the likelihood of constant
    noise, and if most pairs are inliers. With more outliers, some outliers could pass for noisy inliers.
    """
    assert problem.confidence is not None
    there = problem.weights > 0
    known = there & problem.confidence.isfinite()
    log = torch.where(known, problem.confidence.clamp(min=_LEAST_CONFIDENCE).log(), 0.0)
    log = torch.where(known, log - log.sum(-1, keepdim=True) / known.sum(-1, keepdim=True).clamp(min=1), 0.0)
    factors = torch.stack([torch.exp(-2.0 * power * log) for power in _POWERS])  # the geometric mean over pairs is 1
    seen = projection.in_front & there, there, outlier_area, _POWER_FACTORS
    found = [_log_likelihoods(sq_residual * x, precision * x, *seen) for x in factors]
    likelihoods, inliers = (torch.stack(x) for x in zip(*found, strict=True))  # (K, F, B)
    variance = likelihoods.max(1)
    best = variance.values.max(0)  # over the powers, (B,)
    inliers = inliers.gather(1, variance.indices[:, None])[:, 0].gather(0, best.indices[None])[0]
    believed = (best.values > variance.values[0] + _BELIEVED) & (inliers > _MOST * there.sum(-1))
    believed = believed & (outlier_area[:, 0] > 0)
    index = torch.where(believed, best.indices, 0)[None, :, None]
    return factors.gather(0, index.expand(1, *log.shape))[0]
