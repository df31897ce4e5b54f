"""An evaluation is one file, and everything shown is computed from what is in it."""

from __future__ import annotations

import json
import math

import pytest
import torch
from torch import nn

from kornia_pnpnet import PnPNet, RobustWeightedLM, pose_errors, success, success_rate
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.environment import environment
from kornia_pnpnet.evaluation import (
    EvaluationData,
    draw_problems,
    evaluate,
    format_table,
    load_results,
    row_errors,
    save_results,
)
from kornia_pnpnet.types import PnPResult, Pose


class _Fixed(nn.Module):
    """Returns the identity, and remembers how it was called."""

    def __init__(self, bad: float | None = None) -> None:
        super().__init__()
        self.bad = bad
        self.sizes: list[int] = []
        self.was_training: set[bool] = set()
        self.had_grad: set[bool] = set()

    def forward(self, world_points, img_points, intrinsics):
        batch, count = world_points.shape[:2]
        self.sizes.append(batch)
        self.was_training.add(self.training)
        self.had_grad.add(torch.is_grad_enabled())
        rotation = torch.eye(3).expand(batch, 3, 3).to(world_points)
        translation = world_points.new_zeros(batch, 3)
        if self.bad is not None:
            translation[0] = self.bad
        ok = torch.ones(batch, dtype=torch.bool)
        cost = world_points.new_zeros(batch)
        return PnPResult(rotation, translation, torch.ones(batch, count), cost, ok, Pose(rotation, translation))


@pytest.fixture(scope="module")
def sets():
    clean = SyntheticProblems(batch_size=100, seed=5)
    spoilt = SyntheticProblems(batch_size=100, seed=5, outliers=OutlierMix(count=2))
    return {
        "clean": EvaluationData(draw_problems(clean, 100), description={"seed": 5}),
        "spoilt": EvaluationData(draw_problems(spoilt, 60), max_translation=0.5, unit=""),
    }


@pytest.fixture(scope="module")
def solver():
    return PnPNet(None, RobustWeightedLM(m=10, learnable=False))


@pytest.fixture(scope="module")
def results(sets, solver):
    return evaluate({"lm": solver, "fixed": _Fixed()}, sets)


def test_rows_hold_what_the_solver_does(results, sets, solver):
    assert [(row["data"], row["solver"]) for row in results["rows"]] == [
        (data, name) for data in sets for name in ("lm", "fixed")
    ]
    row = results["rows"][2]
    problems = sets["spoilt"].problems
    result = solver(problems.world_points, problems.img_points, problems.intrinsics)
    truth = Pose(*(part.double() for part in problems.pose))
    expected = pose_errors(Pose(result.rotation.double(), result.translation.double()), truth)
    errors, ok = row_errors(row)
    torch.testing.assert_close(tuple(errors), tuple(expected), rtol=1e-5, atol=1e-9)
    assert torch.equal(ok, result.ok)
    assert row["ok"] == pytest.approx(result.ok.double().mean().item(), rel=1e-5)


def test_summaries_are_those_of_the_stored_errors(results):
    for row in results["rows"]:
        entry = results["data"][row["data"]]
        errors, _ = row_errors(row)
        rate = success_rate(success(errors, entry["max_rotation_deg"], entry["max_translation"]))
        assert row["success"] == pytest.approx(rate._asdict(), rel=1e-5)
        for name, values in errors._asdict().items():
            quartiles = values.quantile(torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)).tolist()
            assert [row[name][key] for key in ("q25", "median", "q75")] == pytest.approx(quartiles, rel=1e-5)


def test_table_shows_the_recomputed_numbers(results):
    lines = format_table(results).splitlines()
    assert len(lines) == 2 + len(results["rows"])
    assert len({len(line) for line in lines}) == 1
    for line, row in zip(lines[2:], results["rows"], strict=True):
        data, name, shown, rotation, translation, micros, ok = (cell.strip() for cell in line.strip("|").split("|"))
        entry = results["data"][row["data"]]
        errors, was_ok = row_errors(row)
        rate = success_rate(success(errors, entry["max_rotation_deg"], entry["max_translation"]))
        assert (data, name, shown) == (row["data"], row["solver"], str(rate))
        assert float(rotation.rstrip("°")) == pytest.approx(errors.rotation_error_deg.quantile(0.5).item(), rel=6e-3)
        assert float(translation.split()[0]) == pytest.approx(errors.translation_error.quantile(0.5).item(), rel=6e-3)
        assert translation.endswith(" m") == (entry["unit"] == "m")
        assert float(micros) == round(row["us_per_problem"])
        assert ok == f"{100 * was_ok.double().mean():.1f} %"


def test_results_file_round_trips(results, tmp_path):
    path = tmp_path / "new" / "results.json"
    save_results(results, path)
    assert load_results(path) == results
    save_results({**results, "rows": []}, path)
    assert load_results(path)["rows"] == []
    assert [entry.name for entry in path.parent.iterdir()] == ["results.json"]


def test_a_failed_save_keeps_the_old_file(results, tmp_path):
    path = tmp_path / "results.json"
    save_results(results, path)
    with pytest.raises(ValueError, match="not JSON compliant"):
        save_results({**results, "rows": [math.nan]}, path)
    assert load_results(path) == results
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("content", ["", "[]", '{"format": 99}', "\x00"])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "other.json"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"other\.json"):
        load_results(path)


def test_ten_thousand_problems_and_four_solvers_stay_small():
    problems = draw_problems(SyntheticProblems(batch_size=10_000), 10_000)
    row = evaluate({"fixed": _Fixed()}, {"set": EvaluationData(problems)}, repeats=1)["rows"][0]
    assert 4 * len(json.dumps(row, separators=(",", ":"))) < 2_000_000


def test_big_sets_are_solved_in_chunks_with_one_untimed_call(sets):
    solver = _Fixed()
    solver.train()
    results = evaluate({"fixed": solver}, {"clean": sets["clean"]}, chunk=40, repeats=4)
    assert solver.sizes == [40, 40, 40, 20, 40]
    assert solver.was_training == {False}
    assert solver.had_grad == {False}
    assert solver.training
    whole = evaluate({"fixed": solver}, {"clean": sets["clean"]})
    assert results["rows"][0]["per_problem"] == whole["rows"][0]["per_problem"]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_pose_that_is_not_finite_is_a_failure(sets, bad):
    results = evaluate({"bad": _Fixed(bad), "fixed": _Fixed()}, {"clean": sets["clean"]})
    broken, whole = results["rows"]
    assert broken["per_problem"]["ok"] == [0] + 99 * [1]
    assert broken["per_problem"]["translation_error"] == whole["per_problem"]["translation_error"]


def test_data_and_solvers_are_described(results, solver):
    assert results["solvers"]["lm"] == {"class": "PnPNet", "config": solver.config()}
    assert results["solvers"]["fixed"]["config"] is None
    assert results["data"]["clean"]["description"] == {"seed": 5}
    spoilt = results["data"]["spoilt"]
    assert (spoilt["count"], spoilt["n"], spoilt["mean_outliers"], spoilt["dtype"]) == (60, 9, 2.0, "float32")
    assert (spoilt["max_translation"], spoilt["unit"]) == (0.5, "")
    assert all(row["us_per_problem"] > 0 for row in results["rows"])


def test_environment_says_what_ran():
    env = environment()
    assert env["versions"]["torch"] == torch.__version__
    assert set(env["versions"]) == {"kornia_pnpnet", "torch", "kornia", "numpy", "opencv"}
    assert env["threads"] == torch.get_num_threads()
    assert env["cpu"]
    assert env["commit"] is None or len(env["commit"].rstrip("+")) == 40
    json.dumps(env, allow_nan=False)


def test_fewer_problems_are_the_first_of_more():
    source = SyntheticProblems(batch_size=8, seed=2)
    few, many = draw_problems(source, 5), draw_problems(source, 20)
    assert len(many.world_points) == 20
    assert torch.equal(few.world_points, many.world_points[:5])
    assert torch.equal(many.pose.translation[8:16], source.batch(1).pose.translation)
    with pytest.raises(ValueError, match="at least 1"):
        draw_problems(source, 0)
