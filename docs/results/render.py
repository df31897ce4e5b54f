"""Write the results pages, the overviews and their pictures from the results files. ``make.py`` is the command."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from figures import paper_figures, plot_real_matches, plot_reliability, plot_sweep
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matches import MATCHES, overview, page_facts
from measure import ANY, CHI_SQUARE_95, HERE, OURS, PAPER, PEERS, RESULTS, ROBUST
from problem_picture import plot_problem
from rates import Rates, compare_all
from short_runs import ablation, capacity, read_summary, sweep

from kornia_pnpnet import PnPNet
from kornia_pnpnet.core.tables import markdown_table
from kornia_pnpnet.evaluation.plots import plot_training
from kornia_pnpnet.evaluation.results import format_table, load_results
from kornia_pnpnet.metrics import SuccessRate
from kornia_pnpnet.pretrained import WEIGHTS_FOLDER, shipped_weights

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
    """Success and time of the most used solvers on synthetic problems: the default solver, then by success."""
    rows = {(row["solver"], row["set"]): row for row in benchmark["rows"]}
    found = []
    for spec in dict.fromkeys(solver for solver, _ in rows):
        if spec.partition(":")[0] in SUMMARY_SOLVERS:
            rates, cells = [], []
            for row in (rows.get((spec, name)) for name in SUMMARY_SETS):
                rates.append(row["success"]["rate"] if row else 0.0)
                cells += [f"{100 * rates[-1]:.1f}", f"{row['median_us']:.0f}"] if row else ["–", "–"]
            found.append((spec != ANY, -rates[0], [f"`{spec}`", *cells]))
    found.sort(key=lambda entry: entry[:2])
    header = [text for name in SUMMARY_SETS.values() for text in (f"{name}: solved (%)", "µs")]
    return markdown_table(["Solver", *header], [line for *_, line in found])


def unknown_focal(measured: Mapping[str, Any]) -> str:
    """Success and time on real matches without the focal length, from ``benchmarks/cameras.json``."""
    solvers: dict[str, list[str]] = {}
    for row in measured["real"]:
        cells = [f"{100 * row['success']:.1f}", f"{100 * row['far_but_ok']:.1f}", f"{row['us'] / 1000:.1f}"]
        solvers.setdefault(f"`{row['solver']}`", []).extend(cells)
    kinds = dict.fromkeys(row["kind"] for row in measured["real"])
    header = [text for kind in kinds for text in (f"{kind}: solved (%)", "far, believed (%)", "ms")]
    return markdown_table(["Solver", *header], [[name, *cells] for name, cells in solvers.items()])


def rigs(measured: Mapping[str, Any]) -> dict[str, float]:
    """Least success on rigs and the range of times as fast as PoseLib. From the same file."""
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
    found_cov = found["covariance"]
    covariances = [[name, f"{x['mean']:.2f}", str(SuccessRate(**x["inside"]))] for name, x in found_cov.items()]
    means, inside = ([x["mean"] for x in found_cov.values()], [100 * x["inside"]["rate"] for x in found_cov.values()])
    return {
        "oks": markdown_table(["`ok` (%)", *(f"`{name}`" for name in names)], oks),
        "covariances": markdown_table(["Problems", "mean", "below the limit"], covariances),
        "mean": (min(means), max(means)),
        "inside": (min(inside), max(inside)),
        "errors": [entry["error"] for entry in found["reliability"].values()],
    }


def belief(found: Mapping[str, Any]) -> str:
    """How many far-off poses and how many right poses are ``ok``, by kind of problem and solver."""
    names = [name for name in found if name not in ("environment", "law")]
    lines = []
    for kind in found[names[0]]["kinds"]:
        line = [kind]
        for name in names:
            rates = found[name]["kinds"][kind]
            shares = (rates.get(key) for key in ("ok_of_far", "ok_of_right"))
            line.append(" / ".join("–" if x is None else f"{100 * x['rate']:.1f}" for x in shares))
        lines.append(line)
    return markdown_table(["`ok` of far-off / of right poses (%)", *(f"`{name}`" for name in names)], lines)


def judge(found: Mapping[str, Any]) -> str:
    """What each part of the judge is worth: a row for each part, a column for each set."""
    sets = found["sets"]
    whole = {name: rows[""] for name, rows in sets.items()}

    def cell(name: str, part: str) -> str:
        row, before = sets[name][part], whole[name]
        change, error = (100 * x for x in (row["success"] - before["success"], row["error"]))
        return f"{change:+.1f} ± {error:.1f}; {100 * row['far_ok']:.1f}"

    first = [f"{100 * row['success']:.1f}; {100 * row['far_ok']:.1f}" for row in whole.values()]
    parts = [part for part in next(iter(sets.values())) if part]
    lines = [["whole judge", *first], *([f"without {part}", *(cell(name, part) for name in sets)] for part in parts)]
    return markdown_table(["Solved (%) or change; far off and `ok` (%)", *sets], lines)


def page() -> str:
    """The results page as Markdown."""
    results = {name: load_results(HERE / f"{name}.json") for name in RESULTS}
    complexity, runs = load("complexity"), {name: read_summary(HERE / f"{name}.csv") for name in SUMMARIES}
    benchmark, cameras = (load(name, REPOSITORY / "benchmarks") for name in ("solvers", "cameras"))
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
        overview=written("overview.md.jinja", link="real_matches.md", **overview(load_matches())),
        summary=summary(benchmark),
        benchmark=benchmark,
        unknown_focal=unknown_focal(cameras),
        rigs=rigs(cameras),
        beside_robust=compare_all((rates["set"], rates["set_real"]), ANY, ROBUST),
        beside_peers=compare_all((rates["set"], rates["set_real"]), ANY, PEERS),
        ours_beside_peers=compare_all((rates["paper"], rates["gaussian_pose"], rates["real"]), OURS, PEERS),
        honest=honesty(load("honesty")),
        belief=belief(load("probability")),
        judge=judge(load("judge")),
        chi_square=CHI_SQUARE_95,
        distribution_table=format_table(results["distribution"]),
        ablation=ablation(runs["ablation"]),
        sweep=sweep(runs["sweep"]),
        capacity=capacity(runs["capacity"], "set-{width}x{layers}x{hidden}".format(**any_network.config)),
        weights=shipped_weights(),
        rates=rates,
    )


def real_matches() -> str:
    """The page on real matches as Markdown."""
    facts = page_facts(load_matches(), load("real_matches_cost"), load("keypoints"))
    return written("real_matches.md.jinja", **facts)


def with_block(text: str, block: str) -> str:
    """The text with another block between the lines ``BEGIN`` and ``END``; ``ValueError`` without one of each line."""
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise ValueError(f"A page with an overview needs one line '{BEGIN}' and one line '{END}' below it.")
    return f"{text.partition(BEGIN)[0]}{BEGIN}\n{block}\n{END}{text.partition(END)[2]}"


def with_overview(path: Path) -> str:
    """The page at ``path`` with the overview, whose link leads from there."""
    link = Path(os.path.relpath(HERE / "real_matches.md", path.parent)).as_posix()
    block = written("overview.md.jinja", link=link, **overview(load_matches()))
    return with_block(path.read_text(encoding="utf-8"), block)


def load(name: str, folder: Path = HERE) -> Any:
    """The content of a JSON file."""
    return json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))


def load_matches() -> list[Any]:
    """The files :data:`matches.MATCHES`."""
    return [load(name) for name in MATCHES]


def pages() -> dict[Path, str]:
    """The pages and the texts that their files hold."""
    overviews = {path: with_overview(path) for path in OVERVIEW_PAGES}
    return {HERE / "README.md": page(), HERE / "real_matches.md": real_matches(), **overviews}


def render() -> None:
    """Write the pages, their pictures, and the overviews."""
    drawn = ("paper", "gaussian_pose", "real", "mismatches", "crowd", "against_n", "against_m")
    paper_figures([*(load_results(HERE / f"{name}.json") for name in drawn), load("complexity")], HERE)
    for name in shipped_weights():
        plot_training(HERE / f"training-{name}.png", WEIGHTS_FOLDER / name / "history.csv")
    plot_sweep(HERE / "sweep_against_n.png", HERE / "sweep.csv", against="model.n")
    plot_sweep(HERE / "sweep_against_m.png", HERE / "sweep.csv", against="model.m")
    plot_reliability(HERE / "reliability.png", load("honesty")["reliability"])
    plot_real_matches(HERE / "real_matches.png", load_matches()[0], load("real_matches_cost"))
    plot_problem(HERE / "problem.png")
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
