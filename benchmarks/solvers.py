"""Time, success and memory of solvers beside peers: ``python benchmarks/solvers.py --out benchmarks/solvers.json``.

All solvers solve the same problems of the protocol's data in the same run, on one thread. README.md beside this file
describes the measurements.
"""

import argparse
import itertools
import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import harness
import torch
from contenders import bare_call
from kornia.core.exceptions import BaseError
from torch import nn

from kornia_pnpnet import pose_errors, success, success_rate
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation import draw_problems
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.result import Problems

# Seed of the problems. No training or tuning used it.
SEED = 20_270_300
SMALL, LARGE = 9, 100
SETS = {
    "n = 9, no outliers": (SMALL, OutlierMix(count=0)),
    "n = 9, 0 to 3 outliers": (SMALL, OutlierMix()),
    "n = 9, 3 outliers": (SMALL, OutlierMix(count=3)),
    "n = 100, 50 outliers": (LARGE, OutlierMix(count=50)),
    "n = 100, 70 outliers": (LARGE, OutlierMix(count=70)),
}
# Thresholds were tuned by docs/results/make.py on its tuning seed, like the defaults of the peers. `p3p-ransac` runs
# once with one threshold in pixels, like every peer, and once allowing for noise of the world points.
OURS = (
    *("epnp", "epnp-lm", "reppnp", "ransac-epnp-lm:threshold=50", "p3p-ransac:threshold=50"),
    *("p3p-ransac:threshold=10,world_threshold=0.3", "pnpnet-n9", "pnpnet-set"),
)
PEERS = ("opencv-epnp", "opencv-sqpnp", "opencv-ransac", "opencv-usac", "kornia-rs", "poselib", "pycolmap")
# Solvers of the large problems. The paper's RANSAC is not among them: few samples of 7 pairs are free of outliers, so
# one call of it would take longer than all others together.
ROBUST = ("p3p-ransac", "pnpnet-set", "opencv-ransac", "opencv-usac", "kornia-rs", "poselib", "pycolmap")
MEMORY_SET = "n = 100, 70 outliers"
MEMORY_SOLVER, MEMORY_TARGET, MEMORY_RUNS = "p3p-ransac", 2 * 2**30, 5
# Targets of the time of a peer by the time of a solver of ours, on the small problems.
SPEEDUPS = {("epnp", "opencv-epnp"): 3.0, ("p3p-ransac", "poselib"): 1.0}


def draw(name: str, count: int) -> Problems:
    """Problems of one of ``SETS``, in float64, each set from its own seed."""
    n, outliers = SETS[name]
    seed = SEED + list(SETS).index(name)
    source = SyntheticProblems(n=n, batch_size=min(count, 1000), seed=seed, outliers=outliers, dtype=torch.float64)
    return draw_problems(source, count)


@torch.no_grad()
def measure_set(solvers: Mapping[str, nn.Module], name: str, count: int, repeats: int) -> list[dict[str, Any]]:
    """Time the solvers on one set, each solver once in a round, and measure success."""
    problems = draw(name, count)
    rates, timers = {}, {}
    for spec, solver in solvers.items():
        pose = solver(*problems[:3]).pose  # not timed: slower
        rates[spec] = success_rate(success(pose_errors(pose, problems.pose)))._asdict()
        timers[spec] = partial(harness.seconds, bare_call(solver, problems))
    return [
        {"solver": spec, "set": name, "success": rates[spec], **harness.summary([1e6 * s / count for s in times])}
        for spec, times in harness.in_turns(timers, repeats).items()
    ]


def speedups(rows: Sequence[harness.Row]) -> list[dict[str, Any]]:
    """Every target of speed on every small set on which both sides were measured."""
    found = []
    for mine, theirs in itertools.product(rows, repeat=2):
        wanted = SPEEDUPS.get((base_name(mine["solver"]), base_name(theirs["solver"])))
        if wanted and mine["set"] == theirs["set"] and SETS[mine["set"]][0] == SMALL:
            times = harness.ratio(mine, theirs)
            entry = {"solver": mine["solver"], "peer": theirs["solver"], "set": mine["set"], "ratio": times}
            found.append({**entry, "target": wanted, "met": times >= wanted})
    return found


def base_name(spec: str) -> str:
    """The name of a solver without its options."""
    return spec.partition(":")[0]


def memory_here(spec: str, count: int) -> dict[str, int]:
    """Solve one large batch in this process; the peak memory before and after."""
    before = harness.peak_bytes()
    with harness.threads(), torch.no_grad():
        load_solver(spec)(*draw(MEMORY_SET, count)[:3])
    return {"imports_bytes": before, "peak_bytes": harness.peak_bytes()}


def measure_memory(spec: str, count: int) -> dict[str, Any]:
    """Solve one large batch in several processes and compare the largest peak with the target.

    Peaks of the same call differ with the memory that the allocator has given back.
    """
    harness.say(f"memory of {spec}")
    arguments = ("--memory-of", spec, "--memory-count", str(count))
    runs = [harness.run_child(Path(__file__), *arguments) for _ in range(MEMORY_RUNS)]
    peak = max(run["peak_bytes"] for run in runs)
    rise = max(run["peak_bytes"] - run["imports_bytes"] for run in runs)
    found = {"runs": runs, "peak_bytes": peak, "rise_bytes": rise, "target_bytes": MEMORY_TARGET}
    return {"solver": spec, "set": MEMORY_SET, "count": count, **found, "met": peak < MEMORY_TARGET}


def measure(specs: Sequence[str], *, count: int, repeats: int, memory_count: int) -> dict[str, Any]:
    """Measure everything, with the options of the command. Solvers without their package are skipped."""
    solvers, skipped = {}, {}
    for spec in specs:
        try:
            solvers[spec] = load_solver(spec).double()
        except ImportError as error:
            skipped[spec] = str(error)
            harness.say(f"skipped: {spec}: {error}")
    wanted = [spec for spec in solvers if memory_count and base_name(spec) == MEMORY_SOLVER]
    memory = [measure_memory(spec, memory_count) for spec in wanted]
    rows = []
    with harness.threads():
        for name, (n, _) in SETS.items():
            harness.say(name)
            chosen = {spec: solver for spec, solver in solvers.items() if n == SMALL or base_name(spec) in ROBUST}
            rows += measure_set(chosen, name, count, repeats)
    return {"skipped": skipped, "rows": rows, "speedups": speedups(rows), "memory": memory}


def targets(results: harness.Row) -> list[dict[str, Any]]:
    """The targets of speed and of memory beside the measurements."""
    options: Any = {"unit": "times as fast", "at_most": False}
    what = "`{solver}` beside `{peer}`, {set}"
    found = [harness.target(what.format_map(x), x["ratio"], x["target"], **options) for x in results["speedups"]]
    for entry in results["memory"]:
        peak, rise, wanted = (entry[f"{key}_bytes"] / 2**30 for key in ("peak", "rise", "target"))
        what = "Memory of `{solver}`, {count} problems, {set}".format_map(entry)
        found.append(harness.target(f"{what} ({rise:.2f} GiB without the imports)", peak, wanted, unit="GiB"))
    return found


def page(results: harness.Row) -> str:
    """The tables as a page."""

    def cell(row: harness.Row) -> str:
        return f"{row['median_us']:.1f} µs (min {row['min_us']:.1f}), {100 * row['success']['rate']:.1f} %"

    times = harness.pivot(results["rows"], {"Solver": "`{solver}`"}, SETS, cell, by="set", align="l" * (1 + len(SETS)))
    return harness.render("solvers.md.jinja", results=results, times=times, targets=targets(results))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, write the files and print the tables."""
    command = harness.parser(__doc__, required=False)
    command.add_argument("--solvers", nargs="+", default=[*OURS, *PEERS], help="names, with options after a colon")
    command.add_argument("--count", type=int, default=1000, help="number of problems in a batch")
    command.add_argument("--repeats", type=int, default=7, help="number of rounds")
    command.add_argument("--memory-count", type=int, default=10_000, help="problems of the memory measurement; 0: none")
    command.add_argument("--memory-of", help=argparse.SUPPRESS)  # a process of `measure_memory`
    options = command.parse_args(arguments)
    if options.count < 1 or options.repeats < 1 or options.memory_count < 0:
        command.error("--count and --repeats must be at least 1, --memory-count at least 0")
    if options.memory_of:
        print(json.dumps(memory_here(options.memory_of, options.memory_count)))
        return
    given = {"count": options.count, "repeats": options.repeats}
    try:
        with harness.threads():  # so that the environment in the file has one thread
            results = harness.recorded(
                partial(measure, options.solvers, **given, memory_count=options.memory_count),
                **{"solvers": options.solvers, **given, "seed": SEED, "dtype": "float64"},
            )
    except BaseError as error:
        command.error(str(error))
    if options.out:
        harness.write(options.out, results, page)
    print(page(results))


if __name__ == "__main__":
    main()
