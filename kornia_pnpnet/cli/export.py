"""Write a solver as an ONNX model.

The model solves batches of any size. ONNX Runtime runs the model without PyTorch.

  pnpnet export pnpnet-set.onnx
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

from kornia_pnpnet.cli.arguments import load_solver_without_truth, whole_number


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``pnpnet export``."""
    parser.add_argument("file", metavar="ONNX", help="the file to write")
    parser.add_argument("--solver", metavar="NAME", default="pnpnet-set", help="default: pnpnet-set")
    parser.add_argument(
        "--n", metavar="N", type=whole_number(1), help="correspondences per problem; default: any number"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace the file")


def run(arguments: argparse.Namespace) -> int:
    """Write the model; print its size, inputs and outputs."""
    from kornia_pnpnet.export import INPUTS, OUTPUTS, export_onnx
    from kornia_pnpnet.solver import PnPNet

    solver = load_solver_without_truth(arguments.solver)
    if not isinstance(solver, PnPNet):
        raise ValueError(f"--solver: {arguments.solver} belongs to another library and cannot be exported")
    target = Path(arguments.file)
    target.parent.mkdir(parents=True, exist_ok=True)  # an error now, not after minutes
    if target.is_dir():
        raise ValueError(f"'{target}' is a folder")
    if target.exists() and not arguments.overwrite:
        raise ValueError(f"'{target}' exists: pass --overwrite to replace it")
    print("Tracing and converting; PyTorch's exporter takes a minute or more", flush=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter about itself
        path = export_onnx(solver, target, arguments.n)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, {', '.join(INPUTS)} -> {', '.join(OUTPUTS)}")
    return 0
