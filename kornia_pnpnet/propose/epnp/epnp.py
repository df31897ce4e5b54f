"""EPnP: a pose from four or more pairs, in closed form and by a few Gauss-Newton steps in four unknowns."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kornia_pnpnet.core.checks import check_numbers, check_whole
from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.core.linalg import dot, nearest_rotation, small_product
from kornia_pnpnet.propose.epnp.control_points import ControlPoints, control_points
from kornia_pnpnet.propose.epnp.depths import (
    DepthSystem,
    attach_gradient,
    control_points_in_camera,
    depth_system,
    four_cases,
    minimize,
)
from kornia_pnpnet.types import Problem, Starts, Pose

__all__ = ["EPnP", "best_case"]

# Number of pairs below which a problem is not `ok`: EPnP is defined from four pairs on.
_MIN_PAIRS = 4
# Number of pairs that must be in front of the camera: fewer do not determine a pose.
_MIN_IN_FRONT = 3
# Number of Gauss-Newton steps of every case before the best case is chosen.
_CASE_ITERATIONS = 2
# Squared focal lengths. Larger squared reprojection errors, and points behind the camera, count as this error.
_MAX_SQ_RESIDUAL = 4.0


class EPnP(Configured):
    r"""EPnP with weights, planar points and gradients, for batches.

    The control points in the camera frame are a combination of the null vectors of the projection equations. The
    coefficients are chosen so that the control points have the same distances from each other as in the world. Four
    cases, N = 1 … 4 null vectors, start Gauss-Newton, and the case with the least weighted reprojection error is
    selected (a point behind the camera counts as an error of two focal lengths). The pose moves the control points of
    the world to the control points in the camera frame (orthogonal Procrustes).

    Source: V. Lepetit, F. Moreno-Noguer and P. Fua, "EPnP: An Accurate O(n) Solution to the PnP Problem", IJCV 2009.
    Our changes are for accuracy, for speed, and to avoid eigenvectors of equal eigenvalues:

    - Two thirds of the 12 unknowns are eliminated (``kornia_pnpnet.propose.epnp.depths``); the depths of the control
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
        >>> problems = SyntheticProblems(n=6, batch_size=2, world_sigma=0.0, img_sigma=0.0, dtype=torch.float64).batch(
        ...     0
        ... )
        >>> normalize = Normalize()
        >>> corr, frame = normalize(problems.world_points, problems.img_points, problems.intrinsics)
        >>> guess = EPnP()(corr)
        >>> pose_errors(normalize.undo(guess.pose, frame), problems.pose).translation_error < 1e-6, guess.ok
        (tensor([True, True]), tensor([True, True]))
    """

    def __init__(self, *, iterations: int = 5, algebraic_weight: float = 0.3) -> None:
        super().__init__(locals())
        check_whole(_CASE_ITERATIONS, iterations=iterations)
        check_numbers(0.0, algebraic_weight=algebraic_weight)
        self.iterations = iterations
        self.algebraic_weight = algebraic_weight

    def forward(self, corr: Problem) -> Starts:
        r"""Find the pose.

        Args:
            corr: normalised correspondences.

        Returns:
            The pose, weights of 1, and ``ok``. Where ``ok`` is false the pose is finite.
        """
        corr = corr._replace(weights=corr.usual_weights)
        control = control_points(corr)
        plane_points = (corr.img_points.permute(2, 1, 0) / corr.focal).contiguous()  # (2, N, B)
        system = depth_system(control, plane_points)
        vectors = control.points[:, 1:].permute(2, 1, 0) / system.unit  # (3 axes, 3 vectors, B)
        with torch.no_grad():
            depths, solved = self._depths(system, control, plane_points, vectors)
        if system.error.requires_grad:
            depths = attach_gradient(system, depths, control.planar, self.algebraic_weight)

        camera = torch.stack(control_points_in_camera(system, depths))  # (3, 4, B)
        affine = camera[:, 1:]
        rotation, unique = nearest_rotation(small_product(affine, vectors.transpose(0, 1)))
        # The control points miss their distances a little. The scale restores the known size of the world.
        size = affine.square().sum((0, 1))
        scale = (small_product(rotation, vectors) * affine).sum((0, 1)) / torch.where(size > 0, size, 1.0)
        offset = dot(rotation.unbind(1), control.points[:, 0].mT.unbind(0))
        translation = camera[:, 0] * (scale * system.unit) - offset  # (3, B)

        there = corr.weights.mT > 0
        depth = dot(rotation[2].unbind(0), corr.world_points.permute(2, 1, 0).unbind(0)) + translation[2]  # (N, B)
        ok = solved & unique & (there.sum(0) >= _MIN_PAIRS)
        ok = ok & ((there & (depth > 0)).sum(0) >= _MIN_IN_FRONT)
        pose = Pose(rotation.permute(2, 0, 1).contiguous(), translation.mT.contiguous())
        return Starts(pose, torch.ones_like(corr.weights), ok)

    def _depths(
        self, system: DepthSystem, control: ControlPoints, plane_points: Tensor, vectors: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The depths (4, B) of the best case, and whether they were found (B,); where not, equal depths."""
        cases = four_cases(system).detach()  # forward mode starts here: the square roots of 0 have no derivative
        # The distances do not tell a shape from its mirror image along the optical axis, and Gauss-Newton does not
        # change the one into the other: symmetric points need both.
        mirrored = torch.cat((cases[:1, -1:], -cases[1:, -1:]))
        cases = minimize(system, torch.cat((cases, mirrored), 1), self.algebraic_weight, _CASE_ITERATIONS)
        best = best_case(system, cases, control, plane_points, vectors)
        depths = cases.gather(1, best.expand(4, 1, -1))[:, 0]
        depths = minimize(system, depths, self.algebraic_weight, self.iterations - _CASE_ITERATIONS)
        # Depths beyond the precision of the dtype are a failure; NaN compares false.
        solved = (depths.abs() < 1.0 / torch.finfo(depths.dtype).eps).all(0)
        flat = torch.zeros_like(depths)
        flat[0] = 1.0
        return torch.where(solved, depths, flat), solved


def _frame(one: Sequence[Tensor], two: Sequence[Tensor]) -> list[tuple[Tensor, ...]]:
    """Orthonormal axes from two vectors by Gram-Schmidt; a vector is a triple of tensors."""
    length = dot(one, one).rsqrt()
    a, b, c = (entry * length for entry in one)
    along = dot((a, b, c), two)
    two = [torch.addcmul(entry, along, axis, value=-1) for entry, axis in zip(two, (a, b, c), strict=True)]
    length = dot(two, two).rsqrt()
    d, e, f = (entry * length for entry in two)
    return [(a, b, c), (d, e, f), (b * f - c * e, c * d - a * f, a * e - b * d)]


def best_case(
    system: DepthSystem, cases: Tensor, control: ControlPoints, plane_points: Tensor, vectors: Tensor
) -> Tensor:
    r"""Choose the case of each problem with the least weighted sum of squared reprojection errors.

    The control vectors of a case are nearly the rotated control vectors of the world. The rotation between frames of
    two of these vectors, which is faster, replaces Procrustes.

    Args:
        system: the equations.
        cases: depths, shape :math:`(4, C, B)`.
        control: the control points in the world.
        plane_points: pixels over the focal length, shape :math:`(2, N, B)`.
        vectors: the control vectors of the world in units of ``system.unit``, shape :math:`(3, 3, B)`.

    Returns:
        Number of the best case, int64, shape :math:`(B,)`.
    """
    camera = zip(*(axis.unbind(0) for axis in control_points_in_camera(system, cases)), strict=True)
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
