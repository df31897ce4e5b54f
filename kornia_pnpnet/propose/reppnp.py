r"""EPPnP and REPPnP: the null space of the projection equations, with outliers rejected by their algebraic error.

In the camera frame four control points (see ``propose/control_points.py``) are twelve unknowns, and a
pair gives two equations, :math:`X_i - u_i Z_i = 0` and :math:`Y_i - v_i Z_i = 0`. Their residual is the algebraic
error: the pixel error times the depth over the focal length, a length.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_whole
from kornia_pnpnet.core.linalg import align
from kornia_pnpnet.problem import Problem, Starts
from kornia_pnpnet.propose.control_points import ControlPoints, control_points
from kornia_pnpnet.propose.initialiser import Initialiser
from kornia_pnpnet.refine.residual import retract
from kornia_pnpnet.result import Pose

__all__ = ["REPPnP"]

# Number of pairs that are kept at any error: 11 unknowns of the null vector need 6 pairs, 6 unknowns of a rigid motion
# 3 pairs, and one or two more so that errors show.
_NULL_FLOOR, _RIGID_FLOOR = 7, 5
# Number of pairs below which a problem is not `ok`.
_MIN_PAIRS = 4
# Weight of the squared depths of the control points relative to the centroid, during outlier rejection. Values from
# 1e-3 to 3e-2 work equally well on the protocol's problems.
_DEPTH_PRIOR = 5e-3
# The same weight for the last null vector: small enough to keep the little depth that a narrow view shows.
_FINAL_DEPTH_PRIOR = 1e-5
# Added to 1 minus the leverage: a pair that alone determines an unknown has the leverage 1 and the error 0.
_LEVERAGE_RIDGE = 1e-6


class REPPnP(Initialiser):
    r"""Null space of the projection equations, algebraic outlier rejection, and the pose of the remaining pairs.

    Each iteration finds the null vector of the kept pairs, at first of all pairs, and then keeps the pairs whose
    algebraic error is at most :math:`\max(Q, \delta_{\max})`, with a quantile :math:`Q` of the errors. The last null
    vector is aligned with the world (orthogonal Procrustes). Without rejection the method is EPPnP.

    Source: L. Ferraz, X. Binefa and F. Moreno-Noguer, "Very Fast Solution to the PnP Problem with Algebraic Outlier
    Rejection", CVPR 2014. Our changes are for success on the protocol's problems and for batches:

    - The null vector has the least error with the centroid at depth 1, instead of length 1: a linear system that does
      not depend on the control points, the frame or the unit. A small ridge keeps the other depths close to the
      centroid's, so that the fit bends less to outliers and a narrow view is weak perspective.
    - Pairs are compared by their leave-one-out error. The quantile is the median instead of 25 %, and at least 7 pairs
      are kept.
    - The same loop continues with a rigid motion and one Gauss-Newton step of its algebraic error per iteration, and
      the pose minimises this error. The paper alternates between the span of four null vectors and rigid points.
    - Both loops have a fixed length; the paper's loop stops when the quantile no longer falls.

    Gradients: the selection is piecewise constant, and the last Gauss-Newton steps start from a detached pose, so that
    their gradient is that of the minimum.

    Args:
        reject_outliers: reject outliers; otherwise all pairs are kept.
        max_error: :math:`\delta_{\max}` as a share of the root mean square radius of the world.
        quantile: share of the pairs that is always kept, in (0, 1].
        null_iterations: number of rejections by the null vector.
        rigid_iterations: number of rejections by rigid control points.
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
        null_iterations: int = 3,
        rigid_iterations: int = 4,
        refine_iterations: int = 3,
    ) -> None:
        super().__init__(locals())
        KORNIA_CHECK(0.0 < quantile <= 1.0, f"quantile must lie in (0, 1], got {quantile}.")
        KORNIA_CHECK(type(reject_outliers) is bool, f"reject_outliers must be true or false, got {reject_outliers!r}.")
        check_numbers(0.0, max_error=max_error)
        check_whole(0, null_iterations=null_iterations, rigid_iterations=rigid_iterations)
        check_whole(1, refine_iterations=refine_iterations)
        self.reject_outliers = reject_outliers
        self.max_error = max_error
        self.quantile = quantile
        self.null_iterations = null_iterations
        self.rigid_iterations = rigid_iterations
        self.refine_iterations = refine_iterations

    def forward(self, problem: Problem) -> Starts:
        """Find the pose and the inliers.

        Args:
            problem: the problem in the solver's frame.

        Returns:
            The pose; as weights 1 for the kept pairs and 0 for the outliers; and ``ok``, false for fewer than 4 pairs,
            for points on a line, for equations that do not determine a pose, and for a pose with the centroid of the
            points behind the camera.
        """
        problem = problem._replace(weights=problem.usual_weights)
        with torch.no_grad():
            control = control_points(problem)
        pairs, radius = _own_frame(problem, control)
        with torch.no_grad():
            kept, pose = self._select(pairs)
        ok = control.ok & (pairs.there.sum(-1) >= _MIN_PAIRS)
        for i in range(self.refine_iterations):
            normal = _normal_matrix(_linearize(pairs, pose), pairs.weights, kept)
            ok = ok & _determined(normal) if i == 0 else ok
            pose = _step(pose, torch.where(ok[:, None, None], normal, 0.0))
        ok = ok & (pose.translation[:, 2] > 0)
        offset = (pose.rotation @ control.points[:, 0, :, None])[..., 0]
        pose = Pose(pose.rotation, pose.translation * radius[:, None] - offset)
        kept = kept | (problem.usual == 0)  # the solver decides about pairs that are not of normal scale
        return Starts(pose, kept.to(problem.weights.dtype), ok)

    def _select(self, pairs: _Pairs) -> tuple[Tensor, Pose]:
        """The kept pairs, bool (B, N), and a pose that fits these pairs, in the frame of :class:`_Pairs`."""
        kept = pairs.there
        features = _features(pairs)
        if self.reject_outliers:
            for _ in range(self.null_iterations):
                null = _null_vector(pairs, features, kept, _DEPTH_PRIOR)
                kept = self._keep(pairs, _null_error(pairs, features, null, kept), _NULL_FLOOR)
        pose = _aligned(pairs, _null_vector(pairs, features, kept, _FINAL_DEPTH_PRIOR), kept)
        pose = _step(pose, _normal_matrix(_linearize(pairs, pose), pairs.weights, kept))
        if self.reject_outliers:
            for _ in range(self.rigid_iterations):
                rows = _linearize(pairs, pose)
                inverse = _inverse(_normal_matrix(rows, pairs.weights, kept)[..., :6])
                kept = self._keep(pairs, _leave_one_out(rows[:, 6], rows[:, :6], inverse, pairs, kept), _RIGID_FLOOR)
                pose = _step(pose, _normal_matrix(rows, pairs.weights, kept))
        return kept, pose

    def _keep(self, pairs: _Pairs, sq_error: Tensor, floor: int) -> Tensor:
        """The pairs whose error is at most the larger of quantile and limit, at least ``floor`` pairs; bool (B, N)."""
        rank = (self.quantile * pairs.there.sum(-1, keepdim=True)).ceil().long().clamp(min=floor)  # (B, 1)
        rank = rank.clamp(max=sq_error.shape[-1]) - 1
        ascending = torch.where(pairs.there, sq_error, torch.inf).sort(-1).values
        return pairs.there & (sq_error <= ascending.gather(-1, rank).clamp(min=self.max_error**2))


class _Pairs(NamedTuple):
    """The pairs in a world whose centroid is 0 and whose root mean square radius is 1."""

    coordinates: Tensor  # a, see ControlPoints, (B, 4, N)
    world: Tensor  # (B, 3, N)
    plane: Tensor  # u and v: pixel over focal length, (B, 2, N)
    mean: Tensor  # of u and v, (B, 2, 1)
    weights: Tensor  # with the sum 1, (B, N)
    there: Tensor  # bool, (B, N)


class _Null(NamedTuple):
    """The null vector, and the matrices from which leverages are computed."""

    control: Tensor  # control points in the camera frame, sheared by (x - mean_u z, y - mean_v z, z), (B, 4, 3)
    solution: Tensor  # (T_x, T_y): T_x z and T_y z are the best x and y for the depths z, (B, 4, 8)
    inverse_gram: Tensor  # (B, 4, 4)
    inverse_depths: Tensor  # inverse normal matrix of the depths of the control vectors, (B, 3, 3)


def _own_frame(problem: Problem, control: ControlPoints) -> tuple[_Pairs, Tensor]:
    """The pairs in the frame of :class:`_Pairs`, and the root mean square radius (B,) before."""
    mean_square = control.points[:, 1:].square().sum((1, 2))
    radius = torch.where(control.ok, mean_square, 1.0).sqrt()
    world = (problem.world_points.mT - control.points[:, 0, :, None]) / radius[:, None, None]
    plane = (problem.img_points / problem.focal).mT.contiguous()
    # No gradient through the frame and the sum of weights: the pose depends on neither.
    total = problem.weights.detach().sum(-1, keepdim=True)
    weights = problem.weights / torch.where(total > 0, total, 1.0)
    mean = (control.weights[:, None] * plane).sum(-1, keepdim=True)
    coordinates = control.coordinates.mT.contiguous()
    return _Pairs(coordinates, world, plane, mean, weights, problem.weights > 0), radius


def _features(pairs: _Pairs) -> Tensor:
    """The right factors a, u a, v a, (u² + v²) a of the products in the normal matrix, (B, 16, N)."""
    a, centred = pairs.coordinates, pairs.plane - pairs.mean
    return torch.cat((a, centred[:, :1] * a, centred[:, 1:] * a, centred.square().sum(1, keepdim=True) * a), 1)


def _inverse(matrix: Tensor, ridge: float = 0.0) -> Tensor:
    """Inverse of positive semi-definite matrices plus a ridge, which keeps singular matrices finite."""
    ridge = ridge + 32.0 * torch.finfo(matrix.dtype).eps
    eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    return torch.linalg.inv_ex(matrix + ridge * eye).inverse


def _null_vector(pairs: _Pairs, features: Tensor, kept: Tensor, depth_prior: float) -> _Null:
    r"""Control points in the camera frame with the centroid at depth 1 and the least algebraic error.

    The pixels are relative to their mean: a shear of the camera frame that changes no error but keeps the digits of a
    narrow view. The normal matrix is then :math:`[[A, 0, -U], [0, A, -V], [-U, -V, Q]]`, sums of the products of the
    features. Eliminating x and y as :math:`A^{-1} U z` and :math:`A^{-1} V z` leaves
    :math:`Q - U A^{-1} U - V A^{-1} V` for the depths z.
    """
    weighted = pairs.coordinates * torch.where(kept, pairs.weights, 0.0)[:, None]
    sums = weighted @ features.mT  # (B, 4, 16)
    inverse_gram = _inverse(sums[..., :4])
    cross = sums[..., 4:12]
    solution = inverse_gram @ cross  # (B, 4, 8)
    schur = sums[..., 12:] - torch.cat(cross.chunk(2, -1), 1).mT @ torch.cat(solution.chunk(2, -1), 1)
    inverse_depths = _inverse(schur[:, 1:, 1:], depth_prior)
    depths = torch.cat((torch.ones_like(schur[:, :1, :1]), -(inverse_depths @ schur[:, 1:, :1])), 1)
    control = torch.cat((*(part @ depths for part in solution.chunk(2, -1)), depths), -1)
    return _Null(control, solution, inverse_gram, inverse_depths)


def _null_error(pairs: _Pairs, features: Tensor, null: _Null, kept: Tensor) -> Tensor:
    """Squared leave-one-out errors of the null vector, relative to its size, (B, N)."""
    a = pairs.coordinates
    moved = torch.cat((null.solution, null.inverse_gram), -1).mT @ a  # (B, 12, N)
    from_xy = (moved[:, 8:] * a).sum(1)  # the leverage of u by x alone, and of v by y alone
    # The equations without x and y: coefficients of the depth of the centroid, and of the other depths.
    first = torch.cat((moved[:, 0] - features[:, 4], moved[:, 4] - features[:, 8]), -1)  # (B, 2N)
    rows = torch.cat((moved[:, 1:4] - features[:, 5:8], moved[:, 5:8] - features[:, 9:12]), -1)  # (B, 3, 2N)
    residual = first + (null.control[:, None, 1:, 2] @ rows)[:, 0]
    sq_error = _leave_one_out(residual, rows, null.inverse_depths, pairs, kept, from_xy)
    sq_size = null.control[:, 1:].square().sum((1, 2))[:, None]
    return sq_error / sq_size.clamp(min=torch.finfo(sq_size.dtype).eps ** 2)


def _aligned(pairs: _Pairs, null: _Null, kept: Tensor) -> Pose:
    """The rigid motion that fits the null vector best, by alignment of the points."""
    across, z = null.control.split((2, 1), -1)
    control = torch.cat((across + pairs.mean.mT * z, z), -1)  # (B, 4, 3)
    cam_points = pairs.coordinates.mT @ control
    rotation, _, scale = align(pairs.world.mT, cam_points, torch.where(kept, pairs.weights, 0.0))
    large = scale > torch.finfo(scale.dtype).eps ** 0.5
    return Pose(rotation, control[:, 0] / torch.where(large, scale, 1.0)[:, None])


def _linearize(pairs: _Pairs, pose: Pose) -> Tensor:
    """Jacobian of the algebraic errors by the tangent of ``retract``; the last row holds the errors, (B, 7, 2N)."""
    u, v = pairs.plane.unbind(1)
    x, y, z = (pose.rotation @ pairs.world).unbind(1)  # (B, N) each
    tx, ty, tz = pose.translation[..., None].unbind(1)
    depth = z + tz
    one, zero = torch.ones_like(u), torch.zeros_like(u)
    rows = (
        *(-u * y, -z - v * y, z + u * x, v * x, -y, x),  # by the rotation: the errors of u and of v in turn
        *(one, zero, zero, one, -u, -v),  # by the translation
        *(x + tx - u * depth, y + ty - v * depth),
    )
    return torch.stack(rows, 1).view(u.shape[0], 7, 2 * u.shape[1])


def _normal_matrix(rows: Tensor, weights: Tensor, kept: Tensor) -> Tensor:
    """Normal matrix of the kept pairs; the last column holds the gradient, (B, 6, 7)."""
    return (rows[:, :6] * torch.where(kept, weights, 0.0).repeat(1, 2)[:, None]) @ rows.mT


def _step(pose: Pose, normal: Tensor) -> Pose:
    """Take a Gauss-Newton step."""
    return retract(pose, -(_inverse(normal[..., :6]) @ normal[..., 6:])[..., 0])


def _leave_one_out(
    residual: Tensor, jacobian: Tensor, inverse: Tensor, pairs: _Pairs, kept: Tensor, more: Tensor | float = 0.0
) -> Tensor:
    r"""Decrease of the cost when a pair leaves the fit, or increase when it enters, over its weight, (B, N).

    The value is :math:`e^\top (1 \mp w H)^{-1} e`, minus for the kept pairs, with the pair's errors (B, 2N) and the
    leverage :math:`H` from the Jacobian (B, D, 2N) and the inverse normal matrix; ``more`` is added to its diagonal.
    """
    count, solved = kept.shape[-1], inverse @ jacobian
    uu, vv = (jacobian * solved).sum(1).chunk(2, -1)
    e_u, e_v = residual.chunk(2, -1)
    weights = torch.where(kept, pairs.weights, -pairs.weights)
    a = (1.0 + _LEVERAGE_RIDGE) - weights * (more + uu)
    d = (1.0 + _LEVERAGE_RIDGE) - weights * (more + vv)
    b = weights * (jacobian[..., :count] * solved[..., count:]).sum(1)
    return (d * e_u * e_u + 2.0 * b * e_u * e_v + a * e_v * e_v) / (a * d - b * b).clamp(min=_LEVERAGE_RIDGE**2)


def _determined(normal: Tensor) -> Tensor:
    """Whether the normal matrices have full rank, bool (B,)."""
    matrix = normal.detach()[..., :6]
    factor, info = torch.linalg.cholesky_ex(matrix)
    pivots = factor.diagonal(dim1=-2, dim2=-1).square()
    tolerance = 32.0 * torch.finfo(matrix.dtype).eps
    return (info == 0) & (pivots > tolerance * matrix.diagonal(dim1=-2, dim2=-1)).all(-1)
