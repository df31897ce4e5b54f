"""Helpers that the tests share: problems, correspondences and poses, all seeded, all in float64 unless asked."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from kornia_pnpnet import Pose, Problems
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.refine.residual import retract

# Scripts that are no part of the package and import each other.
SCRIPTS = "benchmarks", "docs/results", "docs/examples"
sys.path += [str(Path(__file__).resolve().parents[1] / folder) for folder in SCRIPTS]
# On some processors MKL rounds a product of matrices differently if one of them has more columns.
os.environ.setdefault("MKL_CBWR", "COMPATIBLE")
# The tensors are small: threads only get into each other's way, above all under pytest-xdist.
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _seed() -> None:
    """Networks draw their weights from the global generator: the same weights in any order of tests."""
    torch.manual_seed(0)


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def make_problems() -> Callable[..., Problems]:
    def make(n: int = 9, batch: int = 7, *, outliers: int = 0, noise: bool = True, **options: Any) -> Problems:
        options = {"img_sigma": 1.0 * noise, "world_sigma": 0.05 * noise, "dtype": torch.float64, **options}
        return SyntheticProblems(n=n, batch_size=batch, outliers=OutlierMix(count=outliers), **options).batch(0)

    return make


@pytest.fixture
def random_rotations() -> Callable[..., Tensor]:
    """Rotations about random axes, by random angles or by given ones."""

    def make(batch: int, *, angle: float | Tensor | None = None, seed: int = 0) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        axis = torch.randn(batch, 3, generator=generator, dtype=torch.float64)
        axis = axis / axis.norm(dim=-1, keepdim=True)
        if angle is None:
            angle = 3.0 * torch.rand(batch, 1, generator=generator, dtype=torch.float64)
        return axis_angle_to_rotation_matrix(axis * angle)

    return make


@pytest.fixture
def perturb() -> Callable[..., Pose]:
    """A pose turned by ``angle`` radians about a random axis and shifted by ``shift`` in a random direction."""

    def make(pose: Pose, *, angle: float = 0.05, shift: float = 0.05, seed: int = 1) -> Pose:
        generator = torch.Generator().manual_seed(seed)
        delta = torch.randn(pose.translation.shape[0], 2, 3, generator=generator, dtype=torch.float64)
        delta = delta / delta.norm(dim=-1, keepdim=True) * torch.tensor([angle, shift], dtype=torch.float64)[:, None]
        return retract(pose, delta.flatten(1).to(pose.translation))

    return make


@pytest.fixture
def drawn(monkeypatch):
    """Figures by file name, laid out as they would have been saved."""
    figure = pytest.importorskip("matplotlib.figure")
    found = {}

    def keep(self, path, **_):
        self.draw_without_rendering()
        found[Path(path).name] = self

    monkeypatch.setattr(figure.Figure, "savefig", keep)
    return found
