"""The protocol's random problems, as an endless, seeded iterable of batches."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from kornia_pnpnet.data.outliers import OutlierMix
from kornia_pnpnet.types import Pose, Problems

__all__ = [
    "BoxPoints",
    "MixedProblems",
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


def _log_uniform(shape: Sequence[int], low: float, high: float, generator: torch.Generator) -> Tensor:
    return uniform(shape, math.log(low), math.log(high), generator).exp_()


def _noise(shape: Sequence[int], sigma: float | Sequence[float], generator: torch.Generator) -> Tensor:
    """Normal noise of one standard deviation, or for each problem of one from a range, log-uniform."""
    noise = _normal(shape, generator)
    if isinstance(sigma, int | float):
        return noise.mul_(sigma)
    low, high = sigma
    return noise.mul_(_log_uniform((shape[0], *(1,) * (len(shape) - 1)), low, high, generator))


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
        slope = self.tilt * _normal((batch_size, 1, 2), generator)
        rise = slope * (direction - centre)  # (B, n, 2)
        surface = (1.0 + (rise[..., 0] + rise[..., 1])).clamp(min=0.3)
        thickness = _log_uniform((batch_size, 1), *self.thickness, generator)
        layer = 1.0 + thickness * uniform((batch_size, n), 0.0, 1.0, generator)
        z = _log_uniform((batch_size, 1), *self.distance, generator) * surface * layer  # (B, n)
        return torch.cat((direction * z[..., None], z[..., None]), -1)


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
        img_sigma: standard deviation of the noise on each pixel coordinate; or the smallest and the largest, for each
            problem another, log-uniform.
        world_sigma: likewise of the noise on each world coordinate.
        dtype: of the batches; everything is drawn in float64 first.
        device: of the batches.

    Raises:
        BaseError: for a size below 1, or a range of noise that is not of two positive, rising numbers.

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
        img_sigma: float | Sequence[float] = 1.0,
        world_sigma: float | Sequence[float] = 0.05,
        dtype: torch.dtype = torch.float32,
        device: str | torch.device = "cpu",
    ) -> None:
        KORNIA_CHECK(n >= 1 and batch_size >= 1, f"n and batch_size must be at least 1, got {n} and {batch_size}.")
        for name, sigma in (("img_sigma", img_sigma), ("world_sigma", world_sigma)):
            right = sigma >= 0 if isinstance(sigma, int | float) else len(sigma) == 2 and 0 < sigma[0] <= sigma[1]
            KORNIA_CHECK(right, f"{name} must be at least 0, or a range of two positive numbers, got {sigma}.")
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
        world_points += _noise(world_points.shape, self.world_sigma, generator)
        seen = torch.where(draw.mismatch[..., None], other_points, cam_points)
        img_points = self.focal * seen[..., :2] / seen[..., 2:]
        img_points = torch.where(draw.sensing[..., None], anywhere, img_points)
        img_points += _noise(img_points.shape, self.img_sigma, generator)
        intrinsics = torch.diag(img_points.new_tensor((self.focal, self.focal, 1.0))).expand(self.batch_size, 3, 3)
        return Problems(
            world_points.to(self.dtype),
            img_points.to(self.dtype),
            intrinsics.to(self.dtype),
            Pose(pose.rotation.to(self.dtype), pose.translation.to(self.dtype)),
            draw.inliers,
        )


class MixedProblems:
    """Batches of problems from several sources, in turns.

    Args:
        sources: each makes a :class:`SyntheticProblems` from ``batch_size``, ``seed`` and ``options``, such as the
            class itself or a :func:`functools.partial` of it.
        shares: how much of a batch each fills, relative to the others; equal parts when ``None``.
        batch_size: problems per batch.
        seed: of the stream.
        options: of all sources.

    Raises:
        BaseError: when the shares do not fit the sources or are not positive.

    Example:
        >>> from functools import partial
        >>> source = MixedProblems(
        ...     [SyntheticProblems, partial(SyntheticProblems, points=SlabPoints())], batch_size=5, n=4
        ... )
        >>> source.batch(0).world_points.shape
        torch.Size([5, 4, 3])
    """

    def __init__(
        self,
        sources: Sequence[Callable[..., SyntheticProblems]],
        *,
        shares: Sequence[float] | None = None,
        batch_size: int = 1000,
        seed: int = 0,
        **options: Any,
    ) -> None:
        shares = [1.0] * len(sources) if shares is None else list(shares)
        KORNIA_CHECK(
            len(shares) == len(sources) > 0 and min(shares) > 0,
            f"MixedProblems needs one positive share for each source, got {shares} for {len(sources)} sources.",
        )
        self.batch_size = batch_size
        bounds = [round(batch_size * sum(shares[:i]) / sum(shares)) for i in range(len(shares) + 1)]
        sizes = [end - start for start, end in pairwise(bounds)]
        made = [
            source(batch_size=size, seed=seed, **options) for source, size in zip(sources, sizes, strict=True) if size
        ]
        self.sources = made
        # A source of more problems has more turns; the first problems of a batch are as mixed as all of them.
        turns = [(turn + 0.5) / size for size in sizes for turn in range(size)]
        self._order = torch.tensor(sorted(range(batch_size), key=turns.__getitem__))

    def batch(self, index: int) -> Problems:
        """Draw batch ``index``.

        Args:
            index: at least 0.

        Returns:
            The problems.
        """
        count = len(self.sources)  # no two sources see the same random numbers
        parts = [source.batch(count * index + i) for i, source in enumerate(self.sources)]
        world_points, img_points, intrinsics, poses, inliers = zip(*parts, strict=True)
        pose = Pose(*(torch.cat(entries) for entries in zip(*poses, strict=True)))
        problems = Problems(
            torch.cat(world_points), torch.cat(img_points), torch.cat(intrinsics), pose, torch.cat(inliers)
        )
        order = self._order.to(problems.inliers.device)
        return problems.map(lambda x: x[order])
