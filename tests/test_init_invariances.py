"""Laws that EPnP, EPPnP and REPPnP share: exact on exact pairs, equivariant, every problem alone."""

from __future__ import annotations

import pytest
import torch
from init_helpers import assert_same, change, flattened

from kornia_pnpnet import Pose, Problem, pose_errors
from kornia_pnpnet.propose.epnp import EPnP
from kornia_pnpnet.propose.reppnp import REPPnP

INITIALISERS = {"EPnP": EPnP(), "EPPnP": REPPnP(reject_outliers=False), "REPPnP": REPPnP()}


@pytest.fixture(params=INITIALISERS)
def init(request):
    return INITIALISERS[request.param]


def select(corr, pairs):
    """Some of the pairs of every problem."""
    return corr.map(lambda x: x[:, pairs] if x.ndim > 1 else x)


@pytest.mark.parametrize(("n", "planar"), [(6, False), (50, False), (5, True), (20, True)])
def test_exact_pairs_give_the_exact_pose(init, n, planar, make_problems, correspond):
    corr, truth = correspond(make_problems(n, 100, noise=False))
    corr = flattened(corr, truth) if planar else corr
    guess = init(corr)
    assert guess.ok.all()
    assert guess.weights.all()
    assert_same(guess.pose, truth, 1e-6)
    single = pose_errors(init(corr.map(torch.Tensor.float)).pose, Pose(*(x.float() for x in truth)))
    assert single.rotation_error_deg.max() < 0.05
    assert single.translation_error.max() < 0.02


@pytest.mark.parametrize("planar", [False, True])
def test_the_pose_follows_order_frame_and_unit_of_the_world(
    init, planar, make_problems, correspond, random_rotations, generator
):
    outliers = 5 if init is INITIALISERS["REPPnP"] and not planar else 0
    corr, truth = correspond(make_problems(20, 50, outliers=outliers))
    corr = flattened(corr, truth) if planar else corr
    guess = init(corr)
    order = torch.randperm(20, generator=generator)
    shuffled = init(select(corr, order))
    assert torch.equal(guess.weights[:, order], shuffled.weights)
    assert_same(guess.pose, shuffled.pose)
    rotation, shift, scale = random_rotations(50), torch.tensor([3.0, -5.0, 2.0], dtype=torch.float64), 37.0
    moved = init(change(corr, world_points=scale * corr.world_points @ rotation.mT + shift))
    assert torch.equal(guess.weights, moved.weights)
    expected = guess.pose.rotation @ rotation.mT
    assert_same(moved.pose, Pose(expected, scale * guess.pose.translation - expected @ shift), 1e-6)


@pytest.mark.parametrize("init", [INITIALISERS["EPnP"], INITIALISERS["EPPnP"]])
def test_weights_count_pairs(init, make_problems, correspond):
    """A pair of weight 3 counts as three pairs, and a common factor of the weights does not matter."""
    corr, _ = correspond(make_problems(9, 50))
    times = torch.tensor([1, 3, 1, 1, 2, 1, 1, 1, 1])
    repeated = init(select(corr, torch.arange(9).repeat_interleave(times)))
    for factor in (1.0, 1e-6):
        weighted = init(corr._replace(weights=factor * times.double().expand(50, 9)))
        assert_same(weighted.pose, repeated.pose)


def test_a_pair_with_weight_zero_is_ignored(init, make_problems, correspond, generator):
    corr, _ = correspond(make_problems(12, 50, outliers=2))
    weights = 0.5 + torch.rand(50, 12, generator=generator, dtype=torch.float64)
    keep = [0, 2, 3, 5, 6, 7, 8, 10, 11]
    removed = init(select(corr._replace(weights=weights), keep))
    pixels = corr.img_points.clone()
    for dropped in (1, 4, 9):
        weights[:, dropped], pixels[:, dropped] = 0.0, 1e4
    zero = init(corr._replace(weights=weights, img_points=pixels))
    assert torch.equal(zero.weights[:, keep], removed.weights)
    assert torch.equal(zero.ok, removed.ok)
    assert_same(Pose(*(x[zero.ok] for x in zero.pose)), Pose(*(x[zero.ok] for x in removed.pose)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_problems_without_a_pose_are_not_ok(init, dtype, make_problems, correspond):
    corr = correspond(make_problems(9, 5))[0].map(lambda x: x.to(dtype))
    world, weights = corr.world_points, corr.weights.clone()
    weights[:, 3:] = 0.0
    for spoilt in (
        change(corr, world_points=world[:, :, :1].expand_as(world)),  # a line
        change(corr, world_points=world[:, :1].expand_as(world)),  # a point
        corr._replace(weights=weights),  # three pairs
        corr._replace(weights=torch.zeros_like(weights)),
        select(corr, slice(3)),
    ):
        guess = init(spoilt)
        assert not guess.ok.any()
        assert all(x.isfinite().all() for x in (*guess.pose, guess.weights))
    empty = Problem(torch.zeros(0, 9, 3), torch.zeros(0, 9, 2), torch.zeros(0, 9), torch.tensor(3400.0))
    assert init(empty).pose.matrix.shape == (0, 4, 4)
