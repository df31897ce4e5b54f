"""Errors, success and its interval; distances, the losses over both stages, and that of the true pose's likelihood."""

import itertools
import math

import numpy as np
import pytest
import torch
from helpers import assert_same, finite
from kornia.core.exceptions import BaseError
from laws import PAIRS, Case, make, make_bad
from torch import nn
from torch.utils import _pytree as pytree

from kornia_pnpnet import Noise, PnPResult, Pose, PoseLoss, SetLoss, Starts, create_solver, pose_covariance
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.likelihood import monte_carlo_pose_loss
from kornia_pnpnet.losses import pose_distances
from kornia_pnpnet.metrics import PoseErrors, pose_errors, reliability, success, success_rate

DOUBLE = torch.float64


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 9e-4, 1.1e-3, 1.0, math.pi / 2, math.pi - 1e-7, math.pi])
def test_errors_of_a_known_motion(angle, random_rotations):
    base = random_rotations(50, seed=1)
    here, there = torch.tensor([[1.0, 2, 3], [1, 5, 7]], dtype=torch.float64).unsqueeze(1).expand(2, 50, 3)
    estimate, truth = Pose(random_rotations(50, angle=angle, seed=2) @ base, here), Pose(base, there)
    errors = pose_errors(estimate, truth)
    expected = torch.full((50,), math.degrees(angle), dtype=torch.float64)
    torch.testing.assert_close(errors.rotation_error_deg, expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(errors.translation_error, torch.full((50,), 5.0).double())
    single = pose_errors(*(Pose(*(x.float() for x in pose)) for pose in (estimate, truth))).rotation_error_deg
    torch.testing.assert_close(single, expected.float(), rtol=1e-2, atol=1e-4)  # small angles are kept, too


def test_success_needs_both_and_is_strict():
    errors = PoseErrors(torch.tensor([0.99, 1.0, 0.99, 1.01]), torch.tensor([0.19, 0.19, 0.2, 0.21]))
    assert success(errors).tolist() == [True, False, False, False]
    assert success(errors, 2.0, 0.3).tolist() == [True] * 4
    assert success(errors, 2.0, torch.tensor([0.1, 0.2, 0.3, 0.1])).tolist() == [False, True, True, False]
    assert not success(PoseErrors(torch.tensor([math.nan, 0.1]), torch.tensor([0.1, math.nan]))).any()
    errors = PoseErrors(torch.tensor([0.5, 2.0]), torch.tensor([0.5, 0.5]))
    for limit in (1, 1.0, np.float32(1.0), np.int64(1), torch.tensor(1.0), torch.ones(2)):
        assert success(errors, max_translation=limit).tolist() == [True, False]
    with pytest.raises(BaseError, match="max_rotation_deg"):
        success(errors, torch.ones(2, 1))


@pytest.mark.parametrize(("successes", "count", "low", "high"), [(81, 263, 0.2553, 0.3662), (0, 20, 0.0, 0.1611)])
def test_the_interval_is_wilsons(successes, count, low, high):
    """R. G. Newcombe, "Two-sided confidence intervals for the single proportion", 1998, table I, method 3."""
    outcome = torch.tensor([True] * successes + [False] * (count - successes))
    rate, mirrored = success_rate(outcome), success_rate(~outcome)
    assert (rate.total, rate.rate) == (count, pytest.approx(successes / count))
    assert (rate.low, rate.high) == pytest.approx((low, high), rel=0, abs=6e-5)
    assert (mirrored.low, mirrored.high) == pytest.approx((1 - rate.high, 1 - rate.low))


def test_chances_that_come_true_have_no_calibration_error():
    generator = torch.Generator().manual_seed(1)
    chances = 0.5 * torch.rand(200_000, generator=generator, dtype=torch.float64)
    outcomes = torch.rand(200_000, generator=generator, dtype=torch.float64) < chances
    found = reliability(chances.view(2, -1), outcomes.view(2, -1))
    assert found.number.sum() == 200_000
    assert found.expected_error < 0.01
    assert found.predicted[5:].isnan().all()  # no chance was that high
    assert reliability(2.0 * chances, outcomes).expected_error == pytest.approx(0.25, abs=0.01)


@pytest.mark.parametrize("unit", [1e-30, 1e30])
def test_lengths_neither_overflow_nor_underflow(unit):
    truth = Pose(torch.eye(3)[None], torch.zeros(1, 3))
    estimate = Pose(torch.eye(3)[None], unit * torch.tensor([[3.0, 0.0, 4.0]]))
    for lengths in (pose_errors(estimate, truth)[1], pose_distances(estimate, truth)[1]):
        torch.testing.assert_close(lengths / unit, torch.tensor([5.0]))


def scaled(pose):
    return Pose(pose.rotation, 1000.0 * pose.translation)


def solved(problems, init, refined):
    batch, n = problems.world_points.shape[:2]
    ones = torch.ones(batch, n, dtype=torch.float64)
    return PnPResult(*refined, ones, ones[:, 0], torch.ones(batch, dtype=torch.bool), init)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.1, 1.0, math.pi])
def test_distances_have_their_closed_forms_and_bounded_gradients(angle, random_rotations):
    base = random_rotations(20, seed=1)
    zeros = torch.zeros(20, 3, dtype=torch.float64)
    moved = (zeros + angle * torch.tensor([2.0, 3.0, 6.0])).requires_grad_()
    turned = (base if angle == 0.0 else random_rotations(20, angle=angle, seed=2) @ base).requires_grad_()
    rotation, translation = pose_distances(Pose(turned, moved), Pose(base, zeros))
    expected = torch.full((20,), 2 * math.sqrt(2) * math.sin(angle / 2), dtype=torch.float64)
    torch.testing.assert_close(rotation, expected, rtol=1e-9, atol=1e-14)
    torch.testing.assert_close(translation, torch.full((20,), 7.0 * angle, dtype=torch.float64))
    for x, distance in ((turned, rotation), (moved, translation)):
        (gradient,) = torch.autograd.grad(distance.sum(), x)
        assert (gradient.flatten(1).norm(dim=-1) <= 1 + 1e-6).all()
        assert angle != 0.0 or not gradient.any()


def test_the_total_is_the_weighted_sum_with_the_ramp(make_problems, perturb, random_rotations):
    p = make_problems()
    init, shift = perturb(p.pose, angle=0.3, shift=2.0), torch.tensor([0.3, 0.0, -0.4], dtype=torch.float64)
    refined = Pose(random_rotations(7, angle=0.1) @ p.pose.rotation, p.pose.translation + shift)
    loss = PoseLoss(rotation=2.0, translation=0.3, init_translation=0.07, refined=5.0)
    for ramp in (0.0, 0.25, 1.0):
        terms = loss(solved(p, init, refined), p, ramp)
        expected = 2.0 * terms.init_rotation + 0.07 * terms.init_translation
        expected = expected + ramp * 5.0 * (2.0 * terms.refined_rotation + 0.3 * terms.refined_translation)
        torch.testing.assert_close(terms.total, expected)
        torch.testing.assert_close(terms.refined_rotation, torch.tensor(2 * math.sqrt(2) * math.sin(0.05)).double())
        torch.testing.assert_close(terms.refined_translation, torch.tensor(0.5).double())


def test_the_first_translation_is_compared_at_the_centroid(make_problems, random_rotations):
    """A first guess that turns the world about its centroid has no translation error."""
    p = make_problems()
    turned = random_rotations(7, angle=0.5) @ p.pose.rotation
    kept = p.pose.translation + ((p.pose.rotation - turned) @ p.world_points.mean(1)[..., None])[..., 0]
    terms = PoseLoss()(solved(p, Pose(turned, kept), p.pose), p)
    assert terms.init_translation < 1e-6
    assert terms.init_rotation > 0.1
    padded = {x: nn.functional.pad(getattr(p, x), (0, 0, 0, 1), value=math.nan) for x in ("world_points", "img_points")}
    assert_same(PoseLoss()(solved(p, Pose(turned, kept), p.pose), p._replace(**padded)), terms)


def test_saturation_bounds_each_problem(make_problems):
    p = make_problems()
    for distance in (1e-3, 1.0, 1e3, 1e12):
        far = Pose(p.pose.rotation, p.pose.translation + distance * torch.eye(3).double()[0])
        total = PoseLoss(translation=1.0, saturation=0.5)(solved(p, p.pose, far), p).total
        torch.testing.assert_close(total, torch.tensor(distance / (1 + distance / 0.5)).double(), rtol=1e-6, atol=0)
        assert total <= 0.5
    first_guess = PoseLoss(init_translation=1.0, saturation=0.5)(solved(p, far, p.pose), p)
    torch.testing.assert_close(first_guess.total, torch.tensor(1e12).double())


def terms_of(loss, problems, refined, hypotheses, noise=None, weights=None, ramp=1.0):
    """The loss of a result that was refined from these hypotheses."""
    first, others = hypotheses[0], hypotheses[1:]
    stacked = Pose(*(torch.stack(parts, 1) for parts in zip(*others, strict=True))) if others else None
    weights = problems.inliers.double() if weights is None else weights
    result = solved(problems, first, refined)._replace(weights=weights)
    return loss(result, problems, ramp, Starts(first, weights, result.ok, stacked, noise))


def test_a_perfect_set_result_costs_nothing(make_problems, perturb):
    p = make_problems(outliers=3)
    hypotheses = [perturb(p.pose, angle=1.0), p.pose]
    terms = terms_of(SetLoss(every=0.0), p, p.pose, hypotheses)
    assert terms.total < 1e-5
    assert terms.weights < 1e-5
    half = torch.full(p.inliers.shape, 0.5, dtype=torch.float64)
    terms = terms_of(SetLoss(), p, p.pose, hypotheses, weights=half)
    torch.testing.assert_close(terms.weights, torch.tensor(math.log(2.0), dtype=torch.float64))


def test_without_ramp_the_refinement_has_no_gradient(make_problems, perturb):
    p = make_problems()
    first, refined = (Pose(*(x.clone().requires_grad_() for x in perturb(p.pose, seed=seed))) for seed in (1, 2))
    for terms in (PoseLoss()(solved(p, first, refined), p, 0.0), terms_of(SetLoss(), p, refined, [first], ramp=0.0)):
        first.rotation.grad = None
        terms.total.backward()
        assert first.rotation.grad.any()
        assert refined.rotation.grad is None
        assert refined.translation.grad is None


def test_the_best_hypothesis_counts_and_a_little_all_of_them(make_problems, perturb):
    p = make_problems()
    near, far = perturb(p.pose, angle=0.1, shift=0.0), perturb(p.pose, angle=1.0, shift=0.0)
    few, many = ([near], [far, near, far])
    alone, several = (terms_of(SetLoss(every=0.0, starts=3), p, p.pose, x).total for x in (few, many))
    torch.testing.assert_close(alone, several)
    only_far = terms_of(SetLoss(every=0.0), p, p.pose, [far]).total
    mixed = terms_of(SetLoss(every=0.3, starts=3), p, p.pose, many).total
    torch.testing.assert_close(mixed, 0.7 * alone + 0.3 * (alone + 2 * only_far) / 3)


def test_the_set_loss_has_no_unit(make_problems, perturb):
    p = make_problems(outliers=2)
    refined, first = perturb(p.pose, angle=0.01), perturb(p.pose, angle=0.3)
    large = p._replace(world_points=1000.0 * p.world_points, pose=scaled(p.pose))
    small_loss = terms_of(SetLoss(), p, refined, [first]).total
    torch.testing.assert_close(terms_of(SetLoss(), large, scaled(refined), [scaled(first)]).total, small_loss)


def test_the_true_noise_is_the_likeliest(make_problems):
    p = make_problems(batch=3000, outliers=2)

    def term(img, world):
        noise = Noise(*(torch.full(p.inliers.shape, x, dtype=torch.float64) for x in (img, world)))
        return terms_of(SetLoss(), p, p.pose, [p.pose], noise).noise

    true = term(1.0, 0.05)
    assert all(term(*wrong) > true for wrong in ((2.0, 0.05), (0.1, 0.05), (1.0, 0.1), (1.0, 0.025), (2.0, 0.1)))


def test_losses_of_bad_problems_are_finite():
    _, _, call = make_bad(Case("pnpnet-set", noise="sigma"))
    leaves = [x.requires_grad_() for x in pytree.tree_leaves(call)]
    result, starts = create_solver("pnpnet-set").double().with_starts(**call)
    p = SyntheticProblems(n=PAIRS, batch_size=len(result.ok), dtype=torch.float64).batch(0)
    p.world_points[~result.ok] = torch.nan
    for terms in (SetLoss()(result, p, 1.0, starts), PoseLoss()(result, p)):
        finite(terms, torch.autograd.grad(terms.total, leaves, retain_graph=True, materialize_grads=True))


def problems(n=30, batch=4, seed=5, **noise):
    return SyntheticProblems(n=n, batch_size=batch, seed=seed, dtype=DOUBLE, **noise).batch(0)


def loss_of(p, hypothesis=None, **options):
    torch.manual_seed(0)
    return monte_carlo_pose_loss(p.pose, p.pose if hypothesis is None else hypothesis, *p[:3], **options)


def test_integral_by_the_prior_alone():
    """Where the noise is large, plain Monte Carlo over the prior finds the same integral."""
    p = problems(n=12, batch=2)
    loss = loss_of(p, img_sigma=20000.0, samples=4000, kernel="cauchy")
    plain = loss_of(p, [], img_sigma=20000.0, samples=60000, rounds=0, kernel="cauchy")
    torch.testing.assert_close(loss, plain, rtol=0.0, atol=0.1)


def test_hypotheses_find_other_modes():
    p = problems(n=40, world_sigma=0.0, img_sigma=0.0)
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=DOUBLE))
    # Half of the pairs see the scene, the other half the scene turned upside down around its centre.
    centre = p.world_points.mean(1, keepdim=True)
    even = (torch.arange(40) % 2 == 0).to(DOUBLE)
    world = torch.where(even.bool()[:, None], p.world_points, (p.world_points - centre) @ turn + centre)
    rotation = p.pose.rotation @ turn
    other = Pose(rotation, p.pose.translation + ((p.pose.rotation - rotation) @ centre.mT)[..., 0])
    arguments = (world, p.img_points, p.intrinsics)
    options = {"img_sigma": 2.0, "kernel": "truncated", "scale": 4.0, "samples": 600, "rounds": 0}
    torch.manual_seed(0)
    none = Pose(rotation, torch.nan * other.translation)
    one, two, spoilt = (monte_carlo_pose_loss(p.pose, x, *arguments, **options) for x in ([], other, none))
    assert (spoilt != 0).all()
    sides = (p.pose, even), (other, 1.0 - even)
    first, second = (pose_covariance(x, *arguments, img_sigma=2.0, weights=y.expand(4, 40)).logdet() for x, y in sides)
    torch.testing.assert_close(two - one, torch.log1p((0.5 * (second - first)).exp()), rtol=0.0, atol=0.2)


@pytest.mark.parametrize("of_pixels", [True, False])
def test_gradient_of_the_integral(of_pixels):
    """Of many samples, along a random direction, it equals central differences: so the loss teaches the noise."""
    p = problems(n=12, batch=2)
    generator = torch.Generator().manual_seed(1)
    direction = torch.randn(p.img_points.shape, generator=generator, dtype=DOUBLE)
    turn = torch.randn(2, 2, generator=generator, dtype=DOUBLE)

    def loss(shift):
        torch.manual_seed(0)
        pixels = p.img_points + shift * direction * of_pixels
        factor = 300.0 * torch.eye(2, dtype=DOUBLE) + shift * turn * (not of_pixels)
        options = {"img_cov": (factor @ factor.mT).expand(2, 12, 2, 2), "samples": 60000, "rounds": 0}
        return monte_carlo_pose_loss(p.pose, p.pose, p.world_points, pixels, p.intrinsics, **options).sum()

    shift = torch.zeros((), dtype=DOUBLE, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(shift), shift)
    with torch.no_grad():
        difference = (loss(torch.tensor(20.0)) - loss(torch.tensor(-20.0))) / 40.0
    torch.testing.assert_close(gradient, difference, rtol=0.05, atol=2e-3)
    torch.testing.assert_close(torch.func.grad(loss)(shift.detach()), gradient)


def test_units_of_the_likelihood():
    """A density per unit of the world: a thousand times the unit is a thousand times the density, in each direction."""
    p = problems()
    large = p._replace(world_points=1000.0 * p.world_points, pose=scaled(p.pose))
    metres, millimetres = loss_of(p, img_sigma=2.0, world_sigma=0.05), loss_of(large, img_sigma=2.0, world_sigma=50.0)
    torch.testing.assert_close(millimetres, metres + 3.0 * math.log(1000.0))


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4])
def test_gradient_from_nothing(dtype, size):
    generator = torch.Generator().manual_seed(3)
    p = SyntheticProblems(n=16, batch_size=8, seed=2, dtype=dtype).batch(0)
    live = [(size * torch.randn(8, 16, k, generator=generator)).to(dtype).requires_grad_() for k in (3, 2)]
    sigma = torch.full((8, 16), 50.0, dtype=dtype, requires_grad=True)
    loss = monte_carlo_pose_loss(p.pose, p.pose, *live, p.intrinsics, img_sigma=sigma)
    loss.sum().backward()
    assert loss.isfinite().all()
    for tensor in (*live, sigma):
        assert tensor.grad.isfinite().all()
        assert (tensor.grad.flatten(1).abs().amax(1) > 0).all()


def test_padding_does_not_change_the_likelihood():
    p, mask = problems(n=20), torch.arange(20).expand(4, 20) < 16
    shorter = loss_of(p._replace(world_points=p.world_points[:, :16], img_points=p.img_points[:, :16]), img_sigma=2.0)
    world = p.world_points.masked_fill(~mask[..., None], torch.nan).requires_grad_()
    padded = loss_of(p._replace(world_points=world), img_sigma=torch.where(mask, 2.0, -1.0), mask=mask)
    padded.sum().backward()
    torch.testing.assert_close(padded, shorter)
    assert world.grad.isfinite().all()
    assert not world.grad[:, 16:].any()


def test_the_likelihood_of_bad_problems_costs_nothing_and_changes_no_other():
    case = Case("epnp-lm", noise="sigma")
    kinds, sound, bad = make_bad(case)
    _, truth = make(case, len(sound["weights"]))
    leaves, losses = [x.requires_grad_() for x in bad.values()], []
    for call in (sound, bad):
        torch.manual_seed(0)
        losses.append(monte_carlo_pose_loss(truth, truth, **call))
    assert torch.equal(losses[1][::2], losses[0][::2])
    assert not losses[1][1::2].any(), kinds
    for gradient in torch.autograd.grad(losses[1].sum(), leaves):
        assert gradient.isfinite().all()
        assert gradient[::2].any()
        assert not gradient[1::2].any()
    box = torch.tensor([*itertools.product((-1.0, 1.0), repeat=3)])[None]
    centre = Pose(torch.eye(3)[None], torch.zeros(1, 3))  # the camera stands at the centroid
    assert monte_carlo_pose_loss(centre, centre, box, box[..., :2], torch.eye(3), img_sigma=1.0).item() == 0.0
    away = Pose(torch.eye(3)[None], torch.tensor([[0.0, 0.0, 5.0]]))
    seen = box[..., :2] / (box[..., 2:] + 5.0)
    assert monte_carlo_pose_loss(away, away, box, seen, torch.eye(3), img_sigma=0.0, world_sigma=0.1).abs().item() > 0.1
