"""Synthetic problems: an endless, seeded source of batches, made of points, noise and outliers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import count

import torch
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_positive, check_whole
from kornia_pnpnet.data.draws import batch_generator, random_poses, uniform
from kornia_pnpnet.data.noise import checked_sigma, draw_noise, hide_sigmas
from kornia_pnpnet.data.outliers import OutlierMix, near_offsets, structured_points
from kornia_pnpnet.data.points import BoxPoints, PointPrior
from kornia_pnpnet.types import Problems

__all__ = ["SyntheticProblems"]

# A camera sees a point when the cosine between its direction and the optical axis is larger. A choice: 87 degrees.
_LEAST_COSINE = 0.05


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
        half_image: pixels of *sensing* outliers are uniform in ``[-half_image, half_image]`` on both axes.
        img_sigma: standard deviation of the noise on each pixel coordinate, or a range from which each problem draws
            one, log-uniform.
        world_sigma: standard deviation of the noise on each world coordinate, or a range.
        known_noise: share of the problems that come with both sigmas. A third of the other problems come with one of
            them; unknown sigmas are NaN.
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
        self.img_sigma = checked_sigma("img_sigma", img_sigma)
        self.world_sigma = checked_sigma("world_sigma", world_sigma)
        self.known_noise = known_noise
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
        cam_points, other_points = self.points(self.batch_size, 2 * self.n, generator).chunk(2, 1)
        draw = self.outliers.draw(self.batch_size, self.n, generator)
        anywhere = uniform((self.batch_size, self.n, 2), -self.half_image, self.half_image, generator)

        world_points = (cam_points - pose.translation[:, None]) @ pose.rotation
        noise, world_sigma = draw_noise(world_points.shape, self.world_sigma, generator)
        world_points += noise
        seen = torch.where(draw.mismatch[..., None], other_points, cam_points)
        if draw.structured is not None:
            seen = torch.where(draw.structured[..., None], structured_points(cam_points, generator), seen)
        # A point that is not in front of the camera has no pixel: its pair is an outlier.
        behind = seen[..., 2] <= _LEAST_COSINE * seen.norm(dim=-1)
        seen = torch.where(behind[..., None], torch.ones_like(seen), seen)
        img_points = self.focal * seen[..., :2] / seen[..., 2:]
        img_points = torch.where((draw.sensing | behind)[..., None], anywhere, img_points)
        noise, img_sigma = draw_noise(img_points.shape, self.img_sigma, generator)
        img_points += noise
        if draw.near is not None:
            img_points += torch.where(draw.near[..., None], near_offsets(img_sigma, self.n, generator), 0.0)
        sigmas: dict[str, Tensor] = {}
        if self.known_noise:
            img_sigma, world_sigma = hide_sigmas(img_sigma, world_sigma, self.known_noise, generator)
            sigmas = {"img_sigma": img_sigma, "world_sigma": world_sigma}
        intrinsics = torch.diag(img_points.new_tensor((self.focal, self.focal, 1.0))).expand(self.batch_size, 3, 3)
        problems = Problems(world_points, img_points, intrinsics, pose, draw.inliers & ~behind, **sigmas)
        return problems.map(lambda x: x.to(self.dtype) if x.is_floating_point() else x)
