"""The benchmarks measure what they say and compute their verdicts; nothing here depends on how fast anything is."""

from __future__ import annotations

import gc
import importlib
import json
import math
import shutil
import statistics
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch
from torch import nn

from kornia_pnpnet import create_solver, pose_errors
from kornia_pnpnet.evaluation.operations import operation_count

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"
PATH = FOLDER / "solvers.py"
SOLVERS = ("epnp", "p3p-ransac:max_samples=50", "opencv-epnp", "poselib")

sys.path.insert(0, str(FOLDER))  # they are scripts and import each other
NAMES = (
    "contenders",
    "engine",
    "harness",
    "latency",
    "others",
    "page",
    "performance",
    "process",
    "settings",
    "startup",
)
modules = {name: importlib.import_module(name) for name in (*NAMES, "tables", "tasks", "throughput", "versions")}
benchmark = importlib.import_module("solvers")


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
    monkeypatch.setattr(benchmark, "run_child", lambda *_: {"imports_bytes": 2**20, "peak_bytes": 2**21})
    assert not benchmark.measure_memory("p3p-ransac", 5, 0)["met"]


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
    call = modules["others"].bare_call(solver, make_problems(n=9, batch=4))
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


def test_so_many_threads_and_as_they_were_afterwards():
    cv2 = pytest.importorskip("cv2")
    before = cv2.getNumThreads()
    torch.set_num_threads(2)
    cv2.setNumThreads(2)
    inside = []

    def interrupted():
        with modules["harness"].threads():
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


# -- what the benchmarks share -----------------------------------------------------------------------------------------


def test_timers_take_turns_and_no_garbage_is_collected_meanwhile():
    order = []

    def timer(name):
        return lambda: order.append((name, gc.isenabled())) or float(len(order))

    found = modules["harness"].in_turns({"a": timer("a"), "b": timer("b")}, 2)
    assert order == [("a", False), ("b", False), ("a", False), ("b", False)]
    assert found == {"a": [1.0, 3.0], "b": [2.0, 4.0]}
    assert gc.isenabled()


def test_quantiles_are_values_that_were_measured():
    values = [float(x) for x in range(1, 101)]
    found = modules["harness"].quantiles(values[::-1], 200)
    assert (found[0], found[100], found[198], found[-1]) == (1.0, 50.0, 99.0, 100.0)
    assert len(found) == 201
    assert set(modules["harness"].quantiles([3.0], 4)) == {3.0}


@pytest.mark.parametrize(("measured", "at_most", "met"), [(2.0, True, True), (2.1, True, False), (2.1, False, True)])
def test_a_target_is_met_at_its_limit(measured, at_most, met):
    assert modules["harness"].target("x", measured, 2.0, unit="s", at_most=at_most)["met"] == met


# -- what is timed -----------------------------------------------------------------------------------------------------


def test_the_coarse_pose_is_as_far_off_as_it_says(make_problems):
    tasks, problems = modules["tasks"], make_problems(n=9, batch=50)
    coarse = tasks.coarse_pose(problems)
    errors = pose_errors(coarse, problems.pose)
    expected = torch.full((50,), tasks.COARSE_ANGLE_DEG, dtype=torch.float64)
    torch.testing.assert_close(errors.rotation_error_deg, expected, atol=1e-4, rtol=0)
    centre = problems.world_points.mean(1)[..., None]
    true, moved = (rotation @ centre + translation[..., None] for rotation, translation in (problems.pose, coarse))
    share = ((moved - true).norm(dim=1) / true.norm(dim=1))[:, 0]
    torch.testing.assert_close(share, torch.full_like(share, tasks.COARSE_SHIFT))


# Exporting takes minutes.
EAGER = [
    pytest.param(name, marks=pytest.mark.slow) if "ONNX" in name else name
    for name in modules["contenders"].CONTENDERS
    if "compiled" not in name
]


@pytest.mark.parametrize("name", EAGER)
def test_contenders_solve_and_differentiate(name, make_problems):
    """Without noise and outliers everything finds the pose, and where there are gradients they are finite."""
    try:
        contender = modules["contenders"].CONTENDERS[name]()
    except ImportError as error:
        pytest.skip(str(error))
    task = contender.task(make_problems(n=9, batch=5, noise=False))
    assert task.success().total == 5
    assert task.success().rate == 1.0
    assert task.seconds(2) > 0
    if contender.differentiable:
        problems = make_problems(n=9, batch=3)
        points, pixels, *learned = contender.task(problems, backward=True).call()
        assert points.shape == problems.world_points.shape
        assert pixels.shape == problems.img_points.shape
        assert all(gradient.isfinite().all() for gradient in (points, pixels, *learned) if gradient is not None)
        assert (points.abs().sum((1, 2)) > 0).any()
        assert (pixels.abs().sum((1, 2)) > 0).any()


def test_one_differentiable_step_at_the_minimum_has_the_gradient_of_all_steps(make_problems):
    """So that PyPose's optimiser, which has no gradient, is compared with what differentiates all of its steps."""
    pytest.importorskip("pypose")
    contenders, problems = modules["contenders"], make_problems(n=9, batch=4, noise=False)
    found = {}
    for name in ("pypose-lm", "pypose-parts"):
        found[name] = contenders.CONTENDERS[name]().task(problems, backward=True).call()[1]
    torch.testing.assert_close(found["pypose-lm"], found["pypose-parts"], rtol=0.05, atol=0.05)


class Uncompiled(nn.Linear):
    """Warns as the solver does where there is no compiler."""

    def compile(self):
        warnings.warn("There is no compiler: computing without.", RuntimeWarning, stacklevel=2)


def test_what_does_not_compile_is_not_timed_as_compiled(make_problems):
    tasks = modules["tasks"]
    with pytest.raises(tasks.CannotBeTimedError, match="no compiler"):
        tasks.compile_or_raise(Uncompiled(1, 1))
    task = tasks.Task(lambda: Uncompiled(1, 1).compile(), lambda: None, make_problems())
    with pytest.raises(tasks.CannotBeTimedError, match="no compiler"):
        task.warm()


# -- its parts ---------------------------------------------------------------------------------------------------------

SMALL = ("refinement", "epnp", "opencv-epnp", "kornia-dlt")


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """The files of a small run, in one process instead of many."""
    pytest.importorskip("cv2")
    folder = tmp_path_factory.mktemp("performance")

    def threaded(script, flag, text, **environment):
        request = json.loads(text)
        measure = modules["performance"]._THREADED[request["part"]][0]
        settings = modules["settings"].Settings.of(request["settings"])
        return json.loads(json.dumps(measure(settings, count=request["threads"])))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(modules["performance"], "run_child", threaded)
        patch.setattr(modules["startup"], "run_child", lambda _, text, **__: modules["process"].main(json.loads(text)))
        modules["performance"].main(["measure", "--quick", "--contenders", *SMALL, "--results", str(folder)])
    return folder, modules["page"].load_parts(folder)[0]


def test_every_part_says_what_was_measured_with_what(measured):
    for part in modules["page"].PARTS:
        results = measured[1][part]
        assert results["environment"]["versions"]["torch"]
        assert results["settings"]["contenders"] == list(SMALL)
        assert len(results["load_average"]) == 2


def test_throughput_has_a_row_for_every_point(measured):
    results, quick = measured[1]["throughput"], modules["settings"].QUICK
    rows = {(row["contender"], row["threads"], row["mode"], row["n"], row["batch"]): row for row in results["rows"]}
    assert len(rows) == len(results["rows"])
    small, large = quick.batches
    one = [(1, "forward", 6, quick.problems), *((1, "forward", 9, batch) for batch in quick.batches)]
    backward = [(1, "forward+backward", 9, small), (1, "forward+backward", 9, large), (2, "forward+backward", 9, large)]
    forward = [*one, (2, "forward", 9, large)]
    expected = {(name, *point) for name in SMALL for point in forward}
    expected |= {(name, *point) for name in SMALL if name != "opencv-epnp" for point in backward}
    assert rows.keys() == expected
    for row in results["rows"]:
        assert row["median_us"] == statistics.median(row["rounds_us"])
        assert row["min_us"] == min(row["rounds_us"]) > 0
        assert 1 <= row["count"] <= row["batch"]
        assert row["success"]["total"] <= quick.problems
    assert rows["opencv-epnp", 1, "forward", 9, small]["success"]["rate"] < 0.2
    assert results["skipped"] == []


def test_loops_are_cut_and_long_calls_left_out():
    throughput, settings = modules["throughput"], modules["settings"]
    problems = settings.draw(9, 40)

    def fake(loops, each):
        class Fake(modules["tasks"].Contender):
            def task(self, problems, *, backward=False):
                task = modules["tasks"].Task(lambda: None, lambda: problems.pose, problems)
                task.seconds = lambda times=1: each * len(problems.world_points)
                return task

        Fake.loops = loops
        return Fake()

    few = settings.FULL._replace(loop_s=0.3, call_s=1.0)
    options = {"backward": False, "known": None}
    task, count, once = throughput.ready(fake(True, 0.01), problems, few, **options)
    assert (count, len(task.problems.world_points)) == (30, 30)
    assert once == pytest.approx(0.3)
    assert throughput.ready(fake(False, 0.01), problems, few, **options)[1] == 40
    with pytest.raises(modules["tasks"].CannotBeTimedError, match="about 4 s"):
        throughput.ready(fake(False, 0.1), problems, few, backward=False, known=0.1)


def a_time(contender, rounds, mode="forward", **more):
    times = {"median_us": statistics.median(rounds), "min_us": min(rounds), "rounds_us": rounds}
    return {"contender": contender, "threads": 1, "mode": mode, "n": 9, "batch": 1000, **times, **more}


def test_targets_of_throughput():
    both = "forward+backward"
    rows = [a_time("refinement compiled", [2.0, 3.0, 4.0]), a_time("pnpnet-n9 compiled", [9.0, 8.5, 8.1])]
    rows += [a_time("opencv-ransac", [180.0, 170.0, 162.0]), a_time("poselib", [60.0, 60.0, 60.0])]
    rows += [a_time("poselib", [1.0], threads=2), a_time("opencv-ransac", [1.0], batch=10)]
    rows += [a_time("refinement compiled", [10.0], both), a_time("pypose-parts", [99.0], both)]
    rows += [a_time("refinement @1576bce", [100.0], both), a_time("net-n9+lm @1576bce", [100.0], both)]
    rows += [a_time("net-n9+lm compiled", [5.0, 5.0, 5.0])]
    found = {entry["what"]: (entry["measured"], entry["met"]) for entry in modules["throughput"].targets(rows)}
    assert found == {
        "`refinement compiled`, per problem": (3.0, True),
        "`net-n9+lm compiled`, per problem": (5.0, True),
        "`pnpnet-n9 compiled`, per problem": (8.5, False),
        "`net-n9+lm compiled` against `opencv-ransac`, forward": (34.0, True),
        "`net-n9+lm compiled` against `poselib`, forward": (12.0, True),
        "`pnpnet-n9 compiled` against `opencv-ransac`, forward": (20.0, True),
        "`pnpnet-n9 compiled` against `poselib`, forward": (pytest.approx(60 / 8.5), False),
        "`refinement compiled` against `pypose-parts`, forward+backward": (pytest.approx(9.9), False),
        "`refinement compiled` against `refinement @1576bce`, forward+backward": (10.0, True),
    }


def test_latency_keeps_the_distribution(measured):
    results = measured[1]["latency"]
    assert [(row["contender"], row["threads"]) for row in results["rows"]] == [(n, t) for t in (1, 2) for n in SMALL]
    for row in results["rows"]:
        spread = row["quantiles_us"]
        assert spread == sorted(spread)
        assert len(spread) == modules["latency"].QUANTILE_STEPS + 1
        assert spread[0] <= row["median_us"] <= row["p90_us"] <= row["p99_us"] <= row["max_us"]
        assert row["success"]["total"] == row["calls"]


def test_calls_come_in_turns_of_which_the_first_is_not_timed():
    order = []

    def task(name, index):
        found = type("Fake", (), {})()
        found.seconds = lambda: order.append((name, index)) or 1e-6
        return found

    turn = modules["latency"]._TURN
    tasks = {name: [task(name, index) for index in range(count)] for name, count in (("a", turn + 1), ("b", 1))}
    times = modules["latency"].latencies(tasks)
    assert {name: len(values) for name, values in times.items()} == {"a": turn + 1, "b": 1}
    assert order[:3] == [("a", 0), ("a", 0), ("a", 1)]
    assert order[turn + 1 :] == [("b", 0), ("b", 0), ("a", turn), ("a", turn)]


def test_targets_of_latency():
    row = {"contender": "pnpnet-n9", "threads": 1, "median_us": 3000.0, "p99_us": 6001.0}
    median, tail = modules["latency"].targets([row, {**row, "threads": 2}, {**row, "contender": "epnp"}])
    assert (median["measured"], median["met"]) == (3.0, True)
    assert not tail["met"]


def test_cold_starts_and_memory(measured):
    starts = measured[1]["startup"]["starts"]
    assert {(entry["contender"], entry["backward"]) for entry in starts} == {
        (name, backward) for name in SMALL for backward in (False, True) if name != "opencv-epnp" or not backward
    }
    for entry in starts:
        (call,) = entry["calls"]
        assert call["first_s"] > 0
        assert (entry["memory"] is None) == (entry["contender"] == "opencv-epnp")
        if entry["memory"]:
            assert entry["memory"]["peak_bytes"] >= entry["memory"]["before_bytes"] > 2**26


def test_a_large_call_shows_in_the_memory():
    """In a process of its own, as it is measured."""
    request = {"contender": "refinement", "backward": True, "device": "cpu", "batches": [2], "memory_batch": 5000}
    found = modules["harness"].run_child(FOLDER / "process.py", json.dumps(request), OMP_NUM_THREADS="1")
    memory = found["memory"]
    assert memory["peak_bytes"] - memory["before_bytes"] > 5000 * 9 * 5 * 4  # the gradients alone
    assert min(found["torch_s"], found["package_s"], found["make_s"]) > 0


def test_compiled_ones_start_cold_and_with_what_that_left(monkeypatch):
    startup, caches = modules["startup"], []

    def fake(script, text, **environment):
        request, folder = json.loads(text), Path(environment["TORCHINDUCTOR_CACHE_DIR"])
        caches.append((request["memory_batch"], len(list(folder.iterdir()))))
        (folder / str(len(caches))).touch()
        calls = [{"batch": batch, "first_s": 4.0 if len(caches) % 2 else 1.0} for batch in request["batches"]]
        return {**request, "make_s": 1.0, "calls": calls, "memory": None, "warnings": []}

    monkeypatch.setattr(startup, "run_child", fake)
    settings = modules["settings"].FULL._replace(startup_runs=2)
    starts = startup.start({"contender": startup.COMPILED, "backward": False, "memory_batch": 7}, settings)
    assert caches == [(0, 0), (7, 1), (0, 0), (0, 1)]
    imports, cold, cached = startup.targets(starts, [0.3, 0.2, 0.9])
    assert (imports["measured"], imports["met"]) == (0.3, True)
    assert (cold["measured"], cached["measured"]) == (5.0, 2.0)
    for entry in starts:
        entry["warnings"] = ["There is no compiler"]
    assert startup.targets(starts, []) == []


def test_traffic_is_what_is_read_and_written():
    with modules["engine"].Traffic() as counted:
        values = torch.ones(100)
        total = values.view(10, 10).mT + values[:10]
    assert total.shape == (10, 10)
    assert counted.kernels == 2  # views are none
    assert counted.bytes == 4 * (100 + 100 + 10 + 100)
    assert modules["engine"].count_bytes([torch.ones(1, 5).expand(100, 5)]) == 4 * 5


def test_the_profile_is_that_of_one_iteration(measured):
    engine = measured[1]["engine"]
    both = [operation_count(f"identity-lm:m={m}", engine["n"]) for m in (engine["m"], engine["m"] - 1)]
    assert engine["iteration_flops"] == pytest.approx(both[0] - both[1])
    n, pose = engine["n"], 12
    pairs = n * (3 + 2 + 1 + 1)  # points, pixels, two weights
    assert engine["floor_bytes"]["iteration"] == 4 * (pairs + 2 * pose)
    assert engine["floor_bytes"]["solve"] == 4 * (pairs + pose) + 4 * (pose + n + 1) + 1  # pose, weights, cost, ok
    assert engine["iteration_bytes"] > engine["floor_bytes"]["iteration"]
    assert engine["gpu"]["solves_per_second_by_bytes"] == pytest.approx(4.3e12 / engine["floor_bytes"]["solve"])


# -- earlier versions --------------------------------------------------------------------------------------------------


def test_a_version_is_measured_from_a_copy_of_its_commit(make_problems):
    repository = FOLDER.parent
    if shutil.which("git") is None or not (repository / ".git").exists():
        pytest.skip("There is no history here.")
    where = ["git", "-C", str(repository), "rev-parse", "HEAD"]
    commit = subprocess.run(where, capture_output=True, text=True, check=True).stdout.strip()
    version = modules["versions"].Version("epnp", commit)
    try:
        task, other = (version.task(make_problems(n=9, batch=4, noise=False, seed=seed)) for seed in (0, 1))
        assert task.seconds(2) > 0
        assert other.success() == task.success()
        assert task.success().rate == 1.0
    finally:
        version.close()
    assert not version.worker.folder.exists()


def test_a_version_that_is_not_here_is_skipped_with_a_reason(monkeypatch, tmp_path):
    versions, settings = modules["versions"], modules["settings"]
    entry = {"version": "lost", "commit": "0000000", "compiled": "", "text": "", "predicted": {}}
    (tmp_path / "versions.json").write_text(json.dumps([entry, {**entry, "commit": None, "compiled": "compiled"}]))
    monkeypatch.setattr(versions, "VERSIONS_FILE", tmp_path / "versions.json")
    only = settings.QUICK._replace(contenders=("refinement @0000000", "epnp"))
    made = settings.make_contenders(only, versions=True)
    assert list(made.contenders) == ["epnp"]
    (skipped,) = made.skipped
    assert skipped["contender"] == "refinement @0000000"
    assert "cannot be measured" in skipped["why"]


def test_versions_say_what_was_expected_of_them():
    for version in modules["versions"].load_versions():
        assert version.keys() == {"version", "commit", "compiled", "text", "predicted"}
        assert version["predicted"].keys() <= modules["tables"].OUTCOMES.keys()
        assert all(value > 0 for value in version["predicted"].values())


# -- the page ----------------------------------------------------------------------------------------------------------


def test_the_performance_page_is_generated_from_its_files():
    page = modules["page"]
    results, gpu = page.load_parts(FOLDER)
    assert page.page(results, modules["versions"].load_versions(), gpu) == page.PAGE.read_text(encoding="utf-8")
    for name in ("batch", "pairs", "latency"):
        assert (page.PAGE.parent / page.PAGE.stem / f"{name}.png").exists()


def test_a_page_is_rendered_of_a_small_run(measured, tmp_path):
    pytest.importorskip("matplotlib")
    folder, results = measured
    modules["performance"].main(["render", "--results", str(folder), "--page", str(tmp_path / "a.md")])
    text = (tmp_path / "a.md").read_text(encoding="utf-8")
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == ["batch.png", "latency.png", "pairs.png"]
    three = modules["tables"].three_digits
    for row in results["throughput"]["rows"]:
        if row["n"] == 9 and row["batch"] == modules["settings"].QUICK.problems:
            assert three(row["median_us"]) in text
    for row in results["latency"]["rows"]:
        assert three(row["median_us"] / 1e3) in text
    assert "No GPU was lent" in text


def test_the_page_shows_every_verdict_and_what_a_gpu_reached(measured):
    page, results = modules["page"], {key: dict(value) for key, value in measured[1].items()}
    target = modules["harness"].target
    found = [target("a", 1.0, 2.0, unit="s", at_most=True), target("b", 1.0, 2.0, unit="", at_most=False)]
    results["startup"]["targets"] = found
    floor = results["engine"]["gpu"]["solves_per_second_by_bytes"]
    row = {**a_time("refinement", [1e8 / floor]), "success": {"rate": 0.5, "low": 0.2, "high": 0.8, "total": 4}}
    gpu = {"rows": [row], "environment": {"gpu": "a GPU"}}
    text = page.page(results, [], gpu)
    assert "| a | at most 2 s | 1.00 s | met |" in text
    assert "| b | at least 2 | 1.00 | **missed** |" in text
    assert "| 1000 | " in text
    assert "| 1 | 50.0 [20.0, 80.0] |" in text
    assert "No GPU" not in text


def test_numbers_have_three_digits():
    three = modules["tables"].three_digits
    assert [three(x) for x in (0.01234, 1.0, 99.96, 123.4, 1234.5)] == ["0.0123", "1.00", "100", "123", "1,234"]
    assert math.isclose(float(three(0.5)), 0.5)
