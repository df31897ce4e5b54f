r"""Control points, which EPnP and REPPnP share.

A world point is :math:`p_i = \sum_j a_{ij} c_j`, and in the camera frame it has the same coordinates :math:`a_{ij}`.
Lepetit et al. take four control points :math:`c_j` and barycentric coordinates. Here :math:`c_0` is the centroid and
the others are *vectors* from it, so that the coordinates can be orthonormal, :math:`\sum_i w_i a_i a_i^\top = I`, and
results do not depend on the axes of the world.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.problem import Problem

__all__ = ["ControlPoints", "control_points"]

# Points are planar when their extent across the plane is below this fraction of their extent along the plane.
_PLANAR_RATIO = 1e-3


class ControlPoints(NamedTuple):
    """Control points, coordinates and weights of the pairs. In memory the problems are the last dimension."""

    points: Tensor  # the centroid and three vectors, a square root of the covariance; planar: c_3 is 0, (B, 4, 3)
    coordinates: Tensor  # a: `coordinates @ points` are the world points; planar: the last ones are 0, (B, N, 4)
    weights: Tensor  # with the sum 1, (B, N)
    planar: Tensor  # whether the points lie in one plane (or on a line), bool, (B,)
    ok: Tensor  # whether the points span more than a line, bool, (B,)


def control_points(problem: Problem) -> ControlPoints:
    r"""Choose the control points by weighted Gram-Schmidt on the coordinates of the world points.

    The axis along which the points spread most is projected out of the other axes, and so on. The principal directions
    of the paper cost an eigendecomposition and have no gradient where two extents are equal.

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
    # An axis below its limit is rounding. The first limit is absolute, the others are relative to the previous extent.
    limit = torch.full_like(total, torch.finfo(rest.dtype).tiny ** 0.5)
    line_ratio = torch.finfo(rest.dtype).eps ** 0.5
    vectors, axes, found = [centroid], [torch.ones_like(weights)], []
    for ratio in (line_ratio, _PLANAR_RATIO, 1.0):
        variance = (rest.square() * weights).sum(1)  # (3, B)
        largest, position = variance.max(0)
        there = largest > limit
        inverse = torch.where(there, torch.where(there, largest, 1.0).rsqrt(), 0.0)
        axis = rest.gather(0, position.expand(1, *weights.shape))[0] * inverse  # (N, B)
        vector = (rest * (weights * axis)).sum(1)  # (3, B)
        rest = rest - vector[:, None] * axis
        vectors.append(vector)
        axes.append(axis)
        found.append(there)
        limit = torch.where(there, (largest.detach() * ratio**2).maximum(limit), torch.inf)
    points, coordinates = torch.stack(vectors, 1).permute(2, 1, 0), torch.stack(axes).permute(2, 1, 0)
    return ControlPoints(points, coordinates, weights.mT, ~found[2], found[1])
