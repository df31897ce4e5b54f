"""Results files: written in one piece, continued by the same evaluation, read by tables and figures."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kornia_pnpnet.core.files import atomic_open
from kornia_pnpnet.core.schema import (
    RATE,
    is_count,
    is_mapping_or_none,
    is_number,
    is_number_or_none,
    is_positive,
    is_share,
    is_text,
    is_text_or_none,
    misfits,
    read_json,
)
from kornia_pnpnet.core.tables import markdown_table
from kornia_pnpnet.metrics import PoseErrors, SuccessRate

__all__ = ["FORMAT", "format_table", "load_results", "resume", "row_errors", "save_results", "source_digest"]

FORMAT = 1
_SHOWN_DIFFERENCES = 3


# What readers ask of a file, see `misfits`.
_PER_PROBLEM = {"rotation_error_deg": [is_number], "translation_error": [is_number], "ok": [is_share]}
_QUARTILES = {"q25": is_number, "median": is_number, "q75": is_number}
_ROW = {
    "data": is_text,
    "solver": is_text,
    "success": RATE,
    "rotation_error_deg": _QUARTILES,
    "translation_error": _QUARTILES,
    "ok": is_share,
    "us_per_problem": is_positive,
    "per_problem?": _PER_PROBLEM,
}
_SET = {
    "description?": is_mapping_or_none,
    "n": is_count,
    "max_rotation_deg": is_number,
    "max_translation": is_number,
    "unit": is_text,
}
_FORMS: dict[str, Any] = {
    "evaluation": {
        "environment": {"versions?": {"*": is_text_or_none}, "commit?": is_text_or_none},
        "solvers": {"*": {"config?": is_mapping_or_none}},
        "data": {"*": _SET},
        "rows": [_ROW],
    },
    "complexity": {"n": [is_count], "counts": {"*": [is_number_or_none]}, "ransac": [is_text]},
}


def _contradictions(results: Mapping[str, Any]) -> Iterator[str]:
    """Places of names in rows that no entry has, and of lists that are not as long as the one beside them."""
    for i, row in enumerate(results.get("rows", ())):
        lists = row.get("per_problem", {})
        if len({len(lists[key]) for key in _PER_PROBLEM if lists}) > 1:
            yield f"rows[{i}].per_problem"
        for key, names in (("data", "data"), ("solver", "solvers")):
            if row[key] not in results[names]:
                yield f"rows[{i}].{key}"


def row_errors(row: Mapping[str, Any]) -> tuple[PoseErrors, Tensor]:
    """The per-problem errors of a row of the results.

    Args:
        row: one of ``results["rows"]``.

    Returns:
        The errors in float64 and ok as bool, each of shape :math:`(B,)`.

    Raises:
        ValueError: when the row does not have them, as those in the repository do not.
    """
    if "per_problem" not in row:
        raise ValueError(f"The results of '{row['solver']}' on '{row['data']}' are without those of each problem.")
    errors = row["per_problem"]
    parts = (torch.tensor(errors[name], dtype=torch.float64) for name in PoseErrors._fields)
    return PoseErrors(*parts), torch.tensor(errors["ok"], dtype=torch.bool)


def save_results(results: Mapping[str, Any], path: str | Path) -> None:
    """Write results as one JSON file, in one piece: a reader finds the old file or the new one.

    Args:
        results: what :func:`~kornia_pnpnet.evaluation.evaluate` returned.
        path: where to; folders are made when missing.

    Raises:
        ValueError: when a number is not finite, which JSON does not know.
    """
    text = json.dumps(results, separators=(",", ":"), allow_nan=False) + "\n"
    with atomic_open(path, encoding="utf-8") as file:
        file.write(text)


def load_results(path: str | Path, *, complexity: bool = False) -> dict[str, Any]:
    """Read a results file.

    Args:
        path: what :func:`save_results` wrote.
        complexity: take operation counts, too (:func:`~kornia_pnpnet.evaluation.operations.complexity_results`).

    Returns:
        The results.

    Raises:
        FileNotFoundError: when there is no such file.
        ValueError: when it is not a results file of this format.
    """
    results = read_json(path, "a results file")
    if not isinstance(results, dict) or results.get("format") != FORMAT:
        raise ValueError(f"'{path}' is not a results file of format {FORMAT}.")
    kinds = tuple(_FORMS) if complexity else ("evaluation",)
    kind = results.get("kind", "evaluation")
    if kind not in kinds:
        raise ValueError(f"'{path}' is not a results file of {' or '.join(kinds)}.")
    wrong = next(itertools.chain(misfits(results, _FORMS[kind]), _contradictions(results)), None)
    if wrong is not None:
        raise ValueError(f"'{path}' is not a results file of {kind}: {wrong} is missing or not what it has to be.")
    return results


def source_digest() -> str:
    """A digest of the package's Python files: tells whether rows are of the same code, committed or not."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(root).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def resume(plan: Mapping[str, Any], path: str | Path) -> dict[str, Any]:
    """Join a plan with the results file that it continues.

    It continues a file that was made by the same code and versions, when all solvers and data sets of the file are
    those of the plan; the plan may have more.

    Args:
        plan: results as they are before the first row.
        path: a results file; nothing is to be continued when there is no file, or no row in it.

    Returns:
        The results of the file with the plan's solvers and data, or the plan.

    Raises:
        ValueError: when the file is not a results file, or holds rows of another plan; the message says what differs.
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
            f"'{path}' holds another evaluation, which this one cannot continue: {shown}{more}. Take another file, or "
            "overwrite this one."
        )
    return {**there, "solvers": fresh["solvers"], "data": fresh["data"]}


def _differences(there: Mapping[str, Any], plan: Mapping[str, Any]) -> list[str]:
    """Why rows that are there are not rows of a plan, in words."""
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
                found.append(f"{kind}: '{name}' is not asked for")
            elif now != entry:
                keys = [key for key in {**entry, **now} if entry.get(key) != now.get(key)]
                found.append(f"{kind}: '{name}' has another {', another '.join(keys)}")
    return found


def _three_digits(value: float) -> str:
    """Three significant digits, zeros at the end kept: 0.160."""
    return f"{value:#.3g}".rstrip(".")


def format_table(results: Mapping[str, Any]) -> str:
    """The results as a Markdown table that also reads well as plain text.

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
