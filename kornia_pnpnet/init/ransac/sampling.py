r"""What RANSAC draws, when it may stop, and whether its answer could be chance: functions of counts alone.

All are per problem and shared by nothing but the random numbers, so that a problem has the same samples alone, in any
batch and at any place in it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["MIN_PAIRS", "Samples", "draw_subsets", "good_sample_share", "log_false_alarms", "samples_needed"]

#: So many pairs have a pose in all but degenerate cases, whatever they are.
MIN_PAIRS = 3


def draw_subsets(numbers: Tensor, counts: Tensor) -> Tensor:
    r"""Turn uniform numbers into subsets: one of ``count`` items, then one of those that are left, and so on.

    Args:
        numbers: uniform in [0, 1), float64, shape :math:`(H, s)`.
        counts: number of items for each problem, shape :math:`(P,)`. With fewer than :math:`s` the subsets go on past
            the last item.

    Returns:
        :math:`H` subsets for each problem, ascending, int64, shape :math:`(P, H, s)`.

    Example:
        >>> draw_subsets(torch.tensor([[0.0, 0.0, 0.99]], dtype=torch.float64), torch.tensor([3, 10])).tolist()
        [[[0, 1, 2]], [[0, 1, 9]]]
    """
    chosen: list[Tensor] = []
    for j in range(numbers.shape[1]):
        left = (counts - j).clamp(min=1)[:, None]
        item = (numbers[:, j] * left).long().minimum(left - 1)  # (P, H); rounding may carry a product up to `left`
        for earlier in chosen:  # ascending: the position among those left becomes the position among all
            item = item + (item >= earlier)
        for i, earlier in enumerate(chosen):
            chosen[i], item = torch.minimum(earlier, item), torch.maximum(earlier, item)
        chosen.append(item)
    return torch.stack(chosen, -1)


class Samples:
    r"""The subsets of pairs that RANSAC tries, for every problem of a batch.

    When there are at most ``most`` subsets of the :math:`N` pairs all are taken once, in an order that ``seed``
    fixes. Else ``most`` are drawn among the pairs that are there. The random numbers are the same for every problem.

    Args:
        there: which pairs there are, bool, shape :math:`(B, N)`.
        size: pairs in a subset.
        most: the largest number of subsets.
        seed: of the random numbers.

    Example:
        >>> samples = Samples(torch.ones(1, 4, dtype=torch.bool), size=3, most=10, seed=0)
        >>> samples.total, sorted(samples.positions(torch.tensor([0]), 0, 4)[0].tolist())
        (4, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])
    """

    def __init__(self, there: Tensor, *, size: int, most: int, seed: int) -> None:
        pairs = there.shape[1]
        generator = torch.Generator().manual_seed(seed)  # on the CPU: the same numbers on every device
        self.size = size
        self.counts = there.sum(-1)
        # Positions of the pairs that are there, then those of the others: what stable sorting would give, but faster.
        rank = torch.where(there, there.cumsum(-1), self.counts[:, None] + (~there).cumsum(-1)) - 1
        order = torch.arange(pairs, device=there.device).expand_as(rank)
        self._present_first = torch.empty_like(rank).scatter_(1, rank, order)  # (B, N)
        self.enumerated = math.comb(pairs, size) <= most
        if self.enumerated:
            table = torch.combinations(torch.arange(pairs), size)
            self._table = table[torch.randperm(len(table), generator=generator)].to(there.device)
        else:
            self._table = torch.rand(most, size, generator=generator, dtype=torch.float64).to(there.device)
        self.total = len(self._table)

    def positions(self, problems: Tensor, start: int, stop: int) -> Tensor:
        r"""Subsets ``start`` to ``stop`` of some problems.

        Args:
            problems: which problems, int64, shape :math:`(P,)`.
            start: the first subset.
            stop: the one after the last.

        Returns:
            Positions of pairs, int64, shape :math:`(P, H, s)`. Enumerated subsets may hold pairs that are not there.
        """
        table = self._table[start:stop]
        if self.enumerated:
            return table.expand(len(problems), -1, -1)
        return self._present(problems, draw_subsets(table, self.counts[problems]))

    def spread(self, problems: Tensor, count: int) -> Tensor:
        r"""Positions of ``count`` pairs spread evenly over those that are there, shape :math:`(P, count)`.

        Pairs that :class:`~kornia_pnpnet.normalize.Normalize` has ordered are thus spread over the image.
        """
        middle = 2 * torch.arange(count, device=problems.device) + 1
        return self._present(problems, middle * self.counts[problems, None] // (2 * count))

    def _present(self, problems: Tensor, ranks: Tensor) -> Tensor:
        """From ranks among the pairs that are there, (P, ...), to their positions."""
        return self._present_first[problems].gather(1, ranks.flatten(1)).view_as(ranks)


def good_sample_share(inliers: Tensor, counts: Tensor, size: int) -> Tensor:
    r"""Share of subsets without an outlier, :math:`\binom{k}{s} / \binom{c}{s}`, which is less than :math:`(k/c)^s`.

    Args:
        inliers: number of inliers :math:`k`, shape :math:`(B,)`.
        counts: number of pairs :math:`c`, shape :math:`(B,)`.
        size: pairs in a subset.

    Returns:
        float64 of shape :math:`(B,)`.

    Example:
        >>> good_sample_share(torch.tensor([6, 2]), torch.tensor([9, 9]), 3)
        tensor([0.2381, 0.0000], dtype=torch.float64)
    """
    share = torch.ones_like(inliers, dtype=torch.float64)
    for j in range(size):
        share = share * (inliers - j).clamp(min=0) / (counts - j).clamp(min=1)
    return share.clamp(max=1.0)


def samples_needed(inliers: Tensor, counts: Tensor, size: int, confidence: float) -> Tensor:
    r"""How many samples make it likely that one of them holds inliers only, :math:`\log(1-p) / \log(1-w)`.

    Source: M. Fischler and R. Bolles, "Random sample consensus", Communications of the ACM 24(6), 1981, section II.B,
    with :math:`w` of :func:`good_sample_share`.

    Args:
        inliers: number of inliers of the best pose so far, shape :math:`(B,)`.
        counts: number of pairs, shape :math:`(B,)`.
        size: pairs in a subset.
        confidence: :math:`p`, in (0, 1).

    Returns:
        float64 of shape :math:`(B,)`, infinite where there is no such sample.

    Example:
        >>> samples_needed(torch.tensor([9, 6, 2]), torch.tensor([9, 9, 9]), 3, 0.999)
        tensor([ 0.0000, 25.4023,     inf], dtype=torch.float64)
    """
    return math.log1p(-confidence) / torch.log1p(-good_sample_share(inliers, counts, size))


def log_false_alarms(tested: Tensor, inliers: Tensor, counts: Tensor, chance: Tensor) -> Tensor:
    r"""Natural logarithm of how often pairs without any pose behind them would have as many inliers.

    Three pairs give a pose, which leaves :math:`\binom{c - 3}{k - 3}` ways to choose the other inliers; each is one
    with the probability :math:`p`; and every tested pose is another chance. So the expected number of such poses is at
    most :math:`T \binom{c-3}{k-3} p^{k-3}`, which a pose worth keeping keeps small.

    Source: L. Moisan and B. Stival, "A probabilistic criterion to detect rigid point matches between two images and
    estimate the fundamental matrix", IJCV 57(3), 2004; P. Moulon, P. Monasse and R. Marlet, "Adaptive structure from
    motion with a contrario model estimation", ACCV 2012. They count the poses that could be tested, not those that
    were.

    Args:
        tested: number of poses :math:`T` that were tested, shape :math:`(B,)`.
        inliers: number of inliers :math:`k` of the best, shape :math:`(B,)`.
        counts: number of pairs :math:`c`, shape :math:`(B,)`.
        chance: probability :math:`p` that a pixel from anywhere is an inlier, shape :math:`(B,)`.

    Returns:
        float64 of shape :math:`(B,)`; where there are fewer inliers than give a pose, the logarithm of the number of
        tested poses.

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
    r"""Of whole numbers :math:`x \ge 0` in float64."""
    if not torch.compiler.is_exporting():
        return torch.lgamma(x + 1)
    # ONNX has no such operation. Stirling's series of Γ(x + 9), which is Γ(x + 1) times eight factors: 12 digits.
    y = x + 9.0
    inv, sq = y.reciprocal(), y.reciprocal().square()
    series = inv * (1 / 12 - sq * (1 / 360 - sq * (1 / 1260 - sq / 1680)))
    factors = math.prod(x + i for i in range(1, 9))
    return (y - 0.5) * y.log() - y + 0.5 * math.log(2.0 * math.pi) + series - torch.as_tensor(factors).log()
