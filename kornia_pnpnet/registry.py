"""Every solver by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from kornia.core.exceptions import ValueCheckError
from torch import nn

from kornia_pnpnet.lm import RobustWeightedLM
from kornia_pnpnet.model import PnPNet, shipped_weights

__all__ = ["create_solver", "list_solvers"]


def _first_stage(weights: str) -> PnPNet:
    """The network of some weights alone, the paper's "Net"."""
    solver = PnPNet.from_pretrained(weights)
    solver.refine = RobustWeightedLM(m=0)
    return solver


def _opencv_ransac(**options: Any) -> nn.Module:
    from kornia_pnpnet.peers import OpenCVRansac  # imports OpenCV, an extra

    return OpenCVRansac(**options)


def _identity_lm(m: int = 30) -> PnPNet:
    """The classical robust LM from the identity pose, the paper's LM without a network."""
    return PnPNet(None, RobustWeightedLM(m=m, learnable=False))


def _builders() -> dict[str, Callable[..., nn.Module]]:
    builders: dict[str, Callable[..., nn.Module]] = {"identity-lm": _identity_lm, "opencv-ransac": _opencv_ransac}
    for name in shipped_weights():
        builders[name] = partial(PnPNet.from_pretrained, name)
        builders[name.replace("pnpnet-", "net-")] = partial(_first_stage, name)
    return builders


def list_solvers() -> list[str]:
    """Names that :func:`create_solver` takes.

    Example:
        >>> "identity-lm" in list_solvers()
        True
    """
    return sorted(_builders())


def create_solver(name: str, **options: Any) -> nn.Module:
    """Build a solver.

    Every solver is called as ``solver(world_points, img_points, intrinsics, weights=None, mask=None)`` and returns a
    :class:`~kornia_pnpnet.types.PnPResult`.

    Args:
        name: one of :func:`list_solvers`.
        options: of that solver, for example ``m`` of ``identity-lm`` or ``threshold`` of ``opencv-ransac``.

    Returns:
        The solver as a module in evaluation mode.

    Raises:
        ValueCheckError: for an unknown name or option.
        ImportError: when the solver needs a package that is not installed.

    Example:
        >>> create_solver("identity-lm", m=10).refine.m
        10
    """
    builders = _builders()
    if name not in builders:
        raise ValueCheckError(f"No solver {name!r}. There are: {', '.join(sorted(builders))}.")
    try:
        return builders[name](**options).eval()
    except TypeError as error:
        raise ValueCheckError(f"Solver {name!r} does not take these options: {error}.") from error
