"""Train a solver: ``python train.py``. See ``conf/train.yaml`` for what can be overridden."""

from __future__ import annotations

import json
import logging
import os
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.types import RunMode
from hydra.utils import instantiate
from kornia.core.exceptions import ValueCheckError
from omegaconf import DictConfig, OmegaConf

from kornia_pnpnet.core.files import digest, write_json
from kornia_pnpnet.core.schema import to_json
from kornia_pnpnet.evaluation.results import differences
from kornia_pnpnet.solver import PnPNet
from kornia_pnpnet.training import TrainingError, fit
from kornia_pnpnet.training.card import write_model_card
from kornia_pnpnet.training.checkpoint import CHECKPOINT_NAME
from kornia_pnpnet.training.results import RESULTS_NAME, find_results, load_run, run_results, summarize_runs

log = logging.getLogger("train")


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def main(config: DictConfig) -> float | None:
    """Train, and write results and weights.

    Returns:
        The success rate on the validation set ``uniform``, or on the last set if no set has this name. A sweeper may
        maximise this rate.
    """
    runtime = HydraConfig.get()
    sweeps = runtime.mode == RunMode.MULTIRUN
    folder = Path(runtime.runtime.output_dir)
    if sweeps and ".." in Path(runtime.sweep.subdir).parts:  # all runs could get the same folder
        raise TrainingError(f"The overrides name the run's folder: {runtime.sweep.subdir}. Pass paths without '..'.")
    try:
        fabric = instantiate(config.engine)
    except InstantiationException as error:
        sys.exit(
            f"Cannot start engine.accelerator={config.engine.accelerator} engine.devices={config.engine.devices}: "
            f"{error.__cause__} PyTorch {torch.__version__} sees {torch.cuda.device_count()} CUDA devices. "
            "Install PyTorch for your GPU, or pass engine=cpu."
        )
    fabric.launch()
    if config.threads is not None:  # after the launch, which sets the threads of several processes
        torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    model = instantiate(config.model.solver)
    with TemporaryDirectory() as temporary, torch.random.fork_rng(devices=[]):
        model.save_pretrained(temporary)  # what cannot be saved is refused before the training
    origin = start = None
    if config.weights is not None:
        try:
            start_from(model, PnPNet.from_pretrained(config.weights))
            origin = find_results(config.weights)
        except (FileNotFoundError, RuntimeError, ValueError, ValueCheckError) as error:
            reason = " ".join(str(error).split())[:300]
            message = f"Cannot start n = {config.model.n} from weights={config.weights}: {reason}"
            if sweeps:  # the sweep continues with its next run
                raise TrainingError(message) from error
            sys.exit(message)
        start = digest(*model.state_dict().values())  # files of weights may have another path on another machine
    if config.compile:
        model.compile()
    validation = {name: instantiate(source).batch(0) for name, source in config.data.validation.items()}
    if not validation:
        sys.exit("data.validation is empty: a run needs at least one validation set.")
    processes = int(os.environ.get("WORLD_SIZE", fabric.world_size))
    if processes != fabric.world_size:
        sys.exit(f"torchrun started {processes} processes: pass engine.devices=... engine.strategy=ddp to match.")
    if fabric.is_global_zero:
        sizes = sum(p.numel() for p in model.parameters() if p.requires_grad), fabric.world_size
        log.info("n = %s, m = %s, %s parameters, %s processes", config.model.n, config.model.m, *sizes)
    resolved: Any = OmegaConf.to_container(config, resolve=True)
    identity = {"data": resolved["data"]["train"], "loss": resolved["loss"], "model_config": resolved["model"]}
    settings = instantiate(config.train, _convert_="all")
    try:
        if settings.updates and (folder / RESULTS_NAME).exists() and not (folder / CHECKPOINT_NAME).exists():
            raise TrainingError(f"{folder} has results and no checkpoint to continue from: choose another folder.")
        report = fit(
            model,
            instantiate(config.data.train),
            validation,
            instantiate(config.loss),
            settings,
            folder,
            fabric=fabric,
            identity={**identity, "weights": start},
            data_workers=config.data_workers,
            resume=config.resume,
            progress=config.progress,
        )
    except (TrainingError, OSError) as error:
        if sweeps:
            raise  # the sweep continues with its next run
        log.error("%s", error)
        sys.exit(1)
    if not fabric.is_global_zero:
        return None
    log.info("%s", report)
    if report.interrupted:
        sweep = [f"hydra.sweep.dir={runtime.sweep.dir}"] if sweeps else []
        again = continuing(*sweep, "resume=true")
        log.warning("Stopped at update %s of %s. Continue with: %s", report.update, settings.updates, again)
        sys.exit(130)
    results = None
    if report.start == report.update and (folder / RESULTS_NAME).exists() and (folder / "weights").is_dir():
        try:
            results = load_run(folder / RESULTS_NAME)
        except ValueError as error:
            if sweeps:
                raise
            sys.exit(str(error))
        if results.run.update != report.update:
            results = None
    sets = json.loads(json.dumps(resolved["data"]["validation"]), parse_constant=str)  # as `run_results` stores them
    if results is not None and to_json(results)["config"]["data"]["validation"] == sets:
        log.info("Nothing is left to train; the results stay as they are.")
    else:
        log.info("Measuring success and speed of the trained solver")
        made = results
        run = report if made is None else made.run
        results = run_results(model.cpu(), validation, run, resolved, list(runtime.overrides.task), origin)
        if made is not None:  # the weights are of the commit that trained them
            results = replace(results, environment=results.environment | {"commit": made.environment["commit"]})
        model.save_pretrained(folder / "weights")
        write_model_card(folder / "weights", results)
        write_json(folder / RESULTS_NAME, to_json(results))  # the last file: a run without it is measured again
    for name, entry in results.validation.items():
        about = config.data.get("about", {}).get(name, "see the configuration")
        log.info("%s (%s): success %s", name, about, entry.success)
    log.info("Weights, model card and results are in %s", folder)
    if sweeps:
        summarize_runs(runtime.sweep.dir)
    return results.validation.get("uniform", entry).success.rate


def continuing(*more: str) -> str:
    """The command that continues this run or sweep. In a cluster's job, ``...`` stands for the unknown arguments."""
    words = sys.argv if Path(sys.argv[0]).name == Path(__file__).name else ["train.py", "-m", "..."]
    return shlex.join(["python", *words, *(word for word in more if word not in words)])


def start_from(model: PnPNet, trained: PnPNet) -> None:
    """Copy the weights of another solver. If ``m`` or the form of the refinement differs, ``model`` keeps its own.

    Raises:
        ValueError: when the network of ``trained`` gets its inputs with another scale, centre or order.
    """

    def inputs(solver: PnPNet) -> dict[str, Any]:
        network: Any = getattr(solver.init, "config", {})
        return {**solver.normalize.config, **{x: network[x] for x in ("world_scale", "img_scale") if x in network}}

    if found := differences(inputs(trained), inputs(model)):
        raise ValueError("the inputs of the networks differ: " + "; ".join(found))
    state = trained.state_dict()
    kind = {key: trained.refine.config[key] for key in ("m", "kernel", "shared", "by_residual")}
    if not kind.items() <= model.refine.config.items():
        log.info("The weights are of a refinement with %s: only the network starts from the weights.", kind)
        state = {name: value for name, value in state.items() if not name.startswith("refine.")}
        state |= {f"refine.{name}": value for name, value in model.refine.state_dict().items()}
    model.load_state_dict(state)


if __name__ == "__main__":
    main()
