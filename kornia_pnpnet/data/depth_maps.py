"""World points from depth maps: noise that grows with the square of the depth, flying pixels, errors of map poses."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_ranges, check_whole
from kornia_pnpnet.data.draws import log_uniform, normal, uniform, unit

__all__ = ["DepthMaps"]

# Standard deviation of each coordinate of the position of a map camera about the query camera, relative to the mean
# distance of the points. A choice: a map image shows the same points from the side by 10 to 40 degrees.
_BASELINE = 0.3
# Bounds of the change of a flying pixel's distance from its map camera, as a share of the distance. A choice.
_FLIGHT = (-0.3, 0.6)


@dataclass(kw_only=True, eq=False)
class DepthMaps:
    r"""Errors of world points that depth cameras have measured from several map images.

    Each world point comes from the depth map of one of ``maps`` cameras near the query camera. Three errors move it:

    - noise along the ray of the map camera, with the standard deviation :math:`a d^2 / \bar d` at the distance
      :math:`d`. The noise of stereo and structured light grows with the square of the distance.
    - the error of the map camera's rotation, which turns all points of one map about this camera;
    - *flying pixels*: at the edge of an object, the measured distance lies between object and background. These pairs
      are outliers.

    Args:
        depth_noise: range of :math:`a`, the noise at the mean distance :math:`\bar d`, relative to this distance. Each
            problem draws a log-uniform number.
        angle: range of the standard deviation, in degrees, of a map camera's rotation about each axis. Each problem
            draws a log-uniform number.
        flying_share: probability that a point is a flying pixel.
        maps: number of map cameras of a problem.

    Example:
        >>> points = torch.tensor([[[0.0, 0.0, 4.0], [1.0, 0.0, 5.0]]], dtype=torch.float64)
        >>> moves, is_flying = DepthMaps(flying_share=0.0)(points, torch.Generator().manual_seed(0))
        >>> moves.shape, bool(moves.norm(dim=-1).max() < 1.0), bool(is_flying.any())
        (torch.Size([1, 2, 3]), True, False)
    """

    depth_noise: tuple[float, float] = (0.001, 0.03)
    angle: tuple[float, float] = (0.02, 0.5)
    flying_share: float = 0.1
    maps: int = 3

    def __post_init__(self) -> None:
        check_ranges(depth_noise=self.depth_noise, angle=self.angle)
        check_numbers(0.0, 1.0, flying_share=self.flying_share)
        check_whole(1, maps=self.maps)

    def __call__(self, cam_points: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw the errors of points in the query camera's frame, (B, N, 3), float64.

        Returns:
            The moves of the points, (B, N, 3), and whether each point is a flying pixel, bool, (B, N, 1).
        """
        batch_size, n, _ = cam_points.shape
        each = batch_size, n, 1
        size = cam_points.norm(dim=-1).mean(1)[:, None, None]  # (B, 1, 1)
        centre = _BASELINE * size * normal((batch_size, self.maps, 3), generator)
        turn = log_uniform((batch_size, 1, 1), *self.angle, generator).deg2rad() * normal(centre.shape, generator)
        of_map = (self.maps * unit(each, generator)).long()
        ray = cam_points - centre.take_along_dim(of_map, 1)
        sigma = log_uniform((batch_size, 1, 1), *self.depth_noise, generator)
        change = sigma * ray.norm(dim=-1, keepdim=True) / size * normal(each, generator)  # relative to the distance
        is_flying = unit(each, generator) < self.flying_share
        change = torch.where(is_flying, uniform(each, *_FLIGHT, generator), change)
        return change * ray + torch.linalg.cross(turn.take_along_dim(of_map, 1), ray), is_flying
