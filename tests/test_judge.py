"""Which pairs are inliers, and how many inliers chance would give, and how probable a pose is."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from kornia.geometry.linalg import transform_points

from kornia_pnpnet import Pose, create_solver, pose_errors
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.judge.belief import LAWS, LEAST_PROBABILITY
from kornia_pnpnet.judge.inliers import Judged, Thresholds, judge, log_false_alarms
from kornia_pnpnet.problem import Problem, State
from kornia_pnpnet.refine.residual import project


def alarms(pixels, errors, tested, weights=None):
    """log_false_alarms of pairs whose points are seen at the origin; with an error of at most 1 a pair is an inlier."""
    count = len(pixels)
    world = torch.tensor([[[0.0, 0.0, 4.0]]]).expand(1, count, 3)
    weights = torch.ones(1, count) if weights is None else weights
    problem = Problem.of(world, torch.tensor([pixels]), 100.0, weights=weights)
    errors = torch.tensor([errors])
    judged = Judged(((errors < 1.0) & (weights > 0)).float(), errors)
    thresholds = Thresholds(torch.full((1, 1), 10.0), torch.zeros(1, 1))
    projection = project(State.of(Pose(torch.eye(3)[None], torch.zeros(1, 3))), problem)
    return log_false_alarms(torch.tensor([tested]), projection, problem, thresholds, judged).item()


BOX = [[-400.0, -200.0], [400.0, -200.0], [-400.0, 200.0], [400.0, 200.0]]
SIX = [*BOX, [-390.0, 190.0], [390.0, -190.0]]
DISC = math.pi * 0.25 * 10.0**2 / (800.0 * 400.0)
#: Pixels, squared errors, number of tested poses, and the expected number of false alarms.
ALARMS = {
    "a disc in a box": (BOX, [0.1, 0.25, 0.0, 0.0], 1, DISC),
    "a strip of a thin box": (
        [[-200.0, 50.0], [200.0, 50.0], [100.0, 50.0], [90.0, 50.0]],
        [0.999999, 0.0, 0.0, 0.0],
        1,
        20.0 / 400.0,
    ),
    "at most 1": ([[60.0, 50.0], [61.0, 50.0], [60.0, 51.0], [61.0, 51.0]], [0.999999, 0.5, 0.0, 0.0], 1, 1.0),
    "each tested pose is a chance": (BOX, [0.25] * 4, 10, 10 * DISC),
    "five inliers": (SIX[:5], [0.25] * 5, 500, 500 * DISC**2),
    "each choice of the inliers besides three is a chance": (SIX[:5], [0.25] * 4 + [1e9], 7, 7 * 2 * DISC),
    "three of six pairs decide": (SIX, [0.25] * 4 + [1e9] * 2, 1, 3 * DISC),
    "no inlier": (BOX[:2], [1e9] * 2, 7, 7.0),
    "three inliers": (BOX[:3], [0.25] * 3, 7, 7.0),
    # Two outliers, of three pairs, are in a disc whose area is 600 times as large.
    "close outliers": (SIX, [0.25] * 4 + [150.0] * 2, 1, 3 * 2 / 3 / 600),
    # All points are seen at the origin: ten pixels are near another point, and four are ignored, of thirty.
    "pixels near other points": ([*BOX, [0.0, 0.0], [0.0, 0.5]], [0.25] * 4 + [1e9] * 2, 1, 3 * 6 / 30),
}


@pytest.mark.parametrize("name", ALARMS)
def test_false_alarms_by_counting(name):
    pixels, errors, tested, expected = ALARMS[name]
    assert alarms(pixels, errors, tested) == pytest.approx(math.log(expected), abs=1e-4)
    weights = torch.tensor([[1.0] * len(pixels) + [0.0]])  # padding is not in the box
    padded = alarms([*pixels, [1e4, 1e4]], [*errors, 0.0], tested, weights)
    assert padded == pytest.approx(math.log(expected), abs=1e-4)


def test_an_inlier_is_within_the_thresholds_of_pixel_and_point():
    """At depth 4 and focal length 100 a point that is off by 0.2 is off by 5 pixels."""
    problem = Problem.of(
        torch.tensor([[[0.0, 0.0, 4.0], [0.2, 0.0, 4.0], [0.48, 0.0, 4.0], [0.0, 0.0, -4.0]]]),
        torch.zeros(1, 4, 2),
        100.0,
    )
    projection = project(State.of(Pose(torch.eye(3)[None], torch.zeros(1, 3))), problem)
    judged = judge(projection, problem, Thresholds(torch.tensor([[10.0]]), torch.tensor([[0.2]])))
    torch.testing.assert_close(judged.errors[0, :3], torch.tensor([0.0, 25.0, 144.0]) / 125.0)
    torch.testing.assert_close(judged.weights, torch.tensor([[0.8, 0.8, 0.0, 0.0]]))
    assert judged.inliers.tolist() == [2]


# --- the probability that a pose is not far off ---------------------------------------------------------------------


def solve(problems, **options):
    return create_solver("pnpnet-set", effort=options.pop("effort", None))(*problems[:3], **options)


@pytest.mark.parametrize("sigmas", [{}, {"img_sigma": 1.0, "world_sigma": 0.05}], ids=["unknown", "given"])
@pytest.mark.parametrize(("effort", "most"), [("fixed", 0.8), ("adaptive", LEAST_PROBABILITY)])
def test_probability_tells_sound_problems_from_random_pixels(effort, most, sigmas):
    """Who searches longer finds better poses by chance, none of which is ``ok``."""
    sound = SyntheticProblems(n=20, batch_size=200, seed=3).batch(0)
    random = sound._replace(img_points=sound.img_points.roll(1, 0))  # the pixels of another problem
    found, wrong = (solve(x, effort=effort, **sigmas) for x in (sound, random))
    assert found.probability.median() > 0.99
    assert wrong.probability.median() < most  # the law is that of problems most of which have a pose
    assert not wrong.ok.double().mean() > 0.05
    for probability in (found.probability, wrong.probability):
        assert ((probability >= 0) & (probability <= 1)).all()
        assert not probability.requires_grad


def test_probability_is_observed_as_often():
    """Problems with many outliers, by the law's own definition of far off."""
    p = SyntheticProblems(n=12, batch_size=1500, seed=5, outliers=OutlierMix(max_ratio=0.8)).batch(0)
    result = solve(p)
    depth = transform_points(p.pose.matrix, p.world_points)[..., 2].median(1).values
    found, true = (-(x.rotation.mT @ x.translation[..., None])[..., 0] for x in (result.pose, p.pose))  # centres
    near = pose_errors(result.pose, p.pose).rotation_error_deg <= 10
    near &= (found - true).norm(dim=-1) <= 0.3 * depth
    sure = result.probability > 0.9
    assert near[sure].double().mean() > 0.9
    assert near[~sure].double().mean() < near[sure].double().mean() - 0.2


def test_laws_are_those_of_the_results_file():
    file = Path(__file__).parents[1] / "docs" / "results" / "probability.json"
    assert {name: list(law) for name, law in LAWS.items()} == json.loads(file.read_text())["laws"]
