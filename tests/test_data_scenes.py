"""Scenes: their images, and the random problems drawn from them."""

import math
from dataclasses import replace

import pytest
import torch
from data_helpers import HEIGHT, WIDTH, assert_counts, assert_uniform, make_scene, make_view, reprojection
from kornia.core.exceptions import BaseError
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch.testing import assert_close

from kornia_pnpnet.data import OutlierMix, Scene, SceneProblems

# --- views ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("img_points", torch.zeros(29, 2), r"img_points has shape \(29, 2\), expected \(30, 2\)"),
        ("rotation", torch.full((3, 3), math.nan), "rotation has values that are not finite"),
        ("rotation", 2 * torch.eye(3), "not a rotation matrix"),
        ("rotation", -torch.eye(3), "not a rotation matrix"),
    ],
)
def test_view_checks_itself(field, value, message):
    with pytest.raises(ValueError, match=message):
        replace(make_view(), **{field: value})


def test_match_behind_the_camera_has_infinite_error():
    view = make_view()
    behind = view.rotation.mT @ (torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64) - view.translation)
    view = replace(view, world_points=torch.cat([view.world_points[:-1], behind[None]]))
    assert view.reprojection_error_px[-1] == math.inf
    assert view.reprojection_error_px[:-1].max() < 1e-9


# --- problems ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("recentre", [True, False])
@pytest.mark.parametrize("outliers", [None, OutlierMix()])
def test_inliers_reproject_exactly_and_outliers_do_not(recentre, outliers):
    problems = SceneProblems(make_scene(40, 30), batch_size=500, outliers=outliers, recentre=recentre).batch(3)
    error = reprojection(problems).norm(dim=-1)
    assert error[problems.inliers].max() < 1e-9
    wrong = error[~problems.inliers]
    assert outliers is None or wrong.median() > 50
    assert (wrong > 1e-3).all()


def test_recentring_moves_the_world_rigidly_to_the_protocols_prior():
    scene = make_scene(30)
    moved, still = (SceneProblems(scene, batch_size=20_000, recentre=recentre).batch(0) for recentre in (True, False))
    assert torch.equal(moved.img_points, still.img_points)
    assert_close(*(torch.cdist(p.world_points[:50], p.world_points[:50]) for p in (moved, still)))
    assert torch.equal(still.pose.rotation[:50], scene.views[0].rotation.expand(50, 3, 3))
    assert_uniform(moved.pose.translation, -12.5, 12.5)
    assert_uniform(rotation_matrix_to_axis_angle(moved.pose.rotation).norm(dim=-1), 0.0, math.pi / 2 + 1e-9)


def test_outliers_do_not_change_points_and_poses():
    scene = make_scene(20, 30)
    clean = SceneProblems(scene, batch_size=100).batch(0)
    spoilt = SceneProblems(scene, batch_size=100, outliers=OutlierMix(count=4)).batch(0)
    assert torch.equal(clean.world_points, spoilt.world_points)
    assert torch.equal(clean.pose.translation, spoilt.pose.translation)
    assert torch.equal(clean.img_points[spoilt.inliers], spoilt.img_points[spoilt.inliers])
    assert (clean.img_points != spoilt.img_points).any(-1)[~spoilt.inliers].all()


def from_the_scene(scene: Scene, img_points: torch.Tensor) -> torch.Tensor:
    """Whether a pixel is one that some view of the scene observed, (B, N)."""
    known = torch.cat([view.img_points for view in scene.views])
    return (img_points[..., None, :] == known).all(-1).any(-1)


def test_both_kinds_of_outliers_as_in_the_protocol():
    scene = make_scene(20, 30)
    problems = SceneProblems(scene, batch_size=2000, outliers=OutlierMix(count=2)).batch(0)
    assert ((~problems.inliers).sum(1) == 2).all()
    share = (~problems.inliers).double().mean(0)
    assert_close(share, torch.full_like(share, 2 / 9), rtol=0, atol=0.04)
    wrong = problems.img_points[~problems.inliers].reshape(2000, 2, 2)
    mismatch = from_the_scene(scene, wrong)
    assert_close(mismatch.double().mean().item(), 0.5, rtol=0, atol=0.03)
    # One spare point: two mismatches of a problem share its pixel, which no inlier has.
    both = mismatch.all(1)
    assert 400 < both.sum() < 600
    assert torch.equal(wrong[both, 0], wrong[both, 1])
    own = problems.img_points[:, :, None] == problems.img_points[:, None]
    assert not (own.all(-1) & problems.inliers[:, :, None] & ~problems.inliers[:, None]).any()
    # The others are anywhere in the image.
    sensed = wrong[~mismatch]
    assert (sensed >= 0).all()
    assert (sensed <= torch.tensor([WIDTH, HEIGHT])).all()
    expected = torch.tensor([WIDTH, HEIGHT], dtype=torch.float64)
    assert_close(sensed.mean(0), expected / 2, rtol=0.05, atol=0)
    assert_close(sensed.std(0), expected / math.sqrt(12), rtol=0.05, atol=0)


def test_fixed_number_of_mismatches_with_spares_of_their_own():
    scene = make_scene(20, 30)
    for count in (0, 1, 5):
        mix = OutlierMix(count=count, mismatch_share=1.0)
        problems = SceneProblems(scene, batch_size=200, outliers=mix, num_spares=5).batch(0)
        assert ((~problems.inliers).sum(1) == count).all()
        assert from_the_scene(scene, problems.img_points).all()
        for pixels in problems.img_points[:20]:
            assert len(pixels.unique(dim=0)) == 9, "no two pairs share a pixel"


def test_real_mismatches_are_marked_without_any_spoiling():
    inliers = torch.arange(40) % 4 != 0
    view = make_view(count=40, inliers=inliers)
    view = replace(view, img_points=view.img_points + 100.0 * ~inliers[:, None])
    problems = SceneProblems(Scene("toy", (view,)), batch_size=500).batch(0)
    assert torch.equal(reprojection(problems).norm(dim=-1) < 1, problems.inliers)
    assert_close(problems.inliers.double().mean().item(), 0.75, rtol=0, atol=0.03)


def test_images_are_equally_likely_and_small_ones_unused():
    scene = make_scene(10, 500, 9)
    source = SceneProblems(scene, batch_size=4000, recentre=False)
    assert [view.name for view in source.views] == ["0.jpg", "1.jpg"]
    translation = source.batch(0).pose.translation
    hits = torch.stack([(translation == view.translation).all(-1).sum() for view in scene.views])
    assert hits[2] == 0
    assert_counts(hits[:2])


def test_points_of_an_image_are_a_uniform_ordered_choice_without_repetition():
    scene = make_scene(5)
    world_points = SceneProblems(scene, n=3, batch_size=60_000, recentre=False).batch(0).world_points
    which = torch.cdist(world_points, scene.views[0].world_points.expand(60_000, 5, 3)).argmin(-1)  # (B, 3)
    _, hits = (which @ torch.tensor([25, 5, 1])).unique(return_counts=True)
    assert len(hits) == 60  # 5 · 4 · 3, so no point comes twice
    assert (hits - 1000).abs().max() < 150  # standard deviation 31


def test_success_limit():
    metric, other = make_scene(20), make_scene(20, 30, metric=False)
    limits = [SceneProblems(scene).max_translation for scene in (metric, other)]
    assert limits == pytest.approx([0.2, 0.005 * other.median_depth])


def test_wrong_arguments():
    with pytest.raises(ValueError, match="no image of 'toy' has the 51 points for n = 50 and num_spares = 1"):
        SceneProblems(make_scene(20, 30), n=50)
    for name in ("near_share", "structured_share"):  # their pixels would be those of inliers
        with pytest.raises(BaseError, match=f"{name}.*0.5"):
            SceneProblems(make_scene(20), outliers=OutlierMix(**{name: 0.5}))
