"""Solve tables of problems. The tables have Apache Arrow's format and come, for example, from Ray Data."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from kornia.core.exceptions import ShapeError, TypeCheckError, ValueCheckError
from torch import Tensor, nn

from kornia_pnpnet.core.checks import check_form
from kornia_pnpnet.core.extras import needs
from kornia_pnpnet.core.files import REFUSED
from kornia_pnpnet.propose.initialiser import trait
from kornia_pnpnet.registry import create_solver
from kornia_pnpnet.result import Status

with needs("shards", "tables need pyarrow"):
    import pyarrow as pa
    from pyarrow import compute

__all__ = ["INPUTS", "OUTPUTS", "Solve", "list_column"]

_PAIRS = -1  # placeholder in shapes for the number of pairs
_SHAPES: dict[str, tuple[int, ...]] = {"world_points": (_PAIRS, 3), "img_points": (_PAIRS, 2), "intrinsics": (3, 3)}
_SHAPES |= dict.fromkeys(("weights", "img_sigma", "world_sigma"), (_PAIRS,))
#: Columns that :class:`Solve` reads.
INPUTS = tuple(_SHAPES)
#: Columns that :class:`Solve` writes with every solver.
OUTPUTS = ("rotation", "translation", "weights", "cost", "ok", "status")

_LISTS = pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list
_NUMBERS = pa.types.is_integer, pa.types.is_floating, pa.types.is_null, pa.types.is_boolean
# Names of the values of `Status`. The last name is the status of rows that the solver cannot accept.
_STATUS_NAMES = pa.array([*(status.name.lower() for status in Status), "malformed"])
# Only problems with at least this number of pairs are padded. See `_groups`.
_PADDED_FROM = 16


class Solve:
    r"""Map a table of problems to a table of poses, for example in ``map_batches`` of Ray Data.

    Each row is a problem. The number of pairs N may differ between rows. Each cell is a list of numbers in row-major
    order: ``world_points`` (3N numbers), ``img_points`` in pixels (2N), and optionally ``intrinsics`` (9), ``weights``
    (N), ``img_sigma`` in pixels, and ``world_sigma`` in the unit of the world. A sigma has N numbers, or one number for
    all pairs. NaN means an unknown sigma.

    The result has the columns ``rotation`` (9), ``translation`` (3), ``weights`` (N), ``cost``, ``ok``, and ``status``
    (the name of a :class:`~kornia_pnpnet.result.Status` in lower case). If the solver estimates an unknown focal
    length, the result also has the columns ``intrinsics`` (9) and ``dist`` (4) with the estimates. Malformed rows have
    the identity and zeros there. Rows keep their order. Other columns of the table, for example ``id``, are kept.
    Tables with a float64 column of numbers are solved in float64, all others in float32. The result has that dtype.

    A row that cannot be solved raises no error: its ``ok`` is false, and its pose is finite. The status of a row is
    ``malformed`` if a list is missing or has an incorrect length, or if the solver does not accept the number of pairs.

    Args:
        solver: a name of :func:`~kornia_pnpnet.registry.list_solvers`, or a solver.
        intrinsics: camera matrix, shape :math:`(3, 3)`, for all rows of tables without the column ``intrinsics``.
        options: options of the named solver, see :func:`~kornia_pnpnet.registry.create_solver`.

    Raises:
        BaseError: for an unknown solver or option, or when ``intrinsics`` does not have the shape :math:`(3, 3)`.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> problems = SyntheticProblems(n=9, batch_size=2, seed=0).batch(0)
        >>> names = "world_points", "img_points", "intrinsics"
        >>> columns = {name: list_column(x.numpy()) for name, x in zip(names, problems)}
        >>> poses = Solve("epnp-lm")(pa.table({"id": [7, 8], **columns}))
        >>> poses["id"].to_pylist(), poses["ok"].to_pylist()
        ([7, 8], [True, True])
    """

    #: Approximate largest number of pairs, padding included, in one call of the solver. The limit saves memory.
    pairs_at_once = 2**17

    def __init__(
        self, solver: str | nn.Module = "pnpnet-set", *, intrinsics: Tensor | None = None, **options: Any
    ) -> None:
        if intrinsics is not None:
            check_form(["3", "3"], intrinsics=intrinsics)
            intrinsics = intrinsics.float()
        if options and not isinstance(solver, str):
            raise ValueCheckError(f"Options are for the name of a solver, got a module and {sorted(options)}.")
        with torch.device("cpu"):  # tables are on the CPU, even if PyTorch's default device is a GPU
            self.solver = create_solver(solver, **options) if isinstance(solver, str) else solver
        self.intrinsics = intrinsics

    def __call__(self, table: pa.Table) -> pa.Table:
        """Solve a table.

        Missing columns, columns of equal names, and arguments of a solver that tables cannot have (``mask``,
        ``confidence``, ``dist``, ``fisheye``, covariances, ``cam_from_rig``) raise ``ValueCheckError``. Columns without
        numbers raise ``TypeCheckError``.
        """
        if double := {name for name in table.column_names if table.column_names.count(name) > 1}:
            raise ValueCheckError(f"the table has several columns {', '.join(sorted(double))}")
        if refused := REFUSED & {*table.column_names}:
            raise ValueCheckError(f"the column {min(refused)} is not read: call the solver itself, or drop the column")
        for name in INPUTS[: 3 if self.intrinsics is None else 2]:
            if name not in table.column_names:
                raise ValueCheckError(f"the table has no column {name}")
        cells = {name: _Cells(name, table[name]) for name in INPUTS if name in table.column_names}
        counts = cells["world_points"].sizes // 3  # (rows,)
        fits = (counts >= 3) & np.logical_and.reduce([x.fit(counts) for x in cells.values()])
        dtype = np.result_type(*(x.values for x in cells.values()))
        values: dict[str, np.ndarray] = {
            "rotation": np.tile(np.eye(3, dtype=dtype), (len(counts), 1, 1)),
            "translation": np.zeros((len(counts), 3), dtype=dtype),
            "cost": np.full(len(counts), np.finfo(dtype).max ** 0.5, dtype=dtype),  # see `PnPNet.forward`
            "ok": np.zeros(len(counts), dtype=bool),
            "status": np.full(len(counts), len(_STATUS_NAMES) - 1, dtype=np.int8),
        }
        if getattr(self.solver, "focal", "known") == "unknown":
            values |= {"intrinsics": values["rotation"].copy(), "dist": np.zeros((len(counts), 4), dtype=dtype)}
        ends = np.append(0, counts.cumsum())
        weights = np.zeros(ends[-1], dtype=dtype)
        pads = not trait(getattr(self.solver, "init", None), "fixed_pairs")
        for rows, width in _groups(counts, fits, self.pairs_at_once, pads=pads):
            there = np.arange(width) < counts[rows, None]  # (R, width), false for padding
            taken = {name: torch.from_numpy(x.take(rows, width).astype(dtype, copy=False)) for name, x in cells.items()}
            inputs: dict[str, Any] = {"intrinsics": self.intrinsics, **taken}
            with torch.no_grad(), suppress(ShapeError):  # raised if the solver does not accept `width` pairs
                result = self.solver(**inputs, mask=None if there.all() else torch.from_numpy(there))
                for name, array in values.items():
                    array[rows] = getattr(result, name).numpy()
                weights[(ends[rows, None] + np.arange(width))[there]] = result.weights.numpy()[there]
        columns = {name: table[name] for name in table.column_names if name not in INPUTS + OUTPUTS}
        columns |= {name: list_column(array) for name, array in values.items() if array.ndim > 1}
        columns["weights"] = pa.ListArray.from_arrays(pa.array(ends, pa.int32()), weights)
        columns |= {name: pa.array(values[name]) for name in ("cost", "ok")}
        return pa.table({**columns, "status": _STATUS_NAMES.take(pa.array(values["status"]))})


def list_column(values: np.ndarray) -> pa.Array:
    r"""Convert an array :math:`(B, …)` to a column of B lists of numbers in row-major order.

    Example:
        >>> list_column(np.eye(2)).to_pylist()
        [[1.0, 0.0], [0.0, 1.0]]
    """
    size = math.prod(values.shape[1:])
    return pa.ListArray.from_arrays(pa.array(np.arange(len(values) + 1) * size, pa.int32()), values.reshape(-1))


class _Cells:
    """A column. List i is ``values[starts[i] : starts[i] + sizes[i]]``, empty if it, or a list in it, is null.

    Null numbers are NaN.
    """

    def __init__(self, name: str, column: pa.ChunkedArray) -> None:
        array = column.combine_chunks()
        ends, nulls = np.arange(len(array) + 1), np.zeros(len(array), int)
        while any(is_list(array.type) for is_list in _LISTS):  # lists from `.tolist()` are nested
            nulls += np.diff(np.append(0, array.is_null().to_numpy(zero_copy_only=False).cumsum())[ends])
            sizes = compute.list_value_length(array).fill_null(0).to_numpy(zero_copy_only=False)
            ends = np.append(0, sizes.cumsum())[ends]
            array = compute.list_flatten(array)
        if not any(is_number(array.type) for is_number in _NUMBERS):
            raise TypeCheckError(f"the column {name} must hold lists of numbers, got {column.type}")
        dtype = pa.float64() if pa.types.is_float64(array.type) else pa.float32()
        self.values = array.cast(dtype, safe=False).to_numpy(zero_copy_only=False)
        self.starts, self.sizes = ends[:-1], np.where(nulls, 0, np.diff(ends))
        self.shape, self.one_for_all = _SHAPES[name], name.endswith("_sigma")

    def fit(self, counts: np.ndarray) -> np.ndarray:
        """Return whether each cell has the number of entries that the cell's problem needs, bool (rows,)."""
        needed = math.prod(counts if size == _PAIRS else size for size in self.shape)
        return (self.sizes == needed) | (self.one_for_all & (self.sizes == 1))

    def take(self, rows: np.ndarray, width: int) -> np.ndarray:
        """Return the cells of some rows. Each cell is padded to ``width`` pairs by repeating its last number."""
        shape = [width if size == _PAIRS else size for size in self.shape]
        within = np.minimum(np.arange(math.prod(shape)), self.sizes[rows, None] - 1)
        return self.values[self.starts[rows, None] + within].reshape(len(rows), *shape)


def _groups(counts: np.ndarray, fits: np.ndarray, most: int, *, pads: bool) -> Iterator[tuple[np.ndarray, int]]:
    """For each call of the solver, yield the rows and the number of pairs to which the rows are padded.

    If ``pads`` is true, problems of 16 or more pairs are padded by less than a quarter, to the next size in 16, 20, 24,
    28, 32, 40, 48, ... Other problems are not padded.
    """
    step = 2 ** (np.log2(counts.clip(_PADDED_FROM)).astype(int) - 2)
    widths = np.where((counts < _PADDED_FROM) | (not pads), counts, -(-counts // step) * step)
    for width in np.unique(widths[fits]):
        rows = np.flatnonzero(fits & (widths == width))
        for part in np.array_split(rows, min(len(rows), -(-len(rows) * width // most))):
            yield part, int(width)
