"""Noise becomes information: squared residuals in standard deviations, and the precision of each pixel."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.problem import LEAST_NOISE, Noise, Problem, Starts
from kornia_pnpnet.refine.residual import Projection, pixel_covariance, pixel_variance

__all__ = ["complete_noise", "information", "is_known", "pixel_precision", "sq_standardised"]


def complete_noise(problem: Problem, starts: Starts) -> Noise | None:
    """Combine the noise from the caller and the noise from the initialiser, so that the noise of every pair is known.

    The result is ``None`` if neither gave noise. The sigmas are from the initialiser. If the initialiser gave no noise,
    the sigmas are from the caller, and unknown sigmas become 0. The covariances are from the caller.
    """
    noise = starts.noise
    if noise is None and problem.noise is not None:
        noise = map_tensors(lambda x: x.nan_to_num(0.0), problem.noise)
    if noise is None:
        return None
    given = noise if problem.noise is None else problem.noise  # an initialiser estimates no covariances
    least = noise.img.maximum(LEAST_NOISE * problem.focal)
    return noise._replace(img=least, img_cov=given.img_cov, world_cov=given.world_cov)


def is_known(problem: Problem) -> Tensor:
    """Find problems for which the caller gave a sigma of any pixel or world point, bool (B, 1)."""
    known = torch.zeros_like(problem.weights[:, :1], dtype=torch.bool)
    for sigma in () if problem.noise is None else problem.noise.sigmas[:2]:
        known = known | sigma.isfinite().any(1, keepdim=True)
    return known


def pixel_precision(projection: Projection, problem: Problem, noise: Noise) -> Tensor | Symmetric2:
    """Inverse variance of each pixel, (B, N), or inverse covariance if the noise has covariances."""
    if not noise.covariances:
        return pixel_variance(projection, noise).reciprocal()
    return pixel_covariance(projection, problem, noise).inverse()


def sq_standardised(projection: Projection, problem: Problem, most: Tensor) -> Tensor:
    """Compute squared residuals with an upper bound, in variances of their pixel or, without noise, in square pixels.

    Args:
        projection: the points of the problem projected at a state.
        problem: the problem. Its noise is known for every pair or for none.
        most: upper bound of a squared residual in square pixels, a scalar or (B, 1). Points behind the camera have this
            residual. With covariances the bound is multiplied by the mean precision of both coordinates.

    Returns:
        Shape :math:`(B, N)`.
    """
    if problem.noise is None or not problem.noise.covariances:
        sq_residual = torch.where(projection.in_front, projection.sq_residual.minimum(most), most)
        return sq_residual if problem.noise is None else sq_residual / pixel_variance(projection, problem.noise)
    precision = pixel_precision(projection, problem, problem.noise)
    assert isinstance(precision, Symmetric2)
    most = 0.5 * most * (precision.uu + precision.vv)
    return torch.where(projection.in_front, precision.form(*projection.residual.mT.unbind()).minimum(most), most)


def information(projection: Projection, problem: Problem) -> tuple[Tensor, Tensor | Symmetric2]:
    """Compute squared residuals in the unit of the robust kernel, and the information of the pixels.

    Args:
        projection: the points of the problem projected at a state.
        problem: the problem, with known noise of every pair or without noise.

    Returns:
        First, squared residuals (B, N), in variances of their pixel or, without noise, in square pixels. Second, the
        inverse variance of each pixel, (B, N) or, without noise, (B, 1). Covariances give inverse covariances instead.
    """
    if problem.noise is None:  # without noise, sigma is one pixel of the caller
        return projection.sq_residual, problem.img_scale.square().reciprocal()[:, None]
    precision = pixel_precision(projection, problem, problem.noise)
    if isinstance(precision, Tensor):
        return projection.sq_residual * precision, precision
    return precision.form(*projection.residual.mT.unbind()), precision
