"""Mixtures of sources, and batches of varying size."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import torch
from kornia.core.check import KORNIA_CHECK

from kornia_pnpnet.core.checks import check_whole
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.data.draws import batch_generator
from kornia_pnpnet.data.synthetic import SyntheticProblems
from kornia_pnpnet.types import Problems

__all__ = ["MixedProblems", "VaryingSize"]

# Added to the seed of the numbers of pairs. Large, because the sources have the seeds next to that of the stream.
_SIZES = 1_000_003


class MixedProblems:
    """Batches of problems that alternate between several sources.

    Args:
        sources: each makes a :class:`SyntheticProblems` from ``batch_size``, ``seed`` and ``options``, such as the
            class itself or a :func:`functools.partial` of it.
        shares: share of the batch of each source, up to a common factor; equal shares when ``None``.
        batch_size: number of problems per batch.
        seed: seed of the stream.
        options: options of all sources.

    Raises:
        BaseError: when the shares do not fit the sources or are not positive.

    Example:
        >>> from functools import partial
        >>> from kornia_pnpnet.data import SlabPoints
        >>> source = MixedProblems(
        ...     [SyntheticProblems, partial(SyntheticProblems, points=SlabPoints())], batch_size=5, n=4
        ... )
        >>> source.batch(0).world_points.shape
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
        shares = [1.0] * len(sources) if shares is None else list(shares)
        KORNIA_CHECK(
            len(shares) == len(sources) > 0 and min(shares) > 0 and sum(shares) < math.inf,
            f"MixedProblems needs one positive share for each source, got {shares} for {len(sources)} sources.",
        )
        self.batch_size = batch_size
        bounds = [round(batch_size * sum(shares[:i]) / sum(shares)) for i in range(len(shares) + 1)]
        sizes = [end - start for start, end in pairwise(bounds)]
        made = [
            source(batch_size=size, seed=seed, **options) for source, size in zip(sources, sizes, strict=True) if size
        ]
        self.sources = made
        # Sources take turns in proportion to their shares, so that the first problems of a batch are mixed like all.
        turns = [(turn + 0.5) / size for size in sizes for turn in range(size)]
        self._order = torch.tensor(sorted(range(batch_size), key=turns.__getitem__))

    def batch(self, index: int) -> Problems:
        """Draw batch ``index``.

        Args:
            index: at least 0.

        Returns:
            The problems.
        """
        count = len(self.sources)  # no two sources see the same random numbers
        parts = [source.batch(count * index + i) for i, source in enumerate(self.sources)]
        for name in ("img_sigma", "world_sigma"):
            parts = _with_sigmas_alike(parts, name)
        problems = map_tensors(lambda *x: torch.cat(x), *parts)
        order = self._order.to(problems.inliers.device)
        return problems.map(lambda x: x[order])


def _with_sigmas_alike(parts: list[Problems], name: str) -> list[Problems]:
    """Problems whose standard deviations of that name have one shape, with NaN for those that were ``None``."""
    dimensions = {sigma.ndim for part in parts if (sigma := getattr(part, name)) is not None}
    if not dimensions:
        return parts
    alike = []
    for part in parts:
        sigma = getattr(part, name)
        if sigma is None:
            sigma = part.world_points.new_full(part.world_points.shape[:1], torch.nan)
        if sigma.ndim < max(dimensions):
            sigma = sigma[:, None].expand(part.inliers.shape)
        alike.append(part._replace(**{name: sigma}))
    return alike


class VaryingSize:
    """Batches that differ in the number of pairs per problem and agree in the total number of pairs.

    Args:
        source: makes a source from ``n``, ``batch_size`` and ``seed``, such as a :func:`functools.partial` of
            :class:`MixedProblems`.
        n: numbers of pairs; each batch draws one.
        batch_size: number of problems in a batch of the smallest number of pairs; other batches have fewer problems.
        seed: seed of the stream.

    Raises:
        BaseError: when there is no number of pairs, or one below 1.

    Example:
        >>> source = VaryingSize(SyntheticProblems, n=(4, 8), batch_size=6)
        >>> sorted({tuple(source.batch(i).inliers.shape) for i in range(20)})
        [(3, 8), (6, 4)]
    """

    def __init__(
        self,
        source: Callable[..., SyntheticProblems | MixedProblems],
        *,
        n: Sequence[int],
        batch_size: int = 1000,
        seed: int = 0,
    ) -> None:
        KORNIA_CHECK(len(n) > 0, "VaryingSize needs at least one number of pairs.")
        for count in n:
            check_whole(1, n=count, batch_size=batch_size)
        self.batch_size = batch_size
        self.seed = seed
        self.sources = [
            source(n=count, batch_size=max(1, batch_size * min(n) // count), seed=seed + i) for i, count in enumerate(n)
        ]

    def batch(self, index: int) -> Problems:
        """Draw batch ``index``."""
        generator = batch_generator(self.seed + _SIZES, index)
        turn = int(torch.randint(len(self.sources), (), generator=generator))
        return self.sources[turn].batch(index)
