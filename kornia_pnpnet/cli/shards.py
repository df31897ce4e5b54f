"""Many problems from files, solved in bounded memory: ``pnpnet solve --batch``."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from kornia.core.exceptions import BaseError
from torch import Tensor, nn

from kornia_pnpnet.cli.correspondence_files import (
    InputError,
    check_camera,
    check_points_present,
    check_shapes,
    read_arrays,
)
from kornia_pnpnet.core.files import atomic_open, check_size, digest, npz_shapes, write_json
from kornia_pnpnet.types import PnPResult

__all__ = ["MANIFEST", "SUFFIXES", "ShardReport", "solve_shards"]

#: Formats of shards. The results of a shard have its name and format.
SUFFIXES = (".npz", ".parquet")
#: File in a folder of results with the name and the digest of the solver.
MANIFEST = "manifest.json"
_INPUTS = ("world_points", "img_points", "intrinsics", "weights", "img_sigma", "world_sigma")
_OUTPUTS = ("rotation", "translation", "weights", "cost", "ok")


class ShardReport(NamedTuple):
    """Counts of a run over shards.

    Attributes:
        solved: problems with a pose in the shards that this run solved.
        problems: all problems in the shards that this run solved.
        shards: number of shards that this run solved.
        kept: number of shards that had results before.
        failed: one line for each shard that cannot be read.
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
    progress: bool = False,
) -> ShardReport:
    r"""Solve shards of problems one after the other, and write the results of each shard to a file of its name.

    A shard is an NPZ file with ``world_points`` (B, N, 3), ``img_points`` (B, N, 2) and optionally ``intrinsics``
    (3, 3) or (B, 3, 3), ``weights`` (B, N) with 0 for padding, and the standard deviations ``img_sigma`` in pixels and
    ``world_sigma`` in the unit of the world, each a number, (B,) or (B, N). Or a shard is a Parquet file with columns
    of these names and one problem per row: each cell is the flat list of the problem's numbers in row-major order, and
    N may differ between rows. The results are ``rotation``, ``translation``, ``weights``, ``cost`` and ``ok`` in the
    format of the shard, in float32. An NPZ file is read as a whole, a Parquet file ``batch`` rows at a time.

    A file of results gets its name when it is complete, so a run that was stopped can be repeated: shards with results
    are skipped. A shard that cannot be read, or whose numbers would need more memory than
    ``core.files.MOST_BYTES`` at once, is reported and the other shards are solved.

    Args:
        solver: any solver.
        sources: shards, or folders of shards.
        out: folder of the results. Two shards of the same name cannot both be written there.
        name: name of the solver. The folder stores it, and results of another solver are not mixed with these.
        intrinsics: camera matrix of shape :math:`(3, 3)` for shards without intrinsics.
        batch: number of problems solved at once.
        overwrite: also solve the shards that have results.
        watch: called after each shard with its path, the number of solved problems and the number of problems.
        progress: show a progress bar with the rate on stderr, where stderr is a terminal and tqdm is installed.

    Returns:
        The :class:`ShardReport`.

    Raises:
        InputError: when there is no shard, two shards have the same name, or ``out`` holds the shards themselves or
            results of another solver.
        ImportError: for Parquet without the extra ``shards``.
        OSError: when the results cannot be written.
    """
    shards = _find(sources)
    out = Path(out)
    for shard in shards:
        if shard.resolve() == (out / shard.name).resolve():
            raise InputError(shard, "the results would overwrite the shard: choose another folder")
    _claim(out, name, solver, {shard.name for shard in shards} if overwrite else set())
    waiting = [shard for shard in shards if overwrite or not (out / shard.name).exists()]
    solved = problems = done = 0
    failed = []
    with _bar(waiting, batch, progress) as advance:
        for shard in waiting:
            solve = _solve_npz if shard.suffix == ".npz" else _solve_parquet
            try:
                ok, count = solve(solver, shard, out / shard.name, intrinsics, batch, advance)
            except InputError as error:
                failed.append(str(error))
                continue
            solved, problems, done = solved + ok, problems + count, done + 1
            watch(shard, ok, count)
    return ShardReport(solved, problems, done, len(shards) - len(waiting), failed)


@contextmanager
def _bar(shards: Sequence[Path], batch: int, shown: bool) -> Iterator[Callable[[int], object]]:
    """A progress bar over the problems of shards; yields what advances it by a number of problems."""
    if not shown or not sys.stderr.isatty() or find_spec("tqdm") is None:
        yield lambda count: None
        return
    from tqdm import tqdm

    total = 0
    for shard in shards:
        with suppress(InputError, ImportError):  # reported when the shard's turn comes
            total += _count(shard, batch)
    with tqdm(total=total, unit="problem", unit_scale=True) as bar:
        yield bar.update


def _count(shard: Path, batch: int) -> int:
    """Number of problems of a shard, from its header; an :class:`InputError` for one that needs too much memory."""
    if shard.suffix == ".npz":
        try:
            return (npz_shapes(shard, _INPUTS).get("world_points") or (0,))[0]
        except ValueError as error:
            raise InputError(shard, str(error)) from None
    return _open_parquet(shard, batch).metadata.num_rows


def _find(sources: Sequence[str | Path]) -> list[Path]:
    """All shards in the order of the sources, those of a folder by name."""
    shards: dict[str, Path] = {}
    for source in map(Path, sources):
        found = sorted(x for x in source.iterdir() if x.suffix in SUFFIXES) if source.is_dir() else [source]
        if not found:
            raise InputError(source, f"no {' or '.join(SUFFIXES)} file in this folder")
        for shard in found:
            if shard.suffix not in SUFFIXES:
                raise InputError(shard, f"the name of a shard must end in {' or '.join(SUFFIXES)}")
            if not shard.is_file():
                raise InputError(shard, "no such file")
            if shards.setdefault(shard.name, shard) != shard:
                raise InputError(shard, f"{shards[shard.name]} has the same name, so the results would collide")
    return list(shards.values())


def _claim(out: Path, name: str, solver: nn.Module, replaced: set[str]) -> None:
    """Write the manifest of this solver; refuse a folder with results of another solver that are not replaced."""
    state = sorted(solver.state_dict().items())
    manifest = {"solver": name, "parameters": digest(*(part for item in state for part in item))}
    path = out / MANIFEST
    if path.exists():
        try:
            found = json.loads(path.read_text())
        except ValueError:
            found = None
        if found != manifest:
            results = [x for x in out.iterdir() if x.suffix in SUFFIXES]
            if not {x.name for x in results} <= replaced:
                how = "--overwrite all of them" if replaced else "--overwrite"
                raise InputError(path, f"the folder has results of another solver than this {name}: change it or {how}")
            for result in results:  # before the manifest: a run stopped in between must not mix two solvers
                result.unlink()
    write_json(path, manifest)


def _solve_npz(
    solver: nn.Module,
    shard: Path,
    target: Path,
    intrinsics: Tensor | None,
    batch: int,
    advance: Callable[[int], object],
) -> tuple[int, int]:
    """Solve an NPZ shard; return the number of solved problems and of all problems."""
    tensors = _tensors(shard, read_arrays(shard, _INPUTS), intrinsics)
    results = []
    for result in _solve(solver, shard, tensors, batch):
        results.append(result)
        advance(len(result.ok))
    outputs = {key: np.concatenate([getattr(x, key).numpy() for x in results]) for key in _OUTPUTS}
    with atomic_open(target, "wb") as file:
        np.savez(file, allow_pickle=False, **outputs)
    return int(outputs["ok"].sum()), len(outputs["ok"])


def _tensors(source: Path, arrays: dict[str, np.ndarray], intrinsics: Tensor | None) -> dict[str, Tensor]:
    """Checked inputs in float32. Values may be NaN or infinite: the solver then marks their problem as not ok."""
    shape = arrays["world_points"].shape
    if len(shape) != 3 or shape[2] != 3 or shape[1] < 3:
        raise InputError(source, f"world_points must have the shape (B, N, 3) with N at least 3, got {shape}")
    count, n = shape[:2]
    sigmas: list[tuple[int, ...]] = [(), (count,), (count, n)]
    shapes: dict[str, list[tuple[int, ...]]] = {
        "world_points": [shape],
        "img_points": [(count, n, 2)],
        "intrinsics": [(3, 3), (count, 3, 3)],
        "weights": [(count, n)],
        "img_sigma": sigmas,
        "world_sigma": sigmas,
    }
    check_shapes(source, arrays, shapes)
    tensors = {key: torch.from_numpy(array.astype(np.float32)) for key, array in arrays.items()}
    if "intrinsics" not in tensors:
        if intrinsics is None:
            raise InputError(source, "the file has no intrinsics: pass --intrinsics fx,fy,cx,cy")
        tensors["intrinsics"] = intrinsics.float()
    if tensors["intrinsics"].ndim == 2:
        tensors["intrinsics"] = check_camera(tensors["intrinsics"], source).expand(count, 3, 3)
    return tensors


def _solve(solver: nn.Module, source: Path, tensors: dict[str, Tensor], batch: int) -> Iterator[PnPResult]:
    """Solve ``batch`` problems at a time."""
    for start in range(0, max(len(tensors["world_points"]), 1), batch):
        part = {key: value[start : start + batch] if value.ndim else value for key, value in tensors.items()}
        try:
            with torch.no_grad():
                yield solver(**part)
        except (BaseError, TypeError) as error:  # for example another number of correspondences than the network's
            raise InputError(source, str(error)) from None


def _open_parquet(shard: Path, batch: int) -> Any:
    """Open a Parquet shard; an :class:`InputError` when ``batch`` rows need too much memory."""
    try:
        from pyarrow import parquet
    except ImportError as error:
        raise ImportError("Parquet needs one more package: pip install 'kornia_pnpnet[shards]'") from error
    try:
        # With pre_buffer Arrow reads ahead to the end of the file, and without buffer_size a row group at once.
        file = parquet.ParquetFile(shard, pre_buffer=False, buffer_size=1 << 20)
        groups = [file.metadata.row_group(i) for i in range(file.metadata.num_row_groups)]
        values = [(sum(x.column(j).num_values for j in range(x.num_columns)), x.num_rows) for x in groups]
    except Exception as error:  # Arrow raises half a dozen types of errors for broken files
        raise InputError(shard, f"not a Parquet file of lists of numbers: {error}") from None
    most = max((count * min(batch, rows) // max(rows, 1) for count, rows in values), default=0)
    try:
        check_size(8 * most, "choose a smaller --batch-size, or split the file")
    except ValueError as error:
        raise InputError(shard, str(error)) from None
    return file


def _solve_parquet(
    solver: nn.Module,
    shard: Path,
    target: Path,
    intrinsics: Tensor | None,
    batch: int,
    advance: Callable[[int], object],
) -> tuple[int, int]:
    """Solve a Parquet shard; return the number of solved problems and of all problems."""
    rows = _open_parquet(shard, batch)
    import pyarrow
    from pyarrow import parquet

    def read() -> Iterator[dict[str, list[Any]]]:
        try:
            columns = [key for key in _INPUTS if key in rows.schema_arrow.names]
            for table in rows.iter_batches(batch, columns=columns):
                yield table.to_pydict()
        except Exception as error:
            raise InputError(shard, f"not a Parquet file of lists of numbers: {error}") from None

    types = dict.fromkeys(_OUTPUTS, pyarrow.list_(pyarrow.float32()))
    schema = pyarrow.schema(types | {"cost": pyarrow.float32(), "ok": pyarrow.bool_()})
    solved = count = 0
    with atomic_open(target, "wb") as file, parquet.ParquetWriter(file, schema) as writer:
        for columns in read():
            arrays, sizes = _padded(shard, columns)
            (result,) = _solve(solver, shard, _tensors(shard, arrays, intrinsics), batch)
            outputs: dict[str, Any] = {key: [*getattr(result, key).flatten(1).numpy()] for key in _OUTPUTS[:2]}
            outputs["weights"] = [x[:size] for x, size in zip(result.weights.numpy(), sizes, strict=True)]
            outputs |= {"cost": result.cost.numpy(), "ok": result.ok.numpy()}
            writer.write_table(pyarrow.table(outputs, schema=schema))
            solved, count = solved + int(result.ok.sum()), count + len(sizes)
            advance(len(sizes))
    return solved, count


def _padded(source: Path, columns: dict[str, list[Any]]) -> tuple[dict[str, np.ndarray], list[int]]:
    """Arrays of rows of different lengths, padded with weight 0, and the number of correspondences of each row."""
    check_points_present(source, columns, "column")
    try:  # rows may be nested lists, as `.tolist()` makes them
        columns = {key: [np.ravel(x) if isinstance(x, list) else x for x in values] for key, values in columns.items()}
    except ValueError as error:
        raise InputError(source, f"lists of different lengths: {error}") from None
    sizes = [0 if x is None else len(x) // 3 for x in columns["world_points"]]
    columns = {"weights": [[1.0] * size for size in sizes], **columns}
    shapes = {"world_points": (3,), "img_points": (2,), "weights": (), "img_sigma": (), "world_sigma": ()}
    arrays: dict[str, np.ndarray] = {}
    for key, values in columns.items():
        try:
            if key == "intrinsics":
                arrays[key] = np.array(values, dtype=np.float64).reshape(-1, 3, 3)
            elif np.ndim(values[0]) == 0:
                arrays[key] = np.array(values, dtype=np.float64)
            else:
                arrays[key] = _pad(source, key, values, sizes, shapes[key])
        except (ValueError, TypeError) as error:
            raise error if isinstance(error, InputError) else InputError(source, f"{key}: {error}") from None
    return arrays, sizes


def _pad(source: Path, key: str, values: list[Any], sizes: list[int], shape: tuple[int, ...]) -> np.ndarray:
    """One array of a list of numbers per row; padded sigmas are NaN, which means unknown."""
    array = np.full((len(sizes), max([*sizes, 3]), *shape), np.nan if key.endswith("_sigma") else 0.0)
    for row, (value, size) in enumerate(zip(values, sizes, strict=True)):
        wanted = array[row, :size].size
        if value is None or len(value) != wanted:
            got = "nothing" if value is None else f"{len(value)} numbers"
            raise InputError(source, f"row {row}: {key} must have {wanted} numbers, got {got}")
        array[row, :size] = np.reshape(value, (size, *shape))
    return array
