"""What a user names is what is drawn and solved, and what is drawn says what it is."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from kornia.core.exceptions import ValueCheckError

import kornia_pnpnet.evaluation.choices
from kornia_pnpnet import PnPNet, list_solvers
from kornia_pnpnet.data import OutlierMix, Scene, SceneProblems, SlabPoints, SyntheticProblems, View
from kornia_pnpnet.evaluation.bounds import KnownInliersAndNoise
from kornia_pnpnet.evaluation.choices import (
    BOUNDS,
    PRIORS,
    default_solvers,
    evaluation_sets,
    load_solver,
    missing_package,
)
from kornia_pnpnet.evaluation.comparison import SeesTruth
from kornia_pnpnet.geometry import rotation_angle

CONF = Path(__file__).resolve().parents[1] / "conf" / "data"


def scene(name="room", points=60, metric=True):
    """One image of points around it, all of them exact."""
    generator = torch.Generator().manual_seed(0)
    world_points = torch.rand(points, 3, dtype=torch.float64, generator=generator) + torch.tensor([-0.5, -0.5, 4.0])
    view = View(
        name="a.jpg",
        world_points=world_points,
        img_points=500 * world_points[:, :2] / world_points[:, 2:] + 320,
        intrinsics=torch.tensor([[500.0, 0, 320], [0, 500, 320], [0, 0, 1]], dtype=torch.float64),
        rotation=torch.eye(3, dtype=torch.float64),
        translation=torch.zeros(3, dtype=torch.float64),
        width=640,
        height=640,
        inliers=torch.ones(points, dtype=torch.bool),
    )
    return Scene(name, (view,), metric=metric)


@pytest.fixture
def scenes(monkeypatch):
    """Any path that is not a prior is a scene of the path's last part."""
    monkeypatch.setattr(
        kornia_pnpnet.evaluation.choices, "load_scene", lambda path, metric: scene(Path(path).stem, metric=metric)
    )


def draw(*sources, outliers="none", n=9, count=20, **options):
    return evaluation_sets(sources, outliers, n=n, count=count, seed=3, **options)


def same(a, b):
    pairs = zip((*a[:3], *a.pose, a.inliers), (*b[:3], *b.pose, b.inliers), strict=True)
    return all(torch.equal(x, y) for x, y in pairs)


# -- problems --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "called", "options"),
    [
        ("synthetic", "paper", {}),
        ("gaussian_pose", "gaussian_pose", {"translation_sigma": 25.0}),
        ("slab", "slab", {"points": SlabPoints()}),
    ],
)
def test_priors_are_the_protocols(source, called, options):
    ((name, entry),) = draw(source, outliers="2").items()
    expected = SyntheticProblems(batch_size=1000, seed=3, outliers=OutlierMix(count=2), **options).batch(0)
    assert same(entry.problems, expected.map(lambda part: part[:20]))
    assert name == f"{source}, n = 9, 2 outliers"
    assert entry.description == {"source": called, "outliers": 2, "mismatch_share": 0.5, "seed": 3}
    assert (entry.max_rotation_deg, entry.max_translation, entry.unit) == (1.0, 0.2, "m")


def test_mixed_has_as_many_boxes_as_slabs():
    problems = next(iter(draw("mixed", count=1000).values())).problems
    depth = (problems.world_points @ problems.pose.rotation.mT + problems.pose.translation[:, None])[..., 2]
    deep = (depth.amax(-1) > 55.0).double().mean().item()  # of the boxes all but (45 / 80)^9
    boxes = next(iter(draw("synthetic", count=1000).values())).problems
    depth = (boxes.world_points @ boxes.pose.rotation.mT + boxes.pose.translation[:, None])[..., 2]
    slabs = next(iter(draw("slab", count=1000).values())).problems
    slab_depth = (slabs.world_points @ slabs.pose.rotation.mT + slabs.pose.translation[:, None])[..., 2]
    ends = [(part.amax(-1) > 55.0).double().mean().item() for part in (depth, slab_depth)]
    assert deep == pytest.approx(sum(ends) / 2, abs=0.05)


@pytest.mark.parametrize("source", PRIORS)
def test_priors_are_those_of_the_training_configuration(source):
    name, make = PRIORS[source]
    if name in ("slab", "any_rotation"):  # half of `mixed` and part of `wide`, by themselves only to evaluate
        return
    with initialize_config_dir(str(CONF.parent), version_base="1.3"):
        config = compose("train", overrides=[f"data={name}", "batch_size=4", "seed=3"])
    trained = instantiate(config.data.train).batch(2)
    ours = make(n=9, batch_size=4, seed=3, outliers=OutlierMix()).batch(2)
    for x, y in zip(trained[:3], ours[:3], strict=True):
        torch.testing.assert_close(x, y)


def test_told_sets_have_the_same_problems_and_their_noise():
    ((name, told),) = draw("synthetic", outliers="2", count=300, known_noise=True).items()
    ((plain_name, plain),) = draw("synthetic", outliers="2", count=300).items()
    assert name == f"{plain_name}, noise told"
    assert plain.problems.sigmas == {}
    assert torch.equal(told.problems.img_points, plain.problems.img_points)
    assert told.problems.img_sigma.tolist() == [1.0] * 300
    torch.testing.assert_close(told.problems.world_sigma, torch.full((300,), 0.05))


def test_any_rotation_turns_further_than_a_quarter():
    (entry,) = draw("any_rotation", outliers="none", count=500).values()
    angles = rotation_angle(entry.problems.pose.rotation, torch.eye(3).expand(500, 3, 3))
    assert 0.4 < (angles > math.pi / 2).double().mean() < 0.6


@pytest.mark.parametrize(
    ("word", "n", "counts", "called", "label"),
    [
        ("none", 9, {0}, "none", "0 outliers"),
        ("0", 9, {0}, "none", "0 outliers"),
        ("0%", 9, {0}, "none", "0 outliers"),
        ("1", 9, {1}, 1, "1 outlier"),
        ("uniform", 9, {0, 1, 2, 3}, "uniform", "0-3 outliers"),
        ("uniform", 20, {0, 1, 2, 3, 4, 5, 6}, "uniform", "0-6 outliers"),
        ("50%", 9, {4}, 4, "4 outliers"),
        ("50%", 20, {10}, 10, "10 outliers"),
        (" 33.3% ", 9, {3}, 3, "3 outliers"),
        ("100%", 9, {9}, 9, "9 outliers"),
    ],
)
def test_words_for_outliers(word, n, counts, called, label):
    ((name, entry),) = draw("synthetic", outliers=word, n=n, count=200).items()
    assert set((~entry.problems.inliers).sum(-1).tolist()) == counts
    assert (name, entry.description["outliers"]) == (f"synthetic, n = {n}, {label}", called)


def test_mismatches_only_are_pixels_of_other_points(scenes):
    ((name, entry),) = draw("room", outliers="4", count=200, mismatches_only=True, dtype=torch.float64).items()
    assert name == "room, n = 9, 4 mismatches"
    assert entry.description["mismatch_share"] == 1.0
    known = scene().views[0].img_points
    distance = torch.cdist(entry.problems.img_points, known.expand(200, -1, -1)).amin(-1)
    assert distance.max() < 0.1
    ((_, both),) = draw("room", outliers="4", count=200, dtype=torch.float64).items()
    distance = torch.cdist(both.problems.img_points, known.expand(200, -1, -1)).amin(-1)
    assert (distance > 1.0).sum(-1).double().mean() == pytest.approx(2.0, abs=0.3)


def test_every_n_has_every_mix_and_a_set_is_the_same_beside_others(scenes):
    sets = draw("synthetic", "room", outliers="none,2", n=[6, 9])
    assert list(sets) == [
        f"{source}, n = {n}, {label}"
        for source in ("synthetic", "room")
        for n in (6, 9)
        for label in ("0 outliers", "2 outliers")
    ]
    for name, entry in sets.items():
        source, _, n, _ = name.replace(",", "").split(maxsplit=3)
        n = int(name.split("n = ")[1].split(",")[0])
        alone = draw(source, outliers="2" if "2 outliers" in name else "none", n=n)
        assert same(entry.problems, alone[name].problems)
        assert entry.description == alone[name].description


@pytest.mark.parametrize("source", ["synthetic", "room"])
def test_both_precisions_hold_the_same_problems(scenes, source):
    ((_, single),), ((_, double),) = (draw(source, dtype=d).items() for d in (torch.float32, torch.float64))
    rounded = double.problems.map(lambda part: part.float() if part.is_floating_point() else part)
    assert double.problems.world_points.dtype == torch.float64
    assert same(single.problems, rounded)


def test_scenes_are_the_protocols(scenes):
    """Points and pixels of the scene, the world moved to the training prior's poses, limits by the unit."""
    sets = draw("here/room", outliers="2", count=1000, dtype=torch.float64)
    ((name, entry),) = sets.items()
    assert name == "room, n = 9, 2 outliers"
    described = {"source": "room", "path": "here/room", "outliers": 2, "mismatch_share": 0.5, "seed": 3}
    assert entry.description == described
    drawn = SceneProblems(scene(), seed=3, outliers=OutlierMix(count=2))
    assert same(entry.problems, drawn.batch(0))
    pose = entry.problems.pose
    assert pose.translation.abs().max() < 12.5
    assert pose.translation.std(0).min() > 6.0
    angle = torch.acos((pose.rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2)
    assert 1.4 < angle.max() <= math.pi / 2
    assert (entry.max_translation, entry.unit) == (0.2, "m")
    ((_, arbitrary),) = draw("here/room", metric=False).items()
    assert (arbitrary.max_translation, arbitrary.unit) == (0.005 * scene().median_depth, "")


def test_raw_matches_say_that_outliers_are_added(scenes):
    assert list(draw("raw.npz", outliers="1")) == ["raw, n = 9, +1 outlier"]


def test_scenes_of_one_name_stay_apart(scenes):
    sets = draw("a/room", "b/room", "a/room")
    assert list(sets) == ["room, n = 9, 0 outliers", "b/room, n = 9, 0 outliers"]
    assert [entry.description["path"] for entry in sets.values()] == ["a/room", "b/room"]


def test_a_scene_with_too_few_points_says_so(scenes):
    with pytest.raises(ValueCheckError, match=r"a/room: no image of 'room' has the 61 points for n = 60"):
        draw("a/room", n=60)


# -- solvers ---------------------------------------------------------------------------------------------------------


def test_bounds_take_options():
    bound = load_solver("known-inliers-and-noise:world_sigma=0.01")
    assert isinstance(bound, KnownInliersAndNoise)
    assert bound.config == {"img_sigma": 1.0, "world_sigma": 0.01}
    assert not bound.training
    assert all(isinstance(load_solver(name), SeesTruth) for name in BOUNDS)
    with pytest.raises(ValueCheckError, match="does not take these options"):
        load_solver("known-inliers:world_sigma=0.01")


def test_a_folder_named_like_a_bound_is_not_taken(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("known-inliers", "identity-lm"):
        (tmp_path / name).mkdir()
    assert isinstance(load_solver("known-inliers"), SeesTruth)
    assert isinstance(load_solver("identity-lm"), PnPNet)


@pytest.mark.parametrize("sources", [["synthetic"], ["synthetic", "a/room"], ["a/room"]])
def test_default_solvers_exist_for_every_n(sources):
    names = default_solvers([6, 9], sources)
    assert len(set(names)) == len(names)
    assert set(default_solvers(9, sources)) | set(default_solvers(6, sources)) == set(names)
    for name in names:
        assert name.partition(":")[0] in {*list_solvers(), *BOUNDS}
        load_solver(name)


def test_default_solvers_suit_scenes():
    synthetic, real = default_solvers(9), default_solvers(9, ["a/room"])
    assert set(BOUNDS) <= set(synthetic)
    assert set(real) & set(BOUNDS) == {"known-inliers"}
    assert [name.partition(":")[0] for name in real] == [
        name.partition(":")[0] for name in synthetic if name != "known-inliers-and-noise"
    ]
    assert "opencv-ransac:threshold=12" in real
    assert "opencv-ransac" in synthetic  # its default is for the protocol's data
    assert "p3p-ransac:threshold=12" in real
    assert any(name.startswith("p3p-ransac:") and "world_threshold" in name for name in synthetic)


def test_default_solvers_are_all_but_the_networks_for_another_n():
    left = set(list_solvers()) - {name.partition(":")[0] for name in default_solvers(9)}
    assert all(name.startswith(("pnpnet-", "net-")) and not name.endswith("-n9") for name in left)


def test_missing_packages_are_named_and_left_out(monkeypatch):
    needed = {"opencv-usac": "OpenCV", "poselib": "PoseLib", "pycolmap": "pycolmap", "p3p-ransac": None, "epnp": None}
    assert {name: missing_package(name) for name in needed} == dict.fromkeys(needed)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert {name: missing_package(name) for name in needed} == needed
    assert not any(name.startswith(("opencv", "poselib", "pycolmap")) for name in default_solvers(9))
