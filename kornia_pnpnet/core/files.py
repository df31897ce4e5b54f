"""Writing files in one piece, reading NPZ files, and digests of contents."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from torch import Tensor

__all__ = ["MOST_BYTES", "atomic_open", "digest", "read_npz", "write_json"]

#: Bytes of numbers that are read from a file at once. A few compressed megabytes can unpack to any size.
MOST_BYTES = 2**31


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


def read_npz(path: Path, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Read the arrays of an NPZ file, or those of these names that it has, without unpickling.

    Raises:
        ValueError: when the file is not an NPZ file of numbers, or has more than :data:`MOST_BYTES` of them. The
            message does not name the file.
    """
    size = 0
    with path.open("rb") as file:
        try:
            with np.lib.npyio.NpzFile(file, allow_pickle=False) as content:
                assert content.zip is not None
                members = {member.filename.removesuffix(".npy"): member.file_size for member in content.zip.infolist()}
                wanted = [name for name in members if names is None or name in names]
                size = sum(members[name] for name in wanted)
                if size <= MOST_BYTES:
                    return {name: np.asarray(content[name]) for name in wanted}
        except Exception as error:  # numpy, zipfile and zlib raise a dozen types of errors for broken files
            raise ValueError(f"not an NPZ file of numbers: {error}") from error
    raise ValueError(f"the numbers take {size / 1e9:.1f} GB, more than {MOST_BYTES / 1e9:.1f} GB: split the file")


def digest(*parts: Any) -> str:
    """SHA-256, in hexadecimal, of contents one after the other.

    Tensors count by dtype, shape and values, on any device; plain data as JSON with sorted keys.
    """
    sha = hashlib.sha256()
    for part in parts:
        if isinstance(part, Tensor):
            values = part.detach().cpu().contiguous()
            sha.update(f" {values.dtype} {tuple(values.shape)}".encode())
            sha.update(values.reshape(-1).view(torch.uint8).numpy().tobytes())  # NumPy does not have every dtype
        elif isinstance(part, bytes):
            sha.update(part)
        else:
            sha.update((part if isinstance(part, str) else json.dumps(part, sort_keys=True)).encode())
    return sha.hexdigest()
