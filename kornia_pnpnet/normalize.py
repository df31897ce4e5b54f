r"""From pixels of any camera and a world in any frame to what the networks and the refiner see, and back.

Pixels become those of a camera with the focal length ``f_const`` and the principal point 0; the pairs may be ordered
by their pixels, as the paper does; the world may be centred and scaled, which makes the solved pose equivariant to
similarity transforms of the world. Every step has an exact inverse on the pose.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.geometry.conversions import normalize_points_with_intrinsics
from torch import Tensor, nn

from kornia_pnpnet.geometry import MIN_DEPTH_RATIO
from kornia_pnpnet.types import Correspondences, Pose

__all__ = ["F_CONST", "Frame", "Normalize"]

#: Focal length of the normalised camera in pixels (PROTOCOL.md: an ETH3D DSLR has 3400-3430).
F_CONST = 3400.0


class Frame(NamedTuple):
    r"""What :class:`Normalize` did, so that it can be undone.

    Attributes:
        centroid: the world point that became the origin, shape :math:`(B, 3)`.
        scale: the factor on world lengths, shape :math:`(B,)`.
        order: position in the input of each normalised pair, int64, shape :math:`(B, N)`.
        valid: whether the problem can be solved at all, bool, shape :math:`(B,)`.
    """

    centroid: Tensor
    scale: Tensor
    order: Tensor
    valid: Tensor


class Normalize(nn.Module):
    r"""Normalise cameras, order and world frame.

    A problem is *valid* when what its pairs hold is finite (and small enough to be squared twice), its weights are
    not negative, at least three pairs have a weight, its camera is a pinhole without skew, and its points
    do not lie on one line or point. The inputs of invalid problems are replaced by zeros, which keeps values and
    gradients finite everywhere behind.

    Args:
        f_const: focal length of the normalised camera in pixels.
        order: sort the pairs by their horizontal pixel coordinate, ties by the vertical one (the paper's input
            order). Pairs without weight come last.
        center: move the centroid of the world points to the origin.
        scale: scale the world to a root mean square distance of 1 from the origin.

    Example:
        >>> normalize = Normalize(order=False, center=True, scale=True)
        >>> world = torch.tensor([[[0.0, 0, 2], [2, 0, 2], [0, 2, 2], [2, 2, 2]]])
        >>> pixels = torch.tensor([[[320.0, 240], [420, 240], [320, 340], [420, 340]]])
        >>> K = torch.tensor([[[100.0, 0, 320], [0, 100, 240], [0, 0, 1]]])
        >>> corr, frame = normalize(world, pixels, K)
        >>> frame.centroid, corr.img_points[0, 3]
        (tensor([[1., 1., 2.]]), tensor([3400., 3400.]))
    """

    def __init__(
        self, *, f_const: float = F_CONST, order: bool = True, center: bool = True, scale: bool = True
    ) -> None:
        super().__init__()
        self.config = {"f_const": f_const, "order": order, "center": center, "scale": scale}
        self.f_const = f_const
        self.order = order
        self.center = center
        self.scale = scale

    def extra_repr(self) -> str:
        """Show the constructor's arguments."""
        return ", ".join(f"{key}={value!r}" for key, value in self.config.items())

    def forward(
        self,
        world_points: Tensor,
        img_points: Tensor,
        intrinsics: Tensor,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
    ) -> tuple[Correspondences, Frame]:
        r"""Normalise a batch.

        Args:
            world_points: shape :math:`(B, N, 3)`.
            img_points: pixels, shape :math:`(B, N, 2)`.
            intrinsics: shape :math:`(B, 3, 3)`.
            weights: at least 0, shape :math:`(B, N)`; 1 when ``None``.
            mask: False where a pair is padding, bool, shape :math:`(B, N)`.

        Returns:
            The normalised correspondences and the :class:`Frame` that undoes it.
        """
        weights = torch.ones_like(world_points[..., 0]) if weights is None else weights
        there = torch.ones_like(weights, dtype=torch.bool) if mask is None else mask
        # Beyond this, squares of squares overflow; NaN compares false. No point in front of the camera has a pixel
        # beyond the other limit.
        limit = torch.finfo(world_points.dtype).max ** 0.25
        with torch.no_grad():
            raw_pixels = self.f_const * normalize_points_with_intrinsics(img_points, intrinsics)
        finite = (
            (world_points.abs() < limit).all(-1)
            & (raw_pixels.abs() <= self.f_const / MIN_DEPTH_RATIO).all(-1)
            & (weights < limit)
            & (weights >= 0)
        )
        focal_lengths = intrinsics.diagonal(dim1=-2, dim2=-1)[:, :2]
        camera_ok = (intrinsics.abs() < limit).flatten(1).all(-1)
        last_row = intrinsics.new_zeros(3)
        last_row[2] = 1.0
        camera_ok = camera_ok & (focal_lengths > 0).all(-1) & (intrinsics[:, 2] == last_row).all(-1)
        camera_ok = camera_ok & (intrinsics[:, 0, 1] == 0) & (intrinsics[:, 1, 0] == 0)
        valid = camera_ok & (finite | ~there).all(-1)

        # Inputs are made safe before anything is computed from them.
        there = there & valid[:, None]
        eye = torch.eye(3, dtype=intrinsics.dtype, device=intrinsics.device)
        intrinsics = torch.where(valid[:, None, None], intrinsics, eye)
        world_points = torch.where(there[..., None], world_points, 0.0)
        img_points = torch.where(there[..., None], img_points, 0.0)
        weights = torch.where(there, weights, 0.0)
        there = weights > 0
        weights = torch.where(there, weights, 0.0)  # a pair that is not there has no gradient either
        pixels = self.f_const * normalize_points_with_intrinsics(img_points, intrinsics)
        centroid, scale, spread_out = self._world_frame(world_points, there)
        world_points = (world_points - centroid[:, None]) * scale[:, None, None]

        # Too few pairs and degenerate worlds become zeros as well: behind this nothing of them has a gradient.
        valid = valid & (there.sum(-1) >= 3) & spread_out
        there = there & valid[:, None]
        world_points = torch.where(there[..., None], world_points, 0.0)
        pixels = torch.where(there[..., None], pixels, 0.0)
        weights = torch.where(there, weights, 0.0)

        order = self._order(pixels, there)
        if self.order:
            world_points = world_points.gather(1, order[..., None].expand(-1, -1, 3))
            pixels = pixels.gather(1, order[..., None].expand(-1, -1, 2))
            weights = weights.gather(1, order)
        focal = pixels.new_full((), self.f_const)  # made on the device: nothing here waits for the CPU
        img_scale = self.f_const * intrinsics[:, 0, 0].rsqrt() * intrinsics[:, 1, 1].rsqrt()
        corr = Correspondences(world_points, pixels, weights, focal, img_scale, scale)
        return corr, Frame(centroid, scale, order, valid)

    def _world_frame(self, world_points: Tensor, there: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Centroid (B, 3) and scale (B,) of the world, and whether it is more than a line (B,)."""
        share = there.to(world_points.dtype)
        share = share / share.sum(-1, keepdim=True).clamp(min=1.0)  # (B, N)
        mean = (share[..., None] * world_points).sum(1)
        centred = torch.where(there[..., None], world_points - mean[:, None], 0.0)

        # The second largest variance from the invariants of the covariance: it is about the sum of the principal
        # minors over the trace. On a line or a point only rounding is left of it.
        with torch.no_grad():
            size = world_points.abs().flatten(1).amax(-1) if world_points.shape[1] else mean.new_zeros(mean.shape[0])
            safe_size = torch.where(size > 0, size, 1.0)
            large = size > torch.finfo(world_points.dtype).tiny ** 0.25  # smaller squares vanish
            unit = centred / safe_size[:, None, None]
            covariance = (share[..., None] * unit).mT @ unit  # (B, 3, 3)
            trace = covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
            minors = 0.5 * (trace.square() - covariance.square().sum((-2, -1)))
            tolerance = (64.0 * torch.finfo(world_points.dtype).eps) ** 2
            spread_out = large & (
                minors > tolerance * trace + torch.finfo(world_points.dtype).eps * 8.0 * trace.square()
            )

        centroid = mean if self.center else torch.zeros_like(mean)
        moved = centred if self.center else world_points
        mean_square = (share[..., None] * moved.square()).sum((1, 2))
        usable = spread_out & (mean_square > 0)
        scale = torch.where(usable, torch.where(usable, mean_square, 1.0).rsqrt(), 1.0)
        return centroid, scale if self.scale else torch.ones_like(scale), spread_out

    def _order(self, pixels: Tensor, there: Tensor) -> Tensor:
        """Positions of the pairs in the order of their pixels, (B, N)."""
        if not self.order:
            return torch.arange(pixels.shape[1], device=pixels.device).expand(pixels.shape[:2])
        keys = torch.where(there[..., None], pixels.detach(), torch.inf)
        by_v = keys[..., 1].argsort(stable=True, dim=-1)
        return by_v.gather(1, keys[..., 0].gather(1, by_v).argsort(stable=True, dim=-1))

    def undo(self, pose: Pose, frame: Frame) -> Pose:
        r"""Express a pose of the normalised world in the original one.

        Args:
            pose: world-to-camera pose of the centred and scaled world.
            frame: what :meth:`forward` returned.

        Returns:
            The pose of the original world: :math:`(R,\; t / s - R c)`.
        """
        rotation, translation = pose
        offset = (rotation @ frame.centroid[..., None])[..., 0]
        return Pose(rotation, translation / frame.scale[:, None] - offset)

    def apply_to_pose(self, pose: Pose, frame: Frame) -> Pose:
        r"""Express a pose of the original world in the normalised one, the inverse of :meth:`undo`.

        Args:
            pose: world-to-camera pose of the original world.
            frame: what :meth:`forward` returned.

        Returns:
            The pose of the centred and scaled world: :math:`(R,\; s (t + R c))`.
        """
        rotation, translation = pose
        offset = (rotation @ frame.centroid[..., None])[..., 0]
        return Pose(rotation, (translation + offset) * frame.scale[:, None])
