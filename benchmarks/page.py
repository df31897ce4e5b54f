"""``docs/performance.md`` and its pictures, from ``performance.md.jinja`` and the results files."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from contenders import ANY, PLAIN, TRAINED, N
from harness import HERE, Row
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from startup import CACHED, COLD, EAGER
from tasks import COARSE_ANGLE_DEG, COARSE_SHIFT, ITERATIONS
from timing import BACKWARD, FORWARD

from kornia_pnpnet import PnPNet
from kornia_pnpnet.core.files import atomic_open
from kornia_pnpnet.core.tables import markdown_table
from kornia_pnpnet.evaluation.plots import WIDTH, log_scale, make_figure, save, themed
from kornia_pnpnet.metrics import SuccessRate

sys.path.append(str(HERE.parent / "docs" / "results"))
import figures

PAGE = HERE.parent / "docs" / "performance.md"
PARTS = ("throughput", "latency", "startup")

#: Who calls a solver in which way, and how the names of such contenders end.
WAYS = (
    ("a notebook, or batches of any size", "`solver(...)`: eager", ""),
    ("one solver in a loop for minutes", "`solver.compile()`", " compiled"),
    ("one problem at a time: a robot, a service, C++", "`pnpnet export x.pt2`: packaged", " packaged"),
    ("no PyTorch on the machine", "`pnpnet export x.onnx`", " ONNX"),
)
#: Contenders that the pictures also show.
DRAWN = ("p3p-ransac", "kornia-dlt")
#: Other libraries.
PEERS = ("poselib", "pycolmap", "opencv-ransac", "kornia-rs")


def three_digits(value: float) -> str:
    """Three significant digits, never an exponent."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:#.3g}".rstrip(".")


def percent(rate: Mapping[str, Any]) -> str:
    """Success with its interval, without the sign."""
    return str(SuccessRate(**rate)).replace(" %", "")


def matching(rows: Iterable[Row], **wanted: Any) -> dict[str, Row]:
    """Rows with these values, by contender."""
    return {row["contender"]: row for row in rows if all(row[key] == value for key, value in wanted.items())}


def time_of(rows: Mapping[str, Row], name: str, unit: float = 1.0) -> str:
    """The median time of a contender in ``unit`` microseconds, or a dash."""
    return three_digits(rows[name]["median_us"] / unit) if name in rows else "–"


def ways_table(results: Mapping[str, Mapping[str, Any]], batch: int) -> str:
    """When to call a solver in which way, and what that costs; in each cell ``TRAINED`` and ``ANY``."""
    alone, many = latency_rows(results), batch_rows(results, batch)
    lines = []
    for who, call, way in WAYS:
        names = [f"{solver}{way}" for solver in (TRAINED, ANY)]
        times = [[time_of(rows, name, unit) for name in names] for rows, unit in ((alone, 1e3), (many, 1.0))]
        firsts = [three_digits(first) if (first := first_call(results, name)) else "–" for name in names]
        lines.append((who, call, *(" · ".join(cells) for cells in (*times, firsts))))
    head = ("You have", "Use", "one problem (ms)", f"each of {batch} (µs)", "first call (s)")
    return markdown_table(head, lines, align="llrrr")


def latency_rows(results: Mapping[str, Mapping[str, Any]]) -> dict[str, Row]:
    """The times of single problems on one thread, by contender."""
    return matching(results["latency"]["rows"], threads=1)


def batch_rows(results: Mapping[str, Mapping[str, Any]], batch: int) -> dict[str, Row]:
    """The times of batches of ``N`` pairs on one thread without gradients, by contender."""
    return matching(results["throughput"]["rows"], threads=1, mode=FORWARD, n=N, batch=batch)


def first_call(results: Mapping[str, Mapping[str, Any]], name: str, cache: str | None = None) -> float | None:
    """Seconds to make a solver and call it once, without gradients: uncompiled, or with this cache (default: cold)."""
    wanted = cache or (COLD if "compiled" in name else EAGER)
    for entry in results["startup"]["starts"]:
        if (entry["contender"], entry["backward"], entry["cache"]) == (name, False, wanted):
            return float(entry["make_s"] + entry["calls"][0]["first_s"])
    return None


def compiling_pays(results: Mapping[str, Mapping[str, Any]], batch: int) -> list[str]:
    """For each solver, how much faster it is compiled, and after how many problems that has paid for the compiler."""
    alone, many = latency_rows(results), batch_rows(results, batch)
    found = []
    for name in (TRAINED, ANY):
        compiled = f"{name} compiled"
        seconds = first_call(results, compiled)
        if seconds is None or not all(key in rows for key in (name, compiled) for rows in (alone, many)):
            continue
        parts = []
        for rows, what in ((many, f"in batches of {batch}"), (alone, "one at a time")):
            slow, fast = rows[name]["median_us"], rows[compiled]["median_us"]
            pays = f"pays after {rounded(1e6 * seconds / (slow - fast))} problems" if fast < slow else "never pays"
            parts.append(f"{slow / fast:.1f} times as fast {what} ({pays})")
        found.append(f"`{name}` compiled is {' and '.join(parts)}.")
    return found


def rounded(count: float) -> str:
    """A number of problems with two digits."""
    step = 10 ** max(0, len(f"{count:.0f}") - 2)
    return f"{round(count / step) * step:,}"


def libraries_table(results: Mapping[str, Mapping[str, Any]], batch: int) -> str:
    """Whole solvers of ours and of other libraries: one problem at a time, and batches."""
    alone, many = latency_rows(results), batch_rows(results, batch)
    names = (*whole_solvers(alone), *(peer for peer in PEERS if peer in alone))
    lines = [(f"`{x}`", time_of(alone, x, 1e3), time_of(many, x), percent(alone[x]["success"])) for x in names]
    return markdown_table(("Solver", "one problem (ms)", f"each of {batch} (µs)", "success, one problem (%)"), lines)


def whole_solvers(rows: Mapping[str, Row]) -> list[str]:
    """The contenders of ours that users call: as shipped, in any way."""
    return [name for name in rows if name.partition(" ")[0] in (TRAINED, ANY)]


def is_drawn(name: str) -> bool:
    """Whether the pictures show a contender: solvers of ours that users call, and other libraries at their best."""
    return name.partition(" ")[0] in (TRAINED, ANY) or name in (*PEERS, *DRAWN)


def leaders(results: Mapping[str, Mapping[str, Any]], batch: int) -> list[str]:
    """For one problem and for batches, the fastest of ours and of the other libraries."""
    found = []
    for what, rows in (("One problem at a time", latency_rows(results)), ("Batches", batch_rows(results, batch))):
        sides = whole_solvers(rows), [name for name in PEERS if name in rows]
        if all(sides):
            ours, theirs = (min(side, key=lambda name: rows[name]["median_us"]) for side in sides)
            ratio = rows[theirs]["median_us"] / rows[ours]["median_us"]
            fastest, other = (ours, theirs) if ratio > 1 else (theirs, ours)
            found.append(f"{what}: `{fastest}` is fastest, {max(ratio, 1 / ratio):.1f} times as fast as `{other}`.")
    return found


def targets_table(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Every target beside the measurement."""
    lines = []
    for part in PARTS:
        for entry in results[part]["targets"]:
            bound, unit = "at most" if entry["at_most"] else "at least", f" {entry['unit']}".rstrip()
            measured = f"{three_digits(entry['measured'])}{unit}"
            verdict = "met" if entry["met"] else "**missed**"
            lines.append((entry["what"], f"{bound} {entry['target']:g}{unit}", measured, verdict))
    return markdown_table(("What", "Wanted", "Measured", "Verdict"), lines)


def throughput_table(results: Mapping[str, Any], batch: int) -> str:
    """One batch size on one thread and two, forward and with gradients."""
    rows = [row for row in results["rows"] if (row["n"], row["batch"]) == (N, batch)]
    columns = [matching(rows, threads=count, mode=mode) for mode in (FORWARD, BACKWARD) for count in (1, 2)]
    rates: dict[str, Any] = {}
    for row in rows:
        rates.setdefault(row["contender"], row["success"])  # the first: of one thread, forward
    lines = [(f"`{x}`", *(time_of(column, x) for column in columns), percent(rates[x])) for x in rates]
    head = ("Contender", "one thread", "two", "forward+backward, one", "two", "success (%)")
    return markdown_table(head, lines)


def latency_table(results: Mapping[str, Any]) -> str:
    """The distributions on one thread, and the median on two."""
    one, two = (matching(results["rows"], threads=count) for count in (1, 2))
    lines = []
    for name, row in one.items():
        cells = [three_digits(row[key] / 1e3) for key in ("median_us", "p90_us", "p99_us", "max_us")]
        cells += [f"{row['p99_us'] / row['median_us']:.2f}", time_of(two, name, 1e3), percent(row["success"])]
        lines.append((f"`{name}`", *cells))
    head = ("Contender", "median (ms)", "90 %", "99 %", "largest", "99 % by median", "median, two threads")
    return markdown_table((*head, "success (%)"), lines)


def startup_table(results: Mapping[str, Any]) -> str:
    """Cold starts, a line for each contender, mode and cache."""
    lines = []
    for entry in results["starts"]:
        if entry["backward"] and entry["cache"] == EAGER:
            continue  # eager with gradients starts as without
        first, *others = entry["calls"]
        kinds = [BACKWARD] * entry["backward"] + [entry["cache"]] * (entry["cache"] != EAGER)
        times = (entry["torch_s"] + entry["package_s"], entry["make_s"] + first["first_s"], 1e3 * first["second_s"])
        later = three_digits(sum(call["first_s"] for call in others)) if others else "–"
        lines.append((", ".join([f"`{entry['contender']}`", *kinds]), *map(three_digits, times), later))
    head = ("Contender", "import (s)", "first call (s)", "second call (ms)", "next batch sizes (s)")
    return markdown_table(head, lines)


def memory_table(results: Mapping[str, Any]) -> str:
    """How much calls add to the peak of a process."""
    found: dict[str, dict[bool, str]] = {}
    for entry in results["starts"]:
        if entry["memory"] is not None:
            added = (entry["memory"]["peak_bytes"] - entry["memory"]["before_bytes"]) / 2**20
            found.setdefault(entry["contender"], {})[entry["backward"]] = three_digits(added)
    lines = [(f"`{name}`", cells.get(False, "–"), cells.get(True, "–")) for name, cells in found.items()]
    return markdown_table(("Contender", "forward (MiB)", "forward+backward (MiB)"), lines)


def of_hundred(share: float) -> str:
    """A share in percent, without the sign."""
    return f"{100 * share:.1f}"


def gpu_section(results: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """What the page says of a GPU, from the file of ``gpu.py``."""
    if results is None:
        return None
    rows = [row for row in results["throughput"]["rows"] if "median_us" in row]
    loops = {row["n"]: row for row in rows if row["contender"] == "poselib"}
    batches = results["throughput"]["settings"]["batches"]
    lines, quickest = [], {}
    for name, n, mode in dict.fromkeys((row["contender"], row["n"], row["mode"]) for row in rows if "work" in row):
        found = {row["batch"]: row for row in rows if (row["contender"], row["n"], row["mode"]) == (name, n, mode)}
        best = min(found.values(), key=lambda row: row["median_us"])
        times = [three_digits(found[batch]["median_us"]) if batch in found else "–" for batch in batches]
        faster = loops[n]["median_us"] / best["median_us"]
        limits = [of_hundred(best["shares"][key]) for key in ("floor", "traffic")]
        memory = three_digits(best["peak_bytes"] / best["batch"] / 1024)
        lines.append((f"`{name}`", mode, f"{n}", *times, f"{faster:.0f}", memory, *limits))
        if (n, mode) == (N, FORWARD):
            quickest[name] = three_digits(best["median_us"]), f"{faster:.0f}"
    sizes = [f"B = {batch}" for batch in batches]
    measured = "times as fast as PoseLib", "memory (KiB a problem)", "floor (%)", "traffic (%)"
    heads = ("Contender", "mode", "n", *sizes, *measured)
    calls = [
        (f"`{row['solver']}`", mode, f"{row['batch']}", three_digits(1e-3 * found["median_us"]))
        for row in results["graphs"]["rows"]
        for mode, found in row["modes"].items()
        if "median_us" in found
    ]
    shares = ("same_ok", "same_pose", "same_gradient")
    parity = [
        (f"`{row['solver']}`", row["dtype"], *map(of_hundred, (*row["success"], *(row[key] for key in shares))))
        for row in results["parity"]["rows"]
        if "why" not in row and None not in [row[key] for key in shares]
    ]
    return {
        "made": results["throughput"]["environment"],
        "poselib": {"us": loops[N]["median_us"], "n": N},
        "count": results["parity"]["settings"]["parity"],
        "best": [(name, *quickest[name]) for name in (TRAINED, ANY)],
        "throughput": markdown_table(heads, lines),
        "graphs": markdown_table(("Solver", "mode", "problems", "a call (ms)"), calls),
        "parity": markdown_table(
            ("Solver", "dtype", "success, CPU (%)", "GPU (%)", "same ok (%)", "same pose (%)", "same gradient (%)"),
            parity,
        ),
    }


def skipped_reasons(results: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Why a row is missing, each reason once."""
    found: dict[str, None] = {}
    for part in PARTS:
        for entry in results[part]["skipped"]:
            place = ", ".join(f"{key} = {entry[key]}" for key in ("n", "batch") if key in entry)
            mode = f", {entry['mode']}" if entry.get("mode") == BACKWARD else ""
            found[f"`{entry['contender']}`{f' at {place}' if place else ''}{mode}: {entry['why']}."] = None
    return list(found)


def page(results: Mapping[str, Mapping[str, Any]], gpu: Mapping[str, Any] | None = None) -> str:
    """The page as Markdown, from the results files by their names in ``PARTS`` and the one of ``gpu.py``."""
    settings, shipped = results["throughput"]["settings"], PnPNet.from_pretrained(TRAINED)
    batch = settings["problems"]
    targets = [entry for part in PARTS for entry in results[part]["targets"]]
    sizes = [entry["calls"][1:] for entry in results["startup"]["starts"] if len(entry["calls"]) > 1]
    options: dict[str, Any] = {"trim_blocks": True, "keep_trailing_newline": True, "undefined": StrictUndefined}
    environment = Environment(loader=FileSystemLoader(HERE), autoescape=False, **options)
    return environment.get_template("performance.md.jinja").render(
        **{"trained": TRAINED, "plain": PLAIN, "any": ANY, "n": N, "m": ITERATIONS},
        **{"angle": COARSE_ANGLE_DEG, "shift": 100 * COARSE_SHIFT},
        shipped={"m": shipped.refine.m, "views": shipped.views},
        made=results["throughput"]["environment"],
        results=results,
        settings=settings,
        ways=ways_table(results, batch),
        cached=[(name, first_call(results, f"{name} compiled", CACHED)) for name in (TRAINED, ANY)],
        pays=compiling_pays(results, batch),
        libraries=libraries_table(results, batch),
        leaders=leaders(results, batch),
        met=(sum(entry["met"] for entry in targets), len(targets)),
        targets=targets_table(results),
        throughput=throughput_table(results["throughput"], batch),
        latency=latency_table(results["latency"]),
        sizes=[call["batch"] for call in sizes[0]] if sizes else [],
        startup=startup_table(results["startup"]),
        memory=memory_table(results["startup"]),
        gpu=gpu_section(gpu),
        skipped=skipped_reasons(results),
    )


# -- pictures ----------------------------------------------------------------------------------------------------------

# Lines by the end of a name, which says how the solver runs. Without such an end the line is dashed.
_WAYS = {" compiled": "-", " compiled whole": ":", " ONNX": "-.", " packaged": ":"}
_LAST_SHARE = 0.99  # share of the calls drawn; other programs delayed the slowest


def plot_times(
    path: Path, title: str, panels: Mapping[str, Sequence[Mapping[str, Any]]], *, against: str, label: str
) -> Path:
    """Draw the time per problem against a column of the rows, one panel for each list of rows."""
    tables = {name: pd.DataFrame(rows).assign(solver=lambda table: table.contender) for name, rows in panels.items()}
    columns = {"median_us": "us", against: label}
    curves = [(name, table.rename(columns=columns), "us") for name, table in tables.items()]
    return figures.draw_curves(path, [title], curves, label, _looks(pd.concat(tables.values()).contender))


@themed
def plot_latency(path: Path, title: str, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Draw the share of the calls with one problem that end within a time, without the slowest hundredth."""
    looks = _looks(row["contender"] for row in rows)
    figure = make_figure(WIDTH, 4.8, title)
    axes = figure.subplots()
    for name, look in looks.items():
        for row in (row for row in rows if row["contender"] == name):
            shares = np.linspace(0, 1, len(row["quantiles_us"]))
            kept = shares <= _LAST_SHARE
            x, y = np.array(row["quantiles_us"])[kept] / 1e3, 100 * shares[kept]
            axes.plot(x, y, **look, markevery=max(1, len(x) // 5))
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
    results = {part: json.loads((folder / f"{part}.json").read_text(encoding="utf-8")) for part in PARTS}
    gpu = folder / "gpu.json"
    return results, json.loads(gpu.read_text(encoding="utf-8")) if gpu.exists() else None


def render(folder: Path, path: Path) -> None:
    """Write the page and its pictures from the results files of a folder."""
    results, gpu = load_parts(folder)
    rows = [row for row in results["throughput"]["rows"] if row["threads"] == 1 and is_drawn(row["contender"])]
    pictures, size = path.parent / path.stem, results["throughput"]["settings"]["problems"]
    batches = {mode: [row for row in rows if (row["mode"], row["n"]) == (mode, N)] for mode in (FORWARD, BACKWARD)}
    pairs = [row for row in rows if row["mode"] == FORWARD and (row["batch"] == size or row["n"] != N)]
    plot_times(pictures / "batch.png", "n = 9, 3 mismatches, one thread", batches, against="batch", label="problems B")
    fewer = "".join(f" ({b} at n = {n})" for n, b in sorted({(x["n"], x["batch"]) for x in pairs}) if b < size)
    title = f"B = {size}{fewer}, a third of the pairs mismatched, one thread"
    plot_times(pictures / "pairs.png", title, {FORWARD: pairs}, against="n", label="pairs n")
    alone = [row for row in results["latency"]["rows"] if row["threads"] == 1 and is_drawn(row["contender"])]
    plot_latency(pictures / "latency.png", "One problem at a time, n = 9, 0 to 3 wrong pairs, one thread", alone)
    with atomic_open(path, encoding="utf-8") as file:
        file.write(page(results, gpu))
