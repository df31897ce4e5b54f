r"""Radial distortion with pose and focal length, by robust least squares from a pose that was found without it."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.geometry import (
    NormalEquations,
    Projection,
    RadialTerms,
    dolly_zoom,
    move,
    normal_equations,
    project,
)
from kornia_pnpnet.refine.step import solve_damped
from kornia_pnpnet.types import MIN_PAIRS, Correspondences, Pose

__all__ = ["Radial", "estimate_radial"]

# Focal lengths. Pairs with a smaller residual count in the first steps, before distortion is known: 0.2 times the cube
# of a tangent of 0.7 is 0.07.
_WIDE = 0.07
# From step to step this limit shrinks by this factor, down to the scale of the residuals.
_SHRINK = 0.6
# Number of steps.
_STEPS = 14
# Scale of Cauchy's kernel in standard deviations, and the median of squared residuals in variances of a coordinate.
_KERNEL_SCALE, _MEDIAN = 3.4, 2.0 * math.log(2.0)
# Focal lengths. The scale of the residuals is at least this.
_LEAST = 1e-5
# Standard deviation of a coefficient before any pair is looked at; it keeps those that no pair determines near 0.
_PRIOR = 0.5
# Largest step of a coefficient.
_LARGEST = 0.3
_DAMPING = 1e-6


class Radial(NamedTuple):
    r"""Pose, focal length and distortion.

    Attributes:
        pose: the pose.
        zoom: logarithm of the focal length over that of the correspondences, :math:`(B,)`.
        coefficients: :math:`k_1` and, where asked for, :math:`k_2`, :math:`(B, K)`.
    """

    pose: Pose
    zoom: Tensor
    coefficients: Tensor


@torch.no_grad()
def estimate_radial(corr: Correspondences, pose: Pose, terms: int) -> Radial:
    r"""Estimate radial distortion with the pose and the focal length.

    The pixel of a point is :math:`f (1 + k_1 \rho^2 + k_2 \rho^4) (p, q)` with :math:`\rho^2 = p^2 + q^2`, the model of
    Kornia and OpenCV. Gauss-Newton steps weigh the pairs by Cauchy's kernel; its scale first is that of what distortion
    does at the edge of an image, and shrinks to the median residual.

    Args:
        corr: normalised correspondences, their focal length an estimate of the true one.
        pose: the pose found without distortion.
        terms: number of coefficients, 1 or 2.

    Returns:
        The estimate, a constant.
    """
    coefficients = torch.zeros_like(corr.weights[:, :terms])
    zoom = torch.zeros_like(corr.weights[:, 0])
    there = corr.weights > 0
    limit = _WIDE
    for _ in range(_STEPS):
        pairs = corr.zoomed(zoom)
        seen, inner = _distorted(project(pose, pairs), pairs, coefficients)
        sq_residual = torch.where(seen.in_front & there, seen.sq_residual, torch.inf)
        scale = _scale(sq_residual, pairs.focal, limit)
        weights = torch.where(seen.in_front & there, corr.weights / (1.0 + sq_residual / scale.square()), 0.0)
        equations = normal_equations(seen, weights, free_focal=True, radial=inner)
        rows, slopes = [list(x) for x in equations.hessian], list(equations.gradient)
        # The prior of the coefficients, in the unit of the equations: residuals of one scale.
        unit = (scale[:, 0] / pairs.focal_of_problem).square() / _PRIOR**2
        for k in range(terms):
            rows[7 + k][7 + k] = rows[7 + k][7 + k] + unit
            slopes[7 + k] = slopes[7 + k] + unit * pairs.focal_of_problem * coefficients[:, k]
        delta, solved = solve_damped(NormalEquations(rows, slopes), torch.full_like(zoom, _DAMPING))
        factor = -solved.to(zoom) / pairs.focal_of_problem
        delta = [(factor * x).clamp(-1.0, 1.0) for x in delta]
        pose, zoom = dolly_zoom(move(pose, delta[:6]), delta[6]), zoom + delta[6]
        coefficients = coefficients + torch.stack(delta[7:], -1).clamp(-_LARGEST, _LARGEST)
        limit *= _SHRINK
    return Radial(pose, zoom, coefficients)


def _scale(sq_residual: Tensor, focal: Tensor, limit: float) -> Tensor:
    """Scale of the kernel in pixels, (B, 1): the limit, or what the residuals around it show where this is more."""
    wide = limit * focal
    ascending = torch.where(sq_residual <= (_KERNEL_SCALE * wide).square(), sq_residual, torch.inf).sort(1).values
    count = ascending.isfinite().sum(1, keepdim=True)
    middle = ((count + MIN_PAIRS + 1) // 2).minimum(count - 1).clamp(min=0)
    sigma = (ascending.gather(1, middle) / _MEDIAN).sqrt().nan_to_num(posinf=0.0)
    return (_KERNEL_SCALE * sigma).maximum(wide).maximum(_LEAST * focal)


def _distorted(projection: Projection, corr: Correspondences, coefficients: Tensor) -> tuple[Projection, RadialTerms]:
    """The projection with distorted pixels, and what their Jacobian needs."""
    p, q = projection.plane_points
    square = torch.addcmul(p * p, q, q)
    stretch, slope = torch.ones_like(square), torch.zeros_like(square)
    for k, coefficient in enumerate(coefficients[..., None].unbind(1)):
        stretch = stretch + coefficient * square ** (k + 1)
        slope = slope + 2.0 * (k + 1) * coefficient * square**k
    u, v = corr.img_points.unbind(-1)
    residual = corr.focal * stretch * p - u, corr.focal * stretch * q - v
    depth = torch.where(projection.in_front, projection.inv_depth, 1.0).reciprocal()
    scaled = residual[0] * depth, residual[1] * depth
    terms = RadialTerms(stretch, slope, depth, coefficients.shape[1])
    return projection._replace(residual=residual, scaled_residual=scaled), terms
