"""Laws of projection, Jacobian, retraction and rotation angle."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.camera.perspective import project_points
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch.utils._pytree import tree_leaves, tree_map

from kornia_pnpnet import Correspondences, Noise, Pose
from kornia_pnpnet.geometry import (
    MIN_DEPTH_RATIO,
    additive_tangent_map,
    change_tangent,
    move,
    normal_equations,
    pixel_variance,
    project,
    retract,
    retract_additive,
    rotation_angle,
    transform,
)
from kornia_pnpnet.refine import lm_step

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
    return Correspondences(world_points, pixels, torch.ones(batch, n, dtype=torch.float64), FOCAL), pose


def per_problem_jacobian(function, at):
    """Derivative (B, M, D) of a map (B, D) -> (B, M) whose rows do not meet."""
    total = torch.autograd.functional.jacobian(lambda x: function(x).sum(0), at)  # (M, B, D)
    return total.movedim(0, 1)


def stacked_residual(projection):
    """First all horizontal, then all vertical coordinates in pixels, (B, 2N)."""
    return torch.cat(projection.residual, 1)


def equations_at(pose, corr, weights, *, additive):
    equations = normal_equations(project(pose, corr), weights)
    return change_tangent(equations, additive_tangent_map(pose)) if additive else equations


def dense(hessian):
    """The symmetric matrices (B, 6, 6) of the entries up to the diagonal."""
    assert [len(row) for row in hessian] == [1, 2, 3, 4, 5, 6]
    return torch.stack([torch.stack([hessian[max(i, j)][min(i, j)] for j in range(6)], -1) for i in range(6)], 1)


def jacobian_rows(pose, corr, *, additive):
    """The Jacobian (B, 2N, 6), one row at a time: the gradient when one residual is 1 and one pair has a weight."""
    projection = project(pose, corr)
    batch, n = projection.inv_depth.shape
    each = tree_map(lambda x: x.repeat_interleave(n, 0), projection)
    weights = torch.eye(n, dtype=torch.float64).repeat(batch, 1)
    one, zero = torch.ones_like(weights), torch.zeros_like(weights)
    tangent_map = additive_tangent_map(pose).repeat_interleave(n, 0)
    rows = []
    for residual in ((one, zero), (zero, one)):
        scaled = tuple(x / each.inv_depth for x in residual)
        equations = normal_equations(each._replace(residual=residual, scaled_residual=scaled), weights)
        equations = change_tangent(equations, tangent_map) if additive else equations
        rows.append(torch.stack(list(equations.gradient), -1).unflatten(0, (batch, n)))
    return torch.cat(rows, 1)


# --- projection ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [3, 9, 50])
def test_projection_is_kornias(n, random_rotations):
    corr, pose = random_scene(n, random_rotations(7))
    projection = project(pose, corr)
    pixels = torch.stack(projection.residual, -1) + corr.img_points

    K = torch.diag(torch.stack((FOCAL, FOCAL, torch.ones_like(FOCAL)))).expand(7, 3, 3)
    functional = project_points(transform(pose, corr.world_points), K[:, None].expand(7, n, 3, 3))
    torch.testing.assert_close(pixels, functional, rtol=1e-12, atol=1e-8)

    intrinsics = torch.eye(4, dtype=torch.float64).repeat(7, 1, 1)
    intrinsics[:, :3, :3] = K
    size = torch.full((7,), 6800.0, dtype=torch.float64)
    camera = PinholeCamera(intrinsics, pose.matrix, size, size)
    torch.testing.assert_close(pixels, camera.project(corr.world_points), rtol=1e-10, atol=1e-7)


def test_projection_is_of_one_piece(random_rotations):
    """Its parts are each other's: the coordinates of R x + t, over the depth, times the focal length."""
    corr, pose = random_scene(9, random_rotations(7))
    projection = project(pose, corr)
    cam_points = transform(pose, corr.world_points)
    torch.testing.assert_close(projection.inv_depth, cam_points[..., 2].reciprocal())
    rotated = torch.stack(projection.rotated, -1) + pose.translation[:, None]
    torch.testing.assert_close(rotated, cam_points)
    plane_points = torch.stack(projection.plane_points, -1)
    torch.testing.assert_close(plane_points, cam_points[..., :2] / cam_points[..., 2:])
    residual = torch.stack(projection.residual, -1)
    torch.testing.assert_close(residual, FOCAL * plane_points - corr.img_points, rtol=1e-10, atol=1e-9)
    scaled = torch.stack(projection.scaled_residual, -1)
    torch.testing.assert_close(scaled, residual * cam_points[..., 2:], rtol=1e-10, atol=1e-8)
    torch.testing.assert_close(projection.sq_residual, residual.square().sum(-1))


def test_transform_is_the_matrix_of_the_pose(random_rotations):
    corr, pose = random_scene(5, random_rotations(7))
    homogeneous = torch.cat((corr.world_points, torch.ones(7, 5, 1, dtype=torch.float64)), -1) @ pose.matrix.mT
    torch.testing.assert_close(transform(pose, corr.world_points), homogeneous[..., :3])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_projection_keeps_dtype_and_shapes(dtype, random_rotations):
    corr, pose = random_scene(4, random_rotations(7))
    corr, pose = Correspondences(*(x.to(dtype) for x in corr[:4])), Pose(*(x.to(dtype) for x in pose))
    projection = project(pose, corr)
    assert all(x.shape == (7, 4) for x in tree_leaves(projection))
    assert {x.dtype for x in tree_leaves(projection)} == {dtype, torch.bool}
    assert projection.in_front.all()
    for additive in (False, True):
        entries = tree_leaves(equations_at(pose, corr, corr.weights, additive=additive))
        assert len(entries) == 21 + 6
        assert all(x.shape == (7,) and x.dtype == dtype for x in entries)


# --- Jacobian ------------------------------------------------------------------------------------------------------

ROTATIONS = {"any": None, "identity": 0.0, "near_identity": 1e-5, "taylor_switch": 1e-3, "small": 0.1, "large": 3.0}
RETRACTIONS = {"retraction": retract, "additive": retract_additive}


@pytest.mark.parametrize("shift", [0.0, 1e4])
@pytest.mark.parametrize("angle", ROTATIONS.values(), ids=ROTATIONS.keys())
@pytest.mark.parametrize("n", [3, 4, 6, 9, 50])
@pytest.mark.parametrize("update", RETRACTIONS)
def test_jacobian_is_the_derivative_through_the_retraction(update, n, angle, shift, random_rotations):
    corr, pose = random_scene(n, random_rotations(7, angle=angle), shift=shift)
    additive = update == "additive"

    def residual(delta):
        return stacked_residual(project(RETRACTIONS[update](pose, delta), corr)) / corr.focal  # (B, 2N)

    analytic = jacobian_rows(pose, corr, additive=additive)  # (B, 2N, 6)
    automatic = per_problem_jacobian(residual, torch.zeros(7, 6, dtype=torch.float64))
    # A turn moves points by their distance from the origin: steps that move them by about 1e-4 either way.
    size = torch.tensor([1e-4 / (50.0 + shift)] * 3 + [1e-4] * 3, dtype=torch.float64)
    steps = torch.diag(size)[:, None].expand(6, 7, 6)
    central = torch.stack([residual(h) - residual(-h) for h in steps], -1) / (2 * size)

    # kornia's conversions near the identity are accurate to 2e-10 (see their docstrings).
    tolerance = 1e-6 if additive else 1e-10
    scale = analytic.abs().amax(1, keepdim=True)
    assert ((analytic - automatic) / scale).abs().max() < tolerance
    assert ((analytic - central) / scale).abs().max() < 1e-5

    weights = torch.rand(7, n, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    weighted = automatic.mT * torch.cat((weights, weights), 1)[:, None]  # (B, 6, 2N)
    equations = equations_at(pose, corr, weights, additive=additive)
    pixels = stacked_residual(project(pose, corr))[..., None]
    hessian, gradient = weighted @ automatic, (weighted @ pixels)[..., 0]
    size = hessian.diagonal(dim1=-2, dim2=-1).sqrt()  # norms of the columns
    assert ((dense(equations.hessian) - hessian) / (size[:, :, None] * size[:, None])).abs().max() < tolerance
    most = size * (weights * project(pose, corr).sq_residual).sum(-1, keepdim=True).sqrt()
    assert ((torch.stack(list(equations.gradient), -1) - gradient) / most).abs().max() < tolerance


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    omega=st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3),
    translation=st.lists(st.floats(-100, 100), min_size=3, max_size=3),
    update=st.sampled_from(sorted(RETRACTIONS)),
)
def test_jacobian_of_any_pose(omega, translation, update):
    pose = Pose(
        axis_angle_to_rotation_matrix(torch.tensor([omega], dtype=torch.float64)),
        torch.tensor([translation], dtype=torch.float64),
    )
    cam_points = torch.tensor([[[1.0, 2, 10], [-4, 3, 20], [5, -6, 30], [0, 0, 5]]], dtype=torch.float64)
    world_points = (cam_points - pose.translation[:, None]) @ pose.rotation
    corr = Correspondences(world_points, torch.zeros(1, 4, 2).double(), torch.ones(1, 4).double(), FOCAL)

    def residual(delta):
        return stacked_residual(project(RETRACTIONS[update](pose, delta), corr)) / corr.focal

    automatic = per_problem_jacobian(residual, torch.zeros(1, 6, dtype=torch.float64))
    analytic = jacobian_rows(pose, corr, additive=update == "additive")
    # What kornia's series near the identity leaves.
    assert (analytic - automatic).abs().max() <= 1e-6 * analytic.abs().max()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("unit", [2.0**-20, 2.0**20])
def test_normal_equations_in_another_unit_of_the_world(unit, dtype, random_rotations):
    """A translation is the unit's, a turn is not: to the bit, since powers of two round nothing."""
    corr, pose = random_scene(9, random_rotations(7))
    corr, pose = Correspondences(*(x.to(dtype) for x in corr[:4])), Pose(*(x.to(dtype) for x in pose))
    scaled = corr._replace(world_points=unit * corr.world_points)
    there = normal_equations(project(pose._replace(translation=unit * pose.translation), scaled), corr.weights)
    here = normal_equations(project(pose, corr), corr.weights)
    unit = torch.tensor([1.0] * 3 + [unit] * 3, dtype=dtype)
    # A common factor of the equations is free.
    factor = dense(there.hessian)[:, :1, :1] / dense(here.hessian)[:, :1, :1]
    assert torch.equal(unit[:, None] * dense(there.hessian) * unit, factor * dense(here.hessian))
    gradient = torch.stack(list(here.gradient), -1)
    assert torch.equal(unit * torch.stack(list(there.gradient), -1), factor[:, 0] * gradient)


# --- retraction -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", ROTATIONS.values(), ids=ROTATIONS.keys())
def test_retraction_by_zero_is_the_identity(angle, random_rotations):
    pose = Pose(random_rotations(7, angle=angle), torch.arange(21, dtype=torch.float64).view(7, 3))
    moved = retract(pose, torch.zeros(7, 6, dtype=torch.float64))
    assert torch.equal(moved.rotation, pose.rotation)
    assert torch.equal(moved.translation, pose.translation)
    moved = retract_additive(pose, torch.zeros(7, 6, dtype=torch.float64))
    # The round trip through the rotation vector, accurate to 2e-10 in kornia's low-angle branch.
    torch.testing.assert_close(moved.rotation, pose.rotation, rtol=0, atol=1e-9)
    assert torch.equal(moved.translation, pose.translation)


@pytest.mark.parametrize("update", RETRACTIONS)
@pytest.mark.parametrize("length", [1e-12, 1e-6, 1e-3, 1.1e-3, 0.3, 2.0, 30.0])
def test_retraction_stays_on_the_group(update, length, random_rotations, generator):
    delta = torch.randn(50, 6, generator=generator, dtype=torch.float64)
    delta = length * delta / delta.norm(dim=-1, keepdim=True)
    rotation = RETRACTIONS[update](Pose(random_rotations(50), torch.zeros(50, 3).double()), delta).rotation
    eye = torch.eye(3, dtype=torch.float64).expand(50, 3, 3)
    torch.testing.assert_close(rotation @ rotation.mT, eye, rtol=0, atol=1e-12)
    assert (torch.linalg.det(rotation) > 0.5).all()


@pytest.fixture
def turns(random_rotations, generator):
    """A pose, tangents (50, 6) whose turns have length 1, and the pose by the exponential map."""
    delta = torch.randn(50, 6, generator=generator, dtype=torch.float64)
    delta = delta / delta[:, :3].norm(dim=-1, keepdim=True)
    pose = Pose(random_rotations(50), torch.zeros(50, 3).double())

    def exponential(omega):
        return axis_angle_to_rotation_matrix(omega) @ pose.rotation

    return pose, delta, exponential


@pytest.mark.parametrize("length", [1e-12, 1e-6, 1e-3, 0.1, 1.0, 2.0, 30.0, 1e6])
def test_retraction_turns_about_its_axis_by_twice_the_arc_tangent_of_half_its_length(length, turns):
    pose, delta, exponential = turns
    moved = retract(pose, length * delta)
    expected = exponential(2.0 * math.atan(0.5 * length) * delta[:, :3])
    torch.testing.assert_close(moved.rotation, expected, rtol=0, atol=1e-14)
    torch.testing.assert_close(moved.translation, length * delta[:, 3:], rtol=0, atol=0)


@pytest.mark.parametrize("length", [0.1, 0.03, 0.01])
def test_retraction_is_the_exponential_to_second_order(length, turns):
    pose, delta, exponential = turns
    error = rotation_angle(retract(pose, length * delta).rotation, exponential(length * delta[:, :3]))
    # 2 arctan(x / 2) = x - x³/12 + x⁵/80 - ...
    torch.testing.assert_close(error, torch.full_like(error, length**3 / 12), rtol=length**2, atol=0)


def test_the_opposite_retraction_undoes_it(turns):
    pose, delta, _ = turns
    back = retract(retract(pose, delta), -delta)
    torch.testing.assert_close(back.rotation, pose.rotation, rtol=0, atol=1e-14)
    torch.testing.assert_close(back.translation, pose.translation, rtol=0, atol=1e-14)


def test_moving_by_entries_is_retracting(turns):
    pose, delta, _ = turns
    moved = move(pose, delta.unbind(-1))
    assert torch.equal(moved.rotation, retract(pose, delta).rotation)
    assert torch.equal(moved.translation, retract(pose, delta).translation)


def test_gradcheck_of_the_retraction(turns):
    pose, delta, _ = turns
    leaves = [x[:3].clone().requires_grad_() for x in (*pose, delta)]
    for factor in (0.0, 1.0):
        assert torch.autograd.gradcheck(lambda r, t, d, factor=factor: tuple(retract(Pose(r, t), factor * d)), leaves)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("length", [0.0, 1e-30, 1e3, 1e15])
def test_retraction_by_anything_is_a_rotation_with_finite_gradients(length, dtype, turns):
    pose, delta, _ = turns
    rotation, delta = pose.rotation.to(dtype), (length * delta).to(dtype).requires_grad_()
    moved = retract(Pose(rotation, pose.translation.to(dtype)), delta)
    eye = torch.eye(3, dtype=dtype).expand(50, 3, 3)
    torch.testing.assert_close(moved.rotation @ moved.rotation.mT, eye, rtol=0, atol=20 * torch.finfo(dtype).eps)
    moved.rotation.sum().backward()
    assert delta.grad.isfinite().all()


def test_additive_update_adds_rotation_vectors():
    vector = torch.tensor([[0.3, -0.2, 0.5]], dtype=torch.float64)
    change = torch.tensor([[0.1, 0.4, -0.2]], dtype=torch.float64)
    pose = Pose(axis_angle_to_rotation_matrix(vector), torch.zeros(1, 3).double())
    moved = retract_additive(pose, torch.cat((change, torch.ones(1, 3).double()), 1))
    torch.testing.assert_close(moved.rotation, axis_angle_to_rotation_matrix(vector + change))
    torch.testing.assert_close(moved.translation, torch.ones(1, 3).double())


# --- rotation angle -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "angle", [0.0, 1e-12, 1e-9, 1e-6, 9e-4, 1.1e-3, 0.1, 1.0, math.pi / 2, 3.0, math.pi - 1e-7, math.pi]
)
def test_rotation_angle_of_a_known_turn(angle, random_rotations):
    base = random_rotations(200, seed=1)
    turned = random_rotations(200, angle=angle, seed=2) @ base
    expected = torch.full((200,), angle, dtype=torch.float64)
    torch.testing.assert_close(rotation_angle(turned, base), expected, rtol=0, atol=2e-15)
    torch.testing.assert_close(rotation_angle(base, turned), expected, rtol=0, atol=2e-15)


def test_rotation_angle_in_float32_keeps_small_angles(random_rotations):
    turned = random_rotations(200, angle=1e-5, seed=2).float()
    angle = rotation_angle(turned, torch.eye(3).expand(200, 3, 3))
    torch.testing.assert_close(angle, torch.full((200,), 1e-5), rtol=1e-2, atol=0)


# --- behind the camera ----------------------------------------------------------------------------------------------

BEHIND = {
    "behind": (1.0, 2.0, -5.0),
    "in_the_plane": (1.0, 2.0, 0.0),
    "at_the_centre": (0.0, 0.0, 0.0),
    "nearly_in_the_plane": (1.0, 1.0, 0.5 * MIN_DEPTH_RATIO),
    "far_behind": (1e12, -1e12, -1e12),
    "tiny": (1e-30, 0.0, -1e-30),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("point", BEHIND.values(), ids=BEHIND.keys())
def test_points_behind_the_camera_do_not_count(point, dtype):
    front = torch.tensor([[1.0, 2, 10], [-4, 3, 20], [5, -6, 30], [3, 3, 7]], dtype=dtype)
    world = torch.cat((front, torch.tensor([point], dtype=dtype)))[None].requires_grad_()
    pixels = torch.full((1, 5, 2), 100.0, dtype=dtype, requires_grad=True)
    corr = Correspondences(world, pixels, torch.ones(1, 5, dtype=dtype), FOCAL.to(dtype))
    translation = torch.zeros(1, 3, dtype=dtype, requires_grad=True)
    pose = Pose(torch.eye(3, dtype=dtype)[None].requires_grad_(), translation)

    projection = project(pose, corr)
    assert projection.in_front.tolist() == [[True] * 4 + [False]]
    assert all(x.isfinite().all() for x in tree_leaves(projection))
    for zero in (projection.inv_depth, *projection.plane_points):
        assert zero[0, 4] == 0
    heavy = torch.tensor([[1.0] * 4 + [1e6]], dtype=dtype)
    counted, not_counted = (normal_equations(projection, w) for w in (heavy, heavy.clamp(max=1.0)))
    assert all(torch.equal(a, b) for a, b in zip(tree_leaves(counted), tree_leaves(not_counted), strict=True))

    one = torch.tensor(1.0, dtype=dtype)
    step = lm_step(corr, pose, projection, corr.weights, one, 1e-3 * one)
    (step.pose.rotation.square().sum() + step.pose.translation.square().sum()).backward()
    for tensor in (world, pixels, pose.rotation, translation):
        assert tensor.grad.isfinite().all()
    assert torch.equal(world.grad[0, 4], torch.zeros(3, dtype=dtype))
    assert torch.equal(pixels.grad[0, 4], torch.zeros(2, dtype=dtype))

    # The step that the points in front would have taken alone, but for the order in which sums are rounded.
    alone = Correspondences(world[:, :4], pixels[:, :4], corr.weights[:, :4], corr.focal)
    without = lm_step(alone, pose, project(pose, alone), alone.weights, one, 1e-3 * one)
    torch.testing.assert_close(
        step.pose.matrix, without.pose.matrix, rtol=1e-4 if dtype == torch.float32 else 1e-12, atol=0
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_in_front_does_not_depend_on_the_unit(dtype):
    point = torch.tensor([[[1.0, 1.0, 1e-3], [1.0, 1.0, 2e-3], [0.3, 0.1, 1.0], [0.0, 0.0, -1.0]]], dtype=dtype)
    pose = Pose(torch.eye(3, dtype=dtype)[None], torch.zeros(1, 3, dtype=dtype))
    for unit in (1e-6, 1.0, 1e6):
        corr = Correspondences(
            point * unit, torch.zeros(1, 4, 2).to(dtype), torch.ones(1, 4).to(dtype), FOCAL.to(dtype)
        )
        assert project(pose, corr).in_front.tolist() == [[False, True, True, False]]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_all_zeros_is_finite(dtype):
    zeros = torch.zeros(1, 4, 3, dtype=dtype, requires_grad=True)
    translation = torch.zeros(1, 3, dtype=dtype, requires_grad=True)
    pose = Pose(torch.eye(3, dtype=dtype)[None], translation)
    corr = Correspondences(zeros, torch.zeros(1, 4, 2).to(dtype), torch.zeros(1, 4).to(dtype), FOCAL.to(dtype))
    projection = project(pose, corr)
    assert not projection.in_front.any()
    entries = tree_leaves(normal_equations(projection, torch.ones_like(corr.weights)))
    assert not any(x.any() for x in entries)
    (sum(entries) + projection.sq_residual).sum().backward()
    assert zeros.grad.isfinite().all()
    assert translation.grad.isfinite().all()


def test_pixel_variance_is_that_of_the_pixel(make_problems):
    """Against the noise of many draws, mean over both coordinates."""
    p = make_problems(n=5, batch=1, noise=False)
    generator = torch.Generator().manual_seed(0)
    moved = p.world_points + 0.05 * torch.randn(100_000, 5, 3, generator=generator, dtype=torch.float64)
    off = 2.0 * torch.randn(100_000, 5, 2, generator=generator, dtype=torch.float64)
    count = torch.ones(1, 5, dtype=torch.float64)
    corr = Correspondences(p.world_points, p.img_points, count, p.intrinsics[0, 0, 0])
    noise = Noise(2.0 * count, 0.05 * count)
    variance = pixel_variance(project(p.pose, corr), noise, corr.focal)
    cam = transform(Pose(*(x.expand(100_000, *x.shape[1:]) for x in p.pose)), moved)
    drawn = (corr.focal * cam[..., :2] / cam[..., 2:] + off).var(0).mean(-1)
    torch.testing.assert_close(variance[0], drawn, rtol=0.02, atol=0)
