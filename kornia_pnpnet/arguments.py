"""The arguments of a solver's call: what they may be, and what they become."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from kornia.core.exceptions import ShapeError, TypeCheckError, ValueCheckError
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kornia_pnpnet.cameras import bearing_cameras, check_coefficients, compose, undistort
from kornia_pnpnet.core.checks import Shapes, check_devices, check_shapes, common_dtype, expand_sigma
from kornia_pnpnet.core.performance import present_first, sees_values
from kornia_pnpnet.core.symmetric import Symmetric2, Symmetric3, equivalent_sigma
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.types import FreeFocal, Noise, PnPResult, Pose, PosePrior, camera_matrices

__all__ = [
    "Inputs",
    "Part",
    "check_cameras",
    "checked_inputs",
    "checked_noise",
    "given_cameras",
    "joined",
    "one_batch",
    "restore_leading",
    "split_batch",
    "with_undistorted",
]

_T = TypeVar("_T")

# Pairs. Problems are not cut to less, so that no solver sees too few.
_LEAST_PAIRS = 16


class Inputs(NamedTuple):
    """Arguments of a call as one batch in one dtype: a camera per problem, sigmas per pair where any is known.

    Where a solver estimates the focal length, ``free_focal`` says in pixels of the caller what is known of it. In a rig
    each pair has a camera, (B, N, 3, 3), and its place in the ``rig``.
    """

    world_points: Tensor
    img_points: Tensor
    intrinsics: Tensor
    weights: Tensor | None
    mask: Tensor | None
    init: Pose | None
    noise: Noise | None
    confidence: Tensor | None
    prior: PosePrior | None = None
    free_focal: FreeFocal | None = None
    rig: Pose | None = None


class Part(NamedTuple):
    """Some problems of a batch.

    Attributes:
        inputs: the problems.
        problems: their positions in the batch, (P,); ``None``: they follow those of the part before.
        pairs: positions of their pairs among the N pairs of the batch, (P, n); ``None``: they have all pairs in order.
        most_pairs: the number N.
    """

    inputs: Inputs
    problems: Tensor | None = None
    pairs: Tensor | None = None
    most_pairs: int = 0


def checked_inputs(
    world_points: Tensor,
    img_points: Tensor,
    intrinsics: Tensor | PinholeCamera | None,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    init: Pose | None = None,
    img_sigma: Tensor | float | None = None,
    world_sigma: Tensor | float | None = None,
    img_cov: Tensor | None = None,
    world_cov: Tensor | None = None,
    confidence: Tensor | None = None,
    prior: PosePrior | None = None,
    *,
    dist: Tensor | None = None,
    fisheye: Tensor | None = None,
    cam_from_rig: Pose | None = None,
) -> tuple[torch.Size, Inputs]:
    """Check the arguments of a call, and make them one batch of one dtype, see :func:`common_dtype`.

    Distorted pixels become those of pinhole cameras, and bearings a rig of cameras that each look at their own point.

    Shapes, dtypes and devices are checked; never values, which would stall a GPU and let one problem fail a batch.

    Returns:
        The leading dimensions of ``world_points``, none for a single problem, and the inputs with one batch dimension.

    Raises:
        ShapeError: for shapes that do not fit each other, or fewer than 3 pairs.
        TypeCheckError: for arguments that are no tensors, or hold booleans or complex numbers.
        DeviceError: for tensors on different devices.
        ValueCheckError: for both a sigma and a covariance of the pixels, or of the points.
    """
    rotation, translation = (None, None) if init is None else init
    is_bearing = isinstance(img_points, Tensor) and img_points.ndim > 1 and img_points.shape[-1] == 3
    if intrinsics is None and is_bearing:
        intrinsics = torch.eye(3, dtype=img_points.dtype, device=img_points.device)
    if intrinsics is None:
        raise TypeCheckError("intrinsics must be a tensor, got NoneType: only bearings, (B, N, 3), need none.")
    matrices = camera_matrices(intrinsics)
    rig_rotation, rig_translation = (None, None) if cam_from_rig is None else cam_from_rig
    (prior_rotation, prior_translation), information, prior_scale = prior or PosePrior(Pose(None, None), None)  # type: ignore[arg-type]
    tensors = {
        "world_points": world_points,
        "img_points": img_points,
        "intrinsics": matrices,
        "weights": weights,
        "init rotation": rotation,
        "init translation": translation,
        "confidence": confidence,
        "img_cov": img_cov,
        "world_cov": world_cov,
        "prior rotation": prior_rotation,
        "prior translation": prior_translation,
        "prior information": information,
        "prior scale": prior_scale,
        "dist": dist,
        "fisheye": fisheye,
        "cam_from_rig rotation": rig_rotation,
        "cam_from_rig translation": rig_translation,
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
    check_coefficients(dist, fisheye)
    if (dist is not None or fisheye is not None) and (is_bearing or cam_from_rig is not None):
        raise ValueCheckError("dist and fisheye are for pixels of one camera: make bearings of each camera's pixels.")
    is_rig = is_bearing or cam_from_rig is not None
    of_pair = is_rig and matrices.ndim == len(size) + 3
    of_camera = () if matrices.ndim == 2 else (*size, count) if of_pair else size
    shapes: Shapes = {
        "img_points": (img_points, (*size, count, 3 if is_bearing else 2)),
        "weights": (weights, (*size, count)),
        "mask": (mask, (*size, count)),
        "confidence": (confidence, (*size, count)),
        "img_cov": (img_cov, (*size, count, 2, 2)),
        "world_cov": (world_cov, (*size, count, 3, 3)),
        "intrinsics": (matrices, (*of_camera, 3, 3)),
        "init rotation": (rotation, (*size, 3, 3)),
        "init translation": (translation, (*size, 3)),
        "prior rotation": (prior_rotation, (*size, 3, 3)),
        "prior translation": (prior_translation, (*size, 3)),
        "prior information": (information, (*size, 6, 6)),
        "prior scale": (prior_scale, size),
        "cam_from_rig rotation": (rig_rotation, (*size, count, 3, 3)),
        "cam_from_rig translation": (rig_translation, (*size, count, 3)),
    }
    for name, lens in (("dist", dist), ("fisheye", fisheye)):
        if lens is not None:
            shapes[name] = lens, (*(size if lens.ndim > 1 else ()), lens.shape[-1])
    check_shapes(shapes, world_points)
    if count < 3:
        raise ShapeError(f"A pose needs at least 3 pairs, got N = {count}.", actual_shape=tuple(world_points.shape))
    if mask is not None and mask.dtype != torch.bool:
        raise TypeCheckError(f"mask must be bool, got {mask.dtype}.")
    check_devices({**tensors, "mask": mask}, world_points)
    sigmas = {"img_sigma": img_sigma, "world_sigma": world_sigma}
    dtype = common_dtype({**tensors, **{name: x for name, x in sigmas.items() if isinstance(x, Tensor)}})
    noise = checked_noise(world_points.to(dtype), img_sigma, world_sigma, img_cov, world_cov)
    per_pair = matrices if matrices.ndim == 2 or of_pair else matrices[..., None, :, :]
    cameras = per_pair.expand(*size, count, 3, 3) if is_rig else matrices.expand(*size, 3, 3)
    pose = None if init is None else Pose(*init)
    rig = None if cam_from_rig is None else Pose(*cam_from_rig)
    given = Inputs(world_points, img_points, cameras, weights, mask, pose, noise, confidence, prior, None, rig)
    inputs = map_tensors(lambda x: one_batch(x, size, dtype), given)
    dist, fisheye = (
        None if x is None else one_batch(x.expand(*size, x.shape[-1]), size, dtype) for x in (dist, fisheye)
    )
    if is_bearing:
        return size, _looking_along(inputs)
    if dist is None and fisheye is None:
        return size, inputs
    return size, with_undistorted(inputs, dist, fisheye)


def with_undistorted(inputs: Inputs, dist: Tensor | None, fisheye: Tensor | None) -> Inputs:
    """Inputs with the pixels of pinhole cameras, see :func:`~kornia_pnpnet.cameras.undistort`.

    Pairs without such a pixel are left out; one that is not finite still fails its problem.
    """
    pixels, found, noise = undistort(inputs.img_points, inputs.intrinsics, dist, fisheye, inputs.noise)
    broken = ~inputs.img_points.isfinite().all(-1)
    mask = found | broken if inputs.mask is None else (found | broken) & inputs.mask
    return inputs._replace(img_points=torch.where(broken[..., None], inputs.img_points, pixels), mask=mask, noise=noise)


def check_cameras(inputs: Inputs, focal: str, *, distorted: bool, alternatives: int, init: object) -> None:
    """Refuse arguments that cannot be combined: an unknown focal length, distortion, rigs and alternatives.

    Raises:
        ValueCheckError: for such arguments.
    """
    rig = inputs.rig is not None
    if focal == "unknown" and (rig or distorted):
        raise ValueCheckError("focal='unknown' takes pixels of one camera without dist and fisheye.")
    if rig and (alternatives or (init is None and inputs.init is None)):
        raise ValueCheckError("A rig or bearings have no alternatives, and need an initialiser or `init`.")


def _looking_along(inputs: Inputs) -> Inputs:
    """Inputs with bearings as those of cameras whose axes are the bearings, with a focal length each and no skew.

    The focal length is the geometric mean of those given: pixels of sigma per radian.
    """
    rotation, sound = bearing_cameras(inputs.img_points)
    axis = torch.where(sound[..., None], inputs.img_points[..., :2] * 0.0, torch.nan)
    cameras = inputs.intrinsics / inputs.intrinsics[..., 2:, 2:]
    focal = (cameras[..., 0, 0] * cameras[..., 1, 1]).sqrt()
    eye = torch.eye(3, dtype=focal.dtype, device=focal.device)
    cameras = eye * torch.stack((focal, focal, torch.ones_like(focal)), -1)[..., None, :]
    return inputs._replace(img_points=axis, intrinsics=cameras, rig=compose(rotation, inputs.rig))


def checked_noise(
    world_points: Tensor,
    img_sigma: Tensor | float | None,
    world_sigma: Tensor | float | None,
    img_cov: Tensor | None,
    world_cov: Tensor | None,
) -> Noise | None:
    """The noise of every pair in the dtype of the points, from sigmas of any kind or covariances of sound shapes.

    Raises:
        ShapeError: for a sigma of another shape.
        TypeCheckError: for a sigma that is no number.
        ValueCheckError: for both a sigma and a covariance of the pixels, or of the points.
    """
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


def one_batch(x: Tensor, size: torch.Size, dtype: torch.dtype) -> Tensor:
    """Reshape a tensor with the leading dimensions ``size`` to one batch, and convert it unless it is a mask."""
    x = x if x.dtype in (dtype, torch.bool) else x.to(dtype)
    return x if len(size) == 1 else x.reshape((size.numel(), *x.shape[len(size) :]))


def restore_leading(size: torch.Size, result: _T) -> _T:
    """Give a result of one batch the leading dimensions that :func:`checked_inputs` returned."""
    return result if len(size) == 1 else map_tensors(lambda x: x.reshape((*size, *x.shape[1:])), result)


def given_cameras(intrinsics: Tensor | PinholeCamera | None, world_points: Tensor, like: Tensor) -> Tensor:
    """The cameras of a rig as they were given, expanded to a problem each, or to a pair each."""
    if intrinsics is None:
        return torch.eye(3, dtype=like.dtype, device=like.device).expand(*world_points.shape[:-2], 3, 3)
    matrices = camera_matrices(intrinsics).to(like.dtype)
    matrices = matrices / matrices[..., 2:, 2:]
    return matrices.expand(*world_points.shape[:-2], 3, 3) if matrices.ndim == 2 else matrices


def split_batch(inputs: Inputs, most: int | None, any_number: bool) -> list[Part]:
    """Split a batch into the parts that are solved one after the other.

    Only on a CPU, where a small part stays in the caches, and only where values are seen.

    Args:
        inputs: the batch.
        most: largest number of pairs of a part for each thread, without gradients; ``None``: the whole batch.
        any_number: whether parts may have fewer pairs than the batch, so that they have little padding.
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
    """Parts of problems of about the same number of pairs, at least two where there are two."""
    assert inputs.mask is not None
    batch, count = inputs.mask.shape
    counts = inputs.mask.sum(1)
    if batch * count <= most and int(counts.max()) == count:
        return [Part(inputs)]
    order = present_first(inputs.mask)
    sizes, problems = counts.sort(stable=True)
    parts, stop = [], batch
    while stop:
        width = min(count, max(int(sizes[stop - 1]), _LEAST_PAIRS))
        start = max(stop - max(most // width, 2), 0)
        start = 0 if start == 1 else start
        at = problems[start:stop]
        pairs = order[at, :width]

        is_rig = inputs.intrinsics.ndim == 4
        of_problems = None if is_rig else inputs.intrinsics, inputs.init, inputs.prior
        cameras, init, prior = map_tensors(lambda x, at=at: x[at], of_problems)
        of_pairs = map_tensors(
            lambda x, at=at, pairs=pairs: x[at[:, None], pairs],
            inputs._replace(intrinsics=inputs.intrinsics if is_rig else inputs.mask, init=None, prior=None),
        )
        of_pairs = of_pairs._replace(init=init, prior=prior)
        parts.append(Part(of_pairs if cameras is None else of_pairs._replace(intrinsics=cameras), at, pairs, count))
        stop = start
    return parts


def joined(parts: list[Part], results: list[PnPResult]) -> PnPResult:
    """The results of all problems and pairs of a batch from those of its parts."""
    padded = []
    for part, result in zip(parts, results, strict=True):
        if part.pairs is not None:
            weights = result.weights.new_zeros(len(part.pairs), part.most_pairs)
            result = result._replace(weights=weights.scatter(1, part.pairs, result.weights))
        padded.append(result)
    result = padded[0] if len(padded) == 1 else map_tensors(lambda *x: torch.cat(x), *padded)
    if parts[0].problems is None:
        return result
    problems = torch.cat([part.problems for part in parts if part.problems is not None])
    back = torch.empty_like(problems).scatter_(0, problems, torch.arange(len(problems), device=problems.device))
    return map_tensors(lambda x: x[back], result)
