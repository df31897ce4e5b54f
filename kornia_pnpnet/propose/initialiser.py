"""The base of all initialisers, and what distinguishes them."""

from __future__ import annotations

from typing import Any

from torch import nn

from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.problem import Problem, Starts

__all__ = ["Initialiser", "trait"]


class Initialiser(Configured):
    """A module that maps a :class:`~kornia_pnpnet.problem.Problem` to :class:`~kornia_pnpnet.problem.Starts`.

    Any module with such a ``forward`` is an initialiser. An attribute below that it lacks has the value of this class.

    Attributes:
        pairs_at_once: number of pairs per core whose temporaries fit its caches. A solver splits larger batches where
            gradients allow it. ``None``: the whole batch.
        fixed_pairs: whether the number of pairs is fixed, ``config["n"]``.
        takes_given: whether a given pose is an argument, ``forward(problem, given)``.
        takes_rigs: whether rigs are solved.
        finds_focal: whether an unknown focal length is estimated.
        estimates_noise: whether the result has several poses and the noise, so that a search may follow:
            ``forward(problem, search_follows=True)``.
        weighs_unusual: whether the weights of pairs that are not of normal scale are valid.
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
    """A trait of any initialiser, see :class:`Initialiser`."""
    return getattr(init, name, getattr(Initialiser, name))
