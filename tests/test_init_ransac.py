"""Laws of RANSAC: it finds the pose, says what it used, and every problem is on its own."""

from __future__ import annotations

import math
import subprocess
import sys

import pytest
import torch
from kornia.core.exceptions import BaseError, ShapeError
from torch import nn

from kornia_pnpnet import Correspondences, Guess, PnPNet, Pose, RobustWeightedLM, pose_errors, success
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.geometry import transform
from kornia_pnpnet.init.epnp.epnp import EPnP
from kornia_pnpnet.init.ransac import RANSAC, SubsetSolver
from kornia_pnpnet.init.ransac.p3p import P3P
from kornia_pnpnet.init.ransac.scoring import Scene
from kornia_pnpnet.init.ransac.search import Search

#: What suits the noise of the protocol: 1 px and 0.05 m.
PROTOCOL = {"threshold": 6.0, "world_threshold": 0.3}


def solver(minimal=None, **options):
    return PnPNet(RANSAC(P3P() if minimal is None else minimal, **options), RobustWeightedLM(m=0, robustness=0))


def solve(net, problems):
    return net(problems.world_points, problems.img_points, problems.intrinsics)


def part(corr, at):
    return Correspondences(*(x if x is None or x.ndim == 0 else x[at] for x in corr))


def outputs(guess):
    return (*guess.pose, guess.weights, guess.ok)


def garbage(n, batch, seed=0):
    """Pixels anywhere, of no pose."""
    mix = OutlierMix(count=n, mismatch_share=0.0)
    return SyntheticProblems(n=n, batch_size=batch, seed=seed, outliers=mix, dtype=torch.float64).batch(0)


@pytest.fixture
def found(monkeypatch):
    """What every search of the test has found."""
    seen = []
    run = Search.run

    def recorded(self):
        seen.append(run(self))
        return seen[-1]

    monkeypatch.setattr(Search, "run", recorded)
    return seen


# --- it finds the pose ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scorer", ["msac", "inliers"])
@pytest.mark.parametrize(("n", "outliers"), [(10, 4), (50, 20), (200, 80)])
def test_exact_recovery_among_outliers(n, outliers, scorer, make_problems):
    problems = make_problems(n, 20, outliers=outliers, noise=False)
    result = solve(solver(threshold=1.0, scorer=scorer), problems)
    errors = pose_errors(result.pose, problems.pose)
    assert errors.rotation_error_deg.max() < 1e-9
    assert errors.translation_error.max() < 1e-9
    assert result.ok.all()
    # A wrong pair may fall on the right place by chance; a right one is never missed.
    assert (result.weights > 0)[problems.inliers].all()
    assert ((result.weights > 0) & ~problems.inliers).double().mean() < 0.01


def test_float32_finds_it_too(make_problems):
    problems = make_problems(20, 50, outliers=8, dtype=torch.float32)
    result = solve(solver(**PROTOCOL), problems)
    assert {x.dtype for x in (result.rotation, result.translation, result.weights)} == {torch.float32}
    assert success(pose_errors(result.pose, problems.pose)).float().mean() > 0.85
    assert result.ok.all()


def test_noise_of_the_world_counts_by_depth(make_problems):
    """Weighing by depth is worth success: the protocol's near points are noisier than the far ones."""
    problems = make_problems(9, 300, outliers=3)
    rates = [
        success(pose_errors(solve(solver(threshold=t, world_threshold=w), problems).pose, problems.pose))
        .double()
        .mean()
        for t, w in ((50.0, 0.0), (6.0, 0.3))
    ]
    assert rates[1] > rates[0] + 0.02


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


# --- the mask is that of the pose -------------------------------------------------------------------------------------


@pytest.mark.parametrize("world_threshold", [0.0, 0.1])
def test_the_mask_is_the_residual_test_at_the_returned_pose(world_threshold, make_problems):
    """In the units of the user: another camera, and a world in centimetres."""
    problems = make_problems(30, 50, outliers=10)
    K = torch.tensor([[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    pixels = problems.img_points * (800.0 / 3400.0) + torch.tensor([320.0, 240.0], dtype=torch.float64)
    world = 100.0 * problems.world_points
    net = solver(threshold=2.0, world_threshold=100.0 * world_threshold)
    result = net(world, pixels, K)
    cam = transform(result.pose, world)
    depth = cam[..., 2]
    sq_residual = (800.0 * cam[..., :2] / depth[..., None] + K[:2, 2] - pixels).square().sum(-1)
    sq_limit = 2.0**2 + (800.0 * 100.0 * world_threshold / depth) ** 2
    assert torch.equal(result.weights > 0, (depth > 0) & (sq_residual < sq_limit))
    inlier = result.weights > 0
    torch.testing.assert_close(result.weights[inlier], (2.0**2 / sq_limit)[inlier])
    assert result.ok.all()


def test_pairs_without_weight_are_no_inliers(make_problems):
    problems = make_problems(12, 20, noise=False)
    mask = torch.ones(20, 12, dtype=torch.bool)
    mask[:, [2, 5, 11]] = False
    world = problems.world_points.clone()
    world[:, 5] = math.nan  # what padding holds does not matter
    result = solver(threshold=1.0)(world, problems.img_points, problems.intrinsics, mask=mask)
    assert torch.equal(result.weights > 0, mask)
    assert pose_errors(result.pose, problems.pose).rotation_error_deg.max() < 1e-9


# --- every problem is on its own --------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [9, 40])
def test_the_same_call_has_the_same_result_to_the_bit(n, make_problems, correspond):
    corr, _ = correspond(make_problems(n, 50, outliers=n // 3))
    ransac = RANSAC(P3P(), **PROTOCOL)
    first = ransac(corr)
    torch.rand(5)  # the global generator is not ours
    assert all(torch.equal(a, b) for a, b in zip(outputs(first), outputs(ransac(corr)), strict=True))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("n", "outliers"), [(4, 0), (9, 3), (40, 20)])
def test_a_problem_is_itself_in_every_batch(n, outliers, dtype, make_problems, correspond):
    corr, _ = correspond(make_problems(n, 60, outliers=outliers, dtype=dtype))
    ransac = RANSAC(P3P(), **PROTOCOL)
    together = outputs(ransac(corr))
    tolerance = 1e-9 if dtype == torch.float64 else 1e-5
    for at in (torch.tensor([0]), torch.tensor([59, 3]), torch.arange(59, -1, -1)):
        for a, b in zip(outputs(ransac(part(corr, at))), together, strict=True):
            if n == 9:
                assert torch.equal(a, b[at])
            else:  # the kernels for a single problem, or for four samples, may round the last bit otherwise
                torch.testing.assert_close(a, b[at], rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("size", [1, 50, 10**6])
def test_the_chunks_do_not_matter(size, make_problems, correspond):
    corr, _ = correspond(make_problems(40, 20, outliers=15))
    # Rounds are no longer than a chunk: with the same rounds everything is the same.
    options = {**PROTOCOL, "min_samples": 100, "max_samples": 100}
    some, default = RANSAC(P3P(), **options, chunk_size=max(size, 100))(corr), RANSAC(P3P(), **options)(corr)
    for a, b in zip(outputs(some), outputs(default), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)
    assert RANSAC(P3P(), **options, chunk_size=size)(corr).ok.all()


def test_easy_problems_stop_early_and_change_nothing(found, make_problems, correspond):
    easy, hard = correspond(make_problems(60, 10))[0], correspond(make_problems(60, 10, outliers=42))[0]
    both = Correspondences(*(torch.cat((a, b)) if a.ndim else a for a, b in zip(easy[:6], hard[:6], strict=True)))
    ransac = RANSAC(P3P(), **PROTOCOL)
    results = [outputs(ransac(corr)) for corr in (easy, hard, both)]
    alone, alone_hard, together = (x.samples for x in found)
    assert torch.equal(torch.cat((alone, alone_hard)), together)
    assert together[:10].max() < together[10:].min()
    for a, b, c in zip(*results, strict=True):
        torch.testing.assert_close(torch.cat((a, b)), c, rtol=1e-9, atol=1e-9)


def test_how_many_samples_are_drawn(found, make_problems, correspond):
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


def test_the_seed_decides_what_is_drawn(found, make_problems, correspond):
    corr, _ = correspond(make_problems(40, 20, outliers=28))
    for seed in (0, 1):
        RANSAC(P3P(), **PROTOCOL, seed=seed, max_samples=20)(corr)
    assert not torch.equal(found[0].poses, found[1].poses)


# --- failure is data --------------------------------------------------------------------------------------------------


def bad_problems(problems):
    """Name and problems of which the second is spoilt."""
    world, img = problems.world_points, problems.img_points

    def spoilt(*, world_points=world, img_points=img, weights=None):
        weights = torch.ones_like(world[..., 0]) if weights is None else weights
        return world_points, img_points, weights

    one = torch.tensor([1])
    line = world[1, :1] + torch.arange(len(world[1]), dtype=world.dtype)[:, None] * torch.ones(3, dtype=world.dtype)
    weights = torch.ones_like(world[..., 0])
    two = weights.clone()
    two[1, 2:] = 0.0
    return {
        "nan": spoilt(world_points=world.index_fill(0, one, math.nan)),
        "no weight": spoilt(weights=weights.index_fill(0, one, 0.0)),
        "two pairs": spoilt(weights=two),
        "a line": spoilt(world_points=world.index_copy(0, one, line[None])),
        "one point": spoilt(world_points=world.index_fill(0, one, 1.0)),
        "one pixel": spoilt(img_points=img.index_fill(0, one, 7.0)),
    }


@pytest.mark.parametrize("n", [9, 40])
@pytest.mark.parametrize("kind", ["nan", "no weight", "two pairs", "a line", "one point", "one pixel"])
def test_bad_problems_fail_alone(kind, n, make_problems):
    problems = make_problems(n, 3, outliers=2)
    world, img, weights = bad_problems(problems)[kind]
    leaves = [x.clone().requires_grad_() for x in (world, img, weights)]
    net = solver(**PROTOCOL)
    result = net(leaves[0], leaves[1], problems.intrinsics, weights=leaves[2])
    sound = solve(net, problems)
    assert result.ok.tolist() == [True, False, True]
    for a, b in ((result.rotation, sound.rotation), (result.translation, sound.translation)):
        assert a.isfinite().all()
        assert torch.equal(a[[0, 2]], b[[0, 2]])
    (result.rotation.sum() + result.translation.sum() + result.weights.sum()).backward()
    for leaf in leaves:
        assert leaf.grad.isfinite().all()
        assert not leaf.grad[1].any()
        assert leaf.grad[0].any() or leaf is leaves[2]


@pytest.mark.parametrize("n", [4, 5, 9, 40])
def test_garbage_is_not_ok(n):
    problems = garbage(n, 300)
    for options in (PROTOCOL, {"threshold": 4.0}):
        assert solve(solver(**options), problems).ok.double().mean() <= 0.01


@pytest.mark.parametrize(("n", "outliers"), [(3, 0), (4, 0), (5, 0), (9, 3), (40, 28)])
def test_sound_problems_are_ok(n, outliers, make_problems):
    problems = make_problems(n, 200, outliers=outliers)
    assert solve(solver(**PROTOCOL), problems).ok.double().mean() > 0.97


def test_too_few_pairs_for_a_sample(make_problems, correspond):
    corr, _ = correspond(make_problems(5, 2))
    with pytest.raises(ShapeError, match="Samples of 7 pairs"):
        RANSAC(SubsetSolver(EPnP(), size=7))(corr)


def test_no_problem_at_all(make_problems, correspond):
    corr, _ = correspond(make_problems(9, 2))
    guess = RANSAC(P3P())(part(corr, slice(0, 0)))
    assert guess.pose.rotation.shape == (0, 3, 3)
    assert guess.ok.shape == (0,)


# --- gradients --------------------------------------------------------------------------------------------------------


def test_gradcheck_of_the_last_refinement(make_problems, correspond):
    """With the inliers, their weights and the start fixed, as the docstring says."""
    corr, _ = correspond(make_problems(9, 2, outliers=3))
    ransac = RANSAC(P3P(), threshold=50.0)  # the weights are 1
    start = ransac(corr).pose
    thresholds = ransac._thresholds(corr)

    def refine(world, img, weights):
        moved = corr._replace(world_points=world, img_points=img, weights=weights)
        return tuple(ransac._refine(moved, start, thresholds)[0])

    leaves = [x.clone().requires_grad_() for x in corr[:3]]
    assert torch.autograd.gradcheck(refine, leaves, atol=1e-5)


def test_the_gradient_is_that_of_the_result(make_problems, correspond):
    """The start is so near the minimum that ignoring what it depends on costs little."""
    corr, _ = correspond(make_problems(12, 4, outliers=4))
    ransac = RANSAC(P3P(), **PROTOCOL)
    img = corr.img_points.clone().requires_grad_()
    generator = torch.Generator().manual_seed(0)
    direction = torch.randn(img.shape, generator=generator, dtype=torch.float64)
    probe = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    guess = ransac(corr._replace(img_points=img))
    (guess.pose.translation * probe).sum().backward()
    # The weights are those at the start, which is found in single precision: smaller steps would show its rounding.
    step = 1e-2
    ends = [ransac(corr._replace(img_points=corr.img_points + s * direction)).pose.translation for s in (step, -step)]
    numeric = ((ends[0] - ends[1]) * probe).sum(-1) / (2 * step)
    analytic = (img.grad * direction).sum((1, 2))
    torch.testing.assert_close(analytic, numeric, rtol=1e-2, atol=1e-8)


def test_the_selection_has_no_gradient(make_problems, correspond):
    corr, _ = correspond(make_problems(9, 2))
    leaves = [x.clone().requires_grad_() for x in corr[:3]]
    guess = RANSAC(P3P(), **PROTOCOL)(Correspondences(*leaves, *corr[3:]))
    assert not guess.weights.requires_grad
    assert guess.pose.rotation.requires_grad


# --- parts and options ------------------------------------------------------------------------------------------------


def test_a_scorer_may_be_any_function(make_problems, correspond):
    corr, _ = correspond(make_problems(9, 30, outliers=3))
    built_in = RANSAC(P3P(), **PROTOCOL)(corr)
    own = RANSAC(P3P(), **PROTOCOL, scorer=lambda error: 3.0 * torch.minimum(error, torch.ones_like(error)))(corr)
    for a, b in zip(outputs(built_in), outputs(own), strict=True):
        torch.testing.assert_close(a, b)
    cauchy = RANSAC(P3P(), **PROTOCOL, scorer=torch.log1p)(corr)
    assert cauchy.ok.all()


@pytest.mark.parametrize("outliers", [0, 2, 3])
def test_the_papers_ransac_finds_the_pose(outliers, make_problems):
    """EPnP and the robust LM on subsets of seven of nine; with three outliers every subset holds one."""
    problems = make_problems(9, 50, outliers=outliers, noise=False)
    minimal = SubsetSolver(EPnP(), RobustWeightedLM(m=5, learnable=False), size=7)
    result = solve(solver(minimal, threshold=5.0), problems)
    right = success(pose_errors(result.pose, problems.pose)).double().mean()
    assert right > (0.95 if outliers < 3 else 0.3)


class Stubborn(nn.Module):
    """An initialiser with a guess for every other problem and a pose that is no number for every third."""

    def forward(self, corr):
        index = torch.arange(len(corr.weights))
        rotation = torch.eye(3, dtype=corr.weights.dtype).repeat(len(index), 1, 1)
        translation = torch.zeros(len(index), 3, dtype=corr.weights.dtype)
        translation[::3] = math.nan
        return Guess(Pose(rotation, translation), torch.ones_like(corr.weights), index % 2 == 0)


def test_a_subset_solver_says_what_is_no_solution(make_problems, correspond):
    corr, _ = correspond(make_problems(7, 12))
    hypotheses = SubsetSolver(Stubborn(), size=7).hypotheses(corr)
    assert hypotheses.valid[:, 0].tolist() == [i % 2 == 0 and i % 3 != 0 for i in range(12)]
    assert hypotheses.pose.translation.isfinite().all()


class Counting(P3P):
    """P3P that remembers how many samples it was given at once."""

    def __init__(self):
        super().__init__()
        self.sizes = []

    def hypotheses(self, corr):
        self.sizes.append(len(corr.weights))
        return super().hypotheses(corr)


@pytest.mark.parametrize(("n", "batch"), [(9, 300), (100, 50), (1000, 3)])
def test_the_working_set_is_bounded(n, batch, make_problems, correspond, monkeypatch):
    largest = []

    def recorded(self, packed, scorer):
        largest.append(self.points.shape[0] * self.points.shape[1] * packed.shape[-1])
        return losses(self, packed, scorer)

    losses = Scene.losses
    monkeypatch.setattr(Scene, "losses", recorded)
    corr, _ = correspond(make_problems(n, batch, outliers=n // 2))
    minimal = Counting()
    ransac = RANSAC(minimal, **PROTOCOL, chunk_size=200)
    ransac(corr)
    assert max(minimal.sizes) <= 200
    assert len(minimal.sizes) > 1
    assert max(largest) <= 128 * 200


def test_many_pairs_are_scored_in_part(make_problems, correspond, monkeypatch):
    seen = []
    rank = Search._keep

    def recorded(self, scene, packed, valid, width, **options):
        seen.append((scene.points.shape[1], packed.shape[-1]))
        return rank(self, scene, packed, valid, width, **options)

    monkeypatch.setattr(Search, "_keep", recorded)
    corr, _ = correspond(make_problems(300, 2, outliers=100))
    RANSAC(P3P(), **PROTOCOL, min_samples=64, max_samples=64)(corr)
    assert seen == [(16, 256), (64, 64), (300, 16)]


def test_its_configuration_is_data():
    ransac = RANSAC(SubsetSolver(EPnP(), RobustWeightedLM(m=5), size=7), threshold=3.0, scorer="inliers")
    assert ransac.config["minimal"]["name"] == "SubsetSolver"
    assert ransac.config["minimal"]["init"] == {"name": "EPnP", **EPnP().config}
    arguments = {key: value for key, value in ransac.config.items() if key != "minimal"}
    assert RANSAC(P3P(), **arguments).config == {**ransac.config, "minimal": {"name": "P3P", **P3P().config}}
    assert "threshold=3.0" in repr(ransac)


@pytest.mark.parametrize(
    "wrong",
    [
        {"threshold": 0.0},
        {"threshold": math.nan},
        {"world_threshold": -1.0},
        {"scorer": "best"},
        {"max_samples": 0},
        {"min_samples": 1.5},
        {"confidence": 1.0},
        {"local_candidates": 0},
        {"local_iterations": -1},
        {"chunk_size": 0},
    ],
)
def test_wrong_arguments_raise(wrong):
    with pytest.raises(BaseError, match=next(iter(wrong))):
        RANSAC(P3P(), **wrong)


def test_a_subset_has_three_pairs_or_more():
    with pytest.raises(BaseError, match="size"):
        SubsetSolver(EPnP(), size=2)


@pytest.mark.slow
def test_ten_thousand_problems_of_a_hundred_pairs_fit_into_two_gibibytes():
    code = (
        "import resource, torch; torch.set_num_threads(1);"
        "from kornia_pnpnet import PnPNet, RobustWeightedLM;"
        "from kornia_pnpnet.data import OutlierMix, SyntheticProblems;"
        "from kornia_pnpnet.init.ransac.p3p import P3P; from kornia_pnpnet.init.ransac.ransac import RANSAC;"
        "data = SyntheticProblems(n=100, batch_size=10000, outliers=OutlierMix(count=50), dtype=torch.float64);"
        "p = data.batch(0); net = PnPNet(RANSAC(P3P(), threshold=6.0, world_threshold=0.3), RobustWeightedLM(m=0));"
        "torch.set_grad_enabled(False); ok = net(p.world_points, p.img_points, p.intrinsics).ok;"
        "print(ok.double().mean().item(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    ok, kibibytes = output.stdout.split()
    assert float(ok) > 0.99
    assert float(kibibytes) < 2 * 1024**2
