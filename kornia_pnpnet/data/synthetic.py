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

from kornia_pnpnet.core.checks import check_numbers, check_positive, check_ranges, check_whole
from kornia_pnpnet.data.outliers import OutlierMix
from kornia_pnpnet.types import Pose, Problems

__all__ = [
    "BoxPoints",
    "MixedProblems",
    "ObjectPoints",
    "PointPrior",
    "SlabPoints",
    "SyntheticProblems",
    "VaryingSize",
    "batch_generator",
    "random_poses",
    "uniform",
]


# A pixel that is a little off is off by so many standard deviations, log-uniform.
_NEAR = 5.0, 50.0
# A point has a pixel when the cosine of its direction from the optical axis is more than this.
_LEAST_COSINE = 0.05
# The numbers of pairs are another stream than the problems.
_SIZES = 1_000_003


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


def _sigma(name: str, value: Any) -> float | tuple[float, float]:
    """One standard deviation, or the smallest and the largest, checked."""
    if hasattr(value, "__len__"):
        check_ranges(**{name: value})
        return float(value[0]), float(value[1])
    check_numbers(0.0, **{name: value})
    return float(value)


def _noise(shape: Sequence[int], sigma: float | Sequence[float], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Normal noise, (B, N, ...), of one standard deviation or of one from a range for each problem, and these, (B,)."""
    noise = _normal(shape, generator)
    if isinstance(sigma, float):
        return noise.mul_(sigma), noise.new_full((shape[0],), sigma)
    low, high = sigma
    sigmas = _log_uniform((shape[0], *(1,) * (len(shape) - 1)), low, high, generator)
    return noise.mul_(sigmas), sigmas.flatten()


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

    Raises:
        BaseError: for a box that is not in front of the camera.

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
        slope = self.tilt * _normal((batch_size, 1, 2), generator)
        rise = slope * (direction - centre)  # (B, n, 2)
        surface = (1.0 + (rise[..., 0] + rise[..., 1])).clamp(min=0.3)
        thickness = _log_uniform((batch_size, 1), *self.thickness, generator)
        layer = 1.0 + thickness * uniform((batch_size, n), 0.0, 1.0, generator)
        z = _log_uniform((batch_size, 1), *self.distance, generator) * surface * layer  # (B, n)
        return torch.cat((direction * z[..., None], z[..., None]), -1)


class ObjectPoints:
    r"""Points of an object of any proportions somewhere in the image, near or far.

    The object is an ellipsoid or a box of half-size about 1, thinner by random factors along two of its axes and down
    to a plane, turned at random. It lies in a random direction at a distance that is log-uniform in its half-sizes.

    Args:
        distance: smallest and largest distance of the centre in half-sizes, log-uniform.
        field_of_view: the centre lies within this tangent on both axes.
        thinnest: the smallest factor of an axis, log-uniform up to 1.
        planar: share of problems whose points lie in a plane.

    Raises:
        BaseError: for a range that falls or is not positive, or a share outside [0, 1].

    Example:
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
        ball = 0.5 * _normal((batch_size, n, 3), generator)
        is_box = uniform((batch_size, 1, 1), 0.0, 1.0, generator) < 0.5
        factors = _log_uniform((batch_size, 1, 3), self.thinnest, 1.0, generator)
        factors[..., 0] = 1.0
        flat = uniform((batch_size, 1), 0.0, 1.0, generator) < self.planar
        factors[..., 2] = torch.where(flat, 0.0, factors[..., 2])
        turn = random_poses(batch_size, generator, max_angle=math.pi).rotation
        points = (torch.where(is_box, box, ball) * factors) @ turn.mT
        tangents = uniform((batch_size, 2), -self.field_of_view, self.field_of_view, generator)
        away = _log_uniform((batch_size, 1), *self.distance, generator)
        centre = away * torch.cat((tangents, torch.ones_like(away)), -1)
        return points + centre[:, None]


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
        known_noise: share of the problems that come with both sigmas. A third of the other problems come with one.
        dtype: of the batches; everything is drawn in float64 first.
        device: of the batches.

    Raises:
        BaseError: for a size below 1, a number that is not finite or out of its bounds, or a range of noise that is not
            of two positive, rising numbers.

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
        known_noise: float = 0.0,
        dtype: torch.dtype = torch.float32,
        device: str | torch.device = "cpu",
    ) -> None:
        check_whole(1, n=n, batch_size=batch_size)
        check_whole(0, seed=seed)
        check_numbers(0.0, translation_box=translation_box, max_angle=max_angle, half_image=half_image)
        check_positive(focal=focal)
        check_numbers(0.0, 1.0, known_noise=known_noise)
        if translation_sigma is not None:
            check_numbers(0.0, translation_sigma=translation_sigma)
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
        self.img_sigma = _sigma("img_sigma", img_sigma)
        self.world_sigma = _sigma("world_sigma", world_sigma)
        self.known_noise = known_noise
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
        noise, world_sigma = _noise(world_points.shape, self.world_sigma, generator)
        world_points += noise
        seen = torch.where(draw.mismatch[..., None], other_points, cam_points)
        if draw.structured is not None:
            seen = torch.where(draw.structured[..., None], _moved(cam_points, generator), seen)
        # A point that is not in front of the camera has no pixel: whatever pixel it comes with is wrong.
        behind = seen[..., 2] <= _LEAST_COSINE * seen.norm(dim=-1)
        seen = torch.where(behind[..., None], torch.ones_like(seen), seen)
        img_points = self.focal * seen[..., :2] / seen[..., 2:]
        img_points = torch.where((draw.sensing | behind)[..., None], anywhere, img_points)
        noise, img_sigma = _noise(img_points.shape, self.img_sigma, generator)
        img_points += noise
        if draw.near is not None:
            off = torch.nn.functional.normalize(_normal(img_points.shape, generator), dim=-1)
            off *= _log_uniform((*img_points.shape[:2], 1), *_NEAR, generator) * img_sigma[:, None, None]
            img_points += torch.where(draw.near[..., None], off, 0.0)
        sigmas: tuple[Tensor, ...] = ()
        if self.known_noise:
            chance = uniform((2, self.batch_size), 0.0, 1.0, generator)
            known = self.known_noise
            unknown = chance[0] >= known
            one = unknown & (chance[0] < known + (1.0 - known) / 3.0)
            is_img = chance[1] < 0.5
            hidden = unknown & ~(one & is_img), unknown & ~(one & ~is_img)
            sigmas = tuple(
                torch.where(hide, torch.nan, sigma).to(self.dtype)
                for hide, sigma in zip(hidden, (img_sigma, world_sigma), strict=True)
            )
        intrinsics = torch.diag(img_points.new_tensor((self.focal, self.focal, 1.0))).expand(self.batch_size, 3, 3)
        return Problems(
            world_points.to(self.dtype),
            img_points.to(self.dtype),
            intrinsics.to(self.dtype),
            Pose(pose.rotation.to(self.dtype), pose.translation.to(self.dtype)),
            draw.inliers & ~behind,
            *sigmas,
        )


def _moved(cam_points: Tensor, generator: torch.Generator) -> Tensor:
    """The points of each problem turned about their centre and shifted, (B, n, 3)."""
    batch_size = len(cam_points)
    centre = cam_points.mean(1, keepdim=True)
    size = (cam_points - centre).square().sum(-1).mean(1).sqrt()[:, None, None]
    turn = random_poses(batch_size, generator, max_angle=math.pi).rotation
    shift = 0.5 * size * _normal((batch_size, 1, 3), generator)
    return (cam_points - centre) @ turn.mT + centre + shift


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
        check_whole(1, batch_size=batch_size)
        shares = [1.0] * len(sources) if shares is None else list(shares)
        KORNIA_CHECK(
            len(shares) == len(sources) > 0 and min(shares) > 0 and sum(shares) < math.inf,
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
        world_points, img_points, intrinsics, poses, inliers, *told = zip(*parts, strict=True)
        pose = Pose(*(torch.cat(entries) for entries in zip(*poses, strict=True)))
        sigmas = (None if entries[0] is None else torch.cat(entries) for entries in told)
        problems = Problems(
            torch.cat(world_points), torch.cat(img_points), torch.cat(intrinsics), pose, torch.cat(inliers), *sigmas
        )
        order = self._order.to(problems.inliers.device)
        return problems.map(lambda x: x[order])


class VaryingSize:
    """Batches whose problems have another number of pairs each time, and as many pairs in all.

    Args:
        source: makes a source from ``n``, ``batch_size`` and ``seed``, such as a :func:`functools.partial` of
            :class:`MixedProblems`.
        n: numbers of pairs, one of which each batch takes at random.
        batch_size: problems in a batch of the smallest number of pairs, and in none more.
        seed: of the stream.

    Raises:
        BaseError: when there is no number of pairs, or one below 1.

    Example:
        >>> source = VaryingSize(SyntheticProblems, n=(4, 8), batch_size=6)
        >>> sorted({tuple(source.batch(i).inliers.shape) for i in range(20)})
        [(3, 8), (6, 4)]
    """

    def __init__(
        self,
        source: Callable[..., SyntheticProblems | MixedProblems],
        *,
        n: Sequence[int],
        batch_size: int = 1000,
        seed: int = 0,
    ) -> None:
        KORNIA_CHECK(len(n) > 0, "VaryingSize needs at least one number of pairs.")
        for count in n:
            check_whole(1, n=count, batch_size=batch_size)
        self.batch_size = batch_size
        self.seed = seed
        self.sources = [
            source(n=count, batch_size=max(1, batch_size * min(n) // count), seed=seed + i) for i, count in enumerate(n)
        ]

    def batch(self, index: int) -> Problems:
        """Draw batch ``index``."""
        generator = batch_generator(self.seed + _SIZES, index)
        turn = int(torch.randint(len(self.sources), (), generator=generator))
        return self.sources[turn].batch(index)
