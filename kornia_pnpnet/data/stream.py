"""Batches in order, drawn by another process while the caller works on the one before."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Generator
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from kornia_pnpnet.types import Problems

__all__ = ["ProblemSource", "stream_batches"]

# Batches that each worker is asked for in advance: enough to go on through the pause of a validation.
_AHEAD = 4


class ProblemSource(Protocol):
    """What draws batch ``i``: always the same numbers, and all batches of one shape."""

    batch_size: int

    def batch(self, index: int) -> Problems:
        """Draw batch ``index``."""
        ...


def stream_batches(source: ProblemSource, start: int, stop: int, workers: int = 0) -> Generator[Problems, None, None]:
    """Yield the batches from ``start`` to ``stop``, excluding ``stop``.

    Close the iterator (or exhaust it) to end the workers. SIGTERM and Ctrl-C, which often reach a whole group of
    processes, do not end them: what to do then is for the caller to decide.

    Args:
        source: what to draw from. Where processes are spawned rather than forked it must be possible to pickle it, and
            the main module must be safe to import.
        start: the first batch.
        stop: the one after the last.
        workers: processes that draw ahead; 0 draws each batch when it is asked for. The numbers are the same.

    Yields:
        The problems. With workers they lie in memory that is used again: a batch is gone when the next is asked for.

    Raises:
        Exception: what a worker raised, with its traceback in the message.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> source = SyntheticProblems(n=9, batch_size=2)
        >>> batches = stream_batches(source, 0, 2)
        >>> [torch.equal(batch.img_points, source.batch(i).img_points) for i, batch in enumerate(batches)]
        [True, True]
    """
    if workers == 0:
        yield from map(source.batch, range(start, stop))
        return
    if start >= stop:
        return
    slots = _SharedSlots(source, source.batch(start), slots=workers * _AHEAD + 1)
    methods = multiprocessing.get_all_start_methods()
    loader = DataLoader(
        slots,
        sampler=range(start, stop),
        batch_size=None,
        num_workers=workers,
        prefetch_factor=_AHEAD,
        worker_init_fn=_ignore_signals,
        generator=torch.Generator(),  # not the global one, whose state is the caller's
        # In its processes joblib puts a way of its own in place of the default, by which a loader cannot start any.
        multiprocessing_context=None if multiprocessing.get_start_method() in methods else methods[0],
    )
    indices: Any = iter(loader)
    try:
        yield from map(slots.read, indices)
    finally:
        indices._shutdown_workers()  # else they live as long as the traceback of an error that refers to them


class _SharedSlots(Dataset[int]):
    """Draws batch ``i`` into one of some slots in memory that all processes share, so that only ``i`` is sent.

    Sent as they are, tensors become new shared memory each time, which takes about as long as drawing them. One slot
    more than batches are asked for in advance keeps the caller's batch from being overwritten.
    """

    def __init__(self, source: ProblemSource, example: Problems, slots: int) -> None:
        self._source = source
        self._slots = slots
        self._memory = example.map(lambda x: torch.empty((slots, *x.shape), dtype=x.dtype).share_memory_())

    def __getitem__(self, index: int) -> int:
        for slot, drawn in zip(_tensors(self.read(index)), _tensors(self._source.batch(index)), strict=True):
            slot.copy_(drawn)
        return index

    def read(self, index: int) -> Problems:
        """The slot of batch ``index``."""
        return self._memory.map(lambda x: x[index % self._slots])


def _tensors(problems: Problems) -> tuple[Tensor, ...]:
    return (*problems[:3], *problems.pose, problems.inliers)


def _ignore_signals(_worker: int) -> None:
    """Leave Ctrl-C and the first SIGTERM to the main process; a second SIGTERM ends the worker as usual."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _frame: signal.signal(number, signal.SIG_DFL))
