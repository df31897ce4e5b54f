"""Synthetic problems of many cameras: random fields of view, and rigs of several cameras with one pose."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import count

import torch
from kornia.core.check import KORNIA_CHECK
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor
from torch.nn import functional

from kornia_pnpnet.core.checks import check_numbers, check_positive, check_whole
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.data.draws import batch_generator, log_uniform, normal, random_poses, uniform
from kornia_pnpnet.result import Pose, Problems

__all__ = ["CameraProblems"]

# Distances of the middle of the points: their unit does not matter to a solver.
_NEAREST, _FARTHEST = 2.0, 50.0


class CameraProblems:
    r"""Random problems of cameras with random fields of view, endless and reproducible.

    Pixels are uniform in a square image, whose middle is the principal point; depths are uniform about a distance that
    is log-uniform in 2 to 50. Outliers have a pixel that is uniform in the image. With several cameras, they look in
    directions that are spread evenly about the rig's vertical axis, their centres lie on a sphere about its origin, and
    the pairs go to them in turn.

    Args:
        n: number of pairs per problem.
        batch_size: number of problems per batch.
        seed: seed of the stream.
        field_of_view: range of the horizontal fields of view in degrees, uniform.
        depth_spread: range of the largest relative distance of a depth from the mean depth, uniform.
        outlier_share: share of the pairs that are outliers, rounded to the nearest number of pairs.
        half_image: half the width of the image in pixels.
        img_sigma: standard deviation of the noise on each pixel coordinate.
        cameras: number of cameras of a rig; 1: no rig.
        baseline: distance of the cameras' centres from the origin of the rig, in mean depths.
        dtype: dtype of the batches; numbers are drawn in float64 and cast.
        device: device of the batches.

    Raises:
        BaseError: for a number out of its bounds.

    Example:
        >>> problems = CameraProblems(n=12, batch_size=2, seed=1, outlier_share=0.25, cameras=3).batch(0)
        >>> problems.intrinsics.shape, problems.cam_from_rig.rotation.shape, problems.inliers.sum(-1)
        (torch.Size([2, 12, 3, 3]), torch.Size([2, 12, 3, 3]), tensor([9, 9]))
    """

    def __init__(
        self,
        *,
        n: int = 12,
        batch_size: int = 1000,
        seed: int = 0,
        field_of_view: Sequence[float] = (18.0, 100.0),
        depth_spread: Sequence[float] = (0.1, 0.5),
        outlier_share: float = 0.0,
        half_image: float = 1000.0,
        img_sigma: float = 1.0,
        cameras: int = 1,
        baseline: float = 0.1,
        dtype: torch.dtype = torch.float32,
        device: str | torch.device = "cpu",
    ) -> None:
        check_whole(1, n=n, batch_size=batch_size, cameras=cameras)
        check_whole(0, seed=seed)
        check_positive(half_image=half_image)
        check_numbers(0.0, img_sigma=img_sigma, baseline=baseline)
        check_numbers(0.0, 1.0, outlier_share=outlier_share)
        for name, values, high in (("field_of_view", field_of_view, 170.0), ("depth_spread", depth_spread, 0.95)):
            rising = len(values) == 2 and 0 <= values[0] <= values[1] <= high
            KORNIA_CHECK(rising, f"{name} must be two rising numbers in [0, {high:g}], got {values!r}.")
        KORNIA_CHECK(field_of_view[0] > 0, f"field_of_view must be positive, got {field_of_view!r}.")
        self.n = n
        self.batch_size = batch_size
        self.seed = seed
        self.field_of_view = tuple(field_of_view)
        self.depth_spread = tuple(depth_spread)
        self.outliers = round(outlier_share * n)
        self.half_image = half_image
        self.img_sigma = img_sigma
        self.cameras = cameras
        self.baseline = baseline
        self.dtype = dtype
        self.device = torch.device(device)

    def __iter__(self) -> Iterator[Problems]:
        """Yield batch 0, 1, 2, … without end."""
        return map(self.batch, count())

    def batch(self, index: int) -> Problems:
        """Draw batch ``index``, at least 0; in a rig with ``cam_from_rig``."""
        generator = batch_generator(self.seed, index, self.device)
        size = self.batch_size, self.n
        of_rig = (self.batch_size, self.cameras)
        angle = uniform(of_rig, self.field_of_view[0], self.field_of_view[1], generator).deg2rad()
        focal = self.half_image / (0.5 * angle).tan()  # (B, C)
        distance = log_uniform((self.batch_size, 1), _NEAREST, _FARTHEST, generator)
        spread = uniform((self.batch_size, 1), self.depth_spread[0], self.depth_spread[1], generator)
        depth = distance * (1.0 + spread * uniform(size, -1.0, 1.0, generator))
        pixels = uniform((*size, 2), -self.half_image, self.half_image, generator)
        turn = torch.arange(self.n, device=self.device) % self.cameras
        focal = focal[:, turn]  # (B, N)
        points = torch.cat((pixels * (depth / focal)[..., None], depth[..., None]), -1)
        rig = self._rig(distance, generator)
        if rig is not None:
            rig = map_tensors(lambda x: x[:, turn], rig)
            points = (rig.rotation.mT @ (points - rig.translation)[..., None])[..., 0]
        pose = random_poses(self.batch_size, generator, translation_box=1.0, max_angle=math.pi)
        pose = pose._replace(translation=distance * pose.translation)
        world_points = (points - pose.translation[:, None]) @ pose.rotation
        order = uniform(size, 0.0, 1.0, generator).argsort(1)
        inliers = order >= self.outliers
        pixels = pixels + self.img_sigma * normal((*size, 2), generator)
        anywhere = uniform((*size, 2), -self.half_image, self.half_image, generator)
        pixels = torch.where(inliers[..., None], pixels, anywhere) + self.half_image
        intrinsics = torch.eye(3, dtype=torch.float64, device=self.device).repeat(*size, 1, 1)
        intrinsics[..., 0, 0] = intrinsics[..., 1, 1] = focal
        intrinsics[..., :2, 2] = self.half_image
        cameras = intrinsics[:, 0] if rig is None else intrinsics
        problems = Problems(world_points, pixels, cameras, pose, inliers, cam_from_rig=rig)
        return problems.map(lambda x: x.to(self.dtype) if x.is_floating_point() else x)

    def _rig(self, distance: Tensor, generator: torch.Generator) -> Pose | None:
        """The cameras in the frame of the rig, (B, C, 3, 3) and (B, C, 3)."""
        if self.cameras == 1:
            return None
        heading = torch.arange(self.cameras, dtype=torch.float64, device=self.device) * (2.0 * math.pi / self.cameras)
        rotation = axis_angle_to_rotation_matrix(torch.stack((0.0 * heading, heading, 0.0 * heading), -1))
        rotation = rotation.expand(self.batch_size, -1, -1, -1)
        centres = functional.normalize(normal((self.batch_size, self.cameras, 3), generator), dim=-1)
        centres = self.baseline * distance[..., None] * centres
        return Pose(rotation, -(rotation @ centres[..., None])[..., 0])
