"""A table of the arguments of all commands, parsers of arguments, and a loader of the solver for ``--solver``."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

if TYPE_CHECKING:
    from torch import nn

_T = TypeVar("_T")

# Largest standard deviation of log(focal length) for `--focal`. A larger number is probably a focal length in pixels.
_MOST_SIGMA = 3.0

#: Names of synthetic data for ``--data``.
SYNTHETIC = ("synthetic", "gaussian_pose", "any_rotation", "slab", "mixed")


class OneLineParser(argparse.ArgumentParser):
    """A parser that accepts values such as ``-1,2`` and reports errors in one line."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r"-[\d.]")  # argparse would read "-1,2" as an option

    def error(self, message: str) -> NoReturn:
        """Print the message in one line and exit with the code 2."""
        self.exit(2, f"pnpnet: {' '.join(message.split())} (see {self.prog} --help)\n")


def _checked(read: Callable[[str], _T], fits: Callable[[_T], bool], expected: str) -> Callable[[str], _T]:
    """Make a parser that applies ``read``, and refuses values for which ``fits`` returns false."""

    def parse(text: str) -> _T:
        with suppress(ValueError):
            value = read(text)
            if fits(value):
                return value
        raise argparse.ArgumentTypeError(f"expected {expected}, got {text!r}")

    return parse


def _whole(low: int, high: int = 10**8) -> Callable[[str], int]:
    """Make a parser of integers. The default of ``high`` excludes numbers that would fill the memory."""
    return _checked(int, lambda value: low <= value <= high, f"an integer from {low} to {high}")


_positive = _checked(float, lambda value: 0 < value < math.inf, "a positive number")
_seconds = _checked(float, lambda value: 0 <= value < math.inf, "a number of at least 0")
_picture = _checked(Path, lambda path: path.suffix.lower() in (".pdf", ".png", ".svg"), "a .pdf, .png or .svg file")


def _counts(text: str) -> list[int]:
    """Parse integers of at least 1 that are separated by commas, and drop duplicates."""
    return list(dict.fromkeys(map(_whole(1), text.split(","))))


def _focal(text: str) -> dict[str, Any]:
    """Parse ``--focal`` into options of :class:`~kornia_pnpnet.PnPNet`."""
    if text in ("known", "unknown"):  # without the prior that a saved solver may have
        return {"focal": text, "focal_sigma": None, **({"radial": 0} if text == "known" else {})}
    if (sigma := _positive(text)) > _MOST_SIGMA:
        fix = f"pass --intrinsics {text},{text},cx,cy; SIGMA is a fraction, such as 0.1"
        raise argparse.ArgumentTypeError(f"{text} is a focal length: {fix}")
    return {"focal": "unknown", "focal_sigma": sigma}


def _path(text: str) -> str:
    """Return the path of a file or a folder. Raise ``OSError`` when the path does not exist."""
    Path(text).stat()
    return text


def _source(text: str) -> str:
    return text if text in SYNTHETIC else _path(text)


def _arg(help_: str, metavar: str | None = None, **more: Any) -> dict[str, Any]:
    """Make options of ``ArgumentParser.add_argument``. The help text ends with the default, if there is one."""
    return {"help": f"{help_}; default: %(default)s" if "default" in more else help_, "metavar": metavar, **more}


def _flag(help_: str) -> dict[str, Any]:
    return {"help": help_, "action": "store_true"}


_PROBLEMS = _arg("problems per set", "COUNT", type=_whole(1), default=1000)
_UNIT = _flag("the scene is not in metres: success needs a translation error below 0.5 %% of the median depth")
_SOLVER = _arg("a name of `pnpnet list`, or a folder of weights", "NAME", default="pnpnet-set")
_MATCHES = """CSV with the header X,Y,Z,u,v and optionally weight, or NPZ with world_points (N, 3), img_points (N, 2)
and optionally weights (N,) and intrinsics (3, 3)"""
_INTRINSICS = "the camera in pixels; replaces that of an NPZ file; with --batch, for shards without intrinsics"
_CAMERA = """a distorted camera as in COLMAP's cameras.txt, in place of --intrinsics, for example
SIMPLE_RADIAL,1920,1080,1500,960,540,-0.02; reprojection errors and sigma then refer to undistorted pixels"""
_FOCAL = "unknown: estimate the focal length; SIGMA: improve the given one, which has this relative error, such as 0.1"
_THRESHOLD = "reject correspondences with a larger reprojection error; default: reject all but the solver's inliers"
_SOLVERS = """names of `pnpnet list`, with options after a colon (opencv-ransac:threshold=12,iterations=100), or folders
of weights; solvers for another n are skipped; default: the usual installed solvers for these n, and the bounds"""
_DATA = f"{', '.join(SYNTHETIC)}, a folder with a COLMAP model, or an .npz file of matches; default: synthetic"
_OUTLIERS = "none, uniform (0 to n/3 per problem), numbers or shares like 50%%, separated by commas"
_MISMATCHES = "every outlier gets the pixel of another point; default: half of them, the others get random pixels"
_DURATION = "approximate duration of the training; 0 skips the training"
#: The arguments of each command.
ARGUMENTS: dict[str, dict[str, dict[str, Any]]] = {
    "solve": {
        "file": _arg(_MATCHES, "FILE", nargs="+", type=_path),
        "--intrinsics": _arg(_INTRINSICS, "fx,fy,cx,cy"),
        "--camera": _arg(_CAMERA, "MODEL,w,h,PARAMS"),
        "--focal": _arg(_FOCAL, "known|unknown|SIGMA", type=_focal),
        "--solver": _SOLVER,
        "--plot": _arg("draw pixels, reprojections and rejected correspondences", "PNG", type=_picture),
        "--threshold": _arg(_THRESHOLD, "PX", type=_positive),
        "--diagnose": _flag(
            "undo usual mistakes (swapped columns, y up, another image size), and name the change that helps"
        ),
        "--json": _flag("print JSON on a terminal, too"),
        "--batch": _flag("every FILE is a shard (a file of many problems) or a folder of shards"),
        "--out": _arg("where --batch writes poses; default: outputs/poses", "FOLDER"),
        "--batch-size": _arg("problems per call", "B", type=_whole(1), default=10_000),
        "--overwrite": _flag(
            "replace the picture; with --batch first delete the results of all shards, then solve all"
        ),
    },
    "evaluate": {
        "--solver": _arg(_SOLVERS, "NAME", nargs="+", action="extend"),
        "--data": _arg(_DATA, "DATA", nargs="+", action="extend", type=_source),
        "--n": _arg("numbers of correspondences per problem, separated by commas", "LIST", type=_counts, default="9"),
        "--outliers": _arg(_OUTLIERS, "LIST", default="none,uniform"),
        "--mismatches-only": _flag(_MISMATCHES),
        "--problems": _PROBLEMS,
        "--seed": _arg("seed of the problems; default: the published results' seed", type=_whole(0, 2**63 - 1)),
        "--dtype": _arg("dtype of the problems", choices=("float32", "float64"), default="float32"),
        "--arbitrary-unit": _UNIT,
        "--out": _arg("the results file", "JSON", default="outputs/results.json"),
        "--overwrite": _flag("replace the results file instead of continuing it"),
        "--plot": _arg("draw success rates and error curves into this folder", "FOLDER"),
    },
    "export": {
        "file": _arg("the file to write, .onnx or .pt2", "FILE"),
        "--solver": _SOLVER,
        "--pairs": _arg(
            "correspondences per problem; several numbers: a .pt2 with a model for each; default: any number",
            "LIST",
            type=_counts,
        ),
        "--batch": _arg("problems per call; default: any number", "B", type=_whole(1)),
        "--rig": _flag("for rigs: several cameras with one pose"),
        "--overwrite": _flag("replace the file"),
    },
    "list": {},
    "demo": {
        "--data": _arg("a COLMAP model or an .npz file of matches instead of random problems", "FOLDER", type=_path),
        "--arbitrary-unit": _UNIT,
        "--out": _arg("where results and pictures go", "FOLDER", default="outputs/demo"),
        "--problems": _PROBLEMS,
        "--train-seconds": _arg(_DURATION, "SECONDS", type=_seconds, default=60.0),
    },
}


def load_solver_without_truth(name: str) -> nn.Module:
    """Make the solver named by ``--solver``. Raise ``ValueError`` for a bound, because bounds need the true pose."""
    from kornia_pnpnet.evaluation.named_solvers import BOUNDS, load_solver

    if name.partition(":")[0] in BOUNDS:
        raise ValueError(f"--solver: {name} is a bound, which needs the true pose: use it with `pnpnet evaluate` only")
    return load_solver(name)
