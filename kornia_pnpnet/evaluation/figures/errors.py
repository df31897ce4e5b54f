"""Distributions of the pose errors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from kornia_pnpnet.evaluation.figures.lines import list_curves
from kornia_pnpnet.evaluation.figures.records import NothingToDrawError
from kornia_pnpnet.evaluation.figures.style import (
    GREY,
    SMALL,
    WIDTH,
    SolverStyle,
    head,
    make_figure,
    save,
    solver_styles,
    tidy,
)
from kornia_pnpnet.evaluation.results import row_errors

__all__ = ["plot_errors"]


def plot_errors(path: str | Path, results: Mapping[str, Any]) -> Path:
    """Draw the share of problems with an error of at most x: a row of two panels for each data set.

    Args:
        path: the picture to write; the ending gives the format.
        results: a results file of :func:`~kornia_pnpnet.evaluation.evaluate`.

    Returns:
        The path.

    Raises:
        ValueError: when there are no rows.
    """
    sets, looks = list(dict.fromkeys(row["data"] for row in results["rows"])), solver_styles(results["solvers"])
    if not sets:
        raise NothingToDrawError("The results have no rows to draw.")
    figure = make_figure(WIDTH, 1.2 + 2.4 * len(sets))
    head(figure, "Problems with an error of at most x", "Dashed: what counts as solved.")
    grid = figure.subplots(len(sets), 2, squeeze=False, sharey=True)
    drawn: set[str] = set()
    for name, panels in zip(sets, grid, strict=True):
        entry = results["data"][name]
        errors = {row["solver"]: row_errors(row)[0] for row in results["rows"] if row["data"] == name}
        drawn |= errors.keys()
        unit = f" ({entry['unit']})" if entry["unit"] else ""
        limits = (entry["max_rotation_deg"], entry["max_translation"])
        labels = ("rotation error (°)", f"translation error{unit}")
        for axes, index, limit, label in zip(panels, (0, 1), limits, labels, strict=True):
            sharp = min(error[index].quantile(0.02).item() for error in errors.values()) < limit / 100
            left, right = limit / (1000 if sharp else 100), 180.0 if index == 0 else limit * 100
            axes.set(xscale="log", xlim=(left, right), ylim=(0, 101), xlabel=label)
            axes.xaxis.set_major_formatter("{x:g}")
            axes.axvline(limit, color=GREY, linewidth=1.2, linestyle=(0, (4, 3)))
            tidy(axes)
            for place, (solver, look) in enumerate(looks.items()):
                if solver in errors:
                    _draw_shares(axes, errors[solver][index].numpy(), solver, look, 0.01 * place)
        panels[0].set(ylabel="problems (%)")
        panels[0].set_title(name, fontsize=SMALL, parse_math=False, loc="left")
    list_curves(figure, {solver: look for solver, look in looks.items() if solver in drawn})
    return save(figure, path)


def _draw_shares(axes: Axes, errors: np.ndarray, solver: str, look: SolverStyle, shift: float) -> None:
    """Draw the share of errors up to x. Markers stand at equal distances, moved along the curve by ``shift``."""
    left, right = axes.get_xlim()
    errors = np.sort(errors)
    share = 100 * np.arange(len(errors) + 1) / len(errors)
    # The curve reaches both edges for any errors.
    ends = np.concatenate((errors[:1].clip(max=left), errors, errors[-1:].clip(min=right)))
    axes.step(ends, [*share, share[-1]], where="post", label=solver, markevery=(shift, 0.15), **look.line())
