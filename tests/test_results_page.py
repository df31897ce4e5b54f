"""The results page follows from its files, and its verdicts from intervals."""

import json

import pytest

pytest.importorskip("pandas")
pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

import matches
import render
from rates import Rates, compare_all, compared

from kornia_pnpnet.core.environment import BEHAVIOUR


def row(rate, *, half=1.0, **columns):
    bounds = {"rate": rate, "low": rate - half, "high": rate + half}
    shares = {f"{data}/{key}": f"{value / 100:.4f}" for data in ("none", "uniform") for key, value in bounds.items()}
    return {"update": "4000", "us_per_problem": "12.3", **columns, **shares}


def test_the_pages_are_rendered_from_their_files():
    for path, text in render.pages().items():
        assert text == path.read_text(encoding="utf-8")


def test_no_results_file_is_older_than_one_change_of_behaviour():
    folders = render.HERE, render.REPOSITORY / "benchmarks", render.REPOSITORY / "docs" / "examples"
    found = {path.name: json.loads(path.read_bytes()) for folder in folders for path in folder.glob("*.json")}
    made = {name: (x if "environment" in x else x["throughput"])["environment"] for name, x in found.items()}
    assert {"solvers.json", "paper.json", "gpu.json"} <= made.keys()
    for name in ("keypoint_pipeline", "keypoint_covariances"):
        made.pop(f"{name}.json")  # ways to train one network, compared within one run
    # Two files are of earlier changes: no GPU was at hand after change 1, and no idle hour after change 3.
    late = {"gpu.json": 4, "startup.json": 2}
    assert [name for name, x in made.items() if BEHAVIOUR - x.get("behaviour", 0) > late.get(name, 1)] == []


def test_kinds_of_matches_are_summed_by_the_number_of_problems():
    solvers = {
        "pnpnet-set": (90, 80, 2.0),
        "poselib:threshold=6": (70, 70, 4.0),
        "poselib:threshold=6+ratio": (65, 71, 4.0),
    }
    rows = [
        {"solver": name, "kind": kind, "group": group, "batch": size, "count": count, "success": rate / 100}
        | {"ms_per_problem": ms * count}
        for name, (*rates, ms) in solvers.items()
        for kind, count, rate in zip(("few", "many"), (100, 300), rates, strict=True)
        for group, size in (("all", 1), ("all", 500), ("0–30 %", 500))
    ]
    file = matches.at_size({"rows": rows})
    assert {(row["batch"], row["group"]) for row in file["rows"]} == {(500, "all"), (500, "0–30 %")}
    found = matches.totals(file)
    ours = found["pnpnet-set"]
    assert [ours[kind].success.rate for kind in ("few", "many", "all")] == [0.9, 0.8, 0.825]
    assert (ours["few"].ms, ours["all"].ms, ours["all"].success.total) == (200.0, 500.0, 400)
    assert matches.best_peer(found) == "poselib:threshold=6"
    assert matches.points_ahead(found) == pytest.approx(12.5)


def test_a_solver_is_ahead_or_behind_only_when_intervals_are_apart():
    def entry(data, solver, rate):
        success = {"rate": rate, "low": rate - 0.01, "high": rate + 0.01}
        return {"data": data, "solver": solver, "success": success, "us_per_problem": 1.0}

    shares = {"won": (0.9, 0.8), "lost": (0.7, 0.8), "even": (0.8, 0.81)}
    rows = [entry(data, name, rate) for data, pair in shares.items() for name, rate in zip("ab", pair, strict=True)]
    rates = Rates({"rows": rows, "data": list(shares), "solvers": ["a", "b"]})
    standing = compare_all([rates], "a", ["b"])
    assert [list(sets) for sets in standing.values()] == [["won"], ["even"], ["lost"]]
    assert standing["behind"] == {"lost": ("b", pytest.approx(10.0))}
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
