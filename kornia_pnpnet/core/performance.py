"""What exists only to be fast: switches, memory layouts, order, compilation, one operation, the allocator's setting.

Nothing here changes a result. Each part says what it buys; times are of PyTorch 2.13 on one thread of an AMD EPYC.
"""

from __future__ import annotations

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


# --- switches: what may be done here ----------------------------------------------------------------------------------


def compiling() -> bool:
    """Whether ``torch.compile`` or ``torch.export`` traces: loops over chunks would break the graph."""
    return torch.compiler.is_compiling()


def exporting() -> bool:
    """Whether ``torch.export`` traces: ONNX has no stable sort, no ``copysign`` and none of our custom operations."""
    return torch.compiler.is_exporting()


def sees_values(x: Tensor) -> bool:
    """Whether code may depend on values: not in graphs, in ``torch.func.vmap`` and on the device meta."""
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


# Numbers. Up to here an operation on a processor takes about as long as its call.
_FEW_NUMBERS = 4096


def are_few(x: Tensor) -> bool:
    """Whether calls, not arithmetic, take the time of operations on a tensor: uncompiled, on a CPU, and small.

    LAPACK then replaces loops over entries: 55 instead of 293 µs for one 6 by 6 system, 104 instead of 400 µs for one
    nearest rotation.
    """
    return not compiling() and x.device.type == "cpu" and x.numel() <= _FEW_NUMBERS


# --- memory layout ----------------------------------------------------------------------------------------------------


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


# Bytes. glibc raises its threshold up to 32 MiB (mallopt(3), M_MMAP_THRESHOLD); 64 KiB are left for its header.
_LARGEST_KEPT = 2**25 - 2**16


def keep_freed_memory() -> None:
    """Let glibc keep the memory of large temporaries for the next call, for the whole process.

    Otherwise every call asks the system anew for each tensor of more than 128 KiB: batches of 1000 and more problems on
    a CPU take 20 to 45 % longer with ``pnpnet-set``. The process then holds up to 64 MiB of freed memory. Other
    allocators, and a glibc whose thresholds were set, stay as they are. Only the command ``pnpnet`` and the benchmarks
    call this function: a library must not decide for its process.

    Example:
        >>> keep_freed_memory()
    """
    torch.empty(_LARGEST_KEPT, dtype=torch.uint8, device="cpu")  # freed at once, and never touched


# --- order ------------------------------------------------------------------------------------------------------------

# Pairs. Up to this number a compiled function sorts by minima and maxima, which become one loop: 31 µs for 9 values of
# 1000 problems, where the call of a sort takes 65 µs. Uncompiled, the calls of the minima take longer than a sort.
_FEW_PAIRS = 12
# Problems. From this number on, one sort of integers takes two thirds of the time of two sorts of floats.
_MANY_PROBLEMS = 256


def in_order(values: Tensor) -> Tensor:
    """Sort values without NaN, (C, N, B), along the second dimension.

    Example:
        >>> in_order(torch.tensor([[[3.0], [1.0], [2.0]]])).flatten()
        tensor([1., 2., 3.])
    """
    if _in_network(values):
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
    if isinstance(rank, int) and _in_network(values):
        return _through_network(values, rank)[rank]
    if isinstance(rank, int) and not exporting():  # ONNX has no k-th value
        return values.kthvalue(rank + 1, 1).values
    rank = torch.as_tensor(rank, device=values.device).clamp(min=0).expand(values.shape[0], 1, values.shape[-1])
    return in_order(values).gather(1, rank)[:, 0]


def _in_network(values: Tensor) -> bool:
    """Whether a network of minima and maxima sorts values (C, N, B): a compiler calls PyTorch for any other sort."""
    return compiling() and isinstance(values.shape[1], int) and values.shape[1] <= _FEW_PAIRS


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
    """Positions of the pairs that are present (B, N), then of the others, each in order.

    Example:
        >>> present_first(torch.tensor([[False, True, True]]))
        tensor([[1, 2, 0]])
    """
    places = torch.arange(present.shape[1], device=present.device)
    return _ascending(torch.where(present, places, places + len(places)))  # no ties: PyTorch's top-k is not stable


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
    if compiling() and not exporting() and keys.shape[1] <= _FEW_PAIRS:
        return _order_by_counting(*keys)
    if keys.dtype == torch.float32 and not compiling() and keys.shape[2] >= _MANY_PROBLEMS:
        # Both keys as one integer. Adding 0 turns -0 into 0.
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


def _order_by_counting(first: Tensor, second: Tensor) -> Tensor:
    """:func:`ascending_order` by the number of pairs that come before each pair: for a compiler one loop, no call.

    For 9 pairs of 1000 problems it takes 60 µs; the sorts take 200 µs.
    """
    position = torch.arange(len(first), device=first.device)
    before = (position < position[:, None])[..., None]  # (N, N, 1): is the second before the first?
    for key in (second, first):
        before = (key < key[:, None]) | ((key == key[:, None]) & before)
    rank = before.sum(1)  # (N, B)
    return torch.zeros_like(rank).scatter(0, rank, position[:, None].expand_as(rank)).mT


# --- a custom operation -----------------------------------------------------------------------------------------------


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


# --- compilation ------------------------------------------------------------------------------------------------------

# Pairs. From this number on, the loop order that the CPU compiler of PyTorch 2.13 chooses can give incorrect results
# where a problem has more pairs than the batch has problems (it transposes vectors of 16 numbers). The given order is
# then kept, which takes up to half as long again.
_MANY_PAIRS = 16


class Compiled:
    """A function of batches that is compiled when it is first called.

    The first dimension of its tensors, the batch, may change without a new compilation, except to or from a batch of
    one. Other sizes, dtypes, and whether gradients are recorded are compiled for anew. When compilation fails, for
    example without a C++ compiler or before PyTorch 2.13, the function runs uncompiled after one warning.

    Args:
        function: takes tensors and nested tuples of tensors. The first dimension of each tensor that has one is the
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
        """Copies and other processes compile for themselves."""
        return type(self), (self.function, self.mode)

    @cached_property
    def _compiled(self) -> tuple[Callable[..., Any], Callable[..., Any]]:
        """The compiled function for few and for many pairs."""
        # `vec_isa_ok` skips asking the C++ compiler for each instruction set: half of the first compilation. Loops end
        # with single numbers, not with a second vector loop: a third less to compile, and calls take the same time.
        options = {**torch._inductor.list_mode_options(self.mode or "default"), "cpp.vec_isa_ok": True}
        options.update({"cpp.enable_loop_tail_vec": False, "guard_filter_fn": _needs_check})
        # Each solver counts its own compilations: numbers of pairs, dtypes, with and without gradients.
        limits: dict[str, Any] = {"recompile_limit": 64, "isolate_recompiles": True}
        few, many = (
            torch.compile(self.function, fullgraph=True, options={**options, **order}, **limits)
            for order in ({}, {"pick_loop_orders": False})
        )

        def copied(run: Callable[..., Any]) -> Callable[..., Any]:
            return lambda *args: map_tensors(torch.clone, run(*args))

        # The next replay of a CUDA graph overwrites the results of the last one.
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
            with suppress(Exception):  # recompiling may warn, and warnings may be errors here: try again without them
                return self._compiled[many](*args)
        try:
            for tensor in tensors:
                if tensor.ndim and tensor.shape[0] > 1:
                    torch._dynamo.maybe_mark_dynamic(tensor, 0)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # warnings of the compiler about itself
                result = self._compiled[many](*args)
            self._seen.add(kind)
            return result
        except torch.cuda.OutOfMemoryError:
            raise
        except Exception as error:  # the compiler's are of many types
            result = self.function(*args)  # a mistake of the caller raises here as it would anywhere
            self.failed = True
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            warnings.warn(f"Not compiled, running uncompiled. {reason[:300]}", RuntimeWarning, stacklevel=3)
            return result


class Runner:
    """Calls functions as they are, or compiled: what may be compiled is visible where it is called.

    Args:
        compiled: whether functions are compiled when they are first called.
        mode: mode of ``torch.compile``.

    Example:
        >>> Runner()(torch.add, torch.ones(1), torch.ones(1))
        tensor([2.])
    """

    def __init__(self, compiled: bool = False, mode: str | None = None) -> None:
        self.compiled, self.mode = compiled, mode
        self._functions: dict[str, Compiled] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and other processes compile for themselves."""
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
        """Whether some function could not be compiled."""
        return any(x.failed for x in self._functions.values())


#: Runs everything uncompiled.
EAGER = Runner()


def _needs_check(guards: Sequence[Any]) -> list[bool]:
    """Skip checks of functions and constants of modules, which do not change: they take time at each call."""
    return [guard.guard_type == "DUPLICATE_INPUT" or not guard.is_global for guard in guards]


def per_problem(scalar: Tensor, like: Tensor) -> Tensor:
    """Expand a scalar to the shape of ``like`` in compiled code, so that its gradient is summed in float64.

    A sum in float32 is compiled anew when the number of addends, which grows with the batch, crosses a limit of the CPU
    compiler of PyTorch 2.13.
    """
    if scalar.ndim or not compiling() or exporting() or like.device.type != "cpu":
        return scalar
    return scalar.double().expand(like.shape).to(like.dtype)


def package_options(pairs: int | None, *, on_stack: bool) -> dict[str, Any]:
    """Options of AOTInductor.

    Args:
        pairs: number of pairs of a problem; ``None``: any number.
        on_stack: keep tensors on the stack where the graph calls no operator of PyTorch. Compiled functions then return
            the same tensors from each call in a thread.
    """
    return {
        "aot_inductor.allow_stack_allocation": on_stack,
        "cpp.vec_isa_ok": True,  # see Compiled
        "cpp.threads": 1,  # else the number of threads of the process that compiles
        "pick_loop_orders": pairs is not None and pairs < _MANY_PAIRS,
    }


# --- packages of one problem: sorts, running sums and products as elementwise operations ------------------------------
# A compiler fuses elementwise operations and calls PyTorch for all others. AOTInductor keeps the tensors of a graph
# without calls on the stack; otherwise most of the time of one problem goes into allocating small tensors. A package of
# `pnpnet-n9` for one problem takes 42 µs with INLINE and 297 µs without.

# Numbers. The comparisons of a sort grow with the square of their number.
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
    """Sort by the number of entries that come before each entry: stable, for values that are not NaN."""
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
#: Decompositions for ``ExportedProgram.run_decompositions``. Sizes that are not static or too large stay as they are.
INLINE: dict[Any, Callable[..., Any]] = {
    _aten.addmm.default: _addmm,
    _aten.cumsum.default: _cumsum,
    _aten.linear.default: _linear,
    **dict.fromkeys((_aten.bmm.default, _aten.matmul.default, _aten.mm.default), _matmul),
    **dict.fromkeys((_aten.sort.default, _aten.sort.stable), _sort),
    _aten.topk.default: _topk,
}
