"""Facts of the short training runs: ablations, the sweep, the size of the set network."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Any

from figures import mix_in_words
from measure import HERE

EXPERIMENTS = HERE.parents[1] / "conf" / "experiment"
KERNEL = "model.solver.refine.kernel"  # column of a summary

Row = Mapping[str, str]


def read_summary(path: Path) -> list[Row]:
    """The rows of the summary of a multirun."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


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
    kinds: dict[tuple[str, str], list[Row]] = {}
    for row in others:
        kinds.setdefault((row["experiment"], row.get(KERNEL, "")), []).append(row)
    findings: dict[str, dict[str, str]] = {}
    verdicts: dict[str, list[str]] = {"Higher success": [], "Lower success": [], "No difference seen": []}
    for (experiment, kind), runs in kinds.items():
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
    """Facts of the sweep: a table of n and mix against m, and the steps in m and in n at the middle of the other."""
    runs = {(int(row["model.n"]), int(row["model.m"]), float(row["data.outliers.max_ratio"])): row for row in rows}
    all_n, all_m, mixes = (sorted(set(values)) for values in zip(*runs, strict=True))
    times = {(n, m): min(float(runs[n, m, mix]["us_per_problem"]) for mix in mixes) for n in all_n for m in all_m}
    n, m = all_n[len(all_n) // 2], all_m[len(all_m) // 2]

    def steps(found: Mapping[int, Row]) -> str:
        return ", ".join(
            f"{low} → {high} {compared([found[high]], [found[low]], 'uniform')}" for low, high in pairwise(found)
        )

    findings = [
        f"{mix_in_words(mix)}: m at n = {n}, {steps({x: runs[n, x, mix] for x in all_m})}; "
        f"n at m = {m}, {steps({x: runs[x, m, mix] for x in all_n})}."
        for mix in mixes
    ]
    axes = {"n": all_n, "m": all_m, "mixes": {mix: mix_in_words(mix) for mix in mixes}}
    return {"updates": rows[0]["update"], "runs": runs, "times": times, **axes, "findings": findings}


def capacity(rows: Sequence[Row], shipped: str) -> dict[str, Any]:
    """Facts of the sizes of the set network: a table, and how each size differs from the ``shipped`` one."""
    sets = validation_sets(rows)
    recipe = [row for row in rows if row["run"] == shipped]
    findings = []
    for row in rows:
        found = {data: compared([row], recipe, data) for data in sets}
        apart = ", ".join(f"{data} {text}" for data, text in found.items() if "overlap" not in text)
        if row not in recipe:
            findings.append(f"`{row['run']}`: {apart or 'all intervals overlap'}.")
    return {"updates": rows[0]["update"], "claim": claim("capacity"), "sets": sets, "runs": rows, "findings": findings}
