r"""Normalisation of problems: the transform from the caller's frame to the solver's frame, and its inverse.

Pixels become pixels of a camera with the focal length ``f_const`` and the principal point 0. Pairs can be sorted by
their pixels, as in the paper. The world can be centred and scaled, so that the solved pose is equivariant to
translations and scalings of the world. A solved pose can be transformed back exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.checks import check_positive
from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.core.linalg import span_a_plane
from kornia_pnpnet.core.performance import ascending_order, ranked
from kornia_pnpnet.core.symmetric import are_semi_definite
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.problem import LEAST_NOISE, MIN_PAIRS, Noise, Problem, Starts
from kornia_pnpnet.refine.residual import MIN_DEPTH_RATIO
from kornia_pnpnet.result import Pose, Status, gate_pose

__all__ = ["F_CONST", "Frame", "Normalize"]

#: Pixels. Focal length of the normalised camera (cameras of ETH3D have focal lengths of 3400 to 3430).
F_CONST = 3400.0
# Typical distances (see `Normalize`) from the median of the points. Centre and scale ignore points beyond `_FAR`. With
# fewer than `_MANY` pairs the limit is `_FAR_OF_FEW`, because the typical distance of few points is inaccurate.
_FAR, _MANY, _FAR_OF_FEW = 5.0, 12, 25.0
# Typical distances from the median. Points further away lose their weight, because float32 has too few digits.
_LARGEST_DISTANCE = 1e6
# Tangent of 85 degrees. No real lens without distortion shows larger angles from the axis.
_FAR_ANGLE = 11.4


class Frame(NamedTuple):
    r"""The changes of frame and order that :class:`Normalize` applied to problems.

    Attributes:
        centroid: the world point that became the origin, shape :math:`(B, 3)`.
        scale: factor of world lengths, shape :math:`(B,)`.
        img_scale: factor of pixels: the geometric mean of the factors of u and v, shape :math:`(B,)`. In a rig, the
            factor is the mean over the pairs.
        order: for each normalised pair, its position in the input, int64, shape :math:`(B, N)`. ``None``: the same
            order.
        status: ``Status.SOLVED`` for a valid problem, else the reason why the problem is invalid, int64, shape
            :math:`(B,)`.
        intrinsics: the camera matrices with a last entry of 1, shape :math:`(B, 3, 3)`, in a rig
            :math:`(B, N, 3, 3)`. The identity replaces invalid matrices.
    """

    centroid: Tensor
    scale: Tensor
    img_scale: Tensor
    order: Tensor | None
    status: Tensor
    intrinsics: Tensor

    @property
    def valid(self) -> Tensor:
        """Whether the problem is valid, see :class:`Normalize`, bool, shape :math:`(B,)`."""
        return self.status == Status.SOLVED.value

    def apply(self, pose: Pose) -> Pose:
        r"""Express a pose in the frame of the problem: :math:`(R,\; s (t + R c))` with scale s and centroid c."""
        offset = (pose.rotation * self.centroid[:, None]).sum(-1)
        return Pose(pose.rotation, (pose.translation + offset) * self.scale[:, None])

    def undo(self, pose: Pose) -> Pose:
        r"""Express a pose in the caller's world, the inverse of :meth:`apply`: :math:`(R,\; t / s - R c)`.

        Each problem may have several poses, :math:`(B, S, 3, 3)` and :math:`(B, S, 3)`.
        """
        more = (1,) * (pose.translation.ndim - 2)
        offset = (pose.rotation * self.centroid.view(-1, *more, 1, 3)).sum(-1)
        return Pose(pose.rotation, pose.translation / self.scale.view(-1, *more, 1) - offset)

    def undo_pairs(self, values: Tensor) -> Tensor:
        """Sort values of pairs, :math:`(B, N)`, back to the caller's order."""
        return values if self.order is None else torch.zeros_like(values).scatter(1, self.order, values)

    def undo_starts(self, starts: Starts) -> Starts:
        """Express starts in the caller's frame, order and units. The new ``ok`` is :attr:`valid`."""
        noise = starts.noise
        if noise is not None:
            noise = Noise(noise.img / self.img_scale[:, None], noise.world / self.scale[:, None])
            noise = map_tensors(self.undo_pairs, noise)
        others = None if starts.others is None else self.undo(starts.others)
        return Starts(self.undo(starts.pose), self.undo_pairs(starts.weights), self.valid, others, noise)

    def start(self, init: Pose | None) -> Pose:
        """Express the caller's pose in the frame of the problem. ``None`` and non-finite poses become the identity."""
        eye = torch.eye(3, dtype=self.scale.dtype, device=self.scale.device).expand(self.scale.shape[0], 3, 3)
        init = Pose(eye, torch.zeros_like(self.centroid)) if init is None else init
        limit = torch.finfo(eye.dtype).max ** 0.25  # fourth powers of numbers below this limit are finite
        usable = self.valid & (torch.cat((init.rotation.flatten(1), init.translation), 1).abs().amax(-1) < limit)
        return self.apply(gate_pose(init, usable, usable))


class Normalize(Configured):
    r"""Normalise the cameras, the order of the pairs, and the world frame of problems.

    A *valid* problem has finite numbers, weights of at least 0, and a pinhole camera (any multiple of a camera matrix,
    with or without skew). At least three of its pairs have a positive weight, and its points do not coincide or lie on
    one line. The inputs of invalid problems are replaced by zeros, so that all later values and gradients are finite. A
    pair of weight 0 is padding. The coordinates of padding are ignored.

    Centroid and scale are computed from the *usual* pairs, so that bad triangulations and bad detections do not spoil
    the frame. The pixel of a usual pair is less than 85° off the camera's axis. The point of a usual pair is at most
    five typical distances from the median of the points (25 with fewer than 12 pairs). The typical distance is the
    radius around the median that contains two thirds of the points. A pair loses its weight when its point is more than
    a million typical distances from the median, or when its pixel is almost 90° off the axis.

    Args:
        f_const: focal length of the normalised camera in pixels.
        order: sort the pairs by u, and pairs with equal u by v (the paper's input order). Unusual pairs and padding
            come last.
        center: move the centroid of the world points to the origin.
        scale: scale the world so that the root mean square distance of the usual points from the origin is 1.

    Raises:
        BaseError: when ``f_const`` is not a positive number.

    Example:
        >>> normalize = Normalize(order=False, center=True, scale=True)
        >>> world = torch.tensor([[[0.0, 0, 2], [2, 0, 2], [0, 2, 2], [2, 2, 2]]])
        >>> pixels = torch.tensor([[[320.0, 240], [420, 240], [320, 340], [420, 340]]])
        >>> K = torch.tensor([[[100.0, 0, 320], [0, 100, 240], [0, 0, 1]]])
        >>> problem, frame = normalize(world, pixels, K)
        >>> frame.centroid, problem.img_points[0, 3]
        (tensor([[1., 1., 2.]]), tensor([3400., 3400.]))
    """

    def __init__(
        self, *, f_const: float = F_CONST, order: bool = True, center: bool = True, scale: bool = True
    ) -> None:
        super().__init__(locals())
        check_positive(f_const=f_const)
        self.f_const = f_const
        self.order = order
        self.center = center
        self.scale = scale

    def forward(
        self,
        world_points: Tensor,
        img_points: Tensor,
        intrinsics: Tensor,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
        noise: Noise | None = None,
        confidence: Tensor | None = None,
        rig: Pose | None = None,
    ) -> tuple[Problem, Frame]:
        r"""Normalise a batch.

        Args:
            world_points: shape :math:`(B, N, 3)`.
            img_points: pixels, shape :math:`(B, N, 2)`.
            intrinsics: shape :math:`(B, 3, 3)`; in a rig one matrix for each pair, :math:`(B, N, 3, 3)`.
            weights: at least 0, shape :math:`(B, N)`; 1 when ``None``.
            mask: False where a pair is padding, bool, shape :math:`(B, N)`.
            noise: standard deviations in pixels and in the unit of the world, NaN where unknown; covariances in the
                squares of these units.
            confidence: the caller's belief that a pair is an inlier, in [0, 1], shape :math:`(B, N)`; NaN where
                unknown.
            rig: the transform from a rig to the camera of each pair, :math:`(B, N, 3, 3)` and :math:`(B, N, 3)`.

        Returns:
            The normalised problem, and the :class:`Frame` that undoes the normalisation. In memory, the batch is the
            last dimension of the problem.
        """
        batch, count = world_points.shape[:2]
        padded = weights is not None or mask is not None
        if weights is None:
            weights = world_points.new_ones(batch, count) if mask is None else mask.to(world_points.dtype)
        else:
            weights = weights if mask is None else torch.where(mask, weights, 0.0)
        # From here on the batch is the last dimension. `rows` (6, N, B) holds the coordinates and the weight of each
        # pair. `camera` (9, B) holds the entries of each matrix: fx, fy = camera[:5:4] and cx, cy = camera[2:6:3].
        rows = torch.cat((world_points.permute(2, 1, 0), img_points.permute(2, 1, 0), weights.mT[None]))
        zero, one = rows.new_zeros(1, batch), rows.new_ones(1, batch)
        # In a rig `cameras` holds the entries of each pair's matrix, (9, N, B).
        cameras = intrinsics.flatten(-2)
        cameras, is_camera = _pinhole((cameras.mT if intrinsics.ndim == 3 else cameras.permute(2, 1, 0)).contiguous())
        camera = cameras[:, None] if intrinsics.ndim == 3 else cameras  # (9, 1 or N, B)

        # Fourth powers of numbers between `limit` and its inverse neither overflow nor underflow. NaN compares false.
        limit = torch.finfo(rows.dtype).max ** 0.25
        there = rows[5] != 0
        sizes = rows.detach().abs()
        if padded:
            sizes = torch.where(there, sizes, zero)
        size = sizes[:5].amax(0)  # largest coordinate of each pair
        # The sum is tested, because the maximum of ONNX Runtime ignores NaN.
        is_finite = sizes.sum((0, 1)) < torch.inf
        if padded:
            is_finite = is_finite & ((rows[5] >= 0) & (rows[5] < limit)).all(0)
        if noise is not None:
            has_noise = _is_usable(noise, there)
            is_finite = is_finite & has_noise
        if rig is not None:
            values = torch.cat((rig.rotation.flatten(-2), rig.translation), -1).detach()
            sound = (values.abs() < limit).all(-1)  # (B, N)
            is_finite = is_finite & (sound | ~there.mT).all(-1)
            eye = torch.eye(3, dtype=rows.dtype, device=rows.device)
            rotation = torch.where(sound[..., None, None], rig.rotation, eye)
            rig = Pose(rotation, torch.where(sound[..., None], rig.translation, 0.0))
            is_camera = (is_camera | ~there).all(0)
        if confidence is not None:
            is_probability = ((confidence >= 0) & (confidence <= 1)) | confidence.isnan()
            is_finite = is_finite & (is_probability | ~there.mT).all(-1)
            confidence = torch.where(is_probability & there.mT, confidence, torch.nan)
        there = there & (is_camera & is_finite) & (size < limit)
        rows = torch.where(there, rows, zero)  # all numbers are finite now, so that products with 0 are 0
        focal = rows.new_full((), self.f_const)  # made on the device, so that a GPU need not wait for the CPU
        img_scales = focal / camera[:5:4]  # (2, 1 or N, B)

        # A pair at an impossible angle or distance loses its weight, but its problem stays valid.
        pixels = (rows[3:5] - camera[2:6:3]) * img_scales
        tangent = pixels.detach().abs().amax(0) / self.f_const
        sq_distance, typical = _distances(rows[:3].detach(), there, padded)
        there = there & (tangent <= 1.0 / MIN_DEPTH_RATIO) & (sq_distance <= _LARGEST_DISTANCE**2 * typical)
        number = there.sum(0)
        far = torch.where(number < _MANY, _FAR_OF_FEW**2, _FAR**2) * typical
        seen = there & (tangent <= _FAR_ANGLE)
        usual = (seen | (there & (seen.sum(0) <= MIN_PAIRS))) & (sq_distance <= far)  # keep wide angles of few pairs
        is_usual, is_there = usual.to(rows.dtype), there.to(rows.dtype)

        # Compute centre and scale from the usual points.
        share = is_usual.sum(0).clamp(min=1.0).reciprocal()
        usual_points = rows[:3] * is_usual
        mean = usual_points.sum(1) * share
        centred = torch.addcmul(usual_points, mean[:, None], is_usual, value=-1)
        largest = usual_points.detach().abs().amax((0, 1))
        spread_out = span_a_plane(centred.detach(), share, largest) & (largest > 1.0 / limit)
        mean_square = (centred if self.center else usual_points).square().sum((0, 1)) * share
        scale = torch.where(spread_out, mean_square, one[0]).rsqrt() if self.scale else one[0]
        centroid = mean if self.center else zero.expand(3, batch)

        status = torch.where(spread_out, Status.SOLVED.value, Status.DEGENERATE.value)
        for fine, otherwise in (
            (number >= MIN_PAIRS, Status.TOO_FEW_PAIRS),
            (is_camera, Status.CAMERA),
            (is_finite, Status.NOT_FINITE),
        ):
            status = torch.where(fine, status, otherwise.value)
        valid = status == Status.SOLVED.value
        # Pairs without weight get the skew 0, because the product with their large pixels could overflow.
        without_skew = torch.addcmul(pixels[:1], camera[1] / camera[0] * is_there, pixels[1:], value=-1)
        world = (rows[:3] - centroid[:, None]) * scale
        # An invalid problem becomes zeros, without gradient.
        rows = torch.cat((world, without_skew, pixels[1:], rows[5:])) * (is_there * valid)

        order = None
        if self.order:
            order = ascending_order(torch.where(usual, rows[3:5].detach(), torch.inf))
            rows = rows.gather(1, order.mT.expand(6, -1, -1))
            is_usual = is_usual.gather(0, order.mT)
        world_points, img_points, weights = rows.permute(2, 1, 0).split((3, 2, 1), -1)
        horizontal, vertical = img_scales.sqrt()
        img_scale = horizontal * vertical  # (1 or N, B)
        eye = torch.eye(3, dtype=camera.dtype, device=camera.device).view(9, *(1,) * (cameras.ndim - 1))
        matrices = torch.where(is_camera, cameras, eye)
        matrices = (matrices.mT if intrinsics.ndim == 3 else matrices.permute(2, 1, 0)).unflatten(-1, (3, 3))
        mean_scale = img_scale[0]
        if rig is not None:  # a problem without pairs gets the scale 1
            share = is_there / is_there.sum(0).clamp(min=1.0)
            mean_scale = torch.where(there.any(0), (img_scale * share).sum(0), 1.0)
        frame = Frame(centroid.mT, scale, mean_scale, order, status, matrices)
        if noise is not None:
            # Unknown (NaN) and impossible sigmas are replaced first, so that the gradient of the scale is not NaN.
            known = [has_noise[:, None] & ~sigma.isnan() for sigma in noise[:2]]
            scaled = [
                torch.where(is_known, torch.where(is_known, sigma, 0.0) * unit, torch.nan)
                for is_known, sigma, unit in zip(known, noise[:2], (img_scale.mT, scale[:, None]), strict=True)
            ]
            noise = noise._replace(img=scaled[0], world=scaled[1])
            if noise.covariances:
                pixel_map = [x.mT for x in (img_scales[0], -camera[1] / camera[0] * img_scales[1], img_scales[1])]
                noise = self._scaled_covariances(noise, (there & has_noise).mT, pixel_map, scale)
        if rig is not None:
            rig = Pose(rig.rotation, rig.translation * scale[:, None, None])
        if order is not None:
            position = order
            noise, confidence, rig = map_tensors(
                lambda x: x.gather(1, position.view(*position.shape, *(1,) * (x.ndim - 2)).expand_as(x)),
                (noise, confidence, rig),
            )
        scales = mean_scale, scale, is_usual.mT
        return Problem(world_points, img_points, weights[..., 0], focal, *scales, noise, confidence, rig), frame

    def _scaled_covariances(self, noise: Noise, sound: Tensor, pixel_map: Sequence[Tensor], scale: Tensor) -> Noise:
        """Convert covariances to the units of the problem. Covariances of pairs that are not ``sound`` are ignored."""
        # `pixel_map` holds the entries a, b, d of the matrix [[a, b], [0, d]] that multiplies pixels.
        img_cov, world_cov = map_tensors(lambda x: torch.where(sound, x, 0.0), (noise.img_cov, noise.world_cov))
        if img_cov is not None:
            img_cov = img_cov.mapped(*pixel_map).at_least((LEAST_NOISE * self.f_const) ** 2)
        if world_cov is not None:
            world_cov = world_cov.scaled(scale.square()[:, None])
        return noise._replace(img_cov=img_cov, world_cov=world_cov)


def _is_usable(noise: Noise, there: Tensor) -> Tensor:
    """Whether each sigma is NaN or a finite number of at least 0, and each covariance is semi-definite, bool (B,)."""
    usable = [((x >= 0) | x.isnan()).all(-1) & ~x.isinf().any(-1) for x in (noise.img, noise.world)]
    return torch.stack([*usable, *((are_semi_definite(x) | ~there.mT).all(-1) for x in noise.covariances)]).all(0)


def _pinhole(camera: Tensor) -> tuple[Tensor, Tensor]:
    """Scale camera matrices (9, B) to a last entry of 1, and tell which are valid. Invalid matrices become all ones."""
    limit = torch.finfo(camera.dtype).max ** 0.25
    entries = camera.detach()
    scaled = entries / entries[8:]
    # The sum of absolute values bounds each value. NaN compares false.
    largest = torch.cat((entries, entries[8:].reciprocal(), scaled, scaled[:5:4].rsqrt())).abs().sum(0)
    below_diagonal = torch.cat((entries[3:4], entries[6:8])).any(0)
    fine = (largest < limit) & ~below_diagonal
    camera = torch.where(fine, camera, 1.0)
    return camera / camera[8:], fine


def _distances(points: Tensor, there: Tensor, padded: bool) -> tuple[Tensor, Tensor]:
    """Squared distances (N, B) of points (3, N, B) from their median, and the squared typical distance (B,)."""
    counts = there.sum(0) if padded else points.shape[1]
    points = torch.where(there, points, torch.inf)
    middle = ranked(points, (counts - 1) // 2).nan_to_num(posinf=0.0)
    sq_distance = (points - middle[:, None]).square().sum(0)
    typical = ranked(sq_distance[None], 2 * counts // 3)[0]
    # If two thirds of the points coincide, an infinite typical distance makes all points usual.
    return sq_distance, typical.masked_fill(typical == 0, torch.inf)
