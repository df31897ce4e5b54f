r"""One iteration of robust weighted Levenberg-Marquardt as pure functions: residual, weight, solve, move.

Source: R. Sheffer and A. Wiesel, "PnP-Net: A hybrid Perspective-n-Point Network", 2020, section 3; the damping by the
diagonal is D. Marquardt's (1963).
"""

from __future__ import annotations

from functools import reduce
from operator import and_
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.compilation import per_problem
from kornia_pnpnet.core.linalg import factorise, relative, substitute
from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.geometry import (
    NormalEquations,
    Projection,
    RadialTerms,
    additive_tangent_map,
    change_tangent,
    distort,
    dolly_zoom,
    move,
    normal_equations,
    pixel_covariance,
    pixel_variance,
    project,
    retract_additive,
)
from kornia_pnpnet.refine.prior import add_focal_prior, add_prior, add_radial_prior
from kornia_pnpnet.refine.variance import NARROWER, KernelWeight, variance_factor, worth_of_confidence
from kornia_pnpnet.types import Correspondences, Noise, Pose

__all__ = [
    "LMStep",
    "corrected_residuals",
    "iterate",
    "lm_step",
    "pixel_precision",
    "solve_damped",
    "sq_standardised",
    "weighted_equations",
]

# Largest change of the logarithm of the focal length in one iteration, so that its exponential cannot overflow.
_LARGEST_ZOOM = 1.0


class LMStep(NamedTuple):
    r"""What one iteration returns.

    Attributes:
        pose: the pose after the step.
        solved: whether the damped normal equations could be solved (if not, the step is zero), bool, :math:`(B,)`.
        zoom: change of the logarithm of the focal length, :math:`(B,)`; ``None``: the focal length is known.
        radial: coefficients of radial distortion, :math:`(B, K)`; ``None``: none are estimated.
    """

    pose: Pose
    solved: Tensor
    zoom: Tensor | None = None
    radial: Tensor | None = None

    def zoom_after(self, before: Tensor | None) -> Tensor | None:
        """The logarithm of the focal length after the step, from that before; ``None``: the focal length is known."""
        return None if before is None or self.zoom is None else before + self.zoom

    def moved(self, delta: list[Tensor]) -> LMStep:
        """Moved by the entries of a tangent vector: of the pose, the focal length and the coefficients."""
        pose, zoom, radial = move(self.pose, delta[:6]), self.zoom, self.radial
        if zoom is not None:
            pose, zoom = dolly_zoom(pose, delta[6]), zoom + delta[6]
        if radial is not None:
            radial = radial + torch.stack(delta[7:], -1)
        return LMStep(pose, self.solved, zoom, radial)


def iterate(
    pairs: Correspondences,
    pose: Pose,
    step: Tensor,
    damping: Tensor,
    shape: Tensor,
    outlier_area: Tensor | None,
    *,
    kernel_weight: KernelWeight,
    additive: bool = False,
) -> LMStep:
    r"""Run one iteration: project, weigh the pairs by their residuals, solve for the step, move.

    Args:
        pairs: normalised correspondences; their noise is known for every pair or for none.
        pose: pose before the iteration.
        step: :math:`\gamma`, a scalar.
        damping: :math:`\lambda`, a scalar or :math:`(B,)`.
        shape: shape of the kernel, a scalar.
        outlier_area: see :class:`~kornia_pnpnet.refine.stages.LMStart`, :math:`(B, 1)`; ``None``: for no problem.
        kernel_weight: the robust kernel's weight.
        additive: update the rotation vector additively, as in the paper.

    Returns:
        The moved pose and whether the equations could be solved.
    """
    step, damping = (per_problem(x, pairs.weights[:, 0]) for x in (step, damping))
    shape = per_problem(shape, pairs.weights[:, :1])
    projection = project(pose, pairs)
    weights = _weights(projection, pairs, kernel_weight, shape, outlier_area)
    return lm_step(pairs, pose, projection, weights, step, damping, additive=additive)


def weighted_equations(
    pairs: Correspondences, at: LMStep, shape: Tensor, outlier_area: Tensor | None, kernel_weight: KernelWeight
) -> NormalEquations:
    """The normal equations of :func:`iterate` before damping, with ``at.radial`` those of distorted pixels."""
    pairs = pairs.zoomed(at.zoom)
    projection, terms, narrower = project(at.pose, pairs), None, NARROWER
    if at.radial is not None:  # the outliers are known by then, and a wider kernel is more accurate
        (projection, terms), narrower = distort(projection, pairs, at.radial), 1.0
    weights = _weights(projection, pairs, kernel_weight, shape, outlier_area, narrower)
    return _equations(projection, weights, at.pose, pairs, terms, at.radial)


def lm_step(
    corr: Correspondences,
    pose: Pose,
    projection: Projection,
    weights: Tensor | Symmetric2,
    step: Tensor,
    damping: Tensor,
    *,
    additive: bool = False,
) -> LMStep:
    r"""Solve the damped normal equations and move the pose.

    .. math:: \beta \leftarrow \beta - \gamma\,(J^\top W J + \lambda\,\mathrm{diag}(J^\top W J))^{-1} J^\top W r

    with :math:`r` projection minus measurement, so that the step that reduces the residual is the negative one.

    Args:
        corr: normalised correspondences. With a prior of the pose or of the focal length the weights are inverse square
            pixels. An unknown focal length is a seventh parameter, see :func:`~kornia_pnpnet.geometry.dolly_zoom`.
        pose: the pose to improve.
        projection: :func:`~kornia_pnpnet.geometry.project` of ``pose``.
        weights: weight of each pair, :math:`(B, N)`, or 2×2 matrices with entries of that shape. Points behind the
            camera do not count. The step does not depend on a common factor.
        step: :math:`\gamma`, a scalar.
        damping: :math:`\lambda`, a scalar or :math:`(B,)`.
        additive: update the rotation vector additively as in the paper, instead of by the retraction.

    Returns:
        The moved pose and whether the equations could be solved.
    """
    equations = _equations(projection, weights, pose, corr)
    if additive:
        equations = change_tangent(equations, additive_tangent_map(pose))
    delta, solved = solve_damped(equations, damping)
    factor = solved * (-step / corr.focal_of_problem)
    delta, rest = [factor * x for x in delta[:6]], delta[6:]
    moved = retract_additive(pose, torch.stack(delta).mT) if additive else move(pose, delta)
    if not rest:
        return LMStep(moved, solved)
    zoom = (factor * rest[0]).clamp(-_LARGEST_ZOOM, _LARGEST_ZOOM)
    return LMStep(dolly_zoom(moved, zoom), solved, zoom)


def solve_damped(equations: NormalEquations, damping: Tensor) -> tuple[list[Tensor], Tensor]:
    r"""Solve :math:`(H + \lambda\,\mathrm{diag}(H))\,\delta = g` for a batch of positive semi-definite :math:`H`.

    An LDLᵀ factorisation written out entry by entry, so that it compiles, exports and differentiates like the rest.
    The test of the pivots does not depend on units.

    Args:
        equations: :math:`H` and :math:`g` of any size, entry by entry.
        damping: :math:`\lambda \ge 0`, a scalar or :math:`(B,)`.

    Returns:
        The entries of the solution, each :math:`(B,)`, and whether there is a solution, bool :math:`(B,)`. Where a
        pivot vanishes, values and gradients are finite but meaningless.

    Example:
        >>> four, eight = torch.tensor([4.0]), torch.tensor([8.0])
        >>> solve_damped(NormalEquations(((four,), (0 * four, four)), (eight, four)), torch.tensor(1.0))
        ([tensor([1.]), tensor([0.5000])], tensor([True]))
    """
    factor = 1.0 + damping
    rows = [[*row[:-1], row[-1] * factor] for row in equations.hessian]
    diagonal = [row[-1] for row in rows]
    limits = torch.finfo(diagonal[0].dtype)
    smallest, infinite = torch.full_like(damping, limits.tiny), torch.full_like(damping, torch.inf)
    good: list[Tensor] = []

    def inverse(k: int, pivot: Tensor) -> Tensor:
        good.append(torch.add(pivot, diagonal[k], alpha=-10.0 * limits.eps) > smallest)
        return torch.where(good[-1], pivot, infinite).reciprocal()

    lower, scaled = factorise(rows, list(equations.gradient), inverse)
    return substitute(lower, scaled), reduce(and_, good)


def pixel_precision(projection: Projection, noise: Noise, focal: Tensor) -> Tensor | Symmetric2:
    """Weight of a pixel by its noise: the inverse of the variance, or of the covariance where there is any.

    Args:
        projection: :func:`~kornia_pnpnet.geometry.project` of a pose.
        noise: noise of each pair.
        focal: the focal length in pixels, a scalar.

    Returns:
        A number for each pair, :math:`(B, N)`, or a 2×2 matrix with entries of that shape.
    """
    if not noise.covariances:
        return pixel_variance(projection, noise, focal).reciprocal()
    at = projection.rotation, projection.plane_points, projection.inv_depth
    return pixel_covariance(*at, noise, focal).inverse()


def sq_standardised(projection: Projection, corr: Correspondences, most: Tensor | None = None) -> Tensor:
    """Squared residuals in variances of their pixel where the noise is known, else in square pixels.

    Where noise has covariances this is the squared Mahalanobis distance.

    Args:
        projection: :func:`~kornia_pnpnet.geometry.project` of a pose.
        corr: normalised correspondences; their noise is known for every pair or for none.
        most: square pixels, a scalar. Larger squared residuals count as this much, and so does a point behind the
            camera. With covariances this many square pixels have the mean precision of both coordinates.

    Returns:
        Shape :math:`(B, N)`.
    """
    noise, sq_residual = corr.noise, projection.sq_residual
    variance = None if noise is None or noise.covariances else pixel_variance(projection, noise, corr.focal)
    if noise is not None and noise.covariances:
        precision = pixel_precision(projection, noise, corr.focal)
        assert isinstance(precision, Symmetric2)
        sq_residual = precision.form(*projection.residual)
        most = None if most is None else 0.5 * most * (precision.uu + precision.vv)
    if most is not None:
        sq_residual = torch.where(projection.in_front, sq_residual.minimum(most), most)
    return sq_residual if variance is None else sq_residual / variance


def corrected_residuals(
    projection: Projection,
    pairs: Correspondences,
    kernel_weight: KernelWeight,
    shape: Tensor,
    outlier_area: Tensor | None,
) -> tuple[Tensor, Noise | None]:
    """Squared residuals in the variances that they show, and the noise with sigmas no smaller than estimated.

    Args:
        projection: :func:`~kornia_pnpnet.geometry.project` of a pose.
        pairs: normalised correspondences, with the weights that :func:`variance_factor` takes.
        kernel_weight: the robust kernel's weight.
        shape: shape of the kernel, a scalar.
        outlier_area: see :func:`iterate`.

    Returns:
        The residuals, :math:`(B, N)`, and the noise, without gradient of the correction.
    """
    sq_residual, noise = sq_standardised(projection, pairs), pairs.noise
    if outlier_area is None or noise is None:
        return sq_residual, noise
    precision = pixel_variance(projection, noise, pairs.focal).reciprocal()
    if pairs.confidence is not None:
        worth = worth_of_confidence(sq_residual, precision, projection, pairs, outlier_area)
        sq_residual, precision = sq_residual * worth, precision * worth
        noise = map_tensors(lambda sigma: sigma * worth.rsqrt(), noise)
    seen = sq_residual, precision, projection, pairs.weights
    factor = variance_factor(*seen, kernel_weight, shape, outlier_area)
    larger = factor.detach().clamp(min=1.0).sqrt()
    return sq_residual / factor, map_tensors(lambda sigma: larger * sigma, noise)


def _weights(
    projection: Projection,
    pairs: Correspondences,
    kernel_weight: KernelWeight,
    shape: Tensor,
    outlier_area: Tensor | None,
    narrower: float = NARROWER,
) -> Tensor | Symmetric2:
    """Weight of each pair in the normal equations: prior weight, inverse variance or covariance, robust weight."""
    if pairs.noise is None:
        robust = pairs.weights * kernel_weight(projection.sq_residual, shape)
        prior = pairs.prior or pairs.free_focal
        return robust if prior is None else robust / prior.pixel.square()[:, None]
    precision = pixel_precision(projection, pairs.noise, pairs.focal)
    if isinstance(precision, Tensor):
        sq_residual = projection.sq_residual * precision
        if outlier_area is not None:
            if pairs.confidence is not None:
                worth = worth_of_confidence(sq_residual, precision, projection, pairs, outlier_area)
                sq_residual, precision = sq_residual * worth, precision * worth
            seen = sq_residual, precision, projection, pairs.weights
            factor = variance_factor(*seen, kernel_weight, shape, outlier_area, narrower)
            sq_residual = sq_residual / factor
            if pairs.prior or pairs.free_focal:  # a common factor does not matter to the pairs alone
                precision = precision / factor.clamp(min=1.0)
    else:
        sq_residual = precision.form(*projection.residual)
    robust = pairs.weights * kernel_weight(sq_residual, shape)
    return map_tensors(lambda x: x * robust, precision)


def _equations(
    projection: Projection,
    weights: Tensor | Symmetric2,
    pose: Pose,
    corr: Correspondences,
    terms: RadialTerms | None = None,
    radial: Tensor | None = None,
) -> NormalEquations:
    """Normal equations of the pairs and of the priors.

    Weights are relative to the heaviest row of the Jacobian, so that products of tiny weights do not vanish.
    """
    prior, free_focal, focal = corr.prior, corr.free_focal, corr.focal_of_problem
    size = weights if isinstance(weights, Tensor) else weights.uu + weights.vv
    size = size * projection.inv_depth * projection.inv_depth
    weights = map_tensors(lambda x: relative(x, size), weights)
    equations = normal_equations(projection, weights, free_focal=free_focal is not None, radial=terms)
    if prior is None and free_focal is None:
        return equations
    largest = size.detach().amax(1)
    unit = torch.where(largest > 0, largest, 1.0)
    if radial is not None:
        equations = add_radial_prior(equations, radial, unit, focal)
    if free_focal is not None:
        equations = add_focal_prior(equations, free_focal, unit, focal)
    return equations if prior is None else add_prior(equations, prior, pose, unit, focal)
