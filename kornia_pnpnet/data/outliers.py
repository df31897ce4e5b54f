"""Outliers of synthetic problems and of scenes: their number, positions and kinds, and the pixels of each kind."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_ranges, check_whole
from kornia_pnpnet.data.draws import log_uniform, normal, random_poses, uniform

__all__ = ["OutlierDraw", "OutlierMix", "crowd_leaders", "near_offsets", "structured_points"]

# Standard deviations of the pixel noise. The distance of a near outlier from its pixel is log-uniform in this range,
# from just outside the noise to ten times that.
_NEAR = 5.0, 50.0
# The same for distances in pixels: the smallest and the largest distance are at least as far.
_NEAR_PIXELS = 5.0, 10.0
# Pairs. Added to n * max_ratio before rounding down: 0.33 gives floor(n / 3) for n up to 15, although 0.33 < 1/3.
_SLACK = 0.05


class OutlierDraw(NamedTuple):
    r"""The outliers of a batch, by kind.

    Attributes:
        mismatch: the pixel shows another point, bool, shape :math:`(B, N)`.
        sensing: the pixel is uniform in the image, bool, shape :math:`(B, N)`.
        near: the pixel is a little off, bool, shape :math:`(B, N)`; ``None``: no pair is.
        structured: the pixel shows the point from another pose, which all structured outliers of a problem share, bool,
            shape :math:`(B, N)`; ``None``: no pair is.
        crowd: the pixel, or the point, is one of a few that many outliers of the problem share, bool, shape
            :math:`(B, N)`; ``None``: no pair is.
        of_points: problems whose crowds share points instead of pixels, bool, shape :math:`(B, 1)`; ``None``: none do.
    """

    mismatch: Tensor
    sensing: Tensor
    near: Tensor | None = None
    structured: Tensor | None = None
    crowd: Tensor | None = None
    of_points: Tensor | None = None

    @property
    def inliers(self) -> Tensor:
        """Pairs that are no outliers, bool, shape :math:`(B, N)`."""
        outliers = self.mismatch | self.sensing
        for kind in (self.near, self.structured, self.crowd):
            outliers = outliers if kind is None else outliers | kind
        return ~outliers

    @property
    def displaced(self) -> Tensor:
        """Pairs whose pixel has nothing to do with their point, bool, shape :math:`(B, N)`."""
        displaced = self.mismatch | self.sensing
        return displaced if self.crowd is None else displaced | self.crowd


class OutlierMix:
    r"""Outliers at random positions, their number uniform over the integers from a minimum to a maximum.

    Of the shares below, each applies to the outliers that the ones before it left: structured, near, crowd, mismatch.

    Args:
        max_ratio: the maximum as a share of the pairs, rounded down. 0.33 means :math:`\lfloor n/3 \rfloor` for every n
            up to 15.
        count: exact number of outliers, which replaces the range.
        min_count: smallest number of outliers, as far as the maximum allows.
        min_ratio: smallest number of outliers as a share of the pairs, rounded up, as far as the maximum allows.
        mismatch_share: probability that an outlier is a *mismatch* (the projection of another point) rather than
            *sensing* (a uniform pixel of the image).
        near_share: probability that an outlier is *near* its pixel instead.
        near_pixels: smallest and largest distance of a near outlier from its pixel in pixels, log-uniform, but at least
            5 and 10 standard deviations of the noise. 5 to 50 standard deviations when ``None``.
        structured_share: probability that outliers of a problem are *structured* instead: they agree on another pose,
            as with repeated structure.
        structured_ratio: smallest and largest number of structured outliers relative to the number of inliers, uniform
            over the problems, as far as there are outliers.
        structured_angle: largest angle in radians by which the structured part of a scene is turned; it is always
            shifted.
        mirrored_share: probability that the structured part of a problem is mirrored as well.
        crowd_share: probability that a problem has *crowds*: a share of its outliers, uniform from 0 to 1, show few
            pixels, those of other pairs of the problem.
        max_crowds: largest number of these pixels; their number is uniform from 1.
        point_crowd_share: probability that the crowds of a problem share few points instead: many pixels, each of some
            other point, that a matcher took for the same point.
        min_inliers: smallest number of inliers, which limits the maximum.

    Raises:
        BaseError: for shares outside [0, 1], counts that are negative or not whole, or a range that falls or is not
            positive.

    Example:
        >>> OutlierMix().max_count(9), OutlierMix(max_ratio=0.33).max_count(9), OutlierMix(count=2).max_count(9)
        (3, 3, 2)
    """

    def __init__(
        self,
        *,
        max_ratio: float = 1.0 / 3.0,
        count: int | None = None,
        min_count: int = 0,
        mismatch_share: float = 0.5,
        near_share: float = 0.0,
        structured_share: float = 0.0,
        min_inliers: int = 0,
        min_ratio: float = 0.0,
        near_pixels: tuple[float, float] | None = None,
        structured_ratio: tuple[float, float] = (1.0 / 3.0, 1.0 / 3.0),
        structured_angle: float = math.pi,
        mirrored_share: float = 0.0,
        crowd_share: float = 0.0,
        max_crowds: int = 4,
        point_crowd_share: float = 0.0,
    ) -> None:
        check_numbers(0.0, 1.0, max_ratio=max_ratio, min_ratio=min_ratio, mismatch_share=mismatch_share)
        check_numbers(0.0, 1.0, near_share=near_share, structured_share=structured_share)
        check_numbers(0.0, 1.0, mirrored_share=mirrored_share, crowd_share=crowd_share)
        check_numbers(0.0, 1.0, point_crowd_share=point_crowd_share)
        check_numbers(0.0, structured_angle=structured_angle)
        check_ranges(structured_ratio=structured_ratio)
        check_whole(0, min_count=min_count, min_inliers=min_inliers)
        check_whole(1, max_crowds=max_crowds)
        if near_pixels is not None:
            check_ranges(near_pixels=near_pixels)
        if count is not None:
            check_whole(0, count=count)
        self.max_ratio = max_ratio
        self.count = count
        self.min_count = min_count
        self.mismatch_share = mismatch_share
        self.near_share = near_share
        self.structured_share = structured_share
        self.min_inliers = min_inliers
        self.min_ratio = min_ratio
        self.near_pixels = near_pixels
        self.structured_ratio = structured_ratio
        self.structured_angle = structured_angle
        self.mirrored_share = mirrored_share
        self.crowd_share = crowd_share
        self.max_crowds = max_crowds
        self.point_crowd_share = point_crowd_share

    def max_count(self, n: int) -> int:
        """The largest number of outliers among ``n`` pairs."""
        if self.count is not None:
            return self.count
        return max(0, min(math.floor(n * self.max_ratio + _SLACK), n - self.min_inliers))

    def least_count(self, n: int) -> int:
        """The smallest number of outliers among ``n`` pairs."""
        if self.count is not None:
            return self.count
        return min(max(self.min_count, math.ceil(n * self.min_ratio - _SLACK)), self.max_count(n))

    def draw(self, batch_size: int, n: int, generator: torch.Generator) -> OutlierDraw:
        r"""Draw the outliers of a batch.

        Args:
            batch_size: number of problems.
            n: number of pairs of each problem.
            generator: source of randomness; the result is on its device.

        Returns:
            Masks of shape ``(batch_size, n)``.

        Raises:
            BaseError: when there are to be more outliers than pairs.
        """
        least, most = self.least_count(n), self.max_count(n)
        KORNIA_CHECK(most <= n, f"{most} outliers do not fit into n = {n} pairs.")
        device = generator.device
        count = torch.randint(least, most + 1, (batch_size, 1), generator=generator, device=device)
        order = torch.rand(batch_size, n, generator=generator, device=device).argsort(-1)
        rank = torch.empty_like(order).scatter_(1, order, torch.arange(n, device=device).expand(batch_size, n))
        outlier = rank < count
        mismatch = torch.rand(batch_size, n, generator=generator, device=device) < self.mismatch_share
        near = structured = crowd = of_points = None
        if self.structured_share:
            chosen = torch.rand(batch_size, 1, generator=generator, device=device) < self.structured_share
            structured = outlier & chosen & (rank < self._most_structured(n - count, generator))
            outlier = outlier & ~structured
        if self.near_share:
            near = outlier & (torch.rand(batch_size, n, generator=generator, device=device) < self.near_share)
            outlier = outlier & ~near
        if self.crowd_share:
            chosen = torch.rand(batch_size, 1, generator=generator, device=device) < self.crowd_share
            share = torch.rand(batch_size, 1, generator=generator, device=device)
            crowd = outlier & chosen & (torch.rand(batch_size, n, generator=generator, device=device) < share)
            outlier = outlier & ~crowd
            if self.point_crowd_share:
                of_points = torch.rand(batch_size, 1, generator=generator, device=device) < self.point_crowd_share
        return OutlierDraw(outlier & mismatch, outlier & ~mismatch, near, structured, crowd, of_points)

    def _most_structured(self, inliers: Tensor, generator: torch.Generator) -> Tensor:
        """The largest number of structured outliers for each number of inliers, (B, 1)."""
        low, high = self.structured_ratio
        ratio = uniform(inliers.shape, low, high, generator) if low < high else low
        return (inliers * ratio + _SLACK).floor()


def near_offsets(
    img_sigma: Tensor, n: int, generator: torch.Generator, pixels: tuple[float, float] | None = None
) -> Tensor:
    """Draw the offsets in pixels of near outliers, (B, n, 2).

    Args:
        img_sigma: pixel noise of each problem, (B,), or of each pair, (B, n).
        n: number of pairs.
        generator: source of randomness.
        pixels: smallest and largest distance, as ``near_pixels`` of :class:`OutlierMix`.
    """
    batch_size = len(img_sigma)
    direction = torch.nn.functional.normalize(normal((batch_size, n, 2), generator), dim=-1)
    img_sigma = img_sigma.reshape(batch_size, -1, 1)
    if pixels is None:
        return direction * (log_uniform((batch_size, n, 1), *_NEAR, generator) * img_sigma)
    low, high = ((factor * img_sigma).clamp(min=x) for factor, x in zip(_NEAR_PIXELS, pixels, strict=True))
    return direction * (low * (high / low) ** uniform((batch_size, n, 1), 0.0, 1.0, generator))


def structured_points(
    cam_points: Tensor, generator: torch.Generator, *, max_angle: float = math.pi, mirrored_share: float = 0.0
) -> Tensor:
    """The points of each problem rotated about their centre and shifted, (B, N, 3): structured outliers show these.

    Args:
        cam_points: shape (B, N, 3).
        generator: source of randomness.
        max_angle: largest angle of the rotation in radians.
        mirrored_share: probability that a problem's points are mirrored too, at a plane of random direction.
    """
    batch_size = len(cam_points)
    centre = cam_points.mean(1, keepdim=True)
    size = (cam_points - centre).square().sum(-1).mean(1).sqrt()[:, None, None]
    turn = torch.eye(3, dtype=cam_points.dtype, device=cam_points.device)
    if max_angle:
        turn = random_poses(batch_size, generator, max_angle=max_angle).rotation
    shift = 0.5 * size * normal((batch_size, 1, 3), generator)
    if mirrored_share:
        axis = torch.nn.functional.normalize(normal((batch_size, 3, 1), generator), dim=1)
        mirrored = uniform((batch_size, 1, 1), 0.0, 1.0, generator) < mirrored_share
        turn = torch.where(mirrored, turn - 2.0 * (turn @ axis) @ axis.mT, turn)
    return (cam_points - centre) @ turn.mT + centre + shift


def crowd_leaders(batch_size: int, n: int, max_crowds: int, generator: torch.Generator) -> Tensor:
    """Draw for each pair one of a few pairs of its problem, (B, N): a crowd shows its pixel, or is of its point.

    Args:
        batch_size: number of problems.
        n: number of pairs of each problem.
        max_crowds: largest number of different pairs in a problem; their number is uniform from 1.
        generator: source of randomness.
    """
    chance = uniform((batch_size, max_crowds), 0.0, 1.0, generator)
    leader = (n * chance).long().clamp(max=n - 1)  # (B, max_crowds)
    crowds = 1 + (max_crowds * uniform((batch_size, 1), 0.0, 1.0, generator)).long()  # (B, 1)
    crowd = (crowds * uniform((batch_size, n), 0.0, 1.0, generator)).long().clamp(max=max_crowds - 1)
    return leader.gather(1, crowd)
