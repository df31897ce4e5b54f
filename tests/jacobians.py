"""Derivatives of functions of a state, by automatic differentiation and by central differences."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from kornia_pnpnet.problem import State
from kornia_pnpnet.refine.residual import moved


def derivative(function: Callable[[State], Tensor], state: State) -> Tensor:
    """The derivative (B, M, 6 + K) of a function (B, M) of states along ``moved``, checked by central differences."""
    batch, unknown = state.camera.shape
    zero = state.camera.new_zeros(6 + unknown, batch)

    def along(delta: Tensor) -> Tensor:
        return function(moved(state, delta))

    # Problems do not meet, so that the derivative of a sum over them has one problem in each entry.
    jacobian = torch.autograd.functional.jacobian(lambda x: along(x).sum(0), zero).permute(2, 0, 1)
    longest = jacobian.abs().amax((0, 1)).clamp(min=1e-3)
    steps = 1e-4 * along(zero).abs().max().clamp(min=1e-2) / longest  # each changes the values by a share of 1e-4
    every = torch.diag(steps.clamp(max=1e-4))[:, :, None].expand(-1, -1, batch)
    central = torch.stack([along(step) - along(-step) for step in every], -1) / (2.0 * every.sum(0).mT[:, None])
    assert ((jacobian - central) / longest).abs().max() < 1e-5
    return jacobian


def verify_jacobian(
    function: Callable[[State], Tensor], state: State, analytic: Tensor, tolerance: float = 1e-9
) -> None:
    """Check that ``analytic`` (B, M, 6 + K) is the derivative of a function (B, M) of states."""
    expected = derivative(function, state)
    longest = expected.abs().amax((0, 1)).clamp(min=1e-3)
    assert ((analytic - expected) / longest).abs().max() < tolerance
