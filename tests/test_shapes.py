"""The functions beside the solvers refuse other shapes and numbers without sense."""

import pytest
import torch
from kornia.core.exceptions import BaseError

from kornia_pnpnet import (
    Pose,
    depth_points,
    diagnose,
    gravity_prior,
    heatmap_keypoints,
    monte_carlo_pose_loss,
    pose_covariance,
    pose_errors,
    success,
)
from kornia_pnpnet.cameras import bearings
from kornia_pnpnet.losses import pose_distances

CAMERA, PIXELS, POINTS = torch.eye(3), torch.zeros(2, 5, 2), torch.ones(2, 5, 3)
POSES = Pose(CAMERA.expand(2, 3, 3), torch.zeros(2, 3))
ERRORS = pose_errors(POSES, POSES)


def covariance(**noise):
    return pose_covariance(POSES, POINTS, PIXELS, CAMERA, **noise)


def likelihood(*given, **options):
    given = given or (POSES, POSES, POINTS, PIXELS, CAMERA)
    return monte_carlo_pose_loss(*given, img_sigma=1.0, **options)


WRONG = {
    "one coordinate": lambda: bearings(PIXELS[..., :1], CAMERA),
    "rays": lambda: bearings(torch.zeros(2, 5, 3), CAMERA),
    "one pixel": lambda: bearings(PIXELS[0, 0], CAMERA),
    "cameras": lambda: bearings(PIXELS, CAMERA.expand(5, 3, 3)),
    "camera of one image": lambda: bearings(PIXELS[0], CAMERA[None]),
    "coefficients": lambda: bearings(PIXELS, CAMERA, dist=torch.zeros(5, 4)),
    "coefficients of one image": lambda: bearings(PIXELS[0], CAMERA, fisheye=torch.zeros(1, 4)),
    "homogeneous pixels": lambda: depth_points(torch.zeros(2, 5, 3), torch.ones(2, 5), CAMERA, POSES, depth_sigma=0.1),
    "both kinds of noise": lambda: depth_points(
        PIXELS, torch.ones(2, 5), CAMERA, POSES, depth_sigma=0.1, img_sigma=1.0, img_cov=torch.zeros(2, 5, 2, 2)
    ),
    "a number": lambda: depth_points(PIXELS, 2.0, CAMERA, POSES, depth_sigma=0.1),
    "depths": lambda: depth_points(PIXELS, torch.ones(2, 5, 1), CAMERA, POSES, depth_sigma=0.1),
    "no cell": lambda: heatmap_keypoints(torch.zeros(1, 2, 0, 5)),
    "one map": lambda: heatmap_keypoints(torch.zeros(4, 4)),
    "truth values": lambda: heatmap_keypoints(torch.zeros(1, 1, 4, 4, dtype=torch.bool)),
    "no temperature": lambda: heatmap_keypoints(torch.zeros(1, 2, 4, 5), 0.0),
    "no stride": lambda: heatmap_keypoints(torch.zeros(1, 2, 4, 5), stride=0),
    "temperatures": lambda: heatmap_keypoints(torch.zeros(1, 2, 4, 5), torch.ones(3, 1, 1, 1)),
    "limits": lambda: success(ERRORS, max_translation=torch.ones(2, 1)),
    "origin": lambda: pose_distances(POSES, POSES, torch.zeros(3)),
    "gravity": lambda: gravity_prior(torch.ones(2, 3), torch.ones(3), 0.1),
    "estimates": lambda: pose_errors(Pose(CAMERA[None], torch.zeros(2, 3)), POSES),
    "one pose": lambda: pose_errors(Pose(CAMERA, torch.zeros(3)), POSES),
    "distances": lambda: pose_distances(Pose(CAMERA.expand(2, 3, 3), torch.zeros(1, 3)), POSES),
    "kernel": lambda: likelihood(kernel="wide"),
    "few samples": lambda: likelihood(samples=3),
    "true poses": lambda: likelihood(POSES, POSES, torch.ones(3, 5, 3), torch.zeros(3, 5, 2), CAMERA),
    "both kinds of pixel noise": lambda: likelihood(img_cov=torch.zeros(2, 5, 2, 2)),
    "both kinds of point noise": lambda: covariance(img_sigma=1.0, world_sigma=0.1, world_cov=torch.zeros(2, 5, 3, 3)),
    "no noise of a covariance": lambda: covariance(world_sigma=0.1),
    "no noise of a loss": lambda: monte_carlo_pose_loss(POSES, POSES, POINTS, PIXELS, CAMERA),
    "bearings": lambda: diagnose(POINTS, POINTS, CAMERA),
    "matrices": lambda: POSES.camera(CAMERA.expand(3, 3, 3)),
}


@pytest.mark.parametrize("kind", WRONG)
def test_wrong_arguments_are_refused(kind):
    with pytest.raises(BaseError):
        WRONG[kind]()
