"""Helpers that several tests share: comparisons, the share of problems that are solved, and derivatives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from kornia_pnpnet import Pose, Problems, pose_errors, success
from kornia_pnpnet.problem import State
from kornia_pnpnet.refine.residual import moved


def assert_same(one: Any, two: Any, rtol: float = 0.0, atol: float = 0.0) -> None:
    """The same tensors in two trees, to the bit unless a tolerance is given."""
    for a, b in zip(pytree.tree_leaves(one), pytree.tree_leaves(two), strict=True):
        torch.testing.assert_close(a, b, rtol=rtol, atol=atol)


@contextmanager
def other_defaults(dtype: torch.dtype, device: str = "meta") -> Iterator[None]:
    """Give PyTorch a default dtype and a default device. Tensors of ``meta`` hold no numbers."""
    torch.set_default_dtype(dtype)
    try:
        with torch.device(device):
            yield
    finally:
        torch.set_default_dtype(torch.float32)


def rate(result: Any, problems: Problems, **limits: float) -> float:
    """The share of problems whose pose is right."""
    return success(pose_errors(result.pose, problems.pose), **limits).double().mean().item()


def reprojection_errors(problems: Problems, pose: Pose | None = None) -> Tensor:
    """Pixels of the points under poses, or under the true ones, minus those of the problems, (B, N, 2)."""
    pose = problems.pose if pose is None else pose
    seen = (problems.world_points @ pose.rotation.mT + pose.translation[:, None]) @ problems.intrinsics.mT
    return seen[..., :2] / seen[..., 2:] - problems.img_points


def derivative(function: Callable[[State], Tensor], state: State) -> Tensor:
    """The derivative (B, M, 6 + K) of a function (B, M) of states along ``moved``, by automatic differentiation."""
    zero = state.camera.new_zeros(6 + state.camera.shape[1], len(state.camera))
    # Problems do not meet, so that the derivative of a sum over them has one problem in each entry.
    total = torch.autograd.functional.jacobian(lambda delta: function(moved(state, delta)).sum(0), zero)
    return total.permute(2, 0, 1)


def verified_derivative(function: Callable[[State], Tensor], state: State) -> Tensor:
    """See :func:`derivative`. Central differences must agree with it."""
    jacobian = derivative(function, state)
    longest = jacobian.abs().amax((0, 1)).clamp(min=1e-3)
    # Each step changes the values by about a share of 1e-4, and the state by 1e-4 at most.
    steps = (1e-4 * function(state).abs().max().clamp(min=1e-2) / longest).clamp(max=1e-4)
    every = torch.diag(steps)[:, :, None].expand(-1, -1, len(state.camera))
    central = torch.stack([function(moved(state, x)) - function(moved(state, -x)) for x in every], -1) / (2.0 * steps)
    assert ((jacobian - central) / longest).abs().max() < 1e-5
    return jacobian


def verify_jacobian(function: Callable[[State], Tensor], state: State, analytic: Tensor) -> None:
    """Check that ``analytic`` (B, M, 6 + K) is the derivative of a function (B, M) of states."""
    expected = verified_derivative(function, state)
    longest = expected.abs().amax((0, 1)).clamp(min=1e-3)
    assert ((analytic - expected) / longest).abs().max() < 1e-9
