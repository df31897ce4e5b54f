r"""RANSAC: the pose with the most inliers among the poses of many small samples, for whole batches at once."""

from __future__ import annotations

import math
from typing import Any

import torch
from kornia.core.check import KORNIA_CHECK
from kornia.core.exceptions import ShapeError, ValueCheckError
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_positive, check_whole
from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.core.linalg import relative
from kornia_pnpnet.core.performance import problems_last
from kornia_pnpnet.core.trees import map_tensors, take
from kornia_pnpnet.geometry import Projection, project
from kornia_pnpnet.propose.minimal import MinimalSolver, describe
from kornia_pnpnet.propose.p3p import P3P, P3PFocals
from kornia_pnpnet.propose.p3p_rig import P3PRig, is_central
from kornia_pnpnet.propose.sampling import kept_at_once
from kornia_pnpnet.propose.scoring import SCORERS, Scorer
from kornia_pnpnet.propose.search import (
    PAIRS_PER_SAMPLE,
    Found,
    Plan,
    Search,
    full_vectors,
    least_squares,
)
from kornia_pnpnet.judge.inliers import (
    MAX_FALSE_ALARMS,
    Judged,
    Thresholds,
    chance_of_inlier,
    chance_of_others,
    fitted_pairs,
    judge,
    log_false_alarms,
)
from kornia_pnpnet.refine.prior import recentred
from kornia_pnpnet.types import LEAST_NOISE, MIN_PAIRS, Problem, Starts, Pose

__all__ = ["FURTHER", "RANSAC", "search_on"]

# The scale of the Cauchy kernel of these steps, in standard deviations of the inliers' residuals; the median of the
# squared residuals of Gaussian noise, in variances of a pixel coordinate; pairs that a pose fits by itself.
_KERNEL_SCALE, _MEDIAN, _FITTED = 3.4, 2.0 * math.log(2.0), 5
# Standard deviations. :func:`search_on` counts nearer pairs as inliers. The limit of estimated noise is wide because
# networks estimate too little noise where most pairs are wrong: right pairs that do not count cost more than wrong
# pairs that do. That of known noise was tuned on problems of uncertain PnP (`benchmarks/uncertain_problems.py`, seeds
# 777 and 778, 10 pairs with 5 outliers): 4 and 8 lead to larger errors.
_INLIER, _KNOWN_INLIER = 10.0, 5.0
# Residuals at the best focal length on a grid, relative to the median distance of the pixels from the principal point
# and the range of the grid in logarithms. Tuned on random problems with fields of view of 18 to 100 degrees (seed 6).
_GRID_RESIDUAL = 0.04
# Normalised units. A guess that has the centre of the world nearer than this counts as this near.
_NEAREST = 0.5
# A pair whose weight or confidence is 0 is drawn this often, relative to a pair where it is 1. Networks mislead more
# often than callers: where repeated structure or crowds agree, for example.
_DOUBT, _LEAST_TRUST = 0.8, 0.05


class RANSAC(Configured):
    r"""The pose with the best score among the poses of many samples, improved on its inliers.

    The samples of all problems are solved as one batch, in rounds. After each round the best pose of a problem is
    improved by least squares on its inliers (LO-RANSAC). A problem is done when a sample without an outlier has been
    drawn with the probability ``confidence``. When the pairs have at most ``max_samples`` subsets, each subset is tried
    once instead. Problems share only the random numbers, which are the same in every call: a problem has the same
    result alone, in any batch and at any place in the batch, except that torch's kernels for a single problem may round
    the last bit differently.

    A pair is an inlier when :math:`\|r\|^2 < \tau^2 + (f \omega / z)^2`. The ``threshold`` :math:`\tau` is for errors
    of the pixels; the ``world_threshold`` :math:`\omega` is for errors of the points, which move the pixel by
    :math:`f/z` times as much. Least squares weigh an inlier by the inverse of the right hand side.

    The guess is ``ok`` when fewer than 0.01 poses with as many inliers are expected by chance, from pairs without any
    pose behind them (see :func:`~kornia_pnpnet.judge.inliers.log_false_alarms`). A problem of only three pairs is
    ``ok`` when it has a pose: three pairs hold no evidence.

    Where the caller gave a confidence for each pair, samples hold pairs in proportion to it, and fewer samples suffice
    when the inliers are those with much confidence.

    Gradients: the inliers, and their weights by depth, are selected without a gradient. The last refinement, unrolled
    least squares on the inliers from a constant start near the minimum, has a gradient to points, pixels and weights.

    Source: M. Fischler and R. Bolles, Communications of the ACM 24(6), 1981; O. Chum, J. Matas and J. Kittler,
    "Locally optimized RANSAC", DAGM 2003; P. Torr and A. Zisserman, CVIU 78(1), 2000 (MSAC); scoring few pairs first as
    in D. Nistér, "Preemptive RANSAC for live structure and motion estimation", ICCV 2003.

    Args:
        minimal: solver of samples, for example :class:`~kornia_pnpnet.propose.P3P` or
            :class:`~kornia_pnpnet.propose.SubsetSolver`.
        threshold: :math:`\tau` in pixels of the user's camera.
        world_threshold: :math:`\omega` in the unit of the user's world.
        scorer: ``"msac"``, the truncated squares; ``"inliers"``, the number of outliers; or any function from squared
            residuals over squared thresholds, of any shape, to losses. The loss of a pose is the sum over the pairs,
            weighted by the weights of the pairs.
        max_samples: largest number of samples of a problem.
        min_samples: smallest number of samples of a problem. Noise makes the poses of many outlier-free samples bad,
            so the first of them may not suffice.
        confidence: probability of having drawn a sample without an outlier, in (0, 1).
        local_candidates: number of best poses of a round that are improved.
        local_iterations: number of times that a pose is improved on its current inliers; the first time on the pairs
            within three times the thresholds.
        final_steps: number of least-squares steps from the best pose, which is near the minimum already. They carry the
            gradient; with 0 the pose is a constant, which is enough where a refinement follows.
        seed: seed of the random numbers.
        chunk_size: number of samples that are solved and scored together. It bounds the memory; a processor's cache
            should hold the tensors of a chunk.

    Raises:
        BaseError: for an unknown scorer or an argument out of range.

    Example:
        >>> from kornia_pnpnet import PnPNet, RobustWeightedLM
        >>> from kornia_pnpnet.data import OutlierMix, SyntheticProblems
        >>> from kornia_pnpnet.propose.p3p import P3P
        >>> problems = SyntheticProblems(n=9, batch_size=4, seed=0, outliers=OutlierMix(count=2)).batch(0)
        >>> ransac = RANSAC(P3P(), threshold=6.0, world_threshold=0.3)
        >>> solver = PnPNet(ransac, RobustWeightedLM(m=0, robustness=0))
        >>> result = solver(problems.world_points, problems.img_points, problems.intrinsics)
        >>> torch.equal(result.weights > 0, problems.inliers), result.ok.tolist()
        (True, [True, True, True, True])
    """

    #: Pairs per core of a part of a batch. Parts have problems of about the same number of pairs.
    pairs_at_once = 24_000
    #: The weights say which of the pairs that are not near are inliers.
    weighs_far_pairs = True

    def __init__(
        self,
        minimal: MinimalSolver,
        *,
        threshold: float = 4.0,
        world_threshold: float = 0.0,
        scorer: str | Scorer = "msac",
        max_samples: int = 10_000,
        min_samples: int = 32,
        confidence: float = 0.999,
        local_candidates: int = 3,
        local_iterations: int = 2,
        final_steps: int = 6,
        seed: int = 0,
        chunk_size: int = 4096,
    ) -> None:
        super().__init__(locals())
        check_whole(1, max_samples=max_samples, min_samples=min_samples, chunk_size=chunk_size)
        check_whole(1, local_candidates=local_candidates, local_iterations=local_iterations)
        check_whole(0, 2**63 - 1, seed=seed)
        check_positive(threshold=threshold)
        check_whole(0, final_steps=final_steps)
        check_numbers(0.0, world_threshold=world_threshold)
        KORNIA_CHECK(0 < confidence < 1, f"confidence must lie in (0, 1), got {confidence}.")
        KORNIA_CHECK(callable(scorer) or scorer in SCORERS, f"scorer must be one of {sorted(SCORERS)}, got {scorer!r}.")
        name = getattr(scorer, "__name__", type(scorer).__name__) if callable(scorer) else scorer
        self.config.update(minimal=describe(minimal), scorer=name)
        self.minimal = minimal
        self.threshold = threshold
        self.world_threshold = world_threshold
        self.final_steps = final_steps
        self.chunk_size = chunk_size
        options = {name: self.config[name] for name in Plan._fields}
        options.update(minimal=minimal, scorer=scorer if callable(scorer) else SCORERS[scorer])
        self.plan = Plan(**options)

    def forward(self, corr: Problem, given: Pose | None = None) -> Starts:
        r"""Find the poses.

        Args:
            corr: normalised correspondences.
            given: poses in the frame of the correspondences that compete with those of the samples.

        Returns:
            The poses; as weights :math:`\tau^2 / (\tau^2 + (f \omega / z)^2)` for the inliers, 0 for the outliers; and
            ``ok``.

        Raises:
            ShapeError: when there are fewer pairs than in a sample.
        """
        size = self.minimal.sample_size
        if corr.weights.shape[1] < size:
            raise ShapeError(
                f"Samples of {size} pairs need N >= {size}, got N = {corr.weights.shape[1]}.",
                actual_shape=tuple(corr.world_points.shape),
                expected_shape=["B", f"{size} or more", "3"],
            )
        # Contiguous, so that a sum over pairs rounds alike at every place in the batch; the noise is not used.
        corr = corr._replace(noise=None).map(torch.Tensor.contiguous)
        with torch.no_grad():
            share = (corr.usual_weights > 0).to(corr.weights)
            share = share / share.sum(-1, keepdim=True).clamp(min=1.0)
            centre = (share[..., None] * _constant(*corr[:3])).sum(1)  # (B, 3)
        # Weights relative to the largest weight, so that their unit does not matter.
        weights = relative(corr.weights, corr.weights)
        corr = corr._replace(world_points=corr.world_points - centre[:, None], weights=weights)
        if corr.prior is not None:
            corr = corr._replace(prior=recentred(corr.prior, centre))
        with torch.no_grad():
            thresholds = self._thresholds(corr)
            if given is not None:
                given = given._replace(translation=given.translation + (given.rotation @ centre[..., None])[..., 0])
                given = map_tensors(lambda x: x.detach()[:, None], given)
            detached = corr.map(torch.Tensor.detach)
            plan, stages = self.plan, [thresholds]
            if corr.free_focal is not None:
                plan = plan._replace(minimal=P3PFocals())
                wide = thresholds.img.maximum(_on_grid(detached))
                stages = [thresholds._replace(img=wide), thresholds]
            if detached.rig is not None:
                plan = plan._replace(minimal=P3PRig(0) if is_central(detached.rig) else P3PRig())
            found = Search(plan, detached, stages[0], _trusted(detached.confidence)).run(given)
        pose, zoom, judged = self._refine(corr, found, stages)
        with torch.no_grad():
            detached = problems_last(detached).zoomed(zoom)
            ok = self._is_evident(found, detached, thresholds, judged, project(pose, detached))
        offset = (pose.rotation @ centre[..., None])[..., 0]
        return Starts(Pose(pose.rotation, pose.translation - offset), judged.weights, ok, zoom=zoom)

    def _thresholds(self, corr: Problem) -> Thresholds:
        """The thresholds in units of the correspondences, (B,) each."""
        one = torch.ones_like(corr.weights[:, 0])
        img, world = (one if scale is None else scale.detach() for scale in (corr.img_scale, corr.world_scale))
        return Thresholds(self.threshold * img, self.world_threshold * world)

    def _refine(
        self, corr: Problem, found: Found, stages: list[Thresholds]
    ) -> tuple[Pose, Tensor | None, Judged]:
        """Improve poses on their inliers, in chunks whose tensors a cache holds; return the inliers afterwards, too.

        The inliers are chosen anew for each entry of ``stages``.
        """
        size = max(1, kept_at_once(PAIRS_PER_SAMPLE * self.chunk_size, corr.weights) // corr.weights.shape[1])
        results = []
        for first in range(0, max(1, len(corr.weights)), size):
            last = min(first + size, len(corr.weights))
            at = full_vectors(torch.arange(first, last, device=corr.weights.device), corr.weights.shape[1])
            base, pose, zoom, part_stages = take((corr, found.pose, found.zoom, stages), at)
            base = problems_last(base)
            part = base.zoomed(zoom)
            projection = project(pose, part)
            for limits in part_stages:
                with torch.no_grad():
                    inliers = judge(projection, part, limits).weights.detach()
                for _ in range(self.final_steps):
                    weights = inliers * _robust(judge(projection, part, limits), inliers)
                    step = least_squares(part, pose, projection, weights)
                    pose, zoom = step.pose, step.zoom_after(zoom)
                    part = base.zoomed(zoom)
                    projection = project(pose, part)
            with torch.no_grad():
                judged = map_tensors(torch.Tensor.detach, judge(projection, part, limits))
            results.append(take((pose, zoom, judged), slice(last - first)))
        pose, zoom, judged = map_tensors(lambda *parts: torch.cat(parts), *results)
        return map_tensors(torch.Tensor.contiguous, pose), zoom, judged

    def _is_evident(
        self, found: Found, corr: Problem, thresholds: Thresholds, judged: Judged, projection: Projection
    ) -> Tensor:
        """Whether a pose has more inliers than chance would give it, (B,)."""
        inliers, counts = (judged.weights > 0).sum(-1), (corr.weights > 0).sum(-1)
        chance = chance_of_inlier(corr, thresholds, judged)
        chance = chance.maximum(chance_of_others(projection, corr, thresholds, judged))
        # Every number of inliers from 4 to all pairs is another test of the same pose.
        tests = found.poses * (counts - MIN_PAIRS).clamp(min=1)
        fitted = fitted_pairs(corr)
        rare = log_false_alarms(tests, inliers, counts, chance, fitted) < math.log(MAX_FALSE_ALARMS)
        if corr.free_focal is not None:
            return found.loss.isfinite() & rare
        return found.loss.isfinite() & (rare | ((inliers == MIN_PAIRS) & (counts == MIN_PAIRS)))


def _on_grid(corr: Problem) -> Tensor:
    """Threshold of residuals between the focal lengths of a grid, in pixels of the correspondences, (B,)."""
    assert corr.free_focal is not None
    away = torch.where(corr.weights > 0, corr.img_points.abs().amax(-1), torch.nan)
    return _GRID_RESIDUAL * corr.free_focal.width * away.nanmedian(1).values.nan_to_num(0.0)


def _robust(judged: Judged, inliers: Tensor) -> Tensor:
    """Weights of a Cauchy kernel, (B, N): its scale follows the median residual of the inliers, wherever they end.

    Thresholds are wide, and noise has tails: with equal weights, pairs near the threshold would decide the pose.
    """
    count = (inliers > 0).sum(-1, keepdim=True)
    ascending = torch.where(inliers > 0, judged.errors, torch.inf).sort(-1).values
    median = ascending.gather(1, ((count + MIN_PAIRS) // 2).minimum(count - 1).clamp(min=0)).clamp(
        min=torch.finfo(ascending.dtype).eps
    )
    # Few inliers lie close to the pose that was fitted to them: their residuals say less than they seem to.
    free = (count - _FITTED).clamp(min=0) / count.clamp(min=1)
    sq_scale = _KERNEL_SCALE**2 * median / _MEDIAN
    return 1.0 / (1.0 + free * judged.errors / sq_scale)


#: How :func:`search_on` searches unless told otherwise.
FURTHER = RANSAC(P3P(), min_samples=64).plan


def _trusted(confidence: Tensor | None) -> Tensor | None:
    """How often pairs are drawn, by the caller's confidence, (B, N)."""
    return None if confidence is None else _LEAST_TRUST + (1.0 - _LEAST_TRUST) * confidence.nan_to_num(0.5)


@torch.no_grad()
def search_on(corr: Problem, guess: Starts, *, keep_others: bool = False, plan: Plan = FURTHER) -> Starts:
    r"""Go on searching where the poses of a guess do not suffice, with samples of likely inliers.

    Samples hold pairs in proportion to 0.8 plus 0.2 times the weight of the guess, times the caller's confidence:
    weights that mislead then cost some samples, but no pose. An inlier is within ten standard deviations of the noise
    that the guess estimates (its mean over the pairs), or within five of the noise of its pair that the caller gave; of
    noise with covariances the standard deviation of isotropic noise of the same trace. The limit is that of a point as
    far away as the centre of the world in the guess, for all poses: with a limit by each pose's own depths, a pose
    close to the points would have most inliers.

    A problem is searched only when, by the number of inliers of the guess's best pose, it needs more than
    ``plan.min_samples`` samples to reach ``plan.confidence``, and still does after its poses were improved on their
    inliers. Problems that are done leave the batch, and no problem's result depends on the others.

    Args:
        corr: normalised correspondences of a centred and scaled world.
        guess: poses, probabilities of being an inlier as weights, and the noise of the pairs.
        keep_others: whether the guess keeps its other poses. The caller's pose is one of them, and few pairs alone may
            lead away from it.
        plan: how to search.

    Returns:
        The guess with the best pose, a constant. Where a problem was searched, the weights are those of a Cauchy kernel
        at this pose, whose scale is the limit of an inlier: the network's likelihoods misled there.

    Raises:
        ValueCheckError: when the initialiser does not estimate the noise.
    """
    if guess.noise is None or guess.others is None:
        raise ValueCheckError('effort="adaptive" needs an initialiser with several poses and the noise, as SetInit.')
    told, noise = corr.noise, map_tensors(torch.Tensor.detach, guess.noise)
    corr = corr._replace(noise=None).map(lambda x: x.detach().contiguous())
    depth = guess.pose.translation[:, 2:].detach().clamp(min=_NEAREST)  # (B, 1)
    sigma = torch.hypot(noise.img, corr.focal * noise.world / depth).maximum(LEAST_NOISE * corr.focal)
    if told is None:
        there = (corr.weights > 0).to(sigma)
        sigma = (sigma * there).sum(-1) / there.sum(-1).clamp(min=1.0)
        limit = _INLIER * sigma
    else:
        known = told.img.isfinite() & told.world.isfinite()
        limit = torch.where(known, _KNOWN_INLIER, _INLIER) * sigma
    thresholds = Thresholds(limit, torch.zeros_like(depth[:, 0]))
    chances = _DOUBT + (1.0 - _DOUBT) * guess.weights.detach()
    trusted = _trusted(corr.confidence)
    chances = chances if trusted is None else chances * trusted
    given = map_tensors(lambda *x: torch.stack(x, 1).detach(), *guess.poses)
    found = Search(plan, corr, thresholds, chances, sigma).run(given, worth=plan.min_samples)
    judged = judge(project(found.pose, problems_last(corr).zoomed(found.zoom)), corr, thresholds)
    searched = (found.samples > 0)[:, None]
    weights = torch.where(searched, 1.0 / (1.0 + judged.errors), guess.weights)
    others = guess.others if keep_others else None
    return guess._replace(pose=found.pose, others=others, weights=weights, zoom=found.zoom)


class _Constant(torch.autograd.Function):
    """See :func:`_constant`."""

    @staticmethod
    def forward(world_points: Tensor, img_points: Tensor, weights: Tensor) -> Tensor:
        return world_points.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.mark_non_differentiable(output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *tensors: Tensor) -> tuple[Tensor, int]:
        raise NotImplementedError(
            "torch.func.vmap cannot map RANSAC, whose search ends when its problems are solved. "
            "Give the solver a larger batch: it takes any leading dimensions."
        )


def _constant(world_points: Tensor, img_points: Tensor, weights: Tensor) -> Tensor:
    """The points as a constant; an error that says what to do inside of ``torch.func.vmap``."""
    constant: Tensor = _Constant.apply(*(x.detach() for x in (world_points, img_points, weights)))  # type: ignore[no-untyped-call]
    return constant
