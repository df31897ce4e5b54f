r"""Compute the losses of thousands of poses per problem at once.

A pixel :math:`b` and a point :math:`(x, y, z)` in the camera frame have the standardised squared residual

.. math:: e = \frac{(x - z\,b_u/f)^2 + (y - z\,b_v/f)^2}{(z \tau / f)^2 + \omega^2}

The definition is in :mod:`kornia_pnpnet.judge.inliers`. Here, numerator and denominator are multiplied by
:math:`(z/f)^2`. One matrix product projects all points with all poses.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.nn import functional

from kornia_pnpnet.core.performance import exporting
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.judge.evidence import groups, totals
from kornia_pnpnet.judge.inliers import MAX_ERROR, Thresholds
from kornia_pnpnet.problem import Problem, Term
from kornia_pnpnet.result import Pose

__all__ = ["SCORERS", "Scene", "Scorer", "as_entries", "as_pose"]

#: A function that maps standardised squared residuals of any shape to losses of the pairs, at least 0.
Scorer: TypeAlias = Callable[[Tensor], Tensor]

# For a point behind the camera, the numerator of e grows by this number times |depth|, so that e exceeds MAX_ERROR.
_BEHIND = 1e15


def _truncated(error: Tensor) -> Tensor:
    """Truncated squares (P. Torr and A. Zisserman, "MLESAC", CVIU 78(1), 2000, section 3)."""
    return error.clamp(max=1.0)


def _outliers(error: Tensor) -> Tensor:
    """The loss of the original RANSAC: 1 for an outlier, 0 for an inlier."""
    return (error >= 1.0).to(error.dtype)


#: Loss functions by name. The loss of a residual at or above the threshold is 1.
SCORERS: dict[str, Scorer] = {"msac": _truncated, "inliers": _outliers}


def as_pose(entries: Tensor) -> Pose:
    """Convert the entries (*, 12) of matrices [R | t], in row-major order, to poses."""
    matrix = entries.unflatten(-1, (3, 4))
    return Pose(matrix[..., :3], matrix[..., 3])


def as_entries(pose: Pose) -> Tensor:
    """Convert poses to the entries (*, 12) of :func:`as_pose`."""
    return torch.cat((pose.rotation, pose.translation[..., None]), -1).flatten(-2)


class Scene(NamedTuple):
    r"""The pairs of some problems in the form that scoring requires.

    Attributes:
        rows: :math:`x - z\,b_u/f`, :math:`y - z\,b_v/f` and :math:`z \tau / f` as linear functions of a pose. Each
            function has a coefficient per entry of :func:`as_pose`, and a constant. Shape :math:`(P, 3, N, 13)`.
        weights: weights of the pairs, see :meth:`of`, shape :math:`(P, 1, N)`.
        sq_world: :math:`\omega^2`, shape :math:`(P, 1, 1)` or :math:`(P, N, 1)`.
        terms: priors of the poses.
        zoomed: whether the last row of a pose is multiplied by a ratio of focal lengths, see ``Search``.
    """

    rows: Tensor
    weights: Tensor
    sq_world: Tensor
    terms: tuple[Term, ...] = ()
    zoomed: bool = False

    @classmethod
    def of(cls, problem: Problem, thresholds: Thresholds, dtype: torch.dtype) -> Scene:
        """Convert problems to a scene of the given dtype.

        Except in rigs, pairs whose pixels are in one cell share one weight. A cell has the size of the threshold.
        Otherwise, a far camera could make all points inliers of a small spot with many outliers.
        """
        weights = problem.weights
        if problem.rig is None:
            cells = (problem.img_points / thresholds.img[..., None]).round()
            all_weights = totals(groups(cells), weights)
            weights = weights * (weights / all_weights.clamp(min=torch.finfo(weights.dtype).tiny))
            eye = torch.eye(3, 4, dtype=problem.weights.dtype, device=problem.weights.device)
            first, second, third = eye.expand(1, 1, 3, 4).unbind(2)
        else:
            first, second, third = torch.cat((problem.rig.rotation, problem.rig.translation[..., None]), -1).unbind(2)
        u, v = (problem.img_points / problem.focal).split(1, -1)
        scale = (thresholds.img / problem.focal)[..., None].expand_as(u)
        camera = torch.stack((first - u * third, second - v * third, scale * third), 1)  # (P, 3, N, 4)
        points = functional.pad(problem.world_points, (0, 1), value=1.0)
        products = camera[..., :3, None] * points[:, None, :, None]
        scene = cls(
            torch.cat((products.flatten(-2), camera[..., 3:]), -1),
            weights[:, None],
            thresholds.world.square()[..., None] + torch.finfo(dtype).tiny,  # avoids 0/0 at the camera centre
            problem.pose_terms,
            problem.free_focal is not None,
        )
        return map_tensors(lambda x: x.to(dtype), scene)

    def pairs(self, positions: Tensor) -> Scene:
        """Select pairs by their positions in each problem, :math:`(P, n)`."""
        rows = self.rows.gather(2, positions[:, None, :, None].expand(-1, 3, -1, 13))
        return self._replace(rows=rows, weights=self.weights.gather(2, positions[:, None]))

    def losses(self, poses: Tensor, scorer: Scorer, *wider: float) -> list[Tensor]:
        """Losses (P, H) of poses (P, 12, H): the weighted sum of the pairs' losses, plus the losses of the priors.

        For each number in ``wider``, further losses (P, H) follow, with squared residuals divided by this number.
        """
        errors = self.errors(poses)
        losses = [(self.weights @ scorer(errors if by == 1.0 else errors / by))[:, 0] for by in (1.0, *wider)]
        if not self.terms:
            return losses
        pose = as_pose(poses.mT)
        if self.zoomed:
            zoom = functional.pad(pose.rotation[..., 2:, :].norm(dim=-1, keepdim=True), (0, 0, 2, 0), value=1.0)
            pose = Pose(pose.rotation / zoom, pose.translation / zoom[..., 0])
        for term in map_tensors(lambda x: x[:, None], self.terms):  # broadcasts over H poses
            penalty = term.disagreement(pose)
            losses = [x + penalty for x in losses]
        return losses

    def errors(self, poses: Tensor) -> Tensor:
        """Standardised squared residuals (P, N, H) of every pair for every pose (P, 12, H), at most MAX_ERROR.

        A penalty on the depth gives points behind the camera MAX_ERROR. A mask would be slower.
        """
        rows = self.rows.flatten(1, 2)
        x, y, z = torch.baddbmm(rows[..., 12:], rows[..., :12], poses).unflatten(1, self.rows.shape[1:3]).unbind(1)
        if exporting():  # ONNX cannot write into a part of a tensor
            x, z = x.clone(), z.clone()
        sq_limit = torch.addcmul(self.sq_world, z, z)
        sq_distance = x.mul_(x).addcmul_(y, y).add_(z.clamp_(max=0.0), alpha=-_BEHIND)
        return sq_distance.div_(sq_limit).clamp_(max=MAX_ERROR)
