r"""How well poses explain pairs, in units of what counts as an inlier: thousands of poses per problem at once.

A pair is an inlier of a pose when :math:`\|r\|^2 < \tau^2 + (f \omega / z)^2`: the threshold :math:`\tau` in pixels,
and the pixels that a move of the world point by the threshold :math:`\omega` makes at the depth :math:`z`. The ratio of
the two sides is the *standardised* squared residual :math:`e`. Times :math:`(z/f)^2` the ratio has no division by the
depth, and the projection is one matrix product:

.. math:: e = \frac{(x - z\,b_u/f)^2 + (y - z\,b_v/f)^2}{(z \tau / f)^2 + \omega^2}
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.geometry import Projection
from kornia_pnpnet.types import Correspondences

__all__ = ["SCORERS", "Judged", "Scene", "Scorer", "Thresholds", "chance_of_inlier", "judge", "standardised_errors"]

Scorer = Callable[[Tensor], Tensor]

#: Largest standardised squared residual, which points behind the camera have as well.
MAX_ERROR = 1e6
# Times a negative depth it is larger than any residual.
_BEHIND = 1e15


def _truncated(error: Tensor) -> Tensor:
    return error.clamp(max=1.0)


def _outlier(error: Tensor) -> Tensor:
    return (error >= 1.0).to(error.dtype)


#: Losses of a pair by its standardised squared residual :math:`e`, 1 at the threshold: the truncated squares of MSAC
#: (P. Torr and A. Zisserman, "MLESAC", CVIU 78(1), 2000, section 3), and RANSAC's count of outliers.
SCORERS: dict[str, Scorer] = {"msac": _truncated, "inliers": _outlier}


class Thresholds(NamedTuple):
    r"""What counts as an inlier in each problem.

    Attributes:
        img: :math:`\tau` in pixels of the normalised camera, shape :math:`(B,)`; where a pose is judged also
            :math:`(B, N)`.
        world: :math:`\omega` in units of the normalised world, likewise.
    """

    img: Tensor
    world: Tensor


class Judged(NamedTuple):
    r"""What one pose for each problem makes of the pairs.

    Attributes:
        weights: :math:`\tau^2 / (\tau^2 + (f \omega / z)^2)` for inliers, which is 1 without a threshold in the world,
            and 0 for all others, shape :math:`(B, N)`.
        errors: standardised squared residuals, below 1 for inliers, :data:`MAX_ERROR` behind the camera, shape
            :math:`(B, N)`.
    """

    weights: Tensor
    errors: Tensor


def judge(projection: Projection, corr: Correspondences, thresholds: Thresholds) -> Judged:
    """Tell which pairs are inliers of a pose, and how precise they are.

    Args:
        projection: :func:`~kornia_pnpnet.geometry.project` of a pose for each problem.
        corr: normalised correspondences. Pairs without weight are no inliers.
        thresholds: what counts as an inlier.

    Returns:
        Weights and errors of the pairs.

    Example:
        >>> from kornia_pnpnet.geometry import project
        >>> from kornia_pnpnet.types import Pose
        >>> points = torch.tensor([[[0.0, 0.0, 4.0], [1.0, 0.0, 4.0]]])
        >>> corr = Correspondences(points, torch.zeros(1, 2, 2), torch.ones(1, 2), torch.tensor(100.0))
        >>> projection = project(Pose(torch.eye(3)[None], torch.zeros(1, 3)), corr)
        >>> judge(projection, corr, Thresholds(torch.tensor([10.0]), torch.tensor([0.0])))
        Judged(weights=tensor([[1., 0.]]), errors=tensor([[0.0000, 6.2500]]))
    """
    img, world = map(_of_pairs, thresholds)
    sq_img = img.square()
    sq_limit = sq_img + (corr.focal * world * projection.inv_depth).square()
    errors = projection.sq_residual / sq_limit
    errors = torch.where(projection.in_front, errors, MAX_ERROR)
    inlier = (errors < 1.0) & (corr.weights > 0)
    return Judged(torch.where(inlier, sq_img / sq_limit, 0.0), errors)


def chance_of_inlier(corr: Correspondences, thresholds: Thresholds, judged: Judged) -> Tensor:
    r"""Probability that a pixel anywhere among the pixels of a problem fits as well as the worst inlier does.

    Anywhere is uniform in the smallest box, parallel to the axes, around the pixels. The disc around a projection that
    is as large as the worst inlier's share of its threshold covers at most its area, and no more than the strips that
    are as wide as the disc. The mean over the inliers is returned.

    Args:
        corr: normalised correspondences.
        thresholds: what counts as an inlier.
        judged: what :func:`judge` returned.

    Returns:
        At most 1, shape :math:`(B,)`.

    Example:
        >>> pixels = torch.tensor([[[0.0, 0.0], [400.0, 0.0], [0.0, 200.0]]])
        >>> corr = Correspondences(torch.zeros(1, 3, 3), pixels, torch.ones(1, 3), torch.tensor(100.0))
        >>> judged = Judged(torch.ones(1, 3), torch.tensor([[0.0, 0.1, 0.25]]))  # the worst is 5 px off
        >>> chance_of_inlier(corr, Thresholds(torch.tensor([10.0]), torch.tensor([0.0])), judged) * 400 * 200
        tensor([78.5398])
    """
    there, inlier = corr.weights[..., None] > 0, judged.weights > 0
    high = torch.where(there, corr.img_points, -torch.inf).amax(1)
    low = torch.where(there, corr.img_points, torch.inf).amin(1)
    eps = torch.finfo(high.dtype).eps  # a perfect fit of pixels that are all the same is no evidence
    sides = (high - low).clamp(min=eps)[:, None]  # (B, 1, 2)
    worst = torch.where(inlier, judged.errors, 0.0).amax(-1, keepdim=True).clamp(min=eps)
    sq_radius = worst * _of_pairs(thresholds.img).square() / torch.where(inlier, judged.weights, 1.0)
    strips = 2.0 * sq_radius.sqrt()[..., None] / sides  # (B, N, 2)
    chance = (0.25 * math.pi * strips.prod(-1)).minimum(strips.amin(-1)).clamp(max=1.0)
    return torch.where(inlier, chance, 0.0).sum(-1) / inlier.sum(-1).clamp(min=1)


def _of_pairs(threshold: Tensor) -> Tensor:
    """A threshold of each problem as one of each of its pairs."""
    return threshold[:, None] if threshold.ndim == 1 else threshold


class Scene(NamedTuple):
    r"""The pairs of some problems as scoring reads them.

    Attributes:
        points: homogeneous world points, shape :math:`(P, N, 4)`.
        u: horizontal pixel coordinates divided by the threshold in pixels, shape :math:`(P, N, 1)`.
        v: vertical ones, shape :math:`(P, N, 1)`.
        weights: shape :math:`(P, 1, N)`.
        depth_scale: :math:`\tau / f`, shape :math:`(P, 1, 1)`.
        sq_world: :math:`\omega^2`, shape :math:`(P, 1, 1)`.
    """

    points: Tensor
    u: Tensor
    v: Tensor
    weights: Tensor
    depth_scale: Tensor
    sq_world: Tensor

    @classmethod
    def make(cls, corr: Correspondences, thresholds: Thresholds, dtype: torch.dtype) -> Scene:
        """Prepare correspondences, see the attributes, in a dtype that suffices to compare poses."""
        points = torch.cat((corr.world_points, torch.ones_like(corr.weights)[..., None]), -1)
        u, v = (corr.img_points / thresholds.img[:, None, None]).to(dtype).split(1, -1)
        # A point in the camera's centre must not make 0/0.
        sq_world = thresholds.world.square() + torch.finfo(dtype).tiny
        return cls(
            points.to(dtype),
            u.contiguous(),
            v.contiguous(),
            corr.weights[:, None].to(dtype),
            (thresholds.img / corr.focal).to(dtype)[:, None, None],
            sq_world.to(dtype)[:, None, None],
        )

    def of(self, problems: Tensor) -> Scene:
        """The scenes of some problems."""
        return Scene(*(x[problems] for x in self))

    def pairs(self, positions: Tensor) -> Scene:
        """Other pairs for each problem, :math:`(P, n)`."""
        at = positions[..., None]
        return self._replace(
            points=self.points.gather(1, at.expand(-1, -1, 4)),
            u=self.u.gather(1, at),
            v=self.v.gather(1, at),
            weights=self.weights.gather(2, at.mT),
        )

    def pack(self, rotation: Tensor, translation: Tensor) -> Tensor:
        r"""Bring poses to the form that :func:`standardised_errors` reads.

        Args:
            rotation: of :math:`S` poses from each of :math:`H` samples, shape :math:`(P, H, S, 3, 3)`.
            translation: shape :math:`(P, H, S, 3)`.

        Returns:
            Transposed 3x4 matrices with the depth multiplied by ``depth_scale``, pose by pose in the last
            dimension, where the arithmetic is fastest, shape :math:`(P, 4, 3, S H)`.
        """
        batch, samples, slots = translation.shape[:3]
        out = self.points.new_empty(batch, 4, 3, slots, samples)
        out[:, :3] = rotation.permute(0, 4, 3, 2, 1)
        out[:, 3] = translation.permute(0, 3, 2, 1)
        out[:, :, 2] *= self.depth_scale[..., None]
        return out.flatten(3)

    def unpack(self, packed: Tensor) -> Tensor:
        """The 3x4 matrices :math:`[R | t]` of packed poses, :math:`(P, 4, 3, H)` to :math:`(P, H, 3, 4)`."""
        matrices = packed.permute(0, 3, 2, 1).contiguous()
        matrices[:, :, 2] /= self.depth_scale
        return matrices

    def losses(self, packed: Tensor, scorer: Scorer) -> Tensor:
        """Weighted sum of the losses of the pairs at each pose, :math:`(P, 4, 3, H)` to :math:`(P, H)`."""
        return (self.weights @ scorer(standardised_errors(self, packed)))[:, 0]


def standardised_errors(scene: Scene, packed: Tensor) -> Tensor:
    r"""Standardised squared residual of every pair at every pose.

    Every operation passes once over memory, in place, without a mask: comparing and selecting would take longer than
    all the arithmetic.

    Args:
        scene: :math:`P` problems of :math:`N` pairs.
        packed: poses of :meth:`Scene.pack`, shape :math:`(P, 4, 3, H)`.

    Returns:
        At most :data:`MAX_ERROR`, shape :math:`(P, N, H)`.

    Example:
        >>> points = torch.tensor([[[0.0, 0.0, 4.0], [1.0, 0.0, 4.0]]])
        >>> corr = Correspondences(points, torch.zeros(1, 2, 2), torch.ones(1, 2), torch.tensor(100.0))
        >>> scene = Scene.make(corr, Thresholds(torch.tensor([10.0]), torch.tensor([0.0])), torch.float64)
        >>> standardised_errors(scene, scene.pack(torch.eye(3).view(1, 1, 1, 3, 3), torch.zeros(1, 1, 1, 3)))[0, :, 0]
        tensor([0.0000, 6.2500], dtype=torch.float64)
    """
    count = packed.shape[-1]
    x, y, z = (scene.points @ packed.flatten(2)).split(count, -1)  # (P, N, H) each
    x.addcmul_(scene.u, z, value=-1.0)
    y.addcmul_(scene.v, z, value=-1.0)
    sq_limit = torch.addcmul(scene.sq_world, z, z)
    sq_distance = x.mul_(x).addcmul_(y, y).add_(z.clamp_(max=0.0), alpha=-_BEHIND)
    return sq_distance.div_(sq_limit).clamp_(max=MAX_ERROR)
