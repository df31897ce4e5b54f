"""The figures of the paper's protocol show the results files, and can be read."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("seaborn")

from kornia_pnpnet.evaluation import figures
from kornia_pnpnet.metrics import success_rate


def results_of(rows):
    """A results file from (source, outliers, n, solver, solved of 100) and optionally m and the mismatch share."""
    file = {"solvers": {}, "data": {}, "rows": []}
    for source, outliers, n, solver, solved, *more in rows:
        m, share = (*more, *(None, 0.5)[len(more) :])
        data = f"{source} {outliers} {n} {share}"
        description = {"source": source, "outliers": outliers, "mismatch_share": share}
        file["data"][data] = {"description": description, "n": n, "unit": ""}
        file["data"][data] |= {"max_rotation_deg": 1.0, "max_translation": 0.2}
        file["solvers"][solver] = {"class": "PnPNet", "config": {"init": None, "refine": m and {"m": m}}}
        success = success_rate(torch.arange(100) < solved)._asdict()
        file["rows"].append({"data": data, "solver": solver, "success": success, "us_per_problem": 5.0 + (m or 0)})
    return file


def points(axes):
    """Places and values in a panel, by solver."""
    return {
        bars.get_label(): np.array(bars.lines[0].get_data(), dtype=float).T.round(6).tolist()
        for bars in axes.containers
    }


def percents(axes):
    return {name: [round(x) for x, _ in dots] for name, dots in points(axes).items()}


def test_dots_stand_in_their_rows_at_their_rates(tmp_path, drawn):
    solved = {"none": {"pnpnet-n9": 84, "reppnp": 56, "known-inliers": 85}, "uniform": {"pnpnet-n9": 100, "epnp": 0}}
    rows = [("paper", k, 9, name, count) for k in solved for name, count in solved[k].items()]
    rows.append(("paper", "none", 9, "reppnp:m=2", 1, 2))  # a point of a curve against m
    assert figures.plot_synthetic(tmp_path / "a.png", [results_of(rows)]) == tmp_path / "a.png"
    panels = drawn["a.png"].axes
    names = [label.get_text() for label in panels[0].get_yticklabels()]
    assert names == ["pnpnet-n9", "epnp", "reppnp", "known-inliers"]
    for axes, rates in zip(panels, solved.values(), strict=True):
        assert {names[int(row)]: x for [(x, row)] in points(axes).values()} == rates
        low, high = axes.containers[0].lines[2][0].get_segments()[0][:, 0]
        rate = success_rate(torch.arange(100) < rates["pnpnet-n9"])
        assert [low, high] == pytest.approx([100 * rate.low, 100 * rate.high])


def test_scenes_are_pooled_over_all_their_problems(tmp_path, drawn):
    rows = [("a", "none", 9, "epnp", 30), ("b", "none", 9, "epnp", 10), ("a", "none", 9, "mine", 1)]
    rows += [("a", 2, 9, "epnp", 5), ("a", 3, 9, "epnp", 7)]
    figures.plot_scenes(tmp_path / "a.png", [results_of(rows)])
    pooled, first, _, spoilt = drawn["a.png"].axes
    assert percents(pooled) == {"epnp": [20]}  # the other solver solved one scene only
    assert percents(first) == {"epnp": [30], "mine": [1]}
    assert percents(spoilt) == {"epnp": [5]}


def test_mismatches_against_their_number(tmp_path, drawn):
    mixed = [("a", k or "none", 9, "epnp", 50 - k) for k in range(3)]
    alone = [(scene, k or "none", 9, "epnp", 80 - k, None, 1.0) for k in range(3) for scene in ("a", "b")]
    alone += [("c", 2, 9, "epnp", 100, None, 1.0), ("a", 2, 20, "epnp", 50, None, 1.0), ("a", 1, 9, "p", 1, None, 1.0)]
    for results in ([mixed, alone], [alone, mixed]):
        figures.plot_mismatches(tmp_path / "a.png", [results_of(rows) for rows in results])
        (axes,) = drawn["a.png"].axes
        assert points(axes).keys() == {"epnp"}
        assert points(axes)["epnp"][1:] == [[1, 79], [2, 78]]
    figures.plot_mismatches(tmp_path / "b.png", [results_of(mixed)])  # without sets of mismatches only


def test_solvers_for_one_n_each_share_a_curve(tmp_path, drawn):
    rows = [("paper", "none", n, f"pnpnet-n{n}", n) for n in (6, 9, 20)]
    rows += [("paper", outliers, n, "epnp", 2 * n) for outliers in ("none", "uniform") for n in (6, 9, 20)]
    rows += [("paper", "uniform", 9, "pnpnet-n9", 7), ("paper", 3, 9, "epnp", 1)]
    figures.plot_against_n(tmp_path / "a.png", [results_of(rows)])
    none, uniform = (points(axes) for axes in drawn["a.png"].axes)
    assert none["pnpnet-n*"] == [[n, n] for n in (6, 9, 20)]
    assert none["epnp"] == uniform["epnp"] == [[n, 2 * n] for n in (6, 9, 20)]
    assert uniform["pnpnet-n*"] == [[9, 7]]


def test_m_is_read_from_the_configuration(tmp_path, drawn):
    names = (("epnp-lm:m=3,x=1", 3), ("epnp-lm:x=1", 9), ("epnp-lm:x=1,m=1", 1), ("identity-lm", 8))
    rows = [("paper", k, 9, name, 10 * m, m) for k in ("none", "uniform") for name, m in names]
    figures.plot_against_m(tmp_path / "a.png", [results_of([*rows, ("paper", 3, 9, "epnp-lm", 1, 9)])])
    *panels, time = drawn["a.png"].axes
    for axes in panels:
        assert points(axes) == {"epnp-lm:x=1": [[m, 10 * m] for m in (1, 3, 9)]}
    assert points(time) == {"epnp-lm:x=1": [[1, 6], [3, 8], [9, 14]]}


COUNTS = {"n": [6, 9, 50], "counts": {"epnp": [10, 20, None], "p3p-ransac": [1, 2, 3]}, "ransac": ["p3p-ransac"]}


def test_operations_with_and_without_ransac(tmp_path, drawn):
    figures.plot_operations(tmp_path / "a.png", COUNTS)
    first, second = (points(axes) for axes in drawn["a.png"].axes)
    np.testing.assert_equal(first, {"epnp": [[6, 10], [9, 20], [50, np.nan]]})
    assert second == {"p3p-ransac": [[6, 1], [9, 2], [50, 3]]}
    for bad in ({}, {"epnp": [1]}):
        with pytest.raises(ValueError, match=r"operation counts|length"):
            figures.plot_operations(tmp_path / "a.png", {**COUNTS, "counts": bad})


def test_figures_without_data_are_left_out(tmp_path, drawn):
    def names(*results):
        return [path.name.partition("_")[0] for path in figures.paper_figures(results, tmp_path)]

    one, counts = results_of([("paper", "none", 9, "epnp", 5)]), {**COUNTS, "kind": "complexity"}
    assert names(one) == ["figure2"]
    assert names(counts) == ["figure1"]
    assert names(results_of([("gaussian_pose", "uniform", 20, "epnp", 5)])) == ["figure3"]
    assert names(results_of([("a", 2, 9, "epnp", 5)])) == ["figure4"]
    assert names(one, results_of([("paper", "none", 6, "epnp", 5)])) == ["figure2", "success"]
    unnamed = results_of([("paper", None, 9, "epnp", 5)])
    for nothing in ([], [results_of([])], [unnamed], [counts] * 2):
        with pytest.raises(ValueError, match=r"results|counts"):
            figures.paper_figures(nothing, tmp_path)


def test_more_problems_count_then_the_last_file(tmp_path, drawn):
    one, more, last = (results_of([("paper", "none", 9, "epnp", solved)]) for solved in (90, 50, 25))
    more["rows"][0]["success"]["total"] = last["rows"][0]["success"]["total"] = 200
    for files, rate in (((one, more), 50), ((more, one), 50), ((more, last), 25)):
        figures.plot_synthetic(tmp_path / "a.png", files)
        assert percents(drawn["a.png"].axes[0]) == {"epnp": [rate]}


def test_texts_stay_on_the_page_and_odd_names_are_written(tmp_path, drawn):
    names = ("pnpnet-n9", r"$\frac{a$", "_hidden", "x" * 60, "with space", "ünïcode", "a:b=$1,m2=3", "known-inliers")
    rows = [("paper", k, n, name, 50) for k in ("none", "uniform", 3) for n in (6, 9) for name in names]
    scenes = (r"$\frac{$", "a/b", "_")
    rows += [(scene, k or "none", 9, name, 50) for scene in scenes for k in range(4) for name in names]
    rows += [("paper", "none", 9, f"epnp-lm:m={m}", 50, m) for m in range(1, 9)]
    counts = {"n": [6, 9], "counts": {name: [1, 2] for name in names}, "ransac": [], "kind": "complexity"}
    figures.paper_figures([results_of(rows), counts], tmp_path)
    assert len(drawn) == 6
    for name, figure in drawn.items():
        box = figure.get_tightbbox()
        assert (box.min >= 0).all()
        assert (box.max <= figure.get_size_inches()).all()
        texts = [*(text for legend in figure.legends for text in legend.get_texts()), *figure.axes[0].get_yticklabels()]
        assert "against_m" in name or {r"$\frac{a$", "_hidden"} <= {text.get_text() for text in texts}
