"""The noise model of synthetic problems: Gaussian noise, its standard deviations, and which of them a solver knows.

To change the noise model, change :func:`draw_noise`: all noise of pixels and world points is drawn there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_ranges
from kornia_pnpnet.data.draws import log_uniform, normal, uniform

__all__ = ["checked_sigma", "draw_noise", "hide_sigmas"]


def checked_sigma(name: str, value: Any) -> float | tuple[float, float]:
    """Check one standard deviation, or the smallest and the largest of a range.

    Raises:
        BaseError: for a number that is negative or not finite, or a range that is not of two positive, rising numbers.
    """
    if hasattr(value, "__len__"):
        check_ranges(**{name: value})
        return float(value[0]), float(value[1])
    check_numbers(0.0, **{name: value})
    return float(value)


def draw_noise(
    shape: Sequence[int], sigma: float | Sequence[float], generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Draw Gaussian noise.

    Args:
        shape: :math:`(B, N, ...)`.
        sigma: standard deviation, or the ends of a range from which each problem draws one, log-uniform.
        generator: source of randomness.

    Returns:
        The noise, and the standard deviation of each problem, :math:`(B,)`.
    """
    noise = normal(shape, generator)
    if isinstance(sigma, float):
        return noise.mul_(sigma), noise.new_full((shape[0],), sigma)
    low, high = sigma
    sigmas = log_uniform((shape[0], *(1,) * (len(shape) - 1)), low, high, generator)
    return noise.mul_(sigmas), sigmas.flatten()


def hide_sigmas(
    img_sigma: Tensor, world_sigma: Tensor, known: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Replace standard deviations that a solver does not know by NaN.

    Args:
        img_sigma: standard deviation of the pixels of each problem, :math:`(B,)`.
        world_sigma: standard deviation of the points of each problem, :math:`(B,)`.
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
    return torch.where(hide_img, torch.nan, img_sigma), torch.where(hide_world, torch.nan, world_sigma)
