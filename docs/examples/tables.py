"""Write the tables of ``README.md`` from the results of the examples: ``python docs/examples/tables.py``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from statistics import median
from typing import Any

from kornia_pnpnet.core.tables import markdown_table

HERE = Path(__file__).resolve().parent
PAGE = HERE / "README.md"


def localisation(results: dict[str, Any]) -> str:
    """Success and errors of each solver."""
    images, unit = results["images"], results["unit"]
    wrong = [row["wrong"] for row in images]
    lines = []
    for name, found in results["solvers"].items():
        turns, centres = (
            [row[name][key] if row[name] else math.inf for row in images] for key in ("rotation_deg", "centre")
        )
        turn = f"{median(turns):.3f}° ({max(turns):.3f}°)"
        centre = f"{median(centres):.4f} {unit} ({max(centres):.4f} {unit})"
        lines.append([f"`{name}`", f"{found['within_1_deg_and_limit']}", turn, centre])
    within = f"images within 1° and {results['limit']} {unit}"
    header = ["Solver", within, "rotation, median (largest) error", "camera centre, median (largest) error"]
    share = f"{100 * min(wrong):.0f} % to {100 * max(wrong):.0f} %"
    return f"{share} of the matches of an image are outliers ({len(images)} images):\n\n{markdown_table(header, lines)}"


def fiducial_board(results: dict[str, Any]) -> str:
    """Success and errors of each solver, by the share of mislabelled corners."""
    runs = results["runs"]
    lines = []
    for share in next(iter(runs.values())):
        cells = [
            f"{100 * run[share]['within_10_mm']:.0f} %, {run[share]['median_mm']:.2f} mm, "
            f"{run[share]['median_deg']:.3f}°"
            for run in runs.values()
        ]
        lines.append([share.replace("%", " %"), *cells])
    share = f"Share of the {results['frames']} frames with the camera within 10 mm"
    table = markdown_table(["Corners mislabelled", *(f"`{name}`" for name in runs)], lines)
    return f"{share}, and median errors of the poses found:\n\n{table}"


def page(text: str) -> str:
    """The page with its tables between the comments that name their files."""
    for table in (localisation, fiducial_board):
        path = HERE / f"{table.__name__}.json"
        comment, end = f"<!-- {path.name}, by tables.py -->", "<!-- end -->"
        before, rest = text.split(comment)
        after = rest.split(end, 1)[1]
        text = f"{before}{comment}\n\n{table(json.loads(path.read_text()))}\n\n{end}{after}"
    return text


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text()))
