"""The shipped weights: what they must reach, and that all that is written about them comes from their run."""

import json
from pathlib import Path

import pytest
import torch

from kornia_pnpnet import PnPNet, create_solver, pose_errors, shipped_weights, success, success_rate
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.model import WEIGHTS_FOLDER
from kornia_pnpnet.reports import write_model_card


def rate(solver, problems):
    with torch.no_grad():
        result = solver(problems.world_points, problems.img_points, problems.intrinsics)
    return success_rate(success(pose_errors(result.pose, problems.pose))).rate


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_success_on_the_protocols_data(dtype):
    """10 000 problems that nothing else uses: at least 80 % without outliers, 62 % with k uniform."""
    solver = create_solver("pnpnet-n9")
    none = SyntheticProblems(n=9, batch_size=10_000, seed=555_001, dtype=dtype).batch(0)
    uniform = SyntheticProblems(n=9, batch_size=10_000, seed=555_002, outliers=OutlierMix(), dtype=dtype).batch(0)
    assert rate(solver, none) >= 0.80
    assert rate(solver, uniform) >= 0.62
    first_stage = create_solver("net-n9")
    assert rate(first_stage, none) < rate(solver, none)


def test_sound_problems_are_ok_and_garbage_is_not():
    solver = create_solver("pnpnet-n9")
    problems = SyntheticProblems(n=9, batch_size=2000, seed=555_003).batch(0)
    with torch.no_grad():
        ok = solver(problems.world_points, problems.img_points, problems.intrinsics).ok
        shuffled = problems.img_points.roll(1, 0)  # every pixel belongs to another problem
        garbage = solver(problems.world_points, shuffled, problems.intrinsics).ok
    assert ok.float().mean() > 0.99
    assert garbage.float().mean() < 0.1


def test_net_n9_is_the_first_guess_of_pnpnet_n9():
    problems = SyntheticProblems(n=9, batch_size=50, seed=555_004).batch(0)
    inputs = (problems.world_points, problems.img_points, problems.intrinsics)
    with torch.no_grad():
        net, whole = create_solver("net-n9")(*inputs), create_solver("pnpnet-n9")(*inputs)
    assert torch.equal(net.rotation, net.init.rotation)
    assert torch.equal(net.rotation, whole.init.rotation)
    assert not torch.equal(net.rotation, whole.rotation)


@pytest.mark.parametrize("name", shipped_weights())
def test_model_card_is_generated_from_the_run(name, tmp_path):
    folder = WEIGHTS_FOLDER / name
    results = json.loads((folder / "results.json").read_text())
    write_model_card(tmp_path, results, name=name)
    assert (tmp_path / "README.md").read_text() == (folder / "README.md").read_text()
    model = {"views": 1, **results["model"]}  # the results of pnpnet-n9 are older than views
    assert PnPNet.from_config(model).config() == PnPNet.from_pretrained(name).config()
    updates, run = 0, results
    while run:
        updates, run = updates + run["run"]["update"], run.get("origin")
    assert updates >= 50_000
    assert sum(path.stat().st_size for path in folder.iterdir()) < 2_000_000


def test_results_page_is_generated_from_its_files():
    make = Path(__file__).resolve().parents[1] / "docs" / "results" / "make.py"
    namespace = {"__name__": "make", "__file__": str(make)}
    exec(compile(make.read_text(), make, "exec"), namespace)
    folder = make.parent
    results = {name: namespace["load_results"](folder / f"{name}.json") for name in namespace["RESULTS"]}
    complexity = json.loads((folder / "complexity.json").read_text())
    short_runs = (namespace["read_summary"](folder / f"{name}.csv") for name in ("ablation", "sweep"))
    assert namespace["page"](results, complexity, *short_runs) == (folder / "README.md").read_text()
