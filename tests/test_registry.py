"""Fuzz of solvers by name: shapes, dtypes, devices, scales, geometry without a pose."""

import copy
import re

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import DeviceError
from strategies import ANY, COUNTS, ERRORS, SOLVERS, WORD, Seen, batches, check, finite, many, numbers, options

from kornia_pnpnet import Pose, create_solver, list_solvers
from kornia_pnpnet.data import SyntheticProblems

PEERS = {name: create_solver(name) for name in ("opencv-ransac", "poselib")}


@st.composite
def calls(draw, n=None):
    """Arguments of a solver by name, some of them missing, and what is wrong with each problem."""
    (world, img, camera), mask, weights, kinds = draw(batches(n))
    batch, count = world.shape[:2]
    if draw(st.booleans()):
        weights = draw(numbers(world.dtype, (batch, count)))
        # The first pair is the one that is spoiled.
        kinds = ["nothing" if weight == 0 else kind for kind, weight in zip(kinds, weights[:, 0], strict=True)]
    if mask is not None and batch and draw(st.booleans()):
        mask[0] = False  # no pair of the first problem
        kinds[0] = "one point"
    sigma = st.none() | numbers(world.dtype, (), (batch,), (batch, count))
    translation = 10.0 * torch.randn(batch, 3, generator=torch.Generator().manual_seed(batch))
    init = Pose(torch.eye(3, dtype=world.dtype).expand(batch, 3, 3), translation.to(world.dtype))
    call = {"world_points": world, "img_points": img, "intrinsics": camera, "weights": weights, "mask": mask}
    call |= {"init": draw(st.sampled_from([None, init])), "img_sigma": draw(sigma), "world_sigma": draw(sigma)}
    return {name: value for name, value in call.items() if value is not None}, kinds


@pytest.mark.parametrize("name", SOLVERS)
def test_solvers_take_anything(name):
    @many(50)
    @given(calls(9 if name.endswith("-n9") else None))
    def run(case):
        call, kinds = case
        check(SOLVERS[name](**call), list(call.values())[:3], kinds)

    run()


#: ``meta`` has shapes and no values: whoever looks at one, or makes a tensor somewhere else, raises there.
DEVICES = ["meta", *(["cuda"] if torch.cuda.is_available() else [])]


GRAPHS = [name for name in SOLVERS if name != "p3p-ransac"]  # RANSAC looks at values


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
    def run(device, case):
        call, _ = case
        result, guess = solvers[device].with_starts(**moved(call, device, call))
        expected = SOLVERS[name](**call)
        for ours, there in zip((*result[:5], *result.init), (*expected[:5], *expected.init), strict=True):
            assert ours.device.type == guess.weights.device.type == device
            assert (ours.shape, ours.dtype) == (there.shape, there.dtype)

    run()


@many(80)
@given(st.sampled_from([*SOLVERS, *PEERS]), st.sampled_from(DEVICES), calls(9), st.data())
def test_inputs_on_different_devices_are_an_error_of_ours(name, device, case, data):
    call = dict(list(case[0].items())[:3]) if name in PEERS else case[0]
    names = data.draw(st.lists(st.sampled_from(list(call)), min_size=1, max_size=len(call) - 1, unique=True))
    with pytest.raises(DeviceError, match=f"on {device}"):
        {**SOLVERS, **PEERS}[name](**moved(call, device, names))


def test_solvers_of_any_name_and_options():
    made = Seen()
    chosen = options(m=COUNTS, threshold=ANY, iterations=COUNTS, seed=COUNTS, confidence=ANY, views=COUNTS, unknown=ANY)

    @many(150)
    @given(st.sampled_from(list_solvers()) | WORD, chosen)
    def run(name, values):
        solver = made(lambda: create_solver(name, **values), (*ERRORS, ImportError, FileNotFoundError))
        if solver is not None:
            number = re.search(r"-n(\d+)", name)
            problems = SyntheticProblems(n=int(number[1]) if number else 9, batch_size=2, seed=0).batch(0)
            finite(*solver(*problems[:3])[:4])

    run()
    made.both()


# --- torch.func -------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning")
@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")  # PyTorch's own use of it in forward mode
@pytest.mark.parametrize(
    "name", [x for x in list_solvers() if not x.startswith(("opencv", "kornia-rs", "poselib", "pycolmap"))]
)
def test_transforms_of_every_solver_of_ours(name):
    """First derivatives against ``backward``, second against central differences of it, ``vmap`` against a loop.

    Pixels move along three directions. Where the pose is found from a start that is a constant, derivatives leave out
    what the start would change, which the last iterations nearly forget: hence the tolerance of second derivatives.
    """
    number = re.search(r"-n(\d+)", name)
    chosen = {"m": 2} if name.endswith("-lm") or "pnpnet-n" in name else {}
    chosen |= {"pnpnet-set": {"m": 8, "effort": "fixed"}, "ransac-epnp-lm": {"max_samples": 20}}.get(name, {})
    p = SyntheticProblems(n=int(number[1]) if number else 8, batch_size=2, seed=3, dtype=torch.float64).batch(0)
    solver = create_solver(name, **chosen).double()
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(3, *p.img_points.shape, generator=generator).double()
    mixture = torch.randn(24, generator=generator).double()

    def outputs(world_points, img_points, intrinsics):
        result = solver(world_points, img_points, intrinsics)
        parts = (*result.pose, *result.init)
        return torch.cat([x.flatten(-2) if x.shape[-2:] == (3, 3) else x for x in parts], -1)

    def moved(shift):
        img_points = p.img_points + (shift[:, None, None, None] * directions).sum(0)
        return outputs(p.world_points, img_points, p.intrinsics)

    def loss(shift):
        return (moved(shift) @ mixture).sum()

    def gradient(shift):
        leaf = shift.clone().requires_grad_()
        return torch.autograd.grad(loss(leaf), leaf)[0]

    zero, steps = torch.zeros(3).double(), 1e-3 * torch.eye(3).double()
    first = gradient(zero)
    second = torch.stack([(gradient(step) - gradient(-step)) / 2e-3 for step in steps])
    assert first.all()
    assert second.any()

    def close(found, expected, tolerance):
        assert (found - expected).norm() <= tolerance * expected.norm()

    close(torch.func.grad(loss)(zero), first, 1e-7)
    close(torch.einsum("boi,o->i", torch.func.jacrev(moved)(zero), mixture), first, 1e-7)
    exact = name != "pnpnet-set"  # its mixture of residuals is a constant of the gradient
    if exact:
        close(torch.autograd.functional.hessian(loss, zero), second, 2e-3)
        close(torch.func.jacrev(torch.func.jacrev(loss))(zero), second, 2e-3)
    close(torch.func.jvp(loss, (zero,), (steps[0],))[1], 1e-3 * first[0], 1e-3)

    close(torch.func.jacfwd(loss)(zero), first, 1e-3)
    if exact:
        close(torch.func.hessian(loss)(zero), second, 2e-3)

    def each(img_points, world_points, intrinsics):
        return outputs(world_points, img_points, intrinsics) @ mixture

    problems = p.img_points, p.world_points, p.intrinsics
    if "ransac" in name:
        with pytest.raises(NotImplementedError, match="vmap"):
            torch.func.vmap(each)(*problems)
        return
    close(torch.func.vmap(each)(*problems), torch.stack([each(*x) for x in zip(*problems, strict=True)]), 1e-7)
    by_problem = torch.func.vmap(torch.func.grad(each))(*problems)
    close((by_problem * directions).flatten(1).sum(1), first, 1e-6)
