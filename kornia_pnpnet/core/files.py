"""Write files in one piece, read CSV and NPZ files, digest contents."""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import json
import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from torch import Tensor

__all__ = ["MOST_BYTES", "InputError", "atomic_open", "digest", "read_csv", "read_npz", "write_json"]

#: Largest number of bytes read from a file at once. A few compressed megabytes can unpack to gigabytes.
MOST_BYTES = 2**31


class InputError(ValueError):
    """A file or an option cannot be used. The message is one line that names it and, in text files, the line."""

    def __init__(self, source: str | Path, message: str, line: int | None = None) -> None:
        place = source if line is None else f"{source}:{line}"
        super().__init__(f"{place}: {' '.join(message.split())}")


@contextmanager
def atomic_open(path: str | Path, mode: str = "w", **options: Any) -> Iterator[IO[Any]]:
    """Open a file for writing that takes its name only when it is complete and on disk.

    A process that is killed or finds the disk full leaves the old file as it was. Missing folders are made.
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


def read_csv(path: str | Path, columns: Sequence[str], optional: Sequence[str] = ()) -> dict[int, dict[str, str]]:
    """Read the rows of a CSV file with a header: maps the number of the line to the cells by column.

    Blank lines and spaces around cells are dropped; further columns are kept.

    Raises:
        InputError: when the file is not CSV in UTF-8, lacks one of the ``columns``, has one of them or an ``optional``
            one twice, or a row has more or fewer cells than the header.
    """
    content = Path(path).read_bytes()
    try:
        reader = csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True)
    except UnicodeDecodeError as error:
        raise InputError(path, "not a text file in UTF-8", content[: error.start].count(b"\n") + 1) from None
    try:
        lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
    except csv.Error as error:
        raise InputError(path, f"not a CSV file: {error}", reader.line_num) from None
    (first, header), *rows = [(line, cells) for line, cells in lines if any(cells)] or [(1, [""])]
    if any(header.count(x) != 1 for x in columns) or any(header.count(x) > 1 for x in optional):
        found = ",".join(header)[:60]
        raise InputError(path, f"expected the header {','.join(columns)}, each once, found {found!r}", first)
    for line, cells in rows:
        if len(cells) != len(header):
            raise InputError(path, f"{len(cells)} values, but the header has {len(header)} columns", line)
    return {line: dict(zip(header, cells, strict=True)) for line, cells in rows}


def read_npz(path: Path, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Read the arrays of an NPZ file, or those of these names that it has, without unpickling.

    Raises:
        ValueError: when the file is not an NPZ file of numbers, or has more than :data:`MOST_BYTES` of them. The
            message does not name the file.
    """
    with path.open("rb") as file:
        try:
            with np.lib.npyio.NpzFile(file, allow_pickle=False) as content:
                assert content.zip is not None
                members = {member.filename.removesuffix(".npy"): member.file_size for member in content.zip.infolist()}
                wanted = {name: size for name, size in members.items() if names is None or name in names}
                size = sum(wanted.values())
                if size <= MOST_BYTES:
                    return {name: np.asarray(content[name]) for name in wanted}
        except Exception as error:  # numpy, zipfile and zlib raise a dozen types of errors for broken files
            raise ValueError(f"not an NPZ file of numbers: {error}") from error
    raise ValueError(f"the numbers take {size / 1e9:.1f} GB, more than {MOST_BYTES / 1e9:.1f} GB: split the file")


def digest(*parts: Any) -> str:
    """SHA-256, in hexadecimal, of contents one after the other.

    The digest of a tensor depends on dtype, shape and values, not on the device. Plain data are digested as JSON with
    sorted keys.
    """
    sha = hashlib.sha256()
    for part in parts:
        if isinstance(part, Tensor):
            values = part.detach().cpu().contiguous()
            content = values.reshape(-1).view(torch.uint8).numpy().tobytes()  # NumPy does not have every dtype
            sha.update(f" {values.dtype} {tuple(values.shape)}".encode() + content)
        elif isinstance(part, bytes):
            sha.update(part)
        else:
            sha.update((part if isinstance(part, str) else json.dumps(part, sort_keys=True)).encode())
    return sha.hexdigest()
