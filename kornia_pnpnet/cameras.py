r"""Cameras that are no pinholes: distorted pixels become pixels of a pinhole camera, bearings become small cameras."""

from __future__ import annotations

from collections.abc import Callable

import torch
from kornia.core.exceptions import ShapeError, ValueCheckError
from kornia.geometry.calibration import distort_points
from torch import Tensor

from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.problem import Noise
from kornia_pnpnet.result import Pose

__all__ = ["bearing_cameras", "bearings", "check_coefficients", "compose", "undistort"]

# Numbers of coefficients of Kornia and OpenCV.
_COEFFICIENTS = (4, 5, 8, 12, 14)
# Newton's steps from the distorted to the undistorted point, and the largest residual of a solution, in focal lengths
# and roots of the machine epsilon.
_STEPS, _LARGEST_RESIDUAL = 12, 0.1
# The largest angle from the axis that has a pixel in a pinhole camera, in radians: 85 degrees.
_WIDEST = 1.4835


def undistort(
    img_points: Tensor, intrinsics: Tensor, dist: Tensor | None, fisheye: Tensor | None, noise: Noise | None
) -> tuple[Tensor, Tensor, Noise | None]:
    r"""Replace pixels of a distorted camera by those of the pinhole camera with the same intrinsics.

    The inverse is found by Newton's method; its gradient is that of the implicit function theorem.

    Args:
        img_points: shape :math:`(B, N, 2)`.
        intrinsics: shape :math:`(B, 3, 3)`.
        dist: coefficients of :func:`kornia.geometry.calibration.distort_points`, shape :math:`(B, D)`.
        fisheye: coefficients of ``cv2.fisheye``, shape :math:`(B, 4)`, in place of ``dist``.
        noise: noise of the pixels that were given.

    Returns:
        The pixels; which pairs have one, bool :math:`(B, N)`: points beyond what the coefficients were calibrated for,
        and more than 85 degrees off the axis, have none; the noise of the new pixels. A standard deviation stays
        isotropic: it is multiplied by the root mean square of the map's singular values.
    """
    camera = intrinsics / intrinsics[..., 2:, 2:]
    plane = _to_plane(img_points, camera)
    if dist is not None:
        coefficients = dist
        eye = torch.eye(3, dtype=plane.dtype, device=plane.device).expand(len(plane), 3, 3)
        # An angle of 90 degrees is infinitely far away: distorted points are close to the undistorted ones.
        ideal, inverse, found = _invert(lambda x: distort_points(x, eye, coefficients), plane)
    else:
        assert fisheye is not None
        ideal, inverse, found = _undistort_fisheye(plane, fisheye)
    back = camera[:, None, :2, :2] @ ideal[..., None]
    pixels = torch.where(found[..., None], back[..., 0] + camera[:, None, :2, 2], camera[:, None, :2, 2])
    if noise is not None:
        # From pixels to the plane, through the inverse map, and back to pixels.
        linear = camera[:, None, :2, :2]
        inverse = linear @ inverse @ torch.linalg.inv(linear)
        inverse = torch.where(found[..., None, None], inverse, torch.eye(2).to(inverse))
        growth = (0.5 * inverse.square().sum((-1, -2))).sqrt()
        noise = noise._replace(img=noise.img * growth)
        if noise.img_cov is not None:
            cov = noise.img_cov
            full = torch.stack((cov.uu, cov.uv, cov.uv, cov.vv), -1).unflatten(-1, (2, 2))
            noise = noise._replace(img_cov=Symmetric2.of(inverse @ full @ inverse.mT))
    return pixels, found, noise


def bearings(
    img_points: Tensor, intrinsics: Tensor, dist: Tensor | None = None, fisheye: Tensor | None = None
) -> Tensor:
    r"""Directions in which a camera sees its pixels; those of a fisheye may be more than 90 degrees off the axis.

    Args:
        img_points: shape :math:`(B, N, 2)`.
        intrinsics: shape :math:`(B, 3, 3)` or :math:`(3, 3)`.
        dist: coefficients of :func:`kornia.geometry.calibration.distort_points`, 4, 5, 8, 12 or 14 numbers, shape
            :math:`(B, D)` or :math:`(D,)`.
        fisheye: coefficients of ``cv2.fisheye``, shape :math:`(B, 4)` or :math:`(4,)`, in place of ``dist``.

    Returns:
        Unit vectors in the camera's frame, shape :math:`(B, N, 3)`, to use in place of pixels; NaN where a pixel has no
        direction.

    Raises:
        ShapeError: for another number of coefficients.
        ValueCheckError: for both kinds of coefficients.

    Example:
        >>> camera = torch.tensor([[100.0, 0.0, 320.0], [0.0, 100.0, 240.0], [0.0, 0.0, 1.0]])
        >>> behind = torch.tensor([[[320.0 + 0.75 * 100.0 * torch.pi, 240.0]]])  # 135 degrees off the axis
        >>> bearings(behind, camera, fisheye=torch.zeros(4))
        tensor([[[ 0.7071,  0.0000, -0.7071]]])
    """
    check_coefficients(dist, fisheye)
    batch = len(img_points)
    camera = (intrinsics / intrinsics[..., 2:, 2:]).expand(batch, 3, 3)
    plane = _to_plane(img_points, camera)
    if fisheye is not None:
        angle, unit, found = _fisheye_angle(plane, fisheye.expand(batch, 4))
        rays = torch.cat((angle.sin() * unit, angle.cos()), -1)
        return torch.where(found[..., None], rays, torch.nan)
    if dist is not None:
        coefficients = dist.expand(batch, dist.shape[-1])
        eye = torch.eye(3, dtype=plane.dtype, device=plane.device).expand(batch, 3, 3)
        plane, _, found = _invert(lambda x: distort_points(x, eye, coefficients), plane)
        plane = torch.where(found[..., None], plane, torch.nan)
    return torch.nn.functional.normalize(torch.cat((plane, torch.ones_like(plane[..., :1])), -1), dim=-1)


def check_coefficients(dist: Tensor | None, fisheye: Tensor | None) -> None:
    """Raise unless there is one kind of coefficients at most, and as many of them as the model has."""
    if dist is not None and fisheye is not None:
        raise ValueCheckError("Give dist or fisheye, not both.")
    for name, given, sizes in (("dist", dist, _COEFFICIENTS), ("fisheye", fisheye, (4,))):
        if given is not None and (given.ndim == 0 or given.shape[-1] not in sizes):
            raise ShapeError(
                f"{name} must have {' or '.join(map(str, sizes))} coefficients, got the shape {tuple(given.shape)}.",
                actual_shape=tuple(given.shape),
                expected_shape=["B", *map(str, sizes)],
            )


def bearing_cameras(rays: Tensor) -> tuple[Tensor, Tensor]:
    r"""Rotations that turn directions to the axis of a camera of their own.

    Args:
        rays: directions of any length but 0, shape :math:`(B, N, 3)`.

    Returns:
        Rotations :math:`(B, N, 3, 3)`, half turns with or without a half turn about the x axis, and whether the
        direction is finite and not 0, bool :math:`(B, N)`; the identity where it is not.

    Example:
        >>> rotation, _ = bearing_cameras(torch.tensor([[[3.0, 0.0, -4.0]]]))
        >>> (
        ...     (rotation @ torch.tensor([3.0, 0.0, -4.0])).norm(dim=-1),
        ...     (rotation @ torch.tensor([3.0, 0.0, -4.0]))[..., 2],
        ... )
        (tensor([[5.]]), tensor([[5.]]))
    """
    length = rays.detach().norm(dim=-1, keepdim=True)
    sound = (length > 0) & length.isfinite()
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=rays.dtype, device=rays.device)
    rays = torch.where(sound, rays, axis)
    rays = torch.nn.functional.normalize(rays, dim=-1)
    turn = torch.where(rays.detach()[..., 2:] < 0, -1.0, 1.0) * torch.ones_like(rays)
    turn = torch.cat((torch.ones_like(turn[..., :1]), turn[..., 1:]), -1)  # half a turn about x for rays behind
    middle = turn * rays + axis
    half_turn = 2.0 * middle[..., :, None] * middle[..., None, :] / middle.square().sum(-1)[..., None, None]
    rotation = (half_turn - torch.eye(3, dtype=rays.dtype, device=rays.device)) * turn[..., None, :]
    return rotation, sound[..., 0]


def _to_plane(img_points: Tensor, camera: Tensor) -> Tensor:
    """Pixels on the plane z = 1, (B, N, 2)."""
    u, v = (img_points - camera[:, None, :2, 2]).unbind(-1)
    fx, skew, fy = (camera[:, None, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    y = v / fy
    return torch.stack(((u - skew * y) / fx, y), -1)


def _invert(function: Callable[[Tensor], Tensor], target: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Points (B, N, 2) that a map takes to the target, the Jacobian of the inverse, and where there is a solution.

    A step of Newton's is as long as half of the target's distance at most. The last two steps carry the gradient, to
    the target and to what the function depends on; the second of them makes second derivatives exact.
    """
    fixed = target.detach()
    point = fixed
    with torch.no_grad():
        for _ in range(_STEPS):
            value, jacobian = _with_jacobian(function, point)
            step = _solve2(jacobian, fixed - value)
            longest = 0.5 * (fixed.norm(dim=-1, keepdim=True) + 1e-3)
            point = point + step * (longest / step.norm(dim=-1, keepdim=True).clamp(min=longest)).nan_to_num(0.0)
        value, jacobian = _with_jacobian(function, point)
        residual = (fixed - value).norm(dim=-1)
        determinant = jacobian[..., 0, 0] * jacobian[..., 1, 1] - jacobian[..., 0, 1] * jacobian[..., 1, 0]
        limit = _LARGEST_RESIDUAL * torch.finfo(point.dtype).eps ** 0.5 * (1.0 + fixed.norm(dim=-1))
        trace = jacobian[..., 0, 0] + jacobian[..., 1, 1]  # beyond a turning point a polynomial has more solutions
        found = (residual < limit) & (determinant > 0) & (trace > 0)
        safe = torch.where(found[..., None], point, 0.0)
        inverse = torch.linalg.inv_ex(torch.where(found[..., None, None], jacobian, torch.eye(2).to(jacobian))).inverse
    wanted = torch.where(found[..., None], target, 0.0)
    for _ in range(2):
        value = torch.where(found[..., None], function(safe), 0.0)
        safe = safe + (inverse @ (wanted - value)[..., None])[..., 0]
    return safe, inverse, found


def _with_jacobian(function: Callable[[Tensor], Tensor], point: Tensor) -> tuple[Tensor, Tensor]:
    """Values (B, N, 2) and Jacobians (B, N, 2, 2) of a map of each point by itself, by central differences of order 2.

    The differences only steer Newton's method: what it converges to does not depend on them.
    """
    size = torch.finfo(point.dtype).eps ** (1 / 3)
    step = size * torch.eye(2, dtype=point.dtype, device=point.device)
    columns = [(function(point + x) - function(point - x)) / (2.0 * size) for x in step]
    return function(point), torch.stack(columns, -1)


def _solve2(matrix: Tensor, right: Tensor) -> Tensor:
    """Solutions of 2×2 systems."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    u, v = right.unbind(-1)
    determinant = a * d - b * c
    determinant = torch.where(determinant.abs() > torch.finfo(matrix.dtype).eps, determinant, torch.inf)
    return torch.stack((d * u - b * v, a * v - c * u), -1) / determinant[..., None]


def _fisheye_angle(plane: Tensor, fisheye: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Angles from the axis (B, N, 1), unit vectors in the plane (B, N, 2), and which angles are below half a turn.

    A distorted radius is the angle times 1 + k1 angle² + k2 angle⁴ + …, as in ``cv2.fisheye``.
    """
    radius = plane.square().sum(-1, keepdim=True)
    central = radius.detach() < torch.finfo(plane.dtype).eps ** 2
    radius = torch.where(central, 1.0, radius).sqrt()
    unit = torch.where(central, 0.0, plane / radius)
    radius = torch.where(central, 0.0, radius)

    def distorted(angle: Tensor) -> tuple[Tensor, Tensor]:
        square = angle * angle
        value, slope = torch.ones_like(angle), torch.ones_like(angle)
        for power, k in enumerate(fisheye[:, None].split(1, -1), 1):
            value = value + k * square**power
            slope = slope + (2 * power + 1) * k * square**power
        return angle * value, slope

    with torch.no_grad():
        angle = radius.clamp(max=torch.pi)
        for _ in range(_STEPS):
            value, slope = distorted(angle)
            step = (radius - value) / torch.where(slope.abs() > 1e-6, slope, torch.inf)
            angle = (angle + step.clamp(-0.5, 0.5)).clamp(0.0, torch.pi)
        value, slope = distorted(angle)
        limit = _LARGEST_RESIDUAL * torch.finfo(angle.dtype).eps ** 0.5
        found = ((radius - value).abs() < limit * (1.0 + radius)) & (slope > 0)
        angle = torch.where(found, angle, 0.0)
        slope = torch.where(found, slope, 1.0)
    wanted = torch.where(found, radius, 0.0)
    for _ in range(2):  # as in `_invert`
        angle = angle + (wanted - torch.where(found, distorted(angle)[0], 0.0)) / slope
    return angle, unit, found[..., 0]


def _undistort_fisheye(plane: Tensor, fisheye: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Points on the plane z = 1 (B, N, 2), the Jacobian of the map to them, and where there is one."""
    angle, unit, found = _fisheye_angle(plane, fisheye)
    found = found & (angle.detach()[..., 0] < _WIDEST)
    angle = torch.where(found[..., None], angle, 0.0)
    ideal = angle.tan() * unit
    with torch.no_grad():
        powers = torch.stack([angle.square() ** i for i in range(1, 5)], -1)  # (B, N, 1, 4)
        odd = torch.arange(3, 10, 2, dtype=plane.dtype, device=plane.device)
        slope = 1.0 + (powers * odd * fisheye[:, None, None]).sum(-1)  # of the radius by the angle
        radius = angle * (1.0 + (powers * fisheye[:, None, None]).sum(-1))
        central = angle < torch.finfo(plane.dtype).eps ** 0.5
        across = torch.where(central, 1.0, angle.tan() / torch.where(central, 1.0, radius))
        along = (1.0 + angle.tan().square()) / slope
        outer = unit[..., :, None] * unit[..., None, :]
        eye = torch.eye(2, dtype=plane.dtype, device=plane.device)
        inverse = along[..., None] * outer + across[..., None] * (eye - outer)
    return ideal, inverse, found


def compose(outer: Tensor, rig: Pose | None) -> Pose:
    """Rotations (B, N, 3, 3) after the cameras of a rig."""
    if rig is None:
        return Pose(outer, torch.zeros_like(outer[..., 0]))
    return Pose(outer @ rig.rotation, (outer @ rig.translation[..., None])[..., 0])
