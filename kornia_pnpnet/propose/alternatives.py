"""Other poses that explain the pairs nearly as well: mirror images of planes, other solutions of three pairs."""

from __future__ import annotations

import math
from typing import TypeVar

import torch
from torch import Tensor
from torch.nn import functional

from kornia_pnpnet.core.linalg import eigenvectors
from kornia_pnpnet.core.performance import repeat_problems
from kornia_pnpnet.core.trees import iter_tensors, map_tensors, take
from kornia_pnpnet.judge.belief import has_enough, residual_noise
from kornia_pnpnet.problem import Problem, Starts, State
from kornia_pnpnet.propose.p3p import p3p
from kornia_pnpnet.refine.lm import Refinement, RobustWeightedLM
from kornia_pnpnet.refine.residual import project, rotation_angle
from kornia_pnpnet.result import Alternatives, Pose

__all__ = ["find_alternatives", "is_seen", "mirror_probability"]

_T = TypeVar("_T")

# A pose explains the pairs nearly as well when its likelihood is at least this share of the best one's.
_LIKELY = 1e-3
# Logarithm. Poses that are this much likelier than the best one are not compared further.
_LIKELIER = 30.0
# Radians, and shares of the distance of the points: poses that are closer are the same minimum.
_SAME_TURN, _SAME_SHIFT = 0.035, 0.035
# Focal lengths. A pair that is not of normal scale is refined only when some first pose projects it this close.
_SEEN = 0.25
# Shares of the spread of the pixels. A mirror image that leaves a larger median residual has no minimum nearby that
# explains as much; of fewer likely inliers than this, any mirror image may have one.
_NEAR_MIRROR, _FEW_INLIERS = 0.2, 10
# Iterations after which mirror images are given up whose log-likelihood is this far below that of the pose.
_FIRST_LOOK, _HOPELESS = 2, -30.0
# Radians. A pose that is turned further is far off, see :attr:`~kornia_pnpnet.result.PnPResult.probability`.
_FAR_TURN = math.radians(10.0)
# For solvers that do not refine: iterations with a classical kernel.
_ITERATIONS = 20


@torch.no_grad()
def find_alternatives(
    refine: RobustWeightedLM, problem: Problem, starts: Starts, pose: Pose, valid: Tensor, most: int
) -> Alternatives:
    """Refine other starts and keep the minima that differ from the pose, and from each other, and are nearly as likely.

    The starts are the mirror image of the pose about the line of sight to the plane through the points, all poses of
    three pairs that lie far apart, and the poses of the starts. The mirror image is kept unrefined where its refinement
    ends at the pose: of a plane that is seen almost from the front, it can be nearly as likely and no minimum.

    Args:
        refine: the refinement that found the pose.
        problem: the problem.
        starts: what the refinement started from.
        pose: the pose that was found.
        valid: problems that have a pose at all, bool (B,).
        most: largest number of other poses.

    Returns:
        The other poses in the frame of the correspondences.
    """
    problem, starts, pose = map_tensors(torch.Tensor.detach, (problem, starts, pose))
    weights = problem.weights * starts.weights
    mirrored = _mirrored(pose, problem, weights)
    every = [pose, mirrored, *_of_three(problem, weights, pose), *starts.poses]
    count, batch = len(every), weights.shape[0]
    many, factors, noise = repeat_problems((problem, starts.weights, starts.noise), count)
    tried = Starts(map_tensors(lambda *x: torch.cat(x), *every), factors, noise=noise)
    refine = refine if refine.m else RobustWeightedLM(_ITERATIONS, kernel="cauchy", learnable=False)
    for _ in range(2):
        refined = refine(many, tried)
        tried = tried._replace(pose=refined.pose)
    unrefined = refine(problem, starts._replace(pose=mirrored, others=None, camera=None), m=0)
    ends, cost, usable = map_tensors(lambda x: x.unflatten(0, (count, batch)), _ends(refined))  # (S, B, ...)
    is_lost = _are_same(map_tensors(lambda x: x[1:2], ends), pose, problem, weights)[0]
    for x, image in zip(iter_tensors((ends, cost, usable)), iter_tensors(_ends(unrefined)), strict=True):
        x[1] = torch.where(is_lost.view(-1, *(1,) * (image.ndim - 1)), image, x[1])

    # From costs, which are means over the pairs, to log-likelihoods.
    unit = (problem.weights > 0).sum(-1) / _unit(problem, starts, map_tensors(lambda x: x[0], ends))
    log_ratio = (-0.5 * unit * (cost - cost[0])).clamp(max=_LIKELIER)
    log_ratio = torch.where(usable & (log_ratio > math.log(_LIKELY)), log_ratio, -torch.inf)
    log_ratio, order = log_ratio.sort(dim=0, descending=True, stable=True)
    ends, cost = _pick((ends, cost), order)
    valid = valid & log_ratio.isfinite() & ~_are_same(ends, pose, problem, weights)
    for i in range(1, count):
        same = _are_same(ends, map_tensors(lambda x: x[i], ends), problem, weights)  # noqa: B023
        valid[i] = valid[i] & ~(same[:i] & valid[:i]).any(0)
    share = torch.where(valid, log_ratio, -torch.inf).exp()
    probability = share / (1.0 + share.sum(0))

    position = (~valid).to(torch.int8).sort(dim=0, stable=True).indices[:most]
    eye = torch.eye(3, dtype=cost.dtype, device=cost.device)
    found = (ends.rotation, ends.translation, cost, probability, valid)
    fill = (eye, 0.0, torch.finfo(cost.dtype).max ** 0.5, 0.0)
    *picked, chosen = _pick(found, position)
    rotation, translation, cost, probability = (
        torch.where(chosen.view(*chosen.shape, *(1,) * (x.ndim - 2)), x, y).movedim(0, 1)
        for x, y in zip(picked, fill, strict=True)
    )
    return Alternatives(rotation, translation, cost, probability, chosen.mT)


@torch.no_grad()
def mirror_probability(
    refine: RobustWeightedLM, problem: Problem, starts: Starts, pose: Pose, ok: Tensor, cost: Tensor
) -> Tensor:
    """Probability that the mirror image of a pose, refined, is right instead of the pose.

    Only a mirror image that is far off and explains the pairs nearly as well makes a pose doubtful.

    Args:
        refine: the refinement that found the pose.
        problem: the problem.
        starts: what the refinement started from.
        pose: the pose that was found, in the frame of the problem.
        ok: which poses are to be believed otherwise, bool, shape :math:`(B,)`.
        cost: the cost of the pose, shape :math:`(B,)`.

    Returns:
        Shape :math:`(B,)`, 0 where not ``ok``.
    """
    weights = problem.weights * starts.weights
    share = _shares(weights)
    middle = (share[..., None] * problem.img_points).sum(1, keepdim=True)
    spread = (share * (problem.img_points - middle).square().sum(-1)).sum(-1, keepdim=True)
    mirrored = _mirrored(pose, problem, weights)
    projection = project(State.of(mirrored), problem)
    close = projection.in_front & (projection.sq_residual < _NEAR_MIRROR**2 * spread)
    few = (weights > 0.5).sum(-1) < _FEW_INLIERS
    rows = (ok & (few | ((share * close).sum(-1) > 0.5))).nonzero()[:, 0]
    probability = torch.zeros_like(cost)
    if not len(rows):
        return probability
    start = Starts(mirrored, starts.weights, noise=starts.noise)
    unit = 0.5 * (problem.weights > 0).sum(-1) / _unit(problem, start, pose)
    for m in (_FIRST_LOOK, refine.m):
        begun = refine.begin(take(problem, rows), take(start, rows))
        end, _ = refine.iterate(begun, m)
        of_end = refine.cost(begun, end)
        log_ratio = torch.where(of_end.isfinite(), unit[rows] * (cost[rows] - of_end), -torch.inf)
        if m < refine.m:
            rows = rows[log_ratio > _HOPELESS]
            if not len(rows):
                return probability
    usable = has_enough(project(end, begun.problem), begun.problem.weights)
    usable &= rotation_angle(end.pose.rotation, pose.rotation[rows]) > _FAR_TURN
    probability[rows] = torch.where(usable, log_ratio.sigmoid(), 0.0)
    return probability


def _ends(refined: Refinement) -> tuple[Pose, Tensor, Tensor]:
    """Poses, their costs, and whether they can be answers, all with the batch first."""
    return refined.pose, refined.cost, refined.in_front & refined.cost.isfinite()


def _pick(tree: _T, index: Tensor) -> _T:
    """Of tensors (S, B, ...) the entries of each problem at an index (K, B)."""
    problems = torch.arange(index.shape[1], device=index.device)
    return map_tensors(lambda x: x[index, problems], tree)


def _shares(weights: Tensor) -> Tensor:
    """Weights (B, N) over their sum."""
    return weights / weights.sum(-1, keepdim=True).clamp(min=torch.finfo(weights.dtype).tiny)


def _mirrored(pose: Pose, problem: Problem, weights: Tensor) -> Pose:
    """Half a turn about the normal of the plane through the points, then about the line of sight to its middle."""
    share = _shares(weights)
    middle = (share[..., None] * problem.world_points).sum(1)
    centred = problem.world_points - middle[:, None]
    covariance = centred.mT @ (share[..., None] * centred)
    if covariance.device.type == "cpu":
        normal = torch.linalg.eigh(covariance).eigenvectors[..., 0]
    else:  # cuSOLVER takes 250 KiB for each, and fails for a hundred thousand
        normal = eigenvectors(covariance.permute(1, 2, 0))[0][1].mT
    seen = (pose.rotation @ middle[..., None])[..., 0] + pose.translation
    rotation = _half_turn(seen) @ pose.rotation @ _half_turn(normal)
    return Pose(rotation, seen - (rotation @ middle[..., None])[..., 0])


def _half_turn(axis: Tensor) -> Tensor:
    axis = functional.normalize(axis, dim=-1)
    return 2.0 * axis[:, :, None] * axis[:, None] - torch.eye(3, dtype=axis.dtype, device=axis.device)


def _of_three(problem: Problem, weights: Tensor, fallback: Pose) -> list[Pose]:
    """The four poses of three likely pairs that lie far apart; the fallback where there are fewer."""
    likely = weights * (weights > 0.5 * weights.amax(1, keepdim=True))
    points, rows = problem.world_points, torch.arange(len(weights), device=weights.device)[:, None]

    def farthest(vectors: Tensor) -> Tensor:
        return torch.where(likely > 0, vectors.square().sum(-1), -1.0).argmax(1, keepdim=True)

    middle = (likely[..., None] * points).sum(1, keepdim=True) / likely.sum(1).clamp(min=1e-30)[:, None, None]
    first = farthest(points - middle)
    from_first = points - points[rows, first]
    second = farthest(from_first)
    third = farthest(torch.linalg.cross(from_first, from_first[rows, second].expand_as(points)))
    index = torch.cat((first, second, third), 1)
    solved = p3p(points[rows, index], problem.img_points[rows, index] / problem.focal)
    valid, (rotation, translation) = solved.valid, solved.pose
    rotation = torch.where(valid[..., None, None], rotation, fallback.rotation[:, None])
    translation = torch.where(valid[..., None], translation, fallback.translation[:, None])
    return list(map(Pose, rotation.unbind(1), translation.unbind(1)))


def _unit(problem: Problem, starts: Starts, pose: Pose) -> Tensor:
    """What a squared residual of one standard deviation costs, (B,)."""
    if problem.noise is not None or starts.noise is not None:
        return torch.ones_like(problem.weights[:, 0])
    noise = residual_noise(project(State.of(pose), problem), problem, problem.weights * starts.weights)
    return noise.img[:, 0].square()


def _are_same(poses: Pose, other: Pose, problem: Problem, weights: Tensor) -> Tensor:
    """Which of the poses (S, B, ...) are the other pose (B, ...), bool (S, B)."""
    share = _shares(weights)
    middle = (share[..., None] * problem.world_points).sum(1)
    seen = (poses.rotation @ middle[..., None])[..., 0] + poses.translation
    there = (other.rotation @ middle[..., None])[..., 0] + other.translation
    shift = (seen - there).norm(dim=-1) < _SAME_SHIFT * there.norm(dim=-1)
    return shift & (rotation_angle(poses.rotation, other.rotation.expand_as(poses.rotation)) < _SAME_TURN)


def is_seen(starts: Starts, problem: Problem) -> Tensor:
    """Whether any of the poses projects a point close to its pixel, bool (B, N)."""
    starts, problem = map_tensors(torch.Tensor.detach, (starts, problem))
    limit = (_SEEN * problem.focal) ** 2
    projections = [project(State.of(pose), problem) for pose in starts.poses]
    return torch.stack([x.in_front & (x.sq_residual < limit) for x in projections]).any(0)
