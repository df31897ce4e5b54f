"""Laws of P3P: all solutions and nothing else; of RANSAC: samples, scores, and that pose and inliers are found."""

import itertools
import math

import pytest
import torch
from helpers import are_rotations, finite
from torch.testing import assert_close

from kornia_pnpnet import MLPInit, Normalize, PnPNet, Pose, PosePrior, RobustWeightedLM, create_solver, pose_errors
from kornia_pnpnet.core.trees import map_tensors, pairs_at
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.data.draws import random_poses
from kornia_pnpnet.judge.inliers import Thresholds, judge
from kornia_pnpnet.problem import Hypotheses, Problem, State
from kornia_pnpnet.propose.epnp import EPnP
from kornia_pnpnet.propose.minimal import SubsetSolver
from kornia_pnpnet.propose.p3p import P3P, p3p
from kornia_pnpnet.propose.p3p_rig import P3PRig
from kornia_pnpnet.propose.ransac import RANSAC
from kornia_pnpnet.propose.sampling import Samples, agreement_of_neighbours, draw, samples_needed
from kornia_pnpnet.propose.scoring import SCORERS, Scene, as_entries
from kornia_pnpnet.propose.search import Search
from kornia_pnpnet.refine.residual import project
from kornia_pnpnet.refine.terms import CameraTerm, PoseTerm

DTYPES = (torch.float64, torch.float32)
NEAR = 1e-6


def rotations(batch, seed):
    return random_poses(batch, torch.Generator().manual_seed(seed), max_angle=math.pi).rotation


def seen(cam_points, generator):
    """World points and plane points of points in the camera frame, and the pose, which is anywhere."""
    rotation = rotations(len(cam_points), seed=77)
    translation = torch.randn(len(cam_points), 3, generator=generator, dtype=torch.float64)
    world_points = (cam_points - translation[:, None]) @ rotation
    return world_points, cam_points[..., :2] / cam_points[..., 2:], Pose(rotation, translation)


def wide(batch, seed=0):
    """A field of view of 90 degrees, depths from 0.1 to 10."""
    generator = torch.Generator().manual_seed(seed)
    xy, z = torch.rand(batch, 3, 3, generator=generator, dtype=torch.float64).split((2, 1), -1)
    return seen(torch.cat((2.0 * xy - 1.0, torch.ones_like(z)), -1) * (0.1 + 9.9 * z), generator)


def protocol(batch, seed=0):
    exact = {"img_sigma": 0.0, "world_sigma": 0.0, "dtype": torch.float64}
    p = SyntheticProblems(n=3, batch_size=batch, seed=seed, **exact).batch(0)
    return p.world_points, p.img_points / p.intrinsics[:, :1, :1], p.pose


def tele(batch, seed=0):
    """Points around one that is a hundred times as far away."""
    generator = torch.Generator().manual_seed(seed)
    centre = torch.tensor([20.0, -10.0, 100.0], dtype=torch.float64)
    return seen(centre + torch.randn(batch, 3, 3, generator=generator, dtype=torch.float64), generator)


SCENES = {"wide": wide, "protocol": protocol, "tele": tele}


def errors(found, pose):
    """Largest error of an entry of the rotation plus relative error of the translation, (B, S), infinite if invalid."""
    rotation = (found.pose.rotation - pose.rotation[:, None]).abs().amax((-1, -2))
    translation = (found.pose.translation - pose.translation[:, None]).norm(dim=-1)
    return torch.where(found.valid, rotation + translation / pose.translation.norm(dim=-1)[:, None], torch.inf)


def in_camera(found, world_points):
    """The points in the camera frame of each solution, (B, S, 3, 3)."""
    return torch.einsum("bsij,bnj->bsni", found.pose.rotation, world_points) + found.pose.translation[:, :, None]


def reprojection_errors(found, world_points, plane_points, rig=None):
    """The largest error of each valid solution; infinite behind the camera."""
    cam_points = in_camera(found, world_points)
    if rig is not None:
        cam_points = torch.einsum("bnij,bsnj->bsni", rig.rotation, cam_points) + rig.translation[:, None]
    error = (cam_points[..., :2] / cam_points[..., 2:] - plane_points[:, None]).norm(dim=-1).amax(-1)
    return torch.where((cam_points[..., 2] > 0).all(-1), error, torch.inf)[found.valid]


def assert_same_solutions(found, expected, tolerance=NEAR):
    """Each solution of one is a solution of the other."""
    assert torch.equal(found.valid.sum(-1), expected.valid.sum(-1))
    matrix, other = (torch.cat((h.pose.rotation, h.pose.translation[..., None]), -1) for h in (found, expected))
    apart = (matrix[:, :, None] - other[:, None]).abs().amax((-1, -2))  # (B, S, S)
    apart = torch.where(expected.valid[:, None], apart, torch.inf)
    assert (apart.amin(-1)[found.valid] < tolerance).all()


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_the_true_pose_is_among_the_solutions_and_all_of_them_are_solutions(scene):
    world_points, plane_points, pose = scene(20_000)
    found = p3p(world_points, plane_points)
    assert (errors(found, pose).amin(-1) < NEAR).all()
    assert (reprojection_errors(found, world_points, plane_points) < 1e-9).all()
    rotation = found.pose.rotation[found.valid]
    assert (rotation @ rotation.mT - torch.eye(3)).abs().max() < 1e-11
    assert (torch.linalg.det(rotation) > 0).all()


def test_there_are_one_to_four_solutions_and_no_two_are_the_same():
    found = p3p(*wide(20_000)[:2])
    counts = torch.bincount(found.valid.sum(-1))
    assert counts[0] == 0
    assert (counts[1:] > 100).all()
    apart = (found.pose.rotation[:, :, None] - found.pose.rotation[:, None]).abs().amax((-1, -2))
    apart = torch.where(found.valid[:, :, None] & found.valid[:, None] & ~torch.eye(4, dtype=torch.bool), apart, 1.0)
    assert apart.min() > NEAR


def test_order_frame_and_unit_of_the_points_do_not_matter(generator):
    world_points, plane_points, _ = wide(5000)
    expected = p3p(world_points, plane_points)
    for order in ((1, 2, 0), (1, 0, 2), (2, 1, 0)):
        assert_same_solutions(p3p(world_points[:, order], plane_points[:, order]), expected)
    turn, shift = rotations(5000, seed=1), torch.randn(5000, 3, generator=generator, dtype=torch.float64)
    for scale in (1e-12, 1e12):
        found = p3p(scale * (world_points @ turn.mT + shift[:, None]), plane_points)
        # x_cam = R' s (Q x + c) + t' is s times R' Q x + R' c + t' / s
        rotation = found.pose.rotation @ turn[:, None]
        moved = (found.pose.rotation @ shift[:, None, :, None])[..., 0] + found.pose.translation / scale
        assert_same_solutions(Hypotheses(Pose(rotation, moved), found.valid), expected)


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_symmetric_scene_whose_cubic_has_its_roots_at_zero_and_infinity(dtype):
    # An equilateral triangle seen from its axis: one pose upright, and three poses from the side.
    angle = torch.tensor([0.0, 2.0, 4.0], dtype=dtype) * math.pi / 3.0
    world_points = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), -1)[None]
    cam_points = world_points + torch.tensor([0.0, 0.0, 4.0], dtype=dtype)
    found = p3p(world_points, cam_points[..., :2] / cam_points[..., 2:])
    assert found.valid.all()
    upright = Pose(torch.eye(3, dtype=dtype)[None], torch.tensor([[0.0, 0.0, 4.0]], dtype=dtype))
    assert errors(found, upright).min() < 100.0 * torch.finfo(dtype).eps
    assert (found.pose.rotation[..., 2, 2] < 0.99).sum() == 3


@pytest.mark.parametrize("offset", [0.0, 1e-12, 1e-6])
def test_two_solutions_that_meet_are_not_lost(offset, generator):
    # They meet where the camera is on the cylinder upright on the circle through the points.
    angles = 2.0 * math.pi * torch.rand(5000, 4, generator=generator, dtype=torch.float64)
    circle = torch.stack((angles.cos(), angles.sin(), torch.zeros_like(angles)), -1)
    centre = circle[:, 3] + torch.tensor([offset, 0.0, 2.0])
    axis3 = torch.nn.functional.normalize(-centre, dim=-1)
    axis1 = torch.nn.functional.normalize(torch.linalg.cross(circle[:, 0].roll(1, -1) + 0.1, axis3), dim=-1)
    rotation = torch.stack((axis1, torch.linalg.cross(axis3, axis1), axis3), -2)
    cam_points = (circle[:, :3] - centre[:, None]) @ rotation.mT
    edges = (circle[:, :3] - circle[:, :3].roll(1, 1)).norm(dim=-1).amin(-1)
    cam_points = cam_points[edges > 0.2]  # short edges would lose digits
    world_points, plane_points, pose = seen(cam_points, generator)
    found = p3p(world_points, plane_points)
    assert found.valid.any(-1).all()
    assert (errors(found, pose).amin(-1) < 1e-5).all()
    assert (errors(found, pose).amin(-1) < NEAR).double().mean() > 0.98
    assert (reprojection_errors(found, world_points, plane_points) < 1e-9).all()


@pytest.mark.parametrize("unit", [2.0**-90, 2.0**90])
@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_single_precision_solves_what_it_can(scene, unit):
    world_points, plane_points, pose = scene(20_000)
    found = p3p(unit * world_points.float(), plane_points.float())
    assert found.pose.rotation.dtype == torch.float32
    finite(found)
    error = (found.pose.rotation - pose.rotation[:, None]).abs().amax((-1, -2))
    error = torch.where(found.valid, error, torch.inf).amin(-1)
    assert error.quantile(0.5) < 1e-5
    assert error.quantile(0.99) < 1e-3
    assert (error < 0.01).double().mean() > 0.999
    assert (found.valid.sum(-1) == p3p(world_points, plane_points).valid.sum(-1)).double().mean() > 0.99


@pytest.mark.parametrize("base", [0.0, 0.3, 3.0])
@pytest.mark.parametrize("looks", ["ahead", "everywhere"])
def test_three_pairs_of_a_rig(base, looks, generator):
    world_points, plane_points, pose = wide(5000)
    turns = rotations(15_000, seed=5).view(5000, 3, 3, 3) if looks == "everywhere" else torch.eye(3).double()
    rig = Pose(turns.expand(5000, 3, 3, 3), base * torch.randn(5000, 3, 3, generator=generator, dtype=torch.float64))
    in_camera_of_pair = in_camera(Hypotheses(Pose(*(x[:, None] for x in pose)), None), world_points)[:, 0]
    in_rig = (rig.rotation.mT @ (in_camera_of_pair - rig.translation)[..., None])[..., 0]
    world_points = (in_rig - pose.translation[:, None]) @ pose.rotation
    found = P3PRig().hypotheses(Problem.of(world_points, plane_points, rig=rig))
    assert (errors(found, pose).amin(-1) < NEAR).double().mean() > 0.95
    gap = reprojection_errors(found, world_points, plane_points, rig)
    assert (gap < 1e-3).all()
    assert (gap < 1e-9).double().mean() > 0.98


@pytest.mark.parametrize("dtype", DTYPES)
def test_numbers_that_make_no_sense_have_finite_solutions(dtype):
    values = torch.tensor([0.0, -1.0, 1e30, torch.inf, -torch.inf, torch.nan])
    points = [x.to(dtype) for x in wide(36)[:2]]
    points[0][:, 0, 0], points[1][:, 1, 1] = values.repeat(6), values.repeat_interleave(6)
    found = p3p(*points)
    are_rotations(found.pose.rotation[found.valid])
    finite(found)


#: Thresholds for the noise of the protocol: 1 px and 0.05 m.
PROTOCOL = {"threshold": 6.0, "world_threshold": 0.3}


@pytest.mark.parametrize("chances", [[0.5, 0.2, 0.0, 0.2, 0.1], [0.2] * 5 + [0.0]], ids=["unequal", "equal"])
@pytest.mark.parametrize("size", [1, 3])
def test_items_are_drawn_by_their_chances_and_none_twice(size, chances, generator):
    draws, upper = 40000, torch.tensor(chances, dtype=torch.float64).cumsum(-1)[None]
    subsets = draw(torch.rand(draws, size, generator=generator, dtype=torch.float64), upper)[0]
    likely = [i for i, chance in enumerate(chances) if chance]
    for order in itertools.permutations(likely, size):
        drawn = [chances[i] for i in order]
        expected = math.prod(chance / (1 - sum(drawn[:i])) for i, chance in enumerate(drawn))
        seen = (subsets == torch.tensor(order)).all(-1).double().mean().item()
        assert abs(seen - expected) < 4 * math.sqrt(expected / draws), order
    assert torch.isin(subsets, torch.tensor(likely)).all()
    assert (subsets.sort(-1).values.diff(dim=-1) > 0).all()


def test_neighbours_of_inliers_agree(generator):
    flat = 6.0 * torch.rand(2, 200, 2, generator=generator, dtype=torch.float64)
    points = torch.cat((flat, 8.0 + flat.sin().sum(-1, keepdim=True)), -1)
    pixels = points[..., :2] / points[..., 2:]
    pixels[:, 40:] = torch.rand(2, 160, 2, generator=generator, dtype=torch.float64) * pixels.amax(1)[:, None]
    likely = agreement_of_neighbours(points, pixels, torch.ones(2, 200, dtype=torch.bool)).topk(20, dim=1).indices
    assert (likely < 40).double().mean() > 0.7  # 0.2 by chance


@pytest.mark.parametrize(("pairs", "size"), [(3, 3), (9, 7), (12, 4)])
def test_enumeration_has_every_subset_once(pairs, size):
    samples, total = Samples(torch.ones(2, pairs), size=size, most=1000, seed=0), math.comb(pairs, size)
    assert samples.totals.tolist() == [total, total]
    positions = samples.positions(torch.tensor([1, 0]), 0, total)
    assert sorted(map(tuple, positions[0].tolist())) == list(itertools.combinations(range(pairs), size))
    assert torch.equal(positions[0], positions[1])
    parts = [samples.positions(torch.tensor([1]), i, min(i + 5, total)) for i in range(0, total, 5)]
    assert torch.equal(torch.cat(parts, 1)[0], positions[0])


def test_only_pairs_with_a_weight_are_drawn(generator):
    there = torch.rand(20, 30, generator=generator) < torch.linspace(0.2, 0.8, 20)[:, None]
    there[:, :3] = True
    samples = Samples(there.double(), size=3, most=200, seed=0)
    assert 0 < (samples.totals < 200).sum() < 20, "some are enumerated"
    positions = samples.positions(torch.arange(20), 0, 200)
    assert there[torch.arange(20)[:, None, None], positions].all()
    assert (positions.sort(-1).values.diff(dim=-1) > 0).all()


@pytest.mark.parametrize(("name", "outliers"), [("pnpnet-set", 60), ("p3p-ransac", 45)])
def test_even_garbage_has_one_answer_alone_and_in_every_order_of_its_pairs(name, outliers):
    drawn = SyntheticProblems(n=60, batch_size=20, seed=3, outliers=OutlierMix(count=outliers)).batch(0)
    world, img, intrinsics = inputs = drawn[:3]
    solver, order = create_solver(name), torch.randperm(60, generator=torch.Generator().manual_seed(0))
    first, second = solver(*inputs), solver(world[:, order], img[:, order], intrinsics)
    same = pose_errors(second.pose, first.pose).rotation_error_deg < 1.0
    assert same.double().mean() > 0.9  # 0.35 if samples are drawn by the places of the pairs
    alone = torch.cat([solver(*(x[i : i + 1] for x in inputs)).rotation for i in range(20)])
    assert ((alone - first.rotation).abs().amax((1, 2)) < 1e-3).double().mean() > 0.98


@pytest.mark.parametrize("size", [3, 7])
def test_the_number_of_samples_has_the_confidence(size):
    count = 9
    for inliers, confidence in itertools.product(range(count + 1), (0.5, 0.9999)):
        subsets = list(itertools.combinations(range(count), size))
        share = sum(max(subset) < inliers for subset in subsets) / len(subsets)
        needed = samples_needed(torch.tensor([inliers]), torch.tensor([count]), size, confidence).item()
        if 0.0 < share < 1.0:
            assert 1.0 - (1.0 - share) ** needed == pytest.approx(confidence)
        else:
            assert needed == (0.0 if share else math.inf)
    assert samples_needed(torch.tensor([0]), torch.tensor([0]), size, 0.999).item() == math.inf


@pytest.mark.parametrize("of_pairs", [False, True])
@pytest.mark.parametrize("in_world", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_errors_without_division_are_the_textbooks(of_pairs, in_world, dtype, make_problems, perturb):
    p = make_problems(9, 7, outliers=2)
    problem, frame = Normalize(order=False)(*p[:3])
    truth = frame.apply(p.pose)
    poses = [perturb(truth, angle=0.3 * i, shift=0.4 * i, seed=i) for i in range(10)]
    tau = torch.linspace(5.0, 50.0, 7, dtype=torch.float64)[:, None]
    omega = tau / 500 * in_world
    tau = tau * torch.linspace(0.2, 3.0, 9, dtype=torch.float64) if of_pairs else tau
    thresholds = Thresholds(tau, omega)
    entries = torch.stack([pose.matrix[:, :3].flatten(1) for pose in poses], -1)
    errors = Scene.of(problem, thresholds, dtype).errors(entries.to(dtype)).double()  # (P, N, H)
    behind = 0
    for h, pose in enumerate(poses):
        cam = problem.world_points @ pose.rotation.mT + pose.translation[:, None]
        depth = cam[..., 2]
        sq_residual = (problem.focal * cam[..., :2] / depth[..., None] - problem.img_points).square().sum(-1)
        limit = tau.square() + (problem.focal * omega / depth).square()
        expected = sq_residual / limit
        usual = (depth > 0) & (expected < 1e5)
        behind += (depth <= 0).sum().item()
        assert (errors[..., h][depth <= 0] >= 1.0).all()
        torch.testing.assert_close(errors[..., h][usual], expected[usual], rtol=2e-3, atol=1e-3)
        if dtype == torch.float64:
            judged = judge(project(State.of(pose), problem), problem, thresholds)
            torch.testing.assert_close(judged.errors[usual], errors[..., h][usual], rtol=1e-9, atol=1e-9)
            weights = torch.where((expected < 1.0) & (depth > 0), tau.square() / limit, 0.0)
            torch.testing.assert_close(judged.weights, weights, rtol=1e-9, atol=1e-9)
    assert behind > 10  # the test has seen them


def solver(minimal=None, **options):
    return PnPNet(RANSAC(P3P() if minimal is None else minimal, **options), RobustWeightedLM(m=0, robustness=0))


@pytest.mark.parametrize(("n", "outliers", "scorer"), [(10, 4, "msac"), (50, 20, "inliers"), (200, 80, "msac")])
def test_exact_recovery_among_outliers(n, outliers, scorer, make_problems):
    problems = make_problems(n, 20, outliers=outliers, noise=False)
    result = solver(threshold=1.0, scorer=scorer)(*problems[:3])
    assert max(x.max() for x in pose_errors(result.pose, problems.pose)) < 1e-9
    assert result.ok.all()
    # An outlier may fall on the right place by chance; an inlier is never missed.
    assert (result.weights > 0)[problems.inliers].all()
    assert ((result.weights > 0) & ~problems.inliers).double().mean() < 0.01


def test_an_unknown_focal_length_changes_neither_priors_nor_samples(make_problems):
    problem = Normalize(order=False)(*make_problems(7, 5, noise=False)[:3])[0].map(torch.Tensor.contiguous)
    one, two = torch.ones_like(problem.weights[:, 0]), 2.0 * problem.focal.expand(5)
    free = problem._replace(free_focal=CameraTerm(two, None, one, two))
    solver = SubsetSolver(EPnP(), RobustWeightedLM(3, learnable=False), size=7)
    assert_close(solver.hypotheses(free).pose, solver.hypotheses(problem).pose)
    pose, prior = solver.hypotheses(problem).pose, torch.eye(6, dtype=torch.float64).expand(5, 6, 6)
    prior = PosePrior(map_tensors(lambda x: x[:, 0], pose), prior)
    term, _ = PoseTerm.of(prior, torch.zeros_like(problem.world_points[:, 0]), one)
    scene = Scene.of(free._replace(pose_terms=(term,)), Thresholds(one[:, None], 0.0 * one[:, None]), torch.float64)
    entries = as_entries(pose).mT * torch.tensor([1.0] * 8 + [2.0] * 4).double()[:, None]
    assert_close(*(x.losses(entries, SCORERS["msac"])[0] for x in (scene, scene._replace(terms=()))))


def test_weights_decide_between_two_poses(make_problems):
    one, other = make_problems(9, 20, noise=False, seed=1), make_problems(9, 20, noise=False, seed=2)
    camera = (one.world_points @ other.pose.rotation.mT + other.pose.translation[:, None])[:, 5:]
    pixels = one.img_points.clone()
    pixels[:, 5:] = 3400.0 * camera[..., :2] / camera[..., 2:]
    net = solver(threshold=1.0)
    for heavy, pose in ((1.0, one.pose), (1.5, other.pose)):
        weights = torch.ones(20, 9, dtype=torch.float64)
        weights[:, 5:] = heavy
        result = net(one.world_points, pixels, one.intrinsics, weights=weights)
        seen = (camera[..., 2] > 1.0).all(-1)  # the other pose has them in front
        assert seen.sum() > 3
        assert pose_errors(result.pose, pose).rotation_error_deg[seen].max() < 1e-6
        assert torch.equal((result.weights > 0).sum(-1)[seen], torch.full((20,), 5 if heavy == 1.0 else 4)[seen])


def test_sound_problems_are_ok_and_pixels_of_no_pose_are_not(make_problems):
    for n, outliers in ((6, 0), (9, 3), (40, 28)):
        assert solver(**PROTOCOL)(*make_problems(n, 100, outliers=outliers)[:3]).ok.double().mean() > 0.97
    for n, options in itertools.product((4, 5, 9, 40), (PROTOCOL, {"threshold": 4.0})):
        mix = OutlierMix(count=n, mismatch_share=0.0)
        problems = SyntheticProblems(n=n, batch_size=100, outliers=mix, dtype=torch.float64).batch(0)
        assert solver(**options)(*problems[:3]).ok.double().mean() <= 0.01


def test_the_gradient_is_that_of_the_result(make_problems, generator):
    """The start is so near the minimum that a constant start costs little."""
    corr, _ = Normalize(order=False)(*make_problems(12, 4, outliers=4)[:3])
    ransac = RANSAC(P3P(), threshold=20.0)
    probe = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    # Without a threshold in the world all inliers weigh 1. The start is found in float32: smaller steps show rounding.
    for name, step in (("img_points", 1e-2), ("world_points", 1e-4), ("weights", 1e-2)):
        value = getattr(corr, name)
        leaf = value.clone().requires_grad_()
        direction = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        guess = ransac(corr._replace(**{name: leaf}))
        assert not guess.weights.requires_grad
        (guess.pose.translation * probe).sum().backward()
        ends = [ransac(corr._replace(**{name: value + s * direction})).pose.translation for s in (step, -step)]
        numeric = ((ends[0] - ends[1]) * probe).sum(-1) / (2 * step)
        torch.testing.assert_close((leaf.grad * direction).flatten(1).sum(-1), numeric, rtol=5e-2, atol=1e-8)


def test_rivals_are_more_accurate_if_the_noise_exceeds_the_threshold():
    noise = {"img_sigma": 6.0, "world_sigma": 0.0, "outliers": OutlierMix(count=12), "dtype": torch.float64}
    problems = SyntheticProblems(n=40, batch_size=100, seed=3, **noise).batch(0)
    ransac = RANSAC(P3P(), threshold=3.0)
    problem, frame = PnPNet(ransac, RobustWeightedLM(m=0)).normalize(*problems[:3])
    limit = 3.0 * problem.img_scale[:, None]
    search = Search(ransac, problem, Thresholds(limit, torch.zeros_like(limit)), finds_rivals=True)
    search.run()
    poses = [frame.undo(search.states(x).pose) for x in (search.poses, search.rivals)]
    assert_close(poses[1].rotation @ poses[1].rotation.mT, torch.eye(3).double().expand(100, 3, 3), rtol=0, atol=1e-12)
    best, rival = (pose_errors(pose, problems.pose).rotation_error_deg.median() for pose in poses)
    assert rival < 0.9 * best


def test_only_doubtful_problems_are_searched(monkeypatch, make_problems):
    monkeypatch.delattr(Search, "run")
    far = Pose(torch.eye(3).double().expand(4, 3, 3), torch.ones(4, 3).double())
    for n, given in itertools.product((9, 40), ({}, {"init": far})):
        world, *rest = make_problems(n, 4, outliers=n // 5)[:3]
        world[1] = torch.nan
        assert create_solver("pnpnet-set")(world, *rest, **given).ok.tolist() == [True, False, True, True]
    with pytest.raises(AttributeError, match="run"):
        create_solver("pnpnet-set")(*make_problems(40, 4, outliers=30)[:3])


def test_tiny_weights_beside_a_prior_count_as_zero(make_problems, perturb):
    p, inf = make_problems(100, 20), torch.full((20,), torch.inf)
    prior = PosePrior(perturb(p.pose, angle=0.05, shift=0.05), 1e3 * torch.eye(6).expand(20, 6, 6), inf)
    few, solver = (torch.arange(100) < 10).double().expand(20, 100), create_solver("pnpnet-set")
    given = {"prior": prior, "img_sigma": 5.0, "world_sigma": 0.05}
    none, tiny = (solver(*p[:3], few + x * (1.0 - few), **given) for x in (0.0, 1e-9))
    assert (tiny.translation - none.translation).norm(dim=1).median() < 1e-3


@pytest.mark.parametrize("weight", [1e-30, 1e-3, 1e30])
def test_a_prior_beside_weights_of_any_unit_does_not_decide_a_search(weight, make_problems):
    p = make_problems(60, 10, outliers=40)
    wrong = PosePrior(make_problems(60, 10, seed=7).pose, torch.eye(6).expand(10, 6, 6))
    ones, solver = torch.ones(10, 60).double(), create_solver("pnpnet-set")
    one, other = (solver(*p[:3], x * ones, prior=wrong) for x in (1.0, weight))
    assert one.ok.sum() > 5
    assert_close(other.matrix, one.matrix)


def test_a_sample_has_no_order(make_problems):
    problem = Normalize(order=False)(*make_problems(7, 5)[:3])[0].map(torch.Tensor.contiguous)
    solver, order = SubsetSolver(MLPInit(7).double(), size=7), torch.randperm(7)
    assert_close(solver.hypotheses(pairs_at(problem, order.expand(5, 7))).pose, solver.hypotheses(problem).pose)
