"""Check the arguments of a solver's call, and convert them to one batch of one dtype."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from kornia.core.exceptions import ShapeError, TypeCheckError, ValueCheckError
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kornia_pnpnet.cameras import check_coefficients, looking_along, pinholes, with_undistorted
from kornia_pnpnet.core.checks import (
    Shapes,
    check_devices,
    check_form,
    check_shapes,
    check_tensors,
    common_dtype,
    expand_sigma,
)
from kornia_pnpnet.core.performance import full_precision, present_first, sees_values
from kornia_pnpnet.core.symmetric import equivalent_sigma, symmetric
from kornia_pnpnet.core.trees import iter_tensors, map_tensors
from kornia_pnpnet.problem import MIN_PAIRS, Inputs, Noise
from kornia_pnpnet.result import PnPResult, Pose, PosePrior, camera_matrices, with_rotation

__all__ = ["checked_inputs", "given_cameras", "in_parts", "restore_leading"]

_T = TypeVar("_T")

# `in_parts` removes padding only down to this number of rows (pairs and padding) per problem.
_LEAST_PAIRS = 16


@full_precision
def checked_inputs(
    world_points: Tensor,
    img_points: Tensor,
    intrinsics: Tensor | PinholeCamera | None,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    init: Pose | None = None,
    *,
    img_sigma: Tensor | float | None = None,
    world_sigma: Tensor | float | None = None,
    img_cov: Tensor | None = None,
    world_cov: Tensor | None = None,
    confidence: Tensor | None = None,
    prior: PosePrior | None = None,
    dist: Tensor | None = None,
    fisheye: Tensor | None = None,
    cam_from_rig: Pose | None = None,
    init_name: str = "init",
) -> tuple[torch.Size, Inputs]:
    """Check the arguments of ``PnPNet.forward``, and return the leading dimensions and one batch of one dtype.

    Distorted pixels become pixels of pinhole cameras. Bearings become a rig: each pair gets a camera whose optical axis
    is the pair's bearing. Tensor values are not checked, because reading a value would stall a GPU. ``init_name`` is
    the name of ``init`` in error messages.
    """
    is_bearing = isinstance(img_points, Tensor) and img_points.ndim > 1 and img_points.shape[-1] == 3
    if intrinsics is None and is_bearing:
        intrinsics = torch.eye(3, dtype=img_points.dtype, device=img_points.device)
    if intrinsics is None:
        raise TypeCheckError(
            "intrinsics is required with pixels (B, N, 2), got NoneType; only bearings (B, N, 3) may omit it."
        )
    check_tensors({"intrinsics": camera_matrices(intrinsics), "weights": weights})
    check_form(["*", "N", "3"], world_points=world_points)
    check_coefficients(dist, fisheye)
    if prior is not None and not isinstance(prior, PosePrior):
        raise TypeCheckError(f"prior must be a PosePrior, got {type(prior).__name__}.")
    size, pairs = world_points.shape[:-2], world_points.shape[:-1]
    is_rig = is_bearing or cam_from_rig is not None
    if (dist is not None or fisheye is not None) and is_rig:
        raise ValueCheckError("dist and fisheye are for pixels of one camera: for a rig, convert pixels to bearings.")
    if weights is not None and weights.shape == (*pairs, 2):
        got = f"one weight for each pair, not for each of u and v (see img_cov): got {tuple(weights.shape)}"
        raise ShapeError(f"weights must have the shape {tuple(pairs)}, {got}.")
    matrices = camera_matrices(intrinsics, size)
    of_pair = is_rig and matrices.ndim == len(size) + 3
    of_camera = () if matrices.ndim == 2 else pairs if of_pair else size
    shapes: Shapes = {
        "img_points": (img_points, (*pairs, 3 if is_bearing else 2)),
        "intrinsics": (matrices, (*of_camera, 3, 3)),
        "weights": (weights, pairs),
        "mask": (mask, pairs),
        "confidence": (confidence, pairs),
        "img_cov": (img_cov, (*pairs, 2, 2)),
        "world_cov": (world_cov, (*pairs, 3, 3)),
    }
    if prior is not None:
        shapes |= {"prior information": (prior.information, (*size, 6, 6)), "prior scale": (prior.scale, size)}
    poses = (init_name, init, size), ("prior", prior and prior.pose, size), ("cam_from_rig", cam_from_rig, pairs)
    for name, pose, leading in poses:
        if pose is not None:
            if not (isinstance(pose, tuple) and len(pose) == 2):
                raise TypeCheckError(f"{name} must be a Pose, got {type(pose).__name__}.")
            shapes |= {f"{name} rotation": (pose[0], (*leading, 3, 3)), f"{name} translation": (pose[1], (*leading, 3))}
    for name, lens in (("dist", dist), ("fisheye", fisheye)):
        if lens is not None:
            shapes[name] = lens, (*(size if lens.ndim > 1 else ()), lens.shape[-1])
    check_shapes(shapes, world_points)
    if pairs[-1] < MIN_PAIRS:
        raise ShapeError(f"A pose needs at least 3 pairs (..., N, 3), got world_points of {tuple(world_points.shape)}.")
    if mask is not None and mask.dtype != torch.bool:
        raise TypeCheckError(f"mask must be bool, got {mask.dtype}.")
    sigmas = {name: x for name, x in (("img_sigma", img_sigma), ("world_sigma", world_sigma)) if isinstance(x, Tensor)}
    tensors = {"world_points": world_points, **{name: x for name, (x, _) in shapes.items()}, **sigmas}
    check_devices(tensors, world_points)
    dtype = common_dtype({name: x for name, x in tensors.items() if name != "mask"})
    noise = _checked_noise(world_points.to(dtype), img_sigma, world_sigma, img_cov, world_cov)

    def one_batch(x: Tensor) -> Tensor:
        x = x if x.dtype in (dtype, torch.bool) else x.to(dtype)
        return x if len(size) == 1 else x.reshape((math.prod(size), *x.shape[len(size) :]))

    per_pair = matrices if matrices.ndim == 2 or of_pair else matrices[..., None, :, :]
    cameras = per_pair.expand(*pairs, 3, 3) if is_rig else matrices.expand(*size, 3, 3)
    inputs = Inputs(world_points, img_points, cameras, weights, mask, init, noise, confidence, prior, cam_from_rig)
    inputs = map_tensors(one_batch, inputs)
    init, rig = (pose and with_rotation(Pose(*pose)) for pose in (inputs.init, inputs.rig))
    prior = inputs.prior and inputs.prior._replace(pose=with_rotation(Pose(*inputs.prior.pose)))
    inputs = inputs._replace(init=init, prior=prior, rig=rig)
    if is_bearing:
        return size, looking_along(inputs)
    if dist is None and fisheye is None:
        return size, inputs
    lenses = map_tensors(lambda x: one_batch(x.expand(*size, x.shape[-1])), (dist, fisheye))
    return size, with_undistorted(inputs, *lenses)


def _checked_noise(
    world_points: Tensor,
    img_sigma: Tensor | float | None,
    world_sigma: Tensor | float | None,
    img_cov: Tensor | None,
    world_cov: Tensor | None,
) -> Noise | None:
    """Return the noise of every pair in the dtype of ``world_points``, or ``None`` if the caller gave no noise."""
    kinds = ("img", img_sigma, img_cov), ("world", world_sigma, world_cov)
    if all(sigma is None and cov is None for _, sigma, cov in kinds):
        return None
    noise: dict[str, Any] = {}
    for name, sigma, cov in kinds:
        if sigma is not None and cov is not None:
            raise ValueCheckError(f"Give {name}_sigma or {name}_cov, not both.")
        matrix = None if cov is None else symmetric(cov.to(world_points.dtype))
        noise[name] = equivalent_sigma(matrix) if matrix else expand_sigma(f"{name}_sigma", sigma, world_points)
        noise[f"{name}_cov"] = matrix
    return Noise(**noise)


def restore_leading(size: torch.Size, result: _T) -> _T:
    """Split the batch dimension of a result into the leading dimensions that :func:`checked_inputs` returned."""
    return result if len(size) == 1 else map_tensors(lambda x: x.reshape((*size, *x.shape[1:])), result)


def given_cameras(intrinsics: Tensor | PinholeCamera | None, size: torch.Size, like: Tensor) -> Tensor:
    """Return the caller's camera matrices of a rig, for each problem or each pair, scaled to a last entry of 1."""
    if intrinsics is None:
        return torch.eye(3, dtype=like.dtype, device=like.device).expand(*size, 3, 3)
    matrices, _ = pinholes(camera_matrices(intrinsics, size).to(like.dtype))
    return matrices.expand(*size, 3, 3) if matrices.ndim == 2 else matrices


def in_parts(solve: Callable[[Inputs], PnPResult], inputs: Inputs, most: int | None, any_number: bool) -> PnPResult:
    """Solve a batch. On a CPU, split the batch into parts that fit the caches, and solve one part after the other.

    A part has about ``most`` pairs for each CPU thread. The size of a part has no limit if ``most`` is ``None`` or
    gradients are recorded. If ``any_number`` is true (``solve`` accepts any number of pairs), problems with a mask are
    grouped by number of pairs, to limit padding. This saves a third to half of the time if the numbers differ strongly.
    """
    batch, count = inputs.world_points.shape[:2]
    if inputs.world_points.device.type != "cpu" or not sees_values(*iter_tensors(inputs)) or not batch:
        return solve(inputs)
    most = batch * count if most is None or torch.is_grad_enabled() else most * torch.get_num_threads()
    if not any_number or inputs.mask is None:
        parts = max(1, min(batch * count // most, batch // 2))
        if parts == 1:
            return solve(inputs)
        several = [map_tensors(lambda x, i=i: x.tensor_split(parts)[i], inputs) for i in range(parts)]
        return map_tensors(lambda *x: torch.cat(x), *map(solve, several))
    counts = inputs.mask.sum(1)
    if batch * count <= most and int(counts.max()) == count:
        return solve(inputs)
    order, (sizes, problems) = present_first(inputs.mask), counts.sort(stable=True)
    of_problem = {"init", "prior"} if inputs.rig is not None else {"init", "prior", "intrinsics"}
    results, places, stop = [], [], batch
    while stop:
        width = min(count, max(int(sizes[stop - 1]), _LEAST_PAIRS))
        start = max(stop - max(most // width, 2), 0)
        start = 0 if start == 1 else start
        at = problems[start:stop]
        pairs = order[at][:, :width]
        entries: dict[str, Any] = {}
        for name, tree in inputs._asdict().items():
            index = (at,) if name in of_problem else (at[:, None], pairs)
            entries[name] = map_tensors(lambda x, index=index: x[index], tree)
        result = solve(Inputs(**entries))
        none = result.weights.new_zeros(len(at), count)
        weights, inliers = none.scatter(1, pairs, result.weights), none.bool().scatter(1, pairs, result.inliers)
        results.append(result._replace(weights=weights, inliers=inliers))
        places.append(at)
        stop = start
    back = torch.cat(places).argsort()
    return map_tensors(lambda *x: torch.cat(x)[back], *results)
