"""Batches drawn by other processes: the same numbers in the same order, and processes that end."""

import multiprocessing
import os
import signal
import subprocess
import sys

import pytest
import torch
from data_helpers import same

from kornia_pnpnet.data import OutlierMix, SyntheticProblems, VaryingSize
from kornia_pnpnet.data.stream import stream_batches

# Python 3.12 warns of every fork of a process with threads, which pytest-xdist's are.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")


class BrokenSource(SyntheticProblems):
    def batch(self, index):
        if index == 7:
            raise ArithmeticError("batch 7 cannot be drawn")
        return super().batch(index)


def make_source(kind=SyntheticProblems, **options):
    return kind(n=6, batch_size=5, seed=3, outliers=OutlierMix(), known_noise=0.5, img_sigma=(0.5, 5.0), **options)


@pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning")  # on a machine with one core
@pytest.mark.parametrize(
    ("workers", "source"),
    [
        (0, make_source()),
        (1, make_source(dtype=torch.float64)),
        (2, make_source()),
        (1, VaryingSize(SyntheticProblems, n=[4, 7], batch_size=6, seed=3)),
    ],
)
def test_batches_are_those_of_the_source_in_order(workers, source):
    found = [same(problems, source.batch(4 + i)) for i, problems in enumerate(stream_batches(source, 4, 25, workers))]
    assert found == [True] * 21
    assert list(stream_batches(source, 3, 3, workers)) == []
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("workers", [0, 1])
def test_an_error_of_the_source_arrives_with_its_message(workers):
    source = make_source(BrokenSource)
    stream = stream_batches(source, 5, 100, workers)
    assert same(next(stream), source.batch(5))
    assert same(next(stream), source.batch(6))
    with pytest.raises(ArithmeticError, match="batch 7 cannot be drawn"):
        next(stream)
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_the_group_does_not_end_the_workers(number):
    source = make_source()
    stream = stream_batches(source, 0, 30, 1)
    assert same(next(stream), source.batch(0))
    (worker,) = multiprocessing.active_children()
    os.kill(worker.pid, number)
    rest = [same(problems, source.batch(index)) for index, problems in enumerate(stream, 1)]
    assert rest == [True] * 29


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
