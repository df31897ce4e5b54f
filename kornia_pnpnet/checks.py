"""Checks of arguments, each with an error that says which one is wrong, what it must be and what it was."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any

from kornia.core.check import KORNIA_CHECK
from kornia.core.exceptions import ShapeError
from torch import Tensor

__all__ = ["check_numbers", "check_positive", "check_ranges", "check_shapes", "check_whole"]


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def check_whole(least: int, /, **values: Any) -> None:
    """Whole numbers of at least so much."""
    for name, value in values.items():
        whole = isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= least
        KORNIA_CHECK(whole, f"{name} must be an integer of at least {least}, got {value!r}.")


def check_numbers(low: float, high: float = math.inf, /, **values: Any) -> None:
    """Finite numbers in ``[low, high]``."""
    limits = f"of at least {low:g}" if high == math.inf else f"in [{low:g}, {high:g}]"
    for name, value in values.items():
        KORNIA_CHECK(_is_number(value) and low <= value <= high, f"{name} must be a number {limits}, got {value!r}.")


def check_positive(**values: Any) -> None:
    """Finite numbers above 0."""
    for name, value in values.items():
        KORNIA_CHECK(_is_number(value) and value > 0, f"{name} must be a positive number, got {value!r}.")


def check_ranges(**values: Any) -> None:
    """Two finite positive numbers that do not fall."""
    for name, value in values.items():
        numbers = hasattr(value, "__len__") and len(value) == 2 and all(map(_is_number, value))
        right = numbers and 0 < value[0] <= value[1]
        KORNIA_CHECK(right, f"{name} must be two positive numbers that do not fall, got {value!r}.")


def check_shapes(shapes: Mapping[str, tuple[Tensor | None, tuple[int, ...]]], beside: str = "") -> None:
    """Tensors that are there have the shapes that go with each other.

    Args:
        shapes: name of each tensor, what it is, and the shape that it must have.
        beside: what else the message says, such as whose batch it is.

    Raises:
        ShapeError: when one has not.
    """
    for name, (tensor, expected) in shapes.items():
        if tensor is not None and tensor.shape != expected:
            raise ShapeError(
                f"{name} must have the shape {expected}{beside}, got {tuple(tensor.shape)}.",
                actual_shape=tuple(tensor.shape),
                expected_shape=expected,
            )
