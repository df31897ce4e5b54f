"""What the benchmarks share: threads, timing in turns, processes of their own, results files and tables."""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
import timeit
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from numpy.typing import NDArray
from torch import Tensor

from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.files import write_json
from kornia_pnpnet.core.performance import keep_freed_memory
from kornia_pnpnet.core.tables import markdown_table

HERE = Path(__file__).resolve().parent
DOCS = HERE.parent / "docs"
#: What a call does.
FORWARD, BACKWARD = "forward", "forward+backward"
#: Samples of clusters for an interval.
SAMPLES = 2000

Row = Mapping[str, Any]


@contextmanager
def threads(count: int = 1) -> Iterator[None]:
    """Run PyTorch and OpenCV on ``count`` threads, and restore both settings of the process afterwards.

    The allocator is set as the documentation advises for large batches.
    """
    keep_freed_memory()
    libraries: list[tuple[Callable[[], int], Callable[[int], None]]] = [(torch.get_num_threads, torch.set_num_threads)]
    with suppress(ImportError):
        import cv2

        libraries.append((cv2.getNumThreads, cv2.setNumThreads))
    with ExitStack() as stack:
        for get, change in libraries:
            stack.callback(change, get())
            change(count)
        yield


def seconds(call: Callable[[], object], times: int = 1, clock: Callable[[], float] = time.perf_counter) -> float:
    """Seconds of a call, the mean over ``times`` calls, without garbage collection."""
    return timeit.timeit(call, timer=clock, number=times) / times


def interval(sums: NDArray[Any], counts: NDArray[Any]) -> list[float]:
    """A mean and its 95 % interval, by drawing clusters with replacement, from the sum and the size of each cluster."""
    drawn = np.random.default_rng(0).integers(len(sums), size=(SAMPLES, len(sums)))
    means = sums[drawn].sum(1) / counts[drawn].sum(1)
    return [float(sums.sum() / counts.sum()), *(float(x) for x in np.percentile(means, (2.5, 97.5)))]


def in_turns(timers: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, list[float]]:
    """Ask each timer once in every round, so that a slow minute of the machine hits all of them."""
    turns = [{name: timer() for name, timer in timers.items()} for _ in range(rounds)]
    return {name: [turn[name] for turn in turns] for name in timers}


def summary(rounds_us: Sequence[float]) -> dict[str, Any]:
    """Median, minimum and all of the times of the rounds."""
    return {"median_us": statistics.median(rounds_us), "min_us": min(rounds_us), "rounds_us": list(rounds_us)}


def peak_bytes() -> int:
    """Peak memory of this process (Linux). ``getrusage`` can include the process that started this one."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))


def run_child(script: Path, *arguments: str, **environment: str) -> Any:
    """Run a script in a process of its own and return the JSON that it prints; raises when the script fails."""
    command, variables = [sys.executable, str(script), *arguments], {**os.environ, **environment}
    output = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=variables)
    return json.loads(output.stdout)


def share(chosen: Tensor) -> float | None:
    """Share of the entries that are true, ``None`` without entries."""
    return float(chosen.double().mean()) if len(chosen) else None


def parser(description: str | None, out: Path | None = None, *, required: bool = True) -> argparse.ArgumentParser:
    """A command line with ``--out``, whose help shows the description as it is written."""
    command = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--out", type=Path, default=out, required=required and out is None, help="file of results")
    return command


def recorded(measure: Callable[[], Row], **settings: Any) -> dict[str, Any]:
    """What a measurement returns, with ``environment``, ``settings``, and ``load_average`` before and after.

    This process uses one thread meanwhile.

    Times are not to be trusted where the load average of the last minute is well above the number of threads.
    """
    with threads():
        made, before = environment(), os.getloadavg()[0]  # the commit is that of the start
        found = measure()
    return {"environment": made, "settings": settings, "load_average": [before, os.getloadavg()[0]], **found}


def render(template: str, **facts: Any) -> str:
    """A page from its template here or in ``docs/results``, with the filters below. Missing facts are errors."""
    options: dict[str, Any] = {"trim_blocks": True, "keep_trailing_newline": True, "undefined": StrictUndefined}
    environment = Environment(loader=FileSystemLoader([HERE, DOCS / "results"]), autoescape=False, **options)
    environment.filters |= {"percent": percent, "digits": three_digits, "foot": foot}
    return environment.get_template(template).render(**facts)


def write(path: Path, results: Row, page: Callable[[Row], str]) -> None:
    """Write a results file, and its page beside it."""
    write_json(path, results)
    path.with_suffix(".md").write_text(page(results), encoding="utf-8")


def say(text: str) -> None:
    """Write a line of progress."""
    print(text, file=sys.stderr, flush=True)


def pivot(
    rows: Iterable[Row],
    keys: Mapping[str, str],
    names: Iterable[str],
    cell: Callable[[Row], str],
    *,
    by: str = "solver",
    **options: Any,
) -> str:
    """A Markdown table with a line for each combination of the keys, and a column for each value of the entry ``by``.

    Keys are format strings by the titles of their columns. The columns of ``names`` hold ``cell``; options are those of
    :func:`~kornia_pnpnet.core.tables.markdown_table`.
    """
    lines: dict[tuple[str, ...], dict[str, str]] = {}
    for row in rows:
        lines.setdefault(tuple(x.format_map(row) for x in keys.values()), {})[row[by]] = cell(row)
    cells = [[*place, *(line.get(name, "–") for name in names)] for place, line in lines.items()]
    return markdown_table([*keys, *names], cells, **options)


def foot(made: Row) -> str:
    """Date, commit and processor of a measurement, from its ``environment``."""
    commit = (made["commit"] or "unknown").partition("+")
    return f"{made['date'][:10]}, commit {commit[0][:9]}{' with changes' * bool(commit[1])}, {made['cpu']}"


def percent(value: float | None, digits: int = 1) -> str:
    """A share in per cent, without the sign."""
    return "–" if value is None else f"{100 * value:.{digits}f}"


def three_digits(value: float) -> str:
    """Three significant digits, never an exponent."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:#.3g}".rstrip(".")
