r"""Robust weighted Levenberg-Marquardt with a fixed number of iterations and learned hyperparameters.

:func:`lm_step` is one iteration as a pure function; :class:`RobustWeightedLM` owns the parameters and the loop.
Source: R. Sheffer and A. Wiesel, "PnP-Net: A hybrid Perspective-n-Point Network", 2020, section 3; the
damping by the diagonal is Marquardt's (1963).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import partial, reduce
from operator import and_
from typing import Any, NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor, nn

from kornia_pnpnet.core.checks import check_numbers, check_whole
from kornia_pnpnet.core.compilation import Compiled
from kornia_pnpnet.core.linalg import factorise, relative, substitute
from kornia_pnpnet.geometry import (
    NormalEquations,
    Projection,
    additive_tangent_map,
    change_tangent,
    move,
    normal_equations,
    pixel_variance,
    problems_last,
    project,
    retract_additive,
)
from kornia_pnpnet.refine.kernels import KERNELS, RobustKernel
from kornia_pnpnet.types import Correspondences, Guess, Noise, Pose, Refinement

__all__ = [
    "BACKWARDS",
    "BoundedParameter",
    "LMStart",
    "LMStep",
    "RobustWeightedLM",
    "explains",
    "lm_step",
    "solve_damped",
]

#: How gradients pass through a refinement, see :class:`RobustWeightedLM`.
BACKWARDS = ("unroll", "truncated", "implicit")

# Residuals count up to this many focal lengths in the cost, and a point behind the camera counts as much: it can
# never be cheaper than a point in front of it.
_MAX_RESIDUAL = 2.0
# A pose explains the pixels when this share of the pairs has residuals below this share of the pixels' spread.
# Just below the share, so that a sum of shares that is it but for rounding is enough.
_EXPLAINED_SHARE, _EXPLAINED_RESIDUAL = 0.6 - 1e-5, 0.2
# Iterations by residual believe the residuals' own variance factor where its likelihood is e to this power higher than
# that of 1; no factor is taken to be less than the second number. Their kernel is then narrower by the third's root.
_BELIEVED, _LEAST_FACTOR, _NARROWER = 3.0, 1e-4, 0.1
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


class LMStart(NamedTuple):
    r"""What the iterations of a refinement start from.

    Attributes:
        corr: the correspondences, problems last in memory.
        prior: weight of each pair before its residual was looked at, for the judgement, :math:`(B, N)`.
        pairs: the correspondences with their weights relative to the largest, what an iteration sees.
        pose: the first pose.
        step: :math:`\gamma` of each iteration, scalars.
        damping: :math:`\lambda` of each.
        shape: the kernel's shape of each.
        starts: where a guess has :math:`S` other poses, ``pose`` holds :math:`(S + 1) B`, first the first ones of all
            problems, and this is ``pairs`` as often; else ``None``.
        compared: ``starts`` with the weights by which their poses are compared.
        by_residual: ``pairs`` with the weights that came with the correspondences alone, what iterations that do not
            ask the guess see; ``None`` where all do.
        estimated: whether the noise of a problem is the guess's estimate alone, which those iterations may correct,
            bool :math:`(B, 1)`; ``None`` without them.
    """

    corr: Correspondences
    prior: Tensor
    pairs: Correspondences
    pose: Pose
    step: tuple[Tensor, ...]
    damping: tuple[Tensor, ...]
    shape: tuple[Tensor, ...]
    starts: Correspondences | None = None
    compared: Correspondences | None = None
    by_residual: Correspondences | None = None
    estimated: Tensor | None = None


class _State(NamedTuple):
    """Where the iterations are: poses, whether the last equations were solved, factor of the damping if it changes."""

    pose: Pose
    solved: Tensor
    factor: Tensor | None


def solve_damped(equations: NormalEquations, damping: Tensor) -> tuple[list[Tensor], Tensor]:
    r"""Solve :math:`(H + \lambda\,\mathrm{diag}(H))\,\delta = g` for a batch of positive semi-definite :math:`H`.

    An LDLᵀ factorisation written out entry by entry, so that it compiles, exports and differentiates like the rest.
    Its test on the pivots does not depend on units.

    Args:
        equations: :math:`H` and :math:`g` of any size, entry by entry.
        damping: :math:`\lambda \ge 0`, a scalar or :math:`(B,)`.

    Returns:
        The entries of the solution, each :math:`(B,)`, and whether there is one, bool :math:`(B,)`. Where a pivot
        vanishes values and gradients are finite but mean nothing.

    Example:
        >>> four, eight = torch.tensor([4.0]), torch.tensor([8.0])
        >>> solve_damped(NormalEquations(((four,), (0 * four, four)), (eight, four)), torch.tensor(1.0))
        ([tensor([1.]), tensor([0.5000])], tensor([True]))
    """
    factor = 1.0 + damping
    rows = [[*row[:-1], row[-1] * factor] for row in equations.hessian]
    diagonal = [row[-1] for row in rows]
    limits = torch.finfo(diagonal[0].dtype)
    smallest, infinite = torch.full_like(damping, limits.tiny), torch.full_like(damping, torch.inf)
    good: list[Tensor] = []

    def inverse(k: int, pivot: Tensor) -> Tensor:
        good.append(torch.add(pivot, diagonal[k], alpha=-10.0 * limits.eps) > smallest)
        return torch.where(good[-1], pivot, infinite).reciprocal()

    lower, scaled = factorise(rows, list(equations.gradient), inverse)
    return substitute(lower, scaled), reduce(and_, good)


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
        weights: weight of each pair, :math:`(B, N)`; points behind the camera do not count whatever it is. The step
            does not depend on a common factor.
        step: :math:`\gamma`, a scalar.
        damping: :math:`\lambda`, a scalar or :math:`(B,)`.
        additive: update the rotation vector additively as in the paper, instead of by the retraction.

    Returns:
        The moved pose and whether the equations could be solved.
    """
    equations = normal_equations(projection, _relative(weights, projection))
    if additive:
        equations = change_tangent(equations, additive_tangent_map(pose))
    delta, solved = solve_damped(equations, damping)
    factor = torch.where(solved, -step / corr.focal, torch.zeros_like(step))
    delta = [factor * x for x in delta]
    return LMStep(retract_additive(pose, torch.stack(delta).mT) if additive else move(pose, delta), solved)


def _relative(weights: Tensor, projection: Projection) -> Tensor:
    """Weights relative to the heaviest row of the Jacobian, so that products of tiny ones do not vanish."""
    return relative(weights, weights * projection.inv_depth * projection.inv_depth)


def _weighted(
    corr: Correspondences,
    pose: Pose,
    shape: Tensor,
    kernel_weight: Callable[[Tensor, Tensor], Tensor],
    estimated: Tensor | None = None,
) -> tuple[Projection, Tensor]:
    """The projection, and the weights of the pairs by their residuals there and by their noise.

    Where the noise is ``estimated`` the residuals have a say in how large it is.
    """
    projection = project(pose, corr)
    if corr.noise is None:
        return projection, corr.weights * kernel_weight(projection.sq_residual, shape)
    precision = pixel_variance(projection, corr.noise, corr.focal).reciprocal()
    residual = projection.sq_residual * precision
    if estimated is not None:
        within = torch.where(projection.in_front, kernel_weight(residual, shape), 0.0)
        factor = _variance_factor(residual, within, corr.weights, estimated)
        residual = residual / torch.where(factor < 1.0, _NARROWER * factor, 1.0)
    return projection, corr.weights * precision * kernel_weight(residual, shape)


def _variance_factor(residual: Tensor, kernel_weight: Tensor, weights: Tensor, estimated: Tensor) -> Tensor:
    r"""By how much the variance of the noise is to be multiplied, at most 1, shape (B, 1).

    The a posteriori variance factor of an adjustment, the weighted sum of squared residuals by the degrees of freedom,
    where its likelihood ratio against 1 is beyond chance; else 1. Only pairs deep within the kernel have a say.

    Args:
        residual: squared residuals by their variance, :math:`(B, N)`.
        kernel_weight: by these residuals, at most 1, :math:`(B, N)`.
        weights: of the pairs, at most 1, :math:`(B, N)`.
        estimated: where the factor may be other than 1, bool (B, 1).
    """
    weights = weights * kernel_weight.square().square()
    freedom = (2.0 * weights.sum(-1, keepdim=True) - 6.0).clamp(min=1.0)
    factor = ((weights * residual).sum(-1, keepdim=True) / freedom).clamp(min=_LEAST_FACTOR)
    log_ratio = 0.5 * freedom * (factor - 1.0 - factor.log())
    return torch.where(estimated & (factor < 1.0) & (log_ratio > _BELIEVED), factor, 1.0)


def _iterate(
    corr: Correspondences,
    pose: Pose,
    step: Tensor,
    damping: Tensor,
    shape: Tensor,
    kernel_weight: Callable[[Tensor, Tensor], Tensor],
    additive: bool,
    estimated: Tensor | None = None,
) -> LMStep:
    """Weigh the pairs by their residuals and take one step."""
    projection, weights = _weighted(corr, pose, shape, kernel_weight, estimated)
    return lm_step(corr, pose, projection, weights, step, damping, additive=additive)


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
        BaseError: when the bounds are none, or ``initial`` is not between them.

    Example:
        >>> BoundedParameter(1e-3, size=2, lower=1e-6, upper=1.0, logarithmic=True)()
        tensor([0.0010, 0.0010], grad_fn=<ExpBackward0>)
    """

    def __init__(self, initial: float, *, size: int, lower: float, upper: float, logarithmic: bool = False) -> None:
        super().__init__()
        check_whole(1, size=size)
        check_numbers(-math.inf, lower=lower, upper=upper)
        KORNIA_CHECK(lower < upper, f"The bounds must rise, got {lower} and {upper}.")
        KORNIA_CHECK(not logarithmic or lower > 0, f"The bounds of a logarithm must be positive, got {lower}.")
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

    Where a guess says how large the noise of each pair is, residuals count in standard deviations: a pair weighs
    :math:`1 / \sigma^2` times the robust weight of :math:`\|r\|^2 / \sigma^2`, with the
    :func:`~kornia_pnpnet.geometry.pixel_variance` :math:`\sigma^2` at the previous estimate, and scales of kernels and
    the cost count in standard deviations too.

    Where a guess has other poses, all of them are refined by the first seven tenths of the iterations, rounded down.
    Then, per problem, the one of the lowest cost by the kernel of the last of these goes on alone.

    With ``by_residual`` neither the choice among several poses nor the last iterations ask the guess how much a pair
    counts: what it took for wrong may by then have shown to be right, and the other way round. Where residuals are so
    small that the noise which the guess estimated cannot be (by their likelihood ratio), its variance is multiplied by
    their a posteriori variance factor, in these iterations by a tenth of it: where the noise is known so well, a
    narrower kernel tells pairs better apart. Noise that came with the correspondences stays as it is.

    All operations are per problem: a problem that cannot be solved keeps its pose, reports ``ok=False`` and changes
    no other.

    Args:
        m: number of iterations; 0 leaves the guess as it is and only judges it.
        kernel: name of the robust kernel, a key of :data:`~kornia_pnpnet.refine.kernels.KERNELS`.
        step: initial :math:`\gamma`, in [0, 2].
        damping: initial :math:`\lambda`, in [1e-8, 100].
        robustness: initial shape of the kernel, its classical value when ``None``. With 0, ``power`` is least squares.
        shared: learn one set for all iterations instead of one each.
        update: ``"retraction"`` on the rotation group, or the paper's ``"additive"`` on the rotation vector.
        reject_worse: refuse, per problem, a step that raises the cost, and raise the damping after it tenfold.
        by_residual: the last so many iterations, of those after the choice among several poses, that choice, and the
            judgement after them leave the guess's weights out.
        learnable: whether the hyperparameters are trained.
        backward: how gradients pass. ``"unroll"``: through all iterations. ``"truncated"``: through the ``last`` ones,
            the pose before them counts as constant. ``"implicit"``: by the implicit function theorem, as through a
            minimum, at a memory that does not grow with ``m``; exact once the iterations have converged, and then step
            and damping have no gradient, nor has the first guess.
        last: how many iterations ``"truncated"`` passes through.

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
        by_residual: int = 0,
        learnable: bool = True,
        backward: str = "unroll",
        last: int = 1,
    ) -> None:
        super().__init__()
        KORNIA_CHECK(type(m) is int and m >= 0, f"m must be an integer of at least 0, got {m!r}.")
        KORNIA_CHECK(kernel in KERNELS, f"kernel must be one of {sorted(KERNELS)}, got {kernel!r}.")
        KORNIA_CHECK(update in ("retraction", "additive"), f"update must be retraction or additive, got {update!r}.")
        KORNIA_CHECK(backward in BACKWARDS, f"backward must be one of {BACKWARDS}, got {backward!r}.")
        KORNIA_CHECK(type(last) is int and last >= 1, f"last must be an integer of at least 1, got {last!r}.")
        KORNIA_CHECK(
            type(by_residual) is int and by_residual >= 0,
            f"by_residual must be an integer of at least 0, got {by_residual!r}.",
        )
        self.config: dict[str, Any] = {
            "m": m,
            "kernel": kernel,
            "step": step,
            "damping": damping,
            "robustness": robustness,
            "shared": shared,
            "update": update,
            "reject_worse": reject_worse,
            "by_residual": by_residual,
            "learnable": learnable,
            "backward": backward,
            "last": last,
        }
        self.m = m
        self.compared_at = 7 * m // 10  # the iteration before which the best of several starts is chosen
        self.by_residual = min(by_residual, m - self.compared_at)
        self.backward = backward
        self.last = last
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
        self._iteration = partial(_iterate, kernel_weight=self.kernel.weight, additive=self.additive)
        # What runs: these, or what `compile` made of them.
        self._begin: Callable[..., LMStart] = self.begin
        self._iterate: Callable[..., LMStep] = self._iteration
        self._iterate_last: Callable[..., LMStep] = self._iteration
        self._choose: Callable[..., _State] = self.choose
        self._finish: Callable[..., Refinement] = self.finish

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

    def _cost(self, projection: Projection, corr: Correspondences, prior: Tensor, shape: Tensor) -> Tensor:
        """Mean robust loss over the pairs that are there, shape (B,)."""
        most = (_MAX_RESIDUAL * corr.focal).square()
        sq_residual = torch.where(projection.in_front, projection.sq_residual.minimum(most), most)  # (B, N)
        if corr.noise is not None:
            sq_residual = sq_residual / pixel_variance(projection, corr.noise, corr.focal)
        count = (corr.weights > 0).sum(-1).clamp(min=1)
        return (prior * self.kernel.loss(sq_residual, shape)).sum(-1) / count

    def begin(self, corr: Correspondences, guess: Guess) -> LMStart:
        """Prepare a refinement: everything before the first iteration.

        Args:
            corr: normalised correspondences of :math:`B` problems with :math:`N` pairs each.
            guess: poses in the frame of ``corr`` and a factor for the weight of each pair.

        Returns:
            What the iterations need.
        """
        step, damping, shape = (x.unbind() for x in self.hyperparameters(corr.world_points))
        corr = problems_last(corr)
        # Problems last, after the starts.
        poses = [x.movedim(0, -1) for x in guess.pose]
        if guess.others is not None:
            others = (x.movedim((0, 1), (-1, -2)) for x in guess.others)
            poses = [torch.cat((x[..., None, :], y), -2).flatten(-2) for x, y in zip(poses, others, strict=True)]
        pose = Pose(*(x.contiguous().movedim(-1, 0) for x in poses))
        prior = corr.weights * guess.weights.mT.contiguous().mT
        # The steps do not depend on a common factor of the weights; tiny ones must not vanish when multiplied.
        noise = None if guess.noise is None else Noise(*(x.mT.contiguous().mT for x in guess.noise))
        pairs = Correspondences(*corr[:2], relative(prior, prior), corr.focal, noise=noise)
        by_residual = estimated = starts = compared = None
        if self.by_residual:
            by_residual = pairs._replace(weights=relative(corr.weights, corr.weights))
            prior = corr.weights
            estimated = torch.ones_like(prior[:, :1], dtype=torch.bool)
            for told in corr.noise or ():
                estimated = estimated & ~told.isfinite().any(1, keepdim=True)
        if guess.others is not None:
            count = 1 + guess.others.rotation.shape[1]
            starts = compared = _repeated(pairs, count)
            if by_residual is not None:
                compared = starts._replace(weights=_repeat(by_residual.weights, count))
        return LMStart(corr, prior, pairs, pose, step, damping, shape, starts, compared, by_residual, estimated)

    def iterate(self, start: LMStart, m: int | None = None) -> LMStep:
        """Run the iterations.

        Args:
            start: what :meth:`begin` returned.
            m: stop after this many; all of them when ``None``.

        Returns:
            The last pose, and whether the last equations could be solved.
        """
        m = self.m if m is None else min(m, self.m)
        unrolled = {"unroll": m, "truncated": min(self.last, m), "implicit": 0}[self.backward]
        ones = torch.ones_like(start.pose.translation[:, 0])
        state = _State(start.pose, ones.bool(), ones if self.reject_worse else None)
        with torch.set_grad_enabled(torch.is_grad_enabled() and unrolled == m):
            state = self._run(start, state, range(m - unrolled))
        state = self._run(start, state, range(m - unrolled, m))
        if start.starts is not None and m <= self.compared_at:
            state = self._choose(start.pairs, start.compared, state, start.shape[max(self.compared_at - 1, 0)])
        if unrolled == 0 and m and torch.is_grad_enabled():
            return LMStep(self._attach_gradient(start, state.pose, start.shape[m - 1]), state.solved)
        return LMStep(state.pose, state.solved)

    def _run(self, start: LMStart, state: _State, iterations: range) -> _State:
        """Some iterations."""
        for i in iterations:
            pairs = start.pairs
            if start.starts is not None and i < self.compared_at:
                pairs = start.starts
            elif start.starts is not None and i == self.compared_at:
                state = self._choose(start.pairs, start.compared, state, start.shape[max(i - 1, 0)])
            iterate = self._iterate
            if start.by_residual is not None and i >= self.m - self.by_residual:
                iterate, pairs = partial(self._iterate_last, estimated=start.estimated), start.by_residual
            pose, factor = state.pose, state.factor
            damping = start.damping[i] if factor is None else start.damping[i] * factor
            pose, solved = iterate(pairs, pose, start.step[i], damping, start.shape[i])
            if factor is not None:
                at = project(pose, pairs), project(state.pose, pairs)
                new, old = (self._cost(x, pairs, pairs.weights, start.shape[i]) for x in at)
                better = new <= old
                factor = torch.where(better, factor * _DAMPING_DOWN, factor * _DAMPING_UP)
                pose = Pose(*_chosen(better, pose, state.pose))
            state = _State(pose, solved, factor)
        return state

    def choose(self, pairs: Correspondences, starts: Correspondences, state: _State, shape: Tensor) -> _State:
        """Of each problem's poses keep the one of the lowest cost: several of ``starts`` to one of ``pairs``."""
        pose = Pose(*(x.detach() for x in state.pose))
        batch = pairs.weights.shape[0]
        cost = self._cost(project(pose, starts), starts, starts.weights, shape.detach())
        best = (cost.view(-1, batch) if batch else cost[None]).argmin(0)  # (B,), the first of equals
        index = torch.add(torch.arange(batch, device=best.device), best, alpha=batch)

        def kept(x: Tensor) -> Tensor:
            return x.movedim(0, -1).index_select(-1, index).movedim(-1, 0)

        factor = None if state.factor is None else kept(state.factor)
        return _State(Pose(*map(kept, state.pose)), kept(state.solved), factor)

    def finish(self, start: LMStart, end: LMStep) -> Refinement:
        """Judge where the iterations ended: everything after the last of them.

        Args:
            start: what :meth:`begin` returned.
            end: what :meth:`iterate` returned.

        Returns:
            See :meth:`forward`.
        """
        corr = start.corr._replace(noise=start.pairs.noise)
        projection, shape = project(end.pose, corr), start.shape[-1]
        sq_residual = projection.sq_residual
        if corr.noise is not None:
            sq_residual = sq_residual / pixel_variance(projection, corr.noise, corr.focal)
        weights = self.kernel.weight(sq_residual, shape)
        if start.by_residual is not None and start.estimated is not None and corr.noise is not None:
            within = torch.where(projection.in_front, weights, 0.0)
            factor = _variance_factor(sq_residual, within, start.by_residual.weights, start.estimated)
            weights = self.kernel.weight(sq_residual / factor, shape)
        weights = torch.where(projection.in_front, start.prior * weights, 0.0)
        cost = self._cost(projection, corr, start.prior, shape)
        # With the noise known what explains the pixels is a question of evidence, which the solver answers.
        seen = explains(projection, corr, start.prior) if corr.noise is None else _enough(projection, start.prior)
        return Refinement(end.pose, weights, cost, end.solved & seen)

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
        start = self._begin(corr, guess)
        return self._finish(start, self.iterate(start, m))

    def compile(self, mode: str | None = None) -> None:
        """Compile with ``torch.compile``, in place: what is before, in, and after an iteration, each once.

        The first call takes seconds, then each takes a fraction of the time. The batch may change its size.

        Args:
            mode: of ``torch.compile``.
        """
        self._begin = Compiled(self.begin, mode)
        self._iterate = Compiled(self._iteration, mode)
        self._iterate_last = Compiled(self._iteration, mode)
        self._choose = Compiled(self.choose, mode)
        self._finish = Compiled(self.finish, mode)

    def _attach_gradient(self, start: LMStart, pose: Pose, shape: Tensor) -> Pose:
        r"""Give a converged pose the gradient of a minimum, by the implicit function theorem.

        With :math:`g(\delta) = J^\top W r` at the pose moved by :math:`\delta`, which is 0 at the minimum,
        :math:`d\delta = -(\partial g / \partial \delta)^{-1} dg`: one Newton step, which is left out of the value.
        Where the matrix is not positive definite the pose is no minimum yet: the Gauss-Newton matrix takes its place.
        """

        def equations(corr: Correspondences, at: Pose, shape: Tensor) -> NormalEquations:
            projection, weights = _weighted(corr, at, shape, self.kernel.weight, start.estimated)
            return normal_equations(projection, _relative(weights, projection))

        pairs = start.pairs if start.by_residual is None else start.by_residual
        fixed = pairs.map(torch.Tensor.detach)
        zero = [torch.zeros_like(start.prior[:, 0]).requires_grad_() for _ in range(6)]
        with torch.enable_grad():
            around, gradient = equations(fixed, move(pose, zero), shape.detach())
            hessian = [
                torch.autograd.grad(entry.sum(), zero[: i + 1], retain_graph=True) for i, entry in enumerate(gradient)
            ]
        gradient = equations(pairs, pose, shape).gradient
        none = torch.zeros_like(shape)
        newton, convex = solve_damped(NormalEquations(hessian, gradient), none)
        gauss_newton, solved = solve_damped(NormalEquations([[x.detach() for x in y] for y in around], gradient), none)
        steps = (torch.where(convex, x, torch.where(solved, y, 0.0)) for x, y in zip(newton, gauss_newton, strict=True))
        return move(pose, [step.detach() - step for step in steps])


def _repeated(pairs: Correspondences, count: int) -> Correspondences:
    """The pairs of all problems several times over."""
    noise = None if pairs.noise is None else Noise(*(_repeat(x, count) for x in pairs.noise))
    world_points, img_points, weights = (_repeat(x, count) for x in pairs[:3])
    return pairs._replace(world_points=world_points, img_points=img_points, weights=weights, noise=noise)


def _repeat(x: Tensor, count: int) -> Tensor:
    """All problems several times over, problems last in memory."""
    # Expanded, not `repeat`, which would ask a compiler for a division at each entry.
    reverse = tuple(reversed(range(x.ndim)))
    last = x.permute(reverse)[..., None, :]
    return last.expand(*last.shape[:-2], count, -1).flatten(-2).permute(reverse)


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
    share = prior / prior.sum(-1, keepdim=True).clamp(min=torch.finfo(prior.dtype).tiny)  # (B, N)
    pixels = corr.img_points.detach()
    spread = (pixels - (share[..., None] * pixels).sum(1, keepdim=True)).square().sum(-1)
    ascending, order = spread.sort(-1)
    position = (share.gather(-1, order).cumsum(-1) < _EXPLAINED_SHARE).sum(-1, keepdim=True)
    limit = _EXPLAINED_RESIDUAL**2 * ascending.gather(-1, position.clamp(max=ascending.shape[-1] - 1))
    explained = projection.in_front & (projection.sq_residual.detach() <= limit)
    enough = torch.where(explained, share, 0.0).sum(-1) >= _EXPLAINED_SHARE
    return enough & _enough(projection, prior)


def _enough(projection: Projection, prior: Tensor) -> Tensor:
    """Whether three pairs or more are in front of the camera, bool (B,)."""
    return (projection.in_front & (prior > 0)).sum(-1) >= 3
