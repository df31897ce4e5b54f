"""Priors of points in the camera's frame: the protocol's box, slabs, objects, façades, rooms, drives.

A new prior is one more class with the ``__call__`` of :class:`PointPrior`.
"""

from __future__ import annotations

import math
from typing import Protocol

import torch
from kornia.core.check import KORNIA_CHECK
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_positive, check_ranges, check_whole
from kornia_pnpnet.data.draws import log_uniform, normal, random_poses, uniform

__all__ = ["BoxPoints", "DrivePoints", "FacadePoints", "ObjectPoints", "PointPrior", "RoomPoints", "SlabPoints"]

# Smallest depth of a slab's tilted surface relative to its distance. A choice: keeps it in front of the camera.
_LEAST_SURFACE = 0.3
# Smallest cosine between a ray and a façade's normal, relative to that of the middle ray. A choice: rays that meet a
# façade further away than 20 times its distance see something else at that depth.
_LEAST_FACING = 0.05
# Added to components of rays before dividing by them: rays along a wall meet it far away instead of at infinity.
_PARALLEL = 1e-9
# Depth of the nearest furniture relative to the wall behind it. A choice: nobody photographs a cupboard's door.
_NEAREST = 0.15
# Degrees. A camera's projection needs less than 180.
_WIDEST = 170.0
# Depth in metres of what is not there, such as the ceiling of a street.
_NOWHERE = 1e6


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


class _View:
    """What the priors of surfaces share: the rays of a random window of an image with a random field of view.

    Args:
        field_of_view: smallest and largest angle in degrees between opposite sides of the square image, uniform.
        window: smallest and largest share of the image's area in which the points lie, log-uniform.
    """

    def __init__(self, field_of_view: tuple[float, float], window: tuple[float, float]) -> None:
        check_ranges(field_of_view=field_of_view, window=window)
        check_numbers(0.0, _WIDEST, field_of_view=field_of_view[1])
        check_numbers(0.0, 1.0, window=window[1])
        self.field_of_view = field_of_view
        self.window = window

    def rays(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """Directions with a third coordinate of 1, (B, n, 3)."""
        angle = uniform((batch_size, 1, 1), *self.field_of_view, generator).deg2rad_()
        area = log_uniform((batch_size, 1, 1), *self.window, generator)
        split = uniform((batch_size, 1, 1), 0.25, 0.75, generator)  # the window's shape: wide, square or high
        size = torch.cat((area**split, area ** (1.0 - split)), -1)  # (B, 1, 2)
        centre = (1.0 - size) * uniform((batch_size, 1, 2), -1.0, 1.0, generator)
        tangents = (angle / 2).tan() * (centre + size * uniform((batch_size, n, 2), -1.0, 1.0, generator))
        return torch.nn.functional.pad(tangents, (0, 1), value=1.0)


class FacadePoints(_View):
    r"""Points of a façade or of two that meet at a corner, with relief.

    Each façade is a plane that is turned away from the camera by a random angle. Recesses and balconies are steps: a
    random half of the points lies deeper by the relief, and all points vary by a tenth of the relief.

    Args:
        field_of_view: smallest and largest angle in degrees between opposite sides of the square image, uniform.
        window: smallest and largest share of the image's area in which the points lie, log-uniform.
        distance: smallest and largest distance along the optical axis in metres, log-uniform.
        slant: largest angle in degrees by which a façade is turned, uniform from 0.
        relief: smallest and largest relief relative to the distance, log-uniform.
        corner: share of problems with two façades.

    Raises:
        BaseError: for a range that falls or is not positive, an angle of 180° or more, or a share outside [0, 1].

    Example:
        >>> points = FacadePoints(corner=0.0)(2, 50, torch.Generator().manual_seed(0))
        >>> points.shape, bool((points[..., 2] > 0).all())
        (torch.Size([2, 50, 3]), True)
    """

    def __init__(
        self,
        *,
        field_of_view: tuple[float, float] = (15.0, 120.0),
        window: tuple[float, float] = (0.1, 1.0),
        distance: tuple[float, float] = (4.0, 60.0),
        slant: float = 70.0,
        relief: tuple[float, float] = (0.001, 0.1),
        corner: float = 0.3,
    ) -> None:
        super().__init__(field_of_view, window)
        check_ranges(distance=distance, relief=relief)
        check_numbers(0.0, 89.0, slant=slant)
        check_numbers(0.0, 1.0, corner=corner)
        self.distance = distance
        self.slant = slant
        self.relief = relief
        self.corner = corner

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """Draw points of shape ``(batch_size, n, 3)``."""
        rays = self.rays(batch_size, n, generator)
        slant = uniform((batch_size, 2, 1), 0.0, math.radians(self.slant), generator)
        turn = uniform((batch_size, 2, 1), -math.pi, math.pi, generator)
        normals = torch.cat((slant.sin() * turn.cos(), slant.sin() * turn.sin(), slant.cos()), -1)  # (B, 2, 3)
        facing = (rays @ normals.mT / slant.cos().mT).clamp(min=_LEAST_FACING)  # (B, n, 2)
        two = uniform((batch_size, 1), 0.0, 1.0, generator) < self.corner
        outward = uniform((batch_size, 1), 0.0, 1.0, generator) < 0.5
        corner = torch.where(outward, facing.amin(-1), facing.amax(-1))
        z = log_uniform((batch_size, 1), *self.distance, generator) / torch.where(two, corner, facing[..., 0])
        step = (uniform((batch_size, n), 0.0, 1.0, generator) < 0.5) + 0.1 * normal((batch_size, n), generator)
        relief = log_uniform((batch_size, 1), *self.relief, generator)
        return rays * (z * (1.0 + relief * step).clamp(min=_LEAST_SURFACE))[..., None]


class RoomPoints(_View):
    r"""Points of a room as seen from inside: floor, ceiling, walls and pieces of furniture.

    The room is a box, the camera anywhere in it but near a wall and turned anyhow. Pieces of furniture are boxes that
    hide what is behind them.

    Args:
        field_of_view: smallest and largest angle in degrees between opposite sides of the square image, uniform.
        window: smallest and largest share of the image's area in which the points lie, log-uniform.
        side: smallest and largest length and width in metres, log-uniform.
        height: smallest and largest height in metres, uniform.
        furniture: number of pieces of furniture.

    Raises:
        BaseError: for a range that falls or is not positive, an angle of 180° or more, or a number that is not whole.

    Example:
        >>> points = RoomPoints(side=(4.0, 5.0), height=(2.0, 3.0))(2, 50, torch.Generator().manual_seed(0))
        >>> points.shape, bool((points.norm(dim=-1) < 7.7).all())
        (torch.Size([2, 50, 3]), True)
    """

    def __init__(
        self,
        *,
        field_of_view: tuple[float, float] = (15.0, 120.0),
        window: tuple[float, float] = (0.1, 1.0),
        side: tuple[float, float] = (2.0, 15.0),
        height: tuple[float, float] = (2.2, 5.0),
        furniture: int = 4,
    ) -> None:
        super().__init__(field_of_view, window)
        check_ranges(side=side, height=height)
        check_whole(0, furniture=furniture)
        self.side = side
        self.height = height
        self.furniture = furniture

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """Draw points of shape ``(batch_size, n, 3)``."""
        rays = self.rays(batch_size, n, generator)
        turn = random_poses(batch_size, generator, max_angle=math.pi).rotation
        ground = log_uniform((batch_size, 1, 2), *self.side, generator)
        size = torch.cat((ground, uniform((batch_size, 1, 1), *self.height, generator)), -1)  # (B, 1, 3)
        low = -size * uniform((batch_size, 1, 3), 0.15, 0.85, generator)  # from the camera, in the room's axes
        in_room = rays @ turn.mT
        z = _far_side(in_room, low, low + size)
        # Furniture stands on the floor and not where the camera is.
        shape = batch_size, self.furniture, 3
        extent = size * uniform(shape, 0.08, 0.4, generator)
        start = low + (size - extent) * uniform(shape, 0.0, 1.0, generator)
        start[..., 2] = low[..., 2]
        near = _near_side(in_room[:, :, None], start[:, None], (start + extent)[:, None])  # (B, n, furniture)
        for hit in near.unbind(-1):
            z = torch.where((hit > _NEAREST * z) & (hit < z), hit, z)
        return rays * z[..., None]


class DrivePoints(_View):
    r"""Points as seen from a car: the road, the fronts on both sides, the end of the street, with a large depth range.

    The camera looks along the street. Cars and trees in front of the fronts are points that are nearer than the fronts.

    Args:
        field_of_view: smallest and largest angle in degrees between opposite sides of the square image, uniform.
        window: smallest and largest share of the image's area in which the points lie, log-uniform.
        height: smallest and largest height of the camera above the road in metres, log-uniform.
        side: smallest and largest distance of the fronts on each side in metres, log-uniform.
        end: smallest and largest distance of the end of the street in metres, log-uniform.
        turn: standard deviation of the yaw in degrees; that of pitch and roll is a third.
        nearer: share of points in front of the fronts.

    Raises:
        BaseError: for a range that falls or is not positive, an angle of 180° or more, or a share outside [0, 1].

    Example:
        >>> points = DrivePoints(turn=0.0, height=(1.5, 1.5))(2, 50, torch.Generator().manual_seed(0))
        >>> points.shape, bool((points[..., 1] < 1.5 + 1e-9).all())
        (torch.Size([2, 50, 3]), True)
    """

    def __init__(
        self,
        *,
        field_of_view: tuple[float, float] = (15.0, 120.0),
        window: tuple[float, float] = (0.1, 1.0),
        height: tuple[float, float] = (1.0, 3.0),
        side: tuple[float, float] = (2.5, 20.0),
        end: tuple[float, float] = (30.0, 200.0),
        turn: float = 15.0,
        nearer: float = 0.3,
    ) -> None:
        super().__init__(field_of_view, window)
        check_ranges(height=height, side=side, end=end)
        check_numbers(0.0, 180.0, turn=turn)
        check_numbers(0.0, 1.0, nearer=nearer)
        self.height = height
        self.side = side
        self.end = end
        self.turn = turn
        self.nearer = nearer

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """Draw points of shape ``(batch_size, n, 3)``."""
        rays = self.rays(batch_size, n, generator)
        angles = math.radians(self.turn) * normal((batch_size, 3), generator)  # pitch, yaw, roll
        angles *= angles.new_tensor((1 / 3, 1.0, 1 / 3))
        turn = axis_angle_to_rotation_matrix(angles)
        left, right = log_uniform((2, batch_size, 1), *self.side, generator)
        height = log_uniform((batch_size, 1), *self.height, generator)
        end = log_uniform((batch_size, 1), *self.end, generator)
        low = torch.stack((-left, torch.full_like(left, -_NOWHERE), -end), -1)  # (B, 1, 3), y points down
        z = _far_side(rays @ turn.mT, low, torch.stack((right, height, end), -1))
        is_nearer = uniform((batch_size, n), 0.0, 1.0, generator) < self.nearer
        return rays * torch.where(is_nearer, z * uniform((batch_size, n), 0.3, 1.0, generator), z)[..., None]


def _far_side(rays: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Where rays from inside an axis-aligned box leave the box, as multiples of the rays; the last dimension goes."""
    rays = torch.where(rays.abs() < _PARALLEL, _PARALLEL, rays)
    return torch.where(rays > 0, high, low).div_(rays).amin(-1)


def _near_side(rays: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Where rays from outside enter an axis-aligned box, infinite for a miss; shapes as of :func:`_far_side`."""
    rays = torch.where(rays.abs() < _PARALLEL, _PARALLEL, rays)
    one, two = low / rays, high / rays
    enter, leave = torch.minimum(one, two).amax(-1), torch.maximum(one, two).amin(-1)
    return torch.where(enter < leave, enter, math.inf)
