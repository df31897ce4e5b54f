"""Count scalar operations by running the code."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from kornia_pnpnet.evaluation.operations.costs import Operations, cholesky, matmul, smallest, solve, sort

__all__ = ["OperationCounter", "count_per_problem"]

_NOTHING, _ADD, _MULTIPLY, _DIVIDE = Operations(), Operations(add=1), Operations(multiply=1), Operations(divide=1)
_SQRT, _EXP, _LOG = Operations(sqrt=1), Operations(exp=1), Operations(log=1)
_COMPARE, _LOGIC = Operations(compare=1), Operations(logic=1)


def _each(names: str, operations: Operations) -> dict[str, Operations]:
    return dict.fromkeys(names.split(), operations)


# Operations for each entry of the result. The first rows only create, move or view data, change signs or draw random
# numbers, which costs nothing.
_ELEMENTWISE: dict[str, Operations] = {
    **_each("_to_copy _unsafe_view alias arange cat clone constant_pad_nd copy detach diag_embed", _NOTHING),
    **_each("diagonal empty empty_like expand eye fill flip full full_like gather index index_put", _NOTHING),
    **_each("index_select lift_fresh masked_select neg new_empty new_full new_ones new_zeros nonzero", _NOTHING),
    **_each("ones ones_like permute promote_types rand randperm repeat scalar_tensor scatter select", _NOTHING),
    **_each("slice split split_with_sizes squeeze stack t take_pairs transpose unbind unsqueeze view zero", _NOTHING),
    **_each("zeros zeros_like", _NOTHING),
    **_each("add rsub sub", _ADD),
    **_each("mul", _MULTIPLY),
    **_each("div floor_divide reciprocal", _DIVIDE),
    **_each("sqrt", _SQRT),
    **_each("rsqrt", _SQRT + _DIVIDE),
    **_each("exp expm1", _EXP),
    **_each("acos atan2 cos lgamma log log1p sin tanh", _LOG),
    **_each("sigmoid", _EXP + _ADD + _DIVIDE),
    **_each("addcmul", _MULTIPLY + _ADD),
    **_each("lerp", 2 * _ADD + _MULTIPLY),
    **_each("linalg_cross", _ADD + 2 * _MULTIPLY),
    **_each("ceil clamp_min eq ge gt le lt maximum minimum ne relu", _COMPARE),
    **_each("abs copysign sgn sign", 2 * _COMPARE),
    **_each("bitwise_and bitwise_not bitwise_or masked_fill where", _LOGIC),
}

# Operations for each input entry of a reduction, except for the first entry of each result.
_REDUCTIONS: dict[str, Operations] = {
    **_each("cumsum sum", _ADD),
    **_each("prod", _MULTIPLY),
    **_each("amax amin argmax argmin max min", _COMPARE),
    **_each("all any", _LOGIC),
}

# Operations for one row, by its length.
_ROWS: dict[str, Callable[[int], Operations]] = {
    "linalg_vector_norm": lambda length: Operations(add=length - 1, multiply=length, sqrt=1),
    # Subtract the maximum, divide the exponentials by their sum.
    "_softmax": lambda length: Operations(add=2 * length - 1, divide=length, exp=length, compare=length - 1),
    # Subtract the mean, divide by the root of variance plus epsilon, apply weight and bias.
    "native_layer_norm": lambda length: Operations(add=4 * length - 1, multiply=3 * length, divide=3, sqrt=1),
}

# Operations for one matrix of the batch, by the shapes of the input matrices.
_MATRIX: dict[str, Callable[..., Operations]] = {
    "mm": lambda first, second: matmul(first[0], first[1], second[1]),
    "bmm": lambda first, second: matmul(first[0], first[1], second[1]),
    "addmm": lambda bias, first, second: matmul(first[0], first[1], second[1]) + first[0] * second[1] * _ADD,
    "linalg_cholesky_ex": lambda matrix: cholesky(matrix[0]),
    "linalg_inv_ex": lambda matrix: solve(matrix[0], matrix[0]),
}


def _power(exponent: Any) -> Operations:
    """Cost of a power (``flops_pow``): products and a root for a multiple of 1/2, else exponential and logarithm."""
    if isinstance(exponent, Tensor) or not float(2 * exponent).is_integer():
        return _EXP + _LOG + _MULTIPLY
    whole, half = divmod(abs(exponent), 1)
    products = int(whole).bit_length() + int(whole).bit_count() - 2 if whole else 0
    root = (_SQRT + min(whole, 1) * _MULTIPLY) if half else _NOTHING
    return products * _MULTIPLY + root + (_DIVIDE if exponent < 0 else _NOTHING)


def _operations(name: str, call: dict[str, Any], output: Any) -> Operations:
    """Operations of one call of the PyTorch operation ``aten.<name>`` with the given arguments and output."""
    result = output[0] if isinstance(output, tuple | list) else output
    if name in _ELEMENTWISE:
        cost = _ELEMENTWISE[name]
        scaled = name in ("add", "sub", "addcmul") and call.get("alpha", call.get("value", 1)) not in (1, -1)
        return _NOTHING if cost is _NOTHING else result.numel() * (cost + _MULTIPLY if scaled else cost)
    if name == "pow":
        return result.numel() * _power(call["exponent"])
    if name == "clamp":
        return result.numel() * sum(call[bound] is not None for bound in ("min", "max")) * _COMPARE
    if name in _MATRIX:
        tensors = [value for value in call.values() if isinstance(value, Tensor)]
        return math.prod(result.shape[:-2]) * _MATRIX[name](*(tensor.shape[-2:] for tensor in tensors))
    if name in _REDUCTIONS:
        entries = call["self"].numel()
        results = entries // call["self"].shape[call["dim"]] if name == "cumsum" else result.numel()
        return (entries - results) * _REDUCTIONS[name]
    if name in _ROWS:
        entries, length = _rows(call)
        return entries // length * _ROWS[name](length)
    if name in ("sort", "topk"):
        length = call["self"].shape[call["dim"]]
        rows = call["self"].numel() // max(length, 1)
        if name == "sort":
            return rows * sort(length)
        return rows * (smallest(length, call["k"]) + (sort(call["k"]) if call["sorted"] else _NOTHING))
    raise NotImplementedError(f"The cost of aten.{name} is unknown. Add the cost to {__name__}.")


def _rows(call: dict[str, Any]) -> tuple[int, int]:
    """Number of input entries of an operation on rows, and the length of one row."""
    tensor = next(value for value in call.values() if isinstance(value, Tensor))
    if "normalized_shape" in call:
        return tensor.numel(), math.prod(call["normalized_shape"])
    dims = call["dim"] if isinstance(call["dim"], list | tuple) else [call["dim"]]
    return tensor.numel(), math.prod(tensor.shape[dim] for dim in dims)


class OperationCounter(TorchDispatchMode):
    """Count the operations of the tensor code that runs inside a ``with`` block.

    Attributes:
        operations: the :class:`Operations` so far.

    Raises:
        NotImplementedError: for a PyTorch operation whose cost is unknown, so that no operation is missed.

    Example:
        >>> with OperationCounter() as counter:
        ...     product = torch.ones(4, 2, 3) @ torch.ones(4, 3, 5)
        >>> counter.operations.multiply, counter.operations.add
        (120, 80)
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.operations = Operations()

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Run one operation and add its cost."""
        output = func(*args, **(kwargs or {}))
        names = [argument.name for argument in func._schema.arguments]
        call = {argument.name: argument.default_value for argument in func._schema.arguments}
        call |= dict(zip(names, args, strict=False)) | (kwargs or {})
        self.operations += _operations(func.overloadpacket.__name__.rstrip("_"), call, output)
        return output


def count_per_problem(run: Callable[[int], object], batch: int = 2) -> Operations:
    """Count the operations that each further problem of a batch costs.

    The count is the difference between a run of ``2 * batch`` and a run of ``batch`` problems, divided by ``batch``.
    Operations that a batch executes once for all problems cancel out.

    Args:
        run: solves a batch of the given size.
        batch: number of problems in the smaller run.

    Returns:
        The operations for one problem.

    Example:
        >>> count_per_problem(lambda batch: torch.ones(batch, 5).sum(-1) * torch.ones(3).sum()).add
        4.0
    """
    counts = []
    for size in (batch, 2 * batch):
        with torch.no_grad(), OperationCounter() as counter:
            run(size)
        counts.append(counter.operations)
    small, large = counts
    return 1 / batch * (large + -1 * small)
