"""The cost of scalar operations and of linear algebra.

Counted are additions, multiplications, divisions, square roots, exponentials, logarithms and other special functions,
comparisons, and logic. Moving data and changing signs cost nothing.
"""

from __future__ import annotations

import math

__all__ = [
    "OPERATION_COSTS",
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


ADD, MULTIPLY, DIVIDE, SQRT, EXP, LOG, COMPARE, LOGIC = OPERATION_COSTS.values()

# --- linear algebra on one matrix -------------------------------------------------------------------------------------
# Sources: Lightspeed as above, by the name of its function; G. Golub and C. Van Loan, Matrix Computations, 3rd edition
# 1996 (GVL). An addition and a multiplication cost 1 each, so half of the flops may be of either kind.


def matmul(rows: int, inner: int, columns: int) -> float:
    """Matrix product (``flops_mul``)."""
    return rows * columns * ((inner - 1) * ADD + inner * MULTIPLY)


def cholesky(n: int) -> float:
    """Cholesky factorisation (``flops_chol``)."""
    return (n**3 - n) / 3 + n * (n - 1) / 2 * DIVIDE + n * SQRT


def solve_triangular(n: int, columns: int, *, unit: bool = False) -> float:
    """Triangular system of n unknowns with several right-hand sides (``flops_solve_tri``)."""
    return columns * (n * n - n + (0 if unit else n * DIVIDE))


def lu(n: int) -> float:
    """Gaussian elimination with partial pivoting (GVL, algorithm 3.4.1)."""
    pairs = n * (n - 1) / 2
    return 2 * pairs * (2 * n - 1) / 3 + pairs * (DIVIDE + COMPARE)


def solve(n: int, columns: int) -> float:
    """Square system with several right-hand sides: :func:`lu` and two triangular systems."""
    return lu(n) + solve_triangular(n, columns, unit=True) + solve_triangular(n, columns)


def sort(n: int) -> float:
    r"""Sorting n numbers with :math:`n \log_2 n` comparisons."""
    return n * math.log2(n) * COMPARE if n > 1 else 0


def smallest(n: int, k: int) -> float:
    """Selecting the k smallest of n numbers.

    Source: R. Floyd and R. Rivest, "Expected time bounds for selection", CACM 18(3), 1975.
    """
    return (n + min(k, n - k)) * COMPARE
