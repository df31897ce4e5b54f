r"""Draw the samples of RANSAC, and compute how many samples suffice.

Problems share only the random numbers. The samples of a problem do not depend on the rest of the batch.
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

# Number of nearest neighbours of a pair that are compared.
_NEIGHBOURS = 16
# Neighbours are searched among at most this number of pairs, which are a subsample spread evenly over all pairs. The
# cost is therefore linear in the number of pairs. The number must be a power of two.
_CANDIDATES = 512
# The bits of an infinite float32.
_INFINITE = 0x7F800000
# Number of distances that are computed at once on a CPU, so that they fit into a core's cache.
_BLOCK = 2**18


def kept_at_once(count: int, like: Tensor) -> int:
    """Size of a block that is computed at once: ``count`` on a CPU (limited by a core's caches), else 64 ``count``."""
    return count if like.device.type == "cpu" else 64 * count


def draw(numbers: Tensor, upper: Tensor) -> Tensor:
    """Draw subsets of items without replacement.

    Items of probability 0 are drawn only when too few items have a positive probability.

    Args:
        numbers: random numbers, uniform in [0, 1), float64, shape (H, s).
        upper: cumulative probabilities of the items of each problem, float64, shape (P, N).

    Returns:
        Positions of the items, shape (P, H, s).
    """
    lower = torch.cat((torch.zeros_like(upper[:, :1]), upper[:, :-1]), 1)
    chosen: list[tuple[Tensor, Tensor]] = []  # starts and lengths of the intervals of drawn items, ascending
    items = []
    left = torch.ones_like(upper[:, :1])
    for number in numbers.unbind(-1):
        at = number * left  # (P, H), position in the concatenation of the remaining intervals
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
    r"""Agreement (B, N) between each pair's nearest neighbours in the image and its nearest neighbours in the world.

    Points that are close in the image are mostly close in the world. An inlier therefore has common neighbours in both
    spaces. An outlier has common neighbours only by chance. The 16 nearest neighbours of each pair are compared. Let a
    common neighbour have the rank :math:`a` in the image and the rank :math:`b` in the world, counted from 0. This
    neighbour adds :math:`1 / (1 + \max(a, b))` to the agreement. Pairs with equal pixels or equal points do not count
    as neighbours, because such pairs often repeat one incorrect match.

    Source: J. Bian et al., "GMS: Grid-based motion statistics for fast, ultra-robust feature correspondence", CVPR 2017
    (the idea, for matches between two images).

    Args:
        world_points: shape :math:`(B, N, 3)`.
        img_points: shape :math:`(B, N, 2)`.
        there: which pairs have a positive weight, bool, shape :math:`(B, N)`.
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
        ]  # the distance between equal points is exactly 0
        no = (both[0] == 0).logical_or_(both[1] == 0).logical_or_(absent[some])
        # The bits of positive floats, read as integers, sort like the floats. The index of the neighbour replaces the
        # last bits, so that no two keys are equal.
        keys = [x.masked_fill_(no, torch.inf).view(torch.int32).bitwise_and_(-_CANDIDATES) for x in both]
        near, seen = (x.bitwise_or_(order).topk(len(rank), largest=False).values for x in keys)
        common = (near[..., :, None] & (_CANDIDATES - 1)) == (seen[..., None, :] & (_CANDIDATES - 1))
        common &= (near < _INFINITE)[..., :, None]
        out[some[:, None], here] = common.flatten(2).float() @ score
    return out


class Samples:
    """The samples that RANSAC tries, for every problem of a batch.

    If a problem has at most ``most`` subsets of ``size`` pairs, each subset is one sample. The order of these samples
    is random. Otherwise ``most`` samples are drawn at random.

    Args:
        there: which pairs have a positive weight, bool (B, N).
        size: number of pairs in a sample.
        most: largest number of samples.
        seed: seed of the random numbers, which are the same for every problem.
        chances: relative chances, at least 0, that pairs are drawn, (B, N); ``None``: equal chances.

    Attributes:
        counts: number of pairs that have a positive weight, (B,).
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
        """Positions (P, H, s) of the pairs in the samples ``start`` to ``stop - 1`` of some problems (P,).

        If a problem has fewer than ``stop`` samples, its first samples are repeated.
        """
        listed = torch.arange(start, stop, device=problems.device) % self.totals[problems, None]
        ranks = self._tables[self._kinds[problems, None], listed.clamp(max=self._tables.shape[1] - 1)]
        if self._numbers is not None:
            drawn = draw(self._numbers[start:stop], self._upper[problems])
            ranks = torch.where(self._enumerated[problems, None, None], ranks, drawn)
        return self._present(problems, ranks)

    def needed(self, problems: Tensor, inliers: Tensor, confidence: float) -> Tensor:
        """Apply :func:`samples_needed` to some problems (P,), given the inliers (P, N) of their best poses.

        With unequal chances, the inverse of the inliers' mean chance replaces the number of pairs. The chances of a
        problem have the sum 1. The mean is weighted by the chances themselves.
        """
        share = torch.where(inliers, self._share[problems], 0.0)
        mass = share.sum(-1)
        count = mass / share.square().sum(-1).clamp(min=torch.finfo(share.dtype).tiny)
        return samples_needed(mass * count, count, self.size, confidence)

    def spread(self, problems: Tensor, count: int) -> Tensor:
        """Select ``count`` pairs, spread evenly over the pairs of positive weight. Returns positions (P, count).

        The selected pairs are spread over the image, because :class:`~kornia_pnpnet.frame.Normalize` orders pairs by
        their pixels. Pairs are selected in proportion to their chances.
        """
        at = (torch.arange(count, dtype=torch.float64, device=problems.device) + 0.5) / count
        ranks = torch.searchsorted(self._upper[problems], at.expand(len(problems), -1).contiguous(), right=True)
        return self._present(problems, ranks.clamp(max=self._upper.shape[1] - 1))

    def _present(self, problems: Tensor, ranks: Tensor) -> Tensor:
        """Convert ranks (P, ...) among the pairs of positive weight to positions in the problems."""
        return self._order[problems].gather(1, ranks.flatten(1)).view_as(ranks)


@lru_cache(maxsize=64)
def _random_numbers(size: int, most: int, seed: int) -> Tensor:
    """Random numbers (most, size) from NumPy, because ``torch.func.jacfwd`` rejects PyTorch's random functions."""
    return torch.from_numpy(np.random.default_rng(seed).random((most, size)))


@lru_cache(maxsize=256)
def _subsets(count: int, size: int, seed: int) -> Tensor:
    """List all subsets of ``size`` among ``count`` items, (C, size). The seed determines their random order."""
    table = torch.combinations(torch.arange(max(count, size), device="cpu"), size)
    return table[torch.from_numpy(np.random.default_rng(seed).permutation(len(table)))]


def samples_needed(inliers: Tensor, counts: Tensor, size: int, confidence: float) -> Tensor:
    r"""Number of samples needed for a probability :math:`p` that at least one sample has no outlier, float64 (B,).

    The number is :math:`\log(1-p) / \log(1-w)`, where :math:`w = \binom{k}{s} / \binom{c}{s}` is the share of samples
    without an outlier.

    Args:
        inliers: number :math:`k` of inliers, not necessarily an integer, shape (B,).
        counts: number :math:`c` of pairs, not necessarily an integer, shape (B,).
        size: number :math:`s` of pairs in a sample.
        confidence: the probability :math:`p`.

    Source: M. Fischler and R. Bolles, "Random sample consensus", Communications of the ACM 24(6), 1981, section II.B.

    Example:
        >>> samples_needed(torch.tensor([9, 6, 2]), torch.tensor([9, 9, 9]), 3, 0.999)
        tensor([ 0.0000, 25.4023,     inf], dtype=torch.float64)
    """
    share = torch.ones_like(inliers, dtype=torch.float64)
    for j in range(size):
        share = share * (inliers - j).clamp(min=0) / (counts - j).clamp(min=1)
    return math.log1p(-confidence) / torch.log1p(-share.clamp(max=1.0))
