"""Fuzz of the initialisers."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from strategies import are_rotations, correspondences, finite, gradients_are_finite, many, numbers

from kornia_pnpnet import MLPInit, SetInit
from kornia_pnpnet.propose.epnp import EPnP
from kornia_pnpnet.propose.minimal import SubsetSolver
from kornia_pnpnet.propose.p3p import P3P, p3p
from kornia_pnpnet.propose.ransac import RANSAC
from kornia_pnpnet.propose.reppnp import REPPnP

INITIALISERS = {
    "EPnP": EPnP(),
    "REPPnP": REPPnP(),
    "MLPInit": MLPInit(9),
    "SetInit": SetInit(),
    "RANSAC of P3P": RANSAC(P3P(), max_samples=40),
    "RANSAC of SubsetSolver": RANSAC(SubsetSolver(EPnP(), size=5), max_samples=10, min_samples=5),
}


@pytest.mark.parametrize("name", INITIALISERS)
def test_initialisers_take_anything(name):
    @many(30)
    @given(correspondences(9, scaled=name == "SetInit"))
    def run(case):
        corr, tensors = case
        init = INITIALISERS[name].to(corr.world_points.dtype)
        guess = init(corr)
        finite(guess.pose, guess.weights, guess.others, guess.noise)
        are_rotations(guess.pose.rotation[(corr.weights > 0).any(-1)])
        assert (guess.weights >= 0).all()
        gradients_are_finite([*guess.pose, guess.weights], tensors)

    run()


@many(80)
@given(st.data(), st.integers(0, 4), st.sampled_from([torch.float32, torch.float64]))
def test_p3p_takes_anything(data, batch, dtype):
    points = [data.draw(numbers(dtype, (batch, 3, size))).requires_grad_() for size in (3, 2)]
    found = p3p(*points)
    assert found.valid.shape == found.pose.rotation.shape[:2]
    are_rotations(found.pose.rotation[found.valid])
    finite(found)
    gradients_are_finite(found.pose, points)
