"""The noise that a refinement starts from, and noise that is much larger than that."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.types import LEAST_NOISE, Correspondences, Guess, Noise, Pose

__all__ = ["complete_noise", "is_unknown", "larger_sigma"]

# Standard deviations that the residuals show, relative to the estimate. Nearer ones are within the reach of the
# iterations by residual; from here on these start too far from the minimum.
_LARGER = 4.0
# A weight of this share of that before the residual was looked at is an inlier's.
_INLIER = 0.25
# Share of the pairs. With fewer inliers the median residual may be that of near misses.
_MOST_ARE = 0.5
# Inliers. The residuals of fewer say little of a pose that was fitted to them: solved again with the noise that they
# show, problems of 6 to 9 pairs are right as often as before (seeds 3117 and 3120 of SyntheticProblems).
_FEWEST = 7
# The poses of the fit are closer to the pixels than the true pose is.
_FITTED = 1.1
# With confidences, sigmas fall with this power of them: on keypoints of networks it lies near 1, and more is better
# where low confidences are outliers. The least confidence counts as this much.
_POWER, _LEAST_CONFIDENCE = 1.5, 0.05
# Median of the length of a residual of unit variance in both coordinates.
_MEDIAN = math.sqrt(2.0 * math.log(2.0))


@torch.no_grad()
def larger_sigma(
    world_points: Tensor,
    img_points: Tensor,
    intrinsics: Tensor,
    pose: Pose,
    inlier_weights: Tensor,
    noise: Noise,
    confidence: Tensor | None = None,
) -> Tensor:
    """Standard deviation of the pixels that the inliers show, where it is much larger than estimated, else 0.

    Where confidences are given, those of a problem differ between its pairs, around the same mean.

    Args:
        world_points: shape :math:`(B, N, 3)`.
        img_points: pixels, shape :math:`(B, N, 2)`.
        intrinsics: camera matrices, shape :math:`(B, 3, 3)`.
        pose: poses of the problems.
        inlier_weights: final weight of each pair relative to that before its residual was looked at, :math:`(B, N)`.
        noise: the estimated noise in the units of the points, shape :math:`(B, N)` each.
        confidence: the caller's belief in each pair, in [0, 1], shape :math:`(B, N)`; NaN where unknown.

    Returns:
        In pixels, shape :math:`(B, N)`.

    Example:
        >>> points = torch.tensor([[[0.0, 0.0, 4.0], [1.0, 0.0, 4.0], [0.0, 1.0, 4.0]]]).repeat(1, 3, 1)
        >>> camera = torch.tensor([[[100.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 1.0]]])
        >>> pixels = torch.tensor([[[10.0, 0.0], [35.0, 0.0], [10.0, 25.0]]]).repeat(1, 3, 1)
        >>> pose, noise = Pose(torch.eye(3)[None], torch.zeros(1, 3)), Noise(torch.ones(1, 9), torch.zeros(1, 9))
        >>> larger_sigma(points, pixels, camera, pose, torch.ones(1, 9), noise)[0, :3].round(decimals=1)
        tensor([9.3000, 9.3000, 9.3000])
    """
    seen = (world_points @ pose.rotation.mT + pose.translation[:, None]) @ intrinsics.mT
    away = seen[..., 2:].clamp(min=torch.finfo(seen.dtype).eps)
    residual = (seen[..., :2] / away - img_points).norm(dim=-1)
    focal = 0.5 * (intrinsics[:, :1, 0] + intrinsics[:, 1:2, 1]) / intrinsics[:, 2:, 2]
    estimate = torch.hypot(noise.img, focal * noise.world / away[..., 0])
    inlier = inlier_weights > _INLIER

    def median(values: Tensor) -> Tensor:
        return torch.where(inlier, values, torch.nan).nanmedian(1).values

    sigma = _FITTED / _MEDIAN * median(residual)
    many = inlier.sum(1) >= (_MOST_ARE * (inlier_weights > 0).sum(1)).clamp(min=_FEWEST)
    sigma = torch.where(many & (sigma > _LARGER * median(estimate)), sigma, 0.0).nan_to_num(0.0, posinf=0.0)[:, None]
    if confidence is None:
        return sigma.expand_as(residual)
    doubt = -confidence.nan_to_num(0.5).clamp(min=_LEAST_CONFIDENCE).log()
    mean = (inlier * doubt).sum(1, keepdim=True) / inlier.sum(1, keepdim=True).clamp(min=1)
    return sigma * (_POWER * (doubt - mean)).exp()


def complete_noise(corr: Correspondences, guess: Guess) -> Noise | None:
    """The caller's covariances, the guess's sigmas or else the caller's with 0 where unknown; ``None``: neither."""
    noise = guess.noise
    if noise is None and corr.noise is not None:
        noise = map_tensors(lambda x: x.nan_to_num(0.0), corr.noise)
    if noise is None:
        return None
    given = noise if corr.noise is None else corr.noise  # a guess has no covariances
    least = noise.img.maximum(LEAST_NOISE * corr.focal)
    return noise._replace(img=least, img_cov=given.img_cov, world_cov=given.world_cov)


def is_unknown(corr: Correspondences) -> Tensor:
    """Problems of which the caller gave neither sigma for any pair, bool (B, 1)."""
    known = torch.zeros_like(corr.weights[:, :1], dtype=torch.bool)
    for sigma in () if corr.noise is None else (corr.noise.img, corr.noise.world):
        known = known | sigma.isfinite().any(1, keepdim=True)
    return ~known
