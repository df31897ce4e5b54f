"""EPPnP and REPPnP: exact on exact pairs, equivariant to frame, unit and order, not ok where there is no pose."""

from __future__ import annotations

import pytest
import torch
from init_helpers import assert_same, change, flattened

from kornia_pnpnet import Correspondences, Normalize, Pose
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.geometry import transform
from kornia_pnpnet.init.reppnp import REPPnP
from kornia_pnpnet.metrics import pose_errors, success


def chosen(pose, index):
    return Pose(pose.rotation[index], pose.translation[index])


def algebraic_error(corr, pose):
    """Pixel error times depth over focal length, (B, N)."""
    cam_points = transform(pose, corr.world_points)
    return (cam_points[..., :2] - corr.img_points / corr.focal * cam_points[..., 2:]).norm(dim=-1)


@pytest.mark.parametrize(("n", "outliers"), [(9, 1), (50, 12)])
def test_gross_outliers_are_found_and_do_not_move_the_pose(n, outliers, make_problems, correspond):
    problems = make_problems(n, 200, outliers=outliers, noise=False)
    corr, truth = correspond(problems)
    # Some mismatches happen to be close to the right pixel: they need not be found.
    gross = (problems.inliers | (algebraic_error(corr, truth) > 0.1)).all(-1)
    assert gross.sum() > 100
    guess = REPPnP()(corr)
    found = (guess.weights.bool() == problems.inliers).all(-1)
    assert found[gross].double().mean() > 0.97
    assert_same(chosen(guess.pose, found), chosen(truth, found))
    every = REPPnP(reject_outliers=False)(corr)
    assert every.weights.all()
    assert success(pose_errors(every.pose, truth))[gross].double().mean() < 0.03


@pytest.mark.parametrize("thickness", [0.0, 1.0])
@pytest.mark.parametrize(("dtype", "max_error_deg"), [(torch.float64, 1e-6), (torch.float32, 0.5)])
def test_a_view_through_a_telephoto_lens(dtype, max_error_deg, thickness, random_rotations, generator):
    """From a distance of 100 radii there is hardly any depth, and off the axis all pixels nearly coincide."""
    world = torch.randn(100, 20, 3, generator=generator, dtype=torch.float64)
    world[..., 2] *= thickness
    truth = Pose(random_rotations(100), torch.tensor([50.0, -30.0, 100.0], dtype=torch.float64).expand(100, 3))
    cam_points = transform(truth, world)
    pixels = 3400.0 * cam_points[..., :2] / cam_points[..., 2:]
    pixels[:, [2, 5, 11], 0] += 40.0  # more than a radius
    focal = torch.tensor(3400.0, dtype=dtype)
    guess = REPPnP()(Correspondences(world.to(dtype), pixels.to(dtype), torch.ones(100, 20, dtype=dtype), focal))
    errors = pose_errors(Pose(*(x.double() for x in guess.pose)), truth)
    right = guess.ok & (errors.rotation_error_deg < max_error_deg)
    assert right.double().mean() > 0.95
    assert (guess.weights[right].sum(-1) == 17).all()


# Shares of success by pairs and most outliers, about three standard deviations below those of 5000 problems.
@pytest.mark.parametrize(("n", "most", "floor"), [(9, None, 0.88), (9, 3, 0.715), (20, 6, 0.975), (50, 16, 0.995)])
def test_success_on_the_protocols_problems(n, most, floor):
    mix = None if most is None else OutlierMix()
    assert mix is None or mix.max_count(n) == most
    problems = SyntheticProblems(n=n, batch_size=1000, seed=7, outliers=mix).batch(0)
    normalize = Normalize(order=False)
    corr, frame = normalize(problems.world_points, problems.img_points, problems.intrinsics)
    guess = REPPnP()(corr)
    assert {x.dtype for x in (*guess.pose, guess.weights)} == {torch.float32}
    right = guess.ok & success(pose_errors(normalize.undo(guess.pose, frame), problems.pose))
    assert right.double().mean() > floor


@pytest.mark.parametrize(("reject_outliers", "planar"), [(False, True), (True, False)])
def test_gradcheck(reject_outliers, planar, make_problems, correspond):
    corr, truth = correspond(make_problems(9, 1, seed=5))
    if planar:
        corr = flattened(corr, truth)
    if reject_outliers:
        pixels = corr.img_points.clone()
        pixels[:, 3] += 1500.0
        corr = change(corr, img_points=pixels)
    model = REPPnP(reject_outliers=reject_outliers, refine_iterations=6)
    first = model(corr)
    assert first.ok.all()
    assert first.weights.all() != reject_outliers

    # All inputs near 1, so that one difference step suits all.
    def run(world, pixels, weights, focal):
        guess = model(Correspondences(world, 1000.0 * pixels, weights, 1000.0 * focal))
        assert torch.equal(guess.weights, first.weights)
        return tuple(guess.pose)

    weights = 0.5 + torch.rand(1, 9, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    first = model(corr._replace(weights=weights))
    inputs = [corr.world_points, corr.img_points / 1000.0, weights, corr.focal / 1000.0]
    inputs = [x.detach().clone().requires_grad_() for x in inputs]
    assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-5, rtol=1e-5)
