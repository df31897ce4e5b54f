"""Synthetic problems, of one camera against the protocol and of many cameras by their own geometry."""

import itertools
import math
from functools import partial

import pytest
import torch
from data_helpers import COUNT, assert_normal, assert_uniform, draw, make_scene, same
from helpers import reprojection_errors
from kornia.geometry.conversions import rotation_matrix_to_axis_angle

from kornia_pnpnet.core.trees import iter_tensors
from kornia_pnpnet.data import (
    CameraProblems,
    DepthMaps,
    FacadePoints,
    ObjectPoints,
    OutlierMix,
    SceneProblems,
    SyntheticProblems,
)


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
    cam = p.true_cam_points
    for axis, (low, high) in enumerate(((-10, 10), (-10, 10), (10, 90))):
        assert_uniform(cam[..., axis], low - 1e-9, high + 1e-9)
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
        assert inliers.all() == (length.max() <= 10.0)
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
    views = FacadePoints(field_of_view=(20.0, 20.0), window=(1.0, 1.0))
    p = draw(60, 200, points=views, half_image=None, outliers=mix, img_sigma=0.0, world_sigma=0.0)
    half = 3400 * math.tan(math.radians(10.0))
    assert_uniform(p.img_points[~p.inliers] / half, -1.0, 1.0)


KINDS = {"structured_share": 0.5, "mirrored_share": 0.5, "near_share": 0.2, "crowd_share": 0.5}
OPTIONS = {"sigma_spread": (0.1, 1.0), "degrees": (1.5, 9.0), "bunched_share": 0.5, "half_image": None}


@pytest.mark.parametrize(
    "source",
    [
        partial(SyntheticProblems, outliers=OutlierMix(max_ratio=0.95, **KINDS), known_noise=1.0, **OPTIONS),
        partial(CameraProblems, cameras=2),
        partial(SceneProblems, make_scene(20, 30), outliers=OutlierMix()),
    ],
)
def test_a_batch_depends_on_seed_and_index_alone(source):
    make = partial(source, n=6, batch_size=5)
    torch.manual_seed(1)
    expected = torch.rand(3)
    torch.manual_seed(1)
    first = make(seed=3).batch(11)
    assert all(x.isfinite().all() for x in iter_tensors(first))
    assert torch.equal(torch.rand(3), expected), "drawing leaves the global generator alone"
    assert same(make(seed=3).batch(11), first)
    # PyTorch's CPU generator uses 32 bits of its own seed.
    distinct = [make(seed=seed).batch(index) for seed in (0, 1, 2**32, 2**40) for index in (0, 1, 2)]
    for one, two in itertools.combinations(distinct, 2):
        assert not torch.equal(one.world_points, two.world_points)
    for index, batch in enumerate(itertools.islice(make(seed=3), 4)):
        assert same(batch, make(seed=3).batch(index))


def test_the_stream_is_the_same_in_every_version():
    """Checkpoints are continued, and results compared, on the batches that they began with."""
    options = {"points": ObjectPoints(), "outliers": OutlierMix(count=6, near_share=0.3, structured_share=1.0)}
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


def test_depth_maps_move_points_along_map_rays_and_make_outliers_of_flying_pixels():
    maps = partial(DepthMaps, angle=(1e-9, 2e-9), flying_share=0.0)
    clean, noisy = (
        draw(9, world_sigma=0.0, img_sigma=0.0, depth_maps=x) for x in (None, maps(depth_noise=(0.01, 0.011)))
    )
    assert noisy.inliers.all()
    moves = (noisy.world_points - clean.world_points).norm(dim=-1)
    distance = clean.true_cam_points.norm(dim=-1)
    near, far = (moves[chosen].square().mean().sqrt() for chosen in (distance < 40, distance > 80))
    assert 2.5 < far / near < 7.0  # about the square of the distances' ratio
    problems = draw(9, depth_maps=maps(flying_share=0.2, depth_noise=(0.01, 0.011)))
    assert abs(problems.inliers.double().mean() - 0.8) < 0.01


def test_a_map_turns_all_of_its_points():
    maps = DepthMaps(depth_noise=(1e-9, 2e-9), angle=(0.5, 0.51), flying_share=0.0, maps=1)
    clean, noisy = (draw(9, world_sigma=0.0, img_sigma=0.0, depth_maps=x) for x in (None, maps))
    before, after = (torch.cdist(x.world_points, x.world_points) for x in (clean, noisy))
    torch.testing.assert_close(before, after, rtol=1e-3, atol=1e-6)
    assert (noisy.world_points - clean.world_points).norm(dim=-1).mean() > 0.1


def test_copies_are_whole_pairs_and_leave_eight_originals():
    problems = draw(30, sigma_spread=0.5, known_noise=1.0, confidence_share=1.0, copies_share=1.0)
    distances = partial(torch.cdist, compute_mode="donot_use_mm_for_euclid_dist")
    same_point = distances(problems.world_points, problems.world_points) == 0
    copied = same_point.sum(-1) > 1
    assert 0.2 < copied.double().mean() < 0.6
    for x in (problems.img_points, problems.img_sigma[..., None], problems.confidence[..., None]):
        assert (distances(x, x)[same_point] == 0).all()
    assert (same_point[:, :8, :8].sum(-1) == 1).all()


# --- many cameras -----------------------------------------------------------------------------------------------------


def draw_cameras(**options):
    return CameraProblems(**{"n": 8, "batch_size": 4000, "seed": 3, "dtype": torch.float64, **options}).batch(0)


def test_pixels_show_their_points_and_fields_of_view_are_uniform():
    problems = draw_cameras(img_sigma=0.0, field_of_view=(30.0, 90.0))
    assert reprojection_errors(problems).abs().max() < 1e-6
    assert (problems.true_cam_points[..., 2] > 0).all()
    angle = 2.0 * torch.atan(1000.0 / problems.intrinsics[:, 0, 0])
    assert_uniform(angle.rad2deg(), 30.0, 90.0)


def test_outliers_are_as_many_as_asked_for():
    problems = draw_cameras(n=10, outlier_share=0.3, img_sigma=0.0)
    assert (problems.inliers.sum(1) == 7).all()
    error = reprojection_errors(problems).norm(dim=-1)
    assert error[problems.inliers].max() < 1e-6
    assert (error[~problems.inliers] > 1.0).double().mean() > 0.99
    assert problems.inliers.double().mean(0).std() < 0.03  # any place


def test_rigs():
    problems = draw_cameras(cameras=3, baseline=0.2, img_sigma=0.0, batch_size=50)
    rotation, translation = problems.cam_from_rig
    seen = (problems.intrinsics @ problems.true_cam_points[..., None])[..., 0]
    torch.testing.assert_close(seen[..., :2] / seen[..., 2:], problems.img_points)
    assert torch.equal(rotation[:, 0], rotation[:, 3])
    assert not torch.equal(rotation[:, 0], rotation[:, 1])
    centres = -(rotation.mT @ translation[..., None])[..., 0].norm(dim=-1)
    assert (centres.amax(1) / centres.amin(1) - 1).abs().max() < 1e-9
    assert "cam_from_rig" in problems.known
