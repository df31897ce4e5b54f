r"""How many operations a solver needs, as a formula in the number of pairs (figure 1 of the paper).

A solver runs *parts*, functions of this package, each with some sizes: :func:`part_calls` says which and how often,
:data:`PARTS` how many operations a call takes. Both describe what the batched code
executes: both sides of a branch are computed, numbers of iterations are fixed. ``tests/test_complexity.py`` holds every
part of every solver against an instrumented run (:class:`OperationCounter`); they agree to the last operation.

What RANSAC draws depends on the data. Its formula is exact for a given number of outliers in the sense of its own rule:
it stops after the first round with as many samples as the rule asks for, and every round finds a better pose, which is
the most that can happen.

Source: R. Sheffer and A. Wiesel, "PnP-Net: A hybrid Perspective-n-Point Network", 2020, which counts by T. Minka's
Lightspeed toolbox; :data:`~kornia_pnpnet.evaluation.operations.operations.OPERATION_COSTS` has its costs.
"""

from kornia_pnpnet.evaluation.operations.calls import part_calls
from kornia_pnpnet.evaluation.operations.counter import OperationCounter, count_per_problem
from kornia_pnpnet.evaluation.operations.counts import SOLVERS, complexity_results, operation_count, operations_by_part
from kornia_pnpnet.evaluation.operations.operations import OPERATION_COSTS, Operations
from kornia_pnpnet.evaluation.operations.parts import PARTS

__all__ = [
    "OPERATION_COSTS",
    "PARTS",
    "SOLVERS",
    "OperationCounter",
    "Operations",
    "complexity_results",
    "count_per_problem",
    "operation_count",
    "operations_by_part",
    "part_calls",
]
