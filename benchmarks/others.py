"""Solvers of other libraries, called as fast as a user of the library can call them."""

from __future__ import annotations

from collections.abc import Callable

from kornia.geometry.calibration.pnp import solve_pnp_dlt
from tasks import Contender, Task, float_inputs, gradient, leaves_of, without_gradient
from torch import nn

from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.peers import PeerSolver
from kornia_pnpnet.result import Pose, Problems


def bare_call(solver: nn.Module, problems: Problems) -> Callable[[], object]:
    """One call with the whole batch for a solver of ours; the calls of the library alone for a peer."""
    inputs = (problems.world_points, problems.img_points, problems.intrinsics)
    if isinstance(solver, PeerSolver):
        single = list(zip(*(x.numpy() for x in inputs), strict=True))
        return lambda: [solver.solve_one(*one) for one in single]
    return lambda: solver(*inputs)


class Peer(Contender):
    """The call of a library for each problem, on arrays in float64 that are prepared."""

    loops, differentiable = True, False

    def __init__(self, spec: str) -> None:
        self.solver = load_solver(spec)

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """The calls one after the other."""

        def poses() -> Pose:
            return Pose(*self.solver(problems.world_points, problems.img_points, problems.intrinsics).pose)

        return Task(bare_call(self.solver, problems), poses, problems)


class KorniaDLT(Contender):
    """Kornia's direct linear transform, batched, in float32. Float64 has the same success."""

    def takes(self, n: int) -> bool:
        """At least six pairs. Above 200 the singular value decomposition of all pairs takes too long."""
        return 6 <= n <= 200

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """One call with the whole batch."""
        world, img, intrinsics = float_inputs(problems, "cpu")
        leaves = leaves_of(world, img)
        call: Callable[[], object] = without_gradient(lambda: solve_pnp_dlt(world, img, intrinsics))
        if backward:
            call = lambda: gradient(solve_pnp_dlt(leaves[0], leaves[1], intrinsics), leaves)  # noqa: E731

        def poses() -> Pose:
            matrix = solve_pnp_dlt(world, img, intrinsics)
            return Pose(matrix[:, :, :3], matrix[:, :, 3])

        return Task(call, poses, problems)
