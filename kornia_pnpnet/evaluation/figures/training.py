"""Pictures of trained networks: learning curves, sweeps of short trainings, and reliability of weights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from kornia_pnpnet.core.schema import read_column, read_rows
from kornia_pnpnet.evaluation.figures import style

_STAGES = {"init": "network alone", "refined": "after the refinement"}
_MIXES = ((style.GREEN, "o", "-"), (style.BLUE, "s", "--"), (style.VERMILION, "^", "-."), (style.PINK, "D", ":"))
_TIME = "time, least over the mixes"
_COLUMNS = {"n": "model.n", "m": "model.m", "mix": "data.outliers.max_ratio", "us": "us_per_problem"}


@style.themed
def plot_training(path: str | Path, history_csv: str | Path) -> Path:
    """Draw the learning curves of a run.

    Args:
        path: the picture to write; the ending gives the format.
        history_csv: the history of the run, with the columns ``update``, ``total``, ``init_rotation``,
            ``init_translation``, ``refined_rotation``, ``refined_translation`` and any ``val/<set>/success``. Empty
            cells are skipped.

    Returns:
        The path.

    Raises:
        ValueError: when a column is missing, a cell is not a number, or there are no rows.
    """
    rows = read_rows(history_csv)
    names = ["update", "total", *(f"{stage}_{kind}" for stage in _STAGES for kind in ("rotation", "translation"))]
    validated = [name for name in rows[0] if name and name.startswith("val/") and name.endswith("/success")]
    columns = {name: read_column(history_csv, rows, name, float, gaps=name != "update") for name in names + validated}
    history = pd.DataFrame(columns).set_index("update")
    figure = style.make_figure(style.WIDTH, 5.4)
    (loss, success), (rotation, translation) = figure.subplots(2, 2, sharex=True)
    loss.plot(history.total.dropna(), color="black")
    loss.set(ylabel="loss", title="training loss (refined terms ramp in)")
    for index, name in enumerate(validated):
        label, rates = name.removeprefix("val/").removesuffix("/success"), 100 * history[name].dropna()
        success.plot(rates, color=style.COLOURS[index % 10], marker=".", label=label)
    success.set(ylim=(0, 100), ylabel="solved (%)", title="validation success")
    for axes, kind, unit in ((rotation, "rotation", "‖R̂ − R‖"), (translation, "translation", "‖t̂ − t‖ (world unit)")):
        for (stage, label), colour, line in zip(_STAGES.items(), (style.ORANGE, style.BLUE), ("--", "-"), strict=True):
            axes.plot(history[f"{stage}_{kind}"].dropna(), color=colour, linestyle=line, label=label)
        axes.set(ylabel=unit, xlabel="update", title=f"{kind} distance")
        style.log_scale(axes, "y")
    figure.legend(handles=rotation.lines, loc="outside lower left", ncols=2)
    figure.legend(handles=success.lines, loc="outside lower right", ncols=2)
    return style.save(figure, path)


def mix_in_words(max_ratio: float) -> str:
    """The mix of outliers with a largest share, in words."""
    share = Fraction(max_ratio).limit_denominator(10)
    most = "n" if share.numerator == 1 else f"{share.numerator}n"
    return f"0 to ⌊{most}/{share.denominator}⌋ pairs wrong" if share else "no wrong pairs"


def plot_sweep(path: str | Path, summary_csv: str | Path, *, against: Literal["n", "m"]) -> Path:
    """Draw the success of trained networks against n or m: a panel for each value of the other, a line for each mix.

    The panels below show the time: the least over the mixes, which do not change the time.

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
    rows = read_rows(summary_csv)
    columns = {**_COLUMNS, **{name: f"uniform/{name}" for name in ("rate", "low", "high")}}
    runs = pd.DataFrame({name: read_column(summary_csv, rows, key, float) for name, key in columns.items()})
    runs = runs.astype({"n": int, "m": int}).assign(solver=runs.mix.map(mix_in_words))
    runs[["rate", "low", "high"]] *= 100
    if runs.duplicated(["n", "m", "mix"]).any():
        raise ValueError(f"'{summary_csv}' has several runs with the same n, m and mix of wrong pairs.")
    mixes = {mix_in_words(mix): _MIXES[index % len(_MIXES)] for index, mix in enumerate(sorted(runs.mix.unique()))}
    styles = {name: style.line_style(*look) for name, look in {**mixes, _TIME: (style.GREY, "X", "-")}.items()}
    times = runs.groupby(["n", "m"], as_index=False).us.min().assign(solver=_TIME)
    other = "m" if against == "n" else "n"
    values = sorted(runs[other].unique())
    panels = [(f"{other} = {value}", runs[runs[other] == value], "rate") for value in values]
    panels += [("", times[times[other] == value], "us") for value in values]
    heading = [f"Success and time of short trainings against {against}, with 95 % intervals"]
    heading.append("Each network is tested on the mix of wrong pairs that it was trained on.")
    return style.draw_curves(path, heading, panels, against, styles)


@style.themed
def plot_reliability(path: str | Path, curves: Mapping[str, Mapping[str, Sequence[float]]]) -> Path:
    """Draw observed shares against predicted probabilities, and below the number of predictions in each range.

    Args:
        path: the picture to write; the ending gives the format.
        curves: by name the lists ``number``, ``predicted`` and ``observed`` of a
            :class:`~kornia_pnpnet.metrics.Reliability`, with one entry for each range. Empty ranges are left out.

    Returns:
        The path.

    Raises:
        ValueError: when there is no curve, the lists differ in length, or a number is negative, or all are 0.
    """
    if not curves:
        raise ValueError("plot_reliability needs at least one curve, got none.")
    figure = style.make_figure(0.72 * style.WIDTH, 6.0)
    chance, share = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    diagonal = chance.plot((0, 1), (0, 1), color=style.GREY, linewidth=1.0, linestyle=":")
    for index, (name, curve) in enumerate(curves.items()):
        lists = [curve.get(key, ()) for key in ("number", "predicted", "observed")]
        if len(set(map(len, lists))) > 1 or not 0 < sum(lists[0]) < math.inf or min(lists[0]) < 0:
            raise ValueError(f"The curve '{name}' needs lists of one length, and numbers >= 0 that are not all 0.")
        number, predicted, observed = np.array(lists, dtype=float)[:, np.array(lists[0]) > 0]
        look = style.line_style(style.COLOURS[index % 10], "os^DvP"[index % 6], "-")
        chance.plot(predicted, observed, **look)
        share.plot(predicted, 100 * number / number.sum(), **look)
    chance.set(ylim=(-0.02, 1.02), xlim=(-0.02, 1.02), ylabel="share of inliers")
    chance.legend([line for line in chance.lines if line not in diagonal], list(curves), loc="upper left")
    share.set(yscale="log", xlabel="weight: the predicted probability of an inlier", ylabel="pairs (%)")
    share.yaxis.set_major_formatter("{x:g}")
    return style.save(figure, path)
