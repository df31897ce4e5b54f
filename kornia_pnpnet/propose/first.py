"""Propose the poses from which refinement starts. For a rig, RANSAC replaces initialisers that need one camera."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from kornia_pnpnet.core.linalg import relative
from kornia_pnpnet.core.performance import present_first, problems_last, sees_values
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.judge.inliers import Thresholds, judge, residual_noise
from kornia_pnpnet.problem import Problem, Starts, State
from kornia_pnpnet.propose.initialiser import trait
from kornia_pnpnet.propose.p3p import P3P
from kornia_pnpnet.propose.ransac import RANSAC
from kornia_pnpnet.propose.sampling import spread_evenly
from kornia_pnpnet.propose.search import Search
from kornia_pnpnet.propose.views import from_views
from kornia_pnpnet.refine.residual import project
from kornia_pnpnet.result import Pose

__all__ = ["propose"]

# An unusual pair (`Problem.usual`) is used if its residual at a proposed pose is below this number of focal lengths.
_SEEN = 0.25
# Inlier threshold for rigs, in focal lengths.
_THRESHOLD = 0.01
_FINDER = RANSAC(P3P(), threshold=_THRESHOLD, final_steps=0)
# If the effort is fixed, RANSAC solves _SAMPLES samples of each problem, and _JUDGES pairs score each pose.
_SAMPLES, _JUDGES = 128, 32
# The root r of x^4 = x + 1. Multiples of (1/r, 1/r^2, 1/r^3), modulo 1, fill the unit cube evenly (M. Roberts, 2018).
_ROOT = 1.2207440846057596


def propose(
    init: nn.Module | None,
    problem: Problem,
    given: Pose | None,
    *,
    views: int,
    order: bool,
    fixed: bool,
    search_follows: bool,
) -> Starts:
    """Propose the poses from which refinement starts.

    Args:
        init: the initialiser, or ``None`` if the refinement starts from the given pose.
        problem: the problem.
        given: the caller's pose in the frame of the problem. A given pose competes with the initialiser's poses.
        views: number of views. ``views`` has no effect for rigs, and for initialisers that accept a given pose.
        order: see :func:`~kornia_pnpnet.propose.views.from_views`.
        fixed: whether the number of samples for a rig is fixed, as compiled and exported graphs require.
        search_follows: see :meth:`~kornia_pnpnet.propose.set.SetInit.forward`.
    """
    if init is None:
        assert given is not None
        return Starts(given, torch.ones_like(problem.weights))
    if problem.rig is not None and not trait(init, "takes_rigs"):
        starts = _starts_of_rig(problem, given, with_noise=trait(init, "estimates_noise"), fixed=fixed)
    elif trait(init, "takes_given"):
        starts, given = init(problem, given), None
    elif views > 1 and problem.rig is None:
        starts = from_views(init, problem, views, order)
    else:
        starts = init(problem, search_follows=True) if search_follows else init(problem)
    if given is not None:  # the initialiser's last pose stays the last, see `Initialiser.estimates_noise`
        more = starts.poses[1:]
        starts = starts._replace(ok=None, others=None).with_others(*more[:-1], given, *more[-1:])
    if trait(init, "weighs_unusual"):
        return starts
    known, limit = problem.map(torch.Tensor.detach), (_SEEN * problem.focal) ** 2
    seen = torch.zeros_like(problem.weights, dtype=torch.bool)
    for pose in map_tensors(torch.Tensor.detach, starts.poses):
        projection = project(State.of(pose), known)
        seen = seen | (projection.in_front & (projection.sq_residual < limit))
    return starts._replace(weights=starts.weights * torch.where(seen, 1.0, problem.usual))


@torch.no_grad()
def _starts_of_rig(problem: Problem, given: Pose | None, *, with_noise: bool, fixed: bool) -> Starts:
    """Find the pose and the inliers of a rig. If ``with_noise``, also find the noise of the inliers' residuals."""
    problem = problem.map(torch.Tensor.detach)
    if fixed or not sees_values(problem.weights):
        starts = _of_fixed_effort(problem._replace(weights=relative(problem.weights, problem.weights), noise=None))
    else:
        starts = _FINDER(problem._replace(img_scale=problem.focal.expand(problem.weights.shape[0])), given)
    noise = None
    if with_noise:
        pairs = problems_last(problem)
        noise = residual_noise(project(State.of(starts.pose), pairs), pairs, starts.weights)
        if problem.noise is not None:
            noise = map_tensors(lambda x, y: torch.where(y.isnan(), x, y), noise, problem.noise.sigmas)
        noise = map_tensors(torch.Tensor.contiguous, noise)
    return starts._replace(ok=None, noise=noise, weights=(starts.weights > 0).to(starts.weights))


def _of_fixed_effort(problem: Problem) -> Starts:
    """Find the best pose of a fixed number of minimal samples. Only the inliers have positive weights."""
    there = problem.weights > 0
    counts = there.sum(1, keepdim=True)
    judges = torch.where(torch.arange(_JUDGES, device=counts.device) < counts, spread_evenly(there, _JUDGES), -1)
    img = (_THRESHOLD * problem.focal).expand(there.shape[0], 1)
    thresholds = Thresholds(img, torch.zeros_like(img))
    search = Search(_FINDER, problem, thresholds)
    search.run_once(_drawn(present_first(there), counts), judges)
    pose = search.state.pose
    return Starts(pose, judge(project(State.of(pose), problems_last(problem)), problem, thresholds).weights)


def _drawn(order: Tensor, counts: Tensor) -> Tensor:
    """Draw samples (B, S, 3) of different pairs from the first ``counts`` (B, 1) positions in ``order`` (B, N)."""
    numbers = torch.arange(1, _SAMPLES + 1, dtype=torch.float64, device=order.device)
    # The second and the third number are ranks among the pairs that the sample does not contain yet.
    first, second, third = ((numbers * _ROOT**-k % 1.0 * (counts - k + 1)).long() for k in (1, 2, 3))  # (B, S) each
    second = second + (second >= first)
    third = third + (third >= torch.minimum(first, second))
    third = third + (third >= torch.maximum(first, second))
    ranks = torch.stack((first, second, third), -1).clamp(min=0, max=order.shape[1] - 1)
    return order.gather(1, ranks.flatten(1)).view_as(ranks)
