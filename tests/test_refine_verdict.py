"""Laws of the verdict: which pairs are inliers, and how many inliers chance would give."""

from __future__ import annotations

import json
import math
from pathlib import Path
from unittest import mock

import pytest
import torch
from kornia_pnpnet.geometry import transform
from kornia_pnpnet.refine.inliers import chance_of_inlier, chance_of_others

from kornia_pnpnet import Pose, Problem, create_solver, pose_errors
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.judge.belief import LAWS, LEAST_PROBABILITY
from kornia_pnpnet.judge.inliers import MAX_ERROR, Judged, Thresholds, judge, log_false_alarms
from kornia_pnpnet.refine import scale
from kornia_pnpnet.refine.residual import project


def test_inliers_weigh_by_the_inverse_of_their_threshold(make_problems, correspond):
    corr, truth = correspond(make_problems(9, 7, outliers=2))
    corr = corr._replace(weights=torch.ones_like(corr.weights).index_fill(1, torch.tensor([3]), 0.0))
    limits = torch.linspace(5.0, 50.0, 7, dtype=torch.float64)
    thresholds = Thresholds(limits, limits / 500)
    projection = project(truth, corr)
    judged = judge(projection, corr, thresholds)
    depth = transform(truth, corr.world_points)[..., 2]
    sq_limit = limits[:, None] ** 2 + (corr.focal * thresholds.world[:, None] / depth) ** 2
    inlier = projection.in_front & (projection.sq_residual < sq_limit) & (corr.weights > 0)
    assert inlier.any()
    assert not inlier.all()
    assert torch.equal(judged.weights > 0, inlier)
    torch.testing.assert_close(judged.weights[inlier], (limits[:, None] ** 2 / sq_limit)[inlier])
    plain = judge(projection, corr, thresholds._replace(world=torch.zeros_like(limits)))
    assert set(plain.weights.unique().tolist()) == {0.0, 1.0}
    back = truth._replace(translation=truth.translation - 1e4)
    judged = judge(project(back, corr), corr, thresholds)
    assert (judged.errors == MAX_ERROR).all()
    assert not judged.weights.any()


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


def test_outliers_close_to_their_projections_make_a_fit_likely_by_chance():
    """Two of five other pairs are outliers within thirty radii of the worst inlier's disc."""
    pixels = torch.zeros(1, 8, 2, dtype=torch.float64)
    pixels[0, 0], pixels[0, 1] = 1e4, -1e4
    corr = Problem(pixels.new_zeros(1, 8, 3), pixels, pixels.new_ones(1, 8), pixels.new_tensor(100.0))
    thresholds = Thresholds(pixels.new_tensor([1.0]), pixels.new_tensor([0.0]))
    weights = pixels.new_tensor([[1.0, 1, 1, 1, 1, 1, 0, 0]])

    def chance(*far):
        errors = pixels.new_tensor([[0.25, 0, 0, 0, 0, 0, *far]])
        return chance_of_inlier(corr, thresholds, Judged(weights, errors)).item()

    alone = chance(1e5, 1e6)
    assert chance(225.0, 1e6) == alone  # one outlier may be a slip
    assert chance(200.0, 225.0) == pytest.approx(2 / 5 * 0.25 / 225.0)
    assert chance(2.0, 3.0) == pytest.approx(2 / 5 / 20**2)  # however close


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


def test_probability_depends_on_no_unit():
    problems = SyntheticProblems(n=12, batch_size=50, seed=6, outliers=OutlierMix(count=4), dtype=torch.float64).batch(
        0
    )
    solver = create_solver("pnpnet-set").double()
    plain = solver(*problems[:3]).probability
    camera = torch.tensor([[3.0, 0, 7], [0, 3, -2], [0, 0, 1]]).double() @ problems.intrinsics
    scaled = solver(1e3 * problems.world_points, 3.0 * problems.img_points + torch.tensor([7.0, -2]).double(), camera)
    torch.testing.assert_close(scaled.probability, plain, rtol=1e-4, atol=1e-4)


def test_laws_are_those_of_the_results_file():
    file = Path(__file__).parents[1] / "docs" / "results" / "probability.json"
    assert {name: list(law) for name, law in LAWS.items()} == json.loads(file.read_text())["laws"]


def test_padding_does_not_change_the_chance_of_others(generator):
    """Of many pairs a part is looked at: a part of the pairs that are there."""
    pixels = torch.randn(1, 40, 2, generator=generator, dtype=torch.float64) * 50.0
    points = torch.cat((pixels / 100.0, torch.ones(1, 40, 1, dtype=torch.float64)), -1)
    pose = Pose(torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64))
    thresholds = Thresholds(torch.tensor([20.0], dtype=torch.float64), torch.zeros(1, dtype=torch.float64))
    chances = []
    for padding in (0, 300):
        far = torch.full((1, padding, 2), 1e3, dtype=torch.float64)
        weights = torch.cat((torch.ones(1, 40), torch.zeros(1, padding)), 1).double()
        world = torch.cat((points, torch.ones(1, padding, 3, dtype=torch.float64)), 1)
        corr = Problem(world, torch.cat((pixels + 9.0, far), 1), weights, torch.tensor(100.0).double())
        projection = project(pose, corr)
        judged = judge(projection, corr, thresholds)
        chances.append(chance_of_others(projection, corr, thresholds, judged))
    assert chances[0] > 0
    assert torch.equal(*chances)


def test_noise_that_was_much_underestimated_is_found(make_problems, generator):
    """Keypoints that are ten times as far off as the network estimates: solved once more, with their noise."""
    problems = make_problems(400, 20, outliers=4, dtype=torch.float32)
    pixels = problems.img_points + 30.0 * torch.randn(problems.img_points.shape, generator=generator)
    solver = create_solver("pnpnet-set")
    given = problems.world_points, pixels, problems.intrinsics
    with torch.no_grad():
        found, told = solver(*given), solver(*given, img_sigma=30.0)
        with mock.patch.object(scale, "_LARGER", math.inf):
            once = solver(*given)
    error = [pose_errors(x.pose, problems.pose).rotation_error_deg.clamp(max=10.0).mean() for x in (found, told, once)]
    assert error[0] < 1.1 * error[1]
    assert error[0] < 0.9 * error[2]
