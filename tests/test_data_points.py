"""Priors of points: where they put points in the camera's frame."""

import pytest
import torch
from data_helpers import COUNT, assert_uniform, draw

from kornia_pnpnet.data import BoxPoints, ObjectPoints, SlabPoints
from kornia_pnpnet.geometry import transform


def test_box_constants_are_arguments(generator):
    points = BoxPoints(half_width=1.0, z_near=5.0, depth=2.0)(COUNT, 3, generator)
    assert_uniform(points[..., :2], -1, 1)
    assert_uniform(points[..., 2], 5, 7)


@pytest.mark.parametrize("field_of_view", [0.9, 0.6])
def test_slabs_are_in_view_and_in_front(field_of_view, generator):
    window = (0.15, min(0.8, field_of_view))
    points = SlabPoints(field_of_view=field_of_view, window=window)(COUNT, 9, generator)
    assert points.shape == (COUNT, 9, 3)
    assert points.isfinite().all()
    assert points[..., 2].min() > 1.0
    tangent = points[..., :2] / points[..., 2:]
    assert tangent.abs().max() <= field_of_view + 1e-9
    half = (tangent.amax(1) - tangent.amin(1)) / 2
    assert half.max() <= window[1] + 1e-9
    # Thin slabs and deep ones both occur.
    relative_depth = points[..., 2].amax(1) / points[..., 2].amin(1)
    assert (relative_depth < 1.3).double().mean() > 0.05
    assert (relative_depth > 3.0).double().mean() > 0.05


def test_objects_are_where_they_were_put(generator):
    points = ObjectPoints(distance=(3.0, 30.0), field_of_view=0.5, planar=0.25)(COUNT, 12, generator)
    centre = points.mean(1)
    assert centre[:, 2].min() > 1.5
    assert centre[:, 2].max() < 32
    values = torch.linalg.svdvals(points - centre[:, None])
    assert (values[:, 2] < 1e-9).double().mean().item() == pytest.approx(0.25, abs=0.015)
    assert (values[:, 1] > 1e-3).all()


def test_points_behind_the_camera_come_with_outliers():
    p = draw(9, 500, points=ObjectPoints(distance=(0.5, 1.0)), world_sigma=0.0)
    behind = transform(p.pose, p.world_points)[..., 2] <= 0
    assert behind.any()
    assert not p.inliers[behind].any()
    assert p.img_points.isfinite().all()
