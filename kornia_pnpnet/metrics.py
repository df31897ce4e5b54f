"""How far a pose is from the truth, in the units people report: degrees and the unit of the world."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.geometry import rotation_angle
from kornia_pnpnet.types import Pose

__all__ = ["PoseErrors", "SuccessRate", "pose_errors", "success", "success_rate"]


class PoseErrors(NamedTuple):
    r"""Errors of a batch of poses.

    Attributes:
        rotation_error_deg: angle between the estimated and the true rotation in degrees, shape :math:`(B,)`.
        translation_error: distance of the translations in the unit of the world, shape :math:`(B,)`.
    """

    rotation_error_deg: Tensor
    translation_error: Tensor


class SuccessRate(NamedTuple):
    """A share of successes with its binomial 95 % (Wilson) interval, all between 0 and 1."""

    rate: float
    low: float
    high: float
    total: int

    def __str__(self) -> str:
        return f"{100 * self.rate:.1f} % [{100 * self.low:.1f}, {100 * self.high:.1f}]"


def pose_errors(estimate: Pose, truth: Pose) -> PoseErrors:
    r"""Compute rotation and translation errors.

    Args:
        estimate: estimated pose, rotation :math:`(B, 3, 3)` and translation :math:`(B, 3)`.
        truth: true pose of the same shapes.

    Returns:
        The angle of :math:`\hat R R^\top` in degrees and :math:`\|\hat t - t\|`, each of shape :math:`(B,)`.

    Example:
        >>> truth = Pose(torch.eye(3)[None], torch.zeros(1, 3))
        >>> estimate = Pose(torch.eye(3)[None], torch.tensor([[3.0, 0.0, 4.0]]))
        >>> pose_errors(estimate, truth).translation_error
        tensor([5.])
    """
    angle = rotation_angle(estimate.rotation, truth.rotation)
    return PoseErrors(angle * (180.0 / math.pi), (estimate.translation - truth.translation).norm(dim=-1))


def success(errors: PoseErrors, max_rotation_deg: float = 1.0, max_translation: float | Tensor = 0.2) -> Tensor:
    r"""Tell which poses are right: both errors below their limits.

    Args:
        errors: the errors, each of shape :math:`(B,)`.
        max_rotation_deg: limit of the rotation error in degrees.
        max_translation: limit of the translation error in the unit of the world, a number or :math:`(B,)`.

    Returns:
        bool of shape :math:`(B,)`.
    """
    return (errors.rotation_error_deg < max_rotation_deg) & (errors.translation_error < max_translation)


def success_rate(successes: Tensor) -> SuccessRate:
    r"""Share of successes with its 95 % interval.

    Args:
        successes: bool of any shape with at least one element.

    Returns:
        The rate and the bounds of the Wilson score interval (E. B. Wilson, 1927), which, unlike the normal
        approximation, stays inside [0, 1] and does not collapse at 0 or 1.

    Raises:
        ValueError: when ``successes`` is empty.

    Example:
        >>> print(success_rate(torch.tensor([True] * 8 + [False] * 2)))
        80.0 % [49.0, 94.3]
    """
    count = successes.numel()
    if count == 0:
        raise ValueError("success_rate needs at least one problem, got none.")
    rate = successes.to(torch.float64).mean().item()
    z = 1.959963984540054  # the 97.5 % point of the normal distribution
    centre = (rate + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(rate * (1 - rate) / count + z * z / (4 * count * count))
    # The bounds hold the rate; at 0 and 1 rounding could put them past it.
    return SuccessRate(rate, max(0.0, min(rate, centre - half)), min(1.0, max(rate, centre + half)), count)
