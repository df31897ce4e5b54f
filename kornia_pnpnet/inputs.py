"""The arguments of a solver's call: what they may be, and what they become."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from kornia.core.exceptions import ShapeError, TypeCheckError
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kornia_pnpnet.core.checks import Shapes, check_devices, check_shapes, common_dtype, expand_sigma
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.types import Noise, Pose, camera_matrices

__all__ = ["Inputs", "checked_inputs", "one_batch", "restore_leading"]

_T = TypeVar("_T")


class Inputs(NamedTuple):
    """Arguments of a call as one batch in one dtype: a camera per problem, sigmas per pair where any is known."""

    world_points: Tensor
    img_points: Tensor
    intrinsics: Tensor
    weights: Tensor | None
    mask: Tensor | None
    init: Pose | None
    noise: Noise | None
    confidence: Tensor | None


def checked_inputs(
    world_points: Tensor,
    img_points: Tensor,
    intrinsics: Tensor | PinholeCamera,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    init: Pose | None = None,
    img_sigma: Tensor | float | None = None,
    world_sigma: Tensor | float | None = None,
    confidence: Tensor | None = None,
) -> tuple[torch.Size, Inputs]:
    """Check the arguments of a call, and make them one batch of one dtype, see :func:`common_dtype`.

    Shapes, dtypes and devices are checked; never values, which would stall a GPU and let one problem fail a batch.

    Returns:
        The leading dimensions of ``world_points``, none for a single problem, and the inputs with one batch dimension.

    Raises:
        ShapeError: for shapes that do not fit each other, or fewer than 3 pairs.
        TypeCheckError: for arguments that are no tensors, or hold booleans or complex numbers.
        DeviceError: for tensors on different devices.
    """
    rotation, translation = (None, None) if init is None else init
    matrices = camera_matrices(intrinsics)
    tensors = {
        "world_points": world_points,
        "img_points": img_points,
        "intrinsics": matrices,
        "weights": weights,
        "init rotation": rotation,
        "init translation": translation,
        "confidence": confidence,
    }
    required = ("world_points", "img_points", "intrinsics")
    for name, value in (*tensors.items(), ("mask", mask)):
        if not isinstance(value, Tensor) and (name in required or value is not None):
            raise TypeCheckError(f"{name} must be a tensor, got {type(value).__name__}.")
    KORNIA_CHECK_SHAPE(world_points, ["*", "N", "3"])
    size, count = world_points.shape[:-2], world_points.shape[-2]
    if isinstance(intrinsics, PinholeCamera) and len(matrices) == size.numel():  # Kornia's cameras are one batch
        matrices = matrices.reshape(*size, 3, 3)
    if weights is not None and weights.shape == (*size, count, 2):
        raise ShapeError(
            f"weights must have the shape {(*size, count)}, one for each pair, not one for each of u and v: "
            f"got {tuple(weights.shape)}.",
            actual_shape=tuple(weights.shape),
            expected_shape=(*size, count),
        )
    shapes: Shapes = {
        "img_points": (img_points, (*size, count, 2)),
        "weights": (weights, (*size, count)),
        "mask": (mask, (*size, count)),
        "confidence": (confidence, (*size, count)),
        "intrinsics": (matrices, (3, 3) if matrices.ndim == 2 else (*size, 3, 3)),
        "init rotation": (rotation, (*size, 3, 3)),
        "init translation": (translation, (*size, 3)),
    }
    check_shapes(shapes, world_points)
    if count < 3:
        raise ShapeError(f"A pose needs at least 3 pairs, got N = {count}.", actual_shape=tuple(world_points.shape))
    if mask is not None and mask.dtype != torch.bool:
        raise TypeCheckError(f"mask must be bool, got {mask.dtype}.")
    check_devices({**tensors, "mask": mask}, world_points)
    sigmas = {"img_sigma": img_sigma, "world_sigma": world_sigma}
    dtype = common_dtype({**tensors, **{name: x for name, x in sigmas.items() if isinstance(x, Tensor)}})
    noise = None
    if img_sigma is not None or world_sigma is not None:
        like = world_points.to(dtype)
        noise = Noise(*(expand_sigma(name, sigma, like) for name, sigma in sigmas.items()))
    cameras = matrices.expand(*size, 3, 3)
    pose = None if init is None else Pose(*init)
    given = Inputs(world_points, img_points, cameras, weights, mask, pose, noise, confidence)
    return size, map_tensors(lambda x: one_batch(x, size, dtype), given)


def one_batch(x: Tensor, size: torch.Size, dtype: torch.dtype) -> Tensor:
    """Reshape a tensor with the leading dimensions ``size`` to one batch, and convert it unless it is a mask."""
    x = x if x.dtype in (dtype, torch.bool) else x.to(dtype)
    return x if len(size) == 1 else x.reshape((size.numel(), *x.shape[len(size) :]))


def restore_leading(size: torch.Size, result: _T) -> _T:
    """Give a result of one batch the leading dimensions that :func:`checked_inputs` returned."""
    return result if len(size) == 1 else map_tensors(lambda x: x.reshape((*size, *x.shape[1:])), result)
