"""The figures of the paper's protocol, from results files: ``python docs/results/figures.py a.json --out figures``.

Files are those of ``pnpnet evaluate``, of operation counts (``complexity.json``) and of sweeps (``summary.csv``). Each
figure for which the files hold data is drawn. Each function writes the picture ``path``, whose ending gives the format,
and returns the path.
"""

import argparse
import json
import math
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from functools import partial
from itertools import cycle
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator

from kornia_pnpnet.evaluation import load_results
from kornia_pnpnet.evaluation.plots import COLOURS, WIDTH, log_scale, make_figure, save, themed
from kornia_pnpnet.evaluation.problem_sets import PRIORS
from kornia_pnpnet.metrics import success_rate
from kornia_pnpnet.training.card import HOW_IT_RAN

BLUE, ORANGE, GREEN, VERMILION, PINK, BROWN, _, GREY, _, SKY = COLOURS

# Colour, marker and line of a solver, in the order of the rows. A solver has the look of the longest name that its name
# begins with, up to a hyphen. A bound has no marker.
# fmt: off
_LOOKS = {
    "pnpnet": (BLUE, "o", "-"), "pnpnet-n9-paper": (BROWN, "o", "-"), "pnpnet-paper": (BROWN, "o", "-"),
    "pnpnet-set": (BLUE, "D", "-."), "net": (SKY, "o", "--"),
    "epnp": (VERMILION, "v", "--"), "epnp-lm": (VERMILION, "v", "-"),
    "reppnp": (GREEN, "^", "--"), "reppnp-lm": (GREEN, "^", "-"), "ransac-epnp-lm": (PINK, "s", "-"),
    "p3p-ransac": (ORANGE, "P", "-"), "p3p-ransac-noise": (ORANGE, "D", "--"), "identity-lm": (BROWN, "X", "-."),
    "opencv-epnp": ("k", "<", ":"), "opencv-sqpnp": ("k", "<", "-."), "opencv-ransac": ("k", ">", "-"),
    "opencv-ransac-sqpnp": ("k", "*", "-."), "opencv-usac": ("k", ">", "--"), "opencv": ("k", "*", ":"),
    "kornia-rs": (GREY, "X", ":"), "poselib": (GREY, "p", "-"), "pycolmap": (GREY, "h", "--"),
    "": ("", "", ""),  # all other solvers
    "known-inliers": ("k", "", "-."), "known-inliers-and-noise": ("k", "", ":"),
}
# fmt: on
# A picture of curves has at most _MOST solvers. Those with these beginnings of a name come first; tables have them all.
_MOST = 8
_FIRST = "pnpnet", "poselib", "opencv-ransac", "pycolmap", "p3p-ransac", "epnp-lm", "kornia", "known-inliers", "opencv"
_OTHERS = [(colour, "d", line) for line in ("-", "--", ":") for colour in ("#882255", "#44AA99", "#999933", "#6644AA")]
_LETTERS, _HANDLE = 112, 11  # of a legend: letters across the page, and letters that a piece of line takes
_ROW = 0.165  # inches from one solver to the next: a line of letters
_MOST_TICKS = 6  # largest number of places on a horizontal axis that are all ticked
_LABELS = {"rate": "solved (%)", "us": "µs per problem", "n": "pairs n", "m": "iterations m"}
_LABELS |= {f"model.{name}": _LABELS[name] for name in "nm"}
Styles = Mapping[str, Mapping[str, Any]]  # arguments of Axes.plot by name
Panel = tuple[str, pd.DataFrame, str]


def solver_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Arguments of ``Axes.plot`` by name of the solver, in the order of legends.

    A known solver has the same look in all pictures, with any options. Up to 12 unknown solvers have different looks.
    """
    base = {name: name.partition(":")[0] for name in names}
    known = {n: max((key for key in _LOOKS if f"{b}-".startswith(key and f"{key}-")), key=len) for n, b in base.items()}
    unknown = sorted({base[name] for name, key in known.items() if not key})
    looks = {name: _LOOKS[key] if key else _OTHERS[unknown.index(base[name]) % 12] for name, key in known.items()}
    natural = {name: re.sub(r"\d+", lambda number: number[0].zfill(9), name) for name in base}  # n9 before n20
    order = sorted(base, key=lambda name: (list(_LOOKS).index(known[name]), natural[name]))
    return {name: line_style(*looks[name], ours=is_ours(name)) for name in order}


def line_style(colour: str, marker: str, line: str, *, ours: bool = False) -> dict[str, Any]:
    """Arguments of ``Axes.plot``. Dashed and dotted lines have open markers, our lines are thick."""
    face = "white" if line in ("--", ":") else colour
    marks = {"marker": marker, "markersize": 4.6, "markerfacecolor": face, "markeredgecolor": colour}
    return {"color": colour, "linestyle": line, "linewidth": 2.0 if ours else 1.2, "zorder": 4 if ours else 3, **marks}


def is_ours(name: str) -> bool:
    """Whether the solver stands out."""
    return name.startswith("pnpnet")


def shortened(name: str) -> str:
    """The name; the middle of names above 27 letters is left out."""
    return name if len(name) <= 27 else f"{name[:12]}…{name[-14:]}"


def draw_legend(figure: Figure, styles: Styles) -> None:
    """Write a legend below all panels, our solvers in bold."""
    names = [shortened(name) for name in styles]
    columns = min(4, _LETTERS // (_HANDLE + max(map(len, names))))
    handles = [Line2D([], [], **style) for style in styles.values()]
    legend = figure.legend(handles, names, loc="outside lower center", ncols=columns, handlelength=3.4)
    for text in legend.get_texts():
        text.set_fontweight("bold" if is_ours(text.get_text()) else "normal")


def make_panels(
    count: int, columns: int, heights: tuple[float, float], heading: Sequence[str], *, shared: bool = False
) -> tuple[Figure, list[Axes], int]:
    """A figure with panels in lines of at most ``columns``, and the number of columns that it has.

    ``heights`` in inches: of the page besides the panels, and of a line of panels. ``shared``: the same axes in all.
    """
    lines = math.ceil(count / columns)
    columns = math.ceil(count / lines)
    figure = make_figure(WIDTH, heights[0] + heights[1] * lines, *heading)
    grid = list(figure.subplots(lines, columns, squeeze=False, sharex=shared, sharey=shared).flat)
    for axes in grid[count:]:
        axes.remove()
    return figure, grid[:count], columns


def reach(table: pd.DataFrame) -> np.ndarray:
    """Lengths of the intervals below and above the rates. A rounded rate can lie just outside its interval."""
    return np.clip([table.rate - table.low, table.high - table.rate], 0, None)


@themed
def draw_dots(path: str | Path, heading: Sequence[str], panels: Sequence[Panel]) -> Path:
    """Draw panels of success, see :func:`draw_curves`, with a row for each solver."""
    styles = solver_styles(solver for _, table, _ in panels for solver in table.solver)
    heights = 0.5, _ROW * len(styles) + 0.85
    figure, grid, columns = make_panels(len(panels), 3, heights, heading, shared=True)
    for axes, (title, table, _) in zip(grid, panels, strict=True):
        for name, rate, (low, high) in zip(table.solver, table.rate, reach(table).T, strict=True):
            look, row = styles[name], list(styles).index(name)
            if not look["marker"]:  # a bound is a line across the panel
                axes.axvline(rate, color=look["color"], linestyle=look["linestyle"], linewidth=0.9, zorder=1)
            dot = {**look, "linestyle": "none", "marker": look["marker"] or "|", "clip_on": False}
            axes.errorbar([rate], [row], xerr=[[low], [high]], label=name, elinewidth=1.4, **dot)
            font: dict[str, Any] = {"fontsize": 8, "fontweight": "bold" if is_ours(name) else "normal"}
            font |= {"transform": axes.get_yaxis_transform(), "va": "center_baseline"}
            axes.text(1.04, row, f"{rate:.1f} ±{max(low, high):.1f}", **font)
        axes.set(title=textwrap.fill(title.replace("_", " "), 34), xlabel=_LABELS["rate"])
    grid[0].set_yticks(range(len(styles)), [shortened(name) for name in styles])
    grid[0].set(xlim=(-3, 103), ylim=(len(styles) - 0.4, -0.6), xticks=range(0, 101, 25))
    for axes in grid[::columns]:
        for label, name in zip(axes.get_yticklabels(), styles, strict=True):
            label.set_fontweight("bold" if is_ours(name) else "normal")
    return save(figure, path)


@themed
def draw_curves(
    path: str | Path, heading: Sequence[str], panels: Sequence[Panel], x: str, styles: Styles | None = None
) -> Path:
    """Draw panels of curves against the column ``x``, of at most 8 solvers (``_FIRST`` first), with one legend below.

    A panel is a title, a table with the column ``solver``, and the name of the column on its vertical axis: ``rate`` in
    per cent (with ``low`` and ``high``), ``us`` or ``operations``. Panels with the same vertical axis share its limits.
    """
    solvers = sorted({solver for _, table, _ in panels for solver in table.solver})
    found = sorted(solvers, key=lambda name: [name.startswith(x) for x in (*_FIRST, "")].index(True))[:_MOST]
    styles = {name: look for name, look in (styles or solver_styles(found)).items() if name in found}
    heights = 1.0 + 0.04 * len(styles), 2.4 if len(panels) > 4 else 3.0
    figure, grid, columns = make_panels(len(panels), 4, heights, heading)
    first: dict[str, Axes] = {}
    for index, (axes, (title, table, y)) in enumerate(zip(grid, panels, strict=True)):
        for name, look in styles.items():
            line = table[table.solver == name].sort_values(x)
            error, every = reach(line) if y == "rate" else None, max(1, len(line) // 8)
            if len(line):
                axes.errorbar(line[x], line[y], yerr=error, label=name, elinewidth=1.0, markevery=every, **look)
        places = sorted(table[x].unique())
        log = 0 < 8 * places[0] < places[-1]
        axes.set(title=title, xlabel=_LABELS.get(x, x), xscale="log" if log else "linear")
        if index % columns == 0 or panels[index - 1][2] != y:
            axes.set_ylabel(_LABELS.get(y, y))
        if y in first:
            axes.sharey(first[y])
        first.setdefault(y, axes)
        whole = all(float(place).is_integer() for place in places)
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)) if log else MaxNLocator(_MOST_TICKS, integer=whole))
        if len(places) <= _MOST_TICKS:
            axes.set_xticks(places)
        axes.xaxis.set_major_formatter("{x:,.0f}" if whole else "{x:g}")
        axes.set_xticks([], minor=True)
    for y, axes in first.items():
        if y == "rate":
            axes.set(ylim=(-3, 103), yticks=range(0, 101, 20))
        else:
            log_scale(axes, "y", EngFormatter(sep="") if y == "operations" else "{x:g}")
    draw_legend(figure, styles)
    return save(figure, path)


_KEYS = ["source", "outliers", "mismatches", "n", "solver"]
_RATE = ["rate", "low", "high", "total"]
_SOURCES = {"paper": "the paper's data", "gaussian_pose": "data with Gaussian positions"}
_PROTOCOL_N, _SCENE_OUTLIERS = 9, 2  # as in the paper
_FEWEST_MISMATCHES = 3  # numbers of mismatches of a curve


def read_records(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Read results files. Data sets without a source or outliers are left out.

    ``outliers`` is a number, ``"uniform"`` for 0 to a third of the pairs, or another text. With ``mismatches`` every
    outlier shows another point. ``base`` is the solver's name without the option m; an unknown ``m`` is -1.
    """
    rows, synthetic = [], {name for name, _ in PRIORS.values()}
    for result in results:
        for row in result["rows"]:
            data, solver = result["data"][row["data"]], row["solver"]
            description = data.get("description") or {}
            source, outliers = description.get("source"), description.get("outliers")
            if isinstance(source, str) and isinstance(outliers, int | str):
                outliers = 0 if outliers == "none" else outliers
                mismatches = outliers != 0 and description.get("mismatch_share") == 1
                refine = (result["solvers"][solver].get("config") or {}).get("refine")
                m = refine.get("m") if isinstance(refine, Mapping) else None
                base = re.sub(r"([:,])m=[^,]*(,?)", lambda option: option[1] if option[2] else "", solver)
                key = (source, outliers, mismatches, data["n"], solver, base, base != solver, source not in synthetic)
                limit = [data[key] for key in ("max_rotation_deg", "max_translation", "unit")]
                rows.append((*key, m if type(m) is int else -1, row["us_per_problem"], limit, *percent(row["success"])))
    table = pd.DataFrame(rows, columns=[*_KEYS, "base", "swept", "scene", "m", "us", "limit", *_RATE])
    table = table.astype({"outliers": object, "mismatches": bool, "swept": bool, "scene": bool})
    return table.sort_values("total", kind="stable").drop_duplicates(_KEYS, keep="last").sort_index()


def percent(success: Mapping[str, Any]) -> tuple[float, float, float, int]:
    """Rate and interval of a success in per cent, and the number of problems."""
    return 100 * success["rate"], 100 * success["low"], 100 * success["high"], success["total"]


def pooled(table: pd.DataFrame) -> pd.DataFrame:
    """Success over all scenes of a table with one n and one outlier setting, for solvers that solved all scenes."""
    rows = []
    for solver, parts in table.groupby("solver", sort=False):
        if len(parts) == table.source.nunique():
            solved = (parts.rate * parts.total / 100).round().sum()  # a rate in a file has six digits
            rows.append((solver, *percent(success_rate(torch.arange(parts.total.sum()) < solved)._asdict())))
    return pd.DataFrame(rows, columns=["solver", *_RATE])


def in_words(table: pd.DataFrame) -> str:
    """The limits of a success, and the numbers of problems."""

    def span(values: Iterable[float], form: str) -> str:
        return " to ".join(dict.fromkeys(f"{x:{form}}" for x in (min(values), max(values))))

    limits = pd.DataFrame(list(table.limit), columns=["degrees", "length", "unit"]).replace("", "world units")
    lengths = [f"{span(part.length, '.2g')} {unit}" for unit, part in limits.groupby("unit", sort=False)]
    problems = f"{span(table.total, 'd')} problems in each set, 95 % intervals."
    return f"Solved: errors below {span(limits.degrees, 'g')}° and {' or '.join(lengths)}. {problems}"


def outliers_in_words(outliers: int | str, n: int | str = "n") -> str:
    """The number of outliers among ``n`` pairs, for a title."""
    if outliers in (0, "uniform"):
        return f"0 to {'⌊n/3⌋' if isinstance(n, str) else n // 3} outliers of {n}" if outliers else "no outliers"
    return outliers if isinstance(outliers, str) else f"{outliers} outliers of {n}"


def at_usual_n(table: pd.DataFrame) -> tuple[pd.DataFrame, int]:
    """The rows at the n of a figure that does not vary n: 9 as in the protocol, or the smallest n."""
    n = _PROTOCOL_N if table.empty or (table.n == _PROTOCOL_N).any() else int(table.n.min())
    return table[table.n == n], n


def _by_outliers(table: pd.DataFrame, n: int | str) -> list[Panel]:
    """A panel of rates for each outlier setting: none, uniform, other numbers, other texts."""
    settings = sorted(table.outliers.unique(), key=lambda x: (x != 0, x != "uniform", isinstance(x, str), x))
    return [(outliers_in_words(setting, n), table[table.outliers == setting], "rate") for setting in settings]


class Content(NamedTuple):
    """What a figure shows: panels of curves against the column ``x``, or of dots. ``table`` has all rows."""

    title: str
    table: pd.DataFrame
    panels: list[Panel]
    x: str = ""


def synthetic(records: pd.DataFrame, source: str) -> Content:
    """Success on synthetic data with no outliers, 0 to a third, and a third: figures 2 and 3."""
    table, n = at_usual_n(records.query("source == @source and not swept and not mismatches"))
    table = table[table.outliers.isin([0, "uniform", n // 3])]
    return Content(f"Success on {_SOURCES[source]}, n = {n}", table, _by_outliers(table, n))


def scenes(records: pd.DataFrame) -> Content:
    """Success without and with two outliers over all scenes, and for each scene: figure 4."""
    table = records.query("scene and not swept and not mismatches")
    table, n = at_usual_n(table[table.outliers.isin([0, _SCENE_OUTLIERS])])
    panels = []
    for setting, chosen in table.groupby("outliers"):
        parts = list(chosen.groupby("source", sort=False))
        together = [(f"all {len(parts)} scenes", pooled(chosen))] if len(parts) > 1 else []
        words = outliers_in_words(setting, n)
        panels += [(f"{words}: {name}", part, "rate") for name, part in together + parts]
    return Content(f"Success on scenes, n = {n}", table, panels)


def mismatches(records: pd.DataFrame) -> Content:
    """Success against the number of mismatches: figure 5.

    Success is pooled over the scenes that have the most numbers of mismatches. A solver that solved all these scenes at
    three numbers or more has a curve. Without sets of mismatches the outliers of the protocol are drawn.
    """
    table = records.query("scene and not swept")
    table = table[table.outliers.map(lambda outliers: isinstance(outliers, int)).astype(bool)]
    kind = table.mismatches.any()
    table, n = at_usual_n(table[(table.mismatches == kind) | (table.outliers == 0)])
    counts = table.groupby("source").outliers.agg(set)
    most: set[int] = max(counts, key=len, default=set())
    table = table[table.source.isin(counts.index[counts >= most]) & table.outliers.isin(most)]
    label = f"{'mismatches' if kind else 'outliers'} among {n} pairs"
    parts = [pooled(part).assign(**{label: number}) for number, part in table.groupby("outliers")]
    rates = pd.concat(parts) if parts else table
    rates = rates[rates.groupby("solver").rate.transform("size") >= _FEWEST_MISMATCHES]
    names = table.source.unique()
    title = f"Success on {names[0] if len(names) == 1 else f'{len(names)} scenes'}, n = {n}"
    return Content(title, table, [("", rates, "rate")] if len(rates) else [], label)


def against_n(records: pd.DataFrame) -> Content:
    """Success on the protocol's data against the number of pairs, a panel for each outlier setting.

    Solvers for one n each, such as ``pnpnet-n9`` and ``pnpnet-n20``, make one curve. Others need two n for a curve.
    """
    table = records.query("source == 'paper' and not swept and not mismatches")
    table = table[table.groupby("outliers").n.transform("nunique") > 1]
    names = zip(table.solver, table.n, strict=True)
    table = table.assign(family=[re.sub(rf"-n{n}\b", "-n*", solver) for solver, n in names])
    single = table.groupby("family").solver.transform("nunique") == 1
    table = table.assign(solver=table.solver.where(single, table.family))
    several = table.groupby(["solver", "outliers"]).n.transform("size") > 1
    table = table[several | table.solver.str.match("pnpnet|net")]
    return Content(f"Success on {_SOURCES['paper']} against the number of pairs", table, _by_outliers(table, "n"), "n")


def against_m(records: pd.DataFrame) -> Content:
    """Success on the protocol's data, and time, against the iterations of the refinement.

    Solvers that differ only in the option m, such as ``epnp-lm`` and ``epnp-lm:m=3``, make one curve; m is read from
    their configurations. The time is of the last outlier setting.
    """
    table, n = at_usual_n(records.query("source == 'paper' and m >= 0 and not mismatches"))
    table = table.assign(solver=table.base).drop_duplicates(["solver", "outliers", "m"], keep="last")
    table = table[table.groupby(["solver", "outliers"]).m.transform("size") > 1]
    panels = _by_outliers(table, n)
    panels += [(f"time, {title}", part, "us") for title, part, _ in panels[-1:]]
    return Content(f"Success on {_SOURCES['paper']} against m, n = {n}", table, panels, "m")


def paper_figures(results: Sequence[Mapping[str, Any]], folder: str | Path) -> list[Path]:
    """Draw the protocol's five figures, success against n and success against m, into a folder.

    Figures without data are left out; ``ValueError`` when no figure has data. Of several results with the same source,
    outliers, n and solver, the one with the most problems is drawn, and of these the last. A solver whose name sets m
    is in the figure against m only. ``results`` may have one file of operation counts.
    """
    complexity = [entry for entry in results if entry.get("kind") == "complexity"]
    if len(complexity) > 1:
        raise ValueError(f"Expected at most one file of operation counts, got {len(complexity)}.")
    records = read_records(entry for entry in results if entry.get("kind") != "complexity")
    made = []
    for entry in complexity:  # see `operations.complexity_results`
        counts = pd.DataFrame({"n": entry["n"], **entry["counts"]})
        table = counts.melt("n", var_name="solver", value_name="operations")
        sampled = table.solver.isin(entry["ransac"]).map({False: "without RANSAC", True: "with RANSAC"})
        panels = [(title, part, "operations") for title, part in table.groupby(sampled, sort=False)]
        heading = ["Operations that a problem of n pairs takes"]
        made.append(draw_curves(Path(folder) / "figure1_operations.png", heading, panels, "n"))
    for name, content in {
        "figure2_paper": synthetic(records, "paper"),
        "figure3_gaussian_pose": synthetic(records, "gaussian_pose"),
        "figure4_scenes": scenes(records),
        "figure5_mismatches": mismatches(records),
        "success_against_n": against_n(records),
        "success_against_m": against_m(records),
    }.items():
        if content.panels:
            draw: Any = partial(draw_curves, x=content.x) if content.x else draw_dots
            path, heading = Path(folder) / f"{name}.png", [content.title, in_words(content.table)]
            made.append(draw(path, heading, content.panels))
    if not made:
        raise ValueError("The results hold no data for any figure: no data set has a source and outliers to compare.")
    return made


_SWEEP_LOOKS = ((GREEN, "o", "-"), (BLUE, "s", "--"), (VERMILION, "^", "-."), (PINK, "D", ":"))
_TIME = "least time of the lines"


def mix_in_words(max_ratio: float) -> str:
    """The mix of outliers with a largest share, in words."""
    share = Fraction(max_ratio).limit_denominator(10)
    most = "n" if share.numerator == 1 else f"{share.numerator}n"
    return f"0 to ⌊{most}/{share.denominator}⌋ outliers" if share else "no outliers"


def plot_sweep(path: str | Path, summary_csv: str | Path, *, against: str, data: str = "uniform") -> Path:
    """Draw the success of the runs of a sweep on a validation set, and their time, against an override.

    The first other override that differs between runs has a panel for each value. All further overrides have a line for
    each combination of values. The panels below show the least time over the lines. ``summary_csv`` is the summary of
    ``train.py -m``. ``ValueError`` when ``against`` has not several numbers, when two runs have the same overrides, or
    without the validation set.
    """
    runs, varied, numbers = read_sweep(summary_csv)
    sets = [name.removesuffix("/rate") for name in runs.columns if name.endswith("/rate")]
    for name, known in ((against, numbers), (data, sets)):
        if name not in known:
            raise ValueError(f"'{summary_csv}' has {', '.join(known) or 'nothing'} to draw, and not '{name}'.")
    if runs.duplicated(varied).any():
        raise ValueError(f"'{summary_csv}' has several runs with the same overrides.")
    panel, *others = [name for name in varied if name != against] or [""]
    rates = {name: 100 * runs[f"{data}/{name}"] for name in ("rate", "low", "high")}
    runs = runs.assign(**rates, us=runs.us_per_problem, **{"": ""}).sort_values(varied)
    runs["solver"] = [", ".join(map(in_sweep_words, others, row)) or data for row in runs[others].to_numpy()]
    looks = dict(zip(runs.sort_values(others or [""]).solver.unique(), cycle(_SWEEP_LOOKS), strict=False))
    styles = {name: line_style(*look) for name, look in {**looks, _TIME: (GREY, "X", "-")}.items()}
    parts = [(in_sweep_words(panel, value), part) for value, part in runs.groupby(panel, dropna=False)]
    panels = [(title, part, "rate") for title, part in parts]
    panels += [("", part.groupby(against, as_index=False).us.min().assign(solver=_TIME), "us") for _, part in parts]
    title = f"Success on '{data}' and time of trained networks against {short_name(against)}, with 95 % intervals"
    return draw_curves(path, [title], panels, against, styles)


def read_sweep(summary_csv: str | Path) -> tuple[pd.DataFrame, list[str], list[str]]:
    """The runs of a sweep, the overrides that differ between them, and those overrides that are numbers."""
    runs = pd.read_csv(summary_csv)
    overrides = [name for name in runs.columns[: runs.columns.get_loc("update")] if name not in ("run", *HOW_IT_RAN)]
    varied = [name for name in overrides if runs[name].nunique(dropna=False) > 1]
    return runs, varied, list(runs[varied].dropna(axis=1).select_dtypes("number"))


def in_sweep_words(name: str, value: Any) -> str:
    """An override of a sweep, in words."""
    if name == "data.outliers.max_ratio":
        return mix_in_words(float(value))
    return f"{short_name(name)} = {value}" if name else ""


def short_name(override: str) -> str:
    """The last part of an override's name."""
    return override.rpartition(".")[2]


@themed
def plot_reliability(path: str | Path, curves: Mapping[str, Mapping[str, Sequence[float]]]) -> Path:
    """Draw observed shares against predicted probabilities, and below the number of predictions in each range.

    ``curves`` has the lists of a :class:`~kornia_pnpnet.metrics.Reliability` by name. Empty ranges are left out.
    """
    figure = make_figure(0.72 * WIDTH, 6.0)
    chance, share = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    chance.plot((0, 1), (0, 1), color=GREY, linewidth=1.0, linestyle=":")
    for index, (name, curve) in enumerate(curves.items()):
        lists = np.array([curve[key] for key in ("number", "predicted", "observed")], dtype=float)
        number, predicted, observed = lists[:, lists[0] > 0]
        look = line_style(COLOURS[index % 10], "os^DvP"[index % 6], "-")
        chance.plot(predicted, observed, label=name, **look)
        share.plot(predicted, 100 * number / number.sum(), **look)
    chance.set(ylim=(-0.02, 1.02), xlim=(-0.02, 1.02), ylabel="share of inliers")
    chance.legend(loc="upper left")
    share.set(yscale="log", xlabel="weight: the predicted probability of an inlier", ylabel="pairs (%)")
    share.yaxis.set_major_formatter("{x:g}")
    return save(figure, path)


# A solver with more inputs keeps its colour and has another marker and line.
_RAW_LOOKS = {"+ratio": {"marker": "s", "linestyle": "--", "markerfacecolor": "white"}, "=fixed": {"marker": "^"}}
_RAW_LOOKS |= {"max_iterations=10000,": {"linestyle": ":"}}


def grouped(rows: Iterable[Mapping[str, Any]], *keys: str) -> dict[Any, list[Mapping[str, Any]]]:
    """Rows by one of their entries, or by a tuple of several entries."""
    found: dict[Any, list[Mapping[str, Any]]] = {}
    for row in rows:
        found.setdefault(itemgetter(*keys)(row), []).append(row)
    return found


def find_rows(results: Mapping[str, Any], kind: str) -> dict[str, dict[str, Mapping[str, Any]]]:
    """The rows of one kind by solver and group."""
    solvers = grouped((row for row in results["rows"] if row["kind"] == kind), "solver")
    return {solver: {row["group"]: row for row in rows} for solver, rows in solvers.items()}


@themed
def plot_real_matches(
    path: str | Path, results: Mapping[str, Any], costs: Mapping[str, Any], titles: Mapping[str, str]
) -> Path:
    """Draw success and time of raw matches against the share of outliers, and time against the number of pairs.

    ``results`` and ``costs`` are files of ``benchmarks/real_matches.py measure`` and ``cost``. Solvers of ``costs`` are
    drawn, with their ``titles``.
    """
    table = find_rows(results, "no ratio test")
    times = {(row["solver"], row["group"]): row["ms_per_problem"] for row in costs["rows"]}
    solvers = costs["settings"]["solvers"]
    looks = solver_styles(solvers)
    for name, style in looks.items():
        for part, look in _RAW_LOOKS.items():
            style |= look if part in f"{name}," else {}
    styles = {titles[solver]: looks[solver] for solver in solvers}
    figure = make_figure(WIDTH, 3.6, "Nearest-neighbour matches without a ratio test")
    plots = ("success", " %", "outliers (%)"), ("ms", " %", "outliers (%)"), ("ms", " pairs", "pairs")
    for axes, (value, unit, label) in zip(figure.subplots(1, 3), plots, strict=True):
        there = [group for solver, group in times if solver == solvers[0] and group.endswith(unit)]
        for name in solvers:
            heights = [100 * table[name][g]["success"] if value == "success" else times[name, g] for g in there]
            axes.plot(np.arange(len(there)), heights, **styles[titles[name]])
        axes.set_xticks(range(len(there)), [group.removesuffix(unit) for group in there], rotation=40, ha="right")
        axes.set(xlabel=label, title="solved (%)" if value == "success" else "ms per problem")
        if value == "ms":
            log_scale(axes, "y")
    draw_legend(figure, styles)
    return save(figure, path)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", metavar="FILE", nargs="+", type=Path, help="results (JSON) or a sweep's summary.csv")
    parser.add_argument("--out", metavar="FOLDER", default="outputs/figures", help="default: outputs/figures")
    arguments = parser.parse_args(argv)
    for path in (path for path in arguments.files if path.suffix == ".csv"):
        numbers = read_sweep(path)[2]
        if not numbers:
            parser.error(f"{path}: no override differs between runs and is a number in all of them.")
        for name in numbers:
            print(plot_sweep(Path(arguments.out) / f"sweep_against_{short_name(name)}.png", path, against=name))
    results = []
    for path in (path for path in arguments.files if path.suffix != ".csv"):
        content = json.loads(path.read_text(encoding="utf-8"))
        counts = isinstance(content, dict) and content.get("kind") == "complexity"
        results.append(content if counts else load_results(path))
    if results:
        print(*paper_figures(results, arguments.out), sep="\n")


if __name__ == "__main__":
    main()
