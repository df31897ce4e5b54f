"""Precision, compilation, memory layout, sorts. Times were measured with PyTorch 2.13 on one thread of an AMD EPYC."""

from __future__ import annotations

import os
import threading
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import wraps
from itertools import accumulate
from typing import Any, ParamSpec, TypeVar, cast

import torch
from torch import Tensor
from torch.autograd import forward_ad

from kornia_pnpnet.core.trees import iter_tensors, map_tensors

_T = TypeVar("_T")
_P = ParamSpec("_P")


# --- switches: which code may run -------------------------------------------------------------------------------------


#: Whether ``torch.compile`` or ``torch.export`` is tracing the code.
compiling = torch.compiler.is_compiling
#: Whether ``torch.export`` is tracing the code. ONNX lacks a stable sort, ``copysign`` and custom operations.
exporting = torch.compiler.is_exporting


def sees_values(*tensors: Tensor) -> bool:
    """Whether Python can read all values. Tracing, ``torch.func.vmap`` and the device ``meta`` prevent reading."""
    if compiling():
        return False
    functorch = torch._C._functorch
    for x in tensors:
        while functorch.is_functorch_wrapped_tensor(x):
            if functorch.is_batchedtensor(x):
                return False
            x = functorch.get_unwrapped(x)
        if x.device.type == "meta":
            return False
    return True


def in_full_precision(device: str) -> AbstractContextManager[Any]:
    """Return a context that disables autocast, except in an exported graph or on a device without autocast."""
    if exporting() or not torch.amp.is_autocast_available(device):
        return nullcontext()
    return torch.autocast(device, enabled=False)


def full_precision(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Disable autocast in a function, on the device of the first tensor among its arguments."""
    return _within(lambda x: in_full_precision("cpu" if x is None else x.device.type), function)


def _within(
    context: Callable[[Tensor | None], AbstractContextManager[Any]], function: Callable[_P, _T]
) -> Callable[_P, _T]:
    """Call a function in ``context(x)``, where x is the first tensor among its arguments (``None``: no tensor)."""

    @wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        with context(next(iter_tensors((*args, *kwargs.values())), None)):
            return function(*args, **kwargs)

    return run


def needs_graph(tensors: Iterable[Tensor]) -> bool:
    """Whether PyTorch must record or trace the operations on some tensors. If not, use :class:`torch.inference_mode`.

    In inference mode, a problem that is solved alone takes a sixth less time.
    """
    if compiling() or torch._C._functorch.peek_interpreter_stack() is not None or forward_ad._current_level >= 0:
        return True
    return torch.is_grad_enabled() and any(x.requires_grad for x in tensors)


def records(x: Tensor) -> bool:
    """Whether autograd records operations on a tensor, also outside of the transforms of ``torch.func``."""
    functorch = torch._C._functorch
    while not (compiling() or x.requires_grad) and functorch.is_functorch_wrapped_tensor(x):
        x = functorch.get_unwrapped(x)
    return x.requires_grad


_TURN = [threading.RLock()]
if hasattr(os, "register_at_fork"):  # the lock of a new process is free, even if a thread of its parent holds the lock
    os.register_at_fork(after_in_child=lambda: _TURN.__setitem__(0, threading.RLock()))


def in_turn(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Let threads call a function one after the other if its first tensor is small (see :func:`are_few`).

    Without turns, four threads wait for Python's lock at each operation, and take 2.5 times as long as one thread.
    """
    return _within(lambda x: nullcontext() if x is None or not are_few(x) else _TURN[0], function)


# Largest size of a small tensor. On a CPU, calling an operation on a small tensor takes longer than the arithmetic.
# For one 6×6 system, LAPACK takes 55 µs, and a loop over the entries takes 293 µs.
_FEW_NUMBERS = 4096


def are_few(x: Tensor) -> bool:
    """Whether the code is uncompiled and the tensor is small and on a CPU. If so, LAPACK replaces entrywise loops."""
    return not compiling() and x.device.type == "cpu" and x.numel() <= _FEW_NUMBERS


# --- memory layout ----------------------------------------------------------------------------------------------------


def problems_last(tree: _T) -> _T:
    """Lay out tensors (B, N, C), except small ones, as (C, N, B) in memory. Shapes and values do not change.

    This layout lets elementwise operations fill the vector registers of the CPU. With 9 pairs per problem, the layout
    halves the time of an iteration of the refinement.
    """
    return map_tensors(lambda x: x if x.ndim < 2 or are_few(x) else _last(x), tree)


def repeat_problems(tree: _T, count: int) -> _T:
    """Repeat the batch of each non-scalar tensor ``count`` times, in the memory layout of :func:`problems_last`."""

    def repeat(x: Tensor) -> Tensor:  # not `Tensor.repeat`, which compiles to one division per entry
        if are_few(x):
            return torch.cat((x,) * count)
        last = _reversed(x)[..., None, :]
        return _reversed(last.expand(*last.shape[:-2], count, -1).flatten(-2))

    return map_tensors(lambda x: repeat(x) if x.ndim else x, tree)


def kept_at_once(count: int, like: Tensor) -> int:
    """Number of items that are computed at once: ``count`` on a CPU, because of its caches, else 64 times ``count``."""
    return count if like.device.type == "cpu" else 64 * count


# Size of an intermediate result that stays in the cache of one core.
_CACHE_BYTES = 2**20


def in_cache(
    function: Callable[..., _T], tensors: Sequence[Tensor], numbers: int, *, split: int = 0, join: int = 0
) -> _T:
    """Call a function on parts of tensors, so that its intermediate results stay in the caches of a CPU's cores.

    The tensors are split along the dimension ``split``, and the results are joined along the dimension ``join``.
    ``numbers`` is the size of the largest intermediate result for one index of ``split``. Compiled code and other
    devices do not split. For 1000 problems of 20 pairs, the parts save a quarter of the time of ``pnpnet-set``, or
    a twentieth after :func:`keep_freed_memory`.
    """
    first = tensors[0]
    if compiling() or first.device.type != "cpu":
        return function(*tensors)
    size = max(1, _CACHE_BYTES * torch.get_num_threads() // max(1, numbers * first.element_size()))
    if first.shape[split] <= size:
        return function(*tensors)
    parts = zip(*(x.split(size, split) for x in tensors), strict=True)
    return map_tensors(lambda *x: torch.cat(x, join), *(function(*part) for part in parts))


def _last(x: Tensor) -> Tensor:
    last = _reversed(x)
    return x if last.is_contiguous() else _reversed(last.contiguous())


def _reversed(x: Tensor) -> Tensor:
    return x.permute(tuple(reversed(range(x.ndim))))


# Largest mmap threshold of glibc (32 MiB, see M_MMAP_THRESHOLD in mallopt(3)) minus room for an allocation's header.
_LARGEST_KEPT = 2**25 - 2**16


def keep_freed_memory() -> None:
    """Let glibc keep up to 64 MiB of freed memory for reuse, in the whole process.

    Without this call, glibc requests memory from the system for each tensor of more than 128 KiB, and large batches of
    ``pnpnet-set`` take 20 to 45 % longer. Only programs may call this function, because a library must not change the
    allocator of its process.
    """
    torch.empty(_LARGEST_KEPT, dtype=torch.uint8, device="cpu")  # freeing this tensor raises glibc's thresholds


# --- order ------------------------------------------------------------------------------------------------------------

# Up to this number of pairs, compiled code sorts by comparisons, which the compiler fuses to one loop. For 1000
# problems of 9 pairs, the loop takes 31 µs and `Tensor.sort` takes 65 µs. With two keys, the times are 60 and 200 µs.
_FEW_PAIRS = 12


def in_order(values: Tensor) -> Tensor:
    """Sort values (C, N, B) in ascending order along the second dimension. NaN is not allowed."""
    if _are_few_pairs(values):
        return torch.stack(_sorted_rows(values), 1)
    # For ONNX, a top-k of all values replaces the sort.
    return values.topk(values.shape[1], 1, largest=False).values if exporting() else values.sort(1).values


def ranked(values: Tensor, rank: Tensor | int) -> Tensor:
    """Find the value with a given rank along the second dimension of values (C, N, B) without NaN.

    ``rank`` is an integer, or a tensor (B,) in which a negative rank counts as 0. Rank 0 is the smallest value.
    """
    if isinstance(rank, int) and _are_few_pairs(values):
        return _sorted_rows(values)[rank]
    if isinstance(rank, int) and not exporting():  # ONNX has no `kthvalue`
        return values.kthvalue(rank + 1, 1).values
    rank = torch.as_tensor(rank, device=values.device).clamp(min=0).expand(values.shape[0], 1, values.shape[-1])
    return in_order(values).gather(1, rank)[:, 0]


def _are_few_pairs(values: Tensor) -> bool:
    return compiling() and isinstance(values.shape[1], int) and values.shape[1] <= _FEW_PAIRS


def _sorted_rows(values: Tensor) -> list[Tensor]:
    """Sort values (C, N, B) into rows (C, B) by odd-even transposition. A compiler removes unused comparisons."""
    rows = list(values.unbind(1))
    for i in range(len(rows)):
        for j in range(i % 2, len(rows) - 1, 2):
            rows[j], rows[j + 1] = torch.minimum(*rows[j : j + 2]), torch.maximum(*rows[j : j + 2])
    return rows


def present_first(present: Tensor) -> Tensor:
    """Find positions (B, N) that move present pairs before absent pairs and otherwise keep the order."""
    places = torch.arange(present.shape[1], device=present.device)
    # The keys are made unique, because PyTorch's top-k is not stable.
    return _ascending(torch.where(present, places, places + present.shape[1]))


def ascending_order(keys: Tensor) -> Tensor:
    """Find the positions (B, N) of the pairs in stable ascending order of two keys (2, N, B) without NaN."""
    if not exporting() and _are_few_pairs(keys):
        return _order_by_counting(*keys).mT
    first, second = keys.mT.contiguous()  # sorting another dimension takes twice the time
    by_second = _ascending(second)
    return by_second.gather(1, _ascending(first.gather(1, by_second)))


def _ascending(keys: Tensor) -> Tensor:
    """Find the indices that sort the last dimension stably in ascending order."""
    if exporting():  # ONNX has no stable sort, but its top-k is stable
        return keys.topk(keys.shape[-1], largest=False).indices
    return keys.argsort(stable=True, dim=-1)


def _order_by_counting(*keys: Tensor) -> Tensor:
    """Find the indices that sort stably in ascending order of keys (N, *). The first key has priority."""
    first = keys[0]
    position = torch.arange(first.shape[0], device=first.device).view(-1, *(1,) * (first.ndim - 1))
    before = position < position[:, None]  # entry (i, j): whether entry j precedes entry i
    for key in reversed(keys):
        before = (key < key[:, None]) | ((key == key[:, None]) & before)
    rank = before.sum(1)
    return torch.zeros_like(rank).scatter(0, rank, position.expand_as(rank))


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


# A compiler cannot fuse a custom operation with the operations that read its result. With a fused gather, compiled code
# takes a third longer for the hypotheses of the set network. `torch.library.Library` is used, because the first call of
# `torch.library.custom_op` imports 800 modules in 2 to 3 s.
_LIBRARY = torch.library.Library("kornia_pnpnet", "DEF")
_LIBRARY.define("take_pairs(Tensor values, Tensor index) -> Tensor")
_LIBRARY.impl("take_pairs", _take_pairs, "CompositeExplicitAutograd")


@torch.library.register_vmap("kornia_pnpnet::take_pairs", lib=_LIBRARY)  # type: ignore[untyped-decorator]
def _(info: Any, in_dims: tuple[int | None, int | None], *tensors: Tensor) -> tuple[Tensor, int]:
    taken = torch.ops.kornia_pnpnet.take_pairs(*fold_vmap(info.batch_size, in_dims, *tensors))
    return unfold_vmap(info.batch_size, taken), 2


def take_pairs(values: Tensor, index: Tensor) -> Tensor:
    """Take the pairs at positions (B, K) from values (B, N, C). The result has the shape (C, K, B)."""
    return (_take_pairs if exporting() else torch.ops.kornia_pnpnet.take_pairs)(values, index)


# --- compilation ------------------------------------------------------------------------------------------------------

# With at least this number of pairs, the CPU compiler of PyTorch 2.13 must not choose the order of loops. The chosen
# order may transpose blocks of 16 numbers. The transposed results are incorrect if N > B for N pairs and B problems.
# For fewer pairs, the compiler chooses the order, because a fixed order takes up to 50 % longer.
_MANY_PAIRS = 16


class Runner:
    """Calls functions of batches. The functions are uncompiled, or are compiled at their first call.

    A function takes tensors and nested tuples of tensors. The first dimension of each non-scalar tensor is the batch.
    A new batch size needs no new compilation, unless the old or new size is 1. PyTorch compiles again when the number
    of pairs or the dtype changes, and when gradients are switched on or off. If the compilation of a function fails,
    the runner warns once and then calls the function uncompiled. Compilation needs a C++ compiler and PyTorch 2.13.
    """

    def __init__(self, compiled: bool = False, mode: str | None = None) -> None:
        if compiled and torch.__version__ < "2.13":
            reason = f"Compilation needs PyTorch 2.13, got {torch.__version__}."
            warnings.warn(f"Not compiled, running uncompiled. {reason}", RuntimeWarning, stacklevel=3)
            compiled = False
        self.compiled, self.mode = compiled, mode
        self.failed: set[Callable[..., Any]] = set()  # functions whose compilation failed
        # Keys of `_functions`: the function, and whether problems have at least `_MANY_PAIRS` pairs.
        self._functions: dict[tuple[Callable[..., Any], bool], Callable[..., Any]] = {}
        self._seen: set[tuple[Any, ...]] = set()

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy or pickle without compiled code. Copies and other processes compile again."""
        return type(self), (self.compiled, self.mode)

    def __call__(self, function: Callable[..., _T], *args: Any) -> _T:
        """Call a function."""
        if not self.compiled or compiling() or function in self.failed:
            return function(*args)
        # Compiled code expects one memory layout, but the layout of uncompiled results depends on the batch size.
        args = map_tensors(_last, args)
        tensors = list(iter_tensors(args))
        first = tensors[0]
        many = first.ndim > 1 and first.shape[1] >= _MANY_PAIRS
        kind = function, first.shape, first.dtype, len(tensors), torch.is_grad_enabled()
        if kind in self._seen:
            with suppress(Exception):  # a warnings filter may turn a warning into an error: run again below
                return cast(_T, self._functions[function, many](*args))
        try:
            if (function, many) not in self._functions:
                self._functions[function, many] = self._compile(function, many)
            for tensor in tensors:
                if tensor.ndim and tensor.shape[0] > 1:
                    torch._dynamo.maybe_mark_dynamic(tensor, 0)
            with warnings.catch_warnings(action="ignore"):  # the compiler warns about its own code
                result: _T = self._functions[function, many](*args)
            self._seen.add(kind)
            return result
        except torch.cuda.OutOfMemoryError:
            raise
        except Exception as error:  # the compiler raises many types of errors
            result = function(*args)  # an invalid call raises its own error here
            self.failed.add(function)
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            warnings.warn(f"Not compiled, running uncompiled. {reason[:300]}", RuntimeWarning, stacklevel=3)
            return result

    def _compile(self, function: Callable[..., Any], many: bool) -> Callable[..., Any]:
        options = torch._inductor.list_mode_options(self.mode or "default") | {
            "cpp.vec_isa_ok": True,  # skip tests of instruction sets, which take half of the first compilation
            "cpp.enable_loop_tail_vec": False,  # shortens the compilation by a third, but not the calls
            "inplace_buffers": False,  # `True` gives incorrect gradients in PyTorch 2.13, see test_core_performance.py
            "guard_filter_fn": _needed_guards,
            **({"pick_loop_orders": False} if many else {}),
        }
        # Each number of pairs and each dtype needs two compilations, with and without gradients. `recompile_limit`
        # applies to each function separately.
        limits: dict[str, Any] = {"recompile_limit": 64, "isolate_recompiles": True}
        run = torch.compile(function, fullgraph=True, options=options, **limits)
        if not options.get("triton.cudagraphs"):
            return run
        # Return copies of the results: the next replay of the CUDA graph overwrites the originals.
        return lambda *args: map_tensors(torch.clone, run(*args))


def _needed_guards(guards: Sequence[Any]) -> list[bool]:
    """Skip the guards of global functions and constants, which never change. Each guard takes time at each call."""
    return [guard.guard_type == "DUPLICATE_INPUT" or not guard.is_global for guard in guards]


#: The runner that calls all functions uncompiled.
EAGER = Runner()


def per_problem(scalar: Tensor, like: Tensor) -> Tensor:
    """In compiled code on a CPU, expand a scalar to the shape of ``like``, so that its gradient is summed in float64.

    For a sum in float32, the CPU compiler of PyTorch 2.13 compiles again when the batch size crosses a limit.
    """
    if scalar.ndim or not compiling() or exporting() or like.device.type != "cpu":
        return scalar
    return scalar.double().expand(like.shape).to(like.dtype)


def package_options(pairs: int | None, *, on_stack: bool) -> dict[str, Any]:
    """Make the options of AOTInductor for a number of pairs; ``None`` means any number.

    With ``on_stack``, tensors stay on the stack if the graph calls no operator of PyTorch. In this case, every
    call in a thread returns the same tensors with new values.
    """
    return {
        "aot_inductor.allow_stack_allocation": on_stack,
        "cpp.vec_isa_ok": True,  # see `Runner`
        "cpp.threads": 1,  # the default is the number of threads of the compiling process
        "pick_loop_orders": pairs is not None and pairs < _MANY_PAIRS,
    }


# --- packages of one problem: sorts, running sums and products as elementwise operations ------------------------------
# A compiler fuses elementwise operations, and calls PyTorch for all other operations. AOTInductor keeps the tensors of
# a graph on the stack if the graph never calls PyTorch. On the stack, a package of `pnpnet-n9` for one problem takes 42
# instead of 297 µs.

# Largest size of an inline sort or cumulative sum. For larger sizes, the graph calls PyTorch, because an inline sort
# compares each number with all others.
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
    return torch.stack([*accumulate(x.to(total or x.dtype).unbind(dim), torch.add)], dim)


def _topk(x: Tensor, k: int, dim: int = -1, largest: bool = True, ordered: bool = True) -> Any:
    if x.shape[dim] > _FEW_INLINE:
        return NotImplemented
    rows = x.movedim(dim, 0)
    index = _order_by_counting(-rows if largest else rows)[:k]
    return rows.gather(0, index).movedim(0, dim), index.movedim(0, dim)


def _sort(x: Tensor, dim: int = -1, descending: bool = False, *, stable: bool | None = None) -> Any:
    return _topk(x, x.shape[dim], dim, descending)


def _argsort(x: Tensor, dim: int = -1, descending: bool = False) -> Any:
    return x.sort(dim, descending)[1]


_aten = torch.ops.aten
#: Decompositions for ``ExportedProgram.run_decompositions`` of a graph with static sizes.
INLINE: dict[Any, Callable[..., Any]] = {
    **dict.fromkeys((_aten.addmm.default, _aten.baddbmm.default), _addmm),
    _aten.argsort.default: _argsort,
    _aten.cumsum.default: _cumsum,
    _aten.linear.default: _linear,
    **dict.fromkeys((_aten.bmm.default, _aten.matmul.default, _aten.mm.default), _matmul),
    **dict.fromkeys((_aten.sort.default, _aten.sort.stable), _sort),
    _aten.topk.default: _topk,
}
