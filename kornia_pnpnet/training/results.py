"""The results file of a training run: success, learned hyperparameters, speed, and how to repeat the run."""

# ruff: noqa: UP013  (one line for each small mapping)
from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, NotRequired, cast

import torch
from typing_extensions import TypedDict

from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.schema import STRICT, Count, Kept, read_json
from kornia_pnpnet.pretrained import find_weights
from kornia_pnpnet.result import Problems
from kornia_pnpnet.solver import PnPNet
from kornia_pnpnet.training.run import FitReport
from kornia_pnpnet.training.validation import ValidationResult, validate

__all__ = ["RESULTS_NAME", "Learned", "RunResults", "find_results", "load_run", "run_results"]

RESULTS_NAME = "results.json"
# Problems of a timed call, and timed calls. The shortest call counts, since other work on the machine only adds time.
_TIMED_PROBLEMS, _TIMED_CALLS = 1000, 20


class Learned(NamedTuple):
    """Learned hyperparameters of the refinement, one number for each iteration."""

    step: list[float]
    damping: list[float]
    robustness: list[float]


# The keys that model cards and summaries read; the mappings have more.
_Init = TypedDict("_Init", {"name": str})
_Refine = TypedDict("_Refine", {"m": Count})
_Size = TypedDict("_Size", {"n": Count})
_ModelConfig = TypedDict("_ModelConfig", {"init": _Init | None, "refine": _Refine})
_RunConfig = TypedDict("_RunConfig", {"name": NotRequired[Any], "model": _Size})
_RunEnvironment = TypedDict("_RunEnvironment", {"commit": str | None})

#: What :meth:`PnPNet.config` returned.
ModelConfig = Annotated[_ModelConfig, Kept]
#: The resolved configuration of ``train.py``.
RunConfig = Annotated[_RunConfig, Kept]
#: What :func:`~kornia_pnpnet.core.environment.environment` returned during the run.
RunEnvironment = Annotated[_RunEnvironment, Kept]


@dataclass(frozen=True)
class RunResults:
    """Results of a training run.

    Attributes:
        overrides: arguments of ``train.py``, ``key=value``.
        run: the report of the training.
        us_per_problem: time of the solver per problem in microseconds, in calls of 1000 problems.
        validation: success and errors on each validation set, at least one.
        learned: hyperparameters of the refinement.
        model: configuration of the solver.
        config: resolved configuration of ``train.py``.
        environment: versions and machine.
        origin: results of the run whose weights this run began with; ``None`` for a run from scratch.

    Raises:
        ValueError: when there is no validation set, or the hyperparameters do not fit the model.
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
        """Check what the types do not say."""
        if not self.validation:
            raise ValueError("validation is empty, expected at least one validation set")
        iterations = max(1, self.model["refine"]["m"])
        if {len(values) for values in self.learned} != {iterations}:
            raise ValueError(f"learned does not have {iterations} numbers for each hyperparameter")

    @property
    def initializer(self) -> str | None:
        """Class of the initialiser; ``None`` for a start from the identity."""
        return self.model["init"]["name"] if self.model["init"] else None

    @property
    def name(self) -> str:
        """Name of the run."""
        return str(self.config.get("name") or self.initializer or "PnPNet")

    def lineage(self) -> list[RunResults]:
        """The runs that led to these weights, the first run first and this run last."""
        return [*(self.origin.lineage() if self.origin else ()), self]


@torch.no_grad()
def run_results(
    model: PnPNet,
    validation: Mapping[str, Problems],
    report: FitReport,
    config: Mapping[str, Any],
    overrides: list[str],
    origin: RunResults | None = None,
) -> RunResults:
    """Measure a trained solver and gather the :class:`RunResults` of its run, whose arguments these are.

    Raises:
        ValueError: when there is no validation set.
    """
    if not validation:
        raise ValueError("The results of a run need at least one validation set, got none.")
    learned = model.refine.hyperparameters(torch.zeros((), dtype=torch.float64))
    return RunResults(
        overrides=overrides,
        run=report,
        us_per_problem=_us_per_problem(model, [*validation.values()][-1]),
        validation=validate(model, validation),
        learned=Learned(*(values.tolist() for values in learned)),
        model=cast(ModelConfig, model.config()),
        config=cast(RunConfig, config),
        environment=cast(RunEnvironment, environment()),
        origin=origin,
    )


def _us_per_problem(model: PnPNet, problems: Problems) -> float:
    part = problems.map(lambda x: x[:_TIMED_PROBLEMS])
    seconds = []
    for _ in range(_TIMED_CALLS):
        began = time.perf_counter()
        model(part.world_points, part.img_points, part.intrinsics, **part.known)
        seconds.append(time.perf_counter() - began)
    return 1e6 * min(seconds) / len(part.world_points)


def load_run(path: str | Path) -> RunResults:
    """Read the results file of a run.

    Raises:
        FileNotFoundError: when there is no such file.
        ValueError: when the file does not hold the results of a run; the message names the wrong entry.
    """
    return read_json(path, RunResults, "a results file of a run")


def find_results(weights: str | Path) -> RunResults | None:
    """Find the results of the run that trained some weights; ``weights`` is what ``PnPNet.from_pretrained`` takes.

    Returns:
        The results, or ``None`` when there is no results file beside the weights or, for a folder named ``weights``,
        in the folder above.

    Raises:
        FileNotFoundError: when there are no such weights.
        ValueError: see :func:`load_run`.
    """
    folder = find_weights(weights)
    # `train.py` writes weights into the folder `weights` of a run. Above another folder the file is of something else.
    folders = [folder, folder.parent] if folder.name == "weights" else [folder]
    paths = (place / RESULTS_NAME for place in folders)
    return next((load_run(path) for path in paths if path.is_file()), None)
