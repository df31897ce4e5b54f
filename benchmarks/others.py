"""Solvers of other libraries, called as fast as a user of the library can call them."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable
from typing import Any

import torch
from kornia.geometry.calibration.pnp import solve_pnp_dlt
from tasks import ITERATIONS, Contender, Task, float_inputs, gradient, leaves_of, normalized, without_gradient
from torch import Tensor, nn

from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.peers import PeerSolver
from kornia_pnpnet.result import Pose, Problems

_PYPOSE_DELTA = 10.0 / 3400.0  # scale of the kernel: 10 px, in focal lengths of the protocol's camera
_PYPOSE_DAMPING = 1e-3  # the damping of our classical refinement
# Problems in one step of PyPose's optimiser, whose Jacobian is dense over all of them. The time per problem is least at
# 10.
_PYPOSE_AT_ONCE = 10


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


class PyPose(Contender):
    """PyPose on the normalised pairs and from the start of ``contenders.Refinement``, in float32.

    Args:
        own_loop: False: ``pypose.optim.LM`` as in its documentation, with a robust kernel and ``FastTriggs``, other
            settings at their defaults, a few problems at once. The optimiser has no gradient; for a gradient, one
            differentiable step of our loop follows at the result.
            True: a batched loop of our own from PyPose's Lie groups, reprojection error and linear solver, with the
            Jacobian of each problem by vectorised reverse mode. Gradients go through all iterations.
    """

    def __init__(self, *, own_loop: bool) -> None:
        self.pypose: Any = _import_pypose()
        self.own_loop = own_loop
        self.loops = not own_loop
        self.solve = self.pypose.optim.solver.Cholesky()
        self.cauchy = self.pypose.optim.kernel.Cauchy(delta=_PYPOSE_DELTA)

    def takes(self, n: int) -> bool:
        """The optimiser at one n; our loop up to 100 pairs, above which a call takes minutes."""
        return n <= 100 if self.own_loop else n == 9

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """Refine all problems."""
        pairs, starts, undo = normalized(problems, "cpu")
        points, pixels = pairs.world_points.contiguous(), (pairs.img_points / pairs.focal).contiguous()
        start = self.pypose.mat2SE3(
            torch.cat((starts.pose.rotation, starts.pose.translation[..., None]), -1), check=False
        )
        refine: Callable[..., Any] = self._steps if self.own_loop else self._optimize
        leaves = leaves_of(points, pixels)

        def forward_and_backward() -> object:
            found = refine(leaves[0], leaves[1], start)
            if not self.own_loop:
                found = self._steps(leaves[0], leaves[1], found, count=1)
            return gradient(found.matrix(), leaves)

        def poses() -> Pose:
            matrix = refine(points, pixels, start).matrix()
            return undo(Pose(matrix[:, :3, :3], matrix[:, :3, 3]))

        forward = without_gradient(lambda: refine(points, pixels, start))
        return Task(forward_and_backward if backward else forward, poses, problems)

    def _residual(self, points: Tensor, pixels: Tensor, pose: Any) -> Any:
        return self.pypose.reprojerr(points, pixels, torch.eye(3), pose)  # (B, N, 2), in focal lengths

    def _optimize(self, points: Tensor, pixels: Tensor, start: Any) -> Any:
        """``pypose.optim.LM`` on a few problems at once."""
        optim, residual = self.pypose.optim, self._residual

        class Reprojection(nn.Module):
            def __init__(self, pose: Any, parameter: Callable[[Any], nn.Parameter]) -> None:
                super().__init__()
                self.pose = parameter(pose)

            def forward(self, points: Tensor, pixels: Tensor) -> Any:
                return residual(points, pixels, self.pose)

        found = []
        for first in range(0, len(points), _PYPOSE_AT_ONCE):
            part = slice(first, first + _PYPOSE_AT_ONCE)
            model = Reprojection(start[part].clone(), self.pypose.Parameter)
            corrector = optim.corrector.FastTriggs(self.cauchy)
            optimizer = optim.LM(model, kernel=self.cauchy, corrector=corrector)
            for _ in range(ITERATIONS):
                optimizer.step((points[part].detach(), pixels[part].detach()))
            found.append(model.pose.detach())
        return self.pypose.SE3(torch.cat(found))

    def _steps(self, points: Tensor, pixels: Tensor, pose: Any, count: int = ITERATIONS) -> Any:
        """Steps of a batched Levenberg–Marquardt with the same kernel."""
        differentiable = torch.is_grad_enabled()
        zero = points.new_zeros(len(points), 6)
        for _ in range(count):

            def summed(tangent: Tensor, pose: Any = pose) -> Tensor:
                # Problems are independent: the Jacobian of the sum holds the Jacobian of each problem.
                moved = self.pypose.se3(tangent).Exp() @ pose
                return self._residual(points, pixels, moved).flatten(1).sum(0)

            with torch.enable_grad():
                jacobian = torch.autograd.functional.jacobian(
                    summed, zero, create_graph=differentiable, vectorize=True
                ).transpose(0, 1)  # (B, 2N, 6)
            residual = self._residual(points, pixels, pose)
            share = (1.0 + residual.square().sum(-1, keepdim=True) / _PYPOSE_DELTA**2).rsqrt()  # root of weight
            scaled = (jacobian.unflatten(1, (-1, 2)) * share[..., None]).flatten(1, 2)
            normal = scaled.mT @ scaled
            damped = normal + _PYPOSE_DAMPING * torch.diag_embed(normal.diagonal(dim1=-2, dim2=-1))
            delta = self.solve(damped, -scaled.mT @ (share * residual).flatten(1)[..., None])[..., 0]
            pose = self.pypose.se3(delta).Exp() @ pose
        return pose


def _import_pypose() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyPose scripts a function, which PyTorch has deprecated
        try:
            return importlib.import_module("pypose")
        except ImportError as error:
            raise ImportError("This contender needs PyPose: pip install 'kornia_pnpnet[bench]'") from error
