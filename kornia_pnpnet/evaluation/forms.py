"""The form of results files, as far as their readers rely on it. Needs pydantic."""

# ruff: noqa: UP013  (a few lines for each small mapping)
from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired

from pydantic import AfterValidator
from typing_extensions import TypedDict

from kornia_pnpnet.core.schema import STRICT, Count, Kept, Positive, Share, read_json

__all__ = ["read_results"]

_Quartiles = TypedDict("_Quartiles", {"q25": float, "median": float, "q75": float})
_Rate = TypedDict("_Rate", {"rate": Share, "low": Share, "high": Share, "total": Count})
_Lists = TypedDict("_Lists", {"rotation_error_deg": list[float], "translation_error": list[float], "ok": list[Share]})
_Solver = TypedDict("_Solver", {"config": NotRequired[dict[str, Any] | None]})
_Environment = TypedDict(
    "_Environment", {"versions": NotRequired[dict[str, str | None]], "commit": NotRequired[str | None]}
)


class _Row(TypedDict):
    data: str
    solver: str
    success: _Rate
    rotation_error_deg: _Quartiles
    translation_error: _Quartiles
    ok: Share
    us_per_problem: Positive
    per_problem: NotRequired[_Lists]


class _ProblemSet(TypedDict):
    description: NotRequired[dict[str, Any] | None]
    n: Count
    max_rotation_deg: float
    max_translation: float
    unit: str


class _Evaluation(TypedDict):
    __pydantic_config__ = STRICT  # type: ignore[misc]
    format: Literal[1]
    kind: NotRequired[Literal["evaluation"]]
    environment: _Environment
    solvers: dict[str, _Solver]
    data: dict[str, _ProblemSet]
    rows: list[_Row]


def _consistent(results: _Evaluation) -> _Evaluation:
    """Refuse names in rows that have no entry, and lists of different lengths."""
    for i, row in enumerate(results["rows"]):
        if len({len(values) for values in row.get("per_problem", {}).values()}) > 1:  # type: ignore[arg-type]
            raise ValueError(f"rows[{i}].per_problem has lists of different lengths")
        for key, names in (("data", results["data"]), ("solver", results["solvers"])):
            if row[key] not in names:  # type: ignore[literal-required]
                raise ValueError(f"rows[{i}].{key} is {row[key]!r}, which has no entry")  # type: ignore[literal-required]
    return results


def read_results(path: str | Path) -> dict[str, Any]:
    """See :func:`~kornia_pnpnet.evaluation.load_results`."""
    kind: Any = Annotated[_Evaluation, AfterValidator(_consistent), Kept]
    return read_json(path, kind, "a results file of evaluation")
