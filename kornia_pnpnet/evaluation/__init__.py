"""Evaluation: comparison of solvers on sets of problems, bounds of the solvers' accuracy, and pictures."""

from kornia_pnpnet.evaluation.comparison import EvaluationData, SeesTruth, draw_problems, evaluate
from kornia_pnpnet.evaluation.results import format_table, load_results, row_errors, save_results

__all__ = [
    "EvaluationData",
    "SeesTruth",
    "draw_problems",
    "evaluate",
    "format_table",
    "load_results",
    "row_errors",
    "save_results",
]
