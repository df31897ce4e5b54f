"""Laws of P3P: all solutions and nothing else, in any order and unit, for every problem of a batch alone."""

import math

import pytest
import torch
from strategies import are_rotations, finite

from kornia_pnpnet import Pose
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.data.draws import random_poses
from kornia_pnpnet.problem import Hypotheses, Problem
from kornia_pnpnet.propose.p3p import p3p
from kornia_pnpnet.propose.p3p_rig import P3PRig

DTYPES = (torch.float64, torch.float32)
NEAR = 1e-6


def rotations(batch, seed):
    return random_poses(batch, torch.Generator().manual_seed(seed), max_angle=math.pi).rotation


def seen(cam_points, generator):
    """World points and plane points of points in the camera frame, and the pose, which is anywhere."""
    rotation = rotations(len(cam_points), seed=77)
    translation = torch.randn(len(cam_points), 3, generator=generator, dtype=torch.float64)
    world_points = (cam_points - translation[:, None]) @ rotation
    return world_points, cam_points[..., :2] / cam_points[..., 2:], Pose(rotation, translation)


def wide(batch, seed=0):
    """A field of view of 90 degrees, depths from 0.1 to 10."""
    generator = torch.Generator().manual_seed(seed)
    xy, z = torch.rand(batch, 3, 3, generator=generator, dtype=torch.float64).split((2, 1), -1)
    return seen(torch.cat((2.0 * xy - 1.0, torch.ones_like(z)), -1) * (0.1 + 9.9 * z), generator)


def protocol(batch, seed=0):
    """The package's own problems without noise."""
    source = SyntheticProblems(n=3, batch_size=batch, seed=seed, img_sigma=0.0, world_sigma=0.0, dtype=torch.float64)
    problems = source.batch(0)
    return problems.world_points, problems.img_points / source.focal, problems.pose


def tele(batch, seed=0):
    """Points around one that is a hundred times as far away."""
    generator = torch.Generator().manual_seed(seed)
    centre = torch.tensor([20.0, -10.0, 100.0], dtype=torch.float64)
    return seen(centre + torch.randn(batch, 3, 3, generator=generator, dtype=torch.float64), generator)


SCENES = {"wide": wide, "protocol": protocol, "tele": tele}


def errors(found, pose):
    """Largest error of an entry of the rotation plus relative error of the translation, (B, S), infinite if invalid."""
    rotation = (found.pose.rotation - pose.rotation[:, None]).abs().amax((-1, -2))
    translation = (found.pose.translation - pose.translation[:, None]).norm(dim=-1)
    error = rotation + translation / pose.translation.norm(dim=-1)[:, None]
    return torch.where(found.valid, error, torch.inf)


def in_camera(found, world_points):
    """The points in the camera frame of each solution, (B, S, 3, 3)."""
    return torch.einsum("bsij,bnj->bsni", found.pose.rotation, world_points) + found.pose.translation[:, :, None]


def reprojection_errors(found, world_points, plane_points):
    """The largest error of each valid solution; infinite behind the camera."""
    cam_points = in_camera(found, world_points)
    error = (cam_points[..., :2] / cam_points[..., 2:] - plane_points[:, None]).norm(dim=-1).amax(-1)
    return torch.where((cam_points[..., 2] > 0).all(-1), error, torch.inf)[found.valid]


def assert_same_solutions(found, expected, tolerance=NEAR):
    """Each solution of one is a solution of the other."""
    assert torch.equal(found.valid.sum(-1), expected.valid.sum(-1))
    matrix, other = (torch.cat((h.pose.rotation, h.pose.translation[..., None]), -1) for h in (found, expected))
    apart = (matrix[:, :, None] - other[:, None]).abs().amax((-1, -2))  # (B, S, S)
    apart = torch.where(expected.valid[:, None], apart, torch.inf)
    assert (apart.amin(-1)[found.valid] < tolerance).all()


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_the_true_pose_is_among_the_solutions_and_all_of_them_are_solutions(scene):
    world_points, plane_points, pose = scene(20_000)
    found = p3p(world_points, plane_points)
    assert found.pose.rotation.shape == (20_000, 4, 3, 3)
    assert (errors(found, pose).amin(-1) < NEAR).all()
    assert (reprojection_errors(found, world_points, plane_points) < 1e-9).all()
    rotation = found.pose.rotation[found.valid]
    assert (rotation @ rotation.mT - torch.eye(3)).abs().max() < 1e-11
    assert (torch.linalg.det(rotation) > 0).all()


def test_there_are_one_to_four_solutions_and_no_two_are_the_same():
    found = p3p(*wide(20_000)[:2])
    counts = torch.bincount(found.valid.sum(-1))
    assert counts[0] == 0
    assert (counts[1:] > 100).all()
    apart = (found.pose.rotation[:, :, None] - found.pose.rotation[:, None]).abs().amax((-1, -2))
    apart = torch.where(found.valid[:, :, None] & found.valid[:, None] & ~torch.eye(4, dtype=torch.bool), apart, 1.0)
    assert apart.min() > NEAR


def test_order_frame_and_unit_of_the_points_do_not_matter(generator):
    world_points, plane_points, _ = wide(5000)
    expected = p3p(world_points, plane_points)
    for order in ((1, 2, 0), (1, 0, 2), (2, 1, 0)):
        assert_same_solutions(p3p(world_points[:, order], plane_points[:, order]), expected)
    turn, shift = rotations(5000, seed=1), torch.randn(5000, 3, generator=generator, dtype=torch.float64)
    for scale in (1e-12, 1e12):
        found = p3p(scale * (world_points @ turn.mT + shift[:, None]), plane_points)
        # x_cam = R' s (Q x + c) + t' is s times R' Q x + R' c + t' / s
        rotation = found.pose.rotation @ turn[:, None]
        moved = (found.pose.rotation @ shift[:, None, :, None])[..., 0] + found.pose.translation / scale
        assert_same_solutions(Hypotheses(Pose(rotation, moved), found.valid), expected)


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_symmetric_scene_whose_cubic_has_its_roots_at_zero_and_infinity(dtype):
    # An equilateral triangle seen from its axis: one pose upright, and three poses from the side.
    angle = torch.tensor([0.0, 2.0, 4.0], dtype=dtype) * math.pi / 3.0
    world_points = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), -1)[None]
    cam_points = world_points + torch.tensor([0.0, 0.0, 4.0], dtype=dtype)
    found = p3p(world_points, cam_points[..., :2] / cam_points[..., 2:])
    assert found.valid.all()
    upright = Pose(torch.eye(3, dtype=dtype)[None], torch.tensor([[0.0, 0.0, 4.0]], dtype=dtype))
    assert errors(found, upright).min() < 100.0 * torch.finfo(dtype).eps
    assert (found.pose.rotation[..., 2, 2] < 0.99).sum() == 3


@pytest.mark.parametrize("offset", [0.0, 1e-12, 1e-6])
def test_two_solutions_that_meet_are_not_lost(offset, generator):
    # They meet where the camera is on the cylinder upright on the circle through the points.
    angles = 2.0 * math.pi * torch.rand(5000, 4, generator=generator, dtype=torch.float64)
    circle = torch.stack((angles.cos(), angles.sin(), torch.zeros_like(angles)), -1)
    centre = circle[:, 3] + torch.tensor([offset, 0.0, 2.0])
    axis3 = torch.nn.functional.normalize(-centre, dim=-1)
    axis1 = torch.nn.functional.normalize(torch.linalg.cross(circle[:, 0].roll(1, -1) + 0.1, axis3), dim=-1)
    rotation = torch.stack((axis1, torch.linalg.cross(axis3, axis1), axis3), -2)
    cam_points = (circle[:, :3] - centre[:, None]) @ rotation.mT
    edges = (circle[:, :3] - circle[:, :3].roll(1, 1)).norm(dim=-1).amin(-1)
    cam_points = cam_points[edges > 0.2]  # short edges would lose digits
    world_points, plane_points, pose = seen(cam_points, generator)
    found = p3p(world_points, plane_points)
    assert found.valid.any(-1).all()
    assert (errors(found, pose).amin(-1) < 1e-5).all()
    assert (errors(found, pose).amin(-1) < NEAR).double().mean() > 0.98
    assert (reprojection_errors(found, world_points, plane_points) < 1e-9).all()


@pytest.mark.parametrize("unit", [2.0**-90, 2.0**90])
@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_single_precision_solves_what_it_can(scene, unit):
    world_points, plane_points, pose = scene(20_000)
    found = p3p(unit * world_points.float(), plane_points.float())
    assert found.pose.rotation.dtype == torch.float32
    finite(found)
    error = (found.pose.rotation - pose.rotation[:, None]).abs().amax((-1, -2))
    error = torch.where(found.valid, error, torch.inf).amin(-1)
    assert error.quantile(0.5) < 1e-5
    assert error.quantile(0.99) < 1e-3
    assert (error < 0.01).double().mean() > 0.999
    exact = p3p(world_points, plane_points)
    assert (found.valid.sum(-1) == exact.valid.sum(-1)).double().mean() > 0.99


@pytest.mark.parametrize("base", [0.0, 0.3, 3.0])
@pytest.mark.parametrize("looks", ["ahead", "everywhere"])
def test_three_pairs_of_a_rig(base, looks, generator):
    world_points, plane_points, pose = wide(5000)
    turns = rotations(15_000, seed=5).view(5000, 3, 3, 3) if looks == "everywhere" else torch.eye(3).double()
    rig = Pose(turns.expand(5000, 3, 3, 3), base * torch.randn(5000, 3, 3, generator=generator, dtype=torch.float64))
    in_camera_of_pair = in_camera(Hypotheses(Pose(*(x[:, None] for x in pose)), None), world_points)[:, 0]
    in_rig = (rig.rotation.mT @ (in_camera_of_pair - rig.translation)[..., None])[..., 0]
    world_points = (in_rig - pose.translation[:, None]) @ pose.rotation
    found = P3PRig().hypotheses(Problem.of(world_points, plane_points, rig=rig))
    assert (errors(found, pose).amin(-1) < NEAR).double().mean() > 0.95
    in_rig = in_camera(found, world_points)
    cam_points = torch.einsum("bnij,bsnj->bsni", rig.rotation, in_rig) + rig.translation[:, None]
    gap = (cam_points[..., :2] / cam_points[..., 2:] - plane_points[:, None]).norm(dim=-1).amax(-1)[found.valid]
    assert (cam_points[found.valid][..., 2] > 0).all()
    assert (gap < 1e-3).all()
    assert (gap < 1e-9).double().mean() > 0.98


@pytest.mark.parametrize("dtype", DTYPES)
def test_numbers_that_make_no_sense_have_finite_solutions(dtype):
    values = torch.tensor([0.0, -1.0, 1e30, torch.inf, -torch.inf, torch.nan])
    points = [x.to(dtype) for x in wide(36)[:2]]
    points[0][:, 0, 0], points[1][:, 1, 1] = values.repeat(6), values.repeat_interleave(6)
    found = p3p(*points)
    are_rotations(found.pose.rotation[found.valid])
    finite(found)
