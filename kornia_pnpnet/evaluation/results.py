"""Results files of evaluations: reading, writing, continuation and formatting as a table."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kornia_pnpnet.core.extras import needs
from kornia_pnpnet.core.files import atomic_open, digest
from kornia_pnpnet.core.tables import markdown_table
from kornia_pnpnet.metrics import PoseErrors, SuccessRate

__all__ = [
    "FORMAT",
    "differences",
    "format_table",
    "load_results",
    "resume",
    "row_errors",
    "save_results",
    "source_digest",
]

FORMAT = 1
_SHOWN_DIFFERENCES = 3


def row_errors(row: Mapping[str, Any]) -> tuple[PoseErrors, Tensor]:
    """Read the errors (float64) and ``ok`` (bool) of a row's problems. Each tensor has the shape :math:`(B,)`.

    Raise ``ValueError`` for a row without per-problem errors. The repository's results files have only summaries.
    """
    if "per_problem" not in row:
        raise ValueError(f"The row of '{row['solver']}' on '{row['data']}' has no per-problem errors.")
    errors = row["per_problem"]
    parts = (torch.tensor(errors[name], dtype=torch.float64) for name in PoseErrors._fields)
    return PoseErrors(*parts), torch.tensor(errors["ok"], dtype=torch.bool)


def save_results(results: Mapping[str, Any], path: str | Path) -> None:
    """Write results to a JSON file atomically. Raise ``ValueError`` for a number that is not finite."""
    with atomic_open(path, encoding="utf-8") as file:
        file.write(json.dumps(results, separators=(",", ":"), allow_nan=False) + "\n")


def load_results(path: str | Path) -> dict[str, Any]:
    """Read a file that :func:`save_results` wrote.

    Raises:
        FileNotFoundError: when the file does not exist.
        ImportError: when pydantic is not installed.
        ValueError: when the file is not a results file of this format. The message names the first invalid entry.
    """
    with needs("eval", "reading results files needs pydantic"):
        from kornia_pnpnet.core.schema import read_json
        from kornia_pnpnet.evaluation.forms import Evaluation
    results: dict[str, Any] = read_json(path, Evaluation, "a results file of evaluation")
    return results


def source_digest() -> str:
    """Compute a digest of the package's Python files. The digest identifies the code that produced a row."""
    root = Path(__file__).resolve().parents[1]
    return digest({path.relative_to(root).as_posix(): digest(path.read_bytes()) for path in root.rglob("*.py")})


def differences(before: Any, now: Any, place: str = "") -> list[str]:
    """List the differences between two nested structures of plain data, for example ``refine.m was 3 and is 4``."""
    if isinstance(before, dict | None) and isinstance(now, dict | None):
        before, now = before or {}, now or {}
        pairs = [(key, before.get(key), now.get(key)) for key in {**before, **now}]
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        pairs = list(zip(range(len(now)), before, now, strict=True))
    else:
        return [] if before == now else [f"{place[1:]} was {before!r} and is {now!r}"]
    return [line for key, old, new in pairs for line in differences(old, new, f"{place}.{key}")]


def resume(plan: Mapping[str, Any], path: str | Path) -> dict[str, Any]:
    """Return ``plan`` with the rows and the environment of the file at ``path``. A missing file is ignored.

    If the file's code, versions, solvers or data sets differ from ``plan``, a ``ValueError`` names some differences.
    """
    fresh: dict[str, Any] = json.loads(json.dumps(plan))  # tuples become lists, as in a file
    there = load_results(path) if Path(path).exists() else fresh
    if not there["rows"]:
        return fresh
    before = {"versions": there["environment"].get("versions"), "code": there.get("code")}
    now = {"versions": fresh["environment"]["versions"], "code": fresh["code"]}
    for kind in ("solvers", "data"):
        before[kind], now[kind] = there[kind], {name: fresh[kind].get(name) for name in there[kind]}
    found = differences(before, now)
    if found:
        more = [f"and {len(found) - _SHOWN_DIFFERENCES} more"] if len(found) > _SHOWN_DIFFERENCES else []
        raise ValueError(
            f"'{path}' holds another evaluation (commit {there['environment'].get('commit')}), which cannot be "
            f"continued: {'; '.join(found[:_SHOWN_DIFFERENCES] + more)}. Choose another file, or overwrite this file."
        )
    return {**there, "solvers": fresh["solvers"], "data": fresh["data"]}


def format_table(results: Mapping[str, Any]) -> str:
    """Format results as a Markdown table: success with its 95 % interval, median errors, time and share of ``ok``."""
    lines = []
    for row in results["rows"]:
        # The flag # keeps trailing zeros, as in 0.160.
        rotation, translation = (f"{row[name]['median']:#.3g}".rstrip(".") for name in PoseErrors._fields)
        unit = results["data"][row["data"]]["unit"]
        success = str(SuccessRate(**{key: row["success"][key] for key in SuccessRate._fields}))
        cells = success, f"{rotation}°", f"{translation} {unit}".rstrip(), f"{row['us_per_problem']:.0f}"
        lines.append((row["data"], row["solver"], *cells, f"{100 * row['ok']:.1f} %"))
    header = ("data", "solver", "success [95 %]", "median rotation error", "median translation error")
    return markdown_table((*header, "µs/problem", "ok"), lines, align="llrrrrr", pad=True)
