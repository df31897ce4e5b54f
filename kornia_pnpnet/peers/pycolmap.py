"""COLMAP's absolute pose estimation."""

from __future__ import annotations

import numpy as np
from kornia.core.check import KORNIA_CHECK

from kornia_pnpnet.core.checks import check_positive
from kornia_pnpnet.peers.base import PeerPose, RobustPeer, import_library, pinhole_parameters

__all__ = ["PyColmap"]


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

    Raises:
        ImportError: when pycolmap is not installed.
        BaseError: for an argument out of range.
    """

    min_iterations: int
    max_iterations: int
    loss_scale: float

    def __init__(
        self,
        *,
        threshold: float = 50.0,
        loss_scale: float = 15.0,
        min_iterations: int = 100,
        max_iterations: int = 10_000,
        confidence: float = 0.9999,
        seed: int = 0,
    ) -> None:
        super().__init__(locals())
        check_positive(loss_scale=loss_scale)
        counts = f"min_iterations {min_iterations} must not exceed max_iterations {max_iterations}."
        KORNIA_CHECK(min_iterations <= max_iterations, counts)
        import_library("pycolmap", "pycolmap")

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """Solve one problem, see :meth:`~kornia_pnpnet.peers.PeerSolver.solve_one`."""
        pycolmap = import_library("pycolmap", "pycolmap")
        camera = pycolmap.Camera(model="PINHOLE", width=1, height=1, params=pinhole_parameters(intrinsics))
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
