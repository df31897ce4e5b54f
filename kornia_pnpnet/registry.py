"""Build solvers by name."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from typing import Any, Literal, TypeAlias, overload

import torch
from kornia.core.exceptions import ValueCheckError
from kornia.geometry.camera import PinholeCamera
from torch import Tensor, nn

from kornia_pnpnet.frame import Normalize
from kornia_pnpnet.peers import KorniaRs, OpenCVPnP, OpenCVRansac, OpenCVUsac, PeerSolver, PoseLib, PyColmap
from kornia_pnpnet.pretrained import shipped_weights
from kornia_pnpnet.propose.epnp import EPnP
from kornia_pnpnet.propose.minimal import SubsetSolver
from kornia_pnpnet.propose.p3p import P3P
from kornia_pnpnet.propose.ransac import RANSAC
from kornia_pnpnet.propose.reppnp import REPPnP
from kornia_pnpnet.refine.lm import RobustWeightedLM
from kornia_pnpnet.solver import PnPNet

__all__ = ["create_solver", "list_solvers", "solve_pnp"]

# Names of the solvers of other libraries. Only type checkers use this type.
_Peer: TypeAlias = Literal[
    "opencv-epnp", "opencv-sqpnp", "opencv-ransac", "opencv-usac", "kornia-rs", "poselib", "pycolmap"
]
# Iterations of the classical robust LM: `_FEW` if another method gives the start, `_MANY` from the identity.
_FEW, _MANY = 10, 30
# Number of pairs in each sample of the paper's RANSAC.
_PAPERS_SAMPLE = 7


def _trained(weights: str, m: int | None = None) -> PnPNet:
    """A trained solver with ``m`` iterations. With ``m=0``, the network is used alone (the paper's "Net")."""
    solver = PnPNet.from_pretrained(weights)
    return solver if m is None else solver.with_options(refine=solver.refine.with_iterations(m))


def _alone(init: Callable[..., nn.Module], **options: Any) -> PnPNet:
    """A solver that judges the pose of ``init``, but does not refine this pose."""
    refine = RobustWeightedLM(0, damping=1e-6, robustness=0.0, learnable=False)
    return PnPNet(init(**options), refine, Normalize(order=init is RANSAC))  # the order of pairs matters to RANSAC only


def _paper_lm(m: int) -> RobustWeightedLM:
    """The classical robust LM of the paper's comparisons: the exponent alpha is 1, and every step is accepted."""
    return RobustWeightedLM(m, learnable=False, reject_worse=False)


def _refined(init: Callable[..., nn.Module], m: int = _FEW, **options: Any) -> PnPNet:
    """A solver that refines the pose of ``init`` by the classical robust LM (the paper's "-LM")."""
    return PnPNet(init(**options), _paper_lm(m), Normalize(order=False))


def _builders() -> dict[str, Callable[..., nn.Module]]:
    builders: dict[str, Callable[..., nn.Module]] = {
        "epnp": partial(_alone, EPnP),
        "epnp-lm": partial(_refined, EPnP),
        "reppnp": partial(_alone, REPPnP),
        "reppnp-lm": partial(_refined, REPPnP),
        "p3p-ransac": lambda **options: _alone(RANSAC, minimal=P3P(), **options),
        "ransac-epnp-lm": lambda m=_FEW, **options: _alone(
            RANSAC, minimal=SubsetSolver(EPnP(), _paper_lm(m), size=_PAPERS_SAMPLE), **options
        ),
        "identity-lm": lambda m=_MANY: PnPNet(None, _paper_lm(m)),
        "opencv-epnp": partial(OpenCVPnP, method="EPNP"),
        "opencv-sqpnp": partial(OpenCVPnP, method="SQPNP"),
        "opencv-ransac": OpenCVRansac,
        "opencv-usac": OpenCVUsac,
        "kornia-rs": KorniaRs,
        "poselib": PoseLib,
        "pycolmap": PyColmap,
    }
    for name in shipped_weights():
        builders[name] = partial(_trained, name)
        builders[name.replace("pnpnet-", "net-")] = partial(_trained, name, m=0)
    return builders


def list_solvers() -> list[str]:
    """List the names that :func:`create_solver` accepts."""
    return sorted(_builders())


@overload
def create_solver(name: _Peer, **options: Any) -> PeerSolver: ...


@overload
def create_solver(name: str, **options: Any) -> PnPNet: ...


def create_solver(name: str, **options: Any) -> nn.Module:
    """Build a solver by its name.

    Every solver is called as ``solver(world_points, img_points, intrinsics, weights=None, mask=None)`` and returns a
    :class:`~kornia_pnpnet.result.PnPResult`. Solvers of this package take more arguments, see
    :meth:`PnPNet.forward <kornia_pnpnet.solver.PnPNet.forward>`. Type checkers infer a ``PnPNet`` unless
    ``name`` is the literal name of another library's solver.

    Args:
        name: one of :func:`list_solvers`.
        options: arguments of the solver's class, which is :class:`~kornia_pnpnet.propose.epnp.EPnP`,
            :class:`~kornia_pnpnet.propose.reppnp.REPPnP`, :class:`~kornia_pnpnet.propose.ransac.RANSAC` or a class of
            :mod:`kornia_pnpnet.peers`. Trained solvers and solvers with ``-lm`` in their name take ``m``, the number of
            iterations (see :meth:`~kornia_pnpnet.refine.lm.RobustWeightedLM.with_iterations`). Solvers of this package
            also take the options of :class:`~kornia_pnpnet.solver.PnPNet`.

    Returns:
        The solver as a module in evaluation mode. Its parameters do not require gradients. A result therefore has an
        autograd graph only if an input requires gradients. To train a shipped solver further, load the solver with
        ``PnPNet.from_pretrained``.

    Raises:
        ValueCheckError: for an unknown name or option.
        BaseError: for an option outside its range.
        ImportError: when the solver needs a package that is not installed.

    Example:
        >>> create_solver("epnp-lm", m=5).refine.m
        5
    """
    builders = _builders()
    if not isinstance(name, str) or name not in builders:
        raise ValueCheckError(f"No solver {name!r}. There are: {', '.join(sorted(builders))}.")
    ours = {key: options.pop(key) for key in PnPNet.option_names() if key in options}
    try:
        solver = builders[name](**options)
        if ours:
            if not isinstance(solver, PnPNet):
                raise TypeError(f"{' and '.join(ours)}: for solvers of this package only")
            solver = solver.with_options(**ours)
        return solver.eval().requires_grad_(False)
    except TypeError as error:
        reason = str(error).rpartition("() ")[2]  # drops the name of a function
        raise ValueCheckError(f"Solver {name!r} does not take these options: {reason}.") from error


@lru_cache(maxsize=8)
def _on_device(name: str, device: torch.device) -> nn.Module:
    def create() -> nn.Module:
        with device:
            return create_solver(name)

    # The parameters must also serve other calls. A new thread is outside of inference mode and of `torch.func`.
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(create).result()


def solve_pnp(
    world_points: Tensor,
    img_points: Tensor,
    intrinsics: Tensor | PinholeCamera,
    weights: Tensor | None = None,
    solver: str | nn.Module = "pnpnet-set",
    *,
    dist: Tensor | None = None,
    fisheye: Tensor | None = None,
) -> Tensor:
    r"""Find world-to-camera matrices despite outliers. The signature follows :func:`kornia.geometry.solve_pnp_dlt`.

    To pass masks or noise, or to get weights and a probability, call a solver of :func:`create_solver`. ``solver`` is
    one of :func:`list_solvers`, or a module with the signature of a solver. Named solvers are cached. For the other
    arguments see :meth:`PnPNet.forward <kornia_pnpnet.solver.PnPNet.forward>`. Solvers of other libraries do not accept
    ``dist`` and ``fisheye``.

    Returns:
        Matrices :math:`[R\,|\,t]` with ``x_cam = R x_world + t``, shape :math:`(B, 3, 4)`. The dtype is float64 if any
        input is float64, else float32. Gradients flow to points, pixels, intrinsics and weights. If a problem
        is not ``ok``, its matrix is NaN and has no gradient.

    Raises:
        ValueCheckError: for an unknown name.
        BaseError: for shapes, dtypes and devices that the solver does not accept.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> p = SyntheticProblems(n=12, batch_size=2, seed=0).batch(0)
        >>> solve_pnp(p.world_points, p.img_points, p.intrinsics).shape
        torch.Size([2, 3, 4])
    """
    if isinstance(solver, str):
        device = world_points.device if isinstance(world_points, Tensor) else torch.device("cpu")
        solver = _on_device(solver, device)
    lens = {name: x for name, x in (("dist", dist), ("fisheye", fisheye)) if x is not None}
    result = solver(world_points, img_points, intrinsics, weights, **lens)
    return torch.where(result.ok[..., None, None], result.matrix[..., :3, :], torch.nan)
