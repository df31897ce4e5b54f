"""What the fuzz tests draw: problems, poses, options, damaged files; and what every result keeps."""

import contextlib
import io
import json
import math
import os
from collections import Counter

import torch
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from kornia.core.exceptions import BaseError

from kornia_pnpnet import Pose, create_solver
from kornia_pnpnet.cli import main
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.data.draws import random_poses
from kornia_pnpnet.refine.kernels import KERNELS
from kornia_pnpnet.refine.lm import BACKWARDS

NAMES = "pnpnet-set", "pnpnet-n9", "net-n9", "epnp", "epnp-lm", "reppnp-lm", "p3p-ransac", "identity-lm"
SOLVERS = {name: create_solver(name) for name in NAMES}
ERRORS = BaseError, ValueError
NAN, INF = float("nan"), float("inf")
TIMES = int(os.environ.get("PNPNET_EXAMPLES", "1"))


def many(examples):
    """Settings of a fuzz test; ``PNPNET_EXAMPLES`` multiplies its examples."""
    slow = [HealthCheck.too_slow]
    count = max(1, examples // 2 * TIMES)
    return settings(max_examples=count, deadline=None, derandomize=True, suppress_health_check=slow)


# --- problems and results ---------------------------------------------------------------------------------------------


def _entry(which, value):
    def spoil(*inputs):
        spoiled = [x.clone() for x in inputs]
        spoiled[which].view(-1)[0] = value  # of the first pair, which no mask hides
        return tuple(spoiled)

    return spoil


#: What may be wrong with the points, pixels and camera of a problem, so that it must not be ok.
NO_POSE = {
    "only nan": lambda *inputs: tuple(torch.full_like(x, NAN) for x in inputs),
    "nan point": _entry(0, NAN),
    "infinite point": _entry(0, -INF),
    "nan pixel": _entry(1, NAN),
    "infinite pixel": _entry(1, INF),
    "nan focal length": _entry(2, NAN),
    "no focal length": _entry(2, 0.0),
    "one point": lambda world, img, camera: (world[:1].expand_as(world), img, camera),
    "a line": lambda world, img, camera: (world[:, :1].expand_as(world), img, camera),
}
#: What may be strange about a problem that may be ok.
STRANGE = {
    "nothing": lambda *inputs: inputs,
    "a plane": lambda world, img, camera: (world * torch.tensor([1.0, 1.0, 0.0]).to(world), img, camera),
    "one pixel": lambda world, img, camera: (world, img[:1].expand_as(img), camera),
    "a huge number": _entry(0, 1e30),
    "a huge pixel": _entry(1, 1e9),
    "a tiny world": lambda world, img, camera: (1e-30 * world, img, camera),
    "negative focal length": _entry(2, -500.0),
    "mirrored pixels": lambda world, img, camera: (world, -img, camera),
    "all points twice": lambda world, img, camera: (world[[i // 2 for i in range(len(world))]], img, camera),
}


@st.composite
def batches(draw, n=None, most=4):
    """A batch of problems in any layout, a mask and weights or ``None``, and what is strange about each problem."""
    count, batch = draw(st.integers(4, 12) if n is None else st.just(n)), draw(st.integers(0, most))
    dtype = draw(st.sampled_from([torch.float32, torch.float64]))
    seed, scale = draw(st.integers(0, 1000)), 10.0 ** draw(st.integers(-6, 6))
    problems = SyntheticProblems(n=count, batch_size=max(batch, 1), seed=seed, dtype=torch.float64)
    world, img, camera = (x[:batch].clone() for x in problems.batch(0)[:3])
    world *= scale
    kinds = [draw(st.sampled_from([*NO_POSE, *STRANGE])) for _ in range(batch)]
    for i, kind in enumerate(kinds):
        world[i], img[i], camera[i] = {**NO_POSE, **STRANGE}[kind](world[i].clone(), img[i].clone(), camera[i].clone())
    inputs = [x.to(dtype) for x in (world, img, camera)]
    layout = draw(st.sampled_from(["contiguous", "transposed", "every other"]))
    if layout == "transposed":
        inputs = [x.permute(2, 1, 0).contiguous().permute(2, 1, 0) for x in inputs]
    elif layout == "every other":
        inputs = [x.repeat_interleave(2, 0)[::2] for x in inputs]
    mask = None
    if draw(st.booleans()):
        mask = torch.rand(batch, count, generator=torch.Generator().manual_seed(seed)) > 0.1
        mask[:, 0] = True
    weight = draw(st.sampled_from([None, 1.0, 1e-12, 1e6]))
    weights = None if weight is None else torch.full((batch, count), weight, dtype=dtype)
    if draw(st.booleans()):
        inputs = [x.detach().requires_grad_() for x in inputs]
    return inputs, mask, weights, kinds


def check(result, inputs, kinds):
    """What every result keeps."""
    batch, count = inputs[0].shape[:2]
    shapes = (batch, 3, 3), (batch, 3), (batch, count), (batch,), (batch,)
    assert tuple(tuple(x.shape) for x in result[:5]) == shapes
    values = *result[:4], *result.init
    assert {x.dtype for x in values} == {inputs[0].dtype}
    finite(values)
    assert result.ok.dtype == torch.bool
    assert not [kind for ok, kind in zip(result.ok.tolist(), kinds, strict=True) if ok and kind in NO_POSE]
    are_rotations(result.rotation)
    if result.translation.requires_grad:
        gradients_are_finite(values, [x for x in inputs if x.requires_grad])


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


def gradients_are_finite(values, tensors):
    total = sum(x.sum() for x in values if x.requires_grad)
    if tensors and isinstance(total, torch.Tensor):
        finite(*(x for x in torch.autograd.grad(total, tensors, allow_unused=True) if x is not None))


# --- numbers, poses and options ---------------------------------------------------------------------------------------


@st.composite
def numbers(draw, dtype, *shapes):
    """A tensor of one of the shapes. Its first entry may be a number that makes no sense."""
    seed, size = draw(st.integers(0, 1000)), 10.0 ** draw(st.integers(-6, 6))
    shape = draw(st.sampled_from(shapes))
    values = size * torch.rand(shape, generator=torch.Generator().manual_seed(seed)).to(dtype)
    if values.numel() and draw(st.booleans()):
        values.view(-1)[0] = draw(st.sampled_from([0.0, -1.0, NAN, INF, 1e30]))
    return values


def rotations(batch, seed, dtype=torch.float64):
    return random_poses(batch, torch.Generator().manual_seed(seed), max_angle=math.pi).rotation.to(dtype)


@st.composite
def poses(draw, batch, dtype):
    """Finite poses of any size."""
    shift = torch.randn(batch, 3, generator=torch.Generator().manual_seed(draw(st.integers(0, 99))))
    size = 10.0 ** draw(st.integers(-6, 6))
    return Pose(rotations(batch, draw(st.integers(0, 99)), dtype), size * shift.to(dtype))


#: Numbers for options: sound ones, and those that make no sense.
ANY = st.one_of(st.floats(-2.0, 200.0), st.sampled_from([0, 1, -1, 0.0, 1e-6, 1e6, INF, -INF, NAN]))
COUNTS = st.one_of(st.integers(-2, 12), st.sampled_from([0.5, NAN, True]))
RANGES = st.tuples(ANY, ANY)
BOOL = st.booleans()
# Without a slash, which would make a word the name of a repository on the Hub.
TEXT = st.text(st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), max_size=12)
OPTIONS = [*KERNELS, *BACKWARDS, "additive", "msac", "AP3P", "EPNP", "USAC_FAST", "epnp-lm", "pnpnet-n9"]
WORD = TEXT | st.sampled_from(OPTIONS)
ARGUMENTS = ["800,800,320,240", "epnp", "p3p-ransac:threshold=2", "pnpnet-set:m=", "epnp:1", "nan", "-1", "--x"]
WORDS = TEXT | st.sampled_from(ARGUMENTS)


@st.composite
def options(draw, **values):
    """None, one or two of these options; the others stay as they are."""
    names = draw(st.lists(st.sampled_from(sorted(values)), max_size=2, unique=True))
    return {name: draw(values[name]) for name in names}


class Seen:
    """Counts what could be made and what was refused."""

    def __init__(self):
        self.counts = Counter()

    def __call__(self, make, errors=ERRORS):
        """What was made, or ``None``."""
        try:
            made = make()
        except errors:
            self.counts["refused"] += 1
            return None
        self.counts["works"] += 1
        return made

    def both(self, least=3):
        """The cases held options that work and options that are refused."""
        assert min(self.counts[x] for x in ("works", "refused")) >= least


# --- files and the command --------------------------------------------------------------------------------------------

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
    """Exit code and what was printed; an exception is one."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main([str(x) for x in arguments])
        except SystemExit as end:
            code = end.code
    return code, out.getvalue(), err.getvalue()
