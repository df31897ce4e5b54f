r"""Is this pose to be believed? Whether it explains the pixels, and whether its inliers could be chance.

A pair is an inlier of a pose when :math:`\|r\|^2 < \tau^2 + (f \omega / z)^2`, with the threshold :math:`\tau` in
pixels and the pixels by which a shift of the world point by the threshold :math:`\omega` moves its projection at the
depth :math:`z`. The ratio of the two sides is the *standardised* squared residual.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.linalg import solve_symmetric, symmetric
from kornia_pnpnet.core.performance import exporting, in_order, present_first
from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.geometry import Projection, normal_equations, span_a_plane
from kornia_pnpnet.refine.step import pixel_precision
from kornia_pnpnet.types import LEAST_NOISE, MIN_PAIRS, Correspondences, Noise

__all__ = [
    "LAWS",
    "LEAST_PROBABILITY",
    "MAX_ERROR",
    "MAX_FALSE_ALARMS",
    "Belief",
    "Judged",
    "Thresholds",
    "believe",
    "chance_of_inlier",
    "chance_of_others",
    "clipped",
    "explains",
    "has_enough",
    "judge",
    "log_false_alarms",
    "probability",
    "residual_noise",
    "rotation_sigma",
]

#: Largest standardised squared residual; points behind the camera have it.
MAX_ERROR = 1e6
#: A pose is evident when fewer poses than this are expected to have as many inliers by chance.
MAX_FALSE_ALARMS = 0.01
#: A pose is to be believed when it is not far off with at least this probability. Of synthetic problems that the law of
#: :func:`probability` was not fitted to, 98 % of the right poses keep it, and 5 to 7 % of the poses that are far off.
LEAST_PROBABILITY = 0.93
#: The laws of :func:`probability`: the log-odds when both numbers are 0, and their slopes by the logarithms of the
#: false alarms and of the rotation's sigma; for noise that was told or estimated by a network, and for noise of
#: :func:`residual_noise`. Fitted by ``python docs/results/make.py measure --only probability``.
LAWS = {"sigmas": (-3.2501, -0.16608, -1.0784), "residuals": (0.89795, -0.27745, 0.070018)}
_ALARMS, _LOG_SIGMA = (-20.0, 10.0), (-12.0, 2.0)
# Pairs. This many stand for all pairs in :func:`chance_of_others`.
_MOST_OTHERS = 64
# Pixels of other pairs near a projection. This many are left out of the count: pixels of right pairs may be close, too.
_FEW_HITS = 4
# Standard deviations. Pairs further off than this are no evidence for a pose.
_EVIDENT = 3.5
# Radii of the disc of the worst inlier. Nearer outliers say nothing about chance: they are pairs that are slightly off,
# or inliers where the caller's sigmas are too small. Tuned on synthetic problems (`pnpnet-set`, seed 9101) with sigmas
# that are half of the noise: ten radii refuse many more right poses, thirty accept more wrong ones.
_REACH = 20.0
# A pose explains the pixels when this share of the pairs (by weight) has small residuals. Just below 0.6, so that a sum
# of shares that is 0.6 up to rounding suffices.
_EXPLAINED_SHARE = 0.6 - 1e-5
# A residual is small when it is below this share of the pixels' spread. A compromise: points behind the camera nearly
# always leave larger residuals, small objects with noise of a tenth of their size leave smaller residuals.
_EXPLAINED_RESIDUAL = 0.2


def has_enough(projection: Projection, weights: Tensor) -> Tensor:
    """Tell whether at least three pairs that have a weight are in front of the camera, bool (B,)."""
    return (projection.in_front & (weights > 0)).sum(-1) >= MIN_PAIRS


def explains(projection: Projection, corr: Correspondences, weights: Tensor) -> Tensor:
    r"""Tell whether a pose explains the pixels, when the noise is unknown.

    A pose explains the pixels when the residual that 60 % of the pairs (by weight) stay below is less than a fifth of
    the distance from their mean that 60 % of the pixels stay below: a pose hardly better than "everything is at one
    point" is no answer. Both sides scale with the image, so that no threshold is in pixels. At least four pairs have to
    agree (of three pairs all three), and their points must span more than a line.

    Args:
        projection: :func:`~kornia_pnpnet.geometry.project` of the pose.
        corr: normalised correspondences.
        weights: weight of each pair before its residual was looked at, :math:`(B, N)`.

    Returns:
        bool of shape :math:`(B,)`.
    """
    weights = weights.detach()
    there = weights > 0
    share = weights / weights.sum(-1, keepdim=True).clamp(min=torch.finfo(weights.dtype).tiny)  # (B, N)
    spread = torch.zeros_like(share)
    for pixels in corr.img_points.detach().unbind(-1):
        centred = pixels - (share * pixels).sum(-1, keepdim=True)
        spread = torch.addcmul(spread, centred, centred)
    ascending, order = spread.sort(-1)
    position = (share.gather(-1, order).cumsum(-1) < _EXPLAINED_SHARE).sum(-1, keepdim=True)
    limit = _EXPLAINED_RESIDUAL**2 * ascending.gather(-1, position.clamp(max=ascending.shape[-1] - 1))
    explained = projection.in_front & (projection.sq_residual.detach() <= limit)
    enough = (share * explained).sum(-1) >= _EXPLAINED_SHARE
    # Any three pairs have a pose that explains them: of more pairs, a fourth has to agree.
    agree = explained & there
    enough = enough & (agree.sum(-1) >= there.sum(-1).clamp(MIN_PAIRS, MIN_PAIRS + 1))
    return enough & _span_a_plane(corr.world_points.detach(), agree)


class Belief(NamedTuple):
    """What the inliers say of a pose.

    Attributes:
        probability: see :func:`probability`, shape :math:`(B,)`.
        ok: whether the pose is to be believed, bool, shape :math:`(B,)`.
    """

    probability: Tensor
    ok: Tensor


def believe(projection: Projection, corr: Correspondences, law: str = "sigmas") -> Belief:
    """Tell whether a pose is to be believed, when the noise is known for every pair.

    Its inliers must be more than chance would give it and span more than a line, and it must probably not be far off.

    Args:
        projection: :func:`~kornia_pnpnet.geometry.project` of the pose.
        corr: normalised correspondences with their noise.
        law: one of :data:`LAWS`.

    Returns:
        The probability and the answer, without a gradient.
    """
    projection, corr = map_tensors(torch.Tensor.detach, projection), corr.map(torch.Tensor.detach)
    assert corr.noise is not None
    precision = pixel_precision(projection, corr.noise, corr.focal) if corr.noise.covariances else None
    assert not isinstance(precision, Tensor)
    precision = map_tensors(lambda x: x / _EVIDENT**2, precision)
    thresholds = Thresholds(_EVIDENT * corr.noise.img, _EVIDENT * corr.noise.world, precision)
    judged = judge(projection, corr, thresholds)
    inliers, counts = (judged.weights > 0).sum(-1), (corr.weights > 0).sum(-1)
    triples = counts * (counts - 1) * (counts - 2) // 6  # any three pairs could have given the pose
    chance = chance_of_inlier(corr, thresholds, judged)
    chance = chance.maximum(chance_of_others(projection, corr, thresholds, judged))
    alarms = log_false_alarms(triples, inliers, counts, chance)
    chances = probability(alarms, rotation_sigma(projection, corr, judged), law).to(corr.weights)
    span = _span_a_plane(corr.world_points, judged.weights > 0)
    evident = (alarms < math.log(MAX_FALSE_ALARMS)) & (chances >= LEAST_PROBABILITY)
    return Belief(torch.where(span, chances, 0.0), span & evident)


def probability(log_alarms: Tensor, sigma: Tensor, law: str = "sigmas") -> Tensor:
    r"""Probability that a pose is not far off: within 10 degrees and 30 % of the distance of the points.

    A logistic law of two numbers: how unlikely the inliers are by chance, and how well they determine the rotation.
    Few inliers in a small part of the space and of the image agree with many poses.

    Args:
        log_alarms: :func:`log_false_alarms`, shape :math:`(B,)`.
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
    """The two numbers of :data:`LAWS`: beyond their ranges more evidence says nothing more."""
    return log_alarms.clamp(*_ALARMS), sigma.log().clamp(*_LOG_SIGMA)


def residual_noise(projection: Projection, corr: Correspondences, weights: Tensor) -> Noise:
    """The noise of the pixels that the median residual shows, for a :func:`probability` where the noise is unknown.

    Args:
        projection: :func:`~kornia_pnpnet.geometry.project` of the pose.
        corr: normalised correspondences.
        weights: weight of each pair before its residual was looked at, :math:`(B, N)`.

    Returns:
        The same sigma for all pairs of a problem.
    """
    there = (weights > 0) & projection.in_front
    count = there.sum(-1, keepdim=True)
    ascending = in_order(torch.where(there, projection.sq_residual, torch.inf).detach().mT[None])[0].mT
    middle = ((count + MIN_PAIRS) // 2).minimum(count - 1).clamp(min=0)  # any pose fits three pairs
    variance = ascending.gather(-1, middle) / (2.0 * math.log(2.0))
    sigma = variance.clamp(max=corr.focal.square()).sqrt().maximum(LEAST_NOISE * corr.focal)
    return Noise(sigma.expand_as(weights), torch.zeros_like(weights))


def rotation_sigma(projection: Projection, corr: Correspondences, judged: Judged) -> Tensor:
    """Standard deviation of the rotation in radians, by the noise of the inliers; infinite where they leave it open.

    Args:
        projection: :func:`~kornia_pnpnet.geometry.project` of the pose.
        corr: normalised correspondences with their noise.
        judged: what :func:`judge` returned.

    Returns:
        The square root of the trace of the rotation's covariance, float64, shape :math:`(B,)`.
    """
    assert corr.noise is not None
    inlier = corr.focal.square() * (judged.weights > 0)
    weights = map_tensors(lambda x: inlier * x, pixel_precision(projection, corr.noise, corr.focal))
    rows = normal_equations(projection, weights).hessian
    matrix = symmetric(rows).double()
    shift = matrix[:, 3:, 3:]
    left = matrix[:, :3, :3] - matrix[:, :3, 3:] @ solve_symmetric(shift, matrix[:, 3:, :3])  # the shift eliminated
    eye = torch.eye(3, dtype=left.dtype, device=left.device)
    variance = solve_symmetric(left, eye.expand_as(left)).diagonal(dim1=1, dim2=2).sum(-1)
    return torch.where(variance > 0, variance, torch.inf).sqrt()  # NaN, too, is open


def _span_a_plane(world_points: Tensor, inliers: Tensor) -> Tensor:
    """Whether the points (B, N, 3) of the inliers (B, N) span more than a line: a line leaves the pose open."""
    inlier = inliers.mT.to(world_points.dtype)
    share = inlier.sum(0).clamp(min=1.0).reciprocal()
    points = world_points.permute(2, 1, 0) * inlier
    centred = torch.addcmul(points, (points.sum(1) * share)[:, None], inlier, value=-1)
    return span_a_plane(centred, share, points.abs().amax((0, 1)))


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


def judge(projection: Projection, corr: Correspondences, thresholds: Thresholds) -> Judged:
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
        >>> corr = Correspondences(points, torch.zeros(1, 2, 2), torch.ones(1, 2), torch.tensor(100.0))
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


def chance_of_inlier(corr: Correspondences, thresholds: Thresholds, judged: Judged) -> Tensor:
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
        >>> corr = Correspondences(torch.zeros(1, 3, 3), pixels, torch.ones(1, 3), torch.tensor(100.0))
        >>> judged = Judged(torch.ones(1, 3), torch.tensor([[0.0, 0.1, 0.25]]))  # the worst is 5 px off
        >>> chance_of_inlier(corr, Thresholds(torch.tensor([10.0]), torch.tensor([0.0])), judged) * 400 * 200
        tensor([78.5398])
    """
    there, inlier = corr.weights[..., None] > 0, judged.weights > 0
    high = torch.where(there, corr.img_points, -torch.inf).amax(1)
    low = torch.where(there, corr.img_points, torch.inf).amin(1)
    eps = torch.finfo(high.dtype).eps  # a perfect fit of pixels that all coincide is no evidence
    sides = (high - low).clamp(min=eps)[:, None]  # (B, 1, 2)
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


def chance_of_others(projection: Projection, corr: Correspondences, thresholds: Thresholds, judged: Judged) -> Tensor:
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
    pixels = torch.where(there[..., None], corr.img_points, torch.inf)
    values = torch.cat((corr.focal * torch.stack(projection.plane_points, -1), pixels, limit[..., None]), -1)
    counts = there.sum(-1)
    if not exporting() and values.shape[1] > _MOST_OTHERS:  # evenly spaced among those that are no padding
        first = torch.arange(_MOST_OTHERS, device=there.device)
        some = present_first(there).gather(1, first.maximum(first * counts[:, None] // _MOST_OTHERS))
        values = values.gather(1, some[..., None].expand(-1, -1, 5))
        counts = counts.clamp(max=_MOST_OTHERS)
    u, v, pixel_u, pixel_v, limit = values.unbind(-1)
    u, v = u[:, :, None] - pixel_u[:, None], v[:, :, None] - pixel_v[:, None]
    near = u.square_().addcmul_(v, v) <= limit[..., None]
    hits = near.sum((1, 2)) - near.diagonal(dim1=1, dim2=2).sum(-1)
    return (hits - _FEW_HITS).clamp(min=0) / (counts * (counts - 1)).clamp(min=1)


def _sq_limits(projection: Projection, corr: Correspondences, thresholds: Thresholds) -> Tensor:
    """Largest squared residual of an inlier in square pixels, (B, N)."""
    if thresholds.precision is not None:
        return thresholds.precision.determinant.rsqrt()
    img, world = _of_pairs(thresholds.img), _of_pairs(thresholds.world)
    return img.square() + (corr.focal * world * projection.inv_depth).square()


def _of_pairs(threshold: Tensor) -> Tensor:
    """Thresholds of problems as thresholds of their pairs."""
    return threshold[:, None] if threshold.ndim == 1 else threshold


def log_false_alarms(tested: Tensor, inliers: Tensor, counts: Tensor, chance: Tensor) -> Tensor:
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

    Returns:
        float64 of shape :math:`(B,)`; with fewer than three inliers the logarithm of the number of tested poses.

    Example:
        >>> chance = torch.tensor([1e-4, 1e-4, 1e-4], dtype=torch.float64)
        >>> log_false_alarms(torch.tensor(100), torch.tensor([3, 4, 6]), torch.tensor([9, 9, 9]), chance)
        tensor([  4.6052,  -2.8134, -20.0301], dtype=torch.float64)
    """
    extra = (inliers - MIN_PAIRS).clamp(min=0).double()
    free = torch.maximum((counts - MIN_PAIRS).clamp(min=0).double(), extra)
    ways = _log_factorial(free) - _log_factorial(extra) - _log_factorial(free - extra)
    tiny = torch.finfo(torch.float64).tiny
    return tested.clamp(min=1).double().log() + ways + extra * chance.double().clamp(min=tiny).log()


def _log_factorial(x: Tensor) -> Tensor:
    r"""Logarithm of :math:`x!` for integers :math:`x \ge 0`, in float64."""
    if not exporting():
        return torch.lgamma(x + 1)
    # ONNX has no log-gamma. Stirling's series of Γ(x + 9), which is Γ(x + 1) times eight factors: 12 digits.
    y = x + 9.0
    inv, sq = y.reciprocal(), y.reciprocal().square()
    series = inv * (1 / 12 - sq * (1 / 360 - sq * (1 / 1260 - sq / 1680)))
    factors = math.prod(x + i for i in range(1, 9))
    return (y - 0.5) * y.log() - y + 0.5 * math.log(2.0 * math.pi) + series - torch.as_tensor(factors).log()
