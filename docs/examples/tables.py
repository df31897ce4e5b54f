"""Write the tables of ``README.md`` and ``clients.md`` from the results: ``python docs/examples/tables.py``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from statistics import median
from typing import Any

from kornia_pnpnet.core.tables import markdown_table

HERE = Path(__file__).resolve().parent


def keypoint_covariances(results: dict[str, Any]) -> str:
    """Errors of the networks that predict each kind of noise."""
    seeds = list(results["seeds"].values())
    lines = []
    for noise in list(seeds[0])[1:]:  # the first network is the start of all
        columns = (("mean_distance", 3), ("median_distance", 3), ("mean_rotation_deg", 2), ("mean_keypoint_px", 2))
        cells = [", ".join(f"{found[noise][key]:.{digits}f}" for found in seeds) for key, digits in columns]
        lines.append([noise, *cells])
    header = ["Noise predicted", "mean distance", "median distance", "mean rotation error (°)", "keypoints (px)"]
    updates = f"{results['updates']} + {results['updates'] // 2} updates"
    return f"Errors on test images after {updates}, {len(seeds)} seeds:\n\n{markdown_table(header, lines)}"


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
    header = ["Corners mislabelled", *(f"`{name}`" for name in runs)]
    return f"{share}, and median errors of the poses found:\n\n{markdown_table(header, lines)}"


def incremental_map(results: dict[str, Any]) -> str:
    """Success of each way to register an image, by the share of wrong matches."""
    runs = results["runs"]
    lines = []
    for share in next(iter(runs.values())):
        cells = [f"{100 * run[share]['within_1_deg']:.0f} %, {run[share]['median_deg']:.3f}°" for run in runs.values()]
        lines.append([share.replace("%", " %"), *cells])
    header = ["Wrong matches", *(f"`{name}`" for name in runs)]
    caption = f"Share of images within 1° and median error, {results['scenes']} scenes of {results['images']} images"
    return f"{caption}:\n\n{markdown_table(header, lines)}"


def pose_network(results: dict[str, Any]) -> str:
    """Errors of the networks of each loss."""
    lines = []
    for name, rows in results["runs"].items():
        turns = ", ".join(f"{row['rotation_deg']:.1f}°" for row in rows)
        shifts = ", ".join(f"{row['translation']:.2f}" for row in rows)
        lines.append([name, turns, shifts])
    seeds = len(next(iter(results["runs"].values())))
    caption = f"Median errors on test poses after {results['steps']} steps from nothing, {seeds} seeds"
    return f"{caption}:\n\n{markdown_table(['Loss', 'rotation', 'translation'], lines)}"


#: The tables of each page.
PAGES = {
    "README.md": (keypoint_covariances, localisation, fiducial_board),
    "clients.md": (incremental_map, pose_network),
}


def page(name: str) -> str:
    """A page with its tables between the comments that name their files."""
    text = (HERE / name).read_text()
    for table in PAGES[name]:
        path = HERE / f"{table.__name__}.json"
        comment, end = f"<!-- {path.name}, by tables.py -->", "<!-- end -->"
        before, rest = text.split(comment)
        after = rest.split(end, 1)[1]
        text = f"{before}{comment}\n\n{table(json.loads(path.read_text()))}\n\n{end}{after}"
    return text


if __name__ == "__main__":
    for name in PAGES:
        (HERE / name).write_text(page(name))
