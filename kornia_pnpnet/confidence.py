"""Confidences from raw scores: probabilities that pairs are inliers, fitted on pairs with known truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK
from kornia.core.exceptions import TypeCheckError, ValueCheckError
from torch import Tensor, nn

from kornia_pnpnet.core.checks import check_devices, check_shapes, common_dtype

__all__ = ["Calibration", "fit_confidence"]

# A bound: the squares of scores stay finite in float32.
_MOST_SCORE = 1e18
# A bound: a logistic law does not go beyond a probability of 1 - 1e-13, so that its table has the digits of the scores.
_MOST_LOGIT = 30.0
# Newton's method on a logistic law: most steps and halvings of a step, the sufficient decrease and the ridge of Lin et
# al. 2007, and the decrease per pair at which it ends, near the resolution of float64.
_MOST_STEPS, _MOST_HALVINGS, _SUFFICIENT, _RIDGE, _LEAST_DECREASE = 100, 30, 1e-4, 1e-12, 1e-14


class Calibration(nn.Module):
    """Map scores to probabilities by a table that :func:`fit_confidence` makes.

    Between the scores of the table the log-odds are linear, so that probabilities rise or fall with the score and have
    a gradient. Scores below the first or above the last score of the table get the probability at that end. The table
    is saved with ``state_dict``; ``load_state_dict`` takes a table of any length.

    Args:
        scores: rising, shape :math:`(K,)`.
        probabilities: probability that a pair with such a score is an inlier, never falling or never rising, in
            (0, 1), shape :math:`(K,)`.

    Without arguments every score has the probability 0.5, until a state is loaded.

    Attributes:
        scores: the scores of the table, a buffer of shape :math:`(K,)`.
        logits: the log-odds at these scores, a buffer of shape :math:`(K,)`.

    Raises:
        ShapeError: when the two do not have the same shape :math:`(K,)`.
        ValueCheckError: when the table is empty, its scores do not rise or are infinite, or its probabilities are
            outside of (0, 1) or both rise and fall.

    Example:
        >>> calibration = Calibration([0.5, 1.0], [0.9, 0.1])  # a ratio of distances: lower is better
        >>> calibration(torch.tensor([0.2, 0.5, 0.75, 1.0, torch.nan]))
        tensor([0.9000, 0.9000, 0.5000, 0.1000,    nan])
    """

    scores: Tensor
    logits: Tensor

    def __init__(
        self, scores: Tensor | Sequence[float] = (0.0,), probabilities: Tensor | Sequence[float] = (0.5,)
    ) -> None:
        super().__init__()
        scores, probabilities = torch.as_tensor(scores), torch.as_tensor(probabilities)
        dtype = common_dtype({"scores": scores, "probabilities": probabilities})
        count = (scores.numel(),)
        check_shapes({"scores": (scores, count), "probabilities": (probabilities, count)})
        check_devices({"probabilities": probabilities}, scores, "scores")
        self.register_buffer("scores", scores.detach().to(dtype, copy=True))
        self.register_buffer("logits", probabilities.detach().to(dtype).logit())
        steps = self.logits.diff()
        if not count[0] or not self.scores.isfinite().all() or not (self.scores.diff() > 0).all():
            raise ValueCheckError("The scores of a calibration must be finite and rise.")
        if not self.logits.isfinite().all() or not ((steps >= 0).all() or (steps <= 0).all()):
            raise ValueCheckError("The probabilities of a calibration must lie in (0, 1) and never fall or never rise.")

    def forward(self, scores: Tensor) -> Tensor:
        """Return the probability that each pair is an inlier.

        Args:
            scores: any shape, floats or integers; NaN where unknown.

        Returns:
            In the open interval (0, 1), by at least the ``eps`` of the dtype away from 0 and 1; NaN, without gradient,
            where the score is NaN. The shape of the scores and their dtype; for integers that of the table.

        Raises:
            TypeCheckError: when the scores are no tensor, or hold booleans or complex numbers.
            DeviceError: when the scores are on another device than the table.
        """
        _check_scores(scores)
        check_devices({"scores": scores}, self.scores, "the calibration")
        dtype = scores.dtype if scores.is_floating_point() else self.scores.dtype
        work = torch.promote_types(torch.promote_types(dtype, self.scores.dtype), torch.float32)
        table, logits = self.scores.to(work), self.logits.to(work)
        unknown = scores.isnan()
        score = torch.where(unknown, table[0], scores.to(work)).clamp(table[0], table[-1])
        right = torch.searchsorted(table, score.detach().contiguous())
        left = (right - 1).clamp(min=0)
        # A table that was cast to half precision may hold a score twice, and a score at the first one has no interval.
        width = table[right] - table[left]
        share = (score - table[left]) / torch.where(width > 0, width, 1.0)
        probability = torch.sigmoid(torch.lerp(logits[left], logits[right], share))
        eps = torch.finfo(dtype).eps
        return torch.where(unknown, torch.nan, probability.clamp(eps, 1.0 - eps)).to(dtype)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Make room for a table of another length."""
        table = [state_dict.get(prefix + name) for name in ("scores", "logits")]
        shapes = {tuple(x.shape) for x in table if isinstance(x, Tensor)}
        if None not in table and len(shapes) == 1 and len(*shapes) == 1:
            self.scores, self.logits = (x.new_empty(*shapes) for x in (self.scores, self.logits))
        super()._load_from_state_dict(state_dict, prefix, *args)


def fit_confidence(
    scores: Tensor, inliers: Tensor, method: str = "isotonic", *, mask: Tensor | None = None
) -> Calibration:
    r"""Fit a map from scores to the probability of being an inlier, on pairs with known truth.

    A score is anything that tells inliers from outliers: a ratio of distances, a matcher's score, a network's output.
    Whether a higher or a lower score is better is found from the pairs. The probabilities go to a solver as
    ``confidence``.

    ``"isotonic"`` assumes only that the probability rises or falls with the score: pool adjacent violators (R. Barlow
    et al., "Statistical Inference under Order Restrictions", 1972; for probabilities B. Zadrozny and C. Elkan,
    "Transforming Classifier Scores into Accurate Multiclass Probability Estimates", 2002). Higher scores are better
    when an inlier has a higher score than an outlier in at least half of all cases. Half an inlier and half an outlier
    are added at the lowest and at the highest score: :math:`k` inliers among the :math:`n` pairs of a block at an end
    give :math:`(k + 1/2) / (n + 1)`, the mean under Jeffreys's prior, so that no finite number of pairs makes a score
    certain. The probability of a block holds at the median of its scores; the log-odds between medians are linear.

    ``"logistic"`` assumes that the log-odds are a linear function of the score, and needs fewer pairs where that is
    true: J. Platt, "Probabilistic Outputs for Support Vector Machines", 1999, with its targets
    :math:`(N_+ + 1) / (N_+ + 2)` for the :math:`N_+` inliers and :math:`1 / (N_- + 2)` for the :math:`N_-` outliers, by
    the Newton method of H.-T. Lin, C.-J. Lin and R. C. Weng, "A Note on Platt's Probabilistic Outputs for Support
    Vector Machines", 2007.

    The fit runs on the CPU in float64, reads the values of the tensors and records no gradient.

    Args:
        scores: any shape, floats or integers; NaN where unknown. Pairs with unknown scores are left out.
        inliers: whether a pair is an inlier, for example whether its reprojection error at a reference pose is below a
            threshold, bool, the shape of ``scores``.
        method: ``"isotonic"``, the better choice from about a thousand pairs on (A. Niculescu-Mizil and R. Caruana,
            "Predicting Good Probabilities with Supervised Learning", 2005), or ``"logistic"``.
        mask: False where a pair is padding, bool, the shape of ``scores``.

    Returns:
        The fitted map, on the device of the scores; its table is in float64 when the scores are, else in float32.

    Raises:
        BaseError: for another method.
        ShapeError: when shapes do not match.
        TypeCheckError: when an argument is no tensor, ``inliers`` or ``mask`` are not bool, or the scores are booleans
            or complex numbers.
        DeviceError: when tensors are on different devices.
        ValueCheckError: when no inlier or no outlier is left to fit on, or a score is larger than 1e18 or infinite.

    Example:
        >>> ratios = torch.tensor([0.3, 0.4, 0.5, 0.6, 0.6, 0.7, 0.8, 0.9, 0.9, 1.0])
        >>> inliers = torch.tensor([1, 1, 1, 1, 0, 1, 0, 0, 0, 0]).bool()
        >>> calibration = fit_confidence(ratios, inliers, "logistic")
        >>> calibration(torch.tensor([0.35, 0.65, 0.95]))
        tensor([0.8885, 0.5367, 0.1441])
    """
    KORNIA_CHECK(method in ("isotonic", "logistic"), f"method must be 'isotonic' or 'logistic', got {method!r}.")
    _check_scores(scores)
    truth = {"inliers": inliers} if mask is None else {"inliers": inliers, "mask": mask}
    for name, value in truth.items():
        if not isinstance(value, Tensor) or value.dtype != torch.bool:
            got = value.dtype if isinstance(value, Tensor) else type(value).__name__
            raise TypeCheckError(f"{name} must be a bool tensor, got {got}.")
    check_shapes({name: (value, tuple(scores.shape)) for name, value in truth.items()})
    check_devices(truth, scores, "scores")
    used = ~scores.isnan() if mask is None else mask & ~scores.isnan()
    values, labels = scores.detach()[used].double().cpu().numpy(), inliers[used].cpu().numpy()
    if not 0 < labels.sum() < labels.size:
        raise ValueCheckError(
            "A calibration needs inliers and outliers with known scores, "
            f"got {labels.sum()} inliers and {labels.size - labels.sum()} outliers."
        )
    if not np.abs(values).max() <= _MOST_SCORE:
        raise ValueCheckError(f"Scores must be at most {_MOST_SCORE:g} in absolute value, or NaN where unknown.")
    different, position, count = np.unique(values, return_inverse=True, return_counts=True)
    right = np.bincount(position[labels], minlength=len(different))
    table, logits = (_isotonic if method == "isotonic" else _logistic)(different, right, count)
    calibration = Calibration().to(scores.device, common_dtype({"scores": scores}))
    # As a state: probabilities near 1 have fewer digits than their log-odds.
    calibration.load_state_dict({"scores": torch.from_numpy(table), "logits": torch.from_numpy(logits)})
    return calibration


def _check_scores(scores: Tensor) -> None:
    if not isinstance(scores, Tensor):
        raise TypeCheckError(f"scores must be a tensor, got {type(scores).__name__}.")
    common_dtype({"scores": scores})


def _isotonic(scores: np.ndarray, right: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pool adjacent violators.

    Args:
        scores: different scores, rising, shape (U,).
        right: number of inliers with each score, shape (U,).
        count: number of pairs with each score, shape (U,).

    Returns:
        The median score and the log-odds of each block, shape (K,).
    """
    wrong = count - right
    wrong_below = wrong.cumsum() - wrong
    # Mann and Whitney's U, twice: pairs of an inlier with an outlier of a lower score; equal scores count half.
    rises = right @ (2 * wrong_below + wrong) >= right.sum() * wrong.sum()
    order = slice(None) if rises else slice(None, None, -1)
    scores, right, count = scores[order], right[order], count[order]

    # Twice the numbers of pairs, so that the halves at the ends are whole numbers, and comparisons are exact.
    twice_right, twice_count = 2 * right, 2 * count
    for end in (0, -1):
        twice_right[end] += 1
        twice_count[end] += 2
    blocks: list[tuple[int, int, int]] = []  # inliers, pairs, and the position of the first score
    for first, (k, n) in enumerate(zip(twice_right.tolist(), twice_count.tolist(), strict=True)):
        while blocks and blocks[-1][0] * n >= k * blocks[-1][1]:
            more_k, more_n, first = blocks.pop()
            k, n = k + more_k, n + more_n
        blocks.append((k, n, first))
    pooled_right, pooled_count, begin = np.array(blocks).T

    until = count.cumsum()  # rank after the last pair with each score
    rank = until[begin] - count[begin]
    size = np.diff(rank, append=until[-1])
    # Of an even number of pairs the median is midway between the two in the middle.
    middle = [scores[np.searchsorted(until, rank + place, side="right")] for place in ((size - 1) // 2, size // 2)]
    logits = np.log(pooled_right) - np.log(pooled_count - pooled_right)
    return np.mean(middle, axis=0)[order].copy(), logits[order].copy()  # torch has no negative strides


def _logistic(scores: np.ndarray, right: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Platt scaling. Arguments as for :func:`_isotonic`; the log-odds at the lowest and the highest score."""
    centre = np.average(scores, weights=count)
    spread = np.sqrt(np.average((scores - centre) ** 2, weights=count)) or 1.0
    design = np.stack(((scores - centre) / spread, np.ones_like(scores)))  # (2, U)
    inliers, outliers = right.sum(), (count - right).sum()
    target = right * (inliers + 1) / (inliers + 2) + (count - right) / (outliers + 2)

    def cost(law: np.ndarray) -> float:
        logits = law @ design
        return float(count @ np.logaddexp(0.0, logits) - target @ logits)

    law = np.array([0.0, np.log((inliers + 1) / (outliers + 1))])  # slope and offset
    for _ in range(_MOST_STEPS):
        probability = 0.5 + 0.5 * np.tanh(0.5 * (law @ design))
        gradient = design @ (count * probability - target)
        hessian = (design * (count * probability * (1.0 - probability))) @ design.T
        step = -np.linalg.solve(hessian + _RIDGE * np.eye(2), gradient)
        descent = gradient @ step
        if -descent <= _LEAST_DECREASE * count.sum():
            break
        before, length = cost(law), 1.0
        for _ in range(_MOST_HALVINGS):
            if cost(law + length * step) <= before + _SUFFICIENT * length * descent:
                break
            length *= 0.5
        law = law + length * step

    if len(scores) == 1 or law[0] == 0.0:
        return scores[:1], law[1:]
    ends = design[:, [0, -1]]
    logits = law @ ends
    capped = logits.clip(-_MOST_LOGIT, _MOST_LOGIT)
    return centre + spread * (ends[0] + (capped - logits) / law[0]), capped
