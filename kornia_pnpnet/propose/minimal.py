"""The interface of RANSAC's minimal solvers, and a minimal solver that runs any initialiser."""

from __future__ import annotations

from typing import Protocol

from torch import nn

from kornia_pnpnet.core.checks import check_whole
from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.core.performance import ascending_order
from kornia_pnpnet.core.trees import map_tensors, pairs_at
from kornia_pnpnet.problem import Hypotheses, Problem
from kornia_pnpnet.propose.initialiser import trait
from kornia_pnpnet.propose.scoring import as_entries
from kornia_pnpnet.refine.lm import RobustWeightedLM
from kornia_pnpnet.result import gate_pose

__all__ = ["MinimalSolver", "SubsetSolver", "describe"]


class MinimalSolver(Protocol):
    """A solver for samples of ``sample_size`` pairs. :class:`~kornia_pnpnet.propose.p3p.P3P` is an example."""

    @property
    def sample_size(self) -> int:
        """Number of pairs in a sample."""

    def hypotheses(self, problem: Problem) -> Hypotheses:
        """Find the poses of samples. A sample is a normalised problem of ``sample_size`` pairs.

        If the focal length is unknown, the last row of each rotation and of each translation is multiplied by
        ``problem.focal`` and divided by the estimated focal length.
        """


class SubsetSolver(Configured):
    r"""A minimal solver that runs an initialiser on each sample, for example the paper's "EPnP-LM on subsets of 7".

    Args:
        init: initialiser, which maps :class:`~kornia_pnpnet.problem.Problem` to :class:`~kornia_pnpnet.problem.Starts`.
        refine: refines the poses of the initialiser, or ``None`` for no refinement.
        size: number of pairs in a sample.

    Raises:
        BaseError: when ``size`` is less than 3.

    Example:
        >>> import torch
        >>> from kornia_pnpnet.propose.mlp import MLPInit
        >>> solver = SubsetSolver(MLPInit(n=7), RobustWeightedLM(m=5, learnable=False), size=7)
        >>> solver.hypotheses(Problem.of(torch.randn(2, 7, 3), torch.randn(2, 7, 2), 3400.0)).pose.rotation.shape
        torch.Size([2, 1, 3, 3])
    """

    def __init__(self, init: nn.Module, refine: RobustWeightedLM | None = None, *, size: int) -> None:
        super().__init__(locals())
        check_whole(3, size=size)
        self.config.update(init=describe(init), refine=None if refine is None else refine.config)
        self.init, self.refine, self.sample_size = init, refine, size

    def hypotheses(self, problem: Problem) -> Hypotheses:
        """Find one pose per sample. A pose is valid if the pose is finite and the start is ``ok``."""
        problem = problem._replace(free_focal=None)  # the pose is scored with the focal length of the problem
        if trait(self.init, "fixed_pairs"):  # such a network needs pairs that are sorted by their pixels
            problem = pairs_at(problem, ascending_order(problem.img_points.permute(2, 1, 0)))
        starts = self.init(problem)
        pose = starts.pose if self.refine is None else self.refine(problem, starts).pose
        valid = as_entries(pose).isfinite().all(-1)
        pose = gate_pose(pose, valid, valid)
        valid = valid if starts.ok is None else valid & starts.ok
        return Hypotheses(map_tensors(lambda x: x[:, None], pose), valid[:, None])


def describe(part: object) -> dict[str, object]:
    """The class name and the constructor arguments of a module, as plain data."""
    return {"name": type(part).__name__, **getattr(part, "config", {})}
