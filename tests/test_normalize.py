"""Laws of the normalisation: it can be undone, projections stay consistent, and nothing that is not there matters."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from kornia.geometry.conversions import normalize_points_with_intrinsics
from kornia_pnpnet.geometry import transform

from kornia_pnpnet import MLPInit, Normalize, PnPNet, Pose, RobustWeightedLM
from kornia_pnpnet.core.trees import iter_tensors
from kornia_pnpnet.frame import F_CONST
from kornia_pnpnet.propose.views import VIEWS
from kornia_pnpnet.refine.residual import project

DTYPES = (torch.float32, torch.float64)
OPTIONS = [
    {"order": order, "center": center, "scale": scale}
    for order in (True, False)
    for center in (True, False)
    for scale in (True, False)
]


def camera(fx, fy, cx, cy, batch=None):
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    return K if batch is None else K.expand(batch, 3, 3)


def see(problems, K):
    """The problems as another camera sees them: the same rays and the same noise relative to the focal length."""
    rays = problems.img_points / problems.intrinsics[:, 0, 0, None, None]
    return rays * K.diagonal(dim1=-2, dim2=-1)[:, None, :2] + K[:, None, :2, 2]


def residuals(pose, corr):
    return torch.stack(project(pose, corr).residual, -1)


# --- poses and cameras ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_poses_go_to_the_frame_of_the_points_and_back(options, make_problems):
    """Residuals scale with the focal length."""
    p = make_problems(outliers=2)
    for f in (500.0, 12345.6):
        K = camera(f, f, 320.0, 240.0, 7)
        pixels = see(p, K)
        cam_points = transform(p.pose, p.world_points)
        expected = (f * cam_points[..., :2] / cam_points[..., 2:] + K[:, None, :2, 2]) - pixels
        normalize = Normalize(**options)
        corr, frame = normalize(p.world_points, pixels, K)
        pose = normalize.apply_to_pose(p.pose, frame)
        if frame.order is not None:
            expected = expected.gather(1, frame.order[..., None].expand(-1, -1, 2))
        torch.testing.assert_close(residuals(pose, corr), expected * (F_CONST / f), rtol=1e-9, atol=1e-7)
        assert corr.focal == F_CONST
        torch.testing.assert_close(normalize.undo(pose, frame).matrix, p.pose.matrix, rtol=0, atol=1e-10)
        forth = normalize.apply_to_pose(normalize.undo(p.pose, frame), frame)
        torch.testing.assert_close(forth.matrix, p.pose.matrix, rtol=0, atol=1e-10)
    if options["center"]:
        assert corr.world_points.mean(1).abs().max() < 1e-10
    if options["center"] and options["scale"]:
        torch.testing.assert_close(corr.world_points.square().sum((1, 2)) / 9, torch.ones(7).double())
    if not options["scale"]:
        assert torch.equal(frame.scale, torch.ones(7).double())


@pytest.mark.parametrize("f_const", [1.0, F_CONST])
@pytest.mark.parametrize(("fx", "fy", "cx", "cy"), [(800, 1200, 0, 0), (3000, 2000, 2016.5, -7.25), (1, 1, 0.5, 0.5)])
def test_pixels_are_kornias_times_the_focal_length_for_any_camera(fx, fy, cx, cy, f_const, make_problems):
    p = make_problems(noise=False)
    K = camera(fx, fy, cx, cy, 7)
    normalize = Normalize(f_const=f_const, order=False)
    corr, frame = normalize(p.world_points, see(p, K), K)
    torch.testing.assert_close(corr.img_points, f_const * normalize_points_with_intrinsics(see(p, K), K))
    assert residuals(normalize.apply_to_pose(p.pose, frame), corr).abs().max() < 1e-8  # the true pose
    assert corr.focal == f_const
    assert frame.valid.all()


# --- order ----------------------------------------------------------------------------------------------------------


def test_pairs_are_ordered_by_u_then_v_and_padding_is_last():
    pixels = torch.tensor([[[3.0, 0], [1, 5], [-9, -9], [1, 4], [2, 7], [1, 4], [-8, -8]]], dtype=torch.float64)
    world = torch.randn(1, 7, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    mask = torch.tensor([[True, True, False, True, True, True, True]])
    weights = torch.tensor([[1.0, 2, 3, 4, 5, 6, 0]], dtype=torch.float64)
    normalize = Normalize(f_const=1.0, center=False, scale=False)
    corr, frame = normalize(world, pixels, camera(1, 1, 0, 0, 1), weights, mask)
    # 3 and 5 tie in both: they keep the order they came in.
    assert frame.order[0, :5].tolist() == [3, 5, 1, 4, 0]
    assert corr.img_points[0, :5].tolist() == [[1, 4], [1, 4], [1, 5], [2, 7], [3, 0]]
    assert corr.weights.tolist() == [[4, 6, 2, 5, 1, 0, 0]]
    assert torch.equal(corr.world_points[0, :5], world[0, [3, 5, 1, 4, 0]])
    assert not corr.world_points[0, 5:].any()
    assert not corr.img_points[0, 5:].any()


# --- equivariance ----------------------------------------------------------------------------------------------------


def assert_similar(two, one, scale, rotation, offset, tolerance):
    """The pose has followed the world ``a' = s Q a + c``: ``R' = R Qᵀ`` and ``t' = s t - R' c``."""
    turned = one.rotation @ rotation.mT
    moved = scale * one.translation - (turned @ offset[..., None])[..., 0]
    torch.testing.assert_close(two.rotation, turned, rtol=0, atol=tolerance)
    torch.testing.assert_close(two.translation, moved, rtol=tolerance, atol=tolerance * (scale + 100))


@pytest.mark.parametrize("scale", [1e-3, 50.0])
def test_poses_follow_a_similarity_of_the_world(scale, make_problems, perturb, random_rotations, generator):
    """Refinement follows any; an initialiser that is not invariant to turns follows scales and shifts."""
    offset = 100.0 * torch.randn(7, 3, generator=generator, dtype=torch.float64)
    p, eye = make_problems(), torch.eye(3, dtype=torch.float64).expand(7, 3, 3)
    for m in (1, 5):
        solver = PnPNet(MLPInit(9).double(), RobustWeightedLM(m=m, reject_worse=True))
        one = solver(p.world_points, p.img_points, p.intrinsics)
        two = solver(scale * p.world_points + offset[:, None], p.img_points, p.intrinsics)
        assert_similar(two.init, one.init, scale, eye, offset, 1e-9)
        assert_similar(two, one, scale, eye, offset, 1e-7)
        assert torch.equal(one.ok, two.ok)

    p, Q = make_problems(outliers=2), random_rotations(7, seed=3)
    init = perturb(p.pose)
    turned = init.rotation @ Q.mT
    moved_init = Pose(turned, scale * init.translation - (turned @ offset[..., None])[..., 0])
    solver = PnPNet(None, RobustWeightedLM(m=5))
    one = solver(p.world_points, p.img_points, p.intrinsics, init=init)
    moved = scale * p.world_points @ Q.mT + offset[:, None]
    two = solver(moved, p.img_points, p.intrinsics, init=moved_init)
    assert_similar(two, one, scale, Q, offset, 1e-9)
    torch.testing.assert_close(two.weights, one.weights, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(two.cost, one.cost, rtol=1e-6, atol=1e-9)
    assert one.ok.any()
    assert torch.equal(one.ok, two.ok)


# --- mask and weights -------------------------------------------------------------------------------------------------

PADDING = (math.nan, math.inf, 1e30, 0.0)


@pytest.mark.parametrize("options", [OPTIONS[0], OPTIONS[2], OPTIONS[-1]], ids=str)
def test_padding_equals_removing_and_has_no_gradient(options, make_problems, perturb):
    p = make_problems(6)
    init = perturb(p.pose)
    solver = PnPNet(None, RobustWeightedLM(m=3), Normalize(**options))
    removed = solver(p.world_points, p.img_points, p.intrinsics, init=init)
    there = torch.ones(7, 6, dtype=torch.float64)
    mask = (torch.arange(9) < 6).expand(7, 9)
    for content in PADDING:
        tensors = [
            torch.cat((x, torch.full((7, 3, *x.shape[2:]), content, dtype=x.dtype)), 1).requires_grad_()
            for x in (p.world_points, p.img_points, there)
        ]
        world, pixels, weights = tensors
        K = p.intrinsics.clone().requires_grad_()
        padded = solver(world, pixels, K, weights, mask, init=init)
        assert padded.ok.all()
        torch.testing.assert_close(padded.matrix, removed.matrix, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(padded.cost, removed.cost, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(padded.weights[:, :6], removed.weights, rtol=1e-6, atol=1e-9)
        assert not padded.weights[:, 6:].any()
        (padded.rotation.sum() + padded.translation.sum() + padded.cost.sum() + padded.weights.sum()).backward()
        assert all(x.grad.isfinite().all() for x in (*tensors, K))
        assert not any(x.grad[:, 6:].any() for x in tensors)


@pytest.mark.parametrize("content", PADDING)
def test_a_pair_without_weight_is_padding(content, make_problems):
    """To the bit, for any numbers of the pair."""
    p = make_problems(9)
    mask = (torch.arange(9) != 2).expand(7, 9)
    world, pixels = p.world_points.clone(), p.img_points.clone()
    world[:, 2], pixels[:, 2] = content, content
    by_weight, frame = Normalize()(world, pixels, p.intrinsics, mask.double())
    by_mask, _ = Normalize()(p.world_points, p.img_points, p.intrinsics, None, mask)
    assert frame.valid.all()
    assert all(torch.equal(a, b) for a, b in zip(iter_tensors(by_weight), iter_tensors(by_mask), strict=True))


# --- validity ---------------------------------------------------------------------------------------------------------

#: Ways to break problem 1: which input, where, and the value put there.
SPOILT = {
    "world_nan": ("world", (1, 2, 0), math.nan),
    "world_inf": ("world", (1, 0, 2), math.inf),
    "pixel_nan": ("pixels", (1, -1, 1), math.nan),
    "pixel_minus_inf": ("pixels", (1, 0, 0), -math.inf),
    "weight_nan": ("weights", (1, 0), math.nan),
    "weight_inf": ("weights", (1, 0), math.inf),
    "weight_negative": ("weights", (1, 0), -1e-3),
    "two_pairs": ("weights", (1, slice(2, None)), 0.0),
    "no_pairs": ("weights", (1,), 0.0),
    "focal_zero": ("intrinsics", (1, 0, 0), 0.0),
    "focal_negative": ("intrinsics", (1, 1, 1), -1.0),
    "intrinsics_nan": ("intrinsics", (1, 0, 2), math.nan),
    "turned_camera": ("intrinsics", (1, 1, 0), 1e-3),
    "all_equal": ("world", (1,), torch.tensor([3.0, 4, 5])),
    "all_equal_inexact": ("world", (1,), torch.tensor([1 / 3, 0.1, 1e4 / 7])),
    "all_zero": ("world", (1,), 0.0),
}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("options", [OPTIONS[0], OPTIONS[-1]], ids=str)
def test_spoilt_problems_are_invalid_and_finite_and_change_no_other(dtype, options, make_problems):
    p = make_problems(dtype=dtype)
    normalize = Normalize(**options)
    inputs = {"world": p.world_points, "pixels": p.img_points, "intrinsics": p.intrinsics}
    inputs["weights"] = torch.ones(7, 9, dtype=dtype)
    good, _ = normalize(*inputs.values())
    keep = torch.arange(7) != 1
    for how, (name, at, value) in SPOILT.items():
        broken = {key: x.clone() for key, x in inputs.items()}
        broken[name][at] = value.to(dtype) if isinstance(value, torch.Tensor) else value
        leaves = [x.requires_grad_() for x in broken.values()]
        corr, frame = normalize(*leaves)
        assert torch.equal(frame.valid, keep), how
        values = (corr.world_points, corr.img_points, corr.weights, frame.centroid, frame.scale)
        assert all(x.isfinite().all() for x in values), how
        gradients = torch.autograd.grad(sum(x.sum() for x in values), leaves, materialize_grads=True)
        assert all(x.isfinite().all() for x in gradients), how
        for one, two in zip(values, (good.world_points, good.img_points, good.weights), strict=False):
            assert torch.equal(one[keep], two[keep]), how


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("offset", [0.0, 1.0, 1e4])
@pytest.mark.parametrize("n", [3, 9, 50])
def test_points_on_a_line_are_invalid(n, offset, dtype, generator):
    """Also where only two of the pairs are there; lines up to the rounding of the dtype."""
    direction = torch.randn(20, 1, 3, generator=generator, dtype=torch.float64)
    direction[:3, 0] = torch.eye(3, dtype=torch.float64)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    start = offset * torch.randn(20, 1, 3, generator=generator, dtype=torch.float64)
    along = torch.rand(20, n, 1, generator=generator, dtype=torch.float64)
    pixels = torch.randn(20, n, 2, generator=generator, dtype=torch.float64).to(dtype)
    K, two = torch.eye(3, dtype=dtype).expand(20, 3, 3), (torch.arange(n) < 2).expand(20, n)
    for length in (1e-3, 1.0, 100.0):
        _, frame = Normalize()((start + length * along * direction).to(dtype), pixels, K)
        assert not frame.valid.any(), length
        world = length * (offset + torch.randn(20, n, 3, generator=generator, dtype=torch.float64))
        _, frame = Normalize()(world.to(dtype), pixels, K, None, two)
        assert not frame.valid.any(), length


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [3, 9, 50])
def test_points_off_a_line_are_valid(n, dtype, random_rotations, generator):
    world = torch.rand(20, n, 3, generator=generator, dtype=torch.float64)
    world[:, :3] = torch.tensor([[0.0, 0, 0], [1, 0, 1], [0.5, 1, 0]], dtype=torch.float64)  # never thin by chance
    pixels = torch.randn(20, n, 2, generator=generator, dtype=torch.float64).to(dtype)
    K, turn = torch.eye(3, dtype=dtype).expand(20, 3, 3), random_rotations(20)
    shapes = [(1, 1, 1), (1, 1, 0), (1, 0.1, 0), (1, 1e-2, 0), (1, 1e-2, 1e-2)]
    if dtype == torch.float64:
        shapes += [(1, 1e-3, 0), (1, 1e-6, 0)]
    for shape, offset, unit in itertools.product(shapes, (0.0, 10.0), (1e-3, 1.0, 1e3)):
        points = unit * ((world * torch.tensor(shape, dtype=torch.float64)) @ turn.mT + offset)
        assert Normalize()(points.to(dtype), pixels, K)[1].valid.all(), (shape, offset, unit)


def test_units_of_the_user_are_brought_along(make_problems):
    """A pixel and a unit of the world that were given become ``img_scale`` pixels and ``world_scale`` units."""
    p = make_problems(n=9)
    K = p.intrinsics.clone()
    K[:, 0, 0], K[:, 1, 1] = 500.0, 2000.0
    moved = p.world_points.clone()
    moved[:, 4, 0] += 1.0
    for scale in (True, False):
        normalize = Normalize(order=False, scale=scale, center=False)
        corr, frame = normalize(p.world_points, p.img_points, K)
        assert torch.equal(corr.world_scale, frame.scale)
        shifted = corr.world_points * 1.0
        shifted[:, 4, 0] += corr.world_scale
        torch.testing.assert_close(shifted / corr.world_scale[:, None, None], moved)
        # One pixel to the right is 3400 / 500 normalised ones, one down 3400 / 2000: the geometric mean of both.
        torch.testing.assert_close(corr.img_scale, torch.full_like(corr.img_scale, 3400.0 / 1000.0))


# --- views ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [True, False])
def test_mirrors_show_the_same_problems_and_are_undone(order, make_problems):
    """Every view has a pose that explains its pixels exactly, and undoing the view gives the true one."""
    p = make_problems(noise=False)
    normalize = Normalize(order=order)
    corr, frame = normalize(*p[:3])
    count = len(VIEWS)
    seen = normalize.views(corr, count)
    points = seen.world_points.unflatten(0, (count, 7))
    assert torch.equal(points[0], corr.world_points)  # the problem itself; no two views are alike
    assert not any(torch.equal(points[i], points[j]) for i in range(count) for j in range(i))
    true = normalize.apply_to_pose(p.pose, frame)
    poses = []
    for swap, reverse_x, reverse_y in VIEWS:
        mirror = torch.diag(torch.tensor([1.0 - 2 * reverse_x, 1.0 - 2 * reverse_y, 1.0], dtype=torch.float64))
        mirror = mirror[:, [1, 0, 2]] if swap else mirror
        poses.append((mirror @ true.rotation @ mirror.mT, true.translation @ mirror.mT))
    stacked = Pose(*(torch.cat(entries) for entries in zip(*poses, strict=True)))
    assert project(stacked, seen).sq_residual.max() < 1e-12
    undone = normalize.undo_views(stacked, count)
    assert len(undone) == count
    for pose in undone:
        torch.testing.assert_close(pose, true)


def test_views_are_ordered_by_their_own_pixels_with_padding_last(make_problems):
    p = make_problems()
    mask = torch.ones(7, 9, dtype=torch.bool)
    mask[2:5, 3] = False
    corr, _ = Normalize()(*p[:3], mask=mask)
    seen = Normalize().views(corr, len(VIEWS))
    there = seen.weights > 0
    count = there.sum(1)
    assert torch.equal(there, torch.arange(9) < count[:, None])
    u = torch.where(there, seen.img_points[..., 0], torch.inf)
    assert (u.diff() >= 0)[there[:, 1:]].all()
