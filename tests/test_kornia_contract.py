"""What this package relies on in kornia, and what it computes otherwise but equally."""

from __future__ import annotations

import math

import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.camera.perspective import project_points
from kornia.geometry.conversions import (
    axis_angle_to_rotation_matrix,
    convert_points_from_homogeneous,
    rotation_matrix_to_axis_angle,
)
from kornia.geometry.liegroup import So3
from kornia.geometry.linalg import inverse_transformation, transform_points

from kornia_pnpnet import Pose
from kornia_pnpnet.problem import Problem, State
from kornia_pnpnet.refine.residual import project

ANGLES = (0.0, 1e-12, 1e-6, 9.9e-4, 1.1e-3, 0.1, 1.0, 3.0, math.pi)


def vectors(angle, dtype=torch.float64):
    axis = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return (angle * axis / axis.norm(dim=-1, keepdim=True)).to(dtype)


def test_axis_angle_is_the_matrix_exponential_and_its_derivative_at_the_identity():
    for angle in ANGLES:
        exponential = torch.linalg.matrix_exp(So3.hat(vectors(angle)))
        torch.testing.assert_close(axis_angle_to_rotation_matrix(vectors(angle)), exponential, rtol=0, atol=1e-13)
        rotation = axis_angle_to_rotation_matrix(vectors(angle, torch.float32))
        torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand(50, 3, 3), rtol=0, atol=2e-6)
    jacobian = torch.func.jacrev(axis_angle_to_rotation_matrix)(torch.zeros(3, dtype=torch.float64))
    generators = So3.hat(torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(So3.vee(generators), torch.eye(3, dtype=torch.float64))
    assert torch.equal(axis_angle_to_rotation_matrix(torch.zeros(2, 3)), torch.eye(3).expand(2, 3, 3))
    torch.testing.assert_close(jacobian.movedim(-1, 0), generators)


@pytest.mark.parametrize("angle", ANGLES[:-1])
def test_rotation_vector_round_trip(angle):
    back = rotation_matrix_to_axis_angle(axis_angle_to_rotation_matrix(vectors(angle)))
    torch.testing.assert_close(back, vectors(angle), rtol=0, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("angle", ANGLES)
def test_gradients_of_the_rotation_vector_are_finite(angle, dtype):
    rotation = axis_angle_to_rotation_matrix(vectors(angle, dtype)).requires_grad_()
    rotation_matrix_to_axis_angle(rotation).sum().backward()
    assert rotation.grad.isfinite().all()
    vector = vectors(angle, dtype).requires_grad_()
    axis_angle_to_rotation_matrix(vector).sum().backward()
    assert vector.grad.isfinite().all()


@pytest.mark.parametrize("angle", [1e-4, 0.1, 0.3, 2.0])
def test_left_jacobian_is_the_derivative_of_the_exponential(angle):
    vector = vectors(angle)

    def turn(change):
        moved = axis_angle_to_rotation_matrix(vector + change)
        relative = moved @ axis_angle_to_rotation_matrix(vector).mT
        return 0.5 * So3.vee(relative - relative.mT)

    derivative = torch.autograd.functional.jacobian(turn, torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(So3.left_jacobian(vector), derivative, rtol=0, atol=1e-7)


def test_dehomogenising_with_zero_eps_divides_whatever_is_not_zero():
    points = torch.tensor([[2.0, 4.0, 2.0], [2e-20, 4e-20, 2e-20], [2.0, 4.0, -2.0], [2.0, 4.0, 0.0]])
    expected = torch.tensor([[1.0, 2.0], [1.0, 2.0], [-1.0, -2.0], [2.0, 4.0]])
    torch.testing.assert_close(convert_points_from_homogeneous(points, eps=0.0), expected)


# --- projection: ours is kornia's, in another layout and with a residual ----------------------------------------------


@pytest.fixture
def scene(random_rotations, generator):
    """Poses of 7 cameras with 5 points in front of each, and the focal lengths as factors of 800 pixels."""
    points = 2.0 * torch.rand(7, 5, 3, generator=generator, dtype=torch.float64) + torch.tensor([-1.0, -1.0, 4.0])
    pose = Pose(random_rotations(7), torch.randn(7, 3, generator=generator, dtype=torch.float64))
    return pose, points, 0.2 * torch.randn(7, 1, generator=generator, dtype=torch.float64)


def test_our_projection_is_kornias(scene):
    pose, points, zoom = scene
    world = transform_points(inverse_transformation(pose.matrix), points)
    pixels = 100.0 * torch.ones(7, 5, 2, dtype=torch.float64)
    found = project(State(pose, zoom), Problem.of(world, pixels, 800.0)).residual.permute(2, 1, 0) + pixels
    intrinsics = torch.eye(4, dtype=torch.float64).repeat(7, 1, 1)
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = 800.0 * zoom[:, 0].exp()
    by_functions = project_points(transform_points(pose.matrix, world), intrinsics[:, None, :3, :3].expand(7, 5, 3, 3))
    torch.testing.assert_close(found, by_functions, rtol=1e-9, atol=1e-9)
    size = torch.full((7,), 640.0, dtype=torch.float64)
    torch.testing.assert_close(
        found, PinholeCamera(intrinsics, pose.matrix, size, size).project(world), rtol=1e-7, atol=1e-7
    )


def test_our_rigs_are_two_transforms_of_kornias(scene, random_rotations, generator):
    pose, points, _ = scene
    rig = Pose(random_rotations(35, seed=1), torch.randn(35, 3, generator=generator, dtype=torch.float64))
    in_rig = transform_points(inverse_transformation(rig.matrix), points.view(35, 1, 3)).view(7, 5, 3)
    world = transform_points(inverse_transformation(pose.matrix), in_rig)
    of_pairs = Pose(rig.rotation.unflatten(0, (7, 5)), rig.translation.unflatten(0, (7, 5)))
    problem = Problem.of(world, torch.zeros(7, 5, 2, dtype=torch.float64), 800.0, rig=of_pairs)
    projection = project(State.of(pose), problem)
    expected = convert_points_from_homogeneous(points, eps=0.0)
    torch.testing.assert_close(projection.residual.permute(2, 1, 0), 800.0 * expected)
    assert projection.in_front.all()
