"""The interface of a contender, and the inputs that all contenders start from.

A contender makes a task of a batch of problems. A task can be timed, forward or forward and backward, and counts how
many problems its poses solve.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from harness import seconds
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor, nn

from kornia_pnpnet import Normalize, Starts, pose_errors, success, success_rate
from kornia_pnpnet.metrics import SuccessRate
from kornia_pnpnet.problem import Problem
from kornia_pnpnet.result import Pose, Problems

# Errors of the pose that refinements start from, about those of the network's guess: the angle, and the distance as a
# share of the distance to the points.
COARSE_ANGLE_DEG, COARSE_SHIFT = 5.0, 0.05
#: Iterations of every refinement.
ITERATIONS = 5


class CannotBeTimedError(Exception):
    """Why a contender cannot be timed."""


@dataclass
class Task:
    """A call on given problems.

    Attributes:
        call: solves all problems once, forward, or forward and backward.
        poses: returns the poses in the frame of the problems; not timed.
        problems: the problems.
        finish: waits for the device.
    """

    call: Callable[[], object]
    poses: Callable[[], Pose]
    problems: Problems
    finish: Callable[[], None] | None = None

    def seconds(self, times: int = 1) -> float:
        """Seconds of a call, the mean over ``times`` calls."""
        if self.finish is None:
            return seconds(self.call, times)
        self.finish()

        def everything() -> None:
            for _ in range(times):
                self.call()
            self.finish()  # type: ignore[misc]

        return seconds(everything) / times

    def warm(self) -> float:
        """Call twice, first to compile and to fill caches, and return the seconds of the second call.

        Raises:
            CannotBeTimedError: when the call warns that it does not compile.
        """
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            self.seconds()
            once = self.seconds()
        _raise_uncompiled(caught)
        return once

    def success(self) -> SuccessRate:
        """Share of the problems that are solved."""
        with torch.no_grad():
            pose = Pose(*(x.double().cpu() for x in self.poses()))
        return success_rate(success(pose_errors(pose, self.problems.pose)))


def _raise_uncompiled(caught: Sequence[warnings.WarningMessage]) -> None:
    for warning in caught:
        if "compil" in str(warning.message) and not issubclass(warning.category, DeprecationWarning):
            raise CannotBeTimedError(str(warning.message))


def compile_or_raise(module: nn.Module, **options: bool | str) -> None:
    """Call the module's ``compile``.

    Raises:
        CannotBeTimedError: when ``compile`` warns that it does not compile.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        module.compile(**options)
    _raise_uncompiled(caught)


class Contender:
    """A solver to be timed.

    Attributes:
        loops: whether problems are solved one after the other. Then a part of a batch tells the time per problem.
        differentiable: whether there are gradients.
        n: the only number of pairs that the solver takes, if there is one.
    """

    loops = False
    differentiable = True
    n: int | None = None

    def takes(self, n: int) -> bool:
        """Whether the contender gets problems of ``n`` pairs."""
        return self.n in (None, n)

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """Prepare a batch; this is not timed."""
        raise NotImplementedError


def first(problems: Problems, count: int) -> Problems:
    """The first ``count`` problems of a batch."""
    return problems.map(lambda x: x[:count])


def relative_errors(pose: Pose, problems: Problems) -> tuple[Tensor, Tensor]:
    """Rotation errors in degrees, and distances of the camera centres by the median distance of the points, (B,)."""
    centres = (-(x.rotation.mT @ x.translation[..., None])[..., 0] for x in (pose, problems.pose))
    cam_points = problems.world_points @ problems.pose.rotation.mT + problems.pose.translation[:, None]
    shift = (next(centres) - next(centres)).norm(dim=-1) / cam_points.norm(dim=-1).median(1).values
    return pose_errors(pose, problems.pose).rotation_error_deg, shift


def float_inputs(problems: Problems, device: str) -> list[Tensor]:
    """Points, pixels and intrinsics in float32 on a device."""
    inputs = (problems.world_points, problems.img_points, problems.intrinsics)
    return [x.to(device, torch.float32) for x in inputs]


def leaves_of(*tensors: Tensor) -> list[Tensor]:
    """Copies that collect gradients."""
    return [x.detach().clone().requires_grad_() for x in tensors]


def gradient(pose: Pose | Tensor, leaves: list[Tensor]) -> tuple[Tensor, ...]:
    """Gradients of the sum of all entries of the poses."""
    total = pose.sum() if isinstance(pose, Tensor) else pose.rotation.sum() + pose.translation.sum()
    return torch.autograd.grad(total, leaves, allow_unused=True)


def waiting(device: str) -> Callable[[], None] | None:
    """The function that waits for a device, ``None`` for the CPU."""
    return torch.cuda.synchronize if device.startswith("cuda") else None


def without_gradient(call: Callable[[], Any]) -> Callable[[], Any]:
    """The call without recording gradients."""
    return torch.no_grad()(call)


def coarse_pose(problems: Problems, seed: int = 0) -> Pose:
    """The true poses, turned about the centre of the points and moved."""
    rotation, translation = problems.pose
    generator = torch.Generator().manual_seed(seed)
    turn, shift = torch.randn(2, len(rotation), 3, generator=generator, dtype=torch.float64)
    turn, shift = (x / x.norm(dim=-1, keepdim=True) for x in (turn, shift))
    centre = problems.world_points.mean(1)[..., None]  # (B, 3, 1)
    camera_centre = rotation @ centre + translation[..., None]
    turned = axis_angle_to_rotation_matrix(torch.deg2rad(torch.tensor(COARSE_ANGLE_DEG)) * turn).to(rotation) @ rotation
    shift = COARSE_SHIFT * camera_centre.norm(dim=1) * shift.to(translation)
    return Pose(turned, (camera_centre - turned @ centre)[..., 0] + shift)


def normalized(problems: Problems, device: str) -> tuple[Problem, Starts, Callable[[Pose], Pose]]:
    """Normalised pairs, the coarse pose in their frame, and the function that undoes normalisation for a pose."""
    with torch.no_grad():
        problem, frame = Normalize(order=False)(*float_inputs(problems, device))
        start = frame.apply(Pose(*(x.to(problem.world_points) for x in coarse_pose(problems))))
    return problem, Starts(start, torch.ones_like(problem.weights)), frame.undo
