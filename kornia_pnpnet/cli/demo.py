"""Compare PnP-Nets with OpenCV and PoseLib, and train a network for a minute.

Without --data, the problems are random. The demo prints a table, trains a small network and draws pictures.

  pnpnet demo --data path/to/colmap --out outputs/demo
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import nn

    from kornia_pnpnet.evaluation import EvaluationData

_N = 9
_SOLVERS = ("pnpnet-set", f"pnpnet-n{_N}", "opencv-ransac", "poselib")


def run(arguments: argparse.Namespace) -> int:
    """Compare the solvers, draw pictures, train a network and print the :func:`verdict`."""
    import torch

    from kornia_pnpnet.evaluation import evaluate, format_table
    from kornia_pnpnet.evaluation.named_solvers import default_solvers, load_solver
    from kornia_pnpnet.evaluation.plots import plot_errors, plot_success, plot_training
    from kornia_pnpnet.evaluation.problem_sets import evaluation_sets

    sources, count, metric = [arguments.data or "synthetic"], arguments.problems, not arguments.arbitrary_unit
    specs = {name.partition(":")[0]: name for name in default_solvers(_N, sources)}
    for missing in sorted({*_SOLVERS} - {*specs}):
        print(f"pnpnet: the demo runs without {missing}, which is not installed", file=sys.stderr)
    sets = evaluation_sets(sources, "none,2" if arguments.data else "none,uniform", n=_N, count=count, metric=metric)
    solvers = {specs[name]: load_solver(specs[name]) for name in _SOLVERS if name in specs}
    torch.set_num_threads(1)  # small tensors gain nothing from more threads
    print(f"{count} problems of {_N} correspondences in each set, one thread:\n", flush=True)
    folder = Path(arguments.out)
    results = evaluate(solvers, sets, path=folder / "results.json", overwrite=True)
    print(format_table(results), flush=True)
    files = [plot_success(folder / "success.png", results), plot_errors(folder / "errors.png", results)]
    files.append(_draw_one(folder / "problem.png", *next(iter(solvers.items())), list(sets.values())[-1]))
    history = _train(arguments.train_seconds, folder / "training") if arguments.train_seconds > 0 else None
    if history is not None:
        files.append(plot_training(folder / "training.png", history))
    print("\nSaved:", folder / "results.json", *files, sep="\n  ")
    print(f"\n{verdict(results)}")
    return 0


def verdict(results: Mapping[str, Any]) -> str:
    """For each set, name the solvers that solved the most problems, and the fastest solver.

    Solvers whose 95 % interval contains the highest success rate share the first place.
    """
    sentences = []
    for data in results["data"]:
        rows = [row for row in results["rows"] if row["data"] == data]
        best = max(row["success"]["rate"] for row in rows)
        most = [_result(row) for row in rows if row["success"]["high"] >= best]
        fastest = _result(min(rows, key=lambda row: row["us_per_problem"]))
        second = "was" if most == [fastest] else f"{fastest} was"
        sentences.append(f'on "{data}", {" and ".join(most)} solved the most problems and {second} the fastest')
    return f"In short: {'; '.join(sentences)}."


def _result(row: Mapping[str, Any]) -> str:
    return f"{row['solver']} ({100 * row['success']['rate']:.1f} %, {row['us_per_problem']:.0f} µs per problem)"


def _draw_one(path: Path, name: str, solver: nn.Module, entry: EvaluationData) -> Path:
    """Plot the first of the problems with the most outliers. The choice does not depend on the solver."""
    import torch

    from kornia_pnpnet.cameras import reproject
    from kornia_pnpnet.evaluation.plots import plot_pose

    outliers = (~entry.problems.inliers).sum(-1)
    index = int(outliers.argmax())
    world_points, img_points, intrinsics = (x[index : index + 1] for x in entry.problems[:3])
    with torch.no_grad():
        result = solver(world_points, img_points, intrinsics)
    pixels, title = reproject(world_points, intrinsics, result.pose), f"{name}, {int(outliers[index])} outliers"
    return plot_pose(path, img_points[0], pixels[0], ~result.inliers[0], title)


def _train(seconds: float, folder: Path) -> Path | None:
    """Train, and print the success rates of the first and last validation. Return ``None`` if a package is missing."""
    from kornia_pnpnet.core.extras import needs
    from kornia_pnpnet.core.files import read_csv

    try:
        with needs("train", "no training"):
            from kornia_pnpnet.training.loop import train_briefly
    except ImportError as error:
        print(f"pnpnet: {error}", file=sys.stderr)
        return None
    print(f"\nTraining a new network for about {seconds:.0f} s:", flush=True)
    history = train_briefly(seconds, folder)
    rows = list(read_csv(history, ["update"]).values())
    for column in rows[0]:
        filled = [row for row in rows if row[column]]
        if filled and column.startswith("val/") and column.endswith("/success"):
            ends = (f"{100 * float(row[column]):.1f} % at update {row['update']}" for row in (filled[0], filled[-1]))
            print(f"  success, outliers {column.split('/')[1]}: {' -> '.join(ends)}")
    return history
