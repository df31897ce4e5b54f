"""Shards of problems: each is solved once, also after an interruption, and its results say of which solver they are."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from data_helpers import arrays, table
from strategies import run_main

from kornia_pnpnet import create_solver
from kornia_pnpnet.cli.correspondence_files import InputError

pa = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")
from kornia_pnpnet.arrow import OUTPUTS, Solve  # noqa: E402
from kornia_pnpnet.cli.shards import solve_shards  # noqa: E402


@pytest.fixture
def solve():
    return Solve("reppnp")


@pytest.fixture
def shards(tmp_path, make_problems):
    """Two NPZ files and a Parquet file of problems, and the problems."""
    folder = tmp_path / "shards"
    folder.mkdir()
    drawn = [make_problems(n=9, batch=7, outliers=1, seed=i, dtype=torch.float32) for i in range(3)]
    for i, problems in enumerate(drawn[:2]):
        np.savez(folder / f"part{i}.npz", **arrays(problems))
    parquet.write_table(table(drawn[2]), folder / "part2.parquet")
    return folder, drawn


def test_results_are_those_of_the_tables(shards, solve, tmp_path):
    folder, drawn = shards
    report = solve_shards(solve, [folder], tmp_path / "out", name="reppnp", batch=7)
    assert report == (sum(int(solve.solver(*p[:3]).ok.sum()) for p in drawn), 21, 3, 0, [])
    for i, problems in enumerate(drawn):
        assert parquet.read_table(tmp_path / "out" / f"part{i}.parquet") == solve(table(problems))


def test_a_shard_is_read_in_batches_and_keeps_other_columns(shards, tmp_path, make_problems):
    _, drawn = shards
    problems = pa.concat_tables([table(p) for p in drawn] + [table(make_problems(n=6, batch=2, dtype=torch.float32))])
    parquet.write_table(problems.append_column("id", pa.array(range(23))), tmp_path / "x.parquet")
    sizes = []

    class Watched(Solve):
        def __call__(self, part):
            sizes.append(len(part))
            return super().__call__(part)

    solve_shards(Watched("epnp-lm"), [tmp_path / "x.parquet"], tmp_path / "out", name="epnp-lm", batch=5)
    found = parquet.read_table(tmp_path / "out" / "x.parquet")
    assert sizes == [5, 5, 5, 5, 3]
    assert found.column_names == ["id", *OUTPUTS]
    assert found["id"].to_pylist() == [*range(23)]


def test_results_of_another_solver_are_not_taken_for_its_own(shards, solve, tmp_path):
    folder, _ = shards
    out = tmp_path / "out"
    solve_shards(solve, [folder], out, name="reppnp")
    other = Solve("pnpnet-n9")
    with pytest.raises(InputError, match="pnpnet-n9"):
        solve_shards(other, [folder], out, name="pnpnet-n9")
    with pytest.raises(InputError, match="reppnp"):  # of this name, but with other parameters
        solve_shards(other, [folder], out, name="reppnp")
    assert solve_shards(other, [folder], out, name="pnpnet-n9", overwrite=True).shards == 3
    (out / "part0.parquet").write_bytes(b"{")
    with pytest.raises(InputError, match="part0"):
        solve_shards(other, [folder], out, name="pnpnet-n9")


def test_a_shard_that_cannot_be_read_stops_no_other(shards, solve, tmp_path):
    folder, drawn = shards
    good = arrays(drawn[0])
    world, img = good["world_points"], good["img_points"]
    bad = {
        "b": {"world_points": world},
        "c": good | {"img_points": img[:5]},
        "d": good | {"world_points": world.astype(object)},
        "e": {"world_points": world, "img_points": img},
        "f": good | {"world_points": world.swapaxes(1, 2)},
    }
    for name, content in bad.items():
        np.savez(folder / f"{name}.npz", **content)
    (folder / "a.npz").write_bytes(b"PK\x03\x04 nothing")
    (folder / "g.parquet").write_bytes(b"PAR1")
    parquet.write_table(table(drawn[0]).drop_columns("intrinsics"), folder / "h.parquet")
    report = solve_shards(solve, [folder], tmp_path / "out", name="reppnp")
    assert report.shards == 3
    for name, line in zip("abcdefgh", report.failed, strict=True):
        assert f"/{name}." in line
    assert sorted(x.stem for x in (tmp_path / "out").iterdir()) == ["part0", "part1", "part2"]


def test_weights_noise_and_a_shared_camera_in_arrays(make_problems, tmp_path):
    p = make_problems(n=9, batch=5, dtype=torch.float32)
    weights = torch.ones(5, 9)
    weights[:, 7:] = 0.0
    of_all = {"img_sigma": np.array(1.0), "intrinsics": p.intrinsics[0].numpy()}
    np.savez(tmp_path / "x.npz", **arrays(p) | {"weights": weights.numpy()} | of_all)
    solver = create_solver("pnpnet-set")
    solve_shards(Solve(solver), [tmp_path / "x.npz"], tmp_path / "out", name="pnpnet-set")
    with torch.no_grad():
        expected = solver(*p[:3], weights=weights, img_sigma=1.0)
    found = parquet.read_table(tmp_path / "out" / "x.parquet")
    np.testing.assert_allclose(found["rotation"].to_pylist(), expected.rotation.flatten(1), atol=1e-5)


def test_sources_that_are_no_shards(shards, solve, tmp_path):
    folder, drawn = shards
    (tmp_path / "empty").mkdir()
    np.savez(tmp_path / "part2.npz", **arrays(drawn[0]))
    for sources, out, why in (
        ([tmp_path / "empty"], "out", "no .npz or .parquet file"),
        ([tmp_path / "x.npz"], "out", "no such file"),
        ([tmp_path / "x.txt"], "out", "must end in"),
        ([folder, tmp_path / "part2.npz"], "out", "would have the name"),
        ([folder], folder, "another folder"),
    ):
        before = {x.name: x.read_bytes() for x in folder.iterdir()}
        with pytest.raises(InputError, match=why):
            solve_shards(solve, sources, tmp_path / out, name="reppnp", overwrite=True)
        assert {x.name: x.read_bytes() for x in folder.iterdir()} == before


def test_the_command(shards, tmp_path):
    folder, _ = shards
    command = "solve", "--batch", folder, "--out", tmp_path / "out", "--solver", "reppnp"
    code, out, _ = run_main(*command)
    assert code == 0
    assert "of 21 problems in 3 shards solved" in out
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()}
    (folder / "z.npz").write_bytes(b"")
    code, out, err = run_main(*command)
    assert code == 2
    assert "3 shards had been solved before" in out
    assert "z.npz" in err
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()} == before
    for wrong in (("solve", folder / "part0.npz", folder / "part1.npz"), (*command, "--plot", "x.png")):
        code, _, err = run_main(*wrong)
        assert code == 2
        assert "--batch" in err


# `getrusage` may include the memory of the parent process.
PEAK = r"""
import re, sys
from pathlib import Path
from kornia_pnpnet.cli import main
code = main()
print(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1])
sys.exit(code)
"""


def peak_memory(folder, count):
    """The largest resident memory of the command while it solves ``count`` problems."""
    command = [sys.executable, "-c", PEAK, "solve", "--batch", "--solver", "epnp", "--batch-size", "1000", str(folder)]
    plain = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run([*command, "--out", f"{folder}-out"], capture_output=True, text=True, check=True, env=plain)
    *_, said, peak = done.stdout.splitlines()
    assert f" of {count} problems" in said
    return int(peak)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("kind", ["shards", "Parquet", "Parquet in row groups"])
def test_memory_does_not_grow_with_the_data(kind, make_problems, tmp_path):
    """Ten times the data, 160 MB: in shards, in one Parquet file that is one row group, in one that has many."""
    problems = make_problems(n=40, batch=10_000, dtype=torch.float32)
    np.savez(tmp_path / "one.npz", **arrays(problems))
    rows = 1000 if kind == "Parquet in row groups" else 200_000
    peaks = []
    for times in (2, 20):
        folder = tmp_path / f"{times}"
        folder.mkdir()
        if kind == "shards":
            for i in range(times):
                (folder / f"{i}.npz").symlink_to(tmp_path / "one.npz")
        else:
            many = pa.concat_tables(times * [table(problems)])
            parquet.write_table(many, folder / "x.parquet", row_group_size=rows)
        peaks.append(peak_memory(folder, times * 10_000))
    assert peaks[1] < 1.1 * peaks[0]
