"""Mixtures of sources, mixtures of priors, and batches that differ in the number of pairs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from itertools import pairwise
from typing import Any

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor

from kornia_pnpnet.core.checks import check_whole, expand_sigma
from kornia_pnpnet.core.trees import map_tensors, take
from kornia_pnpnet.data.draws import batch_generator, unit
from kornia_pnpnet.data.points import PointPrior
from kornia_pnpnet.data.synthetic import SyntheticProblems
from kornia_pnpnet.result import Problems

__all__ = ["MixedPoints", "MixedProblems", "VaryingSize"]

# `VaryingSize` draws numbers of pairs with the seed `seed + _SIZES`. The sources use the seeds `seed`, `seed + 1`, ...
_SIZES = 1_000_003


class MixedProblems:
    """Batches that mix the problems of several sources.

    Args:
        sources: constructors of the sources, called with ``batch_size``, ``seed`` and ``options``. A constructor is
            :class:`SyntheticProblems` or a :func:`functools.partial` of :class:`SyntheticProblems`.
        shares: one positive number per source. The number of problems of a source is proportional to its share
            and rounded: a small batch may have no problem of a source. ``None`` means equal shares.
        batch_size: number of problems per batch.
        seed: seed of the stream.
        options: further arguments of all constructors.

    Raises:
        BaseError: raised by ``batch`` when only some sources give covariances.

    Example:
        >>> from functools import partial
        >>> from kornia_pnpnet.data import SlabPoints
        >>> slabs = partial(SyntheticProblems, points=SlabPoints())
        >>> MixedProblems([SyntheticProblems, slabs], batch_size=5, n=4).batch(0).world_points.shape
        torch.Size([5, 4, 3])
    """

    def __init__(
        self,
        sources: Sequence[Callable[..., SyntheticProblems]],
        *,
        shares: Sequence[float] | None = None,
        batch_size: int = 1000,
        seed: int = 0,
        **options: Any,
    ) -> None:
        check_whole(1, batch_size=batch_size)
        shares = _checked_shares("source", len(sources), shares)
        self.batch_size = batch_size
        sizes = _split(batch_size, shares, round)
        parts = zip(sources, sizes, strict=True)
        self.sources = [source(batch_size=size, seed=seed, **options) for source, size in parts if size]
        # Sources are interleaved, so that every range of a batch has approximately the shares of the whole batch.
        turns = [(turn + 0.5) / size for size in sizes for turn in range(size)]
        self._order = torch.tensor(sorted(range(batch_size), key=turns.__getitem__), device="cpu")

    def batch(self, index: int) -> Problems:
        """Draw a batch; the first index is 0."""
        count = len(self.sources)  # sources get different indices and thus draw different random numbers
        parts = [source.batch(count * index + i) for i, source in enumerate(self.sources)]
        with_covariances = sum(part.img_cov is not None for part in parts)
        KORNIA_CHECK(with_covariances in (0, count), "All sources of a mixture must give covariances, or none of them.")
        for name in ("img_sigma", "world_sigma", "confidence"):
            parts = _alike(parts, name)
        problems = map_tensors(lambda *x: torch.cat(x), *parts)
        return take(problems, self._order.to(problems.inliers.device))


def _checked_shares(what: str, count: int, shares: Sequence[float] | None) -> list[float]:
    shares = [1.0] * count if shares is None else list(shares)
    KORNIA_CHECK(
        len(shares) == count > 0 and min(shares) > 0 and sum(shares) < math.inf,
        f"A mixture needs one positive share for each {what}, got {shares} for {count} {what}s.",
    )
    return shares


def _split(batch_size: int, shares: Sequence[float], rounded: Callable[[float], int]) -> list[int]:
    """Split a batch in proportion to the shares; ``rounded`` rounds the bounds between the parts to integers."""
    bounds = [rounded(batch_size * sum(shares[:i]) / sum(shares)) for i in range(len(shares))]
    return [end - start for start, end in pairwise([*bounds, batch_size])]


def _alike(parts: list[Problems], name: str) -> list[Problems]:
    """Give a field the same number of dimensions in all parts. If some parts have the field, the others get NaN."""
    values = [getattr(part, name) for part in parts]
    dimensions = {0 if value is None else value.ndim for value in values}
    if len(dimensions) == 1:
        return parts
    values = [expand_sigma(name, value, part.world_points) for value, part in zip(values, parts, strict=True)]
    if 2 not in dimensions:
        values = [value[:, 0] for value in values]
    return [part._replace(**{name: value}) for value, part in zip(values, parts, strict=True)]


class MixedPoints:
    """A prior that draws the points of each problem from one of several priors.

    Args:
        priors: the priors.
        shares: one positive number per prior, as in :class:`MixedProblems`.
    """

    def __init__(self, priors: Sequence[PointPrior], *, shares: Sequence[float] | None = None) -> None:
        self.priors = list(priors)
        self.shares = _checked_shares("prior", len(self.priors), shares)

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """See :class:`PointPrior`."""
        # A random offset before rounding gives each prior its share on average, also in small batches.
        offset = unit((), generator).item()
        sizes = _split(batch_size, self.shares, lambda bound: math.floor(bound + offset))
        drawn = [prior(size, n, generator) for prior, size in zip(self.priors, sizes, strict=True) if size]
        return torch.cat(drawn)[unit((batch_size,), generator).argsort()]


@dataclass(eq=False)
class VaryingSize:
    """Batches that differ in the number of pairs per problem, but hardly in the total number of pairs.

    Args:
        source: constructor of a source, called with ``n``, ``batch_size`` and ``seed``.
        n: numbers of pairs per problem. Each batch draws one of these numbers.
        batch_size: number of problems in a batch with the smallest ``n``. Other batches have fewer problems.
        seed: seed of the stream.

    Example:
        >>> source = VaryingSize(SyntheticProblems, n=(4, 8), batch_size=6)
        >>> sorted({tuple(source.batch(i).inliers.shape) for i in range(20)})
        [(3, 8), (6, 4)]
    """

    source: Callable[..., SyntheticProblems | MixedProblems]
    _: KW_ONLY
    n: Sequence[int]
    batch_size: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        KORNIA_CHECK(len(self.n) > 0, "VaryingSize needs at least one number of pairs.")
        for n in self.n:
            check_whole(1, n=n, batch_size=self.batch_size)
        most = self.batch_size * min(self.n)
        sizes = [(n, max(1, most // n), self.seed + i) for i, n in enumerate(self.n)]
        self.sources = [self.source(n=n, batch_size=batch_size, seed=seed) for n, batch_size, seed in sizes]

    def batch(self, index: int) -> Problems:
        """Draw a batch; the first index is 0."""
        generator = batch_generator(self.seed + _SIZES, index)
        turn = int(torch.randint(len(self.sources), (), generator=generator, device="cpu"))
        return self.sources[turn].batch(index)
