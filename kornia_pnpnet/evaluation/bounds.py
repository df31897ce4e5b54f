"""Bounds: the accuracy that a solver could reach if it knew the inliers, or the inliers and the noise."""

from __future__ import annotations

from typing import Any

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, expand_sigma
from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.problem import LEAST_NOISE
from kornia_pnpnet.refine.lm import RobustWeightedLM
from kornia_pnpnet.result import PnPResult, Problems
from kornia_pnpnet.solver import PnPNet

__all__ = ["KnownInliers", "KnownInliersAndNoise"]

# From the true pose, 3 iterations reach the minimum of the cost to 7 digits. 10 iterations reach float64's precision.
_ITERATIONS = 10


def _least_squares(problems: Problems, weights: Tensor, **noise: Any) -> PnPResult:
    """Minimise the weighted squared reprojection errors, starting from the true pose."""
    solver = PnPNet(None, RobustWeightedLM(_ITERATIONS, robustness=0.0, reject_worse=False))
    return solver(*problems[:3], weights, init=problems.pose, cam_from_rig=problems.cam_from_rig, **noise)


class KnownInliers(Configured):
    r"""Least squares over the reprojection errors of the true inliers, starting from the true pose.

    Pairs have equal weights. A solver that weighs pairs by their noise can be more accurate.
    """

    def __init__(self) -> None:
        super().__init__(locals())

    def solve_with_truth(self, problems: Problems) -> PnPResult:
        """See :class:`~kornia_pnpnet.evaluation.SeesTruth`."""
        return _least_squares(problems, problems.inliers * _areas(problems))


class KnownInliersAndNoise(Configured):
    r"""Least squares as in :class:`KnownInliers`, with each inlier weighted by the inverse variance of its pixel.

    The variance is :math:`\sigma_\mathrm{img}^2 + \sigma_\mathrm{world}^2\,\mathrm{tr}(J_x J_x^\top) / 2`, where
    :math:`J_x` is the Jacobian of the pixel with respect to the world point at the true pose. Known covariances
    replace the sigmas and whiten the residuals. The result is then the maximum likelihood estimate.

    Args:
        img_sigma: standard deviation of a pixel coordinate, for pairs whose problem does not give ``img_sigma``. The
            default is the value of the protocol's synthetic data.
        world_sigma: standard deviation of a world coordinate, for pairs whose problem does not give ``world_sigma``.
            The default is the value of the protocol's synthetic data.

    Raises:
        BaseError: for a standard deviation that is negative or not finite, or when both standard deviations are 0.
    """

    def __init__(self, *, img_sigma: float = 1.0, world_sigma: float = 0.05) -> None:
        super().__init__(locals())
        check_numbers(0.0, img_sigma=img_sigma, world_sigma=world_sigma)
        KORNIA_CHECK(img_sigma + world_sigma > 0, "img_sigma and world_sigma must not both be 0.")

    def solve_with_truth(self, problems: Problems) -> PnPResult:
        """See :meth:`KnownInliers.solve_with_truth`."""
        given = {name: expand_sigma(name, getattr(problems, name), problems.world_points) for name in self.config}
        sigmas = {name: torch.where(x.isnan(), self.config[name], x) for name, x in given.items()}
        if problems.img_cov is None and problems.world_cov is None:
            return _least_squares(problems, self._inverse_variances(problems, **sigmas))
        noise = {"img_cov": problems.img_cov, "world_cov": problems.world_cov}
        noise |= {name: sigma for name, sigma in sigmas.items() if noise[name.replace("sigma", "cov")] is None}
        return _least_squares(problems, problems.inliers.to(problems.world_points.dtype), **noise)

    @torch.no_grad()  # with gradients, a NaN point would give its camera a NaN gradient
    def _inverse_variances(self, problems: Problems, img_sigma: Tensor, world_sigma: Tensor) -> Tensor:
        """The weight of each pair in 1/px² at the mean focal length, (B, N). Outliers have the weight 0."""
        cam_points = problems.true_cam_points
        depth = cam_points[..., 2:]
        depth = torch.where(depth > 0, depth, 1.0)  # the solver ignores points behind the camera
        focal = _focal_lengths(problems)
        # J_x = (f / z) [1, 0, -p; 0, 1, -q] R with p = x / z and q = y / z. The rotation cancels in the trace.
        trace = ((focal / depth).square() * (1.0 + (cam_points[..., :2] / depth).square())).sum(-1)  # (B, N)
        img_sigma = img_sigma.maximum(LEAST_NOISE * focal.abs().amax(-1))
        variance = img_sigma.square() + world_sigma.square() * trace / 2.0
        return torch.where(problems.inliers, _areas(problems) / variance, 0.0)


def _focal_lengths(problems: Problems) -> Tensor:
    """Both focal lengths of each pair, (B, N, 2), or (B, 1, 2) without a rig."""
    camera = problems.pair_intrinsics
    return (camera / camera[..., 2:, 2:]).diagonal(dim1=-2, dim2=-1)[..., :2]


def _areas(problems: Problems) -> Tensor:
    """The product of both focal lengths of each pair, divided by the mean, shape as :func:`_focal_lengths`.

    Residuals are refined at one focal length for all cameras of a rig. As a weight, the product makes them pixels.
    """
    size = _focal_lengths(problems).prod(-1).abs()
    return size / size.mean(1, keepdim=True)
