r"""The rounds of RANSAC: solve samples, keep the best poses, improve these on their inliers, stop solved problems."""

from __future__ import annotations

import math
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from kornia_pnpnet.core.performance import problems_last
from kornia_pnpnet.core.trees import map_tensors, take
from kornia_pnpnet.geometry import Projection, project
from kornia_pnpnet.propose.minimal import MinimalSolver
from kornia_pnpnet.propose.sampling import Samples, agreement_of_neighbours, kept_at_once
from kornia_pnpnet.propose.scoring import Scene, Scorer
from kornia_pnpnet.refine import LMStep, lm_step
from kornia_pnpnet.judge.inliers import Thresholds, judge
from kornia_pnpnet.judge.belief import residual_noise, rotation_sigma
from kornia_pnpnet.types import Problem, Hypotheses, Noise, Pose

__all__ = ["PAIRS_PER_SAMPLE", "Found", "Plan", "Search", "full_vectors", "least_squares"]

_T = TypeVar("_T")

# Poses are compared and improved in this precision, which resolves 1e-4 px at the protocol's focal length of 3400 px.
_DTYPE = torch.float32
# Number of pairs that score all poses of a round first, see `_rank`: at least the first, and the second times the cube
# root of the number of samples before. After k samples in vain at a confidence of 0.999 the share of the inliers is
# below (7 / k)^(1/3); of 3 over that share, one is an inlier with a probability of 95 %.
_FIRST_PAIRS, _PAIRS_BY_SAMPLES = 24, 3.0 / 7.0 ** (1 / 3)
# Between two rankings the number of poses is divided by the first, the number of pairs that score multiplied by the
# second. With more than 90 % outliers the few pairs that score first have hardly an inlier: more must be kept.
_KEPT_ONE_IN, _MORE = 2, 4
# Each round draws at least this share of the samples before it. More: fewer rounds, but more needless samples.
_GROWTH = 0.5
# Where no more than this many rounds are left, one round draws them all.
_FEW_LEFT = 1.5
# Number of samples that are solved at once, up to multiples: twice the numbers in the longest vector of a processor.
_VECTOR = 64
# Relative damping of least squares: next to none, since the start is close to the minimum.
_DAMPING = 1e-6
# Thresholds. The first least squares use the pairs up to this limit: the pose of a noisy sample misses some inliers.
_WIDE = 3.0
# Where the inliers leave the rotation open by more than the first (standard deviation in radians), as those of a flat
# scene in a narrow field of view do, another pose may have as many: at least this many samples are drawn. Chosen on a
# scene with a field of view of 13 degrees; half of the angle takes twice the time at 9 pairs.
_OPEN, _OPEN_SAMPLES = 0.008, 256.0
# After this many samples, pairs whose neighbours agree are drawn more often. Finding these takes about as long.
_PLAIN_SAMPLES = 256
# A pair without any agreement is drawn this often, relative to one unit of agreement; the exponent is empirical.
_LEAST_AGREEMENT, _AGREEMENT_POWER = 0.3, 1.5
#: Number of pairs that are improved together, per sample that is solved together: both need about as much memory.
PAIRS_PER_SAMPLE = 4


class Plan(NamedTuple):
    """How to search, see the arguments of :class:`~kornia_pnpnet.propose.ransac.RANSAC`."""

    minimal: MinimalSolver
    scorer: Scorer
    max_samples: int
    min_samples: int
    confidence: float
    local_candidates: int
    local_iterations: int
    seed: int
    chunk_size: int


class Found(NamedTuple):
    r"""The best pose of each problem.

    Attributes:
        pose: the pose in the frame of the correspondences, in their dtype.
        loss: its loss, infinite where there is no pose, shape :math:`(B,)`.
        poses: number of poses that were scored, int64, shape :math:`(B,)`.
        samples: number of samples that were drawn, int64, shape :math:`(B,)`.
        zoom: logarithm of the focal length over that of the correspondences, shape :math:`(B,)`; ``None``: it is known.
    """

    pose: Pose
    loss: Tensor
    poses: Tensor
    samples: Tensor
    zoom: Tensor | None = None


class Search:
    r"""One search for the best poses of a batch, without gradients.

    Args:
        plan: how to search.
        corr: normalised correspondences whose world is centred, since the search runs in float32.
        thresholds: thresholds of an inlier, shape :math:`(B,)` each.
        chances: how likely a pair is an inlier, up to a factor, shape :math:`(B, N)`; all the same when ``None``.
        sigma: standard deviation of the pixels, shape :math:`(B,)` or :math:`(B, N)`; as the residuals of the inliers
            show it when ``None``.

    Example:
        >>> from kornia_pnpnet.propose.p3p import P3P
        >>> from kornia_pnpnet.propose.scoring import SCORERS
        >>> points = torch.rand(1, 6, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> cam_points = points + torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64)
        >>> pixels = 100.0 * cam_points[..., :2] / cam_points[..., 2:]
        >>> corr = Problem(points, pixels, torch.ones_like(pixels[..., 0]), pixels.new_tensor(100.0))
        >>> plan = Plan(P3P(), SCORERS["msac"], 100, 32, 0.999, 2, 2, 0, 4096)
        >>> found = Search(plan, corr, Thresholds(pixels.new_tensor([1.0]), pixels.new_tensor([0.0]))).run()
        >>> round(found.pose.translation[0, 2].item(), 3), found.samples
        (5.0, tensor([20]))
    """

    def __init__(
        self,
        plan: Plan,
        corr: Problem,
        thresholds: Thresholds,
        chances: Tensor | None = None,
        sigma: Tensor | None = None,
    ) -> None:
        self.plan = plan
        self.corr = corr
        self.low = map_tensors(lambda x: x.to(_DTYPE), (corr, thresholds))
        if sigma is not None:
            sigma = (sigma if sigma.ndim > 1 else sigma[:, None]).to(_DTYPE).expand_as(corr.weights)
        self.sigma = sigma
        self.scene = Scene.make(corr, thresholds, _DTYPE)
        self.chances = chances
        self.samples = self.plain = self._samples(chances)
        # The numbers of a pair side by side, so that a sample is gathered pair by pair.
        values = [corr.world_points, corr.img_points, corr.weights[..., None]]
        if corr.rig is not None:
            values += [corr.rig.rotation.flatten(2), corr.rig.translation]
        self.pairs = torch.cat(values, -1).flatten(0, 1)

    def run(self, given: Pose | None = None, worth: int = 0) -> Found:
        """Search until every problem has a sample without an outlier at the confidence, or all its samples.

        Args:
            given: :math:`S` poses of each problem that compete with those of the samples, :math:`(B, S, 3, 3)` and
                :math:`(B, S, 3)`, in the frame of the correspondences.
            worth: number of samples that the given poses count as. A problem that needs no more is not searched.
        """
        plan, totals = self.plan, self.samples.totals
        batch, count = self.corr.weights.shape
        device = self.corr.weights.device
        matrix = torch.eye(3, 4, dtype=_DTYPE, device=device).repeat(batch, 1, 1)
        loss = matrix.new_full((batch,), torch.inf)
        poses, drawn = torch.zeros(2, batch, dtype=torch.long, device=device)
        needed = loss.double()
        least = torch.zeros_like(needed)
        active = (self.samples.counts >= self.samples.size).nonzero()[:, 0]

        def expect(at: Tensor) -> None:
            rows = full_vectors(at, count)
            corr, thresholds, sigma = take((*self.low, self.sigma), rows)
            pose, zoom = self._camera(matrix[rows])
            corr = problems_last(corr).zoomed(zoom)
            projection = project(pose, corr)
            judged = judge(projection, corr, thresholds)
            if corr.free_focal is None:
                told = None if sigma is None else Noise(sigma, torch.zeros_like(sigma))
                noise = told or residual_noise(projection, corr, judged.weights)
                is_open = rotation_sigma(projection, corr._replace(noise=noise), judged) > _OPEN
                least[at] = least[at].where(~is_open[: len(at)], _OPEN_SAMPLES)
            needed[at] = self._needed(at, judged.weights[: len(at)] > 0).maximum(least[at])

        def improve(at: Tensor, losses: Tensor, matrices: Tensor) -> None:
            if not len(at):
                return
            size = max(1, kept_at_once(PAIRS_PER_SAMPLE * plan.chunk_size, at) // (count * losses.shape[1]))
            for one, some, part in zip(*(x.split(size) for x in (at, losses, matrices)), strict=True):
                loss[one], matrix[one] = self._improve(one, some, part)
                expect(one)

        if given is not None and len(active):
            rotation, translation = (x.to(_DTYPE) for x in given)
            packed = self.scene.pack(rotation.permute(2, 3, 0, 1), translation.permute(2, 0, 1))
            matrices = torch.cat((rotation, translation[..., None]), -1)
            losses, matrices = self.scene.losses(packed, plan.scorer)[active], matrices[active]
            loss[active], best = losses.min(1)
            matrix[active] = matrices[torch.arange(len(best), device=device), best]
            poses[active] += rotation.shape[1]
            expect(active)
            hard = needed[active] > worth
            improve(active[hard], losses[hard], matrices[hard])
            if worth:
                active = active[needed[active] > worth]
        start = stop = 0
        while len(active):
            if start < _PLAIN_SAMPLES <= stop and self.corr.rig is None:
                self._prefer_agreement(active)
                expect(active)
            start, stop = stop, self._end_of_round(stop, int(totals[active].max()))
            parts = active.split(max(1, kept_at_once(plan.chunk_size, active) // (stop - start)))
            tops = [self._best_of_samples(part, start, stop) for part in parts]
            top_losses, top_matrices, tested = (torch.cat(parts) for parts in zip(*tops, strict=True))
            poses[active] += tested
            drawn[active] = totals[active].clamp(max=stop)
            better = (top_losses[:, 0] < loss[active]).nonzero()[:, 0]
            improve(active[better], top_losses[better], top_matrices[better])
            active = active[needed[active].clamp(min=plan.min_samples).minimum(totals[active]) > stop]
        pose, zoom = self._camera(matrix.to(self.corr.weights))
        return Found(_orthonormal(pose), loss, poses, drawn, zoom)

    def _camera(self, matrix: Tensor) -> tuple[Pose, Tensor | None]:
        """Pose and zoom from a :func:`_matrix`."""
        if self.corr.free_focal is None:
            return Pose(matrix[..., :3], matrix[..., 3]), None
        scale = matrix[:, 2, :3].norm(dim=-1).clamp(min=torch.finfo(matrix.dtype).eps)
        matrix = torch.cat((matrix[:, :2], matrix[:, 2:] / scale[:, None, None]), 1)
        return Pose(matrix[..., :3], matrix[..., 3]), -scale.log()

    def _prefer_agreement(self, problems: Tensor) -> None:
        """From now on draw the pairs of some problems in proportion to the agreement of their neighbours, too."""
        corr, there = self.corr, self.corr.weights > 0
        agreement = agreement_of_neighbours(*(x[problems] for x in (corr.world_points, corr.img_points, there)))
        chances = torch.ones_like(corr.weights) if self.chances is None else self.chances.clone()
        chances[problems] *= (_LEAST_AGREEMENT + agreement) ** _AGREEMENT_POWER
        self.samples = self._samples(chances)

    def _needed(self, problems: Tensor, inliers: Tensor) -> Tensor:
        """Number of samples to draw, (P,); of the numbers with and without agreement the geometric mean.

        Neighbours also agree where structure repeats: such a wrong pose must not end the search too early.
        """
        needed = self.samples.needed(problems, inliers, self.plan.confidence)
        if self.samples is self.plain:
            return needed
        return (needed * self.plain.needed(problems, inliers, self.plan.confidence)).sqrt()

    def _samples(self, chances: Tensor | None) -> Samples:
        plan = self.plan
        there = self.corr.weights > 0
        return Samples(there, size=plan.minimal.sample_size, most=plan.max_samples, seed=plan.seed, chances=chances)

    def _end_of_round(self, done: int, total: int) -> int:
        """Number of samples after the next round; few that would be left go with it."""
        size = min(max(self.plan.min_samples, int(_GROWTH * done)), self.plan.chunk_size)
        return total if done + size * _FEW_LEFT >= total and total - done <= self.plan.chunk_size else done + size

    def _best_of_samples(self, problems: Tensor, start: int, stop: int) -> tuple[Tensor, Tensor, Tensor]:
        """Losses (P, K), ascending, and matrices (P, K, 3, 4) of the best poses; number of poses of the samples."""
        scene = self.scene.of(problems)
        positions = self.samples.positions(problems, start, stop)  # (P, H, s)
        batch, count, size = positions.shape
        rows = (positions + problems[:, None, None] * self.corr.weights.shape[1]).flatten(0, 1)  # (P H, s)
        rows = full_vectors(rows)
        values = self.pairs.index_select(0, rows.flatten()).view(-1, size, self.pairs.shape[1])
        world, img, weights, rig = values.split((3, 2, 1, values.shape[-1] - 6), -1)
        owners = full_vectors(problems.repeat_interleave(count))
        img_scale, world_scale, free = take((self.corr.img_scale, self.corr.world_scale, self.corr.free_focal), owners)
        sample = Problem(world, img, weights[..., 0], self.corr.focal, img_scale, world_scale, free_focal=free)
        if self.corr.rig is not None:
            sample = sample._replace(rig=Pose(rig[..., :9].unflatten(-1, (3, 3)), rig[..., 9:]))
        solved = self.plan.minimal.hypotheses(sample)
        fresh = torch.arange(start, stop, device=problems.device) < self.samples.totals[problems, None]  # (P, H)
        valid = solved.valid[: batch * count].unflatten(0, (batch, count)) & fresh[..., None]
        valid = valid.mT.flatten(1)  # (P, S H)
        number = valid.sum(1)
        at, valid = _present_first(valid, _VECTOR)
        row = at % count + count * torch.arange(batch, device=at.device)[:, None]
        at = (at // count * len(rows) + row).flatten()
        # Components first, the layout of p3p's results: each is selected along a row of memory.
        pose, zoom = map_tensors(
            lambda x: x.movedim((0, 1), (-1, -2)).flatten(-2).index_select(-1, at).unflatten(-1, valid.shape),
            (solved.pose, solved.zoom if isinstance(solved, Hypotheses) else None),
        )
        rotation, translation = pose
        if zoom is not None:
            rotation[2] *= (scale := (-zoom).exp())
            translation[2] *= scale
        losses, packed = self._rank(problems, scene, scene.pack(rotation, translation), valid, start)
        return losses, scene.unpack(packed), number

    def _rank(self, problems: Tensor, scene: Scene, packed: Tensor, valid: Tensor, done: int) -> tuple[Tensor, Tensor]:
        """Losses and poses of the best; of many pairs, a few score all poses first, then more pairs the best poses.

        After many samples in vain the share of the inliers is small, and more pairs are needed to see one of them.
        """
        pairs, width = max(_FIRST_PAIRS, math.ceil(_PAIRS_BY_SAMPLES * done ** (1 / 3))), packed.shape[-1]
        while 2 * pairs <= scene.points.shape[1]:
            some = scene.pairs(self.samples.spread(problems, pairs))
            width = max(width // _KEPT_ONE_IN, self.plan.local_candidates)
            _, packed, valid = self._keep(some, packed, valid, width, ordered=False)
            pairs *= _MORE
        losses, packed, _ = self._keep(scene, packed, valid, self.plan.local_candidates)
        return losses, packed

    def _keep(
        self, scene: Scene, packed: Tensor, valid: Tensor, width: int, *, ordered: bool = True
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The poses with the smallest losses: losses (P, K), packed (P, 4, 3, K), valid (P, K)."""
        losses = scene.losses(packed, self.plan.scorer).masked_fill(~valid, torch.inf)
        losses, order = losses.topk(min(width, losses.shape[1]), largest=False, sorted=ordered)
        return losses, packed.gather(3, order[:, None, None].expand(-1, 4, 3, -1)), valid.gather(1, order)

    def _improve(self, problems: Tensor, losses: Tensor, matrices: Tensor) -> tuple[Tensor, Tensor]:
        """Improve all the poses (P, K) once, then the best of each problem further; losses (P,), matrices."""
        loss, matrix = losses.flatten(), matrices.flatten(0, 1)  # (P K,), (P K, 3, 4)
        rows = problems.repeat_interleave(losses.shape[1])
        for i in range(self.plan.local_iterations):
            loss, matrix = self._descend(rows, loss, matrix, limit=_WIDE if i == 0 else 1.0)
            if i == 0:
                loss, best = loss.view_as(losses).min(-1)
                matrix = matrix.view_as(matrices)[torch.arange(len(best), device=best.device), best]
                rows = problems
        return loss, matrix

    def _descend(self, problems: Tensor, loss: Tensor, matrix: Tensor, limit: float) -> tuple[Tensor, Tensor]:
        """Take one step of least squares on the pairs within ``limit`` thresholds, where it lowers the loss."""
        count = self.corr.weights.shape[1]
        corr, thresholds = take(self.low, full_vectors(problems, count))
        start, zoom = self._camera(full_vectors(matrix, count))
        corr = problems_last(corr).zoomed(zoom)
        scene = self.scene.of(problems)
        projection = project(start, corr)
        wide = map_tensors(lambda x: limit * x, thresholds)
        moved = least_squares(corr, start, projection, judge(projection, corr, wide).weights)
        new_matrix = take(_matrix(moved.pose, moved.zoom_after(zoom)), slice(len(problems)))
        packed = scene.pack(new_matrix[..., :3].permute(1, 2, 0)[..., None], new_matrix[..., 3].mT[..., None])
        new_loss = scene.losses(packed, self.plan.scorer)[:, 0]
        better = (new_loss < loss) & loss.isfinite()  # an invalid pose stays invalid
        return torch.where(better, new_loss, loss), torch.where(better[:, None, None], new_matrix, matrix)


def least_squares(corr: Problem, pose: Pose, projection: Projection, weights: Tensor) -> LMStep:
    """Take one step of least squares with the weights (B, N) times the weights of the pairs."""
    one, damping = corr.weights.new_ones(()), corr.weights.new_full((), _DAMPING)
    weights = corr.weights * weights
    if corr.free_focal is not None:  # beside a prior, weights are inverse square pixels
        weights = weights / corr.free_focal.pixel.square()[:, None]
    return lm_step(corr._replace(prior=None), pose, projection, weights, one, damping)


def full_vectors(rows: Tensor, pairs: int = 1) -> Tensor:
    """Repeat the first row at the end until the rows fill a processor's vectors; not where each has many pairs.

    Some arithmetic rounds differently in the remainder of the vectors. With full vectors a sample has the same poses at
    any place in the batch. Sums over many pairs may round differently: there, more rows would take more time.
    """
    left_over = -len(rows) % _VECTOR if pairs <= _VECTOR else 0
    return torch.cat((rows, rows[:1].expand(left_over, *rows.shape[1:]))) if left_over else rows


def _present_first(present: Tensor, multiple: int) -> tuple[Tensor, Tensor]:
    """Positions of what is present, (P, K) to (P, W), and which of them are no padding; W: a multiple, as few as do."""
    number = present.sum(1)
    width = multiple * -(-int(number.max()) // multiple) or multiple
    problem, at = present.nonzero(as_tuple=True)
    first = number.cumsum(0) - number
    rank = torch.arange(len(at), device=at.device) - first[problem]
    positions = at.new_zeros(len(present), width)
    positions[problem, rank] = at
    return positions, torch.arange(width, device=at.device) < number[:, None]


def _matrix(pose: Pose, zoom: Tensor | None) -> Tensor:
    r"""The projection matrix :math:`[R | t]` whose last row is divided by the zoom of the focal length."""
    matrix = torch.cat((pose.rotation, pose.translation[..., None]), -1)
    return matrix if zoom is None else torch.cat((matrix[:, :2], matrix[:, 2:] * (-zoom).exp()[:, None, None]), 1)


def _orthonormal(pose: Pose) -> Pose:
    """The nearest rotation to a rotation with rounding errors, by two Newton steps for the polar factor."""
    rotation = pose.rotation
    for _ in range(2):
        rotation = 1.5 * rotation - 0.5 * rotation @ (rotation.mT @ rotation)
    return Pose(rotation, pose.translation)
