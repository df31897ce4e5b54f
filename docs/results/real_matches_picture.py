"""The pictures of the page on real matches: success, time, and what the probability of a pose is worth."""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from figures import draw_legend, solver_styles

from kornia_pnpnet.evaluation.plots import WIDTH, log_scale, make_figure, save, themed

__all__ = ["find_rows", "plot_real_matches"]

_LOOKS = {  # a solver with more inputs keeps its colour and has another marker and line
    "+ratio": {"marker": "s", "linestyle": "--", "markerfacecolor": "white"},
    ":adaptive": {"marker": "^"},
}


def find_rows(results: Mapping[str, Any], kind: str) -> dict[str, dict[str, Mapping[str, Any]]]:
    """The rows of one kind by solver and group."""
    table: dict[str, dict[str, Mapping[str, Any]]] = {}
    for row in results["rows"]:
        if row["kind"] == kind:
            table.setdefault(row["solver"], {})[row["group"]] = row
    return table


@themed
def plot_real_matches(path: str | Path, results: Mapping[str, Any], costs: Mapping[str, Any]) -> Path:
    """Draw success and time against the share of outliers, and time against the number of pairs, of raw matches.

    ``results`` and ``costs`` are what ``benchmarks/real_matches.py measure`` and ``cost`` wrote; the solvers of
    ``costs`` are drawn.
    """
    table = find_rows(results, "no ratio test")
    times = {(row["solver"], row["group"]): row["ms_per_problem"] for row in costs["rows"]}
    solvers = costs["settings"]["solvers"]
    shown = {name: re.sub(r",?\w+_iterations=\d+|:threshold=\d+|effort=", "", name) for name in solvers}
    styles = solver_styles(shown.values())
    for name, style in styles.items():
        for part, look in _LOOKS.items():
            style |= look if part in name else {}
    shares, pairs = (list(pairwise(costs["settings"][key])) for key in ("shares", "pairs"))
    by_share = {f"{100 * a:.0f}–{100 * b:.0f} %": f"{100 * a:.0f}–{100 * b:.0f}" for a, b in shares}
    by_pairs = {f"{a}–{b - 1} pairs": f"{a}–{b - 1}" for a, b in pairs}
    figure = make_figure(WIDTH, 3.6, "Nearest-neighbour matches without a ratio test")
    plots = ("success", by_share, "outliers (%)"), ("ms", by_share, "outliers (%)"), ("ms", by_pairs, "pairs")
    for axes, (value, groups, label) in zip(figure.subplots(1, 3), plots, strict=True):
        there = [group for group in groups if (solvers[0], group) in times]
        for name in solvers:
            heights = [100 * table[name][g]["success"] if value == "success" else times[name, g] for g in there]
            axes.plot(np.arange(len(there)), heights, **styles[shown[name]])
        axes.set_xticks(range(len(there)), [groups[group] for group in there], rotation=40, ha="right")
        axes.set(xlabel=label, title="right poses (%)" if value == "success" else "ms per problem")
        if value == "ms":
            log_scale(axes, "y")
    draw_legend(figure, styles)
    return save(figure, path)
