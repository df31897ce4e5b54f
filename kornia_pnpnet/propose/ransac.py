"""RANSAC: the pose with the best score among the poses of many small samples, for batches."""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK
from kornia.core.exceptions import ShapeError, ValueCheckError
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_positive, check_whole
from kornia_pnpnet.core.linalg import relative
from kornia_pnpnet.core.performance import compiling, problems_last, sees_values
from kornia_pnpnet.core.trees import map_tensors, put, take
from kornia_pnpnet.judge.inliers import Thresholds, judge
from kornia_pnpnet.problem import LEAST_DEPTH, LEAST_NOISE, MIN_PAIRS, Problem, Starts, State
from kornia_pnpnet.propose.initialiser import Initialiser
from kornia_pnpnet.propose.minimal import MinimalSolver, describe
from kornia_pnpnet.propose.p3p import P3P
from kornia_pnpnet.propose.sampling import samples_needed
from kornia_pnpnet.propose.scoring import SCORERS, Scorer
from kornia_pnpnet.propose.search import Search, are_open, cauchy_scale, least_squares
from kornia_pnpnet.refine.residual import project
from kornia_pnpnet.result import Pose

__all__ = ["RANSAC", "search_on"]

# A pose can fit this number of inliers closely even if the pixels are noisy.
_FITTED = 5
# Largest residuals of an inlier in `search_on`, in standard deviations. The first limit is for noise that a network
# estimates. Networks underestimate the noise when most pairs are outliers. The second limit is for the caller's noise.
_INLIER, _KNOWN_INLIER = 10.0, 5.0
# For an unknown focal length, the inlier threshold is at least the product of this number, half the range of log f, and
# the median distance of the pixels from the principal point. The number was tuned on random problems with fields of
# view of 18 to 100 degrees (seed 6).
_GRID_RESIDUAL = 0.04
# _DOUBT is the chance that a pair of weight 0 is drawn, divided by the chance for weight 1. _LEAST_TRUST is this ratio
# for confidences 0 and 1. _LEAST_TRUST is smaller, because confidences are more reliable than a network's weights.
_DOUBT, _LEAST_TRUST = 0.8, 0.05


class RANSAC(Initialiser):
    r"""Find the pose with the best score among the poses of many samples, and improve this pose on its inliers.

    The samples of all problems are solved as one batch, in rounds. If a round finds a better pose, least squares on
    the inliers improve this pose (LO-RANSAC). The search of a problem ends when the probability of at least one sample
    without outliers reaches ``confidence``. If a problem has at most ``max_samples`` possible samples, no sample is
    drawn twice. All problems and calls use the same random numbers. Except for rounding, the result of a problem
    therefore does not depend on the batch. Pairs with a larger confidence are drawn more often. Except in rigs, pairs
    whose pixels are in one cell of the size of the threshold share one weight in the score.

    A pair is an inlier when :math:`\|r\|^2 < \tau^2 + (f \omega / z)^2`, see :mod:`kornia_pnpnet.judge.inliers`. In
    least squares, the weight of an inlier is :math:`\tau^2` divided by the right-hand side, without gradient. The final
    steps multiply this weight by that of a Cauchy kernel. The final steps start from a detached pose close to the
    minimum, and have gradients with respect to points, pixels and weights. The choice of inliers has no gradient.
    Least squares use neither known noise nor priors of the pose. A following refinement uses both.

    Source: M. Fischler and R. Bolles, Communications of the ACM 24(6), 1981; O. Chum, J. Matas and J. Kittler,
    "Locally optimized RANSAC", DAGM 2003; P. Torr and A. Zisserman, CVIU 78(1), 2000 (MSAC); D. Nistér, "Preemptive
    RANSAC for live structure and motion estimation", ICCV 2003 (few pairs score all poses first).

    Args:
        minimal: minimal solver, for example :class:`~kornia_pnpnet.propose.p3p.P3P` or
            :class:`~kornia_pnpnet.propose.minimal.SubsetSolver`.
        threshold: :math:`\tau` in pixels of the user's camera; with distortion, in undistorted pixels.
        world_threshold: :math:`\omega` in the unit of the user's world.
        scorer: loss of a pair, ``"msac"`` (truncated square), ``"inliers"`` (1 for outliers, 0 for inliers), or a
            function (see ``kornia_pnpnet.propose.scoring.Scorer``).
        max_samples: largest number of samples of a problem.
        min_samples: smallest number of samples of a problem. Noise can make the pose of a single sample inaccurate.
        confidence: required probability that at least one sample has no outlier, in (0, 1).
        final_steps: number of least-squares steps from the best pose. 0 steps suffice before a refinement, but leave
            the pose without gradient.
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
        >>> torch.equal(result.inliers, problems.inliers), result.ok.tolist()
        (True, [True, True, True, True])
    """

    #: See Initialiser.
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
            problem: normalised problems. The world must be centred, because the search computes in float32.
            given: one pose per problem, which competes with the poses of the samples.

        Returns:
            The poses, ``ok``, and weights: :math:`\tau^2 / (\tau^2 + (f \omega / z)^2)` for inliers, 0 for outliers.

        Raises:
            ShapeError: when a problem has fewer pairs than a sample.
            NotImplementedError: inside of ``torch.func.vmap``, or on the device ``meta``.
        """
        size = self.minimal.sample_size if problem.rig is None else MIN_PAIRS
        if problem.weights.shape[1] < size:
            raise ShapeError(
                f"Samples of {size} pairs need N >= {size}, got N = {problem.weights.shape[1]}.",
                actual_shape=tuple(problem.world_points.shape),
                expected_shape=["B", f"{size} or more", "3"],
            )
        if not compiling() and not sees_values(*problem[:3]):
            raise NotImplementedError(
                "RANSAC runs neither in torch.func.vmap nor on the device meta, because the number of samples depends "
                "on tensor values. Instead of vmap, give the solver a larger batch with any leading dimensions."
            )
        # If tensors are contiguous, the rounding of sums over pairs does not depend on the position in the batch.
        problem = problem._replace(noise=None).map(torch.Tensor.contiguous)
        problem = problem._replace(weights=relative(problem.weights, problem.weights.detach()))
        fixed = problem.map(torch.Tensor.detach)
        img, world = self.threshold * fixed.img_scale, self.world_threshold * fixed.world_scale
        thresholds = Thresholds(img[:, None], world[:, None])
        stages = [thresholds]
        with torch.no_grad():
            if fixed.free_focal is not None:  # a wider threshold for focal lengths between two values of P3P's grid
                away = torch.where(fixed.weights > 0, fixed.img_points.abs().amax(-1), torch.nan)
                wide = _GRID_RESIDUAL * fixed.free_focal.width * away.nanmedian(1).values.nan_to_num(0.0)
                stages = [thresholds._replace(img=thresholds.img.maximum(wide[:, None])), thresholds]
            search = Search(self, fixed, stages[0], _trusted(fixed), ranks=True)
            search.run(map_tensors(lambda x: x.detach()[:, None], given))
        state, weights = self._refined(problems_last(problem), search.state, stages)
        pose, camera = map_tensors(torch.Tensor.contiguous, state)
        return Starts(pose, weights.contiguous(), search.loss.isfinite(), camera=camera)

    def _refined(self, problem: Problem, state: State, stages: list[Thresholds]) -> tuple[State, Tensor]:
        """Improve poses on their inliers, and weigh the pairs. Each stage selects the inliers once."""
        projection = project(state, problem)
        for thresholds in stages:
            judged = judge(projection, problem, thresholds)
            inliers = judged.weights.detach()
            for _ in range(self.final_steps):
                state = least_squares(problem, projection, inliers * _robust(judged.errors, inliers))
                projection = project(state, problem)
                judged = judge(projection, problem, thresholds)
        return state, judged.weights.detach()


def _robust(errors: Tensor, inliers: Tensor) -> Tensor:
    """Weights (B, N) of a Cauchy kernel. The inliers' median residual gives the scale, because thresholds are wide."""
    there = inliers > 0
    sq_scale = cauchy_scale(errors, there).clamp(min=torch.finfo(errors.dtype).eps)
    # With few inliers, the median residual underestimates the noise. All weights are then moved toward 1.
    count = there.sum(-1, keepdim=True, dtype=errors.dtype)
    return 1.0 / (1.0 + (count - _FITTED).clamp(min=0) / count.clamp(min=1) * errors / sq_scale)


_FURTHER = RANSAC(P3P(), min_samples=64)


def _trusted(problem: Problem) -> Tensor:
    """The caller's confidences as relative chances (B, N) of drawing pairs."""
    if problem.confidence is None:
        return torch.ones_like(problem.weights)
    return _LEAST_TRUST + (1.0 - _LEAST_TRUST) * problem.confidence.nan_to_num(0.5)


@torch.no_grad()
def search_on(problem: Problem, starts: Starts, *, keep_others: bool) -> tuple[Starts, tuple[Tensor, Pose] | None]:
    r"""Run RANSAC on the problems for which the poses of an initialiser do not suffice.

    A problem is searched only if the inliers of the last pose of the starts require over 64 samples for a confidence of
    0.999, or if they determine the pose poorly (see ``are_open``). In the search, all poses of the starts compete with
    the poses of the samples. Let :math:`w` be the weight of a pair in the starts. The chance of drawing this pair is
    proportional to :math:`0.8 + 0.2 w`. A large confidence of the caller increases the chance.

    A pair is an inlier if its residual is below ten standard deviations. If the caller gave both sigmas of the pair,
    the limit is five standard deviations. If the caller gave no noise, the standard deviation of every pair is the mean
    of the estimates. The noise of points is converted to pixels at one depth: the depth of the world's origin in the
    first pose. If each pose used its own depths, a pose close to the points would have the most inliers.

    Args:
        problem: normalised problems of a centred and scaled world.
        starts: poses of each problem, the most promising pose last, and the noise of the pairs. Weights are
            probabilities that pairs are inliers.
        keep_others: whether to keep the other poses of the starts. With few pairs, the best pose can be incorrect.

    Returns:
        First, the starts with the best pose of the search, without gradient. If a problem is not searched, the last
        pose takes this place (unless all poses are kept). In a searched problem, a Cauchy kernel at the best pose gives
        the weights. The kernel's scale is the inlier threshold. Second, the indices of the searched problems and their
        poses with the least loss at wider thresholds, for the comparison with the refined poses (see `reconsider`).
        ``None``: no problem is searched.

    Raises:
        ValueCheckError: when the starts have no noise.
    """
    constant = map_tensors(torch.Tensor.detach, starts)
    known, noise = problem.noise, constant.noise
    if noise is None:
        raise ValueCheckError('effort="adaptive" needs an initialiser that estimates the noise, like SetInit.')
    problem = problem._replace(noise=None).map(lambda x: x.detach().contiguous())
    depth = constant.pose.translation[:, 2:].clamp(min=LEAST_DEPTH)  # (B, 1)
    sigma = torch.hypot(noise.img, problem.focal * noise.world / depth).maximum(LEAST_NOISE * problem.focal)
    if known is None:
        there = (problem.weights > 0).to(sigma)
        sigma = (sigma * there).sum(-1, keepdim=True) / there.sum(-1, keepdim=True).clamp(min=1.0)
        limit = _INLIER * sigma
    else:
        is_known = known.img.isfinite() & known.world.isfinite()
        limit = torch.where(is_known, sigma.new_full((), _KNOWN_INLIER), _INLIER) * sigma
    thresholds = Thresholds(limit, torch.zeros_like(depth))
    chances = (_DOUBT + (1.0 - _DOUBT) * constant.weights) * _trusted(problem)
    last, weights, pairs = constant.poses[-1], constant.weights, problems_last(problem)
    projection = project(State.of(last), pairs)
    inliers, count = judge(projection, pairs, thresholds).weights > 0, (problem.weights > 0).sum(-1)
    needed = samples_needed(inliers.sum(-1), count, MIN_PAIRS, _FURTHER.confidence)
    doubted = (needed > _FURTHER.min_samples) | are_open(projection, pairs, inliers, sigma)
    rows, rivals = (doubted & (count >= MIN_PAIRS)).nonzero()[:, 0], None
    pose = constant.pose if keep_others else last
    if len(rows):
        given = map_tensors(lambda *x: torch.stack(x, 1), *take(constant.poses, rows))
        some, limits, chances, sigma = take((problem, thresholds, chances, sigma), rows)
        some = some._replace(weights=relative(some.weights, some.weights))
        search = Search(_FURTHER, some, limits, chances, sigma, finds_rivals=True, ranks=True)
        search.run(given)
        state, rivals = search.state, (rows, search.states(search.rivals).pose)
        errors = judge(project(state, problems_last(some)), some, limits).errors
        pose, weights = put((pose, weights), rows, (state.pose, 1.0 / (1.0 + errors)))
    others = constant.others if keep_others else None
    return starts._replace(pose=pose, others=others, weights=weights), rivals
