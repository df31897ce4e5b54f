"""The functions beside the solvers take single problems and any leading dimensions, and refuse other shapes."""

from typing import Any, NamedTuple

import pytest
import torch
from helpers import assert_same
from kornia.core.exceptions import BaseError
from torch import Tensor
from torch.utils import _pytree as pytree

from kornia_pnpnet import (
    PnPResult,
    Pose,
    PoseLoss,
    Problems,
    SetLoss,
    Starts,
    create_solver,
    depth_points,
    gravity_prior,
    heatmap_keypoints,
    monte_carlo_pose_loss,
    pose_covariance,
    pose_errors,
    success,
)
from kornia_pnpnet.cameras import bearings
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.losses import pose_distances


class Given(NamedTuple):
    problems: Problems
    result: PnPResult
    starts: Starts
    lens: Tensor
    heatmaps: Tensor


#: Functions of all pairs, and of any number of pairs.
OF_PROBLEMS = {
    "pose_errors": lambda x: pose_errors(x.result.pose, x.problems.pose),
    "success": lambda x: success(pose_errors(x.result.pose, x.problems.pose), max_translation=x.result.cost),
    "pose_distances": lambda x: pose_distances(x.result.pose, x.problems.pose, x.problems.world_points.mean(-2)),
    "gravity_prior": lambda x: gravity_prior(x.problems.pose.translation, x.result.translation, x.result.sigma + 0.1),
    "pose_covariance": lambda x: pose_covariance(x.result.pose, *x.problems[:3], img_sigma=1.0),
    "covariance": lambda x: x.result.covariance(*x.problems[:3], focal="unknown"),
    "true_cam_points": lambda x: x.problems.true_cam_points,
    "matrix": lambda x: x.result.matrix,
}
OF_PAIRS = {
    "bearings": lambda x: bearings(x.problems.img_points, x.problems.intrinsics),
    "bearings dist": lambda x: bearings(x.problems.img_points, x.problems.intrinsics, dist=x.lens),
    "bearings fisheye": lambda x: bearings(x.problems.img_points, x.problems.intrinsics, fisheye=x.lens),
    "depth_points": lambda x: depth_points(
        x.problems.img_points, x.result.weights, x.problems.intrinsics, x.result.pose, depth_sigma=x.result.sigma
    ),
    "heatmap_keypoints": lambda x: heatmap_keypoints(x.heatmaps),
}
#: Means over the batch.
LOSSES = {
    "PoseLoss": lambda x: PoseLoss()(x.result, x.problems),
    "SetLoss": lambda x: SetLoss()(x.result, x.problems, 1.0, x.starts),
}


def given(n: int = 12) -> Given:
    """Six problems."""
    problems = SyntheticProblems(n=12, batch_size=6, seed=1, dtype=torch.float64).batch(0)
    solver = create_solver("pnpnet-set").double().requires_grad_(False)
    result, starts = solver.with_starts(*problems[:3], img_sigma=1.0, world_sigma=0.05)
    generator = torch.Generator().manual_seed(0)
    lens, heatmaps = (0.001 * torch.randn(6, *x, generator=generator).double() for x in ((4,), (n, 5, 6)))
    problems = problems._replace(img_points=problems.img_points[:, :n], world_points=problems.world_points[:, :n])
    result = result._replace(weights=result.weights[:, :n], inliers=result.inliers[:, :n])
    return Given(problems, result, starts, lens, heatmaps)


def mapped(function: Any, tree: Any) -> Any:
    return pytree.tree_map(lambda x: function(x) if isinstance(x, Tensor) else x, tree)


@pytest.mark.parametrize(
    ("name", "n"), [*((name, 12) for name in OF_PROBLEMS), *((name, n) for name in OF_PAIRS for n in (0, 1, 2, 3, 12))]
)
def test_a_function_takes_any_leading_dimensions(name, n):
    x, function = given(n), (OF_PROBLEMS | OF_PAIRS)[name]
    expected = function(x)
    nested = function(mapped(lambda x: x.unflatten(0, (2, 1, 3)), x))
    assert_same(mapped(lambda x: x.flatten(0, 2), nested), expected, 1e-12, 1e-12)
    assert_same(function(mapped(lambda x: x[1], x)), mapped(lambda x: x[1], expected), 1e-9, 1e-9)
    assert_same(function(mapped(lambda x: x[:0], x)), mapped(lambda x: x[:0], expected))


@pytest.mark.parametrize("name", LOSSES)
def test_a_loss_takes_any_leading_dimensions(name):
    x = given()
    nested = LOSSES[name](mapped(lambda x: x.unflatten(0, (2, 1, 3)), x))
    assert_same(nested, LOSSES[name](x), 1e-12, 1e-12)
    assert_same(LOSSES[name](mapped(lambda x: x[1], x)), LOSSES[name](mapped(lambda x: x[1:2], x)), 1e-12, 1e-12)


def test_the_monte_carlo_loss_takes_any_leading_dimensions():
    x = given()
    sizes = [
        monte_carlo_pose_loss(y.problems.pose, y.result.pose, *y.problems[:3], img_sigma=1.0).shape
        for y in (x, mapped(lambda x: x[1], x), mapped(lambda x: x.unflatten(0, (2, 3)), x))
    ]
    assert sizes == [(6,), (), (2, 3)]


def test_cameras_of_poses_are_one_batch():
    x = given()
    pose, camera = x.result.pose, x.problems.intrinsics
    expected = pose.camera(camera)
    nested = mapped(lambda x: x.unflatten(0, (2, 3)), pose).camera(camera.unflatten(0, (2, 3)))
    single = mapped(lambda x: x[1], pose).camera(camera[1])
    shared = mapped(lambda x: x.unflatten(0, (2, 3)), pose).camera(expected)
    for found, part in ((nested, slice(None)), (single, slice(1, 2)), (shared, slice(None))):
        assert_same((found.intrinsics, found.extrinsics), (expected.intrinsics[part], expected.extrinsics[part]))


CAMERA, PIXELS = torch.eye(3), torch.zeros(2, 5, 2)
POSES = Pose(CAMERA.expand(2, 3, 3), torch.zeros(2, 3))
ERRORS = pose_errors(POSES, POSES)
WRONG = {
    "one coordinate": lambda: bearings(PIXELS[..., :1], CAMERA),
    "rays": lambda: bearings(torch.zeros(2, 5, 3), CAMERA),
    "one pixel": lambda: bearings(PIXELS[0, 0], CAMERA),
    "cameras": lambda: bearings(PIXELS, CAMERA.expand(5, 3, 3)),
    "camera of one image": lambda: bearings(PIXELS[0], CAMERA[None]),
    "coefficients": lambda: bearings(PIXELS, CAMERA, dist=torch.zeros(5, 4)),
    "coefficients of one image": lambda: bearings(PIXELS[0], CAMERA, fisheye=torch.zeros(1, 4)),
    "homogeneous pixels": lambda: depth_points(torch.zeros(2, 5, 3), torch.ones(2, 5), CAMERA, POSES, depth_sigma=0.1),
    "depths": lambda: depth_points(PIXELS, torch.ones(2, 5, 1), CAMERA, POSES, depth_sigma=0.1),
    "no cell": lambda: heatmap_keypoints(torch.zeros(1, 2, 0, 5)),
    "temperatures": lambda: heatmap_keypoints(torch.zeros(1, 2, 4, 5), torch.ones(3, 1, 1, 1)),
    "limits": lambda: success(ERRORS, max_translation=torch.ones(2, 1)),
    "origin": lambda: pose_distances(POSES, POSES, torch.zeros(3)),
    "gravity": lambda: gravity_prior(torch.ones(2, 3), torch.ones(3), 0.1),
    "matrices": lambda: POSES.camera(CAMERA.expand(3, 3, 3)),
}


@pytest.mark.parametrize("kind", WRONG)
def test_other_shapes_are_refused(kind):
    with pytest.raises(BaseError):
        WRONG[kind]()
