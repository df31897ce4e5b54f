"""Pairs of points and pixels, their noise, and what initialisers and refiners make of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.symmetric import Symmetric2, Symmetric3
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.types.pose import FramedPrior, FreeFocal, Pose

__all__ = [
    "LEAST_NOISE",
    "MIN_PAIRS",
    "Correspondences",
    "FocalHypotheses",
    "Guess",
    "Hypotheses",
    "Noise",
    "Refinement",
]

#: Focal lengths. Pixels are never known better than this, so that weights stay finite.
LEAST_NOISE = 1e-6
#: Pairs that determine a pose up to a few solutions.
MIN_PAIRS = 3


class Noise(NamedTuple):
    r"""The noise of each pair: standard deviations, the same on each coordinate, and covariances where there are any.

    Attributes:
        img: standard deviation of the pixel, shape :math:`(B, N)`; with a covariance that of isotropic noise of the
            same trace, which is what a network sees.
        world: standard deviation of the world point, as ``img``.
        img_cov: covariance of the pixel, entries of shape :math:`(B, N)`; ``None``: noise is isotropic.
        world_cov: covariance of the world point, as ``img_cov``.
    """

    img: Tensor
    world: Tensor
    img_cov: Symmetric2 | None = None
    world_cov: Symmetric3 | None = None

    @property
    def sigmas(self) -> Noise:
        """The standard deviations alone."""
        return self._replace(img_cov=None, world_cov=None)

    @property
    def covariances(self) -> list[Symmetric2 | Symmetric3]:
        """The covariances that there are."""
        return [x for x in (self.img_cov, self.world_cov) if x is not None]


class Correspondences(NamedTuple):
    r"""Normalised 2D-3D correspondences: the input of initialisers and refiners.

    Attributes:
        world_points: points in the (possibly centred and scaled) world frame, shape :math:`(B, N, 3)`.
        img_points: pixels of a camera with the focal length ``focal`` and the principal point 0,
            shape :math:`(B, N, 2)`.
        weights: weight of each pair, at least 0; 0 means that the pair is padding, shape :math:`(B, N)`.
        focal: the focal length in pixels that all pairs share, a scalar, or :math:`(B, 1)` where it is estimated.
        img_scale: pixels of ``img_points`` per pixel of the user's camera, shape :math:`(B,)`; ``None`` is 1. It
            multiplies values that the user gives in pixels, such as a threshold.
        world_scale: lengths of ``world_points`` per unit of the user's world, shape :math:`(B,)`; ``None`` is 1.
        noise: noise of each pair in the units of ``img_points`` and ``world_points``, NaN where unknown; ``None``: all
            unknown.
        near: 0 for points that are many times as far from the others as these are from each other, and for pixels at
            extreme angles; 1 for all other pairs, shape :math:`(B, N)`; ``None``: 1. An initialiser that is not robust
            leaves out the pairs with 0 (:attr:`near_weights`): they are bad data or the horizon.
        confidence: the caller's belief that a pair is an inlier, in [0, 1], NaN where unknown, shape :math:`(B, N)`;
            ``None``: all unknown.
        prior: what is known of the pose besides the pairs; ``None``: nothing.
        free_focal: what is known of the focal length besides the pairs; ``None``: it is known.
        rig: the camera of each pair in a rig, from the rig's frame to the camera's, :math:`(B, N, 3, 3)` and
            :math:`(B, N, 3)`; the pose is that of the rig. ``None``: one camera, whose frame is that of the pose.
    """

    world_points: Tensor
    img_points: Tensor
    weights: Tensor
    focal: Tensor
    img_scale: Tensor | None = None
    world_scale: Tensor | None = None
    noise: Noise | None = None
    near: Tensor | None = None
    confidence: Tensor | None = None
    prior: FramedPrior | None = None
    free_focal: FreeFocal | None = None
    rig: Pose | None = None

    @property
    def places(self) -> Tensor:
        """Where in the image each pair is seen: its pixel, in a rig a ray times the focal length.

        Shape :math:`(B, N, 2)` or, in the frame of the rig, :math:`(B, N, 3)`.
        """
        return self.img_points if self.rig is None else self.rays(self.img_points / self.focal)

    def rays(self, plane_points: Tensor) -> Tensor:
        """Rays of points in the cameras' planes, as long as the focal length, in the frame of a rig, (B, N, 3)."""
        assert self.rig is not None
        rays = torch.cat((plane_points, torch.ones_like(plane_points[..., :1])), -1)
        rays = self.focal * torch.nn.functional.normalize(rays, dim=-1)
        return (self.rig.rotation * rays[..., None]).sum(-2)

    @property
    def focal_of_problem(self) -> Tensor:
        """The focal length as a scalar or of shape :math:`(B,)`."""
        return self.focal[:, 0] if self.focal.ndim else self.focal

    def zoomed(self, zoom: Tensor | None) -> Correspondences:
        """With the focal length times the exponential of ``zoom``, shape :math:`(B,)`; ``None``: as they are."""
        return self if zoom is None else self._replace(focal=self.focal * zoom.exp()[:, None])

    def seen_with(self, zoom: Tensor | None) -> Correspondences:
        """The same pairs with the focal length known: pixels and their noise are divided instead."""
        if zoom is None:
            return self
        factor = (-zoom).exp()[:, None]
        noise = self.noise
        if noise is not None:
            cov = None if noise.img_cov is None else noise.img_cov.mapped(factor, torch.zeros_like(factor), factor)
            noise = noise._replace(img=noise.img * factor, img_cov=cov)
        scale = None if self.img_scale is None else self.img_scale * factor[:, 0]
        pixels = self.img_points * factor[..., None]
        return self._replace(img_points=pixels, noise=noise, img_scale=scale, free_focal=None)

    @property
    def near_weights(self) -> Tensor:
        """The weights, 0 for pairs that are not near, shape :math:`(B, N)`."""
        return self.weights if self.near is None else self.weights * self.near

    def map(self, function: Callable[[Tensor], Tensor]) -> Correspondences:
        """Apply a function to every tensor."""
        return map_tensors(function, self)


class Guess(NamedTuple):
    r"""A first guess: what an initialiser returns.

    Attributes:
        pose: a coarse pose in the frame of the :class:`Correspondences`.
        weights: a factor for the weight of each pair, at least 0, shape :math:`(B, N)`.
        ok: whether there is a guess at all (degenerate pairs may have none), bool, shape :math:`(B,)`; ``None``:
            always.
        others: more poses to start from, rotations :math:`(B, S, 3, 3)` and translations :math:`(B, S, 3)`; ``None``:
            no others.
        noise: noise of each pair in the units of the correspondences, where unknown the initialiser's estimate;
            residuals then count in standard deviations. ``None``: the initialiser does not estimate noise. It has no
            covariances: the refinement takes those of the correspondences.
        zoom: logarithm of the guessed focal length over that of the correspondences, shape :math:`(B,)`; ``None``: 0.
    """

    pose: Pose
    weights: Tensor
    ok: Tensor | None = None
    others: Pose | None = None
    noise: Noise | None = None
    zoom: Tensor | None = None

    @property
    def poses(self) -> list[Pose]:
        """The pose and the others, each of rotations :math:`(B, 3, 3)` and translations :math:`(B, 3)`."""
        others = () if self.others is None else map(Pose, *(x.unbind(1) for x in self.others))
        return [self.pose, *others]


class Hypotheses(NamedTuple):
    r"""Up to :math:`S` poses for each sample: what a minimal solver returns.

    Attributes:
        pose: rotations :math:`(B, S, 3, 3)` and translations :math:`(B, S, 3)` in the frame of the sample.
        valid: which slots hold a solution, bool, shape :math:`(B, S)`. The other slots are finite.
    """

    pose: Pose
    valid: Tensor


class FocalHypotheses(NamedTuple):
    r"""Up to :math:`S` poses for each sample, each with its focal length.

    Attributes:
        pose: See Hypotheses.
        valid: See Hypotheses.
        zoom: logarithm of the focal length of each slot over that of the correspondences, shape :math:`(B, S)`.
    """

    pose: Pose
    valid: Tensor
    zoom: Tensor


class Refinement(NamedTuple):
    r"""A refined pose: what a refiner returns.

    Attributes:
        pose: the refined pose in the frame of the :class:`Correspondences`.
        weights: the weight of each pair at that pose, shape :math:`(B, N)`.
        cost: mean robust loss of the pairs at that pose, shape :math:`(B,)`.
        ok: whether the pose is to be believed, bool, shape :math:`(B,)`.
        in_front: whether at least three pairs with a weight are in front of the camera, bool, shape :math:`(B,)`.
        probability: probability that the pose is not far off, shape :math:`(B,)`.
        zoom: logarithm of the estimated focal length over that of the correspondences, shape :math:`(B,)`; ``None``:
            the focal length is known.
    """

    pose: Pose
    weights: Tensor
    cost: Tensor
    ok: Tensor
    in_front: Tensor
    probability: Tensor
    zoom: Tensor | None = None
