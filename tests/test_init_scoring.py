"""Laws of the scores of poses: the fast form equals the textbook's, in any unit."""

from __future__ import annotations

import pytest
import torch

from kornia_pnpnet import Pose
from kornia_pnpnet.geometry import transform
from kornia_pnpnet.refine.residual import project
from kornia_pnpnet.init.ransac.scoring import Scene, standardised_errors
from kornia_pnpnet.judge.inliers import Thresholds, judge


@pytest.fixture
def scene(make_problems, correspond, perturb):
    """Problem, ten poses of each problem that see most points, and thresholds."""
    corr, truth = correspond(make_problems(9, 7, outliers=2))
    poses = [perturb(truth, angle=0.3 * i, shift=0.4 * i, seed=i) for i in range(10)]
    stacked = Pose(torch.stack([p.rotation for p in poses], 1), torch.stack([p.translation for p in poses], 1))
    limits = torch.linspace(5.0, 50.0, 7, dtype=torch.float64)
    return corr, stacked, Thresholds(limits, limits / 500)


def pack(scene, poses):
    """Pose :math:`(P, H)` as one solution each of :math:`H` samples."""
    return scene.pack(poses.rotation.permute(2, 3, 0, 1), poses.translation.permute(2, 0, 1))


def textbook(corr, pose, thresholds):
    """Squared residual over squared threshold, infinite behind the camera, (B, N)."""
    cam = transform(pose, corr.world_points)
    depth = cam[..., 2]
    sq_residual = (corr.focal * cam[..., :2] / depth[..., None] - corr.img_points).square().sum(-1)
    sq_img = thresholds.img.reshape(len(depth), -1) ** 2
    sq_limit = sq_img + (corr.focal * thresholds.world[:, None] / depth) ** 2
    return torch.where(depth > 0, sq_residual / sq_limit, torch.inf)


@pytest.mark.parametrize("of_pairs", [False, True])
@pytest.mark.parametrize("in_world", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_errors_without_division_are_the_textbooks(scene, of_pairs, in_world, dtype):
    corr, poses, thresholds = scene
    thresholds = thresholds if in_world else thresholds._replace(world=torch.zeros(7, dtype=torch.float64))
    if of_pairs:
        thresholds = thresholds._replace(img=thresholds.img[:, None] * torch.linspace(0.2, 3.0, 9, dtype=torch.float64))
    fast = Scene.make(corr, thresholds, dtype)
    errors = standardised_errors(fast, pack(fast, poses)).double()  # (P, N, H)
    behind = 0
    for h in range(10):
        pose = Pose(poses.rotation[:, h], poses.translation[:, h])
        expected = textbook(corr, pose, thresholds)
        behind += expected.isinf().sum().item()
        assert (errors[:, :, h][expected.isinf()] >= 1.0).all()
        usual = expected < 1e5
        torch.testing.assert_close(errors[:, :, h][usual], expected[usual], rtol=2e-3, atol=1e-3)
        if dtype == torch.float64:
            judged = judge(project(pose, corr), corr, thresholds)
            torch.testing.assert_close(judged.errors[usual], errors[:, :, h][usual], rtol=1e-9, atol=1e-9)
    assert behind > 10  # the test has seen them
