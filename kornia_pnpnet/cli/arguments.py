"""The arguments of the command ``pnpnet``: names, types, defaults and help."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import NoReturn

from kornia_pnpnet import __version__
from kornia_pnpnet.evaluation.problem_sets import DEFAULT_SEED, PRIORS

__all__ = ["make_parser"]

_PICTURES = (".pdf", ".png", ".svg")


class _Parser(argparse.ArgumentParser):
    """Errors on one line, like all others."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"pnpnet: {' '.join(message.split())} (see {self.prog} --help)\n")


def _positive_int(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected an integer of at least 1, got {text!r}")
    return int(text)


def _positive_ints(text: str) -> list[int]:
    return list(dict.fromkeys(_positive_int(part.strip()) for part in text.split(",")))


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


def make_parser() -> argparse.ArgumentParser:
    """The parser of ``pnpnet``; ``command`` of what it returns is the command's name."""
    parser = _Parser(prog="pnpnet", description="Camera poses from 2D-3D pairs of which some are wrong.")
    parser.add_argument("--version", action="version", version=f"pnpnet {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command", required=True)

    def command(name: str, help_text: str, details: str) -> argparse.ArgumentParser:
        return commands.add_parser(
            name, help=help_text, description=details, formatter_class=argparse.RawDescriptionHelpFormatter
        )

    solve = command(
        "solve",
        "find the pose of one image, or of very many",
        "Find the pose of one image and print it as JSON: x_cam = R x_world + t.\n\n"
        "  pnpnet solve pairs.csv --intrinsics 3400,3400,3024,2016 --plot pose.png\n\n"
        "Solve files of many problems each, in bounded memory, and write their poses; the same command goes on where\n"
        "it was stopped. Shards are NPZ files with world_points (B, N, 3), img_points (B, N, 2) and optionally\n"
        "weights, intrinsics, img_sigma and world_sigma, or Parquet files with such columns, a problem in each row.\n\n"
        "  pnpnet solve --batch shards/ --out poses/\n\n"
        "Exit code: 0 when solved, 1 when the solver found no pose that explains the pairs, 2 for bad input.",
    )
    solve.add_argument(
        "file",
        metavar="FILE",
        nargs="+",
        help="CSV with the header X,Y,Z,u,v and optionally weight, or NPZ with world_points (N, 3), img_points (N, 2) "
        "and optionally weights (N,) and intrinsics (3, 3)",
    )
    solve.add_argument("--intrinsics", metavar="fx,fy,cx,cy", help="the camera in pixels; goes before an NPZ's own")
    solve.add_argument(
        "--solver",
        metavar="NAME",
        help="see `pnpnet list`, or a folder of weights; default: pnpnet-nN for N pairs, or pnpnet-set",
    )
    solve.add_argument("--plot", metavar="PNG", type=_picture, help="draw pixels, reprojections and rejected pairs")
    solve.add_argument(
        "--threshold",
        metavar="PX",
        type=_positive,
        help="pairs with a larger reprojection error are rejected; default: a robust three sigma, at least 3 px",
    )
    solve.add_argument("--batch", action="store_true", help="FILE are shards of many problems, or folders of them")
    solve.add_argument("--out", metavar="FOLDER", help="where --batch writes poses; default: outputs/poses")
    solve.add_argument(
        "--batch-size", metavar="B", type=_positive_int, default=10_000, help="problems at once; default: 10000"
    )
    solve.add_argument("--overwrite", action="store_true", help="solve shards again whose poses are there")

    evaluate = command(
        "evaluate",
        "compare solvers on the same problems",
        "Compare solvers on the same problems in one thread; print a table and write a results file. The same\n"
        "command continues an evaluation that was interrupted; with more solvers, data, n or outliers it adds them.\n\n"
        "  pnpnet evaluate --solver pnpnet-n9 opencv-ransac:threshold=12 --data path/to/colmap --outliers none,2\n"
        "  pnpnet evaluate --n 6,9,20,50 --outliers none,uniform,30%",
    )
    evaluate.add_argument(
        "--solver",
        metavar="NAME",
        nargs="+",
        action="extend",
        help="see `pnpnet list`, options after a colon (opencv-ransac:threshold=12,iterations=100), or folders of "
        "weights; left out where n is not theirs; default: all for these n that are installed, and the bounds",
    )
    evaluate.add_argument(
        "--data",
        metavar="DATA",
        nargs="+",
        action="extend",
        help=f"{', '.join(PRIORS)}, a folder with a COLMAP model, or an .npz file of matches; default: synthetic",
    )
    evaluate.add_argument(
        "--n", metavar="LIST", type=_positive_ints, default=[9], help="pairs per problem, with commas; default: 9"
    )
    evaluate.add_argument(
        "--outliers",
        metavar="LIST",
        default="none,uniform",
        help="none, uniform (0 to n/3 of the pairs), numbers or shares like 50%%, with commas; default: none,uniform",
    )
    evaluate.add_argument(
        "--mismatches-only", action="store_true", help="all outliers are pixels of other points; default: half of them"
    )
    evaluate.add_argument("--problems", type=_positive_int, default=1000, help="per set; default: 1000")
    evaluate.add_argument("--seed", type=_seed, default=DEFAULT_SEED, help=f"of the problems; default: {DEFAULT_SEED}")
    evaluate.add_argument("--dtype", choices=("float32", "float64"), default="float32", help="default: float32")
    _add_unit(evaluate)
    evaluate.add_argument("--out", metavar="JSON", default="outputs/results.json", help="default: outputs/results.json")
    evaluate.add_argument("--overwrite", action="store_true", help="start anew, whatever the results file holds")
    evaluate.add_argument("--plot", metavar="FOLDER", help="draw success rates and error curves into this folder")

    figures = command(
        "figures",
        "draw the paper's figures from results files",
        "Draw those of the paper's figures for which the results files hold data.\n\n"
        "  pnpnet figures outputs/synthetic.json outputs/real.json --out outputs/figures",
    )
    figures.add_argument(
        "files", metavar="RESULTS.json", nargs="+", help="what `pnpnet evaluate` wrote, or operation counts"
    )
    figures.add_argument("--out", metavar="FOLDER", default="outputs/figures", help="default: outputs/figures")

    export = command(
        "export",
        "write a solver as an ONNX model",
        "Write a solver as an ONNX model for batches of any size, which ONNX Runtime runs without PyTorch.\n\n"
        "  pnpnet export pnpnet-set.onnx",
    )
    export.add_argument("file", metavar="ONNX", help="where to")
    export.add_argument("--solver", metavar="NAME", default="pnpnet-set", help="default: pnpnet-set")
    export.add_argument("--n", metavar="N", type=_positive_int, help="for just so many pairs; default: any number")

    command("list", "list solvers and weights", "List the solvers that --solver takes.\n\n  pnpnet list")

    demo = command(
        "demo",
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
