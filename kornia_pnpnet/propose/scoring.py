r"""Scores of thousands of poses per problem at once, and the rules that turn residuals into losses.

A new scoring rule is one entry of :data:`SCORERS`. The *standardised* squared residual :math:`e` of a pair is its
squared residual over the squared threshold, see :mod:`kornia_pnpnet.judge.belief`. With both multiplied by
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
from kornia_pnpnet.refine.prior import votes
from kornia_pnpnet.types import Problem, FramedPrior, Pose

__all__ = ["SCORERS", "Scene", "Scorer", "standardised_errors"]

#: Maps standardised squared residuals of any shape to losses of the pairs.
Scorer: TypeAlias = Callable[[Tensor], Tensor]

# Added to the squared distance per unit of negative depth: points behind the camera then exceed MAX_ERROR.
_BEHIND = 1e15


def _truncated(error: Tensor) -> Tensor:
    return error.clamp(max=1.0)


def _outlier(error: Tensor) -> Tensor:
    return (error >= 1.0).to(error.dtype)


#: Losses of a pair, 1 from the threshold on: the truncated squares of MSAC (P. Torr and A. Zisserman, "MLESAC",
#: CVIU 78(1), 2000, section 3), and RANSAC's count of outliers.
SCORERS: dict[str, Scorer] = {"msac": _truncated, "inliers": _outlier}


class Scene(NamedTuple):
    r"""The pairs of some problems in the form that scoring reads.

    Attributes:
        points: homogeneous world points, shape :math:`(P, N, 4)`.
        u: horizontal pixel coordinates divided by the threshold in pixels, shape :math:`(P, N, 1)`.
        v: vertical pixel coordinates divided by the threshold in pixels, shape :math:`(P, N, 1)`.
        weights: weights of the pairs, shape :math:`(P, 1, N)`.
        depth_scale: :math:`\tau / f`, shape :math:`(P, 1, 1)`.
        sq_world: :math:`\omega^2`, shape :math:`(P, 1, 1)`.
        wider: threshold in pixels of each pair relative to :math:`\tau`, shape :math:`(P, N, 1)`; ``None``: 1.
        prior: what is known of the poses besides the pairs.
        rows: in a rig, what gives the three numerators of the residual as products with the twelve entries of a pose,
            shape :math:`(P, 3 N, 12)`; ``None``: one camera.
        shifts: the same for poses whose entries are all 0, shape :math:`(P, 3 N, 1)`.
    """

    points: Tensor
    u: Tensor
    v: Tensor
    weights: Tensor
    depth_scale: Tensor
    sq_world: Tensor
    wider: Tensor | None = None
    prior: FramedPrior | None = None
    rows: Tensor | None = None
    shifts: Tensor | None = None

    @classmethod
    def make(cls, corr: Problem, thresholds: Thresholds, dtype: torch.dtype) -> Scene:
        """Bring correspondences to this form, in a dtype that suffices to compare poses."""
        points = torch.cat((corr.world_points, torch.ones_like(corr.weights)[..., None]), -1)
        tau, wider = thresholds.img, None
        if tau.ndim == 2:
            tau = tau.mean(1)
            wider = (thresholds.img / tau[:, None])[..., None].to(dtype)
        u, v = (corr.img_points / tau[:, None, None]).to(dtype).split(1, -1)
        # `tiny` avoids 0/0 for a point in the camera's centre.
        sq_world = thresholds.world.square() + torch.finfo(dtype).tiny
        rows, shifts = (None, None) if corr.rig is None else _rows_of_rig(corr, points, tau)
        return cls(
            points.to(dtype),
            u.contiguous(),
            v.contiguous(),
            corr.weights[:, None].to(dtype),
            (tau / corr.focal).to(dtype)[:, None, None],
            sq_world.to(dtype)[:, None, None],
            wider,
            map_tensors(lambda x: x.to(dtype), corr.prior),
            *map_tensors(lambda x: x.to(dtype), (rows, shifts)),
        )

    def of(self, problems: Tensor) -> Scene:
        """Select problems, :math:`(P,)`."""
        return map_tensors(lambda x: x[problems], self)

    def pairs(self, positions: Tensor) -> Scene:
        """Select pairs of each problem, :math:`(P, n)`."""
        at = positions[..., None]
        rows, shifts = self.rows, self.shifts
        if rows is not None and shifts is not None:
            three = torch.cat([at + i * self.points.shape[1] for i in range(3)], 1)
            rows, shifts = rows.gather(1, three.expand(-1, -1, 12)), shifts.gather(1, three)
        return self._replace(
            rows=rows,
            shifts=shifts,
            points=self.points.gather(1, at.expand(-1, -1, 4)),
            u=self.u.gather(1, at),
            v=self.v.gather(1, at),
            weights=self.weights.gather(2, at.mT),
            wider=None if self.wider is None else self.wider.gather(1, at),
        )

    def pack(self, rotation: Tensor, translation: Tensor) -> Tensor:
        r"""Bring :math:`H` poses of each problem to the form that :func:`standardised_errors` reads.

        Args:
            rotation: rotations by components, shape :math:`(3, 3, P, H)`.
            translation: translations by components, shape :math:`(3, P, H)`.

        Returns:
            Transposed 3x4 matrices with the depth multiplied by ``depth_scale``. The poses are in the last dimension,
            where the arithmetic is fastest, shape :math:`(P, 4, 3, H)`.
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
        losses = (self.weights @ scorer(standardised_errors(self, packed)))[:, 0]
        if self.prior is None:
            return losses
        matrices = self.unpack(packed)
        prior = map_tensors(lambda x: x[:, None], self.prior)  # for each of H poses
        return losses + 0.5 * prior.rank - votes(prior, Pose(matrices[..., :3], matrices[..., 3]))


def _rows_of_rig(corr: Problem, points: Tensor, tau: Tensor) -> tuple[Tensor, Tensor]:
    """``rows`` and ``shifts`` of a :class:`Scene`; the depth is multiplied by ``depth_scale``."""
    assert corr.rig is not None
    rotation, translation = corr.rig
    first, second, third = rotation.unbind(2)  # (B, N, 3)
    x, y, z = translation.unbind(2)
    u, v = (corr.img_points / corr.focal).unbind(-1)
    scale = (tau / corr.focal)[:, None]
    directions = [first - u[..., None] * third, second - v[..., None] * third, scale[..., None] * third]
    rows = torch.cat([points[..., :, None] * d[..., None, :] for d in directions], 1).flatten(2)
    return rows, torch.cat((x - u * z, y - v * z, scale * z), 1)[..., None]


def standardised_errors(scene: Scene, packed: Tensor) -> Tensor:
    r"""Compute the standardised squared residual of every pair at every pose.

    Every operation passes once over memory, in place. There is no mask: comparing and selecting would take longer than
    all the arithmetic.

    Args:
        scene: :math:`P` problems of :math:`N` pairs.
        packed: poses of :meth:`Scene.pack`, shape :math:`(P, 4, 3, H)`.

    Returns:
        At most :data:`~kornia_pnpnet.judge.inliers.MAX_ERROR`, shape :math:`(P, N, H)`.

    Example:
        >>> points = torch.tensor([[[0.0, 0.0, 4.0], [1.0, 0.0, 4.0]]])
        >>> corr = Problem(points, torch.zeros(1, 2, 2), torch.ones(1, 2), torch.tensor(100.0))
        >>> scene = Scene.make(corr, Thresholds(torch.tensor([10.0]), torch.tensor([0.0])), torch.float64)
        >>> standardised_errors(scene, scene.pack(torch.eye(3).view(3, 3, 1, 1), torch.zeros(3, 1, 1)))[0, :, 0]
        tensor([0.0000, 6.2500], dtype=torch.float64)
    """
    count = packed.shape[-1]
    if scene.rows is not None and scene.shifts is not None:
        x, y, z = torch.baddbmm(scene.shifts, scene.rows, packed.flatten(1, 2)).chunk(3, 1)
    else:
        x, y, z = (scene.points @ packed.flatten(2)).split(count, -1)  # (P, N, H) each
        x.addcmul_(scene.u, z, value=-1.0)
        y.addcmul_(scene.v, z, value=-1.0)
    limit = z if scene.wider is None else z * scene.wider
    sq_limit = torch.addcmul(scene.sq_world, limit, limit)
    sq_distance = x.mul_(x).addcmul_(y, y).add_(z.clamp_(max=0.0), alpha=-_BEHIND)
    return sq_distance.div_(sq_limit).clamp_(max=MAX_ERROR)
