"""Latency, throughput, cold start and memory beside other libraries: ``python benchmarks/performance.py measure``.

``measure`` writes a results file for each part into this folder; ``render`` makes ``docs/performance.md`` and its
pictures of them. README.md beside this file says what is measured and how to read it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import latency
import page
import throughput
from engine import measure_engine
from harness import HERE, load, run_child, say
from settings import FULL, QUICK, Settings
from startup import measure_startup
from tables import PARTS

from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.evaluation.results import save_results

# What is measured on one thread and on two, each in a process of its own: compiled code is made for the threads that
# there are.
_THREADED: dict[str, tuple[Callable[..., dict[str, list[dict[str, Any]]]], Callable[..., list[dict[str, Any]]]]] = {
    "throughput": (throughput.measure_throughput, throughput.targets),
    "latency": (latency.measure_latency, latency.targets),
}


def measure_part(part: str, settings: Settings) -> dict[str, Any]:
    """Measure one part; its results with what they were made with and on."""
    before = load()
    if part == "engine":
        found = measure_engine()
    elif part == "startup":
        found = measure_startup(settings)
    else:
        requests = [{"part": part, "settings": settings._asdict(), "threads": count} for count in (1, 2)]
        answers = [
            run_child(Path(__file__), "--child", json.dumps(request), OMP_NUM_THREADS=str(request["threads"]))
            for request in requests
        ]
        found = {key: [entry for answer in answers for entry in answer[key]] for key in ("rows", "skipped")}
        found["targets"] = _THREADED[part][1](found["rows"])
    made_with = environment()
    installed = {entry.name.lower(): entry.version for entry in distributions()}
    made_with["versions"] |= {name: installed.get(name) for name in ("pypose", "onnxruntime")}
    made = {"environment": made_with, "settings": settings._asdict(), "load_average": [before, load()]}
    return {**made, **found}


def file_name(part: str, device: str) -> str:
    """A device of its own has files of its own."""
    kind = device.partition(":")[0]
    return f"{part}.json" if kind == "cpu" else f"{part}_{kind}.json"


def make_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", nargs="?", choices=("measure", "render"), default="measure")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="for measure: only these")
    parser.add_argument("--contenders", nargs="+", help="for measure: only these")
    parser.add_argument("--device", default="cpu", help="of the solvers of ours: cpu, cuda")
    parser.add_argument("--quick", action="store_true", help="a few small problems, to see that everything runs")
    parser.add_argument("--results", type=Path, default=HERE, help="folder of the results files")
    parser.add_argument("--page", type=Path, default=page.PAGE, help="for render: where the page goes")
    parser.add_argument("--child", help=argparse.SUPPRESS)  # what a process for one number of threads is started with
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and write the files, or write the page."""
    options = make_parser().parse_args(arguments)
    if options.child:
        request = json.loads(options.child)
        measured = _THREADED[request["part"]][0](Settings.of(request["settings"]), count=request["threads"])
        print(json.dumps(measured))
        return
    if options.step == "render":
        page.render(options.results, options.page)
        return
    contenders = tuple(options.contenders) if options.contenders else None
    settings = (QUICK if options.quick else FULL)._replace(contenders=contenders, device=options.device)
    for part in options.parts:
        path = options.results / file_name(part, options.device)
        save_results(measure_part(part, settings), path)
        say(f"wrote {path}")


if __name__ == "__main__":
    main()
