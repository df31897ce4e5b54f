"""Laws of the verdict: which pairs are inliers, and how many inliers chance would give."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from kornia_pnpnet.geometry import transform
from kornia_pnpnet.refine.inliers import chance_of_inlier, chance_of_others

from kornia_pnpnet import Problem, create_solver, pose_errors
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.judge.inliers import Judged, Thresholds, log_false_alarms
from kornia_pnpnet.refine.inliers import chance_of_inlier
from kornia_pnpnet.judge.belief import LAWS, LEAST_PROBABILITY


@pytest.mark.parametrize(
    ("pixels", "errors", "expected"),
    [
        ([[0.0, 0.0], [400.0, 0.0], [0.0, 200.0]], [0.1, 0.25, 0.0], math.pi * 0.25 * 10.0**2 / (400.0 * 200.0)),
        ([[0.0, 0.0], [400.0, 0.0], [100.0, 0.0]], [1.0, 0.0, 0.0], 20.0 / 400.0),
        ([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], [1.0, 0.5, 0.0], 1.0),
    ],
    ids=["a disc in a box", "a strip of a thin box", "at most 1"],
)
def test_chance_is_the_share_of_the_box(pixels, errors, expected):
    corr = Problem(torch.zeros(1, 3, 3), torch.tensor([pixels]), torch.ones(1, 3), torch.tensor(100.0))
    thresholds = Thresholds(torch.tensor([10.0]), torch.zeros(1))
    judged = Judged(torch.ones(1, 3), torch.tensor([errors]))
    assert chance_of_inlier(corr, thresholds, judged).item() == pytest.approx(expected)
    nothing = torch.zeros(1, 3)
    assert chance_of_inlier(corr._replace(weights=nothing), thresholds, Judged(nothing, judged.errors)).item() == 0.0


def test_false_alarms_by_counting():
    for tested, inliers, count, chance in ((10, 5, 9, 0.01), (1, 4, 4, 0.3), (500, 30, 100, 0.001), (7, 3, 8, 0.5)):
        expected = tested * math.comb(count - 3, inliers - 3) * chance ** (inliers - 3)
        log = log_false_alarms(*(torch.tensor([x]) for x in (tested, inliers, count)), torch.tensor([chance]))
        assert log.item() == pytest.approx(math.log(expected), abs=1e-5)
    zero = torch.zeros(1, dtype=torch.long)
    for inliers, count in ((0, 0), (2, 2), (3, 3), (9, 9)):
        for chance in (0.0, 1.0):
            assert log_false_alarms(zero, zero + inliers, zero + count, torch.tensor([chance])).isfinite().all()


# --- the probability that a pose is not far off ---------------------------------------------------------------------


def of_solver(problems, effort=None, **told):
    solver = create_solver("pnpnet-set", effort=effort)
    return solver(problems.world_points, problems.img_points, problems.intrinsics, **told)


@pytest.mark.parametrize("told", [{}, {"img_sigma": 1.0, "world_sigma": 0.05}], ids=["found", "told"])
@pytest.mark.parametrize(("effort", "most"), [("fixed", 0.8), ("adaptive", LEAST_PROBABILITY)])
def test_probability_tells_sound_problems_from_random_pixels(effort, most, told):
    """Who searches longer finds better poses by chance, none of which is ``ok``."""
    sound = SyntheticProblems(n=20, batch_size=200, seed=3).batch(0)
    result = of_solver(sound, effort, **told)
    assert result.probability.median() > 0.99
    noise = sound._replace(img_points=sound.img_points.roll(1, 0))  # the pixels of another problem
    wrong = of_solver(noise, effort, **told)
    # The law is that of problems most of which have a pose.
    assert wrong.probability.median() < most
    assert not wrong.ok.double().mean() > 0.05
    for found in (result, wrong):
        assert ((found.probability >= 0) & (found.probability <= 1)).all()
        assert not found.probability.requires_grad


def test_probability_falls_with_the_noise_of_few_pairs():
    """Of six pairs: the more noise, the wider the poses that fit."""
    means = []
    for sigma in (0.3, 10.0, 60.0):
        problems = SyntheticProblems(n=6, batch_size=300, seed=4, img_sigma=sigma, world_sigma=0.0).batch(0)
        means.append(of_solver(problems, img_sigma=sigma, world_sigma=0.0).probability.mean().item())
    assert means[0] > 0.97
    assert means == sorted(means, reverse=True)
    assert means[2] < means[0] - 0.1


def test_probability_is_observed_as_often():
    """Problems with many outliers, by the law's own definition of far off."""
    problems = SyntheticProblems(n=12, batch_size=1500, seed=5, outliers=OutlierMix(max_ratio=0.8)).batch(0)
    result = of_solver(problems)
    errors = pose_errors(result.pose, problems.pose)
    depth = (problems.world_points @ problems.pose.rotation.mT + problems.pose.translation[:, None])[..., 2].median(1)[
        0
    ]
    centres = [-(pose.rotation.mT @ pose.translation[..., None])[..., 0] for pose in (result.pose, problems.pose)]
    near = (errors.rotation_error_deg <= 10) & ((centres[0] - centres[1]).norm(dim=-1) <= 0.3 * depth)
    sure = result.probability > 0.9
    assert near[sure].double().mean() > 0.9
    assert near[~sure].double().mean() < near[sure].double().mean() - 0.2


def test_laws_are_those_of_the_results_file():
    file = Path(__file__).parents[1] / "docs" / "results" / "probability.json"
    assert {name: list(law) for name, law in LAWS.items()} == json.loads(file.read_text())["laws"]
