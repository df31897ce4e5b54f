"""Find other poses that explain the pairs nearly as well as the refined pose."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kornia_pnpnet.core.linalg import eigenvectors, half_turn
from kornia_pnpnet.core.performance import problems_last, repeat_problems
from kornia_pnpnet.core.trees import map_tensors, put, take
from kornia_pnpnet.judge.evidence import FAR_TURN, Evidence
from kornia_pnpnet.problem import Problem, Starts, State
from kornia_pnpnet.propose.p3p import minimal_poses
from kornia_pnpnet.propose.scoring import as_entries, as_pose
from kornia_pnpnet.refine.lm import Plan, Progress, RobustWeightedLM, taken
from kornia_pnpnet.refine.residual import project, rotation_angle
from kornia_pnpnet.result import Alternatives, Pose

__all__ = ["find_alternatives", "reconsider"]

# Another pose is kept if its likelihood, divided by the likelihood of the refined pose, exceeds this number.
_LIKELY = 1e-3
# The logarithm of a likelihood ratio is clipped at this number, so that its exponential does not overflow.
_LIKELIER = 30.0
# Two poses are the same minimum if their rotations differ by less than _SAME radians, and their camera coordinates of
# the mean point by less than _SAME times the distance of this point from the camera.
_SAME = 0.035
# A mirror image is refined if most inliers have residuals below this number times the spread of the inliers' pixels.
_NEAR_MIRROR = 0.2
# A rival is another pose that may explain the pairs. _WIDE_ANGLE (rad) is the least initial noise of the wide rival.
_WIDE_ANGLE = 6.4e-3
# Index of the first entry of `Evidence.grid` whose noise is at least _WIDE_ANGLE.
_WIDE_FROM = 5
# The wide rival is tried only if the larger noise lowers the log-likelihood by less than this number per vote.
_GAP = 0.4
# The wide rival is tried only if the share of inliers is below this number.
_CLEAR = 0.9
# A given rival is tried only if its rotation differs from the refined rotation by more than this angle, in radians.
_APART = 0.02
# A given rival is tried only if the share of inliers is below this number.
_CLEAR_OF_RIVALS = 0.97
# Numbers of iterations of a rival: first with constant noise, then with estimated noise.
_FROZEN, _FREE = 1, 3
# Number of iterations from each start in `find_alternatives`.
_ITERATIONS = 12


@torch.no_grad()
def find_alternatives(
    refine: RobustWeightedLM, problem: Problem, starts: Starts, pose: Pose, valid: Tensor, most: int
) -> Alternatives:
    """Find up to ``most`` other minima that are nearly as likely as the pose. All poses are in the problem's frame.

    The refinement starts from the mirror image of the pose, from the P3P solutions of three pairs that lie far apart,
    and from the poses of ``starts``. When the camera sees a plane almost from the front, the mirror image can be nearly
    as likely as the pose without being a minimum. Therefore, if the refinement of the mirror image ends at the pose,
    the unrefined mirror image is used. Problems get no other poses where ``valid``, bool (B,), is false.
    """
    problem, starts, pose = map_tensors(torch.Tensor.detach, (problem, starts, pose))
    plan = refine.begin(problem, starts._replace(pose=pose, others=None, camera=None))
    plan, now = refine.shown(plan, Progress.of(plan.state))
    inlier = _shares(plan.evidence_at(now.state).inlier)
    middle, mirrored = _mean(problem.world_points, inlier), _mirrored(pose, problem, inlier)
    every = [*map(as_entries, (pose, mirrored)), *_of_three(problem, inlier, pose), *map(as_entries, starts.poses)]
    count, batch = len(every), inlier.shape[0]
    many, mixture = repeat_problems((plan, now.mixture), count)
    tried = Progress.of(State.of(as_pose(torch.cat(every))), mixture)
    step, damping, _ = plan.hyperparameters[-1]
    for _ in range(_ITERATIONS):
        tried = refine.by_residuals(many, tried, torch.ones_like(many.votes.known), step, damping)
    ends = torch.cat((as_entries(tried.state.pose), every[1]))
    plans, mixture = repeat_problems((plan, now.mixture), count + 1)
    refined = refine.judge(plans, Progress.of(State.of(as_pose(ends)), mixture))
    usable = refined.in_front & refined.cost.isfinite()
    likelihood = refined.evidence.likelihood
    for term in plans.problem.pose_terms:
        likelihood = likelihood - 0.5 * term.loss(refined.state)
    each = ends, refined.cost, likelihood, usable
    ends, cost, likelihood, usable = (x.unflatten(0, (count + 1, batch)) for x in each)
    usable[count] &= _are_same(ends[1], every[0], middle)
    log_ratio = (likelihood - likelihood[0]).clamp(max=_LIKELIER)
    log_ratio = torch.where(usable & (log_ratio > math.log(_LIKELY)), log_ratio, -torch.inf)
    log_ratio, order = log_ratio.sort(dim=0, descending=True, stable=True)
    ends, cost = ends.take_along_dim(order[..., None], 0), cost.take_along_dim(order, 0)
    valid = valid & log_ratio.isfinite() & ~_are_same(ends, every[0], middle)
    for i in range(1, count + 1):
        same = _are_same(ends, ends[i], middle)
        valid[i] &= ~(same[:i] & valid[:i]).any(0)
    share = torch.where(valid, log_ratio, -torch.inf).exp()
    probability = share / (1.0 + share.sum(0))

    position = (~valid).to(torch.int8).sort(dim=0, stable=True).indices[:most]
    chosen = valid.take_along_dim(position, 0)
    identity = torch.eye(3, 4, dtype=cost.dtype, device=cost.device).flatten()
    rotation, translation = as_pose(
        torch.where(chosen[..., None], ends.take_along_dim(position[..., None], 0), identity).movedim(0, 1)
    )
    cost = torch.where(chosen, cost.take_along_dim(position, 0), torch.finfo(cost.dtype).max ** 0.5)
    return Alternatives(rotation, translation, cost.mT, probability.take_along_dim(position, 0).mT, chosen.mT)


def reconsider(
    refine: RobustWeightedLM,
    plan: Plan,
    now: Progress,
    found: Evidence,
    valid: Tensor,
    rival: State | None,
    replaced: Tensor | None,
) -> tuple[Progress, Evidence, Tensor]:
    """Compare refined poses with rivals. If ``refine.by_residual`` is positive, each problem keeps its likeliest pose.

    The prior of a pose counts for its likelihood. If the noise is unknown and a larger noise is almost as likely, a
    rival starts from the refined pose and the larger noise. If the mirror image of the pose has small residuals, a
    rival starts from the mirror image. If ``replaced`` is ``None``, a given rival is ignored when its rotation is close
    to the refined rotation, or when nearly all pairs are inliers. A given rival starts with the noise of its own
    residuals. If ``refine.by_residual`` is 0, only mirror images and rivals of ``replaced`` are tried. Rivals that end
    over 10 degrees from the result lower its probability.

    ``found`` is the evidence for the refined poses ``now``. A given ``rival`` that equals the refined pose is ignored.
    Where ``replaced``, bool (B,), is true, the given rival replaces the refined pose; elsewhere it is ignored.

    Returns:
        The arguments of :meth:`~kornia_pnpnet.refine.lm.RobustWeightedLM.judge`: the states, the evidence for the
        states, and the log-odds against rivals over 10 degrees away (infinite without such rivals).
    """
    problem, by_residual, pose = plan.problem, now.mixture is not None, now.state.pose
    with torch.no_grad():
        inlier = _shares(found.inlier)
        mirrored = _mirrored(pose, problem, inlier)
        away = (problem.places - _mean(problem.places, inlier)[:, None]).square().sum(-1)
        sq_spread = (inlier * away).sum(-1, keepdim=True)
        projection = project(State(mirrored, now.state.camera), problem)
        close = projection.in_front & (projection.sq_residual < _NEAR_MIRROR**2 * sq_spread)
        mirrors = valid & (found.log_ratio > 0.0) & ((inlier * close).sum(-1) > 0.5)
        free, share = valid & ~plan.votes.known[:, 0] & by_residual, found.mixture.share[:, 0]
        gap = found.likelihood - found.grid[:, _WIDE_FROM:].amax(1)
        unclear = free & (share < _CLEAR) & (gap < _GAP * plan.votes.pairs.sum(-1))
        rival, own = now.state if rival is None else rival, found.mixture
        wide = own._replace(variance=own.variance.maximum(_WIDE_ANGLE**2 * found.radian))
        if replaced is None:
            apart = valid & (share < _CLEAR_OF_RIVALS) & by_residual
            apart &= rotation_angle(rival.pose.rotation, pose.rotation) > _APART
        else:
            unclear, mirrors, apart = unclear & ~replaced, mirrors & ~replaced, replaced
        kinds = (now.state, own), (now.state, wide), (now.state._replace(pose=mirrored), own), (rival, own)
        kind, owners = torch.stack((unclear, unclear, mirrors, apart)).nonzero().unbind(1)
    if not len(owners):
        return now, found, torch.full_like(found.log_ratio, torch.inf)
    state, mixture = problems_last(map_tensors(lambda *x: torch.stack(x)[kind, owners], *kinds))
    every = taken(plan._replace(state=now.state, starts=1), owners)
    if apart.any():  # the last kind is a given rival, which starts with the noise of its own residuals
        given = kind[:, None] == len(kinds) - 1
        mixture = map_tensors(lambda x, y: torch.where(given, x, y), every.evidence_at(state).mixture, mixture)
    tried = Progress.of(state, mixture)
    step, damping, _ = plan.hyperparameters[-1]
    for i in range(_FROZEN + _FREE):
        tried = refine.by_residuals(every, tried, every.votes.known | (i < _FROZEN), step, damping)
    of_ends = every.evidence_at(tried.state)
    # The tensors below have the shape (5, B). The first index is the kind of the rival, or 0 for the refined pose.
    kind = kind + 1
    likelihood = found.likelihood.new_full((len(kinds) + 1, len(valid)), -torch.inf)
    end, others = torch.zeros_like(likelihood, dtype=torch.long), likelihood.clone()
    likelihood[0] = found.likelihood
    if replaced is not None:
        likelihood[0].masked_fill_(replaced, torch.finfo(likelihood.dtype).min)
    of_rivals = of_ends.likelihood
    for mine, its in zip(problem.terms, every.problem.terms, strict=True):
        likelihood[0] -= 0.5 * mine.loss(now.state)
        of_rivals = of_rivals - 0.5 * its.loss(tried.state)
    likelihood[kind, owners] = of_rivals.nan_to_num(-torch.inf)
    end[kind, owners] = torch.arange(len(owners), device=owners.device)
    best = likelihood.argmax(0)
    rows = best.nonzero()[:, 0]
    if by_residual and len(rows):
        at = end[best[rows], rows]
        now, found = put((now, found), rows, take((tried, of_ends), at))
        lost = rotation_angle(pose.rotation[rows], now.state.pose.rotation[rows]) > FAR_TURN
        others[0, rows] = torch.where(lost, likelihood[0, rows], -torch.inf)  # the beaten pose is a rival, too
    far = rotation_angle(tried.state.pose.rotation, now.state.pose.rotation[owners]) > FAR_TURN
    others[kind, owners] = torch.where(far, likelihood[kind, owners], -torch.inf)
    return now, found, likelihood.amax(0) - others.amax(0)


def _shares(weights: Tensor) -> Tensor:
    """Divide the weights (B, N) of each problem by their sum."""
    return weights / weights.sum(-1, keepdim=True).clamp(min=torch.finfo(weights.dtype).tiny)


def _mean(points: Tensor, shares: Tensor) -> Tensor:
    """Weighted mean (B, C) of points (B, N, C)."""
    return (shares[..., None] * points).sum(1)


def _moved(points: Tensor, pose: Pose) -> Tensor:
    """Transform points (B, 3) to the camera frame."""
    return (pose.rotation @ points[..., None])[..., 0] + pose.translation


def _mirrored(pose: Pose, problem: Problem, shares: Tensor) -> Pose:
    """Apply a half turn about the best-fit plane's normal, then the pose, then a half turn about the line of sight.

    In a rig, the line of sight starts at the mean centre of the inliers' cameras.
    """
    middle = _mean(problem.world_points, shares)
    centred = problem.world_points - middle[:, None]
    covariance = torch.bmm(centred.mT, shares[..., None] * centred)
    if covariance.device.type == "cpu":  # LAPACK raises an error for the whole batch if one matrix has NaN
        normal = torch.linalg.eigh(covariance.nan_to_num(0.0, 0.0, 0.0)).eigenvectors[..., 0]
    else:  # cuSOLVER needs 250 KiB for each matrix, and fails for 100,000 matrices
        normal = eigenvectors(covariance.permute(1, 2, 0))[0][1].mT
    seen = torch.baddbmm(pose.translation[..., None], pose.rotation, middle[..., None])
    sight = seen[..., 0] if problem.rig is None else seen[..., 0] - _mean(problem.centres, shares)
    rotation = torch.bmm(torch.bmm(half_turn(sight), pose.rotation), half_turn(normal))
    return Pose(rotation, torch.baddbmm(seen, rotation, middle[..., None], alpha=-1)[..., 0])


def _of_three(problem: Problem, weights: Tensor, fallback: Pose) -> tuple[Tensor, ...]:
    """Find four poses by P3P from three likely pairs that lie far apart. ``fallback`` replaces invalid poses."""
    likely = weights * (weights > 0.5 * weights.amax(1, keepdim=True))
    points, rows = problem.world_points, torch.arange(len(weights), device=weights.device)[:, None]

    def farthest(vectors: Tensor) -> Tensor:
        return torch.where(likely > 0, vectors.square().sum(-1), -1.0).argmax(1, keepdim=True)

    first = farthest(points - _mean(points, _shares(likely))[:, None])
    from_first = points - points[rows, first]
    second = farthest(from_first)
    third = farthest(torch.linalg.cross(from_first, from_first[rows, second].expand_as(points)))
    index = torch.cat((first, second, third), 1)
    entries, valid = minimal_poses(points[rows, index], problem.img_points[rows, index] / problem.focal)
    return torch.where(valid[..., None], entries.permute(1, 2, 0), as_entries(fallback)).unbind()


def _are_same(poses: Tensor, other: Tensor, middle: Tensor) -> Tensor:
    """Whether poses (*, B, 12) are the same minimum as ``other`` (B, 12). ``middle`` (B, 3) is the mean point."""
    pose, other_pose = as_pose(poses), as_pose(other.expand_as(poses))
    there = _moved(middle, other_pose)
    shift = (_moved(middle, pose) - there).norm(dim=-1) < _SAME * there.norm(dim=-1)
    return shift & (rotation_angle(pose.rotation, other_pose.rotation) < _SAME)
