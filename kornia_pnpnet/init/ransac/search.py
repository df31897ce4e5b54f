r"""The rounds of RANSAC: samples, their best poses, local optimisation, and which problems are done."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from kornia_pnpnet.core.performance import problems_last
from kornia_pnpnet.geometry import project
from kornia_pnpnet.init.ransac.sampling import Samples, samples_needed
from kornia_pnpnet.init.ransac.scoring import Scene, Scorer, Thresholds, judge
from kornia_pnpnet.refine import lm_step
from kornia_pnpnet.types import Correspondences, Hypotheses, Pose

__all__ = ["Found", "MinimalSolver", "Plan", "Search", "full_vectors", "take"]

# Poses are compared and improved in this precision: a ten thousandth of a pixel at the protocol's focal length.
_DTYPE = torch.float32
# Of many pairs, this many are scored first, four times as many for the best quarter, and so on.
FIRST_PAIRS, KEPT_ONE_IN = 16, 4
# Each round has at least this share of the samples before it: fewer rounds against fewer samples too many.
GROWTH = 0.5
# Samples are solved in multiples of this, twice the numbers in the longest vector of a processor.
_VECTOR = 64
# Damping of the least squares: next to none, they start close to their minimum.
DAMPING = 1e-6
# The first least squares take inliers up to this many times the threshold: the pose of a noisy sample misses some.
_WIDE = 3.0
# Pairs of problems that are improved together, for each sample that is solved together.
PAIRS_PER_SAMPLE = 4


class MinimalSolver(Protocol):
    """Solves samples of ``sample_size`` pairs each."""

    @property
    def sample_size(self) -> int:
        """Number of pairs in a sample."""

    def hypotheses(self, corr: Correspondences) -> Hypotheses:
        """Return the poses of a batch of samples."""


class Plan(NamedTuple):
    """How to search, see the arguments of :class:`~kornia_pnpnet.init.ransac.ransac.RANSAC`."""

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
        pose: in the frame of the correspondences, in their dtype.
        loss: its loss, infinite where there is no pose, shape :math:`(B,)`.
        poses: how many poses were scored, int64, shape :math:`(B,)`.
        samples: how many samples were drawn, int64, shape :math:`(B,)`.
    """

    pose: Pose
    loss: Tensor
    poses: Tensor
    samples: Tensor


class Search:
    r"""One search for the best poses of a batch, without gradients.

    Args:
        plan: how to search.
        corr: normalised correspondences whose world is centred: the search has few digits.
        thresholds: what counts as an inlier.

    Example:
        >>> from kornia_pnpnet.init.ransac.p3p import P3P
        >>> from kornia_pnpnet.init.ransac.scoring import SCORERS
        >>> points = torch.rand(1, 6, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> cam_points = points + torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64)
        >>> pixels = 100.0 * cam_points[..., :2] / cam_points[..., 2:]
        >>> corr = Correspondences(points, pixels, torch.ones_like(pixels[..., 0]), pixels.new_tensor(100.0))
        >>> plan = Plan(P3P(), SCORERS["msac"], 100, 32, 0.999, 2, 2, 0, 4096)
        >>> found = Search(plan, corr, Thresholds(pixels.new_tensor([1.0]), pixels.new_tensor([0.0]))).run()
        >>> round(found.pose.translation[0, 2].item(), 3), found.samples
        (5.0, tensor([20]))
    """

    def __init__(self, plan: Plan, corr: Correspondences, thresholds: Thresholds) -> None:
        self.plan = plan
        self.corr = corr
        self.low = corr.map(lambda x: x.to(_DTYPE))
        self.thresholds = Thresholds(*(x.to(_DTYPE) for x in thresholds))
        self.scene = Scene.make(corr, thresholds, _DTYPE)
        size = plan.minimal.sample_size
        self.samples = Samples(corr.weights > 0, size=size, most=plan.max_samples, seed=plan.seed)
        # A pair's numbers side by side, so that a sample is gathered pair by pair.
        self.pairs = torch.cat((corr.world_points, corr.img_points, corr.weights[..., None]), -1).flatten(0, 1)

    def run(self) -> Found:
        """Search until every problem is done."""
        plan, samples = self.plan, self.samples
        batch, count = self.corr.weights.shape
        device = self.corr.weights.device
        matrix = torch.eye(3, 4, dtype=_DTYPE, device=device).repeat(batch, 1, 1)
        loss = matrix.new_full((batch,), torch.inf)
        inliers, poses, drawn = torch.zeros(3, batch, dtype=torch.long, device=device)
        active = (samples.counts >= samples.size).nonzero()[:, 0]
        stop = 0
        while stop < samples.total and len(active):
            start, stop = stop, min(samples.total, stop + self._round(stop))
            parts = active.split(max(1, plan.chunk_size // (stop - start)))
            tops = [self._best_of_samples(part, start, stop) for part in parts]
            top_losses, top_matrices, tested = (torch.cat(parts) for parts in zip(*tops, strict=True))
            poses[active] += tested
            drawn[active] = stop
            better = (top_losses[:, 0] < loss[active]).nonzero()[:, 0]
            for some in better.split(max(1, PAIRS_PER_SAMPLE * plan.chunk_size // (count * top_losses.shape[1]))):
                at = active[some]
                loss[at], matrix[at] = self._improve(at, top_losses[some], top_matrices[some])
                corr, thresholds = self._of(at)
                judged = judge(project(_pose(matrix[at]), corr), corr, thresholds)
                inliers[at] = (judged.weights > 0).sum(-1)
            needed = samples_needed(inliers[active], samples.counts[active], samples.size, plan.confidence)
            active = active[needed.clamp(min=plan.min_samples) > stop]
        return Found(_orthonormal(_pose(matrix.to(self.corr.weights))), loss, poses, drawn)

    def _round(self, done: int) -> int:
        """How many samples come after the first ``done``."""
        return min(max(self.plan.min_samples, int(GROWTH * done)), self.plan.chunk_size)

    def _of(self, problems: Tensor) -> tuple[Correspondences, Thresholds]:
        """Correspondences and thresholds of some problems."""
        return take(self.low, problems), Thresholds(*(x[problems] for x in self.thresholds))

    def _best_of_samples(self, problems: Tensor, start: int, stop: int) -> tuple[Tensor, Tensor, Tensor]:
        """Losses (P, K), ascending, and matrices (P, K, 3, 4) of the best poses of some samples, how many there are."""
        scene = self.scene.of(problems)
        positions = self.samples.positions(problems, start, stop)  # (P, H, s)
        batch, count, size = positions.shape
        rows = (positions + problems[:, None, None] * self.corr.weights.shape[1]).flatten(0, 1)  # (P H, s)
        # Some arithmetic rounds differently in what is left over from a processor's vectors: nothing is left over, so
        # that a sample has the same poses wherever it stands.
        rows = full_vectors(rows)
        values = self.pairs.index_select(0, rows.flatten()).view(-1, size, 6)
        world, img, weights = values.split((3, 2, 1), -1)
        owners = full_vectors(problems.repeat_interleave(count))
        img_scale, world_scale = (
            None if x is None else x[owners] for x in (self.corr.img_scale, self.corr.world_scale)
        )
        sample = Correspondences(world, img, weights[..., 0], self.corr.focal, img_scale, world_scale)
        solved = self.plan.minimal.hypotheses(sample)
        valid = solved.valid & (weights[..., 0] > 0).all(-1, keepdim=True)
        parts = (x[: batch * count].unflatten(0, (batch, count)) for x in (*solved.pose, valid))
        rotation, translation, valid = parts
        losses, packed = self._rank(problems, scene, scene.pack(rotation, translation), valid.mT.flatten(1))
        return losses, scene.unpack(packed), valid.sum((1, 2))

    def _rank(self, problems: Tensor, scene: Scene, packed: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """The best poses and their losses; of many pairs some are scored first, then more for the better poses."""
        pairs, width = FIRST_PAIRS, packed.shape[-1]
        while 2 * pairs <= scene.points.shape[1]:
            some = scene.pairs(self.samples.spread(problems, pairs))
            width = max(width // KEPT_ONE_IN, self.plan.local_candidates)
            _, packed, valid = self._keep(some, packed, valid, width, ordered=False)
            pairs *= KEPT_ONE_IN
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
        """Improve the best poses (P, K) of some problems, then the best of them further; losses (P,), matrices."""
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
        """One step of least squares on the pairs within so many thresholds, where it lowers the loss."""
        corr, thresholds = self._of(full_vectors(problems))
        corr, start = problems_last(corr), _pose(full_vectors(matrix))
        scene = self.scene.of(problems)
        one, damping = loss.new_tensor((1.0, DAMPING))
        projection = project(start, corr)
        judged = judge(projection, corr, Thresholds(*(limit * x for x in thresholds)))
        moved = lm_step(corr, start, projection, corr.weights * judged.weights, one, damping).pose
        pose = Pose(*(x[: len(problems)] for x in moved))
        new_loss = scene.losses(scene.pack(*(x[:, None, None] for x in pose)), self.plan.scorer)[:, 0]
        better = (new_loss < loss) & loss.isfinite()  # what is no pose stays none
        new_matrix = torch.cat((pose.rotation, pose.translation[..., None]), -1)
        return torch.where(better, new_loss, loss), torch.where(better[:, None, None], new_matrix, matrix)


def take(corr: Correspondences, at: Tensor | slice) -> Correspondences:
    """The correspondences of some problems."""
    img_scale, world_scale = (None if x is None else x[at] for x in (corr.img_scale, corr.world_scale))
    return Correspondences(
        corr.world_points[at], corr.img_points[at], corr.weights[at], corr.focal, img_scale, world_scale
    )


def full_vectors(rows: Tensor) -> Tensor:
    """The rows, and the first of them again until their number fills a processor's vectors."""
    left_over = -len(rows) % _VECTOR
    return torch.cat((rows, rows[:1].expand(left_over, *rows.shape[1:]))) if left_over else rows


def _pose(matrix: Tensor) -> Pose:
    """A pose from its 3x4 matrix."""
    return Pose(matrix[..., :3], matrix[..., 3])


def _orthonormal(pose: Pose) -> Pose:
    """The nearest rotation to one with rounding errors, by two steps of Newton's iteration for the polar factor."""
    rotation = pose.rotation
    for _ in range(2):
        rotation = 1.5 * rotation - 0.5 * rotation @ (rotation.mT @ rotation)
    return Pose(rotation, pose.translation)
