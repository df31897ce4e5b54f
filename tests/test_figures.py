"""Pictures show the data of their arguments, and leave matplotlib's global state alone."""

from __future__ import annotations

import csv
import importlib
import subprocess
import sys

import numpy as np
import pytest
import torch

pytest.importorskip("matplotlib")

from matplotlib.figure import Figure
from matplotlib.image import imread

from kornia_pnpnet.evaluation.figures import (
    OverviewRow,
    plot_errors,
    plot_overview,
    plot_pose,
    plot_reliability,
    plot_success,
    plot_sweep,
    plot_training,
)
from kornia_pnpnet.metrics import success_rate


def fake_results(solvers: int = 3, sets: int = 2, shift: float = 0.0) -> dict:
    """A results file, as far as a picture reads it."""
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
    """The picture, which has a white opaque background and is neither empty nor full."""
    image = imread(path)
    assert (image[0, 0] == 1).all()
    assert 0.005 < (image[..., :3].min(-1) < 0.9).mean() < 0.6
    return image


def differ(a: np.ndarray, b: np.ndarray) -> bool:
    return a.shape != b.shape or not np.array_equal(a, b)


RED = (0xCC, 0x33, 0x11)


@pytest.fixture
def figures(monkeypatch):
    """Figures instead of files."""
    found = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: found.append(self))
    return found


@pytest.mark.parametrize("plot", [plot_success, plot_errors])
def test_results_pictures_show_the_data(tmp_path, plot):
    results = fake_results(sets=1)
    first = pixels(plot(tmp_path / "new" / "a.png", results))
    assert results == fake_results(sets=1)
    assert not differ(first, pixels(plot(tmp_path / "b.png", results)))
    assert differ(first, pixels(plot(tmp_path / "c.png", fake_results(sets=1, shift=0.2))))
    with pytest.raises(ValueError, match="no rows"):
        plot(tmp_path / "d.png", {**results, "rows": []})
    many = fake_results(solvers=14)
    del many["rows"][1]
    many["rows"][0]["success"] = {"rate": 0.0, "low": 1e-18, "high": 0.0, "total": 50}
    many["rows"][0]["per_problem"]["rotation_error_deg"] = [0.0] * 50
    pixels(plot(tmp_path / "e.png", many))


def test_every_set_has_a_panel_with_a_dot_for_each_of_its_solvers(tmp_path, figures):
    results = fake_results(solvers=3, sets=5)
    del results["rows"][-1]
    plot_success(tmp_path / "a.png", results)
    assert len(figures[0].axes) == 5
    for axes, name in zip(figures[0].axes, results["data"], strict=True):
        dots = {dot.get_label(): dot.lines[0].get_xdata()[0] for dot in axes.containers}
        rows = [row for row in results["rows"] if row["data"] == name]
        assert dots == pytest.approx({row["solver"]: 100 * row["success"]["rate"] for row in rows})


def test_error_curves_are_the_shares_of_the_errors(tmp_path, figures):
    results = fake_results(solvers=2, sets=1)
    plot_errors(tmp_path / "a.png", results)
    (curve,) = (line for line in figures[0].axes[0].lines if line.get_label() == "solver-1")
    errors = np.array(results["rows"][1]["per_problem"]["rotation_error_deg"])
    at, share = (np.asarray(values, dtype=float) for values in curve.get_data())
    for limit in (0.5, 1.0, 5.0):
        assert share[at <= limit].max(initial=0.0) == pytest.approx(100 * (errors <= limit).mean())


def test_the_overview_has_bars_of_success_and_time(tmp_path, figures):
    clean, mixed = success_rate(torch.arange(100) < 90), success_rate(torch.arange(100) < 80)
    rows = [OverviewRow("a", True, clean, mixed, 50.0), OverviewRow("b", False, mixed, clean, 200.0)]
    plot_overview(tmp_path / "a.png", rows, outliers="some outliers")
    solved, time = figures[0].axes
    assert [bar.get_width() for bar in solved.patches] == pytest.approx([90, 80, 80, 90])
    assert [bar.get_width() for bar in time.patches] == [50.0, 200.0]
    with pytest.raises(ValueError, match="at least one row"):
        plot_overview(tmp_path / "a.png", [], outliers="")


def test_pose_picture_marks_rejected_pairs_and_takes_points_behind_the_camera(tmp_path):
    generator = np.random.default_rng(1)
    img = generator.uniform((0, 0), (640, 480), (9, 2))
    projected = img + generator.normal(0, 2, img.shape)
    projected[2] = img[2] + 150
    rejected = np.arange(9) == 2
    kept = pixels(plot_pose(tmp_path / "a.png", img, projected, np.zeros(9, dtype=bool), title="all kept"))
    marked = pixels(plot_pose(tmp_path / "b.png", img, projected, rejected, title="one rejected"))
    # The legend always has a red cross; a rejected pair adds a cross and a line.
    red = [(np.abs(image[..., :3] - np.array(RED) / 255).max(-1) < 0.1).sum() for image in (kept, marked)]
    assert red[1] > 1.5 * red[0] > 0

    img, projected, rejected = map(torch.from_numpy, (img, projected, rejected))
    whole = pixels(plot_pose(tmp_path / "c.png", img, projected, rejected, (640, 480)))
    projected[4], projected[5] = torch.nan, 1e12
    assert differ(whole, pixels(plot_pose(tmp_path / "d.png", img, projected, rejected, (640, 480))))
    pixels(plot_pose(tmp_path / "e.png", img, torch.full_like(img, torch.nan), rejected))
    pixels(plot_pose(tmp_path / "f.png", img[:, :1] * torch.tensor([0.0, 1.0]), projected, rejected))


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


def test_training_picture_reads_the_history(tmp_path):
    drawn = []
    for name, factor in (("a", 1.0), ("b", 2.0)):
        rows = [
            f"{i},{factor / i},{1 / i},{9 / i},{0.5 / i},{4 / i},1.0,{'' if i % 2 else 0.1 * i}" for i in range(1, 9)
        ]
        (tmp_path / f"{name}.csv").write_text("\n".join([f"{HEADER},lr,val/none/success", *rows]) + "\n")
        drawn.append(pixels(plot_training(tmp_path / f"{name}.png", tmp_path / f"{name}.csv")))
    assert differ(*drawn)
    bad = tmp_path / "bad.csv"
    bad.write_text(f"{HEADER}\n1,1,1,1,1,1\n2,nan,1,1,1,1\n")
    pixels(plot_training(tmp_path / "c.png", bad))
    for text, message in (("", "no rows"), (HEADER, "no rows"), ("update\n1", "'total'")):
        bad.write_text(text)
        with pytest.raises(ValueError, match=message):
            plot_training(tmp_path / "a.png", bad)


def sweep_rows() -> list[dict[str, str]]:
    """A summary of a sweep; the rate identifies the run."""
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
def test_sweep_picture_shows_success_and_time(tmp_path, figures, against, places, panels):
    plot_sweep(tmp_path / "a.png", write_summary(tmp_path / "a.csv", sweep_rows()), against=against)
    left, right = figures[0].axes[:2], figures[0].axes[2:]
    for axes, twin, value in zip(left, right, panels, strict=True):
        pairs = [(place, value) if against == "n" else (value, place) for place in places]
        for bars, share in zip(axes.containers, (0, 33), strict=True):
            x, y = bars.lines[0].get_data()
            assert list(x) == places
            assert list(y) == pytest.approx([n + m / 10 + share for n, m in pairs])
        (time,) = twin.lines
        assert list(time.get_ydata()) == pytest.approx([n * m for n, m in pairs])  # the least over the mixes
        zeros = [a.transData.transform((0, 0))[1] for a in (axes, twin)]
        assert zeros[0] == pytest.approx(zeros[1])


def test_an_unfinished_sweep_is_drawn_and_a_contradictory_one_is_not(tmp_path):
    def draw(rows):
        return plot_sweep(tmp_path / "a.png", write_summary(tmp_path / "a.csv", rows), against="n")

    assert differ(pixels(draw(sweep_rows())), pixels(draw(sweep_rows()[:5])))
    with pytest.raises(ValueError, match="several runs"):
        draw([{**row, "model.m": "2"} for row in sweep_rows()])
    with pytest.raises(ValueError, match="us_per_problem"):
        draw([{key: row[key] for key in row if key != "us_per_problem"} for row in sweep_rows()])


def test_pictures_need_matplotlib_without_pyplot(monkeypatch):
    code = (
        "import sys, kornia_pnpnet, kornia_pnpnet.cli\n"
        "assert not {'matplotlib', 'cv2', 'pycolmap', 'hydra', 'lightning_fabric'} & set(sys.modules)\n"
        "import kornia_pnpnet.evaluation.figures\n"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delitem(sys.modules, "kornia_pnpnet.evaluation.figures")
    with pytest.raises(ImportError, match=r"kornia_pnpnet\[eval\]"):
        importlib.import_module("kornia_pnpnet.evaluation.figures")
