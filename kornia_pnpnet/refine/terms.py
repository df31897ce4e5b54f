"""Priors of the pose and of the camera. Each prior is a :class:`~kornia_pnpnet.problem.Term`.

To add a prior, write a class with the methods of ``Term``. ``PnPNet._propose`` puts the instances into
``Problem.pose_terms``. The page "Method" of the documentation lists the other places.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from kornia.geometry.liegroup import So3
from torch import Tensor
from torch.nn import functional

from kornia_pnpnet.core.checks import Shapes, check_devices, check_form, check_positive, check_shapes, common_dtype
from kornia_pnpnet.core.linalg import half_turn, relative
from kornia_pnpnet.core.performance import compiling, full_precision
from kornia_pnpnet.problem import Linear, State
from kornia_pnpnet.refine.residual import NormalEquations, tangent
from kornia_pnpnet.result import Pose, PosePrior, sound_pose

__all__ = ["CameraTerm", "PoseTerm", "add_term", "gravity_prior"]

# An eigenvalue of a matrix with a unit diagonal counts as 0 if it is below this number. An eigenvalue of any other
# information matrix counts as 0 if its ratio to the largest eigenvalue is below this number.
_KNOWN = 1e-5
# Squared errors are clipped at this multiple of the kernel's squared scale. At this bound, the weight is about 0.
_LARGEST_RATIO = 100.0
# Default scale of the robust kernel, in standard deviations.
_SCALE = 3.0
# Prior standard deviation of a coefficient of radial distortion. The prior keeps a coefficient close to 0 if the pairs
# do not determine the coefficient.
RADIAL = 0.15
# Largest number of matrices in one call of cuSOLVER. A call with a hundred thousand matrices fails.
_MOST_MATRICES = 10_000


@full_precision
def gravity_prior(world_down: Tensor, cam_down: Tensor, sigma: Tensor | float) -> PosePrior:
    """Make a prior from a measured direction of gravity, for example from an accelerometer.

    The prior has no information about heading and position. The rotation of the prior's pose maps ``world_down`` to
    ``cam_down`` with an arbitrary heading. Gradients flow to all arguments.

    Args:
        world_down: direction of gravity in the world, of any non-zero length, shape :math:`(B, 3)`. :math:`B` stands
            for any number of leading dimensions, including none.
        cam_down: measured direction of gravity in the camera's axes (+z forward), of the same shape as ``world_down``.
        sigma: standard deviation of the measured direction about each perpendicular axis, in radians. A number, or a
            tensor of shape :math:`()` or :math:`(B,)`.

    Raises:
        BaseError: when the directions are not :math:`(B, 3)`, or sigma is neither a positive number nor a tensor of
            shape :math:`()` or :math:`(B,)`.

    Example:
        >>> down = torch.tensor([[0.0, 0.0, -1.0]])  # the world's z axis points up
        >>> prior = gravity_prior(down, torch.tensor([[0.0, 1.0, 0.0]]), sigma=0.01)  # the camera is level
        >>> prior.information.diagonal(dim1=1, dim2=2).round()
        tensor([[10000.,     0., 10000.,     0.,     0.,     0.]])
    """
    check_form(["*", "3"], world_down=world_down)
    shapes: Shapes = {"cam_down": (cam_down, tuple(world_down.shape))}
    if isinstance(sigma, Tensor):
        shapes["sigma"] = sigma, tuple(world_down.shape[:-1]) if sigma.ndim else ()
    else:
        check_positive(or_infinite=True, sigma=sigma)
    check_shapes(shapes)
    tensors = {"world_down": world_down, **{name: x for name, (x, _) in shapes.items()}}
    check_devices(tensors, world_down, "world_down")
    dtype = common_dtype(tensors)
    directions = (relative(x.to(dtype), x.to(dtype).detach().abs()) for x in (world_down, cam_down))
    a, b = (functional.normalize(x, dim=-1) for x in directions)
    eye = torch.eye(3, dtype=b.dtype, device=b.device)
    # The rotation is half a turn about the bisector of both directions. For opposite directions, which have no
    # bisector, the rotation is half a turn about a perpendicular axis.
    least = a.detach().abs().argmin(-1, keepdim=True)
    across = torch.linalg.cross(a, torch.zeros_like(a).scatter(-1, least, 1.0))
    opposite = ((a + b).detach().square().sum(-1, keepdim=True)) < torch.finfo(b.dtype).eps
    rotation = half_turn(torch.where(opposite, across, a + b))
    precision = torch.as_tensor(sigma, dtype=b.dtype, device=b.device).expand(b.shape[:-1]).square().reciprocal()
    # I - b b^T as a product. If b is almost parallel to an axis, rounding makes the difference indefinite.
    turned = torch.linalg.cross(b[..., None, :], eye.expand(*b.shape, 3))
    known = precision[..., None, None] * (turned @ turned.mT)
    information = functional.pad(known, (0, 3, 0, 3))
    return PosePrior(Pose(rotation, torch.zeros_like(b)), information)


def add_term(equations: NormalEquations, linear: Linear, focal: Tensor) -> NormalEquations:
    """Add a term, linearised at the same state, to the normal equations. ``focal`` is a scalar or (B,)."""
    weighted = torch.bmm(linear.jacobian.mT, linear.information)  # (B, 6 + K, D)
    weight = linear.weight / (focal if equations.unit is None else equations.unit[:, 0] * focal)
    matrix = torch.bmm(weighted, linear.jacobian).permute(1, 2, 0) * (weight / focal)
    gradient = torch.bmm(weighted, linear.residual[..., None])[..., 0].mT * weight
    return equations._replace(matrix=equations.matrix + matrix, gradient=equations.gradient + gradient)


class CameraTerm(NamedTuple):
    """A prior of an unknown focal length, in the problem's pixels, and of radial distortion.

    Attributes:
        expected: the focal length that the caller expects, in pixels, shape :math:`(B,)`.
        information: inverse variance of the logarithm of the focal length, shape :math:`(B,)`; ``None``: there is no
            prior of the camera.
        width: half the width of the search interval around the logarithm of ``focal``, shape :math:`(B,)`.
        focal: the focal length of the problem in pixels, shape :math:`(B,)`.
    """

    expected: Tensor
    information: Tensor | None
    width: Tensor
    focal: Tensor

    def scaled(self, pixels: Tensor) -> CameraTerm:
        """Convert the focal lengths to other pixels, given the number (B,) of new pixels per old pixel."""
        return self._replace(expected=self.expected * pixels, focal=self.focal * pixels)

    def linearise(self, state: State) -> Linear:
        """The residual holds log f minus the expected log f, and then the coefficients of radial distortion."""
        assert self.information is not None
        batch, count = state.camera.shape
        offset = (self.focal / self.expected).log()
        residual = torch.cat((state.zoom + offset[:, None], state.radial), 1)
        eye = torch.eye(count, dtype=residual.dtype, device=residual.device).expand(batch, count, count)
        known = torch.cat((self.information[:, None], torch.full_like(state.radial, RADIAL**-2)), 1)
        return Linear(residual, functional.pad(eye, (6, 0)), eye * known[:, None], torch.ones_like(offset))

    def loss(self, state: State) -> Tensor:
        """Squared Mahalanobis length of the residual, (B,)."""
        linear = self.linearise(state)
        return (linear.information.diagonal(dim1=1, dim2=2) * linear.residual.square()).sum(1)

    def disagreement(self, pose: Pose) -> Tensor:
        """See :class:`~kornia_pnpnet.problem.Term`. A prior of the camera penalises no pose."""
        return torch.zeros_like(pose.translation[..., 0])


class PoseTerm(NamedTuple):
    """A :class:`~kornia_pnpnet.result.PosePrior` in the frame of a problem.

    Attributes:
        pose: the expected pose.
        information: inverse covariance of the pose, shape :math:`(B, 6, 6)`.
        offset: the position of the problem's origin in the caller's world, in the unit of the problem, shape
            :math:`(B, 3)`. Translation errors are errors at the origin of the caller's world.
        free: the only axis in the camera frame about which the rotation is unknown, or 0, shape :math:`(B, 3)`.
        sq_scale: squared scale of the robust kernel, in squared standard deviations, shape :math:`(B,)`.
        rank: number of directions in which the prior has information, shape :math:`(B,)`.
    """

    pose: Pose
    information: Tensor
    offset: Tensor
    free: Tensor
    sq_scale: Tensor
    rank: Tensor

    @classmethod
    def of(cls, prior: PosePrior, centroid: Tensor, size: Tensor) -> tuple[PoseTerm, Tensor]:
        """Express a prior in the frame of a problem, given ``centroid`` and ``size`` of the problem's ``Frame``.

        The second result tells which priors are usable, bool (B,). A prior is usable if its numbers are in range, and
        its information is positive semi-definite. The information of an unusable prior becomes 0.
        """
        lengths = torch.cat((torch.ones_like(centroid), size[:, None].expand(-1, 3)), -1)
        information = prior.information * lengths[:, :, None] * lengths[:, None]
        limits = torch.finfo(size.dtype)
        limit = limits.max**0.25
        numbers = [prior.pose.rotation, prior.pose.translation / size[:, None], information]
        usable = torch.stack([(x.detach().flatten(1).abs() < limit).all(1) for x in numbers]).all(0)
        if prior.scale is not None:
            usable = usable & (prior.scale > 1.0 / limit)
        known, symmetric = _correlations(torch.where(usable[:, None, None], prior.information, 0.0))
        usable = usable & symmetric & (known[:, 0] > -1e3 * torch.finfo(torch.float32).eps)
        rank = (usable[:, None] & (known > _KNOWN)).sum(-1).to(size)
        information = torch.where(usable[:, None, None], prior.information, 0.0)
        information = information * lengths[:, :, None] * lengths[:, None]
        rotation, translation = sound_pose(prior.pose, usable)
        offset = centroid / size[:, None]
        pose = Pose(rotation, translation / size[:, None] + (rotation * offset[:, None]).sum(-1))
        widest = torch.full_like(size, _SCALE) if prior.scale is None else torch.where(usable, prior.scale, _SCALE)
        widest = torch.where(widest < limit, widest, torch.inf)  # an infinite scale has no gradient
        sq_scale = 0.5 * widest.square() * rank.clamp(min=1.0)
        return cls(pose, information, offset, _open_axis(information[:, :3, :3]), sq_scale, rank), usable

    def errors(self, pose: Pose) -> tuple[Tensor, Tensor]:
        """The tangent vector (B, 6) from a pose to the prior (see ``retract``), and the squared Mahalanobis length.

        The vector has no rotation about ``free``. The translation is the error at the origin of the caller's world.
        """
        turn = self.pose.rotation @ pose.rotation.mT
        # Rotate the prior's pose about the free axis, as close to the given pose as possible.
        free = self.free
        along = turn.diagonal(dim1=-2, dim2=-1).sum(-1) - (free * (turn @ free[..., None])[..., 0]).sum(-1)
        around = -(free * So3.vee(turn - turn.mT)).sum(-1)
        sound = torch.hypot(along.detach(), around.detach()) > torch.finfo(along.dtype).eps
        along, around = torch.where(sound, along, 1.0), torch.where(sound, around, 0.0)
        length = torch.hypot(along, around)  # not 0, where its gradient would be NaN
        cosine, sine = along / length, around / length
        axis = So3.hat(free.flatten(0, -2)).unflatten(0, free.shape[:-1])
        turn = turn + sine[..., None, None] * (axis @ turn) + (1.0 - cosine)[..., None, None] * (axis @ (axis @ turn))
        shift = self.pose.translation - pose.translation
        shift = shift + ((pose.rotation - self.pose.rotation) * self.offset[..., None, :]).sum(-1)
        error = torch.cat((tangent(turn), shift), -1)
        return error, ((self.information * error[..., None, :]).sum(-1) * error).sum(-1)

    def linearise(self, state: State) -> Linear:
        """See :class:`~kornia_pnpnet.problem.Term`. The residual is the tangent vector of :meth:`errors`."""
        error, square = self.errors(state.pose)
        half = 0.5 * error[:, :3]
        eye = torch.eye(3, dtype=error.dtype, device=error.device)
        turned = (state.pose.rotation * self.offset[:, None]).sum(-1)
        rows = eye + So3.hat(half) + half[:, :, None] * half[:, None]
        # If the state rotates, the closest pose of the prior also rotates about the free axis.
        follows = self.free - torch.linalg.cross(half, self.free)
        rows = rows - follows[:, :, None] * (self.free[:, None] @ rows)
        by_turn = torch.cat((-rows, -So3.hat(turned)), 1)
        by_shift = torch.cat((torch.zeros_like(rows), -eye.expand_as(rows)), 1)
        columns = [by_turn, by_shift]
        if state.camera.shape[1]:  # a new focal length also moves the camera, see `moved`
            columns += [state.pose.translation[:, 2:, None] * by_shift[..., 2:]]
            columns += [torch.zeros_like(state.radial)[:, None].expand(-1, 6, -1)]
        return Linear(error, torch.cat(columns, 2), self.information, torch.exp(-self._ratio(square)))

    def loss(self, state: State) -> Tensor:
        """Welsch loss (B,) in squared standard deviations. The loss is at most ``sq_scale``."""
        square = self.errors(state.pose)[1]
        scale = torch.where(self.sq_scale.isinf(), 1.0, self.sq_scale)
        return torch.where(self.sq_scale.isinf(), square, -scale * torch.expm1(-self._ratio(square)))

    def _ratio(self, square: Tensor) -> Tensor:
        """Squared errors divided by the squared scale. A bound keeps derivatives of the exponential finite."""
        return torch.minimum(square, _LARGEST_RATIO * self.sq_scale) / self.sq_scale

    def disagreement(self, pose: Pose) -> Tensor:
        """See :class:`~kornia_pnpnet.problem.Term`. The penalty is at most half of ``rank``."""
        scale = torch.where(self.sq_scale.isinf(), _SCALE**2 * self.rank.clamp(min=1.0), self.sq_scale)
        return -0.5 * self.rank * torch.expm1(-self.errors(pose)[1] / scale)


def _open_axis(information: Tensor) -> Tensor:
    """The axis (B, 3) about which the rotation is unknown; 0 unless exactly one such axis exists."""
    eigenvalues = _eigenvalues(information.detach().double())
    least, middle, largest = eigenvalues.unbind(-1)
    is_open = (least < _KNOWN * largest) & (middle > _KNOWN * largest)
    # The columns of the adjugate are multiples of the axis. Eigenvectors would have no derivative at equal eigenvalues.
    scaled = information / torch.where(largest > 0, largest, 1.0).to(information)[:, None, None]
    first, second, third = scaled.unbind(1)
    pairs = ((second, third), (third, first), (first, second))
    products = torch.stack([torch.linalg.cross(a, b) for a, b in pairs], 1)  # (B, 3, 3)
    longest = products.detach().square().sum(-1).argmax(1)[:, None, None].expand(-1, 1, 3)
    axis = torch.where(is_open[:, None], products.gather(1, longest)[:, 0], 1.0)
    return torch.where(is_open[:, None], functional.normalize(axis, dim=-1), 0.0)


def _correlations(information: Tensor) -> tuple[Tensor, Tensor]:
    """Ascending eigenvalues (B, 6) after scaling to a unit diagonal, and whether each matrix is symmetric, (B,).

    A row whose diagonal entry is 0 gets the scale of the largest diagonal entry with the same unit, so that rounding
    errors stay small. If all diagonal entries with the same unit are 0, a non-zero row makes the prior unusable.
    """
    information = information.detach().double()
    diagonal = information.diagonal(dim1=1, dim2=2)
    largest = diagonal.unflatten(1, (2, 3)).amax(-1, keepdim=True).expand(-1, -1, 3).flatten(1)
    size = torch.where(diagonal > 0, diagonal, largest).rsqrt()
    scaled = torch.where(information == 0, 0.0, information * size[:, :, None] * size[:, None])
    scaled = scaled.nan_to_num(math.inf)
    off = (scaled - scaled.mT).abs().amax((1, 2))
    bounded = torch.where(scaled.isfinite().all((1, 2))[:, None, None], scaled, 0.0)
    return _eigenvalues(bounded), off < 1e-3


def _eigenvalues(matrix: Tensor) -> Tensor:
    whole = matrix.device.type == "cpu" or compiling()
    return torch.cat([torch.linalg.eigvalsh(part) for part in ([matrix] if whole else matrix.split(_MOST_MATRICES))])
