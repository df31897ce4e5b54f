"""Write the results pages, the overviews and their pictures from the results files. ``make.py`` is the command."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from figures import paper_figures, plot_reliability, plot_sweep
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matches import MATCHES, overview, page_facts
from measure import ANY, CHI_SQUARE_95, HERE, OURS, PAPER, PEERS, RESULTS, ROBUST
from problem_picture import plot_problem
from rates import Rates, compare_all
from real_matches_picture import plot_real_matches
from short_runs import Row, ablation, capacity, read_summary, sweep

from kornia_pnpnet import PnPNet
from kornia_pnpnet.core.tables import markdown_table
from kornia_pnpnet.evaluation.plots import plot_training
from kornia_pnpnet.evaluation.results import format_table, load_results
from kornia_pnpnet.metrics import SuccessRate
from kornia_pnpnet.pretrained import WEIGHTS_FOLDER, shipped_weights

__all__ = ["OVERVIEW_PAGES", "SUMMARIES", "page", "real_matches", "render", "with_block"]

REPOSITORY = HERE.parents[1]
#: Files of short runs, see ``make.py``.
SUMMARIES = ("ablation", "sweep", "capacity")
#: Pages that show the overview between the lines ``BEGIN`` and ``END``.
OVERVIEW_PAGES = (REPOSITORY / "README.md", REPOSITORY / "docs" / "index.md")
BEGIN, END = "<!-- overview:begin -->", "<!-- overview:end -->"
# Solvers and sets of ``benchmarks/solvers.json`` in the summary of synthetic problems.
SUMMARY_SOLVERS = (ANY, OURS, "p3p-ransac", "poselib", "pycolmap", "opencv-ransac", "opencv-usac")
SUMMARY_SETS = {"n = 9, 0 to 3 outliers": "0–3 of 9 wrong", "n = 100, 70 outliers": "70 of 100 wrong"}


def written(template: str, **facts: Any) -> str:
    """A page of this folder from its template."""
    options: dict[str, Any] = {"trim_blocks": True, "lstrip_blocks": True, "keep_trailing_newline": True}
    environment = Environment(loader=FileSystemLoader(HERE), undefined=StrictUndefined, autoescape=False, **options)
    return environment.get_template(template).render(**facts)


def summary(benchmark: Mapping[str, Any]) -> str:
    """Success and time of the most used solvers on synthetic problems: the default solver, then by success.

    Args:
        benchmark: ``benchmarks/solvers.json``.
    """
    rows = {(row["solver"], row["set"]): row for row in benchmark["rows"]}
    found = []
    for spec in dict.fromkeys(solver for solver, _ in rows):
        if spec.partition(":")[0] in SUMMARY_SOLVERS:
            there = [rows.get((spec, name)) for name in SUMMARY_SETS]
            cells = [
                (f"{100 * row['success']['rate']:.1f}", f"{row['median_us']:.0f}") if row else ("–", "–")
                for row in there
            ]
            found.append((there[0]["success"]["rate"] if there[0] else 0.0, [f"`{spec}`", *cells[0], *cells[1]]))
    found.sort(key=lambda entry: (entry[1][0] != f"`{ANY}`", -entry[0]))
    header = [text for name in SUMMARY_SETS.values() for text in (f"{name}: solved (%)", "µs")]
    return markdown_table(["Solver", *header], [line for _, line in found])


def unknown_focal(measured: Mapping[str, Any]) -> str:
    """Success and time on real matches without the focal length.

    Args:
        measured: ``benchmarks/cameras.json``.
    """
    solvers: dict[str, list[str]] = {}
    for row in measured["real"]:
        cells = [f"{100 * row['success']:.1f}", f"{100 * row['far_but_ok']:.1f}", f"{row['us'] / 1000:.1f}"]
        solvers.setdefault(f"`{row['solver']}`", []).extend(cells)
    kinds = dict.fromkeys(row["kind"] for row in measured["real"])
    header = [text for kind in kinds for text in (f"{kind}: solved (%)", "far, believed (%)", "ms")]
    return markdown_table(["Solver", *header], [[name, *cells] for name, cells in solvers.items()])


def rigs(measured: Mapping[str, Any]) -> dict[str, float]:
    """Least success on rigs and the range of times as fast as PoseLib. The argument is that of `unknown_focal`."""
    cells: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in measured["rigs"]:
        cells.setdefault((row["cameras"], row["baseline"], row["n"], row["share"]), {})[row["solver"]] = row
    ratios = [found["PoseLib"]["us"] / found[ANY]["us"] for found in cells.values()]
    success = [{name: 100 * found[name]["success"] for name in (ANY, "PoseLib")} for found in cells.values()]
    return {
        "slowest": min(ratios),
        "fastest": max(ratios),
        "least": min(x[ANY] for x in success),
        "least_poselib": min(x["PoseLib"] for x in success),
    }


def honesty(found: Mapping[str, Any]) -> dict[str, Any]:
    """How many answers are ``ok``, how well weights are calibrated, and how well covariances fit."""
    names = list(dict.fromkeys(name for rates in found["ok"].values() for name in rates))
    oks = [
        [kind, *(f"{100 * rates[name]['rate']:.1f}" if name in rates else "–" for name in names)]
        for kind, rates in found["ok"].items()
    ]
    covariances = [
        [name, f"{entry['mean']:.2f}", str(SuccessRate(**entry["inside"]))]
        for name, entry in found["covariance"].items()
    ]
    means, inside = zip(
        *((one["mean"], 100 * one["inside"]["rate"]) for one in found["covariance"].values()), strict=True
    )
    return {
        "oks": markdown_table(["`ok` (%)", *(f"`{name}`" for name in names)], oks),
        "covariances": markdown_table(["Problems", "mean", "below the limit"], covariances),
        "mean": (min(means), max(means)),
        "inside": (min(inside), max(inside)),
        "errors": [entry["error"] for entry in found["reliability"].values()],
    }


def page(
    results: Mapping[str, Mapping[str, Any]],
    complexity: Mapping[str, Any],
    honest: Mapping[str, Any],
    short_runs: Mapping[str, Sequence[Row]],
    benchmark: Mapping[str, Any],
    matches: Sequence[Mapping[str, Any]],
    cameras: Mapping[str, Any],
) -> str:
    """The results page as Markdown.

    Args:
        results: the results files by their names, see ``RESULTS``.
        complexity: operation counts.
        honest: the file of ``measure_honesty``.
        short_runs: the summaries :data:`SUMMARIES`.
        benchmark: ``benchmarks/solvers.json``.
        matches: the files :data:`matches.MATCHES`.
        cameras: ``benchmarks/cameras.json``.
    """
    at_nine = complexity["n"].index(9)
    any_network: Any = PnPNet.from_pretrained(ANY).init
    rates = {name: Rates(entry) for name, entry in results.items()}
    return written(
        "README.md.jinja",
        ours=OURS,
        paper=PAPER,
        any=ANY,
        shipped_views=PnPNet.from_pretrained(OURS).views,
        made=results["paper"]["environment"],
        commits={name: f"{entry['environment']['commit']:.9}" for name, entry in results.items()},
        results=results,
        operations={name: counts[at_nine] for name, counts in complexity["counts"].items()},
        overview=overview(matches, "real_matches.md"),
        summary=summary(benchmark),
        benchmark=benchmark,
        unknown_focal=unknown_focal(cameras),
        rigs=rigs(cameras),
        beside_robust=compare_all((rates["set"], rates["set_real"]), ANY, ROBUST),
        beside_peers=compare_all((rates["set"], rates["set_real"]), ANY, PEERS),
        ours_beside_peers=compare_all((rates["paper"], rates["gaussian_pose"], rates["real"]), OURS, PEERS),
        honest=honesty(honest),
        chi_square=CHI_SQUARE_95,
        distribution_table=format_table(results["distribution"]),
        ablation=ablation(short_runs["ablation"]),
        sweep=sweep(short_runs["sweep"]),
        capacity=capacity(short_runs["capacity"], "set-{width}x{layers}x{hidden}".format(**any_network.config)),
        weights=shipped_weights(),
        rates=rates,
    )


def real_matches(files: Sequence[Mapping[str, Any]], costs: Mapping[str, Any], keypoints: Mapping[str, Any]) -> str:
    """The page on real matches as Markdown. Arguments are those of :func:`matches.page_facts`."""
    return written("real_matches.md.jinja", **page_facts(files, costs, keypoints))


def with_block(text: str, block: str) -> str:
    """The text with another block between the lines ``BEGIN`` and ``END``.

    Raises:
        ValueError: when the text has not exactly one of each line.
    """
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise ValueError(f"A page with an overview needs one line '{BEGIN}' and one line '{END}' below it.")
    before, after = text.partition(BEGIN)[0], text.partition(END)[2]
    return f"{before}{BEGIN}\n{block}\n{END}{after}"


def overview_of(path: Path, matches: Sequence[Mapping[str, Any]]) -> str:
    """The overview for a page, whose link leads from there."""
    return overview(matches, Path(os.path.relpath(HERE / "real_matches.md", path.parent)).as_posix())


def load(name: str, folder: Path = HERE) -> Any:
    """The content of a JSON file."""
    return json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))


def render() -> None:
    """Write the pages, their pictures, and the overviews."""
    results = {name: load_results(HERE / f"{name}.json") for name in RESULTS}
    complexity, honest, matches = load("complexity"), load("honesty"), [load(name) for name in MATCHES]
    drawn = ("paper", "gaussian_pose", "real", "mismatches", "crowd", "against_n", "against_m")
    paper_figures([*(results[name] for name in drawn), complexity], HERE)
    for name in shipped_weights():
        plot_training(HERE / f"training-{name}.png", WEIGHTS_FOLDER / name / "history.csv")
    plot_sweep(HERE / "sweep_against_n.png", HERE / "sweep.csv", against="n")
    plot_sweep(HERE / "sweep_against_m.png", HERE / "sweep.csv", against="m")
    plot_reliability(HERE / "reliability.png", honest["reliability"])
    plot_real_matches(HERE / "real_matches.png", matches[0], load("real_matches_cost"))
    plot_problem(HERE / "problem.png")
    write_pages(results, complexity, honest, matches)


def write_pages(
    results: Mapping[str, Any], complexity: Mapping[str, Any], honest: Mapping[str, Any], matches: Sequence[Any]
) -> None:
    """Write the pages and the overviews."""
    short_runs = {name: read_summary(HERE / f"{name}.csv") for name in SUMMARIES}
    benchmark, cameras = (load(name, REPOSITORY / "benchmarks") for name in ("solvers", "cameras"))
    text = page(results, complexity, honest, short_runs, benchmark, matches, cameras)
    (HERE / "README.md").write_text(text, encoding="utf-8")
    text = real_matches(matches, load("real_matches_cost"), load("keypoints"))
    (HERE / "real_matches.md").write_text(text, encoding="utf-8")
    for path in OVERVIEW_PAGES:
        text = with_block(path.read_text(encoding="utf-8"), overview_of(path, matches))
        path.write_text(text, encoding="utf-8")
