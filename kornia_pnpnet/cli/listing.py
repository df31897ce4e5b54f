"""List the solvers and the shipped weights.

The option --solver of the other commands accepts these names.

  pnpnet list
"""

from __future__ import annotations

import argparse

from kornia_pnpnet import list_solvers, shipped_weights
from kornia_pnpnet.evaluation.named_solvers import BOUNDS, missing_package


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """``pnpnet list`` has no arguments."""


def run(_: argparse.Namespace) -> int:
    """Print each solver with the package that it needs and that is not installed."""
    states = {}
    for name in list_solvers():
        package = missing_package(name)
        states[name] = f"needs {package}: pip install 'kornia_pnpnet[eval]'" if package else "installed"
    states |= dict.fromkeys(BOUNDS, "bound: needs the true pose, for `pnpnet evaluate` only")
    for name, state in states.items():
        print(f"{name:<{max(map(len, states))}}  {state}")
    print(f"\nShipped weights: {', '.join(shipped_weights()) or 'none'}")
    return 0
