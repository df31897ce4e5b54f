"""Write the results pages, the overviews and their pictures from the results files. ``make.py`` is the command."""

import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import rates
from figures import grouped, paper_figures, plot_real_matches, plot_reliability, plot_sweep
from matches import SEEN, UNSEEN, at_size, overview, page_facts, title
from measure import ANY, CHI_SQUARE_95, HERE, OURS, PAPER, PEERS, RESULTS, ROBUST
from problem_picture import plot_problem

from kornia_pnpnet import PnPNet
from kornia_pnpnet.core.files import read_csv
from kornia_pnpnet.evaluation.plots import plot_training
from kornia_pnpnet.evaluation.results import format_table, load_results
from kornia_pnpnet.metrics import SuccessRate
from kornia_pnpnet.pretrained import WEIGHTS_FOLDER, shipped_weights

sys.path.append(str(HERE.parents[1] / "benchmarks"))
import harness

REPOSITORY = HERE.parents[1]
#: Files of short runs, see ``make.py``.
SUMMARIES = ("ablation", "sweep", "capacity")
#: Pages that show the overview between the lines ``BEGIN`` and ``END``.
OVERVIEW_PAGES = (REPOSITORY / "README.md", REPOSITORY / "docs" / "index.md")
BEGIN, END = "<!-- overview:begin -->", "<!-- overview:end -->"
# Solvers and sets of ``benchmarks/solvers.json`` in the summary of synthetic problems.
SUMMARY_SOLVERS = (ANY, OURS, "p3p-ransac", "poselib", "pycolmap", "opencv-ransac", "opencv-usac")
SUMMARY_SETS = {"n = 9, 0 to 3 outliers": "0–3 of 9 outliers", "n = 100, 70 outliers": "70 of 100 outliers"}
TIMED_SETS = ("n = 9, no outliers", "n = 9, 3 outliers")
#: The set whose median errors the summary shows.
ACCURACY_SET = "n = 200, 80 outliers, exact points"


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Rows of the most used solvers on synthetic problems, by solver: the default solver, then by success."""
    sets = (*SUMMARY_SETS, ACCURACY_SET)
    chosen = [row for row in rows if row["set"] in sets and row["solver"].partition(":")[0] in SUMMARY_SOLVERS]
    found = grouped(chosen, "solver")
    return dict(sorted(found.items(), key=lambda x: (x[0] != ANY, -x[1][0]["success"]["rate"])))


def page(overview: str) -> str:
    """The results page as Markdown, with an overview of real matches."""
    results = {name: load_results(HERE / f"{name}.json") for name in RESULTS}
    complexity, runs = load("complexity"), {name: [*read_csv(HERE / f"{name}.csv", ()).values()] for name in SUMMARIES}
    benchmark, cameras = (load(name, REPOSITORY / "benchmarks") for name in ("solvers", "cameras"))
    rigs = grouped(cameras["rigs"], "solver")
    timed = grouped((row for row in benchmark["rows"] if row["set"] in TIMED_SETS), "solver")
    at_nine = complexity["n"].index(9)
    any_network: Any = PnPNet.from_pretrained(ANY).init
    files = {name: rates.Rates(entry) for name, entry in results.items()}
    return harness.render(
        "README.md.jinja",
        **{"ours": OURS, "paper": PAPER, "any": ANY, "results": results, "overview": overview, "rates": files},
        shipped_views=PnPNet.from_pretrained(OURS).views,
        made=results["paper"]["environment"],
        operations={name: counts[at_nine] for name, counts in complexity["counts"].items()},
        **{"summary_sets": SUMMARY_SETS, "accuracy_set": ACCURACY_SET, "benchmark": benchmark, "rigs": rigs},
        summary=summary(benchmark["rows"]),
        unknown_focal=grouped(cameras["real"], "solver"),
        rig_batch=cameras["settings"]["count"],
        times={x.partition(":")[0]: [f"{row['median_us']:.0f}" for row in own] for x, own in timed.items()},
        rig_ratios=[other["us"] / own["us"] for own, other in zip(rigs[ANY], rigs["PoseLib"], strict=True)],
        beside_robust=rates.compare_all((files["set"], files["set_real"]), ANY, ROBUST),
        beside_peers=rates.compare_all((files["set"], files["set_real"]), ANY, PEERS),
        ours_beside_peers=rates.compare_all((files["paper"], files["gaussian_pose"], files["real"]), OURS, PEERS),
        believed={name: x["kinds"] for name, x in load("probability").items() if "kinds" in x},
        **{"honest": load("honesty"), "judged": load("judge")["sets"]},
        rate=lambda x: str(SuccessRate(**x)),
        **{"percent": rates.percent, "compared": rates.compared, "kernel": rates.KERNEL, "chi_square": CHI_SQUARE_95},
        distribution_table=format_table(results["distribution"]),
        **{"ablation": rates.ablation(runs["ablation"]), "sweep": rates.sweep(runs["sweep"])},
        sizes={row["run"]: row for row in runs["capacity"]},
        size_sets=rates.validation_sets(runs["capacity"]),
        shipped_size="set-{width}x{layers}x{hidden}".format(**any_network.config),
        weights=shipped_weights(),
        **{"claim": rates.claim, "shown": rates.shown},
    )


def with_block(text: str, block: str) -> str:
    """The text with another block between the lines ``BEGIN`` and ``END``; ``ValueError`` without one of each line."""
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise ValueError(f"A page with an overview needs one line '{BEGIN}' and one line '{END}' below it.")
    return f"{text.partition(BEGIN)[0]}{BEGIN}\n{block}\n{END}{text.partition(END)[2]}"


def load(name: str, folder: Path = HERE) -> Any:
    """The content of a JSON file."""
    return json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))


def pages() -> dict[Path, str]:
    """The pages and the texts that their files hold."""
    matches = load(UNSEEN), load(SEEN)
    facts = overview(*matches)
    found = {HERE / "README.md": page(harness.render("overview.md.jinja", link="real_matches.md", **facts))}
    found[HERE / "real_matches.md"] = harness.render(
        "real_matches.md.jinja", **page_facts(*matches, load("real_matches_cost"), load("keypoints"))
    )
    for path in OVERVIEW_PAGES:
        link = Path(os.path.relpath(HERE / "real_matches.md", path.parent)).as_posix()
        block = harness.render("overview.md.jinja", link=link, **facts)
        found[path] = with_block(path.read_text(encoding="utf-8"), block)
    return found


def render() -> None:
    """Write the pages, their pictures, and the overviews."""
    drawn = ("paper", "gaussian_pose", "real", "mismatches", "crowd", "against_n", "against_m")
    paper_figures([*(load_results(HERE / f"{name}.json") for name in drawn), load("complexity")], HERE)
    for name in shipped_weights():
        plot_training(HERE / f"training-{name}.png", WEIGHTS_FOLDER / name / "history.csv")
    plot_sweep(HERE / "sweep_against_n.png", HERE / "sweep.csv", against="model.n")
    plot_sweep(HERE / "sweep_against_m.png", HERE / "sweep.csv", against="model.m")
    plot_reliability(HERE / "reliability.png", load("honesty")["reliability"])
    costs = load("real_matches_cost")
    titles = {solver: title(solver).replace("`", "") for solver in costs["settings"]["solvers"]}
    plot_real_matches(HERE / "real_matches.png", at_size(load(UNSEEN)), costs, titles)
    plot_problem(HERE / "problem.png")
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
