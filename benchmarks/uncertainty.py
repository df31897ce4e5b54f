"""Pose errors with noise that differs between directions, beside the least that it allows: ``uncertainty.json``.

    python benchmarks/uncertainty.py --out benchmarks/uncertainty.json

The noise of each pixel and of each point has random axes, the largest five times as long as the smallest. A solver is
told the covariances, the standard deviations of isotropic noise of the same trace, or nothing. Errors are medians,
relative to those of maximum likelihood on the true inliers with the covariances, started from the truth; all solve the
same problems.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from kornia_pnpnet import PnPResult, create_solver, pose_errors
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.files import write_json
from kornia_pnpnet.core.tables import markdown_table
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.bounds import KnownInliersAndNoise
from kornia_pnpnet.types import Problems

__all__ = ["main", "measure_errors", "measure_times"]

SOLVER = "pnpnet-set"
# Used for nothing else.
SEED = 20_261_250
AXIS_RATIO = 5.0
#: Pairs of a problem, and how many of them are outliers.
SIZES = ((9, 0), (20, 0), (50, 0), (20, 6), (50, 15), (50, 25))
#: Standard deviations of pixels and, in metres, of points; the last ones are exact.
NOISES = {"protocol": (1.0, 0.05), "mixed": (3.0, 0.01), "pixels": (5.0, 0.0)}
# Of a timed batch, as in the table of throughput: problems, pairs, repeats.
TIMED = (500, 9, 41)


def told(problems: Problems, img_sigma: float, world_sigma: float) -> dict[str, dict[str, Any]]:
    """What a solver may be told of the noise."""
    sigmas = {"img_sigma": img_sigma, "world_sigma": world_sigma}
    return {"covariances": problems.known, "sigmas": sigmas, "nothing": {}}


def medians(result: PnPResult, problems: Problems) -> Tensor:
    """Median rotation and translation error."""
    return torch.stack(list(pose_errors(result.pose, problems.pose))).median(1).values


@torch.no_grad()
def measure_errors(solver: nn.Module, count: int) -> list[dict[str, Any]]:
    """Median errors relative to the bound, of each noise and size."""
    rows = []
    for noise, (img_sigma, world_sigma) in NOISES.items():
        bound = KnownInliersAndNoise(img_sigma=img_sigma, world_sigma=world_sigma)
        for n, outliers in SIZES:
            problems = SyntheticProblems(
                n=n,
                batch_size=count,
                seed=SEED,
                outliers=OutlierMix(count=outliers),
                axis_ratio=AXIS_RATIO,
                img_sigma=img_sigma,
                world_sigma=world_sigma,
                known_noise=1.0,
                dtype=torch.float64,
            ).batch(0)
            best = medians(bound.solve_with_truth(problems), problems)
            isotropic = bound.solve_with_truth(problems._replace(img_cov=None, world_cov=None))
            row: dict[str, Any] = {"noise": noise, "n": n, "outliers": outliers, "bound": best.tolist()}
            row["bound, sigmas"] = (medians(isotropic, problems) / best).tolist()
            for name, known in told(problems, img_sigma, world_sigma).items():
                row[name] = (medians(solver(*problems[:3], **known), problems) / best).tolist()
            rows.append(row)
    return rows


@torch.no_grad()
def measure_times(solver: nn.Module) -> dict[str, float]:
    """Processor time of a problem in µs in float32, medians; what is told takes turns."""
    batch, n, repeats = TIMED
    source = SyntheticProblems(n=n, batch_size=batch, seed=SEED, axis_ratio=AXIS_RATIO, known_noise=1.0)
    problems = source.batch(0)
    kinds = told(problems, 1.0, 0.05)
    seconds: Mapping[str, list[float]] = {name: [] for name in kinds}
    for _ in range(repeats):
        for name, known in kinds.items():
            start = time.process_time()
            solver(*problems[:3], **known)
            seconds[name].append(time.process_time() - start)
    return {name: 1e6 * statistics.median(values[1:]) / batch for name, values in seconds.items()}


def main() -> None:
    """Measure and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/bench/uncertainty.json"))
    parser.add_argument("--count", type=int, default=4000, help="problems of each noise and size (default: 4000)")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    times = measure_times(create_solver(SOLVER))
    rows = measure_errors(create_solver(SOLVER).double(), arguments.count)
    about = {"solver": SOLVER, "seed": SEED, "axis_ratio": AXIS_RATIO, "problems": arguments.count, "noises": NOISES}
    write_json(arguments.out, {"environment": environment(), **about, "us_per_problem": times, "rows": rows})
    columns = ("covariances", "sigmas", "nothing", "bound, sigmas")
    cells = [
        [row["noise"], f"{row['n']}", f"{row['outliers']}", *(" ".join(f"{x:.3f}" for x in row[c]) for c in columns)]
        for row in rows
    ]
    print(markdown_table(["Noise", "n", "Outliers", *columns], cells))
    print(", ".join(f"{name}: {value:.1f} µs" for name, value in times.items()))


if __name__ == "__main__":
    main()
