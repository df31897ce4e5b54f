r"""The gradient of a minimum, by the implicit function theorem."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from kornia_pnpnet.geometry import NormalEquations, dolly_zoom, move
from kornia_pnpnet.refine.stages import LMStart
from kornia_pnpnet.refine.step import LMStep, solve_damped, weighted_equations
from kornia_pnpnet.refine.variance import KernelWeight
from kornia_pnpnet.types import Pose

__all__ = ["attach_gradient"]


def attach_gradient(start: LMStart, end: LMStep, shape: Tensor, kernel_weight: KernelWeight) -> LMStep:
    r"""Give a converged pose and focal length the gradient of a minimum, by the implicit function theorem.

    With :math:`g(\delta) = J^\top W r` at the pose moved by :math:`\delta`, which is 0 at the minimum,
    :math:`d\delta = -(\partial g / \partial \delta)^{-1} dg`: one Newton step whose value is left out. Where the
    matrix is not positive definite the pose is no minimum yet, and the Gauss-Newton matrix replaces it. A second
    step with the same matrix makes second derivatives exact. Covariances turn with the pose, so that the matrix is
    not quite symmetric: a third step takes most of the difference away.

    Args:
        start: the correspondences of the refinement.
        end: where its iterations ended, without gradient.
        shape: shape of the kernel, a scalar.
        kernel_weight: the robust kernel's weight.

    Returns:
        The same values, with a gradient.
    """
    equations = partial(weighted_equations, outlier_area=start.outlier_area, kernel_weight=kernel_weight)
    pairs = start.by_residual
    pose, zoom = end.pose, end.zoom
    zero = [torch.zeros_like(start.prior[:, 0]).requires_grad_() for _ in range(6 if zoom is None else 7)]
    with torch.enable_grad():
        at, seen = _moved(pose, zoom, zero)
        around, gradient = equations(pairs.map(torch.Tensor.detach).zoomed(seen), at, shape.detach())
        hessian = [
            torch.autograd.grad(entry.sum(), zero[: i + 1], retain_graph=True) for i, entry in enumerate(gradient)
        ]
    around, none = [[x.detach() for x in row] for row in around], torch.zeros_like(shape)
    for _ in range(3 if pairs.noise is not None and pairs.noise.covariances else 2):
        gradient = equations(pairs.zoomed(zoom), pose, shape).gradient
        newton, convex = solve_damped(NormalEquations(hessian, gradient), none)
        gauss_newton, solved = solve_damped(NormalEquations(around, gradient), none)
        both = zip(newton, gauss_newton, strict=True)
        steps = [torch.where(convex, x, torch.where(solved, y, 0.0)) for x, y in both]
        pose, zoom = _moved(pose, zoom, [step.detach() - step for step in steps])
    return LMStep(pose, end.solved, zoom)


def _moved(pose: Pose, zoom: Tensor | None, delta: list[Tensor]) -> tuple[Pose, Tensor | None]:
    """Pose and focal length moved by the entries of a tangent vector."""
    pose = move(pose, delta[:6])
    return (pose, None) if zoom is None else (dolly_zoom(pose, delta[6]), zoom + delta[6])
