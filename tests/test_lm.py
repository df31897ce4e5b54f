"""Laws of the robust weighted Levenberg-Marquardt: the solve, the step, the loop and their gradients."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from kornia.core.exceptions import BaseError

from kornia_pnpnet import Correspondences, Guess, Pose, RobustWeightedLM, pose_errors
from kornia_pnpnet.geometry import additive_tangent_map, linearize, project, retract, retract_additive
from kornia_pnpnet.lm import BoundedParameter, explains, lm_step, solve_damped
from kornia_pnpnet.robust import KERNELS

UPDATES = ("retraction", "additive")


def guess(pose, corr):
    return Guess(pose, torch.ones_like(corr.weights))


def one(value):
    return torch.tensor(value, dtype=torch.float64)


# --- the linear system ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
@pytest.mark.parametrize("dim", [1, 2, 6])
@pytest.mark.parametrize("scaling", ["even", "bad"])
def test_solve_damped_is_linalg_solve(dim, damping, scaling, generator):
    root = torch.randn(100, dim, dim + 3, generator=generator, dtype=torch.float64)
    rhs = torch.randn(100, dim, generator=generator, dtype=torch.float64)
    if scaling == "bad":
        root = root * torch.logspace(-8, 8, dim, dtype=torch.float64)[:, None]
    hessian = root @ root.mT
    damped = hessian + damping * torch.diag_embed(hessian.diagonal(dim1=-2, dim2=-1))
    # The reference is solved with a unit diagonal, where LU keeps its digits.
    scale = hessian.diagonal(dim1=-2, dim2=-1).rsqrt()
    expected = scale * torch.linalg.solve(scale[:, :, None] * damped * scale[:, None], scale * rhs)
    for factor in (one(damping), torch.full((100,), damping, dtype=torch.float64)):
        solution, solved = solve_damped(hessian, rhs, factor)
        assert solved.all()
        error = (solution - expected).norm(dim=-1) / expected.norm(dim=-1)
        assert error.max() < 1e-9


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rank", range(6))
def test_singular_systems_give_zero_and_spoil_no_other(rank, dtype, generator):
    root = torch.randn(5, 6, 9, generator=generator, dtype=dtype)
    root[2, :, rank:] = 0.0  # 6 rows in `rank` columns
    root.requires_grad_()
    rhs = torch.randn(5, 6, generator=generator, dtype=dtype).requires_grad_()
    damping = torch.zeros((), dtype=dtype, requires_grad=True)
    solution, solved = solve_damped(root @ root.mT, rhs, damping)
    assert solved.tolist() == [True, True, False, True, True]
    assert torch.equal(solution[2], torch.zeros(6, dtype=dtype))
    solution.sum().backward()
    for tensor in (root, rhs, damping):
        assert tensor.grad.isfinite().all()
    assert not root.grad[2].any()
    assert not rhs.grad[2].any()


def test_a_missing_unknown_is_singular_even_when_damped():
    hessian = torch.diag(torch.tensor([1.0, 2, 0, 3, 4, 5]))[None]
    solution, solved = solve_damped(hessian, torch.ones(1, 6), torch.tensor(0.1))
    assert not solved
    assert not solution.any()


def test_gradcheck_of_the_solve(generator):
    root = torch.randn(3, 4, 6, generator=generator, dtype=torch.float64, requires_grad=True)
    rhs = torch.randn(3, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    damping = torch.rand(3, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, b, c: solve_damped(a @ a.mT, b, c)[0], (root, rhs, damping))


# --- the step -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("additive", [False, True])
@pytest.mark.parametrize("n", [3, 4, 6, 9, 50])
def test_zero_residual_gives_zero_step(n, additive, make_problems, correspond):
    corr, pose = correspond(make_problems(n, noise=False))
    corr = corr._replace(img_points=project(pose, corr).residual + corr.img_points)  # to the last bit
    projection = project(pose, corr)
    step = lm_step(corr, pose, projection, corr.weights, one(1.0), one(1e-3), additive=additive)
    torch.testing.assert_close(step.pose.rotation, pose.rotation, rtol=0, atol=1e-9 if additive else 1e-12)
    torch.testing.assert_close(step.pose.translation, pose.translation, rtol=0, atol=1e-10)


@pytest.mark.parametrize("additive", [False, True])
@pytest.mark.parametrize("n", [4, 9, 50])
def test_a_tiny_step_is_a_descent(n, additive, make_problems, correspond, perturb):
    corr, truth = correspond(make_problems(n, outliers=1))
    pose = perturb(truth)
    projection = project(pose, corr)
    step = lm_step(corr, pose, projection, corr.weights, one(1e-4), one(1e-3), additive=additive)
    assert step.solved.all()
    before = projection.residual.square().sum((1, 2))
    after = project(step.pose, corr).residual.square().sum((1, 2))
    assert (after < before).all()


@pytest.mark.parametrize("additive", [False, True])
def test_the_step_is_the_damped_gauss_newton_step(additive, make_problems, correspond, perturb):
    corr, truth = correspond(make_problems(9, outliers=2))
    pose = perturb(truth)
    weights = torch.rand(7, 9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    step = lm_step(corr, pose, project(pose, corr), weights, one(0.7), one(0.3), additive=additive)
    linear = linearize(project(pose, corr), corr.focal, additive_tangent_map(pose) if additive else None)
    J = linear.jacobian.mT
    JW = linear.jacobian * torch.cat((weights, weights), 1)[:, None]
    H = JW @ J
    H = H + 0.3 * torch.diag_embed(H.diagonal(dim1=-2, dim2=-1))
    delta = -0.7 * torch.linalg.solve(H, JW @ linear.residual[..., None])[..., 0]
    expected = (retract_additive if additive else retract)(pose, delta)
    torch.testing.assert_close(step.pose.matrix, expected.matrix, rtol=1e-9, atol=1e-10)


# --- convergence -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize(("n", "batch"), [(4, 7), (6, 1), (6, 7), (9, 1), (9, 7), (9, 1000), (50, 1), (50, 7)])
def test_classical_lm_finds_the_truth_without_noise(n, batch, update, make_problems, correspond, perturb):
    corr, truth = correspond(make_problems(n, batch, noise=False))
    # With the fixed damping the weakest direction of four points, nearly flat in some problems, converges slowly.
    m = 100 if n == 4 else 30
    refined = RobustWeightedLM(m=m, update=update)(corr, guess(perturb(truth, angle=0.02, shift=0.02), corr))
    errors = pose_errors(refined.pose, truth)
    assert errors.rotation_error_deg.max() < 1e-6
    assert errors.translation_error.max() < 1e-7
    assert refined.ok.all()
    assert refined.cost.max() < 1e-6


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("batch", [1, 7, 1000])
def test_three_points_are_met_exactly(batch, update, make_problems, correspond, perturb):
    corr, truth = correspond(make_problems(3, batch, noise=False))
    start = perturb(truth, angle=0.01, shift=0.01)
    refined = RobustWeightedLM(m=50, update=update, reject_worse=True)(corr, guess(start, corr))
    residual = project(refined.pose, corr).residual.norm(dim=-1).amax(-1)
    # Near a danger cylinder two of the solutions of P3P meet and the convergence is slow there.
    assert (residual < 1e-6).double().mean() >= (1.0 if batch < 10 else 0.99)
    assert (residual < project(start, corr).residual.norm(dim=-1).amax(-1)).all()


@pytest.mark.parametrize("kernel", KERNELS)
def test_wrong_pairs_end_with_little_weight(kernel, make_problems, correspond, perturb):
    problems = make_problems(12, 50, outliers=2)
    corr, truth = correspond(problems)
    lm = RobustWeightedLM(m=30, kernel=kernel, robustness={"power": 1.5}.get(kernel))
    refined = lm(corr, guess(perturb(truth, angle=0.005, shift=0.005), corr))
    median = refined.weights.median(-1, keepdim=True).values
    wrong = (refined.weights < 0.5 * median) if kernel != "truncated" else refined.weights == 0
    assert wrong[~problems.inliers].double().mean() > 0.9
    assert refined.ok.double().mean() > 0.95


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("kernel", KERNELS)
def test_rejecting_worse_steps_never_raises_the_cost(kernel, update, make_problems, correspond, perturb):
    corr, truth = correspond(make_problems(9, 100, outliers=3))
    far = 0.005 if kernel == "truncated" else 0.5  # which sees nothing beyond its scale
    start = guess(perturb(truth, angle=far, shift=far), corr)
    costs = [
        RobustWeightedLM(m=m, kernel=kernel, update=update, reject_worse=True)(corr, start).cost for m in range(12)
    ]
    for before, after in itertools.pairwise(costs):
        assert (after <= before * (1 + 1e-12)).all()
    assert (costs[-1] < costs[0]).double().mean() > 0.9


def test_without_rejection_the_cost_may_rise(make_problems, correspond, perturb):
    """The test above can fail: from far away plain steps do raise the cost of some problems."""
    corr, truth = correspond(make_problems(9, 100, outliers=3))
    start = guess(perturb(truth, angle=0.5, shift=0.5), corr)
    costs = [RobustWeightedLM(m=m)(corr, start).cost for m in range(3)]
    assert ((costs[1] > costs[0]) | (costs[2] > costs[1])).any()


# --- cost and judgement ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", KERNELS)
def test_points_behind_the_camera_never_lower_the_cost(kernel, make_problems, correspond):
    corr, truth = correspond(make_problems(9, 200, outliers=3))
    lm = RobustWeightedLM(m=0, kernel=kernel)
    in_front = project(truth, corr).in_front
    for shift in (0.5, 1.0, 2.0, 5.0, 100.0):
        back = Pose(truth.rotation, truth.translation - shift * one([0.0, 0, 1]))
        behind = in_front & ~project(back, corr).in_front
        only = corr._replace(weights=behind.double())  # judge just the pairs that went behind
        cost_front, cost_back = (lm(only, guess(pose, only)).cost for pose in (truth, back))
        assert (cost_back >= cost_front).all()
    assert behind.all()
    everything = lm(corr, guess(back, corr)).cost
    assert (everything >= lm(corr, guess(truth, corr)).cost).all()
    assert (everything == everything.max()).all()


def test_the_cost_is_a_mean_over_the_pairs(make_problems, correspond, perturb):
    corr, truth = correspond(make_problems(9))
    twice = Correspondences(*(torch.cat((x, x), 1) for x in corr[:3]), corr.focal)
    pose = perturb(truth)
    lm = RobustWeightedLM(m=0)
    torch.testing.assert_close(lm(corr, guess(pose, corr)).cost, lm(twice, guess(pose, twice)).cost)
    empty = corr._replace(weights=torch.zeros_like(corr.weights))
    assert torch.equal(lm(empty, guess(pose, empty)).cost, torch.zeros(7).double())


def test_no_iteration_returns_the_guess_and_judges_it(make_problems, correspond, perturb):
    corr, truth = correspond(make_problems(9, noise=False))
    lm = RobustWeightedLM(m=0)
    good = lm(corr, guess(truth, corr))
    assert torch.equal(good.pose.matrix, truth.matrix)
    assert good.ok.all()
    back = Pose(truth.rotation, truth.translation - one([0.0, 0, 100]))
    bad = lm(corr, guess(back, corr))
    assert torch.equal(bad.pose.matrix, back.matrix)
    assert not bad.ok.any()
    assert not bad.weights.any()


def test_a_pose_that_puts_everything_at_one_point_explains_nothing(make_problems, correspond):
    corr, truth = correspond(make_problems(9, 50))
    far = Pose(truth.rotation, truth.translation + one([0.0, 0, 1e5]))
    assert not explains(project(far, corr), corr, corr.weights).any()
    assert explains(project(truth, corr), corr, corr.weights).all()


# --- one among many -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize(("n", "batch"), [(3, 7), (4, 7), (6, 7), (9, 7), (50, 7), (3, 1000), (9, 1000)])
def test_a_problem_alone_is_itself_in_a_batch(n, batch, update, make_problems, correspond, perturb):
    corr, truth = correspond(make_problems(n, batch, outliers=n // 4))
    start = perturb(truth)
    lm = RobustWeightedLM(m=3, update=update, reject_worse=True)
    together = lm(corr, guess(start, corr))
    for i in (0, batch // 2, batch - 1):
        part = Correspondences(*(x[i : i + 1] for x in corr[:3]), corr.focal)
        alone = lm(part, guess(Pose(*(x[i : i + 1] for x in start)), part))
        torch.testing.assert_close(together.pose.matrix[i : i + 1], alone.pose.matrix, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(together.weights[i : i + 1], alone.weights, rtol=1e-7, atol=1e-9)
        torch.testing.assert_close(together.cost[i : i + 1], alone.cost, rtol=1e-7, atol=1e-9)
        assert torch.equal(together.ok[i : i + 1], alone.ok)


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("n", [3, 4, 6, 9, 50])
def test_shuffled_pairs_give_the_same_pose(n, update, make_problems, correspond, perturb, generator):
    corr, truth = correspond(make_problems(n, outliers=n // 4))
    shuffle = torch.randperm(n, generator=generator)
    mixed = Correspondences(*(x[:, shuffle] for x in corr[:3]), corr.focal)
    start = perturb(truth)
    lm = RobustWeightedLM(m=3, update=update, reject_worse=True)
    straight, shuffled = lm(corr, guess(start, corr)), lm(mixed, guess(start, mixed))
    torch.testing.assert_close(straight.pose.matrix, shuffled.pose.matrix, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(straight.weights[:, shuffle], shuffled.weights, rtol=1e-7, atol=1e-9)
    assert torch.equal(straight.ok, shuffled.ok)


@pytest.mark.parametrize("update", UPDATES)
def test_float32_is_close_to_float64(update, make_problems, correspond, perturb):
    corr, truth = correspond(make_problems(9, 200))
    start = perturb(truth, angle=0.02, shift=0.02)
    lm = RobustWeightedLM(m=10, update=update)
    double = lm(corr, guess(start, corr))
    low = Correspondences(*(x.float() for x in corr))
    single = lm(low, guess(Pose(*(x.float() for x in start)), low))
    assert {x.dtype for x in (*single.pose, single.weights, single.cost)} == {torch.float32}
    errors = pose_errors(Pose(*(x.double() for x in single.pose)), double.pose)
    assert errors.rotation_error_deg.median() < 1e-3
    assert errors.rotation_error_deg.max() < 0.05
    assert errors.translation_error.max() < 1e-2
    assert single.ok.all()


# --- external weights -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("where", ["correspondences", "guess"])
@pytest.mark.parametrize("kernel", KERNELS)
def test_zero_weight_equals_removing(kernel, where, make_problems, correspond, perturb):
    corr, truth = correspond(make_problems(9, outliers=2))
    start = perturb(truth, angle=0.01, shift=0.01)
    weights = torch.ones(7, 9, dtype=torch.float64)
    weights[:, [1, 4]] = 0.0
    keep = [0, 2, 3, 5, 6, 7, 8]
    lm = RobustWeightedLM(m=3, kernel=kernel)
    if where == "guess":
        zero = lm(corr, Guess(start, weights))
    else:
        weighted = corr._replace(weights=weights)
        zero = lm(weighted, guess(start, weighted))
    part = Correspondences(*(x[:, keep] for x in corr[:3]), corr.focal)
    removed = lm(part, guess(start, part))
    torch.testing.assert_close(zero.pose.matrix, removed.pose.matrix, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(zero.weights[:, keep], removed.weights, rtol=1e-7, atol=1e-9)
    assert not zero.weights[:, [1, 4]].any()
    if where == "correspondences":
        torch.testing.assert_close(zero.cost, removed.cost, rtol=1e-9, atol=1e-9)
        assert torch.equal(zero.ok, removed.ok)


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("kernel", KERNELS)
def test_integer_weights_equal_repeating(kernel, update, make_problems, correspond, perturb):
    corr, truth = correspond(make_problems(6))
    start = perturb(truth, angle=0.01, shift=0.01)
    times = torch.tensor([1, 3, 1, 2, 1, 1])
    weighted = corr._replace(weights=times.double().expand(7, 6))
    repeated = Correspondences(*(x.repeat_interleave(times, 1) for x in corr[:3]), corr.focal)
    lm = RobustWeightedLM(m=3, kernel=kernel, update=update, reject_worse=True)
    one_way, other_way = lm(weighted, guess(start, weighted)), lm(repeated, guess(start, repeated))
    torch.testing.assert_close(one_way.pose.matrix, other_way.pose.matrix, rtol=1e-9, atol=1e-9)
    # The cost is a mean over pairs: 6 of them with weights, 9 when they are repeated.
    torch.testing.assert_close(one_way.cost * 6, other_way.cost * 9, rtol=1e-7, atol=1e-9)


def test_external_and_initial_weights_multiply(make_problems, correspond, perturb):
    corr, truth = correspond(make_problems(9))
    start = perturb(truth)
    weights = torch.rand(7, 9, dtype=torch.float64) + 0.1
    lm = RobustWeightedLM(m=3)
    inside = lm(corr._replace(weights=weights), guess(start, corr))
    outside = lm(corr, Guess(start, weights))
    torch.testing.assert_close(inside.pose.matrix, outside.pose.matrix, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(inside.weights, outside.weights)


# --- gradients --------------------------------------------------------------------------------------------------------

SMOOTH = [name for name in KERNELS if name != "truncated"]


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("shared", [True, False], ids=["shared", "per_iteration"])
@pytest.mark.parametrize("kernel", SMOOTH)
def test_gradcheck_through_the_unrolled_iterations(kernel, shared, update, make_problems, correspond, perturb):
    problems = make_problems(6, 2, outliers=1)
    corr, truth = correspond(problems)
    start = perturb(truth, angle=0.01, shift=0.01)
    lm = RobustWeightedLM(m=3, kernel=kernel, shared=shared, update=update).double()
    names = list(dict(lm.named_parameters()))
    assert len(names) == 3

    # Pixels and world points near 1, so that one difference step suits all.
    def run(world, pixels, weights, factor, tangent, *raw):
        moved = Correspondences(world, 1000.0 * pixels, weights, corr.focal)
        first = Guess(retract(start, tangent), factor)
        refined = torch.func.functional_call(lm, dict(zip(names, raw, strict=True)), (moved, first))
        return (*refined.pose, refined.weights, refined.cost)

    generator = torch.Generator().manual_seed(3)
    weights = 0.5 + torch.rand(2, 6, generator=generator, dtype=torch.float64)
    inputs = [
        corr.world_points,
        corr.img_points / 1000.0,
        weights,
        torch.ones_like(weights),
        torch.zeros(2, 6, dtype=torch.float64),
        *(p.detach() for p in lm.parameters()),
    ]
    inputs = [x.clone().requires_grad_() for x in inputs]
    assert (~problems.inliers).any()
    entry_by_entry = kernel == "power" and not shared  # the others along random directions, which is faster
    assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-4, rtol=1e-4, fast_mode=not entry_by_entry)


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_from_anywhere(kernel, update, dtype, make_problems, correspond, random_rotations):
    """From random poses most points start behind the camera or far off."""
    corr, _ = correspond(make_problems(9, 300, outliers=3))
    corr = Correspondences(*(x.to(dtype) for x in corr))
    world, pixels, weights = (x.clone().requires_grad_() for x in corr[:3])
    rotation = random_rotations(300).to(dtype).requires_grad_()
    translation = torch.randn(300, 3, generator=torch.Generator().manual_seed(0)).to(dtype).requires_grad_()
    lm = RobustWeightedLM(m=5, kernel=kernel, update=update)
    refined = lm(Correspondences(world, pixels, weights, corr.focal), guess(Pose(rotation, translation), corr))
    assert all(x.isfinite().all() for x in (*refined.pose, refined.weights, refined.cost))
    (
        refined.pose.rotation.sum() + refined.pose.translation.sum() + refined.weights.sum() + refined.cost.sum()
    ).backward()
    for tensor in (world, pixels, weights, rotation, translation, *lm.parameters()):
        assert tensor.grad.isfinite().all()


def test_unlearned_hyperparameters_take_no_gradient(make_problems, correspond):
    corr, truth = correspond(make_problems())
    lm = RobustWeightedLM(learnable=False)
    assert not any(p.requires_grad for p in lm.parameters())
    assert not lm(corr, guess(truth, corr)).pose.rotation.requires_grad


# --- hyperparameters -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("shared", [True, False])
def test_hyperparameters_start_classical_and_stay_bounded(kernel, shared):
    lm = RobustWeightedLM(m=4, kernel=kernel, shared=shared)
    like = torch.zeros((), dtype=torch.float64)
    for got, classical in zip(lm.hyperparameters(like), (1.0, 1e-3, KERNELS[kernel].default), strict=True):
        assert got.shape == (4,)
        torch.testing.assert_close(got, torch.full((4,), classical, dtype=torch.float64), rtol=1e-5, atol=0)
    assert all(p.numel() == (1 if shared else 4) for p in lm.parameters())
    bounds = ((0.0, 2.0), (1e-8, 1e2), (KERNELS[kernel].lower, KERNELS[kernel].upper))
    for raw in (-50.0, 50.0):
        with torch.no_grad():
            for parameter in lm.parameters():
                parameter.fill_(raw)
        for got, (low, high) in zip(lm.hyperparameters(like), bounds, strict=True):
            assert (got >= low * (1 - 1e-5)).all()
            assert (got <= high * (1 + 1e-5)).all()
            torch.testing.assert_close(got[0].item(), low if raw < 0 else high, rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("raw", [-50.0, 50.0])
@pytest.mark.parametrize("kernel", KERNELS)
def test_the_bounds_themselves_are_finite(kernel, raw, make_problems, correspond, perturb):
    corr, truth = correspond(make_problems(9, outliers=2, dtype=torch.float32))
    lm = RobustWeightedLM(kernel=kernel)
    with torch.no_grad():
        for parameter in lm.parameters():
            parameter.fill_(raw)
    refined = lm(corr, guess(perturb(truth), corr))
    (refined.pose.rotation.sum() + refined.pose.translation.sum() + refined.cost.sum()).backward()
    assert all(x.isfinite().all() for x in (*refined.pose, refined.weights, refined.cost))
    assert all(p.grad.isfinite().all() for p in lm.parameters())


@pytest.mark.parametrize("logarithmic", [False, True])
def test_a_bounded_parameter_is_what_it_was_set_to(logarithmic):
    for initial in (0.01, 0.011, 0.3, 4.9, 5.0):
        parameter = BoundedParameter(initial, size=3, lower=0.01, upper=5.0, logarithmic=logarithmic)
        torch.testing.assert_close(parameter(), torch.full((3,), initial), rtol=1e-4, atol=0)
    for initial in (0.0099, 5.01, -1.0, 9.0, math.nan):
        with pytest.raises(BaseError, match="between"):
            BoundedParameter(initial, size=1, lower=0.01, upper=5.0, logarithmic=logarithmic)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kernel": "tukey"}, "power.*tukey"),
        ({"update": "se3"}, "retraction.*se3"),
        ({"m": -1}, "-1"),
        ({"m": 2.5}, "2.5"),
        ({"step": 2.1}, "2.1"),
        ({"damping": 0.0}, "0.0"),
        ({"robustness": 3.5}, "3.5"),
    ],
)
def test_wrong_arguments_raise_and_say_what_came(arguments, message):
    with pytest.raises(BaseError, match=message):
        RobustWeightedLM(**arguments)


def test_the_config_rebuilds_the_module():
    lm = RobustWeightedLM(m=2, kernel="cauchy", robustness=3.0, shared=True, update="additive", reject_worse=True)
    again = RobustWeightedLM(**lm.config)
    assert again.config == lm.config
    assert "cauchy" in repr(lm)
    again.load_state_dict(lm.state_dict())


def test_power_with_shape_zero_is_least_squares(make_problems, correspond, perturb):
    p = make_problems(6, 20)
    corr, _ = correspond(p)
    lm = RobustWeightedLM(m=3, robustness=0.0)
    guess = Guess(correspond(p._replace(pose=perturb(p.pose)))[1], torch.ones_like(corr.weights))
    refined = lm(corr, guess)
    assert torch.equal(refined.weights, torch.ones_like(refined.weights))
    refined.cost.sum().backward()
    assert lm.robustness.raw.grad.isfinite().all()
