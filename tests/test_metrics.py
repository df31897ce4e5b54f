"""Errors, success and its interval against closed forms and published values."""

import math

import numpy as np
import pytest
import torch
from strategies import ERRORS

from kornia_pnpnet import Pose, pose_errors, success, success_rate
from kornia_pnpnet.losses import pose_distances
from kornia_pnpnet.metrics import PoseErrors, reliability


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 9e-4, 1.1e-3, 1.0, math.pi / 2, math.pi - 1e-7, math.pi])
def test_errors_of_a_known_motion(angle, random_rotations):
    base = random_rotations(50, seed=1)
    here, there = torch.tensor([[1.0, 2, 3], [1, 5, 7]], dtype=torch.float64).unsqueeze(1).expand(2, 50, 3)
    estimate, truth = Pose(random_rotations(50, angle=angle, seed=2) @ base, here), Pose(base, there)
    errors = pose_errors(estimate, truth)
    expected = torch.full((50,), math.degrees(angle), dtype=torch.float64)
    torch.testing.assert_close(errors.rotation_error_deg, expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(errors.translation_error, torch.full((50,), 5.0).double())
    single = pose_errors(*(Pose(*(x.float() for x in pose)) for pose in (estimate, truth))).rotation_error_deg
    torch.testing.assert_close(single, expected.float(), rtol=1e-2, atol=1e-4)  # small angles are kept, too


def test_success_needs_both_and_is_strict():
    errors = PoseErrors(torch.tensor([0.99, 1.0, 0.99, 1.01]), torch.tensor([0.19, 0.19, 0.2, 0.21]))
    assert success(errors).tolist() == [True, False, False, False]
    assert success(errors, 2.0, 0.3).tolist() == [True] * 4
    assert success(errors, 2.0, torch.tensor([0.1, 0.2, 0.3, 0.1])).tolist() == [False, True, True, False]
    nan = PoseErrors(torch.tensor([math.nan, 0.1]), torch.tensor([0.1, math.nan]))
    assert success(nan).tolist() == [False, False]


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"),
    [
        # R. G. Newcombe, "Two-sided confidence intervals for the single proportion", 1998, table I, method 3.
        (81, 263, 0.2553, 0.3662),
        (0, 20, 0.0, 0.1611),
    ],
)
def test_the_interval_is_wilsons(successes, count, low, high):
    outcome = torch.tensor([True] * successes + [False] * (count - successes))
    rate = success_rate(outcome)
    assert rate.total == count
    assert rate.rate == pytest.approx(successes / count)
    assert rate.low == pytest.approx(low, abs=6e-5)
    assert rate.high == pytest.approx(high, abs=6e-5)
    mirrored = success_rate(~outcome)
    assert mirrored.low == pytest.approx(1 - rate.high)
    assert mirrored.high == pytest.approx(1 - rate.low)


def test_chances_that_come_true_have_no_calibration_error():
    """Outcomes drawn with their chances; with all chances doubled the error is what was added."""
    generator = torch.Generator().manual_seed(1)
    chances = 0.5 * torch.rand(200_000, generator=generator, dtype=torch.float64)
    outcomes = torch.rand(200_000, generator=generator, dtype=torch.float64) < chances
    found = reliability(chances.view(2, -1), outcomes.view(2, -1))
    assert found.number.sum() == 200_000
    assert found.expected_error < 0.01
    assert found.predicted[5:].isnan().all()  # no chance was that high
    assert reliability(2.0 * chances, outcomes).expected_error == pytest.approx(0.25, abs=0.01)


@pytest.mark.parametrize(("chances", "outcomes", "ranges"), [(3, 2, 10), (0, 0, 10), (3, 3, 0)])
def test_reliability_needs_as_many_outcomes_and_a_range(chances, outcomes, ranges):
    with pytest.raises(ERRORS):
        reliability(torch.rand(chances), torch.ones(outcomes).bool(), ranges)


@pytest.mark.parametrize("unit", [1e-30, 1e30])
def test_lengths_neither_overflow_nor_underflow(unit):
    truth = Pose(torch.eye(3)[None], torch.zeros(1, 3))
    estimate = Pose(torch.eye(3)[None], unit * torch.tensor([[3.0, 0.0, 4.0]]))
    for lengths in (pose_errors(estimate, truth)[1], pose_distances(estimate, truth)[1]):
        torch.testing.assert_close(lengths / unit, torch.tensor([5.0]))


@pytest.mark.parametrize("limit", [1, 1.0, np.float32(1.0), np.int64(1), torch.tensor(1.0), torch.ones(2)])
def test_limits_are_numbers_of_any_kind(limit):
    errors = PoseErrors(torch.tensor([0.5, 2.0]), torch.tensor([0.5, 0.5]))
    assert success(errors, max_translation=limit).tolist() == [True, False]
