"""Results of training runs: report, validation, results file, and the summary of a sweep of runs."""

# ruff: noqa: UP013  (one line for each small mapping)
from __future__ import annotations

import json
import timeit
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, NotRequired

import torch
from torch import nn
from typing_extensions import TypedDict

from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.schema import STRICT, Count, Kept, read_json
from kornia_pnpnet.metrics import SuccessRate, pose_errors, success, success_rate
from kornia_pnpnet.pretrained import find_weights
from kornia_pnpnet.result import Problems
from kornia_pnpnet.solver import PnPNet
from kornia_pnpnet.training.checkpoint import write_csv

__all__ = [
    "RESULTS_NAME",
    "FitReport",
    "Learned",
    "RunResults",
    "ValidationResult",
    "find_results",
    "load_run",
    "run_results",
    "summarize_runs",
    "validate",
]

RESULTS_NAME = "results.json"
# Number of problems in a timed call, and number of timed calls. The shortest time is reported, because other work on
# the machine can only make a call slower.
_TIMED_PROBLEMS, _TIMED_CALLS = 1000, 10


@dataclass(frozen=True)
class FitReport:
    """Report of one call of :func:`~kornia_pnpnet.training.fit`.

    Attributes:
        start: number of updates in earlier calls.
        update: number of updates in earlier calls and this call.
        skipped: number of skipped steps in earlier calls and this call. See :func:`~kornia_pnpnet.training.fit`.
        interrupted: whether a signal ended the call early. In this case, the call saved a checkpoint.
        seconds: wall-clock time of this call.
        updates_per_second: average speed of this call.
        time_shares: share of ``seconds`` per stage: data (waiting for data), forward, backward, optimizer and rest.
        peak_memory_mib: on a GPU, the peak memory that PyTorch allocated. Otherwise the peak resident memory of this
            process, which is reported as 0 on Windows.
    """

    start: Count
    update: Count
    skipped: Count
    interrupted: bool
    seconds: float
    updates_per_second: float
    time_shares: dict[str, float]
    peak_memory_mib: float

    def __str__(self) -> str:
        shares = ", ".join(f"{stage} {100 * share:.0f} %" for stage, share in self.time_shares.items())
        speed = f"{self.updates_per_second:.1f} per second ({shares})"
        return f"{self.update} updates, {speed}, peak memory {self.peak_memory_mib:.0f} MiB, {self.skipped} skipped"


@dataclass(frozen=True)
class ValidationResult:
    """Success (rotation error below 1°, translation error below 0.2) and errors on one validation set.

    Fields with ``first_stage`` describe the initial poses. The other fields describe the refined poses. Translation
    errors are in the unit of the world.
    """

    success: SuccessRate
    first_stage_success: SuccessRate
    median_rotation_error_deg: float
    median_translation_error: float
    first_stage_median_rotation_error_deg: float
    first_stage_median_translation_error: float


class Learned(NamedTuple):
    """Learned hyperparameters of the refinement. Each list has one number per iteration."""

    step: list[float]
    damping: list[float]
    robustness: list[float]


# Each mapping declares the keys that this package reads. Other keys are allowed.
_Init = TypedDict("_Init", {"name": str})
_Refine = TypedDict("_Refine", {"m": Count})
_Size = TypedDict("_Size", {"n": Count})
_ModelConfig = TypedDict("_ModelConfig", {"init": _Init | None, "refine": _Refine})
_RunConfig = TypedDict("_RunConfig", {"name": NotRequired[Any], "model": _Size})
_RunEnvironment = TypedDict("_RunEnvironment", {"commit": str | None})
ModelConfig = Annotated[_ModelConfig, Kept]
RunConfig = Annotated[_RunConfig, Kept]
RunEnvironment = Annotated[_RunEnvironment, Kept]


@dataclass(frozen=True)
class RunResults:
    """Results of a training run.

    Attributes:
        overrides: arguments of ``train.py`` in the form ``key=value``.
        run: the report of the training.
        us_per_problem: time of the solver in microseconds per problem, in calls of at most 1000 problems.
        validation: success and errors on each validation set, by the name of the set. At least one set is needed.
        learned: learned hyperparameters of the refinement.
        model: configuration of the solver.
        config: resolved configuration of ``train.py``.
        environment: versions and machine, see :func:`~kornia_pnpnet.core.environment.environment`.
        origin: results of the run that trained the initial weights of this run; ``None`` for a run from scratch.

    Raises:
        ValueError: when ``validation`` is empty, or when a list of ``learned`` does not have one number per iteration.
    """

    __pydantic_config__: ClassVar = STRICT

    overrides: list[str]
    run: FitReport
    us_per_problem: float
    validation: dict[str, ValidationResult]
    learned: Learned
    model: ModelConfig
    config: RunConfig
    environment: RunEnvironment
    origin: RunResults | None = None

    def __post_init__(self) -> None:
        if not self.validation:
            raise ValueError("validation is empty, expected at least one validation set")
        iterations = max(1, self.model["refine"]["m"])
        if {len(values) for values in self.learned} != {iterations}:
            raise ValueError(f"learned does not have {iterations} numbers for each hyperparameter")

    @property
    def initializer(self) -> str | None:
        """Class name of the initialiser; ``None`` if the refinement starts from the identity."""
        return self.model["init"]["name"] if self.model["init"] else None

    @property
    def name(self) -> str:
        """Name of the run."""
        return str(self.config.get("name") or self.initializer or "PnPNet")

    def lineage(self) -> list[RunResults]:
        """The runs that trained the weights of this run, in order. The last entry is this run."""
        return [*(self.origin.lineage() if self.origin else ()), self]


@torch.no_grad()
def validate(model: nn.Module, validation: Mapping[str, Problems]) -> dict[str, ValidationResult]:
    """Solve the problems of each validation set, and map the name of the set to a summary of the errors."""
    results = {}
    for name, problems in validation.items():
        result = model(*problems[:3], **problems.known)
        refined, first = (pose_errors(pose, problems.pose) for pose in (result.pose, result.init))
        rates = success_rate(success(refined)), success_rate(success(first))
        results[name] = ValidationResult(*rates, *(part.median().item() for part in (*refined, *first)))
    return results


@torch.no_grad()
def run_results(
    model: PnPNet,
    validation: Mapping[str, Problems],
    report: FitReport,
    config: Any,
    overrides: list[str],
    origin: RunResults | None = None,
) -> RunResults:
    """Measure a trained solver and gather the :class:`RunResults` of its run. At least one validation set is needed."""
    *_, last = validation.values()
    part = last.map(lambda x: x[:_TIMED_PROBLEMS])
    seconds = timeit.repeat(lambda: model(*part[:3], **part.known), repeat=_TIMED_CALLS, number=1)
    learned = model.refine.hyperparameters(torch.zeros((), dtype=torch.float64))
    model_config: Any = model.config()
    made_with: Any = environment()
    return RunResults(
        overrides=overrides,
        run=report,
        us_per_problem=1e6 * min(seconds) / len(part.world_points),
        validation=validate(model, validation),
        learned=Learned(*(values.tolist() for values in learned)),
        model=model_config,
        config=json.loads(json.dumps(config), parse_constant=str),  # JSON has no infinity
        environment=made_with,
        origin=origin,
    )


def load_run(path: str | Path) -> RunResults:
    """Read the results file of a run.

    Raises:
        FileNotFoundError: when the file does not exist.
        ValueError: when the file does not hold the results of a run. The message names the invalid entry.
    """
    return read_json(path, RunResults, "a results file of a run")


def find_results(weights: str | Path) -> RunResults | None:
    """Load the results of the run that trained the given weights. Return ``None`` if there is no results file.

    The file is in the folder of the weights. If this folder is named ``weights``, its parent folder is searched, too.
    For the argument and the errors see :func:`~kornia_pnpnet.pretrained.find_weights` and :func:`load_run`.
    """
    folder = find_weights(weights)
    # `train.py` writes weights into the folder `weights` of a run. Parents of other folders can hold unrelated results.
    folders = [folder, folder.parent] if folder.name == "weights" else [folder]
    paths = (place / RESULTS_NAME for place in folders)
    return next((load_run(path) for path in paths if path.is_file()), None)


def summarize_runs(folder: str | Path) -> Path | None:
    """Write ``summary.csv``: one row with overrides, speed and success for each run in a sub-folder of ``folder``.

    A results file that cannot be read is left out with a warning.

    Returns:
        Path of the summary, or ``None`` when no run has results.
    """
    folder = Path(folder)
    rows: list[dict[str, Any]] = []
    overrides: dict[str, None] = {"run": None}  # the first columns of the summary
    for path in sorted(folder.glob(f"**/{RESULTS_NAME}")):
        try:
            results = load_run(path)
        except ValueError as error:
            warnings.warn(f"Left out of the summary: {error}", stacklevel=2)
            continue
        row = {"run": str(path.parent.relative_to(folder))}
        row |= dict(override.lstrip("+").partition("=")[::2] for override in results.overrides)
        overrides |= dict.fromkeys(row)
        for key in ("update", "skipped", "updates_per_second", "peak_memory_mib"):
            row[key] = getattr(results.run, key)
        row["us_per_problem"] = f"{results.us_per_problem:.4g}"
        for name, entry in results.validation.items():
            row |= {f"{name}/{bound}": f"{getattr(entry.success, bound):.4f}" for bound in ("rate", "low", "high")}
        rows.append(row)
    if not rows:
        return None
    # The file is written atomically, because parallel runs may write the summary at the same time.
    write_csv(folder / "summary.csv", overrides | dict.fromkeys(key for row in rows for key in row), rows)
    return folder / "summary.csv"
