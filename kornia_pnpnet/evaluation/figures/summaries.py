"""Success rates and pose errors of one results file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import seaborn as sns
from matplotlib import rc_context

from kornia_pnpnet.evaluation.figures.panels import draw_dots
from kornia_pnpnet.evaluation.figures.records import NothingToDrawError, limits_in_words, percent, success_limit
from kornia_pnpnet.evaluation.figures.style import (
    GREY,
    THEME,
    WIDTH,
    draw_legend,
    log_scale,
    make_figure,
    save,
    solver_styles,
)
from kornia_pnpnet.evaluation.results import row_errors

_SMALLEST = 1e-12  # an error of 0 has no place on a logarithmic axis


@rc_context(THEME)
def plot_success(path: str | Path, results: Mapping[str, Any]) -> Path:
    """Draw the success rates of all solvers on all data sets, with their 95 % intervals.

    Args:
        path: the picture to write; the ending gives the format.
        results: a results file of :func:`~kornia_pnpnet.evaluation.evaluate`.

    Returns:
        The path.

    Raises:
        ValueError: when there are no rows.
    """
    if not results["rows"]:
        raise NothingToDrawError("The results have no rows to draw.")
    rows = [(row["data"], row["solver"], *percent(row["success"])) for row in results["rows"]]
    table = pd.DataFrame(rows, columns=["data", "solver", "rate", "low", "high", "total"])
    limits = limits_in_words(success_limit(entry) for entry in results["data"].values())
    return draw_dots(path, ["Success with 95 % intervals", limits], [dict(list(table.groupby("data", sort=False)))], 3)


@rc_context(THEME)
def plot_errors(path: str | Path, results: Mapping[str, Any]) -> Path:
    """Draw the share of problems with an error of at most x: a row of two panels for each data set.

    Args:
        path: See :func:`plot_success`.
        results: See :func:`plot_success`.

    Returns:
        The path.

    Raises:
        ValueError: when there are no rows.
    """
    sets = list(dict.fromkeys(row["data"] for row in results["rows"]))
    if not sets:
        raise NothingToDrawError("The results have no rows to draw.")
    styles = solver_styles(row["solver"] for row in results["rows"])
    heading = "Problems with an error of at most x", "Vertical line: limit of a success."
    figure = make_figure(WIDTH, 1.2 + 2.4 * len(sets), *heading)
    for name, panels in zip(sets, figure.subplots(len(sets), 2, squeeze=False, sharey=True), strict=True):
        entry = results["data"][name]
        errors = {row["solver"]: row_errors(row)[0] for row in results["rows"] if row["data"] == name}
        unit = f" ({entry['unit']})" if entry["unit"] else ""
        kinds = (
            (entry["max_rotation_deg"], "rotation error (°)"),
            (entry["max_translation"], f"translation error{unit}"),
        )
        for index, (axes, (limit, label)) in enumerate(zip(panels, kinds, strict=True)):
            for place, (solver, look) in enumerate(styles.items()):
                if solver in errors:
                    values = errors[solver][index].clamp(_SMALLEST).numpy()
                    marks = {"label": solver, "markevery": (0.01 * place, 0.15)}
                    sns.ecdfplot(x=values, stat="percent", log_scale=True, ax=axes, **marks, **look)
            sharp = min(error[index].quantile(0.02).item() for error in errors.values()) < limit / 100
            axes.set(xlim=(limit / (1000 if sharp else 100), 180.0 if index == 0 else limit * 100), ylim=(0, 101))
            axes.set(xlabel=label, ylabel="problems (%)")
            axes.axvline(limit, color=GREY, linewidth=1.2)
            log_scale(axes.xaxis)
        panels[0].set_title(name)
    draw_legend(figure, styles)
    return save(figure, path)
