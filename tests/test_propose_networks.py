"""Networks: samples, noise, training, layers and rotations. Unknown focal lengths: found, differentiable, honest."""

import math
import os
import platform
import subprocess
import sys

import pytest
import torch
from helpers import assert_same, rate, reprojection_errors
from kornia.core.exceptions import BaseError
from kornia.geometry.calibration import distort_points
from kornia.geometry.conversions import axis_angle_to_rotation_matrix

from kornia_pnpnet import Normalize, PnPNet, Pose, SetInit, SetLoss, create_solver, pose_errors, success
from kornia_pnpnet.covariance import pose_covariance
from kornia_pnpnet.data import CameraProblems, OutlierMix, SyntheticProblems
from kornia_pnpnet.problem import Noise
from kornia_pnpnet.propose.focal import scale_focal
from kornia_pnpnet.propose.mlp import rotation_about
from kornia_pnpnet.refine.lm import RobustWeightedLM
from kornia_pnpnet.refine.residual import retract, rotation_angle

NOISE = {"img_sigma": 1.0, "world_sigma": 0.05}


def solver():
    refine = RobustWeightedLM(4, kernel="geman_mcclure", robustness=6.0)
    return PnPNet(SetInit(), refine, Normalize(order=False), effort="fixed").double().eval()


@pytest.mark.parametrize(("n", "outliers"), [(4, 0), (9, 0), (9, 4), (60, 0), (60, 50)])
def test_samples_of_inliers_have_the_true_pose(n, outliers):
    options = {"max_angle": math.pi, "outliers": OutlierMix(count=outliers), "dtype": torch.float64}
    p = SyntheticProblems(n=n, batch_size=50, seed=1, img_sigma=0.0, world_sigma=0.0, **options).batch(0)
    _, guess = solver().with_starts(*p[:3], mask=p.inliers, img_sigma=0.1, world_sigma=0.001)
    sampled = Pose(guess.others.rotation[:, -1], guess.others.translation[:, -1])
    assert success(pose_errors(sampled, p.pose), 0.01, 0.01).double().mean() > 0.95


def test_known_noise_is_used_as_it_is_and_unknown_noise_is_estimated(make_problems):
    p = make_problems(n=9, batch=4)
    net = solver()
    sigma = torch.tensor([0.5, torch.nan, 2.0, torch.nan], dtype=torch.float64)
    noise = net.with_starts(*p[:3], img_sigma=sigma)[1].noise
    known = ~sigma.isnan()
    torch.testing.assert_close(noise.img[known], sigma[known, None].expand(-1, 9))
    assert noise.img.isfinite().all()
    assert ((noise.world > 0) & noise.world.isfinite()).all()
    torch.testing.assert_close(noise.img[~known], net.with_starts(*p[:3])[1].noise.img[~known])
    of_pairs = torch.rand(4, 9, dtype=torch.float64) + 0.1
    torch.testing.assert_close(net.with_starts(*p[:3], world_sigma=of_pairs)[1].noise.world, of_pairs)
    problem, given = net.normalize(*p[:3])[0], Noise(of_pairs, torch.full_like(of_pairs, torch.nan))
    starts = net.init(problem)
    assert_same(net.refine.begin(problem._replace(noise=given), starts).problem.noise[:2], (of_pairs, starts.noise[1]))


def test_it_learns():
    """In a hundred small steps: any rotation, up to a third of the pairs are outliers."""
    refine = RobustWeightedLM(6, kernel="geman_mcclure", robustness=20.0)
    net = PnPNet(SetInit(width=16, layers=2, hidden=32, samples=0), refine, Normalize(order=False))
    data = SyntheticProblems(n=9, batch_size=200, seed=1, outliers=OutlierMix(), max_angle=math.pi, known_noise=0.5)
    fresh = SyntheticProblems(n=9, batch_size=1000, seed=2, outliers=OutlierMix(), max_angle=math.pi).batch(0)
    loss, optimizer = SetLoss(), torch.optim.Adam(net.parameters(), lr=4e-3)
    before = rate(net(*fresh[:3], **NOISE), fresh)
    for i in range(100):
        p = data.batch(i)
        optimizer.zero_grad()
        result, guess = net.with_starts(*p[:3], **p.sigmas)
        loss(result, p, 1.0, guess).total.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
    assert rate(net(*fresh[:3], **NOISE), fresh) > max(0.65, before + 0.2)


def test_padding_costs_nothing(make_problems):
    p = make_problems(n=60, batch=30, outliers=20)
    counts = torch.tensor([20, 33, 57]).repeat(10)
    mask = torch.rand(30, 60, generator=torch.Generator().manual_seed(0)).argsort(1) < counts[:, None]
    net, shapes = solver(), []
    net.init.register_forward_hook(lambda _module, inputs, _output: shapes.append(inputs[0].weights.shape))
    with torch.no_grad():
        whole = net(*p[:3], mask=mask)
        net.init.pairs_at_once = 400 // torch.get_num_threads()
        parts = net(*p[:3], mask=mask, weights=mask.double(), confidence=mask.double())
    assert shapes[0] == (30, 57)
    assert all(b * n <= 400 for b, n in shapes[1:])
    assert {n for _, n in shapes[1:]} == {20, 33, 57}
    assert_same(parts, whole, 1e-9, 1e-9)
    assert (parts.weights[~mask] == 0).all()


_FAULTS = """
import resource
import torch
from kornia_pnpnet import create_solver
from kornia_pnpnet.core.performance import keep_freed_memory
torch.set_num_threads(1)
keep_freed_memory()
solver, faults = create_solver("pnpnet-set"), []
inputs = torch.randn(1000, 9, 3), torch.randn(1000, 9, 2), torch.eye(3)
with torch.no_grad():
    for _ in range(14):
        faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
        solver(*inputs)
print(faults[13] - faults[3])
"""


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another allocator")
def test_memory_of_a_call_serves_the_next():
    """With `keep_freed_memory`, ten calls ask the system for hardly any pages; else each asks for thousands."""
    plain = {key: value for key, value in os.environ.items() if not key.startswith(("MALLOC_", "LD_PRELOAD", "GLIBC"))}
    done = subprocess.run([sys.executable, "-c", _FAULTS], capture_output=True, text=True, check=True, env=plain)
    assert int(done.stdout) < 2000


def test_padding_changes_nothing_where_the_network_sees_some_pairs(make_problems):
    p = make_problems(n=100, batch=20, outliers=40)
    padded = [torch.nn.functional.pad(x, (0, 0, 0, 30)) for x in p[:2]]
    mask = torch.arange(130).expand(20, 130) < 100
    net = PnPNet.from_pretrained("pnpnet-set").double().eval()
    assert_same(net(*padded, p.intrinsics, mask=mask).pose, net(*p[:3]).pose, 1e-6, 1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_axis_and_angle_turn_as_kornias_rotation_vectors(dtype, generator):
    axis = torch.randn(3, 400, generator=generator, dtype=torch.float64)
    axis *= 10.0 ** torch.linspace(-1, 3, 20, dtype=torch.float64).repeat(20)
    angle = 10.0 * torch.randn(400, generator=generator, dtype=torch.float64)
    angle[:200] *= 10.0 ** torch.linspace(-12, 0, 200, dtype=torch.float64)
    upstream = torch.randn(400, 3, 3, generator=generator, dtype=torch.float64).to(dtype)

    def kornias(axis, angle):
        length = (axis.square().sum(0) + torch.finfo(dtype).eps).sqrt()
        return axis_angle_to_rotation_matrix((axis / length * angle).mT)

    outcomes = []
    for function, at in ((rotation_about, dtype), (kornias, torch.float64)):
        leaves = [x.to(dtype).to(at).requires_grad_() for x in (axis, angle)]
        rotation = function(*leaves)
        by_axis, by_angle = torch.autograd.grad(rotation, leaves, upstream.to(at))
        size = leaves[0].detach().norm(dim=0)  # the gradient by the axis is inverse to it
        outcomes.append([x.to(torch.float64) for x in (rotation, by_axis * size, by_angle)])
    tolerance = 2e-5 if dtype == torch.float32 else 1e-12
    for mine, expected in zip(*outcomes, strict=True):
        torch.testing.assert_close(mine, expected, rtol=tolerance, atol=20 * tolerance)


def draw(n, batch=64, *, wrong=0, spread=0.4, noise=0.0, seed=0, **options):
    """Problems of cameras with fields of view from 18 to 100 degrees."""
    options |= {"outlier_share": wrong / n, "depth_spread": (spread, spread), "img_sigma": noise}
    return CameraProblems(n=n, batch_size=batch, seed=seed, dtype=torch.float64, **options).batch(0)


def withheld(problems):
    return scale_focal(problems.intrinsics, problems.intrinsics[:, 0, 0].reciprocal())


def errors(result, problems):
    focal = result.intrinsics[:, 0, 0] / problems.intrinsics[:, 0, 0] - 1.0
    distance = problems.true_cam_points[..., 2].mean(1)
    shift = (result.translation - problems.pose.translation).norm(dim=-1) / distance
    return focal.abs(), shift, rotation_angle(result.rotation, problems.pose.rotation)


@pytest.mark.parametrize("name", ["p3p-ransac", "pnpnet-set", "epnp-lm", "reppnp-lm", "identity-lm"])
@pytest.mark.parametrize("aspect", [1.0, 1.3])
def test_exact_pairs_give_focal_length_and_pose(name, aspect):
    p, stretch = draw(12), torch.tensor([1.0, aspect, 1.0], dtype=torch.float64)
    p = p._replace(img_points=stretch[:2] * p.img_points, intrinsics=stretch[:, None] * p.intrinsics)
    result = create_solver(name, focal="unknown", **({"m": 30} if name.endswith("lm") else {}))(*p[:2], withheld(p))
    focal, shift, turn = errors(result, p)
    assert ((focal < 1e-3) & (shift < 1e-3) & (turn < 1e-3) & result.ok).double().mean() > 0.95
    assert torch.allclose(result.intrinsics[:, 1, 1] / result.intrinsics[:, 0, 0], p.intrinsics.new_tensor(aspect))
    ignored = p.pose._replace(translation=torch.nan * p.pose.translation)
    result = create_solver(name, focal="unknown")(*p[:2], withheld(p), init=ignored)
    assert result.ok.double().mean() > 0.9


@pytest.mark.parametrize("name", ["p3p-ransac", "pnpnet-set"])
def test_outliers_are_left_out(name):
    p = draw(20, wrong=8, noise=1.0, batch=128)
    result = create_solver(name, focal="unknown")(*p[:2], withheld(p))
    focal, shift, turn = errors(result, p)
    assert ((focal < 0.025) & (shift < 0.025) & (turn < math.radians(0.5)) & result.ok).double().mean() > 0.97
    weights = result.weights / result.weights.amax(1, keepdim=True)
    assert weights[~p.inliers].mean() < 0.02
    assert weights[p.inliers].mean() > 0.4


@pytest.mark.parametrize("name", ["p3p-ransac", "pnpnet-set"])
def test_a_plane_seen_from_the_front_is_not_believed(name):
    """Its distance and the focal length cannot be told apart; with a prior of the focal length they can."""
    p = draw(20, spread=0.0, noise=1.0)
    assert not create_solver(name, focal="unknown")(*p[:2], withheld(p)).ok.any()
    result = create_solver(name, focal="unknown", focal_sigma=0.05)(*p[:3])
    assert result.ok.double().mean() > 0.9
    assert (errors(result, p)[0] < 0.1).all()
    noise = {"img_sigma": 1.0, "focal": "unknown"}
    assert (pose_covariance(p.pose, *p[:3], **noise)[:, 6, 6] > 0.2**2).all()
    assert (pose_covariance(p.pose, *p[:3], **noise, focal_sigma=0.05)[:, 6, 6].sqrt() - 0.05).abs().max() < 0.01
    with pytest.raises(BaseError, match="focal"):
        pose_covariance(p.pose, *p[:3], img_sigma=1.0, focal_sigma=0.1)


def test_the_covariance_has_the_focal_length_last():
    p = draw(40, batch=2000, noise=1.0)
    solver = PnPNet(None, RobustWeightedLM(15, robustness=0.0, damping=1e-6), Normalize(order=False), focal="unknown")
    result = solver(*p[:2], withheld(p))
    covariance = pose_covariance(result.pose, *p[:2], result.intrinsics, img_sigma=1.0, focal="unknown")
    assert covariance.shape == (2000, 7, 7)
    turn = Pose(result.rotation @ p.pose.rotation.mT, result.translation).rvec
    log_focal = (result.intrinsics[:, 0, 0] / p.intrinsics[:, 0, 0]).log()[:, None]
    error = torch.cat((turn, result.translation - p.pose.translation, log_focal), -1)
    squares = (error * torch.linalg.solve(covariance, error)).sum(-1)
    assert squares[result.ok].mean().item() == pytest.approx(7.0, rel=0.1)
    last = log_focal[:, 0].square() / covariance[:, 6, 6]
    assert last[result.ok].mean().item() == pytest.approx(1.0, rel=0.1)


def test_the_search_helps_where_the_network_does_not_suffice():
    """With the fixed effort a network guesses with one nominal focal length, otherwise doubtful ones are searched."""
    p = draw(12, wrong=6, noise=1.0, batch=256)
    right = {}
    for effort in ("fixed", "adaptive"):
        result, _ = create_solver("pnpnet-set", focal="unknown", effort=effort).with_starts(*p[:2], withheld(p))
        focal, shift, turn = errors(result, p)
        right[effort] = (focal < 0.025) & (shift < 0.025) & (turn < math.radians(0.5))
        assert (result.ok & ~right[effort]).double().mean() < 0.04
    assert right["fixed"].double().mean() > 0.7
    assert right["adaptive"].double().mean() > 0.96
    assert not (right["fixed"] & ~right["adaptive"]).any()


def seen_through_a_lens(radial, *, noise=0.5, seed=0, **options):
    p = draw(seed=seed, **options)
    dist = torch.tensor([-0.2, 0.03 * (radial - 1), 0.0, 0.0], dtype=torch.float64).expand(len(p.inliers), -1)
    pixels = distort_points(p.img_points, p.intrinsics, dist)
    return p, pixels + noise * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(seed)).double(), dist


@pytest.mark.parametrize("name", ["pnpnet-set", "p3p-ransac", "reppnp-lm"])
@pytest.mark.parametrize("radial", [1, 2])
def test_radial_distortion_is_estimated_with_the_focal_length(name, radial):
    wrong = 0 if name == "reppnp-lm" else 8
    p, pixels, dist = seen_through_a_lens(radial, n=40, batch=32, wrong=wrong, field_of_view=(40.0, 90.0))
    seen = 1.0 + 94.0 * (torch.arange(40) == 3).expand(32, -1)  # one pair has no probability and is left out
    pixels[:, 3] = torch.nan
    without = create_solver(name, focal="unknown")(p.world_points, pixels, withheld(p), confidence=seen)
    assert (errors(without, p)[0] > 0.02).double().mean() > 0.5
    assert not without.dist.any()
    result = create_solver(name, focal="unknown", radial=radial)(p.world_points, pixels, withheld(p), confidence=seen)
    focal, shift, turn = errors(result, p)
    assert ((focal < 0.01) & (shift < 0.01) & (turn < math.radians(0.25)) & result.ok).double().mean() > 0.9
    assert (result.dist - dist)[:, 0].abs().median() < 0.01
    known = create_solver(name)(p.world_points, pixels, result.intrinsics, dist=result.dist, confidence=seen)
    torch.testing.assert_close(known.rotation, result.rotation, rtol=0, atol=0.01)


def test_radial_distortion_is_a_minimum_as_accurate_as_the_noise_allows():
    """A further Gauss-Newton step is short, and normalised errors are chi-square with 8 degrees of freedom."""
    p, pixels, dist = seen_through_a_lens(1, n=40, batch=400, noise=1.0, field_of_view=(50.0, 75.0))
    solver = PnPNet(None, RobustWeightedLM(15, robustness=0.0), Normalize(order=False), focal="unknown", radial=1)
    result = solver(p.world_points, pixels, withheld(p))

    def residual(delta):
        camera = scale_focal(result.intrinsics, delta[:, 6].exp())
        seen = p.img_points + reprojection_errors(p._replace(intrinsics=camera), retract(result.pose, delta[:, :6]))
        lens = result.dist + torch.nn.functional.pad(delta[:, 7:], (0, 3))
        return (distort_points(seen, camera, lens) - pixels).flatten(1)

    zero = torch.zeros(400, 8, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(lambda x: residual(x).sum(0), zero).movedim(0, 1)  # (B, 2N, 8)
    information = jacobian.mT @ jacobian
    step = torch.linalg.solve(information, (jacobian.mT @ residual(zero)[..., None])[..., 0])
    turn = Pose(p.pose.rotation @ result.rotation.mT, result.translation).rvec
    log_focal = (p.intrinsics[:, 0, 0] / result.intrinsics[:, 0, 0]).log()[:, None]
    error = torch.cat((turn, p.pose.translation - result.translation, log_focal, (dist - result.dist)[:, :1]), -1)
    of_step, of_error = ((x * (information @ x[..., None])[..., 0]).sum(-1)[result.ok] for x in (step, error))
    assert of_step.max() < 0.01  # the prior of the coefficient
    assert of_error.mean().item() == pytest.approx(8.0, rel=0.1)


def test_parts_that_fit_a_cache_change_no_result(make_problems, monkeypatch):
    p, solver = make_problems(20, 70, outliers=5), create_solver("pnpnet-set")
    expected = solver(*p[:3])
    monkeypatch.setattr("kornia_pnpnet.core.performance._CACHE_BYTES", 1000)
    assert_same(solver(*p[:3]), expected, 1e-6, 1e-6)
