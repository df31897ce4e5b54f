"""A peer wraps another library's solver in the call signature of PnPNet, to compare solvers on the same problems.

The constructor of a peer imports the library.
"""

from __future__ import annotations

import importlib
import math
import sys
import time
from dataclasses import dataclass, field, fields
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK
from kornia.geometry.camera import PinholeCamera
from torch import Tensor, nn

from kornia_pnpnet.arguments import checked_inputs, restore_leading
from kornia_pnpnet.cameras import pinholes, reproject
from kornia_pnpnet.core.checks import check_form, check_positive, check_whole
from kornia_pnpnet.core.configured import as_plain
from kornia_pnpnet.core.extras import needs
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.problem import MIN_PAIRS
from kornia_pnpnet.result import Alternatives, PnPResult, Pose, Status

__all__ = ["KorniaRs", "OpenCVPnP", "OpenCVRansac", "OpenCVUsac", "PeerPose", "PeerSolver", "PoseLib", "PyColmap"]

# Rows and columns of fx, fy, cx and cy (``PINHOLE`` parameters of COLMAP and PoseLib) in a camera matrix.
_PINHOLE = (0, 1, 0, 1), (0, 1, 2, 2)


class PeerPose(NamedTuple):
    """A peer's solution of one problem, in float64."""

    rotation: np.ndarray  #: World-to-camera rotation, shape :math:`(3, 3)`.
    translation: np.ndarray  #: World-to-camera translation, shape :math:`(3,)`.
    inliers: np.ndarray  #: Whether the library reports a pair as an inlier, bool, shape :math:`(N,)`.
    init: tuple[np.ndarray, np.ndarray] | None = None  #: Pose before the last refinement; ``None``: not reported.


@dataclass(eq=False, kw_only=True)
class PeerSolver(nn.Module):
    r"""A batched layer around a solver of another library. The library solves one problem at a time.

    A subclass implements :meth:`solve_one`, and is a dataclass whose fields are the arguments of the constructor. The
    library gets the pairs of positive weight that are not padding, but gets no weights. If no pose is found, ``ok`` is
    false, and the pose is the identity. A problem is not solved if the library would get fewer than three pairs, if a
    weight is negative or not finite, if a coordinate that the library would get is not finite, or if the camera has
    skew, a focal length of 0 or another fault. The values of padding are ignored.

    Convention: ``x_cam = R x_world + t``, +z forward, pixels ``u = fx x/z + cx``.

    Args:
        threshold: largest reprojection error, in pixels, of an inlier. A solver that takes every pair as an inlier has
            an infinite threshold.

    Raises:
        ImportError: when the library is not installed.
        BaseError: for an argument out of range, or an option that the installed library does not have.
    """

    threshold: float
    #: Elapsed time, in seconds, of the library's calls in the last call of the layer.
    library_s: float = field(default=math.nan, init=False, repr=False)
    #: Name of the module to import, and name of the library for error messages.
    source: ClassVar[tuple[str, str]]

    def __post_init__(self) -> None:
        super().__init__()
        for entry in fields(self):
            value = as_plain(getattr(self, entry.name))
            fits = type(entry.default) is not bool or type(value) is bool
            KORNIA_CHECK(fits, f"{entry.name} must be true or false, got {value!r}.")
            setattr(self, entry.name, value)
        check_positive(or_infinite=True, threshold=self.threshold)
        if hasattr(self, "source"):
            self.library()

    def library(self) -> ModuleType:
        """Import the library, or raise an ``ImportError`` that names the extra to install."""
        module, name = self.source
        if loaded := sys.modules.get(module):  # saves time in each call
            return loaded
        with needs("eval", f"This solver needs {name}"):
            return importlib.import_module(module)

    def config(self) -> dict[str, float | int | str | bool]:
        """Return the arguments of the constructor as plain data."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.init}

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """Solve one problem with the library, or return ``None`` when the library finds no pose.

        The arrays are finite, in float64, and have the shapes ``(N, 3)``, ``(N, 2)`` and ``(3, 3)``.
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

        For arguments and errors see :meth:`~kornia_pnpnet.solver.PnPNet.forward`. Bearings raise ``ShapeError``.

        Returns:
            The :class:`~kornia_pnpnet.result.PnPResult` on the device of the input, without gradients. The dtype is
            float64 if an input is float64, else float32. A pair has the weight 1 if the library reports the pair as an
            inlier, else 0. The cost, in px², is the mean squared reprojection error of the pairs that the library gets.
            Errors above the threshold are truncated to the threshold.
        """
        size, inputs = checked_inputs(world_points, img_points, intrinsics, weights, mask)
        check_form(["*", "N", "2"], img_points=img_points)  # no bearings
        like, largest = inputs.world_points, torch.finfo(inputs.world_points.dtype).max
        world, img, cameras = (x.detach().cpu().double() for x in inputs[:3])
        present = torch.ones_like(world[..., 0], dtype=torch.bool) if inputs.mask is None else inputs.mask.cpu()
        shares = present.double() if inputs.weights is None else inputs.weights.detach().cpu().double()
        used = present & (shares > 0)
        cameras, pinhole = pinholes(cameras)
        pinhole &= (cameras[:, (0, 1, 2, 2), (1, 0, 0, 1)] == 0).all(-1)  # no peer supports skew
        # If a focal length is negative, the pixels are reflected, because not every peer supports such cameras.
        signs = cameras.diagonal(dim1=1, dim2=2).sign()
        img, cameras = img * signs[:, None, :2], signs[..., None] * cameras
        sound = torch.cat((world, img), -1).isfinite().all(-1) | ~used
        sound &= shares.isfinite() & (shares >= 0) | ~present
        status = torch.where(used.sum(-1) >= MIN_PAIRS, Status.NOT_BELIEVED, Status.TOO_FEW_PAIRS)
        status = torch.where(pinhole, status, Status.CAMERA)
        status = torch.where(sound.all(-1), status, Status.NOT_FINITE)

        eye = torch.eye(3, 4, dtype=world.dtype, device=world.device)
        poses = eye.repeat(2, len(world), 1, 1)  # final and initial poses
        inliers, ok = torch.zeros_like(used), torch.zeros_like(pinhole)
        rows = (status == Status.NOT_BELIEVED).nonzero()[:, 0].tolist()
        arrays = [(world[i, used[i]].numpy(), img[i, used[i]].numpy(), cameras[i].numpy()) for i in rows]
        start = time.perf_counter()
        answers = [self.solve_one(*one) for one in arrays]
        self.library_s = time.perf_counter() - start
        for i, found in zip(rows, answers, strict=True):
            if found is not None:
                both = np.stack([np.column_stack(x) for x in (found[:2], found.init or found[:2])])
                if np.isfinite(both).all():
                    poses[:, i], ok[i] = torch.from_numpy(both), True
                    inliers[i, used[i]] = torch.from_numpy(np.asarray(found.inliers, dtype=bool))

        pose, init = (Pose(x[..., :3], x[..., 3]) for x in poses)
        errors = (reproject(world, cameras, pose) - img).square().sum(-1)
        truncated = errors.nan_to_num(nan=math.inf).clamp(max=min(self.threshold, largest**0.25) ** 2)
        cost = torch.where(used, truncated, 0.0).sum(-1) / used.sum(-1).clamp(min=1)
        freedom = (2.0 * inliers.sum(-1, dtype=truncated.dtype) - 6.0).clamp(min=1.0)
        sigma = (torch.where(inliers, truncated, 0.0).sum(-1) / freedom).sqrt()

        result = PnPResult(
            *pose,
            weights=inliers.double(),
            cost=torch.where(ok, cost, largest**0.5),
            ok=ok,
            init=init,
            status=torch.where(ok, Status.SOLVED, status).to(torch.int8),
            probability=ok.double(),
            alternatives=Alternatives.none(pose),
            intrinsics=torch.where(pinhole[:, None, None], signs[..., None] * cameras, eye[:, :3]),
            dist=cost.new_zeros(len(cost), 4),
            sigma=sigma,
            inliers=inliers,
        )

        def back(x: Tensor) -> Tensor:
            return x.clamp(-largest, largest).to(like) if x.is_floating_point() else x.to(like.device)

        return restore_leading(size, map_tensors(back, result))

    if TYPE_CHECKING:  # nn.Module.__call__ accepts and returns Any
        __call__ = forward


@dataclass(eq=False, kw_only=True)
class RobustPeer(PeerSolver):
    """A peer that draws random samples. For the arguments see :class:`OpenCVRansac`."""

    confidence: float = 0.9999
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(threshold=self.threshold)
        KORNIA_CHECK(0 < self.confidence < 1, f"confidence must lie in (0, 1), got {self.confidence}.")
        check_whole(0, seed=self.seed)
        check_whole(1, **{name: value for name, value in self.config().items() if name.endswith("iterations")})


@dataclass(eq=False, kw_only=True)
class _OpenCV(PeerSolver):
    """A solver of OpenCV. The name of OpenCV's constant is ``kind`` followed by ``method``."""

    method: str
    kind: ClassVar[str] = "SOLVEPNP_"
    source = "cv2", "OpenCV"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.flag()

    def flag(self) -> int:
        """Return OpenCV's constant for the method."""
        cv2, name = self.library(), self.kind + f"{self.method}".removeprefix(self.kind)
        usable = hasattr(cv2, name) and name != "USAC_FM_8PTS"  # USAC_FM_8PTS finds fundamental matrices
        KORNIA_CHECK(usable, f"OpenCV {cv2.__version__} has no method {self.method} for poses.")
        return int(getattr(cv2, name))

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """See :meth:`PeerSolver.solve_one`."""
        cv2 = self.library()
        try:
            return self._solve(cv2, world_points, img_points, intrinsics)
        except cv2.error:  # OpenCV raises on degenerate pairs and on too few pairs
            return None

    def _solve(self, cv2: Any, world: np.ndarray, img: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        raise NotImplementedError


@dataclass(eq=False, kw_only=True)
class OpenCVPnP(_OpenCV):
    r"""OpenCV's ``solvePnP`` on all pairs, problem by problem. Every pair is an inlier. The cost is not truncated.

    Args:
        method: OpenCV's name of the solver, for example ``"EPNP"`` for ``SOLVEPNP_EPNP``.
    """

    threshold: float = field(default=math.inf, init=False, repr=False)
    method: str = "SQPNP"

    def _solve(self, cv2: Any, world: np.ndarray, img: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        found, turn, shift = cv2.solvePnP(world, img, intrinsics, None, flags=self.flag())
        return PeerPose(cv2.Rodrigues(turn)[0], shift.ravel(), np.ones(len(world), dtype=bool)) if found else None


@dataclass(eq=False, kw_only=True)
class OpenCVRansac(_OpenCV, RobustPeer):
    r"""OpenCV's ``solvePnPRansac``, then ``solvePnPRefineLM`` on the inliers, problem by problem.

    The defaults were tuned on ``SyntheticProblems``, where the noise of a close world point moves its pixel by 17 px.
    World points with less noise need a lower threshold. With noisy world points, ``method="SQPNP", refine=False``
    solves more problems, because SQPnP minimises an object-space error. SQPnP takes several times as long.

    Args:
        threshold: largest reprojection error, in pixels, of an inlier.
        iterations: largest number of RANSAC iterations.
        confidence: RANSAC stops when a sample without outliers was drawn with at least this probability, in (0, 1).
        method: OpenCV's name of the solver for minimal samples, for example ``"AP3P"`` for ``SOLVEPNP_AP3P``.
        refine: whether to minimise the inliers' squared reprojection errors, starting from RANSAC's pose. The field
            ``init`` of the result is the pose before this refinement.
        seed: seed of OpenCV's global random number generator, set before each problem.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> problems = SyntheticProblems(n=9, batch_size=4, seed=0).batch(0)
        >>> OpenCVRansac()(problems.world_points, problems.img_points, problems.intrinsics).ok
        tensor([True, True, True, True])
    """

    threshold: float = 50.0
    iterations: int = 1000
    method: str = "AP3P"
    refine: bool = True

    def _solve(self, cv2: Any, world: np.ndarray, img: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        cv2.setRNGSeed(self.seed)
        options = {"iterationsCount": self.iterations, "reprojectionError": self.threshold}
        options |= {"confidence": self.confidence, "flags": self.flag()}
        found, turn, shift, kept = cv2.solvePnPRansac(world, img, intrinsics, None, **options)
        if not found or kept is None:
            return None
        kept = kept.ravel()
        first = cv2.Rodrigues(turn)[0], shift.ravel().copy()
        if self.refine and len(kept) > 3:
            turn, shift = cv2.solvePnPRefineLM(world[kept], img[kept], intrinsics, None, turn, shift)
        inliers = np.zeros(len(world), dtype=bool)
        inliers[kept] = True
        return PeerPose(cv2.Rodrigues(turn)[0], shift.ravel(), inliers, first)


@dataclass(eq=False, kw_only=True)
class OpenCVUsac(OpenCVRansac):
    r"""A USAC variant of OpenCV's ``solvePnPRansac``. USAC includes a refinement. See :class:`OpenCVRansac`.

    Args:
        method: OpenCV's name of the variant. ``USAC_PROSAC`` expects the pairs sorted from the best to the worst.
        seed: seed of the local optimisation only. OpenCV restarts the generator of the samples for every problem.
    """

    method: str = "USAC_ACCURATE"
    refine: bool = field(default=False, init=False, repr=False)
    kind = "USAC_"


@dataclass(eq=False, kw_only=True)
class KorniaRs(RobustPeer):
    r"""``solve_pnp_ransac`` of kornia-rs, problem by problem: RANSAC with P3P, then least squares on the inliers.

    kornia-rs computes in float32. Local optimisation is off, because it does not increase the number of solved
    ``SyntheticProblems``. For ``threshold``, ``confidence``, ``seed`` and the tuning of the default
    threshold, see :class:`OpenCVRansac`.

    Args:
        max_iterations: largest number of RANSAC iterations.
        method: kornia-rs's name of the solver for minimal samples, ``"AP3P"`` or ``"EPnP"``.
    """

    threshold: float = 40.0
    max_iterations: int = 1000
    method: str = "AP3P"
    source = "kornia_rs.k3d", "kornia-rs"

    def __post_init__(self) -> None:
        super().__post_init__()
        known = self.method in ("AP3P", "EPnP") and hasattr(self.library().PnPSolverMethod, self.method)
        KORNIA_CHECK(known, f"kornia-rs has no method {self.method!r}.")

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """See :meth:`PeerSolver.solve_one`."""
        k3d = self.library()
        options = {"threshold": self.threshold, "confidence": self.confidence, "max_iterations": self.max_iterations}
        options |= {"seed": self.seed, "method": getattr(k3d.PnPSolverMethod, self.method)}
        try:
            rotation, translation, inliers, _ = k3d.solve_pnp_ransac(world_points, img_points, intrinsics, **options)
        except ValueError:  # no pose found, or too few pairs for the method
            return None
        return PeerPose(rotation, translation, inliers.astype(bool))


@dataclass(eq=False, kw_only=True)
class PoseLib(RobustPeer):
    r"""PoseLib's ``estimate_absolute_pose``, problem by problem: LO-RANSAC (P3P), then a robust refinement on inliers.

    For ``threshold``, ``confidence``, ``seed`` and the tuning of the default threshold, see :class:`OpenCVRansac`.

    Args:
        min_iterations: smallest number of RANSAC iterations. PoseLib's default of 1000 is not better for 9 pairs.
        max_iterations: largest number of RANSAC iterations. If no pose is found, RANSAC runs all these iterations.
        progressive_sampling: use PROSAC, which needs pairs that are sorted from the best to the worst.
    """

    threshold: float = 40.0
    min_iterations: int = 100
    max_iterations: int = 10_000
    progressive_sampling: bool = False
    source = "poselib", "PoseLib"

    def __post_init__(self) -> None:
        super().__post_init__()
        poselib = self.library()
        unknown = self._options().keys() - poselib.RansacOptions().keys()
        KORNIA_CHECK(not unknown, f"PoseLib {poselib.__version__} has no options {sorted(unknown)}.")

    def _options(self) -> dict[str, Any]:
        options = {"max_reproj_error": self.threshold, "success_prob": self.confidence, "seed": self.seed}
        options |= {"min_iterations": self.min_iterations, "max_iterations": self.max_iterations}
        return {**options, "progressive_sampling": self.progressive_sampling}

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """See :meth:`PeerSolver.solve_one`."""
        camera = {"model": "PINHOLE", "width": -1, "height": -1, "params": intrinsics[_PINHOLE]}
        pose, report = self.library().estimate_absolute_pose(img_points, world_points, camera, self._options(), {})
        if report["num_inliers"] == 0:  # PoseLib found no pose
            return None
        return PeerPose(pose.R, pose.t, np.array(report["inliers"]))


@dataclass(eq=False, kw_only=True)
class PyColmap(RobustPeer):
    r"""COLMAP's absolute pose estimation, problem by problem: LO-RANSAC, then robust least squares on the inliers.

    For ``threshold``, ``confidence``, ``seed`` and the tuning of the default threshold, see :class:`OpenCVRansac`.

    Args:
        loss_scale: scale in pixels of the refinement's Cauchy loss, tuned like ``threshold``. COLMAP's default of 1 px
            suits world points with little noise, but solves several per cent fewer ``SyntheticProblems``.
        min_iterations: smallest number of RANSAC iterations.
        max_iterations: largest number of RANSAC iterations.
    """

    threshold: float = 50.0
    loss_scale: float = 15.0
    min_iterations: int = 100
    max_iterations: int = 10_000
    source = "pycolmap", "pycolmap"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(loss_scale=self.loss_scale)
        counts = f"min_iterations {self.min_iterations} must not exceed max_iterations {self.max_iterations}."
        KORNIA_CHECK(self.min_iterations <= self.max_iterations, counts)

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """See :meth:`PeerSolver.solve_one`."""
        pycolmap = self.library()
        camera = pycolmap.Camera(model="PINHOLE", width=1, height=1, params=intrinsics[_PINHOLE])
        ransac = {"max_error": self.threshold, "confidence": self.confidence, "random_seed": self.seed}
        ransac |= {"min_num_trials": self.min_iterations, "max_num_trials": self.max_iterations}
        ransac |= {"min_inlier_ratio": 0.0}  # the default, 0.1, would limit the number of trials further
        options = {"ransac": ransac}, {"loss_function_scale": self.loss_scale}
        found = pycolmap.estimate_and_refine_absolute_pose(img_points, world_points, camera, *options)
        if found is None:
            return None
        matrix = found["cam_from_world"].matrix()  # (3, 4)
        return PeerPose(matrix[:, :3], matrix[:, 3], found["inlier_mask"])
