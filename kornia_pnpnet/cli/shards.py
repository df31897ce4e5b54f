"""Solving many files of problems in bounded memory: ``pnpnet solve --batch``."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from kornia.core.exceptions import BaseError
from pyarrow import compute, parquet

from kornia_pnpnet.arrow import INPUTS, Solve, list_column
from kornia_pnpnet.cli.correspondence_files import read_arrays
from kornia_pnpnet.core.files import InputError, atomic_open, digest

__all__ = ["SUFFIXES", "ShardReport", "solve_shards"]

#: Formats of shards.
SUFFIXES = (".npz", ".parquet")

# Key in the metadata of a results file. The value has the solver's name, and digests (see `name` in `solve_shards`).
_SOLVER = b"kornia_pnpnet.solver"
# Largest number of values that are read from a Parquet file at once: 256 MiB in float64.
_NUMBERS_AT_ONCE = 2**25


class ShardReport(NamedTuple):
    """Result of :func:`solve_shards`."""

    solved: int  #: Number of problems with a pose, in the shards of this call.
    problems: int  #: Number of all problems in the shards of this call.
    shards: int  #: Number of shards that this call solved.
    kept: int  #: Number of shards that were skipped because they have results.
    failed: list[str]  #: One error message for each shard that cannot be read or solved.


def solve_shards(
    solve: Solve,
    sources: Sequence[str | Path],
    out: str | Path,
    *,
    name: str,
    batch: int = 10_000,
    overwrite: bool = False,
) -> ShardReport:
    r"""Solve shards of problems one after the other. The results of the shard ``part.*`` go to ``part.parquet``.

    A Parquet shard has one problem per row and the columns of :class:`~kornia_pnpnet.arrow.Solve`. An NPZ shard is read
    as a whole. Its arrays have the names of these columns: ``world_points`` (B, N, 3), ``img_points`` (B, N, 2) and
    optionally ``intrinsics`` (3, 3) or (B, 3, 3), ``weights`` (B, N), ``img_sigma`` and ``world_sigma``. Both sigmas
    have the shape (), (B,) or (B, N).

    A results file appears only when it is complete. A repeated call skips shards that have results.
    On a terminal, a bar shows the progress.

    Args:
        solve: the solver.
        sources: shards, or folders of shards. The report names the shards that cannot be read or solved.
        out: folder of the results. None of the shards may be in this folder.
        name: name of the solver. Results files store this name, a digest of weights, options and intrinsics, and a
            digest of the shard, which is read once more for it.
        batch: largest number of problems that are solved at once. Parquet shards are also read in such parts.
        overwrite: first delete the results of all shards, then solve all shards.

    Raises:
        InputError: when there is no shard, when two shards would have results of the same name, when ``out`` is the
            folder of a shard, or when a shard has results that were made from other content, or with another solver or
            other weights, options or intrinsics.
        OSError: when the results cannot be written.
    """
    state = chain.from_iterable(sorted(solve.solver.state_dict().items()))
    parameters = digest(repr(solve.solver), *state, solve.intrinsics)  # the text of a solver shows its options
    made_by = {"name": name, "parameters": parameters}
    waiting, unread, kept = {}, list[str](), 0
    for stem, shard in _find(sources, Path(out)).items():
        target = Path(out) / f"{stem}.parquet"
        if overwrite or not target.exists():
            waiting[target] = shard
            continue
        try:
            same = _solver_of(target) == _mark(made_by, shard)
        except InputError as error:
            unread.append(str(error))
            continue
        if not same:
            message = f"no results of {name} with these options for {shard}: use another folder or --overwrite"
            raise InputError(target, message)
        kept += 1
    for target in waiting:  # after an interruption, the same command without --overwrite must not keep old results
        target.unlink(missing_ok=True)
    counts, failed = np.zeros(2, int), []
    with _bar(waiting.values()) as bar:
        for target, shard in waiting.items():
            try:
                counts += _solve_shard(solve, shard, target, _mark(made_by, shard), batch, bar)
            except InputError as error:
                failed.append(str(error))
    solved, problems = counts.tolist()
    return ShardReport(solved, problems, len(waiting) - len(failed), kept, unread + failed)


def _find(sources: Sequence[str | Path], out: Path) -> dict[str, Path]:
    """Map the stem of each shard's name to the path of the shard. Shards of a folder are sorted by name."""
    shards: dict[str, Path] = {}
    endings = " or ".join(SUFFIXES)
    for source in map(Path, sources):
        found = sorted(x for x in source.iterdir() if x.suffix in SUFFIXES) if source.is_dir() else [source]
        if not found:
            raise InputError(source, f"no {endings} file in this folder")
        for shard in found:
            if shard.suffix not in SUFFIXES:
                raise InputError(shard, f"the name of a shard must end in {endings}")
            if not shard.is_file():
                raise InputError(shard, "no such file")
            if shard.resolve().parent == out.resolve():
                raise InputError(shard, "the results would lie among the shards: choose another folder")
            if shards.setdefault(shard.stem, shard) != shard:
                raise InputError(shard, f"its results would have the name of the results of {shards[shard.stem]}")
    return shards


def _mark(made_by: dict[str, str], shard: Path) -> bytes:
    """Return the metadata entry ``_SOLVER`` of the results of a shard."""
    try:
        with shard.open("rb") as file:
            return json.dumps({**made_by, "shard": hashlib.file_digest(file, "sha256").hexdigest()}).encode()
    except OSError as error:
        raise InputError(shard, str(error)) from None


def _solver_of(target: Path) -> bytes | None:
    """Return the metadata entry ``_SOLVER`` of a file, or ``None`` when the file is not a results file."""
    with suppress(pa.ArrowException, OSError):
        return (parquet.read_schema(target).metadata or {}).get(_SOLVER)
    return None


def _bar(shards: Iterable[Path]) -> Any:
    """Make a progress bar that counts problems. Without a terminal, the bar prints nothing."""
    from tqdm import tqdm

    total = None  # the total is unknown with NPZ files and with files that cannot be read
    with suppress(OSError, pa.ArrowException):
        total = sum(parquet.read_metadata(shard).num_rows for shard in shards)
    return tqdm(total=total, unit="problem", unit_scale=True, disable=None)


def _solve_shard(solve: Solve, shard: Path, target: Path, mark: bytes, batch: int, bar: Any) -> tuple[int, int]:
    """Solve a shard, and return the numbers of solved problems and of all problems."""
    solved, count, writer = 0, 0, None
    tables = _tables_of_arrays if shard.suffix == ".npz" else _tables_of_parquet
    with atomic_open(target, "wb") as file, ExitStack() as stack:
        for table in tables(shard, batch):
            try:
                result = solve(table)
            except (BaseError, TypeError, pa.ArrowException) as error:  # a column is missing or does not fit the solver
                raise InputError(shard, str(error)) from None
            if writer is None:
                schema = result.schema.with_metadata({_SOLVER: mark})
                writer = stack.enter_context(parquet.ParquetWriter(file, schema))
            writer.write_table(result)
            solved, count = solved + compute.sum(result["ok"], min_count=0).as_py(), count + len(result)
            bar.update(len(result))
    return solved, count


def _tables_of_parquet(shard: Path, batch: int) -> Iterator[pa.Table]:
    """Yield tables of at most ``batch`` rows from a Parquet file. An empty file yields one empty table."""
    try:
        # With pre_buffer, Arrow reads the whole file ahead. Without buffer_size, Arrow reads whole row groups.
        with parquet.ParquetFile(shard, pre_buffer=False, buffer_size=1 << 20) as file:
            groups = [file.metadata.row_group(i) for i in range(file.metadata.num_row_groups)]
            numbers = [sum(x.column(i).num_values for i in range(x.num_columns)) // max(x.num_rows, 1) for x in groups]
            rows = min(batch, max(_NUMBERS_AT_ONCE // max([*numbers, 1]), 1))
            if not file.metadata.num_rows:
                yield file.schema_arrow.empty_table()
            yield from (pa.Table.from_batches([part]) for part in file.iter_batches(rows))
    except Exception as error:  # Arrow raises many types of errors for broken files
        raise InputError(shard, f"not a Parquet file of problems: {error}") from None


def _tables_of_arrays(shard: Path, batch: int) -> Iterator[pa.Table]:
    """Yield tables of at most ``batch`` problems from an NPZ file. An empty file yields one empty table."""
    arrays = read_arrays(shard, INPUTS)
    for name, size in (("world_points", 3), ("img_points", 2)):
        if arrays[name].ndim != 3 or arrays[name].shape[2] != size:
            raise InputError(shard, f"{name} must be of the shape (B, N, {size}), got {arrays[name].shape}")
    count = len(arrays["world_points"])
    for name, shape in (("intrinsics", (3, 3)), ("img_sigma", ()), ("world_sigma", ())):
        if name in arrays and arrays[name].shape == shape:  # one value for all problems
            arrays[name] = np.broadcast_to(arrays[name], (count, *shape))
    if wrong := [name for name, array in arrays.items() if array.ndim == 0 or len(array) != count]:
        raise InputError(shard, f"the arrays are not of {count} problems each: {', '.join(wrong)}")
    for start in range(0, max(count, 1), batch):
        try:
            yield pa.table({name: list_column(array[start : start + batch]) for name, array in arrays.items()})
        except (TypeError, pa.ArrowException) as error:
            raise InputError(shard, f"an array does not hold real numbers: {error}") from None
