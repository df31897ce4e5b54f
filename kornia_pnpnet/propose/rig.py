r"""The first pose of a rig: minimal samples on the exact cameras, since networks and EPnP know one pinhole camera."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_pnpnet.core.linalg import relative
from kornia_pnpnet.core.performance import present_first, problems_last, repeat_problems, sees_values, take_pairs
from kornia_pnpnet.core.trees import map_tensors, take
from kornia_pnpnet.judge.belief import residual_noise
from kornia_pnpnet.judge.inliers import Thresholds, judge
from kornia_pnpnet.problem import Problem, Starts, State
from kornia_pnpnet.propose.p3p import P3P
from kornia_pnpnet.propose.p3p_rig import P3PRig
from kornia_pnpnet.propose.ransac import RANSAC
from kornia_pnpnet.propose.sampling import draw_subsets
from kornia_pnpnet.propose.scoring import SCORERS, Scene
from kornia_pnpnet.propose.search import least_squares, pack_pairs, unpack_pairs
from kornia_pnpnet.refine.residual import project
from kornia_pnpnet.result import Pose

__all__ = ["starts_of_rig"]

# Focal lengths. Threshold of an inlier: ten times the noise of a pixel at a focal length of 1000 pixels.
_THRESHOLD = 0.01
_FINDER = RANSAC(P3P(), threshold=_THRESHOLD, final_steps=0)
# Number of samples of a fixed effort, and of draws for each, of which the first that P3PRig can solve is the sample: of
# three cameras that look in all directions it can solve every second draw. Chosen on `CameraProblems` with seed 77002.
_SAMPLES, _DRAWS = 128, 4
# Number of pairs on which each pose is scored when the effort is fixed.
_JUDGES = 32
# Number of best poses that a fixed effort improves, by one step of least squares on the pairs up to each limit in
# thresholds.
_IMPROVED, _LIMITS = 3, (3.0, 1.0)
# The root of x^4 = x + 1. Multiples of its negative powers, modulo 1, fill the unit cube evenly (M. Roberts, "The
# unreasonable effectiveness of quasirandom sequences", 2018).
_ROOT = 1.2207440846057596


@torch.no_grad()
def starts_of_rig(problem: Problem, given: Pose | None, *, with_noise: bool, fixed: bool = False) -> Starts:
    """Find the pose of a rig, its inliers and their noise, as constants.

    Args:
        problem: normalised problems of a rig.
        given: see :meth:`~kornia_pnpnet.propose.ransac.RANSAC.forward`.
        with_noise: estimate the noise of the pixels from the residuals, for a refinement that expects it.
        fixed: try a fixed number of samples, as in graphs, in place of RANSAC.
    """
    problem = problem.map(torch.Tensor.detach)
    if fixed or not sees_values(problem.weights):
        starts = _best_of_samples(problem)
    else:
        starts = _FINDER(problem._replace(img_scale=problem.focal.expand(len(problem.weights))), given)
    noise = None
    if with_noise:
        pairs = problems_last(problem)
        noise = residual_noise(project(State.of(starts.pose), pairs), pairs, starts.weights)
        if problem.noise is not None:
            noise = map_tensors(lambda x, y: torch.where(y.isnan(), x, y), noise, problem.noise.sigmas)
        noise = map_tensors(torch.Tensor.contiguous, noise)
    return starts._replace(ok=None, noise=noise, weights=(starts.weights > 0).to(starts.weights))


def _best_of_samples(problem: Problem) -> Starts:
    """The best pose of a fixed number of minimal samples, improved on its inliers, and weights of the inliers."""
    batch, count = problem.weights.shape
    problem = problem._replace(weights=relative(problem.weights, problem.weights), noise=None)
    counts, order = (problem.weights > 0).sum(1), present_first(problem.weights > 0)
    # Judges are spread evenly over the pairs that have a weight; fewer pairs judge once each.
    turn = torch.arange(_JUDGES, device=order.device)
    judges = turn.maximum(turn * counts[:, None] // _JUDGES).clamp(max=count - 1)
    at = torch.cat((_draw(problem, order, counts), order.gather(1, judges)), 1)
    owners = torch.arange(batch, device=order.device)
    samples, judging = take_pairs(pack_pairs(problem), at).split((3 * _SAMPLES, _JUDGES), 1)  # (18, 3 S + J, B)
    samples = samples.unflatten(1, (3, _SAMPLES)).flatten(2)
    pose, valid = P3PRig().hypotheses(unpack_pairs(samples, problem, owners.repeat(_SAMPLES)))

    jury = unpack_pairs(judging, problem, owners)._replace(prior=problem.prior)
    jury = jury._replace(weights=torch.where(turn < counts[:, None], jury.weights, 0.0))
    limit = (_THRESHOLD * problem.focal).expand(batch, 1)
    thresholds = Thresholds(limit, torch.zeros_like(limit))
    scene = Scene.of(jury, thresholds, limit.dtype)
    packed = torch.cat((pose.rotation.mT, pose.translation[..., None, :]), -2)  # (S B, 4, 4, 3)
    packed = packed.unflatten(0, (_SAMPLES, batch)).permute(1, 3, 4, 0, 2).flatten(3)  # (B, 4, 3, S 4)
    valid = valid.unflatten(0, (_SAMPLES, batch)).movedim(0, 1).flatten(1)
    losses = scene.losses(packed, SCORERS["msac"]).masked_fill(~valid, torch.inf)
    best = losses.topk(_IMPROVED, largest=False).indices[:, None, None].expand(-1, 4, 3, -1)
    matrix = packed.gather(3, best).permute(3, 0, 2, 1).flatten(0, 1)  # (K B, 3, 4)
    repeated, limits = repeat_problems((problem._replace(prior=None), thresholds), _IMPROVED)
    projection = project(State.of(Pose(matrix[..., :3], matrix[..., 3])), repeated)
    for factor in _LIMITS:
        inliers = judge(projection, repeated, limits._replace(img=factor * limits.img)).weights
        projection = project(least_squares(repeated, projection, inliers), repeated)
    judged = judge(projection, repeated, limits)
    loss = (repeated.weights * SCORERS["msac"](judged.errors)).sum(1)
    at = loss.unflatten(0, (_IMPROVED, batch)).argmin(0) * batch + owners
    return Starts(take(projection.state.pose, at), judged.weights[at])


def _draw(problem: Problem, order: Tensor, counts: Tensor) -> Tensor:
    """Positions of the pairs of the samples, (B, 3 S), in ``order`` (B, N) of which the first ``counts`` are drawn."""
    numbers = torch.arange(1, _DRAWS * _SAMPLES + 1, dtype=torch.float64, device=order.device)
    numbers = torch.stack([numbers * _ROOT**-k for k in (1, 2, 3)], -1)
    drawn = draw_subsets(numbers - numbers.floor(), counts).mT  # (B, 3, D S)
    drawn = order.gather(1, drawn.flatten(1))
    rays = take_pairs(problem.places, drawn).unflatten(1, (3, _DRAWS, _SAMPLES))  # (3, 3, D, S, B)
    ahead = (rays * rays.sum(1, keepdim=True)).sum(0).amin(0) > 0  # what P3PRig can solve, (D, S, B)
    first = ahead.long().argmax(0).mT[:, None, None].expand(-1, 3, -1, -1)
    return drawn.unflatten(1, (3, _DRAWS, _SAMPLES)).gather(2, first).flatten(1)
