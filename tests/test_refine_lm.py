"""Laws of the robust weighted Levenberg-Marquardt: the linear solve, one step, the loop and their gradients."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia_pnpnet.geometry import retract_additive
from strategies import KINDS, are_rotations, correspondences, finite, gradients_are_finite, many, options, poses

from kornia_pnpnet import Noise, Normalize, PnPNet, Pose, Problem, RobustWeightedLM, Starts, pose_errors
from kornia_pnpnet.core.linalg import solve_positive
from kornia_pnpnet.core.trees import iter_tensors, map_tensors
from kornia_pnpnet.judge.belief import explains
from kornia_pnpnet.refine.kernels import KERNELS
from kornia_pnpnet.refine.lm import BACKWARDS
from kornia_pnpnet.refine.residual import NormalEquations, lm_step, project, retract

DTYPES = (torch.float32, torch.float64)
UPDATES = ("retraction", "additive")
SMOOTH = [name for name in KERNELS if name != "truncated"]


def guess(pose, corr, *others):
    """A guess with unit weights and, optionally, other poses to start from."""
    more = map_tensors(lambda *poses: torch.stack(poses, 1), *others) if others else None
    return Starts(pose, torch.ones_like(corr.weights), others=more)


def of_pairs(function, corr):
    """The correspondences with a function applied to points, pixels and weights."""
    return Problem(*map(function, (corr.world_points, corr.img_points, corr.weights)), corr.focal)


def number(value, dtype=torch.float64):
    return torch.tensor(value, dtype=dtype)


def solve(hessian, rhs, damping):
    """``solve_positive`` of matrices (B, D, D) and vectors (B, D)."""
    rows = [row.unbind(-1)[: i + 1] for i, row in enumerate(hessian.unbind(1))]
    solution, solved = solve_positive(NormalEquations(rows, rhs.unbind(-1)), damping)
    return torch.stack(solution, -1), solved


def one_step(corr, pose, weights=None, *, gamma=1.0, damping=1e-3, update="retraction"):
    """``lm_step`` from a pose with fixed weights."""
    weights = corr.weights if weights is None else weights
    gamma, damping = number([gamma, damping], weights.dtype)
    return lm_step(corr, pose, project(pose, corr), weights, gamma, damping, additive=update == "additive")


def assert_equal(one, two):
    assert all(torch.equal(a, b) for a, b in zip(iter_tensors(one), iter_tensors(two), strict=True))


def assert_close(one, two, rtol=1e-9, atol=1e-9):
    for a, b in zip(iter_tensors(one), iter_tensors(two), strict=True):
        torch.testing.assert_close(a, b, rtol=rtol, atol=atol)


@pytest.fixture
def case(make_problems, correspond, perturb):
    """Problem, their true pose, and a pose ``near`` radians and units away from it."""

    def make(n=9, batch=7, *, near=0.05, dtype=torch.float64, **options):
        corr, truth = correspond(make_problems(n, batch, **options))
        start = perturb(truth, angle=near, shift=near)
        return map_tensors(lambda x: x.to(dtype), (corr, truth, start))

    return make


@pytest.fixture
def anywhere(random_rotations):
    """Random poses: a third among the points, a third about as far as the points extend, a third far off."""

    def make(batch, dtype):
        translation = torch.randn(batch, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        far = torch.logspace(-3, 3, 3, dtype=torch.float64)[torch.arange(batch) % 3]
        return map_tensors(lambda x: x.to(dtype), Pose(random_rotations(batch), far[:, None] * translation))

    return make


# --- the linear system ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("damping", [0.0, 10.0])
@pytest.mark.parametrize("dim", [1, 6])
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
    for factor in (number(damping), torch.full((100,), damping, dtype=torch.float64)):
        solution, solved = solve(hessian, rhs, factor)
        assert solved.all()
        assert ((solution - expected).norm(dim=-1) / expected.norm(dim=-1)).max() < 1e-9


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("rank", [0, 2, 5])
def test_singular_systems_are_reported_finite_and_change_no_other(rank, dtype, generator):
    root = torch.randn(5, 6, 9, generator=generator, dtype=dtype)
    whole = root.clone()
    root[2, :, rank:] = 0.0  # 6 rows in `rank` columns
    root.requires_grad_()
    rhs = torch.randn(5, 6, generator=generator, dtype=dtype).requires_grad_()
    damping = torch.zeros((), dtype=dtype, requires_grad=True)
    solution, solved = solve(root @ root.mT, rhs, damping)
    assert solved.tolist() == [True, True, False, True, True]
    assert solution.isfinite().all()
    others = [0, 1, 3, 4]
    assert torch.equal(solution[others], solve(whole @ whole.mT, rhs, damping)[0][others])
    torch.where(solved[:, None], solution, 0.0).sum().backward()
    assert all(tensor.grad.isfinite().all() for tensor in (root, rhs, damping))
    assert not root.grad[2].any()
    assert not rhs.grad[2].any()
    missing = torch.diag(torch.tensor([1.0, 2, 0, 3, 4, 5], dtype=dtype))[None]  # damping does not help an empty row
    solution, solved = solve(missing, torch.ones(1, 6, dtype=dtype), number(0.1, dtype))
    assert not solved
    assert solution.isfinite().all()


# --- the step -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("n", [3, 9, 50])
def test_zero_residual_gives_zero_step(n, update, case):
    corr, pose, _ = case(n, noise=False)
    residual = torch.stack(project(pose, corr).residual, -1)
    corr = corr._replace(img_points=residual + corr.img_points)  # residual 0 to the last bit
    step = one_step(corr, pose, update=update)
    # The additive update converts the rotation to a rotation vector and back.
    atol = 1e-12 if update == "retraction" else 1e-9
    torch.testing.assert_close(step.pose.rotation, pose.rotation, rtol=0, atol=atol)
    torch.testing.assert_close(step.pose.translation, pose.translation, rtol=0, atol=1e-10)


@pytest.mark.parametrize("update", UPDATES)
def test_the_step_is_the_damped_gauss_newton_step(update, case, generator):
    corr, _, pose = case(9, outliers=2)
    weights = torch.rand(7, 9, generator=generator, dtype=torch.float64)
    step = one_step(corr, pose, weights, gamma=0.7, damping=0.3, update=update)
    move = {"additive": retract_additive, "retraction": retract}[update]

    def residual(delta):
        return torch.cat(project(move(pose, delta), corr).residual, 1)

    at = torch.zeros(7, 6, dtype=torch.float64)
    J = torch.autograd.functional.jacobian(lambda x: residual(x).sum(0), at).movedim(0, 1)  # (B, 2N, 6)
    JW = J.mT * torch.cat((weights, weights), 1)[:, None]
    H = JW @ J
    H = H + 0.3 * torch.diag_embed(H.diagonal(dim1=-2, dim2=-1))
    delta = -0.7 * torch.linalg.solve(H, JW @ residual(at)[..., None])[..., 0]
    # Of the additive update autograd differentiates kornia's series near the identity, accurate to 2e-10.
    tolerance = 1e-7 if update == "additive" else 1e-10
    assert_close(step.pose.matrix, move(pose, delta).matrix, tolerance, tolerance)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("update", UPDATES)
def test_where_the_equations_have_no_solution_the_pose_stays(update, dtype, case):
    corr, _, start = case(dtype=dtype)
    weights = corr.weights.clone()
    weights[2], weights[3, 2:] = 0.0, 0.0  # no pair, two pairs
    weights.requires_grad_()
    step = one_step(corr, start, weights, damping=0.0, update=update)
    assert step.solved.tolist() == [True, True, False, False, True, True, True]
    # The additive update converts the rotation to a rotation vector and back.
    atol = 0.0 if update == "retraction" else 1e-9 if dtype == torch.float64 else 1e-6
    torch.testing.assert_close(step.pose.rotation[2:4], start.rotation[2:4], rtol=0, atol=atol)
    assert torch.equal(step.pose.translation[2:4], start.translation[2:4])
    step.pose.matrix.sum().backward()
    assert weights.grad.isfinite().all()
    assert weights.grad.flatten(1).any(1).tolist() == step.solved.tolist()


# --- convergence -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize(("n", "batch"), [(4, 7), (6, 7), (9, 1000), (50, 1)])
def test_classical_lm_finds_the_truth_without_noise(n, batch, update, case):
    corr, truth, start = case(n, batch, noise=False, near=0.02)
    # With the fixed damping the weakest direction of four points, nearly flat in some problems, converges slowly.
    refined = RobustWeightedLM(m=100 if n == 4 else 30, update=update)(corr, guess(start, corr))
    errors = pose_errors(refined.pose, truth)
    assert errors.rotation_error_deg.max() < 1e-6
    assert errors.translation_error.max() < 1e-7
    assert refined.ok.all()
    assert refined.cost.max() < 1e-6


@pytest.mark.parametrize("update", UPDATES)
def test_three_points_are_met_exactly(update, case):
    corr, _, start = case(3, 1000, noise=False, near=0.01)
    refined = RobustWeightedLM(m=50, update=update, reject_worse=True)(corr, guess(start, corr))
    after, before = (project(pose, corr).sq_residual.amax(-1).sqrt() for pose in (refined.pose, start))
    # Near a danger cylinder two of the solutions of P3P meet and the convergence is slow there.
    assert (after < 1e-6).double().mean() >= 0.99
    assert (after < before).all()


@pytest.mark.parametrize("kernel", KERNELS)
def test_outliers_end_with_little_weight(kernel, make_problems, correspond, perturb):
    problems = make_problems(12, 50, outliers=2)
    corr, truth = correspond(problems)
    lm = RobustWeightedLM(m=30, kernel=kernel, robustness={"power": 1.5}.get(kernel))
    refined = lm(corr, guess(perturb(truth, angle=0.005, shift=0.005), corr))
    median = refined.weights.median(-1, keepdim=True).values
    light = (refined.weights < 0.5 * median) if kernel != "truncated" else refined.weights == 0
    assert light[~problems.inliers].double().mean() > 0.9
    assert refined.ok.double().mean() > 0.95


@pytest.mark.parametrize(("kernel", "update"), [*((kernel, "retraction") for kernel in KERNELS), ("power", "additive")])
def test_rejecting_worse_steps_never_raises_the_cost(kernel, update, case):
    near = 0.005 if kernel == "truncated" else 0.5  # that kernel is blind beyond its scale
    corr, _, start = case(9, 100, outliers=3, near=near)
    options = {"kernel": kernel, "update": update, "reject_worse": True}
    costs = [RobustWeightedLM(m, **options)(corr, guess(start, corr)).cost for m in range(12)]
    for before, after in itertools.pairwise(costs):
        assert (after <= before * (1 + 1e-12)).all()
    assert (costs[-1] < costs[0]).double().mean() > 0.9
    if kernel == "power":  # the law can fail: without rejection, steps from far away do raise the cost of some problems
        costs = [
            RobustWeightedLM(m, update=update, reject_worse=False)(corr, guess(start, corr)).cost for m in range(3)
        ]
        assert ((costs[1] > costs[0]) | (costs[2] > costs[1])).any()


# --- cost and judgement ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", KERNELS)
def test_points_behind_the_camera_never_lower_the_cost(kernel, case):
    corr, truth, _ = case(9, 200, outliers=3)
    lm = RobustWeightedLM(m=0, kernel=kernel)  # which returns the guess and judges it
    in_front = project(truth, corr).in_front
    for shift in (0.5, 1.0, 2.0, 5.0, 100.0):
        back = Pose(truth.rotation, truth.translation - shift * number([0.0, 0, 1]))
        behind = in_front & ~project(back, corr).in_front
        only = corr._replace(weights=behind.double())  # judge just the pairs that went behind
        cost_front, cost_back = (lm(only, guess(pose, only)).cost for pose in (truth, back))
        assert (cost_back >= cost_front).all()
    assert behind.all()
    good, bad = lm(corr, guess(truth, corr)), lm(corr, guess(back, corr))
    assert_equal((good.pose, bad.pose), (truth, back))
    assert (bad.cost >= good.cost).all()
    assert (bad.cost == bad.cost.max()).all()
    assert good.ok.double().mean() > 0.9
    assert not bad.ok.any()
    assert not bad.weights.any()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "unit"), [(5, 1e-30), (9, 1e30), (10, 1.0)])
def test_explains_compares_two_weighted_quantiles(n, unit, dtype, generator):
    """Counted in integers, with weights of 0, ties, and shares of exactly 60 %."""
    batch = 400
    prior = torch.randint(0, 4, (batch, n), generator=generator)
    prior[: batch // 2], prior[-20:] = 1, 0
    pixels = 100.0 * torch.randint(-3, 4, (batch, n, 2), generator=generator, dtype=dtype)  # with ties
    # From 0 to beyond the limit, in steps that no sum of squares above meets by rounding.
    residual = 10.3 * torch.randint(0, 9, (batch, n), generator=generator).to(dtype)
    in_front = torch.rand(batch, n, generator=generator) < 0.9
    # Points whose projections by the identity are the pixels plus the residuals, at depth 1 or -1.
    plane = torch.stack((pixels[..., 0] + residual, pixels[..., 1]), -1) / 100.0
    world = torch.cat((plane, in_front[..., None].to(dtype) * 2 - 1), -1)
    corr = Problem(world, pixels, torch.ones(batch, n, dtype=dtype), number(100.0, dtype))
    pose = Pose(torch.eye(3, dtype=dtype).expand(batch, 3, 3), torch.zeros(batch, 3, dtype=dtype))

    total = prior.sum(-1, keepdim=True)
    mean = (prior[..., None] * pixels.double()).sum(1, keepdim=True) / total[..., None].clamp(min=1)
    spread, order = (pixels - mean).norm(dim=-1).sort(-1)
    below = 5 * prior.gather(-1, order).cumsum(-1) >= 3 * total
    limit = 0.2 * spread.gather(-1, below.int().argmax(-1, keepdim=True))
    explained = in_front & (residual <= limit)
    expected = (5 * (prior * explained).sum(-1) >= 3 * total[:, 0]) & (
        (explained & (prior > 0)).sum(-1) >= (prior > 0).sum(-1).clamp(3, 4)
    )
    assert torch.equal(explains(project(pose, corr), corr, unit * prior.to(dtype)), expected)
    assert 0.1 < expected.double().mean() < 0.9
    far = Pose(pose.rotation, number([0.0, 0.0, 1e6], dtype).expand(batch, 3))  # the image shrinks to one point
    spread_out = spread.amin(-1) > 0
    assert not explains(project(far, corr), corr, corr.weights)[spread_out].any()


# --- one problem among many -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize(("n", "batch"), [(3, 1000), (6, 7), (50, 7)])
def test_a_problem_alone_is_itself_in_a_batch(n, batch, update, case):
    corr, _, start = case(n, batch, outliers=n // 4)
    lm = RobustWeightedLM(m=3, update=update, reject_worse=True)
    together = lm(corr, guess(start, corr))
    for i in (0, batch // 2, batch - 1):
        only = slice(i, i + 1)
        part, first = of_pairs(lambda x, only=only: x[only], corr), map_tensors(lambda x, only=only: x[only], start)
        alone = lm(part, guess(first, part))
        assert_close(map_tensors(lambda x, only=only: x[only], together), alone, rtol=1e-7)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e200, 0.0, None])
def test_a_bad_problem_changes_no_other_by_a_bit(bad, case):
    corr, _, start = case()
    spoilt = of_pairs(torch.clone, corr)
    for tensor in (spoilt.weights,) if bad is None else (spoilt.world_points, spoilt.img_points):
        tensor[2] = 0.0 if bad is None else bad
    for update in UPDATES:
        lm = RobustWeightedLM(m=10, update=update, reject_worse=True)
        sound, refined = (lm(x, guess(start, x)) for x in (corr, spoilt))
        assert sound.ok.all()
        assert refined.ok.tolist() == [i != 2 for i in range(7)]
        assert_equal(*(map_tensors(lambda x: x[torch.arange(7) != 2], x) for x in (refined, sound)))


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("n", [3, 9, 50])
def test_shuffled_pairs_give_the_same_pose(n, update, case, generator):
    corr, _, start = case(n, outliers=n // 4)
    shuffle = torch.randperm(n, generator=generator)
    mixed = of_pairs(lambda x: x[:, shuffle], corr)
    lm = RobustWeightedLM(m=3, update=update, reject_worse=True)
    straight, shuffled = lm(corr, guess(start, corr)), lm(mixed, guess(start, mixed))
    assert_close(straight.pose, shuffled.pose)
    assert_close(straight.weights[:, shuffle], shuffled.weights, rtol=1e-7)
    assert torch.equal(straight.ok, shuffled.ok)


@pytest.mark.parametrize("update", UPDATES)
def test_float32_is_close_to_float64(update, case):
    corr, _, start = case(9, 200, near=0.02)
    lm = RobustWeightedLM(m=10, update=update)
    double = lm(corr, guess(start, corr))
    low, low_start = map_tensors(torch.Tensor.float, (corr, start))
    single = lm(low, guess(low_start, low))
    assert {x.dtype for x in iter_tensors(single)} == {torch.float32, torch.bool}
    errors = pose_errors(map_tensors(torch.Tensor.double, single.pose), double.pose)
    assert errors.rotation_error_deg.median() < 1e-3
    assert errors.rotation_error_deg.max() < 0.05
    assert errors.translation_error.max() < 1e-2
    assert single.ok.all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("update", UPDATES)
def test_the_unit_of_the_world_does_not_matter(update, dtype, case):
    """To the bit, since powers of two round nothing: a world of micrometres, one of thousands of kilometres."""
    corr, _, start = case(9, 100, outliers=2, dtype=dtype)
    lm = RobustWeightedLM(m=5, update=update)
    here = lm(corr, guess(start, corr))
    for unit in (2.0**-20, 2.0**20):
        scaled = corr._replace(world_points=unit * corr.world_points)
        there = lm(scaled, guess(start._replace(translation=unit * start.translation), scaled))
        pose = here.pose._replace(translation=unit * here.pose.translation)
        assert_equal(there, here._replace(pose=pose))


# --- weights ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("kernel", KERNELS)
def test_integer_weights_equal_repeating_and_zero_equals_removing(kernel, update, case):
    """Wherever the weights come from. The cost is a mean over pairs: 6 of them with weights, 9 when repeated."""
    corr, _, start = case(7, outliers=1, near=0.01)
    times = torch.tensor([1, 3, 1, 0, 2, 1, 1])
    weights, there = times.double().expand(7, 7), times > 0
    repeated = of_pairs(lambda x: x.repeat_interleave(times, 1), corr)
    lm = RobustWeightedLM(m=3, kernel=kernel, update=update)
    expected = lm(repeated, guess(start, repeated))
    given = lm(corr._replace(weights=weights), guess(start, corr))
    guessed = lm(corr, Starts(start, weights))
    for refined in (given, guessed):
        assert_close(refined.pose, expected.pose)
        ends = times.cumsum(0)[there] - 1  # the last copy of each pair
        assert_close((refined.weights / weights)[:, there], expected.weights[:, ends], rtol=1e-7)
        assert not refined.weights[:, ~there].any()
    assert_close(given.cost * 6, expected.cost * 9, rtol=1e-7)
    assert torch.equal(given.ok, expected.ok)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("update", UPDATES)
def test_a_common_factor_of_the_weights_does_not_matter(update, dtype, case, anywhere):
    corr, _, start = case(9, 300, outliers=3, near=0.02, dtype=dtype)
    lm = RobustWeightedLM(m=5, update=update)
    here = lm(corr, guess(start, corr))
    tolerance = 1e-3 if dtype == torch.float32 else 1e-9
    for factor in (1e-30, 1e30):
        scaled = corr._replace(weights=factor * corr.weights)
        there = lm(scaled, guess(start, corr))
        assert_close(there.pose.matrix, here.pose.matrix, tolerance, tolerance)
        assert torch.equal(there.ok, here.ok)
        scaled, pose = map_tensors(lambda x: x.clone().requires_grad_(), (scaled, anywhere(300, dtype)))
        lm(scaled, guess(pose, corr)).pose.matrix.sum().backward()
        for tensor in (scaled.world_points, scaled.img_points, *pose, *lm.parameters()):
            assert tensor.grad.isfinite().all()


# --- last iterations without the guess's weights --------------------------------------------------------------------


def with_noise(start, corr, img_sigma):
    """A guess that states the noise of the pixels, and none of the world points."""
    sigma = torch.full_like(corr.weights, img_sigma)
    return guess(start, corr)._replace(noise=Noise(sigma, torch.zeros_like(sigma)))


@pytest.mark.parametrize("backward", ["unroll", "truncated", "implicit"])
def test_iterations_by_residual_ignore_the_guessed_weights_but_not_the_given_ones(backward, case, generator):
    corr, _, start = case(outliers=2)
    doubt = torch.rand(7, 9, generator=generator, dtype=torch.float64)
    lm = RobustWeightedLM(m=3, by_residual=1, backward=backward, reject_worse=False)
    first = RobustWeightedLM(m=2, reject_worse=False)(corr, Starts(start, doubt)).pose
    for weights in (torch.ones_like(doubt), doubt.flip(1)):
        refined = lm(corr._replace(weights=weights), Starts(start, doubt / weights))
        last = RobustWeightedLM(m=1, reject_worse=False)(corr._replace(weights=weights), guess(first, corr))
        assert_close(refined, last, rtol=1e-7)


def test_iterations_by_residual_correct_a_noise_that_is_stated_too_large(case, generator):
    corr, truth, start = case(12, 50, noise=False)
    pixels = corr.img_points + 0.5 * torch.randn(corr.img_points.shape, generator=generator, dtype=torch.float64)
    pixels[:, :2] += 60.0  # two outliers, by six times the stated noise of 10 pixels
    corr = corr._replace(img_points=pixels)
    common = {"m": 10, "kernel": "geman_mcclure", "robustness": 6.0}
    right, wrong, corrected = (
        RobustWeightedLM(by_residual=by_residual, **common)(corr, with_noise(start, corr, sigma))
        for by_residual, sigma in ((0, 0.5), (0, 10.0), (3, 10.0))
    )
    errors = [pose_errors(x.pose, truth).rotation_error_deg.median() for x in (right, wrong, corrected)]
    assert errors[1] > 3.0 * errors[0]
    assert errors[2] < 1.5 * errors[0]
    assert wrong.weights[:, :2].median() > 0.05
    assert corrected.weights[:, :2].median() < 1e-3
    assert corrected.weights[:, 2:].median() > 0.8
    # Noise that came with the correspondences stays as it is, in each problem that has any.
    noise = with_noise(start, corr, 10.0).noise
    partly = Noise(noise.img.where(torch.arange(50)[:, None] < 25, torch.nan), torch.full_like(noise.world, torch.nan))
    kept = RobustWeightedLM(by_residual=3, **common)(corr._replace(noise=partly), with_noise(start, corr, 10.0))
    torch.testing.assert_close(kept.pose.matrix[:25], wrong.pose.matrix[:25])
    torch.testing.assert_close(kept.weights[:25], wrong.weights[:25])
    torch.testing.assert_close(kept.pose.matrix[25:], corrected.pose.matrix[25:])


def test_iterations_by_residual_keep_a_noise_that_may_be_right(case, generator):
    corr, _, start = case(9, 300, noise=False)
    noise = torch.randn(corr.img_points.shape, generator=generator, dtype=torch.float64)
    noisy = corr._replace(img_points=corr.img_points + 2.0 * noise)
    kept, by_residual = (
        RobustWeightedLM(m=10, kernel="geman_mcclure", by_residual=x)(noisy, with_noise(start, corr, 2.0))
        for x in (0, 3)
    )
    moved = (kept.pose.matrix - by_residual.pose.matrix).flatten(1).abs().amax(1) > 1e-9
    assert moved.double().mean() <= 0.05  # two likelihood ratios of e³ each


@pytest.mark.parametrize("outliers", [0, 6])
def test_iterations_by_residual_find_a_larger_noise(outliers, case, generator):
    """Noise of 20 px is stated as 2 px: weights and verdict are close to those of the right statement."""
    corr, _, start = case(20, 100, noise=False, outliers=outliers)
    noise = torch.randn(corr.img_points.shape, generator=generator, dtype=torch.float64)
    noisy = corr._replace(img_points=corr.img_points + 20.0 * noise)
    lm = {x: RobustWeightedLM(m=10, kernel="geman_mcclure", robustness=5.0, by_residual=x) for x in (0, 5)}
    wrong, found, right = (lm[x](noisy, with_noise(start, corr, s)) for x, s in ((0, 2.0), (5, 2.0), (0, 20.0)))

    def apart(one):
        return (one.pose.matrix - right.pose.matrix).flatten(1).norm(dim=1).median()

    assert apart(found) < 0.3 * apart(wrong)
    assert found.ok.float().mean() >= right.ok.float().mean() - 0.02
    assert (found.weights > 0.5).sum() > 0.9 * (right.weights > 0.5).sum()


@pytest.mark.parametrize("backward", ["unroll", "implicit"])
def test_gradients_of_iterations_by_residual_without_any_noise_are_finite(backward, case):
    corr, truth, _ = case(6, noise=False)
    pixels = corr.img_points.clone().requires_grad_()
    lm = RobustWeightedLM(m=3, kernel="geman_mcclure", by_residual=1, backward=backward)
    refined = lm(corr._replace(img_points=pixels), with_noise(truth, corr, 1.0))
    (refined.pose.rotation.sum() + refined.pose.translation.sum() + refined.weights.sum()).backward()
    assert pixels.grad.isfinite().all()
    assert pixels.grad.any()
    assert_close(refined.pose, truth)


@pytest.mark.parametrize(("m", "most"), [(0, 0), (1, 1), (3, 1), (10, 3)])
def test_iterations_by_residual_come_after_the_choice_among_poses(m, most, case, perturb):
    corr, truth, start = case(outliers=2)
    starts = guess(start, corr, perturb(truth, seed=2))
    some, more = (RobustWeightedLM(m=m, by_residual=count)(corr, starts) for count in (most, most + 5))
    assert_equal(some, more)


# --- gradients --------------------------------------------------------------------------------------------------------

# Settings that converge soon: reweighting with 1/‖r‖ takes hundreds of iterations.
CONVERGING = {name: {"kernel": name, "shared": True, "robustness": {"power": 0.5}.get(name)} for name in SMOOTH}


@pytest.mark.parametrize(
    ("kernel", "shared", "update"),
    [
        ("power", False, "retraction"),
        ("power", False, "additive"),
        *((kernel, kernel != "huber", "retraction") for kernel in SMOOTH),
        ("cauchy", True, "additive"),
    ],
)
def test_gradcheck_through_the_unrolled_iterations(kernel, shared, update, case, generator):
    corr, _, start = case(6, 2, outliers=1, near=0.01)
    lm = RobustWeightedLM(m=3, kernel=kernel, shared=shared, update=update).double()
    names = list(dict(lm.named_parameters()))
    assert len(names) == 3

    # Pixels and world points near 1, so that one difference step suits all.
    def run(world, pixels, weights, factor, tangent, *raw):
        moved = Problem(world, 1000.0 * pixels, weights, corr.focal)
        first = Starts(retract(start, tangent), factor)
        refined = torch.func.functional_call(lm, dict(zip(names, raw, strict=True)), (moved, first))
        return (*refined.pose, refined.weights, refined.cost)

    weights = 0.5 + torch.rand(2, 6, generator=generator, dtype=torch.float64)
    inputs = [corr.world_points, corr.img_points / 1000.0, weights, torch.ones_like(weights)]
    inputs += [torch.zeros(2, 6, dtype=torch.float64), *(p.detach() for p in lm.parameters())]
    inputs = [x.clone().requires_grad_() for x in inputs]
    # The other cases are differentiated along random directions, which is faster.
    entry_by_entry = (kernel, update, shared) == ("power", "retraction", False)
    assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-4, rtol=1e-4, fast_mode=not entry_by_entry)


@pytest.mark.parametrize("backward", ["unroll", "truncated", "implicit"])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_gradients_are_finite_from_anywhere(kernel, backward, dtype, case, anywhere):
    """From random poses most points start behind the camera or far off, and may weigh next to nothing."""
    corr = case(9, 300, outliers=3, dtype=dtype)[0]
    shapes = ("lower", "default", "upper") if backward == "unroll" else ("default",)
    for shape, update in itertools.product(shapes, UPDATES):
        options = {"update": update, "backward": backward, "robustness": getattr(KERNELS[kernel], shape)}
        lm = RobustWeightedLM(m=5, kernel=kernel, **options)
        inputs, pose = map_tensors(lambda x: x.clone().requires_grad_(), (corr, anywhere(300, dtype)))
        refined = lm(inputs, guess(pose, corr))
        assert all(x.isfinite().all() for x in iter_tensors(refined))
        sum(x.sum() for x in iter_tensors(refined) if x.requires_grad).backward()
        assert all(x.grad.isfinite().all() for x in (inputs.world_points, inputs.img_points, inputs.weights))
        assert all(x.grad is None or x.grad.isfinite().all() for x in (*pose, *lm.parameters()))


@pytest.mark.parametrize(("backward", "m"), [("truncated", 5), ("truncated", 2), ("implicit", 5)])
@pytest.mark.parametrize("update", UPDATES)
def test_the_backward_pass_does_not_change_the_result(update, backward, m, case):
    corr, _, start = case(outliers=2)
    options = {"m": m, "update": update, "reject_worse": True}
    plain, other = RobustWeightedLM(**options), RobustWeightedLM(**options, backward=backward, last=2)
    assert_equal(plain(corr, guess(start, corr)), other(corr, guess(start, corr)))


@pytest.fixture
def gradients(case, generator):
    """Gradients by points, pixels, weights, start and hyperparameters of a function of a refinement's result.

    Of all problems, or of those whose last iterations did not move the pose any more.
    """
    corr, _, start = case(6, 20, outliers=1, near=0.01)
    probe = torch.randn(20, 4, 4, generator=generator, dtype=torch.float64)

    def of(lm, *, skip=0, converged=False):
        at = start
        with torch.no_grad():
            if skip:
                at = RobustWeightedLM(m=skip, reject_worse=False).double()(corr, guess(start, corr)).pose
            ends = [lm(corr, guess(at, corr), m=m).pose for m in (lm.m - 1, lm.m)]
            counted = (ends[1].matrix - ends[0].matrix).abs().amax((1, 2)) < 1e-12
            counted &= project(ends[1], corr).in_front.all(-1)  # else the pose diverged and stopped
        tangent = torch.zeros(20, 6, dtype=torch.float64)  # of the start: off the group its gradient means nothing
        leaves = [corr.world_points, corr.img_points, corr.weights, tangent]
        leaves = [x.clone().requires_grad_() for x in leaves]
        moved = corr._replace(world_points=leaves[0], img_points=leaves[1], weights=leaves[2])
        refined = lm(moved, guess(retract(at, leaves[3]), corr))
        loss = (probe * refined.pose.matrix).sum((1, 2))
        if converged:
            assert counted.double().mean() > 0.7
            loss = loss[counted]
        leaves += lm.parameters()
        return torch.autograd.grad(loss.sum(), leaves, allow_unused=True, materialize_grads=True)

    return of


def test_truncated_gradients_are_those_of_the_last_iterations(gradients):
    """From a constant pose: no gradient of the guess, nor of the hyperparameters before."""
    truncated = gradients(RobustWeightedLM(m=5, backward="truncated", last=2, reject_worse=False).double())
    last = gradients(RobustWeightedLM(m=2, reject_worse=False).double(), skip=3)
    assert_close(truncated[:3], last[:3], atol=1e-12)
    for a, b in zip(truncated[4:], last[4:], strict=True):
        torch.testing.assert_close(a[3:], b, rtol=1e-9, atol=1e-12)
        assert not a[:3].any()
        assert a[3:].any()
    assert last[3].any()
    assert not truncated[3].any()
    for m in (1, 2):  # nothing is cut off
        whole = gradients(RobustWeightedLM(m=m).double())
        assert_equal(whole, gradients(RobustWeightedLM(m=m, backward="truncated", last=2).double()))
        assert all(x.any() for x in whole)


@pytest.mark.parametrize("kernel", SMOOTH)
def test_implicit_gradients_are_those_of_unrolling_to_the_minimum(kernel, gradients):
    unrolled, implicit = (
        gradients(
            RobustWeightedLM(m=100, backward=b, reject_worse=False, **CONVERGING[kernel]).double(), converged=True
        )
        for b in ("unroll", "implicit")
    )
    for a, b in zip(unrolled, implicit, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-8 * a.abs().max().clamp(min=1.0))
    assert all(x.any() for x in implicit[:3])
    assert implicit[-1].any()
    # The start, the step length and the damping do not move a minimum.
    assert not any(x.any() for x in implicit[3:6])


def test_implicit_gradients_do_not_depend_on_the_unit_of_pixels(make_problems, perturb):
    """Nor where the pose is no minimum, and the Gauss-Newton matrix replaces that of Newton."""
    p = make_problems(n=8, batch=16).map(lambda x: x.double() if x.is_floating_point() else x)
    start = perturb(p.pose, angle=0.3)
    gradients = []
    for focal in (30.0, 3000.0):
        normalize = Normalize(f_const=focal, order=False)
        corr, frame = normalize(*p[:3])
        rays = (corr.img_points / focal).detach().requires_grad_()
        refine = RobustWeightedLM(1, kernel="cauchy", robustness=0.005 * focal, backward="implicit").double()
        guess = Starts(normalize.apply_to_pose(start, frame), torch.ones_like(corr.weights))
        refined = refine(corr._replace(img_points=focal * rays), guess)
        gradients.append(torch.autograd.grad(refined.pose.translation.sum(), rays)[0])
    # The scale of the kernel is stored in float32.
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-3, atol=1e-5)


def test_implicit_second_derivatives_are_those_of_unrolling_to_the_minimum(make_problems, perturb):
    p = make_problems(n=8, batch=2)
    direction = torch.randn_like(p.img_points)
    products = []
    for backward in ("unroll", "implicit"):
        refine = RobustWeightedLM(60, kernel="cauchy", step=1.0, damping=1e-4, robustness=3.0, backward=backward)
        img_points = p.img_points.clone().requires_grad_()
        result = PnPNet(None, refine).double()(p.world_points, img_points, p.intrinsics, init=perturb(p.pose))
        (gradient,) = torch.autograd.grad(
            result.rotation.sum() + result.translation.sum(), img_points, create_graph=True
        )
        products.append(torch.autograd.grad((gradient * direction).sum(), img_points)[0])
    assert (products[1] - products[0]).norm() < 1e-5 * products[0].norm()


@pytest.mark.parametrize(("backward", "grows"), [("unroll", True), ("truncated", False), ("implicit", False)])
def test_memory_of_the_backward_pass(backward, grows, case):
    """Only unrolling keeps more tensors the more iterations there are."""
    corr, _, start = case()
    pixels = corr.img_points.clone().requires_grad_()
    numbers = []

    def count(tensor):
        numbers[-1] += tensor.numel()
        return tensor

    for m in (3, 30):
        numbers.append(0)
        lm = RobustWeightedLM(m=m, shared=True, backward=backward, last=2)
        with torch.autograd.graph.saved_tensors_hooks(count, lambda tensor: tensor):
            lm(corr._replace(img_points=pixels), guess(start, corr))
    assert (numbers[1] > 5 * numbers[0]) == grows
    assert grows or numbers[1] == numbers[0]


# --- hyperparameters -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("shared", [True, False])
def test_hyperparameters_start_classical_and_stay_bounded(kernel, shared, case):
    corr, _, start = case(outliers=2, dtype=torch.float32)
    lm = RobustWeightedLM(m=4, kernel=kernel, shared=shared)
    learned = (lm.step, lm.damping, lm.robustness)
    for parameter, classical in zip(learned, (1.0, 1e-3, KERNELS[kernel].default), strict=True):
        torch.testing.assert_close(parameter(), torch.full((1 if shared else 4,), classical), rtol=1e-5, atol=0)
    assert len(list(lm.parameters())) == 3
    bounds = ((0.0, 2.0), (1e-8, 1e2), (KERNELS[kernel].lower, KERNELS[kernel].upper))
    for raw in (-50.0, 50.0):
        for parameter, (low, high) in zip(learned, bounds, strict=True):
            torch.nn.init.constant_(parameter.raw, raw)
            parameter.zero_grad()
            torch.testing.assert_close(parameter()[0].item(), low if raw < 0 else high, rtol=1e-4, atol=1e-12)
        refined = lm(corr, guess(start, corr))  # at the bounds themselves
        (refined.pose.rotation.sum() + refined.pose.translation.sum() + refined.cost.sum()).backward()
        assert all(x.isfinite().all() for x in iter_tensors(refined))
        assert all(p.grad.isfinite().all() for p in lm.parameters())


def test_unlearned_hyperparameters_take_no_gradient(case):
    corr, truth, _ = case()
    lm = RobustWeightedLM(learnable=False)
    assert not any(p.requires_grad for p in lm.parameters())
    assert not lm(corr, guess(truth, corr)).pose.rotation.requires_grad


# --- several starts -------------------------------------------------------------------------------------------------


@pytest.fixture
def near_and_far(case, perturb):
    """Problem, a pose near the truth and one far from it."""

    def make(**options):
        corr, truth, _ = case(**options)
        return corr, perturb(truth, angle=0.02), perturb(truth, angle=2.5, shift=2.0)

    return make


@pytest.mark.parametrize("options", [{}, {"reject_worse": True}, {"update": "additive"}], ids=str)
def test_the_best_of_several_starts_goes_on(options, near_and_far):
    """Near and far starts take turns: the result is that of the near one alone, also when stopped early."""
    corr, near, far = near_and_far(noise=False)
    turns = [torch.arange(7) % 3 == i for i in range(3)]
    starts = [
        Pose(torch.where(x[:, None, None], near.rotation, far.rotation), torch.where(x[:, None], *translations))
        for translations in [(near.translation, far.translation)]
        for x in turns
    ]
    for m, stop in ((1, None), (2, None), (5, None), (6, None), (6, 0), (6, 1), (6, 3), (6, 5)):
        lm = RobustWeightedLM(m, **options)
        best, alone = (lm(corr, guess(*x), m=stop) for x in ((starts[0], corr, *starts[1:]), (near, corr)))
        assert_close(best, alone, atol=1e-12)


@pytest.mark.parametrize("backward", ["unroll", "implicit", "truncated"])
def test_only_the_best_start_has_a_gradient(backward, near_and_far):
    corr, *poses = near_and_far()
    gradients = []
    for with_far in (True, False):
        (near, far), points = map_tensors(lambda x: x.clone().requires_grad_(), (poses, corr.world_points))
        first = guess(far, corr, near) if with_far else guess(near, corr)
        m = 4 if backward == "unroll" else 20  # implicit gradients are those of a minimum
        lm = RobustWeightedLM(m, robustness=0.0, backward=backward, last=12, reject_worse=False)
        refined = lm(corr._replace(world_points=points), first)
        leaves = (points, *near, *far)
        gradients.append(torch.autograd.grad(refined.pose.translation.sum(), leaves, materialize_grads=True))
    for together, alone in zip(*gradients, strict=True):
        torch.testing.assert_close(together, alone, rtol=1e-6, atol=1e-9)
    of_points, of_near, of_far = gradients[0][0], gradients[0][1:3], gradients[0][3:]
    assert of_points.flatten(1).any(1).all()
    assert all(x.flatten(1).any(1).all() == (backward == "unroll") for x in of_near)
    assert not any(x.any() for x in of_far)


def test_several_starts_are_compared_by_residual_where_the_last_iterations_are(case, perturb):
    """A guess that trusts only three outliers prefers the pose that fits them."""
    corr, near, _ = case(9, 5, noise=False)
    far = perturb(near, angle=0.5, shift=0.5)
    img_points = corr.img_points.clone()
    img_points[:, :3] = torch.stack([corr.focal * x[:, :3] for x in project(far, corr).plane_points], -1)
    corr = corr._replace(img_points=img_points)
    trust = torch.where(torch.arange(9) < 3, 1.0, 1e-6).double().expand(5, 9)
    first = guess(far, corr, near)._replace(weights=trust)
    misled, right = (
        RobustWeightedLM(m=4, kernel="geman_mcclure", robustness=10.0, step=0.0, by_residual=count)(corr, first).pose
        for count in (0, 1)
    )
    torch.testing.assert_close(misled, far)
    torch.testing.assert_close(right, near)


@pytest.mark.parametrize("spoilt", [torch.nan, torch.inf, 1e30])
def test_a_spoilt_start_is_never_the_best(spoilt, case):
    corr, _, start = case()
    bad = Pose(start.rotation, torch.full_like(start.translation, spoilt))
    lm = RobustWeightedLM(4)
    best = lm(corr, guess(bad, corr, start))
    assert_close(best.pose, lm(corr, guess(start, corr)).pose, atol=1e-12)
    assert best.ok.all()


# -- fuzz --------------------------------------------------------------------------------------------------------------


@many(80)
@given(
    correspondences(),
    st.integers(0, 4),
    options(
        kernel=KINDS,
        shared=st.booleans(),
        update=st.sampled_from(["retraction", "additive"]),
        reject_worse=st.booleans(),
        by_residual=st.integers(0, 3),
        backward=st.sampled_from(BACKWARDS),
    ),
    st.data(),
)
def test_refinements_take_anything(case, m, chosen, data):
    corr, tensors = case
    refine = RobustWeightedLM(m, **chosen).to(corr.world_points.dtype)
    pose = data.draw(poses(len(corr.world_points), corr.world_points.dtype))
    refined = refine(corr, Starts(pose, torch.ones_like(corr.weights)))
    finite(refined)
    are_rotations(refined.pose.rotation)
    gradients_are_finite(
        [*refined.pose, refined.cost], [*tensors, *(p for p in refine.parameters() if p.requires_grad)]
    )


@pytest.mark.parametrize("distance", [3.0, 10.0])
def test_a_far_start_does_not_diverge(distance, make_problems, correspond):
    """The default refiner comes home from a camera several times as far away, where plain iterations all diverge."""
    corr, truth = correspond(make_problems(20, 100))
    far = truth._replace(translation=distance * truth.translation)
    shares = []
    for changes in ({}, {"reject_worse": False}):
        refined = RobustWeightedLM(m=30, **changes)(corr, guess(far, corr))
        shares.append((pose_errors(refined.pose, truth).rotation_error_deg < 1.0).double().mean())
    assert shares[0] > 0.95
    assert shares[1] < 0.5
