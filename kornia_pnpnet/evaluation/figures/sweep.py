"""Success and time of a sweep of short trainings, against n and against m."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, NamedTuple

from matplotlib.axes import Axes

from kornia_pnpnet.core.schema import read_column, read_rows
from kornia_pnpnet.evaluation.figures import style
from kornia_pnpnet.evaluation.figures.lines import Curve, draw_rates, few_ticks, list_curves, make_panels
from kornia_pnpnet.evaluation.figures.style import GREY, SMALL, SolverStyle

__all__ = ["mix_in_words", "plot_sweep"]

_NAMES = {"n": "pairs n", "m": "iterations m"}
_LOOKS = tuple(
    SolverStyle(1, colour, marker, True, dash)
    for colour, marker, dash in (
        (style.GREEN, "o", "-"),
        (style.BLUE, "s", (0, (4, 2))),
        (style.RED, "^", (0, (5, 1.5, 1, 1.5))),
        (style.PURPLE, "D", (0, (2, 1))),
    )
)
_TIME, _TIME_LOOK = "µs per problem (right)", SolverStyle(1, GREY, "x", False, (0, (1, 1.3)))


class _Run(NamedTuple):
    """A row of the summary: microseconds per problem, and success in per cent with its interval."""

    n: int
    m: int
    mix: float
    us: float
    rate: float
    low: float
    high: float


def _per_cent(text: str) -> float:
    return 100 * float(text)


#: The columns of the fields of a run, in their order.
_COLUMNS: dict[str, Callable[[str], Any]] = {
    "model.n": int,
    "model.m": int,
    "data.outliers.max_ratio": float,
    "us_per_problem": float,
    **{f"uniform/{name}": _per_cent for name in ("rate", "low", "high")},
}


def mix_in_words(max_ratio: float) -> str:
    """The mix of outliers with a largest share, in words.

    Example:
        >>> mix_in_words(0.0), mix_in_words(0.33)
        ('no wrong pairs', '0 to ⌊n/3⌋ pairs wrong')
    """
    share = Fraction(max_ratio).limit_denominator(10)
    if not share:
        return "no wrong pairs"
    most = "n" if share.numerator == 1 else f"{share.numerator}n"
    return f"0 to ⌊{most}/{share.denominator}⌋ pairs wrong"


def plot_sweep(path: str | Path, summary_csv: str | Path, *, against: Literal["n", "m"]) -> Path:
    """Draw the success of trained networks against n or m: a panel for each value of the other, a line for each mix.

    The axis on the right is time: the least over the mixes, which do not change the time.

    Args:
        path: the picture to write; the ending gives the format.
        summary_csv: the summary of ``train.py -m experiment=sweep``, with the columns ``model.n``, ``model.m``,
            ``data.outliers.max_ratio``, ``us_per_problem`` and ``uniform/rate``, ``/low``, ``/high``. Each run is
            tested on the mix of outliers of its training.
        against: the horizontal axis.

    Returns:
        The path.

    Raises:
        ValueError: when a column is missing, there are no rows, or two rows have the same n, m and mix.
    """
    runs = _read(summary_csv)
    other = "m" if against == "n" else "n"
    looks = {mix: _LOOKS[index % len(_LOOKS)] for index, mix in enumerate(sorted({run.mix for run in runs}))}
    slowest = max(run.us for run in runs)
    panels = sorted({getattr(run, other) for run in runs})
    figure, grid = make_panels(len(panels))
    for axes, value in zip(grid, panels, strict=True):
        here = sorted((run for run in runs if getattr(run, other) == value), key=lambda run: getattr(run, against))
        times: dict[int, float] = {}
        for run in here:
            times[getattr(run, against)] = min(run.us, times.get(getattr(run, against), run.us))
        curves = []
        for mix, look in looks.items():
            line = [run for run in here if run.mix == mix]
            rates = ([getattr(run, name) for run in line] for name in (against, "rate", "low", "high"))
            curves.append(Curve(mix_in_words(mix), look, *rates))
        draw_rates(axes, curves)
        _draw_times(axes, times, slowest)
        axes.set(xlabel=_NAMES[against])
        axes.set_title(f"{other} = {value}", fontsize=SMALL, loc="left")
    style.head(
        figure,
        f"Success of short trainings against {against}",
        "Each network is tested on the mix of wrong pairs that it was trained on. 95 % intervals.",
    )
    list_curves(figure, {**{mix_in_words(mix): look for mix, look in looks.items()}, _TIME: _TIME_LOOK})
    few_ticks(figure, {axes: {getattr(run, against) for run in runs} for axes in grid})
    return style.save(figure, path)


def _draw_times(axes: Axes, times: Mapping[int, float], slowest: float) -> None:
    """Draw microseconds on an axis on the right, behind the curves of success."""
    right = axes.twinx()
    axes.set_zorder(right.get_zorder() + 1)
    axes.patch.set_visible(False)  # it would hide the time
    right.plot(list(times), list(times.values()), label=_TIME, **_TIME_LOOK.line())
    place = axes.get_subplotspec()
    low, high = (share / 100 * slowest for share in axes.get_ylim())  # aligns the zeros of both axes
    right.set(ylim=(low, high), ylabel="µs per problem" if place is None or place.is_last_col() else "")
    right.spines[["top", "left"]].set_visible(False)
    right.tick_params(labelsize=SMALL, colors=GREY)
    right.yaxis.label.set(fontsize=SMALL, color=GREY)


def _read(path: str | Path) -> list[_Run]:
    rows = read_rows(path)
    columns = [read_column(path, rows, name, read) for name, read in _COLUMNS.items()]
    runs = [_Run(*values) for values in zip(*columns, strict=True)]
    if len({run[:3] for run in runs}) < len(runs):
        raise ValueError(f"'{path}' has several runs with the same n, m and mix of wrong pairs.")
    return runs
