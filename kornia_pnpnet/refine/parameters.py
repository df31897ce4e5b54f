"""Hyperparameters that are learned without bounds and used within bounds."""

from __future__ import annotations

import math

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor, nn

from kornia_pnpnet.core.checks import check_numbers, check_whole

__all__ = ["BoundedParameter"]

# Largest absolute value of a raw parameter. The sigmoid of 1000 rounds to 1 in float64.
_BOUND = 1e3


class BoundedParameter(nn.Module):
    """Values that are learned without bounds and used within bounds.

    A sigmoid maps the raw parameter to ``[lower, upper]``, in log space if ``logarithmic``.

    Args:
        initial: initial value of each entry, within the bounds. Training never changes a value at a bound.
        size: number of entries.
        lower: lower bound.
        upper: upper bound.
        logarithmic: interpolate between the logarithms of the bounds, which must be positive.

    Raises:
        BaseError: when ``lower`` is not less than ``upper``, or ``initial`` is not within the bounds.

    Example:
        >>> BoundedParameter(1e-3, size=2, lower=1e-6, upper=1.0, logarithmic=True)()
        tensor([0.0010, 0.0010], grad_fn=<ExpBackward0>)
    """

    def __init__(self, initial: float, *, size: int, lower: float, upper: float, logarithmic: bool = False) -> None:
        super().__init__()
        check_whole(1, size=size)
        check_numbers(-math.inf, lower=lower, upper=upper)
        KORNIA_CHECK(lower < upper, f"The bounds must rise, got {lower} and {upper}.")
        KORNIA_CHECK(not logarithmic or lower > 0, f"The bounds of a logarithm must be positive, got {lower}.")
        KORNIA_CHECK(lower <= initial <= upper, f"The initial value {initial} must lie between {lower} and {upper}.")
        self._logarithmic = logarithmic
        self._lower, self._upper = (math.log(lower), math.log(upper)) if logarithmic else (lower, upper)
        share = ((math.log(initial) if logarithmic else initial) - self._lower) / (self._upper - self._lower)
        # The logit of a bound is infinite and could not be saved. The sigmoid of the clamped logit is still 0 or 1.
        self.raw = nn.Parameter(torch.full((size,), share, dtype=torch.float32).logit().clamp(-_BOUND, _BOUND))

    def forward(self) -> Tensor:
        """Return the bounded values, shape ``(size,)``."""
        value = self._lower + (self._upper - self._lower) * torch.sigmoid(self.raw)
        return value.exp() if self._logarithmic else value
