"""Check the arguments of a solver's call, and convert them to one batch of one dtype."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import torch
from kornia.core.exceptions import ShapeError, TypeCheckError, ValueCheckError
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kornia_pnpnet.cameras import bearing_cameras, check_coefficients, focal_length, pinholes, undistort
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
from kornia_pnpnet.core.symmetric import Symmetric2, Symmetric3, equivalent_sigma
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.problem import MIN_PAIRS, Noise
from kornia_pnpnet.refine.terms import CameraTerm
from kornia_pnpnet.result import PnPResult, Pose, PosePrior, camera_matrices, with_rotation

__all__ = ["Inputs", "checked_inputs", "given_cameras", "joined", "restore_leading", "split_batch", "with_undistorted"]

_T = TypeVar("_T")

# Pairs. `_without_padding` keeps at least this number of pairs of each problem, padding included.
_LEAST_PAIRS = 16


class Inputs(NamedTuple):
    """The arguments of a call as one batch in one dtype. If ``noise`` is given, every pair has sigmas.

    In a rig, ``intrinsics`` has a camera matrix for each pair, (B, N, 3, 3), and ``rig`` the transform from the rig to
    the camera of each pair. ``free_focal`` is the range and the prior of an unknown focal length in the caller's
    pixels. The pixels are already undistorted with the estimated coefficients ``radial``, if given.
    """

    world_points: Tensor
    img_points: Tensor
    intrinsics: Tensor
    weights: Tensor | None = None
    mask: Tensor | None = None
    init: Pose | None = None
    noise: Noise | None = None
    confidence: Tensor | None = None
    prior: PosePrior | None = None
    rig: Pose | None = None
    free_focal: CameraTerm | None = None
    radial: Tensor | None = None


class Part(NamedTuple):
    """Some problems of a batch.

    Attributes:
        inputs: the problems.
        places: positions of the problems in the batch, (P,), and for each problem the order of the batch's pairs,
            (P, N), of which ``inputs`` has the first. ``None``: the parts are consecutive slices of the batch.
    """

    inputs: Inputs
    places: tuple[Tensor, Tensor] | None = None


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
    is the pair's bearing. Tensor values are not checked, because reading a value would stall a GPU. ``init_name`` names
    ``init`` in messages.
    """
    is_bearing = isinstance(img_points, Tensor) and img_points.ndim > 1 and img_points.shape[-1] == 3
    if intrinsics is None and is_bearing:
        intrinsics = torch.eye(3, dtype=img_points.dtype, device=img_points.device)
    if intrinsics is None:
        raise TypeCheckError(
            "intrinsics must be a tensor, got NoneType: only bearings (B, N, 3) may omit it, pixels (B, N, 2) need it."
        )
    matrices = camera_matrices(intrinsics)
    if prior is not None and not isinstance(prior, PosePrior):
        raise TypeCheckError(f"prior must be a PosePrior, got {type(prior).__name__}.")
    # Tensors with an entry for each pair or for each problem, and the shape of an entry.
    of_pairs: Shapes = {"weights": (weights, ()), "mask": (mask, ()), "confidence": (confidence, ())}
    of_pairs |= {"img_cov": (img_cov, (2, 2)), "world_cov": (world_cov, (3, 3))}
    of_problems: Shapes = {}
    if prior is not None:
        of_problems |= {"prior information": (prior.information, (6, 6)), "prior scale": (prior.scale, ())}
    poses = (init_name, init, of_problems), ("prior", prior and prior.pose, of_problems)
    for name, pose, entries in (*poses, ("cam_from_rig", cam_from_rig, of_pairs)):
        if pose is not None:
            if not (isinstance(pose, tuple) and len(pose) == 2):
                raise TypeCheckError(f"{name} must be a Pose, got {type(pose).__name__}.")
            rotation, translation = pose
            entries |= {f"{name} rotation": (rotation, (3, 3)), f"{name} translation": (translation, (3,))}
    optional: dict[str, Any] = {name: x for name, (x, _) in (of_pairs | of_problems).items()}
    for name, sigma in (("img_sigma", img_sigma), ("world_sigma", world_sigma)):
        optional[name] = sigma if isinstance(sigma, Tensor) else None
    optional |= {"dist": dist, "fisheye": fisheye}
    tensors: dict[str, Any] = {"world_points": world_points, "img_points": img_points, "intrinsics": matrices}
    tensors |= {name: x for name, x in optional.items() if x is not None}
    check_tensors(tensors)
    check_form(["*", "N", "3"], world_points=world_points)
    size, count = world_points.shape[:-2], world_points.shape[-2]
    tensors["intrinsics"] = matrices = _of_problems(intrinsics, matrices, size)
    if weights is not None and weights.shape == (*size, count, 2):
        raise ShapeError(
            f"weights must have the shape {(*size, count)}, one for each pair, not one for each of u and v: "
            f"got {tuple(weights.shape)}.",
            actual_shape=tuple(weights.shape),
            expected_shape=(*size, count),
        )
    check_coefficients(dist, fisheye)
    is_rig = is_bearing or cam_from_rig is not None
    if (dist is not None or fisheye is not None) and is_rig:
        raise ValueCheckError("dist and fisheye are for pixels of one camera: make bearings of each camera's pixels.")
    of_pair = is_rig and matrices.ndim == len(size) + 3
    of_camera = () if matrices.ndim == 2 else (*size, count) if of_pair else size
    shapes: Shapes = {
        "img_points": (img_points, (*size, count, 3 if is_bearing else 2)),
        "intrinsics": (matrices, (*of_camera, 3, 3)),
    }
    shapes |= {name: (x, (*size, count, *entry)) for name, (x, entry) in of_pairs.items()}
    shapes |= {name: (x, (*size, *entry)) for name, (x, entry) in of_problems.items()}
    for name, lens in (("dist", dist), ("fisheye", fisheye)):
        if lens is not None:
            shapes[name] = lens, (*(size if lens.ndim > 1 else ()), lens.shape[-1])
    check_shapes(shapes, world_points)
    if count < MIN_PAIRS:
        raise ShapeError(f"A pose needs at least 3 pairs, got N = {count}.", actual_shape=tuple(world_points.shape))
    if mask is not None and mask.dtype != torch.bool:
        raise TypeCheckError(f"mask must be bool, got {mask.dtype}.")
    check_devices(tensors, world_points)
    dtype = common_dtype({name: x for name, x in tensors.items() if name != "mask"})
    noise = _checked_noise(world_points.to(dtype), img_sigma, world_sigma, img_cov, world_cov)
    per_pair = matrices if matrices.ndim == 2 or of_pair else matrices[..., None, :, :]
    cameras = per_pair.expand(*size, count, 3, 3) if is_rig else matrices.expand(*size, 3, 3)
    init, rig = (None if pose is None else Pose(*pose) for pose in (init, cam_from_rig))
    inputs = Inputs(world_points, img_points, cameras, weights, mask, init, noise, confidence, prior, rig)
    inputs = map_tensors(lambda x: one_batch(x, size, dtype), inputs)
    init, prior, rig = inputs.init, inputs.prior, inputs.rig
    inputs = inputs._replace(
        init=init and with_rotation(init),
        prior=prior and prior._replace(pose=with_rotation(prior.pose)),
        rig=rig and with_rotation(rig),
    )
    if is_bearing:
        return size, _looking_along(inputs)
    if dist is None and fisheye is None:
        return size, inputs
    lenses = map_tensors(lambda x: one_batch(x.expand(*size, x.shape[-1]), size, dtype), (dist, fisheye))
    return size, with_undistorted(inputs, *lenses)


def _checked_noise(
    world_points: Tensor,
    img_sigma: Tensor | float | None,
    world_sigma: Tensor | float | None,
    img_cov: Tensor | None,
    world_cov: Tensor | None,
) -> Noise | None:
    """The noise of every pair in the dtype of ``world_points``; ``None`` if the caller gave no noise."""
    kinds = {"img": (img_sigma, img_cov), "world": (world_sigma, world_cov)}
    for name, (sigma, cov) in kinds.items():
        if sigma is not None and cov is not None:
            raise ValueCheckError(f"Give {name}_sigma or {name}_cov, not both.")
    if all(x is None for kind in kinds.values() for x in kind):
        return None
    img = None if img_cov is None else Symmetric2.of(img_cov.to(world_points.dtype))
    world = None if world_cov is None else Symmetric3.of(world_cov.to(world_points.dtype))
    return Noise(
        expand_sigma("img_sigma", img_sigma, world_points) if img is None else equivalent_sigma(img),
        expand_sigma("world_sigma", world_sigma, world_points) if world is None else equivalent_sigma(world),
        img,
        world,
    )


def with_undistorted(inputs: Inputs, dist: Tensor | None, fisheye: Tensor | None) -> Inputs:
    """Replace distorted pixels by pixels of pinhole cameras, see :func:`~kornia_pnpnet.cameras.undistort`.

    Pairs whose pixel cannot be undistorted are masked out. Non-finite pixels stay: ``Normalize`` refuses their problem.
    """
    # Rounding depends on the memory layout.
    inputs, dist, fisheye = map_tensors(torch.Tensor.contiguous, (inputs, dist, fisheye))
    broken = ~inputs.img_points.isfinite().all(-1)
    seen = torch.where(broken[..., None], 0.0, inputs.img_points)
    pixels, found, noise = undistort(seen, inputs.intrinsics, dist, fisheye, inputs.noise)
    mask = found | broken if inputs.mask is None else (found | broken) & inputs.mask
    return inputs._replace(img_points=torch.where(broken[..., None], inputs.img_points, pixels), mask=mask, noise=noise)


def _looking_along(inputs: Inputs) -> Inputs:
    """Convert bearings to a rig, see :func:`checked_inputs`."""
    inputs = map_tensors(torch.Tensor.contiguous, inputs)  # rounding depends on the memory layout
    rotation, sound = bearing_cameras(inputs.img_points)
    rig = inputs.rig
    if rig is not None:  # a pair with an invalid camera becomes a pair without a direction
        sound = sound & torch.cat((rig.rotation.flatten(-2), rig.translation), -1).detach().isfinite().all(-1)
        eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
        turn = torch.where(sound[..., None, None], rig.rotation, eye)
        shift = torch.where(sound[..., None], rig.translation, 0.0)
        rig = Pose(rotation @ turn, (rotation @ shift[..., None])[..., 0])
    axis = torch.where(sound[..., None], torch.zeros_like(inputs.img_points[..., :2]), torch.nan)
    # The geometric mean of fx and fy converts sigmas from pixels to radians. Skew and principal point are ignored.
    cameras, has_focal = pinholes(inputs.intrinsics.diagonal(dim1=-2, dim2=-1).diag_embed())
    focal = torch.where(has_focal, focal_length(cameras), 0.0)
    cameras = torch.stack((focal, focal, torch.ones_like(focal)), -1).diag_embed()
    rig = Pose(rotation, torch.zeros_like(rotation[..., 0])) if rig is None else rig
    return inputs._replace(img_points=axis, intrinsics=cameras, rig=rig)


def one_batch(x: Tensor, size: torch.Size, dtype: torch.dtype) -> Tensor:
    """Merge the leading dimensions ``size`` into one batch dimension, and convert all but bool tensors to ``dtype``."""
    x = x if x.dtype in (dtype, torch.bool) else x.to(dtype)
    return x if len(size) == 1 else x.reshape((size.numel(), *x.shape[len(size) :]))


def restore_leading(size: torch.Size, result: _T) -> _T:
    """Split the batch dimension of a result into the leading dimensions that :func:`checked_inputs` returned."""
    return result if len(size) == 1 else map_tensors(lambda x: x.reshape((*size, *x.shape[1:])), result)


def given_cameras(intrinsics: Tensor | PinholeCamera | None, world_points: Tensor, like: Tensor) -> Tensor:
    """The caller's camera matrices of a rig, scaled to a last entry of 1: one matrix for each problem or each pair."""
    size = world_points.shape[:-2]
    if intrinsics is None:
        return torch.eye(3, dtype=like.dtype, device=like.device).expand(*size, 3, 3)
    matrices = _of_problems(intrinsics, camera_matrices(intrinsics).to(like.dtype), size)
    matrices = matrices / matrices[..., 2:, 2:]
    return matrices.expand(*size, 3, 3) if matrices.ndim == 2 else matrices


def _of_problems(intrinsics: Tensor | PinholeCamera, matrices: Tensor, size: torch.Size) -> Tensor:
    """Give the matrices of Kornia's cameras, which have one batch dimension, the leading dimensions of the problems."""
    one_batch = isinstance(intrinsics, PinholeCamera) and matrices.ndim == 3 and len(matrices) == size.numel()
    return matrices.reshape(*size, 3, 3) if one_batch else matrices


def split_batch(inputs: Inputs, most: int | None, any_number: bool) -> list[Part]:
    """On a CPU, split a batch into parts that fit the caches and are solved one after the other.

    A part has at most ``most`` pairs for each CPU thread; no limit with ``None`` or recorded gradients. With
    ``any_number``, problems are grouped by their number of pairs, so that parts have little padding. Grouping saves a
    third to half of the time if the numbers of pairs differ strongly.
    """
    batch, count = inputs.world_points.shape[:2]
    if inputs.world_points.device.type != "cpu" or not sees_values(inputs.world_points) or not batch:
        return [Part(inputs)]
    most = batch * count if most is None or torch.is_grad_enabled() else most * torch.get_num_threads()
    if any_number and inputs.mask is not None:
        return _without_padding(inputs, most)
    parts = max(1, min(batch * count // most, batch // 2))
    if parts == 1:
        return [Part(inputs)]
    return [Part(map_tensors(lambda x, i=i: x.tensor_split(parts)[i], inputs)) for i in range(parts)]


def _without_padding(inputs: Inputs, most: int) -> list[Part]:
    """Group problems with similar numbers of pairs into parts. Each part has at least two problems if possible."""
    assert inputs.mask is not None
    batch, count = inputs.mask.shape
    counts = inputs.mask.sum(1)
    if batch * count <= most and int(counts.max()) == count:
        return [Part(inputs)]
    order, (sizes, problems) = present_first(inputs.mask), counts.sort(stable=True)
    of_problem = {"init", "prior"} if inputs.rig is not None else {"init", "prior", "intrinsics"}
    parts, stop = [], batch
    while stop:
        width = min(count, max(int(sizes[stop - 1]), _LEAST_PAIRS))
        start = max(stop - max(most // width, 2), 0)
        start = 0 if start == 1 else start
        at, pairs = problems[start:stop], order[problems[start:stop]]
        entries: dict[str, Any] = {}
        for name, tree in inputs._asdict().items():
            index = (at,) if name in of_problem else (at[:, None], pairs[:, :width])
            entries[name] = map_tensors(lambda x, index=index: x[index], tree)
        parts.append(Part(Inputs(**entries), (at, pairs)))
        stop = start
    return parts


def joined(parts: list[Part], results: list[PnPResult]) -> PnPResult:
    """Join the results of the parts of a batch."""
    places = [part.places for part in parts if part.places is not None]
    for i, (_, pairs) in enumerate(places):
        none, at, result = torch.zeros_like(pairs), pairs[:, : results[i].weights.shape[1]], results[i]
        weights = none.to(result.weights).scatter(1, at, result.weights)
        results[i] = result._replace(weights=weights, inliers=none.bool().scatter(1, at, result.inliers))
    whole = results[0] if len(results) == 1 else map_tensors(lambda *x: torch.cat(x), *results)
    if not places:
        return whole
    back = torch.cat([problems for problems, _ in places]).argsort()
    return map_tensors(lambda x: x[back], whole)
