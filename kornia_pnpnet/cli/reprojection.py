"""How well a pose explains the correspondences of one image: reprojection errors and rejected correspondences."""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.geometry.conversions import convert_points_from_homogeneous
from kornia.geometry.linalg import transform_points
from torch import Tensor

from kornia_pnpnet.result import Pose

__all__ = ["Reprojection", "reproject"]

# Median absolute deviation to standard deviation of a normal distribution.
_MAD_TO_SIGMA = 1.4826
# Lowest limit in pixels: about three standard deviations of a corner detector's noise.
_MIN_LIMIT_PX = 3.0


class Reprojection(NamedTuple):
    """The correspondences of one image under a pose.

    Attributes:
        pixels: projections of the world points, (N, 2); NaN where a point is not in front of the camera.
        errors_px: reprojection errors, (N,); NaN where ``pixels`` is NaN.
        limit_px: largest error of a correspondence that is not rejected.
        rejected: whether the error is NaN or above the limit, (N,), bool.
    """

    pixels: Tensor
    errors_px: Tensor
    limit_px: float
    rejected: Tensor


def reproject(
    world_points: Tensor, img_points: Tensor, intrinsics: Tensor, pose: Pose, limit_px: float | None = None
) -> Reprojection:
    """Compare the pixels (N, 2) of one image with the projections of its world points (N, 3) by a pose (1, ...).

    Without ``limit_px`` the limit is a robust estimate of three standard deviations of the inliers, at least 3 px.
    """
    cam_points = transform_points(pose.matrix, world_points[None])[0]
    in_front = cam_points[:, 2:] > 0
    pixels = convert_points_from_homogeneous(torch.where(in_front, cam_points, 1.0) @ intrinsics.mT, eps=0.0)
    pixels = torch.where(in_front, pixels, torch.nan)
    errors = (pixels - img_points).norm(dim=-1)
    if limit_px is None:
        finite = errors[errors.isfinite()].double()
        sigma = _MAD_TO_SIGMA * finite.quantile(0.5).item() if len(finite) else 0.0
        limit_px = max(_MIN_LIMIT_PX, 3.0 * sigma)
    return Reprojection(pixels, errors, limit_px, ~(errors <= limit_px))
