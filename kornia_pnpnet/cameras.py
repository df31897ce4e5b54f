"""Undistort pixels, convert pixels to bearings, make cameras that look along bearings, and project points.

The *undistorted point* of a pixel lies on the pixel's ray and on the plane z = 1. Rays of a fisheye can miss the plane.
For a fisheye, the point therefore has the direction of the ray's (x, y). Its norm is the angle from the optical axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from kornia.core.exceptions import ShapeError, ValueCheckError
from kornia.geometry.calibration import distort_points
from kornia.geometry.conversions import (
    convert_points_from_homogeneous,
    convert_points_to_homogeneous,
    normalize_points_with_intrinsics,
)
from kornia.geometry.linalg import transform_points
from torch import Tensor
from torch.nn.functional import normalize

from kornia_pnpnet.core.checks import check_devices, check_form, check_shapes, check_tensors, common_dtype
from kornia_pnpnet.core.performance import full_precision
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.frame import focal_length, scaled_cameras
from kornia_pnpnet.problem import Inputs, Noise
from kornia_pnpnet.result import Pose, sound_pose

__all__ = [
    "bearing_cameras",
    "bearings",
    "check_coefficients",
    "looking_along",
    "pinholes",
    "reproject",
    "undistort",
    "with_undistorted",
    "zoomed",
]

# Numbers of distortion coefficients that Kornia and OpenCV accept.
_COEFFICIENTS = (4, 5, 8, 12, 14)
# Number of Newton steps from the distorted to the undistorted point.
_STEPS = 12
# Newton solutions are rejected if their relative residual exceeds this number times the square root of eps.
_LARGEST_RESIDUAL = 0.1
# Largest angle from the optical axis, in radians, at which fisheye pixels are undistorted (85 degrees).
_WIDEST = 1.4835


def undistort(
    img_points: Tensor, intrinsics: Tensor, dist: Tensor | None, fisheye: Tensor | None, noise: Noise | None
) -> tuple[Tensor, Tensor, Tensor, Noise | None]:
    r"""Replace distorted pixels by pixels of the pinhole camera that has the same intrinsics.

    Newton's method inverts the distortion, and the implicit function theorem gives the gradient of the inverse. Unlike
    this function, :func:`kornia.geometry.calibration.undistort_points` does not reject pixels without a solution.

    Args:
        img_points: shape :math:`(B, N, 2)`.
        intrinsics: shape :math:`(B, 3, 3)`.
        dist: coefficients of :func:`kornia.geometry.calibration.distort_points`, shape :math:`(B, D)`.
        fisheye: coefficients of ``cv2.fisheye``, shape :math:`(B, 4)`, in place of ``dist``.
        noise: noise of the distorted pixels.

    Returns:
        The undistorted pixels; whether each pixel has a solution, bool :math:`(B, N)`; the scale of each pixel, shape
        :math:`(B, N)`; and the noise of the undistorted pixels. A pixel has no solution if it is outside the range of
        the polynomial, if it is more than 85 degrees off the axis of a fisheye, or if pixel, camera or coefficients are
        invalid. The principal point replaces a pixel without a solution. The scale multiplies sigmas. It is the
        Frobenius norm of the undistortion's Jacobian, divided by √2.
    """
    check_form(["B", "N", "2"], img_points=img_points)
    camera, _ = pinholes(intrinsics)
    point, found, lens = _through(dist, fisheye, img_points, intrinsics)
    flatten = (lambda x: x) if fisheye is None else _flatten
    if fisheye is not None:
        found = found & (point.detach().norm(dim=-1) < _WIDEST)
        point = torch.where(found[..., None], point, 0.0)
    pixels = transform_points(camera, flatten(point))
    with torch.no_grad():  # derivative of the undistorted point with respect to the distorted point
        jacobian = _linearised(flatten, point)[1] @ _inverse(_linearised(lens, point)[1])
        eye = torch.eye(2, dtype=jacobian.dtype, device=jacobian.device)
        jacobian = torch.where(found[..., None, None], jacobian, eye)
    to_pixels = camera[:, None, :2, :2]
    jacobian = to_pixels @ torch.linalg.solve_triangular(to_pixels, jacobian, upper=True, left=False)
    scale = (0.5 * jacobian.square().sum((-1, -2))).sqrt()
    if noise is not None:
        # Noise that is not finite (an unknown sigma is NaN) stays unchanged, and gives the camera no gradient.
        finite = noise.img.isfinite()
        noise = noise._replace(img=torch.where(finite, torch.where(finite, noise.img, 0.0) * scale, noise.img))
        if noise.img_cov is not None:
            (a, b), (c, d) = (row.unbind(-1) for row in jacobian.unbind(-2))
            finite = torch.stack([*noise.img_cov]).isfinite().all(0)
            cov = map_tensors(lambda x: torch.where(finite, x, 0.0), noise.img_cov).mapped(a, b, d, c)
            cov = map_tensors(lambda x, y: torch.where(finite, x, y), cov, noise.img_cov)
            noise = noise._replace(img_cov=cov)
    return pixels, found, scale.detach(), noise


def with_undistorted(inputs: Inputs, dist: Tensor | None, fisheye: Tensor | None) -> Inputs:
    """Replace distorted pixels by pixels of pinhole cameras, see :func:`undistort`.

    Pairs whose pixel cannot be undistorted are masked out. A non-finite pixel, an invalid camera, and coefficients that
    are not finite make their problem invalid.
    """
    # Rounding errors depend on the memory layout, but results must not depend on the layout of the inputs.
    inputs, dist, fisheye = map_tensors(torch.Tensor.contiguous, (inputs, dist, fisheye))
    lens = dist if fisheye is None else fisheye
    assert lens is not None
    unusable = ~lens.detach().isfinite().all(-1)[:, None]
    broken = ~inputs.img_points.isfinite().all(-1) | ~pinholes(inputs.intrinsics)[1][:, None] | unusable
    seen = torch.where(broken[..., None], 0.0, inputs.img_points)
    pixels, found, scale, noise = undistort(seen, inputs.intrinsics, dist, fisheye, inputs.noise)
    mask = found | broken if inputs.mask is None else (found | broken) & inputs.mask
    pixels = torch.where(broken[..., None], inputs.img_points, pixels)
    pixels = torch.where(unusable[..., None], torch.nan, pixels)
    return inputs._replace(img_points=pixels, mask=mask, noise=noise, lens_scale=scale)


@full_precision
def bearings(
    img_points: Tensor, intrinsics: Tensor, dist: Tensor | None = None, fisheye: Tensor | None = None
) -> Tensor:
    r"""Convert pixels to bearings.

    A bearing is the direction of a pixel's ray. Bearings of a fisheye may be more than 90 degrees off the optical axis.

    Args:
        img_points: shape :math:`(B, N, 2)`. :math:`B` stands for any number of leading dimensions, including none.
        intrinsics: shape :math:`(B, 3, 3)` or :math:`(3, 3)`.
        dist: see :meth:`PnPNet.forward <kornia_pnpnet.solver.PnPNet.forward>`.
        fisheye: see ``PnPNet.forward``.

    Returns:
        Unit vectors in the camera's frame, shape :math:`(B, N, 3)`. A solver accepts bearings in place of pixels. The
        bearing of a pixel that cannot be undistorted is NaN and has no gradient.

    Raises:
        ShapeError: when a shape is not as documented, or when no lens model has the given number of coefficients.
        ValueCheckError: when both ``dist`` and ``fisheye`` are given.
        BaseError: for tensors on different devices, and for booleans or complex numbers.

    Example:
        >>> camera = torch.tensor([[100.0, 0.0, 320.0], [0.0, 100.0, 240.0], [0.0, 0.0, 1.0]])
        >>> behind = torch.tensor([[[320.0 + 0.75 * 100.0 * torch.pi, 240.0]]])  # 135 degrees off the axis
        >>> bearings(behind, camera, fisheye=torch.zeros(4))
        tensor([[[ 0.7071,  0.0000, -0.7071]]])
    """
    check_coefficients(dist, fisheye)
    check_form(["*", "N", "2"], img_points=img_points)
    check_form(["*", "3", "3"], intrinsics=intrinsics)
    size, tensors = img_points.shape[:-2], {"intrinsics": intrinsics, "dist": dist, "fisheye": fisheye}
    given = {name: x for name, x in tensors.items() if x is not None}
    entries = {name: (3, 3) if name == "intrinsics" else (x.shape[-1],) for name, x in given.items()}
    leading = {name: size if x.ndim > len(entries[name]) else () for name, x in given.items()}
    check_shapes({name: (x, (*leading[name], *entries[name])) for name, x in given.items()})
    check_devices(given, img_points, "img_points")
    dtype = common_dtype({"img_points": img_points, **given})
    pixels = img_points.to(dtype).reshape(math.prod(size), *img_points.shape[-2:])
    for name, x in given.items():
        given[name] = x.to(dtype).expand(*size, *entries[name]).reshape(-1, *entries[name])
    point, found, _ = _through(given.get("dist"), given.get("fisheye"), pixels, given["intrinsics"])
    if fisheye is None:
        rays = normalize(convert_points_to_homogeneous(point), dim=-1)
    else:
        angle = _angle(point)
        found = found & (angle.detach()[..., 0] < torch.pi)
        rays = torch.cat((torch.sinc(angle / torch.pi) * point, angle.cos()), -1)
    return torch.where(found[..., None], rays, torch.nan).reshape(*img_points.shape[:-1], 3)


def check_coefficients(dist: Tensor | None, fisheye: Tensor | None) -> None:
    """Raise an error when both arguments are given, or when no lens model has the given number of coefficients."""
    check_tensors({"dist": dist, "fisheye": fisheye})
    if dist is not None and fisheye is not None:
        raise ValueCheckError("Give dist or fisheye, not both.")
    for name, given, sizes in (("dist", dist, _COEFFICIENTS), ("fisheye", fisheye, (4,))):
        if given is not None and (given.ndim == 0 or given.shape[-1] not in sizes):
            numbers = " or ".join(map(str, sizes))
            raise ShapeError(f"{name} must have {numbers} coefficients, got the shape {tuple(given.shape)}.")


def bearing_cameras(rays: Tensor) -> tuple[Tensor, Tensor]:
    r"""Find rotations (B, N, 3, 3) that map directions (B, N, 3) to the z axis, and mark valid directions, bool (B, N).

    A direction is invalid if it is not finite, or if no entry exceeds the square root of the smallest normal number. An
    invalid direction gets a constant rotation.

    Example:
        >>> rotation, _ = bearing_cameras(torch.tensor([[[3.0, 0.0, -4.0]]]))
        >>> (rotation @ torch.tensor([3.0, 0.0, -4.0]))[..., 2]
        tensor([[5.]])
    """
    check_form(["*", "3"], rays=rays)
    rays = rays.to(common_dtype({"rays": rays}))
    largest = rays.detach().abs().amax(-1, keepdim=True)  # rays divided by this number have finite squares
    # If all entries of a direction were below this limit, the gradient of the direction would overflow.
    sound = (largest > torch.finfo(rays.dtype).tiny ** 0.5) & largest.isfinite()
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=rays.dtype, device=rays.device)
    rays = normalize(torch.where(sound, rays, axis) / torch.where(sound, largest, 1.0), dim=-1)
    behind = torch.tensor([1.0, -1.0, -1.0], dtype=rays.dtype, device=rays.device)  # a half turn about x
    turn = torch.where(rays.detach()[..., 2:] < 0, behind, 1.0)
    middle = turn * rays + axis
    half_turn = 2.0 * middle[..., :, None] * middle[..., None, :] / middle.square().sum(-1)[..., None, None]
    rotation = (half_turn - torch.eye(3, dtype=rays.dtype, device=rays.device)) * turn[..., None, :]
    return rotation, sound[..., 0]


def looking_along(inputs: Inputs) -> Inputs:
    """Convert bearings to a rig in which each pair has a camera whose optical axis is the bearing of the pair."""
    inputs = map_tensors(torch.Tensor.contiguous, inputs)  # see `with_undistorted`
    rotation, sound = bearing_cameras(inputs.img_points)
    rig = Pose(rotation, torch.zeros_like(rotation[..., 0]))
    if inputs.rig is not None:  # an invalid camera makes the direction of its pair invalid
        sound = sound & torch.cat([x.flatten(2) for x in inputs.rig], 2).detach().isfinite().all(2)
        turn, shift = sound_pose(inputs.rig, sound)
        rig = Pose(rotation @ turn, (rotation @ shift[..., None])[..., 0])
    axis = torch.where(sound[..., None], torch.zeros_like(inputs.img_points[..., :2]), torch.nan)
    # The geometric mean of fx and fy converts sigmas from pixels to radians. Skew and principal point are ignored.
    cameras, has_focal = pinholes(inputs.intrinsics.diagonal(dim1=-2, dim2=-1).diag_embed())
    focal = torch.where(has_focal, focal_length(cameras), 0.0)
    cameras = torch.stack((focal, focal, torch.ones_like(focal)), -1).diag_embed()
    return inputs._replace(img_points=axis, intrinsics=cameras, rig=rig)


def pinholes(intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Scale camera matrices (*, 3, 3), and tell which are valid, see :func:`~kornia_pnpnet.frame.scaled_cameras`."""
    entries, sound = scaled_cameras(intrinsics.flatten(-2).movedim(-1, 0))
    return entries.movedim(0, -1).unflatten(-1, (3, 3)), sound


def reproject(world_points: Tensor, intrinsics: Tensor, pose: Pose) -> Tensor:
    """Project world points (B, N, 3) to pixels (B, N, 2). Points that are not in front of the camera become NaN."""
    cam_points = world_points @ pose.rotation.mT + pose.translation[:, None]
    in_front = cam_points[..., 2:] > 0
    pixels = convert_points_from_homogeneous(torch.where(in_front, cam_points, 1.0) @ intrinsics.mT, eps=0.0)
    return torch.where(in_front, pixels, torch.nan)


def zoomed(plane_points: Tensor, dist: Tensor | None, fisheye: Tensor | None) -> Tensor:
    r"""Differentiate distorted pixels of known points by log f, and convert the derivative to undistorted pixels.

    The lens maps a point :math:`p` of the plane z = 1 to :math:`D(p)`. The derivative of the distorted pixel is
    :math:`f D(p)`. Converted and divided by :math:`f`, it is :math:`(\partial D / \partial p)^{-1} D(p)`, which is
    the result, shape (B, N, 2). Coefficients that are not finite become 0.
    """
    dist, fisheye = map_tensors(lambda x: x.nan_to_num(0.0, 0.0, 0.0), (dist, fisheye))
    lens = _lens(fisheye if dist is None else dist, is_fisheye=dist is None)

    def distorted(point: Tensor) -> Tensor:
        radius = _angle(point)  # the tangent of the angle, because the point lies on the plane
        return lens(point if fisheye is None else radius.atan() / radius * point)

    seen, jacobian = _linearised(distorted, plane_points)
    return (_inverse(jacobian) @ seen[..., None])[..., 0]


def _through(
    dist: Tensor | None, fisheye: Tensor | None, img_points: Tensor, intrinsics: Tensor
) -> tuple[Tensor, Tensor, Callable[[Tensor], Tensor]]:
    """Return undistorted points (B, N, 2), a mask (B, N) of the points that exist, and the lens function."""
    camera, sound = pinholes(intrinsics)
    coefficients = fisheye if dist is None else dist
    if coefficients is not None:
        finite = coefficients.detach().isfinite().all(-1)
        coefficients, sound = torch.where(finite[:, None], coefficients, 0.0), sound & finite
    lens = _lens(coefficients, is_fisheye=dist is None)
    there = img_points.detach().isfinite().all(-1) & sound[:, None]
    x, y = normalize_points_with_intrinsics(torch.where(there[..., None], img_points, 0.0), camera).unbind(-1)
    skew = camera[:, None, 0, 1] / camera[:, None, 0, 0]  # Kornia ignores the skew
    point, found = _invert(lens, torch.stack((x - skew * y, y), -1))
    return point, found & there, lens


def _lens(coefficients: Tensor | None, *, is_fisheye: bool) -> Callable[[Tensor], Tensor]:
    """Make the function that maps undistorted points (B, N, 2) to distorted points on the plane z = 1."""
    if coefficients is None:
        return lambda point: point
    if not is_fisheye:
        eye = torch.eye(3, dtype=coefficients.dtype, device=coefficients.device).expand(coefficients.shape[0], 3, 3)
        return lambda point: distort_points(point, eye, coefficients)

    def distorted(point: Tensor) -> Tensor:
        square = point.square().sum(-1, keepdim=True)
        return point + sum(k * square**i for i, k in enumerate(coefficients[:, None].split(1, -1), 1)) * point

    return distorted


def _angle(point: Tensor) -> Tensor:
    """Return the angles (B, N, 1) of a fisheye's undistorted points. A lower bound keeps derivatives at 0 finite."""
    return point.square().sum(-1, keepdim=True).clamp(min=torch.finfo(point.dtype).eps ** 2).sqrt()


def _flatten(point: Tensor) -> Tensor:
    """Project undistorted points of a fisheye onto the plane z = 1."""
    angle = _angle(point)
    return torch.sinc(angle / torch.pi) / angle.cos() * point


def _invert(lens: Callable[[Tensor], Tensor], target: Tensor) -> tuple[Tensor, Tensor]:
    """Find the points (B, N, 2) that a lens maps to ``target``, and tell which points exist. A missing point is 0."""
    # A Newton step is at most about half the distance of the target from the centre. After the loop, two steps let
    # gradients flow to the target and the coefficients. The second of these steps makes second derivatives exact.
    with torch.no_grad():
        point = target
        longest = 0.5 * (target.norm(dim=-1, keepdim=True) + 1e-3)
        for _ in range(_STEPS):
            seen, jacobian = _linearised(lens, point)
            step = (_inverse(jacobian) @ (target - seen)[..., None])[..., 0]
            point = point + (step * (longest / step.norm(dim=-1, keepdim=True).clamp(min=longest))).nan_to_num(0.0)
        seen, jacobian = _linearised(lens, point)
        limit = _LARGEST_RESIDUAL * torch.finfo(point.dtype).eps ** 0.5 * (1.0 + target.norm(dim=-1))
        # Beyond the maximum of the polynomial, solutions are incorrect: their Jacobian mirrors or turns the image.
        ahead = (torch.linalg.det(jacobian) > 0) & (jacobian.diagonal(dim1=-2, dim2=-1).sum(-1) > 0)
        found = ((target - seen).norm(dim=-1) < limit) & ahead
        point = torch.where(found[..., None], point, 0.0)
        inverse = torch.where(found[..., None, None], _inverse(jacobian), 0.0)
    target = torch.where(found[..., None], target, 0.0)
    for _ in range(2):
        step = (inverse @ (target - lens(point))[..., None])[..., 0]
        point = torch.where(found[..., None], point + step, 0.0)
    return point, found


def _linearised(function: Callable[[Tensor], Tensor], point: Tensor) -> tuple[Tensor, Tensor]:
    """Call a pointwise function once, and return values (B, N, 2) and central-difference Jacobians (B, N, 2, 2)."""
    size = torch.finfo(point.dtype).eps ** (1 / 3)
    u, v = size * torch.eye(2, dtype=point.dtype, device=point.device)
    moved = torch.cat((point, point + u, point - u, point + v, point - v), 1)
    value, right, left, below, above = function(moved).tensor_split(5, 1)
    return value, torch.stack((right - left, below - above), -1) / (2.0 * size)


def _inverse(matrices: Tensor) -> Tensor:
    """Invert 2 by 2 matrices. A singular matrix gives 0."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrices.unbind(-2))
    determinant = a * d - b * c
    determinant = torch.where(determinant.abs() > torch.finfo(matrices.dtype).eps, determinant, torch.inf)
    return torch.stack((d, -b, -c, a), -1).unflatten(-1, (2, 2)) / determinant[..., None, None]
