"""Reading the correspondences and the camera of one image, and computing reprojection errors."""

from __future__ import annotations

import math
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from kornia.geometry.conversions import convert_points_from_homogeneous
from kornia.geometry.linalg import transform_points
from torch import Tensor

from kornia_pnpnet.core.files import InputError, read_csv, read_npz
from kornia_pnpnet.problem import MIN_PAIRS
from kornia_pnpnet.result import Pose

__all__ = ["ImageCorrespondences", "InputError", "camera_matrix", "read_arrays", "read_correspondences", "reproject"]

_COLUMNS = ("X", "Y", "Z", "u", "v")
_ZIP_MAGIC = b"PK\x03\x04"


class ImageCorrespondences(NamedTuple):
    r"""The correspondences of one image, in float64, or in float32 if all arrays of the file are float32.

    Attributes:
        world_points: shape :math:`(N, 3)`.
        img_points: pixels, shape :math:`(N, 2)`.
        weights: at least 0, shape :math:`(N,)`, or ``None``.
        intrinsics: camera matrix, shape :math:`(3, 3)`, or ``None``.
    """

    world_points: Tensor
    img_points: Tensor
    weights: Tensor | None = None
    intrinsics: Tensor | None = None

    def undistorted(self, camera: str) -> ImageCorrespondences:
        """Undistort the pixels, and use the intrinsics of the undistorted pinhole camera.

        A pixel that cannot be undistorted gets the weight 0. For ``camera`` see
        ``kornia_pnpnet.data.colmap.undistort``.
        """
        from kornia_pnpnet.data.colmap import undistort

        try:
            matrix, pixels = undistort(camera, self.img_points)
        except ValueError as error:
            raise InputError("--camera", str(error)) from None
        there = pixels.isfinite().all(-1)
        weights = there.to(pixels) if self.weights is None else torch.where(there, self.weights, 0.0)
        pixels = torch.where(there[:, None], pixels, matrix[:2, 2])
        return ImageCorrespondences(self.world_points, pixels, weights, _pinhole(matrix, "--camera"))


def camera_matrix(text: str) -> Tensor:
    """Read ``fx,fy,cx,cy`` in pixels as a camera matrix, shape (3, 3), float64."""
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError("--intrinsics", f"expected four numbers fx,fy,cx,cy, got {text!r}") from None
    return _pinhole(torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64), "--intrinsics")


def _pinhole(matrix: Tensor, source: str | Path) -> Tensor:
    """Scale a pinhole camera matrix so that its last element is 1; ``InputError`` for any other matrix."""
    if not matrix.isfinite().all():
        raise InputError(source, "the intrinsics are not finite")
    if matrix[1, 0] != 0 or matrix[2, :2].any() or matrix[2, 2] == 0:
        raise InputError(source, "the intrinsics must be [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] or a multiple of it")
    if matrix[0, 0] == 0 or matrix[1, 1] == 0:
        raise InputError(source, f"the focal lengths must not be 0, got {matrix[0, 0]:g} and {matrix[1, 1]:g}")
    return matrix / matrix[2, 2]


def read_correspondences(path: str | Path) -> ImageCorrespondences:
    """Read the correspondences of one image in the order of the file.

    Args:
        path: a CSV file or an NPZ file. A CSV file has the columns ``X,Y,Z,u,v`` and optionally ``weight``, in any
            order; other columns are ignored. An NPZ file has the arrays ``world_points`` (N, 3), ``img_points`` (N, 2)
            and optionally ``weights`` (N,) and ``intrinsics`` (3, 3).

    Raises:
        InputError: for fewer than three correspondences, a missing column or array, or an invalid number.
    """
    path = Path(path)
    with path.open("rb") as file:
        is_npz = path.suffix.lower() == ".npz" or file.read(len(_ZIP_MAGIC)) == _ZIP_MAGIC
    read = _read_npz(path) if is_npz else _read_csv(path)
    if len(read.world_points) < MIN_PAIRS:
        raise InputError(path, f"a pose needs at least {MIN_PAIRS} correspondences, got {len(read.world_points)}")
    return read


def _read_csv(path: Path) -> ImageCorrespondences:
    table: dict[str, list[float]] = {name: [] for name in (*_COLUMNS, "weight")}
    for line, row in read_csv(path, _COLUMNS, optional=("weight",)).items():
        for name in (name for name in table if name in row):
            value = math.nan
            with suppress(ValueError):
                value = float(row[name])
            if not math.isfinite(value) or (name == "weight" and value < 0):
                wanted = "a number of at least 0" if name == "weight" else "a finite number"
                raise InputError(path, f"{name} must be {wanted}, got {row[name][:40]!r}", line)
            table[name].append(value)
    x, y, z, u, v, weights = (torch.tensor(column, dtype=torch.float64) for column in table.values())
    return ImageCorrespondences(torch.stack((x, y, z), 1), torch.stack((u, v), 1), weights if len(weights) else None)


def _read_npz(path: Path) -> ImageCorrespondences:
    arrays = read_arrays(path, ImageCorrespondences._fields)
    if arrays["world_points"].ndim == 3:
        raise InputError(path, f"world_points of {arrays['world_points'].shape} are many problems: pass --batch")
    count = len(arrays["world_points"]) if arrays["world_points"].ndim else 0
    # A file of float32 is solved in float32, so that the solver knows the precision of the points.
    dtype = np.float32 if np.result_type(np.float32, *arrays.values()) == np.float32 else np.float64
    shapes = {"world_points": (count, 3), "img_points": (count, 2), "weights": (count,), "intrinsics": (3, 3)}
    tensors = {}
    for name, array in arrays.items():
        if array.dtype.kind not in "fiub" or array.shape != shapes[name]:
            got = f"{array.dtype} of {array.shape}"
            raise InputError(path, f"{name} must hold numbers of the shape {shapes[name]}, got {got}")
        bad = ~np.isfinite(array) | ((name == "weights") & (array < 0))
        if bad.any():
            wanted = "finite and at least 0" if name == "weights" else "finite"
            raise InputError(path, f"{name}[{int(np.nonzero(bad)[0][0])}] must be {wanted}")
        tensors[name] = torch.tensor(array.astype(dtype))
    if "intrinsics" in tensors:
        tensors["intrinsics"] = _pinhole(tensors["intrinsics"], path)
    return ImageCorrespondences(**tensors)


def read_arrays(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Read the arrays with the given names; ``InputError`` if ``world_points`` or ``img_points`` is missing."""
    try:
        arrays = read_npz(path, names)
    except ValueError as error:
        raise InputError(path, str(error)) from None
    for name in ("world_points", "img_points"):
        if name not in arrays:
            raise InputError(path, f"no array {name}")
    return arrays


def reproject(world_points: Tensor, img_points: Tensor, intrinsics: Tensor, pose: Pose) -> tuple[Tensor, Tensor]:
    """Compute the reprojection errors of one image. ``pose`` is a batch of one pose.

    Returns:
        The reprojections (N, 2) and the reprojection errors (N,) in pixels; NaN for points that are not in front of the
        camera.
    """
    cam_points = transform_points(pose.matrix, world_points[None])[0]
    in_front = cam_points[:, 2:] > 0
    pixels = convert_points_from_homogeneous(torch.where(in_front, cam_points, 1.0) @ intrinsics.mT, eps=0.0)
    pixels = torch.where(in_front, pixels, torch.nan)
    return pixels, (pixels - img_points).norm(dim=-1)
