"""``pnpnet demo``: the shipped weights beside OpenCV, a short training, pictures of both."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import torch
from torch import nn

from kornia_pnpnet.cli.pairs import rejection_limit, reprojections
from kornia_pnpnet.evaluation.comparison import EvaluationData, evaluate, format_table, save_results
from kornia_pnpnet.evaluation.figures import plot_errors, plot_pose, plot_success, plot_training
from kornia_pnpnet.evaluation.named_solvers import default_solvers, load_solver
from kornia_pnpnet.evaluation.problem_sets import evaluation_sets

__all__ = ["run_demo"]

_N = 9
_SOLVERS = (f"pnpnet-n{_N}", f"net-n{_N}", "epnp-lm", "p3p-ransac", "opencv-ransac")  # enough to see at a glance


def run_demo(
    folder: Path, *, data: str | None = None, metric: bool = True, count: int = 1000, train_seconds: float = 60.0
) -> None:
    """Compare the solvers, train, draw; print what comes out.

    Args:
        folder: where ``results.json``, the pictures and the training run go.
        data: a scene (see :func:`~kornia_pnpnet.data.load_scene`) instead of synthetic problems.
        metric: whether the scene is in metres.
        count: problems per set.
        train_seconds: how long to train, roughly; 0 leaves it out.
    """
    names = [name for name in default_solvers(_N, [data or "synthetic"]) if name.partition(":")[0] in _SOLVERS]
    if f"pnpnet-n{_N}" not in names:
        print(f"pnpnet: no weights pnpnet-n{_N} are shipped, going on without", file=sys.stderr)
    sets = evaluation_sets(
        [data or "synthetic"], "none,2" if data else "none,uniform", n=_N, count=count, metric=metric
    )
    solvers = {name: load_solver(name) for name in names}

    # Tensors are small: more threads are no faster, and crawl when another process computes beside them.
    torch.set_num_threads(1)
    print(f"{count} problems of {_N} pairs in each set, all solvers on the same ones, one thread:\n", flush=True)
    results = evaluate(solvers, sets)
    print(format_table(results), flush=True)
    save_results(results, folder / "results.json")
    made = [folder / "results.json"]
    made += [plot_success(folder / "success.png", results), plot_errors(folder / "errors.png", results)]
    name = names[0]
    made.append(_draw_one(folder / "problem.png", name, solvers[name], list(sets.values())[-1]))
    if train_seconds > 0:
        history = _train(train_seconds, folder / "training")
        if history is not None:
            made.append(plot_training(folder / "training.png", history))
    print("\nSaved:", *made, sep="\n  ")


def _draw_one(path: Path, name: str, solver: nn.Module, entry: EvaluationData) -> Path:
    """Draw the first of the problems with the most outliers: whichever it is, not a chosen one."""
    outliers = (~entry.problems.inliers).sum(-1)
    index = int((outliers == outliers.max()).int().argmax())
    world, img, intrinsics = (part[index : index + 1] for part in entry.problems[:3])
    with torch.no_grad():
        result = solver(world, img, intrinsics)
    projected = reprojections(world, result.pose, intrinsics)[0]
    errors = (projected - img[0]).norm(dim=-1)
    rejected = ~(errors <= rejection_limit(errors))
    return plot_pose(path, img[0], projected, rejected, title=f"{name}, {int(outliers[index])} wrong pairs")


def _train(seconds: float, folder: Path) -> Path | None:
    """Train briefly and say how far it came."""
    try:
        from kornia_pnpnet.training.loop import train_briefly
    except ImportError as error:
        print(f"pnpnet: no training: {error}; pip install 'kornia_pnpnet[train]'", file=sys.stderr)
        return None
    print(f"\nTraining a new network for about {seconds:.0f} s:", flush=True)
    history = train_briefly(seconds, folder)
    with history.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for column in (name for name in rows[0] if name.startswith("val/") and name.endswith("/success")):
        filled = [row for row in rows if row[column]]
        if filled:
            label = column.removeprefix("val/").removesuffix("/success")
            ends = (f"{100 * float(row[column]):.1f} % at update {row['update']}" for row in (filled[0], filled[-1]))
            print(f"  success, outliers {label}: {' -> '.join(ends)}")
    return history
