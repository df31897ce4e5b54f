"""What is known of the pose besides the pairs: exact least squares, no harm by a wrong prior, any unit and heading."""

import math

import pytest
import torch
from torch import nn

from kornia_pnpnet import (
    PnPNet,
    PosePrior,
    RobustWeightedLM,
    create_solver,
    gravity_prior,
    pose_errors,
)
from kornia_pnpnet.metrics import success
from kornia_pnpnet.refine.prior import prior_errors, prior_in_frame
from kornia_pnpnet.problem import Problem

SIGMA = math.radians(1.0)
TOLD = {"img_sigma": 1.0, "world_sigma": 0.05}


def drawn(problems, generator, wrong=0.0, sigma=SIGMA):
    """The pose of the frame before: 1 degree and 2 % of the distance off, and ``wrong`` sigmas more."""
    like = problems.world_points
    batch, distance = len(like), problems.pose.translation.norm(dim=-1, keepdim=True)
    sigmas = torch.cat((torch.full_like(distance, sigma).expand(batch, 3), 0.02 * distance.expand(batch, 3)), -1)
    noise, direction = torch.randn(2, batch, 6, generator=generator, dtype=like.dtype)
    error = sigmas * (noise + wrong * nn.functional.normalize(direction, dim=-1))
    return PosePrior(retract(problems.pose, error), torch.diag_embed(sigmas**-2))


def gravity(problems, generator, wrong=0.0, sigma=0.5 * SIGMA):
    like = problems.world_points
    down, noise, side = torch.randn(3, len(like), 3, generator=generator, dtype=like.dtype)
    down = nn.functional.normalize(down, dim=-1)
    truth = (problems.pose.rotation @ down[..., None])[..., 0]
    across = nn.functional.normalize(torch.linalg.cross(truth, side), dim=-1)
    turn = sigma * (noise + wrong * across)
    return gravity_prior(down, truth + torch.linalg.cross(turn, truth), sigma)


def informative(problems, generator):
    """An information with correlations between turns and shifts."""
    root = torch.randn(len(problems.world_points), 6, 6, generator=generator, dtype=torch.float64)
    expected = retract(problems.pose, 0.01 * root[:, 0])
    return PosePrior(expected, 400.0 * root @ root.mT, torch.full_like(root[:, 0, 0], torch.inf))


def refiner(m=40, kernel="huber", robustness=1e4):
    return PnPNet(None, RobustWeightedLM(m, kernel=kernel, robustness=robustness, learnable=False))


def rate(result, problems):
    return success(pose_errors(result.pose, problems.pose)).double().mean()


@pytest.mark.parametrize("kind", [informative, gravity, drawn])
def test_pose_is_a_minimum_of_the_whole_cost(kind, make_problems, generator):
    problems = make_problems(n=8, batch=20, outliers=0)
    prior = kind(problems, generator)
    prior = prior._replace(scale=torch.full((20,), torch.inf, dtype=torch.float64))
    with torch.no_grad():
        result = refiner()(*problems[:3], prior=prior, init=problems.pose, img_sigma=2.0)

    one = torch.ones(20, dtype=torch.float64)
    framed, _ = prior_in_frame(prior, torch.zeros(20, 3, dtype=torch.float64), one, one)
    focals, centre = problems.intrinsics[:, :1, 0], problems.intrinsics[:, None, :2, 2]
    corr = Problem(problems.world_points, problems.img_points - centre, one[:, None].expand(20, 8), one[0])
    delta = torch.zeros(20, 6, dtype=torch.float64, requires_grad=True)
    pose = retract(result.pose, delta)
    plane = torch.stack(project(pose, corr).plane_points, -1)
    fy = problems.intrinsics[:, 1:2, 1]
    pixels = plane * torch.stack((focals, fy), -1)
    # Residuals of the solver are those of a camera with one focal length, the geometric mean.
    mean = (focals * fy).sqrt()
    off = (pixels - corr.img_points) * mean[..., None] / torch.stack((focals, fy), -1)
    of_pairs = off.square().sum((1, 2)) / 4.0
    cost = of_pairs + prior_errors(framed, pose)[1]
    (gradient,) = torch.autograd.grad(cost.sum(), delta, retain_graph=True)
    (alone,) = torch.autograd.grad(of_pairs.sum(), delta)
    assert (gradient.norm(dim=-1) < 1e-5 * alone.norm(dim=-1)).all()


def test_a_prior_without_information_is_a_start_alone(make_problems):
    problems = make_problems(n=9, batch=10, outliers=2)
    nothing = PosePrior(problems.pose, torch.zeros(10, 6, 6, dtype=torch.float64))
    for name in ("pnpnet-set", "epnp-lm", "p3p-ransac"):
        solver = create_solver(name)
        with torch.no_grad():
            expected = solver(*problems[:3], init=problems.pose)
            found = solver(*problems[:3], prior=nothing)
        torch.testing.assert_close(found.matrix, expected.matrix)


def test_what_is_known_helps_and_what_is_wrong_hardly_harms(make_problems, generator):
    solver = create_solver("pnpnet-set")
    three = make_problems(n=3, batch=500, outliers=0)
    nine = make_problems(n=9, batch=500, outliers=3)
    with torch.no_grad():
        assert rate(solver(*three[:3], prior=drawn(three, generator), **TOLD), three) > (
            rate(solver(*three[:3], **TOLD), three) + 0.15
        )
        alone = rate(solver(*nine[:3], **TOLD), nine)
        assert rate(solver(*nine[:3], prior=drawn(nine, generator), **TOLD), nine) > alone + 0.04
        for kind in (drawn, gravity):
            for wrong in (10.0, 100.0):
                assert rate(solver(*nine[:3], prior=kind(nine, generator, wrong), **TOLD), nine) > alone - 0.03


@pytest.mark.parametrize("effort", ["fixed", "adaptive"])
def test_gravity_chooses_among_poses(effort, make_problems, generator):
    """Of four pairs with one outlier, three decide: gravity tells their poses apart."""
    problems = make_problems(n=4, batch=500, outliers=1)
    for solver in (create_solver("pnpnet-set", effort=effort), create_solver("p3p-ransac", threshold=10.0)):
        with torch.no_grad():
            alone = rate(solver(*problems[:3], **TOLD), problems)
            assert rate(solver(*problems[:3], prior=gravity(problems, generator), **TOLD), problems) > alone + 0.02


def test_opposite_directions(generator):
    down = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    prior = gravity_prior(down, -down, torch.tensor(0.1, dtype=torch.float64))
    torch.testing.assert_close((prior.pose.rotation @ down[..., None])[..., 0], -down)
    torch.testing.assert_close(torch.linalg.det(prior.pose.rotation), torch.ones(4, dtype=torch.float64))


def test_gradients(make_problems, generator):
    problems = make_problems(n=5, batch=1, outliers=0)
    prior, (world, img, camera) = drawn(problems, generator), problems[:3]
    solver = refiner(10)
    zero, root = torch.zeros(1, 6, dtype=torch.float64), prior.information.diagonal(dim1=1, dim2=2).sqrt()

    def answer(delta, root, scale):
        known = PosePrior(retract(prior.pose, delta), torch.diag_embed(root**2), scale)
        return solver(world, img, camera, prior=known, gradient="always", img_sigma=1.0).matrix[:, :3]

    inputs = zero, root, torch.full((1,), 2.0, dtype=torch.float64)
    assert torch.autograd.gradcheck(answer, [x.requires_grad_() for x in inputs], eps=1e-6, atol=1e-4, rtol=1e-3)

    down = torch.randn(1, 3, generator=generator, dtype=torch.float64)
    cam = (problems.pose.rotation @ down[..., None])[..., 0] + 0.01
    sigma = torch.full((1,), 0.02, dtype=torch.float64)

    def level(down, cam, sigma):
        known = gravity_prior(down, cam, sigma)
        return solver(world, img, camera, prior=known, init=problems.pose, gradient="always", img_sigma=1.0).matrix

    inputs = [x.requires_grad_() for x in (down, cam, sigma)]
    assert torch.autograd.gradcheck(level, inputs, eps=1e-6, atol=1e-4, rtol=1e-3, fast_mode=True)
