"""Read the correspondences and the camera of one image."""

from __future__ import annotations

import math
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple
from zipfile import is_zipfile

import numpy as np
import torch
from torch import Tensor

from kornia_pnpnet.core.files import REFUSED, InputError, read_csv, read_npz
from kornia_pnpnet.problem import MIN_PAIRS

_COLUMNS = ("X", "Y", "Z", "u", "v")
# Names of columns and arrays that are refused unless they are read, because users would expect an effect.
_REFUSED = {*REFUSED, "weights", "img_sigma", "world_sigma"}


class ImageCorrespondences(NamedTuple):
    """The correspondences of one image. The dtype is float32 if all arrays of the file are float32, else float64."""

    world_points: Tensor  # (N, 3)
    img_points: Tensor  # pixels, (N, 2)
    weights: Tensor  # at least 0, (N,); all 1 if the file has no weights
    intrinsics: Tensor | None = None  # (3, 3)

    def undistorted(self, camera: str) -> ImageCorrespondences:
        """Undistort pixels with ``kornia_pnpnet.data.colmap.undistort``.

        A pixel without a solution is NaN and gets weight 0.
        """
        from kornia_pnpnet.data.colmap import undistort

        try:
            matrix, pixels = undistort(camera, self.img_points)
        except ValueError as error:
            raise InputError("--camera", str(error)) from None
        there = pixels.isfinite().all(-1)
        weights = torch.where(there, self.weights, 0.0).double()
        return ImageCorrespondences(self.world_points.double(), pixels, weights, _pinhole(matrix, "--camera"))


def camera_matrix(text: str) -> Tensor:
    """Read ``fx,fy,cx,cy`` in pixels as a camera matrix, shape (3, 3), float64."""
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError("--intrinsics", f"expected four numbers fx,fy,cx,cy, got {text!r}") from None
    return _pinhole(torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64), "--intrinsics")


def _pinhole(matrix: Tensor, source: str | Path) -> Tensor:
    """Scale a pinhole camera matrix so that its last element is 1. Raise ``InputError`` for any other matrix."""
    if not matrix.isfinite().all():
        raise InputError(source, "the intrinsics are not finite")
    if matrix[1, 0] != 0 or matrix[2, :2].any() or matrix[2, 2] == 0:
        raise InputError(source, "the intrinsics must be [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] or a multiple of it")
    if matrix[0, 0] == 0 or matrix[1, 1] == 0:
        raise InputError(source, f"the focal lengths must not be 0, got {matrix[0, 0]:g} and {matrix[1, 1]:g}")
    return matrix / matrix[2, 2]


def read_correspondences(path: str | Path) -> ImageCorrespondences:
    """Read a CSV file (columns ``X,Y,Z,u,v``, optionally ``weight``) or an NPZ file (arrays named as in the result).

    Raise ``InputError`` for fewer than three correspondences, a missing column or array, or an invalid number.
    """
    path = Path(path)
    read = _read_npz(path) if path.suffix.lower() == ".npz" or is_zipfile(path) else _read_csv(path)
    if len(read.world_points) < MIN_PAIRS:
        raise InputError(path, f"a pose needs at least {MIN_PAIRS} correspondences, got {len(read.world_points)}")
    return read


def _read_csv(path: Path) -> ImageCorrespondences:
    rows: list[list[float]] = []
    for line, cells in read_csv(path, _COLUMNS, optional=("weight",)).items():
        if refused := cells.keys() & (_REFUSED - {"weight"}):
            raise InputError(path, f"the column {min(refused)} is not read: pairs of weight 0 are ignored")
        rows.append([])
        for name in (*_COLUMNS, "weight"):
            text, value = cells.get(name, "1"), math.nan
            with suppress(ValueError):
                value = float(text)
            if not math.isfinite(value) or (name == "weight" and value < 0):
                wanted = "a number of at least 0" if name == "weight" else "a finite number"
                raise InputError(path, f"{name} must be {wanted}, got {text[:40]!r}", line)
            rows[-1].append(value)
    world_points, img_points, weights = torch.tensor(rows, dtype=torch.float64).view(-1, 6).split((3, 2, 1), 1)
    return ImageCorrespondences(world_points, img_points, weights[:, 0])


def _read_npz(path: Path) -> ImageCorrespondences:
    arrays = read_arrays(path, ImageCorrespondences._fields)
    if arrays["world_points"].ndim == 3:
        raise InputError(path, f"world_points of {arrays['world_points'].shape} are many problems: pass --batch")
    count = len(arrays["world_points"]) if arrays["world_points"].ndim else 0
    arrays.setdefault("weights", np.ones(count, np.float32))
    shapes = {"world_points": (count, 3), "img_points": (count, 2), "weights": (count,), "intrinsics": (3, 3)}
    for name, array in arrays.items():
        if array.dtype.kind not in "fiub" or array.shape != shapes[name]:
            got = f"{array.dtype} of {array.shape}"
            raise InputError(path, f"{name} must hold numbers of the shape {shapes[name]}, got {got}")
        bad = ~np.isfinite(array) | ((name == "weights") & (array < 0))
        if bad.any():
            wanted = "finite and at least 0" if name == "weights" else "finite"
            raise InputError(path, f"{name}[{int(np.nonzero(bad)[0][0])}] must be {wanted}")
    # Float32 arrays stay in float32, so that the solver detects points that need more digits than float32 has.
    dtype = np.float32 if np.result_type(np.float32, *arrays.values()) == np.float32 else np.float64
    tensors = {name: torch.tensor(array.astype(dtype)) for name, array in arrays.items()}
    if "intrinsics" in tensors:
        tensors["intrinsics"] = _pinhole(tensors["intrinsics"], path)
    return ImageCorrespondences(**tensors)


def read_arrays(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Read the named arrays of an NPZ file. Raise ``InputError`` if ``world_points`` or ``img_points`` is missing."""
    try:
        arrays = read_npz(path, {*names, *_REFUSED})
    except (OSError, ValueError) as error:
        raise InputError(path, getattr(error, "strerror", None) or str(error)) from None
    if refused := arrays.keys() - {*names}:
        raise InputError(path, f"the array {min(refused)} is not read: pairs with 0 in weights are ignored")
    for name in ("world_points", "img_points"):
        if name not in arrays:
            raise InputError(path, f"no array {name}")
    return arrays
