"""Whatever comes in: shapes, dtypes, layouts, scales, numbers that are none, and geometry without a pose."""

import contextlib
import copy
import io
import json
import os
import warnings
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import BaseError, DeviceError, ShapeError

from kornia_pnpnet import (
    Pose,
    PoseLoss,
    SetLoss,
    create_solver,
    pose_covariance,
    pose_errors,
    solve_pnp,
    success,
)
from kornia_pnpnet.cli import main
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.init import p3p
from kornia_pnpnet.losses import pose_distances
from kornia_pnpnet.metrics import PoseErrors, reliability

SOLVERS = {
    name: create_solver(name)
    for name in ("pnpnet-set", "pnpnet-n9", "net-n9", "epnp", "epnp-lm", "reppnp-lm", "p3p-ransac", "identity-lm")
}
PEERS = {name: create_solver(name) for name in ("opencv-ransac", "poselib")}
NAN, INF = float("nan"), float("inf")


TIMES = int(os.environ.get("PNPNET_EXAMPLES", "1"))


def many(examples, times=TIMES):
    """So many examples, and more for the page; ``times=1`` where each takes seconds."""
    return settings(
        max_examples=examples * times,
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


def check(result, inputs, kinds, tally):
    """What every result keeps."""
    for kind in kinds:
        tally("problems", kind)
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


@pytest.mark.parametrize("name", SOLVERS)
def test_solvers_take_anything(name, tally):
    exactly = 9 if name.endswith("-n9") else None

    @many(40)
    @given(batches(exactly))
    def run(case):
        inputs, mask, weights, kinds = case
        tally("batches", f"`{name}`")
        check(SOLVERS[name](*inputs, weights=weights, mask=mask), inputs, kinds, tally)

    run()


@st.composite
def numbers(draw, dtype, *shapes):
    """Of one of the shapes; now and then one of them is no number that makes sense."""
    seed, size = draw(st.integers(0, 1000)), 10.0 ** draw(st.integers(-6, 6))
    shape = draw(st.sampled_from(shapes))
    values = size * torch.rand(shape, generator=torch.Generator().manual_seed(seed)).to(dtype)
    if values.numel() and draw(st.booleans()):
        values.view(-1)[0] = draw(st.sampled_from([0.0, -1.0, NAN, INF, 1e30]))
    return values


@pytest.mark.parametrize("name", SOLVERS)
def test_solvers_take_any_weights_noise_and_start(name, tally):
    exactly = 9 if name.endswith("-n9") else None

    @many(30)
    @given(batches(exactly), st.data())
    def run(case, data):
        inputs, mask, _, kinds = case
        batch, count = inputs[0].shape[:2]
        tally("batches", f"`{name}`, with any weights, noise, masks and starts")
        dtype, each = inputs[0].dtype, (batch, count)
        weights = data.draw(numbers(dtype, each))
        # The first pair is the one that is spoiled.
        kinds = ["nothing" if weight == 0 else kind for kind, weight in zip(kinds, weights[:, 0], strict=True)]
        sigma = st.one_of(st.none(), numbers(dtype, (), (batch,), each))
        noise = {key: data.draw(sigma) for key in ("img_sigma", "world_sigma")}
        if mask is not None and batch and data.draw(st.booleans()):
            mask[0] = False  # of the first problem nothing is there
            kinds[0] = "one point"
        init = None
        if data.draw(st.booleans()):
            translation = 10.0 * torch.randn(batch, 3, generator=torch.Generator().manual_seed(batch))
            init = Pose(torch.eye(3).expand(batch, 3, 3), translation)
            init = Pose(*(x.to(inputs[0].dtype) for x in init))
        check(SOLVERS[name](*inputs, weights=weights, mask=mask, init=init, **noise), inputs, kinds, tally)

    run()


@pytest.mark.parametrize("name", PEERS)
def test_peers_take_anything(name, tally):
    @many(25)
    @given(batches())
    def run(case):
        inputs, mask, weights, kinds = case
        # Of points on a line they may say what they like.
        kinds = ["nothing" if kind in ("one point", "a line") else kind for kind in kinds]
        tally("batches", f"`{name}`")
        check(PEERS[name](*inputs, weights=weights, mask=mask), inputs, kinds, tally)

    run()


@many(30)
@given(batches(9), st.sampled_from(["pnpnet-set", "pnpnet-n9", "epnp-lm", "p3p-ransac"]))
def test_a_problem_is_solved_as_if_it_were_alone(tally, case, name):
    tally("calls", "every problem of a batch again, alone: the same pose and `ok`")
    inputs, mask, weights, _ = case
    whole = SOLVERS[name](*inputs, weights=weights, mask=mask)
    for i in range(len(inputs[0])):
        part = slice(i, i + 1)
        alone = SOLVERS[name](
            *(x[part] for x in inputs),
            weights=None if weights is None else weights[part],
            mask=None if mask is None else mask[part],
        )
        assert alone.ok.equal(whole.ok[part])
        if name != "p3p-ransac" and alone.ok.item():  # RANSAC draws for the whole batch
            size = whole.translation[part].abs().max().item()
            torch.testing.assert_close(alone.translation, whole.translation[part], rtol=1e-2, atol=1e-2 * size)


@many(30)
@given(
    st.sampled_from(["pnpnet-set", "pnpnet-n9", "epnp-lm", "reppnp-lm"]),
    st.integers(-6, 6),
    st.integers(-3, 3),
    st.integers(0, 100),
)
def test_units_of_world_and_camera_do_not_matter(tally, name, world_power, pixel_power, seed):
    tally("calls", "world times 10⁻⁶ to 10⁶, pixels times 10⁻³ to 10³: the same pose")
    problems = SyntheticProblems(n=9, batch_size=20, seed=seed, dtype=torch.float64).batch(0)
    scale, zoom = 10.0**world_power, 10.0**pixel_power
    camera = problems.intrinsics * torch.tensor([zoom, zoom, 1.0], dtype=torch.float64)[:, None]
    plain = SOLVERS[name](*problems[:3])
    scaled = SOLVERS[name](scale * problems.world_points, zoom * problems.img_points, camera)
    assert scaled.ok.equal(plain.ok)
    ok = plain.ok
    torch.testing.assert_close(scaled.translation[ok] / scale, plain.translation[ok], rtol=1e-3, atol=1e-3)
    back = scaled.pose._replace(translation=scaled.translation / scale)
    solved, as_well = (success(pose_errors(pose, problems.pose)) for pose in (plain.pose, back))
    assert (solved == as_well).float().mean() > 0.9  # at the limit rounding may decide
    assert solved.any()


@many(60)
@given(
    st.sampled_from([*SOLVERS, *PEERS]),
    st.tuples(st.integers(0, 3), st.integers(0, 12), st.integers(1, 4)),
    st.tuples(st.integers(0, 3), st.integers(0, 12), st.integers(1, 3)),
    st.sampled_from([(3, 3), (4, 4), (2, 3, 3), (3,), (3, 3, 3)]),
    st.sampled_from([torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.int64]),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_what_does_not_fit_is_an_error_of_ours(tally, name, world, img, camera, dtype, other):
    tally("calls", "shapes and dtypes that do not fit, half precision, integers: an error of the package's own types")
    solver = {**SOLVERS, **PEERS}[name]
    inputs = torch.ones(world, dtype=dtype), torch.ones(img, dtype=other), torch.ones(camera, dtype=other)
    fits = world[:2] == img[:2] and world[2] == 3 and img[2] == 2 and world[1] >= 3 and dtype == other
    fits = fits and (camera == (3, 3) or camera == (world[0], 3, 3))
    fits = fits and (world[1] == 9 or not name.endswith("-n9"))
    if fits:
        result = solver(*inputs)
        assert not result.ok.any()  # all at one point
    else:
        with pytest.raises(BaseError):
            solver(*inputs)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("n", [0, 1, 2])
def test_fewer_than_three_pairs_are_refused(name, n, tally):
    tally("calls", "0, 1 or 2 pairs: `ShapeError`")
    with pytest.raises(ShapeError):
        SOLVERS[name](torch.zeros(2, n, 3), torch.zeros(2, n, 2), torch.eye(3))


@many(40)
@given(batches())
def test_covariances_take_anything(tally, case):
    tally("calls", "`pose_covariance` of any batch")
    inputs, _, weights, _ = case
    result = SOLVERS["pnpnet-set"](*inputs)
    covariance = pose_covariance(result.pose, *inputs, img_sigma=1.0, weights=weights)
    assert covariance.shape == (len(inputs[0]), 6, 6)
    assert not covariance.requires_grad
    assert not covariance[result.ok].isnan().any()


@many(40)
@given(batches())
def test_matrices_take_anything(tally, case):
    tally("calls", "`solve_pnp` of any batch: NaN where there is no pose, and only there")
    inputs, _, weights, _ = case
    matrix = solve_pnp(*inputs, weights)
    ok = SOLVERS["pnpnet-set"](*inputs, weights).ok
    assert matrix.isnan().all((1, 2)).equal(~ok)
    assert matrix[ok].isfinite().all()


# -- wherever tensors are, and what PyTorch makes of a solver ----------------------------------------------------------

#: ``meta`` has shapes and no values: whoever looks at one, or makes a tensor somewhere else, raises there.
DEVICES = ["meta", *(["cuda"] if torch.cuda.is_available() else [])]
GRAPHS = [name for name in SOLVERS if name != "p3p-ransac"]  # RANSAC looks at values


@st.composite
def calls(draw, n=None):
    """All that a solver can be given, by name; what is not given is missing."""
    (world, img, camera), mask, weights, _ = draw(batches(n))
    batch, count = world.shape[:2]
    sigma = st.none() | numbers(world.dtype, (), (batch,), (batch, count))
    init = Pose(torch.eye(3, dtype=world.dtype).expand(batch, 3, 3), torch.ones(batch, 3, dtype=world.dtype))
    call = {"world_points": world, "img_points": img, "intrinsics": camera, "weights": weights, "mask": mask}
    call |= {"init": draw(st.sampled_from([None, init])), "img_sigma": draw(sigma), "world_sigma": draw(sigma)}
    return {name: value for name, value in call.items() if value is not None}


def moved(call, device, names):
    """Some of the tensors on another device."""
    pose = {name: Pose(*(x.to(device) for x in call[name])) for name in names if name == "init"}
    return {**call, **{name: call[name].to(device) for name in names if name != "init"}, **pose}


@pytest.mark.parametrize("name", GRAPHS)
def test_solvers_stay_where_their_inputs_are(name, tally):
    solvers = {device: copy.deepcopy(SOLVERS[name]).to(device) for device in DEVICES}

    @many(15)
    @given(st.sampled_from(DEVICES), calls(9 if name.endswith("-n9") else None))
    def run(device, call):
        tally("calls", f"`{name}`, all tensors on the device `{device}`: nothing is made elsewhere, no value looked at")
        result, guess = solvers[device].with_guess(**moved(call, device, call))
        expected = SOLVERS[name](**call)
        for ours, there in zip((*result[:5], *result.init), (*expected[:5], *expected.init), strict=True):
            assert ours.device.type == guess.weights.device.type == device
            assert (ours.shape, ours.dtype) == (there.shape, there.dtype)

    run()


@many(80)
@given(st.sampled_from([*SOLVERS, *PEERS]), st.sampled_from(DEVICES), calls(9), st.data())
def test_inputs_on_different_devices_are_an_error_of_ours(tally, name, device, call, data):
    tally("calls", "solvers with some tensors on another device: `DeviceError`")
    call = dict(list(call.items())[:3]) if name in PEERS else call
    names = data.draw(st.lists(st.sampled_from(list(call)), min_size=1, max_size=len(call) - 1, unique=True))
    with pytest.raises(DeviceError, match=f"on {device}"):
        {**SOLVERS, **PEERS}[name](**moved(call, device, names))


def functions_of_tensors():
    """Public functions of tensors, with some that they take."""
    problems = SyntheticProblems(n=9, batch_size=3, seed=0).batch(0)
    result, guess = SOLVERS["pnpnet-set"].with_guess(*problems[:3])
    inputs, both, each = problems[:3], (*result.pose, *problems.pose), torch.full((3, 9), 0.5)

    def loss(function, *parts):
        outcome = result._replace(rotation=parts[0], translation=parts[1], init=Pose(*parts[2:4]))
        return function(outcome, problems._replace(pose=Pose(*parts[4:])))

    def covariance(a, b, world, img, camera, sigma, length, weights):
        return pose_covariance(Pose(a, b), world, img, camera, img_sigma=sigma, world_sigma=length, weights=weights)

    sigmas = torch.tensor(1.0), torch.ones(3), each
    return {
        "solve_pnp": (solve_pnp, (*inputs, each)),
        "p3p": (p3p, (problems.world_points[:, :3], problems.img_points[:, :3])),
        "pose_covariance": (covariance, (*both[:2], *inputs, *sigmas)),
        "pose_errors": (lambda a, b, c, d: pose_errors(Pose(a, b), Pose(c, d)), both),
        "pose_distances": (lambda a, b, c, d: pose_distances(Pose(a, b), Pose(c, d)), both),
        "success": (lambda a, b, c: success(PoseErrors(a, b), 1.0, c), torch.ones(3, 3).unbind()),
        "reliability": (reliability, (each, each > 0.2)),
        "PoseLoss": (partial(loss, PoseLoss()), (*result.pose, *result.init, *problems.pose)),
        "SetLoss": (
            partial(loss, partial(SetLoss(), ramp=1.0, guess=guess)),
            (*result.pose, *result.init, *problems.pose),
        ),
    }


FUNCTIONS = functions_of_tensors()


@many(100)
@given(st.sampled_from(list(FUNCTIONS)), st.sampled_from(DEVICES), st.data())
def test_tensors_on_different_devices_are_an_error_of_ours(tally, name, device, data):
    tally("calls", f"{', '.join(f'`{x}`' for x in FUNCTIONS)} with some tensors on another device: `DeviceError`")
    function, tensors = FUNCTIONS[name]
    function(*tensors)
    which = data.draw(st.lists(st.integers(0, len(tensors) - 1), min_size=1, max_size=len(tensors) - 1, unique=True))
    with pytest.raises(DeviceError, match=f"on {device}"):
        function(*(x.to(device) if i in which else x for i, x in enumerate(tensors)))


def same(result, expected):
    """The same `ok` and the same poses where there are any; of strange problems the minima are flat."""
    assert result[4].equal(expected[4])
    ok = expected[4]
    for ours, there in zip(result[:2], expected[:2], strict=True):
        assert ours.isfinite().all()
        size = there[ok].detach().abs().max().item() if ok.any() else 0.0
        torch.testing.assert_close(ours[ok], there[ok], rtol=1e-2, atol=1e-2 * size)


def tensors_of(case):
    """All tensors of a batch, and a function of them that solves it."""
    inputs, mask, weights, _ = case
    others = {name: value for name, value in (("weights", weights), ("mask", mask)) if value is not None}

    def solve(solver, *tensors):
        return solver(*tensors[:3], **dict(zip(others, tensors[3:], strict=True)))

    return (*inputs, *others.values()), solve


@pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning")
@pytest.mark.parametrize("name", GRAPHS)
def test_vmap_is_a_larger_batch(name, tally):
    solver = SOLVERS[name]

    @many(15)
    @given(batches(9 if name.endswith("-n9") else None))
    def run(case):
        tally("calls", f"`{name}` under `torch.func.vmap`: the results of one batch; under `vmap` of `grad`, too")
        tensors, solve = tensors_of(case)
        mapped = torch.func.vmap(lambda *x: solve(solver, *x)[:5])(*(torch.stack((x, x.flip(0))) for x in tensors))
        plain = solve(solver, *tensors)
        same([x[0] for x in mapped], plain)
        same([x[1].flip(0) for x in mapped], plain)
        if not len(tensors[0]):
            return
        tensors = [x.detach() for x in tensors]

        def outcome(*problem):
            return solve(solver, *(x[None] for x in problem)).rotation.sum()

        each = torch.func.vmap(torch.func.grad(outcome, argnums=1))(*tensors)
        img = tensors[1].clone().requires_grad_()
        (whole,) = torch.autograd.grad(solve(solver, tensors[0], img, *tensors[2:]).rotation.sum(), img)
        assert each.isfinite().all()
        usual = torch.tensor([kind == "nothing" for kind in case[3]])
        size = whole[usual].abs().max().item() if usual.any() else 0.0
        torch.testing.assert_close(each[usual], whole[usual], rtol=0.05, atol=0.05 * size)

    run()


@pytest.mark.filterwarnings("ignore:.*should not be instantiated:DeprecationWarning")
@pytest.mark.slow
@pytest.mark.parametrize("name", ["pnpnet-set", "pnpnet-n9", "epnp-lm"])
def test_compiled_solvers_take_anything(name, tally, monkeypatch):
    """Captured and traced with its gradients; the graphs run as they are, for want of the time to compile them."""
    compile_ = torch.compile
    monkeypatch.setattr(
        torch, "compile", lambda f, **more: compile_(f, **{**more, "options": None, "backend": "aot_eager"})
    )
    torch.compiler.reset()
    solver = copy.deepcopy(SOLVERS[name])
    solver.compile()

    @many(8, times=1)
    @given(batches(9))
    def run(case):
        tally("calls", f"`{name}`, compiled (`aot_eager`): the results of one that is not")
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # that it was not compiled
            check(solver(*case[0], weights=case[2], mask=case[1]), case[0], case[3], tally)
        tensors, solve = tensors_of(case)
        same(solve(solver, *tensors), solve(SOLVERS[name], *tensors))

    run()
    torch.compiler.reset()


# -- the command line: any file, any argument -------------------------------------------------------------------------

TOKENS = (
    b",",
    b"\n",
    b"\r",
    b'"',
    b"\0",
    b"\xff",
    b"nan",
    b"inf",
    b"-",
    b"1e999",
    b"9" * 400,
    b";",
    b" ",
    b"PK\x03\x04",
)


def problem_file(kind):
    """The bytes of a sound file, and how its name ends."""
    problems = SyntheticProblems(n=9, batch_size=3, seed=0).batch(0)
    arrays = dict(zip(("world_points", "img_points", "intrinsics"), (x.numpy() for x in problems[:3]), strict=True))
    file = io.BytesIO()
    match kind:
        case "csv":
            rows = np.concatenate((arrays["world_points"][0], arrays["img_points"][0]), 1)
            file.write("\n".join(["X,Y,Z,u,v", *(",".join(map(str, row)) for row in rows)]).encode())
        case "npz":
            np.savez(file, **{name: array[0] for name, array in arrays.items()})
        case "shard npz":
            np.savez_compressed(file, **arrays)
        case "shard parquet":
            from pyarrow import parquet, table

            parquet.write_table(table({name: [*array.reshape(3, -1)] for name, array in arrays.items()}), file)
    return file.getvalue(), kind.split()[-1]


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


def solving(kind, path):
    """The arguments that solve a file."""
    shard = "--batch", "--out", path.parent / "out", "--overwrite"
    return (
        "solve",
        path,
        *(shard if kind.startswith("shard") else ("--intrinsics", "3400,3400,960,540")),
        "--solver",
        "epnp",
    )


@pytest.mark.filterwarnings("ignore")  # of NumPy, about headers and overlapping entries
@pytest.mark.parametrize("kind", ["csv", "npz", "shard npz", "shard parquet"])
def test_damaged_files_are_a_line_and_no_traceback(kind, tmp_path, tally):
    sound, suffix = problem_file(kind)

    @many(150)
    @given(damage(sound))
    def check_file(content):
        tally("files", f"`pnpnet solve` of a damaged {kind}: at most one line of error, no traceback")
        path = tmp_path / f"problem.{suffix}"
        path.write_bytes(content)
        code, out, err = run_main(*solving(kind, path))
        assert code in (0, 1, 2)
        if code == 2:
            assert err.startswith(f"pnpnet: {path}")
            assert err.count("\n") == 1
        elif suffix in ("csv", "npz") and not kind.startswith("shard"):
            assert json.loads(out)["n"] >= 3

    path = tmp_path / f"sound.{suffix}"
    path.write_bytes(sound)
    assert run_main(*solving(kind, path))[0] == 0
    check_file()


# No slash: what has one could be the name of a repository on the Hub.
WORDS = st.one_of(
    st.text(st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), max_size=12),
    st.sampled_from(
        ["800,800,320,240", "epnp", "p3p-ransac:threshold=2", "pnpnet-set:m=", "epnp:1", "nan", "-1", "--x"]
    ),
)


@many(300)
@given(
    st.lists(
        st.tuples(st.sampled_from(["--intrinsics", "--solver", "--threshold", "--batch-size", "--batch", ""]), WORDS),
        max_size=4,
    ),
    st.one_of(WORDS, st.none()),
)
def test_any_arguments_are_a_line_and_no_traceback(tally, tmp_path_factory, options, file):
    """Of a file that is not there, or of a sound one."""
    tally("files", "`pnpnet solve` with any arguments: a pose, or one line of error")
    sound = tmp_path_factory.getbasetemp() / "sound.csv"
    if not sound.exists():
        sound.write_bytes(problem_file("csv")[0])
    arguments = [x for pair in options for x in pair if x]
    code, out, err = run_main("solve", *arguments, "--", str(sound) if file is None else file)
    if code == 2:
        assert err.startswith("pnpnet: ")
        assert err.count("\n") == 1
    else:
        assert file is None
        assert json.loads(out)["n"] == 9
