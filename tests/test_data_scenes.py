"""Scenes: COLMAP models and files of raw matches, sound, unusable and damaged; random problems drawn from scenes."""

import math
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import helpers
import numpy as np
import pytest
import torch
from helpers import CENTRE, FOCAL, HEIGHT, WIDTH, assert_uniform, make_scene, make_view, many, match_arrays, pose_of
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import BaseError
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch.testing import assert_close

from kornia_pnpnet.data import OutlierMix, Scene, SceneProblems, load_scene
from kornia_pnpnet.data.colmap import undistort

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"needs the real data in {SHARED}")

#: Folders, and the numbers of their views and observations.
MODELS = [("strecha/fountain-P11", 11, 22_808), ("strecha/Herz-Jesus-P25", 25, 42_420)]
MODELS += [("colmap/lund_door", 12, 72_829)]  # 73 327 less the points an image observes twice
MODELS += [("colmap/sceaux_castle", 11, 36_964), ("eth3d/courtyard", 37, 137_260)]
DISTORTION = -0.15
COUNTS = {"left/a.jpg": 40, "left/b.jpg": 25, "right/c.jpg": 12, "right/few.jpg": 9, "right/none.jpg": 0}
FILES = ("cameras.txt", "images.txt", "points3D.txt")
#: Contents of files, and the error.
UNUSABLE = [(dict.fromkeys(FILES, ""), "no images"), ({"points3D.txt": ""}, "observes the point")]
UNUSABLE += [(dict.fromkeys((f"{x[:-3]}{end}" for x in FILES), "junk"), "pycolmap") for end in ("txt", "bin")]
UNUSABLE += [({"cameras.txt": "1 EQUIRECTANGULAR 640 320 640 320\n"}, "cannot be used")]
CAMERAS = ["SIMPLE_RADIAL,640,480,500,320,240,-0.1", "OPENCV 640 480 500 510 320 240 -0.1 0.01 0.001 0.002"]
CAMERAS += ["OPENCV_FISHEYE,640,480,500,510,320,240,0.01,0.002,0,0"]


def text(*numbers):
    return " ".join(repr(float(x)) for x in numbers)


def write_model(folder, model="SIMPLE_RADIAL", counts=COUNTS):
    """Write a text model whose observations are exact; returns each image's true pinhole pixels."""
    folder.mkdir(parents=True, exist_ok=True)
    params = text(FOCAL, *CENTRE, DISTORTION) if model == "SIMPLE_RADIAL" else text(FOCAL, FOCAL, *CENTRE)
    images, points, truth = [], [], {}
    for i, (name, count) in enumerate(counts.items(), start=1):
        view, (quaternion, _, translation) = make_view(name, count, seed=i), pose_of(i)
        truth[name] = view.img_points
        plane = (view.img_points.numpy() - CENTRE) / FOCAL
        factor = 1 + DISTORTION * (plane**2).sum(1, keepdims=True) if model == "SIMPLE_RADIAL" else 1.0
        pixels = FOCAL * factor * plane + CENTRE
        observed = ["7.5 7.5 -1"]  # one pixel without a point in front, as every real model has
        for j, (pixel, point) in enumerate(zip(pixels, view.world_points, strict=True), start=1):
            points.append(f"{len(points) + 1} {text(*point)} 0 0 0 0.0 {i} {j}\n")
            observed.append(f"{text(*pixel)} {len(points)}")
        images.append(f"{i} {text(*quaternion, *translation)} 1 {name}\n{' '.join(observed)}\n")
    contents = f"1 {model} {WIDTH} {HEIGHT} {params}\n", "".join(images), "".join(points)
    for file, content in zip(FILES, contents, strict=True):
        (folder / file).write_text(content)
    return truth


def error_px(view):
    """The reprojection error of each pair, infinite behind the camera."""
    projected = view.cam_points @ view.intrinsics.mT
    error = (projected[:, :2] / projected[:, 2:] - view.img_points).norm(dim=1)
    return torch.where(view.cam_points[:, 2] > 0, error, torch.inf)


@pytest.fixture
def pycolmap():
    return pytest.importorskip("pycolmap", reason="needs pycolmap")


@pytest.mark.parametrize("is_binary", [False, True])
@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "PINHOLE"])
def test_pixels_are_undistorted_and_reproject(tmp_path, pycolmap, model, is_binary):
    truth = write_model(tmp_path, model)
    if is_binary:
        pycolmap.Reconstruction(tmp_path).write_binary(tmp_path)
        for file in FILES:
            (tmp_path / file).unlink()
    scene = load_scene(tmp_path, metric=False)
    assert [view.name for view in scene.views] == ["left/a.jpg", "left/b.jpg", "right/c.jpg"]
    assert (scene.name, scene.skipped, scene.metric) == (tmp_path.name, ("right/few.jpg", "right/none.jpg"), False)
    for i, view in enumerate(scene.views, start=1):
        _, rotation, translation = pose_of(i)
        assert_close(view.rotation, torch.tensor(rotation), rtol=0, atol=1e-12)
        assert_close(view.translation, torch.tensor(translation))
        assert_close(view.img_points, truth[view.name], rtol=0, atol=1e-6)
        assert error_px(view).max() < 1e-6
        assert (view.width, view.height) == (WIDTH, HEIGHT)
        assert (len(view.inliers), view.inliers.all()) == (COUNTS[view.name], True)
        assert view.world_points.dtype == view.img_points.dtype == view.intrinsics.dtype == torch.float64
        assert 2 <= view.cam_points[:, 2].min() <= view.cam_points[:, 2].max() <= 8


@pytest.mark.parametrize("below", ["dslr_calibration_undistorted", "sparse/0", "sparse"])
def test_finds_the_model_below_the_scene(tmp_path, pycolmap, below):
    write_model(tmp_path / "courtyard" / below)
    for folder in (tmp_path / "courtyard", tmp_path / "courtyard" / below, str(tmp_path / "courtyard")):
        scene = load_scene(folder)
        assert (scene.name, len(scene.views)) == ("courtyard", 3)


def test_points_that_are_seen_twice_or_from_behind(tmp_path, pycolmap):
    write_model(tmp_path, counts={"a.jpg": 12})
    images, points = tmp_path / "images.txt", tmp_path / "points3D.txt"
    images.write_text(images.read_text().rstrip() + " 100 100 1\n")
    first, *others = points.read_text().splitlines()
    _, rotation, translation = pose_of(1)
    behind = f"1 {text(*(np.array([0.0, 0.0, -2.0]) - translation) @ rotation)} 0 0 0 0.0 1 1"
    for line, count in ((first, 12), (behind, 11)):
        points.write_text("\n".join([f"{line} 1 13", *others]) + "\n")
        (view,) = load_scene(tmp_path).views
        assert (len(view.world_points), error_px(view).max() < 1e-6) == (count, True)


def test_missing_models(tmp_path, monkeypatch):
    for missing in ("nowhere", "x.npz"):
        with pytest.raises(FileNotFoundError, match=missing):
            load_scene(tmp_path / missing)
    for file in ("cameras.txt", "images.txt", "points3D.bin"):  # half text, half binary is no model
        (tmp_path / file).write_text("")
    with pytest.raises(FileNotFoundError, match="sparse/0"):
        load_scene(tmp_path)
    (tmp_path / "points3D.txt").write_text("")
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ImportError, match=r"pip install '\.\[eval\]'"):
        load_scene(tmp_path)


@pytest.mark.parametrize(("changes", "message"), UNUSABLE)
def test_models_that_cannot_be_used(tmp_path, pycolmap, changes, message):
    write_model(tmp_path)
    for file, content in changes.items():
        (tmp_path / file).write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        load_scene(tmp_path)
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_image_with_enough_points(tmp_path, pycolmap):
    write_model(tmp_path)
    np.savez(tmp_path / "few.npz", **match_arrays(9))
    for path, least, best in ((tmp_path, 41, 40), (tmp_path / "few.npz", 10, 9)):
        with pytest.raises(ValueError, match=f"has {least} points: .* has {best}"):
            load_scene(path, min_points=least)
    assert [view.name for view in load_scene(tmp_path, min_points=40).views] == ["left/a.jpg"]


def test_matches(tmp_path):
    np.savez_compressed(tmp_path / "toy.npz", **match_arrays(20, 8, 15))
    scene = load_scene(tmp_path / "toy.npz")
    assert (scene.name, [view.name for view in scene.views], scene.skipped) == ("toy", ["0.jpg", "2.jpg"], ("1.jpg",))
    for view in scene.views:
        wrong = torch.arange(len(view.inliers)) % 5 == 0
        assert torch.equal(view.inliers, ~wrong)
        assert_close(error_px(view), 30.0 * wrong.double(), rtol=0, atol=1e-9)
    assert all(view.inliers.all() for view in load_scene(tmp_path / "toy.npz", max_error_px=30.0).views)


class Bomb:
    """No file is ever unpickled."""

    def __reduce__(self):
        return (pytest.fail, ("unpickled",))


WRONG = [("R", np.zeros((2, 3, 3)), r"'R' has shape \(2, 3, 3\) of float64, expected numbers of \(1, 3, 3\)")]
WRONG += [("000_img_points", np.zeros((20, 3)), r"'000_img_points' has shape \(20, 3\) .*\(any, 2\)")]
WRONG += [("000_world_points", np.full((20, 3), "x"), "'000_world_points' .*expected numbers")]
WRONG += [("t", np.full((1, 3), np.inf), "translation has values that are not finite")]
WRONG += [("R", factor * np.eye(3)[None], "not a rotation matrix") for factor in (2.0, -1.0)]
WRONG += [("names", np.array([Bomb()], dtype=object), r"x.npz' cannot be used: not an NPZ file of numbers")]
WRONG += [("size", np.array([[np.inf, 480]]), "'size' has numbers that are not positive")]
WRONG += [(name, None, f"no array '{name}'") for name in ("names", "000_error_px")]


@pytest.mark.parametrize(("key", "value", "message"), WRONG)
def test_wrong_array(tmp_path, key, value, message):
    arrays = match_arrays(20) | {key: value}
    np.savez(tmp_path / "x.npz", **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(ValueError, match=message):
        load_scene(tmp_path / "x.npz")


def test_damaged_scenes_are_an_error_of_ours(tmp_path, pycolmap):
    model, matches = tmp_path / "model", tmp_path / "matches.npz"
    write_model(model, "PINHOLE")
    np.savez(matches, **match_arrays(30, 20))
    sound_files = {path: path.read_bytes() for path in (*sorted(model.iterdir()), matches)}

    @many(200)
    @given(st.sampled_from([*sound_files, matches]), st.data())
    def run(file, data):
        path = matches if file == matches else model
        file.write_bytes(data.draw(helpers.damage(sound_files[file])))
        try:
            scene = load_scene(path)
        except (ValueError, OSError) as error:
            helpers.names_the_file(error, path)
        else:
            helpers.finite(*((x.world_points, x.img_points, x.rotation, x.translation) for x in scene.views))
        finally:
            file.write_bytes(sound_files[file])

    run()


@needs_shared
@pytest.mark.parametrize(("folder", "views", "observations"), MODELS)
def test_real_models_reproject(pycolmap, folder, views, observations):
    scene = load_scene(SHARED / folder, metric=not folder.startswith("colmap"))
    assert (scene.name, len(scene.views), scene.skipped) == (Path(folder).name, views, ())
    assert sum(len(view.inliers) for view in scene.views) == observations
    errors = [error_px(view) for view in scene.views]
    assert torch.cat(errors).median() < 1
    assert max(error.median() for error in errors) < 2


@needs_shared
@pytest.mark.parametrize(("name", "mismatches"), [("fountain-P11", 0.053), ("Herz-Jesus-P25", 0.173)])
def test_real_matches(name, mismatches):
    path = SHARED / "matches" / f"{name}.npz"
    scene = load_scene(path)
    with np.load(path, allow_pickle=False) as file:
        assert [view.name for view in scene.views] == list(file["names"])
        for i, view in enumerate(scene.views):
            stored = torch.tensor(file[f"{i:03d}_error_px"]).double()
            # The file says 1e6 where the point lies behind the camera; its pixels and errors are float32.
            assert_close(error_px(view), torch.where(stored >= 1e6, torch.inf, stored), rtol=1e-4, atol=1e-3)
            assert torch.equal(view.inliers, stored <= 10)
    wrong = 1 - torch.cat([view.inliers for view in scene.views]).double().mean().item()
    assert_close(wrong, mismatches, rtol=0, atol=1e-3)


@pytest.mark.parametrize("camera", CAMERAS)
def test_any_camera_is_undistorted(camera, pycolmap):
    pixels = torch.tensor([[320.0, 240.0], [400.0, 300.0], [20.0, 40.0]], dtype=torch.float64)
    matrix, found = undistort(camera, pixels)
    model, width, height, *parameters = camera.replace(" ", ",").split(",")
    lens = pycolmap.Camera(model=model, width=int(width), height=int(height), params=list(map(float, parameters)))
    rays = torch.cat(((found - matrix[:2, 2]) / matrix.diagonal()[:2], torch.ones(3, 1)), 1)
    assert_close(torch.tensor(lens.img_from_cam(rays.numpy())), pixels, rtol=0, atol=1e-6)
    if "FISHEYE" in camera:  # no ray in front of the camera
        assert undistort(camera, torch.tensor([[1200.0, 240.0]]))[1].isnan().all()


@pytest.mark.parametrize("camera", ["F", "PINHOLE,6,4,5", "FOV,a", "", "PINHOLE,inf,4,8,8,3,2", "FOV,6,4,8,8,3,2,nan"])
@pytest.mark.usefixtures("pycolmap")
def test_other_cameras_are_refused(camera):
    with pytest.raises(ValueError, match="MODEL,width,height"):
        undistort(camera, torch.zeros(2, 2))


def test_the_world_is_moved_rigidly_to_the_protocols_prior():
    scene = make_scene(30)
    problems = SceneProblems(scene, batch_size=20_000).batch(0)
    still = scene.views[0].world_points[pairs_of(scene, problems.img_points[:50])]
    assert_close(*(torch.cdist(points, points) for points in (problems.world_points[:50], still)))
    assert_uniform(problems.pose.translation, -12.5, 12.5)
    assert_uniform(rotation_matrix_to_axis_angle(problems.pose.rotation).norm(dim=-1), 0.0, math.pi / 2 + 1e-9)


def test_outliers_do_not_change_points_and_poses():
    draw = partial(SceneProblems, make_scene(20, 30), batch_size=100)
    clean, spoilt = draw().batch(0), draw(outliers=OutlierMix(count=4)).batch(0)
    assert torch.equal(clean.world_points, spoilt.world_points)
    assert torch.equal(clean.pose.matrix, spoilt.pose.matrix)
    assert torch.equal((clean.img_points == spoilt.img_points).all(-1), spoilt.inliers)


def pairs_of(scene, img_points):
    """The place of each pixel among those that the views observed, one view after the other, or -1, (B, N)."""
    match = (img_points[..., None, :] == torch.cat([view.img_points for view in scene.views])).all(-1)
    return torch.where(match.any(-1), match.long().argmax(-1), -1)


def test_both_kinds_of_outliers_as_in_the_protocol():
    scene = make_scene(20, 30)
    problems = SceneProblems(scene, batch_size=2000, outliers=OutlierMix(count=2)).batch(0)
    assert ((~problems.inliers).sum(1) == 2).all()
    wrong = problems.img_points[~problems.inliers].reshape(2000, 2, 2)
    mismatch = pairs_of(scene, wrong) >= 0
    assert_close(mismatch.double().mean().item(), 0.5, rtol=0, atol=0.03)
    # One spare point: two mismatches of a problem share its pixel, which no inlier has.
    both = mismatch.all(1)
    assert 400 < both.sum() < 600
    assert torch.equal(wrong[both, 0], wrong[both, 1])
    own = problems.img_points[:, :, None] == problems.img_points[:, None]
    assert not (own.all(-1) & problems.inliers[:, :, None] & ~problems.inliers[:, None]).any()
    # The others are anywhere in the image.
    sensed = wrong[~mismatch]
    assert_uniform(sensed[:, 0], 0, WIDTH)
    assert_uniform(sensed[:, 1], 0, HEIGHT)


@pytest.mark.parametrize("count", [0, 1, 5])
def test_fixed_number_of_mismatches_with_spares_of_their_own(count):
    scene, mix = make_scene(20, 30), OutlierMix(count=count, mismatch_share=1.0)
    problems = SceneProblems(scene, batch_size=200, outliers=mix, num_spares=5).batch(0)
    assert ((~problems.inliers).sum(1) == count).all()
    chosen = pairs_of(scene, problems.img_points).sort(-1).values
    assert (chosen >= 0).all()
    assert (chosen.diff() > 0).all(), "no two pairs share a pixel"


def test_inliers_reproject_exactly_and_mismatches_of_the_scene_are_marked():
    views = []
    for view in make_scene(40, 28).views:
        inliers = torch.arange(len(view.inliers)) % 4 != 0
        views.append(replace(view, img_points=view.img_points + 100.0 * ~inliers[:, None], inliers=inliers))
    problems = SceneProblems(Scene("toy", tuple(views)), batch_size=500).batch(0)
    assert torch.equal(helpers.reprojection_errors(problems).norm(dim=-1) < 1e-9, problems.inliers)
    assert_close(problems.inliers.double().mean().item(), 0.75, rtol=0, atol=0.03)


def test_images_are_equally_likely_and_small_ones_unused():
    scene = make_scene(10, 500, 9)
    source = SceneProblems(scene, batch_size=4000)
    assert [view.name for view in source.views] == ["0.jpg", "1.jpg"]
    helpers.assert_counts((pairs_of(scene, source.batch(0).img_points[:, 0]) >= 10).long().bincount())


def test_points_of_an_image_are_a_uniform_ordered_choice_without_repetition():
    scene = make_scene(5)
    which = pairs_of(scene, SceneProblems(scene, n=3, batch_size=60_000).batch(0).img_points)  # (B, 3)
    _, hits = (which @ torch.tensor([25, 5, 1])).unique(return_counts=True)
    assert len(hits) == 60  # 5 · 4 · 3, so no point comes twice
    assert (hits - 1000).abs().max() < 150  # standard deviation 31


def test_wrong_arguments():
    with pytest.raises(ValueError, match=r"img_points has shape \(29, 2\), expected \(30, 2\)"):
        replace(make_view(), img_points=torch.zeros(29, 2))
    with pytest.raises(ValueError, match="no image of 'toy' has the 51 points for n = 50 and num_spares = 1"):
        SceneProblems(make_scene(20, 30), n=50)
    for name in ("near_share", "structured_share", "crowd_share"):
        with pytest.raises(BaseError, match=f"{name}.*0.5"):
            SceneProblems(make_scene(20), outliers=OutlierMix(**{name: 0.5}))
