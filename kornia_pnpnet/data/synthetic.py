"""The protocol's random problems, as an endless, seeded iterable of batches."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from kornia_pnpnet.data.outliers import OutlierMix
from kornia_pnpnet.types import Pose, Problems

__all__ = [
    "BoxPoints",
    "MixedPoints",
    "PointPrior",
    "SlabPoints",
    "SyntheticProblems",
    "batch_generator",
    "random_poses",
    "uniform",
]


def batch_generator(seed: int, index: int, device: str | torch.device = "cpu") -> torch.Generator:
    """A generator for batch ``index`` of the stream ``seed``, the same on every call.

    The two numbers are hashed because CPU generators only use 32 bits of their seed.
    """
    state = int(np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1, np.uint64)[0])
    return torch.Generator(device).manual_seed(state >> 1)


def uniform(shape: Sequence[int], low: float, high: float, generator: torch.Generator) -> Tensor:
    """Uniform float64 numbers in ``[low, high)`` of a shape, on the generator's device."""
    values = torch.rand(tuple(shape), generator=generator, device=generator.device, dtype=torch.float64)
    return values.mul_(high - low).add_(low)


def _normal(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    return torch.randn(tuple(shape), generator=generator, device=generator.device, dtype=torch.float64)


def random_poses(
    batch_size: int,
    generator: torch.Generator,
    *,
    translation_box: float = 25.0,
    translation_sigma: float | None = None,
    max_angle: float = math.pi / 2,
) -> Pose:
    r"""Draw world-to-camera poses as the protocol does.

    Args:
        batch_size: how many.
        generator: source of randomness; the poses are on its device.
        translation_box: side of the box centred at 0 in which the translation is uniform.
        translation_sigma: draw the translation from a normal distribution with this standard deviation on each axis
            instead.
        max_angle: the angle is uniform from 0 to this many radians, the axis uniform in direction.

    Returns:
        Poses in float64.
    """
    axis = torch.nn.functional.normalize(_normal((batch_size, 3), generator), dim=-1)
    angle = uniform((batch_size, 1), 0.0, max_angle, generator)
    if translation_sigma is None:
        translation = uniform((batch_size, 3), -translation_box / 2, translation_box / 2, generator)
    else:
        translation = translation_sigma * _normal((batch_size, 3), generator)
    return Pose(axis_angle_to_rotation_matrix(axis * angle), translation)


class PointPrior(Protocol):
    """Draws points in the camera frame, shape ``(batch_size, n, 3)``, float64."""

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """Draw the points."""
        ...


class BoxPoints:
    r"""The protocol's points: uniform in a box in front of the camera, in its frame.

    Args:
        half_width: :math:`|x|` and :math:`|y|` are at most this.
        z_near: depth of the box's near face.
        depth: length of the box along the optical axis.
    """

    def __init__(self, *, half_width: float = 10.0, z_near: float = 10.0, depth: float = 80.0) -> None:
        self.half_width = half_width
        self.z_near = z_near
        self.depth = depth

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """Draw points of shape ``(batch_size, n, 3)``."""
        xy = uniform((batch_size, n, 2), -self.half_width, self.half_width, generator)
        z = uniform((batch_size, n, 1), self.z_near, self.z_near + self.depth, generator)
        return torch.cat((xy, z), -1)


class SlabPoints:
    r"""Points as photographs show them: a tilted slab of any thickness, seen through a window of the image.

    A façade fills part of the image and is thin, a courtyard is deep; a box along the optical axis is neither.
    For each problem a window, a distance, a tilt and a thickness are drawn; each point takes a uniform direction in the
    window and a depth in the slab, :math:`z = d (1 + g_x x/z + g_y y/z)(1 + e\,u)` with :math:`u` uniform.

    Args:
        window: smallest and largest half-size of the window as tangents of the viewing angle, uniform for each axis.
        field_of_view: the window lies within this tangent on both axes.
        distance: smallest and largest distance :math:`d`, log-uniform.
        tilt: standard deviation of the slopes :math:`g`.
        thickness: smallest and largest thickness :math:`e` relative to the distance, log-uniform.
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

        def log_uniform(low: float, high: float) -> Tensor:
            return uniform((batch_size, 1), math.log(low), math.log(high), generator).exp()

        slope = self.tilt * _normal((batch_size, 1, 2), generator)
        rise = slope * (direction - centre)  # (B, n, 2)
        surface = (1.0 + (rise[..., 0] + rise[..., 1])).clamp(min=0.3)
        thickness = 1.0 + log_uniform(*self.thickness) * uniform((batch_size, n), 0.0, 1.0, generator)
        z = log_uniform(*self.distance) * surface * thickness  # (B, n)
        return torch.cat((direction * z[..., None], z[..., None]), -1)


class MixedPoints:
    """Each problem's points from one of several priors, chosen at random.

    Args:
        priors: what to choose from.
        shares: how often each is chosen, relative to the others; equally when ``None``.

    Raises:
        BaseError: when the shares do not fit the priors or are not positive.
    """

    def __init__(self, priors: Sequence[PointPrior], *, shares: Sequence[float] | None = None) -> None:
        shares = [1.0] * len(priors) if shares is None else list(shares)
        KORNIA_CHECK(
            len(shares) == len(priors) > 0 and min(shares) > 0,
            f"MixedPoints needs one positive share for each prior, got {shares} for {len(priors)} priors.",
        )
        self.priors = list(priors)
        self.shares = shares

    def __call__(self, batch_size: int, n: int, generator: torch.Generator) -> Tensor:
        """Draw points of shape ``(batch_size, n, 3)``."""
        draws = [prior(batch_size, n, generator) for prior in self.priors]
        bounds = torch.tensor(self.shares, dtype=torch.float64, device=generator.device).cumsum(0)
        position = bounds[-1] * uniform((batch_size,), 0.0, 1.0, generator)
        points = draws[0]
        for draw, bound in zip(draws[1:], bounds[:-1], strict=True):  # the last prior whose share begins below
            points = torch.where((position >= bound)[:, None, None], draw, points)
        return points


class SyntheticProblems:
    r"""Random problems of the protocol, endless and reproducible: batch ``i`` depends on ``seed`` and ``i`` alone.

    A pose is drawn, points are drawn in the camera frame and moved to the world by the inverse pose; both the world
    coordinates and the pixels get Gaussian noise; some pairs are spoilt. The defaults are the protocol's ``paper``
    distribution; ``gaussian_pose`` is ``translation_sigma=25`` and ``fixed_mismatches`` is
    ``outliers=OutlierMix(count=k, mismatch_share=1.0)``.

    Args:
        n: pairs per problem.
        batch_size: problems per batch.
        seed: of the stream.
        points: draws the points in the camera frame; the protocol's box when ``None``.
        outliers: how many pairs are wrong and how; none when ``None``.
        translation_box: side of the box of translations.
        translation_sigma: normal translations with this standard deviation instead.
        max_angle: largest rotation angle in radians.
        focal: focal length in pixels; the principal point is 0.
        half_image: pixels of *sensing* outliers are uniform in ``[-half_image, half_image]`` on both axes.
        img_sigma: standard deviation of the noise on each pixel coordinate.
        world_sigma: standard deviation of the noise on each world coordinate.
        dtype: of the batches; everything is drawn in float64 first.
        device: of the batches.

    Example:
        >>> problems = SyntheticProblems(n=9, batch_size=2, seed=1, outliers=OutlierMix(count=3)).batch(0)
        >>> problems.world_points.shape, problems.inliers.sum(-1)
        (torch.Size([2, 9, 3]), tensor([6, 6]))
    """

    def __init__(
        self,
        *,
        n: int = 9,
        batch_size: int = 1000,
        seed: int = 0,
        points: PointPrior | None = None,
        outliers: OutlierMix | None = None,
        translation_box: float = 25.0,
        translation_sigma: float | None = None,
        max_angle: float = math.pi / 2,
        focal: float = 3400.0,
        half_image: float = 3400.0,
        img_sigma: float = 1.0,
        world_sigma: float = 0.05,
        dtype: torch.dtype = torch.float32,
        device: str | torch.device = "cpu",
    ) -> None:
        KORNIA_CHECK(n >= 1 and batch_size >= 1, f"n and batch_size must be at least 1, got {n} and {batch_size}.")
        self.n = n
        self.batch_size = batch_size
        self.seed = seed
        self.points = BoxPoints() if points is None else points
        self.outliers = OutlierMix(count=0) if outliers is None else outliers
        self.translation_box = translation_box
        self.translation_sigma = translation_sigma
        self.max_angle = max_angle
        self.focal = focal
        self.half_image = half_image
        self.img_sigma = img_sigma
        self.world_sigma = world_sigma
        self.dtype = dtype
        self.device = torch.device(device)

    def __iter__(self) -> Iterator[Problems]:
        """Yield batch 0, 1, 2, … without end."""
        index = 0
        while True:
            yield self.batch(index)
            index += 1

    def batch(self, index: int) -> Problems:
        r"""Draw batch ``index``.

        Args:
            index: at least 0.

        Returns:
            The problems; pose, points and pixels in ``dtype`` on ``device``.
        """
        generator = batch_generator(self.seed, index, self.device)
        pose = random_poses(
            self.batch_size,
            generator,
            translation_box=self.translation_box,
            translation_sigma=self.translation_sigma,
            max_angle=self.max_angle,
        )
        # Mismatches show other points of the same scene, so both are drawn at once.
        cam_points, other_points = self.points(self.batch_size, 2 * self.n, generator).chunk(2, 1)
        draw = self.outliers.draw(self.batch_size, self.n, generator)
        anywhere = uniform((self.batch_size, self.n, 2), -self.half_image, self.half_image, generator)

        world_points = (cam_points - pose.translation[:, None]) @ pose.rotation
        world_points += _normal(world_points.shape, generator).mul_(self.world_sigma)
        seen = torch.where(draw.mismatch[..., None], other_points, cam_points)
        img_points = self.focal * seen[..., :2] / seen[..., 2:]
        img_points = torch.where(draw.sensing[..., None], anywhere, img_points)
        img_points += _normal(img_points.shape, generator).mul_(self.img_sigma)
        intrinsics = torch.diag(img_points.new_tensor((self.focal, self.focal, 1.0))).expand(self.batch_size, 3, 3)
        return Problems(
            world_points.to(self.dtype),
            img_points.to(self.dtype),
            intrinsics.to(self.dtype),
            Pose(pose.rotation.to(self.dtype), pose.translation.to(self.dtype)),
            draw.inliers,
        )
