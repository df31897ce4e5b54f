"""The tensors that travel between the parts of a solver, each a ``NamedTuple`` with its shape contract.

``NamedTuple`` is a pytree, so ``torch.compile``, ``torch.export``, ``torch.func`` and data loaders take these as they
are. The letters are the same everywhere: ``B`` problems in the batch, ``N`` pairs in each.
"""

from kornia_pnpnet.types.pairs import (
    LEAST_NOISE,
    MIN_PAIRS,
    Correspondences,
    FocalHypotheses,
    Guess,
    Hypotheses,
    Noise,
    Refinement,
)
from kornia_pnpnet.types.pose import FramedPrior, FreeFocal, Pose, PosePrior, camera_matrices
from kornia_pnpnet.types.results import Alternatives, PnPResult, Problems, Status

__all__ = [
    "LEAST_NOISE",
    "MIN_PAIRS",
    "Alternatives",
    "Correspondences",
    "FocalHypotheses",
    "FramedPrior",
    "FreeFocal",
    "Guess",
    "Hypotheses",
    "Noise",
    "PnPResult",
    "Pose",
    "PosePrior",
    "Problems",
    "Refinement",
    "Status",
    "camera_matrices",
]
