"""Priors of points in the camera's frame, and errors of the points that depth cameras measure.

A new prior is a class with the method ``__call__`` of :class:`PointPrior`. An argument of two numbers is a range.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor
from torch.nn.functional import pad

from kornia_pnpnet.core.checks import check_numbers, check_positive, check_ranges, check_whole
from kornia_pnpnet.data.draws import log_uniform, normal, random_poses, uniform, unit

__all__ = [
    "BoxPoints",
    "DepthMaps",
    "DrivePoints",
    "FacadePoints",
    "ObjectPoints",
    "PointPrior",
    "RoomPoints",
    "SlabPoints",
]

Range: TypeAlias = tuple[float, float]

# The numbers below are choices that cover scenes from a flat picture on a wall to a street. Lengths are in metres.
_SLAB_WINDOW = (0.15, 0.8)  # half the size of the slab's window in x / z and y / z
_SLAB_TANGENT = 0.9  # largest |x / z| and |y / z| of a point
_SLAB_DISTANCE = (10.0, 40.0)
_TILT = 0.5  # standard deviation of a slab's slope
_THICKNESS = (0.02, 4.0)  # thickness of a slab, divided by the slab's distance
_LEAST_SURFACE = 0.3  # smallest depth of a slab's surface, divided by the distance of the slab
_OBJECT_DISTANCE = (1.5, 40.0)  # distance of an object, divided by half the size of the object
_OBJECT_TANGENT = 0.8  # largest |x / z| and |y / z| of an object's centre
_THINNEST = 0.05  # smallest ratio of a shorter axis of an object to its longest axis
_PLANAR = 0.15  # share of planar objects
_FACADE_DISTANCE = (4.0, 60.0)
_SLANT = 70.0  # largest angle in degrees between the normal of a façade and the optical axis
_RELIEF = (0.001, 0.1)  # relief of a façade, divided by the façade's depth
_CORNER = 0.3  # share of problems with two façades
# Smallest ratio of a façade's distance to the depth of a point. Rays that miss the façade also get this ratio.
_LEAST_FACING = 0.05
_ROOM_SIDE = (2.0, 15.0)
_ROOM_HEIGHT = (2.2, 5.0)
_FURNITURE = 4  # number of pieces of furniture
_NEAREST = 0.15  # least depth of furniture, divided by the depth of the wall behind it
_CAMERA_HEIGHT = (1.0, 3.0)  # height of the camera above the street
_STREET_SIDE = (2.5, 20.0)  # distance of the house fronts
_STREET_END = (30.0, 200.0)  # distance of the end of the street
_YAW = 15.0  # standard deviation of the camera's yaw, in degrees
_NEARER = 0.3  # share of points on cars and trees
_NOWHERE = 1e6  # height of a street's box, so large that no ray reaches the top
# Largest field of view in degrees. A pinhole camera needs a field of view below 180 degrees.
_WIDEST = 170.0
# Depth maps: standard deviation of a map camera's coordinates in the query camera's frame, divided by the points' mean
# distance. The directions from a point to the map camera and to the query camera typically differ by 10 to 40°.
_BASELINE = 0.3
# Depth maps: smallest and largest relative error of a flying pixel's distance from its map camera.
_FLIGHT = (-0.3, 0.6)


class PointPrior(Protocol):
    """Draws points in the camera frame, shape ``(batch_size, n, 3)``, float64."""

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """Draw the points."""


class BoxPoints:
    r"""The points of the paper's protocol: uniform in a box in front of the camera.

    Args:
        half_width: largest :math:`|x|` and :math:`|y|`, in the unit of the world.
        z_near: depth of the box's near face, in the unit of the world.
        depth: length of the box along the optical axis, in the unit of the world.
    """

    def __init__(self, *, half_width: float = 10.0, z_near: float = 10.0, depth: float = 80.0) -> None:
        check_numbers(0.0, half_width=half_width, depth=depth)
        check_positive(z_near=z_near)
        self.half_width, self.z_near, self.depth = half_width, z_near, depth

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """See :class:`PointPrior`."""
        xy = uniform((batch_size, n, 2), -self.half_width, self.half_width, generator)
        z = uniform((batch_size, n, 1), self.z_near, self.z_near + self.depth, generator)
        return torch.cat((xy, z), -1)


class SlabPoints:
    r"""Points of a tilted slab of random thickness, seen through a window of the image.

    Thin slabs model façades and thick slabs model courtyards. Each problem draws a distance :math:`d`, slopes
    :math:`g`, a thickness :math:`e`, and a window with the centre :math:`c`. Each point has a uniform direction
    :math:`p = (x/z, y/z)` in the window. The depth of the point is :math:`z = d\,(1 + g \cdot (p - c))(1 + e\,u)` with
    :math:`u` uniform in [0, 1).
    """

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """See :class:`PointPrior`."""
        half = uniform((batch_size, 1, 2), *_SLAB_WINDOW, generator)
        centre = (_SLAB_TANGENT - half) * uniform((batch_size, 1, 2), -1.0, 1.0, generator)
        direction = centre + half * uniform((batch_size, n, 2), -1.0, 1.0, generator)
        rise = _TILT * normal((batch_size, 1, 2), generator) * (direction - centre)  # (B, n, 2)
        surface = (1.0 + (rise[..., 0] + rise[..., 1])).clamp(min=_LEAST_SURFACE)
        thickness = log_uniform((batch_size, 1), *_THICKNESS, generator)
        layer = 1.0 + thickness * unit((batch_size, n), generator)
        z = log_uniform((batch_size, 1), *_SLAB_DISTANCE, generator) * surface * layer  # (B, n)
        return pad(direction, (0, 1), value=1.0) * z[..., None]


class ObjectPoints:
    """Points of an object with random proportions, rotation, direction and distance.

    The object is a cube of side 2 or a Gaussian cloud with a standard deviation of 0.5. Random factors make the object
    thinner along two axes. Some objects are planar.
    """

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """See :class:`PointPrior`."""
        box = uniform((batch_size, n, 3), -1.0, 1.0, generator)
        ball = 0.5 * normal((batch_size, n, 3), generator)
        is_box = unit((batch_size, 1, 1), generator) < 0.5
        factors = log_uniform((batch_size, 1, 3), _THINNEST, 1.0, generator)
        factors[..., 0] = 1.0
        factors[..., 2] *= unit((batch_size, 1), generator) >= _PLANAR
        turn = random_poses(batch_size, generator, max_angle=math.pi).rotation
        points = (torch.where(is_box, box, ball) * factors) @ turn.mT
        tangents = uniform((batch_size, 1, 2), -_OBJECT_TANGENT, _OBJECT_TANGENT, generator)
        distance = log_uniform((batch_size, 1, 1), *_OBJECT_DISTANCE, generator)
        return points + distance * pad(tangents, (0, 1), value=1.0)


class _View:
    """Points on surfaces, seen through a random window of an image. For the arguments see :class:`FacadePoints`."""

    def __init__(self, *, field_of_view: Range = (15.0, 120.0), window: Range = (0.1, 1.0)) -> None:
        check_ranges(field_of_view=field_of_view, window=window)
        check_numbers(0.0, _WIDEST, field_of_view=field_of_view[1])
        check_numbers(0.0, 1.0, window=window[1])
        self.field_of_view, self.window = field_of_view, window

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        angle = uniform((batch_size, 1, 1), *self.field_of_view, generator).deg2rad_()
        area = log_uniform((batch_size, 1, 1), *self.window, generator)
        split = uniform((batch_size, 1, 1), 0.25, 0.75, generator)  # shape of the window: wide, square or high
        size = torch.cat((area**split, area ** (1.0 - split)), -1)  # (B, 1, 2)
        centre = (1.0 - size) * uniform((batch_size, 1, 2), -1.0, 1.0, generator)
        tangents = (angle / 2).tan() * (centre + size * uniform((batch_size, n, 2), -1.0, 1.0, generator))
        rays = pad(tangents, (0, 1), value=1.0)
        return rays * self._depth(rays, generator)[..., None]

    def _depth(self, rays: Tensor, generator: torch.Generator) -> Tensor:
        """Draw the depth of a point on each ray, (B, n). The third coordinate of ``rays``, (B, n, 3), is 1."""
        raise NotImplementedError


class FacadePoints(_View):
    """Points of one façade with relief, or of two such façades that meet at a corner.

    Each façade is a plane that is turned away from the camera by a random angle. The relief is a random depth. About
    half of the points lie deeper by the relief, like points in recesses. All depths also get normal noise with a
    standard deviation of a tenth of the relief.

    Args:
        field_of_view: range, in degrees, from which the field of view of the square image is drawn uniformly.
        window: range of the window's share of the image area, drawn log-uniformly. All points lie in the window.
    """

    def _depth(self, rays: Tensor, generator: torch.Generator) -> Tensor:
        batch_size, n, _ = rays.shape
        slant = uniform((batch_size, 2, 1), 0.0, math.radians(_SLANT), generator)
        turn = uniform((batch_size, 2, 1), -math.pi, math.pi, generator)
        normals = torch.cat((slant.sin() * turn.cos(), slant.sin() * turn.sin(), slant.cos()), -1)  # (B, 2, 3)
        facing = (rays @ normals.mT / slant.cos().mT).clamp(min=_LEAST_FACING)  # (B, n, 2)
        two = unit((batch_size, 1), generator) < _CORNER
        outward = unit((batch_size, 1), generator) < 0.5
        corner = torch.where(outward, facing.amin(-1), facing.amax(-1))
        z = log_uniform((batch_size, 1), *_FACADE_DISTANCE, generator) / torch.where(two, corner, facing[..., 0])
        step = (unit((batch_size, n), generator) < 0.5) + 0.1 * normal((batch_size, n), generator)
        relief = log_uniform((batch_size, 1), *_RELIEF, generator)
        return z * (1.0 + relief * step).clamp(min=_LEAST_SURFACE)


class RoomPoints(_View):
    """Points of a room seen from inside: floor, ceiling, walls and pieces of furniture.

    The room is a box. The camera has a random rotation and a random position that is not close to a wall. Each piece of
    furniture is a box that hides the wall behind it. For the arguments see :class:`FacadePoints`.
    """

    def _depth(self, rays: Tensor, generator: torch.Generator) -> Tensor:
        batch_size = len(rays)
        turn = random_poses(batch_size, generator, max_angle=math.pi).rotation
        ground = log_uniform((batch_size, 1, 2), *_ROOM_SIDE, generator)
        size = torch.cat((ground, uniform((batch_size, 1, 1), *_ROOM_HEIGHT, generator)), -1)  # (B, 1, 3)
        low = -size * uniform((batch_size, 1, 3), 0.15, 0.85, generator)  # a corner of the room, relative to the camera
        in_room = rays @ turn.mT
        z = _hits(in_room, low, low + size)[1]
        # Furniture stands on the floor. A piece that contains the camera has a negative `near` and is left out below.
        shape = batch_size, _FURNITURE, 3
        extent = size * uniform(shape, 0.08, 0.4, generator)
        start = low + (size - extent) * unit(shape, generator)
        start[..., 2] = low[..., 2]
        near, far = _hits(in_room[:, :, None], start[:, None], (start + extent)[:, None])  # (B, n, furniture) each
        for hit in torch.where(near < far, near, math.inf).unbind(-1):
            z = torch.where((hit > _NEAREST * z) & (hit < z), hit, z)
        return z


class DrivePoints(_View):
    """Points seen from a car: the road, the house fronts on both sides and the end of the street.

    The camera looks approximately along the street. Some points are closer than the surface behind them, as points on
    cars and trees are. For the arguments see :class:`FacadePoints`.
    """

    def _depth(self, rays: Tensor, generator: torch.Generator) -> Tensor:
        batch_size, n, _ = rays.shape
        angles = math.radians(_YAW) * normal((batch_size, 3), generator)
        turn = axis_angle_to_rotation_matrix(angles * angles.new_tensor((1 / 3, 1.0, 1 / 3)))  # pitch, yaw, roll
        left, right = log_uniform((2, batch_size, 1), *_STREET_SIDE, generator)
        height = log_uniform((batch_size, 1), *_CAMERA_HEIGHT, generator)
        end = log_uniform((batch_size, 1), *_STREET_END, generator)
        low = torch.stack((-left, torch.full_like(left, -_NOWHERE), -end), -1)  # (B, 1, 3), y points down
        z = _hits(rays @ turn.mT, low, torch.stack((right, height, end), -1))[1]
        is_nearer = unit((batch_size, n), generator) < _NEARER
        return torch.where(is_nearer, z * uniform((batch_size, n), 0.3, 1.0, generator), z)


def _hits(rays: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Find at which multiples ``rays``, (..., 3), enter and leave a box. If enter >= leave, a ray misses the box."""
    one, two = low / rays, high / rays
    return torch.minimum(one, two).amax(-1), torch.maximum(one, two).amin(-1)


@dataclass(kw_only=True, eq=False)
class DepthMaps:
    r"""Errors of world points that several depth cameras have measured.

    Each world point comes from the depth map of one of ``maps`` cameras near the query camera. Three errors occur:

    - noise along the ray of the map camera. At the distance :math:`d` from the map camera, the standard deviation is
      :math:`a d^2 / \bar d`, where :math:`\bar d` is the mean distance of the points from the query camera. As with
      stereo cameras and structured light, the noise grows with the square of the distance.
    - the error of the map camera's rotation. This error turns all points of one map about the map camera.
    - *flying pixels*: at the edge of an object, the measured distance lies between the object and the background. Pairs
      with a flying pixel are outliers.

    Args:
        depth_noise: range of :math:`a`, the relative standard deviation at the distance :math:`\bar d`. Each problem
            draws a log-uniform number.
        angle: range of the standard deviation, in degrees, of a map camera's rotation error about each axis. Each
            problem draws a log-uniform number.
        flying_share: probability that a point is a flying pixel.
        maps: number of map cameras of a problem.
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
        """Draw the displacements of points in the query camera's frame, (B, N, 3), float64.

        Also return whether each point is a flying pixel, bool, (B, N, 1).
        """
        batch_size, n, _ = cam_points.shape
        each, one = (batch_size, n, 1), (batch_size, 1, 1)
        size = cam_points.norm(dim=-1).mean(1)[:, None, None]  # (B, 1, 1)
        centre = _BASELINE * size * normal((batch_size, self.maps, 3), generator)
        turn = log_uniform(one, *self.angle, generator).deg2rad() * normal(centre.shape, generator)
        of_map = (self.maps * unit(each, generator)).long()
        ray = cam_points - centre.take_along_dim(of_map, 1)
        sigma = log_uniform(one, *self.depth_noise, generator)
        change = sigma * ray.norm(dim=-1, keepdim=True) / size * normal(each, generator)  # in units of `ray`
        is_flying = unit(each, generator) < self.flying_share
        change = torch.where(is_flying, uniform(each, *_FLIGHT, generator), change)
        return change * ray + torch.linalg.cross(turn.take_along_dim(of_map, 1), ray), is_flying
