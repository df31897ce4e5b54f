r"""The gradient of a minimum, by the implicit function theorem."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from kornia_pnpnet.geometry import NormalEquations
from kornia_pnpnet.refine.stages import LMStart
from kornia_pnpnet.refine.step import LMStep, solve_damped, weighted_equations
from kornia_pnpnet.refine.variance import KernelWeight

__all__ = ["attach_gradient"]


def attach_gradient(start: LMStart, end: LMStep, shape: Tensor, kernel_weight: KernelWeight) -> LMStep:
    r"""Give a converged pose, focal length and distortion the gradient of a minimum, by the implicit function theorem.

    With :math:`g(\delta) = J^\top W r` at the pose moved by :math:`\delta`, which is 0 at the minimum,
    :math:`d\delta = -(\partial g / \partial \delta)^{-1} dg`: one Newton step whose value is left out. Where the
    matrix is not positive definite the pose is no minimum yet, and the Gauss-Newton matrix replaces it. A second
    step with the same matrix makes second derivatives exact. Covariances turn with the pose, so that the matrix is
    not quite symmetric: a third step takes most of the difference away.

    Args:
        start: the correspondences of the refinement; with ``end.radial`` their pixels are distorted.
        end: where its iterations ended, without gradient.
        shape: shape of the kernel, a scalar.
        kernel_weight: the robust kernel's weight.

    Returns:
        The same values, with a gradient.
    """
    equations = partial(weighted_equations, outlier_area=start.outlier_area, kernel_weight=kernel_weight)
    pairs, at = start.by_residual, end
    count = 6 + (0 if end.zoom is None else 1) + (0 if end.radial is None else end.radial.shape[1])
    zero = [torch.zeros_like(start.prior[:, 0]).requires_grad_() for _ in range(count)]
    with torch.enable_grad():
        around, gradient = equations(pairs.map(torch.Tensor.detach), end.moved(zero), shape.detach())
        hessian = [
            torch.autograd.grad(entry.sum(), zero[: i + 1], retain_graph=True) for i, entry in enumerate(gradient)
        ]
    around, none = [[x.detach() for x in row] for row in around], torch.zeros_like(shape)
    focal = pairs.zoomed(end.zoom).focal_of_problem.detach()
    for _ in range(3 if pairs.noise is not None and pairs.noise.covariances else 2):
        gradient = equations(pairs, at, shape).gradient
        newton, convex = solve_damped(NormalEquations(hessian, gradient), none)
        gauss_newton, solved = solve_damped(NormalEquations(around, gradient), none)
        both = zip(newton, gauss_newton, strict=True)
        steps = [torch.where(convex, x, torch.where(solved, y / focal, 0.0)) for x, y in both]
        at = at.moved([step.detach() - step for step in steps])
    return at
