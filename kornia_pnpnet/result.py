"""Tensors that the public functions take and return: poses, results, and problems with known poses.

Each class of tensors is a ``NamedTuple`` and therefore a pytree, which ``torch.compile``, ``torch.export``,
``torch.func`` and data loaders accept. In all shapes of the package, ``B`` is the number of problems in the batch, and
``N`` is the number of pairs of each problem.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from enum import IntEnum, unique
from typing import Any, NamedTuple

import torch
from kornia.core.exceptions import TypeCheckError
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

from kornia_pnpnet.core.checks import (
    Shapes,
    check_devices,
    check_form,
    check_like,
    check_shapes,
    check_tensors,
    common_dtype,
)
from kornia_pnpnet.core.linalg import gate, nearest_rotation, relative
from kornia_pnpnet.core.performance import full_precision, sees_values
from kornia_pnpnet.core.trees import map_tensors

__all__ = [
    "Alternatives",
    "PnPResult",
    "Pose",
    "PosePrior",
    "Problems",
    "Status",
    "camera_matrices",
    "check_pose",
    "check_poses",
    "gate_pose",
    "sound_pose",
    "with_rotation",
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
        r"""A pose from a rotation vector (OpenCV's ``rvec``) and a translation (``tvec``).

        Args:
            rvec: axis times angle in radians, shape :math:`(B, 3)`.
            translation: shape :math:`(B, 3)`.

        Example:
            >>> pose = Pose.from_rvec(torch.tensor([[0.0, 0.0, 0.5]]), torch.zeros(1, 3))
            >>> pose.rvec
            tensor([[0.0000, 0.0000, 0.5000]])
        """
        return cls._of_vectors(axis_angle_to_rotation_matrix, "rvec", rvec, 3, translation)

    @classmethod
    def from_quaternion(cls, quaternion: Tensor, translation: Tensor) -> Pose:
        r"""A pose from a translation and a quaternion in the order :math:`(w, x, y, z)` of COLMAP and Kornia.

        Args:
            quaternion: quaternion of any finite length, shape :math:`(B, 4)`. The length 0 gives the identity.
            translation: shape :math:`(B, 3)`.
        """

        def rotate(x: Tensor) -> Tensor:  # no square of a relative length overflows or underflows
            return quaternion_to_rotation_matrix(relative(x, x.detach().abs()))

        return cls._of_vectors(rotate, "quaternion", quaternion, 4, translation)

    @classmethod
    def _of_vectors(
        cls, rotate: Callable[[Tensor], Tensor], name: str, vectors: Tensor, length: int, translation: Tensor
    ) -> Pose:
        """Check vectors (*, length) and translations (*, 3), and convert them to poses of one dtype."""
        check_form(["*", "3"], translation=translation)
        check_shapes({name: (vectors, (*translation.shape[:-1], length))})
        tensors = {name: vectors, "translation": translation}
        check_devices(tensors, translation, "translation")
        dtype = common_dtype(tensors)
        return cls(rotate(vectors.to(dtype)), translation.to(dtype))

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
        """The pose as Kornia's ``Se3``, with gradients. Kornia orders tangent vectors (translation, rotation)."""
        return Se3.from_matrix(self.matrix)

    def camera(self, intrinsics: Tensor | PinholeCamera, height: int = 1, width: int = 1) -> PinholeCamera:
        r"""Kornia's camera with the pose as its extrinsics.

        Kornia's cameras have one batch dimension. A single pose becomes a batch of one. Leading dimensions are merged.

        Args:
            intrinsics: camera matrices, shape :math:`(B, 3, 3)` or :math:`(3, 3)`; or Kornia's camera, whose image size
                replaces ``height`` and ``width``.
            height: height of the image in pixels. Projection ignores the size of the image.
            width: width of the image in pixels.

        Raises:
            ShapeError: when the intrinsics have other shapes.

        Example:
            >>> pose = Pose(torch.eye(3)[None], torch.tensor([[0.0, 0.0, 2.0]]))
            >>> camera = pose.camera(torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
            >>> camera.project(torch.tensor([[0.1, 0.0, 0.0]]))
            tensor([[345., 240.]])
        """
        leading = self.translation.shape[:-1]
        batch, matrices = leading.numel(), camera_matrices(intrinsics).to(self.translation.dtype)
        if matrices.ndim > 2:
            of_cameras = (batch,) if isinstance(intrinsics, PinholeCamera) else leading
            check_shapes({"intrinsics": (matrices, (*of_cameras, 3, 3))})
        matrices = (matrices / matrices[..., 2:, 2:]).reshape(-1, 3, 3).expand(batch, 3, 3)
        size = [self.translation.new_full((batch,), x) for x in (height, width)]
        if isinstance(intrinsics, PinholeCamera):
            size = [x.expand(batch) for x in (intrinsics.height, intrinsics.width)]
        no_shift = torch.zeros_like(matrices[..., :1])
        return PinholeCamera(Rt_to_matrix4x4(matrices, no_shift), self.matrix.reshape(-1, 4, 4), *size)


def camera_matrices(intrinsics: Tensor | PinholeCamera, size: torch.Size | None = None) -> Tensor:
    """Camera matrices (B, 3, 3) or (3, 3) of ``intrinsics``. The extrinsics of Kornia's cameras are ignored.

    Kornia's cameras have one batch dimension. If the number of cameras fits ``size``, it is split into ``size``.
    """
    if not isinstance(intrinsics, PinholeCamera):
        return intrinsics
    matrices = intrinsics.camera_matrix
    if len(matrices) == 1 and matrices.ndim == 3:
        return matrices[0]
    return matrices if size is None or len(matrices) != size.numel() else matrices.reshape(*size, *matrices.shape[1:])


def check_pose(name: str, pose: Pose) -> None:
    """Check the types of a pose and of its tensors."""
    if not isinstance(pose, Pose):
        raise TypeCheckError(f"{name} must be a Pose, got {type(pose).__name__}.")
    check_tensors({f"{name} {part}": x for part, x in pose._asdict().items()})


def check_poses(estimate: Pose, truth: Pose) -> None:
    """Check that two batches of poses agree in shape, dtype and device. Broadcasting would mix up problems."""
    check_pose("estimate", estimate)
    check_pose("truth", truth)
    shape = tuple(estimate.translation.shape)
    shapes: Shapes = {}
    for name, pose in (("estimate", estimate), ("truth", truth)):
        shapes[f"The rotation of the {name}"] = pose.rotation, (*shape, 3)
        shapes[f"The translation of the {name}"] = pose.translation, shape
    check_shapes(shapes)
    check_like({name: x for name, (x, _) in shapes.items()}, truth.translation, "the translation of the truth")


@full_precision
def with_rotation(pose: Pose) -> Pose:
    """Replace matrices ``(*, 3, 3)`` by the nearest rotations, and matrices of non-positive determinant by NaN."""
    matrices = pose.rotation.reshape(-1, 3, 3)
    rotation, unique = nearest_rotation(matrices.permute(1, 2, 0))
    usable = unique & (torch.linalg.det(matrices.detach()) > 0)
    rotation = torch.where(usable[:, None, None], rotation.permute(2, 0, 1), torch.nan)
    return Pose(rotation.reshape(pose.rotation.shape), pose.translation)


def sound_pose(pose: Pose, sound: Tensor) -> Pose:
    """Replace poses (*) by the identity, without gradient, where ``sound``, bool (*), is false."""
    eye = torch.eye(3, dtype=pose.rotation.dtype, device=pose.rotation.device)
    rotation = torch.where(sound[..., None, None], pose.rotation, eye)
    return Pose(rotation, torch.where(sound[..., None], pose.translation, 0.0))


def gate_pose(pose: Pose, live: Tensor, finite: Tensor) -> Pose:
    """Apply ``core.linalg.gate`` to a pose. The identity replaces poses that are not ``finite``."""
    eye = torch.eye(3, dtype=pose.rotation.dtype, device=pose.rotation.device)
    return Pose(gate(pose.rotation, live, finite, eye), gate(pose.translation, live, finite, 0.0))


class PosePrior(NamedTuple):
    r"""A prior of a pose, for example from the previous frame, from gravity, or from an odometer.

    If :math:`(R, t)` is the true pose, the prior's pose is :math:`(\mathrm{cay}(\omega) R,\; t + v)` with the Cayley
    transform cay and Gaussian noise :math:`(\omega, v)`. The covariance of the noise is the inverse of ``information``.
    :func:`~kornia_pnpnet.covariance.pose_covariance` returns covariances of the same vector :math:`(\omega, v)`.

    Attributes:
        pose: the expected world-to-camera pose.
        information: inverse of the covariance (in radians and the unit of the world), positive semi-definite, shape
            :math:`(B, 6, 6)`. An unknown component of :math:`(\omega, v)` has zeros in its row and column.
        scale: scale :math:`c` of Welsch's kernel, shape :math:`(B,)`; ``None``: 3. The weight of the prior is
            :math:`\exp(-2 s / (k c^2))`, where :math:`k` is the rank of ``information``, and :math:`s` the squared
            Mahalanobis distance between prior and pose. An incorrect prior thus does not spoil a pose that the pairs
            determine. With an infinite scale the weight is 1.
    """

    pose: Pose
    information: Tensor
    scale: Tensor | None = None


@unique
class Status(IntEnum):
    """The values of ``PnPResult.status``. Each value except ``SOLVED`` is a reason why a problem is not ``ok``."""

    #: The problem is ``ok``.
    SOLVED = 0
    #: Fewer than 3 pairs have a positive weight.
    TOO_FEW_PAIRS = 1
    #: The points lie on a line or coincide, or the refined pose is not finite.
    DEGENERATE = 2
    #: An input is invalid: a coordinate, weight or covariance that is not finite, a sigma whose fourth power is
    #: infinite, a negative weight or sigma, a covariance that is not positive semi-definite, an invalid prior, or a
    #: rotation of ``cam_from_rig`` whose determinant is not positive.
    NOT_FINITE = 3
    #: The intrinsics are not a multiple of ``[[fx, s, cx], [0, fy, cy], [0, 0, 1]]``, ``fx`` or ``fy`` is 0, or the
    #: intrinsics do not fit the pixels: almost all pixels are over 89.9 degrees off the optical axis.
    CAMERA = 4
    #: The pairs are too little evidence for the best pose. Solvers return this status for problems of three pairs; use
    #: :func:`~kornia_pnpnet.propose.p3p.p3p` instead.
    NOT_BELIEVED = 5
    #: Fewer than 3 pairs are in front of the camera at the best pose.
    BEHIND = 6
    #: The dtype has too few digits for the points: the coordinates are large, and their differences are small. Use
    #: float64, or subtract an offset from the points before the conversion to float32.
    PRECISION = 7
    #: Pairs were left out because their ``confidence`` is not in [0, 1], and the other pairs determine no pose.
    CONFIDENCE = 8
    #: The pose ``init`` was ignored, and no other pose was found. ``init`` is ignored if it is not finite, or if the
    #: determinant of its matrix is not positive.
    INIT = 9


class Alternatives(NamedTuple):
    r"""Other poses, without gradient, that explain the pairs nearly as well as the result's pose.

    Attributes:
        rotation: world-to-camera rotations by descending probability, shape :math:`(B, S, 3, 3)`.
        translation: world-to-camera translations, shape :math:`(B, S, 3)`.
        cost: cost of each pose, see :class:`PnPResult`, shape :math:`(B, S)`. Costs of one problem are
            comparable. If the focal length is unknown, their pixels are those of the estimated focal length.
        probability: probability of each pose, given that the true pose is the result's pose or an alternative,
            shape :math:`(B, S)`.
        valid: which slots hold a pose, bool, shape :math:`(B, S)`. Empty slots come last.
    """

    rotation: Tensor
    translation: Tensor
    cost: Tensor
    probability: Tensor
    valid: Tensor

    @classmethod
    def none(cls, pose: Pose) -> Alternatives:
        """Alternatives without slots (:math:`S = 0`) for a batch of poses."""
        empty = pose.translation.detach()[:, :0]  # (B, 0)
        vectors = empty[..., None].expand(-1, -1, 3)
        return cls(vectors[..., None].expand(-1, -1, -1, 3), vectors, empty, empty, empty > 0)


# Default of fields that every solver of this package sets. Because of the type `Any`, users need no test for `None`.
_UNSET: Any = None


class PnPResult(NamedTuple):
    r"""The result of every solver.

    Attributes:
        rotation: world-to-camera rotation, shape :math:`(B, 3, 3)`.
        translation: world-to-camera translation in the unit of the world points, shape :math:`(B, 3)`.
        weights: final weight of each pair, in the caller's order, shape :math:`(B, N)`.
        cost: robust loss of the pairs and of a prior, divided by the number of pairs, in the unit of the kernel (see
            :mod:`kornia_pnpnet.refine.kernels`), shape :math:`(B,)`. Costs of the same solver are comparable.
        ok: whether the pose can be trusted, bool, shape :math:`(B,)`. Where ``ok`` is false, the pose, weights,
            cost, ``intrinsics`` and ``dist`` are finite, but have a gradient only with ``gradient="always"``.
        init: the first guess. With the fixed effort (also in training mode), the first guess of every valid problem has
            a gradient, except in rigs. An initialiser can thus learn even if the refinement fails.
        status: the value of the problem's :class:`Status`, int8, shape :math:`(B,)`.
        probability: estimated probability that the rotation error is at most 10 degrees, and the error of the camera's
            centre at most 30 % of the distance between camera and points, shape :math:`(B,)`, without gradient. Solvers
            of other libraries return 1 where ``ok``.
        alternatives: other poses that explain the pairs nearly as well; empty unless the call requested alternatives.
        intrinsics: camera matrices with a last entry of 1, shape :math:`(B, 3, 3)`. In a rig the shape may be
            :math:`(B, N, 3, 3)`. An unknown focal length is replaced by its estimate. The identity replaces an invalid
            matrix.
        dist: estimated distortion (k1, k2, 0, 0), shape :math:`(B, 4)`; 0 if no distortion was estimated.
        sigma: standard deviation of a pixel coordinate in the caller's pixels, estimated from the inliers, shape
            :math:`(B,)`, without gradient. The noise of world points is included. If the standard deviation differs
            between pairs, ``sigma`` is the geometric mean over all pairs of positive weight.
        inliers: which pairs are inliers of the pose, bool, shape :math:`(B, N)`.
    """

    rotation: Tensor
    translation: Tensor
    weights: Tensor
    cost: Tensor
    ok: Tensor
    init: Pose
    status: Tensor = _UNSET
    probability: Tensor = _UNSET
    alternatives: Alternatives | None = None
    intrinsics: Tensor = _UNSET
    dist: Tensor = _UNSET
    sigma: Tensor = _UNSET
    inliers: Tensor = _UNSET

    def __repr__(self) -> str:
        """Five lines: the number of ``ok`` problems; median and range of inliers, sigma and probability; the pose."""
        shown = self.ok, self.status, self.inliers, self.sigma, self.probability, *self.pose
        if not all(type(x) is Tensor and sees_values(x) and x.numel() for x in shown):
            return tuple.__repr__(self)
        flat = (x.detach().reshape(-1, *x.shape[self.ok.ndim :]) for x in shown)
        ok, status, inliers, sigma, probability, rotation, translation = flat

        def spread(values: Tensor) -> str:
            low, median, high = (f"{x:.4g}" for x in (values.min(), values.median(), values.max()))
            return median if low == high else f"{median} ({low} to {high})"

        failed = Counter(Status(x).name for x in status[~ok].tolist())
        pose = ", ".join(f"{name} {(*x.shape,)}" for name, x in self.pose._asdict().items())
        if len(ok) == 1:
            vectors = {"rotation vector": Pose(rotation, translation).rvec, "translation": translation}
            pose = ", ".join(f"{name} {' '.join(f'{x:.4g}' for x in v[0])}" for name, v in vectors.items())
        lines = (
            ", ".join([f"{int(ok.sum())} of {len(ok)} ok", *(f"{n} {name}" for name, n in failed.items())]),
            f"inliers {spread(inliers.sum(1))} of {inliers.shape[1]}",
            f"sigma {spread(sigma)}",
            f"probability {spread(probability)}",
            f"{pose} ({translation.dtype}, {translation.device})",
        )
        return "PnPResult: " + "\n  ".join(lines)

    @property
    def pose(self) -> Pose:
        """Rotation and translation as a :class:`Pose`."""
        return Pose(self.rotation, self.translation)

    @property
    def matrix(self) -> Tensor:
        """The homogeneous world-to-camera matrix, shape :math:`(B, 4, 4)`."""
        return self.pose.matrix

    def covariance(
        self, world_points: Tensor, img_points: Tensor, intrinsics: Tensor | PinholeCamera | None, **more: Any
    ) -> Tensor:
        """The covariance of the pose, computed by :func:`~kornia_pnpnet.covariance.pose_covariance`.

        Args:
            world_points: the points of the solver's call.
            img_points: the pixels or bearings of the solver's call.
            intrinsics: the camera matrices of the solver's call. With ``focal="unknown"``, the result's ``intrinsics``
                and ``dist`` are used instead.
            more: further arguments of ``pose_covariance``. The lens and the rig must be those of the solver's call. The
                default weights are ``inliers``. If the noise of the pixels is not given, it is estimated from the
                residuals of the inliers (see :func:`~kornia_pnpnet.covariance.shown_noise`). The noise of the points is
                then estimated, too, unless it is given.

        Returns:
            Shape :math:`(B, 6, 6)`, see ``pose_covariance``.
        """
        from kornia_pnpnet.covariance import pose_covariance, shown_noise

        more = {name: x for name, x in more.items() if x is not None}
        if more.get("focal") == "unknown" and self.intrinsics is not None:
            intrinsics = self.intrinsics
            more.setdefault("dist", self.dist)
        if "weights" not in more and self.inliers is not None:
            more["weights"] = self.inliers.to(self.rotation.dtype)
        if {"img_sigma", "img_cov"}.isdisjoint(more):
            names = {"dist", "fisheye", "cam_from_rig", "world_sigma", "world_cov"}
            known = {name: x for name, x in more.items() if name in names}
            more |= shown_noise(self.pose, world_points, img_points, intrinsics, more.get("weights"), **known)
        return pose_covariance(self.pose, world_points, img_points, intrinsics, **more)


class Problems(NamedTuple):
    r"""A batch of problems with their true poses. Every data source yields such batches.

    ``img_sigma`` and all later fields are optional inputs of solvers; ``None`` means unknown. For shapes and units see
    :meth:`PnPNet.forward <kornia_pnpnet.solver.PnPNet.forward>`.

    Attributes:
        world_points: shape :math:`(B, N, 3)`.
        img_points: pixels, shape :math:`(B, N, 2)`.
        intrinsics: camera matrices, shape :math:`(B, 3, 3)`, in a rig :math:`(B, N, 3, 3)`.
        pose: the true world-to-camera pose; for a rig, the pose of the rig.
        inliers: whether a pair is an inlier, bool, shape :math:`(B, N)`.
        img_sigma: standard deviation of the noise on each pixel coordinate.
        world_sigma: standard deviation of the noise on each world coordinate.
        confidence: belief that a pair is an inlier.
        img_cov: covariance of each pixel's noise, in place of ``img_sigma``.
        world_cov: covariance of each world point's noise, in place of ``world_sigma``.
        cam_from_rig: the transform from a rig to the camera of each pair; ``None``: one camera.
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
        return {name: x for name, x in self.known.items() if name in ("img_sigma", "world_sigma")}

    @property
    def known(self) -> dict[str, Any]:
        """The known noise, the confidences and the rig, as keyword arguments of a solver's call."""
        # All optional fields are arguments of a solver's call.
        return {name: x for name, x in self._asdict().items() if name in self._field_defaults and x is not None}

    @property
    @full_precision
    def true_cam_points(self) -> Tensor:
        """The points in the frame of their camera, computed with the true pose, shape :math:`(B, N, 3)`."""
        points = self.world_points @ self.pose.rotation.mT + self.pose.translation[..., None, :]
        if self.cam_from_rig is None:
            return points
        return (self.cam_from_rig.rotation @ points[..., None])[..., 0] + self.cam_from_rig.translation

    @property
    def pair_intrinsics(self) -> Tensor:
        """The camera matrix of each pair, shape :math:`(B, N, 3, 3)` in a rig, else :math:`(B, 1, 3, 3)`."""
        return self.intrinsics[..., None, :, :] if self.cam_from_rig is None else self.intrinsics

    def map(self, function: Callable[[Tensor], Tensor]) -> Problems:
        """Apply a function to every tensor, for example to slice the batch or to move it to another device."""
        return map_tensors(function, self)
