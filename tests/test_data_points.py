"""Priors of points: where they put points in the camera's frame."""

import math

import pytest
import torch
from data_helpers import COUNT, assert_normal, assert_uniform, draw, reprojection

from kornia_pnpnet.data import DrivePoints, FacadePoints, ObjectPoints, OutlierMix, RoomPoints, SlabPoints

VIEWS = [FacadePoints, RoomPoints, DrivePoints]


def thinness(points):
    values = torch.linalg.svdvals(points - points.mean(1, keepdim=True))
    return values[:, 2] / values[:, 0]


def test_slabs_are_in_view_and_in_front(generator):
    points = SlabPoints()(COUNT, 9, generator)
    assert points[..., 2].min() > 1.0
    tangent = points[..., :2] / points[..., 2:]
    assert tangent.abs().max() <= 0.9 + 1e-9
    assert (tangent.amax(1) - tangent.amin(1)).max() / 2 <= 0.8 + 1e-9
    # Thin slabs and deep ones both occur.
    relative_depth = points[..., 2].amax(1) / points[..., 2].amin(1)
    assert (relative_depth < 1.3).double().mean() > 0.05
    assert (relative_depth > 3.0).double().mean() > 0.05


def test_objects_are_in_view_and_some_are_planar(generator):
    points = ObjectPoints()(COUNT, 12, generator)
    centre = points.mean(1)
    assert 0.5 < centre[:, 2].min() < centre[:, 2].max() < 41
    assert (thinness(points) < 1e-9).double().mean().item() == pytest.approx(0.15, abs=0.015)


def test_points_behind_the_camera_come_with_outliers():
    def prior(batch_size, n, generator):
        return ObjectPoints()(batch_size, n, generator) - torch.tensor([0.0, 0.0, 1.5])

    p = draw(9, 500, points=prior, world_sigma=0.0)
    behind = p.true_cam_points[..., 2] <= 0
    assert behind.any()
    assert not p.inliers[behind].any()
    assert p.img_points.isfinite().all()


@pytest.mark.parametrize("prior", VIEWS)
def test_views_are_in_front_and_fill_a_window_of_their_field_of_view(prior, generator):
    points = prior(field_of_view=(15.0, 120.0), window=(1.0, 1.0))(4000, 60, generator)
    assert (points[..., 2] > 0).all()
    angle = 2 * (points[..., :2] / points[..., 2:]).abs().amax((1, 2)).atan().rad2deg()
    # The widest of 60 points is within a few percent of the edge.
    assert_uniform((angle[angle > 15] - 15).clamp(max=105)[:100], 0, 105)
    points = prior(field_of_view=(90.0, 90.0), window=(0.1, 0.1))(500, 400, generator)
    tangent = points[..., :2] / points[..., 2:]
    area = (tangent.amax(1) - tangent.amin(1)).prod(-1) / 4
    assert 0.09 < area.min() <= area.max() <= 0.1 + 1e-9


def test_surfaces_have_their_shapes(generator):
    view = {"field_of_view": (100.0, 100.0), "window": (1.0, 1.0)}
    facade, room, drive = (prior(**view)(500, 200, generator) for prior in VIEWS)
    # Most façades are one plane with a little relief; a wide view of a room shows several faces.
    assert 0.3 < (thinness(facade) < 0.02).double().mean() < 0.9
    assert (thinness(room) > 0.02).double().mean() > 0.9
    assert room.norm(dim=-1).max() < math.sqrt(15**2 + 15**2 + 5**2)
    assert (drive[..., 2].amax(1) / drive[..., 2].amin(1)).median() > 20
    assert 1.0 < drive[:, :, 1].amax(1).median() < 40.0  # the road is the lowest surface


@pytest.mark.parametrize("prior", VIEWS)
def test_inliers_of_views_project_within_the_noise(prior):
    p = draw(30, 500, points=prior(), outliers=OutlierMix(max_ratio=0.95, crowd_share=0.5), world_sigma=0.0)
    assert (p.true_cam_points[..., 2][p.inliers] > 0).all()
    assert_normal(reprojection(p)[p.inliers], 1.0)
