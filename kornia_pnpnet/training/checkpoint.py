"""Stopping, continuing and monitoring a run: signals, checkpoints, learning curves, and the time of each stage."""

from __future__ import annotations

import csv
import signal
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import torch
from torch.utils.tensorboard import SummaryWriter

from kornia_pnpnet.core.files import atomic_open
from kornia_pnpnet.evaluation.results import differences

CHECKPOINT_NAME, HISTORY_NAME = "last.ckpt", "history.csv"


class TrainingError(RuntimeError):
    """A training run cannot go on, or a stopped run cannot be continued. The message names the reason."""


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """Turn the first SIGTERM or Ctrl-C into an event, so that the training loop can save a checkpoint before the end.

    Only the main thread can catch signals. In other threads the event is never set.
    """
    event = threading.Event()
    with ExitStack() as handlers:

        def stop(*_: object) -> None:
            event.set()
            handlers.close()  # restores the earlier handlers: a second signal ends the process as usual

        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):
                handlers.callback(signal.signal, number, signal.signal(number, stop))
        yield event


class StageClock:
    """Wall-clock ``seconds`` of each stage of a loop. GPU work counts towards the stage that waits for the GPU."""

    def __init__(self, *stages: str) -> None:
        self.seconds = dict.fromkeys(stages, 0.0)
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        now = time.perf_counter()
        self.seconds[stage] += now - self._last
        self._last = now


def write_csv(path: Path, columns: Iterable[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a CSV file atomically. Missing values become empty cells."""
    with atomic_open(path, newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(columns), extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)


class History:
    """Learning curves in a CSV file and in TensorBoard. Earlier rows with ``update > start`` are removed."""

    def __init__(self, folder: Path, columns: list[str], start: int) -> None:
        self._path, self._columns = folder / HISTORY_NAME, [*columns]
        rows: list[dict[str, Any]] = []
        if start and self._path.is_file():
            with self._path.open(newline="", encoding="utf-8") as file:  # a crash can cut the last row
                rows = [row for row in csv.DictReader(file) if None not in row.values() and int(row["update"]) <= start]
        self._columns += [name for name in (rows[0] if rows else ()) if name not in columns]  # of removed sets
        write_csv(self._path, self._columns, rows)
        self.board = SummaryWriter(folder / "tensorboard", purge_step=start + 1)

    def write(self, row: dict[str, float]) -> None:
        """Append a row, which must have the key ``update``."""
        with self._path.open("a", newline="", encoding="utf-8") as file:
            cells = {key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()}
            csv.DictWriter(file, self._columns).writerow(cells)
        for key, value in row.items():
            if key != "update":
                self.board.add_scalar(key, value, int(row["update"]))


# Settings that may change when a run continues. The weights do not depend on them.
_FREE = ("max_skipped", "log_every", "validate_every", "checkpoint_every")


def load_checkpoint(path: Path, identity: dict[str, Any]) -> dict[str, Any]:
    """Read a checkpoint.

    Raise ``TrainingError`` if the file is damaged or has another identity. Fewer ``updates`` in the file are allowed,
    and other values of ``_FREE``.
    """
    now = identity["settings"]
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        settings = state["identity"]["settings"] | {name: now[name] for name in _FREE}
        settings["updates"] = max(settings["updates"], now["updates"])  # a run may become longer
        found = differences({**state["identity"], "settings": settings}, identity)
    except Exception as error:  # torch.load raises many types of errors on a damaged file
        raise TrainingError(f"Cannot read the checkpoint {path}: {error}") from error
    if found:
        raise TrainingError(f"The checkpoint {path} is of another run: {'; '.join(found)}.")
    return state
