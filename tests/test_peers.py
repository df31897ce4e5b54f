"""Peers keep the contract of our solvers, whatever the library behind them does."""

from __future__ import annotations

import math
import sys
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from kornia.core.exceptions import BaseError, ShapeError, TypeCheckError
from strategies import batches, check, many

from kornia_pnpnet import create_solver, pose_errors, success, success_rate
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.peers import OpenCVPnP, OpenCVRansac, OpenCVUsac, PeerPose, PeerSolver, PoseLib, PyColmap
from kornia_pnpnet.types import PnPResult, Problems

pytest.importorskip("cv2")

#: Every peer: how to make it, and the module that it needs.
PEERS = {
    "opencv-sqpnp": (OpenCVPnP, "cv2"),
    "opencv-epnp": (partial(OpenCVPnP, method="EPNP"), "cv2"),
    "opencv-ransac": (OpenCVRansac, "cv2"),
    "opencv-usac": (OpenCVUsac, "cv2"),
    "poselib": (PoseLib, "poselib"),
    "pycolmap": (PyColmap, "pycolmap"),
}
NOT_ROBUST = ("opencv-sqpnp", "opencv-epnp")
ROBUST = tuple(name for name in PEERS if name not in NOT_ROBUST)


def make(name: str, **options) -> PeerSolver:
    factory, module = PEERS[name]
    pytest.importorskip(module)
    return factory(**options)


def solve(solver, problems: Problems, **extra) -> PnPResult:
    return solver(problems.world_points, problems.img_points, problems.intrinsics, **extra)


def assert_same(a: PnPResult, b: PnPResult) -> None:
    torch.testing.assert_close((*a[:5], *a.init), (*b[:5], *b.init), rtol=0, atol=0)


@pytest.mark.parametrize("n", [4, 6, 9, 50])
@pytest.mark.parametrize("name", PEERS)
def test_clean_problems_are_solved_exactly(name, n, make_problems):
    problems = make_problems(n=n, batch=20, noise=False)
    result = solve(make(name, **({} if name in NOT_ROBUST else {"threshold": 1.0})), problems)
    errors = pose_errors(result.pose, problems.pose)
    exact = (errors.rotation_error_deg < 1e-3) & (errors.translation_error < 1e-3)
    assert result.ok.all()
    # Of four pairs OpenCV's EPnP finds the pose of every fifth problem, SQPnP and USAC miss few.
    share = {"opencv-epnp": 0.1}.get(name, 0.9) if n == 4 else 1.0
    assert exact.double().mean() >= share
    assert (result.weights[exact] == 1).all()
    assert result.cost[exact].max() < 1e-4  # USAC computes in float32


@pytest.mark.parametrize("name", ROBUST)
def test_outliers_are_rejected(name, make_problems):
    problems = make_problems(batch=50, outliers=3, noise=False)
    result = solve(make(name, threshold=2.0), problems)
    solved = success(pose_errors(result.pose, problems.pose))
    assert solved.double().mean() > 0.95
    assert torch.equal(result.weights[solved] == 1, problems.inliers[solved])


@pytest.mark.parametrize("name", NOT_ROBUST)
def test_non_robust_peers_keep_every_pair_at_its_full_cost(name, make_problems):
    problems = make_problems(batch=20, outliers=1)
    result = solve(make(name), problems)
    in_front = ((problems.world_points @ result.rotation.mT)[..., 2] + result.translation[:, None, 2] > 0).all(-1)
    picked = result.ok & in_front
    assert picked.sum() > 5
    assert (result.weights[picked] == 1).all()
    cam = problems.world_points @ result.rotation.mT + result.translation[:, None]
    squared = (3400.0 * cam[..., :2] / cam[..., 2:] - problems.img_points).square().sum(-1)
    torch.testing.assert_close(result.cost[picked], squared.mean(-1)[picked])


def test_cost_is_the_truncated_mean_squared_error(make_problems):
    problems = make_problems(batch=10, outliers=3)
    threshold = 40.0
    result = solve(OpenCVRansac(threshold=threshold), problems)
    cam = problems.world_points @ result.rotation.mT + result.translation[:, None]
    pixels = 3400.0 * cam[..., :2] / cam[..., 2:]
    squared = (pixels - problems.img_points).square().sum(-1)
    squared = torch.where(cam[..., 2] > 0, squared, torch.inf).clamp(max=threshold**2)
    torch.testing.assert_close(result.cost, squared.mean(-1))


# Measured on 5000 problems each (no outliers, k uniform, exactly 3) of the seeds 8000, 8001 and 8002.
@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("opencv-sqpnp", (0.906, 0.229, 0.0)),
        ("opencv-epnp", (0.828, 0.205, 0.0)),
        ("opencv-ransac", (0.848, 0.775, 0.674)),
        ("opencv-usac", (0.894, 0.820, 0.701)),
        ("poselib", (0.852, 0.778, 0.677)),
        ("pycolmap", (0.851, 0.776, 0.675)),
    ],
)
def test_protocol_success_is_what_was_measured_before(name, expected):
    pytest.importorskip(PEERS[name][1])
    solver = create_solver(name)
    for mix, rate in zip((OutlierMix(count=0), OutlierMix(), OutlierMix(count=3)), expected, strict=True):
        problems = SyntheticProblems(batch_size=300, seed=78, outliers=mix).batch(0)
        measured = success_rate(success(pose_errors(solve(solver, problems).pose, problems.pose)))
        assert measured.low - 0.03 < rate < measured.high + 0.03


def test_refining_keeps_the_ransac_pose_as_init(make_problems):
    problems = make_problems(batch=30)
    rough, fine = solve(OpenCVRansac(refine=False), problems), solve(OpenCVRansac(), problems)
    torch.testing.assert_close(rough.pose, rough.init)
    torch.testing.assert_close(fine.init, rough.pose)
    assert not torch.equal(fine.rotation, fine.init.rotation)
    assert (fine.cost <= rough.cost).double().mean() > 0.9


@pytest.mark.parametrize("name", [name for name in PEERS if name != "opencv-ransac"])
def test_peers_that_do_not_say_their_first_pose_repeat_the_result(name, make_problems):
    result = solve(make(name), make_problems(batch=5))
    assert result.ok.any()
    torch.testing.assert_close(result.init, result.pose, rtol=0, atol=0)


@pytest.mark.parametrize("name", PEERS)
def test_bad_problems_fail_alone(name, make_problems):
    problems = make_problems(batch=12)
    solver = make(name)
    good = solve(solver, problems)
    world, img, intrinsics = (part.clone() for part in problems[:3])
    world[0, 3, 1] = torch.nan
    img[1, 0, 0] = torch.inf
    intrinsics[2, 0, 0] = torch.nan
    intrinsics[3, 1, 1] = -1.0
    intrinsics[4, 0, 1] = 5.0
    world[5] = world[5, :1]
    world[6] = 1e300
    img[7] = 0.0
    result = solver(world, img, intrinsics)
    bad = torch.arange(12) < 5
    assert not result.ok[bad].any()
    assert name == "opencv-epnp" or not result.ok[5:7].any()  # OpenCV's EPnP finds a pose of any points
    assert torch.equal(result.rotation[bad], torch.eye(3, dtype=torch.float64).expand(5, 3, 3))
    assert (result.translation[bad] == 0).all()
    assert (result.weights[bad] == 0).all()
    assert all(part.isfinite().all() for part in (*result[:4], *result.init))
    alone = slice(8, None)
    assert result.ok[alone].all()
    for mine, theirs in zip(result[:4], good[:4], strict=True):
        assert torch.equal(mine[alone], theirs[alone])


@pytest.mark.parametrize("name", PEERS)
def test_rubbish_of_any_size_neither_raises_nor_comes_back_infinite(name, generator):
    count = 48
    world = torch.randn(count, 8, 3, generator=generator, dtype=torch.float64)
    img = 1e3 * torch.randn(count, 8, 2, generator=generator, dtype=torch.float64)
    powers = torch.randint(-200, 200, (2, count, 1, 1), generator=generator)
    world[::2] *= 10.0 ** powers[0, ::2].double()
    img[::3] *= 10.0 ** powers[1, ::3].double()
    world[::5, :, 2] = 0.0
    world[::7, 1:] = world[::7, :1]
    img[::11] = img[::11, :1]
    world[::13] = world[::13, :1] * torch.arange(8)[:, None]
    present = torch.rand(count, 8, generator=generator) < 0.7
    result = make(name)(world, img, torch.diag(torch.tensor([3400.0, 3400.0, 1.0])).double(), mask=present)
    assert all(part.isfinite().all() for part in (*result[:4], *result.init))
    assert (result.weights[~present] == 0).all()
    assert 0 < result.ok.sum() < count


def test_three_pairs_are_too_few_for_opencv_but_no_error(make_problems):
    assert not solve(OpenCVRansac(), make_problems(n=3, batch=4)).ok.any()


@pytest.mark.parametrize("name", PEERS)
def test_absent_pairs_do_not_matter(name, make_problems):
    solver = make(name)
    problems = make_problems(n=12, batch=5)
    first = problems._replace(world_points=problems.world_points[:, :9], img_points=problems.img_points[:, :9])
    expected = solve(solver, first)
    absent = torch.arange(12).expand(5, 12) >= 9
    spoilt = problems._replace(world_points=problems.world_points.masked_fill(absent[..., None], torch.nan))
    masked = solve(solver, spoilt, mask=~absent)
    weighted = solve(solver, problems, weights=torch.where(absent, 0.0, 0.3).double())
    for result in (masked, weighted):
        assert (result.weights[absent] == 0).all()
        assert_same(result._replace(weights=result.weights[:, :9]), expected)


def test_negative_or_nan_weights_fail_their_problem(make_problems):
    problems = make_problems(batch=3)
    weights = torch.ones(3, 9, dtype=torch.float64)
    weights[0, 2], weights[1, 4] = -1.0, torch.nan
    assert solve(OpenCVRansac(), problems, weights=weights).ok.tolist() == [False, False, True]


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("opencv-ransac", {"seed": 3, "iterations": 20}),
        ("opencv-ransac", {"seed": 3, "iterations": 20, "method": "SQPNP"}),
        ("opencv-usac", {}),
        ("opencv-usac", {"method": "USAC_MAGSAC"}),
        ("opencv-sqpnp", {}),
        ("poselib", {"min_iterations": 5, "max_iterations": 20}),
        ("pycolmap", {"min_iterations": 5, "max_iterations": 20}),
    ],
)
def test_results_do_not_depend_on_what_was_solved_before(name, options, make_problems):
    problems = make_problems(batch=20, outliers=3)
    solver = make(name, **options)
    together = solve(solver, problems)
    assert_same(solve(solver, problems), together)
    last = Problems(*(part[-1:] for part in problems[:3]), problems.pose, problems.inliers)
    alone = solve(solver, last)
    assert torch.equal(alone.rotation, together.rotation[-1:])


@pytest.mark.parametrize("name", ["poselib", "pycolmap"])
def test_the_seed_reaches_the_library(name, make_problems):
    problems = make_problems(n=40, batch=20, outliers=20)
    few = {"min_iterations": 2, "max_iterations": 4}
    results = [solve(make(name, seed=seed, **few), problems) for seed in (0, 1)]
    assert not torch.equal(results[0].rotation, results[1].rotation)


@pytest.mark.parametrize("name", ROBUST)
def test_the_threshold_reaches_the_library(name, make_problems):
    problems = make_problems(n=30, batch=5)
    kept = [solve(make(name, threshold=threshold), problems).weights.sum() for threshold in (3.0, 100.0)]
    assert kept[0] < 0.7 * kept[1]


def test_the_loss_scale_reaches_pycolmap(make_problems):
    problems = make_problems(batch=5)
    narrow, wide = (solve(make("pycolmap", loss_scale=scale), problems) for scale in (0.1, 100.0))
    assert (narrow.rotation != wide.rotation).any(-1).any(-1).all()


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
    ("name", "options", "message"),
    [
        ("opencv-sqpnp", {"method": "NOPE"}, "SOLVEPNP_NOPE"),
        ("opencv-ransac", {"threshold": 0.0}, "threshold"),
        ("opencv-ransac", {"threshold": math.inf}, "threshold"),
        ("opencv-ransac", {"iterations": 0}, "iterations"),
        ("opencv-ransac", {"iterations": True}, "iterations"),
        ("opencv-ransac", {"confidence": 1.0}, "confidence"),
        ("opencv-ransac", {"seed": -1}, "seed"),
        ("opencv-ransac", {"refine": 1}, "refine"),
        ("opencv-ransac", {"method": "NOPE"}, "SOLVEPNP_NOPE"),
        ("opencv-usac", {"method": "USAC_NOPE"}, "USAC_NOPE"),
        ("opencv-usac", {"method": "USAC_FM_8PTS"}, "USAC_FM_8PTS"),
        ("opencv-usac", {"method": "SOLVEPNP_EPNP"}, "SOLVEPNP_EPNP"),
        ("opencv-usac", {"iterations": 1.5}, "iterations"),
        ("poselib", {"threshold": -1.0}, "threshold"),
        ("poselib", {"min_iterations": 0}, "min_iterations"),
        ("poselib", {"confidence": 0.0}, "confidence"),
        ("pycolmap", {"loss_scale": 0.0}, "loss_scale"),
        ("pycolmap", {"max_iterations": 50}, "max_iterations"),
    ],
)
def test_bad_arguments_say_which(name, options, message):
    with pytest.raises(BaseError, match=message):
        make(name, **options)


def test_poselib_ignores_options_it_does_not_know_so_we_do_not(monkeypatch):
    poselib = pytest.importorskip("poselib")
    monkeypatch.setattr(poselib, "RansacOptions", lambda: {"max_iterations": 1, "success_prob": 0.9, "seed": 0})
    with pytest.raises(BaseError, match="max_reproj_error"):
        PoseLib()


def test_other_methods_by_name(make_problems):
    problems = make_problems(batch=5, noise=False)
    solvers = (OpenCVRansac(method="SQPNP", threshold=1.0), OpenCVUsac(method="USAC_DEFAULT", threshold=1.0))
    for solver in (*solvers, OpenCVPnP(method="ITERATIVE")):
        assert pose_errors(solve(solver, problems).pose, problems.pose).rotation_error_deg.max() < 1e-3


@pytest.mark.parametrize("name", PEERS)
def test_without_the_library_the_error_names_the_extra(name, monkeypatch):
    factory, module = PEERS[name]
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=r"pip install 'kornia_pnpnet\[eval\]'"):
        factory()


@pytest.mark.parametrize("name", PEERS)
def test_config_rebuilds_the_solver(name):
    changed = {"method": "ITERATIVE"} if name in NOT_ROBUST else {"threshold": 7.0, "seed": 5}
    solver = make(name, **changed)
    config = solver.config()
    assert changed.items() <= config.items()
    assert type(solver)(**config).config() == config
    assert ", ".join(f"{key}={value!r}" for key, value in config.items()) in repr(solver)


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


# -- whatever comes in -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["opencv-ransac", "poselib"])
def test_peers_take_anything(name):
    solver = create_solver(name)

    @many(25)
    @given(batches())
    def run(case):
        inputs, mask, weights, kinds = case
        # Of points on a line they may say what they like.
        kinds = ["nothing" if kind in ("one point", "a line") else kind for kind in kinds]
        check(solver(*inputs, weights=weights, mask=mask), inputs, kinds)

    run()
