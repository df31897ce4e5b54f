r"""The refiner: a list of stages of robust weighted Levenberg-Marquardt with learned hyperparameters, and its verdict.

:mod:`~kornia_pnpnet.refine.step` has one iteration as pure functions; :class:`RobustWeightedLM` owns the parameters and
the loop.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor

from kornia_pnpnet.core.checks import check_whole
from kornia_pnpnet.core.compilation import Compiled, per_problem
from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.core.linalg import relative
from kornia_pnpnet.core.performance import problems_last, repeat_problems
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.geometry import Projection, project
from kornia_pnpnet.refine.implicit import attach_gradient
from kornia_pnpnet.refine.kernels import KERNELS, RobustKernel
from kornia_pnpnet.refine.parameters import BoundedParameter
from kornia_pnpnet.refine.prior import focal_loss, prior_loss
from kornia_pnpnet.refine.scale import complete_noise, is_unknown
from kornia_pnpnet.refine.stages import LMStart, Stage, State
from kornia_pnpnet.refine.step import (
    LMStep,
    corrected_residuals,
    iterate,
    sq_standardised,
)
from kornia_pnpnet.refine.variance import outlier_area
from kornia_pnpnet.refine.verdict import believe, explains, has_enough, has_focal, residual_noise
from kornia_pnpnet.types import Correspondences, Guess, Pose, Refinement

__all__ = ["BACKWARDS", "RobustWeightedLM"]

#: How gradients pass through a refinement, see :class:`RobustWeightedLM`.
BACKWARDS = ("unroll", "truncated", "implicit")

# Focal lengths. Residuals count up to this size in the cost, and a point behind the camera counts as much, so that it
# is never cheaper than a point in front of the camera.
_MAX_RESIDUAL = 2.0
# Units in the last place. With `reject_worse`, costs and residuals that differ by less count as equal.
_ROUNDING = 100.0
# Factors of the damping after a refused and after an accepted step (Marquardt 1963; only with `reject_worse`).
_DAMPING_UP, _DAMPING_DOWN = 10.0, 0.3


class RobustWeightedLM(Configured):
    r"""Refine poses by ``m`` unrolled iterations of robust weighted Levenberg-Marquardt.

    Each iteration weighs a pair by the product of the weight that came with the correspondences, the initialiser's
    weight, and the robust weight of its residual at the previous estimate, and takes one
    :func:`~kornia_pnpnet.refine.lm_step`. Step :math:`\gamma`, damping :math:`\lambda` and robustness (the shape of
    the kernel, :math:`\alpha` for ``power``) are learned, by default one set per iteration. At their initial values
    this is the classical method.

    *Noise.* Where the noise of each pair is known or estimated, residuals count in standard deviations: a pair weighs
    :math:`1 / \sigma^2` times the robust weight of :math:`\|r\|^2 / \sigma^2`, with the
    :func:`~kornia_pnpnet.geometry.pixel_variance` :math:`\sigma^2` at the previous estimate. Where the caller gave
    covariances, residuals are whitened by the :func:`~kornia_pnpnet.geometry.pixel_covariance` instead. Scales of
    kernels and the cost then count in standard deviations, too.

    *Several poses.* Where a guess has other poses, the first seven tenths of the iterations (rounded down) refine all
    of them. Then the pose of the lowest cost by the kernel of the last of these iterations goes on alone, per problem.

    *By residual.* The last ``by_residual`` iterations and the choice among several poses ignore the initialiser's
    weights: by then the residuals say better which pairs are outliers. Where the initialiser estimated the noise, and
    the residuals show that its variance is too small or too large (by likelihood ratios), :meth:`finish` multiplies the
    variance by the factor that they show, see ``variance_factor``. Where it is too large
    the iterations multiply by a tenth of that, since a narrower kernel separates inliers from outliers better. Noise
    that the caller gave stays as it is.

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
        reject_worse: refuse, per problem, a step that raises the cost, and raise the damping tenfold after it. From a
            start far away the iterations diverge otherwise; from a good guess they take the same steps, and are faster
            without.
        by_residual: number of final iterations that ignore the initialiser's weights, at most those after the choice
            among several poses.
        learnable: whether the hyperparameters are trained.
        backward: how gradients pass. ``"unroll"``: through all iterations. ``"truncated"``: through the ``last``
            iterations; the pose before them is a constant. ``"implicit"``: by the implicit function theorem, as
            through a minimum, at a memory that does not grow with ``m``; exact once the iterations have converged.
            Step, damping and the first guess then have no gradient. A solver that estimates radial distortion always
            takes this way: the minimum is then one of the distortion, too.
        last: number of iterations that ``"truncated"`` passes through.
        compared_at: number of iterations before the choice among several poses; seven tenths of ``m`` when ``None``.

    Raises:
        BaseError: for an unknown kernel or update, a negative ``m``, or an initial value out of its bounds.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
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
        reject_worse: bool = True,
        by_residual: int = 0,
        learnable: bool = True,
        backward: str = "unroll",
        last: int = 1,
        compared_at: int | None = None,
    ) -> None:
        super().__init__(locals())
        check_whole(0, m=m, by_residual=by_residual)
        check_whole(1, last=last)
        KORNIA_CHECK(kernel in KERNELS, f"kernel must be one of {sorted(KERNELS)}, got {kernel!r}.")
        KORNIA_CHECK(update in ("retraction", "additive"), f"update must be retraction or additive, got {update!r}.")
        KORNIA_CHECK(backward in BACKWARDS, f"backward must be one of {BACKWARDS}, got {backward!r}.")
        self.m = m
        check_whole(0, m, **({} if compared_at is None else {"compared_at": compared_at}))
        self.compared_at = 7 * m // 10 if compared_at is None else compared_at
        self.by_residual = min(by_residual, m - self.compared_at)
        self.backward = backward
        self.last = last
        self.kernel: RobustKernel = KERNELS[kernel]
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
        self._iteration = partial(iterate, kernel_weight=self.kernel.weight, additive=update == "additive")
        # What runs: these functions, or what `compile` made of them.
        self._begin: Callable[..., LMStart] = self.begin
        self._iterate: Callable[..., LMStep] = self._iteration
        self._choose: Callable[..., State] = self._best_pose
        self._finish: Callable[..., Refinement] = self.finish

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

    def with_iterations(self, m: int) -> RobustWeightedLM:
        """A copy with another number of iterations, its hyperparameters included.

        Args:
            m: number of iterations. Fewer: the first of them, and the same share before the choice among several poses.
                More: the last iteration is repeated, so that poses converge further.

        Returns:
            The refiner, not compiled.

        Example:
            >>> refine = RobustWeightedLM(m=5).with_iterations(20)
            >>> refine.m, refine.step().shape
            (20, torch.Size([20]))
        """
        check_whole(0, m=m)
        more = m - self.m
        config = {**self.config, "m": m, "by_residual": max(self.by_residual + more, 0)}
        config["compared_at"] = self.compared_at if more > 0 else None
        refine = RobustWeightedLM(**config)
        for name, parameter in refine.named_parameters():
            trained = self.get_parameter(name).detach()
            parameter.data = trained[torch.arange(len(parameter)).clamp(max=len(trained) - 1)]
        return refine

    def forward(self, corr: Correspondences, guess: Guess, *, m: int | None = None) -> Refinement:
        r"""Refine a guess.

        Args:
            corr: normalised correspondences of :math:`B` problems with :math:`N` pairs each.
            guess: poses in the frame of ``corr`` and a factor for the weight of each pair.
            m: stop after this many iterations; run all of them when ``None``.

        Returns:
            The refined poses, the weights and the cost at these poses with the kernel of the last iteration, and
            ``ok``: whether the last equations could be solved and the pose is to be believed. With unknown noise it
            has to explain the pixels better than a single point would; with known noise it has to have more inliers
            than chance would give it (see :mod:`kornia_pnpnet.refine.verdict`).
        """
        start = self._begin(corr, guess)
        return self._finish(start, self.iterate(start, m))

    def begin(self, corr: Correspondences, guess: Guess) -> LMStart:
        """Prepare a refinement: everything before the first iteration.

        Args:
            corr: normalised correspondences of :math:`B` problems with :math:`N` pairs each.
            guess: poses in the frame of ``corr`` and a factor for the weight of each pair.

        Returns:
            What the iterations need.
        """
        step, damping, shape = (x.unbind() for x in self.hyperparameters(corr.world_points))
        unknown = is_unknown(corr) if self.by_residual or corr.noise is not None else None
        noiseless = None if unknown is None or corr.noise is None or guess.noise is not None else unknown[:, 0]
        corr = problems_last(corr._replace(noise=complete_noise(corr, guess)))
        prior = corr.weights * problems_last(guess.weights)
        area = None
        if self.by_residual and unknown is not None and corr.noise is not None and not corr.noise.covariances:
            area = torch.where(unknown, outlier_area(corr), 0.0)
        # Steps do not depend on a common factor of the weights; tiny weights must not vanish when multiplied.
        guided = corr._replace(weights=relative(prior, prior), img_scale=None, world_scale=None)
        by_residual = guided
        if self.by_residual:
            by_residual = guided._replace(weights=_relative_to_mean(corr.weights))
            prior = corr.weights
        poses = guess.poses
        starts, rivals = guided, None
        if len(poses) > 1:
            starts = repeat_problems(guided, len(poses))
            rivals = starts._replace(weights=repeat_problems(by_residual.weights, len(poses)))
        zoom = None
        if corr.free_focal is not None:
            first = torch.zeros_like(prior[:, 0]) if guess.zoom is None else guess.zoom
            zoom = torch.cat((first, *(torch.zeros_like(first) for _ in poses[1:])))
        # Problems last in memory, too: (3, 3, S B) and (3, S B).
        pose = map_tensors(lambda *x: torch.cat([y.movedim(0, -1) for y in x], -1).movedim(-1, 0), *poses)
        return LMStart(
            corr=corr,
            prior=prior,
            pose=pose,
            guided=guided,
            by_residual=by_residual,
            starts=starts,
            rivals=rivals,
            outlier_area=area,
            noiseless=noiseless,
            zoom=zoom,
            step=step,
            damping=damping,
            shape=shape,
        )

    def stages(self, start: LMStart, m: int, more: int = 0) -> list[Stage]:
        """Plan the first ``m`` iterations: the pairs, weights, noise and hyperparameters that each of them sees.

        Args:
            start: what :meth:`begin` returned.
            m: number of iterations.
            more: number of further iterations like the last one.

        Returns:
            The stages in order: iterations on all poses of the guess, the choice of one pose per problem, iterations
            with the initialiser's weights, and iterations by residual. Stages that have nothing to do are left out.
        """
        explored = 0 if start.rivals is None else min(self.compared_at, m)
        guided = max(self.m - self.by_residual, explored)
        seen: list[tuple[Correspondences, Tensor | None]] = [(start.starts, None)] * explored
        seen += [(start.guided, None)] * (guided - explored)
        seen += [(start.by_residual, start.outlier_area)] * (self.m - guided)
        plan = [
            Stage(i, partial(self._advance, pairs, start.step[i], start.damping[i], start.shape[i], area))
            for i, (pairs, area) in enumerate(seen[:m])
        ]
        plan += [plan[-1]._replace(iteration=m + i) for i in range(more)]
        if start.rivals is not None:
            shape = start.shape[max(self.compared_at - 1, 0)]
            plan.insert(explored, Stage(explored, partial(self._choose, start.rivals, start.prior, shape)))
        return plan

    def iterate(self, start: LMStart, m: int | None = None, *, more: int = 0) -> LMStep:
        """Run the iterations.

        Args:
            start: what :meth:`begin` returned.
            m: stop after this many iterations; run all of them when ``None``.
            more: number of further iterations like the last one.

        Returns:
            The last pose, and whether the last equations could be solved.
        """
        m = self.m if m is None else min(m, self.m)
        more = more if m else 0
        live = {"unroll": 0, "truncated": max(m + more - self.last, 0), "implicit": m + more}[self.backward]
        plan = self.stages(start, m, more)
        ones = torch.ones_like(start.pose.translation[:, 0])
        state = State(start.pose, ones.bool(), ones, start.zoom)
        for stage in plan:
            with torch.set_grad_enabled(torch.is_grad_enabled() and stage.iteration >= live):
                state = stage.advance(state)
        end = LMStep(state.pose, state.solved, state.zoom)
        if self.backward == "implicit" and m and torch.is_grad_enabled():
            return attach_gradient(start, end, start.shape[m - 1], self.kernel.weight)
        return end

    def finish(self, start: LMStart, end: LMStep) -> Refinement:
        """Judge where the iterations ended: everything after the last iteration.

        Args:
            start: what :meth:`begin` returned.
            end: what :meth:`iterate` returned.

        Returns:
            See :meth:`forward`.
        """
        start = start.zoomed(end.zoom)
        projection, shape = project(end.pose, start.corr), per_problem(start.shape[-1], start.prior[:, :1])
        pairs = start.corr._replace(weights=start.by_residual.weights)
        sq_residual, noise = corrected_residuals(projection, pairs, self.kernel.weight, shape, start.outlier_area)
        weights = torch.where(projection.in_front, start.prior * self.kernel.weight(sq_residual, shape), 0.0)
        cost = self._cost(end.pose, projection, start.corr, start.prior, shape)
        judged, unknown, law = start.guided, start.noiseless, "sigmas"
        if noise is None:
            noise, judged, law = residual_noise(projection, start.corr, start.prior), start.corr, "residuals"
            unknown = torch.ones_like(end.solved)
        probability, ok = believe(projection, judged._replace(noise=noise), law)
        if unknown is not None:
            # Not `where`: ONNX Runtime has none for booleans.
            ok = (unknown & explains(projection, start.corr, start.prior)) | (~unknown & ok)
        in_front = has_enough(projection, start.prior)
        if end.zoom is not None:
            ok = ok & has_focal(projection, judged._replace(noise=noise), weights)
        return Refinement(end.pose, weights, cost, end.solved & ok & in_front, in_front, probability, end.zoom)

    def cost(self, start: LMStart, pose: Pose) -> Tensor:
        """The ``cost`` of :meth:`finish` at any pose, shape :math:`(B,)`.

        Args:
            start: what :meth:`begin` returned.
            pose: a pose for each problem in the frame of the correspondences.
        """
        return self._cost(pose, project(pose, start.corr), start.corr, start.prior, start.shape[-1])

    def compile(self, mode: str | None = None) -> None:
        """Compile with ``torch.compile``, in place: what is before, in, and after an iteration, each once.

        The first call takes seconds, further calls a fraction of the uncompiled time. The batch may change its size.

        Args:
            mode: mode of ``torch.compile``.
        """
        self._begin = Compiled(self.begin, mode)
        self._iterate = Compiled(self._iteration, mode)
        self._choose = Compiled(self._best_pose, mode)
        self._finish = Compiled(self.finish, mode)

    def _advance(
        self,
        pairs: Correspondences,
        step: Tensor,
        damping: Tensor,
        shape: Tensor,
        area: Tensor | None,
        state: State,
    ) -> State:
        """One iteration. With ``reject_worse``, a problem whose cost would rise keeps its pose."""
        damping = damping * state.factor if self.reject_worse else damping
        here = pairs.zoomed(state.zoom)
        moved = self._iterate(here, state.pose, step, damping, shape, area)
        pose, solved, zoom = moved.pose, moved.solved, moved.zoom_after(state.zoom)
        if not self.reject_worse or area is not None:  # the cost does not know the corrected noise
            return State(pose, solved, state.factor, zoom)
        at = (pose, pairs.zoomed(zoom)), (state.pose, here)
        new, old = (self._cost(x, project(x, seen), seen, seen.weights, shape) for x, seen in at)
        # At a minimum, rounding decides which cost is lower. A refused step has no gradient there: take the step.
        rounding = _ROUNDING * torch.finfo(new.dtype).eps
        better = new <= old * (1.0 + rounding) + (rounding * here.focal_of_problem).square()
        factor = torch.where(better, state.factor * _DAMPING_DOWN, state.factor * _DAMPING_UP)

        def chosen(new: Tensor, old: Tensor) -> Tensor:
            return torch.where(better.view(-1, *(1,) * (new.ndim - 1)), new, old)

        pose, zoom = map_tensors(chosen, (pose, zoom), (state.pose, state.zoom))
        return State(pose, solved, factor, zoom)

    def _best_pose(self, rivals: Correspondences, prior: Tensor, shape: Tensor, state: State) -> State:
        """Keep the pose of the lowest cost of each problem; ``prior`` has as many problems as there are."""
        batch = prior.shape[0]
        pose, zoom = map_tensors(torch.Tensor.detach, (state.pose, state.zoom))
        rivals = rivals.zoomed(zoom)
        cost = self._cost(pose, project(pose, rivals), rivals, rivals.weights, shape.detach())
        best = (cost.view(-1, batch) if batch else cost[None]).argmin(0)  # (B,), the first of equals
        index = torch.add(torch.arange(batch, device=best.device), best, alpha=batch)
        return map_tensors(lambda x: x.movedim(0, -1).index_select(-1, index).movedim(-1, 0), state)

    def _cost(self, pose: Pose, projection: Projection, corr: Correspondences, prior: Tensor, shape: Tensor) -> Tensor:
        """Mean robust loss over the pairs that have a weight, with that of the prior of the pose, shape (B,)."""
        most = (_MAX_RESIDUAL * corr.focal).square()
        sq_residual = sq_standardised(projection, corr, most)
        count = (corr.weights > 0).sum(-1).clamp(min=1)
        total = (prior * self.kernel.loss(sq_residual, shape)).sum(-1)
        known = corr.prior or corr.free_focal
        unit = known.pixel.square() if known is not None and corr.noise is None else 1.0
        if corr.prior is not None:
            total = total + unit * prior_loss(corr.prior, pose)
        if corr.free_focal is not None:
            total = total + unit * focal_loss(corr.free_focal, corr.focal_of_problem)
        return total / count


def _relative_to_mean(weights: Tensor) -> Tensor:
    """Weights over the mean of those that are not 0: unlike the largest weight, the mean has a derivative at ties."""
    mean = weights.sum(-1, keepdim=True) / (weights > 0).sum(-1, keepdim=True).clamp(min=1)
    return weights / torch.where(mean > 0, mean, 1.0)
