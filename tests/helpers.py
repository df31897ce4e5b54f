"""Helpers that several tests share: comparisons, derivatives, statistics, toy scenes, and what fuzz tests draw."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from kornia.core.exceptions import BaseError
from torch import Tensor
from torch.utils import _pytree as pytree

from kornia_pnpnet import Pose, Problems, pose_errors, success
from kornia_pnpnet.cli import main
from kornia_pnpnet.data import Scene, View
from kornia_pnpnet.problem import State
from kornia_pnpnet.refine.kernels import KERNELS
from kornia_pnpnet.refine.lm import BACKWARDS
from kornia_pnpnet.refine.residual import moved

# 99.9 % points of the chi-square distribution by degrees of freedom. The seeds are fixed, so that results do not vary.
CHI_SQUARE = {1: 10.83, 2: 13.82, 3: 16.27, 6: 22.46, 8: 26.12, 19: 43.82}
WIDTH, HEIGHT, FOCAL, CENTRE = 640, 480, 500.0, np.array([320.0, 240.0])
ERRORS = BaseError, ValueError
NAN, INF = float("nan"), float("inf")


def assert_same(one: Any, two: Any, rtol: float = 0.0, atol: float = 0.0, **more: Any) -> None:
    """The same tensors in two trees, to the bit unless a tolerance is given."""
    for a, b in zip(pytree.tree_leaves(one), pytree.tree_leaves(two), strict=True):
        torch.testing.assert_close(a, b, rtol=rtol, atol=atol, **more)


@contextlib.contextmanager
def other_defaults(dtype: torch.dtype, device: str = "meta") -> Iterator[None]:
    """Give PyTorch a default dtype and a default device. Tensors of ``meta`` hold no numbers."""
    torch.set_default_dtype(dtype)
    try:
        with torch.device(device):
            yield
    finally:
        torch.set_default_dtype(torch.float32)


def rate(result: Any, problems: Problems, **limits: float) -> float:
    """The share of problems whose pose is right."""
    return success(pose_errors(result.pose, problems.pose), **limits).double().mean().item()


def reprojection_errors(problems: Problems, pose: Pose | None = None) -> Tensor:
    """Pixels of the points under poses, or under the true ones, minus those of the problems, (B, N, 2)."""
    pose = problems.pose if pose is None else pose
    seen = (problems.pair_intrinsics @ problems._replace(pose=pose).true_cam_points[..., None])[..., 0]
    return seen[..., :2] / seen[..., 2:] - problems.img_points


def derivative(function: Callable[[State], Tensor], state: State) -> Tensor:
    """The derivative (B, M, 6 + K) of a function (B, M) of states along ``moved``, by automatic differentiation."""
    zero = state.camera.new_zeros(6 + state.camera.shape[1], len(state.camera))
    # Problems do not meet, so that the derivative of a sum over them has one problem in each entry.
    total = torch.autograd.functional.jacobian(lambda delta: function(moved(state, delta)).sum(0), zero)
    return total.permute(2, 0, 1)


def verified_derivative(function: Callable[[State], Tensor], state: State) -> Tensor:
    """See :func:`derivative`. Central differences must agree with it."""
    jacobian = derivative(function, state)
    longest = jacobian.abs().amax((0, 1)).clamp(min=1e-3)
    # Each step changes the values by about a share of 1e-4, and the state by 1e-4 at most.
    steps = (1e-4 * function(state).abs().max().clamp(min=1e-2) / longest).clamp(max=1e-4)
    every = torch.diag(steps)[:, :, None].expand(-1, -1, len(state.camera))
    central = torch.stack([function(moved(state, x)) - function(moved(state, -x)) for x in every], -1) / (2.0 * steps)
    assert ((jacobian - central) / longest).abs().max() < 1e-5
    return jacobian


def verify_jacobian(function: Callable[[State], Tensor], state: State, analytic: Tensor) -> None:
    """Check that ``analytic`` (B, M, 6 + K) is the derivative of a function (B, M) of states."""
    expected = verified_derivative(function, state)
    longest = expected.abs().amax((0, 1)).clamp(min=1e-3)
    assert ((analytic - expected) / longest).abs().max() < 1e-9


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
    intrinsics = torch.tensor([[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]], dtype=torch.float64)
    arrays = (cam - translation) @ rotation, FOCAL * plane + CENTRE, rotation, translation
    world, img, *pose = map(torch.tensor, arrays)
    return View(name, world, img, intrinsics, *pose, WIDTH, HEIGHT, torch.ones(count, dtype=torch.bool))


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


def many(examples):
    """Settings of a fuzz test; ``PNPNET_EXAMPLES`` multiplies its examples."""
    slow = [HealthCheck.too_slow]
    count = max(1, examples // 2 * int(os.environ.get("PNPNET_EXAMPLES", "1")))
    return settings(max_examples=count, deadline=None, derandomize=True, suppress_health_check=slow)


def finite(*values):
    for value in values:
        if isinstance(value, torch.Tensor):
            assert value.dtype == torch.bool or value.isfinite().all()
        elif value is not None:
            finite(*value)


def are_rotations(matrices):
    finite(matrices)
    flat = matrices.detach().double().reshape(-1, 3, 3)
    torch.testing.assert_close(flat @ flat.mT, torch.eye(3).double().expand_as(flat), rtol=0, atol=1e-4)
    assert (torch.linalg.det(flat) > 0).all()


#: Numbers for options: sound ones, and those that make no sense.
ANY = st.one_of(st.floats(-2.0, 200.0), st.sampled_from([0, 1, -1, 0.0, 1e-6, 1e6, INF, -INF, NAN]))
COUNTS = st.one_of(st.integers(-2, 12), st.sampled_from([0.5, NAN, True]))
# Without a slash, which would make a word the name of a repository on the Hub.
TEXT = st.text(st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), max_size=12)
OPTIONS = ["fixed", "adaptive", "unknown", "always"]
OPTIONS += [*KERNELS, *BACKWARDS, "additive", "msac", "AP3P", "EPNP", "USAC_FAST", "epnp-lm", "pnpnet-n9"]
WORD = TEXT | st.sampled_from(OPTIONS)
ARGUMENTS = ["800,800,320,240", "epnp", "p3p-ransac:threshold=2", "pnpnet-set:m=", "epnp:1", "nan", "-1", "--x"]
WORDS = TEXT | st.sampled_from(ARGUMENTS)

#: What damage puts into a file.
TOKENS = (*b',|\n|\r|"|\0|\xff|nan|inf|-|1e999|;| |PK\x03\x04'.split(b"|"), b"9" * 400)


@st.composite
def damage(draw, content):
    """A file of which something was lost, changed or put in, up to four times."""
    content = bytearray(content)
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, len(content)))
        match draw(st.sampled_from(["cut", "lose", "change", "put in"])):
            case "cut":
                del content[place:]
            case "lose":
                del content[place : place + draw(st.integers(1, 40))]
            case "change":
                content[place : place + 1] = draw(st.binary(min_size=1, max_size=1))
            case "put in":
                content[place:place] = draw(st.sampled_from(TOKENS))
    return bytes(content)


def names_the_file(error, path):
    assert str(path) in str(error)


@st.composite
def spoiled(draw, content, places):
    """Results of which some values were lost or replaced."""
    content = json.loads(json.dumps(content))
    for _ in range(draw(st.integers(1, 3))):
        *path, last = draw(st.sampled_from(places))
        inner = content
        with contextlib.suppress(KeyError, IndexError, TypeError):
            for key in path:
                inner = inner[key]
            if draw(st.booleans()):
                del inner[last]
            else:
                inner[last] = draw(st.sampled_from([None, "", "x", -1, 0, 1e300, [], {}, [None], True, {"a": 1}]))
    return content


def places_in(content, path=()):
    """All keys and indices of nested lists and dictionaries; of long lists the first two."""
    if isinstance(content, list):
        content = dict(enumerate(content[:2]))
    for key, value in content.items() if isinstance(content, dict) else ():
        yield (*path, key)
        yield from places_in(value, (*path, key))


def run_main(*arguments):
    """Exit code and what was printed. With the exit code 2 that is one line and no traceback."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main([str(x) for x in arguments])
        except SystemExit as end:
            code = end.code
    assert code != 2 or (err.getvalue()[:8], err.getvalue().count("\n")) == ("pnpnet: ", 1), err.getvalue()
    return code, out.getvalue(), err.getvalue()
