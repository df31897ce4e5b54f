"""The RANSACs of kornia-rs, PoseLib and COLMAP."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from kornia.core.check import KORNIA_CHECK

from kornia_pnpnet.core.checks import check_positive
from kornia_pnpnet.peers.base import PeerPose, RobustPeer

__all__ = ["KorniaRs", "PoseLib", "PyColmap"]


def _pinhole(intrinsics: np.ndarray) -> list[float]:
    """Focal lengths and principal point in the order of COLMAP's camera model ``PINHOLE``."""
    return [intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]]


@dataclass(eq=False, repr=False, kw_only=True)
class KorniaRs(RobustPeer):
    r"""``solve_pnp_ransac`` of kornia-rs, problem by problem: P3P, RANSAC, then least squares of the inliers.

    The library computes in float32. The default threshold is the best of a grid on the protocol's data, as that of
    :class:`~kornia_pnpnet.peers.OpenCVRansac`. The local optimisation of the library, off by default there, finds
    nothing more on these data and is not offered here.

    Threshold, confidence and seed are those of :class:`~kornia_pnpnet.peers.OpenCVRansac`.

    Args:
        max_iterations: largest number of RANSAC iterations.
        method: the library's name of the solver of minimal samples, ``"AP3P"`` or ``"EPnP"``.
    """

    threshold: float = 40.0
    max_iterations: int = 1000
    method: str = "AP3P"
    source = "kornia_rs.k3d", "kornia-rs"

    def __post_init__(self) -> None:
        super().__post_init__()
        methods = getattr(self.library(), "PnPSolverMethod", None)
        KORNIA_CHECK(methods is not None, "This kornia-rs has no PnPSolverMethod: pip install 'kornia_pnpnet[eval]'.")
        known = self.method in ("AP3P", "EPnP") and hasattr(methods, self.method)
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

    The default threshold is the best of a grid on the protocol's data, see
    :class:`~kornia_pnpnet.peers.OpenCVRansac`. PoseLib's own minimum of 1000 iterations, ten times
    the default here, finds nothing more with nine pairs.

    Threshold, confidence and seed are those of :class:`~kornia_pnpnet.peers.OpenCVRansac`.

    Args:
        min_iterations: smallest number of iterations.
        max_iterations: largest number of iterations. A problem without a pose takes all of them.
        progressive_sampling: PROSAC: samples of the first pairs come first, so put the best pairs first.
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
        options = self._options()
        pose, report = self.library().estimate_absolute_pose(img_points, world_points, camera, options, {})
        if report["num_inliers"] == 0:  # PoseLib found no pose
            return None
        return PeerPose(pose.R, pose.t, np.array(report["inliers"]))


@dataclass(eq=False, repr=False, kw_only=True)
class PyColmap(RobustPeer):
    r"""COLMAP's absolute pose estimation, problem by problem: LO-RANSAC, then robust least squares of the inliers.

    The default threshold and loss scale are the best of a grid on the protocol's data, see
    :class:`~kornia_pnpnet.peers.OpenCVRansac`. COLMAP's own loss scale of 1 px suits sharp points; with the
    noise of the protocol it solves several per cent fewer problems.

    Threshold, confidence and seed are those of :class:`~kornia_pnpnet.peers.OpenCVRansac`.

    Args:
        loss_scale: scale of the Cauchy loss of the refinement, in pixels of the input.
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
        ransac = {
            "max_error": self.threshold,
            "min_num_trials": self.min_iterations,
            "max_num_trials": self.max_iterations,
            "confidence": self.confidence,
            "random_seed": self.seed,
        }
        found = pycolmap.estimate_and_refine_absolute_pose(
            img_points, world_points, camera, {"ransac": ransac}, {"loss_function_scale": self.loss_scale}
        )
        if found is None:
            return None
        matrix = found["cam_from_world"].matrix()  # (3, 4)
        return PeerPose(matrix[:, :3], matrix[:, 3], found["inlier_mask"])
