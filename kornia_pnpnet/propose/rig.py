r"""The first guess of a rig: minimal samples on the exact cameras, since networks and EPnP know one pinhole camera."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_pnpnet.core.linalg import relative
from kornia_pnpnet.core.performance import present_first, problems_last, repeat_problems, sees_values, take_pairs
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.geometry import project
from kornia_pnpnet.propose import P3P, RANSAC
from kornia_pnpnet.propose.p3p_rig import P3PRig
from kornia_pnpnet.propose.sampling import draw_subsets
from kornia_pnpnet.propose.scoring import SCORERS, Scene
from kornia_pnpnet.propose.search import least_squares
from kornia_pnpnet.frame import F_CONST
from kornia_pnpnet.judge.inliers import Thresholds, judge
from kornia_pnpnet.judge.belief import residual_noise
from kornia_pnpnet.types import Problem, Starts, Pose

__all__ = ["guess_of_rig"]

# Focal lengths. Threshold of an inlier: ten times the noise of a pixel at a focal length of 1000 pixels.
_THRESHOLD = 0.01
_FINDER = RANSAC(P3P(), threshold=_THRESHOLD * F_CONST, final_steps=0)
# Number of samples of a fixed effort, and of draws for each, of which the first that P3PRig can solve is the sample: of
# three cameras that look in all directions it can solve every second draw. Chosen on `CameraProblems` with seed 77002.
_SAMPLES, _DRAWS = 128, 4
# Number of pairs that score each pose of a fixed effort.
_JUDGES = 32
# Number of best poses that a fixed effort improves, by one step of least squares on the pairs up to each limit in
# thresholds.
_IMPROVED, _LIMITS = 3, (3.0, 1.0)
# The root of x^4 = x + 1. Multiples of its negative powers, modulo 1, fill the unit cube evenly (M. Roberts, "The
# unreasonable effectiveness of quasirandom sequences", 2018).
_ROOT = 1.2207440846057596


def guess_of_rig(corr: Problem, given: Pose | None, *, with_noise: bool, fixed: bool = False) -> Starts:
    """Find the pose of a rig, its inliers and their noise.

    Args:
        corr: normalised correspondences of a rig.
        given: a pose that competes with those of RANSAC's samples.
        with_noise: estimate the noise of the pixels from the residuals, for a refinement that expects it.
        fixed: try a fixed number of samples, as in graphs, in place of RANSAC.

    Returns:
        The guess, a constant.
    """
    corr = corr.map(torch.Tensor.detach)
    with torch.no_grad():
        if fixed or not sees_values(corr.weights):
            guess = _best_of_samples(corr)
        else:
            guess = _FINDER(corr._replace(img_scale=corr.focal.expand(len(corr.weights)) / F_CONST), given)
        noise = None
        if with_noise:
            pairs = problems_last(corr)
            noise = residual_noise(project(guess.pose, pairs), pairs, guess.weights)
            noise = map_tensors(torch.Tensor.contiguous, noise)
            if corr.noise is not None:
                told = corr.noise
                noise = noise._replace(
                    img=torch.where(told.img.isnan(), noise.img, told.img),
                    world=torch.where(told.world.isnan(), noise.world, told.world),
                )
    return guess._replace(ok=None, noise=noise, weights=(guess.weights > 0).to(guess.weights))


def _best_of_samples(corr: Problem) -> Starts:
    """The best pose of a fixed number of minimal samples, improved on its inliers, and weights of the inliers."""
    rig, (batch, count) = corr.rig, corr.weights.shape
    assert rig is not None
    corr = corr._replace(weights=relative(corr.weights, corr.weights), noise=None)
    counts, order = (corr.weights > 0).sum(1), present_first(corr.weights > 0)
    # Judges are spread evenly over the pairs that have a weight; fewer pairs judge once each.
    turn = torch.arange(_JUDGES, device=order.device)
    judges = turn.maximum(turn * counts[:, None] // _JUDGES).clamp(max=count - 1)
    at = torch.cat((_draw(corr, order, counts), order.gather(1, judges)), 1)
    values = (corr.world_points, corr.img_points, corr.weights[..., None], rig.rotation.flatten(2))
    pairs = take_pairs(torch.cat((*values, rig.translation), -1), at)  # (18, 3 S + J, B)
    samples, judges = pairs.split((3 * _SAMPLES, _JUDGES), 1)
    pose, valid = P3PRig().hypotheses(_unpacked(samples.unflatten(1, (3, _SAMPLES)).flatten(2), corr.focal))

    jury = _unpacked(judges, corr.focal)._replace(prior=corr.prior)
    jury = jury._replace(weights=torch.where(turn < counts[:, None], jury.weights, 0.0))
    thresholds = Thresholds((_THRESHOLD * corr.focal).expand(batch), torch.zeros_like(corr.weights[:, 0]))
    scene = Scene.make(jury, thresholds, jury.weights.dtype)
    packed = torch.cat((pose.rotation.mT, pose.translation[..., None, :]), -2)  # (S B, 4, 4, 3)
    packed = packed.unflatten(0, (_SAMPLES, batch)).permute(1, 3, 4, 0, 2).flatten(3)  # (B, 4, 3, S 4)
    valid = valid.unflatten(0, (_SAMPLES, batch)).movedim(0, 1).flatten(1)
    losses = scene.losses(packed, SCORERS["msac"]).masked_fill(~valid, torch.inf)
    best = losses.topk(_IMPROVED, largest=False).indices[:, None, None].expand(-1, 4, 3, -1)
    matrix = packed.gather(3, best).permute(3, 0, 2, 1).flatten(0, 1)  # (K B, 3, 4)
    pose, repeated = Pose(matrix[..., :3], matrix[..., 3]), repeat_problems(corr, _IMPROVED)
    limits = map_tensors(lambda x: x.repeat(_IMPROVED), thresholds)
    projection = project(pose, repeated)
    for limit in _LIMITS:
        inliers = judge(projection, repeated, limits._replace(img=limit * limits.img)).weights
        pose = least_squares(repeated, pose, projection, inliers).pose
        projection = project(pose, repeated)
    judged = judge(projection, repeated, limits)
    loss = (repeated.weights * SCORERS["msac"](judged.errors)).sum(1)
    at = loss.unflatten(0, (_IMPROVED, batch)).argmin(0) * batch + torch.arange(batch, device=loss.device)
    return Starts(map_tensors(lambda x: x[at], pose), judged.weights[at])


def _draw(corr: Problem, order: Tensor, counts: Tensor) -> Tensor:
    """Positions of the pairs of the samples, (B, 3 S): first pairs, second pairs, third pairs.

    Args:
        corr: normalised correspondences of a rig.
        order: positions of the pairs, those that have a weight first, (B, N).
        counts: number of pairs that have a weight, (B,).
    """
    numbers = torch.arange(1, _DRAWS * _SAMPLES + 1, dtype=torch.float64, device=order.device)
    numbers = torch.stack([numbers * _ROOT**-k for k in (1, 2, 3)], -1)
    drawn = draw_subsets(numbers - numbers.floor(), counts).mT  # (B, 3, D S)
    drawn = order.gather(1, drawn.flatten(1))
    rays = take_pairs(corr.places, drawn).unflatten(1, (3, _DRAWS, _SAMPLES))  # (3, 3, D, S, B)
    ahead = (rays * rays.sum(1, keepdim=True)).sum(0).amin(0) > 0  # what P3PRig can solve, (D, S, B)
    first = ahead.long().argmax(0).mT[:, None, None].expand(-1, 3, -1, -1)
    return drawn.unflatten(1, (3, _DRAWS, _SAMPLES)).gather(2, first).flatten(1)


def _unpacked(pairs: Tensor, focal: Tensor) -> Problem:
    """Problem from the numbers of their pairs, (18, N, B)."""
    world, img, weights, rotation, translation = pairs.permute(2, 1, 0).split((3, 2, 1, 9, 3), -1)
    rig = Pose(rotation.unflatten(-1, (3, 3)), translation)
    return Problem(world, img, weights[..., 0], focal, rig=rig)
