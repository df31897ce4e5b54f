r"""Minimal solver of three pairs of a rig: several cameras, or one camera with bearings in any direction."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_pnpnet.cameras import bearing_cameras
from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.core.linalg import small_product
from kornia_pnpnet.core.performance import problems_last, sees_values
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.problem import Hypotheses, Problem
from kornia_pnpnet.propose.p3p import p3p
from kornia_pnpnet.result import Pose

__all__ = ["P3PRig"]

# A pose is a solution when the relative error of each side of the triangle is below this number.
_EXACT = 1e-3


class P3PRig(Configured):
    r"""Minimal solver of three pairs of a rig: the central approximation, then Newton's method on the exact equations.

    In the central approximation all rays start at the mean of the camera centres, and :func:`p3p` finds up to four
    poses. From each pose, Newton's method finds distances along the exact rays. At a solution, the sides of the camera
    triangle are as long as the sides of the world triangle. The exact problem has up to eight solutions (D. Nistér, "A
    minimal solution to the generalised 3-point pose problem", CVPR 2004). This solver finds at most four solutions.

    Args:
        steps: number of Newton steps. If all camera centres coincide, 0 steps suffice.
    """

    #: Number of pairs in a sample.
    sample_size = 3

    def __init__(self, steps: int = 8) -> None:
        super().__init__(locals())
        self.steps = steps

    def hypotheses(self, problem: Problem) -> Hypotheses:
        """Four slots per sample; none is valid if the angle between a ray and the mean ray is 90 degrees or more."""
        problem = problems_last(problem)
        assert problem.rig is not None
        batch = problem.weights.shape[0]
        # The dimensions are pairs, coordinates and problems, (3, 3, B).
        world, rays, back = (
            x.permute(1, 2, 0) for x in (problem.world_points, problem.places, problem.rig.translation)
        )
        rays = rays / rays.square().sum(1, keepdim=True).sqrt()  # in the frame of the rig
        centres = -(problem.rig.rotation.permute(1, 2, 3, 0) * back[:, :, None]).sum(1)
        turn = bearing_cameras(rays.sum(0).mT[:, None])[0][:, 0].permute(1, 2, 0)
        seen = small_product(rays, turn.transpose(0, 1))
        ahead = seen[:, 2:]
        plane = torch.where(ahead > 0, seen[:, :2] / ahead, torch.inf)
        solved = p3p(problem.world_points, plane.permute(2, 0, 1))
        away = ((centres.mean(0) - centres) * rays).sum(1)
        # Rotations (3, 3, 4 B), translations (3, 4 B) and flags (4 B,); the last dimension contains all slots.
        (rotation, translation), valid = map_tensors(lambda x: x.movedim((0, 1), (-1, -2)).flatten(-2), solved)
        slots = torch.arange(4 * batch, device=rays.device)
        owners = torch.arange(batch, device=rays.device).repeat(4)
        if sees_values(rays):  # keep only the slots with a solution
            slots = valid.nonzero()[:, 0]
        rotation, translation = (x.index_select(-1, slots) for x in (rotation, translation))
        world, rays, centres, seen, away = (
            x.contiguous().index_select(-1, owners[slots]) for x in (world, rays, centres, seen, away)
        )
        # Newton's method starts with the points of the central approximation, projected onto the exact rays.
        cam = small_product(world, rotation.transpose(0, 1)) + translation
        rotation, translation, exact = _newton(world, rays, centres, (cam * seen).sum(1) + away, self.steps)
        exact = exact & valid[slots]
        eye = torch.eye(3, dtype=rays.dtype, device=rays.device)[..., None]
        found = Hypotheses(
            Pose(
                eye.repeat(1, 1, 4 * batch).index_copy(-1, slots, torch.where(exact, rotation, eye)),
                rays.new_zeros(3, 4 * batch).index_copy(-1, slots, torch.where(exact, translation, 0.0)),
            ),
            torch.zeros_like(valid).index_copy(0, slots, exact),
        )
        return map_tensors(lambda x: x.unflatten(-1, (4, batch)).movedim((-1, -2), (0, 1)), found)


def _newton(
    world_points: Tensor, rays: Tensor, centres: Tensor, ranges: Tensor, steps: int
) -> tuple[Tensor, Tensor, Tensor]:
    r"""Find distances along three rays such that the camera triangle is congruent to the world triangle.

    The equations are :math:`\|c_i + d_i r_i - c_j - d_j r_j\|^2 = \|x_i - x_j\|^2`, with world points :math:`x`, unit
    rays :math:`r` and centres :math:`c` (3, 3, M). The distances :math:`d` start at ``ranges`` (3, M). Returns the
    rotations, the translations, and whether the equations hold and all distances are positive.
    """
    first, second = [0, 0, 1], [1, 2, 2]
    sides = (world_points[first] - world_points[second]).square().sum(1)  # (3, M)
    for step in range(steps + 1):
        points = centres + ranges[:, None] * rays
        edge = points[first] - points[second]  # (3, 3, M)
        gap = 0.5 * (sides - edge.square().sum(1))
        if step == steps:
            break
        # Cramer's rule for the Jacobian [[a, -b, 0], [c, 0, -d], [0, e, -f]].
        (a, c, e), (b, d, f), (g, h, k) = (edge * rays[first]).sum(1), (edge * rays[second]).sum(1), gap
        both = d * k - f * h
        steps_by_det = torch.stack((g * d * e + b * both, a * both + g * c * f, b * c * k + e * (g * c - a * h)))
        ranges = ranges + steps_by_det / (a * d * e - b * c * f)
    exact = (gap.abs() < _EXACT * sides).all(0) & (ranges > 0).all(0)
    # The rotation maps two sides and the normal of the world triangle to their counterparts of the camera triangle.
    cam = [-edge[0], -edge[1], torch.linalg.cross(edge[0], edge[1], dim=0)]
    world = [world_points[1] - world_points[0], world_points[2] - world_points[0]]
    normal = torch.linalg.cross(*world, dim=0)
    dual = torch.linalg.cross(world[1], normal, dim=0), torch.linalg.cross(normal, world[0], dim=0), normal
    rotation = (torch.stack(cam)[:, :, None] * (torch.stack(dual) / normal.square().sum(0))[:, None]).sum(0)
    translation = points[0] - (rotation * world_points[0]).sum(1)
    return rotation, translation, exact & translation.isfinite().all(0)
