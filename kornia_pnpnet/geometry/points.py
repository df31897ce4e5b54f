r"""Sets of points: how they are aligned, and whether they span a plane."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_pnpnet.core.linalg import nearest_rotation
from kornia_pnpnet.types import Pose

__all__ = ["align", "span_a_plane"]


def align(source: Tensor, target: Tensor, weights: Tensor) -> tuple[Pose, Tensor]:
    r"""Find the rigid motion and the scale that move points onto other points, by weighted least squares.

    Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.

    Args:
        source: points :math:`x`, shape :math:`(B, K, 3)`.
        target: points :math:`y`, shape :math:`(B, K, 3)`.
        weights: at least 0, shape :math:`(B, K)`.

    Returns:
        The motion :math:`(R, t)` and the scale :math:`s`, shape :math:`(B,)`. The best rigid motion is
        :math:`R x + t`, the best similarity :math:`s R (x - \bar x) + \bar y`, where the bars are weighted means.

    Example:
        >>> points = torch.tensor([[[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 2]]])
        >>> pose, scale = align(points, 3.0 * points + 1.0, torch.ones(1, 4))
        >>> pose.translation, scale
        (tensor([[2., 2., 2.]]), tensor([3.]))
    """
    total = weights.sum(-1, keepdim=True)
    share = (weights / torch.where(total > 0, total, 1.0))[..., None]
    source_mean, target_mean = (share * source).sum(1), (share * target).sum(1)
    centred = source - source_mean[:, None]
    covariance = (target - target_mean[:, None]).mT @ (share * centred)  # (B, 3, 3)
    rotation = nearest_rotation(covariance.permute(1, 2, 0))[0].permute(2, 0, 1).contiguous()
    mean_square = (share * centred.square()).sum((1, 2))
    scale = (rotation * covariance).sum((1, 2)) / torch.where(mean_square > 0, mean_square, 1.0)
    translation = target_mean - (rotation @ source_mean[..., None])[..., 0]
    return Pose(rotation, translation), scale


def span_a_plane(centred: Tensor, share: Tensor, size: Tensor) -> Tensor:
    """Whether points span more than a line, so that there are at least three.

    Args:
        centred: the points minus their mean, 0 for padding, (3, N, B).
        share: one over the number of points, (B,).
        size: the largest coordinate before the points were centred, (B,). Where it is 0 or NaN the result is false.

    Returns:
        bool of shape (B,).
    """
    # The second largest variance is about the sum of the principal minors of the covariance, (trace² - sum of squares)
    # / 2, over the trace. For points on a line only rounding remains.
    eps = torch.finfo(centred.dtype).eps
    covariance = (centred[:, None] * centred).sum(2) * (share / (size * size))  # (3, 3, B) in the unit of the size
    trace = covariance.diagonal().sum(-1)
    return ((1.0 - 16.0 * eps) * trace - 2.0 * (64.0 * eps) ** 2) * trace > covariance.square().sum((0, 1))
