"""Poses, results and problems with known poses: the tensors that the public functions take and return.

Each is a ``NamedTuple`` and thus a pytree: ``torch.compile``, ``torch.export``, ``torch.func`` and data loaders take it
as it is. The letters are the same everywhere: ``B`` problems in the batch, ``N`` pairs in each.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

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

from kornia_pnpnet.core.checks import Shapes, check_like, check_shapes
from kornia_pnpnet.core.linalg import gate
from kornia_pnpnet.core.trees import map_tensors

__all__ = [
    "Alternatives",
    "PnPResult",
    "Pose",
    "PosePrior",
    "Problems",
    "Status",
    "camera_matrices",
    "check_poses",
    "gate_pose",
]


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
        no_shift = torch.zeros_like(self.translation)[..., None]
        return PinholeCamera(Rt_to_matrix4x4(matrices, no_shift), self.matrix, *size)


def camera_matrices(intrinsics: Tensor | PinholeCamera) -> Tensor:
    """Camera matrices (B, 3, 3) or (3, 3) from matrices or from Kornia's camera without its extrinsics."""
    if not isinstance(intrinsics, PinholeCamera):
        return intrinsics
    matrices = intrinsics.camera_matrix
    return matrices[0] if len(matrices) == 1 else matrices


def check_poses(estimate: Pose, truth: Pose) -> None:
    """Check that two batches of poses have equal shapes. Broadcasting would compare poses of different problems."""
    batch = tuple(estimate.translation.shape[:-1])
    shapes: Shapes = {
        "The rotation of the estimate": (estimate.rotation, (*batch, 3, 3)),
        "The translation of the estimate": (estimate.translation, (*batch, 3)),
        "The rotation of the truth": (truth.rotation, (*batch, 3, 3)),
        "The translation of the truth": (truth.translation, (*batch, 3)),
    }
    check_shapes(shapes)
    tensors = {name: tensor for name, (tensor, _) in shapes.items()}
    check_like(tensors, truth.translation, "the translation of the truth")


def gate_pose(pose: Pose, live: Tensor, finite: Tensor) -> Pose:
    """``core.linalg.gate`` for a pose; the identity fills."""
    eye = torch.eye(3, dtype=pose.rotation.dtype, device=pose.rotation.device)
    return Pose(gate(pose.rotation, live, finite, eye), gate(pose.translation, live, finite, 0.0))


class PosePrior(NamedTuple):
    r"""What is known of a pose besides the pairs: from the frame before, from gravity, from an odometer.

    With the true pose :math:`(R, t)`, the prior's pose is :math:`(\mathrm{cay}(\omega) R,\; t + v)`, where
    :math:`(\omega, v)` is Gaussian with the inverse of the information as its covariance: the tangent of
    :func:`~kornia_pnpnet.covariance.pose_covariance`.

    Attributes:
        pose: the expected world-to-camera pose.
        information: inverse of the covariance in radians and the unit of the world, positive semi-definite; rows and
            columns of zeros where nothing is known, shape :math:`(B, 6, 6)`.
        scale: :math:`c`, shape :math:`(B,)`; ``None``: 3. A squared error of :math:`s` standard deviations has the
            weight :math:`\exp(-2 s / (k c^2))` with :math:`k` known directions (Welsch's kernel), so that a wrong prior
            does not spoil a pose that the pairs determine. Infinite: least squares.
    """

    pose: Pose
    information: Tensor
    scale: Tensor | None = None


class Status(IntEnum):
    """Why a problem is not ``ok``: the values of ``PnPResult.status``."""

    #: ``ok``.
    SOLVED = 0
    #: Fewer than 3 pairs have a weight and are at an angle that a camera can see.
    TOO_FEW_PAIRS = 1
    #: The points lie on a line or coincide, or the pairs do not determine a pose.
    DEGENERATE = 2
    #: A coordinate, weight, sigma or covariance is NaN or infinite, a weight or sigma is negative, a covariance is not
    #: positive semi-definite, a confidence is outside of [0, 1], or a prior is impossible.
    NOT_FINITE = 3
    #: The intrinsics are not a multiple of ``[[fx, s, cx], [0, fy, cy], [0, 0, 1]]`` with positive ``fx`` and ``fy``.
    CAMERA = 4
    #: No pose was found with which enough pairs agree. Most solvers answer this for three pairs, whose poses
    #: :func:`~kornia_pnpnet.propose.p3p.p3p` finds.
    NOT_BELIEVED = 5
    #: The pose that was found has fewer than 3 pairs in front of the camera.
    BEHIND = 6


class Alternatives(NamedTuple):
    r"""Other poses that explain the pairs nearly as well, without gradient.

    Attributes:
        rotation: world-to-camera rotations in the order of their costs, shape :math:`(B, S, 3, 3)`.
        translation: world-to-camera translations, shape :math:`(B, S, 3)`.
        cost: cost of the refinement that compares the poses, see :class:`PnPResult`, shape :math:`(B, S)`.
        probability: probability of each pose if one of them or the result's pose is the true one, shape :math:`(B, S)`.
        valid: which slots hold a pose, the first ones of a problem, bool, shape :math:`(B, S)`.
    """

    rotation: Tensor
    translation: Tensor
    cost: Tensor
    probability: Tensor
    valid: Tensor

    @classmethod
    def none(cls, pose: Pose) -> Alternatives:
        """No slots, :math:`S = 0`, for the problems of a pose."""
        empty = pose.translation.detach()[:, :0]  # (B, 0)
        vectors = empty[..., None].expand(-1, -1, 3)
        return cls(vectors[..., None].expand(-1, -1, -1, 3), vectors, empty, empty, empty > 0)


class PnPResult(NamedTuple):
    r"""The result of every solver.

    Attributes:
        rotation: world-to-camera rotation, shape :math:`(B, 3, 3)`.
        translation: world-to-camera translation in the unit of the world points, shape :math:`(B, 3)`.
        weights: final weight of each pair, in the order in which the pairs were given, shape :math:`(B, N)`.
        cost: mean robust loss of the pairs and of a prior in the kernel's unit (see
            :mod:`kornia_pnpnet.refine.kernels`), shape :math:`(B,)`. Costs of the same solver are comparable.
        ok: whether the pose is to be believed, bool, shape :math:`(B,)`. Where ``ok`` is false the fields above, the
            ``intrinsics`` and ``dist`` are finite and carry no gradient.
        init: the first guess. It carries a gradient for every valid problem, also where refinement failed, so that an
            initialiser can learn from its failures.
        status: why a problem is not ``ok``: the value of a :class:`Status`, int8, shape :math:`(B,)`.
        probability: estimated probability that the pose is within 10 degrees and 30 % of the distance of the points,
            shape :math:`(B,)`, without gradient. A solver that neither knows nor estimates the noise takes it from the
            residuals. Peers do not estimate the probability and return 1 where ``ok``.
        alternatives: other poses that explain the pairs nearly as well; no slots where the call did not ask for them.
        intrinsics: camera matrices of the poses with a last entry of 1, shape :math:`(B, 3, 3)`. With an unknown focal
            length they hold its estimate. The identity for a problem whose camera is impossible.
        dist: estimated distortion (k1, k2, 0, 0), shape :math:`(B, 4)`; 0 where it was not estimated.
    """

    rotation: Tensor
    translation: Tensor
    weights: Tensor
    cost: Tensor
    ok: Tensor
    init: Pose
    status: Tensor | None = None
    probability: Tensor | None = None
    alternatives: Alternatives | None = None
    intrinsics: Tensor | None = None
    dist: Tensor | None = None

    @property
    def pose(self) -> Pose:
        """Rotation and translation as a :class:`Pose`."""
        return Pose(self.rotation, self.translation)

    @property
    def matrix(self) -> Tensor:
        """The homogeneous world-to-camera matrix, shape :math:`(B, 4, 4)`."""
        return self.pose.matrix


class Problems(NamedTuple):
    r"""A batch of problems with their true poses: what every data source yields.

    Attributes:
        world_points: shape :math:`(B, N, 3)`.
        img_points: pixels, shape :math:`(B, N, 2)`.
        intrinsics: camera matrices, shape :math:`(B, 3, 3)`, in a rig :math:`(B, N, 3, 3)`.
        pose: the true world-to-camera pose.
        inliers: whether a pair is an inlier, bool, shape :math:`(B, N)`.
        img_sigma: standard deviation of the noise on each pixel coordinate, as a solver may know it: NaN where it is
            unknown, ``None`` where it is unknown for all problems, shape :math:`(B,)` or :math:`(B, N)`.
        world_sigma: standard deviation of the noise on each world coordinate; see ``img_sigma``.
        confidence: belief that a pair is an inlier, in [0, 1], NaN and ``None`` as for ``img_sigma``, shape
            :math:`(B, N)`.
        img_cov: covariance of the noise of each pixel, as a solver may know it in place of ``img_sigma``, shape
            :math:`(B, N, 2, 2)`; ``None``: unknown.
        world_cov: covariance of the noise of each world point in place of ``world_sigma``, shape
            :math:`(B, N, 3, 3)`; ``None``: unknown.
        cam_from_rig: the camera of each pair in a rig, :math:`(B, N, 3, 3)` and :math:`(B, N, 3)`, with intrinsics of
            the shape :math:`(B, N, 3, 3)`; the pose is that of the rig. ``None``: one camera.
    """

    world_points: Tensor
    img_points: Tensor
    intrinsics: Tensor
    pose: Pose
    inliers: Tensor
    img_sigma: Tensor | None = None
    world_sigma: Tensor | None = None
    confidence: Tensor | None = None
    img_cov: Tensor | None = None
    world_cov: Tensor | None = None
    cam_from_rig: Pose | None = None

    @property
    def sigmas(self) -> dict[str, Tensor]:
        """The known standard deviations, as keyword arguments of a solver's call."""
        sigmas = {"img_sigma": self.img_sigma, "world_sigma": self.world_sigma}
        return {name: sigma for name, sigma in sigmas.items() if sigma is not None}

    @property
    def known(self) -> dict[str, Any]:
        """The known noise, the confidences and the rig, as keyword arguments of a solver's call."""
        more = {"img_cov": self.img_cov, "world_cov": self.world_cov, "confidence": self.confidence}
        known = {**more, "cam_from_rig": self.cam_from_rig}
        return {**self.sigmas, **{name: value for name, value in known.items() if value is not None}}

    @property
    def true_cam_points(self) -> Tensor:
        """The points in the frame of the camera that sees them, by the true poses, shape :math:`(B, N, 3)`."""
        points = self.world_points @ self.pose.rotation.mT + self.pose.translation[:, None]
        if self.cam_from_rig is None:
            return points
        return (self.cam_from_rig.rotation @ points[..., None])[..., 0] + self.cam_from_rig.translation

    @property
    def pair_intrinsics(self) -> Tensor:
        """The camera matrix of each pair, shape :math:`(B, N, 3, 3)`, without a rig :math:`(B, 1, 3, 3)`."""
        return self.intrinsics[:, None] if self.cam_from_rig is None else self.intrinsics

    def map(self, function: Callable[[Tensor], Tensor]) -> Problems:
        """Apply a function to every tensor, for example to slice the batch or to move it to another device."""
        return map_tensors(function, self)
