"""Synthetic problems with noise and outliers: the protocol's problems, and problems with random fields of view."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from kornia.core.check import KORNIA_CHECK
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor
from torch.nn.functional import normalize, pad

from kornia_pnpnet.core.checks import are_rising, check_numbers, check_positive, check_ranges, check_whole
from kornia_pnpnet.data.draws import RandomProblems, log_uniform, normal, random_poses, uniform, unit
from kornia_pnpnet.data.outliers import OutlierKind, OutlierMix, crowd_leaders, near_offsets, structured_points
from kornia_pnpnet.data.points import BoxPoints, DepthMaps, PointPrior
from kornia_pnpnet.result import Pose, Problems

__all__ = ["CameraProblems", "SyntheticProblems"]

#: A number, or a range of two numbers. From a range, each problem draws a log-uniform number.
Amount: TypeAlias = float | Sequence[float]

# Smallest and largest value of each amount. Every amount may also be 0. The bounds of `degrees` and `sigma_spread` keep
# noise finite in float32.
_ANY = (0.0, math.inf)
_AMOUNTS = {"img_sigma": _ANY, "world_sigma": _ANY, "degrees": (1.0, math.inf), "sigma_spread": (0.0, 3.0)}
# Largest axis ratio. Up to this ratio, float32 resolves the shortest axis of a covariance.
_MOST_RATIO = 100.0
# Largest pixel noise of an inlier, in units of `img_sigma`. This choice applies to Student noise only.
_MOST_NOISE = 10.0
# Standard deviation, in pixels, that replaces 0 in a division.
_TINY = 1e-9
# Smallest cosine between the optical axis and the ray of a visible point. This choice allows angles up to about 87°.
_LEAST_COSINE = 0.05
# Half the side of the largest image at focal length 1, if `half_image` is `None`. Points may lie outside the image.
_WIDEST_TANGENT = math.tan(math.radians(60.0))
# Number of first pairs of a problem that are never copies. This is a choice: eight pairs can still determine a pose.
_LEAST_ORIGINALS = 8
# Largest blur that `_bunched` adds to relative distances. This is a choice: at 2, a bunch is hardly visible.
_MOST_BLUR = 2.0
# Choices for confidences.
_SEPARATION = (0.0, 4.0)  # mean score of noise-free inliers minus mean score of outliers
_NOISINESS = (0.0, 1.0)  # decrease of an inlier's score when log(1 + noise) grows by 1
_GAIN = (0.3, 3.0)  # factor by which scores are multiplied to get logits
_OFFSET = 1.5  # standard deviation of the random number that is added to all logits of a problem
# `CameraProblems`: smallest and largest mean depth of a problem. The unit of the world is arbitrary.
_NEAREST, _FARTHEST = 2.0, 50.0
# `CameraProblems`: half the side of the square image, in pixels.
_HALF_IMAGE = 1000.0


@dataclass(kw_only=True, eq=False)
class SyntheticProblems(RandomProblems):
    r"""Random, reproducible problems of the paper's protocol: ``seed`` and ``i`` determine batch ``i``.

    Points are drawn in the camera's frame. The inverse of a random pose transforms the points to the world frame. World
    coordinates and pixels get noise, and some pairs become outliers. The defaults give the protocol's distribution
    without outliers. A range is two numbers between which each problem draws a log-uniform number.

    Args:
        n: number of pairs per problem.
        batch_size: number of problems per batch.
        seed: seed of the stream.
        points: prior of the points in the camera's frame. ``None`` means ``BoxPoints()``.
        outliers: number and kinds of outliers. ``None`` means no outliers.
        translation_sigma: standard deviation of each coordinate of normally distributed translations. With
            ``None``, translations are uniform in a cube of side 25 about 0.
        max_angle: largest rotation angle in radians.
        focal: focal length in pixels. The principal point is the pixel (0, 0).
        half_image: half the side, in pixels, of the square image with the centre (0, 0). The pixels of *sensing*
            outliers are uniform in the image. ``None`` means the smallest image that contains the pixels of all points
            of a problem, up to a field of view of 120°.
        img_sigma: standard deviation, in pixels, of the noise on each pixel coordinate, or a range.
        world_sigma: standard deviation of the noise on each world coordinate, or a range.
        degrees: degrees of freedom of Student noise on the pixels, at least 1, or a range. 0 means Gaussian noise. With
            Student noise, ``img_sigma`` is the scale of the distribution. Pairs whose pixel noise exceeds
            ``10 * img_sigma`` are outliers.
        sigma_spread: standard deviation of log(sigma) over the pairs of a problem, at most 3, or a range. With a spread
            above 0, the sigmas of a batch have the shape ``(batch_size, n)``.
        axis_ratio: ratio of the largest to the smallest standard deviation over the axes of a pair's noise, at most
            100. The axes are random. With a ratio above 1, ``img_sigma`` and ``world_sigma`` are root mean squares over
            the axes, covariances replace the sigmas in batches, and ``known_noise`` must be 0 or 1.
        known_noise: share of the problems that have both sigmas. With 0, batches have no sigmas. Otherwise, a third of
            the remaining problems have one of the two sigmas, and missing sigmas are NaN.
        confidence_share: share of the problems that have confidences. The confidences of other problems are NaN. With
            a share of 0, batches have no confidences. Problems differ in how well confidences separate inliers from
            outliers, and in the scale of the confidences' logits.
        bunched_share: share of the problems whose inliers, *near* outliers and *structured* outliers are bunched in one
            part of the image. The points of all other outliers come from the rest of the scene.
        depth_maps: errors of depth cameras. World points get these errors and the noise of ``world_sigma``. Sigmas and
            covariances exclude these errors. ``None`` means no errors of depth cameras.
        copies_share: share of the problems that contain copies of pairs, as if a detector listed a point several times.
            A pair of such a problem is a copy with a probability of at most 0.5. The first 8 pairs are never copies.
        dtype: dtype of the batches. Numbers are drawn in float64.
        device: device of the batches. Numbers are drawn on the CPU.

    Example:
        >>> problems = SyntheticProblems(n=9, batch_size=2, seed=1, outliers=OutlierMix(count=3)).batch(0)
        >>> problems.world_points.shape, problems.inliers.sum(-1)
        (torch.Size([2, 9, 3]), tensor([6, 6]))
    """

    points: PointPrior | None = None
    outliers: OutlierMix | None = None
    translation_sigma: float | None = None
    max_angle: float = math.pi / 2
    focal: float = 3400.0
    half_image: float | None = 3400.0
    img_sigma: Amount = 1.0
    world_sigma: Amount = 0.05
    degrees: Amount = 0.0
    sigma_spread: Amount = 0.0
    axis_ratio: float = 1.0
    known_noise: float = 0.0
    confidence_share: float = 0.0
    bunched_share: float = 0.0
    depth_maps: DepthMaps | None = None
    copies_share: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        sizes = {name: getattr(self, name) for name in ("max_angle", "half_image", "translation_sigma")}
        check_numbers(0.0, **{name: value for name, value in sizes.items() if value is not None})
        check_positive(focal=self.focal)
        shares = {name: value for name, value in vars(self).items() if name.endswith("_share")}
        check_numbers(0.0, 1.0, known_noise=self.known_noise, **shares)
        check_numbers(1.0, _MOST_RATIO, axis_ratio=self.axis_ratio)
        for name, (low, high) in _AMOUNTS.items():
            value = getattr(self, name)
            if isinstance(value, Sequence):
                check_ranges(**{name: value})
            for end in value if isinstance(value, Sequence) else [value]:
                check_numbers(low if end else 0.0, high, **{name: end})
        near = self.outliers is not None and self.outliers.near_share > 0.0 and self.outliers.near_pixels is None
        KORNIA_CHECK(not near or self.img_sigma != 0.0, "near outliers of exact pixels need near_pixels.")
        KORNIA_CHECK(
            self.axis_ratio == 1.0 or self.known_noise in (0.0, 1.0),
            f"known_noise must be 0 or 1 if axis_ratio is above 1, got known_noise={self.known_noise}.",
        )

    def _draw(self, generator: torch.Generator) -> Problems:
        size, n, mix = self.batch_size, self.n, self.outliers or OutlierMix(count=0)
        pose = random_poses(size, generator, translation_sigma=self.translation_sigma, max_angle=self.max_angle)
        # The scene has 2N points: N points of the pairs, and N points for the pixels of mismatches and crowds.
        scene = (self.points or BoxPoints())(size, 2 * n, generator)
        kind = mix.draw(size, n, generator)[..., None]  # (B, N, 1), like all masks below
        has_other = (kind == OutlierKind.MISMATCH) | (kind == OutlierKind.CROWD) | (kind == OutlierKind.POINT_CROWD)
        is_sensing = kind == OutlierKind.SENSING
        anywhere = self._anywhere(scene, generator)
        if self.bunched_share:
            scene = self._bunched(scene, (has_other | is_sensing)[..., 0], generator)
        cam_points, other_points = scene.chunk(2, 1)

        world_points = (cam_points - pose.translation[:, None]) @ pose.rotation
        noise, world_sigma, world_cov = self._noise(world_points.shape, self.world_sigma, 0.0, generator)
        world_points += noise
        is_flying = torch.zeros_like(has_other)
        if self.depth_maps is not None:
            moves, is_flying = self.depth_maps(cam_points, generator)
            world_points += moves @ pose.rotation
        shown = torch.where(has_other, other_points, cam_points)
        if mix.structured_share:
            moved = structured_points(cam_points, mix, generator)
            shown = torch.where(kind == OutlierKind.STRUCTURED, moved, shown)
        # If the camera cannot see a pair's point, the pair gets a uniform pixel and is an outlier.
        in_front = _is_in_front(shown)
        shown = torch.where(in_front, shown, 1.0)
        img_points = self.focal * shown[..., :2] / shown[..., 2:]
        img_points = torch.where(is_sensing | ~in_front, anywhere, img_points)
        noise, img_sigma, img_cov = self._noise(img_points.shape, self.img_sigma, self.degrees, generator)
        img_points += noise
        length = noise.norm(dim=-1)
        inliers = ((kind == OutlierKind.INLIER) & in_front & ~is_flying)[..., 0]
        if self.degrees:
            inliers &= length <= _MOST_NOISE * img_sigma
        if mix.near_share:
            offsets = near_offsets(img_sigma, n, generator, mix.near_pixels)
            img_points += torch.where(kind == OutlierKind.NEAR, offsets, 0.0)
        if mix.crowd_share:
            leader = crowd_leaders(size, n, mix.max_crowds, generator)[..., None]
            pixels, points = img_points.take_along_dim(leader, 1), world_points.take_along_dim(leader, 1)
            img_points = torch.where(kind == OutlierKind.CROWD, pixels, img_points)
            world_points = torch.where(kind == OutlierKind.POINT_CROWD, points, world_points)

        known: dict[str, Any] = {}
        if self.known_noise and img_cov is not None:
            known = {"img_cov": img_cov, "world_cov": world_cov}
        elif self.known_noise:
            known = self._known_sigmas(img_sigma, world_sigma, generator)
        if self.confidence_share:
            errors = length / img_sigma.mean(1, keepdim=True).clamp(min=_TINY)
            known["confidence"] = self._confidence(inliers, errors, generator)
        intrinsics = torch.tensor((self.focal, self.focal, 1.0), dtype=torch.float64).diag()
        problems = Problems(world_points, img_points, intrinsics.expand(size, 3, 3), pose, inliers, **known)
        return self._with_copies(problems, generator) if self.copies_share else problems

    def _with_copies(self, problems: Problems, generator: torch.Generator) -> Problems:
        """Replace pairs by copies of other pairs; see ``copies_share``."""
        size, n = problems.inliers.shape
        share = torch.where(unit((size, 1), generator) < self.copies_share, unit((size, 1), generator) / 2.0, 0.0)
        is_copy = (unit((size, n), generator) < share) & (torch.arange(n) >= _LEAST_ORIGINALS)
        other = (n * unit((size, n), generator)).long()
        index = torch.where(is_copy, other, torch.arange(n))
        # If n = 3, poses and cameras are indexed too, but stay the same: the first 8 pairs are never copies.
        return problems.map(lambda x: x[torch.arange(size)[:, None], index] if x.shape[1:2] == (n,) else x)

    def _anywhere(self, scene: Tensor, generator: torch.Generator) -> Tensor:
        """Draw uniform pixels of the image, (B, N, 2)."""
        shape = self.batch_size, self.n, 2
        if self.half_image is not None:
            return uniform(shape, -self.half_image, self.half_image, generator)
        in_front = _is_in_front(scene)
        tangent = torch.where(in_front, scene[..., :2], 0.0) / torch.where(in_front, scene[..., 2:], 1.0)
        half = self.focal * tangent.abs().amax((1, 2), keepdim=True).clamp(max=_WIDEST_TANGENT)
        return half * uniform(shape, -1.0, 1.0, generator)

    def _bunched(self, scene: Tensor, displaced: Tensor, generator: torch.Generator) -> Tensor:
        """Reorder points, (B, 2N, 3). All pairs get points of a bunch, except the outliers in ``displaced``, (B, N)."""
        shape, each = scene.shape[:2], (len(scene), 1)
        direction = normalize(scene, dim=-1)
        # The score of a point is the relative distance of its direction from the first point's direction, plus blur.
        distance = (direction - direction[:, :1]).square().sum(-1).sqrt()
        blur = uniform(each, 0.0, _MOST_BLUR, generator) * unit(shape, generator)
        score = distance / distance.mean(1, keepdim=True).clamp(min=torch.finfo(distance.dtype).tiny) + blur
        chosen = unit(each, generator) < self.bunched_share
        score = torch.where(chosen, score, unit(shape, generator))
        last = pad(displaced, (0, self.n), value=True)
        # Pairs that are not displaced get the points with the lowest scores. The order of these points is random, so
        # that a pair's index is independent of its pixel.
        rank = (last + unit(shape, generator)).argsort(1).argsort(1)
        return scene.take_along_dim(score.argsort(1).gather(1, rank)[..., None], 1)

    def _noise(
        self, shape: Sequence[int], sigma: Amount, degrees: Amount, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        r"""Draw noise (B, N, D). Also return its standard deviations (B, 1) or (B, N) and covariances (B, N, D, D).

        The covariances are ``None`` when ``axis_ratio`` is 1. For Student noise with :math:`\nu` degrees of freedom,
        standard normal noise of length :math:`r` is scaled to the length :math:`\sqrt{\nu(\exp(r^2/\nu) - 1)}`. In two
        dimensions, the result has the bivariate Student distribution.
        """
        noise = normal(shape, generator)
        sigmas = self._amounts(sigma, generator)
        if self.sigma_spread:
            exponents = normal((*shape[:2], 1), generator)
            sigmas = sigmas * (exponents * self._amounts(self.sigma_spread, generator)).exp()
        if degrees:
            freedom = self._amounts(degrees, generator)
            sq_length = noise.square().sum(-1, keepdim=True)
            noise *= (freedom * (sq_length / freedom).expm1() / sq_length).sqrt()
        noise *= sigmas
        if self.axis_ratio == 1.0:
            return noise, sigmas[..., 0], None
        axes = self.axis_ratio ** torch.linspace(0.0, 1.0, shape[-1], dtype=noise.dtype)
        axes = axes / axes.square().mean().sqrt()
        turn = torch.linalg.qr(normal((*shape, shape[-1]), generator)).Q  # (B, N, D, D)
        factor = (turn * axes) @ turn.mT
        return (factor @ noise[..., None])[..., 0], sigmas[..., 0], factor @ factor * sigmas[..., None].square()

    def _amounts(self, value: Amount, generator: torch.Generator) -> Tensor:
        """Draw one number per problem, (B, 1, 1)."""
        each = self.batch_size, 1, 1
        if isinstance(value, Sequence):
            return log_uniform(each, value[0], value[1], generator)
        return torch.full(each, value, dtype=torch.float64)

    def _known_sigmas(self, img_sigma: Tensor, world_sigma: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        """Return the sigmas that are given to solvers; see ``known_noise``."""
        chance, side = unit((2, self.batch_size, 1), generator)
        has_one = chance < self.known_noise + (1.0 - self.known_noise) / 3.0
        known = {}
        for name, sigma, is_side in (("img_sigma", img_sigma, side < 0.5), ("world_sigma", world_sigma, side >= 0.5)):
            sigma = torch.where((chance < self.known_noise) | (has_one & is_side), sigma, torch.nan)
            known[name] = sigma if self.sigma_spread else sigma[:, 0]
        return known

    def _confidence(self, inliers: Tensor, errors: Tensor, generator: torch.Generator) -> Tensor:
        """Draw confidences, (B, N). ``errors`` (B, N) is the pixel noise of each pair in standard deviations."""
        each = self.batch_size, 1
        separation, noisiness = (uniform(each, *bounds, generator) for bounds in (_SEPARATION, _NOISINESS))
        score = normal(inliers.shape, generator) + torch.where(inliers, separation - noisiness * errors.log1p(), 0.0)
        logit = log_uniform(each, *_GAIN, generator) * score + _OFFSET * normal(each, generator)
        return torch.where(unit(each, generator) < self.confidence_share, torch.sigmoid(logit), torch.nan)


def _is_in_front(cam_points: Tensor) -> Tensor:
    """Whether a camera can see each point, (B, N, 1)."""
    return cam_points[..., 2:] > _LEAST_COSINE * cam_points.norm(dim=-1, keepdim=True)


@dataclass(kw_only=True, eq=False)
class CameraProblems(RandomProblems):
    r"""Random problems of cameras with random fields of view.

    The image has 2000 x 2000 pixels, and the principal point is its centre. The pixels of inliers and of outliers are
    uniform in the image. The mean depth of a problem is log-uniform from 2 to 50. The cameras of a rig look in
    directions that are spread evenly about the rig's vertical axis. The camera centres are random points on a sphere
    about the rig's origin. Pair ``i`` belongs to camera ``i % cameras``.

    Args:
        n: number of pairs per problem. For ``batch_size``, ``seed``, ``dtype`` and ``device`` see
            :class:`SyntheticProblems`.
        field_of_view: range of the horizontal field of view, in degrees. Each camera draws a uniform number.
        depth_spread: range from which each problem draws a uniform spread. Depths, divided by the mean depth, are
            uniform from ``1 - spread`` to ``1 + spread``.
        outlier_share: share of the pairs that are outliers. The number of outliers is rounded to an integer.
        img_sigma: standard deviation of the noise on each pixel coordinate, in pixels.
        cameras: number of cameras. Two or more cameras form a rig, and batches then have ``cam_from_rig``.
        baseline: distance of the camera centres from the origin of the rig, divided by the mean depth.

    Example:
        >>> problems = CameraProblems(n=12, batch_size=2, seed=1, outlier_share=0.25, cameras=3).batch(0)
        >>> problems.intrinsics.shape, problems.cam_from_rig.rotation.shape, problems.inliers.sum(-1)
        (torch.Size([2, 12, 3, 3]), torch.Size([2, 12, 3, 3]), tensor([9, 9]))
    """

    n: int = 12
    field_of_view: tuple[float, float] = (18.0, 100.0)
    depth_spread: tuple[float, float] = (0.1, 0.5)
    outlier_share: float = 0.0
    img_sigma: float = 1.0
    cameras: int = 1
    baseline: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        check_whole(1, cameras=self.cameras)
        check_numbers(0.0, img_sigma=self.img_sigma, baseline=self.baseline)
        check_numbers(0.0, 1.0, outlier_share=self.outlier_share)
        for name, low, high in (("field_of_view", 1e-3, 170.0), ("depth_spread", 0.0, 0.95)):
            values = getattr(self, name)
            message = f"{name} must be two rising numbers in [{low:g}, {high:g}], got {values!r}."
            KORNIA_CHECK(are_rising(values, low, high), message)

    def _draw(self, generator: torch.Generator) -> Problems:
        size, each = (self.batch_size, self.n), (self.batch_size, 1)
        angle = uniform((self.batch_size, self.cameras), *self.field_of_view, generator).deg2rad()
        distance = log_uniform(each, _NEAREST, _FARTHEST, generator)
        spread = uniform(each, *self.depth_spread, generator)
        depth = distance * (1.0 + spread * uniform(size, -1.0, 1.0, generator))
        pixels = uniform((*size, 2), -_HALF_IMAGE, _HALF_IMAGE, generator)
        camera = torch.arange(self.n) % self.cameras
        focal = (_HALF_IMAGE / (0.5 * angle).tan())[:, camera]  # (B, N)
        points = torch.cat((pixels * (depth / focal)[..., None], depth[..., None]), -1)
        rig = None
        if self.cameras > 1:
            heading = torch.arange(self.cameras).double()[:, None] * (2.0 * math.pi / self.cameras)
            rotation = axis_angle_to_rotation_matrix(pad(heading, (1, 1))).expand(self.batch_size, -1, -1, -1)
            direction = normalize(normal((self.batch_size, self.cameras, 3), generator), dim=-1)
            centre = self.baseline * distance[..., None] * direction  # (B, C, 3)
            translation = -(rotation @ centre[..., None])[..., 0]
            rig = Pose(rotation[:, camera], translation[:, camera])
            points = (rig.rotation.mT @ (points - rig.translation)[..., None])[..., 0]
        pose = random_poses(self.batch_size, generator, translation_box=1.0, max_angle=math.pi)
        pose = pose._replace(translation=distance * pose.translation)
        world_points = (points - pose.translation[:, None]) @ pose.rotation
        inliers = unit(size, generator).argsort(1) >= round(self.outlier_share * self.n)
        pixels += self.img_sigma * normal((*size, 2), generator)
        anywhere = uniform((*size, 2), -_HALF_IMAGE, _HALF_IMAGE, generator)
        pixels = torch.where(inliers[..., None], pixels, anywhere) + _HALF_IMAGE
        intrinsics = torch.eye(3, dtype=torch.float64).repeat(*size, 1, 1)
        intrinsics[..., 0, 0] = intrinsics[..., 1, 1] = focal
        intrinsics[..., :2, 2] = _HALF_IMAGE
        return Problems(world_points, pixels, intrinsics if rig else intrinsics[:, 0], pose, inliers, cam_from_rig=rig)
