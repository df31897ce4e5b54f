"""What the results page says of short runs follows from their intervals."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")

REPO = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def make():
    spec = importlib.util.spec_from_file_location("make_results", REPO / "docs" / "results" / "make.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def row(rate, *, half=1.0, **columns):
    bounds = {"rate": rate, "low": rate - half, "high": rate + half}
    shares = {f"{data}/{key}": f"{value / 100:.4f}" for data in ("none", "uniform") for key, value in bounds.items()}
    return {"update": "4000", "us_per_problem": "12.3", **columns, **shares}


@pytest.mark.parametrize(
    ("rates", "others", "verdict"),
    [
        ([75.0], [70.0], "+5.0 points (above)"),
        ([65.0], [70.0], "-5.0 points (below)"),
        ([71.5], [70.0], "+1.5 points (not told apart)"),
        ([75.0], [70.0, 74.0], "+3.0 points (not told apart)"),  # one seed of the others comes near
        ([75.0, 71.0], [70.0], "+3.0 points (not told apart)"),
    ],
)
def test_runs_are_told_apart_by_all_their_intervals(make, rates, others, verdict):
    assert make.compared([row(rate) for rate in rates], [row(rate) for rate in others], "none") == verdict


def test_every_experiment_has_a_claim(make):
    for path in make.EXPERIMENTS.glob("*.yaml"):
        assert path.stem in ("protocol", "finetune", "set") or make.claim(path.stem).endswith("."), path


def test_the_ablations_are_said_beside_the_recipe(make):
    seeds = [row(rate, experiment="recipe", seed=f"{seed}") for seed, rate in enumerate((80.0, 81.5))]
    kernels = [row(rate, experiment="kernels", **{make.KERNEL: name}) for name, rate in (("huber", 70), ("cauchy", 81))]
    text = make.ablation_text([*kernels, *seeds, row(90.0, experiment="shared", seed="", **{make.KERNEL: ""})])
    assert "| `recipe seed=1` | 81.5 [80.5, 82.5] | 81.5 [80.5, 82.5] |" in text
    assert "up to 1.5 points" in text
    assert "| `shared` |" in text
    assert make.claim("kernels") in text
    assert "*Found, huber:* none -10.8 points (below), uniform -10.8 points (below)." in text
    assert "*Found, cauchy:* none +0.2 points (not told apart)" in text
    assert "*Found:* none +9.2 points (above)" in text


def test_the_sweep_is_a_table_with_its_steps(make):
    rows = [
        row(rate, **{"model.n": f"{n}", "model.m": f"{m}", "data.outliers.max_ratio": mix})
        for mix, drop in (("0", 0), ("0.33", 20))
        for n in (6, 9)
        for m in (2, 5)
        for rate in (30.0 + 5 * n + (m == 5) - drop,)
    ]
    rows[0]["us_per_problem"] = "7"
    text = make.sweep_text(rows)
    assert "| 9 | 0 to ⌊n/3⌋ pairs wrong | 55.0 [54.0, 56.0] | 56.0 [55.0, 57.0] |" in text
    assert "| 6 | µs | 7 | 12 |" in text
    assert (
        "- no wrong pairs: m at n = 9, 2 → 5 +1.0 points (not told apart); n at m = 5, 6 → 9 +15.0 points (above)."
    ) in text
