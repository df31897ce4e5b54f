"""The base of every peer: the loop over problems, the checks before each problem, and the conversion of its results."""

from __future__ import annotations

import importlib
import inspect
import math
from collections.abc import Mapping
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK
from kornia.core.exceptions import ShapeError
from kornia.geometry.camera import PinholeCamera
from torch import Tensor, nn

from kornia_pnpnet.arguments import checked_inputs, restore_leading
from kornia_pnpnet.core.checks import check_positive, check_whole
from kornia_pnpnet.problem import MIN_PAIRS
from kornia_pnpnet.result import Alternatives, PnPResult, Pose, Status

__all__ = ["PeerPose", "PeerSolver"]


class PeerPose(NamedTuple):
    r"""The solution of one problem, in float64.

    Attributes:
        rotation: world-to-camera rotation, shape :math:`(3, 3)`.
        translation: world-to-camera translation, shape :math:`(3,)`.
        inliers: the pairs that the peer kept, bool, shape :math:`(N,)`.
        init: rotation and translation before the last refinement; ``None`` when the peer does not report them: the
            result then repeats the final pose.
    """

    rotation: np.ndarray
    translation: np.ndarray
    inliers: np.ndarray
    init: tuple[np.ndarray, np.ndarray] | None = None


class PeerSolver(nn.Module):
    r"""A solver of another library, which takes one problem at a time, as a batched layer without gradients.

    A subclass implements :meth:`solve_one` and keeps the arguments of its constructor as attributes of the same names.
    The peer sees only the pairs that are present and have a weight above 0; the size of the weight has no effect. A
    problem fails, with ``ok=False`` and the identity as its pose, when the peer finds no pose, and without asking the
    peer when the problem is not finite, has a negative weight, fewer than three pairs, or a camera with skew or without
    a positive focal length.

    Convention: ``x_cam = R x_world + t``, +z forward, pixels ``u = fx x/z + cx``.

    Args:
        threshold: largest reprojection error of an inlier, in pixels of the input. Infinite for a peer that keeps all
            pairs.

    Raises:
        BaseError: when ``threshold`` is not positive.
    """

    def __init__(self, *, threshold: float) -> None:
        super().__init__()
        check_positive(or_infinite=True, threshold=threshold)
        self.threshold = threshold

    def config(self) -> dict[str, float | int | str | bool]:
        """Return the arguments of the constructor as plain data."""
        return {name: getattr(self, name) for name in inspect.signature(type(self)).parameters}

    def extra_repr(self) -> str:
        """Show the arguments of the constructor."""
        return ", ".join(f"{key}={value!r}" for key, value in self.config().items())

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        r"""Solve one problem.

        Args:
            world_points: shape :math:`(N, 3)`, float64, finite.
            img_points: pixels, shape :math:`(N, 2)`.
            intrinsics: shape :math:`(3, 3)`.

        Returns:
            The pose, or ``None`` when the peer finds none.
        """
        raise NotImplementedError

    @torch.no_grad()
    def forward(
        self,
        world_points: Tensor,
        img_points: Tensor,
        intrinsics: Tensor | PinholeCamera,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
    ) -> PnPResult:
        r"""Solve a batch of problems, one after the other, on the CPU in float64.

        Args:
            world_points: shape :math:`(B, N, 3)`, any unit. Leading dimensions as in
                :meth:`~kornia_pnpnet.solver.PnPNet.forward`.
            img_points: pixels, shape :math:`(B, N, 2)`.
            intrinsics: camera matrices, shape :math:`(B, 3, 3)` or :math:`(3, 3)`, or Kornia's cameras.
            weights: pairs of weight 0 are left out, shape :math:`(B, N)`; 1 when ``None``.
            mask: False where a pair is padding, bool, shape :math:`(B, N)`.

        Returns:
            The :class:`~kornia_pnpnet.result.PnPResult` on the device of the input, without gradients; float64 when any
            input is, else float32. Its weights are 1 for the inliers that the peer reports, else 0; its cost is the
            mean over the pairs of the squared reprojection error in px², truncated at the squared threshold.

        Raises:
            ShapeError: for shapes that do not fit each other, or fewer than 3 pairs.
            TypeCheckError: for arguments that are no tensors, or hold booleans or complex numbers.
            DeviceError: for tensors on different devices.
        """
        size, inputs = checked_inputs(world_points, img_points, intrinsics, weights, mask)
        if inputs.rig is not None:
            raise ShapeError(
                f"Solvers of other libraries take pixels (B, N, 2), got the shape {tuple(img_points.shape)}.",
                actual_shape=tuple(img_points.shape),
                expected_shape=["B", "N", "2"],
            )
        world_points, img_points, intrinsics, weights, mask = inputs[:5]
        batch, count = world_points.shape[:2]
        world, img, cameras = (x.detach().cpu().double().numpy() for x in (world_points, img_points, intrinsics))
        with np.errstate(all="ignore"):  # a camera without a last entry is refused below
            cameras = cameras / cameras[:, 2:, 2:]
        shares = np.ones((batch, count)) if weights is None else weights.detach().cpu().double().numpy()
        present = np.ones((batch, count), dtype=bool) if mask is None else mask.detach().cpu().numpy()
        used = present & (shares > 0)
        status = _status(world, img, cameras, shares, present)

        poses = np.tile(np.eye(3, 4), (2, batch, 1, 1))  # the final pose, and that before the last refinement
        inliers, ok = np.zeros((batch, count)), np.zeros(batch, dtype=bool)
        for i in np.flatnonzero(status == Status.NOT_BELIEVED):
            found = self.solve_one(world[i, used[i]], img[i, used[i]], cameras[i])
            if found is not None and all(map(_finite, (*found[:2], *(found.init or ())))):
                final = np.column_stack((found.rotation, found.translation))
                start = final if found.init is None else np.column_stack(found.init)
                poses[:, i], inliers[i, used[i]], ok[i] = (final, start), found.inliers, True

        largest = torch.finfo(world_points.dtype).max
        errors = _squared_errors(poses[0], world, img, cameras, used & ok[:, None])
        truncated = np.minimum(errors, min(self.threshold, largest**0.25) ** 2)
        cost = np.where(ok, truncated.sum(-1) / np.maximum(used.sum(-1), 1), largest**0.5)

        def back(values: np.ndarray) -> Tensor:
            return torch.from_numpy(values).clamp(-largest, largest).to(world_points)

        pose, init = (Pose(back(x[..., :3]), back(x[..., 3])) for x in poses)
        result = PnPResult(
            *pose,
            back(inliers),
            back(cost),
            torch.from_numpy(ok).to(world_points.device),
            init,
            torch.from_numpy(np.where(ok, Status.SOLVED, status).astype(np.int8)).to(world_points.device),
            back(ok.astype(np.float64)),
            Alternatives.none(pose),
            back(np.where((status == Status.CAMERA)[:, None, None], np.eye(3), cameras)),
            back(np.zeros((batch, 4))),
        )
        return restore_leading(size, result)


class RobustPeer(PeerSolver):
    """Base of the peers that draw samples: checks and keeps their arguments.

    Args:
        arguments: ``locals()`` of the constructor that calls this one: ``threshold``, ``confidence``, ``seed``, numbers
            of iterations, and others, which are not checked.

    Raises:
        BaseError: for an argument out of range.
    """

    confidence: float
    seed: int

    def __init__(self, arguments: Mapping[str, Any]) -> None:
        options = {name: value for name, value in arguments.items() if name not in ("self", "__class__")}
        super().__init__(threshold=options["threshold"])
        check_positive(threshold=self.threshold)
        KORNIA_CHECK(0 < options["confidence"] < 1, f"confidence must lie in (0, 1), got {options['confidence']}.")
        counts = {name: value for name, value in options.items() if name.endswith("iterations")}
        check_whole(0, seed=options["seed"])
        check_whole(1, **counts)
        for name, value in options.items():
            setattr(self, name, int(value) if name in counts or name == "seed" else value)


def _finite(values: np.ndarray) -> bool:
    return bool(np.isfinite(values).all())


def _status(
    world: np.ndarray, img: np.ndarray, cameras: np.ndarray, weights: np.ndarray, present: np.ndarray
) -> np.ndarray:
    """Why problems are not passed to the peer, by the rules of ``Normalize``; ``NOT_BELIEVED`` for the others, (B,)."""
    sound = np.isfinite(world).all(-1) & np.isfinite(img).all(-1) & np.isfinite(weights) & (weights >= 0)  # (B, N)
    enough = (present & (weights > 0)).sum(-1) >= MIN_PAIRS
    # No peer takes a skew.
    pinhole = np.isfinite(cameras).all((-1, -2)) & (cameras[:, 0, 0] > 0) & (cameras[:, 1, 1] > 0)
    pinhole &= (cameras[:, (0, 1, 2, 2), (1, 0, 0, 1)] == 0).all(-1)
    reasons = [~(sound | ~present).all(-1), ~pinhole, ~enough]
    return np.select(reasons, [Status.NOT_FINITE, Status.CAMERA, Status.TOO_FEW_PAIRS], Status.NOT_BELIEVED)


def _squared_errors(
    poses: np.ndarray, world: np.ndarray, img: np.ndarray, cameras: np.ndarray, used: np.ndarray
) -> np.ndarray:
    """Return the squared reprojection errors in px², infinite behind the camera, 0 for unused pairs, (B, N)."""
    cameras = np.where(used.sum(-1)[:, None, None] > 0, cameras, np.eye(3))
    world, img = (np.where(used[..., None], x, 0.0) for x in (world, img))
    with np.errstate(over="ignore", invalid="ignore"):
        cam_points = world @ poses[..., :3].swapaxes(-1, -2) + poses[:, None, :, 3]  # (B, N, 3)
        depth = cam_points[..., 2:]
        focal, centre = cameras[:, None, (0, 1), (0, 1)], cameras[:, None, :2, 2]  # (B, 1, 2)
        projected = cam_points[..., :2] / np.where(depth > 0, depth, 1.0) * focal + centre
        errors = np.where(depth[..., 0] > 0, np.square(projected - img).sum(-1), math.inf)
    return np.where(used, np.nan_to_num(errors, nan=math.inf, posinf=math.inf), 0.0)


def import_library(module: str, library: str) -> ModuleType:
    """Import a module, or raise an ImportError that names the extra which installs the library."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"This solver needs {library}: pip install 'kornia_pnpnet[eval]'") from error


def pinhole_parameters(intrinsics: np.ndarray) -> list[float]:
    """Return focal lengths and principal point in the order of COLMAP's camera model ``PINHOLE``."""
    return [intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]]
