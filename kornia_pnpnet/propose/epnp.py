r"""EPnP: a pose from four or more pairs, in closed form and by a few Gauss-Newton steps in four unknowns.

A world point is a combination of control points, :math:`p_i = \sum_j a_{ij} c_j`. The coordinates :math:`a_{ij}` of the
point are the same in the world frame and in the camera frame. Lepetit et al. use four control points :math:`c_j` and
barycentric coordinates. Here :math:`c_0` is the centroid, and :math:`c_1, c_2, c_3` are *vectors* from the centroid.
The coordinates are then orthonormal, :math:`\sum_i w_i a_i a_i^\top = I`, and the results do not depend on the axes of
the world.

The projection equations are :math:`\sum_j a_{ij} (x_j - u_i z_j) = 0` and :math:`\sum_j a_{ij} (y_j - v_i z_j) = 0`.
Their least-squares solutions for given depths are :math:`x = P z` and :math:`y = Q z`, with
:math:`P = \sum_i w_i u_i a_i a_i^\top` and :math:`Q = \sum_i w_i v_i a_i a_i^\top`. The remaining algebraic error
:math:`z^\top K z` has 4 unknowns, whereas the paper's :math:`M^\top M` has 12. The control vectors in the camera frame
are the columns of a 3 by 3 matrix :math:`D(z)`, and the control vectors in the world are the columns of :math:`L`. The
two sets differ by a rotation or reflection when :math:`D^\top D = L^\top L`. Arrays (4, C, B) hold the depths of C
candidates.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_whole
from kornia_pnpnet.core.linalg import eigenvectors, nearest_rotation, small_product, solve_leading, solve_positive
from kornia_pnpnet.problem import Problem, Starts
from kornia_pnpnet.propose.initialiser import Initialiser
from kornia_pnpnet.result import Pose

__all__ = ["ControlPoints", "EPnP", "control_points"]

# Points are planar when their extent across the plane is below this fraction of their extent along the plane.
_PLANAR_RATIO = 1e-3
# Least number of pairs of a problem that is `ok`: EPnP needs four pairs.
_MIN_PAIRS = 4
# Least number of pairs in front of the camera: fewer pairs do not determine a pose.
_MIN_IN_FRONT = 3
# Number of Gauss-Newton steps in each case before the best case is chosen.
_CASE_ITERATIONS = 2
# Squared focal lengths. Upper bound of a squared reprojection error; a point behind the camera has this error.
_MAX_SQ_RESIDUAL = 4.0
# Share of the squared spread of the pixels. A ridge of this size orders null vectors of equal error: equal depths come
# first, then tilts along the longest extents of the world. The ridge affects only the start of the iterations.
_TIE = 1e-4
# Indices (m, n) of the products βₘβₙ of null-vector coefficients that are unknowns of the four cases, in order of use.
_PRODUCTS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (0, 3))


class ControlPoints(NamedTuple):
    """Control points, coordinates and weights of the pairs; the batch is the last dimension in memory."""

    points: Tensor  # the centroid and three vectors, a square root of the covariance; c_3 is 0 if planar, (B, 4, 3)
    coordinates: Tensor  # `coordinates @ points` are the world points; the last column is 0 if planar, (B, N, 4)
    weights: Tensor  # with the sum 1, (B, N)
    planar: Tensor  # whether the points lie in one plane (or on a line), bool, (B,)
    ok: Tensor  # whether the points span more than a line, bool, (B,)


def control_points(problem: Problem) -> ControlPoints:
    r"""Choose the control points by weighted Gram-Schmidt on the coordinates of the world points.

    Each of three steps selects the axis along which the points spread most, and projects this axis out of the others.
    The paper uses principal directions instead: they cost an eigendecomposition and have no gradient where two extents
    are equal.

    Args:
        problem: the problem. Pairs with the weight 0 are ignored.

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
    # A variance below the limit is rounding. The first limit is absolute; later limits are relative to the previous
    # variance.
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
    return ControlPoints(points, coordinates, weights.mT, ~found[2], found[1])


class EPnP(Initialiser):
    r"""EPnP with weights, planar points and gradients, for batches.

    The control points in the camera frame are a combination of the null vectors of the projection equations. The
    combination has to preserve the distances between the control points. Gauss-Newton starts from four cases with 1 to
    4 null vectors. The case with the least weighted reprojection error is aligned with the world (orthogonal
    Procrustes).

    Source: V. Lepetit, F. Moreno-Noguer and P. Fua, "EPnP: An Accurate O(n) Solution to the PnP Problem", IJCV 2009.
    Four things differ from the paper. Two thirds of the unknowns are eliminated (see the module). The null vectors are
    ordered by their algebraic error at equal depth of the centroid. The norm of the distances does not depend on the
    choice of the control points. The objective includes the algebraic error, because the null vectors of about twelve
    noisy pairs have different errors. Planar points use the same equations, with 0 as the fourth control point.

    Four or five pairs can have up to four solutions, and the solution with the least reprojection error may be
    incorrect. A problem is not ``ok`` with fewer than four pairs, with points on a line, and when fewer than three
    pairs are in front of the camera. The implicit function theorem gives the gradient of the minimum.

    Args:
        iterations: number of Gauss-Newton steps, at least 2. Every case takes two steps; the best case takes the rest.
        algebraic_weight: :math:`\mu \ge 0`, weight of the algebraic error relative to the squared error of the
            distances. Both errors are measured in a world with a root mean square radius of 1, for pixels over the
            focal length. In the paper the weight is 0.

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
        """Find the pose in the solver's frame. All weights are 1, and a pose that is not ``ok`` is finite, too."""
        problem = problem._replace(weights=problem.usual_weights)
        control = control_points(problem)
        system = _depth_system(control, problem, self.algebraic_weight)
        with torch.no_grad():
            depths, solved = self._depths(system)
        if system.prior.requires_grad:
            depths = _attach_gradient(system, depths, control.planar)

        camera = _in_camera(system, depths)[:, :, 0]  # (3, 4, B)
        affine = camera[:, 1:]
        moment = small_product(affine, system.vectors.transpose(0, 1))
        turn, unique = nearest_rotation(moment)
        # The distances of the control points are slightly incorrect. The scale restores the known size of the world.
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
        """Depths (4, 1, B) of the best case, and whether the case succeeded, bool (B,); equal depths if it failed."""
        cases = _four_cases(system).detach()  # also in forward mode: sqrt has no derivative at 0
        # A shape and its mirror image along the optical axis have the same distances, and Gauss-Newton does not turn
        # the shape into the mirror image. Symmetric points therefore need both starts.
        mirrored = torch.cat((cases[:1, -1:], -cases[1:, -1:]))
        cases = _minimize(system, torch.cat((cases, mirrored), 1), _CASE_ITERATIONS)
        best = cases.gather(1, _best_case(system, cases).expand(4, 1, -1))
        depths = _minimize(system, best, self.iterations - _CASE_ITERATIONS)
        # Depths beyond the precision of the dtype are a failure; NaN compares false.
        solved = (depths.abs() < 1.0 / torch.finfo(depths.dtype).eps).all(0)
        return torch.where(solved, depths, system.maps[2, 0]), solved[0]


class _DepthSystem(NamedTuple):
    """The equations of depths (4, C, B)."""

    coordinates: Tensor  # a, (4, N, B)
    weights: Tensor  # with the sum 1, (N, B)
    plane_points: Tensor  # (u, v), (2, N, B)
    unit: Tensor  # unit of the depths: the root mean square distance of the points from their centroid, (B,)
    vectors: Tensor  # the control vectors of the world, divided by `unit`, (3 axes, 3 vectors, B)
    gram: Tensor  # the Gram matrix of the vectors, with the trace 1, (3, 3, 1, B)
    maps: Tensor  # P, Q and the identity, the maps from z to x, y and z, (3, 4, 4, 1, B)
    error: Tensor  # K, (4, 4, B)
    prior: Tensor  # K times the weight of the algebraic error, (4, 4, 1, B)


def _depth_system(control: ControlPoints, problem: Problem, weight: float) -> _DepthSystem:
    """Eliminate the x and y coordinates of the control points."""
    coordinates, weights = control.coordinates.mT.contiguous(), control.weights[:, None]  # (B, 4, N), (B, 1, N)
    plane_points = (problem.img_points / problem.focal).mT  # (B, 2, N)
    scaled = (plane_points[:, :, None] * coordinates[:, None]).flatten(1, 2)  # (B, 8, N)
    moments = torch.bmm(scaled, (weights * coordinates).mT)  # P and Q, (B, 8, 4)
    # K is computed as a sum of squared residuals. A difference of moments would lose all digits in float32.
    errors = (scaled - torch.bmm(moments, coordinates)).unflatten(1, (2, 4)).transpose(1, 2)  # (B, 4, 2, N)
    error = torch.bmm((weights[:, None] * errors).flatten(2), errors.flatten(2).mT).permute(1, 2, 0)
    eye = torch.eye(4, dtype=weights.dtype, device=weights.device)
    maps = torch.cat((moments, eye.expand(len(moments), 4, 4)), 1).permute(1, 2, 0).unflatten(0, (3, 4)).contiguous()
    mean_square = control.points[:, 1:].square().sum((1, 2))
    unit = torch.where(control.ok, mean_square, 1.0).sqrt()
    vectors = control.points[:, 1:].permute(2, 1, 0) / unit
    gram = small_product(vectors.transpose(0, 1), vectors)[:, :, None]
    last = (x.permute(1, 2, 0).contiguous() for x in (coordinates, plane_points))
    return _DepthSystem(
        next(last),
        control.weights.mT,
        next(last),
        unit,
        vectors,
        gram,
        maps[..., None, :],
        error,
        weight * error[:, :, None],
    )


def _in_camera(system: _DepthSystem, depths: Tensor) -> Tensor:
    """Camera coordinates of the centroid and of the control vectors, divided by ``system.unit``, (3, 4, C, B)."""
    return small_product(system.maps.flatten(0, 1), depths[:, None])[:, 0].unflatten(0, (3, 4))


def _null_space(system: _DepthSystem) -> Tensor:
    """A basis of depths in the order of their algebraic error, (4, 4 vectors, B): z = β₁v₁ + β₂v₂ + β₃v₃ + β₄v₄.

    The first vector has the least error of all depths with the centroid at depth 1. The other vectors have the centroid
    at depth 0. They are the eigenvectors of the lower right 3 by 3 block of K, so that K is diagonal in this basis.
    """
    error, eye = system.error, torch.eye(4, dtype=system.error.dtype, device=system.error.device)[..., None]
    spread = error[0, 0] + system.maps[:2, 0, 1:, 0].square().sum((0, 1))
    ridge = _TIE * spread * (1.1 * eye[1:, 1:] - system.gram[:, :, 0])
    values, directions = (torch.stack(x, -2) for x in zip(*eigenvectors(error[1:, 1:] + ridge), strict=True))
    along = (error[0, 1:, None] * directions).sum(0) / values  # (3 vectors, B)
    usual = -(along * directions).sum(1, keepdim=True)
    return torch.cat((eye[:1].expand(1, 4, len(spread)), torch.cat((usual, directions), 1)))


def _four_cases(system: _DepthSystem) -> Tensor:
    r"""The depths of the paper's four cases, which use N = 1, 2, 3 and 4 null vectors, (4, 4 cases, B).

    Least squares find the products of the betas. The case N = 3 omits the smallest product :math:`\beta_3^2`. The case
    N = 4 adds :math:`\beta_1 \beta_4`, so that the six equations have six unknowns. (The paper linearises the four
    remaining products again.) The systems of all cases are leading blocks of one system.
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
    square, mixed, other, third, _, fourth = torch.stack(padded, 1).unbind(0)  # (4 cases, B), of ½β₁², β₁β₂, ½β₂², …
    sign = square.sign()
    first = (2.0 * square.abs()).sqrt()
    second = (2.0 * sign * other).clamp(min=0.0).sqrt().copysign(sign * mixed)
    inverse = sign / first
    return small_product(basis, torch.stack((first, second, third * inverse, fourth * inverse)))


def _normal_equations(system: _DepthSystem, depths: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    r"""Half of the Gauss-Newton matrix (4, 4, C, B), half of the gradient (4, C, B), and the misfits (3, 3, C, B)."""
    vectors = _in_camera(system, depths)[:, 1:]
    columns = vectors.transpose(0, 1)
    misfit = small_product(columns, vectors) - system.gram
    half = small_product(columns, system.maps[:, 1:].flatten(1, 2)).unflatten(1, (3, 4))
    slope = (half + half.transpose(0, 1)).flatten(0, 1)  # (9, 4, C, B)
    normal = small_product(slope.transpose(0, 1), slope) + system.prior
    gradient = small_product(slope.transpose(0, 1), misfit.flatten(0, 1)[:, None])
    return normal, (gradient + small_product(system.prior, depths[:, None]))[:, 0], misfit


def _minimize(system: _DepthSystem, depths: Tensor, iterations: int) -> Tensor:
    r"""Gauss-Newton on :math:`\|D^\top D - L^\top L\|_F^2 + \mu\, z^\top K z`.

    The six entries of the Gram matrix are equivalent to the paper's six distances between control points.
    """
    for _ in range(iterations):
        normal, gradient, _ = _normal_equations(system, depths)
        (step,) = solve_leading([row.unbind(0) for row in normal.unbind(0)], gradient.unbind(0), (4,))
        depths = depths - torch.stack(step)
    return depths


def _attach_gradient(system: _DepthSystem, depths: Tensor, planar: Tensor) -> Tensor:
    r"""Give a minimum (4, 1, B) its gradient by the implicit function theorem; 0 where the minimum is not isolated.

    The result has the value of ``depths`` and the derivatives of two Newton steps with a constant matrix. One step
    makes first derivatives exact; two steps make second derivatives exact.
    """
    with torch.no_grad():
        normal, _, misfit = _normal_equations(system, depths)
        for rows in system.maps[:, 1:].unbind(0):
            normal = normal + 2.0 * small_product(rows.transpose(0, 1), small_product(misfit, rows))
        # The third vector of planar points always has depth 0. A 1 on the diagonal keeps the system regular.
        normal[3, 3] += planar
        eye = torch.eye(4, dtype=depths.dtype, device=depths.device)[..., None].expand_as(normal[:, :, 0])
        columns, solved = solve_positive(normal.expand(-1, -1, 4, -1).flatten(2), eye.flatten(1), depths.new_zeros(()))
        inverse = torch.where(solved, columns, 0.0).unflatten(1, (4, 1, -1))  # (4, 4, 1, B)
    for _ in range(2):
        step = small_product(inverse, _normal_equations(system, depths)[1][:, None])[:, 0]
        depths = depths - step + step.detach()
    return depths


def _frames(one: Tensor, two: Tensor) -> Tensor:
    """Orthonormal axes (3, 3 axes, *) from two vectors (3, *) by Gram-Schmidt."""
    first = one * one.square().sum(0).rsqrt()
    second = torch.addcmul(two, (first * two).sum(0), first, value=-1)
    second = second * second.square().sum(0).rsqrt()
    return torch.stack((first, second, torch.linalg.cross(first, second, dim=0)), 1)


def _best_case(system: _DepthSystem, cases: Tensor) -> Tensor:
    """Index (B,) of the case with the least weighted sum of squared reprojection errors, of depths (4, C, B).

    The control vectors of a case are nearly the rotated control vectors of the world. The rotation is computed from
    frames of two of these vectors, which is faster than Procrustes.
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
    error = torch.where(z > 0, error, _MAX_SQ_RESIDUAL)  # also in failed cases: NaN compares false
    return (error * system.weights).sum(1).argmin(0)
