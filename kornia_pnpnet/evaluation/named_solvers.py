"""Solvers and bounds by their names on the command line."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from kornia.core.exceptions import ValueCheckError
from torch import nn

from kornia_pnpnet.evaluation.bounds import KnownInliers, KnownInliersAndNoise
from kornia_pnpnet.evaluation.problem_sets import PRIORS
from kornia_pnpnet.peers import KorniaRs, OpenCVPnP, PoseLib, PyColmap
from kornia_pnpnet.registry import create_solver, list_solvers
from kornia_pnpnet.solver import PnPNet

__all__ = ["BOUNDS", "default_solvers", "load_solver", "missing_package"]

#: Bounds by name. A bound needs the true poses and inliers, so a bound cannot solve new problems.
BOUNDS: dict[str, type[nn.Module]] = {"known-inliers": KnownInliers, "known-inliers-and-noise": KnownInliersAndNoise}

# Solvers that are evaluated by default, in the order of the results.
_COMPETITORS = (
    *("pnpnet-set", "pnpnet-n{n}", "net-n{n}", "identity-lm", "epnp", "epnp-lm", "reppnp", "reppnp-lm"),
    *("ransac-epnp-lm", "p3p-ransac", "opencv-sqpnp", "opencv-epnp", "opencv-ransac", "opencv-usac"),
    *("kornia-rs", "poselib", "pycolmap"),
)
# Options of RANSAC for real scenes. This threshold is the best of a grid from 3 to 60 px on five scenes with 0, 2 and 4
# outliers in 9 pairs. Success hardly changes from 6 to 20 px. The seed of these problems was not `DEFAULT_SEED`.
_SCENE_OPTIONS = dict.fromkeys(
    ("ransac-epnp-lm", "p3p-ransac", "opencv-ransac", "opencv-usac", "kornia-rs", "poselib", "pycolmap"), "threshold=12"
)
# Options of RANSAC for synthetic data. These thresholds are the best of a grid from (3 px, 0.15 m) to
# (8 px, 0.4 m) on problems whose seed was not `DEFAULT_SEED`. Success varies by one percentage point over the grid.
_PRIOR_OPTIONS = dict.fromkeys(("ransac-epnp-lm", "p3p-ransac"), "threshold=5,world_threshold=0.25")
# Maps the start of a solver's name to the module and the name of the package that the solver needs.
_PACKAGES = {peer.source[1].lower(): peer.source for peer in (OpenCVPnP, KorniaRs, PoseLib, PyColmap)}


def load_solver(spec: str) -> nn.Module:
    """Build a solver or a bound, in evaluation mode, from its name.

    Args:
        spec: a folder of weights, or a name of :func:`~kornia_pnpnet.registry.list_solvers` or of :data:`BOUNDS`. A
            name can have options after a colon, for example ``"opencv-ransac:threshold=12,refine=false"``.

    Raises:
        BaseError: for an unknown name or option.
        ImportError: when the solver needs a package that is not installed.
    """
    name, _, text = spec.partition(":")
    if name not in {*list_solvers(), *BOUNDS} and Path(spec).is_dir():
        return PnPNet.from_pretrained(spec)
    options: dict[str, Any] = {}
    for option in filter(None, text.split(",")):
        key, _, word = option.partition("=")
        options[key] = word
        with suppress(ValueError):  # a word that is not JSON stays a string
            options[key] = json.loads(word)
    if name not in BOUNDS:
        return create_solver(name, **options)
    try:
        return BOUNDS[name](**options).eval()
    except TypeError as error:
        raise ValueCheckError(f"Bound {name!r} does not accept these options: {error}.") from error


def default_solvers(n: int | Iterable[int], sources: Iterable[str] = ("synthetic",)) -> list[str]:
    """List the names of installed solvers and bounds to evaluate by default. :func:`load_solver` accepts the names.

    Args:
        n: number of pairs per problem, or several such numbers.
        sources: see :func:`~kornia_pnpnet.evaluation.problem_sets.evaluation_sets`. If no source is synthetic, RANSAC
            gets thresholds for scenes, and the bound that needs the noise is left out.
    """
    sizes = [n] if isinstance(n, int) else list(n)
    names = dict.fromkeys(competitor.format(n=size) for competitor in _COMPETITORS for size in sizes)
    installed = [name for name in names if name in list_solvers() and not missing_package(name)]
    synthetic = any(source in PRIORS for source in sources)
    options = _PRIOR_OPTIONS if synthetic else _SCENE_OPTIONS
    specs = [f"{name}:{options[name]}" if name in options else name for name in installed]
    return [*specs, *(BOUNDS if synthetic else ["known-inliers"])]


def missing_package(solver: str) -> str | None:
    """The name of a missing package that a solver needs, or ``None`` if no package is missing."""
    needed = (package for prefix, package in _PACKAGES.items() if solver.startswith(prefix))
    return next((name for module, name in needed if importlib.util.find_spec(module.split(".")[0]) is None), None)
