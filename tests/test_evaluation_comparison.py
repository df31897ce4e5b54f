"""Comparing solvers: rows and their summaries, results files, continuing an evaluation, inputs of solvers."""

import json
import math
import re
from functools import reduce
from operator import getitem

import pytest
import torch
from torch import nn

from kornia_pnpnet import MLPInit, PnPNet, RobustWeightedLM, create_solver, pose_errors, success, success_rate
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.trees import iter_tensors, map_tensors
from kornia_pnpnet.data import CameraProblems, OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.bounds import KnownInliers
from kornia_pnpnet.evaluation.comparison import EvaluationData, draw_problems, evaluate
from kornia_pnpnet.evaluation.results import format_table, load_results, row_errors, save_results, source_digest
from kornia_pnpnet.result import PnPResult, Pose

CLEAN = {"clean": EvaluationData(SyntheticProblems(batch_size=100, seed=5).batch(0), description={"seed": 5})}
SPOILT = SyntheticProblems(batch_size=100, seed=5, outliers=OutlierMix(count=2))
SETS = {**CLEAN, "spoilt": EvaluationData(draw_problems(SPOILT, 60), max_translation=0.5, unit="")}
SOLVER = PnPNet(None, RobustWeightedLM(m=10, learnable=False))
#: Entries of a results file that make no sense.
WRONG = [*(("rows.0.success.rate", x) for x in (1.5, math.nan)), *(("rows.0.success.total", x) for x in (0.5, 2**63))]
WRONG += [*(("rows.0.us_per_problem", x) for x in ("1", 10**400)), ("rows.0.solver", "t"), ("data", [])]
WRONG += [("rows.0.per_problem", {"rotation_error_deg": [], "translation_error": [0.0], "ok": [1]})]
WRONG += [("rows.0.per_problem.ok", 1), ("data.clean.n", None)]


@pytest.fixture(autouse=True)
def _same_code(monkeypatch):
    """Keep the digest of the code fixed: the package may be edited while its tests run."""
    monkeypatch.setattr("kornia_pnpnet.evaluation.comparison.source_digest", lambda: "the code")


class _Fixed(nn.Module):
    """Return the identity and remember the sizes of the calls; raise an error after some calls."""

    def __init__(self, *, bad: float = 0.0, calls: float = math.inf, error: BaseException | None = None) -> None:
        super().__init__()
        self.bad, self.calls, self.error, self.sizes = bad, calls, error or KeyboardInterrupt(), []

    def forward(self, world_points, img_points, intrinsics):
        if len(self.sizes) >= self.calls:
            raise self.error
        assert not self.training
        assert not torch.is_grad_enabled()
        batch = len(world_points)
        self.sizes.append(batch)
        pose = Pose(torch.eye(3).expand(batch, 3, 3).to(world_points), world_points.new_zeros(batch, 3))
        pose.translation[0] = self.bad
        weights, cost = world_points.new_ones(world_points.shape[:2]), world_points.new_zeros(batch)
        return PnPResult(*pose, weights, cost, weights[:, 0] > 0, pose)


def as_double(tree):
    return map_tensors(lambda part: part.double() if part.is_floating_point() else part, tree)


def lm(m=3, seed=0):
    torch.manual_seed(seed)
    return PnPNet(MLPInit(n=9), RobustWeightedLM(m=m))


def names(results):
    return [(row["data"], row["solver"]) for row in results["rows"]]


@pytest.fixture(scope="module")
def evaluated():
    return evaluate({"lm": SOLVER, "fixed": _Fixed()}, SETS)


def test_rows_hold_the_errors_of_the_solver(evaluated):
    assert names(evaluated) == [(data, name) for data in SETS for name in ("lm", "fixed")]
    row, problems = evaluated["rows"][2], SETS["spoilt"].problems
    result = SOLVER(*problems[:3])
    errors, ok = row_errors(row)
    expected = pose_errors(as_double(result.pose), as_double(problems.pose))
    torch.testing.assert_close(tuple(errors), tuple(expected), rtol=1e-5, atol=1e-9)
    assert torch.equal(ok, result.ok)
    assert row["ok"] == pytest.approx(result.ok.double().mean().item(), rel=1e-5)
    assert all(row["us_per_problem"] > 0 for row in evaluated["rows"])


def test_summaries_and_table_are_those_of_the_stored_errors(evaluated):
    lines = format_table(evaluated).splitlines()
    for line, row in zip(lines[2:], evaluated["rows"], strict=True):
        entry = evaluated["data"][row["data"]]
        errors, _ = row_errors(row)
        rate = success_rate(success(errors, entry["max_rotation_deg"], entry["max_translation"]))
        assert row["success"] == pytest.approx(rate._asdict(), rel=1e-5)
        for name, values in errors._asdict().items():
            quartiles = values.quantile(torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)).tolist()
            assert [row[name][key] for key in ("q25", "median", "q75")] == pytest.approx(quartiles, rel=1e-5)
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert cells[:3] == [row["data"], row["solver"], str(rate)]
        assert float(cells[3].rstrip("°")) == pytest.approx(errors.rotation_error_deg.quantile(0.5).item(), rel=6e-3)
        assert cells[4].endswith(" m") == (entry["unit"] == "m")


def test_big_sets_are_solved_in_chunks_with_one_untimed_call():
    solver = _Fixed().train()
    results = evaluate({"fixed": solver}, CLEAN, chunk=40, repeats=4)
    assert solver.sizes == [40, 40, 40, 20, 40]
    assert solver.training  # as before; `_Fixed` checks the mode during its calls
    assert results["rows"][0]["per_problem"] == evaluate({"fixed": solver}, CLEAN)["rows"][0]["per_problem"]


def test_a_pose_that_is_not_finite_is_a_failure():
    solvers = {"nan": _Fixed(bad=math.nan), "inf": _Fixed(bad=math.inf), "fixed": _Fixed()}
    *broken, whole = (row["per_problem"] for row in evaluate(solvers, CLEAN)["rows"])
    for row in broken:
        assert row["ok"] == [0] + 99 * [1]
        assert row["translation_error"] == whole["translation_error"]
    here = Pose(torch.eye(3).expand(100, 3, 3), torch.zeros(100, 3))  # where solvers are that find no pose
    noise = CLEAN["clean"].problems._replace(img_points=3000.0 * torch.rand(100, 9, 2), pose=here)
    (row,) = evaluate({"epnp-lm": create_solver("epnp-lm")}, {"noise": EvaluationData(noise)})["rows"]
    assert row["success"]["rate"] == row["ok"] == 0.0


def test_fewer_problems_are_the_first_of_more():
    source = SyntheticProblems(batch_size=8, seed=2, known_noise=1.0)
    few, many = draw_problems(source, 5), draw_problems(source, 20)
    assert {len(part) for part in iter_tensors(many)} == {20}
    assert all(map(torch.equal, iter_tensors(few), iter_tensors(many.map(lambda part: part[:5]))))
    assert all(map(torch.equal, iter_tensors(many.map(lambda part: part[8:16])), iter_tensors(source.batch(1))))
    with pytest.raises(ValueError, match="at least 1"):
        draw_problems(source, 0)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "new" / "results.json"


@pytest.mark.parametrize("content", ["", "{", "[" * 9999, "[]", '{"format": 99}', '{"format": 1, "rows": []}', "\x00"])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "other.json"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"other\.json"):
        load_results(path)


@pytest.mark.parametrize(("place", "value"), WRONG)
def test_the_wrong_entry_of_a_file_is_named(evaluated, place, value, path):
    save_results(evaluated, path)
    results = load_results(path)
    *inner, last = (int(x) if x.isdecimal() else x for x in place.split("."))
    reduce(getitem, inner, results)[last] = value
    path.write_text(json.dumps(results))
    with pytest.raises(ValueError, match=r"results\.json.*: " + re.escape(place.replace(".0", "[0]"))):
        load_results(path)


def test_the_digest_of_the_code_covers_python_files_and_their_places(tmp_path, monkeypatch):
    monkeypatch.setattr("kornia_pnpnet.evaluation.results.__file__", str(tmp_path / "evaluation" / "results.py"))
    digests = []
    for name, content in (("a.py", "b = 2"), ("a.py", "b = 3"), ("c.py", ""), ("notes.txt", "")):
        (tmp_path / name).write_text(content)
        digests.append(source_digest())
    assert len({*digests}) == 3
    assert digests[2] == digests[3]


def without_times(results):
    rows = [{key: value for key, value in row.items() if key != "us_per_problem"} for row in results["rows"]]
    return {**results, "rows": rows, "environment": None}


@pytest.mark.parametrize(("calls", "finished"), [(1, 1), (6, 3)])
def test_interrupted_and_continued_equals_uninterrupted(path, calls, finished):
    whole = evaluate({"first": _Fixed(), "second": _Fixed()}, SETS, repeats=3)
    with pytest.raises(KeyboardInterrupt):
        evaluate({"first": _Fixed(), "second": _Fixed(calls=calls)}, SETS, path=path)
    kept = load_results(path)["rows"]
    assert len(kept) == finished
    solvers = {"first": _Fixed(), "second": _Fixed()}
    continued = evaluate(solvers, SETS, path=path)
    assert continued["rows"][:finished] == kept  # no finished row is measured again
    assert without_times(continued) == without_times(whole)
    assert load_results(path) == continued
    assert len(solvers["first"].sizes) == (4 if calls < 4 else 0)
    assert evaluate({"first": _Fixed(), "second": _Fixed(calls=0)}, SETS, path=path) == continued


def test_solvers_and_sets_may_be_added(path):
    evaluate({"fixed": _Fixed()}, {"spoilt": SETS["spoilt"]}, path=path)
    before = {**load_results(path), "note": "not ours"}
    save_results(before, path)
    counted = _Fixed()
    grown = evaluate({"lm": SOLVER, "fixed": counted}, SETS, path=path)
    assert names(grown) == [(data, name) for data in SETS for name in ("lm", "fixed")]
    assert grown["rows"][3] == before["rows"][0]
    assert counted.sizes == 4 * [100]
    assert list(grown["data"]) == list(SETS)
    assert grown["note"] == "not ours"


def other(function=lambda part: part, **changes):
    changed = CLEAN["clean"]._replace(problems=map_tensors(function, CLEAN["clean"].problems), **changes)
    return lambda _, data, __: data.update(clean=changed)


def other_versions(solvers, data, patch):
    env = environment()
    env["versions"]["torch"] = "0.1"
    patch.setattr("kornia_pnpnet.evaluation.comparison.environment", lambda: env)
    patch.setattr("kornia_pnpnet.evaluation.comparison.source_digest", lambda: "other")


CHANGES = [(lambda solvers, *_: solvers.update(lm=lm(m=4)), r"lm\.config\.refine\.m was 3 and is 4")]
CHANGES += [(lambda solvers, *_: solvers.update(lm=lm(seed=1)), r"lm\.weights was")]
CHANGES += [(lambda x, *_: x.pop("fixed"), r"solvers\.fixed\."), (lambda _, x, __: x.pop("clean"), r"data\.clean\.")]
CHANGES += [(other(max_translation=0.1), r"clean\.max_translation was 0.2 and is 0.1")]
CHANGES += [(other(lambda part: part.flip(0)), r"clean\.digest was"), (other(as_double), r"clean\.dtype was")]
CHANGES += [(other_versions, r"torch was .* and is '0\.1'; code was")]


@pytest.mark.parametrize(("change", "named"), CHANGES)
def test_rows_of_another_evaluation_are_refused(path, monkeypatch, change, named):
    solvers, data = {"lm": lm(), "fixed": _Fixed()}, dict(SETS)
    evaluate(solvers, data, path=path)
    before = path.read_bytes()
    change(solvers, data, monkeypatch)
    with pytest.raises(ValueError, match=rf"results\.json.*{named}"):
        evaluate(solvers, data, path=path)
    assert path.read_bytes() == before
    anew = evaluate(solvers, data, path=path, overwrite=True)
    assert load_results(path) == anew
    assert without_times(anew) == without_times(evaluate(solvers, data))


def test_rows_of_another_machine_name_it(path, monkeypatch):
    with pytest.raises(KeyboardInterrupt):
        evaluate({"first": _Fixed(), "second": _Fixed(calls=0)}, CLEAN, path=path)
    env = {**environment(), "cpu": "an abacus", "threads": 100, "date": "tomorrow"}
    monkeypatch.setattr("kornia_pnpnet.evaluation.comparison.environment", lambda: env)
    first, second = evaluate({"first": _Fixed(), "second": _Fixed()}, CLEAN, path=path)["rows"]
    assert "environment" not in first
    assert second["environment"] == {"cpu": "an abacus", "threads": 100}


def test_a_path_that_cannot_be_written_is_an_error_before_the_work(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path, tmp_path / "file" / "results.json"):
        with pytest.raises(OSError, match=r"directory|exists"):
            evaluate({"fixed": _Fixed(calls=0)}, SETS, path=path)


def test_only_bounds_get_the_truth():
    rows = evaluate({"bound": KnownInliers(), "fixed": _Fixed()}, CLEAN, chunk=50)["rows"]
    assert rows[0]["success"]["rate"] > 0.7
    assert rows[1]["success"]["rate"] == 0.0


def test_only_our_solvers_get_the_noise_level():
    known = EvaluationData(draw_problems(SyntheticProblems(batch_size=40, seed=3, known_noise=1.0), count=60))
    given, ours = [], PnPNet(None, RobustWeightedLM(1))
    ours.register_forward_pre_hook(lambda _, args, noise: given.append(noise), with_kwargs=True)
    for data in (known, CLEAN["clean"]):
        evaluate({"ours": ours, "other": _Fixed()}, {"data": data}, chunk=60)
        for noise in given:
            assert noise.keys() == data.problems.sigmas.keys()
            assert all(torch.equal(noise[name], sigma) for name, sigma in data.problems.sigmas.items())
        assert given
        given.clear()


def test_a_solver_for_another_n_or_that_takes_no_rigs_is_left_out(path):
    data = {str(n): EvaluationData(draw_problems(SyntheticProblems(n=n, batch_size=10), 10)) for n in (6, 9)}
    for _ in range(2):  # the second time from the file
        results = evaluate({"nine": lm(), "any": _Fixed()}, data, path=path)
        assert names(results) == [("6", "any"), ("9", "nine"), ("9", "any")]
        (entry,) = results["left_out"]
        assert (entry["data"], entry["solver"]) == ("6", "nine")
        assert "n = 9" in entry["reason"]
        assert load_results(path) == results
    rigs = {"rigs": EvaluationData(CameraProblems(n=12, batch_size=10, cameras=3).batch(0))}
    results = evaluate({"start": create_solver("identity-lm"), "any": create_solver("epnp-lm")}, rigs)
    assert (names(results), results["left_out"][0]["solver"]) == ([("rigs", "any")], "start")


def test_an_error_says_where_it_was_and_keeps_the_rows(path):
    broken = _Fixed(calls=0, error=RuntimeError("no memory"))
    with pytest.raises(RuntimeError, match="no memory") as caught:
        evaluate({"fixed": _Fixed(), "broken": broken}, SETS, path=path)
    assert caught.value.__notes__ == ["broken on clean"]
    assert len(load_results(path)["rows"]) == 1


def test_the_digest_covers_every_field_of_the_problems():
    def digest(problems):
        return evaluate({}, {"set": EvaluationData(problems)})["data"]["set"]["digest"]

    problems = SyntheticProblems(batch_size=4, known_noise=1.0).batch(0)
    assert digest(problems) == digest(problems.map(torch.clone)) == digest(as_double(problems))
    for field in iter_tensors(problems):
        new = torch.cat((~field[:1] if field.dtype == torch.bool else field[:1] + 1.0, field[1:]))
        changed = problems.map(lambda part, field=field, new=new: new if part is field else part)
        assert digest(changed) != digest(problems)
