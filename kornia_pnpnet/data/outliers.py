"""Outliers of synthetic problems and of scenes: their number, positions and kinds, and the pixels of each kind."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_whole
from kornia_pnpnet.data.draws import log_uniform, normal, random_poses

__all__ = ["OutlierDraw", "OutlierMix", "near_offsets", "structured_points"]

# Standard deviations of the pixel noise. The distance of a near outlier from its pixel is log-uniform in this range,
# from just outside the noise to ten times that.
_NEAR = 5.0, 50.0
# Pairs. Added to n * max_ratio before rounding down: 0.33 gives floor(n / 3) for n up to 15, although 0.33 < 1/3.
_SLACK = 0.05


class OutlierDraw(NamedTuple):
    r"""The outliers of a batch, by kind.

    Attributes:
        mismatch: the pixel shows another point, bool, shape :math:`(B, N)`.
        sensing: the pixel is uniform in the image, bool, shape :math:`(B, N)`.
        near: the pixel is off by 5 to 50 standard deviations of the noise, bool, shape :math:`(B, N)`; ``None``: no
            pair is.
        structured: the pixel shows the point from another pose, which all structured outliers of a problem share, bool,
            shape :math:`(B, N)`; ``None``: no pair is.
    """

    mismatch: Tensor
    sensing: Tensor
    near: Tensor | None = None
    structured: Tensor | None = None

    @property
    def inliers(self) -> Tensor:
        """Pairs that are no outliers, bool, shape :math:`(B, N)`."""
        outliers = self.mismatch | self.sensing
        for kind in (self.near, self.structured):
            outliers = outliers if kind is None else outliers | kind
        return ~outliers


class OutlierMix:
    r"""Outliers at random positions, their number uniform over the integers from ``min_count`` to a maximum.

    Args:
        max_ratio: the maximum as a share of the pairs, rounded down. 0.33 means :math:`\lfloor n/3 \rfloor` for every n
            up to 15.
        count: exact number of outliers, which replaces the range.
        min_count: smallest number of outliers.
        mismatch_share: probability that an outlier is a *mismatch* (the projection of another point) rather than
            *sensing* (a uniform pixel of the image).
        near_share: probability that an outlier is *near* its pixel instead, off by 5 to 50 standard deviations.
        structured_share: probability that the outliers of a problem are *structured* instead, up to a third of its
            inliers: they agree on another pose, as with repeated structure.
        min_inliers: smallest number of inliers, which limits the maximum.

    Raises:
        BaseError: for shares outside [0, 1] or counts that are negative or not whole.

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
    ) -> None:
        check_numbers(0.0, 1.0, max_ratio=max_ratio, mismatch_share=mismatch_share)
        check_numbers(0.0, 1.0, near_share=near_share, structured_share=structured_share)
        check_whole(0, min_count=min_count, min_inliers=min_inliers)
        if count is not None:
            check_whole(0, count=count)
        self.max_ratio = max_ratio
        self.count = count
        self.min_count = min_count
        self.mismatch_share = mismatch_share
        self.near_share = near_share
        self.structured_share = structured_share
        self.min_inliers = min_inliers

    def max_count(self, n: int) -> int:
        """The largest number of outliers among ``n`` pairs."""
        if self.count is not None:
            return self.count
        return max(0, min(math.floor(n * self.max_ratio + _SLACK), n - self.min_inliers))

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
        most = self.max_count(n)
        least = min(self.min_count, most) if self.count is None else self.count
        KORNIA_CHECK(most <= n, f"{most} outliers do not fit into n = {n} pairs.")
        device = generator.device
        count = torch.randint(least, most + 1, (batch_size, 1), generator=generator, device=device)
        order = torch.rand(batch_size, n, generator=generator, device=device).argsort(-1)
        rank = torch.empty_like(order).scatter_(1, order, torch.arange(n, device=device).expand(batch_size, n))
        outlier = rank < count
        mismatch = torch.rand(batch_size, n, generator=generator, device=device) < self.mismatch_share
        near = structured = None
        if self.structured_share:
            chosen = torch.rand(batch_size, 1, generator=generator, device=device) < self.structured_share
            structured = outlier & chosen & (rank < (n - count) // 3)
            outlier = outlier & ~structured
        if self.near_share:
            near = outlier & (torch.rand(batch_size, n, generator=generator, device=device) < self.near_share)
            outlier = outlier & ~near
        return OutlierDraw(outlier & mismatch, outlier & ~mismatch, near, structured)


def near_offsets(img_sigma: Tensor, n: int, generator: torch.Generator) -> Tensor:
    """Draw the offsets in pixels of near outliers, (B, n, 2), from the pixel noise of each problem, (B,)."""
    batch_size = len(img_sigma)
    direction = torch.nn.functional.normalize(normal((batch_size, n, 2), generator), dim=-1)
    return direction * (log_uniform((batch_size, n, 1), *_NEAR, generator) * img_sigma[:, None, None])


def structured_points(cam_points: Tensor, generator: torch.Generator) -> Tensor:
    """The points of each problem rotated about their centre and shifted, (B, N, 3): structured outliers show these."""
    batch_size = len(cam_points)
    centre = cam_points.mean(1, keepdim=True)
    size = (cam_points - centre).square().sum(-1).mean(1).sqrt()[:, None, None]
    turn = random_poses(batch_size, generator, max_angle=math.pi).rotation
    shift = 0.5 * size * normal((batch_size, 1, 3), generator)
    return (cam_points - centre) @ turn.mT + centre + shift
