r"""EPnP: a pose from four or more pairs, in closed form and by a few Gauss-Newton steps in four unknowns.

With orthonormal coordinates (see ``kornia_pnpnet.propose.control_points``) the equations
:math:`\sum_j a_{ij} (x_j - u_i z_j) = 0`, and the same with :math:`y` and :math:`v`, are solved for x and y in closed
form: :math:`x = P z` with :math:`P = \sum_i w_i u_i a_i a_i^\top`, and :math:`y = Q z` with :math:`v_i`. The remaining
algebraic error :math:`z^\top K z` has 4 unknowns where the paper's :math:`M^\top M` has 12. The control vectors in the
camera frame are the columns of a 3 by 3 matrix :math:`D(z)`. They are the rotated control vectors :math:`L` of the
world when :math:`D^\top D = L^\top L`. Arrays have the problems in the last dimension.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_whole
from kornia_pnpnet.core.linalg import (
    dot,
    eigenvectors,
    nearest_rotation,
    small_product,
    solve_leading,
    solve_positive,
)
from kornia_pnpnet.problem import Problem, Starts
from kornia_pnpnet.propose.control_points import ControlPoints, control_points
from kornia_pnpnet.propose.initialiser import Initialiser
from kornia_pnpnet.result import Pose

__all__ = ["EPnP"]

# Number of pairs below which a problem is not `ok`: EPnP is defined from four pairs on.
_MIN_PAIRS = 4
# Number of pairs that must be in front of the camera: fewer do not determine a pose.
_MIN_IN_FRONT = 3
# Number of Gauss-Newton steps of every case before the best case is chosen.
_CASE_ITERATIONS = 2
# Squared focal lengths. Larger squared reprojection errors, and points behind the camera, count as this error.
_MAX_SQ_RESIDUAL = 4.0
# Share of the squared spread of the pixels. A ridge of this size breaks ties between null vectors: equal depths come
# first, then tilts along the world's longest extents. It affects where the iterations start, not where they end.
_TIE = 1e-4
# Upper entries of the Gram matrix of the three control vectors; an entry is the equation of an "edge".
_EDGES = [(i, j) for i in range(1, 4) for j in range(i, 4)]


class EPnP(Initialiser):
    r"""EPnP with weights, planar points and gradients, for batches.

    The control points in the camera frame are a combination of the null vectors of the projection equations that keeps
    the distances of the world. Gauss-Newton starts from four cases, N = 1 … 4 null vectors; the case with the least
    weighted reprojection error is aligned with the world (orthogonal Procrustes).

    Source: V. Lepetit, F. Moreno-Noguer and P. Fua, "EPnP: An Accurate O(n) Solution to the PnP Problem", IJCV 2009.
    Ours are the elimination of two thirds of the unknowns (see the module), the order of the null vectors (by their
    algebraic error at equal depth of the centroid, not at equal length), a norm of the distances that does not depend
    on the choice of the control points, and the algebraic error as a part of the objective: with a dozen noisy pairs
    the null vectors are not equally free. Planar points use the same equations, with 0 as the fourth control point.

    Four or five pairs leave up to four solutions, and the solution with the least reprojection error may be incorrect.
    A problem is not ``ok`` with fewer than four pairs, with points on a line, and when fewer than three pairs are in
    front of the camera. Gradients to points, pixels and weights are those of the minimum, by the implicit function
    theorem.

    Args:
        iterations: number of Gauss-Newton steps, at least 2: two steps in every case, the other steps in the best case.
        algebraic_weight: :math:`\mu \ge 0`, weight of the algebraic error relative to the squared error of the
            distances, for a world of unit root mean square radius and pixels over the focal length; 0 in the paper.

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
        r"""Find the pose.

        Args:
            problem: the problem in the solver's frame.

        Returns:
            The pose, weights of 1, and ``ok``. Where ``ok`` is false the pose is finite.
        """
        problem = problem._replace(weights=problem.usual_weights)
        control = control_points(problem)
        plane_points = (problem.img_points.permute(2, 1, 0) / problem.focal).contiguous()  # (2, N, B)
        system = _depth_system(control, plane_points, self.algebraic_weight)
        with torch.no_grad():
            depths, solved = self._depths(system)
        if system.error.requires_grad:
            depths = _attach_gradient(system, depths)

        vectors = system.vectors
        camera = torch.stack(_in_camera(system, depths))[:, :, 0]  # (3, 4, B)
        affine = camera[:, 1:]
        rotation, unique = nearest_rotation(small_product(affine, vectors.transpose(0, 1)))
        # The control points miss their distances a little. The scale restores the known size of the world.
        size = affine.square().sum((0, 1))
        scale = (small_product(rotation, vectors) * affine).sum((0, 1)) / torch.where(size > 0, size, 1.0)
        offset = dot(rotation.unbind(1), control.points[:, 0].mT.unbind(0))
        translation = camera[:, 0] * (scale * system.unit) - offset  # (3, B)

        there = problem.weights.mT > 0
        depth = dot(rotation[2].unbind(0), problem.world_points.permute(2, 1, 0).unbind(0)) + translation[2]  # (N, B)
        ok = solved & unique & (there.sum(0) >= _MIN_PAIRS)
        ok = ok & ((there & (depth > 0)).sum(0) >= _MIN_IN_FRONT)
        pose = Pose(rotation.permute(2, 0, 1).contiguous(), translation.mT.contiguous())
        return Starts(pose, torch.ones_like(problem.weights), ok)

    def _depths(self, system: _DepthSystem) -> tuple[Tensor, Tensor]:
        """The depths (4, 1, B) of the best case, and whether they were found (B,); where not, equal depths."""
        cases = _four_cases(system).detach()  # forward mode starts here: the square roots of 0 have no derivative
        # A shape and its mirror image along the optical axis have the same distances, and Gauss-Newton does not change
        # the one into the other: symmetric points need both.
        mirrored = torch.cat((cases[:1, -1:], -cases[1:, -1:]))
        cases = _minimize(system, torch.cat((cases, mirrored), 1), _CASE_ITERATIONS)
        best = cases.gather(1, _best_case(system, cases).expand(4, 1, -1))
        depths = _minimize(system, best, self.iterations - _CASE_ITERATIONS)
        # Depths beyond the precision of the dtype are a failure; NaN compares false.
        solved = (depths.abs() < 1.0 / torch.finfo(depths.dtype).eps).all(0)
        return torch.where(solved, depths, system.maps[2][0]), solved[0]


class _DepthSystem(NamedTuple):
    """The equations of depths (4, C, B): C candidates for each problem."""

    control: ControlPoints
    plane_points: Tensor  # (u, v), (2, N, B)
    unit: Tensor  # unit of the depths: the root mean square distance of the points from their centroid, (B,)
    vectors: Tensor  # the control vectors of the world in this unit, (3 axes, 3 vectors, B)
    maps: tuple[tuple[Tensor, ...], ...]  # rows (4, 1, B) of P, Q and the identity: x = P z, y = Q z, z
    error: Tensor  # K, (4, 4, 1, B)
    prior: Tensor  # half the weighted algebraic error, (4, 4, 1, B)
    gram: Tensor  # the Gram matrix of the vectors, whose trace is 1, (3, 3, B)
    target: dict[tuple[int, int], Tensor]  # minus its entry of each edge, (B,)


def _depth_system(control: ControlPoints, plane_points: Tensor, weight: float) -> _DepthSystem:
    """Eliminate the x and y coordinates of the control points."""
    coordinates, weights = control.coordinates.permute(2, 1, 0), control.weights.mT
    scaled = plane_points[:, None] * coordinates  # (2, 4, N, B)
    moments = [((weights * a) * scaled).sum(2, keepdim=True) for a in coordinates]  # (2, 4, 1, B) each
    # K is a sum of squared residuals of the elimination. As a difference of moments float32 would lose it.
    errors = scaled
    for a, moment in zip(coordinates, moments, strict=True):
        errors = torch.addcmul(errors, a, moment, value=-1)
    weighted = weights * errors
    quadratic = torch.stack([(weighted[:, j, None] * errors).sum((0, 2)) for j in range(4)])[:, :, None]
    first, second = torch.stack(moments).unbind(1)  # (4, 4, 1, B) each
    eye = torch.eye(4, dtype=weights.dtype, device=weights.device)[..., None, None]
    mean_square = control.points[:, 1:].square().sum((1, 2))
    unit = torch.where(control.ok, mean_square, 1.0).sqrt()
    vectors = control.points[:, 1:].permute(2, 1, 0) / unit
    gram = small_product(vectors.transpose(0, 1), vectors)
    target = {(k, j): -gram[k - 1, j - 1] for k, j in _EDGES}
    maps = first.unbind(), second.unbind(), eye.unbind()
    prior = 0.5 * weight * quadratic
    return _DepthSystem(control, plane_points, unit, vectors, maps, quadratic, prior, gram, target)


def _in_camera(system: _DepthSystem, depths: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """x, y and z of the centroid and the vectors in units of ``system.unit``, (4, C, B) each."""
    z = depths.unbind(0)
    return dot(system.maps[0], z), dot(system.maps[1], z), depths  # P is symmetric: its rows are its columns


def _null_space(system: _DepthSystem) -> Tensor:
    """A basis of depths in the order of their algebraic error, (4, 4 vectors, B): z = β₁v₁ + β₂v₂ + β₃v₃ + β₄v₄.

    The first vector has the least error with the centroid at depth 1. The other vectors have the centroid at depth 0;
    they are the eigenvectors of the rest of K, so that K is diagonal in this basis.
    """
    error = system.error[:, :, 0]
    first, second = (rows[0][1:, 0] for rows in system.maps[:2])  # (3, B) each
    spread = error[0, 0] + (first.square() + second.square()).sum(0)
    eye = torch.eye(3, dtype=error.dtype, device=error.device)[..., None]
    usual = torch.zeros_like(first)
    directions = []
    for value, direction in eigenvectors(torch.addcmul(error[1:, 1:], _TIE * spread, 1.1 * eye - system.gram)):
        along = dot(error[0, 1:].unbind(0), direction.unbind(0)) / value
        usual = torch.addcmul(usual, along, direction, value=-1)
        directions.append(direction)
    top = system.maps[2][0][:, 0].expand(1, 4, *spread.shape)
    return torch.cat((top, torch.stack((usual, *directions), 1)))


def _four_cases(system: _DepthSystem) -> Tensor:
    r"""The depths of the paper's four cases, which differ in the number of null vectors, (4, 4 cases, B).

    For :math:`N = 1, 2, 3` the products of the betas are found by least squares; for N = 3 without :math:`\beta_3^2`,
    the smallest product. N = 4 adds :math:`\beta_1 \beta_4`, so that there are as many unknowns as equations (the paper
    linearises the four remaining products again). The systems of all cases are leading blocks of one system.
    """
    basis = _null_space(system)
    camera = [axis.unbind(0) for axis in _in_camera(system, basis)]  # (4 vectors, B) for each axis and control point
    single = [[control.unbind(0) for control in axis] for axis in camera]
    normal, rhs = basis.new_zeros(6, 6, basis.shape[-1]), basis.new_zeros(6, basis.shape[-1])
    for k, j in _EDGES:
        sides = [(k, j), (j, k)] if k != j else [(k, j)]
        terms = [(axis, *side) for axis in range(3) for side in sides]
        # The unknowns are ½β₁², β₁β₂, β₁β₃, β₁β₄, ½β₂², β₂β₃; the equation of an edge with itself is halved.
        parts = [
            dot((single[c][a][m] for c, a, _ in terms), (camera[c][b][others] for c, _, b in terms))
            for m, others in ((0, slice(0, 4)), (1, slice(1, 3)))
        ]
        row = torch.cat(parts)  # (6, B)
        weight, half = (2.0, 1.0) if k != j else (4.0, 0.5)
        normal.addcmul_(row[:, None], row, value=weight)
        rhs.addcmul_(system.target[k, j], row, value=-half * weight)
    nested = (0, 1, 4, 2, 5, 3)
    rows, right = [row.unbind(0) for row in normal.unbind(0)], rhs.unbind(0)
    solutions = solve_leading([[rows[i][j] for j in nested] for i in nested], [right[i] for i in nested], (1, 3, 5, 6))
    zero = torch.zeros_like(right[0])
    padded = [torch.stack([*x, *[zero] * (6 - len(x))]) for x in solutions]
    square, mixed, other, third, _, fourth = torch.stack(padded, 1).unbind(0)  # (4 cases, B) each
    sign = square.sign()
    first = (2.0 * square.abs()).sqrt()
    second = (2.0 * sign * other).clamp(min=0.0).sqrt().copysign(sign * mixed)
    inverse = sign / first
    return dot(basis[:, :, None].unbind(1), (first, second, third * inverse, fourth * inverse))


def _normal_equations(system: _DepthSystem, depths: Tensor) -> tuple[Tensor, Tensor, dict[tuple[int, int], Tensor]]:
    r"""Half of :math:`J^\top J` (4, 4, C, B) and of :math:`J^\top r` (4, C, B), and the misfits of the edges (C, B)."""
    p, q, axes = system.maps
    normal, misfits = system.prior.expand(4, *depths.shape).clone(), {}
    gradient = dot(system.prior.unbind(0), depths.unbind(0))
    x, y, z = (axis.unbind(0) for axis in _in_camera(system, depths))
    for k, j in _EDGES:
        misfits[k, j] = misfit = (
            torch.addcmul(system.target[k, j], x[k], x[j]).addcmul_(y[k], y[j]).addcmul_(z[k], z[j])
        )
        slope = (x[k] * p[j]).addcmul_(y[k], q[j]).addcmul_(z[k], axes[j])
        if k != j:
            slope.addcmul_(x[j], p[k]).addcmul_(y[j], q[k]).addcmul_(z[j], axes[k])
        # A diagonal entry of the Gram matrix appears once in the Frobenius norm, and its slope is halved; the other
        # entries appear twice.
        normal.addcmul_(slope[:, None], slope, value=1.0 if k != j else 2.0)
        gradient.addcmul_(slope, misfit)
    return normal, gradient, misfits


def _minimize(system: _DepthSystem, depths: Tensor, iterations: int) -> Tensor:
    r"""Gauss-Newton on :math:`\|D^\top D - L^\top L\|_F^2 + \mu\, z^\top K z`.

    The six entries of the Gram matrix are equivalent to the paper's six distances between control points.
    """
    for _ in range(iterations):
        normal, gradient, _ = _normal_equations(system, depths)
        (step,) = solve_leading((row.unbind(0) for row in normal.unbind(0)), gradient.unbind(0), (4,))
        depths = depths - torch.stack(step)
    return depths


def _attach_gradient(system: _DepthSystem, depths: Tensor) -> Tensor:
    r"""Give a minimum (4, 1, B) its gradient by the implicit function theorem; 0 where the minimum is not isolated.

    The result has the value of ``depths`` and the derivatives of two Newton steps with a constant matrix: the first
    step makes first derivatives exact, the second step second derivatives.
    """
    depths = depths.detach()
    normal, gradient, misfits = _normal_equations(system, depths)
    with torch.no_grad():
        entries = [misfits[min(i, j), max(i, j)] for i in range(1, 4) for j in range(1, 4)]
        misfit = torch.stack(entries).unflatten(0, (3, 3))
        for rows in system.maps:
            matrix = torch.stack(rows[1:])
            normal = normal + small_product(matrix.transpose(0, 1), small_product(misfit, matrix))
        # The depth of the third vector of planar points is always 0: an identity row keeps the system regular.
        normal[3, 3] += system.control.planar
        # The four columns of the inverse, one system each.
        eye = torch.eye(4, dtype=depths.dtype, device=depths.device)[..., None].expand_as(normal[:, :, 0])
        repeated = normal.expand(-1, -1, 4, -1).flatten(2)
        columns, solved = solve_positive(repeated, eye.flatten(1), depths.new_zeros(()))
        inverse = torch.where(solved, columns, 0.0).unflatten(1, (4, 1, -1))  # (4, 4, 1, B)
    for again in (True, False):
        step = small_product(inverse, gradient[:, None])[:, 0]
        depths = depths - step + step.detach()
        if again:
            gradient = _normal_equations(system, depths)[1]
    return depths


def _frame(one: Tensor, two: Tensor) -> Tensor:
    """Orthonormal axes (3, 3 axes, *) from two vectors (3, *) by Gram-Schmidt."""
    first = one * dot(one.unbind(), one.unbind()).rsqrt()
    second = torch.addcmul(two, dot(first.unbind(), two.unbind()), first, value=-1)
    second = second * dot(second.unbind(), second.unbind()).rsqrt()
    return torch.stack((first, second, torch.linalg.cross(first, second, dim=0)), 1)


def _best_case(system: _DepthSystem, cases: Tensor) -> Tensor:
    """Number (B,) of the case with the least weighted sum of squared reprojection errors, of depths (4, C, B).

    The control vectors of a case are nearly the rotated control vectors of the world. The rotation between frames of
    two of these vectors, which is faster, replaces Procrustes.
    """
    camera, world = torch.stack(_in_camera(system, cases)), system.vectors[:, :, None]  # (3, 4, C, B), (3, 3, 1, B)
    world_frame = _frame(world[:, 0], world[:, 1]).transpose(0, 1)
    turned = small_product(small_product(_frame(camera[:, 1], camera[:, 2]), world_frame), world)  # (3, 3, C, B)
    points = camera[:, 0, :, None]
    for vector, coordinate in zip(turned.unbind(1), system.control.coordinates.permute(2, 1, 0)[1:], strict=True):
        points = torch.addcmul(points, vector[:, :, None], coordinate)  # (3, C, N, B)
    x, y, z = points.unbind()
    inverse = z.reciprocal()
    u, v = system.plane_points
    x, y = torch.addcmul(-u, x, inverse), torch.addcmul(-v, y, inverse)
    error = (x * x).addcmul_(y, y).clamp_(max=_MAX_SQ_RESIDUAL)
    error = torch.where(z > 0, error, _MAX_SQ_RESIDUAL)  # failed cases, too: NaN compares false
    return (error * system.control.weights.mT).sum(1).argmin(0)
