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

__all__ = ["AtPose", "Evidence", "Mixture", "Votes", "at_pose", "copies", "evidence", "updated"]

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
# Rows are sorted by a key, the sum of their columns times powers of this number, so that equal rows are adjacent. The
# number is transcendental, so that different rows of integers have different keys. The powers are computed on the
# device, because a CUDA graph cannot contain a copy from the CPU.
_KEY = math.pi / 4


class Votes(NamedTuple):
    """The quantities in the evidence that do not depend on the pose.

    Attributes:
        pairs: the vote of each pair, the inverse of the number of its copies, 0 for padding, (B, N).
        known: whether the caller gave the noise of a problem, bool (B, 1).
        outlier: density of an outlier's pixel, divided by the density of a narrow inlier at the projection, if the
            variance of the inlier is 1 px² and half of the pairs are inliers, (B, 1).
    """

    pairs: Tensor
    known: Tensor
    outlier: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, problem: Problem, known: Tensor) -> Votes:
        """Count the copies of pairs, and spread the outliers over a square with the variance of the usual pixels."""
        there = problem.weights > 0
        cells = torch.cat((problem.img_points / (_PIXEL_CELL * problem.focal), problem.world_points / _POINT_CELL), -1)
        pairs = torch.where(there, copies(cells.round(), there).reciprocal(), 0.0)
        usual = (problem.usual_weights > 0).to(problem.weights)[..., None]
        share = usual / usual.sum(1, keepdim=True).clamp(min=1.0)
        places = problem.places
        variance = (share * (places - (share * places).sum(1, keepdim=True)).square()).sum((1, 2))[:, None]
        area = 6.0 * variance + (LEAST_NOISE * problem.focal).square()
        return cls(pairs, known, 2.0 * math.pi / (1.0 - _TAIL) / area)


class AtPose(NamedTuple):
    """The residuals of a problem at a pose.

    Attributes:
        projection: the points projected at the pose.
        exponent: minus half of the squared residual in variances of its pixel, -∞ in effect behind the camera, (B, N).
        density: the square root of the determinant of the precision, (B, N) or (1, 1).
        outlier: ``Votes.outlier`` with the variance of each pixel, (B, N) or (B, 1).
        precision: inverse variance of each pixel, (B, N) or (1, 1), or inverse covariance.
    """

    projection: Projection
    exponent: Tensor
    density: Tensor
    outlier: Tensor
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
        total: sum of the votes, shape (B, 1).
    """

    variance: Tensor
    share: Tensor
    least: Tensor
    total: Tensor

    def densities(self, exponent: Tensor, outlier: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Relative densities (B, N) of inliers, of inliers each divided by its factor of the variance, and of outliers.

        ``exponent`` and ``outlier`` are those of :class:`AtPose`.
        """
        scaled = exponent / self.variance
        narrow, wide = scaled.exp(), (scaled / _WIDE).exp()
        share = _TAIL / (1.0 - _TAIL) / _WIDE
        inlier, weighted = (torch.add(narrow, wide, alpha=x) for x in (share, share / _WIDE))
        return inlier, weighted, (self.variance / self.share - self.variance) * outlier

    def weights(self, seen: AtPose) -> Tensor:
        """Robust weights (B, N): the derivatives of the negative log-likelihood, at most 1."""
        inlier, weighted, outlier = self.densities(seen.exponent, seen.outlier)
        return weighted / (inlier + outlier)


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
    key = _KEY ** torch.arange(rows.shape[-1], dtype=rows.dtype, device=rows.device)
    order = (rows * key).sum(-1).argsort(1)
    ordered = rows.gather(1, order[..., None].expand_as(rows))
    # `long`, because PyTorch 2.13 cannot compile the maximum of booleans.
    new = (ordered[:, 1:] != ordered[:, :-1]).long().amax(-1)
    run = functional.pad(new.cumsum(1), (1, 0))
    sizes = torch.zeros_like(rows[..., 0]).scatter_add(1, run, there.to(rows).gather(1, order))
    return torch.empty_like(sizes).scatter(1, order, sizes.gather(1, run)).clamp(min=1.0)


@torch.no_grad()
def evidence(seen: AtPose, problem: Problem, votes: Votes) -> Evidence:
    """Compute the evidence for a pose of a problem, whose noise is known for every pair or ``None``."""
    exponent, density, outliers = (x.detach() for x in (seen.exponent, seen.density, seen.outlier))
    there, total = votes.pairs > 0, votes.pairs.sum(-1, keepdim=True).clamp(min=1.0)
    mean = torch.where(there, density.log(), 0.0).sum(-1, keepdim=True) / there.sum(-1, keepdim=True).clamp(min=1)
    radian = problem.focal.square() * mean.exp()
    factors, log_prior = _grid(radian, votes.known)  # (F, B, 1) each
    share = factors.new_full((), 0.5)
    inlier, _, outlier = Mixture(factors, share, factors, total).densities(exponent, outliers)  # (F, B, N)
    chances, more = votes.pairs / total * inlier, inlier - outlier
    for _ in range(_ROUNDS):
        share = share * (chances / torch.addcmul(outlier, share, more)).sum(-1, keepdim=True)
        share = share.clamp(_LEAST_SHARE, 1.0 - _LEAST_SHARE)
    terms = (torch.addcmul(outlier, share, more) / outlier).log()
    fitted = (terms * there).topk(MIN_PAIRS, -1).values.clamp(min=0.0).sum(-1, keepdim=True)
    likelihood = (votes.pairs * terms).sum(-1, keepdim=True) - fitted + log_prior  # (F, B, 1)
    last = total[:, 0].clamp(min=MIN_PAIRS) - 1.0
    samples = last**3 - last  # six times the number of triples
    log_ratio = likelihood.logsumexp(0)[:, 0] - (_POSES / 6.0 * samples).log()
    best = likelihood.argmax(0, keepdim=True)
    variance, share = (x.gather(0, best)[0] for x in (factors, share))
    # The smallest angle of the grid stands for all smaller angles.
    least = torch.where(best[0] > 0, _STEP**-0.5 * variance, torch.finfo(share.dtype).eps ** 2 * variance)
    mixture = Mixture(variance, share, least, total)
    for _ in range(_FINAL_ROUNDS):
        mixture = updated(mixture, seen, votes)
    inlier, _, outlier = mixture.densities(exponent, outliers)
    inlier = inlier / (inlier + outlier) * there
    chances = votes.pairs * inlier
    freedom = (0.5 * seen.unknowns - chances.sum(-1)).clamp(max=-0.5)
    sigma = ((chances * exponent).sum(-1) / freedom / radian[:, 0]).sqrt()
    return Evidence(log_ratio, likelihood[..., 0].mT, mixture, inlier, radian, sigma)


def at_pose(state: State, problem: Problem, votes: Votes) -> AtPose:
    """Project the points at a pose, and standardise the residuals. Without noise, the variance of a pixel is 1 px²."""
    projection = project(state, problem)
    sq_residual, precision = information(projection, problem)
    exponent = torch.where(projection.in_front, -0.5 * sq_residual, -(torch.finfo(sq_residual.dtype).max ** 0.5))
    density = precision if isinstance(precision, Tensor) else precision.determinant.sqrt()
    return AtPose(projection, exponent, density, votes.outlier / density, precision)


@torch.no_grad()
def updated(mixture: Mixture, seen: AtPose, votes: Votes, frozen: Tensor | None = None) -> Mixture:
    """One round of expectation and maximisation.

    The variance of problems ``frozen``, bool (B, 1), does not change; ``None``: of those with noise from the caller.
    """
    exponent = seen.exponent.detach()
    inlier, weighted, outlier = mixture.densities(exponent, seen.outlier.detach())
    chances = votes.pairs / (inlier + outlier)
    inliers = (chances * inlier).sum(-1, keepdim=True)
    squares = (chances * weighted * exponent).sum(-1, keepdim=True)  # times -1/2
    variance = (squares / (0.5 * seen.unknowns - inliers).clamp(max=-0.5)).maximum(mixture.least)
    return mixture._replace(
        variance=torch.where(votes.known if frozen is None else frozen, mixture.variance, variance),
        share=(inliers / mixture.total).clamp(_LEAST_SHARE, 1.0 - _LEAST_SHARE),
    )


def _grid(radian: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Factors of the variances and their prior log-probabilities, (F, B, 1) each."""
    number = torch.arange(_SCALES, dtype=radian.dtype, device=radian.device)[:, None, None]
    factors = torch.where(known, 1.0, _LEAST_ANGLE**2 * radian) * _STEP**number
    return factors, torch.where(known, _UNEXPECTED * number, -math.log(_SCALES))
