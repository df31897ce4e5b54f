"""Success rates of a results file: tables, and how solvers compare."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from measure import BOUNDS


def interval(rate: float, low: float, high: float) -> str:
    """A rate with its interval."""
    return f"{rate:.1f} [{low:.1f}, {high:.1f}]"


def shown(data: str) -> str:
    """The name of a set of problems as a title."""
    short = data.replace("synthetic, ", "").replace("any_rotation", "any rotation").replace("_", " ")
    short = short.replace("+0 outliers (raw matches)", "raw matches")
    return re.sub(r"(\d)-(\d)", r"\1–\2", short)


class Standing(NamedTuple):
    """Sets by how a solver compares with the best other one: their intervals are apart, or overlap.

    ``behind`` has by set the best other solver, and its lead in points.
    """

    ahead: list[str]
    behind: dict[str, tuple[str, float]]
    overlapping: list[str]

    def __str__(self) -> str:
        total = len(self.ahead) + len(self.behind) + len(self.overlapping)
        lost = "; ".join(f"{shown(data)}: `{best}` by {points:.1f}" for data, (best, points) in self.behind.items())
        lost = f" Behind, in points: {lost}." if lost else ""
        counts = f"ahead on {len(self.ahead)}, behind on {len(self.behind)}, intervals overlap on"
        return f"{counts} {len(self.overlapping)} of {total} sets.{lost}"


class Rates:
    """Success rates and times of a results file, by data set and solver."""

    def __init__(self, results: Mapping[str, Any]) -> None:
        self.rows = {(row["data"], row["solver"]): row for row in results["rows"]}
        self.sets = list(results["data"])
        self.solvers = [name for name in results["solvers"] if any((data, name) in self.rows for data in self.sets)]

    def rate(self, data: str, solver: str) -> float:
        """Success in per cent."""
        return 100 * float(self.rows[data, solver]["success"]["rate"])

    def pooled(self, solver: str, ending: str) -> float:
        """Mean success in per cent over the sets whose names end so."""
        rates = [self.rate(data, solver) for data in self.sets if data.endswith(ending)]
        return sum(rates) / len(rates)

    def time(self, data: str, solver: str) -> float:
        """Microseconds per problem."""
        return float(self.rows[data, solver]["us_per_problem"])

    def difference(self, data: str, one: str, other: str) -> tuple[float, bool]:
        """Difference of two solvers in points, and whether their intervals are apart."""
        a, b = (self.rows[data, name]["success"] for name in (one, other))
        return 100 * (a["rate"] - b["rate"]), a["low"] > b["high"] or b["low"] > a["high"]

    def versus(self, data: str, one: str, other: str) -> str:
        """The difference of two solvers in words."""
        points, apart = self.difference(data, one, other)
        return f"{points:+.1f} points ({('ahead' if points > 0 else 'behind') if apart else 'intervals overlap'})"

    def best(self, data: str, solvers: Iterable[str]) -> str:
        """The solver with the highest success."""
        return max((name for name in solvers if (data, name) in self.rows), key=lambda name: self.rate(data, name))

    def reach(self, sets: Sequence[str] | None = None) -> float:
        """The largest half-width of an interval, in points."""
        found = [row["success"] for (data, _), row in self.rows.items() if data in (sets or self.sets)]
        return 100 * max(max(one["rate"] - one["low"], one["high"] - one["rate"]) for one in found)

    def cell(self, data: str, solver: str) -> str:
        """Success in per cent for a table, a dash where the solver did not solve the set."""
        return f"{self.rate(data, solver):.1f}" if (data, solver) in self.rows else "–"

    def first(self, data: str, solver: str) -> bool:
        """Whether no other solver solves more of a set, bounds aside."""
        best = self.best(data, [name for name in self.solvers if name not in BOUNDS])
        return (data, solver) in self.rows and self.rate(data, solver) == self.rate(data, best)

    def titles(self) -> tuple[str, list[str]]:
        """What the names of all sets begin with, and the titles of the sets without it."""
        start = self.sets[0].rpartition(", ")[0]
        start = start if all(data.startswith(start) for data in self.sets) else ""
        return shown(start), [shown(data.removeprefix(f"{start}, ")) for data in self.sets]


def compare_all(files: Iterable[Rates], solver: str, others: Sequence[str]) -> Standing:
    """A solver beside the best of the others, on every set of some results files."""
    standing = Standing([], {}, [])
    for rates in files:
        for data in rates.sets:
            best = rates.best(data, others)
            points, apart = rates.difference(data, solver, best)
            if not apart:
                standing.overlapping.append(data)
            elif points > 0:
                standing.ahead.append(data)
            else:
                standing.behind[data] = best, -points
    return standing
