"""The distribution of the time of a single problem, since the claim is a fixed cost."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from contenders import ONE, PLAIN, TRAINED, WHOLE
from harness import quantiles, say, target, threads, without_garbage_collection
from settings import N, Settings, draw, make_contenders
from tasks import CannotBeTimedError, Contender, Task, first

from kornia_pnpnet.data import OutlierMix
from kornia_pnpnet.result import Problems

#: Number of quantiles of a distribution in the file, besides the smallest value.
QUANTILE_STEPS = 200
_TURN = 20  # calls of a contender in a row; one more call before them is not timed
_WARM = 10  # calls before all others


def measure_latency(settings: Settings, *, count: int) -> dict[str, list[dict[str, Any]]]:
    """Call every contender with one problem at a time, on ``count`` threads.

    Returns:
        ``rows``, one for each contender: ``calls``, ``median_us``, ``p90_us``, ``p99_us``, ``max_us`` and
        ``quantiles_us``; and ``skipped``.
    """
    # The page shows the distribution on one thread, and only the median on two.
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
    """Warm tasks of one problem each, for ``settings.latency_s`` seconds of calls."""

    def one(index: int) -> Task:
        return contender.task(problems.map(lambda x: x[index : index + 1]))

    most = max(_TURN, int(settings.latency_s / one(0).warm()))
    tasks = [one(index) for index in range(min(most, len(problems.world_points)))]
    for task in tasks[:_WARM]:
        task.seconds()
    return tasks


def latencies(tasks: Mapping[str, Sequence[Task]]) -> dict[str, list[float]]:
    """Microseconds of every call, ``_TURN`` calls of each contender in turn."""
    found: dict[str, list[float]] = {name: [] for name in tasks}
    with without_garbage_collection():
        for start in range(0, max(map(len, tasks.values()), default=0), _TURN):
            for name, mine in tasks.items():
                for index, task in enumerate(mine[start : start + _TURN]):
                    if index == 0:
                        task.seconds()
                    found[name].append(1e6 * task.seconds())
    return found


def targets(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Targets of one problem on one thread."""
    found = []
    compiled = (WHOLE, *(f"{name} compiled" for name in (PLAIN, ONE, TRAINED)))
    most = dict.fromkeys(compiled, 0.4) | dict.fromkeys((PLAIN, ONE, TRAINED), 3.0)
    for name, most_ms in most.items():
        for row in rows:
            if (row["contender"], row["threads"]) == (name, 1):
                median = f"`{name}`, one problem, median"
                found.append(target(median, row["median_us"] / 1e3, most_ms, unit="ms", at_most=True))
                tail = f"`{name}`, one problem, 99th percentile by the median"
                found.append(target(tail, row["p99_us"] / row["median_us"], 2.0, unit="", at_most=True))
    return found
