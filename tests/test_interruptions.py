"""Processes that die, disks that are full, files that are damaged: nothing that was saved is lost."""

import json
import multiprocessing
import random
import shutil
import signal
import sys
import time

import numpy as np
import pytest
import torch
from helpers import arrays, assert_same, damage, many, table
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ValueCheckError
from test_training_loop import LossWith, comparable, forks, make_parts, read_history

from kornia_pnpnet import MLPInit, PnPNet, RobustWeightedLM
from kornia_pnpnet.cli import main
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.training import fit
from kornia_pnpnet.training.checkpoint import CHECKPOINT_NAME

resource = pytest.importorskip("resource", reason="not on Windows")

KILLS = 20
pytestmark = [forks, pytest.mark.skipif(sys.platform != "linux", reason="forks")]


def train(folder, updates=40, resume=False, **changes):
    parts = make_parts(updates, validate_every=50, checkpoint_every=5)
    fit(folder=folder, resume=resume, **{**parts, **changes})


def assert_same_runs(folder, other):
    assert_same(*(torch.load(x / CHECKPOINT_NAME, weights_only=True)["model"] for x in (folder, other)))
    assert comparable(read_history(folder)) == comparable(read_history(other))


def in_a_process(function, *arguments):
    process = multiprocessing.get_context("fork").Process(target=function, args=arguments)
    process.start()
    return process


def with_kills(tmp_path, start, moments):
    """Start processes until KILLS were killed at random moments. Yield each folder, and whether its process ended."""
    chance, killed, run = random.Random(0), 0, 0
    while killed < KILLS:
        run, done = run + 1, False
        while not done:
            process = start(tmp_path / str(run))
            process.join(chance.uniform(*moments) if killed < KILLS else None)
            process.kill()  # nothing when it has ended
            process.join()
            done = process.exitcode == 0
            assert done or process.exitcode == -signal.SIGKILL
            killed += not done
            yield tmp_path / str(run), done


@pytest.mark.slow
def test_kill_9_at_any_moment_loses_nothing(tmp_path):
    train(tmp_path / "whole", updates=400)

    def start(folder):
        return in_a_process(train, folder, 400, (folder / CHECKPOINT_NAME).exists())

    for folder, done in with_kills(tmp_path, start, (0.05, 1.0)):
        if done:
            assert_same_runs(folder, tmp_path / "whole")


def _with_a_full_disk(folder):
    """Train with files limited to 10 kB from update 23 on. Exit code 3: a file could not be written."""

    def full():
        shutil.copy(folder / CHECKPOINT_NAME, folder / "before")
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
        return 1.0

    try:
        train(folder, loss=LossWith(full, at=(23,)))
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
    assert_same_runs(tmp_path / "run", tmp_path / "whole")


def solve(source, out, *options):
    return main(["solve", "--batch", "--solver", "epnp", *options, "--out", str(out), str(source)])


def _shards_on_a_full_disk(source, out):
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
    sys.exit(solve(source, out))


def test_shards_on_a_full_disk_are_whole_or_missing(tmp_path, capsys):
    pytest.importorskip("pyarrow")
    source, out = tmp_path / "in", tmp_path / "out"
    source.mkdir()
    for name, count in (("a", 10), ("b", 1000), ("c", 10)):
        np.savez(source / f"{name}.npz", **arrays(SyntheticProblems(n=6, batch_size=count, seed=0).batch(0)))
    process = in_a_process(_shards_on_a_full_disk, source, out)
    process.join()
    assert process.exitcode == 2
    assert {path.name for path in out.iterdir()} == {"a.parquet"}
    assert solve(source, out) == 0
    assert "in 2 shards solved; 1 shards had been solved before" in capsys.readouterr().out


@pytest.mark.slow
def test_kill_9_at_any_moment_loses_no_results(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    source, whole = tmp_path / "in", tmp_path / "whole"
    source.mkdir()
    for i in range(20):
        problems = SyntheticProblems(n=6, batch_size=1000, seed=i).batch(0)
        if i % 4 == 0:
            parquet.write_table(table(problems), source / f"{i:02}.parquet")
        else:
            np.savez(source / f"{i:02}.npz", **arrays(problems))
    names = {f"{path.stem}.parquet" for path in source.iterdir()}

    def start(out):
        return in_a_process(lambda: sys.exit(solve(source, out, "--batch-size", "500")))

    began, process = time.monotonic(), start(whole)
    process.join()
    assert process.exitcode == 0
    amid, made = 0, {}
    for out, done in with_kills(tmp_path, start, (0.0, (time.monotonic() - began) / 4)):
        found = {path: path.stat().st_mtime_ns for path in out.glob("*") if path.name in names}
        assert {path: time for path, time in made.items() if path.parent == out}.items() <= found.items()
        made = found
        amid += not done and 0 < len(made) < len(names)
        if done:
            assert {path.name for path in out.iterdir() if path.suffix != ".tmp"} == names
            assert all(parquet.read_table(out / name) == parquet.read_table(whole / name) for name in names)
    assert amid >= 3  # else the moments say nothing


def test_damaged_weights_load_nothing(tmp_path):
    PnPNet(MLPInit(6), RobustWeightedLM(2)).save_pretrained(tmp_path)
    files = {name: (tmp_path / name).read_bytes() for name in ("config.json", "model.safetensors")}
    sound = PnPNet.from_pretrained(tmp_path)

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
        assert_same(loaded.state_dict(), sound.state_dict())

    run()
