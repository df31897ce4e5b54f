r"""The evidence for a pose: how much likelier the pairs are with this pose than without a pose.

The residual of an inlier is Gaussian. One inlier in ten has three times the standard deviation of the rest. The
pixel of an outlier is uniformly distributed. Let :math:`w` be the share of inliers, and :math:`s` a factor of all
inlier variances. Let :math:`d_i(s)` be the density of pair :math:`i` as an inlier, divided by its density as an
outlier. The log-likelihood ratio is

.. math:: L(s) = \sum_i v_i \log(w\,d_i(s) + 1 - w)

minus the positive terms of the three points with the largest terms, because any three points fit some pose. The vote
:math:`v_i` is the inverse of the number of pairs with about the same pixel and point. Expectation-maximisation (EM)
estimates :math:`w`. If the noise is unknown, :math:`s` takes the values of a grid. Otherwise :math:`s` is 1, 8, 64,
..., and larger values have lower prior probabilities.

Let :math:`M` be the mean of :math:`\exp L(s)`, weighted by the prior probability of :math:`s`. The *evidence* is
:math:`\log M - \log n - \log k`, where :math:`n` is the number of possible minimal samples, and :math:`k` the largest
number of poses per sample. A pose is *believed* if its :func:`probability` is at least :data:`LEAST_PROBABILITY`.

The results have no gradient.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from kornia_pnpnet.core.linalg import solve_symmetric
from kornia_pnpnet.core.performance import in_cache
from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.problem import LEAST_NOISE, MIN_PAIRS, Problem, State
from kornia_pnpnet.refine.residual import Projection, information, normal_equations, project
from kornia_pnpnet.refine.terms import RADIAL

__all__ = [
    "FAR_TURN",
    "LAW",
    "LAW_RANGE",
    "LEAST_PROBABILITY",
    "AtPose",
    "Evidence",
    "Mixture",
    "Votes",
    "at_pose",
    "evidence",
    "groups",
    "pose_sigma",
    "probability",
    "totals",
    "updated",
    "within_limits",
]

# Smallest standard deviation in the grid for unknown noise, in radians (0.1 px at a focal length of 3000 px).
_LEAST_ANGLE = 1e-4 / 8.0**0.5
# Ratio of neighbouring variances in the grid.
_STEP = 8.0
# Number of variances in the grid. The largest standard deviation is 0.018 rad (14 px at a focal length of 800 px).
_SCALES = 7
# If the caller gave the noise, `s = 8^k` has a prior log-probability of k times this number.
_UNEXPECTED = -3.0
# Numbers of EM rounds: `_ROUNDS` estimate the share of inliers at each fixed `s`, `_FINAL_ROUNDS` also estimate `s`.
_ROUNDS, _FINAL_ROUNDS = 4, 2
# Real residuals have heavy tails: a share `_TAIL` of the inliers (the wide component) has `_WIDE` times the variance of
# the rest. Without this component, success on indoor RGB-D matches falls by 2.5 percentage points.
_TAIL, _WIDE = 0.1, 9.0
# Least share of inliers and of outliers.
_LEAST_SHARE = 3e-3
# Two pairs are copies if their pixels are in one cell of a grid, and their points are in one cell of another grid. The
# unit of `_PIXEL_CELL` is the focal length. `_POINT_CELL` is in the unit of the normalised world.
_PIXEL_CELL, _POINT_CELL = 2e-3, 1e-2
# Largest number of poses per minimal sample.
_POSES = 4
# Each row gets a key: the sum of its entries times powers of this number. Rows with equal keys count as equal. Because
# the number is transcendental, different rows of integers have different keys.
_KEY = math.pi / 4

#: Least :func:`probability` of a believed pose. A Gaussian error is within two sigmas with about this probability.
LEAST_PROBABILITY = 0.955
#: Coefficients of the log-odds in :func:`probability`: the constant, and the factor of the evidence.
#: ``python docs/results/make.py measure --only probability`` fitted these numbers, and fits them again for comparison.
LAW = (0.3166, 0.6848)
#: Range to which the evidence is clipped in :func:`probability`.
LAW_RANGE = (-10.0, 15.0)
#: Largest errors of a correct pose: rotation error in radians, translation error as a share of the points' distance.
FAR_TURN, _FAR_SHIFT = math.radians(10.0), 0.3
# Largest standard deviation, in radians, of plausible noise. The value 0.0125 would reject 4 % of the correct poses of
# indoor RGB-D matches (`rgbd/indoor.npz`, without a ratio test).
_MOST_NOISE = 0.016
# In each round of the fit of a line, points lose weight if their distance from the line exceeds this multiple of the
# standard deviation along the line. The last multiple is small, because an outlier must not turn a long line.
_OFF = 0.05, 2e-3, 1e-4
# A point is off a line if the camera sees it away from the line by more than _CLEARLY standard deviations of a pixel,
# and by more than _LEAST_OFF radians.
_CLEARLY, _LEAST_OFF = 2.0, 2e-4
# The required number of points off the line is the number of inliers minus this number, but at least 1 and at most 3.
_FEW = 4
# Rounds of the robust fit of the line's centre. A point at the centre has 1 / _NEAR times the weight that a point at a
# typical distance has.
_CENTRE_ROUNDS, _NEAR = 3, 0.02


class Votes(NamedTuple):
    """The quantities in the evidence that do not depend on the pose.

    Attributes:
        pairs: votes (B, N). A vote is 1 over the number of copies of the pair (including the pair), or 0 for padding.
        points: for each pair, an index that only pairs with the same world point have in common, (B, N).
        known: whether the caller gave any noise of the problem, bool (B, 1).
        outlier: density of an outlier's pixel, divided by the peak of the inliers' narrow component at a variance of
            1 px², (B, 1). The value is for equal shares of inliers and outliers.
    """

    pairs: Tensor
    points: Tensor
    known: Tensor
    outlier: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, problem: Problem, known: Tensor) -> Votes:
        """Count copies of pairs. Outliers are uniform on a square of the same variance as the usual pairs' pixels."""
        there = problem.weights > 0
        world, weights = problem.world_points, there.to(problem.weights)
        places, inside = problem.places, world if problem.rig is None else torch.cat((world, problem.centres), -1)
        cells = torch.cat((places / (_PIXEL_CELL * problem.focal), inside / _POINT_CELL), -1).round()
        # Points are the same only if they are equal: outliers far away can make all other points share one cell.
        pairs, points = groups(torch.stack((cells, functional.pad(world, (cells.shape[-1] - 3, 0)))))
        pairs = weights / totals(pairs, weights).clamp(min=1.0)
        usual = (problem.usual_weights > 0).to(problem.weights)[..., None]
        share = usual / usual.sum(1, keepdim=True).clamp(min=1.0)
        variance = (share * (places - (share * places).sum(1, keepdim=True)).square()).sum((1, 2))[:, None]
        area = 6.0 * variance + (LEAST_NOISE * problem.focal).square()
        return cls(pairs, points, known, 2.0 * math.pi / (1.0 - _TAIL) / area)


class AtPose(NamedTuple):
    """The residuals of a problem at a pose.

    Attributes:
        projection: the points projected with the pose.
        exponent: -1/2 times the squared residual divided by the pixel's variance, (B, N). The exponent is
            about -∞ behind the camera.
        density: the square root of the determinant of ``precision``, (B, N) or (1, 1).
        outlier: ``Votes.outlier`` divided by ``density``, (B, N) or (B, 1).
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
        variance: factor of the inliers' variances, shape (B, 1). If ``problem.noise`` is ``None``, the unit is px².
        share: share of inliers, shape (B, 1).
        least: lower bound of ``variance``, shape (B, 1). Without the bound, a few pairs could make the variance 0.
        total: sum of the votes, shape (B, 1).
    """

    variance: Tensor
    share: Tensor
    least: Tensor
    total: Tensor

    def densities(self, exponent: Tensor, outlier: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Relative densities (B, N) of inliers, of inliers with the wide component divided by 9, and of outliers."""
        # `exp2` is faster than `exp`. On a CPU (MKL), `exp` takes 50 times as long if the result underflows.
        scaled = exponent / (math.log(2.0) * self.variance)
        narrow, wide = scaled.exp2(), (scaled / _WIDE).exp2()
        share = _TAIL / (1.0 - _TAIL) / _WIDE
        inlier, weighted = (torch.add(narrow, wide, alpha=x) for x in (share, share / _WIDE))
        return inlier, weighted, (self.variance / self.share - self.variance) * outlier

    def weights(self, seen: AtPose) -> Tensor:
        """Robust weights (B, N), at most 1: derivatives of the negative log-likelihood by ``-exponent / variance``."""
        inlier, weighted, outlier = self.densities(seen.exponent, seen.outlier)
        return weighted / (inlier + outlier)


class Evidence(NamedTuple):
    """The evidence for one pose of each problem.

    Attributes:
        log_ratio: the evidence, shape (B,).
        grid: :math:`L(s)` plus the prior log-probability of :math:`s`, for each :math:`s`, shape (B, F).
        mixture: the estimated distribution of the residuals.
        inlier: probability that a pair is an inlier, shape (B, N).
        radian: the :math:`s` at which the geometric mean of the pixels' standard deviations is one radian, (B, 1).
        sigma: the standard deviation of a pixel in radians, estimated from the inliers, shape (B,).
    """

    log_ratio: Tensor
    grid: Tensor
    mixture: Mixture
    inlier: Tensor
    radian: Tensor
    sigma: Tensor

    @property
    def likelihood(self) -> Tensor:
        """The largest entry of ``grid``, (B,), for the comparison of poses of one problem."""
        return self.grid.amax(1)


def groups(rows: Tensor) -> Tensor:
    """For each row of (*, N, C), an index below N that equal rows have in common, (*, N)."""
    powers = _KEY ** torch.arange(rows.shape[-1], dtype=torch.float64, device=rows.device)
    # Contiguous, because the sums of equal rows must be equal to the last bit.
    ordered, order = (rows.contiguous() * powers).sum(-1).sort(-1)
    run = functional.pad((ordered[..., 1:] != ordered[..., :-1]).cumsum(-1), (1, 0))
    return torch.empty_like(order).scatter(-1, order, run)


def totals(group: Tensor, values: Tensor) -> Tensor:
    """For each entry of :func:`groups`, (B, N), sum ``values`` (B, N) over the equal entries."""
    return torch.zeros_like(values).scatter_add(1, group, values).gather(1, group)


@torch.no_grad()
def evidence(seen: AtPose, problem: Problem, votes: Votes) -> Evidence:
    """Compute the evidence for a pose. ``problem.noise`` must be ``None``, or known for every pair."""
    exponent, density, outliers = (x.detach() for x in (seen.exponent, seen.density, seen.outlier))
    there, total = votes.pairs > 0, votes.pairs.sum(-1, keepdim=True).clamp(min=1.0)
    mean = torch.where(there, density.log(), 0.0).sum(-1, keepdim=True) / there.sum(-1, keepdim=True).clamp(min=1)
    radian = problem.focal.square() * mean.exp()
    power = torch.arange(_SCALES, dtype=radian.dtype, device=radian.device)[:, None, None]
    factors = torch.where(votes.known, 1.0, _LEAST_ANGLE**2 * radian) * _STEP**power  # (F, B, 1)
    log_prior = torch.where(votes.known, _UNEXPECTED * power, -math.log(_SCALES))

    def fitted(factors: Tensor) -> tuple[Tensor, Tensor]:
        """Log-likelihoods and shares of inliers at given variances (F, B, 1)."""
        share = factors.new_full((), 0.5)
        inlier, _, outlier = Mixture(factors, share, factors, total).densities(exponent, outliers)  # (F, B, N)
        chances, more = votes.pairs / total * inlier, inlier - outlier
        for _ in range(_ROUNDS):
            share = share * (chances / torch.addcmul(outlier, share, more)).sum(-1, keepdim=True)
            share = share.clamp(_LEAST_SHARE, 1.0 - _LEAST_SHARE)
        terms = votes.pairs * (torch.addcmul(outlier, share, more) / outlier).log()
        # Three points fit any pose. If they were detected repeatedly, all of their pairs do.
        by_point = torch.zeros_like(terms).scatter_add(-1, votes.points.expand_as(terms), terms)
        most = by_point.topk(MIN_PAIRS, -1).values.clamp(min=0.0).sum(-1, keepdim=True)
        return terms.sum(-1, keepdim=True) - most, share

    likelihood, share = in_cache(fitted, (factors,), exponent.numel())
    likelihood = likelihood + log_prior  # (F, B, 1)
    last = total[:, 0].clamp(min=MIN_PAIRS) - 1.0
    samples = last**3 - last  # six times the number of triples
    log_ratio = likelihood.logsumexp(0)[:, 0] - (_POSES / 6.0 * samples).log()
    best = likelihood.argmax(0, keepdim=True)
    variance, share = (x.gather(0, best)[0] for x in (factors, share))
    # At the smallest variance of the grid, the lower bound is about 0, because the noise can be even smaller.
    least = torch.where(best[0] > 0, _STEP**-0.5 * variance, torch.finfo(share.dtype).eps ** 2 * variance)
    mixture = Mixture(variance, share, least, total)
    for _ in range(_FINAL_ROUNDS):
        mixture = updated(mixture, seen, votes, votes.known)
    inlier, _, outlier = mixture.densities(exponent, outliers)
    inlier = inlier / (inlier + outlier) * there
    chances = votes.pairs * inlier
    freedom = (0.5 * seen.unknowns - chances.sum(-1)).clamp(max=-0.5)
    sigma = ((chances * exponent).sum(-1) / freedom / radian[:, 0]).sqrt()
    return Evidence(log_ratio, likelihood[..., 0].mT, mixture, inlier, radian, sigma)


def at_pose(state: State, problem: Problem, votes: Votes) -> AtPose:
    """Project the points with a pose, and standardise the residuals. For noise ``None``, pixels have variance 1 px²."""
    projection = project(state, problem)
    sq_residual, precision = information(projection, problem)
    exponent = torch.where(projection.in_front, -0.5 * sq_residual, -(torch.finfo(sq_residual.dtype).max ** 0.5))
    # With huge noise, the determinant underflows.
    least = torch.finfo(sq_residual.dtype).tiny
    density = precision if isinstance(precision, Tensor) else precision.determinant.clamp(min=least).sqrt()
    return AtPose(projection, exponent, density, votes.outlier / density, precision)


@torch.no_grad()
def updated(mixture: Mixture, seen: AtPose, votes: Votes, frozen: Tensor) -> Mixture:
    """Run one round of EM. Problems that are ``frozen``, bool (B, 1), keep their variance."""
    exponent = seen.exponent.detach()
    inlier, weighted, outlier = mixture.densities(exponent, seen.outlier.detach())
    chances = votes.pairs / (inlier + outlier)
    inliers = (chances * inlier).sum(-1, keepdim=True)
    squares = (chances * weighted * exponent).sum(-1, keepdim=True)  # times -1/2
    variance = (squares / (0.5 * seen.unknowns - inliers).clamp(max=-0.5)).maximum(mixture.least)
    return mixture._replace(
        variance=torch.where(frozen, mixture.variance, variance),
        share=(inliers / mixture.total).clamp(_LEAST_SHARE, 1.0 - _LEAST_SHARE),
    )


@torch.no_grad()
def probability(seen: AtPose, problem: Problem, found: Evidence, votes: Votes, odds: Tensor | None = None) -> Tensor:
    """Probability (B,) of errors of at most 10 degrees (rotation) and 30 % of the points' distance (translation).

    The result has three factors. The first is a logistic function of the evidence. The second is :func:`within_limits`
    of :func:`pose_sigma`. The third is the logistic function of ``odds`` (B,), the log-odds of the pose against other
    poses (``None``: no other poses). The result is 0 if almost all inliers lie on a line, as far as the camera sees.
    Implausible noise, for example of mirrored pixels, also gives 0. If the caller gave noise, noise up to the caller's
    noise is plausible, too.
    """
    scale = votes.pairs * found.inlier / found.mixture.variance
    precision = map_tensors(lambda x: scale * x, seen.precision)
    noise = found.sigma  # the unit is a radian at the focal length of the problem
    if problem.free_focal is not None:
        noise = noise * problem.focal / seen.projection.focal
    plausible = (noise < _MOST_NOISE) | (votes.known & (found.mixture.variance <= 1.0))[:, 0]
    sigma = pose_sigma(seen.projection, problem, precision).detach()
    usable = plausible & _leave_a_line(seen.projection, problem, votes.pairs * (found.inlier > 0.5), noise)
    offset, by_evidence = LAW
    chance = torch.sigmoid(offset + by_evidence * found.log_ratio.clamp(*LAW_RANGE)) * within_limits(sigma)
    chance = chance if odds is None else chance * torch.sigmoid(odds)
    return torch.where(usable, chance, 0.0)


def within_limits(sigma: Tensor) -> Tensor:
    """Probability, in float32, that a Gaussian error with standard deviation ``sigma`` is between -1 and 1."""
    return torch.erf(0.5**0.5 / sigma.float())


def pose_sigma(projection: Projection, problem: Problem, precision: Tensor | Symmetric2) -> Tensor:
    """Standard deviation of the pose in units of the largest errors of a correct pose, float64, (B,).

    The square of the result is the sum of the variances of rotation, translation and an unknown focal length. A change
    of the focal length counts as a change of distance. ``precision`` is the inverse variance (or covariance) of each
    pixel in px^-2, (B, N), 0 for outliers. The result is infinite if the pixels do not determine the pose.
    """
    sq_focal = projection.focal.reshape(-1, 1).square()
    precision = map_tensors(lambda x: sq_focal * x, precision)
    matrix = normal_equations(projection, problem, precision).matrix
    matrix = matrix.permute(2, 0, 1).double()
    variance = torch.zeros_like(matrix[:, 0, 0])
    for k in range(matrix.shape[-1] - 1, 5, -1):  # the camera is eliminated (Schur complement)
        cross, own = matrix[:, k : k + 1, :k], matrix[:, k, k]
        if problem.free_focal is not None and problem.free_focal.information is not None:
            own = own + (problem.free_focal.information if k == 6 else RADIAL**-2)
        if k == 6:
            # The depth of the points grows with the focal length, see `refine.residual.moved`.
            left = own - _form(matrix[:, :6, :6], cross[:, 0])
            variance = torch.where(left > 0, left.reciprocal(), torch.inf) / _FAR_SHIFT**2
        matrix = matrix[:, :k, :k] - cross.mT * cross / own[:, None, None].clamp(min=torch.finfo(own.dtype).tiny)
    above, below = matrix.split(3, 1)
    turn, (cross, shift) = above[..., :3], below.split(3, -1)
    points = projection.rotated + projection.state.pose.translation.mT[:, None]
    if problem.rig is not None:
        points = points - problem.centres.permute(2, 1, 0)
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
    """The product v^T M^-1 v (B,) of symmetric matrices (B, 6, 6) and vectors (B, 6), from 3 x 3 blocks."""
    turn, cross, shift = matrix[:, :3, :3], matrix[:, 3:, :3], matrix[:, 3:, 3:]
    first, last = vector[:, :3, None], vector[:, 3:, None]
    solved = solve_symmetric(shift, torch.cat((cross, last), -1))
    left, right = turn - cross.mT @ solved[..., :3], first - cross.mT @ solved[..., 3:]
    parts = last.mT @ solved[..., 3:] + right.mT @ solve_symmetric(left, right)
    form = parts[:, 0, 0]
    return torch.where(form.isnan(), torch.inf, form)  # ONNX has no `nan_to_num` of float64


def _leave_a_line(projection: Projection, problem: Problem, votes: Tensor, sigma: Tensor) -> Tensor:
    """Whether the camera sees enough points of the inliers away from their best-fitting line, bool (B,).

    Points on a line leave one rotation free. A few outliers can determine this rotation by chance. ``votes`` (B, N) are
    0 for outliers. ``sigma`` (B,) is the standard deviation of a pixel in radians.
    """
    world = projection.rotated  # (3, N, B)
    weights = there = votes.mT.to(world.dtype)  # (N, B)
    number = there.sum(0)
    # If no inlier exists, or if all inliers are one point, the numbers are NaN, and the result is False.
    for _ in range(_CENTRE_ROUNDS):  # far points must not turn the first line
        share = weights / weights.sum(0)
        sq_off = (world - (share * world).sum(1, keepdim=True)).square().sum(0)
        weights = there / torch.add(sq_off, (share * sq_off).sum(0), alpha=_NEAR)
    for off in _OFF:
        share = weights / weights.sum(0)
        centred = world - (share * world).sum(1, keepdim=True)
        matrix = (centred[:, None] * (share * centred)).sum(2)  # (3, 3, B)
        matrix = matrix / matrix.amax((0, 1))
        # The line follows the first eigenvector. This is close to the column of the fourth power that belongs to the
        # longest column of the matrix.
        matrix = (matrix[:, :, None] * matrix).sum(1)
        longest = matrix.diagonal().argmax(1).expand(1, 3, -1)
        direction = (matrix * matrix.gather(0, longest)).sum(1, keepdim=True)
        direction = direction / direction.norm(dim=0)
        along = (direction * centred).sum(0)
        away = torch.addcmul(centred, direction, along, value=-1.0)
        sq_off = away.square().sum(0)
        weights = there / torch.add(sq_off, (share * along.square()).sum(0), alpha=off**2)
    points = world + projection.state.pose.translation.mT[:, None]
    if problem.rig is not None:
        points = points - problem.centres.permute(2, 1, 0)
    sq_turned = torch.linalg.cross(away, points, dim=0).square().sum(0)  # `norm` is slow in this layout
    clear = sq_turned > ((_CLEARLY * sigma).clamp(min=_LEAST_OFF) * points.square().sum(0)).square()
    return (there * clear).sum(0) > (number - _FEW).clamp(1, MIN_PAIRS) - 0.5  # sums of votes are rounded
