"""A network over the set of pairs, for any number, order, world and camera: poses, weights and noise."""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor, nn
from torch.nn import functional

from kornia_pnpnet.core.checks import check_devices, check_whole
from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.core.linalg import dot, small_product, solve_symmetric
from kornia_pnpnet.core.performance import present_first, sees_values, take_pairs
from kornia_pnpnet.geometry import align, project
from kornia_pnpnet.init.ransac import p3p
from kornia_pnpnet.refine.prior import votes
from kornia_pnpnet.types import Correspondences, Guess, Noise, Pose

__all__ = ["SetInit"]

# Ridge of the affine camera, relative to the mean square of the world points. It makes the fit unique for planar
# points.
_RIDGE = 0.02
# Features are clipped at this many times the spread of their kind, so that a wild pair does not dominate the network.
_MOST = 8.0
# Centre of the logarithm of the estimated noise, relative to the spread of the pixels and of the world.
_LOG_NOISE = -5.0
# Noise of less than this share of the spread counts as this share: scores divide by the variance.
_LEAST_NOISE = 1e-6
# Numbers per pair: 3 of the world, 2 of the image, 2 of the residual, 3 of the problem, 2 of the noise, 2 flags.
_FEATURES = 14
# With confidences: their logit and a flag more. Confidences are clipped to this distance from 0 and from 1.
_CONFIDENCE_FEATURES = 2
_LEAST_CONFIDENCE = 1e-3
# With repeats: the logarithms of the numbers of pairs with the same pixel and with the same point.
_REPEAT_FEATURES = 2
# Points are sorted by their first coordinate plus the others times these factors, so that equal points are neighbours;
# the factors are irrational, so that the points of a grid have different keys.
_KEY = 0.7548776662, 0.5698402910
# Added to the score of padding.
_ABSENT = -1e9
# Minimal samples, as ranks of pairs by likelihood. The first six are a Turán system: whichever two of the six likeliest
# pairs are outliers, one of the six samples has only inliers. No five samples have this property.
_SAMPLES = ((0, 1, 2), (0, 1, 3), (2, 3, 4), (2, 3, 5), (0, 4, 5), (1, 4, 5), (0, 2, 3), (1, 2, 3))
# From 18, 24 and 30 pairs on, the same samples are drawn again with their ranks multiplied by 3, 4 and 5.
_SPREADS = {18: 3, 24: 4, 30: 5}
# From 36 pairs on, 25 further samples: each of the 25 likeliest pairs is in three of them, no two pairs meet twice.
_RING = {36: [(a, b, c) for i in range(25) for a, b, c in [sorted((i, (i + 1) % 25, (i + 6) % 25))]]}
#: Number of top-ranked pairs that score each hypothesis.
MOST_JUDGES = 32
# Slots for poses of minimal samples. Of more, those that hold no pose, which most do, are not scored on a CPU.
_MANY_SLOTS = 64
# Variances. Squared residuals of this size halve the score of a pair.
_JUDGED = 50.0
# Normalised units. A pose that has the centre of the world nearer than this counts as this near.
_NEAREST = 0.5
# Score of a pair whose likelihood is 0, relative to a pair whose likelihood is 1.
_LEAST_VOTE = 0.5


class _View:
    r"""The network's input: invariant to rotations of world and camera and to their units.

    The camera is rotated so that the mean of the rays is its axis, and zoomed until the spread of the rays is 1. The
    world, already centred and scaled, is rotated to the axes of the affine camera that fits the pairs best (by ridge
    regression).
    """

    def __init__(self, corr: Correspondences, confidence: bool = False, repeats: bool = False) -> None:
        world = corr.world_points.contiguous()
        there = (corr.near_weights > 0).to(world.dtype)
        share = (there / there.sum(1, keepdim=True).clamp(min=1.0))[..., None]  # (B, N, 1)
        plane = corr.img_points / corr.focal
        rays = functional.normalize(torch.cat((plane, torch.ones_like(plane[..., :1])), -1), dim=-1)
        mean = torch.stack([(share[..., 0] * ray).sum(1) for ray in rays.unbind(-1)], -1)
        x, y, z = functional.normalize(mean, dim=-1).unbind(-1)  # z > 0
        k = (1.0 + z).reciprocal()
        rows = (1.0 - k * x * x, -k * x * y, -x, -k * x * y, 1.0 - k * y * y, -y, x, y, z)
        self.there = there
        self.camera = torch.stack(rows, -1).unflatten(-1, (3, 3))  # (B, 3, 3), the smallest such rotation
        self.rays = rays @ self.camera.mT  # (B, N, 3)
        tiny = 1e-12
        self.spread = ((share * self.rays[..., :2].square()).sum((1, 2)) + tiny).sqrt()  # (B,)
        seen = self.rays[..., :2] / self.spread[:, None, None]
        seen = seen - (share * seen).sum(1, keepdim=True)

        moment = world.mT @ (share * world) + _RIDGE * torch.eye(3, dtype=world.dtype, device=world.device)
        affine = solve_symmetric(moment, world.mT @ (share * seen)).mT  # (B, 2, 3)
        self.world = _frame(affine)  # (B, 3, 3)
        self.points = world @ self.world.mT  # (B, N, 3)
        residual = seen - world @ affine.mT
        sizes = 0.5 * (affine.square().sum(-1) + 1e-3).log()  # (B, 2)
        self.log_spread = self.spread.log()
        problem = torch.cat((self.log_spread[:, None], sizes), -1)[:, None].expand(-1, world.shape[1], -1)
        self.known = self._known(corr)
        noise = [torch.where(known, log - _LOG_NOISE, 0.0) for log, known in self.known]
        flags = [known.to(world.dtype) for _, known in self.known]
        if confidence:
            given = torch.full_like(corr.weights, torch.nan) if corr.confidence is None else corr.confidence
            believed = given.nan_to_num(0.5).clamp(_LEAST_CONFIDENCE, 1.0 - _LEAST_CONFIDENCE)
            flags += [believed.logit(), (~given.isnan()).to(world.dtype)]
        if repeats:
            flags += [_same(corr.img_points, there).log(), _same(corr.world_points, there).log()]
        parts = self.points, seen, residual, problem, *(x[..., None] for x in (*noise, *flags))
        self.features = torch.cat(parts, -1).clamp(-_MOST, _MOST)

    def _known(self, corr: Correspondences) -> list[tuple[Tensor, Tensor]]:
        """Logarithms of the noise of pixels and of points relative to their spread, and whether the noise is known."""
        if corr.noise is None:
            no = torch.zeros_like(corr.weights, dtype=torch.bool)
            return [(torch.zeros_like(corr.weights), no)] * 2
        units = corr.focal * self.spread[:, None], torch.ones_like(self.spread[:, None])
        sigmas = corr.noise.img, corr.noise.world
        known = [torch.isfinite(x) for x in sigmas]
        logs = []
        for sigma, unit, is_known in zip(sigmas, units, known, strict=True):
            # Unknown sigmas are NaN. Replace them before dividing, or the gradient of the unit becomes NaN.
            relative = torch.where(is_known, sigma, 1.0) / torch.where(is_known, unit, 1.0)
            logs.append(relative.clamp(min=_LEAST_NOISE).log())
        return list(zip(logs, known, strict=True))


@torch.no_grad()
def _same(points: Tensor, there: Tensor) -> Tensor:
    """Number of pairs of the problem whose point is exactly the same, at least 1; ``points`` (B, N, K), (B, N)."""
    key, *others = points.unbind(-1)
    for x, factor in zip(others, _KEY, strict=False):
        key = key + factor * x
    order = key.argsort(1)  # equal points are neighbours
    ordered = points.gather(1, order[..., None].expand_as(points))
    # Numbers, not booleans, of which PyTorch 2.13 makes code that does not compile.
    new = (ordered[:, 1:] != ordered[:, :-1]).long().amax(-1)
    run = functional.pad(new.cumsum(1), (1, 0))
    sizes = torch.zeros_like(there).scatter_add(1, run, there.gather(1, order))
    return torch.empty_like(there).scatter(1, order, sizes.gather(1, run)).clamp(min=1.0)


def _frame(affine: Tensor) -> Tensor:
    """The rotation whose first two rows are nearest the rows of an affine camera (B, 2, 3); any rotation if it is 0."""
    p, q = affine.unbind(1)
    pp, pq, qq = dot(p.unbind(-1), p.unbind(-1)), dot(p.unbind(-1), q.unbind(-1)), dot(q.unbind(-1), q.unbind(-1))
    # The inverse square root of [[pp, pq], [pq, qq]], up to a factor: (S + sqrt(det S) I)^-1.
    ridge = 1e-3 * (pp + qq) + 1e-6
    root = ((pp + ridge) * (qq + ridge) - pq * pq).clamp(min=1e-12).sqrt()
    u = (qq + ridge + root)[:, None] * p - pq[:, None] * q
    axis = torch.eye(3, dtype=u.dtype, device=u.device)[0]
    u = functional.normalize(u + 1e-6 * axis, dim=-1)
    v = (pp + ridge + root)[:, None] * q - pq[:, None] * p
    v = v - (u * v).sum(-1, keepdim=True) * u + 1e-6 * _orthogonal(u)
    v = functional.normalize(v, dim=-1)
    return torch.stack((u, v, torch.linalg.cross(u, v)), 1)


def _orthogonal(unit: Tensor) -> Tensor:
    """A unit vector orthogonal to each, (B, 3)."""
    x, y, z = unit.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0)
    a = -(sign + z).reciprocal()
    return torch.stack((1.0 + sign * x * x * a, sign * x * y * a, -sign * x), -1)


class _Block(nn.Module):
    """A residual layer on each pair, with a context that attention pools over all pairs."""

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
        """Map (B, N, width) to the same shape; ``absent`` (B, N) is a large negative number for padding, else 0."""
        (batch, count, width), heads = x.shape, self.heads
        y = self.norm(x)
        # The scores need no bias: the softmax over pairs cancels it.
        attention = (_by_channel(y, self.look.weight[width:]) + absent).softmax(-1)  # (heads, B, N)
        # Pooling is linear: the values of the means are the means of the values, which a problem has instead of a pair.
        means = torch.bmm(attention.movedim(0, 1), y)  # (B, heads, width)
        values = self.look.weight[:width].view(heads, width // heads, width)
        context = torch.bmm(means.movedim(1, 0), values.mT).movedim(0, 1).flatten(1) + self.look.bias[:width]
        hidden = functional.linear(y, self.pair.weight)
        hidden = hidden.add_((self.all(context) + self.pair.bias)[:, None]).relu_()
        x = (x + self.out.bias).flatten(0, 1)
        return torch.addmm(x, hidden.flatten(0, 1), self.out.weight.mT).view(batch, count, width)


def _by_channel(x: Tensor, weight: Tensor) -> Tensor:
    """A linear map of (B, N, width) to few channels (C, B, N), each contiguous in memory, which is faster for BLAS."""
    return (weight @ x.flatten(0, 1).mT).unflatten(1, x.shape[:2])


class SetInit(Configured):
    r"""A small network over the set of pairs: several coarse poses, a weight for each pair, and the noise.

    Each pair passes residual layers that see all pairs through pooled attention: the cost is linear in the number of
    pairs, and their order does not matter. For each of ``starts`` hypotheses the network then predicts the distance of
    each point along its ray and a weight for it, and the pose is the rigid motion that moves the world points there
    (weighted least squares in closed form). The poses are equivariant to similarity transforms of the world, rotations
    by any angle included, and to rotations of the camera except its roll; intrinsics enter through the rays alone. The
    network runs in the dtype of its weights, everything around it in the dtype of the correspondences.

    The likeliest pairs also form ``samples`` minimal samples of three, and more samples where there are more pairs.
    The poses of the samples (see :func:`~kornia_pnpnet.init.p3p`) are scored by the 32 likeliest pairs, and the best
    pose is one more hypothesis: a constant without gradient, at a fixed cost.

    The weight of a pair is the estimated probability that it is an inlier. Of noise with covariances the network and
    the scores of samples see the standard deviation of isotropic noise of the same trace. The noise is the ``noise`` of
    the :class:`~kornia_pnpnet.types.Correspondences` where known, else the network's estimate.

    The design is ours. Distances along rays before a closed-form alignment: J. Hesch and S. Roumeliotis, "A direct
    least-squares method for PnP", ICCV 2011, among many; attention pooled over correspondences: W. Sun et al., "ACNe:
    Attentive context normalization for robust permutation-equivariant learning", CVPR 2020; six samples of six pairs of
    which one is free of any two outliers: P. Turán's problem for (6, 4, 3), 1941.

    Args:
        width: number of channels of each pair.
        layers: number of residual layers.
        heads: number of attention heads of each layer.
        hidden: number of channels inside a layer.
        starts: number of hypotheses of the network, at least 1.
        samples: number of minimal samples of the six likeliest pairs, 0 to 8; more pairs have more samples.
        confidence: whether the network sees the ``confidence`` of the correspondences.
        repeats: whether the network sees how many pairs have the same pixel and how many have the same point.

    Raises:
        BaseError: for numbers out of range, or when ``heads`` does not divide ``width``.

    Example:
        >>> corr = Correspondences(torch.randn(2, 7, 3), torch.randn(2, 7, 2), torch.ones(2, 7), torch.tensor(3400.0))
        >>> guess = SetInit(starts=3)(corr)
        >>> guess.pose.rotation.shape, guess.others.translation.shape, guess.weights.shape
        (torch.Size([2, 3, 3]), torch.Size([2, 3, 3]), torch.Size([2, 7]))
    """

    #: Pairs per core whose temporaries stay in its caches. A solver splits larger batches where gradients allow it.
    pairs_at_once = 12_000
    #: The weights say which of the pairs that are not near are inliers.
    weighs_far_pairs = True

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
        self.starts = starts
        self.confidence = confidence
        self.repeats = repeats
        self.first = nn.Linear(_FEATURES + _CONFIDENCE_FEATURES * confidence + _REPEAT_FEATURES * repeats, width)
        self.blocks = nn.ModuleList(_Block(width, heads, hidden) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        # Per pair: the logit of being an inlier; per hypothesis a weight and a distance along the ray.
        self.pair = nn.Linear(width, 1 + 2 * starts)
        # Per problem: the distance of the world in each hypothesis; the noise of pixels and of points.
        self.problem = nn.Linear(width, starts + 2)
        with torch.no_grad():
            self.pair.weight *= 0.3
            self.problem.weight *= 0.1
            for layer in (self.pair, self.problem):
                layer.bias.zero_()
            self.pair.bias[0] = 2.0

    def forward(self, corr: Correspondences, *, search_follows: bool = False) -> Guess:
        """Guess poses, weights and noise.

        Args:
            corr: normalised correspondences of a centred and scaled world, of any :math:`N`, in any order.
            search_follows: draw fewer samples, since what they miss is searched for.

        Returns:
            The first hypothesis as the pose and the other hypotheses as others, the best sample last; probabilities of
            being an inlier as weights; the noise of each pair.

        Raises:
            DeviceError: when the correspondences and the network are on different devices.
        """
        check_devices({"world_points": corr.world_points}, self.pair.bias, "the network")
        view = _View(corr, self.confidence, self.repeats)
        dtype = corr.world_points.dtype
        pair, problem = (x.to(dtype) for x in self._run(view.features, view.there))
        starts = self.starts
        right = torch.sigmoid(pair[0])
        counts, along = pair[1:].unflatten(0, (2, starts)).unbind(0)  # (S, B, N) each
        away, noise = problem.split((starts, 2), -1)
        # A point's distance is the distance of the world's centre plus an offset, so that far worlds keep their relief.
        distance = (away.clamp(-6.0, 6.0) - view.log_spread[:, None]).exp().mT[..., None]  # (S, B, 1)
        relief = (view.points[..., 2] + 3.0 * along) / distance
        ranges = distance * relief.clamp(-3.0, 3.0).exp()
        counts = (right * torch.exp(3.0 * torch.tanh(counts)) + 1e-6) * view.there
        source = view.points.expand(starts, -1, -1, -1).flatten(0, 1)
        pose, _ = align(source, (ranges[..., None] * view.rays).flatten(0, 1), counts.flatten(0, 1))
        # Problems last, after the hypotheses: (3, 3, S, B) and (3, S, B).
        rotation, translation = (x.movedim(0, -1).unflatten(-1, (starts, right.shape[0])) for x in pose)
        back = view.camera.permute(2, 1, 0)[:, :, None]
        rotation = small_product(small_product(back, rotation), view.world.permute(1, 2, 0)[:, :, None])
        translation = small_product(back, translation[:, None])[:, 0]
        noises = self._noise(corr, view, noise)
        if self.samples:
            fallback = Pose(rotation[:, :, 0], translation[:, 0])
            sampled = self._sampled(corr, right, noises, fallback, search_follows)
            rotation, translation = (
                torch.cat((x, y[..., None, :]), -2) for x, y in zip((rotation, translation), sampled, strict=True)
            )
        every = Pose(rotation.permute(3, 2, 0, 1), translation.permute(2, 1, 0))  # (B, S, 3, 3) and (B, S, 3)
        others = Pose(*(x[:, 1:] for x in every)) if every.rotation.shape[1] > 1 else None
        return Guess(Pose(*(x[:, 0] for x in every)), right, others=others, noise=noises)

    def triples(self, count: int, *, search_follows: bool = False) -> dict[int, list[tuple[int, int, int]]]:
        """Minimal samples of a problem.

        Args:
            count: number of pairs.
            search_follows: only those of the likeliest pairs. A search finds what the others would.

        Returns:
            Groups of samples, as ranks of pairs by likelihood, by the least number of pairs of a problem that uses the
            group. Groups that spread over more pairs help where the likeliest pairs are outliers that agree.
        """
        near = [x for x in _SAMPLES[: self.samples] if max(x) < count]
        if search_follows:
            return {0: near}
        spread = {least: [(f * i, f * j, f * k) for i, j, k in near] for least, f in _SPREADS.items() if least <= count}
        ring = {least: ring for least, ring in _RING.items() if least <= count}
        return {0: near, **spread, **ring}

    @torch.no_grad()
    def _sampled(
        self, corr: Correspondences, right: Tensor, noise: Noise, fallback: Pose, search_follows: bool
    ) -> Pose:
        """The best pose of the minimal samples by the score of the likeliest pairs; problems last."""
        batch, count = right.shape
        there = corr.near_weights > 0
        chances = torch.where(there, right, 0.0)
        # An unlikely pair that agrees may be an inlier after all; padding does not score.
        vote = torch.where(there, _LEAST_VOTE + (1.0 - _LEAST_VOTE) * right, 0.0)
        img, world = (x.expand(batch, count)[..., None] for x in (noise.img, noise.world))
        of_pairs = torch.cat((corr.world_points, corr.img_points, vote[..., None], img, world), -1)  # (B, N, 8)
        if not isinstance(count, int):  # exported for any number of pairs: pad to the number of judges
            more = of_pairs[:, :1] * torch.tensor((1, 1, 1, 1, 1, 0, 1, 1), dtype=vote.dtype, device=vote.device)
            of_pairs = torch.cat((of_pairs, more.expand(-1, MOST_JUDGES, -1)), 1)
            chances, count = functional.pad(chances, (0, MOST_JUDGES)), count + MOST_JUDGES
        likely = chances.topk(min(MOST_JUDGES, count)).indices
        pairs = take_pairs(of_pairs, likely)  # (8, K, B)
        samples = self.triples(count, search_follows=search_follows)
        drawn = [sample for group in samples.values() for sample in group]
        # (6, 3, S B), stacked, not indexed, so that a compiler copies whole rows.
        three = torch.stack([pairs[:6, k] for column in zip(*drawn, strict=True) for k in column], 1)
        three = three.unflatten(1, (3, len(drawn))).flatten(2)
        pose, valid = p3p(three[:3].permute(2, 1, 0), three[3:5].permute(2, 1, 0) / corr.focal)
        # Components first, then the four solutions and the samples, problems last: the layout of p3p's results.
        each = len(drawn), batch
        rotation, translation = (x.movedim((0, 1), (-1, -2)).unflatten(-1, each).flatten(-3, -2) for x in pose)
        valid = (valid.mT & (three[5] > 0).all(0)).unflatten(-1, each)  # (4, S, B)
        if len(samples) > 1:  # by the number of pairs without padding, so that padding changes nothing
            enough = [(there.sum(1) >= least).expand(len(group), -1) for least, group in samples.items()]
            valid = valid & torch.cat(enough)
        valid = valid.flatten(0, 1)  # (H, B)
        rotation = rotation.flatten(0, 1)  # (9, H, B)
        if batch and len(valid) > _MANY_SLOTS and valid.device.type == "cpu" and sees_values(valid):
            slots = present_first(valid.mT)[:, : max(int(valid.sum(0).max()), 1)].mT
            rotation, translation = (x.gather(1, slots.expand(len(x), -1, -1)) for x in (rotation, translation))
            valid = valid.gather(0, slots)
        # `project` sees hypotheses as the batch and problems as points, so that problems stay last: (H, K, B, 1).
        matrices = rotation.unflatten(0, (3, 3))
        every = Pose(matrices.permute(2, 0, 1, 3)[:, :, :, None], translation.permute(1, 0, 2)[:, :, None])
        world, img, vote, *sigmas = (x.permute(1, 2, 0)[..., None, :] for x in pairs.split((3, 2, 1, 1, 1)))
        judges = Correspondences(world, img, vote[..., 0], corr.focal)
        projection = project(every, judges)
        # The variance at the depth of the network's pose: by each pose's own depths, a pose close to the points would
        # explain most pixels.
        img, world = (x[..., 0] for x in sigmas)
        depth = fallback.translation[2, :, None].clamp(min=_NEAREST)  # (B, 1)
        variance = img.square() + (corr.focal * world / depth).square()
        support = judges.weights / (1.0 + projection.sq_residual / (_JUDGED * variance))
        support = torch.where(projection.in_front, support, 0.0).sum(1)[..., 0]  # (H, B)
        if corr.prior is not None:
            support = support + votes(corr.prior, Pose(matrices.permute(2, 3, 0, 1), translation.permute(1, 2, 0)))
        best = torch.where(valid, support, -1.0).max(0)
        index = best.indices
        rotation = rotation.gather(1, index.expand(9, 1, -1)).view(3, 3, batch)
        translation = translation.gather(1, index.expand(3, 1, -1))[:, 0]
        found = best.values > 0.0
        return Pose(*(torch.where(found, x, y) for x, y in zip((rotation, translation), fallback, strict=True)))

    def _run(self, features: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
        """The network: outputs for each pair, (1 + 2 S, B, N), and for each problem, (B, S + 2)."""
        x = self.first(features.to(self.first.weight.dtype))
        absent = torch.where(there > 0, 0.0, _ABSENT).to(x.dtype)
        for block in self.blocks:
            x = block(x, absent)
        x = self.norm(x)
        pair = _by_channel(x, self.pair.weight) + self.pair.bias[:, None, None]
        share = (pair[0] + absent).softmax(-1)
        return pair, self.problem(torch.bmm(share[:, None], x)[:, 0])

    def _noise(self, corr: Correspondences, view: _View, estimate: Tensor) -> Noise:
        """The known noise, and the network's estimate where unknown."""
        units = (corr.focal * view.spread)[:, None], torch.ones_like(view.spread)[:, None]
        pairs = []
        for i, ((log, known), unit) in enumerate(zip(view.known, units, strict=True)):
            guessed = _LOG_NOISE + 3.0 * torch.tanh(estimate[:, i : i + 1])
            pairs.append(torch.where(known, log, guessed).exp() * unit)
        return Noise(*pairs)
