"""Synthetic problems against the protocol, by the distributions of their poses, points and noise."""

import itertools
import math

import pytest
import torch
from data_helpers import COUNT, assert_normal, assert_uniform, draw, reprojection, same
from kornia.geometry.conversions import rotation_matrix_to_axis_angle

from kornia_pnpnet import Pose, Problems
from kornia_pnpnet.core.trees import iter_tensors
from kornia_pnpnet.data import OutlierMix, SlabPoints, SyntheticProblems
from kornia_pnpnet.data.draws import random_poses
from kornia_pnpnet.geometry import transform

# --- poses ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pose():
    return draw(outliers=OutlierMix()).pose


def test_translations_are_uniform_in_the_box(pose):
    for axis in range(3):
        assert_uniform(pose.translation[:, axis], -12.5, 12.5)
    correlation = torch.corrcoef(pose.translation.T) - torch.eye(3)
    assert correlation.abs().max() < 0.03


def test_rotations_have_a_uniform_axis_and_a_uniform_angle(pose):
    vector = rotation_matrix_to_axis_angle(pose.rotation)
    angle = vector.norm(dim=-1)
    assert_uniform(angle, 0.0, math.pi / 2 + 1e-9)
    axis = vector / angle[:, None]
    for coordinate in range(3):  # Archimedes: each coordinate of a uniform direction is uniform
        assert_uniform(axis[:, coordinate], -1.0 - 1e-9, 1.0 + 1e-9)
    assert_uniform(torch.atan2(axis[:, 1], axis[:, 0]), -math.pi, math.pi)
    eye = torch.eye(3, dtype=torch.float64).expand(COUNT, 3, 3)
    torch.testing.assert_close(pose.rotation @ pose.rotation.mT, eye)


def test_pose_constants_are_arguments(generator):
    assert_normal(draw(3, translation_sigma=25.0).pose.translation, 25.0)
    pose = random_poses(COUNT, generator, translation_box=2.0, max_angle=0.1)
    assert_uniform(pose.translation, -1.0, 1.0)
    assert_uniform(rotation_matrix_to_axis_angle(pose.rotation).norm(dim=-1), 0.0, 0.1 + 1e-9)


# --- points and noise -------------------------------------------------------------------------------------------------


def test_points_are_uniform_in_the_box_in_front_of_the_camera():
    p = draw(4, world_sigma=0.0, img_sigma=0.0)
    cam = transform(p.pose, p.world_points)
    slack = 1e-9
    assert_uniform(cam[..., 0], -10 - slack, 10 + slack)
    assert_uniform(cam[..., 1], -10 - slack, 10 + slack)
    assert_uniform(cam[..., 2], 10 - slack, 90 + slack)
    assert reprojection(p).abs().max() < 1e-8
    assert p.inliers.all()
    # The image is exactly the near face of the box.
    assert p.img_points.abs().max() <= 3400 + 1e-6
    camera = torch.diag(torch.tensor([3400.0, 3400, 1], dtype=torch.float64))
    assert torch.equal(p.intrinsics, camera.expand(COUNT, 3, 3))
    assert draw(3, 2, focal=100.0).intrinsics[0, 1, 1] == 100.0


def test_noise_is_normal_with_its_standard_deviation():
    clean, noisy = (draw(9, img_sigma=0.0, world_sigma=sigma) for sigma in (0.0, 0.05))
    assert torch.equal(noisy.img_points, clean.img_points)
    world, img = noisy.world_points - clean.world_points, reprojection(draw(9, world_sigma=0.0, img_sigma=3.0))
    for noise, sigma in ((world, 0.05), (img, 3.0)):
        assert_normal(noise, sigma)
        assert abs(noise.std().item() / sigma - 1) < 0.005


@pytest.mark.parametrize("name", ["img_sigma", "world_sigma"])
def test_noise_from_a_range_is_log_uniform_over_the_problems(name):
    other = {"img_sigma": "world_sigma", "world_sigma": "img_sigma"}[name]
    clean, noisy, constant = (draw(50, 4000, **{other: 0.0, name: x}) for x in (0.0, (0.01, 1.0), (0.05, 0.05)))

    def sigma(p):  # of each problem, known to a tenth
        noise = reprojection(p) if name == "img_sigma" else p.world_points - clean.world_points
        return noise.flatten(1).square().mean(1).sqrt()

    quarter = torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)
    torch.testing.assert_close(sigma(noisy).log10().quantile(quarter), 2 * quarter - 2, rtol=0, atol=0.05)
    assert sigma(noisy).min() > 0.007
    assert sigma(noisy).max() < 1.4
    assert (sigma(constant) / 0.05 - 1).abs().max() < 0.4


def test_a_share_of_problems_comes_with_sigmas():
    p = draw(4, known_noise=0.4, img_sigma=(0.5, 5.0), world_sigma=0.05)
    known = [~x.isnan() for x in (p.img_sigma, p.world_sigma)]
    assert (known[0] & known[1]).double().mean().item() == pytest.approx(0.4, abs=0.015)
    for one, other in (known, known[::-1]):
        assert (one & ~other).double().mean().item() == pytest.approx(0.1, abs=0.01)
    assert (p.world_sigma[known[1]] == 0.05).all()
    assert_uniform(p.img_sigma[known[0]].log(), math.log(0.5) - 1e-6, math.log(5.0) + 1e-6)
    assert set(p.sigmas) == {"img_sigma", "world_sigma"}
    assert draw(4, 2).sigmas == {}


def test_known_sigmas_are_those_of_the_noise():
    p = draw(200, 500, known_noise=1.0, img_sigma=(0.5, 5.0), world_sigma=0.0)
    ratio = reprojection(p).flatten(1).square().mean(1).sqrt() / p.img_sigma
    assert (ratio - 1).abs().max() < 0.2


# --- streams ----------------------------------------------------------------------------------------------------------


def test_a_batch_depends_on_seed_and_index_alone():
    def source(seed):
        return SyntheticProblems(n=6, batch_size=5, seed=seed, outliers=OutlierMix())

    torch.manual_seed(1)
    expected = torch.rand(3)
    torch.manual_seed(1)
    first = source(3).batch(11)
    assert torch.equal(torch.rand(3), expected), "drawing leaves the global generator alone"
    assert same(source(3).batch(11), first)
    # PyTorch's CPU generator uses 32 bits of its own seed.
    distinct = [source(seed).batch(index) for seed in (0, 1, 2**32, 2**40) for index in (0, 1, 2)]
    for one, two in itertools.combinations(distinct, 2):
        assert not torch.equal(one.world_points, two.world_points)
    for index, batch in enumerate(itertools.islice(source(3), 4)):
        assert same(batch, source(3).batch(index))


def test_the_stream_is_the_same_in_every_version():
    """Checkpoints are continued, and results compared, on the batches that they began with."""
    source = SyntheticProblems(
        n=4, batch_size=2, seed=1, outliers=OutlierMix(count=2), points=SlabPoints(), dtype=torch.float64
    )
    p = source.batch(5)
    expected = [22.701997641412, 32.510782258771, 7.399977915547, -537.263534025228, 241.439302635276]
    expected += [-11.830719013041, 1.755626411493, -12.466575925139]
    found = torch.cat((p.world_points[1, 3], p.img_points[1, 3], p.pose.translation[1]))
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64), rtol=1e-9, atol=0)
    assert p.inliers.tolist() == [[True, False, False, True], [True, True, False, False]]


def test_dtype_and_shapes():
    p, double = (SyntheticProblems(n=4, batch_size=3, dtype=d).batch(0) for d in (torch.float32, torch.float64))
    assert isinstance(p, Problems)
    assert isinstance(p.pose, Pose)
    assert [tuple(x.shape) for x in iter_tensors(p)] == [(3, 4, 3), (3, 4, 2), (3, 3, 3), (3, 3, 3), (3, 3), (3, 4)]
    assert {x.dtype for x in iter_tensors(double)} == {torch.float64, torch.bool}
    assert same(double.map(lambda x: x.float() if x.dtype == torch.float64 else x), p)
