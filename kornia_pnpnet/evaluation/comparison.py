"""Comparison of solvers: all solvers solve the same problems, and a results file holds the errors and the times."""

from __future__ import annotations

import json
import math
import statistics
import time
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from kornia.core.exceptions import ShapeError, ValueCheckError
from torch import nn

from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.files import digest
from kornia_pnpnet.core.trees import iter_tensors, map_tensors, take
from kornia_pnpnet.data.stream import ProblemSource
from kornia_pnpnet.evaluation.results import FORMAT, resume, row_errors, save_results, source_digest
from kornia_pnpnet.metrics import pose_errors, success, success_rate
from kornia_pnpnet.peers import PeerSolver
from kornia_pnpnet.result import PnPResult, Pose, Problems, sound_pose
from kornia_pnpnet.solver import PnPNet

__all__ = ["EvaluationData", "SeesTruth", "draw_problems", "evaluate"]

# Rotation in place of a missing pose: half a turn about the axis (1, 2, 3), which no true pose is expected to be.
_NO_ROTATION = ((-6 / 7, 2 / 7, 3 / 7), (2 / 7, -3 / 7, 6 / 7), (3 / 7, 6 / 7, 2 / 7))
_QUARTILES = {"q25": 0.25, "median": 0.5, "q75": 0.75}
# Entries of the environment that may differ between the rows of a results file. Versions of packages must be equal.
_MACHINE = ("python", "platform", "cpu", "threads", "gpu", "commit")


class EvaluationData(NamedTuple):
    """A set of problems in one batch, and the limits of a success."""

    problems: Problems  #: The problems.
    max_rotation_deg: float = 1.0  #: Limit of the rotation error in degrees.
    max_translation: float = 0.2  #: Limit of the translation error in the unit of the world.
    unit: str = "m"  #: Name of the unit of the world.
    description: Mapping[str, Any] = {}  #: Plain data about the source of the problems, for the results file.


@runtime_checkable
class SeesTruth(Protocol):
    """A bound is a module to which :func:`evaluate` passes the true poses and inliers."""

    def solve_with_truth(self, problems: Problems) -> PnPResult:
        """Solve problems with the help of their true poses and inliers."""


def draw_problems(source: ProblemSource, count: int) -> Problems:
    """Take the first ``count`` problems of a source, from batch 0 on. Raise ``ValueError`` for a count below 1.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> draw_problems(SyntheticProblems(batch_size=4), count=6).world_points.shape
        torch.Size([6, 9, 3])
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}.")
    first = source.batch(0)
    more = (source.batch(index) for index in range(1, math.ceil(count / len(first.world_points))))
    return map_tensors(lambda *parts: torch.cat(parts)[:count], first, *more)


def evaluate(
    solvers: Mapping[str, nn.Module],
    data: Mapping[str, EvaluationData],
    *,
    path: str | Path | None = None,
    overwrite: bool = False,
    chunk: int = 1000,
    repeats: int = 3,
) -> dict[str, Any]:
    """Solve the same problems with every solver.

    A pose that is not finite, or the identity of a solver that found no pose, counts as half a turn about (1, 2, 3);
    ``ok`` is false. Summaries are computed from errors that are rounded to six significant digits. The results file is
    written after every row. A call with the same arguments, or with further solvers and data sets, continues the file.
    The file of any other evaluation is refused. A module of your own that has options needs ``config``, a dictionary of
    the options or a function that returns it. Without ``config``, rows that were measured with other options are kept.

    Args:
        solvers: solvers by name, called as ``solver(world_points, img_points, intrinsics)`` in evaluation mode without
            gradients. A :class:`~kornia_pnpnet.solver.PnPNet` also gets :attr:`~kornia_pnpnet.result.Problems.known`.
            For bounds see :class:`SeesTruth`.
        data: sets of problems by name. Each set is solved on the device and in the dtype of its problems.
        path: the results file; ``None`` writes no file.
        overwrite: replace the file at ``path`` instead of continuing it.
        chunk: number of problems per call of a solver. A smaller number takes less memory.
        repeats: smallest number of timed calls. One untimed call precedes the timed calls.

    Returns:
        Plain data: ``format``, ``code`` (digest of the package), ``environment`` (see
        :func:`~kornia_pnpnet.core.environment.environment`), ``solvers`` (class, configuration, digest of the weights),
        ``data`` (description, limits, digest), ``rows``, and ``left_out`` (``data``, ``solver`` and ``reason`` for each
        set that a solver refuses).

        The row of a set and a solver has ``success`` (rate, low, high, total), ``rotation_error_deg`` and
        ``translation_error`` (quartiles), ``ok`` (share), ``us_per_problem`` (median of the timed calls; for a peer the
        time of the library alone), ``per_problem`` (errors and ok) and possibly ``environment`` (entries that
        differ from the file's entries).

    Raises:
        ValueError: when ``path`` is not a results file, or holds another evaluation.
        OSError: when ``path`` cannot be written.

    Example:
        >>> from kornia_pnpnet import create_solver
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> data = {"synthetic": EvaluationData(SyntheticProblems(n=9, batch_size=100, seed=0).batch(0))}
        >>> row = evaluate({"mine": create_solver("epnp-lm")}, data, repeats=1)["rows"][0]
        >>> row["success"]["total"], row["success"]["rate"] > 0.5
        (100, True)
    """
    from tqdm import tqdm

    here = environment()
    results: dict[str, Any] = {
        "format": FORMAT,
        "environment": here,
        "code": source_digest(),
        "solvers": {name: _describe_solver(solver) for name, solver in solvers.items()},
        "data": {name: {**_describe_data(entry), "chunk": chunk} for name, entry in data.items()},
        "rows": [],
    }
    if path is not None and not overwrite:
        results = resume(results, path)
    results["left_out"] = []
    elsewhere = {key: here[key] for key in _MACHINE if results["environment"].get(key) != here[key]}
    if path is not None:
        save_results(results, path)  # a file that cannot be written fails here, before the work

    plan = list(product(data, solvers))
    done = {(row["data"], row["solver"]): row for row in results["rows"]}
    missing = [names for names in plan if names not in done]
    for names in tqdm(missing, disable=None, unit="run"):  # without a terminal, there is no progress bar
        row: dict[str, Any] = dict(zip(("data", "solver"), names, strict=True))
        try:
            row |= _measure(solvers[row["solver"]], data[row["data"]], chunk, repeats)
        except (ShapeError, ValueCheckError) as error:
            results["left_out"].append({**row, "reason": str(error).splitlines()[0]})
        except Exception as error:
            error.add_note(f"{row['solver']} on {row['data']}")
            raise
        else:
            done[names] = row | ({"environment": elsewhere} if elsewhere else {})
            results["rows"] = [done[names] for names in plan if names in done]
        if path is not None:
            save_results(results, path)
    return results


def _describe_solver(solver: nn.Module) -> dict[str, Any]:
    config = getattr(solver, "config", None)
    config = config() if callable(config) else config
    state = list(iter_tensors(list(solver.state_dict().values())))
    return {
        "class": type(solver).__name__,
        "config": config if isinstance(config, dict) else None,
        "weights": digest(*state) if state else None,
    }


def _describe_data(entry: EvaluationData) -> dict[str, Any]:
    problems = entry.problems
    # The digest uses float32 numbers, because the last bits of float64 numbers differ between machines.
    rounded = problems.map(lambda part: part.float() if part.is_floating_point() else part)
    return {
        "description": dict(entry.description),
        "count": len(problems.world_points),
        "n": problems.world_points.shape[1],
        "mean_outliers": _rounded((~problems.inliers).sum(-1).double().mean().item()),
        "max_rotation_deg": entry.max_rotation_deg,
        "max_translation": entry.max_translation,
        "unit": entry.unit,
        "dtype": str(problems.world_points.dtype).removeprefix("torch."),
        "device": problems.world_points.device.type,
        "digest": digest(*iter_tensors(rounded)),
    }


@torch.no_grad()
def _measure(solver: nn.Module, entry: EvaluationData, chunk: int, repeats: int) -> dict[str, Any]:
    """Solve a set and return its row without the names of the set and the solver."""
    problems, modes = entry.problems, [(part, part.training) for part in solver.modules()]
    chunks = [take(problems, slice(i, i + chunk)) for i in range(0, len(problems.world_points), chunk)]
    solver.eval()
    try:
        _solve(solver, chunks[0])
        calls = [_solve(solver, chunks[i % len(chunks)]) for i in range(max(repeats, len(chunks)))]
    finally:
        for part, mode in modes:
            part.training = mode
    # The time of a smaller last chunk is left out, because the fixed cost of a call would raise the time per problem.
    full = len(chunks[0].world_points)
    seconds = statistics.median(elapsed / full for result, elapsed in calls if len(result.ok) == full)
    found = [(result.pose, result.ok) for result, _ in calls[: len(chunks)]]
    pose, ok = map_tensors(lambda *parts: torch.cat(parts), *found)
    pose, truth = map_tensors(lambda part: part.double().cpu(), (pose, problems.pose))
    finite = pose.matrix.isfinite().all((1, 2))
    ok = ok.cpu() & finite
    pose = sound_pose(pose, finite)
    # Solvers return the identity if they find no pose. This must not be a success where the true pose is the identity.
    none = ~ok & (pose.matrix == torch.eye(4).to(pose.rotation)).all((1, 2))
    rotation = torch.where(none[:, None, None], pose.rotation.new_tensor(_NO_ROTATION), pose.rotation)
    errors = pose_errors(Pose(rotation, pose.translation), truth)

    lists = {name: values.tolist() for name, values in errors._asdict().items()}
    per_problem = _rounded({**lists, "ok": ok.int().tolist()})
    errors, ok = row_errors({"per_problem": per_problem})
    rate = success_rate(success(errors, entry.max_rotation_deg, entry.max_translation))
    row: dict[str, Any] = {"success": rate._asdict()}
    for name, values in errors._asdict().items():
        row[name] = {key: values.quantile(share).item() for key, share in _QUARTILES.items()}
    row |= {"ok": ok.double().mean().item(), "us_per_problem": 1e6 * seconds}
    return {**_rounded(row), "per_problem": per_problem}


def _solve(solver: nn.Module, problems: Problems) -> tuple[PnPResult, float]:
    """Solve the problems, and return the result and the seconds: elapsed, or those of a library's own calls."""
    device = problems.world_points.device
    start = _now(device)
    if isinstance(solver, SeesTruth):
        result = solver.solve_with_truth(problems)
    else:
        result = solver(*problems[:3], **(problems.known if isinstance(solver, PnPNet) else {}))
    return result, solver.library_s if isinstance(solver, PeerSolver) else _now(device) - start


def _now(device: torch.device) -> float:
    """Wait until the device has done its work, and return the time in seconds."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def _rounded(value: Any) -> Any:
    """Round the floats of nested data to six significant digits, so that results files stay small."""
    return json.loads(json.dumps(value), parse_float=lambda digits: float(f"{float(digits):.6g}"))
