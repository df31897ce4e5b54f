"""What the laws of ``laws.py`` do not say of solvers: effort, confidence, gradients, given poses, saving and views."""

import math
import os
import re
from functools import partial

import numpy as np
import pytest
import torch
from helpers import assert_same, rate
from kornia.core.exceptions import BaseError, ValueCheckError
from laws import PEERS
from safetensors.torch import save_file
from torch.utils.data import DataLoader, default_collate

import kornia_pnpnet as k
from kornia_pnpnet import MLPInit, Normalize, PnPNet, Pose, RobustWeightedLM, Status, create_solver
from kornia_pnpnet.cameras import bearings
from kornia_pnpnet.core.trees import iter_tensors
from kornia_pnpnet.data import OutlierMix, SlabPoints, SyntheticProblems
from kornia_pnpnet.losses import pose_distances
from kornia_pnpnet.propose.epnp import EPnP

STARTED = "p3p-ransac", "ransac-epnp-lm", "epnp", "reppnp", "epnp-lm", "pnpnet-set", "pnpnet-n9"
NAMES = "identity-lm", "p3p-ransac", "pnpnet-n9", "poselib"
WRONG = [("pnpnet-nine", {}, r"pnpnet-nine.*identity-lm"), (["epnp"], {}, "epnp"), (None, {}, "None")]
WRONG += [("pnpnet-n9", {"m": -1}, "m must")]
WRONG += [(name, {"iterations": 3}, r"options: got .* 'iterations'\.$") for name in NAMES]
CONFIGS = {"six": {"init": {"name": "MLPInit", "n": "six"}}, "Oracle": {"init": {"name": "Oracle"}}}
CONFIGS |= {"refine": {"refine": None}, "tukey": {"refine": {"kernel": "tukey"}}, "colour": {"colour": "red"}}


def hard_problems(count=30):
    options = {"points": SlabPoints(), "outliers": OutlierMix(count=180), "world_sigma": 0.01}
    return SyntheticProblems(n=200, batch_size=count, seed=5, **options).batch(0)


def test_adaptive_effort_finds_poses_among_nine_tenths_of_outliers():
    problems, rates = hard_problems(), {}
    for effort in ("fixed", "adaptive"):
        with torch.no_grad():
            result = create_solver("pnpnet-set", effort=effort)(*problems[:3])
        rates[effort] = rate(result, problems, max_translation=0.5)
        again = create_solver("pnpnet-set", effort=effort)(*problems[:3])  # deterministic, with gradients, too
        assert torch.allclose(again.translation, result.translation, rtol=1e-4, atol=1e-4)
    assert rates["adaptive"] > max(0.95, rates["fixed"] + 0.05), rates


@pytest.mark.filterwarnings("ignore:There is a performance drop")  # of vmap, without a rule for addcmul
def test_effort_is_adaptive_in_inference_and_fixed_in_training_and_in_graphs():
    inputs = hard_problems(4)[:3]
    solvers = [create_solver("pnpnet-set", effort=effort) for effort in ("fixed", "adaptive", None)]
    fixed, adaptive, default = (solver(*inputs).translation for solver in solvers)
    assert not torch.allclose(fixed, adaptive, rtol=1e-3)
    assert torch.equal(default, adaptive)
    assert torch.equal(solvers[2].train()(*inputs).translation, fixed)
    inputs = SyntheticProblems(n=20, batch_size=3, seed=1).batch(0)[:3]
    mapped = torch.func.vmap(lambda *x: solvers[1](*x).translation)(*inputs)
    assert torch.allclose(mapped, solvers[0](*inputs).translation, rtol=1e-4, atol=1e-4)
    for_one = torch.func.vmap(lambda x: solvers[1](inputs[0][:1], x[None], inputs[2][:1]).translation[0])(inputs[1][:1])
    assert torch.allclose(for_one, mapped[:1], rtol=1e-4, atol=1e-4)
    mapped = torch.func.vmap(lambda *x: solvers[0](*x).covariance(*x, img_sigma=1.0))(*inputs)
    expected = solvers[0](*inputs).covariance(*inputs, img_sigma=np.float32(1.0))
    torch.testing.assert_close(mapped, expected, rtol=1e-2, atol=0.0)
    additive = PnPNet(solvers[0].init, RobustWeightedLM(2, update="additive"), effort="fixed").eval()
    mapped = torch.func.vmap(lambda *x: additive(*x).translation)(*inputs)
    torch.testing.assert_close(mapped, additive(*inputs).translation, rtol=1e-4, atol=1e-4)
    assert PnPNet(k.SetInit(starts=1, samples=0)).eval()(*inputs).ok.all()


def test_a_network_may_see_the_confidence(make_problems, generator):
    p = make_problems(12)
    confidence = torch.sigmoid(1.4 * p.inliers + torch.randn(7, 12, generator=generator)).requires_grad_()
    blind, seeing = (PnPNet(k.SetInit(confidence=sees), normalize=Normalize(order=False)) for sees in (False, True))

    def weights(solver, confidence):
        return solver.with_starts(*p[:3], confidence=confidence)[1].weights

    assert torch.equal(weights(blind, None), weights(blind, confidence))
    assert not torch.equal(weights(seeing, None), weights(seeing, confidence))
    (gradient,) = torch.autograd.grad(weights(seeing, confidence).sum(), confidence)
    assert gradient.isfinite().all()
    assert gradient.any()


def test_fitted_confidences_find_poses_among_many_outliers(generator):
    """Scores as ratios of the distances to the nearest and the second nearest descriptor: lower is better."""
    problems = SyntheticProblems(n=100, batch_size=60, seed=2, world_sigma=0.0, outliers=OutlierMix(count=88)).batch(0)
    uniform = torch.rand(problems.inliers.shape, generator=generator)
    scores = torch.where(problems.inliers, 0.45 + 0.55 * uniform, 1.0 - 0.4 * uniform**2)
    # Densities of the scores of 12 inliers, from 0.45 to 1, and of 88 outliers, from 0.6 to 1.
    inlier = torch.full_like(scores, 12.0 / 0.55)
    outlier = torch.where(scores > 0.6, 88.0 / 0.8 / ((1.0 - scores) / 0.4).clamp(min=1e-3).sqrt(), 0.0)
    confidences = {"none": None, "raw": 1.0 - scores, "fitted": (inlier / (inlier + outlier)).clamp(0.01, 0.99)}
    solver, rates = create_solver("p3p-ransac", max_samples=300), {}
    for name, confidence in confidences.items():
        rates[name] = rate(solver(*problems[:3], confidence=confidence), problems, max_translation=0.5)
    assert rates["fitted"] > rates["none"] + 0.15, rates
    assert rates["fitted"] > rates["raw"] + 0.05, rates


@pytest.mark.parametrize("power", [0.0, 1.5, 3.0])
def test_confidence_is_at_least_as_good_as_weights_made_of_it(power, generator):
    """Keypoints as a network finds them: less accurate (``power``) and more often wrong where it is less confident."""
    problems = SyntheticProblems(n=11, batch_size=500, seed=31, img_sigma=0.0, world_sigma=0.0).batch(0)
    confidence = torch.rand(500, 11, generator=generator) ** 0.4
    noise = torch.randn(2, 500, 11, 2, generator=generator)
    pixels = problems.img_points + confidence.clamp(min=0.05)[..., None] ** -power * noise[0]
    elsewhere = problems.img_points.roll(1, 1) + 50.0 * noise[1]
    inliers = torch.rand(500, 11, generator=generator) < 0.98 * confidence.sqrt()
    pixels = torch.where(inliers[..., None], pixels, elsewhere)
    errors = {}
    for name, values in {"confidence": confidence, "weights": confidence**6, "mask": inliers | True}.items():
        found = create_solver("pnpnet-set")(problems[0], pixels, problems[2], **{name: values})
        errors[name] = k.pose_errors(found.pose, problems.pose).rotation_error_deg.clamp(max=10.0).mean()
    assert errors["confidence"] < errors["weights"]
    assert errors["confidence"] < 1.02 * errors["mask"]


@pytest.mark.parametrize("name", ["pnpnet-set", "epnp-lm", "pnpnet-n9"])
def test_a_pose_that_is_not_ok_carries_a_gradient_on_request(name, make_problems, generator):
    p, found = make_problems(), []
    p.img_points[3:] = 2000.0 * torch.rand(4, 9, 2, generator=generator, dtype=torch.float64)
    solver, always = create_solver(name), create_solver(name, gradient="always")
    for run, options in ((solver, {}), (solver, {"gradient": "always"}), (always, {})):
        leaf = p.img_points.clone().requires_grad_()
        result = run(p.world_points, leaf, p.intrinsics, **options)
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


@pytest.mark.parametrize("name", ["pnpnet-set", "epnp-lm"])
def test_a_step_against_the_gradient_lowers_the_loss_of_problems_that_are_not_ok(name, generator):
    p = SyntheticProblems(n=12, batch_size=128, seed=1, world_sigma=0.0, img_sigma=0.0).batch(0)
    solver = create_solver(name, effort="fixed", gradient="always")
    pixels = (p.img_points + 200.0 * torch.randn(p.img_points.shape, generator=generator)).requires_grad_()

    def losses(img_points):
        result = solver(p.world_points, img_points, p.intrinsics)
        assert result.ok.float().mean() < 0.1
        rotation, translation = pose_distances(result.pose, p.pose)
        return rotation + translation / p.pose.translation.norm(dim=1)

    confidence = torch.full((128, 12), 0.5).requires_grad_()
    found = solver(p.world_points, pixels.detach(), p.intrinsics, confidence=confidence)
    if name == "pnpnet-set":  # the only solver whose network sees confidences
        (gradient,) = torch.autograd.grad(1e9 * found.translation.sum(), confidence)
        assert (gradient.norm(dim=1) < 11.0).all()
    before = losses(pixels)
    (gradient,) = torch.autograd.grad(before.sum(), pixels)
    step = 0.1 * gradient / gradient.flatten(1).norm(dim=1)[:, None, None]  # pixels
    with torch.no_grad():
        assert (losses(pixels - step) < before).float().mean() > 0.95


@pytest.mark.filterwarnings("error:No problem of the first 8 batches")  # pyproject.toml ignores it in other tests
def test_a_training_without_a_gradient_warns_once(make_problems, generator):
    p = make_problems()
    wrong = (2000.0 * torch.rand(p.img_points.shape, generator=generator, dtype=torch.float64)).requires_grad_()
    right = p.img_points.clone().requires_grad_()
    solver = create_solver("pnpnet-set", effort="fixed")
    calls = (wrong, {"gradient": "always"}), (wrong, {"first_stage_only": True}), (wrong.detach(), {})
    for pixels, options in (*(call for call in calls for _ in range(10)), *[(wrong, {})] * 7):
        solver(p.world_points, pixels, p.intrinsics, **options)
    with pytest.warns(RuntimeWarning, match="monte_carlo_pose_loss"):
        solver(p.world_points, wrong, p.intrinsics)
    solver(p.world_points, wrong, p.intrinsics)
    solver = create_solver("pnpnet-set", effort="fixed")
    for pixels in (wrong, right, *[wrong] * 8):
        solver(p.world_points, pixels, p.intrinsics)
    solver, rays = create_solver("pnpnet-set", effort="fixed"), bearings(wrong.detach(), p.intrinsics)
    for _ in range(7):
        solver(p.world_points, rays.requires_grad_(), p.intrinsics)
    with pytest.warns(RuntimeWarning, match="monte_carlo_pose_loss"):
        solver(p.world_points, rays, p.intrinsics)


@pytest.mark.parametrize("name", STARTED)
def test_a_given_pose_helps_and_does_no_harm(name, make_problems, perturb):
    p = make_problems(noise=False)
    far = Pose(p.pose.rotation.flip(0), -3.0 * p.pose.translation)
    solver = create_solver(name)
    assert_same(solver(*p[:3], init=far).matrix, p.pose.matrix, atol=1e-2)
    close = perturb(p.pose, angle=1e-3, shift=1e-2)
    result = solver(*p[:3], init=close)
    assert (result.matrix - p.pose.matrix).norm() < 0.1 * (close.matrix - p.pose.matrix).norm()


@pytest.mark.parametrize(("name", "options"), [("p3p-ransac", {"max_samples": 1}), ("epnp-lm", {}), ("pnpnet-n9", {})])
def test_a_given_pose_competes_with_those_of_the_initialiser(name, options, make_problems, perturb):
    p = make_problems(batch=100, outliers=3, noise=False, max_angle=math.pi)
    near, solver = perturb(p.pose, angle=1e-4, shift=1e-3), create_solver(name, **options)
    alone, given = (rate(solver(*p[:3], init=x), p) for x in (None, near))
    assert given > alone + 0.2


def test_a_given_pose_competes_even_if_the_pairs_are_too_few_for_a_sample(make_problems):
    p = make_problems(batch=20, noise=False)
    given = {"mask": (torch.arange(9) < 5).expand(20, 9), "init": p.pose}
    assert_same(create_solver("ransac-epnp-lm")(*p[:3], **given).matrix, p.pose.matrix, atol=1e-5)


@pytest.mark.parametrize("focal", ["known", "unknown"])
@pytest.mark.parametrize("name", ["pnpnet-set", "p3p-ransac"])
def test_a_pair_is_left_out_if_its_confidence_is_no_probability(name, focal, make_problems, generator):
    p, solver = make_problems(12), create_solver(name, focal=focal)
    confidence = torch.rand(7, 12, generator=generator, dtype=torch.float64)
    weights = torch.ones_like(confidence)

    def solved(value, weight=1.0):
        changed, weighed = confidence.clone(), weights.clone()
        changed[:, 3], weighed[:, 3] = value, weight
        return solver(*p[:3], weighed, confidence=changed)

    for rounded, value in ((1.0005, 1.0), (-0.0005, 0.0)):
        assert_same(solved(rounded), solved(value))
    for impossible in (1.1, -0.1, 95.0, torch.inf):
        assert_same(solved(impossible), solved(0.5, weight=0.0))
    percent = torch.where(weights.cumsum(1) < 3, confidence, 95.0)
    assert (solver(*p[:3], confidence=percent).status == Status.CONFIDENCE).all()


def test_a_given_matrix_becomes_the_nearest_rotation(make_problems, generator):
    p, solver = make_problems(), PnPNet(None)
    changed = 1.02 * p.pose.rotation + 0.01 * torch.randn(7, 3, 3, generator=generator)
    left, _, right = torch.linalg.svd(changed)
    given, nearest = (Pose(x, p.pose.translation) for x in (changed, left @ right))
    known = torch.eye(6).double().expand(7, 6, 6)
    for option in (lambda x: {"init": x}, lambda x: {"prior": k.PosePrior(x, known)}):
        found, expected = (solver(*p[:3], **option(x)) for x in (given, nearest))
        assert found.ok.all()
        assert_same(found.pose, expected.pose, 1e-9, 1e-9)
        assert_same(found.init, nearest, 1e-9, 1e-9)


@pytest.mark.parametrize("factor", [-1.0, 0.0, torch.nan])
def test_a_given_matrix_that_is_no_rotation_is_ignored(factor, make_problems):
    p = make_problems()
    given = Pose(factor * p.pose.rotation, p.pose.translation)
    assert_same(*(create_solver("epnp-lm")(*p[:3], init=x).pose for x in (given, None)), 1e-6, 1e-6)
    assert (create_solver("identity-lm", m=0)(*p[:3], init=given).status == Status.INIT).all()


def test_more_views_solve_more(make_problems):
    p, rates = make_problems(batch=400), []
    for views in (1, 2, 8):
        torch.manual_seed(3)
        rates.append(rate(PnPNet(MLPInit(9), RobustWeightedLM(10), views=views).double().eval()(*p[:3]), p))
    assert rates[0] + 0.03 < rates[1] < rates[2] - 0.1


def saved_net():
    refine = RobustWeightedLM(m=2, kernel="cauchy", shared=True, update="additive", reject_worse=True)
    solver = PnPNet(MLPInit(6, world_scale=2000), refine, Normalize(center=False), views=3)
    with torch.no_grad():
        for parameter in solver.parameters():
            parameter.add_(0.01 * torch.randn_like(parameter))
    return solver


SAVED = [saved_net, lambda: PnPNet(None, RobustWeightedLM(m=2, step=np.float32(0.9)), gradient="always")]
SAVED += [lambda: PnPNet(EPnP(algebraic_weight=2000), RobustWeightedLM(m=2))]
SAVED += [lambda: create_solver("epnp-lm", m=2, focal="unknown", focal_sigma=np.float32(0.1), radial=1)]
SAVED += [lambda: create_solver("pnpnet-set", effort="fixed", views=2)]
SAVED += [type("Sub", (PnPNet,), {"__init__": lambda self, *a, **x: PnPNet.__init__(self, *a, **x)})]  # noqa: PLW0108


@pytest.mark.parametrize("solver", SAVED)
def test_saving_and_loading_keeps_every_option_and_every_bit(solver, tmp_path, make_problems):
    solver, p = solver().eval(), make_problems(6)
    solver.refine.backward = "implicit"
    solver.save_pretrained(tmp_path / "deep" / "folder")
    again = PnPNet.from_pretrained(str(tmp_path / "deep" / "folder"))
    assert again.config() == solver.config() == solver.with_options().config()
    assert again.options == solver.options
    assert again.refine.backward == again.refine.with_iterations(9).backward == "implicit"
    assert not again.training
    assert_same(again(*p[:3]), solver(*p[:3]))
    solver.compile()
    assert solver.with_options()._run.compiled
    solver.train().refine.eval()
    solver.with_options(gradient="always")
    assert (solver.training, solver.refine.training) == (True, False)


@pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning")
@pytest.mark.parametrize("name", ["pnpnet-set", "pnpnet-n9"])
def test_vmap_over_parameters_has_the_fixed_effort(name, make_problems):
    p, solver = make_problems(9, 4, outliers=3), create_solver(name)
    parameters, _ = torch.func.stack_module_state([solver, solver])
    solve = partial(torch.func.functional_call, solver, args=tuple(p[:3]))
    found = torch.func.vmap(lambda x: solve(x).translation)(parameters)
    expected = create_solver(name, effort="fixed")(*p[:3]).translation
    torch.testing.assert_close(found, torch.stack((expected, expected)), rtol=1e-4, atol=1e-4)


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")  # PyTorch's own use of it in forward mode
def test_a_transform_over_one_argument_keeps_the_gradient_of_another(make_problems):
    p, solver = make_problems(9, 4), create_solver("epnp")
    world = p.world_points.requires_grad_()
    alone = solver(world, *p[1:3]).translation
    primal, _ = torch.func.jvp(lambda x: solver(world, x, p.intrinsics).translation, (p.img_points,), (p.img_points,))
    assert_same(*(torch.autograd.grad(x.sum(), world) for x in (alone, primal)), rtol=1e-9, atol=1e-9)


#: What a random damage, of which ``test_interruptions.py`` tries many, does not do.
DAMAGES = [
    lambda config, weights: torch.save({"a": torch.zeros(1)}, weights),
    lambda config, weights: weights.unlink(),
    lambda config, weights: save_file({"linear.weight": torch.zeros(2, 2)}, weights),
    lambda config, weights: weights.unlink() or os.mkfifo(weights),
    *(lambda config, _, text=x: config.write_text(text) for x in ("[1, 2]", '{"init": []}', "[" * 10**5, " " * 2**21)),
    lambda config, weights: config.write_text(config.read_text().replace("cauchy", "huber")),  # of other weights
]


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_weights_raise_a_typed_error(damage, tmp_path):
    saved_net().save_pretrained(tmp_path)
    damage(tmp_path / "config.json", tmp_path / "model.safetensors")
    with pytest.raises(ValueCheckError, match=r"\S"):
        PnPNet.from_pretrained(tmp_path)


def test_an_initialiser_of_ones_own(make_problems, tmp_path):
    class Identity(torch.nn.Module):
        def forward(self, problem):
            eye = torch.eye(3).to(problem.weights).expand(7, 3, 3)
            return k.Starts(Pose(eye, torch.zeros_like(eye[:, 0])), torch.ones_like(problem.weights))

    solver = PnPNet(Identity(), RobustWeightedLM(m=2))
    assert solver(*make_problems()[:3]).matrix.shape == (7, 4, 4)
    with pytest.raises(ValueCheckError, match="Identity cannot be saved"):
        solver.save_pretrained(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("name", "options", "message"), [*WRONG, *(("config", CONFIGS[x], x) for x in CONFIGS)])
def test_solvers_that_there_are_not_raise_an_error_that_names_what_is_wrong(name, options, message):
    with pytest.raises(BaseError, match=message):
        PnPNet.from_config({**saved_net().config(), **options}) if name == "config" else create_solver(name, **options)


def _solve_each(solver, problems, places):
    return default_collate([solver(*(x[i] for x in problems[:3])) for i in places])


@pytest.mark.parametrize("name", ["pnpnet-set", "pnpnet-n9", "epnp-lm", "identity-lm"])
def test_a_data_loader_returns_results_and_loaded_weights_can_be_trained(name):
    solve = partial(_solve_each, create_solver(name), SyntheticProblems(n=9, batch_size=4, seed=0).batch(0))
    assert next(iter(DataLoader(range(4), batch_size=4, num_workers=1, collate_fn=solve))).rotation.shape == (4, 3, 3)
    if name in k.shipped_weights():
        assert all(x.requires_grad for x in PnPNet.from_pretrained(name).parameters())


@pytest.mark.parametrize("name", ["pnpnet-set", "p3p-ransac"])
def test_results_without_gradients_can_be_used_where_gradients_are_recorded(name):
    solver, inputs = create_solver(name), SyntheticProblems(n=9, batch_size=40, seed=0).batch(0)[:3]
    result = solver(*inputs)
    assert not any(x.is_inference() for x in iter_tensors((result, result.covariance(*inputs))))
    pixels = inputs[1].clone().requires_grad_()
    recorded = solver(inputs[0], pixels, inputs[2])  # what the first call cached serves this call, too
    (recorded.translation * result.translation).sum().backward()
    assert pixels.grad.abs().amax((1, 2))[result.ok].min() > 0
    assert torch.allclose(recorded.translation, result.translation, rtol=1e-4, atol=1e-4)
    with torch.inference_mode():
        assert solver(*inputs).translation.is_inference()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("name", ["pnpnet-set", "pnpnet-n9", "epnp-lm", "reppnp-lm", "p3p-ransac"])
def test_solvers_stay_where_their_inputs_are(name, make_problems):
    p = make_problems(dtype=torch.float32).map(lambda x: x.cuda())
    result, starts = create_solver(name).cuda().with_starts(*p[:3])
    assert {x.device.type for x in iter_tensors((result, starts.weights))} == {"cuda"}


@pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning")
@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")  # PyTorch's own use of it in forward mode
@pytest.mark.parametrize("name", [x for x in k.list_solvers() if x not in PEERS])
def test_transforms_of_every_solver_of_ours(name, generator):
    """First derivatives against ``backward``, second against central differences of it, ``vmap`` against a loop."""
    # Pixels move along three directions. Where the pose is found from a start that is a constant, derivatives leave out
    # what the start would change, which the last iterations nearly forget: hence the tolerance of second derivatives.
    number = re.search(r"-n(\d+)", name)
    chosen = {"m": 2} if name.endswith("-lm") or "pnpnet-n" in name else {}
    chosen |= {"pnpnet-set": {"m": 8, "effort": "fixed"}, "ransac-epnp-lm": {"max_samples": 20}}.get(name, {})
    p = SyntheticProblems(n=int(number[1]) if number else 8, batch_size=2, seed=3, dtype=torch.float64).batch(0)
    solver = create_solver(name, **chosen).double()
    directions = torch.randn(3, *p.img_points.shape, generator=generator).double()
    mixture = torch.randn(24, generator=generator).double()

    def outputs(world_points, img_points, intrinsics):
        result = solver(world_points, img_points, intrinsics)
        return torch.cat([x.flatten(-2) if x.shape[-2:] == (3, 3) else x for x in (*result.pose, *result.init)], -1)

    def moved(shift):
        return outputs(p.world_points, p.img_points + (shift[:, None, None, None] * directions).sum(0), p.intrinsics)

    def loss(shift):
        return (moved(shift) @ mixture).sum()

    def gradient(shift):
        leaf = shift.clone().requires_grad_()
        return torch.autograd.grad(loss(leaf), leaf)[0]

    zero, steps = torch.zeros(3).double(), 1e-3 * torch.eye(3).double()
    first = gradient(zero)
    second = torch.stack([(gradient(step) - gradient(-step)) / 2e-3 for step in steps])
    assert first.all()
    assert second.any()

    def close(found, expected, tolerance):
        assert (found - expected).norm() <= tolerance * expected.norm()

    close(torch.func.grad(loss)(zero), first, 1e-7)
    close(torch.einsum("boi,o->i", torch.func.jacrev(moved)(zero), mixture), first, 1e-7)
    close(torch.func.jvp(loss, (zero,), (steps[0],))[1], 1e-3 * first[0], 1e-3)
    close(torch.func.jacfwd(loss)(zero), first, 1e-3)
    if name != "pnpnet-set":  # its mixture of residuals is a constant of the gradient
        for hessian in (torch.func.hessian(loss), torch.func.jacrev(torch.func.jacrev(loss))):
            close(hessian(zero), second, 2e-3)
        close(torch.autograd.functional.hessian(loss, zero), second, 2e-3)

    def each(img_points, world_points, intrinsics):
        return outputs(world_points, img_points, intrinsics) @ mixture

    problems = p.img_points, p.world_points, p.intrinsics
    if "ransac" in name:
        with pytest.raises(NotImplementedError, match="vmap"):
            torch.func.vmap(each)(*problems)
        return
    close(torch.func.vmap(each)(*problems), torch.stack([each(*x) for x in zip(*problems, strict=True)]), 1e-7)
    by_problem = torch.func.vmap(torch.func.grad(each))(*problems)
    leaves = [problems[0].clone().requires_grad_(), *problems[1:]]
    close(torch.autograd.grad(torch.func.vmap(each)(*leaves).sum(), leaves[0])[0], by_problem, 1e-7)
    close((by_problem * directions).flatten(1).sum(1), first, 1e-6)
