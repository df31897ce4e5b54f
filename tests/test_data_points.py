"""Priors of points: where they put points in the camera's frame."""

import math

import pytest
import torch
from data_helpers import COUNT, assert_normal, assert_uniform, draw, reprojection

from kornia_pnpnet.data import (
    BoxPoints,
    DrivePoints,
    FacadePoints,
    ObjectPoints,
    OutlierMix,
    RoomPoints,
    SlabPoints,
)
from kornia_pnpnet.data.draws import batch_generator
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


VIEWS = [FacadePoints, RoomPoints, DrivePoints]


@pytest.mark.parametrize("prior", VIEWS)
def test_views_are_in_front_and_in_their_field_of_view(prior, generator):
    points = prior(field_of_view=(15.0, 120.0), window=(1.0, 1.0))(4000, 60, generator)
    assert points.isfinite().all()
    assert (points[..., 2] > 0).all()
    angle = 2 * (points[..., :2] / points[..., 2:]).abs().amax((1, 2)).atan().rad2deg()
    assert angle.max() <= 120 + 1e-6
    assert angle.min() > 13
    # The widest of 60 points is within a few percent of the edge.
    assert_uniform((angle[angle > 15] - 15).clamp(max=105)[:100], 0, 105)


@pytest.mark.parametrize("prior", VIEWS)
def test_views_fill_a_window_of_the_asked_share(prior, generator):
    points = prior(field_of_view=(90.0, 90.0), window=(0.1, 0.1))(500, 400, generator)
    tangent = points[..., :2] / points[..., 2:]
    area = (tangent.amax(1) - tangent.amin(1)).prod(-1) / 4
    assert area.max() <= 0.1 + 1e-9
    assert area.min() > 0.09


def test_facades_are_flat_up_to_their_relief_and_have_corners(generator):
    flat = FacadePoints(relief=(1e-9, 1e-9), corner=0.25, slant=30.0, window=(1.0, 1.0))(2000, 30, generator)
    values = torch.linalg.svdvals(flat - flat.mean(1, keepdim=True))
    thin = values[:, 2] / values[:, 0]
    assert 0.72 < (thin < 1e-6).double().mean() < 0.85  # of some corners one façade fills the window
    deep = FacadePoints(relief=(0.1, 0.1), corner=0.0, slant=0.0, distance=(10.0, 10.0))(2000, 30, generator)
    assert (deep[..., 2] > 10.5).double().mean().item() == pytest.approx(0.5, abs=0.01)
    assert deep[..., 2].mean().item() == pytest.approx(10.5, abs=0.02)


def test_rooms_are_boxes_with_furniture(generator):
    view = {"field_of_view": (100.0, 100.0), "window": (1.0, 1.0)}
    empty, full = (
        RoomPoints(side=(3.0, 4.0), height=(2.0, 3.0), furniture=k, **view)(500, 200, batch_generator(5, 0))
        for k in (0, 6)
    )
    assert empty.norm(dim=-1).max() < math.sqrt(4**2 + 4**2 + 3**2)
    # A wide view sees several faces of the room. Furniture hides parts of them.
    values = torch.linalg.svdvals(empty - empty.mean(1, keepdim=True))
    assert (values[:, 2] / values[:, 0] > 0.02).double().mean() > 0.9
    assert (full[..., 2] <= empty[..., 2]).all()
    assert 0.05 < (full[..., 2] < empty[..., 2]).double().mean() < 0.5


def test_drives_have_a_road_and_a_large_depth_range(generator):
    points = DrivePoints(turn=0.0, height=(1.5, 1.5), nearer=0.0, window=(1.0, 1.0), end=(100.0, 100.0))(
        500, 200, generator
    )
    assert points[..., 1].max() <= 1.5 + 1e-9
    assert points[..., 2].max() <= 100 + 1e-9
    assert ((points[..., 1] - 1.5).abs() < 1e-9).double().mean() > 0.2
    wide = points[(points[..., :2] / points[..., 2:]).abs().amax((1, 2)) > 0.8]
    assert (wide[..., 2].amax(1) / wide[..., 2].amin(1)).median() > 20


@pytest.mark.parametrize("prior", VIEWS)
def test_inliers_of_views_project_within_the_noise(prior):
    p = draw(30, 500, points=prior(), outliers=OutlierMix(max_ratio=0.95, crowd_share=0.5), world_sigma=0.0)
    assert (transform(p.pose, p.world_points)[..., 2][p.inliers] > 0).all()
    assert_normal(reprojection(p)[p.inliers], 1.0)
