"""Checks of arguments, each with an error that says which one is wrong, what it must be and what it was."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any, TypeAlias

from kornia.core.check import KORNIA_CHECK
from kornia.core.exceptions import DeviceError, ShapeError, TypeCheckError
from torch import Tensor

from kornia_pnpnet.types import Pose

__all__ = [
    "Shapes",
    "check_devices",
    "check_like",
    "check_numbers",
    "check_poses",
    "check_positive",
    "check_ranges",
    "check_shapes",
    "check_whole",
]

#: For the name of each tensor: the tensor, or ``None`` where it was left out, and the shape that it must have.
Shapes: TypeAlias = dict[str, tuple[Tensor | None, tuple[int, ...]]]


def _is_number(value: Any) -> bool:
    right = isinstance(value, Real) and not isinstance(value, bool)
    return right and bool(-math.inf < value < math.inf)


def check_whole(least: int, /, **values: Any) -> None:
    """Raise a ``BaseError`` unless these are whole numbers of at least so much."""
    for name, value in values.items():
        whole = isinstance(value, Integral) and not isinstance(value, bool)
        KORNIA_CHECK(whole and value >= least, f"{name} must be an integer of at least {least}, got {value!r}.")


def check_numbers(low: float, high: float = math.inf, /, **values: Any) -> None:
    """Raise a ``BaseError`` unless these are finite numbers in ``[low, high]``."""
    limits = f"of at least {low:g}" if high == math.inf else f"in [{low:g}, {high:g}]"
    for name, value in values.items():
        KORNIA_CHECK(_is_number(value) and low <= value <= high, f"{name} must be a number {limits}, got {value!r}.")


def check_positive(*, or_infinite: bool = False, **values: Any) -> None:
    """Raise a ``BaseError`` unless these are positive and finite, or infinite where that is allowed."""
    for name, value in values.items():
        right = (_is_number(value) and value > 0) or (or_infinite and value == math.inf)
        KORNIA_CHECK(right, f"{name} must be a positive number, got {value!r}.")


def check_ranges(**values: Any) -> None:
    """Raise a ``BaseError`` unless these are two positive numbers each, the first not larger than the second."""
    for name, value in values.items():
        numbers = hasattr(value, "__len__") and len(value) == 2 and all(map(_is_number, value))
        right = numbers and 0 < value[0] <= value[1]
        KORNIA_CHECK(right, f"{name} must be two positive numbers, the second not smaller, got {value!r}.")


def check_shapes(shapes: Shapes, like: Tensor | None = None) -> None:
    """Check that tensors have the shapes that go with each other.

    Args:
        shapes: see :data:`Shapes`.
        like: the world points whose batch they belong to, for the message.

    Raises:
        ShapeError: when one has another shape.
    """
    for name, (tensor, expected) in shapes.items():
        if tensor is not None and tensor.shape != expected:
            beside = "" if like is None else f" to go with world_points of {tuple(like.shape)}"
            raise ShapeError(
                f"{name} must have the shape {expected}{beside}, got {tuple(tensor.shape)}.",
                actual_shape=tuple(tensor.shape),
                expected_shape=expected,
            )


def check_like(tensors: Mapping[str, Tensor | None], like: Tensor, name: str = "world_points") -> None:
    """Check that tensors have the dtype of another one and are where it is; ``name`` is that of the other one.

    Raises:
        TypeCheckError: when one has another dtype.
        DeviceError: when one is on another device.
    """
    for this, tensor in tensors.items():
        if tensor is not None and tensor.dtype != like.dtype:
            raise TypeCheckError(f"{this} is {tensor.dtype} but {name} is {like.dtype}.")
    check_devices(tensors, like, name)


def check_devices(tensors: Mapping[str, Tensor | None], like: Tensor, name: str = "world_points") -> None:
    """Check that tensors are where another one is, those of no dimension, too; ``name`` is that of the other one.

    Raises:
        DeviceError: when one is on another device.
    """
    for this, tensor in tensors.items():
        if tensor is not None and tensor.device != like.device:
            raise DeviceError(f"{this} is on {tensor.device} but {name} is on {like.device}.")


def check_poses(estimate: Pose, truth: Pose) -> None:
    """Check that both are as many poses: broadcasting would compare what does not belong together.

    Raises:
        ShapeError: when the shapes are not (*, 3, 3) and (*, 3), with the same leading ones.
        TypeCheckError: when the dtypes differ.
        DeviceError: when the devices differ.
    """
    batch = tuple(estimate.translation.shape[:-1])
    shapes: Shapes = {}
    for name, pose in (("estimate", estimate), ("truth", truth)):
        shapes[f"The rotation of the {name}"] = pose.rotation, (*batch, 3, 3)
        shapes[f"The translation of the {name}"] = pose.translation, (*batch, 3)
    check_shapes(shapes)
    parts = {name: tensor for name, (tensor, _) in shapes.items()}
    check_like(parts, truth.translation, "the translation of the truth")
