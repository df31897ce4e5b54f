r"""EPPnP and REPPnP: a pose from the null space of the projection equations. REPPnP also rejects outliers.

A pair gives two equations, :math:`X_i - u_i Z_i = 0` and :math:`Y_i - v_i Z_i = 0`. The left sides are the algebraic
errors. The unknowns are the camera coordinates of four control points (see :mod:`kornia_pnpnet.propose.epnp`). In an
array ``rows`` (B, K + 1, 2 N), the first K rows hold the derivatives of the errors with respect to K unknowns, and the
last row holds the errors. In each row, N entries for u precede N entries for v.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_whole
from kornia_pnpnet.core.linalg import align
from kornia_pnpnet.problem import Problem, Starts
from kornia_pnpnet.propose.epnp import ControlPoints, control_points
from kornia_pnpnet.propose.initialiser import Initialiser
from kornia_pnpnet.refine.residual import retract
from kornia_pnpnet.result import Pose

__all__ = ["REPPnP"]

# Number of iterations of outlier rejection, first with the null vector, then with the rigid motion.
_NULL_ITERATIONS, _RIGID_ITERATIONS = 3, 4
# Least numbers of pairs that outlier rejection keeps, first with the null vector, then with the rigid motion. 6 pairs
# determine the null vector, and 3 pairs determine the rigid motion.
_NULL_FLOOR, _RIGID_FLOOR = 7, 5
# A problem needs at least this number of pairs to be `ok`.
_MIN_PAIRS = 4
# Ridges on the depths of the control vectors during and after outlier rejection. In the final pose, a large ridge would
# suppress the small depths of a narrow view.
_DEPTH_PRIOR, _FINAL_DEPTH_PRIOR = 5e-3, 1e-5
# This number is added to (1 - leverage) of a pair, because the leverage can be 1.
_LEVERAGE_RIDGE = 1e-6


class REPPnP(Initialiser):
    r"""A pose from the null space of the projection equations, with outlier rejection by the algebraic error.

    Each iteration finds the null vector of the kept pairs, and then keeps pairs with algebraic errors of at most
    :math:`\max(Q, \delta_{\max})`. Here :math:`Q` is a quantile of the errors. The first iteration uses all pairs. The
    last null vector is aligned with the world by orthogonal Procrustes. Without rejection the method is EPPnP.

    Source: L. Ferraz, X. Binefa and F. Moreno-Noguer, "Very Fast Solution to the PnP Problem with Algebraic Outlier
    Rejection", CVPR 2014. Our changes raise the success rate or allow batches:

    - The null vector is scaled so that the centroid has depth 1. (In the paper, the vector has length 1.) The vector
      solves a linear system, and does not depend on the control points, the frame or the unit. To reduce the effect of
      outliers, a small ridge pulls all points toward the depth of the centroid.
    - Outliers are rejected by their leave-one-out error. The quantile is 50 % (paper: 25 %).
    - A second loop fits a rigid motion by Gauss-Newton on the algebraic error, and rejects outliers of this motion. The
      final pose minimises the algebraic error. The paper's loop alternates between a rigid motion and a combination of
      four null vectors.
    - Both loops have a fixed length. The paper's loop stops when the quantile no longer decreases.

    The selection of pairs has no gradient. The last Gauss-Newton steps start from a detached pose, and their gradient
    is the gradient of the minimum.

    Args:
        reject_outliers: whether outliers are rejected. If ``False``, all pairs are kept.
        max_error: :math:`\delta_{\max}`, divided by the root mean square radius of the world.
        quantile: smallest ratio of kept pairs to all pairs, in (0, 1].
        refine_iterations: number of Gauss-Newton steps after the last rejection, at least 1.

    Raises:
        BaseError: when an argument is out of range.

    Example:
        >>> from kornia_pnpnet import Normalize
        >>> from kornia_pnpnet.data import OutlierMix, SyntheticProblems
        >>> problems = SyntheticProblems(n=20, batch_size=2, seed=0, outliers=OutlierMix(count=5)).batch(0)
        >>> problem, _ = Normalize(order=False)(*problems[:3])
        >>> starts = REPPnP()(problem)
        >>> starts.ok, (starts.weights > 0).eq(problems.inliers).all()
        (tensor([True, True]), tensor(True))
    """

    def __init__(
        self,
        *,
        reject_outliers: bool = True,
        max_error: float = 0.03,
        quantile: float = 0.5,
        refine_iterations: int = 3,
    ) -> None:
        super().__init__(locals())
        KORNIA_CHECK(0.0 < quantile <= 1.0, f"quantile must lie in (0, 1], got {quantile}.")
        KORNIA_CHECK(type(reject_outliers) is bool, f"reject_outliers must be true or false, got {reject_outliers!r}.")
        check_numbers(0.0, max_error=max_error)
        check_whole(1, refine_iterations=refine_iterations)
        self.reject_outliers = reject_outliers
        self.max_error = max_error
        self.quantile = quantile
        self.refine_iterations = refine_iterations

    def forward(self, problem: Problem) -> Starts:
        """Find the pose and the inliers of a problem in the solver's frame.

        Returns:
            The pose, weights, and ``ok``. The weight is 1 for kept pairs and for unusual pairs (see ``Problem.usual``),
            and 0 for other pairs. A problem is not ``ok`` if it has fewer than 4 pairs, if its points lie on a line, if
            the equations do not determine a pose, or if the centroid of the points is behind the camera.
        """
        problem = problem._replace(weights=problem.usual_weights)
        with torch.no_grad():
            control = control_points(problem)
        centroid = control.points[:, 0, :, None]
        # The sum of the weights needs no gradient, because the pose does not depend on this sum.
        total = problem.weights.detach().sum(-1, keepdim=True)
        pairs = _Pairs(
            (problem.world_points.mT - centroid) / control.radius[:, None, None],
            (problem.img_points / problem.focal).mT.contiguous(),
            problem.weights / torch.where(total > 0, total, 1.0),
            problem.weights > 0,
        )
        with torch.no_grad():
            weights, pose = self._select(pairs, control)
        weights = torch.where(weights > 0, pairs.weights, 0.0)  # these weights have a gradient
        ok = control.ok & (pairs.there.sum(-1) >= _MIN_PAIRS)
        for i in range(self.refine_iterations):
            normal = _normal_matrix(_linearize(pairs, pose), weights)
            ok = ok & _determined(normal) if i == 0 else ok
            pose = _step(pose, torch.where(ok[:, None, None], normal, 0.0))
        ok = ok & (pose.translation[:, 2] > 0)
        offset = (pose.rotation @ centroid)[..., 0]
        pose = Pose(pose.rotation, pose.translation * control.radius[:, None] - offset)
        kept = (weights > 0) | (problem.usual == 0)  # the solver decides about unusual pairs
        return Starts(pose, kept.to(problem.weights.dtype), ok)

    def _select(self, pairs: _Pairs, control: ControlPoints) -> tuple[Tensor, Pose]:
        """Return weights (0 for outliers), and the pose of the kept pairs in the frame of :class:`_Pairs`."""
        coordinates = control.coordinates.mT.contiguous()  # (B, 4, N)
        # Subtracting the mean from the pixels is a shear of the camera frame. The shear does not change the algebraic
        # errors. In a narrow view, the shear reduces rounding errors.
        mean = (control.weights[:, None] * pairs.plane).sum(-1, keepdim=True)  # (B, 2, 1)
        zero = torch.zeros_like(coordinates)
        by_x, by_y = torch.cat((coordinates, zero), -1), torch.cat((zero, coordinates), -1)
        by_z = -(pairs.plane - mean).flatten(1)[:, None] * coordinates.repeat(1, 1, 2)
        parts = by_x[:, :1], by_y[:, :1], by_x[:, 1:], by_y[:, 1:], by_z[:, 1:], by_z[:, :1]
        rows, weights = torch.cat(parts, 1), pairs.weights  # the last row is for the centroid's depth, which is 1
        for _ in range(_NULL_ITERATIONS if self.reject_outliers else 0):
            inverse, null = _null_vector(rows, weights, _DEPTH_PRIOR)
            errors = _leave_one_out(torch.cat((rows[:, :-1], null.mT @ rows), 1), inverse, pairs, weights)
            sq_size = null[:, 2:-1].square().sum(1).clamp(min=torch.finfo(null.dtype).eps ** 2)
            weights = self._keep(pairs, errors / sq_size, _NULL_FLOOR)
        # Align the world points with the camera points of the last null vector.
        _, null = _null_vector(rows, weights, _FINAL_DEPTH_PRIOR)
        centroid, vectors = torch.cat((null[:, :2], null[:, -1:]), 1), null[:, 2:-1].view(-1, 3, 3)
        camera = torch.cat((centroid, vectors), 2)  # (B, 3, 4)
        camera = torch.cat((camera[:, :2] + mean * camera[:, 2:], camera[:, 2:]), 1)
        rotation, _, scale = align(pairs.world.mT, (camera @ coordinates).mT, weights)
        scale = torch.where(scale > torch.finfo(scale.dtype).eps ** 0.5, scale, 1.0)
        pose = Pose(rotation, camera[..., 0] / scale[:, None])
        pose = _step(pose, _normal_matrix(_linearize(pairs, pose), weights))
        for _ in range(_RIGID_ITERATIONS if self.reject_outliers else 0):
            rows = _linearize(pairs, pose)
            inverse = _inverse(_normal_matrix(rows, weights))
            weights = self._keep(pairs, _leave_one_out(rows, inverse, pairs, weights), _RIGID_FLOOR)
            pose = _step(pose, _normal_matrix(rows, weights))
        return weights, pose

    def _keep(self, pairs: _Pairs, sq_error: Tensor, floor: int) -> Tensor:
        """Weights (B, N), 0 if the error exceeds both quantile and ``max_error``. At least ``floor`` pairs are kept."""
        count = pairs.there.sum(-1, keepdim=True, dtype=sq_error.dtype)  # (B, 1)
        rank = (self.quantile * count).ceil().long().clamp(min=floor)
        rank = rank.clamp(max=sq_error.shape[-1]) - 1
        ascending = torch.where(pairs.there, sq_error, torch.inf).sort(-1).values
        kept = sq_error <= ascending.gather(-1, rank).clamp(min=self.max_error**2)
        return torch.where(kept, pairs.weights, 0.0)


class _Pairs(NamedTuple):
    """Pairs whose world points have the centroid 0 and the root mean square radius 1."""

    world: Tensor  # (B, 3, N)
    plane: Tensor  # u and v, pixels over the focal length, (B, 2, N)
    weights: Tensor  # normalised to the sum 1, (B, N)
    there: Tensor  # whether the weight is not 0, bool, (B, N)


def _normal_matrix(rows: Tensor, weights: Tensor) -> Tensor:
    """Normal equations (B, K, K + 1) of ``rows`` (see the module). The last column is the gradient."""
    return (rows[:, :-1] * weights.repeat(1, 2)[:, None]) @ rows.mT


def _inverse(normal: Tensor, ridge: Tensor | float = 0.0) -> Tensor:
    """Invert the normal matrix plus a ridge. A tiny number on the diagonal makes the inverse exist."""
    ridge = torch.diag_embed(normal.new_zeros(normal.shape[1]) + ridge + 32.0 * torch.finfo(normal.dtype).eps)
    return torch.linalg.inv_ex(normal[..., :-1] + ridge).inverse


def _null_vector(rows: Tensor, weights: Tensor, depth_prior: float) -> tuple[Tensor, Tensor]:
    """Inverse normal matrix (B, 11, 11), and null vector (B, 12, 1). The centroid's depth (last entry) is 1."""
    normal = _normal_matrix(rows, weights)
    inverse = _inverse(normal, depth_prior * (torch.arange(11, device=normal.device) >= 8).to(normal))
    return inverse, torch.cat((-(inverse @ normal[..., -1:]), torch.ones_like(normal[:, :1, :1])), 1)


def _linearize(pairs: _Pairs, pose: Pose) -> Tensor:
    """The algebraic errors and their derivatives with respect to the tangent vector of ``retract``, (B, 7, 2 N)."""
    u, v = pairs.plane.unbind(1)
    x, y, z = (pose.rotation @ pairs.world).unbind(1)  # (B, N) each
    tx, ty, tz = pose.translation[..., None].unbind(1)
    depth = z + tz
    one, zero = torch.ones_like(u), torch.zeros_like(u)
    rows = (
        *(-u * y, -z - v * y, z + u * x, v * x, -y, x),  # rotation: errors in u and in v for each axis
        *(one, zero, zero, one, -u, -v),  # translation
        *(x + tx - u * depth, y + ty - v * depth),
    )
    return torch.stack(rows, 1).view(u.shape[0], 7, 2 * u.shape[1])


def _step(pose: Pose, normal: Tensor) -> Pose:
    return retract(pose, -(_inverse(normal) @ normal[..., 6:])[..., 0])


def _leave_one_out(rows: Tensor, inverse: Tensor, pairs: _Pairs, weights: Tensor) -> Tensor:
    r"""Squared leave-one-out errors :math:`e^\top (1 \mp w H)^{-1} e` (B, N) with the leverage :math:`H`.

    If a kept pair is removed (minus), or a rejected pair is added (plus), the cost changes. The error is the change of
    the cost, divided by the weight :math:`w` of the pair.
    """
    jacobian, count = rows[:, :-1], weights.shape[-1]
    solved = inverse @ jacobian
    e_u, e_v = rows[:, -1].chunk(2, -1)
    signed = torch.where(weights > 0, weights, -pairs.weights)
    a, d = ((1.0 + _LEVERAGE_RIDGE) - signed.repeat(1, 2) * (jacobian * solved).sum(1)).chunk(2, -1)
    b = signed * (jacobian[..., :count] * solved[..., count:]).sum(1)
    return (d * e_u * e_u + 2.0 * b * e_u * e_v + a * e_v * e_v) / (a * d - b * b).clamp(min=_LEVERAGE_RIDGE**2)


def _determined(normal: Tensor) -> Tensor:
    """Whether each normal matrix has full rank, bool (B,)."""
    matrix = normal.detach()[..., :6]
    factor, info = torch.linalg.cholesky_ex(matrix)
    pivots = factor.diagonal(dim1=-2, dim2=-1).square()
    tolerance = 32.0 * torch.finfo(matrix.dtype).eps
    return (info == 0) & (pivots > tolerance * matrix.diagonal(dim1=-2, dim2=-1)).all(-1)
