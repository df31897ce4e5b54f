"""What the benchmarks share: threads, timing in turns, the memory of a process, and processes of their own."""

from __future__ import annotations

import gc
import json
import math
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from kornia_pnpnet.core.performance import keep_freed_memory

HERE = Path(__file__).resolve().parent


@contextmanager
def threads(count: int = 1) -> Iterator[None]:
    """Run PyTorch and OpenCV on ``count`` threads, and restore both settings of the process afterwards.

    The allocator is set as the documentation advises for large batches.
    """
    keep_freed_memory()
    cv2 = sys.modules.get("cv2")  # its solvers have imported it
    before = torch.get_num_threads(), None if cv2 is None else cv2.getNumThreads()
    torch.set_num_threads(count)
    if cv2 is not None:
        cv2.setNumThreads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        if cv2 is not None:
            cv2.setNumThreads(before[1])


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Do not collect garbage, as in :mod:`timeit`."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


def load() -> float:
    """Load average of the last minute. Well above the number of threads, times are not to be trusted."""
    return os.getloadavg()[0]


def seconds(call: Callable[[], object], times: int = 1) -> float:
    """Seconds of a call, the mean over ``times`` calls."""
    start = time.perf_counter()
    for _ in range(times):
        call()
    return (time.perf_counter() - start) / times


def in_turns(timers: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, list[float]]:
    """Ask each timer once in every round, so that a slow minute of the machine hits all of them."""
    found: dict[str, list[float]] = {name: [] for name in timers}
    with without_garbage_collection():
        for _ in range(rounds):
            for name, timer in timers.items():
                found[name].append(timer())
    return found


def summary(rounds_us: Sequence[float]) -> dict[str, Any]:
    """Median, minimum and all of the times of the rounds."""
    return {"median_us": statistics.median(rounds_us), "min_us": min(rounds_us), "rounds_us": list(rounds_us)}


def ratio(mine: Mapping[str, Any], theirs: Mapping[str, Any]) -> float:
    """Time of theirs by time of mine: the median over the rounds of the ratio in the same round."""
    rounds = zip(theirs["rounds_us"], mine["rounds_us"], strict=True)
    return statistics.median(other / own for other, own in rounds)


def quantiles(values: Sequence[float], steps: int) -> list[float]:
    """Quantiles at 0, 1/steps, ..., 1. Each is one of the values."""
    ascending = sorted(values)
    return [ascending[max(0, math.ceil(step / steps * len(ascending)) - 1)] for step in range(steps + 1)]


def peak_bytes() -> int:
    """Peak memory of this process (Linux). ``getrusage`` can include the process that started this one."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))


def run_child(script: Path, *arguments: str, **environment: str) -> Any:
    """Run a script in a process of its own and return the JSON that it prints. Its standard error is shown at once.

    Raises:
        RuntimeError: when the script fails.
    """
    command = [sys.executable, str(script), *arguments]
    variables = {**os.environ, **environment}
    output = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False, env=variables)
    if output.returncode:
        raise RuntimeError(f"{' '.join(command)} failed; its error is above.")
    return json.loads(output.stdout)


def target(what: str, measured: float, wanted: float, *, unit: str, at_most: bool) -> dict[str, Any]:
    """A target beside the measurement, and whether the target is met."""
    met = measured <= wanted if at_most else measured >= wanted
    return {"what": what, "measured": measured, "target": wanted, "unit": unit, "at_most": at_most, "met": met}


def say(text: str) -> None:
    """Write a line of progress."""
    print(text, file=sys.stderr, flush=True)
