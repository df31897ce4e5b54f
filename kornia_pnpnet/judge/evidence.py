r"""The evidence for a pose: how much likelier the pairs are with this pose than without a pose.

*Model.* The residual of an inlier is Gaussian. One of ten inliers has three times the standard deviation. The pixel of
an outlier is uniformly distributed in a square that has the variance of the pixels. Let :math:`w` be the share of
inliers, and let :math:`s` be a factor of all standard deviations. Let :math:`d_i(s)` be the density of pair :math:`i`
as an inlier, divided by its density as an outlier. The log-likelihood ratio is

.. math:: L(s) = \sum_i v_i \log(w\,d_i(s) + 1 - w)

without its three largest terms, because some pose fits any three pairs. Copies of a pair share one vote :math:`v_i`.
Expectation and maximisation estimate the share :math:`w`. If the noise is unknown, the factors :math:`s` are a grid of
angles, which has the same meaning for all cameras. If the caller gave the noise, the factor is 1 or, with a low prior
probability, larger.

*Evidence.* The evidence is the logarithm of the mean of :math:`\exp L(s)` over the factors, minus the logarithms of the
number of minimal samples and of the number of poses per sample.

The results have no gradient.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.problem import LEAST_NOISE, MIN_PAIRS, Problem, State
from kornia_pnpnet.refine.information import information
from kornia_pnpnet.refine.residual import Projection, project

__all__ = ["AtPose", "Evidence", "Mixture", "at_pose", "copies", "evidence", "outlier_area", "updated", "votes"]

# Unknown noise: the smallest standard deviation of the grid in radians, the ratio of neighbouring variances, and the
# number of variances. The largest standard deviation is 0.018, or 14 pixels at a focal length of 800 pixels.
_LEAST_ANGLE, _STEP, _SCALES = 1e-4, 8.0, 6
# Given noise: the factors of the variance are powers of 8. Prior log-probability of each power.
_UNEXPECTED = -3.0
# Rounds of expectation and maximisation: for the share of inliers at each factor, and for the final factor and share.
_ROUNDS, _FINAL_ROUNDS = 4, 2
# Real residuals have heavy tails. The model therefore has a second kind of inliers: the first number is their share of
# all inliers, and the second number is the factor of their variance. With one kind of inliers, success on indoor RGB-D
# matches falls by 2.5 points.
_TAIL, _WIDE = 0.1, 9.0
# Least share of inliers and of outliers.
_LEAST_SHARE = 3e-3
# Pairs are copies if both pixels and both points are in the same cell of a grid. Size of a cell in focal lengths, and
# in units of the normalised world.
_PIXEL_CELL, _POINT_CELL = 2e-3, 1e-2
# Number of poses of a minimal sample.
_POSES = 4
# Rows are sorted by a key with these coefficients, so that equal rows are adjacent. The ratios of the coefficients are
# irrational, so that different points of a grid have different keys.
_KEY = 1.0, 0.7548776662, 0.5698402910, 0.3247179572, 0.2451223338


class AtPose(NamedTuple):
    """The residuals of a problem at a pose, for :func:`evidence`.

    Attributes:
        projection: the points projected at the pose.
        sq_residual: squared residuals in variances of their pixel, infinite behind the camera, (B, N).
        density: the square root of the determinant of the precision, (B, N).
        precision: inverse variance of each pixel, (B, N), or inverse covariance.
    """

    projection: Projection
    sq_residual: Tensor
    density: Tensor
    precision: Tensor | Symmetric2

    @property
    def unknowns(self) -> int:
        """Number of unknowns of the state."""
        return 6 + self.projection.state.camera.shape[1]


class Mixture(NamedTuple):
    """The distribution of the residuals of a problem.

    Attributes:
        variance: factor of the variances of the inliers, shape (B, 1). If the problem has no noise, the unit is px².
        share: share of inliers, shape (B, 1).
        least: lower bound of ``variance``, shape (B, 1). Few pairs could otherwise be fitted ever more closely.
        area: area of the square in which the pixels of outliers are uniformly distributed, px², shape (B, 1).
    """

    variance: Tensor
    share: Tensor
    least: Tensor
    area: Tensor

    def densities(self, sq_residual: Tensor, density: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Relative densities of narrow inliers, wide inliers and outliers, (B, N); see :func:`at_pose`."""
        scaled = sq_residual / self.variance
        narrow = (1.0 - _TAIL) * (-0.5 * scaled).exp()
        wide = _TAIL / _WIDE * (-0.5 / _WIDE * scaled).exp()
        odds = 2.0 * math.pi * (self.share.reciprocal() - 1.0) * self.variance
        return narrow, wide, odds / (self.area * density)

    def weights(self, seen: AtPose) -> Tensor:
        """Robust weights (B, N): the derivatives of the negative log-likelihood, at most 1."""
        narrow, wide, outlier = self.densities(seen.sq_residual, seen.density)
        return torch.add(narrow, wide, alpha=1.0 / _WIDE) / (narrow + wide + outlier)


class Evidence(NamedTuple):
    """What the pairs say about one pose of each problem.

    Attributes:
        log_ratio: the evidence, shape (B,).
        grid: :math:`L` plus the prior log-probability of each factor, shape (B, F).
        mixture: the estimated distribution of the residuals.
        inlier: probability that a pair is an inlier, shape (B, N).
        radian: factor of the variances at which the usual standard deviation is one radian, shape (B, 1).
        sigma: the standard deviation of a pixel that the inliers show, in radians, shape (B,).
    """

    log_ratio: Tensor
    grid: Tensor
    mixture: Mixture
    inlier: Tensor
    radian: Tensor
    sigma: Tensor

    @property
    def likelihood(self) -> Tensor:
        """The largest entry of ``grid``, which compares poses of one problem, shape (B,)."""
        return self.grid.amax(1)


@torch.no_grad()
def copies(rows: Tensor, there: Tensor) -> Tensor:
    """Number (B, N) of rows that equal each row of (B, N, C), among the rows ``there`` (B, N); at least 1."""
    order = (rows * rows.new_tensor(_KEY[: rows.shape[-1]])).sum(-1).argsort(1)
    ordered = rows.gather(1, order[..., None].expand_as(rows))
    # `long`, because PyTorch 2.13 cannot compile the maximum of booleans.
    new = (ordered[:, 1:] != ordered[:, :-1]).long().amax(-1)
    run = functional.pad(new.cumsum(1), (1, 0))
    sizes = torch.zeros_like(rows[..., 0]).scatter_add(1, run, there.to(rows).gather(1, order))
    return torch.empty_like(sizes).scatter(1, order, sizes.gather(1, run)).clamp(min=1.0)


@torch.no_grad()
def votes(problem: Problem) -> Tensor:
    """The vote of each pair, (B, N): the inverse of the number of copies, 0 for padding."""
    there = problem.weights > 0
    cells = torch.cat((problem.img_points / (_PIXEL_CELL * problem.focal), problem.world_points / _POINT_CELL), -1)
    return torch.where(there, copies(cells.round(), there).reciprocal(), 0.0)


@torch.no_grad()
def outlier_area(problem: Problem) -> Tensor:
    """Area of the square that has the variance of the pixels of usual pairs (see ``Problem.usual``), px², (B, 1)."""
    there = (problem.usual_weights > 0).to(problem.weights)[..., None]
    share = there / there.sum(1, keepdim=True).clamp(min=1.0)
    places = problem.places
    variance = (share * (places - (share * places).sum(1, keepdim=True)).square()).sum((1, 2))[:, None]
    return 6.0 * variance + (LEAST_NOISE * problem.focal).square()


@torch.no_grad()
def evidence(seen: AtPose, problem: Problem, votes: Tensor, known: Tensor) -> Evidence:
    """Compute the evidence for a pose.

    Args:
        seen: the residuals at the pose.
        problem: the problem. Its noise is known for every pair or ``None``.
        votes: the result of :func:`votes`.
        known: whether the caller gave the noise of a problem, bool (B, 1).
    """
    sq_residual, density, focal = (x.detach() for x in (seen.sq_residual, seen.density, problem.focal))
    area, total = outlier_area(problem).detach(), votes.sum(-1, keepdim=True).clamp(min=1.0)
    there = votes > 0
    mean = torch.where(there, density.log(), 0.0).sum(-1, keepdim=True) / there.sum(-1, keepdim=True).clamp(min=1)
    radian = focal.square() * mean.exp()
    factors, log_prior = _grid(radian, known)  # (F, B, 1) each
    half = torch.full_like(factors, 0.5)
    narrow, wide, outlier = Mixture(factors, half, factors, area).densities(sq_residual, density)
    inlier_density = narrow + wide
    odds, inverse, share = inlier_density / outlier, outlier / inlier_density, half
    for _ in range(_ROUNDS):
        inlier = (1.0 + (1.0 / share - 1.0) * inverse).reciprocal()
        share = ((votes * inlier).sum(-1, keepdim=True) / total).clamp(_LEAST_SHARE, 1.0 - _LEAST_SHARE)
    terms = (share * odds + 1.0 - share).log()
    fitted = (terms * there).topk(MIN_PAIRS, -1).values.clamp(min=0.0).sum(-1, keepdim=True)
    likelihood = (votes * terms).sum(-1, keepdim=True) - fitted + log_prior  # (F, B, 1)
    count = total[:, 0].clamp(min=MIN_PAIRS)
    samples = count * (count - 1.0) * (count - 2.0) / 6.0
    log_ratio = likelihood.logsumexp(0)[:, 0] - math.log(_POSES) - samples.log()
    best = likelihood.argmax(0)[None]
    variance, share = (x.gather(0, best)[0] for x in (factors, share))
    # The smallest angle of the grid stands for all smaller angles.
    exact = torch.finfo(share.dtype).eps ** 2
    least = torch.where(best[0] > 0, share.new_full((), _STEP**-0.5), exact) * variance
    mixture = Mixture(variance, share, least, area)
    for _ in range(_FINAL_ROUNDS):
        mixture = updated(mixture, seen, votes, known)
    narrow, wide, outlier = mixture.densities(sq_residual, density)
    inlier = (narrow + wide) / (narrow + wide + outlier) * there
    sq_finite = sq_residual.nan_to_num(posinf=0.0)
    freedom = (2.0 * (votes * inlier).sum(-1) - seen.unknowns).clamp(min=1.0)
    sigma = ((votes * inlier * sq_finite).sum(-1) / freedom / radian[:, 0]).sqrt()
    return Evidence(log_ratio, likelihood[..., 0].mT, mixture, inlier, radian, sigma)


def at_pose(state: State, problem: Problem) -> AtPose:
    """Project the points at a pose, and standardise the residuals. Without noise, the variance of a pixel is 1 px²."""
    projection = project(state, problem)
    sq_residual, precision = information(projection, problem)
    sq_residual = torch.where(projection.in_front, sq_residual, torch.inf)
    if problem.noise is None:
        precision = torch.ones_like(sq_residual)
    density = precision if isinstance(precision, Tensor) else precision.determinant.sqrt()
    return AtPose(projection, sq_residual, density, precision)


@torch.no_grad()
def updated(mixture: Mixture, seen: AtPose, votes: Tensor, known: Tensor) -> Mixture:
    """One round of expectation and maximisation.

    Args:
        mixture: the mixture before the round.
        seen: the residuals.
        votes: votes of the pairs, (B, N).
        known: where true, the variance does not change, bool (B, 1).
    """
    sq_residual, density = seen.sq_residual.detach(), seen.density.detach()
    narrow, wide, outlier = mixture.densities(sq_residual, density)
    inlier, total = narrow + wide, votes.sum(-1, keepdim=True).clamp(min=1.0)
    chances = votes / (inlier + outlier)
    inliers = (chances * inlier).sum(-1, keepdim=True)
    finite = sq_residual.nan_to_num(posinf=0.0)
    weighted = (chances * torch.add(narrow, wide, alpha=1.0 / _WIDE) * finite).sum(-1, keepdim=True)
    variance = (weighted / (2.0 * inliers - seen.unknowns).clamp(min=1.0)).maximum(mixture.least)
    return mixture._replace(
        variance=torch.where(known, mixture.variance, variance),
        share=(inliers / total).clamp(_LEAST_SHARE, 1.0 - _LEAST_SHARE),
    )


def _grid(radian: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Factors of the variances and their prior log-probabilities, (F, B, 1) each."""
    number = torch.arange(_SCALES, dtype=radian.dtype, device=radian.device)[:, None, None]
    factors = torch.where(known, 1.0, _LEAST_ANGLE**2 * radian) * _STEP**number
    return factors, torch.where(known, _UNEXPECTED * number, -math.log(_SCALES))
