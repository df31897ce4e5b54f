"""Laws of projection, Jacobian, retraction and rotation angle."""

from __future__ import annotations

import math

import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.camera.perspective import project_points
from kornia.geometry.conversions import axis_angle_to_rotation_matrix

from kornia_pnpnet import Noise, Pose, Problem
from kornia_pnpnet.core.linalg import solve_positive
from kornia_pnpnet.core.trees import iter_tensors, map_tensors
from kornia_pnpnet.geometry import additive_tangent_map, change_tangent
from kornia_pnpnet.refine.residual import normal_equations, pixel_variance, project, retract, rotation_angle

DTYPES = (torch.float32, torch.float64)
FOCAL = torch.tensor(3400.0, dtype=torch.float64)


def random_scene(n, rotation, *, batch=7, shift=0.0, seed=0):
    """Points in front of cameras whose world lies ``shift`` away, and pixels 50 px off."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return 2 * torch.rand(*shape, generator=generator, dtype=torch.float64) - 1

    cam_points = uniform(batch, n, 3) * torch.tensor([10.0, 10, 40]) + torch.tensor([0.0, 0, 50])
    pose = Pose(rotation, 12.5 * uniform(batch, 3) + shift)
    world_points = (cam_points - pose.translation[:, None]) @ pose.rotation
    pixels = FOCAL * cam_points[..., :2] / cam_points[..., 2:] + 50 * uniform(batch, n, 2)
    return Problem(world_points, pixels, torch.ones(batch, n, dtype=torch.float64), FOCAL), pose


def per_problem_jacobian(function, at):
    """Derivative (B, M, D) of a map (B, D) -> (B, M) whose rows do not meet."""
    total = torch.autograd.functional.jacobian(lambda x: function(x).sum(0), at)  # (M, B, D)
    return total.movedim(0, 1)


def stacked_residual(projection):
    """First all horizontal, then all vertical coordinates in pixels, (B, 2N)."""
    return torch.cat(projection.residual, 1)


def normal_matrices(pose, corr, weights, *, update="retraction"):
    """The matrices (B, 6, 6) and right sides (B, 6) of the normal equations."""
    equations = normal_equations(project(pose, corr), weights)
    if update == "additive":
        equations = change_tangent(equations, additive_tangent_map(pose))
    rows = equations.hessian  # of the lower triangle
    matrix = [torch.stack([rows[max(i, j)][min(i, j)] for j in range(6)], -1) for i in range(6)]
    return torch.stack(matrix, 1), torch.stack(list(equations.gradient), -1)


# --- projection ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [3, 50])
def test_projection_is_kornias(n, random_rotations):
    corr, pose = random_scene(n, random_rotations(7))
    projection = project(pose, corr)
    pixels = torch.stack(projection.residual, -1) + corr.img_points
    torch.testing.assert_close(projection.sq_residual, (pixels - corr.img_points).square().sum(-1))

    K = torch.diag(torch.stack((FOCAL, FOCAL, torch.ones_like(FOCAL)))).expand(7, 3, 3)
    functional = project_points(transform(pose, corr.world_points), K[:, None].expand(7, n, 3, 3))
    torch.testing.assert_close(pixels, functional, rtol=1e-12, atol=1e-8)
    intrinsics = torch.eye(4, dtype=torch.float64).repeat(7, 1, 1)
    intrinsics[:, :3, :3] = K
    size = torch.full((7,), 6800.0, dtype=torch.float64)
    camera = PinholeCamera(intrinsics, pose.matrix, size, size)
    torch.testing.assert_close(pixels, camera.project(corr.world_points), rtol=1e-10, atol=1e-7)

    homogeneous = torch.cat((corr.world_points, torch.ones(7, n, 1, dtype=torch.float64)), -1) @ pose.matrix.mT
    torch.testing.assert_close(transform(pose, corr.world_points), homogeneous[..., :3])
    single = project(*map_tensors(torch.Tensor.float, (pose, corr)))
    assert {x.dtype for x in iter_tensors(single)} == {torch.float32, torch.bool}
    assert single.in_front.all()


# --- Jacobian ------------------------------------------------------------------------------------------------------

ROTATIONS = {"any": None, "identity": 0.0, "near_identity": 1e-5, "taylor_switch": 1e-3, "small": 0.1, "large": 3.0}
RETRACTIONS = {"retraction": retract, "additive": retract_additive}


@pytest.mark.parametrize(("n", "shift"), [(3, 0.0), (9, 1e4)])
@pytest.mark.parametrize("angle", ROTATIONS.values(), ids=ROTATIONS.keys())
@pytest.mark.parametrize("update", RETRACTIONS)
def test_normal_equations_are_of_the_derivative_through_the_retraction(update, n, angle, shift, random_rotations):
    """The Jacobian by autograd is that by central differences, and makes the analytic equations."""
    corr, pose = random_scene(n, random_rotations(7, angle=angle), shift=shift)

    def residual(delta):
        return stacked_residual(project(RETRACTIONS[update](pose, delta), corr)) / corr.focal  # (B, 2N)

    jacobian = per_problem_jacobian(residual, torch.zeros(7, 6, dtype=torch.float64))  # (B, 2N, 6)
    # A turn moves points by their distance from the origin: steps that move them by about 1e-4 either way.
    size = torch.tensor([1e-4 / (50.0 + shift)] * 3 + [1e-4] * 3, dtype=torch.float64)
    steps = torch.diag(size)[:, None].expand(6, 7, 6)
    central = torch.stack([residual(h) - residual(-h) for h in steps], -1) / (2 * size)
    assert ((jacobian - central) / jacobian.abs().amax(1, keepdim=True)).abs().max() < 1e-5

    generator = torch.Generator().manual_seed(1)
    # kornia's conversions near the identity are accurate to 2e-10 (see their docstrings).
    tolerance = 1e-6 if update == "additive" else 1e-10
    for weights in (torch.rand(7, n, generator=generator, dtype=torch.float64), torch.eye(n).double()[0].expand(7, n)):
        weighted = jacobian.mT * torch.cat((weights, weights), 1)[:, None]  # (B, 6, 2N)
        projection = project(pose, corr)
        hessian, gradient = weighted @ jacobian, (weighted @ stacked_residual(projection)[..., None])[..., 0]
        matrix, right_side = normal_matrices(pose, corr, weights, update=update)
        size = hessian.diagonal(dim1=-2, dim2=-1).sqrt()  # norms of the columns
        assert ((matrix - hessian) / (size[:, :, None] * size[:, None])).abs().max() < tolerance
        most = size * (weights * projection.sq_residual).sum(-1, keepdim=True).sqrt()
        assert ((right_side - gradient) / most).abs().max() < tolerance


# --- retraction -----------------------------------------------------------------------------------------------------


@pytest.fixture
def turns(random_rotations, generator):
    """A pose, tangents (50, 6) whose turns have length 1, and the pose by the exponential map."""
    delta = torch.randn(50, 6, generator=generator, dtype=torch.float64)
    delta = delta / delta[:, :3].norm(dim=-1, keepdim=True)
    pose = Pose(random_rotations(50), torch.zeros(50, 3).double())

    def exponential(omega):
        return axis_angle_to_rotation_matrix(omega) @ pose.rotation

    return pose, delta, exponential


@pytest.mark.parametrize("length", [0.0, 1e-12, 1e-3, 0.03, 1.0, 1e6])
def test_retraction_is_cayleys(length, turns):
    """It turns about its axis by 2 arctan(length / 2) = x - x³/12 + x⁵/80 - …; the opposite one undoes it."""
    pose, delta, exponential = turns
    moved = retract(pose, length * delta)
    expected = exponential(2.0 * math.atan(0.5 * length) * delta[:, :3])
    torch.testing.assert_close(moved.rotation, expected, rtol=0, atol=1e-14)
    torch.testing.assert_close(moved.translation, length * delta[:, 3:], rtol=0, atol=0)
    if 1e-3 < length < 0.1:
        error = rotation_angle(moved.rotation, exponential(length * delta[:, :3]))
        torch.testing.assert_close(error, torch.full_like(error, length**3 / 12), rtol=length**2, atol=0)
    back = retract(moved, -length * delta)
    torch.testing.assert_close(back.rotation, pose.rotation, rtol=0, atol=1e-13)
    torch.testing.assert_close(back.translation, pose.translation, rtol=0, atol=1e-14 * max(length, 1.0))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("length", [0.0, 1e-30, 1e-3, 1.0, 1e3, 1e15])
def test_retraction_by_anything_is_a_rotation_with_finite_gradients(length, dtype, turns):
    pose, delta, _ = turns
    rotation, delta = pose.rotation.to(dtype), (length * delta).to(dtype).requires_grad_()
    moved = retract(Pose(rotation, pose.translation.to(dtype)), delta)
    eye = torch.eye(3, dtype=dtype).expand(50, 3, 3)
    torch.testing.assert_close(moved.rotation @ moved.rotation.mT, eye, rtol=0, atol=20 * torch.finfo(dtype).eps)
    assert (torch.linalg.det(moved.rotation) > 0.5).all()
    moved.rotation.sum().backward()
    assert delta.grad.isfinite().all()


def test_additive_update_adds_rotation_vectors():
    vector, change = torch.tensor([[[0.3, -0.2, 0.5]], [[0.1, 0.4, -0.2]]], dtype=torch.float64)
    pose = Pose(axis_angle_to_rotation_matrix(vector), torch.zeros(1, 3).double())
    for factor in (0.0, 1.0, 1e-3, 10.0):
        moved = retract_additive(pose, torch.cat((factor * change, torch.ones(1, 3).double()), 1))
        torch.testing.assert_close(moved.rotation, axis_angle_to_rotation_matrix(vector + factor * change))
        torch.testing.assert_close(moved.translation, torch.ones(1, 3).double())


# --- rotation angle -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 9e-4, 1.1e-3, 1.0, math.pi / 2, math.pi - 1e-7, math.pi])
def test_rotation_angle_of_a_known_turn(angle, random_rotations):
    base, turn = random_rotations(200, seed=1), random_rotations(200, angle=angle, seed=2)
    expected = torch.full((200,), angle, dtype=torch.float64)
    for a, b in ((turn @ base, base), (base, turn @ base)):
        torch.testing.assert_close(rotation_angle(a, b), expected, rtol=0, atol=2e-15)
    if 1e-5 < angle < 3.0:  # float32 keeps small angles, too
        single = rotation_angle(turn.float(), torch.eye(3).expand(200, 3, 3))
        torch.testing.assert_close(single, expected.float(), rtol=1e-2, atol=0)


# --- behind the camera ----------------------------------------------------------------------------------------------


def test_pixel_variance_is_that_of_the_pixel(make_problems):
    """Against the noise of many draws, mean over both coordinates."""
    p = make_problems(n=5, batch=1, noise=False)
    generator = torch.Generator().manual_seed(0)
    moved = p.world_points + 0.05 * torch.randn(100_000, 5, 3, generator=generator, dtype=torch.float64)
    off = 2.0 * torch.randn(100_000, 5, 2, generator=generator, dtype=torch.float64)
    count = torch.ones(1, 5, dtype=torch.float64)
    corr = Problem(p.world_points, p.img_points, count, p.intrinsics[0, 0, 0])
    noise = Noise(2.0 * count, 0.05 * count)
    variance = pixel_variance(project(p.pose, corr), noise, corr.focal)
    cam = transform(Pose(*(x.expand(100_000, *x.shape[1:]) for x in p.pose)), moved)
    drawn = (corr.focal * cam[..., :2] / cam[..., 2:] + off).var(0).mean(-1)
    torch.testing.assert_close(variance[0], drawn, rtol=0.02, atol=0)
