"""Readers of real scenes: COLMAP and ETH3D models, and files of raw matches."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_pnpnet.core.files import read_npz
from kornia_pnpnet.data.scenes import Scene, View

__all__ = ["load_colmap", "load_matches", "load_scene", "undistort"]

# Folders of a model below the user's folder: the folder itself, ETH3D's layout, COLMAP's layout.
_MODEL_FOLDERS = (".", "dslr_calibration_undistorted", "sparse/0", "sparse")
_MODEL_FILES = ("cameras", "images", "points3D")


def load_scene(path: str | Path, *, metric: bool = True, min_points: int = 10, max_error_px: float = 10.0) -> Scene:
    """Load a scene: an ``.npz`` file with :func:`load_matches`, a folder with :func:`load_colmap`.

    Args:
        path: the file or the folder.
        metric: whether the unit of the scene is the metre.
        min_points: images with fewer points are skipped.
        max_error_px: matches with a larger reprojection error under the true pose are outliers; ignored for COLMAP
            models.

    Raises:
        FileNotFoundError: if there is nothing at ``path`` or no model in the folder.
        ImportError: if a COLMAP model is to be read without ``pycolmap``.
        ValueError: if the file or the model cannot be used, or all images are skipped; the message says why.
    """
    path = Path(path)
    if path.suffix == ".npz" and not path.is_dir():
        return load_matches(path, metric=metric, min_points=min_points, max_error_px=max_error_px)
    return load_colmap(path, metric=metric, min_points=min_points)


def load_colmap(folder: str | Path, *, metric: bool = True, min_points: int = 10) -> Scene:
    """Load a COLMAP model, text or binary, through ``pycolmap``. See :func:`load_scene` for options and errors.

    Pixels of distorted cameras are undistorted to the pinhole camera with the same focal length and principal point.
    A point that an image observes twice is used once, and points behind the camera, which only a fisheye lens can see,
    are dropped. All pairs count as inliers.

    The model is in ``folder`` or below it: ETH3D has it in ``dslr_calibration_undistorted``, COLMAP in ``sparse/0`` or
    ``sparse``.
    """
    folder = Path(folder)
    model_folder = _find_model(folder)
    pycolmap = _pycolmap()
    try:
        model = pycolmap.Reconstruction(str(model_folder))
    except Exception as error:  # its C++ code throws many types on bad files, std::bad_alloc included
        reason = " ".join(str(error).split())
        raise ValueError(f"pycolmap cannot read the model in '{model_folder}': {reason}") from error
    if not model.images:
        raise ValueError(f"the COLMAP model in '{model_folder}' has no images")
    world_points = {point_id: point.xyz for point_id, point in model.points3D.items()}
    try:
        views = [_colmap_view(image, world_points) for image in model.images.values()]
    except KeyError as error:
        raise ValueError(f"the COLMAP model in '{model_folder}' has no point {error} that an image observes") from error
    except ValueError as error:
        raise ValueError(f"the COLMAP model in '{model_folder}' cannot be used: {error}") from error
    place = folder.resolve()
    while place.name in {"0", "sparse", "dslr_calibration_undistorted"}:  # the scene is above these folders of a model
        place = place.parent
    return _scene(folder, place.name, views, min_points, metric)


def load_matches(path: str | Path, *, metric: bool = True, min_points: int = 10, max_error_px: float = 10.0) -> Scene:
    """Load a file of raw, unfiltered 2D-3D matches with the true poses. See :func:`load_scene` for options and errors.

    The file holds ``names`` (V,), ``K`` (V, 3, 3), ``R`` (V, 3, 3), ``t`` (V, 3) and ``size`` (V, 2) as width and
    height; for image ``iii`` (three digits) ``iii_img_points`` (M, 2), ``iii_world_points`` (M, 3) and
    ``iii_error_px`` (M,), the reprojection error under the true pose. Nothing in it is unpickled.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file of matches at '{path}'")
    try:
        views = _match_views(read_npz(path), max_error_px)
    except ValueError as error:
        raise ValueError(f"the matches in '{path}' cannot be used: {error}") from error
    if not views:
        raise ValueError(f"the file of matches '{path}' has no images")
    return _scene(path, path.stem, views, min_points, metric)


def undistort(camera: str, img_points: Tensor) -> tuple[Tensor, Tensor]:
    """Undistort pixels by any camera model that ``pycolmap`` knows.

    Args:
        camera: ``MODEL,width,height,params...``, a line of COLMAP's ``cameras.txt`` without its number.
        img_points: pixels in the convention of the camera, shape (N, 2).

    Returns:
        The pinhole camera of the same focal length and principal point, (3, 3), and its pixels, float64; NaN where a
        pixel has none.

    Raises:
        ImportError: if ``pycolmap`` is missing.
        ValueError: for an unknown model or other numbers than the model has.
    """
    pycolmap = _pycolmap()
    try:
        model, *numbers = (part for part in camera.replace(" ", ",").split(",") if part)
        width, height, *parameters = map(float, numbers)
        lens = pycolmap.Camera(model=model.upper(), width=int(width), height=int(height), params=parameters)
        if not lens.verify_params():
            raise ValueError(f"{lens.model_name} has the parameters {lens.params_info}")
        matrix, pixels = _pinhole(lens, img_points.double().numpy())
    except (ValueError, RuntimeError, IndexError, AttributeError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"expected MODEL,width,height,params of COLMAP, got {camera!r}: {reason}") from error
    return torch.tensor(matrix), torch.tensor(pixels)


def _pycolmap() -> Any:
    try:
        import pycolmap
    except ImportError as error:
        raise ImportError("COLMAP's models and cameras need pycolmap: pip install 'kornia_pnpnet[eval]'") from error
    return pycolmap


def _pinhole(camera: Any, distorted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pinhole camera (3, 3) like a ``pycolmap.Camera``, and its pixels (M, 2); NaN where there are none."""
    intrinsics = camera.calibration_matrix()
    plane = camera.cam_from_img(distorted)  # (M, 2), nan where the lens model has no inverse
    with np.errstate(invalid="ignore"):  # infinite where a focal length is 0
        return intrinsics, plane @ intrinsics[:2, :2].T + intrinsics[:2, 2]


def _scene(path: Path, name: str, views: list[View], min_points: int, metric: bool) -> Scene:
    """Sort the views by name, and skip views with too few points."""
    views = sorted(views, key=lambda view: view.name)
    kept = tuple(view for view in views if len(view.world_points) >= min_points)
    if not kept:
        most = max(len(view.world_points) for view in views)
        raise ValueError(f"no image of '{path}' has {min_points} points: the best of {len(views)} images has {most}")
    return Scene(name, kept, tuple(view.name for view in views if len(view.world_points) < min_points), metric)


def _find_model(folder: Path) -> Path:
    """The folder at or below ``folder`` that has the three files of a model, all binary or all text."""
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder at '{folder}'")
    for below in _MODEL_FOLDERS:
        for ending in (".bin", ".txt"):
            if all((folder / below / (stem + ending)).is_file() for stem in _MODEL_FILES):
                return folder / below
    looked = f"looked for cameras, images and points3D (.bin or .txt) in {', '.join(_MODEL_FOLDERS)}"
    raise FileNotFoundError(f"no COLMAP model in '{folder}': {looked}")


def _colmap_view(image: Any, world_points: Mapping[int, np.ndarray]) -> View:
    """The observations of one ``pycolmap.Image``."""
    observed = image.get_observation_points2D()
    ids, first = np.unique(np.array([point.point3D_id for point in observed], dtype=np.uint64), return_index=True)
    distorted = np.array([observed[i].xy for i in first], dtype=np.float64).reshape(-1, 2)
    points = np.array([world_points[int(i)] for i in ids], dtype=np.float64).reshape(-1, 3)
    world_to_cam = image.cam_from_world().matrix()  # (3, 4)
    intrinsics, pixels = _pinhole(image.camera, distorted)
    depth = points @ world_to_cam[2, :3] + world_to_cam[2, 3]
    # `~(depth <= 0)`, so that a pose that is not finite reaches the check in View.
    seen = np.isfinite(pixels).all(axis=1) & ~(depth <= 0)
    tensors = (points[seen], pixels[seen], intrinsics, world_to_cam[:, :3], world_to_cam[:, 3])
    world, img, camera, rotation, translation = map(torch.tensor, tensors)
    width, height = int(image.camera.width), int(image.camera.height)
    inliers = torch.ones(len(world), dtype=torch.bool)
    return View(image.name, world, img, camera, rotation, translation, width, height, inliers)


def _match_views(arrays: Mapping[str, np.ndarray], max_error_px: float) -> list[View]:
    """The views of a file of matches."""

    def read(key: str, *shape: int | None) -> Tensor:
        if key not in arrays:
            raise ValueError(f"there is no array '{key}'")
        array = arrays[key]
        fits = len(shape) == array.ndim and all(s in (None, a) for s, a in zip(shape, array.shape, strict=True))
        if not fits or array.dtype.kind not in "fiu":
            wanted = ", ".join("any" if s is None else str(s) for s in shape)
            raise ValueError(f"'{key}' has shape {array.shape} of {array.dtype}, expected numbers of ({wanted})")
        return torch.tensor(array.astype(np.float64))

    if "names" not in arrays:
        raise ValueError("there is no array 'names'")
    names = [str(name) for name in np.atleast_1d(arrays["names"])]
    count = len(names)
    intrinsics, rotation, translation = read("K", count, 3, 3), read("R", count, 3, 3), read("t", count, 3)
    sizes = read("size", count, 2)
    views = []
    for i, (name, size) in enumerate(zip(names, sizes.tolist(), strict=True)):
        img_points = read(f"{i:03d}_img_points", None, 2)
        world_points = read(f"{i:03d}_world_points", len(img_points), 3)
        inliers = read(f"{i:03d}_error_px", len(img_points)) <= max_error_px
        width, height = map(int, size)
        pose = rotation[i], translation[i]
        views.append(View(name, world_points, img_points, intrinsics[i], *pose, width, height, inliers))
    return views
