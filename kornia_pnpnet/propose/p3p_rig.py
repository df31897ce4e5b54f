r"""Minimal solver of three pairs of a rig. A rig is several cameras, or one camera with bearings in any direction.

A pair consists of a world point :math:`x_k` and a ray, which starts at the camera centre :math:`c_k` and has the unit
direction :math:`r_k`. The unknowns are the distances :math:`d_k > 0` along the rays. The triangle of the points
:math:`c_k + d_k r_k` has to be congruent to the triangle of the world points:

.. math:: \|c_i + d_i r_i - c_j - d_j r_j\|^2 = \|x_i - x_j\|^2.

There are up to eight solutions (D. Nistér, "A minimal solution to the generalised 3-point pose problem", CVPR 2004).
For a given :math:`d_1`, one equation gives up to two :math:`d_2`, and another equation gives up to two :math:`d_3`. All
four values are real in one interval of :math:`d_1`. A *branch* is a choice of :math:`d_2` and :math:`d_3`. On a branch,
the third equation depends on :math:`d_1` alone. Newton's method starts where the error of this equation changes sign.

The last dimension of every tensor has B problems or M solutions.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_pnpnet.core.performance import problems_last, sees_values
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.problem import Hypotheses, Problem
from kornia_pnpnet.propose.scoring import as_pose

__all__ = ["P3PRig"]

# Number of distances d_1 at which the third equation of each branch is evaluated. If two solutions of a branch lie
# between neighbouring distances, both are missed. If cameras look in all directions, 4 % of the poses are missed.
_DISTANCES = 16
# Largest number of solutions, and number of Newton steps.
_SOLUTIONS, _STEPS = 8, 6
# A pose is a solution when the relative error of each side of the triangle is below _EXACT, and each entry of RᵀR - I
# is below _ORTHOGONAL. Here R is the rotation matrix.
_EXACT, _ORTHOGONAL = 1e-3, 0.01


class _Branches(NamedTuple):
    """Two solutions for the distance of a pair k, as functions of the distance d of pair 1.

    Seen from the camera centre of pair k, the point of pair 1 is ``ahead + d * cosine`` along the ray of pair k, and
    ``aside + d * tilt`` off this ray. All vectors have the shape (3, M), and all numbers the shape (M,).
    """

    ahead: Tensor
    cosine: Tensor
    aside: Tensor
    tilt: Tensor
    sq_side: Tensor

    @classmethod
    def of(cls, offset: Tensor, ray: Tensor, first_ray: Tensor, sq_side: Tensor) -> _Branches:
        """``offset`` is the vector from the camera centre of pair k to the camera centre of pair 1."""
        ahead, change = (offset * ray).sum(0), first_ray - ray
        gain = (change * ray).sum(0)
        return cls(ahead, 1.0 + gain, offset - ahead * ray, change - gain * ray, sq_side)

    def interval(self) -> tuple[Tensor, Tensor]:
        """Least and largest distance of pair 1 with real solutions. If none exist, the least exceeds the largest."""
        sq_tilt = self.tilt.square().sum(0).clamp(min=torch.finfo(self.tilt.dtype).eps ** 2)  # for parallel rays
        middle = -(self.aside * self.tilt).sum(0) / sq_tilt
        sq_half = middle.square() + (self.sq_side - self.aside.square().sum(0)) / sq_tilt
        half = torch.where(sq_half > 0, sq_half.clamp(min=0.0).sqrt(), -1.0)
        return middle - half, middle + half

    def at(self, distance: Tensor, sign: Tensor) -> Tensor:
        """Distances of pair k for distances (D, M) or (M,) of pair 1. The sign, -1 or 1, selects the solution."""
        sq_aside = sum((x + y * distance).square() for x, y in zip(self.aside, self.tilt, strict=True))
        return self.ahead + self.cosine * distance + sign * (self.sq_side - sq_aside).clamp(min=0.0).sqrt()


class P3PRig:
    """Minimal solver of three pairs of a rig. See :mod:`kornia_pnpnet.propose.p3p_rig`."""

    #: Number of pairs in a sample.
    sample_size = 3

    def hypotheses(self, problem: Problem) -> Hypotheses:
        """Eight slots per sample. See MinimalSolver.hypotheses."""
        problem = problems_last(problem)
        assert problem.rig is not None
        batch = problem.weights.shape[0]
        world, rays, back = (  # each (3 pairs, 3 coordinates, B)
            x.permute(1, 2, 0).contiguous() for x in (problem.world_points, problem.places, problem.rig.translation)
        )
        rays = rays / rays.square().sum(1, keepdim=True).sqrt()  # in the frame of the rig
        centres = -(problem.rig.rotation.permute(1, 2, 3, 0) * back[:, :, None]).sum(1)
        sides = (world[[0, 0, 1]] - world[[1, 2, 2]]).square().sum(1)
        branches = [_Branches.of(centres[0] - centres[k], rays[k], rays[0], sides[k - 1]) for k in (1, 2)]
        start, signs, slots, owners = _starts(branches, rays, centres, sides[2])
        branches, world, rays, centres, sides = map_tensors(
            lambda x: x.index_select(-1, owners), (branches, world, rays, centres, sides)
        )
        ranges = torch.stack((start, *(x.at(start, sign) for x, sign in zip(branches, signs, strict=True))))
        rotation, translation, exact = _newton(world, rays, centres, sides, ranges)
        identity = torch.eye(3, 4, dtype=rays.dtype, device=rays.device)[..., None]
        found = torch.where(exact, torch.cat((rotation, translation[:, None]), 1), identity)
        entries = identity.repeat(1, 1, _SOLUTIONS * batch).index_copy(-1, slots, found).flatten(0, 1)
        valid = exact.new_zeros(_SOLUTIONS * batch).index_copy(0, slots, exact).view(_SOLUTIONS, batch)
        return Hypotheses(as_pose(entries.unflatten(-1, valid.shape).permute(2, 1, 0)), valid.mT)


def _starts(
    branches: list[_Branches], rays: Tensor, centres: Tensor, sq_side: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Starts of Newton's method: distances (M,) of pair 1, signs (2, M) of the branches, slots (M,), problems (M,)."""
    batch, device = sq_side.shape[0], sq_side.device
    lows, highs = zip(*(x.interval() for x in branches), strict=True)
    low, high = torch.maximum(*lows).clamp(min=0.0), torch.minimum(*highs)
    real = high > low
    middle, half = 0.5 * (low + high), torch.where(real, 0.5 * (high - low), 0.0)
    # d_2 and d_3 behave like square roots at an end of the interval, but are smooth functions of arcsin(`turn`).
    turn = torch.linspace(-0.5 * math.pi, 0.5 * math.pi, _DISTANCES, dtype=sq_side.dtype, device=device).sin()[:, None]
    distances = middle + half * turn  # (D, B)
    signs = torch.tensor([-1.0, 1.0], dtype=sq_side.dtype, device=device)[:, None, None]
    second, third = (x.at(distances, signs) for x in branches)  # (2, D, B)
    offset = centres[1] - centres[2]
    linear = (2.0 * offset * rays[1:]).sum(1)  # (2, B)
    wide = (rays[1] - rays[2]).square().sum(0)
    alone = linear[0] * second + (offset.square().sum(0) - sq_side), linear[1] * third
    # `gap` is the error of the third equation. In this form, the error loses no digits in a narrow view.
    gap = (second[:, None] - third).square() + (wide * second)[:, None] * third + (alone[0][:, None] - alone[1])
    above = gap.flatten(0, 1) > 0  # (4, D, B)
    changes = ((above[:, 1:] != above[:, :-1]) & real).flatten(0, 1)  # (4 (D - 1), B)
    # Unique keys make the order of the solutions independent of the implementation of `topk`.
    keys = torch.arange(changes.shape[0], 0, -1, dtype=sq_side.dtype, device=device)[:, None]
    chosen, at = (changes * keys).topk(_SOLUTIONS, 0)
    slots = torch.arange(_SOLUTIONS * batch, device=device)
    if sees_values(sq_side):
        slots = (chosen.flatten() > 0).nonzero()[:, 0]
    owners, at = torch.arange(batch, device=device).repeat(_SOLUTIONS)[slots], at.flatten()[slots]
    branch, at = at // (_DISTANCES - 1), at % (_DISTANCES - 1) * batch + owners
    first, last = (gap.flatten()[branch * (_DISTANCES * batch) + at + x] for x in (0, batch))
    left, right = (distances.flatten()[at + x] for x in (0, batch))
    share = first / (first - last)
    return left + share * (right - left), 2.0 * torch.stack((branch // 2, branch % 2)).to(left) - 1.0, slots, owners


def _newton(
    world_points: Tensor, rays: Tensor, centres: Tensor, sides: Tensor, ranges: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Run Newton's method from distances ``ranges`` (3, M). Returns rotations, translations, and validity (M,)."""
    first, second = [0, 0, 1], [1, 2, 2]
    for step in range(_STEPS + 1):
        points = centres + ranges[:, None] * rays
        edge = points[first] - points[second]  # (3, 3, M)
        gap = 0.5 * (sides - edge.square().sum(1))
        if step == _STEPS:
            break
        # Cramer's rule for the Jacobian [[a, -b, 0], [c, 0, -d], [0, e, -f]].
        (a, c, e), (b, d, f), (g, h, k) = (edge * rays[first]).sum(1), (edge * rays[second]).sum(1), gap
        both = d * k - f * h
        steps_by_det = torch.stack((g * d * e + b * both, a * both + g * c * f, b * c * k + e * (g * c - a * h)))
        ranges = ranges + steps_by_det / (a * d * e - b * c * f)
    exact = (gap.abs() < _EXACT * sides).all(0) & (ranges > 0).all(0)
    # The rotation maps two sides and the normal of the world triangle to their counterparts in the camera triangle.
    cam = [-edge[0], -edge[1], torch.linalg.cross(edge[0], edge[1], dim=0)]
    world = [world_points[1] - world_points[0], world_points[2] - world_points[0]]
    normal = torch.linalg.cross(*world, dim=0)
    dual = torch.linalg.cross(world[1], normal, dim=0), torch.linalg.cross(normal, world[0], dim=0), normal
    rotation = (torch.stack(cam)[:, :, None] * (torch.stack(dual) / normal.square().sum(0))[:, None]).sum(0)
    translation = points[0] - (rotation * world_points[0]).sum(1)
    # In a triangle that is almost a line, small errors of the sides turn the normal.
    product = (rotation[:, :, None] * rotation[:, None]).sum(0)
    eye = torch.eye(3, dtype=rays.dtype, device=rays.device)[..., None]
    exact = exact & ((product - eye).abs() < _ORTHOGONAL).all(0).all(0)
    return rotation, translation, exact & translation.isfinite().all(0)
