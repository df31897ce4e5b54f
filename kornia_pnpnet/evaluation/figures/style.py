"""The look of all pictures: the page, the sizes of the letters, and the colour, marker and place of each solver."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

__all__ = [
    "BLUE",
    "GREEN",
    "GREY",
    "GROUPS",
    "LETTERS",
    "ORANGE",
    "PURPLE",
    "RED",
    "SKY",
    "SMALL",
    "SOURCES",
    "TITLE",
    "WIDTH",
    "SolverStyle",
    "head",
    "make_figure",
    "save",
    "shortened",
    "solver_styles",
    "tidy",
    "wrapped",
]

#: Of a page with two columns, in inches: drawn at its final size, letters keep theirs, in points.
WIDTH = 7.2
SMALL, TITLE = 8.0, 9.0
#: How many small letters are as wide as the page, about.
LETTERS = 112
_DPI = 300

# Okabe and Ito's colours, which the colour-blind can tell apart; markers and dashes tell the solvers apart in grey.
BLUE, ORANGE, GREY, RED = "#0072B2", "#E69F00", "#5f5f5f", "#CC3311"
SKY, GREEN, VERMILION, PURPLE = "#56B4E9", "#009E73", "#D55E00", "#B5528C"
_BLACK = "#222222"
_SOLID, _DASHED, _DOTTED, _DASH_DOTTED = "-", (0, (4, 2)), (0, (1, 1.3)), (0, (5, 1.5, 1, 1.5))

#: What solvers are sorted into, from the top of a picture down.
GROUPS = ("PnP-Net", "methods of the paper", "beyond the paper", "other libraries", "others", "bounds")
_OTHERS, _BOUNDS = 4, 5
#: What the protocol's priors are called in a title.
SOURCES = {"paper": "the paper's data", "gaussian_pose": "data with Gaussian positions"}


class SolverStyle(NamedTuple):
    """How a solver is drawn in every picture.

    Attributes:
        group: index into :data:`GROUPS`.
        colour: of its line and marker.
        marker: matplotlib's letter for it; empty for a bound, which is a line.
        filled: whether the marker is.
        dash: matplotlib's line style.
    """

    group: int
    colour: str
    marker: str
    filled: bool
    dash: Any

    @property
    def ours(self) -> bool:
        """Whether the line is to stand out."""
        return self.group == 0 and self.filled

    @property
    def bound(self) -> bool:
        """Whether it is no solver but the most that one could reach."""
        return self.group == _BOUNDS

    def line(self) -> dict[str, Any]:
        """Arguments of ``Axes.plot`` and ``Axes.errorbar``."""
        return {
            "color": self.colour,
            "linestyle": self.dash,
            "linewidth": 2.0 if self.ours else 1.2,
            "zorder": 4 if self.ours else 3,
            **self.dot(),
        }

    def dot(self) -> dict[str, Any]:
        """The part of :meth:`line` that is about the marker."""
        return {
            "marker": self.marker,
            "markersize": 5.2 if self.ours else 4.4,
            "markerfacecolor": self.colour if self.filled else "white",
            "markeredgecolor": self.colour,
            "markeredgewidth": 1.0,
        }


# By the longest beginning of the name that is here, up to a hyphen; in the order of the rows. A method alone is open
# and dashed, the same one refined is filled and solid.
_KNOWN = {
    "pnpnet": SolverStyle(0, BLUE, "o", True, _SOLID),
    "pnpnet-set": SolverStyle(0, BLUE, "D", True, _DASH_DOTTED),
    "net": SolverStyle(0, SKY, "o", False, _DASHED),
    "epnp": SolverStyle(1, VERMILION, "v", False, _DASHED),
    "epnp-lm": SolverStyle(1, VERMILION, "v", True, _SOLID),
    "reppnp": SolverStyle(1, GREEN, "^", False, _DASHED),
    "reppnp-lm": SolverStyle(1, GREEN, "^", True, _SOLID),
    "ransac-epnp-lm": SolverStyle(1, PURPLE, "s", True, _SOLID),
    "p3p-ransac": SolverStyle(2, ORANGE, "P", True, _SOLID),
    "p3p-ransac-noise": SolverStyle(2, ORANGE, "D", False, _DASHED),
    "identity-lm": SolverStyle(2, "#7A5C2E", "X", True, _DASH_DOTTED),
    "opencv-epnp": SolverStyle(3, _BLACK, "<", False, _DOTTED),
    "opencv-sqpnp": SolverStyle(3, _BLACK, "<", True, _DASHED),
    "opencv-ransac": SolverStyle(3, _BLACK, ">", True, _SOLID),
    "opencv-ransac-sqpnp": SolverStyle(3, _BLACK, "*", True, _DASH_DOTTED),
    "opencv-usac": SolverStyle(3, _BLACK, ">", False, _DASH_DOTTED),
    "opencv": SolverStyle(3, _BLACK, "*", False, _DOTTED),
    "poselib": SolverStyle(3, "#8a8a8a", "p", True, _SOLID),
    "pycolmap": SolverStyle(3, "#8a8a8a", "h", False, _DASHED),
    "known-inliers": SolverStyle(_BOUNDS, "#000000", "", True, _DASH_DOTTED),
    "known-inliers-and-noise": SolverStyle(_BOUNDS, "#000000", "", True, _DOTTED),
}
_RANKS = {name: rank for rank, name in enumerate(_KNOWN)}
_MORE_COLOURS, _MORE_MARKERS = ("#882255", "#44AA99", "#999933", "#6644AA", "#AA7766"), ("d", "8", "H", "P")


def solver_styles(names: Iterable[str]) -> dict[str, SolverStyle]:
    """Styles by name, in the order in which solvers are listed.

    Args:
        names: of solvers, options after a colon. Known ones always look the same, and so does a solver with other
            options. Unknown ones differ from each other as long as there are no more than 20.

    Returns:
        A style for each name: sorted by group, within it as the paper lists them, then by name.

    Example:
        >>> list(solver_styles(["poselib", "mine", "epnp-lm:m=3", "pnpnet-n9"]))
        ['pnpnet-n9', 'epnp-lm:m=3', 'poselib', 'mine']
    """
    keys = {name: _known(name) for name in names}
    unknown = sorted({_base(name) for name, key in keys.items() if key is None})
    styles = {}
    for name, key in keys.items():
        if key is not None:
            styles[name] = _KNOWN[key]
        else:
            index = unknown.index(_base(name))
            colour, marker = _MORE_COLOURS[index % 5], _MORE_MARKERS[index % 4]
            styles[name] = SolverStyle(_OTHERS, colour, marker, index % 2 == 0, (_SOLID, _DASHED, _DOTTED)[index % 3])

    def rank(name: str) -> tuple[int, int, list[tuple[int, str]]]:
        return styles[name].group, _RANKS.get(keys[name] or "", 0), _natural(name)

    return {name: styles[name] for name in sorted(styles, key=rank)}


def _base(name: str) -> str:
    return name.partition(":")[0]


def _known(name: str) -> str | None:
    base = _base(name)
    fits = [key for key in _KNOWN if base == key or base.startswith(f"{key}-")]
    return max(fits, key=len, default=None)


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts n9 before n20."""
    return [(int(part), "") if part.isdecimal() else (0, part) for part in re.split(r"(\d+)", name)]


def make_figure(width: float, height: float) -> Figure:
    """An opaque white figure, readable on a dark page too; its size in inches."""
    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def head(figure: Figure, *lines: str) -> None:
    """Say above all panels what they show."""
    figure.suptitle("\n".join(lines), x=0.01, ha="left", fontsize=TITLE, parse_math=False)


def save(figure: Figure, path: str | Path, *, dpi: int = _DPI) -> Path:
    """Write the figure, making folders when missing; the path's ending gives the format."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi)
    return path


def tidy(axes: Axes, grid: Literal["both", "x", "y"] = "both") -> None:
    """Frame on two sides, a pale grid behind the data, small letters."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis=grid, color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(which="both", labelsize=SMALL)
    axes.xaxis.label.set_fontsize(SMALL)
    axes.yaxis.label.set_fontsize(SMALL)


def shortened(name: str, most: int = 27) -> str:
    """The name, its middle left out when it is longer than ``most`` letters.

    Example:
        >>> shortened("outputs/2026-11-21/12-00-00/weights")
        'outputs/2026…-00-00/weights'
    """
    half = (most - 1) // 2
    return name if len(name) <= most else f"{name[: half - 1]}…{name[-half - 1 :]}"


def wrapped(name: str, width: int) -> str:
    """The name in lines of at most ``width`` letters, broken behind signs where it can be."""
    lines = [""]
    for word in re.findall(rf"[^-_ ,/]{{1,{width}}}[-_ ,/]*|[-_ ,/]+", name):
        if lines[-1] and len(lines[-1]) + len(word.rstrip()) > width:
            lines.append("")
        lines[-1] += word
    return "\n".join(line.rstrip() for line in lines)
