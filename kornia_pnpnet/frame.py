r"""Normalise problems: transform them from the caller's frame to the solver's frame, and transform poses back."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.checks import check_positive
from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.core.linalg import span_a_plane
from kornia_pnpnet.core.performance import ascending_order, exporting, ranked
from kornia_pnpnet.core.symmetric import are_semi_definite
from kornia_pnpnet.core.trees import map_tensors, pairs_at
from kornia_pnpnet.problem import LEAST_NOISE, MIN_PAIRS, Noise, Problem, Starts
from kornia_pnpnet.refine.residual import MIN_DEPTH_RATIO
from kornia_pnpnet.result import Pose, Status, sound_pose

__all__ = ["F_CONST", "Frame", "Normalize", "focal_length", "may_be_confidence", "scaled_cameras"]

#: Focal length of the normalised camera in pixels. (Cameras of ETH3D have focal lengths of 3400 to 3430.)
F_CONST = 3400.0
# Limit of the entries of given poses. Fourth powers of entries must be finite in float32, because networks use float32.
_LARGEST_ENTRY = torch.finfo(torch.float32).max ** 0.25
# Centre and scale ignore points that are farther than `_FAR` typical distances (see `Normalize`) from the median. For
# fewer than `_MANY` pairs, the limit is `_FAR_OF_FEW`, because the typical distance of few points is inaccurate.
_FAR, _MANY, _FAR_OF_FEW = 5.0, 12, 25.0
# Points beyond this number of typical distances from the median lose their weight, because float32 has too few digits.
_LARGEST_DISTANCE = 1e6
# A confidence (such as a cosine of descriptors) may leave [0, 1] by less than this number, because of rounding.
_ROUNDING = 1e-3
# Tangent of 85 degrees. A real lens without distortion does not see rays that are more than 85 degrees off the axis.
_FAR_ANGLE = 11.4


class Frame(NamedTuple):
    r"""The changes of frame and order that :class:`Normalize` applied to problems.

    Attributes:
        centroid: the world point that became the origin, shape :math:`(B, 3)`.
        size: the length in the caller's world that became 1, shape :math:`(B,)`.
        img_scale: factor from the caller's pixels to the problem's pixels (geometric mean of the absolute factors of u
            and v), shape :math:`(B,)`. In a rig, the factor is the geometric mean over the pairs. For distorted
            pixels, the solver multiplies the factor by the geometric mean of ``Inputs.lens_scale``.
        order: position of each normalised pair in the input, int64, shape :math:`(B, N)`; ``None``: the same order.
        status: ``Status.SOLVED`` or the reason why the problem is invalid, int64, shape :math:`(B,)`.
        intrinsics: the camera matrices, scaled to a last entry of 1, shape :math:`(B, 3, 3)`, or :math:`(B, N, 3, 3)`
            in a rig. The identity replaces invalid matrices.
        ignored: ``Status.INIT`` if an invalid ``init`` was ignored, else ``Status.CONFIDENCE`` if pairs with an invalid
            ``confidence`` were left out, else ``Status.SOLVED``, int64, shape :math:`(B,)`; ``None``: neither is given.
    """

    centroid: Tensor
    size: Tensor
    img_scale: Tensor
    order: Tensor | None
    status: Tensor
    intrinsics: Tensor
    ignored: Tensor | None = None

    @property
    def valid(self) -> Tensor:
        """Whether the problem is valid, see :class:`Normalize`, bool, shape :math:`(B,)`."""
        return self.status == Status.SOLVED.value

    def apply(self, pose: Pose) -> Pose:
        r"""Express a pose in the problem's frame, :math:`(R,\; (t + R c) / s)`, for the size s and the centroid c."""
        offset = (pose.rotation * self.centroid[:, None]).sum(-1)
        return Pose(pose.rotation, (pose.translation + offset) / self.size[:, None])

    def undo(self, pose: Pose) -> Pose:
        r"""Invert :meth:`apply`: express a pose in the caller's world, :math:`(R,\; s t - R c)`.

        Each problem may have several poses, :math:`(B, S, 3, 3)` and :math:`(B, S, 3)`.
        """
        more = (1,) * (pose.translation.ndim - 2)
        offset = (pose.rotation * self.centroid.view(-1, *more, 1, 3)).sum(-1)
        return Pose(pose.rotation, pose.translation * self.size.view(-1, *more, 1) - offset)

    def units(self, focal: Tensor, lens_scale: Tensor | None) -> Tensor:
        """Number of the problem's pixels per pixel of the caller, (B, 1 or N), in the caller's order."""
        unit = focal / focal_length(self.intrinsics[:, None] if self.intrinsics.ndim == 3 else self.intrinsics)
        unit = unit if lens_scale is None else unit * lens_scale
        return torch.where((unit > 0) & unit.isfinite(), unit, 1.0)

    def undo_pairs(self, values: Tensor) -> Tensor:
        """Put values :math:`(B, N)` of pairs back into the caller's order."""
        return values if self.order is None else torch.zeros_like(values).scatter(1, self.order, values)

    def undo_starts(self, starts: Starts, focal: Tensor, lens_scale: Tensor | None) -> Starts:
        """Express starts of problems with a focal length in the caller's frame, order and units.

        The ``ok`` of the new starts is :attr:`valid`.
        """
        noise = starts.noise
        if noise is not None:
            img, world = map(self.undo_pairs, noise[:2])
            noise = Noise(img / self.units(focal, lens_scale), world * self.size[:, None])
        others = None if starts.others is None else self.undo(starts.others)
        return Starts(self.undo(starts.pose), self.undo_pairs(starts.weights), self.valid, others, noise)

    def start(self, init: Pose | None) -> tuple[Pose, Tensor]:
        """Express the caller's poses (``None``: identities) in this frame, and tell which are usable, bool (B,)."""
        eye = torch.eye(3, dtype=self.size.dtype, device=self.size.device).expand(self.size.shape[0], 3, 3)
        init = Pose(eye, torch.zeros_like(self.centroid)) if init is None else init
        values = torch.cat((init.rotation.flatten(1), self.apply(init).translation), 1).detach()
        usable = self.valid & (values.abs().amax(-1) < _LARGEST_ENTRY)
        return self.apply(sound_pose(init, usable)), usable


class Normalize(Configured):
    r"""Normalise the cameras, the order of the pairs, and the world frame of problems.

    Pixels become pixels of a camera with the focal length ``f_const`` and the principal point 0.

    A *valid* problem has finite numbers, weights of at least 0, and a pinhole camera (any multiple of a camera matrix,
    with or without skew). At least three of its pairs have a positive weight. Its points deviate from any line by more
    than the rounding errors of the coordinates. Zeros replace the inputs of invalid problems, so that all later values
    and gradients are finite. A pair with the weight 0 is padding. The coordinates of padding are ignored.

    Centroid and scale are computed from the *usual* pairs, so that bad triangulations and bad detections do not spoil
    the frame. The pixel of a usual pair is less than 85° off the camera's axis. The point of a usual pair is at most
    five typical distances from the median of the points (25 for fewer than 12 pairs). The typical distance is the
    radius of the sphere around the median that contains two thirds of the points. A pair loses its weight if its point
    is more than a million typical distances from the median, or if its pixel is almost 90° off the axis.

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
        r"""Normalise a batch. In memory, the batch is the last dimension of the problem's tensors.

        Args:
            world_points: shape :math:`(B, N, 3)`.
            img_points: pixels, shape :math:`(B, N, 2)`.
            intrinsics: shape :math:`(B, 3, 3)`; in a rig one matrix for each pair, :math:`(B, N, 3, 3)`.
            weights: at least 0, shape :math:`(B, N)`; 1 when ``None``.
            mask: False where a pair is padding, bool, shape :math:`(B, N)`.
            noise: noise of each pair, in pixels and in the unit of the world.
            confidence: see :class:`~kornia_pnpnet.problem.Problem`. Pairs with a value outside [0, 1] are left out.
            rig: see :class:`~kornia_pnpnet.problem.Problem`.
        """
        (batch, count), ignored = world_points.shape[:2], None
        if confidence is not None:
            named = torch.ones_like(confidence, dtype=torch.bool) if mask is None else mask
            named = named if weights is None else named & (weights != 0)
            mask = named & may_be_confidence(confidence)
            ignored = torch.where((named & ~mask).any(-1), Status.CONFIDENCE.value, Status.SOLVED.value)
            confidence = torch.where(mask, confidence.clamp(0.0, 1.0), torch.nan)
        padded = weights is not None or mask is not None
        if weights is None:
            weights = world_points.new_ones(batch, count) if mask is None else mask.to(world_points.dtype)
        elif mask is not None:
            weights = torch.where(mask, weights, 0.0)
        # From here on the batch is the last dimension. `rows` (6, N, B) holds the coordinates and the weight of each
        # pair. `camera` (9, 1 or N, B) holds the matrix entries: fx, fy = camera[:5:4] and cx, cy = camera[2:6:3].
        rows = torch.cat((world_points.permute(2, 1, 0), img_points.permute(2, 1, 0), weights.mT[None]))
        zero, one = rows.new_zeros(1, batch), rows.new_ones(1, batch)
        cameras = intrinsics.flatten(-2)
        cameras = cameras.mT if intrinsics.ndim == 3 else cameras.permute(2, 1, 0)
        cameras, is_camera = scaled_cameras(cameras.contiguous())
        camera = cameras[:, None] if intrinsics.ndim == 3 else cameras  # (9, 1 or N, B)

        # Fourth powers of numbers from 1 / `limit` to `limit` neither overflow nor underflow. NaN fails every test.
        limits = torch.finfo(rows.dtype)
        limit = limits.max**0.25
        given = rows[5] != 0
        sizes = rows.detach().abs()
        if padded:
            sizes = torch.where(given, sizes, zero)
        # The test uses a sum, because the maximum of ONNX Runtime ignores NaN, and because later sums must be finite.
        is_finite = sizes.sum((0, 1), dtype=torch.float64) < limits.max
        if padded:
            is_finite = is_finite & ((rows[5] >= 0) & (rows[5] < limit)).all(0)
        if rig is not None:
            is_camera = (is_camera | ~given).all(0)
        there = given & (is_camera & is_finite) & (sizes[3:5].amax(0) < limit)
        # A pair loses its weight if its distance or angle is too large. The problem stays valid.
        distance, typical = _distances(rows[:3].detach(), there, padded)
        there = there & (distance <= _LARGEST_DISTANCE * typical)
        rows = torch.where(there, rows, zero)  # all numbers are finite now, also in the unit of the typical distance
        focal = rows.new_full((), self.f_const)  # made on the device, so that a GPU need not wait for the CPU
        img_scales = focal / camera[:5:4]  # (2, 1 or N, B)

        pixels = (rows[3:5] - camera[2:6:3]) * img_scales
        off_axis = pixels.detach().abs().amax(0)  # f_const times the tangent of the angle from the axis
        there = there & (off_axis <= self.f_const / MIN_DEPTH_RATIO)
        number = there.sum(0)
        far = torch.where(number < _MANY, typical.new_full((), _FAR_OF_FEW), _FAR) * typical
        seen = there & (off_axis <= self.f_const * _FAR_ANGLE)
        usual = (seen | (there & (seen.sum(0) <= MIN_PAIRS))) & (distance <= far)  # keep all angles if few are seen
        is_usual = usual.to(rows.dtype)

        # Compute centre and scale from the usual points. Before squaring, coordinates are divided by the largest one.
        share = is_usual.sum(0).clamp(min=1.0).reciprocal()
        usual_points = rows[:3] * is_usual
        mean = usual_points.sum(1) * share
        unit = usual_points.detach().abs().amax((0, 1)).clamp(min=limits.tiny)
        centred = torch.addcmul(usual_points, mean[:, None], is_usual, value=-1) / unit
        spread_out, is_precise = span_a_plane(centred.detach(), share)
        mean_square = (centred if self.center else usual_points / unit).square().sum((0, 1)) * share
        unit, mean_square = (torch.where(is_precise, x, one[0]) for x in (unit, mean_square))
        size = mean_square.sqrt() * unit if self.scale else one[0]
        centroid = mean if self.center else zero.expand(3, batch)

        if noise is not None:
            has_noise = _is_usable(noise, given, size)
            is_finite = is_finite & has_noise
        if rig is not None:
            values = torch.cat((rig.rotation.flatten(-2), rig.translation / size[:, None, None]), -1).detach()
            sound = (values.abs() < _LARGEST_ENTRY).all(-1)  # (B, N)
            is_finite = is_finite & (sound | ~given.mT).all(-1)
            rig = sound_pose(rig, sound)
            rig = Pose(rig.rotation, rig.translation / size[:, None, None])
        status = torch.where(spread_out, Status.PRECISION.value, Status.DEGENERATE.value)
        status = status.masked_fill(is_precise, Status.SOLVED.value)
        status = status.masked_fill(number < MIN_PAIRS, Status.CAMERA.value)  # camera invalid or not fitting the pixels
        if padded:
            status = status.masked_fill(given.sum(0) < MIN_PAIRS, Status.TOO_FEW_PAIRS.value)
        if ignored is not None:
            status = torch.where(status == Status.TOO_FEW_PAIRS.value, ignored.maximum(status), status)
        status = torch.where(is_finite, status, Status.NOT_FINITE.value)
        valid = status == Status.SOLVED.value
        without_skew = torch.addcmul(pixels[:1], camera[1] / camera[0], pixels[1:], value=-1)
        world = (rows[:3] - centroid[:, None]) / size
        # All numbers of an invalid problem become 0, without gradient.
        rows = torch.where(there & valid, torch.cat((world, without_skew, pixels[1:], rows[5:])), zero)

        order = None
        if self.order:
            order = ascending_order(torch.where(usual, rows[3:5].detach(), torch.inf))
            rows = rows.gather(1, order.mT.expand(6, -1, -1))
            is_usual = is_usual.gather(0, order.mT)
        world_points, img_points, weights = rows.permute(2, 1, 0).split((3, 2, 1), -1)
        horizontal, vertical = img_scales
        img_scale = (horizontal * vertical).abs().sqrt()  # (1 or N, B)
        matrices = (cameras.mT if intrinsics.ndim == 3 else cameras.permute(2, 1, 0)).unflatten(-1, (3, 3))
        mean_scale = img_scale[0]
        if rig is not None:  # a problem without pairs gets the scale 1
            share = there.to(rows.dtype) / number.clamp(min=1)
            mean_scale = torch.where(there.any(0), (img_scale.log() * share).sum(0).exp(), 1.0)
        frame = Frame(centroid.mT, size, mean_scale, order, status, matrices, ignored)
        if noise is not None:
            sound = (there & has_noise).mT

            def scaled(sigma: Tensor, unit: Tensor) -> Tensor:
                """Divide sigmas by a unit. Unknown sigmas are replaced first: the unit's gradient must not be NaN."""
                known = sound & ~sigma.isnan()
                return torch.where(known, torch.where(known, sigma, 0.0) / unit, torch.nan)

            img_cov, world_cov = map_tensors(lambda x: torch.where(sound, x, 0.0), noise[2:])
            if img_cov is not None:  # the matrix [[a, b], [0, d]] multiplies pixels
                a, b, d = (x.mT for x in (horizontal, -camera[1] / camera[0] * vertical, vertical))
                img_cov = img_cov.mapped(a, b, d).at_least((LEAST_NOISE * self.f_const) ** 2)
            if world_cov is not None:
                world_cov = world_cov.divided(size[:, None])
            sigmas = scaled(noise.img, img_scale.mT.reciprocal()), scaled(noise.world, size[:, None])
            noise = Noise(*sigmas, img_cov, world_cov)
        if order is not None:
            noise, confidence, rig = pairs_at((noise, confidence, rig), order)
        scales = mean_scale, size.reciprocal(), is_usual.mT
        return Problem(world_points, img_points, weights[..., 0], focal, *scales, noise, confidence, rig), frame


def may_be_confidence(values: Tensor) -> Tensor:
    """Whether values are probabilities, up to rounding, or NaN (unknown)."""
    return (values > -_ROUNDING) & (values < 1.0 + _ROUNDING) | values.isnan()


def focal_length(camera: Tensor) -> Tensor:
    r"""Geometric means :math:`(*)` of the sizes of fx and fy, for valid camera matrices :math:`(*, 3, 3)`."""
    return (camera[..., 0, 0] * camera[..., 1, 1]).abs().sqrt()


def scaled_cameras(camera: Tensor) -> tuple[Tensor, Tensor]:
    """Scale camera matrices (9, ...) to a last entry of 1, and tell which matrices are valid.

    A valid matrix is upper triangular, and its focal lengths are not 0. Fourth powers of the entries, of the inverse
    focal lengths and of the inverse last entry are finite. The identity replaces an invalid matrix.
    """
    limit = torch.finfo(camera.dtype).max ** 0.25
    entries = camera.detach()
    scaled = entries / entries[8:]
    # The sum of absolute values bounds each value. NaN is not below the limit.
    largest = torch.cat((entries, entries[8:].reciprocal(), scaled, scaled[:5:4].reciprocal())).abs().sum(0)
    below_diagonal = torch.cat((entries[3:4], entries[6:8])).any(0)
    fine = (largest < limit) & ~below_diagonal
    eye = torch.eye(3, dtype=camera.dtype, device=camera.device)
    camera = torch.where(fine, camera, eye.view(9, *(1,) * (camera.ndim - 1)))
    return camera / camera[8:], fine


def _is_usable(noise: Noise, given: Tensor, size: Tensor) -> Tensor:
    """Tell whether all ``given`` pairs have sigmas in [0, limit) or NaN, and semi-definite covariances, bool (B,)."""
    limit = torch.finfo(size.dtype).max ** 0.25
    sigmas = noise.img, noise.world.detach() / size[:, None]
    usable = [((x >= 0) & (x < limit)) | x.isnan() for x in sigmas]
    world_cov = map_tensors(lambda x: x.detach() / size[:, None] / size[:, None], noise.world_cov)
    covariances = noise._replace(world_cov=world_cov).covariances
    return torch.stack([(x | ~given.mT).all(-1) for x in (*usable, *map(are_semi_definite, covariances))]).all(0)


def _distances(points: Tensor, there: Tensor, padded: bool) -> tuple[Tensor, Tensor]:
    """Distances (N, B) of points (3, N, B) from their median, and the typical distance (B,)."""
    counts = there.sum(0) if padded else points.shape[1]
    points = torch.where(there, points, torch.inf)
    middle = ranked(points, (counts - 1) // 2).nan_to_num(posinf=0.0)
    offset = points - middle[:, None]
    if exporting():  # ONNX has no `hypot`
        distance = offset.square().sum(0).sqrt()
    else:  # squares could overflow or underflow
        x, y, z = offset
        distance = x.hypot(y).hypot(z)
    typical = ranked(distance[None], 2 * counts // 3)[0]
    # If two thirds of the points coincide, an infinite typical distance makes all points usual.
    return distance, typical.masked_fill(typical == 0, torch.inf)
