"""Other poses that explain the pairs nearly as well: mirror images of planes, other solutions of three pairs."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from kornia_pnpnet.core.linalg import eigenvectors, gate
from kornia_pnpnet.core.performance import repeat_problems
from kornia_pnpnet.core.trees import map_tensors, take
from kornia_pnpnet.geometry import project, rotation_angle
from kornia_pnpnet.propose.p3p import p3p
from kornia_pnpnet.refine import RobustWeightedLM
from kornia_pnpnet.judge.belief import LEAST_PROBABILITY, has_enough, residual_noise
from kornia_pnpnet.types import Alternatives, Problem, Starts, PnPResult, Pose, Status

__all__ = ["doubt_mirrored", "find_alternatives", "is_seen"]

# A pose explains the pairs nearly as well when its likelihood is at least this share of the best one's.
_LIKELY = 1e-3
# Logarithm. Poses that are this much likelier than the best one are not compared further.
_LIKELIER = 30.0
# Radians, and shares of the distance of the points: poses that are closer are the same minimum.
_SAME_TURN, _SAME_SHIFT = 0.035, 0.035
# Focal lengths. A pair that is not near is refined only when some first guess projects it this close to its pixel.
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
    refine: RobustWeightedLM, corr: Problem, guess: Starts, pose: Pose, valid: Tensor, most: int
) -> Alternatives:
    """Refine other starts and keep the minima that differ from the pose, and from each other, and are nearly as likely.

    The starts are the mirror image of the pose about the line of sight to the plane through the points, all poses of
    three pairs that lie far apart, and the poses of the guess. The mirror image is kept unrefined where its refinement
    ends at the pose: of a plane that is seen almost from the front, it can be nearly as likely and no minimum.

    Args:
        refine: the refinement that found the pose.
        corr: normalised correspondences.
        guess: what the refinement started from.
        pose: the pose that was found.
        valid: problems that have a pose at all, bool (B,).
        most: largest number of other poses.

    Returns:
        The other poses in the frame of the correspondences.
    """
    corr, pose = corr.map(torch.Tensor.detach), map_tensors(torch.Tensor.detach, pose)
    guess = map_tensors(torch.Tensor.detach, guess)
    weights = corr.weights * guess.weights
    mirrored = _mirrored(pose, corr, weights)
    starts = [pose, mirrored, *_of_three(corr, weights, pose), *guess.poses]
    count, batch = len(starts), weights.shape[0]
    many = repeat_problems(corr, count)
    tried = Starts(
        map_tensors(lambda *x: torch.cat(x), *starts),
        repeat_problems(guess.weights, count),
        noise=repeat_problems(guess.noise, count),
    )
    refine = refine if refine.m else RobustWeightedLM(_ITERATIONS, kernel="cauchy", learnable=False)
    for _ in range(2):
        refined = refine(many, tried)
        tried = tried._replace(pose=refined.pose)
    ends = map_tensors(lambda x: x.unflatten(0, (count, batch)), refined.pose)  # (S, B, ...)
    cost = refined.cost.unflatten(0, (count, batch))
    usable = (refined.in_front & refined.cost.isfinite()).unflatten(0, (count, batch))
    unrefined = refine(corr, Starts(mirrored, guess.weights, noise=guess.noise), m=0)
    is_lost = _are_same(Pose(*(x[1:2] for x in ends)), pose, corr, weights)[0]
    for x, image in zip(
        (*ends, cost, usable),
        (*mirrored, unrefined.cost, unrefined.in_front & unrefined.cost.isfinite()),
        strict=True,
    ):
        x[1] = torch.where(is_lost.view(-1, *(1,) * (image.ndim - 1)), image, x[1])

    # From costs, which are means over the pairs, to log-likelihoods.
    unit = (corr.weights > 0).sum(-1) / _unit(corr, guess, Pose(*(x[0] for x in ends)))
    log_ratio = (-0.5 * unit * (cost - cost[0])).clamp(max=_LIKELIER)
    usable = usable & (log_ratio > torch.tensor(_LIKELY).log())
    log_ratio, order = torch.where(usable, log_ratio, -torch.inf).sort(dim=0, descending=True, stable=True)
    cost, usable = cost.gather(0, order), usable.gather(0, order)
    ends = Pose(*(x.gather(0, order.view(count, batch, *(1,) * (x.ndim - 2)).expand_as(x)) for x in ends))
    same = [_are_same(ends, Pose(*(x[i] for x in ends)), corr, weights) for i in range(count)]  # (S, B) each
    valid = usable & valid & ~_are_same(ends, pose, corr, weights)
    for i in range(1, count):
        again = (same[i][:i] & valid[:i]).any(0)
        valid[i] = valid[i] & ~again
    share = torch.where(valid, log_ratio, -torch.inf).exp()
    probability = share / (1.0 + share.sum(0))

    position = (~valid).to(torch.int8).sort(dim=0, stable=True).indices[:most]
    eye = torch.eye(3, dtype=cost.dtype, device=cost.device)
    chosen = valid.gather(0, position)

    def pick(x: Tensor, fill: Tensor | float) -> Tensor:
        shape = (*position.shape, *(1,) * (x.ndim - 2))
        picked = x.gather(0, position.view(shape).expand(-1, -1, *x.shape[2:]))
        return torch.where(chosen.view(shape), picked, fill).movedim(0, 1)

    largest = torch.finfo(cost.dtype).max ** 0.5
    picked = pick(ends.rotation, eye), pick(ends.translation, 0.0), pick(cost, largest), pick(probability, 0.0)
    return Alternatives(*picked, chosen.mT)


def doubt_mirrored(
    refine: RobustWeightedLM, corr: Problem, guess: Starts, pose: Pose, result: PnPResult, always: bool
) -> PnPResult:
    """Do not believe a pose whose mirror image, refined, is far off and explains the pairs nearly as well.

    Args:
        refine: the refinement that found the pose.
        corr: normalised correspondences.
        guess: what the refinement started from.
        pose: the pose of the result in the frame of the correspondences.
        result: the result.
        always: whether gradients flow through poses that are not believed.

    Returns:
        The result with less probability, and not ``ok`` where it is below the least.
    """
    assert result.probability is not None
    assert result.status is not None
    probability = result.probability * (1.0 - _mirror_probability(refine, corr, guess, pose, result))
    doubted = result.ok & (probability < LEAST_PROBABILITY)
    live, everywhere = ~doubted | always, torch.ones_like(doubted)
    with_gradient = ("rotation", "translation", "weights", "cost", "intrinsics", "dist")
    gated = map_tensors(lambda x: gate(x, live, everywhere, 0.0), [getattr(result, name) for name in with_gradient])
    return result._replace(
        **dict(zip(with_gradient, gated, strict=True)),
        ok=result.ok & ~doubted,
        status=result.status.masked_fill(doubted, Status.NOT_BELIEVED.value),
        probability=probability,
    )


@torch.no_grad()
def _mirror_probability(
    refine: RobustWeightedLM, corr: Problem, guess: Starts, pose: Pose, result: PnPResult
) -> Tensor:
    """Probability that not the pose is right but its mirror image, where one of them is, (B,); 0 where not ok."""
    weights = corr.weights * guess.weights
    share = _shares(weights)
    middle = (share[..., None] * corr.img_points).sum(1, keepdim=True)
    spread = (share * (corr.img_points - middle).square().sum(-1)).sum(-1, keepdim=True)
    mirrored = _mirrored(pose, corr, weights)
    projection = project(mirrored, corr)
    near = projection.in_front & (projection.sq_residual < _NEAR_MIRROR**2 * spread)
    few = (weights > 0.5).sum(-1) < _FEW_INLIERS
    rows = (result.ok & (few | ((share * near).sum(-1) > 0.5))).nonzero()[:, 0]
    probability = torch.zeros_like(share[:, 0])
    start = Starts(mirrored, guess.weights, noise=guess.noise)
    unit = 0.5 * (corr.weights > 0).sum(-1) / _unit(corr, start, pose)
    for m in (_FIRST_LOOK, refine.m):
        if not len(rows):
            return probability
        some = take(corr, rows)
        begun = refine.begin(some, take(start, rows))
        end = refine.iterate(begun, m).pose
        cost = refine.cost(begun, end)
        log_ratio = torch.where(cost.isfinite(), unit[rows] * (result.cost[rows] - cost), -torch.inf)
        if m < refine.m:
            rows = rows[log_ratio > _HOPELESS]
    usable = has_enough(project(end, some), some.weights)
    usable &= rotation_angle(end.rotation, pose.rotation[rows]) > _FAR_TURN
    probability[rows] = torch.where(usable, log_ratio.sigmoid(), 0.0)
    return probability


def _shares(weights: Tensor) -> Tensor:
    """Weights (B, N) over their sum."""
    return weights / weights.sum(-1, keepdim=True).clamp(min=torch.finfo(weights.dtype).tiny)


def _mirrored(pose: Pose, corr: Problem, weights: Tensor) -> Pose:
    """Half a turn about the normal of the plane through the points, then about the line of sight to its middle."""
    share = _shares(weights)
    middle = (share[..., None] * corr.world_points).sum(1)
    centred = corr.world_points - middle[:, None]
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


def _of_three(corr: Problem, weights: Tensor, fallback: Pose) -> list[Pose]:
    """The four poses of three likely pairs that lie far apart; the fallback where there are fewer."""
    likely = weights * (weights > 0.5 * weights.amax(1, keepdim=True))

    def farthest(size: Tensor) -> Tensor:
        return torch.where(likely > 0, size, -1.0).argmax(1, keepdim=True)

    def at(x: Tensor, index: Tensor) -> Tensor:
        return x.gather(1, index[..., None].expand(-1, -1, x.shape[-1]))

    points = corr.world_points
    middle = (likely[..., None] * points).sum(1, keepdim=True) / likely.sum(1).clamp(min=1e-30)[:, None, None]
    first = farthest((points - middle).square().sum(-1))
    second = farthest((points - at(points, first)).square().sum(-1))
    side = at(points, second) - at(points, first)
    third = farthest(torch.linalg.cross(points - at(points, first), side.expand_as(points)).square().sum(-1))
    index = torch.cat((first, second, third), 1)
    solutions = p3p(at(points, index), at(corr.img_points, index) / corr.focal)
    poses = []
    for i in range(solutions.valid.shape[1]):
        valid = solutions.valid[:, i]
        rotation = torch.where(valid[:, None, None], solutions.pose.rotation[:, i], fallback.rotation)
        poses.append(
            Pose(rotation, torch.where(valid[:, None], solutions.pose.translation[:, i], fallback.translation))
        )
    return poses


def _unit(corr: Problem, guess: Starts, pose: Pose) -> Tensor:
    """What a squared residual of one standard deviation costs, (B,)."""
    if corr.noise is not None or guess.noise is not None:
        return torch.ones_like(corr.weights[:, 0])
    noise = residual_noise(project(pose, corr), corr, corr.weights * guess.weights)
    return noise.img[:, 0].square()


def _are_same(poses: Pose, other: Pose, corr: Problem, weights: Tensor) -> Tensor:
    """Which of the poses (S, B, ...) are the other pose (B, ...), bool (S, B)."""
    share = _shares(weights)
    middle = (share[..., None] * corr.world_points).sum(1)
    seen = (poses.rotation @ middle[..., None])[..., 0] + poses.translation
    there = (other.rotation @ middle[..., None])[..., 0] + other.translation
    shift = (seen - there).norm(dim=-1) < _SAME_SHIFT * there.norm(dim=-1)
    return shift & (rotation_angle(poses.rotation, other.rotation.expand_as(poses.rotation)) < _SAME_TURN)


def is_seen(guess: Starts, corr: Problem) -> Tensor:
    """Whether any pose of a guess sees a pair's point about where its pixel is, bool (B, N)."""
    seen = []
    for pose in guess.poses:
        projection = project(map_tensors(torch.Tensor.detach, pose), corr.map(torch.Tensor.detach))
        seen.append(projection.in_front & (projection.sq_residual < (_SEEN * corr.focal) ** 2))
    return torch.stack(seen).any(0)
