"""The base classes of peers: checks of the input, the loop over problems, and the conversion of the results."""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass, fields
from types import ModuleType
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK
from kornia.core.exceptions import ShapeError
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import convert_points_from_homogeneous
from torch import Tensor, nn

from kornia_pnpnet.arguments import checked_inputs, restore_leading
from kornia_pnpnet.cameras import pinholes
from kornia_pnpnet.core.checks import check_positive, check_whole
from kornia_pnpnet.core.extras import needs
from kornia_pnpnet.problem import MIN_PAIRS
from kornia_pnpnet.result import Alternatives, PnPResult, Pose, Status

__all__ = ["PeerPose", "PeerSolver", "RobustPeer"]


class PeerPose(NamedTuple):
    r"""A peer's solution of one problem, in float64.

    Attributes:
        rotation: world-to-camera rotation, shape :math:`(3, 3)`.
        translation: world-to-camera translation, shape :math:`(3,)`.
        inliers: whether the library reports a pair as an inlier, bool, shape :math:`(N,)`.
        init: rotation and translation before the last refinement; ``None`` if the library does not report this pose.
            With ``None``, ``PnPResult.init`` is the final pose.
    """

    rotation: np.ndarray
    translation: np.ndarray
    inliers: np.ndarray
    init: tuple[np.ndarray, np.ndarray] | None = None


@dataclass(eq=False, repr=False, kw_only=True)
class PeerSolver(nn.Module):
    r"""A batched layer around a solver of another library. The library solves one problem at a time.

    A subclass is a dataclass that implements :meth:`solve_one`. The fields are the arguments of the constructor. The
    library gets the pairs that are present and have a weight above 0, but not the weights. A problem without a pose has
    ``ok=False``, and its pose is the identity. A problem is not solved if it
    has fewer than three pairs, a negative weight or a value that is not finite. A problem is also not solved if its
    camera has skew or a focal length of 0.

    Convention: ``x_cam = R x_world + t``, +z forward, pixels ``u = fx x/z + cx``.

    Args:
        threshold: largest reprojection error of an inlier in pixels; infinite if every pair is an inlier.

    Raises:
        ImportError: when the library is not installed.
        BaseError: for an argument out of range, or an option that the installed library does not have.
    """

    threshold: float
    #: Name of the module to import, and name of the library for error messages.
    source: ClassVar[tuple[str, str] | None] = None

    def __post_init__(self) -> None:
        super().__init__()
        check_positive(or_infinite=True, threshold=self.threshold)
        if self.source is not None:
            self.library()

    def library(self) -> ModuleType:
        """Import the library, or raise an ``ImportError`` that names the extra to install."""
        assert self.source is not None
        module, name = self.source
        with needs("eval", f"This solver needs {name}"):
            return importlib.import_module(module)

    def config(self) -> dict[str, float | int | str | bool]:
        """Return the arguments of the constructor as plain data."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.init}

    def extra_repr(self) -> str:
        """Show the arguments of the constructor."""
        return ", ".join(f"{key}={value!r}" for key, value in self.config().items())

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        r"""Solve one problem with the library.

        Args:
            world_points: shape :math:`(N, 3)`, float64, finite.
            img_points: pixels, shape :math:`(N, 2)`.
            intrinsics: shape :math:`(3, 3)`.

        Returns:
            The solution, or ``None`` when the library finds no pose.
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

        For arguments and errors see :meth:`~kornia_pnpnet.solver.PnPNet.forward`. Bearings and rigs raise
        ``ShapeError``.

        Returns:
            The :class:`~kornia_pnpnet.result.PnPResult` on the device of the input, without gradients. The dtype is
            float64 if an input is float64, else float32. A weight is 1 if the library reports the pair as an inlier,
            else 0. The cost in px² is the mean squared reprojection error of the pairs that the library gets. A squared
            error above the squared threshold counts as the squared threshold.
        """
        size, inputs = checked_inputs(world_points, img_points, intrinsics, weights, mask)
        if inputs.rig is not None:
            raise ShapeError(
                f"Solvers of other libraries take pixels (B, N, 2), got the shape {tuple(img_points.shape)}.",
                actual_shape=tuple(img_points.shape),
                expected_shape=["B", "N", "2"],
            )
        like, largest = inputs.world_points, torch.finfo(inputs.world_points.dtype).max
        world, img, cameras = (x.detach().cpu().double() for x in inputs[:3])
        present = torch.ones_like(world[..., 0], dtype=torch.bool) if inputs.mask is None else inputs.mask.cpu()
        shares = present.double() if inputs.weights is None else inputs.weights.detach().cpu().double()
        used = present & (shares > 0)
        cameras, pinhole = pinholes(cameras)
        pinhole &= (cameras[:, (0, 1, 2, 2), (1, 0, 0, 1)] == 0).all(-1)  # no peer supports skew
        # Not every peer supports a negative focal length, so that peers get the reflected image.
        signs = cameras.diagonal(dim1=1, dim2=2).sign()
        img, cameras = img * signs[:, None, :2], signs[..., None] * cameras
        sound = world.isfinite().all(-1) & img.isfinite().all(-1) & shares.isfinite() & (shares >= 0) | ~present
        status = torch.where(used.sum(-1) >= MIN_PAIRS, Status.NOT_BELIEVED, Status.TOO_FEW_PAIRS)
        status = torch.where(pinhole, status, Status.CAMERA)
        status = torch.where(sound.all(-1), status, Status.NOT_FINITE)

        eye = torch.eye(3, 4, dtype=world.dtype, device=world.device)
        poses = eye.repeat(2, len(world), 1, 1)  # final and initial poses
        inliers, ok = torch.zeros_like(shares), torch.zeros_like(world[:, 0, 0], dtype=torch.bool)
        for i in (status == Status.NOT_BELIEVED).nonzero()[:, 0].tolist():
            found = self.solve_one(world[i, used[i]].numpy(), img[i, used[i]].numpy(), cameras[i].numpy())
            if found is not None:
                both = np.stack([np.column_stack(x) for x in (found[:2], found.init or found[:2])])
                if np.isfinite(both).all():
                    poses[:, i], ok[i] = torch.from_numpy(both), True
                    inliers[i, used[i]] = torch.from_numpy(np.asarray(found.inliers)).double()

        truncated = _squared_errors(poses[0], world, img, cameras).clamp(max=min(self.threshold, largest**0.25) ** 2)
        cost = torch.where(used, truncated, 0.0).sum(-1) / used.sum(-1).clamp(min=1)

        kept = inliers > 0
        freedom = (2.0 * kept.sum(-1, dtype=truncated.dtype) - 6.0).clamp(min=1.0)
        sigma = (torch.where(kept, truncated, 0.0).sum(-1) / freedom).sqrt()

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
            intrinsics=back(torch.where(pinhole[:, None, None], signs[..., None] * cameras, eye[:, :3])),
            dist=like.new_zeros(len(like), 4),
            sigma=back(sigma),
            inliers=(inliers > 0).to(like.device),
        )
        return restore_leading(size, result)

    if TYPE_CHECKING:  # nn.Module.__call__ accepts and returns Any
        __call__ = forward


@dataclass(eq=False, repr=False, kw_only=True)
class RobustPeer(PeerSolver):
    """A peer that draws random samples. For the arguments see ``OpenCVRansac``.

    Raises:
        BaseError: for a ``threshold``, ``confidence``, ``seed`` or number of iterations out of range.
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


def _squared_errors(poses: Tensor, world: Tensor, img: Tensor, cameras: Tensor) -> Tensor:
    """The squared reprojection errors in px², (B, N); infinite for points behind the camera."""
    cam_points = world @ poses[..., :3].mT + poses[:, None, :, 3]
    in_front = cam_points[..., 2:] > 0
    pixels = convert_points_from_homogeneous(torch.where(in_front, cam_points, 1.0) @ cameras.mT, eps=0.0)
    errors = (pixels - img).square().sum(-1, keepdim=True)
    return torch.where(in_front, errors.nan_to_num(nan=math.inf), math.inf)[..., 0]
