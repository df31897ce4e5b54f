"""Random numbers and poses in float64, and the base class of random sources."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor
from torch.nn.functional import normalize

from kornia_pnpnet.core.checks import check_whole
from kornia_pnpnet.result import Pose, Problems

__all__ = ["RandomProblems", "batch_generator", "log_uniform", "normal", "random_poses", "uniform", "unit"]


@dataclass(kw_only=True, eq=False)
class RandomProblems:
    """Base class of random sources. For the fields see :class:`~kornia_pnpnet.data.SyntheticProblems`."""

    n: int = 9
    batch_size: int = 1000
    seed: int = 0
    dtype: torch.dtype = torch.float32
    device: str | torch.device = "cpu"

    def __post_init__(self) -> None:
        check_whole(1, n=self.n, batch_size=self.batch_size)
        check_whole(0, seed=self.seed)

    def __iter__(self) -> Iterator[Problems]:
        """Yield batch 0, 1, 2, … without end."""
        return map(self.batch, count())

    def batch(self, index: int) -> Problems:
        """Draw a batch; the first index is 0."""
        with torch.device("cpu"):  # the generator is on the CPU, even if PyTorch's default device is a GPU
            problems = self._draw(batch_generator(self.seed, index))
        return problems.map(lambda x: x.to(self.device, self.dtype if x.is_floating_point() else x.dtype))

    def _draw(self, generator: torch.Generator) -> Problems:
        raise NotImplementedError


def batch_generator(seed: int, index: int) -> torch.Generator:
    """Make the random generator of a batch; equal arguments give equal random numbers."""
    # Seed and index are hashed into one number, because CPU generators use only 32 bits of their seed.
    state = int(np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1, np.uint64)[0])
    return torch.Generator().manual_seed(state >> 1)


def unit(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """Uniform numbers in [0, 1)."""
    return torch.rand(tuple(shape), generator=generator, dtype=torch.float64)


def uniform(shape: Sequence[int], low: float, high: float, generator: torch.Generator) -> Tensor:
    """Uniform numbers in ``[low, high)``."""
    return unit(shape, generator).mul_(high - low).add_(low)


def normal(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """Standard normal numbers."""
    return torch.randn(tuple(shape), generator=generator, dtype=torch.float64)


def log_uniform(shape: Sequence[int], low: float, high: float, generator: torch.Generator) -> Tensor:
    """Log-uniform numbers in ``[low, high)``."""
    return uniform(shape, math.log(low), math.log(high), generator).exp_()


def random_poses(
    batch_size: int,
    generator: torch.Generator,
    *,
    translation_box: float = 25.0,
    translation_sigma: float | None = None,
    max_angle: float = math.pi / 2,
) -> Pose:
    """Draw world-to-camera poses. The defaults give the distribution of the paper's protocol.

    The axis of the rotation has a uniform direction, and the angle is uniform from 0 to ``max_angle`` radians. If
    ``translation_sigma`` is ``None``, the translation is uniform in a cube of side ``translation_box`` about 0.
    Otherwise, each coordinate of the translation is normal with the standard deviation ``translation_sigma``.
    """
    axis = normalize(normal((batch_size, 3), generator), dim=-1)
    angle = uniform((batch_size, 1), 0.0, max_angle, generator)
    if translation_sigma is None:
        translation = uniform((batch_size, 3), -translation_box / 2, translation_box / 2, generator)
    else:
        translation = translation_sigma * normal((batch_size, 3), generator)
    return Pose(axis_angle_to_rotation_matrix(axis * angle), translation)
