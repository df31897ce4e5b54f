"""The RANSAC of kornia-rs, Kornia's library in Rust."""

from __future__ import annotations

from types import ModuleType

import numpy as np
from kornia.core.check import KORNIA_CHECK

from kornia_pnpnet.peers.base import PeerPose, RobustPeer, import_library

__all__ = ["KorniaRs"]


def _import_kornia_rs() -> ModuleType:
    return import_library("kornia_rs.k3d", "kornia-rs")


class KorniaRs(RobustPeer):
    r"""``solve_pnp_ransac`` of kornia-rs, problem by problem: P3P, RANSAC, then least squares of the inliers.

    The library computes in float32. The default threshold is the best of a grid on the protocol's data, as that of
    :class:`~kornia_pnpnet.peers.OpenCVRansac`. The local optimisation of the library, off by default there, finds
    nothing more on these data and is not offered here.

    Threshold, confidence and seed are those of :class:`~kornia_pnpnet.peers.OpenCVRansac`.

    Args:
        max_iterations: largest number of RANSAC iterations.
        method: the library's name of the solver of minimal samples, ``"AP3P"`` or ``"EPnP"``.

    Raises:
        ImportError: when kornia-rs is not installed.
        BaseError: for an unknown method or an argument out of range, or when the installed kornia-rs is too old to
            let the caller choose the method.
    """

    max_iterations: int
    method: str

    def __init__(
        self,
        *,
        threshold: float = 40.0,
        max_iterations: int = 1000,
        confidence: float = 0.9999,
        method: str = "AP3P",
        seed: int = 0,
    ) -> None:
        super().__init__(locals())
        methods = getattr(_import_kornia_rs(), "PnPSolverMethod", None)
        KORNIA_CHECK(methods is not None, "This kornia-rs has no PnPSolverMethod: pip install 'kornia_pnpnet[eval]'.")
        KORNIA_CHECK(method in ("AP3P", "EPnP") and hasattr(methods, method), f"kornia-rs has no method {method!r}.")

    def solve_one(self, world_points: np.ndarray, img_points: np.ndarray, intrinsics: np.ndarray) -> PeerPose | None:
        """Solve one problem, see :meth:`~kornia_pnpnet.peers.PeerSolver.solve_one`."""
        k3d = _import_kornia_rs()
        try:
            rotation, translation, inliers, _ = k3d.solve_pnp_ransac(
                world_points,
                img_points,
                intrinsics,
                method=getattr(k3d.PnPSolverMethod, self.method),
                threshold=self.threshold,
                max_iterations=self.max_iterations,
                confidence=self.confidence,
                seed=self.seed,
            )
        except ValueError:  # no pose found, or too few pairs for the method
            return None
        return PeerPose(rotation, translation, inliers.astype(bool))
