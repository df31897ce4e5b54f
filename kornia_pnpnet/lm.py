r"""Robust weighted Levenberg-Marquardt with a fixed number of iterations and learned hyperparameters.

:func:`lm_step` is one iteration as a pure function; :class:`RobustWeightedLM` owns the parameters and the loop.
Source: R. Sheffer and A. Wiesel, "PnP-Net: A hybrid Perspective-n-Point Network", 2020, section 3; the
damping by the diagonal is Marquardt's (1963).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor, nn

from kornia_pnpnet.geometry import (
    Projection,
    additive_tangent_map,
    linearize,
    project,
    retract,
    retract_additive,
)
from kornia_pnpnet.robust import KERNELS, RobustKernel
from kornia_pnpnet.types import Correspondences, Guess, Pose, Refinement

__all__ = ["BoundedParameter", "LMStep", "RobustWeightedLM", "explains", "lm_step", "solve_damped"]

# Residuals count up to this many focal lengths in the cost, and a point behind the camera counts as much: it can
# never be cheaper than a point in front of it.
_MAX_RESIDUAL = 2.0
# A pose explains the pixels when this share of the pairs has residuals below this share of the pixels' spread.
_EXPLAINED_SHARE, _EXPLAINED_RESIDUAL = 0.6, 0.2
# Factors of the damping after a refused and after an accepted step (only with `reject_worse`).
_DAMPING_UP, _DAMPING_DOWN = 10.0, 0.3


class LMStep(NamedTuple):
    r"""What one iteration returns.

    Attributes:
        pose: the pose after the step.
        solved: whether the damped normal equations could be solved (else the step is zero), bool, :math:`(B,)`.
    """

    pose: Pose
    solved: Tensor


def solve_damped(hessian: Tensor, gradient: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    r"""Solve :math:`(H + \lambda\,\mathrm{diag}(H))\,\delta = g` for a batch of positive semi-definite :math:`H`.

    An LDLᵀ factorisation written out in plain operations, so that it compiles, exports and differentiates like the
    rest. :math:`H` is first scaled to a unit diagonal, which makes the test on the pivots independent of units.

    Args:
        hessian: :math:`(B, D, D)`.
        gradient: :math:`(B, D)`.
        damping: :math:`\lambda \ge 0`, a scalar or :math:`(B,)`.

    Returns:
        The solution :math:`(B, D)` and whether there is one, bool :math:`(B,)`. Where a pivot vanishes the solution
        is zero with zero gradients.

    Example:
        >>> solve_damped(torch.eye(2)[None] * 4.0, torch.tensor([[8.0, 4.0]]), torch.tensor(1.0))
        (tensor([[1.0000, 0.5000]]), tensor([True]))
    """
    diagonal = hessian.diagonal(dim1=-2, dim2=-1)  # (B, D)
    dim = diagonal.shape[-1]
    used = diagonal > torch.finfo(hessian.dtype).tiny
    scale = torch.where(used, torch.where(used, diagonal, 1.0).rsqrt(), 0.0)
    damped_diagonal = (1.0 + damping)[..., None] if damping.ndim else 1.0 + damping
    eye = torch.eye(dim, dtype=hessian.dtype, device=hessian.device)
    schur = hessian * scale[:, :, None] * scale[:, None, :]
    schur = schur * (1.0 - eye) + torch.diag_embed(used.to(schur.dtype) * damped_diagonal)  # (B, D, D)
    rest = gradient * scale
    tolerance = 10.0 * torch.finfo(hessian.dtype).eps

    solved = torch.ones_like(used[:, 0])
    pivots, columns, partial = [], [], []
    for k in range(dim):
        pivot = schur[:, 0, 0]
        good = pivot > tolerance
        solved = solved & good
        pivot = torch.where(good, pivot, 1.0)
        pivots.append(pivot)
        partial.append(rest[:, 0])
        if k < dim - 1:
            column = schur[:, 1:, 0] / pivot[:, None]  # (B, D - k - 1)
            columns.append(column)
            rest = rest[:, 1:] - column * rest[:, :1]
            schur = schur[:, 1:, 1:] - column[:, :, None] * schur[:, None, 0, 1:]
    solution = (partial[-1] / pivots[-1])[:, None]
    for k in range(dim - 2, -1, -1):
        entry = partial[k] / pivots[k] - (columns[k] * solution).sum(-1)
        solution = torch.cat((entry[:, None], solution), 1)
    return torch.where(solved[:, None], solution * scale, 0.0), solved


def lm_step(
    corr: Correspondences,
    pose: Pose,
    projection: Projection,
    weights: Tensor,
    step: Tensor,
    damping: Tensor,
    *,
    additive: bool = False,
) -> LMStep:
    r"""One damped Gauss-Newton step, :math:`\beta \leftarrow \beta - \gamma\,(J^\top W J + \lambda D)^{-1} J^\top W r`.

    Here :math:`D = \mathrm{diag}(J^\top W J)` and :math:`r` is projection minus measurement, so that the step that
    reduces it is the negative one.

    Args:
        corr: normalised correspondences.
        pose: the pose to improve.
        projection: :func:`~kornia_pnpnet.geometry.project` of ``pose``.
        weights: weight of each pair, :math:`(B, N)`; points behind the camera do not count whatever it is.
        step: :math:`\gamma`, a scalar.
        damping: :math:`\lambda`, a scalar or :math:`(B,)`.
        additive: update the rotation vector additively as in the paper, instead of by the retraction.

    Returns:
        The moved pose and whether the equations could be solved.
    """
    linear = linearize(projection, corr.focal, additive_tangent_map(pose) if additive else None)
    used = torch.where(projection.in_front, weights, 0.0)
    # The step does not depend on a common factor of the weights; tiny weights must not vanish when multiplied.
    largest = used.detach().amax(-1, keepdim=True)
    used = used / torch.where(largest > 0, largest, 1.0)
    weighted = linear.jacobian * torch.cat((used, used), 1)[:, None]  # (B, 6, 2N)
    hessian = weighted @ linear.jacobian.mT
    # Not a product of matrices: for a batch of one that takes another kernel, which rounds differently.
    gradient = (weighted * linear.residual[:, None]).sum(-1)
    delta, solved = solve_damped(hessian, gradient, damping)
    update = retract_additive if additive else retract
    return LMStep(update(pose, -step * delta), solved)


class BoundedParameter(nn.Module):
    r"""Values that are learned without bounds and used within them.

    The parameter passes a sigmoid onto ``[lower, upper]``, in log space when ``logarithmic``.

    Args:
        initial: the first value of each entry, between the bounds. A value at a bound stays there.
        size: how many entries.
        lower: lower bound.
        upper: upper bound.
        logarithmic: interpolate the logarithm; the bounds must be positive.

    Raises:
        BaseError: when ``initial`` is not between the bounds.

    Example:
        >>> BoundedParameter(1e-3, size=2, lower=1e-6, upper=1.0, logarithmic=True)()
        tensor([0.0010, 0.0010], grad_fn=<ExpBackward0>)
    """

    def __init__(self, initial: float, *, size: int, lower: float, upper: float, logarithmic: bool = False) -> None:
        super().__init__()
        KORNIA_CHECK(lower <= initial <= upper, f"The initial value {initial} must lie between {lower} and {upper}.")
        self._logarithmic = logarithmic
        self._lower, self._upper = (math.log(lower), math.log(upper)) if logarithmic else (lower, upper)
        share = ((math.log(initial) if logarithmic else initial) - self._lower) / (self._upper - self._lower)
        self.raw = nn.Parameter(torch.full((size,), share).logit())

    def forward(self) -> Tensor:
        """Return the bounded values, shape ``(size,)``."""
        value = self._lower + (self._upper - self._lower) * torch.sigmoid(self.raw)
        return value.exp() if self._logarithmic else value


class RobustWeightedLM(nn.Module):
    r"""Refine poses by ``m`` unrolled iterations of robust weighted Levenberg-Marquardt.

    Each iteration weighs a pair by the robust weight of its residual at the previous estimate, times the weight that
    came with the correspondences, times the initialiser's, and takes one :func:`lm_step`. Step :math:`\gamma`,
    damping :math:`\lambda` and robustness (the shape of the kernel, :math:`\alpha` for ``power``) are learned, by
    default one set per iteration; at their initial values this is the classical method.

    All operations are per problem: a problem that cannot be solved keeps its pose, reports ``ok=False`` and changes
    no other.

    Args:
        m: number of iterations; 0 leaves the guess as it is and only judges it.
        kernel: name of the robust kernel, a key of :data:`~kornia_pnpnet.robust.KERNELS`.
        step: initial :math:`\gamma`, in [0, 2].
        damping: initial :math:`\lambda`, in [1e-8, 100].
        robustness: initial shape of the kernel, its classical value when ``None``. With 0, ``power`` is least squares.
        shared: learn one set for all iterations instead of one each.
        update: ``"retraction"`` on the rotation group, or the paper's ``"additive"`` on the rotation vector.
        reject_worse: refuse, per problem, a step that raises the cost, and raise the damping after it tenfold.
        learnable: whether the hyperparameters are trained.

    Raises:
        BaseError: for an unknown kernel or update, a negative ``m``, or an initial value out of its bounds.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> from kornia_pnpnet.metrics import pose_errors
        >>> from kornia_pnpnet.normalize import Normalize
        >>> problems = SyntheticProblems(n=9, batch_size=2, seed=0, world_sigma=0.0, img_sigma=0.0).batch(0)
        >>> normalize = Normalize(center=False, scale=False, order=False)
        >>> corr, frame = normalize(problems.world_points, problems.img_points, problems.intrinsics)
        >>> refined = RobustWeightedLM(m=5)(corr, Guess(problems.pose, torch.ones_like(corr.weights)))
        >>> refined.ok
        tensor([True, True])
    """

    def __init__(
        self,
        m: int = 5,
        *,
        kernel: str = "power",
        step: float = 1.0,
        damping: float = 1e-3,
        robustness: float | None = None,
        shared: bool = False,
        update: str = "retraction",
        reject_worse: bool = False,
        learnable: bool = True,
    ) -> None:
        super().__init__()
        KORNIA_CHECK(type(m) is int and m >= 0, f"m must be an integer of at least 0, got {m!r}.")
        KORNIA_CHECK(kernel in KERNELS, f"kernel must be one of {sorted(KERNELS)}, got {kernel!r}.")
        KORNIA_CHECK(update in ("retraction", "additive"), f"update must be retraction or additive, got {update!r}.")
        self.config: dict[str, Any] = {
            "m": m,
            "kernel": kernel,
            "step": step,
            "damping": damping,
            "robustness": robustness,
            "shared": shared,
            "update": update,
            "reject_worse": reject_worse,
            "learnable": learnable,
        }
        self.m = m
        self.kernel: RobustKernel = KERNELS[kernel]
        self.additive = update == "additive"
        self.reject_worse = reject_worse
        size = 1 if shared or m == 0 else m
        shape = self.kernel.default if robustness is None else robustness
        self.step = BoundedParameter(step, size=size, lower=0.0, upper=2.0)
        self.damping = BoundedParameter(damping, size=size, lower=1e-8, upper=1e2, logarithmic=True)
        self.robustness = BoundedParameter(
            shape,
            size=size,
            lower=self.kernel.lower,
            upper=self.kernel.upper,
            logarithmic=self.kernel.logarithmic,
        )
        self.requires_grad_(learnable and m > 0)

    def extra_repr(self) -> str:
        """Show the constructor's arguments."""
        return ", ".join(f"{key}={value!r}" for key, value in self.config.items())

    def hyperparameters(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        r"""Return :math:`\gamma`, :math:`\lambda` and the kernel's shape for each iteration.

        Args:
            like: a tensor of the dtype and device to return them in.

        Returns:
            Three tensors of shape :math:`(\max(m, 1),)`.
        """
        count = max(self.m, 1)
        step, damping, shape = (p().to(like).expand(count) for p in (self.step, self.damping, self.robustness))
        return step, damping, shape

    def _cost(self, projection: Projection, corr: Correspondences, weights: Tensor, shape: Tensor) -> Tensor:
        """Mean robust loss over the pairs that are there, shape (B,)."""
        most = (_MAX_RESIDUAL * corr.focal).square()
        sq_residual = projection.residual.square().sum(-1).minimum(most)
        sq_residual = torch.where(projection.in_front, sq_residual, most)  # (B, N)
        count = (corr.weights > 0).sum(-1).clamp(min=1)
        return (weights * self.kernel.loss(sq_residual, shape)).sum(-1) / count

    def _pair_weights(self, projection: Projection, prior: Tensor, shape: Tensor) -> Tensor:
        """Robust weight times prior weight, 0 behind the camera, shape (B, N)."""
        robust = self.kernel.weight(projection.residual.square().sum(-1), shape)
        return torch.where(projection.in_front, prior * robust, 0.0)

    def forward(self, corr: Correspondences, guess: Guess, *, m: int | None = None) -> Refinement:
        r"""Refine a guess.

        Args:
            corr: normalised correspondences of :math:`B` problems with :math:`N` pairs each.
            guess: poses in the frame of ``corr`` and a factor for the weight of each pair.
            m: stop after this many iterations; all of them when ``None``.

        Returns:
            The refined poses; the weights and the cost at them, with the shape of the last iteration; and ``ok``,
            which is true when the last iteration's equations could be solved and the pose explains the pixels better
            than a single point would (see :func:`explains`).
        """
        step, damping, shape = self.hyperparameters(corr.world_points)
        prior = corr.weights * guess.weights
        pose = guess.pose
        projection = project(pose, corr)
        solved = torch.ones_like(projection.in_front[:, 0])
        factor = torch.ones_like(corr.weights[:, 0])  # of the damping, per problem
        for i in range(self.m if m is None else min(m, self.m)):
            weights = self._pair_weights(projection, prior, shape[i])
            candidate, solved = lm_step(
                corr, pose, projection, weights, step[i], damping[i] * factor, additive=self.additive
            )
            candidate_projection = project(candidate, corr)
            if self.reject_worse:
                better = self._cost(candidate_projection, corr, prior, shape[i]) <= self._cost(
                    projection, corr, prior, shape[i]
                )
                factor = torch.where(better, factor * _DAMPING_DOWN, factor * _DAMPING_UP)
                candidate = Pose(*_chosen(better, candidate, pose))
                candidate_projection = Projection(*_chosen(better, candidate_projection, projection))
            pose, projection = candidate, candidate_projection
        weights = self._pair_weights(projection, prior, shape[-1])
        cost = self._cost(projection, corr, prior, shape[-1])
        return Refinement(pose, weights, cost, solved & explains(projection, corr, prior))


def _chosen(first: Tensor, a: Iterable[Tensor], b: Iterable[Tensor]) -> Iterator[Tensor]:
    """For each pair of tensors, ``a`` for the problems where ``first`` holds, else ``b``."""
    return (torch.where(first.view(-1, *(1,) * (x.ndim - 1)), x, y) for x, y in zip(a, b, strict=True))


def explains(projection: Projection, corr: Correspondences, prior: Tensor) -> Tensor:
    r"""Tell whether a pose explains the pixels at all.

    It does when at least three pairs are in front of the camera, and when the residual that 60 % of the pairs (by
    prior weight) stay below is less than a fifth of the distance from their mean that 60 % of the pixels stay below: a
    pose that is hardly better than "everything is at one point" is not an answer. Both sides scale with the image, so
    there is no threshold in pixels. The numbers are a compromise: points behind the camera leave a larger residual
    all but always, small objects with a tenth of their size as noise a smaller one.

    Args:
        projection: :func:`~kornia_pnpnet.geometry.project` of the pose.
        corr: the correspondences.
        prior: weight of each pair before its residual was looked at, :math:`(B, N)`.

    Returns:
        bool of shape :math:`(B,)`.
    """
    prior = prior.detach()
    there = prior > 0
    share = prior / prior.sum(-1, keepdim=True).clamp(min=torch.finfo(prior.dtype).tiny)  # (B, N)
    pixels = corr.img_points.detach()
    spread = (pixels - (share[..., None] * pixels).sum(1, keepdim=True)).square().sum(-1)
    residual = torch.where(projection.in_front, projection.residual.detach().square().sum(-1), torch.inf)

    ascending, order = torch.stack((residual, spread)).sort(-1)  # (2, B, N)
    position = (share.expand_as(ascending).gather(-1, order).cumsum(-1) < _EXPLAINED_SHARE).sum(-1, keepdim=True)
    residual, spread = ascending.gather(-1, position.clamp(max=ascending.shape[-1] - 1))[..., 0]  # what most are below
    in_front = (projection.in_front & there).sum(-1)
    return (in_front >= 3) & (residual <= _EXPLAINED_RESIDUAL**2 * spread)
