"""``conf/experiment``: every file composes and trains, and changes what it says that it changes."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.utils import instantiate
from omegaconf import OmegaConf

CONF = Path(__file__).resolve().parents[1] / "conf"
FILES = {path.stem: path for path in sorted((CONF / "experiment").glob("*.yaml"))}
# Two updates of the network alone and one through the refinement, where the recipe's ramp is not changed.
SHORT = ("debug=two_updates", "train.updates=3")


def swept(experiment):
    """What an experiment runs over: its own sweeper's overrides, one at a time."""
    params = OmegaConf.select(OmegaConf.load(FILES[experiment]), "hydra.sweeper.params") or {}
    overrides = OverridesParser.create().parse_overrides([f"{key}={values}" for key, values in params.items()])
    return {x.key_or_group: list(x.sweep_string_iterator()) for x in overrides}


# An experiment alone, and with the first and the last value of each override that its sweeper runs over.
CASES = [(name, ()) for name in FILES] + [("set", ("data=rigs", "model.n=12"))]
CASES += [
    (name, (f"{key}={value}",))
    for name in FILES
    for key, values in swept(name).items()
    for value in dict.fromkeys((values[0], values[-1]))
]


def composed(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("train", overrides=list(overrides))


@pytest.fixture
def trained(fit_config):
    """Trains an experiment: the configuration, the solver's state before, the solver after, and the report."""

    def run(*overrides):
        config = composed(*overrides, *SHORT)
        torch.manual_seed(config.seed)
        solver = instantiate(config.model.solver)
        before = deepcopy(solver.state_dict())
        return config, before, solver, fit_config(config, solver)

    return run


def moved(before, solver):
    return {name for name, value in solver.state_dict().items() if not torch.equal(value, before[name])}


@pytest.mark.parametrize(("experiment", "overrides"), CASES)
def test_every_experiment_trains(experiment, overrides, trained):
    *_, report = trained(f"experiment={experiment}", *overrides)
    assert (report.update, report.skipped) == (3, 0)


def test_net_loss_only_leaves_the_refiner_as_it_was(trained):
    _, before, solver, _ = trained("experiment=net_loss_only")
    parameters = {name for name, _ in solver.named_parameters()}
    assert moved(before, solver) == {name for name in parameters if name.startswith("init.")}


def test_identity_start_learns_the_refiner_alone_from_the_first_update(trained):
    config, before, solver, _ = trained("experiment=identity_start")
    assert solver.init is None
    assert moved(before, solver) == {f"refine.{name}.raw" for name in ("step", "damping", "robustness")}
    problems = instantiate(config.data.train).batch(0)
    first = solver(*problems[:3]).init
    assert torch.allclose(first.rotation, torch.eye(3), atol=1e-6)
    assert torch.allclose(first.translation, torch.zeros(3), atol=1e-4)
    settings = instantiate(config.train, _convert_="all")
    assert [settings.ramp_factor(update) for update in range(3)] == [1.0, 1.0, 1.0]


@pytest.mark.parametrize("max_ratio", swept("sweep")["data.outliers.max_ratio"])
def test_sweep_tests_on_the_mix_it_trains_on(max_ratio):
    config = composed("experiment=sweep", f"data.outliers.max_ratio={max_ratio}", "model.n=12", "model.m=2")
    solver = instantiate(config.model.solver)
    assert (solver.init.n, solver.refine.m) == (12, 2)
    train, validation = (instantiate(source) for source in (config.data.train, config.data.validation.uniform))
    sources = [*train.sources, validation]
    most = {source.outliers.max_count(12) for source in sources}
    assert most == {round(12 * float(max_ratio))}
    assert len({source.seed for source in sources}) == 2
