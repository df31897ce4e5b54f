"""Problems as data sources yield them, and results as solvers return them."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

from torch import Tensor

from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.types.pose import Pose

__all__ = ["Alternatives", "PnPResult", "Problems", "Status"]


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
    #: No pose was found with which enough pairs agree. Of three pairs most solvers answer this: see
    #: :func:`kornia_pnpnet.init.p3p`, which finds all poses of three pairs.
    NOT_BELIEVED = 5
    #: The pose that was found has fewer than 3 pairs in front of the camera.
    BEHIND = 6


class Alternatives(NamedTuple):
    r"""Other poses that explain the pairs nearly as well, without gradient.

    Attributes:
        rotation: world-to-camera rotations in the order of their costs, shape :math:`(B, S, 3, 3)`.
        translation: world-to-camera translations, shape :math:`(B, S, 3)`.
        cost: as the ``cost`` of a :class:`PnPResult`, of the refinement that compares the poses, shape :math:`(B, S)`.
        probability: probability of each pose when one of them or the result's pose is right, shape :math:`(B, S)`.
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
        cost: mean robust loss of the pairs, with that of a prior, in the kernel's unit (see
            :mod:`kornia_pnpnet.refine.kernels`), shape :math:`(B,)`. Comparable between problems that the
            same solver solved.
        ok: whether the pose is to be believed, bool, shape :math:`(B,)`. Where ``ok`` is false the fields above, the
            ``intrinsics`` and ``dist`` are finite and carry no gradient.
        init: the first guess. It carries a gradient for every valid problem, also where refinement failed, so that an
            initialiser can learn from its failures.
        status: why a problem is not ``ok``: the value of a :class:`Status`, int8, shape :math:`(B,)`.
        probability: estimated probability that the pose is not far off, which is within 10 degrees and 30 % of the
            distance of the points, shape :math:`(B,)`, without gradient. Where the solver neither knows nor estimates
            the noise, it is taken from the residuals. Peers do not estimate it: theirs is 1 where ``ok``.
        alternatives: other poses that explain the pairs nearly as well; no slots where the call did not ask for them.
        intrinsics: the camera matrices that the poses go with, with a last entry of 1, shape :math:`(B, 3, 3)`. With an
            unknown focal length they hold its estimate. The identity for a problem whose camera is impossible.
        dist: the estimated distortion (k1, k2, 0, 0), which goes with the ``intrinsics``, shape :math:`(B, 4)`; 0 where
            it was not estimated.
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
        inliers: whether the pixel of a pair shows its point, bool, shape :math:`(B, N)`.
        img_sigma: standard deviation of the noise on each pixel coordinate, as a solver may know it: NaN where it is
            unknown, ``None`` where it is unknown for all problems, shape :math:`(B,)` or :math:`(B, N)`.
        world_sigma: that of the noise on each world coordinate, with NaN, ``None`` and shape as for ``img_sigma``.
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
