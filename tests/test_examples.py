"""The examples of the documentation run, and their results support the page."""

import json
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from kornia_pnpnet import Pose

EXAMPLES = Path(__file__).resolve().parents[1] / "docs" / "examples"


@pytest.mark.slow
def test_keypoint_offsets_are_learned_through_the_pose(tmp_path):
    script = EXAMPLES / "keypoint_offsets.py"
    subprocess.run([sys.executable, script, "--steps", "300", "--out", tmp_path], check=True)
    runs = json.loads((tmp_path / "keypoint_offsets.json").read_text())["runs"]
    assert (tmp_path / "keypoint_offsets.png").stat().st_size > 0
    ours, *others = (run["error_px"] for run in runs.values())
    assert ours[-1] < ours[0] / 10
    assert all(errors[-1] > errors[0] / 2 for errors in others)
    assert runs["pnpnet-set"]["steps_without_finite_gradient"] == 0


@pytest.mark.slow
def test_a_boards_mislabelled_corners_do_not_matter(tmp_path):
    subprocess.run([sys.executable, EXAMPLES / "fiducial_board.py", "--frames", "20", "--out", tmp_path], check=True)
    runs = json.loads((tmp_path / "fiducial_board.json").read_text())["runs"]
    assert (tmp_path / "fiducial_board.png").stat().st_size > 0
    assert all(row["within_10_mm"] == 1.0 for row in runs["pnpnet-set"].values())
    assert all(row["median_mm"] < 2.0 for row in runs["pnpnet-set"].values())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("references", "queries"), [(14, 4), (15, 0)], ids=["images without points", "held-out images"]
)
def test_queries_of_a_folder_and_a_model_are_localised(tmp_path, monkeypatch, references, queries):
    """The queries are the images without points, or every fifth image where all have points."""
    pytest.importorskip("sklearn")
    monkeypatch.syspath_prepend(EXAMPLES)
    import rendered_hall

    scene = rendered_hall.make_scene(tmp_path / "hall", references, queries)
    arguments = ["--images", scene / "images", "--model", scene / "sparse", "--out", tmp_path]
    subprocess.run([sys.executable, EXAMPLES / "localiser.py", *arguments], check=True)
    results = json.loads((tmp_path / "localiser.json").read_text())
    assert (tmp_path / "localiser.png").stat().st_size > 0
    assert len(results["images"]) == (queries or references // 5)
    ours, *theirs = results["solvers"].values()
    assert ours["recall"][1] == 1.0  # 0.25 m, 2 degrees
    assert all(ours["recall"][1] >= x["recall"][1] for x in theirs)
    assert all(row["outliers"] < row["outliers_of_all"] for row in results["images"])


def test_disk_and_lightglue_fit_the_localiser(monkeypatch):
    """An untrained network and a matcher of nearest neighbours, because the weights would be downloaded."""
    pytest.importorskip("sklearn")
    monkeypatch.syspath_prepend(EXAMPLES)
    import localiser
    from kornia.feature import match_mnn

    monkeypatch.setattr(localiser.DISK, "from_pretrained", lambda checkpoint: localiser.DISK().eval())
    monkeypatch.setattr(localiser, "LightGlueMatcher", lambda name: lambda a, b, *lafs_and_sizes: match_mnn(a, b))
    detector = localiser.DiskLightGlue(50)
    image = torch.rand(1, 3, 90, 120)
    with torch.no_grad():
        lafs, descriptors = detector.detect(image)
    assert 0 < len(descriptors) <= 50
    pose = Pose(torch.eye(3).double(), torch.zeros(3).double())
    pixels = lafs[0, :, :, 2].double()
    points = torch.cat((pixels, torch.ones_like(pixels[:, :1])), 1)
    photo = localiser.Photo("", (90, 120), torch.eye(3).double(), pose, lafs, descriptors, pixels, points)
    found = localiser.match(photo, [photo, photo], detector)
    assert len(found.scores) == 2 * len(pixels)
    assert (localiser.errors_px(found, photo) == 0).all()


@pytest.mark.slow
def test_priors_help_to_track_with_few_pairs(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    import rendered_hall

    sequence = rendered_hall.write_sequence(tmp_path / "walk", 30)
    arguments = ["--sequence", sequence, "--intrinsics", "500", "500", "320", "240", "--out", tmp_path]
    subprocess.run([sys.executable, EXAMPLES / "tracking.py", *arguments], check=True)
    results = json.loads((tmp_path / "tracking.json").read_text())
    assert (tmp_path / "tracking.png").stat().st_size > 0
    assert results["frames"] == 28
    assert all(run["right"] == 1.0 for run in results["runs"]["100"].values())
    alone, *known = (run["right"] for run in results["runs"]["4"].values())
    assert all(right > alone for right in known)


@pytest.mark.slow
def test_images_become_poses_end_to_end(tmp_path):
    """A few updates of it."""
    script = EXAMPLES / "keypoint_pipeline.py"
    arguments = ["--updates", "60", "--seeds", "1", "--batches", "1", "--out", tmp_path]
    subprocess.run([sys.executable, script, *arguments], check=True)
    found = json.loads((tmp_path / "keypoint_pipeline.json").read_text())["seeds"]["0"]
    losses = found["keypoints first"]["curves"]["keypoint_loss"]
    assert losses[-1] < 0.9 * losses[0]
    assert 0.0 < found["end to end"]["mean_distance"] <= 1.0
    for picture in ("keypoint_pipeline.png", "keypoint_pipeline_overlays.png"):
        assert (tmp_path / picture).stat().st_size > 0


@pytest.mark.slow
def test_networks_predict_each_kind_of_noise(tmp_path):
    """A few updates of it."""
    script = EXAMPLES / "keypoint_pipeline.py"
    arguments = ["--covariances", "--updates", "40", "--seeds", "1", "--batches", "1", "--out", tmp_path]
    subprocess.run([sys.executable, script, *arguments], check=True)
    _, *kinds = json.loads((tmp_path / "keypoint_covariances.json").read_text())["seeds"]["0"].values()
    assert len(kinds) == 3
    assert all(0.0 < found["mean_distance"] <= 1.0 for found in kinds)


@pytest.mark.slow
def test_an_incremental_map_registers_its_images(tmp_path):
    subprocess.run([sys.executable, EXAMPLES / "incremental_map.py", "--scenes", "4", "--out", tmp_path], check=True)
    theirs, ours = json.loads((tmp_path / "incremental_map.json").read_text())["runs"].values()
    assert ours["5%"]["within_1_deg"] > 0.7  # the map drifts without bundle adjustment
    assert all(ours[share]["within_1_deg"] >= theirs[share]["within_1_deg"] for share in ours)


@pytest.mark.slow
def test_a_pose_network_learns_from_nothing(tmp_path):
    arguments = ["--steps", "200", "--seeds", "1", "--out", tmp_path]
    subprocess.run([sys.executable, EXAMPLES / "pose_network.py", *arguments], check=True)
    *distances, likelihood = json.loads((tmp_path / "pose_network.json").read_text())["runs"].values()
    assert likelihood[0]["rotation_deg"] < 20.0
    assert all(likelihood[0]["rotation_deg"] < rows[0]["rotation_deg"] for rows in distances)


def test_the_end_to_end_gradient_halves_the_error_for_every_seed():
    """In the results that the documentation shows."""
    results = json.loads((EXAMPLES / "keypoint_pipeline.json").read_text())
    assert len(results["seeds"]) == 3
    for runs in results["seeds"].values():
        for key in ("mean_distance", "median_distance"):
            assert runs["keypoint loss alone"][key] > 2.0 * runs["end to end"][key]


def test_the_tables_of_the_page_are_of_the_results():
    made = runpy.run_path(str(EXAMPLES / "tables.py"))
    for name in made["PAGES"]:
        assert made["page"](name) == (EXAMPLES / name).read_text()


def test_keypoints_are_visible_where_nothing_is_before_them(monkeypatch):
    """The box alone: what shows is as near as the ray's hit with the box."""
    monkeypatch.syspath_prepend(EXAMPLES)
    import keypoint_pipeline as pipeline

    pose = pipeline.draw(3, 0).pose
    eye = -(pose.translation[:, None] @ pose.rotation)
    rays = pipeline.KEYPOINTS - eye  # (B, 14, 3), hit the box first where they meet its slabs
    near = ((-pipeline.HALF * rays.sign() - eye) / rays).amax(-1)
    first = near > 1.0 - 1e-4
    assert (first == pipeline.outside(pose)).all()
    assert 0 < first.sum() < first.numel()
