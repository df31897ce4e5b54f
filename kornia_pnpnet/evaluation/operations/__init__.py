r"""Operation counts: how many scalar operations a solver executes for one problem of n pairs (figure 1 of the paper).

Every count is measured: :class:`OperationCounter` runs the solver and adds up what each PyTorch operation costs,
weighted by the table :data:`~kornia_pnpnet.evaluation.operations.costs.OPERATION_COSTS`. The batched code computes both
sides of a branch and runs a fixed number of iterations, so the counts of all solvers but RANSAC are the same for every
problem of n pairs.

RANSAC draws samples until its stopping rule is met, so its count depends on the problem. :func:`operation_count` takes
the mean over 64 problems of the protocol with a given number of outliers and without noise: every inlier then lies
within the threshold, and RANSAC stops as early as its rule allows. With noise RANSAC draws more samples.

Source: R. Sheffer and A. Wiesel, "PnP-Net: A hybrid Perspective-n-Point Network", 2020, which counts by T. Minka's
Lightspeed toolbox.
"""

from kornia_pnpnet.evaluation.operations.costs import OPERATION_COSTS
from kornia_pnpnet.evaluation.operations.counter import OperationCounter, count_per_problem
from kornia_pnpnet.evaluation.operations.counts import SOLVERS, complexity_results, operation_count

__all__ = [
    "OPERATION_COSTS",
    "SOLVERS",
    "OperationCounter",
    "complexity_results",
    "count_per_problem",
    "operation_count",
]
