"""OpenCV's ``solvePnP`` and the two families of its ``solvePnPRansac``."""

from __future__ import annotations

import math
from types import ModuleType

import numpy as np
from kornia.core.check import KORNIA_CHECK

from kornia_pnpnet.peers.base import PeerPose, PeerSolver, RobustPeer, missing

__all__ = ["OpenCVPnP", "OpenCVRansac", "OpenCVUsac"]


def _import_opencv() -> ModuleType:
    try:
        import cv2
    except ImportError as error:
        raise missing("OpenCV") from error
    return cv2


def _check_method(cv2: ModuleType, method: str) -> None:
    KORNIA_CHECK(hasattr(cv2, f"SOLVEPNP_{method}"), f"OpenCV {cv2.__version__} has no SOLVEPNP_{method}.")


class OpenCVPnP(PeerSolver):
    r"""OpenCV's ``solvePnP`` on all pairs, problem by problem: nothing in it is robust to a wrong pair.

    Every pair is reported as an inlier; the cost is not truncated.

    Args:
        method: OpenCV's name of the solver, for example ``"EPNP"`` for ``SOLVEPNP_EPNP``. A name, because the numbers
            differ between OpenCV's versions.

    Raises:
        ImportError: when OpenCV is not installed.
        BaseError: for an unknown method.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> problems = SyntheticProblems(n=9, batch_size=4, seed=0).batch(0)
        >>> OpenCVPnP(method="EPNP")(problems.world_points, problems.img_points, problems.intrinsics).ok
        tensor([True, True, True, True])
    """

    def __init__(self, *, method: str = "SQPNP") -> None:
        super().__init__(threshold=math.inf)
        _check_method(_import_opencv(), method)
        self.method = method

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """Solve one problem, see :meth:`PeerSolver.solve_one`."""
        cv2 = _import_opencv()
        flag = getattr(cv2, f"SOLVEPNP_{self.method}")
        try:
            found, rotation_vector, translation = cv2.solvePnP(world_points, img_points, intrinsics, None, flags=flag)
            if not found:
                return None
            rotation = cv2.Rodrigues(rotation_vector)[0]
        except cv2.error:  # an assertion of OpenCV's, on degenerate or too few pairs
            return None
        return PeerPose(rotation, translation.ravel(), np.ones(len(world_points), dtype=bool))


class _Robust(RobustPeer):
    """What the families of ``solvePnPRansac`` share."""

    iterations: int

    def _search(
        self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray, flag: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """The rotation vector, the translation and the indices of the inliers, or ``None`` when nothing was found."""
        cv2 = _import_opencv()
        cv2.setRNGSeed(self.seed)
        found, rotation_vector, translation, kept = cv2.solvePnPRansac(
            world_points,
            img_points,
            intrinsics,
            None,
            iterationsCount=self.iterations,
            reprojectionError=self.threshold,
            confidence=self.confidence,
            flags=flag,
        )
        return (rotation_vector, translation, kept.ravel()) if found and kept is not None else None


class OpenCVRansac(_Robust):
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
            solved before it.

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
        super().__init__(threshold=threshold, iterations=iterations, confidence=confidence, seed=seed)
        KORNIA_CHECK(type(refine) is bool, f"refine must be true or false, got {refine!r}.")
        _check_method(_import_opencv(), method)
        self.method = method
        self.refine = refine

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """Solve one problem, see :meth:`PeerSolver.solve_one`."""
        cv2 = _import_opencv()
        try:
            found = self._search(world_points, img_points, intrinsics, getattr(cv2, f"SOLVEPNP_{self.method}"))
            if found is None:
                return None
            rotation_vector, translation, kept = found
            first = cv2.Rodrigues(rotation_vector)[0], translation.ravel().copy()
            if self.refine and len(kept) > 3:
                rotation_vector, translation = cv2.solvePnPRefineLM(
                    world_points[kept], img_points[kept], intrinsics, None, rotation_vector, translation
                )
            rotation = cv2.Rodrigues(rotation_vector)[0]
        except cv2.error:  # an assertion of OpenCV's, on degenerate or too few pairs
            return None
        return PeerPose(rotation, translation.ravel(), np.isin(np.arange(len(world_points)), kept), *first)


class OpenCVUsac(_Robust):
    r"""OpenCV's ``solvePnPRansac`` in one of its USAC variants, problem by problem.

    USAC has its own samples, local optimisation and final polishing; nothing is refined afterwards. The default
    threshold is tuned as that of :class:`OpenCVRansac`.

    Args:
        threshold: largest reprojection error of an inlier, in the pixels that the solver is given.
        method: OpenCV's name of the variant, for example ``"USAC_ACCURATE"`` or ``"USAC_MAGSAC"``. ``USAC_PROSAC``
            expects the pairs from the best to the worst. A name, because the numbers differ between OpenCV's
            versions.
        iterations: largest number of iterations.
        confidence: it ends when it has seen an outlier-free sample with this probability, in (0, 1).
        seed: of OpenCV's global random numbers, set before each problem; the local optimisation draws from them. The
            samples are drawn from a generator that OpenCV starts anew for every problem.

    Raises:
        ImportError: when OpenCV is not installed.
        BaseError: for an unknown method or an argument out of range.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> problems = SyntheticProblems(n=9, batch_size=4, seed=0).batch(0)
        >>> OpenCVUsac()(problems.world_points, problems.img_points, problems.intrinsics).ok
        tensor([True, True, True, True])
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
        super().__init__(threshold=threshold, iterations=iterations, confidence=confidence, seed=seed)
        cv2 = _import_opencv()
        # USAC_FM_8PTS is in the same list but finds fundamental matrices.
        known = method.startswith("USAC_") and method != "USAC_FM_8PTS" and hasattr(cv2, method)
        KORNIA_CHECK(known, f"OpenCV {cv2.__version__} has no {method} for poses.")
        self.method = method

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """Solve one problem, see :meth:`PeerSolver.solve_one`."""
        cv2 = _import_opencv()
        try:
            found = self._search(world_points, img_points, intrinsics, getattr(cv2, self.method))
            if found is None:
                return None
            rotation_vector, translation, kept = found
            rotation = cv2.Rodrigues(rotation_vector)[0]
        except cv2.error:  # an assertion of OpenCV's, on degenerate or too few pairs
            return None
        return PeerPose(rotation, translation.ravel(), np.isin(np.arange(len(world_points)), kept))
