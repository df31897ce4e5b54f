"""Streams of batches: worker processes draw the next batches while the caller works on the current batch."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Generator
from functools import partial
from multiprocessing.util import Finalize
from typing import Any, Protocol

import numpy as np
import torch
from torch.utils._pytree import tree_map_only
from torch.utils.data import DataLoader

from kornia_pnpnet.result import Problems

__all__ = ["ProblemSource", "stream_batches"]

# Number of batches that each worker draws in advance. Workers thus stay busy while the caller runs a validation.
_AHEAD = 4


class ProblemSource(Protocol):
    """A source of problems. Equal indices give equal batches."""

    batch_size: int

    def batch(self, index: int) -> Problems:
        """Draw batch ``index``."""


def stream_batches(source: ProblemSource, start: int, stop: int, workers: int = 0) -> Generator[Problems, None, None]:
    """Yield the batches ``start``, …, ``stop - 1``.

    The workers end when the iterator is exhausted, closed or deleted, and at the latest when the process ends. Workers
    ignore Ctrl-C and the first SIGTERM, so that the caller decides when to stop.

    Args:
        source: the source of the problems. If the platform spawns processes instead of forking, the source must be
            picklable and the main module must be safe to import.
        start: index of the first batch.
        stop: index after the last batch.
        workers: number of worker processes. With 0, the caller's process draws the batches. The problems do not depend
            on the number of workers.
    """
    if workers == 0:
        yield from map(source.batch, range(start, stop))
        return
    methods = multiprocessing.get_all_start_methods()
    indices: Any = range(start, stop)
    loader = DataLoader(
        indices,
        batch_size=None,
        collate_fn=partial(_draw_arrays, source),
        num_workers=workers,
        prefetch_factor=_AHEAD,
        worker_init_fn=_ignore_signals,
        generator=torch.Generator(),  # the loader must not draw from PyTorch's global generator
        # In joblib's processes, the default start method is joblib's own. A loader cannot use that method.
        multiprocessing_context=None if multiprocessing.get_start_method() in methods else methods[0],
    )
    with torch.device("cpu"):  # the loader's generator is on the CPU, even if PyTorch's default device is a GPU
        arrays: Any = iter(loader)
    # At exit, multiprocessing sends one SIGTERM to each worker and waits. Workers ignore the first SIGTERM, so this
    # finalizer ends the workers earlier.
    end_workers = Finalize(None, arrays._shutdown_workers, exitpriority=0)
    try:
        for batch in arrays:
            yield tree_map_only(np.ndarray, torch.from_numpy, batch)
    finally:
        end_workers()  # otherwise, a traceback that refers to `arrays` would keep the workers alive


def _draw_arrays(source: ProblemSource, index: int) -> Any:
    """Draw a batch as NumPy arrays. Tensors would be sent slowly, each through its own block of shared memory."""
    return tree_map_only(torch.Tensor, torch.Tensor.numpy, source.batch(index))


def _ignore_signals(_worker: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _frame: signal.signal(number, signal.SIG_DFL))
