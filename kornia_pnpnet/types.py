"""The tensors that travel between the parts of a solver, each a ``NamedTuple`` with its shape contract.

``NamedTuple`` is a pytree, so ``torch.compile``, ``torch.export``, ``torch.func`` and data loaders take these as they
are. The letters are the same everywhere: ``B`` problems in the batch, ``N`` pairs in each.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
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

from kornia_pnpnet.core.symmetric import Symmetric2, Symmetric3
from kornia_pnpnet.core.trees import map_tensors

__all__ = [
    "Alternatives",
    "Correspondences",
    "FramedPrior",
    "Guess",
    "Hypotheses",
    "Noise",
    "PnPResult",
    "Pose",
    "PosePrior",
    "Problems",
    "Refinement",
    "Status",
]


#: Focal lengths. Pixels are never known better than this, so that weights stay finite.
LEAST_NOISE = 1e-6
#: Pairs that determine a pose up to a few solutions.
MIN_PAIRS = 3


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


class Noise(NamedTuple):
    r"""The noise of each pair: standard deviations, the same on each coordinate, and covariances where there are any.

    Attributes:
        img: standard deviation of the pixel, shape :math:`(B, N)`; with a covariance that of isotropic noise of the
            same trace, which is what a network sees.
        world: standard deviation of the world point, as ``img``.
        img_cov: covariance of the pixel, entries of shape :math:`(B, N)`; ``None``: noise is isotropic.
        world_cov: covariance of the world point, as ``img_cov``.
    """

    img: Tensor
    world: Tensor
    img_cov: Symmetric2 | None = None
    world_cov: Symmetric3 | None = None

    @property
    def sigmas(self) -> Noise:
        """The standard deviations alone."""
        return self._replace(img_cov=None, world_cov=None)

    @property
    def covariances(self) -> list[Symmetric2 | Symmetric3]:
        """The covariances that there are."""
        return [x for x in (self.img_cov, self.world_cov) if x is not None]


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


class Correspondences(NamedTuple):
    r"""Normalised 2D-3D correspondences: the input of initialisers and refiners.

    Attributes:
        world_points: points in the (possibly centred and scaled) world frame, shape :math:`(B, N, 3)`.
        img_points: pixels of a camera with the focal length ``focal`` and the principal point 0,
            shape :math:`(B, N, 2)`.
        weights: weight of each pair, at least 0; 0 means that the pair is padding, shape :math:`(B, N)`.
        focal: the focal length in pixels that all pairs share, a scalar.
        img_scale: pixels of ``img_points`` per pixel of the user's camera, shape :math:`(B,)`; ``None`` is 1. It
            multiplies values that the user gives in pixels, such as a threshold.
        world_scale: lengths of ``world_points`` per unit of the user's world, shape :math:`(B,)`; ``None`` is 1.
        noise: noise of each pair in the units of ``img_points`` and ``world_points``, NaN where unknown; ``None``: all
            unknown.
        near: 0 for points that are many times as far from the others as these are from each other, and for pixels at
            extreme angles; 1 for all other pairs, shape :math:`(B, N)`; ``None``: 1. An initialiser that is not robust
            leaves out the pairs with 0 (:attr:`near_weights`): they are bad data or the horizon.
        confidence: the caller's belief that a pair is an inlier, in [0, 1], NaN where unknown, shape :math:`(B, N)`;
            ``None``: all unknown.
        prior: what is known of the pose besides the pairs; ``None``: nothing.
    """

    world_points: Tensor
    img_points: Tensor
    weights: Tensor
    focal: Tensor
    img_scale: Tensor | None = None
    world_scale: Tensor | None = None
    noise: Noise | None = None
    near: Tensor | None = None
    confidence: Tensor | None = None
    prior: FramedPrior | None = None

    @property
    def near_weights(self) -> Tensor:
        """The weights, 0 for pairs that are not near, shape :math:`(B, N)`."""
        return self.weights if self.near is None else self.weights * self.near

    def map(self, function: Callable[[Tensor], Tensor]) -> Correspondences:
        """Apply a function to every tensor."""
        return map_tensors(function, self)


class Guess(NamedTuple):
    r"""A first guess: what an initialiser returns.

    Attributes:
        pose: a coarse pose in the frame of the :class:`Correspondences`.
        weights: a factor for the weight of each pair, at least 0, shape :math:`(B, N)`.
        ok: whether there is a guess at all (degenerate pairs may have none), bool, shape :math:`(B,)`; ``None``:
            always.
        others: more poses to start from, rotations :math:`(B, S, 3, 3)` and translations :math:`(B, S, 3)`; ``None``:
            no others.
        noise: noise of each pair in the units of the correspondences, where unknown the initialiser's estimate;
            residuals then count in standard deviations. ``None``: the initialiser does not estimate noise. It has no
            covariances: the refinement takes those of the correspondences.
    """

    pose: Pose
    weights: Tensor
    ok: Tensor | None = None
    others: Pose | None = None
    noise: Noise | None = None

    @property
    def poses(self) -> list[Pose]:
        """The pose and the others, each of rotations :math:`(B, 3, 3)` and translations :math:`(B, 3)`."""
        others = () if self.others is None else map(Pose, *(x.unbind(1) for x in self.others))
        return [self.pose, *others]


class Hypotheses(NamedTuple):
    r"""Up to :math:`S` poses for each sample: what a minimal solver returns.

    Attributes:
        pose: rotations :math:`(B, S, 3, 3)` and translations :math:`(B, S, 3)` in the frame of the sample.
        valid: which slots hold a solution, bool, shape :math:`(B, S)`. The other slots are finite.
    """

    pose: Pose
    valid: Tensor


class Refinement(NamedTuple):
    r"""A refined pose: what a refiner returns.

    Attributes:
        pose: the refined pose in the frame of the :class:`Correspondences`.
        weights: the weight of each pair at that pose, shape :math:`(B, N)`.
        cost: mean robust loss of the pairs at that pose, shape :math:`(B,)`.
        ok: whether the pose is to be believed, bool, shape :math:`(B,)`.
        in_front: whether at least three pairs with a weight are in front of the camera, bool, shape :math:`(B,)`.
        probability: probability that the pose is not far off, shape :math:`(B,)`.
    """

    pose: Pose
    weights: Tensor
    cost: Tensor
    ok: Tensor
    in_front: Tensor
    probability: Tensor


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
        ok: whether the pose is to be believed, bool, shape :math:`(B,)`. Where ``ok`` is false the fields above are
            finite and carry no gradient.
        init: the first guess. It carries a gradient for every valid problem, also where refinement failed, so that an
            initialiser can learn from its failures.
        status: why a problem is not ``ok``: the value of a :class:`Status`, int8, shape :math:`(B,)`.
        probability: estimated probability that the pose is not far off, which is within 10 degrees and 30 % of the
            distance of the points, shape :math:`(B,)`, without gradient. Where the solver neither knows nor estimates
            the noise, it is taken from the residuals. Peers do not estimate it: theirs is 1 where ``ok``.
        alternatives: other poses that explain the pairs nearly as well; no slots where the call did not ask for them.
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
        intrinsics: camera matrices, shape :math:`(B, 3, 3)`.
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

    @property
    def sigmas(self) -> dict[str, Tensor]:
        """The known standard deviations, as keyword arguments of a solver's call."""
        sigmas = {"img_sigma": self.img_sigma, "world_sigma": self.world_sigma}
        return {name: sigma for name, sigma in sigmas.items() if sigma is not None}

    @property
    def known(self) -> dict[str, Tensor]:
        """The known noise and the confidences, as keyword arguments of a solver's call."""
        more = {"img_cov": self.img_cov, "world_cov": self.world_cov, "confidence": self.confidence}
        return self.sigmas | {name: value for name, value in more.items() if value is not None}

    def map(self, function: Callable[[Tensor], Tensor]) -> Problems:
        """Apply a function to every tensor, for example to slice the batch or to move it to another device."""
        return map_tensors(function, self)
