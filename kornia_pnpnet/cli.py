"""The command ``pnpnet``: solve a file of pairs, compare solvers, list them, and a demo."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any, NoReturn

import torch
from kornia.core.exceptions import BaseError

from kornia_pnpnet import __version__, list_solvers, shipped_weights
from kornia_pnpnet.choices import DEFAULT_SEED, default_solvers, evaluation_sets, load_solver, missing_package
from kornia_pnpnet.pairs import PairsError, camera_matrix, read_pairs, rejection_limit, reprojections

__all__ = ["main"]

_PICTURES = (".pdf", ".png", ".svg")


class _Parser(argparse.ArgumentParser):
    """Errors on one line, like all others."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"pnpnet: {message} (see {self.prog} --help)\n")


def _positive_int(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected an integer of at least 1, got {text!r}")
    return int(text)


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"expected an integer of at least 0, got {text!r}")
    return int(text)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a positive number, got {text!r}")
    return value


def _not_negative(text: str) -> float:
    return 0.0 if text in ("0", "0.0") else _positive(text)


def _picture(text: str) -> Path:
    if Path(text).suffix.lower() not in _PICTURES:
        raise argparse.ArgumentTypeError(f"expected a file ending in {', '.join(_PICTURES)}, got {text!r}")
    return Path(text)


def _parser() -> _Parser:
    parser = _Parser(prog="pnpnet", description="Camera poses from 2D-3D pairs of which some are wrong.")
    parser.add_argument("--version", action="version", version=f"pnpnet {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def command(name: str, run: Any, help_text: str, details: str) -> argparse.ArgumentParser:
        added = commands.add_parser(
            name, help=help_text, description=details, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        added.set_defaults(run=run)
        return added

    solve = command(
        "solve",
        _solve,
        "find the pose of one image",
        "Find the pose of one image and print it as JSON: x_cam = R x_world + t.\n\n"
        "  pnpnet solve pairs.csv --intrinsics 3400,3400,3024,2016 --plot pose.png\n\n"
        "Exit code: 0 when solved, 1 when the solver found no pose that explains the pairs, 2 for bad input.",
    )
    solve.add_argument(
        "file",
        metavar="FILE",
        help="CSV with the header X,Y,Z,u,v and optionally weight, or NPZ with world_points (N, 3), img_points (N, 2) "
        "and optionally weights (N,) and intrinsics (3, 3)",
    )
    solve.add_argument("--intrinsics", metavar="fx,fy,cx,cy", help="the camera in pixels; goes before an NPZ's own")
    solve.add_argument(
        "--solver", metavar="NAME", help="see `pnpnet list`, or a folder of weights; default: pnpnet-nN for N pairs"
    )
    solve.add_argument("--plot", metavar="PNG", type=_picture, help="draw pixels, reprojections and rejected pairs")
    solve.add_argument(
        "--threshold",
        metavar="PX",
        type=_positive,
        help="pairs with a larger reprojection error are rejected; default: a robust three sigma, at least 3 px",
    )

    evaluate = command(
        "evaluate",
        _evaluate,
        "compare solvers on the same problems",
        "Compare solvers on the same problems, in float32; print a table and write a results file.\n\n"
        "  pnpnet evaluate --solver pnpnet-n9 opencv-ransac:threshold=12 --data path/to/colmap --outliers none,2",
    )
    evaluate.add_argument(
        "--solver",
        metavar="NAME",
        nargs="+",
        action="extend",
        help="see `pnpnet list`, options after a colon (opencv-ransac:threshold=12,iterations=100), or folders of "
        "weights; default: those for n that are installed",
    )
    evaluate.add_argument(
        "--data",
        metavar="DATA",
        nargs="+",
        action="extend",
        help="synthetic, a folder with a COLMAP model, or an .npz file of matches; default: synthetic",
    )
    evaluate.add_argument("--n", type=_positive_int, default=9, help="pairs per problem; default: 9")
    evaluate.add_argument(
        "--outliers",
        metavar="LIST",
        default="none,uniform",
        help="none, uniform (0 to n/3 of the pairs) or numbers, with commas; default: none,uniform",
    )
    evaluate.add_argument("--problems", type=_positive_int, default=1000, help="per set; default: 1000")
    evaluate.add_argument("--seed", type=_seed, default=DEFAULT_SEED, help=f"of the problems; default: {DEFAULT_SEED}")
    _add_unit(evaluate)
    evaluate.add_argument("--out", metavar="JSON", default="outputs/results.json", help="default: outputs/results.json")
    evaluate.add_argument("--plot", metavar="FOLDER", help="draw success rates and error curves into this folder")

    command("list", _list, "list solvers and weights", "List the solvers that --solver takes.\n\n  pnpnet list")

    demo = command(
        "demo",
        _demo,
        "solve problems beside OpenCV, then train for a minute",
        "Solve random problems without and with outliers beside OpenCV's RANSAC, train a small model, draw pictures.\n"
        "\n  pnpnet demo --data path/to/colmap --out outputs/demo",
    )
    demo.add_argument("--data", metavar="FOLDER", help="a COLMAP model or an .npz file of matches, not synthetic data")
    _add_unit(demo)
    demo.add_argument("--out", metavar="FOLDER", default="outputs/demo", help="default: outputs/demo")
    demo.add_argument("--problems", type=_positive_int, default=1000, help="per set; default: 1000")
    demo.add_argument(
        "--train-seconds", type=_not_negative, default=60.0, help="0 leaves the training out; default: 60"
    )
    return parser


def _add_unit(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--arbitrary-unit",
        action="store_true",
        help="the scene is not in metres: a success has a translation error below 0.5 %% of the median depth",
    )


def main(argv: list[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: arguments after the command's name; those of the process when ``None``.

    Returns:
        The exit code: 0, 1 when ``solve`` found no pose, 2 for bad input, 130 when interrupted.
    """
    arguments = _parser().parse_args(argv)
    try:
        return int(arguments.run(arguments))
    except (BaseError, PairsError, OSError, ImportError, ValueError) as error:
        print(f"pnpnet: {_one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("pnpnet: interrupted", file=sys.stderr)
        return 130


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__


def _solve(arguments: argparse.Namespace) -> int:
    from kornia.geometry.conversions import rotation_matrix_to_quaternion

    camera = camera_matrix(arguments.intrinsics) if arguments.intrinsics else None
    pairs = read_pairs(arguments.file)
    camera = pairs.intrinsics if camera is None else camera
    if camera is None:
        raise PairsError(arguments.file, "the camera is not in the file: pass --intrinsics fx,fy,cx,cy")
    count = len(pairs.world_points)
    name = arguments.solver
    if name is None:
        name = f"pnpnet-n{count}"
        if name not in shipped_weights():
            print(f"pnpnet: no weights {name} are shipped, using identity-lm", file=sys.stderr)
            name = "identity-lm"
    solver = load_solver(name)
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
        from kornia_pnpnet.figures import plot_pose

        plot_pose(arguments.plot, pairs.img_points, projected, rejected, title=name)
    return 0 if answer["ok"] else 1


def _evaluate(arguments: argparse.Namespace) -> int:
    from kornia_pnpnet.evaluation import evaluate, format_table, save_results

    sources = arguments.data or ["synthetic"]
    solvers = {name: load_solver(name) for name in arguments.solver or default_solvers(arguments.n, sources)}
    sets = evaluation_sets(
        sources,
        arguments.outliers,
        n=arguments.n,
        count=arguments.problems,
        seed=arguments.seed,
        metric=not arguments.arbitrary_unit,
    )
    results = evaluate(solvers, sets)
    save_results(results, arguments.out)
    print(format_table(results))
    print(f"\nResults: {arguments.out}")
    if arguments.plot:
        from kornia_pnpnet.figures import plot_errors, plot_success

        folder = Path(arguments.plot)
        pictures = plot_success(folder / "success.png", results), plot_errors(folder / "errors.png", results)
        print("Pictures: " + ", ".join(map(str, pictures)))
    return 0


def _list(_: argparse.Namespace) -> int:
    names = list_solvers()
    for name in names:
        package = missing_package(name)
        state = f"needs {package}: pip install 'kornia_pnpnet[eval]'" if package else "installed"
        print(f"{name:<{max(map(len, names))}}  {state}")
    print(f"\nShipped weights: {', '.join(shipped_weights()) or 'none'}")
    return 0


def _demo(arguments: argparse.Namespace) -> int:
    from kornia_pnpnet.demo import run_demo

    run_demo(
        Path(arguments.out),
        data=arguments.data,
        metric=not arguments.arbitrary_unit,
        count=arguments.problems,
        train_seconds=arguments.train_seconds,
    )
    return 0
