"""A network that estimates poses, weights and noise from a set of pairs, for any number and any order of the pairs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor, nn
from torch.nn import functional

from kornia_pnpnet.core.checks import check_devices, check_whole
from kornia_pnpnet.core.linalg import align, solve_symmetric
from kornia_pnpnet.core.performance import (
    are_few,
    compiling,
    in_cache,
    present_first,
    problems_last,
    sees_values,
    take_pairs,
)
from kornia_pnpnet.core.trees import pairs_at
from kornia_pnpnet.judge.evidence import groups, totals
from kornia_pnpnet.problem import LEAST_DEPTH, Noise, Problem, Starts, State
from kornia_pnpnet.propose.initialiser import Initialiser
from kornia_pnpnet.propose.p3p import minimal_poses
from kornia_pnpnet.propose.sampling import ranked, spread_evenly
from kornia_pnpnet.propose.scoring import as_entries, as_pose
from kornia_pnpnet.refine.residual import MIN_DEPTH_RATIO, project
from kornia_pnpnet.result import Pose

__all__ = ["SetInit"]

# Number of features of a pair, see `_View`. Confidences and repeats add further features.
_FEATURES = 14
# Ridge of the affine fit, divided by the mean square of the points. The ridge makes the fit to planar points unique.
_RIDGE = 0.02
# Features are clipped to this absolute value, so that no pair dominates the network.
_MOST = 8.0
# Confidences are clipped to at least this distance from 0 and from 1.
_LEAST_CONFIDENCE = 1e-3
# Centre of the range of log(noise) that the network can estimate. The unit is the spread of the pixels or world points.
_LOG_NOISE = -5.0
# Least noise, divided by the spread. Scores divide by the variance, which must not be 0.
_LEAST_NOISE = 1e-6
# Least number of pairs for which the softmax is computed over rows. PyTorch 2.13 is slow for shorter rows.
_SHORT = 16
# This number is added to the attention scores of unusual pairs and of padding.
_ABSENT = -1e9
# Minimal samples, as ranks of the pairs in descending order of likelihood. The first six samples are a Turán system:
# if two of the six likeliest pairs are outliers, at least one of the six samples has only inliers.
_SAMPLES = ((0, 1, 2), (0, 1, 3), (2, 3, 4), (2, 3, 5), (0, 4, 5), (1, 4, 5), (0, 2, 3), (1, 2, 3))
# For each entry (n, f), problems of at least n pairs also use _SAMPLES with all ranks multiplied by f. If the likeliest
# pairs agree on an incorrect pose, the samples of larger ranks help.
_SPREADS = ((18, 3), (24, 4), (30, 5))
# 25 further samples of the 25 likeliest pairs, for problems of at least 36 pairs. No two of the 25 share two pairs.
_RING_FROM = 36
_RING = [(a, b, c) for i in range(25) for a, b, c in [sorted((i, (i + 1) % 25, (i + 6) % 25))]]
# Number of likeliest pairs that score each hypothesis.
_MOST_JUDGES = 32
# If the squared residual of a pair is this number times the variance, the score is half the score at the residual 0.
_JUDGED = 50.0
# Score of a pair of likelihood 0, divided by the score of a pair of likelihood 1.
_LEAST_VOTE = 0.5
# If the minimal samples have more slots for poses than this number, a CPU removes the empty slots before scoring.
_MANY_SLOTS = 64
# If `search_on` follows, the network sees at most this number of pairs, but the search uses all pairs. On real matches
# and on random problems of up to 1000 pairs, limits of 32 to 96 pairs give the same success rate as no limit.
_ENOUGH = 48


class _View:
    r"""The network's input.

    The features are invariant to units, to rotations of the world, and to rotations of the camera except the roll. The
    camera is rotated to the mean ray, and the rays are scaled to the spread 1. Ridge regression fits an affine camera
    to the pairs, and the world is rotated to the axes of this affine camera.

    Attributes:
        there: 1 for usual pairs (see ``Problem.usual``) with a weight above 0, else 0, shape :math:`(B, N)`.
        rays: unit rays in the frame of the original camera, shape :math:`(B, N, 3)`.
        log_spread: logarithm of the spread of the rays, shape :math:`(B, 1)`. The spread is the root mean square of
            :math:`\sin \alpha`, where :math:`\alpha` is the angle between a ray and the mean ray.
        unit: spread of the pixels, and spread of the world points, shape :math:`(B, 2)`.
        height: third coordinates of the rotated world points, shape :math:`(B, N)`.
        features: the network's input, shape :math:`(B, N, C)`.
    """

    def __init__(self, problem: Problem, confidence: bool, repeats: Tensor | None) -> None:
        world = problem.world_points.contiguous()
        eye = torch.eye(3, dtype=world.dtype, device=world.device)
        self.there = (problem.usual_weights > 0).to(world.dtype)
        share = (self.there / self.there.sum(1, keepdim=True).clamp(min=1.0))[..., None]  # (B, N, 1)
        plane = functional.pad(problem.img_points / problem.focal, (0, 1), value=1.0)
        self.rays = functional.normalize(plane, dim=-1)
        mean = functional.normalize((share * self.rays).sum(1), dim=-1)
        # Two reflections rotate the mean ray to the z axis: one maps the ray to the negative z axis, one negates z.
        half = mean + eye[2]
        mirror = 1.0 - 2.0 * eye[2]
        turn = (half * mirror)[..., None] * (half / half[:, 2:])[:, None]
        across = torch.bmm(self.rays, (eye * mirror - turn)[:, :2].mT)
        spread = ((share * across.square()).sum((1, 2)) + 1e-12).sqrt()[:, None]
        seen = across / spread[..., None]
        seen = seen - (share * seen).sum(1, keepdim=True)

        moment, cross = torch.bmm(world.mT, share * torch.cat((world, seen), -1)).split((3, 2), -1)
        affine = solve_symmetric(moment + _RIDGE * eye, cross).mT  # (B, 2, 3)
        squares = affine.square().sum(-1)  # (B, 2)
        points = torch.bmm(world, _frame(affine, squares).mT)
        residual = torch.baddbmm(seen, world, affine.mT, alpha=-1)
        self.height = points[..., 2]
        self.log_spread = spread.log()
        self.unit = torch.cat((problem.focal * spread, torch.ones_like(spread)), -1)
        of_problem = torch.cat((self.log_spread, 0.5 * (squares + 1e-3).log()), -1)
        parts = [points, seen, residual, of_problem[:, None].expand(-1, world.shape[1], -1), self._noise(problem)]
        if confidence:
            given = torch.full_like(problem.weights, torch.nan) if problem.confidence is None else problem.confidence
            believed = given.nan_to_num(0.5).clamp(_LEAST_CONFIDENCE, 1.0 - _LEAST_CONFIDENCE)
            parts.append(torch.stack((believed.logit(), (~given.isnan()).to(world.dtype)), -1))
        if repeats is not None:
            parts.append(repeats)
        self.features = torch.cat(parts, -1).clamp(-_MOST, _MOST)

    def _noise(self, problem: Problem) -> Tensor:
        """Features (B, N, 4): log(noise / spread) of pixels and of points, then whether each noise is known."""
        if problem.noise is None:
            return torch.zeros_like(problem.weights)[..., None].expand(-1, -1, 4)
        sigmas = torch.stack((problem.noise.img, problem.noise.world), -1)  # (B, N, 2)
        known = sigmas.isfinite()
        # Unknown sigmas are NaN, and are replaced before the division. Otherwise `unit` would get the gradient NaN.
        relative = torch.where(known, sigmas, 1.0) / torch.where(known, self.unit[:, None], 1.0)
        logs = torch.where(known, relative.clamp(min=_LEAST_NOISE).log() - _LOG_NOISE, 0.0)
        return torch.cat((logs, known.to(logs.dtype)), -1)


@torch.no_grad()
def _repeats(problem: Problem) -> Tensor:
    """Logarithms (B, N, 2) of two counts: the pairs that share the pixel of a pair, and those that share its point."""
    there = (problem.usual_weights > 0).to(problem.weights)
    counts = [totals(groups(x), there) for x in (problem.img_points, problem.world_points)]
    return torch.stack(counts, -1).clamp(min=1.0).log()


def _frame(affine: Tensor, squares: Tensor) -> Tensor:
    """Rotation whose first two rows are closest to ``affine`` (B, 2, 3). ``squares`` is ``affine.square().sum(-1)``."""
    p, q = affine.unbind(1)
    product = (p * q).sum(-1, keepdim=True)  # (B, 1)
    # The orthonormal rows closest to A = `affine` are S^-1/2 A, where S = A A^T. S^-1/2 is proportional to the adjugate
    # of S + sqrt(det S) I.
    raised = squares + (1e-3 * squares.sum(-1, keepdim=True) + 1e-6)
    first, second = raised.split(1, -1)  # the gradient of `prod` would synchronise a GPU
    root = (first * second - product.square()).clamp(min=1e-12).sqrt()
    diagonal = raised.flip(-1) + root
    u, v = (diagonal[..., None] * affine - product[..., None] * affine.flip(1)).unbind(1)
    eye = torch.eye(3, dtype=u.dtype, device=u.device)
    u = functional.normalize(u + 1e-6 * eye[0], dim=-1)
    # A reflection maps the z axis to u or to -u. The same reflection maps the x axis to a vector orthogonal to u.
    sign = torch.where(u[:, 2:] < 0, u.new_full((), -1.0), 1.0)
    orthogonal = eye[0] - (u[:, :1] / (1.0 + sign * u[:, 2:])) * (u + sign * eye[2])
    v = functional.normalize(v - (u * v).sum(-1, keepdim=True) * u + 1e-6 * orthogonal, dim=-1)
    return torch.stack((u, v, torch.linalg.cross(u, v)), 1)


@torch.no_grad()
def _agreement(problem: Problem, noise: Noise, pose: Pose) -> Tensor:
    """Agreement (B, N) of each pair with a pose, in [0, 1]. Points behind the camera have the agreement 0."""
    projection = project(State.of(pose), problems_last(problem))
    variance = _variance(noise, problem.focal, pose)
    agreement = 1.0 / (1.0 + projection.sq_residual / (_JUDGED * variance))
    return torch.where(projection.in_front, agreement, 0.0).contiguous()


def _variance(noise: Noise, focal: Tensor, pose: Pose) -> Tensor:
    """Variance (B, N) of the pixels, from the noise of pixels and of points at the depth of the world's centre."""
    depth = pose.translation[:, 2:].clamp(min=LEAST_DEPTH)
    return noise.img.square() + (focal * noise.world / depth).square()


def _samples(count: int, number: int, search_follows: bool) -> tuple[Sequence[int], list[int]]:
    """How many pairs a problem must have for each of S samples, and the 3 S ranks of the pairs of these samples."""
    every = [(0, sample) for sample in _SAMPLES[: max(number, 1)] if max(sample) < count]
    if not search_follows:  # a search draws further samples
        every += [(least, (f * i, f * j, f * k)) for least, f in _SPREADS for _, (i, j, k) in every]
        every += [(_RING_FROM, sample) for sample in _RING]
    least, samples = zip(*(x for x in every if x[0] <= count), strict=True)
    return least, [rank for ranks in zip(*samples, strict=True) for rank in ranks]


@cache
def _sample_table(count: int, number: int, search_follows: bool, device: torch.device) -> tuple[Tensor, Tensor]:
    """Ranks (3 S,) and numbers of pairs (S, 1) of `_samples`, copied once. A CUDA graph cannot copy from the CPU."""
    least, ranks = _samples(count, number, search_follows)
    with torch.inference_mode(False):  # later calls may need gradients
        return torch.tensor(ranks, device=device), torch.tensor(least, device=device)[:, None]


def _support(judges: Tensor, poses: Tensor) -> Tensor:
    """Scores (H, B) that the pairs ``judges`` (7, K, B) give to poses [R | t] (3, 4, H, B)."""
    a, b, c, u, v, vote, precision = judges.unbind()  # (K, B) each
    first, second, third, translation = poses[:, :, :, None].unbind(1)  # (3, H, 1, B) each
    points = torch.addcmul(translation, first, a)  # (3, H, K, B)
    x, y, z = points.addcmul_(second, b).addcmul_(third, c).unbind()
    across = torch.addcmul(x * x, y, y)
    front = (z * z.abs()).mul_(1.0 - MIN_DEPTH_RATIO**2) > MIN_DEPTH_RATIO**2 * across
    inverse = z.reciprocal()
    x, y = torch.addcmul(-u, x, inverse), torch.addcmul(-v, y, inverse)
    score = torch.addcmul(x * x, y, y).mul_(precision).add_(1.0).reciprocal_().mul_(vote)
    return torch.where(front, score, 0.0).sum(1)


class _Block(nn.Module):
    """A residual layer of two inputs: the features of a pair, and a context that attention pools over all pairs."""

    def __init__(self, width: int, heads: int, hidden: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.look = nn.Linear(width, width + heads)
        self.pair = nn.Linear(width, hidden)
        self.all = nn.Linear(width, hidden, bias=False)
        self.out = nn.Linear(hidden, width)
        with torch.no_grad():
            self.out.weight *= 0.5
            self.out.bias.zero_()

    def forward(self, x: Tensor, absent: Tensor) -> Tensor:
        """Map ``x`` (B * N, width) to the same shape. ``absent`` (B, N) is added to the scores, see ``_ABSENT``."""
        (batch, count), width, heads = absent.shape, x.shape[1], self.heads
        y = self.norm(x)
        values, scores = self.look.weight.split((width, heads))
        # The scores have no bias, because the softmax over pairs cancels a bias.
        attention = _attention(y, scores, absent).movedim(0, 1)  # (B, heads, N)
        # The values are linear in y. The mean of the values therefore follows from the mean of y.
        means = torch.bmm(attention, y.view(batch, count, width)).movedim(1, 0)  # (heads, B, width)
        bias = self.look.bias[:width].view(heads, 1, -1)
        context = torch.baddbmm(bias, means, values.view(heads, -1, width).mT).movedim(0, 1).reshape(batch, width)
        hidden = functional.linear(y, self.pair.weight).view(batch, count, self.pair.out_features)
        hidden = hidden.add_(functional.linear(context, self.all.weight, self.pair.bias)[:, None]).relu_()
        return torch.addmm(x + self.out.bias, hidden.flatten(0, 1), self.out.weight.mT)


def _attention(x: Tensor, weight: Tensor, absent: Tensor) -> Tensor:
    """Softmax over the pairs, (C, B, N). The C scores of a pair are linear in ``x`` (B * N, width).

    For few pairs, the softmax over columns takes a tenth of the time of the softmax over rows.
    """
    scores = torch.addmm(absent.view(1, -1), weight, x.mT).view(weight.shape[0], *absent.shape)
    if compiling() or scores.shape[-1] >= _SHORT or are_few(scores):
        return scores.softmax(-1)
    return scores.mT.contiguous().softmax(1).mT.contiguous()  # `bmm` is slow with other layouts


class SetInit(Initialiser):
    r"""A small network that maps a set of pairs to several coarse poses, a weight for each pair, and the noise.

    In every residual layer, attention pools a context over all pairs. The cost is linear in the number of pairs, and
    the order of the pairs has no effect. For each hypothesis, the network predicts a weight of each point, and the
    distance of each point from the camera. The pose is the rigid motion that aligns the world points with the points on
    the rays at the predicted distances. Poses are equivariant to similarity transforms of the world, and to rotations
    of the camera except the roll.

    The likeliest pairs also form minimal samples of three (see :func:`~kornia_pnpnet.propose.p3p.p3p`), and score the
    poses of the samples. The best pose of the samples is a further hypothesis, and has no gradient.

    The weight of a pair is the estimated probability that the pair is an inlier. The network also estimates unknown
    noise. The layers compute in the dtype of the network's weights, and other operations in the dtype of the pairs.

    Sources: J. Hesch and S. Roumeliotis, "A direct least-squares method for PnP", ICCV 2011 (distances along rays, then
    alignment); W. Sun et al., "ACNe: Attentive context normalization for robust permutation-equivariant learning", CVPR
    2020 (attention pooled over correspondences); P. Turán's problem for (6, 4, 3), 1941 (the samples).

    Args:
        width: number of channels of each pair.
        layers: number of residual layers.
        heads: number of attention heads of each layer.
        hidden: number of channels inside a layer.
        starts: number of hypotheses of the network, at least 1.
        samples: number of minimal samples of the six likeliest pairs, 0 to 8, at least 1 before a search. Problems of
            at least 18 pairs have further samples.
        confidence: whether the network sees the ``confidence`` of the correspondences.
        repeats: whether the network sees how many pairs share a pixel and how many pairs share a world point.

    Raises:
        BaseError: for numbers out of range, or when ``heads`` does not divide ``width``.

    Example:
        >>> problem = Problem.of(torch.randn(2, 7, 3), torch.randn(2, 7, 2), 3400.0)
        >>> starts = SetInit(starts=3)(problem)
        >>> starts.pose.rotation.shape, starts.others.translation.shape, starts.weights.shape
        (torch.Size([2, 3, 3]), torch.Size([2, 3, 3]), torch.Size([2, 7]))
    """

    pairs_at_once = 24_000
    estimates_noise = True
    weighs_unusual = True

    def __init__(
        self,
        *,
        width: int = 32,
        layers: int = 3,
        heads: int = 4,
        hidden: int = 64,
        starts: int = 2,
        samples: int = 6,
        confidence: bool = False,
        repeats: bool = False,
    ) -> None:
        super().__init__(locals())
        check_whole(1, width=width, layers=layers, heads=heads, hidden=hidden, starts=starts)
        check_whole(0, len(_SAMPLES), samples=samples)
        self.samples = samples
        KORNIA_CHECK(width % heads == 0, f"heads must divide width, got {heads} and {width}.")
        self.starts = int(starts)
        self.confidence = confidence
        self.repeats = repeats
        self.first = nn.Linear(_FEATURES + 2 * confidence + 2 * repeats, width)
        self.blocks = nn.ModuleList(_Block(width, heads, hidden) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        # Outputs of a pair: the inlier logit, a weight per hypothesis, and a distance per hypothesis.
        self.pair = nn.Linear(width, 1 + 2 * starts)
        # Outputs of a problem: the distance of the world's centre per hypothesis, and the noise of pixels and points.
        self.problem = nn.Linear(width, starts + 2)
        with torch.no_grad():
            for layer, scale in ((self.pair, 0.3), (self.problem, 0.1)):
                layer.weight *= scale
                layer.bias.zero_()
            self.pair.bias[0] = 2.0

    def forward(self, problem: Problem, *, search_follows: bool = False) -> Starts:
        """Find poses, weights and noise.

        Args:
            problem: pairs in any order. The world is centred and scaled.
            search_follows: whether :func:`~kornia_pnpnet.propose.ransac.search_on` follows. If so, the network sees at
                most 48 pairs, and fewer samples are solved. Pairs that the network does not see are weighted by their
                agreement with the last hypothesis.

        Returns:
            The poses of all hypotheses, the weights, and the noise of each pair. If ``samples`` is not 0, the
            last hypothesis is the best pose of the samples. If a search follows, the poses of the network compete
            with the poses of the samples, and the last hypothesis is the winner, also if ``samples`` is 0.

        Raises:
            DeviceError: when the problem and the network are on different devices.
        """
        check_devices({"world_points": problem.world_points}, self.pair.bias, "the network")
        given, index, starts = problem, None, self.starts
        same = _repeats(problem) if self.repeats else None
        if search_follows and problem.weights.shape[1] > _ENOUGH:
            usual = problem.usual_weights > 0
            order = ranked(problem, usual)
            index = order.gather(1, spread_evenly(usual.gather(1, order), _ENOUGH))
            problem, same = pairs_at((problem, same), index)
        view = _View(problem, self.confidence, same)
        numbers = view.there.shape[1] * self.config["hidden"]
        outputs = in_cache(self._run, (view.features, view.there), numbers, join=-2)
        of_pairs, of_problem = (x.to(view.there.dtype) for x in outputs)
        probability = torch.sigmoid(of_pairs[0])
        counts, along = of_pairs[1:].split(starts)  # (S, B, N) each
        away, noise = of_problem.split((starts, 2), -1)
        # The distance of a point is approximately the distance of the world's centre plus an offset. If the network
        # predicted a factor instead of an offset, the relief of the points would grow with the distance.
        distance = (away.clamp(-6.0, 6.0) - view.log_spread).exp().mT[..., None]  # (S, B, 1)
        relief = torch.add(view.height, along, alpha=3.0) / distance
        ranges = distance * relief.clamp(-3.0, 3.0).exp()
        chances = probability * view.there
        counts = torch.addcmul(view.there * 1e-6, chances, (3.0 * counts.tanh()).exp())
        points = (ranges[..., None] * view.rays).flatten(0, 1)
        source = problem.world_points.expand(starts, -1, -1, -1).flatten(0, 1)
        rotation, translation, _ = align(source, points, counts.flatten(0, 1))
        poses = [*map(Pose, *(x.unflatten(0, (starts, -1)).unbind() for x in (rotation, translation)))]
        noises = self._noise(given, view, noise)
        if self.samples or search_follows:
            visible = noises if index is None else pairs_at(noises, index)
            poses.append(self._sampled(problem, chances, visible, poses, search_follows))
        if index is not None:
            probability = _agreement(given, noises, poses[-1]).scatter(1, index, probability)
        return Starts(poses[0], probability, noise=noises).with_others(*poses[1:])

    @torch.no_grad()
    def _sampled(
        self, problem: Problem, chances: Tensor, noise: Noise, others: Sequence[Pose], search_follows: bool
    ) -> Pose:
        """Find the best-scoring pose of all samples, or return ``others[0]`` if no pair supports a pose.

        If a search follows, the ``others`` compete with the poses of the samples.
        """
        batch, count = chances.shape
        there = problem.usual_weights > 0
        # Unlikely pairs also contribute to scores, because they can be inliers.
        vote = torch.add((1.0 - _LEAST_VOTE) * chances, there, alpha=_LEAST_VOTE)
        # The variance is computed at the depth of the network's pose. At the depth of a hypothesis close to the points,
        # the variance would be large, and most pairs would agree with the hypothesis.
        precision = problem.focal.square() / (_JUDGED * _variance(noise, problem.focal, others[0]))
        plane_points, scoring = problem.img_points / problem.focal, (vote[..., None], precision[..., None])
        of_pairs = torch.cat((problem.world_points, plane_points, *scoring), -1)  # (B, N, 7)
        if not isinstance(count, int):  # exported for any number of pairs: append padding
            more = of_pairs[:, :1] * torch.tensor((1, 1, 1, 1, 1, 0, 1), dtype=vote.dtype, device=vote.device)
            of_pairs = torch.cat((of_pairs, more.expand(-1, _MOST_JUDGES, -1)), 1)
            chances, count = functional.pad(chances, (0, _MOST_JUDGES)), count + _MOST_JUDGES
        likely = chances.topk(min(_MOST_JUDGES, count)).indices
        pairs = take_pairs(of_pairs, likely)  # (7, K, B)
        if compiling():  # compiled code is faster with `stack`
            least, ranks = _samples(count, self.samples, search_follows)
            enough = torch.tensor(least, device=there.device)[:, None]
            three = torch.stack([pairs[:6, rank] for rank in ranks], 1)
        else:
            of_table, enough = _sample_table(count, self.samples, search_follows, pairs.device)
            three = pairs[:6].index_select(1, of_table)
        three = three.unflatten(1, (3, -1)).flatten(2)  # (6, 3, S B)
        entries, valid = minimal_poses(three[:3].permute(2, 1, 0), three[3:5].permute(2, 1, 0))
        each = enough.shape[0], batch
        entries = entries.unflatten(-1, each).flatten(1, 2)  # (12, H, B)
        valid = (valid & (three[5] > 0).all(0)).unflatten(-1, each)  # (4, S, B)
        if not search_follows and count >= _SPREADS[0][0]:  # `there` does not count padding
            valid = valid & (there.sum(1) >= enough)
        valid = valid.flatten(0, 1)  # (H, B)
        if batch and len(valid) > _MANY_SLOTS and valid.device.type == "cpu" and sees_values(valid):
            slots = present_first(valid.mT)[:, : max(int(valid.sum(0).max()), 1)].mT
            entries, valid = entries.gather(1, slots.expand(12, -1, -1)), valid.gather(0, slots)
        if search_follows:
            entries = torch.cat((entries, torch.stack([as_entries(pose).mT for pose in others], 1)), 1)
            valid = torch.cat((valid, valid.new_ones(len(others), batch)))
        support = in_cache(partial(_support, pairs), (entries.unflatten(0, (3, 4)),), 3 * pairs[0].numel(), split=2)
        valid = valid & (support > 0)
        for term in problem.pose_terms:
            support = support - term.disagreement(as_pose(entries.permute(1, 2, 0)))
        score, best = torch.where(valid, support, -torch.inf).max(0)
        chosen = entries.gather(1, best.expand(12, 1, -1))[:, 0].mT  # (B, 12)
        return as_pose(torch.where((score > -torch.inf)[:, None], chosen, as_entries(others[0])))

    def _run(self, features: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
        """The network's outputs per pair (1 + 2 S, B, N) and per problem (B, S + 2), for S ``starts``. See `_View`."""
        x = self.first(features.flatten(0, 1).to(self.first.weight.dtype))
        absent = torch.where(there > 0, x.new_zeros(()), max(_ABSENT, 0.5 * torch.finfo(x.dtype).min)).contiguous()
        for block in self.blocks:
            x = block(x, absent)
        x = self.norm(x)
        pair = torch.addmm(self.pair.bias[:, None], self.pair.weight, x.mT).view(self.pair.out_features, *absent.shape)
        share = _attention(x, self.pair.weight[:1], absent)[0]  # the softmax cancels a bias
        return pair, self.problem(torch.bmm(share[:, None], x.view(*absent.shape, x.shape[-1]))[:, 0])

    def _noise(self, problem: Problem, view: _View, estimate: Tensor) -> Noise:
        """The noise of each pair: the known noise of the problem, else the network's estimate."""
        guessed = ((_LOG_NOISE + 3.0 * estimate.tanh()).exp() * view.unit)[:, None].expand(*problem.weights.shape, 2)
        if problem.noise is not None:
            known = torch.stack((problem.noise.img, problem.noise.world), -1)
            guessed = torch.where(known.isfinite(), known, guessed)
        img, world = guessed.maximum(_LEAST_NOISE * view.unit[:, None]).unbind(-1)
        return Noise(img, world)
