"""Distances between poses that can be trained with, and the paper's loss over both stages."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from kornia_pnpnet.types import PnPResult, Pose, Problems

__all__ = ["LossTerms", "PoseLoss", "pose_distances"]


class LossTerms(NamedTuple):
    """The loss and the four mean distances that it weighs, each a scalar.

    Attributes:
        total: the weighted sum, saturated per problem.
        init_rotation: chordal rotation distance of the first guess.
        init_translation: translation distance of the first guess at the centroid of the points.
        refined_rotation: chordal rotation distance after refinement.
        refined_translation: translation distance after refinement.
    """

    total: Tensor
    init_rotation: Tensor
    init_translation: Tensor
    refined_rotation: Tensor
    refined_translation: Tensor


def pose_distances(estimate: Pose, truth: Pose) -> tuple[Tensor, Tensor]:
    r"""Distances whose gradient is bounded everywhere, also at 0.

    Args:
        estimate: rotation :math:`(B, 3, 3)` and translation :math:`(B, 3)`.
        truth: the same shapes.

    Returns:
        :math:`\|\hat R - R\|_F = 2\sqrt2 \sin(\theta / 2)` and :math:`\|\hat t - t\|`, each :math:`(B,)`.

    Example:
        >>> eye = Pose(torch.eye(3)[None], torch.zeros(1, 3))
        >>> turned = Pose(torch.tensor([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]]), torch.tensor([[3.0, 4, 0]]))
        >>> pose_distances(turned, eye)
        (tensor([2.]), tensor([5.]))
    """
    return _lengths(_difference(estimate, truth))


def _difference(estimate: Pose, truth: Pose) -> Pose:
    """The estimate minus the truth, entry by entry."""
    return Pose(estimate.rotation - truth.rotation, estimate.translation - truth.translation)


def _lengths(difference: Pose) -> tuple[Tensor, Tensor]:
    """Frobenius and Euclidean norm of the parts, each (B,)."""
    tiny = torch.finfo(difference.rotation.dtype).tiny
    rotation = (difference.rotation.square().sum((-2, -1)) + tiny).sqrt()
    translation = (difference.translation.square().sum(-1) + tiny).sqrt()
    return rotation, translation


def _at(points: Tensor, difference: Pose) -> Pose:
    """The difference of the same poses for a world whose origin is at ``points``, (B, 3)."""
    turned = (difference.rotation * points[:, None]).sum(-1)
    return Pose(difference.rotation, difference.translation + turned)


class PoseLoss(nn.Module):
    r"""Weighted sum of four distances: rotation and translation, after the first stage and after the refinement.

    After the refinement the translation is compared as it is scored. The first stage's is compared at the centroid of
    the world points: at the world's origin, which may be far from them, it would mostly repeat the rotation error.

    A refinement that fails is off by any amount; so that such problems do not drown the others, the refined distance
    :math:`d` of a problem may be saturated to :math:`d / (1 + d / c)`. With :math:`c` near the limit of success the
    loss follows the success rate.

    Args:
        rotation: weight of the chordal rotation distances.
        translation: weight of the refined translation distance, per unit of length.
        init_translation: weight of the first stage's translation distance, per unit of length.
        refined: weight of the refined terms against the first stage's, before the ramp.
        saturation: :math:`c`; ``None`` does not saturate.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> problems = SyntheticProblems(batch_size=1, seed=0).batch(0)
        >>> result = PnPResult(*problems.pose, torch.ones(1, 9), torch.zeros(1), torch.tensor([True]), problems.pose)
        >>> PoseLoss()(result, problems).total.item() < 1e-6
        True
    """

    def __init__(
        self,
        *,
        rotation: float = 1.0,
        translation: float = 0.1,
        init_translation: float = 0.02,
        refined: float = 1.0,
        saturation: float | None = None,
    ) -> None:
        super().__init__()
        self.rotation = rotation
        self.translation = translation
        self.init_translation = init_translation
        self.refined = refined
        self.saturation = saturation

    def forward(self, result: PnPResult, problems: Problems, ramp: float = 1.0) -> LossTerms:
        r"""Compare a solver's result with the truth.

        Args:
            result: of :math:`B` problems.
            problems: what was solved, with the true poses.
            ramp: factor of the refined terms, 0 at the start of the training. Then no gradient goes through them.

        Returns:
            The loss and its terms, means over the batch.
        """
        centroid = problems.world_points.mean(1)
        init_rotation, init_translation = _lengths(_at(centroid, _difference(result.init, problems.pose)))
        with torch.set_grad_enabled(torch.is_grad_enabled() and ramp > 0.0):
            rotation, translation = pose_distances(result.pose, problems.pose)
        init = self.rotation * init_rotation + self.init_translation * init_translation
        refined = self.rotation * rotation + self.translation * translation
        if self.saturation is not None:
            refined = refined / (1.0 + refined / self.saturation)
        total = init + ramp * self.refined * refined
        terms = (total, init_rotation, init_translation, rotation, translation)
        return LossTerms(*(term.mean() for term in terms))
