"""Operation counts of solvers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from kornia.core.exceptions import ValueCheckError

from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.evaluation.operations.calls import part_calls
from kornia_pnpnet.evaluation.operations.operations import OPERATION_COSTS, Operations
from kornia_pnpnet.evaluation.operations.parts import PARTS
from kornia_pnpnet.init import RANSAC
from kornia_pnpnet.solver import PnPNet

__all__ = ["SOLVERS", "complexity_results", "operation_count", "operations_by_part"]

#: The solvers that have a formula, by their names.
SOLVERS = (
    "net",
    "pnpnet",
    "pnpnet-set",
    "epnp",
    "epnp-lm",
    "reppnp",
    "reppnp-lm",
    "p3p-ransac",
    "ransac-epnp-lm",
    "identity-lm",
)

# The shipped weights behind the names without n: the count of a network only needs its architecture.
_ANY_N = {"net": "net-n9", "pnpnet": "pnpnet-n9"}
_FORMAT = 1


def operations_by_part(
    solver: PnPNet, n: int, *, outliers: int | None = None, better: int | None = None
) -> dict[str, Operations]:
    """Operations for one problem of n pairs, by parts.

    Args:
        solver: see :func:`part_calls`, as are the others.
        n: number of pairs.
        outliers: how many of them are wrong.
        better: how many rounds of RANSAC find a better pose.

    Returns:
        For each name in :data:`PARTS` that the solver runs, the operations of all its
        calls.

    Raises:
        ValueCheckError: when there is no formula.
    """
    total: dict[str, Operations] = {}
    for part, times, sizes in part_calls(solver, n, outliers=outliers, better=better):
        total[part] = total.get(part, Operations()) + times * PARTS[part](*sizes)
    return total


def operation_count(solver: str | PnPNet, n: int, *, outliers: int | None = None) -> float:
    """Flops for one problem of n pairs.

    Args:
        solver: the solver, or its name as for the command line (``"p3p-ransac:confidence=0.99"``). A network counts as
            one that is built for n pairs; ``net`` and ``pnpnet`` are the names without n.
        n: number of pairs.
        outliers: how many of them are wrong, for the rule by which RANSAC stops; it draws all its samples when
            ``None``.

    Returns:
        Operations weighted by :data:`~kornia_pnpnet.evaluation.operations.operations.OPERATION_COSTS`.

    Raises:
        ValueCheckError: when there is no such solver, or no formula for it.

    Example:
        >>> round(operation_count("identity-lm", 9), -4)
        70000.0
    """
    solver = _solver(solver) if isinstance(solver, str) else solver
    return sum(operations.flops for operations in operations_by_part(solver, n, outliers=outliers).values())


def _solver(spec: str) -> PnPNet:
    name, colon, options = spec.partition(":")
    solver = load_solver(_ANY_N.get(name, name) + colon + options)
    if not isinstance(solver, PnPNet):
        raise ValueCheckError(f"There is no formula for {spec!r}: it is not made of this package's parts.")
    return solver


def complexity_results(
    solvers: Sequence[str] = SOLVERS, n: Iterable[int] = range(6, 51), *, outlier_share: float = 1 / 3
) -> dict[str, Any]:
    """Operation counts as plain data, for the results file behind figure 1.

    Args:
        solvers: names, see :func:`operation_count`.
        n: numbers of pairs.
        outlier_share: of how many outliers RANSAC is to be sure: the share of the pairs, rounded down.

    Returns:
        ``kind`` and ``format``; ``n``; ``counts``, for each solver one number for each n, ``None`` where its samples
        have more than n pairs; ``ransac``, the solvers that draw samples; ``all_samples``, their counts when they do
        not stop before the last sample; ``outliers`` for each n; ``costs``, the table of costs; ``environment``.
    """
    sizes = list(n)
    outliers = [int(outlier_share * size + 1e-9) for size in sizes]
    built = {name: _solver(name) for name in solvers}
    ransac = [name for name, solver in built.items() if isinstance(solver.init, RANSAC)]

    def count(name: str, size: int, wrong: int | None) -> float | None:
        init = built[name].init
        if isinstance(init, RANSAC) and size < init.minimal.sample_size:
            return None
        return operation_count(built[name], size, outliers=wrong)

    return {
        "kind": "complexity",
        "format": _FORMAT,
        "n": sizes,
        "counts": {name: [count(name, *pair) for pair in zip(sizes, outliers, strict=True)] for name in built},
        "ransac": ransac,
        "all_samples": {name: [count(name, size, None) for size in sizes] for name in ransac},
        "outliers": outliers,
        "costs": dict(OPERATION_COSTS),
        "environment": environment(),
    }
