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
                if isinstance(value, Real) and not isinstance(value, bool):  # JSON has no NumPy numbers
                    value = int(value) if isinstance(value, Integral) else float(value)
                self.config[name] = value

    def extra_repr(self) -> str:
        """Show the arguments of the constructor."""
        return ", ".join(f"{name}={value!r}" for name, value in self.config.items())
