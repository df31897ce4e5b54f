r"""Which pairs are inliers of a pose, and how many of them chance would give it.

A pair is an inlier of a pose when :math:`\|r\|^2 < \tau^2 + (f \omega / z)^2`, with the threshold :math:`\tau` in
pixels and the pixels by which a shift of the world point by the threshold :math:`\omega` moves its projection at the
depth :math:`z`. The ratio of the two sides is the *standardised* squared residual.
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
from kornia_pnpnet.geometry import Projection
from kornia_pnpnet.types import MIN_PAIRS, Problem

__all__ = [
    "MAX_ERROR",
    "MAX_FALSE_ALARMS",
    "Judged",
    "Thresholds",
    "chance_of_inlier",
    "chance_of_others",
    "fitted_pairs",
    "judge",
    "log_false_alarms",
]

#: Largest standardised squared residual; points behind the camera have it.
MAX_ERROR = 1e6
#: A pose is evident when fewer poses than this are expected to have as many inliers by chance.
MAX_FALSE_ALARMS = 0.01
# Pairs. This many stand for all pairs in :func:`chance_of_others`.
_MOST_OTHERS = 64
# Pixels of other pairs near a projection. This many are left out of the count: pixels of right pairs may be close, too.
_FEW_HITS = 4
# Radii of the disc of the worst inlier. Nearer outliers say nothing about chance: they are pairs that are slightly off,
# or inliers where the caller's sigmas are too small. Tuned on synthetic problems (`pnpnet-set`, seed 9101) with sigmas
# that are half of the noise: ten radii refuse many more right poses, thirty accept more wrong ones.
_REACH = 20.0


def fitted_pairs(corr: Problem) -> int:
    """Pairs that nearly any pose fits: three, or four where the focal length is unknown."""
    return MIN_PAIRS if corr.free_focal is None else MIN_PAIRS + 1


class Thresholds(NamedTuple):
    r"""The thresholds of an inlier in each problem.

    Attributes:
        img: :math:`\tau` in pixels of the normalised camera, shape :math:`(B,)` or :math:`(B, N)`.
        world: :math:`\omega` in units of the normalised world, shape :math:`(B,)` or :math:`(B, N)`.
        precision: the matrix by which the squared length of a residual is 1 at the threshold, entries :math:`(B, N)`;
            ``None``: that of :math:`\tau` and :math:`\omega`. A disc of the same area stands for its ellipse where
            the chance of an inlier is estimated.
    """

    img: Tensor
    world: Tensor
    precision: Symmetric2 | None = None


class Judged(NamedTuple):
    r"""Inliers and residuals of one pose per problem.

    Attributes:
        weights: :math:`\tau^2 / (\tau^2 + (f \omega / z)^2)` for inliers, which is 1 without a threshold in the world,
            and 0 for all others, shape :math:`(B, N)`.
        errors: standardised squared residuals, below 1 for inliers, :data:`MAX_ERROR` behind the camera, shape
            :math:`(B, N)`.
    """

    weights: Tensor
    errors: Tensor


def judge(projection: Projection, corr: Problem, thresholds: Thresholds) -> Judged:
    """Tell which pairs are inliers of a pose, and how precise the inliers are.

    Args:
        projection: :func:`~kornia_pnpnet.geometry.project` of a pose for each problem.
        corr: normalised correspondences. Pairs without weight are no inliers.
        thresholds: what counts as an inlier.

    Returns:
        Weights and errors of the pairs.

    Example:
        >>> from kornia_pnpnet.geometry import project
        >>> from kornia_pnpnet.types import Pose
        >>> points = torch.tensor([[[0.0, 0.0, 4.0], [1.0, 0.0, 4.0]]])
        >>> corr = Problem(points, torch.zeros(1, 2, 2), torch.ones(1, 2), torch.tensor(100.0))
        >>> projection = project(Pose(torch.eye(3)[None], torch.zeros(1, 3)), corr)
        >>> judge(projection, corr, Thresholds(torch.tensor([10.0]), torch.tensor([0.0])))
        Judged(weights=tensor([[1., 0.]]), errors=tensor([[0.0000, 6.2500]]))
    """
    sq_img, sq_limit = _of_pairs(thresholds.img).square(), _sq_limits(projection, corr, thresholds)
    errors = projection.sq_residual / sq_limit
    if thresholds.precision is not None:
        errors = thresholds.precision.form(*projection.residual)
    errors = torch.where(projection.in_front, errors, MAX_ERROR)
    inlier = (errors < 1.0) & (corr.weights > 0)
    return Judged(torch.where(inlier, sq_img / sq_limit, 0.0), errors)


def chance_of_inlier(corr: Problem, thresholds: Thresholds, judged: Judged) -> Tensor:
    r"""Probability that an outlier fits by chance, as well as the worst inlier does.

    The larger of two estimates is returned: one from the image, one from the outliers.

    *The image.* The pixel of an outlier is uniform in the smallest axis-parallel box around the pixels. It fits when it
    falls into the disc around a projection whose radius is the worst inlier's share of its threshold. The chance is the
    smaller of two shares: that of the disc's area in the box's, and that of the disc's diameter in the shorter side.
    The mean over the inliers counts.

    *The outliers.* A pose that is wrong but brings all points near their pixels has more inliers than independent
    pixels would give it. Points behind the camera, for example, have such poses. The outliers then lie close to their
    projections. The chance is the share of the pairs (without the three that give the pose) that are outliers within a
    larger disc, times the ratio of the areas of both discs. The larger disc is at least twenty times as wide and holds
    at least two outliers; the one with the largest chance counts.

    Args:
        corr: normalised correspondences.
        thresholds: what counts as an inlier.
        judged: what :func:`judge` returned.

    Returns:
        At most 1, shape :math:`(B,)`.

    Example:
        >>> pixels = torch.tensor([[[0.0, 0.0], [400.0, 0.0], [0.0, 200.0]]])
        >>> corr = Problem(torch.zeros(1, 3, 3), pixels, torch.ones(1, 3), torch.tensor(100.0))
        >>> judged = Judged(torch.ones(1, 3), torch.tensor([[0.0, 0.1, 0.25]]))  # the worst is 5 px off
        >>> chance_of_inlier(corr, Thresholds(torch.tensor([10.0]), torch.tensor([0.0])), judged) * 400 * 200
        tensor([78.5398])
    """
    there, inlier = corr.weights[..., None] > 0, judged.weights > 0
    high = torch.where(there, corr.places, -torch.inf).amax(1)
    low = torch.where(there, corr.places, torch.inf).amin(1)
    eps = torch.finfo(high.dtype).eps  # a perfect fit of pixels that all coincide is no evidence
    sides = (high - low).clamp(min=eps)  # (B, 2), of the rays in a rig (B, 3)
    if corr.rig is not None:
        sides = sides.sort(-1).values[:, 1:]
    sides = sides[:, None]
    worst = torch.where(inlier, judged.errors, 0.0).amax(-1, keepdim=True).clamp(min=eps)
    sq_radius = worst * _of_pairs(thresholds.img).square() / torch.where(inlier, judged.weights, 1.0)
    strips = 2.0 * sq_radius.sqrt()[..., None] / sides  # (B, N, 2)
    chance = (0.25 * math.pi * strips.prod(-1)).minimum(strips.amin(-1)).clamp(max=1.0)
    anywhere = torch.where(inlier, chance, 0.0).sum(-1) / inlier.sum(-1).clamp(min=1)
    outlier = (corr.weights > 0) & ~inlier
    sq_distance = in_order(torch.where(outlier, judged.errors, torch.inf).mT[None])[0, 1:].mT  # from the second on
    within = torch.arange(2, corr.weights.shape[1] + 1, device=outlier.device)
    others = ((corr.weights > 0).sum(-1, keepdim=True) - MIN_PAIRS).clamp(min=1)
    by_outliers = within / others * worst / sq_distance.maximum(_REACH**2 * worst)
    return anywhere.maximum(by_outliers.amax(-1)).clamp(max=1.0)


def chance_of_others(projection: Projection, corr: Problem, thresholds: Thresholds, judged: Judged) -> Tensor:
    """Share of other pairs' pixels that are as near to a point's projection as the worst inlier's pixel to its own.

    Pixels are not uniform: many outliers may have the same pixel, and a pose from which all points are seen in a small
    part of the image finds many pixels there.

    Args:
        projection: :func:`~kornia_pnpnet.geometry.project` of the pose.
        corr: normalised correspondences.
        thresholds: what counts as an inlier.
        judged: what :func:`judge` returned.

    Returns:
        At most 1, shape :math:`(B,)`. Of more than 64 pairs, evenly spaced ones stand for all.
    """
    there = corr.weights > 0
    worst = torch.where(judged.weights > 0, judged.errors, 0.0).amax(-1, keepdim=True)
    limit = torch.where(projection.in_front & there, worst * _sq_limits(projection, corr, thresholds), -1.0)
    pixels = torch.where(there[..., None], corr.places, torch.inf)
    seen = torch.stack(projection.plane_points, -1)
    seen = corr.focal[..., None] * seen if corr.rig is None else corr.rays(seen)
    values = torch.cat((seen, pixels, limit[..., None]), -1)
    counts = there.sum(-1)
    if not exporting() and values.shape[1] > _MOST_OTHERS:  # evenly spaced among those that are no padding
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


def log_false_alarms(
    tested: Tensor, inliers: Tensor, counts: Tensor, chance: Tensor, fitted: int = MIN_PAIRS
) -> Tensor:
    r"""Natural logarithm of the number of poses that are expected to have as many inliers by chance.

    Three pairs give a pose, which leaves :math:`\binom{c - 3}{k - 3}` ways to choose the other inliers. Each of them is
    an inlier by chance with the probability :math:`p`, and every tested pose is another chance. So the expected number
    of such poses is at most :math:`T \binom{c-3}{k-3} p^{k-3}`.

    Source: L. Moisan and B. Stival, "A probabilistic criterion to detect rigid point matches between two images and
    estimate the fundamental matrix", IJCV 57(3), 2004; P. Moulon, P. Monasse and R. Marlet, "Adaptive structure from
    motion with a contrario model estimation", ACCV 2012. These count the poses that could be tested; here the poses
    that were tested count.

    Args:
        tested: number of poses :math:`T` that were tested, shape :math:`(B,)`.
        inliers: number of inliers :math:`k` of the best pose, shape :math:`(B,)`.
        counts: number of pairs :math:`c`, shape :math:`(B,)`.
        chance: probability :math:`p` that a pixel from anywhere is an inlier, shape :math:`(B,)`.
        fitted: number of pairs that give a pose, in place of 3.

    Returns:
        float64 of shape :math:`(B,)`; with fewer than three inliers the logarithm of the number of tested poses.

    Example:
        >>> chance = torch.tensor([1e-4, 1e-4, 1e-4], dtype=torch.float64)
        >>> log_false_alarms(torch.tensor(100), torch.tensor([3, 4, 6]), torch.tensor([9, 9, 9]), chance)
        tensor([  4.6052,  -2.8134, -20.0301], dtype=torch.float64)
    """
    extra = (inliers - fitted).clamp(min=0).double()
    free = torch.maximum((counts - fitted).clamp(min=0).double(), extra)
    ways = _log_factorial(free) - _log_factorial(extra) - _log_factorial(free - extra)
    tiny = torch.finfo(torch.float64).tiny
    return tested.clamp(min=1).double().log() + ways + extra * chance.double().clamp(min=tiny).log()


def _sq_limits(projection: Projection, corr: Problem, thresholds: Thresholds) -> Tensor:
    """Largest squared residual of an inlier in square pixels, (B, N)."""
    if thresholds.precision is not None:
        return thresholds.precision.determinant.rsqrt()
    img, world = _of_pairs(thresholds.img), _of_pairs(thresholds.world)
    return img.square() + (corr.focal * world * projection.inv_depth).square()


def _of_pairs(threshold: Tensor) -> Tensor:
    """Thresholds of problems as thresholds of their pairs."""
    return threshold[:, None] if threshold.ndim == 1 else threshold


def _log_factorial(x: Tensor) -> Tensor:
    r"""Logarithm of :math:`x!` for integers :math:`x \ge 0`, in float64."""
    if not exporting():
        return torch.lgamma(x + 1)
    # ONNX has no log-gamma. Stirling's series of Γ(x + 9), which is Γ(x + 1) times eight factors: 12 digits.
    y = x + 9.0
    inv, sq = y.reciprocal(), y.reciprocal().square()
    series = inv * (1 / 12 - sq * (1 / 360 - sq * (1 / 1260 - sq / 1680)))
    factors = reduce(mul, [x + i for i in range(1, 9)])
    return (y - 0.5) * y.log() - y + 0.5 * math.log(2.0 * math.pi) + series - torch.as_tensor(factors).log()
