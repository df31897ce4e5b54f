"""The figures of the paper's protocol show the results files, and can be read."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("matplotlib")

from matplotlib.colors import same_color
from matplotlib.figure import Figure
from matplotlib.text import Text

from kornia_pnpnet.evaluation.figures import (
    paper_figures,
    plot_against_m,
    plot_against_n,
    plot_mismatches,
    plot_operations,
    plot_scenes,
    plot_synthetic,
)
from kornia_pnpnet.evaluation.figures.style import SMALL, shortened, solver_styles, wrapped
from kornia_pnpnet.metrics import success_rate

SOLVERS = (
    *("pnpnet-n9", "net-n9", "epnp", "epnp-lm", "reppnp", "reppnp-lm", "ransac-epnp-lm", "p3p-ransac", "identity-lm"),
    *("opencv-sqpnp", "opencv-ransac:threshold=12", "opencv-usac", "poselib", "pycolmap", "known-inliers"),
    *("known-inliers-and-noise", "outputs/2026-11-21/12-00-00/weights", "mine"),
)
SCENES = ("fountain-P11", "Herz-Jesus-P25", "a_scene_with_a_long_name")


def results_of(rows, solvers=None):
    """A results file from (source, outliers, n, solver, solved, total) and optionally m, time and mismatch share."""
    file = {"solvers": {}, "data": {}, "rows": []}
    for source, outliers, n, solver, solved, total, *more in rows:
        m, time, share = (*more, *(None, 10.0, 0.5)[len(more) :])
        data = f"{source} {outliers} {n} {share}"
        description = {"source": source, "outliers": outliers, "mismatch_share": share}
        entry = {"description": description, "n": n, "max_rotation_deg": 1.0, "max_translation": 0.2, "unit": "m"}
        file["data"][data] = entry
        config = {"threshold": 5.0} if m is None else {"init": None, "refine": {"m": m}}
        file["solvers"][solver] = {"class": "PnPNet", "config": config}
        success = success_rate(torch.arange(total) < solved)._asdict()
        file["rows"].append({"data": data, "solver": solver, "success": success, "us_per_problem": time})
    return file


def all_results(solvers=SOLVERS):
    """Data for every figure, made up."""
    draw = np.random.default_rng(0).integers
    rows = [
        (source, outliers, 9, solver, draw(0, 201), 200)
        for source in ("paper", "gaussian_pose")
        for outliers in ("none", "uniform", 3)
        for solver in solvers
    ]
    rows += [(scene, k, 9, solver, draw(0, 101), 100) for scene in SCENES for k in range(6) for solver in solvers]
    rows += [("paper", "uniform", n, solver, draw(0, 101), 100) for n in (6, 30) for solver in solvers]
    rows += [("paper", "none", n, solvers[0], draw(0, 101), 100) for n in range(6, 31)]
    rows += [
        ("paper", "none", 9, f"{solver}:m={m}", draw(0, 101), 100, m, 5.0 + m)
        for solver in ("epnp-lm", "pnpnet-n9")
        for m in (0, 2, 10)
    ]
    counts = {solver: list(range(1000 * i + 1006, 1000 * i + 1051)) for i, solver in enumerate(solvers)}
    sampled = [solver for solver in solvers if "ransac" in solver]
    return [results_of(rows), {"kind": "complexity", "n": list(range(6, 51)), "counts": counts, "ransac": sampled}]


FIGURES = 7  # the five of the protocol, and success against n and m


@pytest.fixture
def drawn(monkeypatch):
    """Figures by file name, laid out as they would have been saved."""
    figures = {}

    def keep(self, path, **_):
        self.draw_without_rendering()
        figures[Path(path).name] = self

    monkeypatch.setattr(Figure, "savefig", keep)
    return figures


def points(axes):
    """What stands in a panel, by solver: places, values, lower and upper ends of the intervals."""
    found = {}
    for container in axes.containers:
        line, _, (bars,) = container.lines
        ends = np.stack(bars.get_segments())
        along = 0 if container.has_xerr else 1
        x, y = line.get_data()
        found[container.get_label()] = np.array([x, y, *ends[..., along].T], dtype=float)
    return found


def percent(solved, total):
    rate = success_rate(torch.arange(total) < solved)
    return [100 * rate.rate, 100 * rate.low, 100 * rate.high]


def row_names(axes):
    """Names of the rows of dots, by their height."""
    return {tick: label.get_text() for tick, label in zip(axes.get_yticks(), axes.get_yticklabels(), strict=True)}


def texts(figure):
    """The texts that are drawn, with their boxes in pixels. Axes have more: ticks beyond their limits."""
    seen = []
    draw = Text.draw

    def keep(self, renderer, *arguments, **options):
        draw(self, renderer, *arguments, **options)
        if self.get_visible() and self.get_text().strip():
            seen.append((self, Text.get_window_extent(self, renderer)))  # an annotation's own box has its arrow

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Text, "draw", keep)
        figure.draw_without_rendering()
    return seen


@pytest.mark.parametrize("source", ["paper", "gaussian_pose"])
def test_dots_stand_in_their_rows_at_their_rates(tmp_path, drawn, source):
    solved = {
        "none": {"reppnp": 56, "pnpnet-n9": 84, "known-inliers": 85},
        "uniform": {"reppnp": 0, "pnpnet-n9": 100, "known-inliers": 99},
    }
    rows = [(source, outliers, 9, name, count, 100) for outliers in solved for name, count in solved[outliers].items()]
    rows.append((source, "none", 9, "reppnp:m=2", 1, 100))  # a point of a curve against m
    assert plot_synthetic(tmp_path / "a.png", [results_of(rows)], source) == tmp_path / "a.png"
    panels = drawn["a.png"].axes
    names = row_names(panels[0])
    for axes, outliers in zip(panels, solved, strict=True):
        assert points(axes).keys() == solved[outliers].keys()
        for solver, (rate, row, low, high) in ((name, values[:, 0]) for name, values in points(axes).items()):
            assert names[row] == solver
            assert [rate, low, high] == pytest.approx(percent(solved[outliers][solver], 100))
            assert f"{rate:.1f}" in {text.get_text() for text in axes.texts if text.xy[1] == row}
            assert axes.get_xlim()[0] < rate < axes.get_xlim()[1]
        through = [line.get_xdata()[0] for line in axes.lines if list(line.get_ydata()) == [0, 1]]
        assert through == [solved[outliers]["known-inliers"]]  # a bound is a line across the panel


def test_a_row_for_each_solver_ours_first_and_bounds_last(tmp_path, drawn):
    plot_synthetic(
        tmp_path / "a.png", [results_of([("paper", "none", 9, name, 50, 100) for name in reversed(SOLVERS)])]
    )
    (axes,) = drawn["a.png"].axes
    names = [name for _, name in sorted(row_names(axes).items()) if name in map(shortened, SOLVERS)]
    assert sorted(names) == sorted(map(shortened, SOLVERS))
    assert names[:2] == ["pnpnet-n9", "net-n9"]
    assert names[-2:] == ["known-inliers", "known-inliers-and-noise"]


def test_scenes_are_pooled_over_all_their_problems(tmp_path, drawn):
    rows = [("a", "none", 9, "epnp", 30, 100), ("b", "none", 9, "epnp", 10, 200), ("a", "none", 9, "mine", 1, 100)]
    rows += [("a", 2, 9, "epnp", 5, 100), ("a", 3, 9, "epnp", 7, 100)]
    plot_scenes(tmp_path / "a.png", [results_of(rows)])
    pooled, first, _, spoilt = drawn["a.png"].axes
    assert points(pooled).keys() == {"epnp"}  # the other solver solved one scene only
    assert points(pooled)["epnp"][[0, 2, 3], 0] == pytest.approx(percent(40, 300))
    assert points(first).keys() == {"epnp", "mine"}
    assert points(spoilt)["epnp"][0, 0] == 5


def test_mismatches_against_their_number(tmp_path, drawn):
    solved = {"pnpnet-n9": [99, 90, 80, 60], "reppnp-lm": [95, 70, 40, 10]}
    rows = [
        (scene, k or "none", 9, solver, counts[k], 100)
        for solver, counts in solved.items()
        for k in range(4)
        for scene in ("a", "b")
    ]
    rows += [("c", 2, 9, "reppnp-lm", 100, 100), ("a", 2, 20, "reppnp-lm", 50, 100)]
    plot_mismatches(tmp_path / "a.png", [results_of(rows)])
    (axes,) = drawn["a.png"].axes
    assert points(axes).keys() == solved.keys()
    for solver, (x, *values) in points(axes).items():
        assert x.tolist() == [0, 1, 2, 3]
        np.testing.assert_allclose(np.array(values).T, [percent(2 * count, 200) for count in solved[solver]])


def test_mismatches_only_go_before_the_mix_and_never_into_it(tmp_path, drawn):
    mixed = [("a", k or "none", 9, "epnp", 50 - k, 100) for k in range(3)]
    alone = [("a", k or "none", 9, "epnp", 80 - k, 100, None, 10.0, 1.0) for k in range(3)]
    for results in itertools.permutations([results_of(mixed), results_of(alone)]):
        plot_mismatches(tmp_path / "a.png", results)
        plot_scenes(tmp_path / "b.png", results)
        assert points(drawn["a.png"].axes[0])["epnp"][1, 1:].tolist() == pytest.approx([79, 78])
        assert points(drawn["b.png"].axes[1])["epnp"][0, 0] == 48


def test_solvers_for_one_n_each_share_a_curve(tmp_path, drawn):
    rows = [("paper", "none", n, f"pnpnet-n{n}", n, 100) for n in (6, 9, 20)]
    rows += [("paper", outliers, n, "epnp", 2 * n, 100) for outliers in ("none", "uniform") for n in (6, 9, 20)]
    rows += [("paper", "uniform", 9, "pnpnet-n9", 7, 100), ("paper", 3, 9, "epnp", 1, 100)]
    plot_against_n(tmp_path / "a.png", [results_of(rows)])
    none, uniform = (points(axes) for axes in drawn["a.png"].axes)
    assert none.keys() == uniform.keys() == {"pnpnet-n*", "epnp"}
    np.testing.assert_allclose(none["pnpnet-n*"].T, [[n, *percent(n, 100)] for n in (6, 9, 20)])
    np.testing.assert_allclose(none["epnp"].T, [[n, *percent(2 * n, 100)] for n in (6, 9, 20)])
    np.testing.assert_allclose(uniform["pnpnet-n*"].T, [[9, *percent(7, 100)]])


def test_m_is_read_from_the_configuration(tmp_path, drawn):
    rows = [
        ("paper", outliers, 9, name, 10 * m + 1, 100, m, 5.0 + m)
        for outliers in ("none", "uniform")
        for name, m in (("epnp-lm:m=3", 3), ("epnp-lm", 9), ("epnp-lm:m=0", 0), ("identity-lm", 8))
    ]
    rows.append(("paper", 3, 9, "epnp-lm", 1, 100, 9))
    plot_against_m(tmp_path / "a.png", [results_of(rows)])
    *panels, time = drawn["a.png"].axes
    for axes in panels:
        assert points(axes).keys() == {"epnp-lm"}
        np.testing.assert_allclose(points(axes)["epnp-lm"].T, [[m, *percent(10 * m + 1, 100)] for m in (0, 3, 9)])
    assert np.array(time.lines[0].get_data()).tolist() == [[0, 3, 9], [5, 8, 14]]


def test_operations_with_and_without_ransac(tmp_path, drawn):
    counts = {"epnp": [10, 20, None], "p3p-ransac": [100, 200, 300], "net-n9": [5, 50, 500]}
    plot_operations(tmp_path / "a.png", {"n": [6, 9, 50], "counts": counts, "ransac": ["p3p-ransac"]})
    for axes, names in zip(drawn["a.png"].axes, ({"epnp", "net-n9"}, {"p3p-ransac"}), strict=True):
        assert {line.get_label() for line in axes.lines} == {text.get_text() for text in axes.texts} == names
        for line in axes.lines:
            assert list(line.get_xdata()) == [6, 9, 50]
            assert [None if np.isnan(value) else value for value in line.get_ydata()] == counts[line.get_label()]
    for bad in ({}, {"epnp": [1]}):
        with pytest.raises(ValueError, match="operation counts"):
            plot_operations(tmp_path / "a.png", {"n": [6, 9, 50], "counts": bad, "ransac": []})


def test_figures_without_data_are_left_out(tmp_path, drawn):
    def names(*results):
        return [path.name.partition("_")[0] for path in paper_figures(results, tmp_path)]

    one = results_of([("paper", "none", 9, "epnp", 5, 10)])
    assert names(one) == ["figure2"]
    assert names(all_results()[1]) == ["figure1"]
    assert names(results_of([("gaussian_pose", "uniform", 20, "epnp", 5, 10)])) == ["figure3"]
    assert names(results_of([("a", 2, 9, "epnp", 5, 10)])) == ["figure4"]
    assert names(one, results_of([("paper", "none", 6, "epnp", 5, 10)])) == ["figure2", "success"]
    unnamed = results_of([("paper", "none", 9, "epnp", 5, 10)])
    for entry in unnamed["data"].values():
        del entry["description"]["outliers"]
    for nothing in ([], [results_of([])], [unnamed], [all_results()[1]] * 2):
        with pytest.raises(ValueError, match=r"results|counts"):
            paper_figures(nothing, tmp_path)


def test_more_problems_count_then_the_last_file(tmp_path, drawn):
    def dot(*results):
        plot_synthetic(tmp_path / "a.png", results)
        return points(drawn["a.png"].axes[0])["epnp"][0, 0]

    few, more, last = (results_of([("paper", "none", 9, "epnp", *counts)]) for counts in ((9, 10), (10, 20), (5, 20)))
    assert dot(few, more) == dot(more, few) == 50
    assert dot(more, last) == 25


def test_all_figures_are_written_and_the_results_are_not_changed(tmp_path):
    results = all_results(SOLVERS[:3])
    made = paper_figures(results, tmp_path / "new")
    assert len(made) == FIGURES
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in made)
    assert results == all_results(SOLVERS[:3])


def test_a_solver_has_one_look_in_all_figures_and_another_one_than_others(tmp_path, drawn):
    paper_figures(all_results(), tmp_path)
    for name in ("pnpnet-n9", "reppnp-lm", "poselib", "mine"):
        looks = set()
        for axes in (axes for figure in drawn.values() for axes in figure.axes):
            dots = [container.lines[0] for container in axes.containers if container.get_label() == name]
            for line in dots + [line for line in axes.lines if line.get_label() == name]:
                looks.add((line.get_color(), line.get_marker(), same_color(line.get_markerfacecolor(), "white")))
        assert len(looks) == 1
    styles = solver_styles([*SOLVERS, "pnpnet-set", "opencv-epnp", "opencv-ransac-sqpnp", *(f"x{i}" for i in range(9))])
    without_colour = {(look.marker, look.filled, str(look.dash)) for look in styles.values()}
    assert len(without_colour) == len(styles)


def test_letters_are_large_enough_on_the_page_and_apart(tmp_path, drawn):
    paper_figures(all_results(), tmp_path)
    assert len(drawn) == FIGURES
    for name, figure in drawn.items():
        assert figure.get_figwidth() <= 7.2
        for text, box in texts(figure):
            assert text.get_fontsize() >= SMALL
            off = np.maximum(figure.bbox.min - box.min, box.max - figure.bbox.max).max()
            assert off <= 0, f"{name}: {text.get_text()!r} leaves the page by {off:.1f} pixels"
        for (one, a), (other, b) in itertools.combinations(texts(figure), 2):
            across, along = np.minimum(a.max, b.max) - np.maximum(a.min, b.min)
            # A box has room above and below its letters: a quarter of a line may be shared.
            overlap = across > 0 and along > 0.25 * min(a.height, b.height)
            assert not overlap, f"{name}: {one.get_text()!r} is written over {other.get_text()!r}"


def test_odd_names_are_written_as_they_are(tmp_path, drawn):
    names = (r"$\frac{a$", "_hidden", "others", "bounds", "x" * 60, "with space", "ünïcode", "a:b=$1,m2=3")
    scenes = (r"$\frac{$", "a/b", "_")
    rows = [("paper", k, n, solver, 5, 10) for k in ("none", "uniform") for n in (6, 9) for solver in names]
    rows += [(scene, k, 9, solver, 5, 10) for scene in scenes for k in range(3) for solver in names]
    counts = {"n": [6, 9], "counts": {name: [1, 2] for name in names}, "ransac": [], "kind": "complexity"}
    paper_figures([results_of(rows), counts], tmp_path)
    for figure in drawn.values():
        assert {shortened(name) for name in names} <= {text.get_text() for text, _ in texts(figure)}
    assert set(scenes) <= {axes.get_title() for axes in drawn["figure4_scenes.png"].axes}


def test_long_names_are_broken_and_shortened():
    assert wrapped("Herz-Jesus-P25", 11) == "Herz-Jesus-\nP25"
    assert wrapped("sceaux_castle", 8) == "sceaux_\ncastle"
    assert max(map(len, wrapped("x" * 50 + "-y", 10).split("\n"))) <= 11
    assert wrapped("", 5) == ""
    assert shortened("short") == "short"
    assert all(len(shortened("ab" * length)) == 27 for length in (27, 28, 80))
