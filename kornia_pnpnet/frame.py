r"""Into the solver's frame and back.

Pixels become those of a camera with the focal length ``f_const`` and the principal point 0. The pairs may be ordered
by their pixels, as in the paper. The world may be centred and scaled, which makes the solved pose equivariant to
similarity transforms of the world. Every step has an exact inverse on the pose.
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

#: Focal length of the normalised camera in pixels (the cameras of ETH3D have 3400 to 3430).
F_CONST = 3400.0
# A point further from the median of the points than this number of typical distances does not count for centre and
# scale. With fewer than 12 pairs the larger number holds, because few pairs say little about a typical distance.
_FAR, _MANY, _FAR_OF_FEW = 5.0, 12, 25.0
# Typical distances from the median. A float32 has too few digits for points further away.
_LARGEST_DISTANCE = 1e6
# Tangent of 85 degrees, a larger angle than a lens without distortion can show.
_FAR_ANGLE = 11.4


class Frame(NamedTuple):
    r"""How :class:`Normalize` moved and ordered problems.

    Attributes:
        centroid: the world point that became the origin, shape :math:`(B, 3)`.
        scale: factor of world lengths, shape :math:`(B,)`.
        img_scale: factor of pixels, the geometric mean of both axes, shape :math:`(B,)`.
        order: position in the input of each normalised pair, int64, shape :math:`(B, N)`; ``None``: unchanged.
        status: ``Status.SOLVED`` where the problem is valid, else the reason, int64, shape :math:`(B,)`.
        intrinsics: the camera matrices with a last entry of 1, the identity where they are impossible, shape
            :math:`(B, 3, 3)`, of a rig :math:`(B, N, 3, 3)`.
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
        r"""Express a pose of the caller's world in the frame of the problem: :math:`(R,\; s (t + R c))`."""
        offset = (pose.rotation * self.centroid[:, None]).sum(-1)
        return Pose(pose.rotation, (pose.translation + offset) * self.scale[:, None])

    def undo(self, pose: Pose) -> Pose:
        r"""Express a pose in the caller's world, the inverse of :meth:`apply`: :math:`(R,\; t / s - R c)`.

        There may be several poses of each problem, :math:`(B, S, 3, 3)` and :math:`(B, S, 3)`.
        """
        more = (1,) * (pose.translation.ndim - 2)
        offset = (pose.rotation * self.centroid.view(-1, *more, 1, 3)).sum(-1)
        return Pose(pose.rotation, pose.translation / self.scale.view(-1, *more, 1) - offset)

    def undo_pairs(self, values: Tensor) -> Tensor:
        """Bring values of pairs, :math:`(B, N)`, back to the order in which the pairs came."""
        return values if self.order is None else torch.zeros_like(values).scatter(1, self.order, values)

    def undo_starts(self, starts: Starts) -> Starts:
        """Express starts in the frame, order and units of the inputs; ``ok``: whether the problem is valid."""
        noise = starts.noise
        if noise is not None:
            noise = Noise(noise.img / self.img_scale[:, None], noise.world / self.scale[:, None])
            noise = map_tensors(self.undo_pairs, noise)
        others = None if starts.others is None else self.undo(starts.others)
        return Starts(self.undo(starts.pose), self.undo_pairs(starts.weights), self.valid, others, noise)

    def start(self, init: Pose | None) -> Pose:
        """A caller's pose in the frame of the problem; the identity for ``None`` and where it is not finite."""
        eye = torch.eye(3, dtype=self.scale.dtype, device=self.scale.device).expand(self.scale.shape[0], 3, 3)
        init = Pose(eye, torch.zeros_like(self.centroid)) if init is None else init
        limit = torch.finfo(eye.dtype).max ** 0.25  # as for points: below it, squares of squares are finite
        usable = self.valid & (torch.cat((init.rotation.flatten(1), init.translation), 1).abs().amax(-1) < limit)
        return self.apply(gate_pose(init, usable, usable))


class Normalize(Configured):
    r"""Normalise cameras, order and world frame.

    A problem is *valid* when its numbers are finite, its weights are not negative, at least three pairs have a weight,
    its camera is a pinhole (any multiple of its matrix, with or without skew), and its points do not lie on one line or
    coincide. The inputs of invalid problems are replaced by zeros, which keeps all later values and gradients finite. A
    pair without weight is padding: its numbers do not matter.

    Centroid and scale are those of the *usual* pairs, so that bad triangulations and bad detections do not spoil the
    frame. A usual pair is less than 85° off the camera's axis, and its point is at most five typical distances from the
    median of the points; two thirds of the pairs are within one typical distance. Pairs beyond a million typical
    distances, or too close to 90° to be seen, lose their weight.

    Args:
        f_const: focal length of the normalised camera in pixels.
        order: sort the pairs by their horizontal pixel coordinate, ties by the vertical one (the paper's input
            order). Pairs without weight come last.
        center: move the centroid of the world points to the origin.
        scale: scale the world to a root mean square distance of 1 from the origin.

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
            intrinsics: shape :math:`(B, 3, 3)`, or of each pair in a rig, :math:`(B, N, 3, 3)`.
            weights: at least 0, shape :math:`(B, N)`; 1 when ``None``.
            mask: False where a pair is padding, bool, shape :math:`(B, N)`.
            noise: standard deviations in pixels and in the unit of the world, NaN where unknown, or covariances in
                their squares.
            confidence: the caller's belief that a pair is an inlier, in [0, 1], shape :math:`(B, N)`; NaN where
                unknown.
            rig: the camera of each pair in the frame of a rig, :math:`(B, N, 3, 3)` and :math:`(B, N, 3)`.

        Returns:
            The problem in its frame, with the problems last in memory, and the :class:`Frame` that undoes it.
        """
        batch, count = world_points.shape[:2]
        padded = weights is not None or mask is not None
        if weights is None:
            weights = world_points.new_ones(batch, count) if mask is None else mask.to(world_points.dtype)
        else:
            weights = weights if mask is None else torch.where(mask, weights, 0.0)
        # From here on problems are the last dimension: coordinates and weight of each pair, (6, N, B), and the entries
        # of each camera, (9, B), of which fx, fy = [:5:4] and cx, cy = [2:6:3].
        rows = torch.cat((world_points.permute(2, 1, 0), img_points.permute(2, 1, 0), weights.mT[None]))
        zero, one = rows.new_zeros(1, batch), rows.new_ones(1, batch)
        # Of a rig the entries of each pair's camera, (9, N, B).
        cameras = intrinsics.flatten(-2)
        cameras, is_camera = _pinhole((cameras.mT if intrinsics.ndim == 3 else cameras.permute(2, 1, 0)).contiguous())
        camera = cameras[:, None] if intrinsics.ndim == 3 else cameras  # (9, 1 or N, B)

        # Make inputs safe before computing with them: between this limit and its inverse, squares of squares neither
        # overflow nor vanish. NaN compares false.
        limit = torch.finfo(rows.dtype).max ** 0.25
        there = rows[5] != 0
        sizes = rows.detach().abs()
        if padded:
            sizes = torch.where(there, sizes, zero)
        size = sizes[:5].amax(0)  # of each pair
        # Sums, because the maximum of ONNX Runtime leaves NaN out.
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
        rows = torch.where(there, rows, zero)  # finite, so that products with 0 are 0 from here on
        focal = rows.new_full((), self.f_const)  # made on the device, so that a GPU need not wait for the CPU
        img_scales = focal / camera[:5:4]  # (2, 1 or N, B)

        # A pair far off is no reason to refuse the problem: beyond any angle or distance it is an outlier.
        pixels = (rows[3:5] - camera[2:6:3]) * img_scales
        tangent = pixels.detach().abs().amax(0) / self.f_const
        sq_distance, typical = _distances(rows[:3].detach(), there, padded)
        there = there & (tangent <= 1.0 / MIN_DEPTH_RATIO) & (sq_distance <= _LARGEST_DISTANCE**2 * typical)
        number = there.sum(0)
        far = torch.where(number < _MANY, _FAR_OF_FEW**2, _FAR**2) * typical
        seen = there & (tangent <= _FAR_ANGLE)
        usual = (seen | (there & (seen.sum(0) <= MIN_PAIRS))) & (sq_distance <= far)  # a wide angle may be right
        is_usual, is_there = usual.to(rows.dtype), there.to(rows.dtype)

        # Centre and scale by the pairs of normal scale.
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
        # The skew is 0 for pairs that are left out, whose pixels may be so large that products overflow.
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
        if rig is not None:  # 1 where no pair is there
            share = is_there / is_there.sum(0).clamp(min=1.0)
            mean_scale = torch.where(there.any(0), (img_scale * share).sum(0), 1.0)
        frame = Frame(centroid.mT, scale, mean_scale, order, status, matrices)
        if noise is not None:
            # Unknown sigmas, NaN, and those of invalid problems are replaced before they are scaled: the gradient of
            # the scale would be NaN.
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
        """Covariances in the units of the problem, raised above rounding; 0 where not ``sound``.

        Pixels are multiplied by the matrix [[a, b], [0, d]] with the entries of ``pixel_map``, (B, 1) or (B, N) each.
        """
        img_cov, world_cov = map_tensors(lambda x: torch.where(sound, x, 0.0), (noise.img_cov, noise.world_cov))
        if img_cov is not None:
            img_cov = img_cov.mapped(*pixel_map).at_least((LEAST_NOISE * self.f_const) ** 2)
        if world_cov is not None:
            world_cov = world_cov.scaled(scale.square()[:, None])
        return noise._replace(img_cov=img_cov, world_cov=world_cov)


def _is_usable(noise: Noise, there: Tensor) -> Tensor:
    """Whether the noise of all pairs is possible, bool (B,).

    Standard deviations are finite and not negative, or unknown; covariances of pairs that are there, bool (N, B), are
    finite and positive semi-definite.
    """
    usable = [((x >= 0) | x.isnan()).all(-1) & ~x.isinf().any(-1) for x in (noise.img, noise.world)]
    return torch.stack([*usable, *((are_semi_definite(x) | ~there.mT).all(-1) for x in noise.covariances)]).all(0)


def _pinhole(camera: Tensor) -> tuple[Tensor, Tensor]:
    """Cameras (9, B) scaled to a last entry of 1, and whether they are pinhole cameras, bool (B,).

    A pinhole camera has positive focal lengths and any skew; the entries below the diagonal are 0. Any multiple of its
    matrix is the same camera. Other matrices become ones.
    """
    limit = torch.finfo(camera.dtype).max ** 0.25
    entries = camera.detach()
    scaled = entries / entries[8:]
    # A sum below the limit bounds each term; NaN compares false.
    largest = torch.cat((entries, entries[8:].reciprocal(), scaled, scaled[:5:4].rsqrt())).abs().sum(0)
    below_diagonal = torch.cat((entries[3:4], entries[6:8])).any(0)
    fine = (largest < limit) & ~below_diagonal
    camera = torch.where(fine, camera, 1.0)
    return camera / camera[8:], fine


def _distances(points: Tensor, there: Tensor, padded: bool) -> tuple[Tensor, Tensor]:
    """Squared distances (N, B) from the median of the points (3, N, B), and the distance that two thirds stay below.

    The typical distance (B,) is squared, too, and infinite where two thirds of the points coincide.
    """
    counts = there.sum(0) if padded else points.shape[1]
    points = torch.where(there, points, torch.inf)
    middle = ranked(points, (counts - 1) // 2).nan_to_num(posinf=0.0)
    sq_distance = (points - middle[:, None]).square().sum(0)
    typical = ranked(sq_distance[None], 2 * counts // 3)[0]
    return sq_distance, typical.masked_fill(typical == 0, torch.inf)
