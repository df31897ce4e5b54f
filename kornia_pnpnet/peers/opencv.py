"""OpenCV's PnP solvers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from kornia.core.check import KORNIA_CHECK

from kornia_pnpnet.peers.base import PeerPose, PeerSolver, RobustPeer

__all__ = ["OpenCVPnP", "OpenCVRansac", "OpenCVUsac"]

_SOURCE = "cv2", "OpenCV"


def _check_method(peer: PeerSolver, name: str) -> None:
    cv2 = peer.library()
    KORNIA_CHECK(hasattr(cv2, name), f"OpenCV {cv2.__version__} has no {name} for poses.")


@dataclass(eq=False, repr=False, kw_only=True)
class OpenCVPnP(PeerSolver):
    r"""OpenCV's ``solvePnP`` on all pairs, problem by problem. The solver is not robust to outliers.

    Every pair is reported as an inlier; the cost is not truncated.

    Args:
        method: OpenCV's name of the solver, for example ``"EPNP"`` for ``SOLVEPNP_EPNP``.
    """

    threshold: float = field(default=math.inf, init=False)
    method: str = "SQPNP"
    source = _SOURCE

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_method(self, f"SOLVEPNP_{self.method}")

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """See :meth:`PeerSolver.solve_one`."""
        cv2 = self.library()
        flag = getattr(cv2, f"SOLVEPNP_{self.method}")
        try:
            found, rotation_vector, translation = cv2.solvePnP(world_points, img_points, intrinsics, None, flags=flag)
        except cv2.error:  # an assertion of OpenCV's, on degenerate or too few pairs
            return None
        if not found:
            return None
        return PeerPose(cv2.Rodrigues(rotation_vector)[0], translation.ravel(), np.ones(len(world_points), dtype=bool))


@dataclass(eq=False, repr=False, kw_only=True)
class _Sampling(RobustPeer):
    """OpenCV's ``solvePnPRansac`` with the method ``flag``."""

    threshold: float = 50.0
    iterations: int = 1000
    method: str
    refine = False
    source = _SOURCE

    @property
    def flag(self) -> str:
        """OpenCV's name of the method."""
        return f"SOLVEPNP_{self.method}"

    def __post_init__(self) -> None:
        super().__post_init__()
        KORNIA_CHECK(type(self.refine) is bool, f"refine must be true or false, got {self.refine!r}.")
        _check_method(self, self.flag)

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """See :meth:`PeerSolver.solve_one`."""
        cv2 = self.library()
        cv2.setRNGSeed(self.seed)
        options = {"iterationsCount": self.iterations, "reprojectionError": self.threshold}
        options |= {"confidence": self.confidence, "flags": getattr(cv2, self.flag)}
        try:
            found, turn, shift, kept = cv2.solvePnPRansac(world_points, img_points, intrinsics, None, **options)
            if not found or kept is None:
                return None
            kept = kept.ravel()
            first = cv2.Rodrigues(turn)[0], shift.ravel().copy()
            if self.refine and len(kept) > 3:
                turn, shift = cv2.solvePnPRefineLM(world_points[kept], img_points[kept], intrinsics, None, turn, shift)
            rotation = cv2.Rodrigues(turn)[0]
        except cv2.error:  # an assertion of OpenCV's, on degenerate or too few pairs
            return None
        return PeerPose(rotation, shift.ravel(), np.isin(np.arange(len(world_points)), kept), first)


@dataclass(eq=False, repr=False, kw_only=True)
class OpenCVRansac(_Sampling):
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

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> problems = SyntheticProblems(n=9, batch_size=4, seed=0).batch(0)
        >>> OpenCVRansac()(problems.world_points, problems.img_points, problems.intrinsics).ok
        tensor([True, True, True, True])
    """

    method: str = "AP3P"
    refine: bool = True


@dataclass(eq=False, repr=False, kw_only=True)
class OpenCVUsac(_Sampling):
    r"""OpenCV's ``solvePnPRansac`` in one of its USAC variants, problem by problem.

    USAC has its own sampling, local optimisation and final refinement; nothing is refined afterwards. The default
    threshold is tuned in the same way as that of :class:`OpenCVRansac`, whose other arguments it has.

    Args:
        method: OpenCV's name of the variant, for example ``"USAC_ACCURATE"`` or ``"USAC_MAGSAC"``. ``USAC_PROSAC``
            expects the pairs sorted from the best to the worst.
        seed: used by the local optimisation. The samples come from a generator that OpenCV starts anew for every
            problem.
    """

    method: str = "USAC_ACCURATE"

    @property
    def flag(self) -> str:
        """OpenCV's name of the variant; USAC_FM_8PTS, for fundamental matrices, is in the same list and is none."""
        usable = self.method.startswith("USAC_") and self.method != "USAC_FM_8PTS"
        return self.method if usable else f"variant {self.method}"
