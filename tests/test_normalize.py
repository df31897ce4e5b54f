"""Laws of the normalisation: it can be undone, projections stay consistent, and nothing that is not there matters."""

from __future__ import annotations

import math

import pytest
import torch
from kornia.geometry.conversions import normalize_points_with_intrinsics

from kornia_pnpnet import Correspondences, MLPInit, Normalize, PnPNet, Pose, RobustWeightedLM
from kornia_pnpnet.geometry import project, transform
from kornia_pnpnet.normalize import F_CONST, VIEWS

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


# --- inverse --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("n", [3, 4, 9, 50])
def test_undo_is_the_inverse_on_poses(n, options, make_problems):
    p = make_problems(n, outliers=1)
    normalize = Normalize(**options)
    _, frame = normalize(p.world_points, p.img_points, p.intrinsics)
    back = normalize.undo(normalize.apply_to_pose(p.pose, frame), frame)
    torch.testing.assert_close(back.matrix, p.pose.matrix, rtol=0, atol=1e-12 * 100)
    forth = normalize.apply_to_pose(normalize.undo(p.pose, frame), frame)
    torch.testing.assert_close(forth.matrix, p.pose.matrix, rtol=0, atol=1e-12 * 100)


def in_order(values, frame):
    """Values of pairs, (B, N, C), in the order of the normalised pairs."""
    return values if frame.order is None else values.gather(1, frame.order[..., None].expand_as(values))


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_poses_and_points_move_together(options, make_problems):
    p = make_problems()
    normalize = Normalize(**options)
    corr, frame = normalize(p.world_points, p.img_points, p.intrinsics)
    moved = transform(normalize.apply_to_pose(p.pose, frame), corr.world_points)
    original = in_order(transform(p.pose, p.world_points), frame)
    torch.testing.assert_close(moved, original * frame.scale[:, None, None], rtol=1e-12, atol=1e-12)
    if options["center"]:
        assert corr.world_points.mean(1).abs().max() < 1e-12 * 100
    if options["center"] and options["scale"]:
        torch.testing.assert_close(corr.world_points.square().sum((1, 2)) / 9, torch.ones(7).double())
    if not options["scale"]:
        assert torch.equal(frame.scale, torch.ones(7).double())


# --- camera ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("f", [500.0, 3400.0, 12345.6])
@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_residuals_scale_with_the_focal_length(f, options, make_problems):
    p = make_problems(outliers=2)
    K = camera(f, f, 320.0, 240.0, 7)
    pixels = see(p, K)
    cam_points = transform(p.pose, p.world_points)
    expected = (f * cam_points[..., :2] / cam_points[..., 2:] + K[:, None, :2, 2]) - pixels

    normalize = Normalize(**options)
    corr, frame = normalize(p.world_points, pixels, K)
    residual = torch.stack(project(normalize.apply_to_pose(p.pose, frame), corr).residual, -1)
    expected = in_order(expected, frame)
    torch.testing.assert_close(residual, expected * (F_CONST / f), rtol=1e-9, atol=1e-7)
    assert corr.focal == F_CONST


@pytest.mark.parametrize(("fx", "fy", "cx", "cy"), [(800, 1200, 0, 0), (3000, 2000, 2016.5, -7.25), (1, 1, 0.5, 0.5)])
def test_true_poses_project_exactly_for_any_camera(fx, fy, cx, cy, make_problems):
    p = make_problems(noise=False)
    K = camera(fx, fy, cx, cy, 7)
    normalize = Normalize()
    corr, frame = normalize(p.world_points, see(p, K), K)
    residual = torch.stack(project(normalize.apply_to_pose(p.pose, frame), corr).residual, -1)
    assert residual.abs().max() < 1e-8
    assert frame.valid.all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pixels_are_kornias_times_the_focal_length(dtype, make_problems):
    p = make_problems(dtype=dtype)
    K = camera(3000, 2000, 2016.5, -7.25, 7).to(dtype)
    corr, _ = Normalize(order=False)(p.world_points, p.img_points, K)
    torch.testing.assert_close(corr.img_points, F_CONST * normalize_points_with_intrinsics(p.img_points, K))


def test_the_camera_of_the_normalised_pixels_is_a_constructor_argument(make_problems):
    p = make_problems(noise=False)
    corr, frame = Normalize(f_const=1.0, order=False)(p.world_points, p.img_points, p.intrinsics)
    torch.testing.assert_close(corr.img_points, p.img_points / 3400.0)
    assert corr.focal == 1.0
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


@pytest.mark.parametrize("n", [3, 9, 50])
def test_the_order_does_not_depend_on_the_input_order(n, make_problems, generator):
    p = make_problems(n)
    shuffle = torch.randperm(n, generator=generator)
    one, _ = Normalize()(p.world_points, p.img_points, p.intrinsics)
    two, _ = Normalize()(p.world_points[:, shuffle], p.img_points[:, shuffle], p.intrinsics)
    assert torch.equal(one.img_points, two.img_points)
    torch.testing.assert_close(one.world_points, two.world_points, rtol=0, atol=1e-13)


@pytest.mark.parametrize("with_init", [True, False])
def test_permuted_pairs_give_the_same_pose_and_permuted_weights(with_init, make_problems, perturb, generator):
    p = make_problems(outliers=2)
    shuffle = torch.randperm(9, generator=generator)
    solver = PnPNet(MLPInit(9).double(), RobustWeightedLM(m=5))
    init = perturb(p.pose) if with_init else None
    one = solver(p.world_points, p.img_points, p.intrinsics, init=init)
    two = solver(p.world_points[:, shuffle], p.img_points[:, shuffle], p.intrinsics, init=init)
    torch.testing.assert_close(two.init.matrix, one.init.matrix, rtol=1e-9, atol=1e-9)
    if with_init:  # from an untrained guess five steps end anywhere
        torch.testing.assert_close(two.matrix, one.matrix, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(two.weights, one.weights[:, shuffle], rtol=1e-6, atol=1e-9)
        assert one.ok.any()
        assert torch.equal(one.ok, two.ok)


# --- equivariance ----------------------------------------------------------------------------------------------------


def similar(pose, scale, rotation, offset):
    """The pose after the world has moved, ``a' = s Q a + c``: ``R' = R Qᵀ`` and ``t' = s t - R' c``."""
    turned = pose.rotation @ rotation.mT
    return Pose(turned, scale * pose.translation - (turned @ offset[..., None])[..., 0])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 50.0])
@pytest.mark.parametrize("m", [0, 1, 5])
def test_poses_follow_a_moved_and_scaled_world(m, scale, make_problems, generator):
    p = make_problems()
    offset = 100.0 * torch.randn(7, 3, generator=generator, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64).expand(7, 3, 3)
    solver = PnPNet(MLPInit(9).double(), RobustWeightedLM(m=m, reject_worse=True))
    one = solver(p.world_points, p.img_points, p.intrinsics)
    two = solver(scale * p.world_points + offset[:, None], p.img_points, p.intrinsics)
    expected = similar(one.init, scale, eye, offset)
    torch.testing.assert_close(two.init.rotation, expected.rotation, rtol=0, atol=1e-9)
    torch.testing.assert_close(two.init.translation, expected.translation, rtol=1e-9, atol=1e-9 * (scale + 100))
    expected = similar(one.pose, scale, eye, offset)
    torch.testing.assert_close(two.rotation, expected.rotation, rtol=0, atol=1e-7)
    torch.testing.assert_close(two.translation, expected.translation, rtol=1e-7, atol=1e-7 * (scale + 100))
    assert torch.equal(one.ok, two.ok)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 50.0])
def test_refinement_follows_any_similarity_of_the_world(scale, make_problems, perturb, random_rotations, generator):
    p = make_problems(outliers=2)
    Q = random_rotations(7, seed=3)
    offset = 100.0 * torch.randn(7, 3, generator=generator, dtype=torch.float64)
    init = perturb(p.pose)
    solver = PnPNet(None, RobustWeightedLM(m=5))
    one = solver(p.world_points, p.img_points, p.intrinsics, init=init)
    moved = scale * p.world_points @ Q.mT + offset[:, None]
    two = solver(moved, p.img_points, p.intrinsics, init=similar(init, scale, Q, offset))
    expected = similar(one.pose, scale, Q, offset)
    torch.testing.assert_close(two.rotation, expected.rotation, rtol=0, atol=1e-9)
    torch.testing.assert_close(two.translation, expected.translation, rtol=1e-9, atol=1e-9 * (scale + 100))
    torch.testing.assert_close(two.weights, one.weights, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(two.cost, one.cost, rtol=1e-6, atol=1e-9)
    assert one.ok.any()
    assert torch.equal(one.ok, two.ok)


# --- mask and weights -------------------------------------------------------------------------------------------------

PADDING = {"nan": math.nan, "inf": math.inf, "huge": 1e30, "zero": 0.0}


@pytest.mark.parametrize("content", PADDING.values(), ids=PADDING.keys())
@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_padding_equals_removing(options, content, make_problems, perturb):
    p = make_problems(6)
    init = perturb(p.pose)
    mask = torch.ones(7, 9, dtype=torch.bool)
    mask[:, 6:] = False
    world = torch.cat((p.world_points, torch.full((7, 3, 3), content, dtype=torch.float64)), 1).requires_grad_()
    pixels = torch.cat((p.img_points, torch.full((7, 3, 2), content, dtype=torch.float64)), 1).requires_grad_()
    weights = torch.full((7, 9), content, dtype=torch.float64)
    weights[:, :6] = 1.0
    weights.requires_grad_()
    K = p.intrinsics.clone().requires_grad_()

    solver = PnPNet(None, RobustWeightedLM(m=3), Normalize(**options))
    padded = solver(world, pixels, K, weights, mask, init=init)
    removed = solver(p.world_points, p.img_points, p.intrinsics, init=init)
    assert padded.ok.all()
    torch.testing.assert_close(padded.matrix, removed.matrix, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(padded.cost, removed.cost, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(padded.weights[:, :6], removed.weights, rtol=1e-6, atol=1e-9)
    assert not padded.weights[:, 6:].any()

    (padded.rotation.sum() + padded.translation.sum() + padded.cost.sum() + padded.weights.sum()).backward()
    for name, tensor in {"world": world, "pixels": pixels, "weights": weights, "intrinsics": K}.items():
        assert tensor.grad.isfinite().all(), name
    assert not world.grad[:, 6:].any()
    assert not pixels.grad[:, 6:].any()
    assert not weights.grad[:, 6:].any()


def test_what_padding_holds_does_not_change_a_bit(make_problems):
    p = make_problems(9)
    mask = torch.ones(7, 9, dtype=torch.bool)
    mask[:, [1, 4]] = False
    solver = PnPNet(MLPInit(9), RobustWeightedLM(m=3))
    results = []
    for content in PADDING.values():
        world, pixels = p.world_points.clone(), p.img_points.clone()
        world[~mask], pixels[~mask] = content, content
        results.append(solver(world, pixels, p.intrinsics, mask=mask))
    for other in results[1:]:
        assert torch.equal(other.matrix, results[0].matrix)
        assert torch.equal(other.weights, results[0].weights)
        assert torch.equal(other.ok, results[0].ok)


@pytest.mark.parametrize("content", PADDING.values(), ids=PADDING.keys())
def test_a_pair_without_weight_has_no_place(content, make_problems):
    """It is padding, whatever it holds."""
    p = make_problems(9)
    weights = torch.ones(7, 9, dtype=torch.float64)
    weights[:, 2] = 0.0
    mask = torch.ones(7, 9, dtype=torch.bool)
    mask[:, 2] = False
    world, pixels = p.world_points.clone(), p.img_points.clone()
    world[:, 2], pixels[:, 2] = content, content
    by_weight, frame = Normalize()(world, pixels, p.intrinsics, weights)
    by_mask, _ = Normalize()(p.world_points, p.img_points, p.intrinsics, None, mask)
    assert frame.valid.all()
    for one, two in zip(by_weight[:6], by_mask[:6], strict=True):
        assert torch.equal(one, two)


# --- validity ---------------------------------------------------------------------------------------------------------


def spoil(world, pixels, K, weights, name):
    """Break problem 1 of a batch in one way."""
    world, pixels, K, weights = world.clone(), pixels.clone(), K.clone(), weights.clone()
    n = world.shape[1]
    match name:
        case "world_nan":
            world[1, 2, 0] = math.nan
        case "world_inf":
            world[1, 0, 2] = math.inf
        case "pixel_nan":
            pixels[1, n - 1, 1] = math.nan
        case "pixel_minus_inf":
            pixels[1, 0, 0] = -math.inf
        case "weight_nan":
            weights[1, 0] = math.nan
        case "weight_inf":
            weights[1, 0] = math.inf
        case "weight_negative":
            weights[1, 0] = -1e-3
        case "two_pairs":
            weights[1, 2:] = 0.0
        case "no_pairs":
            weights[1] = 0.0
        case "focal_zero":
            K[1, 0, 0] = 0.0
        case "focal_negative":
            K[1, 1, 1] = -1.0
        case "intrinsics_nan":
            K[1, 0, 2] = math.nan
        case "skew":
            K[1, 0, 1] = 1e-3
        case "all_equal":
            world[1] = torch.tensor([3.0, 4, 5]).to(world)
        case "all_equal_inexact":
            world[1] = torch.tensor([1 / 3, 0.1, 1e4 / 7]).to(world)
        case "all_zero":
            world[1], pixels[1] = 0.0, 0.0
    return world, pixels, K, weights


SPOILT = (
    *("world_nan", "world_inf", "pixel_nan", "pixel_minus_inf", "weight_nan", "weight_inf", "weight_negative"),
    *("two_pairs", "no_pairs", "focal_zero", "focal_negative", "intrinsics_nan", "skew"),
    *("all_equal", "all_equal_inexact", "all_zero"),
)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", SPOILT)
@pytest.mark.parametrize("options", [OPTIONS[0], OPTIONS[-1]], ids=str)
def test_spoilt_problems_are_invalid_and_finite_and_alone(name, dtype, options, make_problems):
    p = make_problems(dtype=dtype)
    ones = torch.ones(7, 9, dtype=dtype)
    inputs = [x.requires_grad_() for x in spoil(p.world_points, p.img_points, p.intrinsics, ones, name)]
    corr, frame = Normalize(**options)(*inputs)
    assert frame.valid.tolist() == [True, False] + [True] * 5
    assert all(x.isfinite().all() for x in (*corr[:6], frame.centroid, frame.scale))
    sum(x.sum() for x in (corr.world_points, corr.img_points, corr.weights, frame.centroid, frame.scale)).backward()
    for tensor in inputs:
        assert tensor.grad.isfinite().all()
    good, _ = Normalize(**options)(p.world_points, p.img_points, p.intrinsics, ones)
    keep = [0, 2, 3, 4, 5, 6]
    for one, two in zip(corr[:3], good[:3], strict=True):
        assert torch.equal(one[keep], two[keep])


def line(n, dtype, *, offset, length, seed):
    """Points on exact lines (up to the rounding of the dtype) in random directions, far from the origin."""
    generator = torch.Generator().manual_seed(seed)
    direction = torch.randn(20, 1, 3, generator=generator, dtype=torch.float64)
    direction[:3, 0] = torch.eye(3, dtype=torch.float64)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    start = offset * torch.randn(20, 1, 3, generator=generator, dtype=torch.float64)
    along = length * torch.rand(20, n, 1, generator=generator, dtype=torch.float64)
    return (start + along * direction).to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("offset", [0.0, 1.0, 100.0, 1e4])
@pytest.mark.parametrize("length", [1e-3, 1.0, 100.0])
@pytest.mark.parametrize("n", [3, 9, 50])
def test_points_on_a_line_are_invalid(n, length, offset, dtype):
    world = line(n, dtype, offset=offset, length=length, seed=n)
    pixels = torch.randn(20, n, 2, generator=torch.Generator().manual_seed(1)).to(dtype)
    _, frame = Normalize()(world, pixels, torch.eye(3, dtype=dtype).expand(20, 3, 3))
    assert not frame.valid.any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [3, 9, 50])
def test_points_off_a_line_are_valid(n, dtype, random_rotations):
    generator = torch.Generator().manual_seed(n)
    world = torch.rand(20, n, 3, generator=generator, dtype=torch.float64)
    world[:, :3] = torch.tensor([[0.0, 0, 0], [1, 0, 1], [0.5, 1, 0]], dtype=torch.float64)  # never thin by chance
    pixels = torch.randn(20, n, 2, generator=generator, dtype=torch.float64).to(dtype)
    K = torch.eye(3, dtype=dtype).expand(20, 3, 3)
    turn = random_rotations(20)
    shapes = [(1, 1, 1), (1, 1, 0), (1, 0.1, 0), (1, 1e-2, 0), (1, 1e-2, 1e-2)]
    if dtype == torch.float64:
        shapes += [(1, 1e-3, 0), (1, 1e-6, 0)]
    for shape in shapes:
        for offset in (0.0, 10.0):
            points = (world * torch.tensor(shape, dtype=torch.float64)) @ turn.mT + offset
            for unit in (1e-3, 1.0, 1e3):
                _, frame = Normalize()((unit * points).to(dtype), pixels, K)
                assert frame.valid.all(), (shape, offset, unit)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1e-7, 1e-3, 1.0, 1e4, 1e8])
@pytest.mark.parametrize("offset", [0.0, 1.0, 1e4])
def test_two_pairs_are_invalid_wherever_they_are(offset, size, dtype):
    generator = torch.Generator().manual_seed(0)
    world = size * (offset + torch.randn(500, 9, 3, generator=generator, dtype=torch.float64))
    pixels = torch.randn(500, 9, 2, generator=generator, dtype=torch.float64)
    mask = torch.arange(9) < 2
    K = camera(1, 1, 0, 0, 500).to(dtype)
    _, frame = Normalize()(world.to(dtype), pixels.to(dtype), K, None, mask.expand(500, 9))
    assert not frame.valid.any()


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_problems_are_side_by_side_in_memory(options, make_problems):
    """One coordinate of one pair of all problems is a row: see ``core.performance.problems_last``."""
    corr, _ = Normalize(**options)(*make_problems()[:3])
    assert corr.world_points.permute(2, 1, 0).is_contiguous()
    assert corr.img_points.permute(2, 1, 0).is_contiguous()
    assert corr.weights.mT.is_contiguous()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_normalisation_keeps_the_dtype(dtype, make_problems):
    p = make_problems(dtype=dtype)
    corr, frame = Normalize()(p.world_points, p.img_points, p.intrinsics)
    assert {x.dtype for x in (*corr[:6], frame.centroid, frame.scale)} == {dtype}
    assert frame.valid.all()


def test_a_typo_in_an_option_raises():
    with pytest.raises(TypeError, match="centre"):
        Normalize(centre=True)


def test_gradcheck(make_problems):
    p = make_problems(5, 2)
    normalize = Normalize()

    def run(world, pixels, focal, weights):
        K = torch.zeros(2, 3, 3, dtype=torch.float64)
        K = K + torch.diag_embed(torch.cat((focal[:2], torch.ones(1).double())))
        K = K + torch.nn.functional.pad(focal[2:, None], (2, 0, 0, 1))
        corr, frame = normalize(world, pixels, K, weights)
        return (*corr[:3], frame.centroid, frame.scale)

    focal = torch.tensor([3400.0, 3000, 20, 30], dtype=torch.float64)
    inputs = [p.world_points, p.img_points, focal, torch.rand(2, 5, dtype=torch.float64) + 0.5]
    assert torch.autograd.gradcheck(run, [x.detach().requires_grad_() for x in inputs])
    corr = normalize(p.world_points, p.img_points, p.intrinsics)[0]
    assert isinstance(corr, Correspondences)


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
    assert seen.world_points.shape == (7 * count, 9, 3)
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


def test_the_first_view_is_the_problem_and_no_two_are_alike(make_problems):
    corr, _ = Normalize()(*make_problems()[:3])
    seen = Normalize().views(corr, len(VIEWS))
    assert torch.equal(seen.world_points[:7], corr.world_points)
    assert torch.equal(seen.img_points[:7], corr.img_points)
    points = seen.world_points.unflatten(0, (len(VIEWS), 7))
    assert all(not torch.equal(points[i], points[j]) for i in range(len(VIEWS)) for j in range(i))


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
