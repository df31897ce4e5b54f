"""Decide whether a pose is to be believed, from the evidence for it and from the accuracy that the inliers allow."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.linalg import solve_symmetric
from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.judge.evidence import AtPose, Evidence
from kornia_pnpnet.problem import MIN_PAIRS, Problem
from kornia_pnpnet.refine.residual import Projection, normal_equations

__all__ = [
    "FAR_TURN",
    "LAW",
    "LEAST_PROBABILITY",
    "Belief",
    "believe",
    "clipped",
    "has_enough",
    "pose_sigma",
    "probability",
]

#: A pose is believed when its :func:`probability` is at least this value.
LEAST_PROBABILITY = 0.9
#: Coefficients of the log-odds in :func:`probability`: the constant, the factor of the evidence, and the factor of the
#: logarithm of ``sigma``. ``python docs/results/make.py measure --only probability`` fitted the law.
LAW = (-1.573, 0.6221, -0.4594)
_EVIDENCE, _LOG_SIGMA = (-10.0, 15.0), (-8.0, 2.0)
#: Largest errors of a correct pose: of the rotation in radians, and of the translation as a share of the distance.
FAR_TURN, _FAR_SHIFT = math.radians(10.0), 0.3
# Largest `pose_sigma` of a pose that is believed. Two standard deviations are the largest error of a correct pose.
_OPEN = 0.5
# Largest standard deviation of plausible noise in radians, or 13 pixels at a focal length of 800 pixels. With 0.0125,
# 4 % of the right poses of indoor RGB-D matches (`rgbd/indoor.npz`, without a ratio test) would not be believed.
_MOST_NOISE = 0.016
# A point lies off a line if its distance from the line exceeds this factor times the spread of the points. The spread
# is the standard deviation of the points along the line.
_OFF = 0.05
# With this number of inliers, one point off the line suffices. Each further inlier requires a further point, up to 3.
_FEW = 5
# Rounds of the robust fit of the line, and squarings of the covariance for its first eigenvector.
_LINE_ROUNDS, _SQUARINGS = 3, 3


def has_enough(projection: Projection, weights: Tensor) -> Tensor:
    """Tell whether at least three pairs that have a weight are in front of the camera, bool (B,)."""
    return (projection.in_front & (weights > 0)).sum(-1) >= MIN_PAIRS


class Belief(NamedTuple):
    """The :func:`probability` of a pose, whether the pose is to be believed (bool), and its :func:`pose_sigma`."""

    probability: Tensor
    ok: Tensor
    sigma: Tensor


@torch.no_grad()
def believe(seen: AtPose, problem: Problem, found: Evidence, known: Tensor) -> Belief:
    """Tell whether a pose is to be believed.

    The :func:`probability` must be at least `LEAST_PROBABILITY`, and :func:`pose_sigma` must be small. The points of
    the inliers must span more than a line. The noise must be plausible, or ``known`` (B, 1) from the caller: pairs of a
    wrong convention, such as mirrored pixels, show much noise at their best pose.
    """
    scale = found.inlier / found.mixture.variance
    precision = map_tensors(lambda x: scale * x, seen.precision)
    sigma = pose_sigma(seen.projection, problem, precision).detach()
    plausible = (found.sigma < _MOST_NOISE) | (known & (found.mixture.variance <= 1.0))[:, 0]
    usable = plausible & (sigma < _OPEN) & _leave_a_line(problem.world_points, found.inlier > 0.5)
    chances = torch.where(usable, probability(found.log_ratio, sigma).to(problem.weights), 0.0)
    return Belief(chances, usable & (chances >= LEAST_PROBABILITY), sigma)


def probability(log_ratio: Tensor, sigma: Tensor) -> Tensor:
    """Probability (B,) that the errors of a pose are at most 10 degrees and 30 % of the distance of the points.

    The probability is a logistic function of the evidence ``log_ratio`` and of the logarithm of :func:`pose_sigma`,
    both (B,).
    """
    evidence, log_sigma = clipped(log_ratio, sigma)
    offset, by_evidence, by_sigma = LAW
    return torch.sigmoid(offset + by_evidence * evidence + by_sigma * log_sigma)


def clipped(log_ratio: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
    """Clip the two variables of :data:`LAW`, the evidence and the logarithm of sigma, to their ranges."""
    return log_ratio.clamp(*_EVIDENCE), sigma.log().clamp(*_LOG_SIGMA).to(log_ratio.dtype)


def pose_sigma(projection: Projection, problem: Problem, precision: Tensor | Symmetric2) -> Tensor:
    """Standard deviation of the pose, in units of the largest errors of a correct pose.

    The variances of the rotation and of the translation are traces of their covariances. An unknown focal length, whose
    error changes the distance, is part of the covariance. ``precision`` is the inverse variance (or covariance) of each
    pixel in px^-2, (B, N), 0 for outliers. The result is float64, (B,), infinite for an undetermined pose.
    """
    precision = map_tensors(lambda x: problem.focal.square() * x, precision)
    matrix = normal_equations(projection, problem, precision).matrix
    matrix = matrix.permute(2, 0, 1).double()
    variance = torch.zeros_like(matrix[:, 0, 0])
    for k in range(matrix.shape[-1] - 1, 5, -1):  # the camera is eliminated (Schur complement)
        cross, own = matrix[:, k : k + 1, :k], matrix[:, k, k]
        if k == 6:
            if problem.free_focal is not None and problem.free_focal.information is not None:
                own = own + problem.free_focal.information
            # The depth of the points grows with the focal length, see `refine.residual.moved`.
            left = own - _form(matrix[:, :6, :6], cross[:, 0])
            variance = torch.where(left > 0, left.reciprocal(), torch.inf) / _FAR_SHIFT**2
        matrix = matrix[:, :k, :k] - cross.mT * cross / own[:, None, None].clamp(min=torch.finfo(own.dtype).tiny)
    above, below = matrix.split(3, 1)
    turn, (cross, shift) = above[..., :3], below.split(3, -1)
    points = projection.rotated + projection.state.pose.translation.mT[:, None]
    distance = points.square().sum(0).sqrt().mT.double()
    share = (precision if isinstance(precision, Tensor) else precision.uu).double()
    total = share.sum(-1).clamp(min=torch.finfo(torch.float32).tiny)
    sq_distance = ((share * distance).sum(-1) / total).square()
    for own, other, mixed, unit in (
        (turn, shift, cross, FAR_TURN**2),
        (shift, turn, cross.mT, _FAR_SHIFT**2 * sq_distance),
    ):
        # The other block is eliminated (Schur complement).
        left = torch.baddbmm(own, mixed.mT, solve_symmetric(other, mixed), alpha=-1)
        eye = torch.eye(3, dtype=left.dtype, device=left.device)
        part = solve_symmetric(left, eye.expand_as(left)).diagonal(dim1=1, dim2=2).sum(-1)
        variance = variance + torch.where(part > 0, part, torch.inf) / unit  # NaN becomes infinite, too
    return torch.where(variance > 0, variance, torch.inf).sqrt()


def _form(matrix: Tensor, vector: Tensor) -> Tensor:
    """The product v^T M^-1 v (B,) of symmetric matrices (B, 6, 6) and vectors (B, 6), by blocks of three."""
    turn, cross, shift = matrix[:, :3, :3], matrix[:, 3:, :3], matrix[:, 3:, 3:]
    first, last = vector[:, :3, None], vector[:, 3:, None]
    solved = solve_symmetric(shift, torch.cat((cross, last), -1))
    left, right = turn - cross.mT @ solved[..., :3], first - cross.mT @ solved[..., 3:]
    parts = last.mT @ solved[..., 3:] + right.mT @ solve_symmetric(left, right)
    form = parts[:, 0, 0]
    return torch.where(form.isnan(), torch.inf, form)  # ONNX has no `nan_to_num` of float64


def _leave_a_line(world_points: Tensor, inliers: Tensor) -> Tensor:
    """Whether enough points (B, N, 3) of the inliers (B, N) lie off a line, bool (B,).

    A line leaves one rotation free, so that a few outliers can determine a pose by chance.
    """
    weights = there = inliers.to(world_points.dtype)[..., None]  # (B, N, 1)
    tiny = torch.finfo(weights.dtype).tiny
    for _ in range(_LINE_ROUNDS):
        share = weights / weights.sum(1, keepdim=True).clamp(min=tiny)
        centred = world_points - torch.bmm(share.mT, world_points)
        matrix = torch.bmm(centred.mT, share * centred)
        matrix = matrix / matrix.norm(dim=(1, 2), keepdim=True).clamp(min=tiny)
        for _ in range(_SQUARINGS):  # the direction of the line is the first eigenvector
            matrix = torch.bmm(matrix, matrix)
        direction = matrix.sum(-1, keepdim=True)
        direction = direction / direction.norm(dim=1, keepdim=True).clamp(min=tiny)
        along = torch.bmm(centred, direction)
        sq_off = torch.baddbmm(centred, along, direction.mT, alpha=-1).square().sum(-1, keepdim=True)
        limit = _OFF**2 * torch.bmm(share.mT, along.square())
        weights = there / (sq_off + limit.clamp(min=tiny**0.5))
    off = (inliers & (sq_off > limit)[..., 0]).sum(-1)
    return off >= (inliers.sum(-1) - _FEW).clamp(1, MIN_PAIRS)
