"""Priors of points: where they put points in the camera's frame; mixtures of sources, and batches of varying size."""

import math
from functools import partial

import pytest
import torch
from data_helpers import COUNT, assert_counts, assert_uniform, draw, same
from helpers import reprojection_errors
from kornia.core.exceptions import BaseError

from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.data import (
    BoxPoints,
    DrivePoints,
    FacadePoints,
    MixedPoints,
    MixedProblems,
    ObjectPoints,
    OutlierMix,
    RoomPoints,
    SlabPoints,
    SyntheticProblems,
    VaryingSize,
)

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


# --- mixtures ---------------------------------------------------------------------------------------------------------


def mixed(shares=None, batch_size=60, **chosen):
    """A mixture of three sources whose points are at the depths 1, 2 and 3."""
    planes = [partial(SyntheticProblems, points=BoxPoints(z_near=z, depth=0.0)) for z in (1.0, 2.0, 3.0)]
    chosen = {"world_sigma": 0.0, **chosen}
    return MixedProblems(planes, shares=shares, batch_size=batch_size, seed=7, n=4, dtype=torch.float64, **chosen)


@pytest.mark.parametrize("shares", [(1.0, 1.0, 1.0), (3.0, 1.0, 1.0)])
def test_mixed_sources_have_their_shares_in_every_part_of_a_batch(shares):
    p = mixed(shares).batch(0)
    depth = p.true_cam_points[..., 2]
    assert (depth.amax(1) - depth.amin(1)).max() < 1e-9, "a problem's points come from one source"
    for part in (slice(60), slice(20), slice(20, 40)):
        found = depth[part, 0].round().long().bincount(minlength=4)[1:]
        expected = torch.tensor(shares) / sum(shares) * len(depth[part])
        assert (found - expected).abs().max() <= 1


def test_mixed_sources_do_not_see_the_same_random_numbers_and_stay_whole():
    source = mixed(img_sigma=0.0, outliers=OutlierMix(count=1))
    p = map_tensors(lambda *x: torch.cat(x), *(source.batch(i) for i in range(3)))
    assert len(p.pose.translation.unique(dim=0)) == 180
    assert torch.equal(reprojection_errors(p).norm(dim=-1) < 1e-6, p.inliers)


def test_shares_that_do_not_fit_raise():
    for count, shares in ((0, None), (2, (1.0,)), (2, (1.0, 0.0)), (2, (1.0, -1.0))):
        with pytest.raises(BaseError, match=f"{count} sources"):
            MixedProblems([SyntheticProblems] * count, shares=shares)


def test_mixed_points_have_their_shares_in_small_batches_too(generator):
    planes = [BoxPoints(z_near=z, depth=0.0) for z in (1.0, 2.0, 3.0)]
    points = MixedPoints(planes, shares=(6.0, 3.0, 1.0))
    depth = torch.cat([points(3, 4, generator)[..., 2] for _ in range(2000)])
    assert torch.equal(depth, depth[:, :1].expand_as(depth)), "a problem's points come from one prior"
    assert_counts(depth[:, 0].round().long().bincount()[1:], (0.6, 0.3, 0.1))
    assert_counts(depth[::3, 0].round().long().bincount()[1:], (0.6, 0.3, 0.1))
    with pytest.raises(BaseError, match="2 priors"):
        MixedPoints(planes[:2], shares=(1.0,))


def test_covariances_are_known_of_all_problems_of_a_mixture_or_of_none():
    stretched = partial(SyntheticProblems, axis_ratio=3.0, known_noise=1.0)
    p = MixedProblems([stretched, stretched], batch_size=6, n=4).batch(0)
    assert (p.img_cov.shape, p.world_cov.shape) == ((6, 4, 2, 2), (6, 4, 3, 3))
    with pytest.raises(BaseError, match="covariances"):
        MixedProblems([stretched, SyntheticProblems], batch_size=6, n=4).batch(0)


def test_in_a_mixture_unknown_sigmas_are_nan_and_sigmas_of_pairs_go_with_those_of_problems():
    sources = [partial(SyntheticProblems, sigma_spread=x, known_noise=1.0) for x in (0.0, 0.5)]
    p = MixedProblems([SyntheticProblems, sources[0]], batch_size=10, n=4).batch(0)
    assert p.img_sigma.isnan().sum() == p.world_sigma.isnan().sum() == 5
    p = MixedProblems([*sources, SyntheticProblems], batch_size=30, n=4).batch(0)
    assert p.img_sigma.shape == p.world_sigma.shape == (30, 4)
    constant = (p.img_sigma == 1.0).all(1)
    assert (constant.sum(), p.img_sigma.isnan().all(1).sum()) == (10, 10)
    assert torch.equal(constant, (p.world_sigma == p.world_sigma[constant][0, 0]).all(1))


def test_varying_sizes_are_reproducible_and_come_from_the_list():
    mixture = partial(MixedProblems, [SyntheticProblems], known_noise=0.5)
    one, two = (VaryingSize(mixture, n=[5, 9, 20], batch_size=40, seed=3) for _ in range(2))
    assert all(same(one.batch(i), two.batch(i)) for i in range(30))
    assert {tuple(one.batch(i).inliers.shape) for i in range(30)} == {(40, 5), (22, 9), (10, 20)}
