"""One problem in its image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.collections import LineCollection
from torch import Tensor

from kornia_pnpnet.core.checks import check_positive
from kornia_pnpnet.evaluation.figures.style import BLUE, THEME, VERMILION, make_figure, save


@rc_context(THEME)
def plot_pose(
    path: str | Path,
    img_points: np.ndarray | Tensor,
    reprojections: np.ndarray | Tensor,
    rejected: np.ndarray | Tensor,
    size: tuple[float, float] | None = None,
    *,
    title: str = "",
) -> Path:
    r"""Draw one problem in its image: each pixel, joined to the projection of its point.

    Args:
        path: the picture to write; the ending gives the format.
        img_points: measured pixels, shape :math:`(N, 2)`. Pairs whose pixel is not finite are left out.
        reprojections: projections of the points in pixels, shape :math:`(N, 2)`; not finite for points behind the
            camera, which are not drawn.
        rejected: whether the solver rejected the pair, bool, shape :math:`(N,)`.
        size: width and height of the image in pixels; ``None``: the range of the pixels and the projections near them.
        title: text before the counts.

    Returns:
        The path.

    Raises:
        ValueError: when the shapes do not agree, or when no pixel is finite.
        BaseError: when the size is not positive.
    """
    pixels, projected = np.asarray(img_points, dtype=float), np.asarray(reprojections, dtype=float)
    bad = np.asarray(rejected, dtype=bool)
    if pixels.ndim != 2 or pixels.shape[1] != 2 or projected.shape != pixels.shape or bad.shape != pixels.shape[:1]:
        shapes = f"{pixels.shape}, {projected.shape} and {bad.shape}"
        raise ValueError(f"plot_pose needs pixels and projections (N, 2) and rejected (N,), got {shapes}.")
    if size is not None:
        check_positive(width=size[0], height=size[1])
    there = np.isfinite(pixels).all(axis=1)
    if not there.any():
        raise ValueError("There is no pixel to draw.")
    pixels, projected, bad = pixels[there], projected[there], bad[there]
    seen = np.isfinite(projected).all(axis=1)
    left, top, right, bottom = (0.0, 0.0, *size) if size is not None else _bounds(pixels, projected[seen])

    ratio = (bottom - top) / (right - left)
    width = min(6.1, 7.0 / ratio)
    figure = make_figure(max(5.0, width + 0.9), max(3.5, width * ratio + 1.1))
    axes = figure.subplots()
    for which, colour, dash in ((seen & ~bad, BLUE, "-"), (seen & bad, VERMILION, "--")):
        lines = np.stack((pixels[which], projected[which]), axis=1)
        axes.add_collection(LineCollection(list(lines), colors=colour, linewidths=1.2, linestyles=dash, alpha=0.8))
    marks: dict[str, Any] = {"markersize": 9.0, "linestyle": "none"}
    axes.plot(*pixels[~bad].T, "o", color=BLUE, markerfacecolor="none", label="pixel, kept", **marks)
    axes.plot(*pixels[bad].T, "x", color=VERMILION, markeredgewidth=2.2, label="pixel, rejected", **marks)
    axes.plot(*projected[seen].T, "+", color="black", markeredgewidth=1.3, label="reprojection", **marks)
    axes.set(xlim=(left, right), ylim=(bottom, top), xlabel="u (px)", ylabel="v (px)", aspect="equal")
    counts = f"n = {len(pixels)}, {int(bad.sum())} rejected"
    hidden = int((~seen).sum())
    counts += f", {hidden} behind the camera" if hidden else ""
    axes.set_title(f"{title}: {counts}" if title else counts)
    figure.legend(loc="outside lower center", ncols=3)
    return save(figure, path)


def _bounds(pixels: np.ndarray, projected: np.ndarray) -> tuple[float, float, float, float]:
    """Left, top, right and bottom around the pixels and the projections near them."""
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    reach = max(1.0, float((high - low).max()))
    near = ((projected > low - 0.5 * reach) & (projected < high + 0.5 * reach)).all(axis=1)
    points = np.concatenate((pixels, projected[near]))
    low, high = points.min(axis=0) - 0.06 * reach, points.max(axis=0) + 0.06 * reach
    # Room for the marks: neither side is shorter than a third of the other.
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, (high - low).max() / 6)
    return *(middle - half), *(middle + half)
