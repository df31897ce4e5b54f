r"""The refinement: stages of robust weighted Levenberg-Marquardt iterations with learned hyperparameters."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor

from kornia_pnpnet.core.checks import check_whole
from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.core.linalg import relative, solve_positive
from kornia_pnpnet.core.performance import EAGER, Runner, are_few, per_problem, problems_last, repeat_problems
from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.judge.evidence import (
    LEAST_PROBABILITY,
    Evidence,
    Mixture,
    Votes,
    at_pose,
    evidence,
    probability,
    updated,
)
from kornia_pnpnet.problem import MIN_PAIRS, Noise, Problem, Starts, State
from kornia_pnpnet.refine.kernels import KERNELS, BoundedParameter, RobustKernel
from kornia_pnpnet.refine.residual import (
    NormalEquations,
    Projection,
    information,
    lm_step,
    moved,
    normal_equations,
    project,
)
from kornia_pnpnet.refine.terms import add_term
from kornia_pnpnet.result import Pose

__all__ = ["BACKWARDS", "Plan", "Progress", "Refinement", "RobustWeightedLM", "taken"]

#: How gradients pass through a refinement, see :class:`RobustWeightedLM`.
BACKWARDS = ("unroll", "implicit")

_T = TypeVar("_T")

# Upper bound of a residual in the cost, in focal lengths. Points behind the camera have this residual, so that no point
# in front of the camera costs more.
_MAX_RESIDUAL = 2.0
# Largest assumed noise of a pixel in focal lengths: for bearings without intrinsics, one "pixel" would be one radian.
_LARGEST_PIXEL = 0.01
# With `reject_worse`, a step is rejected only if the cost rises by more than this number of units in the last place.
_ROUNDING = 100.0
# Estimated noise of points is replaced by 0 only if 0 raises the log-likelihood by more than this number. If the number
# is 0 instead of 2, success for nine pairs (protocol) falls by 1.4 to 2.7 percentage points, and errors for 20 exact
# points fall from 1.14 to 1.07 times those of least squares. If the noise is always replaced: by 4.6 to 5.3, to 1.04.
_EXPECTED = 2.0
# Factors of the damping after a rejected step and after an accepted step (Marquardt 1963; only with `reject_worse`).
_DAMPING_UP, _DAMPING_DOWN = 10.0, 0.3


class Plan(NamedTuple):
    r"""The inputs of all iterations of a refinement. Weights and sigmas have the shape :math:`(B, N)`.

    Attributes:
        problem: the problem with the caller's weights. The problem's noise is ``None``, or known for every pair.
        prior: weight of each pair in ``judge``, without the robust weight. The caller's weight if there are iterations
            by residual (see :class:`RobustWeightedLM`), else the product of the caller's and the initialiser's weight.
        guided: product of the caller's and the initialiser's weights, divided by the largest product of the problem.
        by_residual: ``prior`` divided by the mean of its positive entries; ``guided`` if no iteration is by residual.
        state: the initial states in a batch of size :math:`S B`: all first states, then all second states, ….
        world_sigma: the caller's standard deviation of each point, 0 where unknown.
        votes: see :class:`~kornia_pnpnet.judge.evidence.Votes`.
        hyperparameters: three scalars for each iteration: the step, the damping, and the shape of the kernel.
        starts: number :math:`S` of initial states of each problem.
    """

    problem: Problem
    prior: Tensor
    guided: Tensor
    by_residual: Tensor
    state: State
    world_sigma: Tensor
    votes: Votes
    hyperparameters: tuple[tuple[Tensor, Tensor, Tensor], ...]
    starts: int

    def evidence_at(self, state: State) -> Evidence:
        """The evidence for the poses of a state."""
        return evidence(at_pose(state, self.problem, self.votes), self.problem, self.votes)


class Progress(NamedTuple):
    """The input and the result of an iteration.

    ``solved`` tells whether the last equations could be solved, bool (B,). ``factor`` (B,) multiplies the damping.
    ``mixture`` is the distribution of the residuals in iterations by residual.
    """

    state: State
    solved: Tensor
    factor: Tensor
    mixture: Mixture | None = None

    @classmethod
    def of(cls, state: State, mixture: Mixture | None = None) -> Progress:
        """The start of the iterations."""
        ones = torch.ones_like(state.pose.translation[:, 0])
        return cls(state, ones > 0, ones, mixture)


class Refinement(NamedTuple):
    """A refined pose: the result of a refiner.

    Attributes:
        state: the refined pose in the frame of the problem, and the refined camera.
        weights: the weight of each pair at the refined pose, shape :math:`(B, N)`.
        cost: robust loss of pairs and priors, divided by the number of pairs of positive weight, shape :math:`(B,)`.
        ok: whether the pose passes the tests of :meth:`RobustWeightedLM.forward`, bool, shape :math:`(B,)`.
        in_front: whether at least three pairs of positive weight are in front of the camera, bool, shape :math:`(B,)`.
        probability: see :func:`~kornia_pnpnet.judge.evidence.probability`, shape :math:`(B,)`.
        evidence: the evidence for the pose.
    """

    state: State
    weights: Tensor
    cost: Tensor
    ok: Tensor
    in_front: Tensor
    probability: Tensor
    evidence: Evidence

    @property
    def pose(self) -> Pose:
        """The refined pose."""
        return self.state.pose


class RobustWeightedLM(Configured):
    r"""Refine poses by ``m`` unrolled iterations of robust weighted Levenberg-Marquardt.

    Each iteration takes one :func:`~kornia_pnpnet.refine.residual.lm_step`. The weight of a pair is the product of the
    caller's weight, the initialiser's weight, and the robust weight of the residual at the previous estimate. Step
    :math:`\gamma`, damping :math:`\lambda` and robustness (the shape of the kernel) are learned. A problem whose
    equations cannot be solved keeps its pose, and is not ``ok``.

    *Noise.* If the noise of each pair is known or estimated, each residual is divided by the standard deviation (or
    whitened by the covariance) of its pixel at the previous estimate. Kernel scales are then in standard deviations.

    *Several poses.* The first 70 % of the iterations (rounded down) refine all poses of an initialiser. The kernel of
    the last of these iterations gives the cost of each pose. Later iterations refine the pose of lowest cost.

    *By residual.* If ``by_residual`` is positive, the last ``by_residual`` iterations and the choice among poses
    ignore the initialiser's weights, because late residuals separate inliers better than these weights. In these
    iterations, a fitted mixture of inliers and outliers (:mod:`kornia_pnpnet.judge.evidence`) replaces the kernel.

    Args:
        m: number of iterations. If ``m`` is 0, the pose of the lowest cost is judged without refinement.
        kernel: name of the robust kernel, a key of :data:`~kornia_pnpnet.refine.kernels.KERNELS`.
        step: initial :math:`\gamma`, in [0, 2].
        damping: initial :math:`\lambda`, in [1e-8, 100].
        robustness: initial shape of the kernel; ``None``: the default of the kernel. The kernel ``power`` with
            the shape 0 is least squares.
        shared: learn one set of hyperparameters for all iterations instead of one set per iteration.
        update: ``"retraction"`` on the rotation group, or the paper's ``"additive"`` update of the rotation vector.
        reject_worse: reject a step that raises the cost of its problem, and then multiply the damping by 10. The last
            ``by_residual`` iterations reject no step. Without rejection, iterations from a distant start can diverge.
        by_residual: number of final iterations that ignore the initialiser's weights. The limit is the number of
            iterations after the choice among several poses.
        learnable: whether the hyperparameters are trained.
        backward: ``"unroll"`` differentiates all iterations. ``"implicit"`` applies the implicit function theorem to
            the last state, so that memory does not grow with ``m``. The implicit gradient is exact at a minimum. Step,
            damping and initial poses have no implicit gradient.

    Raises:
        BaseError: for an unknown kernel, update or backward, for a negative ``m`` or ``by_residual``, and for an
            initial value outside its bounds.

    Example:
        >>> from kornia_pnpnet import Normalize
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> problems = SyntheticProblems(n=9, batch_size=2, seed=0, world_sigma=0.0, img_sigma=0.0).batch(0)
        >>> normalize = Normalize(center=False, scale=False, order=False)
        >>> problem, frame = normalize(problems.world_points, problems.img_points, problems.intrinsics)
        >>> refined = RobustWeightedLM(m=5)(problem, Starts(problems.pose, torch.ones_like(problem.weights)))
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
    ) -> None:
        super().__init__(locals())
        check_whole(0, m=m, by_residual=by_residual)
        KORNIA_CHECK(kernel in KERNELS, f"kernel must be one of {sorted(KERNELS)}, got {kernel!r}.")
        KORNIA_CHECK(update in ("retraction", "additive"), f"update must be retraction or additive, got {update!r}.")
        self.backward = backward
        self.m = m = int(m)
        self.explored = 7 * m // 10
        self.by_residual = min(by_residual, m - self.explored)
        self.additive = update == "additive"
        self.reject_worse = reject_worse
        size = 1 if shared or m == 0 else m
        shape = self.kernel.default if robustness is None else robustness
        self.step = BoundedParameter(step, size=size, lower=0.0, upper=2.0)
        self.damping = BoundedParameter(damping, size=size, lower=1e-8, upper=1e2, logarithmic=True)
        bounds = {"lower": self.kernel.lower, "upper": self.kernel.upper}
        self.robustness = BoundedParameter(shape, size=size, **bounds, logarithmic=self.kernel.logarithmic)
        for parameter in self.parameters():  # `requires_grad_` is forbidden within `torch.func.grad`
            parameter.requires_grad = learnable and m > 0

    @property
    def kernel(self) -> RobustKernel:
        """The robust kernel."""
        return KERNELS[self.config["kernel"]]

    def hyperparameters(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        r"""Step, damping and robustness per iteration, shape :math:`(\max(m, 1),)` each, in the dtype of ``like``."""
        count = max(self.m, 1)
        step, damping, shape = (p().to(like).expand(count) for p in (self.step, self.damping, self.robustness))
        return step, damping, shape

    @property
    def backward(self) -> str:
        """How gradients are computed, as the argument. Copies and saved solvers keep a change."""
        return str(self.config["backward"])

    @backward.setter
    def backward(self, backward: str) -> None:
        KORNIA_CHECK(backward in BACKWARDS, f"backward must be one of {BACKWARDS}, got {backward!r}.")
        self.config["backward"] = backward

    def with_iterations(self, m: int) -> RobustWeightedLM:
        """Return a copy with ``m`` iterations. Additional iterations repeat the hyperparameters of the last iteration.

        Example:
            >>> refine = RobustWeightedLM(m=5).with_iterations(20)
            >>> refine.m, refine.step().shape
            (20, torch.Size([20]))
        """
        check_whole(0, m=m)
        by_residual = max(self.by_residual + m - self.m, 0) if self.by_residual else 0
        with self.step.raw.device:
            refine = RobustWeightedLM(**{**self.config, "m": m, "by_residual": by_residual})
            for name, parameter in refine.named_parameters():
                trained = self.get_parameter(name).detach()
                parameter.data = trained[torch.arange(len(parameter)).clamp(max=len(trained) - 1)]
                parameter.requires_grad = refine.m > 0 and (self.m == 0 or self.get_parameter(name).requires_grad)
        return refine

    def forward(self, problem: Problem, starts: Starts) -> Refinement:
        """Refine the poses of ``starts`` in the frame of the problem.

        A pose is ``ok`` only if the equations of the last iteration could be solved, at least three pairs of positive
        weight are in front of the camera, and the :func:`~kornia_pnpnet.judge.evidence.probability` suffices.
        """
        plan, now = self.iterate(self.begin(problem, starts))
        return self.judge(plan, now)

    def begin(self, problem: Problem, starts: Starts) -> Plan:
        """Prepare the inputs of all iterations."""
        each = zip(*(x.unbind() for x in self.hyperparameters(problem.world_points)), strict=True)
        given = problem.noise
        known = torch.zeros_like(problem.weights[:, :1], dtype=torch.bool)
        if given is not None:  # whether the caller gave at least one sigma
            known = torch.stack(given[:2]).isfinite().any(-1).any(0)[:, None]
        problem = problems_last(problem._replace(noise=_complete_noise(problem, starts)))
        prior = problem.weights * problems_last(starts.weights)
        # The division prevents underflow. If there are no terms, the divisor changes no step and needs no gradient.
        guided = by_residual = relative(prior, prior if problem.terms else prior.detach())
        if self.by_residual:
            prior = problem.weights
            # Unlike the largest weight, this mean is differentiable. Tiny weights count as if they were 0.
            by_residual = relative(prior, prior.detach())
            mean = by_residual.square().sum(-1, keepdim=True) / by_residual.sum(-1, keepdim=True).clamp(min=1.0)
            by_residual = by_residual / torch.where(mean > 0, mean, 1.0)
        poses = starts.poses
        # In memory, rotations have the shape (3, 3, S B), and translations (3, S B), see `problems_last`.
        pose = map_tensors(lambda *x: torch.cat([y.movedim(0, -1) for y in x], -1).movedim(-1, 0), *poses)
        camera = pose.translation[:, : 0 if problem.free_focal is None else 1] * 0.0
        if starts.camera is not None:
            camera = starts.camera.repeat(len(poses), 1)
        world_sigma = torch.zeros_like(prior) if given is None else problems_last(given.world.nan_to_num(0.0))
        weights, state = (prior, guided, by_residual), State(pose, camera)
        return Plan(problem, *weights, state, world_sigma, Votes.of(problem, known), tuple(each), len(poses))

    def iterate(self, plan: Plan, m: int | None = None, *, more: int = 0, run: Runner = EAGER) -> tuple[Plan, Progress]:
        """Run iterations on several poses, on the best pose, and finally by residual, see :class:`RobustWeightedLM`.

        Args:
            plan: the result of :meth:`begin`.
            m: number of iterations to run; ``None``: all iterations.
            more: number of additional iterations with the hyperparameters of the last iteration.
            run: calls each part of the refinement, compiled or uncompiled.

        Returns:
            The plan and the last states. The plan holds the noise that the iterations by residual used.
        """
        m = self.m if m is None else min(m, self.m)
        each = plan.hyperparameters[:m] + plan.hyperparameters[max(m - 1, 0) :][:1] * more
        explored = min(self.explored, m) if plan.starts > 1 else 0
        switch = max(self.m - self.by_residual, explored) if self.by_residual else len(each)
        guided, now = plan.problem._replace(weights=plan.guided), Progress.of(plan.state)
        implicit = self.backward == "implicit" and len(each) > 0  # without iterations, the starts have the gradient
        recording = torch.is_grad_enabled()
        with torch.set_grad_enabled(recording and not implicit):
            if plan.starts > 1:
                several = repeat_problems(guided, plan.starts)
                for one in each[:explored]:
                    now = run(self._iteration, several, now, *one)
                rivals = several._replace(weights=repeat_problems(plan.by_residual, plan.starts))
                now = run(self._best, rivals, plan.prior, plan.hyperparameters[max(self.explored - 1, 0)][2], now)
            for one in each[explored:switch]:
                now = run(self._iteration, guided, now, *one)
            if each[switch:]:
                with torch.set_grad_enabled(recording):  # also with `implicit`, the noise has a gradient
                    plan, now = run(self.shown, plan, now)
            for step, damping, _ in each[switch:]:
                now = run(self.by_residuals, plan, now, plan.votes.known, step, damping)
        if implicit and recording:
            now = now._replace(state=self._with_gradient(plan, now, each[-1][2]))
        return plan, now

    def by_residuals(self, plan: Plan, now: Progress, known: Tensor, step: Tensor, damping: Tensor) -> Progress:
        r"""Run one iteration by residual: fit the mixture to the residuals, and step with the mixture's weights.

        If the noise of a problem is ``known`` (bool :math:`(B, 1)`), the mixture keeps its variance.
        """
        assert now.mixture is not None
        problem = plan.problem._replace(weights=plan.by_residual)
        step, damping = (per_problem(x, problem.img_scale) for x in (step, damping))
        seen = at_pose(now.state, problem, plan.votes)
        mixture = updated(now.mixture, seen, plan.votes, known)
        robust = mixture.weights(seen) / mixture.variance
        equations = self._equations(seen.projection, problem, robust, seen.precision)
        state, solved = lm_step(equations, now.state, seen.projection.focal, step, damping, additive=self.additive)
        return Progress(state, solved, now.factor, mixture)

    def judge(self, plan: Plan, now: Progress, found: Evidence | None = None, odds: Tensor | None = None) -> Refinement:
        """Judge the states of :meth:`iterate`. If ``found`` is ``None``, the evidence for the states is computed.

        ``odds``, shape :math:`(B,)`, are log-odds of the poses against other poses. ``None``: there are no other poses.
        """
        seen = at_pose(now.state, plan.problem, plan.votes)
        shape = per_problem(plan.hyperparameters[-1][2], plan.prior[:, :1])
        if found is None:
            found = evidence(seen, plan.problem, plan.votes)
        if now.mixture is None:
            robust = self.kernel.weight(information(seen.projection, plan.problem)[0], shape)
        else:
            robust = found.mixture.weights(seen)
        weights = torch.where(seen.projection.in_front, plan.prior * robust, 0.0)
        cost = self._cost(seen.projection, plan.problem, plan.prior, shape)
        chance = probability(seen, plan.problem, found, plan.votes, odds)
        in_front = (seen.projection.in_front & (plan.prior > 0)).sum(-1) >= MIN_PAIRS
        ok = now.solved & in_front & (chance >= LEAST_PROBABILITY)
        return Refinement(now.state, weights, cost, ok, in_front, chance, found)

    def shown(self, plan: Plan, now: Progress) -> tuple[Plan, Progress]:
        """Fit a mixture to the residuals. Set estimated noise of points to 0 if that is clearly likelier."""
        problem, noise = plan.problem, plan.problem.noise
        if noise is None or noise.world_cov is not None:
            return plan, now._replace(mixture=plan.evidence_at(now.state).mixture)
        of_pixels = noise._replace(world=plan.world_sigma)
        both = map_tensors(lambda x, y: torch.cat((x.mT, y.mT), 1).mT, noise, of_pixels)
        state, problem, votes = repeat_problems((now.state, problem, plan.votes), 2)
        problem = problem._replace(noise=both)
        found = evidence(at_pose(state, problem, votes), problem, votes)
        batch = plan.prior.shape[0]
        first, second = found.likelihood.view(2, batch)
        other = (second > first + _EXPECTED).long()
        index = torch.add(torch.arange(batch, device=other.device), other, alpha=batch)
        noise, mixture = taken((both, found.mixture), index)
        mixture = map_tensors(lambda x: x[:, 0, None], mixture)  # strides as in later iterations: one compiled graph
        return plan._replace(problem=plan.problem._replace(noise=noise)), now._replace(mixture=mixture)

    def _iteration(self, problem: Problem, now: Progress, step: Tensor, damping: Tensor, shape: Tensor) -> Progress:
        """One iteration. With ``reject_worse``, a problem whose cost would rise keeps its state."""
        step, damping = (per_problem(x, problem.img_scale) for x in (step, damping))
        shape = per_problem(shape, problem.weights[:, :1])
        damping = damping * now.factor if self.reject_worse else damping
        projection, equations = self._by_kernel(now.state, problem, shape)
        state, solved = lm_step(equations, now.state, projection.focal, step, damping, additive=self.additive)
        if not self.reject_worse:
            return Progress(state, solved, now.factor)
        new = self._cost(project(state, problem), problem, problem.weights, shape)
        old = self._cost(projection, problem, problem.weights, shape)
        # At a minimum, costs differ only by rounding errors. The step is accepted, because rejection has no gradient.
        rounding = _ROUNDING * torch.finfo(new.dtype).eps
        better = new <= old * (1.0 + rounding) + (rounding * projection.focal).square()
        factor = torch.where(better, now.factor * _DAMPING_DOWN, now.factor * _DAMPING_UP)
        kept = map_tensors(lambda x, y: torch.where(better.view(-1, *(1,) * (x.ndim - 1)), x, y), state, now.state)
        return Progress(kept, solved, factor)

    def _by_kernel(self, state: State, problem: Problem, shape: Tensor) -> tuple[Projection, NormalEquations]:
        projection = project(state, problem)
        sq_residual, precision = information(projection, problem)
        robust = self.kernel.weight(sq_residual, shape)
        if problem.noise is None and problem.terms:  # sigma is one pixel of the caller
            robust = robust / _pixel(problem).square()[:, None]
        return projection, self._equations(projection, problem, robust, precision)

    def _equations(
        self, projection: Projection, problem: Problem, robust: Tensor, precision: Tensor | Symmetric2
    ) -> NormalEquations:
        """Sum the normal equations of the terms and of the weighted and whitened pairs."""
        robust = problem.weights * robust
        weights = map_tensors(lambda x: x * robust, precision)
        equations = normal_equations(projection, problem, weights, relative=True)
        for term in problem.terms:
            equations = add_term(equations, term.linearise(projection.state), projection.focal)
        return equations

    def _best(self, rivals: Problem, prior: Tensor, shape: Tensor, now: Progress) -> Progress:
        """For each problem, keep the state of lowest cost. ``rivals`` are the problems of all states in ``now``."""
        batch = prior.shape[0]
        projection = project(map_tensors(torch.Tensor.detach, now.state), rivals)
        cost = self._cost(projection, rivals, rivals.weights, shape.detach())
        best = (cost.view(-1, batch) if batch else cost[None]).argmin(0)  # (B,); at equal costs the first state
        index = torch.add(torch.arange(batch, device=best.device), best, alpha=batch)
        return taken(now, index)

    def _cost(self, projection: Projection, problem: Problem, prior: Tensor, shape: Tensor) -> Tensor:
        """Robust loss of pairs and terms, divided by the number of pairs with a positive weight, shape (B,)."""
        sq_residual, precision = information(projection, problem)
        # The mean precision of both coordinates converts the bound from square pixels to squared sigmas.
        most = (_MAX_RESIDUAL * projection.focal).square().reshape(-1, 1)
        most = most * (precision if isinstance(precision, Tensor) else 0.5 * (precision.uu + precision.vv))
        sq_residual = torch.where(projection.in_front, sq_residual.minimum(most), most)
        count = (problem.weights > 0).sum(-1).clamp(min=1)
        total = (prior * self.kernel.loss(sq_residual, shape)).sum(-1)
        unit = _pixel(problem).square() if problem.noise is None else 1.0  # `None`: sigma is one pixel of the caller
        for term in problem.terms:
            total = total + unit * term.loss(projection.state)
        return total / count

    def _with_gradient(self, plan: Plan, now: Progress, shape: Tensor) -> State:
        r"""Attach the gradient of the minimiser to a converged state, by the implicit function theorem.

        At the minimum, :math:`g = J^\top W r` is 0, so that :math:`d\delta = -(\partial g / \partial \delta)^{-1} dg`.
        Each added Newton step has this gradient and the value 0. The second step makes second derivatives exact. If the
        Newton matrix is not positive definite, the Gauss-Newton matrix replaces it. Noise of points makes the Newton
        matrix slightly asymmetric, which the solver ignores. With covariances, a third step removes most of this error.
        """

        def equations(problem: Problem, at: State, shape: Tensor) -> NormalEquations:
            if mixture is None:
                return self._by_kernel(at, problem, shape)[1]
            seen = at_pose(at, problem, plan.votes)
            robust = mixture.weights(seen) / mixture.variance
            return self._equations(seen.projection, problem, robust, seen.precision)

        mixture, state = now.mixture, now.state
        problem = plan.problem._replace(weights=plan.guided if mixture is None else plan.by_residual)
        zero = torch.zeros_like(state.pose.translation[:1, 0]).expand(6 + state.camera.shape[1], state.camera.shape[0])
        zero = zero.clone().requires_grad_()
        with torch.enable_grad():
            near = equations(problem.map(torch.Tensor.detach), moved(state, zero), shape.detach())
            hessian = [torch.autograd.grad(x.sum(), zero, retain_graph=True)[0] for x in near.gradient]
        matrix, around, none = torch.stack(hessian), near.matrix.detach(), shape.new_zeros(())
        focal = project(state, problem).focal.detach()
        for _ in range(3 if problem.noise is not None and problem.noise.covariances else 2):
            gradient = equations(problem, state, shape).gradient
            newton, convex = solve_positive(matrix, gradient, none)
            gauss_newton, solved = solve_positive(around, gradient, none)
            delta = torch.where(convex, newton, torch.where(solved, gauss_newton / focal, 0.0))
            state = moved(state, delta.detach() - delta)
        return state


def taken(tree: _T, index: Tensor) -> _T:
    """Select problems from every tensor of a tree, except scalars. The result has the layout of ``problems_last``."""

    def select(x: Tensor) -> Tensor:
        if not x.ndim or are_few(x):
            return x[index] if x.ndim else x
        return x.movedim(0, -1).index_select(-1, index).movedim(-1, 0)

    return map_tensors(select, tree)


def _pixel(problem: Problem) -> Tensor:
    """One pixel of the caller, at most `_LARGEST_PIXEL`, in the problem's pixels, shape (B,)."""
    return problem.img_scale.clamp(max=_LARGEST_PIXEL * problem.focal)


def _complete_noise(problem: Problem, starts: Starts) -> Noise | None:
    """Complete the noise of every pair. The initialiser gives the sigmas that the problem lacks.

    If the initialiser gives no noise, the mean of the problem's known sigmas of pixels replaces each unknown sigma of a
    pixel. The same holds for points. If no sigma is known, points get 0. Pixels get 1, as if no noise had been given,
    but with terms one pixel of the caller. If neither the problem nor the initialiser has noise, return ``None``.
    """
    given, guess = problem.noise, starts.noise
    if given is None:
        return None if guess is None else guess.bounded(problem.focal)
    if guess is None:
        pixel = (_pixel(problem) if problem.terms else torch.ones_like(problem.img_scale))[:, None]
        guess = Noise(_mean_known(given.img, pixel), _mean_known(given.world, torch.zeros_like(pixel)))
    noise = map_tensors(lambda x, y: torch.where(x.isnan(), y, x), given.sigmas, guess)
    return noise._replace(img_cov=given.img_cov, world_cov=given.world_cov).bounded(problem.focal)


def _mean_known(sigmas: Tensor, default: Tensor) -> Tensor:
    """The mean (B, 1) of the known sigmas (B, N) of each problem, or ``default`` (B, 1) if no sigma is known."""
    known = ~sigmas.isnan()
    count = known.sum(-1, keepdim=True)
    mean = torch.where(known, sigmas, 0.0).sum(-1, keepdim=True) / count.clamp(min=1)
    return torch.where(count > 0, mean, default)
