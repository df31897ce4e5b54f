"""The loss of the true pose's likelihood: known values, a gradient from the first step, and noise that it teaches."""

import math

import pytest
import torch
from laws import Case, make, make_bad

from kornia_pnpnet import Pose, monte_carlo_pose_loss, pose_covariance
from kornia_pnpnet.data import SyntheticProblems

DOUBLE = torch.float64


def problems(n=30, batch=4, seed=5, **noise):
    return SyntheticProblems(n=n, batch_size=batch, seed=seed, dtype=DOUBLE, **noise).batch(0)


def loss_of(p, hypothesis=None, **options):
    torch.manual_seed(0)
    return monte_carlo_pose_loss(p.pose, hypothesis or p.pose, *p[:3], **options)


def test_integral_by_the_prior_alone():
    """Where the noise is large, plain Monte Carlo over the prior finds the same integral."""
    p = problems(n=12, batch=2)
    loss = loss_of(p, img_sigma=20000.0, samples=4000, kernel="cauchy")
    plain = loss_of(p, [], img_sigma=20000.0, samples=60000, rounds=0, kernel="cauchy")
    torch.testing.assert_close(loss, plain, rtol=0.0, atol=0.1)


def test_hypotheses_find_other_modes():
    """A second pose that explains the pairs as well adds its integral, if the samples find it."""
    p = problems(n=40, world_sigma=0.0, img_sigma=0.0)
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=DOUBLE))
    # Half of the pairs see the scene, the other half the scene turned upside down around its centre.
    centre = p.world_points.mean(1, keepdim=True)
    turned = (p.world_points - centre) @ turn + centre
    even = (torch.arange(40) % 2 == 0).to(DOUBLE)
    world = torch.where(even.bool()[:, None], p.world_points, turned)
    rotation = p.pose.rotation @ turn
    other = Pose(rotation, p.pose.translation + ((p.pose.rotation - rotation) @ centre.mT)[..., 0])
    arguments = (world, p.img_points, p.intrinsics)
    options = {"img_sigma": 2.0, "kernel": "truncated", "scale": 4.0, "samples": 600, "rounds": 0}
    torch.manual_seed(0)
    one = monte_carlo_pose_loss(p.pose, [], *arguments, **options)
    two = monte_carlo_pose_loss(p.pose, other, *arguments, **options)
    first, second = (
        pose_covariance(pose, *arguments, img_sigma=2.0, weights=share.expand(4, 40)).logdet()
        for pose, share in ((p.pose, even), (other, 1.0 - even))
    )
    torch.testing.assert_close(two - one, torch.log1p((0.5 * (second - first)).exp()), rtol=0.0, atol=0.2)


@pytest.mark.parametrize("of_pixels", [True, False])
def test_gradient_of_the_integral(of_pixels):
    """With many samples the gradient is that of the loss: along a random direction it equals central differences.

    A loss that is minus the logarithm of a density and has the right gradient teaches the noise of the data.
    """
    p = problems(n=12, batch=2)
    generator = torch.Generator().manual_seed(1)
    direction = torch.randn(p.img_points.shape, generator=generator, dtype=DOUBLE)
    turn = torch.randn(2, 2, generator=generator, dtype=DOUBLE)

    def loss(shift):
        torch.manual_seed(0)
        pixels = p.img_points + shift * direction * of_pixels
        factor = 300.0 * torch.eye(2, dtype=DOUBLE) + shift * turn * (not of_pixels)
        options = {"img_cov": (factor @ factor.mT).expand(2, 12, 2, 2), "samples": 60000, "rounds": 0}
        return monte_carlo_pose_loss(p.pose, p.pose, p.world_points, pixels, p.intrinsics, **options).sum()

    shift = torch.zeros((), dtype=DOUBLE, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(shift), shift)
    with torch.no_grad():
        difference = (loss(torch.tensor(20.0)) - loss(torch.tensor(-20.0))) / 40.0
    torch.testing.assert_close(gradient, difference, rtol=0.05, atol=2e-3)


def test_units():
    """A density per unit of the world: a thousand times the unit is a thousand times the density, in each direction."""
    p = problems()
    metres = loss_of(p, img_sigma=2.0, world_sigma=0.05)
    pose = Pose(p.pose.rotation, 1000.0 * p.pose.translation)
    torch.manual_seed(0)
    millimetres = monte_carlo_pose_loss(
        pose, pose, 1000.0 * p.world_points, p.img_points, p.intrinsics, img_sigma=2.0, world_sigma=50.0
    )
    torch.testing.assert_close(millimetres, metres + 3.0 * math.log(1000.0))


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4])
def test_gradient_from_nothing(dtype, size):
    """Predictions that fit no pose, of any size, have a finite gradient that is not zero, in every problem."""
    generator = torch.Generator().manual_seed(3)
    p = SyntheticProblems(n=16, batch_size=8, seed=2, dtype=dtype).batch(0)
    live = [(size * torch.randn(8, 16, k, generator=generator)).to(dtype).requires_grad_() for k in (3, 2)]
    sigma = torch.full((8, 16), 50.0, dtype=dtype, requires_grad=True)
    loss = monte_carlo_pose_loss(p.pose, p.pose, *live, p.intrinsics, img_sigma=sigma)
    loss.sum().backward()
    assert loss.isfinite().all()
    for tensor in (*live, sigma):
        assert tensor.grad.isfinite().all()
        assert (tensor.grad.flatten(1).abs().amax(1) > 0).all()


def test_padding_changes_nothing():
    p = problems(n=20)
    mask = torch.arange(20).expand(4, 20) < 16
    shorter = loss_of(p._replace(world_points=p.world_points[:, :16], img_points=p.img_points[:, :16]), img_sigma=2.0)
    world = p.world_points.masked_fill(~mask[..., None], torch.nan).requires_grad_()
    sigma = torch.where(mask, 2.0, -1.0)
    padded = loss_of(p._replace(world_points=world), img_sigma=sigma, mask=mask)
    padded.sum().backward()
    torch.testing.assert_close(padded, shorter)
    assert world.grad.isfinite().all()
    assert not world.grad[:, 16:].any()


def test_bad_problems_cost_nothing_and_fail_alone():
    case = Case("epnp-lm", noise="sigma")
    kinds, sound, bad = make_bad(case)
    _, truth = make(case, len(sound["weights"]))
    leaves = [x.requires_grad_() for x in bad.values()]
    losses = []
    for call in (sound, bad):
        torch.manual_seed(0)
        losses.append(monte_carlo_pose_loss(truth, truth, **call))
    assert torch.equal(losses[1][::2], losses[0][::2])
    assert not losses[1][1::2].any(), kinds
    for gradient in torch.autograd.grad(losses[1].sum(), leaves):
        assert gradient.isfinite().all()
        assert gradient[::2].any()
        assert not gradient[1::2].any()
