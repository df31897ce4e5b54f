"""Laws of RANSAC: the pose is found, the weights are its inliers, and every problem is independent."""

from __future__ import annotations

import pytest
import torch

from kornia_pnpnet import PnPNet, RobustWeightedLM, pose_errors, success
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.geometry import transform
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


class Counting(P3P):
    """P3P that records the number of samples of each call, and the weights of the pairs of each sample."""

    def __init__(self):
        super().__init__()
        self.sizes, self.samples = [], []

    def hypotheses(self, corr):
        self.sizes.append(len(corr.weights))
        self.samples += corr.weights.unbind()
        return super().hypotheses(corr)


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


def test_sound_problems_are_ok_and_pixels_of_no_pose_are_not(make_problems):
    for n, outliers in ((3, 0), (4, 0), (5, 0), (9, 3), (40, 28)):
        problems = make_problems(n, 100, outliers=outliers)
        assert solve(solver(**PROTOCOL), problems).ok.double().mean() > 0.97
    for n in (4, 5, 9, 40):
        mix = OutlierMix(count=n, mismatch_share=0.0)
        problems = SyntheticProblems(n=n, batch_size=100, outliers=mix, dtype=torch.float64).batch(0)
        for options in (PROTOCOL, {"threshold": 4.0}):
            assert solve(solver(**options), problems).ok.double().mean() <= 0.01


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
