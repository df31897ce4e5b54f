"""Evaluation metrics: success rates, calibration, and pose errors in degrees and in the unit of the world."""

from __future__ import annotations

import math
from numbers import Real
from typing import NamedTuple

import torch
from kornia.core.exceptions import TypeCheckError, ValueCheckError
from torch import Tensor

from kornia_pnpnet.core.checks import check_devices, check_shapes, check_tensors, check_whole, common_dtype
from kornia_pnpnet.core.linalg import lengths
from kornia_pnpnet.core.performance import full_precision
from kornia_pnpnet.refine.residual import rotation_angle
from kornia_pnpnet.result import Pose, check_poses

__all__ = ["PoseErrors", "Reliability", "SuccessRate", "pose_errors", "reliability", "success", "success_rate"]

# The 97.5 % quantile of the standard normal distribution, for a two-sided 95 % interval.
_Z_95 = 1.959963984540054


class PoseErrors(NamedTuple):
    """Errors of a batch of poses."""

    rotation_error_deg: Tensor  #: Angle of :math:`\hat R R^\top` in degrees, shape :math:`(B,)`.
    translation_error: Tensor  #: :math:`\|\hat t - t\|` in the unit of the world, shape :math:`(B,)`.


class SuccessRate(NamedTuple):
    """A success rate with its 95 % Wilson interval."""

    rate: float  #: Share of successes, between 0 and 1.
    low: float  #: Lower bound of the interval.
    high: float  #: Upper bound of the interval.
    total: int  #: Number of trials.

    def __str__(self) -> str:
        return f"{100 * self.rate:.1f} % [{100 * self.low:.1f}, {100 * self.high:.1f}]"


class Reliability(NamedTuple):
    r"""Predicted probabilities and observed frequencies in :math:`K` equally wide bins of probability."""

    number: Tensor  #: Number of predictions in each bin, shape :math:`(K,)`.
    predicted: Tensor  #: Mean predicted probability, NaN for an empty bin, shape :math:`(K,)`.
    observed: Tensor  #: Share of true outcomes, NaN for an empty bin, shape :math:`(K,)`.

    @property
    def expected_error(self) -> float:
        """The expected calibration error: mean of ``|predicted - observed|`` over the bins, weighted by ``number``."""
        gap = (self.predicted - self.observed).abs().nan_to_num(0.0)
        return float((self.number * gap).sum() / self.number.sum())


def reliability(chances: Tensor, outcomes: Tensor, ranges: int = 10) -> Reliability:
    r"""Compare predicted probabilities with outcomes, for a reliability diagram.

    Source: C. Guo et al., "On calibration of modern neural networks", ICML 2017, here for binary outcomes.

    Args:
        chances: predicted probabilities between 0 and 1, any shape with at least one element.
        outcomes: whether each predicted event happened, bool, same shape.
        ranges: number of bins, :math:`K`.

    Raises:
        ValueCheckError: when the shapes differ, the tensors are empty, a chance is not between 0 and 1, or ``outcomes``
            is not bool.
        BaseError: when ``ranges`` is not an integer of at least 1, or the tensors are on different devices.

    Example:
        >>> found = reliability(torch.tensor([0.9, 0.9, 0.9, 0.1]), torch.tensor([True, True, False, False]), ranges=2)
        >>> found.number.tolist(), f"{found.expected_error:.3f}"
        ([1.0, 3.0], '0.200')
    """
    check_tensors({"chances": chances, "outcomes": outcomes})
    if chances.shape != outcomes.shape or chances.numel() == 0:
        shapes = f"{tuple(chances.shape)} and {tuple(outcomes.shape)}"
        raise ValueCheckError(f"chances and outcomes must have the same shape and at least one element, got {shapes}.")
    check_whole(1, ranges=ranges)
    check_devices({"outcomes": outcomes}, chances, "chances")
    if outcomes.dtype != torch.bool or not bool(((chances >= 0) & (chances <= 1)).all()):
        raise ValueCheckError("chances must be between 0 and 1, and outcomes must be bool.")
    chance, outcome = (x.detach().flatten().to(torch.float64) for x in (chances, outcomes))
    bins = (chance * ranges).long().clamp(0, ranges - 1)
    number, predicted, observed = (
        chance.new_zeros(ranges).index_add(0, bins, x) for x in (torch.ones_like(chance), chance, outcome)
    )
    return Reliability(number, predicted / number, observed / number)


@full_precision
def pose_errors(estimate: Pose, truth: Pose) -> PoseErrors:
    r"""Compute pose errors. Rotations have the shape :math:`(B, 3, 3)`, and translations :math:`(B, 3)`.

    Raises:
        BaseError: when shapes are not as documented, or shapes, dtypes or devices of the poses differ.

    Example:
        >>> truth = Pose(torch.eye(3)[None], torch.zeros(1, 3))
        >>> estimate = Pose(torch.eye(3)[None], torch.tensor([[3.0, 0.0, 4.0]]))
        >>> pose_errors(estimate, truth).translation_error
        tensor([5.])
    """
    check_poses(estimate, truth)
    angle = rotation_angle(estimate.rotation, truth.rotation)
    return PoseErrors(angle * (180.0 / math.pi), lengths(estimate.translation - truth.translation))


def success(errors: PoseErrors, max_rotation_deg: float = 1.0, max_translation: float | Tensor = 0.2) -> Tensor:
    r"""Tell whether both errors of each pose are below their limits, bool :math:`(B,)`. NaN is not below a limit.

    Args:
        errors: the errors of :math:`B` poses.
        max_rotation_deg: limit of the rotation error in degrees.
        max_translation: limit of the translation error in the unit of the world, a number or :math:`(B,)`.

    Raises:
        BaseError: when tensors are on different devices, or when a shape is not as documented.

    Example:
        >>> success(PoseErrors(torch.tensor([0.5, 0.5, 2.0]), torch.tensor([0.1, 0.3, 0.1])))
        tensor([ True, False, False])
    """
    check_tensors(errors._asdict())
    limits = {"max_rotation_deg": max_rotation_deg, "max_translation": max_translation}
    for name, value in limits.items():
        if not isinstance(value, (Real, Tensor)):  # also NumPy's numbers
            raise TypeCheckError(f"{name} must be a number, got {type(value).__name__}.")
    rotation, translation = errors
    tensors = {"rotation_error_deg": rotation}
    tensors |= {name: x for name, x in limits.items() if isinstance(x, Tensor) and x.ndim}
    check_shapes({name: (x, tuple(translation.shape)) for name, x in tensors.items()})
    common_dtype({**tensors, "translation_error": translation})
    check_devices(tensors, translation, "translation_error")
    return (rotation < max_rotation_deg) & (translation < max_translation)


def success_rate(successes: Tensor) -> SuccessRate:
    r"""Success rate with its 95 % Wilson score interval (E. B. Wilson, 1927).

    Args:
        successes: bool, any shape with at least one element. Other tensors raise ``ValueError``.

    Example:
        >>> print(success_rate(torch.tensor([True] * 8 + [False] * 2)))
        80.0 % [49.0, 94.3]
    """
    check_tensors({"successes": successes})
    count = successes.numel()
    if count == 0 or successes.dtype != torch.bool or successes.is_meta:
        kind = f"{count} elements of {successes.dtype} on {successes.device}"
        raise ValueError(f"successes must be a bool tensor with at least one element and with values, got {kind}.")
    rate = successes.to(torch.float64).mean().item()
    z = _Z_95
    centre = (rate + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(rate * (1 - rate) / count + z * z / (4 * count * count))
    # The interval must contain the rate. At rates of 0 and 1, rounding could exclude the rate.
    return SuccessRate(rate, max(0.0, min(rate, centre - half)), min(1.0, max(rate, centre + half)), count)
