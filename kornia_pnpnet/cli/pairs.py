"""One problem from a file, and how well a pose explains it: what the command line needs around a solver."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
import torch
from kornia.geometry.conversions import convert_points_from_homogeneous, denormalize_points_with_intrinsics
from torch import Tensor

from kornia_pnpnet.geometry import transform
from kornia_pnpnet.types import Pose

__all__ = [
    "Pairs",
    "PairsError",
    "camera_matrix",
    "check_present",
    "checked_camera",
    "read_arrays",
    "read_pairs",
    "rejection_limit",
    "reprojections",
]

_COLUMNS = ("X", "Y", "Z", "u", "v")
_WEIGHT = "weight"
_MIN_PAIRS = 3
_ZIP_MAGIC = b"PK\x03\x04"


class PairsError(ValueError):
    """A file of pairs or a camera cannot be used; the message is one line, with the file and where it can the line."""

    def __init__(self, source: str | Path, message: str, line: int | None = None) -> None:
        where = f"{source}:{line}" if line is not None else str(source)
        super().__init__(f"{where}: {' '.join(message.split())}")


class Pairs(NamedTuple):
    r"""The pairs of one image, in float64.

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


def camera_matrix(text: str) -> Tensor:
    """Read a camera from ``fx,fy,cx,cy`` in pixels.

    Args:
        text: four numbers with commas between them; the focal lengths must be positive.

    Returns:
        The camera matrix, shape :math:`(3, 3)`, float64.

    Raises:
        PairsError: when it is something else.

    Example:
        >>> camera_matrix("100,100,320,240")[0]
        tensor([100.,   0., 320.], dtype=torch.float64)
    """
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError:
        raise PairsError("--intrinsics", f"expected four numbers fx,fy,cx,cy, got {text!r}") from None
    matrix = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return checked_camera(matrix, "--intrinsics")


def checked_camera(matrix: Tensor, source: str | Path) -> Tensor:
    """A camera matrix (3, 3) as it came.

    Raises:
        PairsError: when it is none of a pinhole camera without skew; ``source`` says where it is from.
    """
    if not matrix.isfinite().all():
        raise PairsError(source, "the intrinsics are not finite")
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        focal = f"{matrix[0, 0]:g} and {matrix[1, 1]:g}"
        raise PairsError(source, f"the focal lengths must be positive, got {focal}")
    if matrix[0, 1] != 0:
        raise PairsError(source, f"the camera must have no skew, got {matrix[0, 1]:g}")
    if matrix[1, 0] != 0 or not torch.equal(matrix[2], matrix.new_tensor((0.0, 0.0, 1.0))):
        raise PairsError(source, "the intrinsics must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    return matrix


def read_pairs(path: str | Path) -> Pairs:
    """Read the pairs of one image.

    Args:
        path: a CSV file with the header ``X,Y,Z,u,v`` in any order, an optional column ``weight`` and any others; or
            an NPZ file with the arrays ``world_points`` (N, 3), ``img_points`` (N, 2) and optionally ``weights``
            (N,) and ``intrinsics`` (3, 3). Nothing is unpickled.

    Returns:
        At least three pairs, all finite, in the order of the file.

    Raises:
        PairsError: when the file cannot be used.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise PairsError(path, error.strerror or str(error)) from None
    if path.suffix.lower() == ".npz" or content.startswith(_ZIP_MAGIC):
        return _read_npz(path, content)
    return _read_csv(path, content)


def _read_csv(path: Path, content: bytes) -> Pairs:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise PairsError(path, "not a text file in UTF-8", content[: error.start].count(b"\n") + 1) from None
    if "\0" in text:
        raise PairsError(path, "not a text file", text[: text.index("\0")].count("\n") + 1)
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    header: list[str] = []
    rows: list[list[float]] = []
    try:
        for cells in reader:
            if not any(cell.strip() for cell in cells):
                continue
            if header:
                rows.append(_row(path, reader.line_num, header, cells))
            else:
                header = _header(path, reader.line_num, cells)
    except csv.Error as error:
        raise PairsError(path, f"not a CSV file: {error}", reader.line_num) from None
    if not header:
        raise PairsError(path, f"the file is empty, expected the header {','.join(_COLUMNS)}", 1)
    if len(rows) < _MIN_PAIRS:
        raise PairsError(path, f"a pose needs at least {_MIN_PAIRS} pairs, got {len(rows)}", reader.line_num)
    table = torch.tensor(rows, dtype=torch.float64)
    return Pairs(table[:, :3], table[:, 3:5], table[:, 5] if table.shape[1] > len(_COLUMNS) else None)


def _header(path: Path, line: int, cells: list[str]) -> list[str]:
    header = [cell.strip() for cell in cells]
    for column in (*_COLUMNS, _WEIGHT):
        if header.count(column) > 1:
            raise PairsError(path, f"the column {column} is there {header.count(column)} times", line)
    missing = [column for column in _COLUMNS if column not in header]
    if missing:
        found = repr(",".join(header))
        found = found if len(found) <= 60 else f"{found[:57]}..."
        what = f"no column {', '.join(missing)}" if len(missing) < len(_COLUMNS) else "no header"
        raise PairsError(path, f"{what}: expected {','.join(_COLUMNS)}, found {found}", line)
    return header


def _row(path: Path, line: int, header: list[str], cells: list[str]) -> list[float]:
    """The numbers X, Y, Z, u, v and, where there is such a column, the weight."""
    if len(cells) != len(header):
        raise PairsError(path, f"{len(cells)} values, but the header has {len(header)} columns", line)
    numbers = []
    for column in (*_COLUMNS, _WEIGHT):
        if column not in header:
            continue
        cell = cells[header.index(column)].strip()
        try:
            numbers.append(float(cell))
        except ValueError:
            raise PairsError(path, f"{column} is not a number: {cell[:40]!r}", line) from None
        if not math.isfinite(numbers[-1]):
            raise PairsError(path, f"{column} is not finite: {cell}", line)
        if column == _WEIGHT and numbers[-1] < 0:
            raise PairsError(path, f"{column} is negative: {cell}", line)
    return numbers


def read_arrays(path: Path, stream: IO[bytes], names: Sequence[str]) -> dict[str, np.ndarray]:
    """Read those arrays of an NPZ file that are there.

    Args:
        path: of the file, for messages.
        stream: its content.
        names: of the arrays; ``world_points`` and ``img_points`` have to be there.

    Raises:
        PairsError: when it is not such a file, or one of the two is missing. Nothing is unpickled.
    """
    try:
        with np.load(stream, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in names if name in file.files}
    except Exception as error:  # numpy, zipfile and zlib have a dozen ways to say that a file is broken
        raise PairsError(path, f"not an NPZ file of plain arrays: {error}") from None
    check_present(path, arrays, "array")
    return arrays


def check_present(path: Path, arrays: Collection[str], kind: str) -> None:
    """Raise a :class:`PairsError` where points or pixels are missing; ``kind`` is what they are called in the file."""
    for name in ("world_points", "img_points"):
        if name not in arrays:
            raise PairsError(path, f"no {kind} {name}")


def _read_npz(path: Path, content: bytes) -> Pairs:
    arrays = read_arrays(path, io.BytesIO(content), ("world_points", "img_points", "weights", "intrinsics"))
    count = len(arrays["world_points"]) if arrays["world_points"].ndim else 0
    shapes = {"world_points": (count, 3), "img_points": (count, 2), "weights": (count,), "intrinsics": (3, 3)}
    for name, array in arrays.items():
        if array.shape != shapes[name] or array.dtype.kind not in "fiu":
            got = f"{array.dtype} of {array.shape}"
            raise PairsError(path, f"{name} must hold numbers of the shape {shapes[name]}, got {got}")
    if count < _MIN_PAIRS:
        raise PairsError(path, f"a pose needs at least {_MIN_PAIRS} pairs, got {count}")
    for name, array in arrays.items():
        bad = ~np.isfinite(array).reshape(len(array), -1).all(axis=1)
        if bad.any():
            raise PairsError(path, f"{name}[{int(bad.argmax())}] is not finite")
    tensors = {name: torch.tensor(array.astype(np.float64)) for name, array in arrays.items()}
    if "weights" in tensors and (tensors["weights"] < 0).any():
        raise PairsError(path, f"weights[{int((tensors['weights'] < 0).int().argmax())}] is negative")
    if "intrinsics" in tensors:
        checked_camera(tensors["intrinsics"], path)
    return Pairs(**tensors)


def reprojections(world_points: Tensor, pose: Pose, intrinsics: Tensor) -> Tensor:
    r"""Where a pose puts the points in the image.

    Args:
        world_points: shape :math:`(B, N, 3)`.
        pose: world-to-camera pose, :math:`(B, 3, 3)` and :math:`(B, 3)`.
        intrinsics: shape :math:`(B, 3, 3)`.

    Returns:
        Pixels of shape :math:`(B, N, 2)`, NaN for points that are not in front of the camera.
    """
    cam_points = transform(pose, world_points)
    in_front = cam_points[..., 2:] > 0
    plane_points = convert_points_from_homogeneous(torch.where(in_front, cam_points, 1.0), eps=0.0)
    pixels = denormalize_points_with_intrinsics(plane_points, intrinsics)
    return torch.where(in_front, pixels, torch.nan)


def rejection_limit(errors_px: Tensor) -> float:
    r"""Reprojection error above which a pair is taken for wrong when nobody says: a robust three sigma.

    Args:
        errors_px: reprojection errors of one problem in pixels, shape :math:`(N,)`; those that are not finite do not
            count.

    Returns:
        Three times 1.4826 times the median error, but at least 3 px.

    Example:
        >>> rejection_limit(torch.tensor([0.1, 0.2, 900.0])), rejection_limit(torch.tensor([9.0, 10.0, 11.0]))
        (3.0, 44.478)
    """
    finite = errors_px[errors_px.isfinite()]
    return max(3.0, 3.0 * 1.4826 * finite.double().quantile(0.5).item()) if len(finite) else 3.0
