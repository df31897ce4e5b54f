"""``train.py`` and ``conf``: every configuration composes and trains; sweeps and resuming work from the shell."""

import logging
import runpy
import shlex
import signal
import subprocess
import sys
from copy import deepcopy
from pathlib import Path

import pytest
import torch
from helpers import assert_same
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.utils import instantiate
from measure import collect_weights
from omegaconf import OmegaConf

from kornia_pnpnet import PnPNet
from kornia_pnpnet.core.files import read_csv
from kornia_pnpnet.training import fit
from kornia_pnpnet.training.checkpoint import History
from kornia_pnpnet.training.results import load_run

REPO = Path(__file__).resolve().parents[1]
DATA = sorted(path.stem for path in (REPO / "conf" / "data").glob("*.yaml"))
SMALL = "debug=two_updates", "threads=1"
EXPERIMENTS = {path.stem: path for path in sorted((REPO / "conf" / "experiment").glob("*.yaml"))}


def composed(*overrides):
    with initialize_config_dir(str(REPO / "conf"), version_base="1.3"):
        return compose("train", overrides=list(overrides))


def run(*arguments):
    """``train.py`` in a process of its own, which imports everything anew."""
    command = [sys.executable, str(REPO / "train.py"), *arguments, *SMALL]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200, check=False)
    assert done.returncode == 0, done.stderr


@pytest.fixture
def train(monkeypatch):
    """``train.py`` in this process, as the shell would call it."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", [str(REPO / "train.py"), *arguments, *SMALL])
        try:
            runpy.run_path(str(REPO / "train.py"), run_name="__main__")
        finally:  # Hydra puts handlers of its own in their place
            for handler in root.handlers:
                handler.close()
            root.handlers[:] = handlers
            root.setLevel(level)

    return call


def test_overrides_reach_the_parts():
    """A sweep tests on other problems of the mix that it trains on. A typing error raises."""
    sizes = "model.n=12", "model.m=3", "data.outliers.max_ratio=0.2", "batch_size=7", "seed=5"
    config = composed("experiment=sweep", *sizes)
    solver, data = instantiate(config.model.solver), instantiate(config.data.train)
    sets = {name: instantiate(source) for name, source in config.data.validation.items()}
    assert (solver.init.n, solver.refine.m) == (12, 3)
    assert data.batch_size == 7
    assert {source.n for source in (*data.sources, *sets.values())} == {12}
    assert {source.outliers.max_count(12) for source in (*data.sources, sets["uniform"])} == {2}
    assert {source.seed for source in data.sources} == {5} != {sets["uniform"].seed}
    with pytest.raises(Exception, match="kernal"):
        instantiate(composed("+model.solver.refine.kernal=huber").model.solver)


def test_run_writes_results_and_resumes(tmp_path, train):
    command, log = (f"hydra.run.dir={tmp_path}", "train.updates=1"), tmp_path / "train.log"
    run(*command)
    results = load_run(tmp_path / "results.json")
    assert results.run.update == 1
    assert set(results.validation) == {"none", "uniform", "slab"}
    assert "train.updates=1" in results.overrides
    checkpoint = torch.load(tmp_path / "last.ckpt", weights_only=True)["model"]
    assert_same(PnPNet.from_pretrained(tmp_path / "weights").state_dict(), checkpoint)
    with pytest.raises(SystemExit, match=r"^1$"):
        train(*command)
    assert "resume=true" in log.read_text()
    train(*command, "resume=true")
    assert log.read_text().count("Weights, model card and results are in") == 2
    train(*command, "resume=true", "+data.validation.mine=${data.validation.none}")  # a further set is measured
    assert load_run(tmp_path / "results.json").run == results.run
    assert "mine" in load_run(tmp_path / "results.json").validation
    (tmp_path / "last.ckpt").unlink()
    with pytest.raises(SystemExit, match=r"^1$"):
        train(*command, "resume=true")
    assert "results and no checkpoint" in log.read_text()


def test_run_starts_from_weights(tmp_path, train):
    learn_nothing = ("train.lr=0", "train.lr_refine=0", "train.ramp=[0,0]")
    weights = PnPNet.from_pretrained("pnpnet-n9")
    kernel = weights.refine.config["kernel"]
    options = (f"model.m={weights.refine.m}", f"model.solver.refine.kernel={kernel}", "weights=pnpnet-n9")
    options += ("model.solver.refine.robustness=null", f"model.views={weights.views}")
    train(f"hydra.run.dir={tmp_path / 'run'}", *options, *learn_nothing)
    assert_same(PnPNet.from_pretrained(tmp_path / "run" / "weights").state_dict(), weights.state_dict())
    lineage = load_run(tmp_path / "run" / "results.json").lineage()
    assert [entry.run.update for entry in lineage] == [200_000, 5000, 2000, 2]
    again = f"hydra.run.dir={tmp_path / 'run'}", *options, *learn_nothing, "resume=true"
    train(*again, f"weights={tmp_path / 'run' / 'weights'}")
    with pytest.raises(SystemExit, match=r"^1$"):
        train(*again, "weights=null")
    assert "of another run: weights was" in (tmp_path / "run" / "train.log").read_text()
    train(f"hydra.run.dir={tmp_path / 'again'}", *options, f"weights={tmp_path / 'run' / 'weights'}", "train.updates=3")
    collect_weights([tmp_path / "run", tmp_path / "again"], tmp_path / "mine")
    history = read_csv(tmp_path / "mine" / "history.csv", ["update"]).values()
    assert [row["update"] for row in history] == ["1", "2", "3", "4", "5"]
    card = (tmp_path / "mine" / "README.md").read_text()
    assert "\n# mine\n" in card
    assert card.count("`python train.py") == 5
    assert str(tmp_path) not in card
    train(f"hydra.run.dir={tmp_path / 'deeper'}", *options, *learn_nothing, f"model.m={weights.refine.m + 1}")
    assert "only the network" in (tmp_path / "deeper" / "train.log").read_text()
    deeper = PnPNet.from_pretrained(tmp_path / "deeper" / "weights")
    assert deeper.refine.step().tolist() == pytest.approx([1.0] * (weights.refine.m + 1))
    assert_same(list(deeper.init.parameters()), list(weights.init.parameters()))
    assert PnPNet.from_pretrained(tmp_path / "mine").config() == weights.config()
    (tmp_path / "mine" / "results.json").write_text('{"overrides": [1]}')
    damaged = f"weights={tmp_path / 'mine'}", r"is not a results file of a run: overrides\[0\] is 1"
    centre = "model.solver.normalize.center=false", "inputs of the networks differ: center"
    for wrong, why in (("model.n=6", "size mismatch"), ("weights=nowhere", "No weights 'nowhere'"), centre, damaged):
        with pytest.raises(SystemExit, match=f"Cannot start.*{why}"):
            train(f"hydra.run.dir={tmp_path}/wrong", *options, wrong)
    assert not (tmp_path / "wrong" / "last.ckpt").exists()


MINE = """
from kornia_pnpnet.data import SyntheticProblems

class Mine:
    def __init__(self, n, batch_size, seed, corners):
        self.problems = SyntheticProblems(n=n, batch_size=batch_size, seed=seed)

    def batch(self, index):
        return self.problems.batch(index)
"""


def test_data_of_ones_own_and_any_validation_sets(tmp_path, monkeypatch, train):
    (tmp_path / "mine.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)
    source = "{_target_: mine.Mine, n: 9, batch_size: 8, seed: 7, corners: 4}"
    away = "~data.validation.uniform", "~data.validation.none", "~data.validation.slab"
    sets = *away, f"+data.validation.board={source}", f"hydra.sweep.dir={tmp_path / 'sweep'}", "model.m=1"
    train("-m", *sets)
    (folder,) = (path.parent for path in tmp_path.glob("sweep/*/results.json"))
    assert "| board |" in (folder / "weights" / "README.md").read_text()
    assert "board/rate" in (tmp_path / "sweep" / "summary.csv").read_text()
    with pytest.raises(SystemExit, match=r"data\.validation is empty"):
        train(*away, f"hydra.run.dir={tmp_path}/none")


def test_two_runs_of_a_sweep_never_share_a_folder(tmp_path, train, capsys):
    with pytest.raises(SystemExit):
        train("-m", "model.m=2,5", "weights=../../w/a", f"hydra.sweep.dir={tmp_path}")
    assert "Pass paths without '..'" in capsys.readouterr().err


@pytest.mark.slow
def test_compilation_changes_neither_the_numbers_nor_what_is_saved(tmp_path):
    for compiled in ("false", "true"):
        run(f"hydra.run.dir={tmp_path / compiled}", f"compile={compiled}", "train.ramp=[0,0]")
    plain, compiled = (torch.load(tmp_path / name / "last.ckpt", weights_only=True) for name in ("false", "true"))
    assert compiled["identity"] == plain["identity"]
    off = torch.cat([(x - plain["model"][name]).abs().flatten() for name, x in compiled["model"].items()])
    # The steps from poses of an untrained network multiply rounding errors of float32 in a few problems, and Adam moves
    # an entry whose gradient is no more than rounding by as much as any other, in any direction.
    assert off.median() < 1e-5
    assert (off > 1e-4).double().mean() < 0.1
    PnPNet.from_pretrained(tmp_path / "true" / "weights")
    assert "compile=" not in (tmp_path / "true" / "weights" / "README.md").read_text()


@pytest.mark.slow
def test_two_processes_train(tmp_path):
    run(f"hydra.run.dir={tmp_path}", "engine=ddp_cpu")
    assert load_run(tmp_path / "results.json").run.update == 2


def test_sweep_leaves_results_and_a_summary(tmp_path, train, capsys):
    train("-m", "model.n=6,9", "model.m=0,2", "data.outliers.max_ratio=0.33", f"hydra.sweep.dir={tmp_path}")
    assert len(list(tmp_path.glob("*/results.json"))) == 4
    rows = list(read_csv(tmp_path / "summary.csv", ["run"]).values())
    assert {(row["model.n"], row["model.m"]) for row in rows} == {("6", "0"), ("6", "2"), ("9", "0"), ("9", "2")}
    table = capsys.readouterr().out
    for value in ("model.n", "model.m", "uniform", *(row["us_per_problem"] for row in rows)):
        assert f" {value} |" in table
    assert "max_ratio" not in table.partition("| model.n")[2]  # the same in all runs
    for row in rows:
        rate = load_run(tmp_path / row["run"] / "results.json").validation["uniform"].success.rate
        assert float(row["uniform/rate"]) == pytest.approx(rate, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("launcher", "option"), [("joblib", "n_jobs=2"), ("submitit_local", "timeout_min=5")])
def test_sweeps_by_other_launchers(launcher, option, tmp_path):
    command, ends = ("-m", f"hydra/launcher={launcher}", f"hydra.launcher.{option}", "model.n=6,9"), []
    for _ in range(2):
        run(*command, "resume=true", f"hydra.sweep.dir={tmp_path}")
        assert len(list(tmp_path.glob("*/results.json"))) == 2
        rows = read_csv(tmp_path / "summary.csv", ["run"]).values()
        assert {(row["model.n"], row["update"]) for row in rows} == {("6", "2"), ("9", "2")}
        ends.append({path: path.stat().st_mtime_ns for path in tmp_path.glob("*/last.ckpt")})
    assert ends[0] == ends[1]


def test_an_interrupted_sweep_names_the_command_that_continues_it(tmp_path, train, monkeypatch):
    write, command = History.write, ["-m", "model.n=6,9", f"hydra.sweep.dir={tmp_path}/a b", "train.updates=3"]

    def interrupt(self, row):
        write(self, row)
        if row["update"] == 1:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(History, "write", interrupt)
    with pytest.raises(SystemExit, match=r"^130$"):
        train(*command)
    monkeypatch.setattr(History, "write", write)
    (log,) = tmp_path.glob("a b/*/train.log")
    python, script, *words = shlex.split(log.read_text().partition("Continue with: ")[2])
    assert (python, script, words[: len(command)]) == ("python", str(REPO / "train.py"), command)
    train(*(word for word in words if word not in SMALL))
    assert len(list(tmp_path.glob("a b/*/results.json"))) == 2


def test_a_missing_gpu_is_named(tmp_path, train):
    if torch.cuda.is_available() or torch.backends.mps.is_available():
        pytest.skip("has a GPU")
    with pytest.raises(SystemExit, match=r"accelerator=gpu .* sees 0 CUDA devices"):
        train("engine=gpu", f"hydra.run.dir={tmp_path}")


# Two updates of the network alone and one through the refinement, where the recipe's ramp is not changed.
THREE = ("debug=two_updates", "train.updates=3")


def swept(experiment):
    """What an experiment runs over: its own sweeper's overrides, one at a time."""
    params = OmegaConf.select(OmegaConf.load(EXPERIMENTS[experiment]), "hydra.sweeper.params") or {}
    overrides = OverridesParser.create().parse_overrides([f"{key}={values}" for key, values in params.items()])
    return {x.key_or_group: list(x.sweep_string_iterator()) for x in overrides}


# An experiment alone, with all data, or with the first and the last value of each override that its sweeper runs over.
CASES = [(name, ()) for name in EXPERIMENTS if not swept(name)]
CASES += [("set", (f"data={data}", "model.n=12")) for data in DATA]
SWEPT = [(name, key, values) for name in EXPERIMENTS for key, values in swept(name).items()]
CASES += [(name, (f"{key}={x}",)) for name, key, values in SWEPT for x in dict.fromkeys((values[0], values[-1]))]


def fit_config(config, folder, solver=None):
    """Train what a composed configuration describes, as ``train.py`` does, or another solver in its place."""
    solver = instantiate(config.model.solver) if solver is None else solver
    data, loss, fabric = (instantiate(x) for x in (config.data.train, config.loss, config.engine))
    sets = {name: instantiate(source).batch(0) for name, source in config.data.validation.items()}
    settings = instantiate(config.train, _convert_="all")
    return fit(solver, data, sets, loss, settings, folder, fabric=fabric, progress=False)


@pytest.mark.parametrize(("experiment", "overrides"), CASES)
def test_every_experiment_trains(experiment, overrides, tmp_path):
    report = fit_config(composed(f"experiment={experiment}", *overrides, *THREE), tmp_path)
    assert (report.update, report.skipped) == (3, 0)


@pytest.mark.parametrize(("experiment", "part"), [("net_loss_only", "init"), ("identity_start", "refine")])
def test_what_an_ablation_trains(experiment, part, tmp_path):
    config = composed(f"experiment={experiment}", *THREE)
    solver = instantiate(config.model.solver)
    before = deepcopy(solver.state_dict())
    fit_config(config, tmp_path, solver)
    moved = {name for name, value in solver.state_dict().items() if not torch.equal(value, before[name])}
    assert moved == {name for name, _ in solver.named_parameters() if name.startswith(f"{part}.")}
    settings = instantiate(config.train, _convert_="all")
    assert {settings.ramp_factor(update) for update in range(3)} == {1.0 if part == "refine" else 0.0}
    assert (solver.init is None) == (part == "refine")
