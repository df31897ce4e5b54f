"""Readers of real scenes: COLMAP models and files of raw matches, sound, unusable and damaged."""

import io
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from data_helpers import CENTRE, FOCAL, HEIGHT, WIDTH, make_view, pose_of, reprojection
from hypothesis import given
from hypothesis import strategies as st
from strategies import damage, finite, many, names_the_file
from torch.testing import assert_close

from kornia_pnpnet.data import OutlierMix, SceneProblems, load_colmap, load_matches, load_scene
from kornia_pnpnet.data.colmap import undistort

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"needs the real data in {SHARED}")

DISTORTION = -0.15
COUNTS = {"left/a.jpg": 40, "left/b.jpg": 25, "right/c.jpg": 12, "right/few.jpg": 9, "right/none.jpg": 0}
FILES = ("cameras.txt", "images.txt", "points3D.txt")


def distort(plane: np.ndarray, model: str) -> np.ndarray:
    """COLMAP's SIMPLE_RADIAL by its formula, or no distortion."""
    factor = 1 + DISTORTION * (plane**2).sum(1, keepdims=True) if model == "SIMPLE_RADIAL" else 1.0
    return FOCAL * factor * plane + CENTRE


def write_model(folder: Path, model: str = "SIMPLE_RADIAL", counts: dict[str, int] = COUNTS) -> dict[str, np.ndarray]:
    """Write a text model whose observations are exact; returns each image's true pinhole pixels."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    params = f"{FOCAL} {CENTRE[0]} {CENTRE[1]} {DISTORTION}" if model == "SIMPLE_RADIAL" else "500 500 320 240"
    (folder / "cameras.txt").write_text(f"1 {model} {WIDTH} {HEIGHT} {params}\n")
    images, points, truth = [], [], {}
    for i, (name, count) in enumerate(counts.items(), start=1):
        quaternion, rotation, translation = pose_of(i)
        plane = rng.uniform(-0.6, 0.6, (count, 2)) * [1.0, 0.75]
        depth = rng.uniform(3.0, 9.0, (count, 1))
        cam = np.hstack([plane, np.ones((count, 1))]) * depth
        world = (cam - translation) @ rotation
        truth[name] = FOCAL * plane + CENTRE
        pixels = distort(plane, model)
        ids = [len(points) + j + 1 for j in range(count)]
        numbers = [*quaternion, *translation]
        images.append(f"{i} {' '.join(repr(float(v)) for v in numbers)} 1 {name}")
        # One pixel without a point in front, as every real model has.
        observed = ["7.5 7.5 -1", *(f"{float(u)!r} {float(v)!r} {k}" for (u, v), k in zip(pixels, ids, strict=True))]
        images.append(" ".join(observed))
        for j, (k, point) in enumerate(zip(ids, world, strict=True), start=1):
            points.append(f"{k} {' '.join(repr(float(v)) for v in point)} 0 0 0 0.0 {i} {j}")
    (folder / "images.txt").write_text("\n".join(images) + "\n")
    (folder / "points3D.txt").write_text("\n".join(points) + "\n")
    return truth


@pytest.fixture
def pycolmap():
    return pytest.importorskip("pycolmap", reason="needs pycolmap")


def match_arrays(*counts: int) -> dict[str, np.ndarray]:
    """The arrays of a file of matches; every fifth match is off by 30 px."""
    views = [make_view(f"{i}.jpg", count, seed=i) for i, count in enumerate(counts)]
    arrays = {
        "names": np.array([view.name for view in views]),
        "K": np.stack([view.intrinsics.numpy() for view in views]),
        "R": np.stack([view.rotation.numpy() for view in views]),
        "t": np.stack([view.translation.numpy() for view in views]),
        "size": np.array([[WIDTH, HEIGHT]] * len(views)),
    }
    for i, view in enumerate(views):
        error = np.where(np.arange(len(view.img_points)) % 5 == 0, 30.0, 0.0)
        arrays[f"{i:03d}_img_points"] = view.img_points.numpy() + error[:, None] * [1.0, 0.0]
        arrays[f"{i:03d}_world_points"] = view.world_points.numpy()
        arrays[f"{i:03d}_error_px"] = error.astype(np.float32)
    return arrays


# --- COLMAP models ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "PINHOLE"])
def test_pixels_are_undistorted_and_reproject(tmp_path, pycolmap, model):
    truth = write_model(tmp_path, model)
    scene = load_colmap(tmp_path, metric=False)
    assert [view.name for view in scene.views] == ["left/a.jpg", "left/b.jpg", "right/c.jpg"]
    assert scene.skipped == ("right/few.jpg", "right/none.jpg")
    assert scene.name == tmp_path.name
    assert not scene.metric
    for i, view in enumerate(scene.views, start=1):
        _, rotation, translation = pose_of(i)
        assert_close(view.rotation, torch.tensor(rotation), rtol=0, atol=1e-12)
        assert_close(view.translation, torch.tensor(translation))
        assert_close(view.img_points, torch.tensor(truth[view.name]), rtol=0, atol=1e-6)
        assert view.reprojection_error_px.max() < 1e-6
        assert (view.width, view.height) == (WIDTH, HEIGHT)
        assert len(view.inliers) == COUNTS[view.name]
        assert view.inliers.all()
        assert view.world_points.dtype == view.img_points.dtype == view.intrinsics.dtype == torch.float64
        assert 3 <= view.cam_points[:, 2].min() <= view.cam_points[:, 2].max() <= 9
    assert scene.median_depth == torch.cat([view.cam_points[:, 2] for view in scene.views]).median().item()
    if model == "SIMPLE_RADIAL":
        raw = distort((truth["left/a.jpg"] - CENTRE) / FOCAL, model)
        assert np.abs(raw - truth["left/a.jpg"]).max() > 10, "the lens must matter, or this test shows nothing"


def test_binary_equals_text(tmp_path, pycolmap):
    write_model(tmp_path / "text")
    (tmp_path / "binary").mkdir()
    pycolmap.Reconstruction(str(tmp_path / "text")).write_binary(str(tmp_path / "binary"))
    text, binary = load_colmap(tmp_path / "text"), load_colmap(tmp_path / "binary")
    assert text.skipped == binary.skipped
    for a, b in zip(text.views, binary.views, strict=True):
        assert a.name == b.name
        for field in ("world_points", "img_points", "intrinsics", "rotation", "translation", "inliers"):
            assert_close(getattr(a, field), getattr(b, field), rtol=0, atol=1e-12)


@pytest.mark.parametrize("below", ["dslr_calibration_undistorted", "sparse/0", "sparse"])
def test_finds_the_model_below_the_scene(tmp_path, pycolmap, below):
    write_model(tmp_path / "courtyard" / below)
    for folder in (tmp_path / "courtyard", tmp_path / "courtyard" / below, str(tmp_path / "courtyard")):
        scene = load_scene(folder)
        assert (scene.name, len(scene.views)) == ("courtyard", 3)


def test_a_point_seen_twice_is_used_once(tmp_path, pycolmap):
    write_model(tmp_path, counts={"a.jpg": 10})
    images, points = tmp_path / "images.txt", tmp_path / "points3D.txt"
    images.write_text(images.read_text().rstrip() + " 100 100 1\n")
    lines = points.read_text().splitlines()
    points.write_text("\n".join([lines[0] + " 1 11", *lines[1:]]) + "\n")
    (view,) = load_colmap(tmp_path).views
    assert len(view.world_points) == 10
    assert view.reprojection_error_px.max() < 1e-6


def test_points_behind_the_camera_are_dropped(tmp_path, pycolmap):
    write_model(tmp_path, counts={"a.jpg": 12})
    _, rotation, translation = pose_of(1)
    behind = (np.array([0.0, 0.0, -2.0]) - translation) @ rotation
    lines = (tmp_path / "points3D.txt").read_text().splitlines()
    lines[0] = f"1 {behind[0]} {behind[1]} {behind[2]} 0 0 0 0.0 1 1"
    (tmp_path / "points3D.txt").write_text("\n".join(lines) + "\n")
    (view,) = load_colmap(tmp_path).views
    assert len(view.world_points) == 11


# --- unusable models --------------------------------------------------------------------------------------------------


def test_missing_models(tmp_path, monkeypatch):
    for missing in ("nowhere", "x.npz"):
        with pytest.raises(FileNotFoundError, match=missing):
            load_scene(tmp_path / missing)
    for file in ("cameras.txt", "images.txt", "points3D.bin"):  # half text, half binary is no model
        (tmp_path / file).write_text("")
    with pytest.raises(FileNotFoundError, match=r"no COLMAP model in .*sparse/0"):
        load_scene(tmp_path)
    (tmp_path / "points3D.txt").write_text("")
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ImportError, match=r"pip install 'kornia_pnpnet\[eval\]'"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("content", "files", "message"),
    [
        ("", FILES, "has no images"),
        ("junk", FILES, "pycolmap cannot read the model in"),
        ("junk", ("cameras.bin", "images.bin", "points3D.bin"), "pycolmap cannot read the model in"),
        ("1 EQUIRECTANGULAR 640 320 640 320\n", ("cameras.txt",), "cannot be used"),
    ],
)
def test_models_that_cannot_be_used(tmp_path, pycolmap, content, files, message):
    write_model(tmp_path)
    if "images.bin" in files:
        for file in FILES:
            (tmp_path / file).unlink()
    for file in files:
        (tmp_path / file).write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        load_scene(tmp_path)
    assert "\n" not in str(caught.value)


def test_no_image_with_enough_points(tmp_path, pycolmap):
    write_model(tmp_path)
    np.savez(tmp_path / "few.npz", **match_arrays(9))
    for path, least, best in ((tmp_path, 41, 40), (tmp_path / "few.npz", 10, 9)):
        with pytest.raises(ValueError, match=f"has {least} points: .* has {best}"):
            load_scene(path, min_points=least)
    assert [view.name for view in load_scene(tmp_path, min_points=40).views] == ["left/a.jpg"]


# --- files of matches -------------------------------------------------------------------------------------------------


def test_matches(tmp_path):
    np.savez_compressed(tmp_path / "toy.npz", **match_arrays(20, 8, 15))
    scene = load_scene(tmp_path / "toy.npz")
    assert scene.name == "toy"
    assert [view.name for view in scene.views] == ["0.jpg", "2.jpg"]
    assert scene.skipped == ("1.jpg",)
    for view in scene.views:
        wrong = torch.arange(len(view.inliers)) % 5 == 0
        assert torch.equal(view.inliers, ~wrong)
        assert_close(view.reprojection_error_px, 30.0 * wrong.double(), rtol=0, atol=1e-9)
    assert all(view.inliers.all() for view in load_matches(tmp_path / "toy.npz", max_error_px=30.0).views)


class Bomb:
    def __reduce__(self):
        return (pytest.fail, ("unpickled",))


def saved(save, *arrays, **named):
    file = io.BytesIO()
    save(file, *arrays, **named)
    return file.getvalue()


def test_files_that_are_not_matches(tmp_path):
    damaged = bytearray(saved(np.savez_compressed, **match_arrays(200)))
    damaged[len(damaged) // 2 : len(damaged) // 2 + 64] = bytes(64)
    pickled = saved(np.savez, **(match_arrays(20) | {"names": np.array([Bomb()], dtype=object)}))
    for content in (b"", b"not a zip file", b"PK\x03\x04broken", damaged, pickled, saved(np.save, np.zeros(3))):
        (tmp_path / "x.npz").write_bytes(content)
        with pytest.raises(ValueError, match=r"x.npz' cannot be used: not an NPZ file of numbers"):
            load_scene(tmp_path / "x.npz")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("R", np.zeros((2, 3, 3)), r"'R' has shape \(2, 3, 3\) of float64, expected numbers of \(1, 3, 3\)"),
        ("000_img_points", np.zeros((20, 3)), r"'000_img_points' has shape \(20, 3\) .*\(any, 2\)"),
        ("000_world_points", np.full((20, 3), "x"), "'000_world_points' .*expected numbers"),
        ("t", np.full((1, 3), np.inf), "translation has values that are not finite"),
        ("names", None, "no array 'names'"),
        ("000_error_px", None, "no array '000_error_px'"),
    ],
)
def test_wrong_array(tmp_path, key, value, message):
    arrays = match_arrays(20) | {key: value}
    np.savez(tmp_path / "x.npz", **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(ValueError, match=message):
        load_scene(tmp_path / "x.npz")


# --- damaged files ----------------------------------------------------------------------------------------------------


def test_damaged_scenes_are_an_error_of_ours(tmp_path, pycolmap):
    model, matches = tmp_path / "model", tmp_path / "matches.npz"
    write_model(model, "PINHOLE")
    np.savez(matches, **match_arrays(30, 20))
    sound_files = {path: path.read_bytes() for path in (*sorted(model.iterdir()), matches)}

    @many(200)
    @given(st.sampled_from([*sound_files, matches]), st.data())
    def run(file, data):
        path = matches if file == matches else model
        file.write_bytes(data.draw(damage(sound_files[file])))
        try:
            scene = load_scene(path)
        except (ValueError, OSError) as error:
            names_the_file(error, path)
        else:
            finite(*((view.world_points, view.img_points, view.rotation, view.translation) for view in scene.views))
        finally:
            file.write_bytes(sound_files[file])

    run()


# --- real data --------------------------------------------------------------------------------------------------------


@needs_shared
@pytest.mark.parametrize(
    ("folder", "views", "observations"),
    [
        ("strecha/fountain-P11", 11, 22_808),
        ("strecha/Herz-Jesus-P25", 25, 42_420),
        ("colmap/lund_door", 12, 72_829),  # 73 327 less the points an image observes twice
        ("colmap/sceaux_castle", 11, 36_964),
        ("eth3d/courtyard", 37, 137_260),
    ],
)
def test_real_models_reproject(pycolmap, folder, views, observations):
    scene = load_scene(SHARED / folder, metric=not folder.startswith("colmap"))
    assert scene.name == Path(folder).name
    assert len(scene.views) == views
    assert scene.skipped == ()
    assert sum(len(view.inliers) for view in scene.views) == observations
    assert torch.cat([view.reprojection_error_px for view in scene.views]).median() < 1
    for view in scene.views:
        assert view.reprojection_error_px.median() < 2
        assert view.cam_points[:, 2].min() > 0
    source = SceneProblems(scene, batch_size=1000, outliers=OutlierMix(count=2))
    problems = source.batch(0)
    error = reprojection(problems).norm(dim=-1)
    assert error[problems.inliers].median() < 1
    assert error[problems.inliers].max() < 12
    assert error[~problems.inliers].median() > 200


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
            stored = torch.where(stored >= 1e6, torch.inf, stored)
            assert_close(view.reprojection_error_px, stored, rtol=1e-4, atol=1e-3)
            assert torch.equal(view.inliers, stored <= 10)
    wrong = 1 - torch.cat([view.inliers for view in scene.views]).double().mean().item()
    assert_close(wrong, mismatches, rtol=0, atol=1e-3)
    problems = SceneProblems(scene, batch_size=2000).batch(0)
    assert 0.5 * mismatches < (~problems.inliers).double().mean() < 2 * mismatches


@pytest.mark.parametrize(
    "camera",
    [
        "SIMPLE_RADIAL,640,480,500,320,240,-0.1",
        "OPENCV 640 480 500 510 320 240 -0.1 0.01 0.001 0.002",
        "OPENCV_FISHEYE,640,480,500,510,320,240,0.01,0.002,0,0",
    ],
)
def test_any_camera_is_undistorted(camera, pycolmap):
    pixels = torch.tensor([[320.0, 240.0], [400.0, 300.0], [20.0, 40.0]], dtype=torch.float64)
    matrix, found = undistort(camera, pixels)
    model, width, height, *parameters = camera.replace(" ", ",").split(",")
    lens = pycolmap.Camera(model=model, width=int(width), height=int(height), params=list(map(float, parameters)))
    rays = torch.cat(((found - matrix[:2, 2]) / matrix.diagonal()[:2], torch.ones(3, 1)), 1)
    torch.testing.assert_close(torch.tensor(lens.img_from_cam(rays.numpy())), pixels, rtol=0, atol=1e-6)


@pytest.mark.parametrize("camera", ["FOO,640,480,500", "PINHOLE,640,480,500", "PINHOLE,a,b", ""])
@pytest.mark.usefixtures("pycolmap")
def test_other_cameras_are_refused(camera):
    with pytest.raises(ValueError, match="MODEL,width,height"):
        undistort(camera, torch.zeros(2, 2))
