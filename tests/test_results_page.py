"""The results page follows from its files, and its verdicts from intervals."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import pytest

pytest.importorskip("seaborn")

REPO = Path(__file__).resolve().parents[1]
FOLDER = REPO / "docs" / "results"


@pytest.fixture(scope="module")
def render():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FOLDER)
        yield importlib.import_module("render")


def row(rate, *, half=1.0, **columns):
    bounds = {"rate": rate, "low": rate - half, "high": rate + half}
    shares = {f"{data}/{key}": f"{value / 100:.4f}" for data in ("none", "uniform") for key, value in bounds.items()}
    return {"update": "4000", "us_per_problem": "12.3", **columns, **shares}


def test_the_page_is_rendered_from_its_files(render):
    results = {name: render.load_results(FOLDER / f"{name}.json") for name in render.RESULTS}
    files = [json.loads((FOLDER / f"{name}.json").read_text()) for name in ("complexity", "honesty")]
    runs = {name: render.read_summary(FOLDER / f"{name}.csv") for name in render.SUMMARIES}
    assert render.page(results, *files, runs) == (FOLDER / "README.md").read_text(encoding="utf-8")


def test_the_overview_has_the_numbers_of_its_file_between_the_lines_of_the_readme(render):
    results = json.loads((REPO / "benchmarks" / "solvers.json").read_text())
    rows, table = render.overview(results)
    assert [row.ours for row in rows].count(True) == 1
    assert [row.us_per_problem for row in rows] == sorted(row.us_per_problem for row in rows)
    for entry in rows:
        numbers = [f"{100 * rate.rate:.1f} %" for rate in (entry.without_outliers, entry.with_outliers)]
        (line,) = (line for line in table.splitlines() if entry.name in line)
        assert all(number in line for number in (*numbers, f"{entry.us_per_problem:.0f}"))
    text = f"before\n{render.BEGIN}\nold\n{render.END}\nafter\n"
    replaced = render.with_block(text, table)
    assert replaced == render.with_block(replaced, table) == text.replace("old", table)
    with pytest.raises(ValueError, match="overview:begin"):
        render.with_block("before", table)


def test_runs_are_apart_only_when_all_their_intervals_are(render):
    for rates, others, difference, verdict in (
        ([75.0], [70.0], "+5.0", "above"),
        ([65.0], [70.0], "-5.0", "below"),
        ([71.5], [70.0], "+1.5", "overlap"),
        ([75.0], [70.0, 74.0], "+3.0", "overlap"),  # one seed of the others comes near
        ([75.0, 71.0], [70.0], "+3.0", "overlap"),
    ):
        found = render.compared([row(rate) for rate in rates], [row(rate) for rate in others], "none")
        assert found.startswith(difference)
        assert verdict in found


def test_ablations_stand_beside_the_recipe(render):
    seeds = [row(rate, experiment="recipe", seed=f"{seed}") for seed, rate in enumerate((80.0, 81.5))]
    kernels = [row(rate, experiment="kernels", **{render.KERNEL: k}) for k, rate in (("huber", 70), ("cauchy", 81))]
    facts = render.ablation([*kernels, *seeds, row(90.0, experiment="shared", seed="", **{render.KERNEL: ""})])
    assert (facts["seeds"], facts["spread"]) == (2, pytest.approx(1.5))
    assert "| `recipe seed=1` | 81.5 [80.5, 82.5] | 81.5 [80.5, 82.5] |" in facts["table"]
    by_name = {finding["experiment"]: finding["found"] for finding in facts["findings"]}
    assert by_name["kernels"]["huber"].startswith("none -10.8 points (below)")
    assert by_name["kernels"]["cauchy"].startswith("none +0.2 points (intervals overlap)")
    assert by_name["shared"][""].startswith("none +9.2 points (above)")
