"""Laws of the scores of poses: the fast form equals the textbook's, whatever the units."""

from __future__ import annotations

import math

import pytest
import torch

from kornia_pnpnet import Correspondences, Pose
from kornia_pnpnet.geometry import project, transform
from kornia_pnpnet.init.ransac.scoring import SCORERS, Scene, standardised_errors
from kornia_pnpnet.refine.verdict import MAX_ERROR, Thresholds, chance_of_inlier, judge


@pytest.fixture
def scene(make_problems, correspond, perturb):
    """Correspondences, ten poses of each problem that see most points, and thresholds."""
    corr, truth = correspond(make_problems(9, 7, outliers=2))
    poses = [perturb(truth, angle=0.3 * i, shift=0.4 * i, seed=i) for i in range(10)]
    stacked = Pose(torch.stack([p.rotation for p in poses], 1), torch.stack([p.translation for p in poses], 1))
    limits = torch.linspace(5.0, 50.0, 7, dtype=torch.float64)
    return corr, stacked, Thresholds(limits, limits / 500)


def pack(scene, poses):
    """Pose :math:`(P, H)` as one solution each of :math:`H` samples."""
    return scene.pack(poses.rotation[:, :, None], poses.translation[:, :, None])


def textbook(corr, pose, thresholds):
    """Squared residual over squared threshold, infinite behind the camera, (B, N)."""
    cam = transform(pose, corr.world_points)
    depth = cam[..., 2]
    sq_residual = (corr.focal * cam[..., :2] / depth[..., None] - corr.img_points).square().sum(-1)
    sq_limit = thresholds.img[:, None] ** 2 + (corr.focal * thresholds.world[:, None] / depth) ** 2
    return torch.where(depth > 0, sq_residual / sq_limit, torch.inf)


@pytest.mark.parametrize("in_world", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_errors_without_division_are_the_textbooks(scene, in_world, dtype):
    corr, poses, thresholds = scene
    thresholds = thresholds if in_world else thresholds._replace(world=torch.zeros(7, dtype=torch.float64))
    fast = Scene.make(corr, thresholds, dtype)
    errors = standardised_errors(fast, pack(fast, poses)).double()  # (P, N, H)
    behind = 0
    for h in range(10):
        expected = textbook(corr, Pose(poses.rotation[:, h], poses.translation[:, h]), thresholds)
        behind += expected.isinf().sum().item()
        assert (errors[:, :, h][expected.isinf()] >= 1.0).all()
        usual = expected < 1e5
        torch.testing.assert_close(errors[:, :, h][usual], expected[usual], rtol=2e-3, atol=1e-3)
        if dtype == torch.float64:
            judged = judge(project(Pose(poses.rotation[:, h], poses.translation[:, h]), corr), corr, thresholds)
            torch.testing.assert_close(judged.errors[usual], errors[:, :, h][usual], rtol=1e-9, atol=1e-9)
    assert behind > 10  # the test has seen them


def test_nothing_is_better_behind_the_camera(scene):
    corr, poses, thresholds = scene
    back = Pose(poses.rotation, poses.translation - torch.tensor([0.0, 0.0, 1e4], dtype=torch.float64))
    fast = Scene.make(corr, thresholds, torch.float32)
    assert (standardised_errors(fast, pack(fast, back)) == MAX_ERROR).all()
    judged = judge(project(Pose(back.rotation[:, 0], back.translation[:, 0]), corr), corr, thresholds)
    assert (judged.errors == MAX_ERROR).all()
    assert not judged.weights.any()


def test_a_point_in_the_centre_of_the_camera_is_a_number():
    corr = Correspondences(torch.zeros(1, 4, 3), torch.ones(1, 4, 2), torch.ones(1, 4), torch.tensor(100.0))
    thresholds = Thresholds(torch.ones(1), torch.zeros(1))
    fast = Scene.make(corr, thresholds, torch.float32)
    pose = Pose(torch.eye(3)[None, None], torch.zeros(1, 1, 3))
    assert standardised_errors(fast, pack(fast, pose)).isfinite().all()
    assert judge(project(Pose(*(x[0] for x in pose)), corr), corr, thresholds).errors.isfinite().all()


def test_packing_and_unpacking_is_the_identity(scene):
    corr, poses, thresholds = scene
    fast = Scene.make(corr, thresholds, torch.float64)
    matrices = fast.unpack(pack(fast, poses))
    torch.testing.assert_close(matrices[..., :3], poses.rotation)
    torch.testing.assert_close(matrices[..., 3], poses.translation)


def test_slots_of_a_sample_are_poses_of_their_own(scene):
    corr, poses, thresholds = scene
    fast = Scene.make(corr, thresholds, torch.float64)
    one = standardised_errors(fast, pack(fast, poses))
    slots = fast.pack(*(x.unflatten(1, (5, 2)) for x in poses))  # five samples of two solutions
    order = torch.arange(10).view(5, 2).T.flatten()  # slot by slot
    torch.testing.assert_close(standardised_errors(fast, slots), one[:, :, order])


def test_losses_are_weighted_sums(scene):
    corr, poses, thresholds = scene
    weights = torch.rand(7, 9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    fast = Scene.make(corr._replace(weights=weights), thresholds, torch.float64)
    packed = pack(fast, poses)
    errors = standardised_errors(fast, packed)
    for name, loss in (("msac", errors.clamp(max=1.0)), ("inliers", (errors >= 1.0).double())):
        expected = (weights[:, :, None] * loss).sum(1)
        torch.testing.assert_close(fast.losses(packed, SCORERS[name]), expected)


def test_some_pairs_and_some_problems(scene, generator):
    corr, poses, thresholds = scene
    fast = Scene.make(corr, thresholds, torch.float64)
    errors = standardised_errors(fast, pack(fast, poses))
    chosen = torch.tensor([4, 1])
    positions = torch.randint(0, 9, (2, 5), generator=generator)
    some = fast.of(chosen).pairs(positions)
    part = standardised_errors(some, pack(some, Pose(*(x[chosen] for x in poses))))
    torch.testing.assert_close(part, errors[chosen].gather(1, positions[..., None].expand(-1, -1, 10)))


def test_inliers_weigh_by_the_inverse_of_their_threshold(scene):
    corr, poses, thresholds = scene
    truth = Pose(poses.rotation[:, 0], poses.translation[:, 0])
    corr = corr._replace(weights=torch.ones_like(corr.weights).index_fill(1, torch.tensor([3]), 0.0))
    projection = project(truth, corr)
    judged = judge(projection, corr, thresholds)
    depth = transform(truth, corr.world_points)[..., 2]
    sq_limit = thresholds.img[:, None] ** 2 + (corr.focal * thresholds.world[:, None] / depth) ** 2
    inlier = projection.in_front & (projection.sq_residual < sq_limit) & (corr.weights > 0)
    assert inlier.any()
    assert not inlier.all()
    assert torch.equal(judged.weights > 0, inlier)
    torch.testing.assert_close(judged.weights[inlier], (thresholds.img[:, None] ** 2 / sq_limit)[inlier])
    plain = judge(projection, corr, thresholds._replace(world=torch.zeros_like(thresholds.world)))
    assert set(plain.weights.unique().tolist()) == {0.0, 1.0}


@pytest.mark.parametrize("size", [0.01, 1.0, 1e3])
def test_the_unit_of_the_world_does_not_matter(size, scene):
    corr, poses, thresholds = scene
    fast = Scene.make(corr, thresholds, torch.float32)
    errors = standardised_errors(fast, pack(fast, poses))
    larger = Scene.make(
        corr._replace(world_points=size * corr.world_points),
        Thresholds(thresholds.img, size * thresholds.world),
        torch.float32,
    )
    scaled = standardised_errors(larger, pack(larger, Pose(poses.rotation, size * poses.translation)))
    usual = errors < 100
    torch.testing.assert_close(scaled[usual], errors[usual], rtol=1e-3, atol=1e-3)


# --- what a random pixel would do -------------------------------------------------------------------------------------


def in_front(pixels, errors, threshold=10.0):
    """Pairs at depth 1, all inliers with given standardised errors."""
    corr = Correspondences(
        torch.zeros(1, len(pixels), 3), torch.tensor([pixels]), torch.ones(1, len(pixels)), torch.tensor(100.0)
    )
    judged = judge(
        project(Pose(torch.eye(3)[None], torch.tensor([[0.0, 0.0, 1.0]])), corr), corr, Thresholds(*torch.zeros(2, 1))
    )
    judged = judged._replace(weights=torch.ones(1, len(pixels)), errors=torch.tensor([errors]))
    return corr, Thresholds(torch.tensor([threshold]), torch.zeros(1)), judged


def test_chance_is_the_share_of_the_disc_in_the_box():
    corr, thresholds, judged = in_front([[0.0, 0.0], [400.0, 0.0], [0.0, 200.0]], [0.1, 0.25, 0.0])
    expected = math.pi * 0.25 * 10.0**2 / (400.0 * 200.0)
    assert chance_of_inlier(corr, thresholds, judged).item() == pytest.approx(expected)


def test_a_thin_box_is_a_strip():
    corr, thresholds, judged = in_front([[0.0, 0.0], [400.0, 0.0], [100.0, 0.0]], [1.0, 0.0, 0.0])
    assert chance_of_inlier(corr, thresholds, judged).item() == pytest.approx(20.0 / 400.0)


def test_chance_is_at_most_one_and_a_number_without_pairs():
    corr, thresholds, judged = in_front([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], [1.0, 0.5, 0.0])
    assert chance_of_inlier(corr, thresholds, judged).item() == 1.0
    nothing = judged._replace(weights=torch.zeros(1, 3))
    assert chance_of_inlier(corr._replace(weights=torch.zeros(1, 3)), thresholds, nothing).item() == 0.0
