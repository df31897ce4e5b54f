"""The arguments of a solver's call: what they may be, and what they become."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from kornia.core.exceptions import ShapeError, TypeCheckError
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kornia_pnpnet.core.checks import Shapes, check_devices, check_like, check_shapes, expand_sigma
from kornia_pnpnet.types import Noise, Pose, camera_matrices

__all__ = ["Inputs", "check_inputs", "checked_inputs", "one_batch"]


class Inputs(NamedTuple):
    """Checked arguments of a call: a camera for each problem, sigmas of each pair where any of them is known."""

    world_points: Tensor
    img_points: Tensor
    intrinsics: Tensor
    weights: Tensor | None
    mask: Tensor | None
    init: Pose | None
    noise: Noise | None


def one_batch(size: torch.Size, argument: Any) -> Any:
    """Reshape an argument of problems with any leading dimensions to one batch dimension.

    Args:
        size: the leading dimensions of ``world_points``; none for a single problem.
        argument: a tensor with these leading dimensions, a pose of such tensors, or what all problems share.
    """
    if isinstance(argument, tuple):
        return Pose(*(one_batch(size, x) for x in argument))
    own = isinstance(argument, Tensor) and argument.ndim > 0 and argument.shape[: len(size)] == size
    # A matrix (3, 3), or a sigma of one problem's pairs, has no leading dimensions when there are any.
    if not own or (size and argument.shape == (3, 3)):
        return argument
    return argument.reshape(size.numel(), *argument.shape[len(size) :])


def check_inputs(
    world_points: Tensor,
    img_points: Tensor,
    intrinsics: Tensor,
    weights: Tensor | None,
    mask: Tensor | None,
    init: Pose | None = None,
) -> None:
    """Check shapes, dtypes and devices; never values, which would stall a GPU and let one problem fail a batch.

    Raises:
        ShapeError: for shapes that do not fit each other, or fewer than 3 pairs.
        TypeCheckError: for arguments that are no tensors, dtypes that differ or are not float32 or float64.
        DeviceError: for tensors on different devices.
    """
    for name, value in (("world_points", world_points), ("img_points", img_points), ("intrinsics", intrinsics)):
        if not isinstance(value, Tensor):
            raise TypeCheckError(f"{name} must be a tensor, got {type(value).__name__}.")
    KORNIA_CHECK_SHAPE(world_points, ["B", "N", "3"])
    KORNIA_CHECK_SHAPE(img_points, ["B", "N", "2"])
    batch, count = world_points.shape[:2]
    rotation, translation = (None, None) if init is None else init
    shapes: Shapes = {
        "img_points": (img_points, (batch, count, 2)),
        "weights": (weights, (batch, count)),
        "mask": (mask, (batch, count)),
        "intrinsics": (intrinsics, (3, 3) if intrinsics.ndim == 2 else (batch, 3, 3)),
        "init rotation": (rotation, (batch, 3, 3)),
        "init translation": (translation, (batch, 3)),
    }
    check_shapes(shapes, world_points)
    if count < 3:
        raise ShapeError(f"A pose needs at least 3 pairs, got N = {count}.", actual_shape=tuple(world_points.shape))
    check_like({name: tensor for name, (tensor, _) in shapes.items() if name != "mask"}, world_points)
    if world_points.dtype not in (torch.float32, torch.float64):
        raise TypeCheckError(
            f"world_points must be float32 or float64, got {world_points.dtype}: cast the inputs with .float()."
        )
    if mask is not None and mask.dtype != torch.bool:
        raise TypeCheckError(f"mask must be bool, got {mask.dtype}.")
    check_devices({"mask": mask}, world_points)


def checked_inputs(
    world_points: Tensor,
    img_points: Tensor,
    intrinsics: Tensor | PinholeCamera,
    weights: Tensor | None,
    mask: Tensor | None,
    init: Pose | None,
    img_sigma: Tensor | float | None,
    world_sigma: Tensor | float | None,
) -> Inputs:
    """Check the arguments of a call, and expand them to all problems and pairs."""
    intrinsics = camera_matrices(intrinsics)
    check_inputs(world_points, img_points, intrinsics, weights, mask, init)
    noise = None
    if img_sigma is not None or world_sigma is not None:
        img, world = (expand_sigma(*x, world_points) for x in (("img_sigma", img_sigma), ("world_sigma", world_sigma)))
        noise = Noise(img, world)
    if intrinsics.ndim == 2:
        intrinsics = intrinsics.expand(world_points.shape[0], 3, 3)
    init = None if init is None else Pose(*init)
    return Inputs(world_points, img_points, intrinsics, weights, mask, init, noise)
