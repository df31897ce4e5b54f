"""Problems of many cameras by their own geometry."""

import pytest
import torch
from data_helpers import assert_uniform, reprojection
from kornia.core.exceptions import BaseError

from kornia_pnpnet.data import CameraProblems


def draw(**options):
    return CameraProblems(**{"n": 8, "batch_size": 4000, "seed": 3, "dtype": torch.float64, **options}).batch(0)


def test_pixels_show_their_points_and_fields_of_view_are_uniform():
    problems = draw(img_sigma=0.0, field_of_view=(30.0, 90.0))
    assert reprojection(problems).abs().max() < 1e-6
    assert (problems.true_cam_points[..., 2] > 0).all()
    angle = 2.0 * torch.atan(1000.0 / problems.intrinsics[:, 0, 0])
    assert_uniform(angle.rad2deg(), 30.0, 90.0)


def test_outliers_are_as_many_as_asked_for():
    problems = draw(n=10, outlier_share=0.3, img_sigma=0.0)
    assert (problems.inliers.sum(1) == 7).all()
    error = reprojection(problems).norm(dim=-1)
    assert error[problems.inliers].max() < 1e-6
    assert (error[~problems.inliers] > 1.0).double().mean() > 0.99
    assert problems.inliers.double().mean(0).std() < 0.03  # any place


def test_rigs():
    problems = draw(cameras=3, baseline=0.2, img_sigma=0.0, batch_size=50)
    rotation, translation = problems.cam_from_rig
    seen = (problems.intrinsics @ problems.true_cam_points[..., None])[..., 0]
    torch.testing.assert_close(seen[..., :2] / seen[..., 2:], problems.img_points)
    assert torch.equal(rotation[:, 0], rotation[:, 3])
    assert not torch.equal(rotation[:, 0], rotation[:, 1])
    centres = -(rotation.mT @ translation[..., None])[..., 0].norm(dim=-1)
    assert (centres.amax(1) / centres.amin(1) - 1).abs().max() < 1e-9
    assert "cam_from_rig" in problems.known


@pytest.mark.parametrize(
    "options",
    [{"n": 0}, {"field_of_view": (90.0, 30.0)}, {"field_of_view": (0.0, 30.0)}, {"outlier_share": 2.0}, {"cameras": 0}],
)
def test_bad_options(options):
    with pytest.raises(BaseError):
        CameraProblems(**options)
