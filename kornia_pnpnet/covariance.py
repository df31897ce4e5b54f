"""Compute the covariance of a pose from the noise of the correspondences."""

from __future__ import annotations

import math
from typing import Any

import torch
from kornia.core.exceptions import ValueCheckError
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.liegroup import So3
from torch import Tensor

from kornia_pnpnet.arguments import checked_inputs, restore_leading
from kornia_pnpnet.cameras import zoomed
from kornia_pnpnet.core.checks import check_positive
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.frame import Normalize
from kornia_pnpnet.problem import MIN_PAIRS, Noise, State
from kornia_pnpnet.refine.residual import information, normal_equations, pixel_covariance, project
from kornia_pnpnet.refine.terms import CameraTerm, PoseTerm, add_term
from kornia_pnpnet.result import Pose, PosePrior, sound_pose

__all__ = ["pose_covariance", "shown_noise"]

# An information matrix with a unit diagonal is regular if its least eigenvalue exceeds this number. Smaller eigenvalues
# are rounding errors of float64.
_LEAST_EIGENVALUE = 1e-13
# The given focal length may differ by at most this factor from the focal length that fits the pixels at the pose. A
# larger factor shows that the caller passed the intrinsics of the solver's call instead of the estimated intrinsics.
_FOCAL_RATIO = 1.5
# Iterations for the noise of the pixels beside known noise of the points.
_ROUNDS = 10
# `shown_noise` tries these shares of pixel noise in the mean variance of a pixel. The points' noise causes the rest.
_SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)


def pose_covariance(
    pose: Pose,
    world_points: Tensor,
    img_points: Tensor,
    intrinsics: Tensor | PinholeCamera | None,
    *,
    img_sigma: Tensor | float | None = None,
    world_sigma: Tensor | float | None = None,
    img_cov: Tensor | None = None,
    world_cov: Tensor | None = None,
    weights: Tensor | None = None,
    prior: PosePrior | None = None,
    focal: str = "known",
    focal_sigma: float | None = None,
    dist: Tensor | None = None,
    fisheye: Tensor | None = None,
    cam_from_rig: Pose | None = None,
) -> Tensor:
    r"""Compute the first-order covariance of a pose that was found by weighted least squares.

    The covariance is :math:`(\sum_i w_i J_i^\top \Sigma_i^{-1} J_i)^{-1}`. :math:`J_i` is the derivative of pixel
    :math:`i` with respect to the tangent vector :math:`(\omega, v)` of :func:`~kornia_pnpnet.refine.residual.retract`.
    If :math:`(R, t)` is the true pose, the estimated pose is :math:`(\mathrm{cay}(\omega) R,\; t + v)` with the Cayley
    transform cay. :math:`\Sigma_i` is the covariance of the pixel, see
    :func:`~kornia_pnpnet.refine.residual.pixel_covariance`. The sums run in float64. Gradients flow to all arguments.
    But the effect of a lens on the noise counts as constant. With a known focal length, ``dist`` and ``fisheye``
    therefore have no gradient.

    A robust kernel gives most inliers a weight :math:`u_i` below 1. An M-estimate is nevertheless almost as accurate as
    least squares on the inliers (P. Huber, "Robust Statistics", 1981). The weights are therefore divided by their mean
    over the inliers, :math:`\bar u = \sum_i u_i^2 / \sum_i u_i`, and limited to 1: :math:`w_i = \min(1, u_i / \bar u)`.

    Args:
        pose: the estimated world-to-camera pose, rotation :math:`(B, 3, 3)` and translation :math:`(B, 3)`.
        world_points: see :meth:`PnPNet.forward <kornia_pnpnet.solver.PnPNet.forward>`, also for dimensions and dtypes.
        img_points: pixels or bearings; see ``PnPNet.forward``.
        intrinsics: see ``PnPNet.forward``.
        img_sigma: see ``PnPNet.forward``; required if ``img_cov`` is ``None``.
        world_sigma: see ``PnPNet.forward``. If ``world_sigma`` and ``world_cov`` are ``None``, world points are exact.
        img_cov: see ``PnPNet.forward``.
        world_cov: see ``PnPNet.forward``.
        weights: weight of each pair, 0 for outliers, shape :math:`(B, N)`, such as ``result.inliers.double()``.
            ``None``: 1 for every pair.
        prior: the prior of the solver's call. The prior's information, times the prior's robust weight at the pose, is
            added to the information of the pairs.
        focal: ``"unknown"`` if the solver estimated the focal length, else ``"known"``. With ``"unknown"``, pass the
            ``intrinsics`` of the result, not the ``intrinsics`` of the solver's call.
        focal_sigma: the solver's ``focal_sigma``, a prior whose information is added to the information of the pairs.
        dist: see ``PnPNet.forward``. The coefficients are taken as exact, also when the solver estimated them.
        fisheye: see ``PnPNet.forward``.
        cam_from_rig: see ``PnPNet.forward``. The covariance is that of the pose of the rig.

    Returns:
        The covariance in radians and the unit of the world, shape :math:`(B, 6, 6)`, with the dtype of a solver's
        result. With an unknown focal length the shape is :math:`(B, 7, 7)`, and the last row and column belong to the
        logarithm of the focal length. If the pairs do not determine the pose, or a solver would refuse the problem, the
        diagonal is infinite and all other entries are 0. The same holds with ``focal="unknown"`` if the given focal
        length differs by more than a factor of 1.5 from the focal length that fits the pixels at the pose.

    Raises:
        BaseError: see ``PnPNet.forward``; also if the noise of the pixels is missing, if ``focal`` is neither
            ``"known"`` nor ``"unknown"``, if ``focal_sigma`` is given for a known focal length, or if the focal length
            of a rig or of bearings is unknown.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> p = SyntheticProblems(n=50, batch_size=2, seed=0).batch(0)
        >>> noise = {"img_sigma": 1.0, "world_sigma": 0.05}
        >>> pose_covariance(p.pose, p.world_points, p.img_points, p.intrinsics, **noise).shape
        torch.Size([2, 6, 6])
    """
    if focal not in ("known", "unknown") or (focal == "known" and focal_sigma is not None):
        raise ValueCheckError(f"focal must be 'known', or 'unknown' with or without focal_sigma, got {focal!r}.")
    if img_sigma is None and img_cov is None:
        raise ValueCheckError("pose_covariance needs the noise of the pixels: img_sigma or img_cov.")
    size, inputs = checked_inputs(
        *(world_points, img_points, intrinsics, weights, None, pose),
        img_sigma=img_sigma,
        world_sigma=0.0 if world_sigma is None and world_cov is None else world_sigma,
        img_cov=img_cov,
        world_cov=world_cov,
        prior=prior,
        dist=dist,
        fisheye=fisheye,
        cam_from_rig=cam_from_rig,
        init_name="pose",
    )
    if focal == "unknown" and inputs.rig is not None:
        raise ValueCheckError("focal='unknown' takes pixels of one camera.")
    dtype, inputs = inputs.world_points.dtype, map_tensors(_double, inputs)
    # The information matrix is well conditioned if the points have the centroid 0 and the spread 1.
    problem, frame = Normalize(order=False)(*inputs[:5], inputs.noise, None, inputs.rig)
    assert inputs.init is not None
    assert problem.noise is not None
    framed_pose, posed = frame.start(inputs.init)
    pose = sound_pose(inputs.init, posed)
    size_of_camera = 0 if focal == "known" else 1
    count = problem.weights.shape[0]
    state = State(framed_pose, problem.weights.new_zeros(count, size_of_camera))
    projection = project(state, problem)
    if size_of_camera and (dist is not None or fisheye is not None):
        lens = map_tensors(lambda x: x.double().expand(*size, -1).reshape(count, x.shape[-1]), (dist, fisheye))
        added = zoomed(projection.plane.permute(2, 1, 0), *lens).permute(2, 1, 0) - projection.plane
        projection = projection._replace(lens=added * (projection.rotated[2] + framed_pose.translation[:, 2]))
    total = problem.weights.sum(-1, keepdim=True)
    mean = problem.weights.square().sum(-1, keepdim=True) / torch.where(total > 0, total, 1.0)
    inlier = (problem.weights / torch.where(mean > 0, mean, 1.0)).clamp(max=1.0)
    known = ((problem.noise.img + problem.noise.world).isfinite() | (problem.weights == 0)).all(1)
    noise = map_tensors(lambda x: x.nan_to_num(0.0), problem.noise).bounded(problem.focal)
    precision = information(projection, problem._replace(noise=noise))[1]
    precision = map_tensors(lambda x: inlier * x, precision)
    equations, determined = normal_equations(projection, problem, precision), posed & known
    if size_of_camera:
        plane, pixels = projection.plane, problem.img_points.permute(2, 1, 0) / problem.focal
        ratio = (plane * pixels).sum(0) / plane.square().sum(0)  # (N, B); NaN behind the camera
        ratio = torch.where(problem.weights.mT > 0, ratio, torch.nan).detach().nanmedian(0).values
        determined = determined & (ratio.log().abs() < math.log(_FOCAL_RATIO))
    if focal_sigma is not None:
        check_positive(focal_sigma=focal_sigma)
        one = torch.ones_like(frame.size)
        term = CameraTerm(one, one * focal_sigma**-2, one, one)
        equations = add_term(equations, term.linearise(state), problem.focal)
    if inputs.prior is not None:
        framed, usable = PoseTerm.of(inputs.prior, frame.centroid, frame.size)
        equations, determined = add_term(equations, framed.linearise(state), problem.focal), determined & usable
    matrix = equations.matrix.permute(2, 0, 1) * problem.focal.square()
    eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    with torch.no_grad():
        unit = matrix.diagonal(dim1=1, dim2=2).rsqrt()
        correlation = unit[:, :, None] * matrix * unit[:, None]
        is_definite = torch.linalg.cholesky_ex(correlation - _LEAST_EIGENVALUE * eye).info == 0
        determined = (determined & is_definite & correlation.isfinite().all((1, 2)))[:, None, None]
    inverse = torch.linalg.inv_ex(torch.where(determined, matrix, eye)).inverse

    # Convert to the caller's world: omega stays the same, and v = size * v_framed + (R centroid) x omega.
    rotated_centroid = (pose.rotation @ frame.centroid[..., None])[..., 0]
    shift = torch.cat((So3.hat(rotated_centroid), frame.size[:, None, None] * eye[:3, :3]), -1)
    if size_of_camera:  # the depth of the centroid grows with the focal length, see `refine.residual.moved`
        depth = pose.translation[:, 2] + rotated_centroid[:, 2]
        shift = torch.cat((shift, depth[:, None, None] * eye[2:3, :3].mT), -1)
    first, last = (eye[rows].expand(count, -1, -1) for rows in (slice(3), slice(6, None)))
    back = torch.cat((first, shift, last), 1)
    covariance = back @ torch.where(determined, inverse, 0.0) @ back.mT
    covariance = torch.where(determined, covariance, eye.masked_fill(eye > 0, torch.inf))
    return restore_leading(size, covariance.to(dtype))


@torch.no_grad()
def shown_noise(
    pose: Pose,
    world_points: Tensor,
    img_points: Tensor,
    intrinsics: Tensor | PinholeCamera | None,
    weights: Tensor | None,
    **more: Any,
) -> dict[str, Tensor]:
    """Estimate the noise of the pixels, and of the points unless it is known, from the residuals at a pose.

    At a larger depth, the noise of a point moves the point's pixel less. The noise of a pixel does not depend on the
    depth. Five mixtures of pixel noise and point noise are tried. The largest Gaussian likelihood selects one of them.
    Beside known noise of the points, the noise of the pixels with the largest likelihood is found by iterations.

    See :func:`pose_covariance` for the arguments. ``more`` has ``dist``, ``fisheye``, ``cam_from_rig``, and the known
    ``world_sigma`` or ``world_cov``. The returned dict has ``img_sigma`` and, if unknown, ``world_sigma``, shape (B,).
    """
    if not {"world_sigma", "world_cov"}.isdisjoint(more):
        more["img_sigma"] = 0.0
    size, inputs = checked_inputs(world_points, img_points, intrinsics, weights, None, pose, init_name="pose", **more)
    dtype, inputs = inputs.world_points.dtype, map_tensors(_double, inputs)
    problem, frame = Normalize(order=False)(*inputs[:5], inputs.noise, None, inputs.rig)
    projection = project(State.of(frame.start(inputs.init)[0]), problem)
    weights, exact = problem.weights, torch.zeros_like(problem.weights)
    total = weights.sum(1).clamp(min=MIN_PAIRS)
    unit = frame.units(problem.focal, inputs.lens_scale).expand_as(weights)
    # Variance of each pixel if only the caller's pixels have noise, of the standard deviation 1, or only the points, of
    # the standard deviation 1 or the known noise.
    moved = pixel_covariance(projection, problem, problem.noise or Noise(exact, torch.ones_like(exact)))
    of_pixels, of_points = unit.square(), torch.where(weights > 0, 0.5 * (moved.uu + moved.vv), 0.0)
    by_pixel, mean = ((weights * x).sum(1) / total for x in (of_pixels, of_points))
    freedom = (2.0 * total - 6.0).clamp(min=1.0)
    if problem.noise is not None:  # Fisher scoring towards the likeliest variance
        observed = projection.sq_residual * (total / freedom)[:, None]
        variance = (weights * observed).sum(1) / (total * by_pixel)
        least = 1e-6 * variance
        for _ in range(_ROUNDS):
            change = weights * of_pixels / (of_points + variance[:, None] * of_pixels).square().clamp(min=1e-200)
            variance = (change * (observed - of_points)).sum(1) / (change * of_pixels).sum(1)
            variance = variance.maximum(least)
        return {"img_sigma": restore_leading(size, variance.sqrt().to(dtype))}
    share = mean.new_tensor(_SHARES)[:, None]  # (S, 1)
    variance = share[..., None] * of_pixels / by_pixel[:, None]  # (S, B, N)
    variance = variance + (1.0 - share[..., None]) * of_points / mean[:, None]
    variance = torch.where(weights > 0, variance, 1.0)
    scale = (weights * projection.sq_residual / variance).sum(-1) / freedom  # (S, B)
    best = (total * scale.log() + (weights * variance.log()).sum(-1)).nan_to_num(torch.inf).argmin(0)
    share, scale = share[best, 0], scale.gather(0, best[None])[0]
    img, world = (share * scale / by_pixel).sqrt(), ((1.0 - share) * scale / mean).sqrt() * frame.size
    return {"img_sigma": restore_leading(size, img.to(dtype)), "world_sigma": restore_leading(size, world.to(dtype))}


def _double(x: Tensor) -> Tensor:
    return x.double() if x.is_floating_point() else x
