"""What the fuzz tests draw: problems, poses, options, damaged files; and what every result keeps."""

import contextlib
import io
import json
import os
from collections import Counter

import torch
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from kornia.core.exceptions import BaseError

from kornia_pnpnet import Pose, create_solver
from kornia_pnpnet.cli import main
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.refine.kernels import KERNELS
from kornia_pnpnet.refine.lm import BACKWARDS

SOLVERS = {
    name: create_solver(name)
    for name in ("pnpnet-set", "pnpnet-n9", "net-n9", "epnp", "epnp-lm", "reppnp-lm", "p3p-ransac", "identity-lm")
}


NAN, INF = float("nan"), float("inf")

TIMES = int(os.environ.get("PNPNET_EXAMPLES", "1"))


def many(examples, times=TIMES):
    """Settings of a fuzz test; ``PNPNET_EXAMPLES`` multiplies its examples, ``times=1`` where each takes seconds."""
    return settings(
        max_examples=max(1, examples // 2 * times),
        deadline=None,
        derandomize=True,
        suppress_health_check=[HealthCheck.too_slow],
    )


# What may be wrong with a problem; those in NO_POSE must not be ok.
def _line(world, img, camera):
    return world[:, :1] * torch.ones(3, dtype=world.dtype), img, camera


def _plane(world, img, camera):
    flat = world.clone()
    flat[:, 2] = 0.0
    return flat, img, camera


def _entry(which, value):
    def spoil(*inputs):
        spoiled = list(inputs)
        spoiled[which] = spoiled[which].clone()
        spoiled[which].view(-1)[0] = value  # of the first pair, which no mask hides
        return tuple(spoiled)

    return spoil


NO_POSE = {
    "only nan": lambda *inputs: tuple(torch.full_like(x, NAN) for x in inputs),
    "nan point": _entry(0, NAN),
    "infinite point": _entry(0, -INF),
    "nan pixel": _entry(1, NAN),
    "infinite pixel": _entry(1, INF),
    "nan focal length": _entry(2, NAN),
    "no focal length": _entry(2, 0.0),
    "negative focal length": _entry(2, -500.0),
    "one point": lambda world, img, camera: (world[:1].expand_as(world).clone(), img, camera),
    "a line": _line,
}

STRANGE = {
    "nothing": lambda *inputs: inputs,
    "a plane": _plane,
    "one pixel": lambda world, img, camera: (world, img[:1].expand_as(img).clone(), camera),
    "a huge number": _entry(0, 1e30),
    "a huge pixel": _entry(1, 1e9),
    "a tiny world": lambda world, img, camera: (1e-30 * world, img, camera),
    "mirrored pixels": lambda world, img, camera: (world, -img, camera),
    "all points twice": lambda world, img, camera: (world[[i // 2 for i in range(len(world))]], img, camera),
}


@st.composite
def batches(draw, n=None, most=4):
    """A batch of problems, what is wrong with each, and what else there is about its tensors."""
    count, batch = draw(st.integers(4, 12) if n is None else st.just(n)), draw(st.integers(0, most))
    dtype = draw(st.sampled_from([torch.float32, torch.float64]))
    seed = draw(st.integers(0, 1000))
    scale = 10.0 ** draw(st.integers(-6, 6))
    problems = SyntheticProblems(n=count, batch_size=max(batch, 1), seed=seed, dtype=torch.float64)
    world, img, camera = (x[:batch].clone() for x in problems.batch(0)[:3])
    world *= scale
    kinds = [draw(st.sampled_from([*NO_POSE, *STRANGE])) for _ in range(batch)]
    for i, kind in enumerate(kinds):
        world[i], img[i], camera[i] = {**NO_POSE, **STRANGE}[kind](world[i], img[i], camera[i])
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
    weights = draw(st.sampled_from([None, 1.0, 1e-12, 1e6]))
    weights = None if weights is None else torch.full((batch, count), weights, dtype=dtype)
    if draw(st.booleans()):
        inputs = [x.detach().requires_grad_() for x in inputs]
    return inputs, mask, weights, kinds


def check(result, inputs, kinds):
    """What every result keeps."""
    batch, count = inputs[0].shape[:2]
    shapes = (batch, 3, 3), (batch, 3), (batch, count), (batch,), (batch,)
    assert tuple(tuple(x.shape) for x in result[:5]) == shapes
    for value in (*result[:4], *result.init):
        assert value.dtype == inputs[0].dtype
        assert value.isfinite().all()
    assert result.ok.dtype == torch.bool
    for ok, kind in zip(result.ok.tolist(), kinds, strict=True):
        assert not (ok and kind in NO_POSE), kind
    eye = torch.eye(3, dtype=torch.float64).expand(batch, 3, 3)
    rotation = result.rotation.detach().double()
    torch.testing.assert_close(rotation @ rotation.mT, eye, rtol=0, atol=1e-4)
    tensors = [x for x in inputs if x.requires_grad]
    if tensors and result.translation.requires_grad:
        total = sum(x.sum() for x in (*result[:4], *result.init))
        for gradient in torch.autograd.grad(total, tensors, allow_unused=True):
            assert gradient is None or gradient.isfinite().all()


@st.composite
def numbers(draw, dtype, *shapes):
    """Of one of the shapes; now and then one of them is no number that makes sense."""
    seed, size = draw(st.integers(0, 1000)), 10.0 ** draw(st.integers(-6, 6))
    shape = draw(st.sampled_from(shapes))
    values = size * torch.rand(shape, generator=torch.Generator().manual_seed(seed)).to(dtype)
    if values.numel() and draw(st.booleans()):
        values.view(-1)[0] = draw(st.sampled_from([0.0, -1.0, NAN, INF, 1e30]))
    return values


def same(result, expected):
    """The same `ok` and the same poses where there are any; of strange problems the minima are flat."""
    assert result[4].equal(expected[4])
    ok = expected[4]
    for ours, there in zip(result[:2], expected[:2], strict=True):
        assert ours.isfinite().all()
        size = there[ok].detach().abs().max().item() if ok.any() else 0.0
        torch.testing.assert_close(ours[ok], there[ok], rtol=1e-2, atol=1e-2 * size)


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


def run_main(*arguments):
    """Exit code and what was printed; an exception is one."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main([str(x) for x in arguments])
        except SystemExit as end:
            code = end.code
    return code, out.getvalue(), err.getvalue()


# No slash: what has one could be the name of a repository on the Hub.
WORDS = st.one_of(
    st.text(st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), max_size=12),
    st.sampled_from(
        ["800,800,320,240", "epnp", "p3p-ransac:threshold=2", "pnpnet-set:m=", "epnp:1", "nan", "-1", "--x"]
    ),
)

ERRORS = BaseError, ValueError

#: Numbers for options: sound ones, and those that make no sense.
ANY = st.one_of(st.floats(-2.0, 200.0), st.sampled_from([0, 1, -1, 0.0, 1e-6, 1e6, INF, -INF, NAN]))

COUNTS = st.one_of(st.integers(-2, 12), st.sampled_from([0.5, NAN, True]))

RANGES = st.tuples(ANY, ANY)

BOOL = st.booleans()

WORD = st.text(st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), max_size=8) | st.sampled_from(
    [*KERNELS, *BACKWARDS, "additive", "msac", "AP3P", "EPNP", "USAC_FAST", "epnp-lm", "pnpnet-n9"]
)


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


def rotations(batch, seed, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    q, r = torch.linalg.qr(torch.randn(batch, 3, 3, generator=generator, dtype=torch.float64))
    q = q * r.diagonal(dim1=1, dim2=2).sign()[:, None]
    return (q * q.det()[:, None, None]).to(dtype)


@st.composite
def poses(draw, batch, dtype):
    """Of any size; finite."""
    shift = torch.randn(batch, 3, generator=torch.Generator().manual_seed(draw(st.integers(0, 99))))
    size = 10.0 ** draw(st.integers(-6, 6))
    return Pose(rotations(batch, draw(st.integers(0, 99)), dtype), size * shift.to(dtype))


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


def names_the_file(error, path):
    assert str(path) in str(error)


@st.composite
def spoiled(draw, content, places):
    """Results of which some values were lost or replaced."""
    content = json.loads(json.dumps(content))
    for _ in range(draw(st.integers(1, 3))):
        *path, last = draw(st.sampled_from(places))
        inner = content
        try:
            for key in path:
                inner = inner[key]
            if draw(st.booleans()):
                del inner[last]
            else:
                inner[last] = draw(st.sampled_from([None, "", "x", -1, 0, 1e300, [], {}, [None], True, {"a": 1}]))
        except (KeyError, IndexError, TypeError):
            continue
    return content


def places_in(content, path=()):
    """All keys and indices of nested lists and dictionaries; of long lists the first two."""
    items = (
        content.items() if isinstance(content, dict) else enumerate(content[:2]) if isinstance(content, list) else ()
    )
    for key, value in items:
        yield (*path, key)
        yield from places_in(value, (*path, key))
