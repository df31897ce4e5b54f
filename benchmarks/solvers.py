"""Time, success and memory of solvers beside peers: ``python benchmarks/solvers.py --out benchmarks/solvers.json``.

All solvers solve the same problems of the protocol's data in the same run, on one thread. README.md beside this file
describes the measurements.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from harness import in_turns, load, peak_bytes, ratio, run_child, say, seconds, summary, threads
from kornia.core.exceptions import BaseError
from others import bare_call
from torch import nn

from kornia_pnpnet import pose_errors, success, success_rate
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.tables import markdown_table
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation import draw_problems
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.evaluation.results import save_results
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
    "epnp",
    "epnp-lm",
    "reppnp",
    "ransac-epnp-lm:threshold=50",
    "p3p-ransac:threshold=50",
    "p3p-ransac:threshold=10,world_threshold=0.3",
    "pnpnet-n9",
    "pnpnet-set",
)
PEERS = ("opencv-epnp", "opencv-sqpnp", "opencv-ransac", "opencv-usac", "kornia-rs", "poselib", "pycolmap")
# Solvers of the large problems. The paper's RANSAC is not among them: few samples of 7 pairs are free of outliers, so
# one call of it would take longer than all others together.
ROBUST = ("p3p-ransac", "pnpnet-set", "opencv-ransac", "opencv-usac", "kornia-rs", "poselib", "pycolmap")
MEMORY_SET = "n = 100, 70 outliers"
MEMORY_SOLVER, MEMORY_TARGET, MEMORY_RUNS = "p3p-ransac", 2 * 2**30, 5


# Targets of the time of a peer by the time of a solver of ours, on the small problems.
SPEEDUPS = {("epnp", "opencv-epnp"): 3.0, ("p3p-ransac", "poselib"): 1.0}


def draw(name: str, count: int, seed: int) -> Problems:
    """Problems of one of ``SETS``, in float64, each set from its own seed."""
    n, outliers = SETS[name]
    seed += list(SETS).index(name)
    source = SyntheticProblems(n=n, batch_size=min(count, 1000), seed=seed, outliers=outliers, dtype=torch.float64)
    return draw_problems(source, count)


def base_name(spec: str) -> str:
    """The name of a solver without its options."""
    return spec.partition(":")[0]


@torch.no_grad()
def measure_set(
    solvers: Mapping[str, nn.Module], name: str, count: int, repeats: int, seed: int
) -> list[dict[str, Any]]:
    """Time the solvers on one set, each solver once in a round, and measure success."""
    problems = draw(name, count, seed)
    rates, timers = {}, {}
    for spec, solver in solvers.items():
        result = solver(problems.world_points, problems.img_points, problems.intrinsics)  # not timed: slower
        rates[spec] = success_rate(success(pose_errors(result.pose, problems.pose)))
        timers[spec] = partial(seconds, bare_call(solver, problems))
    rounds = in_turns(timers, repeats)
    return [
        {"solver": spec, "set": name, "success": rates[spec]._asdict(), **summary([1e6 * s / count for s in times])}
        for spec, times in rounds.items()
    ]


def speedups(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Every target of speed on every small set on which both sides were measured."""
    found = []
    for (solver, peer), target in SPEEDUPS.items():
        for mine, theirs in itertools.product(rows, rows):
            names = (base_name(mine["solver"]), base_name(theirs["solver"]))
            if names == (solver, peer) and mine["set"] == theirs["set"] and SETS[mine["set"]][0] == SMALL:
                times = ratio(mine, theirs)
                entry = {"solver": mine["solver"], "peer": theirs["solver"], "set": mine["set"], "ratio": times}
                found.append({**entry, "target": target, "met": times >= target})
    return found


def memory_here(spec: str, count: int, seed: int) -> dict[str, int]:
    """Solve one large batch in this process; the peak memory before and after."""
    before = peak_bytes()
    with threads(), torch.no_grad():
        problems = draw(MEMORY_SET, count, seed)
        load_solver(spec)(problems.world_points, problems.img_points, problems.intrinsics)
    return {"imports_bytes": before, "peak_bytes": peak_bytes()}


def measure_memory(spec: str, count: int, seed: int) -> dict[str, Any]:
    """Solve one large batch in several processes and compare the largest peak with the target.

    Peaks of the same call differ with the memory that the allocator has given back.
    """
    say(f"memory of {spec}")
    arguments = ("--memory-of", spec, "--memory-count", str(count), "--seed", str(seed))
    runs = [run_child(Path(__file__), *arguments) for _ in range(MEMORY_RUNS)]
    peak = max(run["peak_bytes"] for run in runs)
    return {
        "solver": spec,
        "set": MEMORY_SET,
        "count": count,
        "runs": runs,
        "peak_bytes": peak,
        "rise_bytes": max(run["peak_bytes"] - run["imports_bytes"] for run in runs),
        "target_bytes": MEMORY_TARGET,
        "met": peak < MEMORY_TARGET,
    }


def measure(specs: Sequence[str], *, count: int, repeats: int, memory_count: int, seed: int) -> dict[str, Any]:
    """Measure everything, with a line on standard error for each step.

    Args:
        specs: solvers, as for :func:`load_solver`. Solvers without their package are skipped.
        count: number of problems in a batch.
        repeats: number of rounds.
        memory_count: number of problems of the memory measurement; 0: none.
        seed: seed of the problems.

    Returns:
        ``environment``, ``settings``, ``load_average`` (before and after), ``skipped`` (the reason by solver), ``rows``
        (one for each solver and set), ``speedups`` and ``memory``.
    """
    before = load()
    solvers, skipped = {}, {}
    for spec in specs:
        try:
            solvers[spec] = load_solver(spec).double()
        except ImportError as error:
            skipped[spec] = str(error)
            say(f"skipped: {spec}: {error}")
    wanted = [spec for spec in solvers if memory_count and base_name(spec) == MEMORY_SOLVER]
    memory = [measure_memory(spec, memory_count, seed) for spec in wanted]
    rows = []
    with threads():
        for name in SETS:
            say(name)
            small = SETS[name][0] == SMALL
            chosen = {spec: solver for spec, solver in solvers.items() if small or base_name(spec) in ROBUST}
            rows += measure_set(chosen, name, count, repeats, seed)
        settings = {"solvers": list(specs), "count": count, "repeats": repeats, "seed": seed, "dtype": "float64"}
        made = {"environment": environment(), "settings": settings, "load_average": [before, load()]}
    return {**made, "skipped": skipped, "rows": rows, "speedups": speedups(rows), "memory": memory}


def format_tables(results: Mapping[str, Any]) -> str:
    """Times with success, and the targets, as two Markdown tables."""
    cells = {}
    for row in results["rows"]:
        time_us, rate = f"{row['median_us']:.1f} µs (min {row['min_us']:.1f})", 100 * row["success"]["rate"]
        cells[row["solver"], row["set"]] = f"{time_us}, {rate:.1f} %"
    solvers = dict.fromkeys(row["solver"] for row in results["rows"])
    lines = [[f"`{spec}`", *(cells.get((spec, name), "–") for name in SETS)] for spec in solvers]
    times = markdown_table(["Solver", *SETS], lines, align="l" * (1 + len(SETS)))
    found = []
    for entry in results["speedups"]:
        wanted = f"`{entry['solver']}` at least {entry['target']:g} times as fast as `{entry['peer']}`"
        found.append((entry, wanted, f"{entry['ratio']:.2f} times"))
    for entry in results["memory"]:
        peak, rise, target = (entry[f"{key}_bytes"] / 2**30 for key in ("peak", "rise", "target"))
        wanted = f"`{entry['solver']}` on {entry['count']} problems below {target:g} GiB"
        found.append((entry, wanted, f"{peak:.2f} GiB, {rise:.2f} GiB without the imports"))
    lines = [
        [wanted, entry["set"], measured, "met" if entry["met"] else "**missed**"] for entry, wanted, measured in found
    ]
    return f"{times}\n\n{markdown_table(['Target', 'Set', 'Measured', 'Verdict'], lines, align='llll')}"


def page(results: Mapping[str, Any]) -> str:
    """The tables as a page."""
    load = results["load_average"]
    where = f"{results['environment']['cpu']}, {results['environment']['date']}"
    return f"""\
# Time, success and memory

Written by `benchmarks/solvers.py`, see [README.md](README.md). Median and minimum in µs per problem, calls of
{results["settings"]["count"]} problems, one thread, {where}, load average {load[0]:.1f} before and {load[1]:.1f} after.

{format_tables(results)}
"""


def make_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="the results file (.json); the tables go beside it (.md)")
    parser.add_argument("--solvers", nargs="+", default=[*OURS, *PEERS], help="names, with options after a colon")
    parser.add_argument("--count", type=int, default=1000, help="number of problems in a batch")
    parser.add_argument("--repeats", type=int, default=7, help="number of rounds")
    parser.add_argument("--memory-count", type=int, default=10_000, help="problems of the memory measurement; 0: none")
    parser.add_argument("--seed", type=int, default=SEED, help="seed of the problems")
    parser.add_argument("--memory-of", help=argparse.SUPPRESS)  # a process of `measure_memory`
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, write the files and print the tables."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    if options.count < 1 or options.repeats < 1 or options.memory_count < 0:
        parser.error("--count and --repeats must be at least 1, --memory-count at least 0")
    if options.memory_of:
        print(json.dumps(memory_here(options.memory_of, options.memory_count, options.seed)))
        return
    sizes = {"count": options.count, "repeats": options.repeats, "memory_count": options.memory_count}
    try:
        results = measure(options.solvers, **sizes, seed=options.seed)
    except BaseError as error:
        parser.error(str(error))
    if options.out:
        save_results(results, options.out)
        options.out.with_suffix(".md").write_text(page(results), encoding="utf-8")
    print(format_tables(results))


if __name__ == "__main__":
    main()
