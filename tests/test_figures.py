"""Pictures show the data of their arguments, and leave matplotlib's global state alone."""

from __future__ import annotations

import importlib
import itertools
import sys

import numpy as np
import pytest
import torch

pytest.importorskip("seaborn")

import matplotlib as mpl
import pandas as pd
from matplotlib import pyplot

from kornia_pnpnet.evaluation import figures


def fake_results(sets=2):
    """A results file, as far as a picture reads it."""
    generator, names, rows = np.random.default_rng(0), ("pnpnet-n9", "mine", "epnp"), []
    for data, (index, solver) in itertools.product((f"set {i}" for i in range(sets)), enumerate(names)):
        rate, errors = 0.9 - 0.2 * index, np.exp(generator.normal(index, 1.0, 50)).tolist()
        per_problem = {"rotation_error_deg": errors, "translation_error": errors, "ok": [1] * 50}
        success = {"rate": rate, "low": rate - 0.05, "high": rate + 0.05, "total": 50}
        rows.append({"data": data, "solver": solver, "success": success, "per_problem": per_problem})
    entry = {"max_rotation_deg": 1.0, "max_translation": 0.2, "unit": "m"}
    return {"solvers": dict.fromkeys(names), "data": {f"set {i}": entry for i in range(sets)}, "rows": rows}


@pytest.mark.parametrize("plot", [figures.plot_success, figures.plot_errors])
def test_a_file_is_written_and_global_state_stays(tmp_path, plot):
    before, results = dict(mpl.rcParams), fake_results()
    path = plot(tmp_path / "new" / "a.png", results)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert results == fake_results()
    assert dict(mpl.rcParams) == before
    assert not pyplot.get_fignums()
    with pytest.raises(ValueError, match="no rows"):
        plot(tmp_path / "b.png", {**results, "rows": []})


def test_every_set_has_a_panel_with_a_dot_for_each_of_its_solvers(tmp_path, drawn):
    results = fake_results(sets=5)
    del results["rows"][-1]
    figures.plot_success(tmp_path / "a.png", results)
    assert len(drawn["a.png"].axes) == 5
    for axes, name in zip(drawn["a.png"].axes, results["data"], strict=True):
        dots = {dot.get_label(): dot.lines[0].get_xdata()[0] for dot in axes.containers}
        rows = [row for row in results["rows"] if row["data"] == name]
        assert dots == pytest.approx({row["solver"]: 100 * row["success"]["rate"] for row in rows})


def test_error_curves_are_the_shares_of_the_errors(tmp_path, drawn):
    results = fake_results(sets=1)
    results["rows"][0]["per_problem"]["rotation_error_deg"] = [0.0] * 50
    figures.plot_errors(tmp_path / "a.png", results)
    (curve,) = (line for line in drawn["a.png"].axes[0].lines if line.get_label() == "mine")
    errors = np.array(results["rows"][1]["per_problem"]["rotation_error_deg"])
    at, share = (np.asarray(values, dtype=float) for values in curve.get_data())
    for limit in (0.5, 1.0, 5.0):
        assert share[at <= limit].max(initial=0.0) == pytest.approx(100 * (errors <= limit).mean())


def test_pose_picture_marks_rejected_pairs_and_takes_points_behind_the_camera(tmp_path, drawn):
    generator = np.random.default_rng(1)
    img = torch.from_numpy(generator.uniform((0, 0), (640, 480), (9, 2)))
    projected, rejected = img + 1.0, torch.arange(9) == 2
    projected[4], projected[5], img[6] = torch.nan, 1e12, torch.nan
    for size in (None, (640, 480)):
        figures.plot_pose(tmp_path / "a.png", img, projected, rejected, size, title="$\\frac{")
        (axes,) = drawn["a.png"].axes
        assert [len(line.get_xdata()) for line in axes.lines] == [7, 1, 7]  # kept, rejected, projected
        assert abs(np.diff(axes.get_xlim())[0]) < 1000
    for bad in ((img[:3], projected, rejected), (img * torch.nan, projected, rejected)):
        with pytest.raises(ValueError, match=r"plot_pose needs|no pixel"):
            figures.plot_pose(tmp_path / "c.png", *bad)


def test_reliability_picture_leaves_empty_ranges_out(tmp_path, drawn):
    curve = {"number": [3.0, 0.0, 5.0], "predicted": [0.1, 0.5, 0.9], "observed": [0.2, 1.0, 0.7]}
    figures.plot_reliability(tmp_path / "a.png", {f"curve {i}": curve for i in range(11)})
    chance, share = drawn["a.png"].axes
    assert np.array(chance.lines[-1].get_data()).tolist() == [[0.1, 0.9], [0.2, 0.7]]
    assert share.lines[-1].get_ydata().tolist() == pytest.approx([37.5, 62.5])
    for bad in ({}, {"a": {**curve, "number": [0.0] * 3}}, {"a": {**curve, "observed": [0.5]}}):
        with pytest.raises(ValueError, match="curve"):
            figures.plot_reliability(tmp_path / "b.png", bad)


def test_training_picture_reads_the_history(tmp_path, drawn):
    header = "update,total,init_rotation,init_translation,refined_rotation,refined_translation"
    rows = [f"{i},{2 / i},{1 / i},{9 / i},nan,{4 / i},{'' if i % 2 else 0.1 * i}" for i in range(1, 9)]
    history = tmp_path / "a.csv"
    history.write_text("\n".join([f"{header},val/none/success", *rows]) + "\n")
    figures.plot_training(tmp_path / "a.png", history)
    loss, success, *_ = drawn["a.png"].axes
    assert loss.lines[0].get_ydata() == pytest.approx([2 / i for i in range(1, 9)])
    assert pytest.approx(np.array([[i, 10 * i] for i in (2, 4, 6, 8)])) == np.array(success.lines[0].get_data()).T
    for text, message in (("", "no rows"), (header, "no rows"), ("update\n1", "'total'")):
        history.write_text(text)
        with pytest.raises(ValueError, match=message):
            figures.plot_training(tmp_path / "a.png", history)


@pytest.fixture
def runs():
    """A summary of a sweep; the rate identifies the run."""
    columns = ["data.outliers.max_ratio", "model.n", "model.m"]
    runs = pd.DataFrame(itertools.product((0.33, 0), (9, 6), (10, 2)), columns=columns)
    rate = runs["model.n"] / 100 + runs["model.m"] / 1000 + runs["data.outliers.max_ratio"]
    runs["us_per_problem"] = runs["model.n"] * runs["model.m"] + 10 * runs["data.outliers.max_ratio"]
    return runs.assign(**{"uniform/rate": rate, "uniform/low": rate - 0.01, "uniform/high": rate + 0.01})


@pytest.mark.parametrize(("against", "places", "panels"), [("m", [2, 10], [6, 9]), ("n", [6, 9], [2, 10])])
def test_sweep_picture_shows_success_and_time(tmp_path, drawn, runs, against, places, panels):
    runs.to_csv(tmp_path / "a.csv", index=False)
    figures.plot_sweep(tmp_path / "a.png", tmp_path / "a.csv", against=against)
    rates, times = drawn["a.png"].axes[:2], drawn["a.png"].axes[2:]
    for axes, below, value in zip(rates, times, panels, strict=True):
        pairs = [(place, value) if against == "n" else (value, place) for place in places]
        for bars, share in zip(axes.containers, (0, 33), strict=True):
            x, y = bars.lines[0].get_data()
            assert list(x) == places
            assert list(y) == pytest.approx([n + m / 10 + share for n, m in pairs])
        (time,) = below.containers
        assert list(time.lines[0].get_ydata()) == pytest.approx([n * m for n, m in pairs])  # the least over the mixes


def test_an_unfinished_sweep_is_drawn_and_a_contradictory_one_is_not(tmp_path, drawn, runs):
    path, contradictory = tmp_path / "a.csv", runs.assign(**{"model.m": 2})
    runs[:5].to_csv(path, index=False)
    figures.plot_sweep(tmp_path / "a.png", path, against="n")
    for wrong, message in ((contradictory, "several runs"), (runs.drop(columns="us_per_problem"), "us_per_problem")):
        wrong.to_csv(path, index=False)
        with pytest.raises(ValueError, match=message):
            figures.plot_sweep(tmp_path / "a.png", path, against="n")


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "seaborn", None)
    monkeypatch.delitem(sys.modules, "kornia_pnpnet.evaluation.figures")
    with pytest.raises(ImportError, match=r"kornia_pnpnet\[eval\]"):
        importlib.import_module("kornia_pnpnet.evaluation.figures")
