"""Compare solvers on the same problems.

The solvers run in one thread. Their results are printed as a table and written to a results file. The same command
continues an interrupted evaluation. With more solvers, data, n or outliers it adds their rows to the results file.

  pnpnet evaluate --solver pnpnet-n9 opencv-ransac:threshold=12 --data path/to/colmap --outliers none,2
  pnpnet evaluate --n 6,9,20,50 --outliers none,uniform,30%
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from kornia_pnpnet.cli.arguments import add_arbitrary_unit, counts, existing_path, whole_number

#: Names of synthetic data for ``--data``.
SYNTHETIC = ("synthetic", "gaussian_pose", "any_rotation", "slab", "mixed")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``pnpnet evaluate``."""
    parser.add_argument(
        "--solver",
        metavar="NAME",
        nargs="+",
        action="extend",
        help="names of `pnpnet list`, with options after a colon (opencv-ransac:threshold=12,iterations=100), or "
        "folders of weights; solvers for another n are skipped; default: all installed solvers for these n, and the "
        "bounds",
    )
    parser.add_argument(
        "--data",
        metavar="DATA",
        nargs="+",
        action="extend",
        type=lambda text: text if text in SYNTHETIC else existing_path(text),
        help=f"{', '.join(SYNTHETIC)}, a folder with a COLMAP model, or an .npz file of matches; default: synthetic",
    )
    parser.add_argument(
        "--n",
        metavar="LIST",
        type=counts,
        default=[9],
        help="numbers of correspondences per problem, separated by commas; default: 9",
    )
    parser.add_argument(
        "--outliers",
        metavar="LIST",
        default="none,uniform",
        help="none, uniform (0 to n/3 per problem), numbers or shares like 50%%, separated by commas; "
        "default: none,uniform",
    )
    parser.add_argument(
        "--mismatches-only",
        action="store_true",
        help="every outlier is the pixel of another point; default: half of the outliers, the others are random pixels",
    )
    parser.add_argument(
        "--problems", metavar="COUNT", type=whole_number(1), default=1000, help="problems per set; default: 1000"
    )
    parser.add_argument(
        "--seed",
        type=whole_number(0, 2**63 - 1),
        help="seed of the problems; default: that of the published results",
    )
    parser.add_argument("--dtype", choices=("float32", "float64"), default="float32", help="default: float32")
    add_arbitrary_unit(parser)
    parser.add_argument("--out", metavar="JSON", default="outputs/results.json", help="default: outputs/results.json")
    parser.add_argument("--overwrite", action="store_true", help="replace the results file instead of continuing it")
    parser.add_argument("--plot", metavar="FOLDER", help="draw success rates and error curves into this folder")


def run(arguments: argparse.Namespace) -> int:
    """Evaluate the solvers; print the table and the path of the results."""
    import torch

    from kornia_pnpnet.evaluation import comparison, format_table, load_results
    from kornia_pnpnet.evaluation.named_solvers import default_solvers, load_solver
    from kornia_pnpnet.evaluation.problem_sets import DEFAULT_SEED, evaluation_sets

    out = Path(arguments.out)
    found = len(load_results(out)["rows"]) if out.exists() and not arguments.overwrite else 0
    sources = arguments.data or ["synthetic"]
    solvers = {name: load_solver(name) for name in arguments.solver or default_solvers(arguments.n, sources)}
    sets = evaluation_sets(
        sources,
        arguments.outliers,
        n=arguments.n,
        count=arguments.problems,
        seed=DEFAULT_SEED if arguments.seed is None else arguments.seed,
        metric=not arguments.arbitrary_unit,
        mismatches_only=arguments.mismatches_only,
        dtype=getattr(torch, arguments.dtype),
    )
    torch.set_num_threads(1)  # the other libraries solve in one thread, too
    try:
        results = comparison.evaluate(solvers, sets, path=out, overwrite=arguments.overwrite)
    except KeyboardInterrupt:
        print(f"pnpnet: interrupted; the same command continues {out}", file=sys.stderr)
        return 130
    if not results["rows"]:
        raise ValueError(f"no solver accepts these problems: {results['left_out'][0]['reason']}")
    for solver in solvers:
        given = [entry["reason"] for entry in results["left_out"] if entry["solver"] == solver]
        if given:
            print(f"pnpnet: {solver} is skipped on {len(given)} of {len(sets)} sets: {given[0]}", file=sys.stderr)
    print(format_table(results))
    print(f"\nResults: {out}" + (f" ({found} of {len(results['rows'])} rows were there)" if found else ""))
    if arguments.plot:
        from kornia_pnpnet.evaluation.plots import plot_errors, plot_success

        folder = Path(arguments.plot)
        pictures = plot_success(folder / "success.png", results), plot_errors(folder / "errors.png", results)
        print("Pictures: " + ", ".join(map(str, pictures)))
    return 0
