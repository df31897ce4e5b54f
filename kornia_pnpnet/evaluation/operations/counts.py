"""Operation counts of solvers by name, and the results file behind figure 1."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from kornia.core.exceptions import ValueCheckError

from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.evaluation.operations.costs import OPERATION_COSTS
from kornia_pnpnet.evaluation.operations.counter import count_per_problem
from kornia_pnpnet.evaluation.results import FORMAT
from kornia_pnpnet.propose.mlp import MLPInit
from kornia_pnpnet.propose.ransac import RANSAC
from kornia_pnpnet.solver import PnPNet

__all__ = ["SOLVERS", "complexity_results", "operation_count"]

#: The solvers of figure 1. ``net``, ``pnpnet`` and ``pnpnet-paper`` are networks built for each number of pairs.
SOLVERS = (
    "net",
    "pnpnet",
    "pnpnet-paper",
    "pnpnet-set",
    "epnp",
    "epnp-lm",
    "reppnp",
    "reppnp-lm",
    "p3p-ransac",
    "ransac-epnp-lm",
    "identity-lm",
)

# Shipped solvers behind the names without n. Their networks are replaced by untrained ones for n pairs: a count depends
# on the architecture alone.
_ANY_N = {"net": "net-n9", "pnpnet": "pnpnet-n9", "pnpnet-paper": "pnpnet-n9-paper"}
# Problems in a run. RANSAC pads its samples to multiples of 64, so a batch of 64 needs next to no padding.
_BATCH = 64


def operation_count(solver: str | PnPNet, n: int, *, outliers: int = 0) -> float:
    """Count the operations that a solver executes for one problem, by running it.

    Args:
        solver: the solver, or its name as for :func:`~kornia_pnpnet.evaluation.named_solvers.load_solver`. The names
            ``net``, ``pnpnet`` and ``pnpnet-paper`` stand for networks that are built for ``n`` pairs.
        n: number of pairs, at least 3.
        outliers: number of outliers among them. Only the counts of RANSAC depend on it: solvers by name have the fixed
            effort.

    Returns:
        Operations weighted by :data:`~kornia_pnpnet.evaluation.operations.costs.OPERATION_COSTS`, the mean over 64
        problems without noise.

    Raises:
        ValueCheckError: when the solver does not run in PyTorch, and so cannot be counted.
        BaseError: for an unknown name, or numbers of pairs and outliers that do not fit each other or the solver.

    Example:
        >>> round(operation_count("identity-lm", 9), -5)
        100000.0
    """
    runnable = _solver(solver, n) if isinstance(solver, str) else solver
    mix = OutlierMix(count=outliers)
    source = SyntheticProblems(n=n, batch_size=_BATCH, outliers=mix, img_sigma=0.0, world_sigma=0.0)
    problems = source.batch(0)

    def run(batch: int) -> None:
        repeated = problems.map(lambda part: torch.cat([part] * (batch // _BATCH)))
        runnable(repeated.world_points, repeated.img_points, repeated.intrinsics)

    run(_BATCH)  # what is computed once and kept is not counted
    return count_per_problem(run, _BATCH)


def _solver(spec: str, n: int) -> PnPNet:
    name, colon, options = spec.partition(":")
    solver = load_solver(_ANY_N.get(name, name) + colon + options)
    if not isinstance(solver, PnPNet):
        raise ValueCheckError(f"The operations of {spec!r} cannot be counted: it is not a solver in PyTorch.")
    if name in _ANY_N:
        solver.init = MLPInit(n)
    solver.effort = "fixed"  # the operations of a search depend on the data
    return solver


def _sample_size(spec: str) -> int:
    """Number of pairs in a sample of RANSAC, 0 for a solver that draws no samples."""
    init = _solver(spec, n=9).init
    return init.minimal.sample_size if isinstance(init, RANSAC) else 0


def complexity_results(
    solvers: Sequence[str] = SOLVERS, n: Iterable[int] = range(6, 51), *, outlier_share: float = 1 / 3
) -> dict[str, Any]:
    """Count the operations of solvers for the results file behind figure 1.

    Args:
        solvers: names, see :func:`operation_count`.
        n: numbers of pairs.
        outlier_share: share of outliers among the pairs of each problem; their number is rounded down.

    Returns:
        ``kind`` and ``format``; ``n``; ``counts``, for each solver one number for each n, ``None`` where a sample of
        RANSAC has more than n pairs; ``ransac``, the solvers that draw samples; ``outliers`` for each n; ``costs``, the
        table of costs; ``environment``.
    """
    sizes = list(n)
    outliers = [int(outlier_share * size + 1e-9) for size in sizes]  # 1/3 of 9 is 3, not 2 by rounding
    smallest = {name: _sample_size(name) for name in solvers}
    counts = {
        name: [
            operation_count(name, size, outliers=wrong) if size >= least else None
            for size, wrong in zip(sizes, outliers, strict=True)
        ]
        for name, least in smallest.items()
    }
    return {
        "kind": "complexity",
        "format": FORMAT,
        "n": sizes,
        "counts": counts,
        "ransac": [name for name, least in smallest.items() if least],
        "outliers": outliers,
        "costs": dict(OPERATION_COSTS),
        "environment": environment(),
    }
