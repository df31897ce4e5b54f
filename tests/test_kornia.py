"""Cameras, groups and the DLT of Kornia beside ours; the patch for Kornia passes its tests, and its page is true."""

import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import kornia
import pytest
import torch
import upstream
from kornia.core.exceptions import ShapeError
from kornia.geometry import solve_pnp_dlt
from kornia.geometry.camera.perspective import project_points

from kornia_pnpnet import PnPNet, Pose, create_solver, depth_points, pose_covariance, registry, solve_pnp
from kornia_pnpnet.data import CameraProblems
from kornia_pnpnet.problem import Problem, State
from kornia_pnpnet.refine.residual import project

REPO = Path(__file__).resolve().parents[1]
PATCHES = sorted((REPO / "docs" / "upstream").glob("*.patch"))
INSTALLED = Path(kornia.__file__).parent
CHANGED = Path("kornia") / "geometry" / "calibration"

# What Kornia's tests need of its repository and the wheel does not have, in our words.
CONFTEST = """
import pytest
import torch

@pytest.fixture
def device():
    return torch.device("cpu")

@pytest.fixture(params=[torch.float32, torch.float64], ids=str)
def dtype(request):
    return request.param

@pytest.fixture
def torch_optimizer():
    return lambda function: torch.compile(function, fullgraph=True, backend="eager")

@pytest.fixture(autouse=True)
def names_of_doctests(doctest_namespace):
    doctest_namespace["torch"] = torch
"""
BASE = """
import torch

class BaseTester:
    def assert_close(self, actual, expected, rtol=1e-4, atol=1e-5):
        torch.testing.assert_close(actual, expected, rtol=rtol, atol=atol)

    def gradcheck(self, function, inputs):
        assert torch.autograd.gradcheck(function, [x.double().requires_grad_() for x in inputs], fast_mode=True)
"""


def run(folder, *command, **environment):
    options = {"cwd": folder, "env": {**os.environ, **environment}, "capture_output": True, "text": True}
    done = subprocess.run(command, check=False, **options)
    assert done.returncode == 0, (done.stderr + done.stdout)[-4000:]
    return done.stdout


def apply(folder):
    """Apply the patches in ``folder``; the wheel has no documentation."""
    # Inside a repository git would look for the paths from its top.
    run(folder, "git", "apply", "--exclude=docs/*", *map(str, PATCHES), GIT_CEILING_DIRECTORIES=str(folder.parent))


def test_patch_applies_to_the_installed_kornia_and_its_page_is_written_from_the_file(tmp_path):
    shutil.copytree(INSTALLED / "geometry" / "calibration", tmp_path / CHANGED)
    apply(tmp_path)
    assert (tmp_path / CHANGED / "pnp_robust.py").exists()
    assert "solve_pnp_robust" in (tmp_path / CHANGED / "__init__.py").read_text()
    results = json.loads((REPO / "benchmarks" / "upstream.json").read_text())
    assert upstream.page(results) in (REPO / "docs" / "upstream.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_tests_of_the_patch_pass_in_the_patched_kornia(tmp_path):
    shutil.copytree(INSTALLED, tmp_path / "kornia", ignore=shutil.ignore_patterns("__pycache__"))
    apply(tmp_path)
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "testing").mkdir()
    (tmp_path / "testing" / "base.py").write_text(BASE)
    command = [sys.executable, "-m", "pytest", "-q", "--doctest-modules", "tests", str(CHANGED / "pnp_robust.py")]
    assert "skipped" not in run(tmp_path, *command, PYTHONPATH=str(tmp_path))


@pytest.mark.slow
def test_patch_is_measured_beside_the_others():
    pytest.importorskip("cv2")
    rows = {row["solver"]: row for row in upstream.measure_success(20, ((12, 0.25),))}
    assert rows["solve_pnp_robust"]["success"] > 0.9
    assert rows["solve_pnp_dlt"]["success"] < 0.5
    assert all(row["us"] > 0 for row in upstream.measure_batches((2,)))
    assert all(row["last"] < row["first"] for row in upstream.measure_descent(4, (0.0,)))


def cameras(intrinsics):
    """Cameras of Kornia anywhere: where they are must not matter."""
    eye = torch.eye(3, dtype=intrinsics.dtype).expand(len(intrinsics), 3, 3)
    return Pose(eye, torch.full_like(eye[:, 0], 5.0)).camera(intrinsics, height=7, width=7)


def test_covariances_and_first_guesses_take_cameras_and_one_camera_serves_three_problems(make_problems):
    p, solver = make_problems(batch=5), create_solver("epnp")
    expected = pose_covariance(p.pose, *p[:3], img_sigma=1.0)
    assert pose_covariance(p.pose, *p[:2], cameras(p.intrinsics), img_sigma=1.0).equal(expected)
    result, _ = PnPNet(None).with_starts(*p[:2], cameras(p.intrinsics), init=p.pose)
    assert result.matrix.equal(PnPNet(None)(*p[:3], init=p.pose).matrix)
    three = p.world_points[:3], p.img_points[:3]  # as many problems as the matrix of a camera has rows
    assert solver(*three, cameras(p.intrinsics[:1])).matrix.equal(solver(*three, p.intrinsics[0]).matrix)
    with pytest.raises(ShapeError, match="intrinsics"):
        solver(*three, cameras(p.intrinsics[:2]))


def test_poses_as_elements_of_kornias_group(make_problems):
    p = make_problems(batch=5)
    translation = p.pose.translation.clone().requires_grad_()
    element = p.pose._replace(translation=translation).se3
    torch.testing.assert_close(element.matrix(), p.pose.matrix, rtol=1e-12, atol=1e-12)
    element.inverse().t.sum().backward()
    torch.testing.assert_close(translation.grad, -p.pose.rotation.sum(-1), rtol=1e-9, atol=1e-9)


def test_cameras_at_a_pose_project_as_we_do(make_problems):
    p = make_problems(n=9, batch=5, noise=False)
    for intrinsics in (p.intrinsics, 2.0 * p.intrinsics, cameras(p.intrinsics)):
        camera = p.pose.camera(intrinsics, height=480, width=640)
        seen = camera.project(p.world_points[:, :1])[:, 0]
        torch.testing.assert_close(seen, p.img_points[:, 0], rtol=1e-9, atol=1e-6)
        assert (camera.extrinsics.equal(p.pose.matrix), camera.camera_matrix.equal(p.intrinsics)) == (True, True)
    assert camera.height.tolist() == [7.0] * 5  # that of the camera that came
    shared = p.pose.camera(p.intrinsics[0].float(), height=480, width=640)
    assert (shared.intrinsics.dtype, shared.intrinsics.shape) == (torch.float64, (5, 4, 4))
    assert shared.width.tolist() == [640.0] * 5
    nested = Pose(*(x[None] for x in p.pose))  # Kornia's cameras are one batch
    assert nested.camera(camera).extrinsics.equal(camera.extrinsics)
    depth = {"depth": torch.ones(1, 5, 9), "depth_sigma": 0.1, "pose": nested}
    lifted = [depth_points(p.img_points[None], intrinsics=x, **depth) for x in (p.intrinsics[None], camera)]
    torch.testing.assert_close(*lifted)


def test_solve_pnp_returns_what_kornias_dlt_does(make_problems):
    p = make_problems(n=12, batch=5, noise=False)
    torch.testing.assert_close(solve_pnp(*p[:3]), solve_pnp_dlt(*p[:3]), rtol=1e-4, atol=1e-4)
    matrix = solve_pnp(*p[:2], cameras(p.intrinsics), torch.ones_like(p.img_points[..., 0]), solver="epnp-lm")
    torch.testing.assert_close(matrix, p.pose.matrix[:, :3], rtol=1e-6, atol=1e-6)


def test_solve_pnp_marks_what_it_cannot_solve(make_problems):
    p = make_problems(n=9, batch=4)
    world = p.world_points.clone()
    world[1, 2] = torch.nan
    pixels = p.img_points.clone().requires_grad_()
    registry._on_device.cache_clear()
    assert torch.func.grad(lambda x: solve_pnp(p.world_points, x, p.intrinsics).sum())(p.img_points).isfinite().all()
    registry._on_device.cache_clear()
    torch.inference_mode()(solve_pnp)(*p[:3])  # makes the solver that later calls share
    matrix = solve_pnp(world, pixels, p.intrinsics)
    assert matrix.isnan().all((1, 2)).tolist() == [False, True, False, False]
    assert matrix[0].equal(solve_pnp(p.world_points, p.img_points, p.intrinsics)[0])
    matrix[..., 3].nansum().backward()
    assert pixels.grad.isfinite().all()
    assert (pixels.grad.abs().sum((1, 2)) > 0).tolist() == [True, False, True, True]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 9.9e-4, 1.1e-3, 0.1, 1.0, 3.0, math.pi])
def test_rotation_vectors_become_rotations_and_back_with_finite_gradients(angle, dtype, generator):
    axis = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator, dtype=torch.float64), dim=-1)
    vector = (angle * axis).to(dtype).requires_grad_()
    pose = Pose.from_rvec(vector, torch.zeros_like(vector))
    for size in (1e-30, 1e30):
        found = Pose.from_quaternion(size * pose.quaternion, vector).rotation
        torch.testing.assert_close(found, pose.rotation, rtol=0, atol=1e-6)
    back = pose.rvec
    if angle < 3.1:  # at a half turn two vectors give one rotation
        torch.testing.assert_close(back, vector, rtol=0, atol=1e-9 if dtype == torch.float64 else 2e-3)
    assert torch.autograd.grad(back.sum(), vector)[0].isfinite().all()


@pytest.mark.parametrize("cameras", [1, 3])
def test_our_projection_is_kornias(cameras, random_rotations, generator):
    p = CameraProblems(n=5, batch_size=7, seed=0, cameras=cameras, dtype=torch.float64).batch(0)
    if cameras > 1:  # at any turn
        rig = Pose(random_rotations(35).unflatten(0, (7, 5)), p.cam_from_rig.translation)
        in_rig = (rig.rotation.mT @ (p.true_cam_points - rig.translation)[..., None])[..., 0]
        world = (in_rig - p.pose.translation[:, None]) @ p.pose.rotation
        p = p._replace(world_points=world, cam_from_rig=rig)
    zoom = 0.2 * torch.randn(7, 1, generator=generator, dtype=torch.float64) * (cameras == 1)
    problem = Problem.of(p.world_points, torch.zeros_like(p.img_points), 800.0, rig=p.cam_from_rig)
    found = project(State(p.pose, zoom), problem).residual.permute(2, 1, 0)
    intrinsics = torch.diag_embed(torch.cat((zoom, zoom, 0.0 * zoom), 1).exp() * torch.tensor([800.0, 800.0, 1.0]))
    expected = project_points(p.true_cam_points, intrinsics[:, None].expand(7, 5, 3, 3))
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
