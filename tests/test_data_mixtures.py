"""Mixtures of sources and batches of varying size."""

from functools import partial

import pytest
import torch
from data_helpers import assert_counts, reprojection, same
from kornia.core.exceptions import BaseError

from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.data import BoxPoints, MixedPoints, MixedProblems, OutlierMix, SyntheticProblems, VaryingSize


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
    assert torch.equal(reprojection(p).norm(dim=-1) < 1e-6, p.inliers)


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
