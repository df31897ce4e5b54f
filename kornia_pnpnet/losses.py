"""Differentiable distances between poses, and training losses for both stages of a solver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from kornia.geometry.conversions import convert_points_from_homogeneous
from torch import Tensor, nn

from kornia_pnpnet.core.checks import (
    check_like,
    check_numbers,
    check_positive,
    check_shapes,
    check_tensors,
    check_whole,
)
from kornia_pnpnet.core.linalg import lengths
from kornia_pnpnet.core.performance import full_precision
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.problem import Noise, Starts
from kornia_pnpnet.result import PnPResult, Pose, Problems, check_pose, check_poses

__all__ = ["LossTerms", "PoseLoss", "SetLoss", "pose_distances"]

# Probabilities in the cross entropy are at least this number, so that the loss of a single pair is bounded.
_LEAST_PROBABILITY = 1e-3
# Squared residuals are clipped to this multiple of the variance, because larger residuals are not noise.
_MOST_VARIANCES = 20.0


class LossTerms(NamedTuple):
    """The loss and its terms. Each field is a scalar, the mean over the batch."""

    total: Tensor  #: Weighted sum of the terms. In the sum, the refined terms are saturated, see :class:`PoseLoss`.
    init_rotation: Tensor  #: Chordal rotation distance of the first guess.
    init_translation: Tensor  #: Translation distance of the first guess, measured at the centroid of the points.
    refined_rotation: Tensor  #: Chordal rotation distance after refinement.
    refined_translation: Tensor  #: Translation distance after refinement.
    weights: Tensor  #: Cross entropy of the weights, which are inlier probabilities; 0 in :class:`PoseLoss`.
    noise: Tensor  #: Negative log-likelihood of the estimated noise; 0 in :class:`PoseLoss`.


def pose_distances(estimate: Pose, truth: Pose, origin: Tensor | None = None) -> tuple[Tensor, Tensor]:
    r"""Rotation and translation distances between poses. The gradients of the distances are bounded, even at 0.

    Args:
        estimate: rotation :math:`(B, 3, 3)` and translation :math:`(B, 3)`.
        truth: rotation :math:`(B, 3, 3)` and translation :math:`(B, 3)`.
        origin: world point at which the translations are compared, :math:`(B, 3)`; ``None``: the world's origin.

    Returns:
        The chordal rotation distance :math:`\|\hat R - R\|_F = 2\sqrt2 \sin(\theta / 2)` for the angle
        :math:`\theta`, and the translation distance :math:`\|\hat t - t\|`, each :math:`(B,)`.

    Raises:
        BaseError: when shapes are not as documented, or dtypes or devices differ.

    Example:
        >>> eye = Pose(torch.eye(3)[None], torch.zeros(1, 3))
        >>> turned = Pose(torch.tensor([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]]), torch.tensor([[3.0, 4, 0]]))
        >>> pose_distances(turned, eye)
        (tensor([2.]), tensor([5.]))
    """
    check_poses(estimate, truth)
    rotation = estimate.rotation - truth.rotation
    translation = estimate.translation - truth.translation
    if origin is not None:
        check_shapes({"origin": (origin, tuple(translation.shape))})
        check_like({"origin": origin}, translation, "the translation of the estimate")
        translation = translation + (rotation * origin[..., None, :]).sum(-1)
    return lengths(rotation.flatten(-2)), lengths(translation)


def _centre(problems: Problems) -> Tensor:
    """Centroids of the finite world points, (B, 3). The tensors of the problems must have one dtype and one device."""
    check_pose("The pose of the problems", problems.pose)
    tensors = {name: getattr(problems, name) for name in ("world_points", "img_points", "intrinsics")}
    check_tensors(tensors)
    check_shapes({"img_points": (problems.img_points, (*problems.world_points.shape[:-1], 2))}, problems.world_points)
    check_like(tensors, problems.pose.translation, "the translation of the truth")
    world, seen = problems.world_points, problems.world_points.isfinite().all(-1, keepdim=True)
    return torch.where(seen, world, 0.0).sum(-2) / seen.sum(-2).clamp(min=1)


@dataclass(eq=False, repr=False, kw_only=True)
class PoseLoss(nn.Module):
    r"""Weighted sum of rotation and translation distances, for the first guess and for the refined pose.

    Refined translations are compared at the world's origin, as in :func:`~kornia_pnpnet.metrics.pose_errors`.
    Translations of the first guess are compared at the centroid of the points. At a distant origin, the translation
    error would repeat the rotation error. The error of a failed refinement has no bound. The weighted refined
    distance :math:`d` of a problem is therefore saturated to :math:`d / (1 + d / c)`.

    Args:
        rotation: weight of the chordal rotation distances.
        translation: weight of the refined translation distance, per unit of length.
        init_translation: weight of the first guess's translation distance, per unit of length.
        refined: weight of the refined terms for ``ramp=1``. The terms of the first guess have the weight 1.
        saturation: :math:`c`, for example the largest distance that counts as a success; ``None``: no saturation.

    Raises:
        BaseError: for a negative weight, or a saturation that is not positive.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> problems = SyntheticProblems(batch_size=1, seed=0).batch(0)
        >>> result = PnPResult(*problems.pose, torch.ones(1, 9), torch.zeros(1), torch.tensor([True]), problems.pose)
        >>> PoseLoss()(result, problems).total.item() < 1e-6
        True
    """

    rotation: float = 1.0
    translation: float = 0.1
    init_translation: float = 0.02
    refined: float = 1.0
    saturation: float | None = None

    def __post_init__(self) -> None:
        super().__init__()
        check_positive(saturation=math.inf if self.saturation is None else self.saturation, or_infinite=True)
        check_numbers(0.0, rotation=self.rotation, translation=self.translation)
        check_numbers(0.0, init_translation=self.init_translation, refined=self.refined)

    def forward(self, result: PnPResult, problems: Problems, ramp: float = 1.0) -> LossTerms:
        r"""Compare a solver's result with the true poses. Different shapes, dtypes or devices raise ``BaseError``.

        Args:
            result: the result for :math:`B` problems.
            problems: the problems with their true poses.
            ramp: factor of the refined terms, 0 at the start of a training. At 0 the refined terms have no gradient.
        """
        init_rotation, init_translation = pose_distances(result.init, problems.pose, _centre(problems))
        pose = result.pose if ramp > 0.0 else map_tensors(Tensor.detach, result.pose)
        rotation, translation = pose_distances(pose, problems.pose)
        init = self.rotation * init_rotation + self.init_translation * init_translation
        refined = self.rotation * rotation + self.translation * translation
        largest = math.inf if self.saturation is None else self.saturation
        total = init + ramp * self.refined * refined / (1.0 + refined / largest)
        none = torch.zeros_like(total)
        terms = LossTerms(total, init_rotation, init_translation, rotation, translation, weights=none, noise=none)
        return map_tensors(torch.mean, terms)


@dataclass(eq=False, repr=False, kw_only=True)
class SetLoss(nn.Module):
    r"""The loss of poses, inlier probabilities and noise, for training :class:`~kornia_pnpnet.propose.set.SetInit`.

    Translations are compared at the points' centroid, in units of its distance from the camera. The terms are:

    - First guess: a weighted mean of the best hypothesis's distance and the mean distance of all hypotheses. The best
      hypothesis has most of the weight, so that hypotheses can differ.
    - Refined pose: the sum of the rotation and translation distances in units of ``rotation_unit`` and
      ``translation_unit``. The sum is saturated as in :class:`PoseLoss`.
    - Binary cross entropy of the network's weights.
    - Negative log-likelihood of the estimated noise, given the inliers' residuals at the true pose.

    Args:
        starts: number of the network's hypotheses, which are the first poses of ``guess``.
        every: weight of the mean distance of all hypotheses. The best hypothesis has the weight ``1 - every``.
        refined: weight of the refined term, for ``ramp=1``.
        saturation: :math:`c` of the refined term, see :class:`PoseLoss`.
        weights: weight of the cross entropy.
        noise: weight of the negative log-likelihood.
        rotation_unit: largest rotation error of a success, in degrees.
        translation_unit: largest translation error of a success, as a share of the centroid's distance from the camera.

    Raises:
        BaseError: for a negative weight, or a saturation or unit that is not positive.
    """

    starts: int = 2
    every: float = 0.15
    refined: float = 1.0
    saturation: float = 2.0
    weights: float = 0.5
    noise: float = 0.02
    rotation_unit: float = 1.0
    translation_unit: float = 0.005

    def __post_init__(self) -> None:
        super().__init__()
        check_whole(1, starts=self.starts)
        check_numbers(0.0, 1.0, every=self.every)
        check_numbers(0.0, refined=self.refined, weights=self.weights, noise=self.noise)
        check_positive(saturation=self.saturation, or_infinite=True)
        check_positive(rotation_unit=self.rotation_unit, translation_unit=self.translation_unit)

    @full_precision
    def forward(self, result: PnPResult, problems: Problems, ramp: float, guess: Starts) -> LossTerms:
        """See :meth:`PoseLoss.forward`. ``guess`` is from :meth:`~kornia_pnpnet.solver.PnPNet.with_starts`."""
        centre = _centre(problems)
        every = [pose_distances(pose, problems.pose, centre) for pose in guess.poses[: self.starts]]
        rotation, translation = problems.pose
        distance = lengths((rotation @ centre[..., None])[..., 0] + translation)
        rotations, translations = (torch.stack(x, -1) for x in zip(*every, strict=True))  # (B, S) each
        translations = translations / distance[..., None]
        sums = rotations + translations
        best = sums.argmin(-1, keepdim=True)
        init_rotation, init_translation, least = (x.gather(-1, best)[..., 0] for x in (rotations, translations, sums))
        first = (1.0 - self.every) * least + self.every * sums.mean(-1)

        pose = result.pose if ramp > 0.0 else map_tensors(Tensor.detach, result.pose)
        rotation, translation = pose_distances(pose, problems.pose, centre)
        translation = translation / distance
        chordal_unit = 2.0**0.5 * math.radians(self.rotation_unit)
        refined = rotation / chordal_unit + translation / self.translation_unit
        refined = refined / (1.0 + refined / self.saturation)
        probability = torch.where(problems.inliers, guess.weights, 1.0 - guess.weights)
        entropy = -probability.clamp(min=_LEAST_PROBABILITY).log().mean(-1)
        noise = torch.zeros_like(first) if guess.noise is None else _negative_log_likelihood(guess.noise, problems)
        total = first + ramp * self.refined * refined + self.weights * entropy + self.noise * noise
        terms = LossTerms(total, init_rotation, init_translation, rotation, translation, entropy, noise)
        return map_tensors(torch.mean, terms)


def _negative_log_likelihood(noise: Noise, problems: Problems) -> Tensor:
    """Mean negative log-likelihood of the inliers' residuals at the true pose, up to a constant, (B,)."""
    cam, img = problems.true_cam_points, problems.img_points
    used = problems.inliers & (cam.sum(-1) + img.sum(-1)).isfinite()
    cam = torch.where(used[..., None], cam, torch.eye(3, dtype=cam.dtype, device=cam.device)[2])
    img = torch.where(used[..., None], img, 0.0)
    cameras = problems.pair_intrinsics / problems.pair_intrinsics[..., 2:, 2:]
    seen = (cameras @ cam[..., None])[..., 0]  # Kornia's `project_points` ignores skew
    sq_residual = (convert_points_from_homogeneous(seen, eps=0.0) - img).square().sum(-1)
    moved = cameras.diagonal(dim1=-2, dim2=-1)[..., :2].abs().mean(-1) * noise.world / cam[..., 2]
    variance = noise.img.square() + moved.square() * (1.0 + 0.5 * (cam[..., :2] / cam[..., 2:]).square().sum(-1))
    loss = variance.log() + 0.5 * (sq_residual / variance).clamp(max=_MOST_VARIANCES)
    return torch.where(used, loss, 0.0).sum(-1) / used.sum(-1).clamp(min=1)
