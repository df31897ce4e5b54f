"""Bounds: least squares of the true inliers, their weights, and the success that the protocol measured."""

import pytest
import torch
from helpers import assert_same, rate, reprojection_errors
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from laws import BAD, Case, make_bad, take
from strategies import finite

from kornia_pnpnet.data import CameraProblems, OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.bounds import KnownInliers, KnownInliersAndNoise
from kornia_pnpnet.result import Pose, Problems

BOUNDS = (KnownInliers, KnownInliersAndNoise)


@pytest.mark.parametrize("bound", BOUNDS)
def test_bounds_of_rigs(bound):
    problems = CameraProblems(n=12, batch_size=50, seed=3, outlier_share=0.25, cameras=3, dtype=torch.float64).batch(0)
    result = bound().solve_with_truth(problems)
    assert torch.equal(result.weights > 0, problems.inliers)
    assert rate(result, problems) > 0.9


@pytest.mark.parametrize("bound", BOUNDS)
def test_the_pose_minimises_the_weighted_squares_of_the_inliers(make_problems, bound):
    problems = make_problems(batch=5, outliers=2)
    result = bound().solve_with_truth(problems)
    assert torch.equal(result.weights > 0, problems.inliers)
    assert result.ok.all()
    turn, shift = torch.zeros(2, 5, 3, dtype=torch.float64).requires_grad_()
    pose = Pose(axis_angle_to_rotation_matrix(turn) @ result.rotation, result.translation + shift)
    costs = (result.weights.detach() * reprojection_errors(problems, pose).square().sum(-1)).sum(-1)
    # A radian moves pixels by thousands, so that a gradient of this size is rounding.
    for gradient in torch.autograd.grad(costs.sum(), (turn, shift)):
        assert gradient.abs().max() < 1e-6 * costs.max()


def test_weights_are_inverse_variances_by_the_jacobian(make_problems):
    problems = make_problems(batch=3, outliers=1)
    camera = torch.tensor([[800.0, 0, 320], [0, 950, 240], [0, 0, 1]], dtype=torch.float64)
    problems = problems._replace(intrinsics=camera.expand(3, 3, 3))
    problems = problems._replace(img_points=problems.img_points + reprojection_errors(problems))
    weights = KnownInliersAndNoise(img_sigma=2.0, world_sigma=0.3).solve_with_truth(problems).weights

    def pixels(world_points):
        return reprojection_errors(problems._replace(world_points=world_points))

    jacobian = torch.autograd.functional.jacobian(pixels, problems.world_points)  # (B, N, 2, B, N, 3)
    variance = 2.0**2 + 0.3**2 * jacobian.square().sum((-4, -3, -2, -1)) / 2.0
    torch.testing.assert_close(weights.detach(), torch.where(problems.inliers, 1.0 / variance, 0.0))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("mix", "inliers", "inliers_and_noise"),
    [(None, 0.850, 0.907), (OutlierMix(), 0.783, 0.836), (OutlierMix(count=3), 0.690, 0.739)],
)
def test_success_is_what_the_protocol_measured(mix, inliers, inliers_and_noise, dtype):
    problems = SyntheticProblems(batch_size=4000, seed=77, outliers=mix, dtype=dtype).batch(0)
    # Three standard deviations of 4000 problems are 0.014 to 0.022.
    for bound, expected in ((KnownInliers(), inliers), (KnownInliersAndNoise(), inliers_and_noise)):
        assert rate(bound.solve_with_truth(problems), problems) == pytest.approx(expected, abs=0.022)


@pytest.mark.parametrize("bound", BOUNDS)
def test_bad_problems_fail_alone(bound):
    kinds, sound, spoiled = make_bad(Case("identity-lm"))
    arguments = "world_points", "img_points", "intrinsics"

    def solved(call):
        inliers = torch.ones_like(sound["weights"], dtype=torch.bool)
        return bound().solve_with_truth(Problems(*(call[x] for x in arguments), sound["init"], inliers))

    found = solved(spoiled)
    assert_same(take(slice(0, None, 2), found), take(slice(0, None, 2), solved(sound)))
    assert not any(ok and BAD[kind][0] in arguments for kind, ok in zip(kinds, found.ok[1::2], strict=True))
    finite(*found[:4], found.init)
