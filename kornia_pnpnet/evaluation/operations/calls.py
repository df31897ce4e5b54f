"""Which parts a solver runs, how often, and on how many pairs."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from kornia.core.exceptions import ValueCheckError
from torch import nn

from kornia_pnpnet.core.checks import check_whole
from kornia_pnpnet.evaluation.operations.parts import PARTS
from kornia_pnpnet.init import P3P, RANSAC, EPnP, MLPInit, REPPnP, SetInit, SubsetSolver
from kornia_pnpnet.init.epnp.epnp import CASE_ITERATIONS
from kornia_pnpnet.init.ransac.ransac import FINAL_STEPS
from kornia_pnpnet.init.ransac.sampling import samples_needed
from kornia_pnpnet.init.ransac.scoring import SCORERS
from kornia_pnpnet.init.ransac.search import GROWTH
from kornia_pnpnet.init.set import MOST_JUDGES
from kornia_pnpnet.refine.lm import RobustWeightedLM
from kornia_pnpnet.solver import PnPNet

__all__ = ["part_calls"]

#: A part, how often it is called for each problem, and its sizes.
Call = tuple[str, float, tuple[int, ...]]


def _step_calls(n: int, times: float) -> Iterator[Call]:
    """One step of Levenberg-Marquardt."""
    yield "lm._relative", times, (n,)
    yield "geometry.normal_equations", times, (n,)
    yield "lm.lm_step", times, ()
    yield "lm.solve_damped", times, ()
    yield "geometry.move", times, ()


def _lm_calls(lm: RobustWeightedLM, n: int, times: float = 1, starts: int = 1, noise: bool = False) -> Iterator[Call]:
    """A refinement, of several starts until they are compared, whose guess may know the noise."""
    weight, loss = (f"robust.{function.__name__}" for function in (lm.kernel.weight, lm.kernel.loss))
    if lm.additive or lm.reject_worse or weight not in PARTS:
        raise ValueCheckError(f"There is no formula for {lm}: it needs the retraction, no rejection, another kernel.")
    iterations = lm.m + (starts - 1) * lm.compared_at
    compared = starts if starts > 1 else 0
    by_residual = lm.by_residual > 0
    # By residual the noise is corrected before its pairs are weighed again, in iterations and at the end.
    corrected = lm.by_residual if noise else 0
    factors = corrected + 1 if corrected else 0
    yield "lm._iterate", (iterations - corrected) * times, (n, noise, False)
    yield "lm._iterate", corrected * times, (n, noise, True)
    yield "lm._variance_factor", factors * times, (n,)
    yield from _step_calls(n, iterations * times)
    yield "geometry.project", (iterations + compared + 1) * times, (n,)
    yield "geometry.pixel_variance", noise * (iterations + compared + 2) * times, (n, n)
    yield weight, (iterations + 1 + factors) * times, (n,)
    yield "lm.RobustWeightedLM._cost", (compared + 1) * times, (n, noise)
    yield loss, (compared + 1) * times, (n,)
    yield "lm.RobustWeightedLM.begin", times, (n, by_residual)
    yield "lm.RobustWeightedLM.finish", times, (n, noise, by_residual)
    yield "lm.explains", (not noise) * times, (n,)
    if compared:
        yield "lm.RobustWeightedLM.choose", times, (starts,)


def _epnp_calls(epnp: EPnP, n: int, times: float) -> Iterator[Call]:
    for part in ("epnp.EPnP.forward", "control_points.control_points", "depths.depth_system", "epnp.best_case"):
        yield part, times, (n,)
    yield "depths.four_cases", times, ()
    yield "depths.minimize", times, (4, CASE_ITERATIONS)
    yield "depths.minimize", times, (1, epnp.iterations - CASE_ITERATIONS)  # in the best case
    yield "small.nearest_rotation", times, ()


def _reppnp_calls(reppnp: REPPnP, n: int, times: float) -> Iterator[Call]:
    null, rigid = (reppnp.null_iterations, reppnp.rigid_iterations) if reppnp.reject_outliers else (0, 0)
    steps = 1 + rigid + reppnp.refine_iterations
    yield "reppnp.REPPnP.forward", times, (n, reppnp.refine_iterations)
    yield "control_points.control_points", times, (n,)
    yield "reppnp._aligned", times, (n,)
    yield "reppnp._null_vector", (null + 1) * times, (n,)
    yield "reppnp._null_error", null * times, (n,)
    yield "reppnp._rigid_error", rigid * times, (n,)
    yield "reppnp.REPPnP._keep", (null + rigid) * times, (n,)
    yield "reppnp._linearize", steps * times, (n,)
    yield "reppnp._normal_matrix", (steps + rigid) * times, (n,)
    yield "small.nearest_rotation", times, ()
    yield "reppnp._step", steps * times, ()
    yield "geometry.move", steps * times, ()


def _ransac_calls(ransac: RANSAC, n: int, outliers: int | None, better: int | None) -> Iterator[Call]:
    plan, minimal = ransac.plan, ransac.minimal
    size, slots = minimal.sample_size, 4 if isinstance(minimal, P3P) else 1
    if plan.scorer not in SCORERS.values():
        raise ValueCheckError(f"There is no formula for the scorer {ransac.config['scorer']}.")
    rounds = _rounds(ransac, n, outliers)
    better = len(rounds) if better is None else better
    for samples in rounds:
        kept = min(plan.local_candidates, samples * slots)
        drawn = math.comb(n, size) > plan.max_samples
        yield "search.Search._best_of_samples", 1, (samples, size, slots, kept, drawn)
        yield "search.Search._rank", 1, (n, samples * slots, kept)
    match minimal:
        case P3P():
            yield "p3p.P3P.hypotheses", sum(rounds), ()
            yield "p3p.p3p", sum(rounds), ()
        case SubsetSolver(init=init, refine=refine):
            yield from _init_calls(init, size, sum(rounds))
            yield from _lm_calls(refine, size, sum(rounds)) if refine is not None else ()
            yield "ransac.SubsetSolver.hypotheses", sum(rounds), (_says_ok(init),)
        case _:
            raise ValueCheckError(f"There is no formula for samples solved by {type(minimal).__name__}.")
    # The best poses of a round take one step, the best of them the others; then the final ones.
    poses = min(plan.local_candidates, rounds[0] * slots)
    steps = poses + plan.local_iterations - 1
    yield "search.Search._improve", better, (poses,)
    yield "search.Search._descend", better * steps, (n,)
    yield from _step_calls(n, better * steps + FINAL_STEPS)
    yield "geometry.project", better * (steps + 1) + FINAL_STEPS + 1, (n,)
    yield "search.Search.run", 1, (n, size, len(rounds), better)
    yield "ransac.RANSAC.forward", 1, (n,)


def _rounds(ransac: RANSAC, n: int, outliers: int | None) -> list[int]:
    """Samples in each round: at least as many as the rule asks for, each a share of what came before it or more."""
    plan, size = ransac.plan, ransac.minimal.sample_size
    total = min(math.comb(n, size), plan.max_samples)
    if total == 0:
        raise ValueCheckError(f"Samples of {size} pairs need at least as many, got n = {n}.")
    needed = float(total)
    if outliers is not None:
        inliers, count = torch.tensor(n - outliers), torch.tensor(n)
        needed = max(plan.min_samples, samples_needed(inliers, count, size, plan.confidence).item())
    rounds: list[int] = []
    while (done := sum(rounds)) < total and (done < needed or not rounds):
        rounds.append(min(max(plan.min_samples, int(GROWTH * done)), plan.chunk_size, total - done))
    return rounds


def _says_ok(init: nn.Module | None) -> bool:
    """Whether an initialiser may say that it has no guess."""
    return not isinstance(init, MLPInit | SetInit | None)


def _set_calls(init: SetInit, n: int, times: float) -> Iterator[Call]:
    """A set network that is not told the noise, and its samples."""
    sizes = (init.config[key] for key in ("width", "layers", "hidden", "starts"))
    yield "set._View.__init__", times, (n,)
    yield "set.SetInit._run", times, (n, *sizes)
    yield "set.SetInit.forward", times, (n, init.starts)
    yield "small.nearest_rotation", init.starts * times, ()
    yield "set.SetInit._noise", times, (n,)
    if not init.samples:
        return
    samples = init.triples(n)
    judges, drawn = min(MOST_JUDGES, n), sum(map(len, samples.values()))
    yield "set.SetInit._sampled", times, (n, judges, drawn, len(samples))
    yield "p3p.p3p", drawn * times, ()
    yield "geometry.project", 4 * drawn * times, (judges,)
    yield "geometry.pixel_variance", times, (4 * drawn * judges, judges)


def _init_calls(init: nn.Module | None, n: int, times: float = 1) -> Iterator[Call]:
    match init:
        case None:
            yield "model.PnPNet._given", times, ()
            yield "normalize.Normalize.apply_to_pose", times, ()
        case MLPInit():
            yield "mlp.MLPInit.forward", times, (n,)
        case EPnP():
            yield from _epnp_calls(init, n, times)
        case SetInit():
            yield from _set_calls(init, n, times)
        case REPPnP():
            yield from _reppnp_calls(init, n, times)
        case _:
            raise ValueCheckError(f"There is no formula for {type(init).__name__}.")


def part_calls(solver: PnPNet, n: int, *, outliers: int | None = None, better: int | None = None) -> Iterator[Call]:
    """What a solver runs for one problem of n pairs.

    Args:
        solver: the solver. A network counts as one that is built for n pairs.
        n: number of pairs.
        outliers: how many pairs are wrong, for the rule by which RANSAC stops; it draws all its samples when ``None``.
        better: how many rounds of RANSAC find a better pose; every one when ``None``.

    Returns:
        Names of :data:`PARTS`, how often each is called, and with which sizes.

    Raises:
        ValueCheckError: when there is no formula for the solver, or RANSAC's samples have more than n pairs.
        BaseError: for no pairs, or more wrong ones than there are.
    """
    check_whole(1, n=n)
    if outliers is not None:
        check_whole(0, outliers=outliers, inliers=n - outliers)
    normalize = solver.normalize
    if not (normalize.center and normalize.scale):
        raise ValueCheckError(f"There is no formula for {normalize}: the world has to be centred and scaled.")
    yield "normalize.Normalize.forward", 1, (n, normalize.order)
    views = solver.views if solver.refine.m and solver.init is not None else 1
    if views > 1:
        yield "normalize.Normalize.views", 1, (n, views, normalize.order)
        yield "normalize.Normalize.undo_views", 1, (views,)
        if not isinstance(solver.init, MLPInit):
            raise ValueCheckError(f"There is no formula for views of {type(solver.init).__name__}.")
    if isinstance(solver.init, RANSAC):
        yield from _ransac_calls(solver.init, n, outliers, better)
    else:
        yield from _init_calls(solver.init, n, views)
    noise, starts = False, views
    if isinstance(solver.init, SetInit):
        noise, starts = True, solver.init.starts + (solver.init.samples > 0)
    yield "model.PnPNet._guess", 1, (n, noise)
    yield from _lm_calls(solver.refine, n, starts=starts, noise=noise)
    yield "normalize.Normalize.undo", 2, ()
    yield "model.PnPNet._result", 1, (n, _says_ok(solver.init), noise)
    if noise:
        yield "geometry.project", 1, (n,)
        yield "model._is_no_chance", 1, (n,)
