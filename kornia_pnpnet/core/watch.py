"""A warning for trainings that get no gradient."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from kornia_pnpnet.core.performance import sees_values

# Number of watched batches. The first batches show whether a training can learn; later calls cost nothing.
_CALLS = 8


class GradientWatch:
    """Warn once if the first 8 batches that need a gradient have no ``ok`` problem. Only the 8th call reads values."""

    def __init__(self) -> None:
        self._solved: list[Tensor] = []

    def __reduce__(self) -> tuple[type[GradientWatch], tuple[()]]:
        return type(self), ()  # a copy watches anew, and holds no tensor of a GPU

    def see(self, ok: Tensor, *inputs: Tensor | None) -> None:
        """Record ``ok`` (bool of any shape) of a batch if an input requires a gradient."""
        learns = torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in inputs)
        # A tensor of `torch.func` must not outlive its transform. Values cannot be read while a CUDA graph is captured.
        readable = sees_values(ok) and not torch._C._functorch.is_functorch_wrapped_tensor(ok)
        readable = readable and not (ok.is_cuda and torch.cuda.is_current_stream_capturing())
        if len(self._solved) >= _CALLS or not (learns and readable and ok.numel()):
            return
        self._solved.append(ok.any())
        if len(self._solved) == _CALLS and not any(map(bool, self._solved)):  # the devices may differ
            warnings.warn(
                f"No problem of the first {_CALLS} batches is ok, and only problems that are ok have a gradient: "
                "nothing can be learned from these poses. Start with the loss monte_carlo_pose_loss (how to: Train "
                "your network through the solver).",
                RuntimeWarning,
                stacklevel=3,
            )
