"""Streams of batches: other processes draw the next batches while the caller works on the current batch."""

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

# Batches that each worker draws in advance: enough to keep drawing during a validation.
_AHEAD = 4


class ProblemSource(Protocol):
    """A source of problems: batch ``i`` always has the same numbers, and all batches have one shape."""

    batch_size: int

    def batch(self, index: int) -> Problems:
        """Draw batch ``index``."""
        ...


def stream_batches(source: ProblemSource, start: int, stop: int, workers: int = 0) -> Generator[Problems, None, None]:
    """Yield the batches from ``start`` to ``stop``, excluding ``stop``.

    The workers end when the iterator is exhausted, closed or deleted, at the latest with the process. SIGTERM and
    Ctrl-C, which often reach a whole group of processes, do not end the workers: the caller decides what to do.

    Args:
        source: the source of the problems. Where processes are spawned rather than forked, the source must be
            picklable and the main module safe to import.
        start: number of the first batch.
        stop: number after the last batch.
        workers: number of processes that draw ahead; 0 draws each batch when it is requested. The numbers drawn do not
            depend on the number of workers. With workers the memory of a batch is reused for the next batch.
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
        generator=torch.Generator(),  # not the global generator, whose state is the caller's
        # In joblib's processes the default start method is joblib's own, which a loader cannot use.
        multiprocessing_context=None if multiprocessing.get_start_method() in methods else methods[0],
    )
    indices: Any = iter(loader)
    # A stream may be left open until the interpreter ends. The workers must end before multiprocessing's own exit waits
    # for them: it sends one SIGTERM, which they ignore.
    atexit.register(indices._shutdown_workers)
    try:
        yield from map(slots.read, indices)
    finally:
        atexit.unregister(indices._shutdown_workers)
        indices._shutdown_workers()  # else they live as long as the traceback of an error that refers to them


class _SharedSlots(Dataset[int]):
    """Draws batch ``i`` into a slot of memory that all processes share, so that processes exchange only ``i``.

    Tensors that are sent become new shared memory each time, which takes about as long as drawing them. There is one
    slot more than batches drawn in advance, so that the caller's batch is not overwritten.
    """

    def __init__(self, source: ProblemSource, example: Problems, slots: int) -> None:
        self._source, self._slots = source, slots
        self._memory = example.map(lambda x: torch.empty((slots, *x.shape), dtype=x.dtype).share_memory_())

    def __getitem__(self, index: int) -> int:
        map_tensors(torch.Tensor.copy_, self.read(index), self._source.batch(index))
        return index

    def read(self, index: int) -> Problems:
        """The slot of batch ``index``."""
        return self._memory.map(lambda x: x[index % self._slots])


def _ignore_signals(_worker: int) -> None:
    """Leave Ctrl-C and the first SIGTERM to the main process; a second SIGTERM ends the worker as usual."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _frame: signal.signal(number, signal.SIG_DFL))
