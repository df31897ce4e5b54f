"""All figures of the paper's protocol."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from kornia_pnpnet.evaluation.figures.curves import plot_against_m, plot_against_n, plot_mismatches
from kornia_pnpnet.evaluation.figures.dots import plot_scenes, plot_synthetic
from kornia_pnpnet.evaluation.figures.operations import plot_operations
from kornia_pnpnet.evaluation.figures.records import NothingToDrawError

__all__ = ["paper_figures"]

_OPERATIONS = "figure1_operations.png"
_FIGURES: Mapping[str, Callable[[Path, Sequence[Mapping[str, Any]]], Path]] = {
    "figure2_paper.png": partial(plot_synthetic, source="paper"),
    "figure3_gaussian_pose.png": partial(plot_synthetic, source="gaussian_pose"),
    "figure4_scenes.png": plot_scenes,
    "figure5_mismatches.png": plot_mismatches,
    "success_against_n.png": plot_against_n,
    "success_against_m.png": plot_against_m,
}


def paper_figures(results: Sequence[Mapping[str, Any]], folder: str | Path) -> list[Path]:
    """Draw the protocol's five figures, success against n and success against m. Figures without data are left out.

    Args:
        results: results files of :func:`~kornia_pnpnet.evaluation.evaluate`, and at most one file of operation counts
            (``kind`` is ``"complexity"``). Of several results with the same source, outliers, n and solver, the one
            with the most problems is drawn, and of these the last. A solver whose name sets m is in the figure against
            m only.
        folder: folder of the pictures, made when missing.

    Returns:
        The paths of the pictures: ``figure1_operations.png``, ``figure2_paper.png``, ``figure3_gaussian_pose.png``,
        ``figure4_scenes.png``, ``figure5_mismatches.png``, ``success_against_n.png`` and ``success_against_m.png``.

    Raises:
        ValueError: when no figure has data, or there are several files of operation counts.
    """
    if not results:
        raise ValueError("There are no results to draw: expected at least one results file.")
    folder = Path(folder)
    complexity = [entry for entry in results if entry.get("kind") == "complexity"]
    solved = [entry for entry in results if entry.get("kind") != "complexity"]
    if len(complexity) > 1:
        raise ValueError(f"Operation counts come from one file, got {len(complexity)}.")
    made = [plot_operations(folder / _OPERATIONS, entry) for entry in complexity]
    for name, plot in _FIGURES.items():
        with suppress(NothingToDrawError):
            made.append(plot(folder / name, solved))
    if not made:
        raise ValueError("The results hold no data for any figure: no data set has a source and outliers to compare.")
    return made
