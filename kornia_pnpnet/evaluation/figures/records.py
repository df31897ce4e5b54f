"""Results files as one list of records, for the figures of the paper."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import torch

from kornia_pnpnet.evaluation.problem_sets import PRIORS
from kornia_pnpnet.metrics import SuccessRate, success_rate

_SYNTHETIC = {name for name, _ in PRIORS.values()}
_PROTOCOL_N = 9


class NothingToDrawError(ValueError):
    """The results hold no data for a figure."""


class Record(NamedTuple):
    """One solver on one data set.

    Attributes:
        source: ``paper``, another prior, or a scene.
        outliers: number of outliers, ``"uniform"`` (0 to a third of the pairs), or another text of the file.
        mismatches: whether every outlier shows another point. Otherwise some show any place in the image.
        n: pairs per problem.
        solver: name of the solver, options after a colon.
        m: iterations of the refinement, when the configuration has a number.
        success: rate, interval and number of problems.
        us_per_problem: time in microseconds.
        limit: limits of a success, see :func:`success_limit`.
    """

    source: str
    outliers: int | str
    mismatches: bool
    n: int
    solver: str
    m: int | None
    success: SuccessRate
    us_per_problem: float
    limit: tuple[float, float, str]

    @property
    def scene(self) -> bool:
        """Whether the problems are of a scene."""
        return self.source not in _SYNTHETIC

    @property
    def swept(self) -> bool:
        """Whether the solver's name sets m: a point of a curve against m."""
        return without_m(self.solver) != self.solver


def records(results: Iterable[Mapping[str, Any]]) -> list[Record]:
    """Read results files.

    Args:
        results: results of :func:`~kornia_pnpnet.evaluation.evaluate`. Operation counts and data sets without a source
            or outliers in their description are left out.

    Returns:
        One record for each source, outliers, kind of outliers, n and solver. Of several, the one with the most
        problems, and of these the last.
    """
    found: dict[tuple[object, ...], Record] = {}
    for result in results:
        for row in result.get("rows", ()):
            data = result["data"][row["data"]]
            description = data.get("description") or {}
            if not (isinstance(description.get("source"), str) and isinstance(description.get("outliers"), int | str)):
                continue
            outliers = 0 if description["outliers"] == "none" else description["outliers"]
            record = Record(
                source=description["source"],
                outliers=outliers,
                mismatches=outliers != 0 and description.get("mismatch_share") == 1,
                n=data["n"],
                solver=row["solver"],
                m=_iterations(result["solvers"][row["solver"]]),
                success=SuccessRate._make(row["success"][key] for key in SuccessRate._fields),
                us_per_problem=row["us_per_problem"],
                limit=success_limit(data),
            )
            key = record[:5]
            if key not in found or found[key].success.total <= record.success.total:
                found[key] = record
    return list(found.values())


def _iterations(solver: Mapping[str, Any]) -> int | None:
    refine = (solver.get("config") or {}).get("refine")
    m = refine.get("m") if isinstance(refine, Mapping) else None
    return m if type(m) is int else None


def without_m(solver: str) -> str:
    """The solver's name without the option m.

    Example:
        >>> without_m("epnp-lm:m=3,damping=1"), without_m("pnpnet-n9:m=2")
        ('epnp-lm:damping=1', 'pnpnet-n9')
    """
    name, _, options = solver.partition(":")
    others = [option for option in options.split(",") if option and not option.startswith("m=")]
    return ":".join([name, *filter(None, [",".join(others)])])


def pooled(chosen: Sequence[Record], scenes: Iterable[str]) -> dict[str, SuccessRate]:
    """Success over all problems of some scenes, for each solver that solved all these scenes.

    Args:
        chosen: records of the scenes, with the same outliers and n.
        scenes: names of the scenes.
    """
    found: dict[str, dict[str, SuccessRate]] = {}
    for record in chosen:
        found.setdefault(record.solver, {})[record.source] = record.success
    rates = {}
    for solver, by_scene in found.items():
        if by_scene.keys() >= set(scenes):
            parts = [by_scene[scene] for scene in scenes]
            solved = sum(round(part.rate * part.total) for part in parts)  # a rate in a file has six digits
            rates[solver] = success_rate(torch.arange(sum(part.total for part in parts)) < solved)
    return rates


def success_limit(data: Mapping[str, Any]) -> tuple[float, float, str]:
    """Limits of a success on a data set of a results file: degrees, length, and unit of the length."""
    return data["max_rotation_deg"], data["max_translation"], data["unit"]


def limits_in_words(limits: Iterable[tuple[float, float, str]]) -> str:
    """The limits of a success, in words."""
    rotations: set[float] = set()
    by_unit: dict[str, set[float]] = {}
    for rotation_deg, translation, unit in limits:
        rotations.add(rotation_deg)
        by_unit.setdefault(unit or "world units", set()).add(translation)
    lengths = [f"{_span(values, '.2g')} {unit}" for unit, values in by_unit.items()]
    return f"Solved: errors below {_span(rotations, 'g')}° and {' or '.join(lengths)}"


def in_words(chosen: Collection[Record]) -> str:
    """The limits of a success and the number of problems in each set."""
    totals = _span({record.success.total for record in chosen}, "d")
    return f"{limits_in_words(record.limit for record in chosen)}. {totals} problems in each set, 95 % intervals."


def _span(values: Collection[float], form: str) -> str:
    """The value, or the least and the largest value when their texts differ."""
    low, high = f"{min(values):{form}}", f"{max(values):{form}}"
    return low if low == high else f"{low} to {high}"


def outliers_in_words(outliers: int | str, n: int | None = None) -> str:
    """The number of outliers, and with ``n`` the number of pairs, for a title."""
    if outliers == 0:
        return "no wrong pairs"
    if outliers == "uniform":
        return "0 to ⌊n/3⌋ pairs wrong" if n is None else f"0 to {n // 3} of {n} pairs wrong"
    if isinstance(outliers, int):
        return f"{outliers} pairs wrong" if n is None else f"{outliers} of {n} pairs wrong"
    return outliers


def outliers_in_order(chosen: Iterable[Record]) -> list[int | str]:
    """The outlier settings in order: none, uniform, other numbers, other texts."""
    settings = {record.outliers for record in chosen}
    numbers = sorted(value for value in settings if isinstance(value, int))
    words = sorted(value for value in settings if isinstance(value, str))
    return sorted([*words, *numbers], key=lambda value: (value != 0, value != "uniform", isinstance(value, str)))


def usual_n(chosen: Iterable[Record]) -> int:
    """The n of a figure that does not vary n: 9 as in the protocol, or the smallest n."""
    numbers = {record.n for record in chosen}
    return _PROTOCOL_N if _PROTOCOL_N in numbers else min(numbers, default=_PROTOCOL_N)
