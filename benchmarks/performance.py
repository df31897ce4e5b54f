"""Throughput, latency, cold start and memory beside other libraries: ``python benchmarks/performance.py measure``.

``measure`` writes a results file for each part into this folder; ``render`` writes ``docs/performance.md`` and its
pictures from these files. README.md beside this file describes the measurements.
"""

import argparse
import json
import math
import statistics
import tempfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.metadata import distributions
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import page
from contenders import PLAIN, WHOLE, CannotBeTimedError, Contender, N, Task, draw, make_contenders
from harness import BACKWARD, FORWARD, HERE, in_turns, recorded, run_child, say, summary, threads
from page import CACHED, COLD, EAGER

from kornia_pnpnet.core.trees import take
from kornia_pnpnet.data import OutlierMix
from kornia_pnpnet.evaluation.results import save_results
from kornia_pnpnet.result import Problems

_PROBE = 10  # problems of the first call of a loop
_FEWEST_ROUNDS = 3
# Pairs in a batch of the rows that vary n: the memory of some contenders grows with the square of n.
_MOST_PAIRS = 100_000


class Settings(NamedTuple):
    """How much is measured."""

    contenders: Sequence[str] | None = None  # names; None: all
    problems: int = 1000  # that success is counted on; batch size of the rows with other numbers of pairs than N
    batches: tuple[int, ...] = (1, 10, 100, 1000, 10_000, 100_000)  # at N pairs
    pairs: tuple[int, ...] = (6, 9, 20, 100, 1000)
    most_backward: int = 10_000  # largest batch size with gradients
    rounds: int = 5  # at most
    loop_s: float = 0.2  # for a contender in a round: a loop solves fewer problems, a shorter call is repeated
    call_s: float = 2.0  # batches whose call takes longer are left out
    point_s: float = 3.0  # for all rounds of one comparison, about
    latency_calls: int = 1000  # calls with a single problem
    latency_s: float = 2.5  # for these calls; slow contenders get fewer
    memory_batch: int = 10_000  # of the memory measurement


FULL = Settings()
#: A few small problems, which show that everything runs.
QUICK = Settings(None, 20, (1, 20), (6, 9), 20, 3, 0.01, 600.0, 1.0, 20, 1.0, 100)


def grid(settings: Settings, count: int) -> dict[int, list[tuple[int, str]]]:
    """For each number of pairs the batch sizes and modes; fewer of them with more than one thread."""
    sizes = [size for size in settings.batches if count == 1 or size >= settings.problems]
    backward = [size for size in sizes if size <= settings.most_backward][: None if count == 1 else 1]
    points = {n: [(max(1, min(settings.problems, _MOST_PAIRS // n)), FORWARD)] for n in settings.pairs}
    at_n = [*((size, FORWARD) for size in sizes), *((size, BACKWARD) for size in backward)]
    return {**points, N: at_n} if count == 1 else {N: at_n}


def ready(
    contender: Contender, problems: Problems, settings: Settings, *, backward: bool = False, known: float = 0.0
) -> tuple[Task, float]:
    """A warm task, and the seconds of its call.

    A loop gets the first problems, enough for ``settings.loop_s`` seconds. ``known``: seconds per pair of an earlier
    measurement. CannotBeTimedError when the call would take too long, or the contender cannot compile.
    """
    expected = known * problems.inliers.numel()
    if contender.loops:
        task = contender.task(take(problems, slice(_PROBE)), backward=backward)
        task.seconds()
        problems = take(problems, slice(max(task.size, int(settings.loop_s * task.size / task.seconds()))))
    elif expected > settings.call_s:
        raise CannotBeTimedError(f"a call would take about {expected:.0f} s")
    task = contender.task(problems, backward=backward)
    return task, task.warm()


def measure_throughput(settings: Settings, count: int) -> dict[str, list[dict[str, Any]]]:
    """Times on ``count`` threads. The entry ``count`` of a row is less than the batch for a loop."""
    rows: list[dict[str, Any]] = []
    contenders, missing = make_contenders(settings.contenders)
    skipped = [{**entry, "threads": count} for entry in missing]
    known: defaultdict[tuple[str, str], float] = defaultdict(float)  # seconds per pair of the last measurement
    for n, points in grid(settings, count).items():
        problems = draw(n, max(settings.problems, *(batch for batch, _ in points)))
        rates: dict[str, dict[str, Any]] = {}
        for batch, mode in points:
            say(f"throughput: {count} thread(s), n = {n}, B = {batch}, {mode}")
            place = {"threads": count, "mode": mode, "n": n, "batch": batch}
            some, backward = take(problems, slice(batch)), mode == BACKWARD
            tasks: dict[str, tuple[Task, float]] = {}
            for name, contender in contenders.items():
                if not contender.takes(n) or (backward and not contender.differentiable):
                    continue
                if n != N and "compiled" in name:  # to compile for each number of pairs takes most of an hour
                    continue
                try:
                    task, once = ready(contender, some, settings, backward=backward, known=known[name, mode])
                except CannotBeTimedError as error:
                    skipped.append({"contender": name, **place, "why": str(error)})
                    continue
                if name not in rates:  # after the first call, which shows whether the contender compiles
                    rates[name] = rate(contender, take(problems, slice(settings.problems)), settings)
                tasks[name] = task, once
                known[name, mode] = once / task.problems.inliers.numel()
            for name, times in timed(tasks, settings).items():
                found = {"count": tasks[name][0].size, "success": rates[name], **summary(times)}
                rows.append({"contender": name, **place, **found})
    return {"rows": rows, "skipped": skipped}


def rate(contender: Contender, problems: Problems, settings: Settings) -> dict[str, Any]:
    """Success; a loop gets the problems that it solves in a tenth of ``settings.point_s``."""
    if contender.loops:
        _, once = ready(contender, take(problems, slice(_PROBE)), settings)
        problems = take(problems, slice(max(_PROBE, int(_PROBE * settings.point_s / 10 / once))))
    return contender.task(problems).success()._asdict()


def timed(tasks: Mapping[str, tuple[Task, float]], settings: Settings) -> dict[str, list[float]]:
    """Microseconds per problem of each round, of what :func:`ready` returned."""
    # Repeated for as long as a loop takes: a single call would begin with the data of other contenders in the caches.
    times = {name: max(1, math.ceil(settings.loop_s / once)) for name, (_, once) in tasks.items()}
    round_s = sum(times[name] * once for name, (_, once) in tasks.items())
    rounds = min(settings.rounds, max(_FEWEST_ROUNDS, int(settings.point_s / round_s))) if tasks else 0
    return in_turns({name: partial(task.us, times[name]) for name, (task, _) in tasks.items()}, rounds)


#: Number of quantiles of a distribution in the file, besides the smallest value.
QUANTILE_STEPS = 200
_TURN = 20  # calls of a contender in a row; one more call before them is not timed
_WARM = 10  # calls before all others


def measure_latency(settings: Settings, count: int) -> dict[str, list[dict[str, Any]]]:
    """Call every contender with one problem at a time, on ``count`` threads."""
    # The page shows the distribution on one thread, and only the median on two.
    problems = draw(N, settings.latency_calls if count == 1 else max(1, settings.latency_calls // 4), OutlierMix())
    rows = []
    contenders, skipped = make_contenders(settings.contenders)
    tasks = {}
    for name, contender in contenders.items():
        say(f"latency: {count} thread(s), {name}")
        single = [contender.task(take(problems, slice(i, i + 1))) for i in range(len(problems.world_points))]
        try:
            tasks[name] = single[: max(_TURN, int(settings.latency_s / single[0].warm()))]
        except CannotBeTimedError as error:
            skipped.append({"contender": name, "why": str(error)})
            continue
        for task in single[:_WARM]:
            task.seconds()
    times = latencies(tasks)
    for name, mine in tasks.items():
        success = contenders[name].task(problems).success()._asdict()
        # Each quantile is one of the times.
        spread = np.quantile(times[name], np.linspace(0, 1, QUANTILE_STEPS + 1), method="inverted_cdf").tolist()
        tail = {f"p{share}_us": spread[round(share / 100 * QUANTILE_STEPS)] for share in (90, 99)}
        row = {"contender": name, "threads": count, "calls": len(mine), "success": success}
        row |= {"median_us": statistics.median(times[name]), **tail, "max_us": spread[-1]}
        rows.append({**row, "quantiles_us": [round(value, 2) for value in spread]})
    return {"rows": rows, "skipped": [{**entry, "threads": count} for entry in skipped]}


def latencies(tasks: Mapping[str, Sequence[Task]]) -> dict[str, list[float]]:
    """Microseconds of every call, ``_TURN`` calls of each contender in turn."""
    found: dict[str, list[float]] = {name: [] for name in tasks}
    for start in range(0, max(map(len, tasks.values()), default=0), _TURN):
        for name, mine in tasks.items():
            turn = mine[start : start + _TURN]
            found[name] += [task.us() for task in (*turn[:1], *turn)][1:]
    return found


def measure_threads(part: str, settings: Settings, count: int) -> dict[str, list[dict[str, Any]]]:
    """Throughput or latency on ``count`` threads, in this process."""
    with threads(count):
        return (measure_throughput if part == "throughput" else measure_latency)(settings, count)


def measure_part(part: str, settings: Settings) -> dict[str, Any]:
    """Measure throughput, latency or cold starts; rows and skipped contenders."""
    if part == "startup":
        return measure_startup(settings)
    # One process for each number of threads: code is compiled for the threads of its process.
    answers = []
    for count in (1, 2):
        request = json.dumps({"part": part, "settings": settings._asdict(), "count": count})
        answers.append(run_child(Path(__file__), "--child", request, OMP_NUM_THREADS=str(count)))
    return {key: [entry for answer in answers for entry in answer[key]] for key in ("rows", "skipped")}


# The first batch size shows the compiler's warm-up, the others whether another size compiles again.
_BATCHES = (1000, 999, 100, 10, 1)


def measure_startup(settings: Settings) -> dict[str, Any]:
    """Start every contender alone, forward and with gradients, on one thread.

    Compiled contenders start with an empty cache of the compiler, and again with the cache of that first start.
    """
    contenders, skipped = make_contenders(settings.contenders)
    starts = []
    for name, contender in contenders.items():
        if name.startswith(PLAIN) and name != WHOLE:
            continue  # as TRAINED
        for backward in (False, True) if contender.differentiable and name != WHOLE else (False,):
            say(f"cold start: {name}{', backward' if backward else ''}")
            # A loop needs the memory of one problem.
            batch = 0 if contender.loops else settings.memory_batch
            starts += start({"contender": name, "backward": backward, "memory_batch": batch}, settings)
    return {"starts": starts, "skipped": skipped}


def start(request: Mapping[str, Any], settings: Settings) -> list[dict[str, Any]]:
    """Run ``process.py`` in processes one after the other. Only the last process measures memory."""

    def measured(cache: str, batches: Sequence[int], **environment: str) -> dict[str, Any]:
        wanted = {**request, "batches": batches, "memory_batch": 0 if cache == COLD else request["memory_batch"]}
        found = run_child(HERE / "process.py", json.dumps(wanted), OMP_NUM_THREADS="1", **environment)
        return {**found, "cache": cache}

    if "compiled" not in request["contender"]:
        return [measured(EAGER, [1])]
    batches = [min(size, settings.problems) for size in _BATCHES]
    with tempfile.TemporaryDirectory(prefix="inductor-") as folder:
        return [measured(cache, batches, TORCHINDUCTOR_CACHE_DIR=folder) for cache in (COLD, CACHED)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and write the results files, or write the page."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("step", nargs="?", choices=("measure", "render"), default="measure")
    command.add_argument("--parts", nargs="+", choices=page.PARTS, default=page.PARTS, help="for measure: only these")
    command.add_argument("--contenders", nargs="+", help="for measure: only these")
    command.add_argument("--quick", action="store_true", help="a few small problems: does everything run?")
    command.add_argument("--results", type=Path, default=HERE, help="folder of the results files")
    command.add_argument("--child", help=argparse.SUPPRESS)  # the request of `measure_part` to a process of its own
    options = command.parse_args(arguments)
    if options.child:
        request = json.loads(options.child)
        print(json.dumps(measure_threads(request["part"], Settings(**request["settings"]), request["count"])))
        return
    if options.step == "render":
        page.render(options.results)
        return
    settings = (QUICK if options.quick else FULL)._replace(contenders=options.contenders)
    installed = {entry.name.lower(): entry.version for entry in distributions()}
    for part in options.parts:
        path = options.results / f"{part}.json"
        results = recorded(partial(measure_part, part, settings), **settings._asdict())
        results["environment"]["versions"]["onnxruntime"] = installed.get("onnxruntime")
        results["peers"] = {name: peer.solver.config() for name, peer in make_contenders(page.PEERS)[0].items()}
        save_results(results, path)
        say(f"wrote {path}")


if __name__ == "__main__":
    main()
