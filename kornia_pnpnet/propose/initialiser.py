"""The base of all initialisers."""

from __future__ import annotations

from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.problem import Problem, Starts

__all__ = ["Initialiser"]


class Initialiser(Configured):
    """A module that maps a :class:`Problem` to :class:`Starts`; :mod:`kornia_pnpnet.propose` explains the traits."""

    pairs_at_once: int | None = None
    fixed_pairs: bool = False
    takes_given: bool = False
    takes_rigs: bool = False
    estimates_noise: bool = False
    weighs_unusual: bool = False

    def forward(self, problem: Problem) -> Starts:
        """Propose poses.

        Args:
            problem: the problem in the solver's frame.
        """
        raise NotImplementedError
