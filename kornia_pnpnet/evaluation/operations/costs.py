"""The cost of scalar operations, and the operation counts of linear algebra.

Counted are additions, multiplications, divisions, square roots, exponentials, logarithms and other special functions,
comparisons, and logic. Moving data and changing signs cost nothing.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

__all__ = [
    "OPERATION_COSTS",
    "Operations",
    "cholesky",
    "lu",
    "matmul",
    "smallest",
    "solve",
    "solve_triangular",
    "sort",
]

#: The cost of one operation of each kind in "flops". Source: T. Minka's Lightspeed toolbox for MATLAB 2.8, which the
#: paper follows: ``flops.m`` and ``flops_div``, ``_sqrt``, ``_exp``, ``_log`` (timed on a Pentium 4). There a sine or
#: another special function costs as much as a logarithm, and an absolute value (4) as much as two comparisons. The
#: table has no logic (and, or, not, choosing one of two values); its cost of 1 is ours.
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
    """Number of operations of each kind. Counts can be added and multiplied by a number.

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
        """The sum, weighted by :data:`~kornia_pnpnet.evaluation.operations.costs.OPERATION_COSTS`."""
        return sum(OPERATION_COSTS[kind] * count for kind, count in asdict(self).items())


# --- linear algebra on one matrix -------------------------------------------------------------------------------------
# Sources: Lightspeed as above, by the name of its function; G. Golub and C. Van Loan, Matrix Computations, 3rd edition
# 1996 (GVL).


def _half(flops: float) -> Operations:
    """Half of the flops as additions, half as multiplications."""
    return Operations(add=flops / 2, multiply=flops / 2)


def matmul(rows: int, inner: int, columns: int) -> Operations:
    """Matrix product (``flops_mul``)."""
    return rows * columns * Operations(add=inner - 1, multiply=inner)


def cholesky(n: int) -> Operations:
    """Cholesky factorisation (``flops_chol``)."""
    return _half((n**3 - n) / 3) + Operations(divide=n * (n - 1) / 2, sqrt=n)


def solve_triangular(n: int, columns: int, *, unit: bool = False) -> Operations:
    """Triangular system of n unknowns with several right-hand sides (``flops_solve_tri``)."""
    return columns * (_half(n * n - n) + Operations(divide=0 if unit else n))


def lu(n: int) -> Operations:
    """Gaussian elimination with partial pivoting (GVL, algorithm 3.4.1)."""
    pairs = n * (n - 1) / 2
    return _half(2 * pairs * (2 * n - 1) / 3) + Operations(divide=pairs, compare=pairs)


def solve(n: int, columns: int) -> Operations:
    """Square system with several right-hand sides: :func:`lu` and two triangular systems."""
    return lu(n) + solve_triangular(n, columns, unit=True) + solve_triangular(n, columns)


def sort(n: int) -> Operations:
    r"""Sorting n numbers with :math:`n \log_2 n` comparisons."""
    return Operations(compare=n * math.log2(n) if n > 1 else 0)


def smallest(n: int, k: int) -> Operations:
    """Selecting the k smallest of n numbers.

    Source: R. Floyd and R. Rivest, "Expected time bounds for selection", CACM 18(3), 1975.
    """
    return Operations(compare=n + min(k, n - k))
