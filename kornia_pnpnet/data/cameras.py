"""Synthetic problems of many cameras: random fields of view, and rigs of several cameras with one pose."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from kornia.core.check import KORNIA_CHECK
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch.nn.functional import normalize, pad

from kornia_pnpnet.core.checks import check_numbers, check_whole
from kornia_pnpnet.data.draws import RandomProblems, log_uniform, normal, random_poses, uniform, unit
from kornia_pnpnet.result import Pose, Problems

__all__ = ["CameraProblems"]

# Smallest and largest mean depth of a problem, in the unit of the world. The values are arbitrary: solvers do not
# depend on the unit.
_NEAREST, _FARTHEST = 2.0, 50.0
# Half the side of the square image, in pixels.
_HALF_IMAGE = 1000.0


@dataclass(kw_only=True, eq=False)
class CameraProblems(RandomProblems):
    r"""Random problems of cameras with random fields of view.

    The image has 2000 x 2000 pixels, and the principal point is its centre. The pixels of inliers and of outliers are
    uniform in the image. The mean depth of a problem is log-uniform from 2 to 50. The cameras of a rig look in
    directions that are spread evenly about the rig's vertical axis. The camera centres are random points on a sphere
    about the rig's origin. Pair ``i`` belongs to camera ``i % cameras``.

    Args:
        n: number of pairs per problem. For ``batch_size``, ``seed``, ``dtype`` and ``device`` see
            :class:`~kornia_pnpnet.data.SyntheticProblems`.
        field_of_view: range, in degrees, from which each camera draws its horizontal field of view uniformly.
        depth_spread: range from which each problem draws its spread uniformly. Depths divided by the mean depth are
            uniform from ``1 - spread`` to ``1 + spread``.
        outlier_share: share of the pairs that are outliers. The number of outliers is rounded to an integer.
        img_sigma: standard deviation of the noise on each pixel coordinate, in pixels.
        cameras: number of cameras. Two or more cameras form a rig, and batches then have ``cam_from_rig``.
        baseline: distance of the camera centres from the origin of the rig, relative to the mean depth.

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
            rising = len(values) == 2 and low <= values[0] <= values[1] <= high
            KORNIA_CHECK(rising, f"{name} must be two rising numbers in [{low:g}, {high:g}], got {values!r}.")

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
