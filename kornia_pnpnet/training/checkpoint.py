"""Parts of a run that can be stopped, continued and watched: signals, checkpoints, learning curves, times."""

from __future__ import annotations

import csv
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch.utils.tensorboard import SummaryWriter

from kornia_pnpnet.core.files import atomic_open

__all__ = [
    "CHECKPOINT_NAME",
    "HISTORY_NAME",
    "History",
    "StageClock",
    "TrainingError",
    "load_checkpoint",
    "stop_on_signal",
]

CHECKPOINT_NAME, HISTORY_NAME = "last.ckpt", "history.csv"


class TrainingError(RuntimeError):
    """The training cannot go on or cannot be continued. The message names the reason and a remedy."""


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """Turn the first SIGTERM or Ctrl-C into an event, so that the loop can save before it ends.

    Signals can only be caught in the main thread; elsewhere the event is never set.
    """
    event = threading.Event()
    numbers = (signal.SIGTERM, signal.SIGINT) if threading.current_thread() is threading.main_thread() else ()
    before = {number: signal.getsignal(number) for number in numbers}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def stop(*_: object) -> None:
        event.set()
        restore()  # a second signal ends the process as usual

    for number in before:
        signal.signal(number, stop)
    try:
        yield event
    finally:
        restore()


class StageClock:
    """Wall-clock ``seconds`` of the stages of a loop, which add up to the time of the loop.

    The work of a GPU counts in the stage that waits for the result.
    """

    def __init__(self, *stages: str) -> None:
        self.seconds = dict.fromkeys(stages, 0.0)
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        now = time.perf_counter()
        self.seconds[stage] += now - self._last
        self._last = now

    def since(self, before: Mapping[str, float] | None = None) -> tuple[float, dict[str, float]]:
        """Seconds since ``before`` (an earlier copy of ``seconds``) or the start, and the share of each stage."""
        spent = {stage: seconds - (before or {}).get(stage, 0.0) for stage, seconds in self.seconds.items()}
        whole = max(sum(spent.values()), 1e-9)
        return whole, {stage: seconds / whole for stage, seconds in spent.items()}


class History:
    """Learning curves in one CSV file and TensorBoard. Rows of updates after ``start`` are dropped."""

    def __init__(self, folder: Path, columns: list[str], start: int) -> None:
        self._path = folder / HISTORY_NAME
        self._columns = columns
        rows: list[dict[str, Any]] = []
        if start and self._path.is_file():
            with self._path.open(newline="") as file:
                rows = [row for row in csv.DictReader(file) if None not in row.values()]  # a crash can cut the last row
            rows = [row for row in rows if row["update"].isdigit() and int(row["update"]) <= start]
        with atomic_open(self._path, newline="") as file:
            writer = csv.DictWriter(file, columns, restval="", extrasaction="ignore")
            writer.writeheader()
            writer.writerows(rows)
        self.board = SummaryWriter(folder / "tensorboard", purge_step=start or None)

    def write(self, row: dict[str, float]) -> None:
        """Append a row. The key ``update`` is required."""
        with self._path.open("a", newline="") as file:
            csv.DictWriter(file, self._columns, restval="").writerow(
                {key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()}
            )
        for key, value in row.items():
            if key != "update":
                self.board.add_scalar(key, value, int(row["update"]))


def load_checkpoint(path: Path, identity: dict[str, Any]) -> dict[str, Any]:
    """Read a checkpoint; ``TrainingError`` when the file is damaged or its identity is another one."""
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        there = _leaves(state["identity"])
    except Exception as error:  # torch.load raises many types on a damaged file
        raise TrainingError(f"Cannot read the checkpoint {path}: {error}") from error
    now = _leaves(identity)
    differing = [key for key in {**there, **now} if there.get(key) != now.get(key)]
    if differing:
        details = "; ".join(f"{key} was {there.get(key)!r} and is {now.get(key)!r}" for key in differing)
        raise TrainingError(f"The checkpoint {path} is of another run: {details}.")
    return state


def _leaves(value: Any, prefix: str = "") -> dict[str, Any]:
    """Nested plain data as ``{"a.b.0": leaf}``."""
    if isinstance(value, dict):
        entries = list(value.items())
    elif isinstance(value, (list, tuple)):
        entries = list(enumerate(value))
    else:
        return {prefix.removeprefix("."): value}
    return {k: v for key, entry in entries for k, v in _leaves(entry, f"{prefix}.{key}").items()}
