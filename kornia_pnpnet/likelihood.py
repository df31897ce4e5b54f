"""A loss that trains points, pixels and their noise: the negative log-likelihood of the true pose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from kornia.core.exceptions import TypeCheckError, ValueCheckError
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor

from kornia_pnpnet.arguments import checked_inputs
from kornia_pnpnet.core.checks import check_form, check_positive, check_whole
from kornia_pnpnet.core.performance import full_precision
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.frame import Normalize
from kornia_pnpnet.problem import Inputs, Problem, Starts, State
from kornia_pnpnet.refine.lm import RobustWeightedLM
from kornia_pnpnet.refine.residual import covariance_at, information, normal_equations, project, retract, tangent
from kornia_pnpnet.result import Pose

__all__ = ["monte_carlo_pose_loss"]

# Degrees of freedom of the t distributions. The heavy tails prevent very large importance weights.
_FREEDOM = 3.0
# Scale of the translation's prior, divided by the distance between camera and points.
_PRIOR_TRANSLATION = 0.5
# Largest rotational scale of a t distribution, in radians. Tangent vectors approximate larger rotations badly.
_WIDEST_ROTATION = 1.0
# Iterations and damping of the refinement that finds a mode.
_MODE_ITERATIONS, _MODE_DAMPING = 4, 1e-3
# Least depth of a point, divided by the points' distance from the camera. Smaller depths are raised and penalised.
_LEAST_DEPTH = 0.02


@full_precision
def monte_carlo_pose_loss(
    truth: Pose,
    hypotheses: Pose | Sequence[Pose],
    world_points: Tensor,
    img_points: Tensor,
    intrinsics: Tensor | PinholeCamera,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    img_sigma: Tensor | float | None = None,
    world_sigma: Tensor | float | None = None,
    img_cov: Tensor | None = None,
    world_cov: Tensor | None = None,
    samples: int = 96,
    rounds: int = 2,
    kernel: str = "huber",
    scale: float = 3.0,
) -> Tensor:
    r"""Negative log-likelihood of the true pose under the distribution of poses that the correspondences define.

    The likelihood compares the true pose with all other poses. The loss has useful gradients already at the start of a
    training, when no pose fits the correspondences. The density of a pose :math:`y` is
    :math:`p(y) = \exp(-c(y))\,p_0(y) / Z`. The cost :math:`c` is half the weighted sum of the pairs' robust losses.
    Residuals are in standard deviations. If world points have noise, the cost includes the logarithm of each pixel's
    variance. In the prior :math:`p_0`, rotations are uniform, and the centroid of the points, in the camera's axes, has
    a t distribution around its true place. The scale of this t distribution is half the distance between camera and
    points. Importance sampling estimates the constant :math:`Z`.

    The same number of samples is drawn from each component of a mixture. The components are the prior and several t
    distributions: one around the true pose, one around each hypothesis, and one around each of ``rounds`` modes. A mode
    is found by refining the sample with the largest importance weight so far. The precision of a t distribution is the
    matrix of the normal equations at its centre. Gradients flow to all inputs except poses. A problem that a solver
    would refuse, or with an unknown (NaN) sigma, has the loss 0 and no gradient.

    Source: H. Chen et al., "EPro-PnP: Generalized End-to-End Probabilistic Perspective-n-Points", CVPR 2022, equations
    4 to 7. This function adds hypotheses and a prior, and uses modes in place of fitted proposals.

    Args:
        truth: true world-to-camera poses, rotation :math:`(B, 3, 3)` and translation :math:`(B, 3)`.
        hypotheses: further poses around which samples are drawn, such as the ``pose`` of a result.
        world_points: see :meth:`PnPNet.forward <kornia_pnpnet.solver.PnPNet.forward>`, also for dimensions and dtypes.
        img_points: pixels; see ``PnPNet.forward``.
        intrinsics: see ``PnPNet.forward``.
        weights: see ``PnPNet.forward``.
        mask: see ``PnPNet.forward``.
        img_sigma: see ``PnPNet.forward``; required if ``img_cov`` is ``None``. The loss can train ``img_sigma``.
        world_sigma: see ``PnPNet.forward``. If ``world_sigma`` and ``world_cov`` are ``None``, world points are exact.
        img_cov: see ``PnPNet.forward``.
        world_cov: see ``PnPNet.forward``.
        samples: number of poses drawn per problem, rounded down to a multiple of the number of components.
        rounds: number of t distributions around modes.
        kernel: name of the robust kernel, a key of :data:`~kornia_pnpnet.refine.kernels.KERNELS`.
        scale: scale of the kernel in standard deviations; for the kernel ``"power"``, the exponent. ``KERNELS`` has
            its range.

    Returns:
        The loss of each problem in nats, shape :math:`(B,)`. The density is per radian³ and world unit³.

    Raises:
        BaseError: see ``PnPNet.forward``; also for an unknown kernel, a scale out of range, fewer samples than
            components, or missing noise of the pixels.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> p = SyntheticProblems(n=20, batch_size=2, seed=0).batch(0)
        >>> pixels = torch.randn_like(p.img_points).requires_grad_()  # of an untrained network
        >>> loss = monte_carlo_pose_loss(p.pose, p.pose, p.world_points, pixels, p.intrinsics, img_sigma=100.0)
        >>> loss.mean().backward()
        >>> loss.shape, bool(pixels.grad.isfinite().all()), bool((pixels.grad != 0).any())
        (torch.Size([2]), True, True)
    """
    if not isinstance(hypotheses, Sequence):
        raise TypeCheckError(f"hypotheses must be a Pose or a sequence of poses, got {type(hypotheses).__name__}.")
    others = [hypotheses] if isinstance(hypotheses, Pose) else list(hypotheses)
    count = len(others) + 2 + rounds
    check_whole(0, rounds=rounds)
    check_whole(count, samples=samples)
    check_positive(scale=scale)
    if img_sigma is None and img_cov is None:
        raise ValueCheckError("monte_carlo_pose_loss needs the noise of the pixels: img_sigma or img_cov.")
    noisy_points = world_sigma is not None or world_cov is not None

    def check(points: Tensor) -> list[tuple[torch.Size, Inputs]]:
        return [
            checked_inputs(
                *(points, img_points, intrinsics, weights, mask, pose),
                img_sigma=img_sigma,
                world_sigma=world_sigma if noisy_points else 0.0,
                img_cov=img_cov,
                world_cov=world_cov,
                init_name=name,
            )
            for name, pose in (("truth", truth), *(("hypotheses", pose) for pose in others))
        ]

    checked = check(world_points)
    check_form(["*", "N", "2"], img_points=img_points)  # no bearings
    if len({x.world_points.dtype for _, x in checked}) > 1:  # only some poses are in float64
        checked = check(world_points.double())
    size, inputs = checked[0]
    noise = inputs.noise
    assert noise is not None
    sound = noise.img.isfinite() & (noise.img >= 0) & noise.world.isfinite()
    padding = torch.stack([x == 0 for x in (torch.ones_like(noise.img), *inputs[3:5]) if x is not None]).any(0)
    known = (sound | padding).all(1)
    img, world = (torch.where(known[:, None] & sound, x, 1.0) for x in noise[:2])
    with torch.no_grad():  # a gradient of the frame would only add noise to the integral's gradient
        _, frame = Normalize(order=False)(*inputs[:5], noise._replace(img=img, world=world))
        started = [frame.start(map_tensors(lambda y: y.to(frame.size), x.init)) for _, x in checked]
        first, usable = started[0]
        live = known & first.translation.any(-1) & usable
    unit = frame.size[:, None]
    world_noise = None if noise.world_cov is None else noise.world_cov.divided(unit)
    noise = noise._replace(img=img, world=world / unit, world_cov=world_noise)
    points = (inputs.world_points - frame.centroid[:, None]) / unit[..., None]
    problem, _ = Normalize(center=False, scale=False, order=False)(points, *inputs[1:5], noise)
    assert problem.noise is not None
    # The noise of padding is NaN, and becomes 1.
    noise = map_tensors(lambda x: x.nan_to_num(1.0), problem.noise).bounded(problem.focal)
    problem = problem._replace(noise=noise)

    axis = points.new_tensor([0.0, 0.0, 1.0])  # a refused problem gets a constant translation
    poses = []
    for pose, ok in started:  # the truth replaces hypotheses that are no poses
        rotation = torch.where(ok[:, None, None], pose.rotation, first.rotation)
        translation = torch.where(ok[:, None], pose.translation, first.translation)
        poses.append(Pose(rotation, torch.where(live[:, None], translation, axis)))
    with points.device:
        refine = RobustWeightedLM(
            _MODE_ITERATIONS,
            kernel=kernel,
            robustness=scale,
            damping=_MODE_DAMPING,
            reject_worse=False,
            learnable=False,
        )
    model = _Posterior(problem, _Prior(poses[0].translation), refine, points.new_tensor(scale), noisy_points)
    with torch.no_grad():
        drawn, log_proposal = _draw(model._replace(problem=problem.map(Tensor.detach)), poses, samples // count, rounds)
    log_densities = model.log_density(map_tensors(lambda x, y: torch.cat((x[None], y)), poses[0], drawn))
    log_total = torch.logsumexp(log_densities[1:] - log_proposal, 0) - math.log(len(log_proposal))
    log_density = log_densities[0] - log_total
    return torch.where(live, -log_density + 3.0 * frame.size.log(), 0.0).reshape(size)


class _Prior(NamedTuple):
    """The prior of poses: uniform rotations, and a t distribution around the true ``translation``, (B, 3)."""

    translation: Tensor

    @property
    def distance(self) -> Tensor:
        """Distance between the true camera and the points, (B, 1)."""
        return self.translation.norm(dim=-1, keepdim=True)

    def sample(self, count: int) -> Pose:
        """Draw ``count`` poses for each problem, (S, B, ...)."""
        random = self.translation.new_empty(count, len(self.translation), 4).normal_()
        rotation = quaternion_to_rotation_matrix(random)
        shift = _PRIOR_TRANSLATION * self.distance * _sample_t(count, self.translation)
        return Pose(rotation, self.translation + shift)

    def log_density(self, poses: Pose) -> Tensor:
        """Logarithm of the density per radian³ and unit³, (S, B). The density does not depend on the rotation."""
        width = _PRIOR_TRANSLATION * self.distance
        sq_distance = ((poses.translation - self.translation) / width).square().sum(-1)
        return _log_t(sq_distance, 3) - 3.0 * width.log().mT - math.log(8.0 * math.pi**2)


class _Component(NamedTuple):
    """A t distribution around a pose, with the Cholesky ``factor`` (B, 6, 6) of its precision matrix."""

    pose: Pose
    factor: Tensor

    def sample(self, count: int) -> Pose:
        vectors = _sample_t(count, self.factor[..., 0])  # (S, B, 6)
        tangents = torch.linalg.solve_triangular(self.factor.mT, vectors.permute(1, 2, 0), upper=True).permute(2, 0, 1)
        origin = map_tensors(lambda x: x.expand(count, *x.shape).flatten(0, 1), self.pose)
        return map_tensors(lambda x: x.unflatten(0, (count, -1)), retract(origin, tangents.flatten(0, 1)))

    def log_density(self, poses: Pose) -> Tensor:
        omega = tangent(poses.rotation @ self.pose.rotation.mT)
        vector = torch.cat((omega, poses.translation - self.pose.translation), -1)
        sq_distance = (vector[..., None, :] @ self.factor)[..., 0, :].square().sum(-1)
        log_determinant = self.factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        # Cayley's map from tangent vectors to rotations multiplies volumes by 1 / (1 + |omega|² / 4)².
        return _log_t(sq_distance, 6) + log_determinant + 2.0 * torch.log1p(0.25 * omega.square().sum(-1))


class _Posterior(NamedTuple):
    """The density of poses up to a constant factor, in the frame of a problem."""

    problem: Problem  # with known noise
    prior: _Prior
    refine: RobustWeightedLM  # finds modes; its robust kernel is also the kernel of the density
    shape: Tensor  # the kernel's scale or exponent, a scalar
    noisy_points: bool  # whether world points have noise; if so, the variance of a pixel depends on the pose

    def log_density(self, poses: Pose) -> Tensor:
        """Logarithm of the product of likelihood and prior, (S, B), for poses (S, B, 3, 3) and (S, B, 3)."""
        problem, noise, distance = self.problem, self.problem.noise, self.prior.distance
        assert noise is not None
        cam = problem.world_points @ poses.rotation.mT + poses.translation[..., None, :]  # (S, B, N, 3)
        least = _LEAST_DEPTH * distance
        depth = cam[..., 2].maximum(least)
        plane = cam[..., :2] / depth[..., None]
        sq_behind = (problem.focal * (depth - cam[..., 2]) / least).square()
        residual = problem.focal * plane - problem.img_points
        if noise.covariances:
            p, q = plane.unbind(-1)
            covariance = covariance_at(poses.rotation[..., None, :, :], p, q, problem.focal / depth, noise)
            determinant, precision = covariance.determinant, covariance.inverse()
            sq_residual = precision.form(*residual.unbind(-1)) + 0.5 * sq_behind * (precision.uu + precision.vv)
        else:
            variance = noise.img.square()
            if self.noisy_points:
                sides = 1.0 + 0.5 * plane.square().sum(-1)
                variance = variance + (problem.focal * noise.world / depth).square() * sides
            sq_residual, determinant = (residual.square().sum(-1) + sq_behind) / variance, variance.square()
        loss = self.refine.kernel.loss(sq_residual, self.shape)
        if self.noisy_points:
            loss = loss + determinant.log()
        return self.prior.log_density(poses) - 0.5 * (problem.weights * loss).sum(-1)

    def component(self, pose: Pose) -> _Component:
        """Make the t distribution around a pose from the normal equations, and bound its width."""
        problem, projection = self.problem, project(State.of(pose), self.problem)
        sq_residual, precision = information(projection, problem)
        factor = problem.focal.square() * problem.weights * self.refine.kernel.weight(sq_residual, self.shape)
        weights = map_tensors(lambda x: factor * x, precision)
        matrix = normal_equations(projection, problem, weights).matrix.permute(2, 0, 1)
        widest = torch.full_like(pose.translation, _WIDEST_ROTATION)
        widest = torch.cat((widest, (_PRIOR_TRANSLATION * self.prior.distance).expand(-1, 3)), -1)
        matrix = matrix + torch.diag_embed(widest.square().reciprocal())
        # The matrix is scaled to a unit diagonal, so that rounding does not depend on units.
        scale = matrix.diagonal(dim1=-2, dim2=-1).rsqrt()
        eye = torch.eye(6, dtype=scale.dtype, device=scale.device)
        scaled = matrix * scale[..., None] * scale[..., None, :] + 10.0 * torch.finfo(scale.dtype).eps * eye
        return _Component(pose, torch.linalg.cholesky_ex(scaled)[0] / scale[..., None])

    def mode(self, poses: Pose, log_weights: Tensor) -> Pose:
        """Find a mode by refining the pose that has the largest importance weight."""
        best = log_weights.argmax(0)
        pose = map_tensors(lambda x: x[best, torch.arange(len(best), device=best.device)], poses)
        starts = Starts(pose, torch.ones_like(self.problem.weights))
        return self.refine.iterate(self.refine.begin(self.problem, starts))[1].state.pose


def _draw(model: _Posterior, poses: Sequence[Pose], each: int, rounds: int) -> tuple[Pose, Tensor]:
    """Draw samples from the mixture, and compute the mixture's log-density at each sample, (S, B)."""
    mixture: list[_Prior | _Component] = [model.prior, *map(model.component, poses)]
    drawn = map_tensors(lambda *x: torch.cat(x), *[part.sample(each) for part in mixture])

    def log_mixture() -> Tensor:
        densities = torch.stack([part.log_density(drawn) for part in mixture])
        return torch.logsumexp(densities, 0) - math.log(len(mixture))

    for _ in range(rounds):
        mixture.append(model.component(model.mode(drawn, model.log_density(drawn) - log_mixture())))
        drawn = map_tensors(lambda *x: torch.cat(x), drawn, mixture[-1].sample(each))
    return drawn, log_mixture()


def _sample_t(count: int, like: Tensor) -> Tensor:
    """Draw ``count`` vectors from the standard t distribution for each row of ``like``."""
    normal = torch.randn(count, *like.shape, dtype=like.dtype, device=like.device)
    freedom = torch.full((count, *like.shape[:-1], 1), 0.5 * _FREEDOM, dtype=like.dtype, device=like.device)
    return normal * (0.5 * _FREEDOM / torch._standard_gamma(freedom)).sqrt()


def _log_t(sq_distance: Tensor, size: int) -> Tensor:
    """Log-density of the ``size``-dimensional standard t distribution at vectors of squared length ``sq_distance``."""
    both = 0.5 * (_FREEDOM + size)
    constant = math.lgamma(both) - math.lgamma(0.5 * _FREEDOM) - 0.5 * size * math.log(_FREEDOM * math.pi)
    return constant - both * torch.log1p(sq_distance / _FREEDOM)
