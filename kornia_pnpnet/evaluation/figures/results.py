"""Pictures of results files: success, errors, and the figures of the paper's protocol."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence, Sized
from contextlib import suppress
from pathlib import Path
from typing import Any

import pandas as pd
import seaborn as sns
import torch

from kornia_pnpnet.evaluation.figures import style
from kornia_pnpnet.evaluation.problem_sets import PRIORS
from kornia_pnpnet.evaluation.results import row_errors
from kornia_pnpnet.metrics import success_rate

_SYNTHETIC = {name for name, _ in PRIORS.values()}
_KEYS = ["source", "outliers", "mismatches", "n", "solver"]
_LIMIT = ["max_rotation_deg", "max_translation", "unit"]
_RATE = ["rate", "low", "high", "total"]
_SOURCES = {"paper": "the paper's data", "gaussian_pose": "data with Gaussian positions"}
_PROTOCOL_N, _SCENE_OUTLIERS = 9, 2  # as in the paper
_FEWEST_MISMATCHES = 3  # numbers of mismatches of a curve


class NothingToDrawError(ValueError):
    """The results hold no data for a figure."""


def require(found: Sized, what: str) -> None:
    """Raise when nothing was found."""
    if not len(found):
        raise NothingToDrawError(f"The results hold no {what} to draw.")


def read_records(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Read results files. Operation counts and data sets without a source or outliers are left out.

    One row for each source, outliers, kind of outliers, n and solver: the one with the most problems, then the last.
    ``outliers`` is a number, ``"uniform"`` for 0 to a third of the pairs, or another text; ``mismatches`` says that
    every outlier shows another point; ``base`` is the solver's name without the option m; an unknown ``m`` is -1.
    """
    rows = []
    for result in results:
        for row in result.get("rows", ()):
            data, solver = result["data"][row["data"]], row["solver"]
            description = data.get("description") or {}
            source, outliers = description.get("source"), description.get("outliers")
            if isinstance(source, str) and isinstance(outliers, int | str):
                outliers = 0 if outliers == "none" else outliers
                mismatches = outliers != 0 and description.get("mismatch_share") == 1
                refine = (result["solvers"][solver].get("config") or {}).get("refine")
                m = refine.get("m") if isinstance(refine, Mapping) else None
                base = re.sub(r"([:,])m=[^,]*(,?)", lambda option: option[1] if option[2] else "", solver)
                key = (source, outliers, mismatches, data["n"], solver, base, base != solver, source not in _SYNTHETIC)
                more = (m if type(m) is int else -1, row["us_per_problem"], [data[key] for key in _LIMIT])
                rows.append((*key, *more, *percent(row["success"])))
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


def in_words(limits: Iterable[Sequence[Any]], totals: Sequence[int] = ()) -> str:
    """The limits of a success (degrees, length, unit of the length), and the numbers of problems."""
    table = pd.DataFrame(list(limits), columns=["degrees", "length", "unit"]).fillna("").replace("", "world units")
    lengths = [f"{_span(part.length, '.2g')} {unit}" for unit, part in table.groupby("unit", sort=False)]
    problems = f" {_span(totals, 'd')} problems in each set, 95 % intervals." if len(totals) else ""
    return f"Solved: errors below {_span(table.degrees, 'g')}° and {' or '.join(lengths)}.{problems}"


def _span(values: Iterable[float], form: str) -> str:
    """The value, or the least and the largest value when their texts differ."""
    low, high = f"{min(values):{form}}", f"{max(values):{form}}"
    return low if low == high else f"{low} to {high}"


def outliers_in_words(outliers: int | str, n: int | str = "n") -> str:
    """The number of outliers among ``n`` pairs, for a title."""
    if outliers in (0, "uniform"):
        return f"0 to {'⌊n/3⌋' if isinstance(n, str) else n // 3} outliers of {n}" if outliers else "no outliers"
    return outliers if isinstance(outliers, str) else f"{outliers} outliers of {n}"


def at_usual_n(table: pd.DataFrame) -> tuple[pd.DataFrame, int]:
    """The rows at the n of a figure that does not vary n: 9 as in the protocol, or the smallest n."""
    n = _PROTOCOL_N if table.empty or (table.n == _PROTOCOL_N).any() else int(table.n.min())
    return table[table.n == n], n


@style.themed
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
    require(results["rows"], "rows")
    rows = [(row["data"], row["solver"], *percent(row["success"])) for row in results["rows"]]
    table = pd.DataFrame(rows, columns=["data", "solver", "rate", "low", "high", "total"])
    limits = in_words([entry[key] for key in _LIMIT] for entry in results["data"].values())
    panels = dict(list(table.groupby("data", sort=False)))
    return style.draw_dots(path, ["Success with 95 % intervals", limits], [panels])


@style.themed
def plot_errors(path: str | Path, results: Mapping[str, Any]) -> Path:
    """Draw the share of problems with an error of at most x: a row of two panels for each data set.

    Args:
        path: See :func:`plot_success`.
        results: See :func:`plot_success`.

    Returns:
        The path.

    Raises:
        ValueError: when there are no rows.
    """
    sets = list(dict.fromkeys(row["data"] for row in results["rows"]))
    require(sets, "rows")
    styles = style.solver_styles(row["solver"] for row in results["rows"])
    heading = "Problems with an error of at most x", "Vertical line: limit of a success."
    figure = style.make_figure(style.WIDTH, 1.2 + 2.4 * len(sets), *heading)
    for name, panels in zip(sets, figure.subplots(len(sets), 2, squeeze=False, sharey=True), strict=True):
        entry = results["data"][name]
        errors = {row["solver"]: row_errors(row)[0] for row in results["rows"] if row["data"] == name}
        labels = "rotation error (°)", f"translation error ({entry['unit'] or 'world units'})"
        limits = entry["max_rotation_deg"], entry["max_translation"]
        for index, (axes, limit, label) in enumerate(zip(panels, limits, labels, strict=True)):
            axes.set(xscale="log", xlim=(limit / 1000, limit * 180), ylim=(0, 101), xlabel=label)
            style.log_scale(axes, "x")
            axes.axvline(limit, color=style.GREY, linewidth=1.2)
            for place, (solver, look) in enumerate(styles.items()):
                if solver in errors:
                    values, marks = errors[solver][index].numpy(), {"markevery": (0.01 * place, 0.15)}
                    sns.ecdfplot(x=values, stat="percent", ax=axes, label=solver, **marks, **look)
        panels[0].set(title=name, ylabel="problems (%)")
    style.draw_legend(figure, styles)
    return style.save(figure, path)


@style.themed
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
    table, n = at_usual_n(read_records(results).query("source == @source and not swept and not mismatches"))
    parts = {setting: table[table.outliers == setting] for setting in (0, "uniform", n // 3)}
    panels = {outliers_in_words(setting, n): part for setting, part in parts.items() if len(part)}
    require(panels, f"success on '{source}' with none, uniform or {n // 3} outliers")
    table = pd.concat(panels.values())
    heading = [f"Success on {_SOURCES.get(source, source)}, n = {n}", in_words(table.limit, table.total)]
    return style.draw_dots(path, heading, [panels])


@style.themed
def plot_scenes(path: str | Path, results: Sequence[Mapping[str, Any]]) -> Path:
    """Draw success on scenes, over all scenes and for each: figure 4 of the protocol.

    The panels are without outliers and with two, at n = 9 or the smallest n of the results. A solver has a dot over all
    scenes when it solved all of them.

    Args:
        path: See :func:`plot_synthetic`.
        results: See :func:`plot_synthetic`.

    Returns:
        The path.

    Raises:
        ValueError: when the results have no such scenes.
    """
    table = read_records(results).query("scene and not swept and not mismatches")
    table, n = at_usual_n(table[table.outliers.isin([0, _SCENE_OUTLIERS])])
    require(table, f"success on scenes with 0 or {_SCENE_OUTLIERS} outliers")
    lines = []
    for setting, chosen in table.groupby("outliers"):
        scenes = dict(list(chosen.groupby("source", sort=False)))
        first, words = next(iter(scenes)), outliers_in_words(setting, n)
        whole = {f"{words}: all {len(scenes)} scenes": pooled(chosen)}
        lines.append({**whole, **scenes} if len(scenes) > 1 else {f"{words}: {first}": scenes[first]})
    return style.draw_dots(path, [f"Success on scenes, n = {n}", in_words(table.limit, table.total)], lines, 6)


def plot_mismatches(path: str | Path, results: Sequence[Mapping[str, Any]]) -> Path:
    """Draw success on scenes against the number of mismatches: figure 5 of the protocol.

    The scenes with the most numbers of mismatches are pooled, at n = 9 or the smallest n of the results. A solver that
    solved all these scenes at three numbers or more has a curve. Without sets of mismatches only, the outliers of the
    protocol are drawn.

    Args:
        path: See :func:`plot_synthetic`.
        results: See :func:`plot_synthetic`.

    Returns:
        The path.

    Raises:
        ValueError: when no scene has three numbers of mismatches.
    """
    table = read_records(results).query("scene and not swept")
    table = table[table.outliers.map(lambda outliers: isinstance(outliers, int)).astype(bool)]
    kind = table.mismatches.any()
    table, n = at_usual_n(table[(table.mismatches == kind) | (table.outliers == 0)])
    counts = table.groupby("source").outliers.agg(set)
    most: set[int] = max(counts, key=len, default=set())
    table = table[table.source.isin(counts.index[counts >= most]) & table.outliers.isin(most)]
    label = f"{'mismatches' if kind else 'outliers'} among {n} pairs"
    parts = [pooled(part).assign(**{label: number}) for number, part in table.groupby("outliers")]
    require(parts[_FEWEST_MISMATCHES - 1 :], f"scenes with {_FEWEST_MISMATCHES} numbers of mismatches")
    rates = pd.concat(parts)
    rates = rates[rates.groupby("solver").rate.transform("size") >= _FEWEST_MISMATCHES]
    require(rates, f"solvers with {_FEWEST_MISMATCHES} numbers of mismatches")
    scenes = table.source.unique()
    title = f"Success on {f'{len(scenes)} scenes' if len(scenes) > 1 else scenes[0]}, n = {n}"
    return style.draw_curves(path, [title, in_words(table.limit, table.total)], [("", rates, "rate")], label)


def plot_against_n(path: str | Path, results: Sequence[Mapping[str, Any]]) -> Path:
    """Draw success on the protocol's data against the number of pairs, a panel for each outlier setting.

    Solvers for one n each, such as ``pnpnet-n9`` and ``pnpnet-n20``, make one curve. Other solvers need two n.

    Args:
        path: See :func:`plot_synthetic`.
        results: See :func:`plot_synthetic`.

    Returns:
        The path.

    Raises:
        ValueError: when no outlier setting has two numbers of pairs.
    """
    table = read_records(results).query("source == 'paper' and not swept and not mismatches")
    table = table[table.groupby("outliers").n.transform("nunique") > 1]
    require(table, "success on 'paper' with several n and the same outliers")
    families = [re.sub(rf"-n{n}\b", "-n*", solver) for solver, n in zip(table.solver, table.n, strict=True)]
    single = table.groupby(families).solver.transform("nunique") == 1
    table = table.assign(solver=table.solver.where(single, families))
    several = table.groupby(["solver", "outliers"]).n.transform("size") > 1
    table = table[several | table.solver.str.match("pnpnet|net")]
    heading = [f"Success on {_SOURCES['paper']} against the number of pairs", in_words(table.limit, table.total)]
    return style.draw_curves(path, heading, _by_outliers(table, "n"), "n")


def plot_against_m(path: str | Path, results: Sequence[Mapping[str, Any]]) -> Path:
    """Draw success on the protocol's data, and time, against the iterations of the refinement.

    Solvers that differ only in the option m, such as ``epnp-lm`` and ``epnp-lm:m=3``, make one curve; m is read from
    their configurations. n is 9 or the smallest n of the results. The time is of the last outlier setting.

    Args:
        path: See :func:`plot_synthetic`.
        results: See :func:`plot_synthetic`.

    Returns:
        The path.

    Raises:
        ValueError: when no solver has two m.
    """
    table, n = at_usual_n(read_records(results).query("source == 'paper' and m >= 0 and not mismatches"))
    table = table.assign(solver=table.base).drop_duplicates(["solver", "outliers", "m"], keep="last")
    table = table[table.groupby(["solver", "outliers"]).m.transform("size") > 1]
    require(table, "success on 'paper' of a solver with several m")
    panels = _by_outliers(table, n)
    panels.append((f"time, {panels[-1][0]}", panels[-1][1], "us"))
    heading = [f"Success on {_SOURCES['paper']} against m, n = {n}", in_words(table.limit, table.total)]
    return style.draw_curves(path, heading, panels, "m")


def _by_outliers(table: pd.DataFrame, n: int | str) -> list[tuple[str, pd.DataFrame, str]]:
    """A panel of rates for each outlier setting: none, uniform, other numbers, other texts."""
    settings = sorted(table.outliers.unique(), key=lambda x: (x != 0, x != "uniform", isinstance(x, str), x))
    return [(outliers_in_words(setting, n), table[table.outliers == setting], "rate") for setting in settings]


def plot_operations(path: str | Path, complexity: Mapping[str, Any]) -> Path:
    """Draw the operations of a solver for one problem of n pairs: figure 1 of the protocol.

    Args:
        path: See :func:`plot_success`.
        complexity: ``n``, numbers of pairs; ``counts``, by solver one operation count for each n, or ``None``;
            ``ransac``, the names of the solvers of the second panel.

    Returns:
        The path.

    Raises:
        ValueError: when there is no solver, or the counts of a solver are not one for each n.
    """
    n, counts = list(complexity["n"]), complexity["counts"]
    if not n or not counts:
        raise ValueError("There are no operation counts to draw.")
    table = pd.DataFrame({"n": n, **counts}).melt("n", var_name="solver", value_name="operations")
    sampled = table.solver.isin(complexity["ransac"]).map({False: "without RANSAC", True: "with RANSAC"})
    panels = [(title, part, "operations") for title, part in table.groupby(sampled, sort=False)]
    return style.draw_curves(path, ["Operations that a problem of n pairs takes"], panels, "n")


_FIGURES: dict[str, Callable[..., Path]] = {
    "figure2_paper.png": plot_synthetic,
    "figure3_gaussian_pose.png": lambda path, results: plot_synthetic(path, results, "gaussian_pose"),
    "figure4_scenes.png": plot_scenes,
    "figure5_mismatches.png": plot_mismatches,
    "success_against_n.png": plot_against_n,
    "success_against_m.png": plot_against_m,
}


def paper_figures(results: Sequence[Mapping[str, Any]], folder: str | Path) -> list[Path]:
    """Draw the protocol's five figures, success against n and success against m. Figures without data are left out.

    Args:
        results: results files of :func:`~kornia_pnpnet.evaluation.evaluate`, and at most one file of operation counts
            (``kind`` is ``"complexity"``). Of several results with the same source, outliers, n and solver, the one
            with the most problems is drawn, and of these the last. A solver whose name sets m is in the figure against
            m only.
        folder: folder of the pictures, made when missing.

    Returns:
        The paths of the pictures.

    Raises:
        ValueError: when no figure has data, or there are several files of operation counts.
    """
    complexity = [entry for entry in results if entry.get("kind") == "complexity"]
    solved = [entry for entry in results if entry.get("kind") != "complexity"]
    if len(complexity) > 1 or not results:
        raise ValueError(f"Expected at least one results file and at most one of operation counts, got {len(results)}.")
    made = [plot_operations(Path(folder) / "figure1_operations.png", entry) for entry in complexity]
    for name, plot in _FIGURES.items():
        with suppress(NothingToDrawError):
            made.append(plot(Path(folder) / name, solved))
    if not made:
        raise ValueError("The results hold no data for any figure: no data set has a source and outliers to compare.")
    return made
