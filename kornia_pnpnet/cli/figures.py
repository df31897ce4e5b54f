"""Draw the paper's figures from results files.

Each figure for which the files hold data is drawn.

  pnpnet figures outputs/synthetic.json outputs/real.json --out outputs/figures
"""

from __future__ import annotations

import argparse

from kornia_pnpnet.cli.arguments import existing_path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``pnpnet figures``."""
    parser.add_argument(
        "files",
        metavar="RESULTS.json",
        nargs="+",
        type=existing_path,
        help="results of `pnpnet evaluate`, or operation counts",
    )
    parser.add_argument("--out", metavar="FOLDER", default="outputs/figures", help="default: outputs/figures")


def run(arguments: argparse.Namespace) -> int:
    """Draw the figures and print their paths."""
    from kornia_pnpnet.evaluation import load_results
    from kornia_pnpnet.evaluation.figures import paper_figures

    pictures = paper_figures([load_results(path, complexity=True) for path in arguments.files], arguments.out)
    print(*pictures, sep="\n")
    return 0
