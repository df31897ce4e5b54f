r"""Operation counts of solvers, from instrumented runs (figure 1 of the paper).

``costs`` is the one table of what an operation costs, ``counter`` the instrument, ``counts`` the runs. A count is of
what the batched code executes for one problem: both sides of a branch and all iterations of a fixed number.

RANSAC draws until its rule stops it, which depends on the data. Its count is the mean over problems of the protocol
with a third of outliers; beside it stands the count when no sample has an inlier beyond itself, so that all samples are
drawn.

Source: R. Sheffer and A. Wiesel, "PnP-Net: A hybrid Perspective-n-Point Network", 2020, who count by T. Minka's
Lightspeed toolbox.
"""

from kornia_pnpnet.evaluation.operations.costs import OPERATION_COSTS, Operations
from kornia_pnpnet.evaluation.operations.counter import OperationCounter, count_per_problem
from kornia_pnpnet.evaluation.operations.counts import SOLVERS, complexity_results, operation_count

__all__ = [
    "OPERATION_COSTS",
    "SOLVERS",
    "OperationCounter",
    "Operations",
    "complexity_results",
    "count_per_problem",
    "operation_count",
]
