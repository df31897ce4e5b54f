"""The base class of all initialisers."""

from __future__ import annotations

from typing import Any

from torch import nn

from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.problem import Problem, Starts

__all__ = ["Initialiser", "trait"]


class Initialiser(Configured):
    """A module that maps a :class:`~kornia_pnpnet.problem.Problem` to :class:`~kornia_pnpnet.problem.Starts`.

    Any module with the same ``forward`` is an initialiser. The defaults below replace attributes that it lacks.

    Attributes:
        pairs_at_once: largest number of pairs per thread in a part of a batch. On a CPU and without gradients, solvers
            split a batch into parts that fit the CPU's caches. ``None`` if batches are not split.
        fixed_pairs: whether the number of pairs has to be ``config["n"]``.
        takes_given: whether ``forward(problem, given)`` accepts a given pose.
        takes_rigs: whether the initialiser solves rigs.
        finds_focal: whether the initialiser estimates an unknown focal length.
        estimates_noise: whether the result contains several poses and the noise. The initialiser then accepts
            ``forward(problem, search_follows=True)``.
        weighs_unusual: whether the weights of pairs that are not of normal scale are also valid.
    """

    pairs_at_once: int | None = None
    fixed_pairs: bool = False
    takes_given: bool = False
    takes_rigs: bool = False
    finds_focal: bool = False
    estimates_noise: bool = False
    weighs_unusual: bool = False

    def forward(self, problem: Problem) -> Starts:
        """Estimate poses of a problem in the solver's frame."""
        raise NotImplementedError


def trait(init: nn.Module | None, name: str) -> Any:
    """An attribute of an initialiser, or its default."""
    return getattr(init, name, getattr(Initialiser, name))
