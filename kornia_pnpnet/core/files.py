"""Writing files in one piece, and digests of contents."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import torch
from torch import Tensor

__all__ = ["atomic_open", "digest", "write_json"]


@contextmanager
def atomic_open(path: str | Path, mode: str = "w", **options: Any) -> Iterator[IO[Any]]:
    """Open a file for writing that takes its name only when it is complete and on disk.

    A process that is killed or finds the disk full leaves the old file as it was: a reader sees the old file or the
    new one, never a part.

    Args:
        path: the file; missing folders are made.
        mode: ``"w"`` or ``"wb"``.
        options: passed to :func:`open`.

    Yields:
        The open file.

    Raises:
        OSError: when the file cannot be written.
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
    """Write an indented JSON file in one piece.

    Args:
        path: the file; missing folders are made.
        content: plain data.

    Raises:
        TypeError: for values that JSON does not have.
        ValueError: for numbers that are not finite.
        OSError: when the file cannot be written. After any of these errors the old file is as it was.
    """
    with atomic_open(path, encoding="utf-8") as file:
        file.write(json.dumps(content, indent=2, allow_nan=False) + "\n")


def digest(*parts: Any) -> str:
    """SHA-256 of contents, one after the other.

    Args:
        parts: bytes and texts; tensors of any dtype and device, by dtype, shape and values; other plain data as JSON
            with sorted keys.

    Returns:
        The digest in hexadecimal.

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
