"""Pictures of results: the only module that needs matplotlib. It draws without pyplot, so nothing global changes."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from torch import Tensor

from kornia_pnpnet.evaluation import row_errors

try:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
except ImportError as error:
    raise ImportError("Pictures need matplotlib: pip install 'kornia_pnpnet[eval]'") from error

__all__ = ["plot_errors", "plot_pose", "plot_success", "plot_training"]

# Okabe and Ito's colours, which the colour-blind can tell apart, the pale yellow left out; then the same with another
# hatch or dash.
_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#000000")
_HATCHES, _DASHES = ("", "///", "..."), ("-", "--", ":")
_RED, _GREY = "#CC3311", "#5f5f5f"
_DPI = 150
_SETS_PER_ROW = 4


def _figure(width: float, height: float) -> Figure:
    """An opaque white figure, readable on a dark page too; its size in inches."""
    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def _save(figure: Figure, path: str | Path) -> Path:
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=_DPI)
    return path


def _tidy(axes: Axes, grid: Literal["both", "y"] = "both") -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis=grid, color="#dddddd", linewidth=0.7)
    axes.set_axisbelow(True)


def _style(index: int) -> tuple[str, int]:
    """Colour and round of the palette of the solver with this index."""
    return _COLOURS[index % len(_COLOURS)], min(index // len(_COLOURS), len(_HATCHES) - 1)


def plot_pose(
    path: str | Path,
    img_points: np.ndarray | Tensor,
    reprojections: np.ndarray | Tensor,
    rejected: np.ndarray | Tensor,
    size: tuple[float, float] | None = None,
    *,
    title: str = "",
) -> Path:
    r"""Draw one problem in its image: each pixel, joined to where the pose puts its point.

    Args:
        path: where the picture goes; the ending gives the format.
        img_points: measured pixels, shape :math:`(N, 2)`.
        reprojections: projections of the points, shape :math:`(N, 2)`; not finite for points behind the camera,
            which have no place in the image.
        rejected: whether the pair is taken for wrong, bool, shape :math:`(N,)`.
        size: width and height of the image in pixels, the origin in its corner; when ``None``, what the pixels and
            the reprojections near them need.
        title: stands before the counts.

    Returns:
        The path.
    """
    pixels, projected = np.asarray(img_points, dtype=float), np.asarray(reprojections, dtype=float)
    bad = np.asarray(rejected, dtype=bool)
    seen = np.isfinite(projected).all(axis=1)
    left, top, right, bottom = (0.0, 0.0, *size) if size is not None else _bounds(pixels, projected[seen])

    ratio = (bottom - top) / (right - left)
    width = min(6.1, 7.0 / ratio)
    figure = _figure(max(5.0, width + 0.9), max(3.5, width * ratio + 1.1))
    axes = figure.subplots()
    for which, colour, dash in ((seen & ~bad, _COLOURS[0], "-"), (seen & bad, _RED, "--")):
        lines = np.stack((pixels[which], projected[which]), axis=1)
        axes.add_collection(LineCollection(list(lines), colors=colour, linewidths=1.2, linestyles=dash, alpha=0.8))
    marks: dict[str, Any] = {"markersize": 9.0, "linestyle": "none"}
    axes.plot(*pixels[~bad].T, "o", color=_COLOURS[0], markerfacecolor="none", label="pixel, kept", **marks)
    axes.plot(*pixels[bad].T, "x", color=_RED, markeredgewidth=2.2, label="pixel, rejected", **marks)
    axes.plot(*projected[seen].T, "+", color="black", markeredgewidth=1.3, label="reprojection", **marks)
    axes.set(xlim=(left, right), ylim=(bottom, top), xlabel="u (px)", ylabel="v (px)", aspect="equal")
    _tidy(axes)
    counts = f"n = {len(pixels)}, {int(bad.sum())} rejected"
    hidden = int((~seen).sum())
    counts += f", {hidden} behind the camera" if hidden else ""
    axes.set_title(f"{title}: {counts}" if title else counts, fontsize=11)
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    return _save(figure, path)


def _bounds(pixels: np.ndarray, projected: np.ndarray) -> tuple[float, float, float, float]:
    """Left, top, right and bottom around the pixels and those reprojections that are not far off."""
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    reach = max(1.0, float((high - low).max()))
    near = ((projected > low - 0.5 * reach) & (projected < high + 0.5 * reach)).all(axis=1)
    points = np.concatenate((pixels, projected[near]))
    low, high = points.min(axis=0) - 0.06 * reach, points.max(axis=0) + 0.06 * reach
    # A strip would leave no room for the marks: at least a third as wide as long, and the other way round.
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, (high - low).max() / 6)
    return *(middle - half), *(middle + half)


def plot_success(path: str | Path, results: Mapping[str, Any]) -> Path:
    """Draw success rates as bars with their 95 % intervals, grouped by data set.

    Args:
        path: where the picture goes; the ending gives the format.
        results: what :func:`~kornia_pnpnet.evaluation.evaluate` returned.

    Returns:
        The path.
    """
    solvers, sets = list(results["solvers"]), list(results["data"])
    rates = {(row["data"], row["solver"]): row["success"] for row in results["rows"]}
    width = 0.84 / len(solvers)
    per_row = min(len(sets), _SETS_PER_ROW)
    parts = [sets[start : start + per_row] for start in range(0, len(sets), per_row)]
    figure = _figure(max(6.0, 1.2 + (0.55 * len(solvers) + 0.5) * per_row), 1.2 + 3.2 * len(parts))
    for part, axes in zip(parts, figure.subplots(len(parts), squeeze=False)[:, 0], strict=True):
        for index, solver in enumerate(solvers):
            colour, turn = _style(index)
            there = [(place, rates[name, solver]) for place, name in enumerate(part) if (name, solver) in rates]
            places = np.array([place - 0.42 + width * (index + 0.5) for place, _ in there])
            rate, low, high = (100 * np.array([entry[key] for _, entry in there]) for key in ("rate", "low", "high"))
            style = {"color": colour, "hatch": _HATCHES[turn], "edgecolor": "white", "linewidth": 0}
            bars = axes.bar(places, rate, 0.92 * width, label=solver, **style)
            reach = np.stack((rate - low, high - rate)).clip(
                min=0
            )  # rounded in the file, a bound may lie a hair inside
            axes.errorbar(places, rate, reach, fmt="none", ecolor="#222222", capsize=3, linewidth=1.2)
            for bar, value, top in zip(bars, rate, high, strict=True):
                place = bar.get_x() + bar.get_width() / 2
                axes.annotate(f"{value:.1f}", (place, top), (0, 3), textcoords="offset points", ha="center", fontsize=8)
        axes.set_xticks(range(len(part)), [_wrapped(name) for name in part])
        axes.tick_params(axis="x", length=0)
        axes.set(ylim=(0, 108), yticks=range(0, 101, 20), ylabel="problems solved (%)", xlim=(-0.55, per_row - 0.45))
        _tidy(axes, grid="y")
    first = figure.axes[0]
    first.set_title(f"Success with 95 % intervals: {_limits(results, sets)}", fontsize=11, loc="left")
    handles, labels = first.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(5, len(solvers)), frameon=False)
    return _save(figure, path)


def _wrapped(name: str) -> str:
    return name.replace(", ", "\n")


def _limits(results: Mapping[str, Any], sets: Sequence[str]) -> str:
    """What counts as a success, in words."""
    entries = [results["data"][name] for name in sets]
    rotations, translations = ({entry[key] for entry in entries} for key in ("max_rotation_deg", "max_translation"))
    units = {entry["unit"] for entry in entries}
    if any(len(values) > 1 for values in (rotations, translations, units)):
        return "both errors below the limit of the set"
    return f"below {rotations.pop():g}° and " + f"{translations.pop():.3g} {units.pop() or 'world units'}"


def plot_errors(path: str | Path, results: Mapping[str, Any]) -> Path:
    """Draw how many problems have an error of at most x: a row of two panels for each data set.

    Args:
        path: where the picture goes; the ending gives the format.
        results: what :func:`~kornia_pnpnet.evaluation.evaluate` returned.

    Returns:
        The path.
    """
    solvers, sets = list(results["solvers"]), list(results["data"])
    figure = _figure(9.0, 0.8 + 3.0 * len(sets))
    grid = figure.subplots(len(sets), 2, squeeze=False, sharey=True)
    drawn: dict[str, Line2D] = {}
    for name, panels in zip(sets, grid, strict=True):
        entry = results["data"][name]
        rows = [row for row in results["rows"] if row["data"] == name]
        unit = f" ({entry['unit']})" if entry["unit"] else ""
        limits = (entry["max_rotation_deg"], entry["max_translation"])
        labels = ("rotation error (°)", f"translation error{unit}")
        for axes, index, limit, label in zip(panels, (0, 1), limits, labels, strict=True):
            sharp = min(row_errors(row)[0][index].quantile(0.02).item() for row in rows) < limit / 100
            left, right = limit / (1000 if sharp else 100), 180.0 if index == 0 else limit * 100
            axes.set(xscale="log", xlim=(left, right), ylim=(0, 101), xlabel=label)
            axes.xaxis.set_major_formatter("{x:g}")
            drawn["limit of a success"] = axes.axvline(limit, color=_GREY, linewidth=1.2, linestyle=(0, (4, 3)))
            _tidy(axes)
            for row in rows:
                colour, turn = _style(solvers.index(row["solver"]))
                errors = np.sort(row_errors(row)[0][index].numpy())
                share = 100 * np.arange(len(errors) + 1) / len(errors)
                # The curve comes from the left edge and leaves at the right one, wherever the errors lie.
                ends = np.concatenate((errors[:1].clip(max=left), errors, errors[-1:].clip(min=right)))
                line = axes.step(ends, [*share, share[-1]], where="post", color=colour, linestyle=_DASHES[turn])
                drawn[row["solver"]] = line[0]
        panels[0].set(ylabel="problems (%)")
        panels[0].set_title(name, fontsize=11, loc="left")
    figure.legend(drawn.values(), drawn.keys(), loc="outside lower center", ncols=min(5, len(drawn)), frameon=False)
    return _save(figure, path)


def plot_training(path: str | Path, history_csv: str | Path) -> Path:
    """Draw the learning curves of a run.

    Args:
        path: where the picture goes; the ending gives the format.
        history_csv: the run's history, a CSV file with the columns ``update``, ``total``, ``init_rotation``,
            ``init_translation``, ``refined_rotation``, ``refined_translation`` and any ``val/<set>/success``. Empty
            cells are skipped, other columns are not read.

    Returns:
        The path.

    Raises:
        ValueError: when a column is missing or there are no rows.
    """
    with Path(history_csv).open(newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise ValueError(f"'{history_csv}' has no rows to draw.")

    def curve(column: str) -> tuple[list[float], list[float]]:
        if column not in rows[0]:
            raise ValueError(f"'{history_csv}' has no column '{column}'.")
        pairs = [(float(row["update"]), float(row[column])) for row in rows if row[column]]
        pairs = [pair for pair in pairs if math.isfinite(pair[1])]
        return [x for x, _ in pairs], [y for _, y in pairs]

    figure = _figure(9.0, 6.2)
    (loss, success), (rotation, translation) = figure.subplots(2, 2, sharex=True)
    loss.plot(*curve("total"), color="black", linewidth=1.7)
    for axes, kind in ((rotation, "rotation"), (translation, "translation")):
        axes.plot(*curve(f"init_{kind}"), color=_COLOURS[1], linewidth=1.7, linestyle="--", label="network alone")
        axes.plot(*curve(f"refined_{kind}"), color=_COLOURS[0], linewidth=1.7, label="after the refinement")
        axes.set(yscale="log", xlabel="update")
        axes.legend(frameon=False)
    for index, column in enumerate(name for name in rows[0] if name.startswith("val/") and name.endswith("/success")):
        colour, turn = _style(index)
        updates, rates = curve(column)
        label = column.removeprefix("val/").removesuffix("/success")
        success.plot(
            updates, [100 * rate for rate in rates], color=colour, linestyle=_DASHES[turn], marker=".", label=label
        )
    success.set(ylim=(0, 100), ylabel="problems solved (%)")
    success.set_title("validation success", fontsize=11, loc="left")
    if success.lines:
        success.legend(frameon=False)
    loss.set(ylabel="loss")
    loss.set_title("training loss (refined terms ramp in)", fontsize=11, loc="left")
    rotation.set(ylabel=r"$\|\hat R - R\|_F$")
    rotation.set_title("rotation distance", fontsize=11, loc="left")
    translation.set(ylabel=r"$\|\hat t - t\|$ (world unit)")
    translation.set_title("translation distance", fontsize=11, loc="left")
    for axes in (loss, success, rotation, translation):
        _tidy(axes)
    return _save(figure, path)
