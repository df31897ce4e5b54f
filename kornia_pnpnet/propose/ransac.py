r"""RANSAC: the pose with the most inliers among the poses of many small samples, for whole batches at once."""

from __future__ import annotations

import math

import torch
from kornia.core.check import KORNIA_CHECK
from kornia.core.exceptions import ShapeError, ValueCheckError
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_positive, check_whole
from kornia_pnpnet.core.linalg import relative
from kornia_pnpnet.core.performance import compiling, problems_last, sees_values
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.judge.inliers import MAX_FALSE_ALARMS, Judged, Thresholds, judge, log_false_alarms
from kornia_pnpnet.problem import LEAST_NOISE, MIN_PAIRS, Problem, Starts, State
from kornia_pnpnet.propose.initialiser import Initialiser
from kornia_pnpnet.propose.minimal import MinimalSolver, describe
from kornia_pnpnet.propose.p3p import P3P
from kornia_pnpnet.propose.scoring import SCORERS, Scorer
from kornia_pnpnet.propose.search import Search, cauchy_scale, least_squares
from kornia_pnpnet.refine.residual import Projection, project
from kornia_pnpnet.result import Pose

__all__ = ["RANSAC", "search_on"]

# Number of pairs that any pose fits.
_FITTED = 5
# Standard deviations. :func:`search_on` counts nearer pairs as inliers. The limit of estimated noise is wide because
# networks estimate too little noise where most pairs are outliers: an inlier that does not count costs more than an
# outlier that does. That of known noise was tuned on problems of uncertain PnP (`benchmarks/uncertain_problems.py`,
# seeds 777 and 778, 10 pairs with 5 outliers): 4 and 8 lead to larger errors.
_INLIER, _KNOWN_INLIER = 10.0, 5.0
# Residuals at the best focal length on a grid, relative to the median distance of the pixels from the principal point
# and the range of the grid in logarithms. Tuned on random problems with fields of view of 18 to 100 degrees (seed 6).
_GRID_RESIDUAL = 0.04
# Normalised units. Least depth of the centre of the world in the limit of an inlier.
_NEAREST = 0.5
# A pair whose weight or confidence is 0 is drawn this often, relative to a pair where it is 1. Networks mislead more
# often than callers: where repeated structure or crowds agree, for example.
_DOUBT, _LEAST_TRUST = 0.8, 0.05


class RANSAC(Initialiser):
    r"""The pose with the best score among the poses of many samples, improved on its inliers.

    The samples of all problems are solved as one batch, in rounds. After each round the best pose of a problem is
    improved by least squares on its inliers (LO-RANSAC). A problem is done when a sample without an outlier has been
    drawn with the probability ``confidence``. When the pairs have at most ``max_samples`` subsets, each subset is tried
    once instead. Problems share only the random numbers, which are the same in every call: a problem has the same
    result alone, in any batch and at any place in the batch, up to rounding.

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
        minimal: solver of samples, for example :class:`~kornia_pnpnet.propose.p3p.P3P` or
            :class:`~kornia_pnpnet.propose.minimal.SubsetSolver`.
        threshold: :math:`\tau` in pixels of the user's camera.
        world_threshold: :math:`\omega` in the unit of the user's world.
        scorer: ``"msac"``, the truncated squares; ``"inliers"``, the number of outliers; or any function from squared
            residuals over squared thresholds, of any shape, to losses. The loss of a pose is the sum over the pairs,
            weighted by the weights of the pairs.
        max_samples: largest number of samples of a problem.
        min_samples: smallest number of samples of a problem. Noise makes the poses of many outlier-free samples bad,
            so the first of them may not suffice.
        confidence: probability of having drawn a sample without an outlier, in (0, 1).
        final_steps: number of least-squares steps from the best pose, which is near the minimum already. They carry the
            gradient; with 0 the pose is a constant, which is enough where a refinement follows.
        seed: seed of the random numbers.

    Raises:
        BaseError: for an unknown scorer or an argument out of range.

    Example:
        >>> from kornia_pnpnet import PnPNet, RobustWeightedLM
        >>> from kornia_pnpnet.data import OutlierMix, SyntheticProblems
        >>> problems = SyntheticProblems(n=9, batch_size=4, seed=0, outliers=OutlierMix(count=2)).batch(0)
        >>> ransac = RANSAC(P3P(), threshold=6.0, world_threshold=0.3)
        >>> solver = PnPNet(ransac, RobustWeightedLM(m=0, robustness=0))
        >>> result = solver(problems.world_points, problems.img_points, problems.intrinsics)
        >>> torch.equal(result.weights > 0, problems.inliers), result.ok.tolist()
        (True, [True, True, True, True])
    """

    #: Pairs per core of a part of a batch. Parts have problems of about the same number of pairs.
    pairs_at_once = 24_000
    takes_given = True
    takes_rigs = True
    weighs_unusual = True

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
        final_steps: int = 6,
        seed: int = 0,
    ) -> None:
        super().__init__(locals())
        check_whole(1, max_samples=max_samples, min_samples=min_samples)
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
        self.score = scorer if callable(scorer) else SCORERS[scorer]
        self.max_samples, self.min_samples = max_samples, min_samples
        self.confidence, self.final_steps, self.seed = confidence, final_steps, seed
        self.finds_focal = isinstance(minimal, P3P)

    def forward(self, problem: Problem, given: Pose | None = None) -> Starts:
        r"""Find the poses.

        Args:
            problem: normalised problems.
            given: a pose of each problem that competes with those of the samples, in the frame of the problem.

        Returns:
            The poses; as weights :math:`\tau^2 / (\tau^2 + (f \omega / z)^2)` for the inliers, 0 for the outliers; and
            ``ok``.

        Raises:
            ShapeError: when there are fewer pairs than in a sample.
            NotImplementedError: inside of ``torch.func.vmap``.
        """
        size = self.minimal.sample_size
        if problem.weights.shape[1] < size:
            raise ShapeError(
                f"Samples of {size} pairs need N >= {size}, got N = {problem.weights.shape[1]}.",
                actual_shape=tuple(problem.world_points.shape),
                expected_shape=["B", f"{size} or more", "3"],
            )
        if not compiling() and not all(map(sees_values, problem[:3])):
            raise NotImplementedError(
                "torch.func.vmap cannot map RANSAC, whose search ends when its problems are solved. "
                "Give the solver a larger batch: it takes any leading dimensions."
            )
        # Contiguous, so that a sum over pairs rounds alike at every place in the batch; the noise is not used.
        problem = problem._replace(noise=None).map(torch.Tensor.contiguous)
        share = (problem.usual_weights.detach() > 0).to(problem.weights)
        share = share / share.sum(-1, keepdim=True).clamp(min=1.0)
        centre = (share[..., None] * problem.world_points.detach()).sum(1)  # (B, 3)
        # Weights relative to the largest weight, so that their unit does not matter.
        weights = relative(problem.weights, problem.weights)
        problem = problem._replace(world_points=problem.world_points - centre[:, None], weights=weights)
        if problem.prior is not None:
            problem = problem._replace(prior=problem.prior.recentred(centre))
        if given is not None:
            given = map_tensors(lambda x: x.detach()[:, None], _recentred(given, centre))
        fixed = problem.map(torch.Tensor.detach)
        img, world = self.threshold * fixed.img_scale, self.world_threshold * fixed.world_scale
        thresholds = Thresholds(img[:, None], world[:, None])
        stages = [thresholds]
        with torch.no_grad():
            if fixed.free_focal is not None:
                stages = [thresholds._replace(img=thresholds.img.maximum(_on_grid(fixed))), thresholds]
            search = Search(self, fixed, stages[0], _trusted(fixed))
            search.run(given)
        projection, judged = self._refined(problems_last(problem), search.state, stages)
        pose, camera = map_tensors(torch.Tensor.contiguous, projection.state)
        with torch.no_grad():
            projection, counts = map_tensors(torch.Tensor.detach, projection), (fixed.weights > 0).sum(-1)
            # Every number of inliers from 4 to all pairs is another test of the same pose.
            tests = search.scored * (counts - MIN_PAIRS).clamp(min=1)
            alarms = log_false_alarms(tests, projection, problems_last(fixed), thresholds, judged)
            ok = alarms < math.log(MAX_FALSE_ALARMS)
            if fixed.free_focal is None:
                ok |= (judged.inliers == MIN_PAIRS) & (counts == MIN_PAIRS)
            ok &= search.loss.isfinite()
        return Starts(_recentred(pose, -centre), judged.weights.contiguous(), ok, camera=camera)

    def _refined(self, problem: Problem, state: State, stages: list[Thresholds]) -> tuple[Projection, Judged]:
        """Improve poses on their inliers, which are chosen anew for each of the stages."""
        projection = project(state, problem)
        for thresholds in stages:
            judged = judge(projection, problem, thresholds)
            inliers = judged.weights.detach()
            for _ in range(self.final_steps):
                state = least_squares(problem, projection, inliers * _robust(judged.errors, inliers))
                projection = project(state, problem)
                judged = judge(projection, problem, thresholds)
        return projection, map_tensors(torch.Tensor.detach, judged)


def _recentred(pose: Pose, centre: Tensor) -> Pose:
    """Poses where a world point (B, 3) becomes the origin."""
    return Pose(pose.rotation, pose.translation + (pose.rotation @ centre[..., None])[..., 0])


def _on_grid(problem: Problem) -> Tensor:
    """Threshold of residuals between the focal lengths of a grid, in pixels of the problem, (B, 1)."""
    away = torch.where(problem.weights > 0, problem.img_points.abs().amax(-1), torch.nan)
    return (_GRID_RESIDUAL * problem.free_focal.width * away.nanmedian(1).values.nan_to_num(0.0))[:, None]


def _robust(errors: Tensor, inliers: Tensor) -> Tensor:
    """Weights of a Cauchy kernel, (B, N): its scale follows the median residual of the inliers, wherever they end.

    Thresholds are wide, and noise has tails: with equal weights, pairs near the threshold would decide the pose.
    """
    sq_scale, count = cauchy_scale(errors, inliers > 0)
    # Few inliers lie close to the pose that was fitted to them: their residuals say less than they seem to.
    free = (count - _FITTED).clamp(min=0) / count.clamp(min=1)
    return 1.0 / (1.0 + free * errors / sq_scale.clamp(min=torch.finfo(errors.dtype).eps))


# How :func:`search_on` searches.
_FURTHER = RANSAC(P3P(), min_samples=64)


def _trusted(problem: Problem) -> Tensor:
    """How often pairs are drawn, by the caller's confidence, (B, N)."""
    if problem.confidence is None:
        return torch.ones_like(problem.weights)
    return _LEAST_TRUST + (1.0 - _LEAST_TRUST) * problem.confidence.nan_to_num(0.5)


@torch.no_grad()
def search_on(problem: Problem, starts: Starts, *, keep_others: bool = False) -> Starts:
    r"""Go on searching where the poses of an initialiser do not suffice, with samples of likely inliers.

    Samples hold pairs in proportion to 0.8 plus 0.2 times the weight of the starts, times the caller's confidence:
    weights that mislead then cost some samples, but no pose. An inlier is within ten standard deviations of the noise
    that the starts estimate (its mean over the pairs), or within five of the noise of its pair that the caller gave; of
    noise with covariances the standard deviation of isotropic noise of the same trace. The limit is that of a point as
    far away as the centre of the world in the first pose, for all poses: with a limit by each pose's own depths, a pose
    close to the points would have most inliers.

    A problem is searched only when, by the number of inliers of the best pose of the starts, it needs more than 64
    samples to reach a confidence of 0.999, and still does after its poses were improved on their inliers. Problems that
    are done leave the batch, and no problem's result depends on the others.

    Args:
        problem: normalised problems of a centred and scaled world.
        starts: several poses, probabilities of being an inlier as weights, and the noise of the pairs.
        keep_others: whether the starts keep their other poses. The caller's pose is one of them, and few pairs alone
            may lead away from it.

    Returns:
        The starts with the best pose, a constant. Where a problem was searched, the weights are those of a Cauchy
        kernel at this pose, whose scale is the limit of an inlier: the network's likelihoods misled there.

    Raises:
        ValueCheckError: when the initialiser does not estimate the noise.
    """
    if starts.noise is None or starts.others is None:
        raise ValueCheckError('effort="adaptive" needs an initialiser with several poses and the noise, as SetInit.')
    constant = map_tensors(torch.Tensor.detach, starts)
    known, noise = problem.noise, map_tensors(torch.Tensor.detach, starts.noise)
    problem = problem._replace(noise=None).map(lambda x: x.detach().contiguous())
    depth = constant.pose.translation[:, 2:].clamp(min=_NEAREST)  # (B, 1)
    sigma = torch.hypot(noise.img, problem.focal * noise.world / depth).maximum(LEAST_NOISE * problem.focal)
    if known is None:
        there = (problem.weights > 0).to(sigma)
        sigma = (sigma * there).sum(-1, keepdim=True) / there.sum(-1, keepdim=True).clamp(min=1.0)
        limit = _INLIER * sigma
    else:
        limit = torch.where(known.img.isfinite() & known.world.isfinite(), _KNOWN_INLIER, _INLIER) * sigma
    thresholds = Thresholds(limit, torch.zeros_like(depth))
    chances = (_DOUBT + (1.0 - _DOUBT) * constant.weights) * _trusted(problem)
    given = map_tensors(lambda *x: torch.stack(x, 1), *constant.poses)
    search = Search(_FURTHER, problem, thresholds, chances, sigma)
    search.run(given, enough=_FURTHER.min_samples)
    state = search.state
    judged = judge(project(state, problems_last(problem)), problem, thresholds)
    weights = torch.where((search.drawn > 0)[:, None], 1.0 / (1.0 + judged.errors), constant.weights)
    others = starts.others if keep_others else None
    return starts._replace(pose=state.pose, others=others, weights=weights, camera=state.camera)
