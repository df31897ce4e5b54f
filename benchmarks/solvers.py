"""Time, success and memory of solvers beside peers: ``python benchmarks/solvers.py --out benchmarks/solvers.json``.

All solvers solve the same problems of the protocol's data in the same run, on one thread. README.md beside this file
describes the measurements.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import harness
import torch
from contenders import bare_call
from torch import nn

from kornia_pnpnet import pose_errors, success, success_rate
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation import draw_problems
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.result import Problems

# Seed of the problems. No training or tuning used it.
SEED = 20_270_300
SMALL, LARGE, ACCURATE = 9, 100, 200
#: The number of pairs, the outliers, and the noise of the world points. The pixels have a noise of 1 px.
SETS: dict[str, tuple[int, OutlierMix, float]] = {
    "n = 9, no outliers": (SMALL, OutlierMix(count=0), 0.05),
    "n = 9, 0 to 3 outliers": (SMALL, OutlierMix(), 0.05),
    "n = 9, 3 outliers": (SMALL, OutlierMix(count=3), 0.05),
    "n = 100, 50 outliers": (LARGE, OutlierMix(count=50), 0.05),
    "n = 100, 70 outliers": (LARGE, OutlierMix(count=70), 0.05),
    "n = 200, 80 outliers, exact points": (ACCURATE, OutlierMix(count=80), 0.0),
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
MEMORY_SOLVER, MEMORY_RUNS = "p3p-ransac", 5


def draw(name: str, count: int) -> Problems:
    """Problems of one of ``SETS``, in float64, each set from its own seed."""
    n, outliers, world_sigma = SETS[name]
    options: Any = {"seed": SEED + list(SETS).index(name), "dtype": torch.float64}
    source = SyntheticProblems(n=n, batch_size=min(count, 1000), outliers=outliers, world_sigma=world_sigma, **options)
    return draw_problems(source, count)


@torch.no_grad()
def measure_set(solvers: Mapping[str, nn.Module], name: str, count: int, repeats: int) -> list[dict[str, Any]]:
    """Time the solvers on one set, each solver once in a round, and measure success and the median errors."""
    problems = draw(name, count)
    found, timers = {}, {}
    for spec, solver in solvers.items():
        errors = pose_errors(solver(*problems[:3]).pose, problems.pose)  # not timed: slower
        medians = {f"median_{key}": float(x.median()) for key, x in errors._asdict().items()}
        found[spec] = {"success": success_rate(success(errors))._asdict(), **medians}
        timers[spec] = partial(harness.seconds, bare_call(solver, problems))
    return [
        {"solver": spec, "set": name, **found[spec], **harness.summary([1e6 * s / count for s in times])}
        for spec, times in harness.in_turns(timers, repeats).items()
    ]


def measure_memory(spec: str, count: int) -> dict[str, Any]:
    """Solve one large batch in several processes, and find the largest peak.

    Peaks of the same call differ with the memory that the allocator has given back.
    """
    harness.say(f"memory of {spec}")
    arguments = ("--memory-of", spec, "--memory-count", str(count))
    runs = [harness.run_child(Path(__file__), *arguments) for _ in range(MEMORY_RUNS)]
    peak = max(run["peak_bytes"] for run in runs)
    rise = max(run["peak_bytes"] - run["imports_bytes"] for run in runs)
    place = {"solver": spec, "set": MEMORY_SET, "count": count}
    return {**place, "runs": runs, "peak_bytes": peak, "rise_bytes": rise}


def measure(specs: Sequence[str], *, count: int, repeats: int, memory_count: int) -> dict[str, Any]:
    """Measure everything, with the options of the command. Solvers without their package are skipped."""
    solvers, skipped = {}, {}
    for spec in specs:
        try:
            solvers[spec] = load_solver(spec).double()
        except ImportError as error:
            skipped[spec] = str(error)
            harness.say(f"skipped: {spec}: {error}")
    name_of = {spec: spec.partition(":")[0] for spec in solvers}
    wanted = [spec for spec, name in name_of.items() if memory_count and name == MEMORY_SOLVER]
    memory = [measure_memory(spec, memory_count) for spec in wanted]
    rows = []
    for name, (n, *_) in SETS.items():
        harness.say(name)
        chosen = {spec: solver for spec, solver in solvers.items() if n == SMALL or name_of[spec] in ROBUST}
        rows += measure_set(chosen, name, count, repeats)
    return {"skipped": skipped, "rows": rows, "memory": memory}


def page(results: harness.Row) -> str:
    """The tables as a page."""
    rows, keys, options = results["rows"], {"Solver": "`{solver}`"}, {"by": "set", "align": "l" + len(SETS) * "r"}
    cells = {"times": "{median_us:.1f}", "rates": "{success[rate]:.1%}"}
    cells["errors"] = "{median_rotation_error_deg:.3f}° · {median_translation_error:.4f}"
    tables = {name: harness.pivot(rows, keys, SETS, cell.format_map, **options) for name, cell in cells.items()}
    return harness.render("solvers.md.jinja", results=results, **tables)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, write the files and print the tables."""
    command = harness.parser(__doc__, required=False)
    command.add_argument("--solvers", nargs="+", default=[*OURS, *PEERS], help="names, with options after a colon")
    command.add_argument("--count", type=int, default=1000, help="number of problems in a batch")
    command.add_argument("--repeats", type=int, default=7, help="number of rounds")
    command.add_argument("--memory-count", type=int, default=10_000, help="problems of the memory measurement; 0: none")
    command.add_argument("--memory-of", help=argparse.SUPPRESS)  # a process of `measure_memory`
    options = command.parse_args(arguments)
    if options.memory_of:
        before = harness.peak_bytes()
        with harness.threads(), torch.no_grad():
            load_solver(options.memory_of)(*draw(MEMORY_SET, options.memory_count)[:3])
        print(json.dumps({"imports_bytes": before, "peak_bytes": harness.peak_bytes()}))
        return
    given = {"count": options.count, "repeats": options.repeats}
    run = partial(measure, options.solvers, **given, memory_count=options.memory_count)
    results = harness.recorded(run, solvers=options.solvers, **given, seed=SEED, dtype="float64")
    if options.out:
        harness.write(options.out, results, page)
    print(page(results))


if __name__ == "__main__":
    main()
