"""What several commands share: a parser with one-line errors, types of arguments, and the choice of a solver."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from torch import nn

__all__ = [
    "OneLineParser",
    "add_arbitrary_unit",
    "counts",
    "existing_path",
    "load_solver_without_truth",
    "picture_path",
    "positive_float",
    "whole_number",
]

_PICTURES = (".pdf", ".png", ".svg")


class OneLineParser(argparse.ArgumentParser):
    """A parser whose errors are one line, as all errors of ``pnpnet`` are, and that takes lists of negative numbers."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r"-[\d.]")  # argparse takes "-1,2" for an option

    def error(self, message: str) -> NoReturn:
        """Print the message in one line and exit with the code 2."""
        self.exit(2, f"pnpnet: {' '.join(message.split())} (see {self.prog} --help)\n")


def whole_number(low: int, high: int = 10**8) -> Callable[[str], int]:
    """Make a parser of integers from ``low`` to ``high``; more problems or pairs than the default fill no memory."""

    def parse(text: str) -> int:
        if not text.isdecimal() or not low <= int(text[:20]) <= high:
            raise argparse.ArgumentTypeError(f"expected an integer from {low} to {high}, got {text!r}")
        return int(text)

    return parse


def counts(text: str) -> list[int]:
    """Parse integers of at least 1 separated by commas, without duplicates."""
    return list(dict.fromkeys(whole_number(1)(part.strip()) for part in text.split(",")))


def positive_float(text: str) -> float:
    """Parse a finite number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a positive number, got {text!r}")
    return value


def existing_path(text: str) -> str:
    """Parse the path of a file or a folder; ``OSError`` where there is none."""
    Path(text).stat()
    return text


def picture_path(text: str) -> Path:
    """Parse the path of a picture, whose ending gives the format."""
    if Path(text).suffix.lower() not in _PICTURES:
        raise argparse.ArgumentTypeError(f"expected a file ending in {', '.join(_PICTURES)}, got {text!r}")
    return Path(text)


def add_arbitrary_unit(parser: argparse.ArgumentParser) -> None:
    """Add ``--arbitrary-unit``, for scenes of unknown scale."""
    parser.add_argument(
        "--arbitrary-unit",
        action="store_true",
        help="the scene is not in metres: success needs a translation error below 0.5 %% of the median depth",
    )


def load_solver_without_truth(name: str) -> nn.Module:
    """Make the solver named by ``--solver``; raise a ``ValueError`` for a bound, which needs the true pose."""
    from kornia_pnpnet.evaluation.named_solvers import BOUNDS, load_solver

    if name.partition(":")[0] in BOUNDS:
        raise ValueError(f"--solver: {name} is a bound, which needs the true pose: use it with `pnpnet evaluate` only")
    return load_solver(name)
