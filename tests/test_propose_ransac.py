"""Laws of RANSAC: how samples are drawn and poses scored, and that the pose and its inliers are found."""

import itertools
import math

import pytest
import torch

from kornia_pnpnet import PnPNet, RobustWeightedLM, create_solver, pose_errors
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.judge.inliers import Thresholds, judge
from kornia_pnpnet.problem import State
from kornia_pnpnet.propose.p3p import P3P
from kornia_pnpnet.propose.ransac import RANSAC
from kornia_pnpnet.propose.sampling import (
    Samples,
    agreement_of_neighbours,
    draw,
    samples_needed,
)
from kornia_pnpnet.propose.scoring import Scene, as_pose
from kornia_pnpnet.propose.search import Search
from kornia_pnpnet.refine.residual import project

# --- samples ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "chances", [[0.5, 0.2, 0.0, 0.2, 0.1], [0.2] * 5 + [0.0]], ids=["some are likelier", "all are equally likely"]
)
@pytest.mark.parametrize("size", [1, 3])
def test_items_are_drawn_by_their_chances_and_none_twice(size, chances, generator):
    """Items one after the other in proportion to their probabilities among those that are left."""
    draws, upper = 40000, torch.tensor(chances, dtype=torch.float64).cumsum(-1)[None]
    subsets = draw(torch.rand(draws, size, generator=generator, dtype=torch.float64), upper)[0]
    likely = [i for i, chance in enumerate(chances) if chance]
    for order in itertools.permutations(likely, size):
        drawn = [chances[i] for i in order]
        expected = math.prod(chance / (1 - sum(drawn[:i])) for i, chance in enumerate(drawn))
        seen = (subsets == torch.tensor(order)).all(-1).double().mean().item()
        assert abs(seen - expected) < 4 * math.sqrt(expected / draws), order
    assert torch.isin(subsets, torch.tensor(likely)).all()
    assert (subsets.sort(-1).values.diff(dim=-1) > 0).all()


def test_neighbours_of_inliers_agree(generator):
    """Points of a wavy surface; the pixels of four fifths of them are anywhere."""
    flat = 6.0 * torch.rand(2, 200, 2, generator=generator, dtype=torch.float64)
    points = torch.cat((flat, 8.0 + flat.sin().sum(-1, keepdim=True)), -1)
    pixels = points[..., :2] / points[..., 2:]
    pixels[:, 40:] = torch.rand(2, 160, 2, generator=generator, dtype=torch.float64) * pixels.amax(1)[:, None]
    likely = agreement_of_neighbours(points, pixels, torch.ones(2, 200, dtype=torch.bool)).topk(20, dim=1).indices
    assert (likely < 40).double().mean() > 0.7  # 0.2 by chance


@pytest.mark.parametrize(("pairs", "size"), [(3, 3), (9, 7), (12, 4)])
def test_enumeration_has_every_subset_once(pairs, size):
    samples = Samples(torch.ones(2, pairs), size=size, most=1000, seed=0)
    total = math.comb(pairs, size)
    assert samples.totals.tolist() == [total, total]
    positions = samples.positions(torch.tensor([1, 0]), 0, total)
    assert sorted(map(tuple, positions[0].tolist())) == list(itertools.combinations(range(pairs), size))
    assert torch.equal(positions[0], positions[1])
    parts = [samples.positions(torch.tensor([1]), i, min(i + 5, total)) for i in range(0, total, 5)]
    assert torch.equal(torch.cat(parts, 1)[0], positions[0])


def test_only_pairs_with_a_weight_are_drawn_independent_of_other_problems(generator):
    there = torch.rand(20, 30, generator=generator) < torch.linspace(0.2, 0.8, 20)[:, None]
    there[:, :3] = True
    samples = Samples(there.double(), size=3, most=200, seed=0)
    assert 0 < (samples.totals < 200).sum() < 20, "some are enumerated"
    problems = torch.arange(20)
    positions = samples.positions(problems, 0, 200)
    assert there[problems[:, None, None], positions].all()
    assert (positions.sort(-1).values.diff(dim=-1) > 0).all()
    for i in (0, 7, 19):
        alone = Samples(there[i : i + 1, : 1 + int(there[i].nonzero().max())].double(), size=3, most=200, seed=0)
        alone = alone.positions(torch.tensor([0]), 10, 90)
        assert torch.equal(alone, samples.positions(torch.tensor([19, i]), 10, 90)[1:]), "nor of padding"


def test_even_garbage_has_one_answer_in_every_order_of_its_pairs():
    drawn = SyntheticProblems(n=60, batch_size=20, seed=5, outliers=OutlierMix(count=60), dtype=torch.float32).batch(0)
    world, img, intrinsics = drawn[:3]
    solver, order = create_solver("pnpnet-set"), torch.randperm(60, generator=torch.Generator().manual_seed(0))
    first, second = solver(world, img, intrinsics), solver(world[:, order], img[:, order], intrinsics)
    same = pose_errors(second.pose, first.pose).rotation_error_deg < 1.0
    assert same.double().mean() > 0.9  # 0.35 if samples are drawn by the places of the pairs


@pytest.mark.parametrize("size", [3, 7])
def test_the_number_of_samples_has_the_confidence(size):
    """By counting the subsets without an outlier."""
    count = 9
    for inliers, confidence in itertools.product(range(count + 1), (0.5, 0.9999)):
        subsets = list(itertools.combinations(range(count), size))
        share = sum(max(subset) < inliers for subset in subsets) / len(subsets)
        needed = samples_needed(torch.tensor([inliers]), torch.tensor([count]), size, confidence).item()
        if 0.0 < share < 1.0:
            assert 1.0 - (1.0 - share) ** needed == pytest.approx(confidence)
        else:
            assert needed == (0.0 if share else math.inf)
    assert samples_needed(torch.tensor([0]), torch.tensor([0]), size, 0.999).item() == math.inf


# --- scores -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("of_pairs", [False, True])
@pytest.mark.parametrize("in_world", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_errors_without_division_are_the_textbooks(of_pairs, in_world, dtype, make_problems, correspond, perturb):
    """Squared residual over squared threshold of ten poses of each problem, infinite behind the camera."""
    problem, truth = correspond(make_problems(9, 7, outliers=2))
    poses = [perturb(truth, angle=0.3 * i, shift=0.4 * i, seed=i) for i in range(10)]
    tau = torch.linspace(5.0, 50.0, 7, dtype=torch.float64)[:, None]
    omega = tau / 500 * in_world
    tau = tau * torch.linspace(0.2, 3.0, 9, dtype=torch.float64) if of_pairs else tau
    thresholds = Thresholds(tau, omega)
    scene = Scene.of(problem, thresholds, dtype)
    entries = [torch.cat((pose.rotation, pose.translation[..., None]), -1).flatten(1) for pose in poses]
    errors = scene.errors(torch.stack(entries, -1).to(dtype)).double()  # (P, N, H)
    behind = 0
    for h, pose in enumerate(poses):
        cam = problem.world_points @ pose.rotation.mT + pose.translation[:, None]
        depth = cam[..., 2]
        sq_residual = (problem.focal * cam[..., :2] / depth[..., None] - problem.img_points).square().sum(-1)
        limit = tau.square() + (problem.focal * omega / depth).square()
        expected = sq_residual / limit
        usual = (depth > 0) & (expected < 1e5)
        behind += (depth <= 0).sum().item()
        assert (errors[..., h][depth <= 0] >= 1.0).all()
        torch.testing.assert_close(errors[..., h][usual], expected[usual], rtol=2e-3, atol=1e-3)
        if dtype == torch.float64:
            judged = judge(project(State.of(pose), problem), problem, thresholds)
            torch.testing.assert_close(judged.errors[usual], errors[..., h][usual], rtol=1e-9, atol=1e-9)
            weights = torch.where((expected < 1.0) & (depth > 0), tau.square() / limit, 0.0)
            torch.testing.assert_close(judged.weights, weights, rtol=1e-9, atol=1e-9)
    assert behind > 10  # the test has seen them


# --- the search -------------------------------------------------------------------------------------------------------


#: Thresholds for the noise of the protocol: 1 px and 0.05 m.
PROTOCOL = {"threshold": 6.0, "world_threshold": 0.3}


def solver(minimal=None, **options):
    return PnPNet(RANSAC(P3P() if minimal is None else minimal, **options), RobustWeightedLM(m=0, robustness=0))


@pytest.mark.parametrize(("n", "outliers", "scorer"), [(10, 4, "msac"), (50, 20, "inliers"), (200, 80, "msac")])
def test_exact_recovery_among_outliers(n, outliers, scorer, make_problems):
    problems = make_problems(n, 20, outliers=outliers, noise=False)
    result = solver(threshold=1.0, scorer=scorer)(*problems[:3])
    errors = pose_errors(result.pose, problems.pose)
    assert errors.rotation_error_deg.max() < 1e-9
    assert errors.translation_error.max() < 1e-9
    assert result.ok.all()
    # An outlier may fall on the right place by chance; an inlier is never missed.
    assert (result.weights > 0)[problems.inliers].all()
    assert ((result.weights > 0) & ~problems.inliers).double().mean() < 0.01


def test_weights_decide_between_two_poses(make_problems):
    """Five pairs of one pose, four of another: the four win when they weigh more."""
    one, other = make_problems(9, 20, noise=False, seed=1), make_problems(9, 20, noise=False, seed=2)
    camera = (one.world_points @ other.pose.rotation.mT + other.pose.translation[:, None])[:, 5:]
    pixels = one.img_points.clone()
    pixels[:, 5:] = 3400.0 * camera[..., :2] / camera[..., 2:]
    net = solver(threshold=1.0)
    for heavy, pose in ((1.0, one.pose), (1.5, other.pose)):
        weights = torch.ones(20, 9, dtype=torch.float64)
        weights[:, 5:] = heavy
        result = net(one.world_points, pixels, one.intrinsics, weights=weights)
        seen = (camera[..., 2] > 1.0).all(-1)  # the other pose has them in front
        assert seen.sum() > 3
        assert pose_errors(result.pose, pose).rotation_error_deg[seen].max() < 1e-6
        assert torch.equal((result.weights > 0).sum(-1)[seen], torch.full((20,), 5 if heavy == 1.0 else 4)[seen])


def test_sound_problems_are_ok_and_pixels_of_no_pose_are_not(make_problems):
    for n, outliers in ((6, 0), (9, 3), (40, 28)):
        problems = make_problems(n, 100, outliers=outliers)
        assert solver(**PROTOCOL)(*problems[:3]).ok.double().mean() > 0.97
    for n in (4, 5, 9, 40):
        mix = OutlierMix(count=n, mismatch_share=0.0)
        problems = SyntheticProblems(n=n, batch_size=100, outliers=mix, dtype=torch.float64).batch(0)
        for options in (PROTOCOL, {"threshold": 4.0}):
            assert solver(**options)(*problems[:3]).ok.double().mean() <= 0.01


def test_the_gradient_is_that_of_the_result(make_problems, correspond):
    """The start is so near the minimum that a constant start costs little."""
    corr, _ = correspond(make_problems(12, 4, outliers=4))
    ransac = RANSAC(P3P(), threshold=20.0)
    generator = torch.Generator().manual_seed(0)
    probe = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    # Without a threshold in the world all inliers weigh 1. The start is found in float32: smaller steps show rounding.
    for name, step in (("img_points", 1e-2), ("world_points", 1e-4), ("weights", 1e-2)):
        value = getattr(corr, name)
        leaf = value.clone().requires_grad_()
        direction = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        guess = ransac(corr._replace(**{name: leaf}))
        assert not guess.weights.requires_grad
        (guess.pose.translation * probe).sum().backward()
        ends = [ransac(corr._replace(**{name: value + s * direction})).pose.translation for s in (step, -step)]
        numeric = ((ends[0] - ends[1]) * probe).sum(-1) / (2 * step)
        analytic = (leaf.grad * direction).flatten(1).sum(-1)
        torch.testing.assert_close(analytic, numeric, rtol=5e-2, atol=1e-8)


def test_rivals_are_more_accurate_if_the_noise_exceeds_the_threshold():
    noise = {"img_sigma": 6.0, "world_sigma": 0.0, "outliers": OutlierMix(count=12)}
    problems = SyntheticProblems(n=40, batch_size=100, seed=3, **noise).batch(0)
    ransac = RANSAC(P3P(), threshold=3.0)
    problem, frame = PnPNet(ransac, RobustWeightedLM(m=0)).normalize(*problems[:3])
    limit = 3.0 * problem.img_scale[:, None]
    search = Search(ransac, problem, Thresholds(limit, torch.zeros_like(limit)), finds_rivals=True)
    search.run()
    errors = [
        pose_errors(frame.undo(as_pose(x)), problems.pose).rotation_error_deg.median()
        for x in (search.poses, search.rivals)
    ]
    assert errors[1] < 0.9 * errors[0]
