"""The training loop, on one process or several.

Lightning Fabric carries devices and processes. The package adds the ramp of the loss, steps that are skipped when they
are not finite, and a run that can be stopped at any moment and continued to the same numbers.
"""

from __future__ import annotations

import shutil
import timeit
from collections.abc import Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import torch
from kornia.core.check import KORNIA_CHECK
from lightning_fabric import Fabric
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from kornia_pnpnet.core.checks import check_positive
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.data.stream import ProblemSource, stream_batches
from kornia_pnpnet.losses import PoseLoss, SetLoss
from kornia_pnpnet.propose.mlp import MLPInit
from kornia_pnpnet.refine.lm import RobustWeightedLM
from kornia_pnpnet.result import Problems
from kornia_pnpnet.solver import PnPNet
from kornia_pnpnet.training.checkpoint import CHECKPOINT_NAME, HISTORY_NAME, stop_on_signal
from kornia_pnpnet.training.results import FitReport
from kornia_pnpnet.training.run import Run, TrainSettings

__all__ = ["fit", "train_briefly"]


def fit(
    model: PnPNet,
    data: ProblemSource,
    validation: Mapping[str, Problems],
    loss: PoseLoss | SetLoss,
    settings: TrainSettings,
    folder: str | Path,
    *,
    fabric: Fabric | None = None,
    identity: Mapping[str, Any] | None = None,
    data_workers: int = 0,
    resume: bool = False,
    progress: bool = True,
) -> FitReport:
    r"""Train a solver.

    Writes ``last.ckpt``, ``history.csv`` and ``tensorboard/`` into ``folder``. SIGTERM and Ctrl-C save a checkpoint and
    return. A step whose loss or gradient is not finite is skipped and counted.

    Args:
        model: the solver, trained in place.
        data: source of the problems; batch ``i`` is used for update ``i``.
        validation: fixed problems by the name of their set.
        loss: compares results with true poses.
        settings: numbers of the run.
        folder: folder of the run.
        fabric: the launched engine; one process on the CPU when ``None``.
        identity: plain data that must be equal when the run is continued, for example the configuration of the data.
        data_workers: processes that draw the next batches, for each process that trains, see
            :func:`~kornia_pnpnet.data.stream.stream_batches`.
        resume: continue from the checkpoint in ``folder`` if there is one.
        progress: show a progress bar.

    Returns:
        The report of this call.

    Raises:
        TrainingError: when ``folder`` holds a checkpoint and ``resume`` is false, when the checkpoint is damaged or of
            other settings or options of the solver, or when more than ``settings.max_skipped`` steps were not finite.
        BaseError: when the batch cannot be divided equally among the processes.
    """
    if fabric is None:
        fabric = Fabric(accelerator="cpu", devices=1)
    KORNIA_CHECK(
        data.batch_size % fabric.world_size == 0,
        f"A batch of {data.batch_size} cannot be shared equally among {fabric.world_size} processes.",
    )
    run = Run(model, loss, validation, settings, Path(folder), fabric, identity or {}, resume)
    part = slice(fabric.global_rank, None, fabric.world_size)  # all processes together have the batch of one process
    hidden = not (progress and fabric.is_global_zero)
    bar = tqdm(total=settings.updates, initial=run.start, disable=hidden, unit="update")
    batches = stream_batches(data, run.start, settings.updates, data_workers)
    with stop_on_signal() as stop, closing(batches), bar, logging_redirect_tqdm():
        while not (run.finished or run.interrupted):
            run.clock.lap("rest")
            problems = next(batches).map(lambda x: x[part].to(fabric.device))
            run.clock.lap("data")
            step = run.step(problems, stop)
            bar.update()
            validates = run.finished or run.update % settings.validate_every == 0
            if validates or run.update % settings.log_every == 0:
                run.log(step, validates)
                bar.set_postfix_str(run.rates)
            if run.finished or run.interrupted or run.update % settings.checkpoint_every == 0:
                run.save()
    return run.report()


def train_briefly(seconds: float, folder: str | Path, *, progress: bool = True) -> Path:
    """Train a new PnP-Net for n = 9 for a short time, to show that training works on this machine.

    Args:
        seconds: approximate duration. The speed of the machine is measured first.
        folder: folder of the run. A run in this folder is replaced.
        progress: show a progress bar.

    Returns:
        Path of the learning curves, a CSV file.

    Raises:
        BaseError: when ``seconds`` is not a positive number.
    """
    check_positive(seconds=seconds)
    folder = Path(folder)
    for name in (CHECKPOINT_NAME, HISTORY_NAME):
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / "tensorboard", ignore_errors=True)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = PnPNet(MLPInit(9), RobustWeightedLM(5))
    data = SyntheticProblems(n=9, batch_size=250, seed=0, outliers=OutlierMix())
    sets = {"none": (900_001, None), "uniform": (900_002, OutlierMix())}
    validation = {
        name: SyntheticProblems(n=9, batch_size=500, seed=seed, outliers=mix).batch(0)
        for name, (seed, mix) in sets.items()
    }
    loss = PoseLoss(saturation=0.02)

    def try_update(ramp: float) -> None:
        problems = data.batch(0)
        loss(model(*problems[:3], first_stage_only=ramp == 0.0), problems, ramp).total.backward()

    alone = TrainSettings(0).ramp[0]  # share of the run that trains the network without the refinement
    fast, slow = (timeit.timeit(partial(try_update, ramp), number=10) / 10 for ramp in (0.0, 1.0))
    expected = alone * fast + (1.0 - alone) * slow
    updates = max(100, round(seconds / expected) // 100 * 100)
    rows = updates // 20
    settings = TrainSettings(updates, warmup=100, log_every=rows, validate_every=rows, checkpoint_every=updates)
    fit(model, data, validation, loss, settings, folder, progress=progress)
    return folder / HISTORY_NAME
