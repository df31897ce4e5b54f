"""An evaluation is one file, and everything shown is computed from what is in it."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys

import pytest
import torch
from torch import nn

import kornia_pnpnet.evaluation.comparison
from kornia_pnpnet import MLPInit, PnPNet, RobustWeightedLM, pose_errors, success, success_rate
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.comparison import (
    EvaluationData,
    SeesTruth,
    draw_problems,
    evaluate,
    format_table,
    load_results,
    row_errors,
    save_results,
)
from kornia_pnpnet.types import PnPResult, Pose


@pytest.fixture(autouse=True)
def _same_code(monkeypatch):
    """The package may be edited while its tests run; what a digest of it does is tested below."""
    monkeypatch.setattr(kornia_pnpnet.evaluation.comparison, "source_digest", lambda: "the code")


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
    described = results["solvers"]["lm"]
    assert (described["class"], described["config"]) == ("PnPNet", solver.config())
    assert results["solvers"]["fixed"] == {"class": "_Fixed", "config": None, "weights": None}
    assert results["data"]["clean"]["description"] == {"seed": 5}
    spoilt = results["data"]["spoilt"]
    assert (spoilt["count"], spoilt["n"], spoilt["mean_outliers"], spoilt["dtype"]) == (60, 9, 2.0, "float32")
    assert (spoilt["max_translation"], spoilt["unit"]) == (0.5, "")
    assert all(row["us_per_problem"] > 0 for row in results["rows"])


def test_environment_says_what_ran():
    env = environment()
    assert env["versions"]["torch"] == torch.__version__
    assert set(env["versions"]) >= {"kornia_pnpnet", "torch", "kornia", "numpy", "opencv"}
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


# -- resuming --------------------------------------------------------------------------------------------------------


class _Stops(_Fixed):
    """Is interrupted in its n-th call."""

    def __init__(self, after: int | None = None) -> None:
        super().__init__()
        self.after = after

    def forward(self, *inputs):
        if self.after is not None and len(self.sizes) >= self.after:
            raise KeyboardInterrupt
        return super().forward(*inputs)


def without_times(results):
    """What does not depend on when and how fast it was computed."""
    rows = [{key: value for key, value in row.items() if key != "us_per_problem"} for row in results["rows"]]
    return json.loads(json.dumps({**results, "rows": rows, "environment": None}))


@pytest.mark.parametrize("calls", [0, 1, 4, 6])
def test_interrupted_and_continued_is_uninterrupted(sets, tmp_path, calls):
    """The second solver has four calls on each of the two sets."""
    path = tmp_path / "results.json"
    whole = evaluate({"first": _Fixed(), "second": _Stops()}, sets, repeats=3)
    with pytest.raises(KeyboardInterrupt):
        evaluate({"first": _Fixed(), "second": _Stops(calls)}, sets, path=path)
    kept = load_results(path)["rows"]
    finished = [("clean", "first"), ("clean", "second"), ("spoilt", "first")][: 1 if calls < 4 else 3]
    assert [(row["data"], row["solver"]) for row in kept] == finished

    solvers = {"first": _Fixed(), "second": _Stops()}
    continued = evaluate(solvers, sets, path=path)
    assert continued["rows"][: len(kept)] == kept, "a finished row was measured again"
    assert without_times(continued) == without_times(whole)
    assert load_results(path) == continued
    assert len(solvers["first"].sizes) == (4 if calls < 4 else 0)

    solvers = {"first": _Fixed(), "second": _Stops(0)}
    assert evaluate(solvers, sets, path=path) == continued, "a finished evaluation is only read"


def test_a_killed_process_leaves_its_finished_rows(sets, tmp_path):
    path = tmp_path / "results.json"
    script = """
import os, signal, sys, torch
torch.set_num_threads(1)
import kornia_pnpnet.evaluation.comparison
from kornia_pnpnet import PnPNet, RobustWeightedLM
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.evaluation.comparison import EvaluationData, draw_problems, evaluate

class Killed(PnPNet):
    def forward(self, *inputs):
        if armed:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().forward(*inputs)

kornia_pnpnet.evaluation.comparison.source_digest = lambda: "the code"
armed = "armed" in sys.argv
data = {"clean": EvaluationData(draw_problems(SyntheticProblems(batch_size=100, seed=5), 100))}
make = lambda kind: kind(None, RobustWeightedLM(m=3, learnable=False))
evaluate({"lm": make(PnPNet), "killed": make(Killed)}, data, path=sys.argv[1])
"""
    command = [sys.executable, "-c", script, str(path)]
    killed = subprocess.run([*command, "armed"], check=False, timeout=60, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert killed.returncode == -9
    (row,) = load_results(path)["rows"]
    assert row["solver"] == "lm"
    assert [entry.name for entry in tmp_path.iterdir()] == ["results.json"]
    subprocess.run(command, check=True, timeout=60, env={**os.environ, "OMP_NUM_THREADS": "1"})
    first, second = load_results(path)["rows"]
    assert first == row
    assert second["per_problem"] == row["per_problem"]


def test_solvers_and_sets_may_be_added(sets, solver, tmp_path):
    path = tmp_path / "results.json"
    evaluate({"fixed": _Fixed()}, {"spoilt": sets["spoilt"]}, path=path)
    before = {**load_results(path), "note": "not ours"}
    save_results(before, path)
    counted = _Fixed()
    grown = evaluate({"lm": solver, "fixed": counted}, sets, path=path)
    assert [(row["data"], row["solver"]) for row in grown["rows"]] == [(d, s) for d in sets for s in ("lm", "fixed")]
    assert grown["rows"][3] == before["rows"][0]
    assert counted.sizes == 4 * [100]
    assert list(grown["data"]) == list(sets)
    assert grown["note"] == "not ours"


def lm(m=3, seed=0):
    torch.manual_seed(seed)
    return PnPNet(MLPInit(n=9), RobustWeightedLM(m=m))


def other_code(monkeypatch):
    monkeypatch.setattr(kornia_pnpnet.evaluation.comparison, "source_digest", lambda: "other")


def other_version(monkeypatch):
    env = environment()
    env["versions"] = {**env["versions"], "torch": "0.1"}
    monkeypatch.setattr(kornia_pnpnet.evaluation.comparison, "environment", lambda: env)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda solvers, data, _: solvers.update(lm=lm(m=4)), "solvers: 'lm' has another config, another weights"),
        (lambda solvers, data, _: solvers.update(lm=lm(seed=1)), "solvers: 'lm' has another weights"),
        (lambda solvers, data, _: solvers.pop("fixed"), "solvers: 'fixed' is not asked for"),
        (lambda solvers, data, _: data.pop("clean"), "data: 'clean' is not asked for"),
        (
            lambda solvers, data, _: data.update(clean=data["clean"]._replace(max_translation=0.1)),
            "data: 'clean' has another max_translation",
        ),
        (
            lambda solvers, data, _: data.update(
                clean=data["clean"]._replace(problems=data["clean"].problems.map(lambda x: x.flip(0)))
            ),
            "data: 'clean' has another digest",
        ),
        (
            lambda solvers, data, _: data.update(
                clean=data["clean"]._replace(
                    problems=data["clean"].problems.map(lambda x: x.double() if x.is_floating_point() else x)
                )
            ),
            "data: 'clean' has another dtype",
        ),
        (lambda solvers, data, monkeypatch: other_code(monkeypatch), "the package's code has changed since"),
        (lambda solvers, data, monkeypatch: other_version(monkeypatch), "torch was .* and is 0.1"),
    ],
)
def test_rows_of_another_evaluation_are_refused(sets, tmp_path, monkeypatch, change, expected):
    path = tmp_path / "results.json"
    solvers, data = {"lm": lm(), "fixed": _Fixed()}, dict(sets)
    evaluate(solvers, data, path=path)
    before = path.read_bytes()
    change(solvers, data, monkeypatch)
    with pytest.raises(ValueError, match=rf"results\.json' holds another evaluation.*: {expected}( \(commit .*\))?\."):
        evaluate(solvers, data, path=path)
    assert path.read_bytes() == before
    anew = evaluate(solvers, data, path=path, overwrite=True)
    assert load_results(path) == anew
    assert without_times(anew) == without_times(evaluate(solvers, data))


def test_many_differences_are_counted(sets, tmp_path):
    path = tmp_path / "results.json"
    evaluate({name: _Fixed() for name in "abcde"}, {"clean": sets["clean"]}, path=path)
    with pytest.raises(ValueError, match=r"'c' is not asked for; and 2 more\. Take another file, or overwrite"):
        evaluate({"f": _Fixed()}, {"clean": sets["clean"]}, path=path)


def test_a_file_without_rows_is_no_evaluation_to_lose(sets, tmp_path):
    path = tmp_path / "results.json"
    with pytest.raises(KeyboardInterrupt):
        evaluate({"other": _Stops(0)}, sets, path=path)
    assert load_results(path)["rows"] == []
    assert len(evaluate({"fixed": _Fixed()}, sets, path=path)["rows"]) == 2


@pytest.mark.parametrize("keep", [0, 1, 200, -1, -2])
def test_a_damaged_file_is_refused_and_kept(results, sets, tmp_path, keep):
    path = tmp_path / "results.json"
    save_results(results, path)
    content = path.read_bytes()[:-1][:keep]  # the last byte is a line end
    path.write_bytes(content)
    counted = _Fixed()
    with pytest.raises(ValueError, match=r"results\.json' is not a results file"):
        evaluate({"fixed": counted}, sets, path=path)
    assert path.read_bytes() == content
    assert counted.sizes == []
    assert len(evaluate({"fixed": counted}, sets, path=path, overwrite=True)["rows"]) == 2


def test_a_place_that_cannot_be_written_is_found_before_the_work(sets, tmp_path):
    (tmp_path / "file").write_text("")
    counted = _Fixed()
    for path in (tmp_path, tmp_path / "file" / "results.json"):
        with pytest.raises(OSError, match=r"directory|exists"):
            evaluate({"fixed": counted}, sets, path=path)
    assert counted.sizes == []


def test_rows_made_on_another_machine_say_so(sets, tmp_path, monkeypatch):
    path = tmp_path / "results.json"
    with pytest.raises(KeyboardInterrupt):
        evaluate({"first": _Fixed(), "second": _Stops(0)}, {"clean": sets["clean"]}, path=path)
    env = {**environment(), "cpu": "an abacus", "threads": 100, "date": "tomorrow"}
    monkeypatch.setattr(kornia_pnpnet.evaluation.comparison, "environment", lambda: env)
    first, second = evaluate({"first": _Fixed(), "second": _Stops()}, {"clean": sets["clean"]}, path=path)["rows"]
    assert "environment" not in first
    assert second["environment"] == {"cpu": "an abacus", "threads": 100}


# -- what solvers are given ------------------------------------------------------------------------------------------


class _Oracle(_Fixed):
    def solve_with_truth(self, problems):
        assert not self.training
        assert not torch.is_grad_enabled()
        self.sizes.append(len(problems.world_points))
        result = super().forward(*problems[:3])
        return result._replace(rotation=problems.pose.rotation, translation=problems.pose.translation)


def test_only_who_sees_the_truth_is_given_it(sets):
    oracle, fixed = _Oracle(), _Fixed()
    assert isinstance(oracle, SeesTruth)
    assert not isinstance(fixed, SeesTruth)
    rows = evaluate({"oracle": oracle, "fixed": fixed}, {"clean": sets["clean"]}, chunk=50)["rows"]
    assert [row["success"]["rate"] for row in rows] == [1.0, 0.0]


def test_solvers_of_ours_are_told_the_noise(sets):
    data = EvaluationData(draw_problems(SyntheticProblems(batch_size=40, seed=3, known_noise=1.0), count=60))

    heard = []

    class Heard(PnPNet):
        def forward(self, *args, img_sigma=None, world_sigma=None):
            heard.append((img_sigma, world_sigma))
            return super().forward(*args, img_sigma=img_sigma, world_sigma=world_sigma)

    class Deaf(nn.Module):
        def forward(self, world_points, img_points, intrinsics):
            return PnPNet(None, RobustWeightedLM(1))(world_points, img_points, intrinsics)

    evaluate({"ours": Heard(None, RobustWeightedLM(1)), "other": Deaf()}, {"told": data}, chunk=60)
    assert all(torch.equal(a, data.problems.img_sigma) for a, _ in heard)
    assert all(torch.equal(b, data.problems.world_sigma) for _, b in heard)
    heard.clear()
    evaluate({"ours": Heard(None, RobustWeightedLM(1))}, sets)
    assert set(heard) == {(None, None)}


def test_a_solver_for_another_n_is_left_out(tmp_path):
    data = {str(n): EvaluationData(draw_problems(SyntheticProblems(n=n, batch_size=10), 10)) for n in (6, 9)}
    path = tmp_path / "results.json"
    for _ in range(2):  # the second time from the file
        results = evaluate({"nine": lm(), "any": _Fixed()}, data, path=path)
        assert [(row["data"], row["solver"]) for row in results["rows"]] == [("6", "any"), ("9", "nine"), ("9", "any")]
        (entry,) = results["left_out"]
        assert (entry["data"], entry["solver"]) == ("6", "nine")
        assert "n = 9" in entry["reason"]
        assert load_results(path) == results


def test_an_error_says_where_it_was_and_keeps_the_rows(sets, tmp_path):
    class Broken(_Fixed):
        def forward(self, *_):
            raise RuntimeError("no memory")

    path = tmp_path / "results.json"
    with pytest.raises(RuntimeError, match="no memory") as caught:
        evaluate({"fixed": _Fixed(), "broken": Broken()}, sets, path=path)
    assert caught.value.__notes__ == ["broken on clean"]
    assert len(load_results(path)["rows"]) == 1


def test_the_digest_is_of_the_problems(sets):
    def digest(problems):
        return evaluate({}, {"set": EvaluationData(problems)})["data"]["set"]["digest"]

    problems = sets["spoilt"].problems
    assert digest(problems) == digest(problems.map(torch.clone))
    assert digest(problems) == digest(problems.map(lambda x: x.double() if x.is_floating_point() else x))
    for field in (*problems[:3], *problems.pose, problems.inliers):

        def change(x, field=field):
            return x if x is not field else torch.cat((~x[:1] if x.dtype == torch.bool else x[:1] + 1.0, x[1:]))

        assert digest(problems.map(change)) != digest(problems)
