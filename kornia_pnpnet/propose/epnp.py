r"""EPnP: a pose from four or more pairs, in closed form and by a few Gauss-Newton steps in four unknowns.

With orthonormal coordinates (see :mod:`~kornia_pnpnet.propose.control_points`) the equations
:math:`\sum_j a_{ij} (x_j - u_i z_j) = 0`, and the same with :math:`y` and :math:`v`, are solved for x and y in closed
form: :math:`x = P z` with :math:`P = \sum_i w_i u_i a_i a_i^\top`, and :math:`y = Q z` with :math:`v_i` instead of
:math:`u_i`. The remaining algebraic error :math:`z^\top K z` has 4 unknowns where the paper's :math:`M^\top M` has 12,
and every :math:`z` is a candidate, as in the paper's null space for N = 4. The control vectors in the camera frame are
the columns of a 3 by 3 matrix :math:`D(z)`. They are the rotated control vectors :math:`L` of the world when
:math:`D^\top D = L^\top L`. Arrays have the problems in the last dimension.
"""

from __future__ import annotations

from collections.abc import Sequence
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
# Upper entries of a symmetric 4 by 4 matrix.
_UPPER = [(i, j) for i in range(4) for j in range(i, 4)]
# Upper entries of the Gram matrix of the three control vectors; an entry is the equation of an "edge".
_EDGES = [(i, j) for i in range(3) for j in range(i, 3)]


class EPnP(Initialiser):
    r"""EPnP with weights, planar points and gradients, for batches.

    The control points in the camera frame are a combination of the null vectors of the projection equations. The
    coefficients are chosen so that the control points have the same distances from each other as in the world. Four
    cases, N = 1 … 4 null vectors, start Gauss-Newton, and the case with the least weighted reprojection error is
    selected (a point behind the camera counts as an error of two focal lengths). The pose moves the control points of
    the world to the control points in the camera frame (orthogonal Procrustes).

    Source: V. Lepetit, F. Moreno-Noguer and P. Fua, "EPnP: An Accurate O(n) Solution to the PnP Problem", IJCV 2009.
    Our changes are for accuracy, for speed, and to avoid eigenvectors of equal eigenvalues:

    - Two thirds of the 12 unknowns are eliminated (see the module); the depths of the control
      points remain. The null vectors are ordered by their algebraic error at equal depth of the centroid instead of
      equal length. Where fewer than six pairs leave several null vectors, the vectors along the world's longest
      extents come first.
    - The distances are compared in a norm that does not depend on the choice of the control points. The algebraic
      error stays in the objective with the weight ``algebraic_weight``, since with a dozen noisy pairs the null
      vectors are not equally free. The weight 0 is the paper's method.
    - Planar points use the same equations, with 0 as the fourth control point.

    Four or five pairs leave up to four solutions in the null space, and the solution with the least reprojection error
    may be wrong. A problem is not ``ok`` with fewer than four pairs, with points on a line, and when fewer than three
    pairs are in front of the camera.

    Gradients to points, pixels and weights are first derivatives of the minimum that Gauss-Newton found, by the
    implicit function theorem. The choice among the cases is not differentiated.

    Args:
        iterations: number of Gauss-Newton steps, at least 2: two steps in every case, the other steps in the best case.
        algebraic_weight: :math:`\mu \ge 0`, weight of the algebraic error relative to the squared error of the
            distances, for points of unit root mean square distance from their centroid and pixels over the focal
            length.

    Raises:
        BaseError: when an argument is out of its range.

    Example:
        >>> from kornia_pnpnet import Normalize
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> from kornia_pnpnet.metrics import pose_errors
        >>> noiseless = SyntheticProblems(n=6, batch_size=2, world_sigma=0.0, img_sigma=0.0, dtype=torch.float64)
        >>> problems, normalize = noiseless.batch(0), Normalize()
        >>> problem, frame = normalize(problems.world_points, problems.img_points, problems.intrinsics)
        >>> starts = EPnP()(problem)
        >>> pose_errors(normalize.undo(starts.pose, frame), problems.pose).translation_error < 1e-6, starts.ok
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
        system = _depth_system(control, plane_points)
        vectors = control.points[:, 1:].permute(2, 1, 0) / system.unit  # (3 axes, 3 vectors, B)
        with torch.no_grad():
            depths, solved = self._depths(system, control, plane_points, vectors)
        if system.error.requires_grad:
            depths = _attach_gradient(system, depths, control.planar, self.algebraic_weight)

        camera = torch.stack(_in_camera(system, depths))  # (3, 4, B)
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

    def _depths(
        self, system: _DepthSystem, control: ControlPoints, plane_points: Tensor, vectors: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The depths (4, B) of the best case, and whether they were found (B,); where not, equal depths."""
        cases = _four_cases(system).detach()  # forward mode starts here: the square roots of 0 have no derivative
        # The distances do not tell a shape from its mirror image along the optical axis, and Gauss-Newton does not
        # change the one into the other: symmetric points need both.
        mirrored = torch.cat((cases[:1, -1:], -cases[1:, -1:]))
        cases = _minimize(system, torch.cat((cases, mirrored), 1), self.algebraic_weight, _CASE_ITERATIONS)
        best = _best_case(system, cases, control, plane_points, vectors)
        depths = cases.gather(1, best.expand(4, 1, -1))[:, 0]
        depths = _minimize(system, depths, self.algebraic_weight, self.iterations - _CASE_ITERATIONS)
        # Depths beyond the precision of the dtype are a failure; NaN compares false.
        solved = (depths.abs() < 1.0 / torch.finfo(depths.dtype).eps).all(0)
        flat = torch.zeros_like(depths)
        flat[0] = 1.0
        return torch.where(solved, depths, flat), solved


class _DepthSystem(NamedTuple):
    """The equations of the depths of the control points."""

    first: Tensor  # P, (4, 4, B)
    second: Tensor  # Q, (4, 4, B)
    error: Tensor  # K, (4, 4, B)
    gram: Tensor  # the Gram matrix of the control vectors, scaled to the trace 1, (3, 3, B)
    unit: Tensor  # unit of the depths: the root mean square distance of the points from their centroid, (B,)


class _Objective(NamedTuple):
    """The system as :func:`_normal_equations` reads it: rows (4, *, B), and without their first entries (3, *, B)."""

    first: tuple[Tensor, ...]
    second: tuple[Tensor, ...]
    first_inner: list[Tensor]
    second_inner: list[Tensor]
    prior: Tensor  # half the weighted algebraic error, (4, 4, *, B)
    target: list[tuple[Tensor, ...]]  # minus the Gram matrix
    axes: tuple[Tensor, ...]


def _symmetric(upper: dict[tuple[int, int], Tensor]) -> Tensor:
    """Symmetric matrices (*, 4, 4, B) from their upper entries (*, B)."""
    entries = [upper[min(i, j), max(i, j)] for i in range(4) for j in range(4)]
    return torch.stack(entries, -2).unflatten(-2, (4, 4))


def _depth_system(control: ControlPoints, plane_points: Tensor) -> _DepthSystem:
    """Eliminate the x and y coordinates of the control points; ``plane_points`` are (u, v), (2, N, B)."""
    coordinates = control.coordinates.permute(2, 1, 0).unbind(0)[1:]  # (N, B) each; the first is 1
    weights = control.weights.mT
    weighted = [weights, *(weights * a for a in coordinates)]
    scaled = [plane_points, *(plane_points * a for a in coordinates)]  # (2, N, B) each
    moments = {(i, j): (weighted[i] * scaled[j]).sum(1) for i, j in _UPPER}  # (2, B) each
    # K is a sum of squared residuals of the elimination. As a difference of moments float32 would lose it.
    errors = []
    for j in range(4):
        error = scaled[j] - moments[0, j][:, None]
        for i, a in enumerate(coordinates, 1):
            error = torch.addcmul(error, a, moments[min(i, j), max(i, j)][:, None], value=-1)
        errors.append(error)
    weighted = [weights * error for error in errors]
    quadratic = _symmetric({(i, j): (weighted[i] * errors[j]).sum((0, 1)) for i, j in _UPPER})
    first, second = _symmetric(moments).unbind(0)
    vectors = control.points[:, 1:].permute(2, 1, 0)  # (3 axes, 3 vectors, B)
    gram = small_product(vectors.transpose(0, 1), vectors)
    mean_square = torch.where(control.ok, gram[0, 0] + gram[1, 1] + gram[2, 2], 1.0)
    return _DepthSystem(first, second, quadratic, gram / mean_square, mean_square.sqrt())


def _in_camera(system: _DepthSystem, depths: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """x, y and z of the centroid and the vectors in units of ``system.unit``, each (4, *, B), at depths (4, *, B)."""
    z = depths.unbind(0)
    shape = (4, *(1,) * (depths.ndim - 2), -1)
    x = dot((row.view(shape) for row in system.first.unbind(0)), z)  # P is symmetric: its rows are its columns
    y = dot((row.view(shape) for row in system.second.unbind(0)), z)
    return x, y, depths


def _null_space(system: _DepthSystem) -> Tensor:
    """A basis of depths in the order of their algebraic error, (4, 4 vectors, B): z = β₁v₁ + β₂v₂ + β₃v₃ + β₄v₄.

    The first vector has the least error with the centroid at depth 1. The other vectors have the centroid at depth 0;
    they are the eigenvectors of the rest of K, so that K is diagonal in this basis.
    """
    first, second, error, gram = system.first, system.second, system.error, system.gram
    spread = error[0, 0] + (first[0, 1:].square() + second[0, 1:].square()).sum(0)
    eye = torch.eye(3, dtype=gram.dtype, device=gram.device)[..., None]
    inner = torch.addcmul(error[1:, 1:], _TIE * spread, 1.1 * eye - gram)
    usual = torch.zeros_like(first[0, 1:])  # (3, B)
    directions = []
    for value, direction in eigenvectors(inner):
        along = dot(error[0, 1:].unbind(0), direction.unbind(0)) / value
        usual = torch.addcmul(usual, along, direction, value=-1)
        directions.append(direction)
    top = eye.new_zeros(4, 1)
    top[0] = 1.0
    return torch.cat((top.expand(1, 4, *spread.shape), torch.stack((usual, *directions), 1)))


def _four_cases(system: _DepthSystem) -> Tensor:
    r"""The depths of the paper's four cases, which differ in the number of null vectors, (4, 4 cases, B).

    For :math:`N = 1, 2, 3` the products of the betas are found by least squares; for N = 3 without :math:`\beta_3^2`,
    the smallest product. N = 4 adds :math:`\beta_1 \beta_4`, so that there are as many unknowns as equations (the paper
    linearises the four remaining products again). The systems of all cases are leading blocks of one system.
    """
    basis = _null_space(system)  # (4, 4 vectors, B)
    camera = _in_camera(system, basis)
    vectors = [axis.unbind(0)[1:] for axis in camera]  # (4 vectors, B) for each axis and control vector
    single = [[control.unbind(0) for control in axis] for axis in vectors]
    normal, rhs = basis.new_zeros(6, 6, basis.shape[-1]), basis.new_zeros(6, basis.shape[-1])
    for k, j in _EDGES:
        sides = [(k, j), (j, k)] if k != j else [(k, j)]
        terms = [(axis, *side) for axis in range(3) for side in sides]
        # The unknowns are ½β₁², β₁β₂, β₁β₃, β₁β₄, ½β₂², β₂β₃; the equation of an edge with itself is halved.
        parts = [
            dot((single[c][a][m] for c, a, _ in terms), (vectors[c][b][others] for c, _, b in terms))
            for m, others in ((0, slice(0, 4)), (1, slice(1, 3)))
        ]
        row = torch.cat(parts)  # (6, B)
        target, weight = (system.gram[k, j], 2.0) if k != j else (0.5 * system.gram[k, j], 4.0)
        normal.addcmul_(row[:, None], row, value=weight)
        rhs.addcmul_(target, row, value=weight)
    nested = (0, 1, 4, 2, 5, 3)
    rows, right = [row.unbind(0) for row in normal.unbind(0)], rhs.unbind(0)
    one, two, three, four = solve_leading(
        [[rows[i][j] for j in nested] for i in nested], [right[i] for i in nested], (1, 3, 5, 6)
    )
    zero = torch.zeros_like(one[0])
    square = torch.stack((one[0], two[0], three[0], four[0]))
    sign = square.sign()
    first = (2.0 * square.abs()).sqrt()
    inverse = sign / first
    mixed = torch.stack((zero, two[1], three[1], four[1])) * sign
    square = torch.stack((zero, two[2], three[2], four[2])) * sign
    second = (2.0 * square).clamp(min=0.0).sqrt().copysign(mixed)
    third = torch.stack((zero, zero, three[3], four[3])) * inverse
    fourth = torch.stack((zero, zero, zero, four[5])) * inverse
    return dot(basis[:, :, None].unbind(1), (first, second, third, fourth))


def _objective(system: _DepthSystem, weight: float, cases: bool) -> _Objective:
    """Lay out the system for one candidate per problem, or, with ``cases``, for several in the middle dimension."""
    shape = (4, 1, -1) if cases else (4, -1)
    first, second = (tuple(row.view(shape) for row in x.unbind(0)) for x in (system.first, system.second))
    eye = torch.eye(4, dtype=system.error.dtype, device=system.error.device)
    return _Objective(
        first,
        second,
        [row[1:] for row in first],
        [row[1:] for row in second],
        (0.5 * weight * system.error).view(4, *shape),
        [row.unbind(0) for row in (-system.gram).unbind(0)],
        tuple(row.view(4, *(1,) * (len(shape) - 1)) for row in eye[1:].unbind(0)),
    )


def _normal_equations(objective: _Objective, depths: Tensor) -> tuple[Tensor, Tensor, dict[tuple[int, int], Tensor]]:
    r"""Half of :math:`J^\top J` (4, 4, *, B) and of :math:`J^\top r` (4, *, B), and the misfits of the edges (*, B)."""
    first, second, first_inner, second_inner, prior, target, axes = objective
    z = depths.unbind(0)
    normal, gradient, misfits = prior.expand(4, *depths.shape).clone(), dot(prior.unbind(0), z), {}
    x, y, z = dot(first_inner, z).unbind(0), dot(second_inner, z).unbind(0), z[1:]
    for k, j in _EDGES:
        misfits[k, j] = misfit = torch.addcmul(target[k][j], x[k], x[j]).addcmul_(y[k], y[j]).addcmul_(z[k], z[j])
        slope = (x[k] * first[j + 1]).addcmul_(y[k], second[j + 1]).addcmul_(z[k], axes[j])
        if k != j:
            slope.addcmul_(x[j], first[k + 1]).addcmul_(y[j], second[k + 1]).addcmul_(z[j], axes[k])
        # A diagonal entry of the Gram matrix appears once in the Frobenius norm, and its slope is halved; the other
        # entries appear twice.
        normal.addcmul_(slope[:, None], slope, value=1.0 if k != j else 2.0)
        gradient.addcmul_(slope, misfit)
    return normal, gradient, misfits


def _minimize(system: _DepthSystem, depths: Tensor, weight: float, iterations: int) -> Tensor:
    r"""Gauss-Newton on :math:`\|D^\top D - L^\top L\|_F^2 + \mu\, z^\top K z`; depths (4, B) or (4, C, B).

    The six entries of the Gram matrix are equivalent to the paper's six distances between control points, but their
    norm does not depend on the choice of the control points.
    """
    objective = _objective(system, weight, depths.ndim > 2)
    for _ in range(iterations):
        normal, gradient, _ = _normal_equations(objective, depths)
        (step,) = solve_leading((row.unbind(0) for row in normal.unbind(0)), gradient.unbind(0), (4,))
        depths = depths - torch.stack(step)
    return depths


def _attach_gradient(system: _DepthSystem, depths: Tensor, planar: Tensor, weight: float) -> Tensor:
    r"""Give a minimum (4, B) its gradient by the implicit function theorem; 0 where the minimum is not isolated.

    The result has the value of ``depths`` and the derivatives of two Newton steps with a constant matrix: the first
    step makes first derivatives exact, the second step second derivatives. So the iterations need not be
    differentiated, and the gradient does not depend on how the minimum was found.
    """
    objective, depths = _objective(system, weight, False), depths.detach()
    normal, gradient, misfits = _normal_equations(objective, depths)
    with torch.no_grad():
        entries = [misfits[min(i, j), max(i, j)] for i in range(3) for j in range(3)]
        misfit = torch.stack(entries).unflatten(0, (3, 3))
        for matrix in (system.first[1:], system.second[1:]):
            normal = normal + small_product(matrix.transpose(0, 1), small_product(misfit, matrix))
        normal = normal + torch.nn.functional.pad(misfit, (0, 0, 1, 0, 1, 0))
        # The depth of the third vector of planar points is always 0: an identity row keeps the system regular.
        last = torch.zeros_like(normal[:, :, :1])
        last[3, 3] = 1.0
        normal = normal + last * planar
        # The four columns of the inverse, one system each.
        eye = torch.eye(4, dtype=depths.dtype, device=depths.device)[..., None].expand_as(normal).flatten(1)
        repeated = normal[:, :, None].expand(-1, -1, 4, -1).flatten(2)
        columns, solved = solve_positive(repeated, eye, depths.new_zeros(()))
        inverse = torch.where(solved, columns, 0.0).unflatten(1, (4, -1))  # (4, 4, B)
    for again in (True, False):
        step = small_product(inverse, gradient[:, None])[:, 0]
        depths = depths - step + step.detach()
        if again:
            gradient = _normal_equations(objective, depths)[1]
    return depths


def _frame(one: Sequence[Tensor], two: Sequence[Tensor]) -> list[tuple[Tensor, ...]]:
    """Orthonormal axes from two vectors by Gram-Schmidt; a vector is a triple of tensors."""
    length = dot(one, one).rsqrt()
    a, b, c = (entry * length for entry in one)
    along = dot((a, b, c), two)
    two = [torch.addcmul(entry, along, axis, value=-1) for entry, axis in zip(two, (a, b, c), strict=True)]
    length = dot(two, two).rsqrt()
    d, e, f = (entry * length for entry in two)
    return [(a, b, c), (d, e, f), (b * f - c * e, c * d - a * f, a * e - b * d)]


def _best_case(
    system: _DepthSystem, cases: Tensor, control: ControlPoints, plane_points: Tensor, vectors: Tensor
) -> Tensor:
    """Number (B,) of the case with the least weighted sum of squared reprojection errors, of depths (4, C, B).

    The control vectors of a case are nearly the rotated control vectors of the world. The rotation between frames of
    two of these vectors, which is faster, replaces Procrustes.
    """
    camera = zip(*(axis.unbind(0) for axis in _in_camera(system, cases)), strict=True)
    centroid, *affine = camera  # triples of (C, B)
    world = [vector.unbind(0) for vector in vectors.unbind(1)]  # triples of (B,)
    axes, world_axes = _frame(*affine[:2]), _frame(*world[:2])
    entries = [[dot(axis, vector) for axis in world_axes] for vector in world]
    points = [centroid, *([dot(entry, axis) for axis in zip(*axes, strict=True)] for entry in entries)]
    cases_first = [[axis.unbind(0) for axis in point] for point in points]
    coordinates = control.coordinates.permute(2, 1, 0).unbind(0)[1:]  # (N, B) each
    weights = control.weights.mT
    minus_u, minus_v = (-plane_points).unbind(0)
    errors = []
    for case in range(cases.shape[1]):
        x, y, z = (
            torch.addcmul(origin[case], coordinates[0], a[case])
            .addcmul_(coordinates[1], b[case])
            .addcmul_(coordinates[2], c[case])
            for origin, a, b, c in zip(*cases_first, strict=True)
        )  # (N, B) each
        inverse = z.reciprocal()
        x, y = torch.addcmul(minus_u, x, inverse), torch.addcmul(minus_v, y, inverse)
        error = (x * x).addcmul_(y, y).clamp_(max=_MAX_SQ_RESIDUAL)
        error = torch.where(z > 0, error, _MAX_SQ_RESIDUAL)  # failed cases, too: NaN compares false
        errors.append((error * weights).sum(0))
    return torch.stack(errors).argmin(0)
