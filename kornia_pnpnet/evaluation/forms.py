"""The form of results files, as far as their readers rely on it. Needs pydantic."""

# ruff: noqa: UP013  (a few lines for each small mapping)
from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired

from pydantic import AfterValidator
from typing_extensions import TypedDict

from kornia_pnpnet.core.schema import STRICT, Count, Kept, Positive, Share, read_json

__all__ = ["read_results"]


_Rate = TypedDict("_Rate", {"rate": Share, "low": Share, "high": Share, "total": Count})
_Quartiles = TypedDict("_Quartiles", {"q25": float, "median": float, "q75": float})
_PerProblem = TypedDict(
    "_PerProblem", {"rotation_error_deg": list[float], "translation_error": list[float], "ok": list[Share]}
)
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
    per_problem: NotRequired[_PerProblem]


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


class _Complexity(TypedDict):
    __pydantic_config__ = STRICT  # type: ignore[misc]
    format: Literal[1]
    n: list[Count]
    counts: dict[str, list[float | None]]
    ransac: list[str]


def _consistent(results: _Evaluation) -> _Evaluation:
    """Refuse names in rows that have no entry, and lists of different lengths."""
    for i, row in enumerate(results["rows"]):
        if len({len(values) for values in row.get("per_problem", {}).values()}) > 1:  # type: ignore[arg-type]
            raise ValueError(f"rows[{i}].per_problem has lists of different lengths")
        for key, name, names in (("data", row["data"], "data"), ("solver", row["solver"], "solvers")):
            if name not in results[names]:  # type: ignore[literal-required]
                raise ValueError(f"rows[{i}].{key} is {name!r}, which {names} does not contain")
    return results


def read_results(path: str | Path, complexity: bool) -> dict[str, Any]:
    """See :func:`~kornia_pnpnet.evaluation.load_results`."""
    what = f"a results file of evaluation{' or complexity' if complexity else ''}"
    kinds: Any = Annotated[_Evaluation, AfterValidator(_consistent), Kept]
    if complexity and read_json(path, dict[str, Any], what).get("kind") == "complexity":
        kinds = Annotated[_Complexity, Kept]
    return read_json(path, kinds, what)
