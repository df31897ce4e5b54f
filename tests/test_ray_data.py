"""Ray Data with two workers: no problem is lost, and the results are those of one process, also when a worker dies."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import table

from kornia_pnpnet.data import SyntheticProblems

pytest.importorskip("ray", reason="needs the extra scale")
pa = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")
from kornia_pnpnet.arrow import Solve  # noqa: E402

pytestmark = pytest.mark.slow
EXAMPLES = Path(__file__).resolve().parents[1] / "docs" / "examples"
FILES, ROWS, BATCH = 6, 1000, 500
DEADLINE = 1200  # seconds; starting Ray takes minutes on a busy machine

#: Runs the example on two nodes with one core each.
SCRIPT = f"""
import signal, sys
import ray, ray_data
from ray.cluster_utils import Cluster
from workers import Watched

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
ray_data.BLOCK = 50_000  # bytes
cluster = Cluster(initialize_head=True, head_node_args={{"num_cpus": 1}})
cluster.add_node(num_cpus=1)
ray.init(address=cluster.address, log_to_driver=False)
options = dict(zip(("source", "out", "id_column"), sys.argv[1:]))
ray_data.Solve = Watched
ray_data.solve(solver="pnpnet-n9", workers=2, batch={BATCH}, **options)
ray.shutdown()
cluster.shutdown()
"""

#: Notes the rows of each call. In its third call a worker is killed once where there is a file "die", and waits for as
#: long as there is a file "wait".
WORKERS = """
import os, signal, time
from pathlib import Path
from kornia_pnpnet.arrow import Solve

HERE = Path(__file__).parent

class Watched(Solve):
    calls = 0

    def __call__(self, table):
        self.calls += 1
        if self.calls == 3 and (HERE / "die").exists():
            (HERE / "die").rename(HERE / "died")
            os.kill(os.getpid(), signal.SIGKILL)
        while self.calls == 3 and (HERE / "wait").exists():
            time.sleep(0.1)
        (HERE / "calls" / f"{os.getpid()}-{self.calls}").write_text(str(len(table)))
        return super().__call__(table)
"""


@pytest.fixture
def start(tmp_path):
    """Start the example on problems in ``tmp_path / "in"``; results come to ``tmp_path / "out"``."""
    (tmp_path / "in").mkdir()
    (tmp_path / "calls").mkdir()
    (tmp_path / "workers.py").write_text(WORKERS)
    for i in range(FILES):
        drawn = SyntheticProblems(n=9, batch_size=ROWS, seed=i, dtype=torch.float32).batch(0)
        rows = pa.array(np.arange(i * ROWS, (i + 1) * ROWS))
        parquet.write_table(table(drawn).add_column(0, "id", rows), tmp_path / "in" / f"{i}.parquet")
    paths = os.pathsep.join([str(tmp_path), str(EXAMPLES), os.environ.get("PYTHONPATH", "")])
    variables = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "RAY_USAGE_STATS_ENABLED": "0"}
    command = [sys.executable, "-c", SCRIPT, "in", "out"]  # Ray's checkpoints need absolute paths
    processes = []

    def run(*more):
        processes.append(subprocess.Popen([*command, *more], env=variables, cwd=tmp_path))
        return processes[-1]

    yield run
    for process in processes:
        process.kill()
        process.wait()


def check_results(folder):
    """Each problem is solved once, and as in one process."""
    found = parquet.read_table(folder / "out").sort_by("id")
    assert found["id"].to_pylist() == [*range(FILES * ROWS)]
    expected = Solve("pnpnet-n9")(parquet.read_table(folder / "in").sort_by("id"))
    assert found["ok"].to_pylist() == expected["ok"].to_pylist()
    for name in ("rotation", "translation"):
        np.testing.assert_allclose(found[name].to_pylist(), expected[name].to_pylist(), rtol=1e-3, atol=1e-4)


def test_a_killed_worker_loses_nothing(start, tmp_path):
    (tmp_path / "die").touch()
    assert start().wait(DEADLINE) == 0
    assert (tmp_path / "died").exists()
    check_results(tmp_path)


def test_a_stopped_run_goes_on_where_it_was(start, tmp_path):
    (tmp_path / "wait").touch()
    process = start("id")
    done, deadline = tmp_path / "out.done", time.monotonic() + DEADLINE
    while not [path for path in done.glob("*.parquet") if "pending" not in path.name] and time.monotonic() < deadline:
        assert process.poll() is None
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    assert process.wait(DEADLINE) != 0
    (tmp_path / "wait").unlink()
    for path in (tmp_path / "calls").iterdir():
        path.unlink()
    assert start("id").wait(DEADLINE) == 0
    assert 0 < sum(int(path.read_text()) for path in (tmp_path / "calls").iterdir()) < FILES * ROWS
    check_results(tmp_path)
    before = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert start("id").wait(DEADLINE) == 0  # nothing is left to do
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == before
