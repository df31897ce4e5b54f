"""The contract of the layer: what goes in, what comes out, what goes wrong and what that costs the others."""

from __future__ import annotations

import copy
import json
import math
import pickle

import pytest
import torch
from kornia.core.exceptions import BaseError, DeviceError, ShapeError, TypeCheckError, ValueCheckError
from torch.utils import _pytree as pytree

from kornia_pnpnet import (
    Guess,
    MLPInit,
    Normalize,
    PnPNet,
    PnPResult,
    Pose,
    PoseLoss,
    RobustWeightedLM,
    create_solver,
    list_solvers,
    pose_errors,
)
from kornia_pnpnet.init import EPnP
from kornia_pnpnet.metrics import success

DTYPES = (torch.float32, torch.float64)


def net(n=9, m=3, **options):
    return PnPNet(MLPInit(n), RobustWeightedLM(m=m, **options))


def assert_same(one, two, rtol=0.0, atol=0.0):
    for a, b in zip(pytree.tree_leaves(one), pytree.tree_leaves(two), strict=True):
        torch.testing.assert_close(a, b, rtol=rtol, atol=atol)


# --- shapes, dtypes, pytrees -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [3, 4, 6, 9, 50])
@pytest.mark.parametrize("batch", [1, 7])
def test_shapes_and_dtypes(batch, n, dtype, make_problems):
    p = make_problems(n, batch, dtype=dtype)
    result = net(n)(p.world_points, p.img_points, p.intrinsics)
    expected = {
        "rotation": (batch, 3, 3),
        "translation": (batch, 3),
        "weights": (batch, n),
        "cost": (batch,),
        "ok": (batch,),
        "matrix": (batch, 4, 4),
    }
    assert {name: tuple(getattr(result, name).shape) for name in expected} == expected
    assert result.init.rotation.shape == (batch, 3, 3)
    assert result.init.translation.shape == (batch, 3)
    assert result.ok.dtype == torch.bool
    floats = [x for x in pytree.tree_leaves(result) if x.dtype != torch.bool]
    assert {x.dtype for x in floats} == {dtype}
    assert all(x.isfinite().all() for x in floats)
    eye = torch.eye(3, dtype=dtype).expand(batch, 3, 3)
    torch.testing.assert_close(result.rotation @ result.rotation.mT, eye, rtol=0, atol=1e-4)


def test_a_thousand_problems_are_solved_from_nearby(make_problems, perturb):
    p = make_problems(9, 1000, dtype=torch.float32)
    result = PnPNet()(p.world_points, p.img_points, p.intrinsics, init=perturb(p.pose))
    assert result.ok.float().mean() > 0.99


def test_the_result_is_a_pytree(make_problems):
    p = make_problems()
    result = net()(p.world_points, p.img_points, p.intrinsics)
    moved = pytree.tree_map(lambda x: x.detach().clone(), result)
    assert isinstance(moved, PnPResult)
    assert isinstance(moved.init, Pose)
    assert_same(moved, result)
    assert torch.equal(result.matrix[:, :3, :3], result.rotation)
    assert torch.equal(result.matrix[:, :3, 3], result.translation)
    assert torch.equal(result.pose.rotation, result.rotation)


@pytest.mark.parametrize("dtype", DTYPES)
def test_one_camera_for_all(dtype, make_problems):
    p = make_problems(dtype=dtype)
    solver = net()
    assert_same(
        solver(p.world_points, p.img_points, p.intrinsics[0]), solver(p.world_points, p.img_points, p.intrinsics)
    )


def test_three_problems_with_one_camera_is_not_a_batch_of_three_cameras(make_problems):
    p = make_problems(9, 3)
    solver = net()
    assert_same(
        solver(p.world_points, p.img_points, p.intrinsics[0]), solver(p.world_points, p.img_points, p.intrinsics)
    )


@pytest.mark.parametrize("dtype", DTYPES)
def test_an_empty_batch(dtype, make_problems):
    p = make_problems(dtype=dtype)
    solver = net()
    empty = solver(p.world_points[:0], p.img_points[:0], p.intrinsics[:0])
    assert empty.matrix.shape == (0, 4, 4)
    assert empty.weights.shape == (0, 9)
    assert empty.ok.shape == (0,)
    assert solver(p.world_points[:0], p.img_points[:0], p.intrinsics[0]).cost.shape == (0,)
    assert PnPNet()(p.world_points[:0], p.img_points[:0], p.intrinsics[:0]).ok.shape == (0,)


@pytest.mark.parametrize("dtype", DTYPES)
def test_memory_layout_and_gradient_flags_do_not_matter(dtype, make_problems):
    p = make_problems(dtype=dtype)
    solver = net()
    plain = solver(p.world_points, p.img_points, p.intrinsics)
    world = p.world_points.permute(2, 1, 0).contiguous().permute(2, 1, 0).requires_grad_()
    pixels = torch.stack((p.img_points, p.img_points), -1)[..., 0].requires_grad_()
    K = p.intrinsics.mT.contiguous().mT
    assert not world.is_contiguous()
    assert not pixels.is_contiguous()
    strided = solver(world, pixels, K)
    tolerance = 1e-9 if dtype == torch.float64 else 1e-3
    assert_same(strided.init, plain.init, rtol=tolerance, atol=tolerance)
    assert torch.equal(strided.ok, plain.ok)
    assert strided.rotation.requires_grad
    with torch.no_grad():
        assert not solver(world, pixels, K).rotation.requires_grad
    with torch.inference_mode():
        assert solver(world.detach(), pixels.detach(), K).rotation.is_inference()


def test_inputs_are_left_as_they_are(make_problems):
    p = make_problems(outliers=2)
    copies = [x.clone() for x in p[:3]]
    net()(*p[:3])
    assert all(torch.equal(one, two) for one, two in zip(p[:3], copies, strict=True))


# --- errors -----------------------------------------------------------------------------------------------------------


def bad_calls(p):
    world, pixels, K = p.world_points, p.img_points, p.intrinsics
    ones, mask = torch.ones(7, 9, dtype=torch.float64), torch.ones(7, 9, dtype=torch.bool)
    return {
        "world_2d": ((world[0], pixels, K), {}, ShapeError, r"\[9, 3\]"),
        "world_of_4": ((torch.cat((world, world[..., :1]), -1), pixels, K), {}, ShapeError, r"4"),
        "pixels_of_3": ((world, world, K), {}, ShapeError, r"3"),
        "pixels_2d": ((world, pixels[0], K), {}, ShapeError, r"\[9, 2\]"),
        "other_batch": ((world, pixels[:6], K), {}, ShapeError, r"img_points.*\(7, 9, 2\).*\(6, 9, 2\)"),
        "other_n": ((world, pixels[:, :8], K), {}, ShapeError, r"img_points.*\(7, 9, 2\).*\(7, 8, 2\)"),
        "K_of_other_batch": ((world, pixels, K[:6]), {}, ShapeError, r"intrinsics.*\(7, 3, 3\).*\(6, 3, 3\)"),
        "K_of_4": ((world, pixels, torch.eye(4).double()), {}, ShapeError, r"intrinsics.*\(4, 4\)"),
        "K_vector": ((world, pixels, K[0, 0]), {}, ShapeError, r"intrinsics.*\(3,\)"),
        "weights": ((world, pixels, K), {"weights": ones[:, :8]}, ShapeError, r"weights.*\(7, 9\).*\(7, 8\)"),
        "mask": ((world, pixels, K), {"mask": mask[:1]}, ShapeError, r"mask.*\(7, 9\).*\(1, 9\)"),
        "two_pairs": ((world[:, :2], pixels[:, :2], K), {}, ShapeError, r"3 pairs.*2"),
        "float32_pixels": ((world, pixels.float(), K), {}, TypeCheckError, r"img_points.*float32.*float64"),
        "float32_K": ((world, pixels, K.float()), {}, TypeCheckError, r"intrinsics.*float32.*float64"),
        "float32_weights": ((world, pixels, K), {"weights": ones.float()}, TypeCheckError, r"weights.*float32"),
        "half": ((world.half(), pixels.half(), K.half()), {}, TypeCheckError, r"float16.*\.float\(\)"),
        "bfloat16": ((world.bfloat16(), pixels.bfloat16(), K.bfloat16()), {}, TypeCheckError, r"bfloat16.*\.float\(\)"),
        "integers": ((world.long(), pixels.long(), K.long()), {}, TypeCheckError, r"int64"),
        "float_mask": ((world, pixels, K), {"mask": ones}, TypeCheckError, r"mask.*bool.*float64"),
        "meta_pixels": ((world, pixels.to("meta"), K), {}, DeviceError, r"img_points.*meta.*cpu"),
        "meta_K": ((world, pixels, K.to("meta")), {}, DeviceError, r"intrinsics.*meta.*cpu"),
        "meta_mask": ((world, pixels, K), {"mask": mask.to("meta")}, DeviceError, r"mask.*meta.*cpu"),
        "init": ((world, pixels, K), {"init": Pose(p.pose.rotation[:6], p.pose.translation)}, ShapeError, r"6"),
        "init_t": ((world, pixels, K), {"init": Pose(p.pose.rotation, p.pose.rotation)}, ShapeError, r"3"),
    }


@pytest.mark.parametrize("solver", [net(), PnPNet()], ids=["mlp", "given"])
def test_wrong_inputs_raise_typed_errors_that_say_what_came(solver, make_problems):
    for name, (arguments, options, error, message) in bad_calls(make_problems()).items():
        with pytest.raises(error, match=f"(?s){message}") as raised:
            solver(*arguments, **options)
        assert isinstance(raised.value, BaseError), name


def test_a_wrong_n_names_both_numbers(make_problems):
    p = make_problems(10)
    with pytest.raises(ShapeError, match=r"(?s)n = 9.*N = 10"):
        net(9)(p.world_points, p.img_points, p.intrinsics)


# --- bad problems among good ones -------------------------------------------------------------------------------------


def turn_away(p, i):
    """What a camera would see through its back: true depths negative, pixels by the same formula."""
    cam = p.world_points[i] @ p.pose.rotation[i].mT + p.pose.translation[i]
    cam = cam * torch.tensor([1.0, 1, -1]).to(cam)
    world = (cam - p.pose.translation[i]) @ p.pose.rotation[i]
    return world, p.intrinsics[i, 0, 0] * cam[:, :2] / cam[:, 2:]


def spoil(p, i, how):
    """The problems with problem ``i`` spoilt in one way, and whether its inputs may still have an answer."""
    world, pixels, K = (x.clone() for x in p[:3])
    generator = torch.Generator().manual_seed(5)
    match how:
        case "nan_world":
            world[i, 4, 1] = math.nan
        case "all_nan":
            world[i], pixels[i], K[i] = math.nan, math.nan, math.nan
        case "inf_world":
            world[i, 0, 0] = math.inf
        case "nan_pixel":
            pixels[i, 8, 0] = math.nan
        case "inf_pixel":
            pixels[i] = -math.inf
        case "nan_camera":
            K[i, 1, 1] = math.nan
        case "zero_camera":
            K[i] = 0.0
        case "huge":
            world[i] = torch.finfo(world.dtype).max
        case "huge_spread":
            world[i] *= 1e30
        case "huge_pixels":
            pixels[i] *= 1e30
        case "tiny":
            world[i] *= 1e-30
        case "all_zero":
            world[i], pixels[i] = 0.0, 0.0
        case "all_equal":
            world[i] = world[i, :1].clone()
        case "equal_pixels":
            pixels[i] = pixels[i, :1].clone()
        case "collinear":
            step = torch.arange(9, dtype=world.dtype)[:, None]
            world[i] = world[i, :1] + step * torch.tensor([1.0, 2, -0.5]).to(world)
        case "behind":
            world[i], pixels[i] = turn_away(p, i)
        case "all_outliers":
            pixels[i] = 3400 * (2 * torch.rand(9, 2, generator=generator) - 1).to(pixels)
    return world, pixels, K


#: Those of which the contract says that there is no answer.
HOPELESS = (
    *("nan_world", "all_nan", "inf_world", "nan_pixel", "inf_pixel", "nan_camera", "zero_camera"),
    *("all_zero", "all_equal", "collinear"),
)
ODD = (*HOPELESS, "equal_pixels", "huge", "huge_spread", "huge_pixels", "tiny", "behind", "all_outliers")
SOLVERS = {
    "net": lambda: net(9, 5),
    "net_double": lambda: net(9, 5).double(),
    "additive": lambda: net(9, 5, update="additive"),
    "rejecting": lambda: net(9, 5, reject_worse=True),
    "first_stage": lambda: net(9, 0),
    "identity": lambda: PnPNet(None, RobustWeightedLM(m=5)),
}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("solver", SOLVERS.values(), ids=SOLVERS.keys())
@pytest.mark.parametrize("how", ODD)
def test_a_bad_problem_changes_no_other_by_a_bit(how, solver, dtype, make_problems):
    p = make_problems(outliers=1, dtype=dtype)
    solver = solver()
    good = [0, 1, 3, 4, 5, 6]
    inputs = [x.requires_grad_() for x in spoil(p, 2, how)]
    result = solver(*inputs)
    reference = solver(*p[:3])
    assert_same(pytree.tree_map(lambda x: x[good], result), pytree.tree_map(lambda x: x[good], reference))
    assert all(x.isfinite().all() for x in pytree.tree_leaves(result))
    if how in (*HOPELESS, "equal_pixels"):
        assert not result.ok[2]
    # Every output may enter a loss: all gradients are finite, and there are none where there is no answer.
    sum(x.sum() for x in pytree.tree_leaves(result) if x.is_floating_point()).backward()
    for name, tensor in zip(("world_points", "img_points", "intrinsics"), inputs, strict=True):
        assert tensor.grad.isfinite().all(), name
        if how in HOPELESS:
            assert not tensor.grad[2].any(), name
    for name, parameter in solver.named_parameters():
        assert (parameter.grad is not None) == parameter.requires_grad, name
        assert parameter.grad is None or parameter.grad.isfinite().all(), name


@pytest.mark.parametrize("how", HOPELESS)
def test_a_bad_problem_gives_the_parameters_no_gradient(how, make_problems):
    p = make_problems()
    solver = net(9, 5)
    result = solver(*spoil(p, 2, how))
    leaves = [x[2].sum() for x in pytree.tree_leaves(result) if x.is_floating_point() and x.requires_grad]
    sum(leaves).backward()
    for parameter in solver.parameters():
        assert parameter.grad is None or not parameter.grad.any()


def test_a_failed_refinement_gives_no_gradient_through_the_pose(make_problems):
    """Where ``ok`` is false but the input is sound, only the first guess can be trained."""
    p = make_problems(9, 100)
    inputs = [x.clone().requires_grad_() for x in p[:3]]
    result = net(9, 5)(*inputs)
    assert (~result.ok).any()
    (
        result.rotation[~result.ok].sum() + result.translation[~result.ok].sum() + result.cost[~result.ok].sum()
    ).backward()
    assert not any(x.grad is not None and x.grad.any() for x in inputs)


@pytest.mark.parametrize("how", ["nan_world", "inf_pixel", "all_equal", "collinear", "behind", "all_outliers"])
def test_good_problems_equal_being_solved_alone(how, make_problems, perturb):
    p = make_problems()
    init = perturb(p.pose)
    world, pixels, K = spoil(p, 2, how)
    given = PnPNet(None, RobustWeightedLM(m=5))
    with_net = net(9, 3).double()
    together = given(world, pixels, K, init=init)
    guessed = with_net(world, pixels, K)
    for i in (0, 1, 3, 4, 5, 6):
        part = slice(i, i + 1)
        alone = given(world[part], pixels[part], K[part], init=Pose(*(x[part] for x in init)))
        assert alone.ok
        assert_same(pytree.tree_map(lambda x, part=part: x[part], together), alone, rtol=1e-9, atol=1e-9)
        alone = with_net(world[part], pixels[part], K[part])
        first = Pose(*(x[part] for x in guessed.init))
        assert_same(first, alone.init, rtol=1e-9, atol=1e-9)
        if alone.ok:
            assert_same(pytree.tree_map(lambda x, part=part: x[part], guessed.pose), alone.pose, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("module_dtype", DTYPES)
def test_float64_inputs_give_float64_answers_whatever_the_weights(module_dtype, make_problems):
    """Shipped weights are float32: a problem in float64 is still itself in a batch, to 1e-9."""
    p = make_problems(9, 50)
    solver = net(9, 5).to(module_dtype)
    together = solver(*p[:3])
    for i in range(50):
        alone = solver(*(x[i : i + 1] for x in p[:3]))
        assert_same(pytree.tree_map(lambda x, i=i: x[i : i + 1], together.init), alone.init, rtol=1e-9, atol=1e-9)


def test_all_bad_is_no_exception(make_problems):
    p = make_problems(9, 4)
    nothing = torch.full_like(p.world_points, math.nan)
    result = net()(nothing, p.img_points, p.intrinsics)
    assert not result.ok.any()
    assert torch.equal(result.rotation, torch.eye(3, dtype=torch.float64).expand(4, 3, 3))
    assert not result.weights.any()


def test_everything_behind_the_true_pose_is_not_ok(make_problems):
    p = make_problems(9, 200)
    seen = [turn_away(p, i) for i in range(200)]
    world, pixels = (torch.stack(x) for x in zip(*seen, strict=True))
    result = PnPNet()(world, pixels, p.intrinsics, init=p.pose)
    assert not result.ok.any()
    assert_same(result.pose, p.pose, rtol=1e-12, atol=1e-12)  # there is no way from there


@pytest.mark.parametrize("bad", ["nan", "inf", "zero_rotation", "far"])
def test_a_bad_pose_by_hand_spoils_only_its_problem(bad, make_problems, perturb):
    p = make_problems()
    init = perturb(p.pose)
    rotation, translation = init.rotation.clone(), init.translation.clone()
    match bad:
        case "nan":
            rotation[2, 0, 0] = math.nan
        case "inf":
            translation[2, 1] = math.inf
        case "zero_rotation":
            rotation[2] = 0.0
        case "far":
            translation[2] = 1e300
    inputs = [x.clone().requires_grad_() for x in p[:3]]
    result = PnPNet()(*inputs, init=Pose(rotation, translation))
    reference = PnPNet()(*p[:3], init=init)
    good = [0, 1, 3, 4, 5, 6]
    assert_same(pytree.tree_map(lambda x: x[good], result), pytree.tree_map(lambda x: x[good], reference))
    assert all(x.isfinite().all() for x in pytree.tree_leaves(result))
    sum(x.sum() for x in pytree.tree_leaves(result) if x.requires_grad).backward()
    assert all(x.grad.isfinite().all() for x in inputs)


# --- gradients --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("first", ["given", "net"])
def test_gradcheck_through_the_whole_layer(first, weighted, make_problems, perturb):
    p = make_problems(5, 2, outliers=1)
    torch.manual_seed(1)
    solver = PnPNet(MLPInit(5), RobustWeightedLM(m=2)).double()
    init = perturb(p.pose, angle=0.01, shift=0.1)

    def camera(focal, centre):
        diagonal = torch.cat((1000 * focal, torch.ones(2, 1, dtype=torch.float64)), 1)
        return torch.diag_embed(diagonal) + torch.nn.functional.pad(1000 * centre[..., None], (2, 0, 0, 1))

    # Pixels in thousands, so that one difference step suits all inputs.
    def run(world, pixels, focal, centre, weights, turn, shift):
        given = Pose(init.rotation + turn, init.translation + shift) if first == "given" else None
        result = solver(world, 1000 * pixels, camera(focal, centre), weights, init=given)
        outputs = [result.init.rotation, result.init.translation]
        # From an untrained guess a problem need not be solved: its pose then carries no gradient by contract.
        if first == "given":
            outputs += [result.rotation, result.translation, result.weights, result.cost]
        return tuple(outputs)

    generator = torch.Generator().manual_seed(2)
    weights = torch.ones(2, 5, dtype=torch.float64)
    if weighted:
        weights = 0.5 + torch.rand(2, 5, generator=generator, dtype=torch.float64)
    focal = torch.tensor([[3.4, 3.4], [3.0, 3.8]], dtype=torch.float64)
    centre = torch.tensor([[0.0, 0.0], [0.1, -0.1]], dtype=torch.float64)
    pixels = p.img_points / 3400 * focal[:, None] + centre[:, None]
    inputs = [p.world_points, pixels, focal, centre, weights]
    inputs += [torch.zeros(2, 3, 3, dtype=torch.float64), torch.zeros(2, 3, dtype=torch.float64)]
    inputs = [x.clone().requires_grad_() for x in inputs]
    if first == "given":
        assert solver(p.world_points, 1000 * pixels, camera(focal, centre), weights, init=init).ok.all()
    assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-4, rtol=1e-4)


def test_the_whole_layer_trains(make_problems):
    """A few steps of Adam on the first guess of one batch lower its loss."""
    p = make_problems(9, 200, dtype=torch.float32)
    solver = net(9, 2)
    loss = PoseLoss(saturation=1.0)
    optimizer = torch.optim.Adam(solver.parameters(), lr=1e-3)
    losses = []
    for _ in range(30):
        terms = loss(solver(*p[:3]), p)
        optimizer.zero_grad()
        terms.total.backward()
        optimizer.step()
        losses.append(terms.total.item())
    assert losses[-1] < 0.8 * losses[0]


# --- compile, export, autocast, copies --------------------------------------------------------------------------------


@pytest.mark.parametrize("cast_dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ["net", "additive", "identity"])
def test_autocast_around_the_layer_changes_no_bit(name, dtype, cast_dtype, make_problems):
    """Neither of the results nor of the gradients."""
    outcomes = []
    for enabled in (False, True):
        world, pixels, K = (x.requires_grad_() for x in make_problems(dtype=dtype)[:3])
        torch.manual_seed(0)
        solver = SOLVERS[name]()
        with torch.autocast("cpu", dtype=cast_dtype, enabled=enabled):
            result = solver(world, pixels, K)
            loss = result.init.translation.sum() + result.translation.sum() + result.cost.sum()
        loss.backward()
        gradients = [x.grad for x in (world, pixels, K, *solver.parameters())]
        outcomes.append((*pytree.tree_leaves(result), *gradients))
    for plain, cast in zip(*outcomes, strict=True):
        assert plain is cast is None or torch.equal(plain, cast)


@pytest.mark.parametrize("options", [{}, {"update": "additive", "reject_worse": True, "kernel": "huber"}], ids=str)
def test_the_layer_exports(options, make_problems):
    p = make_problems(dtype=torch.float32)
    solver = net(9, 2, **options).eval()
    program = torch.export.export(solver, (p.world_points, p.img_points, p.intrinsics))
    other = make_problems(seed=1, dtype=torch.float32)
    exported = program.module()(other.world_points, other.img_points, other.intrinsics)
    assert_same(exported, solver(*other[:3]), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("masked", [False, True])
def test_the_layer_compiles_into_one_graph(masked, make_problems):
    p = make_problems(dtype=torch.float32)
    solver = net(9, 2)
    mask = torch.ones(7, 9, dtype=torch.bool) if masked else None
    compiled = torch.compile(solver, backend="eager", fullgraph=True)
    assert_same(compiled(*p[:3], mask=mask), solver(*p[:3], mask=mask), rtol=1e-5, atol=1e-5)


def test_copies_and_dtypes_of_the_module(make_problems):
    p = make_problems()
    solver = net()
    assert_same(copy.deepcopy(solver)(*p[:3]), solver(*p[:3]))
    double = copy.deepcopy(solver).double()
    assert {x.dtype for x in double.state_dict().values()} == {torch.float64}
    # The network in another precision, its guess a little different.
    assert_same(double(*p[:3]).init, solver(*p[:3]).init, rtol=1e-4, atol=1e-3)
    # float32 inputs to a float64 module come out as float32.
    low = make_problems(dtype=torch.float32)
    assert double(*low[:3]).rotation.dtype == torch.float32


# --- a pose by hand ---------------------------------------------------------------------------------------------------


def test_a_pose_by_hand_takes_the_place_of_the_network(make_problems, perturb):
    p = make_problems()
    init = perturb(p.pose)
    by_hand = net(9, 5)(*p[:3], init=init)
    torch.testing.assert_close(by_hand.init.matrix, init.matrix, rtol=1e-12, atol=1e-11)
    assert by_hand.ok.all()
    assert_same(by_hand, PnPNet(None, RobustWeightedLM(m=5))(*p[:3], init=init))
    as_tuple = PnPNet()(*p[:3], init=(init.rotation, init.translation))
    assert as_tuple.ok.all()


def test_without_anything_the_identity_is_the_guess(make_problems):
    p = make_problems()
    result = PnPNet(None, RobustWeightedLM(m=0))(*p[:3])
    torch.testing.assert_close(result.matrix, torch.eye(4, dtype=torch.float64).expand(7, 4, 4), rtol=0, atol=1e-12)


# --- weights on disk --------------------------------------------------------------------------------------------------


@pytest.fixture
def saved(tmp_path):
    solver = PnPNet(
        MLPInit(6, world_scale=2.0),
        RobustWeightedLM(m=2, kernel="cauchy", shared=True, update="additive", reject_worse=True),
        Normalize(center=False),
    )
    with torch.no_grad():
        for parameter in solver.parameters():
            parameter.add_(0.01 * torch.randn_like(parameter))
    folder = tmp_path / "deep" / "folder"
    solver.save_pretrained(folder)
    return solver, folder


@pytest.mark.parametrize("dtype", DTYPES)
def test_saving_and_loading_gives_bit_equal_outputs(dtype, saved, make_problems):
    solver, folder = saved
    p = make_problems(6, dtype=dtype)
    for where in (folder, str(folder)):
        again = PnPNet.from_pretrained(where)
        assert again.config() == solver.config()
        assert not again.training
        assert_same(again(*p[:3]), solver(*p[:3]))


def test_a_solver_without_a_network_is_saved_too(tmp_path, make_problems, perturb):
    p = make_problems()
    init = perturb(p.pose)
    solver = PnPNet(None, RobustWeightedLM(m=2, step=0.9))
    solver.save_pretrained(tmp_path)
    assert_same(PnPNet.from_pretrained(tmp_path)(*p[:3], init=init), solver(*p[:3], init=init))


def damage(folder, how):
    config, weights = folder / "config.json", folder / "model.safetensors"
    content = json.loads(config.read_text())
    match how:
        case "truncated":
            weights.write_bytes(weights.read_bytes()[:-100])
        case "empty":
            weights.write_bytes(b"")
        case "noise":
            weights.write_bytes(bytes(range(256)) * 8)
        case "pickle":
            weights.write_bytes(pickle.dumps({"a": 1}))
        case "torch_save":
            torch.save({"a": torch.zeros(1)}, weights)
        case "missing":
            weights.unlink()
        case "foreign":
            from safetensors.torch import save_file

            save_file({"linear.weight": torch.zeros(2, 2)}, weights)
        case "other_n":
            content["init"]["n"] = 7
            config.write_text(json.dumps(content))
        case "not_json":
            config.write_text("{n: 9")
        case "not_a_dict":
            config.write_text("[1, 2]")
        case "null":
            config.write_text("null")
        case "binary_config":
            config.write_bytes(b"\xff\xfe\x00")
        case "no_refine":
            del content["refine"]
            config.write_text(json.dumps(content))
        case "unknown_key":
            content["refine"]["momentum"] = 0.9
            config.write_text(json.dumps(content))
        case "unknown_part":
            content["colour"] = "red"
            config.write_text(json.dumps(content))
        case "unknown_init":
            content["init"]["name"] = "Oracle"
            config.write_text(json.dumps(content))
        case "unknown_kernel":
            content["refine"]["kernel"] = "tukey"
            config.write_text(json.dumps(content))
        case "wrong_type":
            content["init"]["n"] = "six"
            config.write_text(json.dumps(content))
        case "refine_is_a_list":
            content["refine"] = [1]
            config.write_text(json.dumps(content))


@pytest.mark.parametrize(
    "how",
    [
        *("truncated", "empty", "noise", "pickle", "torch_save", "missing", "foreign", "other_n", "not_json"),
        *("not_a_dict", "null", "binary_config", "no_refine", "unknown_key", "unknown_part", "unknown_init"),
        *("unknown_kernel", "wrong_type", "refine_is_a_list"),
    ],
)
def test_damaged_weights_raise_a_typed_error(how, saved):
    _, folder = saved
    damage(folder, how)
    with pytest.raises(ValueCheckError) as raised:
        PnPNet.from_pretrained(folder)
    assert isinstance(raised.value, BaseError)
    assert str(raised.value)


def test_unknown_names_list_the_shipped_ones(tmp_path, monkeypatch):
    import socket

    def no_network(*args, **kwargs):
        raise AssertionError("the network was touched")

    monkeypatch.setattr(socket, "getaddrinfo", no_network)
    monkeypatch.setattr(socket.socket, "connect", no_network)
    for name in ("pnpnet-n8", "", ".", str(tmp_path), "a/b/c", str(tmp_path / "missing")):
        with pytest.raises(FileNotFoundError, match=r"shipped are \["):
            PnPNet.from_pretrained(name)


def test_solvers_by_name(make_problems):
    names = list_solvers()
    assert "identity-lm" in names
    assert names == sorted(names)
    solver = create_solver("identity-lm", m=3)
    assert not solver.training
    assert solver(*make_problems()[:3]).matrix.shape == (7, 4, 4)
    with pytest.raises(ValueCheckError, match=r"pnpnet-nine.*identity-lm"):
        create_solver("pnpnet-nine")
    with pytest.raises(ValueCheckError, match="iterations"):
        create_solver("identity-lm", iterations=3)


@pytest.mark.parametrize("m", [0, 2, PnPNet.from_pretrained("pnpnet-n9").refine.m])
def test_the_first_iterations_of_trained_weights(m, make_problems):
    p = make_problems()
    whole = create_solver("pnpnet-n9")
    solver = create_solver("pnpnet-n9", m=m)
    assert solver.refine.m == m
    corr, _ = whole.normalize(*p[:3])
    guess = whole.init(corr)
    for mine, others in zip(solver.refine(corr, guess).pose, whole.refine(corr, guess, m=m).pose, strict=True):
        assert torch.equal(mine, others)
    most = whole.refine.m
    with pytest.raises(BaseError, match=f"from 0 to {most}, got {most + 1}"):
        create_solver("pnpnet-n9", m=most + 1)


@pytest.mark.parametrize("name", [name for name in list_solvers() if not name.startswith(("opencv", "poselib", "pyc"))])
def test_every_solver_of_ours_keeps_the_contract(name, make_problems):
    """Shapes, dtype, permutation of the pairs, and a bad problem that changes no other by a bit."""
    n = int(name.rpartition("-n")[2]) if "net-n" in name else 9
    p = make_problems(n=n, dtype=torch.float64)
    solver = create_solver(name)
    with torch.no_grad():
        result = solver(*p[:3])
        broken = p.world_points.clone()
        broken[3] = torch.nan
        beside = solver(broken, *p[1:3])
        order = torch.randperm(n, generator=torch.Generator().manual_seed(0))
        shuffled = solver(p.world_points[:, order], p.img_points[:, order], p.intrinsics)
    assert result.matrix.shape == (7, 4, 4)
    assert result.weights.shape == (7, n)
    assert result.matrix.dtype == result.cost.dtype == torch.float64
    others = torch.arange(7) != 3
    assert not beside.ok[3]
    assert beside.matrix[3].isfinite().all()
    for mine, theirs in zip(beside[:5], result[:5], strict=True):
        assert torch.equal(mine[others], theirs[others])
    # The order does not matter, save that enumerated samples are tried in it.
    if "ransac" not in name:
        ok = result.ok & shuffled.ok
        torch.testing.assert_close(shuffled.matrix[ok], result.matrix[ok], rtol=1e-6, atol=1e-6)
        assert torch.equal(shuffled.ok, result.ok)


# --- corners that once were wrong -----------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1e7, 1e9, 1e20, 1e36])
@pytest.mark.parametrize("dtype", DTYPES)
def test_large_pixels_leave_finite_gradients(size, dtype, make_problems):
    p = make_problems(dtype=dtype)
    pixels = p.img_points.clone()
    pixels[2, 4, 1] = size
    pixels.requires_grad_()
    solver = net(9, 5).to(dtype)
    result = solver(p.world_points, pixels, p.intrinsics)
    assert not result.ok[2]
    (result.rotation.sum() + result.translation.sum() + result.weights.sum() + result.init.translation.sum()).backward()
    assert pixels.grad.isfinite().all()
    assert all(x.grad.isfinite().all() for x in solver.parameters() if x.grad is not None)


def test_a_weight_of_zero_has_no_gradient(make_problems, perturb):
    p = make_problems()
    weights = torch.ones(7, 9, dtype=torch.float64)
    weights[:, 3] = 0.0
    weights.requires_grad_()
    result = PnPNet(None, RobustWeightedLM(m=3))(*p[:3], weights, init=perturb(p.pose))
    result.translation.sum().backward()
    assert (weights.grad[:, 3] == 0).all()
    assert (weights.grad[result.ok][:, :3] != 0).any()


def test_a_common_factor_of_tiny_weights_does_not_matter(make_problems, perturb):
    p = make_problems(dtype=torch.float32)
    solver, init = PnPNet(None, RobustWeightedLM(m=5)), perturb(p.pose)
    one = solver(*p[:3], torch.ones(7, 9), init=init)
    two = solver(*p[:3], torch.full((7, 9), 2.0**-100), init=init)
    torch.testing.assert_close(two.matrix, one.matrix, rtol=1e-5, atol=1e-5)


def test_costs_of_failed_problems_can_be_summed(make_problems):
    for dtype in DTYPES:
        p = make_problems(dtype=dtype)
        cost = net(9, 2).to(dtype)(torch.full_like(p.world_points, torch.nan), *p[1:3]).cost
        assert cost.sum().isfinite()


def test_cameras_that_are_no_pinholes_are_refused(make_problems):
    p = make_problems()
    K = p.intrinsics.clone()
    K[1, 2, 2], K[2, 1, 0], K[3, 0, 1] = 2.0, 50.0, 1.0
    ok = PnPNet(None)(*p[:2], K, init=p.pose).ok
    assert ok.tolist() == [True, False, False, False, True, True, True]


@pytest.mark.parametrize("with_net", [True, False])
def test_export_and_compile_with_any_batch(with_net, make_problems):
    solver = net(9, 2).double() if with_net else PnPNet(None, RobustWeightedLM(m=2))
    p, q = make_problems(batch=4), make_problems(batch=6, seed=1)
    batch = torch.export.Dim("B")
    program = torch.export.export(solver.eval(), tuple(p[:3]), dynamic_shapes=({0: batch},) * 3)
    torch.testing.assert_close(program.module()(*q[:3]).rotation, solver(*q[:3]).rotation, rtol=1e-9, atol=1e-9)
    compiled = torch.compile(solver, backend="eager", fullgraph=True, dynamic=True)
    torch.testing.assert_close(compiled(*q[:3]).rotation, solver(*q[:3]).rotation, rtol=1e-9, atol=1e-9)


def test_an_initialiser_of_ones_own(make_problems, tmp_path):
    class Identity(torch.nn.Module):
        def forward(self, corr):
            batch = corr.weights.shape[0]
            eye = torch.eye(3).to(corr.weights).expand(batch, 3, 3)
            return Guess(Pose(eye, corr.weights.new_zeros(batch, 3)), torch.ones_like(corr.weights))

    solver = PnPNet(Identity(), RobustWeightedLM(m=2))
    assert solver(*make_problems()[:3]).matrix.shape == (7, 4, 4)
    assert solver.config()["init"] == {"name": "Identity"}
    with pytest.raises(ValueCheckError, match="Identity cannot be saved"):
        solver.save_pretrained(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_an_initialiser_without_a_guess_fails_its_problem_alone(make_problems):
    class Truth(torch.nn.Module):
        def forward(self, corr):
            ok = torch.arange(len(corr.weights)) != 2
            return Guess(pose, torch.ones_like(corr.weights), ok)

    p = make_problems()
    normalize = Normalize()
    pose = normalize.apply_to_pose(p.pose, normalize(*p[:3])[1])
    world_points = p.world_points.clone().requires_grad_()
    result = PnPNet(Truth(), RobustWeightedLM(m=2), normalize)(world_points, *p[1:3])
    assert result.ok.tolist() == [True, True, False, True, True, True, True]
    result.translation.sum().backward()
    gradient = world_points.grad.abs().sum((1, 2))
    assert gradient[2] == 0
    assert (gradient[result.ok] > 0).all()


def test_an_init_pose_of_another_shape_or_dtype_is_refused(make_problems):
    p = make_problems()
    with pytest.raises(ShapeError, match="init translation"):
        PnPNet(None)(*p[:3], init=Pose(p.pose.rotation, p.pose.translation[:3]))
    with pytest.raises(TypeCheckError, match="init rotation"):
        PnPNet(None)(*p[:3], init=Pose(p.pose.rotation.float(), p.pose.translation))


@pytest.mark.parametrize("name", ["epnp-lm", "reppnp-lm"])
def test_solvers_without_a_network_are_saved_too(name, make_problems, tmp_path):
    solver = create_solver(name, m=2)
    solver.save_pretrained(tmp_path)
    p = make_problems()
    again = PnPNet.from_pretrained(tmp_path)
    assert again.config() == solver.config()
    assert torch.equal(again(*p[:3]).matrix, solver(*p[:3]).matrix)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ["epnp-lm", "reppnp-lm", "p3p-ransac", "ransac-epnp-lm"])
def test_degenerate_worlds_leave_no_gradient_anywhere(name, dtype, make_problems):
    """Not even in what all problems share: a parameter, or a factor before the layer."""
    p = make_problems(n=9, dtype=dtype)
    world = p.world_points.clone()
    world[1], world[2], world[3] = 0.0, 1.0, world[3] * torch.finfo(dtype).tiny ** 0.5
    world[4] = world[4, :1] + torch.arange(9, dtype=dtype)[:, None] * torch.ones(3, dtype=dtype)
    factor = torch.ones((), dtype=dtype, requires_grad=True)
    leaf = world.requires_grad_()
    result = create_solver(name)(leaf * factor, p.img_points * factor, p.intrinsics)
    assert not result.ok[1:5].any()
    (result.cost.sum() + result.translation.sum() + result.init.translation.sum()).backward()
    assert factor.grad.isfinite()
    assert torch.equal(leaf.grad[1:5], torch.zeros(4, 9, 3, dtype=dtype))


@pytest.mark.parametrize("dtype", DTYPES)
def test_samples_round_the_same_wherever_they_stand(dtype, make_problems):
    problems = make_problems(n=7, batch=40, dtype=dtype)
    solver = create_solver("ransac-epnp-lm", max_samples=50)
    whole = solver(*problems[:3])
    for first_bad in (3, 27, 38):
        world = problems.world_points.clone()
        world[first_bad:] = torch.nan
        beside = solver(world, *problems[1:3])
        assert torch.equal(beside.matrix[:first_bad], whole.matrix[:first_bad])


@pytest.mark.parametrize("name", ["epnp-lm", "reppnp", "p3p-ransac", "ransac-epnp-lm"])
def test_solvers_are_pickled(name, make_problems):
    p = make_problems()
    solver = create_solver(name)
    assert torch.equal(pickle.loads(pickle.dumps(solver))(*p[:3]).matrix, solver(*p[:3]).matrix)


@pytest.mark.parametrize("unit", [1e-46, 1.0, 1e39])
def test_any_unit_of_the_weights(unit, make_problems):
    p = make_problems(n=10, noise=False)
    result = create_solver("p3p-ransac")(*p[:3], torch.full((7, 10), unit, dtype=torch.float64))
    assert result.ok.all()


def test_what_is_no_tensor_or_no_name_is_a_typed_error(make_problems):
    p = make_problems()
    with pytest.raises(TypeCheckError, match="world_points must be a tensor, got list"):
        PnPNet(None)(p.world_points.tolist(), *p[1:3])
    with pytest.raises(ValueCheckError, match="No solver"):
        create_solver(["epnp"])
    for options in ({"seed": 1.5}, {"seed": -1}, {"threshold": -1.0}):
        with pytest.raises(BaseError):
            create_solver("p3p-ransac", **options)


# --- views ----------------------------------------------------------------------------------------------------------


def untrained(views=1, m=6, n=9):
    torch.manual_seed(3)
    return PnPNet(MLPInit(n), RobustWeightedLM(m), views=views).double().eval()


@pytest.mark.parametrize("views", [0, 9, 2.0, True, "2"])
def test_a_number_of_views_that_there_is_not_is_refused(views):
    with pytest.raises(BaseError, match="views must be an integer from 1 to 8"):
        PnPNet(MLPInit(9), views=views)


def test_more_views_solve_more(make_problems):
    """Also for a network that has learned little: the poses it starts from are simply more."""
    p = make_problems(batch=400)
    rates = [success(pose_errors(untrained(views, m=10)(*p[:3]).pose, p.pose)).double().mean() for views in (1, 2, 8)]
    assert rates[0] + 0.03 < rates[1]
    assert rates[1] + 0.1 < rates[2]


@pytest.mark.parametrize("views", [2, 8])
def test_with_views_the_first_guess_is_still_that_of_the_problem_itself(views, make_problems):
    p = make_problems()
    torch.testing.assert_close(untrained(views)(*p[:3]).init, untrained()(*p[:3]).init)
    alone, several = (untrained(k)(*p[:3], first_stage_only=True) for k in (1, views))
    torch.testing.assert_close(several.pose, alone.pose)
    torch.testing.assert_close(untrained(views, m=0)(*p[:3]).pose, untrained(m=0)(*p[:3]).pose)


def test_views_do_not_matter_for_a_pose_that_is_given(make_problems, perturb):
    p = make_problems()
    start = perturb(p.pose)
    torch.testing.assert_close(untrained(4)(*p[:3], init=start).pose, untrained()(*p[:3], init=start).pose)


def test_views_of_a_method_that_mirrors_do_not_change(make_problems):
    p = make_problems(outliers=1)
    one, four = (PnPNet(EPnP(), RobustWeightedLM(4), views=views)(*p[:3]) for views in (1, 4))
    assert one.ok.any()
    torch.testing.assert_close(four.pose, one.pose, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(four.weights, one.weights, rtol=1e-6, atol=1e-8)


def test_views_of_one_problem_do_not_touch_another(make_problems):
    p = make_problems(batch=5, outliers=1)
    solver = untrained(3)
    together = solver(*p[:3])
    for i in range(5):
        torch.testing.assert_close(solver(*(x[i : i + 1] for x in p[:3])).matrix, together.matrix[i : i + 1])
    spoilt = p.world_points.clone()
    spoilt[2, 4] = torch.nan
    result = solver(spoilt, *p[1:3])
    others = torch.arange(5) != 2
    assert not result.ok[2]
    assert result.matrix.isfinite().all()
    torch.testing.assert_close(result.matrix[others], together.matrix[others])


def test_gradients_with_views_are_finite_and_reach_the_network(make_problems):
    p = make_problems(batch=5)
    solver = untrained(3)
    p.world_points[1] = 0.0
    result = solver(*p[:3])
    (result.translation.sum() + result.weights.sum() + result.init.translation.sum()).backward()
    assert all(x.grad.isfinite().all() for x in solver.parameters())
    assert all(x.grad.abs().sum() > 0 for x in solver.init.parameters())


def test_views_are_saved(make_problems, tmp_path):
    solver = untrained(5)
    solver.save_pretrained(tmp_path)
    again = PnPNet.from_pretrained(tmp_path).double()
    assert again.views == 5
    p = make_problems()
    torch.testing.assert_close(again(*p[:3]).matrix, solver.float().double()(*p[:3]).matrix)


def test_trained_weights_take_views_and_m(make_problems):
    p = make_problems(batch=1000, outliers=2, noise=False)
    assert create_solver("pnpnet-n9", views=3).views == 3
    shallow = create_solver("pnpnet-n9", m=2, views=8)
    assert (shallow.refine.m, shallow.views) == (2, 8)
    results = [create_solver("pnpnet-n9", views=views).double()(*p[:3]) for views in (1, 8)]
    one, eight = (success(pose_errors(result.pose, p.pose)).double().mean() for result in results)
    assert eight > one + 0.01
    with pytest.raises(BaseError, match="views must be an integer from 1 to 8"):
        create_solver("pnpnet-n9", views=0)


# --- noise that is known --------------------------------------------------------------------------------------------


def test_known_noise_solves_more(make_problems, perturb):
    """From near the truth, with wrong pairs: weighing by what each pair is worth passes what residuals alone allow."""
    p = make_problems(batch=1000, outliers=3)
    start = perturb(p.pose)
    refine = RobustWeightedLM(10, kernel="geman_mcclure", robustness=6.0, damping=1e-4)
    solver = PnPNet(None, refine)
    plain = PnPNet(None, RobustWeightedLM(10, robustness=1.5, damping=1e-4))
    told = solver(*p[:3], init=start, img_sigma=1.0, world_sigma=0.05)
    rates = [success(pose_errors(r.pose, p.pose)).double().mean() for r in (told, plain(*p[:3], init=start))]
    assert rates[0] > rates[1] + 0.03
    assert told.ok.double().mean() > 0.97


def test_known_noise_has_the_units_of_the_inputs(make_problems, perturb):
    """A number, one of each problem or of each pair, in pixels and lengths of any camera and world."""
    p = make_problems(batch=6, outliers=2)
    solver, start = PnPNet(None, RobustWeightedLM(4, kernel="cauchy", robustness=3.0)), perturb(p.pose)
    number = solver(*p[:3], init=start, img_sigma=1.0, world_sigma=0.05)
    of_problems = solver(
        *p[:3], init=start, img_sigma=torch.ones(6).double(), world_sigma=torch.full((6,), 0.05).double()
    )
    of_pairs = solver(*p[:3], init=start, img_sigma=torch.ones(6, 9).double(), world_sigma=0.05)
    scaled = solver(
        1000.0 * p.world_points,
        p.img_points / 4.0,
        p.intrinsics / torch.tensor([[4.0], [4.0], [1.0]]).double(),
        init=Pose(start.rotation, 1000.0 * start.translation),
        img_sigma=0.25,
        world_sigma=50.0,
    )
    for other in (of_problems, of_pairs):
        torch.testing.assert_close(other.matrix, number.matrix)
        torch.testing.assert_close(other.weights, number.weights)
    torch.testing.assert_close(scaled.rotation, number.rotation)
    torch.testing.assert_close(scaled.translation, 1000.0 * number.translation)
    torch.testing.assert_close(scaled.cost, number.cost)
    assert torch.equal(scaled.ok, number.ok)


def test_noise_of_pairs_stays_with_them_in_any_order(make_problems):
    p = make_problems(batch=5, outliers=2)
    sigma = torch.rand(5, 9, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 5 + 0.2
    refine = RobustWeightedLM(5, kernel="cauchy", robustness=3.0)
    results = [
        PnPNet(None, refine, Normalize(order=order))(*p[:3], init=p.pose, img_sigma=sigma) for order in (False, True)
    ]
    torch.testing.assert_close(results[0].matrix, results[1].matrix)
    torch.testing.assert_close(results[0].weights, results[1].weights)


@pytest.mark.parametrize("name", ["img_sigma", "world_sigma"])
def test_noise_that_makes_no_sense_is_not_ok_or_refused(name, make_problems):
    p = make_problems(batch=6, noise=False)
    solver = create_solver("epnp-lm")
    sigma = torch.tensor([1.0, -1.0, torch.inf, 0.0, torch.nan, 1.0], dtype=torch.float64)
    result = solver(*p[:3], **{name: sigma})
    assert result.ok[[1, 2]].tolist() == [False, False]
    assert result.ok[[0, 5]].all()
    assert result.matrix.isfinite().all()
    alone = solver(*(x[5:] for x in p[:3]), **{name: sigma[5:]})
    assert torch.equal(alone.matrix[0], result.matrix[5])
    for wrong, message in (
        (torch.ones(5, dtype=torch.float64), "must be a number or have the shape"),
        (torch.ones(6), "float32 but world_points is torch.float64"),
        ("1", "must be a number or a tensor"),
    ):
        with pytest.raises(BaseError, match=message):
            solver(*p[:3], **{name: wrong})


@pytest.mark.parametrize("name", ["pnpnet-set", "pnpnet-n9", "epnp-lm", "reppnp-lm", "p3p-ransac", "identity-lm"])
@pytest.mark.parametrize("told", [{"img_sigma": 50.0}, {"world_sigma": 0.5}], ids=repr)
def test_gradients_are_finite_where_one_noise_is_told(name, told, make_problems):
    problems = make_problems(n=9, batch=3)
    inputs = [x.clone().requires_grad_() for x in problems[:3]]
    result = create_solver(name)(*inputs, **told)
    assert result.ok.any()
    total = result.translation.sum() + result.init.translation.sum()
    for gradient in torch.autograd.grad(total, inputs):
        assert gradient.isfinite().all()
        assert gradient.any()


def test_pairs_of_no_pose_are_not_ok_when_the_noise_is_known(make_problems):
    p = make_problems(batch=500)
    solver = create_solver("epnp-lm")
    noise = {"img_sigma": 1.0, "world_sigma": 0.05}
    garbage = solver(p.world_points, p.img_points.roll(1, 0), p.intrinsics, **noise)
    assert garbage.ok.double().mean() < 0.02
    assert solver(*p[:3], **noise).ok.double().mean() > 0.95


# --- torch.func ------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")  # PyTorch's own, of jvp
@pytest.mark.parametrize("name", ["pnpnet-set", "pnpnet-n9", "epnp-lm", "reppnp-lm", "identity-lm"])
def test_transforms_of_torch_func(name, make_problems):
    """As the page on training loops says: reverse mode for all, forward mode without EPnP, REPPnP and P3P."""
    world, img, intrinsics = make_problems(9, 3)[:3]
    solver = create_solver(name)

    def translations(pixels):
        return solver(world, pixels, intrinsics).translation

    jacobian = torch.func.jacrev(lambda pixels: translations(pixels).sum(0))(img)  # (3, B, N, 2)
    pixels = img.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(translations(pixels)[:, 2].sum(), pixels)
    torch.testing.assert_close(jacobian[2], gradient)
    direction = torch.randn(img.shape, dtype=img.dtype)

    def forward():
        return torch.func.jvp(translations, (img,), (direction,))[1]

    if name in ("pnpnet-n9", "identity-lm"):
        torch.testing.assert_close(forward().sum(0), (jacobian * direction).sum((1, 2, 3)), rtol=1e-4, atol=1e-6)
    else:
        with pytest.raises(NotImplementedError, match="jvp"):
            forward()


def test_views_keep_the_noise_and_the_hypotheses_of_a_set_network(make_problems):
    """More views of a network that estimates noise and gives several poses do not solve fewer problems."""
    p = make_problems(batch=1000, outliers=3, dtype=torch.float32)
    one, three = (create_solver("pnpnet-set", views=views)(*p[:3]) for views in (1, 3))
    rates = [success(pose_errors(result.pose, p.pose)).float().mean() for result in (one, three)]
    assert rates[1] > rates[0] - 0.02
    assert three.ok.float().mean() > 0.99
