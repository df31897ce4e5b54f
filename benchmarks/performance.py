"""Throughput, latency, cold start and memory beside other libraries: ``python benchmarks/performance.py measure``.

``measure`` writes a results file for each part into this folder; ``render`` writes ``docs/performance.md`` and its
pictures from these files. README.md beside this file describes the measurements.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from functools import partial
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import page
import timing
from contenders import FULL, QUICK, Settings
from harness import HERE, parser, recorded, run_child, say
from startup import measure_startup

from kornia_pnpnet.evaluation.results import save_results


def measure_threads(part: str, settings: Settings, count: int) -> dict[str, list[dict[str, Any]]]:
    """Throughput or latency on ``count`` threads, in this process."""
    measure_here = timing.measure_throughput if part == "throughput" else timing.measure_latency
    return measure_here(settings, count=count)


def measure_part(part: str, settings: Settings) -> dict[str, Any]:
    """Measure throughput or latency; rows, skipped contenders and targets."""
    if part == "startup":
        return measure_startup(settings)
    # One process for each number of threads: code is compiled for the threads of its process.
    requests = [{"part": part, "settings": settings._asdict(), "count": count} for count in (1, 2)]
    answers = [
        run_child(Path(__file__), "--child", json.dumps(request), OMP_NUM_THREADS=str(request["count"]))
        for request in requests
    ]
    found = {key: [entry for answer in answers for entry in answer[key]] for key in ("rows", "skipped")}
    targets = timing.throughput_targets if part == "throughput" else timing.latency_targets
    return {**found, "targets": targets(found["rows"])}


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and write the results files, or write the page."""
    command = parser(__doc__)
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
