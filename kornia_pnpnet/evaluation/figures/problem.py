"""One problem in its image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from torch import Tensor

from kornia_pnpnet.core.checks import check_positive
from kornia_pnpnet.evaluation.figures import style


@style.themed
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
    if pixels.shape != (len(bad), 2) or projected.shape != pixels.shape or bad.ndim != 1:
        shapes = f"{pixels.shape}, {projected.shape} and {bad.shape}"
        raise ValueError(f"plot_pose needs pixels and projections (N, 2) and rejected (N,), got {shapes}.")
    there = np.isfinite(pixels).all(axis=1)
    if not there.any():
        raise ValueError("There is no pixel to draw.")
    pixels, projected, bad = pixels[there], projected[there], bad[there]
    seen = np.isfinite(projected).all(axis=1)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    if size is not None:
        check_positive(width=size[0], height=size[1])
        low, high = np.zeros(2), np.array(size)
    else:  # around the pixels and the projections near them; neither side is shorter than a third of the other
        reach = max(1.0, (high - low).max())
        near = seen & (np.abs(projected - (low + high) / 2) < (high - low) / 2 + reach / 2).all(axis=1)
        points = np.concatenate((pixels, projected[near]))
        middle, half = (points.max(axis=0) + points.min(axis=0)) / 2, np.ptp(points, axis=0) / 2 + 0.06 * reach
        low, high = middle - np.maximum(half, half.max() / 3), middle + np.maximum(half, half.max() / 3)
    width, height = (high - low) * min(6.1 / (high - low)[0], 7.0 / (high - low)[1])
    figure = style.make_figure(max(5.0, width + 0.9), max(3.5, height + 1.1))
    axes = figure.subplots()
    for which, colour, dash in ((seen & ~bad, style.BLUE, "-"), (seen & bad, style.VERMILION, "--")):
        lines = list(np.stack((pixels[which], projected[which]), axis=1))
        axes.add_collection(LineCollection(lines, colors=colour, linewidths=1.2, linestyles=dash, alpha=0.8))
    marks: dict[str, Any] = {"markersize": 9.0, "linestyle": "none"}
    axes.plot(*pixels[~bad].T, "o", color=style.BLUE, markerfacecolor="none", label="pixel, kept", **marks)
    axes.plot(*pixels[bad].T, "x", color=style.VERMILION, markeredgewidth=2.2, label="pixel, rejected", **marks)
    axes.plot(*projected[seen].T, "+", color="black", markeredgewidth=1.3, label="reprojection", **marks)
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), xlabel="u (px)", ylabel="v (px)", aspect="equal")
    counts = f"n = {len(pixels)}, {bad.sum()} rejected"
    counts += f", {(~seen).sum()} behind the camera" if not seen.all() else ""
    axes.set_title(f"{title}: {counts}" if title else counts)
    figure.legend(loc="outside lower center", ncols=3)
    return style.save(figure, path)
