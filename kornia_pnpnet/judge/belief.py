"""Decide whether a pose is to be believed.

If the noise is unknown, a pose must explain the pixels (:func:`explains`). If the noise is known, a pose must have more
inliers than expected by chance (:func:`believe`).

Each problem has one pose, given by its :class:`~kornia_pnpnet.refine.residual.Projection`. Weights and noise of the
pairs have the shape :math:`(B, N)`. The results have no gradient.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.linalg import solve_positive, solve_symmetric, span_a_plane
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
    "median_residual",
    "probability",
    "residual_noise",
    "rotation_sigma",
]

#: A pose is believed when its :func:`probability` is at least this value. On held-out synthetic problems, 98 % of the
#: correct poses and 5 to 7 % of the incorrect poses reach this value.
LEAST_PROBABILITY = 0.93
#: Coefficients of the log-odds in :func:`probability`: the constant, the factor of ``log_alarms``, and the factor of
#: the logarithm of ``sigma``. The law ``sigmas`` is for noise that the caller gave or a network estimated. The law
#: ``residuals`` is for noise from :func:`residual_noise`. Both laws were fitted by
#: ``python docs/results/make.py measure --only probability``.
LAWS = {"sigmas": (-3.2501, -0.16608, -1.0784), "residuals": (0.89795, -0.27745, 0.070018)}
_ALARMS, _LOG_SIGMA = (-20.0, 10.0), (-12.0, 2.0)
# A pair is an outlier of a pose if its residual exceeds this number of standard deviations.
_EVIDENT = 3.5
# The pairs determine the focal length if the standard deviation of log f is below this number.
_OPEN_FOCAL = 0.15
# A pose explains the pixels when the pairs with small residuals have at least this fraction of the total weight. The
# fraction is 0.6 minus a tolerance for rounding.
_EXPLAINED_SHARE = 0.6 - 1e-5
# A residual is small if it is below this fraction of the spread of the pixels. Poses with points behind the camera
# nearly always have larger residuals. Correct poses have small residuals even if the noise is a tenth of the spread.
_EXPLAINED_RESIDUAL = 0.2


def has_enough(projection: Projection, weights: Tensor) -> Tensor:
    """Tell whether at least three pairs that have a weight are in front of the camera, bool (B,)."""
    return (projection.in_front & (weights > 0)).sum(-1) >= MIN_PAIRS


def explains(projection: Projection, problem: Problem, weights: Tensor) -> Tensor:
    """Tell whether a pose explains the pixels, for problems of unknown noise.

    The spread of the pixels is the 60 % quantile of their distances from their mean. A residual is small if it is at
    most a fifth of the spread. Pairs with small residuals must have 60 % of the total weight. The ``weights`` do not
    include the weights of a robust kernel. A pose fails if it fits hardly better than a pose that projects all points
    to one pixel. At least four pairs must have small residuals (three pairs if the problem has only three). The points
    of these pairs must span more than a line.
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
    # Some pose explains any three pairs. If the problem has more than three pairs, a fourth pair must agree.
    agree = explained & there
    enough = enough & (agree.sum(-1) >= there.sum(-1).clamp(MIN_PAIRS, MIN_PAIRS + 1))
    return enough & _span_a_plane(problem.world_points.detach(), agree)


class Belief(NamedTuple):
    """The :func:`probability` of a pose, and whether the pose is to be believed (bool)."""

    probability: Tensor
    ok: Tensor


def believe(projection: Projection, problem: Problem, noise: Noise, law: str = "sigmas") -> Belief:
    """Tell whether a pose is to be believed, for problems of known noise.

    The pose must have more inliers than expected by chance (:data:`~kornia_pnpnet.judge.inliers.MAX_FALSE_ALARMS`). The
    points of the inliers must span more than a line. The :func:`probability` must be at least `LEAST_PROBABILITY`.
    """
    projection, problem, noise = map_tensors(torch.Tensor.detach, (projection, problem, noise))
    precision = pixel_precision(projection, problem, noise) if noise.covariances else None
    assert not isinstance(precision, Tensor)
    precision = map_tensors(lambda x: x / _EVIDENT**2, precision)
    thresholds = Thresholds(_EVIDENT * noise.img, _EVIDENT * noise.world, precision)
    judged = judge(projection, problem, thresholds)
    counts = (problem.weights > 0).sum(-1)
    samples = counts * (counts - 1) * (counts - 2) // 6  # any three pairs can be the minimal sample of the pose
    if problem.free_focal is not None:
        samples = samples * (counts - 3).clamp(min=1) // 4
    alarms = log_false_alarms(samples, projection, problem, thresholds, judged)
    chances = probability(alarms, rotation_sigma(projection, problem, noise, judged), law).to(problem.weights)
    span = _span_a_plane(problem.world_points, judged.weights > 0)
    evident = (alarms < math.log(MAX_FALSE_ALARMS)) & (chances >= LEAST_PROBABILITY)
    return Belief(torch.where(span, chances, 0.0), span & evident)


def probability(log_alarms: Tensor, sigma: Tensor, law: str = "sigmas") -> Tensor:
    """Probability that a pose is correct.

    The rotation of a correct pose has an error of at most 10 degrees. The error of its translation is at most 30 % of
    the distance of the points. The probability is a logistic function of the logarithms of two numbers. The number of
    false alarms tells how unlikely the inliers are by chance. Sigma tells how well the inliers determine the rotation.

    Args:
        log_alarms: :func:`~kornia_pnpnet.judge.inliers.log_false_alarms`, shape :math:`(B,)`.
        sigma: :func:`rotation_sigma`, shape :math:`(B,)`.
        law: a key of :data:`LAWS`.

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
    """Clip the two variables of :data:`LAWS`, the logarithms of false alarms and of sigma, to their ranges."""
    return log_alarms.clamp(*_ALARMS), sigma.log().clamp(*_LOG_SIGMA)


def median_residual(sq_residuals: Tensor, there: Tensor, fitted: int = MIN_PAIRS) -> Tensor:
    """Median of the squared residuals (B, N) of the used pairs ``there`` (B, N), infinite without such a pair, (B, 1).

    A state can fit ``fitted`` pairs exactly, so that the median ignores this number of smallest residuals.
    """
    count = there.sum(-1, keepdim=True)
    ascending = in_order(torch.where(there, sq_residuals, torch.inf).mT[None])[0].mT
    return ascending.gather(-1, ((count + fitted) // 2).minimum(count - 1).clamp(min=0))


def residual_noise(projection: Projection, problem: Problem, weights: Tensor) -> Noise:
    """Estimate the noise of the pixels from the median residual. All pairs of a problem have the same sigma."""
    there = (weights > 0) & projection.in_front
    variance = median_residual(projection.sq_residual.detach(), there) / (2.0 * math.log(2.0))
    focal = projection.focal.detach().reshape(-1, 1)
    sigma = variance.minimum(focal.square()).sqrt().maximum(LEAST_NOISE * focal)
    return Noise(sigma.expand_as(weights), torch.zeros_like(weights))


def rotation_sigma(projection: Projection, problem: Problem, noise: Noise, judged: Judged) -> Tensor:
    """Standard deviation of the rotation in radians, from the noise of the inliers, float64 (B,).

    The standard deviation is the square root of the trace of the rotation's covariance. If the inliers do not determine
    the rotation, the standard deviation is infinite.
    """
    inlier = problem.focal.square() * (judged.weights > 0)
    weights = map_tensors(lambda x: inlier * x, pixel_precision(projection, problem, noise))
    matrix = normal_equations(projection, problem, weights).matrix[:6, :6].permute(2, 0, 1).double()
    turn, cross, shift = matrix[:, :3, :3], matrix[:, 3:, :3], matrix[:, 3:, 3:]
    left = turn - cross.mT @ solve_symmetric(shift, cross)  # the translation is eliminated (Schur complement)
    eye = torch.eye(3, dtype=left.dtype, device=left.device)
    variance = solve_symmetric(left, eye.expand_as(left)).diagonal(dim1=1, dim2=2).sum(-1)
    return torch.where(variance > 0, variance, torch.inf).sqrt()  # NaN becomes infinite, too


def has_focal(projection: Projection, problem: Problem, noise: Noise, weights: Tensor) -> Tensor:
    """Tell whether the pairs determine an unknown focal length up to a standard deviation of 15 %, bool (B,).

    Two such standard deviations are 30 %, which is the largest error of a correct translation. ``weights`` are the
    final weights of the pairs.
    """
    projection, problem, noise = map_tensors(torch.Tensor.detach, (projection, problem, noise))
    weights = weights.detach()
    tiny = torch.finfo(weights.dtype).tiny
    share = projection.focal.square().reshape(-1, 1) * (weights / weights.amax(1, keepdim=True).clamp(min=tiny))
    precision = map_tensors(lambda x: share * x, pixel_precision(projection, problem, noise))
    matrix = normal_equations(projection, problem, precision).matrix.double()
    pose, cross = matrix[:6, :6], matrix[:6, 6]
    solution, solved = solve_positive(pose, cross, cross.new_zeros(()))
    # Eliminating the pose gives the information of the focal length (Schur complement).
    information = matrix[6, 6] - (cross * solution).sum(0)
    known = problem.free_focal.information
    information = information if known is None else information + known
    return solved & (information > _OPEN_FOCAL**-2)


def _span_a_plane(world_points: Tensor, inliers: Tensor) -> Tensor:
    """Whether the points (B, N, 3) of the inliers (B, N) span more than a line. A line does not determine the pose."""
    inlier = inliers.mT.to(world_points.dtype)
    share = inlier.sum(0).clamp(min=1.0).reciprocal()
    points = world_points.permute(2, 1, 0) * inlier
    centred = torch.addcmul(points, (points.sum(1) * share)[:, None], inlier, value=-1)
    return span_a_plane(centred, share, points.abs().amax((0, 1)))
