"""Keypoints of heat maps and points of depth: means and covariances with closed forms, and against samples."""

import pytest
import torch
from kornia.geometry.conversions import convert_points_from_homogeneous, convert_points_to_homogeneous
from kornia.geometry.linalg import transform_points
from kornia.geometry.subpix import spatial_soft_argmax2d
from torch.autograd import gradcheck

from kornia_pnpnet import Pose, create_solver, depth_points, heatmap_keypoints

DOUBLE = torch.float64
CAMERA = torch.tensor([[500.0, 3.0, 320.0], [0.0, 450.0, 240.0], [0.0, 0.0, 1.0]], dtype=DOUBLE)


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float32, 1e-3), (DOUBLE, 1e-6)])
def test_gaussian_maps_have_their_mean_and_covariance(dtype, atol):
    """The covariance of a density that is constant in cells: that of the samples and of a cell."""
    mean = torch.tensor([30.3, 20.6], dtype=DOUBLE)
    covariance = torch.tensor([[9.0, 3.0], [3.0, 4.0]], dtype=DOUBLE)
    v, u = torch.meshgrid(torch.arange(48, dtype=DOUBLE), torch.arange(64, dtype=DOUBLE), indexing="ij")
    offset = torch.stack((u, v), -1) - mean
    logits = -0.5 * (offset @ torch.linalg.inv(covariance) * offset).sum(-1)
    pixels, found = heatmap_keypoints(logits.to(dtype).expand(2, 3, -1, -1))
    expected = covariance + torch.eye(2) / 12.0
    torch.testing.assert_close(pixels, mean.to(dtype).expand(2, 3, 2), atol=atol, rtol=0.0)
    torch.testing.assert_close(found, expected.to(dtype).expand(2, 3, 2, 2), atol=atol, rtol=0.0)


def test_means_are_kornias_and_a_stride_is_each_cell_as_a_block_of_pixels(generator):
    """A cell that covers 3 by 3 pixels is the same density as 9 cells of a third of its share."""
    heatmaps = torch.randn(2, 3, 5, 6, generator=generator, dtype=DOUBLE)
    pixels, _ = heatmap_keypoints(heatmaps, 0.5)
    torch.testing.assert_close(pixels, spatial_soft_argmax2d(heatmaps, 0.5, normalized_coordinates=False))
    blocks = heatmaps.repeat_interleave(3, -1).repeat_interleave(3, -2)
    torch.testing.assert_close(heatmap_keypoints(heatmaps, stride=3.0), heatmap_keypoints(blocks))


def test_gradients_of_heat_maps(generator):
    heatmaps = torch.randn(1, 2, 4, 5, generator=generator, dtype=DOUBLE, requires_grad=True)
    temperature = torch.tensor([[[[0.7]], [[1.3]]]], dtype=DOUBLE, requires_grad=True)
    assert gradcheck(heatmap_keypoints, (heatmaps, temperature))


@pytest.fixture
def seen(random_rotations, generator):
    """Points, the pose of a camera, and their pixels and depth in it."""
    points = torch.randn(2, 7, 3, generator=generator, dtype=DOUBLE)
    pose = Pose(random_rotations(2), torch.tensor([[0.3, -0.2, 6.0], [0.1, 0.4, 8.0]], dtype=DOUBLE))
    cam = transform_points(pose.matrix, points)
    return points, pose, convert_points_from_homogeneous(cam @ CAMERA.mT), cam[..., 2]


def test_exact_measurements_give_exact_points(seen):
    """Back to the points that were projected, with a skew; a sigma is a multiple of the identity, of 0 for none."""
    points, pose, pixels, depth = seen
    found, covariance = depth_points(pixels, depth, CAMERA, pose, depth_sigma=0.0)
    torch.testing.assert_close(found, points)
    assert not covariance.any()
    img_cov = (4.0 * torch.eye(2, dtype=DOUBLE)).expand(2, 7, 2, 2)
    one = depth_points(pixels, depth, CAMERA, pose, depth_sigma=0.1, img_sigma=2.0)
    other = depth_points(pixels, depth, CAMERA, pose, depth_sigma=torch.full((2,), 0.1), img_cov=img_cov)
    torch.testing.assert_close(one, other)


def test_covariances_of_points_are_those_of_samples(seen, generator):
    """Also where the depth is so inexact that a first-order transport would be off."""
    _, pose, pixels, depth = seen
    sigma = (0.4 * depth[:, :1]).expand(2, 7)
    factor = torch.tensor([[30.0, 0.0], [20.0, 40.0]], dtype=DOUBLE)
    img_cov = (factor @ factor.mT).expand(2, 7, 2, 2)
    points, covariance = depth_points(pixels, depth, CAMERA, pose, depth_sigma=sigma, img_cov=img_cov)
    drawn_pixels = pixels + torch.randn(40000, *pixels.shape, generator=generator, dtype=DOUBLE) @ factor.mT
    drawn_depth = depth + sigma * torch.randn(40000, *depth.shape, generator=generator, dtype=DOUBLE)
    rays = convert_points_to_homogeneous(drawn_pixels) @ torch.linalg.inv(CAMERA).mT
    offset = (drawn_depth[..., None] * rays - pose.translation[:, None]) @ pose.rotation - points
    sampled = torch.einsum("sbni,sbnj->bnij", offset, offset) / len(offset)
    size = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    torch.testing.assert_close(offset.mean(0) / size, torch.zeros_like(points), atol=0.03, rtol=0.0)
    correlation = size[..., None] * size[..., None, :]
    torch.testing.assert_close(sampled / correlation, covariance / correlation, atol=0.05, rtol=0.0)


def test_gradients_of_points(seen):
    _, pose, pixels, depth = seen
    camera, sigma = CAMERA.clone(), torch.full((1, 2), 0.2, dtype=DOUBLE)
    img_cov = torch.eye(2, dtype=DOUBLE).expand(1, 2, 2, 2).clone()
    given = (pixels[:1, :2], depth[:1, :2], camera, pose.rotation[:1], pose.translation[:1], sigma, img_cov)
    given = tuple(x.clone().requires_grad_() for x in given)

    def points(pixels, depth, camera, rotation, translation, sigma, img_cov):
        pose = Pose(rotation, translation)
        return depth_points(pixels, depth, camera.triu(), pose, depth_sigma=sigma, img_cov=img_cov)

    assert gradcheck(points, given)


def test_missing_depth_is_nan_and_can_be_masked(seen):
    """Pairs without depth fail their problem, unless they are masked."""
    _, pose, pixels, depth = seen
    depth = depth.clone()
    depth[0, 1], depth[0, 2], depth[0, 3] = 0.0, torch.nan, torch.inf
    sigma = torch.full((2, 7), 0.01, dtype=DOUBLE)
    sigma[0, 4] = -1.0
    points, covariance = depth_points(pixels, depth, CAMERA, pose, depth_sigma=sigma, img_sigma=0.5)
    good = torch.ones(2, 7, dtype=torch.bool)
    good[0, 1:5] = False
    assert torch.equal(points.isfinite().all(-1), good)
    assert torch.equal(covariance.isfinite().all((-2, -1)), good)
    call = {"world_points": points, "img_points": pixels, "intrinsics": CAMERA, "world_cov": covariance}
    solver = create_solver("epnp-lm")
    assert solver(**call).ok.tolist() == [False, True]
    assert solver(**call, mask=good).ok[1]


def test_a_matrix_that_is_no_rotation_is_replaced_by_the_nearest(generator):
    pixels, depth = torch.rand(2, 5, 2, generator=generator), 1.0 + torch.rand(2, 5, generator=generator)
    camera, here = torch.eye(3), Pose(torch.eye(3).expand(2, 3, 3), torch.ones(2, 3))
    found = depth_points(pixels, depth, camera, here._replace(rotation=1.1 * here.rotation), depth_sigma=0.1)
    torch.testing.assert_close(found, depth_points(pixels, depth, camera, here, depth_sigma=0.1))
    mirrored = depth_points(pixels, depth, camera, here._replace(rotation=-here.rotation), depth_sigma=0.1)
    assert all(x.isnan().all() for x in mirrored)
