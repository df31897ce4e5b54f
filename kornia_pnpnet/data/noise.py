"""The noise of synthetic problems, and what a solver knows of it: sigmas, covariances and confidences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeAlias

import torch
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_ranges
from kornia_pnpnet.data.draws import log_uniform, normal, uniform, unit

__all__ = ["Amount", "check_amount", "draw_confidence", "draw_noise", "hide_sigmas"]

#: A number, or the two ends of a range from which each problem draws a number, log-uniform.
Amount: TypeAlias = float | Sequence[float]

# Ranges of the quality of a confidence: standard deviations between inliers and outliers, influence of the noise, and
# scale of the logits; standard deviation of the offset of the logits.
_SEPARATION, _NOISINESS, _GAIN, _OFFSET = (0.0, 4.0), (0.0, 1.0), (0.3, 3.0), 1.5
# Squared standard deviations. Keeps the quotient of the tails from 0 / 0; float64 resolves the quotient here.
_LEAST_SQ_LENGTH = 1e-12


def check_amount(name: str, value: Any, low: float = 0.0, high: float = math.inf) -> Amount:
    """Check a number, or both ends of a range, against ``[low, high]``, and convert it; a number may also be 0.

    Raises:
        BaseError: for a number that is out of bounds, or a range that is not of two positive, rising numbers.
    """
    if not hasattr(value, "__len__"):
        check_numbers(0.0 if value == 0 else low, high, **{name: value})
        return float(value)
    check_ranges(**{name: value})
    for end in value:
        check_numbers(low, high, **{name: end})
    return float(value[0]), float(value[1])


def draw_noise(
    shape: Sequence[int],
    sigma: Amount,
    generator: torch.Generator,
    *,
    spread: Amount,
    degrees: Amount = 0.0,
    axis_ratio: float,
) -> tuple[Tensor, Tensor, Tensor | None]:
    r"""Draw noise of the shape :math:`(B, N, D)`. See :class:`~kornia_pnpnet.data.SyntheticProblems` for the options.

    With ``degrees`` the length :math:`r` of normal noise on a pair, in standard deviations, becomes
    :math:`\sqrt{\nu(\exp(r^2/\nu) - 1)}`: noise of two coordinates then has the bivariate Student distribution with
    :math:`\nu` degrees of freedom, and short noise hardly changes.

    Returns:
        The noise; its standard deviations, :math:`(B, 1)` or with a spread :math:`(B, N)`; with an axis ratio above 1
        its covariances, :math:`(B, N, D, D)`.
    """
    noise = normal(shape, generator)
    sigmas = _amounts(shape[0], sigma, generator)
    if spread:
        sigmas = sigmas * normal((*shape[:2], 1), generator).mul_(_amounts(shape[0], spread, generator)).exp_()
    if degrees:
        freedom = _amounts(shape[0], degrees, generator)
        sq_length = noise.square().sum(-1, keepdim=True).clamp(min=_LEAST_SQ_LENGTH)
        noise *= (freedom * (sq_length / freedom).expm1() / sq_length).sqrt()
    noise.mul_(sigmas)
    if axis_ratio == 1.0:
        return noise, sigmas[..., 0], None
    axes = axis_ratio ** torch.linspace(0.0, 1.0, shape[-1], dtype=noise.dtype, device=noise.device)
    axes = axes / axes.square().mean().sqrt()
    turn = torch.linalg.qr(normal((*shape, shape[-1]), generator)).Q  # (B, N, D, D)
    factor = (turn * axes) @ turn.mT
    return (factor @ noise[..., None])[..., 0], sigmas[..., 0], factor @ factor * sigmas[..., None].square()


def _amounts(batch_size: int, value: Amount, generator: torch.Generator) -> Tensor:
    """A number for each problem, (B, 1, 1)."""
    each = batch_size, 1, 1
    if isinstance(value, Sequence):
        return log_uniform(each, *value, generator)
    return torch.full(each, value, dtype=torch.float64, device=generator.device)


def hide_sigmas(
    img_sigma: Tensor, world_sigma: Tensor, known: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Replace sigmas, (B, 1) or (B, N), by NaN where a solver does not know them. See ``known_noise``."""
    chance, is_img = unit((2, len(img_sigma), 1), generator)
    one, is_img = chance < known + (1.0 - known) / 3.0, is_img < 0.5
    has_img, has_world = ((chance < known) | (one & mine) for mine in (is_img, ~is_img))
    return torch.where(has_img, img_sigma, torch.nan), torch.where(has_world, world_sigma, torch.nan)


def draw_confidence(inliers: Tensor, errors: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Draw the confidence of a matcher or a keypoint network in each pair, in (0, 1), shape (B, N).

    The quality of confidences differs between problems: inliers and outliers lie from zero to four standard deviations
    apart, with any scale and offset of the logits. Noisy inliers have lower confidences.

    Args:
        inliers: bool, shape (B, N).
        errors: length of the noise of each pixel, in the problem's standard deviations, shape (B, N).
        share: share of the problems that have confidences; the other problems have NaN.
        generator: source of randomness.
    """
    each = len(inliers), 1
    separation, noisiness = (uniform(each, *bounds, generator) for bounds in (_SEPARATION, _NOISINESS))
    score = normal(inliers.shape, generator) + torch.where(inliers, separation - noisiness * errors.log1p(), 0.0)
    logit = log_uniform(each, *_GAIN, generator) * score + _OFFSET * normal(each, generator)
    return torch.where(unit(each, generator) < share, torch.sigmoid(logit), torch.nan)
