"""Results files: their form, continuing an interrupted evaluation, and the table of an evaluation."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import torch
from torch import Tensor

from kornia_pnpnet.core.files import atomic_open, digest
from kornia_pnpnet.core.schema import Count, Positive, Share, from_json, read_json
from kornia_pnpnet.core.tables import markdown_table
from kornia_pnpnet.metrics import PoseErrors, SuccessRate

__all__ = ["FORMAT", "format_table", "load_results", "resume", "row_errors", "save_results", "source_digest"]

FORMAT = 1
_SHOWN_DIFFERENCES = 3


# The form of results files, as far as a reader relies on it.
class _Rate(TypedDict):
    rate: Share
    low: Share
    high: Share
    total: Count


class _Quartiles(TypedDict):
    q25: float
    median: float
    q75: float


class _PerProblem(TypedDict):
    rotation_error_deg: list[float]
    translation_error: list[float]
    ok: list[Share]


class _Row(TypedDict):
    data: str
    solver: str
    success: _Rate
    rotation_error_deg: _Quartiles
    translation_error: _Quartiles
    ok: Share
    us_per_problem: Positive
    per_problem: NotRequired[_PerProblem]


class _ProblemSet(TypedDict):
    description: NotRequired[dict[str, Any] | None]
    n: Count
    max_rotation_deg: float
    max_translation: float
    unit: str


class _Solver(TypedDict):
    config: NotRequired[dict[str, Any] | None]


class _Environment(TypedDict):
    versions: NotRequired[dict[str, str | None]]
    commit: NotRequired[str | None]


class _Evaluation(TypedDict):
    environment: _Environment
    solvers: dict[str, _Solver]
    data: dict[str, _ProblemSet]
    rows: list[_Row]


class _Complexity(TypedDict):
    n: list[Count]
    counts: dict[str, list[float | None]]
    ransac: list[str]


_FORMS: dict[str, type] = {"evaluation": _Evaluation, "complexity": _Complexity}


def _contradictions(results: Mapping[str, Any]) -> Iterator[str]:
    """Describe names in rows that have no entry, and lists of different lengths."""
    for i, row in enumerate(results.get("rows", ())):
        lists = row.get("per_problem", {})
        if len({len(lists[key]) for key in _PerProblem.__annotations__ if lists}) > 1:
            yield f"rows[{i}].per_problem has lists of different lengths"
        for key, names in (("data", "data"), ("solver", "solvers")):
            if row[key] not in results[names]:
                yield f"rows[{i}].{key} is {row[key]!r}, which {names} does not contain"


def row_errors(row: Mapping[str, Any]) -> tuple[PoseErrors, Tensor]:
    """Read the per-problem errors of a row.

    Args:
        row: one of ``results["rows"]``.

    Returns:
        The errors in float64, and ok as bool, each of shape :math:`(B,)`.

    Raises:
        ValueError: when the row has no per-problem errors, like the rows of the files in the repository.
    """
    if "per_problem" not in row:
        raise ValueError(f"The row of '{row['solver']}' on '{row['data']}' has no per-problem errors.")
    errors = row["per_problem"]
    parts = (torch.tensor(errors[name], dtype=torch.float64) for name in PoseErrors._fields)
    return PoseErrors(*parts), torch.tensor(errors["ok"], dtype=torch.bool)


def save_results(results: Mapping[str, Any], path: str | Path) -> None:
    """Write results as one JSON file, in one piece: a reader finds the old file or the new one.

    Args:
        results: what :func:`~kornia_pnpnet.evaluation.evaluate` returned.
        path: the file; missing folders are made.

    Raises:
        ValueError: when a number is not finite, which JSON cannot express.
        OSError: when the file cannot be written.
    """
    text = json.dumps(results, separators=(",", ":"), allow_nan=False) + "\n"
    with atomic_open(path, encoding="utf-8") as file:
        file.write(text)


def load_results(path: str | Path, *, complexity: bool = False) -> dict[str, Any]:
    """Read a results file.

    Args:
        path: a file of :func:`save_results`.
        complexity: also accept operation counts (:func:`~kornia_pnpnet.evaluation.operations.complexity_results`).

    Returns:
        The results.

    Raises:
        FileNotFoundError: when there is no such file.
        ValueError: when the file is not a results file of this format; the message names the first wrong entry.
    """
    results = read_json(path, "a results file")
    if not isinstance(results, dict) or results.get("format") != FORMAT:
        raise ValueError(f"'{path}' is not a results file of format {FORMAT}.")
    kinds = tuple(_FORMS) if complexity else ("evaluation",)
    kind = results.get("kind", "evaluation")
    if kind not in kinds:
        raise ValueError(f"'{path}' is not a results file of {' or '.join(kinds)}.")
    try:
        results = from_json(_FORMS[kind], results)
        for contradiction in _contradictions(results):
            raise ValueError(contradiction)
    except ValueError as error:
        raise ValueError(f"'{path}' is not a results file of {kind}: {error}.") from error
    return results


def source_digest() -> str:
    """Compute a digest of the package's Python files: rows with the same digest come from the same code."""
    root = Path(__file__).resolve().parents[1]
    return digest({path.relative_to(root).as_posix(): digest(path.read_bytes()) for path in root.rglob("*.py")})


def resume(plan: Mapping[str, Any], path: str | Path) -> dict[str, Any]:
    """Join the plan of an evaluation with the results file that the evaluation continues.

    A file can be continued by the same code and versions. The plan must have all solvers and data sets of the file,
    unchanged, and may have more.

    Args:
        plan: the results before the first row.
        path: the results file. It may be missing or have no rows.

    Returns:
        The results of the file with the plan's solvers and data; the plan when there are no rows to continue.

    Raises:
        ValueError: when the file is not a results file, or holds rows of another plan; the message names the
            differences.
    """
    fresh: dict[str, Any] = json.loads(json.dumps(plan))  # tuples become lists, as in a file
    there = load_results(path) if Path(path).exists() else fresh
    if not there["rows"]:
        return fresh
    differing = _differences(there, fresh)
    if differing:
        shown = "; ".join(differing[:_SHOWN_DIFFERENCES])
        more = f"; and {len(differing) - _SHOWN_DIFFERENCES} more" if len(differing) > _SHOWN_DIFFERENCES else ""
        raise ValueError(
            f"'{path}' holds another evaluation, which this one cannot continue: {shown}{more}. Choose another file, "
            "or overwrite this one."
        )
    return {**there, "solvers": fresh["solvers"], "data": fresh["data"]}


def _differences(there: Mapping[str, Any], plan: Mapping[str, Any]) -> list[str]:
    """Describe why the rows of a file do not belong to a plan."""
    found = []
    for package, version in plan["environment"]["versions"].items():
        was = there["environment"].get("versions", {}).get(package)
        if was != version:
            found.append(f"{package} was {was} and is {version}")
    if there.get("code") != plan["code"]:
        found.append(f"the package's code has changed since (commit {there['environment'].get('commit')})")
    for kind in ("solvers", "data"):
        for name, entry in there[kind].items():
            now = plan[kind].get(name)
            if now is None:
                found.append(f"{kind}: '{name}' is not part of this one")
            elif now != entry:
                keys = [key for key in {**entry, **now} if entry.get(key) != now.get(key)]
                found.append(f"{kind}: '{name}' has another {', another '.join(keys)}")
    return found


def _three_digits(value: float) -> str:
    """Format three significant digits, with zeros at the end: 0.160."""
    return f"{value:#.3g}".rstrip(".")


def format_table(results: Mapping[str, Any]) -> str:
    """Format the results as a Markdown table that also reads well as plain text.

    Args:
        results: what :func:`~kornia_pnpnet.evaluation.evaluate` returned.

    Returns:
        One line for each set and solver: success with its 95 % interval, median errors, time and share of ok.
    """
    header = ("data", "solver", "success [95 %]", "median rotation error", "median translation error")
    rows = []
    for row in results["rows"]:
        unit = results["data"][row["data"]]["unit"]
        rows.append(
            (
                row["data"],
                row["solver"],
                str(SuccessRate._make(row["success"][key] for key in SuccessRate._fields)),
                f"{_three_digits(row['rotation_error_deg']['median'])}°",
                f"{_three_digits(row['translation_error']['median'])} {unit}".rstrip(),
                f"{row['us_per_problem']:.0f}",
                f"{100 * row['ok']:.1f} %",
            )
        )
    return markdown_table((*header, "µs/problem", "ok"), rows, align="llrrrrr", pad=True)
