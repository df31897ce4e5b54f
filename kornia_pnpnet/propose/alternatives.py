"""Find other poses that explain the pairs nearly as well as the refined pose."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from kornia_pnpnet.core.linalg import eigenvectors
from kornia_pnpnet.core.performance import repeat_problems
from kornia_pnpnet.core.trees import map_tensors, take
from kornia_pnpnet.judge.belief import has_enough, residual_noise
from kornia_pnpnet.problem import Problem, Starts, State
from kornia_pnpnet.propose.p3p import p3p
from kornia_pnpnet.propose.scoring import as_entries, as_pose
from kornia_pnpnet.refine.lm import Refinement, RobustWeightedLM
from kornia_pnpnet.refine.residual import project, rotation_angle
from kornia_pnpnet.result import Alternatives, Pose

__all__ = ["find_alternatives", "mirror_probability"]

# Another pose is kept when its likelihood is at least this fraction of the likelihood of the refinement's pose.
_LIKELY = 1e-3
# Upper bound of the logarithm of this likelihood ratio, so that the exponential does not overflow.
_LIKELIER = 30.0
# Two poses are the same minimum if their rotations differ by less than `_SAME_TURN` radians and their positions by less
# than `_SAME_SHIFT`. A position is the mean point in the camera frame, in units of its distance from the camera.
_SAME_TURN, _SAME_SHIFT = 0.035, 0.035
# A mirror image is refined if its median residual is below the first number times the spread of the pixels. With fewer
# likely inliers than the second number, the mirror image is always refined.
_NEAR_MIRROR, _FEW_INLIERS = 0.2, 10
# After the first number of iterations, a mirror image is dropped if its log-likelihood minus the log-likelihood of the
# pose is below the second number.
_FIRST_LOOK, _HOPELESS = 2, -30.0
# A mirror image within this angle (radians) of the pose does not lower the pose's
# :attr:`~kornia_pnpnet.result.PnPResult.probability`.
_FAR_TURN = math.radians(10.0)
# If the solver does not refine (``m=0``), other poses are refined by this number of iterations with a Cauchy kernel.
_ITERATIONS = 20


@torch.no_grad()
def find_alternatives(
    refine: RobustWeightedLM, problem: Problem, starts: Starts, pose: Pose, valid: Tensor, most: int
) -> Alternatives:
    """Find other minima that are nearly as likely as the pose. All minima differ from the pose and from each other.

    One start of the refinement is the mirror image of the pose, see `_mirrored`. Four starts are the P3P solutions of
    three pairs that lie far apart. The other starts are the poses of ``starts``. When the camera sees a plane almost
    from the front, the mirror image can be nearly as likely as the pose without being a minimum. If the refinement of
    the mirror image ends at the pose, the unrefined mirror image is therefore used.

    Args:
        refine: the refinement that found the pose.
        problem: the problem.
        starts: the starts from which the refinement found the pose.
        pose: the pose that the refinement found, in the frame of the problem.
        valid: which problems are valid (see :class:`~kornia_pnpnet.frame.Frame`), bool (B,).
        most: largest number of other poses.

    Returns:
        The other poses in the frame of the problem.
    """
    problem, starts, pose = map_tensors(torch.Tensor.detach, (problem, starts, pose))
    weights = problem.weights * starts.weights
    middle = _mean(problem.world_points, weights)
    mirrored = _mirrored(pose, problem, weights)
    every = [*map(as_entries, (pose, mirrored)), *_of_three(problem, weights, pose), *map(as_entries, starts.poses)]
    count, batch = len(every), weights.shape[0]
    many, factors, noise = repeat_problems((problem, starts.weights, starts.noise), count)
    tried = Starts(as_pose(torch.cat(every)), factors, noise=noise)
    refine = refine if refine.m else RobustWeightedLM(_ITERATIONS, kernel="cauchy", learnable=False)
    for _ in range(2):
        refined = refine(many, tried)
        tried = tried._replace(pose=refined.pose)
    unrefined = refine(problem, starts._replace(pose=mirrored, others=None, camera=None), m=0)
    ends, cost, usable = (x.unflatten(0, (count, batch)) for x in _ends(refined))  # (S, B, ...)
    lost = _are_same(ends[1], every[0], middle)
    for x, image in zip((ends, cost, usable), _ends(unrefined), strict=True):
        x[1, lost] = image[lost]

    # Costs are means over the pairs. Log-likelihoods are sums over the pairs.
    unit = (problem.weights > 0).sum(-1) / _unit(problem, starts, as_pose(ends[0]))
    log_ratio = (-0.5 * unit * (cost - cost[0])).clamp(max=_LIKELIER)
    log_ratio = torch.where(usable & (log_ratio > math.log(_LIKELY)), log_ratio, -torch.inf)
    log_ratio, order = log_ratio.sort(dim=0, descending=True, stable=True)
    ends, cost = ends.take_along_dim(order[..., None], 0), cost.take_along_dim(order, 0)
    valid = valid & log_ratio.isfinite() & ~_are_same(ends, every[0], middle)
    for i in range(1, count):
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


@torch.no_grad()
def mirror_probability(
    refine: RobustWeightedLM, problem: Problem, starts: Starts, pose: Pose, ok: Tensor, cost: Tensor
) -> Tensor:
    """Compute the probability (B,) that the refined mirror image is the correct pose instead of the given pose.

    The probability is 0 if the pose is not ``ok``, or if the refined mirror image is within 10 degrees of the pose.

    Args:
        refine: See find_alternatives.
        problem: See find_alternatives.
        starts: See find_alternatives.
        pose: See find_alternatives.
        ok: which poses pass all other tests, bool (B,).
        cost: the costs of the poses, (B,).
    """
    weights = problem.weights * starts.weights
    away = (problem.img_points - _mean(problem.img_points, weights)[:, None]).square().sum(-1)
    spread = _mean(away[..., None], weights)
    mirrored = _mirrored(pose, problem, weights)
    projection = project(State.of(mirrored), problem)
    close = projection.in_front & (projection.sq_residual < _NEAR_MIRROR**2 * spread)
    few = (weights > 0.5).sum(-1) < _FEW_INLIERS
    rows = (ok & (few | (_mean(close[..., None], weights)[:, 0] > 0.5))).nonzero()[:, 0]
    probability = torch.zeros_like(cost)
    start = Starts(mirrored, starts.weights, noise=starts.noise)
    for m in (_FIRST_LOOK, refine.m):
        if not len(rows):
            return probability
        begun = refine.begin(take(problem, rows), take(start, rows))
        end, _ = refine.iterate(begun, m)
        of_end = refine.cost(begun, end)
        unit = 0.5 * (begun.problem.weights > 0).sum(-1) / _unit(problem, start, pose)[rows]
        log_ratio = torch.where(of_end.isfinite(), unit * (cost[rows] - of_end), -torch.inf)
        if m < refine.m:
            rows = rows[log_ratio > _HOPELESS]
    usable = has_enough(project(end, begun.problem), begun.problem.weights)
    usable &= rotation_angle(end.pose.rotation, pose.rotation[rows]) > _FAR_TURN
    probability[rows] = torch.where(usable, log_ratio.sigmoid(), 0.0)
    return probability


def _ends(refined: Refinement) -> tuple[Tensor, Tensor, Tensor]:
    """Entries and costs of the refined poses. A pose is usable if its cost is finite and enough points are in front."""
    return as_entries(refined.pose), refined.cost, refined.in_front & refined.cost.isfinite()


def _mean(points: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean (B, C) of points (B, N, C)."""
    total = weights.sum(-1, keepdim=True).clamp(min=torch.finfo(weights.dtype).tiny)
    return ((weights / total)[..., None] * points).sum(1)


def _moved(points: Tensor, pose: Pose) -> Tensor:
    """Transform points (B, 3) to the camera frame."""
    return (pose.rotation @ points[..., None])[..., 0] + pose.translation


def _mirrored(pose: Pose, problem: Problem, weights: Tensor) -> Pose:
    """Apply a half turn about the plane's normal, then the pose, then a half turn about the line of sight."""
    middle = _mean(problem.world_points, weights)
    centred = problem.world_points - middle[:, None]
    covariance = centred.mT @ (weights[..., None] * centred)
    if covariance.device.type == "cpu":
        normal = torch.linalg.eigh(covariance).eigenvectors[..., 0]
    else:  # cuSOLVER takes 250 KiB for each matrix, and fails for 100,000 matrices
        normal = eigenvectors(covariance.permute(1, 2, 0))[0][1].mT
    seen = _moved(middle, pose)
    rotation = _half_turn(seen) @ pose.rotation @ _half_turn(normal)
    return Pose(rotation, seen - (rotation @ middle[..., None])[..., 0])


def _half_turn(axis: Tensor) -> Tensor:
    axis = functional.normalize(axis, dim=-1)
    return 2.0 * axis[:, :, None] * axis[:, None] - torch.eye(3, dtype=axis.dtype, device=axis.device)


def _of_three(problem: Problem, weights: Tensor, fallback: Pose) -> tuple[Tensor, ...]:
    """Solve P3P for three likely pairs that lie far apart. ``fallback`` replaces invalid solutions among the four."""
    likely = weights * (weights > 0.5 * weights.amax(1, keepdim=True))
    points, rows = problem.world_points, torch.arange(len(weights), device=weights.device)[:, None]

    def farthest(vectors: Tensor) -> Tensor:
        return torch.where(likely > 0, vectors.square().sum(-1), -1.0).argmax(1, keepdim=True)

    first = farthest(points - _mean(points, likely)[:, None])
    from_first = points - points[rows, first]
    second = farthest(from_first)
    third = farthest(torch.linalg.cross(from_first, from_first[rows, second].expand_as(points)))
    index = torch.cat((first, second, third), 1)
    solved = p3p(points[rows, index], problem.img_points[rows, index] / problem.focal)
    entries = torch.where(solved.valid[..., None], as_entries(solved.pose), as_entries(fallback)[:, None])
    return entries.unbind(1)


def _unit(problem: Problem, starts: Starts, pose: Pose) -> Tensor:
    """Squared standard deviation (B,) in the unit of the refinement's cost."""
    if problem.noise is not None or starts.noise is not None:
        return torch.ones_like(problem.weights[:, 0])
    noise = residual_noise(project(State.of(pose), problem), problem, problem.weights * starts.weights)
    return noise.img[:, 0].square()


def _are_same(poses: Tensor, other: Tensor, middle: Tensor) -> Tensor:
    """Whether poses (*, B, 12) are the same minimum as ``other`` (B, 12). ``middle`` (B, 3) is the mean point."""
    pose, other_pose = as_pose(poses), as_pose(other.expand_as(poses))
    there = _moved(middle, other_pose)
    shift = (_moved(middle, pose) - there).norm(dim=-1) < _SAME_SHIFT * there.norm(dim=-1)
    return shift & (rotation_angle(pose.rotation, other_pose.rotation) < _SAME_TURN)
