"""Processes that die, disks that are full, files that are damaged: nothing that was saved is lost."""

import csv
import json
import multiprocessing
import random
import resource
import shutil
import signal
import sys
import time

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ValueCheckError
from strategies import damage, many

from kornia_pnpnet import MLPInit, PnPNet, PoseLoss, RobustWeightedLM
from kornia_pnpnet.cli import main
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.training import TrainSettings, fit
from kornia_pnpnet.training.checkpoint import CHECKPOINT_NAME, HISTORY_NAME

KILLS = 20
# Python 3.12 warns of every fork of a process with threads, which pytest-xdist's are.
pytestmark = [
    pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning"),
    pytest.mark.skipif(sys.platform != "linux", reason="forks"),
]


class Then(PoseLoss):
    """Calls a function at an update."""

    def __init__(self, update=-1, what=None):
        super().__init__()
        self.left, self.what = update, what

    def forward(self, *args, **kwargs):
        self.left -= 1
        if self.left == 0:
            self.what()
        return super().forward(*args, **kwargs)


def train(folder, updates=40, resume=False, loss=None):
    torch.manual_seed(0)
    model = PnPNet(MLPInit(6), RobustWeightedLM(2))
    problems = SyntheticProblems(n=6, batch_size=16, seed=3)
    ends = TrainSettings(updates, warmup=1, log_every=1, validate_every=50, checkpoint_every=5, ramp=(0.2, 0.5))
    validation = {"none": SyntheticProblems(n=6, batch_size=32, seed=4).batch(0)}
    fit(model, problems, validation, loss or Then(), ends, folder, resume=resume, progress=False)


def state(folder):
    saved = torch.load(folder / CHECKPOINT_NAME, weights_only=True)
    with (folder / HISTORY_NAME).open(newline="") as file:
        rows = list(csv.DictReader(file))
    timed = ("updates_per_second", "peak_memory_mib")
    kept = [key for key in rows[0] if key not in timed and not key.endswith("_share")]
    return saved["model"], [{key: row[key] for key in kept} for row in rows]


def in_a_process(function, *arguments):
    process = multiprocessing.get_context("fork").Process(target=function, args=arguments)
    process.start()
    return process


@pytest.mark.slow
def test_kill_9_at_any_moment_loses_nothing(tmp_path):
    """After any number of kills the weights and curves are those of a run without kills."""
    updates = 400
    train(tmp_path / "whole", updates)
    weights, history = state(tmp_path / "whole")
    chance = random.Random(0)
    killed, run = 0, 0
    while killed < KILLS:
        run += 1
        folder, done = tmp_path / str(run), False
        while not done:
            process = in_a_process(train, folder, updates, (folder / CHECKPOINT_NAME).exists())
            process.join(chance.uniform(0.05, 1.0) if killed < KILLS else None)
            done = process.exitcode == 0
            if process.exitcode is None:
                process.kill()
                process.join()
                killed += 1
            elif not done:
                raise AssertionError(f"exit code {process.exitcode} after {killed} kills")
        mine, rows = state(folder)
        assert mine.keys() == weights.keys()
        assert all(mine[key].equal(value) for key, value in weights.items())
        assert rows == history
    assert killed == KILLS


def _with_a_full_disk(folder):
    """Train with files limited to 10 kB from update 23 on. Exit code 3: a file could not be written."""

    def full():
        shutil.copy(folder / CHECKPOINT_NAME, folder / "before")
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))

    try:
        train(folder, loss=Then(23, full))
    except OSError:
        sys.exit(3)


def test_a_full_disk_loses_nothing(tmp_path):
    process = in_a_process(_with_a_full_disk, tmp_path / "run")
    process.join()
    assert process.exitcode == 3
    assert (tmp_path / "run" / CHECKPOINT_NAME).read_bytes() == (tmp_path / "run" / "before").read_bytes()
    assert list((tmp_path / "run").glob("*.tmp")) == []
    train(tmp_path / "run", resume=True)
    train(tmp_path / "whole")
    (mine, rows), (weights, history) = state(tmp_path / "run"), state(tmp_path / "whole")
    assert all(mine[key].equal(value) for key, value in weights.items())
    assert rows == history


def arrays_of(source):
    """The arrays of a shard."""
    inputs = (x.numpy() for x in source.batch(0)[:3])
    return dict(zip(("world_points", "img_points", "intrinsics"), inputs, strict=True))


def _shards_on_a_full_disk(source, out):
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
    sys.exit(main(["solve", "--batch", "--solver", "epnp", "--out", str(out), str(source)]))


def test_shards_on_a_full_disk_are_whole_or_missing(tmp_path, capsys):
    pytest.importorskip("pyarrow")
    source, out = tmp_path / "in", tmp_path / "out"
    source.mkdir()
    for name, count in (("a", 10), ("b", 1000), ("c", 10)):
        np.savez(source / f"{name}.npz", **arrays_of(SyntheticProblems(n=6, batch_size=count, seed=0)))
    process = in_a_process(_shards_on_a_full_disk, source, out)
    process.join()
    assert process.exitcode == 2
    assert {path.name for path in out.iterdir()} == {"a.parquet"}
    assert main(["solve", "--batch", "--solver", "epnp", "--out", str(out), str(source)]) == 0
    assert "in 2 shards solved; 1 shards had been solved before" in capsys.readouterr().out


def _solve_batch(source, out):
    sys.exit(main(["solve", "--batch", "--solver", "epnp", "--batch-size", "500", "--out", str(out), str(source)]))


@pytest.mark.slow
def test_kill_9_at_any_moment_loses_no_results(tmp_path):
    """After any number of kills the results are those of a call without kills, and no result is made twice."""
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    source, whole = tmp_path / "in", tmp_path / "whole"
    source.mkdir()
    for i in range(20):
        arrays = arrays_of(SyntheticProblems(n=6, batch_size=1000, seed=i))
        if i % 4 == 0:
            lists = {key: [*x.reshape(1000, -1)] for key, x in arrays.items()}
            parquet.write_table(pyarrow.table(lists), source / f"{i:02}.parquet")
        else:
            np.savez(source / f"{i:02}.npz", **arrays)

    began = time.monotonic()
    process = in_a_process(_solve_batch, source, whole)
    process.join()
    took = time.monotonic() - began
    assert process.exitcode == 0
    names = {f"{path.stem}.parquet" for path in source.iterdir()}
    chance = random.Random(0)
    killed, amid, run = 0, 0, 0
    while killed < KILLS:
        run += 1
        out, done, made = tmp_path / str(run), False, {}
        while not done:
            process = in_a_process(_solve_batch, source, out)
            process.join(chance.uniform(0.0, took / 4) if killed < KILLS else None)
            process.kill()  # nothing when it has ended
            process.join()
            done = process.exitcode == 0
            found = {path.name: path.stat().st_mtime_ns for path in out.glob("*") if path.name in names}
            assert made.items() <= found.items()
            made = found
            if not done:
                assert process.exitcode == -signal.SIGKILL
                killed += 1
                amid += 0 < len(made) < len(names)
        assert {path.name for path in out.iterdir() if path.suffix != ".tmp"} == names
        assert all(parquet.read_table(out / name) == parquet.read_table(whole / name) for name in names)
    assert amid >= 3  # else the moments say nothing


@pytest.fixture(scope="module")
def weights_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    PnPNet(MLPInit(6), RobustWeightedLM(2)).save_pretrained(folder)
    return folder


def test_damaged_weights_load_nothing(weights_folder, tmp_path):
    """Damage gives an error, or changes neither the configuration nor the weights."""
    files = {name: (weights_folder / name).read_bytes() for name in ("config.json", "model.safetensors")}
    sound = PnPNet.from_pretrained(weights_folder)

    @many(200)
    @given(st.sampled_from(sorted(files)), st.data())
    def run(name, data):
        for each, content in files.items():
            (tmp_path / each).write_bytes(data.draw(damage(content)) if each == name else content)
        try:
            loaded = PnPNet.from_pretrained(tmp_path)
        except ValueCheckError:
            return
        assert json.dumps(loaded.config()) == json.dumps(sound.config())
        theirs = loaded.state_dict()
        assert all(theirs[key].equal(value) for key, value in sound.state_dict().items())

    run()
