"""Modules that remember the arguments of their constructor."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any

from torch import nn


class Configured(nn.Module):
    """A module whose ``config`` holds the arguments of its constructor, except arguments that are modules.

    Args:
        arguments: the result of ``locals()`` at the start of the subclass's constructor, before any assignment.
    """

    def __init__(self, arguments: Mapping[str, Any]) -> None:
        super().__init__()
        self.config: dict[str, Any] = {}
        for name, value in arguments.items():
            if name not in ("self", "__class__") and not isinstance(value, nn.Module):
                self.config[name] = as_plain(value)

    def extra_repr(self) -> str:
        """Show the arguments of the constructor."""
        return ", ".join(f"{name}={value!r}" for name, value in self.config.items())


def as_plain(value: Any) -> Any:
    """Convert a NumPy number to Python's, because neither JSON nor OpenCV accepts it. Other values do not change."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return value
    return int(value) if isinstance(value, Integral) else float(value)
