"""Outliers: their number, their positions and the pixels of each kind."""

import math

import pytest
import torch
from data_helpers import COUNT, assert_counts, assert_normal, assert_uniform, draw, reprojection
from kornia.core.exceptions import BaseError

from kornia_pnpnet import create_solver
from kornia_pnpnet.data import BoxPoints, OutlierMix, SlabPoints


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
    assert_counts((~draw(n, outliers=OutlierMix()).inliers).sum(0))
    # Pairs of positions are as likely as each other: none attracts or repels its neighbour.
    two = (~draw(n, outliers=OutlierMix(count=2)).inliers).double()
    together = two.T @ two / COUNT
    expected = 2 / (n * (n - 1))
    pairs = together[~torch.eye(n, dtype=torch.bool)]
    assert (pairs - expected).abs().max() < 4.5 * math.sqrt(expected / COUNT)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 1.0])
def test_mismatches_have_their_share(share, generator):
    kinds = OutlierMix(count=3, mismatch_share=share).draw(COUNT, 9, generator)
    assert not (kinds.mismatch & kinds.sensing).any()
    assert torch.equal(kinds.inliers, ~(kinds.mismatch | kinds.sensing))
    found = torch.stack((kinds.mismatch.sum(), kinds.sensing.sum()))
    if share in (0.0, 1.0):
        assert found.tolist() == [share * 3 * COUNT, (1 - share) * 3 * COUNT]
    else:
        assert_counts(found, (share, 1 - share))


def test_sensing_pixels_are_anywhere_in_the_image_with_noise():
    mix = OutlierMix(count=3, mismatch_share=0.0)
    clean, noisy = (draw(9, 5000, outliers=mix, world_sigma=0.0, img_sigma=sigma) for sigma in (0.0, 1.0))
    wrong = ~clean.inliers
    assert_uniform(clean.img_points[wrong][:, 0], -3400, 3400)
    assert_uniform(clean.img_points[wrong][:, 1], -3400, 3400)
    assert_normal((noisy.img_points - clean.img_points)[wrong], 1.0)
    small = draw(9, 500, outliers=mix, half_image=10.0, img_sigma=0.0)
    assert small.img_points[~small.inliers].abs().max() <= 10


def test_mismatched_pixels_belong_to_another_point_of_the_box_with_noise():
    mix = OutlierMix(count=3, mismatch_share=1.0)
    clean, noisy = (draw(9, 5000, outliers=mix, world_sigma=0.0, img_sigma=sigma) for sigma in (0.0, 1.0))
    plain = draw(9, 5000, world_sigma=0.0, img_sigma=0.0)
    wrong = ~clean.inliers
    assert reprojection(clean)[~wrong].abs().max() < 1e-8
    other = clean.img_points[wrong]
    assert other.abs().max() <= 3400 + 1e-9
    assert (reprojection(clean)[wrong].norm(dim=-1) > 1.0).double().mean() > 0.999
    # Distributed like the pixels of inliers: the deciles hold a tenth each.
    deciles = plain.img_points[..., 0].flatten().quantile(torch.linspace(0.1, 0.9, 9, dtype=torch.float64))
    shares = torch.bucketize(other[:, 0].contiguous(), deciles).bincount(minlength=10) / len(other)
    assert (shares - 0.1).abs().max() < 4 * math.sqrt(0.09 / len(other))
    # ... and independent of the true pixel.
    both = torch.stack((other[:, 0], (clean.img_points + reprojection(clean))[wrong][:, 0]))
    assert torch.corrcoef(both)[0, 1].abs() < 0.04
    assert_normal((noisy.img_points - clean.img_points)[wrong], 1.0)


@pytest.mark.parametrize("points", [BoxPoints(), SlabPoints()], ids=["box", "slab"])
def test_a_mismatch_shows_another_point_of_the_same_scene(points):
    """Its pixel lies among those of inliers: otherwise its place alone would give it away, as in no real image."""
    p = draw(20, 4000, points=points, outliers=OutlierMix(count=1, mismatch_share=1.0), img_sigma=0.0, world_sigma=0.0)
    right = torch.where(p.inliers[..., None], p.img_points, torch.nan)
    low, high = right.nan_to_num(math.inf).amin(1), right.nan_to_num(-math.inf).amax(1)
    wrong = p.img_points[~p.inliers]
    # One more uniform point falls outside the range of 19 with probability 2/20 on each axis.
    outside = ((wrong < low) | (wrong > high)).double().mean()
    assert 0.08 < outside < 0.12


def test_near_outliers_are_a_little_off():
    p = draw(9, 2000, outliers=OutlierMix(count=3, near_share=1.0), world_sigma=0.0)
    off = reprojection(p).norm(dim=-1)
    assert (p.inliers.sum(-1) == 6).all()
    assert off[p.inliers].max() < 5.5
    assert off[~p.inliers].min() > 1.0
    assert off[~p.inliers].max() < 55.0


def test_structured_outliers_agree_on_another_pose():
    mix = OutlierMix(count=6, structured_share=1.0)
    p = draw(24, 50, outliers=mix, img_sigma=0.0, world_sigma=0.0)
    wrong = ~p.inliers
    assert (wrong.sum(-1) >= 6).all()  # a moved point that is not in front of the camera is wrong as well
    six = wrong.sum(-1) == 6
    world, img = (x[six][wrong[six]].unflatten(0, (-1, 6)) for x in (p.world_points, p.img_points))
    result = create_solver("epnp-lm")(world, img, p.intrinsics[six])
    assert (result.ok & (result.cost < 1e-3)).sum() > 20


def test_impossible_mixes_raise(generator):
    with pytest.raises(BaseError, match=r"10 outliers.*9"):
        OutlierMix(count=10).draw(1, 9, generator)
    with pytest.raises(TypeError, match="ratio"):
        OutlierMix(ratio=0.2)
