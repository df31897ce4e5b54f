"""Functions that are compiled when they are first called, and options of the compilers of PyTorch."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Generic, ParamSpec, TypeVar

import torch
from torch import Tensor

from kornia_pnpnet.core.performance import compiling, exporting
from kornia_pnpnet.core.trees import iter_tensors, map_tensors

__all__ = ["Compiled", "Runner", "package_options", "per_problem"]

_P = ParamSpec("_P")
_T = TypeVar("_T")

# Each solver counts its own compilations: numbers of pairs, dtypes, with and without gradients. PyTorch before 2.13
# cannot: there all solvers count together.
_LIMITS: dict[str, Any] = {"recompile_limit": 64, "isolate_recompiles": True}
_LIMITS = _LIMITS if "isolate_recompiles" in inspect.signature(torch.compile).parameters else {}

# Pairs. From this number on, the loop order that the CPU compiler of PyTorch 2.13 chooses can give incorrect results
# where a problem has more pairs than the batch has problems (it transposes vectors of 16 numbers). The given order is
# then kept, which takes up to half as long again.
_MANY_PAIRS = 16


class Compiled(Generic[_P, _T]):
    """A function of batches that is compiled when it is first called.

    The first dimension of its tensors, the batch, may change without a new compilation, except to or from a batch of
    one. Other sizes, dtypes, and whether gradients are recorded are compiled for anew. When compilation fails, for
    example without a C++ compiler, the function runs uncompiled after one warning.

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

    def __init__(self, function: Callable[_P, _T], mode: str | None = None) -> None:
        self.function = function
        self.mode = mode
        # `vec_isa_ok` skips asking the C++ compiler for each instruction set: half of the first compilation. Loops end
        # with single numbers, not with a second vector loop: a third less to compile, and calls take the same time.
        options = {**torch._inductor.list_mode_options(mode or "default"), "cpp.vec_isa_ok": True}
        options.update({"cpp.enable_loop_tail_vec": False, "guard_filter_fn": _needs_check})
        target = function if _LIMITS else self._leaves
        self._compiled = [
            torch.compile(target, fullgraph=True, options=one, **_LIMITS)
            for one in (options, {**options, "pick_loop_orders": False})
        ]
        self.failed = False
        self._seen: set[tuple[torch.Size, torch.dtype, int, bool]] = set()
        self._like: dict[Any, _T] = {}
        # The next replay of a CUDA graph overwrites the results of the last one.
        self._copies = bool(options.get("triton.cudagraphs"))

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and other processes compile for themselves."""
        return type(self), (self.function, self.mode)

    def __call__(self, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        """Call the function."""
        if self.failed or compiling():
            return self.function(*args, **kwargs)
        tensors = list(iter_tensors(args))
        first = tensors[0]
        kind = first.shape, first.dtype, len(tensors), torch.is_grad_enabled()
        compiled = self._compiled[first.ndim > 1 and first.shape[1] >= _MANY_PAIRS]
        if kind in self._seen:
            with suppress(Exception):  # recompiling may warn, and warnings may be errors here: try again without them
                return self._run(compiled, *args, **kwargs)
        try:
            for tensor in tensors:
                if tensor.ndim and tensor.shape[0] > 1:
                    torch._dynamo.maybe_mark_dynamic(tensor, 0)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # warnings of the compiler about itself
                result = self._run(compiled, *args, **kwargs)
            self._seen.add(kind)
            return result
        except torch.cuda.OutOfMemoryError:
            raise
        except Exception as error:  # the compiler's are of many types
            result = self.function(*args, **kwargs)  # a mistake of the caller raises here as it would anywhere
            self.failed = True
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            warnings.warn(f"Not compiled, running uncompiled. {reason[:300]}", RuntimeWarning, stacklevel=3)
            return result

    def _run(self, compiled: Callable[..., Any], *args: _P.args, **kwargs: _P.kwargs) -> _T:
        """Call the compiled function. A compiler before PyTorch 2.13 returns tensors: some named tuples it cannot."""
        if _LIMITS:
            result = compiled(*args, **kwargs)
        else:
            key = torch.is_grad_enabled(), _kinds((args, *kwargs.items()))
            if key not in self._like:
                self._like[key] = map_tensors(lambda x: x.new_empty(()), self.function(*args, **kwargs))
            with torch._dynamo.config.patch(cache_size_limit=64):  # all share the code of `_leaves`
                leaves = iter(compiled(*args, **kwargs))
            result = map_tensors(lambda _: next(leaves), self._like[key])
        return map_tensors(torch.clone, result) if self._copies else result

    def _leaves(self, *args: _P.args, **kwargs: _P.kwargs) -> list[Tensor]:
        return list(iter_tensors(self.function(*args, **kwargs)))


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
        self._functions: dict[str, Compiled[..., Any]] = {}

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
        return self._functions[name](*args)

    @property
    def failed(self) -> bool:
        """Whether some function could not be compiled."""
        return any(x.failed for x in self._functions.values())


#: Runs everything uncompiled.
EAGER = Runner()


def _kinds(x: Any) -> Any:
    """Nested tuples with the type of each tensor in its place."""
    return tuple(map(_kinds, x)) if isinstance(x, (tuple, list)) else type(x) if isinstance(x, Tensor) else x


def per_problem(scalar: Tensor, like: Tensor) -> Tensor:
    """Expand a scalar to the shape of ``like`` in compiled code, so that its gradient is summed in float64.

    A sum in float32 is compiled anew when the number of addends, which grows with the batch, crosses a limit of the CPU
    compiler of PyTorch 2.13.
    """
    if scalar.ndim or not compiling() or exporting() or like.device.type != "cpu":
        return scalar
    return scalar.double().expand(like.shape).to(like.dtype)


def _needs_check(guards: Sequence[Any]) -> list[bool]:
    """Skip checks of functions and constants of modules, which do not change: they take time at each call."""
    return [guard.guard_type == "DUPLICATE_INPUT" or not guard.is_global for guard in guards]


def package_options(pairs: int | None, *, on_stack: bool) -> dict[str, Any]:
    """Options of AOTInductor.

    Args:
        pairs: number of pairs of a problem; ``None``: any number.
        on_stack: keep tensors on the stack where the graph calls no operator of PyTorch. Compiled functions then return
            the same tensors from each call in a thread.

    Example:
        >>> package_options(9, on_stack=False)["cpp.threads"]
        1
    """
    return {
        "aot_inductor.allow_stack_allocation": on_stack,
        "cpp.vec_isa_ok": True,  # see Compiled
        "cpp.threads": 1,  # else the number of threads of the process that compiles
        "pick_loop_orders": pairs is not None and pairs < _MANY_PAIRS,
    }
