"""Operation counts of solvers by name, for figure 1."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from kornia.core.exceptions import ShapeError, ValueCheckError
from torch import nn

from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.evaluation.operations.costs import OPERATION_COSTS
from kornia_pnpnet.evaluation.operations.counter import count_per_problem
from kornia_pnpnet.init import RANSAC, MLPInit
from kornia_pnpnet.solver import PnPNet

__all__ = ["SOLVERS", "complexity_results", "operation_count"]

#: The solvers of figure 1, by name.
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

# The shipped weights behind the names without n: the count of a network depends on its architecture alone.
_ANY_N = {"net": "net-n9", "pnpnet": "pnpnet-n9"}
_FORMAT = 1
# Problems over which the count of a RANSAC is averaged, and their seed. Other solvers cost the same for all problems.
_PROBLEMS, _SEED = 8, 2024
# Pixels. No pair is ever within this threshold: RANSAC draws all its samples.
_ENDLESS = 1e-9


def operation_count(solver: str | PnPNet, n: int, *, outliers: int = 0) -> float:
    """Count the weighted operations of a run, per problem.

    Args:
        solver: the solver, or its name as for the command line (``"p3p-ransac:confidence=0.99"``). A network of a fixed
            number of pairs counts as one of the same kind that is built for n pairs; ``net`` and ``pnpnet`` are the
            names without n.
        n: number of pairs.
        outliers: number of outliers in each problem; only the counts of RANSAC depend on it.

    Returns:
        Operations weighted by :data:`~kornia_pnpnet.evaluation.operations.costs.OPERATION_COSTS`, the mean over some
        synthetic problems.

    Raises:
        ValueCheckError: when there is no such solver, or it is not one of this package.
        BaseError: when the solver does not take n pairs, or there are more outliers than pairs.
        NotImplementedError: when the solver runs an operation of unknown cost.

    Example:
        >>> round(operation_count("identity-lm", 9), -4)
        70000.0
    """
    built = _built(solver, n)
    count = _PROBLEMS if isinstance(built.init, RANSAC) else 2
    source = SyntheticProblems(n=n, batch_size=count, seed=_SEED, outliers=OutlierMix(count=outliers))
    problems = source.batch(0)

    def run(times: int) -> None:
        repeated = problems.map(lambda x: x.repeat(times, *(1,) * (x.ndim - 1)))
        built(repeated.world_points, repeated.img_points, repeated.intrinsics)

    return count_per_problem(run).flops / count


def _built(solver: str | PnPNet, n: int) -> PnPNet:
    """The solver, with an untrained network for n pairs in place of a network for another number."""
    if isinstance(solver, str):
        name, colon, options = solver.partition(":")
        made: nn.Module = load_solver(_ANY_N.get(name, name) + colon + options)
        if not isinstance(made, PnPNet):
            raise ValueCheckError(f"Cannot count the operations of {solver!r}: it is not a solver of this package.")
        solver = made
    if isinstance(solver.init, MLPInit):
        return PnPNet(MLPInit(n), solver.refine, solver.normalize, views=solver.views).eval()
    return solver


def complexity_results(
    solvers: Sequence[str] = SOLVERS, n: Iterable[int] = range(6, 51), *, outlier_share: float = 1 / 3
) -> dict[str, Any]:
    """Operation counts as plain data, for the results file behind figure 1.

    Args:
        solvers: names, see :func:`operation_count`.
        n: numbers of pairs.
        outlier_share: share of outliers, rounded down to a number.

    Returns:
        ``kind`` and ``format``; ``n``; ``counts``, for each solver one number for each n, ``None`` where the solver
        needs more than n pairs; ``ransac``, the names of the solvers that draw samples; ``all_samples``, their counts
        when they draw all samples; ``outliers`` for each n; ``costs``, the table of costs; ``environment``.
    """
    sizes = list(n)
    outliers = [int(outlier_share * size + 1e-9) for size in sizes]
    built = {name: _built(name, sizes[0]) for name in solvers}
    ransac = [name for name, solver in built.items() if isinstance(solver.init, RANSAC)]

    def count(spec: str, size: int, wrong: int) -> float | None:
        try:
            return operation_count(spec, size, outliers=wrong)
        except ShapeError:  # its samples have more pairs
            return None

    def endless(spec: str) -> str:
        return f"{spec}{',' if ':' in spec else ':'}threshold={_ENDLESS}"

    return {
        "kind": "complexity",
        "format": _FORMAT,
        "n": sizes,
        "counts": {name: [count(name, *pair) for pair in zip(sizes, outliers, strict=True)] for name in built},
        "ransac": ransac,
        "all_samples": {name: [count(endless(name), size, 0) for size in sizes] for name in ransac},
        "outliers": outliers,
        "costs": dict(OPERATION_COSTS),
        "environment": environment(),
    }
