"""Solvers, bounds and sets of problems by the names that a user types, and what the bounds find."""

from pathlib import Path

import pytest
import torch
from helpers import assert_same, finite, make_view, rate, reprojection_errors
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from kornia.core.exceptions import BaseError
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from laws import BAD, Case, make_bad, take

from kornia_pnpnet import PnPNet, Pose, Problems, list_solvers
from kornia_pnpnet.cli.arguments import SYNTHETIC
from kornia_pnpnet.core.trees import iter_tensors
from kornia_pnpnet.data import CameraProblems, OutlierMix, Scene, SceneProblems, SyntheticProblems
from kornia_pnpnet.evaluation import problem_sets
from kornia_pnpnet.evaluation.bounds import KnownInliers, KnownInliersAndNoise
from kornia_pnpnet.evaluation.comparison import SeesTruth
from kornia_pnpnet.evaluation.named_solvers import BOUNDS, default_solvers, load_solver, missing_package

#: Words for outliers, n, the numbers of outliers, what the description and the name of the set say.
WORDS = [*((word, 9, {0}, "none", "0 outliers") for word in ("none", "0%")), ("1", 9, {1}, 1, "1 outlier")]
WORDS += [("50%", 9, {4}, 4, "4 outliers"), (" 33.3% ", 9, {3}, 3, "3 outliers")]
WORDS += [("uniform", 20, {0, 1, 2, 3, 4, 5, 6}, "uniform", "0-6 outliers")]
#: Mixes of outliers, and the success of both bounds.
REACHED = [(None, 0.850, 0.907), (OutlierMix(), 0.783, 0.836), (OutlierMix(count=3), 0.690, 0.739)]


def test_a_name_takes_options_and_wins_over_a_folder_of_that_name(tmp_path, monkeypatch):
    bound = load_solver("known-inliers-and-noise:world_sigma=0.01")
    assert isinstance(bound, KnownInliersAndNoise)
    assert bound.config == {"img_sigma": 1.0, "world_sigma": 0.01}
    assert not bound.training
    monkeypatch.chdir(tmp_path)
    for name in ("known-inliers", "identity-lm"):
        (tmp_path / name).mkdir()
    assert isinstance(load_solver("known-inliers"), SeesTruth)
    assert isinstance(load_solver("identity-lm"), PnPNet)


@pytest.mark.parametrize("sources", [["synthetic", "a/room"], ["a/room"]])
def test_default_solvers_load_and_cover_every_n(sources):
    specs = default_solvers([6, 9], sources)
    assert len(set(specs)) == len(specs)
    assert set(default_solvers(9, sources)) | set(default_solvers(6, sources)) == set(specs)
    for spec in specs:
        assert isinstance(load_solver(spec), SeesTruth) == (spec.partition(":")[0] in BOUNDS)
    left = {x for x in list_solvers() if not x.startswith(("pnpnet-", "net-")) or x.endswith(("-n6", "-n9"))}
    assert not left - {spec.partition(":")[0] for spec in specs}, "add these solvers to _COMPETITORS"


def test_missing_packages_are_named_and_left_out(monkeypatch):
    needed = {"opencv-usac": "OpenCV", "poselib": "PoseLib", "pycolmap": "pycolmap", "kornia-rs": "kornia-rs"}
    needed["epnp"] = None
    assert {name: missing_package(name) for name in needed} == dict.fromkeys(needed)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert {name: missing_package(name) for name in needed} == needed
    assert not any(name.startswith(("opencv", "kornia-rs", "poselib", "pycolmap")) for name in default_solvers(9))


def scene(name="room", metric=True):
    return Scene(name, (make_view(count=60),), (), metric)


@pytest.fixture
def scenes(monkeypatch):
    """Any source that is not a prior loads the same scene, named by the last part of its path."""
    monkeypatch.setattr(problem_sets, "load_scene", lambda path, metric: scene(Path(path).stem, metric))


def draw(*sources, outliers="none", n=9, count=20, **options):
    return problem_sets.evaluation_sets(map(Path, sources), outliers, n=n, count=count, seed=3, **options)


def test_synthetic_sets_are_the_protocols():
    (entry,) = draw("synthetic", outliers="2").values()
    expected = SyntheticProblems(batch_size=1000, seed=3, outliers=OutlierMix(count=2)).batch(0)
    assert_same(entry.problems, expected.map(lambda part: part[:20]))
    assert entry.description == {"source": "paper", "outliers": 2, "mismatch_share": 0.5, "seed": 3}
    assert (entry.max_rotation_deg, entry.max_translation, entry.unit) == (1.0, 0.2, "m")


@pytest.mark.parametrize("source", ["synthetic", "gaussian_pose", "mixed"])
def test_priors_are_those_of_the_training_configuration(source):
    assert tuple(problem_sets.PRIORS) == SYNTHETIC
    name, make = problem_sets.PRIORS[source]
    with initialize_config_dir(str(Path(__file__).resolve().parents[1] / "conf"), version_base="1.3"):
        config = compose("train", overrides=[f"data={name}", "batch_size=4", "seed=3"])
    trained = instantiate(config.data.train).batch(2)
    ours = make(n=9, batch_size=4, seed=3, outliers=OutlierMix()).batch(2)
    torch.testing.assert_close(list(iter_tensors(trained)), list(iter_tensors(ours)))


def test_known_noise_is_added_to_the_same_problems():
    ((name, known),) = draw("synthetic", outliers="2", count=300, known_noise=True).items()
    ((plain_name, plain),) = draw("synthetic", outliers="2", count=300).items()
    assert name == f"{plain_name}, noise given"
    assert plain.problems.sigmas == {}
    assert torch.equal(known.problems.img_points, plain.problems.img_points)
    assert known.problems.img_sigma.tolist() == [1.0] * 300
    torch.testing.assert_close(known.problems.world_sigma, torch.full((300,), 0.05))


@pytest.mark.parametrize(("word", "n", "counts", "called", "label"), WORDS)
def test_words_for_outliers(word, n, counts, called, label):
    ((name, entry),) = draw("synthetic", outliers=word, n=n, count=200).items()
    assert set((~entry.problems.inliers).sum(-1).tolist()) == counts
    assert (name, entry.description["outliers"]) == (f"synthetic, n = {n}, {label}", called)


def test_mismatches_only_have_pixels_of_their_own(scenes):
    ((name, entry),) = draw("room", outliers="4", count=1000, mismatches_only=True, dtype=torch.float64).items()
    assert name == "room, n = 9, 4 mismatches"
    mix = OutlierMix(count=4, mismatch_share=1.0)
    assert_same(entry.problems, SceneProblems(scene(), seed=3, outliers=mix, num_spares=4).batch(0))


def test_every_n_has_every_mix_and_a_set_is_the_same_beside_others(scenes):
    sets = draw("synthetic", "room", outliers="none,2", n=[6, 9])
    mixes = [(source, n, count) for source in ("synthetic", "room") for n in (6, 9) for count in (0, 2)]
    for (name, entry), (source, n, count) in zip(sets.items(), mixes, strict=True):
        assert name == f"{source}, n = {n}, {count} outliers"
        alone = draw(source, outliers=str(count), n=n)[name]
        assert_same(entry.problems, alone.problems)
        assert entry.description == alone.description


def test_scenes_are_the_protocols_and_of_one_name_are_named_by_their_paths(scenes):
    (entry,) = draw("here/room", outliers="2", count=1000, dtype=torch.float64).values()
    assert entry.description == {"source": "room", "path": "here/room", "outliers": 2, "mismatch_share": 0.5, "seed": 3}
    assert_same(entry.problems, SceneProblems(scene(), seed=3, outliers=OutlierMix(count=2)).batch(0))
    assert (entry.max_translation, entry.unit) == (0.2, "m")
    (arbitrary,) = draw("here/room", metric=False).values()
    assert (arbitrary.max_translation, arbitrary.unit) == (0.005 * scene().median_depth, "")
    assert list(draw("a/room", "b/room", "a/room")) == ["room, n = 9, 0 outliers", "b/room, n = 9, 0 outliers"]
    with pytest.raises(BaseError, match="same name"):
        draw("a/room", "room")


@pytest.mark.parametrize("bound", BOUNDS.values())
def test_the_pose_minimises_the_weighted_squares_of_the_inliers_also_of_rigs(make_problems, bound):
    rigs = CameraProblems(n=12, batch_size=50, seed=3, outlier_share=0.25, cameras=3, dtype=torch.float64).batch(0)
    for problems in (make_problems(batch=50, outliers=2), rigs):
        result = bound().solve_with_truth(problems)
        assert torch.equal(result.weights > 0, problems.inliers)
        assert result.ok.all()
        turn, shift = torch.zeros(2, 50, 3, dtype=torch.float64).requires_grad_()
        pose = Pose(axis_angle_to_rotation_matrix(turn) @ result.rotation, result.translation + shift)
        weights = result.weights.detach() / problems.pair_intrinsics[..., :2, :2].det()  # unweighs cameras of a rig
        weights = problems.inliers if bound is KnownInliers else weights
        costs = (weights * reprojection_errors(problems, pose).square().sum(-1)).sum(-1)
        # A radian moves pixels by thousands, so that a gradient of this size is rounding.
        assert torch.cat(torch.autograd.grad(costs.sum(), (turn, shift))).abs().max() < 1e-6 * costs.max()
    assert rate(result, rigs) > 0.9


def test_weights_are_inverse_variances_by_the_jacobian(make_problems):
    problems = make_problems(batch=3, outliers=1)
    camera = torch.tensor([[800.0, 0, 320], [0, 950, 240], [0, 0, 1]], dtype=torch.float64)
    problems = problems._replace(intrinsics=camera.expand(3, 3, 3))
    problems = problems._replace(img_points=problems.img_points + reprojection_errors(problems))
    bound, same = KnownInliersAndNoise(img_sigma=2.0, world_sigma=0.3), 10.0 * problems.intrinsics
    weights = bound.solve_with_truth(problems).weights
    given = problems._replace(img_sigma=weights.new_tensor([2, 2, torch.nan]), world_sigma=0.3 * weights.new_ones(3, 9))
    assert_same(KnownInliersAndNoise(img_sigma=2.0).solve_with_truth(given).weights, weights)  # NaN: unknown
    assert_same(bound.solve_with_truth(problems._replace(intrinsics=same)).weights, weights, rtol=1e-9)
    exact = problems._replace(img_sigma=weights.new_zeros(3), world_sigma=weights.new_zeros(3))
    assert KnownInliersAndNoise().solve_with_truth(exact).ok.all()

    def pixels(world_points):
        return reprojection_errors(problems._replace(world_points=world_points))

    jacobian = torch.autograd.functional.jacobian(pixels, problems.world_points)  # (B, N, 2, B, N, 3)
    variance = 2.0**2 + 0.3**2 * jacobian.square().sum((-4, -3, -2, -1)) / 2.0
    torch.testing.assert_close(weights.detach(), torch.where(problems.inliers, 1.0 / variance, 0.0))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("mix", "inliers", "inliers_and_noise"), REACHED)
def test_success_is_what_the_protocol_measured(mix, inliers, inliers_and_noise, dtype):
    problems = SyntheticProblems(batch_size=4000, seed=77, outliers=mix, dtype=dtype).batch(0)
    # Three standard deviations of 4000 problems are 0.014 to 0.022.
    for bound, expected in ((KnownInliers(), inliers), (KnownInliersAndNoise(), inliers_and_noise)):
        assert rate(bound.solve_with_truth(problems), problems) == pytest.approx(expected, abs=0.022)


@pytest.mark.parametrize("bound", BOUNDS.values())
def test_bad_problems_fail_alone(bound):
    kinds, sound, spoiled = make_bad(Case("identity-lm"))
    arguments = "world_points", "img_points", "intrinsics"

    def solved(call):
        inliers = torch.ones_like(sound["weights"], dtype=torch.bool)
        return bound().solve_with_truth(Problems(*(call[x] for x in arguments), sound["init"], inliers))

    found = solved(spoiled)
    assert_same(take(slice(0, None, 2), found), take(slice(0, None, 2), solved(sound)))
    assert not any(ok and BAD[kind][0] in arguments for kind, ok in zip(kinds, found.ok[1::2], strict=True))
    finite(*found[:4], found.init)
