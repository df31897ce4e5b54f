"""Compare solvers on the same problems.

The solvers run in one thread. Their results are printed as a table and written to a results file. The same command
continues an interrupted evaluation. If --solver names the solvers, a command with more of them, or with more data, n
or outliers, adds rows to the results file.

  pnpnet evaluate --solver pnpnet-n9 opencv-ransac:threshold=12 --data path/to/colmap --outliers none,2
  pnpnet evaluate --n 6,9,20,50 --outliers none,uniform,30%
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def run(arguments: argparse.Namespace) -> int:
    """Evaluate the solvers, and print the table and the path of the results."""
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
        same = "the same command" + " without --overwrite" * arguments.overwrite
        print(f"pnpnet: interrupted; {same} continues {out}", file=sys.stderr)
        return 130
    if not results["rows"]:
        raise ValueError(f"no solver accepts these problems: {results['left_out'][0]['reason']}")
    for solver in solvers:
        reasons = [entry["reason"] for entry in results["left_out"] if entry["solver"] == solver]
        if reasons:
            print(f"pnpnet: {solver} is skipped on {len(reasons)} of {len(sets)} sets: {reasons[0]}", file=sys.stderr)
    print(format_table(results))
    print(f"\nResults: {out}" + (f" ({found} of {len(results['rows'])} rows were there)" if found else ""))
    if arguments.plot:
        from kornia_pnpnet.evaluation.plots import plot_errors, plot_success

        folder = Path(arguments.plot)
        pictures = plot_success(folder / "success.png", results), plot_errors(folder / "errors.png", results)
        print("Pictures: " + ", ".join(map(str, pictures)))
    return 0
