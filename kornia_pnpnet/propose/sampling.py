r"""Samples of RANSAC: which subsets of the pairs are drawn, and how many samples suffice.

Problems share only the random numbers: a problem has the same samples alone and at any place in any batch.
"""

from __future__ import annotations

import itertools
import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from kornia_pnpnet.core.performance import present_first

__all__ = ["Samples", "agreement_of_neighbours", "draw", "kept_at_once", "samples_needed"]

# Nearest neighbours of a pair that are compared.
_NEIGHBOURS = 16
# Of more pairs than this, as many spread over all pairs are compared, so that the cost is linear. A power of two.
_CANDIDATES = 512
# The bits of an infinite float32.
_INFINITE = 0x7F800000
# Numbers of a block of distances, so that a processor's cache holds it.
_BLOCK = 2**18


def kept_at_once(count: int, like: Tensor) -> int:
    """How much is computed at once: ``count``, what the caches of a CPU's core hold, or 64 times as much elsewhere.

    A graphics processor is slow at many small operations, and its memory holds more.
    """
    return count if like.device.type == "cpu" else 64 * count


def draw(numbers: Tensor, upper: Tensor) -> Tensor:
    """Draw subsets of items one by one without replacement.

    Items of probability 0 are drawn only where there are too few others.

    Args:
        numbers: uniform in [0, 1), float64, shape (H, s).
        upper: cumulative probabilities of the items of each problem, float64, shape (P, N).

    Returns:
        Positions of the items, shape (P, H, s).
    """
    lower = torch.cat((torch.zeros_like(upper[:, :1]), upper[:, :-1]), 1)
    chosen: list[tuple[Tensor, Tensor]] = []  # where the interval of an item begins, and its length, ascending
    items = []
    left = torch.ones_like(upper[:, :1])
    for number in numbers.unbind(-1):
        at = number * left  # (P, H), among the intervals that are left
        for begin, length in chosen:
            at = at + torch.where(at >= begin, length, 0.0)
        item = torch.searchsorted(upper, at, right=True).clamp(max=upper.shape[1] - 1)
        items.append(item)
        begin, length = lower.gather(1, item), (upper - lower).gather(1, item)
        left = left - length
        for i, (other, size) in enumerate(chosen):
            swap = other > begin
            chosen[i] = torch.where(swap, begin, other), torch.where(swap, length, size)
            begin, length = torch.where(swap, other, begin), torch.where(swap, size, length)
        chosen.append((begin, length))
    return torch.stack(items, -1)


def agreement_of_neighbours(world_points: Tensor, img_points: Tensor, there: Tensor) -> Tensor:
    r"""How well the neighbours of each pair in the image agree with those in the world, (B, N), at least 0.

    What is seen side by side mostly lies side by side, so that inliers share neighbours; outliers share them by chance.
    A pair that is the :math:`a`-th nearest in the image and the :math:`b`-th nearest in the world, counted from 0 and
    both among 16, counts :math:`1 / (1 + \max(a, b))`. Pairs with the same pixel or the same point do not count: one
    wrong match that is made many times looks like this.

    Source: the idea is that of J. Bian et al., "GMS: Grid-based motion statistics for fast, ultra-robust feature
    correspondence", CVPR 2017, for matches between two images.

    Args:
        world_points: shape :math:`(B, N, 3)`.
        img_points: shape :math:`(B, N, 2)`.
        there: which pairs have a weight, bool, shape :math:`(B, N)`.
    """
    counts, width = there.sum(-1, keepdim=True), min(there.shape[1], _CANDIDATES)
    order = torch.arange(width, dtype=torch.int32, device=there.device)
    at = present_first(there).gather(1, order * counts.clamp(min=width) // width)  # (B, W)
    rank = torch.arange(min(_NEIGHBOURS, width), device=there.device)
    score = (1.0 + torch.maximum(rank[:, None], rank)).reciprocal().flatten()
    absent = (order >= counts)[:, None]
    world_points, img_points = world_points.float(), img_points.float()
    out = torch.empty_like(there, dtype=torch.float32)
    block = kept_at_once(_BLOCK, there)
    rows = torch.arange(there.shape[1], device=there.device).split(max(1, block // width))
    problems = torch.arange(len(there), device=there.device).split(max(1, block // (width * there.shape[1])))
    for some, here in itertools.product(problems, rows):
        both = [
            torch.cdist(x[some][:, here], x[some[:, None], at[some]], compute_mode="donot_use_mm_for_euclid_dist")
            for x in (world_points, img_points)
        ]  # exactly 0 between equal points
        no = (both[0] == 0).logical_or_(both[1] == 0).logical_or_(absent[some])
        # Distances as integers with the number of the pair in the last digits: they ascend alike, and differ.
        keys = [x.masked_fill_(no, torch.inf).view(torch.int32).bitwise_and_(-_CANDIDATES) for x in both]
        near, seen = (x.bitwise_or_(order).topk(len(rank), largest=False).values for x in keys)
        common = (near[..., :, None] & (_CANDIDATES - 1)) == (seen[..., None, :] & (_CANDIDATES - 1))
        common &= (near < _INFINITE)[..., :, None]
        out[some[:, None], here] = common.flatten(2).float() @ score
    return out


class Samples:
    """The samples that RANSAC tries, for every problem of a batch.

    When a problem has at most ``most`` subsets of its pairs, each subset is a sample once, in random order. Otherwise
    ``most`` samples are drawn.

    Args:
        there: which pairs have a weight, bool (B, N).
        size: number of pairs in a sample.
        most: largest number of samples.
        seed: seed of the random numbers, which are the same for every problem.
        chances: pairs are drawn in proportion to these numbers, at least 0, (B, N); ``None``: all equally likely.

    Attributes:
        counts: number of pairs that have a weight, (B,).
        totals: number of samples of each problem, (B,).

    Example:
        >>> samples = Samples(torch.ones(1, 4, dtype=torch.bool), size=3, most=10, seed=0)
        >>> samples.totals.tolist(), sorted(samples.positions(torch.tensor([0]), 0, 4)[0].tolist())
        ([4], [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])
    """

    def __init__(self, there: Tensor, *, size: int, most: int, seed: int, chances: Tensor | None = None) -> None:
        device = there.device
        self.size = size
        self.counts = there.sum(-1)
        self._order = present_first(there)
        subsets = [math.comb(n, size) for n in range(there.shape[1] + 1)]
        of_problem = torch.tensor(subsets, dtype=torch.float64, device=device)[self.counts]
        self.totals = of_problem.clamp(max=most).long()
        self._enumerated = of_problem <= most
        kinds, self._kinds = self.counts.where(self._enumerated, size).unique(return_inverse=True)
        tables = [_subsets(n, size, seed) for n in kinds.tolist()] or [_subsets(size, size, seed)]
        self._tables = pad_sequence(tables, batch_first=True).to(device)  # (K, L, s)
        self._numbers = None if bool(self._enumerated.all()) else _random_numbers(size, most, seed).to(device)
        share = there.double()
        if chances is not None:
            share = share * torch.where(self._enumerated[:, None], 1.0, chances)
        self._share = share / share.sum(-1, keepdim=True).clamp(min=torch.finfo(share.dtype).tiny)
        self._upper = self._share.gather(1, self._order).cumsum(-1)

    def positions(self, problems: Tensor, start: int, stop: int) -> Tensor:
        """Positions of the pairs of the samples ``start`` to ``stop - 1`` of some problems (P,), (P, H, s).

        Samples after the last one of a problem repeat others.
        """
        listed = torch.arange(start, stop, device=problems.device) % self.totals[problems, None]
        ranks = self._tables[self._kinds[problems, None], listed.clamp(max=self._tables.shape[1] - 1)]
        if self._numbers is not None:
            drawn = draw(self._numbers[start:stop], self._upper[problems])
            ranks = torch.where(self._enumerated[problems, None, None], ranks, drawn)
        return self._present(problems, ranks)

    def needed(self, problems: Tensor, inliers: Tensor, confidence: float) -> Tensor:
        """:func:`samples_needed` of some problems (P,) with the inliers (P, N) of their best poses so far.

        Where pairs are unequally likely, the formula reads an effective number of pairs: one over the mean share of an
        inlier. The mean is weighted by the share.
        """
        share = torch.where(inliers, self._share[problems], 0.0)
        mass = share.sum(-1)
        count = mass / share.square().sum(-1).clamp(min=torch.finfo(share.dtype).tiny)
        return samples_needed(mass * count, count, self.size, confidence)

    def spread(self, problems: Tensor, count: int) -> Tensor:
        """Positions of ``count`` pairs spread evenly over the pairs that have a weight, (P, count).

        :class:`~kornia_pnpnet.frame.Normalize` orders pairs by their pixels: these are spread over the image. Where
        pairs are unequally likely, likely ones come more often.
        """
        at = (torch.arange(count, dtype=torch.float64, device=problems.device) + 0.5) / count
        ranks = torch.searchsorted(self._upper[problems], at.expand(len(problems), -1).contiguous(), right=True)
        return self._present(problems, ranks.clamp(max=self._upper.shape[1] - 1))

    def _present(self, problems: Tensor, ranks: Tensor) -> Tensor:
        """Positions of pairs from their ranks (P, ...) among the pairs that have a weight."""
        return self._order[problems].gather(1, ranks.flatten(1)).view_as(ranks)


@lru_cache(maxsize=64)
def _random_numbers(size: int, most: int, seed: int) -> Tensor:
    """Uniform numbers in [0, 1), (most, size), on the CPU. NumPy's: ``torch.func.jacfwd`` refuses those of PyTorch."""
    return torch.from_numpy(np.random.default_rng(seed).random((most, size)))


@lru_cache(maxsize=256)
def _subsets(count: int, size: int, seed: int) -> Tensor:
    """All subsets of ``count`` items in an order that the seed fixes, (C, size), on the CPU."""
    table = torch.combinations(torch.arange(max(count, size), device="cpu"), size)
    return table[torch.from_numpy(np.random.default_rng(seed).permutation(len(table)))]


def samples_needed(inliers: Tensor, counts: Tensor, size: int, confidence: float) -> Tensor:
    r"""Number of samples of which at least one has no outlier with the confidence :math:`p`, float64 (B,).

    It is :math:`\log(1-p) / \log(1-w)` with the share :math:`w = \binom{k}{s} / \binom{c}{s}` of samples of :math:`s`
    pairs without an outlier, of :math:`k` inliers (B,), whole or not, of :math:`c` pairs (B,).

    Source: M. Fischler and R. Bolles, "Random sample consensus", Communications of the ACM 24(6), 1981, section II.B.

    Example:
        >>> samples_needed(torch.tensor([9, 6, 2]), torch.tensor([9, 9, 9]), 3, 0.999)
        tensor([ 0.0000, 25.4023,     inf], dtype=torch.float64)
    """
    share = torch.ones_like(inliers, dtype=torch.float64)
    for j in range(size):
        share = share * (inliers - j).clamp(min=0) / (counts - j).clamp(min=1)
    return math.log1p(-confidence) / torch.log1p(-share.clamp(max=1.0))
