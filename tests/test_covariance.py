"""Covariances of poses against the errors of many problems, of pixels and points as arguments, heat maps and depth."""

import math
from functools import partial
from itertools import product

import pytest
import torch
from helpers import assert_same, derivative, reprojection_errors
from kornia.core.exceptions import BaseError
from kornia.geometry import conversions
from kornia.geometry.linalg import transform_points
from kornia.geometry.subpix import spatial_soft_argmax2d
from laws import CAMERAS, LENSES, PAIRS, Case, gradcheck_by_size, make, make_bad
from torch.autograd import gradcheck
from torch.nn.functional import normalize
from torch.utils import _pytree as pytree

from kornia_pnpnet import PnPNet, PnPResult, Pose, PosePrior, RobustWeightedLM, create_solver, pose_covariance
from kornia_pnpnet.cameras import bearings
from kornia_pnpnet.covariance import shown_noise
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.bounds import KnownInliersAndNoise
from kornia_pnpnet.likelihood import monte_carlo_pose_loss
from kornia_pnpnet.measurements import depth_points, heatmap_keypoints
from kornia_pnpnet.metrics import pose_errors
from kornia_pnpnet.problem import State
from kornia_pnpnet.refine.residual import retract, tangent

DOUBLE = torch.float64
CAMERA = torch.tensor([[800.0, 30.0, 320.0], [0.0, 1000.0, 240.0], [0.0, 0.0, 1.0]], dtype=DOUBLE)


def test_units_of_the_noise_and_pairs_without_weight(make_problems):
    p = make_problems(n=12, batch=5)
    plain = pose_covariance(p.pose, *p[:3], img_sigma=1.0, world_sigma=0.1)
    full = p.world_points.new_full
    double = pose_covariance(p.pose, *p[:3], img_sigma=full((5,), 2.0), world_sigma=full((5, 12), 0.2))
    torch.testing.assert_close(double, 4.0 * plain)
    scaled = Pose(p.pose.rotation, 1000.0 * p.pose.translation)
    large = pose_covariance(scaled, 1000.0 * p.world_points, *p[1:3], img_sigma=1.0, world_sigma=100.0)
    unit = torch.tensor([1.0] * 3 + [1000.0] * 3, dtype=DOUBLE)
    torch.testing.assert_close(large, plain * unit * unit[:, None])
    weights = (torch.arange(12) < 8).double().expand(5, 12)
    world, sigma = p.world_points.clone(), torch.full((5, 12), 2.0, dtype=DOUBLE)
    world[:, 8:], sigma[:, 8:] = torch.nan, torch.nan
    half = pose_covariance(p.pose, world, *p[1:3], img_sigma=sigma, weights=weights)
    part = pose_covariance(p.pose, p.world_points[:, :8], p.img_points[:, :8], p.intrinsics, img_sigma=2.0)
    torch.testing.assert_close(half, part)


@pytest.mark.parametrize(("camera", "noise"), [("pixels", "covariance"), *product(CAMERAS, ("sigma",))])
def test_an_undetermined_pose_has_infinite_variances_and_no_gradient(camera, noise):
    case = Case("epnp-lm", camera, noise)
    kinds, sound, bad = make_bad(case)
    _, pose = make(case, len(sound["weights"]))
    leaves = [x.requires_grad_() for x in pytree.tree_leaves(bad)]
    found, expected = pose_covariance(pose, **bad), pose_covariance(pose, **sound)
    assert torch.equal(found[::2], expected[::2])
    assert expected.isfinite().all()
    infinite = torch.diag(torch.full((6,), torch.inf, dtype=DOUBLE))
    assert torch.equal(found[1::2], infinite.expand(len(kinds), 6, 6)), kinds
    for gradient in torch.autograd.grad(found[::2].sum(), leaves):
        assert gradient.isfinite().all()
        assert not gradient[1::2].any()


def test_lenses_bearings_and_rigs_have_the_covariance_of_a_pinhole_camera():
    (plain, pose), solver = make(Case("epnp-lm")), create_solver("epnp-lm")
    calls = [make(Case("epnp-lm", extra=lens))[0] for lens in LENSES]
    calls.append({**plain, "img_points": bearings(plain["img_points"], plain["intrinsics"]), "intrinsics": None})
    eye = Pose(torch.eye(3, dtype=DOUBLE).expand(5, PAIRS, 3, 3), torch.zeros_like(plain["world_points"]))
    calls.append({**plain, "intrinsics": plain["intrinsics"][:, None].expand(5, PAIRS, 3, 3), "cam_from_rig": eye})
    expected, *found = (solver(**x).covariance(**x).diagonal(dim1=1, dim2=2) for x in (plain, *calls))
    for covariance in found:  # at the edge of the image, noise of a bearing is another noise of the pixel
        assert_same(covariance, expected, rtol=0.2)
    for refuses in (partial(monte_carlo_pose_loss, pose), partial(pose_covariance, focal="unknown")):  # bearings
        with pytest.raises(BaseError):
            refuses(pose, **calls[2], img_sigma=1.0)


@pytest.mark.parametrize(("n", "outliers"), [(12, 0), (20, 5)])
def test_covariances_from_the_weights_of_the_shipped_network(n, outliers):
    """The mean normalised squared errors are those of chi-square: 6 for the pose, 3 for each half."""
    p = SyntheticProblems(n=n, batch_size=2000, seed=9, outliers=OutlierMix(count=outliers), dtype=DOUBLE).batch(0)
    noise = {"img_sigma": 1.0, "world_sigma": 0.05}
    result = create_solver("pnpnet-set").double()(*p[:3], **noise)
    covariance = pose_covariance(result.pose, *p[:3], **noise, weights=result.weights)
    error = torch.cat((tangent(result.rotation @ p.pose.rotation.mT), result.translation - p.pose.translation), -1)
    for part, freedom, tolerance in ((slice(0, 6), 6.0, 0.06), (slice(0, 3), 3.0, 0.1), (slice(3, 6), 3.0, 0.1)):
        squares = (error[:, part] * torch.linalg.solve(covariance[:, part, part], error[:, part])).sum(-1)
        assert squares.mean().item() == pytest.approx(freedom, rel=tolerance)


@pytest.mark.parametrize(("n", "img_sigma", "world_sigma"), [(20, 1.0, 0.05), (50, 2.0, 0.0), (30, 0.0, 0.02)])
def test_noise_that_nobody_gave_is_that_of_the_residuals(n, img_sigma, world_sigma):
    options = {"n": n, "batch_size": 500, "seed": 10, "dtype": DOUBLE}
    p = SyntheticProblems(img_sigma=img_sigma, world_sigma=world_sigma, **options).batch(0)
    result = create_solver("pnpnet-set").double()(*p[:3])
    error = torch.cat((tangent(result.rotation @ p.pose.rotation.mT), result.translation - p.pose.translation), -1)
    for known in ({"world_sigma": world_sigma}, {}):
        covariance = result.covariance(*p[:3], **known)
        squares = (error * torch.linalg.solve(covariance, error)).sum(-1)[result.ok]
        assert squares.mean().item() == pytest.approx(6.0, rel=0.33)
    alone = PnPResult(*(x[0] if isinstance(x, torch.Tensor) else x for x in result))
    torch.testing.assert_close(alone.covariance(*(x[0] for x in p[:3])), covariance[0])


@pytest.mark.parametrize("along", [True, False])
def test_noise_of_pixels_beside_known_noise_of_points_is_the_likeliest(along, generator):
    """Points move along their rays, which moves no pixel, or only one of them moves, by 100 px. Two have no weight."""
    p = SyntheticProblems(n=50, batch_size=200, seed=3, img_sigma=1.0, world_sigma=0.0, dtype=DOUBLE).batch(0)
    ray, first = normalize(p.true_cam_points, dim=-1) @ p.pose.rotation, torch.eye(50, dtype=DOUBLE)[0].expand(200, 50)
    draws = torch.randn(200, 50, 3, generator=generator, dtype=DOUBLE)
    points = p.world_points + (0.5 * draws[..., :1] * ray if along else first[..., None] * draws)
    known = {"world_cov": 0.25 * ray[..., None] * ray[..., None, :]} if along else {"world_sigma": first}
    weights = torch.ones(200, 50, dtype=DOUBLE).index_fill(1, torch.tensor([1, 2]), 0.0)
    found = shown_noise(p.pose, points, p.img_points, p.intrinsics, weights, **known)["img_sigma"]
    assert (found.median() - 1.0).abs() < 0.1 < found.min()


@pytest.mark.parametrize("case", [Case("epnp-lm", noise="sigma"), Case("epnp-lm", noise="covariance", extra="prior")])
def test_gradients(case):
    call, pose = make(case, 1)
    call |= {"pose": pose, "weights": torch.linspace(0.1, 0.9, PAIRS, dtype=DOUBLE)[None]}
    gradcheck_by_size(pose_covariance, call, atol=1e-6)


def test_an_unknown_focal_length_is_that_of_the_result(make_problems):
    """The solver's call may give any focal length; the covariance of the pose is not computed with it."""
    p = make_problems(n=20, batch=3)
    nominal = p.intrinsics / torch.tensor([3400.0, 3400.0, 1.0]).double()[:, None]
    result = create_solver("p3p-ransac", focal="unknown")(*p[:2], nominal, img_sigma=1.0)
    assert result.ok.all()
    noise = {"img_sigma": 1.0, "focal": "unknown"}
    expected = pose_covariance(result.pose, *p[:2], result.intrinsics, **noise, weights=result.inliers.double())
    assert expected.isfinite().all()
    torch.testing.assert_close(result.covariance(*p[:2], nominal, **noise, weights=None, dist=None), expected)
    assert pose_covariance(result.pose, *p[:2], nominal, **noise).diagonal(dim1=1, dim2=2).isinf().all()


def test_a_prior_adds_its_information(make_problems):
    p = make_problems(n=8, batch=5)
    pose = Pose(p.pose.rotation, p.pose.translation - (p.pose.rotation @ torch.full((3,), 100.0, dtype=DOUBLE)))
    information = torch.diag(torch.tensor([1e3, 2e3, 3e3, 4.0, 5.0, 6.0], dtype=DOUBLE)).expand(5, 6, 6)
    given = pose, p.world_points + 100.0, *p[1:3]  # in the frame of the caller, not of the centroid
    alone = pose_covariance(*given, img_sigma=1.0)
    found = pose_covariance(*given, img_sigma=1.0, prior=PosePrior(pose, information))
    torch.testing.assert_close(torch.linalg.inv(found), torch.linalg.inv(alone) + information, rtol=1e-6, atol=1e-3)


def problems(n=9, batch=4, outliers=0, **options):
    """Problems with covariances of ratio 5, seen by a camera with a skew and two focal lengths."""
    options = {"axis_ratio": 5.0, "known_noise": 1.0, "img_sigma": 10.0, "dtype": DOUBLE, "seed": 3, **options}
    p = SyntheticProblems(n=n, batch_size=batch, outliers=OutlierMix(count=outliers), **options).batch(0)
    change = CAMERA[:2, :2] @ torch.diag(1.0 / p.intrinsics[0].diagonal()[:2])
    img = p.img_points @ change.mT + CAMERA[:2, 2]
    return p._replace(img_points=img, img_cov=change @ p.img_cov @ change.mT, intrinsics=CAMERA.expand(batch, 3, 3))


def least_squares(m=30, **options):
    options = {"robustness": 0.0, "reject_worse": False, "learnable": False, **options}
    return PnPNet(None, RobustWeightedLM(m, **options))


def whitened(p, pose):
    """The Jacobian (B, 2N, 6) by the tangent and the residual (B, 2N), all derivatives by autograd."""

    def total(world):
        return reprojection_errors(p._replace(world_points=world), pose).sum((0, 1))

    residual = reprojection_errors(p, pose)
    jacobian = derivative(lambda x: reprojection_errors(p, x.pose).flatten(1), State.of(pose))
    by_point = torch.autograd.functional.jacobian(total, p.world_points).movedim(0, 2)  # (B, N, 2, 3)
    covariance = p.img_cov + by_point @ p.world_cov @ by_point.mT
    whiten = torch.linalg.inv(torch.linalg.cholesky(covariance))
    return (whiten @ jacobian.unflatten(1, (-1, 2))).flatten(1, 2), (whiten @ residual[..., None]).flatten(1)


def test_poses_covariances_and_weights_are_those_of_a_dense_solver():
    p = problems()
    result = least_squares()(*p[:3], init=p.pose, **p.known)
    robust = least_squares(kernel="cauchy", robustness=3.0)(*p[:3], init=p.pose, **p.known)
    covariance = pose_covariance(result.pose, *p[:3], **p.known)
    pose = p.pose
    for _ in range(30):
        jacobian, residual = whitened(p, pose)
        pose = retract(pose, -torch.linalg.lstsq(jacobian, residual[..., None]).solution[..., 0])
    torch.testing.assert_close(result.rotation, pose.rotation, rtol=0, atol=1e-9)
    torch.testing.assert_close(result.translation, pose.translation, rtol=0, atol=1e-7)
    torch.testing.assert_close(covariance, torch.linalg.inv(jacobian.mT @ jacobian), rtol=1e-6, atol=1e-12)
    _, residual = whitened(p, robust.pose)
    distance = residual.unflatten(1, (-1, 2)).square().sum(-1)
    torch.testing.assert_close(robust.weights, 1.0 / (1.0 + distance / 9.0), rtol=1e-6, atol=0)
    sigma = torch.linspace(0.01, 0.1, 36, dtype=DOUBLE).view(4, 9)  # of isotropic covariances
    noises = {"world_sigma": sigma}, {"world_cov": sigma.square()[..., None, None] * torch.eye(3, dtype=DOUBLE)}
    torch.testing.assert_close(*(pose_covariance(p.pose, *p[:3], img_cov=p.img_cov, **x) for x in noises))


def test_exact_points_and_exact_pixels_are_sound():
    p, exact = problems(batch=20, world_sigma=0.0), torch.zeros(20, 9, 3, 3, dtype=DOUBLE, requires_grad=True)
    result = create_solver("pnpnet-set")(*p[:3], img_cov=p.img_cov, world_cov=exact)
    assert result.ok.all()
    assert torch.autograd.grad(result.rotation.sum(), exact)[0].isfinite().all()
    flat = torch.diag(torch.tensor([1.0, 0.0], dtype=DOUBLE)).expand_as(p.img_cov)  # exact in the vertical
    result = create_solver("epnp-lm")(*p[:3], img_cov=flat, world_cov=problems(batch=20).world_cov)
    assert result.matrix.isfinite().all()
    assert result.ok.double().mean() > 0.9


def test_covariances_reach_the_bound_and_sigmas_do_not():
    p = problems(n=20, batch=1500, outliers=6, world_sigma=0.02)
    solver, sigmas = create_solver("pnpnet-set"), {"img_sigma": 10.0 * 30.0 / 113.0, "world_sigma": 0.02}
    found = KnownInliersAndNoise().solve_with_truth(p), solver(*p[:3], **p.known), solver(*p[:3], **sigmas)
    errors = [torch.stack(list(pose_errors(x.pose, p.pose))).median(1).values for x in found]
    assert (errors[1] < 1.05 * errors[0]).all()
    assert (errors[2] > 1.15 * errors[0]).all()


@pytest.mark.parametrize("sigmas", [{}, {"img_sigma": 0.5}, {"img_sigma": 0.5, "world_sigma": 0.002}])
def test_the_likelihood_is_that_of_the_covariances(sigmas):
    """Laplace's approximation, exact in the limit: the density of the covariance at the mode."""
    p = problems(n=60, img_sigma=0.5, world_sigma=0.002)
    given = {name: torch.full((4, 60), x, dtype=DOUBLE) for name, x in sigmas.items()} or p.known
    mode = least_squares()(*p[:3], init=p.pose, **given).pose
    known = {"world_sigma": 0.0, **given} if "img_sigma" in given else given
    expected = 0.5 * torch.logdet(2.0 * math.pi * pose_covariance(mode, *p[:3], **known))
    torch.manual_seed(0)
    noise = {name: x.clone().requires_grad_() for name, x in given.items()}
    loss = monte_carlo_pose_loss(mode, mode, *p[:3], **noise, samples=2000, kernel="truncated", scale=1e3)
    assert_same(loss, expected, atol=0.1)
    for gradient in torch.autograd.grad(loss.sum(), list(noise.values())):
        assert gradient.isfinite().all()
        assert (gradient != 0).any()


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float32, 1e-3), (DOUBLE, 1e-6)])
def test_gaussian_maps_have_their_mean_and_covariance(dtype, atol):
    """The covariance of a density that is constant in cells: that of the samples and of a cell."""
    mean = torch.tensor([30.3, 20.6], dtype=DOUBLE)
    covariance = torch.tensor([[9.0, 3.0], [3.0, 4.0]], dtype=DOUBLE)
    v, u = torch.meshgrid(torch.arange(48, dtype=DOUBLE), torch.arange(64, dtype=DOUBLE), indexing="ij")
    offset = torch.stack((u, v), -1) - mean
    logits = -0.5 * (offset @ torch.linalg.inv(covariance) * offset).sum(-1)
    pixels, found = heatmap_keypoints(logits.to(dtype).expand(2, 3, -1, -1))
    expected = covariance + torch.eye(2) / 12.0
    torch.testing.assert_close(pixels, mean.to(dtype).expand(2, 3, 2), atol=atol, rtol=0.0)
    torch.testing.assert_close(found, expected.to(dtype).expand(2, 3, 2, 2), atol=atol, rtol=0.0)


def test_means_are_kornias_and_a_stride_is_each_cell_as_a_block_of_pixels(generator):
    """A cell that covers 3 by 3 pixels is the same density as 9 cells of a third of its share."""
    heatmaps = torch.randn(2, 3, 5, 6, generator=generator, dtype=DOUBLE)
    pixels, _ = heatmap_keypoints(heatmaps, 0.5)
    torch.testing.assert_close(pixels, spatial_soft_argmax2d(heatmaps, 0.5, normalized_coordinates=False))
    blocks = heatmaps.repeat_interleave(3, -1).repeat_interleave(3, -2)
    torch.testing.assert_close(heatmap_keypoints(heatmaps, stride=3.0), heatmap_keypoints(blocks))
    heatmaps = torch.randn(1, 2, 4, 5, generator=generator, dtype=DOUBLE)
    heatmaps = heatmaps.masked_fill(heatmaps < -1.0, -torch.inf).requires_grad_()  # logarithms of the probability 0
    temperature = torch.tensor([[[[0.7]], [[1.3]]]], dtype=DOUBLE, requires_grad=True)
    assert gradcheck(heatmap_keypoints, (heatmaps, temperature))


@pytest.fixture
def seen(random_rotations, generator):
    """Points, the pose of a camera, and their pixels and depth in it."""
    points = torch.randn(2, 7, 3, generator=generator, dtype=DOUBLE)
    pose = Pose(random_rotations(2), torch.tensor([[0.3, -0.2, 6.0], [0.1, 0.4, 8.0]], dtype=DOUBLE))
    cam = transform_points(pose.matrix, points)
    return points, pose, conversions.convert_points_from_homogeneous(cam @ CAMERA.mT), cam[..., 2]


def test_exact_measurements_give_exact_points(seen):
    points, pose, pixels, depth = seen
    found, covariance = depth_points(pixels, depth, CAMERA, pose, depth_sigma=0.0)
    torch.testing.assert_close(found, points)
    assert not covariance.any()
    img_cov = (4.0 * torch.eye(2, dtype=DOUBLE)).expand(2, 7, 2, 2)
    one = depth_points(pixels, depth, CAMERA, pose, depth_sigma=0.1, img_sigma=2.0)
    other = depth_points(pixels, depth, CAMERA, pose, depth_sigma=torch.full((2,), 0.1), img_cov=img_cov)
    torch.testing.assert_close(one, other)


def test_covariances_of_points_are_those_of_samples(seen, generator):
    _, pose, pixels, depth = seen
    sigma = (0.4 * depth[:, :1]).expand(2, 7)
    factor = torch.tensor([[30.0, 0.0], [20.0, 40.0]], dtype=DOUBLE)
    img_cov = (factor @ factor.mT).expand(2, 7, 2, 2)
    points, covariance = depth_points(pixels, depth, CAMERA, pose, depth_sigma=sigma, img_cov=img_cov)
    drawn_pixels = pixels + torch.randn(40000, *pixels.shape, generator=generator, dtype=DOUBLE) @ factor.mT
    drawn_depth = depth + sigma * torch.randn(40000, *depth.shape, generator=generator, dtype=DOUBLE)
    rays = conversions.convert_points_to_homogeneous(drawn_pixels) @ torch.linalg.inv(CAMERA).mT
    offset = (drawn_depth[..., None] * rays - pose.translation[:, None]) @ pose.rotation - points
    sampled = torch.einsum("sbni,sbnj->bnij", offset, offset) / len(offset)
    size = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    torch.testing.assert_close(offset.mean(0) / size, torch.zeros_like(points), atol=0.03, rtol=0.0)
    correlation = size[..., None] * size[..., None, :]
    torch.testing.assert_close(sampled / correlation, covariance / correlation, atol=0.05, rtol=0.0)


def test_gradients_of_points(seen):
    _, pose, pixels, depth = seen
    camera, sigma = CAMERA.clone(), torch.full((1, 2), 0.2, dtype=DOUBLE)
    img_cov = torch.eye(2, dtype=DOUBLE).expand(1, 2, 2, 2).clone()
    given = (pixels[:1, :2], depth[:1, :2], camera, pose.rotation[:1], pose.translation[:1], sigma, img_cov)
    given = tuple(x.clone().requires_grad_() for x in given)

    def points(pixels, depth, camera, rotation, translation, sigma, img_cov):
        pose = Pose(rotation, translation)
        return depth_points(pixels, depth, camera.triu(), pose, depth_sigma=sigma, img_cov=img_cov)

    assert gradcheck(points, given)


def test_missing_depth_is_nan_and_can_be_masked(seen):
    _, pose, pixels, depth = seen
    depth = depth.clone()
    depth[0, 1], depth[0, 2], depth[0, 3] = 0.0, torch.nan, torch.inf
    sigma = torch.full((2, 7), 0.01, dtype=DOUBLE)
    sigma[0, 4] = -1.0
    points, covariance = depth_points(pixels, depth, CAMERA, pose, depth_sigma=sigma, img_sigma=0.5)
    good = torch.ones(2, 7, dtype=torch.bool)
    good[0, 1:5] = False
    assert torch.equal(points.isfinite().all(-1), good)
    assert torch.equal(covariance.isfinite().all((-2, -1)), good)
    call = {"world_points": points, "img_points": pixels, "intrinsics": CAMERA, "world_cov": covariance}
    solver = create_solver("epnp-lm")
    assert solver(**call).ok.tolist() == [False, True]
    assert solver(**call, mask=good).ok[1]


def test_a_matrix_that_is_no_rotation_is_replaced_by_the_nearest(generator):
    pixels, depth = torch.rand(2, 5, 2, generator=generator), 1.0 + torch.rand(2, 5, generator=generator)
    camera, here = torch.eye(3), Pose(torch.eye(3).expand(2, 3, 3), torch.ones(2, 3))
    found = depth_points(pixels, depth, camera, here._replace(rotation=1.1 * here.rotation), depth_sigma=0.1)
    torch.testing.assert_close(found, depth_points(pixels, depth, camera, here, depth_sigma=0.1))
    mirrored = depth_points(pixels, depth, camera, here._replace(rotation=-here.rotation), depth_sigma=0.1)
    assert all(x.isnan().all() for x in mirrored)
