"""Tables and shards of problems: the poses are those of a call, and no row or shard stops or changes another one."""

import os
import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch
from helpers import arrays, run_main
from helpers import table as table_of
from kornia.core.exceptions import ShapeError, TypeCheckError, ValueCheckError

from kornia_pnpnet import MLPInit, PnPNet, create_solver
from kornia_pnpnet.cli.correspondence_files import InputError

pa = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")
from kornia_pnpnet.arrow import OUTPUTS, Solve  # noqa: E402
from kornia_pnpnet.cli.shards import solve_shards  # noqa: E402

NAMES = ("world_points", "img_points", "intrinsics")
SOLVE = Solve("reppnp")
BAD = {"a missing list": ("world_points", None, "malformed"), "an empty list": ("img_points", [], "malformed")}
BAD |= {"too few pixels": ("img_points", [1.0] * 17, "malformed"), "no camera": ("intrinsics", [0.0] * 9, "camera")}
COUNTS = {"two pairs": 6, "part of a point": 28, "too many points": 30}
BAD |= {name: ("world_points", [1.0] * count, "malformed") for name, count in COUNTS.items()}
BAD |= {"half a camera": ("intrinsics", [1.0] * 4, "malformed"), "NaN": ("img_points", [np.nan] * 18, "not_finite")}
BAD |= {"a missing number": ("world_points", [None, *[1.0] * 26], "not_finite")}
BAD |= {"a missing point": ("world_points", [[1.0] * 3] * 5 + [None] + [[1.0] * 3] * 4, "malformed")}
BAD |= {"one point": ("world_points", [1.0] * 27, "degenerate")}


@pytest.fixture
def draw(make_problems):
    """Draw problems, and their table with more columns."""

    def make(n=9, batch=7, seed=0, **more):
        problems = make_problems(n=n, batch=batch, seed=seed, dtype=torch.float32)
        return problems, table_of(problems, **more)

    return make


def numbers(table, name):
    return np.array(table[name].to_pylist())


@pytest.mark.parametrize("name", ["epnp-lm", "p3p-ransac", "pnpnet-n9", "pnpnet-set", "poselib", "unknown focal"])
def test_poses_are_those_of_a_call(name, draw):
    if name == "poselib":
        pytest.importorskip("poselib")
    unknown = name.startswith("unknown")
    solver = create_solver("pnpnet-set", focal="unknown", radial=1) if unknown else create_solver(name)
    problems, table = draw()
    expected, found = solver(*problems[:3]), Solve(solver)(table)
    assert found["ok"].to_pylist() == expected.ok.tolist()
    for key in ("rotation", "translation", "weights", "cost", *("intrinsics", "dist") * unknown):
        np.testing.assert_array_equal(numbers(found, key).ravel(), getattr(expected, key).numpy().ravel())


def test_weights_sigmas_and_options_reach_the_solver(draw):
    weights, img_sigma = np.ones((7, 9), np.float32), np.linspace(0.5, 2.0, 63, dtype=np.float32).reshape(7, 9)
    weights[:, 7:] = 0.0
    world_sigma = np.full((7, 1), 0.05, np.float32)
    problems, table = draw(weights=weights, img_sigma=img_sigma, world_sigma=world_sigma)
    tensors = {"weights": weights, "img_sigma": img_sigma, "world_sigma": world_sigma.repeat(9, 1)}
    expected = create_solver("pnpnet-set", m=3)(*problems[:3], **{k: torch.from_numpy(x) for k, x in tensors.items()})
    as_number = table.set_column(5, "world_sigma", pa.array(world_sigma[:, 0]))
    as_number = as_number.set_column(3, "weights", pa.array((weights > 0).tolist()))
    for given in (table, as_number):
        found = Solve("pnpnet-set", m=np.int64(3))(given)
        np.testing.assert_array_equal(numbers(found, "translation"), expected.translation)


def test_a_camera_for_all(draw):
    problems, table = draw()
    camera = problems.intrinsics[0]
    assert Solve("epnp-lm", intrinsics=camera)(table.drop_columns("intrinsics")) == Solve("epnp-lm")(table)
    with pytest.raises(ShapeError):
        Solve("epnp-lm", intrinsics=camera[:2])


@pytest.mark.parametrize("name", ["epnp-lm", "pnpnet-set"])
def test_rows_of_different_numbers_of_pairs(name, draw):
    sizes = [6, 40, 9, 17, 9, 33, 16]
    drawn, solve = [draw(n, 1, seed) for seed, n in enumerate(sizes)], Solve(name)
    found = solve(pa.concat_tables(table for _, table in drawn))
    assert [len(x) for x in found["weights"].to_pylist()] == sizes
    for row, (problems, table) in zip(found.to_pylist(), drawn, strict=True):
        alone = solve.solver(*problems[:3])
        np.testing.assert_allclose(row["translation"], alone.translation[0], rtol=1e-3)
        np.testing.assert_allclose(row["weights"], alone.weights[0], rtol=1e-2, atol=1e-4)
        assert row["ok"] == alone.ok.item()
        np.testing.assert_allclose(row["rotation"], numbers(solve(table), "rotation")[0], atol=1e-5)


def test_other_columns_pass_through_and_rows_keep_their_order(draw):
    _, table = draw(batch=5)
    table = table.append_column("id", pa.array([3, 1, 4, 1, 5])).append_column("name", pa.array([*"abcde"]))
    found = Solve("epnp-lm")(table)
    assert found.column_names == ["id", "name", *OUTPUTS]
    assert found["id"].to_pylist() == [3, 1, 4, 1, 5]
    backwards = Solve("epnp-lm")(table.take([4, 3, 2, 1, 0]))
    np.testing.assert_allclose(numbers(backwards, "rotation")[::-1], numbers(found, "rotation"), atol=1e-5)


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_row_is_not_ok_and_changes_no_other(kind, draw):
    name, cell, status = BAD[kind]
    _, table = draw()
    good, cells = Solve("epnp-lm")(table), table[name].to_pylist()
    if cell and isinstance(cell[0], list):
        cells = [np.reshape(x, (-1, 3)).tolist() for x in cells]
    cells[2] = cell
    found = Solve("epnp-lm")(table.set_column(NAMES.index(name), name, pa.array(cells)))
    row = found.to_pylist()[2]
    assert (row["ok"], row["status"]) == (False, status)
    assert row["rotation"] == np.eye(3).ravel().tolist()
    assert np.isfinite([*row["translation"], *row["weights"], row["cost"]]).all()
    others = [0, 1, 3, 4, 5, 6]
    assert found.take(others)["ok"] == good.take(others)["ok"]
    np.testing.assert_allclose(numbers(found, "rotation")[others], numbers(good, "rotation")[others], atol=1e-5)


def test_rows_for_another_network_are_malformed_and_few_rows_are_a_table(draw):
    # Tables of 18 pairs would be padded to 20 pairs for solvers of any number of pairs.
    for n, solver in ((9, "pnpnet-n9"), (18, PnPNet(MLPInit(18)).eval())):
        table, solve = pa.concat_tables([draw(n - 1, 2)[1], draw(n, 3)[1]]), Solve(solver)
        status = solve(table)["status"].to_pylist()
        assert [x == "malformed" for x in status] == [True] * 2 + [False] * 3
        assert n == 18 or status[2:] == ["solved"] * 3
    assert [len(solve(table.slice(2, rows))) for rows in (0, 1)] == [0, 1]


def test_any_kind_of_list(draw):
    _, table = draw()
    expected = numbers(Solve("epnp-lm")(table.slice(2, 3)), "translation")
    for make in (
        lambda x: x.cast(pa.large_list(pa.float64())),
        lambda x: x.cast(pa.list_(pa.float64(), len(x[0]))),
        lambda x: pa.array([np.reshape(y, (-1, 1)).tolist() for y in x.to_pylist()]),
        lambda x: pa.chunked_array([x.combine_chunks()[:3], x.combine_chunks()[3:]]),
    ):
        other = pa.table({name: make(table[name]) for name in NAMES})
        np.testing.assert_allclose(numbers(Solve("epnp-lm")(other.slice(2, 3)), "translation"), expected, rtol=1e-4)
    far = pa.array([np.add(x, 5e6).tolist() for x in table["world_points"].to_pylist()])  # too far for float32
    found = Solve("epnp-lm")(table.set_column(NAMES.index("world_points"), "world_points", far))
    np.testing.assert_allclose(numbers(found, "rotation"), numbers(Solve("epnp-lm")(table), "rotation"), atol=1e-4)


def test_tables_that_are_not_of_problems(draw):
    _, table = draw()
    wrong = [(table.drop_columns(name), ValueCheckError) for name in ("img_points", "intrinsics")]
    texts = pa.array(["x"] * 7), pa.array([["x"]] * 7)
    wrong += [(table.set_column(0, "world_points", column), TypeCheckError) for column in texts]
    wrong += [(table.append_column(name, table[0]), ValueCheckError) for name in (*NAMES, "mask")]
    for changed, error in wrong:
        with pytest.raises(error):
            Solve("epnp-lm")(changed)


def test_a_worker_gets_it_pickled(draw):
    _, table = draw()
    for solve in (Solve("pnpnet-n9"), Solve(create_solver("pnpnet-set").eval())):
        assert pickle.loads(pickle.dumps(solve))(table) == solve(table)


def test_no_call_of_the_solver_is_large(draw):
    _, table = draw(batch=50)
    solve = Solve("epnp-lm")
    expected, called = solve(table), []
    solve.solver.register_forward_hook(lambda _, args, result: called.append(result.weights.numel()))
    solve.pairs_at_once = 100
    np.testing.assert_allclose(numbers(solve(table), "rotation"), numbers(expected, "rotation"), atol=1e-5)
    assert sum(called) == 450
    assert max(called) <= 100


@pytest.fixture
def shards(tmp_path, make_problems):
    """Two NPZ files and a Parquet file of problems, and the problems."""
    folder = tmp_path / "shards"
    folder.mkdir()
    drawn = [make_problems(n=9, batch=7, outliers=1, seed=i, dtype=torch.float32) for i in range(3)]
    for i, problems in enumerate(drawn[:2]):
        np.savez(folder / f"part{i}.npz", **arrays(problems))
    parquet.write_table(table_of(drawn[2]), folder / "part2.parquet")
    return folder, drawn


@pytest.mark.parametrize("name", ["confidence", "dist", "img_cov", "cam_from_rig"])
def test_columns_that_would_have_no_effect_are_refused(name, make_problems):
    table = table_of(make_problems(n=6, batch=2, dtype=torch.float32))
    with pytest.raises(ValueCheckError, match=f"column {name} is not read"):
        SOLVE(table.append_column(name, pa.array([[0.0] * 4] * 2)))


def test_results_of_shards_are_those_of_the_tables_and_not_taken_for_others(shards, tmp_path):
    (folder, drawn), out = shards, tmp_path / "out"
    report = solve_shards(SOLVE, [folder], out, name="reppnp", batch=7)
    assert report == (sum(int(SOLVE.solver(*p[:3]).ok.sum()) for p in drawn), 21, 3, 0, [])
    for i, problems in enumerate(drawn):
        assert parquet.read_table(out / f"part{i}.parquet") == SOLVE(table_of(problems))
    other, option = Solve("pnpnet-n9"), Solve("reppnp", reject_outliers=False)
    camera, focal = Solve(SOLVE.solver, intrinsics=torch.eye(3)), Solve("reppnp", focal="unknown")
    for solve, name in ((other, "pnpnet-n9"), *((x, "reppnp") for x in (other, option, camera, focal))):
        with pytest.raises(InputError, match=name):
            solve_shards(solve, [folder], out, name=name)
    np.savez(tmp_path / "part0.npz", **arrays(drawn[1]))  # has the name of another shard
    with pytest.raises(InputError, match="no results of reppnp with these options for"):
        solve_shards(SOLVE, [tmp_path / "part0.npz"], out, name="reppnp")
    assert solve_shards(SOLVE, [folder], out, name="reppnp").kept == 3
    assert solve_shards(other, [folder], out, name="pnpnet-n9", overwrite=True).shards == 3
    (out / "part0.parquet").write_bytes(b"{")
    with pytest.raises(InputError, match="part0"):
        solve_shards(other, [folder], out, name="pnpnet-n9")


def test_a_shard_is_read_in_batches_and_keeps_other_columns(shards, tmp_path, make_problems):
    _, drawn = shards
    tables = [table_of(problems) for problems in (*drawn, make_problems(n=6, batch=2, dtype=torch.float32))]
    parquet.write_table(pa.concat_tables(tables).append_column("id", pa.array(range(23))), tmp_path / "x.parquet")
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


def test_a_shard_that_cannot_be_read_stops_no_other(shards, tmp_path):
    folder, drawn = shards
    good = arrays(drawn[0])
    world, img = good["world_points"], good["img_points"]
    bad = [{"world_points": world}, {"world_points": world, "img_points": img}, good | {"img_points": img[:5]}]
    bad += [good | {"world_points": world.astype(object)}, good | {"world_points": world.swapaxes(1, 2)}]
    for name, content in zip("bcdef", bad, strict=True):
        np.savez(folder / f"{name}.npz", **content)
    (folder / "a.npz").write_bytes(b"PK\x03\x04 nothing")
    (folder / "g.parquet").write_bytes(b"PAR1")
    parquet.write_table(table_of(drawn[0]).drop_columns("intrinsics"), folder / "h.parquet")
    report = solve_shards(SOLVE, [folder], tmp_path / "out", name="reppnp")
    assert report.shards == 3
    assert all(f"/{name}." in line for name, line in zip("abcdefgh", report.failed, strict=True))
    assert sorted(x.stem for x in (tmp_path / "out").iterdir()) == ["part0", "part1", "part2"]


def test_weights_noise_and_a_shared_camera_in_arrays(make_problems, tmp_path):
    p = make_problems(n=9, batch=5, dtype=torch.float32)
    weights = (torch.arange(9) < 7).float().repeat(5, 1)
    of_all = {"img_sigma": np.array(1.0), "intrinsics": p.intrinsics[0].numpy()}
    np.savez(tmp_path / "x.npz", **arrays(p) | {"weights": weights.numpy()} | of_all)
    solver = create_solver("pnpnet-set")
    solve_shards(Solve(solver), [tmp_path / "x.npz"], tmp_path / "out", name="pnpnet-set")
    expected = solver(*p[:3], weights=weights, img_sigma=1.0)
    found = parquet.read_table(tmp_path / "out" / "x.parquet")
    np.testing.assert_allclose(found["rotation"].to_pylist(), expected.rotation.flatten(1), atol=1e-5)


def test_sources_that_are_no_shards(shards, tmp_path):
    folder, drawn = shards
    (tmp_path / "empty").mkdir()
    np.savez(tmp_path / "part2.npz", **arrays(drawn[0]))
    wrong = {"empty": "no .npz or .parquet file", "x.npz": "no such file", "x.txt": "must end in"}
    cases = [([tmp_path / name], "out", why) for name, why in wrong.items()]
    cases += [([folder, tmp_path / "part2.npz"], "out", "would have the name"), ([folder], folder, "another folder")]
    for sources, out, why in cases:
        before = {x.name: x.read_bytes() for x in folder.iterdir()}
        with pytest.raises(InputError, match=why):
            solve_shards(SOLVE, sources, tmp_path / out, name="reppnp", overwrite=True)
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
            many = pa.concat_tables(times * [table_of(problems)])
            parquet.write_table(many, folder / "x.parquet", row_group_size=rows)
        peaks.append(peak_memory(folder, times * 10_000))
    assert peaks[1] < 1.1 * peaks[0]
