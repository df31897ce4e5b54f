"""Nested tuples of tensors, visited as a whole: no code lists their fields by position."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from torch import Tensor

__all__ = ["iter_tensors", "map_tensors", "put", "take"]

_T = TypeVar("_T")


def map_tensors(function: Callable[..., Any], tree: _T, *others: _T) -> _T:
    """Apply a function to every tensor of nested tuples.

    Args:
        function: receives the tensors at the same place of all trees.
        tree: a tensor, or a (named) tuple or list of trees. Everything else, such as ``None``, stays as it is.
        others: more trees of the same structure.

    Returns:
        A tree of the same types that holds what the function returned.

    Example:
        >>> import torch
        >>> map_tensors(torch.add, (torch.ones(2), None), (torch.ones(2), None))
        (tensor([2., 2.]), None)
    """
    if isinstance(tree, Tensor):
        return function(tree, *others)
    if not isinstance(tree, (tuple, list)):
        return tree
    parts = (map_tensors(function, *entries) for entries in zip(tree, *others, strict=True))
    return type(tree)(*parts) if hasattr(tree, "_fields") else type(tree)(parts)


def take(tree: _T, at: Tensor | slice) -> _T:
    """Select problems from every tensor of a tree that has a batch."""
    return map_tensors(lambda x: x[at] if x.ndim else x, tree)


def put(tree: _T, at: Tensor, rows: _T) -> _T:
    """Replace the problems at some indices in every tensor of a tree."""
    return map_tensors(lambda x, new: x.index_copy(0, at, new), tree, rows)


def iter_tensors(tree: Any) -> Iterator[Tensor]:
    """Yield every tensor of nested tuples and lists, in order; anything else is passed over."""
    if isinstance(tree, Tensor):
        yield tree
    elif isinstance(tree, (tuple, list)):
        for entry in tree:
            yield from iter_tensors(entry)
