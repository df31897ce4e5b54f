r"""Whether a pose is to be believed: whether it explains the pixels, and whether its inliers could be chance.

The functions take the :class:`~kornia_pnpnet.refine.residual.Projection` of one pose per problem, the problem, the
noise of every pair, and weights of the pairs, :math:`(B, N)`. Their answers have no gradient and the shape
:math:`(B,)`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.linalg import solve_symmetric, span_a_plane
from kornia_pnpnet.core.performance import in_order
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.judge.inliers import MAX_FALSE_ALARMS, Judged, Thresholds, judge, log_false_alarms
from kornia_pnpnet.problem import LEAST_NOISE, MIN_PAIRS, Noise, Problem
from kornia_pnpnet.refine.information import pixel_precision
from kornia_pnpnet.refine.residual import Projection, normal_equations

__all__ = [
    "LAWS",
    "LEAST_PROBABILITY",
    "Belief",
    "believe",
    "clipped",
    "explains",
    "has_enough",
    "has_focal",
    "probability",
    "residual_noise",
    "rotation_sigma",
]

#: A pose is believed when its :func:`probability` is at least this. On synthetic problems to which the law was not
#: fitted, 98 % of the poses within the limits pass, and 5 to 7 % of the poses that are far off.
LEAST_PROBABILITY = 0.93
#: The laws of :func:`probability`: the log-odds when both numbers are 0, and the slopes by the logarithms of the false
#: alarms and of the rotation's sigma. The first law is for noise that was given or estimated by a network, the second
#: for :func:`residual_noise`. Fitted by ``python docs/results/make.py measure --only probability``.
LAWS = {"sigmas": (-3.2501, -0.16608, -1.0784), "residuals": (0.89795, -0.27745, 0.070018)}
_ALARMS, _LOG_SIGMA = (-20.0, 10.0), (-12.0, 2.0)
# Standard deviations. A pair with a larger residual is no evidence for a pose.
_EVIDENT = 3.5
# Standard deviation of the logarithm of a focal length beyond which it is open.
_OPEN_FOCAL = 0.15
# A pose explains the pixels when at least this fraction of the pairs (by weight) has small residuals. The fraction is
# just below 0.6, so that a sum of shares that is 0.6 up to rounding suffices.
_EXPLAINED_SHARE = 0.6 - 1e-5
# A residual is small when it is below this fraction of the pixels' spread. Poses with points behind the camera nearly
# always have larger residuals; small objects with noise of a tenth of their size have smaller ones.
_EXPLAINED_RESIDUAL = 0.2


def has_enough(projection: Projection, weights: Tensor) -> Tensor:
    """Tell whether at least three pairs that have a weight are in front of the camera, bool (B,)."""
    return (projection.in_front & (weights > 0)).sum(-1) >= MIN_PAIRS


def explains(projection: Projection, problem: Problem, weights: Tensor) -> Tensor:
    r"""Tell whether a pose explains the pixels, when the noise is unknown.

    A pose explains the pixels when the residual that 60 % of the pairs (by weight) stay below is less than a fifth of
    the distance from their mean that 60 % of the pixels stay below: a pose hardly better than "everything is at one
    point" is no answer. Both sides scale with the image, so that no threshold is in pixels. At least four pairs have to
    agree (of three pairs all three), and their points must span more than a line. The weights are those before
    residuals were looked at.
    """
    weights = weights.detach()
    there = weights > 0
    share = weights / weights.sum(-1, keepdim=True).clamp(min=torch.finfo(weights.dtype).tiny)  # (B, N)
    places = problem.places.detach()
    spread = (places - (share[..., None] * places).sum(1, keepdim=True)).square().sum(-1)
    ascending, order = spread.sort(-1)
    position = (share.gather(-1, order).cumsum(-1) < _EXPLAINED_SHARE).sum(-1, keepdim=True)
    limit = _EXPLAINED_RESIDUAL**2 * ascending.gather(-1, position.clamp(max=ascending.shape[-1] - 1))
    explained = projection.in_front & (projection.sq_residual.detach() <= limit)
    enough = (share * explained).sum(-1) >= _EXPLAINED_SHARE
    # Any three pairs have a pose that explains them: of more pairs, a fourth has to agree.
    agree = explained & there
    enough = enough & (agree.sum(-1) >= there.sum(-1).clamp(MIN_PAIRS, MIN_PAIRS + 1))
    return enough & _span_a_plane(problem.world_points.detach(), agree)


class Belief(NamedTuple):
    """The :func:`probability` of a pose, and whether it is to be believed, bool."""

    probability: Tensor
    ok: Tensor


def believe(projection: Projection, problem: Problem, noise: Noise, law: str = "sigmas") -> Belief:
    """Tell whether a pose is to be believed, when the noise is known for every pair, by one of the :data:`LAWS`.

    The pose must have more inliers than chance would give it, the inliers must span more than a line, and the
    probability must be at least :data:`LEAST_PROBABILITY`.
    """
    projection, problem, noise = map_tensors(torch.Tensor.detach, (projection, problem, noise))
    precision = pixel_precision(projection, problem, noise) if noise.covariances else None
    assert not isinstance(precision, Tensor)
    precision = map_tensors(lambda x: x / _EVIDENT**2, precision)
    thresholds = Thresholds(_EVIDENT * noise.img, _EVIDENT * noise.world, precision)
    judged = judge(projection, problem, thresholds)
    counts = (problem.weights > 0).sum(-1)
    samples = counts * (counts - 1) * (counts - 2) // 6  # any three pairs could have given the pose
    if problem.free_focal is not None:
        samples = samples * (counts - 3).clamp(min=1) // 4
    alarms = log_false_alarms(samples, projection, problem, thresholds, judged)
    chances = probability(alarms, rotation_sigma(projection, problem, noise, judged), law).to(problem.weights)
    span = _span_a_plane(problem.world_points, judged.weights > 0)
    evident = (alarms < math.log(MAX_FALSE_ALARMS)) & (chances >= LEAST_PROBABILITY)
    return Belief(torch.where(span, chances, 0.0), span & evident)


def probability(log_alarms: Tensor, sigma: Tensor, law: str = "sigmas") -> Tensor:
    r"""Probability that a pose is within 10 degrees and 30 % of the distance of the points.

    A logistic law of two numbers: how unlikely the inliers are by chance, and how well they determine the rotation.
    Few inliers in a small part of the space and of the image agree with many poses.

    Args:
        log_alarms: :func:`~kornia_pnpnet.judge.inliers.log_false_alarms`, shape :math:`(B,)`.
        sigma: :func:`rotation_sigma`, shape :math:`(B,)`.
        law: one of :data:`LAWS`.

    Returns:
        In (0, 1), shape :math:`(B,)`.

    Example:
        >>> probability(torch.tensor([-30.0, -30.0, 0.0]), torch.tensor([0.001, 0.3, 0.001]))
        tensor([0.9995, 0.7974, 0.9852])
    """
    alarms, log_sigma = clipped(log_alarms, sigma)
    offset, by_alarms, by_sigma = LAWS[law]
    return torch.sigmoid(offset + by_alarms * alarms + by_sigma * log_sigma)


def clipped(log_alarms: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
    """Logarithms of the false alarms and of sigma, clipped to the ranges in which :data:`LAWS` depend on them."""
    return log_alarms.clamp(*_ALARMS), sigma.log().clamp(*_LOG_SIGMA)


def residual_noise(projection: Projection, problem: Problem, weights: Tensor) -> Noise:
    """The noise of the pixels by the median residual, the same sigma for all pairs of a problem."""
    there = (weights > 0) & projection.in_front
    count = there.sum(-1, keepdim=True)
    ascending = in_order(torch.where(there, projection.sq_residual, torch.inf).detach().mT[None])[0].mT
    middle = ((count + MIN_PAIRS) // 2).minimum(count - 1).clamp(min=0)  # any pose fits three pairs
    variance = ascending.gather(-1, middle) / (2.0 * math.log(2.0))
    focal = projection.focal.detach().reshape(-1, 1)
    sigma = variance.minimum(focal.square()).sqrt().maximum(LEAST_NOISE * focal)
    return Noise(sigma.expand_as(weights), torch.zeros_like(weights))


def rotation_sigma(projection: Projection, problem: Problem, noise: Noise, judged: Judged) -> Tensor:
    """Square root of the trace of the rotation's covariance in radians, by the noise of the inliers, float64 (B,).

    Infinite where the inliers do not determine the rotation.
    """
    inlier = problem.focal.square() * (judged.weights > 0)
    weights = map_tensors(lambda x: inlier * x, pixel_precision(projection, problem, noise))
    matrix = normal_equations(projection, problem, weights).matrix[:6, :6].permute(2, 0, 1).double()
    turn, cross, shift = matrix[:, :3, :3], matrix[:, 3:, :3], matrix[:, 3:, 3:]
    left = turn - cross.mT @ solve_symmetric(shift, cross)  # the shift eliminated
    eye = torch.eye(3, dtype=left.dtype, device=left.device)
    variance = solve_symmetric(left, eye.expand_as(left)).diagonal(dim1=1, dim2=2).sum(-1)
    return torch.where(variance > 0, variance, torch.inf).sqrt()  # NaN, too, is open


def has_focal(projection: Projection, problem: Problem, noise: Noise, weights: Tensor) -> Tensor:
    """Whether the pairs determine an unknown focal length to a standard deviation of 15 %, bool (B,).

    Two standard deviations are then the 30 % of the distance beyond which a pose is far off. ``weights`` are the final
    weights of the pairs.
    """
    projection, problem, noise = map_tensors(torch.Tensor.detach, (projection, problem, noise))
    weights = weights.detach()
    tiny = torch.finfo(weights.dtype).tiny
    share = projection.focal.square().reshape(-1, 1) * (weights / weights.amax(1, keepdim=True).clamp(min=tiny))
    precision = map_tensors(lambda x: share * x, pixel_precision(projection, problem, noise))
    matrix = normal_equations(projection, problem, precision).matrix.permute(2, 0, 1).double()
    camera, cross, pose = matrix[:, 6:7, 6:7], matrix[:, :6, 6:7], matrix[:, :6, :6]
    solved, info = torch.linalg.solve_ex(pose, cross)
    # The information of the focal length when the pose is unknown.
    information = (camera - cross.mT @ solved)[:, 0, 0]
    known = problem.free_focal.information
    information = information if known is None else information + known
    return (info == 0) & (information > _OPEN_FOCAL**-2)


def _span_a_plane(world_points: Tensor, inliers: Tensor) -> Tensor:
    """Whether the points (B, N, 3) of the inliers (B, N) span more than a line: a line leaves the pose open."""
    inlier = inliers.mT.to(world_points.dtype)
    share = inlier.sum(0).clamp(min=1.0).reciprocal()
    points = world_points.permute(2, 1, 0) * inlier
    centred = torch.addcmul(points, (points.sum(1) * share)[:, None], inlier, value=-1)
    return span_a_plane(centred, share, points.abs().amax((0, 1)))
