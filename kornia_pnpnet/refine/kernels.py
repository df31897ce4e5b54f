r"""Robust kernels, which weight a pair by its squared residual, and hyperparameters that are learned within bounds.

A kernel has a loss :math:`\rho(s)` of the squared residual :math:`s`. The weight :math:`w(s)` is the derivative of the
loss. Residuals are in standard deviations if the noise is known or estimated, else in pixels of the normalised camera.
The *shape* of a kernel is a scale in the unit of the residual. Only for ``power``, the shape is the exponent
:math:`\alpha` of the weight :math:`w = 1/\|r\|^\alpha` of PnP-Net. To add a kernel, extend :data:`KERNELS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor, nn

from kornia_pnpnet.core.checks import check_numbers, check_whole

__all__ = ["KERNELS", "POWER_FLOOR", "BoundedParameter", "RobustKernel"]

#: ``power`` adds the square of this number (in pixels or sigmas) to squared residuals, so that no weight is infinite.
POWER_FLOOR = 0.1
# Largest absolute value of a raw parameter. The sigmoid of 1000 rounds to 1 in float64.
_BOUND = 1e3


class RobustKernel(NamedTuple):
    """A robust loss of the squared residual, the derivative of the loss, and the range of the shape.

    Attributes:
        loss: ``loss(sq_residual, shape)``, which is 0 for a residual of 0 and never decreases.
        weight: ``weight(sq_residual, shape)``, the derivative of ``loss`` with respect to ``sq_residual``. A weight
            that falls exponentially needs a lower bound, or gradients become NaN.
        default: the shape that is used when none is given. Default scales are meant for residuals in pixels.
        lower: the smallest shape that may be learned.
        upper: the largest shape that may be learned.
        logarithmic: whether the shape is a scale and is therefore learned in log space.
    """

    loss: Callable[[Tensor, Tensor], Tensor]
    weight: Callable[[Tensor, Tensor], Tensor]
    default: float
    lower: float = 0.1
    upper: float = 1e4
    logarithmic: bool = True


def _power_loss(sq_residual: Tensor, alpha: Tensor) -> Tensor:
    # The loss is the integral of the weight (s + c)^(-alpha/2) from 0 to s, where c is `floor`. With e = 1 - alpha/2
    # and L = log(1 + s/c), the integral is c^e L (exp(x) - 1) / x at x = e L. Close to x = 0, a series replaces the
    # fraction, so that the loss is smooth at alpha = 2.
    floor = POWER_FLOOR**2
    exponent = 1.0 - 0.5 * alpha
    log_ratio = torch.log1p(sq_residual / floor)
    x = exponent * log_ratio
    small = x.abs() < 1e-2
    safe = torch.where(small, 1.0, x)
    series = 1.0 + x * (1.0 / 2 + x * (1.0 / 6 + x * (1.0 / 24 + x * (1.0 / 120 + x / 720))))
    relative = torch.where(small, torch.where(small, series, 1.0), torch.expm1(safe) / safe)
    return floor**exponent * log_ratio * relative


def _huber_loss(sq_residual: Tensor, scale: Tensor) -> Tensor:
    square = scale * scale
    return sq_residual.minimum(square) + 2.0 * scale * (sq_residual.maximum(square).sqrt() - scale)


#: The kernels by name. ``power`` is the kernel of PnP-Net. The other kernels are common M-estimators (Z. Zhang,
#: "Parameter estimation techniques", Image and Vision Computing 15(1), 1997, table 1). ``truncated`` is the truncated
#: least squares of MSAC.
KERNELS: dict[str, RobustKernel] = {
    "power": RobustKernel(
        loss=_power_loss,
        weight=lambda square, alpha: torch.exp(-0.5 * alpha * torch.log(square + POWER_FLOOR**2)),
        default=1.0,
        lower=0.0,
        upper=3.0,
        logarithmic=False,
    ),
    "huber": RobustKernel(
        loss=_huber_loss,
        weight=lambda square, scale: scale * square.maximum(scale * scale).rsqrt(),
        default=5.0,
    ),
    "cauchy": RobustKernel(
        loss=lambda square, scale: scale * scale * torch.log1p(square / (scale * scale)),
        weight=lambda square, scale: 1.0 / (1.0 + square / (scale * scale)),
        default=10.0,
    ),
    "geman_mcclure": RobustKernel(
        loss=lambda square, scale: square / (1.0 + square / (scale * scale)),
        weight=lambda square, scale: (1.0 + square / (scale * scale)) ** -2,
        default=20.0,
    ),
    "truncated": RobustKernel(
        loss=lambda square, scale: torch.minimum(square, scale * scale),
        # The zero term gives the scale a gradient of 0. Distributed training expects a gradient for every parameter.
        weight=lambda square, scale: (square < scale * scale).to(square.dtype) + 0.0 * scale,
        default=30.0,
    ),
}


class BoundedParameter(nn.Module):
    """Learned values: a sigmoid maps the raw parameter to ``[lower, upper]``, in log space if ``logarithmic``.

    Args:
        initial: initial value of each entry, within the bounds. A value that starts at a bound never changes.
        size: number of entries.
        lower: lower bound.
        upper: upper bound.
        logarithmic: interpolate between the logarithms of the bounds. If true, both bounds must be positive.

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
        KORNIA_CHECK(lower < upper, f"lower must be less than upper, got {lower} and {upper}.")
        KORNIA_CHECK(not logarithmic or lower > 0, f"lower must be positive if logarithmic, got {lower}.")
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
