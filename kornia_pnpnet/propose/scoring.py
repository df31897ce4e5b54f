r"""Scores of thousands of poses per problem at once, and the rules that turn residuals into losses.

A new scoring rule is one entry of :data:`SCORERS`. The *standardised* squared residual :math:`e` of a pair is its
squared residual over the squared threshold, see :mod:`kornia_pnpnet.judge.inliers`. With both multiplied by
:math:`(z/f)^2` there is no division by the depth, and the projection is one matrix product:

.. math:: e = \frac{(x - z\,b_u/f)^2 + (y - z\,b_v/f)^2}{(z \tau / f)^2 + \omega^2}
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.judge.inliers import MAX_ERROR, Thresholds
from kornia_pnpnet.problem import Problem
from kornia_pnpnet.refine.terms import PoseTerm
from kornia_pnpnet.result import Pose

__all__ = ["SCORERS", "Scene", "Scorer"]

#: Maps standardised squared residuals of any shape to losses of the pairs.
Scorer: TypeAlias = Callable[[Tensor], Tensor]

# Added to the squared distance per unit of negative depth: points behind the camera then exceed MAX_ERROR.
_BEHIND = 1e15

#: Losses of a pair, 1 from the threshold on: the truncated squares of MSAC (P. Torr and A. Zisserman, "MLESAC",
#: CVIU 78(1), 2000, section 3), and RANSAC's count of outliers.
SCORERS: dict[str, Scorer] = {
    "msac": lambda error: error.clamp(max=1.0),
    "inliers": lambda error: (error >= 1.0).to(error.dtype),
}


class Scene(NamedTuple):
    r"""The pairs of some problems in the form that scoring reads.

    Attributes:
        points: homogeneous world points, shape :math:`(P, N, 4)`.
        pixels: pixel coordinates divided by the threshold in pixels, contiguous, shape :math:`(P, 2, N, 1)`.
        weights: weights of the pairs, shape :math:`(P, 1, N)`.
        depth_scale: :math:`\tau / f`, shape :math:`(P, 1, 1)`.
        sq_world: :math:`\omega^2`, shape :math:`(P, 1, 1)`.
        wider: threshold in pixels of each pair relative to :math:`\tau`, shape :math:`(P, N, 1)`; ``None``: 1.
        prior: what is known of the poses besides the pairs.
        rows: in a rig, what gives the three numerators of the residual as products with the twelve entries of a pose,
            and a constant, shape :math:`(P, 3, N, 13)`; ``None``: one camera.
    """

    points: Tensor
    pixels: Tensor
    weights: Tensor
    depth_scale: Tensor
    sq_world: Tensor
    wider: Tensor | None = None
    prior: PoseTerm | None = None
    rows: Tensor | None = None

    @classmethod
    def of(cls, problem: Problem, thresholds: Thresholds, dtype: torch.dtype) -> Scene:
        """Bring problems to this form, in a dtype that suffices to compare poses."""
        points = torch.cat((problem.world_points, torch.ones_like(problem.weights)[..., None]), -1)
        tau, wider = thresholds.img, None
        if tau.shape[1] > 1:
            tau = tau.mean(1, keepdim=True)
            wider = (thresholds.img / tau)[..., None]
        scene = cls(
            points,
            (problem.img_points / tau[..., None]).mT.contiguous()[..., None],
            problem.weights[:, None],
            (tau / problem.focal)[..., None],
            thresholds.world.square()[..., None] + torch.finfo(dtype).tiny,  # avoids 0/0 in the camera's centre
            wider,
            problem.prior,
            None if problem.rig is None else _rows_of_rig(problem, points, tau),
        )
        return map_tensors(lambda x: x.to(dtype), scene)

    def pairs(self, positions: Tensor) -> Scene:
        """Select pairs of each problem, :math:`(P, n)`."""
        at = positions[..., None]
        return self._replace(
            points=self.points.gather(1, at.expand(-1, -1, 4)),
            pixels=self.pixels.gather(2, at[:, None].expand(-1, 2, -1, -1)),
            weights=self.weights.gather(2, at.mT),
            wider=None if self.wider is None else self.wider.gather(1, at),
            rows=None if self.rows is None else self.rows.gather(2, at[:, None].expand(-1, 3, -1, 13)),
        )

    def pack(self, rotation: Tensor, translation: Tensor) -> Tensor:
        """Poses by components, (3, 3, P, H) and (3, P, H), in the form that :meth:`errors` reads, (P, 4, 3, H).

        These are transposed 3x4 matrices with the depth multiplied by ``depth_scale``. The poses are in the last
        dimension, where the arithmetic is fastest.
        """
        out = self.points.new_empty(translation.shape[1], 4, 3, translation.shape[2])
        out[:, :3] = rotation.permute(2, 1, 0, 3)
        out[:, 3] = translation.movedim(0, 1)
        if self.rows is None:
            out[:, :, 2] *= self.depth_scale
        return out

    def unpack(self, packed: Tensor) -> Tensor:
        """The 3x4 matrices :math:`[R | t]` of packed poses, :math:`(P, 4, 3, H)` to :math:`(P, H, 3, 4)`."""
        matrices = packed.permute(0, 3, 2, 1).contiguous()
        if self.rows is None:
            matrices[:, :, 2] /= self.depth_scale
        return matrices

    def losses(self, packed: Tensor, scorer: Scorer) -> Tensor:
        """Weighted sum of the losses of pairs and prior at each pose, :math:`(P, 4, 3, H)` to :math:`(P, H)`."""
        losses = (self.weights @ scorer(self.errors(packed)))[:, 0]
        if self.prior is None:
            return losses
        matrices = self.unpack(packed)
        prior = map_tensors(lambda x: x[:, None], self.prior)  # for each of H poses
        return losses + prior.disagreement(Pose(matrices[..., :3], matrices[..., 3]))

    def errors(self, packed: Tensor) -> Tensor:
        """The standardised squared residual of every pair at every pose of :meth:`pack`, (P, N, H), at most MAX_ERROR.

        Every operation passes once over memory, in place. There is no mask: comparing and selecting would take longer
        than all the arithmetic.
        """
        if self.rows is not None:
            rows = self.rows.flatten(1, 2)
            x, y, z = torch.baddbmm(rows[..., 12:], rows[..., :12], packed.flatten(1, 2)).chunk(3, 1)
        else:
            x, y, z = (self.points @ packed.flatten(2)).split(packed.shape[-1], -1)  # (P, N, H) each
            x.addcmul_(self.pixels[:, 0], z, value=-1.0)
            y.addcmul_(self.pixels[:, 1], z, value=-1.0)
        limit = z if self.wider is None else z * self.wider
        sq_limit = torch.addcmul(self.sq_world, limit, limit)
        sq_distance = x.mul_(x).addcmul_(y, y).add_(z.clamp_(max=0.0), alpha=-_BEHIND)
        return sq_distance.div_(sq_limit).clamp_(max=MAX_ERROR)


def _rows_of_rig(problem: Problem, points: Tensor, tau: Tensor) -> Tensor:
    """``rows`` of a :class:`Scene`; the depth is multiplied by ``depth_scale``."""
    assert problem.rig is not None
    cameras = torch.cat((problem.rig.rotation, problem.rig.translation[..., None]), -1)  # (B, N, 3, 4)
    first, second, third = cameras.unbind(2)
    u, v = (problem.img_points / problem.focal).split(1, -1)
    scale = (tau / problem.focal)[..., None]
    rows = torch.stack((first - u * third, second - v * third, scale * third), 1)  # (B, 3, N, 4)
    products = points[:, None, :, :, None] * rows[..., None, :3]
    return torch.cat((products.flatten(-2), rows[..., 3:]), -1)
