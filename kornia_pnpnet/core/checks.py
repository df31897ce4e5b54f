"""Checks of arguments. Every error message names the argument, the expected value and the received value."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any, TypeAlias

import torch
from kornia.core.check import KORNIA_CHECK, KORNIA_CHECK_SHAPE
from kornia.core.exceptions import DeviceError, ShapeError, TypeCheckError
from torch import Tensor

#: Maps the name of each argument to its tensor and its expected shape. A tensor that is ``None`` is not checked.
Shapes: TypeAlias = dict[str, tuple[Tensor | None, tuple[int, ...]]]


def _is_number(value: Any) -> bool:
    real = isinstance(value, Real) and not isinstance(value, bool)
    return real and bool(-math.inf < value < math.inf)


def check_whole(least: int, most: int | None = None, /, **values: Any) -> None:
    """Raise ``BaseError`` unless each value is a Python or NumPy integer in [least, most]. ``None`` means no limit."""
    bounds = f"of at least {least}" if most is None else f"from {least} to {most}"
    for name, value in values.items():
        whole = isinstance(value, Integral) and not isinstance(value, bool)
        inside = whole and least <= value and (most is None or value <= most)
        KORNIA_CHECK(inside, f"{name} must be an integer {bounds}, got {value!r}.")


def check_numbers(low: float, high: float = math.inf, /, **values: Any) -> None:
    """Raise ``BaseError`` unless each value is a finite number in ``[low, high]``."""
    bounds = f"of at least {low:g}" if high == math.inf else f"in [{low:g}, {high:g}]"
    for name, value in values.items():
        KORNIA_CHECK(_is_number(value) and low <= value <= high, f"{name} must be a number {bounds}, got {value!r}.")


def check_positive(*, or_infinite: bool = False, **values: Any) -> None:
    """Raise ``BaseError`` unless each value is a positive, finite number. ``or_infinite`` also allows infinity."""
    for name, value in values.items():
        positive = (_is_number(value) and value > 0) or (or_infinite and isinstance(value, Real) and value == math.inf)
        KORNIA_CHECK(positive, f"{name} must be a positive number, got {value!r}.")


def are_rising(values: Any, low: float, high: float = math.inf) -> bool:
    """Tell whether ``values`` are two finite numbers in ``[low, high]``, the second not smaller."""
    two_numbers = hasattr(values, "__len__") and len(values) == 2 and all(map(_is_number, values))
    return two_numbers and low <= values[0] <= values[1] <= high


def check_ranges(**values: Any) -> None:
    """Raise ``BaseError`` unless each value is a pair of finite numbers ``(low, high)`` with ``0 < low <= high``."""
    for name, value in values.items():
        in_order = are_rising(value, 0.0) and value[0] > 0
        KORNIA_CHECK(in_order, f"{name} must be two positive numbers, the second not smaller, got {value!r}.")


def check_tensors(tensors: Mapping[str, Any]) -> None:
    """Raise ``TypeCheckError`` when a value is not a tensor. ``None`` is skipped."""
    for name, value in tensors.items():
        if value is not None and not isinstance(value, Tensor):
            hint = " (torch.from_numpy converts it)" if type(value).__name__ == "ndarray" else ""
            raise TypeCheckError(f"{name} must be a tensor, got {type(value).__name__}{hint}.")


def check_form(form: list[str], **tensors: Tensor) -> None:
    """Raise an error unless each value is a tensor of the shape ``form`` (notation of ``KORNIA_CHECK_SHAPE``)."""
    check_tensors(tensors)
    for name, tensor in tensors.items():
        KORNIA_CHECK_SHAPE(tensor, form, f"Argument: {name}")


def check_shapes(shapes: Shapes, like: Tensor | None = None) -> None:
    """Raise an error when a value is not a tensor of its expected shape. The message names the shape of ``like``."""
    check_tensors({name: tensor for name, (tensor, _) in shapes.items()})
    for name, (tensor, expected) in shapes.items():
        if tensor is not None and tensor.shape != expected:
            beside = "" if like is None else f" to go with world_points of {tuple(like.shape)}"
            got = tuple(tensor.shape)
            message = f"{name} must have the shape {expected}{beside}, got {got}."
            raise ShapeError(message, actual_shape=got, expected_shape=expected)


def check_like(tensors: Mapping[str, Tensor | None], like: Tensor, like_name: str = "world_points") -> None:
    """Raise an error when a tensor has another dtype or device than ``like``. ``None`` is skipped."""
    for name, tensor in tensors.items():
        if tensor is not None and tensor.dtype != like.dtype:
            raise TypeCheckError(f"{name} is {tensor.dtype} but {like_name} is {like.dtype}.")
    check_devices(tensors, like, like_name)


def check_devices(tensors: Mapping[str, Tensor | None], like: Tensor, like_name: str = "world_points") -> None:
    """Raise ``DeviceError`` when a tensor is on another device than ``like``. ``None`` is skipped."""
    for name, tensor in tensors.items():
        if tensor is not None and tensor.device != like.device:
            raise DeviceError(f"{name} is on {tensor.device} but {like_name} is on {like.device}.")


def common_dtype(tensors: Mapping[str, Tensor | None]) -> torch.dtype:
    """Choose the dtype of a computation: float64 if any tensor is float64, else float32. ``None`` is ignored.

    Half precision would be too coarse for pixels, and integers have no gradient. Raise ``TypeCheckError`` when a tensor
    holds booleans or complex numbers.
    """
    given = {name: tensor.dtype for name, tensor in tensors.items() if tensor is not None}
    for name, dtype in given.items():
        if dtype == torch.bool or dtype.is_complex:
            raise TypeCheckError(f"{name} must hold floats or integers, got {dtype}.")
    return torch.float64 if torch.float64 in given.values() else torch.float32


def expand_sigma(name: str, sigma: Tensor | float | None, world_points: Tensor) -> Tensor:
    """Check a standard deviation, and expand it to (*, N) in the dtype of world points (*, N, 3).

    ``sigma`` is a number or has the shape (), (*) or (*, N). ``None`` becomes NaN. Error messages use ``name``.
    """
    pairs = world_points.shape[:-1]
    if sigma is None or isinstance(sigma, Real):
        value = torch.nan if sigma is None else float(sigma)
        return world_points.new_full(pairs, value, dtype=torch.float64).to(world_points.dtype)  # inf if it is too large
    if not isinstance(sigma, Tensor):
        raise TypeCheckError(f"{name} must be a number or a tensor, got {type(sigma).__name__}.")
    check_devices({name: sigma}, world_points)
    if sigma.shape not in ((), pairs[:-1], pairs):
        expected = f"be a number or have the shape {tuple(pairs[:-1])} or {tuple(pairs)}"
        got = tuple(sigma.shape)
        raise ShapeError(f"{name} must {expected}, got {got}.", actual_shape=got, expected_shape=["*", "N"])
    return (sigma if sigma.shape == pairs else sigma[..., None]).expand(pairs).to(world_points.dtype)
