"""Exported solvers compute what the layer does, for batches of any size, without PyTorch."""

import math
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ValueCheckError
from strategies import Seen, batches, many, same

from kornia_pnpnet import MLPInit, PnPNet, RobustWeightedLM, create_solver
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sizes"),
    [("pnpnet-n9", ((9, 1), (9, 3), (9, 100))), ("pnpnet-set", ((4, 3), (9, 1), (9, 50), (20, 50), (100, 20)))],
)
def test_onnx(name, sizes, make_problems, tmp_path):
    """Batches of any size, with padding where any number of correspondences is allowed, and with a broken problem."""
    solver = create_solver(name)
    path = export_onnx(solver, tmp_path / "model.onnx")
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
    assert main(["export", str(tmp_path / "x.onnx"), "--solver", "opencv-ransac"]) == 2
    assert "opencv-ransac" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


# -- fuzz --------------------------------------------------------------------------------------------------------------


SMALL = {
    "network": PnPNet(MLPInit(6), RobustWeightedLM(1)),
    "from the identity": PnPNet(None, RobustWeightedLM(1)),
    "RANSAC": create_solver("p3p-ransac"),
}


#: Mostly none that a graph can have: each that is made takes seconds.
PAIRS = st.sampled_from([None, 6, 6.0, 12, 0, 1, 2, -1, True, 0.5, math.nan, "6"])


@pytest.mark.slow
def test_programs_of_any_number_of_pairs():
    made = Seen()
    export = cache(lambda name, kind, n: export_program(SMALL[name], n))  # True is 1, and 6.0 is 6, but for the kind

    @many(20)
    @given(st.sampled_from(sorted(SMALL)), PAIRS, st.data())
    def run(name, n, data):
        program = made(lambda: export(name, type(n), n))
        if program is None:
            return
        (world, img, camera), *_ = data.draw(batches(6 if name == "network" else n).filter(lambda case: case[3]))
        inputs = [x.detach().float().contiguous() for x in (world, img, camera, torch.ones_like(world[..., 0]))]
        with torch.no_grad():
            same(program.module()(*inputs), SMALL[name](*inputs)[:5])

    run()
    made.both()


@pytest.mark.slow
def test_models_of_any_number_of_pairs(tmp_path):
    pytest.importorskip("onnxscript", reason="needs onnxscript")
    made = Seen()
    path = tmp_path / "solver.onnx"

    @many(30, times=1)
    @given(st.sampled_from(sorted(SMALL)), PAIRS)
    def run(name, n):
        path.write_bytes(b"old")
        if made(lambda: export_onnx(SMALL[name], path, n)) is None:
            assert path.read_bytes() == b"old"
        else:
            assert path.stat().st_size > 1000
        assert [*tmp_path.iterdir()] == [path]

    run()
    made.both(1)
