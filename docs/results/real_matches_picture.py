"""The pictures of the page on real matches: success, time, and what the probability of a pose is worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from kornia_pnpnet.evaluation.figures.style import (
    WIDTH,
    draw_legend,
    log_scale,
    make_figure,
    save,
    solver_styles,
    themed,
)

__all__ = ["find_rows", "plot_real_matches"]

_LEAST = 20  # problems: smaller groups are not drawn
_LOOKS = {  # the same solver told more has the same colour and another marker and line
    "+ratio": {"marker": "s", "linestyle": "--", "markerfacecolor": "white"},
    ":effort=adaptive": {"marker": "^"},
}


def find_rows(results: Mapping[str, Any], kind: str) -> dict[str, dict[str, Mapping[str, Any]]]:
    """The rows of one kind by solver and group."""
    table: dict[str, dict[str, Mapping[str, Any]]] = {}
    for row in results["rows"]:
        if row["kind"] == kind:
            table.setdefault(row["solver"], {})[row["group"]] = row
    return table


@themed
def plot_real_matches(path: str | Path, results: Mapping[str, Any], solvers: Sequence[str]) -> Path:
    """Draw success and time against the share of outliers, and time against the number of pairs, of raw matches.

    Args:
        path: the picture to write.
        results: what ``benchmarks/real_matches.py measure`` wrote.
        solvers: names in the order of the legend.

    Returns:
        The path.
    """
    table = find_rows(results, "no ratio test")
    styles = solver_styles(solvers)
    for name, style in styles.items():
        for part, look in _LOOKS.items():
            style |= look if part in name else {}
    settings = results["settings"]
    shares = [
        (f"{100 * a:.0f}–{100 * b:.0f} %", f"{100 * a:.0f}–{100 * b:.0f}") for a, b in pairwise(settings["shares"])
    ]
    pairs = [(f"{a}–{b - 1} pairs", f"{a}–{b - 1}") for a, b in pairwise(settings["pairs"])]
    panels = (("success", shares, "outliers (%)"), ("ms_per_problem", shares, "outliers (%)"))
    panels += (("ms_per_problem", pairs, "pairs"),)
    figure = make_figure(WIDTH, 3.4, "Raw nearest-neighbour matches, " + settings["split"])
    for axes, (value, groups, label) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        first = next(iter(table.values()))
        groups = [(group, title) for group, title in groups if first[group]["count"] >= _LEAST]
        for name in solvers:
            heights = [table[name][group][value] for group, _ in groups]
            scale = 100 if value == "success" else 1
            axes.plot(np.arange(len(groups)), scale * np.array(heights, dtype=float), **styles[name])
        axes.set_xticks(range(len(groups)), [title for _, title in groups], rotation=40, ha="right")
        axes.set(xlabel=label, title="right poses (%)" if value == "success" else "ms per problem")
        if value != "success":
            log_scale(axes, "y")
    draw_legend(figure, styles)
    return save(figure, path)
