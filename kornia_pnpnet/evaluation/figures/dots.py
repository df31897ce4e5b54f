"""Success rates as dots: a row for each solver, a panel for each set of problems."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.axes import Axes

from kornia_pnpnet.evaluation.figures import style
from kornia_pnpnet.evaluation.figures.records import (
    NothingToDrawError,
    Record,
    in_words,
    limits_in_words,
    outliers_in_words,
    pooled,
    records,
    success_limit,
    usual_n,
)
from kornia_pnpnet.evaluation.figures.style import SMALL, TITLE, WIDTH, SolverStyle
from kornia_pnpnet.metrics import SuccessRate

__all__ = ["plot_scenes", "plot_success", "plot_synthetic"]

_ROW = 0.152  # inches from one solver to the next: a line of small letters
_SCENE_OUTLIERS = 2  # as in the paper
_NUMBERS = 11  # letters of the space for the numbers of a panel
_PANELS_PER_LINE, _SCENES_PER_LINE = 3, 5


class _Panel(NamedTuple):
    """One set of problems: success by solver, and whether numbers stand beside the dots."""

    title: str
    rates: Mapping[str, SuccessRate]
    numbers: bool = True


class _Line(NamedTuple):
    """Panels side by side, and their common title."""

    panels: Sequence[_Panel]
    title: str = ""


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
    rates: dict[str, dict[str, SuccessRate]] = {name: {} for name in results["data"]}
    for row in results["rows"]:
        rates[row["data"]][row["solver"]] = SuccessRate(**row["success"])
    if not results["rows"]:
        raise NothingToDrawError("The results have no rows to draw.")
    limit = limits_in_words(success_limit(entry) for entry in results["data"].values())
    panels = [_Panel(name, by_name) for name, by_name in rates.items()]
    return _draw(
        path,
        ["Success with 95 % intervals", f"{limit}."],
        _lines(panels, _PANELS_PER_LINE),
        style.solver_styles(results["solvers"]),
    )


def plot_synthetic(path: str | Path, results: Sequence[Mapping[str, Any]], source: str = "paper") -> Path:
    """Draw success on synthetic data without and with outliers: figures 2 and 3 of the protocol.

    The panels are no outliers, 0 to a third of the pairs, and a third, at n = 9 or the smallest n of the results.

    Args:
        path: See :func:`plot_success`.
        results: results files of :func:`~kornia_pnpnet.evaluation.evaluate`.
        source: ``paper`` or ``gaussian_pose``.

    Returns:
        The path.

    Raises:
        ValueError: when the results have no such problems.
    """
    everything = records(results)
    here = [record for record in everything if record.source == source and not (record.swept or record.mismatches)]
    if not here:
        raise NothingToDrawError(f"The results hold no success on '{source}'.")
    n = usual_n(here)
    here = [record for record in here if record.n == n and record.outliers in (0, "uniform", n // 3)]
    rates = {setting: _by_solver(r for r in here if r.outliers == setting) for setting in (0, "uniform", n // 3)}
    panels = [_Panel(outliers_in_words(setting, n), by_solver) for setting, by_solver in rates.items() if by_solver]
    if not panels:
        raise NothingToDrawError(f"The results hold no success on '{source}' with none, uniform or {n // 3} outliers.")
    heading = (f"Success on {style.SOURCES.get(source, source)}, n = {n}", in_words(here))
    return _draw(path, heading, [_Line(panels)], style.solver_styles(r.solver for r in everything))


def plot_scenes(path: str | Path, results: Sequence[Mapping[str, Any]]) -> Path:
    """Draw success on scenes, over all scenes and for each: figure 4 of the protocol.

    The panels are without outliers and with two, at n = 9 or the smallest n of the results. A solver has a dot over all
    scenes when it solved all of them.

    Args:
        path: See :func:`plot_success`.
        results: See :func:`plot_synthetic`.

    Returns:
        The path.

    Raises:
        ValueError: when the results have no such scenes.
    """
    everything = records(results)
    here = [r for r in everything if r.scene and not (r.swept or r.mismatches) and r.outliers in (0, _SCENE_OUTLIERS)]
    if not here:
        raise NothingToDrawError(f"The results hold no success on scenes with 0 or {_SCENE_OUTLIERS} outliers.")
    n = usual_n(here)
    here = [record for record in here if record.n == n]
    lines = []
    for setting in (0, _SCENE_OUTLIERS):
        chosen = [record for record in here if record.outliers == setting]
        scenes = list(dict.fromkeys(record.source for record in chosen))
        panels = [_Panel(name, _by_solver(r for r in chosen if r.source == name), len(scenes) <= 2) for name in scenes]
        if len(scenes) > 1:
            panels.insert(0, _Panel(f"all {len(scenes)} scenes", pooled(chosen, scenes)))
        lines += _lines(panels, _SCENES_PER_LINE + 1, outliers_in_words(setting, n)) if panels else []
    heading = (f"Success on scenes, n = {n}", in_words(here))
    return _draw(path, heading, lines, style.solver_styles(r.solver for r in everything))


def _by_solver(chosen: Iterable[Record]) -> dict[str, SuccessRate]:
    return {record.solver: record.success for record in chosen}


def _lines(panels: Sequence[_Panel], most: int, title: str = "") -> list[_Line]:
    """The panels in lines of about equal length, at most ``most`` in a line."""
    size = math.ceil(len(panels) / math.ceil(len(panels) / most))
    return [_Line(panels[i : i + size], title if i == 0 else "") for i in range(0, len(panels), size)]


def _draw(path: str | Path, heading: Sequence[str], lines: Sequence[_Line], styles: Mapping[str, SolverStyle]) -> Path:
    """Draw lines of panels; all panels have the same rows."""
    there = {solver for line in lines for panel in line.panels for solver in panel.rates}
    rows = _Rows.of({name: look for name, look in styles.items() if name in there})
    columns = max(len(line.panels) for line in lines)
    figure = style.make_figure(WIDTH, 0.4 + (_ROW * rows.total + 0.75) * len(lines))
    style.head(figure, *heading)
    ratios = [2 if all(line.panels[i].numbers for line in lines if i < len(line.panels)) else 1 for i in range(columns)]
    grid = figure.subplots(len(lines), columns, sharey=True, squeeze=False, width_ratios=ratios)
    room = style.LETTERS - max(len(style.shortened(name)) for name in rows.solvers)
    room -= _NUMBERS * sum(panel.numbers for panel in lines[0].panels)
    for line, places in zip(lines, grid, strict=True):
        for axes, panel, ratio in zip(places, line.panels, ratios, strict=False):
            _draw_panel(axes, panel, rows, (0, 50, 100) if columns > _PANELS_PER_LINE else range(0, 101, 25))
            letters = room * ratio // sum(ratios) + _NUMBERS * panel.numbers
            axes.set_title(style.wrapped(panel.title, letters), fontsize=SMALL, parse_math=False)
        for axes in places[len(line.panels) :]:
            axes.remove()
        places[0].set_ylabel(line.title, fontsize=TITLE, fontweight="bold")
        _name_rows(places[0], rows)
    return style.save(figure, path)


class _Rows(NamedTuple):
    """The row of each solver and of each title of a group, counted from the top."""

    total: int
    styles: Mapping[str, SolverStyle]
    solvers: Mapping[str, int]
    groups: Mapping[str, int]

    @classmethod
    def of(cls, styles: Mapping[str, SolverStyle]) -> _Rows:
        titled = len({look.group for look in styles.values()}) > 1
        solvers: dict[str, int] = {}
        groups: dict[str, int] = {}
        for name, look in styles.items():
            title = style.GROUPS[look.group]
            if titled and title not in groups:
                groups[title] = len(solvers) + len(groups)
            solvers[name] = len(solvers) + len(groups)
        return cls(len(solvers) + len(groups), styles, solvers, groups)


def _name_rows(axes: Axes, rows: _Rows) -> None:
    """Write the names of solvers and groups to the left of the first panel."""
    named = [*rows.groups.items(), *rows.solvers.items()]
    axes.set_yticks([row for _, row in named], [style.shortened(name) for name, _ in named], parse_math=False)
    for label in axes.get_yticklabels()[: len(rows.groups)]:
        label.set(style="italic", color=style.GREY)
    for label, solver in zip(axes.get_yticklabels()[len(rows.groups) :], rows.solvers, strict=True):
        label.set(fontweight="bold" if rows.styles[solver].ours else "normal")


def _draw_panel(axes: Axes, panel: _Panel, rows: _Rows, ticks: Sequence[int]) -> None:
    """Draw one panel."""
    axes.hlines(list(rows.solvers.values()), 0, 100, colors="#eeeeee", linewidths=0.6, zorder=0)
    for solver, rate in panel.rates.items():
        look, row = rows.styles[solver], rows.solvers[solver]
        value, low, high = 100 * rate.rate, 100 * rate.low, 100 * rate.high
        if look.bound:
            axes.axvline(value, color=look.colour, linestyle=look.dash, linewidth=0.9, zorder=1)
        # A rate of the file is rounded, so a bound can lie just inside.
        reach = [[max(0.0, value - low)], [max(0.0, high - value)]]
        dot = {"color": look.colour, "linestyle": "none", **look.dot(), "marker": look.marker or "|", "clip_on": False}
        dot["markersize"] *= 0.85  # smaller than in other pictures, so that the interval shows
        axes.errorbar([value], [row], xerr=reach, label=solver, elinewidth=1.6, **dot)
        if panel.numbers:
            # To the right of the panel, where no dots are.
            place: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
            font: dict[str, Any] = {"fontsize": SMALL, "ha": "right", "va": "center_baseline"}
            axes.annotate(f"{value:.1f}", (1, row), (28, 0), fontweight="bold" if look.ours else None, **place, **font)
            axes.annotate(f"±{max(reach)[0]:.1f}", (1, row), (50, 0), color=style.GREY, **place, **font)
    axes.set(xlim=(-3, 103), xticks=ticks, xlabel="solved (%)")
    axes.set_ylim(rows.total - 0.4, -0.6)
    style.tidy(axes, grid="x")
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
