"""Pictures of results, the only part that needs matplotlib. They are drawn without pyplot: nothing global changes.

``paper_figures`` draws the protocol's figures from results files. The functions behind it and the others each draw one.
"""

try:
    import matplotlib  # noqa: F401
except ImportError as error:
    raise ImportError("Pictures need matplotlib: pip install 'kornia_pnpnet[eval]'") from error

from kornia_pnpnet.evaluation.figures.curves import plot_against_m, plot_against_n, plot_mismatches
from kornia_pnpnet.evaluation.figures.dots import plot_scenes, plot_success, plot_synthetic
from kornia_pnpnet.evaluation.figures.errors import plot_errors
from kornia_pnpnet.evaluation.figures.operations import plot_operations
from kornia_pnpnet.evaluation.figures.overview import OverviewRow, plot_overview
from kornia_pnpnet.evaluation.figures.paper import paper_figures
from kornia_pnpnet.evaluation.figures.problem import plot_pose
from kornia_pnpnet.evaluation.figures.reliability import plot_reliability
from kornia_pnpnet.evaluation.figures.sweep import plot_sweep
from kornia_pnpnet.evaluation.figures.training import plot_training

__all__ = [
    "OverviewRow",
    "paper_figures",
    "plot_against_m",
    "plot_against_n",
    "plot_errors",
    "plot_mismatches",
    "plot_operations",
    "plot_overview",
    "plot_pose",
    "plot_reliability",
    "plot_scenes",
    "plot_success",
    "plot_sweep",
    "plot_synthetic",
    "plot_training",
]
