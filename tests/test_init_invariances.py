"""Laws that EPnP, EPPnP and REPPnP share: exact on exact pairs, equivariant, every problem alone."""

from __future__ import annotations

import pytest
import torch
from init_helpers import assert_same, flattened

from kornia_pnpnet import Pose, pose_errors
from kornia_pnpnet.init import EPnP, REPPnP

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


@pytest.mark.parametrize("init", [INITIALISERS["EPnP"], INITIALISERS["EPPnP"]])
def test_weights_count_pairs(init, make_problems, correspond):
    """A pair of weight 3 counts as three pairs, and a common factor of the weights does not matter."""
    corr, _ = correspond(make_problems(9, 50))
    times = torch.tensor([1, 3, 1, 1, 2, 1, 1, 1, 1])
    repeated = init(select(corr, torch.arange(9).repeat_interleave(times)))
    for factor in (1.0, 1e-6):
        weighted = init(corr._replace(weights=factor * times.double().expand(50, 9)))
        assert_same(weighted.pose, repeated.pose)
