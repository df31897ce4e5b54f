"""The first proposals for a problem: from an initialiser of any kind, the caller's pose, and mirror images."""

from __future__ import annotations

import torch
from torch import nn

from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.problem import Problem, Starts, State
from kornia_pnpnet.propose.initialiser import trait
from kornia_pnpnet.propose.rig import starts_of_rig
from kornia_pnpnet.propose.views import from_views
from kornia_pnpnet.refine.residual import project
from kornia_pnpnet.result import Pose

__all__ = ["propose"]

# Focal lengths. A pair that is not of normal scale is refined only when some first pose projects it this close.
_SEEN = 0.25


def propose(
    init: nn.Module | None,
    problem: Problem,
    given: Pose | None,
    *,
    views: int = 1,
    order: bool = True,
    fixed: bool = False,
    search_follows: bool = False,
) -> Starts:
    """Propose poses to start from.

    Args:
        init: the initialiser; ``None``: the refinement starts from the given pose.
        problem: the problem.
        given: the caller's pose in the frame of the problem; it competes with the others.
        views: number of mirror images that an initialiser of one camera sees.
        order: whether the pairs are in the order of their pixels.
        fixed: whether the effort for a rig is fixed.
        search_follows: whether an initialiser that estimates the noise may leave hard problems to a search.
    """
    if init is None:
        assert given is not None
        return Starts(given, torch.ones_like(problem.weights))
    if problem.rig is not None and not trait(init, "takes_rigs"):
        starts = starts_of_rig(problem, given, with_noise=trait(init, "estimates_noise"), fixed=fixed)
    elif trait(init, "takes_given"):
        starts, given = init(problem, given), None
    elif views > 1:
        starts = from_views(init, problem, views, order)
    else:
        starts = init(problem, search_follows=True) if search_follows else init(problem)
    if given is not None:
        starts = starts.with_others(given)._replace(ok=None)
    if trait(init, "weighs_unusual"):
        return starts
    # A pair that is not of normal scale has a weight where some pose projects its point close to its pixel.
    known, limit = problem.map(torch.Tensor.detach), (_SEEN * problem.focal) ** 2
    seen = torch.zeros_like(problem.weights, dtype=torch.bool)
    for pose in map_tensors(torch.Tensor.detach, starts.poses):
        projection = project(State.of(pose), known)
        seen = seen | (projection.in_front & (projection.sq_residual < limit))
    return starts._replace(weights=starts.weights * torch.where(seen, 1.0, problem.usual))
