"""The evidence for a pose: noise, inliers, and whether it is believed; other poses; the diagnosis of usual mistakes."""

import json
import math
from pathlib import Path

import pytest
import torch
from doubtful import INTRINSICS, doubtful
from kornia.core.exceptions import BaseError

from kornia_pnpnet import PnPNet, Pose, Status, create_solver, diagnose, gravity_prior, p3p, pose_errors, success
from kornia_pnpnet.data import CameraProblems, OutlierMix, SyntheticProblems
from kornia_pnpnet.data.draws import random_poses
from kornia_pnpnet.judge.evidence import LAW, LEAST_PROBABILITY, Votes, _leave_a_line, at_pose, evidence, pose_sigma
from kornia_pnpnet.problem import Noise, Problem, State
from kornia_pnpnet.refine.residual import project, rotation_angle
from kornia_pnpnet.refine.terms import CameraTerm

RESULTS = Path(__file__).parents[1] / "docs" / "results"
NAMES = ["pnpnet-set", "epnp-lm", "reppnp-lm", "p3p-ransac"]


def drawn(pairs, outliers, sigma):
    options = {"field_of_view": (90.0, 90.0), "outlier_share": outliers / pairs, "img_sigma": sigma}
    return CameraProblems(n=pairs, batch_size=50, seed=0, dtype=torch.float64, **options).batch(0)


def scene(pairs, outliers, sigma):
    p = drawn(pairs, outliers, sigma)
    return Problem.of(p.world_points, p.img_points - p.intrinsics[:, None, :2, 2], 1000.0), p.pose


def found(problem, pose, known=False):
    votes = Votes.of(problem, torch.full_like(problem.weights[:, :1], float(known)).bool())
    return evidence(at_pose(State.of(pose), problem, votes), problem, votes)


def test_given_noise_is_kept_unless_the_residuals_contradict(make_problems):
    problem, pose = scene(60, 20, 1.0)
    for given, factor in ((1.0, 1.0), (2.0, 1.0), (0.1, 64.0)):
        noise = Noise(torch.full_like(problem.weights, given), torch.zeros_like(problem.weights))
        result = found(problem._replace(noise=noise), pose, known=True)
        assert (result.mixture.variance == factor).all()
        assert 1000.0 * result.sigma.median() == pytest.approx(1.0, rel=0.1)
    # Exact points are found to be exact beside covariances of pixels.
    p, solver = make_problems(50, 20, img_sigma=0.5, world_sigma=0.0), create_solver("pnpnet-set")
    covariances = 0.25 * torch.eye(2).double().expand(20, 50, 2, 2)
    expected, exact = solver(*p[:3], img_sigma=0.5), solver(*p[:3], img_cov=covariances)
    assert (exact.matrix - expected.matrix).abs().amax((1, 2)).median() < 1e-4


def test_evidence_rises_with_pairs_and_falls_with_noise_and_with_an_incorrect_pose(perturb):
    few, many, noisy = (found(*scene(*x)).log_ratio.median() for x in ((10, 2, 1.0), (40, 8, 1.0), (40, 8, 10.0)))
    assert 0.0 < few < noisy < many
    problem, pose = scene(40, 8, 1.0)
    assert (found(problem, perturb(pose, angle=0.35, shift=0.0)).log_ratio < 0).all()


def test_copies_share_one_vote():
    problem, pose = scene(12, 3, 1.0)
    twice = Problem.of(*(x.repeat(1, 2, 1) for x in problem[:2]), 1000.0)
    votes = Votes.of(twice, twice.weights[:, :1] < 0).pairs
    torch.testing.assert_close(votes.sum(1), torch.full((50,), 12.0, dtype=torch.float64))
    torch.testing.assert_close(found(twice, pose).log_ratio, found(problem, pose).log_ratio, rtol=0.1, atol=2.0)
    looks = Pose(random_poses(24, torch.Generator().manual_seed(0)).rotation, torch.zeros(24, 3).double())
    rig = twice._replace(img_points=0.0 * twice.img_points, rig=Pose(*(x.expand(50, *x.shape) for x in looks)))
    assert (Votes.of(rig, twice.weights[:, :1] < 0).pairs == 1.0).all()  # of bearings: each looks elsewhere


def test_copies_of_an_outlier_do_not_fix_the_rotation_about_a_line(generator):
    line = torch.linspace(-1.0, 1.0, 12, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0.0, 0.0]).double()
    world = torch.cat((line, torch.tensor([[0.3, 0.5, 0.2]]).double().expand(3, 3))).expand(50, 15, 3)
    pose = Pose(torch.eye(3).double().expand(50, 3, 3), torch.tensor([0.0, 0.0, 4.0]).double().expand(50, 3))
    seen = 800.0 * world[..., :2] / (world[..., 2:] + 4.0)
    seen = seen + 0.5 * torch.randn(50, 15, 2, generator=generator).double()
    seen[:, 12:] = seen[:, 12:13]
    result = create_solver("pnpnet-set")(world, seen, torch.diag(torch.tensor([800.0, 800.0, 1.0])), init=pose)
    assert result.inliers[:, 12:].any()
    assert not result.ok.any()


@pytest.mark.parametrize("length", [0.3, 1.0, 10.0, 1000.0])
def test_a_far_point_does_not_make_a_line_a_solid(length, random_rotations, generator):
    rods = torch.randn(200, 9, 3, generator=generator).double() * torch.tensor([1.0, 1e-3, 1e-3])
    rods[:, 0] *= torch.tensor([1.0, 1e3, 1e3]) * length
    solids = torch.randn(200, 9, 3, generator=generator).double()
    pose = Pose(random_rotations(200), torch.tensor([0.0, 0.0, 30.0]).double().expand(200, 3))
    there, sigma = torch.ones(200, 9).bool(), torch.full((200,), 1e-3)
    problems = [Problem.of(points, points[..., :2], 1.0) for points in (rods, solids)]
    rod, solid = (_leave_a_line(project(State.of(pose), x), x, there, sigma) for x in problems)
    assert rod.double().mean() < 0.03
    assert solid.all()


@pytest.mark.parametrize("information", [None, 5.0])
def test_an_unknown_focal_length_has_any_nominal_value(information):
    p = CameraProblems(n=12, batch_size=4, seed=0, dtype=torch.float64).batch(0)
    zoom, one = torch.tensor([[-1.0], [0.0], [0.5], [1.2]]).double(), torch.ones(4).double()
    pixels = (p.img_points - p.intrinsics[:, None, :2, 2]) / p.intrinsics[:, :1, :1]
    term = CameraTerm(one, None if information is None else information * one, one, one)
    sigmas = []
    for now, factor in ((zoom, zoom.exp()), (0.0 * zoom, torch.ones_like(zoom))):
        problem = Problem.of(p.world_points, pixels * factor[..., None], free_focal=term)
        precision = torch.ones_like(problem.weights) / factor**2
        sigmas.append(pose_sigma(project(State(p.pose, now), problem), problem, precision))
    torch.testing.assert_close(*sigmas)


def test_the_frame_of_a_rig_is_free():
    problem, pose = scene(12, 0, 1.0)
    eye, sigmas = torch.eye(3).double().expand(50, 12, 3, 3), []
    for shift in torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 50.0]]).double():
        moved, rig = State.of(Pose(pose.rotation, pose.translation - shift)), Pose(eye, shift.expand(50, 12, 3))
        rigs = problem._replace(rig=rig)
        sigmas.append(pose_sigma(project(moved, rigs), rigs, torch.ones_like(problem.weights)))
    torch.testing.assert_close(*sigmas)


@pytest.mark.parametrize("name", ["pnpnet-set", "p3p-ransac", "epnp-lm", "pnpnet-n20"])
def test_doubtful_poses_are_not_ok_and_right_poses_of_tags_are(name):
    for kind in doubtful(100, seed=41):
        pairs = kind.world_points.shape[1]
        if (name.endswith("n20") and pairs != 20) or (pairs < 4):
            continue
        result = create_solver(name)(kind.world_points, kind.img_points, INTRINSICS, **kind.given)
        turn = torch.full((100,), torch.inf)
        if kind.truth is not None:
            turn = pose_errors(result.pose, kind.truth).rotation_error_deg
        most = 0.4 if kind.name.startswith("20 pairs") else 0.05  # 20 pairs of a wrong convention often fit some pose
        assert (result.ok & (turn > 10.0)).double().mean() <= most, kind.name
        if kind.name.startswith("tag of 20") and name == "p3p-ransac":  # the mirror image of bearings, too
            rays = torch.nn.functional.pad(kind.img_points, (0, 1), value=1.0) @ INTRINSICS.inverse().mT
            rays = create_solver(name)(kind.world_points, rays, INTRINSICS)
            assert (rays.ok & (pose_errors(rays.pose, kind.truth).rotation_error_deg > 10.0)).double().mean() <= 0.05
        if kind.name.startswith(("tag of 100", "tag of 400", "2 tags")) and name != "epnp-lm":
            assert result.ok[turn < 2.0].double().mean() >= 0.85, kind.name
            assert result.inliers[turn < 2.0].double().mean() > 0.98, kind.name


@pytest.mark.parametrize("sigma", [0.1, 1.0, 6.0, 24.0])
@pytest.mark.parametrize("outliers", [0, 60])
@pytest.mark.parametrize("name", ["pnpnet-set", "p3p-ransac"])
def test_the_noise_and_the_inliers_are_those_of_the_data(name, sigma, outliers):
    p = drawn(100, outliers, sigma)
    solver = create_solver(name, **({"threshold": 4.0 * sigma} if name == "p3p-ransac" else {}))
    result = solver(*p[:3])
    assert result.sigma.median() == pytest.approx(sigma, rel=0.1 if sigma < 20.0 else 0.2)
    assert result.inliers[p.inliers].double().mean() > 0.98
    assert not outliers or result.inliers[~p.inliers].double().mean() < 0.1


@pytest.mark.parametrize("sigmas", [{}, {"img_sigma": 1.0, "world_sigma": 0.05}], ids=["unknown", "given"])
@pytest.mark.parametrize("effort", ["fixed", "adaptive"])
def test_probability_tells_sound_problems_from_random_pixels(effort, sigmas):
    """Who searches longer finds better poses by chance, none of which is ``ok``."""
    sound = SyntheticProblems(n=20, batch_size=200, seed=3).batch(0)
    random = sound._replace(img_points=sound.img_points.roll(1, 0))  # the pixels of another problem
    solver = create_solver("pnpnet-set", effort=effort)
    found, wrong = (solver(*x[:3], **sigmas) for x in (sound, random))
    assert found.probability.median() > 0.99
    assert wrong.probability.median() < 0.3
    assert not wrong.ok.double().mean() > 0.02


def test_probability_is_observed_as_often():
    p = SyntheticProblems(n=12, batch_size=1500, seed=5, outliers=OutlierMix(max_ratio=0.8)).batch(0)
    result = create_solver("pnpnet-set")(*p[:3])
    depth = p.true_cam_points[..., 2].median(1).values
    found, true = (-(x.rotation.mT @ x.translation[..., None])[..., 0] for x in (result.pose, p.pose))  # centres
    near = pose_errors(result.pose, p.pose).rotation_error_deg <= 10
    near &= (found - true).norm(dim=-1) <= 0.3 * depth
    sure = result.probability >= LEAST_PROBABILITY
    assert near[sure].double().mean() > 0.95
    assert near[~sure].double().mean() < near[sure].double().mean() - 0.2


def test_a_result_prints_anywhere(make_problems):
    p = make_problems()
    result = create_solver("epnp-lm")(*(x.to("meta") for x in p[:3]))
    assert repr(result)
    assert repr(result._replace(sigma=None))
    single = create_solver("epnp-lm")(*(x[0] for x in p[:3]))
    torch.func.vmap(lambda x: (repr(single._replace(sigma=x)), x)[1])(torch.ones(2))


def test_the_law_is_that_of_the_results_file_and_close_to_a_new_fit():
    made = json.loads((RESULTS / "probability.json").read_text())
    assert list(LAW) == made["law"]
    grid = torch.cartesian_prod(torch.ones(1), torch.arange(-10.0, 16.0))
    chance, fitted = (grid @ torch.tensor([LAW, made["fitted"]]).mT).sigmoid().unbind(1)
    assert (chance - fitted)[chance > LEAST_PROBABILITY].abs().max() < 0.015


def test_noise_whose_covariance_has_no_float32_determinant_harms_its_problem_only():
    p = SyntheticProblems(n=12, batch_size=3, seed=5, dtype=torch.float32).batch(0)
    solver, sigma = create_solver("pnpnet-set"), torch.full((3, 12), 0.1)
    noise = {"img_cov": torch.eye(2).expand(3, 12, 2, 2), "world_sigma": sigma}
    expected = solver(*p[:3], **noise)
    sigma[1] = 1e9
    found = solver(*p[:3], **noise)
    assert found.ok.tolist() == [True, False, True]
    assert torch.equal(found.matrix[::2], expected.matrix[::2])


def boards(generator, batch=60, tilt=40.0, sigma=0.0, dtype=torch.float64):
    """A board of nine points, tilted, from far away: its mirror image projects to almost the same pixels."""
    side = torch.linspace(-0.1, 0.1, 3, dtype=dtype)
    world = torch.cat((torch.cartesian_prod(side, side), torch.zeros(9, 1, dtype=dtype)), 1).expand(batch, 9, 3)
    azimuth, x, y = torch.rand(3, batch, generator=generator, dtype=dtype)
    azimuth = 2.0 * math.pi * azimuth
    axis = torch.stack((azimuth.cos(), azimuth.sin(), 0.0 * azimuth), -1) * math.radians(tilt)
    pose = Pose.from_rvec(axis, torch.stack((0.5 * x, 0.5 * y, 2.5 + x), -1))
    camera = torch.tensor([[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]], dtype=dtype)
    seen = (world @ pose.rotation.mT + pose.translation[:, None]) @ camera.mT
    noise = sigma * torch.randn(batch, 9, 2, generator=generator, dtype=dtype)
    return world, seen[..., :2] / seen[..., 2:] + noise, camera.expand(batch, 3, 3), pose


def answers(result):
    found = result.alternatives
    others = [Pose(*x) for x in zip(found.rotation.unbind(1), found.translation.unbind(1), strict=True)]
    return [result.pose, *others], [torch.ones_like(result.ok), *found.valid.unbind(1)]


@pytest.mark.parametrize("name", NAMES)
def test_the_right_pose_of_a_board_is_among_them(name, generator):
    *given, pose = boards(generator, sigma=0.7)
    result = create_solver(name)(*given, alternatives=2)
    found, (poses, valid) = result.alternatives, answers(result)
    right = torch.stack([success(pose_errors(x, pose), 15.0, 0.3) for x in poses]) & torch.stack(valid)
    assert right.any(0).double().mean() > max(0.9, right[0].double().mean())
    assert found.rotation.shape == (60, 2, 3, 3)
    there = found.valid
    assert there[:, 0].double().mean() > 0.5
    assert (there[:, 0] | ~there[:, 1]).all()
    assert (found.probability[:, 1] <= found.probability[:, 0])[there[:, 1]].all()
    assert ((found.probability > 0) == there).all()
    assert (found.probability.sum(1) < 1).all()
    assert torch.equal(found.rotation[~there], torch.eye(3, dtype=torch.float64).expand(int((~there).sum()), 3, 3))
    for other, is_there in zip(poses[1:], valid[1:], strict=True):
        assert (pose_errors(other, result.pose).rotation_error_deg > 1.9)[is_there].all()


def test_a_pose_is_not_believed_beside_its_mirror_image(generator):
    *given, pose = boards(generator, batch=1000, sigma=0.7, dtype=torch.float32)
    believed = {}
    for effort in ("fixed", "adaptive"):
        result = create_solver("pnpnet-set", effort=effort)(*given)
        error = pose_errors(result.pose, pose).rotation_error_deg
        believed[effort] = result.ok[error > 10.0].double().mean(), result.ok[error < 5.0].double().mean()
        assert (result.status[~result.ok] != 0).all()
        assert (result.probability[result.ok] >= LEAST_PROBABILITY).all()
    assert believed["fixed"][0] > 0.5
    assert believed["adaptive"][0] < 0.5
    assert believed["adaptive"][1] > 0.7


def test_a_board_seen_from_the_front(generator):
    """The mirror image is often no minimum; the tilt is then as uncertain as the image says."""
    *given, pose = boards(generator, batch=200, tilt=8.0, sigma=1.0)
    options = {"img_sigma": 1.0, "world_sigma": 0.0, "alternatives": 1}
    result = create_solver("pnpnet-set")(*given, **options)
    poses, (_, valid) = answers(result)
    assert valid.double().mean() > 0.6
    first, other = (pose_errors(x, pose).rotation_error_deg < 8.0 for x in poses)
    assert (first | (other & valid)).double().mean() > first.double().mean() + 0.1
    # The line of sight to the middle stays where it is.
    seen = [(x.rotation @ given[0].mean(1)[..., None])[..., 0] + x.translation for x in (poses[1], pose)]
    angle = torch.nn.functional.cosine_similarity(*seen, dim=-1)[valid].clamp(max=1.0).acos()
    assert (angle < math.radians(0.3)).all()
    # An unknown focal length, expected 1.5 times too long, gives the alternatives of the found one.
    camera = given[2] * given[2].new_tensor([[1.5, 1.0, 1.0], [1.0, 1.5, 1.0], [1.0, 1.0, 1.0]])
    found = create_solver("pnpnet-set", focal="unknown", focal_sigma=0.5)(*given[:2], camera, **options)
    known = create_solver("pnpnet-set")(*given[:2], found.intrinsics, **options)
    both = found.alternatives.valid & known.alternatives.valid
    assert (found.alternatives.cost / known.alternatives.cost)[both].log().abs().median() < 1e-6


def test_the_solutions_of_three_pairs(make_problems):
    problems = make_problems(n=3, batch=50, noise=False)
    plane = (problems.img_points - problems.intrinsics[:, None, :2, 2]) / problems.intrinsics[:, None, [0, 1], [0, 1]]
    every, valid = p3p(problems.world_points, plane)
    result, other = (create_solver(x)(*problems[:3], alternatives=3) for x in ("pnpnet-set", "p3p-ransac"))
    assert (torch.cat((result.status, other.status)) == Status.NOT_BELIEVED).all()
    seen = torch.zeros_like(valid)
    for pose, there in zip(*answers(result), strict=True):
        for i in range(4):
            errors = pose_errors(Pose(every.rotation[:, i], every.translation[:, i]), pose)
            seen[:, i] |= there & success(errors, 3.0, 0.05 * pose.translation.norm(dim=-1))
    assert (seen | ~valid).double().mean() > 0.95


def test_gravity_chooses_between_mirror_images(generator):
    *given, pose = boards(generator, batch=300, tilt=40.0, sigma=1.0)
    down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand(300, 3)
    prior = gravity_prior(down, (pose.rotation @ down[..., None])[..., 0], 0.05)
    known = {"prior": prior, "img_sigma": 1.0, "world_sigma": 0.0}
    result, more = (create_solver("pnpnet-set")(*given, **known, alternatives=number) for number in (0, 1))
    assert (more.alternatives.probability < 0.1).double().mean() > 0.9
    close = pose_errors(result.pose, pose).rotation_error_deg < 10.0
    assert close.double().mean() > 0.98
    assert result.ok[close].double().mean() > 0.9


@pytest.mark.parametrize("name", NAMES)
def test_none_where_the_pairs_say_enough(name, make_problems):
    problems = make_problems(n=50, batch=20)
    solver = create_solver(name, **({"threshold": 20.0} if name == "p3p-ransac" else {}))
    expected, result = solver(*problems[:3]), solver(*problems[:3], alternatives=3)
    assert expected.alternatives.valid.shape == (20, 0)
    assert not result.alternatives.valid.any()
    assert torch.equal(result.matrix, expected.matrix)


def test_padding_bad_problems_and_gradients(generator):
    world, img, camera, _ = boards(generator, batch=6, sigma=1.0)
    solver = create_solver("pnpnet-set")
    whole = solver(world, img, camera, alternatives=2)
    padded = [torch.nn.functional.pad(x, (0, 0, 0, 3)) for x in (world, img)]
    masked = solver(*padded, camera, mask=(torch.arange(12) < 9).expand(6, 12), alternatives=2)
    assert whole.alternatives.valid[:, 0].any()
    broken = img.clone()
    broken[1, 0, 0] = torch.nan
    bad = solver(world, broken, camera, alternatives=2)
    keep = [0, 2, 3, 4, 5]
    for other in (bad.alternatives.rotation, masked.alternatives.rotation):
        torch.testing.assert_close(other[keep], whole.alternatives.rotation[keep], atol=1e-6, rtol=0)
    with pytest.raises(BaseError, match="alternatives"):
        solver(world, img, camera, alternatives=-1)
    gradients = []
    for alternatives in (0, 2):
        pixels = img.clone().requires_grad_()
        result = solver(world, pixels, camera, alternatives=alternatives)
        gradients.append(torch.autograd.grad(result.translation.sum(), pixels)[0])
    assert torch.equal(*gradients)
    assert gradients[0].any()
    assert not result.alternatives.rotation.requires_grad


def test_a_pose_that_its_mirror_image_has_beaten_is_a_rival_too(generator):
    pairs = boards(generator, batch=64, sigma=1.0)[:3]
    best = create_solver("pnpnet-set")(*pairs, alternatives=1)
    refiner = PnPNet(None, create_solver("pnpnet-set").refine).eval()
    mirrored = Pose(best.alternatives.rotation[:, 0], best.alternatives.translation[:, 0])
    one, other = (refiner(*pairs, init=pose) for pose in (best.pose, mirrored))
    same = best.alternatives.valid[:, 0] & (rotation_angle(one.rotation, other.rotation) < 0.02)
    assert same.sum() > 40
    assert (one.probability - other.probability)[same].abs().max() < 0.2


CENTRE = torch.tensor([330.0, 235.0])
SIZE = torch.tensor([640.0, 480.0])
FLIPS = {"flip y", "mirror the world"}


def camera(focal=800.0, centre=CENTRE):
    return torch.tensor([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])


def observed(outliers=10, batch=()):
    generator = torch.Generator().manual_seed(40)
    pixels = torch.rand(*batch, 40, 2, generator=generator) * SIZE
    z = 4.0 + 4.0 * torch.rand(*batch, 40, 1, generator=generator)
    pose = Pose.from_rvec(torch.tensor([[0.3, -0.4, 0.9]]), torch.tensor([[0.2, 0.3, 6.0]]))
    points = (torch.cat(((pixels - CENTRE) / 800.0, torch.ones_like(z)), -1) * z - pose.translation) @ pose.rotation[0]
    pixels = pixels + 0.5 * torch.randn(pixels.shape, generator=generator)
    pixels[..., :outliers, :] = pixels[..., :outliers, :].roll(1, -2)
    return points, pixels, Pose(*(x[0].expand(*batch, *x.shape[1:]) for x in pose))


def changes(found):
    return {trial.change for trial in found.best}


UP, Z = torch.tensor([1.0, -1.0]), torch.tensor([1.0, -1.0, 1.0])
#: What was done to points, pixels and camera, and the changes that may be named.
MISTAKES = {
    "none": (lambda x, u: (x, u, camera()), {"as given"}),
    "wrong scale": (lambda x, u: (1e3 * x, u, 2.0 * camera()), {"as given"}),
    "swapped": (lambda x, u: (x, u.flip(-1), camera()), {"swap u and v"}),
    "y up": (lambda x, u: (x, SIZE * torch.tensor([0.0, 1.0]) + UP * u, camera()), FLIPS),
    "left-handed": (lambda x, u: (x * Z, u, camera()), FLIPS),
    "no centre": (lambda x, u: (x, u, camera(centre=0.0 * CENTRE)), {"set the principal point to half the image size"}),
    "centred pixels": (lambda x, u: (x, u - CENTRE, camera()), {"set the principal point to 0"}),
    "focal length too long": (lambda x, u: (x, u, camera(1600.0)), {"halve the focal length"}),
    "focal length too short": (lambda x, u: (x, u, camera(400.0)), {"double the focal length"}),
    "smaller image": (lambda x, u: (x, u / 2.0, camera()), {"halve the intrinsics (resized image)"}),
    "larger image": (lambda x, u: (x, 2.0 * u, camera()), {"double the intrinsics (resized image)"}),
    "plane": (lambda x, u: (x, (u - CENTRE) / 800.0, camera()), {"multiply normalised coordinates by the intrinsics"}),
}


@pytest.mark.parametrize("name", MISTAKES)
@pytest.mark.parametrize("batch", [(), (2, 1)], ids=str)
def test_the_mistake_is_named(name, batch):
    points, pixels, _ = observed(batch=batch)
    spoil, expected = MISTAKES[name]
    found = diagnose(*spoil(points, pixels))
    assert changes(found) <= expected
    (best, *_) = found.best
    assert best.agree == pytest.approx(0.75, abs=0.06)
    assert best.sigma < 1.5


def test_a_given_pose_is_tried_as_its_inverse():
    points, pixels, pose = observed()
    inverse = Pose(pose.rotation.mT, -(pose.rotation.mT @ pose.translation))
    other = Pose(torch.eye(3), torch.tensor([0.0, 0.0, 6.0]))
    for given, expected in ((pose, "as given"), (inverse, "invert the pose"), (other, "find another pose")):
        assert changes(diagnose(points, pixels, camera(), pose=given)) == {expected}
    assert changes(diagnose(points * Z, pixels, camera(), pose=pose)) <= FLIPS


def test_random_pairs_have_no_diagnosis():
    points, pixels, _ = observed(outliers=40)
    shuffled = pixels[torch.randperm(40, generator=torch.Generator().manual_seed(0))]
    assert diagnose(points, shuffled, camera()).best == diagnose(points, pixels, torch.zeros(3, 3)).best == ()
