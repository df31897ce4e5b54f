"""Laws of the normalisation: it can be undone, projections stay consistent, and nothing that is not there matters."""

import itertools

import pytest
import torch
from kornia.geometry.conversions import denormalize_points_with_intrinsics

from kornia_pnpnet import Normalize, Pose
from kornia_pnpnet.frame import F_CONST
from kornia_pnpnet.problem import Starts, State
from kornia_pnpnet.propose.views import VIEWS, from_views
from kornia_pnpnet.refine.residual import project

DOUBLE = torch.float64
both_dtypes = pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
OPTIONS = [dict(zip(("order", "center", "scale"), x, strict=True)) for x in itertools.product((True, False), repeat=3)]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("f_const", [1.0, F_CONST])
@pytest.mark.parametrize(("fx", "fy", "cx", "cy"), [(800, 1200, 0, 0), (3000, 2000, 2016.5, -7.25), (1, 1, 0.5, 0.5)])
def test_poses_go_to_the_frame_of_the_points_and_back_for_any_camera(fx, fy, cx, cy, f_const, options, make_problems):
    """Pixels are Kornia's times the focal length, and residuals scale with it."""
    p = make_problems(outliers=2)
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=DOUBLE).expand(7, 3, 3)
    rays = p.img_points / p.intrinsics[:, 0, 0, None, None]
    img_points = denormalize_points_with_intrinsics(rays, K)
    problem, frame = Normalize(f_const=f_const, **options)(p.world_points, img_points, K)
    cam = p.true_cam_points
    pixels, expected = f_const * rays, f_const * (cam[..., :2] / cam[..., 2:] - rays)
    if frame.order is not None:
        pixels, expected = (x.gather(1, frame.order[..., None].expand(-1, -1, 2)) for x in (pixels, expected))
    pose = frame.apply(p.pose)
    torch.testing.assert_close(problem.img_points, pixels)
    found = project(State.of(pose), problem).residual.permute(2, 1, 0)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-10 * f_const)
    for back in (frame.undo(pose), frame.apply(frame.undo(p.pose))):
        torch.testing.assert_close(back.matrix, p.pose.matrix, rtol=0, atol=1e-10)
    assert problem.focal == f_const
    assert frame.valid.all()
    if options["center"]:
        assert problem.world_points.mean(1).abs().max() < 1e-10
    if options["center"] and options["scale"]:
        torch.testing.assert_close(problem.world_points.square().sum((1, 2)) / 9, torch.ones(7).double())
    if not options["scale"]:
        assert torch.equal(frame.size, torch.ones(7).double())


@both_dtypes
@pytest.mark.parametrize("power", [-100, 100])
def test_the_unit_of_the_world_changes_neither_values_nor_gradients(power, dtype, make_problems):
    """A power of two changes no digit. The far point, which is dropped in every unit, changes nothing either."""
    p, outcomes = make_problems(outliers=2).map(lambda x: x.to(dtype) if x.is_floating_point() else x), []
    for unit in (1.0, 2.0**power):
        world = unit * p.world_points
        world[:, 0] = 1e38
        world.requires_grad_()
        problem, frame = Normalize(order=False)(world, *p[1:3])
        back = frame.undo(p.pose)
        seen = problem.world_points.square().sum() + (back.translation / unit).sum()
        gradient = unit * torch.autograd.grad(seen, world)[0]
        outcomes.append((problem.world_points, frame.size / unit, back.translation / unit, gradient))
    torch.testing.assert_close(*outcomes, rtol=0, atol=0)


@both_dtypes
@pytest.mark.parametrize("offset", [0.0, 1.0, 1e4])
@pytest.mark.parametrize("n", [3, 9, 50])
def test_points_on_a_line_are_invalid(n, offset, dtype, generator):
    direction, start = torch.randn(2, 20, 1, 3, generator=generator, dtype=DOUBLE)
    direction[:3, 0] = torch.eye(3, dtype=DOUBLE)
    along = torch.rand(20, n, 1, generator=generator, dtype=DOUBLE)
    line = along * torch.nn.functional.normalize(direction, dim=-1)
    pixels = torch.randn(20, n, 2, generator=generator, dtype=DOUBLE).to(dtype)
    K, two = torch.eye(3, dtype=dtype).expand(20, 3, 3), (torch.arange(n) < 2).expand(20, n)
    anywhere = offset + torch.randn(20, n, 3, generator=generator, dtype=DOUBLE)
    for length in (1e-3, 1.0, 100.0):
        for world, mask in ((offset * start + length * line, None), (length * anywhere, two)):
            assert not Normalize()(world.to(dtype), pixels, K, None, mask)[1].valid.any(), length


@both_dtypes
@pytest.mark.parametrize("n", [3, 9, 50])
def test_points_off_a_line_are_valid(n, dtype, random_rotations, generator):
    world = torch.rand(20, n, 3, generator=generator, dtype=DOUBLE)
    world[:, :3] = torch.tensor([[0.0, 0, 0], [1, 0, 1], [0.5, 1, 0]], dtype=DOUBLE)  # never thin by chance
    pixels = torch.randn(20, n, 2, generator=generator, dtype=DOUBLE).to(dtype)
    K, turn = torch.eye(3, dtype=dtype).expand(20, 3, 3), random_rotations(20)
    shapes = [(1, 1, 1), (1, 1, 0), (1, 0.1, 0), (1, 1e-2, 0), (1, 1e-2, 1e-2)]
    shapes += [(1, 1e-3, 0), (1, 1e-6, 0)] * (dtype == DOUBLE)
    for shape, offset, unit in itertools.product(shapes, (0.0, 10.0), (1e-3, 1.0, 1e3)):
        points = unit * ((world * torch.tensor(shape, dtype=DOUBLE)) @ turn.mT + offset)
        assert Normalize()(points.to(dtype), pixels, K)[1].valid.all(), (shape, offset, unit)


@pytest.mark.parametrize("order", [True, False])
def test_mirrors_show_the_same_problems_and_are_undone(order, make_problems):
    p = make_problems(noise=False)
    problem, frame = Normalize(order=order)(*p[:3])
    true, count = frame.apply(p.pose), len(VIEWS)
    poses = []
    for swap, reverse_x, reverse_y in VIEWS:
        mirror = torch.diag(torch.tensor([1.0 - 2 * reverse_x, 1.0 - 2 * reverse_y, 1.0], dtype=DOUBLE))
        mirror = mirror[:, [1, 0, 2]] if swap else mirror
        poses.append((mirror @ true.rotation @ mirror.mT, true.translation @ mirror.mT))
    stacked = Pose(*(torch.cat(entries) for entries in zip(*poses, strict=True)))

    def knowing(seen):
        points = seen.world_points.unflatten(0, (count, 7))
        assert torch.equal(points[0], problem.world_points)  # the problem itself; no two views are alike
        assert not any(torch.equal(points[i], points[j]) for i in range(count) for j in range(i))
        assert project(State.of(stacked), seen).residual.abs().max() < 1e-6
        if order:
            assert (seen.img_points[:, 1:, 0] >= seen.img_points[:, :-1, 0]).all()
        return Starts(stacked, seen.weights)

    starts = from_views(knowing, problem, count, order)
    assert len(starts.poses) == count
    for pose in starts.poses:
        torch.testing.assert_close(pose, true)
