"""``docs/performance.md`` and its pictures, from ``performance.md.jinja`` and the results files."""

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import harness
import numpy as np
import pandas as pd
from contenders import ANY, COARSE_ANGLE_DEG, COARSE_SHIFT, ITERATIONS, PLAIN, TRAINED, N
from harness import BACKWARD, FORWARD, HERE, Row

from kornia_pnpnet import PnPNet
from kornia_pnpnet.evaluation.plots import WIDTH, log_scale, make_figure, save, themed
from kornia_pnpnet.metrics import SuccessRate

sys.path.append(str(HERE.parent / "docs" / "results"))
import figures

PAGE = HERE.parent / "docs" / "performance.md"
PARTS = ("throughput", "latency", "startup")
#: Caches of the compiler at a start, or no compiler.
COLD, CACHED, EAGER = "cold", "cached", "eager"
#: Solvers of ours that users call, other libraries, and what the pictures show. Ours run in several ways: "NAME WAY".
OURS = (TRAINED, ANY)
PEERS = ("poselib", "pycolmap", "opencv-ransac", "kornia-rs")
DRAWN = (*OURS, *PEERS, "p3p-ransac", "kornia-dlt")

Rows = Mapping[str, Row]  # by contender


def matching(rows: Iterable[Row], **wanted: Any) -> dict[str, Row]:
    """Rows with these values, by contender."""
    return {row["contender"]: row for row in rows if wanted.items() <= row.items()}


def quickest(results: Row) -> list[dict[str, Any]]:
    """The quickest batch of each contender on a GPU, with the times of all batches and the time of PoseLib."""
    rows = [row for row in results["throughput"]["rows"] if "median_us" in row]
    loops = {row["n"]: row["median_us"] for row in rows if row["contender"] == "poselib"}
    found = []
    for group in figures.grouped((row for row in rows if "work" in row), "contender", "n", "mode").values():
        best = min(group, key=lambda row: row["median_us"])
        us = {row["batch"]: row["median_us"] for row in group}
        success = next((row["success"] for row in group if "success" in row), None)  # of the first batch
        found.append({**best, "us": us, "loop_us": loops[best["n"]], "success": success})
    return found


def page(results: Rows, gpu: Row | None = None) -> str:
    """The page as Markdown, from the results files by their names in ``PARTS`` and the one of ``gpu.py``."""
    throughput, latency, starts = results["throughput"], results["latency"]["rows"], results["startup"]["starts"]
    settings, shipped = throughput["settings"], PnPNet.from_pretrained(TRAINED)
    sizes = [entry["calls"][1:] for entry in starts if len(entry["calls"]) > 1]
    first_calls = {
        (x["contender"], x["cache"]): x["make_s"] + x["calls"][0]["first_s"] for x in starts if not x["backward"]
    }

    def at(threads: int, mode: str) -> Rows:
        return matching(throughput["rows"], threads=threads, mode=mode, n=N, batch=settings["problems"])

    alone, many = matching(latency, threads=1), at(1, FORWARD)
    return harness.render(
        "performance.md.jinja",
        **{"trained": TRAINED, "plain": PLAIN, "any": ANY, "n": N, "m": ITERATIONS},
        **{"angle": COARSE_ANGLE_DEG, "shift": 100 * COARSE_SHIFT, "at": at},
        **{"cold": COLD, "cached": CACHED, "eager": EAGER, "forward": FORWARD, "backward": BACKWARD},
        successes=lambda row: str(SuccessRate(**row["success"])).replace(" %", ""),
        shipped={"m": shipped.refine.m, "views": shipped.views},
        made=throughput["environment"],
        results=results,
        settings=settings,
        **{"alone": alone, "two": matching(latency, threads=2), "many": many},
        first_calls=first_calls,
        ours=[name for name in alone if name.partition(" ")[0] in OURS],
        peers=[name for name in PEERS if name in alone],
        sizes=[call["batch"] for call in sizes[0]] if sizes else [],
        gpu=gpu,
        gpu_compiles=any("median_us" in x["modes"].get("compiled", {}) for x in (gpu["graphs"]["rows"] if gpu else ())),
        quickest=quickest(gpu) if gpu else [],
    )


# Line styles by the end of a contender's name. Other names have a dashed line.
_WAYS = {" compiled": "-", " compiled whole": ":", " ONNX": "-.", " packaged": ":"}
_NOT_DRAWN = " compiled", " ONNX", "p3p-ransac"  # of the single calls, whose table has all contenders
_LAST_SHARE = 0.99  # share of the calls drawn; other programs delayed the slowest


def plot_times(path: Path, title: str, panels: Mapping[str, Sequence[Row]], *, against: str, label: str) -> Path:
    """Draw the time per problem against a column of the rows, one panel for each list of rows."""
    tables = {name: pd.DataFrame(rows) for name, rows in panels.items()}
    columns = {"contender": "solver", "median_us": "us", against: label}
    curves = [(name, one.rename(columns=columns), "us") for name, one in tables.items()]
    return figures.draw_curves(path, [title], curves, label, _looks(pd.concat(tables.values()).contender))


@themed
def plot_latency(path: Path, title: str, rows: Sequence[Row]) -> Path:
    """Draw the share of the calls with one problem that end within a time, without the slowest hundredth."""
    rows = [row for row in rows if not row["contender"].endswith(_NOT_DRAWN)]
    found, looks = matching(rows), _looks(row["contender"] for row in rows)
    figure = make_figure(WIDTH, 4.8, title)
    axes = figure.subplots()
    for name, look in looks.items():
        times = np.array(found[name]["quantiles_us"]) / 1e3
        shares = np.linspace(0, 1, len(times))
        kept = shares <= _LAST_SHARE
        axes.plot(times[kept], 100 * shares[kept], **look, markevery=max(1, int(kept.sum()) // 5))
    axes.set(xlabel="ms for one problem", ylabel="calls done (%)", ylim=(0, 100))
    log_scale(axes, "x")
    figures.draw_legend(figure, looks)
    return save(figure, path)


def _looks(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Styles in order: a solver, and behind it the ways in which it also runs."""
    there = set(names)
    bases = {next((name.removesuffix(way) for way in _WAYS if name.endswith(way)), name) for name in there}
    found = {}
    for base, look in figures.solver_styles(bases).items():
        for way, line in {"": "--", **_WAYS}.items():
            if base + way in there:
                alone = not any(base + way in there for way in _WAYS)
                shape = look["color"], look["marker"], look["linestyle"] if alone else line
                found[base + way] = figures.line_style(*shape, ours=figures.is_ours(base) and line != "--")
    return found


def load_parts(folder: Path) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """The results files, and the results file of a GPU when there is one."""
    found = {path.stem: json.loads(path.read_bytes()) for path in folder.glob("*.json") if path.stem in (*PARTS, "gpu")}
    return {part: found[part] for part in PARTS}, found.get("gpu")


def render(folder: Path) -> None:
    """Write the page and its pictures from the results files of a folder."""
    results, gpu = load_parts(folder)

    def drawn(part: str) -> list[Row]:
        return [x for x in results[part]["rows"] if x["threads"] == 1 and x["contender"].partition(" ")[0] in DRAWN]

    rows, alone = drawn("throughput"), drawn("latency")
    pictures, size = PAGE.parent / PAGE.stem, results["throughput"]["settings"]["problems"]
    some = [row for row in rows if row["n"] == N and not row["contender"].endswith(" ONNX")]
    batches = {mode: [row for row in some if row["mode"] == mode] for mode in (FORWARD, BACKWARD)}
    kept = {row["contender"] for row in rows if row["n"] != N}
    pairs = [x for x in rows if x["contender"] in kept and (x["n"] != N or (x["mode"], x["batch"]) == (FORWARD, size))]
    plot_times(pictures / "batch.png", "n = 9, 3 mismatches, one thread", batches, against="batch", label="problems B")
    fewer = "".join(f" ({b} at n = {n})" for n, b in sorted({(x["n"], x["batch"]) for x in pairs}) if b < size)
    title = f"B = {size}{fewer}, a third of the pairs mismatched, one thread"
    plot_times(pictures / "pairs.png", title, {FORWARD: pairs}, against="n", label="pairs n")
    plot_latency(pictures / "latency.png", "One problem at a time, n = 9, 0 to 3 outliers, one thread", alone)
    PAGE.write_text(page(results, gpu), encoding="utf-8")
