r"""Radial distortion with pose and focal length: a first estimate, and least squares with the weights of a refinement.

The pixel of a point is :math:`f (1 + k_1 \rho^2 + k_2 \rho^4) (p, q)` with :math:`\rho^2 = p^2 + q^2`, the model of
Kornia and OpenCV.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.geometry import NormalEquations, distort, normal_equations, project, radial_stretch
from kornia_pnpnet.refine.implicit import attach_gradient
from kornia_pnpnet.refine.prior import add_radial_prior
from kornia_pnpnet.refine.stages import LMStart
from kornia_pnpnet.refine.step import LMStep, solve_damped, weighted_equations
from kornia_pnpnet.refine.variance import KernelWeight
from kornia_pnpnet.types import MIN_PAIRS, Correspondences, Pose

__all__ = ["distorted", "estimate_radial", "refine_radial", "rescaled"]

# Focal lengths. Pairs with a smaller residual count in the first steps, before distortion is known: 0.2 times the cube
# of a tangent of 0.7 is 0.07.
_WIDE = 0.07
# From step to step this limit shrinks by this factor, down to the scale of the residuals.
_SHRINK = 0.6
# Number of steps of the first estimate, and of the refinement after it.
_STEPS, _MORE_STEPS = 14, 6
# Scale of Cauchy's kernel in standard deviations, and the median of squared residuals in variances of a coordinate.
_KERNEL_SCALE, _MEDIAN = 3.4, 2.0 * math.log(2.0)
# Focal lengths. The scale of the residuals is at least this.
_LEAST = 1e-5
# Largest step of a coefficient, and of any other parameter.
_LARGEST, _LARGEST_OTHER = 0.3, 1.0
_DAMPING = 1e-6


@torch.no_grad()
def estimate_radial(corr: Correspondences, pose: Pose, terms: int) -> LMStep:
    r"""Estimate radial distortion with the pose and the focal length.

    Gauss-Newton steps weigh the pairs by Cauchy's kernel; its scale first is that of what distortion does at the edge
    of an image, and shrinks to the median residual.

    Args:
        corr: normalised correspondences, their focal length an estimate of the true one.
        pose: the pose found without distortion.
        terms: number of coefficients, 1 or 2.

    Returns:
        The estimate, a constant; its ``zoom`` is the logarithm of the focal length over that of the correspondences.
    """
    zero = torch.zeros_like(corr.weights[:, 0])
    at = LMStep(pose, zero == 0, zero, torch.zeros_like(corr.weights[:, :terms]))
    there = corr.weights > 0
    limit = _WIDE
    for _ in range(_STEPS):
        assert at.radial is not None
        pairs = corr.zoomed(at.zoom)
        seen, inner = distort(project(at.pose, pairs), pairs, at.radial)
        sq_residual = torch.where(seen.in_front & there, seen.sq_residual, torch.inf)
        scale = _scale(sq_residual, pairs.focal, limit)
        weights = torch.where(seen.in_front & there, corr.weights / (1.0 + sq_residual / scale.square()), 0.0)
        equations = normal_equations(seen, weights, free_focal=True, radial=inner)
        unit = (_KERNEL_SCALE / scale[:, 0]).square()
        equations = add_radial_prior(equations, at.radial, unit, pairs.focal_of_problem)
        at = _stepped(at, equations, pairs.focal_of_problem)
        limit *= _SHRINK
    return at


def refine_radial(start: LMStart, end: LMStep, kernel_weight: KernelWeight) -> LMStep:
    """Refine distortion, pose and focal length together, with the weights and the noise of the last iterations.

    Args:
        start: the correspondences of the refinement, their pixels distorted.
        end: where its iterations ended, with coefficients of distortion.
        kernel_weight: the robust kernel's weight.

    Returns:
        The minimum, with the gradient of a minimum, see :func:`~kornia_pnpnet.refine.implicit.attach_gradient`. Where
        it is not finite, the values that were given.
    """
    first = map_tensors(torch.Tensor.detach, end)
    at, shape = first, start.shape[-1]
    with torch.no_grad():
        for _ in range(_MORE_STEPS):
            equations = weighted_equations(start.by_residual, at, shape, start.outlier_area, kernel_weight)
            at = _stepped(at, equations, start.by_residual.zoomed(at.zoom).focal_of_problem)
        assert at.zoom is not None
        assert at.radial is not None
        finite = (at.pose.rotation.sum((1, 2)) + at.pose.translation.sum(1) + at.zoom + at.radial.sum(1)).isfinite()
        at = map_tensors(lambda x, y: torch.where(finite.view(-1, *(1,) * (x.ndim - 1)), x, y), at, first)
    return attach_gradient(start, at, shape, kernel_weight) if torch.is_grad_enabled() else at


def rescaled(coefficients: Tensor, zoom: Tensor) -> Tensor:
    """Coefficients (B, K) of the same distortion for a focal length that is larger by the exponential of ``zoom``."""
    powers = torch.arange(2, 2 * coefficients.shape[1] + 2, 2, dtype=zoom.dtype, device=zoom.device)
    return coefficients * (powers * zoom[:, None]).exp()


def distorted(corr: Correspondences, coefficients: Tensor) -> Correspondences:
    """Correspondences whose pixels, and their noise, are those before distortion (B, K) was taken away."""
    p, q = (corr.img_points / corr.focal).unbind(-1)
    stretch, slope = radial_stretch(p, q, coefficients)
    noise = corr.noise
    if noise is not None:
        with torch.no_grad():
            along = stretch + slope * torch.addcmul(p * p, q, q)
            growth = (0.5 * (stretch**-2 + along**-2)).sqrt()  # of a standard deviation, see `cameras.undistort`
            turned = stretch + slope * p * p, slope * p * q, stretch + slope * q * q, slope * p * q
        cov = None if noise.img_cov is None else noise.img_cov.mapped(*turned)
        noise = noise._replace(img=noise.img / growth, img_cov=cov)
    return corr._replace(img_points=stretch[..., None] * corr.img_points, noise=noise)


def _stepped(at: LMStep, equations: NormalEquations, focal: Tensor) -> LMStep:
    """After a step of bounded length."""
    delta, solved = solve_damped(equations, torch.full_like(equations.gradient[0], _DAMPING))
    factor = -solved.to(delta[0]) / focal
    limits = [_LARGEST_OTHER] * 7 + [_LARGEST] * (len(delta) - 7)
    delta = [(factor * x).clamp(-limit, limit) for x, limit in zip(delta, limits, strict=True)]
    return at.moved(delta)


def _scale(sq_residual: Tensor, focal: Tensor, limit: float) -> Tensor:
    """Scale of the kernel in pixels, (B, 1): the limit, or what the residuals around it show where this is more."""
    wide = limit * focal
    ascending = torch.where(sq_residual <= (_KERNEL_SCALE * wide).square(), sq_residual, torch.inf).sort(1).values
    count = ascending.isfinite().sum(1, keepdim=True)
    middle = ((count + MIN_PAIRS + 1) // 2).minimum(count - 1).clamp(min=0)
    sigma = (ascending.gather(1, middle) / _MEDIAN).sqrt().nan_to_num(posinf=0.0)
    return (_KERNEL_SCALE * sigma).maximum(wide).maximum(_LEAST * focal)
