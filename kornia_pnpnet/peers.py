"""Solvers of other libraries behind the signature of ours, so that they can be compared on the same problems."""

from __future__ import annotations

import math
from types import ModuleType
from typing import NamedTuple

import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor, nn

from kornia_pnpnet.model import check_inputs
from kornia_pnpnet.types import PnPResult, Pose

__all__ = ["OpenCVRansac", "PeerPose", "PeerSolver"]


class PeerPose(NamedTuple):
    r"""What a peer finds for one problem, in float64.

    Attributes:
        rotation: world-to-camera rotation, shape :math:`(3, 3)`.
        translation: world-to-camera translation, shape :math:`(3,)`.
        inliers: which of the pairs it was given the peer kept, bool, shape :math:`(N,)`.
        init_rotation: rotation before the last refinement, shape :math:`(3, 3)`.
        init_translation: translation before the last refinement, shape :math:`(3,)`.
    """

    rotation: np.ndarray
    translation: np.ndarray
    inliers: np.ndarray
    init_rotation: np.ndarray
    init_translation: np.ndarray


class PeerSolver(nn.Module):
    r"""A solver that takes one problem at a time, as a batched layer without gradients.

    A subclass implements :meth:`solve_one`. Pairs with the weight 0 and padding are never shown to it; other weights
    do not matter. A problem that is not finite, has a negative weight, fewer than three pairs or a camera with skew or
    without a positive focal length, and one that the peer gives up, has ``ok=False`` and the identity as its pose.

    Convention: ``x_cam = R x_world + t``, +z forward, pixels ``u = fx x/z + cx``.

    Args:
        threshold: largest reprojection error of an inlier, in the pixels that the solver is given.

    Raises:
        BaseError: when ``threshold`` is not positive.
    """

    def __init__(self, *, threshold: float) -> None:
        super().__init__()
        KORNIA_CHECK(0 < threshold < math.inf, f"threshold must be positive and finite, got {threshold}.")
        self.threshold = threshold

    def config(self) -> dict[str, float | int | str | bool]:
        """The constructor arguments, as plain data."""
        return {"threshold": self.threshold}

    def extra_repr(self) -> str:
        """Show the constructor's arguments."""
        return ", ".join(f"{key}={value!r}" for key, value in self.config().items())

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        r"""Solve one problem.

        Args:
            world_points: shape :math:`(N, 3)`, float64, finite.
            img_points: pixels, shape :math:`(N, 2)`.
            intrinsics: shape :math:`(3, 3)`.

        Returns:
            What was found, or ``None`` when nothing was.
        """
        raise NotImplementedError

    @torch.no_grad()
    def forward(
        self,
        world_points: Tensor,
        img_points: Tensor,
        intrinsics: Tensor,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
    ) -> PnPResult:
        r"""Solve a batch of problems, one after the other, on the CPU in float64.

        Args:
            world_points: shape :math:`(B, N, 3)`, float32 or float64, any unit.
            img_points: pixels, shape :math:`(B, N, 2)`.
            intrinsics: camera matrices, shape :math:`(B, 3, 3)` or :math:`(3, 3)`.
            weights: pairs with 0 are left out, shape :math:`(B, N)`; 1 when ``None``.
            mask: False where a pair is padding, bool, shape :math:`(B, N)`.

        Returns:
            The :class:`~kornia_pnpnet.types.PnPResult` in the dtype and on the device of the input, without
            gradients. Its weights are 1 for the inliers that the peer reports, else 0; its cost is the mean over the
            pairs of the squared reprojection error in px², truncated at the squared threshold.

        Raises:
            ShapeError: for shapes that do not fit each other, or fewer than 3 pairs.
            TypeCheckError: for dtypes that differ or are not float32 or float64.
            DeviceError: for tensors on different devices.
        """
        check_inputs(world_points, img_points, intrinsics, weights, mask)
        batch, count = world_points.shape[:2]
        world, img, cameras = (x.detach().cpu().double().numpy() for x in (world_points, img_points, intrinsics))
        cameras = np.broadcast_to(cameras, (batch, 3, 3))
        shares = np.ones((batch, count)) if weights is None else weights.detach().cpu().double().numpy()
        present = np.ones((batch, count), dtype=bool) if mask is None else mask.detach().cpu().numpy()

        rotation, translation = np.tile(np.eye(3), (batch, 1, 1)), np.zeros((batch, 3))
        init_rotation, init_translation = rotation.copy(), translation.copy()
        pair_weights, ok = np.zeros((batch, count)), np.zeros(batch, dtype=bool)
        cost = np.full(batch, torch.finfo(world_points.dtype).max ** 0.5)
        for i in range(batch):
            if not _solvable(world[i], img[i], cameras[i], shares[i], present[i]):
                continue
            used = present[i] & (shares[i] > 0)
            found = self.solve_one(world[i, used], img[i, used], cameras[i])
            if found is None or not all(np.isfinite(part).all() for part in found):
                continue
            error = _squared_errors(found.rotation, found.translation, world[i, used], img[i, used], cameras[i])
            rotation[i], translation[i] = found.rotation, found.translation
            init_rotation[i], init_translation[i] = found.init_rotation, found.init_translation
            pair_weights[i, used] = found.inliers
            cost[i] = np.minimum(error, self.threshold**2).mean()
            ok[i] = True

        largest = torch.finfo(world_points.dtype).max

        def back(values: np.ndarray) -> Tensor:
            return torch.from_numpy(values).clamp(-largest, largest).to(world_points)

        return PnPResult(
            back(rotation),
            back(translation),
            back(pair_weights),
            back(cost),
            torch.from_numpy(ok).to(world_points.device),
            Pose(back(init_rotation), back(init_translation)),
        )


def _solvable(world: np.ndarray, img: np.ndarray, camera: np.ndarray, weights: np.ndarray, present: np.ndarray) -> bool:
    """Whether a problem may be shown to a peer; the rules of :class:`~kornia_pnpnet.normalize.Normalize`."""
    finite = all(np.isfinite(x).all() for x in (world[present], img[present], weights[present], camera))
    if not finite or (weights[present] < 0).any() or (present & (weights > 0)).sum() < 3:
        return False
    pinhole = camera[0, 1] == 0 and camera[1, 0] == 0 and (camera[2] == (0.0, 0.0, 1.0)).all()
    return bool(camera[0, 0] > 0 and camera[1, 1] > 0 and pinhole)


def _squared_errors(
    rotation: np.ndarray, translation: np.ndarray, world: np.ndarray, img: np.ndarray, camera: np.ndarray
) -> np.ndarray:
    """Squared reprojection errors in px², infinite behind the camera, shape (N,)."""
    with np.errstate(over="ignore", invalid="ignore"):
        cam_points = world @ rotation.T + translation
        depth = cam_points[:, 2:]
        in_front = depth[:, 0] > 0
        projected = cam_points[:, :2] / np.where(in_front[:, None], depth, 1.0) * camera.diagonal()[:2] + camera[:2, 2]
        return np.where(in_front, np.square(projected - img).sum(-1), np.inf)


def _import_opencv() -> ModuleType:
    try:
        import cv2
    except ImportError as error:
        raise ImportError("This solver needs OpenCV: pip install 'kornia_pnpnet[eval]'") from error
    return cv2


class OpenCVRansac(PeerSolver):
    r"""OpenCV's ``solvePnPRansac`` and ``solvePnPRefineLM`` on its inliers, problem by problem.

    The defaults are the best of a grid on the protocol's data (3000 problems of another seed without and with
    outliers, f = 3400 px, thresholds from 30 to 120 px): the noise of the world points alone moves a near point's
    pixel by 17 px. Pixels of a sharper world want a lower threshold. With noise in the world points,
    ``method="SQPNP", refine=False`` solves more problems: its error in space, not in the image, suits that noise. It
    takes several times as long.

    Args:
        threshold: largest reprojection error of an inlier, in the pixels that the solver is given.
        iterations: largest number of RANSAC iterations.
        confidence: RANSAC ends when it has seen an outlier-free sample with this probability, in (0, 1).
        method: OpenCV's name of the solver of samples, for example ``"AP3P"`` for ``SOLVEPNP_AP3P``. A name,
            because the numbers differ between OpenCV's versions.
        refine: minimise the squared reprojection error of the inliers from the RANSAC pose, which is kept as
            ``init``.
        seed: of OpenCV's global random numbers, set before each problem: a problem has the same result whatever is
            solved before it. Some methods, ``"SQPNP"`` among them, draw from them.

    Raises:
        ImportError: when OpenCV is not installed.
        BaseError: for an unknown method or an argument out of range.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> problems = SyntheticProblems(n=9, batch_size=4, seed=0).batch(0)
        >>> OpenCVRansac()(problems.world_points, problems.img_points, problems.intrinsics).ok
        tensor([True, True, True, True])
    """

    def __init__(
        self,
        *,
        threshold: float = 50.0,
        iterations: int = 1000,
        confidence: float = 0.9999,
        method: str = "AP3P",
        refine: bool = True,
        seed: int = 0,
    ) -> None:
        super().__init__(threshold=threshold)
        cv2 = _import_opencv()
        KORNIA_CHECK(type(iterations) is int and iterations >= 1, f"iterations must be at least 1, got {iterations!r}.")
        KORNIA_CHECK(type(refine) is bool, f"refine must be true or false, got {refine!r}.")
        KORNIA_CHECK(type(seed) is int, f"seed must be an integer, got {seed!r}.")
        KORNIA_CHECK(0.0 < confidence < 1.0, f"confidence must lie in (0, 1), got {confidence}.")
        KORNIA_CHECK(hasattr(cv2, f"SOLVEPNP_{method}"), f"OpenCV {cv2.__version__} has no SOLVEPNP_{method}.")
        self.iterations = iterations
        self.confidence = confidence
        self.method = method
        self.refine = refine
        self.seed = seed

    def config(self) -> dict[str, float | int | str | bool]:
        """The constructor arguments, as plain data."""
        names = ("iterations", "confidence", "method", "refine", "seed")
        return {**super().config(), **{name: getattr(self, name) for name in names}}

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """Solve one problem, see :meth:`PeerSolver.solve_one`."""
        cv2 = _import_opencv()
        cv2.setRNGSeed(self.seed)
        try:
            found, rotation_vector, translation, kept = cv2.solvePnPRansac(
                world_points,
                img_points,
                intrinsics,
                None,
                iterationsCount=self.iterations,
                reprojectionError=self.threshold,
                confidence=self.confidence,
                flags=getattr(cv2, f"SOLVEPNP_{self.method}"),
            )
            if not found or kept is None:
                return None
            first = cv2.Rodrigues(rotation_vector)[0], translation.ravel().copy()
            kept = kept.ravel()
            if self.refine and len(kept) > 3:
                rotation_vector, translation = cv2.solvePnPRefineLM(
                    world_points[kept], img_points[kept], intrinsics, None, rotation_vector, translation
                )
            rotation = cv2.Rodrigues(rotation_vector)[0]
        except cv2.error:  # an assertion of OpenCV's, on degenerate or too few pairs
            return None
        inliers = np.zeros(len(world_points), dtype=bool)
        inliers[kept] = True
        return PeerPose(rotation, translation.ravel(), inliers, *first)
