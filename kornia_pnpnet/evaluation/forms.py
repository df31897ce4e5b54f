"""The schema of results files, limited to the entries that readers use. The module needs pydantic."""

# ruff: noqa: UP013  (one line for each small mapping)
from __future__ import annotations

from typing import Annotated, Any, Literal, NotRequired

from pydantic import AfterValidator
from typing_extensions import TypedDict

from kornia_pnpnet.core.schema import STRICT, Count, Kept, Positive, Share

__all__ = ["Evaluation"]

_Quartiles = TypedDict("_Quartiles", {"q25": float, "median": float, "q75": float})
_Rate = TypedDict("_Rate", {"rate": Share, "low": Share, "high": Share, "total": Count})
_Lists = TypedDict("_Lists", {"rotation_error_deg": list[float], "translation_error": list[float], "ok": list[Share]})


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


class _Results(TypedDict):
    __pydantic_config__ = STRICT  # type: ignore[misc]
    format: Literal[1]
    environment: dict[str, Any]
    solvers: dict[str, dict[str, Any]]
    data: dict[str, _ProblemSet]
    rows: list[_Row]


def _consistent(results: Any) -> Any:
    """Raise ``ValueError`` if a row has an unknown data set or solver, or lists of different lengths."""
    for i, row in enumerate(results["rows"]):
        if len({len(values) for values in row.get("per_problem", {}).values()}) > 1:
            raise ValueError(f"rows[{i}].per_problem has lists of different lengths")
        for key, names in (("data", results["data"]), ("solver", results["solvers"])):
            if row[key] not in names:
                raise ValueError(f"rows[{i}].{key} is {row[key]!r}, which has no entry")
    return results


#: Schema of the files that :func:`~kornia_pnpnet.evaluation.save_results` writes.
Evaluation: Any = Annotated[_Results, AfterValidator(_consistent), Kept]
