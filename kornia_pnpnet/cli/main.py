"""The command ``pnpnet``: solve a file of pairs, compare solvers, draw the figures, list solvers, and a demo."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path

import torch
from kornia.core.exceptions import BaseError

from kornia_pnpnet import list_solvers, shipped_weights
from kornia_pnpnet.cli.arguments import make_parser
from kornia_pnpnet.cli.pairs import PairsError, camera_matrix, read_pairs, rejection_limit, reprojections
from kornia_pnpnet.evaluation.named_solvers import BOUNDS, default_solvers, load_solver, missing_package
from kornia_pnpnet.evaluation.problem_sets import evaluation_sets

__all__ = ["main"]


def main(argv: list[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: arguments after the command's name; those of the process when ``None``.

    Returns:
        The exit code: 0, 1 when ``solve`` found no pose, 2 for bad input, 130 when interrupted.
    """
    arguments = make_parser().parse_args(argv)
    try:
        return _COMMANDS[arguments.command](arguments)
    except (BaseError, PairsError, OSError, ImportError, ValueError) as error:
        print(f"pnpnet: {_one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("pnpnet: interrupted", file=sys.stderr)
        return 130


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename and error.strerror:
        return " ".join(f"{error.filename}: {error.strerror}".splitlines())  # a name may have several
    notes = (f"({note})" for note in getattr(error, "__notes__", ()))
    return " ".join(" ".join([str(error) or type(error).__name__, *notes]).split())


def _solve_batch(arguments: argparse.Namespace, camera: torch.Tensor | None) -> int:
    from kornia_pnpnet.cli.shards import solve_shards

    if arguments.plot or arguments.threshold:
        raise ValueError("--plot and --threshold are for one image, not for --batch")
    name = arguments.solver or "pnpnet-set"
    report = solve_shards(
        _any_but_bounds(name),
        arguments.file,
        arguments.out or "outputs/poses",
        name=name,
        intrinsics=camera,
        batch=arguments.batch_size,
        overwrite=arguments.overwrite,
        watch=lambda shard, solved, count: print(f"{shard}: {solved} of {count} solved", flush=True),
    )
    for line in report.failed:
        print(f"pnpnet: {line}", file=sys.stderr)
    kept = f"; {report.kept} shards had been solved before" if report.kept else ""
    print(f"{report.solved} of {report.problems} problems in {report.shards} shards solved{kept}")
    return 2 if report.failed else 0


def _any_but_bounds(name: str) -> torch.nn.Module:
    if name.partition(":")[0] in BOUNDS:
        raise ValueError(f"--solver: {name} is a bound, which has to see the true pose: it can only be evaluated")
    return load_solver(name)


def _solve(arguments: argparse.Namespace) -> int:
    from kornia.geometry.conversions import rotation_matrix_to_quaternion

    camera = camera_matrix(arguments.intrinsics) if arguments.intrinsics else None
    if arguments.batch:
        return _solve_batch(arguments, camera)
    path, *more = arguments.file
    if more or arguments.out or arguments.overwrite:
        raise ValueError("several files, --out and --overwrite go with --batch")
    pairs = read_pairs(path)
    camera = pairs.intrinsics if camera is None else camera
    if camera is None:
        raise PairsError(path, "the camera is not in the file: pass --intrinsics fx,fy,cx,cy")
    count = len(pairs.world_points)
    name = arguments.solver
    if name is None:
        suited, shipped = (f"pnpnet-n{count}", "pnpnet-set"), shipped_weights()
        name = next((weights for weights in suited if weights in shipped), "identity-lm")
        if name not in shipped:
            print(f"pnpnet: no weights {suited[0]} are shipped, using {name}", file=sys.stderr)
    solver = _any_but_bounds(name)
    weights = None if pairs.weights is None else pairs.weights[None]
    with torch.no_grad():
        result = solver(pairs.world_points[None], pairs.img_points[None], camera[None], weights)

    projected = reprojections(pairs.world_points[None], result.pose, camera[None])[0]
    errors = (projected - pairs.img_points).norm(dim=-1)
    limit = rejection_limit(errors) if arguments.threshold is None else arguments.threshold
    rejected = ~(errors <= limit)
    answer = {
        "solver": name,
        "n": count,
        "ok": result.ok.item(),
        "rotation": result.rotation[0].tolist(),
        "translation": result.translation[0].tolist(),
        "quaternion_wxyz": rotation_matrix_to_quaternion(result.rotation)[0].tolist(),
        "cost": result.cost.item(),
        "rejected_above_px": limit,
        "pairs": [
            {"weight": weight, "reprojection_error_px": error if math.isfinite(error) else None, "rejected": bad}
            for weight, error, bad in zip(result.weights[0].tolist(), errors.tolist(), rejected.tolist(), strict=True)
        ],
    }
    print(json.dumps(answer, indent=2, allow_nan=False))
    if arguments.plot:
        from kornia_pnpnet.evaluation.figures import plot_pose

        plot_pose(arguments.plot, pairs.img_points, projected, rejected, title=name)
    return 0 if answer["ok"] else 1


def _evaluate(arguments: argparse.Namespace) -> int:
    from kornia_pnpnet.evaluation.comparison import evaluate, format_table, load_results

    out = Path(arguments.out)
    kept = len(load_results(out)["rows"]) if out.exists() and not arguments.overwrite else 0
    sources = arguments.data or ["synthetic"]
    solvers = {name: load_solver(name) for name in arguments.solver or default_solvers(arguments.n, sources)}
    sets = evaluation_sets(
        sources,
        arguments.outliers,
        n=arguments.n,
        count=arguments.problems,
        seed=arguments.seed,
        metric=not arguments.arbitrary_unit,
        mismatches_only=arguments.mismatches_only,
        dtype=getattr(torch, arguments.dtype),
    )
    torch.set_num_threads(1)  # as in the demo, and as the peers have it
    try:
        results = evaluate(solvers, sets, path=out, overwrite=arguments.overwrite)
    except KeyboardInterrupt:
        print(f"pnpnet: interrupted; the same command continues {out}", file=sys.stderr)
        return 130
    reasons: dict[str, list[str]] = {}
    for entry in results["left_out"]:
        reasons.setdefault(entry["solver"], []).append(entry["reason"])
    if not results["rows"]:
        raise ValueError(f"no solver takes these problems: {results['left_out'][0]['reason']}")
    for solver, given in reasons.items():
        print(f"pnpnet: {solver} is left out on {len(given)} of {len(sets)} sets: {given[0]}", file=sys.stderr)
    print(format_table(results))
    print(f"\nResults: {out}" + (f" ({kept} of {len(results['rows'])} rows were there)" if kept else ""))
    if arguments.plot:
        from kornia_pnpnet.evaluation.figures import plot_errors, plot_success

        folder = Path(arguments.plot)
        pictures = plot_success(folder / "success.png", results), plot_errors(folder / "errors.png", results)
        print("Pictures: " + ", ".join(map(str, pictures)))
    return 0


def _figures(arguments: argparse.Namespace) -> int:
    from kornia_pnpnet.evaluation.comparison import load_results
    from kornia_pnpnet.evaluation.figures import paper_figures

    pictures = paper_figures([load_results(path, complexity=True) for path in arguments.files], arguments.out)
    print(*pictures, sep="\n")
    return 0


def _export(arguments: argparse.Namespace) -> int:
    from kornia_pnpnet.export import INPUTS, OUTPUTS, export_onnx
    from kornia_pnpnet.solver import PnPNet

    solver = _any_but_bounds(arguments.solver)
    if not isinstance(solver, PnPNet):
        raise ValueError(f"--solver: {arguments.solver} is another library's, which has no graph")
    path = export_onnx(solver, arguments.file, arguments.n)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, {', '.join(INPUTS)} -> {', '.join(OUTPUTS)}")
    return 0


def _list(_: argparse.Namespace) -> int:
    states = {}
    for name in list_solvers():
        package = missing_package(name)
        states[name] = f"needs {package}: pip install 'kornia_pnpnet[eval]'" if package else "installed"
    states |= dict.fromkeys(BOUNDS, "bound: sees the true pose, for `pnpnet evaluate` only")
    for name, state in states.items():
        print(f"{name:<{max(map(len, states))}}  {state}")
    print(f"\nShipped weights: {', '.join(shipped_weights()) or 'none'}")
    return 0


def _demo(arguments: argparse.Namespace) -> int:
    from kornia_pnpnet.cli.demo import run_demo

    run_demo(
        Path(arguments.out),
        data=arguments.data,
        metric=not arguments.arbitrary_unit,
        count=arguments.problems,
        train_seconds=arguments.train_seconds,
    )
    return 0


_COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "solve": _solve,
    "export": _export,
    "evaluate": _evaluate,
    "figures": _figures,
    "list": _list,
    "demo": _demo,
}
