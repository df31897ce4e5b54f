"""The time of a single problem, as a distribution: a fixed cost is the claim."""

from __future__ import annotations

import gc
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from contenders import ONE, PLAIN, TRAINED, WHOLE
from harness import quantiles, say, target, threads
from settings import N, Settings, draw, make_contenders
from tasks import CannotBeTimedError, Contender, Task, first

from kornia_pnpnet.data import OutlierMix
from kornia_pnpnet.types import Problems

__all__ = ["QUANTILE_STEPS", "measure_latency", "targets"]

#: The file keeps so many quantiles of each distribution, and the smallest.
QUANTILE_STEPS = 200
# Calls in a row before it is another's turn; the first of them is not timed.
_TURN = 20
_WARM = 10


def measure_latency(settings: Settings, *, count: int) -> dict[str, list[dict[str, Any]]]:
    """Call everything with one problem at a time, on ``count`` threads.

    Returns:
        ``rows``, one for each contender: ``calls``, ``median_us``, ``p90_us``, ``p99_us``, ``max_us`` and
        ``quantiles_us``; and ``skipped``.
    """
    # The distribution is shown on one thread; a second changes the median, or does not.
    problems = draw(N, settings.latency_calls if count == 1 else max(1, settings.latency_calls // 4), OutlierMix())
    rows = []
    with threads(count):
        contenders, skipped = make_contenders(settings, count=count)
        tasks = {}
        for name, contender in contenders.items():
            say(f"latency: {count} thread(s), {name}")
            try:
                tasks[name] = single_tasks(contender, problems, settings)
            except CannotBeTimedError as error:
                skipped.append({"contender": name, "why": str(error)})
        times = latencies(tasks)
        for name, mine in tasks.items():
            success = contenders[name].task(first(problems, len(mine))).success()._asdict()
            spread = quantiles(times[name], QUANTILE_STEPS)
            rows.append(
                {
                    "contender": name,
                    "threads": count,
                    "calls": len(times[name]),
                    "success": success,
                    "median_us": statistics.median(times[name]),
                    "p90_us": spread[round(0.90 * QUANTILE_STEPS)],
                    "p99_us": spread[round(0.99 * QUANTILE_STEPS)],
                    "max_us": spread[-1],
                    "quantiles_us": [round(value, 2) for value in spread],
                }
            )
    return {"rows": rows, "skipped": [{**entry, "threads": count} for entry in skipped]}


def single_tasks(contender: Contender, problems: Problems, settings: Settings) -> list[Task]:
    """A warm task for each problem, as many as take a given time."""

    def one(index: int) -> Task:
        return contender.task(problems.map(lambda x: x[index : index + 1]))

    most = max(_TURN, int(settings.latency_s / one(0).warm()))
    tasks = [one(index) for index in range(min(most, len(problems.world_points)))]
    for task in tasks[:_WARM]:
        task.seconds()
    return tasks


def latencies(tasks: Mapping[str, Sequence[Task]]) -> dict[str, list[float]]:
    """Microseconds of every call, some calls of each contender in turn."""
    found: dict[str, list[float]] = {name: [] for name in tasks}
    collecting = gc.isenabled()
    gc.disable()
    try:
        for start in range(0, max(map(len, tasks.values()), default=0), _TURN):
            for name, mine in tasks.items():
                for index, task in enumerate(mine[start : start + _TURN]):
                    if index == 0:
                        task.seconds()
                    found[name].append(1e6 * task.seconds())
    finally:
        if collecting:
            gc.enable()
    return found


def targets(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """What is wanted of one problem on one thread."""
    found = []
    compiled = WHOLE, *(f"{name} compiled" for name in (PLAIN, ONE, TRAINED))
    for name, most_ms in (*((name, 0.4) for name in compiled), *((name, 3.0) for name in (PLAIN, ONE, TRAINED))):
        for row in rows:
            if (row["contender"], row["threads"]) == (name, 1):
                median = f"`{name}`, one problem, median"
                found.append(target(median, row["median_us"] / 1e3, most_ms, unit="ms", at_most=True))
                tail = f"`{name}`, one problem, 99th percentile by the median"
                found.append(target(tail, row["p99_us"] / row["median_us"], 2.0, unit="", at_most=True))
    return found
