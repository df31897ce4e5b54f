"""Solvers by name: options of any kind, and the transforms of torch.func."""

import re

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from strategies import ANY, COUNTS, ERRORS, WORD, Seen, finite, many, options

from kornia_pnpnet import create_solver, list_solvers
from kornia_pnpnet.core.trees import iter_tensors
from kornia_pnpnet.data import SyntheticProblems


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


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("name", ["pnpnet-set", "pnpnet-n9", "epnp-lm", "reppnp-lm", "p3p-ransac"])
def test_solvers_stay_where_their_inputs_are(name, make_problems):
    p = make_problems(dtype=torch.float32).map(lambda x: x.cuda())
    result, starts = create_solver(name).cuda().with_starts(*p[:3])
    assert {x.device.type for x in iter_tensors((result, starts.weights))} == {"cuda"}


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
