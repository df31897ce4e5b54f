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
    given = starts.noise if problem.noise is None else problem.noise
    if given is None:
        return None
    noise = map_tensors(lambda x: x.nan_to_num(0.0), given) if starts.noise is None else starts.noise
    least = noise.img.maximum(LEAST_NOISE * problem.focal)
    return noise._replace(img=least, img_cov=given.img_cov, world_cov=given.world_cov)


def is_known(problem: Problem) -> Tensor:
    """Find problems for which the caller gave a sigma of any pixel or world point, bool (B, 1)."""
    if problem.noise is None:
        return torch.zeros_like(problem.weights[:, :1], dtype=torch.bool)
    return torch.stack(problem.noise[:2]).isfinite().any(-1).any(0)[:, None]


def pixel_precision(projection: Projection, problem: Problem, noise: Noise) -> Tensor | Symmetric2:
    """Inverse variance of each pixel, (B, N), or inverse covariance if the noise has covariances."""
    if not noise.covariances:
        return pixel_variance(projection, noise).reciprocal()
    return pixel_covariance(projection, problem, noise).inverse()


def information(projection: Projection, problem: Problem) -> tuple[Tensor, Tensor | Symmetric2]:
    """Compute squared residuals (B, N) in the unit of the robust kernel, and the information of the pixels.

    With noise, which is then known for every pair, squared residuals are in variances of their pixel, and the
    information is the inverse variance of each pixel, (B, N), or its inverse covariance. Without noise, squared
    residuals are in square pixels, and the information is 1, (1, 1).
    """
    if problem.noise is None:
        return projection.sq_residual, problem.weights.new_ones(1, 1)
    precision = pixel_precision(projection, problem, problem.noise)
    if isinstance(precision, Tensor):
        return projection.sq_residual * precision, precision
    return precision.form(*projection.residual.mT.unbind()), precision


def sq_standardised(projection: Projection, problem: Problem, most: Tensor) -> Tensor:
    """Compute the squared residuals (B, N) of :func:`information` with an upper bound.

    ``most`` is the bound in square pixels, a scalar or (B, 1). Multiplication by the mean precision of both coordinates
    converts the bound to variances. Points behind the camera have this residual.
    """
    sq_residual, precision = information(projection, problem)
    most = most * (precision if isinstance(precision, Tensor) else 0.5 * (precision.uu + precision.vv))
    return torch.where(projection.in_front, sq_residual.minimum(most), most)
