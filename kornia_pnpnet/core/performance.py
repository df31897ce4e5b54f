"""Code for speed: switches, memory layouts, sorting, a custom operation, compilation, and memory of the process.

This module changes the speed of computations, not their results. All times were measured with PyTorch 2.13 on one
thread of an AMD EPYC.
"""

from __future__ import annotations

import os
import threading
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import cache, cached_property
from typing import Any, TypeVar

import torch
from torch import Tensor

from kornia_pnpnet.core.trees import iter_tensors, map_tensors

__all__ = [
    "EAGER",
    "INLINE",
    "Compiled",
    "Runner",
    "are_few",
    "ascending_order",
    "compiling",
    "exporting",
    "fold_vmap",
    "in_full_precision",
    "in_order",
    "in_turn",
    "keep_freed_memory",
    "package_options",
    "per_problem",
    "present_first",
    "problems_last",
    "ranked",
    "repeat_problems",
    "sees_values",
    "take_pairs",
    "unfold_vmap",
]

_T = TypeVar("_T")


# --- switches: which code may run -------------------------------------------------------------------------------------


def compiling() -> bool:
    """Whether ``torch.compile`` or ``torch.export`` is tracing the code."""
    return torch.compiler.is_compiling()


def exporting() -> bool:
    """Whether ``torch.export`` is tracing the code. ONNX lacks a stable sort, ``copysign`` and custom operations."""
    return torch.compiler.is_exporting()


def sees_values(x: Tensor) -> bool:
    """Whether Python code may read values. Tracing, ``torch.func.vmap`` and the device ``meta`` forbid reading."""
    if compiling():
        return False
    functorch = torch._C._functorch
    while functorch.is_functorch_wrapped_tensor(x):
        if functorch.is_batchedtensor(x):
            return False
        x = functorch.get_unwrapped(x)
    return x.device.type != "meta"


def in_full_precision(device: str) -> AbstractContextManager[Any]:
    """Return a context that disables autocast, except in an exported graph or on a device without autocast."""
    if exporting() or not torch.amp.is_autocast_available(device):
        return nullcontext()
    return torch.autocast(device, enabled=False)


_TURN = [threading.RLock()]
if hasattr(os, "register_at_fork"):  # the lock of a new process is free, even if a thread of its parent holds the lock
    os.register_at_fork(after_in_child=lambda: _TURN.__setitem__(0, threading.RLock()))


def in_turn(x: Tensor) -> AbstractContextManager[Any]:
    """Return a context in which threads run one after the other, if ``x`` has few numbers (see :func:`are_few`).

    Every operation on few numbers releases Python's lock and waits for it again. Four threads that wait for each other
    at every operation are together two and a half times slower than one thread.
    """
    return _TURN[0] if are_few(x) else nullcontext()


# Numbers. For fewer numbers on a CPU, the call of an operation takes longer than its arithmetic.
_FEW_NUMBERS = 4096


def are_few(x: Tensor) -> bool:
    """Whether the code is uncompiled and the tensor is small and on a CPU. Calls then take longer than arithmetic.

    For such tensors LAPACK replaces loops over entries. One 6×6 system then takes 55 instead of 293 µs. One nearest
    rotation takes 104 instead of 400 µs.
    """
    return not compiling() and x.device.type == "cpu" and x.numel() <= _FEW_NUMBERS


# --- memory layout ----------------------------------------------------------------------------------------------------


def problems_last(tree: _T) -> _T:
    """Lay out tensors (B, N, C) as (C, N, B) in memory. Shapes and values do not change.

    Elementwise operations then fill the vector registers of the CPU even if each problem has few pairs. With 9 pairs
    per problem, this layout halves the time of an iteration of the refinement.
    """
    return map_tensors(lambda x: _reversed(_reversed(x).contiguous()) if x.ndim > 1 else x, tree)


def repeat_problems(tree: _T, count: int) -> _T:
    """Repeat the batch of each non-scalar tensor ``count`` times, in the memory layout of :func:`problems_last`."""

    def repeat(x: Tensor) -> Tensor:  # `Tensor.repeat` compiles to one division per entry
        last = _reversed(x)[..., None, :]
        return _reversed(last.expand(*last.shape[:-2], count, -1).flatten(-2))

    return map_tensors(lambda x: repeat(x) if x.ndim else x, tree)


def _reversed(x: Tensor) -> Tensor:
    return x.permute(tuple(reversed(range(x.ndim))))


# Bytes. The largest mmap threshold of glibc, 32 MiB (mallopt(3), M_MMAP_THRESHOLD), minus 64 KiB for the header of the
# allocation.
_LARGEST_KEPT = 2**25 - 2**16


def keep_freed_memory() -> None:
    """Let glibc keep freed memory of large tensors for reuse, in the whole process.

    By default glibc requests memory from the system for each tensor of more than 128 KiB. With ``pnpnet-set`` on a CPU,
    batches of at least 1000 problems then take 20 to 45 % longer than after this call. After this call the process
    holds up to 64 MiB of freed memory. The call has no effect on other allocators, or if the thresholds of glibc were
    set explicitly. Only the command ``pnpnet`` and the benchmarks call this function: a library must not change the
    allocator of its process.

    Example:
        >>> keep_freed_memory()
    """
    torch.empty(_LARGEST_KEPT, dtype=torch.uint8, device="cpu")  # freed at once; its pages are never written


# --- order ------------------------------------------------------------------------------------------------------------

# Pairs. Up to this number of pairs, compiled code uses a sorting network, which compiles to one loop. To sort 9 values
# in each of 1000 problems, the network takes 31 µs, and `Tensor.sort` takes 65 µs. Uncompiled code calls `Tensor.sort`,
# because the many calls of a network take longer.
_FEW_PAIRS = 12
# Problems. For larger batches, one sort of integers takes two thirds of the time of two sorts of floats.
_MANY_PROBLEMS = 256


def in_order(values: Tensor) -> Tensor:
    """Sort values (C, N, B) in ascending order along the second dimension. NaN is not allowed.

    Example:
        >>> in_order(torch.tensor([[[3.0], [1.0], [2.0]]])).flatten()
        tensor([1., 2., 3.])
    """
    if _in_network(values):
        return torch.stack(_through_network(values, None), 1)
    # For ONNX, a top-k of all values replaces the sort.
    return values.topk(values.shape[1], 1, largest=False).values if exporting() else values.sort(1).values


def ranked(values: Tensor, rank: Tensor | int) -> Tensor:
    """Find the value with a given rank along the second dimension.

    Args:
        values: no NaN, shape :math:`(C, N, B)`.
        rank: an integer, or a tensor of shape :math:`(B,)` in which a negative rank counts as 0. Rank 0 is the smallest
            value.

    Returns:
        Shape :math:`(C, B)`.

    Example:
        >>> ranked(torch.tensor([[[3.0], [1.0], [2.0]]]), 1)
        tensor([[2.]])
    """
    if isinstance(rank, int) and _in_network(values):
        return _through_network(values, rank)[rank]
    if isinstance(rank, int) and not exporting():  # ONNX has no `kthvalue`
        return values.kthvalue(rank + 1, 1).values
    rank = torch.as_tensor(rank, device=values.device).clamp(min=0).expand(values.shape[0], 1, values.shape[-1])
    return in_order(values).gather(1, rank)[:, 0]


def _in_network(values: Tensor) -> bool:
    """Whether :func:`_network` sorts values (C, N, B), which needs compiled code and few pairs."""
    return compiling() and isinstance(values.shape[1], int) and values.shape[1] <= _FEW_PAIRS


def _through_network(values: Tensor, rank: int | None) -> list[Tensor]:
    """Sort values (C, N, B) into rows (C, B). With a rank, only the row of this rank is correct."""
    rows = list(values.unbind(1))
    for i, j, smaller, larger in _network(len(rows), rank):
        a, b = rows[i], rows[j]
        rows[i], rows[j] = torch.minimum(a, b) if smaller else a, torch.maximum(a, b) if larger else b
    return rows


@cache
def _network(count: int, rank: int | None) -> list[tuple[int, int, bool, bool]]:
    """Comparators of a sorting network: two positions, and whether their minimum and their maximum are needed.

    With a rank, only the comparators that are needed for the number with this rank are returned. Source: D. Knuth, "The
    Art of Computer Programming", volume 3, algorithm 5.2.2M (Batcher's merge exchange).
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
    """Find positions (B, N) that move present pairs before absent pairs, without any other change of order.

    Example:
        >>> present_first(torch.tensor([[False, True, True]]))
        tensor([[1, 2, 0]])
    """
    places = torch.arange(present.shape[1], device=present.device)
    # The keys are unique, because PyTorch's top-k is not stable.
    return _ascending(torch.where(present, places, places + present.shape[1]))


def ascending_order(keys: Tensor) -> Tensor:
    """Find the stable ascending order by the first of two keys. The second key orders equal first keys.

    Args:
        keys: no NaN, shape :math:`(2, N, B)`.

    Returns:
        Positions, int64, shape :math:`(B, N)`.

    Example:
        >>> ascending_order(torch.tensor([[[3.0], [1.0], [1.0]], [[0.0], [5.0], [4.0]]]))
        tensor([[2, 1, 0]])
    """
    if compiling() and not exporting() and keys.shape[1] <= _FEW_PAIRS:
        return _order_by_counting(*keys)
    if keys.dtype == torch.float32 and not compiling() and keys.shape[2] >= _MANY_PROBLEMS:
        # Combine both keys into one integer. Adding 0 turns -0 into 0.
        bits = (keys + 0.0).mT.contiguous().view(torch.int32)
        first, second = (bits ^ (bits >> 31 & 0x7FFFFFFF)).long()  # integers in the order of the floats
        return _ascending((first << 32) + second)
    first, second = keys.mT.contiguous()  # sorting the last dimension takes half the time
    by_second = _ascending(second)
    return by_second.gather(1, _ascending(first.gather(1, by_second)))


def _ascending(keys: Tensor) -> Tensor:
    """The stable ascending order along the last dimension."""
    if exporting():  # ONNX has no stable sort, but its top-k is stable
        return keys.topk(keys.shape[-1], largest=False).indices
    return keys.argsort(stable=True, dim=-1)


def _order_by_counting(first: Tensor, second: Tensor) -> Tensor:
    """Compute :func:`ascending_order` by counting the pairs that precede each pair. The count compiles to one loop.

    For 1000 problems of 9 pairs, counting takes 60 µs, and sorting takes 200 µs.
    """
    position = torch.arange(len(first), device=first.device)
    before = (position < position[:, None])[..., None]  # (N, N, 1); entry (i, j): whether pair j precedes pair i
    for key in (second, first):
        before = (key < key[:, None]) | ((key == key[:, None]) & before)
    rank = before.sum(1)  # (N, B)
    return torch.zeros_like(rank).scatter(0, rank, position[:, None].expand_as(rank)).mT


# --- a custom operation -----------------------------------------------------------------------------------------------


def fold_vmap(size: int, in_dims: Sequence[int | None], *tensors: Tensor) -> list[Tensor]:
    """Merge the vmapped dimension of each tensor with the batch, which is the first dimension."""
    pairs = zip(tensors, in_dims, strict=True)
    return [(x.expand(size, *x.shape) if dim is None else x.movedim(dim, 0)).flatten(0, 1) for x, dim in pairs]


def unfold_vmap(size: int, result: Tensor) -> Tensor:
    """Undo :func:`fold_vmap`: split the last dimension of a result into the vmapped dimension and the batch."""
    return result.unflatten(-1, (size, -1))


def _take_pairs(values: Tensor, index: Tensor) -> Tensor:
    return values.permute(2, 1, 0).gather(1, index.mT.expand(values.shape[-1], -1, -1))


# A compiler does not fuse a custom operation with the operations that read its result. With a fused gather, the
# compiled hypotheses of the set network take a third longer. `torch.library.Library` is used because the first call of
# `torch.library.custom_op` imports 800 modules in 2 to 3 s.
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
    """Take the pairs at positions (B, K) from values (B, N, C). The result has the shape (C, K, B)."""
    return (_take_pairs if exporting() else torch.ops.kornia_pnpnet.take_pairs)(values, index)


# --- compilation ------------------------------------------------------------------------------------------------------

# Pairs. For at least this number of pairs, the CPU compiler of PyTorch 2.13 must not choose the order of loops. A
# chosen order can transpose blocks of 16 numbers. The results are then incorrect if a problem has more pairs than the
# batch has problems. Without this choice, compiled code takes up to 50 % longer.
_MANY_PAIRS = 16


class Compiled:
    """A function of batches that is compiled at its first call.

    The batch size may change without a new compilation, except to or from 1. PyTorch compiles again when the number of
    pairs or the dtype changes, and when gradients are switched on or off. If compilation fails, the function warns once
    and then runs uncompiled. Compilation fails without a C++ compiler and before PyTorch 2.13.

    Args:
        function: takes tensors and nested tuples of tensors. The first dimension of each non-scalar tensor is the
            batch.
        mode: mode of ``torch.compile``.

    Attributes:
        failed: whether compilation has failed.

    Example:
        >>> double = Compiled(lambda x: 2 * x)
        >>> double.function(torch.ones(2))
        tensor([2., 2.])
    """

    def __init__(self, function: Callable[..., Any], mode: str | None = None) -> None:
        self.function, self.mode = function, mode
        self.failed = False
        self._seen: set[tuple[torch.Size, torch.dtype, int, bool]] = set()

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy or pickle without compiled code. Copies and other processes compile again."""
        return type(self), (self.function, self.mode)

    @cached_property
    def _compiled(self) -> tuple[Callable[..., Any], Callable[..., Any]]:
        """The compiled functions for problems with fewer than ``_MANY_PAIRS`` pairs and for all other problems."""
        # `vec_isa_ok` skips tests of the C++ compiler for each instruction set. These tests take half of the time of
        # the first compilation. Without `enable_loop_tail_vec` a loop ends with scalar code instead of a second vector
        # loop. Compilation then takes a third less time, and calls take the same time.
        options = {**torch._inductor.list_mode_options(self.mode or "default"), "cpp.vec_isa_ok": True}
        options.update({"cpp.enable_loop_tail_vec": False, "guard_filter_fn": _needs_check})
        # Each number of pairs and each dtype needs two compilations, with and without gradients. The limit applies to
        # each solver separately.
        limits: dict[str, Any] = {"recompile_limit": 64, "isolate_recompiles": True}
        few, many = (
            torch.compile(self.function, fullgraph=True, options={**options, **order}, **limits)
            for order in ({}, {"pick_loop_orders": False})
        )

        def copied(run: Callable[..., Any]) -> Callable[..., Any]:
            return lambda *args: map_tensors(torch.clone, run(*args))

        # The results are copied, because the next replay of the CUDA graph overwrites them.
        return (copied(few), copied(many)) if options.get("triton.cudagraphs") else (few, many)

    def __call__(self, *args: Any) -> Any:
        """Call the function."""
        if self.failed or compiling():
            return self.function(*args)
        tensors = list(iter_tensors(args))
        first = tensors[0]
        kind = first.shape, first.dtype, len(tensors), torch.is_grad_enabled()
        many = first.ndim > 1 and first.shape[1] >= _MANY_PAIRS
        if kind in self._seen:
            with suppress(Exception):  # may be a warning raised as an error: try again below, without warnings
                return self._compiled[many](*args)
        try:
            for tensor in tensors:
                if tensor.ndim and tensor.shape[0] > 1:
                    torch._dynamo.maybe_mark_dynamic(tensor, 0)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the compiler warns about its own code
                result = self._compiled[many](*args)
            self._seen.add(kind)
            return result
        except torch.cuda.OutOfMemoryError:
            raise
        except Exception as error:  # the compiler raises many types of errors
            result = self.function(*args)  # an invalid call raises its own error here
            self.failed = True
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            warnings.warn(f"Not compiled, running uncompiled. {reason[:300]}", RuntimeWarning, stacklevel=3)
            return result


class Runner:
    """Calls functions, compiled or uncompiled. Code that may be compiled is called through a runner.

    Args:
        compiled: whether to compile each function at its first call.
        mode: mode of ``torch.compile``.

    Example:
        >>> Runner()(torch.add, torch.ones(1), torch.ones(1))
        tensor([2.])
    """

    def __init__(self, compiled: bool = False, mode: str | None = None) -> None:
        self.compiled, self.mode = compiled, mode
        self._functions: dict[str, Compiled] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy or pickle without compiled code. Copies and other processes compile again."""
        return type(self), (self.compiled, self.mode)

    def __call__(self, function: Callable[..., _T], *args: Any) -> _T:
        """Call a function of batches."""
        if not self.compiled:
            return function(*args)
        name = function.__qualname__
        if name not in self._functions:
            self._functions[name] = Compiled(function, self.mode)
        result: _T = self._functions[name](*args)
        return result

    @property
    def failed(self) -> bool:
        """Whether the compilation of any function has failed."""
        return any(x.failed for x in self._functions.values())


#: The runner that calls all functions uncompiled.
EAGER = Runner()


def _needs_check(guards: Sequence[Any]) -> list[bool]:
    """Skip the guards of global functions and constants, which never change. Each guard takes time at each call."""
    return [guard.guard_type == "DUPLICATE_INPUT" or not guard.is_global for guard in guards]


def per_problem(scalar: Tensor, like: Tensor) -> Tensor:
    """In compiled code on a CPU, expand a scalar to the shape of ``like``, so that its gradient is summed in float64.

    The gradient of the scalar is a sum over the batch. For a sum in float32, the CPU compiler of PyTorch 2.13 compiles
    again when the batch size crosses a limit.
    """
    if scalar.ndim or not compiling() or exporting() or like.device.type != "cpu":
        return scalar
    return scalar.double().expand(like.shape).to(like.dtype)


def package_options(pairs: int | None, *, on_stack: bool) -> dict[str, Any]:
    """Make the options of AOTInductor.

    Args:
        pairs: number of pairs of a problem; ``None``: any number.
        on_stack: keep tensors on the stack if the graph calls no operator of PyTorch. Every call in a thread then
            returns the same tensors, with new values.
    """
    return {
        "aot_inductor.allow_stack_allocation": on_stack,
        "cpp.vec_isa_ok": True,  # see `Compiled`
        "cpp.threads": 1,  # the default is the number of threads of the compiling process
        "pick_loop_orders": pairs is not None and pairs < _MANY_PAIRS,
    }


# --- packages of one problem: sorts, running sums and products as elementwise operations ------------------------------
# A compiler fuses elementwise operations, and calls PyTorch for all other operations. AOTInductor keeps the tensors of
# a graph on the stack if the graph never calls PyTorch. Otherwise the allocation of small tensors takes most of the
# time of one problem. A package of `pnpnet-n9` for one problem takes 42 µs with INLINE and 297 µs without INLINE.

# Numbers. Longer sorts and cumulative sums remain calls of PyTorch. An inline sort compares all pairs of its numbers.
_FEW_INLINE = 32


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
    if x.shape[dim] > _FEW_INLINE:
        return NotImplemented
    total = torch.int64 if dtype is None and not x.is_floating_point() else dtype
    rows = list(x.to(total or x.dtype).unbind(dim))
    for i in range(1, len(rows)):
        rows[i] = rows[i] + rows[i - 1]
    return torch.stack(rows, dim)


def _topk(x: Tensor, k: int, dim: int = -1, largest: bool = True, ordered: bool = True) -> Any:
    """Stable top-k by counting the entries that precede each entry, for values without NaN."""
    if x.shape[dim] > _FEW_INLINE:
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
#: Decompositions for ``ExportedProgram.run_decompositions`` of a graph with static sizes.
INLINE: dict[Any, Callable[..., Any]] = {
    _aten.addmm.default: _addmm,
    _aten.cumsum.default: _cumsum,
    _aten.linear.default: _linear,
    **dict.fromkeys((_aten.bmm.default, _aten.matmul.default, _aten.mm.default), _matmul),
    **dict.fromkeys((_aten.sort.default, _aten.sort.stable), _sort),
    _aten.topk.default: _topk,
}
