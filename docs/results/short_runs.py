"""Facts of the short training runs: ablations, the sweep, the size of the set network."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Any

from figures import mix_in_words
from measure import HERE
from rates import interval

from kornia_pnpnet.core.tables import markdown_table

EXPERIMENTS = HERE.parents[1] / "conf" / "experiment"
KERNEL = "model.solver.refine.kernel"  # column of a summary

Row = Mapping[str, str]


def read_summary(path: Path) -> list[Row]:
    """The rows of the summary of a multirun, none when there is no file."""
    if not path.exists():
        return []
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


def updates_of(rows: Sequence[Row]) -> str:
    """Number of updates of the runs; all numbers when they differ."""
    return " or ".join(dict.fromkeys(row["update"] for row in rows))


def claim(experiment: str) -> str:
    """The claim in the first comment of an experiment's file."""
    lines = (EXPERIMENTS / f"{experiment}.yaml").read_text(encoding="utf-8").splitlines()
    comment = " ".join(line.removeprefix("# ") for line in takewhile(lambda line: line.startswith("#"), lines))
    return comment.partition("Claim: ")[2]


def ablation(rows: Sequence[Row]) -> dict[str, Any]:
    """Facts of the ablations: a table, and by experiment and as ``verdicts`` the comparison with the recipe."""
    sets = [key.removesuffix("/rate") for key in rows[0] if key.endswith("/rate")]
    recipe = [row for row in rows if row["experiment"] == "recipe"]
    others = [row for row in rows if row not in recipe]
    lines = []
    for row in [*recipe, *others]:
        seed = f"seed={row['seed']}" if row.get("seed") else ""
        name = " ".join(filter(None, (row["experiment"], row.get(KERNEL), seed)))
        lines.append([f"`{name}`", *(interval(*percent(row, data)) for data in sets)])
    kinds: dict[tuple[str, str], list[Row]] = {}
    for row in others:
        kinds.setdefault((row["experiment"], row.get(KERNEL, "")), []).append(row)
    findings: dict[str, dict[str, str]] = {}
    verdicts: dict[str, list[str]] = {"Higher success": [], "Lower success": [], "No difference seen": []}
    for (experiment, kind), runs in kinds.items():
        found = ", ".join(f"{data} {compared(runs, recipe, data)}" for data in sets)
        verdict = "Lower success" if "(below)" in found else "Higher success" if "(above)" in found else None
        verdicts[verdict or "No difference seen"].append(f"`{experiment}{' ' if kind else ''}{kind}`")
        findings.setdefault(experiment, {})[kind] = found
    rates = [[percent(row, data)[0] for row in recipe] for data in sets]
    return {
        "updates": updates_of(rows),
        "seeds": len(recipe),
        "spread": max(max(values) - min(values) for values in rates),
        "table": markdown_table(["Run", *(f"{data} (%)" for data in sets)], lines),
        "verdicts": verdicts,
        "findings": [{"experiment": name, "claim": claim(name), "found": found} for name, found in findings.items()],
    }


def sweep(rows: Sequence[Row]) -> dict[str, Any]:
    """Facts of the sweep: a table of n and mix against m, and the steps in m and in n at the middle of the other."""
    runs = {(int(row["model.n"]), int(row["model.m"]), float(row["data.outliers.max_ratio"])): row for row in rows}
    all_n, all_m, mixes = (sorted(set(values)) for values in zip(*runs, strict=True))
    lines = []
    for n in all_n:
        for mix in mixes:
            cells = [interval(*percent(runs[n, m, mix], "uniform")) for m in all_m]
            lines.append([f"{n}", mix_in_words(mix), *cells])
        times = [min(float(runs[n, m, mix]["us_per_problem"]) for mix in mixes) for m in all_m]
        lines.append([f"{n}", "µs", *(f"{time:.0f}" for time in times)])
    header = ["n", "trained and tested on", *(f"m = {m} (%)" for m in all_m)]
    n, m = all_n[len(all_n) // 2], all_m[len(all_m) // 2]

    def steps(values: Sequence[int], pairs: Iterable[tuple[Row, Row]]) -> str:
        return ", ".join(
            f"{low} → {high} {compared([after], [before], 'uniform')}"
            for (low, high), (before, after) in zip(pairwise(values), pairs, strict=True)
        )

    findings = [
        f"{mix_in_words(mix)}: m at n = {n}, {steps(all_m, pairwise(runs[n, x, mix] for x in all_m))}; "
        f"n at m = {m}, {steps(all_n, pairwise(runs[x, m, mix] for x in all_n))}."
        for mix in mixes
    ]
    table = markdown_table(header, lines, align="rl" + "r" * len(all_m))
    return {"updates": updates_of(rows), "table": table, "findings": findings}


def capacity(rows: Sequence[Row], shipped: str) -> dict[str, Any]:
    """Facts of the sizes of the set network: a table, and how each size differs from the ``shipped`` one."""
    sets = [key.removesuffix("/rate") for key in rows[0] if key.endswith("/rate")]
    recipe = [row for row in rows if row["run"] == shipped]
    lines, findings = [], []
    for row in rows:
        rates = [f"{percent(row, data)[0]:.1f}" for data in sets]
        lines.append([f"`{row['run']}`", *rates])
        found = {data: compared([row], recipe, data) for data in sets}
        apart = ", ".join(f"{data} {text}" for data, text in found.items() if "overlap" not in text)
        if row not in recipe:
            findings.append(f"`{row['run']}`: {apart or 'all intervals overlap'}.")
    table = markdown_table(["Network", *(f"{data} (%)" for data in sets)], lines)
    return {"updates": updates_of(rows), "claim": claim("capacity"), "table": table, "findings": findings}
