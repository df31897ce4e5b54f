"""EPnP: a pose from four or more pairs in closed form and a few Gauss-Newton steps in four unknowns."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor, nn

from kornia_pnpnet.core.linalg import dot, nearest_rotation, small_product
from kornia_pnpnet.init.epnp.control_points import ControlPoints, control_points
from kornia_pnpnet.init.epnp.depths import (
    DepthSystem,
    attach_gradient,
    control_points_in_camera,
    depth_system,
    four_cases,
    minimize,
)
from kornia_pnpnet.types import Correspondences, Guess, Pose

__all__ = ["EPnP", "best_case"]

_MIN_PAIRS, _MIN_IN_FRONT = 4, 3
# Gauss-Newton steps of every case before one of them is chosen.
CASE_ITERATIONS = 2
# A reprojection error counts up to this many squared focal lengths, and a point behind the camera counts as much.
_MAX_SQ_RESIDUAL = 4.0


class EPnP(nn.Module):
    r"""EPnP with weights, planar points and gradients, for batches.

    The control points of the world are expressed in the camera frame as a combination of the null vectors of the
    projection equations; the coefficients make the control points as far from each other as they are in the world.
    Four cases, N = 1 … 4 null vectors, start Gauss-Newton; the case with the least weighted reprojection error is taken
    (a point behind the camera counts as an error of two focal lengths). The pose moves the control points of the
    world to those in the camera (orthogonal Procrustes).

    Source: V. Lepetit, F. Moreno-Noguer and P. Fua, "EPnP: An Accurate O(n) Solution to the PnP Problem", IJCV 2009.
    We depart from it for accuracy, for speed and to do without eigenvectors of equal eigenvalues:

    - Two thirds of the 12 unknowns are eliminated (``kornia_pnpnet.init.epnp.depths``). What remains are the depths of
      the control points; the null vectors are ordered by their algebraic error at equal depth of the centroid, not
      at equal length. Where fewer than six pairs leave several null vectors, those with the world's longest extents
      come first.
    - The distances are compared in a norm that does not depend on the choice of the control points, and the algebraic
      error stays in the objective with the weight ``algebraic_weight``: with a dozen noisy pairs the null vectors
      are not equally free. 0 is the paper.
    - Planar points have three control points in the same equations, with 0 as the fourth; no branch of its own.

    Four pairs are the fewest, and like five they work by the null space: there they leave up to four solutions, of
    which the least reprojection error need not be the right one. A problem is not ``ok`` with fewer pairs, with
    points on a line, and when fewer than three pairs are in front of the camera.

    Gradients to points, pixels and weights are those of the minimum that Gauss-Newton found, by the implicit function
    theorem. They are first derivatives; the choice among the cases is not differentiated.

    Args:
        iterations: Gauss-Newton steps, at least 2. Two of them are made in every case, the others in the best one.
        algebraic_weight: :math:`\mu \ge 0`, weight of the algebraic error beside the squared error of the distances,
            for points of unit root mean square distance from their centroid and pixels over the focal length.

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
        super().__init__()
        KORNIA_CHECK(
            isinstance(iterations, int) and iterations >= CASE_ITERATIONS,
            f"iterations must be an integer of at least {CASE_ITERATIONS}, got {iterations!r}.",
        )
        KORNIA_CHECK(
            0.0 <= algebraic_weight < float("inf"), f"algebraic_weight must be at least 0, got {algebraic_weight!r}."
        )
        self.config = {"iterations": iterations, "algebraic_weight": algebraic_weight}
        self.iterations = iterations
        self.algebraic_weight = algebraic_weight

    def extra_repr(self) -> str:
        """Show the constructor's arguments."""
        return ", ".join(f"{key}={value!r}" for key, value in self.config.items())

    def forward(self, corr: Correspondences) -> Guess:
        r"""Find the pose.

        Args:
            corr: normalised correspondences.

        Returns:
            The pose, weights of one, and whether there is a pose. Where there is none the pose is finite.
        """
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
        # The control points miss their distances a little. Their size is known.
        size = affine.square().sum((0, 1))
        scale = (small_product(rotation, vectors) * affine).sum((0, 1)) / torch.where(size > 0, size, 1.0)
        offset = dot(rotation.unbind(1), control.points[:, 0].mT.unbind(0))
        translation = camera[:, 0] * (scale * system.unit) - offset  # (3, B)

        there = corr.weights.mT > 0
        depth = dot(rotation[2].unbind(0), corr.world_points.permute(2, 1, 0).unbind(0)) + translation[2]  # (N, B)
        ok = solved & unique & (there.sum(0) >= _MIN_PAIRS)
        ok = ok & ((there & (depth > 0)).sum(0) >= _MIN_IN_FRONT)
        pose = Pose(rotation.permute(2, 0, 1).contiguous(), translation.mT.contiguous())
        return Guess(pose, torch.ones_like(corr.weights), ok)

    def _depths(
        self, system: DepthSystem, control: ControlPoints, plane_points: Tensor, vectors: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The depths (4, B) of the best case, and whether they could be found (B,); else those of equal depth."""
        cases = minimize(system, four_cases(system), self.algebraic_weight, CASE_ITERATIONS)
        best = best_case(system, cases, control, plane_points, vectors)
        depths = cases.gather(1, best.expand(4, 1, -1))[:, 0]
        depths = minimize(system, depths, self.algebraic_weight, self.iterations - CASE_ITERATIONS)
        # Greater ratios than rounding resolves are a failure; NaN compares false.
        solved = (depths.abs() < 1.0 / torch.finfo(depths.dtype).eps).all(0)
        flat = torch.zeros_like(depths)
        flat[0] = 1.0
        return torch.where(solved, depths, flat), solved


def _frame(one: Sequence[Tensor], two: Sequence[Tensor]) -> list[tuple[Tensor, ...]]:
    """Orthonormal axes of two vectors; a vector is a triple."""
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
    r"""Choose among the cases of every problem by the weighted mean of their squared reprojection errors.

    The control vectors of a case are nearly those of the world turned: frames of two of them stand in for Procrustes.

    Args:
        system: the equations.
        cases: depths, shape :math:`(4, C, B)`.
        control: the control points in the world.
        plane_points: pixels over the focal length, shape :math:`(2, N, B)`.
        vectors: the control vectors of the world in units of ``system.unit``, shape :math:`(3, 3, B)`.

    Returns:
        The number of the best case, shape :math:`(B,)`.
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
        error = torch.where(z > 0, error, _MAX_SQ_RESIDUAL)  # also where a case has failed: NaN compares false
        errors.append((error * weights).sum(0))
    return torch.stack(errors).argmin(0)
