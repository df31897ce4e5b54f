"""Covariances of pixels and world points: whitening by them, from the user's argument to pose, weights and gradient."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError, TypeCheckError, ValueCheckError
from kornia.geometry.liegroup import So3
from strategies import SOLVERS, batches, check, many

from kornia_pnpnet import (
    Normalize,
    PnPNet,
    Pose,
    RobustWeightedLM,
    Status,
    create_solver,
    monte_carlo_pose_loss,
    pose_covariance,
    pose_errors,
)
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.bounds import KnownInliersAndNoise
from kornia_pnpnet.refine.residual import retract

DOUBLE = torch.float64
CAMERA = torch.tensor([[800.0, 30.0, 320.0], [0.0, 1000.0, 240.0], [0.0, 0.0, 1.0]], dtype=DOUBLE)


def problems(n=9, batch=4, outliers=0, seed=3, **options):
    """Problems with covariances of ratio 5, seen by a camera with a skew and two focal lengths."""
    options = {"axis_ratio": 5.0, "known_noise": 1.0, "img_sigma": 10.0, "dtype": DOUBLE, **options}
    mix = OutlierMix(count=outliers)
    p = SyntheticProblems(n=n, batch_size=batch, seed=seed, outliers=mix, **options).batch(0)
    change = CAMERA[:2, :2] @ torch.diag(1.0 / p.intrinsics[0].diagonal()[:2])
    img = p.img_points @ change.mT + CAMERA[:2, 2]
    return p._replace(img_points=img, img_cov=change @ p.img_cov @ change.mT, intrinsics=CAMERA.expand(batch, 3, 3))


def covs(p):
    return {"img_cov": p.img_cov, "world_cov": p.world_cov}


def least_squares(m=30, **options):
    options = {"robustness": 0.0, "reject_worse": False, "learnable": False, **options}
    return PnPNet(None, RobustWeightedLM(m, **options))


def isotropic(sigma, size):
    return sigma[..., None, None].square() * torch.eye(size, dtype=sigma.dtype)


def image_of(world, rotation, translation):
    homogeneous = (world @ rotation.mT + translation) @ CAMERA.mT
    return homogeneous[:, :2] / homogeneous[:, 2:]


def dense_system(p, i, pose):
    """Of one problem: the whitened Jacobian (2N, 6) by the tangent and residual (2N), all derivatives by autograd."""
    rotation, translation = pose

    def seen(tangent):
        moved = retract(Pose(rotation[None], translation[None]), tangent[None])
        return image_of(p.world_points[i], moved.rotation[0], moved.translation[0])

    def point(world):
        return image_of(world, rotation, translation).sum(0)

    zero = torch.zeros(6, dtype=DOUBLE)
    jacobian = torch.autograd.functional.jacobian(seen, zero)  # (N, 2, 6)
    by_point = torch.autograd.functional.jacobian(point, p.world_points[i]).movedim(1, 0)  # (N, 2, 3)
    covariance = p.img_cov[i] + by_point @ p.world_cov[i] @ by_point.mT
    whiten = torch.linalg.inv(torch.linalg.cholesky(covariance))
    residual = seen(zero) - p.img_points[i]
    return (whiten @ jacobian).flatten(0, 1), (whiten @ residual[..., None]).flatten()


# -- against other ways to say the same ----------------------------------------------------------------------------


def test_poses_covariances_and_weights_are_those_of_a_dense_solver():
    p = problems()
    result = least_squares()(*p[:3], init=p.pose, **covs(p))
    robust = least_squares(kernel="cauchy", robustness=3.0)(*p[:3], init=p.pose, **covs(p))
    covariance = pose_covariance(result.pose, *p[:3], **covs(p))
    for i in range(4):
        pose = Pose(p.pose.rotation[i], p.pose.translation[i])
        for _ in range(30):
            jacobian, residual = dense_system(p, i, pose)
            step = -torch.linalg.lstsq(jacobian, residual[:, None]).solution[:, 0]
            pose = Pose(*(x[0] for x in retract(Pose(*(x[None] for x in pose)), step[None])))
        torch.testing.assert_close(result.rotation[i], pose.rotation, rtol=0, atol=1e-9)
        torch.testing.assert_close(result.translation[i], pose.translation, rtol=0, atol=1e-7)
        information = jacobian.mT @ jacobian
        torch.testing.assert_close(covariance[i], torch.linalg.inv(information), rtol=1e-6, atol=1e-12)
        _, residual = dense_system(p, i, Pose(robust.rotation[i], robust.translation[i]))
        distance = residual.view(-1, 2).square().sum(-1)
        torch.testing.assert_close(robust.weights[i], 1.0 / (1.0 + distance / 9.0), rtol=1e-6, atol=0)


@pytest.mark.parametrize("name", ["epnp-lm", "pnpnet-n9", "p3p-ransac"])
def test_an_isotropic_covariance_is_a_sigma(name, make_problems):
    p = make_problems(batch=20, outliers=1)
    solver = create_solver(name).double()
    sigma = torch.linspace(10.0, 30.0, 180, dtype=DOUBLE).view(20, 9)
    by_sigma, by_cov = p.img_points.clone().requires_grad_(), p.img_points.clone().requires_grad_()
    told = solver(p.world_points, by_sigma, p.intrinsics, img_sigma=sigma, world_sigma=0.0)
    same = solver(p.world_points, by_cov, p.intrinsics, img_cov=isotropic(sigma, 2), world_sigma=0.0)
    assert told.ok.double().mean() > 0.5
    assert torch.equal(told.ok, same.ok)
    for ours, other in zip(told[:4], same[:4], strict=True):
        torch.testing.assert_close(other[told.ok], ours[told.ok], rtol=1e-6, atol=1e-7)
    for result in (told, same):
        if result.rotation.requires_grad:
            (result.rotation[..., 0].sum() + result.weights.sum()).backward()
    if by_sigma.grad is not None:
        torch.testing.assert_close(by_cov.grad, by_sigma.grad, rtol=1e-4, atol=1e-7)


def test_isotropic_covariances_of_points_are_sigmas(make_problems):
    p = make_problems(batch=10)
    sigma = torch.linspace(0.02, 0.1, 90, dtype=DOUBLE).view(10, 9)
    img_cov = isotropic(torch.full((10, 9), 2.0, dtype=DOUBLE), 2)
    solver = least_squares()
    told = solver(*p[:3], init=p.pose, img_cov=img_cov, world_sigma=sigma)
    same = solver(*p[:3], init=p.pose, img_cov=img_cov, world_cov=isotropic(sigma, 3))
    mixed = solver(*p[:3], init=p.pose, img_sigma=2.0, world_cov=isotropic(sigma, 3))
    for other in (same, mixed):
        torch.testing.assert_close(other.matrix, told.matrix, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(other.weights, told.weights, rtol=1e-9, atol=1e-9)


def test_order_and_views_change_nothing():
    p = problems(batch=6)
    ordered, plain = (
        PnPNet(None, least_squares().refine, Normalize(order=order))(*p[:3], init=p.pose, **covs(p))
        for order in (True, False)
    )
    torch.testing.assert_close(ordered[:4], plain[:4], rtol=1e-9, atol=1e-9)
    one, four = (create_solver("pnpnet-set", views=views).double()(*p[:3], **covs(p)) for views in (1, 4))
    torch.testing.assert_close(four.matrix, one.matrix, rtol=1e-3, atol=1e-3)


def test_any_leading_dimensions():
    p = problems(batch=6)
    solver = create_solver("pnpnet-set").double()
    flat = solver(*p[:3], **covs(p))
    nested = solver(*(x.unflatten(0, (2, 3)) for x in p[:3]), **{k: x.unflatten(0, (2, 3)) for k, x in covs(p).items()})
    one = solver(*(x[4] for x in p[:3]), **{k: x[4] for k, x in covs(p).items()})
    torch.testing.assert_close(nested.matrix.flatten(0, 1), flat.matrix, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(one.matrix, flat.matrix[4], rtol=1e-9, atol=1e-9)


def test_float32_solves_as_float64():
    p = problems(n=20, batch=50, axis_ratio=50.0)
    single = p.map(lambda x: x.float() if x.is_floating_point() else x)
    solver = create_solver("pnpnet-set")
    ours, exact = solver(*single[:3], **covs(single)), solver(*p[:3], **covs(p))
    assert ours.rotation.dtype == torch.float32
    assert exact.rotation.dtype == DOUBLE
    assert (pose_errors(Pose(*(x.double() for x in ours.pose)), exact.pose).rotation_error_deg < 0.01).all()


# -- laws ----------------------------------------------------------------------------------------------------------


def turn_about(axis, angle):
    return Pose.from_rvec(angle * torch.tensor([axis], dtype=DOUBLE), torch.zeros(1, 3, dtype=DOUBLE)).rotation[0]


@pytest.mark.parametrize("solver", ["refinement", "pnpnet-set"])
def test_covariances_turn_with_the_world(solver):
    p = problems(outliers=1)
    turn = turn_about((0.3, -1.2, 0.8), 1.0)
    solver = least_squares(kernel="cauchy", robustness=3.0) if solver == "refinement" else create_solver(solver)
    start = {} if solver.init is not None else {"init": p.pose}
    moved_start = {} if not start else {"init": Pose(p.pose.rotation @ turn.mT, p.pose.translation)}
    plain = solver(*p[:3], **start, **covs(p))
    turned = solver(
        p.world_points @ turn.mT,
        *p[1:3],
        **moved_start,
        img_cov=p.img_cov,
        world_cov=turn @ p.world_cov @ turn.mT,
    )
    torch.testing.assert_close(turned.rotation @ turn, plain.rotation, rtol=0, atol=1e-5)
    torch.testing.assert_close(turned.translation, plain.translation, rtol=0, atol=1e-4)
    torch.testing.assert_close(turned.weights, plain.weights, rtol=0, atol=1e-4)


def test_the_covariance_of_a_pose_turns_with_its_frame():
    p = problems()
    expected = pose_covariance(p.pose, *p[:3], **covs(p))
    turn = turn_about((0.3, -1.2, 0.8), 1.0)
    turned = pose_covariance(
        Pose(p.pose.rotation @ turn.mT, p.pose.translation),
        p.world_points @ turn.mT,
        *p[1:3],
        img_cov=p.img_cov,
        world_cov=turn @ p.world_cov @ turn.mT,
    )
    torch.testing.assert_close(turned, expected, rtol=1e-6, atol=0)
    roll = turn_about((0.0, 0.0, 1.0), 0.7)
    change = CAMERA @ roll @ torch.linalg.inv(CAMERA)  # of homogeneous pixels
    img = p.img_points @ change[:2, :2].mT + change[:2, 2]
    rolled = pose_covariance(
        Pose(roll @ p.pose.rotation, p.pose.translation @ roll.mT),
        p.world_points,
        img,
        p.intrinsics,
        img_cov=change[:2, :2] @ p.img_cov @ change[:2, :2].mT,
        world_cov=p.world_cov,
    )
    both = torch.block_diag(roll, roll)
    torch.testing.assert_close(rolled, both @ expected @ both.mT, rtol=1e-6, atol=1e-12)


def test_covariances_turn_with_the_image():
    p = problems()
    camera = torch.diag(torch.tensor([900.0, 900.0, 1.0], dtype=DOUBLE)).expand(4, 3, 3)
    change = torch.linalg.inv(CAMERA[:2, :2]) * 900.0
    img = (p.img_points - CAMERA[:2, 2]) @ change.mT
    img_cov = change @ p.img_cov @ change.mT
    roll = turn_about((0.0, 0.0, 1.0), 0.7)
    solver = least_squares()
    plain = solver(p.world_points, img, camera, init=p.pose, img_cov=img_cov, world_cov=p.world_cov)
    start = Pose(roll @ p.pose.rotation, p.pose.translation @ roll.mT)
    flat = roll[:2, :2]
    rolled = solver(
        p.world_points,
        img @ flat.mT,
        camera,
        init=start,
        img_cov=flat @ img_cov @ flat.mT,
        world_cov=p.world_cov,
    )
    torch.testing.assert_close(roll.mT @ rolled.rotation, plain.rotation, rtol=0, atol=1e-9)
    torch.testing.assert_close(rolled.translation @ roll, plain.translation, rtol=0, atol=1e-7)
    skewed = solver(*p[:3], init=p.pose, **covs(p))  # the same problem in another camera
    torch.testing.assert_close(skewed.matrix, plain.matrix, rtol=0, atol=1e-7)


def test_a_common_factor_changes_no_pose():
    p = problems()
    solver = least_squares()
    plain = solver(*p[:3], init=p.pose, **covs(p))
    scaled = solver(*p[:3], init=p.pose, **{name: 9.0 * x for name, x in covs(p).items()})
    torch.testing.assert_close(scaled.matrix, plain.matrix, rtol=0, atol=1e-9)
    cov, large = (pose_covariance(plain.pose, *p[:3], **{k: f * x for k, x in covs(p).items()}) for f in (1.0, 9.0))
    torch.testing.assert_close(large, 9.0 * cov)


def test_gradcheck():
    p = problems(n=6, batch=2)
    solver = least_squares(2, kernel="cauchy", robustness=3.0)

    def run(world, img, img_cov, world_cov):
        result = solver(world, img, p.intrinsics, init=p.pose, img_cov=img_cov, world_cov=0.01 * world_cov)
        return result.rotation, result.translation, result.weights

    inputs = p.world_points, p.img_points, p.img_cov, 100.0 * p.world_cov  # so that one difference step suits all
    inputs = [x.clone().requires_grad_() for x in inputs]
    assert solver(*p[:3], init=p.pose, **covs(p)).ok.all()
    assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-7, rtol=1e-3, fast_mode=True)


def test_the_implicit_gradient_is_that_of_all_iterations():
    p = problems(n=6, batch=2)
    gradients = []
    for backward in ("unroll", "implicit"):
        solver = least_squares(60, kernel="cauchy", robustness=3.0, backward=backward)
        leaves = {name: x.clone().requires_grad_() for name, x in covs(p).items()}
        result = solver(*p[:3], init=p.pose, **leaves)
        gradients.append(torch.autograd.grad(result.translation[:, 0].sum(), list(leaves.values())))
    for unrolled, implicit in zip(*gradients, strict=True):
        torch.testing.assert_close(implicit, unrolled, rtol=0, atol=1e-5 * unrolled.abs().max().item())


@pytest.mark.parametrize("name", ["pnpnet-set", "pnpnet-n9", "epnp-lm", "reppnp-lm"])
def test_gradients_reach_the_covariances(name):
    p = problems(outliers=2)
    leaves = {key: x.clone().requires_grad_() for key, x in covs(p).items()}
    result = create_solver(name)(*p[:3], **leaves)
    assert result.ok.any()
    result.translation.sum().backward()
    for leaf in leaves.values():
        assert leaf.grad.isfinite().all()
        assert (leaf.grad.flatten(1) != 0).any(1)[result.ok].all()


# -- bad covariances -----------------------------------------------------------------------------------------------

BAD = {
    "nan": torch.nan,
    "infinite": torch.inf,
    "negative": -1.0,
    "indefinite": None,
}


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("name", ["img_cov", "world_cov"])
@pytest.mark.parametrize("solver", ["pnpnet-set", "epnp-lm"])
def test_a_bad_covariance_fails_its_problem_alone(solver, name, bad):
    p = problems(batch=5)
    solver = create_solver(solver).double()
    given = {key: x.clone() for key, x in covs(p).items()}
    if bad == "indefinite":
        given[name][1, 3, 0, 1] = given[name][1, 3, 1, 0] = 10.0 * given[name][1, 3].diagonal().max()
    else:
        given[name][1, 3] = BAD[bad] * torch.eye(len(given[name][1, 3]), dtype=DOUBLE)
    leaves = {key: x.requires_grad_() for key, x in given.items()}
    img = p.img_points.clone().requires_grad_()
    result = solver(p.world_points, img, p.intrinsics, **leaves)
    (result.translation.sum() + result.init.translation.sum() + result.weights.sum()).backward()
    others = [0, 2, 3, 4]
    assert not result.ok[1]
    assert result.status[1] == Status.NOT_FINITE
    for grad in (img.grad, *(x.grad for x in leaves.values())):
        assert grad.isfinite().all()
        assert (grad[1] == 0).all()
    assert result.matrix.isfinite().all()
    clean = solver(*p[:3], **covs(p))
    assert torch.equal(result.matrix[others], clean.matrix[others])
    assert torch.equal(result.ok[others], clean.ok[others])
    # As padding the pair does not matter.
    mask = torch.ones(5, 9, dtype=torch.bool)
    mask[1, 3] = False
    padded = solver(p.world_points, img, p.intrinsics, mask=mask, **leaves)
    assert torch.equal(padded.ok, solver(*p[:3], mask=mask, **covs(p)).ok)
    leaves[name].grad = None
    padded.translation.sum().backward()
    assert leaves[name].grad.isfinite().all()


def test_exact_points_and_exact_pixels_are_sound():
    p = problems(batch=20, world_sigma=0.0)
    exact = {"img_cov": p.img_cov, "world_cov": torch.zeros_like(p.world_cov).requires_grad_()}
    result = create_solver("pnpnet-set")(*p[:3], **exact)
    assert result.ok.all()
    result.rotation.sum().backward()
    assert exact["world_cov"].grad.isfinite().all()
    flat = torch.zeros_like(p.img_cov)
    flat[..., 0, 0] = 1.0  # the vertical coordinate of each pixel is exact
    result = create_solver("epnp-lm")(*p[:3], img_cov=flat, world_cov=problems(batch=20).world_cov)
    assert result.matrix.isfinite().all()
    assert result.ok.double().mean() > 0.9


@pytest.mark.parametrize("call", ["solver", "pose_covariance", "likelihood"])
def test_what_contradicts_is_an_error(call):
    p = problems()
    run = {
        "solver": lambda **noise: create_solver("epnp-lm")(*p[:3], **noise),
        "pose_covariance": lambda **noise: pose_covariance(p.pose, *p[:3], **noise),
        "likelihood": lambda **noise: monte_carlo_pose_loss(p.pose, p.pose, *p[:3], **noise),
    }[call]
    with pytest.raises(ValueCheckError, match="img_sigma or img_cov"):
        run(img_sigma=1.0, img_cov=p.img_cov)
    with pytest.raises(ValueCheckError, match="world_sigma or world_cov"):
        run(img_sigma=1.0, world_sigma=0.1, world_cov=p.world_cov)
    with pytest.raises(ShapeError, match="img_cov"):
        run(img_cov=p.img_cov[:, :4])
    with pytest.raises(ShapeError, match="world_cov"):
        run(img_sigma=1.0, world_cov=p.img_cov)
    with pytest.raises(TypeCheckError, match="img_cov"):
        run(img_cov=p.img_cov > 0)
    if call != "solver":
        with pytest.raises(ValueCheckError, match="img_sigma or img_cov"):
            run()


@st.composite
def any_covariances(draw, count, batch, dtype):
    """Of any size and shape of ellipsoid, with now and then an entry that makes no sense."""
    found = {}
    for name, size in (("img_cov", 2), ("world_cov", 3)):
        if draw(st.booleans()):
            generator = torch.Generator().manual_seed(draw(st.integers(0, 99)))
            rank = draw(st.integers(0, size))
            factor = torch.randn(batch, count, size, rank, generator=generator, dtype=torch.float64)
            matrix = (10.0 ** draw(st.integers(-12, 12)) * factor @ factor.mT).to(dtype)
            if matrix.numel() and draw(st.booleans()):
                matrix.view(-1)[draw(st.integers(0, 3))] = draw(
                    st.sampled_from([0.0, -1.0, torch.nan, torch.inf, 1e30])
                )
            found[name] = matrix.requires_grad_() if draw(st.booleans()) else matrix
    return found


@many(150)
@given(st.sampled_from([x for x in SOLVERS if "n9" not in x]), batches(), st.data())
def test_a_solver_takes_any_covariances(name, case, data):
    inputs, mask, weights, kinds = case
    batch, count = inputs[0].shape[:2]
    given_covs = data.draw(any_covariances(count, batch, inputs[0].dtype))
    result = SOLVERS[name](*inputs, mask=mask, weights=weights, **given_covs)
    check(result, [*inputs, *given_covs.values()], kinds)


def test_undetermined_where_a_covariance_is_bad():
    p = problems(batch=3)
    bad = p.world_cov.clone()
    bad[1, 2] = -bad[1, 2]
    covariance = pose_covariance(p.pose, *p[:3], img_cov=p.img_cov, world_cov=bad)
    assert covariance[1].diagonal().isinf().all()
    clean = pose_covariance(p.pose, *p[:3], **covs(p))
    assert torch.equal(covariance[[0, 2]], clean[[0, 2]])
    weights = torch.ones(3, 9, dtype=DOUBLE)
    weights[1, 2] = 0.0
    assert pose_covariance(p.pose, *p[:3], img_cov=p.img_cov, world_cov=bad, weights=weights).isfinite().all()


# -- what it is for ------------------------------------------------------------------------------------------------


def test_told_covariances_reach_the_bound_and_sigmas_do_not():
    p = problems(n=20, batch=1500, outliers=6, world_sigma=0.02)
    solver = create_solver("pnpnet-set")
    with torch.no_grad():
        found = [
            KnownInliersAndNoise().solve_with_truth(p),
            solver(*p[:3], **covs(p)),
            solver(*p[:3], img_sigma=10.0 * 30.0 / 113.0, world_sigma=0.02),
        ]
    errors = [torch.stack(list(pose_errors(x.pose, p.pose))).median(1).values for x in found]
    assert (errors[1] < 1.05 * errors[0]).all()
    assert (errors[2] > 1.15 * errors[0]).all()
    best = found[0].pose
    covariance = pose_covariance(best, *p[:3], **covs(p), weights=p.inliers.double())
    omega = So3.vee(best.rotation @ p.pose.rotation.mT - p.pose.rotation @ best.rotation.mT) / 2.0
    error = torch.cat((omega, best.translation - p.pose.translation), -1)
    squares = (error * torch.linalg.solve(covariance, error)).sum(-1)
    assert squares.mean().item() == pytest.approx(6.0, rel=0.05)


def test_the_likelihood_is_that_of_the_covariances():
    """Laplace's approximation, exact in the limit, of pixels and points with covariances; isotropic ones are sigmas."""
    p = problems(n=60, img_sigma=0.5, world_sigma=0.002)
    mode = least_squares()(*p[:3], init=p.pose, **covs(p)).pose
    expected = 0.5 * torch.logdet(2.0 * math.pi * pose_covariance(mode, *p[:3], **covs(p)))
    options = {"samples": 2000, "kernel": "truncated", "scale": 1e3}

    def loss(**noise):
        torch.manual_seed(0)
        return monte_carlo_pose_loss(mode, mode, *p[:3], **noise, **options)

    torch.testing.assert_close(loss(**covs(p)), expected, rtol=0.0, atol=0.1)
    sigma = torch.full((4, 60), 2.0, dtype=DOUBLE)
    camera = torch.diag(torch.tensor([900.0, 900.0, 1.0], dtype=DOUBLE))
    pixels = (p.img_points - CAMERA[:2, 2]) @ torch.linalg.inv(CAMERA[:2, :2]).mT * 900.0
    p = p._replace(img_points=pixels, intrinsics=camera.expand(4, 3, 3))
    torch.testing.assert_close(loss(img_cov=isotropic(sigma, 2)), loss(img_sigma=sigma), rtol=1e-5, atol=1e-5)
    leaf = p.img_cov.clone().requires_grad_()
    loss(img_cov=leaf).sum().backward()
    assert leaf.grad.isfinite().all()
    assert (leaf.grad != 0).any()


def test_synthetic_noise_has_its_covariance():
    """Noise whitened by its covariance is standard normal in every direction."""
    options = {"img_sigma": (0.5, 5.0), "world_sigma": 0.1, "sigma_spread": 0.5, "seed": 8, "n": 20, "batch_size": 500}
    p = SyntheticProblems(axis_ratio=5.0, known_noise=1.0, dtype=DOUBLE, **options).batch(0)
    assert p.img_sigma is None
    assert set(p.known) == {"img_cov", "world_cov"}
    for covariance, size in ((p.img_cov, 2), (p.world_cov, 3)):
        values = torch.linalg.eigvalsh(covariance)
        torch.testing.assert_close(values[..., -1] / values[..., 0], torch.full((500, 20), 25.0, dtype=DOUBLE))
        assert covariance.shape == (500, 20, size, size)
    cam = p.world_points @ p.pose.rotation.mT + p.pose.translation[:, None]
    exact = SyntheticProblems(axis_ratio=5.0, known_noise=1.0, dtype=DOUBLE, **{**options, "world_sigma": 0.0}).batch(0)
    cam = exact.world_points @ exact.pose.rotation.mT + exact.pose.translation[:, None]
    off = exact.img_points - 3400.0 * cam[..., :2] / cam[..., 2:]
    for noise, covariance in ((off, exact.img_cov), (p.world_points - exact.world_points, p.world_cov)):
        whitened = torch.linalg.solve_triangular(
            torch.linalg.cholesky(covariance), noise[..., None], upper=False
        ).flatten(0, 1)[..., 0]
        second = whitened.mT @ whitened / len(whitened)
        torch.testing.assert_close(second, torch.eye(len(second), dtype=DOUBLE), rtol=0, atol=0.05)
