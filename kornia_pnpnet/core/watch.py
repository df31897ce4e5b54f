"""A warning for trainings that get no gradient."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from kornia_pnpnet.core.performance import sees_values

__all__ = ["GradientWatch"]

# Calls. The first batches of a training show whether it can learn; later calls cost nothing.
_CALLS = 8


class GradientWatch:
    """Warn once if no problem of the first 8 batches that need a gradient is ``ok``. Reads values in one call only."""

    def __init__(self) -> None:
        self._left = _CALLS
        self._solved: Tensor | None = None

    def see(self, ok: Tensor, *inputs: Tensor | None) -> None:
        """Look at ``ok`` of a batch, bool, any shape, and at whether any of the inputs requires a gradient."""
        if self._left == 0 or not torch.is_grad_enabled() or not any(x is not None and x.requires_grad for x in inputs):
            return
        # A wrapped tensor must not outlive its transform.
        if not ok.numel() or not sees_values(ok) or torch._C._functorch.is_functorch_wrapped_tensor(ok):
            return
        self._left -= 1
        self._solved = ok.any() if self._solved is None else self._solved | ok.any()
        if self._left:
            return
        if not self._solved:
            warnings.warn(
                f"No problem of the first {_CALLS} batches is ok, and only problems that are ok have a gradient: "
                "nothing can be learned from these poses. Start with the loss monte_carlo_pose_loss (how to: Train "
                "your network through the solver).",
                RuntimeWarning,
                stacklevel=3,
            )
        self._solved = None
