"""What the tests of the data sources share: statistical checks, random problems and toy scenes."""

import math

import numpy as np
import pytest
import torch

from kornia_pnpnet.core.trees import iter_tensors
from kornia_pnpnet.data import Scene, SyntheticProblems, View

COUNT = 20_000
# 99.9 % points of the chi-square distribution by degrees of freedom. The seeds are fixed, so that results do not vary.
CHI_SQUARE = {1: 10.83, 2: 13.82, 3: 16.27, 6: 22.46, 8: 26.12, 19: 43.82}

WIDTH, HEIGHT, FOCAL, CENTRE = 640, 480, 500.0, np.array([320.0, 240.0])


def assert_distances(sample, distribution):
    """The Kolmogorov-Smirnov distance at the 0.1 % level."""
    sample = sample.flatten().double().sort().values
    share = torch.arange(1, len(sample) + 1, dtype=torch.float64) / len(sample)
    assert (distribution(sample) - share).abs().max() < 1.95 / math.sqrt(len(sample))


def assert_uniform(sample, low, high):
    assert sample.min() >= low
    assert sample.max() <= high
    assert_distances(sample, lambda x: (x - low) / (high - low))


def assert_normal(sample, sigma):
    assert_distances(sample, lambda x: 0.5 * (1 + torch.erf(x / (sigma * math.sqrt(2)))))


def assert_counts(counts, shares=None):
    """Chi-square at the 0.1 % level."""
    counts = counts.double()
    expected = counts.sum() * (torch.ones(len(counts)) / len(counts) if shares is None else torch.tensor(shares))
    assert ((counts - expected).square() / expected).sum() < CHI_SQUARE[len(counts) - 1]


def draw(n=9, batch=COUNT, **options):
    return SyntheticProblems(n=n, batch_size=batch, seed=7, dtype=torch.float64, **options).batch(0)


def same(one, two):
    """Whether two trees hold the same numbers, NaN included."""
    pairs = zip(iter_tensors(one), iter_tensors(two), strict=True)
    return all(a.dtype == b.dtype and torch.allclose(a, b, rtol=0, atol=0, equal_nan=True) for a, b in pairs)


def arrays(problems):
    """The arrays of a shard."""
    return {name: getattr(problems, name).numpy() for name in ("world_points", "img_points", "intrinsics")}


def table(problems, **more):
    """The table of a shard, with more columns."""
    from kornia_pnpnet.arrow import list_column

    columns = {name: list_column(np.asarray(array)) for name, array in (arrays(problems) | more).items()}
    return pytest.importorskip("pyarrow").table(columns)


def pose_of(i):
    """Quaternion (w, x, y, z), rotation matrix and translation of image i, from first principles."""
    angle = 0.1 + 0.2 * i
    axis = np.array([1.0, 2.0, -1.0]) / math.sqrt(6)
    cross = np.cross(np.eye(3), axis)
    rotation = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    quaternion = np.array([math.cos(angle / 2), *(math.sin(angle / 2) * axis)])
    return quaternion, rotation, np.array([0.3 * i, -0.2, 0.5])


def make_view(name="a.jpg", count=30, seed=0):
    """A view whose observations are exact. All its pixels differ."""
    rng = np.random.default_rng(seed)
    _, rotation, translation = pose_of(seed)
    plane = rng.uniform(-0.5, 0.5, (count, 2))
    cam = np.hstack([plane, np.ones((count, 1))]) * rng.uniform(2, 8, (count, 1))
    return View(
        name=name,
        world_points=torch.tensor((cam - translation) @ rotation),
        img_points=torch.tensor(FOCAL * plane + CENTRE),
        intrinsics=torch.tensor([[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]], dtype=torch.float64),
        rotation=torch.tensor(rotation),
        translation=torch.tensor(translation),
        width=WIDTH,
        height=HEIGHT,
        inliers=torch.ones(count, dtype=torch.bool),
    )


def make_scene(*counts):
    return Scene("toy", tuple(make_view(f"{i}.jpg", count, seed=i) for i, count in enumerate(counts)), ())


def match_arrays(*counts):
    """The arrays of a file of matches; every fifth match is off by 30 px."""
    views = [make_view(f"{i}.jpg", count, seed=i) for i, count in enumerate(counts)]
    fields = {"K": "intrinsics", "R": "rotation", "t": "translation"}
    arrays = {key: np.stack([getattr(view, name).numpy() for view in views]) for key, name in fields.items()}
    arrays |= {"names": np.array([view.name for view in views]), "size": np.array([[WIDTH, HEIGHT]] * len(views))}
    for i, view in enumerate(views):
        error = np.where(np.arange(len(view.img_points)) % 5 == 0, 30.0, 0.0)
        arrays[f"{i:03d}_img_points"] = view.img_points.numpy() + error[:, None] * [1.0, 0.0]
        arrays[f"{i:03d}_world_points"] = view.world_points.numpy()
        arrays[f"{i:03d}_error_px"] = error.astype(np.float32)
    return arrays
