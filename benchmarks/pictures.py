"""The pictures of ``docs/performance.md``."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from kornia_pnpnet.evaluation.plots import WIDTH, make_figure, save, themed

sys.path.append(str(Path(__file__).resolve().parents[1] / "docs" / "results"))
import figures as style

# Lines by the end of a name, which says how the solver runs. Without such an end the line is dashed.
_WAYS = {" compiled": "-", " compiled whole": ":", " ONNX": "-.", " packaged": ":"}
_LAST_SHARE = 0.99  # share of the calls drawn; other programs delayed the slowest


def plot_times(
    path: Path, title: str, panels: Mapping[str, Sequence[Mapping[str, Any]]], *, against: str, label: str
) -> Path:
    """Draw the time per problem against a column of the rows, one panel for each list of rows."""
    tables = {name: pd.DataFrame(rows).assign(solver=lambda table: table.contender) for name, rows in panels.items()}
    columns = {"median_us": "us", against: label}
    curves = [(name, table.rename(columns=columns), "us") for name, table in tables.items()]
    return style.draw_curves(path, [title], curves, label, _looks(pd.concat(tables.values()).contender))


@themed
def plot_latency(path: Path, title: str, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Draw the share of the calls with one problem that end within a time, without the slowest hundredth."""
    looks = _looks(row["contender"] for row in rows)
    figure = make_figure(WIDTH, 4.8, title)
    axes = figure.subplots()
    for name, look in looks.items():
        for row in (row for row in rows if row["contender"] == name):
            shares = np.linspace(0, 1, len(row["quantiles_us"]))
            kept = shares <= _LAST_SHARE
            x, y = np.array(row["quantiles_us"])[kept] / 1e3, 100 * shares[kept]
            axes.plot(x, y, **look, markevery=max(1, len(x) // 5))
    axes.set(xlabel="ms for one problem", ylabel="calls done (%)", ylim=(0, 100))
    style.log_scale(axes, "x")
    style.draw_legend(figure, looks)
    return save(figure, path)


def _looks(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Styles in order: a solver, and behind it the ways in which it also runs."""
    there = set(names)
    bases = {next((name.removesuffix(way) for way in _WAYS if name.endswith(way)), name) for name in there}
    found = {}
    for base, look in style.solver_styles(bases).items():
        for way, line in {"": "--", **_WAYS}.items():
            if base + way in there:
                alone = not any(base + way in there for way in _WAYS)
                shape = look["color"], look["marker"], look["linestyle"] if alone else line
                found[base + way] = style.line_style(*shape, ours=style.is_ours(base) and line != "--")
    return found
