"""Laws of the robust weighted Levenberg-Marquardt, from given poses; of its kernels, residual and retraction."""

import itertools
import math

import pytest
import torch
from helpers import assert_same, reprojection_errors, verified_derivative
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, rotation_matrix_to_axis_angle

from kornia_pnpnet import Normalize, PnPNet, Pose, RobustWeightedLM, SetInit, create_solver, pose_errors
from kornia_pnpnet.core.symmetric import symmetric
from kornia_pnpnet.data import CameraProblems
from kornia_pnpnet.problem import Problem, State
from kornia_pnpnet.refine.kernels import KERNELS
from kornia_pnpnet.refine.residual import normal_equations, project, retract


def retract_additive(pose, delta):
    """The paper's update, which adds to the rotation vector."""
    vector = rotation_matrix_to_axis_angle(pose.rotation) + delta[:, :3]
    return Pose(axis_angle_to_rotation_matrix(vector), pose.translation + delta[:, 3:])


UPDATES = {"retraction": retract, "additive": retract_additive}
every_kernel = pytest.mark.parametrize("kernel", KERNELS)
every_update = pytest.mark.parametrize("update", UPDATES)


def solver(m=5, **options):
    """A refinement of given poses in the frame of the caller."""
    return PnPNet(None, RobustWeightedLM(m, learnable=False, **options), Normalize(center=False, scale=False))


@every_update
def test_the_step_is_the_damped_gauss_newton_step(update, make_problems, perturb, generator):
    p = make_problems(outliers=2)
    start, move = perturb(p.pose), UPDATES[update]
    weights = 0.1 + torch.rand(7, 9, generator=generator, dtype=torch.float64)
    options = {"robustness": 0.0, "step": 0.7, "damping": 0.3, "reject_worse": False, "update": update}
    found = solver(1, **options).double()(*p[:3], weights, init=start, gradient="always")

    def errors(delta):
        return reprojection_errors(p, move(start, delta)).flatten(1)

    zero = torch.zeros(7, 6, dtype=torch.float64)
    J = torch.autograd.functional.jacobian(lambda x: errors(x).sum(0), zero).movedim(0, 1)  # (B, 2N, 6)
    JW = J.mT * weights.repeat_interleave(2, 1)[:, None]
    H = JW @ J + 0.3 * torch.diag_embed((JW @ J).diagonal(dim1=-2, dim2=-1))
    delta = -0.7 * torch.linalg.solve(H, JW @ errors(zero)[..., None])[..., 0]
    # The hyperparameters are stored in float32; kornia's series near the identity is accurate to 2e-10.
    assert_same(found.matrix, move(start, delta).matrix, 1e-6, 1e-6)


@every_update
@pytest.mark.parametrize(("n", "batch"), [(4, 7), (9, 1000), (50, 1)])
def test_the_truth_is_found_without_noise(n, batch, update, make_problems, perturb):
    p = make_problems(n, batch, noise=False)
    # With the fixed damping the weakest direction of four points, nearly flat in some problems, converges slowly.
    lm = RobustWeightedLM(m=100 if n == 4 else 30, update=update)
    result = PnPNet(None, lm)(*p[:3], init=perturb(p.pose, angle=0.02, shift=0.2))
    assert max(x.max() for x in pose_errors(result.pose, p.pose)) < 1e-6
    assert result.ok.all()
    assert_same(solver(1, update=update)(*p[:3], init=p.pose).matrix, p.pose.matrix, 1e-9, 1e-9)  # no residual, no step


def test_a_copy_with_other_iterations_learns_what_the_original_learns():
    trained = [RobustWeightedLM(3, **x).with_iterations(5) for x in ({}, {"learnable": False})]
    trained += [RobustWeightedLM(0).with_iterations(5), create_solver("pnpnet-set").refine.with_iterations(5)]
    assert [sum(p.numel() for p in x.parameters() if p.requires_grad) for x in trained] == [15, 0, 15, 0]


def test_a_far_start_does_not_diverge(make_problems):
    """The default refiner comes home from a camera several times as far away, where plain iterations diverge."""
    p = make_problems(20, 100)
    middle = (p.world_points @ p.pose.rotation.mT).mean(1)
    far = Pose(p.pose.rotation, 10.0 * (p.pose.translation + middle) - middle)
    found = [PnPNet(None, RobustWeightedLM(30, reject_worse=x))(*p[:3], init=far).pose for x in (True, False)]
    careful, plain = ((pose_errors(x, p.pose).rotation_error_deg < 1.0).double().mean() for x in found)
    assert careful > 0.95
    assert plain < 0.5


@pytest.mark.parametrize(("kernel", "update"), [*((kernel, "retraction") for kernel in KERNELS), ("power", "additive")])
def test_rejecting_worse_steps_never_raises_the_cost(kernel, update, make_problems, perturb):
    p = make_problems(9, 100, outliers=3)
    near = 0.005 if kernel == "truncated" else 0.3  # that kernel is blind beyond its scale
    start = perturb(p.pose, angle=near, shift=10 * near)
    costs = [solver(m, kernel=kernel, update=update)(*p[:3], init=start).cost for m in range(10)]
    assert all((after <= before * (1 + 1e-9)).all() for before, after in itertools.pairwise(costs))
    assert (costs[-1] < costs[0]).double().mean() > 0.9


@every_kernel
def test_outliers_end_with_little_weight(kernel, make_problems, perturb):
    p = make_problems(12, 50, outliers=2)
    lm = RobustWeightedLM(m=30, kernel=kernel, robustness={"power": 1.5}.get(kernel))
    result = PnPNet(None, lm)(*p[:3], init=perturb(p.pose, angle=0.005, shift=0.05))
    light = result.weights < 0.5 * result.weights.median(-1, keepdim=True).values
    assert light[~p.inliers].double().mean() > 0.9
    assert result.ok.double().mean() > 0.85  # the poses of some kernels are less accurate


@every_kernel
def test_points_behind_the_camera_never_lower_the_cost(kernel, make_problems):
    p = make_problems(9, 200, outliers=3)
    judged = PnPNet(None, RobustWeightedLM(0, kernel=kernel))  # which returns the given pose
    back = Pose(p.pose.rotation, p.pose.translation - torch.tensor([0.0, 0.0, 1e4]).double())
    good, bad = (judged(*p[:3], init=pose) for pose in (p.pose, back))
    assert_same(bad.matrix, back.matrix, 1e-9, 1e-9)
    assert (bad.cost >= good.cost).all()
    assert (bad.cost == bad.cost.max()).all()
    assert not bad.ok.any()
    assert not bad.weights.any()
    assert good.ok.double().mean() > 0.9


@every_update
@every_kernel
def test_integer_weights_equal_repeating(kernel, update, make_problems, perturb):
    """Zero equals removing. The cost is a mean over pairs: 6 of them with weights, 9 when repeated."""
    p, times = make_problems(7, outliers=1), torch.tensor([1, 3, 1, 0, 2, 1, 1])
    start, lm = perturb(p.pose, angle=0.01, shift=0.1), solver(3, kernel=kernel, update=update)
    world, img = (x.repeat_interleave(times, 1) for x in p[:2])
    expected = lm(world, img, p.intrinsics, init=start)
    found = lm(*p[:3], times.double().expand(7, 7), init=start)
    ends = times.cumsum(0)[times > 0] - 1  # the last copy of each pair
    weights = (found.weights / times)[:, times > 0]
    assert_same((found.matrix, found.ok), (expected.matrix, expected.ok), 1e-7, 1e-7)
    assert_same((found.cost * 6, weights), (expected.cost * 9, expected.weights[:, ends]), 1e-6, 1e-6)


@pytest.mark.parametrize("backward", ["unroll", "implicit"])
@every_kernel
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_from_anywhere(kernel, backward, dtype, make_problems, random_rotations):
    """From random poses most points start behind the camera or far off, and may weigh next to nothing."""
    p = make_problems(9, 300, outliers=3, dtype=dtype)
    far = torch.logspace(-1, 4, 3, dtype=dtype)[torch.arange(300) % 3, None]
    pose = Pose(random_rotations(300).to(dtype), far * torch.randn(300, 3, dtype=dtype))
    for raw, update in itertools.product((-50.0, None, 50.0), UPDATES):
        lm = RobustWeightedLM(5, kernel=kernel, update=update, backward=backward)
        shape = KERNELS[kernel]
        bounds = {lm.step: (0, 2), lm.damping: (1e-8, 1e2), lm.robustness: (shape.lower, shape.upper)}
        for parameter, ends in bounds.items() if raw is not None else ():  # at the bounds themselves
            torch.nn.init.constant_(parameter.raw, raw)
            assert parameter()[0].item() == pytest.approx(ends[raw > 0], rel=1e-4)
        leaves = [x.clone().requires_grad_() for x in (*p[:3], *pose)]
        result = PnPNet(None, lm, gradient="always")(*leaves[:3], init=Pose(*leaves[3:]))
        assert all(x.isfinite().all() for x in result[:4])
        sum(x.sum() for x in result[:4]).backward()
        assert all(x.grad is None or x.grad.isfinite().all() for x in (*leaves, *lm.parameters()))


@pytest.mark.parametrize("kernel", [name for name in KERNELS if name != "truncated"])
def test_implicit_gradients_are_those_of_unrolling_to_the_minimum(kernel, make_problems, perturb):
    p = make_problems(8, 20, outliers=1)
    shape = {"power": 0.5}.get(kernel, 5.0)  # reweighting with 1/‖r‖ would take hundreds of iterations
    start, gradients = perturb(p.pose, angle=0.01, shift=0.1), []
    for backward in ("unroll", "implicit"):
        options = {"kernel": kernel, "robustness": shape, "shared": True, "reject_worse": False, "backward": backward}
        lm = RobustWeightedLM(100, **options).double()
        leaves = [x.clone().requires_grad_() for x in (*p[:3], *start)]
        result = PnPNet(None, lm, gradient="always")(*leaves[:3], init=Pose(*leaves[3:]))
        with torch.no_grad():
            again = PnPNet(None, RobustWeightedLM(1, **options).double(), gradient="always")(*p[:3], init=result.pose)
            there = (again.matrix - result.matrix).abs().amax((1, 2)) < 1e-9
        assert there.double().mean() > 0.6
        loss = result.translation[there].sum() + 10.0 * result.rotation[there, 0].sum()
        wanted = [*leaves[:3], lm.robustness.raw, *leaves[3:], lm.step.raw, lm.damping.raw]
        gradients.append(torch.autograd.grad(loss, wanted, materialize_grads=True))
    for unrolled, implicit in zip(*(x[:3] for x in gradients), strict=True):
        torch.testing.assert_close(implicit, unrolled, rtol=1e-4, atol=1e-5 * unrolled.abs().max().item())
    assert [x.any().item() for x in gradients[1]] == [True] * 4 + [False] * 4
    judged = PnPNet(SetInit(samples=0).double(), RobustWeightedLM(0, backward=backward), gradient="always")(*leaves[:3])
    assert torch.autograd.grad(judged.rotation.sum(), leaves[1])[0].any()  # the gradient of the start


def test_implicit_gradients_of_the_noise_are_those_of_unrolling(make_problems):
    p, gradients = make_problems(20, 6, outliers=4), []
    init, sigma = create_solver("pnpnet-set").init.double(), (1.0 + torch.arange(120) % 3).double().view(6, 20)
    for backward in ("unroll", "implicit"):
        refine = RobustWeightedLM(30, by_residual=20, backward=backward).double()
        solver = PnPNet(init, refine, gradient="always").eval()
        result = solver(*p[:3], img_sigma=sigma.requires_grad_(), world_sigma=0.05)
        gradients.append(torch.autograd.grad(result.translation[result.ok].sum(), sigma)[0])
    assert result.ok.sum() > 3
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-5)


def test_implicit_second_derivatives_are_those_of_unrolling_to_the_minimum(make_problems, perturb):
    p = make_problems(n=8, batch=2)
    direction, products = torch.randn_like(p.img_points), []
    for backward in ("unroll", "implicit"):
        lm = RobustWeightedLM(60, kernel="cauchy", step=1.0, damping=1e-4, robustness=3.0, backward=backward)
        img = p.img_points.clone().requires_grad_()
        result = PnPNet(None, lm).double()(p.world_points, img, p.intrinsics, init=perturb(p.pose))
        total = result.rotation.sum() + result.translation.sum()
        (gradient,) = torch.autograd.grad(total, img, create_graph=True)
        products.append(torch.autograd.grad((gradient * direction).sum(), img)[0])
    assert (products[1] - products[0]).norm() < 1e-5 * products[0].norm()


@pytest.mark.parametrize(("backward", "least", "most"), [("unroll", 5.0, torch.inf), ("implicit", 0.0, 1.0)])
def test_memory_of_the_backward_pass(backward, least, most, make_problems):
    p, sizes = make_problems(), {3: [], 30: []}
    img = p.img_points.clone().requires_grad_()
    for m, kept in sizes.items():
        lm = RobustWeightedLM(m, shared=True, backward=backward)
        with torch.autograd.graph.saved_tensors_hooks(lambda x, kept=kept: kept.append(x.numel()) or x, lambda x: x):
            PnPNet(None, lm)(p.world_points, img, p.intrinsics, init=p.pose)
    assert least < sum(sizes[30]) / sum(sizes[3]) <= most


# The power kernel's exponent through its special value 2 and both ends; scales of the others in pixels.
ALPHAS = (0.0, 1e-3, 1.0, 1.999, 2.0 - 1e-9, 2.0, 2.0 + 1e-9, 3.0)
SCALES = (0.1, 5.0, 1e4)
CASES = [(name, shape) for name in KERNELS for shape in (ALPHAS if name == "power" else SCALES)]
SQ_RESIDUALS = torch.cat((torch.zeros(1), torch.logspace(-8, 12, 241))).double()
#: Losses and weights of the squared residuals 0, 1, 4 and 100. With the exponent 0 `power` is least squares.
CLOSED = [("huber", "loss", 2.0, [0.0, 1.0, 4.0, 36.0]), ("huber", "weight", 2.0, [1.0, 1.0, 1.0, 0.2])]
CLOSED += [("truncated", "loss", 2.0, [0.0, 1.0, 4.0, 4.0]), ("cauchy", "weight", 2.0, [1.0, 0.8, 0.5, 1 / 26])]
CLOSED += [("geman_mcclure", "loss", 2.0, [0.0, 0.8, 2.0, 100 / 26]), ("power", "loss", 0.0, [0.0, 1.0, 4.0, 100.0])]
CLOSED += [("power", "loss", 2.0, [0.0, *(math.log1p(100.0 * s) for s in (1.0, 4.0, 100.0))])]


@pytest.mark.parametrize(("name", "shape"), CASES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_loss_starts_at_zero_and_rises_and_its_derivative_is_the_weight_which_falls(name, shape, dtype):
    kernel, sq_residual = KERNELS[name], SQ_RESIDUALS.to(dtype).requires_grad_()
    loss, weight = (f(sq_residual, torch.tensor(shape, dtype=dtype)) for f in (kernel.loss, kernel.weight))
    (derivative,) = torch.autograd.grad(loss.sum(), sq_residual)
    assert loss.dtype == weight.dtype == dtype
    assert loss[0] == 0
    assert (loss[1:] > 0).all()
    rounding = 4 * torch.finfo(dtype).eps
    assert (loss[1:] >= loss[:-1] * (1 - rounding)).all()
    assert (weight >= 0).all()
    assert (weight[1:] <= weight[:-1] * (1 + rounding)).all()
    if dtype == torch.float64:
        smooth = (SQ_RESIDUALS.sqrt() - shape).abs() > (1e-9 if name == "truncated" else -1.0)
        # Weights are at most 1 except for `power`, whose tail autograd keeps to full precision.
        atol = 1e-300 if name == "power" else 1e-15
        torch.testing.assert_close(derivative[smooth], weight[smooth], rtol=1e-9, atol=atol)


@pytest.mark.parametrize("name", [name for name in KERNELS if name != "truncated"])
def test_gradcheck_in_both_arguments(name):
    kernel = KERNELS[name]
    sq_residual = torch.tensor([0.0, 1e-3, 0.3, 7.0, 90.0, 3e3], dtype=torch.float64).requires_grad_()
    for shape in (0.1, 1.0, 1.99, 2.0, 2.01, 2.9) if name == "power" else (0.5, 4.0, 30.0):
        inputs = sq_residual, torch.tensor(shape, dtype=torch.float64).requires_grad_()
        # Differences across sq_residual = 0 need the loss a little below zero, which is smooth there.
        assert torch.autograd.gradcheck(kernel.loss, inputs, eps=1e-5, atol=1e-4)
        assert torch.autograd.gradcheck(kernel.weight, inputs, eps=1e-7, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize(("name", "part", "shape", "expected"), CLOSED)
def test_closed_forms(name, part, shape, expected):
    found = getattr(KERNELS[name], part)(torch.tensor([0.0, 1.0, 4.0, 100.0]).double(), torch.tensor(shape).double())
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64))


FOCAL, RADIAL = 3400.0, torch.tensor([[0.05, -0.02]], dtype=torch.float64)


def scene(camera, unknown, turn):
    """Points in front of cameras but for one, and a state with unknown parameters of the camera."""
    options = {"cameras": 1 if camera == "pixels" else 3, "baseline": 0.1 if camera == "rig" else 0.0}
    p = CameraProblems(n=9, batch_size=7, seed=0, dtype=torch.float64, **options).batch(0)
    if p.cam_from_rig is not None:  # whose cameras turn about one axis
        rig = p.cam_from_rig._replace(rotation=p.cam_from_rig.rotation @ turn.mT[:, None])
        pose = Pose(turn @ p.pose.rotation, (turn @ p.pose.translation[..., None])[..., 0])
        p = p._replace(pose=pose, cam_from_rig=rig)
    to_camera = p.pose.rotation if p.cam_from_rig is None else p.cam_from_rig.rotation[:, 0] @ p.pose.rotation
    p.world_points[0, 0] -= 1000.0 * to_camera[0, 2]  # to the far side of the camera
    known = torch.cat((torch.linspace(-0.1, 0.1, 7).double()[:, None], RADIAL.expand(7, 2)), 1)[:, :unknown]
    return State(p.pose, known), Problem.of(p.world_points, p.img_points - 1000.0, FOCAL, rig=p.cam_from_rig)


@pytest.mark.parametrize("few", [True, False])
@pytest.mark.parametrize(("camera", "unknown"), [("rig", 0), ("bearings", 0), *(("pixels", k) for k in range(4))])
def test_normal_equations_are_those_of_the_derivative(camera, unknown, few, random_rotations, monkeypatch, generator):
    state, problem = scene(camera, unknown, random_rotations(7))
    jacobian = verified_derivative(lambda x: project(x, problem).residual.flatten(0, 1).mT, state).unflatten(1, (2, 9))
    projection = project(state, problem)
    assert projection.in_front.sum() == 62
    monkeypatch.setattr("kornia_pnpnet.refine.residual.are_few", lambda _: few)
    root = torch.randn(7, 9, 2, 2, generator=generator, dtype=torch.float64)
    for matrices in (root @ root.mT, torch.eye(2) * root[..., :1, :1].square()):
        is_scalar = not matrices[..., 0, 1].any()
        weights = matrices[..., 0, 0] if is_scalar else symmetric(matrices)
        found = normal_equations(projection, problem, weights)
        left = torch.einsum("buni,bnuv->bvni", jacobian, matrices * projection.in_front[..., None, None])
        focal = projection.focal.expand(7)
        matrix = torch.einsum("bvni,bvnj->ijb", left, jacobian) / focal**2
        gradient = torch.einsum("bvni,vnb->ib", left, projection.residual) / focal
        size = matrix.diagonal().mT.sqrt()
        assert ((found.matrix - matrix) / (size[:, None] * size)).abs().max() < 1e-10
        assert ((found.gradient - gradient) / size).abs().max() < 1e-8 * FOCAL


def test_points_behind_the_camera_have_finite_gradients():
    world = torch.tensor([[[1.0, 2.0, z] for z in (-1.0, 0.0, 1e-30, 5.0)]], requires_grad=True)
    for unknown in (0, 3):
        state = State(Pose(torch.eye(3)[None], torch.zeros(1, 3)), torch.zeros(1, unknown, requires_grad=True))
        projection = project(state, Problem.of(world, torch.zeros(1, 4, 2), 1000.0))
        assert projection.in_front.tolist() == [[False, False, False, True]]
        leaves = [world, state.camera] if unknown else [world]
        assert all(x.isfinite().all() for x in torch.autograd.grad(projection.residual.sum(), leaves))


@pytest.mark.parametrize("length", [0.0, 1e-12, 1e-3, 0.03, 1.0, 1e6])
def test_retraction_is_cayleys(length, random_rotations, generator):
    """It turns about its axis by 2 arctan(length / 2); the opposite one undoes it."""
    delta = torch.randn(50, 6, generator=generator, dtype=torch.float64)
    delta = delta / delta[:, :3].norm(dim=-1, keepdim=True)
    pose = Pose(random_rotations(50), torch.zeros(50, 3).double())
    there = retract(pose, length * delta)
    expected = axis_angle_to_rotation_matrix(2.0 * math.atan(0.5 * length) * delta[:, :3]) @ pose.rotation
    assert_same(there.rotation, expected, atol=1e-14)
    assert_same(there.translation, length * delta[:, 3:])
    back = retract(there, -length * delta)
    assert_same(back.rotation, pose.rotation, atol=1e-13)
    assert_same(back.translation, pose.translation, atol=1e-14 * max(length, 1.0))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("length", [0.0, 1e-30, 1e-3, 1.0, 1e3, 1e15])
def test_retraction_by_anything_is_a_rotation_with_finite_gradients(length, dtype, random_rotations, generator):
    delta = (length * torch.randn(50, 6, generator=generator)).to(dtype).requires_grad_()
    there = retract(Pose(random_rotations(50).to(dtype), torch.zeros(50, 3, dtype=dtype)), delta)
    eye = torch.eye(3, dtype=dtype).expand(50, 3, 3)
    assert_same(there.rotation @ there.rotation.mT, eye, atol=20 * torch.finfo(dtype).eps)
    assert (torch.linalg.det(there.rotation) > 0.5).all()
    there.rotation.sum().backward()
    assert delta.grad.isfinite().all()
