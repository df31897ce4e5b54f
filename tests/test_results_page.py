"""The results page follows from its files, and its verdicts from intervals."""

import json

import pytest

pytest.importorskip("pandas")
pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

import matches
import render
from rates import compared

from kornia_pnpnet.core.environment import BEHAVIOUR


def row(rate, *, half=1.0, **columns):
    bounds = {"rate": rate, "low": rate - half, "high": rate + half}
    shares = {f"{data}/{key}": f"{value / 100:.4f}" for data in ("none", "uniform") for key, value in bounds.items()}
    return {"update": "4000", "us_per_problem": "12.3", **columns, **shares}


def test_the_pages_are_rendered_from_their_files():
    for path, text in render.pages().items():
        assert text == path.read_text(encoding="utf-8")


def test_no_results_file_is_older_than_one_change_of_behaviour():
    folders = render.HERE, render.REPOSITORY / "benchmarks"
    found = {path.name: json.loads(path.read_bytes()) for folder in folders for path in folder.glob("*.json")}
    made = {name: (x if "environment" in x else x["throughput"])["environment"] for name, x in found.items()}
    assert {"solvers.json", "paper.json", "gpu.json"} <= made.keys()
    assert [name for name, x in made.items() if BEHAVIOUR - x.get("behaviour", 0) > 1] == []


def test_a_block_stands_between_its_lines():
    text = f"before\n{render.BEGIN}\nold\n{render.END}\nafter\n"
    replaced = render.with_block(text, "new")
    assert replaced == render.with_block(replaced, "new") == text.replace("old", "new")
    with pytest.raises(ValueError, match="overview:begin"):
        render.with_block("before", "new")


def matches_file(solvers, counts=(100, 300)):
    """A file of real matches: success in per cent and milliseconds of each solver, for two kinds of matches."""
    rows = [
        {"solver": name, "kind": kind, "group": "all", "count": count, "success": rate / 100, "ms_per_problem": ms}
        for name, (*rates, ms) in solvers.items()
        for kind, count, rate in zip(("few", "many"), counts, rates, strict=True)
    ]
    return {"rows": rows, "settings": {"solvers": list(solvers)}}


def test_measurements_are_pooled_by_the_number_of_problems_and_by_what_the_solver_did():
    peer = "poselib:threshold=6"
    first = {"pnpnet-set:effort=adaptive": (90, 80, 2.0), "pnpnet-set": (80, 60, 1.0), peer: (70, 70, 4.0)}
    second = {"pnpnet-set": (70, 60, 4.0), "pnpnet-set:effort=fixed": (60, 40, 1.0), peer: (70, 70, 8.0)}
    second["pycolmap:threshold=8"] = (50, 50, 1.0)  # which the first file lacks
    pooled = matches.pool([matches_file(first), matches_file(second, (300, 100))])
    adaptive, fixed, other = pooled.values()  # in the order of the first file
    assert [adaptive[kind].success.rate for kind in ("few", "many", "all")] == [0.75, 0.75, 0.75]
    assert [fixed[kind].success.rate for kind in ("few", "many")] == [0.65, 0.55]
    assert (adaptive["all"].ms, fixed["few"].ms, other["all"].ms) == (3.0, 1.0, 6.0)
    assert adaptive["all"].success.total == 800
    assert matches.points_ahead(pooled) == pytest.approx(0.05)


def test_a_solver_is_ahead_or_behind_only_when_intervals_are_apart():
    def entry(data, solver, rate):
        success = {"rate": rate, "low": rate - 0.01, "high": rate + 0.01}
        return {"data": data, "solver": solver, "success": success, "us_per_problem": 1.0}

    shares = {"won": (0.9, 0.8), "lost": (0.7, 0.8), "even": (0.8, 0.81)}
    rows = [entry(data, name, rate) for data, pair in shares.items() for name, rate in zip("ab", pair, strict=True)]
    rates = render.Rates({"rows": rows, "data": list(shares), "solvers": ["a", "b"]})
    standing = render.compare_all([rates], "a", ["b"])
    assert (standing.ahead, standing.overlapping) == (["won"], ["even"])
    assert standing.behind == {"lost": ("b", pytest.approx(10.0))}
    assert rates.best("lost", ["a", "b"]) == "b"


def test_runs_are_apart_only_when_all_their_intervals_are():
    for rates, others, difference, verdict in (
        ([75.0], [70.0], "+5.0", "above"),
        ([65.0], [70.0], "-5.0", "below"),
        ([71.5], [70.0], "+1.5", "overlap"),
        ([75.0], [70.0, 74.0], "+3.0", "overlap"),  # one seed of the others comes near
        ([75.0, 71.0], [70.0], "+3.0", "overlap"),
    ):
        found = compared([row(rate) for rate in rates], [row(rate) for rate in others], "none")
        assert found.startswith(difference)
        assert verdict in found
