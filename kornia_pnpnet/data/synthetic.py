"""Synthetic problems: an endless, seeded source of batches, made of points, noise and outliers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import count
from typing import Any

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_positive, check_whole
from kornia_pnpnet.data.draws import batch_generator, random_poses, uniform
from kornia_pnpnet.data.noise import (
    LEAST_DEGREES,
    MOST_NOISE,
    MOST_RATIO,
    MOST_SPREAD,
    checked_sigma,
    draw_confidence,
    draw_noise,
    hide_sigmas,
    stretched,
)
from kornia_pnpnet.data.outliers import OutlierMix, crowd_leaders, near_offsets, structured_points
from kornia_pnpnet.data.points import BoxPoints, PointPrior
from kornia_pnpnet.result import Problems

__all__ = ["SyntheticProblems"]

# Pixels. Noise of no size divides by this.
_TINY = 1e-9
# A camera sees a point when the cosine between its direction and the optical axis is larger. A choice: 87 degrees.
_LEAST_COSINE = 0.05
# Half the side of the widest image at a focal length of 1, so that objects next to the camera fit into an image.
_WIDEST_TANGENT = math.tan(math.radians(60.0))
# Mean distances between points in the image. A choice: bunches are sharp to hardly visible.
_MOST_BLUR = 2.0


class SyntheticProblems:
    r"""Random problems of the protocol, endless and reproducible: batch ``i`` depends on ``seed`` and ``i`` alone.

    Points are drawn in the camera's frame, and the inverse of a random pose moves them to the world. World coordinates
    and pixels get Gaussian noise, and some pairs become outliers. The defaults are the protocol's ``paper``
    distribution; ``gaussian_pose`` is ``translation_sigma=25`` and ``fixed_mismatches`` is
    ``outliers=OutlierMix(count=k, mismatch_share=1.0)``.

    Args:
        n: number of pairs per problem.
        batch_size: number of problems per batch.
        seed: seed of the stream.
        points: prior of the points in the camera's frame; the protocol's box when ``None``.
        outliers: number and kinds of outliers; no outliers when ``None``.
        translation_box: side of the box in which translations are uniform.
        translation_sigma: standard deviation of normally distributed translations, which replace the box.
        max_angle: largest rotation angle in radians.
        focal: focal length in pixels; the principal point is 0.
        half_image: pixels of *sensing* outliers are uniform in ``[-half_image, half_image]`` on both axes; ``None``:
            in the smallest such square that holds the pixels of all points of the problem, up to a field of view of
            120°.
        img_sigma: standard deviation of the noise on each pixel coordinate, or a range from which each problem draws
            one, log-uniform.
        world_sigma: standard deviation of the noise on each world coordinate, or a range.
        degrees: degrees of freedom of the pixel noise's Student distribution, at least 1, or a range from which each
            problem draws one, log-uniform. 0: Gaussian noise. ``img_sigma`` is the standard deviation of the bulk; a
            pair with noise above 10 of it is called an outlier.
        sigma_spread: the sigmas of a problem's pairs are log-normal about those of the problem, with this standard
            deviation of the logarithm, at most 3, or a range as for ``degrees``. Known sigmas are then those of each
            pair, shape ``(batch_size, n)``.
        axis_ratio: largest over smallest standard deviation of the noise of each pixel and of each point, along random
            axes that differ between pairs. Above 1, ``img_sigma`` and ``world_sigma`` are the root mean square over the
            axes, at most 100, and known noise is covariances, of all problems or of none.
        known_noise: share of the problems that come with both sigmas. A third of the other problems come with one of
            them; unknown sigmas are NaN.
        confidence_share: share of the problems that come with confidences, see
            ``data.noise.draw_confidence``.
        bunched_share: share of the problems whose inliers are bunched in a part of the image; the points and pixels of
            outliers, but for *near* and *structured* ones, come from the rest of the scene.
        dtype: dtype of the batches; numbers are drawn in float64 and cast.
        device: device of the batches.

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
        half_image: float | None = 3400.0,
        img_sigma: float | Sequence[float] = 1.0,
        world_sigma: float | Sequence[float] = 0.05,
        degrees: float | Sequence[float] = 0.0,
        sigma_spread: float | Sequence[float] = 0.0,
        axis_ratio: float = 1.0,
        known_noise: float = 0.0,
        confidence_share: float = 0.0,
        bunched_share: float = 0.0,
        dtype: torch.dtype = torch.float32,
        device: str | torch.device = "cpu",
    ) -> None:
        check_whole(1, n=n, batch_size=batch_size)
        check_whole(0, seed=seed)
        check_numbers(0.0, translation_box=translation_box, max_angle=max_angle)
        check_positive(focal=focal)
        check_numbers(0.0, 1.0, known_noise=known_noise, bunched_share=bunched_share)
        check_numbers(0.0, 1.0, confidence_share=confidence_share)
        if half_image is not None:
            check_numbers(0.0, half_image=half_image)
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
        self.img_sigma = checked_sigma("img_sigma", img_sigma)
        self.world_sigma = checked_sigma("world_sigma", world_sigma)
        self.degrees = checked_sigma("degrees", degrees, LEAST_DEGREES)
        self.sigma_spread = checked_sigma("sigma_spread", sigma_spread, 0.0, MOST_SPREAD)
        check_numbers(1.0, MOST_RATIO, axis_ratio=axis_ratio)
        KORNIA_CHECK(
            axis_ratio == 1.0 or known_noise in (0.0, 1.0),
            f"Covariances are known for all problems or for none, got known_noise={known_noise}.",
        )
        self.axis_ratio = axis_ratio
        self.known_noise = known_noise
        self.confidence_share = confidence_share
        self.bunched_share = bunched_share
        self.dtype = dtype
        self.device = torch.device(device)

    def __iter__(self) -> Iterator[Problems]:
        """Yield batch 0, 1, 2, … without end."""
        return map(self.batch, count())

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
        scene = self.points(self.batch_size, 2 * self.n, generator)
        draw = self.outliers.draw(self.batch_size, self.n, generator)
        anywhere = self._anywhere(scene, generator)
        if self.bunched_share:
            scene = _bunched(scene, draw.displaced, self.bunched_share, generator)
        cam_points, other_points = scene.chunk(2, 1)

        world_points = (cam_points - pose.translation[:, None]) @ pose.rotation
        noise, world_sigma = draw_noise(world_points.shape, self.world_sigma, generator, spread=self.sigma_spread)
        covariances = {}
        if self.axis_ratio > 1.0:
            noise, shape = stretched(noise, self.axis_ratio, generator)
            covariances["world_cov"] = shape * world_sigma.reshape(self.batch_size, -1, 1, 1).square()
        world_points += noise
        is_other = draw.mismatch if draw.crowd is None else draw.mismatch | draw.crowd
        seen = torch.where(is_other[..., None], other_points, cam_points)
        if draw.structured is not None:
            mix = self.outliers
            moved = structured_points(
                cam_points, generator, max_angle=mix.structured_angle, mirrored_share=mix.mirrored_share
            )
            seen = torch.where(draw.structured[..., None], moved, seen)
        # A point that is not in front of the camera has no pixel: its pair is an outlier.
        behind = ~_is_in_front(seen)
        seen = torch.where(behind[..., None], torch.ones_like(seen), seen)
        img_points = self.focal * seen[..., :2] / seen[..., 2:]
        img_points = torch.where((draw.sensing | behind)[..., None], anywhere, img_points)
        noise, img_sigma = draw_noise(
            img_points.shape, self.img_sigma, generator, spread=self.sigma_spread, degrees=self.degrees
        )
        if self.axis_ratio > 1.0:
            noise, shape = stretched(noise, self.axis_ratio, generator)
            covariances["img_cov"] = shape * img_sigma.reshape(self.batch_size, -1, 1, 1).square()
        img_points += noise
        inliers = draw.inliers & ~behind
        if self.degrees:
            inliers &= noise.norm(dim=-1) <= MOST_NOISE * img_sigma.reshape(self.batch_size, -1)
        if draw.near is not None:
            offsets = near_offsets(img_sigma, self.n, generator, self.outliers.near_pixels)
            img_points += torch.where(draw.near[..., None], offsets, 0.0)
        if draw.crowd is not None:
            leader = crowd_leaders(self.batch_size, self.n, self.outliers.max_crowds, generator)[..., None]
            of_pixels, of_points = draw.crowd[..., None], torch.zeros_like(leader, dtype=torch.bool)
            if draw.of_points is not None:
                of_points = of_pixels & draw.of_points[..., None]
            shared = img_points.take_along_dim(leader, 1), world_points.take_along_dim(leader, 1)
            img_points = torch.where(of_pixels & ~of_points, shared[0], img_points)
            world_points = torch.where(of_points, shared[1], world_points)
        known: dict[str, Any] = {}
        errors = noise.norm(dim=-1) / img_sigma.reshape(self.batch_size, -1).mean(1, keepdim=True).clamp(min=_TINY)
        if self.known_noise and covariances:
            known = covariances
        elif self.known_noise:
            img_sigma, world_sigma = hide_sigmas(img_sigma, world_sigma, self.known_noise, generator)
            known = {"img_sigma": img_sigma, "world_sigma": world_sigma}
        if self.confidence_share:
            known["confidence"] = draw_confidence(inliers, errors, self.confidence_share, generator)
        intrinsics = torch.diag(img_points.new_tensor((self.focal, self.focal, 1.0))).expand(self.batch_size, 3, 3)
        problems = Problems(world_points, img_points, intrinsics, pose, inliers, **known)
        return problems.map(lambda x: x.to(self.dtype) if x.is_floating_point() else x)

    def _anywhere(self, scene: Tensor, generator: torch.Generator) -> Tensor:
        """Pixels that are uniform in the image, (B, N, 2)."""
        shape = self.batch_size, self.n, 2
        if self.half_image is not None:
            return uniform(shape, -self.half_image, self.half_image, generator)
        in_front = _is_in_front(scene)[..., None]
        depth = torch.where(in_front, scene[..., 2:], 1.0)
        tangent = torch.where(in_front, scene[..., :2] / depth, 0.0)
        half = self.focal * tangent.abs().amax((1, 2), keepdim=True).clamp(max=_WIDEST_TANGENT)
        return half * uniform(shape, -1.0, 1.0, generator)


def _is_in_front(cam_points: Tensor) -> Tensor:
    """Whether a camera can see each point, (B, N)."""
    return cam_points[..., 2] > _LEAST_COSINE * cam_points.norm(dim=-1)


def _bunched(scene: Tensor, displaced: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """The points of each scene, (B, 2N, 3), sorted so that pairs that are not ``displaced``, (B, N), lie together.

    Points are ranked by their angle from one of them, with random numbers of a random size added: bunches differ in how
    sharp they are. In a share of the problems the first points of the ranking go to the pairs that are not displaced.
    """
    batch_size, twice = scene.shape[:2]
    direction = torch.nn.functional.normalize(scene, dim=-1)
    distance = (direction - direction[:, :1]).square().sum(-1).sqrt()
    blur = uniform((batch_size, 1), 0.0, _MOST_BLUR, generator) * uniform((batch_size, twice), 0.0, 1.0, generator)
    score = distance / distance.mean(1, keepdim=True).clamp(min=torch.finfo(distance.dtype).tiny) + blur
    chosen = uniform((batch_size, 1), 0.0, 1.0, generator) < share
    score = torch.where(chosen, score, uniform((batch_size, twice), 0.0, 1.0, generator))
    last = torch.nn.functional.pad(displaced, (0, twice - displaced.shape[1]), value=True)
    # Kept pairs first, in random order: the number of a pair says nothing about its place in the image.
    places = (last + uniform((batch_size, twice), 0.0, 1.0, generator)).argsort(1)
    order = torch.empty_like(places).scatter_(1, places, score.argsort(1))
    return scene.gather(1, order[..., None].expand(-1, -1, 3))
