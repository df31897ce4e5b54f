"""Reader of real scenes: COLMAP and ETH3D models, and files of raw matches."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_pnpnet.core.files import read_npz
from kornia_pnpnet.data.scenes import Scene, View

__all__ = ["load_scene", "undistort"]

# Folders of a model below the user's folder: the folder itself, ETH3D's layout, COLMAP's layout.
_MODEL_FOLDERS = (".", "dslr_calibration_undistorted", "sparse/0", "sparse")


def load_scene(path: str | Path, *, metric: bool = True, min_points: int = 10, max_error_px: float = 10.0) -> Scene:
    """Load a scene from a COLMAP model or from a file of raw, unfiltered 2D-3D matches with the true poses.

    A folder holds a model, text or binary, that ``pycolmap`` reads. The model is in the folder or below it: ETH3D has
    it in ``dslr_calibration_undistorted``, COLMAP in ``sparse/0`` or ``sparse``. Pixels of distorted cameras are
    undistorted to the pinhole camera with the same focal length and principal point. A point that an image observes
    twice is used once, and points behind the camera, which only a fisheye lens can see, are dropped. All pairs count
    as inliers.

    An ``.npz`` file holds ``names`` (V,), ``K`` (V, 3, 3), ``R`` (V, 3, 3), ``t`` (V, 3) and ``size`` (V, 2) as width
    and height; for image ``iii`` (three digits) ``iii_img_points`` (M, 2), ``iii_world_points`` (M, 3) and
    ``iii_error_px`` (M,), the reprojection error under the true pose. Nothing in it is unpickled.

    Args:
        path: the folder or the file.
        metric: whether the unit of the scene is the metre.
        min_points: images with fewer points are skipped.
        max_error_px: matches of a file with a larger reprojection error are outliers.

    Raises:
        FileNotFoundError: if there is nothing at ``path`` or no model in the folder.
        ImportError: if a COLMAP model is to be read without ``pycolmap``.
        ValueError: if the file or the model cannot be used, or all images are skipped; the message says why.
    """
    path = Path(path)
    is_file = path.suffix == ".npz" and not path.is_dir()
    try:
        found = _match_views(path, max_error_px) if is_file else _colmap_views(path)
        views = sorted(found, key=lambda view: view.name)
    except ValueError as error:
        raise ValueError(f"'{path}' cannot be used: {error}") from error
    if not views:
        raise ValueError(f"'{path}' cannot be used: it has no images")
    kept = tuple(view for view in views if len(view.world_points) >= min_points)
    if not kept:
        most = max(len(view.world_points) for view in views)
        raise ValueError(f"no image of '{path}' has {min_points} points: the best of {len(views)} images has {most}")
    skipped = tuple(view.name for view in views if len(view.world_points) < min_points)
    # The folder of a scene is above the folders of its model.
    above = (place.name for place in (path.resolve(), *path.resolve().parents))
    name = path.stem if is_file else next(x for x in above if x not in ("0", "sparse", "dslr_calibration_undistorted"))
    return Scene(name, kept, skipped, metric)


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
        model, *numbers = camera.replace(",", " ").split()
        width, height, *parameters = map(float, numbers)
        lens = pycolmap.Camera(model=model.upper(), width=int(width), height=int(height), params=parameters)
        if not lens.verify_params():
            raise ValueError(f"{lens.model_name} has the parameters {lens.params_info}")
        matrix, pixels = _pinhole(lens, img_points.double().numpy())
    except (ValueError, RuntimeError, IndexError, AttributeError, TypeError) as error:
        raise ValueError(f"expected MODEL,width,height,params of COLMAP, got {camera!r}: {_line(error)}") from error
    return torch.tensor(matrix), torch.tensor(pixels)


def _pycolmap() -> Any:
    try:
        import pycolmap
    except ImportError as error:
        raise ImportError("COLMAP's models and cameras need pycolmap: pip install 'kornia_pnpnet[eval]'") from error
    return pycolmap


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


def _pinhole(camera: Any, distorted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pinhole camera (3, 3) like a ``pycolmap.Camera``, and its pixels (M, 2); NaN where there are none."""
    intrinsics = camera.calibration_matrix()
    plane = camera.cam_from_img(distorted)  # (M, 2), nan where the lens model has no inverse
    with np.errstate(invalid="ignore"):  # infinite where a focal length is 0
        return intrinsics, plane @ intrinsics[:2, :2].T + intrinsics[:2, 2]


def _find_model(folder: Path) -> Path:
    """The folder at or below ``folder`` that has the three files of a model, all binary or all text."""
    for below, ending in product(_MODEL_FOLDERS, (".bin", ".txt")):
        if all((folder / below / f"{stem}{ending}").is_file() for stem in ("cameras", "images", "points3D")):
            return folder / below
    looked = f"looked for cameras, images and points3D (.bin or .txt) in {', '.join(_MODEL_FOLDERS)}"
    raise FileNotFoundError(f"no COLMAP model at '{folder}': {looked}")


def _colmap_views(folder: Path) -> Iterator[View]:
    """The images of a model with what they observe."""
    place = _find_model(folder)
    pycolmap = _pycolmap()
    try:
        model = pycolmap.Reconstruction(str(place))
    except Exception as error:  # its C++ code throws many types on bad files, std::bad_alloc included
        raise ValueError(f"pycolmap cannot read the model: {_line(error)}") from error
    xyz_of = {number: point.xyz for number, point in model.points3D.items()}
    for image in model.images.values():
        observed = image.get_observation_points2D()
        pixel_of = {point.point3D_id: point.xy for point in reversed(observed)}  # of two pixels of a point the first
        numbers = sorted(pixel_of)
        if missing := pixel_of.keys() - xyz_of.keys():
            raise ValueError(f"image '{image.name}' observes the point {min(missing)}, which the model lacks")
        points = np.array([xyz_of[number] for number in numbers], dtype=np.float64).reshape(-1, 3)
        distorted = np.array([pixel_of[number] for number in numbers], dtype=np.float64).reshape(-1, 2)
        intrinsics, pixels = _pinhole(image.camera, distorted)
        world_to_cam = image.cam_from_world().matrix()  # (3, 4)
        depth = points @ world_to_cam[2, :3] + world_to_cam[2, 3]
        # `~(depth <= 0)`, so that a pose that is not finite reaches the check in View.
        seen = np.isfinite(pixels).all(axis=1) & ~(depth <= 0)
        arrays = (points[seen], pixels[seen], intrinsics, world_to_cam[:, :3], world_to_cam[:, 3])
        world, img, camera, rotation, translation = map(torch.tensor, arrays)
        inliers, size = torch.ones(len(world), dtype=torch.bool), (image.camera.width, image.camera.height)
        yield View(image.name, world, img, camera, rotation, translation, *size, inliers)


def _match_views(path: Path, max_error_px: float) -> Iterator[View]:
    """The images of a file of matches."""
    arrays = read_npz(path)
    if "names" not in arrays:
        raise ValueError("there is no array 'names'")
    names = [str(name) for name in np.atleast_1d(arrays["names"])]
    count = len(names)
    intrinsics, rotation = (_numbers(arrays, key, count, 3, 3) for key in ("K", "R"))
    translation, sizes = _numbers(arrays, "t", count, 3), _numbers(arrays, "size", count, 2).tolist()
    for i, (width, height) in enumerate(sizes):
        img = _numbers(arrays, f"{i:03d}_img_points", None, 2)
        world = _numbers(arrays, f"{i:03d}_world_points", len(img), 3)
        inliers = _numbers(arrays, f"{i:03d}_error_px", len(img)) <= max_error_px
        size = int(width), int(height)
        yield View(names[i], world, img, intrinsics[i], rotation[i], translation[i], *size, inliers)


def _numbers(arrays: Mapping[str, np.ndarray], key: str, *shape: int | None) -> Tensor:
    """An array of numbers, float64; ``None`` in its shape is any number."""
    if key not in arrays:
        raise ValueError(f"there is no array '{key}'")
    array = arrays[key]
    fits = len(shape) == array.ndim and all(s in (None, a) for s, a in zip(shape, array.shape, strict=True))
    if not fits or array.dtype.kind not in "fiu":
        wanted = ", ".join("any" if s is None else str(s) for s in shape)
        raise ValueError(f"'{key}' has shape {array.shape} of {array.dtype}, expected numbers of ({wanted})")
    return torch.tensor(array.astype(np.float64))
