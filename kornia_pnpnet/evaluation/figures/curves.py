"""Success against the number of mismatches, against n and against m."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from kornia_pnpnet.evaluation.figures import style
from kornia_pnpnet.evaluation.figures.lines import Curve, draw_rates, few_ticks, list_curves, make_panels, name_curves
from kornia_pnpnet.evaluation.figures.records import (
    NothingToDrawError,
    Record,
    in_words,
    outliers_in_order,
    outliers_in_words,
    pooled,
    records,
    usual_n,
    without_m,
)
from kornia_pnpnet.evaluation.figures.style import SMALL, WIDTH, SolverStyle
from kornia_pnpnet.metrics import SuccessRate

__all__ = ["plot_against_m", "plot_against_n", "plot_mismatches"]

_FEWEST_MISMATCHES = 3  # numbers of mismatches of a curve


def plot_mismatches(path: str | Path, results: Sequence[Mapping[str, Any]]) -> Path:
    """Draw success on scenes against the number of mismatches: figure 5 of the protocol.

    The scenes with the most numbers of mismatches are pooled, at n = 9 or the smallest n of the results. A solver that
    solved all these scenes at three numbers or more has a curve. Without sets of mismatches only, the outliers of the
    protocol are drawn.

    Args:
        path: the picture to write; the ending gives the format.
        results: results files of :func:`~kornia_pnpnet.evaluation.evaluate`.

    Returns:
        The path.

    Raises:
        ValueError: when no scene has three numbers of mismatches.
    """
    everything = records(results)
    here = [r for r in everything if r.scene and not r.swept and isinstance(r.outliers, int)]
    kind = any(record.mismatches for record in here)
    here = [record for record in here if record.mismatches == kind or record.outliers == 0]
    n = usual_n(here)
    counts: dict[str, set[int | str]] = {}
    for record in here:
        if record.n == n:
            counts.setdefault(record.source, set()).add(record.outliers)
    most = max(counts.values(), key=len, default=set())
    scenes = [scene for scene, numbers in counts.items() if numbers >= most]
    here = [r for r in here if r.n == n and r.source in scenes and r.outliers in most]
    rates: dict[str, dict[float, SuccessRate]] = {}
    for number in outliers_in_order(here):
        for solver, rate in pooled([r for r in here if r.outliers == number], scenes).items():
            rates.setdefault(solver, {})[float(number)] = rate
    rates = {solver: points for solver, points in rates.items() if len(points) >= _FEWEST_MISMATCHES}
    if len(most) < _FEWEST_MISMATCHES or not rates:
        raise NothingToDrawError(f"The results hold no scenes with {_FEWEST_MISMATCHES} numbers of mismatches.")

    curves = _curves(rates, style.solver_styles(record.solver for record in everything))
    figure = style.make_figure(WIDTH, 4.2)
    axes = figure.subplots()
    draw_rates(axes, curves)
    axes.set(xticks=sorted(map(int, most)), xlabel=f"mismatches among {n} pairs" if kind else f"wrong pairs of {n}")
    names = f"{len(scenes)} scenes" if len(scenes) > 1 else scenes[0]
    style.head(figure, f"Success on {names}, n = {n}", in_words(here))
    name_curves(figure, {axes: curves})
    return style.save(figure, path)


def plot_against_n(path: str | Path, results: Sequence[Mapping[str, Any]]) -> Path:
    """Draw success on the protocol's data against the number of pairs, a panel for each outlier setting.

    Solvers for one n each, such as ``pnpnet-n9`` and ``pnpnet-n20``, make one curve. Other solvers need two n.

    Args:
        path: See :func:`plot_mismatches`.
        results: See :func:`plot_mismatches`.

    Returns:
        The path.

    Raises:
        ValueError: when no outlier setting has two numbers of pairs.
    """
    everything = records(results)
    here = [record for record in everything if record.source == "paper" and not (record.swept or record.mismatches)]
    settings = [s for s in outliers_in_order(here) if len({r.n for r in here if r.outliers == s}) > 1]
    if not settings:
        raise NothingToDrawError("The results hold no success on 'paper' with several n and the same outliers.")
    here = [record for record in here if record.outliers in settings]
    names = _names_over_n(here)
    looks = style.solver_styles([*names.values(), *(record.solver for record in everything)])
    figure, grid = make_panels(len(settings))
    panels = {}
    for axes, setting in zip(grid, settings, strict=True):
        rates: dict[str, dict[float, SuccessRate]] = {}
        for record in here:
            if record.outliers == setting:
                rates.setdefault(names[record.solver, record.n], {})[record.n] = record.success
        rates = {name: points for name, points in rates.items() if len(points) > 1 or looks[name].group == 0}
        panels[axes] = _curves(rates, looks)
        draw_rates(axes, panels[axes])
        axes.set(xscale="log", xlabel="pairs n")
        axes.set_title(outliers_in_words(setting), fontsize=SMALL, loc="left")
    style.head(figure, f"Success on {style.SOURCES['paper']} against the number of pairs", in_words(here))
    return _finish(figure, panels, looks, path)


def _names_over_n(chosen: Iterable[Record]) -> dict[tuple[str, int], str]:
    """The name of the curve of a solver at some n: solvers that differ only in the n of their names share a curve."""
    families: dict[str, set[tuple[str, int]]] = {}
    for record in chosen:
        family = re.sub(rf"-n{record.n}\b", "-n*", record.solver)
        families.setdefault(family, set()).add((record.solver, record.n))
    names = {}
    for family, members in families.items():
        one = len({solver for solver, _ in members}) == 1
        names.update({(solver, n): solver if one else family for solver, n in members})
    return names


def plot_against_m(path: str | Path, results: Sequence[Mapping[str, Any]]) -> Path:
    """Draw success on the protocol's data, and time, against the iterations of the refinement.

    Solvers that differ only in the option m, such as ``epnp-lm`` and ``epnp-lm:m=3``, make one curve; m is read from
    their configurations. n is 9 or the smallest n of the results. The time is of the last outlier setting.

    Args:
        path: See :func:`plot_mismatches`.
        results: See :func:`plot_mismatches`.

    Returns:
        The path.

    Raises:
        ValueError: when no solver has two m.
    """
    everything = records(results)
    here = [r for r in everything if r.source == "paper" and not r.mismatches and r.m is not None]
    n = usual_n(here)
    here = [record for record in here if record.n == n]
    depths: dict[tuple[str, int | str], set[int | None]] = {}
    for record in here:
        depths.setdefault((without_m(record.solver), record.outliers), set()).add(record.m)
    here = [record for record in here if len(depths[without_m(record.solver), record.outliers]) > 1]
    settings = outliers_in_order(here)
    if not settings:
        raise NothingToDrawError("The results hold no success on 'paper' of a solver with several m.")

    looks = style.solver_styles(without_m(record.solver) for record in everything)
    figure, grid = make_panels(len(settings) + 1)
    panels = {}
    for axes, setting in zip(grid, settings, strict=False):
        rates: dict[str, dict[float, SuccessRate]] = {}
        times: dict[str, dict[float, float]] = {}
        for record in here:
            if record.outliers == setting and record.m is not None:
                rates.setdefault(without_m(record.solver), {})[record.m] = record.success
                times.setdefault(without_m(record.solver), {})[record.m] = record.us_per_problem
        panels[axes] = _curves(rates, looks)
        draw_rates(axes, panels[axes])
        axes.set_title(outliers_in_words(setting, n), fontsize=SMALL, loc="left")
    last = grid[-1]
    panels[last] = _draw_times(last, times, looks)
    last.set_title(f"time, {outliers_in_words(settings[-1], n)}", fontsize=SMALL, loc="left")
    for axes in grid:
        axes.set(xlabel="iterations m")
    style.head(figure, f"Success on {style.SOURCES['paper']} against m, n = {n}", in_words(here))
    return _finish(figure, panels, looks, path)


def _finish(
    figure: Figure, panels: Mapping[Axes, Sequence[Curve]], looks: Mapping[str, SolverStyle], path: str | Path
) -> Path:
    """List the curves below the panels, tick their places, and write the picture."""
    drawn = {curve.name for curves in panels.values() for curve in curves}
    list_curves(figure, {name: look for name, look in looks.items() if name in drawn})
    few_ticks(figure, {axes: {int(x) for curve in curves for x in curve.x} for axes, curves in panels.items()})
    return style.save(figure, path)


def _draw_times(
    axes: Axes, times: Mapping[str, Mapping[float, float]], looks: Mapping[str, SolverStyle]
) -> list[Curve]:
    """Draw microseconds per problem, and return the curves."""
    curves = []
    for name, look in looks.items():
        if name in times:
            x = sorted(times[name])
            y = [times[name][place] for place in x]
            curves.append(Curve(name, look, x, y))
            axes.plot(x, y, label=name, **look.line())
    axes.set(yscale="log", ylabel="µs per problem")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    style.tidy(axes)
    return curves


def _curves(rates: Mapping[str, Mapping[float, SuccessRate]], looks: Mapping[str, SolverStyle]) -> list[Curve]:
    return [Curve.of_rates(name, look, rates[name]) for name, look in looks.items() if name in rates]
