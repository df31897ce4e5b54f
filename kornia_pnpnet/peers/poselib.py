"""PoseLib's LO-RANSAC."""

from __future__ import annotations

from typing import Any

import numpy as np
from kornia.core.check import KORNIA_CHECK

from kornia_pnpnet.peers.base import PeerPose, RobustPeer, import_library, pinhole_parameters

__all__ = ["PoseLib"]


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

    Raises:
        ImportError: when PoseLib is not installed.
        BaseError: for an argument out of range, or when the installed PoseLib lacks one of the options; PoseLib
            itself would ignore an unknown option.
    """

    min_iterations: int
    max_iterations: int
    progressive_sampling: bool

    def __init__(
        self,
        *,
        threshold: float = 40.0,
        min_iterations: int = 100,
        max_iterations: int = 10_000,
        confidence: float = 0.9999,
        progressive_sampling: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__(locals())
        poselib = import_library("poselib", "PoseLib")
        unknown = self._options().keys() - poselib.RansacOptions().keys()
        KORNIA_CHECK(not unknown, f"PoseLib {poselib.__version__} has no options {sorted(unknown)}.")

    def _options(self) -> dict[str, Any]:
        """Return the options under PoseLib's names."""
        return {
            "max_reproj_error": self.threshold,
            "min_iterations": self.min_iterations,
            "max_iterations": self.max_iterations,
            "success_prob": self.confidence,
            "progressive_sampling": self.progressive_sampling,
            "seed": self.seed,
        }

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """Solve one problem, see :meth:`~kornia_pnpnet.peers.PeerSolver.solve_one`."""
        poselib = import_library("poselib", "PoseLib")
        camera = {"model": "PINHOLE", "width": -1, "height": -1, "params": pinhole_parameters(intrinsics)}
        pose, report = poselib.estimate_absolute_pose(img_points, world_points, camera, self._options(), {})
        if report["num_inliers"] == 0:  # PoseLib found no pose
            return None
        return PeerPose(pose.R, pose.t, np.array(report["inliers"]))
