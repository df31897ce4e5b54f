"""The first proposals for a problem: from an initialiser of any kind, the caller's pose, and mirror images."""

from __future__ import annotations

import torch
from torch import nn

from kornia_pnpnet.problem import Problem, Starts
from kornia_pnpnet.propose.alternatives import is_seen
from kornia_pnpnet.propose.initialiser import trait
from kornia_pnpnet.propose.rig import starts_of_rig
from kornia_pnpnet.propose.views import from_views
from kornia_pnpnet.result import Pose

__all__ = ["propose"]


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
    # Pairs that are not of normal scale have a weight where a start sees them.
    return starts._replace(weights=starts.weights * torch.where(is_seen(starts, problem), 1.0, problem.usual))
