"""How sure a pose is: its covariance, from what the pairs are worth."""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kornia_pnpnet.core.checks import Shapes, check_devices, check_shapes
from kornia_pnpnet.geometry import normal_equations, pixel_variance, project
from kornia_pnpnet.types import Correspondences, Noise, Pose, camera_matrices

__all__ = ["pose_covariance"]


def pose_covariance(
    pose: Pose,
    world_points: Tensor,
    img_points: Tensor,
    intrinsics: Tensor | PinholeCamera,
    *,
    img_sigma: Tensor | float,
    world_sigma: Tensor | float = 0.0,
    weights: Tensor | None = None,
) -> Tensor:
    r"""Covariance of a pose that was found by weighted least squares, to first order.

    It is :math:`(\sum_i w_i J_i^\top J_i / \sigma_i^2)^{-1}` with the Jacobian of the pixels by the tangent
    :math:`(\omega, v)` of :func:`~kornia_pnpnet.geometry.retract`: the estimate is about
    :math:`(\mathrm{cay}(\omega) R,\; t + v)` when :math:`(R, t)` is true. :math:`\sigma_i^2` is the
    :func:`~kornia_pnpnet.geometry.pixel_variance`. It is computed in float64 and has no gradient.

    Args:
        pose: rotation :math:`(B, 3, 3)`, translation :math:`(B, 3)`.
        world_points: shape :math:`(B, N, 3)`.
        img_points: pixels, shape :math:`(B, N, 2)`.
        intrinsics: shape :math:`(B, 3, 3)` or :math:`(3, 3)`, or Kornia's cameras.
        img_sigma: standard deviation of the noise on each pixel coordinate, a number, :math:`(B,)` or :math:`(B, N)`.
        world_sigma: likewise on each world coordinate, in the unit of the world.
        weights: how likely each pair is right, shape :math:`(B, N)`, such as the ``weights`` of a result; 1 when
            ``None``.

    Returns:
        Shape :math:`(B, 6, 6)`, in radians and the world's unit. Where the pairs do not determine the pose it is
        infinite on the diagonal and 0 elsewhere.

    Raises:
        ShapeError: for shapes that do not go together.
        DeviceError: for tensors on different devices.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> p = SyntheticProblems(n=50, batch_size=2, seed=0).batch(0)
        >>> pose_covariance(p.pose, *p[:3], img_sigma=1.0, world_sigma=0.05).shape
        torch.Size([2, 6, 6])
    """
    KORNIA_CHECK_SHAPE(world_points, ["B", "N", "3"])
    batch, count = world_points.shape[:2]
    rotation, translation = pose
    camera = camera_matrices(intrinsics)
    shapes: Shapes = {
        "img_points": (img_points, (batch, count, 2)),
        "intrinsics": (camera, (3, 3) if camera.ndim == 2 else (batch, 3, 3)),
        "rotation of the pose": (rotation, (batch, 3, 3)),
        "translation of the pose": (translation, (batch, 3)),
        "weights": (weights, (batch, count)),
    }
    sigmas = {"img_sigma": img_sigma, "world_sigma": world_sigma}
    for name, sigma in sigmas.items():
        if isinstance(sigma, Tensor):
            each = (batch,) if sigma.ndim == 1 else (batch, count)
            shapes[name] = sigma, each if sigma.ndim else ()
    check_shapes(shapes, world_points)
    check_devices({name: tensor for name, (tensor, _) in shapes.items()}, world_points)
    dtype = world_points.dtype
    with torch.no_grad():
        world, pixels, camera = (x.double() for x in (world_points, img_points, camera))
        focals, centre = camera.diagonal(dim1=-2, dim2=-1)[..., :2], camera[..., :2, 2]
        one = focals.new_ones(())  # rays: pixels of a camera with the focal length 1
        rays = (pixels - centre[..., None, :]) / focals[..., None, :]
        focal = focals.log().mean(-1).exp().reshape(-1, 1)  # (B or 1, 1)
        numbers = (torch.as_tensor(x, dtype=torch.float64, device=world.device) for x in sigmas.values())
        img, length = ((x[:, None] if x.ndim == 1 else x).expand(batch, count) for x in numbers)
        # About the centroid and in units of the spread, where turns and shifts are well apart.
        mean = world.mean(1, keepdim=True)
        size = (world - mean).square().sum(-1).mean(1).sqrt().clamp(min=torch.finfo(torch.float64).tiny)[:, None]
        rotation, translation = rotation.double(), translation.double()
        turned = (rotation @ mean.mT)[..., 0]
        moved = Pose(rotation, (translation + turned) / size)
        there = torch.ones_like(img) if weights is None else weights.double()
        corr = Correspondences((world - mean) / size[..., None], rays, there, one)
        projection = project(moved, corr)
        variance = pixel_variance(projection, Noise(img / focal, length / size), one)
        rows = normal_equations(projection, there / variance).hessian
        hessian = torch.stack([torch.stack([rows[max(i, j)][min(i, j)] for j in range(6)], -1) for i in range(6)], -2)
        inverse, info = torch.linalg.inv_ex(hessian)
        known = (info == 0) & inverse.isfinite().all((1, 2)) & (inverse.diagonal(dim1=1, dim2=2) > 0).all(-1)
        inverse = torch.where(known[:, None, None], inverse, 0.0)
        # v of the world as it was: size times that of the centred one, and what a turn about the centroid shifts.
        x, y, z = turned.unbind(-1)
        zero = torch.zeros_like(x)
        cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))
        eye = torch.eye(3, dtype=torch.float64, device=world.device).expand(batch, 3, 3)
        upper = torch.cat((eye, torch.zeros_like(eye)), -1)
        lower = torch.cat((cross, size[..., None] * eye), -1)
        back = torch.cat((upper, lower), 1)
        covariance = back @ inverse @ back.mT
        diagonal = torch.eye(6, dtype=torch.bool, device=world.device)
        infinite = covariance.new_zeros(6, 6).masked_fill(diagonal, torch.inf)
        return torch.where(known[:, None, None], covariance, infinite).to(dtype)
