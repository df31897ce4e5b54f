"""What is timed: solvers of ours and of other libraries behind one small interface.

A contender makes a task of a batch of problems; the task is called, forward or forward and backward, and says how many
problems its poses solve. Nothing here is slower than what a user of the library would write.
"""

from __future__ import annotations

import functools
import importlib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from harness import seconds
from kornia.geometry.calibration.pnp import solve_pnp_dlt
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor, nn

from kornia_pnpnet import Guess, Normalize, create_solver, pose_errors, success, success_rate
from kornia_pnpnet.choices import load_solver
from kornia_pnpnet.metrics import SuccessRate
from kornia_pnpnet.peers import PeerSolver
from kornia_pnpnet.types import Correspondences, Pose, Problems

__all__ = [
    "CONTENDERS",
    "OURS",
    "CannotBeTimedError",
    "Contender",
    "Task",
    "bare_call",
    "coarse_pose",
    "first",
    "normalized",
]

TRAINED = "pnpnet-n9"
# How far the pose is from the true one from which refinements start: what the first stage of the network leaves.
COARSE_ANGLE_DEG, COARSE_SHIFT = 5.0, 0.05
# Iterations of every refinement, the trained one's number.
ITERATIONS = 5
# PyPose's kernel begins at a residual of 10 px; the damping is our classical one.
_PYPOSE_DELTA, _PYPOSE_DAMPING = 10.0 / 3400.0, 1e-3
# PyPose's optimiser has one dense Jacobian for all problems together: more at once take longer, fewer as well.
_PYPOSE_AT_ONCE = 10


class CannotBeTimedError(Exception):
    """Why a contender has no time."""


@dataclass
class Task:
    """A call on given problems.

    Attributes:
        call: solves all of them once; forward and backward when it was made so.
        poses: the poses in the frame of the problems, in float64; not timed.
        problems: the problems.
        finish: waits for the device.
    """

    call: Callable[[], object]
    poses: Callable[[], Pose]
    problems: Problems
    finish: Callable[[], None] | None = None

    def seconds(self, times: int = 1) -> float:
        """Seconds that a call takes, the mean over ``times`` of them."""
        if self.finish is None:
            return seconds(self.call, times)
        self.finish()

        def everything() -> None:
            for _ in range(times):
                self.call()
            self.finish()  # type: ignore[misc]

        return seconds(everything) / times

    def warm(self) -> float:
        """Call it twice, the first time to compile and to fill caches, and return the seconds of the second.

        Raises:
            CannotBeTimedError: when it warns that it does not compile: what is called compiled would not be.
        """
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            self.seconds()
            once = self.seconds()
        _raise_uncompiled(caught)
        return once

    def success(self) -> SuccessRate:
        """How many of the problems are solved."""
        with torch.no_grad():
            pose = Pose(*(x.double().cpu() for x in self.poses()))
        return success_rate(success(pose_errors(pose, self.problems.pose)))


def _raise_uncompiled(caught: Sequence[warnings.WarningMessage]) -> None:
    for warning in caught:
        if "compil" in str(warning.message) and not issubclass(warning.category, DeprecationWarning):
            raise CannotBeTimedError(str(warning.message))


def _compile(module: nn.Module) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        module.compile()
    _raise_uncompiled(caught)


class Contender:
    """Something that is timed.

    Attributes:
        loops: whether problems are solved one after the other, so that a part of a batch tells the time of one.
        differentiable: whether there are gradients.
    """

    loops = False
    differentiable = True

    def takes(self, n: int) -> bool:
        """Whether it is shown problems of ``n`` pairs."""
        return True

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """Make everything ready that is not to be timed."""
        raise NotImplementedError

    def close(self) -> None:
        """Give back what it holds."""


def first(problems: Problems, count: int) -> Problems:
    """The first of a batch."""
    return problems.map(lambda x: x[:count])


def _inputs(problems: Problems, device: str) -> list[Tensor]:
    return [x.to(device, torch.float32) for x in problems[:3]]


def _leaves(*tensors: Tensor) -> list[Tensor]:
    return [x.detach().clone().requires_grad_() for x in tensors]


def _gradient(pose: Pose | Tensor, leaves: list[Tensor]) -> tuple[Tensor, ...]:
    """Backward from the sum of all entries of the poses."""
    total = pose.sum() if isinstance(pose, Tensor) else pose[0].sum() + pose[1].sum()
    return torch.autograd.grad(total, leaves, allow_unused=True)


def _waiting(device: str) -> Callable[[], None] | None:
    return torch.cuda.synchronize if device.startswith("cuda") else None


def _without_gradient(call: Callable[[], Any]) -> Callable[[], Any]:
    return torch.no_grad()(call)


def coarse_pose(problems: Problems, seed: int = 0) -> Pose:
    """The true poses, turned about the points' centre and moved: what refinements start from.

    Returns:
        Poses in the frame of the problems, in their dtype.
    """
    rotation, translation = problems.pose
    generator = torch.Generator().manual_seed(seed)
    turn, shift = torch.randn(2, len(rotation), 3, generator=generator, dtype=torch.float64)
    turn, shift = (x / x.norm(dim=-1, keepdim=True) for x in (turn, shift))
    centre = problems.world_points.mean(1)[..., None]  # (B, 3, 1)
    camera_centre = rotation @ centre + translation[..., None]
    turned = axis_angle_to_rotation_matrix(torch.deg2rad(torch.tensor(COARSE_ANGLE_DEG)) * turn).to(rotation) @ rotation
    shift = COARSE_SHIFT * camera_centre.norm(dim=1) * shift.to(translation)
    return Pose(turned, (camera_centre - turned @ centre)[..., 0] + shift)


# -- ours --------------------------------------------------------------------------------------------------------------


class Ours(Contender):
    """A solver of this package: the whole call, in float32. Gradients go to points, pixels and what is learned."""

    def __init__(self, spec: str, *, compiled: bool = False, device: str = "cpu") -> None:
        self.solver = load_solver(spec).float().to(device)
        self.device = device
        self.only_n = int(spec.rpartition("-n")[2]) if spec.startswith("pnpnet-n") else None
        if compiled:
            _compile(self.solver)

    def takes(self, n: int) -> bool:
        """A network takes its own number of pairs."""
        return self.only_n in (None, n)

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """The call with the whole batch."""
        inputs = _inputs(problems, self.device)

        def poses() -> Pose:
            return Pose(*self.solver(*inputs).pose)

        call: Callable[[], object] = _without_gradient(lambda: self.solver(*inputs))
        if backward:
            leaves = _leaves(*inputs[:2])
            learned = [x for x in self.solver.parameters() if x.requires_grad]
            call = lambda: _gradient(self.solver(*leaves, inputs[2]).pose, [*leaves, *learned])  # noqa: E731
        return Task(call, poses, problems, _waiting(self.device))


def normalized(problems: Problems, device: str) -> tuple[Correspondences, Guess, Callable[[Pose], Pose]]:
    """Normalised pairs, the coarse pose in their frame, and the way back; none of it is timed."""
    normalize = Normalize(order=False)
    with torch.no_grad():
        corr, frame = normalize(*_inputs(problems, device))
        start = normalize.apply_to_pose(Pose(*(x.to(corr.world_points) for x in coarse_pose(problems))), frame)
    return corr, Guess(start, torch.ones_like(corr.weights)), lambda pose: normalize.undo(pose, frame)


class Refinement(Contender):
    """The trained refinement alone, on normalised pairs and from the coarse pose."""

    def __init__(self, *, compiled: bool = False, device: str = "cpu") -> None:
        solver: Any = create_solver(TRAINED)
        self.refine: nn.Module = solver.refine.to(device)
        self.device = device
        if compiled:
            _compile(self.refine)

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """The refiner's call."""
        corr, guess, undo = normalized(problems, self.device)
        call: Callable[[], object] = _without_gradient(lambda: self.refine(corr, guess))
        if backward:
            # Not cloned: the layout in memory is the one in which pairs arrive.
            leaves = [x.detach().requires_grad_() for x in corr[:2]]
            wanted = corr._replace(world_points=leaves[0], img_points=leaves[1])
            learned = [x for x in self.refine.parameters() if x.requires_grad]
            call = lambda: _gradient(self.refine(wanted, guess).pose, [*leaves, *learned])  # noqa: E731
        return Task(call, lambda: undo(self.refine(corr, guess).pose), problems, _waiting(self.device))


# -- other libraries ---------------------------------------------------------------------------------------------------


def bare_call(solver: nn.Module, problems: Problems) -> Callable[[], object]:
    """One call with the whole batch for a solver of ours, the bare calls of the library for a peer's."""
    if isinstance(solver, PeerSolver):
        single = list(zip(*(x.numpy() for x in problems[:3]), strict=True))
        return lambda: [solver.solve_one(*one) for one in single]
    return lambda: solver(*problems[:3])


class Peer(Contender):
    """A library's call for each problem, on arrays in float64 that lie ready."""

    loops, differentiable = True, False

    def __init__(self, spec: str) -> None:
        self.solver = load_solver(spec)

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """The calls one after the other."""
        return Task(bare_call(self.solver, problems), lambda: self.solver(*problems[:3]).pose, problems)


class KorniaDLT(Contender):
    """Kornia's direct linear transform, batched, in float32; float64 solves as many problems."""

    def takes(self, n: int) -> bool:
        """It needs six pairs. Its singular value decomposition of all pairs takes too long for very many."""
        return 6 <= n <= 200

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """One call with the whole batch."""
        world, img, intrinsics = _inputs(problems, "cpu")
        leaves = _leaves(world, img)
        call: Callable[[], object] = _without_gradient(lambda: solve_pnp_dlt(world, img, intrinsics))
        if backward:
            call = lambda: _gradient(solve_pnp_dlt(leaves[0], leaves[1], intrinsics), leaves)  # noqa: E731

        def poses() -> Pose:
            matrix = solve_pnp_dlt(world, img, intrinsics)
            return Pose(matrix[:, :, :3], matrix[:, :, 3])

        return Task(call, poses, problems)


class PyPose(Contender):
    """PyPose on the normalised pairs and from the start of :class:`Refinement`, in float32.

    Args:
        own_loop: False: ``pypose.optim.LM`` as its documentation has it, a robust kernel with ``FastTriggs``, the
            other settings its own, a few problems at once. It is made to be stepped, not differentiated: for a
            gradient, one differentiable step of the other kind follows at its result.
            True: a loop of our own out of PyPose's parts: its Lie groups, reprojection error and linear solver, with
            the Jacobian of each problem alone by vectorised reverse mode. That is batched and differentiates through
            all iterations.
    """

    def __init__(self, *, own_loop: bool) -> None:
        self.pypose: Any = _import_pypose()
        self.own_loop = own_loop
        self.loops = not own_loop
        self.solve = self.pypose.optim.solver.Cholesky()
        self.cauchy = self.pypose.optim.kernel.Cauchy(delta=_PYPOSE_DELTA)

    def takes(self, n: int) -> bool:
        """Of the loop over a few problems at once the time at one n says enough."""
        return self.own_loop or n == 9

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """Refine all of them."""
        corr, guess, undo = normalized(problems, "cpu")
        points, pixels = corr.world_points.contiguous(), (corr.img_points / corr.focal).contiguous()
        start = self.pypose.mat2SE3(torch.cat((guess.pose[0], guess.pose[1][..., None]), -1), check=False)
        refine: Callable[..., Any] = self._steps if self.own_loop else self._optimize
        leaves = _leaves(points, pixels)

        def forward_and_backward() -> object:
            found = refine(leaves[0], leaves[1], start)
            if not self.own_loop:
                found = self._steps(leaves[0], leaves[1], found, count=1)
            return _gradient(found.matrix(), leaves)

        def poses() -> Pose:
            matrix = refine(points, pixels, start).matrix()
            return undo(Pose(matrix[:, :3, :3], matrix[:, :3, 3]))

        forward = _without_gradient(lambda: refine(points, pixels, start))
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
        """Steps of a batched Levenberg-Marquardt with the same kernel."""
        differentiable = torch.is_grad_enabled()
        zero = points.new_zeros(len(points), 6)
        for _ in range(count):

            def summed(tangent: Tensor, pose: Any = pose) -> Tensor:
                # Problems do not depend on each other: the sum's Jacobian holds that of each.
                moved = self.pypose.se3(tangent).Exp() @ pose
                return self._residual(points, pixels, moved).flatten(1).sum(0)

            with torch.enable_grad():
                jacobian = torch.autograd.functional.jacobian(
                    summed, zero, create_graph=differentiable, vectorize=True
                ).transpose(0, 1)  # (B, 2N, 6)
            residual = self._residual(points, pixels, pose)
            share = (1.0 + residual.square().sum(-1, keepdim=True) / _PYPOSE_DELTA**2).rsqrt()  # root of the weight
            scaled = (jacobian.unflatten(1, (-1, 2)) * share[..., None]).flatten(1, 2)
            normal = scaled.mT @ scaled
            damped = normal + _PYPOSE_DAMPING * torch.diag_embed(normal.diagonal(dim1=-2, dim2=-1))
            delta = self.solve(damped, -scaled.mT @ (share * residual).flatten(1)[..., None])[..., 0]
            pose = self.pypose.se3(delta).Exp() @ pose
        return pose


def _import_pypose() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it still scripts a function, which PyTorch has deprecated
        try:
            return importlib.import_module("pypose")
        except ImportError as error:
            raise ImportError("This contender needs PyPose: pip install 'kornia_pnpnet[bench]'") from error


#: Ours, by name. RANSACs have the thresholds that suit the protocol's data (docs/results).
OURS: dict[str, Callable[..., Contender]] = {
    "pnpnet-n9": functools.partial(Ours, TRAINED),
    "pnpnet-n9 compiled": functools.partial(Ours, TRAINED, compiled=True),
    "refinement": Refinement,
    "refinement compiled": functools.partial(Refinement, compiled=True),
    "epnp": functools.partial(Ours, "epnp"),
    "epnp-lm": functools.partial(Ours, "epnp-lm"),
    "reppnp": functools.partial(Ours, "reppnp"),
    "p3p-ransac": functools.partial(Ours, "p3p-ransac:threshold=50"),
}
#: All that is timed.
CONTENDERS: dict[str, Callable[..., Contender]] = {
    **OURS,
    "opencv-epnp": functools.partial(Peer, "opencv-epnp"),
    "opencv-ransac": functools.partial(Peer, "opencv-ransac"),
    "opencv-usac": functools.partial(Peer, "opencv-usac"),
    "poselib": functools.partial(Peer, "poselib"),
    "pycolmap": functools.partial(Peer, "pycolmap"),
    "kornia-dlt": KorniaDLT,
    "pypose-lm": functools.partial(PyPose, own_loop=False),
    "pypose-parts": functools.partial(PyPose, own_loop=True),
}
