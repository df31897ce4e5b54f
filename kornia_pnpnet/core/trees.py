"""Functions that visit every tensor of nested tuples."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from torch import Tensor

_T = TypeVar("_T")


def map_tensors(function: Callable[..., Any], tree: _T, *others: _T) -> _T:
    """Apply a function to every tensor of nested tuples, named tuples and lists. Other values, such as ``None``, stay.

    ``others`` are trees of the same structure. The function receives one tensor from each tree.
    """
    if isinstance(tree, Tensor):
        return function(tree, *others)
    if not isinstance(tree, (tuple, list)):
        return tree
    parts = (map_tensors(function, *entries) for entries in zip(tree, *others, strict=True))
    return type(tree)(*parts) if hasattr(tree, "_fields") else type(tree)(parts)


def take(tree: _T, at: Tensor | slice) -> _T:
    """Select problems from every tensor of a tree, except from scalars."""
    return map_tensors(lambda x: x[at] if x.ndim else x, tree)


def pairs_at(tree: _T, at: Tensor) -> _T:
    """Select pairs by positions (B, K) from each tensor (B, N, ...) with N >= K. Other tensors do not change."""

    def pick(x: Tensor) -> Tensor:
        if x.ndim < 2 or x.shape[1] < at.shape[1]:
            return x
        # `take_along_dim` would fix the sizes of exported graphs.
        return x.gather(1, at.view(*at.shape, *(1,) * (x.ndim - 2)).expand(*at.shape, *x.shape[2:]))

    return map_tensors(pick, tree)


def put(tree: _T, at: Tensor, rows: _T) -> _T:
    """Return a copy of a tree in which the problems at the indices ``at`` are replaced by ``rows``."""
    return map_tensors(lambda x, new: x.index_copy(0, at, new), tree, rows)


def iter_tensors(tree: Any) -> Iterator[Tensor]:
    """Yield every tensor of nested tuples and lists in order, and skip all other values."""
    if isinstance(tree, Tensor):
        yield tree
    elif isinstance(tree, (tuple, list)):
        for entry in tree:
            yield from iter_tensors(entry)
