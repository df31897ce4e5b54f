"""Write the tables of ``README.md`` and ``clients.md`` from the results: ``python docs/examples/tables.py``."""

from __future__ import annotations

import json
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


def localiser(results: dict[str, Any]) -> str:
    """Recall, errors and time of each solver, and the time of the stages before."""
    settings, images = results["settings"], results["images"]
    limits = [f"{near:g} m, {turn:g}°" for near, turn in results["limits"]]
    lines = []
    for name, found in results["solvers"].items():
        recall = [f"{100 * share:.0f} %" for share in found["recall"]]
        error = f"{100 * found['median']['metres']:.1f} cm, {found['median']['degrees']:.2f}°"
        lines.append([name.replace("pnpnet-set", "`pnpnet-set`"), *recall, error, f"{found['ms']:.1f}"])
    table = markdown_table(["Solver", *limits, "median error", "ms per query"], lines)
    few, many = (100 * median(row[key] for row in images) for key in ("outliers", "outliers_of_all"))
    counts = f"{len(images)} queries, {settings['references']} images of the map"
    outliers = f"Of all matches of a query {many:.0f} % are outliers, of the {settings['pairs']} likeliest {few:.0f} %"
    caption = f"{counts}. {outliers} (medians). Share of the queries within limits:"
    stages = ", ".join(f"{stage} {ms:.1f} ms" for stage, ms in results["stages_ms"].items())
    cpu = results["environment"]["cpu"]
    return f"{caption}\n\n{table}\n\nBefore the solver each query takes: {stages}. Times are of one thread of {cpu}."


def tracking(results: dict[str, Any]) -> str:
    """Frames that are right and time per frame, by the number of pairs, with and without priors."""
    lines = []
    for pairs, ways in results["runs"].items():
        lines.append([pairs, *(f"{100 * x['right']:.0f} %, {100 * x['rmse_m']:.1f} cm" for x in ways.values())])
    times = [median(ways[name]["ms"] for ways in results["runs"].values()) for name in results["runs"][pairs]]
    lines.append(["ms per frame", *(f"{ms:.1f}" for ms in times)])
    near, turn = results["right"]
    right = f"{results['frames']} frames. Share of the frames within {100 * near:.0f} cm and {turn:g}°"
    caption = f"{right}, and root mean square error of the path"
    stages = " and ".join(f"{stage} {ms:.0f} ms" for stage, ms in results["stages_ms"].items())
    table = markdown_table(["Pairs per frame", *ways], lines)
    return f"{caption}:\n\n{table}\n\nBefore the solver each frame takes: {stages}."


def by_share(runs: dict[str, Any], title: str, cell: str) -> str:
    """A table with a line for each fraction of outliers, and a column for each solver."""
    shares = next(iter(runs.values()))
    lines = [[share.replace("%", " %"), *(cell.format_map(run[share]) for run in runs.values())] for share in shares]
    return markdown_table([title, *(f"`{name}`" for name in runs)], lines)


def fiducial_board(results: dict[str, Any]) -> str:
    """Success and errors of each solver, by the share of mislabelled corners."""
    cell = "{within_10_mm:.0%}, {median_mm:.2f} mm, {median_deg:.3f}°"
    table = by_share(results["runs"], "Corners mislabelled", cell).replace("%,", " %,")
    caption = (
        f"Share of the {results['frames']} frames with the camera within 10 mm, and median errors of the poses found"
    )
    return f"{caption}:\n\n{table}"


def incremental_map(results: dict[str, Any]) -> str:
    """Success of each way to register an image, by the fraction of wrong matches."""
    table = by_share(results["runs"], "Wrong matches", "{within_1_deg:.0%}, {median_deg:.3f}°").replace("%,", " %,")
    caption = f"Share of images within 1° and median error, {results['scenes']} scenes of {results['images']} images"
    return f"{caption}:\n\n{table}"


def pose_network(results: dict[str, Any]) -> str:
    """Errors on test images during the trainings."""
    columns = {"ok": "{:.0%}", "rotation_deg": "{:.1f}°", "translation": "{:.2f}", "pixels": "{:.1f} px"}
    lines = []
    for rows in zip(*results["curves"], strict=True):
        cells = [", ".join(form.format(row[name]).replace("%", " %") for row in rows) for name, form in columns.items()]
        lines.append([str(rows[0]["step"]), *cells])
    table = markdown_table(["Step", "`ok`", "rotation", "translation", "keypoints"], lines)
    return f"Share of poses that are `ok` and median errors, on test images:\n\n{table}"


def serve(results: dict[str, Any]) -> str:
    """Latencies and throughput, by the number of clients and of PyTorch's threads."""
    lines = []
    for row in results["rows"]:
        name = "`Server`" if row["solve"] == "Server" else "each client calls the solver"
        times = [f"{row[level]:.0f}" for level in ("p50", "p90", "p99", "per_second")]
        lines.append([f"{row['clients']}", f"{row['threads']}", name, *times])
    header = ["Clients", "PyTorch threads", "", "median (ms)", "90 %", "99 %", "problems per second"]
    return f"{results['requests']} problems of 50 pairs, `pnpnet-set`:\n\n{markdown_table(header, lines)}"


#: The tables of each page.
PAGES = {
    "README.md": (localiser, tracking, keypoint_covariances, fiducial_board, serve),
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
