"""Fuzz of solvers by name: shapes, dtypes, devices, scales, geometry without a pose."""

import contextlib
import copy
import re
import warnings
from functools import partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import BaseError, DeviceError, ShapeError
from strategies import (
    ANY,
    BOOL,
    COUNTS,
    ERRORS,
    SOLVERS,
    WORD,
    Seen,
    batches,
    check,
    finite,
    many,
    numbers,
    options,
    poses,
    same,
)

from kornia_pnpnet import (
    MLPInit,
    Normalize,
    PnPNet,
    Pose,
    PoseLoss,
    RobustWeightedLM,
    SetInit,
    SetLoss,
    create_solver,
    list_solvers,
    pose_covariance,
    pose_errors,
    solve_pnp,
    success,
)
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.init import P3P, RANSAC, EPnP, REPPnP, p3p
from kornia_pnpnet.losses import pose_distances
from kornia_pnpnet.metrics import PoseErrors, reliability
from kornia_pnpnet.peers import OpenCVPnP, OpenCVRansac, OpenCVUsac, PeerSolver, PoseLib, PyColmap

PEERS = {name: create_solver(name) for name in ("opencv-ransac", "poselib")}


@pytest.mark.parametrize("name", SOLVERS)
def test_solvers_take_anything(name):
    exactly = 9 if name.endswith("-n9") else None

    @many(40)
    @given(batches(exactly))
    def run(case):
        inputs, mask, weights, kinds = case
        check(SOLVERS[name](*inputs, weights=weights, mask=mask), inputs, kinds)

    run()


@pytest.mark.parametrize("name", SOLVERS)
def test_solvers_take_any_weights_noise_and_start(name):
    exactly = 9 if name.endswith("-n9") else None

    @many(30)
    @given(batches(exactly), st.data())
    def run(case, data):
        inputs, mask, _, kinds = case
        batch, count = inputs[0].shape[:2]
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
        check(SOLVERS[name](*inputs, weights=weights, mask=mask, init=init, **noise), inputs, kinds)

    run()


@many(30)
@given(batches(9), st.sampled_from(["pnpnet-set", "pnpnet-n9", "epnp-lm", "p3p-ransac"]))
def test_a_problem_is_solved_as_if_it_were_alone(case, name):
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
def test_units_of_world_and_camera_do_not_matter(name, world_power, pixel_power, seed):
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
def test_what_does_not_fit_is_an_error_of_ours(name, world, img, camera, dtype, other):
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
def test_fewer_than_three_pairs_are_refused(name, n):
    with pytest.raises(ShapeError):
        SOLVERS[name](torch.zeros(2, n, 3), torch.zeros(2, n, 2), torch.eye(3))


@many(40)
@given(batches())
def test_matrices_take_anything(case):
    inputs, _, weights, _ = case
    matrix = solve_pnp(*inputs, weights)
    ok = SOLVERS["pnpnet-set"](*inputs, weights).ok
    assert matrix.isnan().all((1, 2)).equal(~ok)
    assert matrix[ok].isfinite().all()


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


@pytest.mark.slow
@pytest.mark.parametrize("name", GRAPHS)
def test_solvers_stay_where_their_inputs_are(name):
    solvers = {device: copy.deepcopy(SOLVERS[name]).to(device) for device in DEVICES}

    @many(15)
    @given(st.sampled_from(DEVICES), calls(9 if name.endswith("-n9") else None))
    def run(device, call):
        result, guess = solvers[device].with_guess(**moved(call, device, call))
        expected = SOLVERS[name](**call)
        for ours, there in zip((*result[:5], *result.init), (*expected[:5], *expected.init), strict=True):
            assert ours.device.type == guess.weights.device.type == device
            assert (ours.shape, ours.dtype) == (there.shape, there.dtype)

    run()


@many(80)
@given(st.sampled_from([*SOLVERS, *PEERS]), st.sampled_from(DEVICES), calls(9), st.data())
def test_inputs_on_different_devices_are_an_error_of_ours(name, device, call, data):
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
def test_tensors_on_different_devices_are_an_error_of_ours(name, device, data):
    function, tensors = FUNCTIONS[name]
    function(*tensors)
    which = data.draw(st.lists(st.integers(0, len(tensors) - 1), min_size=1, max_size=len(tensors) - 1, unique=True))
    with pytest.raises(DeviceError, match=f"on {device}"):
        function(*(x.to(device) if i in which else x for i, x in enumerate(tensors)))


def tensors_of(case):
    """All tensors of a batch, and a function of them that solves it."""
    inputs, mask, weights, _ = case
    others = {name: value for name, value in (("weights", weights), ("mask", mask)) if value is not None}

    def solve(solver, *tensors):
        return solver(*tensors[:3], **dict(zip(others, tensors[3:], strict=True)))

    return (*inputs, *others.values()), solve


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning")
@pytest.mark.parametrize("name", GRAPHS)
def test_vmap_is_a_larger_batch(name):
    solver = SOLVERS[name]

    @many(15)
    @given(batches(9 if name.endswith("-n9") else None))
    def run(case):
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
def test_compiled_solvers_take_anything(name, monkeypatch):
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
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # that it was not compiled
            check(solver(*case[0], weights=case[2], mask=case[1]), case[0], case[3])
        tensors, solve = tensors_of(case)
        same(solve(solver, *tensors), solve(SOLVERS[name], *tensors))

    run()
    torch.compiler.reset()


SAMPLING = {"threshold": ANY, "iterations": COUNTS, "confidence": ANY, "seed": COUNTS}


MAKERS = {
    "RobustWeightedLM": (
        RobustWeightedLM,
        options(
            m=COUNTS,
            kernel=WORD,
            step=ANY,
            damping=ANY,
            robustness=ANY,
            shared=BOOL,
            update=WORD,
            by_residual=COUNTS,
            backward=WORD,
            last=COUNTS,
        ),
    ),
    "MLPInit": (lambda n=9, **sizes: MLPInit(n, **sizes), options(n=COUNTS, world_scale=ANY, img_scale=ANY)),
    "SetInit": (SetInit, options(width=COUNTS, layers=COUNTS, heads=COUNTS, hidden=COUNTS, starts=COUNTS)),
    "EPnP": (EPnP, options(iterations=COUNTS, algebraic_weight=ANY)),
    "REPPnP": (REPPnP, options(max_error=ANY, quantile=ANY, null_iterations=COUNTS, rigid_iterations=COUNTS)),
    "RANSAC": (
        partial(RANSAC, P3P()),
        options(threshold=ANY, world_threshold=ANY, scorer=WORD, max_samples=COUNTS, confidence=ANY, seed=COUNTS),
    ),
    "Normalize": (Normalize, options(f_const=ANY)),
    "OpenCVPnP": (OpenCVPnP, options(method=WORD)),
    "OpenCVRansac": (OpenCVRansac, options(**SAMPLING, method=WORD, refine=BOOL)),
    "OpenCVUsac": (OpenCVUsac, options(**SAMPLING, method=WORD)),
    "PoseLib": (PoseLib, options(threshold=ANY, min_iterations=COUNTS, max_iterations=COUNTS, confidence=ANY)),
    "PyColmap": (PyColmap, options(threshold=ANY, loss_scale=ANY, min_iterations=COUNTS, max_iterations=COUNTS)),
}


@pytest.mark.parametrize("name", MAKERS)
def test_parts_of_any_options(name):
    make, chosen = MAKERS[name]
    problems = SyntheticProblems(n=12, batch_size=3, seed=0).batch(0)
    made = Seen()
    with contextlib.suppress(ImportError):
        make()

    @many(60)
    @given(chosen)
    def run(values):
        part = made(lambda: make(**values))
        if part is None:
            return
        key = {"RobustWeightedLM": "refine", "Normalize": "normalize"}.get(name, "init")
        solver = part if isinstance(part, PeerSolver) else PnPNet(**{"init": EPnP(), key: part})
        n = values.get("n", 9)
        finite(*solver(problems.world_points[:, :n], problems.img_points[:, :n], problems.intrinsics)[:4])

    run()
    made.both()


def test_solvers_of_any_name_and_options():
    made = Seen()
    chosen = options(m=COUNTS, threshold=ANY, iterations=COUNTS, seed=COUNTS, confidence=ANY, views=COUNTS, unknown=ANY)

    @many(150)
    @given(st.sampled_from(list_solvers()) | WORD, chosen)
    def run(name, values):
        solver = made(lambda: create_solver(name, **values), (*ERRORS, ImportError, FileNotFoundError))
        if solver is not None:
            number = re.search(r"-n(\d+)$", name)
            problems = SyntheticProblems(n=int(number[1]) if number else 9, batch_size=2, seed=0).batch(0)
            finite(*solver(*problems[:3])[:4])

    run()
    made.both()


@many(60)
@given(batches(), st.data(), st.sampled_from(["pnpnet-set", "epnp-lm", "p3p-ransac"]))
def test_cameras_of_kornia_take_anything(case, data, name):
    (world, img, matrices), mask, weights, _ = case
    batch = len(world)
    pose = data.draw(poses(batch, world.dtype))
    camera = pose.camera(matrices, 480, 640)
    assert pose.matrix.shape == (batch, 4, 4)
    assert pose.matrix[:, :3, 3].equal(pose.translation)
    assert camera.extrinsics.equal(pose.matrix)
    if batch:  # Kornia's quaternions have at least one
        torch.testing.assert_close(pose.se3.matrix(), pose.matrix, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(camera.intrinsics[:, :3, :3], matrices, rtol=0, atol=0, equal_nan=True)
    ours, plain = (SOLVERS[name](world, img, x, weights=weights, mask=mask) for x in (camera, matrices))
    for one, other in zip(ours[:5], plain[:5], strict=True):
        assert one.equal(other)
