r"""Which pairs are inliers of a pose, and whether the pose could have them by chance.

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
from kornia_pnpnet.problem import MIN_PAIRS, Problem
from kornia_pnpnet.refine.residual import Projection

__all__ = ["MAX_ERROR", "MAX_FALSE_ALARMS", "Judged", "Thresholds", "judge", "log_false_alarms"]

#: Largest standardised squared residual; points behind the camera have it.
MAX_ERROR = 1e6
#: A pose is evident when fewer poses than this are expected to have as many inliers by chance.
MAX_FALSE_ALARMS = 0.01
# Largest number of pairs, spread evenly over all, that `_chance_by_others` compares.
_MOST_OTHERS = 64
# Hits that are ignored, because pixels of inliers can coincide.
_FEW_HITS = 4
# Ratio of the residual of an outlier to that of the worst inlier. Outliers of smaller ratios say nothing about chance:
# they are near misses, or inliers where the caller's sigmas are too small. Tuned on synthetic problems (`pnpnet-set`,
# seed 9101) with sigmas that are half of the noise: 10 refuses many more poses within the limits, 30 accepts more poses
# that are far off.
_REACH = 20.0


class Thresholds(NamedTuple):
    r"""The thresholds of an inlier in each problem.

    Attributes:
        img: :math:`\tau` in pixels of the problem, shape :math:`(B, 1)` or :math:`(B, N)`.
        world: :math:`\omega` in units of the problem's world, shape :math:`(B, 1)` or :math:`(B, N)`.
        precision: the matrix by which the squared length of a residual is 1 at the threshold, entries :math:`(B, N)`;
            ``None``: the matrix follows from :math:`\tau` and :math:`\omega`. The chance of an inlier is estimated by
            a disc of the same area as its ellipse.
    """

    img: Tensor
    world: Tensor
    precision: Symmetric2 | None = None

    def sq_limits(self, projection: Projection) -> Tensor:
        """Largest squared residual of an inlier in square pixels, (B, N)."""
        if self.precision is not None:
            return self.precision.determinant.rsqrt()
        return self.img.square() + ((projection.focal * projection.inv_depth).mT * self.world).square()


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

    @property
    def inliers(self) -> Tensor:
        """Number of inliers, shape (B,)."""
        return (self.weights > 0).sum(-1)


def judge(projection: Projection, problem: Problem, thresholds: Thresholds) -> Judged:
    """Find the inliers of a pose, and their precision. Pairs without weight are no inliers.

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
    r"""Natural logarithm of the number of poses that are expected to have as many inliers by chance.

    Three pairs give a pose, which leaves :math:`\binom{c - 3}{k - 3}` ways to choose the other inliers. Each of them is
    an inlier by chance with the probability :math:`p`, and every tested pose is another chance. So the expected number
    of such poses is at most :math:`T \binom{c-3}{k-3} p^{k-3}`. With an unknown focal length four pairs give a pose.

    The probability :math:`p` is the largest of three estimates: from the image, from the outliers and from other pairs.

    Source: L. Moisan and B. Stival, "A probabilistic criterion to detect rigid point matches between two images and
    estimate the fundamental matrix", IJCV 57(3), 2004; P. Moulon, P. Monasse and R. Marlet, "Adaptive structure from
    motion with a contrario model estimation", ACCV 2012. These count the poses that could be tested; here the poses
    that were tested count.

    Args:
        tested: number of poses :math:`T` that were tested, shape :math:`(B,)`.
        projection: the points at the pose.
        problem: the problem, :math:`c` pairs that have a weight.
        thresholds: what counts as an inlier.
        judged: what :func:`judge` returned, :math:`k` inliers.

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
    r"""Probability that an outlier fits by chance as well as the worst inlier does, at most 1, (B,).

    *The image.* The pixel of an outlier is uniform in the smallest axis-parallel box around the pixels. The pixel fits
    when it falls into a disc around the projection, whose standardised radius is the residual of the worst inlier. The
    chance is the ratio of the areas of disc and box, or the ratio of the disc's diameter to the shorter side of the box
    if this is smaller; then its mean over the inliers.

    *The outliers.* A pose that is far off but brings all points near their pixels has more inliers than independent
    pixels would give it. Points behind the camera, for example, have such poses. The outliers then lie close to their
    projections. The chance is the share of the pairs (without the three that give the pose) that are outliers within a
    larger disc, times the ratio of the areas of both discs. The larger disc is at least twenty times as wide and holds
    at least two outliers; of all such discs the one with the largest chance is taken.
    """
    there, inlier = problem.weights > 0, judged.weights > 0
    high = torch.where(there[..., None], problem.places, -torch.inf).amax(1)
    low = torch.where(there[..., None], problem.places, torch.inf).amin(1)
    eps = torch.finfo(high.dtype).eps  # a perfect fit of pixels that all coincide is no evidence
    sides = (high - low).clamp(min=eps)  # (B, 2), of the rays in a rig (B, 3)
    if problem.rig is not None:
        sides = sides.sort(-1).values[:, 1:]
    worst = torch.where(inlier, judged.errors, 0.0).amax(-1, keepdim=True).clamp(min=eps)
    sq_radius = worst * thresholds.img.square() / torch.where(inlier, judged.weights, 1.0)
    strips = 2.0 * sq_radius.sqrt()[..., None] / sides[:, None]  # (B, N, 2)
    chance = (0.25 * math.pi * strips.prod(-1)).minimum(strips.amin(-1)).clamp(max=1.0)
    anywhere = torch.where(inlier, chance, 0.0).sum(-1) / inlier.sum(-1).clamp(min=1)
    outlier = there & ~inlier
    sq_distance = in_order(torch.where(outlier, judged.errors, torch.inf).mT[None])[0, 1:].mT  # from the second on
    within = torch.arange(2, there.shape[1] + 1, device=outlier.device)
    others = (there.sum(-1, keepdim=True) - MIN_PAIRS).clamp(min=1)
    by_outliers = within / others * worst / sq_distance.maximum(_REACH**2 * worst)
    return anywhere.maximum(by_outliers.amax(-1)).clamp(max=1.0)


def _chance_by_others(projection: Projection, problem: Problem, thresholds: Thresholds, judged: Judged) -> Tensor:
    """Probability that the pixel of another pair is as close to a projection as the pixel of the worst inlier is, (B,).

    Pixels are not uniform: many outliers may have the same pixel, and a pose that projects all points into a small part
    of the image finds many pixels there.
    """
    there = problem.weights > 0
    worst = torch.where(judged.weights > 0, judged.errors, 0.0).amax(-1, keepdim=True)
    limit = torch.where(projection.in_front & there, worst * thresholds.sq_limits(projection), -1.0)
    pixels = torch.where(there[..., None], problem.places, torch.inf)
    seen = projection.plane.permute(2, 1, 0)
    seen = projection.focal.reshape(-1, 1, 1) * seen if problem.rig is None else problem.rays(seen)
    values = torch.cat((seen, pixels, limit[..., None]), -1)
    counts = there.sum(-1)
    if not exporting() and values.shape[1] > _MOST_OTHERS:  # spread evenly over those that are no padding
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
    # ONNX has no log-gamma. Stirling's series of Γ(x + 9), which is Γ(x + 1) times eight factors: 12 digits.
    y = x + 9.0
    inv, sq = y.reciprocal(), y.reciprocal().square()
    series = inv * (1 / 12 - sq * (1 / 360 - sq * (1 / 1260 - sq / 1680)))
    large = (y - 0.5) * y.log() - y + 0.5 * math.log(2.0 * math.pi) + series
    return large - reduce(mul, [x + i for i in range(1, 9)]).log()
