"""Synthetic problems of one camera against the protocol, of many cameras, and mixtures; their outliers and points."""

import itertools
import math
from functools import partial

import pytest
import torch
from helpers import assert_counts, assert_normal, assert_same, assert_uniform, make_scene, reprojection_errors
from kornia.core.exceptions import BaseError
from kornia.geometry.conversions import rotation_matrix_to_axis_angle

from kornia_pnpnet import create_solver, data
from kornia_pnpnet.core.trees import iter_tensors, map_tensors
from kornia_pnpnet.data import CameraProblems, DepthMaps, OutlierKind, OutlierMix, SceneProblems, SyntheticProblems

COUNT = 20_000
VIEWS = [data.FacadePoints, data.RoomPoints, data.DrivePoints]
#: Points at the depths 1, 2 and 3.
PLANES = [data.BoxPoints(z_near=z, depth=0.0) for z in (1.0, 2.0, 3.0)]


def draw(n=9, batch=COUNT, **options):
    return SyntheticProblems(n=n, batch_size=batch, seed=7, dtype=torch.float64, **options).batch(0)


def test_poses_are_uniform_in_the_box_in_axis_and_in_angle():
    pose = draw(outliers=OutlierMix()).pose
    assert (torch.corrcoef(pose.translation.T) - torch.eye(3)).abs().max() < 0.03
    vector = rotation_matrix_to_axis_angle(pose.rotation)
    angle = vector.norm(dim=-1)
    assert_uniform(angle, 0.0, math.pi / 2 + 1e-9)
    axis = vector / angle[:, None]
    for coordinate in range(3):  # Archimedes: each coordinate of a uniform direction is uniform
        assert_uniform(pose.translation[:, coordinate], -12.5, 12.5)
        assert_uniform(axis[:, coordinate], -1.0 - 1e-9, 1.0 + 1e-9)
    assert_uniform(torch.atan2(axis[:, 1], axis[:, 0]), -math.pi, math.pi)


def test_points_are_uniform_in_the_box_in_front_of_the_camera():
    p = draw(4, world_sigma=0.0, img_sigma=0.0)
    for axis, (low, high) in enumerate(((-10, 10), (-10, 10), (10, 90))):
        assert_uniform(p.true_cam_points[..., axis], low - 1e-9, high + 1e-9)
    assert reprojection_errors(p).abs().max() < 1e-8
    assert p.inliers.all()
    # The image is exactly the near face of the box.
    assert p.img_points.abs().max() <= 3400 + 1e-6
    camera = torch.diag(torch.tensor([3400.0, 3400, 1], dtype=torch.float64))
    assert torch.equal(p.intrinsics, camera.expand(COUNT, 3, 3))
    assert draw(3, 2, focal=100.0).intrinsics[0, 1, 1] == 100.0


def test_noise_is_normal_with_its_standard_deviation():
    clean, noisy = (draw(9, img_sigma=0.0, world_sigma=sigma) for sigma in (0.0, 0.05))
    assert torch.equal(noisy.img_points, clean.img_points)
    assert_normal(noisy.world_points - clean.world_points, 0.05)
    assert_normal(reprojection_errors(draw(9, world_sigma=0.0, img_sigma=3.0)), 3.0)
    for share in (0.0, 1.0):  # also of outliers
        options = {"outliers": OutlierMix(count=3, mismatch_share=share), "world_sigma": 0.0}
        clean, noisy = (draw(9, 5000, img_sigma=sigma, **options) for sigma in (0.0, 1.0))
        assert_normal((noisy.img_points - clean.img_points)[~clean.inliers], 1.0)


@pytest.mark.parametrize("name", ["img_sigma", "world_sigma"])
def test_noise_from_a_range_is_log_uniform_over_the_problems(name):
    clean = {"img_sigma": 0.0, "world_sigma": 0.0}
    p = draw(4, known_noise=1.0, **{**clean, name: (0.01, 1.0)})
    noise = reprojection_errors(p) if name == "img_sigma" else p.world_points - draw(4, **clean).world_points
    sigma = getattr(p, name)
    assert_normal(noise / sigma[:, None, None], 1.0)
    assert_uniform(sigma.log10(), -2.0 - 1e-9, 1e-9)


def test_a_share_of_problems_comes_with_sigmas():
    p = draw(4, known_noise=0.4, img_sigma=2.0, world_sigma=0.05, translation_sigma=25.0)
    assert_normal(p.pose.translation, 25.0)
    known = [~x.isnan() for x in (p.img_sigma, p.world_sigma)]
    assert (known[0] & known[1]).double().mean().item() == pytest.approx(0.4, abs=0.015)
    for one, other in (known, known[::-1]):
        assert (one & ~other).double().mean().item() == pytest.approx(0.1, abs=0.01)
    assert ((p.img_sigma[known[0]] == 2.0).all(), (p.world_sigma[known[1]] == 0.05).all()) == (True, True)
    assert (set(p.known), draw(4, 2).known) == ({"img_sigma", "world_sigma"}, {})


def test_heavy_tails_keep_the_sigma_of_the_bulk():
    def lengths(degrees):
        p = draw(20, 4000, img_sigma=2.0, world_sigma=0.0, degrees=degrees)
        return reprojection_errors(p).norm(dim=-1) / 2.0, p.inliers

    for degrees in (2.0, 5.0):
        length, inliers = lengths(degrees)
        # The squared length of bivariate Student noise: P(r^2 > x) = (1 + x / degrees)^(-degrees / 2).
        assert_uniform((1 + length.square() / degrees) ** (-degrees / 2), 0.0, 1.0)
        assert torch.equal(inliers, length <= 10.0)
    normal, few, many = (lengths(degrees)[0].flatten() for degrees in (0.0, 2.0, 1000.0))
    assert few.quantile(0.2).item() == pytest.approx(normal.quantile(0.2).item(), rel=0.1)
    assert few.quantile(0.95) > 1.9 * normal.quantile(0.95)
    assert many.quantile(0.95).item() == pytest.approx(normal.quantile(0.95).item(), rel=0.01)


def test_sigmas_of_pairs_are_log_normal_about_that_of_the_problem():
    p = draw(40, 1000, sigma_spread=0.5, known_noise=0.4, img_sigma=2.0, world_sigma=0.01)
    for sigma, middle in ((p.img_sigma, 2.0), (p.world_sigma, 0.01)):
        known = ~sigma.isnan()
        assert torch.equal(known.all(1), known.any(1))
        assert_normal((sigma[known] / middle).log(), 0.5)
    p = draw(200, 500, sigma_spread=(0.1, 1.0), known_noise=1.0, world_sigma=0.0)
    assert_normal(reprojection_errors(p) / p.img_sigma[..., None], 1.0)
    spread = p.img_sigma.log().std(1).log10()
    torch.testing.assert_close(spread.quantile(0.5).item(), -0.5, rtol=0, atol=0.06)


def test_bunched_inliers_lie_together_and_outliers_anywhere():
    mix = OutlierMix(count=60, mismatch_share=1.0)
    area = {}
    for share in (0.0, 0.5, 1.0):
        p = draw(80, 1000, bunched_share=share, outliers=mix, img_sigma=0.0, world_sigma=0.0)
        assert reprojection_errors(p)[p.inliers].abs().max() < 1e-8
        assert (p.inliers.sum(-1) == 20).all()
        pixels = p.img_points[p.inliers].unflatten(0, (-1, 20))
        wrong = p.img_points[~p.inliers].unflatten(0, (-1, 60))
        area[share] = pixels.var(1).prod(-1).sqrt() / wrong.var(1).prod(-1).sqrt()
    assert area[0.0].median().item() == pytest.approx(1.0, abs=0.1)
    assert area[1.0].median() < 0.6
    plain, half, all_of_them = ((x < 0.5).double().mean().item() for x in area.values())
    assert half == pytest.approx((plain + all_of_them) / 2, abs=0.06)


def test_an_image_without_a_size_holds_the_points():
    mix = OutlierMix(count=6, mismatch_share=0.0)
    views = data.FacadePoints(field_of_view=(20.0, 20.0), window=(1.0, 1.0))
    p = draw(60, 200, points=views, half_image=None, outliers=mix, img_sigma=0.0, world_sigma=0.0)
    assert_uniform(p.img_points[~p.inliers] / (3400 * math.tan(math.radians(10.0))), -1.0, 1.0)


KINDS = {"structured_share": 0.5, "mirrored_share": 0.5, "near_share": 0.2, "crowd_share": 0.5}
OPTIONS = {"sigma_spread": (0.1, 1.0), "degrees": (1.5, 9.0), "bunched_share": 0.5, "half_image": None}
SOURCES = [partial(SyntheticProblems, outliers=OutlierMix(max_ratio=0.95, **KINDS), known_noise=1.0, **OPTIONS)]
SOURCES += [partial(CameraProblems, cameras=2), partial(SceneProblems, make_scene(20, 30), outliers=OutlierMix())]


@pytest.mark.parametrize("source", SOURCES)
def test_a_batch_depends_on_seed_and_index_alone(source):
    make = partial(source, n=6, batch_size=5)
    state, first = torch.get_rng_state(), make(seed=3).batch(11)
    assert all(x.isfinite().all() for x in iter_tensors(first))
    assert torch.equal(torch.get_rng_state(), state), "drawing leaves the global generator alone"
    assert_same(make(seed=3).batch(11), first)
    # PyTorch's CPU generator uses 32 bits of its own seed.
    distinct = [make(seed=seed).batch(index) for seed in (0, 1, 2**32, 2**40) for index in (0, 1, 2)]
    for one, two in itertools.combinations(distinct, 2):
        assert not torch.equal(one.world_points, two.world_points)
    for index, batch in enumerate(itertools.islice(make(seed=3), 4)):
        assert_same(batch, make(seed=3).batch(index))


def test_the_stream_is_the_same_in_every_version():
    """Checkpoints are continued, and results compared, on the batches that they began with."""
    options = {"points": data.ObjectPoints(), "outliers": OutlierMix(count=6, near_share=0.3, structured_share=1.0)}
    options |= {"img_sigma": (0.3, 6.0), "world_sigma": (0.001, 0.01), "known_noise": 0.5, "dtype": torch.float64}
    p = SyntheticProblems(n=12, batch_size=2, seed=1, **options).batch(5)
    expected = [23.067263258722, 18.199892259688, 9.537124951628, 303.953631751419, -2612.142990805551]
    expected += [3.971357934598, 0.395595077194, 0.001169390653, 0.001973564060]
    found = torch.cat((p.world_points[1, 11], p.img_points[1, 11], p.img_sigma, p.world_sigma))
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64), rtol=1e-8, atol=0)
    assert p.inliers[1].tolist() == [x == "1" for x in "010011100110"]


def test_confidences_tell_inliers_from_outliers_more_or_less():
    mix = OutlierMix(max_ratio=0.6)
    p = SyntheticProblems(n=100, batch_size=400, seed=3, outliers=mix, confidence_share=0.5).batch(0)
    given = ~p.confidence.isnan()
    assert torch.equal(given.all(-1), given.any(-1))
    assert 0.4 < given.all(-1).double().mean() < 0.6
    areas = []  # under the curve: how often an inlier has the larger confidence
    for confidence, inliers in zip(p.confidence[given.all(-1)], p.inliers[given.all(-1)], strict=True):
        if 10 < inliers.sum() < 90:
            areas.append((confidence[inliers][:, None] > confidence[~inliers]).double().mean().item())
    assert min(areas) < 0.6
    assert max(areas) > 0.95
    assert sum(areas) / len(areas) > 0.75
    assert set(p.known) == {"confidence"}


def test_depth_maps_move_points_along_map_rays_turn_them_together_and_make_outliers_of_flying_pixels():
    maps = partial(DepthMaps, depth_noise=(0.01, 0.011), angle=(1e-9, 2e-9))
    turning = DepthMaps(depth_noise=(1e-9, 2e-9), angle=(0.5, 0.51), flying_share=0.0, maps=1)
    kinds = None, maps(flying_share=0.0), turning
    clean, noisy, turned = (draw(9, world_sigma=0.0, img_sigma=0.0, depth_maps=x) for x in kinds)
    assert noisy.inliers.all()
    moves = (noisy.world_points - clean.world_points).norm(dim=-1)
    distance = clean.true_cam_points.norm(dim=-1)
    near, far = (moves[chosen].square().mean().sqrt() for chosen in (distance < 40, distance > 80))
    assert 2.5 < far / near < 7.0  # about the square of the distances' ratio
    assert abs(draw(9, depth_maps=maps(flying_share=0.2)).inliers.double().mean() - 0.8) < 0.01
    before, after = (torch.cdist(x.world_points, x.world_points) for x in (clean, turned))
    torch.testing.assert_close(before, after, rtol=1e-3, atol=1e-6)
    assert (turned.world_points - clean.world_points).norm(dim=-1).mean() > 0.1


def test_copies_are_whole_pairs_and_leave_eight_originals():
    problems = draw(30, sigma_spread=0.5, known_noise=1.0, confidence_share=1.0, copies_share=1.0)
    distances = partial(torch.cdist, compute_mode="donot_use_mm_for_euclid_dist")
    same_point = distances(problems.world_points, problems.world_points) == 0
    assert 0.2 < (same_point.sum(-1) > 1).double().mean() < 0.6
    for x in (problems.img_points, problems.img_sigma[..., None], problems.confidence[..., None]):
        assert (distances(x, x)[same_point] == 0).all()
    assert (same_point[:, :8, :8].sum(-1) == 1).all()


def counts(mix, n=9):
    return (~draw(n, outliers=mix).inliers).sum(-1).bincount()


def test_the_number_of_outliers_is_uniform_or_exact():
    for n in (9, 20):
        found = counts(OutlierMix(), n)
        assert len(found) == n // 3 + 1
        assert_counts(found)
    found = counts(OutlierMix(min_count=2))
    assert found[:2].tolist() == [0, 0]
    assert_counts(found[2:])
    for count in (0, 3, 9):
        assert counts(OutlierMix(count=count)).tolist() == [0] * count + [COUNT]
    with pytest.raises(BaseError, match=r"10 outliers.*9"):
        counts(OutlierMix(count=10))
    assert all(OutlierMix(max_ratio=0.33).max_count(n) == OutlierMix().max_count(n) == n // 3 for n in range(3, 16))
    assert [OutlierMix().max_count(n) for n in (20, 21, 50, 51)] == [6, 7, 16, 17]
    assert [OutlierMix(max_ratio=0.6, min_inliers=4).max_count(n) for n in (3, 6, 20)] == [0, 2, 12]


@pytest.mark.parametrize("n", [9, 20])
def test_outliers_are_at_random_positions(n):
    two = (~draw(n, outliers=OutlierMix(count=2)).inliers).double()
    assert_counts(two.sum(0))
    # Pairs of positions are as likely as each other: none attracts or repels its neighbour.
    together, expected = two.T @ two / COUNT, 2 / (n * (n - 1))
    assert (together[~torch.eye(n, dtype=torch.bool)] - expected).abs().max() < 4.5 * math.sqrt(expected / COUNT)


def test_kinds_of_outliers_have_their_shares_and_pixels(generator):
    found = OutlierMix(count=3, mismatch_share=0.2).draw(COUNT, 9, generator).flatten().bincount()
    assert found[OutlierKind.INLIER] == 6 * COUNT
    assert_counts(found[[OutlierKind.MISMATCH, OutlierKind.SENSING]], (0.2, 0.8))
    p = draw(9, 5000, outliers=OutlierMix(count=3, mismatch_share=0.0), half_image=10.0, img_sigma=0.0)
    assert_uniform(p.img_points[~p.inliers][:, 0], -10, 10)
    assert_uniform(p.img_points[~p.inliers][:, 1], -10, 10)
    mixes = OutlierMix(count=3, mismatch_share=1.0), None
    p, plain = (draw(9, 5000, outliers=mix, world_sigma=0.0, img_sigma=0.0) for mix in mixes)
    assert reprojection_errors(p)[p.inliers].abs().max() < 1e-8
    assert (reprojection_errors(p)[~p.inliers].norm(dim=-1) > 1.0).double().mean() > 0.999
    # Distributed like the pixels of inliers: the deciles hold a tenth each.
    other = p.img_points[~p.inliers]
    deciles = plain.img_points[..., 0].flatten().quantile(torch.linspace(0.1, 0.9, 9, dtype=torch.float64))
    shares = torch.bucketize(other[:, 0].contiguous(), deciles).bincount(minlength=10) / len(other)
    assert (shares - 0.1).abs().max() < 4 * math.sqrt(0.09 / len(other))


def test_near_outliers_have_distances_in_pixels_beyond_the_noise():
    p = draw(9, 2000, outliers=OutlierMix(count=3, near_share=1.0), world_sigma=0.0)
    off = reprojection_errors(p).norm(dim=-1)
    assert off[p.inliers].max() < 5.5
    assert 1.0 < off[~p.inliers].min() < off[~p.inliers].max() < 55.0
    mix = OutlierMix(count=3, near_share=1.0, near_pixels=(3.0, 30.0))
    off = reprojection_errors(p := draw(9, outliers=mix, world_sigma=0.0, img_sigma=1e-6)).norm(dim=-1)[~p.inliers]
    assert_uniform(off.log(), math.log(3.0) - 1e-5, math.log(30.0) + 1e-5)
    off = reprojection_errors(p := draw(9, 2000, outliers=mix, world_sigma=0.0, img_sigma=5.0)).norm(dim=-1)[~p.inliers]
    assert off.min() > 25 - 4 * 5  # 5 and 10 standard deviations, with noise
    assert off.max() < 50 + 5 * 5


def test_crowds_have_their_share(generator):
    kind = OutlierMix(count=30, crowd_share=0.3).draw(COUNT, 40, generator)
    found = (kind == OutlierKind.CROWD).sum(-1)
    # A uniform share of 30 outliers gives each number from 0 to 30 with the same probability.
    assert_counts(torch.stack(((found == 0).sum(), (found > 0).sum())), (0.7 + 0.3 / 31, 0.3 * 30 / 31))
    assert_counts(found.bincount()[1:].unflatten(0, (10, 3)).sum(-1)[:9])
    assert ((kind == OutlierKind.INLIER).sum(-1) == 10).all()


def test_crowds_share_few_pixels():
    p = draw(40, 2000, outliers=OutlierMix(count=30, crowd_share=1.0, max_crowds=3), world_sigma=0.0)
    alike = (p.img_points[:, :, None] == p.img_points[:, None]).all(-1)  # (B, n, n)
    members = alike.sum(-1)
    first = alike.long().argmax(-1) == torch.arange(40)  # the first pair with its pixel
    pixels = ((members > 1) & first).sum(-1)
    assert pixels.max() == 3
    assert (pixels.bincount()[1:] > 400).all()
    assert 0.01 < (members[p.inliers] > 1).double().mean() < 0.1, "some crowds gather on the pixel of an inlier"
    assert reprojection_errors(p)[p.inliers].norm(dim=-1).max() < 6


def test_crowds_of_a_point_have_many_pixels():
    mix = OutlierMix(count=30, crowd_share=1.0, max_crowds=3, point_crowd_share=0.25)
    p = draw(40, 2000, outliers=mix, world_sigma=0.0)
    points, pixels = (((x[:, :, None] == x[:, None]).all(-1).sum(-1) > 1).any(-1) for x in p[:2])
    assert not (points & pixels).any()
    assert_counts(torch.stack((points.sum(), pixels.sum())), (0.25, 0.75))
    assert reprojection_errors(p)[p.inliers].norm(dim=-1).max() < 6


@pytest.mark.parametrize(("mirrored", "angle"), [(0.0, 0.0), (1.0, 0.0), (0.0, math.pi)])
def test_structured_outliers_agree_on_another_pose_of_the_points_or_of_mirrored_points(mirrored, angle):
    options = {"structured_share": 1.0, "mirrored_share": mirrored, "structured_angle": angle}
    p = draw(24, 50, outliers=OutlierMix(count=6, **options), img_sigma=0.0, world_sigma=0.0)
    six = (~p.inliers).sum(-1) == 6  # a moved point that is not in front of the camera is an outlier as well
    wrong = ~p.inliers[six]
    world, img = (x[six][wrong].unflatten(0, (-1, 6)) for x in (p.world_points, p.img_points))
    agree = []
    for sign in (1.0, -1.0):
        points = world * torch.tensor([sign, 1.0, 1.0], dtype=world.dtype)
        result = create_solver("epnp-lm")(points, img, p.intrinsics[six])
        agree.append((result.ok & (result.cost < 1e-3)).double().mean().item())
    assert agree[int(mirrored)] > 0.5
    assert agree[1 - int(mirrored)] < 0.1


def test_cameras_see_their_points_but_for_outliers_and_fields_of_view_are_uniform():
    options = {"outlier_share": 0.3, "img_sigma": 0.0, "field_of_view": (30.0, 90.0), "dtype": torch.float64}
    problems = CameraProblems(n=10, batch_size=4000, seed=3, **options).batch(0)
    assert (problems.true_cam_points[..., 2] > 0).all()
    assert_uniform(2.0 * torch.atan(1000.0 / problems.intrinsics[:, 0, 0]).rad2deg(), 30.0, 90.0)
    assert (problems.inliers.sum(1) == 7).all()
    error = reprojection_errors(problems).norm(dim=-1)
    assert error[problems.inliers].max() < 1e-6
    assert (error[~problems.inliers] > 1.0).double().mean() > 0.99
    assert problems.inliers.double().mean(0).std() < 0.03  # any place


def test_rigs():
    options = {"cameras": 3, "baseline": 0.2, "img_sigma": 0.0, "dtype": torch.float64}
    problems = CameraProblems(n=8, batch_size=50, seed=3, **options).batch(0)
    rotation, translation = problems.cam_from_rig
    seen = (problems.intrinsics @ problems.true_cam_points[..., None])[..., 0]
    torch.testing.assert_close(seen[..., :2] / seen[..., 2:], problems.img_points)
    assert torch.equal(rotation[:, 0], rotation[:, 3])
    assert not torch.equal(rotation[:, 0], rotation[:, 1])
    centres = -(rotation.mT @ translation[..., None])[..., 0].norm(dim=-1)
    assert (centres.amax(1) / centres.amin(1) - 1).abs().max() < 1e-9


def thinness(points):
    values = torch.linalg.svdvals(points - points.mean(1, keepdim=True))
    return values[:, 2] / values[:, 0]


def test_slabs_and_objects_are_in_view_and_in_front(generator):
    points = data.SlabPoints()(COUNT, 9, generator)
    assert points[..., 2].min() > 1.0
    tangent = points[..., :2] / points[..., 2:]
    assert tangent.abs().max() <= 0.9 + 1e-9
    assert (tangent.amax(1) - tangent.amin(1)).max() / 2 <= 0.8 + 1e-9
    # Thin slabs and deep ones both occur.
    relative_depth = points[..., 2].amax(1) / points[..., 2].amin(1)
    assert (relative_depth < 1.3).double().mean() > 0.05
    assert (relative_depth > 3.0).double().mean() > 0.05
    # Objects are in view, and some are planar.
    points = data.ObjectPoints()(COUNT, 12, generator)
    centre = points.mean(1)
    assert 0.5 < centre[:, 2].min() < centre[:, 2].max() < 41
    assert (thinness(points) < 1e-9).double().mean().item() == pytest.approx(0.15, abs=0.015)


def test_points_behind_the_camera_come_with_outliers():
    def prior(batch_size, n, generator):
        return data.ObjectPoints()(batch_size, n, generator) - torch.tensor([0.0, 0.0, 1.5])

    p = draw(9, 500, points=prior, world_sigma=0.0)
    behind = p.true_cam_points[..., 2] <= 0
    assert behind.any()
    assert not p.inliers[behind].any()
    assert p.img_points.isfinite().all()


@pytest.mark.parametrize("prior", VIEWS)
def test_views_are_in_front_and_fill_a_window_of_their_field_of_view(prior, generator):
    points = prior(field_of_view=(15.0, 120.0), window=(1.0, 1.0))(4000, 60, generator)
    assert (points[..., 2] > 0).all()
    angle = 2 * (points[..., :2] / points[..., 2:]).abs().amax((1, 2)).atan().rad2deg()
    # The widest of 60 points is within a few percent of the edge.
    assert_uniform((angle[angle > 15] - 15).clamp(max=105)[:100], 0, 105)
    points = prior(field_of_view=(90.0, 90.0), window=(0.1, 0.1))(500, 400, generator)
    tangent = points[..., :2] / points[..., 2:]
    area = (tangent.amax(1) - tangent.amin(1)).prod(-1) / 4
    assert 0.09 < area.min() <= area.max() <= 0.1 + 1e-9


def test_surfaces_have_their_shapes(generator):
    view = {"field_of_view": (100.0, 100.0), "window": (1.0, 1.0)}
    facade, room, drive = (prior(**view)(500, 200, generator) for prior in VIEWS)
    # Most façades are one plane with a little relief; a wide view of a room shows several faces.
    assert 0.3 < (thinness(facade) < 0.02).double().mean() < 0.9
    assert (thinness(room) > 0.02).double().mean() > 0.9
    assert room.norm(dim=-1).max() < math.sqrt(15**2 + 15**2 + 5**2)
    assert (drive[..., 2].amax(1) / drive[..., 2].amin(1)).median() > 20
    assert 1.0 < drive[:, :, 1].amax(1).median() < 40.0  # the road is the lowest surface


def mixed(shares=None, **chosen):
    planes = [partial(SyntheticProblems, points=plane, world_sigma=0.0) for plane in PLANES]
    return data.MixedProblems(planes, shares=shares, batch_size=60, seed=7, n=4, dtype=torch.float64, **chosen)


@pytest.mark.parametrize("shares", [(1.0, 1.0, 1.0), (3.0, 1.0, 1.0)])
def test_mixed_sources_have_their_shares_in_every_part_of_a_batch(shares):
    depth = mixed(shares).batch(0).true_cam_points[..., 2]
    assert (depth.amax(1) - depth.amin(1)).max() < 1e-9, "a problem's points come from one source"
    for part in (slice(60), slice(20), slice(20, 40)):
        found = depth[part, 0].round().long().bincount(minlength=4)[1:]
        assert (found - torch.tensor(shares) / sum(shares) * len(depth[part])).abs().max() <= 1


def test_mixed_sources_do_not_see_the_same_random_numbers_and_stay_whole():
    source = mixed(img_sigma=0.0, outliers=OutlierMix(count=1))
    p = map_tensors(lambda *x: torch.cat(x), *(source.batch(i) for i in range(3)))
    assert len(p.pose.translation.unique(dim=0)) == 180
    assert torch.equal(reprojection_errors(p).norm(dim=-1) < 1e-6, p.inliers)
    for count, shares in ((0, None), (2, (1.0,)), (2, (1.0, 0.0)), (2, (1.0, -1.0))):
        with pytest.raises(BaseError, match=f"{count} sources"):
            data.MixedProblems([SyntheticProblems] * count, shares=shares)


def test_mixed_points_have_their_shares_in_small_batches_too(generator):
    points = data.MixedPoints(PLANES, shares=(6.0, 3.0, 1.0))
    depth = torch.cat([points(3, 4, generator)[..., 2] for _ in range(2000)])
    assert torch.equal(depth, depth[:, :1].expand_as(depth)), "a problem's points come from one prior"
    assert_counts(depth[:, 0].round().long().bincount()[1:], (0.6, 0.3, 0.1))
    assert_counts(depth[::3, 0].round().long().bincount()[1:], (0.6, 0.3, 0.1))
    with pytest.raises(BaseError, match="2 priors"):
        data.MixedPoints(PLANES[:2], shares=(1.0,))


def test_covariances_are_known_of_all_problems_of_a_mixture_or_of_none():
    stretched = partial(SyntheticProblems, axis_ratio=3.0, known_noise=1.0)
    p = data.MixedProblems([stretched, stretched], batch_size=6, n=4).batch(0)
    assert (p.img_cov.shape, p.world_cov.shape) == ((6, 4, 2, 2), (6, 4, 3, 3))
    with pytest.raises(BaseError, match="covariances"):
        data.MixedProblems([stretched, SyntheticProblems], batch_size=6, n=4).batch(0)


def test_in_a_mixture_unknown_sigmas_are_nan_and_sigmas_of_pairs_go_with_those_of_problems():
    sources = [partial(SyntheticProblems, sigma_spread=x, known_noise=1.0) for x in (0.0, 0.5)]
    p = data.MixedProblems([SyntheticProblems, sources[0]], batch_size=10, n=4).batch(0)
    assert p.img_sigma.isnan().sum() == p.world_sigma.isnan().sum() == 5
    p = data.MixedProblems([*sources, SyntheticProblems], batch_size=30, n=4).batch(0)
    assert p.img_sigma.shape == p.world_sigma.shape == (30, 4)
    constant = (p.img_sigma == 1.0).all(1)
    assert (constant.sum(), p.img_sigma.isnan().all(1).sum()) == (10, 10)
    assert torch.equal(constant, (p.world_sigma == p.world_sigma[constant][0, 0]).all(1))


def test_varying_sizes_are_reproducible_and_come_from_the_list():
    mixture = partial(data.MixedProblems, [SyntheticProblems], known_noise=0.5)
    one, two = (data.VaryingSize(mixture, n=[5, 9, 20], batch_size=40, seed=3) for _ in range(2))
    assert_same(*([x.batch(i) for i in range(30)] for x in (one, two)), equal_nan=True)
    assert {tuple(one.batch(i).inliers.shape) for i in range(30)} == {(40, 5), (22, 9), (10, 20)}
