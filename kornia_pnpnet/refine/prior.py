r"""What is known of a pose before any pair is looked at: a Gaussian on its tangent, with a robust kernel."""

from __future__ import annotations

import math

import torch
from kornia.core.check import KORNIA_CHECK, KORNIA_CHECK_SHAPE
from kornia.geometry.liegroup import So3
from torch import Tensor
from torch.nn import functional

from kornia_pnpnet.core.performance import compiling
from kornia_pnpnet.geometry import NormalEquations
from kornia_pnpnet.types import FramedPrior, FreeFocal, Pose, PosePrior

__all__ = [
    "add_focal_prior",
    "add_prior",
    "add_radial_prior",
    "focal_loss",
    "gravity_prior",
    "prior_errors",
    "prior_in_frame",
    "prior_loss",
    "recentred",
    "votes",
]

# Eigenvalues of an information below this share count as 0: nothing is known in that direction.
_KNOWN = 1e-5
# Standard deviations: scale of the robust kernel unless the caller gave one.
_SCALE = 3.0
# Rotations further off count as this far (1 + the cosine of the angle).
_LEAST_DENOMINATOR = 1e-4
# Standard deviation of a coefficient of radial distortion before any pair is looked at; it keeps those that no pair
# determines near 0.
_RADIAL = 0.15
# Matrices whose eigenvalues a graphics processor finds at once.
_MOST_MATRICES = 10_000


def gravity_prior(world_down: Tensor, cam_down: Tensor, sigma: Tensor | float) -> PosePrior:
    r"""A prior of where gravity points, as an accelerometer tells it; it says nothing of heading and position.

    Args:
        world_down: direction of gravity in the world, of any length but 0, shape :math:`(B, 3)`.
        cam_down: the same direction in the camera's axes (+z forward), as measured, shape :math:`(B, 3)`.
        sigma: standard deviation of the measured direction about each axis across it, in radians, a number or
            :math:`(B,)`.

    Returns:
        The prior. The rotation of its pose is one of those that turn ``world_down`` to ``cam_down``. Gradients flow to
        the directions and to sigma.

    Raises:
        ShapeError: when the directions are not :math:`(B, 3)`.
        BaseError: when sigma is a number that is not positive.

    Example:
        >>> down = torch.tensor([[0.0, 0.0, -1.0]])  # the world's z axis points up
        >>> prior = gravity_prior(down, torch.tensor([[0.0, 1.0, 0.0]]), sigma=0.01)  # the camera is level
        >>> prior.information.diagonal(dim1=1, dim2=2).round()
        tensor([[10000.,     0., 10000.,     0.,     0.,     0.]])
    """
    KORNIA_CHECK_SHAPE(world_down, ["B", "3"])
    KORNIA_CHECK_SHAPE(cam_down, ["B", "3"])
    KORNIA_CHECK(isinstance(sigma, Tensor) or sigma > 0, f"sigma must be positive, got {sigma}.")
    a, b = (functional.normalize(x, dim=-1) for x in (world_down, cam_down))
    eye = torch.eye(3, dtype=b.dtype, device=b.device)
    # Half a turn about the middle of both directions; about any axis across them where they are opposite.
    across = torch.linalg.cross(a, eye[a.detach().abs().argmin(-1)])
    opposite = ((a + b).detach().square().sum(-1, keepdim=True)) < torch.finfo(b.dtype).eps
    middle = functional.normalize(torch.where(opposite, across, a + b), dim=-1)
    rotation = 2.0 * middle[:, :, None] * middle[:, None] - eye
    precision = torch.as_tensor(sigma, dtype=b.dtype, device=b.device).expand(b.shape[:1]).square().reciprocal()
    known = precision[:, None, None] * (eye - b[:, :, None] * b[:, None])
    information = functional.pad(known, (0, 3, 0, 3))
    return PosePrior(Pose(rotation, torch.zeros_like(b)), information)


def prior_in_frame(prior: PosePrior, centroid: Tensor, scale: Tensor, pixel: Tensor) -> tuple[FramedPrior, Tensor]:
    """Express a prior in the frame of normalised correspondences.

    Args:
        prior: in the world of the caller.
        centroid: the world point that became the origin, (B, 3).
        scale: factor of world lengths, (B,).
        pixel: length of the caller's pixel in those of the correspondences, (B,).

    Returns:
        The prior, and whether it is possible, bool (B,): finite, its information symmetric and positive semi-definite.
        An impossible prior says nothing.
    """
    usable = _is_usable(prior)
    eye = torch.eye(3, dtype=centroid.dtype, device=centroid.device)
    rotation = torch.where(usable[:, None, None], prior.pose.rotation, eye)
    translation = torch.where(usable[:, None], prior.pose.translation, 0.0)
    information = torch.where(usable[:, None, None], prior.information, 0.0)
    offset = centroid * scale[:, None]
    moved = translation * scale[:, None] + (rotation * offset[:, None]).sum(-1)
    lengths = torch.cat((torch.ones_like(centroid), scale.reciprocal()[:, None].expand(-1, 3)), -1)
    information = information * lengths[:, :, None] * lengths[:, None]
    rank = (_correlations(information)[0] > _KNOWN).sum(-1).to(centroid)
    widest = torch.full_like(scale, _SCALE) if prior.scale is None else torch.where(usable, prior.scale, _SCALE)
    sq_scale = 0.5 * widest.square() * rank.clamp(min=1.0)
    free = _open_axis(information[:, :3, :3])
    return FramedPrior(Pose(rotation, moved), information, offset, free, sq_scale, rank, pixel), usable


def recentred(prior: FramedPrior, centre: Tensor) -> FramedPrior:
    """The prior where a world point (B, 3) becomes the origin."""
    rotation, translation = prior.pose
    pose = Pose(rotation, translation + (rotation @ centre[..., None])[..., 0])
    return prior._replace(pose=pose, offset=prior.offset + centre)


def prior_errors(prior: FramedPrior, pose: Pose) -> tuple[Tensor, Tensor]:
    r"""The tangent vector from poses to the prior's pose, and its squared Mahalanobis length.

    Args:
        prior: the prior of :math:`B` problems.
        pose: poses, :math:`(B, 3, 3)` and :math:`(B, 3)`.

    Returns:
        :math:`(\omega, v)` of :func:`~kornia_pnpnet.geometry.retract`, :math:`(B, 6)`, where turns about an axis of
        which the prior knows nothing are left out; the squared length, :math:`(B,)`.
    """
    turn = prior.pose.rotation @ pose.rotation.mT
    # Where the information leaves turns about an axis open, the nearest of all poses that it allows.
    free = prior.free
    twice = So3.vee(turn - turn.mT)
    along = turn.detach().diagonal(dim1=-2, dim2=-1).sum(-1) - (free * (turn.detach() @ free[..., None])[..., 0]).sum(
        -1
    )
    around = -(free * twice.detach()).sum(-1)  # at the nearest pose the error has no derivative by this angle
    length = torch.hypot(along, around)
    sound = length > torch.finfo(length.dtype).eps
    length = torch.where(sound, length, 1.0)
    cosine, sine = torch.where(sound, along / length, 1.0), torch.where(sound, around / length, 0.0)
    axis = So3.hat(free.flatten(0, -2)).unflatten(0, free.shape[:-1])
    turn = turn + sine[..., None, None] * (axis @ turn) + (1.0 - cosine)[..., None, None] * (axis @ (axis @ turn))
    trace = turn.diagonal(dim1=-2, dim2=-1).sum(-1)
    omega = 2.0 * So3.vee(turn - turn.mT) / (1.0 + trace).clamp(min=_LEAST_DENOMINATOR)[..., None]
    shift = prior.pose.translation - pose.translation
    shift = shift + ((pose.rotation - prior.pose.rotation) * prior.offset[..., None, :]).sum(-1)
    error = torch.cat((omega, shift), -1)
    return error, ((prior.information * error[..., None, :]).sum(-1) * error).sum(-1)


def prior_loss(prior: FramedPrior, pose: Pose) -> Tensor:
    """Robust loss (Welsch) in squared standard deviations, (B,): at most the squared scale of the kernel."""
    square = prior_errors(prior, pose)[1]
    scale = torch.where(prior.sq_scale.isinf(), 1.0, prior.sq_scale)
    return torch.where(prior.sq_scale.isinf(), square, -scale * torch.expm1(-square / scale))


def votes(prior: FramedPrior, pose: Pose) -> Tensor:
    """Agreement with a pose in pairs: a prior of two known directions counts as one pair, (B,)."""
    scale = torch.where(prior.sq_scale.isinf(), _SCALE**2 * prior.rank.clamp(min=1.0), prior.sq_scale)
    return 0.5 * prior.rank * torch.exp(-prior_errors(prior, pose)[1] / scale)


def add_prior(
    equations: NormalEquations, prior: FramedPrior, pose: Pose, unit: Tensor, focal: Tensor
) -> NormalEquations:
    r"""Add the prior's term to normal equations.

    Args:
        equations: of the pairs at the pose, with the Jacobian divided by the focal length.
        prior: the prior.
        pose: the pose.
        unit: what a weight of 1 in the equations stands for, in inverse square pixels, (B,).
        focal: the focal length in pixels, a scalar or (B,).
    """
    error, square = prior_errors(prior, pose)
    half = 0.5 * error[:, :3]
    eye = torch.eye(3, dtype=error.dtype, device=error.device)
    turned = (pose.rotation * prior.offset[:, None]).sum(-1)
    rows = eye + So3.hat(half) + half[:, :, None] * half[:, None]
    jacobian = torch.cat(
        (
            torch.cat((-rows, torch.zeros_like(rows)), -1),
            torch.cat((-So3.hat(turned), -eye.expand_as(rows)), -1),
        ),
        1,
    )
    robust = torch.exp(-square / prior.sq_scale)
    weight = (robust / (unit * focal))[:, None]
    weighted = jacobian.mT @ prior.information
    matrix = (weight / focal[..., None])[..., None] * (weighted @ jacobian)
    gradient = weight * (weighted @ error[..., None])[..., 0]
    if len(equations.gradient) > 6:  # a zoom moves the camera along its axis, see `dolly_zoom`
        depth = pose.translation[:, 2, None]
        matrix = torch.cat((matrix, depth[..., None] * matrix[:, 5:6]), 1)
        matrix = torch.cat((matrix, depth[..., None] * matrix[:, :, 5:6]), 2)
        gradient = torch.cat((gradient, depth * gradient[:, 5:6]), 1)
    rows_of, slopes = [list(x) for x in equations.hessian], list(equations.gradient)
    for i, row in enumerate(rows_of[: gradient.shape[1]]):  # distortion, the parameters after these, has no part in it
        rows_of[i] = [x + matrix[:, i, j] for j, x in enumerate(row)]
        slopes[i] = slopes[i] + gradient[:, i]
    return NormalEquations(rows_of, slopes)


def add_focal_prior(equations: NormalEquations, free: FreeFocal, unit: Tensor, focal: Tensor) -> NormalEquations:
    """Add what is known of the focal length, the seventh parameter, to normal equations.

    Args:
        equations: See add_prior.
        free: what is known of the focal length.
        unit: See add_prior.
        focal: the focal length in pixels, (B,).
    """
    weight = free.information / (unit * focal)
    rows, slopes = [list(x) for x in equations.hessian], list(equations.gradient)
    rows[6][6] = rows[6][6] + weight / focal
    slopes[6] = slopes[6] + weight * (focal / free.expected).log()
    return NormalEquations(rows, slopes)


def add_radial_prior(equations: NormalEquations, coefficients: Tensor, unit: Tensor, focal: Tensor) -> NormalEquations:
    """Add to normal equations that coefficients of radial distortion, their parameters from the eighth on, are small.

    Args:
        equations: See add_prior.
        coefficients: shape (B, K).
        unit: See add_prior.
        focal: the focal length in pixels, a scalar or (B,).
    """
    weight = 1.0 / (_RADIAL**2 * unit * focal)
    rows, slopes = [list(x) for x in equations.hessian], list(equations.gradient)
    for k, coefficient in enumerate(coefficients.unbind(1), 7):
        rows[k][k] = rows[k][k] + weight / focal
        slopes[k] = slopes[k] + weight * coefficient
    return NormalEquations(rows, slopes)


def focal_loss(free: FreeFocal, focal: Tensor) -> Tensor:
    """Squared distance in standard deviations of a focal length (B,) from what is known of it, (B,)."""
    return free.information * (focal / free.expected).log().square()


def _is_usable(prior: PosePrior) -> Tensor:
    """Whether the numbers are finite and the information is symmetric and positive semi-definite, bool (B,)."""
    numbers = [prior.pose.rotation, prior.pose.translation, prior.information]
    limit = torch.finfo(prior.information.dtype).max ** 0.25
    fine = torch.stack([(x.detach().flatten(1).abs() < limit).all(1) for x in numbers]).all(0)
    if prior.scale is not None:
        fine = fine & (prior.scale > 0)
    known, symmetric = _correlations(torch.where(fine[:, None, None], prior.information.detach(), 0.0))
    return fine & symmetric & (known[:, 0] > -1e3 * torch.finfo(prior.information.dtype).eps)


def _open_axis(information: Tensor) -> Tensor:
    """The axis (B, 3) about which turns are open where both other axes are known, else 0."""
    eigenvalues = _eigenvalues(information.detach().double())
    least, middle, largest = eigenvalues.unbind(-1)
    is_open = (least < _KNOWN * largest) & (middle > _KNOWN * largest)
    # The columns of the adjugate are multiples of the axis; eigenvectors of equal eigenvalues have no derivative.
    scaled = information / torch.where(largest > 0, largest, 1.0).to(information)[:, None, None]
    first, second, third = scaled.unbind(1)
    pairs = ((second, third), (third, first), (first, second))
    products = torch.stack([torch.linalg.cross(a, b) for a, b in pairs], 1)  # (B, 3, 3)
    longest = products.detach().square().sum(-1).argmax(1)[:, None, None].expand(-1, 1, 3)
    axis = torch.where(is_open[:, None], products.gather(1, longest)[:, 0], 1.0)
    return torch.where(is_open[:, None], functional.normalize(axis, dim=-1), 0.0)


def _correlations(information: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues (B, 6), ascending, of an information scaled to a unit diagonal; whether it is symmetric, (B,)."""
    diagonal = information.detach().double().diagonal(dim1=1, dim2=2)
    size = torch.where(diagonal > 0, diagonal, 1.0).rsqrt()
    scaled = information.detach().double() * size[:, :, None] * size[:, None]
    scaled = scaled.nan_to_num(math.inf)
    off = (scaled - scaled.mT).abs().amax((1, 2))
    bounded = torch.where(scaled.isfinite().all((1, 2))[:, None, None], scaled, 0.0)
    return _eigenvalues(bounded), off < 1e-3


def _eigenvalues(matrix: Tensor) -> Tensor:
    """Eigenvalues of symmetric matrices, ascending. cuSOLVER fails for a hundred thousand of them at once."""
    whole = matrix.device.type == "cpu" or compiling()
    return torch.cat([torch.linalg.eigvalsh(part) for part in ([matrix] if whole else matrix.split(_MOST_MATRICES))])
