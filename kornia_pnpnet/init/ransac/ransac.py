r"""RANSAC: the pose that most pairs agree on, from many small samples of them, for whole batches at once."""

from __future__ import annotations

import math
from typing import Any

import torch
from kornia.core.check import KORNIA_CHECK
from kornia.core.exceptions import ShapeError
from torch import Tensor, nn

from kornia_pnpnet.core.linalg import relative
from kornia_pnpnet.core.performance import problems_last
from kornia_pnpnet.geometry import project
from kornia_pnpnet.init.ransac.sampling import MIN_PAIRS, log_false_alarms
from kornia_pnpnet.init.ransac.scoring import SCORERS, Judged, Scorer, Thresholds, chance_of_inlier, judge
from kornia_pnpnet.init.ransac.search import (
    DAMPING,
    PAIRS_PER_SAMPLE,
    Found,
    MinimalSolver,
    Plan,
    Search,
    full_vectors,
    take,
)
from kornia_pnpnet.refine import RobustWeightedLM, lm_step
from kornia_pnpnet.types import Correspondences, Guess, Hypotheses, Pose

__all__ = ["RANSAC", "SubsetSolver"]

# Steps of least squares from the best pose: it is near the minimum already.
FINAL_STEPS = 2
# A pose is chance when so many with as many inliers are expected from pairs without a pose.
_MAX_FALSE_ALARMS = 1e-2


class SubsetSolver(nn.Module):
    r"""A solver of samples made of an initialiser: the paper's "EPnP-LM on subsets of 7", for example.

    Args:
        init: maps :class:`~kornia_pnpnet.types.Correspondences` to a :class:`~kornia_pnpnet.types.Guess`.
        refine: improves the guess; the guess itself when ``None``.
        size: number of pairs in a sample.

    Raises:
        BaseError: when ``size`` is less than 3.

    Example:
        >>> from kornia_pnpnet.init.mlp import MLPInit
        >>> solver = SubsetSolver(MLPInit(n=7), RobustWeightedLM(m=5, learnable=False), size=7)
        >>> corr = Correspondences(torch.randn(2, 7, 3), torch.randn(2, 7, 2), torch.ones(2, 7), torch.tensor(3400.0))
        >>> solver.hypotheses(corr).pose.rotation.shape
        torch.Size([2, 1, 3, 3])
    """

    def __init__(self, init: nn.Module, refine: RobustWeightedLM | None = None, *, size: int) -> None:
        super().__init__()
        KORNIA_CHECK(type(size) is int and size >= 3, f"size must be an integer of at least 3, got {size!r}.")
        self.init = init
        self.refine = refine
        self.sample_size = size
        self.config = {"init": _named(init), "refine": None if refine is None else refine.config, "size": size}

    def hypotheses(self, corr: Correspondences) -> Hypotheses:
        r"""Solve samples.

        Args:
            corr: normalised correspondences of samples, :math:`N` is ``size``.

        Returns:
            One pose for each sample, valid where the initialiser has a guess and the pose is finite.
        """
        guess = self.init(corr)
        pose = guess.pose if self.refine is None else self.refine(corr, guess).pose
        valid = pose.rotation.isfinite().flatten(1).all(-1) & pose.translation.isfinite().all(-1)
        eye = torch.eye(3, dtype=pose.rotation.dtype, device=pose.rotation.device)
        rotation = torch.where(valid[:, None, None], pose.rotation, eye)
        translation = torch.where(valid[:, None], pose.translation, 0.0)
        valid = valid if guess.ok is None else valid & guess.ok
        return Hypotheses(Pose(rotation[:, None], translation[:, None]), valid[:, None])


class RANSAC(nn.Module):
    r"""The pose with the best score among those of many samples, improved on its inliers.

    Samples of all problems are solved as one batch, in rounds. After each round the best pose of a problem is improved
    by least squares on its inliers (LO-RANSAC), and the problem is done when a sample without an outlier has been seen
    with the ``confidence``. When there are at most ``max_samples`` subsets each is tried once instead. Problems only
    share the random numbers, which are the same in every call: a problem has the same result alone, in any batch and
    at any place in it, up to a last bit that torch's kernels for a single problem may round otherwise.

    A pair is an inlier when :math:`\|r\|^2 < \tau^2 + (f \omega / z)^2`, with the ``threshold`` :math:`\tau` for
    errors of the pixels and the ``world_threshold`` :math:`\omega` for errors of the points, which move the pixel by
    :math:`f/z` times as much. Least squares weigh an inlier by the inverse of the right hand side.

    The guess is ``ok`` when so many inliers among pairs without any pose behind them would be a rare chance (see
    :func:`~kornia_pnpnet.refine.verdict.log_false_alarms`; fewer than 0.01 such poses are expected). Of three pairs
    alone that cannot be told: they are ``ok`` when there is a pose.

    Gradients: which pairs are inliers, and the weights that their depths give them, are selected without a gradient.
    The last refinement, unrolled least squares on them from a constant start near its minimum, has one to points,
    pixels and weights.

    Source: M. Fischler and R. Bolles, Communications of the ACM 24(6), 1981; O. Chum, J. Matas and J. Kittler,
    "Locally optimized RANSAC", DAGM 2003; P. Torr and A. Zisserman, CVIU 78(1), 2000 (MSAC); scoring few pairs first as
    in D. Nistér, "Preemptive RANSAC for live structure and motion estimation", ICCV 2003.

    Args:
        minimal: solver of samples, such as :class:`~kornia_pnpnet.init.ransac.p3p.P3P` or a :class:`SubsetSolver`.
        threshold: :math:`\tau` in pixels of the camera that is given.
        world_threshold: :math:`\omega` in the unit of the world that is given.
        scorer: ``"msac"``, the truncated squares; ``"inliers"``, their number; or any function from the squared
            residuals divided by the squared threshold, of any shape, to losses of the pairs. The loss of a pose is the
            sum, weighted by the weights of the pairs.
        max_samples: the largest number of samples for each problem.
        min_samples: the smallest. Noise makes the poses of many a good sample bad: the first one need not do.
        confidence: probability to have seen a sample without an outlier, in (0, 1).
        local_candidates: the best so many poses of a round are improved.
        local_iterations: how often a pose is improved on the inliers that it then has; the first time on those within
            three times the thresholds.
        seed: of the random numbers.
        chunk_size: samples that are solved and scored together. It bounds the memory, and a cache should hold it.

    Raises:
        BaseError: for an unknown scorer or an argument out of range.

    Example:
        >>> from kornia_pnpnet import PnPNet
        >>> from kornia_pnpnet.data import OutlierMix, SyntheticProblems
        >>> from kornia_pnpnet.init.ransac.p3p import P3P
        >>> problems = SyntheticProblems(n=9, batch_size=4, seed=0, outliers=OutlierMix(count=2)).batch(0)
        >>> ransac = RANSAC(P3P(), threshold=6.0, world_threshold=0.3)
        >>> solver = PnPNet(ransac, RobustWeightedLM(m=0, robustness=0))
        >>> result = solver(problems.world_points, problems.img_points, problems.intrinsics)
        >>> torch.equal(result.weights > 0, problems.inliers), result.ok.tolist()
        (True, [True, True, True, True])
    """

    def __init__(
        self,
        minimal: MinimalSolver,
        *,
        threshold: float = 4.0,
        world_threshold: float = 0.0,
        scorer: str | Scorer = "msac",
        max_samples: int = 1000,
        min_samples: int = 32,
        confidence: float = 0.999,
        local_candidates: int = 3,
        local_iterations: int = 2,
        seed: int = 0,
        chunk_size: int = 4096,
    ) -> None:
        super().__init__()
        numbers = {
            "max_samples": max_samples,
            "min_samples": min_samples,
            "local_candidates": local_candidates,
            "local_iterations": local_iterations,
            "chunk_size": chunk_size,
        }
        for name, value in numbers.items():
            KORNIA_CHECK(type(value) is int and value >= 1, f"{name} must be an integer of at least 1, got {value!r}.")
        KORNIA_CHECK(0 < threshold < math.inf, f"threshold must be positive and finite, got {threshold}.")
        KORNIA_CHECK(0 <= world_threshold < math.inf, f"world_threshold must be at least 0, got {world_threshold}.")
        KORNIA_CHECK(0 < confidence < 1, f"confidence must lie in (0, 1), got {confidence}.")
        KORNIA_CHECK(type(seed) is int and 0 <= seed < 2**63, f"seed must be an integer of at least 0, got {seed!r}.")
        KORNIA_CHECK(callable(scorer) or scorer in SCORERS, f"scorer must be one of {sorted(SCORERS)}, got {scorer!r}.")
        self.config: dict[str, Any] = {
            "minimal": _named(minimal),
            "threshold": threshold,
            "world_threshold": world_threshold,
            "scorer": scorer if isinstance(scorer, str) else getattr(scorer, "__name__", type(scorer).__name__),
            **numbers,
            "confidence": confidence,
            "seed": seed,
        }
        self.minimal = minimal
        self.threshold = threshold
        self.world_threshold = world_threshold
        self.chunk_size = chunk_size
        self.plan = Plan(
            minimal=minimal,
            scorer=scorer if callable(scorer) else SCORERS[scorer],
            confidence=confidence,
            seed=seed,
            **numbers,
        )

    def extra_repr(self) -> str:
        """Show the constructor's arguments."""
        return ", ".join(f"{key}={value!r}" for key, value in self.config.items() if key != "minimal")

    def forward(self, corr: Correspondences) -> Guess:
        r"""Find the poses.

        Args:
            corr: normalised correspondences.

        Returns:
            The poses; as weights the inliers at them, times :math:`\tau^2 / (\tau^2 + (f \omega / z)^2)`; and ``ok``.

        Raises:
            ShapeError: when there are fewer pairs than in a sample.
        """
        size = self.minimal.sample_size
        if corr.weights.shape[1] < size:
            raise ShapeError(
                f"Samples of {size} pairs need at least as many, got N = {corr.weights.shape[1]}.",
                actual_shape=tuple(corr.world_points.shape),
                expected_shape=["B", f"{size} or more", "3"],
            )
        # Pair by pair in memory: a sum over pairs then rounds alike wherever a problem stands in the batch.
        corr = corr._replace(**{name: getattr(corr, name).contiguous() for name in ("world_points", "img_points")})
        weights = corr.weights.contiguous()
        with torch.no_grad():
            share = (weights > 0).to(weights)
            share = share / share.sum(-1, keepdim=True).clamp(min=1.0)
            centre = (share[..., None] * corr.world_points).sum(1)  # (B, 3), a constant
        # Any unit of the weights is allowed: from here on they are relative to the largest.
        weights = relative(weights, weights)
        corr = corr._replace(world_points=corr.world_points - centre[:, None], weights=weights)
        with torch.no_grad():
            thresholds = self._thresholds(corr)
            found = Search(self.plan, corr, thresholds).run()
        pose, judged = self._refine(corr, found.pose, thresholds)
        with torch.no_grad():
            ok = self._is_no_chance(found, corr, thresholds, judged)
        offset = (pose.rotation @ centre[..., None])[..., 0]
        return Guess(Pose(pose.rotation, pose.translation - offset), judged.weights, ok)

    def _thresholds(self, corr: Correspondences) -> Thresholds:
        """The thresholds in units of the correspondences, (B,) each."""
        one = torch.ones_like(corr.weights[:, 0])
        img, world = (one if scale is None else scale for scale in (corr.img_scale, corr.world_scale))
        return Thresholds(self.threshold * img, self.world_threshold * world)

    def _refine(self, corr: Correspondences, start: Pose, thresholds: Thresholds) -> tuple[Pose, Judged]:
        """Least squares on the inliers of some poses, in chunks whose tensors a cache holds, and the inliers then."""
        one, damping = corr.weights.new_tensor((1.0, DAMPING))
        size = max(1, PAIRS_PER_SAMPLE * self.chunk_size // corr.weights.shape[1])
        results = []
        for first in range(0, max(1, len(corr.weights)), size):
            last = min(first + size, len(corr.weights))
            at = full_vectors(torch.arange(first, last, device=corr.weights.device))
            part, limits = problems_last(take(corr, at)), Thresholds(*(x[at] for x in thresholds))
            pose = Pose(*(x[at] for x in start))
            projection = project(pose, part)
            with torch.no_grad():
                inliers = judge(projection, part, limits).weights
            for _ in range(FINAL_STEPS):
                pose = lm_step(part, pose, projection, part.weights * inliers, one, damping).pose
                projection = project(pose, part)
            with torch.no_grad():
                judged = judge(projection, part, limits)
            results.append([x[: last - first] for x in (*pose, *judged)])
        rotation, translation, weights, errors = (torch.cat(parts) for parts in zip(*results, strict=True))
        return Pose(rotation.contiguous(), translation.contiguous()), Judged(weights, errors)

    def _is_no_chance(self, found: Found, corr: Correspondences, thresholds: Thresholds, judged: Judged) -> Tensor:
        """Whether pairs without a pose would hardly have as many inliers, as close; (B,)."""
        inliers, counts = (judged.weights > 0).sum(-1), (corr.weights > 0).sum(-1)
        chance = chance_of_inlier(corr, thresholds, judged)
        # Each number of inliers is another chance as well.
        tests = found.poses * (counts - MIN_PAIRS).clamp(min=1)
        rare = log_false_alarms(tests, inliers, counts, chance) < math.log(_MAX_FALSE_ALARMS)
        return found.loss.isfinite() & (rare | ((inliers == MIN_PAIRS) & (counts == MIN_PAIRS)))


def _named(part: object) -> dict[str, Any]:
    """The name of a part's class and the arguments of its constructor."""
    return {"name": type(part).__name__, **getattr(part, "config", {})}
