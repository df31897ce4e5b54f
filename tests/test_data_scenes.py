"""Scenes: their images, and the random problems drawn from them."""

import math
from dataclasses import replace

import pytest
import torch
from data_helpers import HEIGHT, WIDTH, assert_counts, assert_uniform, make_scene, make_view
from helpers import reprojection_errors
from kornia.core.exceptions import BaseError
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch.testing import assert_close

from kornia_pnpnet.data import OutlierMix, Scene, SceneProblems


def test_the_world_is_moved_rigidly_to_the_protocols_prior():
    scene = make_scene(30)
    problems = SceneProblems(scene, batch_size=20_000).batch(0)
    chosen = pairs_of(scene, problems.img_points[:50])
    still = scene.views[0].world_points[chosen]
    assert_close(*(torch.cdist(points, points) for points in (problems.world_points[:50], still)))
    assert_uniform(problems.pose.translation, -12.5, 12.5)
    assert_uniform(rotation_matrix_to_axis_angle(problems.pose.rotation).norm(dim=-1), 0.0, math.pi / 2 + 1e-9)


def test_outliers_do_not_change_points_and_poses():
    clean, spoilt = (
        SceneProblems(make_scene(20, 30), batch_size=100, outliers=mix).batch(0) for mix in (None, OutlierMix(count=4))
    )
    assert torch.equal(clean.world_points, spoilt.world_points)
    assert torch.equal(clean.pose.matrix, spoilt.pose.matrix)
    assert torch.equal((clean.img_points == spoilt.img_points).all(-1), spoilt.inliers)


def pairs_of(scene, img_points):
    """The place of each pixel among those that the views observed, one view after the other, or -1, (B, N)."""
    match = (img_points[..., None, :] == torch.cat([view.img_points for view in scene.views])).all(-1)
    return torch.where(match.any(-1), match.long().argmax(-1), -1)


def test_both_kinds_of_outliers_as_in_the_protocol():
    scene = make_scene(20, 30)
    problems = SceneProblems(scene, batch_size=2000, outliers=OutlierMix(count=2)).batch(0)
    assert ((~problems.inliers).sum(1) == 2).all()
    wrong = problems.img_points[~problems.inliers].reshape(2000, 2, 2)
    mismatch = pairs_of(scene, wrong) >= 0
    assert_close(mismatch.double().mean().item(), 0.5, rtol=0, atol=0.03)
    # One spare point: two mismatches of a problem share its pixel, which no inlier has.
    both = mismatch.all(1)
    assert 400 < both.sum() < 600
    assert torch.equal(wrong[both, 0], wrong[both, 1])
    own = problems.img_points[:, :, None] == problems.img_points[:, None]
    assert not (own.all(-1) & problems.inliers[:, :, None] & ~problems.inliers[:, None]).any()
    # The others are anywhere in the image.
    sensed = wrong[~mismatch]
    assert_uniform(sensed[:, 0], 0, WIDTH)
    assert_uniform(sensed[:, 1], 0, HEIGHT)


@pytest.mark.parametrize("count", [0, 1, 5])
def test_fixed_number_of_mismatches_with_spares_of_their_own(count):
    scene, mix = make_scene(20, 30), OutlierMix(count=count, mismatch_share=1.0)
    problems = SceneProblems(scene, batch_size=200, outliers=mix, num_spares=5).batch(0)
    assert ((~problems.inliers).sum(1) == count).all()
    chosen = pairs_of(scene, problems.img_points).sort(-1).values
    assert (chosen >= 0).all()
    assert (chosen.diff() > 0).all(), "no two pairs share a pixel"


def test_inliers_reproject_exactly_and_mismatches_of_the_scene_are_marked():
    views = []
    for view in make_scene(40, 28).views:
        inliers = torch.arange(len(view.inliers)) % 4 != 0
        views.append(replace(view, img_points=view.img_points + 100.0 * ~inliers[:, None], inliers=inliers))
    problems = SceneProblems(Scene("toy", tuple(views)), batch_size=500).batch(0)
    assert torch.equal(reprojection_errors(problems).norm(dim=-1) < 1e-9, problems.inliers)
    assert_close(problems.inliers.double().mean().item(), 0.75, rtol=0, atol=0.03)


def test_images_are_equally_likely_and_small_ones_unused():
    scene = make_scene(10, 500, 9)
    source = SceneProblems(scene, batch_size=4000)
    assert [view.name for view in source.views] == ["0.jpg", "1.jpg"]
    assert_counts((pairs_of(scene, source.batch(0).img_points[:, 0]) >= 10).long().bincount())


def test_points_of_an_image_are_a_uniform_ordered_choice_without_repetition():
    scene = make_scene(5)
    which = pairs_of(scene, SceneProblems(scene, n=3, batch_size=60_000).batch(0).img_points)  # (B, 3)
    _, hits = (which @ torch.tensor([25, 5, 1])).unique(return_counts=True)
    assert len(hits) == 60  # 5 · 4 · 3, so no point comes twice
    assert (hits - 1000).abs().max() < 150  # standard deviation 31


def test_wrong_arguments():
    with pytest.raises(ValueError, match=r"img_points has shape \(29, 2\), expected \(30, 2\)"):
        replace(make_view(), img_points=torch.zeros(29, 2))
    with pytest.raises(ValueError, match="no image of 'toy' has the 51 points for n = 50 and num_spares = 1"):
        SceneProblems(make_scene(20, 30), n=50)
    for name in ("near_share", "structured_share", "crowd_share"):
        with pytest.raises(BaseError, match=f"{name}.*0.5"):
            SceneProblems(make_scene(20), outliers=OutlierMix(**{name: 0.5}))
