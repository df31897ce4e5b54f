"""Shards of problems: the poses are those of a call, each shard is solved once, also after an interruption."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from kornia_pnpnet import create_solver
from kornia_pnpnet.cli import main
from kornia_pnpnet.cli.correspondence_files import InputError
from kornia_pnpnet.cli.shards import MANIFEST, solve_shards

NAMES = ("world_points", "img_points", "intrinsics")


@pytest.fixture
def solver():
    return create_solver("reppnp")


def arrays(problems):
    return {name: getattr(problems, name).numpy() for name in NAMES}


@pytest.fixture
def shards(tmp_path, make_problems):
    """Three shards of problems and the problems."""
    folder = tmp_path / "shards"
    folder.mkdir()
    drawn = [make_problems(n=9, batch=7, outliers=1, seed=i, dtype=torch.float32) for i in range(3)]
    for i, problems in enumerate(drawn):
        np.savez(folder / f"part{i}.npz", **arrays(problems))
    return folder, drawn


def test_poses_are_those_of_a_call(shards, solver, tmp_path):
    folder, drawn = shards
    report = solve_shards(solver, [folder], tmp_path / "out", name="reppnp", batch=3)
    assert report == (sum(int(solver(*p[:3]).ok.sum()) for p in drawn), 21, 3, 0, [])
    for i, problems in enumerate(drawn):
        expected = solver(*problems[:3])
        with np.load(tmp_path / "out" / f"part{i}.npz") as found:
            assert set(found.files) == {"rotation", "translation", "weights", "cost", "ok"}
            assert found["ok"].tolist() == expected.ok.tolist()
            np.testing.assert_allclose(found["translation"], expected.translation, rtol=1e-4)
            assert found["weights"].dtype == np.float32


def test_it_goes_on_with_the_first_shard_without_a_result(shards, solver, tmp_path, monkeypatch):
    folder, _ = shards
    out = tmp_path / "out"
    calls = []

    def stopped(shard, *_):
        calls.append(shard.name)
        if len(calls) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        solve_shards(solver, [folder], out, name="reppnp", watch=stopped)
    assert sorted(x.name for x in out.iterdir()) == [MANIFEST, "part0.npz", "part1.npz"]
    before = (out / "part0.npz").stat().st_mtime_ns
    assert solve_shards(solver, [folder], out, name="reppnp")[2:] == (1, 2, [])
    assert (out / "part0.npz").stat().st_mtime_ns == before
    assert solve_shards(solver, [folder], out, name="reppnp", overwrite=True).shards == 3
    assert (out / "part0.npz").stat().st_mtime_ns > before


def test_another_solver_does_not_go_on_in_the_same_folder(shards, solver, tmp_path):
    folder, _ = shards
    solve_shards(solver, [folder], tmp_path / "out", name="reppnp")
    with pytest.raises(InputError, match="pnpnet-n9"):
        solve_shards(create_solver("pnpnet-n9"), [folder], tmp_path / "out", name="pnpnet-n9")
    one = next(folder.iterdir())
    with pytest.raises(InputError, match="all of them"):
        solve_shards(create_solver("pnpnet-n9"), [one], tmp_path / "out", name="pnpnet-n9", overwrite=True)

    def stopped(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):  # the results left in the folder are by one solver
        solve_shards(create_solver("epnp"), [folder], tmp_path / "out", name="epnp", overwrite=True, watch=stopped)
    assert len(list((tmp_path / "out").glob("*.npz"))) == 1
    assert solve_shards(solver, [folder], tmp_path / "out", name="reppnp", overwrite=True).shards == 3
    (tmp_path / "out" / MANIFEST).write_text("{")
    with pytest.raises(InputError, match="reppnp"):
        solve_shards(solver, [folder], tmp_path / "out", name="reppnp")


def test_a_shard_that_cannot_be_read_stops_no_other(shards, solver, tmp_path):
    folder, drawn = shards
    good = arrays(drawn[0])
    (folder / "a.npz").write_bytes(b"PK\x03\x04 nothing")
    np.savez(folder / "b.npz", world_points=good["world_points"])
    np.savez(folder / "c.npz", **{**good, "img_points": good["img_points"][:5]})
    np.savez(folder / "d.npz", **{**good, "world_points": good["world_points"].astype(object)})
    np.savez(folder / "e.npz", world_points=good["world_points"], img_points=good["img_points"])
    report = solve_shards(solver, [folder], tmp_path / "out", name="reppnp")
    assert report.shards == 3
    for name, why in zip(
        "abcde", ("not an NPZ", "no array img_points", "of the shape", "not an NPZ", "pass --intrinsics"), strict=True
    ):
        (line,) = (x for x in report.failed if f"/{name}.npz" in x)
        assert why in line
    assert sorted(x.name for x in (tmp_path / "out").iterdir())[1:] == ["part0.npz", "part1.npz", "part2.npz"]


def test_one_bad_problem_is_not_ok_and_no_more(shards, solver, tmp_path):
    folder, drawn = shards
    broken = arrays(drawn[0])
    broken["world_points"] = broken["world_points"].copy()
    broken["world_points"][2, 3] = np.nan
    np.savez(folder / "part0.npz", **broken)
    solve_shards(solver, [folder / "part0.npz"], tmp_path / "out", name="reppnp")
    with np.load(tmp_path / "out" / "part0.npz") as found:
        assert not found["ok"][2]
        assert found["ok"].sum() >= 5
        assert np.isfinite(found["rotation"]).all()


def test_weights_noise_and_a_shared_camera(make_problems, tmp_path):
    p = make_problems(n=9, batch=5, dtype=torch.float32)
    weights = torch.ones(5, 9)
    weights[:, 7:] = 0.0
    np.savez(tmp_path / "x.npz", **arrays(p) | {"weights": weights.numpy(), "img_sigma": np.array(1.0)})
    solver = create_solver("pnpnet-set")
    solve_shards(solver, [tmp_path / "x.npz"], tmp_path / "out", name="pnpnet-set")
    with torch.no_grad():
        expected = solver(*p[:3], weights=weights, img_sigma=1.0)
    with np.load(tmp_path / "out" / "x.npz") as found:
        np.testing.assert_allclose(found["rotation"], expected.rotation, atol=1e-5)
        assert (found["weights"][:, 7:] == 0).all()
    two = arrays(p)
    camera = torch.from_numpy(two.pop("intrinsics"))[0]
    np.savez(tmp_path / "y.npz", **two)
    assert solve_shards(solver, [tmp_path / "y.npz"], tmp_path / "z", name="pnpnet-set", intrinsics=camera).shards == 1


@pytest.mark.parametrize("nested", [False, True])
def test_parquet_with_numbers_of_pairs_that_differ(nested, make_problems, tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    drawn = [make_problems(n=n, batch=1, dtype=torch.float32) for n in (6, 12, 9, 30)]
    rows = [{name: (x[0] if nested else x[0].flatten()).tolist() for name, x in arrays(p).items()} for p in drawn]
    parquet.write_table(pyarrow.Table.from_pylist(rows), tmp_path / "x.parquet")
    solver = create_solver("pnpnet-set")
    report = solve_shards(solver, [tmp_path / "x.parquet"], tmp_path / "out", name="pnpnet-set", batch=3)
    assert report[1:] == (4, 1, 0, [])
    found = parquet.read_table(tmp_path / "out" / "x.parquet").to_pylist()
    for row, p in zip(found, drawn, strict=True):
        with torch.no_grad():
            alone = solver(*p[:3])
        np.testing.assert_allclose(row["translation"], alone.translation[0], rtol=1e-3)
        assert len(row["weights"]) == p.world_points.shape[1]
        assert row["ok"] == alone.ok.item()
    rows[1]["img_points"] = rows[1]["img_points"][:-1]
    parquet.write_table(pyarrow.Table.from_pylist(rows), tmp_path / "bad.parquet")
    (tmp_path / "no.parquet").write_bytes(b"PAR1")
    report = solve_shards(
        solver, [tmp_path / "bad.parquet", tmp_path / "no.parquet"], tmp_path / "out", name="pnpnet-set"
    )
    assert f"row 1: img_points must have 24 numbers, got {22 if nested else 23}" in report.failed[0]
    assert "not a Parquet file" in report.failed[1]
    assert not (tmp_path / "out" / "bad.parquet").exists()


def test_sources_that_are_no_shards(shards, solver, tmp_path):
    folder, drawn = shards
    (tmp_path / "empty").mkdir()
    np.savez(tmp_path / "part0.npz", **arrays(drawn[0]))
    for sources, why in (
        ([tmp_path / "empty"], "no .npz or .parquet file"),
        ([tmp_path / "x.npz"], "no such file"),
        ([tmp_path / "x.txt"], "must end in"),
        ([folder, tmp_path / "part0.npz"], "same name"),
        ([folder], None),
    ):
        out = folder if why is None else tmp_path / "out"
        before = {x.name: x.read_bytes() for x in folder.iterdir()}
        with pytest.raises(InputError, match=why or "overwrite the shard"):
            solve_shards(solver, sources, out, name="reppnp", overwrite=True)
        assert {x.name: x.read_bytes() for x in folder.iterdir()} == before


def test_the_command(shards, tmp_path, capsys):
    folder, _ = shards
    command = ["solve", "--batch", str(folder), "--out", str(tmp_path / "out"), "--solver", "reppnp"]
    assert main(command) == 0
    assert "of 21 problems in 3 shards solved" in capsys.readouterr().out
    assert main(command) == 0
    assert "3 shards had been solved before" in capsys.readouterr().out
    assert json.loads((tmp_path / "out" / MANIFEST).read_text())["solver"] == "reppnp"
    (folder / "z.npz").write_bytes(b"")
    assert main(command) == 2
    assert "z.npz" in capsys.readouterr().err
    assert main(["solve", str(folder / "part0.npz"), str(folder / "part1.npz")]) == 2
    assert "--batch" in capsys.readouterr().err
    assert main([*command, "--plot", "x.png"]) == 2


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
    one = arrays(make_problems(n=40, batch=10_000, dtype=torch.float32))
    np.savez(tmp_path / "one.npz", **one)
    rows = 1000 if kind == "Parquet in row groups" else 200_000
    peaks = []
    for times in (2, 20):
        folder = tmp_path / f"{times}"
        folder.mkdir()
        if kind == "shards":
            for i in range(times):
                (folder / f"{i}.npz").symlink_to(tmp_path / "one.npz")
        else:
            pyarrow = pytest.importorskip("pyarrow")
            parquet = pytest.importorskip("pyarrow.parquet")
            table = pyarrow.table({key: [*x.reshape(10_000, -1)] for key, x in one.items()})
            parquet.write_table(pyarrow.concat_tables(times * [table]), folder / "x.parquet", row_group_size=rows)
        peaks.append(peak_memory(folder, times * 10_000))
    assert peaks[1] < 1.1 * peaks[0]
