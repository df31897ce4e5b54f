"""The base class of initialisers: what a solver may ask of a module that finds the first poses."""

from __future__ import annotations

from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.problem import Problem, Starts

__all__ = ["Initialiser"]


class Initialiser(Configured):
    """Maps a :class:`~kornia_pnpnet.problem.Problem` to a :class:`~kornia_pnpnet.problem.Starts`.

    Attributes:
        pairs_at_once: number of pairs per core above which a solver splits a batch; ``None``: it never splits.
        fixed_pairs: every problem has the same number of pairs, which the initialiser was made for.
        takes_given: ``forward`` takes poses of the caller that compete with its own, as a second argument.
        takes_rigs: the problem may be one of a rig.
        finds_focal: the focal length may be unknown.
        estimates_noise: the starts hold the noise of the pairs.
        weighs_unusual: the weights of the starts also tell inliers among pairs that are not of normal scale.
    """

    pairs_at_once: int | None = None
    fixed_pairs = False
    takes_given = False
    takes_rigs = False
    finds_focal = False
    estimates_noise = False
    weighs_unusual = False

    def forward(self, problem: Problem) -> Starts:
        """Find poses to start from."""
        raise NotImplementedError
