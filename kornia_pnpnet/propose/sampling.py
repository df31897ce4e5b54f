"""Draw samples of pairs, and compute how many samples suffice. Problems share only the random numbers."""

from __future__ import annotations

import itertools
import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from kornia_pnpnet.core.performance import kept_at_once, present_first
from kornia_pnpnet.problem import Problem

__all__ = ["Samples", "agreement_of_neighbours", "draw", "ranked", "samples_needed", "spread_evenly"]

# The _NEIGHBOURS nearest neighbours of a pair are found among at most _CANDIDATES pairs. The cost is therefore linear
# in the number of pairs. _CANDIDATES is a power of two because of the bit masks.
_NEIGHBOURS, _CANDIDATES = 16, 512
# The bits of the float32 infinity, read as an integer.
_INFINITE = 0x7F800000
# Number of distances that are computed at once on a CPU, so that they fit into a core's cache.
_BLOCK = 2**18
# Fractional parts of the multiples of the golden ratio are spread evenly over the unit interval.
_GOLDEN = 0.6180339887
# Pairs are ranked by u + _RANK[0] * v + _RANK[1] * d for a pixel (u, v) and the squared distance d of a point from the
# origin. Different pairs rarely have the same sum.
_RANK = 0.7548776662, 0.5698402910


@torch.no_grad()
def ranked(problem: Problem, present: Tensor) -> Tensor:
    """Find positions (B, N) that sort the pairs by their pixels and points. Absent pairs come last.

    If a search takes sorted pairs, its poses do not depend on the caller's order of the pairs.
    """
    u, v = problem.img_points.double().unbind(-1)  # in float32, rounding makes keys equal
    keys = u + _RANK[0] * v + _RANK[1] * problem.world_points.square().sum(-1)
    return torch.where(present, keys, torch.inf).argsort(stable=True)


@torch.no_grad()
def spread_evenly(present: Tensor, count: int) -> Tensor:
    """Indices (B, count) of present pairs, evenly spread. If fewer than ``count`` are present, absent pairs follow.

    Multiples of the golden ratio shift the positions slightly, so that the selection does not follow a periodic pattern
    in the order of the pairs. No position occurs twice, unless the problem has fewer than ``count`` pairs.
    """
    steps = torch.arange(count, dtype=torch.float64, device=present.device)
    total = present.sum(1, keepdim=True).clamp(min=count)
    most = ((1.0 - count / total) / (1.0 - _GOLDEN)).clamp(max=1.0)
    spread = (steps + most * ((_GOLDEN * steps) % 1.0)) * (total / count)
    return present_first(present).gather(1, spread.long().clamp(max=present.shape[1] - 1))


def draw(numbers: Tensor, upper: Tensor) -> Tensor:
    """Draw subsets (P, H, s) without replacement. Items of probability 0 are drawn only if no other items are left.

    ``numbers`` (H, s) are uniform in [0, 1). ``upper`` (P, N) are the cumulative probabilities of the items.
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

    An inlier has neighbours that are common to image and world. An outlier has common neighbours only by chance. A
    common neighbour of rank :math:`a` in the image and rank :math:`b` in the world adds :math:`1 / (1 + \max(a, b))` to
    the agreement. Neighbours with an equal pixel or point do not count, because they often repeat one incorrect match.

    Source: J. Bian et al., "GMS: Grid-based motion statistics for fast, ultra-robust feature correspondence", CVPR 2017
    (the idea, for matches between two images).
    """
    counts, width = there.sum(-1, keepdim=True), min(there.shape[1], _CANDIDATES)
    order = torch.arange(width, dtype=torch.int32, device=there.device)
    at = spread_evenly(there, width)  # (B, W)
    rank = torch.arange(min(_NEIGHBOURS, width), dtype=torch.float32, device=there.device)
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
    """The samples that RANSAC tries: all subsets of pairs in random order, or ``most`` samples if more subsets exist.

    Args:
        chances: relative chances that pairs are drawn, (B, N). A pair with the chance 0 is never drawn.
        size: number of pairs in a sample.
        most: largest number of samples.
        seed: seed of the random numbers, which are the same for every problem.

    Attributes:
        counts: number of pairs that have a positive chance, (B,).
        totals: number of samples of each problem, (B,).
    """

    def __init__(self, chances: Tensor, *, size: int, most: int, seed: int) -> None:
        there, device, self.size = chances > 0, chances.device, size
        self.counts = there.sum(-1)
        self._order = present_first(there)
        subsets = [min(math.comb(n, size), most + 1) for n in range(there.shape[1] + 1)]
        self.totals = torch.tensor(subsets, device=device)[self.counts]
        self._enumerated = self.totals <= most
        self.totals.clamp_(max=most)
        kinds, self._kinds = self.counts.where(self._enumerated, size).unique(return_inverse=True)
        tables = [_subsets(n, size, seed) for n in kinds.tolist()] or [_subsets(size, size, seed)]
        self._tables = pad_sequence(tables, batch_first=True).to(device)  # (K, L, s)
        self._numbers = None if bool(self._enumerated.all()) else _random_numbers(size, most, seed).to(device)
        share = torch.where(self._enumerated[:, None], there, chances.double())
        self._share = share / share.sum(-1, keepdim=True).clamp(min=torch.finfo(share.dtype).tiny)
        self._upper = self._share.gather(1, self._order).cumsum(-1)

    def positions(self, problems: Tensor, start: int, stop: int) -> Tensor:
        """Indices (P, H, s) of pairs in samples ``start`` to ``stop - 1``. After the last sample, samples repeat."""
        listed = torch.arange(start, stop, device=problems.device) % self.totals[problems, None]
        ranks = self._tables[self._kinds[problems, None], listed.clamp(max=self._tables.shape[1] - 1)]
        if self._numbers is not None:
            drawn = draw(self._numbers[start:stop], self._upper[problems])
            ranks = torch.where(self._enumerated[problems, None, None], ranks, drawn)
        return self._order[problems].gather(1, ranks.flatten(1)).view_as(ranks)

    def needed(self, problems: Tensor, inliers: Tensor, confidence: float) -> Tensor:
        """Apply :func:`samples_needed` to some problems (P,), given the inliers (P, N) of their best poses.

        Unequal chances p (of sum 1) count as n equal chances, where 1 / n = sum(p^2) / sum(p) over the inliers.
        """
        share = torch.where(inliers, self._share[problems], 0.0)
        mass = share.sum(-1)
        count = mass / share.square().sum(-1).clamp(min=torch.finfo(share.dtype).tiny)
        return samples_needed(mass * count, count, self.size, confidence)

    def spread(self, problems: Tensor, count: int) -> Tensor:
        """Indices (P, count) of the pairs at evenly spaced values of the cumulative chances."""
        at = (torch.arange(count, dtype=torch.float64, device=problems.device) + 0.5) / count
        ranks = torch.searchsorted(self._upper[problems], at.expand(len(problems), -1).contiguous(), right=True)
        return self._order[problems].gather(1, ranks.clamp(max=self._upper.shape[1] - 1))


@lru_cache(maxsize=64)
def _random_numbers(size: int, most: int, seed: int) -> Tensor:
    """Random numbers (most, size) from NumPy, because ``torch.func.jacfwd`` rejects PyTorch's random functions."""
    return torch.from_numpy(np.random.default_rng(seed).random((most, size)))


@lru_cache(maxsize=256)
def _subsets(count: int, size: int, seed: int) -> Tensor:
    """List all subsets (C, size) of ``size`` out of ``count`` items. The seed determines their random order."""
    table = torch.tensor([*itertools.combinations(range(max(count, size)), size)], device="cpu")
    return table[torch.from_numpy(np.random.default_rng(seed).permutation(len(table)))]


def samples_needed(inliers: Tensor, counts: Tensor, size: int, confidence: float) -> Tensor:
    r"""Number of samples needed for a probability ``confidence`` that at least one sample has no outlier, float64 (B,).

    The number is :math:`\log(1-p) / \log(1-w)` for the confidence :math:`p`. The share of samples without an outlier is
    :math:`w = \binom{k}{s} / \binom{c}{s}` for :math:`k` inliers of :math:`c` pairs. Fractional counts are allowed.
    Source: M. Fischler and R. Bolles, "Random sample consensus", Communications of the ACM 24(6), 1981, section II.B.
    """
    drawn = torch.arange(size, dtype=torch.float64, device=inliers.device)
    shares = (inliers[:, None] - drawn).clamp(min=0.0) / (counts[:, None] - drawn).clamp(min=1.0)
    return math.log1p(-confidence) / torch.log1p(-shares.prod(-1).clamp(max=1.0))
