"""Compiling parts of a solver with ``torch.compile``, and going on without where that is not possible."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Generic, ParamSpec, TypeVar

import torch

from kornia_pnpnet.core.trees import iter_tensors

__all__ = ["Compiled"]

# A solver of its own counts how often it was compiled: for other numbers of pairs, dtypes, with and without gradients.
_LIMITS: dict[str, Any] = {"recompile_limit": 64, "isolate_recompiles": True}

# Of so many pairs on, the compiler of PyTorch 2.13 for CPUs may order loops so that what it computes is wrong, where a
# problem has more pairs than the batch has problems: it must then keep to the order that it is given, which takes up to
# half as long again. Vectors of 16 numbers, which it transposes, are what goes wrong.
_MANY = 16

_P = ParamSpec("_P")
_T = TypeVar("_T")


class Compiled(Generic[_P, _T]):
    r"""A function of batches that is compiled when it is first called.

    The first dimension of its tensors, the batch, may change without a new compilation (a batch of one is compiled for
    itself); other sizes, dtypes, and whether gradients are recorded may not. Where it cannot be compiled, for want of
    a C++ compiler or because the function does something a compiler cannot follow, it runs as it is, with one warning.

    Args:
        function: of tensors and nested tuples of them, whose first dimension is the batch in all that have one.
        mode: of ``torch.compile``.

    Example:
        >>> double = Compiled(lambda x: 2 * x)
        >>> double.function(torch.ones(2))
        tensor([2., 2.])
    """

    def __init__(self, function: Callable[_P, _T], mode: str | None = None) -> None:
        self.function = function
        self.mode = mode
        # Else half of the first compilation would go into asking the C++ compiler which instructions it knows, for each
        # set of them that the processor has.
        options = {**torch._inductor.list_mode_options(mode or "default"), "cpp.vec_isa_ok": True}
        options["guard_filter_fn"] = _worth_checking
        few, many = (
            torch.compile(function, fullgraph=True, options=more, **_LIMITS)
            for more in (options, {**options, "pick_loop_orders": False})
        )
        self._compiled = {False: few, True: many}
        self._failed = False
        self._seen: set[tuple[torch.Size, torch.dtype, bool]] = set()

    def __reduce__(self) -> tuple[type[Compiled[_P, _T]], tuple[Callable[_P, _T], str | None]]:
        """What was compiled stays behind when a solver is copied or sent to another process."""
        return type(self), (self.function, self.mode)

    def __call__(self, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        """Call the function."""
        if self._failed or torch.compiler.is_compiling():
            return self.function(*args, **kwargs)
        first = next(iter_tensors(args))
        kind = first.shape, first.dtype, torch.is_grad_enabled()
        compiled = self._compiled[first.ndim > 1 and first.shape[1] >= _MANY]
        errors = torch._dynamo.exc.TorchDynamoException, torch._inductor.exc.InductorError
        if kind in self._seen:
            with suppress(*errors):  # recompiling may warn, and warnings may be errors here: try again without them
                return compiled(*args, **kwargs)
        try:
            for tensor in iter_tensors(args):
                if tensor.ndim and tensor.shape[0] > 1:
                    torch._dynamo.maybe_mark_dynamic(tensor, 0)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # what a compiler says of its own parts
                result = compiled(*args, **kwargs)
            self._seen.add(kind)
            return result
        except errors as error:
            result = self.function(*args, **kwargs)  # a mistake of the caller raises here as it would anywhere
            self._failed = True
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            warnings.warn(f"Not compiled, running as it is. {reason[:300]}", RuntimeWarning, stacklevel=3)
            return result


def _worth_checking(guards: Sequence[Any]) -> list[bool]:
    """Functions and constants of modules do not change, and asking for all of them at each call takes time."""
    return [guard.guard_type == "DUPLICATE_INPUT" or not guard.is_global for guard in guards]
