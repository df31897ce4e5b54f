"""Distances between poses that can be trained with, and the paper's loss over both stages."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from kornia_pnpnet.core.checks import check_numbers, check_poses, check_positive, check_whole
from kornia_pnpnet.geometry import transform
from kornia_pnpnet.types import Guess, Noise, PnPResult, Pose, Problems

__all__ = ["LossTerms", "PoseLoss", "SetLoss", "pose_distances"]

# Probabilities this close to 0 and 1 are no surer: a pair that is wrong about them costs no more than it teaches.
_LEAST_CHANCE = 1e-3
# Squared residuals beyond this many variances are no noise.
_MOST_VARIANCES = 20.0


class LossTerms(NamedTuple):
    """The loss and what it weighs, each a scalar and a mean over the batch.

    Attributes:
        total: the weighted sum, saturated per problem.
        init_rotation: chordal rotation distance of the first guess.
        init_translation: translation distance of the first guess at the centroid of the points.
        refined_rotation: chordal rotation distance after refinement.
        refined_translation: translation distance after refinement.
        weights: cross entropy of the weights as probabilities of being right; 0 where no loss looks at it.
        noise: likelihood of the right pairs under the estimated noise; likewise.
    """

    total: Tensor
    init_rotation: Tensor
    init_translation: Tensor
    refined_rotation: Tensor
    refined_translation: Tensor
    weights: Tensor
    noise: Tensor


def pose_distances(estimate: Pose, truth: Pose) -> tuple[Tensor, Tensor]:
    r"""Distances whose gradient is bounded everywhere, also at 0.

    Args:
        estimate: rotation :math:`(B, 3, 3)` and translation :math:`(B, 3)`.
        truth: the same shapes.

    Returns:
        :math:`\|\hat R - R\|_F = 2\sqrt2 \sin(\theta / 2)` and :math:`\|\hat t - t\|`, each :math:`(B,)`.

    Raises:
        ShapeError: when the shapes are others, or differ.
        TypeCheckError: when the dtypes differ.
        DeviceError: when the devices differ.

    Example:
        >>> eye = Pose(torch.eye(3)[None], torch.zeros(1, 3))
        >>> turned = Pose(torch.tensor([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]]), torch.tensor([[3.0, 4, 0]]))
        >>> pose_distances(turned, eye)
        (tensor([2.]), tensor([5.]))
    """
    check_poses(estimate, truth)
    return _lengths(_difference(estimate, truth))


def _difference(estimate: Pose, truth: Pose) -> Pose:
    """The estimate minus the truth, entry by entry."""
    return Pose(estimate.rotation - truth.rotation, estimate.translation - truth.translation)


def _lengths(difference: Pose) -> tuple[Tensor, Tensor]:
    """Frobenius and Euclidean norm of the parts, each (B,)."""
    tiny = torch.finfo(difference.rotation.dtype).tiny
    rotation = (difference.rotation.square().sum((-2, -1)) + tiny).sqrt()
    translation = (difference.translation.square().sum(-1) + tiny).sqrt()
    return rotation, translation


def _at(points: Tensor, difference: Pose) -> Pose:
    """The difference of the same poses for a world whose origin is at ``points``, (B, 3)."""
    turned = (difference.rotation * points[:, None]).sum(-1)
    return Pose(difference.rotation, difference.translation + turned)


class PoseLoss(nn.Module):
    r"""Weighted sum of four distances: rotation and translation, after the first stage and after the refinement.

    After the refinement the translation is compared as it is scored. The first stage's is compared at the centroid of
    the world points: at the world's origin, which may be far from them, it would mostly repeat the rotation error.

    A refinement that fails is off by any amount; so that such problems do not drown the others, the refined distance
    :math:`d` of a problem may be saturated to :math:`d / (1 + d / c)`. With :math:`c` near the limit of success the
    loss follows the success rate.

    Args:
        rotation: weight of the chordal rotation distances.
        translation: weight of the refined translation distance, per unit of length.
        init_translation: weight of the first stage's translation distance, per unit of length.
        refined: weight of the refined terms against the first stage's, before the ramp.
        saturation: :math:`c`; ``None`` does not saturate.

    Raises:
        BaseError: for a negative weight, or a saturation that is not positive.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> problems = SyntheticProblems(batch_size=1, seed=0).batch(0)
        >>> result = PnPResult(*problems.pose, torch.ones(1, 9), torch.zeros(1), torch.tensor([True]), problems.pose)
        >>> PoseLoss()(result, problems).total.item() < 1e-6
        True
    """

    def __init__(
        self,
        *,
        rotation: float = 1.0,
        translation: float = 0.1,
        init_translation: float = 0.02,
        refined: float = 1.0,
        saturation: float | None = None,
    ) -> None:
        super().__init__()
        check_numbers(
            0.0, rotation=rotation, translation=translation, init_translation=init_translation, refined=refined
        )
        if saturation is not None:
            check_positive(saturation=saturation, or_infinite=True)
        self.rotation = rotation
        self.translation = translation
        self.init_translation = init_translation
        self.refined = refined
        self.saturation = saturation

    def forward(self, result: PnPResult, problems: Problems, ramp: float = 1.0) -> LossTerms:
        r"""Compare a solver's result with the truth.

        Args:
            result: of :math:`B` problems.
            problems: what was solved, with the true poses.
            ramp: factor of the refined terms, 0 at the start of the training. Then no gradient goes through them.

        Returns:
            The loss and its terms, means over the batch.

        Raises:
            BaseError: when result and truth differ in shape, dtype or device.
        """
        for pose in (result.pose, result.init):
            check_poses(pose, problems.pose)
        centroid = problems.world_points.mean(1)
        init_rotation, init_translation = _lengths(_at(centroid, _difference(result.init, problems.pose)))
        with torch.set_grad_enabled(torch.is_grad_enabled() and ramp > 0.0):
            rotation, translation = _lengths(_difference(result.pose, problems.pose))
        init = self.rotation * init_rotation + self.init_translation * init_translation
        refined = self.rotation * rotation + self.translation * translation
        if self.saturation is not None:
            refined = refined / (1.0 + refined / self.saturation)
        total = init + ramp * self.refined * refined
        none = torch.zeros_like(total)
        terms = (total, init_rotation, init_translation, rotation, translation, none, none)
        return LossTerms(*(term.mean() for term in terms))


class SetLoss(nn.Module):
    r"""What a set network learns from: the pose before and after the refinement, right and wrong pairs, and noise.

    Nothing in it has a unit: translations are compared at the centroid of the points, as a share of its distance.

    - Of the hypotheses of a first guess the best one counts, and a little all of them, so that they may differ.
    - After the refinement, both errors in units of what counts as success, saturated as in :class:`PoseLoss`.
    - Binary cross entropy of the network's weights.
    - The negative log-likelihood of the right pairs' residuals at the true pose under the estimated noise.

    Args:
        starts: the first so many hypotheses are the network's, and count.
        every: weight of the mean over the hypotheses against the best of them.
        refined: weight of the terms after the refinement, before the ramp.
        saturation: of these, in units of success.
        weights: weight of the cross entropy.
        noise: weight of the likelihood.
        rotation_unit: what counts as success, in degrees.
        translation_unit: likewise, as a share of the distance.

    Raises:
        BaseError: for a negative weight, or a saturation or unit that is not positive.
    """

    def __init__(
        self,
        *,
        starts: int = 2,
        every: float = 0.15,
        refined: float = 1.0,
        saturation: float = 2.0,
        weights: float = 0.5,
        noise: float = 0.02,
        rotation_unit: float = 1.0,
        translation_unit: float = 0.005,
    ) -> None:
        super().__init__()
        check_whole(1, starts=starts)
        check_numbers(0.0, 1.0, every=every)
        check_numbers(0.0, refined=refined, weights=weights, noise=noise)
        check_positive(saturation=saturation, or_infinite=True)
        check_positive(rotation_unit=rotation_unit, translation_unit=translation_unit)
        self.starts = starts
        self.every = every
        self.refined = refined
        self.saturation = saturation
        self.weights = weights
        self.noise = noise
        self.rotation_unit = 2.0**0.5 * math.radians(rotation_unit)  # as a chordal distance
        self.translation_unit = translation_unit

    def forward(self, result: PnPResult, problems: Problems, ramp: float, guess: Guess) -> LossTerms:
        """Compare a solver's result with the truth.

        Args:
            result: of :math:`B` problems.
            problems: what was solved, with the true poses.
            ramp: factor of the refined terms, 0 at the start of the training. Then no gradient goes through them.
            guess: what the result was refined from, see :meth:`~kornia_pnpnet.solver.PnPNet.with_guess`.

        Returns:
            The loss and its terms, means over the batch.

        Raises:
            BaseError: when result and truth differ in shape, dtype or device.
        """
        for pose in (result.pose, result.init):
            check_poses(pose, problems.pose)
        hypotheses = [x[:, None] for x in guess.pose]
        if guess.others is not None:
            hypotheses = [torch.cat(x, 1)[:, : self.starts] for x in zip(hypotheses, guess.others, strict=True)]
        starts = hypotheses[0].shape[1]
        centre = problems.world_points.mean(1)
        away = (problems.pose.rotation @ centre[..., None])[..., 0] + problems.pose.translation
        distance = away.norm(dim=-1)

        truth = Pose(*(x.repeat_interleave(starts, 0) for x in problems.pose))
        flat = Pose(*(x.flatten(0, 1) for x in hypotheses))
        lengths = _lengths(_at(centre.repeat_interleave(starts, 0), _difference(flat, truth)))
        rotations, translations = (x.view(-1, starts) for x in lengths)
        translations = translations / distance[:, None]
        each = rotations + translations
        best = each.argmin(1, keepdim=True)
        first = (1.0 - self.every) * each.gather(1, best)[:, 0] + self.every * each.mean(1)

        with torch.set_grad_enabled(torch.is_grad_enabled() and ramp > 0.0):
            rotation, translation = _lengths(_at(centre, _difference(result.pose, problems.pose)))
            translation = translation / distance
            refined = rotation / self.rotation_unit + translation / self.translation_unit
            refined = refined / (1.0 + refined / self.saturation)
        entropy = _cross_entropy(guess.weights, problems.inliers)
        likelihood = torch.zeros_like(first) if guess.noise is None else _surprise(guess.noise, problems)
        total = first + ramp * self.refined * refined + self.weights * entropy + self.noise * likelihood
        init = (x.gather(1, best)[:, 0] for x in (rotations, translations))
        terms = (total, *init, rotation, translation, entropy, likelihood)
        return LossTerms(*(term.mean() for term in terms))


def _cross_entropy(weights: Tensor, inliers: Tensor) -> Tensor:
    """Mean binary cross entropy of each problem, (B,)."""
    right = torch.where(inliers, weights, 1.0 - weights)
    return -right.clamp(min=_LEAST_CHANCE).log().mean(-1)


def _surprise(noise: Noise, problems: Problems) -> Tensor:
    """Negative log-likelihood of the right pairs' residuals at the true pose, up to a constant, mean of each, (B,)."""
    cam = transform(problems.pose, problems.world_points)
    z = torch.where(problems.inliers, cam[..., 2], 1.0)
    focal = problems.intrinsics.diagonal(dim1=1, dim2=2)[:, None, :2]
    centre = problems.intrinsics[:, None, :2, 2]
    plane = cam[..., :2] / z[..., None]
    sq_residual = (focal * plane + centre - problems.img_points).square().sum(-1)
    moved = focal.mean(-1) * noise.world / z
    variance = noise.img.square() + moved.square() * (1.0 + 0.5 * plane.square().sum(-1))
    surprise = variance.log() + 0.5 * (sq_residual / variance).clamp(max=_MOST_VARIANCES)
    return torch.where(problems.inliers, surprise, 0.0).sum(-1) / problems.inliers.sum(-1).clamp(min=1)
