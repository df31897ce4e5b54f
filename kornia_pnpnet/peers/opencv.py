"""OpenCV's PnP solvers."""

from __future__ import annotations

import math
from types import ModuleType

import numpy as np
from kornia.core.check import KORNIA_CHECK

from kornia_pnpnet.peers.base import PeerPose, PeerSolver, RobustPeer, import_library

__all__ = ["OpenCVPnP", "OpenCVRansac", "OpenCVUsac"]


def _import_opencv() -> ModuleType:
    return import_library("cv2", "OpenCV")


def _check_method(method: str) -> str:
    cv2 = _import_opencv()
    KORNIA_CHECK(hasattr(cv2, f"SOLVEPNP_{method}"), f"OpenCV {cv2.__version__} has no SOLVEPNP_{method}.")
    return method


class OpenCVPnP(PeerSolver):
    r"""OpenCV's ``solvePnP`` on all pairs, problem by problem. The solver is not robust to outliers.

    Every pair is reported as an inlier; the cost is not truncated.

    Args:
        method: OpenCV's name of the solver, for example ``"EPNP"`` for ``SOLVEPNP_EPNP``.

    Raises:
        ImportError: when OpenCV is not installed.
        BaseError: for an unknown method.
    """

    def __init__(self, *, method: str = "SQPNP") -> None:
        super().__init__(threshold=math.inf)
        self.method = _check_method(method)

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """Solve one problem, see :meth:`PeerSolver.solve_one`."""
        cv2 = _import_opencv()
        flag = getattr(cv2, f"SOLVEPNP_{self.method}")
        try:
            found, rotation_vector, translation = cv2.solvePnP(world_points, img_points, intrinsics, None, flags=flag)
        except cv2.error:  # an assertion of OpenCV's, on degenerate or too few pairs
            return None
        if not found:
            return None
        return PeerPose(cv2.Rodrigues(rotation_vector)[0], translation.ravel(), np.ones(len(world_points), dtype=bool))


class _Robust(RobustPeer):
    """OpenCV's ``solvePnPRansac``."""

    iterations: int
    method: str
    refine = False
    # Start of the method's name in OpenCV.
    prefix = ""

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
                flags=getattr(cv2, self.prefix + self.method),
            )
            if not found or kept is None:
                return None
            kept = kept.ravel()
            first = cv2.Rodrigues(rotation_vector)[0], translation.ravel().copy()
            if self.refine and len(kept) > 3:
                rotation_vector, translation = cv2.solvePnPRefineLM(
                    world_points[kept], img_points[kept], intrinsics, None, rotation_vector, translation
                )
            rotation = cv2.Rodrigues(rotation_vector)[0]
        except cv2.error:  # an assertion of OpenCV's, on degenerate or too few pairs
            return None
        return PeerPose(rotation, translation.ravel(), np.isin(np.arange(len(world_points)), kept), first)


class OpenCVRansac(_Robust):
    r"""OpenCV's ``solvePnPRansac``, then ``solvePnPRefineLM`` on its inliers, problem by problem.

    The defaults are the best of a grid on the protocol's data (3000 problems of another seed without and with outliers,
    focal length 3400 px, thresholds from 30 to 120 px), where the noise of a near world point alone moves its pixel by
    17 px. Sharper world points need a lower threshold. With noise in the world points, ``method="SQPNP", refine=False``
    solves more problems, because SQPnP minimises an error in space and not in the image, but it takes several times as
    long.

    Args:
        threshold: largest reprojection error of an inlier, in pixels of the input.
        iterations: largest number of RANSAC iterations.
        confidence: RANSAC stops when it has drawn an outlier-free sample with this probability, in (0, 1).
        method: OpenCV's name of the solver of minimal samples, for example ``"AP3P"`` for ``SOLVEPNP_AP3P``.
        refine: minimise the squared reprojection error of the inliers, started from RANSAC's pose. The result keeps
            that pose as ``init``.
        seed: seed of OpenCV's global random numbers, set before each problem.

    Raises:
        ImportError: when OpenCV is not installed.
        BaseError: for an unknown method or an argument out of range.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> problems = SyntheticProblems(n=9, batch_size=4, seed=0).batch(0)
        >>> OpenCVRansac()(problems.world_points, problems.img_points, problems.intrinsics).ok
        tensor([True, True, True, True])
    """

    prefix = "SOLVEPNP_"

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
        super().__init__(locals())
        KORNIA_CHECK(type(refine) is bool, f"refine must be true or false, got {refine!r}.")
        _check_method(method)


class OpenCVUsac(_Robust):
    r"""OpenCV's ``solvePnPRansac`` in one of its USAC variants, problem by problem.

    USAC has its own sampling, local optimisation and final refinement; nothing is refined afterwards. The default
    threshold is tuned in the same way as that of :class:`OpenCVRansac`, whose other arguments it has.

    Args:
        method: OpenCV's name of the variant, for example ``"USAC_ACCURATE"`` or ``"USAC_MAGSAC"``. ``USAC_PROSAC``
            expects the pairs sorted from the best to the worst.
        seed: used by the local optimisation. The samples come from a generator that OpenCV starts anew for every
            problem.

    Raises:
        ImportError: when OpenCV is not installed.
        BaseError: for an unknown method or an argument out of range.
    """

    def __init__(
        self,
        *,
        threshold: float = 50.0,
        method: str = "USAC_ACCURATE",
        iterations: int = 1000,
        confidence: float = 0.9999,
        seed: int = 0,
    ) -> None:
        super().__init__(locals())
        cv2 = _import_opencv()
        # USAC_FM_8PTS is in the same list of OpenCV but computes fundamental matrices.
        known = method.startswith("USAC_") and method != "USAC_FM_8PTS" and hasattr(cv2, method)
        KORNIA_CHECK(known, f"OpenCV {cv2.__version__} has no {method} for poses.")
