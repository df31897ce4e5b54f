r"""The search of RANSAC: solve minimal samples, score their poses, and improve the best poses on their inliers."""

from __future__ import annotations

import math
from typing import Protocol

import torch
from torch import Tensor

from kornia_pnpnet.core.linalg import solve_positive
from kornia_pnpnet.core.performance import compiling, kept_at_once, present_first
from kornia_pnpnet.core.trees import map_tensors, pairs_at, take
from kornia_pnpnet.judge.evidence import pose_sigma
from kornia_pnpnet.judge.inliers import Thresholds, judge, median_residual, residual_noise
from kornia_pnpnet.problem import MIN_PAIRS, Problem, State
from kornia_pnpnet.propose.minimal import MinimalSolver
from kornia_pnpnet.propose.p3p_rig import P3PRig
from kornia_pnpnet.propose.sampling import Samples, agreement_of_neighbours, ranked
from kornia_pnpnet.propose.scoring import Scene, Scorer, as_entries, as_pose
from kornia_pnpnet.refine.residual import Projection, moved, normal_equations, project
from kornia_pnpnet.refine.terms import add_term
from kornia_pnpnet.result import Pose

__all__ = ["CAUCHY", "Search", "are_open", "cauchy_scale", "least_squares"]

#: Scale of the Cauchy kernel in standard deviations.
CAUCHY = 3.4

# Poses are compared and improved in this dtype. At a focal length of 3400 px, rounding errors are about 1e-4 px.
_DTYPE = torch.float32
# Largest number of samples that a CPU solves and scores at once, so that the tensors fit into a core's caches.
_SAMPLES_AT_ONCE = 8192
# A round has _GROWTH times the samples of all earlier rounds, but at least `min_samples` and at most _LARGEST_ROUND.
_GROWTH, _LARGEST_ROUND = 0.5, 4096
# A round draws all remaining samples if they fill at most _ROUNDS_LEFT rounds, or if at most _FEW_SAMPLES are left.
# With few pairs, the pose then does not depend on the order of pairs, and rounding does not decide when a search ends.
_ROUNDS_LEFT, _FEW_SAMPLES = 2, 120
# After k samples, the first scoring of a round uses _PAIRS_BY_SAMPLES * k^(1/3) pairs, but at least _FIRST_PAIRS. If k
# samples did not suffice for a confidence of 0.999, the share w of inliers is below (7 / k)^(1/3). Among 3 / w pairs,
# at least one is an inlier with a probability of 95 %.
_FIRST_PAIRS, _PAIRS_BY_SAMPLES = 24, 3.0 / 7.0 ** (1 / 3)
# A minimal solver fills about a quarter of its slots. After each scoring of a round, the best half of the poses is
# scored again by four times as many pairs. If fewer poses were kept, the best pose could be lost: with 90 % outliers,
# the first pairs contain few inliers.
_FILLED_ONE_IN, _KEPT_ONE_IN, _MORE = 4, 2, 4
# If (slots for poses) x (pairs) is at most this number, scoring the empty slots is faster than removing them.
_FEW_RESIDUALS = 4096
# Each round improves the _IMPROVED poses of smallest loss. The best improved pose is then improved again.
_IMPROVED = 3
# Samples are solved in multiples of this number, so that they fill the vector registers of a processor.
_VECTOR = 64
# Square of the wider threshold at which rivals are scored, divided by the squared inlier threshold.
_WIDER = 16.0
# A Newton step maps a matrix M to N. For a rotation, N = M, and the entrywise product of M and N sums to 3. If the sum
# differs from 3 by at least this number, M is not a rotation.
_FAR_FROM_ROTATION = 0.1
# Relative damping of a least-squares step. The damping is small, because the start is close to the minimum.
_DAMPING = 1e-6
# If `pose_sigma` exceeds _OPEN, at least _OPEN_SAMPLES samples are drawn, see `are_open`. Fewer than _OPEN_PAIRS pairs
# have fewer samples of three pairs.
_OPEN, _OPEN_SAMPLES, _OPEN_PAIRS = 0.06, 256.0, 13
# Solving _PLAIN_SAMPLES samples takes as long as `agreement_of_neighbours`. After these samples, the chance of each
# pair is multiplied by (a + agreement)^b. The numbers a = _LEAST_AGREEMENT and b = _AGREEMENT_POWER are empirical.
_PLAIN_SAMPLES = 256
_LEAST_AGREEMENT, _AGREEMENT_POWER = 0.3, 1.5


class Plan(Protocol):
    """Options of a search, see :class:`~kornia_pnpnet.propose.ransac.RANSAC`."""

    minimal: MinimalSolver
    score: Scorer
    max_samples: int
    min_samples: int
    confidence: float
    seed: int


class Search:
    r"""One search for the best poses of a batch, without gradients.

    A pose is stored as the twelve entries of :math:`[R | t]`, see :func:`~kornia_pnpnet.propose.scoring.as_pose`. If
    the focal length is unknown, the last row of :math:`[R | t]` is multiplied by ``problem.focal`` and divided by the
    estimated focal length.

    Args:
        plan: options of the search.
        problem: problems. The points must be centred at the origin, because the search computes in float32.
        thresholds: inlier thresholds.
        chances: relative chances that pairs are drawn, shape :math:`(B, N)`. ``None``: all chances are equal.
        sigma: standard deviation of the pixels, shape :math:`(B, 1)` or :math:`(B, N)`. If ``None``, the search
            estimates the standard deviation from the residuals of the inliers.
        finds_rivals: whether the search finds ``rivals``.
        ranks: whether to sort the pairs by :func:`~kornia_pnpnet.propose.sampling.ranked`. Sorting makes the poses
            independent of the caller's order of the pairs.

    Attributes:
        poses: the best pose of each problem, shape :math:`(B, 12)`.
        loss: loss of the best pose, shape :math:`(B,)`. The loss of a problem without a pose is infinite.
        rivals: the unimproved pose with the least loss at wider thresholds, shape :math:`(B, 12)`.
    """

    def __init__(
        self,
        plan: Plan,
        problem: Problem,
        thresholds: Thresholds,
        chances: Tensor | None = None,
        sigma: Tensor | None = None,
        *,
        finds_rivals: bool = False,
        ranks: bool = False,
    ) -> None:
        chances = (problem.weights > 0) * (torch.ones_like(problem.weights) if chances is None else chances)
        if ranks:
            order = ranked(problem, chances > 0)
            of_pairs = problem.world_points, problem.img_points, problem.weights, problem.rig
            of_pairs, chances, thresholds, sigma = pairs_at((of_pairs, chances, thresholds, sigma), order)
            world_points, img_points, weights, rig = of_pairs
            problem = problem._replace(world_points=world_points, img_points=img_points, weights=weights, rig=rig)
        self.finds_rivals = finds_rivals
        self.plan, self.problem, self.chances = plan, problem, chances
        self.minimal = plan.minimal if problem.rig is None else P3PRig()
        self.thresholds, sigma = map_tensors(lambda x: x.to(_DTYPE), (thresholds, sigma))
        self.sigma = None if sigma is None else sigma.expand_as(problem.weights)
        self.scene = Scene.of(problem, self.thresholds, _DTYPE)
        # All numbers of a pair are adjacent, so that one operation selects pairs: (B, N, 6), or (B, N, 18) for rigs.
        of_rig = [] if problem.rig is None else [problem.rig.rotation.flatten(2), problem.rig.translation]
        self.pairs = torch.cat((problem.world_points, problem.img_points, problem.weights[..., None], *of_rig), -1)
        self.low = self.pairs.to(_DTYPE)
        batch = self.low.shape[0]
        self.poses = torch.eye(3, 4, dtype=_DTYPE, device=self.low.device).flatten().repeat(batch, 1)
        self.rivals = self.poses.clone()
        self.loss = self.low.new_full((batch,), torch.inf)
        self.rival_loss, self.needed = self.loss.clone(), self.loss.double()

    @property
    def state(self) -> State:
        """The best poses and cameras."""
        return self.states(self.poses)

    def states(self, poses: Tensor) -> State:
        """Convert ``poses`` or ``rivals`` to states in the dtype of the problem, with orthonormal rotations."""
        pose, camera = self._state(poses.to(self.problem.weights))
        # One Newton step towards the closest orthogonal matrix doubles the number of correct digits.
        rotation = 1.5 * pose.rotation - 0.5 * pose.rotation @ (pose.rotation.mT @ pose.rotation)
        # The solution of a degenerate sample can be far from a rotation, for example if rounding makes rays equal.
        is_rotation = ((rotation * pose.rotation).sum((1, 2), keepdim=True) - 3.0).abs() < _FAR_FROM_ROTATION
        rotation = torch.where(is_rotation, rotation, torch.eye(3, dtype=rotation.dtype, device=rotation.device))
        return State(Pose(rotation, pose.translation), camera)

    def run(self, given: Pose | None = None) -> None:
        """Search each problem until its samples suffice for the plan's confidence, or until all samples are drawn.

        The poses ``given``, (B, S, 3, 3) and (B, S, 3), compete with the poses of the samples.
        """
        self.samples = self.plain = self._samples(self.chances)
        totals = self.samples.totals
        rows = (self.samples.counts >= MIN_PAIRS).nonzero()[:, 0]
        if given is not None and len(rows):
            poses = as_entries(given)[rows].to(_DTYPE).mT
            valid = torch.ones_like(poses[:, 0], dtype=torch.bool)
            losses, poses = self._compared(rows, take(self.scene, rows), poses, valid)
            self.loss[rows], self.poses[rows] = losses[:, 0], poses[..., 0]
        active = (self.samples.counts >= self.samples.size).nonzero()[:, 0]
        start, stop = 0, 0
        while len(active):
            if start < _PLAIN_SAMPLES <= stop and self.problem.rig is None:
                self._prefer_agreement(active)
                self._expect(active)
            start, (size, most) = stop, self._sizes_of_round(stop)
            last = totals[active] - start <= most
            finishing, active, stop = active[last], active[~last], start + size
            if len(finishing):
                self._draw(finishing, start, int(totals[finishing].max()))
            if len(active):
                self._draw(active, start, stop)
                active = active[self.needed[active].clamp(min=self.plan.min_samples) > stop]

    def run_once(self, positions: Tensor, judges: Tensor) -> None:
        """Search in one round of given samples. No shape depends on values, as compiled and exported graphs require.

        Args:
            positions: for each sample, the positions of its pairs in the problem, shape :math:`(B, H, s)`.
            judges: positions of the pairs that score all poses, shape :math:`(B, J)`. Negative positions are ignored.
        """
        problems = torch.arange(positions.shape[0], device=positions.device)
        poses, valid = self._solved(problems, positions)
        jury = self.scene.pairs(judges.clamp(min=0))
        jury = jury._replace(weights=torch.where(judges[:, None] >= 0, jury.weights, 0.0))
        _, poses, _ = self._best_of(jury.losses(poses, self.plan.score)[0], poses, valid, _IMPROVED)
        losses = self.scene.losses(poses, self.plan.score)[0]
        self.loss, self.poses = self._improved(problems, losses, poses)

    def _state(self, poses: Tensor) -> State:
        """Convert stored poses (R, 12) to states."""
        if self.problem.free_focal is None:
            return State.of(as_pose(poses))
        first, last = poses.split((8, 4), 1)
        scale = last[:, :3].norm(dim=-1, keepdim=True).clamp(min=torch.finfo(poses.dtype).eps)
        return State(as_pose(torch.cat((first, last / scale), 1)), -scale.log())

    def _unpacked(self, values: Tensor, owners: Tensor) -> Problem:
        """Build P problems of n pairs from C numbers per pair, (C, n, P). ``owners`` (P,) are indices in the batch."""
        scales, free = take(((self.problem.img_scale, self.problem.world_scale), self.problem.free_focal), owners)
        scales, free, focal = map_tensors(lambda x: x.to(values), (scales, free, self.problem.focal))
        values = values.permute(2, 1, 0)
        rig = None if self.problem.rig is None else Pose(values[..., 6:15].unflatten(-1, (3, 3)), values[..., 15:])
        weights = values[..., 5]
        usual = torch.ones_like(weights)
        return Problem(values[..., :3], values[..., 3:5], weights, focal, *scales, usual, rig=rig, free_focal=free)

    def _projected(self, rows: Tensor, poses: Tensor) -> tuple[Problem, Thresholds, Projection]:
        """Select problems and thresholds at ``rows`` (R,), and project the points with poses (R, 12), in float32."""
        problem = self._unpacked(self.low[rows].permute(2, 1, 0).contiguous(), rows)
        return problem, take(self.thresholds, rows), project(self._state(poses), problem)

    def _samples(self, chances: Tensor) -> Samples:
        return Samples(chances, size=self.minimal.sample_size, most=self.plan.max_samples, seed=self.plan.seed)

    def _prefer_agreement(self, problems: Tensor) -> None:
        """In the given problems, multiply the chance of each pair by (a + agreement)^b, see `_PLAIN_SAMPLES`."""
        world, img, weights = take(self.problem[:3], problems)
        agreement = agreement_of_neighbours(world, img, weights > 0)
        chances = self.chances.clone()
        chances[problems] *= (_LEAST_AGREEMENT + agreement) ** _AGREEMENT_POWER
        self.samples = self._samples(chances)

    def _expect(self, at: Tensor) -> None:
        """From the inliers of the best poses, estimate the number of samples that the given problems need.

        After `_prefer_agreement`, the estimate is the geometric mean of the numbers for the old and the new chances.
        If structures repeat, outliers also have common neighbours, and the number for the new chances may be too small.
        """
        if not len(at):
            return
        rows = full_vectors(at, self.low.shape[1])
        problem, thresholds, projection = self._projected(rows, self.poses[rows])
        judged = judge(projection, problem, thresholds)
        inliers = judged.weights[: len(at)] > 0
        needed = self.samples.needed(at, inliers, self.plan.confidence)
        if self.samples is not self.plain:
            needed = (needed * self.plain.needed(at, inliers, self.plan.confidence)).sqrt()
        if self.problem.free_focal is None:
            sigma = residual_noise(projection, problem, judged.weights).img if self.sigma is None else self.sigma[rows]
            is_open = are_open(projection, problem, judged.weights > 0, sigma)[: len(at)]
            needed = torch.where(is_open, needed.clamp(min=_OPEN_SAMPLES), needed)
        self.needed[at] = needed

    def _sizes_of_round(self, done: int) -> tuple[int, int]:
        """Number of samples in the next round, and the largest number of remaining samples that one round draws."""
        size = min(max(self.plan.min_samples, int(_GROWTH * done)), _LARGEST_ROUND)
        most = max(_ROUNDS_LEFT * size, _FEW_SAMPLES if self.problem.free_focal is None else 0)
        return size, min(most, _LARGEST_ROUND)

    def _draw(self, problems: Tensor, start: int, stop: int) -> None:
        """Solve the samples ``start`` to ``stop - 1`` of some problems, and store better poses."""
        parts = problems.split(max(1, kept_at_once(_SAMPLES_AT_ONCE, problems) // (stop - start)))
        losses, poses = map_tensors(lambda *x: torch.cat(x), *(self._round(x, start, stop) for x in parts))
        better = losses[:, 0] < self.loss[problems]
        if len(at := problems[better]):
            self.loss[at], self.poses[at] = self._improved(at, losses[better], poses[better])
        # After the first round, the number of samples is also unknown where a given pose stayed the best.
        changed = better if start else self.loss[problems].isfinite()
        self._expect(problems[changed & (self.samples.totals[problems] > stop)])

    def _round(self, problems: Tensor, start: int, stop: int) -> tuple[Tensor, Tensor]:
        """Find the best poses of samples ``start`` to ``stop - 1``: ascending losses (P, K) and entries (P, 12, K).

        If a problem has many pairs, a few pairs score all poses first. More pairs then score the best poses. The number
        of pairs in the first scoring grows with ``start``, because inliers are rare if many samples had no success.
        """
        poses, valid = self._solved(problems, self.samples.positions(problems, start, stop))
        # Repeated samples of a problem are invalid, so that its best poses do not depend on the rest of the batch.
        fresh = torch.arange(start, stop, device=problems.device) < self.samples.totals[problems, None]
        slots_of_sample = valid.shape[1] // (stop - start)
        valid = valid & fresh.repeat(1, slots_of_sample)
        if valid.shape[1] * self.low.shape[1] > _FEW_RESIDUALS:
            slots = present_first(valid)[:, : max(1, int(valid.sum(1).max()))]
            poses, valid = poses.gather(2, slots[:, None].expand(-1, 12, -1)), valid.gather(1, slots)
        scene, present = take(self.scene, problems), self.samples.counts[problems]
        pairs, most = max(_FIRST_PAIRS, math.ceil(_PAIRS_BY_SAMPLES * start ** (1 / 3))), int(present.max())
        best = fresh.sum(1) * max(slots_of_sample // _FILLED_ONE_IN, 1)
        kept = torch.full_like(best, valid.shape[1])
        while 2 * pairs <= most:  # each problem keeps as many poses as it would keep alone
            best = best // _KEPT_ONE_IN
            kept = torch.where(2 * pairs <= present, best.clamp(min=_IMPROVED), kept)
            losses = scene.pairs(self.samples.spread(problems, pairs)).losses(poses, self.plan.score)[0]
            losses = losses * (2 * pairs <= present)[:, None]  # equal losses keep the order of the poses
            _, poses, valid = self._best_of(losses, poses, valid, int(kept.max()))
            valid = valid & (torch.arange(valid.shape[1], device=valid.device) < kept[:, None])
            pairs *= _MORE
        return self._compared(problems, scene, poses, valid)

    def _solved(self, problems: Tensor, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Solve samples (P, H, s) of some problems. Returns poses (P, 12, S H), and which poses are valid, (P, S H)."""
        each = positions.shape[:2]
        rows = full_vectors((positions + problems[:, None, None] * self.pairs.shape[1]).flatten(0, 1))  # (R, s)
        values = self.pairs.flatten(0, 1).index_select(0, rows.flatten()).unflatten(0, rows.shape)
        owners = full_vectors(problems.repeat_interleave(each[1]))
        pose, valid = self.minimal.hypotheses(self._unpacked(values.permute(2, 1, 0), owners))
        # The components of a pose come first, as in the memory of p3p's result, so that each component is contiguous.
        pose = map_tensors(lambda x: x.movedim((0, 1), (-1, -2)), pose)
        poses = torch.cat((pose.rotation, pose.translation[:, None]), 1).flatten(0, 1).to(_DTYPE)  # (12, S, R)
        poses, valid = (x[..., : each[0] * each[1]].unflatten(-1, each) for x in (poses, valid.mT))
        return poses.movedim(2, 0).flatten(2), valid.movedim(1, 0).flatten(1)

    def _compared(self, problems: Tensor, scene: Scene, poses: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Find the best of poses (P, 12, W): ascending losses (P, K), entries (P, 12, K). Also store better rivals."""
        losses, *wider = scene.losses(poses, self.plan.score, *[_WIDER] * self.finds_rivals)
        for each in wider:
            loss, rival, _ = self._best_of(each, poses, valid, 1)
            better = loss[:, 0] < self.rival_loss[problems]
            at = problems[better]
            self.rival_loss[at], self.rivals[at] = loss[better, 0], rival[better, :, 0]
        return self._best_of(losses, poses, valid, _IMPROVED)[:2]

    def _best_of(self, losses: Tensor, poses: Tensor, valid: Tensor, width: int) -> tuple[Tensor, Tensor, Tensor]:
        """Losses (P, K), entries (P, 12, K) and validity (P, K) of the K poses with the smallest losses, best first."""
        losses = losses.masked_fill(~valid, torch.inf)
        # Of equal losses, which are frequent, the first wins. `topk` alone would choose by the width of the batch.
        places = torch.arange(1, losses.shape[1] + 1, dtype=losses.dtype, device=losses.device)
        keys = losses.clamp(min=torch.finfo(losses.dtype).tiny ** 0.5)
        keys = keys.addcmul(keys, places, value=2.0 * torch.finfo(losses.dtype).eps)
        order = keys.topk(min(width, losses.shape[1]), largest=False).indices
        return losses.gather(1, order), poses.gather(2, order[:, None].expand(-1, 12, -1)), valid.gather(1, order)

    def _improved(self, problems: Tensor, losses: Tensor, poses: Tensor) -> tuple[Tensor, Tensor]:
        """Improve poses (P, 12, K) by a least-squares step on their inliers, and the best new pose by a second step.

        A step that does not lower the loss is undone. Returns the losses (P,) and entries (P, 12) of the best poses.
        """
        number, pairs = problems.shape[0], self.low.shape[1]
        problems, losses, poses = (full_vectors(x, pairs) for x in (problems, losses, poses))
        scene = take(self.scene, problems)
        for _ in range(2):
            owners = problems.repeat_interleave(poses.shape[2])
            problem, thresholds, projection = self._projected(owners, poses.mT.flatten(0, 1))
            pose, camera = least_squares(problem, projection, judge(projection, problem, thresholds).weights)
            entries = as_entries(pose)
            if camera.shape[1]:
                entries = torch.cat((entries[:, :8], entries[:, 8:] * (-camera).exp()), 1)
            new = entries.view_as(poses.mT).mT
            new_losses = scene.losses(new, self.plan.score)[0]
            better = (new_losses < losses) & losses.isfinite()
            losses, poses = torch.where(better, new_losses, losses), torch.where(better[:, None], new, poses)
            losses, best = losses.min(1, keepdim=True)
            poses = poses.gather(2, best[:, None].expand(-1, 12, -1))
        return losses[:number, 0], poses[:number, :, 0]


def least_squares(problem: Problem, projection: Projection, weights: Tensor, variance: Tensor | None = None) -> State:
    """Take one least-squares step. Pairs are weighted by the products of ``weights`` (B, N) and ``problem.weights``.

    If the focal length has a prior, the prior's weight depends on the ``variance`` (B, 1) of a pixel coordinate. The
    default variance is one squared pixel of the caller's image.
    """
    weights = problem.weights * weights
    equations = normal_equations(projection, problem, weights)
    for term in problem.camera_terms:
        variance = problem.img_scale.square()[:, None] if variance is None else variance
        equations = equations._replace(unit=variance.reciprocal())
        equations = add_term(equations, term.linearise(projection.state), projection.focal)
    delta, _ = solve_positive(equations.matrix, equations.gradient, weights.new_full((), _DAMPING))
    return moved(projection.state, delta / -projection.focal)


def are_open(projection: Projection, problem: Problem, inliers: Tensor, sigma: Tensor) -> Tensor:
    """Whether the inliers (B, N) determine the pose poorly, bool (B,). ``sigma`` is the noise of the pixels.

    An incorrect pose may then have as many inliers as the correct pose, for example if the camera sees a flat scene in
    a narrow field of view. More samples find more such poses. With fewer than `_OPEN_PAIRS` pairs, no pose is open.
    """
    enough = (problem.weights > 0).sum(-1) >= _OPEN_PAIRS
    if inliers.shape[1] < _OPEN_PAIRS:
        return enough
    return enough & (pose_sigma(projection, problem, inliers / sigma.square()) > _OPEN)


def cauchy_scale(sq_residuals: Tensor, there: Tensor, fitted: int = MIN_PAIRS) -> Tensor:
    """Squared scale (B, 1) of a Cauchy kernel. For the arguments, see `median_residual`."""
    median = median_residual(sq_residuals, there, fitted)  # median / (2 log 2) is the variance of a coordinate
    return CAUCHY**2 / (2.0 * math.log(2.0)) * median


def full_vectors(rows: Tensor, pairs: int = 1) -> Tensor:
    """Repeat the first row until the number of rows is a multiple of `_VECTOR`, unless each row has many pairs.

    In partly filled vectors, processors round differently, and results would depend on the position in the batch.
    """
    if compiling() or pairs > _VECTOR:
        return rows
    left_over = -len(rows) % _VECTOR
    return torch.cat((rows, rows[:1].expand(left_over, *rows.shape[1:]))) if left_over else rows
