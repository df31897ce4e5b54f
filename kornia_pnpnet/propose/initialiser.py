"""The base class of all initialisers."""

from __future__ import annotations

from typing import Any

from torch import nn

from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.problem import Problem, Starts

__all__ = ["Initialiser", "trait"]


class Initialiser(Configured):
    """A module that maps a :class:`~kornia_pnpnet.problem.Problem` to :class:`~kornia_pnpnet.problem.Starts`.

    Any module with such a ``forward`` is an initialiser. If a module lacks an attribute below, solvers use the value of
    this class.

    Attributes:
        pairs_at_once: number of pairs whose temporaries fit the caches of one core. Without gradients, a solver splits
            batches with more pairs per thread (CPU only). ``None``: batches are not split.
        fixed_pairs: whether the number of pairs is fixed, ``config["n"]``.
        takes_given: whether ``forward(problem, given)`` accepts a given pose.
        takes_rigs: whether the initialiser solves rigs.
        finds_focal: whether the initialiser estimates an unknown focal length.
        estimates_noise: whether the result contains several poses and the noise. A search may then follow, and the
            initialiser accepts ``forward(problem, search_follows=True)``.
        weighs_unusual: whether the weights are also valid for pairs that are not of normal scale.
    """

    pairs_at_once: int | None = None
    fixed_pairs: bool = False
    takes_given: bool = False
    takes_rigs: bool = False
    finds_focal: bool = False
    estimates_noise: bool = False
    weighs_unusual: bool = False

    def forward(self, problem: Problem) -> Starts:
        """Propose poses for a problem in the solver's frame."""
        raise NotImplementedError


def trait(init: nn.Module | None, name: str) -> Any:
    """The value of an attribute of :class:`Initialiser` for any initialiser."""
    return getattr(init, name, getattr(Initialiser, name))
