"""Reader of real scenes: COLMAP and ETH3D models, and files of raw matches."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_pnpnet.core.extras import needs
from kornia_pnpnet.core.files import read_npz
from kornia_pnpnet.data.scenes import Scene, View

__all__ = ["load_scene", "undistort"]

# Possible folders of a model, relative to the user's folder. ETH3D and COLMAP use different sub-folders.
_MODEL_FOLDERS = (".", "dslr_calibration_undistorted", "sparse/0", "sparse")
# Largest distance in pixels between a pixel and the distorted form of its undistorted pixel.
_ROUND_TRIP = 0.5


def load_scene(path: str | Path, *, metric: bool = True, min_points: int = 10, max_error_px: float = 10.0) -> Scene:
    """Load a scene from a COLMAP model, or from a file with unfiltered 2D-3D matches and true poses.

    The model is in the folder ``path`` or in one of its sub-folders ``dslr_calibration_undistorted`` (ETH3D),
    ``sparse/0`` and ``sparse`` (COLMAP). Pixels of distorted cameras are undistorted, see ``undistort``. If an image
    observes a point twice, the first pixel is used. Points behind the camera and points without a finite pixel are
    dropped. All pairs of a model count as inliers.

    A file of matches is an ``.npz`` file with the matches of V images. The file has the arrays ``names`` (V,),
    ``K`` (V, 3, 3), ``R`` (V, 3, 3), ``t`` (V, 3) and ``size`` (V, 2) with widths and heights. The names of all other
    arrays start with the three-digit index of an image. For example, the M matches of image 7 are ``007_img_points``
    (M, 2) and ``007_world_points`` (M, 3), and ``007_error_px`` (M,) has the reprojection errors at the true pose.

    Args:
        path: the folder or the file.
        metric: whether the unit of the scene is the metre.
        min_points: images with fewer points are skipped.
        max_error_px: largest reprojection error, in pixels, of an inlier in a file of matches.

    Raises:
        FileNotFoundError: if ``path`` does not exist or the folder has no model.
        ImportError: if ``pycolmap`` is missing and ``path`` is a COLMAP model.
        ValueError: if the file or the model cannot be used, or if all images are skipped. The message says why.
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
    # A scene has the name of the innermost folder that is not part of a model's layout.
    above = (place.name for place in (path.resolve(), *path.resolve().parents))
    name = path.stem if is_file else next(x for x in above if x not in ("0", "sparse", "dslr_calibration_undistorted"))
    return Scene(name, kept, skipped, metric)


def undistort(camera: str, img_points: Tensor) -> tuple[Tensor, Tensor]:
    """Undistort pixels of any perspective camera model that ``pycolmap`` knows.

    Args:
        camera: ``MODEL,width,height,params...``, as in COLMAP's ``cameras.txt`` but without the camera's ID.
        img_points: distorted pixels, shape (N, 2).

    Returns:
        Two float64 tensors. The first (3, 3) is a pinhole camera matrix. It has the focal length and the principal
        point of ``camera``. The second (N, 2) has the undistorted pixels, NaN where the model has no inverse.

    Raises:
        ImportError: if ``pycolmap`` is missing.
        ValueError: for an unknown model, or for parameters that do not fit the model.
    """
    pycolmap = _pycolmap()
    try:
        model, *numbers = camera.replace(",", " ").split()
        width, height, *parameters = map(float, numbers)
        if not np.isfinite([width, height, *parameters]).all():
            raise ValueError("a number is not finite")
        lens = pycolmap.Camera(model=model.upper(), width=int(width), height=int(height), params=parameters)
        if not lens.verify_params():
            raise ValueError(f"{lens.model_name} has the parameters {lens.params_info}")
        matrix, pixels = _pinhole(lens, img_points.double().numpy())
    except (ValueError, RuntimeError, IndexError, AttributeError, TypeError) as error:
        raise ValueError(f"expected MODEL,width,height,params of COLMAP, got {camera!r}: {_line(error)}") from error
    return torch.tensor(matrix, device="cpu"), torch.tensor(pixels, device="cpu")


def _pycolmap() -> Any:
    with needs("eval", "COLMAP's models and cameras need pycolmap"):
        import pycolmap
    return pycolmap


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


def _pinhole(camera: Any, distorted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """See :func:`undistort`; ``camera`` is a ``pycolmap.Camera``."""
    intrinsics = camera.calibration_matrix()
    plane = camera.cam_from_img(distorted)  # (M, 2), NaN where the camera model has no inverse
    with np.errstate(invalid="ignore"):  # a focal length of 0 makes `plane` infinite
        again = camera.img_from_cam(np.column_stack((plane, np.ones(len(plane)))))
        plane[np.abs(again - distorted).max(1, initial=0.0) > _ROUND_TRIP] = np.nan  # for example beyond 90 degrees
        return intrinsics, plane @ intrinsics[:2, :2].T + intrinsics[:2, 2]


def _find_model(folder: Path) -> Path:
    """Return the first folder of ``_MODEL_FOLDERS`` that has the three files of a model in one format."""
    for below, ending in product(_MODEL_FOLDERS, (".bin", ".txt")):
        if all((folder / below / f"{stem}{ending}").is_file() for stem in ("cameras", "images", "points3D")):
            return folder / below
    looked = f"looked for cameras, images and points3D (.bin or .txt) in {', '.join(_MODEL_FOLDERS)}"
    raise FileNotFoundError(f"no COLMAP model at '{folder}': {looked}")


def _colmap_views(folder: Path) -> Iterator[View]:
    place = _find_model(folder)
    pycolmap = _pycolmap()
    try:
        model = pycolmap.Reconstruction(str(place))
    except Exception as error:  # pycolmap raises many types of errors on bad files, even MemoryError
        raise ValueError(f"pycolmap cannot read the model: {_line(error)}") from error
    xyz_of = {number: point.xyz for number, point in model.points3D.items()}
    for image in model.images.values():
        observed = image.get_observation_points2D()
        pixel_of = {point.point3D_id: point.xy for point in reversed(observed)}  # keeps the first pixel of a point
        numbers = sorted(pixel_of)
        if missing := pixel_of.keys() - xyz_of.keys():
            raise ValueError(f"image '{image.name}' observes the point {min(missing)}, which the model lacks")
        points = np.array([xyz_of[number] for number in numbers], dtype=np.float64).reshape(-1, 3)
        distorted = np.array([pixel_of[number] for number in numbers], dtype=np.float64).reshape(-1, 2)
        intrinsics, pixels = _pinhole(image.camera, distorted)
        world_to_cam = image.cam_from_world().matrix()  # (3, 4)
        depth = points @ world_to_cam[2, :3] + world_to_cam[2, 3]
        # A pose that is not finite gives NaN depths. Points of NaN depth are kept, and `View` refuses the pose.
        seen = np.isfinite(pixels).all(axis=1) & ~(depth <= 0)
        arrays = (points[seen], pixels[seen], intrinsics, world_to_cam[:, :3], world_to_cam[:, 3])
        world, img, camera, rotation, translation = (torch.tensor(x, device="cpu") for x in arrays)
        inliers, size = torch.ones_like(world[:, 0], dtype=torch.bool), (image.camera.width, image.camera.height)
        yield View(image.name, world, img, camera, rotation, translation, *size, inliers)


def _match_views(path: Path, max_error_px: float) -> Iterator[View]:
    arrays = read_npz(path)
    if "names" not in arrays:
        raise ValueError("there is no array 'names'")
    names = [str(name) for name in np.atleast_1d(arrays["names"])]
    count = len(names)
    intrinsics, rotation = (_numbers(arrays, key, count, 3, 3) for key in ("K", "R"))
    translation, sizes = _numbers(arrays, "t", count, 3), _numbers(arrays, "size", count, 2)
    if not ((sizes > 0) & sizes.isfinite()).all():
        raise ValueError("'size' has numbers that are not positive")
    for i, (width, height) in enumerate(sizes.tolist()):
        img = _numbers(arrays, f"{i:03d}_img_points", None, 2)
        world = _numbers(arrays, f"{i:03d}_world_points", len(img), 3)
        inliers = _numbers(arrays, f"{i:03d}_error_px", len(img)) <= max_error_px
        size = int(width), int(height)
        yield View(names[i], world, img, intrinsics[i], rotation[i], translation[i], *size, inliers)


def _numbers(arrays: Mapping[str, np.ndarray], key: str, *shape: int | None) -> Tensor:
    """Read a numeric array as float64 and check its shape; ``None`` in ``shape`` allows any size."""
    if key not in arrays:
        raise ValueError(f"there is no array '{key}'")
    array = arrays[key]
    fits = len(shape) == array.ndim and all(s in (None, a) for s, a in zip(shape, array.shape, strict=True))
    if not fits or array.dtype.kind not in "fiu":
        wanted = ", ".join("any" if s is None else str(s) for s in shape)
        raise ValueError(f"'{key}' has shape {array.shape} of {array.dtype}, expected numbers of ({wanted})")
    return torch.from_numpy(array.astype(np.float64))
