"""Covariances of pixels and world points: whitening by them, from the user's argument to pose, weights and gradient."""

import math

import pytest
import torch
from helpers import assert_same, derivative, reprojection_errors

from kornia_pnpnet import (
    PnPNet,
    RobustWeightedLM,
    create_solver,
    monte_carlo_pose_loss,
    pose_covariance,
    pose_errors,
)
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.bounds import KnownInliersAndNoise
from kornia_pnpnet.problem import State
from kornia_pnpnet.refine.residual import retract

DOUBLE = torch.float64
CAMERA = torch.tensor([[800.0, 30.0, 320.0], [0.0, 1000.0, 240.0], [0.0, 0.0, 1.0]], dtype=DOUBLE)


def problems(n=9, batch=4, outliers=0, seed=3, **options):
    """Problems with covariances of ratio 5, seen by a camera with a skew and two focal lengths."""
    options = {"axis_ratio": 5.0, "known_noise": 1.0, "img_sigma": 10.0, "dtype": DOUBLE, **options}
    mix = OutlierMix(count=outliers)
    p = SyntheticProblems(n=n, batch_size=batch, seed=seed, outliers=mix, **options).batch(0)
    change = CAMERA[:2, :2] @ torch.diag(1.0 / p.intrinsics[0].diagonal()[:2])
    img = p.img_points @ change.mT + CAMERA[:2, 2]
    return p._replace(img_points=img, img_cov=change @ p.img_cov @ change.mT, intrinsics=CAMERA.expand(batch, 3, 3))


def covs(p):
    return {"img_cov": p.img_cov, "world_cov": p.world_cov}


def least_squares(m=30, **options):
    options = {"robustness": 0.0, "reject_worse": False, "learnable": False, **options}
    return PnPNet(None, RobustWeightedLM(m, **options))


def whitened(p, pose):
    """The Jacobian (B, 2N, 6) by the tangent and the residual (B, 2N), all derivatives by autograd."""

    def total(world):
        return reprojection_errors(p._replace(world_points=world), pose).sum((0, 1))

    residual = reprojection_errors(p, pose)
    jacobian = derivative(lambda x: reprojection_errors(p, x.pose).flatten(1), State.of(pose))
    by_point = torch.autograd.functional.jacobian(total, p.world_points).movedim(0, 2)  # (B, N, 2, 3)
    covariance = p.img_cov + by_point @ p.world_cov @ by_point.mT
    whiten = torch.linalg.inv(torch.linalg.cholesky(covariance))
    return (whiten @ jacobian.unflatten(1, (-1, 2))).flatten(1, 2), (whiten @ residual[..., None]).flatten(1)


# -- against other ways to say the same ----------------------------------------------------------------------------


def test_poses_covariances_and_weights_are_those_of_a_dense_solver():
    p = problems()
    result = least_squares()(*p[:3], init=p.pose, **covs(p))
    robust = least_squares(kernel="cauchy", robustness=3.0)(*p[:3], init=p.pose, **covs(p))
    covariance = pose_covariance(result.pose, *p[:3], **covs(p))
    pose = p.pose
    for _ in range(30):
        jacobian, residual = whitened(p, pose)
        pose = retract(pose, -torch.linalg.lstsq(jacobian, residual[..., None]).solution[..., 0])
    torch.testing.assert_close(result.rotation, pose.rotation, rtol=0, atol=1e-9)
    torch.testing.assert_close(result.translation, pose.translation, rtol=0, atol=1e-7)
    torch.testing.assert_close(covariance, torch.linalg.inv(jacobian.mT @ jacobian), rtol=1e-6, atol=1e-12)
    _, residual = whitened(p, robust.pose)
    distance = residual.unflatten(1, (-1, 2)).square().sum(-1)
    torch.testing.assert_close(robust.weights, 1.0 / (1.0 + distance / 9.0), rtol=1e-6, atol=0)


def test_an_isotropic_covariance_is_a_sigma():
    p, sigma = problems(), torch.linspace(0.01, 0.1, 36, dtype=DOUBLE).view(4, 9)
    known = {"world_cov": sigma.square()[..., None, None] * torch.eye(3, dtype=DOUBLE)}
    found = pose_covariance(p.pose, *p[:3], img_cov=p.img_cov, **known)
    torch.testing.assert_close(found, pose_covariance(p.pose, *p[:3], img_cov=p.img_cov, world_sigma=sigma))


# -- exact measurements -----------------------------------------------------------------------------------------------


def test_exact_points_and_exact_pixels_are_sound():
    p, exact = problems(batch=20, world_sigma=0.0), torch.zeros(20, 9, 3, 3, dtype=DOUBLE, requires_grad=True)
    result = create_solver("pnpnet-set")(*p[:3], img_cov=p.img_cov, world_cov=exact)
    assert result.ok.all()
    assert torch.autograd.grad(result.rotation.sum(), exact)[0].isfinite().all()
    flat = torch.diag(torch.tensor([1.0, 0.0], dtype=DOUBLE)).expand_as(p.img_cov)  # exact in the vertical
    result = create_solver("epnp-lm")(*p[:3], img_cov=flat, world_cov=problems(batch=20).world_cov)
    assert result.matrix.isfinite().all()
    assert result.ok.double().mean() > 0.9


# -- what it is for ------------------------------------------------------------------------------------------------


def test_covariances_reach_the_bound_and_sigmas_do_not():
    p = problems(n=20, batch=1500, outliers=6, world_sigma=0.02)
    solver = create_solver("pnpnet-set")
    found = [
        KnownInliersAndNoise().solve_with_truth(p),
        solver(*p[:3], **covs(p)),
        solver(*p[:3], img_sigma=10.0 * 30.0 / 113.0, world_sigma=0.02),
    ]
    errors = [torch.stack(list(pose_errors(x.pose, p.pose))).median(1).values for x in found]
    assert (errors[1] < 1.05 * errors[0]).all()
    assert (errors[2] > 1.15 * errors[0]).all()


@pytest.mark.parametrize("sigmas", [{}, {"img_sigma": 0.5}, {"img_sigma": 0.5, "world_sigma": 0.002}])
def test_the_likelihood_is_that_of_the_covariances(sigmas):
    """Laplace's approximation, exact in the limit: the density of the covariance at the mode."""
    p = problems(n=60, img_sigma=0.5, world_sigma=0.002)
    given = {name: torch.full((4, 60), x, dtype=DOUBLE) for name, x in sigmas.items()} or covs(p)
    mode = least_squares()(*p[:3], init=p.pose, **given).pose
    known = {"world_sigma": 0.0, **given} if "img_sigma" in given else given
    expected = 0.5 * torch.logdet(2.0 * math.pi * pose_covariance(mode, *p[:3], **known))
    torch.manual_seed(0)
    noise = {name: x.clone().requires_grad_() for name, x in given.items()}
    loss = monte_carlo_pose_loss(mode, mode, *p[:3], **noise, samples=2000, kernel="truncated", scale=1e3)
    assert_same(loss, expected, atol=0.1)
    for gradient in torch.autograd.grad(loss.sum(), list(noise.values())):
        assert gradient.isfinite().all()
        assert (gradient != 0).any()
