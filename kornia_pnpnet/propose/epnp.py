r"""EPnP: a pose from four or more pairs. A closed-form solution is refined by Gauss-Newton steps in four unknowns.

A world point is a combination of control points, :math:`p_i = \sum_j a_{ij} c_j`. The coordinates :math:`a_{ij}` are
the same in the world frame and in the camera frame. Here :math:`c_0` is the centroid, and :math:`c_1, c_2, c_3` are
*vectors* from the centroid. The vectors are chosen so that the coordinates are orthonormal,
:math:`\sum_i w_i a_i a_i^\top = I`. (Lepetit et al. use four points and barycentric coordinates.)

The projection equations are :math:`\sum_j a_{ij} (x_j - u_i z_j) = 0` and :math:`\sum_j a_{ij} (y_j - v_i z_j) = 0`.
For given depths :math:`z` of the control points, the least-squares solutions are :math:`x = P z` and :math:`y = Q z`,
with :math:`P = \sum_i w_i u_i a_i a_i^\top` and :math:`Q = \sum_i w_i v_i a_i a_i^\top`. Of the paper's 12 unknowns,
only the four depths remain. The algebraic error of the depths is :math:`z^\top K z`. The control vectors are the
columns of :math:`D(z)` in the camera frame, and of :math:`L` in the world frame. If :math:`D^\top D = L^\top L`, a
rotation or a reflection maps :math:`L` to :math:`D`. An array (4, C, B) contains the four depths of C candidates.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_whole
from kornia_pnpnet.core.linalg import (
    eigenvectors,
    nearest_rotation,
    signed,
    small_product,
    solve_leading,
    solve_positive,
)
from kornia_pnpnet.core.performance import records
from kornia_pnpnet.problem import Problem, Starts
from kornia_pnpnet.propose.initialiser import Initialiser
from kornia_pnpnet.result import Pose

__all__ = ["ControlPoints", "EPnP", "control_points"]

# Points are planar when their smallest extent is below this fraction of their middle extent.
_PLANAR_RATIO = 1e-3
# A problem that is `ok` has at least _MIN_PAIRS pairs, and at least _MIN_IN_FRONT of them are in front of the camera.
_MIN_PAIRS, _MIN_IN_FRONT = 4, 3
# Number of Gauss-Newton steps that each case takes before the best case is chosen.
_CASE_ITERATIONS = 2
# Upper bound of a squared reprojection error, in squared focal lengths. A point behind the camera has this error.
_MAX_SQ_RESIDUAL = 4.0
# Size of the ridge of `_null_space`, divided by the squared spread of the pixels. If null vectors have equal errors,
# the ridge sorts them by the extent of the world along them, in descending order.
_TIE = 1e-4
# Indices (m, n) of the products βₘβₙ, which are the unknowns of `_four_cases`.
_PRODUCTS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (0, 3))


class ControlPoints(NamedTuple):
    """Control points, and the coordinates and the weights of the pairs. The batch is the last dimension in memory."""

    points: Tensor  # the centroid and three vectors; the last vector of planar points is 0, (B, 4, 3)
    coordinates: Tensor  # the world points are `coordinates @ points`; the last column of planar points is 0, (B, N, 4)
    weights: Tensor  # normalised to the sum 1, (B, N)
    planar: Tensor  # whether the points lie in a plane or on a line, bool, (B,)
    radius: Tensor  # root mean square distance of the points from the centroid; 1 if they lie on a line, (B,)
    ok: Tensor  # whether the points do not lie on a line, bool, (B,)


def control_points(problem: Problem) -> ControlPoints:
    r"""Choose the control points by weighted Gram-Schmidt on the coordinates of the world points.

    Each of three steps selects the coordinate of largest variance, and makes all other coordinates orthogonal to this
    one. Pairs with weight 0 are ignored. (The paper's principal directions have no gradient if two extents are equal.)

    Example:
        >>> world = torch.tensor([[[4.0, 0, 0], [-4, 0, 0], [0, 2, 0], [0, -2, 0]]])
        >>> control = control_points(Problem.of(world, torch.zeros(1, 4, 2)))
        >>> control.planar, torch.allclose(control.coordinates @ control.points, world)
        (tensor([True]), True)
    """
    weights = problem.weights.mT.contiguous()  # (N, B)
    total = weights.sum(0)
    weights = weights / torch.where(total > 0, total, 1.0)
    world = problem.world_points.permute(2, 1, 0).contiguous()  # (3, N, B)
    centroid = (world * weights).sum(1)  # (3, B)
    rest = world - centroid[:, None]
    # A variance below the limit counts as 0. From the second axis on, the limit is relative to the previous variance.
    limit = torch.full_like(total, torch.finfo(rest.dtype).tiny ** 0.5)
    line_ratio = torch.finfo(rest.dtype).eps ** 0.5
    vectors, axes, found = [centroid], [torch.ones_like(weights)], []
    for ratio in (line_ratio, _PLANAR_RATIO, 1.0):
        largest, position = (rest.square() * weights).sum(1).max(0)  # (B,): the largest variance of an axis
        there = largest > limit
        inverse = torch.where(there, largest, torch.inf).rsqrt()
        axis = rest.gather(0, position.expand(1, *weights.shape))[0] * inverse  # (N, B)
        vector = (rest * (weights * axis)).sum(1)  # (3, B)
        rest = torch.addcmul(rest, vector[:, None], axis, value=-1)
        vectors.append(vector)
        axes.append(axis)
        found.append(there)
        limit = torch.where(there, (largest.detach() * ratio**2).maximum(limit), torch.inf)
    points, coordinates = torch.stack(vectors, 1).permute(2, 1, 0), torch.stack(axes).permute(2, 1, 0)
    radius = torch.where(found[1], points[:, 1:].square().sum((1, 2)), 1.0).sqrt()
    return ControlPoints(points, coordinates, weights.mT, ~found[2], radius, found[1])


class EPnP(Initialiser):
    r"""EPnP with weights, planar points and gradients, for batches.

    The control points in the camera frame are a combination of the null vectors of the projection equations. The
    coefficients have to preserve the distances between the control points. Gauss-Newton starts from four cases, which
    combine one, two, three and four null vectors. Orthogonal Procrustes aligns the case of the smallest weighted
    reprojection error with the world.

    Source: V. Lepetit, F. Moreno-Noguer and P. Fua, "EPnP: An Accurate O(n) Solution to the PnP Problem", IJCV 2009.
    Four things differ from the paper. Two thirds of the unknowns are eliminated (see the module). The centroid has
    depth 0 in all but one null vector. The objective includes the algebraic error, and does not depend on the choice of
    the control points. Planar points use the same equations, with 0 as the last control vector.

    Four or five pairs can have up to four solutions, and the solution of the least reprojection error may be incorrect.
    A problem is not ``ok`` if it has fewer than four pairs, if its points lie on a line, or if fewer than three pairs
    are in front of the camera. The gradient of the pose follows from the implicit function theorem.

    Args:
        iterations: number of Gauss-Newton steps of the best case, at least 2. All other cases take two steps.
        algebraic_weight: :math:`\mu \ge 0`, weight of the algebraic error relative to the squared error of the
            distances, in a world with a root mean square radius of 1. The paper's weight is 0.

    Raises:
        BaseError: when an argument is out of its range.

    Example:
        >>> from kornia_pnpnet import Normalize
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> from kornia_pnpnet.metrics import pose_errors
        >>> noiseless = SyntheticProblems(n=6, batch_size=2, world_sigma=0.0, img_sigma=0.0, dtype=torch.float64)
        >>> problems = noiseless.batch(0)
        >>> problem, frame = Normalize()(problems.world_points, problems.img_points, problems.intrinsics)
        >>> starts = EPnP()(problem)
        >>> pose_errors(frame.undo(starts.pose), problems.pose).translation_error < 1e-6, starts.ok
        (tensor([True, True]), tensor([True, True]))
    """

    def __init__(self, *, iterations: int = 5, algebraic_weight: float = 0.3) -> None:
        super().__init__(locals())
        check_whole(_CASE_ITERATIONS, iterations=iterations)
        check_numbers(0.0, algebraic_weight=algebraic_weight)
        self.iterations = iterations
        self.algebraic_weight = algebraic_weight

    def forward(self, problem: Problem) -> Starts:
        """Find the pose in the solver's frame. All returned weights are 1, and all returned poses are finite."""
        problem = problem._replace(weights=problem.usual_weights)
        control = control_points(problem)
        system = _depth_system(control, problem, self.algebraic_weight)
        with torch.no_grad():
            depths, solved = self._depths(system)
        if records(system.prior):
            depths = _attach_gradient(system, depths, control.planar)

        camera = _in_camera(system, depths)[:, :, 0]  # (3, 4, B)
        affine = camera[:, 1:]
        moment = small_product(affine, system.vectors.transpose(0, 1))
        turn, unique = nearest_rotation(moment)
        # In the camera frame, the control vectors have approximate lengths. The scale restores the world's size.
        size = affine.square().sum((0, 1))
        scale = (turn * moment).sum((0, 1)) / torch.where(size > 0, size, 1.0)
        rotation = turn.permute(2, 0, 1).contiguous()
        offset = (rotation @ control.points[:, 0, :, None])[..., 0]
        translation = (camera[:, 0] * (scale * system.unit)).mT - offset

        there = problem.weights > 0
        depth = (problem.world_points @ rotation[:, 2, :, None])[..., 0] + translation[:, 2:]  # (B, N)
        in_front = (there & (depth > 0)).sum(1) >= _MIN_IN_FRONT
        ok = solved & unique & (there.sum(1) >= _MIN_PAIRS) & in_front
        return Starts(Pose(rotation, translation), torch.ones_like(problem.weights), ok)

    def _depths(self, system: _DepthSystem) -> tuple[Tensor, Tensor]:
        """Depths (4, 1, B) of the best case, and its validity (B,). All points of an invalid case have equal depths."""
        cases = _four_cases(system).detach()  # `no_grad` does not stop forward-mode derivatives
        # A shape and its mirror image along the optical axis have equal distances between points. Gauss-Newton cannot
        # move from one shape to the other shape, and therefore starts from both shapes.
        mirrored = torch.cat((cases[:1, -1:], -cases[1:, -1:]))
        cases = _minimize(system, torch.cat((cases, mirrored), 1), _CASE_ITERATIONS)
        best = cases.gather(1, _best_case(system, cases).expand(4, 1, -1))
        depths = _minimize(system, best, self.iterations - _CASE_ITERATIONS)
        # The comparison is false for NaN.
        solved = (depths.abs() < 1.0 / torch.finfo(depths.dtype).eps).all(0)
        return torch.where(solved, depths, system.maps[2, 0]), solved[0]


class _DepthSystem(NamedTuple):
    """The equations of the four depths. The docstring of the module defines the symbols."""

    coordinates: Tensor  # a, (4, N, B)
    weights: Tensor  # w, normalised to the sum 1, (N, B)
    plane_points: Tensor  # u and v, (2, N, B)
    unit: Tensor  # unit of the depths, the root mean square distance of the points from their centroid, (B,)
    vectors: Tensor  # L, the control vectors of the world divided by `unit`, (3 axes, 3 vectors, B)
    gram: Tensor  # LᵀL, (3, 3, 1, B)
    maps: Tensor  # P, Q and the identity, (3, 4, 4, 1, B)
    error: Tensor  # K, (4, 4, B)
    prior: Tensor  # K times `algebraic_weight`, (4, 4, 1, B)


def _depth_system(control: ControlPoints, problem: Problem, weight: float) -> _DepthSystem:
    """Eliminate the x and y coordinates of the control points; ``weight`` is the ``algebraic_weight``."""
    coordinates, weights = control.coordinates.mT.contiguous(), control.weights[:, None]  # (B, 4, N), (B, 1, N)
    plane_points = (problem.img_points / problem.focal).mT  # (B, 2, N)
    scaled = (plane_points[:, :, None] * coordinates[:, None]).flatten(1, 2)  # (B, 8, N)
    moments = torch.bmm(scaled, (weights * coordinates).mT)  # P and Q, (B, 8, 4)
    # K is computed from squared residuals, because a difference of moments would lose all digits in float32.
    errors = (scaled - torch.bmm(moments, coordinates)).unflatten(1, (2, 4)).transpose(1, 2)  # (B, 4, 2, N)
    error = torch.bmm((weights[:, None] * errors).flatten(2), errors.flatten(2).mT).permute(1, 2, 0)
    eye = torch.eye(4, dtype=weights.dtype, device=weights.device)
    maps = torch.cat((moments, eye.expand(moments.shape[0], 4, 4)), 1)
    maps = maps.permute(1, 2, 0).unflatten(0, (3, 4)).contiguous()
    vectors = control.points[:, 1:].permute(2, 1, 0) / control.radius
    gram = small_product(vectors.transpose(0, 1), vectors)[:, :, None]
    coordinates, plane_points = (x.permute(1, 2, 0).contiguous() for x in (coordinates, plane_points))
    known = coordinates, control.weights.mT, plane_points, control.radius, vectors, gram
    return _DepthSystem(*known, maps[..., None, :], error, weight * error[:, :, None])


def _in_camera(system: _DepthSystem, depths: Tensor) -> Tensor:
    """Camera coordinates (3, 4, C, B) of the centroid and of the control vectors, divided by ``system.unit``."""
    return small_product(system.maps.flatten(0, 1), depths[:, None])[:, 0].unflatten(0, (3, 4))


def _null_space(system: _DepthSystem) -> Tensor:
    """The basis v (4, 4 vectors, B) that makes K nearly diagonal. The depths are z = β₁v₁ + β₂v₂ + β₃v₃ + β₄v₄.

    The centroid has the depth 1 in v₁, and the depth 0 in v₂, v₃ and v₄. The algebraic errors of v₂, v₃ and v₄ ascend.
    """
    error, eye = system.error, torch.eye(4, dtype=system.error.dtype, device=system.error.device)[..., None]
    spread = error[0, 0] + system.maps[:2, 0, 1:, 0].square().sum((0, 1))
    ridge = _TIE * spread * (1.1 * eye[1:, 1:] - system.gram[:, :, 0])
    values, directions = (torch.stack(x, -2) for x in zip(*eigenvectors(error[1:, 1:] + ridge), strict=True))
    along = (error[0, 1:, None] * directions).sum(0) / values  # (3 vectors, B)
    usual = -(along * directions).sum(1, keepdim=True)
    return torch.cat((eye[:1].expand(1, 4, spread.shape[0]), torch.cat((usual, directions), 1)))


def _four_cases(system: _DepthSystem) -> Tensor:
    r"""The depths (4, 4 cases, B) of the paper's four cases, with 1, 2, 3 and 4 null vectors.

    Linear least squares find products of the coefficients :math:`\beta`. Six equations determine at most six products.
    Small products such as :math:`\beta_3^2` are ignored. The four linear systems are leading blocks of one system.
    """
    basis = _null_space(system)
    vectors = _in_camera(system, basis)[:, 1:]  # (3 axes, 3 vectors, 4 null vectors, B)
    left, right = (vectors[:, :, index] for index in map(list, zip(*_PRODUCTS, strict=True)))
    half = (left[:, :, None] * right[:, None]).sum(0)
    rows = (half + half.transpose(0, 1)).flatten(0, 1)  # (9 entries of the Gram matrix, 6 products, B)
    normal = small_product(rows.transpose(0, 1), rows)
    rhs = small_product(rows.transpose(0, 1), system.gram.flatten(0, 1))[:, 0]
    solutions = solve_leading([row.unbind(0) for row in normal.unbind(0)], rhs.unbind(0), (1, 3, 5, 6))
    zero = torch.zeros_like(rhs[0])
    padded = [torch.stack([*x, *[zero] * (6 - len(x))]) for x in solutions]
    square, mixed, other, third, _, fourth = torch.stack(padded, 1).unbind(0)  # ½β₁², β₁β₂, ½β₂², …, (4 cases, B)
    sign = square.sign()
    first = (2.0 * square.abs()).sqrt()
    second = signed((2.0 * sign * other).clamp(min=0.0).sqrt(), sign * mixed)
    inverse = sign / first
    return small_product(basis, torch.stack((first, second, third * inverse, fourth * inverse)))


def _normal_equations(system: _DepthSystem, depths: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    r"""For `_minimize`: the normal matrix (4, 4, C, B), half the gradient (4, C, B), and DᵀD - LᵀL (3, 3, C, B)."""
    vectors = _in_camera(system, depths)[:, 1:]
    columns = vectors.transpose(0, 1)
    misfit = small_product(columns, vectors) - system.gram
    half = small_product(columns, system.maps[:, 1:].flatten(1, 2)).unflatten(1, (3, 4))
    slope = (half + half.transpose(0, 1)).flatten(0, 1)  # (9, 4, C, B)
    normal = small_product(slope.transpose(0, 1), slope) + system.prior
    gradient = small_product(slope.transpose(0, 1), misfit.flatten(0, 1)[:, None])
    return normal, (gradient + small_product(system.prior, depths[:, None]))[:, 0], misfit


def _minimize(system: _DepthSystem, depths: Tensor, iterations: int) -> Tensor:
    r"""Minimise :math:`\|D^\top D - L^\top L\|_F^2 + \mu\, z^\top K z` by Gauss-Newton (paper: six distances)."""
    for _ in range(iterations):
        normal, gradient, _ = _normal_equations(system, depths)
        (step,) = solve_leading([row.unbind(0) for row in normal.unbind(0)], gradient.unbind(0), (4,))
        depths = depths - torch.stack(step)
    return depths


def _attach_gradient(system: _DepthSystem, depths: Tensor, planar: Tensor) -> Tensor:
    r"""Attach gradients to minima (4, 1, B) by the implicit function theorem. Gradients of degenerate minima are 0.

    Two Newton steps with a constant matrix make first and second derivatives exact. The minima do not change.
    """
    with torch.no_grad():
        normal, _, misfit = _normal_equations(system, depths)
        for rows in system.maps[:, 1:].unbind(0):
            normal = normal + 2.0 * small_product(rows.transpose(0, 1), small_product(misfit, rows))
        # The last control vector of planar points is 0. A 1 on the diagonal makes the system regular.
        normal[3, 3] += planar
        eye = torch.eye(4, dtype=depths.dtype, device=depths.device)[..., None].expand_as(normal[:, :, 0])
        columns, solved = solve_positive(normal.expand(-1, -1, 4, -1).flatten(2), eye.flatten(1), depths.new_zeros(()))
        inverse = torch.where(solved, columns, 0.0).unflatten(1, (4, 1, -1))  # (4, 4, 1, B)
    for _ in range(2):
        step = small_product(inverse, _normal_equations(system, depths)[1][:, None])[:, 0]
        depths = depths - step + step.detach()
    return depths


def _frames(one: Tensor, two: Tensor) -> Tensor:
    """Orthonormal axes (3, 3 axes, *) of two vectors (3, *) by Gram-Schmidt."""
    first = one * one.square().sum(0).rsqrt()
    second = torch.addcmul(two, (first * two).sum(0), first, value=-1)
    second = second * second.square().sum(0).rsqrt()
    return torch.stack((first, second, torch.linalg.cross(first, second, dim=0)), 1)


def _best_case(system: _DepthSystem, cases: Tensor) -> Tensor:
    """Index (B,) of the case with the least weighted sum of squared reprojection errors.

    The frames of the first two control vectors give an approximate rotation. Procrustes would take longer.
    """
    camera, world = _in_camera(system, cases), system.vectors[:, :, None]  # (3, 4, C, B), (3, 3, 1, B)
    camera_frames, world_frame = _frames(camera[:, 1], camera[:, 2]), _frames(world[:, 0], world[:, 1])
    turned = small_product(camera_frames, small_product(world_frame.transpose(0, 1), world))  # (3, 3, C, B)
    points = camera[:, 0, :, None]
    for vector, coordinate in zip(turned.unbind(1), system.coordinates[1:], strict=True):
        points = torch.addcmul(points, vector[:, :, None], coordinate)  # (3, C, N, B)
    x, y, z = points.unbind()
    inverse = z.reciprocal()
    u, v = system.plane_points
    x, y = torch.addcmul(-u, x, inverse), torch.addcmul(-v, y, inverse)
    error = (x * x).addcmul_(y, y).clamp_(max=_MAX_SQ_RESIDUAL)
    error = torch.where(z > 0, error, _MAX_SQ_RESIDUAL)  # z > 0 is false for the NaN of a failed case
    return (error * system.weights).sum(1).argmin(0)
