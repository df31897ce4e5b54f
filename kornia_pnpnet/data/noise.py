"""The noise model of synthetic problems: noise, its standard deviations, and which of them a solver knows.

To change the noise model, change :func:`draw_noise`: all noise of pixels and world points is drawn there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_ranges
from kornia_pnpnet.data.draws import log_uniform, normal, uniform

__all__ = [
    "LEAST_DEGREES",
    "MOST_NOISE",
    "MOST_RATIO",
    "MOST_SPREAD",
    "checked_sigma",
    "draw_confidence",
    "draw_noise",
    "hide_sigmas",
    "stretched",
]

#: Smallest degrees of freedom of the tails: noise stays finite in float32.
LEAST_DEGREES = 1.0
#: Largest standard deviation of the logarithm of the pairs' sigmas: noise stays finite in float32.
MOST_SPREAD = 3.0
#: Largest ratio of the axes of noise: its covariance keeps digits of the shortest axis in float32.
MOST_RATIO = 100.0
#: Standard deviations. A choice: a pair whose pixel has more noise is called an outlier.
MOST_NOISE = 10.0

# Ranges of what a confidence is worth: by how many standard deviations it tells inliers from outliers, how much it says
# of the noise, and how its scale and its centre differ between problems.
_TELLING, _NOISINESS, _GAIN, _OFFSET = (0.0, 4.0), (0.0, 1.0), (0.3, 3.0), 1.5
# Squared standard deviations. Keeps the quotient of the tails from 0 / 0; float64 resolves the quotient here.
_LEAST_SQ_LENGTH = 1e-12


def checked_sigma(name: str, value: Any, low: float = 0.0, high: float = math.inf) -> float | tuple[float, float]:
    """Check one standard deviation or other number of the noise, or the smallest and the largest of a range.

    Args:
        name: name of the argument in error messages.
        value: the number or range.
        low: smallest sound number; 0, which turns an option off, is sound as well.
        high: largest sound number.

    Raises:
        BaseError: for a number that is negative, not finite or out of bounds, or a range that is not of two positive,
            rising numbers.
    """
    if hasattr(value, "__len__"):
        check_ranges(**{name: value})
        check_numbers(low, high, **{name: value[0]})
        check_numbers(low, high, **{name: value[1]})
        return float(value[0]), float(value[1])
    check_numbers(0.0 if value == 0 else low, high, **{name: value})
    return float(value)


def draw_noise(
    shape: Sequence[int],
    sigma: float | tuple[float, float],
    generator: torch.Generator,
    *,
    spread: float | tuple[float, float] = 0.0,
    degrees: float | tuple[float, float] = 0.0,
) -> tuple[Tensor, Tensor]:
    r"""Draw Gaussian noise, or noise with heavy tails.

    The length :math:`r` of normal noise on a pair, in standard deviations, becomes
    :math:`\sqrt{\nu(\exp(r^2/\nu) - 1)}`: noise of two coordinates then has the bivariate Student distribution with
    :math:`\nu` degrees of freedom. Short noise stays what it was, so that the standard deviation remains that of the
    bulk; the tails are as :math:`r^{-\nu}`.

    Args:
        shape: :math:`(B, N, ...)`.
        sigma: standard deviation, or the ends of a range from which each problem draws one, log-uniform.
        generator: source of randomness.
        spread: standard deviation of the logarithm of each pair's standard deviation about that of its problem, or a
            range as for ``sigma``; 0: all pairs of a problem have the same.
        degrees: degrees of freedom :math:`\nu` of the tails, or a range as for ``sigma``; 0: Gaussian noise.

    Returns:
        The noise, and the standard deviation of each problem, :math:`(B,)`, or with a spread of each pair,
        :math:`(B, N)`.
    """
    noise = normal(shape, generator)
    each = (shape[0], *(1,) * (len(shape) - 1))
    sigmas = _of_problems(each, sigma, generator)
    if spread:
        factor = normal((*shape[:2], *each[2:]), generator).mul_(_of_problems(each, spread, generator)).exp_()
        sigmas = sigmas * factor
    if degrees:
        freedom = _of_problems(each, degrees, generator)
        sq_length = noise.square().sum(-1, keepdim=True).clamp(min=_LEAST_SQ_LENGTH)
        noise *= (freedom * (sq_length / freedom).expm1() / sq_length).sqrt()
    return noise.mul_(sigmas), sigmas.flatten(0 if not spread else 1)


def stretched(noise: Tensor, ratio: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Stretch isotropic noise along random axes, others for each pair.

    Args:
        noise: shape :math:`(B, N, D)`.
        ratio: largest over smallest standard deviation. The standard deviations of the axes are a geometric series.
        generator: source of randomness.

    Returns:
        The noise, of the same mean variance, and its covariance in units of that variance, :math:`(B, N, D, D)`.
    """
    size = noise.shape[-1]
    axes = ratio ** torch.linspace(0.0, 1.0, size, dtype=noise.dtype, device=noise.device)
    axes = axes / axes.square().mean().sqrt()
    turn = torch.linalg.qr(normal((*noise.shape, size), generator)).Q
    factor = (turn * axes) @ turn.mT
    return (factor @ noise[..., None])[..., 0], factor @ factor


def _of_problems(shape: Sequence[int], value: float | tuple[float, float], generator: torch.Generator) -> Tensor:
    """A number for each problem: a given one, or one drawn log-uniform from a range."""
    if isinstance(value, float):
        return torch.full(tuple(shape), value, dtype=torch.float64, device=generator.device)
    return log_uniform(shape, *value, generator)


def hide_sigmas(
    img_sigma: Tensor, world_sigma: Tensor, known: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Replace standard deviations that a solver does not know by NaN.

    Args:
        img_sigma: standard deviation of the pixels of each problem, :math:`(B,)`, or of each pair, :math:`(B, N)`.
        world_sigma: standard deviation of the points, in the same shape.
        known: share of problems whose standard deviations are both known. In a third of the others one is known.
        generator: source of randomness.

    Returns:
        Both, with NaN where unknown.
    """
    chance = uniform((2, len(img_sigma)), 0.0, 1.0, generator)
    unknown = chance[0] >= known
    one = unknown & (chance[0] < known + (1.0 - known) / 3.0)
    is_img = chance[1] < 0.5
    hide_img, hide_world = unknown & ~(one & is_img), unknown & ~(one & ~is_img)
    if img_sigma.ndim > 1:
        hide_img, hide_world = hide_img[:, None], hide_world[:, None]
    return torch.where(hide_img, torch.nan, img_sigma), torch.where(hide_world, torch.nan, world_sigma)


def draw_confidence(inliers: Tensor, errors: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Draw the belief of a caller in each pair, as from a matcher or a keypoint network.

    What a confidence is worth differs between problems: from nothing to four standard deviations between inliers and
    outliers, of any scale and centre. Those of noisy inliers are lower.

    Args:
        inliers: bool, shape :math:`(B, N)`.
        errors: length of the noise of each pixel, in the problem's standard deviations, shape :math:`(B, N)`.
        share: share of the problems that have confidences.
        generator: source of randomness.

    Returns:
        In (0, 1), NaN for the other problems, shape :math:`(B, N)`.
    """
    each = len(inliers), 1
    telling, noisiness = (uniform(each, *bounds, generator) for bounds in (_TELLING, _NOISINESS))
    score = normal(inliers.shape, generator) + torch.where(inliers, telling - noisiness * errors.log1p(), 0.0)
    logit = log_uniform(each, *_GAIN, generator) * score + _OFFSET * normal(each, generator)
    return torch.where(uniform(each, 0.0, 1.0, generator) < share, torch.sigmoid(logit), torch.nan)
