"""The benchmarks measure what they say and compute their verdicts; nothing here depends on how fast a machine is."""

import importlib
import itertools
import json
import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import reprojection_errors
from torch import nn

from kornia_pnpnet import create_solver
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.data import OutlierMix, SyntheticProblems

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"
SOLVERS = ("epnp", "p3p-ransac:max_samples=50", "opencv-epnp", "poselib")
PEERS = ("cv2", "poselib", "pycolmap")
NAMES = ("contenders", "gpu", "harness", "page", "performance", "process", "solvers")
contenders, gpu, harness, page, performance, process, benchmark = (importlib.import_module(name) for name in NAMES)
# Exporting takes minutes.
MARKS = {x: [pytest.mark.slow] * x.endswith(("ONNX", "packaged")) for x in contenders.CONTENDERS if "compiled" not in x}


def load(script, *packages):
    """A script, if the packages that it needs are there."""
    for package in packages:
        pytest.importorskip(package)
    return importlib.import_module(script)


def test_everything_is_measured_once_at_a_commit(tmp_path):
    (tmp_path / "benchmarks").mkdir()
    shutil.copy(FOLDER / "measure.sh", tmp_path / "benchmarks")
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\necho "$*" >> calls\ncase "$*" in *"$BROKEN"*) exit 1;; esac\n')
    python.chmod(0o755)
    git = ["git", "-c", "user.name=n", "-c", "user.email=e", "-C", str(tmp_path)]

    def commit() -> None:
        subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "m"], check=True)

    def scripts(broken: str) -> list[str]:
        (tmp_path / "calls").write_text("")
        environment = {**os.environ, "PYTHON": str(python), "DATA": "scenes", "BROKEN": broken}
        done = subprocess.run(["sh", str(tmp_path / "benchmarks/measure.sh")], env=environment, check=False)
        assert (done.returncode == 0) == (broken == "nothing")
        return [line.split()[0] for line in (tmp_path / "calls").read_text().splitlines()]

    subprocess.run([*git, "init", "-q"], check=True)
    commit()
    pages = ["benchmarks/performance.py", "docs/results/make.py", "docs/examples/tables.py"]
    stopped = scripts("cameras.py")
    assert stopped[0] == "benchmarks/solvers.py"
    assert stopped[-1] == "benchmarks/cameras.py"
    rest = scripts("nothing")
    assert rest[0] == stopped[-1]
    assert rest[-4:] == ["docs/results/make.py", *pages]
    assert scripts("nothing") == pages
    commit()
    assert scripts("nothing") == stopped + rest[1:]


def test_every_solver_has_a_row_for_every_set_it_solves(tmp_path):
    load("solvers", "cv2", "poselib")
    path, sizes = tmp_path / "solvers.json", ("--count", "20", "--repeats", "3", "--memory-count", "0")
    benchmark.main(["--out", str(path), *sizes, "--solvers", *SOLVERS])
    written = json.loads(path.read_text())
    rows = {(row["solver"], row["set"]): row for row in written["rows"]}
    small = {name for name, (n, *_) in benchmark.SETS.items() if n == benchmark.SMALL}
    expected = {(spec, name) for spec in SOLVERS for name in small}
    expected |= {(spec, name) for spec in SOLVERS if "epnp" not in spec for name in benchmark.SETS}
    assert rows.keys() == expected
    assert all((len(row["rounds_us"]), row["success"]["total"]) == (3, 20) for row in rows.values())
    assert rows["poselib", "n = 100, 50 outliers"]["success"]["rate"] > 0.8
    assert rows["opencv-epnp", "n = 9, 3 outliers"]["success"]["rate"] < 0.2
    row = rows["poselib", "n = 200, 80 outliers, exact points"]
    assert 0.0 < row["median_rotation_error_deg"] < 0.1
    assert 0.0 < row["median_translation_error"] < 0.02
    text = benchmark.page(written)
    assert all(f"{row[key]:.{digits}f}" in text for key, digits in (("median_us", 1), ("median_rotation_error_deg", 3)))


def test_peers_are_timed_without_our_adapter(make_problems):
    pytest.importorskip("cv2")
    solver, seen = create_solver("opencv-epnp"), []
    solver.solve_one = lambda *arrays: seen.append([array.shape for array in arrays])
    call = contenders.bare_call(solver, make_problems(n=9, batch=4))
    assert seen == []
    call()
    assert seen == 4 * [[(9, 3), (9, 2), (3, 3)]]


def test_missing_packages_are_skipped_with_a_reason(monkeypatch):
    monkeypatch.setitem(sys.modules, "poselib", None)
    results = benchmark.measure(["epnp", "poselib"], count=2, repeats=1, memory_count=0)
    assert "PoseLib" in results["skipped"]["poselib"]
    assert {entry["solver"] for entry in results["rows"]} == {"epnp"}
    assert results["memory"] == []


@pytest.mark.parametrize("name", [pytest.param(name, marks=marks) for name, marks in MARKS.items()])
def test_contenders_solve_and_differentiate(name, make_problems):
    """Without noise and outliers every contender finds the pose; gradients, where there are any, are finite."""
    try:
        contender = contenders.CONTENDERS[name]()
    except ImportError as error:
        pytest.skip(str(error))
    task = contender.task(make_problems(n=9, batch=5, noise=False))
    assert task.success().rate == 1.0
    assert task.seconds(2) > 0
    if contender.differentiable:
        problems = make_problems(n=9, batch=3)
        gradients = contender.task(problems, backward=True).call()  # to points, pixels and parameters
        assert all(gradient.isfinite().all() for gradient in gradients if gradient is not None)
        for gradient, leaf in zip(gradients[:2], problems[:2], strict=True):
            assert gradient.shape == leaf.shape
            assert gradient.any()


def test_a_solver_that_does_not_compile_is_not_timed_as_compiled(monkeypatch):
    def warn(_):
        warnings.warn("There is no compiler: computing without.", RuntimeWarning, stacklevel=2)

    monkeypatch.setattr(nn.Linear, "compile", warn)
    with pytest.raises(contenders.CannotBeTimedError, match="no compiler"):
        contenders.compile_or_raise(nn.Linear(1, 1))


@pytest.mark.slow
def test_throughput_and_latency_have_a_row_for_every_point(tmp_path, monkeypatch):
    pytest.importorskip("cv2")
    names = ("refinement", "epnp-lm", "opencv-ransac", "kornia-dlt")

    def here(script, *arguments, **environment):
        request = json.loads(arguments[-1])
        if script.name == "process.py":
            return process.main(request)
        settings = performance.Settings(**request["settings"])
        return json.loads(json.dumps(performance.measure_threads(request["part"], settings, request["count"])))

    monkeypatch.setattr(performance, "run_child", here)
    performance.main(["measure", "--quick", "--contenders", *names, "--results", str(tmp_path)])
    throughput, latency = (page.load_parts(tmp_path)[0][part] for part in ("throughput", "latency"))
    rows = {(row["contender"], row["threads"], row["mode"], row["n"], row["batch"]) for row in throughput["rows"]}
    small, large = performance.QUICK.batches
    forward = [(1, "forward", 6, performance.QUICK.problems), (2, "forward", 9, large)]
    forward += [(1, "forward", 9, batch) for batch in (small, large)]
    backward = [(threads, "forward+backward", 9, batch) for threads, batch in ((1, small), (1, large), (2, large))]
    expected = {(name, *point) for name in names for point in forward}
    assert rows == expected | {(name, *point) for name in names if name != "opencv-ransac" for point in backward}
    assert all(1 <= row["count"] <= row["batch"] for row in throughput["rows"])
    assert throughput["skipped"] == []
    assert [(row["contender"], row["threads"]) for row in latency["rows"]] == [(n, t) for t in (1, 2) for n in names]
    for row in latency["rows"]:
        spread = row["quantiles_us"]
        assert spread == sorted(spread)
        assert spread[0] <= row["median_us"] <= row["p90_us"] <= row["p99_us"] <= row["max_us"]
        assert row["success"]["total"] == max(1, performance.QUICK.latency_calls // (1, 4)[row["threads"] - 1])


def test_compiled_solvers_are_measured_with_nine_pairs_only(monkeypatch):
    contender = contenders.CONTENDERS["refinement"]()  # eager under both names
    made = dict.fromkeys(("refinement", "refinement compiled"), contender)
    monkeypatch.setattr(performance, "make_contenders", lambda names: (made, []))
    rows = performance.measure_throughput(performance.QUICK, 1)["rows"]
    assert {(row["contender"], row["n"]) for row in rows} == {(name, 9) for name in made} | {("refinement", 6)}


def test_a_large_call_shows_in_the_memory_of_its_process():
    request = {"contender": "refinement", "backward": True, "batches": [2], "memory_batch": 5000}
    found = harness.run_child(FOLDER / "process.py", json.dumps(request), OMP_NUM_THREADS="1")
    memory = found["memory"]
    assert memory["peak_bytes"] - memory["before_bytes"] > 5000 * 9 * 5 * 4  # the gradients alone
    assert min(found["torch_s"], found["package_s"], found["make_s"]) > 0


@pytest.mark.slow
def test_the_measurements_for_a_gpu_run_on_a_cpu(tmp_path, monkeypatch):
    pytest.importorskip("cv2")
    monkeypatch.setattr(gpu.contenders, "compile_or_raise", lambda solver, **options: None)  # compiling takes minutes
    names = (*gpu.QUICK.contenders, "opencv-ransac")
    few = gpu.QUICK._replace(modes=("eager", "compiled", "captured"), calls=(2,), pairs=(9,), contenders=names)
    path = tmp_path / "gpu.json"
    to_file = ["--device", "cpu", "--out", str(path)]
    gpu.main(to_file, few)
    results = {part: found["rows"] for part, found in json.loads(path.read_text()).items()}
    assert {"pnpnet-n9", "pnpnet-set", "p3p-ransac", "epnp"} <= {row["solver"] for row in results["parity"]}
    for row in results["parity"]:  # the device is the CPU
        assert row["same_ok"] == 1.0
        assert {row["same_pose"], row["same_gradient"]} <= {1.0, None}
        assert row["success"][0] == row["success"][1]
    assert [row["mode"] for row in results["graphs"]] == ["forward", "forward+backward"]
    for row in results["graphs"]:
        assert row["modes"]["compiled"]["rotation_difference"] < 1e-6
        assert row["modes"]["compiled"]["same_gradient"] == 1.0
        assert "why" in row["modes"]["captured"]
    rows = {(row["contender"], row["mode"], row["batch"]) for row in results["throughput"]}
    assert rows >= set(itertools.product(gpu.QUICK.contenders, ("forward", "forward+backward"), few.batches))
    gpu.main([*to_file, "--parts", "graphs"], few._replace(modes=("captured",)))  # the others stay
    assert json.loads(path.read_text())["throughput"]["rows"] == results["throughput"]


def test_covariances_are_right_and_bring_errors_close_to_the_bound(monkeypatch):
    script = load("uncertainty", *PEERS)
    for name, value in (("SIZES", (30,)), ("SHARES", (0.3,)), ("CREDIBLE", ((20, 0), (50, 25)))):
        monkeypatch.setattr(script, name, value)
    solver = create_solver(script.SOLVER).double()
    for row in script.measure_errors(solver, 500):
        assert all(0.9 < error < 1.1 for error in row["covariances"]), row
        assert all(error > 1.3 for name in ("nothing", *script.PEERS) for error in row[name]), row
    for row in script.measure_credibility(solver, 1500)[:4]:
        assert 5.6 < row["mean"] < 6.4, row
        assert 0.935 < row["below"] < 0.97, row


def test_cameras_are_measured_beside_the_peers(monkeypatch):
    script = load("cameras", *PEERS)
    for name, value in (("RIGS", (3,)), ("BASELINES", (0.1,))):
        monkeypatch.setattr(script, name, value)
    found = {row["solver"]: row for row in script.measure_focal(32, (12,), (0.25,))}
    assert set(found) == {*script.OURS, "pycolmap", "opencv, 21 focals", "oracle"}
    rigs = script.measure_rigs(32, ((12, 0.25),))
    assert len(rigs) == 4
    assert all(row["success"] > 0.9 for row in (*rigs, *found.values()) if not row["solver"].startswith("opencv"))
    assert all(row["median_focal"] < 0.01 for row in script.measure_cell(4, 100))


def test_pages_are_written_from_their_files():
    results, on_gpu = page.load_parts(FOLDER)
    assert page.page(results, on_gpu) == page.PAGE.read_text(encoding="utf-8")
    assert "Not measured" in page.page(results)
    for name in ("cameras", "solvers", "uncertainty"):
        results = json.loads((FOLDER / f"{name}.json").read_text())
        assert load(name, *PEERS).page(results) == (FOLDER / f"{name}.md").read_text(encoding="utf-8")


def test_real_matches_are_measured_and_failures_drawn(tmp_path):
    real_matches = load("real_matches", "pandas", "poselib")
    files = [tmp_path / f"{name}.npz" for name in ("yard", "room")]
    for seed, file in enumerate(files):  # as of ``make``: 4 outliers among 40 with the ratio test, 32 without
        options = {"n": 40, "batch_size": 6, "seed": seed, "world_sigma": 0.0, "dtype": torch.float64}
        parts = [SyntheticProblems(outliers=OutlierMix(count=count), **options).batch(0) for count in (4, 32)]
        p = map_tensors(lambda *x: torch.cat(x), *parts)
        arrays = {"world": p.world_points, "pixels": p.img_points, "mask": p.inliers | True, "K": p.intrinsics}
        arrays |= {"ratio": torch.where(p.inliers, 0.5, 0.9), "R": p.pose.rotation, "t": p.pose.translation}
        arrays |= {"error_px": reprojection_errors(p).norm(dim=-1), "kind": torch.arange(2).repeat_interleave(6)}
        np.savez_compressed(file, **{name: value.numpy() for name, value in arrays.items()})
    specs = ["p3p-ransac:max_samples=3", "p3p-ransac:threshold=8", "p3p-ransac:threshold=8+ratio", "known-inliers"]
    specs += ["poselib:threshold=8+ratio", "pnpnet-set+ratio"]
    more = ["--split", "made up", "--pictures", tmp_path, "--batch", 500, 1, "--solvers", *specs]
    real_matches.main([str(x) for x in ("measure", *files, "--out", tmp_path / "out.json", *more)])
    results = json.loads((tmp_path / "out.json").read_text())
    rows = {(row["solver"], row["kind"], row["group"], row["batch"]): row for row in results["rows"]}
    for kind, spec in itertools.product(real_matches.KINDS, specs):
        every = rows[spec, kind, "all", 500]
        assert every["count"] == 12
        assert every["success"] >= rows[specs[0], kind, "all", 500]["success"]
        assert every["success"] == rows[spec, kind, "all", 1]["success"]  # a problem alone is solved as in a batch
        scenes = [rows[spec, kind, scene, 500]["success"] for scene in ("yard", "room")]
        assert sum(scenes) / 2 == pytest.approx(every["success"])  # the scenes are all problems
    assert rows[specs[0], real_matches.KINDS[1], "all", 500]["far"] > 0
    assert results["failures"]
    assert all((tmp_path / failure["picture"]).stat().st_size > 0 for failure in results["failures"])


def test_keypoints_are_measured_where_they_were_not_seen(tmp_path, monkeypatch):
    keypoints = load("keypoints", "poselib", "sklearn")
    p, draw = SyntheticProblems(n=12, batch_size=60, seed=3, dtype=torch.float64).batch(0), np.random.default_rng(0)
    confidence = draw.uniform(0.2, 1.0, (60, 12))
    pixels = p.img_points.numpy() + 2.0 / confidence[..., None] * draw.normal(size=(60, 12, 2))
    pixels[:, 0] += 200.0  # an outlier that the confidence knows
    confidence[:, 0] = 0.1
    arrays = {"world": p.world_points, "img": pixels, "K": p.intrinsics.expand(60, 3, 3), "confidence": confidence}
    arrays |= {"R": p.pose.rotation, "t": p.pose.translation, "mask": np.ones((60, 12), bool)}
    np.savez(tmp_path / "a.npz", **arrays, seen=np.arange(60) < 30, cluster=np.arange(60) // 2, inlier_px=40.0)
    (tmp_path / "sources.json").write_text('{"a": "synthetic"}')
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["keypoints.py", "a.npz", "--sources", "sources.json", "--out", "out.json"])
    keypoints.main()
    (result,) = json.loads(Path("out.json").read_text())["results"]
    assert (result["seen"], result["measured"], result["clusters"]) == (30, 30, 15)
    rows = {row["way"]: row for row in result["rows"]}
    assert max(row["median"] for row in rows.values()) < 0.1
    fitted = rows["confidence=fitted"]
    for base in keypoints.BASES:
        for key, (mean, low, high) in fitted["less"][base].items():
            assert low <= mean <= high
            assert mean == pytest.approx(fitted[key] - rows[base][key])
