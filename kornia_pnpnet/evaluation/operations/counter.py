"""Count scalar operations by running the code."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from kornia_pnpnet.evaluation.operations.costs import (
    ADD,
    COMPARE,
    DIVIDE,
    EXP,
    LOG,
    LOGIC,
    MULTIPLY,
    SQRT,
    cholesky,
    matmul,
    smallest,
    solve,
    sort,
)

__all__ = ["OperationCounter", "count_per_problem"]


def _each(names: str, cost: float) -> dict[str, float]:
    return dict.fromkeys(names.split(), cost)


# Cost for each entry of the result. The first rows only create, move or view data, change signs or draw random
# numbers, which costs nothing.
_ELEMENTWISE: dict[str, float] = {
    **_each("_local_scalar_dense _to_copy _unsafe_view alias arange cat clone constant_pad_nd copy detach", 0),
    **_each("diag_embed diagonal empty empty_like expand eye fill flip full full_like gather index index_copy", 0),
    **_each("index_put index_select lift_fresh masked_select neg new_empty new_full new_ones new_zeros nonzero", 0),
    **_each("ones ones_like permute promote_types rand randperm repeat scalar_tensor scatter select", 0),
    **_each("slice split split_with_sizes squeeze stack t take_pairs transpose unbind unsqueeze view zero", 0),
    **_each("zeros zeros_like", 0),
    **_each("add rsub scatter_add sub", ADD),
    **_each("mul", MULTIPLY),
    **_each("div floor_divide reciprocal remainder", DIVIDE),
    **_each("sqrt", SQRT),
    **_each("rsqrt", SQRT + DIVIDE),
    **_each("hypot", SQRT + ADD + 2 * MULTIPLY),
    **_each("logit", LOG + ADD + DIVIDE),
    **_each("exp expm1", EXP),
    **_each("acos atan2 cos lgamma log log1p sin tanh", LOG),
    **_each("sigmoid", EXP + ADD + DIVIDE),
    **_each("addcmul", MULTIPLY + ADD),
    **_each("lerp", 2 * ADD + MULTIPLY),
    **_each("linalg_cross", ADD + 2 * MULTIPLY),
    **_each("ceil clamp_min eq ge gt isinf isnan le lt maximum minimum ne relu", COMPARE),
    **_each("abs copysign nan_to_num sgn sign", 2 * COMPARE),
    **_each("bitwise_and bitwise_not bitwise_or logical_or masked_fill where", LOGIC),
}

# Cost for each input entry of a reduction, except for the first entry of each result.
_REDUCTIONS: dict[str, float] = {
    **_each("cumsum sum", ADD),
    **_each("prod", MULTIPLY),
    **_each("amax amin argmax argmin max min", COMPARE),
    **_each("all any", LOGIC),
}

# Cost for one row, by its length.
_ROWS: dict[str, Callable[[int], float]] = {
    "linalg_vector_norm": lambda length: (length - 1) * ADD + length * MULTIPLY + SQRT,
    # Subtract the maximum, divide the exponentials by their sum.
    "_softmax": lambda length: (2 * length - 1) * ADD + length * (DIVIDE + EXP) + (length - 1) * COMPARE,
    # Subtract the mean, divide by the root of variance plus epsilon, apply weight and bias.
    "native_layer_norm": lambda length: (4 * length - 1) * ADD + 3 * length * MULTIPLY + 3 * DIVIDE + SQRT,
}

# Cost for one matrix of the batch, by the shapes of the input matrices.
_MATRIX: dict[str, Callable[..., float]] = {
    "mm": lambda first, second: matmul(first[0], first[1], second[1]),
    "mv": lambda first, second: matmul(first[0], first[1], 1),
    "bmm": lambda first, second: matmul(first[0], first[1], second[1]),
    "addmm": lambda bias, first, second: matmul(first[0], first[1], second[1]) + first[0] * second[1] * ADD,
    "linalg_cholesky_ex": lambda matrix: cholesky(matrix[0]),
    "linalg_inv_ex": lambda matrix: solve(matrix[0], matrix[0]),
    # Tridiagonal form and QR iterations with eigenvectors: about 9 n^3, half of them products. Source: G. Golub and C.
    # Van Loan, "Matrix Computations", 4th edition, section 8.3.
    "_linalg_eigh": lambda matrix: 4.5 * matrix[0] ** 3 * (ADD + MULTIPLY),
}


def _power(exponent: Any) -> float:
    """Cost of a power (``flops_pow``): products and a root for a multiple of 1/2, else exponential and logarithm."""
    if isinstance(exponent, Tensor) or not float(2 * exponent).is_integer():
        return EXP + LOG + MULTIPLY
    whole, half = divmod(abs(exponent), 1)
    products = int(whole).bit_length() + int(whole).bit_count() - 2 if whole else 0
    root = (SQRT + min(whole, 1) * MULTIPLY) if half else 0
    return products * MULTIPLY + root + (DIVIDE if exponent < 0 else 0)


def _operations(name: str, call: dict[str, Any], output: Any) -> float:
    """Cost of one call of the PyTorch operation ``aten.<name>`` with the given arguments and output."""
    result = output[0] if isinstance(output, tuple | list) else output
    if name in _ELEMENTWISE:
        cost = _ELEMENTWISE[name]
        scaled = name in ("add", "sub", "addcmul") and call.get("alpha", call.get("value", 1)) not in (1, -1)
        return result.numel() * (cost + MULTIPLY if scaled else cost) if cost else 0
    if name == "pow":
        return result.numel() * _power(call["exponent"])
    if name == "clamp":
        return result.numel() * sum(call[bound] is not None for bound in ("min", "max")) * COMPARE
    if name in _MATRIX:
        tensors = [value for value in call.values() if isinstance(value, Tensor)]
        return math.prod(tensors[0].shape[:-2]) * _MATRIX[name](*(tensor.shape[-2:] for tensor in tensors))
    if name in _REDUCTIONS:
        entries = call["self"].numel()
        results = entries // call["self"].shape[call["dim"]] if name == "cumsum" else result.numel()
        return (entries - results) * _REDUCTIONS[name]
    if name in _ROWS:
        entries, length = _rows(call)
        return entries // length * _ROWS[name](length)
    if name == "mean":
        return (call["self"].numel() - result.numel()) * ADD + result.numel() * DIVIDE
    if name == "searchsorted":  # by bisection
        return result.numel() * (call["sorted_sequence"].shape[-1] + 1).bit_length() * COMPARE
    if name == "nanmedian":
        length = call["self"].shape[call["dim"]] if "dim" in call else call["self"].numel()
        rows = call["self"].numel() // max(length, 1)
        return rows * (length * COMPARE + smallest(length, (length + 1) // 2))
    if name == "_unique2":
        return sort(call["self"].numel())
    if name in ("sort", "topk", "kthvalue"):
        length = call["self"].shape[call["dim"]]
        rows = call["self"].numel() // max(length, 1)
        if name == "kthvalue":
            return rows * smallest(length, call["k"])
        if name == "sort":
            return rows * sort(length)
        return rows * (smallest(length, call["k"]) + (sort(call["k"]) if call["sorted"] else 0))
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
        total: cost of the operations so far, see :data:`~kornia_pnpnet.evaluation.operations.costs.OPERATION_COSTS`.

    Raises:
        NotImplementedError: for a PyTorch operation whose cost is unknown, so that no operation is missed.

    Example:
        >>> with OperationCounter() as counter:
        ...     product = torch.ones(4, 2, 3) @ torch.ones(4, 3, 5)
        >>> counter.total  # 4 * 2 * 5 entries with 3 multiplications and 2 additions each
        200.0
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.total = 0.0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Run one operation and add its cost."""
        output = func(*args, **(kwargs or {}))
        names = [argument.name for argument in func._schema.arguments]
        call = {argument.name: argument.default_value for argument in func._schema.arguments}
        call |= dict(zip(names, args, strict=False)) | (kwargs or {})
        self.total += _operations(func.overloadpacket.__name__.rstrip("_"), call, output)
        return output


def count_per_problem(run: Callable[[int], object], batch: int = 2) -> float:
    """Measure the cost that each further problem of a batch adds.

    The count is the difference between a run of ``2 * batch`` and a run of ``batch`` problems, divided by ``batch``.
    Operations that a batch executes once for all problems cancel out.

    Args:
        run: solves a batch of the given size.
        batch: number of problems in the smaller run.

    Returns:
        The cost of one problem.

    Example:
        >>> count_per_problem(lambda batch: torch.ones(batch, 5).sum(-1) * torch.ones(3).sum())
        5.0
    """
    counts = []
    for size in (batch, 2 * batch):
        with torch.no_grad(), OperationCounter() as counter:
            run(size)
        counts.append(counter.total)
    return (counts[1] - counts[0]) / batch
