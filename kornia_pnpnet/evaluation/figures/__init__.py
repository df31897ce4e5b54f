"""Pictures of results: all figures of the paper's protocol at once, or one picture by each other function.

Only this folder needs matplotlib and seaborn. matplotlib's settings change only while a picture is drawn.
"""

try:
    import seaborn  # noqa: F401
except ImportError as error:
    raise ImportError("Pictures need matplotlib and seaborn: pip install 'kornia_pnpnet[eval]'") from error

from kornia_pnpnet.evaluation.figures.problem import plot_pose
from kornia_pnpnet.evaluation.figures.results import (
    paper_figures,
    plot_against_m,
    plot_against_n,
    plot_errors,
    plot_mismatches,
    plot_operations,
    plot_scenes,
    plot_success,
    plot_synthetic,
)
from kornia_pnpnet.evaluation.figures.training import plot_reliability, plot_sweep, plot_training

__all__ = [
    "paper_figures",
    "plot_against_m",
    "plot_against_n",
    "plot_errors",
    "plot_mismatches",
    "plot_operations",
    "plot_pose",
    "plot_reliability",
    "plot_scenes",
    "plot_success",
    "plot_sweep",
    "plot_synthetic",
    "plot_training",
]
