r"""The rounds of RANSAC: solve samples, keep the best poses, improve these on their inliers, stop solved problems."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.trees import map_tensors, take
from kornia_pnpnet.judge.belief import residual_noise, rotation_sigma
from kornia_pnpnet.judge.inliers import Thresholds, judge
from kornia_pnpnet.problem import Noise, Problem, State
from kornia_pnpnet.propose.minimal import FocalHypotheses, MinimalSolver
from kornia_pnpnet.propose.sampling import Samples, agreement_of_neighbours, kept_at_once
from kornia_pnpnet.propose.scoring import Scene, Scorer
from kornia_pnpnet.refine.residual import Projection, lm_step, normal_equations, project
from kornia_pnpnet.refine.terms import add_term
from kornia_pnpnet.result import Pose

__all__ = ["PAIRS_AT_ONCE", "Found", "Plan", "Search", "full_vectors", "least_squares", "pack_pairs", "unpack_pairs"]

# Poses are compared and improved in this precision, which resolves 1e-4 px at the protocol's focal length of 3400 px.
_DTYPE = torch.float32
# Number of samples that are solved and scored together, and of pairs that are improved together: a core's caches hold
# their tensors.
_SAMPLES_AT_ONCE = 4096
PAIRS_AT_ONCE = 8 * _SAMPLES_AT_ONCE
# Number of pairs that score all poses of a round first, see `_rank`: at least the first, and the second times the cube
# root of the number of samples before. After k samples in vain at a confidence of 0.999 the share of the inliers is
# below (7 / k)^(1/3); of 3 over that share, one is an inlier with a probability of 95 %.
_FIRST_PAIRS, _PAIRS_BY_SAMPLES = 24, 3.0 / 7.0 ** (1 / 3)
# Between two rankings the number of poses is divided by the first, the number of pairs that score multiplied by the
# second. With more than 90 % outliers the few pairs that score first have hardly an inlier: more must be kept.
_KEPT_ONE_IN, _MORE = 2, 4
# Number of best poses of a round that are improved once; the best of them is then improved again.
_IMPROVED = 3
# Each round draws at least this fraction of the samples before it. More: fewer rounds, but more needless samples.
_GROWTH = 0.5
# Where no more rounds than these are left, one round draws them all.
_FEW_LEFT = 2.0
# Number of samples that are solved at once, up to multiples: twice the numbers in the longest vector of a processor.
_VECTOR = 64
# Relative damping of least squares: next to none, since the start is close to the minimum.
_DAMPING = 1e-6
# Thresholds. The first least squares use the pairs up to this limit: the pose of a noisy sample misses some inliers.
_WIDE = 3.0
# Where the inliers leave the rotation open by more than the first (standard deviation in radians), as those of a flat
# scene in a narrow field of view do, another pose may have as many: at least the second number of samples is drawn.
# Chosen on a scene with a field of view of 13 degrees; half of the angle takes twice the time at 9 pairs.
_OPEN, _OPEN_SAMPLES = 0.008, 256.0
# After this number of samples, pairs whose neighbours agree are drawn more often. Finding these takes about as long.
_PLAIN_SAMPLES = 256
# A pair without any agreement is drawn this often, relative to one unit of agreement; the exponent is empirical.
_LEAST_AGREEMENT, _AGREEMENT_POWER = 0.3, 1.5


class Plan(NamedTuple):
    """How to search, see the arguments of :class:`~kornia_pnpnet.propose.ransac.RANSAC`."""

    minimal: MinimalSolver
    scorer: Scorer
    max_samples: int
    min_samples: int
    confidence: float
    seed: int


class Found(NamedTuple):
    r"""The best state of each problem.

    Attributes:
        state: pose in the frame of the problem and zoom, in the dtype of the problem.
        loss: its loss, infinite where there is no pose, shape :math:`(B,)`.
        poses: number of poses that were scored, int64, shape :math:`(B,)`.
        samples: number of samples that were drawn, int64, shape :math:`(B,)`.
    """

    state: State
    loss: Tensor
    poses: Tensor
    samples: Tensor


class Search:
    r"""One search for the best poses of a batch, without gradients.

    Poses are 3x4 matrices :math:`[R | t]`, whose last row is divided by the zoom of an unknown focal length.

    Args:
        plan: how to search.
        problem: the problems; their world is centred, since the search runs in float32.
        thresholds: thresholds of an inlier.
        chances: how likely a pair is an inlier, up to a factor, shape :math:`(B, N)`; all the same when ``None``.
        sigma: standard deviation of the pixels, shape :math:`(B, 1)` or :math:`(B, N)`; as the residuals of the inliers
            show it when ``None``.

    Example:
        >>> from kornia_pnpnet.propose.p3p import P3P
        >>> from kornia_pnpnet.propose.scoring import SCORERS
        >>> points = torch.rand(1, 6, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> cam_points = points + torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64)
        >>> problem = Problem.of(points, 100.0 * cam_points[..., :2] / cam_points[..., 2:], 100.0)
        >>> plan = Plan(P3P(), SCORERS["msac"], max_samples=100, min_samples=32, confidence=0.999, seed=0)
        >>> found = Search(plan, problem, Thresholds(points.new_ones(1, 1), points.new_zeros(1, 1))).run()
        >>> round(found.state.pose.translation[0, 2].item(), 3), found.samples
        (5.0, tensor([20]))
    """

    def __init__(
        self,
        plan: Plan,
        problem: Problem,
        thresholds: Thresholds,
        chances: Tensor | None = None,
        sigma: Tensor | None = None,
    ) -> None:
        self.plan = plan
        self.problem = problem
        batch, device = len(problem.weights), problem.weights.device
        thresholds, sigma = map_tensors(lambda x: x.to(_DTYPE), (thresholds, sigma))
        self.limits = thresholds, None if sigma is None else sigma.expand_as(problem.weights)
        self.scene = Scene.of(problem, thresholds, _DTYPE)
        self.pairs = pack_pairs(problem)
        self.low = self.pairs.to(_DTYPE)
        self.chances = chances
        self.samples = self.plain = self._samples(chances)
        self.matrix = torch.eye(3, 4, dtype=_DTYPE, device=device).repeat(batch, 1, 1)
        self.loss = self.matrix.new_full((batch,), torch.inf)
        self.needed = self.loss.double()
        self.least = torch.zeros_like(self.needed)

    def run(self, given: Pose | None = None, enough: int = 0) -> Found:
        """Search until every problem has a sample without an outlier at the confidence, or all its samples.

        Args:
            given: :math:`S` poses of each problem that compete with those of the samples, :math:`(B, S, 3, 3)` and
                :math:`(B, S, 3)`, in the frame of the problem.
            enough: a problem whose given poses show that it needs no more samples than this is not searched.
        """
        totals = self.samples.totals
        poses, drawn = torch.zeros_like(totals), torch.zeros_like(totals)
        active = (self.samples.counts >= self.samples.size).nonzero()[:, 0]
        if given is not None and len(active):
            rotation, translation = (x.to(_DTYPE) for x in given)
            packed = self.scene.pack(rotation.permute(2, 3, 0, 1), translation.permute(2, 0, 1))
            losses, matrices = self.scene.losses(packed, self.plan.scorer)[active], self.scene.unpack(packed)[active]
            poses[active] += losses.shape[1]
            self.loss[active], best = losses.min(1)
            self.matrix[active] = matrices[torch.arange(len(best), device=best.device), best]
            self._expect(active)
            hard = self.needed[active] > enough
            self._improve(active[hard], losses[hard], matrices[hard])
            if enough:
                active = active[self.needed[active] > enough]
        start = stop = 0
        while len(active):
            if start < _PLAIN_SAMPLES <= stop and self.problem.rig is None:
                self._prefer_agreement(active)
                self._expect(active)
            start, stop = stop, self._end_of_round(stop, int(totals[active].max()))
            parts = active.split(max(1, kept_at_once(_SAMPLES_AT_ONCE, active) // (stop - start)))
            best_of_parts = [self._best_of_samples(part, start, stop) for part in parts]
            losses, matrices, scored = map_tensors(lambda *x: torch.cat(x), *best_of_parts)
            poses[active] += scored
            drawn[active] = totals[active].clamp(max=stop)
            better = (losses[:, 0] < self.loss[active]).nonzero()[:, 0]
            self._improve(active[better], losses[better], matrices[better])
            enough_samples = self.needed[active].clamp(min=self.plan.min_samples).minimum(totals[active])
            active = active[enough_samples > stop]
        pose, camera = self._state(self.matrix.to(self.problem.weights))
        return Found(State(_orthonormal(pose), camera), self.loss, poses, drawn)

    def _state(self, matrix: Tensor) -> State:
        """Pose and zoom of matrices."""
        if self.problem.free_focal is None:
            return State.of(Pose(matrix[..., :3], matrix[..., 3]))
        scale = matrix[:, 2, :3].norm(dim=-1, keepdim=True).clamp(min=torch.finfo(matrix.dtype).eps)
        matrix = torch.cat((matrix[:, :2], matrix[:, 2:] / scale[..., None]), 1)
        return State(Pose(matrix[..., :3], matrix[..., 3]), -scale.log())

    def _some(self, rows: Tensor) -> Problem:
        """Some of the problems, in the precision of the search."""
        return unpack_pairs(self.low[rows].permute(2, 1, 0).contiguous(), self.problem, rows)

    def _samples(self, chances: Tensor | None) -> Samples:
        plan, there = self.plan, self.problem.weights > 0
        return Samples(there, size=plan.minimal.sample_size, most=plan.max_samples, seed=plan.seed, chances=chances)

    def _prefer_agreement(self, problems: Tensor) -> None:
        """From now on draw the pairs of some problems in proportion to the agreement of their neighbours, too."""
        world, img, weights = (x[problems] for x in self.problem[:3])
        chances = torch.ones_like(self.problem.weights) if self.chances is None else self.chances.clone()
        agreement = agreement_of_neighbours(world, img, weights > 0)
        chances[problems] *= (_LEAST_AGREEMENT + agreement) ** _AGREEMENT_POWER
        self.samples = self._samples(chances)

    def _expect(self, at: Tensor) -> None:
        """Find how many samples some problems need, by the inliers of their best poses.

        Once agreement was counted, it is the geometric mean of the numbers with and without agreement. Neighbours also
        agree where structure repeats: such a wrong pose must not end the search too early.
        """
        rows = full_vectors(at, self.problem.weights.shape[1])
        thresholds, sigma = take(self.limits, rows)
        problem = self._some(rows)
        projection = project(self._state(self.matrix[rows]), problem)
        judged = judge(projection, problem, thresholds)
        if self.problem.free_focal is None:
            known = None if sigma is None else Noise(sigma, torch.zeros_like(sigma))
            noise = known or residual_noise(projection, problem, judged.weights)
            is_open = rotation_sigma(projection, problem, noise, judged) > _OPEN
            self.least[at] = self.least[at].where(~is_open[: len(at)], _OPEN_SAMPLES)
        inliers = judged.weights[: len(at)] > 0
        needed = self.samples.needed(at, inliers, self.plan.confidence)
        if self.samples is not self.plain:
            needed = (needed * self.plain.needed(at, inliers, self.plan.confidence)).sqrt()
        self.needed[at] = needed.maximum(self.least[at])

    def _end_of_round(self, done: int, total: int) -> int:
        """Number of samples after the next round; few that would be left go with it."""
        size = min(max(self.plan.min_samples, int(_GROWTH * done)), _SAMPLES_AT_ONCE)
        return total if done + size * _FEW_LEFT >= total and total - done <= _SAMPLES_AT_ONCE else done + size

    def _best_of_samples(self, problems: Tensor, start: int, stop: int) -> tuple[Tensor, Tensor, Tensor]:
        """Losses (P, K), ascending, and matrices (P, K, 3, 4) of the best poses; number of poses of the samples."""
        positions = self.samples.positions(problems, start, stop)  # (P, H, s)
        batch, count, size = positions.shape
        rows = (positions + problems[:, None, None] * self.problem.weights.shape[1]).flatten(0, 1)  # (P H, s)
        rows = full_vectors(rows)
        values = self.pairs.flatten(0, 1).index_select(0, rows.flatten()).view(-1, size, self.pairs.shape[2])
        owners = full_vectors(problems.repeat_interleave(count))
        solved = self.plan.minimal.hypotheses(unpack_pairs(values.permute(2, 1, 0), self.problem, owners))
        fresh = torch.arange(start, stop, device=problems.device) < self.samples.totals[problems, None]  # (P, H)
        valid = solved.valid[: batch * count].unflatten(0, (batch, count)) & fresh[..., None]
        valid = valid.mT.flatten(1)  # (P, S H)
        number = valid.sum(1)
        at, valid = _present_first(valid, number)
        row = at % count + count * torch.arange(batch, device=at.device)[:, None]
        at = (at // count * len(rows) + row).flatten()
        # The components of a pose are the first dimensions, as in p3p's results, so that selecting poses reads each
        # component from contiguous memory.
        (rotation, translation), zoom = map_tensors(
            lambda x: x.movedim((0, 1), (-1, -2)).flatten(-2).index_select(-1, at).unflatten(-1, valid.shape),
            (solved.pose, solved.zoom if isinstance(solved, FocalHypotheses) else None),
        )
        if zoom is not None:
            rotation[2] *= (scale := (-zoom).exp())
            translation[2] *= scale
        scene = take(self.scene, problems)
        losses, packed = self._rank(problems, scene, scene.pack(rotation, translation), valid, start)
        return losses, scene.unpack(packed), number

    def _rank(self, problems: Tensor, scene: Scene, packed: Tensor, valid: Tensor, done: int) -> tuple[Tensor, Tensor]:
        """Losses and poses of the best; of many pairs, a few score all poses first, then more pairs the best poses.

        After many samples in vain the share of the inliers is small, and more pairs are needed to see one of them.
        """

        def keep(judges: Scene, width: int, last: bool) -> tuple[Tensor, Tensor, Tensor]:
            """The poses with the smallest losses: losses (P, K), packed (P, 4, 3, K), valid (P, K)."""
            losses = judges.losses(packed, self.plan.scorer).masked_fill(~valid, torch.inf)
            losses, order = losses.topk(min(width, losses.shape[1]), largest=False, sorted=last)
            return losses, packed.gather(3, order[:, None, None].expand(-1, 4, 3, -1)), valid.gather(1, order)

        pairs, width = max(_FIRST_PAIRS, math.ceil(_PAIRS_BY_SAMPLES * done ** (1 / 3))), packed.shape[-1]
        while 2 * pairs <= scene.points.shape[1]:
            width = max(width // _KEPT_ONE_IN, _IMPROVED)
            _, packed, valid = keep(scene.pairs(self.samples.spread(problems, pairs)), width, last=False)
            pairs *= _MORE
        losses, packed, _ = keep(scene, _IMPROVED, last=True)
        return losses, packed

    def _improve(self, problems: Tensor, losses: Tensor, matrices: Tensor) -> None:
        """Improve all the poses (P, K) once, then the best of each problem further; it becomes the problem's pose."""
        if not len(problems):
            return
        size = max(1, kept_at_once(PAIRS_AT_ONCE, problems) // (self.problem.weights.shape[1] * losses.shape[1]))
        for at, some, part in zip(*(x.split(size) for x in (problems, losses, matrices)), strict=True):
            owners = at.repeat_interleave(some.shape[1])
            loss, matrix = self._descend(owners, some.flatten(), part.flatten(0, 1), limit=_WIDE)
            loss, best = loss.view_as(some).min(-1)
            matrix = matrix.view_as(part)[torch.arange(len(best), device=best.device), best]
            self.loss[at], self.matrix[at] = self._descend(at, loss, matrix, limit=1.0)
            self._expect(at)

    def _descend(self, problems: Tensor, loss: Tensor, matrix: Tensor, limit: float) -> tuple[Tensor, Tensor]:
        """Take one step of least squares on the pairs within ``limit`` thresholds, where it lowers the loss."""
        count = self.problem.weights.shape[1]
        rows = full_vectors(problems, count)
        some, scene = self._some(rows), take(self.scene, problems)
        wide = map_tensors(lambda x: limit * x[rows], self.limits[0])
        projection = project(self._state(full_vectors(matrix, count)), some)
        pose, camera = least_squares(some, projection, judge(projection, some, wide).weights)
        new_matrix = torch.cat((pose.rotation, pose.translation[..., None]), -1)[: len(problems)]
        if camera.shape[1]:
            zoomed = new_matrix[:, 2:] * (-camera[: len(problems), None]).exp()
            new_matrix = torch.cat((new_matrix[:, :2], zoomed), 1)
        components = new_matrix.permute(1, 2, 0)[..., None]
        new_loss = scene.losses(scene.pack(components[:, :3], components[:, 3]), self.plan.scorer)[:, 0]
        better = (new_loss < loss) & loss.isfinite()  # an invalid pose stays invalid
        return torch.where(better, new_loss, loss), torch.where(better[:, None, None], new_matrix, matrix)


def least_squares(problem: Problem, projection: Projection, weights: Tensor) -> State:
    """Take one step of least squares with the weights (B, N) times the weights of the pairs."""
    weights = problem.weights * weights
    equations = normal_equations(projection, problem, weights)
    for term in problem._replace(prior=None).terms:  # a residual of a pixel of the caller is a standard deviation
        equations = equations._replace(unit=problem.img_scale.square().reciprocal()[:, None])
        equations = add_term(equations, term.linearise(projection.state), projection.focal)
    one, damping = weights.new_ones(()), weights.new_full((), _DAMPING)
    return lm_step(equations, projection.state, projection.focal, one, damping)[0]


def pack_pairs(problem: Problem) -> Tensor:
    """The numbers of each pair side by side, (B, N, 6), in a rig (B, N, 18): pairs are selected at once."""
    rig = [] if problem.rig is None else [problem.rig.rotation.flatten(2), problem.rig.translation]
    return torch.cat((problem.world_points, problem.img_points, problem.weights[..., None], *rig), -1)


def unpack_pairs(values: Tensor, problem: Problem, owners: Tensor) -> Problem:
    """Undo :func:`pack_pairs`.

    Args:
        values: pairs of :math:`P` problems, shape :math:`(C, n, P)`.
        problem: the problems they are from.
        owners: which of these, shape :math:`(P,)`.
    """
    dtype = values.dtype
    scales, free = take(((problem.img_scale, problem.world_scale), problem.free_focal), owners)
    scales, free, focal = map_tensors(lambda x: x.to(dtype), (scales, free, problem.focal))
    values = values.permute(2, 1, 0)
    rig = Pose(values[..., 6:15].unflatten(-1, (3, 3)), values[..., 15:]) if values.shape[2] > 6 else None
    weights = values[..., 5]
    usual = torch.ones_like(weights)
    return Problem(values[..., :3], values[..., 3:5], weights, focal, *scales, usual, rig=rig, free_focal=free)


def full_vectors(rows: Tensor, pairs: int = 1) -> Tensor:
    """Repeat the first row at the end until the rows fill a processor's vectors; not where each has many pairs.

    Some arithmetic rounds differently in the remainder of the vectors. With full vectors a sample has the same poses at
    any place in the batch. Sums over many pairs may round differently: there, more rows would take more time.
    """
    left_over = -len(rows) % _VECTOR if pairs <= _VECTOR else 0
    return torch.cat((rows, rows[:1].expand(left_over, *rows.shape[1:]))) if left_over else rows


def _present_first(present: Tensor, number: Tensor) -> tuple[Tensor, Tensor]:
    """Positions of what is present, (P, K) to (P, W), and which of them are no padding.

    The width is as small as the largest number of a problem allows, and fills a processor's vectors.
    """
    width = max(1, -(-int(number.max()) // _VECTOR)) * _VECTOR
    problem, at = present.nonzero(as_tuple=True)
    rank = torch.arange(len(at), device=at.device) - (number.cumsum(0) - number)[problem]
    positions = at.new_zeros(len(present), width)
    positions[problem, rank] = at
    return positions, torch.arange(width, device=at.device) < number[:, None]


def _orthonormal(pose: Pose) -> Pose:
    """The nearest rotation to a rotation with rounding errors, by two Newton steps for the polar factor."""
    rotation = pose.rotation
    for _ in range(2):
        rotation = 1.5 * rotation - 0.5 * rotation @ (rotation.mT @ rotation)
    return Pose(rotation, pose.translation)
