"""The base of every peer: the loop over problems, the checks before each problem, and the conversion of its results."""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass, fields
from types import ModuleType
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK
from kornia.core.exceptions import ShapeError
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import convert_points_from_homogeneous
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


@dataclass(eq=False, repr=False, kw_only=True)
class PeerSolver(nn.Module):
    r"""A solver of another library, which takes one problem at a time, as a batched layer without gradients.

    A subclass implements :meth:`solve_one` and is a dataclass, whose fields are the arguments of its constructor.
    The peer sees only the pairs that are present and have a weight above 0; the size of the weight has no effect. A
    problem fails, with ``ok=False`` and the identity as its pose, when the peer finds no pose, and without asking the
    peer when the problem is not finite, has a negative weight, fewer than three pairs, or a camera with skew or without
    a positive focal length.

    Convention: ``x_cam = R x_world + t``, +z forward, pixels ``u = fx x/z + cx``.

    Args:
        threshold: largest reprojection error of an inlier, in pixels of the input. Infinite for a peer that keeps all
            pairs.

    Raises:
        ImportError: when the library is not installed.
        BaseError: for an argument out of range, or an option that the installed library does not have.
    """

    threshold: float
    #: The module that the peer imports, and the name of its library.
    source: ClassVar[tuple[str, str] | None] = None

    def __post_init__(self) -> None:
        super().__init__()
        check_positive(or_infinite=True, threshold=self.threshold)
        if self.source is not None:
            self.library()

    def library(self) -> ModuleType:
        """Import the library, or raise an ImportError that names the extra which installs it."""
        assert self.source is not None
        module, name = self.source
        try:
            return importlib.import_module(module)
        except ImportError as error:
            raise ImportError(f"This solver needs {name}: pip install 'kornia_pnpnet[eval]'") from error

    def config(self) -> dict[str, float | int | str | bool]:
        """Return the arguments of the constructor as plain data."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.init}

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

        Args and errors are those of :meth:`~kornia_pnpnet.solver.PnPNet.forward`, for pixels only.

        Returns:
            The :class:`~kornia_pnpnet.result.PnPResult` on the device of the input, without gradients; float64 when any
            input is, else float32. Its weights are 1 for the inliers that the peer reports, else 0; its cost is the
            mean over the pairs of the squared reprojection error in px², truncated at the squared threshold.
        """
        size, inputs = checked_inputs(world_points, img_points, intrinsics, weights, mask)
        if inputs.rig is not None:
            raise ShapeError(
                f"Solvers of other libraries take pixels (B, N, 2), got the shape {tuple(img_points.shape)}.",
                actual_shape=tuple(img_points.shape),
                expected_shape=["B", "N", "2"],
            )
        like = inputs[0]
        world, img, cameras = (x.detach().cpu().double() for x in inputs[:3])
        shares = torch.ones_like(world[..., 0]) if inputs[3] is None else inputs[3].detach().cpu().double()
        present = torch.ones_like(shares, dtype=torch.bool) if inputs[4] is None else inputs[4].cpu()
        cameras, used = cameras / cameras[:, 2:, 2:], present & (shares > 0)
        status = _status(world, img, cameras, torch.where(present, shares, 0.0), present)

        poses = torch.eye(3, 4, dtype=torch.float64).repeat(2, len(world), 1, 1)  # final, before the last refinement
        inliers, ok = torch.zeros_like(shares), torch.zeros(len(world), dtype=torch.bool)
        for i in (status == Status.NOT_BELIEVED).nonzero()[:, 0].tolist():
            found = self.solve_one(world[i, used[i]].numpy(), img[i, used[i]].numpy(), cameras[i].numpy())
            if found is not None:
                both = np.stack([np.column_stack(x) for x in (found[:2], found.init or found[:2])])
                if np.isfinite(both).all():
                    poses[:, i], ok[i] = torch.from_numpy(both), True
                    inliers[i, used[i]] = torch.from_numpy(np.asarray(found.inliers)).double()

        largest = torch.finfo(like.dtype).max
        truncated = _squared_errors(poses[0], world, img, cameras).clamp(max=min(self.threshold, largest**0.25) ** 2)
        cost = torch.where(used, truncated, 0.0).sum(-1) / used.sum(-1).clamp(min=1)

        def back(values: Tensor) -> Tensor:
            return values.clamp(-largest, largest).to(like)

        pose, init = (Pose(back(x[..., :3]), back(x[..., 3])) for x in poses)
        result = PnPResult(
            *pose,
            weights=back(inliers),
            cost=back(torch.where(ok, cost, largest**0.5)),
            ok=ok.to(like.device),
            init=init,
            status=torch.where(ok, Status.SOLVED, status).to(like.device, torch.int8),
            probability=back(ok.double()),
            alternatives=Alternatives.none(pose),
            intrinsics=back(torch.where((status == Status.CAMERA)[:, None, None], torch.eye(3).double(), cameras)),
            dist=like.new_zeros(len(like), 4),
        )
        return restore_leading(size, result)


@dataclass(eq=False, repr=False, kw_only=True)
class RobustPeer(PeerSolver):
    """Base of the peers that draw samples. It checks ``threshold``, ``confidence``, ``seed`` and numbers of iterations.

    Raises:
        BaseError: for an argument out of range.
    """

    confidence: float = 0.9999
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(threshold=self.threshold)
        KORNIA_CHECK(0 < self.confidence < 1, f"confidence must lie in (0, 1), got {self.confidence}.")
        counts = {name: value for name, value in self.config().items() if name.endswith("iterations")}
        check_whole(0, seed=self.seed)
        check_whole(1, **counts)
        for name, value in {**counts, "seed": self.seed}.items():
            setattr(self, name, int(value))


def _status(world: Tensor, img: Tensor, cameras: Tensor, weights: Tensor, present: Tensor) -> Tensor:
    """Why problems are not passed to the peer, by the rules of ``Normalize``; ``NOT_BELIEVED`` for the others, (B,)."""
    sound = world.isfinite().all(-1) & img.isfinite().all(-1) & weights.isfinite() & (weights >= 0) | ~present  # (B, N)
    enough = (present & (weights > 0)).sum(-1) >= MIN_PAIRS
    focal, others = cameras[:, (0, 1), (0, 1)], cameras[:, (0, 1, 2, 2), (1, 0, 0, 1)]  # no peer takes a skew
    pinhole = cameras.isfinite().flatten(1).all(-1) & (focal > 0).all(-1) & (others == 0).all(-1)
    status = torch.where(enough, Status.NOT_BELIEVED, Status.TOO_FEW_PAIRS)
    status = torch.where(pinhole, status, Status.CAMERA)
    return torch.where(sound.all(-1), status, Status.NOT_FINITE)


def _squared_errors(poses: Tensor, world: Tensor, img: Tensor, cameras: Tensor) -> Tensor:
    """The squared reprojection errors in px², infinite behind the camera, (B, N)."""
    cam_points = world @ poses[..., :3].mT + poses[:, None, :, 3]
    in_front = cam_points[..., 2:] > 0
    pixels = convert_points_from_homogeneous(torch.where(in_front, cam_points, 1.0) @ cameras.mT, eps=0.0)
    errors = (pixels - img).square().sum(-1, keepdim=True)
    return torch.where(in_front, errors.nan_to_num(nan=math.inf), math.inf)[..., 0]
