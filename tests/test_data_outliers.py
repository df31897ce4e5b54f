"""Outliers: their number, their positions and the pixels of each kind."""

import math

import pytest
import torch
from data_helpers import COUNT, assert_counts, assert_normal, assert_uniform, draw
from helpers import reprojection_errors
from kornia.core.exceptions import BaseError

from kornia_pnpnet import create_solver
from kornia_pnpnet.data import OutlierKind, OutlierMix


def counts(mix, n=9):
    return (~draw(n, outliers=mix).inliers).sum(-1).bincount()


def test_the_number_of_outliers_is_uniform_or_exact():
    for n in (9, 20):
        found = counts(OutlierMix(), n)
        assert len(found) == n // 3 + 1
        assert_counts(found)
    found = counts(OutlierMix(min_count=2))
    assert found[:2].tolist() == [0, 0]
    assert_counts(found[2:])
    for count in (0, 3, 9):
        assert counts(OutlierMix(count=count)).tolist() == [0] * count + [COUNT]


def test_the_largest_number_of_outliers():
    for n in range(3, 16):
        assert OutlierMix(max_ratio=0.33).max_count(n) == OutlierMix().max_count(n) == n // 3
    assert [OutlierMix().max_count(n) for n in (20, 21, 50, 51)] == [6, 7, 16, 17]
    assert [OutlierMix(max_ratio=0.6, min_inliers=4).max_count(n) for n in (3, 6, 20)] == [0, 2, 12]


@pytest.mark.parametrize("n", [9, 20])
def test_outliers_are_at_random_positions(n):
    two = (~draw(n, outliers=OutlierMix(count=2)).inliers).double()
    assert_counts(two.sum(0))
    # Pairs of positions are as likely as each other: none attracts or repels its neighbour.
    together = two.T @ two / COUNT
    expected = 2 / (n * (n - 1))
    pairs = together[~torch.eye(n, dtype=torch.bool)]
    assert (pairs - expected).abs().max() < 4.5 * math.sqrt(expected / COUNT)


def test_mismatches_have_their_share(generator):
    found = OutlierMix(count=3, mismatch_share=0.2).draw(COUNT, 9, generator).flatten().bincount()
    assert found[OutlierKind.INLIER] == 6 * COUNT
    assert_counts(found[[OutlierKind.MISMATCH, OutlierKind.SENSING]], (0.2, 0.8))


def test_sensing_pixels_are_anywhere_in_the_image():
    p = draw(9, 5000, outliers=OutlierMix(count=3, mismatch_share=0.0), half_image=10.0, img_sigma=0.0)
    assert_uniform(p.img_points[~p.inliers][:, 0], -10, 10)
    assert_uniform(p.img_points[~p.inliers][:, 1], -10, 10)


def test_mismatched_pixels_belong_to_another_point_of_the_box():
    p = draw(9, 5000, outliers=OutlierMix(count=3, mismatch_share=1.0), world_sigma=0.0, img_sigma=0.0)
    plain = draw(9, 5000, world_sigma=0.0, img_sigma=0.0)
    assert reprojection_errors(p)[p.inliers].abs().max() < 1e-8
    assert (reprojection_errors(p)[~p.inliers].norm(dim=-1) > 1.0).double().mean() > 0.999
    # Distributed like the pixels of inliers: the deciles hold a tenth each.
    other = p.img_points[~p.inliers]
    deciles = plain.img_points[..., 0].flatten().quantile(torch.linspace(0.1, 0.9, 9, dtype=torch.float64))
    shares = torch.bucketize(other[:, 0].contiguous(), deciles).bincount(minlength=10) / len(other)
    assert (shares - 0.1).abs().max() < 4 * math.sqrt(0.09 / len(other))


@pytest.mark.parametrize("mismatch_share", [0.0, 1.0])
def test_pixels_of_outliers_have_noise(mismatch_share):
    mix = OutlierMix(count=3, mismatch_share=mismatch_share)
    clean, noisy = (draw(9, 5000, outliers=mix, world_sigma=0.0, img_sigma=sigma) for sigma in (0.0, 1.0))
    assert_normal((noisy.img_points - clean.img_points)[~clean.inliers], 1.0)


def test_near_outliers_have_distances_in_pixels_beyond_the_noise():
    p = draw(9, 2000, outliers=OutlierMix(count=3, near_share=1.0), world_sigma=0.0)
    off = reprojection_errors(p).norm(dim=-1)
    assert off[p.inliers].max() < 5.5
    assert 1.0 < off[~p.inliers].min() < off[~p.inliers].max() < 55.0
    mix = OutlierMix(count=3, near_share=1.0, near_pixels=(3.0, 30.0))
    off = reprojection_errors(p := draw(9, outliers=mix, world_sigma=0.0, img_sigma=1e-6)).norm(dim=-1)[~p.inliers]
    assert_uniform(off.log(), math.log(3.0) - 1e-5, math.log(30.0) + 1e-5)
    off = reprojection_errors(p := draw(9, 2000, outliers=mix, world_sigma=0.0, img_sigma=5.0)).norm(dim=-1)[~p.inliers]
    assert off.min() > 25 - 4 * 5  # 5 and 10 standard deviations, with noise
    assert off.max() < 50 + 5 * 5


def test_crowds_have_their_share(generator):
    kind = OutlierMix(count=30, crowd_share=0.3).draw(COUNT, 40, generator)
    found = (kind == OutlierKind.CROWD).sum(-1)
    # A uniform share of 30 outliers gives each number from 0 to 30 with the same probability.
    assert_counts(torch.stack(((found == 0).sum(), (found > 0).sum())), (0.7 + 0.3 / 31, 0.3 * 30 / 31))
    assert_counts(found.bincount()[1:].unflatten(0, (10, 3)).sum(-1)[:9])
    assert ((kind == OutlierKind.INLIER).sum(-1) == 10).all()


def test_crowds_share_few_pixels():
    p = draw(40, 2000, outliers=OutlierMix(count=30, crowd_share=1.0, max_crowds=3), world_sigma=0.0)
    alike = (p.img_points[:, :, None] == p.img_points[:, None]).all(-1)  # (B, n, n)
    members = alike.sum(-1)
    first = alike.long().argmax(-1) == torch.arange(40)  # the first pair with its pixel
    pixels = ((members > 1) & first).sum(-1)
    assert pixels.max() == 3
    assert (pixels.bincount()[1:] > 400).all()
    assert 0.01 < (members[p.inliers] > 1).double().mean() < 0.1, "some crowds gather on the pixel of an inlier"
    assert reprojection_errors(p)[p.inliers].norm(dim=-1).max() < 6


def test_crowds_of_a_point_have_many_pixels():
    mix = OutlierMix(count=30, crowd_share=1.0, max_crowds=3, point_crowd_share=0.25)
    p = draw(40, 2000, outliers=mix, world_sigma=0.0)
    points, pixels = (
        ((x[:, :, None] == x[:, None]).all(-1).sum(-1) > 1).any(-1) for x in (p.world_points, p.img_points)
    )
    assert not (points & pixels).any()
    assert_counts(torch.stack((points.sum(), pixels.sum())), (0.25, 0.75))
    assert reprojection_errors(p)[p.inliers].norm(dim=-1).max() < 6


@pytest.mark.parametrize(("mirrored", "angle"), [(0.0, 0.0), (1.0, 0.0), (0.0, math.pi)])
def test_structured_outliers_agree_on_another_pose_of_the_points_or_of_mirrored_points(mirrored, angle):
    options = {"structured_share": 1.0, "mirrored_share": mirrored, "structured_angle": angle}
    p = draw(24, 50, outliers=OutlierMix(count=6, **options), img_sigma=0.0, world_sigma=0.0)
    six = (~p.inliers).sum(-1) == 6  # a moved point that is not in front of the camera is an outlier as well
    wrong = ~p.inliers[six]
    world, img = (x[six][wrong].unflatten(0, (-1, 6)) for x in (p.world_points, p.img_points))
    agree = []
    for sign in (1.0, -1.0):
        points = world * torch.tensor([sign, 1.0, 1.0], dtype=world.dtype)
        result = create_solver("epnp-lm")(points, img, p.intrinsics[six])
        agree.append((result.ok & (result.cost < 1e-3)).double().mean().item())
    assert agree[int(mirrored)] > 0.5
    assert agree[1 - int(mirrored)] < 0.1


def test_more_outliers_than_pairs_raise(generator):
    with pytest.raises(BaseError, match=r"10 outliers.*9"):
        OutlierMix(count=10).draw(1, 9, generator)
