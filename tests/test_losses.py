"""The distances, and the losses over both stages."""

import math

import pytest
import torch
from laws import PAIRS, Case, make_bad
from strategies import finite
from torch.utils import _pytree as pytree

from kornia_pnpnet import Noise, PnPResult, Pose, PoseLoss, SetLoss, Starts, create_solver
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.losses import pose_distances

EPS = 1e-6


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
        assert (gradient.flatten(1).norm(dim=-1) <= 1 + EPS).all()
        assert angle != 0.0 or not gradient.any()


def test_the_total_is_the_weighted_sum_with_the_ramp(make_problems, perturb, random_rotations):
    p = make_problems()
    init = perturb(p.pose, angle=0.3, shift=2.0)
    shift = torch.tensor([0.3, 0.0, -0.4], dtype=torch.float64)
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
    centroid = p.world_points.mean(1)
    kept = p.pose.translation + ((p.pose.rotation - turned) @ centroid[..., None])[..., 0]
    terms = PoseLoss()(solved(p, Pose(turned, kept), p.pose), p)
    assert terms.init_translation < EPS
    assert terms.init_rotation > 0.1


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

    def scaled(pose):
        return Pose(pose.rotation, 1000.0 * pose.translation)

    large = p._replace(world_points=1000.0 * p.world_points, pose=scaled(p.pose))
    small_loss = terms_of(SetLoss(), p, refined, [first]).total
    torch.testing.assert_close(terms_of(SetLoss(), large, scaled(refined), [scaled(first)]).total, small_loss)


def test_the_true_noise_is_the_likeliest(make_problems):
    """Among sigmas that are off by a factor of two or more."""
    p = make_problems(batch=3000, outliers=2)
    shape = p.inliers.shape

    def term(img, world):
        noise = Noise(*(torch.full(shape, x, dtype=torch.float64) for x in (img, world)))
        return terms_of(SetLoss(), p, p.pose, [p.pose], noise).noise

    true = term(1.0, 0.05)
    assert all(term(*wrong) > true for wrong in ((2.0, 0.05), (0.1, 0.05), (1.0, 0.1), (1.0, 0.025), (2.0, 0.1)))


def test_losses_of_bad_problems_are_finite():
    _, _, call = make_bad(Case("pnpnet-set", noise="sigma"))
    leaves = [x.requires_grad_() for x in pytree.tree_leaves(call)]
    solver = create_solver("pnpnet-set").double()
    result, starts = solver.with_starts(**call)
    p = SyntheticProblems(n=PAIRS, batch_size=len(result.ok), dtype=torch.float64).batch(0)
    for terms in (SetLoss()(result, p, 1.0, starts), PoseLoss()(result, p)):
        finite(terms, torch.autograd.grad(terms.total, leaves, retain_graph=True, materialize_grads=True))
