r"""EPPnP and REPPnP: the null space of the projection equations, freed from outliers by the algebraic error alone.

A world point is :math:`p_i = \sum_j a_{ij} c_j` of four control points. In the camera frame these are twelve unknowns,
and a pair gives two equations, :math:`X_i - u_i Z_i = 0` and :math:`Y_i - v_i Z_i = 0`. What is left of them is the
algebraic error, the pixel error times the depth over the focal length: a length, which needs no projection.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor, nn

from kornia_pnpnet.geometry import retract
from kornia_pnpnet.init.epnp.control_points import ControlPoints, align, control_points
from kornia_pnpnet.types import Correspondences, Guess, Pose

__all__ = ["REPPnP"]

# The pairs that are kept whatever their errors. A pair gives 2 equations; the null vector has 11 unknowns, a pose 6:
# to the fewest that determine them come one and two more, without which no error could show.
_NULL_FLOOR, _RIGID_FLOOR = 7, 5
_MIN_PAIRS = 4
# Weight of the squared depths of the control points, relative to the centroid's, while outliers are looked for and at
# last. Anything from 1e-3 to 3e-2 does for the first; the second must stay below what a narrow view sees of depth.
_DEPTH_PRIOR, _FINAL_DEPTH_PRIOR = 5e-3, 1e-5


class REPPnP(nn.Module):
    r"""Null space of the projection equations, algebraic outlier rejection, and the pose of what is left.

    All pairs count at first. In each iteration the null vector of the pairs that count is found, and then those
    count whose algebraic error is at most :math:`\max(Q, \delta_{\max})`, where :math:`Q` is a quantile of the
    errors. The control points of the last null vector are aligned with those of the world (orthogonal Procrustes).
    With ``reject_outliers=False`` this is EPPnP.

    Source: L. Ferraz, X. Binefa and F. Moreno-Noguer, "Very Fast Solution to the PnP Problem with Algebraic Outlier
    Rejection", CVPR 2014. We depart from it for success on the protocol's problems and for batches:

    - The null vector is the one of least error among those with the centroid at depth 1, not among those of length
      1. It solves a linear system instead of an eigenproblem, its sign is right, and it does not depend on the
      choice of the control points, on the frame of the world or on its unit.
    - While outliers are looked for, the depths of the control points are kept close to the centroid's by a small
      ridge. That takes away ways to bend to outliers, and where a view is too narrow to show depth it leaves the
      weak perspective that it does show.
    - The error that is compared is that of leaving the pair out (of letting it in, for one that is out),
      :math:`e^\top (1 \mp w H)^{-1} e` with the leverage :math:`H` of the pair. One outlier among few pairs bends the
      fit to itself, and its plain error is small.
    - The quantile is the median, not 25 %, and at least 7 pairs are kept: a quarter of 20 pairs does not determine a
      null vector.
    - The same loop then goes on with rigid control points, one Gauss-Newton step of their algebraic error per
      iteration: with 6 unknowns instead of 11, fewer pairs tell who is wrong.
    - The pose minimises the algebraic error over the rigid motions by Gauss-Newton, which weighs every direction by
      what it costs. The paper alternates between the span of four null vectors, in which every direction is
      free, and the rigid control points.
    - Both loops have a fixed length; the paper's stops when the quantile no longer falls.

    Gradients: the selection is piecewise constant, and the last Gauss-Newton steps start from a detached pose. Close to
    the minimum, what they pass on is the derivative of the minimum.

    Args:
        reject_outliers: look for outliers; otherwise all pairs count.
        max_error: :math:`\delta_{\max}` as a share of the root mean square radius of the world.
        quantile: the share of the pairs that always counts, in (0, 1].
        null_iterations: rounds of rejection by the null vector.
        rigid_iterations: rounds of rejection by rigid control points.
        refine_iterations: Gauss-Newton steps after the last selection, at least 1.

    Raises:
        BaseError: for a quantile outside (0, 1], a negative error, or a wrong number of iterations.

    Example:
        >>> from kornia_pnpnet import Normalize
        >>> from kornia_pnpnet.data import OutlierMix, SyntheticProblems
        >>> problems = SyntheticProblems(n=20, batch_size=2, seed=0, outliers=OutlierMix(count=5)).batch(0)
        >>> corr, _ = Normalize(order=False)(*problems[:3])
        >>> guess = REPPnP()(corr)
        >>> guess.ok, (guess.weights > 0).eq(problems.inliers).all()
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
        super().__init__()
        KORNIA_CHECK(0.0 < quantile <= 1.0, f"quantile must lie in (0, 1], got {quantile}.")
        KORNIA_CHECK(0.0 <= max_error < math.inf, f"max_error must be finite and at least 0, got {max_error}.")
        KORNIA_CHECK(type(reject_outliers) is bool, f"reject_outliers must be true or false, got {reject_outliers!r}.")
        self.config = {
            "reject_outliers": reject_outliers,
            "max_error": max_error,
            "quantile": quantile,
            "null_iterations": null_iterations,
            "rigid_iterations": rigid_iterations,
            "refine_iterations": refine_iterations,
        }
        for name, least in (("null_iterations", 0), ("rigid_iterations", 0), ("refine_iterations", 1)):
            count = self.config[name]
            KORNIA_CHECK(type(count) is int and count >= least, f"{name} must be an integer >= {least}, got {count!r}.")
        self.reject_outliers = reject_outliers
        self.max_error = max_error
        self.quantile = quantile
        self.null_iterations = null_iterations
        self.rigid_iterations = rigid_iterations
        self.refine_iterations = refine_iterations

    def extra_repr(self) -> str:
        """Show the constructor's arguments."""
        return ", ".join(f"{key}={value!r}" for key, value in self.config.items())

    def forward(self, corr: Correspondences) -> Guess:
        r"""Guess the pose and the inliers.

        Args:
            corr: normalised correspondences, with any frame and unit of the world.

        Returns:
            The pose; as weights 1 for the pairs that count and 0 for the others; and ``ok``, false for fewer than 4
            pairs, for points on a line, for equations that do not determine a pose, and for a pose that has the
            centroid of the points behind the camera.
        """
        with torch.no_grad():
            control = control_points(corr)
        pairs, radius = _own_frame(corr, control)
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
        return Guess(pose, kept.to(corr.weights.dtype), ok)

    def _select(self, pairs: _Pairs) -> tuple[Tensor, Pose]:
        """The pairs that count, bool (B, N), and a pose that fits them, in the pairs' own frame."""
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
                normal = _normal_matrix(rows, pairs.weights, kept)
                kept = self._keep(pairs, _rigid_error(pairs, rows, normal, kept), _RIGID_FLOOR)
                pose = _step(pose, _normal_matrix(rows, pairs.weights, kept))
        return kept, pose

    def _keep(self, pairs: _Pairs, sq_error: Tensor, floor: int) -> Tensor:
        """The pairs whose error is at most the larger of the quantile and the limit, bool (B, N)."""
        rank = (self.quantile * pairs.there.sum(-1, keepdim=True)).ceil().long().clamp(min=floor)  # (B, 1)
        rank = rank.clamp(max=sq_error.shape[-1]) - 1
        ascending = torch.where(pairs.there, sq_error, torch.inf).sort(-1).values
        return pairs.there & (sq_error <= ascending.gather(-1, rank).clamp(min=self.max_error**2))


class _Pairs(NamedTuple):
    """The pairs in a world of their own, with the centroid 0 and the root mean square radius 1."""

    coordinates: Tensor  # a, of the control points, (B, 4, N)
    world: Tensor  # (B, 3, N)
    u: Tensor  # pixel over focal length, (B, N)
    v: Tensor
    mean_u: Tensor  # (B, 1)
    mean_v: Tensor
    weights: Tensor  # with the sum 1, (B, N)
    there: Tensor  # bool, (B, N)


class _Null(NamedTuple):
    """The null vector, and what the leverage of a pair is made of."""

    control: Tensor  # control points in the camera frame, sheared by (x - mean_u z, y - mean_v z, z), (B, 4, 3)
    solution: Tensor  # T, with T_x z and T_y z the best x and y for the depths z, (B, 4, 8)
    inverse_gram: Tensor  # (B, 4, 4)
    inverse_depths: Tensor  # inverse of the normal matrix of the depths but the centroid's, (B, 3, 3)


def _own_frame(corr: Correspondences, control: ControlPoints) -> tuple[_Pairs, Tensor]:
    """The pairs in their own frame, and the root mean square radius (B,) that became 1."""
    mean_square = control.points[:, 1:].square().sum((1, 2))
    radius = torch.where(control.ok, mean_square, 1.0).sqrt()
    world = (corr.world_points.mT - control.points[:, 0, :, None]) / radius[:, None, None]
    u, v = (corr.img_points / corr.focal).unbind(-1)
    # The frame is not differentiated: the pose does not depend on it, nor on a common factor of the weights.
    total = corr.weights.detach().sum(-1, keepdim=True)
    weights = corr.weights / torch.where(total > 0, total, 1.0)
    mean_u, mean_v = ((control.weights * x).sum(-1, keepdim=True) for x in (u, v))
    coordinates = control.coordinates.mT.contiguous()
    return _Pairs(coordinates, world, u, v, mean_u, mean_v, weights, corr.weights > 0), radius


def _features(pairs: _Pairs) -> Tensor:
    """The right factors a, u a, v a, (u² + v²) a of the products that the normal matrix sums, (B, 16, N)."""
    a = pairs.coordinates
    u, v = (pairs.u - pairs.mean_u)[:, None], (pairs.v - pairs.mean_v)[:, None]
    return torch.cat((a, u * a, v * a, (u * u + v * v) * a), 1)


def _inverse(matrix: Tensor, ridge: float = 0.0) -> Tensor:
    """Inverse of positive semi-definite matrices; what they do not determine is small instead of infinite."""
    ridge = ridge + 32.0 * torch.finfo(matrix.dtype).eps
    eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    return torch.linalg.inv_ex(matrix + ridge * eye).inverse


def _null_vector(pairs: _Pairs, features: Tensor, kept: Tensor, depth_prior: float) -> _Null:
    r"""Control points in the camera frame with the centroid at depth 1 and the least algebraic error.

    With the pixels relative to their mean, a shear of the camera frame that changes no error but keeps the digits of
    a narrow view, the normal matrix is :math:`[[A, 0, -U], [0, A, -V], [-U, -V, Q]]`: sums of :math:`a a^\top`,
    :math:`u a a^\top`, :math:`v a a^\top` and :math:`(u^2 + v^2) a a^\top`. Eliminating x and y as :math:`A^{-1} U z`
    and :math:`A^{-1} V z` leaves :math:`Q - U A^{-1} U - V A^{-1} V` for the depths z.
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
    """Squared errors of leaving pairs out, relative to the size of the null vector, (B, N)."""
    a = pairs.coordinates
    moved = torch.cat((null.solution, null.inverse_gram), -1).mT @ a  # (B, 12, N)
    from_xy = (moved[:, 8:] * a).sum(1)  # the leverage that x alone and y alone give
    # The equations once x and y are eliminated, in the depth of the centroid and in the other depths.
    first = torch.cat((moved[:, 0] - features[:, 4], moved[:, 4] - features[:, 8]), -1)  # (B, 2N)
    rows = torch.cat((moved[:, 1:4] - features[:, 5:8], moved[:, 5:8] - features[:, 9:12]), -1)  # (B, 3, 2N)
    residual = first + (null.control[:, None, 1:, 2] @ rows)[:, 0]
    uu, uv, vv = _leverage(rows, null.inverse_depths @ rows)
    sq_error = _leave_one_out(residual, from_xy + uu, uv, from_xy + vv, pairs, kept)
    sq_size = null.control[:, 1:].square().sum((1, 2))[:, None]
    return sq_error / sq_size.clamp(min=torch.finfo(sq_size.dtype).eps ** 2)


def _aligned(pairs: _Pairs, null: _Null, kept: Tensor) -> Pose:
    """The rigid motion that fits the null vector best."""
    x, y, z = null.control.unbind(-1)
    control = torch.stack((x + pairs.mean_u * z, y + pairs.mean_v * z, z), -1)  # (B, 4, 3)
    cam_points = pairs.coordinates.mT @ control
    pose, scale = align(pairs.world.mT, cam_points, torch.where(kept, pairs.weights, 0.0))
    large = scale > torch.finfo(scale.dtype).eps ** 0.5
    return Pose(pose.rotation, control[:, 0] / torch.where(large, scale, 1.0)[:, None])


def _linearize(pairs: _Pairs, pose: Pose) -> Tensor:
    """Jacobian of the algebraic errors by the tangent of ``retract``, and below it the errors, (B, 7, 2N)."""
    u, v = pairs.u, pairs.v
    rotated = pose.rotation @ pairs.world
    x, y, z = rotated.unbind(1)  # (B, N) each
    tx, ty, tz = pose.translation[..., None].unbind(1)
    depth = z + tz
    one, zero = torch.ones_like(u), torch.zeros_like(u)
    # fmt: off
    rows = (
        -u * y, -z - v * y,
        z + u * x, v * x,
        -y, x,
        one, zero,
        zero, one,
        -u, -v,
        x + tx - u * depth, y + ty - v * depth,
    )
    # fmt: on
    return torch.stack(rows, 1).view(u.shape[0], 7, 2 * u.shape[1])


def _normal_matrix(rows: Tensor, weights: Tensor, kept: Tensor) -> Tensor:
    """Normal matrix of the pairs that count and, as its last column, the gradient, (B, 6, 7)."""
    weights = torch.where(kept, weights, 0.0)
    return (rows[:, :6] * torch.cat((weights, weights), -1)[:, None]) @ rows.mT


def _step(pose: Pose, normal: Tensor) -> Pose:
    """One Gauss-Newton step."""
    return retract(pose, -(_inverse(normal[..., :6]) @ normal[..., 6:])[..., 0])


def _rigid_error(pairs: _Pairs, rows: Tensor, normal: Tensor, kept: Tensor) -> Tensor:
    """Squared errors of leaving pairs out of the linearised rigid problem, (B, N)."""
    jacobian = rows[:, :6]
    return _leave_one_out(rows[:, 6], *_leverage(jacobian, _inverse(normal[..., :6]) @ jacobian), pairs, kept)


def _leverage(jacobian: Tensor, solved: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Entries (B, N) of the 2 x 2 leverages from a Jacobian (B, D, 2N) and the inverse normal matrix times it."""
    count = jacobian.shape[-1] // 2
    uu, vv = (jacobian * solved).sum(1).chunk(2, -1)
    return uu, (jacobian[..., :count] * solved[..., count:]).sum(1), vv


def _leave_one_out(residual: Tensor, uu: Tensor, uv: Tensor, vv: Tensor, pairs: _Pairs, kept: Tensor) -> Tensor:
    r"""How much the cost falls when a pair leaves the fit, or rises when it enters, over its weight, (B, N).

    It is :math:`e^\top (1 \mp w H)^{-1} e` with the pair's error :math:`e` in (B, 2N) and leverage :math:`H`, minus for
    the pairs that are in the fit.
    """
    e_u, e_v = residual.chunk(2, -1)
    weights = torch.where(kept, pairs.weights, -pairs.weights)
    # What only one pair determines has the leverage 1: its error is 0, and this keeps 0 / 0 away.
    a = (1.0 + 1e-6) - weights * uu
    d = (1.0 + 1e-6) - weights * vv
    b = weights * uv
    return (d * e_u * e_u + 2.0 * b * e_u * e_v + a * e_v * e_v) / (a * d - b * b).clamp(min=1e-12)


def _determined(normal: Tensor) -> Tensor:
    """Whether the normal matrices have full rank, bool (B,)."""
    matrix = normal.detach()[..., :6]
    factor, info = torch.linalg.cholesky_ex(matrix)
    pivots = factor.diagonal(dim1=-2, dim2=-1).square()
    tolerance = 32.0 * torch.finfo(matrix.dtype).eps
    return (info == 0) & (pivots > tolerance * matrix.diagonal(dim1=-2, dim2=-1)).all(-1)
