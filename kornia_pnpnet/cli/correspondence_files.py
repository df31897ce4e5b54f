"""Files of the correspondences of one image, CSV or NPZ, and the camera of the command line."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kornia_pnpnet.core.files import read_npz

__all__ = ["ImageCorrespondences", "InputError", "camera_matrix", "read_arrays", "read_correspondences"]

_COLUMNS = ("X", "Y", "Z", "u", "v")
_MIN_COUNT = 3
_ZIP_MAGIC = b"PK\x03\x04"


class InputError(ValueError):
    """A file or a camera cannot be used. The message is one line and names the file and, in text files, the line."""

    def __init__(self, source: str | Path, message: str, line: int | None = None) -> None:
        where = f"{source}:{line}" if line is not None else str(source)
        super().__init__(f"{where}: {' '.join(message.split())}")


class ImageCorrespondences(NamedTuple):
    r"""The correspondences of one image, in float64.

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
        """With the pixels of the pinhole camera of COLMAP's ``MODEL,width,height,params...``.

        A pixel that no ray of the camera has gets the weight 0.
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
    """Return the matrix of a pinhole camera, scaled to end in 1; raise an :class:`InputError` for any other matrix."""
    if not matrix.isfinite().all():
        raise InputError(source, "the intrinsics are not finite")
    if matrix[1, 0] != 0 or matrix[2, :2].any() or matrix[2, 2] == 0:
        raise InputError(source, "the intrinsics must be [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] or a multiple of it")
    matrix = matrix / matrix[2, 2]
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise InputError(source, f"the focal lengths must be positive, got {matrix[0, 0]:g} and {matrix[1, 1]:g}")
    return matrix


def read_correspondences(path: str | Path) -> ImageCorrespondences:
    """Read the correspondences of one image: at least three, all finite, in the order of the file.

    Args:
        path: a CSV file with the header ``X,Y,Z,u,v`` in any order, an optional column ``weight`` and any others; or
            an NPZ file with the arrays ``world_points`` (N, 3), ``img_points`` (N, 2) and optionally ``weights``
            (N,) and ``intrinsics`` (3, 3).
    """
    path = Path(path)
    content = path.read_bytes()
    is_npz = path.suffix.lower() == ".npz" or content.startswith(_ZIP_MAGIC)
    read = _read_npz(path) if is_npz else _read_csv(path, content)
    if len(read.world_points) < _MIN_COUNT:
        raise InputError(path, f"a pose needs at least {_MIN_COUNT} correspondences, got {len(read.world_points)}")
    return read


def _read_csv(path: Path, content: bytes) -> ImageCorrespondences:
    try:
        reader = csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True)
    except UnicodeDecodeError as error:
        raise InputError(path, "not a text file in UTF-8", content[: error.start].count(b"\n") + 1) from None
    try:
        lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
    except csv.Error as error:
        raise InputError(path, f"not a CSV file: {error}", reader.line_num) from None
    (header_line, header), *rows = [(line, cells) for line, cells in lines if any(cells)] or [(1, [""])]
    columns = [*_COLUMNS, *(["weight"] if "weight" in header else [])]
    if any(header.count(column) != 1 for column in columns):
        found = ",".join(header)[:60]
        raise InputError(path, f"expected the header {','.join(_COLUMNS)}, each once, found {found!r}", header_line)
    table = np.empty((len(rows), len(columns)))
    for number, (line, cells) in enumerate(rows):
        if len(cells) != len(header):
            raise InputError(path, f"{len(cells)} values, but the header has {len(header)} columns", line)
        named = dict(zip(header, cells, strict=True))
        for index, column in enumerate(columns):
            table[number, index] = value = _number(named[column])
            least = 0.0 if column == "weight" else -math.inf
            if not (math.isfinite(value) and value >= least):
                wanted = "a number of at least 0" if column == "weight" else "a finite number"
                raise InputError(path, f"{column} must be {wanted}, got {named[column][:40]!r}", line)
    world_points, img_points, weights = torch.from_numpy(table).tensor_split((3, 5), 1)
    return ImageCorrespondences(world_points, img_points, weights[:, 0] if "weight" in columns else None)


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _read_npz(path: Path) -> ImageCorrespondences:
    arrays = read_arrays(path, ("world_points", "img_points", "weights", "intrinsics"))
    count = len(arrays["world_points"]) if arrays["world_points"].ndim else 0
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
        tensors[name] = torch.tensor(array.astype(np.float64))
    if "intrinsics" in tensors:
        tensors["intrinsics"] = _pinhole(tensors["intrinsics"], path)
    return ImageCorrespondences(**tensors)


def read_arrays(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Read the arrays that the NPZ file ``path`` has, of which only the points must be there."""
    try:
        arrays = read_npz(path, names)
    except ValueError as error:
        raise InputError(path, str(error)) from None
    for name in ("world_points", "img_points"):
        if name not in arrays:
            raise InputError(path, f"no array {name}")
    return arrays
