"""Very many problems from files, in bounded memory: what ``pnpnet solve --batch`` does."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from kornia.core.exceptions import BaseError
from torch import Tensor, nn

from kornia_pnpnet.cli.pairs import PairsError, check_present, checked_camera, read_arrays
from kornia_pnpnet.core.files import atomic_open
from kornia_pnpnet.types import PnPResult

__all__ = ["SUFFIXES", "ShardReport", "solve_shards"]

#: Files that are read, and written under the same name.
SUFFIXES = (".npz", ".parquet")
#: What says by which solver a folder of results was made.
MANIFEST = "manifest.json"
_NUMBERS = ("world_points", "img_points", "intrinsics", "weights", "img_sigma", "world_sigma")
_RESULTS = ("rotation", "translation", "weights", "cost", "ok")


class ShardReport(NamedTuple):
    """What became of the shards.

    Attributes:
        solved: problems with a pose, of the shards that were solved in this run.
        problems: problems of these shards.
        shards: how many shards were solved in this run.
        kept: how many had been solved before.
        failed: one line for each that cannot be read.
    """

    solved: int
    problems: int
    shards: int
    kept: int
    failed: list[str]


def solve_shards(
    solver: nn.Module,
    sources: Sequence[str | Path],
    out: str | Path,
    *,
    name: str,
    intrinsics: Tensor | None = None,
    batch: int = 10_000,
    overwrite: bool = False,
    watch: Callable[[Path, int, int], None] = lambda path, solved, count: None,
) -> ShardReport:
    r"""Solve shards of problems one after the other, and write the results of each under its name.

    A shard is an NPZ file with ``world_points`` (B, N, 3), ``img_points`` (B, N, 2) and, each of them optional,
    ``intrinsics`` (3, 3) or (B, 3, 3), ``weights`` (B, N), where 0 is padding, ``img_sigma`` and ``world_sigma``,
    numbers, (B,) or (B, N). Or it is a Parquet file with columns of these names, one problem in a row, all numbers of
    a problem in one list, row by row; numbers of pairs may differ from row to row. Of a Parquet file ``batch`` rows are
    in memory at a time, an NPZ file as a whole. Its results are ``rotation``, ``translation``, ``weights``, ``cost``
    and ``ok`` in the same format, float32, a list for each problem in Parquet.

    A result takes its name when it is complete: whoever is stopped goes on with the first shard that has none. A shard
    that cannot be read is reported and stops no other.

    Args:
        solver: any solver.
        sources: shards, or folders of them.
        out: a folder; two sources of one name cannot both go there.
        name: of the solver, which a folder of results remembers: another one does not go on in it.
        intrinsics: camera matrix (3, 3) for shards without cameras.
        batch: problems solved at once.
        overwrite: solve again what has been solved.
        watch: called after each shard with its path, the problems solved in it and all of them.

    Returns:
        The :class:`ShardReport`.

    Raises:
        PairsError: when there is no shard, two have one name, or the folder is another solver's or that of a shard.
        ImportError: for Parquet without the extra ``shards``.
        OSError: when the results cannot be written.
    """
    shards = _shards(sources)
    out = Path(out)
    for shard in shards:
        if shard.resolve() == (out / shard.name).resolve():
            raise PairsError(shard, "its results would take its place: another folder for them")
    _claim(out, name, solver, {shard.name for shard in shards} if overwrite else set())
    solved = problems = done = kept = 0
    failed = []
    for shard in shards:
        target = out / shard.name
        if target.exists() and not overwrite:
            kept += 1
            continue
        solve = _solve_npz if shard.suffix == ".npz" else _solve_parquet
        try:
            right, count = solve(solver, shard, target, intrinsics, batch)
        except PairsError as error:
            failed.append(str(error))
            continue
        solved, problems, done = solved + right, problems + count, done + 1
        watch(shard, right, count)
    return ShardReport(solved, problems, done, kept, failed)


def _shards(sources: Sequence[str | Path]) -> list[Path]:
    """All shards, in the order of their sources and names."""
    shards: dict[str, Path] = {}
    for source in map(Path, sources):
        found = sorted(x for x in source.iterdir() if x.suffix in SUFFIXES) if source.is_dir() else [source]
        if not found:
            raise PairsError(source, f"no {' or '.join(SUFFIXES)} file in this folder")
        for shard in found:
            if shard.suffix not in SUFFIXES:
                raise PairsError(shard, f"a shard ends in {' or '.join(SUFFIXES)}")
            if not shard.is_file():
                raise PairsError(shard, "no such file")
            if shards.setdefault(shard.name, shard) != shard:
                raise PairsError(shard, f"its results would take the name of those of {shards[shard.name]}")
    return list(shards.values())


def _claim(out: Path, name: str, solver: nn.Module, replaced: set[str]) -> None:
    """Write into a folder by which solver its results are, or see that those that are not replaced are by the same."""
    digest = hashlib.sha256()
    for key, value in sorted(solver.state_dict().items()):
        digest.update(key.encode() + value.detach().cpu().numpy().tobytes())
    mine = {"solver": name, "parameters": digest.hexdigest()}
    path = out / MANIFEST
    if path.exists():
        try:
            theirs = json.loads(path.read_text())
        except ValueError:
            theirs = None
        if theirs != mine:
            results = [x for x in out.iterdir() if x.suffix in SUFFIXES]
            if not {x.name for x in results} <= replaced:
                how = "--overwrite all of them" if replaced else "--overwrite"
                raise PairsError(path, f"the results in this folder are not by this {name}: take another, or {how}")
            for result in results:  # now: whoever is stopped must not find them under the new name
                result.unlink()
    with atomic_open(path) as file:
        json.dump(mine, file, indent=2)


def _solve_npz(solver: nn.Module, shard: Path, target: Path, intrinsics: Tensor | None, batch: int) -> tuple[int, int]:
    try:
        with shard.open("rb") as stream:
            arrays = read_arrays(shard, stream, _NUMBERS)
    except OSError as error:
        raise PairsError(shard, error.strerror or str(error)) from None
    tensors = _tensors(shard, arrays, intrinsics)
    results = list(_solve(solver, shard, tensors, batch))
    parts = {key: np.concatenate([getattr(x, key).numpy() for x in results]) for key in _RESULTS}
    with atomic_open(target, "wb") as file:
        np.savez(file, allow_pickle=False, **parts)
    return int(parts["ok"].sum()), len(parts["ok"])


def _tensors(source: Path, arrays: dict[str, np.ndarray], intrinsics: Tensor | None) -> dict[str, Tensor]:
    """Checked inputs in float32. What is not finite is its problem's own affair, which is then not ok."""
    shape = arrays["world_points"].shape
    if len(shape) != 3 or shape[2] != 3 or shape[1] < 3:
        raise PairsError(source, f"world_points must have the shape (B, N, 3) with N at least 3, got {shape}")
    count, pairs = shape[:2]
    noise: tuple[tuple[int, ...], ...] = ((), (count,), (count, pairs))
    shapes: dict[str, tuple[tuple[int, ...], ...]] = {
        "world_points": (shape,),
        "img_points": ((count, pairs, 2),),
        "intrinsics": ((3, 3), (count, 3, 3)),
        "weights": ((count, pairs),),
        "img_sigma": noise,
        "world_sigma": noise,
    }
    for key, array in arrays.items():
        if array.dtype.kind not in "fiub" or array.shape not in shapes[key]:
            wanted = " or ".join(map(str, shapes[key]))
            raise PairsError(
                source, f"{key} must hold numbers of the shape {wanted}, got {array.dtype} of {array.shape}"
            )
    tensors = {key: torch.from_numpy(array.astype(np.float32)) for key, array in arrays.items()}
    if "intrinsics" not in tensors:
        if intrinsics is None:
            raise PairsError(source, "the camera is not in the file: pass --intrinsics fx,fy,cx,cy")
        tensors["intrinsics"] = intrinsics.float()
    if tensors["intrinsics"].ndim == 2:
        tensors["intrinsics"] = checked_camera(tensors["intrinsics"], source).expand(count, 3, 3)
    return tensors


def _solve(solver: nn.Module, source: Path, tensors: dict[str, Tensor], batch: int) -> Iterator[PnPResult]:
    """Solve so many problems at a time."""
    count = len(tensors["world_points"])
    per_problem = {key: value for key, value in tensors.items() if value.ndim}
    for start in range(0, max(count, 1), batch):
        part = {**tensors, **{key: value[start : start + batch] for key, value in per_problem.items()}}
        try:
            with torch.no_grad():
                yield solver(**part)
        except (BaseError, TypeError) as error:  # for example another number of pairs than the solver's
            raise PairsError(source, str(error)) from None


def _solve_parquet(
    solver: nn.Module, shard: Path, target: Path, intrinsics: Tensor | None, batch: int
) -> tuple[int, int]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise ImportError("Parquet needs one more package: pip install 'kornia_pnpnet[shards]'") from error

    def read() -> Iterator[dict[str, list[Any]]]:
        try:
            # As it comes, Arrow reads ahead to the end of the file, and row groups, which may be all of it, as a whole.
            rows = parquet.ParquetFile(shard, pre_buffer=False, buffer_size=1 << 20)
            columns = [key for key in _NUMBERS if key in rows.schema_arrow.names]
            for table in rows.iter_batches(batch, columns=columns):
                yield table.to_pydict()
        except Exception as error:  # Arrow has half a dozen ways to say that a file is broken
            raise PairsError(shard, f"not a Parquet file of lists of numbers: {error}") from None

    lists = pyarrow.list_(pyarrow.float32())
    schema = pyarrow.schema(
        [(key, lists) for key in ("rotation", "translation", "weights")]
        + [("cost", pyarrow.float32()), ("ok", pyarrow.bool_())]
    )
    solved = count = 0
    with atomic_open(target, "wb") as file, parquet.ParquetWriter(file, schema) as writer:
        for columns in read():
            arrays, sizes = _padded(shard, columns)
            (result,) = _solve(solver, shard, _tensors(shard, arrays, intrinsics), batch)
            fields: dict[str, Any] = {
                "rotation": [*result.rotation.flatten(1).numpy()],
                "translation": [*result.translation.numpy()],
                "weights": [x[:size] for x, size in zip(result.weights.numpy(), sizes, strict=True)],
                "cost": result.cost.numpy(),
                "ok": result.ok.numpy(),
            }
            writer.write_table(pyarrow.table(fields, schema=schema))
            solved, count = solved + int(result.ok.sum()), count + len(sizes)
    return solved, count


def _padded(source: Path, columns: dict[str, list[Any]]) -> tuple[dict[str, np.ndarray], list[int]]:
    """Problems of different numbers of pairs as arrays with padding of the weight 0, and these numbers."""
    check_present(source, columns, "column")
    sizes = [len(x or ()) // 3 for x in columns["world_points"]]
    longest, count = max([*sizes, 3]), len(sizes)
    widths = {"world_points": 3, "img_points": 2, "weights": 1}
    columns = {"weights": [[1.0] * size for size in sizes], **columns}
    arrays: dict[str, np.ndarray] = {}
    for key, values in columns.items():
        try:
            if key == "intrinsics" or np.ndim(values[0]) == 0:
                arrays[key] = np.array(values, dtype=np.float64)
                if key == "intrinsics":
                    arrays[key] = arrays[key].reshape(count, 3, 3)
                continue
            width = widths.get(key, 1)
            array = np.full((count, longest * width), 0.0 if key in widths else np.nan)
            for row, (value, size) in enumerate(zip(values, sizes, strict=True)):
                if value is None or len(value) != size * width:
                    got = "nothing" if value is None else f"{len(value)} numbers"
                    raise PairsError(source, f"row {row}: {key} must have {size * width} numbers, got {got}")
                array[row, : size * width] = value
        except (ValueError, TypeError) as error:
            raise error if isinstance(error, PairsError) else PairsError(source, f"{key}: {error}") from None
        arrays[key] = array.reshape(count, longest, width) if width > 1 else array
    return arrays, sizes
