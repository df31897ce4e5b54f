"""Export solvers as programs of ``torch.export``, as ahead-of-time packages, and as ONNX models."""

from __future__ import annotations

import copy
import importlib
import io
import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from kornia.core.exceptions import ValueCheckError
from kornia.geometry.camera import PinholeCamera
from torch import Tensor, nn

from kornia_pnpnet.core.checks import check_shapes, check_tensors, check_whole
from kornia_pnpnet.core.extras import needs
from kornia_pnpnet.core.files import atomic_open
from kornia_pnpnet.core.performance import INLINE, package_options
from kornia_pnpnet.data import CameraProblems
from kornia_pnpnet.problem import MIN_PAIRS
from kornia_pnpnet.propose.initialiser import trait
from kornia_pnpnet.result import Pose, camera_matrices
from kornia_pnpnet.solver import PnPNet

__all__ = [
    "INPUTS",
    "OUTPUTS",
    "RIG_INPUTS",
    "ExportedCamera",
    "ExportedResult",
    "PackagedSolver",
    "check_packages",
    "export_onnx",
    "export_package",
    "export_program",
    "load_package",
]


class ExportedResult(NamedTuple):
    """The outputs of an exported solver: some fields of :class:`~kornia_pnpnet.result.PnPResult`.

    Attributes:
        rotation: shape :math:`(B, 3, 3)`.
        translation: shape :math:`(B, 3)`.
        pair_weights: the result's ``weights``, shape :math:`(B, N)`. In ONNX, inputs and outputs cannot share names.
        cost: shape :math:`(B,)`.
        ok: bool, shape :math:`(B,)`.
    """

    rotation: Tensor
    translation: Tensor
    pair_weights: Tensor
    cost: Tensor
    ok: Tensor


class ExportedCamera(NamedTuple):
    """The fields of :class:`ExportedResult`, then ``camera`` (the result's ``intrinsics``, shape :math:`(B, 3, 3)`)."""

    rotation: Tensor
    translation: Tensor
    pair_weights: Tensor
    cost: Tensor
    ok: Tensor
    camera: Tensor


#: Names of the inputs of an exported solver, in order. All inputs are float32.
INPUTS = ("world_points", "img_points", "intrinsics", "weights")
#: Names of the inputs of a solver that was exported for rigs.
RIG_INPUTS = (*INPUTS, "rig_rotation", "rig_translation")
#: Names of the outputs of an exported solver if the focal length is known.
OUTPUTS = ExportedResult._fields
# Upper bounds of the dynamic dimensions. With finite ranges, torch.export can simplify its guards.
_MAX_BATCH, _MAX_N = 2**20, 2**16
# Keys of a package's metadata. `_ANY` is the value for a size that is not fixed.
_BATCH, _N, _ANY, _RIG = "pnpnet_batch", "pnpnet_n", "any", "pnpnet_rig"
# Name of the only model (if `n` of `export_package` is no sequence), and folder of all models in a package's archive.
_MODEL, _MODELS = "model", "/data/aotinductor/"


class _Graph(nn.Module):
    """A solver whose result is a plain tuple of tensors."""

    def __init__(self, solver: PnPNet) -> None:
        super().__init__()
        self.solver = solver

    def forward(
        self, world_points: Tensor, img_points: Tensor, intrinsics: Tensor, weights: Tensor, *rig: Tensor
    ) -> tuple[Tensor, ...]:
        cam_from_rig = Pose(*rig) if rig else None
        result = self.solver(world_points, img_points, intrinsics, weights, cam_from_rig=cam_from_rig)
        outputs = result.rotation, result.translation, result.weights, result.cost, result.ok
        return outputs if self.solver.focal == "known" else (*outputs, result.intrinsics)


def export_program(
    solver: PnPNet, n: int | None = None, *, batch: int | None = None, rig: bool = False
) -> torch.export.ExportedProgram:
    r"""Trace a solver with ``torch.export``.

    Args:
        solver: a solver whose initialiser is not RANSAC. The program always uses ``effort="fixed"``.
        n: number of pairs per problem. ``None`` means the number for which the network was built. If the solver accepts
            any number of pairs, ``None`` means any number from 4 on.
        batch: number of problems in each call; ``None`` means any number. A compiler can optimise for a fixed number.
        rig: whether the program solves problems of rigs (several cameras with one pose).

    Returns:
        A program that maps :data:`INPUTS` to the fields of :class:`ExportedResult`, or of :class:`ExportedCamera` if
        the focal length is unknown. Inputs have the shapes of ``PnPNet.forward``. Padding needs the weight 0. A program
        for rigs takes :data:`RIG_INPUTS`. For rigs, ``intrinsics`` has a matrix for each pair, :math:`(B, N, 3, 3)`.

    Raises:
        BaseError: when ``n`` is less than 3 or not the network's number of pairs, or when ``batch`` is less than 1 or
            more than 1 048 576.
        ValueCheckError: when the solver cannot be traced, or when a solver for rigs has an unknown focal length or no
            initialiser.

    Example:
        >>> from kornia_pnpnet import MLPInit, RobustWeightedLM
        >>> program = export_program(PnPNet(MLPInit(n=6), RobustWeightedLM(m=1)))
        >>> inputs = torch.ones(5, 6, 3), torch.ones(5, 6, 2), torch.eye(3).expand(5, 3, 3), torch.ones(5, 6)
        >>> dict(zip(OUTPUTS, program.module()(*inputs)))["ok"]
        tensor([False, False, False, False, False])
    """
    fixed = _checked_n(solver, n, batch=batch, rig=rig)
    pairs, count = fixed or 12, int(batch or 3)
    problems = CameraProblems(n=pairs, batch_size=count, cameras=3 if rig else 1).batch(0)
    inputs = (*problems[:3], torch.ones_like(problems.world_points[..., 0]), *(problems.cam_from_rig or ()))
    sizes: dict[int, Any] = {} if batch is not None else {0: torch.export.Dim("batch", min=1, max=_MAX_BATCH)}
    points = sizes if fixed is not None else {**sizes, 1: torch.export.Dim("pairs", min=4, max=_MAX_N)}
    shapes = (points, points, points if rig else sizes, points, *((points, points),) * rig)
    try:
        with torch.no_grad(), warnings.catch_warnings(action="ignore", category=FutureWarning):  # PyTorch's code warns
            graph = _Graph(copy.deepcopy(solver).cpu().float().eval())
            return torch.export.export(graph, inputs, dynamic_shapes=shapes)
    except Exception as error:
        raise ValueCheckError(f"{type(solver.init).__name__} cannot be exported: {_reason(error)}") from error


def _checked_n(solver: PnPNet, n: int | None, *, batch: int | None, rig: bool) -> int | None:
    """Check the arguments, and return the fixed number of pairs of a program, ``None`` if it takes any number."""
    if trait(solver.init, "takes_given"):
        raise ValueCheckError("RANSAC cannot be exported: the number of its samples depends on the data.")
    nominal = trait(solver.init, "estimates_noise") and solver.refine.by_residual
    if solver.focal == "unknown" and (solver.radial or not nominal):
        raise ValueCheckError(
            "With an unknown focal length, only a solver with SetInit, with iterations by residual and without radial"
            " distortion can be exported."
            " Other solvers search for the focal length, and the number of samples depends on the data."
        )
    if rig and (solver.focal == "unknown" or solver.init is None):
        raise ValueCheckError("For rigs a solver needs an initialiser and known focal lengths.")
    check_whole(3, n=3 if n is None else n)
    check_whole(1, _MAX_BATCH, batch=1 if batch is None else batch)
    config: Any = getattr(solver.init, "config", {})
    fixed = int(config["n"]) if trait(solver.init, "fixed_pairs") else n
    if n not in (None, fixed):
        raise ValueCheckError(f"The solver's network was built for n = {fixed}, got n = {n!r}.")
    return fixed


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:300]


def check_packages(suffix: str) -> None:
    """Raise ``ImportError`` when the extra ``onnx`` (for ``.onnx``) or a C++ compiler (for ``.pt2``) is missing."""
    if suffix == ".onnx":
        with needs("onnx", "ONNX models need more packages"):
            for name in ("onnx", "onnx_ir", "onnxscript"):
                importlib.import_module(name)
        return
    from torch._inductor.cpp_builder import get_cpp_compiler

    try:
        get_cpp_compiler()
    except RuntimeError as error:
        raise ImportError(
            "Ahead-of-time packages need a C++ compiler: install g++ (Debian, Ubuntu: apt install g++) or clang, or"
            " name yours in the environment variable CXX"
        ) from error


def export_package(
    solver: PnPNet,
    path: str | Path,
    n: int | Sequence[int] | None = None,
    *,
    batch: int | None = None,
    rig: bool = False,
) -> Path:
    """Compile a solver ahead of time with AOTInductor. See :func:`export_program` for the arguments and their errors.

    :func:`load_package` loads the package without tracing or compiling. C++ programs need only libtorch to load a
    package. A package runs on one thread, except for matrix products. A package needs the compiling machine's PyTorch
    version, and a CPU that has all of this machine's instruction sets (for example AVX-512). Compiling takes minutes.
    An existing file is replaced only when the package is complete.

    A package for ``batch=1`` and a fixed number of pairs solves one problem in a fraction of the time of other
    packages. With PyTorch's own loader, a call of such a package overwrites the previous result of the same thread.

    If ``n`` is a sequence of numbers, such as ``(16, 64, 256)``, the package holds a model for each number. If there
    are several, a problem is padded to the next of these numbers. C++ programs choose a model by name: the model for
    16 pairs is "n16". If ``n`` is a single number or ``None``, the only model is "model".

    Returns:
        The path, which must end in ``.pt2``.

    Raises:
        ImportError: when no C++ compiler is installed.
    """
    path = Path(path)
    if path.suffix != ".pt2":
        raise ValueCheckError(f"The name of a package must end in .pt2, got '{path}'.")
    check_packages(".pt2")
    from torch._inductor.package.package import package_aoti  # imports the compiler

    sizes = {f"n{size}": size for size in n} if isinstance(n, Sequence) else {_MODEL: n}
    check_whole(1, sizes=len(sizes))
    # All numbers are checked before the first model is compiled.
    fixed = {name: _checked_n(solver, size, batch=batch, rig=rig) for name, size in sizes.items()}
    files = {name: _compiled(solver, size, batch=batch, rig=rig) for name, size in fixed.items()}
    content = io.BytesIO()
    package_aoti(content, files)
    with atomic_open(path, "wb") as file:
        file.write(content.getbuffer())
    return path


def _compiled(solver: PnPNet, pairs: int | None, *, batch: int | None, rig: bool) -> Any:
    """Compile a solver, and return the files of one model of a package."""
    program = export_program(solver, pairs, batch=batch, rig=rig)
    metadata = {_BATCH: str(batch or _ANY), _N: str(pairs or _ANY), _RIG: str(rig)}
    # For one problem, operator calls and allocations take most of the time, and inlined operators avoid both. For
    # several problems, inlined operators are slower than calls.
    inline = batch == 1 and pairs is not None
    options = {**package_options(pairs, on_stack=inline), "aot_inductor.metadata": metadata}
    with warnings.catch_warnings(action="ignore"):  # the compiler warns about its own code
        program = program.run_decompositions(INLINE) if inline else program
        inputs, options = program.example_inputs, {**options, "aot_inductor.package": True}
        return torch._inductor.aot_compile(program.module(check_guards=False), *inputs, options=options)


class PackagedSolver:
    """A solver that :func:`export_package` compiled. Results have no gradients.

    Calls compute in float32 on the CPU. Inputs of any dtype, device and memory layout are converted.

    Attributes:
        batch: number of problems in each call; ``None``: any number.
        sizes: the numbers of pairs for which the package has models, in increasing order; empty if one model takes any
            number from 4 on. With several models, the smallest one that is large enough solves the padded problem.
        rig: whether the package solves problems of rigs.
    """

    def __init__(self, loaders: Sequence[torch._C._aoti.AOTIModelPackageLoader]) -> None:
        metadata = [loader.get_metadata() for loader in loaders]
        self.batch = None if metadata[0][_BATCH] == _ANY else int(metadata[0][_BATCH])
        self.rig = metadata[0][_RIG] == str(True)
        fixed = metadata[0][_N] != _ANY
        self._runs = {int(of[_N]) if fixed else 0: loader.run for of, loader in zip(metadata, loaders, strict=True)}
        self.sizes = tuple(sorted(self._runs)) if fixed else ()

    def __call__(
        self,
        world_points: Tensor,
        img_points: Tensor,
        intrinsics: Tensor | PinholeCamera,
        weights: Tensor | None = None,
        *,
        cam_from_rig: Pose | None = None,
    ) -> ExportedResult | ExportedCamera:
        """Solve a batch of problems of pixels, see ``PnPNet.forward``. A package for rigs requires ``cam_from_rig``.

        Raises:
            ShapeError: when a shape differs from the shapes for which the package was compiled.
            ValueCheckError: when a package for rigs gets no ``cam_from_rig``, or any other package gets one.
        """
        intrinsics = camera_matrices(intrinsics)
        check_tensors({"world_points": world_points, "img_points": img_points, "intrinsics": intrinsics})
        if self.rig != (cam_from_rig is not None):
            raise ValueCheckError(f"This package {'needs' if self.rig else 'does not take'} cam_from_rig.")
        batch, given = (*world_points.shape, 0, 0)[:2]
        size = next((size for size in self.sizes if size >= given), max(self.sizes, default=0))
        any_number = not self.sizes or (len(self.sizes) > 1 and given <= size)
        batch, n = self.batch or batch, max(given, MIN_PAIRS if self.sizes else 4) if any_number else size
        weights = world_points.new_ones(batch, n) if weights is None else weights
        cameras = (batch, n, 3, 3) if self.rig else (batch, 3, 3)
        intrinsics = intrinsics.expand(cameras) if intrinsics.ndim == 2 else intrinsics
        shapes = (batch, n, 3), (batch, n, 2), cameras, (batch, n), (batch, n, 3, 3), (batch, n, 3)
        inputs = [world_points, img_points, intrinsics, weights, *(cam_from_rig or ())]
        check_shapes(dict(zip(RIG_INPUTS, zip(inputs, shapes, strict=False), strict=False)))
        inputs = [x.to("cpu", torch.float32) for x in inputs]
        if n < size:  # the padding repeats the last pair, with weight 0
            pair = torch.arange(size, device="cpu").clamp(max=n - 1)
            inputs = [x if i == 2 and not self.rig else x.index_select(1, pair) for i, x in enumerate(inputs)]
            inputs[3][:, n:] = 0.0
        # Compiled code does not check strides. Results are copied, because the next call may overwrite them.
        rotation, translation, weights, *others = self._runs[size]([x.contiguous() for x in inputs])
        results = [x.clone() for x in (rotation, translation, weights[:, :n], *others)]
        return (ExportedResult if len(results) == len(OUTPUTS) else ExportedCamera)(*results)


def load_package(path: str | Path) -> PackagedSolver:
    """Load a solver that :func:`export_package` compiled. Loading neither traces nor compiles.

    A package is machine code: load only packages that you trust.

    Raises:
        OSError: when the file cannot be read.
        ValueCheckError: when the file is not a package of :func:`export_package` for this platform.
    """
    Path(path).open("rb").close()
    try:
        with zipfile.ZipFile(path) as archive:
            names = {entry.split(_MODELS)[1].split("/")[0] for entry in archive.namelist() if _MODELS in entry}
        # `torch._inductor.aoti_load_package` is not used, because it spends seconds on the import of the compiler.
        load = torch._C._aoti.AOTIModelPackageLoader
        return PackagedSolver([load(str(path), name, False, 1, -1) for name in sorted(names)])
    except (RuntimeError, KeyError, ValueError, IndexError, zipfile.BadZipFile) as error:
        message = f"'{path}' is not a solver of export_package for this machine: {_reason(error)}"
        raise ValueCheckError(message) from error


def export_onnx(
    solver: PnPNet, path: str | Path, n: int | None = None, *, batch: int | None = None, rig: bool = False
) -> Path:
    """Write a solver to one file as an ONNX model, and return the path. ONNX Runtime runs the model without PyTorch.

    See :func:`export_program` for the arguments, inputs, outputs and errors. Without the extra ``onnx``, the function
    raises ``ImportError``. An existing file is replaced only when the model is complete.
    """
    check_packages(".onnx")
    path = Path(path)
    program = export_program(solver, n, batch=batch, rig=rig)
    inputs, outputs = RIG_INPUTS if rig else INPUTS, OUTPUTS if solver.focal == "known" else ExportedCamera._fields
    names: dict[str, Any] = {"input_names": [*inputs], "output_names": [*outputs]}
    with warnings.catch_warnings(action="ignore", category=FutureWarning):  # the exporter warns about its own code
        model = torch.onnx.export(program, dynamo=True, verbose=False, optimize=False, **names)
    assert model is not None
    _simplify(model.model)
    graph = model.model_proto
    batches = {value.type.tensor_type.shape.dim[0].dim_param for value in graph.graph.input}
    if batch is None and not batches.isdisjoint({"", *map(str, range(10))}):
        # The exporter fixed the batch size to the batch size of the example inputs.
        raise ValueCheckError(f"{type(solver.init).__name__} cannot be exported to ONNX for batches of any size.")
    with atomic_open(path, "wb") as file:
        file.write(graph.SerializeToString())
    return path


def _simplify(model: Any) -> None:
    """Simplify a model. The passes are those of ``torch.onnx.export(optimize=True)`` except the rewrite rules."""
    # The rewrite rules would take 90 % of the time of all passes, but remove only 5 % of the nodes.
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
