"""Laws of RANSAC: the pose is found, the weights are its inliers, and every problem is independent."""

from __future__ import annotations

import math

import pytest
import torch
from kornia.core.exceptions import ShapeError
from kornia_pnpnet.geometry import transform
from kornia_pnpnet.init.ransac.search import Search

from kornia_pnpnet import PnPNet, RobustWeightedLM, pose_errors, success
from kornia_pnpnet.core.trees import map_tensors, take
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.propose.epnp import EPnP
from kornia_pnpnet.propose.minimal import SubsetSolver
from kornia_pnpnet.propose.p3p import P3P
from kornia_pnpnet.propose.ransac import RANSAC

#: Thresholds for the noise of the protocol: 1 px and 0.05 m.
PROTOCOL = {"threshold": 6.0, "world_threshold": 0.3}


def solver(minimal=None, **options):
    return PnPNet(RANSAC(P3P() if minimal is None else minimal, **options), RobustWeightedLM(m=0, robustness=0))


def solve(net, problems):
    return net(problems.world_points, problems.img_points, problems.intrinsics)


def outputs(guess):
    return (*guess.pose, guess.weights, guess.ok)


class Counting(P3P):
    """P3P that records the number of samples of each call, and the weights of the pairs of each sample."""

    def __init__(self):
        super().__init__()
        self.sizes, self.samples = [], []

    def hypotheses(self, corr):
        self.sizes.append(len(corr.weights))
        self.samples += corr.weights.unbind()
        return super().hypotheses(corr)


@pytest.fixture
def found(monkeypatch):
    """The results of all searches of the test."""
    seen = []
    run = Search.run

    def recorded(self, given=None):
        seen.append(run(self, given))
        return seen[-1]

    monkeypatch.setattr(Search, "run", recorded)
    return seen


@pytest.mark.parametrize(("n", "outliers", "scorer"), [(10, 4, "msac"), (50, 20, "inliers"), (200, 80, "msac")])
def test_exact_recovery_among_outliers(n, outliers, scorer, make_problems):
    problems = make_problems(n, 20, outliers=outliers, noise=False)
    result = solve(solver(threshold=1.0, scorer=scorer), problems)
    errors = pose_errors(result.pose, problems.pose)
    assert errors.rotation_error_deg.max() < 1e-9
    assert errors.translation_error.max() < 1e-9
    assert result.ok.all()
    # An outlier may fall on the right place by chance; an inlier is never missed.
    assert (result.weights > 0)[problems.inliers].all()
    assert ((result.weights > 0) & ~problems.inliers).double().mean() < 0.01


def test_float32_finds_the_pose_too(make_problems):
    problems = make_problems(20, 50, outliers=8, dtype=torch.float32)
    result = solve(solver(**PROTOCOL), problems)
    assert {x.dtype for x in (result.rotation, result.translation, result.weights)} == {torch.float32}
    assert success(pose_errors(result.pose, problems.pose)).float().mean() > 0.85
    assert result.ok.all()


def test_weighing_by_depth_pays(make_problems):
    """The protocol's near points have more noise in the image than its far points."""
    problems = make_problems(9, 300, outliers=3)
    plain, by_depth = (
        success(pose_errors(solve(solver(**options), problems).pose, problems.pose)).double().mean()
        for options in ({"threshold": 50.0}, PROTOCOL)
    )
    assert by_depth > plain + 0.02


@pytest.mark.parametrize("outliers", [0, 3])
def test_the_papers_ransac_finds_the_pose(outliers, make_problems):
    """EPnP and the robust LM on subsets of seven of nine; with three outliers every subset holds one."""
    problems = make_problems(9, 50, outliers=outliers, noise=False)
    minimal = SubsetSolver(EPnP(), RobustWeightedLM(m=5, learnable=False), size=7)
    result = solve(solver(minimal, threshold=5.0), problems)
    right = success(pose_errors(result.pose, problems.pose)).double().mean()
    assert right > (0.3 if outliers else 0.95)


def test_weights_decide_between_two_poses(make_problems):
    """Five pairs of one pose, four of another: the four win when they weigh more."""
    one, other = make_problems(9, 20, noise=False, seed=1), make_problems(9, 20, noise=False, seed=2)
    camera = transform(other.pose, one.world_points)[:, 5:]
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


def test_the_world_need_not_be_centred(make_problems, correspond):
    """Map coordinates leave float32 no digits; the search moves them to the origin first."""
    corr, _ = correspond(make_problems(9, 20, outliers=3))
    ransac = RANSAC(P3P(), **PROTOCOL)
    near = ransac(corr)
    offset = torch.tensor([5e5, 5e6, 100.0], dtype=torch.float64)
    far = ransac(corr._replace(world_points=corr.world_points + offset))
    torch.testing.assert_close(far.pose.rotation, near.pose.rotation, rtol=0, atol=1e-6)
    assert torch.equal(far.weights > 0, near.weights > 0)
    translation = far.pose.translation + far.pose.rotation @ offset
    torch.testing.assert_close(translation, near.pose.translation, rtol=0, atol=1e-6)


@pytest.mark.parametrize("world_threshold", [0.0, 0.1])
def test_the_weights_are_the_inliers_of_the_returned_pose(world_threshold, make_problems):
    """In the units of the user: another camera, and a world in centimetres."""
    problems = make_problems(30, 50, outliers=10)
    K = torch.tensor([[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    pixels = problems.img_points * (800.0 / 3400.0) + torch.tensor([320.0, 240.0], dtype=torch.float64)
    world = 100.0 * problems.world_points
    result = solver(threshold=2.0, world_threshold=100.0 * world_threshold)(world, pixels, K)
    cam = transform(result.pose, world)
    depth = cam[..., 2]
    sq_residual = (800.0 * cam[..., :2] / depth[..., None] + K[:2, 2] - pixels).square().sum(-1)
    sq_limit = 2.0**2 + (800.0 * 100.0 * world_threshold / depth) ** 2
    inlier = result.weights > 0
    assert torch.equal(inlier, (depth > 0) & (sq_residual < sq_limit))
    torch.testing.assert_close(result.weights[inlier], (2.0**2 / sq_limit)[inlier])
    assert result.ok.all()


def test_pairs_without_weight_are_no_inliers(make_problems):
    problems = make_problems(12, 20, noise=False)
    mask = torch.ones(20, 12, dtype=torch.bool)
    mask[:, [2, 5, 11]] = False
    world = problems.world_points.clone()
    world[:, 5] = math.nan  # padding may hold anything
    result = solver(threshold=1.0)(world, problems.img_points, problems.intrinsics, mask=mask)
    assert torch.equal(result.weights > 0, mask)
    assert pose_errors(result.pose, problems.pose).rotation_error_deg.max() < 1e-9


@pytest.mark.parametrize(("masked", "weighted"), [(True, False), (False, True)])
def test_pairs_without_weight_are_never_drawn(masked, weighted, make_problems):
    """Neither pairs that the mask hides nor pairs of weight 0, where there are too many subsets to try each."""
    problems = make_problems(60, 10, outliers=20)
    there = torch.rand(10, 60, generator=torch.Generator().manual_seed(0)) < 0.5
    minimal = Counting()
    net, K = solver(minimal, **PROTOCOL), problems.intrinsics
    weights = torch.where(there, 0.1, 0.0).double() if weighted else None
    net(problems.world_points, problems.img_points, K, weights=weights, mask=there if masked else None)
    assert len(minimal.samples) > 100
    assert all((weight > 0).all() for weight in minimal.samples)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("n", "outliers"), [(4, 0), (9, 3), (40, 20)])
def test_a_problem_has_the_same_result_in_every_batch(n, outliers, dtype, make_problems, correspond):
    corr, _ = correspond(make_problems(n, 60, outliers=outliers, dtype=dtype))
    ransac = RANSAC(P3P(), **PROTOCOL)
    together = outputs(ransac(corr))
    tolerance = 1e-9 if dtype == torch.float64 else 1e-5
    torch.rand(5)  # the global generator is not used
    assert all(torch.equal(a, b) for a, b in zip(outputs(ransac(corr)), together, strict=True))
    for at in (torch.tensor([0]), torch.tensor([59, 3]), torch.arange(59, -1, -1)):
        for a, b in zip(outputs(ransac(take(corr, at))), together, strict=True):
            if n == 9:
                assert torch.equal(a, b[at])
            else:  # the kernels for a single problem, or for four samples, may round the last bit differently
                torch.testing.assert_close(a, b[at], rtol=tolerance, atol=tolerance)


def test_chunks_do_not_matter(make_problems, correspond):
    corr, _ = correspond(make_problems(40, 20, outliers=15))
    # Rounds are no longer than a chunk: with the same rounds everything is the same.
    options = {**PROTOCOL, "min_samples": 100, "max_samples": 100}
    default = outputs(RANSAC(P3P(), **options)(corr))
    for size in (100, 10**6):
        for a, b in zip(outputs(RANSAC(P3P(), **options, chunk_size=size)(corr)), default, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)
    assert RANSAC(P3P(), **options, chunk_size=1)(take(corr, slice(2))).ok.all()


@pytest.mark.parametrize(("n", "batch"), [(9, 300), (1000, 3)])
def test_a_chunk_bounds_the_samples_that_are_solved_together(n, batch, make_problems, correspond):
    minimal = Counting()
    RANSAC(minimal, **PROTOCOL, chunk_size=256)(correspond(make_problems(n, batch, outliers=n // 2))[0])
    assert max(minimal.sizes) <= 256
    assert len(minimal.sizes) > 1


def test_easy_problems_stop_early_and_change_nothing(found, make_problems, correspond):
    easy, hard = (correspond(make_problems(60, 10, outliers=k))[0] for k in (0, 42))
    both = map_tensors(lambda a, b: torch.cat((a, b)) if a.ndim else a, easy, hard)
    ransac = RANSAC(P3P(), **PROTOCOL)
    results = [outputs(ransac(corr)) for corr in (easy, hard, both)]
    alone, alone_hard, together = (x.samples for x in found)
    assert torch.equal(torch.cat((alone, alone_hard)), together)
    assert together[:10].max() < together[10:].min()
    for a, b, c in zip(*results, strict=True):
        torch.testing.assert_close(torch.cat((a, b)), c, rtol=1e-9, atol=1e-9)


def test_options_decide_how_many_samples_are_drawn(found, make_problems, correspond):
    corr, _ = correspond(make_problems(40, 20, outliers=20, noise=False))

    def samples(**options):
        RANSAC(P3P(), **{"threshold": 1.0, "min_samples": 5, **options})(corr)
        return found[-1].samples

    assert samples(max_samples=1).tolist() == [1] * 20
    few, many = samples(confidence=0.5), samples(confidence=0.9999)
    assert (few <= many).all()
    assert few.sum() < many.sum()
    assert samples(min_samples=400).min() >= 400
    assert samples(min_samples=400, chunk_size=150).min() >= 400
    assert samples(max_samples=77, threshold=1e-6).max() <= 77  # no inliers, no early end
    poses = [samples(seed=seed, max_samples=20) is not None and found[-1].poses for seed in (0, 1)]
    assert not torch.equal(*poses)


def test_sound_problems_are_ok_and_pixels_of_no_pose_are_not(make_problems):
    for n, outliers in ((3, 0), (4, 0), (5, 0), (9, 3), (40, 28)):
        problems = make_problems(n, 100, outliers=outliers)
        assert solve(solver(**PROTOCOL), problems).ok.double().mean() > 0.97
    for n in (4, 5, 9, 40):
        mix = OutlierMix(count=n, mismatch_share=0.0)
        problems = SyntheticProblems(n=n, batch_size=100, outliers=mix, dtype=torch.float64).batch(0)
        for options in (PROTOCOL, {"threshold": 4.0}):
            assert solve(solver(**options), problems).ok.double().mean() <= 0.01


def test_too_few_pairs_and_no_problems(make_problems, correspond):
    corr, _ = correspond(make_problems(5, 2))
    with pytest.raises(ShapeError, match=r"7 pairs.*N = 5"):
        RANSAC(SubsetSolver(EPnP(), size=7))(corr)
    guess = RANSAC(P3P())(take(corr, slice(0, 0)))
    assert guess.pose.rotation.shape == (0, 3, 3)
    assert guess.ok.shape == (0,)


def test_a_scorer_may_be_any_function(make_problems, correspond):
    corr, _ = correspond(make_problems(9, 30, outliers=3))
    built_in = RANSAC(P3P(), **PROTOCOL)(corr)
    own = RANSAC(P3P(), **PROTOCOL, scorer=lambda error: 3.0 * torch.minimum(error, torch.ones_like(error)))(corr)
    for a, b in zip(outputs(built_in), outputs(own), strict=True):
        torch.testing.assert_close(a, b)
    assert RANSAC(P3P(), **PROTOCOL, scorer=torch.log1p)(corr).ok.all()


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


def test_without_final_steps_the_pose_is_a_constant(make_problems, correspond):
    corr, truth = correspond(make_problems(20, 5, outliers=5, noise=False))
    img_points = corr.img_points.clone().requires_grad_()
    for steps, learns in ((0, False), (1, True)):
        guess = RANSAC(P3P(), threshold=1.0, final_steps=steps)(corr._replace(img_points=img_points))
        assert guess.pose.rotation.requires_grad is learns
        assert pose_errors(guess.pose, truth).rotation_error_deg.max() < 0.01
