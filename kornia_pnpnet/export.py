"""A solver as a graph for other programs: ``torch.export`` and ONNX."""

from __future__ import annotations

import copy
import warnings
from pathlib import Path
from typing import Any

import torch
from kornia.core.exceptions import ValueCheckError
from torch import Tensor, nn

from kornia_pnpnet.core.checks import check_whole
from kornia_pnpnet.core.files import atomic_open
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.init import MLPInit
from kornia_pnpnet.solver import PnPNet

__all__ = ["INPUTS", "OUTPUTS", "export_onnx", "export_program"]

#: Names of the inputs of an exported solver, in their order, all float32.
INPUTS = ("world_points", "img_points", "intrinsics", "weights")
#: Names of its outputs: fields of :class:`~kornia_pnpnet.types.PnPResult`, of which ``pair_weights`` is ``weights``: in
#: ONNX no output has the name of an input. ``ok`` is bool.
OUTPUTS = ("rotation", "translation", "pair_weights", "cost", "ok")
_MOST_PAIRS = 65_536


class _Graph(nn.Module):
    """Tensors in, tensors out."""

    def __init__(self, solver: PnPNet) -> None:
        super().__init__()
        self.solver = solver

    def forward(
        self, world_points: Tensor, img_points: Tensor, intrinsics: Tensor, weights: Tensor
    ) -> tuple[Tensor, ...]:
        result = self.solver(world_points, img_points, intrinsics, weights)
        return result.rotation, result.translation, result.weights, result.cost, result.ok


def export_program(solver: PnPNet, n: int | None = None) -> torch.export.ExportedProgram:
    r"""Trace a solver for batches of any size.

    Args:
        solver: with trained or classical parts; RANSAC, which draws until it has seen enough, has no graph.
        n: number of pairs. ``None``: what its network takes, and any number from 4 on where it takes any.

    Returns:
        A program of :data:`INPUTS`: points :math:`(B, N, 3)`, pixels :math:`(B, N, 2)`, cameras :math:`(B, 3, 3)`,
        weights :math:`(B, N)`, 0 for padding. It returns :data:`OUTPUTS`.

    Raises:
        BaseError: when ``n`` is less than 3, or not what the network takes.
        ValueCheckError: when the solver has no graph.

    Example:
        >>> from kornia_pnpnet import RobustWeightedLM
        >>> program = export_program(PnPNet(MLPInit(n=6), RobustWeightedLM(m=1)))
        >>> inputs = torch.ones(5, 6, 3), torch.ones(5, 6, 2), torch.eye(3).expand(5, 3, 3), torch.ones(5, 6)
        >>> dict(zip(OUTPUTS, program.module()(*inputs)))["ok"]
        tensor([False, False, False, False, False])
    """
    if n is not None:
        check_whole(3, n=n)
    fixed = int(solver.init.config["n"]) if isinstance(solver.init, MLPInit) else n
    if n not in (None, fixed):
        raise ValueCheckError(f"The solver's network takes {fixed} pairs, so n cannot be {n!r}.")
    problems = SyntheticProblems(n=12 if fixed is None else fixed, batch_size=3, seed=0).batch(0)
    inputs = (*problems[:3], torch.ones_like(problems.world_points[..., 0]))
    batch = torch.export.Dim("batch", min=1, max=2**20)
    pairs = {} if fixed is not None else {1: torch.export.Dim("pairs", min=4, max=_MOST_PAIRS)}
    shapes: tuple[dict[int, Any], ...] = ({0: batch, **pairs}, {0: batch, **pairs}, {0: batch}, {0: batch, **pairs})
    try:
        with torch.no_grad():
            return torch.export.export(_Graph(copy.deepcopy(solver).float().eval()), inputs, dynamic_shapes=shapes)
    except Exception as error:
        reason = " ".join(str(error).split())[:300]
        raise ValueCheckError(f"{type(solver.init).__name__} cannot be exported: {reason}") from error


def export_onnx(solver: PnPNet, path: str | Path, n: int | None = None) -> Path:
    """Write a solver as an ONNX model, in one file, which ONNX Runtime runs without PyTorch.

    Args:
        solver: as for :func:`export_program`.
        path: of the file; replaced whole or not at all.
        n: likewise.

    Returns:
        The path.

    Raises:
        BaseError: as of :func:`export_program`.
        ImportError: without the extra ``onnx``.
        OSError: when the file cannot be written.
    """
    try:
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise ImportError("ONNX needs more packages: pip install 'kornia_pnpnet[onnx]'") from error
    path = Path(path)
    program = export_program(solver, n)
    inputs, outputs = list(INPUTS), list(OUTPUTS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # of the exporter, about itself
        model = torch.onnx.export(program, dynamo=True, verbose=False, input_names=inputs, output_names=outputs)
    assert model is not None
    graph = model.model_proto
    batches = {value.type.tensor_type.shape.dim[0].dim_param for value in graph.graph.input}
    if not batches.isdisjoint({"", *map(str, range(10))}):
        # What is computed with the batch as a number would hold for the batch of the example alone.
        raise ValueCheckError(f"{type(solver.init).__name__} cannot be exported to ONNX for batches of any size.")
    with atomic_open(path, "wb") as file:
        file.write(graph.SerializeToString())
    return path
