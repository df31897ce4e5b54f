"""What lets a training run be stopped at any moment and continued: signals, checkpoints, learning curves."""

from __future__ import annotations

import csv
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch.utils.tensorboard import SummaryWriter

from kornia_pnpnet.files import atomic_open

__all__ = [
    "CHECKPOINT_NAME",
    "HISTORY_NAME",
    "History",
    "TrainingError",
    "load_checkpoint",
    "save_checkpoint",
    "stop_on_signal",
]

CHECKPOINT_NAME, HISTORY_NAME = "last.ckpt", "history.csv"


class TrainingError(RuntimeError):
    """The training cannot go on, or cannot be continued as asked; the message says why and what to do."""


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """Turn SIGTERM and Ctrl-C into an event, so that the loop can save before it ends."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    signals = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(number, lambda *_: event.set()) for number in signals]
    try:
        yield event
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)


class History:
    """Learning curves in one CSV file and TensorBoard.

    Args:
        folder: where they go.
        columns: of the CSV file; a row may leave some empty.
        start: rows of a former call that are later than this update are dropped.
    """

    def __init__(self, folder: Path, columns: list[str], start: int) -> None:
        self._path = folder / HISTORY_NAME
        self._columns = columns
        rows: list[dict[str, Any]] = []
        if start and self._path.is_file():
            with self._path.open(newline="") as file:
                rows = [row for row in csv.DictReader(file) if int(row["update"]) <= start]
        with atomic_open(self._path, newline="") as file:
            writer = csv.DictWriter(file, columns, restval="", extrasaction="ignore")
            writer.writeheader()
            writer.writerows(rows)
        self._board = SummaryWriter(folder / "tensorboard", purge_step=start or None)

    def write(self, row: dict[str, float]) -> None:
        """Append a row, which must have ``update``."""
        with self._path.open("a", newline="") as file:
            csv.DictWriter(file, self._columns, restval="").writerow(
                {key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()}
            )
        for key, value in row.items():
            if key != "update":
                self._board.add_scalar(key, value, int(row["update"]))

    def close(self) -> None:
        """Close TensorBoard's file."""
        self._board.close()


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint in one piece: a run killed at any moment leaves the old one or the new one."""
    with atomic_open(path, "wb") as file:
        torch.save(state, file)


def load_checkpoint(path: Path, identity: dict[str, Any]) -> dict[str, Any]:
    """Read a checkpoint.

    Args:
        path: what :func:`save_checkpoint` wrote. Only tensors and plain data are read; nothing is unpickled.
        identity: settings that must be those of the checkpoint's run.

    Returns:
        The state.

    Raises:
        TrainingError: when the file is damaged or of another run.
    """
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        saved = state["identity"]
    except Exception as error:  # torch.load raises many types on a damaged file
        raise TrainingError(f"Cannot read the checkpoint {path}: {error}") from error
    differing = sorted(key for key in identity if saved.get(key) != identity[key])
    if differing:
        details = "; ".join(f"{key}: {saved.get(key)!r} there, {identity[key]!r} now" for key in differing)
        raise TrainingError(f"The checkpoint {path} is of another run: {details}.")
    return state
