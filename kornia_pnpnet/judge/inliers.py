r"""Find the inliers of a pose by thresholds.

A pair is an inlier if its residual :math:`r` satisfies :math:`\|r\|^2 < \tau^2 + (f \omega / z)^2`. The threshold
:math:`\tau` is in pixels. The threshold :math:`\omega` is a shift of the world point, in the unit of the world. The
*standardised* squared residual is the left side of the inequality divided by the right side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.performance import in_order
from kornia_pnpnet.problem import LEAST_NOISE, MIN_PAIRS, Noise, Problem
from kornia_pnpnet.refine.residual import Projection

__all__ = ["MAX_ERROR", "Judged", "Thresholds", "judge", "median_residual", "residual_noise"]

#: The standardised squared residual of points behind the camera.
MAX_ERROR = 1e6


class Thresholds(NamedTuple):
    r"""The thresholds :math:`\tau` and :math:`\omega` of each problem or pair, :math:`(B, 1)` or :math:`(B, N)`."""

    img: Tensor
    world: Tensor


class Judged(NamedTuple):
    r"""Inliers and residuals of one pose per problem.

    Attributes:
        weights: :math:`\tau^2 / (\tau^2 + (f \omega / z)^2)` for inliers, 0 for other pairs, shape :math:`(B, N)`.
        errors: standardised squared residuals, :data:`MAX_ERROR` behind the camera, shape :math:`(B, N)`.
    """

    weights: Tensor
    errors: Tensor


def judge(projection: Projection, problem: Problem, thresholds: Thresholds) -> Judged:
    """Find the inliers of a pose. Pairs of weight 0 are not inliers.

    Example:
        >>> from kornia_pnpnet.problem import State
        >>> from kornia_pnpnet.refine.residual import project
        >>> from kornia_pnpnet.result import Pose
        >>> problem = Problem.of(torch.tensor([[[0.0, 0.0, 4.0], [1.0, 0.0, 4.0]]]), torch.zeros(1, 2, 2), 100.0)
        >>> projection = project(State.of(Pose(torch.eye(3)[None], torch.zeros(1, 3))), problem)
        >>> judge(projection, problem, Thresholds(torch.tensor([[10.0]]), torch.tensor([[0.0]])))
        Judged(weights=tensor([[1., 0.]]), errors=tensor([[0.0000, 6.2500]]))
    """
    sq_limit = thresholds.img.square() + ((projection.focal * projection.inv_depth).mT * thresholds.world).square()
    errors = torch.where(projection.in_front, projection.sq_residual / sq_limit, MAX_ERROR)
    inlier = (errors < 1.0) & (problem.weights > 0)
    return Judged(torch.where(inlier, thresholds.img.square() / sq_limit, 0.0), errors)


def median_residual(sq_residuals: Tensor, there: Tensor, fitted: int = MIN_PAIRS) -> Tensor:
    """Median (B, 1) of the squared residuals (B, N) where ``there`` (B, N) is true; infinite if no entry is true.

    The median ignores the ``fitted`` smallest residuals, because a state can fit ``fitted`` pairs exactly.
    """
    count = there.sum(-1, keepdim=True)
    ascending = in_order(torch.where(there, sq_residuals, torch.inf).mT[None])[0].mT
    return ascending.gather(-1, ((count + fitted) // 2).minimum(count - 1).clamp(min=0))


def residual_noise(projection: Projection, problem: Problem, weights: Tensor) -> Noise:
    """Estimate the noise of the pixels from the median residual. All pairs of a problem get the same sigma."""
    there = (weights > 0) & projection.in_front
    variance = median_residual(projection.sq_residual.detach(), there) / (2.0 * math.log(2.0))
    focal = projection.focal.detach().reshape(-1, 1)
    sigma = variance.minimum(focal.square()).sqrt().maximum(LEAST_NOISE * focal)
    return Noise(sigma.expand_as(weights), torch.zeros_like(weights))
