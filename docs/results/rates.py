"""Success rates of results files and of short training runs (ablations, the sweep, the size of the set network)."""

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import takewhile
from typing import Any

from figures import grouped, mix_in_words
from measure import BOUNDS, HERE


def shown(data: str) -> str:
    """The name of a set of problems as a title."""
    short = data.replace("synthetic, ", "").replace("any_rotation", "any rotation").replace("_", " ")
    short = short.replace("+0 outliers (raw matches)", "raw matches")
    return re.sub(r"(\d)-(\d)", r"\1–\2", short)


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

    def difference(self, data: str, one: str, other: str) -> tuple[float, bool]:
        """Difference of two solvers in points, and whether their intervals are apart."""
        a, b = (self.rows[data, name]["success"] for name in (one, other))
        return 100 * (a["rate"] - b["rate"]), a["low"] > b["high"] or b["low"] > a["high"]

    def best(self, data: str, solvers: Iterable[str]) -> str:
        """The solver with the highest success."""
        return max((name for name in solvers if (data, name) in self.rows), key=lambda name: self.rate(data, name))

    def reach(self) -> float:
        """The largest half-width of an interval, in points."""
        found = [row["success"] for row in self.rows.values()]
        return 100 * max(max(one["rate"] - one["low"], one["high"] - one["rate"]) for one in found)

    def first(self, data: str, solver: str) -> bool:
        """Whether no other solver solves more of a set, bounds aside."""
        best = self.best(data, [name for name in self.solvers if name not in BOUNDS])
        return (data, solver) in self.rows and self.rate(data, solver) == self.rate(data, best)

    def titles(self) -> tuple[str, list[str]]:
        """What the names of all sets begin with, and the titles of the sets without it."""
        start = self.sets[0].rpartition(", ")[0]
        start = start if all(data.startswith(start) for data in self.sets) else ""
        return shown(start), [shown(data.removeprefix(f"{start}, ")) for data in self.sets]


def compare_all(files: Iterable[Rates], solver: str, others: Sequence[str]) -> dict[str, dict[str, tuple[str, float]]]:
    """All sets of some results files by how a solver compares with the best of the others.

    The solver is ``ahead`` or ``behind`` where the intervals are apart; elsewhere they are ``overlapping``. Each set
    has the best other solver, and its lead in points.
    """
    found: dict[str, dict[str, tuple[str, float]]] = {"ahead": {}, "overlapping": {}, "behind": {}}
    for rates in files:
        for data in rates.sets:
            best = rates.best(data, others)
            lead, apart = rates.difference(data, best, solver)
            verdict = "overlapping" if not apart else "behind" if lead > 0 else "ahead"
            found[verdict][data] = best, lead
    return found


EXPERIMENTS = HERE.parents[1] / "conf" / "experiment"
KERNEL = "model.solver.refine.kernel"  # column of a summary

Row = Mapping[str, str]


def percent(row: Row, data: str) -> tuple[float, float, float]:
    """Success of a run on a validation set in per cent, and its interval."""
    rate, low, high = (100 * float(row[f"{data}/{key}"]) for key in ("rate", "low", "high"))
    return rate, low, high


def compared(runs: Sequence[Row], others: Sequence[Row], data: str) -> str:
    """Difference of the means of two groups of runs in points, and whether all their intervals are apart."""
    (rates, lows, highs), (other_rates, other_lows, other_highs) = (
        zip(*(percent(row, data) for row in rows), strict=True) for rows in (runs, others)
    )
    difference = sum(rates) / len(rates) - sum(other_rates) / len(other_rates)
    above, below = min(lows) > max(other_highs), max(highs) < min(other_lows)
    return f"{difference:+.1f} points ({'above' if above else 'below' if below else 'intervals overlap'})"


def claim(experiment: str) -> str:
    """The claim in the first comment of an experiment's file."""
    lines = (EXPERIMENTS / f"{experiment}.yaml").read_text(encoding="utf-8").splitlines()
    comment = " ".join(line.removeprefix("# ") for line in takewhile(lambda line: line.startswith("#"), lines))
    return comment.partition("Claim: ")[2]


def validation_sets(rows: Sequence[Row]) -> list[str]:
    """Names of the validation sets of runs."""
    return [key.removesuffix("/rate") for key in rows[0] if key.endswith("/rate")]


def ablation(rows: Sequence[Row]) -> dict[str, Any]:
    """Facts of the ablations: a table, and by experiment and as ``verdicts`` the comparison with the recipe."""
    sets = validation_sets(rows)
    recipe = [row for row in rows if row["experiment"] == "recipe"]
    others = [row for row in rows if row not in recipe]
    findings: dict[str, dict[str, str]] = {}
    verdicts: dict[str, list[str]] = {"Higher success": [], "Lower success": [], "No difference seen": []}
    for (experiment, kind), runs in grouped(others, "experiment", KERNEL).items():
        found = ", ".join(f"{data} {compared(runs, recipe, data)}" for data in sets)
        verdict = "Lower success" if "(below)" in found else "Higher success" if "(above)" in found else None
        verdicts[verdict or "No difference seen"].append(f"`{f'{experiment} {kind}'.strip()}`")
        findings.setdefault(experiment, {})[kind] = found
    rates = [[percent(row, data)[0] for row in recipe] for data in sets]
    return {
        "updates": rows[0]["update"],
        "seeds": len(recipe),
        "spread": max(max(values) - min(values) for values in rates),
        "sets": sets,
        "runs": [*recipe, *others],
        "verdicts": verdicts,
        "findings": [{"experiment": name, "claim": claim(name), "found": found} for name, found in findings.items()],
    }


def sweep(rows: Sequence[Row]) -> dict[str, Any]:
    """Facts of the sweep: runs by n, m and mix, least times over the mixes, and the middle n and m."""
    runs = {(int(row["model.n"]), int(row["model.m"]), float(row["data.outliers.max_ratio"])): row for row in rows}
    all_n, all_m, mixes = (sorted(set(values)) for values in zip(*runs, strict=True))
    times = {(n, m): min(float(runs[n, m, mix]["us_per_problem"]) for mix in mixes) for n in all_n for m in all_m}
    middle = {"middle_n": all_n[len(all_n) // 2], "middle_m": all_m[len(all_m) // 2]}
    axes = {"n": all_n, "m": all_m, "mixes": {mix: mix_in_words(mix) for mix in mixes}}
    return {"updates": rows[0]["update"], "runs": runs, "times": times, **axes, **middle}
