"""Solvers of other libraries keep the contract of our solvers."""

import sys

import numpy as np
import pytest
import torch
from helpers import assert_same, reprojection_errors
from kornia.core.exceptions import BaseError
from laws import OPENCV, PEERS

from kornia_pnpnet import create_solver, pose_errors, success
from kornia_pnpnet.core.extras import needs
from kornia_pnpnet.core.trees import iter_tensors
from kornia_pnpnet.peers import KorniaRs, OpenCVPnP, OpenCVRansac, PeerPose, PeerSolver, PoseLib, PyColmap

pytest.importorskip("cv2")


def test_the_cause_of_a_failed_import_is_named():
    with pytest.raises(ImportError, match="libGL"), needs("eval", "needs OpenCV"):
        raise ImportError("libGL.so.1: cannot open shared object file")


ROBUST = tuple(name for name in PEERS if name not in OPENCV)
FEW, FOUR = {"min_iterations": 2, "max_iterations": 4}, {"max_iterations": 4}
#: Options of which both are sound and have other results.
PAIRS = [(name, *({"seed": x, **FEW} for x in (0, 1))) for name in ("poselib", "pycolmap")]
PAIRS += [("kornia-rs", *({"seed": x, **FOUR} for x in (0, 1)))]
PAIRS += [("kornia-rs", *({"method": x, **FOUR} for x in ("AP3P", "EPnP")))]
PAIRS += [("poselib", *({"progressive_sampling": x, **FEW} for x in (False, True)))]
PAIRS += [("pycolmap", {"loss_scale": 0.1}, {"loss_scale": 100.0})]
PAIRS += [(name, {"threshold": 3.0}, {"threshold": np.int64(100)}) for name in ROBUST]


def make(name: str, **options) -> PeerSolver:
    try:
        return create_solver(name, **options)
    except ImportError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("n", [4, 9])
@pytest.mark.parametrize("name", PEERS)
def test_clean_problems_are_solved_exactly(name, n, make_problems):
    problems = make_problems(n=n, batch=20, noise=False)
    result = make(name, **({} if name in OPENCV else {"threshold": 1.0}))(*problems[:3])
    errors = pose_errors(result.pose, problems.pose)
    exact = (errors.rotation_error_deg < 1e-3) & (errors.translation_error < 1e-3)
    assert result.ok.all()
    # Of four pairs OpenCV's EPnP finds the pose of every fifth problem, SQPnP and USAC miss few.
    assert exact.double().mean() >= ({"opencv-epnp": 0.1}.get(name, 0.9) if n == 4 else 1.0)
    assert (result.weights[exact] == 1).all()
    assert result.cost[exact].max() < 1e-4  # USAC computes in float32


@pytest.mark.parametrize("name", ROBUST)
def test_outliers_are_rejected(name, make_problems):
    problems = make_problems(batch=50, outliers=3, noise=False)
    result = make(name, threshold=2.0)(*problems[:3])
    solved = success(pose_errors(result.pose, problems.pose))
    assert solved.double().mean() > 0.95
    assert torch.equal(result.weights[solved] == 1, problems.inliers[solved])


@pytest.mark.parametrize("name", PEERS)
def test_cost_is_the_mean_squared_error_truncated_at_the_threshold(name, make_problems):
    problems, solver = make_problems(batch=20, outliers=1), make(name)
    result = solver(*problems[:3])
    squared = reprojection_errors(problems, result.pose).square().sum(-1).clamp(max=solver.threshold**2)
    seen = problems._replace(pose=result.pose).true_cam_points[..., 2] > 0
    picked = result.ok & seen.all(-1)  # a peer may put points behind the camera
    assert picked.sum() > 5
    torch.testing.assert_close(result.cost[picked], squared.mean(-1)[picked])
    assert name in ROBUST or (result.weights[picked] == 1).all()


def test_refining_keeps_the_ransac_pose_as_init(make_problems):
    rough, fine = (OpenCVRansac(refine=x)(*make_problems(batch=30)[:3]) for x in (False, True))
    torch.testing.assert_close(rough.pose, rough.init)
    torch.testing.assert_close(fine.init, rough.pose)
    assert not torch.equal(fine.rotation, fine.init.rotation)
    assert (fine.cost <= rough.cost).double().mean() > 0.9


@pytest.mark.parametrize("name", PEERS)
def test_rubbish_of_any_size_neither_raises_nor_comes_back_infinite(name, generator):
    world = torch.randn(48, 8, 3, generator=generator, dtype=torch.float64)
    img = 1e3 * torch.randn(48, 8, 2, generator=generator, dtype=torch.float64)
    world[::2] *= 10.0 ** torch.randint(-200, 200, (24, 1, 1), generator=generator).double()
    img[::3] *= 10.0 ** torch.randint(-200, 200, (16, 1, 1), generator=generator).double()
    world[::5, :, 2] = 0.0
    world[::7, 1:] = world[::7, :1]
    img[::11] = img[::11, :1]
    world[::13] = world[::13, :1] * torch.arange(8)[:, None]
    present = torch.rand(48, 8, generator=generator) < 0.7
    world[~present], masked = torch.nan, ~present & (torch.arange(8) < 4)  # the rest has the weight 0
    camera = torch.diag(torch.tensor([3400.0, 3400.0, 1.0])).double()
    result = make(name)(world, img, camera, present.double(), ~masked)
    assert result.status.equal(make(name)(world, img, camera, mask=present).status)
    assert all(part.isfinite().all() for part in iter_tensors(result))
    assert (result.weights[~present] == 0).all()
    assert 0 < result.ok.sum() < 48


def test_too_few_pairs_and_a_skew_fail_without_an_error(make_problems):
    skewed = make_problems(batch=4).map(torch.clone)
    skewed.intrinsics[2, 0, 1] = 5.0
    assert OpenCVRansac()(*skewed[:3]).ok.tolist() == [True, True, False, True]
    assert not OpenCVRansac()(*make_problems(n=3, batch=4)[:3]).ok.any()


@pytest.mark.parametrize(("name", "one", "other"), PAIRS)
def test_options_reach_the_library(name, one, other, make_problems):
    problems = make_problems(n=40, batch=20, outliers=20)
    first, second = (make(name, **options)(*problems[:3]) for options in (one, other))
    assert (first.rotation != second.rotation).flatten(1).any(-1).double().mean() > 0.5
    assert "threshold" not in one or first.weights.sum() < 0.7 * second.weights.sum()


def test_results_have_no_gradient_and_problems_may_share_a_camera(make_problems):
    problems = make_problems(batch=4)
    world = problems.world_points.clone().requires_grad_()
    result = OpenCVRansac()(world, problems.img_points, problems.intrinsics[0])
    assert not any(part.requires_grad for part in iter_tensors(result))
    assert torch.equal(result.probability, result.ok.double())
    assert_same(result, OpenCVRansac()(*problems[:3]))


def test_options_that_poselib_would_ignore_are_an_error(monkeypatch):
    poselib = pytest.importorskip("poselib")
    monkeypatch.setattr(poselib, "RansacOptions", lambda: {"max_iterations": 1, "success_prob": 0.9, "seed": 0})
    with pytest.raises(BaseError, match="max_reproj_error"):
        PoseLib()


@pytest.mark.parametrize("peer", [OpenCVPnP, KorniaRs, PoseLib, PyColmap])
def test_without_the_library_the_error_names_the_extra(peer, monkeypatch):
    monkeypatch.setitem(sys.modules, peer.source[0], None)
    with pytest.raises(ImportError, match=r"pip install '\.\[eval\]'"):
        peer()


@pytest.mark.parametrize("name", PEERS)
def test_config_rebuilds_the_solver(name):
    changed = {"method": "ITERATIVE"} if name in OPENCV else {"threshold": np.int64(7), "seed": 5}
    solver = make(name, **changed)
    config = solver.config()
    assert changed.items() <= config.items()
    assert type(solver)(**config).config() == config
    assert {type(x) for x in config.values()} <= {int, float, str, bool}


class _Other(PeerSolver):
    """Give up on the second call, return NaN on the third, and put all points behind the camera on the fourth."""

    calls = 0

    def solve_one(self, world_points, img_points, intrinsics):
        self.calls += 1
        if self.calls == 2:
            return None
        shift = np.array([1.0, 2.0, {3: np.nan, 4: -1e4}.get(self.calls, 3.0)])
        return PeerPose(np.eye(3), shift, np.ones(len(world_points), dtype=bool), (np.eye(3), np.zeros(3)))


def test_another_peer_only_solves_one_problem(make_problems):
    result = _Other(threshold=1.0)(*make_problems(batch=4)[:3])
    assert result.ok.tolist() == [True, False, False, True]
    assert result.translation.tolist() == [[1, 2, 3], [0, 0, 0], [0, 0, 0], [1, 2, -1e4]]
    assert result.cost[3] == 1.0  # every error is truncated at the threshold
