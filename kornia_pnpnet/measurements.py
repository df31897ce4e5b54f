"""Make a solver's inputs and their covariances: pixels from heat maps, and world points from pixels with depth."""

from __future__ import annotations

import math

import torch
from kornia.core.check import KORNIA_CHECK
from kornia.core.exceptions import TypeCheckError, ValueCheckError
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.subpix import spatial_expectation2d, spatial_softmax2d
from torch import Tensor

from kornia_pnpnet.cameras import pinholes
from kornia_pnpnet.core.checks import (
    Shapes,
    check_devices,
    check_form,
    check_positive,
    check_shapes,
    check_tensors,
    common_dtype,
    expand_sigma,
)
from kornia_pnpnet.core.performance import full_precision
from kornia_pnpnet.result import Pose, camera_matrices, check_pose, sound_pose, with_rotation

__all__ = ["depth_points", "heatmap_keypoints"]

# Variance per axis of a uniform distribution over one cell, in squared cells.
_CELL_VARIANCE = 1.0 / 12.0
# Least logit of a heatmap. With logits of minus infinity, the gradient of the temperature would be NaN.
_LEAST_LOGIT = -1e30


@full_precision
def heatmap_keypoints(
    heatmaps: Tensor, temperature: Tensor | float = 1.0, *, stride: float = 1.0
) -> tuple[Tensor, Tensor]:
    r"""Compute a keypoint and its covariance for each heat map: the mean and the covariance of the map's softmax.

    The softmax of a map is a density that is constant in each cell. The mean of this density is Kornia's soft-argmax.
    The variance of a cell, 1/12 per axis, is added to the covariance of the cells' centres (Sheppard's correction). The
    result is positive definite. :func:`~kornia_pnpnet.likelihood.monte_carlo_pose_loss` can train the covariance.

    Convention:
        Pixels are (u, v), and the centre of the top-left pixel is (0, 0), as in Kornia. Add 0.5 to the pixels if the
        camera's principal point is measured from the corner of the image.

    Source: A. Nibali et al., "Numerical Coordinate Regression with Convolutional Neural Networks", 2018 (DSNT).

    Args:
        heatmaps: logits or logarithms of probabilities, shape :math:`(B, N, H, W)`, with any leading dimensions.
        temperature: positive divisor of the logits, a number or a tensor that broadcasts to ``heatmaps``.
        stride: image pixels per cell of the map. Cell 0 covers the first ``stride`` pixels.

    Returns:
        A solver's ``img_points`` (B, N, 2) and ``img_cov`` in px² (B, N, 2, 2). A map with NaN gives NaN.
        A map of minus infinity alone counts as uniform.

    Raises:
        BaseError: when ``heatmaps`` is not a real tensor of maps with at least one cell, when ``temperature`` does not
            broadcast to ``heatmaps``, or when ``temperature`` or ``stride`` is a number that is not positive.

    Example:
        >>> heatmaps = torch.full((1, 1, 5, 5), -100.0)
        >>> heatmaps[..., 2, 1:4] = 0.0  # a short horizontal edge
        >>> pixels, covariance = heatmap_keypoints(heatmaps)
        >>> pixels
        tensor([[[2., 2.]]])
        >>> covariance
        tensor([[[[0.7500, 0.0000],
                  [0.0000, 0.0833]]]])
    """
    check_form(["*", "N", "H", "W"], heatmaps=heatmaps)
    KORNIA_CHECK(0 not in heatmaps.shape[-2:], f"A heat map needs at least one cell, got {tuple(heatmaps.shape)}.")
    check_positive(stride=stride)
    tensors = {"heatmaps": heatmaps}
    if isinstance(temperature, Tensor):
        tensors["temperature"] = temperature
        check_devices(tensors, heatmaps, "heatmaps")
        sizes = zip(temperature.shape[::-1], heatmaps.shape[::-1], strict=False)
        fits = all(size in (1, other) for size, other in sizes)
        shapes = f"{tuple(temperature.shape)} and {tuple(heatmaps.shape)}"
        KORNIA_CHECK(fits, f"temperature must broadcast to the shape of heatmaps, got {shapes}.")
    else:
        check_positive(temperature=temperature)
    logits = heatmaps.to(common_dtype(tensors)).clamp(min=_LEAST_LOGIT) / temperature
    check_shapes({"heatmaps / temperature": (logits, tuple(heatmaps.shape))})
    *size, height, width = heatmaps.shape
    share = spatial_softmax2d(logits.reshape(math.prod(heatmaps.shape[:-3]), *heatmaps.shape[-3:]))
    mean = spatial_expectation2d(share, normalized_coordinates=False)  # (B, N, 2), cells
    u = torch.arange(width, dtype=share.dtype, device=share.device) - mean[..., :1]  # (B, N, W)
    v = torch.arange(height, dtype=share.dtype, device=share.device) - mean[..., 1:]  # (B, N, H)
    uu = (share.sum(-2) * u.square()).sum(-1) + _CELL_VARIANCE
    vv = (share.sum(-1) * v.square()).sum(-1) + _CELL_VARIANCE
    uv = (v * (share @ u[..., None])[..., 0]).sum(-1)
    covariance = torch.stack((uu, uv, uv, vv), -1).reshape(*size, 2, 2)
    return stride * mean.reshape(*size, 2) + 0.5 * (stride - 1.0), stride**2 * covariance


@full_precision
def depth_points(
    img_points: Tensor,
    depth: Tensor,
    intrinsics: Tensor | PinholeCamera,
    pose: Pose,
    *,
    depth_sigma: Tensor | float,
    img_sigma: Tensor | float | None = None,
    img_cov: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    r"""Compute world points and their covariances from pixels with depth, for example in an RGB-D image.

    A pixel :math:`(u, v)` of depth :math:`d` shows the point :math:`x = R^\top (d\,r - t)`, where :math:`r` is the ray
    :math:`K^{-1} (u, v, 1)^\top`. If the errors of pixel and depth are independent, the covariance of :math:`x` is
    exactly :math:`R^\top ((d^2 + \sigma_d^2)\, A \Sigma A^\top + \sigma_d^2\, r r^\top) R`. :math:`A` is the derivative
    of :math:`r` with respect to the pixel, and :math:`\Sigma` is the covariance of the pixel.

    Args:
        img_points: undistorted pixels of the camera that measured the depth, shape :math:`(B, N, 2)`, with any leading
            dimensions.
        depth: depth along the camera's z axis in the unit of the world, shape :math:`(B, N)`.
        intrinsics: see :meth:`PnPNet.forward <kornia_pnpnet.solver.PnPNet.forward>`.
        pose: world-to-camera pose of this camera, rotation :math:`(B, 3, 3)` and translation :math:`(B, 3)`. The
            nearest rotation replaces a matrix that is not exactly a rotation.
        depth_sigma: standard deviation of ``depth`` in the same unit, a number or shape :math:`(B,)` or :math:`(B, N)`.
        img_sigma: see ``PnPNet.forward``. Pixels are exact if neither ``img_sigma`` nor ``img_cov`` is given.
        img_cov: see ``PnPNet.forward``.

    Returns:
        A solver's ``world_points``, shape :math:`(B, N, 3)`, and ``world_cov`` in squared units of the world, shape
        :math:`(B, N, 3, 3)`. A pair gets NaN, without gradient, if its depth is not positive, its sigma is negative, or
        its camera or pose is invalid. The same holds if the fourth power of any of its numbers is not finite.
        The solver's ``mask`` must exclude pairs with NaN; otherwise their problem is not ``ok``.

    Raises:
        BaseError: for tensors whose shapes or devices do not match, tensors of booleans or complex numbers, a sigma
            that is neither a number nor a tensor, or ``img_sigma`` together with ``img_cov``.

    Example:
        >>> camera = torch.tensor([[100.0, 0.0, 50.0], [0.0, 100.0, 50.0], [0.0, 0.0, 1.0]])
        >>> here = Pose(torch.eye(3)[None], torch.zeros(1, 3))
        >>> pixel, depth = torch.tensor([[[50.0, 50.0]]]), torch.tensor([[2.0]])
        >>> points, covariance = depth_points(pixel, depth, camera, here, depth_sigma=0.1, img_sigma=1.0)
        >>> points, covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        (tensor([[[0., 0., 2.]]]), tensor([[[0.0200, 0.0200, 0.1000]]]))
    """
    check_form(["*", "N", "2"], img_points=img_points)
    check_pose("pose", pose)
    if img_sigma is not None and img_cov is not None:
        raise ValueCheckError("Give img_sigma or img_cov, not both.")
    *batch, count = img_points.shape[:-1]
    camera = camera_matrices(intrinsics, img_points.shape[:-2])
    check_tensors({"intrinsics": camera})
    shapes: Shapes = {
        "depth": (depth, (*batch, count)),
        "intrinsics": (camera, (3, 3) if camera.ndim == 2 else (*batch, 3, 3)),
        "rotation of the pose": (pose.rotation, (*batch, 3, 3)),
        "translation of the pose": (pose.translation, (*batch, 3)),
        "img_cov": (img_cov, (*batch, count, 2, 2)),
    }
    check_shapes(shapes)
    if depth_sigma is None:
        raise TypeCheckError("depth_sigma must be a number or a tensor, got None.")
    tensors = {name: tensor for name, (tensor, _) in shapes.items()}
    sigmas = {"depth_sigma": depth_sigma, "img_sigma": img_sigma}
    tensors |= {name: x for name, x in sigmas.items() if isinstance(x, Tensor)}
    check_devices(tensors, img_points, "img_points")
    dtype = common_dtype({"img_points": img_points, **tensors})
    pixels, depth, camera = (x.to(dtype) for x in (img_points, depth, camera))
    rotation, translation = with_rotation(Pose(*(x.to(dtype) for x in pose)))
    sigma_depth = expand_sigma("depth_sigma", depth_sigma, pixels)
    sigma_img = expand_sigma("img_sigma", 0.0 if img_sigma is None else img_sigma, pixels)

    limit = torch.finfo(dtype).max ** 0.25  # fourth powers of smaller numbers are finite
    eye = torch.eye(3, dtype=dtype, device=pixels.device)
    camera, has_camera = pinholes(camera)
    posed = has_camera & (torch.cat((rotation.flatten(-2), translation), -1).detach().abs() < limit).all(-1)
    rotation, translation = sound_pose(Pose(rotation, translation), posed)
    numbers = [pixels, *(x[..., None] for x in (depth, sigma_depth, sigma_img))]
    numbers += [] if img_cov is None else [img_cov.to(dtype).flatten(-2)]
    sound = posed[..., None] & (torch.cat(numbers, -1).detach().abs() < limit).all(-1)
    sound = sound & (depth > 0) & (sigma_depth >= 0) & (sigma_img >= 0)
    depth, sigma_depth, sigma_img = (torch.where(sound, x, 1.0) for x in (depth, sigma_depth, sigma_img))
    pixels = torch.where(sound[..., None], pixels, 0.0)
    noise = sigma_img.square()[..., None, None] * eye[:2, :2]
    if img_cov is not None:
        noise = torch.where(sound[..., None, None], img_cov.to(dtype), eye[:2, :2])

    # Rays are expressed in the world's axes. Kornia's unprojection is not used, because it ignores the skew.
    back = rotation.mT @ torch.linalg.inv_ex(camera).inverse  # (B, 3, 3)
    rays = convert_points_to_homogeneous(pixels) @ back.mT  # (B, N, 3)
    points = depth[..., None] * rays - translation[..., None, :] @ rotation
    across = back[..., None, :, :2]  # (B, 1, 3, 2)
    variance = sigma_depth.square()[..., None, None]
    covariance = (depth.square()[..., None, None] + variance) * (across @ noise @ across.mT)
    covariance = covariance + variance * rays[..., :, None] * rays[..., None, :]
    points = torch.where(sound[..., None], points, torch.nan)
    return points, torch.where(sound[..., None, None], covariance, torch.nan)
