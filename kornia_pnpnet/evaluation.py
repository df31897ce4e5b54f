"""Solvers on problems: every solver on the same ones, into one results file that tables and figures read."""

from __future__ import annotations

import json
import math
import statistics
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from kornia_pnpnet.environment import environment
from kornia_pnpnet.files import atomic_open
from kornia_pnpnet.metrics import PoseErrors, SuccessRate, pose_errors, success, success_rate
from kornia_pnpnet.types import PnPResult, Pose, Problems

__all__ = [
    "EvaluationData",
    "draw_problems",
    "evaluate",
    "format_table",
    "load_results",
    "row_errors",
    "save_results",
]

FORMAT = 1
_QUARTILES = {"q25": 0.25, "median": 0.5, "q75": 0.75}


class EvaluationData(NamedTuple):
    """Problems and what counts as solving them.

    Attributes:
        problems: a batch of any size.
        max_rotation_deg: a success has a smaller rotation error, in degrees.
        max_translation: a success has a smaller translation error, in the unit of the world.
        unit: the unit of the world, for axis labels.
        description: where the problems come from, as plain data for the results file.
    """

    problems: Problems
    max_rotation_deg: float = 1.0
    max_translation: float = 0.2
    unit: str = "m"
    description: Mapping[str, Any] = {}


class _Source(Protocol):
    """What :func:`draw_problems` needs of a data source."""

    def batch(self, index: int) -> Problems:
        """Draw batch ``index``."""
        ...


def draw_problems(source: _Source, count: int) -> Problems:
    """Take the first problems of a source.

    Args:
        source: has ``batch(index)``, for example :class:`~kornia_pnpnet.data.SyntheticProblems`.
        count: how many problems, at least 1.

    Returns:
        ``count`` problems: the source's batches 0, 1, ... one after the other, cut to length. With the same batch
        size, more problems begin with the fewer ones.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> draw_problems(SyntheticProblems(batch_size=4), count=6).world_points.shape
        torch.Size([6, 9, 3])
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}.")
    batches = [source.batch(0)]
    size = len(batches[0].world_points)
    batches += [source.batch(index) for index in range(1, math.ceil(count / size))]
    fields = zip(*((*batch[:3], *batch.pose, batch.inliers) for batch in batches), strict=True)
    joined = iter([torch.cat(field)[:count] for field in fields])
    return batches[0].map(lambda _: next(joined))


def _chunks(problems: Problems, size: int) -> Iterator[Problems]:
    for start in range(0, len(problems.world_points), size):
        yield problems.map(lambda part, start=start: part[start : start + size])  # type: ignore[misc]


def evaluate(
    solvers: Mapping[str, nn.Module],
    data: Mapping[str, EvaluationData],
    *,
    chunk: int = 1000,
    repeats: int = 3,
    progress: bool | None = None,
) -> dict[str, Any]:
    """Solve the same problems with every solver.

    A non-finite pose counts as the identity with ``ok=False``. All summaries are computed from the per-problem errors
    as they are stored, rounded to six digits, so that whoever reads the file finds the same numbers.

    Args:
        solvers: by name, each called as ``solver(world_points, img_points, intrinsics)`` in evaluation mode, without
            gradients.
        data: problems by name, on the device and in the dtype to solve them in.
        chunk: problems per call, which bounds the memory.
        repeats: calls to time at least. The first chunk is solved once before, untimed.
        progress: show a progress bar; when ``None``, if standard error is a terminal.

    Returns:
        Plain data: ``format``, ``environment`` (see :func:`environment`), ``solvers`` with each one's configuration,
        ``data`` with each set's description and limits, and ``rows``, one for each set and solver: ``success``
        (rate, low, high, total), quartiles of ``rotation_error_deg`` and ``translation_error``, the share ``ok``,
        ``us_per_problem`` (median over the timed calls) and the ``per_problem`` errors and ok.
    """
    from tqdm import tqdm

    hidden = not (sys.stderr.isatty() if progress is None else progress)
    rows = []
    with tqdm(total=len(solvers) * len(data), disable=hidden, unit="run") as bar:
        for data_name, entry in data.items():
            for solver_name, solver in solvers.items():
                bar.set_postfix_str(f"{solver_name} on {data_name}")
                rows.append({"data": data_name, "solver": solver_name, **_row(solver, entry, chunk, repeats)})
                bar.update()
    return {
        "format": FORMAT,
        "environment": environment(),
        "solvers": {name: _config(solver) for name, solver in solvers.items()},
        "data": {name: {**_describe(entry), "chunk": chunk} for name, entry in data.items()},
        "rows": rows,
    }


def _config(solver: nn.Module) -> dict[str, Any]:
    config = getattr(solver, "config", None)
    return {"class": type(solver).__name__, "config": config() if callable(config) else None}


def _describe(entry: EvaluationData) -> dict[str, Any]:
    problems = entry.problems
    return {
        "description": dict(entry.description),
        "count": len(problems.world_points),
        "n": problems.world_points.shape[1],
        "mean_outliers": _rounded((~problems.inliers).sum(-1).double().mean().item()),
        "max_rotation_deg": entry.max_rotation_deg,
        "max_translation": entry.max_translation,
        "unit": entry.unit,
        "dtype": str(problems.world_points.dtype).removeprefix("torch."),
        "device": problems.world_points.device.type,
    }


def _row(solver: nn.Module, entry: EvaluationData, chunk: int, repeats: int) -> dict[str, Any]:
    """Solve, time, compare and summarise one set with one solver."""
    was_training = solver.training
    solver.eval()
    try:
        with torch.no_grad():
            errors, ok, seconds = _run(solver, entry.problems, chunk, repeats)
    finally:
        solver.train(was_training)
    per_problem = {name: [_rounded(value) for value in values.tolist()] for name, values in errors._asdict().items()}
    stored = PoseErrors(*(torch.tensor(values, dtype=torch.float64) for values in per_problem.values()))
    rate = success_rate(success(stored, entry.max_rotation_deg, entry.max_translation))
    return {
        "success": {name: value if name == "total" else _rounded(value) for name, value in rate._asdict().items()},
        **{name: _quartiles(values) for name, values in stored._asdict().items()},
        "ok": _rounded(ok.double().mean().item()),
        "us_per_problem": _rounded(1e6 * seconds),
        "per_problem": {**per_problem, "ok": ok.int().tolist()},
    }


def _run(solver: nn.Module, problems: Problems, chunk: int, repeats: int) -> tuple[PoseErrors, Tensor, float]:
    """Errors and ok of all problems, and the median time per problem in seconds."""
    chunks = list(_chunks(problems, chunk))
    _timed(solver, chunks[0])
    results, seconds = [], []
    for part in chunks:
        result, elapsed = _timed(solver, part)
        results.append(_compare(result, part.pose))
        seconds.append((len(part.world_points), elapsed / len(part.world_points)))
    while len(seconds) < repeats:
        part = chunks[len(seconds) % len(chunks)]
        seconds.append((len(part.world_points), _timed(solver, part)[1] / len(part.world_points)))
    # A short last chunk pays the cost of a call for few problems: it does not count beside full ones.
    full = max(size for size, _ in seconds)
    rotation, translation, ok = (torch.cat(values) for values in zip(*results, strict=True))
    return PoseErrors(rotation, translation), ok, statistics.median(time for size, time in seconds if size == full)


def _timed(solver: nn.Module, problems: Problems) -> tuple[PnPResult, float]:
    on_gpu = problems.world_points.is_cuda
    if on_gpu:
        torch.cuda.synchronize()
    start = time.perf_counter()
    result = solver(problems.world_points, problems.img_points, problems.intrinsics)
    if on_gpu:
        torch.cuda.synchronize()
    return result, time.perf_counter() - start


def _compare(result: PnPResult, truth: Pose) -> tuple[Tensor, Tensor, Tensor]:
    """Errors in float64 on the CPU, and ok."""
    rotation, translation, *true = (x.double().cpu() for x in (result.rotation, result.translation, *truth))
    finite = rotation.isfinite().flatten(1).all(-1) & translation.isfinite().all(-1)
    rotation = torch.where(finite[:, None, None], rotation, torch.eye(3, dtype=torch.float64))
    translation = torch.where(finite[:, None], translation, 0.0)
    return *pose_errors(Pose(rotation, translation), Pose(*true)), result.ok.cpu() & finite


def _rounded(value: float) -> float:
    """Six significant digits: a results file of 10 000 problems stays small."""
    return float(f"{value:.6g}")


def _quartiles(values: Tensor) -> dict[str, float]:
    return {name: _rounded(values.quantile(share).item()) for name, share in _QUARTILES.items()}


def row_errors(row: Mapping[str, Any]) -> tuple[PoseErrors, Tensor]:
    """The per-problem errors of a row of the results.

    Args:
        row: one of ``results["rows"]``.

    Returns:
        The errors in float64 and ok as bool, each of shape :math:`(B,)`.
    """
    errors = row["per_problem"]
    parts = (torch.tensor(errors[name], dtype=torch.float64) for name in PoseErrors._fields)
    return PoseErrors(*parts), torch.tensor(errors["ok"], dtype=torch.bool)


def save_results(results: Mapping[str, Any], path: str | Path) -> None:
    """Write results as one JSON file, in one piece: a reader finds the old file or the new one.

    Args:
        results: what :func:`evaluate` returned.
        path: where to; folders are made when missing.

    Raises:
        ValueError: when a number is not finite, which JSON does not know.
    """
    text = json.dumps(results, separators=(",", ":"), allow_nan=False) + "\n"
    with atomic_open(path, encoding="utf-8") as file:
        file.write(text)


def load_results(path: str | Path) -> dict[str, Any]:
    """Read a results file.

    Args:
        path: what :func:`save_results` wrote.

    Returns:
        The results.

    Raises:
        FileNotFoundError: when there is no such file.
        ValueError: when it is not a results file of this format.
    """
    try:
        results = json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"'{path}' is not a results file: {error}") from error
    if not isinstance(results, dict) or results.get("format") != FORMAT:
        raise ValueError(f"'{path}' is not a results file of format {FORMAT}.")
    return results


def _three_digits(value: float) -> str:
    """Three significant digits, zeros at the end kept: 0.160."""
    return f"{value:#.3g}".rstrip(".")


def format_table(results: Mapping[str, Any]) -> str:
    """The results as a Markdown table that also reads well as plain text.

    Args:
        results: what :func:`evaluate` returned.

    Returns:
        One line for each set and solver: success with its 95 % interval, median errors, time and share of ok.
    """
    head = ("data", "solver", "success [95 %]", "median rotation error", "median translation error", "µs/problem", "ok")
    cells = [head]
    for row in results["rows"]:
        unit = results["data"][row["data"]]["unit"]
        cells.append(
            (
                row["data"],
                row["solver"],
                str(SuccessRate(**row["success"])),
                f"{_three_digits(row['rotation_error_deg']['median'])}°",
                f"{_three_digits(row['translation_error']['median'])} {unit}".rstrip(),
                f"{row['us_per_problem']:.0f}",
                f"{100 * row['ok']:.1f} %",
            )
        )
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    left = 2  # the names; numbers are aligned to the right
    lines = [
        "| "
        + " | ".join(c.ljust(w) if i < left else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True)))
        + " |"
        for line in cells
    ]
    rule = "|" + "|".join("-" * (w + 2) if i < left else "-" * (w + 1) + ":" for i, w in enumerate(widths)) + "|"
    return "\n".join([lines[0], rule, *lines[1:]])
