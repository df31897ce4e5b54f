"""``docs/performance.md`` and its pictures, from ``performance.md.jinja`` and the results files."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import harness
import numpy as np
import pandas as pd
from contenders import ANY, COARSE_ANGLE_DEG, COARSE_SHIFT, ITERATIONS, PLAIN, TRAINED, N
from harness import HERE, Column, Row, digits, percent, pivot, table, targets_table, three_digits
from timing import BACKWARD, FORWARD

from kornia_pnpnet import PnPNet
from kornia_pnpnet.core.files import atomic_open
from kornia_pnpnet.evaluation.plots import WIDTH, log_scale, make_figure, save, themed
from kornia_pnpnet.metrics import SuccessRate

sys.path.append(str(HERE.parent / "docs" / "results"))
import figures

PAGE = HERE.parent / "docs" / "performance.md"
PARTS = ("throughput", "latency", "startup")
#: Caches of the compiler at a start, or no compiler.
COLD, CACHED, EAGER = "cold", "cached", "eager"
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

Rows = Mapping[str, Row]  # by contender


def matching(rows: Iterable[Row], **wanted: Any) -> dict[str, Row]:
    """Rows with these values, by contender."""
    return {row["contender"]: row for row in rows if wanted.items() <= row.items()}


def time_of(rows: Rows, name: str, unit: float = 1.0) -> str:
    """The median time of a contender in ``unit`` microseconds, or a dash."""
    return three_digits(rows[name]["median_us"] / unit) if name in rows else "–"


def successes(row: Row) -> str:
    """Success in per cent with its interval."""
    return str(SuccessRate(**row["success"])).replace(" %", "")


def is_whole(name: str) -> bool:
    """Whether a contender is a solver of ours that users call, as shipped, in any way."""
    return name.partition(" ")[0] in (TRAINED, ANY)


class Summary:
    """The first tables and sentences of the page, from the results files by their names in ``PARTS``."""

    def __init__(self, results: Rows) -> None:
        self.batch = results["throughput"]["settings"]["problems"]
        self.starts = results["startup"]["starts"]
        # One thread, without gradients: single problems, and batches of problems of N pairs.
        self.alone = matching(results["latency"]["rows"], threads=1)
        self.many = matching(results["throughput"]["rows"], threads=1, mode=FORWARD, n=N, batch=self.batch)

    def first_call(self, name: str, cache: str | None = None) -> float | None:
        """Seconds to make a solver and call it once: uncompiled, or with this cache (default: cold)."""
        wanted = cache or (COLD if "compiled" in name else EAGER)
        found = matching(self.starts, contender=name, backward=False, cache=wanted).get(name)
        return None if found is None else float(found["make_s"] + found["calls"][0]["first_s"])

    def ways(self) -> str:
        """When to call a solver in which way, and what that costs; in each cell ``TRAINED`` and ``ANY``."""

        def both(text: Any) -> Column:
            return lambda way: " · ".join(text(solver + way["end"]) for solver in (TRAINED, ANY))

        columns: dict[str, Column] = {
            **{"You have": "{who}", "Use": "{call}"},
            "one problem (ms)": both(lambda name: time_of(self.alone, name, 1e3)),
            f"each of {self.batch} (µs)": both(lambda name: time_of(self.many, name)),
            "first call (s)": both(lambda name: three_digits(first) if (first := self.first_call(name)) else "–"),
        }
        rows = [{"who": who, "call": call, "end": end} for who, call, end in WAYS]
        return table(rows, columns, align="llrrr")

    def compiling_pays(self) -> list[str]:
        """For each solver, its speedup by compiling, and the number of problems that pay for the compiler."""
        found = []
        for name in (TRAINED, ANY):
            compiled = f"{name} compiled"
            seconds = self.first_call(compiled)
            if seconds is None or not all(key in rows for key in (name, compiled) for rows in (self.alone, self.many)):
                continue
            parts = []
            for rows, what in ((self.many, f"in batches of {self.batch}"), (self.alone, "one at a time")):
                slow, fast = rows[name]["median_us"], rows[compiled]["median_us"]
                count = 1e6 * seconds / (slow - fast) if fast < slow else 0.0
                step = 10 ** max(0, len(f"{count:.0f}") - 2)  # two digits
                pays = f"pays after {round(count / step) * step:,} problems" if count else "never pays"
                parts.append(f"{slow / fast:.1f} times as fast {what} ({pays})")
            found.append(f"`{name}` compiled is {' and '.join(parts)}.")
        return found

    def libraries(self) -> str:
        """Whole solvers of ours and of other libraries: one problem at a time, and batches."""
        names = [*filter(is_whole, self.alone), *(peer for peer in PEERS if peer in self.alone)]
        columns: dict[str, Column] = {
            "Solver": "`{contender}`",
            "one problem (ms)": digits("median_us", 1e3),
            f"each of {self.batch} (µs)": lambda row: time_of(self.many, row["contender"]),
            "success, one problem (%)": successes,
        }
        return table((self.alone[name] for name in names), columns)

    def leaders(self) -> list[str]:
        """For one problem and for batches, the fastest of ours and of the other libraries."""
        found = []
        for what, rows in (("One problem at a time", self.alone), ("Batches", self.many)):
            sides = [*filter(is_whole, rows)], [name for name in PEERS if name in rows]
            if all(sides):
                best = (min(side, key=lambda name: rows[name]["median_us"]) for side in sides)
                fast, slow = sorted(best, key=lambda name: rows[name]["median_us"])
                times = rows[slow]["median_us"] / rows[fast]["median_us"]
                found.append(f"{what}: `{fast}` is fastest, {times:.1f} times as fast as `{slow}`.")
        return found


def medians(rows: Iterable[Row], unit: float = 1.0, **wanted: Any) -> Column:
    """A column of the median times of some rows, by the contender of a line."""
    found = matching(rows, **wanted)
    return lambda row: time_of(found, row["contender"], unit)


def throughput_table(results: Row, batch: int) -> str:
    """One batch size on one thread and two, forward and with gradients."""
    rows = [row for row in results["rows"] if (row["n"], row["batch"]) == (N, batch)]
    columns: dict[str, Column] = {
        "Contender": "`{contender}`",
        "forward, one thread": medians(rows, threads=1, mode=FORWARD),
        "two": medians(rows, threads=2, mode=FORWARD),
        "forward+backward, one": medians(rows, threads=1, mode=BACKWARD),
        "two threads": medians(rows, threads=2, mode=BACKWARD),
        "success (%)": successes,
    }
    firsts: dict[str, Row] = {}
    for row in rows:
        firsts.setdefault(row["contender"], row)  # forward, on one thread
    return table(firsts.values(), columns)


def latency_table(results: Row) -> str:
    """The distributions on one thread, and the median on two."""
    named = {"median (ms)": "median_us", "90 %": "p90_us", "99 %": "p99_us", "largest": "max_us"}
    columns: dict[str, Column] = {
        "Contender": "`{contender}`",
        **{title: digits(key, 1e3) for title, key in named.items()},
        "99 % by median": lambda row: f"{row['p99_us'] / row['median_us']:.2f}",
        "median, two threads": medians(results["rows"], 1e3, threads=2),
        "success (%)": successes,
    }
    return table(matching(results["rows"], threads=1).values(), columns)


def startup_table(results: Row) -> str:
    """Cold starts, a line for each contender, mode and cache."""

    def name(entry: Row) -> str:
        kinds = [BACKWARD] * entry["backward"] + [entry["cache"]] * (entry["cache"] != EAGER)
        return ", ".join([f"`{entry['contender']}`", *kinds])

    def later(entry: Row) -> str:
        others = entry["calls"][1:]
        return three_digits(sum(call["first_s"] for call in others)) if others else "–"

    columns: dict[str, Column] = {
        "Contender": name,
        "import (s)": lambda entry: three_digits(entry["torch_s"] + entry["package_s"]),
        "first call (s)": lambda entry: three_digits(entry["make_s"] + entry["calls"][0]["first_s"]),
        "second call (ms)": lambda entry: three_digits(1e3 * entry["calls"][0]["second_s"]),
        "next batch sizes (s)": later,
    }
    # An eager start with gradients is like one without.
    return table((x for x in results["starts"] if not x["backward"] or x["cache"] != EAGER), columns)


def memory_table(results: Row) -> str:
    """How much calls add to the peak of a process."""
    modes = {False: "forward (MiB)", True: "forward+backward (MiB)"}
    rows = [{**entry, "mode": modes[entry["backward"]]} for entry in results["starts"] if entry["memory"]]

    def added(entry: Row) -> str:
        return three_digits((entry["memory"]["peak_bytes"] - entry["memory"]["before_bytes"]) / 2**20)

    return pivot(rows, {"Contender": "`{contender}`"}, modes.values(), added, by="mode")


def gpu_section(results: Row | None) -> dict[str, Any] | None:
    """Tables and facts of the section on a GPU, from the file of ``gpu.py``."""
    if results is None:
        return None
    parity, part = results["parity"], results["throughput"]
    rows = [row for row in part["rows"] if "median_us" in row]
    loops = {row["n"]: row for row in rows if row["contender"] == "poselib"}
    sizes = {f"B = {batch}": batch for batch in part["settings"]["batches"]}
    groups: dict[tuple[str, int, str], dict[int, Row]] = {}
    for row in rows:
        if "work" in row:
            groups.setdefault((row["contender"], row["n"], row["mode"]), {})[row["batch"]] = row
    lines, quickest = [], {}
    for (name, n, mode), found in groups.items():
        best = min(found.values(), key=lambda row: row["median_us"])
        faster = f"{loops[n]['median_us'] / best['median_us']:.0f}"
        us = {batch: three_digits(row["median_us"]) for batch, row in found.items()}
        times = {title: us.get(batch, "–") for title, batch in sizes.items()}
        lines.append({**best, **best["shares"], **times, "faster": faster})
        if (n, mode) == (N, FORWARD):
            quickest[name] = us[best["batch"]], faster
    columns: dict[str, Column] = {
        **{"Contender": "`{contender}`", "mode": "{mode}", "n": "{n}", **{title: f"{{{title}}}" for title in sizes}},
        "times as fast as PoseLib": "{faster}",
        "memory (KiB a problem)": lambda row: three_digits(row["peak_bytes"] / row["batch"] / 1024),
        **{"floor (%)": percent("floor"), "traffic (%)": percent("traffic")},
    }
    calls = [
        {**row, **found, "mode": mode}
        for row in results["graphs"]["rows"]
        for mode, found in row["modes"].items()
        if "median_us" in found
    ]
    graphs: dict[str, Column] = {"Solver": "`{solver}`", "mode": "{mode}", "problems": "{batch}"}
    compared: dict[str, Column] = {
        **{"Solver": "`{solver}`", "dtype": "{dtype}", "success, CPU (%)": percent("cpu"), "GPU (%)": percent("gpu")},
        **{f"same {key} (%)": percent(f"same_{key}") for key in ("ok", "pose", "gradient")},
    }
    complete = [
        {**row, **dict(zip(("cpu", "gpu"), row["success"], strict=True))}
        for row in parity["rows"]
        if None not in (row.get("same_pose"), row.get("same_gradient"))
    ]
    return {
        "made": part["environment"],
        "poselib": {"us": loops[N]["median_us"], "n": N},
        "count": parity["settings"]["parity"],
        "best": [(name, *quickest[name]) for name in (TRAINED, ANY)],
        "throughput": table(lines, columns),
        "graphs": table(calls, {**graphs, "a call (ms)": digits("median_us", 1e3)}),
        "parity": table(complete, compared),
    }


def skipped_reasons(results: Rows) -> list[str]:
    """Why a row is missing, each reason once."""
    found: dict[str, None] = {}
    for part in PARTS:
        for entry in results[part]["skipped"]:
            place = ", ".join(f"{key} = {entry[key]}" for key in ("n", "batch") if key in entry)
            mode = f", {entry['mode']}" if entry.get("mode") == BACKWARD else ""
            found[f"`{entry['contender']}`{f' at {place}' if place else ''}{mode}: {entry['why']}."] = None
    return list(found)


def page(results: Rows, gpu: Row | None = None) -> str:
    """The page as Markdown, from the results files by their names in ``PARTS`` and the one of ``gpu.py``."""
    settings, shipped, summary = results["throughput"]["settings"], PnPNet.from_pretrained(TRAINED), Summary(results)
    targets = [entry for part in PARTS for entry in results[part]["targets"]]
    sizes = [entry["calls"][1:] for entry in results["startup"]["starts"] if len(entry["calls"]) > 1]
    return harness.render(
        "performance.md.jinja",
        **{"trained": TRAINED, "plain": PLAIN, "any": ANY, "n": N, "m": ITERATIONS},
        **{"angle": COARSE_ANGLE_DEG, "shift": 100 * COARSE_SHIFT},
        shipped={"m": shipped.refine.m, "views": shipped.views},
        made=results["throughput"]["environment"],
        results=results,
        settings=settings,
        ways=summary.ways(),
        cached=[(name, summary.first_call(f"{name} compiled", CACHED)) for name in (TRAINED, ANY)],
        pays=summary.compiling_pays(),
        libraries=summary.libraries(),
        leaders=summary.leaders(),
        met=(sum(entry["met"] for entry in targets), len(targets)),
        targets=targets_table(targets),
        throughput=throughput_table(results["throughput"], summary.batch),
        latency=latency_table(results["latency"]),
        sizes=[call["batch"] for call in sizes[0]] if sizes else [],
        startup=startup_table(results["startup"]),
        memory=memory_table(results["startup"]),
        gpu=gpu_section(gpu),
        skipped=skipped_reasons(results),
    )


# Line styles by the end of a contender's name. Other names have a dashed line.
_WAYS = {" compiled": "-", " compiled whole": ":", " ONNX": "-.", " packaged": ":"}
_LAST_SHARE = 0.99  # share of the calls drawn; other programs delayed the slowest


def plot_times(path: Path, title: str, panels: Mapping[str, Sequence[Row]], *, against: str, label: str) -> Path:
    """Draw the time per problem against a column of the rows, one panel for each list of rows."""
    tables = {name: pd.DataFrame(rows).assign(solver=lambda one: one.contender) for name, rows in panels.items()}
    columns = {"median_us": "us", against: label}
    curves = [(name, one.rename(columns=columns), "us") for name, one in tables.items()]
    return figures.draw_curves(path, [title], curves, label, _looks(pd.concat(tables.values()).contender))


@themed
def plot_latency(path: Path, title: str, rows: Sequence[Row]) -> Path:
    """Draw the share of the calls with one problem that end within a time, without the slowest hundredth."""
    looks = _looks(row["contender"] for row in rows)
    figure = make_figure(WIDTH, 4.8, title)
    axes = figure.subplots()
    for name, look in looks.items():
        for row in rows:
            if row["contender"] != name:
                continue
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


def is_drawn(row: Row) -> bool:
    """Whether the pictures show a row: solvers of ours that users call, and other libraries, on one thread."""
    return row["threads"] == 1 and (is_whole(row["contender"]) or row["contender"] in (*PEERS, *DRAWN))


def load_parts(folder: Path) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """The results files, and the results file of a GPU when there is one."""
    results = {part: json.loads((folder / f"{part}.json").read_text(encoding="utf-8")) for part in PARTS}
    gpu = folder / "gpu.json"
    return results, json.loads(gpu.read_text(encoding="utf-8")) if gpu.exists() else None


def render(folder: Path, path: Path) -> None:
    """Write the page and its pictures from the results files of a folder."""
    results, gpu = load_parts(folder)
    rows = [row for row in results["throughput"]["rows"] if is_drawn(row)]
    pictures, size = path.parent / path.stem, results["throughput"]["settings"]["problems"]
    batches = {mode: [row for row in rows if (row["mode"], row["n"]) == (mode, N)] for mode in (FORWARD, BACKWARD)}
    pairs = [row for row in rows if row["mode"] == FORWARD and (row["batch"] == size or row["n"] != N)]
    plot_times(pictures / "batch.png", "n = 9, 3 mismatches, one thread", batches, against="batch", label="problems B")
    fewer = "".join(f" ({b} at n = {n})" for n, b in sorted({(x["n"], x["batch"]) for x in pairs}) if b < size)
    title = f"B = {size}{fewer}, a third of the pairs mismatched, one thread"
    plot_times(pictures / "pairs.png", title, {FORWARD: pairs}, against="n", label="pairs n")
    alone = [row for row in results["latency"]["rows"] if is_drawn(row)]
    plot_latency(pictures / "latency.png", "One problem at a time, n = 9, 0 to 3 outliers, one thread", alone)
    with atomic_open(path, encoding="utf-8") as file:
        file.write(page(results, gpu))
