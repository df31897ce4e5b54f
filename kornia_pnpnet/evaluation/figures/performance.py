"""Times against the batch size or the number of pairs, and the distribution of the times of single calls."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter

from kornia_pnpnet.evaluation.figures import style
from kornia_pnpnet.evaluation.figures.lines import list_curves
from kornia_pnpnet.evaluation.figures.style import SMALL, WIDTH, SolverStyle

__all__ = ["plot_latency", "plot_times"]

# Line styles by the end of a name, which says how the solver runs.
_WAYS = {" compiled": "-", " compiled whole": (0, (1, 1.3)), " ONNX": (0, (5, 1.5, 1, 1.5))}
_DASHED = (0, (4, 2))
_LAST_SHARE = 0.99  # share of the calls drawn; other programs delayed the slowest


def plot_times(
    path: str | Path, title: str, panels: Mapping[str, Sequence[Mapping[str, Any]]], *, against: str, label: str
) -> Path:
    """Draw the time per problem against a column of the rows, one curve for each contender.

    Args:
        path: the picture to write; the ending gives the format.
        title: title above all panels.
        panels: rows by the title of the panel, with ``contender``, ``median_us`` and the column ``against``.
        against: column of the horizontal axis.
        label: label of the horizontal axis.

    Returns:
        The path.

    Raises:
        ValueError: when there is nothing to draw.
    """
    looks = _looks(row["contender"] for rows in panels.values() for row in rows)
    figure = style.make_figure(WIDTH, 4.2)
    grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (heading, rows) in zip(grid, panels.items(), strict=True):
        for name, look in looks.items():
            mine = sorted((row for row in rows if row["contender"] == name), key=lambda row: row[against])
            if mine:
                axes.plot([row[against] for row in mine], [row["median_us"] for row in mine], **look.line())
        axes.set(xscale="log", xlabel=label)
        places = sorted({row[against] for row in rows})
        axes.set_xticks(places, [f"{place:,}" for place in places])
        axes.set_xticks([], minor=True)
        axes.set_title(heading, fontsize=SMALL, loc="left")
        _logarithmic_time(axes.yaxis, axes)
    grid[0].set(ylabel="µs per problem")
    style.head(figure, title)
    list_curves(figure, looks)
    return style.save(figure, path)


def plot_latency(path: str | Path, title: str, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Draw the share of the calls with one problem that end within a time, without the slowest hundredth.

    Args:
        path: See :func:`plot_times`.
        title: See :func:`plot_times`.
        rows: rows with ``contender`` and ``quantiles_us``, the quantiles of the times at equally spaced shares.

    Returns:
        The path.

    Raises:
        ValueError: when there is nothing to draw.
    """
    looks = _looks(row["contender"] for row in rows)
    figure = style.make_figure(WIDTH, 4.2)
    axes = figure.subplots()
    for name, look in looks.items():
        for row in rows:
            if row["contender"] == name:
                last = len(row["quantiles_us"]) - 1
                shares = [index / last for index in range(last + 1)]
                kept = [index for index, share in enumerate(shares) if share <= _LAST_SHARE]
                x, y = [row["quantiles_us"][i] / 1e3 for i in kept], [100 * shares[i] for i in kept]
                axes.plot(x, y, **look.line(), markevery=max(1, len(kept) // 5))
    axes.set(xscale="log", xlabel="ms for one problem", ylabel="calls done (%)", ylim=(0, 100))
    _logarithmic_time(axes.xaxis, axes)
    style.head(figure, title)
    list_curves(figure, looks)
    return style.save(figure, path)


def _looks(names: Iterable[str]) -> dict[str, SolverStyle]:
    """Styles in order. A solver that also runs compiled is open and dashed; each way of compiling has its own line.

    Raises:
        ValueError: when there is no name.
    """
    there = dict.fromkeys(names)
    if not there:
        raise ValueError("There are no times to draw.")
    found = {}
    bases = {name: next((name.removesuffix(way) for way in _WAYS if name.endswith(way)), name) for name in there}
    for base, look in style.solver_styles(set(bases.values())).items():
        ways = {base + way: dash for way, dash in _WAYS.items() if base + way in there}
        if base in there:
            found[base] = look._replace(filled=False, dash=_DASHED) if ways else look
        found |= {name: look._replace(filled=True, dash=dash) for name, dash in ways.items()}
    return found


def _logarithmic_time(axis: Any, axes: Axes) -> None:
    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    axis.set_major_locator(LogLocator())
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())
    style.tidy(axes)
