"""Exported solvers compute what the layer does, for batches of any size, compiled ahead of time and in ONNX Runtime."""

import math
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import torch._inductor.config
from kornia.core.exceptions import BaseError, ShapeError, ValueCheckError

from kornia_pnpnet import PnPNet, Pose, RobustWeightedLM, SetInit, create_solver
from kornia_pnpnet.cli import main
from kornia_pnpnet.data import CameraProblems
from kornia_pnpnet.export import OUTPUTS, RIG_INPUTS, export_onnx, export_package, export_program, load_package

CPP = Path(__file__).resolve().parents[1] / "docs" / "examples" / "cpp"


def inputs_of(problems, weights=None):
    weights = torch.ones_like(problems.world_points[..., 0]) if weights is None else weights
    return tuple(x.float() for x in (*problems[:3], weights))


def rigs(n, batch):
    """Inputs of a solver for rigs."""
    problems = CameraProblems(n=n, batch_size=batch, seed=5, cameras=3, outlier_share=0.25).batch(0)
    return *inputs_of(problems), *problems.cam_from_rig


def broken(problems):
    """Problems of which the fourth, if there is one, has NaN."""
    world = problems.world_points.clone()
    world[3:4, 1] = torch.nan
    return problems._replace(world_points=world)


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
    assert cost.isfinite().all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "n", "counts"),
    [
        ("pnpnet-n9", None, (9,)),
        ("epnp-lm", 9, (9,)),
        ("reppnp-lm", 9, (9,)),
        ("identity-lm", 9, (9,)),
        ("pnpnet-set", 9, (9,)),
        ("pnpnet-set", None, (4, 5, 9, 17, 18, 30, 40, 200)),
    ],
)
def test_programs(name, n, counts, make_problems):
    solver = create_solver(name)
    program = export_program(solver, n)
    for count in counts:
        for batch in (2, 50):
            # With outliers EPnP ends on the edge of two minima so often that rounding decides.
            outliers = 0 if name == "epnp-lm" else count // 4
            inputs = inputs_of(make_problems(n=count, batch=batch, outliers=outliers))
            near(program.module()(*inputs), solver, inputs)


def run_onnx(path, inputs):
    runtime = pytest.importorskip("onnxruntime")
    session = runtime.InferenceSession(path, providers=["CPUExecutionProvider"])
    assert tuple(x.name for x in session.get_inputs()) == RIG_INPUTS[: len(inputs)]
    assert tuple(x.name for x in session.get_outputs())[:5] == OUTPUTS
    return session.run(None, {name: x.numpy() for name, x in zip(RIG_INPUTS, inputs, strict=False)})


@pytest.mark.parametrize(
    ("name", "fixed", "sizes"),
    [
        ("one iteration", 4, ((9, 4),)),
        pytest.param("one iteration", None, ((9, 4),), marks=pytest.mark.slow),
        pytest.param("pnpnet-n9", None, ((9, 1), (9, 3), (9, 100)), marks=pytest.mark.slow),
        pytest.param("pnpnet-set", None, ((4, 3), (9, 1), (9, 50), (20, 50), (100, 20)), marks=pytest.mark.slow),
    ],
)
def test_onnx(name, fixed, sizes, make_problems, tmp_path):
    """Batches of any size, with padding where any number of correspondences is allowed, and with a broken problem."""
    solver = PnPNet(None, RobustWeightedLM(1)) if name == "one iteration" else create_solver(name)
    path = export_onnx(solver, tmp_path / "model.onnx", 9 if name == "one iteration" else None, batch=fixed)
    for count, batch in sizes:
        problems = broken(make_problems(n=count, batch=batch, outliers=count // 4))
        weights = torch.ones_like(problems.world_points[..., 0])
        weights[:, 4:5] = 0.0 if name == "pnpnet-set" else 1.0
        inputs = inputs_of(problems, weights)
        found = run_onnx(path, inputs)
        near(found, solver, inputs)
        assert all(np.isfinite(x).all() for x in found[:4])
        assert not found[4][3:4].any()


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


REFUSED = [("p3p-ransac", {"n": 9}), ("pnpnet-n9", {"n": 8}), ("identity-lm", {"rig": True})]
REFUSED += [("identity-lm", {"n": n}) for n in (2, True, 6.0, math.nan, "6")]
REFUSED += [("identity-lm", {"n": 9, "batch": batch}) for batch in (0, True, 0.5, "1")]


@pytest.mark.parametrize(("name", "options"), REFUSED)
def test_what_cannot_be_exported_leaves_the_old_file(name, options, tmp_path):
    for export, path in ((export_onnx, tmp_path / "old.onnx"), (export_package, tmp_path / "old.pt2")):
        path.write_bytes(b"old")
        with pytest.raises(BaseError):
            export(create_solver(name), path, **options)
        assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 2


def test_solvers_that_the_command_cannot_export(tmp_path, capsys):
    for arguments, reason in ((["opencv-ransac"], "opencv-ransac"), (["identity-lm", "--rig"], "rigs")):
        assert main(["export", str(tmp_path / "x.onnx"), "--solver", *arguments]) == 2
        assert reason in capsys.readouterr().err
    with pytest.raises(ValueCheckError, match="rig"):
        export_program(create_solver("pnpnet-set", focal="unknown"), rig=True)
    assert list(tmp_path.iterdir()) == []


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


# -- ahead-of-time packages --------------------------------------------------------------------------------------------


def packaged(folder, solver, n, **options):
    if shutil.which("g++") is None and shutil.which("clang++") is None:
        pytest.skip("no C++ compiler")
    return export_package(solver, folder / "model.pt2", n, **options)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "batch", "sizes"),
    [(9, 1, ((9, 1),)), (9, None, ((9, 1), (9, 3), (9, 100))), (None, None, ((6, 3), (9, 1), (40, 2), (20, 50)))],
)
def test_packages(n, batch, sizes, make_problems, tmp_path):
    """Tensors of other dtypes and layouts than the package was compiled for, and a broken problem."""
    solver = PnPNet(None, RobustWeightedLM(1))
    package = load_package(packaged(tmp_path, solver, n, batch=batch))
    assert (package.sizes, package.batch) == (() if n is None else (n,), batch)
    for count, size in sizes:
        inputs = inputs_of(broken(make_problems(n=count, batch=size, outliers=count // 4)))
        found = package(*inputs)
        assert found._fields == OUTPUTS
        near(found, solver, inputs)
        assert all(x.isfinite().all() for x in found[:4])
        assert not found.ok[3:4].any()
        transposed = [x.double().mT.contiguous().mT for x in inputs[:3]]
        for ours, again in zip(package(*inputs[:3]), package(*transposed), strict=True):
            assert torch.equal(ours, again)
    world, img, intrinsics, weights = inputs_of(make_problems(n=9, batch=batch or 3))
    wrong = [(world[:, :3], img[:, :3], intrinsics), (world, img[:, :8], intrinsics), (world[0], img, intrinsics)]
    wrong += [(world, img, intrinsics, weights[:, :8]), (world, img, intrinsics[:0])]
    for inputs in wrong:
        with pytest.raises(ShapeError):
            package(*inputs)


@pytest.mark.slow
@pytest.mark.parametrize("rig", [False, True])
def test_a_package_for_several_numbers_of_pairs_pads(rig, make_problems, tmp_path):
    solver = create_solver("epnp") if rig else PnPNet(None, RobustWeightedLM(1))
    package = load_package(packaged(tmp_path, solver, (12, 8), batch=2, rig=rig))
    assert package.sizes == (8, 12)
    for n in (4, 5, 8, 9, 12):
        inputs = rigs(n, 2) if rig else inputs_of(make_problems(n=n, batch=2))
        before = [x.clone() for x in inputs]
        found = package(*inputs[:4], cam_from_rig=Pose(*inputs[4:]) if rig else None)
        assert found.pair_weights.shape == (2, n)
        near(found, solver, inputs)
        assert all(torch.equal(x, y) for x, y in zip(inputs, before, strict=True))
    for n in (2, 13):
        world, img, intrinsics, _ = inputs_of(make_problems(n=n, batch=2))
        with pytest.raises((ShapeError, ValueCheckError)):
            package(world, img, intrinsics)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["program", "onnx", "package"])
def test_rigs(kind, tmp_path):
    solver = PnPNet(SetInit(), RobustWeightedLM(2, kernel="huber"))
    sizes = ((5, 3), (12, 1), (12, 50), (70, 10))
    if kind == "program":
        run = export_program(solver, rig=True).module()
    elif kind == "onnx":
        path = export_onnx(solver, tmp_path / "model.onnx", rig=True)
        run = lambda *inputs: run_onnx(path, inputs)  # noqa: E731
    else:
        package, sizes = load_package(packaged(tmp_path, solver, 12, rig=True)), ((12, 1), (12, 50))
        run = lambda *inputs: package(*inputs[:4], cam_from_rig=Pose(*inputs[4:]))  # noqa: E731
    for size in sizes:
        near(run(*rigs(*size)), solver, rigs(*size))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake")
def test_cpp_example(make_problems, tmp_path):
    """The C++ program and Python get the same numbers from the same package."""
    path = packaged(tmp_path, PnPNet(None, RobustWeightedLM(1)), 9, batch=1)
    prefix = f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"
    subprocess.run(["cmake", "-S", CPP, "-B", tmp_path / "build", prefix], check=True)
    subprocess.run(["cmake", "--build", tmp_path / "build"], check=True)

    problems = make_problems(n=9, batch=1)
    world, img, intrinsics, _ = inputs_of(problems)
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
