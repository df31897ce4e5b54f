"""Peers keep the contract of our solvers, whatever the library behind them does."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from kornia.core.exceptions import BaseError, ShapeError, TypeCheckError

from kornia_pnpnet import create_solver, pose_errors, success, success_rate
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.peers import OpenCVRansac, PeerPose, PeerSolver
from kornia_pnpnet.types import PnPResult, Problems

pytest.importorskip("cv2")


def solve(solver, problems: Problems, **extra) -> PnPResult:
    return solver(problems.world_points, problems.img_points, problems.intrinsics, **extra)


def assert_same(a: PnPResult, b: PnPResult) -> None:
    torch.testing.assert_close((*a[:5], *a.init), (*b[:5], *b.init), rtol=0, atol=0)


@pytest.mark.parametrize("n", [4, 6, 9, 50])
def test_clean_problems_are_solved_exactly(make_problems, n):
    problems = make_problems(n=n, batch=20, noise=False)
    result = solve(OpenCVRansac(threshold=1.0), problems)
    errors = pose_errors(result.pose, problems.pose)
    assert result.ok.all()
    assert errors.rotation_error_deg.max() < 1e-3
    assert errors.translation_error.max() < 1e-3
    assert (result.weights == 1).all()
    assert result.cost.max() < 1e-6


def test_outliers_are_rejected(make_problems):
    problems = make_problems(batch=50, outliers=3, noise=False)
    result = solve(OpenCVRansac(threshold=2.0), problems)
    solved = success(pose_errors(result.pose, problems.pose))
    assert solved.double().mean() > 0.95
    assert torch.equal(result.weights[solved] == 1, problems.inliers[solved])


def test_cost_is_the_truncated_mean_squared_error(make_problems):
    problems = make_problems(batch=10, outliers=3)
    threshold = 40.0
    result = solve(OpenCVRansac(threshold=threshold), problems)
    cam = problems.world_points @ result.rotation.mT + result.translation[:, None]
    pixels = 3400.0 * cam[..., :2] / cam[..., 2:]
    squared = (pixels - problems.img_points).square().sum(-1)
    squared = torch.where(cam[..., 2] > 0, squared, torch.inf).clamp(max=threshold**2)
    torch.testing.assert_close(result.cost, squared.mean(-1))


def test_protocol_success_is_what_was_measured_before():
    source = SyntheticProblems(batch_size=500, seed=78, outliers=OutlierMix())
    problems = source.batch(0)
    rate = success_rate(success(pose_errors(solve(create_solver("opencv-ransac"), problems).pose, problems.pose)))
    assert 0.70 < rate.rate < 0.84


def test_refining_keeps_the_ransac_pose_as_init(make_problems):
    problems = make_problems(batch=30)
    rough, fine = solve(OpenCVRansac(refine=False), problems), solve(OpenCVRansac(), problems)
    torch.testing.assert_close(rough.pose, rough.init)
    torch.testing.assert_close(fine.init, rough.pose)
    assert not torch.equal(fine.rotation, fine.init.rotation)
    assert (fine.cost <= rough.cost).double().mean() > 0.9


def test_bad_problems_fail_alone(make_problems):
    problems = make_problems(batch=12)
    good = solve(OpenCVRansac(), problems)
    world, img, intrinsics = (part.clone() for part in problems[:3])
    world[0, 3, 1] = torch.nan
    img[1, 0, 0] = torch.inf
    intrinsics[2, 0, 0] = torch.nan
    intrinsics[3, 1, 1] = -1.0
    intrinsics[4, 0, 1] = 5.0
    world[5] = world[5, :1]
    world[6] = 1e300
    img[7] = 0.0
    result = OpenCVRansac()(world, img, intrinsics)
    bad = torch.arange(12) < 5
    assert not result.ok[bad].any()
    assert not result.ok[5:7].any()
    assert torch.equal(result.rotation[bad], torch.eye(3, dtype=torch.float64).expand(5, 3, 3))
    assert (result.translation[bad] == 0).all()
    assert (result.weights[bad] == 0).all()
    assert all(part.isfinite().all() for part in (*result[:4], *result.init))
    alone = slice(8, None)
    assert result.ok[alone].all()
    for mine, theirs in zip(result[:4], good[:4], strict=True):
        assert torch.equal(mine[alone], theirs[alone])


def test_three_pairs_are_too_few_for_opencv_but_no_error(make_problems):
    assert not solve(OpenCVRansac(), make_problems(n=3, batch=4)).ok.any()


def test_absent_pairs_do_not_matter(make_problems):
    problems = make_problems(n=12, batch=5)
    first = problems._replace(world_points=problems.world_points[:, :9], img_points=problems.img_points[:, :9])
    expected = solve(OpenCVRansac(), first)
    absent = torch.arange(12).expand(5, 12) >= 9
    spoilt = problems._replace(world_points=problems.world_points.masked_fill(absent[..., None], torch.nan))
    masked = solve(OpenCVRansac(), spoilt, mask=~absent)
    weighted = solve(OpenCVRansac(), problems, weights=torch.where(absent, 0.0, 0.3).double())
    for result in (masked, weighted):
        assert (result.weights[absent] == 0).all()
        assert_same(result._replace(weights=result.weights[:, :9]), expected)


def test_negative_or_nan_weights_fail_their_problem(make_problems):
    problems = make_problems(batch=3)
    weights = torch.ones(3, 9, dtype=torch.float64)
    weights[0, 2], weights[1, 4] = -1.0, torch.nan
    assert solve(OpenCVRansac(), problems, weights=weights).ok.tolist() == [False, False, True]


@pytest.mark.parametrize("method", ["AP3P", "SQPNP"])
def test_results_do_not_depend_on_what_was_solved_before(make_problems, method):
    problems = make_problems(batch=20, outliers=3)
    solver = OpenCVRansac(seed=3, method=method, iterations=20)
    together = solve(solver, problems)
    assert_same(solve(solver, problems), together)
    last = Problems(*(part[-1:] for part in problems[:3]), problems.pose, problems.inliers)
    alone = solve(solver, last)
    assert torch.equal(alone.rotation, together.rotation[-1:])


def test_dtype_gradients_and_shared_camera(make_problems):
    problems = make_problems(batch=4, dtype=torch.float32)
    world = problems.world_points.clone().requires_grad_()
    result = OpenCVRansac()(world, problems.img_points, problems.intrinsics[0])
    assert all(part.dtype == torch.float32 for part in (*result[:4], *result.init))
    assert result.ok.dtype == torch.bool
    assert not any(part.requires_grad for part in (*result[:5], *result.init))
    assert_same(result, solve(OpenCVRansac(), problems))
    failed = OpenCVRansac()(world.detach() * torch.nan, problems.img_points, problems.intrinsics)
    assert failed.cost.isfinite().all()


def test_inputs_are_checked_at_the_door(make_problems):
    problems = make_problems(batch=4)
    with pytest.raises(ShapeError, match="img_points"):
        OpenCVRansac()(problems.world_points, problems.img_points[:, :5], problems.intrinsics)
    with pytest.raises(TypeCheckError, match="intrinsics"):
        OpenCVRansac()(problems.world_points, problems.img_points, problems.intrinsics.float())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"threshold": 0.0}, "threshold"),
        ({"iterations": 0}, "iterations"),
        ({"confidence": 1.0}, "confidence"),
        ({"method": "NOPE"}, "SOLVEPNP_NOPE"),
    ],
)
def test_bad_arguments_say_which(options, message):
    with pytest.raises(BaseError, match=message):
        OpenCVRansac(**options)


def test_other_methods_by_name(make_problems):
    problems = make_problems(batch=5, noise=False)
    result = solve(OpenCVRansac(method="SQPNP", threshold=1.0), problems)
    assert pose_errors(result.pose, problems.pose).rotation_error_deg.max() < 1e-3


def test_without_opencv_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ImportError, match=r"pip install 'kornia_pnpnet\[eval\]'"):
        OpenCVRansac()


def test_config_rebuilds_the_solver():
    config = OpenCVRansac(threshold=7.0, method="P3P").config()
    assert OpenCVRansac(**config).config() == config
    assert "threshold=7.0" in repr(OpenCVRansac(**config))


class _Other(PeerSolver):
    """A new peer in a few lines: gives up on its second call, returns rubbish on the third."""

    calls = 0

    def solve_one(self, world_points, img_points, intrinsics):
        self.calls += 1
        if self.calls == 2:
            return None
        shift = np.full(3, np.nan) if self.calls == 3 else np.array([1.0, 2.0, 3.0])
        return PeerPose(np.eye(3), shift, np.ones(len(world_points), dtype=bool), np.eye(3), np.zeros(3))


class _Behind(PeerSolver):
    """Puts all points of the tests behind the camera."""

    def solve_one(self, world_points, img_points, intrinsics):
        shift = np.array([0.0, 0.0, -1e4])
        return PeerPose(np.eye(3), shift, np.ones(len(world_points), dtype=bool), np.eye(3), shift)


def test_points_behind_the_camera_cost_the_most(make_problems):
    result = solve(_Behind(threshold=3.0), make_problems(batch=4))
    assert result.ok.all()
    assert (result.cost == 9.0).all()


def test_another_peer_only_solves_one_problem(make_problems):
    result = solve(_Other(threshold=1.0), make_problems(batch=4))
    assert result.ok.tolist() == [True, False, False, True]
    assert result.translation.tolist() == [[1, 2, 3], [0, 0, 0], [0, 0, 0], [1, 2, 3]]
