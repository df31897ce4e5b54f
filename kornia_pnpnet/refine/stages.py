"""What a refinement plans before its first iteration, and what passes from one stage of the plan to the next."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

from kornia_pnpnet.types import Correspondences, Pose

__all__ = ["LMStart", "Stage", "State"]


class LMStart(NamedTuple):
    r"""Everything that the iterations of a refinement need, made before the first of them.

    Attributes:
        corr: the correspondences with the weights of the caller, problems last in memory. Their noise is known for
            every pair, or ``None``.
        prior: weight of each pair without the robust factor, for cost and verdict: the caller's times the
            initialiser's, or the caller's alone when there are iterations by residual, :math:`(B, N)`.
        pose: the first poses, :math:`(S B)`: one pose of every problem, then the next pose of every problem.
        guided: ``corr`` with weights of caller and initialiser, relative to the largest.
        by_residual: ``corr`` with the weights that the last iterations see: those of the caller alone, relative to
            their mean, or ``guided`` without such iterations.
        starts: ``guided`` once for each of the :math:`S` poses.
        rivals: the pairs by whose cost the :math:`S` poses compete; ``None`` when :math:`S = 1`.
        outlier_area: area of the image in which pixels of outliers lie, in square pixels, for problems for which the
            caller gave no sigma, so that the last iterations may correct the initialiser's estimate; 0 for the others,
            :math:`(B, 1)`; ``None`` when there are no such iterations.
        noiseless: problems for which neither the caller gave a sigma nor the initialiser an estimate, although the
            caller gave one for others, bool :math:`(B,)`; ``None``: no such problems.
        zoom: logarithm of the first focal lengths over those of the correspondences, :math:`(S B)`; ``None``: the focal
            lengths are known.
        step: :math:`\gamma` of each iteration, scalars.
        damping: :math:`\lambda` of each iteration, scalars.
        shape: shape of the kernel of each iteration, scalars.
    """

    corr: Correspondences
    prior: Tensor
    pose: Pose
    guided: Correspondences
    by_residual: Correspondences
    starts: Correspondences
    rivals: Correspondences | None
    outlier_area: Tensor | None
    noiseless: Tensor | None
    zoom: Tensor | None
    step: tuple[Tensor, ...]
    damping: tuple[Tensor, ...]
    shape: tuple[Tensor, ...]

    def zoomed(self, zoom: Tensor | None) -> LMStart:
        """With other focal lengths, see :meth:`~kornia_pnpnet.types.Correspondences.zoomed`, for one pose a problem."""
        corr, guided, by_residual = (x.zoomed(zoom) for x in (self.corr, self.guided, self.by_residual))
        return self._replace(corr=corr, guided=guided, by_residual=by_residual)


class State(NamedTuple):
    """Between two stages.

    Attributes:
        pose: the poses.
        solved: whether the last equations were solved.
        factor: a factor of the damping.
        zoom: see :class:`LMStart`.
    """

    pose: Pose
    solved: Tensor
    factor: Tensor
    zoom: Tensor | None = None


class Stage(NamedTuple):
    """One entry of a refinement's plan.

    Attributes:
        iteration: number of the iteration that it is, or that it precedes.
        advance: from the state before the stage to the state after it.
    """

    iteration: int
    advance: Callable[[State], State]
