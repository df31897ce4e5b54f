"""Outliers of synthetic problems and of scenes: their number, positions, kinds and pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor
from torch.nn.functional import normalize

from kornia_pnpnet.core.checks import check_numbers, check_ranges, check_whole
from kornia_pnpnet.data.draws import log_uniform, normal, random_poses, uniform, unit

__all__ = ["OutlierKind", "OutlierMix", "crowd_leaders", "near_offsets", "structured_points"]

# `near_pixels`: default range, and smallest lower and upper end. The unit is the standard deviation of the pixel noise.
# The numbers are choices. Noise hardly exceeds 5 standard deviations.
_NEAR, _LEAST_NEAR = (5.0, 50.0), (5.0, 10.0)
# `_SLACK` is added to numbers of outliers before rounding down. A ratio of 0.33 then gives floor(n / 3) for n up to 15.
_SLACK = 0.05


class OutlierKind(IntEnum):
    """Kinds of pairs, see :class:`OutlierMix`. Pairs of a crowd share a pixel; pairs of a point crowd share a point."""

    INLIER = 0
    MISMATCH = 1
    SENSING = 2
    NEAR = 3
    STRUCTURED = 4
    CROWD = 5
    POINT_CROWD = 6


@dataclass(kw_only=True, eq=False)
class OutlierMix:
    r"""Number and kinds of the outliers of random problems.

    The number of outliers is a uniform integer between two bounds, and the outliers are random pairs. Kinds are
    assigned in four steps: structured, near, crowd, and finally mismatch or sensing. Each step skips outliers that
    already have a kind.

    Args:
        max_ratio: largest share of outliers. n * ``max_ratio`` + 0.05 is rounded down: 0.33 gives n // 3 for n <= 15.
        count: number of outliers. If given, ``max_ratio``, ``min_count`` and ``min_inliers`` have no effect. A
            source can add outliers, for example by noise with heavy tails.
        min_count: smallest number of outliers. A ``min_count`` above the largest number is lowered to that number.
        min_inliers: smallest number of inliers, before a source adds outliers. At most n - ``min_inliers`` pairs are
            outliers.
        mismatch_share: outliers of none of the kinds below are *mismatches* with this probability, else *sensing*
            outliers. A mismatch has the pixel of another point. A sensing outlier has a uniform pixel of the image.
        near_share: probability that an outlier is *near*. The pixel of a near outlier is close to its point's pixel.
        near_pixels: range of a near outlier's distance from the pixel of its point, in pixels. Distances are
            log-uniform. The lower end is raised to at least 5 standard deviations of the pixel noise, and the upper end
            to at least 10. ``None`` means 5 to 50 standard deviations.
        structured_share: probability that a problem has *structured* outliers. The structured outliers of a problem
            agree on one incorrect pose, as in scenes with repeated structure.
        structured_ratio: range of the ratio of structured outliers to inliers. Each problem draws a uniform ratio.
        structured_angle: largest rotation angle, in radians. Structured outliers have the pixels of a shifted and
            rotated copy of the problem's points.
        mirrored_share: probability that the copy for structured outliers is also mirrored.
        crowd_share: probability that a problem has *crowds*. All outliers of a crowd have the pixel of one pair, the
            leader. For each problem, the probability that an outlier joins a crowd is drawn uniformly from 0 to 1.
        max_crowds: largest number of crowds. Each problem draws a number of crowds uniformly from 1 to ``max_crowds``.
        point_crowd_share: probability that a problem's crowds share their leaders' world points instead of pixels.

    Example:
        >>> OutlierMix().max_count(9), OutlierMix(max_ratio=0.33).max_count(9), OutlierMix(count=2).max_count(9)
        (3, 3, 2)
    """

    max_ratio: float = 1.0 / 3.0
    count: int | None = None
    min_count: int = 0
    min_inliers: int = 0
    mismatch_share: float = 0.5
    near_share: float = 0.0
    near_pixels: tuple[float, float] | None = None
    structured_share: float = 0.0
    structured_ratio: tuple[float, float] = (1.0 / 3.0, 1.0 / 3.0)
    structured_angle: float = math.pi
    mirrored_share: float = 0.0
    crowd_share: float = 0.0
    max_crowds: int = 4
    point_crowd_share: float = 0.0

    def __post_init__(self) -> None:
        shares = {name: value for name, value in vars(self).items() if name.endswith("_share")}
        check_numbers(0.0, 1.0, max_ratio=self.max_ratio, **shares)
        check_numbers(0.0, structured_angle=self.structured_angle)
        near_pixels = _NEAR if self.near_pixels is None else self.near_pixels
        check_ranges(structured_ratio=self.structured_ratio, near_pixels=near_pixels)
        count = 0 if self.count is None else self.count
        check_whole(0, count=count, min_count=self.min_count, min_inliers=self.min_inliers)
        check_whole(1, max_crowds=self.max_crowds)

    def max_count(self, n: int) -> int:
        """The largest number of outliers among ``n`` pairs."""
        if self.count is not None:
            return self.count
        return max(0, min(math.floor(n * self.max_ratio + _SLACK), n - self.min_inliers))

    def draw(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """Draw a value of :class:`OutlierKind` for each pair, int64, shape ``(batch_size, n)``.

        Raises:
            BaseError: when ``count`` exceeds ``n``.
        """
        most = self.max_count(n)
        least = min(self.min_count, most) if self.count is None else most
        KORNIA_CHECK(most <= n, f"{most} outliers do not fit into n = {n} pairs.")

        def chance(*shape: int) -> Tensor:
            return torch.rand(batch_size, *shape, generator=generator, dtype=torch.float32)

        count = torch.randint(least, most + 1, (batch_size, 1), generator=generator)
        rank = chance(n).argsort(-1).argsort(-1)
        is_open = rank < count  # outliers whose kind can still change
        kind = is_open * torch.where(chance(n) < self.mismatch_share, OutlierKind.MISMATCH, OutlierKind.SENSING)
        if self.structured_share:
            chosen = chance(1) < self.structured_share
            low, high = self.structured_ratio
            ratio = uniform((batch_size, 1), low, high, generator) if low < high else low
            chosen = is_open & chosen & (rank < ((n - count).double() * ratio + _SLACK).floor())
            kind[chosen], is_open = OutlierKind.STRUCTURED, is_open & ~chosen
        if self.near_share:
            chosen = is_open & (chance(n) < self.near_share)
            kind[chosen], is_open = OutlierKind.NEAR, is_open & ~chosen
        if self.crowd_share:
            chosen, share = chance(1) < self.crowd_share, chance(1)
            kind[is_open & chosen & (chance(n) < share)] = OutlierKind.CROWD
            if self.point_crowd_share:
                kind[(kind == OutlierKind.CROWD) & (chance(1) < self.point_crowd_share)] = OutlierKind.POINT_CROWD
        return kind


def near_offsets(img_sigma: Tensor, n: int, generator: torch.Generator, pixels: tuple[float, float] | None) -> Tensor:
    """Draw pixel offsets of near outliers, (B, n, 2). The shape of ``img_sigma`` is (B, 1) or (B, n)."""
    direction = normalize(normal((len(img_sigma), n, 2), generator), dim=-1)
    each, img_sigma = (len(img_sigma), n, 1), img_sigma[..., None]
    if pixels is None:
        return direction * (log_uniform(each, *_NEAR, generator) * img_sigma)
    low, high = ((factor * img_sigma).clamp(min=x) for factor, x in zip(_LEAST_NEAR, pixels, strict=True))
    return direction * (low * (high / low) ** unit(each, generator))


def structured_points(cam_points: Tensor, mix: OutlierMix, generator: torch.Generator) -> Tensor:
    """Rotate, shift and possibly mirror a copy of all points, (B, N, 3); see :class:`OutlierMix`."""
    batch_size = len(cam_points)
    centre = cam_points.mean(1, keepdim=True)
    size = (cam_points - centre).square().sum(-1).mean(1).sqrt()[:, None, None]
    turn = torch.eye(3, dtype=cam_points.dtype)
    if mix.structured_angle:
        turn = random_poses(batch_size, generator, max_angle=mix.structured_angle).rotation
    shift = 0.5 * size * normal((batch_size, 1, 3), generator)
    if mix.mirrored_share:  # mirror at a plane with a random normal
        axis = normalize(normal((batch_size, 3, 1), generator), dim=1)
        mirrored = unit((batch_size, 1, 1), generator) < mix.mirrored_share
        turn = torch.where(mirrored, turn - 2.0 * (turn @ axis) @ axis.mT, turn)
    return (cam_points - centre) @ turn.mT + centre + shift


def crowd_leaders(batch_size: int, n: int, max_crowds: int, generator: torch.Generator) -> Tensor:
    """Draw the index of a leader for each pair, (B, N). Only pairs of a crowd use their leader."""
    leader = (n * unit((batch_size, max_crowds), generator)).long()  # (B, max_crowds)
    crowds = 1 + (max_crowds * unit((batch_size, 1), generator)).long()  # (B, 1)
    crowd = (crowds * unit((batch_size, n), generator)).long()
    return leader.gather(1, crowd)
