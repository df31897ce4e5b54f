"""Throughput, latency, cold start and memory beside other libraries: ``python benchmarks/performance.py measure``.

``measure`` writes a results file for each part into this folder; ``render`` writes ``docs/performance.md`` and its
pictures from these files. README.md beside this file describes the measurements.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import latency
import page
import throughput
from harness import HERE, load, run_child, say
from settings import FULL, QUICK, Settings
from startup import measure_startup

from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.evaluation.results import save_results


def measure_threads(part: str, settings: Settings, count: int) -> dict[str, list[dict[str, Any]]]:
    """Throughput or latency on ``count`` threads, in this process."""
    measure_here = throughput.measure_throughput if part == "throughput" else latency.measure_latency
    return measure_here(settings, count=count)


def measure_part(part: str, settings: Settings) -> dict[str, Any]:
    """Measure one part; its results with environment, settings and load average."""
    before = load()
    if part == "startup":
        found = measure_startup(settings)
    else:
        # One process for each number of threads: code is compiled for the threads of its process.
        requests = [{"part": part, "settings": settings._asdict(), "count": count} for count in (1, 2)]
        answers = [
            run_child(Path(__file__), "--child", json.dumps(request), OMP_NUM_THREADS=str(request["count"]))
            for request in requests
        ]
        found = {key: [entry for answer in answers for entry in answer[key]] for key in ("rows", "skipped")}
        targets = throughput.targets if part == "throughput" else latency.targets
        found["targets"] = targets(found["rows"])
    made_with = environment()
    installed = {entry.name.lower(): entry.version for entry in distributions()}
    made_with["versions"] |= {name: installed.get(name) for name in ("pypose", "onnxruntime")}
    return {"environment": made_with, "settings": settings._asdict(), "load_average": [before, load()], **found}


def make_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", nargs="?", choices=("measure", "render"), default="measure")
    parser.add_argument("--parts", nargs="+", choices=page.PARTS, default=page.PARTS, help="for measure: only these")
    parser.add_argument("--contenders", nargs="+", help="for measure: only these")
    parser.add_argument("--quick", action="store_true", help="a few small problems: does everything run?")
    parser.add_argument("--results", type=Path, default=HERE, help="folder of the results files")
    parser.add_argument("--page", type=Path, default=page.PAGE, help="for render: the page to write")
    parser.add_argument("--child", help=argparse.SUPPRESS)  # the request of `measure_part` to a process of its own
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and write the results files, or write the page."""
    options = make_parser().parse_args(arguments)
    if options.child:
        request = json.loads(options.child)
        measured = measure_threads(request["part"], Settings(**request["settings"]), request["count"])
        print(json.dumps(measured))
        return
    if options.step == "render":
        page.render(options.results, options.page)
        return
    contenders = tuple(options.contenders) if options.contenders else None
    settings = (QUICK if options.quick else FULL)._replace(contenders=contenders)
    for part in options.parts:
        path = options.results / f"{part}.json"
        save_results(measure_part(part, settings), path)
        say(f"wrote {path}")


if __name__ == "__main__":
    main()
