"""Control points and alignment: laws that hold for any points."""

from __future__ import annotations

import pytest
import torch

from kornia_pnpnet import Correspondences
from kornia_pnpnet.geometry import align
from kornia_pnpnet.init.epnp.control_points import control_points


def correspondences(world, weights=None):
    weights = torch.ones_like(world[..., 0]) if weights is None else weights
    return Correspondences(world, torch.zeros_like(world[..., :2]), weights, torch.ones((), dtype=world.dtype))


@pytest.fixture
def world(generator):
    """Points of very different extents along random axes, far from the origin."""
    axes = torch.linalg.qr(torch.randn(7, 3, 3, generator=generator, dtype=torch.float64)).Q
    extents = torch.tensor([5.0, 1.0, 0.1], dtype=torch.float64)
    return (torch.randn(7, 9, 3, generator=generator, dtype=torch.float64) * extents) @ axes + 20.0


@pytest.fixture
def weights(generator):
    return torch.rand(7, 9, generator=generator, dtype=torch.float64) + 0.1


def test_coordinates_are_orthonormal_and_give_the_points_back(world, weights):
    control = control_points(correspondences(world, weights))
    torch.testing.assert_close(control.coordinates @ control.points, world, rtol=0, atol=1e-12)
    moments = control.coordinates.mT @ (control.coordinates * control.weights[..., None])
    torch.testing.assert_close(moments, torch.eye(4, dtype=torch.float64).expand(7, 4, 4), rtol=0, atol=1e-11)
    torch.testing.assert_close(control.weights, weights / weights.sum(-1, keepdim=True))
    assert control.ok.all()
    assert not control.planar.any()


def test_align_recovers_a_similarity(world, weights, random_rotations):
    rotation = random_rotations(7)
    shift = torch.randn(7, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    target = 0.5 * world @ rotation.mT + shift[:, None]
    pose, scale = align(world, target, weights)
    torch.testing.assert_close(pose.rotation, rotation, rtol=0, atol=1e-9)
    torch.testing.assert_close(scale, torch.full_like(scale, 0.5))
    pose, _ = align(world, 2.0 * target, weights)
    torch.testing.assert_close(pose.translation, 2.0 * shift, rtol=0, atol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_planes_lines_and_points_are_told_apart(unit, dtype, world, random_rotations):
    centred = world - world.mean(1, keepdim=True)
    for spread, ok, planar in (((1, 1, 0), True, True), ((1, 0, 0), 0, 1), ((0, 0, 0), 0, 1), ((1, 1, 3e-2), 1, 0)):
        shape = (centred @ random_rotations(7) * torch.tensor(spread)) @ random_rotations(7, seed=1)
        points = (unit * shape).to(dtype).requires_grad_()
        control = control_points(correspondences(points))
        assert (control.ok == ok).all()
        assert (control.planar == planar).all()
        assert control.points.isfinite().all()
        assert control.coordinates.isfinite().all()
        if planar:
            assert not control.points[:, 3].any()
            assert not control.coordinates[..., 3].any()
        (control.coordinates.sum() + control.points.sum()).backward()
        assert points.grad.isfinite().all()
    assert not control_points(correspondences(world, torch.zeros(7, 9).double())).ok.any()


def test_align_minimises_the_squares(world, weights, generator, random_rotations):
    target = world @ random_rotations(7).mT + torch.randn(7, 9, 3, generator=generator, dtype=torch.float64)
    pose, scale = align(world, target, weights)
    assert (scale > 0).all()

    def cost(rotation, translation):
        return (weights[..., None] * (world @ rotation.mT + translation[:, None] - target).square()).sum((1, 2))

    mean = (weights[..., None] * world).sum(1) / weights.sum(-1, keepdim=True)
    centre = (pose.rotation @ mean[..., None])[..., 0] + pose.translation
    for seed in range(20):
        turned = random_rotations(7, angle=0.01, seed=seed) @ pose.rotation
        other = centre - (turned @ mean[..., None])[..., 0]
        assert (cost(turned, other) > cost(pose.rotation, pose.translation)).all()
