"""The contract of the layer: what goes in, what comes out, what goes wrong and what that costs the others."""

from __future__ import annotations

import copy
import math
import pickle
from functools import partial

import pytest
import torch
from kornia.core.exceptions import BaseError, ShapeError, TypeCheckError, ValueCheckError
from safetensors.torch import save_file
from torch.utils import _pytree as pytree

from kornia_pnpnet import (
    MLPInit,
    Normalize,
    PnPNet,
    Pose,
    RobustWeightedLM,
    SetInit,
    Starts,
    create_solver,
    list_solvers,
    pose_errors,
    solve_pnp,
)
from kornia_pnpnet.data import OutlierMix, SlabPoints, SyntheticProblems
from kornia_pnpnet.metrics import success

DTYPES = (torch.float32, torch.float64)


def net(n=9, m=3, **options):
    return PnPNet(MLPInit(n), RobustWeightedLM(m=m, **options))


def assert_same(one, two, rtol=0.0, atol=0.0):
    for a, b in zip(pytree.tree_leaves(one), pytree.tree_leaves(two), strict=True):
        torch.testing.assert_close(a, b, rtol=rtol, atol=atol)


def only(index, tree):
    """Some problems of a batch."""
    return pytree.tree_map(lambda x: x[index], tree)


# --- errors -----------------------------------------------------------------------------------------------------------


def bad_calls(p):
    world, pixels, K = p.world_points, p.img_points, p.intrinsics
    ones, mask = torch.ones(7, 9, dtype=torch.float64), torch.ones(7, 9, dtype=torch.bool)
    return {
        "world_2d": ((world[0], pixels, K), {}, ShapeError, r"img_points.*\(9, 2\)"),
        "world_of_4": ((torch.cat((world, world[..., :1]), -1), pixels, K), {}, ShapeError, r"4"),
        "pixels_of_4": ((world, torch.cat((pixels, pixels), -1), K), {}, ShapeError, r"img_points.*\(7, 9, 4\)"),
        "other_batch": ((world, pixels[:6], K), {}, ShapeError, r"img_points.*\(7, 9, 2\).*\(6, 9, 2\)"),
        "other_n": ((world, pixels[:, :8], K), {}, ShapeError, r"img_points.*\(7, 9, 2\).*\(7, 8, 2\)"),
        "K_of_other_batch": ((world, pixels, K[:6]), {}, ShapeError, r"intrinsics.*\(7, 3, 3\).*\(6, 3, 3\)"),
        "weights": ((world, pixels, K), {"weights": ones[:, :8]}, ShapeError, r"weights.*\(7, 9\).*\(7, 8\)"),
        "mask": ((world, pixels, K), {"mask": mask[:1]}, ShapeError, r"mask.*\(7, 9\).*\(1, 9\)"),
        "two_pairs": ((world[:, :2], pixels[:, :2], K), {}, ShapeError, r"3 pairs.*2"),
        "weights_of_u_and_v": ((world, pixels, K), {"weights": pixels}, ShapeError, r"weights.*\(7, 9\).*\(7, 9, 2\)"),
        "list_of_weights": ((world, pixels, K), {"weights": ones.tolist()}, TypeCheckError, r"weights.*list"),
        "bool_weights": ((world, pixels, K), {"weights": mask}, TypeCheckError, r"weights.*bool"),
        "complex": ((world, pixels * 1j, K), {}, TypeCheckError, r"img_points.*complex128"),
        "float_mask": ((world, pixels, K), {"mask": ones}, TypeCheckError, r"mask.*bool.*float64"),
        "init": ((world, pixels, K), {"init": Pose(p.pose.rotation[:6], p.pose.translation)}, ShapeError, r"6"),
        "init_bool": ((world, pixels, K), {"init": Pose(*(x > 0 for x in p.pose))}, TypeCheckError, r"init rot"),
        "list": ((world.tolist(), pixels, K), {}, TypeCheckError, r"world_points.*list"),
        "sigmas": ((world, pixels, K), {"img_sigma": ones[0]}, ShapeError, r"img_sigma.*\(7, 9\).*\(9,\)"),
        "text_sigma": ((world, pixels, K), {"img_sigma": "1"}, TypeCheckError, r"img_sigma.*str"),
    }


@pytest.mark.parametrize("solver", [net(), PnPNet()], ids=["mlp", "given"])
def test_wrong_inputs_raise_typed_errors_that_name_argument_and_value(solver, make_problems):
    for name, (arguments, options, error, message) in bad_calls(make_problems()).items():
        with pytest.raises(error, match=f"(?s){message}") as raised:
            solver(*arguments, **options)
        assert isinstance(raised.value, BaseError), name
    with pytest.raises(ShapeError, match=r"(?s)n = 9.*N = 10"):
        net(9)(*make_problems(10)[:3])


# --- bad problems among good ones -------------------------------------------------------------------------------------


def turn_away(p, i):
    """What a camera would see through its back: true depths negative, pixels by the same formula."""
    cam = p.world_points[i] @ p.pose.rotation[i].mT + p.pose.translation[i]
    cam = cam * torch.tensor([1.0, 1, -1]).to(cam)
    world = (cam - p.pose.translation[i]) @ p.pose.rotation[i]
    return world, p.intrinsics[i, 0, 0] * cam[:, :2] / cam[:, 2:]


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_batch_of_bad_problems_gives_identities(dtype, make_problems):
    p = make_problems(9, 4, dtype=dtype)
    result = net()(torch.full_like(p.world_points, math.nan), p.img_points, p.intrinsics)
    assert not result.ok.any()
    assert torch.equal(result.rotation, torch.eye(3, dtype=dtype).expand(4, 3, 3))
    assert not result.weights.any()
    assert result.cost.sum().isfinite()


def test_everything_behind_the_true_pose_is_not_ok(make_problems):
    p = make_problems(9, 200)
    seen = [turn_away(p, i) for i in range(200)]
    world, pixels = (torch.stack(x) for x in zip(*seen, strict=True))
    result = PnPNet()(world, pixels, p.intrinsics, init=p.pose)
    assert not result.ok.any()
    assert_same(result.pose, p.pose, rtol=1e-12, atol=1e-12)  # there is no way from there


# --- effort -------------------------------------------------------------------------------------------------------


def hard_problems(count=30):
    mix = OutlierMix(count=180)
    points = SlabPoints()
    return SyntheticProblems(n=200, batch_size=count, seed=5, points=points, outliers=mix, world_sigma=0.01).batch(0)


def test_adaptive_effort_finds_poses_among_nine_tenths_of_outliers():
    problems = hard_problems()
    rates = {}
    for effort in ("fixed", "adaptive"):
        solver = create_solver("pnpnet-set", effort=effort)
        with torch.no_grad():
            result = solver(*problems[:3])
        errors = pose_errors(result.pose, problems.pose)
        rates[effort] = success(errors, max_translation=0.5).double().mean().item()
        again = create_solver("pnpnet-set", effort=effort)(*problems[:3])  # deterministic, with gradients, too
        assert torch.allclose(again.translation, result.translation, rtol=1e-4, atol=1e-4)
    assert rates["adaptive"] > max(0.95, rates["fixed"] + 0.05), rates


def test_effort_is_adaptive_in_inference_and_fixed_in_training():
    world, pixels, camera = hard_problems(4)[:3]
    solvers = [create_solver("pnpnet-set", effort=effort) for effort in ("fixed", "adaptive", None)]
    fixed, adaptive = (solver(world, pixels, camera).translation for solver in solvers[:2])
    assert not torch.allclose(fixed, adaptive, rtol=1e-3)
    solver = solvers[2]
    assert torch.equal(solver(world, pixels, camera).translation, adaptive)
    assert torch.equal(solver.train()(world, pixels, camera).translation, fixed)


@pytest.mark.filterwarnings("ignore:There is a performance drop")  # of vmap, without a rule for addcmul
def test_adaptive_effort_in_graphs_and_without_noise():
    problems = SyntheticProblems(n=20, batch_size=3, seed=1).batch(0)
    fixed, adaptive = (create_solver("pnpnet-set", effort=effort) for effort in ("fixed", "adaptive"))
    expected = fixed(*problems[:3]).translation
    mapped = torch.func.vmap(lambda *x: adaptive(*x).translation)(*problems[:3])
    assert torch.allclose(mapped, expected, rtol=1e-4, atol=1e-4)
    for name, effort in (("epnp-lm", "adaptive"), ("pnpnet-set", "much")):
        with pytest.raises(BaseError, match="effort"):
            create_solver(name, effort=effort)


# --- confidence ---------------------------------------------------------------------------------------------------


def believed(problems, generator):
    """A confidence that tells little of a single pair: an inlier's is larger than an outlier's in 84 of 100 cases."""
    noise = torch.randn(problems.inliers.shape, generator=generator)
    return torch.sigmoid(1.4 * problems.inliers + noise)


def test_confidence_guides_the_samples(generator):
    problems = hard_problems(100)
    confidence = believed(problems, generator)
    solver = create_solver("p3p-ransac", max_samples=300, threshold=8.0)
    rates = []
    with torch.no_grad():
        for given in (None, confidence):
            errors = pose_errors(solver(*problems[:3], confidence=given).pose, problems.pose)
            rates.append(success(errors, max_translation=0.5).double().mean().item())
    assert rates[1] > rates[0] + 0.1, rates


def test_a_network_may_see_the_confidence(make_problems, generator):
    problems = make_problems(12)
    confidence = believed(problems, generator).requires_grad_()
    blind, seeing = (PnPNet(SetInit(confidence=sees), normalize=Normalize(order=False)) for sees in (False, True))
    result, guess = seeing.with_starts(*problems[:3], confidence=confidence)
    (gradient,) = torch.autograd.grad(guess.weights.sum(), confidence)
    assert gradient.isfinite().all()
    assert gradient.any()
    order = torch.randperm(12, generator=generator)
    shuffled = seeing(problems[0][:, order], problems[1][:, order], problems[2], confidence=confidence[:, order])
    assert torch.allclose(shuffled.translation, result.translation, rtol=1e-6, atol=1e-6)
    assert not torch.equal(seeing.with_starts(*problems[:3])[1].weights, guess.weights)
    same = [blind.with_starts(*problems[:3], confidence=c)[1].weights for c in (None, confidence)]
    assert torch.equal(*same)


# --- compile, export, autocast, copies --------------------------------------------------------------------------------


@pytest.mark.parametrize("cast_dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("name", ["pnpnet-n9", "epnp-lm"])
def test_autocast_around_the_layer_changes_no_bit(name, cast_dtype, make_problems):
    """Neither of the results nor of the gradients."""
    outcomes = []
    for enabled in (False, True):
        world, pixels, K = (x.requires_grad_() for x in make_problems(dtype=torch.float32)[:3])
        solver = create_solver(name)
        with torch.autocast("cpu", dtype=cast_dtype, enabled=enabled):
            result = solver(world, pixels, K)
            loss = result.init.translation.sum() + result.translation.sum() + result.cost.sum()
        loss.backward()
        gradients = [x.grad for x in (world, pixels, K, *solver.parameters())]
        outcomes.append((*pytree.tree_leaves(result), *gradients))
    for plain, cast in zip(*outcomes, strict=True):
        assert plain is cast is None or torch.equal(plain, cast)


def test_copies_and_dtypes_of_the_module(make_problems):
    p = make_problems()
    solver = net()
    expected = solver(*p[:3])
    for copied in (copy.deepcopy(solver), pickle.loads(pickle.dumps(solver))):
        assert_same(copied(*p[:3]), expected)
        with torch.no_grad():
            copied.refine.step.raw.fill_(-1.0)  # a parameter of its own
        assert not torch.equal(copied(*p[:3]).matrix, expected.matrix)
        assert_same(solver(*p[:3]), expected)
    double = copy.deepcopy(solver).double()
    assert {x.dtype for x in double.state_dict().values()} == {torch.float64}
    assert_same(double(*p[:3]).init, expected.init, rtol=1e-4, atol=1e-3)
    assert double(*make_problems(dtype=torch.float32)[:3]).rotation.dtype == torch.float32


# --- a pose by hand ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pnpnet-set", "epnp-lm", "pnpnet-n9"])
def test_a_pose_that_is_not_ok_carries_a_gradient_on_request(name, make_problems, generator):
    p = make_problems()
    pixels = p.img_points.clone()
    pixels[3:] = 2000.0 * torch.rand(4, 9, 2, generator=generator, dtype=torch.float64)
    solver = create_solver(name)
    found = []
    for call in (solver, partial(solver, gradient="always"), create_solver(name, gradient="always")):
        leaf = pixels.clone().requires_grad_()
        result = call(p.world_points, leaf, p.intrinsics)
        (gradient,) = torch.autograd.grad((result.rotation.sum() + result.translation.sum()), leaf)
        assert gradient.isfinite().all()
        found.append((result.ok, gradient.flatten(1).norm(dim=1)))
    (ok, own), *others = found
    assert ok[:3].all()
    assert not ok.all()
    assert not own[~ok].any()
    for same, norms in others:
        assert torch.equal(same, ok)
        assert norms.all()
        assert torch.equal(norms[ok], own[ok])
    with pytest.raises(BaseError, match="gradient must"):
        solver(*p[:3], gradient="never")


@pytest.mark.parametrize("name", ["pnpnet-set", "p3p-ransac", "opencv-ransac", "kornia-rs", "poselib", "pycolmap"])
def test_any_leading_dimensions(name, make_problems):
    p = make_problems(9, 6)
    try:
        solver = create_solver(name)
    except ImportError as error:
        pytest.skip(str(error))
    ours = isinstance(solver, PnPNet)
    options = {"weights": torch.rand(6, 9).double() + 0.5, "mask": torch.arange(9).expand(6, 9) > 0}
    options |= {"init": p.pose, "img_sigma": torch.ones(6).double()} if ours else {}
    batch = solver(*p[:3], **options)
    for shape in ((2, 3), (6, 1, 1)):
        nested = pytree.tree_map(lambda x, shape=shape: x.unflatten(0, shape), (p[:3], options))
        result = solver(*nested[0], **nested[1])
        assert result.matrix.shape == (*shape, 4, 4)
        assert_same(pytree.tree_map(lambda x, shape=shape: x.flatten(0, len(shape) - 1), result), batch)
        cameras = p.pose.camera(p.intrinsics)
        assert_same(solver(*nested[0][:2], cameras, **nested[1]), result)
    one = solver(*(x[2] for x in p[:3]), **{key: only(2, value) for key, value in options.items()})
    assert_same(one, only(2, batch), rtol=1e-6, atol=1e-6)
    if ours:
        sigma = torch.ones(9).double()
        _, guess = solver.with_starts(p.world_points[2], p.img_points[2], p.intrinsics[2], img_sigma=sigma)
        assert guess.weights.shape == (9,)
    with pytest.raises(ShapeError, match=r"weights.*\(2, 3, 9\).*\(6, 9\)"):
        solver(
            p.world_points.unflatten(0, (2, 3)), p.img_points.unflatten(0, (2, 3)), p.intrinsics[0], torch.ones(6, 9)
        )


@pytest.mark.parametrize("name", ["pnpnet-set", "pnpnet-n9", "epnp-lm", "p3p-ransac", "opencv-sqpnp", "pycolmap"])
def test_every_dtype_is_computed_in_float32_or_float64(name, make_problems):
    """Pixels, points and weights that all dtypes can hold, so that every call solves the same problems."""
    p = make_problems(noise=False)
    world, pixels = (100.0 * p.world_points).round(), p.img_points.round()
    inputs = [x.to(torch.bfloat16).double() for x in (world, pixels, p.intrinsics, torch.ones(7, 9))]
    try:
        solver = create_solver(name)
    except ImportError as error:
        pytest.skip(str(error))
    expected = {dtype: solver(*(x.to(dtype) for x in inputs)) for dtype in DTYPES}
    assert expected[torch.float64].ok.double().mean() > 0.7  # pixels are off by up to 8
    narrow = (torch.float16, torch.bfloat16, torch.float32, torch.int32, torch.int64)
    for kinds in (*zip(*[narrow] * 4, strict=True), narrow[:4]):
        leaves = [x.to(kind) for x, kind in zip(inputs, kinds, strict=True)]
        assert_same(solver(*leaves), expected[torch.float32])
        assert_same(solver(leaves[0], inputs[1], *leaves[2:]), expected[torch.float64])
    matrix = solve_pnp(*(x.half() for x in inputs), solver=solver)
    assert matrix.dtype == torch.float32
    if isinstance(solver, PnPNet):
        sigmas = {"img_sigma": torch.ones(7).half(), "world_sigma": 1}
        floats = {"img_sigma": torch.ones(7), "world_sigma": 1.0}
        assert_same(solver(*leaves, **sigmas), solver(*leaves, **floats))


@pytest.mark.parametrize("cast_dtype", [torch.bfloat16, torch.float16])
def test_inputs_of_half_precision_get_gradients_of_half_precision(cast_dtype, make_problems):
    p = make_problems(dtype=torch.float32)
    rounded = [x.to(cast_dtype).float().requires_grad_() for x in p[:3]]
    halves = [x.detach().to(cast_dtype).requires_grad_() for x in rounded]
    for inputs in (rounded, halves):
        with torch.autocast("cpu", dtype=cast_dtype):
            result = create_solver("pnpnet-set")(*inputs)
        assert result.ok.any()
        result.rotation.sum().backward()
    for half, full in zip(halves, rounded, strict=True):
        assert half.grad.dtype == cast_dtype
        assert torch.equal(half.grad, full.grad.to(cast_dtype))


@pytest.mark.parametrize(
    "name", ["p3p-ransac", "ransac-epnp-lm", "epnp", "reppnp", "epnp-lm", "pnpnet-set", "pnpnet-n9"]
)
def test_a_given_pose_helps_and_does_no_harm(name, make_problems, perturb):
    p = make_problems(noise=False)
    far = Pose(p.pose.rotation.flip(0), -3.0 * p.pose.translation)
    solver = create_solver(name)
    assert_same(solver(*p[:3], init=far).matrix, p.pose.matrix, atol=1e-2)
    close = perturb(p.pose, angle=1e-3, shift=1e-2)
    result = solver(*p[:3], init=close)
    assert (result.matrix - p.pose.matrix).norm() < 0.1 * (close.matrix - p.pose.matrix).norm()
    identity = PnPNet(None, RobustWeightedLM(m=0))(*p[:3])  # the guess where there is no other
    torch.testing.assert_close(identity.matrix, torch.eye(4).double().expand(7, 4, 4), rtol=0, atol=1e-12)


# --- weights on disk --------------------------------------------------------------------------------------------------


def saved_net():
    refine = RobustWeightedLM(m=2, kernel="cauchy", shared=True, update="additive", reject_worse=True)
    solver = PnPNet(MLPInit(6, world_scale=2.0), refine, Normalize(center=False), views=3)
    with torch.no_grad():
        for parameter in solver.parameters():
            parameter.add_(0.01 * torch.randn_like(parameter))
    return solver


@pytest.mark.parametrize(
    "solver",
    [
        saved_net,
        lambda: PnPNet(None, RobustWeightedLM(m=2, step=0.9), gradient="always"),
        lambda: create_solver("epnp-lm", m=2, focal="unknown", focal_sigma=0.1, radial=1),
        lambda: create_solver("reppnp-lm", m=2),
        lambda: create_solver("pnpnet-set", effort="fixed", views=2),
    ],
    ids=["net", "identity", "epnp", "reppnp", "set"],
)
def test_saving_and_loading_keeps_every_option_and_every_bit(solver, tmp_path, make_problems):
    solver = solver().eval()
    solver.save_pretrained(tmp_path / "deep" / "folder")
    for where in (tmp_path / "deep" / "folder", str(tmp_path / "deep" / "folder")):
        again = PnPNet.from_pretrained(where)
        assert (again.config(), again.options) == (solver.config(), solver.options)
        assert not again.training
        for dtype in DTYPES:
            p = make_problems(6, dtype=dtype)
            assert_same(again(*p[:3]), solver(*p[:3]))


DAMAGES = {
    "truncated": lambda config, weights: weights.write_bytes(weights.read_bytes()[:-100]),
    "empty": lambda config, weights: weights.write_bytes(b""),
    "pickle": lambda config, weights: torch.save({"a": torch.zeros(1)}, weights),
    "missing": lambda config, weights: weights.unlink(),
    "foreign": lambda config, weights: save_file({"linear.weight": torch.zeros(2, 2)}, weights),
    "not JSON": lambda config, weights: config.write_text("{n: 9"),
    "no dictionary": lambda config, weights: config.write_text("[1, 2]"),
    "not text": lambda config, weights: config.write_bytes(b"\xff\xfe\x00"),
    "another configuration": lambda config, weights: config.write_text(config.read_text().replace("cauchy", "huber")),
}


def test_damaged_weights_raise_a_typed_error(tmp_path):
    for how, damage in DAMAGES.items():
        folder = tmp_path / how
        saved_net().save_pretrained(folder)
        damage(folder / "config.json", folder / "model.safetensors")
        with pytest.raises(ValueCheckError, match=r"\S"):
            PnPNet.from_pretrained(folder)
    sound = saved_net().config()
    wrong = ({"init": {**sound["init"], "n": "six"}}, {"init": {"name": "Oracle"}}, {"refine": None}, {"refine": [1]})
    for change in (*wrong, {"refine": {**sound["refine"], "kernel": "tukey"}}, {"colour": "red"}):
        with pytest.raises(BaseError):
            PnPNet.from_config({**sound, **change})


def test_solvers_by_name(make_problems):
    names = list_solvers()
    assert names == sorted(names)
    solver = create_solver("identity-lm", m=3)
    assert not solver.training
    assert solver(*make_problems()[:3]).matrix.shape == (7, 4, 4)
    with pytest.raises(ValueCheckError, match=r"pnpnet-nine.*identity-lm"):
        create_solver("pnpnet-nine")
    with pytest.raises(ValueCheckError, match="iterations"):
        create_solver("identity-lm", iterations=3)
    for wrong in (["epnp"], None):
        with pytest.raises(ValueCheckError):
            create_solver(wrong)
    with pytest.raises(BaseError, match="m must"):
        create_solver("pnpnet-n9", m=-1)


def test_an_initialiser_of_ones_own(make_problems, tmp_path):
    class Identity(torch.nn.Module):
        def forward(self, corr):
            batch = corr.weights.shape[0]
            eye = torch.eye(3).to(corr.weights).expand(batch, 3, 3)
            return Starts(Pose(eye, corr.weights.new_zeros(batch, 3)), torch.ones_like(corr.weights))

    solver = PnPNet(Identity(), RobustWeightedLM(m=2))
    assert solver(*make_problems()[:3]).matrix.shape == (7, 4, 4)
    assert solver.config()["init"] == {"name": "Identity"}
    with pytest.raises(ValueCheckError, match="Identity cannot be saved"):
        solver.save_pretrained(tmp_path)
    assert list(tmp_path.iterdir()) == []


# --- views ----------------------------------------------------------------------------------------------------------


def test_more_views_solve_more(make_problems):
    """Also for an untrained network: refinement starts from more poses."""
    p, rates = make_problems(batch=400), []
    for views in (1, 2, 8):
        torch.manual_seed(3)
        result = PnPNet(MLPInit(9), RobustWeightedLM(10), views=views).double().eval()(*p[:3])
        rates.append(success(pose_errors(result.pose, p.pose)).double().mean())
    assert rates[0] + 0.03 < rates[1]
    assert rates[1] + 0.1 < rates[2]


# --- known noise --------------------------------------------------------------------------------------------


def test_known_noise_solves_more(make_problems, perturb):
    """From near the truth, with outliers: weights of known noise beat weights of residuals alone."""
    p = make_problems(batch=1000, outliers=3)
    start = perturb(p.pose)
    refine = RobustWeightedLM(10, kernel="geman_mcclure", robustness=6.0, damping=1e-4)
    solver = PnPNet(None, refine)
    plain = PnPNet(None, RobustWeightedLM(10, robustness=1.5, damping=1e-4))
    known = solver(*p[:3], init=start, img_sigma=1.0, world_sigma=0.05)
    rates = [success(pose_errors(r.pose, p.pose)).double().mean() for r in (known, plain(*p[:3], init=start))]
    assert rates[0] > rates[1] + 0.03
    assert known.ok.double().mean() > 0.97
