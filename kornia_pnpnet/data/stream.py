"""Streams of batches: worker processes draw the next batches while the caller works on the current batch."""

from __future__ import annotations

import atexit
import multiprocessing
import signal
from collections.abc import Generator
from typing import Any, Protocol

import torch
from torch.utils.data import DataLoader, Dataset

from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.result import Problems

__all__ = ["ProblemSource", "stream_batches"]

# Number of batches that each worker draws in advance. These batches last for the duration of a validation.
_AHEAD = 4


class ProblemSource(Protocol):
    """A source of problems. Equal indices give equal batches. For workers, all batches must have the same shape."""

    batch_size: int

    def batch(self, index: int) -> Problems:
        """Draw batch ``index``."""
        ...


def stream_batches(source: ProblemSource, start: int, stop: int, workers: int = 0) -> Generator[Problems, None, None]:
    """Yield the batches ``start``, …, ``stop - 1``.

    The workers end when the iterator is exhausted, closed or deleted, and at the latest when the process ends. Workers
    ignore Ctrl-C and the first SIGTERM, so that the caller decides when to stop.

    Args:
        source: the source of the problems. If the platform spawns processes instead of forking, the source must be
            picklable and the main module must be safe to import.
        start: index of the first batch.
        stop: index after the last batch.
        workers: number of worker processes. With 0, each batch is drawn on request. The problems do not depend on the
            number of workers. With workers, a batch is valid only until the next batch is requested.
    """
    if workers == 0 or start >= stop:
        yield from map(source.batch, range(start, stop))
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
        generator=torch.Generator(),  # else the loader would draw from PyTorch's global generator
        # In processes of joblib, the default start method is joblib's own. A loader cannot use this method.
        multiprocessing_context=None if multiprocessing.get_start_method() in methods else methods[0],
    )
    indices: Any = iter(loader)
    # At exit, multiprocessing sends one SIGTERM to each worker and waits. Workers ignore the first SIGTERM, so this
    # handler ends the workers first.
    atexit.register(indices._shutdown_workers)
    try:
        yield from map(slots.read, indices)
    finally:
        atexit.unregister(indices._shutdown_workers)
        indices._shutdown_workers()  # else a traceback that refers to `indices` keeps the workers alive


class _SharedSlots(Dataset[int]):
    """Shared memory for batches. A worker writes batch ``i`` into a slot and sends only ``i``.

    Sending the tensors would be slower, because every batch would allocate shared memory. One slot holds the caller's
    batch, and the other slots hold the batches drawn in advance.
    """

    def __init__(self, source: ProblemSource, example: Problems, slots: int) -> None:
        self._source, self._slots = source, slots
        self._memory = example.map(lambda x: torch.empty((slots, *x.shape), dtype=x.dtype).share_memory_())

    def __getitem__(self, index: int) -> int:
        map_tensors(torch.Tensor.copy_, self.read(index), self._source.batch(index))
        return index

    def read(self, index: int) -> Problems:
        """Return batch ``index`` as views of its slot."""
        return self._memory.map(lambda x: x[index % self._slots])


def _ignore_signals(_worker: int) -> None:
    """Ignore Ctrl-C and the first SIGTERM. A second SIGTERM ends the worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _frame: signal.signal(number, signal.SIG_DFL))
