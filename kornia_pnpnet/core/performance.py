"""What exists only to be fast: memory layouts, order, one custom operation, the allocator's setting.

Nothing here changes a result. Each part says what it buys; times are of PyTorch 2.13 on one thread of an AMD EPYC.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Any, TypeVar

import torch
from torch import Tensor

from kornia_pnpnet.core.trees import map_tensors

__all__ = [
    "are_few",
    "ascending_order",
    "compiling",
    "exporting",
    "fold_vmap",
    "in_full_precision",
    "in_order",
    "keep_freed_memory",
    "present_first",
    "problems_last",
    "ranked",
    "repeat_problems",
    "sees_values",
    "take_pairs",
    "unfold_vmap",
]

_T = TypeVar("_T")


def compiling() -> bool:
    """Whether ``torch.compile`` or ``torch.export`` traces: loops over chunks would break the graph."""
    return torch.compiler.is_compiling()


def exporting() -> bool:
    """Whether ``torch.export`` traces: ONNX has no stable sort, no ``copysign`` and none of our custom operations."""
    return torch.compiler.is_exporting()


def sees_values(x: Tensor) -> bool:
    """Whether what happens next may depend on values: not in graphs, in ``torch.func.vmap`` and on the device meta."""
    if compiling():
        return False
    functorch = torch._C._functorch
    while functorch.is_functorch_wrapped_tensor(x):
        if functorch.is_batchedtensor(x):
            return False
        x = functorch.get_unwrapped(x)
    return x.device.type != "meta"


def in_full_precision(device: str) -> AbstractContextManager[Any]:
    """Disable autocast on devices that have it; ``meta`` does not. In a graph for other programs it has no meaning."""
    if exporting() or not torch.amp.is_autocast_available(device):
        return nullcontext()
    return torch.autocast(device, enabled=False)


# Numbers. Up to here an operation on a processor takes about as long as its call, so that few operations that repeat
# work take less time than many operations.
_FEW_NUMBERS = 4096


def are_few(x: Tensor) -> bool:
    """Whether calls, not arithmetic, take the time of operations on a tensor: uncompiled, on a CPU, and small."""
    return not compiling() and x.device.type == "cpu" and x.numel() <= _FEW_NUMBERS


def problems_last(tree: _T) -> _T:
    """Lay out tensors (B, N, C) as (C, N, B) in memory; shapes and values stay.

    Elementwise operations then run at full width however few pairs a problem has, and a compiler can keep a problem in
    registers: half the time of an iteration at n = 9.
    """
    return map_tensors(lambda x: _reversed(_reversed(x).contiguous()) if x.ndim > 1 else x, tree)


def repeat_problems(tree: _T, count: int) -> _T:
    """Repeat the batch of every tensor that has one, problems last in memory."""

    def repeat(x: Tensor) -> Tensor:  # `Tensor.repeat` compiles to a division for the index of each entry
        last = _reversed(x)[..., None, :]
        return _reversed(last.expand(*last.shape[:-2], count, -1).flatten(-2))

    return map_tensors(lambda x: repeat(x) if x.ndim else x, tree)


def _reversed(x: Tensor) -> Tensor:
    return x.permute(tuple(reversed(range(x.ndim))))


# Pairs. Up to this number, compiled and uncompiled, a network of minima and maxima replaces a sort, which waits for
# mispredicted branches: a third of the time for 9 points of 1000 problems.
_FEW_COMPILED, _FEW = 12, 32
# Problems. From this number on, calls of many small operations take less time uncompiled than a call of one sort.
_MANY_PROBLEMS = 256


def in_order(values: Tensor) -> Tensor:
    """Sort values without NaN, (C, N, B), along the second dimension.

    Example:
        >>> in_order(torch.tensor([[[3.0], [1.0], [2.0]]])).flatten()
        tensor([1., 2., 3.])
    """
    if _are_few(values):
        return torch.stack(_through_network(values, None), 1)
    # ONNX sorts by a top-k.
    return values.topk(values.shape[1], 1, largest=False).values if exporting() else values.sort(1).values


def ranked(values: Tensor, rank: Tensor | int) -> Tensor:
    """Find the value of a rank, along the second dimension.

    Args:
        values: no NaN, shape :math:`(C, N, B)`.
        rank: 0 for the smallest value, shape :math:`(B,)`. A negative rank means 0.

    Returns:
        Shape :math:`(C, B)`.

    Example:
        >>> ranked(torch.tensor([[[3.0], [1.0], [2.0]]]), 1)
        tensor([[2.]])
    """
    if isinstance(rank, int) and _are_few(values):
        return _through_network(values, rank)[rank]
    if isinstance(rank, int) and not exporting():  # ONNX has no k-th value
        return values.kthvalue(rank + 1, 1).values
    rank = torch.as_tensor(rank, device=values.device).clamp(min=0).expand(values.shape[0], 1, values.shape[-1])
    return in_order(values).gather(1, rank)[:, 0]


def _are_few(values: Tensor) -> bool:
    """Whether a network takes less time than a sort of values (C, N, B)."""
    count = values.shape[1]
    if compiling():
        return isinstance(count, int) and count <= _FEW_COMPILED
    return count <= _FEW and values.shape[2] >= _MANY_PROBLEMS and values.device.type == "cpu"


def _through_network(values: Tensor, rank: int | None) -> list[Tensor]:
    """The rows (C, B) of values (C, N, B) in ascending order, or with the one of a rank at its place."""
    rows = list(values.unbind(1))
    for i, j, smaller, larger in _network(len(rows), rank):
        a, b = rows[i], rows[j]
        rows[i], rows[j] = torch.minimum(a, b) if smaller else a, torch.maximum(a, b) if larger else b
    return rows


@cache
def _network(count: int, rank: int | None) -> list[tuple[int, int, bool, bool]]:
    """Comparisons that sort numbers, or find one: two positions, and whether their minimum and maximum are needed.

    Source: D. Knuth, "The Art of Computer Programming", volume 3, algorithm 5.2.2M (Batcher's merge exchange).
    """
    pairs = []
    step = largest = 1 << max(count - 1, 1).bit_length() - 1
    while step:
        distance, other, parity = step, largest, 0
        while distance:
            pairs += [(i, i + distance) for i in range(count - distance) if i & step == parity]
            distance, other, parity = other - step, other // 2, step
        step //= 2
    wanted = set(range(count)) if rank is None else {rank}
    network = []
    for i, j in reversed(pairs):
        if i in wanted or j in wanted:
            network.append((i, j, i in wanted, j in wanted))
            wanted |= {i, j}
    return network[::-1]


def present_first(present: Tensor) -> Tensor:
    """Positions of the pairs that are present (B, N), then of the others, each in order: a stable sort, but faster.

    Example:
        >>> present_first(torch.tensor([[False, True, True]]))
        tensor([[1, 2, 0]])
    """
    rank = torch.where(present, present.cumsum(-1), present.sum(-1, keepdim=True) + (~present).cumsum(-1)) - 1
    order = torch.arange(present.shape[1], device=present.device).expand_as(rank)
    return torch.empty_like(rank).scatter_(1, rank, order)


def ascending_order(keys: Tensor) -> Tensor:
    """Find the stable ascending order by the first of two keys, ties by the second key.

    Args:
        keys: no NaN, shape :math:`(2, N, B)`.

    Returns:
        Positions, int64, shape :math:`(B, N)`.

    Example:
        >>> ascending_order(torch.tensor([[[3.0], [1.0], [1.0]], [[0.0], [5.0], [4.0]]]))
        tensor([[2, 1, 0]])
    """
    count = keys.shape[1]
    if compiling() and not exporting() and count <= _FEW_COMPILED:
        return _order_by_counting(keys)
    if keys.dtype == torch.float32 and not compiling() and keys.shape[2] >= _MANY_PROBLEMS:
        # Both keys as one integer, and a single sort: two thirds of the time. Adding 0 turns -0 into 0.
        bits = (keys + 0.0).mT.contiguous().view(torch.int32)
        first, second = (bits ^ (bits >> 31 & 0x7FFFFFFF)).long()  # integers in the order of the floats
        return _ascending((first << 32) + second)
    first, second = keys.mT.contiguous()  # sorting along the last dimension is twice as fast
    by_second = _ascending(second)
    return by_second.gather(1, _ascending(first.gather(1, by_second)))


def _ascending(keys: Tensor) -> Tensor:
    """Stable ascending order along the last dimension."""
    if exporting():  # ONNX has no stable sort, but its top-k is stable
        return keys.topk(keys.shape[-1], largest=False).indices
    return keys.argsort(stable=True, dim=-1)


def _order_by_counting(keys: Tensor) -> Tensor:
    """:func:`ascending_order` by the number of pairs that come before each pair, which a compiler makes one loop."""
    count, batch = keys.shape[1:]
    first, second = (key.unbind() for key in keys)
    rank = [torch.full_like(first[0], i, dtype=torch.int32) for i in range(count)]
    for j in range(count):
        for i in range(j):
            later = (first[j] < first[i]) | ((first[j] == first[i]) & (second[j] < second[i]))
            rank[i], rank[j] = rank[i] + later, rank[j] - later.int()
    positions = torch.arange(count, device=keys.device)[:, None].expand(count, batch)
    return torch.zeros_like(positions).scatter(0, torch.stack(rank).long(), positions).mT


def fold_vmap(size: int, in_dims: Sequence[int | None], *tensors: Tensor) -> list[Tensor]:
    """Make the dimension that ``torch.func.vmap`` maps a part of the batch, which is the first dimension."""
    pairs = zip(tensors, in_dims, strict=True)
    return [(x.expand(size, *x.shape) if dim is None else x.movedim(dim, 0)).flatten(0, 1) for x, dim in pairs]


def unfold_vmap(size: int, result: Tensor) -> Tensor:
    """Undo :func:`fold_vmap` for a result whose batch is the last dimension: the mapped dimension comes before it."""
    return result.unflatten(-1, (size, -1))


def _take_pairs(values: Tensor, index: Tensor) -> Tensor:
    return values.permute(2, 1, 0).gather(1, index.mT.expand(values.shape[-1], -1, -1))


# Compilers do not look inside: fused into its readers, each would gather anew, and the compiled hypotheses of the set
# network take a third longer. The first call of `torch.library.custom_op` would import 800 modules, for 2 to 3 s.
_LIBRARY = torch.library.Library("kornia_pnpnet", "DEF")
_LIBRARY.define("take_pairs(Tensor values, Tensor index) -> Tensor")
_LIBRARY.impl("take_pairs", _take_pairs, "CompositeExplicitAutograd")


@torch.library.register_fake("kornia_pnpnet::take_pairs", lib=_LIBRARY)  # type: ignore[untyped-decorator]
def _(values: Tensor, index: Tensor) -> Tensor:
    return values.new_empty(values.shape[-1], index.shape[1], index.shape[0])


@torch.library.register_vmap("kornia_pnpnet::take_pairs", lib=_LIBRARY)  # type: ignore[untyped-decorator]
def _(info: Any, in_dims: tuple[int | None, int | None], *tensors: Tensor) -> tuple[Tensor, int]:
    taken = torch.ops.kornia_pnpnet.take_pairs(*fold_vmap(info.batch_size, in_dims, *tensors))
    return unfold_vmap(info.batch_size, taken), 2


def take_pairs(values: Tensor, index: Tensor) -> Tensor:
    """Take the pairs at positions (B, K) from values (B, N, C): shape (C, K, B)."""
    return (_take_pairs if exporting() else torch.ops.kornia_pnpnet.take_pairs)(values, index)


# Bytes. glibc raises its threshold up to 32 MiB (mallopt(3), M_MMAP_THRESHOLD); 64 KiB are left for its header.
_LARGEST_KEPT = 2**25 - 2**16


def keep_freed_memory() -> None:
    """Let glibc keep the memory of large temporaries for the next call, for the whole process.

    Else every call asks the system anew for each tensor of more than 128 KiB: batches of 1000 and more problems on a
    CPU take 20 to 45 % longer with ``pnpnet-set``. The process then holds up to 64 MiB of freed memory. Other
    allocators, and a glibc whose thresholds were set, stay as they are. Only the command ``pnpnet`` and the benchmarks
    call this function: a library must not decide for its process.

    Example:
        >>> keep_freed_memory()
    """
    torch.empty(_LARGEST_KEPT, dtype=torch.uint8, device="cpu")  # freed at once, and never touched
