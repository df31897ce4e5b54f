"""Pictures exist, show the data, and leave nothing behind in matplotlib."""

from __future__ import annotations

import csv
import importlib
import itertools
import subprocess
import sys
import warnings
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from strategies import ANY, ERRORS, WORD, Seen, damage, many, names_the_file, numbers

from kornia_pnpnet.evaluation.figures import (
    plot_against_m,
    plot_against_n,
    plot_mismatches,
    plot_pose,
    plot_reliability,
    plot_scenes,
    plot_sweep,
    plot_training,
)

pytest.importorskip("matplotlib")

from matplotlib.figure import Figure
from matplotlib.image import imread

from kornia_pnpnet.evaluation.figures import (
    plot_errors,
    plot_success,
)


def fake_results(solvers: int = 3, sets: int = 2, shift: float = 0.0) -> dict:
    """What `evaluate` returns, as far as a picture reads it."""
    generator = np.random.default_rng(0)
    names, data = ["pnpnet-n9", *(f"solver-{i}" for i in range(1, solvers))], [f"set, {i}" for i in range(sets)]
    entry = {"max_rotation_deg": 1.0, "max_translation": 0.2, "unit": "m"}
    rows = []
    for set_name in data:
        for index, name in enumerate(names):
            rate = max(0.0, 0.9 - 0.2 * index - shift)
            rotation = np.exp(generator.normal(index + shift, 1.0, 50)).tolist()
            per_problem = {"rotation_error_deg": rotation, "translation_error": rotation, "ok": [1] * 50}
            success = {"rate": rate, "low": max(0.0, rate - 0.05), "high": min(1.0, rate + 0.05), "total": 50}
            rows.append({"data": set_name, "solver": name, "success": success, "per_problem": per_problem})
    return {"solvers": dict.fromkeys(names), "data": {name: dict(entry) for name in data}, "rows": rows}


def pixels(path) -> np.ndarray:
    image = imread(path)
    assert image.shape[0] > 300
    assert image.shape[1] > 1400
    # An opaque white background; colour, dark ink, and most of the page empty.
    assert (image[0, 0] == 1).all()
    assert 0.005 < (image[..., :3].min(-1) < 0.9).mean() < 0.6
    return image


def differ(a: np.ndarray, b: np.ndarray) -> bool:
    return a.shape != b.shape or not np.array_equal(a, b)


def has_colour(image: np.ndarray, colour: tuple[int, int, int]) -> bool:
    return bool((np.abs(image[..., :3] - np.array(colour) / 255).max(-1) < 0.02).sum() > 20)


BLUE, RED = (0, 0x72, 0xB2), (0xCC, 0x33, 0x11)


@pytest.fixture
def problem():
    generator = np.random.default_rng(1)
    img = generator.uniform((0, 0), (640, 480), (9, 2))
    projected = img + generator.normal(0, 2, img.shape)
    projected[2] = img[2] + 150
    return img, projected, np.arange(9) == 2


@pytest.mark.parametrize("plot", [plot_success, plot_errors])
def test_results_pictures_show_the_data(tmp_path, plot):
    results = fake_results(sets=1)
    first = pixels(plot(tmp_path / "new" / "a.png", results))
    assert results == fake_results(sets=1)
    again = pixels(plot(tmp_path / "b.png", results))
    other = pixels(plot(tmp_path / "c.png", fake_results(sets=1, shift=0.2)))
    assert np.array_equal(first, again)
    assert differ(first, other)
    assert has_colour(first, BLUE)


def test_every_set_has_a_panel_with_a_dot_for_each_of_its_solvers(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: figures.append(self))
    results = fake_results(solvers=3, sets=5)
    del results["rows"][-1]
    plot_success(tmp_path / "a.png", results)
    panels = figures[0].axes
    assert [axes.get_title() for axes in panels] == list(results["data"])
    for axes in panels:
        dots = {dot.get_label(): dot.lines[0].get_xdata()[0] for dot in axes.containers}
        rows = [row for row in results["rows"] if row["data"] == axes.get_title()]
        assert dots == pytest.approx({row["solver"]: 100 * row["success"]["rate"] for row in rows})


def test_error_curves_are_the_shares_of_the_errors(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: figures.append(self))
    results = fake_results(solvers=2, sets=1)
    plot_errors(tmp_path / "a.png", results)
    (curve,) = (line for line in figures[0].axes[0].lines if line.get_label() == "solver-1")
    errors = np.array(results["rows"][1]["per_problem"]["rotation_error_deg"])
    at, share = (np.asarray(values, dtype=float) for values in curve.get_data())
    for limit in (0.5, 1.0, 5.0):
        assert share[at <= limit].max(initial=0.0) == pytest.approx(100 * (errors <= limit).mean())


@pytest.mark.parametrize("plot", [plot_success, plot_errors])
def test_results_without_rows_cannot_be_drawn(tmp_path, plot):
    with pytest.raises(ValueError, match="no rows"):
        plot(tmp_path / "a.png", {**fake_results(), "rows": []})


@pytest.mark.parametrize("plot", [plot_success, plot_errors])
@pytest.mark.parametrize(("solvers", "sets"), [(1, 1), (14, 1)])
def test_any_number_of_solvers_and_sets(tmp_path, plot, solvers, sets):
    pixels(plot(tmp_path / "a.png", fake_results(solvers, sets)))


def test_incomplete_and_extreme_rows(tmp_path):
    results = fake_results()
    del results["rows"][1]
    results["rows"][0]["success"] = {"rate": 0.0, "low": 1e-18, "high": 0.0, "total": 50}
    results["rows"][0]["per_problem"]["rotation_error_deg"] = [0.0] * 50
    results["data"]["set, 1"]["max_translation"] = 1.0
    pixels(plot_success(tmp_path / "a.png", results))
    pixels(plot_errors(tmp_path / "b.png", results))


def test_pose_picture_marks_rejected_pairs(tmp_path, problem):
    img, projected, rejected = problem
    kept = pixels(plot_pose(tmp_path / "a.png", img, projected, np.zeros(9, dtype=bool), title="all kept"))
    marked = pixels(plot_pose(tmp_path / "b.png", img, projected, rejected, title="one rejected"))
    # The legend has a cross in any case; the pair's own cross and line come on top.
    red = [(np.abs(image[..., :3] - np.array(RED) / 255).max(-1) < 0.1).sum() for image in (kept, marked)]
    assert red[1] > 1.5 * red[0] > 0
    assert has_colour(marked, BLUE)


def test_pose_picture_takes_tensors_sizes_and_points_behind(tmp_path, problem):
    img, projected, rejected = map(torch.from_numpy, problem)
    whole = pixels(plot_pose(tmp_path / "a.png", img, projected, rejected, (640, 480)))
    projected[4] = torch.nan
    projected[5] = 1e12
    behind = pixels(plot_pose(tmp_path / "b.png", img, projected, rejected, (640, 480)))
    assert differ(whole, behind)
    pixels(plot_pose(tmp_path / "c.png", img, torch.full_like(img, torch.nan), rejected))
    pixels(plot_pose(tmp_path / "d.png", img[:, :1] * torch.tensor([0.0, 1.0]), projected, rejected))


def test_reliability_picture_leaves_empty_ranges_out(tmp_path):
    curve = {"number": [3.0, 0.0, 5.0], "predicted": [0.1, 0.0, 0.9], "observed": [0.2, 0.0, 0.7]}
    first = pixels(plot_reliability(tmp_path / "a.png", {"a": curve}))
    empty = {**curve, "predicted": [0.1, 0.5, 0.9], "observed": [0.2, 1.0, 0.7]}
    assert not differ(first, pixels(plot_reliability(tmp_path / "b.png", {"a": empty})))
    moved = {**curve, "observed": [0.2, 0.0, 0.3]}
    assert differ(first, pixels(plot_reliability(tmp_path / "c.png", {"a": moved})))
    pixels(plot_reliability(tmp_path / "d.png", {f"curve {i}": curve for i in range(8)}))
    with pytest.raises(ValueError, match="at least one curve"):
        plot_reliability(tmp_path / "e.png", {})


HEADER = "update,total,init_rotation,init_translation,refined_rotation,refined_translation"


def write_history(path, *, factor: float = 1.0):
    rows = [f"{i},{factor / i},{1 / i},{9 / i},{0.5 / i},{4 / i},1.0,{'' if i % 2 else 0.1 * i}" for i in range(1, 9)]
    path.write_text("\n".join([f"{HEADER},lr,val/none/success", *rows]) + "\n")
    return path


def test_training_picture_reads_the_history(tmp_path):
    first = pixels(plot_training(tmp_path / "a.png", write_history(tmp_path / "a.csv")))
    other = pixels(plot_training(tmp_path / "b.png", write_history(tmp_path / "b.csv", factor=2.0)))
    assert differ(first, other)
    bare = tmp_path / "bare.csv"
    bare.write_text(f"{HEADER}\n1,1,1,1,1,1\n2,nan,1,1,1,1\n")
    pixels(plot_training(tmp_path / "c.png", bare))


@pytest.mark.parametrize(
    ("text", "message"), [("", "no rows"), (HEADER, "no rows"), ("update\n1", "no column 'total'")]
)
def test_histories_that_cannot_be_drawn(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        plot_training(tmp_path / "a.png", path)


def sweep_rows() -> list[dict[str, str]]:
    """A sweep's summary: the rate says which run it is."""
    rows = []
    for mix in ("0.33", "0"):
        for n, m in ((9, 10), (9, 2), (6, 2), (6, 10)):
            rate = n / 100 + m / 1000 + float(mix)
            rows.append({"model.n": f"{n}", "model.m": f"{m}", "data.outliers.max_ratio": mix})
            rows[-1] |= {"uniform/rate": f"{rate}", "uniform/low": f"{rate - 0.01}", "uniform/high": f"{rate + 0.01}"}
            rows[-1]["us_per_problem"] = f"{n * m + 10 * float(mix)}"
    return rows


def write_summary(path, rows):
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return path


@pytest.mark.parametrize(("against", "places", "panels"), [("m", [2, 10], [6, 9]), ("n", [6, 9], [2, 10])])
def test_sweep_picture_shows_success_and_time(tmp_path, monkeypatch, against, places, panels):
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: figures.append(self))
    plot_sweep(tmp_path / "a.png", write_summary(tmp_path / "a.csv", sweep_rows()), against=against)
    left, right = figures[0].axes[:2], figures[0].axes[2:]
    other = "n" if against == "m" else "m"
    assert [axes.get_title(loc="left") for axes in left] == [f"{other} = {value}" for value in panels]
    for axes, twin, value in zip(left, right, panels, strict=True):
        pairs = [(place, value) if against == "n" else (value, place) for place in places]
        drawn = {bars.get_label(): bars.lines[0].get_data() for bars in axes.containers}
        assert list(drawn) == ["no wrong pairs", "0 to ⌊n/3⌋ pairs wrong"]
        for (x, y), share in zip(drawn.values(), (0, 33), strict=True):
            assert list(x) == places
            assert list(y) == pytest.approx([n + m / 10 + share for n, m in pairs])
        (time,) = twin.lines
        # The least over the mixes; the zeros of both axes lie side by side.
        assert list(time.get_ydata()) == pytest.approx([n * m for n, m in pairs])
        zeros = [a.transData.transform((0, 0))[1] for a in (axes, twin)]
        assert zeros[0] == pytest.approx(zeros[1])


def test_an_unfinished_sweep_is_drawn(tmp_path):
    whole = pixels(plot_sweep(tmp_path / "a.png", write_summary(tmp_path / "a.csv", sweep_rows()), against="n"))
    part = pixels(plot_sweep(tmp_path / "b.png", write_summary(tmp_path / "b.csv", sweep_rows()[:5]), against="n"))
    assert differ(whole, part)
    assert has_colour(whole, BLUE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: [{**row, "model.m": "2"} for row in rows], "several runs with the same n, m and mix"),
        (lambda rows: [{key: row[key] for key in row if key != "us_per_problem"} for row in rows], "'us_per_problem'"),
    ],
)
def test_sweeps_that_cannot_be_drawn(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        plot_sweep(tmp_path / "a.png", write_summary(tmp_path / "a.csv", change(sweep_rows())), against="m")
    (tmp_path / "empty.csv").write_text("model.n,model.m")
    with pytest.raises(ValueError, match="no rows"):
        plot_sweep(tmp_path / "a.png", tmp_path / "empty.csv", against="m")


def test_no_pyplot_and_no_matplotlib_without_figures():
    code = (
        "import sys, kornia_pnpnet, kornia_pnpnet.cli\n"
        "assert not {'matplotlib', 'cv2', 'pycolmap', 'hydra', 'lightning_fabric'} & set(sys.modules)\n"
        "import kornia_pnpnet.evaluation.figures\n"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_without_matplotlib_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delitem(sys.modules, "kornia_pnpnet.evaluation.figures")
    with pytest.raises(ImportError, match=r"pip install 'kornia_pnpnet\[eval\]'"):
        importlib.import_module("kornia_pnpnet.evaluation.figures")


# -- whatever comes in -------------------------------------------------------------------------------------------------


def test_pictures_of_any_numbers(tmp_path):
    path = tmp_path / "picture.png"

    @many(25)
    @given(st.integers(0, 5), st.data(), st.none() | st.tuples(ANY, ANY))
    def run(count, data, size):
        shapes = (count, 2), data.draw(st.sampled_from([(count, 2), (count, 2), (count, 3), (2,)]))
        points = [data.draw(numbers(torch.float64, shape)) for shape in shapes]
        path.unlink(missing_ok=True)
        try:
            plot_pose(path, *points, torch.arange(count) % 2 == 0, size)
        except ERRORS:
            assert not path.exists()
        else:
            assert path.stat().st_size > 1000

    run()


CURVES = {
    plot_training: "update,total,init_rotation,init_translation,refined_rotation,refined_translation,val/a/success\n"
    "0,3.5,1,2,3,4,\n100,2.5,1,2,3,4,0.5\n200,1.5,1,2,3,4,0.75\n",
    partial(plot_sweep, against="n"): "model.n,model.m,data.outliers.max_ratio,us_per_problem,uniform/rate,uniform/low,"
    "uniform/high\n6,5,0.33,20.5,0.5,0.4,0.6\n9,5,0.33,20.5,0.6,0.5,0.7\n9,8,0,20.5,0.8,0.7,0.9\n",
}


@pytest.mark.filterwarnings("ignore::UserWarning")  # about names of curves
@pytest.mark.parametrize("plot", CURVES, ids=["plot_training", "plot_sweep"])
def test_damaged_curves_are_an_error_of_ours(plot, tmp_path, request):
    path = tmp_path / "curves.csv"

    @many(25)
    @given(damage(CURVES[plot].encode()))
    def run(content):
        path.write_bytes(content)
        try:
            plot(tmp_path / "picture.png", path)
        except ValueError as error:
            names_the_file(error, path)

    run()


SOURCES = "paper", "gaussian_pose", "fox", "the $b_a^r$n"


NAMES = "epnp-lm", "epnp-lm:m=3", "pnpnet-n6", "pnpnet-n9", "known-inliers"


SHARE = st.floats(0.0, 1.0)


NUMBER = st.one_of(st.floats(0.0, 200.0), st.sampled_from([-1.0, 0.0, 1e-300, 1e300]))


@st.composite
def evaluations(draw, full=False):
    """Results of any solvers on any sets, each on most of them; ``full``: of all there are here."""

    def some(*values):
        return values if full else draw(st.lists(st.sampled_from(values), min_size=1, max_size=3, unique=True))

    def few(values):  # one for each set and solver would be more than can be drawn
        return itertools.cycle(draw(st.lists(values, min_size=1, max_size=3)))

    names, outliers, numbers = some(*NAMES, draw(WORD)), some("none", "uniform", 1, 2, "many"), some(6, 9, 0)
    limits, units, shares = few(NUMBER), few(WORD), few(st.sampled_from([0.5, 1]))
    sets = {
        f"{source} {wrong} {n}": {
            "description": {"source": source, "outliers": wrong, "mismatch_share": next(shares)},
            "n": n,
            "max_rotation_deg": next(limits),
            "max_translation": next(limits),
            "unit": next(units),
        }
        for source, wrong, n in itertools.product(some(*SOURCES), outliers, numbers)
    }
    rates = few(st.fixed_dictionaries({"rate": SHARE, "low": SHARE, "high": SHARE, "total": st.integers(1, 300)}))
    times, lost = few(st.floats(1e-9, 1e12)), few(st.sampled_from([False, False, False, True]))
    rows = [
        {"data": data, "solver": solver, "success": next(rates), "us_per_problem": next(times)}
        for data, solver in itertools.product(sets, names)
        if not next(lost)
    ]
    depths = few(st.sampled_from([None, {"refine": 1}, *({"refine": {"m": m}} for m in (0, 3, 5))]))
    if full:
        depths = itertools.cycle([{"refine": {"m": 10}}, {"refine": {"m": 3}}])
    return {"data": sets, "solvers": {name: {"config": next(depths)} for name in names}, "rows": rows}


def drawn(tmp_path, what, plot, strategy, examples=16):
    """Draw pictures: there is one, or an error and none."""
    made = Seen()
    path = tmp_path / "picture.png"

    @many(examples)
    @given(strategy)
    def run(values):
        path.unlink(missing_ok=True)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Glyph", UserWarning)  # that the font does not have
            assert (made(lambda: plot(path, values)) is not None) == path.exists()

    run()
    made.both(1)


@pytest.mark.parametrize("plot", [plot_against_m, plot_against_n, plot_mismatches, plot_scenes])
def test_pictures_of_any_results(plot, tmp_path):
    strategy = st.lists(evaluations(), max_size=2) | st.lists(evaluations(full=True), min_size=1, max_size=1)
    drawn(tmp_path, f"`{plot.__name__}` of any results", plot, strategy)


def test_reliability_pictures_of_any_numbers(tmp_path):
    keys = "number", "predicted", "observed"
    equal = st.lists(st.tuples(st.integers(0, 9), ANY, ANY), min_size=1, max_size=4)
    equal = equal.map(lambda rows: dict(zip(keys, zip(*rows, strict=True), strict=True)))
    curve = equal | st.fixed_dictionaries(dict.fromkeys(keys, st.lists(ANY, max_size=3)))
    drawn(tmp_path, "`plot_reliability` of any numbers", plot_reliability, st.dictionaries(WORD, curve, max_size=3))
