"""Write the results page and its pictures from the results files. ``make.py`` is the command."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from keypoint_tables import keypoint_tables
from measure import ANY, CHI_SQUARE_95, HERE, OURS, PAPER, PEERS, RESULTS, ROBUST
from overview_picture import OverviewRow, plot_overview
from real_matches_picture import find_rows, plot_real_matches

from kornia_pnpnet import PnPNet
from kornia_pnpnet.core.tables import markdown_table
from kornia_pnpnet.evaluation.figures import paper_figures, plot_reliability, plot_sweep, plot_training
from kornia_pnpnet.evaluation.figures.training import mix_in_words
from kornia_pnpnet.evaluation.results import format_table, load_results
from kornia_pnpnet.metrics import SuccessRate
from kornia_pnpnet.pretrained import WEIGHTS_FOLDER, shipped_weights

__all__ = [
    "SUMMARIES",
    "Rates",
    "ablation",
    "capacity",
    "claim",
    "compared",
    "measured_on_matches",
    "overview",
    "page",
    "real_matches",
    "render",
    "sweep",
    "with_block",
]

REPOSITORY = HERE.parents[1]
EXPERIMENTS = REPOSITORY / "conf" / "experiment"
#: Files of `benchmarks/real_matches.py measure` on other scenes, the latest last.
LATER_MATCHES = ("real_matches_again", "real_matches_third", "real_matches_fourth")
#: Files of short runs, see ``make.py``.
SUMMARIES = ("ablation", "sweep", "capacity")
KERNEL = "model.solver.refine.kernel"  # column of a summary
#: The solvers of the overview: the titles by the names in ``benchmarks/solvers.json``.
OVERVIEW = {
    ANY: f"{ANY} (ours)",
    "poselib": "PoseLib",
    "opencv-ransac": "OpenCV RANSAC",
    "pycolmap": "pycolmap",
}
OVERVIEW_SETS = ("n = 9, no outliers", "n = 9, 0 to 3 outliers")
BEGIN, END = "<!-- overview:begin -->", "<!-- overview:end -->"

Row = Mapping[str, str]


class Rates:
    """Success rates and times of a results file, by data set and solver.

    Args:
        results: the results file.
    """

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

    def versus(self, data: str, one: str, other: str) -> str:
        """Difference of two solvers in points, and whether their intervals are apart."""
        a, b = (self.rows[data, name]["success"] for name in (one, other))
        apart = a["low"] > b["high"] or b["low"] > a["high"]
        difference = 100 * (a["rate"] - b["rate"])
        verdict = ("ahead" if difference > 0 else "behind") if apart else "intervals overlap"
        return f"{difference:+.1f} points ({verdict})"

    def best(self, data: str, solvers: Iterable[str]) -> str:
        """The solver with the highest success."""
        return max((name for name in solvers if (data, name) in self.rows), key=lambda name: self.rate(data, name))

    def table(self, sets: Sequence[str] | None = None, *, times: bool = True) -> str:
        """A line for each solver: success with its interval and, with ``times``, microseconds for each set."""
        sets = self.sets if sets is None else sets
        start = f"{sets[0].rpartition(', ')[0]}, "
        common = all(data.startswith(start) for data in sets)
        header = ["Solver"]
        for data in sets:
            header += [f"{data.removeprefix(start) if common else data} (%)", *(["µs"] if times else [])]
        lines = []
        for solver in self.solvers:
            if any((data, solver) in self.rows for data in sets):
                cells = [cell for data in sets for cell in self._cells(data, solver)[: 1 + times]]
                lines.append([f"`{solver}`", *cells])
        return markdown_table(header, lines)

    def _cells(self, data: str, solver: str) -> tuple[str, str]:
        if (data, solver) not in self.rows:
            return "–", "–"
        success = self.rows[data, solver]["success"]
        return interval(*(100 * success[key] for key in ("rate", "low", "high"))), f"{self.time(data, solver):.0f}"


def interval(rate: float, low: float, high: float) -> str:
    """A rate with its interval."""
    return f"{rate:.1f} [{low:.1f}, {high:.1f}]"


# -- short runs --------------------------------------------------------------------------------------------------------


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
    """Facts of the ablations: updates, seeds and their spread, a table, and for each experiment claim and findings."""
    sets = [key.removesuffix("/rate") for key in rows[0] if key.endswith("/rate")]
    recipe = [row for row in rows if row["experiment"] == "recipe"]
    others = [row for row in rows if row not in recipe]
    lines = []
    for row in [*recipe, *others]:
        seed = f"seed={row['seed']}" if row.get("seed") else ""
        name = " ".join(filter(None, (row["experiment"], row.get(KERNEL), seed)))
        lines.append([f"`{name}`", *(interval(*percent(row, data)) for data in sets)])
    findings: dict[str, dict[str, list[Row]]] = {}
    for row in others:
        findings.setdefault(row["experiment"], {}).setdefault(row.get(KERNEL, ""), []).append(row)
    rates = [[percent(row, data)[0] for row in recipe] for data in sets]
    return {
        "updates": updates_of(rows),
        "seeds": len(recipe),
        "spread": max(max(values) - min(values) for values in rates),
        "table": markdown_table(["Run", *(f"{data} (%)" for data in sets)], lines),
        "findings": [
            {
                "experiment": experiment,
                "claim": claim(experiment),
                "found": {
                    kind: ", ".join(f"{data} {compared(runs, recipe, data)}" for data in sets)
                    for kind, runs in by_kind.items()
                },
            }
            for experiment, by_kind in findings.items()
        ],
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


# -- the page ----------------------------------------------------------------------------------------------------------


def beside_peers(rates: Rates, solvers: Sequence[str], others: Sequence[str]) -> str:
    """One line for each data set: how far some solvers are from the best of the others."""
    lines = []
    for data in rates.sets:
        best = rates.best(data, others)
        names = [f"`{name}` " if len(solvers) > 1 else "" for name in solvers]
        parts = ", ".join(
            f"{name}{rates.versus(data, solver, best)}" for name, solver in zip(names, solvers, strict=True)
        )
        lines.append(f"- {data}, best is `{best}` with {rates.rate(data, best):.1f} %: {parts}.")
    return "\n".join(lines)


def honesty_tables(found: Mapping[str, Any]) -> dict[str, str]:
    """How many answers are ``ok``, and how well covariances fit, as tables."""
    names = list(dict.fromkeys(name for rates in found["ok"].values() for name in rates))
    oks = [
        [kind, *(str(SuccessRate(**rates[name])) if name in rates else "–" for name in names)]
        for kind, rates in found["ok"].items()
    ]
    covariances = [
        [name, f"{entry['mean']:.2f}", str(SuccessRate(**entry["inside"]))]
        for name, entry in found["covariance"].items()
    ]
    return {
        "oks": markdown_table(["", *(f"`{name}`" for name in names)], oks),
        "covariances": markdown_table(["", "mean", "below the limit"], covariances),
    }


def page(
    results: Mapping[str, Mapping[str, Any]],
    complexity: Mapping[str, Any],
    honest: Mapping[str, Any],
    short_runs: Mapping[str, Sequence[Row]],
) -> str:
    """The results page as Markdown.

    Args:
        results: the results files by their names, see ``RESULTS``.
        complexity: operation counts.
        honest: the file of ``measure_honesty``.
        short_runs: the summaries :data:`SUMMARIES`.
    """
    at_nine = complexity["n"].index(9)
    any_network: Any = PnPNet.from_pretrained(ANY).init
    loader = FileSystemLoader(HERE)
    options: dict[str, Any] = {"trim_blocks": True, "lstrip_blocks": True, "keep_trailing_newline": True}
    environment = Environment(loader=loader, undefined=StrictUndefined, autoescape=False, **options)
    return environment.get_template("README.md.jinja").render(
        ours=OURS,
        paper=PAPER,
        any=ANY,
        shipped_views=PnPNet.from_pretrained(OURS).views,
        made=results["paper"]["environment"],
        commits=list(dict.fromkeys(f"{entry['environment']['commit']:.9}" for entry in results.values())),
        results=results,
        operations={name: counts[at_nine] for name, counts in complexity["counts"].items()},
        peers=(*PEERS, "opencv-epnp", "opencv-sqpnp"),
        robust=ROBUST,
        beside_peers=beside_peers,
        honest={**honest, **honesty_tables(honest)},
        chi_square=CHI_SQUARE_95,
        distribution_table=format_table(results["distribution"]),
        ablation=ablation(short_runs["ablation"]),
        sweep=sweep(short_runs["sweep"]),
        capacity=capacity(short_runs["capacity"], "set-{width}x{layers}x{hidden}".format(**any_network.config)),
        weights=shipped_weights(),
        **{f"{name}_rates": Rates(entry) for name, entry in results.items()},
    )


def measured_on_matches(results: Mapping[str, Any]) -> dict[str, Any]:
    """Tables of a file of ``benchmarks/real_matches.py measure``.

    Returns:
        ``kinds``; ``rows`` by kind, solver and group; ``tables`` by kind; ``peer``, the best PoseLib; ``beside``, each
        solver beside that: name, success and points ahead in per cent, and the ratio of times; ``total`` of problems;
        ``scenes``, a table.
    """
    settings = results["settings"]
    kinds = list(dict.fromkeys(row["kind"] for row in results["rows"]))
    rows = {kind: find_rows(results, kind) for kind in kinds}
    groups = ["all", *(f"{100 * a:.0f}–{100 * b:.0f} %" for a, b in pairwise(settings["shares"]))]

    def number(value: float | None, factor: float = 100.0) -> str:
        return "–" if value is None else f"{factor * value:.{1 if factor > 1 else 2}f}"

    tables = {}
    for kind, found in rows.items():
        counts = [found[settings["solvers"][0]][group]["count"] for group in groups]
        header = [f"{kind}: right (%)", "ms", *(f"{g} ({n})" for g, n in zip(groups, counts, strict=True))]
        header += ["ok of right", "ok of far off"]
        lines = [
            [
                f"`{name}`",
                number(one["all"]["ms_per_problem"], 1.0),
                *(number(one[group]["success"]) for group in groups),
                *(number(one["all"][key]) for key in ("ok_of_right", "ok_of_far")),
            ]
            for name, one in found.items()
        ]
        tables[kind] = markdown_table(header, lines)

    def total(name: str, key: str) -> float:
        every = [rows[kind][name]["all"] for kind in kinds]
        return float(sum(row["count"] * row[key] for row in every) / sum(row["count"] for row in every))

    peers = [name for name in settings["solvers"] if name.startswith("poselib")]
    peer = max(peers, key=lambda name: total(name, "success"))
    beside = [
        (name, 100 * total(name, "success"), 100 * (total(name, "success") - total(peer, "success")), times)
        for name in settings["solvers"]
        for times in [total(name, "ms_per_problem") / total(peer, "ms_per_problem")]
    ]
    known = {row["scene"]: row for row in read_summary(HERE / "real_matches_scenes.csv")}
    lines = []
    for entry in results["counts"]:
        facts = known.get(entry["scene"], {})
        numbers = [str(entry[kind]["counted"]) for kind in kinds]
        lines.append([entry["scene"], *(facts.get(key, "–") for key in ("shows", "source", "licence")), *numbers])
    scenes = markdown_table(
        ["Scene", "shows", "public repository", "licence", *(f"problems, {k}" for k in kinds)], lines
    )
    count = sum(rows[kind][settings["solvers"][0]]["all"]["count"] for kind in kinds)
    found = {"kinds": kinds, "rows": rows, "tables": tables, "peer": peer, "beside": beside}
    return {**found, "total": count, "scenes": scenes}


def real_matches(
    results: Mapping[str, Any],
    costs: Mapping[str, Any],
    later: Sequence[Mapping[str, Any]],
    keypoints: Mapping[str, Any],
) -> str:
    """The page on real matches as Markdown.

    Args:
        results: what ``benchmarks/real_matches.py measure`` wrote.
        costs: what ``benchmarks/real_matches.py cost`` wrote.
        later: what ``benchmarks/real_matches.py measure`` wrote of other scenes with later versions.
        keypoints: what ``benchmarks/keypoints.py`` wrote.
    """
    settings, facts = results["settings"], measured_on_matches(results)
    first = settings["solvers"][0]
    curve = results["reliability"][first]
    deciles = [
        (i / 10, (i + 1) / 10, int(count), predicted, observed)
        for i, (count, predicted, observed) in enumerate(
            zip(*(curve[key] for key in ("number", "predicted", "observed")), strict=True)
        )
        if count
    ]
    options: dict[str, Any] = {"trim_blocks": True, "lstrip_blocks": True, "keep_trailing_newline": True}
    environment = Environment(loader=FileSystemLoader(HERE), undefined=StrictUndefined, autoescape=False, **options)
    raw = facts["rows"][facts["kinds"][1]][first]["all"]
    return environment.get_template("real_matches.md.jinja").render(
        results=results,
        costs=costs,
        later=[{**measured_on_matches(entry), "results": entry} for entry in later],
        first=first,
        far_count=round(raw["far"] * raw["count"]),
        deciles=deciles,
        keypoints=keypoint_tables(keypoints),
        **facts,
    )


def overview(results: Mapping[str, Any]) -> tuple[list[OverviewRow], str]:
    """The solvers of the README's picture, the fastest first, and the table below it.

    Args:
        results: ``benchmarks/solvers.json``.
    """
    found = {(row["solver"], row["set"]): row for row in results["rows"]}
    rows = []
    for solver, title in OVERVIEW.items():
        without, mixed = (found[solver, name] for name in OVERVIEW_SETS)
        rates = SuccessRate(**without["success"]), SuccessRate(**mixed["success"])
        rows.append(OverviewRow(title, solver == ANY, *rates, mixed["median_us"]))
    rows.sort(key=lambda row: row.us_per_problem)
    lines = []
    for row in rows:
        cells = (row.name, f"{100 * row.without_outliers.rate:.1f} %", f"{100 * row.with_outliers.rate:.1f} %")
        mark = "**" if row.ours else ""
        lines.append([f"{mark}{cell}{mark}" for cell in (*cells, f"{row.us_per_problem:.0f}")])
    header = ["Solver", "solved, no outliers", "solved, 0–3 outliers of 9", "µs per problem, 0–3 outliers"]
    made, settings = results["environment"], results["settings"]
    source = (
        f"9 pairs, {settings['count']} synthetic problems for each column, solved in one call (other libraries: one "
        f"call per problem), one thread, {made['cpu']}. Solved: rotation error below 1°, translation error below 0.2. "
        "All solvers and sets: [benchmarks](benchmarks/solvers.md)."
    )
    return rows, f"{markdown_table(header, lines)}\n\n{source}"


def with_block(text: str, block: str) -> str:
    """The text with another block between the lines ``BEGIN`` and ``END``.

    Raises:
        ValueError: when the text has not exactly one of each line.
    """
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise ValueError(f"README.md needs one line '{BEGIN}' and one line '{END}' below it.")
    before, after = text.partition(BEGIN)[0], text.partition(END)[2]
    return f"{before}{BEGIN}\n{block}\n{END}{after}"


def render() -> None:
    """Write the page, its pictures, and the overview of the README."""
    results = {name: load_results(HERE / f"{name}.json") for name in RESULTS}
    complexity, honest = (json.loads((HERE / f"{name}.json").read_text()) for name in ("complexity", "honesty"))
    drawn = ("paper", "gaussian_pose", "real", "mismatches", "crowd", "against_n", "against_m")
    paper_figures([*(results[name] for name in drawn), complexity], HERE)
    for name in shipped_weights():
        plot_training(HERE / f"training-{name}.png", WEIGHTS_FOLDER / name / "history.csv")
    plot_sweep(HERE / "sweep_against_n.png", HERE / "sweep.csv", against="n")
    plot_sweep(HERE / "sweep_against_m.png", HERE / "sweep.csv", against="m")
    plot_reliability(HERE / "reliability.png", honest["reliability"])
    short_runs = {name: read_summary(HERE / f"{name}.csv") for name in SUMMARIES}
    (HERE / "README.md").write_text(page(results, complexity, honest, short_runs), encoding="utf-8")

    found = json.loads((HERE / "real_matches.json").read_text())
    costs = json.loads((HERE / "real_matches_cost.json").read_text())
    plot_real_matches(HERE / "real_matches.png", found, costs)
    later = [json.loads((HERE / f"{name}.json").read_text()) for name in LATER_MATCHES]
    keypoints = json.loads((HERE / "keypoints.json").read_text())
    (HERE / "real_matches.md").write_text(real_matches(found, costs, later, keypoints), encoding="utf-8")

    rows, table = overview(json.loads((REPOSITORY / "benchmarks" / "solvers.json").read_text()))
    plot_overview(HERE / "overview.png", rows, outliers="0 to 3 outliers among 9 pairs")
    readme = REPOSITORY / "README.md"
    readme.write_text(with_block(readme.read_text(encoding="utf-8"), table), encoding="utf-8")
