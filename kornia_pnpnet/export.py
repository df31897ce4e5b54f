"""Export of solvers as graphs for other programs: ``torch.export`` and ONNX."""

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
from kornia_pnpnet.init import RANSAC, MLPInit
from kornia_pnpnet.solver import PnPNet

__all__ = ["INPUTS", "OUTPUTS", "export_onnx", "export_program"]

#: Names of the inputs of an exported solver, in this order, all float32.
INPUTS = ("world_points", "img_points", "intrinsics", "weights")
#: Names of the outputs: fields of :class:`~kornia_pnpnet.types.PnPResult`. ``ok`` is bool. ``pair_weights`` are the
#: result's ``weights``: ONNX requires another name than that of the input.
OUTPUTS = ("rotation", "translation", "pair_weights", "cost", "ok")
#: Upper bounds of the dynamic dimensions: torch.export simplifies its guards with finite ranges.
_MAX_BATCH = 2**20
_MAX_N = 2**16


class _Graph(nn.Module):
    """A solver whose result is a plain tuple of tensors."""

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
        solver: any solver but RANSAC, whose number of iterations depends on the data.
        n: number of correspondences per problem. With ``None`` the n of the network, or any n of at least 4 when the
            network accepts any n.

    Returns:
        A program that maps :data:`INPUTS` to :data:`OUTPUTS`. The inputs are world points :math:`(B, N, 3)`, pixels
        :math:`(B, N, 2)`, camera matrices :math:`(B, 3, 3)` and weights :math:`(B, N)`, 0 for padding.

    Raises:
        BaseError: when ``n`` is less than 3 or not the n of the network.
        ValueCheckError: when the solver cannot be traced.

    Example:
        >>> from kornia_pnpnet import RobustWeightedLM
        >>> program = export_program(PnPNet(MLPInit(n=6), RobustWeightedLM(m=1)))
        >>> inputs = torch.ones(5, 6, 3), torch.ones(5, 6, 2), torch.eye(3).expand(5, 3, 3), torch.ones(5, 6)
        >>> dict(zip(OUTPUTS, program.module()(*inputs)))["ok"]
        tensor([False, False, False, False, False])
    """
    if isinstance(solver.init, RANSAC):
        raise ValueCheckError("RANSAC cannot be exported: the number of its samples depends on the data.")
    if n is not None:
        check_whole(3, n=n)
    fixed = int(solver.init.config["n"]) if isinstance(solver.init, MLPInit) else n
    if n not in (None, fixed):
        raise ValueCheckError(f"The solver's network was built for n = {fixed}, got n = {n!r}.")
    problems = SyntheticProblems(n=12 if fixed is None else fixed, batch_size=3, seed=0).batch(0)
    weights = torch.ones_like(problems.world_points[..., 0])
    inputs = (problems.world_points, problems.img_points, problems.intrinsics, weights)
    batch: dict[int, Any] = {0: torch.export.Dim("batch", min=1, max=_MAX_BATCH)}
    points = batch if fixed is not None else {**batch, 1: torch.export.Dim("pairs", min=4, max=_MAX_N)}
    shapes = (points, points, batch, points)
    try:
        with torch.no_grad():
            return torch.export.export(_Graph(copy.deepcopy(solver).float().eval()), inputs, dynamic_shapes=shapes)
    except Exception as error:
        reason = " ".join(str(error).split())[:300]
        raise ValueCheckError(f"{type(solver.init).__name__} cannot be exported: {reason}") from error


def export_onnx(solver: PnPNet, path: str | Path, n: int | None = None) -> Path:
    """Write a solver as an ONNX model in one file. ONNX Runtime runs the model without PyTorch.

    Args:
        solver: see :func:`export_program`.
        path: the file to write. An existing file is replaced when the model is complete.
        n: see :func:`export_program`.

    Returns:
        The path.

    Raises:
        BaseError: see :func:`export_program`.
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
        warnings.simplefilter("ignore", FutureWarning)  # the exporter warns about its own code
        model = torch.onnx.export(
            program, dynamo=True, verbose=False, optimize=False, input_names=inputs, output_names=outputs
        )
    assert model is not None
    _simplify(model.model)
    graph = model.model_proto
    batches = {value.type.tensor_type.shape.dim[0].dim_param for value in graph.graph.input}
    if not batches.isdisjoint({"", *map(str, range(10))}):
        # The exporter replaced the batch size by that of the example inputs.
        raise ValueCheckError(f"{type(solver.init).__name__} cannot be exported to ONNX for batches of any size.")
    with atomic_open(path, "wb") as file:
        file.write(graph.SerializeToString())
    return path


def _simplify(model: Any) -> None:
    """Simplify as ``torch.onnx.export(optimize=True)`` does, but without its rewrite rules.

    The time of the rules grows with the square of the size. For the thousands of nodes of a solver they take nine
    tenths of all time, and take a twentieth of the nodes away.
    """
    from onnx_ir.passes import Sequential, common
    from onnxscript import optimizer

    common.InlinePass()(model)
    optimizer.fold_constants_ir(model, onnx_shape_inference=False)
    Sequential(
        common.RemoveUnusedNodesPass(),
        common.RemoveUnusedOpsetsPass(),
        common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        common.LiftSubgraphInitializersToMainGraphPass(),
        common.DeduplicateInitializersPass(),
        common.CommonSubexpressionEliminationPass(),
        common.OutputFixPass(),
        common.NameFixPass(),
    )(model)
