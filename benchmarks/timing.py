"""Time per problem in batches, forward and with gradients, and the distribution of the time of a single problem."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from contenders import (
    ANY,
    PLAIN,
    TRAINED,
    WHOLE,
    CannotBeTimedError,
    Contender,
    N,
    Settings,
    Task,
    draw,
    first,
    make_contenders,
)
from harness import Row, in_turns, ratio, say, summary, target, without_garbage_collection

from kornia_pnpnet.data import OutlierMix
from kornia_pnpnet.result import Problems

FORWARD, BACKWARD = "forward", "forward+backward"
_PROBE = 10  # problems of the first call of a loop
_FEWEST_ROUNDS = 3
# Pairs in a batch of the rows that vary n: the memory of some contenders grows with the square of n.
_MOST_PAIRS = 100_000


def grid(settings: Settings, count: int) -> Iterator[tuple[int, list[tuple[int, str]]]]:
    """For each number of pairs the batch sizes and modes; fewer of them with more than one thread."""
    sizes = [size for size in settings.batches if count == 1 or size >= settings.problems]
    backward = [size for size in sizes if size <= settings.most_backward][: None if count == 1 else 1]
    for n in settings.pairs:
        if n == N:
            yield n, [*((size, FORWARD) for size in sizes), *((size, BACKWARD) for size in backward)]
        elif count == 1:
            yield n, [(max(1, min(settings.problems, _MOST_PAIRS // n)), FORWARD)]


def ready(
    contender: Contender, problems: Problems, settings: Settings, *, backward: bool, known: float | None
) -> tuple[Task, int, float]:
    """A warm task, its number of problems, and the seconds of its call.

    A loop gets its first problems, enough for ``settings.loop_s`` seconds. ``known`` are seconds per problem of an
    earlier measurement, or ``None``. CannotBeTimedError when the call would take too long, or the contender cannot
    compile.
    """
    count = len(problems.world_points)
    if contender.loops:
        probe = min(count, _PROBE)
        task = contender.task(first(problems, probe), backward=backward)
        task.seconds()
        count = min(count, max(probe, int(settings.loop_s * probe / task.seconds())))
    elif known is not None and known * count > settings.call_s:
        raise CannotBeTimedError(f"a call would take about {known * count:.0f} s")
    task = contender.task(first(problems, count), backward=backward)
    return task, count, task.warm()


def measure_throughput(settings: Settings, count: int) -> dict[str, list[dict[str, Any]]]:
    """Times on ``count`` threads. The entry ``count`` of a row is less than the batch for a loop."""
    rows: list[dict[str, Any]] = []
    skipped: list[dict[str, Any]] = []
    # Seconds per problem of the last measurement, scaled in proportion to the number of pairs.
    known: dict[tuple[str, str], float] = {}
    before = 0
    for n, points in grid(settings, count):
        known = {key: seconds * max(1.0, n / before) for key, seconds in known.items()}
        before = n
        torch.compiler.reset()  # compile for this number of pairs only
        contenders, missing = make_contenders(settings)
        skipped += [{**entry, "threads": count, "n": n} for entry in missing]
        problems = draw(n, max(settings.problems, *(batch for batch, _ in points)))
        rates: dict[str, dict[str, Any]] = {}
        for batch, mode in points:
            say(f"throughput: {count} thread(s), n = {n}, B = {batch}, {mode}")
            tasks: dict[str, tuple[Task, int, float]] = {}
            for name, contender in contenders.items():
                backward = mode == BACKWARD
                if not contender.takes(n) or (backward and not contender.differentiable):
                    continue
                before_s = known.get((name, mode))
                try:
                    found = ready(contender, first(problems, batch), settings, backward=backward, known=before_s)
                except CannotBeTimedError as error:
                    place = {"contender": name, "threads": count, "n": n, "batch": batch, "mode": mode}
                    skipped.append({**place, "why": str(error)})
                    continue
                if name not in rates:  # after the first call, which shows whether the contender compiles
                    rates[name] = rate(contender, first(problems, settings.problems), settings)
                tasks[name] = found
                known[name, mode] = found[2] / found[1]
            for name, times in timed(tasks, settings).items():
                place = {"contender": name, "threads": count, "mode": mode, "n": n, "batch": batch}
                rows.append({**place, "count": tasks[name][1], "success": rates[name], **summary(times)})
    return {"rows": rows, "skipped": skipped}


def rate(contender: Contender, problems: Problems, settings: Settings) -> dict[str, Any]:
    """Success; a loop gets the problems that it solves in a tenth of ``settings.point_s``."""
    if contender.loops:
        _, _, once = ready(contender, first(problems, _PROBE), settings, backward=False, known=None)
        problems = first(problems, max(_PROBE, int(_PROBE * settings.point_s / 10 / once)))
    return contender.task(problems).success()._asdict()


def timed(tasks: Mapping[str, tuple[Task, int, float]], settings: Settings) -> dict[str, list[float]]:
    """Microseconds per problem of each round, of what :func:`ready` returned."""
    # Repeated for as long as a loop takes: a single call would begin with the data of other contenders in the caches.
    times = {name: max(1, math.ceil(settings.loop_s / once)) for name, (_, _, once) in tasks.items()}
    round_s = sum(times[name] * once for name, (_, _, once) in tasks.items())
    rounds = min(settings.rounds, max(_FEWEST_ROUNDS, int(settings.point_s / round_s))) if tasks else 0

    def timer(name: str) -> float:
        task, size, _ = tasks[name]
        return 1e6 * task.seconds(times[name]) / size

    return in_turns({name: partial(timer, name) for name in tasks}, rounds)


def throughput_targets(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Targets of 1000 problems of 9 pairs with 3 mismatches on one thread, where both sides were measured."""
    place = {"threads": 1, "n": N, "batch": 1000, "mode": FORWARD}
    here = {row["contender"]: row for row in rows if place.items() <= row.items()}
    found = []
    for name, most in (("refinement compiled", 3.0), (f"{TRAINED} compiled", 8.0)):
        if name in here:
            found.append(target(f"`{name}`, per problem", here[name]["median_us"], most, unit="µs"))
    for solver, peer, least in ((TRAINED, "opencv-ransac", 20.0), (TRAINED, "poselib", 10.0), (ANY, "poselib", 5.0)):
        mine = f"{solver} compiled"
        if mine in here and peer in here:
            what = f"`{mine}` against `{peer}`, {FORWARD}"
            found.append(target(what, ratio(here[mine], here[peer]), least, unit="times as fast", at_most=False))
    return found


#: Number of quantiles of a distribution in the file, besides the smallest value.
QUANTILE_STEPS = 200
_TURN = 20  # calls of a contender in a row; one more call before them is not timed
_WARM = 10  # calls before all others


def measure_latency(settings: Settings, count: int) -> dict[str, list[dict[str, Any]]]:
    """Call every contender with one problem at a time, on ``count`` threads."""
    # The page shows the distribution on one thread, and only the median on two.
    problems = draw(N, settings.latency_calls if count == 1 else max(1, settings.latency_calls // 4), OutlierMix())
    rows = []
    contenders, skipped = make_contenders(settings)
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
        # Each quantile is one of the times.
        spread = np.quantile(times[name], np.linspace(0, 1, QUANTILE_STEPS + 1), method="inverted_cdf").tolist()
        tail = {f"p{share}_us": spread[round(share / 100 * QUANTILE_STEPS)] for share in (90, 99)}
        row = {"contender": name, "threads": count, "calls": len(mine), "success": success}
        row |= {"median_us": statistics.median(times[name]), **tail, "max_us": spread[-1]}
        rows.append({**row, "quantiles_us": [round(value, 2) for value in spread]})
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


def latency_targets(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Targets of one problem on one thread."""
    found = []
    alone = {row["contender"]: row for row in rows if row["threads"] == 1}
    for name, most_ms in {WHOLE: 0.4, f"{TRAINED} compiled": 0.4, PLAIN: 3.0, TRAINED: 3.0}.items():
        if row := alone.get(name):
            found.append(target(f"`{name}`, one problem, median", row["median_us"] / 1e3, most_ms, unit="ms"))
            tail = f"`{name}`, one problem, 99th percentile by the median"
            found.append(target(tail, row["p99_us"] / row["median_us"], 2.0))
    return found
