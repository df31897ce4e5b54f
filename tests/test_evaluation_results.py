"""Results files: written in one piece, checked when read, and the digest of the code."""

from __future__ import annotations

import math
import re
from functools import reduce
from operator import getitem

import pytest

import kornia_pnpnet.evaluation.results
from kornia_pnpnet.evaluation.results import load_results, save_results, source_digest


@pytest.fixture
def results():
    quartiles = {"q25": 0.1, "median": 0.2, "q75": 0.3}
    row = {
        "data": "a",
        "solver": "s",
        "success": {"rate": 1.0, "low": 0.5, "high": 1.0, "total": 2},
        "rotation_error_deg": quartiles,
        "translation_error": quartiles,
        "ok": 1.0,
        "us_per_problem": 12.5,
        "per_problem": {"rotation_error_deg": [0.1, 2.5e-7], "translation_error": [0.0, 1e-3], "ok": [1, 1]},
    }
    data = {"count": 2, "n": 9, "max_rotation_deg": 1.0, "max_translation": 0.2, "unit": "m"}
    return {"format": 1, "environment": {"commit": None}, "solvers": {"s": {}}, "data": {"a": data}, "rows": [row]}


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


@pytest.mark.parametrize("content", ["", "[]", '{"format": 99}', '{"format": 1, "rows": []}', "\x00"])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "other.json"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"other\.json"):
        load_results(path)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("rows.0.success.rate", 1.5),
        ("rows.0.solver", "t"),
        ("rows.0.per_problem.ok", 1),
        ("rows.0.per_problem", {"rotation_error_deg": [], "translation_error": [0.0], "ok": [1]}),
        ("data.a.n", None),
        ("data", []),
    ],
)
def test_the_wrong_entry_of_a_file_is_named(results, place, value, tmp_path):
    path = tmp_path / "results.json"
    *inner, last = (int(x) if x.isdecimal() else x for x in place.split("."))
    reduce(getitem, inner, results)[last] = value
    save_results(results, path)
    with pytest.raises(ValueError, match=r"results\.json.*: " + re.escape(place.replace(".0", "[0]"))):
        load_results(path)


def test_the_digest_of_the_code_covers_python_files_and_their_places(tmp_path, monkeypatch):
    monkeypatch.setattr(kornia_pnpnet.evaluation.results, "__file__", str(tmp_path / "results.py"))
    (tmp_path / "data").mkdir()
    (tmp_path / "results.py").write_text("a = 1\n")
    (tmp_path / "data" / "other.py").write_text("b = 2\n")
    before = source_digest()
    (tmp_path / "notes.txt").write_text("not code")
    assert source_digest() == before
    (tmp_path / "data" / "other.py").write_text("b = 3\n")
    changed = source_digest()
    assert changed != before
    (tmp_path / "data" / "other.py").rename(tmp_path / "other.py")
    assert source_digest() not in {before, changed}
