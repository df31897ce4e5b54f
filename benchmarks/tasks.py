"""The interface of what is timed, and what all of it starts from.

A contender makes a task of a batch of problems; the task is called, forward or forward and backward, and says how many
problems its poses solve.
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

from kornia_pnpnet import Guess, Normalize, pose_errors, success, success_rate
from kornia_pnpnet.metrics import SuccessRate
from kornia_pnpnet.types import Correspondences, Pose, Problems

__all__ = [
    "COARSE_ANGLE_DEG",
    "COARSE_SHIFT",
    "ITERATIONS",
    "CannotBeTimedError",
    "Contender",
    "Task",
    "coarse_pose",
    "compile_or_raise",
    "first",
    "float_inputs",
    "gradient",
    "leaves_of",
    "normalized",
    "waiting",
    "without_gradient",
]

# How far the pose is from the true one from which refinements start: what the first stage of the network leaves.
COARSE_ANGLE_DEG, COARSE_SHIFT = 5.0, 0.05
# Iterations of every refinement, the trained one's number.
ITERATIONS = 5


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


def compile_or_raise(module: nn.Module, **options: bool) -> None:
    """Call its ``compile``.

    Raises:
        CannotBeTimedError: when it warns that it does not.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        module.compile(**options)
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


def float_inputs(problems: Problems, device: str) -> list[Tensor]:
    """Points, pixels and cameras in float32 on a device."""
    return [x.to(device, torch.float32) for x in problems[:3]]


def leaves_of(*tensors: Tensor) -> list[Tensor]:
    """Copies that gradients go to."""
    return [x.detach().clone().requires_grad_() for x in tensors]


def gradient(pose: Pose | Tensor, leaves: list[Tensor]) -> tuple[Tensor, ...]:
    """Backward from the sum of all entries of the poses."""
    total = pose.sum() if isinstance(pose, Tensor) else pose[0].sum() + pose[1].sum()
    return torch.autograd.grad(total, leaves, allow_unused=True)


def waiting(device: str) -> Callable[[], None] | None:
    """What waits for a device, if anything has to."""
    return torch.cuda.synchronize if device.startswith("cuda") else None


def without_gradient(call: Callable[[], Any]) -> Callable[[], Any]:
    """The call with no gradients recorded."""
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


def normalized(problems: Problems, device: str) -> tuple[Correspondences, Guess, Callable[[Pose], Pose]]:
    """Normalised pairs, the coarse pose in their frame, and the way back; none of it is timed."""
    normalize = Normalize(order=False)
    with torch.no_grad():
        corr, frame = normalize(*float_inputs(problems, device))
        start = normalize.apply_to_pose(Pose(*(x.to(corr.world_points) for x in coarse_pose(problems))), frame)
    return corr, Guess(start, torch.ones_like(corr.weights)), lambda pose: normalize.undo(pose, frame)
