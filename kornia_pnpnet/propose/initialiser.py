"""The base class of all initialisers."""

from __future__ import annotations

from typing import Any

from torch import nn

from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.problem import Problem, Starts

__all__ = ["Initialiser", "trait"]


class Initialiser(Configured):
    """A module that maps a :class:`~kornia_pnpnet.problem.Problem` to :class:`~kornia_pnpnet.problem.Starts`.

    Any module with this ``forward`` is an initialiser. If a module lacks an attribute, this class gives the default.

    Attributes:
        pairs_at_once: largest number of pairs per part and thread, or ``None`` for no split. On a CPU and without
            gradients, solvers split a batch into parts that fit the CPU's caches.
        fixed_pairs: whether the number of pairs has to be ``config["n"]``.
        takes_given: whether ``forward(problem, given)`` accepts a given pose.
        takes_rigs: whether the initialiser solves rigs.
        finds_focal: whether the initialiser estimates an unknown focal length.
        estimates_noise: whether the result contains the noise. Such an initialiser accepts
            ``forward(problem, search_follows=True)``, and then its last pose is the most promising.
        weighs_unusual: whether the weights of unusual pairs (``Problem.usual``) are final. If not, `propose` sets them.
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
    """Get an attribute of an initialiser, or the default if the initialiser lacks the attribute."""
    return getattr(init, name, getattr(Initialiser, name))
