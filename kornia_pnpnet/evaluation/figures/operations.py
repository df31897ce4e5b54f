"""Operation counts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from kornia_pnpnet.evaluation.figures import style
from kornia_pnpnet.evaluation.figures.lines import Curve, few_ticks, name_curves
from kornia_pnpnet.evaluation.figures.style import SMALL, WIDTH

__all__ = ["plot_operations"]


def plot_operations(path: str | Path, complexity: Mapping[str, Any]) -> Path:
    """Draw the operations of a solver for one problem of n pairs: figure 1 of the protocol.

    Args:
        path: the picture to write; the ending gives the format.
        complexity: ``n``, numbers of pairs; ``counts``, by solver one operation count for each n, or ``None``;
            ``ransac``, the names of the solvers of the second panel.

    Returns:
        The path.

    Raises:
        ValueError: when there is no solver, or the counts of a solver are not one for each n.
    """
    n, sampled = list(complexity["n"]), set(complexity["ransac"])
    counts = {name: np.array(values, dtype=float) for name, values in complexity["counts"].items()}
    if not n or not counts:
        raise ValueError("There are no operation counts to draw.")
    for name, values in counts.items():
        if len(values) != len(n):
            raise ValueError(f"There are {len(n)} numbers of pairs, but {len(values)} operation counts of '{name}'.")
    looks = style.solver_styles(counts)
    titles = {False: "without RANSAC", True: "with RANSAC"}
    groups = {title: [name for name in looks if (name in sampled) == which] for which, title in titles.items()}
    groups = {title: names for title, names in groups.items() if names}

    figure = style.make_figure(WIDTH, 3.6)
    panels = {}
    grid = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for axes, (title, names) in zip(grid, groups.items(), strict=True):
        curves = []
        for name in names:
            here = np.isfinite(counts[name])
            curves.append(Curve(name, looks[name], np.array(n)[here].tolist(), counts[name][here].tolist()))
            axes.plot(n, counts[name], label=name, markevery=max(1, len(n) // 6), **looks[name].line())
        axes.set(yscale="log", xlabel="pairs n")
        axes.set_title(title, fontsize=SMALL, loc="left")
        style.tidy(axes)
        panels[axes] = curves
    next(iter(panels)).set(ylabel="operations")
    style.head(figure, "Operations that a problem of n pairs takes")
    name_curves(figure, panels)
    round_places = [place for place in n if place % 10 == 0 or place in (n[0], n[-1])]
    few_ticks(figure, dict.fromkeys(panels, round_places))
    return style.save(figure, path)
