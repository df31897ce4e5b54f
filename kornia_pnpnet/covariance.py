"""Covariance of a pose: how accurate the pose is, given the noise of its correspondences."""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from kornia.core.exceptions import ValueCheckError
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import normalize_points_with_intrinsics
from kornia.geometry.liegroup import So3
from torch import Tensor

from kornia_pnpnet.arguments import checked_noise
from kornia_pnpnet.core.checks import Shapes, check_devices, check_positive, check_shapes, common_dtype
from kornia_pnpnet.core.symmetric import are_semi_definite
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.problem import LEAST_NOISE, Noise, Problem, State
from kornia_pnpnet.refine.information import pixel_precision
from kornia_pnpnet.refine.residual import normal_equations, project
from kornia_pnpnet.refine.terms import CameraTerm, PoseTerm, add_term
from kornia_pnpnet.result import Pose, PosePrior, camera_matrices

__all__ = ["pose_covariance"]

# An information matrix with a diagonal of 1 and a smaller eigenvalue is singular up to rounding in float64.
_LEAST_EIGENVALUE = 1e-13


def pose_covariance(
    pose: Pose,
    world_points: Tensor,
    img_points: Tensor,
    intrinsics: Tensor | PinholeCamera,
    *,
    img_sigma: Tensor | float | None = None,
    world_sigma: Tensor | float | None = None,
    img_cov: Tensor | None = None,
    world_cov: Tensor | None = None,
    weights: Tensor | None = None,
    prior: PosePrior | None = None,
    focal: str = "known",
    focal_sigma: float | None = None,
) -> Tensor:
    r"""First-order covariance of a pose found by weighted least squares.

    The covariance is :math:`(\sum_i w_i J_i^\top \Sigma_i^{-1} J_i)^{-1}`. :math:`J_i` is the Jacobian of pixel
    :math:`i` by the tangent :math:`(\omega, v)` of :func:`~kornia_pnpnet.refine.residual.retract`: when
    :math:`(R, t)` is the true pose, the estimate is about :math:`(\mathrm{cay}(\omega) R,\; t + v)`.
    :math:`\Sigma_i` is the :func:`~kornia_pnpnet.refine.residual.pixel_covariance`, of isotropic noise the
    :func:`~kornia_pnpnet.refine.residual.pixel_variance`. The computation runs in float64. Gradients flow to the pose,
    the points, the camera, the noise and the weights.

    A robust kernel gives most inliers a weight below 1, but an M-estimate is hardly less accurate for it (P. Huber,
    "Robust Statistics", 1981). So :math:`w_i` is the weight over the mean weight of an inlier,
    :math:`\bar w = \sum_i w_i^2 / \sum_i w_i`, at most 1: a common factor of the weights does not matter.

    Args:
        pose: the estimated world-to-camera pose, rotation :math:`(B, 3, 3)` and translation :math:`(B, 3)`.
        world_points: see :meth:`PnPNet.forward <kornia_pnpnet.solver.PnPNet.forward>`.
        img_points: pixels; see ``PnPNet.forward``.
        intrinsics: see ``PnPNet.forward``.
        img_sigma: see ``PnPNet.forward``; required without ``img_cov``.
        world_sigma: see ``PnPNet.forward``. World points are exact without this and ``world_cov``.
        img_cov: see ``PnPNet.forward``.
        world_cov: see ``PnPNet.forward``.
        weights: weight of each pair, 0 for outliers, shape :math:`(B, N)`: the ``weights`` of a result. Those of
            `p3p-ransac` with a ``world_threshold`` also depend on the depth: pass ``(result.weights > 0).double()``.
            ``None``: 1 for every pair.
        prior: the prior that the pose was found with; its information adds to that of the pairs.
        focal: ``"known"``, or ``"unknown"``: the pose was found together with the focal length of the ``intrinsics``,
            which are then the ``intrinsics`` of the result.
        focal_sigma: the option of the solver with an unknown focal length; its information adds to that of the pairs.

    Returns:
        Shape :math:`(B, 6, 6)`, with an unknown focal length :math:`(B, 7, 7)`, whose last row and column are of the
        logarithm of the focal length; in radians and the unit of the world, float64 when the points, the camera, the
        weights or the pose are, else float32. Where the pairs do not determine the pose, or a covariance is not
        positive semi-definite, the diagonal is infinite and all other entries are 0.

    Raises:
        ShapeError: when shapes do not match.
        TypeCheckError: when a sigma is neither a number nor a tensor, or a tensor holds booleans or complex numbers.
        DeviceError: when tensors are on different devices.
        ValueCheckError: without the noise of the pixels, with both a sigma and a covariance, or for another ``focal``.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> p = SyntheticProblems(n=50, batch_size=2, seed=0).batch(0)
        >>> noise = {"img_sigma": 1.0, "world_sigma": 0.05}
        >>> pose_covariance(p.pose, p.world_points, p.img_points, p.intrinsics, **noise).shape
        torch.Size([2, 6, 6])
    """
    KORNIA_CHECK_SHAPE(world_points, ["B", "N", "3"])
    batch, count = world_points.shape[:2]
    camera = camera_matrices(intrinsics)
    shapes: Shapes = {
        "img_points": (img_points, (batch, count, 2)),
        "intrinsics": (camera, (3, 3) if camera.ndim == 2 else (batch, 3, 3)),
        "rotation of the pose": (pose.rotation, (batch, 3, 3)),
        "translation of the pose": (pose.translation, (batch, 3)),
        "weights": (weights, (batch, count)),
        "img_cov": (img_cov, (batch, count, 2, 2)),
        "world_cov": (world_cov, (batch, count, 3, 3)),
    }
    check_shapes(shapes, world_points)
    tensors = {name: tensor for name, (tensor, _) in shapes.items()}
    check_devices(tensors, world_points)
    dtype = common_dtype({"world_points": world_points, **tensors})
    if focal not in ("known", "unknown") or (focal == "known" and focal_sigma is not None):
        raise ValueCheckError(f"focal must be 'known', or 'unknown' with or without focal_sigma, got {focal!r}.")
    if img_sigma is None and img_cov is None:
        raise ValueCheckError("pose_covariance needs the noise of the pixels: img_sigma or img_cov.")
    world_sigma = 0.0 if world_sigma is None and world_cov is None else world_sigma
    noise = checked_noise(world_points.double(), img_sigma, world_sigma, img_cov, world_cov)
    assert noise is not None
    points, rotation, camera = world_points.double(), pose.rotation.double(), camera.double()
    inlier = torch.ones_like(noise.img) if weights is None else _inlier_probability(weights.double())

    # Coordinates in which the matrix is well conditioned: centroid 0, spread 1, focal length 1.
    centroid = points.mean(1, keepdim=True)  # (B, 1, 3)
    offsets = points - centroid
    mean_square = offsets.square().sum(-1).mean(1, keepdim=True)  # (B, 1)
    spread = torch.where(mean_square > 0, mean_square, 1.0).sqrt()
    rotated_centroid = (rotation @ centroid.mT)[..., 0]  # (B, 3)
    centred_pose = Pose(rotation, (pose.translation.double() + rotated_centroid) / spread)
    rays = normalize_points_with_intrinsics(img_points.double(), camera.expand(batch, 3, 3))
    mean_focal = camera.diagonal(dim1=-2, dim2=-1)[..., :2].log().mean(-1).exp().reshape(-1, 1)  # (B or 1, 1)
    one = torch.ones_like(spread[:, 0])
    problem = Problem.of(offsets / spread[..., None], rays, weights=inlier)
    state = State(centred_pose, one.new_zeros(batch, 0 if focal == "known" else 1))

    projection = project(state, problem)
    sound = [(are_semi_definite(x) | (inlier == 0)).all(1) for x in noise.covariances]
    noise = _in_unit_frame(noise, camera, mean_focal, spread, inlier != 0)
    pair_weights = map_tensors(lambda x: inlier * x, pixel_precision(projection, problem, noise))
    equations = normal_equations(projection, problem, pair_weights)
    if focal_sigma is not None:
        check_positive(focal_sigma=focal_sigma)
        term = CameraTerm(one, one * focal_sigma**-2, one, one)
        equations = add_term(equations, term.linearise(state), problem.focal)
    if prior is not None:
        framed, usable = PoseTerm.of(map_tensors(torch.Tensor.double, prior), centroid[:, 0], spread[:, 0].reciprocal())
        sound.append(usable)
        equations = add_term(equations, framed.linearise(state), problem.focal)
    information = equations.matrix.permute(2, 0, 1)
    size = information.shape[-1]
    eye = torch.eye(size, dtype=information.dtype, device=information.device)
    with torch.no_grad():
        unit = information.diagonal(dim1=1, dim2=2).rsqrt()
        correlation = unit[:, :, None] * information * unit[:, None]
        is_definite = torch.linalg.cholesky_ex(correlation - _LEAST_EIGENVALUE * eye).info == 0
        determined = torch.stack((is_definite, correlation.isfinite().all((1, 2)), *sound)).all(0)[:, None, None]
    inverse = torch.linalg.inv_ex(torch.where(determined, information, eye)).inverse

    # Back to the given coordinates: omega stays, v = spread * v_centred + (R centroid) x omega.
    back = eye.repeat(batch, 1, 1)
    back[:, 3:6, :3] = So3.hat(rotated_centroid)
    back[:, 3:6, 3:6] *= spread[..., None]
    if size == 7:  # the depth of the centroid grows with the focal length, see `moved`
        back[:, 5, 6] = pose.translation[:, 2].double() + rotated_centroid[:, 2]
    covariance = back @ torch.where(determined, inverse, 0.0) @ back.mT
    return torch.where(determined, covariance, torch.where(eye > 0, torch.inf, 0.0)).to(dtype)


def _inlier_probability(weights: Tensor) -> Tensor:
    """Robust weights of inliers vary around their mean: this mean, as the inliers weigh it, and more count as 1."""
    total = weights.sum(-1, keepdim=True)
    mean = weights.square().sum(-1, keepdim=True) / torch.where(total > 0, total, 1.0)
    return (weights / torch.where(mean > 0, mean, 1.0)).clamp(max=1.0)


def _in_unit_frame(noise: Noise, camera: Tensor, mean_focal: Tensor, spread: Tensor, used: Tensor) -> Noise:
    """Noise in units of focal length and spread; covariances of pairs that are not ``used``, bool (B, N), are 0."""
    img_cov, world_cov = map_tensors(lambda x: torch.where(used, x, 0.0), (noise.img_cov, noise.world_cov))
    if img_cov is not None:
        fx, fy, skew = (camera[..., i, j].reshape(-1, 1) for i, j in ((0, 0), (1, 1), (0, 1)))
        img_cov = img_cov.mapped(1.0 / fx, -skew / (fx * fy), 1.0 / fy).at_least(LEAST_NOISE**2)
    if world_cov is not None:
        world_cov = world_cov.scaled(spread.square().reciprocal())
    return Noise(noise.img / mean_focal, noise.world / spread, img_cov, world_cov)
