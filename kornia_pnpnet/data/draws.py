"""What the data sources share: the base class, one generator per batch, random numbers and poses, the noise model."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any, TypeAlias

import numpy as np
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_ranges, check_whole
from kornia_pnpnet.result import Pose, Problems

__all__ = [
    "Amount",
    "RandomProblems",
    "batch_generator",
    "check_amount",
    "draw_confidence",
    "draw_noise",
    "hide_sigmas",
    "log_uniform",
    "normal",
    "random_poses",
    "uniform",
    "unit",
]

#: A number, or the two ends of a range from which each problem draws a number, log-uniform.
Amount: TypeAlias = float | Sequence[float]

# Ranges of the quality of a confidence: standard deviations between inliers and outliers, influence of the noise, and
# scale and offset of the logits.
_SEPARATION, _NOISINESS, _GAIN, _OFFSET = (0.0, 4.0), (0.0, 1.0), (0.3, 3.0), 1.5
# Squared standard deviations. Keeps the quotient of the tails from 0 / 0; float64 resolves the quotient here.
_LEAST_SQ_LENGTH = 1e-12


@dataclass(kw_only=True, eq=False)
class RandomProblems:
    """Random problems, endless and reproducible. Options: see :class:`~kornia_pnpnet.data.SyntheticProblems`."""

    n: int = 9
    batch_size: int = 1000
    seed: int = 0
    dtype: torch.dtype = torch.float32
    device: str | torch.device = "cpu"

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_whole(1, n=self.n, batch_size=self.batch_size)
        check_whole(0, seed=self.seed)

    def __iter__(self) -> Iterator[Problems]:
        """Yield batch 0, 1, 2, … without end."""
        return map(self.batch, count())

    def batch(self, index: int) -> Problems:
        """Draw batch ``index``, at least 0."""
        return self._draw(index).map(lambda x: x.to(self.device, self.dtype if x.is_floating_point() else x.dtype))

    def _draw(self, index: int) -> Problems:
        raise NotImplementedError


def batch_generator(seed: int, index: int, device: str | torch.device = "cpu") -> torch.Generator:
    """A generator for batch ``index`` of the stream ``seed``, the same on every call.

    The two numbers are hashed because CPU generators only use 32 bits of their seed.
    """
    state = int(np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1, np.uint64)[0])
    return torch.Generator(device).manual_seed(state >> 1)


def unit(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """Uniform float64 numbers in [0, 1), on the generator's device."""
    return torch.rand(tuple(shape), generator=generator, device=generator.device, dtype=torch.float64)


def uniform(shape: Sequence[int], low: float, high: float, generator: torch.Generator) -> Tensor:
    """Uniform float64 numbers in ``[low, high)``, on the generator's device."""
    return unit(shape, generator).mul_(high - low).add_(low)


def normal(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """Standard normal float64 numbers, on the generator's device."""
    return torch.randn(tuple(shape), generator=generator, device=generator.device, dtype=torch.float64)


def log_uniform(shape: Sequence[int], low: float, high: float, generator: torch.Generator) -> Tensor:
    """Float64 numbers whose logarithm is uniform between the logarithms of ``low`` and ``high``."""
    return uniform(shape, math.log(low), math.log(high), generator).exp_()


def random_poses(
    batch_size: int,
    generator: torch.Generator,
    *,
    translation_box: float = 25.0,
    translation_sigma: float | None = None,
    max_angle: float = math.pi / 2,
) -> Pose:
    """Draw world-to-camera poses of the protocol, in float64, on the generator's device.

    The axis of the rotation is uniform in direction, its angle uniform from 0 to ``max_angle`` radians. The translation
    is uniform in a box of side ``translation_box`` about 0, or normal with ``translation_sigma`` on each axis.
    """
    axis = torch.nn.functional.normalize(normal((batch_size, 3), generator), dim=-1)
    angle = uniform((batch_size, 1), 0.0, max_angle, generator)
    if translation_sigma is None:
        translation = uniform((batch_size, 3), -translation_box / 2, translation_box / 2, generator)
    else:
        translation = translation_sigma * normal((batch_size, 3), generator)
    return Pose(axis_angle_to_rotation_matrix(axis * angle), translation)


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
    spread: Amount = 0.0,
    degrees: Amount = 0.0,
    axis_ratio: float = 1.0,
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
    each = shape[0], 1, 1
    sigmas = _of_problems(each, sigma, generator)
    if spread:
        sigmas = sigmas * normal((*shape[:2], 1), generator).mul_(_of_problems(each, spread, generator)).exp_()
    if degrees:
        freedom = _of_problems(each, degrees, generator)
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


def _of_problems(shape: Sequence[int], value: Amount, generator: torch.Generator) -> Tensor:
    """A float64 number for each problem."""
    if isinstance(value, Sequence):
        return log_uniform(shape, value[0], value[1], generator)
    return torch.full(tuple(shape), value, dtype=torch.float64, device=generator.device)


def hide_sigmas(
    img_sigma: Tensor, world_sigma: Tensor, known: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Replace sigmas, (B, 1) or (B, N), by NaN where a solver does not know them.

    Both sigmas are known in the share ``known`` of the problems, one of them in a third of the other problems.
    """
    chance = unit((2, len(img_sigma), 1), generator)
    unknown = chance[0] >= known
    one = unknown & (chance[0] < known + (1.0 - known) / 3.0)
    is_img = chance[1] < 0.5
    hide_img, hide_world = unknown & ~(one & is_img), unknown & ~(one & ~is_img)
    return torch.where(hide_img, torch.nan, img_sigma), torch.where(hide_world, torch.nan, world_sigma)


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
