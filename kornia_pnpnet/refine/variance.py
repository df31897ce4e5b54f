r"""How much larger or smaller the noise is than its estimate, by the residuals at a pose."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import torch
from torch import Tensor

from kornia_pnpnet.geometry import Projection
from kornia_pnpnet.types import MIN_PAIRS, Correspondences

__all__ = ["NARROWER", "KernelWeight", "outlier_area", "variance_factor", "worth_of_confidence"]

# Logarithm of a likelihood ratio. The residuals' own variance factor replaces 1 where it is e³ times as likely.
_BELIEVED = 3.0
# Exponents of 4: variance factors that are compared before. Noise above the estimate needs them: a kernel that is too
# narrow hides it.
_FACTORS = range(8)
# Powers of the confidence that the standard deviation of the noise may be proportional to, and the variance factors at
# which they are compared: noise of the geometric mean's confidence may be below the estimate.
_POWERS = (0.0, -1.0, -2.0, -3.0)
_POWER_FACTORS = range(-5, 8)
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


def outlier_area(corr: Correspondences) -> Tensor:
    """Area of a square with the variance of the pixels that are near: where pixels of outliers lie, (B, 1)."""
    there = (corr.near_weights > 0).to(corr.weights)
    share = there / there.sum(-1, keepdim=True).clamp(min=1.0)
    variance = torch.zeros_like(share[:, :1])
    for pixels in corr.places.detach().unbind(-1):
        mean = (share * pixels).sum(-1, keepdim=True)
        variance = variance + (share * (pixels - mean).square()).sum(-1, keepdim=True)
    return 6.0 * variance + torch.finfo(variance.dtype).tiny


@torch.no_grad()
def _factor_above(
    sq_residual: Tensor, precision: Tensor, in_front: Tensor, there: Tensor, outlier_area: Tensor
) -> Tensor:
    """Variance factor of the largest likelihood among those from 1 on, (B, 1), see :func:`variance_factor`."""
    likelihood, _ = _log_likelihoods(sq_residual, precision, in_front, there, outlier_area, _FACTORS)
    best = likelihood.max(0)
    believed = (outlier_area[:, 0] > 0) & (best.values > likelihood[0] + _BELIEVED)
    return torch.where(believed, _powers_of_4(_FACTORS, sq_residual)[best.indices], 1.0)[:, None]


def _powers_of_4(exponents: range, like: Tensor) -> Tensor:
    """Powers (F,), made on the device: a copy from the CPU cannot be captured in a CUDA graph."""
    return 4.0 ** torch.arange(exponents.start, exponents.stop, dtype=like.dtype, device=like.device)


def _log_likelihoods(
    sq_residual: Tensor,
    precision: Tensor,
    in_front: Tensor,
    there: Tensor,
    outlier_area: Tensor,
    exponents: range,
) -> tuple[Tensor, Tensor]:
    """Log-likelihood of the residuals at each variance factor and the number of inliers, (F, B) each."""
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
def worth_of_confidence(
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
