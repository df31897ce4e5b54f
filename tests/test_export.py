"""Exported solvers compute what the layer does, for batches of any size, without PyTorch."""

import math

import numpy as np
import pytest
import torch
from kornia.core.exceptions import BaseError, ValueCheckError

from kornia_pnpnet import PnPNet, RobustWeightedLM, create_solver
from kornia_pnpnet.cli import main
from kornia_pnpnet.export import INPUTS, OUTPUTS, export_onnx, export_program


def inputs_of(problems, weights=None):
    weights = torch.ones_like(problems.world_points[..., 0]) if weights is None else weights
    return tuple(x.float() for x in (problems.world_points, problems.img_points, problems.intrinsics, weights))


def near(found, solver, inputs):
    """Equal within 1e-4 of the scene's size; a problem on the edge of two minima may end in either."""
    with torch.no_grad():
        expected = solver(*inputs)
    rotation, translation, weights, cost, ok = (torch.as_tensor(x) for x in found)
    size = expected.translation.norm(dim=-1).clamp(min=1e-6)  # 0 where not ok
    off = (translation - expected.translation).norm(dim=-1) / size + (rotation - expected.rotation).abs().amax((1, 2))
    assert (off < 1e-4).float().mean() >= 0.98
    assert off.median() < 1e-5
    same = off < 1e-4
    torch.testing.assert_close(weights[same], expected.weights[same], rtol=0, atol=2e-2)
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
            inputs = inputs_of(make_problems(n=count, batch=batch, outliers=count // 4))
            near(program.module()(*inputs), solver, inputs)


def run_onnx(path, inputs):
    runtime = pytest.importorskip("onnxruntime")
    session = runtime.InferenceSession(path, providers=["CPUExecutionProvider"])
    assert tuple(x.name for x in session.get_inputs()) == INPUTS
    assert tuple(x.name for x in session.get_outputs()) == OUTPUTS
    return session.run(None, {name: x.numpy() for name, x in zip(INPUTS, inputs, strict=True)})


@pytest.mark.parametrize(
    ("name", "sizes"),
    [
        ("one iteration", ((9, 3),)),
        pytest.param("pnpnet-n9", ((9, 1), (9, 3), (9, 100)), marks=pytest.mark.slow),
        pytest.param("pnpnet-set", ((4, 3), (9, 1), (9, 50), (20, 50), (100, 20)), marks=pytest.mark.slow),
    ],
)
def test_onnx(name, sizes, make_problems, tmp_path):
    """Batches of any size, with padding where any number of correspondences is allowed, and with a broken problem."""
    solver = PnPNet(None, RobustWeightedLM(1)) if name == "one iteration" else create_solver(name)
    path = export_onnx(solver, tmp_path / "model.onnx", 9 if name == "one iteration" else None)
    for count, batch in sizes:
        problems = make_problems(n=count, batch=batch, outliers=count // 4)
        world, weights = problems.world_points.clone(), torch.ones_like(problems.world_points[..., 0])
        weights[:, 4:5] = 0.0 if name == "pnpnet-set" else 1.0
        world[3:4, 1] = torch.nan
        inputs = inputs_of(problems._replace(world_points=world), weights)
        found = run_onnx(path, inputs)
        near(found, solver, inputs)
        assert all(np.isfinite(x).all() for x in found[:4])
        assert not found[4][3:4].any()


def test_solvers_that_cannot_be_exported(tmp_path, capsys):
    with pytest.raises(ValueCheckError, match="RANSAC"):
        export_program(create_solver("p3p-ransac"), 9)
    with pytest.raises(ValueCheckError, match="9"):
        export_program(create_solver("pnpnet-n9"), 8)
    for n in (0, 1, 2, -1, True, 0.5, 6.0, math.nan, "6"):
        with pytest.raises(BaseError):
            export_program(PnPNet(None, RobustWeightedLM(1)), n)
    (tmp_path / "old.onnx").write_bytes(b"old")
    with pytest.raises(ValueCheckError, match="RANSAC"):
        export_onnx(create_solver("p3p-ransac"), tmp_path / "old.onnx", 9)
    assert (tmp_path / "old.onnx").read_bytes() == b"old"
    (tmp_path / "old.onnx").unlink()
    assert main(["export", str(tmp_path / "x.onnx"), "--solver", "opencv-ransac"]) == 2
    assert "opencv-ransac" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
