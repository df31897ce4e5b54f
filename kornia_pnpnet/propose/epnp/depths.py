r"""EPnP's equations in the four depths of the control points, with the problems in the last dimension.

With orthonormal coordinates (see :mod:`~kornia_pnpnet.propose.epnp.control_points`) the equations
:math:`\sum_j a_{ij} (x_j - u_i z_j) = 0`, and the same with :math:`y` and :math:`v`, are solved for x and y in closed
form: :math:`x = P z` with :math:`P = \sum_i w_i u_i a_i a_i^\top`, and :math:`y = Q z` with :math:`v_i` instead of
:math:`u_i`. The remaining algebraic error :math:`z^\top K z` has 4 unknowns where the paper's :math:`M^\top M` has 12,
and every :math:`z` is a candidate, as in the paper's null space for N = 4. The control vectors in the camera frame are
the columns of a 3 by 3 matrix :math:`D(z)`. They are the rotated control vectors :math:`L` of the world when
:math:`D^\top D = L^\top L`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.linalg import dot, eigenvectors, small_product, solve_leading
from kornia_pnpnet.geometry import NormalEquations
from kornia_pnpnet.propose.epnp.control_points import ControlPoints
from kornia_pnpnet.refine import solve_damped

__all__ = [
    "DepthSystem",
    "attach_gradient",
    "control_points_in_camera",
    "depth_system",
    "four_cases",
    "minimize",
]

# Share of the squared spread of the pixels. A ridge of this size breaks ties between null vectors: equal depths come
# first, then tilts along the world's longest extents. It affects where the iterations start, not where they end.
_TIE = 1e-4
# Upper entries of a symmetric 4 by 4 matrix.
_UPPER = [(i, j) for i in range(4) for j in range(i, 4)]
# Upper entries of the Gram matrix of the three control vectors; an entry is the equation of an "edge".
_EDGES = [(i, j) for i in range(3) for j in range(i, 3)]


class DepthSystem(NamedTuple):
    r"""The equations of the depths of the control points.

    Attributes:
        first: :math:`P`, shape :math:`(4, 4, B)`.
        second: :math:`Q`, shape :math:`(4, 4, B)`.
        error: :math:`K`, shape :math:`(4, 4, B)`.
        gram: :math:`L^\top L`, scaled to the trace 1, shape :math:`(3, 3, B)`.
        unit: unit of the depths, the root mean square distance of the world points from their centroid, shape
            :math:`(B,)`.
    """

    first: Tensor
    second: Tensor
    error: Tensor
    gram: Tensor
    unit: Tensor


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


def depth_system(control: ControlPoints, plane_points: Tensor) -> DepthSystem:
    r"""Eliminate the x and y coordinates of the control points.

    Args:
        control: the control points in the world.
        plane_points: :math:`(u, v)`, pixels over the focal length, shape :math:`(2, N, B)`.

    Returns:
        The :class:`DepthSystem`.
    """
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
    return DepthSystem(first, second, quadratic, gram / mean_square, mean_square.sqrt())


def control_points_in_camera(system: DepthSystem, depths: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    r"""The control points in the camera frame that belong to depths.

    Args:
        system: the equations.
        depths: :math:`z`, shape :math:`(4, *, B)`.

    Returns:
        x, y and z of the centroid and the vectors, in units of ``system.unit``, each :math:`(4, *, B)`.
    """
    z = depths.unbind(0)
    shape = (4, *(1,) * (depths.ndim - 2), -1)
    x = dot((row.view(shape) for row in system.first.unbind(0)), z)  # P is symmetric: its rows are its columns
    y = dot((row.view(shape) for row in system.second.unbind(0)), z)
    return x, y, depths


def _null_space(system: DepthSystem) -> Tensor:
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


def four_cases(system: DepthSystem) -> Tensor:
    r"""The depths of the paper's four cases, which differ in the number of null vectors.

    For :math:`N = 1, 2, 3` the products of the betas are found by least squares; for N = 3 without :math:`\beta_3^2`,
    the smallest product. N = 4 adds :math:`\beta_1 \beta_4`, so that there are as many unknowns as equations (the paper
    linearises the four remaining products again). The systems of all cases are leading blocks of one system.

    Args:
        system: the equations.

    Returns:
        Depths, shape :math:`(4, 4, B)`, with the cases in the second dimension.
    """
    basis = _null_space(system)  # (4, 4 vectors, B)
    camera = control_points_in_camera(system, basis)
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


def _objective(system: DepthSystem, weight: float, cases: bool) -> _Objective:
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


def minimize(system: DepthSystem, depths: Tensor, weight: float, iterations: int) -> Tensor:
    r"""Gauss-Newton on :math:`\|D^\top D - L^\top L\|_F^2 + \mu\, z^\top K z`.

    The six entries of the Gram matrix are equivalent to the paper's six distances between control points, but their
    norm does not depend on the choice of the control points.

    Args:
        system: the equations.
        depths: start, shape :math:`(4, B)`, or :math:`(4, C, B)` for C candidates per problem.
        weight: :math:`\mu`.
        iterations: number of iterations.

    Returns:
        The depths, in the shape of ``depths``.
    """
    objective = _objective(system, weight, depths.ndim > 2)
    for _ in range(iterations):
        normal, gradient, _ = _normal_equations(objective, depths)
        (step,) = solve_leading((row.unbind(0) for row in normal.unbind(0)), gradient.unbind(0), (4,))
        depths = depths - torch.stack(step)
    return depths


def attach_gradient(system: DepthSystem, depths: Tensor, planar: Tensor, weight: float) -> Tensor:
    r"""Give the minimum its gradient, by the implicit function theorem.

    The result has the value of ``depths`` and the derivatives of two Newton steps with a constant matrix: the first
    step makes first derivatives exact, the second step second derivatives. So the iterations need not be
    differentiated, and the gradient does not depend on how the minimum was found.

    Args:
        system: the equations, with a gradient.
        depths: a minimum of the objective of :func:`minimize`, shape :math:`(4, B)`.
        planar: whether the points of a problem are planar, bool, shape :math:`(B,)`.
        weight: :math:`\mu`.

    Returns:
        The depths with a gradient, which is 0 where the minimum is not isolated.
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
        rows = [row[: i + 1].unbind(0) for i, row in enumerate(normal.unbind(0))]
        eye = torch.eye(4, dtype=depths.dtype, device=depths.device)[..., None]
        solution, solved = solve_damped(NormalEquations(rows, eye.unbind(0)), eye.new_zeros(()))
        inverse = torch.where(solved, torch.stack(solution), 0.0).detach()  # (4, 4, B)
    for again in (True, False):
        step = small_product(inverse, gradient[:, None])[:, 0]
        depths = depths - step + step.detach()
        if again:
            gradient = _normal_equations(objective, depths)[1]
    return depths
