"""Fuzz of the command line: damaged files, arbitrary arguments, damaged results."""

import io
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from data_helpers import arrays, table
from hypothesis import given
from hypothesis import strategies as st
from strategies import WORDS, damage, many, places_in, run_main, spoiled

from kornia_pnpnet.data import OutlierMix, SyntheticProblems


def problem_file(kind):
    """The bytes of a sound file, and how its name ends."""
    problems = SyntheticProblems(n=9, batch_size=3, seed=0, outliers=OutlierMix(count=0)).batch(0)
    single, file = arrays(problems.map(lambda x: x[0])), io.BytesIO()
    match kind:
        case "csv":
            rows = np.concatenate((single["world_points"], single["img_points"]), 1)
            file.write("\n".join(["X,Y,Z,u,v", *(",".join(map(str, row)) for row in rows)]).encode())
        case "npz":
            np.savez(file, **single)
        case "shard npz":
            np.savez_compressed(file, **arrays(problems))
        case "shard parquet":
            pytest.importorskip("pyarrow.parquet").write_table(table(problems), file)
    return file.getvalue(), kind.split()[-1]


@pytest.mark.filterwarnings("ignore")  # of NumPy, about headers and overlapping entries
@pytest.mark.parametrize("kind", ["csv", "npz", "shard npz", "shard parquet"])
def test_damaged_files_are_a_line_and_no_traceback(kind, tmp_path):
    sound, suffix = problem_file(kind)
    path, shard = tmp_path / f"problem.{suffix}", ("--batch", "--out", tmp_path / "out", "--overwrite")
    options = shard if kind.startswith("shard") else ("--intrinsics", "3400,3400,0,0")

    def solve(content):
        path.write_bytes(content)
        return run_main("solve", path, *options, "--solver", "epnp")

    @many(150)
    @given(damage(sound))
    def check_file(content):
        code, out, err = solve(content)
        assert code in (0, 1, 2)
        if code == 2:
            assert err.startswith(f"pnpnet: {path}")
        elif not kind.startswith("shard"):
            assert json.loads(out)["n"] >= 3

    assert solve(sound)[0] == 0
    check_file()


def test_spoiled_results_are_a_line_and_no_traceback(tmp_path, drawn):
    made, path = tmp_path / "results.json", tmp_path / "spoiled.json"
    arguments = "evaluate", "--solver", "epnp", "--problems", "20", "--n", "9,12", "--outliers", "none,3", "--out"
    assert run_main(*arguments, made)[0] == 0
    content = json.loads(made.read_text())
    places = list(places_in(content))
    codes = Counter()

    @many(120)
    @given(spoiled(content, places))
    def run(other):
        path.write_text(json.dumps(other))
        code, _, _ = run_main(*arguments, path, "--plot", tmp_path / "plot")
        codes[code] += 1
        assert code in (0, 2)

    run()
    assert codes[0]
    assert codes[2] >= 5


#: Arguments that keep each command short, and the options that are drawn.
COMMANDS = {
    "solve": (("sound.csv", "--intrinsics", "3400,3400,0,0"), "--solver --threshold --batch-size --focal --camera"),
    "evaluate": (("--solver", "epnp", "--problems", 3), "--solver --data --n --outliers --seed --dtype --plot"),
    "export": (("--solver", "p3p-ransac"), "--pairs"),
    "list": ((), "--x"),
    "demo": (("--problems", 3, "--train-seconds", 0), "--data --problems"),
}
SETS = ["9", "6,9", "none,2", "50%", "uniform", "float64", "gaussian_pose", "p3p-ransac", "1e9"]
TEXTS = WORDS | st.sampled_from(SETS)


def test_any_arguments_are_a_line_and_no_traceback(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("sound.csv").write_bytes(problem_file("csv")[0])
    # No argument changes how a figure is drawn.
    monkeypatch.setattr(pytest.importorskip("matplotlib.figure").Figure, "savefig", lambda *_, **__: None)
    codes = Counter()

    @many(80)
    @given(st.sampled_from(sorted(COMMANDS)), st.data())
    def run(name, data):
        quick, may = COMMANDS[name]
        pairs = data.draw(st.lists(st.tuples(st.sampled_from(may.split()), TEXTS), max_size=2))
        files = data.draw(st.lists(TEXTS, max_size=1))
        code, out, _ = run_main(name, *quick, *(x for pair in pairs for x in pair), *files)
        codes[name, code] += 1
        assert code in (0, 1, 2)
        assert out or code == 2

    run()
    assert all(codes[name, 2] for name in COMMANDS)
    # What `export` needs is not among the words.
    assert all(codes[name, 0] for name in ("solve", "evaluate", "list", "demo"))
