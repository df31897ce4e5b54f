"""Learning curves."""

from __future__ import annotations

import math
from pathlib import Path

from kornia_pnpnet.core.schema import read_column, read_rows
from kornia_pnpnet.evaluation.figures.style import BLUE, COLOURS, ORANGE, SMALL, TITLE, WIDTH, make_figure, save, tidy

__all__ = ["plot_training"]


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
    steps = read_column(history_csv, rows, "update", float)

    def curve(column: str) -> tuple[list[float], list[float]]:
        values = read_column(history_csv, rows, column, float, gaps=True)
        pairs = [pair for pair in zip(steps, values, strict=True) if not math.isnan(pair[1])]
        return [x for x, _ in pairs], [y for _, y in pairs]

    figure = make_figure(WIDTH, 5.4)
    (loss, success), (rotation, translation) = figure.subplots(2, 2, sharex=True)
    loss.plot(*curve("total"), color="black", linewidth=1.7)
    for axes, kind in ((rotation, "rotation"), (translation, "translation")):
        axes.plot(*curve(f"init_{kind}"), color=ORANGE, linewidth=1.7, linestyle="--", label="network alone")
        axes.plot(*curve(f"refined_{kind}"), color=BLUE, linewidth=1.7, label="after the refinement")
        axes.set(yscale="log", xlabel="update")
        axes.legend(frameon=False, fontsize=SMALL)
    validated = [name for name in rows[0] if name and name.startswith("val/") and name.endswith("/success")]
    for index, column in enumerate(validated):
        colour, dash = COLOURS[index % len(COLOURS)], ("-", "--", ":")[index // len(COLOURS) % 3]
        updates, rates = curve(column)
        label = column.removeprefix("val/").removesuffix("/success")
        success.plot(updates, [100 * rate for rate in rates], color=colour, linestyle=dash, marker=".", label=label)
    success.set(ylim=(0, 100), ylabel="problems solved (%)")
    success.set_title("validation success", fontsize=TITLE, loc="left")
    if success.lines:
        success.legend(frameon=False, fontsize=SMALL)
    loss.set(ylabel="loss")
    loss.set_title("training loss (refined terms ramp in)", fontsize=TITLE, loc="left")
    rotation.set(ylabel=r"$\|\hat R - R\|_F$")
    rotation.set_title("rotation distance", fontsize=TITLE, loc="left")
    translation.set(ylabel=r"$\|\hat t - t\|$ (world unit)")
    translation.set_title("translation distance", fontsize=TITLE, loc="left")
    for axes in (loss, success, rotation, translation):
        tidy(axes)
    return save(figure, path)
