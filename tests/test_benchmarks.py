"""The benchmark measures what it says and computes its verdicts; nothing here depends on how fast anything is."""

from __future__ import annotations

import importlib.util
import json
import statistics
import sys
from pathlib import Path

import pytest
import torch

from kornia_pnpnet import create_solver

PATH = Path(__file__).resolve().parent.parent / "benchmarks" / "solvers.py"
SOLVERS = ("epnp", "p3p-ransac:max_samples=50", "opencv-epnp", "poselib")


def load():
    spec = importlib.util.spec_from_file_location("benchmark_of_solvers", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


benchmark = load()


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The file of a small run."""
    for module in ("cv2", "poselib"):
        pytest.importorskip(module)
    path = tmp_path_factory.mktemp("benchmark") / "solvers.json"
    sizes = ("--count", "20", "--repeats", "3", "--memory-count", "20")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(benchmark, "MEMORY_RUNS", 2)
        benchmark.main(["--out", str(path), *sizes, "--solvers", *SOLVERS])
    return json.loads(path.read_text())


def row(solver, rounds, name="n = 9, 3 outliers"):
    success = {"rate": 0.5, "low": 0.2, "high": 0.8, "total": 4}
    times = {"median_us": statistics.median(rounds), "min_us": min(rounds), "rounds_us": rounds}
    return {"solver": solver, "set": name, "success": success, **times}


def test_the_page_is_generated_from_its_file():
    results = json.loads(PATH.with_suffix(".json").read_text())
    assert benchmark.page(results) == PATH.with_suffix(".md").read_text()


def test_the_file_says_what_was_measured_with_what(written):
    assert written["environment"]["threads"] == 1
    assert written["environment"]["versions"]["torch"]
    assert written["settings"]["solvers"] == list(SOLVERS)
    assert written["settings"]["count"] == 20
    assert written["skipped"] == {}
    assert len(written["load_average"]) == 2


def test_every_solver_has_a_row_for_every_set_it_is_shown(written):
    rows = {(row["solver"], row["set"]): row for row in written["rows"]}
    small, large = (
        {name for name, (n, _) in benchmark.SETS.items() if n == size} for size in (benchmark.SMALL, benchmark.LARGE)
    )
    expected = {(spec, name) for spec in SOLVERS for name in small}
    expected |= {(spec, name) for spec in SOLVERS if "epnp" not in spec for name in large}
    assert rows.keys() == expected
    assert len(rows) == len(written["rows"])
    for entry in rows.values():
        assert len(entry["rounds_us"]) == 3
        assert entry["min_us"] == min(entry["rounds_us"]) > 0
        assert entry["median_us"] == statistics.median(entry["rounds_us"])
        assert entry["success"]["total"] == 20
    assert rows["poselib", "n = 100, 50 outliers"]["success"]["rate"] > 0.8
    assert rows["opencv-epnp", "n = 9, 3 outliers"]["success"]["rate"] < 0.2


def test_targets_are_compared_where_both_sides_ran(written):
    pairs = {(entry["solver"], entry["peer"], entry["set"]) for entry in written["speedups"]}
    small = [name for name, (n, _) in benchmark.SETS.items() if n == benchmark.SMALL]
    expected = {("epnp", "opencv-epnp", name) for name in small} | {(SOLVERS[1], "poselib", name) for name in small}
    assert pairs == expected
    assert all(entry["met"] == (entry["ratio"] >= entry["target"]) for entry in written["speedups"])


def test_memory_is_that_of_a_process_of_its_own(written):
    (memory,) = written["memory"]
    assert memory["solver"] == SOLVERS[1]
    assert memory["count"] == 20
    assert len(memory["runs"]) == 2
    assert all(run["peak_bytes"] > run["imports_bytes"] > 2**26 for run in memory["runs"])  # PyTorch alone is more
    assert memory["peak_bytes"] == max(run["peak_bytes"] for run in memory["runs"])
    assert memory["rise_bytes"] == max(run["peak_bytes"] - run["imports_bytes"] for run in memory["runs"])
    assert memory["met"] == (memory["peak_bytes"] < memory["target_bytes"])


def test_memory_without_room_misses_the_target(monkeypatch):
    monkeypatch.setattr(benchmark, "MEMORY_TARGET", 2**20)
    monkeypatch.setattr(benchmark.subprocess, "run", lambda *_, **__: _Output())
    assert not benchmark.measure_memory("p3p-ransac", 5, 0)["met"]


class _Output:
    returncode = 0
    stdout = json.dumps({"imports_bytes": 2**20, "peak_bytes": 2**21})


def test_a_failing_memory_run_is_an_error():
    with pytest.raises(RuntimeError, match="nonsense"):
        benchmark.measure_memory("nonsense", 5, 0)


def test_the_ratio_is_the_median_over_rounds_of_the_peers_time_by_ours():
    rows = [row("epnp:x=1", [10.0, 10.0, 20.0]), row("opencv-epnp", [30.0, 90.0, 20.0])]
    (entry,) = benchmark.speedups([*rows, row("poselib", [1.0, 1.0, 1.0])])
    assert entry["ratio"] == 3.0
    assert entry["met"]
    rows[0]["rounds_us"] = [10.1, 10.0, 20.0]
    (entry,) = benchmark.speedups(rows)
    assert not entry["met"]
    assert benchmark.speedups([row("epnp", [1.0]), row("opencv-epnp", [9.0], "n = 9, no outliers")]) == []


def test_tables_show_every_number_and_verdict(written):
    table = benchmark.format_tables(written)
    for entry in written["rows"]:
        assert (
            f"{entry['median_us']:.1f} µs (min {entry['min_us']:.1f}), {100 * entry['success']['rate']:.1f} %" in table
        )
    verdicts = [entry["met"] for entry in (*written["speedups"], *written["memory"])]
    assert table.count("target met") == sum(verdicts)
    assert table.count("target missed") == len(verdicts) - sum(verdicts)
    assert table.count("–") == 2 * 2  # two solvers are not shown two sets


def test_peers_are_timed_without_our_adapter(make_problems):
    pytest.importorskip("cv2")
    solver, seen = create_solver("opencv-epnp"), []
    solver.solve_one = lambda *arrays: seen.append([array.shape for array in arrays])
    call = benchmark.call_of(solver, make_problems(n=9, batch=4))
    assert seen == []
    call()
    assert seen == 4 * [[(9, 3), (9, 2), (3, 3)]]


def test_missing_packages_are_skipped_with_a_reason(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "poselib", None)
    results = benchmark.measure(["epnp", "poselib"], count=2, repeats=1, memory_count=0, seed=0)
    assert list(results["skipped"]) == ["poselib"]
    assert "skipped: poselib: This solver needs PoseLib" in capsys.readouterr().err
    assert {entry["solver"] for entry in results["rows"]} == {"epnp"}
    assert results["speedups"] == results["memory"] == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--solvers", "nonsense"], "No solver 'nonsense'"),
        (["--solvers", "epnp:nonsense=1"], "does not take these options"),
        (["--count", "0"], "at least 1"),
        (["--repeats", "0"], "at least 1"),
    ],
)
def test_wrong_arguments_say_which(arguments, message, capsys):
    with pytest.raises(SystemExit):
        benchmark.main(arguments)
    assert message in capsys.readouterr().err


def test_one_thread_and_as_it_was_afterwards():
    cv2 = pytest.importorskip("cv2")
    before = cv2.getNumThreads()
    torch.set_num_threads(2)
    cv2.setNumThreads(2)
    inside = []

    def interrupted():
        with benchmark.one_thread():
            inside.append((torch.get_num_threads(), cv2.getNumThreads()))
            raise KeyError

    try:
        with pytest.raises(KeyError):
            interrupted()
        assert inside == [(1, 1)]
        assert (torch.get_num_threads(), cv2.getNumThreads()) == (2, 2)
    finally:
        torch.set_num_threads(1)
        cv2.setNumThreads(before)


def test_sets_differ_and_the_same_seed_gives_the_same_problems():
    first, again = (benchmark.draw("n = 9, no outliers", 3, 5) for _ in range(2))
    assert torch.equal(first.world_points, again.world_points)
    assert first.world_points.dtype == torch.float64
    assert first.inliers.all()
    other = benchmark.draw("n = 9, 3 outliers", 3, 5)
    assert not torch.equal(first.world_points, other.world_points)
    assert (~other.inliers).sum(-1).tolist() == [3, 3, 3]
