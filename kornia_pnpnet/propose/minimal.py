"""Minimal solvers: the contract of RANSAC's samples, and a solver of samples made of any initialiser."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import nn

from kornia_pnpnet.core.checks import check_whole
from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.refine import RobustWeightedLM
from kornia_pnpnet.types import Problem, Hypotheses, Hypotheses, Pose

__all__ = ["MinimalSolver", "SubsetSolver", "describe"]


class MinimalSolver(Protocol):
    """Solves samples of ``sample_size`` pairs each, for example :class:`~kornia_pnpnet.propose.P3P`."""

    @property
    def sample_size(self) -> int:
        """Number of pairs in a sample."""

    def hypotheses(self, corr: Problem) -> Hypotheses | Hypotheses:
        """Return the poses of a batch of samples."""


class SubsetSolver(Configured):
    r"""A solver of samples made of an initialiser, for example the paper's "EPnP-LM on subsets of 7".

    Args:
        init: maps :class:`~kornia_pnpnet.problem.Problem` to a :class:`~kornia_pnpnet.problem.Starts`.
        refine: refines the guess; ``None``: the guess is the solution.
        size: number of pairs in a sample.

    Raises:
        BaseError: when ``size`` is less than 3.

    Example:
        >>> from kornia_pnpnet.propose.mlp import MLPInit
        >>> solver = SubsetSolver(MLPInit(n=7), RobustWeightedLM(m=5, learnable=False), size=7)
        >>> corr = Problem(torch.randn(2, 7, 3), torch.randn(2, 7, 2), torch.ones(2, 7), torch.tensor(3400.0))
        >>> solver.hypotheses(corr).pose.rotation.shape
        torch.Size([2, 1, 3, 3])
    """

    def __init__(self, init: nn.Module, refine: RobustWeightedLM | None = None, *, size: int) -> None:
        super().__init__(locals())
        check_whole(3, size=size)
        self.config.update(init=describe(init), refine=None if refine is None else refine.config)
        self.init = init
        self.refine = refine
        self.sample_size = size

    def hypotheses(self, corr: Problem) -> Hypotheses:
        r"""Solve samples.

        Args:
            corr: normalised correspondences of samples; :math:`N` is ``size``.

        Returns:
            One pose per sample, valid where the initialiser has a guess and the pose is finite.
        """
        guess = self.init(corr)
        pose = guess.pose if self.refine is None else self.refine(corr, guess).pose
        valid = pose.rotation.isfinite().flatten(1).all(-1) & pose.translation.isfinite().all(-1)
        eye = torch.eye(3, dtype=pose.rotation.dtype, device=pose.rotation.device)
        rotation = torch.where(valid[:, None, None], pose.rotation, eye)
        translation = torch.where(valid[:, None], pose.translation, 0.0)
        valid = valid if guess.ok is None else valid & guess.ok
        return Hypotheses(Pose(rotation[:, None], translation[:, None]), valid[:, None])


def describe(part: object) -> dict[str, object]:
    """The class name and the constructor's arguments of a part, as plain data."""
    return {"name": type(part).__name__, **getattr(part, "config", {})}
