"""The solvers of OpenCV, and the RANSACs of kornia-rs, PoseLib and COLMAP."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from kornia.core.check import KORNIA_CHECK

from kornia_pnpnet.core.checks import check_positive
from kornia_pnpnet.peers.base import PeerPose, PeerSolver, RobustPeer

__all__ = ["KorniaRs", "OpenCVPnP", "OpenCVRansac", "OpenCVUsac", "PoseLib", "PyColmap"]


@dataclass(eq=False, repr=False, kw_only=True)
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
        # The constant USAC_FM_8PTS is for fundamental matrices.
        usable = hasattr(cv2, name) and name != "USAC_FM_8PTS"
        KORNIA_CHECK(usable, f"OpenCV {cv2.__version__} has no method {self.method} for poses.")
        flag: int = getattr(cv2, name)
        return flag


@dataclass(eq=False, repr=False, kw_only=True)
class OpenCVPnP(_OpenCV):
    r"""OpenCV's ``solvePnP`` on all pairs, problem by problem. The solver is not robust to outliers.

    Every pair is reported as an inlier, and the cost is not truncated.

    Args:
        method: OpenCV's name of the solver, for example ``"EPNP"`` for ``SOLVEPNP_EPNP``.
    """

    threshold: float = field(default=math.inf, init=False)
    method: str = "SQPNP"

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """See :meth:`PeerSolver.solve_one`."""
        cv2 = self.library()
        try:
            found, turn, shift = cv2.solvePnP(world_points, img_points, intrinsics, None, flags=self.flag())
        except cv2.error:  # OpenCV raises on degenerate pairs and on too few pairs
            return None
        if not found:
            return None
        return PeerPose(cv2.Rodrigues(turn)[0], shift.ravel(), np.ones(len(world_points), dtype=bool))


@dataclass(eq=False, repr=False, kw_only=True)
class OpenCVRansac(_OpenCV, RobustPeer):
    r"""OpenCV's ``solvePnPRansac``, then ``solvePnPRefineLM`` on the inliers, problem by problem.

    The defaults are the best of a grid with thresholds from 30 to 120 px. The grid used 3000 problems of the protocol
    with another seed, without and with outliers. At the focal length of 3400 px, the noise of a close world point moves
    the pixel by 17 px. World points with less noise need a lower threshold. With noisy world points, the options
    ``method="SQPNP", refine=False`` solve more problems than the defaults, because SQPnP minimises an error in space
    and not in the image. With these options, a problem takes several times as long as with the defaults.

    Args:
        threshold: largest reprojection error of an inlier in pixels.
        iterations: largest number of RANSAC iterations.
        confidence: number in (0, 1). RANSAC stops when the probability of at least one sample without outliers reaches
            this number.
        method: OpenCV's name of the solver of minimal samples, for example ``"AP3P"`` for ``SOLVEPNP_AP3P``.
        refine: refine the pose of RANSAC by least squares of the inliers' reprojection errors. ``PnPResult.init`` is
            the pose of RANSAC.
        seed: seed of OpenCV's global random numbers, set before each problem.

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

    def __post_init__(self) -> None:
        super().__post_init__()
        KORNIA_CHECK(type(self.refine) is bool, f"refine must be true or false, got {self.refine!r}.")

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """See :meth:`PeerSolver.solve_one`."""
        cv2 = self.library()
        cv2.setRNGSeed(self.seed)
        options = {"iterationsCount": self.iterations, "reprojectionError": self.threshold}
        options |= {"confidence": self.confidence, "flags": self.flag()}
        try:
            found, turn, shift, kept = cv2.solvePnPRansac(world_points, img_points, intrinsics, None, **options)
            if not found or kept is None:
                return None
            kept = kept.ravel()
            first = cv2.Rodrigues(turn)[0], shift.ravel().copy()
            if self.refine and len(kept) > 3:
                turn, shift = cv2.solvePnPRefineLM(world_points[kept], img_points[kept], intrinsics, None, turn, shift)
            rotation = cv2.Rodrigues(turn)[0]
        except cv2.error:  # OpenCV raises on degenerate pairs and on too few pairs
            return None
        return PeerPose(rotation, shift.ravel(), np.isin(np.arange(len(world_points)), kept), first)


@dataclass(eq=False, repr=False, kw_only=True)
class OpenCVUsac(OpenCVRansac):
    r"""A USAC variant of OpenCV's ``solvePnPRansac``, problem by problem.

    USAC has its own sampling, local optimisation and final refinement, so the pose is not refined again. For the other
    arguments see :class:`OpenCVRansac`.

    Args:
        method: OpenCV's name of the variant, for example ``"USAC_ACCURATE"`` or ``"USAC_MAGSAC"``. ``USAC_PROSAC``
            expects the pairs sorted from the best to the worst.
        seed: seed of the local optimisation only. OpenCV restarts the generator of the samples for every problem.
    """

    method: str = "USAC_ACCURATE"
    refine: bool = field(default=False, init=False)
    kind = "USAC_"


def _pinhole(intrinsics: np.ndarray) -> list[float]:
    """Focal lengths and principal point in the order of the camera model ``PINHOLE`` of COLMAP and PoseLib."""
    return [intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]]


@dataclass(eq=False, repr=False, kw_only=True)
class KorniaRs(RobustPeer):
    r"""``solve_pnp_ransac`` of kornia-rs, problem by problem: P3P, RANSAC, then least squares of the inliers.

    kornia-rs computes in float32. There is no option for local optimisation, because local optimisation does not
    increase the number of solved problems on the protocol's data. For ``threshold``, its tuning, ``confidence`` and
    ``seed`` see :class:`OpenCVRansac`.

    Args:
        max_iterations: largest number of RANSAC iterations.
        method: kornia-rs's name of the solver of minimal samples, ``"AP3P"`` or ``"EPnP"``.
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
        options = {**self.config(), "method": getattr(k3d.PnPSolverMethod, self.method)}
        try:
            rotation, translation, inliers, _ = k3d.solve_pnp_ransac(world_points, img_points, intrinsics, **options)
        except ValueError:  # no pose found, or too few pairs for the method
            return None
        return PeerPose(rotation, translation, inliers.astype(bool))


@dataclass(eq=False, repr=False, kw_only=True)
class PoseLib(RobustPeer):
    r"""PoseLib's ``estimate_absolute_pose``, problem by problem: P3P, LO-RANSAC and a robust refinement of the inliers.

    For ``threshold``, its tuning, ``confidence`` and ``seed`` see :class:`OpenCVRansac`. PoseLib's own default for
    ``min_iterations`` is 1000. On problems of nine pairs, 1000 iterations solve no more problems than 100.

    Args:
        min_iterations: smallest number of RANSAC iterations.
        max_iterations: largest number of RANSAC iterations. A problem without a pose takes this number of iterations.
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
        """Return the options under PoseLib's names."""
        names = {"threshold": "max_reproj_error", "confidence": "success_prob"}
        return {names.get(name, name): value for name, value in self.config().items()}

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """See :meth:`PeerSolver.solve_one`."""
        camera = {"model": "PINHOLE", "width": -1, "height": -1, "params": _pinhole(intrinsics)}
        pose, report = self.library().estimate_absolute_pose(img_points, world_points, camera, self._options(), {})
        if report["num_inliers"] == 0:  # PoseLib found no pose
            return None
        return PeerPose(pose.R, pose.t, np.array(report["inliers"]))


@dataclass(eq=False, repr=False, kw_only=True)
class PyColmap(RobustPeer):
    r"""COLMAP's absolute pose estimation, problem by problem: LO-RANSAC, then robust least squares of the inliers.

    For ``threshold``, its tuning, ``confidence`` and ``seed`` see :class:`OpenCVRansac`. ``loss_scale`` is tuned on the
    same grid. COLMAP's own default for ``loss_scale`` is 1 px, which suits world points with little noise. With the
    noise of the protocol, 1 px solves several per cent fewer problems than 15 px.

    Args:
        loss_scale: scale of the Cauchy loss of the refinement in pixels.
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
        camera = pycolmap.Camera(model="PINHOLE", width=1, height=1, params=_pinhole(intrinsics))
        ransac = {"max_error": self.threshold, "confidence": self.confidence, "random_seed": self.seed}
        ransac |= {"min_num_trials": self.min_iterations, "max_num_trials": self.max_iterations}
        options = {"ransac": ransac}, {"loss_function_scale": self.loss_scale}
        found = pycolmap.estimate_and_refine_absolute_pose(img_points, world_points, camera, *options)
        if found is None:
            return None
        matrix = found["cam_from_world"].matrix()  # (3, 4)
        return PeerPose(matrix[:, :3], matrix[:, 3], found["inlier_mask"])
