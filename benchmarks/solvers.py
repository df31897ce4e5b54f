"""Time, success and memory of solvers beside peers: ``python benchmarks/solvers.py --out benchmarks/solvers.json``.

All solvers have the same problems of the protocol's data in the same run, on one thread. README.md beside this file
says what is measured and how to read it.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from harness import in_turns, load, peak_bytes, ratio, run_child, say, seconds, summary, threads
from kornia.core.exceptions import BaseError
from others import bare_call
from torch import nn

from kornia_pnpnet import pose_errors, success, success_rate
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation import draw_problems
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.evaluation.results import save_results
from kornia_pnpnet.types import Problems

# Nothing was trained, tuned or looked at with these problems before.
SEED = 20_270_300
SMALL, LARGE = 9, 100
SETS = {
    "n = 9, no outliers": (SMALL, OutlierMix(count=0)),
    "n = 9, 0 to 3 outliers": (SMALL, OutlierMix()),
    "n = 9, 3 outliers": (SMALL, OutlierMix(count=3)),
    "n = 100, 50 outliers": (LARGE, OutlierMix(count=50)),
    "n = 100, 70 outliers": (LARGE, OutlierMix(count=70)),
}
# Thresholds: what docs/results/make.py found on its tuning seed, as the peers' defaults were found on theirs. Once
# `p3p-ransac` has the threshold in pixels that every peer has, once it allows for noise of the world points.
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
PEERS = ("opencv-epnp", "opencv-sqpnp", "opencv-ransac", "opencv-usac", "poselib", "pycolmap")
# Those that are shown the large problems. The paper's RANSAC is not: few of its samples of 7 are without an outlier
# there, so it tries all that it may, and one call takes longer than those of all the others together.
ROBUST = ("p3p-ransac", "pnpnet-set", "opencv-ransac", "opencv-usac", "poselib", "pycolmap")
MEMORY_SET = "n = 100, 70 outliers"
MEMORY_SOLVER, MEMORY_TARGET, MEMORY_RUNS = "p3p-ransac", 2 * 2**30, 5


class Speedup(NamedTuple):
    """How many times as fast as a peer a solver of ours has to be, on the small problems."""

    solver: str
    peer: str
    target: float


SPEEDUPS = (Speedup("epnp", "opencv-epnp", 3.0), Speedup("p3p-ransac", "poselib", 1.0))


def draw(name: str, count: int, seed: int) -> Problems:
    """Problems of one of ``SETS``, in float64; another seed for each set."""
    n, outliers = SETS[name]
    seed += list(SETS).index(name)
    source = SyntheticProblems(n=n, batch_size=min(count, 1000), seed=seed, outliers=outliers, dtype=torch.float64)
    return draw_problems(source, count)


def base_name(spec: str) -> str:
    """The name of a solver without its options."""
    return spec.partition(":")[0]


def runs_on(spec: str, name: str) -> bool:
    """Whether a solver is shown a set."""
    return SETS[name][0] == SMALL or base_name(spec) in ROBUST


@torch.no_grad()
def measure_set(
    solvers: Mapping[str, nn.Module], name: str, count: int, repeats: int, seed: int
) -> list[dict[str, Any]]:
    """Time the solvers on one set in rounds, each solver once in a round, and count what they solve."""
    problems = draw(name, count, seed)
    rates, timers = {}, {}
    for spec, solver in solvers.items():
        result = solver(*problems[:3])  # not timed: first calls are slower
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
    for wanted in SPEEDUPS:
        for mine, theirs in itertools.product(rows, rows):
            names = base_name(mine["solver"]), base_name(theirs["solver"])
            if names != wanted[:2] or mine["set"] != theirs["set"] or SETS[mine["set"]][0] != SMALL:
                continue
            times = ratio(mine, theirs)
            entry = {"solver": mine["solver"], "peer": theirs["solver"], "set": mine["set"], "ratio": times}
            found.append({**entry, "target": wanted.target, "met": times >= wanted.target})
    return found


def memory_here(spec: str, count: int, seed: int) -> dict[str, int]:
    """Solve one large batch in this process; its peak before there were problems, and in the end."""
    before = peak_bytes()
    with threads(), torch.no_grad():
        load_solver(spec)(*draw(MEMORY_SET, count, seed)[:3])
    return {"imports_bytes": before, "peak_bytes": peak_bytes()}


def measure_memory(spec: str, count: int, seed: int) -> dict[str, Any]:
    """Solve one large batch in processes of its own and compare the largest peak with the target.

    Peaks of the same run differ: it is chance what the allocator has given back when the next tensor comes.
    """
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
        specs: solvers, as :func:`load_solver` takes them. Those whose package is not installed
            are skipped.
        count: problems in a batch.
        repeats: rounds.
        memory_count: problems in the batch whose memory is measured; 0: none is.
        seed: of the problems.

    Returns:
        ``environment``, ``settings``, ``load_average`` (of the last minute, before and after), ``skipped`` (why, by
        solver), ``rows`` (one for each solver and set), ``speedups`` and ``memory``.
    """
    before = load()
    solvers, skipped = {}, {}
    for spec in specs:
        try:
            solvers[spec] = load_solver(spec).double()
        except ImportError as error:
            skipped[spec] = str(error)
            say(f"skipped: {spec}: {error}")
    memory = []
    for spec in solvers if memory_count else ():
        if base_name(spec) == MEMORY_SOLVER:
            say(f"memory of {spec}")
            memory.append(measure_memory(spec, memory_count, seed))
    rows = []
    with threads():
        for name in SETS:
            say(name)
            chosen = {spec: solver for spec, solver in solvers.items() if runs_on(spec, name)}
            rows += measure_set(chosen, name, count, repeats, seed)
        settings = {"solvers": list(specs), "count": count, "repeats": repeats, "seed": seed, "dtype": "float64"}
        return {
            "environment": environment(),
            "settings": settings,
            "load_average": [before, load()],
            "skipped": skipped,
            "rows": rows,
            "speedups": speedups(rows),
            "memory": memory,
        }


def verdict(met: bool) -> str:
    """What the tables say of a target."""
    return "target met" if met else "target missed"


def format_tables(results: Mapping[str, Any]) -> str:
    """Times with success, and the targets, as two Markdown tables."""
    cells = {}
    for row in results["rows"]:
        time_us, rate = f"{row['median_us']:.1f} µs (min {row['min_us']:.1f})", 100 * row["success"]["rate"]
        cells[row["solver"], row["set"]] = f"{time_us}, {rate:.1f} %"
    lines = ["| Solver | " + " | ".join(SETS) + " |", "|---" * (1 + len(SETS)) + "|"]
    for spec in dict.fromkeys(row["solver"] for row in results["rows"]):
        lines.append(f"| `{spec}` | " + " | ".join(cells.get((spec, name), "–") for name in SETS) + " |")
    lines += ["", "| Target | Set | Measured | Verdict |", "|---|---|---|---|"]
    for entry in results["speedups"]:
        wanted = f"`{entry['solver']}` at least {entry['target']:g} times as fast as `{entry['peer']}`"
        lines.append(f"| {wanted} | {entry['set']} | {entry['ratio']:.2f} times | {verdict(entry['met'])} |")
    for entry in results["memory"]:
        peak, rise, target = (entry[f"{key}_bytes"] / 2**30 for key in ("peak", "rise", "target"))
        wanted = f"`{entry['solver']}` on {entry['count']} problems below {target:g} GiB"
        measured = f"{peak:.2f} GiB, {rise:.2f} GiB of it not the imports' (the largest of {len(entry['runs'])} runs)"
        lines.append(f"| {wanted} | {entry['set']} | {measured} | {verdict(entry['met'])} |")
    return "\n".join(lines)


def page(results: Mapping[str, Any]) -> str:
    """The tables as a page that says where they are from."""
    count, load = results["settings"]["count"], results["load_average"]
    where = f"{results['environment']['cpu']}, {results['environment']['date']}"
    return (
        "# Time, success and memory\n\n"
        "Written by `benchmarks/solvers.py`, see [README.md](README.md). Median and minimum in µs per problem, calls\n"
        f"of {count} problems, one thread, {where}, load average {load[0]:.1f} before and {load[1]:.1f} after.\n\n"
        f"{format_tables(results)}\n"
    )


def make_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="the results file, ending in .json; the tables go beside it, into .md")
    parser.add_argument("--solvers", nargs="+", default=[*OURS, *PEERS], help="names, with options after a colon")
    parser.add_argument("--count", type=int, default=1000, help="problems in a batch")
    parser.add_argument("--repeats", type=int, default=7, help="rounds")
    parser.add_argument("--memory-count", type=int, default=10_000, help="problems for the memory; 0: none")
    parser.add_argument("--seed", type=int, default=SEED, help="of the problems")
    parser.add_argument("--memory-of", help=argparse.SUPPRESS)  # what the process for the memory is started with
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, write the file and print the tables."""
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
