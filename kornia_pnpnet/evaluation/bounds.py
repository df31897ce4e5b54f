"""Bounds: what a solver could reach if it knew the wrong pairs, and if it knew the noise as well.

They are given the answers, so they stand beside the solvers of a comparison and not among them.
"""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor, nn

from kornia_pnpnet.core.checks import check_numbers
from kornia_pnpnet.geometry import transform
from kornia_pnpnet.refine import RobustWeightedLM
from kornia_pnpnet.solver import PnPNet
from kornia_pnpnet.types import PnPResult, Problems

__all__ = ["KnownInliers", "KnownInliersAndNoise"]

_ITERATIONS = 10  # from the true pose 3 reach the minimum to 7 digits of the cost, 10 to the last


class KnownInliers(nn.Module):
    r"""Least squares of the pixels of the true inliers, started from the true pose.

    The best that a method can do which finds all wrong pairs and then minimises the reprojection error. Source: the
    protocol's bound *known inliers*.

    Example:
        >>> from kornia_pnpnet.data import OutlierMix, SyntheticProblems
        >>> problems = SyntheticProblems(batch_size=4, seed=1, outliers=OutlierMix(count=3)).batch(0)
        >>> result = KnownInliers().solve_with_truth(problems)
        >>> torch.equal(result.weights > 0, problems.inliers)
        True
    """

    def __init__(self) -> None:
        super().__init__()
        self.config: dict[str, float] = {}
        self.least_squares = PnPNet(None, RobustWeightedLM(_ITERATIONS, robustness=0.0, learnable=False))

    def extra_repr(self) -> str:
        """Show the constructor's arguments."""
        return ", ".join(f"{key}={value!r}" for key, value in self.config.items())

    def pair_weights(self, problems: Problems) -> Tensor:
        """Weigh the pairs of some problems: 1 for an inlier, else 0, shape :math:`(B, N)`."""
        return problems.inliers.to(problems.world_points.dtype)

    def solve_with_truth(self, problems: Problems) -> PnPResult:
        r"""Solve problems whose answers are known.

        Args:
            problems: :math:`B` problems with :math:`N` pairs each.

        Returns:
            The minimum next to the true pose.
        """
        world_points, img_points, intrinsics = problems[:3]
        return self.least_squares(world_points, img_points, intrinsics, self.pair_weights(problems), init=problems.pose)


class KnownInliersAndNoise(KnownInliers):
    r"""The same with each pair weighted by the inverse variance of its pixel.

    Noise of a world point moves its pixel the more the nearer it is. With :math:`J_x` the derivative of the pixel by
    the point at the true pose, the weight is
    :math:`1 / (\sigma_\mathrm{img}^2 + \sigma_\mathrm{world}^2\,\mathrm{tr}(J_x J_x^\top) / 2)`. Source: the
    protocol's bound *known inliers and noise*.

    Args:
        img_sigma: standard deviation of each pixel coordinate in pixels; the default is the protocol's.
        world_sigma: standard deviation of each world coordinate in the unit of the world; the default is the
            protocol's, for scenes it has to be known.

    Raises:
        BaseError: for a standard deviation that is negative or not finite, or when both are 0.

    Example:
        >>> KnownInliersAndNoise(world_sigma=0.01)
        KnownInliersAndNoise(
          img_sigma=1.0, world_sigma=0.01
          ...
    """

    def __init__(self, *, img_sigma: float = 1.0, world_sigma: float = 0.05) -> None:
        super().__init__()
        check_numbers(0.0, img_sigma=img_sigma, world_sigma=world_sigma)
        KORNIA_CHECK(img_sigma + world_sigma > 0, "img_sigma and world_sigma must not both be 0.")
        self.config = {"img_sigma": img_sigma, "world_sigma": world_sigma}

    @torch.no_grad()
    def pair_weights(self, problems: Problems) -> Tensor:
        """Weigh the pairs of some problems by the variance of their pixels, 0 for outliers, shape :math:`(B, N)`.

        The weights have no gradient: one of a point that is NaN would reach all others.
        """
        cam_points = transform(problems.pose, problems.world_points)  # (B, N, 3)
        depth = cam_points[..., 2:]
        depth = torch.where(depth > 0, depth, 1.0)  # pairs behind the camera do not count anyway
        plane_points = cam_points[..., :2] / depth
        focal = problems.intrinsics.diagonal(dim1=-2, dim2=-1)[:, None, :2]
        # J_x = (f / z) [1, 0, -p; 0, 1, -q] R, and the rotation drops out of the trace.
        trace = ((focal / depth).square() * (1.0 + plane_points.square())).sum(-1)  # (B, N)
        variance = self.config["img_sigma"] ** 2 + self.config["world_sigma"] ** 2 * trace / 2.0
        return torch.where(problems.inliers, variance.reciprocal(), 0.0)
