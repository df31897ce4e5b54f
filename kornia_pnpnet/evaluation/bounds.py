"""Bounds: the accuracy that a solver could reach if it knew the inliers, or the inliers and the noise.

A bound needs the true poses and inliers, so it cannot solve new problems.
"""

from __future__ import annotations

from typing import Any

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers
from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.refine.lm import RobustWeightedLM
from kornia_pnpnet.result import PnPResult, Problems
from kornia_pnpnet.solver import PnPNet

__all__ = ["KnownInliers", "KnownInliersAndNoise"]

# From the true pose 3 iterations reach the minimum to 7 digits of the cost, 10 to the last digit of float64.
_ITERATIONS = 10


def _least_squares(problems: Problems, weights: Tensor, **noise: Any) -> PnPResult:
    """The minimum of the weighted squared reprojection errors next to the true pose."""
    solver = PnPNet(None, RobustWeightedLM(_ITERATIONS, robustness=0.0, reject_worse=False))
    return solver(*problems[:3], weights, init=problems.pose, cam_from_rig=problems.cam_from_rig, **noise)


class KnownInliers(Configured):
    r"""Least squares of the reprojection errors of the true inliers, started from the true pose.

    No method that finds the inliers and then minimises the reprojection error does better. Source: the protocol's bound
    *known inliers*.

    Example:
        >>> from kornia_pnpnet.data import OutlierMix, SyntheticProblems
        >>> problems = SyntheticProblems(batch_size=4, seed=1, outliers=OutlierMix(count=3)).batch(0)
        >>> result = KnownInliers().solve_with_truth(problems)
        >>> torch.equal(result.weights > 0, problems.inliers)
        True
    """

    def __init__(self) -> None:
        super().__init__(locals())

    def solve_with_truth(self, problems: Problems) -> PnPResult:
        """Solve problems with the help of their true poses and inliers."""
        return _least_squares(problems, problems.inliers.to(problems.world_points.dtype))


class KnownInliersAndNoise(Configured):
    r"""Least squares as in :class:`KnownInliers`, with each inlier weighted by the inverse variance of its pixel.

    The noise of a world point moves the pixels of near points more than those of far points. With :math:`J_x` the
    derivative of the pixel by the point at the true pose, the weight is
    :math:`1 / (\sigma_\mathrm{img}^2 + \sigma_\mathrm{world}^2\,\mathrm{tr}(J_x J_x^\top) / 2)`. Source: the
    protocol's bound *known inliers and noise*.

    Problems with covariances get the maximum likelihood estimate on the inliers: their covariances whiten the
    residuals, and a sigma stands for a covariance that is missing.

    Args:
        img_sigma: standard deviation of each pixel coordinate, in pixels. The default is the protocol's.
        world_sigma: standard deviation of each world coordinate, in the unit of the world. The default is that of the
            protocol's synthetic data.

    Raises:
        BaseError: for a standard deviation that is negative or not finite, or when both are 0.
    """

    def __init__(self, *, img_sigma: float = 1.0, world_sigma: float = 0.05) -> None:
        super().__init__(locals())
        check_numbers(0.0, img_sigma=img_sigma, world_sigma=world_sigma)
        KORNIA_CHECK(img_sigma + world_sigma > 0, "img_sigma and world_sigma must not both be 0.")

    def solve_with_truth(self, problems: Problems) -> PnPResult:
        """See :meth:`KnownInliers.solve_with_truth`."""
        covs = {"img": problems.img_cov, "world": problems.world_cov}
        if all(cov is None for cov in covs.values()):
            return _least_squares(problems, self._inverse_variances(problems))
        sigmas = {f"{kind}_sigma": self.config[f"{kind}_sigma"] for kind, cov in covs.items() if cov is None}
        known = {f"{kind}_cov": cov for kind, cov in covs.items() if cov is not None}
        return _least_squares(problems, problems.inliers.to(problems.world_points.dtype), **sigmas, **known)

    @torch.no_grad()  # the gradient of a NaN point would reach all other points
    def _inverse_variances(self, problems: Problems) -> Tensor:
        """The weight of each pair in 1/px², 0 for an outlier, (B, N)."""
        cam_points = problems.true_cam_points
        depth = cam_points[..., 2:]
        depth = torch.where(depth > 0, depth, 1.0)  # pairs behind the camera have no weight in the solver
        focal = problems.pair_intrinsics.diagonal(dim1=-2, dim2=-1)[..., :2]
        # J_x = (f / z) [1, 0, -p; 0, 1, -q] R; the rotation cancels in the trace.
        trace = ((focal / depth).square() * (1.0 + (cam_points[..., :2] / depth).square())).sum(-1)  # (B, N)
        variance = self.config["img_sigma"] ** 2 + self.config["world_sigma"] ** 2 * trace / 2.0
        return torch.where(problems.inliers, variance.reciprocal(), 0.0)
