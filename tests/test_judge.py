"""The evidence for a pose: which noise the pairs show, which pairs are inliers, and whether the pose is believed."""

import json
from pathlib import Path

import pytest
import torch
from doubtful import INTRINSICS, doubtful
from kornia.geometry.linalg import transform_points

from kornia_pnpnet import create_solver, pose_errors
from kornia_pnpnet.data import CameraProblems, OutlierMix, SyntheticProblems
from kornia_pnpnet.judge.evidence import LAW, LEAST_PROBABILITY, Votes, at_pose, evidence
from kornia_pnpnet.problem import Noise, Problem, State

ROOT = Path(__file__).parents[1]
SOLVERS = ("pnpnet-set", "p3p-ransac", "epnp-lm", "pnpnet-n20")
#: Largest share of the far-off poses that are ``ok``. 20 pairs of a wrong convention often fit an incorrect pose.
MOST, MOST_OF_20 = 0.05, 0.4


def drawn(pairs, outliers, sigma):
    """Problems of cameras with the focal length 1000."""
    options = {"field_of_view": (90.0, 90.0), "outlier_share": outliers / pairs, "img_sigma": sigma}
    return CameraProblems(n=pairs, batch_size=50, seed=0, dtype=torch.float64, **options).batch(0)


def scene(pairs, outliers, sigma):
    """The problems with the principal point 0, and their poses."""
    p = drawn(pairs, outliers, sigma)
    return Problem.of(p.world_points, p.img_points - p.intrinsics[:, None, :2, 2], 1000.0), p.pose


def found(problem, pose, known=False):
    votes = Votes.of(problem, torch.full_like(problem.weights[:, :1], float(known)).bool())
    return evidence(at_pose(State.of(pose), problem, votes), problem, votes)


def test_given_noise_is_kept_unless_the_residuals_contradict():
    problem, pose = scene(60, 20, 1.0)
    for given, factor in ((1.0, 1.0), (2.0, 1.0), (0.1, 64.0)):
        noise = Noise(torch.full_like(problem.weights, given), torch.zeros_like(problem.weights))
        result = found(problem._replace(noise=noise), pose, known=True)
        assert (result.mixture.variance == factor).all()
        assert 1000.0 * result.sigma.median() == pytest.approx(1.0, rel=0.1)


def test_evidence_rises_with_pairs_and_falls_with_noise_and_with_an_incorrect_pose(perturb):
    few, many, noisy = (found(*scene(*x)).log_ratio.median() for x in ((10, 2, 1.0), (40, 8, 1.0), (40, 8, 10.0)))
    assert 0.0 < few < noisy < many
    problem, pose = scene(40, 8, 1.0)
    assert (found(problem, perturb(pose, angle=0.35, shift=0.0)).log_ratio < 0).all()


def test_copies_share_one_vote():
    problem, pose = scene(12, 3, 1.0)
    twice = Problem.of(*(x.repeat(1, 2, 1) for x in problem[:2]), 1000.0)
    votes = Votes.of(twice, twice.weights[:, :1] < 0).pairs
    torch.testing.assert_close(votes.sum(1), torch.full((50,), 12.0, dtype=torch.float64))
    torch.testing.assert_close(found(twice, pose).log_ratio, found(problem, pose).log_ratio, rtol=0.1, atol=2.0)


# --- the results ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SOLVERS)
def test_doubtful_poses_are_not_ok_and_right_poses_of_tags_are(name):
    for kind in doubtful(100, seed=41):
        pairs = kind.world_points.shape[1]
        if (name.endswith("n20") and pairs != 20) or (pairs < 4):
            continue
        result = create_solver(name)(kind.world_points, kind.img_points, INTRINSICS, **kind.given)
        turn = torch.full((100,), torch.inf)
        if kind.truth is not None:
            turn = pose_errors(result.pose, kind.truth).rotation_error_deg
        most = MOST_OF_20 if kind.name.startswith("20 pairs") else MOST
        assert (result.ok & (turn > 10.0)).double().mean() <= most, kind.name
        if kind.name.startswith(("tag of 100", "tag of 400")) and name != "epnp-lm":
            assert result.ok[turn < 2.0].double().mean() >= 0.85, kind.name
            assert result.inliers[turn < 2.0].double().mean() > 0.98, kind.name


@pytest.mark.parametrize("sigma", [0.1, 1.0, 6.0, 24.0])
@pytest.mark.parametrize("outliers", [0, 60])
@pytest.mark.parametrize("name", ["pnpnet-set", "p3p-ransac"])
def test_the_noise_and_the_inliers_are_those_of_the_data(name, sigma, outliers):
    p = drawn(100, outliers, sigma)
    solver = create_solver(name, **({"threshold": 4.0 * sigma} if name == "p3p-ransac" else {}))
    result = solver(*p[:3])
    assert result.sigma.median() == pytest.approx(sigma, rel=0.1 if sigma < 20.0 else 0.2)
    assert result.inliers[p.inliers].double().mean() > 0.98
    assert not outliers or result.inliers[~p.inliers].double().mean() < 0.1


@pytest.mark.parametrize("sigmas", [{}, {"img_sigma": 1.0, "world_sigma": 0.05}], ids=["unknown", "given"])
@pytest.mark.parametrize("effort", ["fixed", "adaptive"])
def test_probability_tells_sound_problems_from_random_pixels(effort, sigmas):
    """Who searches longer finds better poses by chance, none of which is ``ok``."""
    sound = SyntheticProblems(n=20, batch_size=200, seed=3).batch(0)
    random = sound._replace(img_points=sound.img_points.roll(1, 0))  # the pixels of another problem
    solver = create_solver("pnpnet-set", effort=effort)
    found, wrong = (solver(*x[:3], **sigmas) for x in (sound, random))
    assert found.probability.median() > 0.99
    assert wrong.probability.median() < 0.3
    assert not wrong.ok.double().mean() > 0.02
    for probability in (found.probability, wrong.probability):
        assert ((probability >= 0) & (probability <= 1)).all()
        assert not probability.requires_grad


def test_probability_is_observed_as_often():
    """Problems with many outliers, by the law's own definition of far off."""
    p = SyntheticProblems(n=12, batch_size=1500, seed=5, outliers=OutlierMix(max_ratio=0.8)).batch(0)
    result = create_solver("pnpnet-set")(*p[:3])
    depth = transform_points(p.pose.matrix, p.world_points)[..., 2].median(1).values
    found, true = (-(x.rotation.mT @ x.translation[..., None])[..., 0] for x in (result.pose, p.pose))  # centres
    near = pose_errors(result.pose, p.pose).rotation_error_deg <= 10
    near &= (found - true).norm(dim=-1) <= 0.3 * depth
    sure = result.probability >= LEAST_PROBABILITY
    assert near[sure].double().mean() > 0.95
    assert near[~sure].double().mean() < near[sure].double().mean() - 0.2


def test_a_result_prints_anywhere(make_problems):
    p = make_problems()
    result = create_solver("epnp-lm")(*(x.to("meta") for x in p[:3]))
    assert repr(result)
    assert repr(result._replace(sigma=None))
    single = create_solver("epnp-lm")(*(x[0] for x in p[:3]))
    torch.func.vmap(lambda x: (repr(single._replace(sigma=x)), x)[1])(torch.ones(2))


def test_the_law_is_that_of_the_results_file():
    assert list(LAW) == json.loads((ROOT / "docs" / "results" / "probability.json").read_text())["law"]


def test_noise_whose_covariance_has_no_float32_determinant_harms_its_problem_only():
    p = SyntheticProblems(n=12, batch_size=3, seed=5, dtype=torch.float32).batch(0)
    solver, sigma = create_solver("pnpnet-set"), torch.full((3, 12), 0.1)
    noise = {"img_cov": torch.eye(2).expand(3, 12, 2, 2), "world_sigma": sigma}
    expected = solver(*p[:3], **noise)
    sigma[1] = 1e9
    found = solver(*p[:3], **noise)
    assert found.ok.tolist() == [True, False, True]
    assert torch.equal(found.matrix[::2], expected.matrix[::2])
