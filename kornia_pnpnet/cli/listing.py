"""List the solvers and the shipped weights.

The option --solver of the other commands accepts these names.

  pnpnet list
"""

from __future__ import annotations

import argparse

#: Descriptions of solvers. A key is the start of a solver's name, and the longest matching key applies.
_WHAT = {
    "pnpnet-set": "network over any number of pairs, then learned LM: the default",
    "pnpnet-n": "the paper's network for that number of pairs, then learned LM; for cameras near the world's axes",
    "net-": "the network alone, without refinement",
    "epnp": "EPnP, for problems without outliers",
    "epnp-lm": "EPnP, then robust LM",
    "reppnp": "EPnP that rejects outliers by their algebraic error",
    "reppnp-lm": "REPPnP, then robust LM",
    "p3p-ransac": "RANSAC with P3P on samples of three, for any share of outliers",
    "ransac-epnp-lm": "the paper's RANSAC on samples of seven",
    "identity-lm": "robust LM from the identity, or from a given pose",
    "opencv-": "OpenCV's solver, one problem at a time",
    "kornia-rs": "kornia-rs's RANSAC, one problem at a time",
    "poselib": "PoseLib's RANSAC, one problem at a time",
    "pycolmap": "COLMAP's RANSAC, one problem at a time",
}


def run(_: argparse.Namespace) -> int:
    """Print the description of each solver. If the solver needs a package that is missing, name the package."""
    from kornia_pnpnet import list_solvers, shipped_weights
    from kornia_pnpnet.core.extras import how_to_install
    from kornia_pnpnet.evaluation.named_solvers import BOUNDS, missing_package

    states = {}
    for name in list_solvers():
        package = missing_package(name)
        missing = f" (needs {package}: {how_to_install('eval')})" if package else ""
        states[name] = _WHAT[max(filter(name.startswith, _WHAT), key=len)] + missing
    states |= dict.fromkeys(BOUNDS, "bound: needs the true pose, for `pnpnet evaluate` only")
    for name, state in states.items():
        print(f"{name:<{max(map(len, states))}}  {state}")
    print(f"\nShipped weights: {', '.join(shipped_weights())}")
    return 0
