"""Random numbers of the data sources: one generator per batch, and the distributions that several sources share."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from kornia_pnpnet.result import Pose

__all__ = ["batch_generator", "log_uniform", "normal", "random_poses", "uniform"]


def batch_generator(seed: int, index: int, device: str | torch.device = "cpu") -> torch.Generator:
    """A generator for batch ``index`` of the stream ``seed``, the same on every call.

    The two numbers are hashed because CPU generators only use 32 bits of their seed.
    """
    state = int(np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1, np.uint64)[0])
    return torch.Generator(device).manual_seed(state >> 1)


def uniform(shape: Sequence[int], low: float, high: float, generator: torch.Generator) -> Tensor:
    """Uniform float64 numbers in ``[low, high)``, on the generator's device."""
    values = torch.rand(tuple(shape), generator=generator, device=generator.device, dtype=torch.float64)
    return values.mul_(high - low).add_(low)


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
