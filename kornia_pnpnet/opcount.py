r"""Counts the scalar operations of tensor code by running it: the instrument behind :mod:`kornia_pnpnet.complexity`.

What counts is what a scalar program would have to compute for the same result: additions, multiplications, divisions,
roots, exponentials, logarithms and other special functions, comparisons, logic. Moving data, changing signs, making
constants and drawing random numbers count nothing.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

__all__ = [
    "OPERATION_COSTS",
    "OperationCounter",
    "Operations",
    "cholesky",
    "count_per_problem",
    "eigh",
    "matmul",
    "qr",
    "solve",
    "solve_triangular",
    "sort",
    "svd",
]

#: What one operation of each kind costs in "flops". Source: T. Minka's Lightspeed toolbox for MATLAB 2.8 (the protocol
#: that the paper follows): ``flops.m`` and ``flops_div``, ``_sqrt``, ``_exp``, ``_log``, which time a Pentium 4. There
#: sines and other special functions cost as a logarithm, a change of sign and moved data cost nothing, and an absolute
#: value (4) costs as two comparisons. Logic (and, or, not, choosing one of two) is not in that table: 1 is ours.
OPERATION_COSTS: dict[str, int] = {
    "add": 1,
    "multiply": 1,
    "divide": 8,
    "sqrt": 8,
    "exp": 40,
    "log": 20,
    "compare": 2,
    "logic": 1,
}


@dataclass(frozen=True)
class Operations:
    """How many operations of each kind; they can be added, and multiplied by a number.

    Example:
        >>> (3 * Operations(add=1, divide=2) + Operations(add=4)).flops
        55
    """

    add: float = 0
    multiply: float = 0
    divide: float = 0
    sqrt: float = 0
    exp: float = 0
    log: float = 0
    compare: float = 0
    logic: float = 0

    def __add__(self, other: Operations) -> Operations:
        return Operations(**{kind: count + getattr(other, kind) for kind, count in asdict(self).items()})

    def __mul__(self, factor: float) -> Operations:
        return Operations(**{kind: factor * count for kind, count in asdict(self).items()})

    __rmul__ = __mul__

    @property
    def flops(self) -> float:
        """The sum, weighted by :data:`OPERATION_COSTS`."""
        return sum(OPERATION_COSTS[kind] * count for kind, count in asdict(self).items())


_NOTHING, _ADD, _MULTIPLY, _DIVIDE = Operations(), Operations(add=1), Operations(multiply=1), Operations(divide=1)
_SQRT, _EXP, _LOG = Operations(sqrt=1), Operations(exp=1), Operations(log=1)
_COMPARE, _LOGIC = Operations(compare=1), Operations(logic=1)


# --- linear algebra on one matrix -------------------------------------------------------------------------------------
# Sources: Lightspeed as above where it has a formula; else G. Golub and C. Van Loan, Matrix Computations, 3rd edition
# 1996 (GVL), whose flops are taken as half additions, half multiplications.


def _half(flops: float) -> Operations:
    return Operations(add=flops / 2, multiply=flops / 2)


def matmul(rows: int, inner: int, columns: int) -> Operations:
    """A product of matrices (``flops_mul``)."""
    return rows * columns * Operations(add=inner - 1, multiply=inner)


def cholesky(n: int) -> Operations:
    """A Cholesky factorisation (``flops_chol``)."""
    return _half((n**3 - n) / 3) + Operations(divide=n * (n - 1) / 2, sqrt=n)


def solve_triangular(n: int, columns: int, *, unit: bool = False) -> Operations:
    """A triangular system with several right-hand sides (``flops_solve_tri``)."""
    return columns * (_half(n * n - n) + Operations(divide=0 if unit else n))


def lu(n: int) -> Operations:
    """Gaussian elimination with partial pivoting (GVL, algorithm 3.4.1)."""
    pairs = n * (n - 1) / 2
    return _half(2 * pairs * (2 * n - 1) / 3) + Operations(divide=pairs, compare=pairs)


def solve(n: int, columns: int) -> Operations:
    """A square system with several right-hand sides: :func:`lu` and two triangular systems."""
    return lu(n) + solve_triangular(n, columns, unit=True) + solve_triangular(n, columns)


def qr(rows: int, columns: int) -> Operations:
    """Householder QR with the thin Q, for at least as many rows as columns (GVL, section 5.2.1)."""
    return _half(4 * columns * columns * (rows - columns / 3))


def eigh(n: int) -> Operations:
    """The symmetric QR algorithm with eigenvectors (GVL, algorithm 8.3.3)."""
    return _half(9 * n**3)


def svd(rows: int, columns: int, *, full: bool = False) -> Operations:
    """The Golub-Reinsch SVD with both kinds of vectors (GVL, section 5.4.5)."""
    m, n = max(rows, columns), min(rows, columns)
    return _half(4 * m * m * n + 8 * m * n * n + 9 * n**3 if full or m == n else 14 * m * n * n + 8 * n**3)


def sort(n: int) -> Operations:
    r"""Sorting, or anything else that is done by sorting, with :math:`n \log_2 n` comparisons."""
    return Operations(compare=n * math.log2(n) if n > 1 else 0)


# --- PyTorch's operations ---------------------------------------------------------------------------------------------


def _each(names: str, operations: Operations) -> dict[str, Operations]:
    return dict.fromkeys(names.split(), operations)


#: Operations for each entry of the result. The first ones move, make or view data, change signs or draw at random.
_ELEMENTWISE: dict[str, Operations] = {
    **_each("_local_scalar_dense _to_copy _unsafe_view alias arange as_strided cat clone copy detach", _NOTHING),
    **_each("diag_embed diagonal empty empty_like expand eye fill flip full full_like gather index", _NOTHING),
    **_each("index_copy index_put index_select lift_fresh neg new_empty new_full new_ones new_zeros nonzero", _NOTHING),
    **_each("ones ones_like permute promote_types rand randint repeat roll scalar_tensor scatter select", _NOTHING),
    **_each("slice split split_with_sizes squeeze stack t transpose tril triu unbind unsqueeze view", _NOTHING),
    **_each("zeros zeros_like", _NOTHING),
    **_each("add sub rsub", _ADD),
    **_each("mul", _MULTIPLY),
    **_each("div reciprocal remainder floor_divide", _DIVIDE),
    **_each("sqrt", _SQRT),
    **_each("rsqrt", _SQRT + _DIVIDE),
    **_each("exp expm1", _EXP),
    **_each("acos asin atan atan2 cos log log1p log2 sin tan", _LOG),
    **_each("sigmoid", _EXP + _ADD + _DIVIDE),
    **_each("addcmul", _MULTIPLY + _ADD),
    **_each("addcdiv", _DIVIDE + _ADD),
    **_each("lerp", 2 * _ADD + _MULTIPLY),
    **_each("linalg_cross", 2 * _MULTIPLY + _ADD),
    **_each("ceil clamp_max clamp_min eq floor ge gt le lt maximum minimum ne relu round", _COMPARE),
    **_each("abs copysign sgn sign", 2 * _COMPARE),
    **_each("bitwise_and bitwise_not bitwise_or logical_and logical_not logical_or masked_fill where", _LOGIC),
}

#: Operations for each entry that a reduction takes in beyond the first of each result.
_REDUCTIONS: dict[str, Operations] = {
    **_each("cumsum mean sum", _ADD),
    **_each("cumprod prod", _MULTIPLY),
    **_each("amax amin argmax argmin max min", _COMPARE),
    **_each("all any", _LOGIC),
}

#: Operations for one matrix of the batch, from the arguments of the call.
_MATRIX: dict[str, Callable[[dict[str, Any]], Operations]] = {
    "mm": lambda call: matmul(*_size(call["self"]), _size(call["mat2"])[1]),
    "bmm": lambda call: matmul(*_size(call["self"]), _size(call["mat2"])[1]),
    "addmm": lambda call: _multiply_add(*_size(call["mat1"]), _size(call["mat2"])[1]),
    "baddbmm": lambda call: _multiply_add(*_size(call["batch1"]), _size(call["batch2"])[1]),
    "linalg_cholesky_ex": lambda call: cholesky(_size(call["self"])[0]),
    "linalg_solve_triangular": lambda call: solve_triangular(
        _size(call["self"])[0], _size(call["B"])[call["left"]], unit=call["unitriangular"]
    ),
    "_linalg_solve_ex": lambda call: solve(_size(call["A"])[0], call["B"].numel() // call["A"][..., 0].numel()),
    "linalg_inv_ex": lambda call: solve(_size(call["A"])[0], _size(call["A"])[0]),
    "_linalg_det": lambda call: lu(_size(call["A"])[0]) + (_size(call["A"])[0] - 1) * _MULTIPLY,
    "linalg_qr": lambda call: qr(*_size(call["A"])),
    "_linalg_eigh": lambda call: eigh(_size(call["A"])[0]),
    "_linalg_svd": lambda call: svd(*_size(call["A"]), full=call["full_matrices"]),
}


def _size(matrices: Tensor) -> tuple[int, int]:
    """Rows and columns."""
    return matrices.shape[-2], matrices.shape[-1]


def _multiply_add(rows: int, inner: int, columns: int) -> Operations:
    return matmul(rows, inner, columns) + rows * columns * _ADD


def _power(exponent: Any) -> Operations:
    """Raising to a power (``flops_pow``): by products and a root where that does it."""
    if isinstance(exponent, Tensor) or not float(2 * exponent).is_integer():
        return _EXP + _LOG + _MULTIPLY
    whole, half = divmod(abs(exponent), 1)
    products = int(whole).bit_length() + int(whole).bit_count() - 2 if whole else 0
    root = (_SQRT + min(whole, 1) * _MULTIPLY) if half else _NOTHING
    return products * _MULTIPLY + root + (_DIVIDE if exponent < 0 else _NOTHING)


def _operations(name: str, call: dict[str, Any], output: Any) -> Operations:
    """Operations of one call of PyTorch's operation of that name."""
    result = output[0] if isinstance(output, tuple | list) else output
    if name in _ELEMENTWISE:
        cost = _ELEMENTWISE[name]
        return cost if cost is _NOTHING else result.numel() * cost
    if name == "pow":
        return result.numel() * _power(call["exponent"])
    if name == "clamp":
        return result.numel() * sum(call[bound] is not None for bound in ("min", "max")) * _COMPARE
    if name in _MATRIX:
        matrices = call["A"] if "A" in call else call["mat1" if name == "addmm" else "self"]
        return math.prod(matrices.shape[:-2]) * _MATRIX[name](call)
    entries = call["self"].numel() if "self" in call else 0
    if name in ("max", "min") and "other" in call:
        return result.numel() * _COMPARE
    if name in _REDUCTIONS:
        results = entries // call["self"].shape[call["dim"]] if name.startswith("cum") else result.numel()
        return (entries - results) * _REDUCTIONS[name] + (results * _DIVIDE if name == "mean" else _NOTHING)
    if name == "linalg_vector_norm" and call["ord"] == 2:
        return entries * _MULTIPLY + (entries - result.numel()) * _ADD + result.numel() * _SQRT
    if name in ("sort", "topk", "kthvalue", "median"):
        length = call["self"].shape[call["dim"]] if "dim" in call else entries
        return entries / max(length, 1) * sort(length)
    raise NotImplementedError(f"The cost of aten.{name} is unknown: say in kornia_pnpnet.opcount what it is.")


# --- the instrument ---------------------------------------------------------------------------------------------------

_PACKAGE = str(Path(__file__).parent)


class OperationCounter(TorchDispatchMode):
    """Count the operations of the tensor code that runs inside a ``with`` block.

    Args:
        parts: functions to tell apart, as ``module.qualified_name`` below this package, for example
            ``"lm.lm_step"``. An operation counts for the innermost of them that is running, else for ``""``.

    Attributes:
        counts: the :class:`Operations` of each part.

    Raises:
        NotImplementedError: for an operation of PyTorch whose cost is not known: none is lost in silence.

    Example:
        >>> with OperationCounter() as counter:
        ...     product = torch.ones(4, 2, 3) @ torch.ones(4, 3, 5)
        >>> counter.counts[""].multiply, counter.counts[""].add
        (120, 80)
    """

    def __init__(self, parts: Collection[str] = ()) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._parts = frozenset(parts)
        self.counts: dict[str, Operations] = {}

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Run one operation and add what it cost."""
        output = func(*args, **(kwargs or {}))
        names = [argument.name for argument in func._schema.arguments]
        call = {argument.name: argument.default_value for argument in func._schema.arguments}
        call |= dict(zip(names, args, strict=False)) | (kwargs or {})
        operations = _operations(func.overloadpacket.__name__.rstrip("_"), call, output)
        if operations != _NOTHING:
            part = self._part()
            self.counts[part] = self.counts.get(part, _NOTHING) + operations
        return output

    def _part(self) -> str:
        """The innermost running function that is one of the parts."""
        frame = sys._getframe(2) if self._parts else None
        while frame is not None:
            code = frame.f_code
            if code.co_filename.startswith(_PACKAGE):
                name = f"{Path(code.co_filename).stem}.{code.co_qualname}"
                if name in self._parts:
                    return name
            frame = frame.f_back
        return ""


def count_per_problem(run: Callable[[int], object], parts: Collection[str] = ()) -> dict[str, Operations]:
    """Operations that each further problem of a batch costs, by parts.

    What is computed once for the whole batch drops out: the difference of a run of four and a run of two is taken.

    Args:
        run: solves a batch of the given size.
        parts: see :class:`OperationCounter`.

    Returns:
        The operations for one problem; parts without any are left out.

    Example:
        >>> count_per_problem(lambda batch: torch.ones(batch, 5).sum(-1) * torch.ones(3).sum())[""].add
        4.0
    """
    counters = []
    for batch in (2, 4):
        with torch.no_grad(), OperationCounter(parts) as counter:
            run(batch)
        counters.append(counter.counts)
    small, large = counters
    differences = {part: 0.5 * (count + -1 * small.get(part, _NOTHING)) for part, count in large.items()}
    return {part: operations for part, operations in differences.items() if operations != _NOTHING}
