"""Distorted pixels, fisheyes, bearings in every direction, and rigs of several cameras with one pose."""

import math

import cv2
import pytest
import torch
from kornia.core.exceptions import BaseError
from kornia.geometry.calibration import distort_points, undistort_points
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, convert_points_to_homogeneous
from kornia.geometry.linalg import inverse_transformation, transform_points
from laws import distorted
from torch.nn import functional

from kornia_pnpnet import Noise, PnPNet, Pose, PosePrior, create_solver, pose_covariance, pose_errors, solve_pnp
from kornia_pnpnet.cameras import bearing_cameras, bearings, undistort
from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.data import CameraProblems
from kornia_pnpnet.evaluation.bounds import KnownInliersAndNoise
from kornia_pnpnet.likelihood import monte_carlo_pose_loss
from kornia_pnpnet.losses import SetLoss
from kornia_pnpnet.propose.focal import scale_focal
from kornia_pnpnet.refine.residual import retract

#: Coefficients of Kornia and OpenCV; the models take the first 4, 5, 8, 12 or 14.
DIST = -0.2, 0.05, 0.001, -0.002, 0.01, 0.05, 0.01, 0.002, 0.001, -0.001, 0.002, 0.0005, 0.01, -0.02
DIST = torch.tensor(DIST, dtype=torch.float64)
FISHEYE = torch.tensor([0.05, -0.01, 0.002, -0.0005], dtype=torch.float64)
LENSES = {"dist": DIST[:5], "fisheye": FISHEYE}
RIGS = [("pnpnet-set", 3, 0.25, {}), ("pnpnet-set", 6, 0.25, {"effort": "fixed"}), ("p3p-ransac", 6, 0.25, {})]
RIGS += [("reppnp-lm", 3, 0.0, {})]
CAMERA = torch.tensor([[400.0, 0.0, 320.0], [0.0, 420.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


@pytest.fixture
def uniform(generator):
    return lambda *x, low=-1.0, high=1.0: low + (high - low) * torch.rand(*x, generator=generator, dtype=DIST.dtype)


def seen(uniform, batch, n):
    pixels = torch.stack((uniform(batch, n, low=20, high=620), uniform(batch, n, low=20, high=460)), -1)
    rays = convert_points_to_homogeneous(pixels) @ torch.linalg.inv(CAMERA).mT
    pose = Pose(axis_angle_to_rotation_matrix(uniform(batch, 3)), 2.0 * uniform(batch, 3))
    points = transform_points(inverse_transformation(pose.matrix), rays * uniform(batch, n, 1, low=3.0, high=7.0))
    return points, pixels, pose


def right(result, pose, degrees=0.01, shift=0.001):
    turned, moved = pose_errors(result.pose, pose)
    return (turned < degrees) & (moved < shift) & result.ok


@pytest.mark.parametrize("number", [4, 5, 8, 12, 14])
def test_undistorted_pixels_are_distorted_back_and_kornias(number, uniform):
    """Kornia's fixed-point iteration has the same limit where the distortion is mild."""
    _, pixels, _ = seen(uniform, 3, 50)
    camera, dist = CAMERA.expand(3, 3, 3), DIST[:number].expand(3, -1)
    seen_pixels = distort_points(pixels, camera, dist)
    found, there, *_ = undistort(seen_pixels, camera, dist, None, None)
    assert there.all()
    torch.testing.assert_close(found, pixels, rtol=0, atol=1e-8)
    torch.testing.assert_close(found, undistort_points(seen_pixels, camera, dist, num_iters=200), rtol=0, atol=1e-6)


def test_fisheyes_agree_with_opencv(uniform):
    _, pixels, _ = seen(uniform, 1, 50)
    plane = transform_points(torch.linalg.inv(CAMERA), pixels).reshape(-1, 1, 2).numpy()
    seen_pixels = torch.from_numpy(cv2.fisheye.distortPoints(plane, CAMERA.numpy(), FISHEYE.numpy())).view(1, 50, 2)
    found, there, *_ = undistort(seen_pixels, CAMERA[None], None, FISHEYE[None], None)
    assert there.all()
    torch.testing.assert_close(found, pixels, rtol=0, atol=1e-6)
    rays = bearings(seen_pixels, CAMERA, fisheye=FISHEYE) @ CAMERA.mT
    torch.testing.assert_close(rays[..., :2] / rays[..., 2:], pixels, rtol=0, atol=1e-6)


def test_where_there_is_no_pixel():
    turning = torch.tensor([[-0.3, 0.0, 0.0, 0.0]], dtype=torch.float64)
    for off, dist, fisheye in ((0.9, turning, None), (2.0, None, 0.0 * turning)):  # 2 radians are 115 degrees
        pixels = torch.tensor([[[320.0, 240.0], [320.0 + 400.0 * off, 240.0]]], dtype=torch.float64)
        _, there, *_ = undistort(pixels, CAMERA[None], dist, fisheye, None)
        assert there.tolist() == [[True, False]]


@pytest.mark.parametrize("name", ["pnpnet-set", "p3p-ransac", "epnp-lm"])
@pytest.mark.parametrize("lens", LENSES)
def test_distorted_pixels_are_solved_without_those_that_no_point_has(name, lens, uniform):
    points, pixels, pose = seen(uniform, 8, 12)
    given, solver = {lens: LENSES[lens].expand(8, -1)}, create_solver(name)
    pixels = distorted(pixels, CAMERA.expand(8, 3, 3), **given)
    pixels[:, 0] = 5000.0
    of_each = solver(points, pixels, CAMERA, **given)
    assert right(of_each, pose, 0.1, 0.01).all()
    assert (of_each.weights[:, 0] == 0).all()
    matrices = solve_pnp(points, pixels, CAMERA, solver=solver, **{lens: LENSES[lens]})
    torch.testing.assert_close(matrices, of_each.matrix[:, :3])


@pytest.mark.parametrize("lens", LENSES)
def test_noise_and_an_unknown_focal_length_go_through_the_lens(lens, uniform):
    """By the derivative of distorted pixels; the equivalent sigma has the same mean square."""
    points, _, pose = seen(uniform, 2, 9)
    camera, given = CAMERA.expand(2, 3, 3), {lens: (DIST if lens == "dist" else FISHEYE).expand(2, -1)}

    def pixels(delta):
        zoomed = scale_focal(camera, delta[6].exp())
        cam = transform_points(retract(pose, delta[:6].mT).matrix, points)
        return distorted(transform_points(zoomed, cam[..., :2] / cam[..., 2:]), zoomed, **given)

    zero, cov = torch.zeros(7, 2, dtype=torch.float64), torch.tensor([[2.0, 0.5], [0.5, 1.0]], dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(lambda x: pixels(x).sum(0), zero).permute(3, 0, 1, 2)
    noise = {"img_cov": cov.expand(2, 9, 2, 2), "focal": "unknown"}
    found = pose_covariance(pose, points, pixels(zero), CAMERA, **noise, **given)
    information = (jacobian.mT @ torch.linalg.inv(cov) @ jacobian).sum(1)
    torch.testing.assert_close(found, torch.linalg.inv(information), rtol=1e-6, atol=1e-12)
    one, lenses = torch.ones(2, 9, dtype=torch.float64), (given.get("dist"), given.get("fisheye"))
    *_, scale, found = undistort(pixels(zero), camera, *lenses, Noise(one, one, Symmetric2(one, 0.0 * one, one)))
    torch.testing.assert_close(found.img, (0.5 * (found.img_cov.uu + found.img_cov.vv)).sqrt())
    assert found.img.equal(scale)


@pytest.mark.parametrize("name", ["pnpnet-set", "epnp-lm"])
def test_sigma_is_that_of_the_pixels_of_a_fisheye(name, uniform, generator):
    """Of the caller's, not of undistorted pixels, out to 60 degrees off the axis."""
    angle, around = uniform(300, 40, 1, low=0.0, high=math.radians(60.0)), uniform(300, 40, 1, high=math.pi)
    across = torch.cat((around.cos(), around.sin()), -1) * uniform(300, 40, 1).sign()
    points = torch.cat((angle.sin() * across, angle.cos()), -1) * uniform(300, 40, 1, low=2.0, high=6.0)
    pixels = 400.0 * angle * across + torch.randn(300, 40, 2, generator=generator, dtype=torch.float64)
    camera = torch.diag(torch.tensor([400.0, 400.0, 1.0]))
    for noise, limit in (({}, 0.1), ({"img_sigma": 1.0}, 0.02)):
        result = create_solver(name)(points, pixels, camera, fisheye=0.0 * FISHEYE, **noise)
        assert result.sigma.median().item() == pytest.approx(1.0, abs=limit)
    call = {"world_points": points, "img_points": pixels, "intrinsics": camera, "fisheye": 0.0 * FISHEYE}
    shown, given = (result.covariance(**call, **x).diagonal(dim1=1, dim2=2) for x in ({}, {"img_sigma": 1.0}))
    assert (shown / given).median().item() == pytest.approx(1.0, abs=0.2)


def test_a_rig_of_different_focal_lengths_shows_its_noise():
    """Estimated noise makes poses as accurate as given noise."""
    options = {"cameras": 3, "baseline": 0.5, "outlier_share": 0.25, "field_of_view": (18.0, 100.0)}
    p = CameraProblems(n=40, batch_size=300, seed=0, **options).batch(0)
    solver, noise = create_solver("pnpnet-set"), {"img_sigma": 1.0, "world_sigma": 0.0}
    shown, given = (pose_errors(solver(*p[:3], **p.known | x).pose, p.pose) for x in ({}, noise))
    assert shown.translation_error.median() < 1.04 * given.translation_error.median()


def test_a_prior_is_weighed_against_a_pixel_of_the_fisheye(uniform, generator):
    """60 degrees off the axis, the lens scale is 3.06: a camera with a shorter focal length has the same pixels."""
    around, depth = uniform(50, 40, 1, high=math.pi), uniform(50, 40, 1, low=2.0, high=6.0)
    across = torch.cat((around.cos(), around.sin()), -1) * uniform(50, 40, 1).sign()
    points = depth * torch.cat((math.sin(math.radians(60.0)) * across, torch.full_like(depth, 0.5)), -1)
    pixels = 400.0 * math.radians(60.0) * across + torch.randn(50, 40, 2, generator=generator, dtype=torch.float64)
    angle, short = pixels.norm(dim=-1, keepdim=True) / 400.0, 400.0 / 3.06
    eye, one = torch.eye(6, dtype=torch.float64).expand(50, 6, 6), torch.ones(50, dtype=torch.float64)
    shift = 0.1 * torch.stack((one, 0.0 * one, 0.0 * one), -1)
    prior, solver = PosePrior(Pose(eye[:, :3, :3], shift), 1e4 * eye, math.inf * one), create_solver("epnp-lm")
    camera, shorter = (torch.diag(torch.tensor([f, f, 1.0], dtype=torch.float64)) for f in (400.0, short))
    found = solver(points, pixels, camera, fisheye=0.0 * FISHEYE, prior=prior)
    expected = solver(points, short * angle.tan() / angle * pixels / 400.0, shorter, prior=prior)
    torch.testing.assert_close(found.translation, expected.translation, rtol=0, atol=2e-3)


@pytest.mark.parametrize("signs", [(-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)])
def test_covariances_and_losses_of_negative_focal_lengths(signs, make_problems):
    p, flip = make_problems(batch=3, outliers=2), torch.tensor([*signs, 1.0], dtype=torch.float64)
    reflected = p._replace(img_points=flip[:2] * p.img_points, intrinsics=flip[:, None] * p.intrinsics)
    cov = torch.tensor([[2.0, 0.5], [0.5, 1.0]], dtype=torch.float64).expand(3, 9, 2, 2)
    outcomes = []
    for q, noise in ((p, cov), (reflected, flip[:2, None] * flip[:2] * cov)):
        torch.manual_seed(0)
        img = q.img_points.clone().requires_grad_()
        losses = monte_carlo_pose_loss(q.pose, q.pose, q.world_points, img, q.intrinsics, img_cov=noise)
        (gradient,) = torch.autograd.grad(losses.sum(), img)
        gradient = gradient if q is p else flip[:2] * gradient
        covariance = pose_covariance(q.pose, *q[:3], img_cov=noise, world_sigma=0.05, focal="unknown")
        result, guess = create_solver("pnpnet-set").with_starts(*q[:3], img_sigma=1.0)
        bound = KnownInliersAndNoise().solve_with_truth(q)
        outcomes.append((losses, gradient, covariance, SetLoss()(result, q, 1.0, guess), bound.pose))
    torch.testing.assert_close(*outcomes, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("lens", LENSES)
def test_gradcheck_of_the_lens(lens, uniform):
    _, pixels, _ = seen(uniform, 1, 4)
    given = (DIST[:8] if lens == "dist" else FISHEYE)[None]
    mask = torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=torch.float64)  # of a camera: its free entries

    def by_entries(pixels, camera, given):
        both = (given, None) if lens == "dist" else (None, given)
        return undistort(pixels, camera * mask + CAMERA * (1 - mask), *both, None)[0]

    inputs = [x.clone().requires_grad_() for x in (pixels, CAMERA[None], given)]
    assert torch.autograd.gradcheck(by_entries, inputs, eps=1e-5, atol=1e-4, rtol=1e-4)
    assert torch.autograd.gradgradcheck(by_entries, inputs, eps=1e-5, atol=1e-3, rtol=1e-4)


def test_bearing_cameras_look_along(uniform):
    rays = torch.cat((uniform(1, 100, 3), torch.eye(3)[None].double(), -torch.eye(3)[None].double()), 1)
    rotation, sound = bearing_cameras(rays)
    assert sound.all()
    along = (rotation @ functional.normalize(rays, dim=-1)[..., None])[..., 0]
    torch.testing.assert_close(along, torch.tensor([0.0, 0, 1]).double().expand_as(along))
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).double().expand_as(rotation))
    assert (torch.linalg.det(rotation) > 0.99).all()
    _, sound = bearing_cameras(torch.tensor([[[0.0, 0, 0], [math.nan, 0, 1]]]))
    assert not sound.any()


def everywhere(uniform, batch, n, outliers=0):
    """Points all around, bearings and poses; the first bearings are outliers."""
    cam_points = functional.normalize(uniform(batch, n, 3), dim=-1) * uniform(batch, n, 1, low=3.0, high=7.0)
    pose = Pose(axis_angle_to_rotation_matrix(uniform(batch, 3)), 2.0 * uniform(batch, 3))
    rays = functional.normalize(cam_points, dim=-1)
    rays[:, :outliers] = functional.normalize(uniform(batch, outliers, 3), dim=-1)
    return transform_points(inverse_transformation(pose.matrix), cam_points), rays, pose


@pytest.mark.parametrize("name", ["pnpnet-set", "p3p-ransac", "epnp-lm"])
def test_bearings_in_every_direction(name, uniform):
    points, rays, pose = everywhere(uniform, 32, 20, 0 if name == "epnp-lm" else 6)
    options = {"threshold": 0.01} if name == "p3p-ransac" else {}  # without intrinsics in radians
    result = create_solver(name, **options)(points, 3.0 * rays, None)
    assert right(result, pose, 0.05, 0.01).double().mean() > 0.9
    assert torch.equal(result.intrinsics, torch.eye(3, dtype=torch.float64).expand(32, 3, 3))
    if name != "epnp-lm":
        assert result.weights[:, :6].mean() < 0.05 * result.weights[:, 6:].mean()
    assert right(create_solver(name)(points, rays, CAMERA, img_sigma=0.5), pose, 0.05, 0.01).double().mean() > 0.9


def rig(batch, n, cameras, base, outlier_share=0.0):
    options = {"cameras": cameras, "baseline": base, "outlier_share": outlier_share, "img_sigma": 0.0}
    return CameraProblems(n=n, batch_size=batch, seed=0, dtype=torch.float64, **options).batch(0)


@pytest.mark.parametrize("options", [{}, {"effort": "fixed"}])
@pytest.mark.parametrize("name", ["pnpnet-set", "p3p-ransac", "epnp-lm"])
@pytest.mark.parametrize("camera", ["bearings", 0.0, 0.1, 0.6])
def test_four_pairs_all_around(camera, name, options, uniform):
    """Four bearings in every direction, or one pair in each of four cameras that look to four sides."""
    if camera == "bearings":
        points, rays, pose = everywhere(uniform, 100, 4)
        result = create_solver(name, **options)(points, rays, None)
    else:
        p = rig(100, 4, 4, camera)
        result, pose = create_solver(name, **options)(*p[:3], **p.known), p.pose
    assert right(result, pose, 0.05, 0.01).all()


@pytest.mark.parametrize("base", [0.02, 0.5])
@pytest.mark.parametrize(("name", "cameras", "outlier_share", "options"), RIGS)
def test_rigs(name, cameras, outlier_share, options, base):
    p = rig(32, 24, cameras, base, outlier_share)
    result = create_solver(name, **options)(*p[:3], **p.known)
    assert right(result, p.pose, 0.05, 0.01).double().mean() > 0.95
    torch.testing.assert_close(result.intrinsics, p.intrinsics)
    given = create_solver(name, **options).with_starts(*p[:3], **p.known, img_sigma=1.5, world_sigma=0.0)
    assert torch.equal(given[0].intrinsics, p.intrinsics)
    assert given[1].noise is None or (given[1].noise.img - 1.5).abs().max() < 1e-5
    there, cameras = torch.arange(24) < 20, p.intrinsics.clone()
    cameras[:, ~there] = 0.0
    padded = create_solver(name, **options)(*p[:2], cameras, mask=there.expand(32, -1), **p.known)
    assert padded.intrinsics.isfinite().all()


def test_what_cannot_be_combined_is_refused():
    p = rig(2, 8, 2, 0.1)
    (points, pixels, intrinsics), rigs = p[:3], p.known
    dist, solver = torch.zeros(4, dtype=torch.float64), create_solver("pnpnet-set")
    for call, match in (
        (lambda: solver(points, pixels, intrinsics), "intrinsics"),
        (lambda: solver(points, pixels, intrinsics, dist=dist, **rigs), "bearings"),
        (lambda: solver(points, pixels, CAMERA, dist=torch.zeros(6).double()), "coefficients"),
        (lambda: solver(points, pixels, CAMERA, dist=dist, fisheye=dist), "not both"),
        (lambda: create_solver("pnpnet-set", focal="unknown")(points, pixels, CAMERA, dist=dist), "unknown"),
        (lambda: solver(points, pixels, intrinsics, alternatives=1, **rigs), "alternatives"),
        (lambda: PnPNet()(points, pixels, intrinsics, **rigs), "initialiser"),
        (lambda: solver(points, pixels, None), "intrinsics"),
        (lambda: create_solver("epnp", focal="unknown").with_starts(points, pixels, CAMERA, dist=dist), "unknown"),
        (lambda: bearings(pixels.expand(2, 2, -1, -1), CAMERA.expand(2, 3, 3)), "intrinsics"),
        (lambda: solver(points, pixels, CAMERA, torch.ones(2, 8, 2)), "not for each of u and v"),
        (lambda: solver(points, pixels, CAMERA, init=torch.eye(4)), "init must be a Pose"),
        (lambda: solver(points, pixels, CAMERA, prior=p.pose), "prior must be a PosePrior"),
        (lambda: solver(points, pixels, CAMERA, world_sigma=0.1, world_cov=torch.zeros(2, 8, 3, 3)), "world_sigma or"),
        (lambda: create_solver("opencv-epnp", views=2), "views: for solvers of this package only"),
    ):
        with pytest.raises(BaseError, match=match):
            call()
