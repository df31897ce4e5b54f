"""What the paper's figures take from results files, in one list."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import torch

from kornia_pnpnet.evaluation.problem_sets import PRIORS
from kornia_pnpnet.metrics import SuccessRate, success_rate

__all__ = [
    "NothingToDrawError",
    "Record",
    "by_solver",
    "in_words",
    "limits_in_words",
    "outliers_in_words",
    "outliers_in_order",
    "pooled",
    "records",
    "success_limit",
    "usual_n",
    "without_m",
]

_SYNTHETIC = {name for name, _ in PRIORS.values()}


_PROTOCOL_N = 9


class NothingToDrawError(ValueError):
    """The results hold no data for a figure."""


class Record(NamedTuple):
    """One solver on one data set.

    Attributes:
        source: ``paper``, another prior, or a scene.
        outliers: how many of the pairs are wrong, ``"uniform"`` (0 to a third of them), or what the file says.
        mismatches: whether every wrong pixel is that of another point, none anywhere in the image.
        n: pairs per problem.
        solver: its name, options after a colon.
        m: iterations of its refinement, when its configuration says so.
        success: rate, interval and number of problems.
        us_per_problem: time in microseconds.
        limit: what a success is, see :func:`success_limit`.
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
        """Whether the problems come from a scene."""
        return self.source not in _SYNTHETIC

    @property
    def swept(self) -> bool:
        """Whether the solver's name sets m: one point of a curve against m, no solver of its own."""
        return without_m(self.solver) != self.solver


def records(results: Iterable[Mapping[str, Any]]) -> list[Record]:
    """Read results.

    Args:
        results: what :func:`~kornia_pnpnet.evaluation.evaluate` returned, any number of times. Data sets whose
            description names no source and outliers are left out; operation counts are, too.

    Returns:
        One record for each source, outliers, n and solver: when there are several, that with the most problems, the
        last one of these. Mismatches alone are other outliers than the protocol's mix.
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


def by_solver(chosen: Iterable[Record]) -> dict[str, SuccessRate]:
    """Success by solver."""
    return {record.solver: record.success for record in chosen}


def pooled(chosen: Sequence[Record], scenes: Iterable[str]) -> dict[str, SuccessRate]:
    """Success over all problems of several scenes, for the solvers that all of these were given to.

    Args:
        chosen: records of these scenes, with the same outliers and n.
        scenes: their names.

    Returns:
        The share of all problems and its interval, by solver.
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
    """What solving a problem of an entry of ``results["data"]`` means: degrees, length, and the unit of the length."""
    return data["max_rotation_deg"], data["max_translation"], data["unit"]


def limits_in_words(limits: Iterable[tuple[float, float, str]]) -> str:
    """What counts as a success, in words."""
    rotations: set[float] = set()
    by_unit: dict[str, set[float]] = {}
    for rotation_deg, translation, unit in limits:
        rotations.add(rotation_deg)
        by_unit.setdefault(unit or "world units", set()).add(translation)
    lengths = [f"{_span(values, '.2g')} {unit}" for unit, values in by_unit.items()]
    return f"Solved: errors below {_span(rotations, 'g')}° and {' or '.join(lengths)}"


def in_words(chosen: Collection[Record]) -> str:
    """What counts as a success, and how many problems there are in each set."""
    totals = _span({record.success.total for record in chosen}, "d")
    return f"{limits_in_words(record.limit for record in chosen)}. {totals} problems in each set, 95 % intervals."


def _span(values: Collection[float], form: str) -> str:
    """The value, or the least and the largest when they differ in the form in which they are written."""
    low, high = f"{min(values):{form}}", f"{max(values):{form}}"
    return low if low == high else f"{low} to {high}"


def outliers_in_words(outliers: int | str, n: int | None = None) -> str:
    """How many pairs are wrong, for a title; of how many when ``n`` is said."""
    if outliers == 0:
        return "no wrong pairs"
    if outliers == "uniform":
        return "0 to ⌊n/3⌋ pairs wrong" if n is None else f"0 to {n // 3} of {n} pairs wrong"
    if isinstance(outliers, int):
        return f"{outliers} pairs wrong" if n is None else f"{outliers} of {n} pairs wrong"
    return outliers


def outliers_in_order(chosen: Iterable[Record]) -> list[int | str]:
    """The outlier settings there are: none, uniform, other numbers, anything else."""
    settings = {record.outliers for record in chosen}
    numbers = sorted(value for value in settings if isinstance(value, int))
    words = sorted(value for value in settings if isinstance(value, str))
    return sorted([*words, *numbers], key=lambda value: (value != 0, value != "uniform", isinstance(value, str)))


def usual_n(chosen: Iterable[Record]) -> int:
    """The n that a figure is about which does not vary it: the protocol's 9, or the smallest there is."""
    numbers = {record.n for record in chosen}
    return _PROTOCOL_N if _PROTOCOL_N in numbers else min(numbers, default=_PROTOCOL_N)
