"""Priors of points in the camera's frame: the protocol's box, slabs, objects.

A new prior is one more class with the ``__call__`` of :class:`PointPrior`.
"""

from __future__ import annotations

import math
from typing import Protocol

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_positive, check_ranges
from kornia_pnpnet.data.draws import log_uniform, normal, random_poses, uniform

__all__ = ["BoxPoints", "ObjectPoints", "PointPrior", "SlabPoints"]

# Smallest depth of a slab's tilted surface relative to its distance. A choice: keeps it in front of the camera.
_LEAST_SURFACE = 0.3


class PointPrior(Protocol):
    """Draws points in the camera frame, shape ``(batch_size, n, 3)``, float64."""

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """Draw the points."""
        ...


class BoxPoints:
    r"""The protocol's points: uniform in a box in front of the camera, in its frame.

    Args:
        half_width: largest :math:`|x|` and :math:`|y|`, in the unit of the world.
        z_near: depth of the box's near face, in the unit of the world.
        depth: length of the box along the optical axis, in the unit of the world.

    Raises:
        BaseError: for a negative length, or a near face that is not in front of the camera.

    Example:
        >>> points = BoxPoints(half_width=2.0, z_near=1.0, depth=3.0)(5, 9, torch.Generator().manual_seed(0))
        >>> points.shape, bool((points[..., 2] >= 1.0).all()), bool((points[..., :2].abs() <= 2.0).all())
        (torch.Size([5, 9, 3]), True, True)
    """

    def __init__(self, *, half_width: float = 10.0, z_near: float = 10.0, depth: float = 80.0) -> None:
        check_numbers(0.0, half_width=half_width, depth=depth)
        check_positive(z_near=z_near)
        self.half_width = half_width
        self.z_near = z_near
        self.depth = depth

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """Draw points of shape ``(batch_size, n, 3)``."""
        xy = uniform((batch_size, n, 2), -self.half_width, self.half_width, generator)
        z = uniform((batch_size, n, 1), self.z_near, self.z_near + self.depth, generator)
        return torch.cat((xy, z), -1)


class SlabPoints:
    r"""Points as in photographs: a tilted slab of any thickness, seen through a window of the image.

    A façade fills part of the image and is thin, a courtyard is deep; a box along the optical axis is neither.
    A window, a distance, a tilt and a thickness are drawn for each problem. Each point has a uniform direction in the
    window and a depth in the slab, :math:`z = d (1 + g_x x/z + g_y y/z)(1 + e\,u)` with :math:`u` uniform.

    Args:
        window: smallest and largest half-size of the window as tangents of the viewing angle, uniform for each axis.
        field_of_view: the window lies within this tangent on both axes.
        distance: smallest and largest distance :math:`d` in the unit of the world, log-uniform.
        tilt: standard deviation of the slopes :math:`g`.
        thickness: smallest and largest thickness :math:`e` relative to the distance, log-uniform.

    Raises:
        BaseError: for a range that falls or is not positive, or a window that is larger than the field of view.
    """

    def __init__(
        self,
        *,
        window: tuple[float, float] = (0.15, 0.8),
        field_of_view: float = 0.9,
        distance: tuple[float, float] = (10.0, 40.0),
        tilt: float = 0.5,
        thickness: tuple[float, float] = (0.02, 4.0),
    ) -> None:
        check_ranges(window=window, distance=distance, thickness=thickness)
        check_numbers(0.0, field_of_view=field_of_view, tilt=tilt)
        KORNIA_CHECK(
            window[1] <= field_of_view, f"The window {window} must fit into the field of view, got {field_of_view}."
        )
        self.window = window
        self.field_of_view = field_of_view
        self.distance = distance
        self.tilt = tilt
        self.thickness = thickness

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """Draw points of shape ``(batch_size, n, 3)``."""
        half = uniform((batch_size, 1, 2), *self.window, generator)
        centre = (self.field_of_view - half) * uniform((batch_size, 1, 2), -1.0, 1.0, generator)
        direction = centre + half * uniform((batch_size, n, 2), -1.0, 1.0, generator)
        slope = self.tilt * normal((batch_size, 1, 2), generator)
        rise = slope * (direction - centre)  # (B, n, 2)
        surface = (1.0 + (rise[..., 0] + rise[..., 1])).clamp(min=_LEAST_SURFACE)
        thickness = log_uniform((batch_size, 1), *self.thickness, generator)
        layer = 1.0 + thickness * uniform((batch_size, n), 0.0, 1.0, generator)
        z = log_uniform((batch_size, 1), *self.distance, generator) * surface * layer  # (B, n)
        return torch.cat((direction * z[..., None], z[..., None]), -1)


class ObjectPoints:
    r"""Points of an object of any proportions somewhere in the image, near or far.

    The object is an ellipsoid or a box of half-size about 1, made thinner by random factors along two axes, down to a
    plane, and rotated at random. Its direction is random, its distance in half-sizes log-uniform.

    Args:
        distance: smallest and largest distance of the centre in half-sizes, log-uniform.
        field_of_view: the centre lies within this tangent on both axes.
        thinnest: smallest factor of an axis; factors are log-uniform between this and 1.
        planar: share of problems whose points lie in a plane.

    Raises:
        BaseError: for a range that falls or is not positive, or a share outside [0, 1].

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> problems = SyntheticProblems(n=8, batch_size=2, points=ObjectPoints(planar=1.0), world_sigma=0.0).batch(0)
        >>> centred = problems.world_points - problems.world_points.mean(1, keepdim=True)
        >>> torch.linalg.matrix_rank(centred, rtol=1e-4)
        tensor([2, 2])
    """

    def __init__(
        self,
        *,
        distance: tuple[float, float] = (1.5, 40.0),
        field_of_view: float = 0.8,
        thinnest: float = 0.05,
        planar: float = 0.15,
    ) -> None:
        check_ranges(distance=distance)
        check_numbers(0.0, field_of_view=field_of_view)
        check_positive(thinnest=thinnest)
        check_numbers(0.0, 1.0, thinnest=thinnest, planar=planar)
        self.distance = distance
        self.field_of_view = field_of_view
        self.thinnest = thinnest
        self.planar = planar

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """Draw points of shape ``(batch_size, n, 3)``."""
        box = uniform((batch_size, n, 3), -1.0, 1.0, generator)
        ball = 0.5 * normal((batch_size, n, 3), generator)
        is_box = uniform((batch_size, 1, 1), 0.0, 1.0, generator) < 0.5
        factors = log_uniform((batch_size, 1, 3), self.thinnest, 1.0, generator)
        factors[..., 0] = 1.0
        flat = uniform((batch_size, 1), 0.0, 1.0, generator) < self.planar
        factors[..., 2] = torch.where(flat, 0.0, factors[..., 2])
        turn = random_poses(batch_size, generator, max_angle=math.pi).rotation
        points = (torch.where(is_box, box, ball) * factors) @ turn.mT
        tangents = uniform((batch_size, 2), -self.field_of_view, self.field_of_view, generator)
        away = log_uniform((batch_size, 1), *self.distance, generator)
        centre = away * torch.cat((tangents, torch.ones_like(away)), -1)
        return points + centre[:, None]
