"""Exported solvers compute what the layer does, for batches of any size, compiled ahead of time and in ONNX Runtime."""

import copy
import math
import shutil
import subprocess
import sys
from itertools import product
from pathlib import Path

import pytest
import torch
import torch._inductor.config
from helpers import assert_same, finite
from kornia.core.exceptions import BaseError, ShapeError, ValueCheckError

from kornia_pnpnet import PnPNet, Pose, RobustWeightedLM, SetInit, create_solver
from kornia_pnpnet.cli import main
from kornia_pnpnet.core.performance import INLINE
from kornia_pnpnet.data import CameraProblems
from kornia_pnpnet.export import OUTPUTS, RIG_INPUTS, export_onnx, export_package, export_program, load_package

CPP = Path(__file__).resolve().parents[1] / "docs" / "examples" / "cpp"


def inputs_of(problems):
    weights = torch.ones_like(problems.world_points[..., 0])
    return *(x.float() for x in (*problems[:3], weights)), *(problems.cam_from_rig or ())


def near(found, solver, inputs):
    """Equal within 1e-4 of the scene's size; a problem on the edge of two minima may end in either."""
    with torch.no_grad(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(solver, "effort", "fixed")  # as that of a graph
        expected = solver(*inputs[:4], cam_from_rig=Pose(*inputs[4:]) if inputs[4:] else None)
    rotation, translation, weights, cost, ok = (torch.as_tensor(x) for x in found)
    size = expected.translation.norm(dim=-1).clamp(min=1e-6)  # 0 where not ok
    off = (translation - expected.translation).norm(dim=-1) / size + (rotation - expected.rotation).abs().amax((1, 2))
    assert (off < 1e-4).float().mean() >= 0.98
    assert off.median() < 1e-5
    same = off < 1e-4
    # The weight of a small residual changes quickly with the pose.
    torch.testing.assert_close(weights[same], expected.weights[same], rtol=2e-2, atol=2e-2)
    assert (ok == expected.ok).float().mean() >= 0.98
    finite(rotation, translation, weights, cost)


def run_onnx(path, inputs):
    session = pytest.importorskip("onnxruntime").InferenceSession(path, providers=["CPUExecutionProvider"])
    assert tuple(x.name for x in session.get_inputs()) == RIG_INPUTS[: len(inputs)]
    assert tuple(x.name for x in session.get_outputs())[:5] == OUTPUTS
    return session.run(None, {name: x.numpy() for name, x in zip(RIG_INPUTS, inputs, strict=False)})


def packaged(folder, solver, n, **options):
    if shutil.which("g++") is None and shutil.which("clang++") is None:
        pytest.skip("no C++ compiler")
    return export_package(solver, folder / "model.pt2", n, **options)


def exported(kind, solver, folder, n, **options):
    if kind == "program":
        return export_program(solver, n, **options).module()
    if kind == "onnx":
        path = export_onnx(solver, folder / "model.onnx", n, **options)
        return lambda *inputs: run_onnx(path, inputs)
    package = load_package(packaged(folder, solver, n, **options))
    return lambda *inputs: package(*inputs[:4], cam_from_rig=Pose(*inputs[4:]) if inputs[4:] else None)


PROGRAMS = "pnpnet-n9", "epnp-lm", "reppnp-lm", "identity-lm", "pnpnet-set"
#: Kind, solver, number of pairs and size of the batch of the export; then those of problems, and whether it is a rig.
SLOW = [
    *(("program", name, 9, None, ((9, 2), (9, 50)), False) for name in PROGRAMS),
    ("program", "pnpnet-set", None, None, [*product((4, 5, 9, 17, 18, 30, 40, 200), (2, 50))], False),
    ("onnx", "pnpnet-n9", None, None, ((9, 1), (9, 3), (9, 100)), False),
    ("onnx", "pnpnet-set", None, None, ((4, 3), (9, 1), (9, 50), (20, 50), (100, 20)), False),
    ("onnx", "epnp", None, None, ((4, 5), (9, 4), (50, 2)), False),
    ("onnx", "set-lm", None, None, ((5, 3), (12, 1), (12, 50), (70, 10)), True),
    ("package", "identity-lm", 9, 1, ((9, 1),), False),
    ("package", "identity-lm", 9, None, ((9, 1), (9, 3), (9, 100)), False),
    ("package", "identity-lm", None, None, ((6, 3), (9, 1), (40, 2), (20, 50)), False),
    ("package", "set-lm", 12, None, ((12, 1), (12, 50)), True),
    ("package", "identity-lm", (12, 8), 2, [(n, 2) for n in (4, 5, 8, 9, 12)], False),
    ("package", "epnp", (12, 8), 2, [(n, 2) for n in (4, 5, 8, 9, 12)], True),
]
EXPORTS = [("onnx", "identity-lm", 9, batch, ((9, 4),), False) for batch in (4, None)]
EXPORTS += [("program", "set-lm", None, None, ((5, 3), (12, 1), (12, 50), (70, 10)), True)]
EXPORTS += [pytest.param(*export, marks=pytest.mark.slow) for export in SLOW]


@pytest.mark.parametrize(("kind", "name", "n", "batch", "sizes", "is_rig"), EXPORTS)
def test_exports(kind, name, n, batch, sizes, is_rig, make_problems, tmp_path):
    solver = PnPNet(SetInit(), RobustWeightedLM(2, kernel="huber")) if name == "set-lm" else create_solver(name)
    solver = PnPNet(None, RobustWeightedLM(1)) if name == "identity-lm" else solver
    compiled = copy.deepcopy(solver)
    compiled.compile()  # which changes no export
    run = exported(kind, compiled, tmp_path, n, batch=batch, rig=is_rig)
    for count, size in sizes:
        # With outliers EPnP ends on the edge of two minima so often that rounding decides.
        outliers = 0 if name.startswith("epnp") else count // 4
        problems = make_problems(n=count, batch=size, outliers=outliers)
        if is_rig:
            problems = CameraProblems(n=count, batch_size=size, seed=5, cameras=3, outlier_share=0.25).batch(0)
        else:
            problems.world_points[3:4, 1] = torch.nan
        inputs = inputs_of(problems)
        inputs[3][:, 4:5] = 0.0 if name == "pnpnet-set" and n is None else 1.0
        before, found = [x.clone() for x in inputs], run(*inputs)
        near(found, solver, inputs)
        assert is_rig or not found[4][3:4].any()
        torch.testing.assert_close(inputs, tuple(before), rtol=0, atol=0, equal_nan=True)


@pytest.mark.slow
def test_onnx_of_an_unknown_focal_length(tmp_path):
    solver = create_solver("pnpnet-set", focal="unknown")
    path = export_onnx(solver, tmp_path / "model.onnx")
    for n, batch in ((6, 7), (12, 50)):
        problems = CameraProblems(n=n, batch_size=batch, seed=5).batch(0)
        nominal = torch.where(torch.eye(3) > 0, 1.0, problems.intrinsics)
        inputs = inputs_of(problems._replace(intrinsics=nominal))
        inputs[3][0, 5:] = 0.0
        *found, camera = run_onnx(path, inputs)
        near(found, solver, inputs)
        solver.effort = "fixed"
        torch.testing.assert_close(torch.from_numpy(camera), solver(*inputs).intrinsics, rtol=1e-3, atol=1e-3)


#: Solver, its options, those of the export, and the error.
REFUSED = [("p3p-ransac", {}, {"n": 9}, "RANSAC cannot"), ("pnpnet-n9", {}, {"n": 8}, "built for n = 9")]
REFUSED += [("identity-lm", {}, {"rig": True}, "For rigs")]
REFUSED += [("identity-lm", {}, {"n": n}, "n must be an integer of at least 3") for n in (2, True, 6.0, math.nan, "6")]
REFUSED += [("identity-lm", {}, {"n": 9, "batch": batch}, "batch must be") for batch in (0, True, 0.5, "1")]
REFUSED += [("p3p-ransac", {"focal": "unknown"}, {}, "RANSAC cannot")]
REFUSED += [("epnp-lm", {"focal": "unknown"}, {}, "With an unknown focal")]
REFUSED += [("pnpnet-set", {"focal": "unknown", "radial": 1}, {}, "With an unknown focal")]
REFUSED += [("pnpnet-set", {"focal": "unknown"}, {"rig": True}, "For rigs")]


@pytest.mark.parametrize(("name", "chosen", "options", "why"), REFUSED)
def test_what_cannot_be_exported_leaves_the_old_file(name, chosen, options, why, tmp_path):
    for export, path in ((export_onnx, tmp_path / "old.onnx"), (export_package, tmp_path / "old.pt2")):
        path.write_bytes(b"old")
        with pytest.raises(BaseError, match=why):
            export(create_solver(name, **chosen), path, **options)
        assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 2


def test_all_numbers_of_pairs_are_checked_before_the_first_is_compiled(tmp_path, monkeypatch):
    monkeypatch.setattr("kornia_pnpnet.export._compiled", None)
    with pytest.raises(ValueCheckError, match="built for n = 9"):
        export_package(create_solver("pnpnet-n9"), tmp_path / "x.pt2", (9, 12))


@pytest.mark.parametrize(("name", "missing"), [("x.onnx", "onnx"), ("x.onnx", "onnxscript"), ("x.pt2", "compiler")])
def test_what_an_export_needs_is_checked_before_it_starts(name, missing, tmp_path, monkeypatch, capsys):
    export = export_package if missing == "compiler" else export_onnx
    if missing != "compiler":
        monkeypatch.setitem(sys.modules, missing, None)
    with torch._inductor.config.patch("cpp.cxx", ("no-such-compiler",)):
        assert main(["export", str(tmp_path / name)]) == 2
        with pytest.raises(ImportError):
            export(PnPNet(), tmp_path / name, 9)
    out, err = capsys.readouterr()
    assert out == ""
    assert "C++ compiler" in err if missing == "compiler" else "pip install '.[onnx]'" in err


@pytest.mark.slow
def test_what_a_package_takes(make_problems, tmp_path):
    package = load_package(packaged(tmp_path, PnPNet(None, RobustWeightedLM(1)), (12, 8), batch=2))
    assert (package.sizes, package.batch) == ((8, 12), 2)
    problems = make_problems(n=13, batch=2)
    world, img, intrinsics, weights = inputs_of(problems)
    inputs = world[:, :9], img[:, :9], intrinsics
    found = package(*inputs)
    assert found._fields == OUTPUTS
    assert_same(package(*(x.double().mT.contiguous().mT for x in inputs)), found)
    assert_same(package(*inputs[:2], problems.pose.camera(intrinsics)), found)
    wrong = [*((world[:, :n], img[:, :n], intrinsics) for n in (2, 13)), (*inputs, weights[:, :8])]
    wrong += [(inputs[0], img[:, :8], intrinsics), (inputs[0][0], *inputs[1:]), (*inputs[:2], intrinsics[:0])]
    for refused in wrong:
        with pytest.raises((ShapeError, ValueCheckError)):
            package(*refused)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake")
def test_cpp_example(make_problems, tmp_path):
    path = packaged(tmp_path, PnPNet(None, RobustWeightedLM(1)), 9, batch=1)
    prefix = f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"
    subprocess.run(["cmake", "-S", CPP, "-B", tmp_path / "build", prefix], check=True)
    subprocess.run(["cmake", "--build", tmp_path / "build"], check=True)
    world, img, intrinsics, _ = inputs_of(make_problems(n=9, batch=1))
    rows = torch.cat((world, img), -1)[0].tolist()
    table = tmp_path / "matches.csv"
    table.write_text("\n".join(["X,Y,Z,u,v", *(",".join(map(repr, row)) for row in rows)]) + "\n")
    camera = [repr(intrinsics[0, i, j].item()) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))]
    command = [tmp_path / "build" / "pnpnet_solve", path, table, *camera]
    rotation, translation, ok = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    expected = load_package(path)(world, img, intrinsics)
    for text, tensor in ((rotation, expected.rotation), (translation, expected.translation)):
        torch.testing.assert_close(torch.tensor([*map(float, text.split())]), tensor.flatten(), rtol=1e-6, atol=1e-6)
    assert ok == ("ok" if expected.ok.item() else "not ok")
    table.write_text("\n".join(table.read_text().splitlines()[:-1]))
    refused = subprocess.run(command, capture_output=True, text=True, check=False)
    assert refused.returncode == 2
    assert "n = 9" in refused.stderr


def test_files_that_are_no_packages(tmp_path):
    with pytest.raises(ValueCheckError, match=r"\.pt2"):
        export_package(PnPNet(), tmp_path / "model.so", 9)
    with pytest.raises(FileNotFoundError):
        load_package(tmp_path / "missing.pt2")
    path = tmp_path / "text.pt2"
    path.write_text("text")
    with pytest.raises(ValueCheckError, match="text"):
        load_package(path)


@pytest.mark.filterwarnings("ignore::FutureWarning")  # of PyTorch, about its own code
def test_a_package_of_one_problem_calls_no_operator_of_pytorch():
    """One call of PyTorch moves all tensors of the graph from the stack to the heap, which takes ten times as long."""
    program = export_program(create_solver("pnpnet-n9"), 9, batch=1).run_decompositions(INLINE)
    called = {getattr(node.target, "overloadpacket", None) for node in program.graph.nodes}
    aten = torch.ops.aten
    assert aten.scatter_add in called  # Inductor generates code for it
    calls = aten.mm, aten.bmm, aten.addmm, aten.baddbmm, aten.matmul, aten.linear, aten.sort, aten.argsort, aten.topk
    assert not called & {*calls, aten.cumsum, aten.cumprod, aten._linalg_eigh}
