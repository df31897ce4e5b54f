import io
import itertools
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import BaseError
from strategies import damage, finite, many, names_the_file
from torch.testing import assert_close

from kornia_pnpnet.data.colmap import load_colmap, load_matches, load_scene
from kornia_pnpnet.data.outliers import OutlierMix
from kornia_pnpnet.data.scenes import Scene, SceneProblems, View, _choose

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"needs the real data in {SHARED}")

WIDTH, HEIGHT, FOCAL, CENTRE = 640, 480, 500.0, np.array([320.0, 240.0])
DISTORTION = -0.15
COUNTS = {"left/a.jpg": 40, "left/b.jpg": 25, "right/c.jpg": 12, "right/few.jpg": 9, "right/none.jpg": 0}


def pose_of(i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quaternion (w, x, y, z), rotation matrix and translation of image i, from first principles."""
    angle = 0.1 + 0.2 * i
    axis = np.array([1.0, 2.0, -1.0]) / math.sqrt(6)
    cross = np.cross(np.eye(3), axis)
    rotation = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    quaternion = np.array([math.cos(angle / 2), *(math.sin(angle / 2) * axis)])
    return quaternion, rotation, np.array([0.3 * i, -0.2, 0.5])


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


def make_view(name: str = "a.jpg", count: int = 30, seed: int = 0, inliers: torch.Tensor | None = None) -> View:
    """A view whose observations are exact. All its pixels differ."""
    rng = np.random.default_rng(seed)
    _, rotation, translation = pose_of(seed)
    plane = rng.uniform(-0.5, 0.5, (count, 2))
    cam = np.hstack([plane, np.ones((count, 1))]) * rng.uniform(2, 8, (count, 1))
    return View(
        name=name,
        world_points=torch.tensor((cam - translation) @ rotation),
        img_points=torch.tensor(FOCAL * plane + CENTRE),
        intrinsics=torch.tensor([[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]], dtype=torch.float64),
        rotation=torch.tensor(rotation),
        translation=torch.tensor(translation),
        width=WIDTH,
        height=HEIGHT,
        inliers=torch.ones(count, dtype=torch.bool) if inliers is None else inliers,
    )


def make_scene(*counts: int, metric: bool = True) -> Scene:
    return Scene("toy", tuple(make_view(f"{i}.jpg", count, seed=i) for i, count in enumerate(counts)), (), metric)


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


def residual_px(problems) -> torch.Tensor:
    """Distance between pixels and projections under the true pose, (B, N)."""
    cam = problems.world_points @ problems.pose.rotation.mT + problems.pose.translation[:, None]
    assert (cam[..., 2] > 0).all()
    projected = cam @ problems.intrinsics.mT
    return (projected[..., :2] / projected[..., 2:] - problems.img_points).norm(dim=-1)


# COLMAP models


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
        assert scene.name == "courtyard"
        assert len(scene.views) == 3


def test_a_point_seen_twice_is_taken_once(tmp_path, pycolmap):
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


def test_depths(tmp_path, pycolmap):
    write_model(tmp_path, counts={"a.jpg": 11, "b.jpg": 11})
    scene = load_colmap(tmp_path)
    depths = torch.cat([view.cam_points[:, 2] for view in scene.views])
    assert ((depths >= 3) & (depths <= 9)).all()
    assert scene.median_depth == depths.median().item()
    assert scene.views[0].median_depth == depths[:11].median().item()


# Errors


def test_missing_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no folder at '.*nowhere'"):
        load_scene(tmp_path / "nowhere")


def test_folder_without_model(tmp_path):
    (tmp_path / "cameras.txt").write_text("")
    with pytest.raises(
        FileNotFoundError, match=r"no COLMAP model in .*looked for cameras, images and points3D.*sparse/0"
    ):
        load_scene(tmp_path)


def test_half_text_half_binary_is_no_model(tmp_path):
    for file in ("cameras.txt", "images.txt", "points3D.bin"):
        (tmp_path / file).write_text("")
    with pytest.raises(FileNotFoundError, match="no COLMAP model"):
        load_scene(tmp_path)


def test_missing_pycolmap(tmp_path, monkeypatch):
    for file in ("cameras.txt", "images.txt", "points3D.txt"):
        (tmp_path / file).write_text("")
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ImportError, match=r"pip install 'kornia_pnpnet\[eval\]'"):
        load_scene(tmp_path)


def test_model_without_images(tmp_path, pycolmap):
    for file in ("cameras.txt", "images.txt", "points3D.txt"):
        (tmp_path / file).write_text("")
    with pytest.raises(ValueError, match="has no images"):
        load_scene(tmp_path)


@pytest.mark.parametrize("ending", ["txt", "bin"])
def test_broken_model(tmp_path, pycolmap, ending):
    for stem in ("cameras", "images", "points3D"):
        (tmp_path / f"{stem}.{ending}").write_bytes(b"junk")
    with pytest.raises(ValueError, match="pycolmap cannot read the model in") as caught:
        load_scene(tmp_path)
    assert "\n" not in str(caught.value)


def test_no_image_with_enough_points(tmp_path, pycolmap):
    write_model(tmp_path)
    with pytest.raises(ValueError, match="has 41 points: the best of 5 images has 40"):
        load_scene(tmp_path, min_points=41)
    assert [view.name for view in load_scene(tmp_path, min_points=40).views] == ["left/a.jpg"]


def test_pose_that_is_not_finite(tmp_path, pycolmap):
    write_model(tmp_path / "text", counts={"a.jpg": 12})
    model = pycolmap.Reconstruction(str(tmp_path / "text"))
    model.frames[1].rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.0, np.nan, 0.0]))
    (tmp_path / "binary").mkdir()
    model.write_binary(str(tmp_path / "binary"))
    with pytest.raises(ValueError, match=r"image 'a.jpg': translation has values that are not finite"):
        load_scene(tmp_path / "binary")


def test_panorama_is_refused(tmp_path, pycolmap):
    write_model(tmp_path)
    (tmp_path / "cameras.txt").write_text("1 EQUIRECTANGULAR 640 320 640 320\n")
    with pytest.raises(ValueError, match="cannot be used"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"img_points": torch.zeros(29, 2)}, r"img_points has shape \(29, 2\), expected \(30, 2\)"),
        ({"intrinsics": torch.eye(4)}, r"intrinsics has shape \(4, 4\)"),
        ({"rotation": torch.full((3, 3), math.nan)}, "rotation has values that are not finite"),
        ({"rotation": 2 * torch.eye(3)}, "not a rotation matrix"),
        ({"rotation": -torch.eye(3)}, "not a rotation matrix"),
        ({"inliers": torch.ones(3, dtype=torch.bool)}, "inliers has shape"),
    ],
)
def test_view_checks_itself(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(make_view(), **changes)


# Matches


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


def test_match_behind_the_camera_has_infinite_error():
    view = make_view()
    behind = view.rotation.mT @ (torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64) - view.translation)
    view = replace(view, world_points=torch.cat([view.world_points[:-1], behind[None]]))
    assert view.reprojection_error_px[-1] == math.inf
    assert view.reprojection_error_px[:-1].max() < 1e-9


def test_missing_file_of_matches(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no file of matches at '.*x.npz'"):
        load_scene(tmp_path / "x.npz")


@pytest.mark.parametrize("content", [b"", b"not a zip file", b"PK\x03\x04broken"])
def test_corrupt_npz(tmp_path, content):
    (tmp_path / "x.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"x.npz' is not a readable .npz file of plain arrays"):
        load_scene(tmp_path / "x.npz")


def test_damaged_npz(tmp_path):
    np.savez_compressed(tmp_path / "x.npz", **match_arrays(200))
    content = bytearray((tmp_path / "x.npz").read_bytes())
    content[len(content) // 2 : len(content) // 2 + 64] = bytes(64)
    (tmp_path / "x.npz").write_bytes(content)
    with pytest.raises(ValueError, match="is not a readable"):
        load_scene(tmp_path / "x.npz")


class Bomb:
    def __reduce__(self):
        return (pytest.fail, ("unpickled",))


def test_nothing_is_unpickled(tmp_path):
    arrays = match_arrays(20) | {"names": np.array([Bomb()], dtype=object)}
    np.savez(tmp_path / "x.npz", **arrays)
    with pytest.raises(ValueError, match="is not a readable"):
        load_scene(tmp_path / "x.npz")


def test_plain_array_is_no_npz(tmp_path):
    with (tmp_path / "x.npz").open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(ValueError, match="is not a readable"):
        load_scene(tmp_path / "x.npz")


@pytest.mark.parametrize("key", ["names", "K", "R", "t", "size", "001_img_points", "001_world_points", "001_error_px"])
def test_missing_array(tmp_path, key):
    arrays = match_arrays(20, 20)
    del arrays[key]
    np.savez(tmp_path / "x.npz", **arrays)
    with pytest.raises(ValueError, match=rf"x.npz' cannot be used: there is no array '{key}'"):
        load_scene(tmp_path / "x.npz")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("R", np.zeros((2, 3, 3)), r"'R' has shape \(2, 3, 3\) of float64, expected numbers of \(1, 3, 3\)"),
        ("000_img_points", np.zeros((20, 3)), r"'000_img_points' has shape \(20, 3\) .*\(any, 2\)"),
        ("000_error_px", np.zeros(19), r"'000_error_px' has shape \(19,\)"),
        ("000_world_points", np.full((20, 3), "x"), "'000_world_points' .*expected numbers"),
        ("t", np.full((1, 3), np.inf), "translation has values that are not finite"),
        ("R", np.ones((1, 3, 3)), "not a rotation matrix"),
    ],
)
def test_wrong_array(tmp_path, key, value, message):
    np.savez(tmp_path / "x.npz", **(match_arrays(20) | {key: value}))
    with pytest.raises(ValueError, match=message):
        load_scene(tmp_path / "x.npz")


def test_matches_with_too_few_points_or_images(tmp_path):
    np.savez(tmp_path / "few.npz", **match_arrays(9))
    with pytest.raises(ValueError, match="has 10 points: the best of 1 images has 9"):
        load_scene(tmp_path / "few.npz")
    none = {"K": np.zeros((0, 3, 3)), "R": np.zeros((0, 3, 3)), "t": np.zeros((0, 3)), "size": np.zeros((0, 2))}
    np.savez(tmp_path / "none.npz", names=np.array([], dtype=str), **none)
    with pytest.raises(ValueError, match="has no images"):
        load_scene(tmp_path / "none.npz")


# Problems


def test_shapes_and_dtypes():
    source = SceneProblems(make_scene(20, 30), n=7, batch_size=5, dtype=torch.float32)
    problems = source.batch(0)
    assert problems.world_points.shape == (5, 7, 3)
    assert problems.img_points.shape == (5, 7, 2)
    assert problems.intrinsics.shape == problems.pose.rotation.shape == (5, 3, 3)
    assert problems.pose.translation.shape == (5, 3)
    assert problems.inliers.shape == (5, 7)
    assert problems.inliers.dtype == torch.bool
    for field in (problems.world_points, problems.img_points, problems.intrinsics, *problems.pose):
        assert field.dtype == torch.float32
    assert SceneProblems(make_scene(20)).batch(0).world_points.dtype == torch.float64


@pytest.mark.parametrize("recentre", [True, False])
@pytest.mark.parametrize("outliers", [None, OutlierMix(count=2), OutlierMix()])
def test_inliers_reproject_exactly_and_outliers_do_not(recentre, outliers):
    problems = SceneProblems(make_scene(40, 30), batch_size=500, outliers=outliers, recentre=recentre).batch(3)
    error = residual_px(problems)
    assert error[problems.inliers].max() < 1e-9
    wrong = error[~problems.inliers]
    assert outliers is None or wrong.median() > 50
    assert (wrong > 1e-3).all()


def test_recentred_pose_prior():
    problems = SceneProblems(make_scene(20), batch_size=20_000).batch(0)
    rotation, translation = problems.pose
    assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand_as(rotation), rtol=0, atol=1e-12)
    assert (rotation.det() > 0).all()
    assert translation.abs().max() <= 12.5
    assert_close(translation.mean(0), torch.zeros(3, dtype=torch.float64), rtol=0, atol=0.25)
    assert_close(translation.std(0), torch.full((3,), 25 / math.sqrt(12), dtype=torch.float64), rtol=0.02, atol=0)
    angle = torch.arccos(((rotation.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1))
    assert angle.max() <= math.pi / 2 + 1e-9
    # Uniform, not Haar: all quarters of the range hold as many.
    assert torch.histc(angle, 4, 0, math.pi / 2).sub(5000).abs().max() < 300
    axis = torch.stack([rotation[:, 2, 1], rotation[:, 0, 2], rotation[:, 1, 0]], 1) - torch.stack(
        [rotation[:, 1, 2], rotation[:, 2, 0], rotation[:, 0, 1]], 1
    )
    axis = torch.nn.functional.normalize(axis, dim=1)
    assert_close(axis.mean(0), torch.zeros(3, dtype=torch.float64), rtol=0, atol=0.02)
    assert_close(axis.mT @ axis / len(axis), torch.eye(3, dtype=torch.float64) / 3, rtol=0, atol=0.02)


def test_pose_prior_arguments():
    problems = SceneProblems(make_scene(20), batch_size=300, translation_box=2.0, max_angle=0.1).batch(0)
    assert 0.9 < problems.pose.translation.abs().max() <= 1.0
    trace = problems.pose.rotation.diagonal(dim1=1, dim2=2).sum(1)
    assert trace.min() >= 1 + 2 * math.cos(0.1) - 1e-12


def test_recentring_moves_the_world_rigidly():
    scene = make_scene(30)
    moved = SceneProblems(scene, batch_size=50).batch(0)
    still = SceneProblems(scene, batch_size=50, recentre=False).batch(0)
    assert torch.equal(moved.img_points, still.img_points)
    assert_close(
        torch.cdist(moved.world_points, moved.world_points), torch.cdist(still.world_points, still.world_points)
    )
    assert torch.equal(still.pose.rotation, scene.views[0].rotation.expand(50, 3, 3))
    assert not torch.allclose(moved.world_points, still.world_points)


def test_batches_are_reproducible():
    scene = make_scene(20, 30)

    def make(seed: int = 0) -> SceneProblems:
        return SceneProblems(scene, batch_size=4, seed=seed, outliers=OutlierMix())

    source = make()
    later = source.batch(1)
    for first, second in zip(source, itertools.islice(make(), 3), strict=False):
        for a, b in zip(first[:3] + tuple(first.pose), second[:3] + tuple(second.pose), strict=True):
            assert torch.equal(a, b)
    assert torch.equal(later.world_points, next(itertools.islice(make(), 1, None)).world_points)
    assert not torch.equal(source.batch(0).world_points, later.world_points)
    assert not torch.equal(make(seed=1).batch(0).world_points, source.batch(0).world_points)
    torch.manual_seed(5)
    assert torch.equal(make().batch(1).world_points, later.world_points), "the global generator plays no part"


def test_outliers_do_not_change_points_and_poses():
    scene = make_scene(20, 30)
    clean = SceneProblems(scene, batch_size=100).batch(0)
    spoilt = SceneProblems(scene, batch_size=100, outliers=OutlierMix(count=4)).batch(0)
    assert torch.equal(clean.world_points, spoilt.world_points)
    assert torch.equal(clean.pose.translation, spoilt.pose.translation)
    assert torch.equal(clean.img_points[spoilt.inliers], spoilt.img_points[spoilt.inliers])
    assert (clean.img_points != spoilt.img_points).any(-1)[~spoilt.inliers].all()


def from_the_scene(scene: Scene, img_points: torch.Tensor) -> torch.Tensor:
    """Whether a pixel is one that some view of the scene observed, (B, N)."""
    known = torch.cat([view.img_points for view in scene.views])
    return (img_points[..., None, :] == known).all(-1).any(-1)


def test_both_kinds_of_outliers_as_in_the_protocol():
    scene = make_scene(20, 30)
    problems = SceneProblems(scene, batch_size=2000, outliers=OutlierMix(count=2)).batch(0)
    assert ((~problems.inliers).sum(1) == 2).all()
    share = (~problems.inliers).double().mean(0)
    assert_close(share, torch.full_like(share, 2 / 9), rtol=0, atol=0.04)
    wrong = problems.img_points[~problems.inliers].reshape(2000, 2, 2)
    mismatch = from_the_scene(scene, wrong)
    assert_close(mismatch.double().mean().item(), 0.5, rtol=0, atol=0.03)
    # One spare point: two mismatches of a problem share its pixel, which no inlier has.
    both = mismatch.all(1)
    assert 400 < both.sum() < 600
    assert torch.equal(wrong[both, 0], wrong[both, 1])
    own = problems.img_points[:, :, None] == problems.img_points[:, None]
    assert not (own.all(-1) & problems.inliers[:, :, None] & ~problems.inliers[:, None]).any()
    # The others are anywhere in the image.
    sensed = wrong[~mismatch]
    assert (sensed >= 0).all()
    assert (sensed <= torch.tensor([WIDTH, HEIGHT])).all()
    expected = torch.tensor([WIDTH, HEIGHT], dtype=torch.float64)
    assert_close(sensed.mean(0), expected / 2, rtol=0.05, atol=0)
    assert_close(sensed.std(0), expected / math.sqrt(12), rtol=0.05, atol=0)


@pytest.mark.parametrize("count", range(6))
def test_fixed_number_of_mismatches_with_spares_of_their_own(count):
    scene = make_scene(20, 30)
    mix = OutlierMix(count=count, mismatch_share=1.0)
    problems = SceneProblems(scene, batch_size=200, outliers=mix, num_spares=5).batch(0)
    assert ((~problems.inliers).sum(1) == count).all()
    assert from_the_scene(scene, problems.img_points).all()
    for pixels in problems.img_points[:20]:
        assert len(pixels.unique(dim=0)) == 9, "no two pairs share a pixel"


def test_mismatch_comes_from_the_same_image():
    scene = make_scene(20, 30)
    mix = OutlierMix(count=3, mismatch_share=1.0)
    problems = SceneProblems(scene, batch_size=50, outliers=mix, recentre=False).batch(0)
    for view in scene.views:
        mine = (problems.pose.translation == view.translation).all(-1)
        assert mine.any()
        pixels = problems.img_points[mine].reshape(-1, 1, 2)
        assert (pixels == view.img_points).all(-1).any(-1).all()


def test_real_mismatches_are_marked_without_any_spoiling():
    inliers = torch.arange(40) % 4 != 0
    view = make_view(count=40, inliers=inliers)
    view = replace(view, img_points=view.img_points + 100.0 * ~inliers[:, None])
    source = SceneProblems(Scene("toy", (view,)), batch_size=500)
    problems = source.batch(0)
    error = residual_px(problems)
    assert torch.equal(error < 1, problems.inliers)
    assert_close(problems.inliers.double().mean().item(), 0.75, rtol=0, atol=0.03)


def test_images_are_drawn_alike_and_small_ones_not_at_all():
    scene = make_scene(10, 500, 9)
    source = SceneProblems(scene, batch_size=4000, recentre=False)
    assert [view.name for view in source.views] == ["0.jpg", "1.jpg"]
    translation = source.batch(0).pose.translation
    share = (translation == scene.views[0].translation).all(-1).double().mean().item()
    assert_close(share, 0.5, rtol=0, atol=0.03)
    assert not (translation == scene.views[2].translation).all(-1).any()


def test_success_limit():
    assert SceneProblems(make_scene(20)).max_translation == 0.2
    scene = make_scene(20, 30, metric=False)
    assert_close(SceneProblems(scene).max_translation, 0.005 * scene.median_depth)


@pytest.mark.parametrize("arguments", [{"n": 0}, {"batch_size": 0}, {"num_spares": 0}])
def test_arguments_out_of_range(arguments):
    with pytest.raises(BaseError, match="at least 1"):
        SceneProblems(make_scene(20), **arguments)


def test_scene_too_small_for_n():
    with pytest.raises(ValueError, match="no image of 'toy' has the 51 points for n = 50 and num_spares = 1"):
        SceneProblems(make_scene(20, 30), n=50)


def test_choose_is_uniform_over_ordered_choices():
    counts = torch.full((60_000,), 5)
    chosen = _choose(counts, 3, torch.Generator().manual_seed(0))
    code = chosen @ torch.tensor([25, 5, 1])
    _, hits = code.unique(return_counts=True)
    assert len(hits) == 60  # 5 · 4 · 3, so no number comes twice
    assert (hits - 1000).abs().max() < 150  # standard deviation 31


def test_choose_all_and_with_different_counts():
    counts = torch.tensor([3, 4, 1000]).repeat(500)
    chosen = _choose(counts, 3, torch.Generator().manual_seed(0))
    assert (chosen >= 0).all()
    assert (chosen < counts[:, None]).all()
    assert torch.equal(chosen[::3].sort(1).values, torch.arange(3).expand(500, 3))


# Real data


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
    error = residual_px(problems)
    assert error[problems.inliers].median() < 1
    assert error[problems.inliers].max() < 12
    assert error[~problems.inliers].median() > 200


@needs_shared
def test_lens_distortion_of_lund_door_matters(pycolmap):
    model = pycolmap.Reconstruction(str(SHARED / "colmap/lund_door"))
    view = load_scene(SHARED / "colmap/lund_door", metric=False).views[0]
    image = model.find_image_with_name(view.name)
    observed = image.get_observation_points2D()
    world_points = torch.tensor(np.array([model.points3D[point.point3D_id].xyz for point in observed]))
    raw = replace(
        view,
        world_points=world_points,
        img_points=torch.tensor(np.array([point.xy for point in observed])),
        inliers=torch.ones(len(observed), dtype=torch.bool),
    )
    assert view.reprojection_error_px.quantile(0.95) < 2
    assert raw.reprojection_error_px.quantile(0.95) > 4


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


# -- whatever comes in -------------------------------------------------------------------------------------------------


def test_damaged_scenes_are_an_error_of_ours(tmp_path):
    pytest.importorskip("pycolmap", reason="needs pycolmap")
    model = tmp_path / "model"
    write_model(model, "PINHOLE")
    sound_files = {path.name: path.read_bytes() for path in model.iterdir()}

    @many(100)
    @given(st.sampled_from(sorted(sound_files)), st.data())
    def run(name, data):
        (model / name).write_bytes(data.draw(damage(sound_files[name])))
        try:
            scene = data.draw(st.sampled_from([load_colmap, load_scene]))(model)
        except (ValueError, OSError) as error:
            names_the_file(error, model)
        else:
            finite(*((view.world_points, view.img_points, view.rotation, view.translation) for view in scene.views))
        finally:
            (model / name).write_bytes(sound_files[name])

    run()


def test_damaged_matches_are_an_error_of_ours(tmp_path):
    file = io.BytesIO()
    np.savez(file, **match_arrays(30, 20))
    path = tmp_path / "matches.npz"

    @many(150)
    @given(damage(file.getvalue()))
    def run(content):
        path.write_bytes(content)
        try:
            scene = load_matches(path)
        except (ValueError, OSError) as error:
            names_the_file(error, path)
        else:
            finite(*((view.world_points, view.img_points, view.rotation, view.translation) for view in scene.views))

    run()
