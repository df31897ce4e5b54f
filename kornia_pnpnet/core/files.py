"""Atomic writing of files, reading of CSV and NPZ files, and digests of contents."""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import json
import os
import uuid
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from torch import Tensor

#: Largest total size in bytes that :func:`read_npz` reads. A compressed file of a few megabytes can contain gigabytes.
MOST_BYTES = 2**31

#: Names of fields that no file of problems may have, because they would have no effect.
REFUSED = {"mask", "confidence", "weight", "dist", "fisheye", "img_cov", "world_cov", "cam_from_rig"}


class InputError(ValueError):
    """An input file or a command-line option cannot be used. The message is one line that begins with ``source``."""

    def __init__(self, source: str | Path, message: str, line: int | None = None) -> None:
        place = source if line is None else f"{source}:{line}"
        super().__init__(f"{place}: {' '.join(message.split())}")


@contextmanager
def atomic_open(path: str | Path, mode: str = "w", **options: Any) -> Iterator[IO[Any]]:
    """Open a temporary file for writing, and rename the complete file to ``path``. Missing folders are made."""
    path = Path(path)
    if path.exists() and not path.is_file():  # a folder, or a device such as /dev/null
        number = errno.EISDIR if path.is_dir() else errno.EINVAL
        raise OSError(number, os.strerror(number), str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")  # readers of tables skip hidden files
    try:
        with temporary.open(mode, **options) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: str | Path, content: Any) -> None:
    """Write an indented JSON file by :func:`atomic_open`. Raise ``ValueError`` when a number is not finite."""
    with atomic_open(path, encoding="utf-8") as file:
        file.write(json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_csv(path: str | Path, columns: Sequence[str], optional: Sequence[str] = ()) -> dict[int, dict[str, str]]:
    """Read a CSV file with a header. The result maps line numbers to rows, and a row maps column names to cells.

    Blank lines and spaces around cells are dropped. All columns are kept. Raise ``InputError`` when the file is not
    CSV in UTF-8, one of ``columns`` is missing, one of ``columns`` or ``optional`` occurs twice, or a row has more or
    fewer cells than the header.
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
    """Read the named arrays (or all arrays) of an NPZ file without unpickling. Missing arrays are left out.

    Raise ``ValueError`` when the file is not an NPZ file, contains pickled objects, or has arrays of more than
    :data:`MOST_BYTES` in total. The message does not name the file.
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
        except Exception as error:  # numpy, zipfile and zlib raise many types of errors for broken files
            raise ValueError(f"not an NPZ file of numbers: {error}") from error
    raise ValueError(f"the numbers take {size / 1e9:.1f} GB, more than {MOST_BYTES / 1e9:.1f} GB: split the file")


def digest(*parts: Any) -> str:
    """Compute one hexadecimal SHA-256 digest of the concatenated parts: tensors, strings, bytes, and data as JSON.

    The digest of a tensor depends on dtype, shape and values, not on the device.
    """
    sha = hashlib.sha256()
    for part in parts:
        if isinstance(part, Tensor):
            values = part.detach().cpu().contiguous()
            content = values.reshape(-1).view(torch.uint8).numpy().tobytes()  # NumPy lacks some dtypes
            sha.update(f" {values.dtype} {tuple(values.shape)}".encode() + content)
        elif isinstance(part, bytes):
            sha.update(part)
        else:
            sha.update((part if isinstance(part, str) else json.dumps(part, sort_keys=True)).encode())
    return sha.hexdigest()
