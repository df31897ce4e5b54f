"""Write a solver as an ONNX model or as a package that is compiled ahead of time.

The suffix of the file selects the format. ONNX Runtime runs a model (.onnx) without PyTorch. A package (.pt2) loads
without compiling, in Python and in C++ with libtorch. A package runs on the kind of CPU that compiled it.

  pnpnet export pnpnet-set.onnx
  pnpnet export pnpnet-n9.pt2 --solver pnpnet-n9 --batch 1
  pnpnet export pnpnet-set.pt2 --batch 1 --pairs 16,64,256
  pnpnet export rig.onnx --rig
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

from kornia_pnpnet.cli.arguments import load_solver_without_truth


def run(arguments: argparse.Namespace) -> int:
    """Write the file; print its size, inputs and outputs."""
    target = Path(arguments.file)
    if target.suffix not in (".onnx", ".pt2"):
        raise ValueError(f"'{target}': the file's name must end in .onnx (ONNX) or .pt2 (compiled ahead of time)")
    from kornia_pnpnet import export
    from kornia_pnpnet.solver import PnPNet

    if target.suffix == ".onnx" and len(arguments.pairs or ()) > 1:
        raise ValueError("--pairs: an ONNX model has one number of pairs, or any number")
    export.check_packages(target.suffix)
    solver = load_solver_without_truth(arguments.solver)
    if not isinstance(solver, PnPNet):
        raise ValueError(f"--solver: {arguments.solver} belongs to another library and cannot be exported")
    target.parent.mkdir(parents=True, exist_ok=True)  # an invalid folder fails here, before minutes of tracing
    if target.is_dir():
        raise ValueError(f"'{target}' is a folder")
    if target.exists() and not arguments.overwrite:
        raise ValueError(f"'{target}' exists: pass --overwrite to replace it")
    pairs = arguments.pairs if arguments.pairs is None or len(arguments.pairs) > 1 else arguments.pairs[0]
    is_onnx = target.suffix == ".onnx"
    print(f"Tracing and {'converting' if is_onnx else 'compiling'}; PyTorch takes a minute or more", flush=True)
    with warnings.catch_warnings(action="ignore"):  # PyTorch's exporter warns about its own code
        write = export.export_onnx if is_onnx else export.export_package
        path = write(solver, target, pairs, batch=arguments.batch, rig=arguments.rig)
    outputs = export.OUTPUTS if solver.focal == "known" else export.ExportedCamera._fields
    inputs = export.RIG_INPUTS if arguments.rig else export.INPUTS
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, {', '.join(inputs)} -> {', '.join(outputs)}")
    return 0
