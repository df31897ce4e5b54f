"""The training loop and its batches: resuming equals not stopping, two processes equal one, workers draw and end."""

import math
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from types import SimpleNamespace

import pytest
import torch
from helpers import assert_same
from kornia.core.exceptions import BaseError
from lightning_fabric import Fabric

from kornia_pnpnet import MLPInit, PnPNet, PoseLoss, RobustWeightedLM
from kornia_pnpnet.core.files import read_csv
from kornia_pnpnet.data import OutlierMix, SyntheticProblems, VaryingSize
from kornia_pnpnet.data.stream import stream_batches
from kornia_pnpnet.training import TrainSettings, fit, train_briefly
from kornia_pnpnet.training.checkpoint import CHECKPOINT_NAME, HISTORY_NAME, TrainingError
from kornia_pnpnet.training.loop import _own_part

SHARES = [f"{stage}_share" for stage in ("data", "forward", "backward", "optimizer", "rest")]
#: Signals, and the numbers of workers before and after.
SIGNALS = [(signal.SIGTERM, 0, 0), (signal.SIGINT, 1, 0), (signal.SIGINT, 0, 1), (signal.SIGTERM, 1, 1)]

# Python 3.12 warns of every fork of a process with threads, which pytest-xdist's are.
pytestmark = forks = pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")


def make_parts(updates=6, dtype=torch.float32, **changes):
    torch.manual_seed(0)
    settings = {"warmup": 1, "log_every": 1, "validate_every": 3, "checkpoint_every": 2, "ramp": (0.2, 0.5), **changes}
    model, loss = PnPNet(MLPInit(6), RobustWeightedLM(2)).to(dtype), PoseLoss(saturation=0.02)
    data = SyntheticProblems(n=6, batch_size=16, seed=3, outliers=OutlierMix(), dtype=dtype)
    sets = {"none": SyntheticProblems(n=6, batch_size=32, seed=4, dtype=dtype).batch(0)}
    parts = {"model": model, "data": data, "validation": sets, "loss": loss, "progress": False}
    return parts | {"settings": TrainSettings(updates, **settings)}


def read_history(folder):
    return list(read_csv(folder / HISTORY_NAME, ["update"]).values())


def comparable(rows):
    """History rows without what depends on the clock or the memory."""
    timed = ("updates_per_second", "peak_memory_mib", *SHARES)
    return [{k: v for k, v in row.items() if k not in timed} for row in rows]


class LossWith(PoseLoss):
    """Calls a function at some updates. The loss is multiplied by the result of the function."""

    def __init__(self, function, at):
        super().__init__(saturation=0.02)
        self.calls, self.function, self.at = 0, function, at

    def forward(self, *args, **kwargs):
        terms = super().forward(*args, **kwargs)
        self.calls += 1
        return terms._replace(total=terms.total * self.function()) if self.calls in self.at else terms


def stopping_loss(at, number):
    """Sends a signal to this process and its workers during one update, as a terminal does."""

    def stop():
        for child in multiprocessing.active_children():
            os.kill(child.pid, number)
        signal.raise_signal(number)
        return 1.0

    return LossWith(stop, at=(at,))


@pytest.mark.parametrize(("number", "workers", "workers_later"), SIGNALS)
def test_resuming_after_a_signal_equals_not_stopping(tmp_path, number, workers, workers_later):
    if workers and sys.platform == "win32":
        pytest.skip("os.kill ends the workers")
    whole = make_parts()
    fit(folder=tmp_path / "whole", **whole)
    handler = signal.getsignal(number)
    stopped = {**make_parts(), "loss": stopping_loss(3, number)}
    report = fit(folder=tmp_path / "parts", data_workers=workers, **stopped)
    assert not multiprocessing.active_children()
    assert (report.update, report.interrupted) == (3, True)
    assert signal.getsignal(number) is handler
    assert len(read_history(tmp_path / "parts")) == 3
    with (tmp_path / "parts" / HISTORY_NAME).open("r+") as file:
        last = file.readlines()[-1]
        file.write(f"4{last[1:]}2")  # a killed run has rows beyond its last checkpoint, and the last row may be cut
    again = {**make_parts(), "model": PnPNet(MLPInit(6), RobustWeightedLM(2))}  # other weights at first
    report = fit(folder=tmp_path / "parts", resume=True, data_workers=workers_later, **again)
    assert (report.update, report.interrupted) == (6, False)
    assert_same(whole["model"].state_dict(), again["model"].state_dict())
    assert comparable(read_history(tmp_path / "parts")) == comparable(read_history(tmp_path / "whole"))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_steps_that_are_not_finite_are_skipped_and_counted(tmp_path, value):
    parts = make_parts(updates=1)
    before = deepcopy(parts["model"])
    report = fit(folder=tmp_path / "one", **{**parts, "loss": LossWith(lambda: value, at=(1,))})
    assert report.skipped == 1
    assert_same(parts["model"].state_dict(), before.state_dict())
    parts = make_parts(updates=5)
    report = fit(folder=tmp_path / "some", **{**parts, "loss": LossWith(lambda: value, at=(2, 4))})
    assert report.skipped == 2
    assert all(p.isfinite().all() for p in parts["model"].parameters())
    assert [row["skipped"] for row in read_history(tmp_path / "some")] == ["0", "1", "1", "2", "2"]
    with pytest.raises(TrainingError, match=r"3 steps .* max_skipped = 2"):
        fit(folder=tmp_path / "all", **{**make_parts(max_skipped=2), "loss": LossWith(lambda: value, at=range(1, 7))})


def test_a_checkpoint_is_continued_by_the_same_run_only(tmp_path):
    """Any difference is named: the settings, and plain data that the caller passes as the identity of the run."""
    identity = {"data": {"seed": 3, "sigma": [1.0, 2.0]}}
    fit(folder=tmp_path, identity=identity, **make_parts())
    content = (tmp_path / CHECKPOINT_NAME).read_bytes()
    with pytest.raises(TrainingError, match="resume=true"):
        fit(folder=tmp_path, identity=identity, **make_parts())
    for changes, named in (({"lr": 1.0}, r"lr"), ({"updates": 5}, r"updates was 6 and is 5\.$")):
        with pytest.raises(TrainingError, match=rf"of another run: settings\.{named}"):
            fit(folder=tmp_path, identity=identity, resume=True, **make_parts(**changes))
    with pytest.raises(TrainingError, match=r"of another run: data\.sigma\.1 was 2\.0 and is 5\.0\.$"):
        fit(folder=tmp_path, identity={"data": {"seed": 3, "sigma": [1.0, 5.0]}}, resume=True, **make_parts())
    for option, value in (("effort", "fixed"), ("gradient", "always"), ("focal", "unknown"), ("views", 2)):
        other = PnPNet(MLPInit(6), RobustWeightedLM(2), **{option: value})
        with pytest.raises(TrainingError, match=rf"of another run: model\.{option} was .* and is {value!r}\.$"):
            fit(folder=tmp_path, identity=identity, resume=True, **{**make_parts(), "model": other})
    assert (tmp_path / CHECKPOINT_NAME).read_bytes() == content
    free = {**make_parts(max_skipped=7, log_every=2, validate_every=2, checkpoint_every=5), "validation": {}}
    report = fit(folder=tmp_path, identity={"data": {"seed": 3, "sigma": (1.0, 2.0)}}, resume=True, **free)
    assert (report.start, report.update) == (6, 6)
    assert read_history(tmp_path)[-1]["val/none/success"]  # curves of removed sets stay


def test_a_run_becomes_longer_with_the_schedule_of_the_longer_run(tmp_path):
    """The run may have ended, and may be continued again. A signal in the last update is no interruption."""
    report = fit(folder=tmp_path, **{**make_parts(), "loss": stopping_loss(6, signal.SIGTERM)})
    assert (report.update, report.interrupted) == (6, False)
    report = fit(folder=tmp_path, resume=True, **{**make_parts(updates=12), "loss": stopping_loss(3, signal.SIGTERM)})
    assert (report.start, report.update, report.interrupted) == (6, 9, True)
    assert fit(folder=tmp_path, resume=True, **make_parts(updates=12)).update == 12
    rows, lengths = read_history(tmp_path), [6] * 6 + [12] * 6
    assert [row["update"] for row in rows] == [str(update) for update in range(1, 13)]
    for update, (row, length) in enumerate(zip(rows, lengths, strict=True)):
        settings = make_parts(updates=length)["settings"]
        assert float(row["lr"]) == pytest.approx(settings.lr * settings.lr_factor(update), rel=1e-5)
        assert float(row["ramp"]) == pytest.approx(settings.ramp_factor(update), rel=1e-5)


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", None])
def test_a_damaged_checkpoint_is_refused(tmp_path, content):
    fit(folder=tmp_path, **make_parts())
    path = tmp_path / CHECKPOINT_NAME
    path.write_bytes(path.read_bytes()[:-100] if content is None else content)
    with pytest.raises(TrainingError, match="Cannot read the checkpoint"):
        fit(folder=tmp_path, resume=True, **make_parts())


def test_schedules():
    settings = TrainSettings(1000, warmup=10, final_lr=0.1, ramp=(0.2, 0.4))
    assert settings.lr_factor(0) == pytest.approx(0.1, rel=1e-5)
    assert settings.lr_factor(9) == pytest.approx(1.0, abs=1e-3)
    assert settings.lr_factor(1000) == pytest.approx(0.1)
    assert [settings.ramp_factor(u) for u in (0, 200, 300, 400, 999)] == [0.0, 0.0, 0.5, 1.0, 1.0]
    assert TrainSettings(10, ramp=(0.0, 0.0)).ramp_factor(0) == 1.0
    assert [TrainSettings(10, ramp=(0.5, 0.5)).ramp_factor(update) for update in (0, 4, 5, 9)] == [0.0, 0.0, 1.0, 1.0]
    assert TrainSettings(10, ramp=(1.0, 1.0)).ramp_factor(9) == 0.0


def test_training_outside_the_main_thread(tmp_path):
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(fit, folder=tmp_path, **make_parts()).result().update == 6


def test_train_briefly(tmp_path):
    old = tmp_path / CHECKPOINT_NAME
    old.write_bytes(b"old")
    for seconds in (0.0, -1.0, math.nan, math.inf, None, "1", True):
        with pytest.raises(BaseError, match="seconds"):
            train_briefly(seconds, tmp_path, progress=False)
    assert old.read_bytes() == b"old"
    assert train_briefly(1.0, tmp_path, progress=False) == tmp_path / HISTORY_NAME
    rows = read_history(tmp_path)
    assert len(rows) >= 10
    assert float(rows[-1]["val/none/success"]) > float(rows[0]["val/none/success"])


class Uneven(SyntheticProblems):
    def batch(self, index):
        return super().batch(index).map(lambda x: x[: (1, 5, 16)[index % 3]])


@pytest.mark.skipif(sys.platform == "win32", reason="forks")
@pytest.mark.parametrize("source", [SyntheticProblems, Uneven])
def test_two_processes_equal_one(source, tmp_path):
    def parts():
        data = source(n=6, batch_size=16, seed=3, outliers=OutlierMix(), dtype=torch.float64)
        return {**make_parts(dtype=torch.float64), "validation": {}, "data": data}

    one = parts()
    start = deepcopy(one["model"].state_dict())
    fit(folder=tmp_path / "one", **one)

    def train(fabric):
        fit(folder=tmp_path, fabric=fabric, **parts())

    Fabric(accelerator="cpu", devices=2, strategy="ddp_fork").launch(train)
    two = torch.load(tmp_path / CHECKPOINT_NAME, weights_only=True)["model"]
    assert_same(two, one["model"].state_dict(), atol=1e-9)
    assert any(not torch.equal(two[name], start[name]) for name in start)


def test_validation_has_its_own_interval_and_does_not_change_the_training(tmp_path):
    one, other = make_parts(updates=9, log_every=4, validate_every=3), make_parts(updates=9, validate_every=100)
    fit(folder=tmp_path, **one)
    fit(folder=tmp_path / "other", **other)
    assert_same(one["model"].state_dict(), other["model"].state_dict())
    rows = read_history(tmp_path)
    assert [row["update"] for row in rows] == ["3", "4", "6", "8", "9"]
    assert [row["update"] for row in rows if row["val/none/success"]] == ["3", "6", "9"]


def test_shares_of_the_time_add_up_and_show_slow_data(tmp_path, monkeypatch):
    draw, parts = SyntheticProblems.batch, make_parts()
    monkeypatch.setattr(SyntheticProblems, "batch", lambda *x: time.sleep(0.5) or draw(*x))
    shares = fit(folder=tmp_path, **parts).time_shares
    assert shares["data"] == max(shares.values())
    for row in ({f"{stage}_share": x for stage, x in shares.items()}, *read_history(tmp_path)):
        values = [float(row[share]) for share in SHARES]
        assert min(values) > 0.0
        assert sum(values) == pytest.approx(1.0, abs=1e-4)  # six digits are written


@pytest.mark.parametrize(("batch_size", "processes"), [(15, 2), (2, 4)])
def test_the_mean_over_processes_is_that_of_the_batch(batch_size, processes):
    batch = SyntheticProblems(n=6, batch_size=batch_size).batch(0)
    fabrics = [SimpleNamespace(world_size=processes, global_rank=i, device="cpu") for i in range(processes)]
    means = [factor * part.world_points.mean() for part, factor in (_own_part(batch, fabric) for fabric in fabrics)]
    torch.testing.assert_close(sum(means) / processes, batch.world_points.mean())


class BrokenSource(SyntheticProblems):
    def batch(self, index):
        if index == 7:
            raise ArithmeticError("batch 7 cannot be drawn")
        return super().batch(index)


def make_source(kind=SyntheticProblems, **options):
    return kind(n=6, batch_size=5, seed=3, outliers=OutlierMix(), known_noise=0.5, img_sigma=(0.5, 5.0), **options)


@pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning")  # on a machine with one core
@pytest.mark.parametrize("workers", [0, 1, 2])
@pytest.mark.parametrize(
    "source", [make_source(dtype=torch.float64), VaryingSize(SyntheticProblems, n=[4, 7], batch_size=6, seed=3)]
)
def test_batches_are_those_of_the_source_in_order(workers, source):
    with torch.device("meta"):  # a default device that the problems are not on
        found = [*stream_batches(source, 4, 25, workers)]
    assert_same(found, [source.batch(i) for i in range(4, 25)], equal_nan=True)
    assert list(stream_batches(source, 3, 3, workers)) == []
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("workers", [0, 1])
def test_an_error_of_the_source_arrives_with_its_message(workers):
    source = make_source(BrokenSource)
    stream = stream_batches(source, 5, 100, workers)
    assert_same([next(stream), next(stream)], [source.batch(5), source.batch(6)], equal_nan=True)
    with pytest.raises(ArithmeticError, match="batch 7 cannot be drawn"):
        next(stream)
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_the_group_does_not_end_the_workers(number):
    source = make_source()
    stream = stream_batches(source, 0, 30, 1)
    assert_same(next(stream), source.batch(0), equal_nan=True)
    (worker,) = multiprocessing.active_children()
    os.kill(worker.pid, number)
    assert_same([*stream], [source.batch(index) for index in range(1, 30)], equal_nan=True)


LEFT_OPEN = """
import multiprocessing, sys, torch
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.data.stream import stream_batches

if __name__ == "__main__":
    multiprocessing.set_start_method(sys.argv[1])
    source = SyntheticProblems(n=6, batch_size=5)
    stream = stream_batches(source, 0, 10**9, workers=2)
    for index in range(12):
        assert torch.equal(next(stream).img_points, source.batch(index).img_points), index
    print("end")
"""


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_a_stream_that_is_left_open_does_not_keep_the_process(method, tmp_path):
    """Processes that are spawned, as on systems that cannot fork, draw the same problems."""
    script = tmp_path / "left_open.py"
    script.write_text(LEFT_OPEN)
    command = [sys.executable, str(script), method]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert (done.returncode, done.stdout) == (0, "end\n"), done.stderr
