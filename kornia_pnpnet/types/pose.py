"""Poses, and what is known of a pose before any pair is looked at."""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import (
    Rt_to_matrix4x4,
    axis_angle_to_rotation_matrix,
    quaternion_to_rotation_matrix,
    rotation_matrix_to_axis_angle,
    rotation_matrix_to_quaternion,
)
from kornia.geometry.liegroup import Se3
from torch import Tensor

__all__ = ["FramedPrior", "FreeFocal", "Pose", "PosePrior", "camera_matrices"]


class Pose(NamedTuple):
    r"""A world-to-camera rigid motion, ``x_cam = R x_world + t``.

    Attributes:
        rotation: :math:`R`, shape :math:`(B, 3, 3)`.
        translation: :math:`t` in the unit of the world points, shape :math:`(B, 3)`.
    """

    rotation: Tensor
    translation: Tensor

    @property
    def matrix(self) -> Tensor:
        """The homogeneous world-to-camera matrix, shape :math:`(B, 4, 4)`."""
        size = self.translation.shape[:-1]  # any leading dimensions
        matrix = Rt_to_matrix4x4(self.rotation.reshape(-1, 3, 3), self.translation.reshape(-1, 3, 1))
        return matrix.reshape((*size, 4, 4))

    @classmethod
    def from_rvec(cls, rvec: Tensor, translation: Tensor) -> Pose:
        r"""A pose from a rotation vector, as OpenCV's ``rvec`` and ``tvec``.

        Args:
            rvec: axis times angle in radians, shape :math:`(B, 3)`.
            translation: shape :math:`(B, 3)`.

        Example:
            >>> pose = Pose.from_rvec(torch.tensor([[0.0, 0.0, 0.5]]), torch.zeros(1, 3))
            >>> pose.rvec
            tensor([[0.0000, 0.0000, 0.5000]])
        """
        return cls(axis_angle_to_rotation_matrix(rvec), translation)

    @classmethod
    def from_quaternion(cls, quaternion: Tensor, translation: Tensor) -> Pose:
        r"""A pose from a quaternion :math:`(w, x, y, z)`, as COLMAP's and Kornia's, of any length but 0.

        Args:
            quaternion: shape :math:`(B, 4)`.
            translation: shape :math:`(B, 3)`.
        """
        return cls(quaternion_to_rotation_matrix(quaternion), translation)

    @property
    def rvec(self) -> Tensor:
        """The rotation vector, axis times angle in radians, shape :math:`(B, 3)`."""
        return rotation_matrix_to_axis_angle(self.rotation)

    @property
    def quaternion(self) -> Tensor:
        """The unit quaternion (w, x, y, z), shape :math:`(B, 4)`."""
        return rotation_matrix_to_quaternion(self.rotation)

    @property
    def se3(self) -> Se3:
        """As Kornia's group element, with the gradient of the pose; its tangent vectors are (translation, rotation)."""
        return Se3.from_matrix(self.matrix)

    def camera(self, intrinsics: Tensor | PinholeCamera, height: int = 1, width: int = 1) -> PinholeCamera:
        r"""Kornia's camera with these extrinsics.

        Args:
            intrinsics: camera matrices, shape :math:`(B, 3, 3)` or :math:`(3, 3)`, or a camera, whose image size is
                kept.
            height: height of the image in pixels; projection does not need it.
            width: width of the image in pixels; projection does not need it.

        Example:
            >>> pose = Pose(torch.eye(3)[None], torch.tensor([[0.0, 0.0, 2.0]]))
            >>> camera = pose.camera(torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
            >>> camera.project(torch.tensor([[0.1, 0.0, 0.0]]))
            tensor([[345., 240.]])
        """
        batch = len(self.translation)
        size = [self.translation.new_full((batch,), x) for x in (height, width)]
        if isinstance(intrinsics, PinholeCamera):
            size = [x.expand(batch) for x in (intrinsics.height, intrinsics.width)]
        matrices = camera_matrices(intrinsics).expand(batch, 3, 3)
        return PinholeCamera(
            Rt_to_matrix4x4(matrices, torch.zeros_like(self.translation)[..., None]), self.matrix, *size
        )


def camera_matrices(intrinsics: Tensor | PinholeCamera) -> Tensor:
    """Camera matrices (B, 3, 3) or (3, 3) from matrices or from Kornia's camera without its extrinsics."""
    if not isinstance(intrinsics, PinholeCamera):
        return intrinsics
    matrices = intrinsics.camera_matrix
    return matrices[0] if len(matrices) == 1 else matrices


class PosePrior(NamedTuple):
    r"""What is known of a pose before the pairs are looked at: of the frame before, of gravity, of an odometer.

    With the true pose :math:`(R, t)`, the prior's pose is :math:`(\mathrm{cay}(\omega) R,\; t + v)`, where
    :math:`(\omega, v)` is Gaussian with the inverse of the information as its covariance: the tangent of
    :func:`~kornia_pnpnet.covariance.pose_covariance`.

    Attributes:
        pose: the world-to-camera pose that is expected.
        information: inverse of the covariance in radians and the unit of the world, positive semi-definite; rows and
            columns of zeros where nothing is known, shape :math:`(B, 6, 6)`.
        scale: :math:`c`, shape :math:`(B,)`; ``None``: 3. The squared error :math:`s` in standard deviations weighs
            :math:`\exp(-2 s / (k c^2))` with :math:`k` known directions (Welsch's kernel), so that a wrong prior does
            not spoil a pose that the pairs determine. Infinite: least squares.
    """

    pose: Pose
    information: Tensor
    scale: Tensor | None = None


class FramedPrior(NamedTuple):
    """A :class:`PosePrior` in the frame of normalised correspondences.

    Attributes:
        pose: the expected pose.
        information: its inverse covariance, shape :math:`(B, 6, 6)`.
        offset: the centroid of the world in normalised lengths, shape :math:`(B, 3)`: shifts of the pose are those of
            the caller's world.
        free: axis in the camera about which turns are open although the other turns are known, else 0,
            shape :math:`(B, 3)`.
        sq_scale: squared scale of the robust kernel, in squared standard deviations, shape :math:`(B,)`.
        rank: number of known directions, shape :math:`(B,)`.
        pixel: one pixel of the caller, in pixels of the correspondences, shape :math:`(B,)`: the noise where nobody
            tells it.
    """

    pose: Pose
    information: Tensor
    offset: Tensor
    free: Tensor
    sq_scale: Tensor
    rank: Tensor
    pixel: Tensor


class FreeFocal(NamedTuple):
    """What is known of a focal length that is estimated with the pose, in the unit of normalised correspondences.

    Attributes:
        expected: the focal length that the caller expects, in pixels, shape :math:`(B,)`.
        information: inverse variance of the logarithm of the expected focal length; 0: nothing is known, shape
            :math:`(B,)`.
        width: the focal length is searched within this distance of that of the correspondences, in logarithms, shape
            :math:`(B,)`.
        pixel: one pixel of the caller, in pixels of the correspondences, shape :math:`(B,)`: the noise where nobody
            tells it.
    """

    expected: Tensor
    information: Tensor
    width: Tensor
    pixel: Tensor
