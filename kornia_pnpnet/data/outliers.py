"""How many pairs are wrong, which, and in what way."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_whole

__all__ = ["OutlierDraw", "OutlierMix"]


class OutlierDraw(NamedTuple):
    r"""Which pairs of a batch are wrong.

    Attributes:
        mismatch: the pixel belongs to another point, bool, shape :math:`(B, N)`.
        sensing: the pixel is anywhere in the image, bool, shape :math:`(B, N)`.
        near: the pixel is a little off, bool, shape :math:`(B, N)`; ``None``: none is.
        structured: the pixel is where another pose, the same for all of these of a problem, would show the point,
            bool, shape :math:`(B, N)`; ``None``: none is.
    """

    mismatch: Tensor
    sensing: Tensor
    near: Tensor | None = None
    structured: Tensor | None = None

    @property
    def inliers(self) -> Tensor:
        """Pairs that are none of these, bool, shape :math:`(B, N)`."""
        wrong = self.mismatch | self.sensing
        for more in (self.near, self.structured):
            wrong = wrong if more is None else wrong | more
        return ~wrong


class OutlierMix:
    r"""The number of wrong pairs, uniform over the integers from ``min_count`` to a maximum, at random positions.

    Args:
        max_ratio: the maximum as a share of the pairs, rounded down. A twentieth of a pair is forgiven, so that a
            third written as 0.33 means :math:`\lfloor n/3 \rfloor` for every n up to 15.
        count: exactly this many instead.
        min_count: the fewest.
        mismatch_share: probability that a wrong pair is a *mismatch* (the projection of another point) rather than
            *sensing* (a pixel anywhere in the image).
        near_share: probability that a wrong pair is *near* instead: a little off.
        structured_share: probability that the wrong pairs of a problem are *structured* instead, up to a third of the
            right ones: they agree on another pose, as repeated structure does.
        min_inliers: so many pairs stay right, whatever ``max_ratio`` says.

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
        """The most wrong pairs among ``n``."""
        if self.count is not None:
            return self.count
        return max(0, min(math.floor(n * self.max_ratio + 0.05), n - self.min_inliers))

    def draw(self, batch_size: int, n: int, generator: torch.Generator) -> OutlierDraw:
        r"""Draw the wrong pairs of a batch.

        Args:
            batch_size: number of problems.
            n: pairs in each.
            generator: source of randomness; the result is on its device.

        Returns:
            Masks of shape ``(batch_size, n)``.

        Raises:
            BaseError: when more wrong pairs are asked for than there are pairs.
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
            such = torch.rand(batch_size, 1, generator=generator, device=device) < self.structured_share
            structured = outlier & such & (rank < (n - count) // 3)
            outlier = outlier & ~structured
        if self.near_share:
            near = outlier & (torch.rand(batch_size, n, generator=generator, device=device) < self.near_share)
            outlier = outlier & ~near
        return OutlierDraw(outlier & mismatch, outlier & ~mismatch, near, structured)
