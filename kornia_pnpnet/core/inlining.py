"""Sorts, running sums and matrix products as elementwise operations, for compiled solvers of one problem.

A compiler fuses elementwise operations and calls PyTorch for all others. AOTInductor keeps the tensors of a graph
without calls on the stack; otherwise most of the time of one problem goes into allocating small tensors. A package of
``pnpnet-n9`` for one problem takes 42 µs with :data:`INLINE` and 297 µs without.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

__all__ = ["INLINE"]

# Numbers. The comparisons of a sort grow with the square of their number.
_FEW = 32


def _matmul(a: Tensor, b: Tensor) -> Any:
    if a.ndim < 2 or b.ndim < 2:
        return NotImplemented
    return (a[..., None] * b[..., None, :, :]).sum(-2)


def _addmm(bias: Tensor, a: Tensor, b: Tensor, *, beta: float = 1, alpha: float = 1) -> Tensor:
    return beta * bias + alpha * _matmul(a, b)


def _linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    product = (x[..., None, :] * weight).sum(-1)
    return product if bias is None else product + bias


def _cumsum(x: Tensor, dim: int, *, dtype: torch.dtype | None = None) -> Any:
    if x.shape[dim] > _FEW:
        return NotImplemented
    total = torch.int64 if dtype is None and not x.is_floating_point() else dtype
    rows = list(x.to(total or x.dtype).unbind(dim))
    for i in range(1, len(rows)):
        rows[i] = rows[i] + rows[i - 1]
    return torch.stack(rows, dim)


def _topk(x: Tensor, k: int, dim: int = -1, largest: bool = True, ordered: bool = True) -> Any:
    """Sort by the number of entries that come before each entry: stable, for values that are not NaN."""
    if x.shape[dim] > _FEW:
        return NotImplemented
    values = x.movedim(dim, -1)
    positions = torch.arange(x.shape[dim], device=x.device)
    one, other = values[..., :, None], values[..., None, :]
    precedes = other > one if largest else other < one
    rank = (precedes | ((other == one) & (positions < positions[:, None]))).sum(-1)
    index = ((rank[..., None, :] == positions[:k, None]) * positions).sum(-1)
    return values.gather(-1, index).movedim(-1, dim), index.movedim(-1, dim)


def _sort(x: Tensor, dim: int = -1, descending: bool = False, *, stable: bool | None = None) -> Any:
    return _topk(x, x.shape[dim], dim, descending)


_aten = torch.ops.aten
#: Decompositions for ``ExportedProgram.run_decompositions``. Sizes that are not static or too large stay as they are.
INLINE: dict[Any, Callable[..., Any]] = {
    _aten.addmm.default: _addmm,
    _aten.bmm.default: _matmul,
    _aten.cumsum.default: _cumsum,
    _aten.linear.default: _linear,
    _aten.matmul.default: _matmul,
    _aten.mm.default: _matmul,
    _aten.sort.default: _sort,
    _aten.sort.stable: _sort,
    _aten.topk.default: _topk,
}
