"""Views are rotated or mirrored copies of a problem. A network finds a different pose for each view."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from kornia_pnpnet.core.performance import ascending_order
from kornia_pnpnet.core.trees import iter_tensors, map_tensors
from kornia_pnpnet.problem import Problem, Starts
from kornia_pnpnet.result import Pose

__all__ = ["VIEWS", "from_views"]

#: The eight symmetries of a square image. The three flags are: exchange x and y, then negate x, then negate y.
VIEWS = (
    (False, False, False),
    (True, False, False),
    (False, True, True),
    (True, True, True),
    (False, True, False),
    (False, False, True),
    (True, True, False),
    (True, False, True),
)


def from_views(init: Callable[[Problem], Starts], problem: Problem, count: int, order: bool) -> Starts:
    """Apply an initialiser to the views of a problem. The result has the poses of all views.

    A view exchanges or negates the coordinates x and y of pixels and of world points in the same way.

    Args:
        init: the initialiser.
        problem: :math:`B` problems.
        count: number of views, 2 to 8. The first view is the problem itself.
        order: whether the initialiser needs pairs that are sorted by their pixels.
    """
    batch = problem.weights.shape[0]
    starts = init(_views(problem, count, order))
    first: Starts = map_tensors(lambda x: x[:batch], starts)
    return first.with_others(*(x for pose in starts.poses for x in _undone(pose, count)))


def _views(problem: Problem, count: int, order: bool) -> Problem:
    """Concatenate the first views of all problems, the second views, and so on. Drop covariances and terms."""
    noise = None if problem.noise is None else problem.noise.sigmas
    of_pairs = problem.weights, problem.usual, noise, problem.confidence
    others = [values.mT for values in iter_tensors(of_pairs)]  # (N, B) each
    x, y, z, u, v = (*problem.world_points.permute(2, 1, 0), *problem.img_points.permute(2, 1, 0))
    seen = [torch.stack((*_exchanged(x, y, *view), z, *_exchanged(u, v, *view), *others)) for view in VIEWS[:count]]
    if order:
        there = (problem.usual_weights != 0).mT
        keys = torch.cat([torch.where(there, view[3:5].detach(), torch.inf) for view in seen[1:]], -1)
        at = ascending_order(keys)  # (B * (count - 1), N)
        seen = [seen[0], torch.cat(seen[1:], -1).gather(1, at.mT.expand(5 + len(others), -1, -1))]
    rows = torch.cat(seen, -1)
    world_points, img_points = rows[:5].permute(2, 1, 0).split((3, 2), -1)
    rest = iter(rows[5:].mT)
    weights, usual, noise, confidence = map_tensors(lambda _: next(rest), of_pairs)
    scales = problem.img_scale.repeat(count), problem.world_scale.repeat(count), usual
    return Problem(world_points, img_points, weights, problem.focal, *scales, noise, confidence)


def _undone(pose: Pose, count: int) -> list[Pose]:
    """Transform the poses of all views except the first into poses of the problems."""
    poses = []
    matrices, vectors = (x.movedim(0, -1).unflatten(-1, (count, -1)).unbind(-2)[1:] for x in pose)
    for view, matrix, vector in zip(VIEWS[1:count], matrices, vectors, strict=True):  # (3, 3, B), (3, B)
        for axis in (0, 1):
            matrix = _axes_back(matrix, axis, view)
        poses.append(Pose(matrix.movedim(-1, 0), _axes_back(vector, 0, view).movedim(-1, 0)))
    return poses


def _exchanged(x: Tensor, y: Tensor, swap: bool, reverse_x: bool, reverse_y: bool) -> tuple[Tensor, Tensor]:
    """Convert the coordinates x and y in the problem to coordinates in a view."""
    x, y = (y, x) if swap else (x, y)
    return -x if reverse_x else x, -y if reverse_y else y


def _axes_back(entries: Tensor, axis: int, view: tuple[bool, bool, bool]) -> Tensor:
    """Convert the coordinates x, y and z of a view (along ``axis``) to coordinates in the problem."""
    x, y, z = entries.unbind(axis)
    x, y = _exchanged(x, y, False, *view[1:])
    return torch.stack((y, x, z) if view[0] else (x, y, z), axis)
