"""Write the tables of the page on the examples from their results: ``python docs/examples/tables.py``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from statistics import median
from typing import Any

HERE = Path(__file__).resolve().parent
PAGE = HERE / "README.md"


def localisation(results: dict[str, Any]) -> list[str]:
    """How often each solver succeeded, and its errors."""
    images, unit = results["images"], results["unit"]
    wrong = [row["wrong"] for row in images]
    lines = [
        f"Of the matches of the {len(images)} images, {100 * min(wrong):.0f} % to {100 * max(wrong):.0f} % are wrong:",
        "",
        f"| Solver | images within 1° and {results['limit']} {unit} | rotation, median (largest) error "
        "| camera centre, median (largest) error |",
        "|---|---|---|---|",
    ]
    for name, found in results["solvers"].items():
        turns, centres = (
            [row[name][key] if row[name] else math.inf for row in images] for key in ("rotation_deg", "centre")
        )
        lines.append(
            f"| `{name}` | {found['within_1_deg_and_limit']} | {median(turns):.3f}° ({max(turns):.3f}°) "
            f"| {median(centres):.4f} {unit} ({max(centres):.4f} {unit}) |"
        )
    return lines


def fiducial_board(results: dict[str, Any]) -> list[str]:
    """How often each solver succeeded, and its errors, by the share of the wrong corners."""
    runs = results["runs"]
    lines = [
        f"Share of the {results['frames']} frames with the camera within 10 mm, and median errors of the poses found:",
        "",
        f"| Corners mislabelled | {' | '.join(f'`{name}`' for name in runs)} |",
        "|---|" + len(runs) * "---|",
    ]
    for share in next(iter(runs.values())):
        cells = [
            f"{100 * run[share]['within_10_mm']:.0f} %, {run[share]['median_mm']:.2f} mm, "
            f"{run[share]['median_deg']:.3f}°"
            for run in runs.values()
        ]
        lines.append(f"| {share.replace('%', ' %')} | {' | '.join(cells)} |")
    return lines


def page(text: str) -> str:
    """The page with its tables between the comments that name them."""
    for table in (localisation, fiducial_board):
        path = HERE / f"{table.__name__}.json"
        comment, end = f"<!-- {path.name}, by tables.py -->", "<!-- end -->"
        before, rest = text.split(comment)
        after = rest.split(end, 1)[1]
        text = "\n".join([before + comment, "", *table(json.loads(path.read_text())), "", end + after])
    return text


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text()))
