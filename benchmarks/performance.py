"""Throughput, latency, cold start and memory beside other libraries: ``python benchmarks/performance.py measure``.

``measure`` writes a results file for each part into this folder; ``render`` writes ``docs/performance.md`` and its
pictures from these files. README.md beside this file describes the measurements.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import page
import timing
from contenders import ANY, FULL, PLAIN, QUICK, TRAINED, WHOLE, N, Settings, make_contenders
from harness import HERE, Row, ratio, recorded, run_child, say, target, threads
from page import CACHED, COLD, EAGER
from timing import BACKWARD, FORWARD

from kornia_pnpnet.evaluation.results import save_results

COMPILED = f"{TRAINED} compiled"


def measure_threads(part: str, settings: Settings, count: int) -> dict[str, list[dict[str, Any]]]:
    """Throughput or latency on ``count`` threads, in this process."""
    with threads(count):
        return (timing.measure_throughput if part == "throughput" else timing.measure_latency)(settings, count)


def measure_part(part: str, settings: Settings) -> dict[str, Any]:
    """Measure throughput, latency or cold starts; rows, skipped contenders and targets."""
    if part == "startup":
        return measure_startup(settings)
    # One process for each number of threads: code is compiled for the threads of its process.
    requests = [{"part": part, "settings": settings._asdict(), "count": count} for count in (1, 2)]
    answers = [
        run_child(Path(__file__), "--child", json.dumps(request), OMP_NUM_THREADS=str(request["count"]))
        for request in requests
    ]
    found = {key: [entry for answer in answers for entry in answer[key]] for key in ("rows", "skipped")}
    targets = throughput_targets if part == "throughput" else latency_targets
    return {**found, "targets": targets(found["rows"])}


# The first batch size shows the compiler's warm-up, the others whether another size compiles again.
_BATCHES = (1000, 999, 100, 10, 1)
_IMPORTS = 5  # processes; the median counts
_IMPORT = (
    "import time, torch, kornia; start = time.perf_counter(); import kornia_pnpnet; print(time.perf_counter() - start)"
)


def measure_startup(settings: Settings) -> dict[str, Any]:
    """Start every contender alone, forward and with gradients, on one thread.

    Compiled contenders start with an empty cache of the compiler, and again with the cache of that first start.
    """
    contenders, skipped = make_contenders(settings)
    starts = []
    for name, contender in contenders.items():
        if name.startswith(PLAIN) and name != WHOLE:
            continue  # as TRAINED
        for backward in (False, True) if contender.differentiable and name != WHOLE else (False,):
            say(f"cold start: {name}{', backward' if backward else ''}")
            # A loop needs the memory of one problem.
            batch = 0 if contender.loops else settings.memory_batch
            starts += start({"contender": name, "backward": backward, "memory_batch": batch}, settings)
    command = [sys.executable, "-c", _IMPORT]
    imports = [
        float(subprocess.run(command, capture_output=True, text=True, check=True).stdout) for _ in range(_IMPORTS)
    ]
    return {"starts": starts, "imports_s": imports, "skipped": skipped, "targets": startup_targets(starts, imports)}


def start(request: Mapping[str, Any], settings: Settings) -> list[dict[str, Any]]:
    """Run ``process.py`` in processes one after the other. Only the last process measures memory."""

    def measured(cache: str, batches: Sequence[int], **environment: str) -> dict[str, Any]:
        wanted = {**request, "batches": batches, "memory_batch": 0 if cache == COLD else request["memory_batch"]}
        found = run_child(HERE / "process.py", json.dumps(wanted), OMP_NUM_THREADS="1", **environment)
        return {**found, "cache": cache}

    if "compiled" not in request["contender"]:
        return [measured(EAGER, [1])]
    batches = [min(size, settings.problems) for size in _BATCHES]
    with tempfile.TemporaryDirectory(prefix="inductor-") as folder:
        return [measured(cache, batches, TORCHINDUCTOR_CACHE_DIR=folder) for cache in (COLD, CACHED)]


def throughput_targets(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Targets of 1000 problems of 9 pairs with 3 mismatches on one thread, where both sides were measured."""
    here = page.matching(rows, threads=1, n=N, batch=1000, mode=FORWARD)
    found = []
    for name, most in (("refinement compiled", 3.0), (f"{TRAINED} compiled", 8.0)):
        if name in here:
            found.append(target(f"`{name}`, per problem", here[name]["median_us"], most, unit="µs"))
    for solver, peer, least in ((TRAINED, "opencv-ransac", 20.0), (TRAINED, "poselib", 10.0), (ANY, "poselib", 5.0)):
        mine = f"{solver} compiled"
        if mine in here and peer in here:
            what = f"`{mine}` against `{peer}`, {FORWARD}"
            found.append(target(what, ratio(here[mine], here[peer]), least, unit="times as fast", at_most=False))
    return found


def latency_targets(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Targets of one problem on one thread."""
    found = []
    alone = page.matching(rows, threads=1)
    for name, most_ms in {WHOLE: 0.4, f"{TRAINED} compiled": 0.4, PLAIN: 3.0, TRAINED: 3.0}.items():
        if row := alone.get(name):
            found.append(target(f"`{name}`, one problem, median", row["median_us"] / 1e3, most_ms, unit="ms"))
            tail = f"`{name}`, one problem, 99th percentile by the median"
            found.append(target(tail, row["p99_us"] / row["median_us"], 2.0))
    return found


def startup_targets(starts: Sequence[Row], imports: Sequence[float]) -> list[dict[str, Any]]:
    """Most seconds of the import, and of making a compiled solver with its first call."""
    what = "`import kornia_pnpnet` after torch and kornia"
    found = [target(what, statistics.median(imports), 0.5, unit="s")] if imports else []
    compiled = [entry for entry in starts if entry["contender"] == COMPILED]
    if any("compil" in text for entry in compiled for text in entry["warnings"]):
        return found  # there is no compiler
    for entry in sorted(compiled, key=lambda entry: (entry["backward"], entry["cache"] == CACHED)):
        most, mode = 20.0 if entry["cache"] == COLD else 5.0, BACKWARD if entry["backward"] else FORWARD
        what, first = f"`{COMPILED}`, first call, {mode}, {entry['cache']}", entry["calls"][0]["first_s"]
        found.append(target(what, entry["make_s"] + first, most, unit="s"))
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and write the results files, or write the page."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("step", nargs="?", choices=("measure", "render"), default="measure")
    command.add_argument("--parts", nargs="+", choices=page.PARTS, default=page.PARTS, help="for measure: only these")
    command.add_argument("--contenders", nargs="+", help="for measure: only these")
    command.add_argument("--quick", action="store_true", help="a few small problems: does everything run?")
    command.add_argument("--results", type=Path, default=HERE, help="folder of the results files")
    command.add_argument("--page", type=Path, default=page.PAGE, help="for render: the page to write")
    command.add_argument("--child", help=argparse.SUPPRESS)  # the request of `measure_part` to a process of its own
    options = command.parse_args(arguments)
    if options.child:
        request = json.loads(options.child)
        print(json.dumps(measure_threads(request["part"], Settings(**request["settings"]), request["count"])))
        return
    if options.step == "render":
        page.render(options.results, options.page)
        return
    contenders = tuple(options.contenders) if options.contenders else None
    settings = (QUICK if options.quick else FULL)._replace(contenders=contenders)
    installed = {entry.name.lower(): entry.version for entry in distributions()}
    for part in options.parts:
        path = options.results / f"{part}.json"
        results = recorded(partial(measure_part, part, settings), **settings._asdict())
        results["environment"]["versions"]["onnxruntime"] = installed.get("onnxruntime")
        save_results(results, path)
        say(f"wrote {path}")


if __name__ == "__main__":
    main()
