"""Writing files in one piece, and digests of contents."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import zipfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from torch import Tensor

__all__ = ["MOST_BYTES", "atomic_open", "check_size", "digest", "npz_shapes", "read_npz", "write_json"]

#: Bytes of numbers that are read from a file at once. A few compressed megabytes can unpack to any size.
MOST_BYTES = 2**31
# Readers of the headers by version.
_NPY_HEADERS = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}


@contextmanager
def atomic_open(path: str | Path, mode: str = "w", **options: Any) -> Iterator[IO[Any]]:
    """Open a file for writing that takes its name only when it is complete and on disk.

    A process that is killed or finds the disk full leaves the old file as it was: a reader sees the old file or the
    new one, never a part. Missing folders are made.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open(mode, **options) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: str | Path, content: Any) -> None:
    """Write an indented JSON file in one piece. ``ValueError`` for numbers that are not finite."""
    with atomic_open(path, encoding="utf-8") as file:
        file.write(json.dumps(content, indent=2, allow_nan=False) + "\n")


def check_size(count: int, advice: str) -> None:
    """Raise a ``ValueError`` when ``count`` bytes are more than :data:`MOST_BYTES`; ``advice`` says what to do."""
    if count > MOST_BYTES:
        raise ValueError(f"the numbers take {count / 1e9:.1f} GB, more than {MOST_BYTES / 1e9:.1f} GB: {advice}")


def npz_shapes(path: Path, names: Collection[str] | None = None) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of an NPZ file, or of those of these names that it has, from their headers alone.

    Raises:
        ValueError: when the file is not an NPZ file of numbers, or has more than :data:`MOST_BYTES` of them. The
            message does not name the file.
    """
    shapes, size = {}, 0
    with path.open("rb") as content:
        try:
            with zipfile.ZipFile(content) as archive:
                for member in archive.infolist():
                    name = member.filename.removesuffix(".npy")
                    if names is not None and name not in names:
                        continue
                    with archive.open(member) as file:
                        major = np.lib.format.read_magic(file)[0]
                        shapes[name], _, dtype = _NPY_HEADERS[major](file)
                    if dtype.hasobject:
                        raise ValueError(f"{name} holds Python objects")
                    size += max(math.prod(shapes[name]) * dtype.itemsize, member.file_size)
        except Exception as error:  # numpy, zipfile and zlib raise a dozen types of errors for broken files
            raise ValueError(f"not an NPZ file of numbers: {error}") from error
    check_size(size, "split the file")
    return shapes


def read_npz(path: Path, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Read the arrays of an NPZ file, or those of these names that it has, without unpickling.

    Raises:
        ValueError: see :func:`npz_shapes`.
    """
    wanted = npz_shapes(path, names)
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as content:  # np.load leaves broken files open
            return {name: np.asarray(content[name]) for name in content.files if name in wanted}
    except Exception as error:  # numpy, zipfile and zlib raise a dozen types of errors for broken files
        raise ValueError(f"not an NPZ file of numbers: {error}") from error


def digest(*parts: Any) -> str:
    """SHA-256, in hexadecimal, of contents one after the other.

    Tensors count by dtype, shape and values, on any device; plain data as JSON with sorted keys.

    Example:
        >>> state = {"weight": torch.ones(2)}
        >>> len(digest({"m": 3}, *(part for item in sorted(state.items()) for part in item)))
        64
    """
    sha = hashlib.sha256()
    for part in parts:
        if isinstance(part, bytes):
            sha.update(part)
        elif isinstance(part, str):
            sha.update(part.encode())
        elif isinstance(part, Tensor):
            values = part.detach().cpu().contiguous()
            sha.update(f" {values.dtype} {tuple(values.shape)}".encode())
            sha.update(values.reshape(-1).view(torch.uint8).numpy().tobytes())  # NumPy does not have every dtype
        else:
            sha.update(json.dumps(part, sort_keys=True).encode())
    return sha.hexdigest()
