r"""Find the inliers of a pose, and estimate whether a pose could have as many inliers by chance.

A pair is an inlier if its residual :math:`r` satisfies :math:`\|r\|^2 < \tau^2 + (f \omega / z)^2`. The threshold
:math:`\tau` is in pixels. The threshold :math:`\omega` is a shift of the world point. At the depth :math:`z`, this
shift moves the projection by :math:`f \omega / z` pixels. The left-hand side divided by the right-hand side is the
*standardised* squared residual.
"""

from __future__ import annotations

import math
from functools import reduce
from operator import mul
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.performance import exporting, in_order, present_first
from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.problem import MIN_PAIRS, Problem
from kornia_pnpnet.refine.residual import Projection

__all__ = ["MAX_ERROR", "MAX_FALSE_ALARMS", "Judged", "Thresholds", "judge", "log_false_alarms"]

#: The standardised squared residual of points behind the camera.
MAX_ERROR = 1e6
#: A pose is believed only if its number of false alarms (see :func:`log_false_alarms`) is below this number.
MAX_FALSE_ALARMS = 0.01
# `_chance_by_others` compares at most this number of pairs, which are spaced evenly over all pairs.
_MOST_OTHERS = 64
# `_chance_by_others` ignores this number of hits, because pixels of inliers can coincide.
_FEW_HITS = 4
# Smallest ratio R / r in `_chance_by_place`. If the caller's sigmas are too small, correct matches lie outside of the
# inlier disc, but close to it. Tuned on synthetic problems (`pnpnet-set`, seed 9101) with sigmas that are half of the
# noise. A ratio of 10 rejects many more correct poses than 20. A ratio of 30 accepts more incorrect poses than 20.
_REACH = 20.0


class Thresholds(NamedTuple):
    r"""The inlier thresholds of each problem or pair.

    Attributes:
        img: :math:`\tau` in pixels of the problem, shape :math:`(B, 1)` or :math:`(B, N)`.
        world: :math:`\omega` in units of the problem's world, shape :math:`(B, 1)` or :math:`(B, N)`.
        precision: if given, the standardised squared residual of a pair is :math:`r^\top P r` with this matrix
            :math:`P`. Its entries have the shape :math:`(B, N)`. False alarms are then estimated for a disc that has
            the area of the ellipse :math:`r^\top P r < 1`.
    """

    img: Tensor
    world: Tensor
    precision: Symmetric2 | None = None

    def sq_limits(self, projection: Projection) -> Tensor:
        """Squared radius (px²) of the inlier disc, (B, N). With ``precision``, disc and ellipse have the same area."""
        if self.precision is not None:
            return self.precision.determinant.rsqrt()
        return self.img.square() + ((projection.focal * projection.inv_depth).mT * self.world).square()


class Judged(NamedTuple):
    r"""Inliers and residuals of one pose per problem.

    Attributes:
        weights: :math:`\tau^2 / (\tau^2 + (f \omega / z)^2)` for inliers, 0 for all other pairs, shape :math:`(B, N)`.
            If :math:`\omega` is 0, the weight of an inlier is 1.
        errors: standardised squared residuals, shape :math:`(B, N)`. Inliers have values below 1. Points behind the
            camera have the value :data:`MAX_ERROR`.
    """

    weights: Tensor
    errors: Tensor

    @property
    def inliers(self) -> Tensor:
        """Number of inliers, shape (B,)."""
        return (self.weights > 0).sum(-1)


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
    sq_limit = thresholds.sq_limits(projection)
    if thresholds.precision is None:
        errors = projection.sq_residual / sq_limit
    else:
        errors = thresholds.precision.form(*projection.residual.mT.unbind())
    errors = torch.where(projection.in_front, errors, MAX_ERROR)
    inlier = (errors < 1.0) & (problem.weights > 0)
    return Judged(torch.where(inlier, thresholds.img.square() / sq_limit, 0.0), errors)


def log_false_alarms(
    tested: Tensor, projection: Projection, problem: Problem, thresholds: Thresholds, judged: Judged
) -> Tensor:
    r"""Natural logarithm of the expected number of poses that have as many inliers as this pose by chance.

    Three of the :math:`c` pairs determine a pose. If the pose has :math:`k` inliers, there are
    :math:`\binom{c - 3}{k - 3}` ways to choose the other inliers. A pair is an inlier by chance with the probability
    :math:`p`. Of :math:`T` tested poses, at most :math:`T \binom{c-3}{k-3} p^{k-3}` are therefore expected to have
    :math:`k` inliers by chance. With an unknown focal length, four pairs determine a pose, and 4 replaces 3.

    The probability :math:`p` is the largest of three estimates, see `_chance_by_place` and `_chance_by_others`.

    Source: L. Moisan and B. Stival, "A probabilistic criterion to detect rigid point matches between two images and
    estimate the fundamental matrix", IJCV 57(3), 2004; P. Moulon, P. Monasse and R. Marlet, "Adaptive structure from
    motion with a contrario model estimation", ACCV 2012. The sources count all poses that could be tested. This
    function counts only the poses that were tested.

    Args:
        tested: number of poses :math:`T` that were tested, shape :math:`(B,)`.
        projection: the points projected at the pose.
        problem: the problem, with :math:`c` pairs that have a weight.
        thresholds: the thresholds of an inlier.
        judged: the result of :func:`judge`, with :math:`k` inliers.

    Returns:
        float64 of shape :math:`(B,)`.
    """
    chance = _chance_by_place(problem, thresholds, judged).maximum(
        _chance_by_others(projection, problem, thresholds, judged)
    )
    fitted = MIN_PAIRS if problem.free_focal is None else MIN_PAIRS + 1
    extra = (judged.inliers - fitted).clamp(min=0).double()
    free = torch.maximum(((problem.weights > 0).sum(-1) - fitted).clamp(min=0).double(), extra)
    ways = _log_factorial(free) - _log_factorial(extra) - _log_factorial(free - extra)
    tiny = torch.finfo(torch.float64).tiny
    return tested.clamp(min=1).double().log() + ways + extra * chance.double().clamp(min=tiny).log()


def _chance_by_place(problem: Problem, thresholds: Thresholds, judged: Judged) -> Tensor:
    """Probability that an outlier fits by chance at least as well as the worst inlier, (B,).

    *From the image.* The pixel of an outlier is assumed to be uniform in the bounding box of all pixels. The outlier
    fits if its pixel lies in a disc around the projection of its point. The radius r of the disc is the residual of the
    worst inlier. The chance is the area of the disc divided by the area of the box. If the box is thin, the chance is
    at most the diameter of the disc divided by the longer side. The estimate is the mean chance of the inliers.

    *From the outliers.* An incorrect pose can project all points close to their pixels, for example if the points are
    behind the camera. The outliers then lie close to their projections, and many pairs are inliers by chance. Suppose
    that n >= 2 outliers have pixels within a radius R >= 20 r of their projections. Three of the c pairs determine the
    pose. The chance is then n / (c - 3) * (r / R)^2. The estimate is the largest of these chances over all R.
    """
    there, inlier = problem.weights > 0, judged.weights > 0
    high = torch.where(there[..., None], problem.places, -torch.inf).amax(1)
    low = torch.where(there[..., None], problem.places, torch.inf).amin(1)
    eps = torch.finfo(high.dtype).eps  # if all pixels coincide, a perfect fit is no evidence
    sides = (high - low).clamp(min=eps)  # (B, 2), or (B, 3) for the rays of a rig
    if problem.rig is not None:
        sides = sides.sort(-1).values[:, 1:]
    worst = torch.where(inlier, judged.errors, 0.0).amax(-1, keepdim=True).clamp(min=eps)
    sq_radius = worst * thresholds.img.square() / torch.where(inlier, judged.weights, 1.0)
    strips = 2.0 * sq_radius.sqrt()[..., None] / sides[:, None]  # (B, N, 2)
    chance = (0.25 * math.pi * strips.prod(-1)).minimum(strips.amin(-1)).clamp(max=1.0)
    anywhere = torch.where(inlier, chance, 0.0).sum(-1) / inlier.sum(-1).clamp(min=1)
    outlier = there & ~inlier
    sq_distance = in_order(torch.where(outlier, judged.errors, torch.inf).mT[None])[0, 1:].mT  # n >= 2
    within = torch.arange(2, there.shape[1] + 1, device=outlier.device)
    others = (there.sum(-1, keepdim=True) - MIN_PAIRS).clamp(min=1)
    by_outliers = within / others * worst / sq_distance.maximum(_REACH**2 * worst)
    return anywhere.maximum(by_outliers.amax(-1)).clamp(max=1.0)


def _chance_by_others(projection: Projection, problem: Problem, thresholds: Thresholds, judged: Judged) -> Tensor:
    """Probability (B,) that the pixel of another pair lies in the disc around a projection, see `_chance_by_place`.

    Pixels are not uniform. Many outliers may have the same pixel. A pose that projects all points into a small part of
    the image can therefore have many inliers by chance.
    """
    there = problem.weights > 0
    worst = torch.where(judged.weights > 0, judged.errors, 0.0).amax(-1, keepdim=True)
    limit = torch.where(projection.in_front & there, worst * thresholds.sq_limits(projection), -1.0)
    pixels = torch.where(there[..., None], problem.places, torch.inf)
    seen = projection.plane.permute(2, 1, 0)
    seen = projection.focal.reshape(-1, 1, 1) * seen if problem.rig is None else problem.rays(seen)
    values = torch.cat((seen, pixels, limit[..., None]), -1)
    counts = there.sum(-1)
    if not exporting() and values.shape[1] > _MOST_OTHERS:  # spaced evenly over the pairs of positive weight
        first = torch.arange(_MOST_OTHERS, device=there.device)
        some = present_first(there).gather(1, first.maximum(first * counts[:, None] // _MOST_OTHERS))
        values = values.gather(1, some[..., None].expand(-1, -1, values.shape[-1]))
        counts = counts.clamp(max=_MOST_OTHERS)
    *both, limit = values.unbind(-1)
    size = len(both) // 2
    first, *others = (x[:, :, None] - y[:, None] for x, y in zip(both[:size], both[size:], strict=True))
    sq_distance = first.square_()
    for other in others:
        sq_distance.addcmul_(other, other)
    near = sq_distance <= limit[..., None]
    hits = near.sum((1, 2)) - near.diagonal(dim1=1, dim2=2).sum(-1)
    return (hits - _FEW_HITS).clamp(min=0) / (counts * (counts - 1)).clamp(min=1)


def _log_factorial(x: Tensor) -> Tensor:
    r"""Logarithm of :math:`x!` for integers :math:`x \ge 0`, in float64."""
    if not exporting():
        return torch.lgamma(x + 1)
    # ONNX has no log-gamma. Stirling's series gives Γ(x + 9) to 12 digits. Γ(x + 9) is Γ(x + 1) times eight factors.
    y = x + 9.0
    inv, sq = y.reciprocal(), y.reciprocal().square()
    series = inv * (1 / 12 - sq * (1 / 360 - sq * (1 / 1260 - sq / 1680)))
    large = (y - 0.5) * y.log() - y + 0.5 * math.log(2.0 * math.pi) + series
    return large - reduce(mul, [x + i for i in range(1, 9)]).log()
