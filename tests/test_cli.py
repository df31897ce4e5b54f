"""The command line says what the library says, and bad input is one line and the exit code 2."""

from __future__ import annotations

import csv
import io
import json
import math
import subprocess
import sys
from collections import Counter
from types import ModuleType

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from kornia_pnpnet.cli.pairs import rejection_limit, reprojections
from strategies import BOOL, WORDS, damage, many, places_in, run_main, spoiled
from torch import nn

import kornia_pnpnet.solver
from kornia_pnpnet import MLPInit, PnPNet, RobustWeightedLM, create_solver, list_solvers
from kornia_pnpnet.cli import main
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.evaluation.named_solvers import BOUNDS, default_solvers
from kornia_pnpnet.evaluation.operations import complexity_results
from kornia_pnpnet.evaluation.results import load_results, save_results
from kornia_pnpnet.types import Pose

CAMERA = "800,810,320,240"
K = torch.tensor([[800.0, 0, 320], [0, 810, 240], [0, 0, 1]], dtype=torch.float64)


@pytest.fixture
def problem():
    """World points and the pixels of a camera at the identity that looks at them, two of nine wrong."""
    generator = np.random.default_rng(0)
    world = generator.uniform((-2, -2, 4), (2, 2, 9), (9, 3))
    img = world[:, :2] / world[:, 2:] * (800, 810) + (320, 240) + generator.normal(0, 0.3, (9, 2))
    img[[1, 6]] += ((180.0, -90.0), (-150.0, 200.0))
    return world, img


@pytest.fixture
def csv_file(tmp_path, problem):
    path = tmp_path / "pairs.csv"
    rows = [",".join(repr(float(value)) for value in row) for row in np.concatenate(problem, axis=1)]
    path.write_text("\n".join(["X,Y,Z,u,v", *rows]) + "\n")
    return path


@pytest.fixture
def weights_folder(tmp_path):
    """An untrained network whose refinement gets from anywhere near to the pose."""
    torch.manual_seed(1)
    PnPNet(MLPInit(n=9), RobustWeightedLM(m=5)).save_pretrained(tmp_path / "weights")
    return tmp_path / "weights"


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """Pretend that untrained weights pnpnet-n9 come with the package."""
    PnPNet(MLPInit(n=9), RobustWeightedLM(m=5)).save_pretrained(tmp_path / "shipped" / "pnpnet-n9")
    monkeypatch.setattr(kornia_pnpnet.solver, "WEIGHTS_FOLDER", tmp_path / "shipped")


def run(capsys, *arguments) -> tuple[int, str, str]:
    capsys.readouterr()
    code = main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return code, out, err


def answer(capsys, *arguments) -> dict:
    code, out, _ = run(capsys, "solve", *arguments)

    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    parsed = json.loads(out, parse_constant=refuse)
    assert code == (0 if parsed["ok"] else 1)
    return parsed


# -- solve -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", ["identity-lm", "weights"])
def test_solve_prints_what_the_library_returns(capsys, csv_file, problem, weights_folder, solver):
    name = solver if solver == "identity-lm" else str(weights_folder)
    got = answer(capsys, csv_file, "--intrinsics", CAMERA, "--solver", name)
    module = create_solver(name) if solver == "identity-lm" else PnPNet.from_pretrained(weights_folder)
    world, img = (torch.from_numpy(part)[None] for part in problem)
    with torch.no_grad():
        result = module(world, img, K)
    assert got["solver"] == name
    assert got["n"] == 9
    assert got["ok"] == result.ok.item()
    assert got["rotation"] == result.rotation[0].tolist()
    assert got["translation"] == result.translation[0].tolist()
    assert got["cost"] == result.cost.item()
    assert [pair["weight"] for pair in got["pairs"]] == result.weights[0].tolist()
    torch.testing.assert_close(
        quaternion_to_rotation_matrix(torch.tensor(got["quaternion_wxyz"], dtype=torch.float64)), result.rotation[0]
    )
    cam = world @ result.rotation.mT + result.translation[:, None]
    pixels = cam[0, :, :2] / cam[0, :, 2:] * K.diagonal()[:2] + K[:2, 2]
    for pair, point, error in zip(got["pairs"], cam[0], (pixels - img[0]).norm(dim=-1), strict=True):
        if point[2] > 0:
            assert pair["reprojection_error_px"] == pytest.approx(error.item())
            assert pair["rejected"] == (error.item() > got["rejected_above_px"])
        else:
            assert pair == {"weight": 0.0, "reprojection_error_px": None, "rejected": True}


def test_solve_finds_the_wrong_pairs(capsys, csv_file):
    got = answer(capsys, csv_file, "--intrinsics", CAMERA, "--solver", "identity-lm")
    assert got["ok"]
    assert [pair["rejected"] for pair in got["pairs"]] == [i in (1, 6) for i in range(9)]
    np.testing.assert_allclose(got["rotation"], np.eye(3), atol=5e-3)
    errors = sorted(pair["reprojection_error_px"] for pair in got["pairs"])
    assert got["rejected_above_px"] == max(3.0, 3 * 1.4826 * errors[4])


def test_pairs_behind_the_camera_are_rejected(capsys, csv_file, tmp_path):
    lines = csv_file.read_text().splitlines()
    path = tmp_path / "behind.csv"
    path.write_text("\n".join([*lines, "0.1,0.2,-5,300,200"]))
    got = answer(capsys, path, "--intrinsics", CAMERA, "--solver", "identity-lm", "--threshold", "1e6")
    assert got["ok"]
    assert got["pairs"][-1] == {"weight": 0.0, "reprojection_error_px": None, "rejected": True}
    assert not any(pair["rejected"] for pair in got["pairs"][:-1])


def test_threshold_is_taken_as_given(capsys, csv_file):
    common = (csv_file, "--intrinsics", CAMERA, "--solver", "identity-lm", "--threshold")
    assert not any(pair["rejected"] for pair in answer(capsys, *common, "5000")["pairs"])
    assert sum(pair["rejected"] for pair in answer(capsys, *common, "1e-9")["pairs"]) == 9


def test_csv_in_any_column_order_and_npz_give_the_same(capsys, tmp_path, problem, csv_file):
    world, img = problem
    weights = np.linspace(0.5, 1.5, 9)
    shuffled = tmp_path / "shuffled.csv"
    with shuffled.open("w", newline="", encoding="utf-8-sig") as file:
        writer = csv.writer(file)
        writer.writerow(["v", " weight", "name", "Z", "X ", "u", "Y"])
        for (x, y, z), (u, v), weight in zip(world.tolist(), img.tolist(), weights.tolist(), strict=True):
            writer.writerow([v, weight, "a, b", z, x, u, y])
        file.write("\n  \n")
    archive = tmp_path / "pairs.npz"
    np.savez(archive, world_points=world, img_points=img, weights=weights, intrinsics=K.numpy(), other=np.zeros(2))
    from_csv = answer(capsys, shuffled, "--intrinsics", CAMERA, "--solver", "identity-lm")
    from_npz = answer(capsys, archive, "--solver", "identity-lm")
    assert from_csv == from_npz
    assert from_csv != answer(capsys, csv_file, "--intrinsics", CAMERA, "--solver", "identity-lm")
    renamed = tmp_path / "pairs.dat"
    archive.rename(renamed)
    assert answer(capsys, renamed, "--solver", "identity-lm") == from_npz
    other_camera = answer(capsys, renamed, "--intrinsics", "900,900,320,240", "--solver", "identity-lm")
    assert other_camera["rotation"] != from_npz["rotation"]


def test_weights_keep_their_order_and_zero_means_absent(capsys, csv_file, tmp_path):
    lines = csv_file.read_text().splitlines()
    weighted = tmp_path / "weighted.csv"
    factors = [0.0 if i in (1, 6) else 1.0 for i in range(9)]
    body = [f"{line},{factor}" for line, factor in zip(lines[1:], factors, strict=True)]
    weighted.write_text("\n".join([f"{lines[0]},weight", *body]))
    got = answer(capsys, weighted, "--intrinsics", CAMERA, "--solver", "identity-lm")
    assert [pair["weight"] == 0 for pair in got["pairs"]] == [factor == 0 for factor in factors]
    assert [pair["rejected"] for pair in got["pairs"]] == [factor == 0 for factor in factors]


def test_default_solver_is_the_shipped_one_for_that_n(capsys, csv_file, shipped):
    assert answer(capsys, csv_file, "--intrinsics", CAMERA)["solver"] == "pnpnet-n9"


def test_default_solver_without_weights_says_so(capsys, csv_file, tmp_path, monkeypatch):
    monkeypatch.setattr(kornia_pnpnet.solver, "WEIGHTS_FOLDER", tmp_path / "none")
    code, out, err = run(capsys, "solve", csv_file, "--intrinsics", CAMERA)
    assert code == 0
    assert json.loads(out)["solver"] == "identity-lm"
    assert err == "pnpnet: no weights pnpnet-n9 are shipped, using identity-lm\n"


def test_no_pose_is_exit_code_one(capsys, tmp_path):
    path = tmp_path / "line.csv"
    path.write_text("X,Y,Z,u,v\n" + "\n".join(f"{i},{2 * i},{5 + i},{10 * i},{7 * i}" for i in range(9)))
    for solver in ("identity-lm", "opencv-ransac"):
        got = answer(capsys, path, "--intrinsics", CAMERA, "--solver", solver)
        assert not got["ok"]
        assert got["rotation"] == torch.eye(3).tolist()


def test_plot_draws_the_pairs(capsys, csv_file, tmp_path):
    pytest.importorskip("matplotlib")
    picture = tmp_path / "sub" / "pose.png"
    answer(capsys, csv_file, "--intrinsics", CAMERA, "--solver", "identity-lm", "--plot", picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size > 10_000


# -- bad input -------------------------------------------------------------------------------------------------------

GOOD = "1,2,3,4,5\n"
HEADER = "X,Y,Z,u,v\n"


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "1: the file is empty, expected the header X,Y,Z,u,v"),
        ("\n \n", "1: the file is empty, expected the header X,Y,Z,u,v"),
        ("X,Y,Z,u\n1,2,3,4\n", "1: no column v: expected X,Y,Z,u,v, found 'X,Y,Z,u'"),
        ("\nX,Z,v\n1,2,3\n", "2: no column Y, u: expected X,Y,Z,u,v, found 'X,Z,v'"),
        (GOOD * 3, "1: no header: expected X,Y,Z,u,v, found '1,2,3,4,5'"),
        (f"X,{HEADER}{GOOD}", "1: the column X is there 2 times"),
        (HEADER + GOOD + "1,2,3,4\n" + GOOD, "3: 4 values, but the header has 5 columns"),
        (HEADER + GOOD + "1,2,3,4,5,6\n" + GOOD, "3: 6 values, but the header has 5 columns"),
        (HEADER + GOOD + GOOD + "1,2,x,4,5\n", "4: Z is not a number: 'x'"),
        (HEADER + "\n" + GOOD + "1,2,,4,5\n", "4: Z is not a number: ''"),
        (HEADER + "1,2,3,nan,5\n" + GOOD, "2: u is not finite: nan"),
        (HEADER + "1,2,3,4,-inf\n" + GOOD, "2: v is not finite: -inf"),
        ("X,Y,Z,u,v,weight\n1,2,3,4,5,-1\n", "2: weight is negative: -1"),
        ("X,Y,Z,u,v,weight\n1,2,3,4,5,\n", "2: weight is not a number: ''"),
        (HEADER, "1: a pose needs at least 3 pairs, got 0"),
        (HEADER + GOOD * 2, "3: a pose needs at least 3 pairs, got 2"),
        (HEADER + '1,2,3,4,"5\n' + GOOD, "3: not a CSV file: unexpected end of data"),
        (HEADER + GOOD + "\0\0", "3: not a text file"),
        (HEADER.encode() + b"\xff\xfe\n", "2: not a text file in UTF-8"),
        (bytes(range(1, 256)) * 20, "2: not a text file in UTF-8"),
        (b"\xff\xfeX\0,\0", "1: not a text file in UTF-8"),
    ],
)
def test_bad_csv_files(capsys, tmp_path, content, expected):
    path = tmp_path / "bad.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert run(capsys, "solve", path, "--intrinsics", CAMERA) == (2, "", f"pnpnet: {path}:{expected}\n")


@pytest.mark.parametrize(
    ("arrays", "expected"),
    [
        ({"img_points": np.zeros((4, 2))}, "no array world_points"),
        ({"world_points": np.zeros((4, 3))}, "no array img_points"),
        (
            {"world_points": np.zeros((4, 3)), "img_points": np.zeros((5, 2))},
            "img_points must hold numbers of the shape (4, 2), got float64 of (5, 2)",
        ),
        (
            {"world_points": np.zeros(()), "img_points": np.zeros((0, 2))},
            "world_points must hold numbers of the shape (0, 3), got float64 of ()",
        ),
        (
            {"world_points": np.zeros((3, 3), dtype="U1"), "img_points": np.zeros((3, 2))},
            "world_points must hold numbers of the shape (3, 3), got <U1 of (3, 3)",
        ),
        ({"world_points": np.zeros((0, 3)), "img_points": np.zeros((0, 2))}, "a pose needs at least 3 pairs, got 0"),
        (
            {"world_points": np.zeros((4, 3)), "img_points": np.array([[0, 0], [1, 1], [0, math.nan], [2, 2]])},
            "img_points[2] is not finite",
        ),
        (
            {"world_points": np.ones((3, 3)), "img_points": np.ones((3, 2)), "weights": np.array([1, 1, -2.0])},
            "weights[2] is negative",
        ),
        (
            {"world_points": np.ones((3, 3)), "img_points": np.ones((3, 2)), "intrinsics": -np.eye(3)},
            "the focal lengths must be positive, got -1 and -1",
        ),
        (
            {"world_points": np.ones((3, 3)), "img_points": np.ones((3, 2)), "intrinsics": np.eye(3) + np.eye(3, k=1)},
            "the camera must have no skew, got 1",
        ),
        (
            {"world_points": np.ones((3, 3)), "img_points": np.ones((3, 2)), "intrinsics": 2 * np.eye(3)},
            "the intrinsics must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
        ),
    ],
)
def test_bad_npz_files(capsys, tmp_path, arrays, expected):
    path = tmp_path / "bad.npz"
    np.savez(path, **arrays)
    assert run(capsys, "solve", path, "--intrinsics", CAMERA) == (2, "", f"pnpnet: {path}: {expected}\n")


def test_npz_files_that_are_none(capsys, tmp_path):
    path = tmp_path / "bad.npz"
    np.savez(path, world_points=np.array([{}], dtype=object), img_points=np.zeros((3, 2)))
    good = tmp_path / "good.npz"
    np.savez(good, world_points=np.ones((3, 3)), img_points=np.ones((3, 2)))
    contents = [path.read_bytes(), b"", b"garbage\n", good.read_bytes()[:-40]]
    for content in contents:
        path.write_bytes(content)
        code, out, err = run(capsys, "solve", path, "--intrinsics", CAMERA)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert err.startswith(f"pnpnet: {path}: not an NPZ file of plain arrays: ")
    assert run(capsys, "solve", good) == (
        2,
        "",
        f"pnpnet: {good}: the camera is not in the file: pass --intrinsics fx,fy,cx,cy\n",
    )


def test_missing_files_and_folders(capsys, tmp_path):
    missing = tmp_path / "missing.csv"
    for path, reason in ((missing, "No such file or directory"), (tmp_path, "Is a directory")):
        assert run(capsys, "solve", path, "--intrinsics", CAMERA) == (2, "", f"pnpnet: {path}: {reason}\n")


@pytest.mark.parametrize(
    ("camera", "expected"),
    [
        ("1,2,3", "expected four numbers fx,fy,cx,cy, got '1,2,3'"),
        ("1,2,3,x", "expected four numbers fx,fy,cx,cy, got '1,2,3,x'"),
        ("1,2,3,4,5", "expected four numbers fx,fy,cx,cy, got '1,2,3,4,5'"),
        ("0,800,320,240", "the focal lengths must be positive, got 0 and 800"),
        ("800,-1,320,240", "the focal lengths must be positive, got 800 and -1"),
        ("800,800,nan,240", "the intrinsics are not finite"),
    ],
)
def test_bad_intrinsics(capsys, csv_file, camera, expected):
    assert run(capsys, "solve", csv_file, f"--intrinsics={camera}") == (2, "", f"pnpnet: --intrinsics: {expected}\n")


def test_wrong_n_and_wrong_solvers_are_one_line(capsys, csv_file, tmp_path, weights_folder):
    eight = tmp_path / "eight.csv"
    eight.write_text("\n".join(csv_file.read_text().splitlines()[:-1]))
    common = ("--intrinsics", CAMERA, "--solver")
    code, out, err = run(capsys, "solve", eight, *common, weights_folder)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "n = 9" in err
    assert "N = 8" in err
    bad = {
        "nobody": "No solver 'nobody'",
        str(tmp_path): "No weights",
        "opencv-ransac:speed=9": "unexpected keyword argument 'speed'",
        "opencv-ransac:threshold=-1": "threshold must be positive",
    }
    for name, expected in bad.items():
        code, out, err = run(capsys, "solve", csv_file, *common, name)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert err.startswith("pnpnet: ")
        assert expected in err
    (weights_folder / "config.json").write_text("{}")
    code, out, err = run(capsys, "solve", csv_file, *common, weights_folder)
    assert (code, out, err.count("\n")) == (2, "", 1)


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("solve",),
        ("fly",),
        ("solve", "x.csv", "--threshold", "0"),
        ("solve", "x.csv", "--plot", "x.doc"),
        ("evaluate", "--problems", "0"),
        ("evaluate", "--seed", "-1"),
        ("evaluate", "--n", "9,"),
        ("evaluate", "--n", "six"),
        ("evaluate", "--dtype", "float16"),
        ("figures",),
        ("demo", "--train-seconds", "nan"),
    ],
)
def test_wrong_usage_is_one_line(capsys, arguments):
    with pytest.raises(SystemExit) as stopped:
        main(list(arguments))
    _, err = capsys.readouterr()
    assert stopped.value.code == 2
    assert err.startswith("pnpnet: ")
    assert err.count("\n") == 1


@pytest.mark.parametrize("command", ["solve", "evaluate", "figures", "list", "demo"])
def test_help_has_an_example(capsys, command):
    with pytest.raises(SystemExit) as stopped:
        main([command, "--help"])
    assert stopped.value.code == 0
    assert f"\n  pnpnet {command}" in capsys.readouterr().out


# -- evaluate, list, demo --------------------------------------------------------------------------------------------


def test_evaluate_writes_what_it_prints(capsys, tmp_path, shipped):
    pytest.importorskip("matplotlib")
    out_file, pictures = tmp_path / "results.json", tmp_path / "pictures"
    code, out, err = run(
        capsys, "evaluate", "--outliers", "none,uniform,2", "--problems", 20, "--out", out_file, "--plot", pictures
    )
    assert (code, err) == (0, "")
    results = load_results(out_file)
    assert list(results["solvers"]) == default_solvers(9)
    labels = ("0 outliers", "0-3 outliers", "2 outliers")
    assert list(results["data"]) == [f"synthetic, n = 9, {label}" for label in labels]
    assert [entry["mean_outliers"] for entry in results["data"].values()][::2] == [0.0, 2.0]
    assert out.count("| synthetic, n = 9, 2 outliers") == len(results["solvers"])
    assert sorted(path.name for path in pictures.iterdir()) == ["errors.png", "success.png"]
    again = tmp_path / "again.json"
    run(capsys, "evaluate", "--problems", 20, "--solver", "identity-lm", "--out", again)
    (same,) = (
        row
        for row in results["rows"]
        if (row["data"], row["solver"]) == ("synthetic, n = 9, 0 outliers", "identity-lm")
    )
    assert load_results(again)["rows"][0]["per_problem"] == same["per_problem"]


def test_the_same_command_continues_and_another_is_refused(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("kornia_pnpnet.evaluation.comparison.source_digest", lambda: "edited by nobody meanwhile")
    out_file = tmp_path / "results.json"
    common = ("evaluate", "--problems", 5, "--out", out_file, "--outliers", "none")
    assert run(capsys, *common, "--solver", "identity-lm", "--n", "6")[0] == 0
    before = load_results(out_file)["rows"]
    code, out, err = run(capsys, *common, "--solver", "identity-lm", "known-inliers", "--n", "6,9")
    assert (code, err) == (0, "")
    assert out.splitlines()[-1] == f"Results: {out_file} (1 of 4 rows were there)"
    rows = load_results(out_file)["rows"]
    assert rows[0] == before[0]
    assert [(row["data"], row["solver"]) for row in rows] == [
        (f"synthetic, n = {n}, 0 outliers", solver) for n in (6, 9) for solver in ("identity-lm", "known-inliers")
    ]
    content = out_file.read_bytes()
    other = (*common, "--solver", "identity-lm", "known-inliers", "--n", "6,9", "--seed", 7)
    code, out, err = run(capsys, *other)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "holds another evaluation" in err
    assert out_file.read_bytes() == content
    assert run(capsys, *other, "--overwrite")[0] == 0
    assert load_results(out_file)["data"]["synthetic, n = 6, 0 outliers"]["description"]["seed"] == 7


def test_a_damaged_results_file_is_one_line_and_stays(capsys, tmp_path):
    out_file = tmp_path / "results.json"
    out_file.write_text('{"format": 1, "rows": [{"data"')
    code, out, err = run(capsys, "evaluate", "--problems", 5, "--out", out_file)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"pnpnet: '{out_file}' is not a results file: ")
    assert out_file.read_text() == '{"format": 1, "rows": [{"data"'


def test_interrupting_an_evaluation_says_how_to_go_on(capsys, tmp_path, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("kornia_pnpnet.evaluation.comparison.evaluate", interrupt)
    out_file = tmp_path / "results.json"
    code, out, err = run(capsys, "evaluate", "--problems", 5, "--solver", "identity-lm", "--out", out_file)
    assert (code, out, err) == (130, "", f"pnpnet: interrupted; the same command continues {out_file}\n")


def test_solvers_for_another_n_are_left_out_with_one_line(capsys, tmp_path, weights_folder):
    common = (
        "evaluate",
        "--problems",
        5,
        "--out",
        tmp_path / "results.json",
        "--outliers",
        "none,1",
        "--dtype",
        "float64",
    )
    code, out, err = run(capsys, *common, "--n", "6,9", "--solver", weights_folder, "identity-lm")
    assert code == 0
    assert err.startswith(f"pnpnet: {weights_folder} is left out on 2 of 4 sets: This network was built for n = 9")
    assert err.count("\n") == 1
    results = load_results(tmp_path / "results.json")
    assert len(results["rows"]) == 6
    assert {entry["dtype"] for entry in results["data"].values()} == {"float64"}
    code, out, err = run(capsys, *common, "--overwrite", "--n", 6, "--solver", weights_folder)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "no solver takes these problems: This network was built for n = 9" in err


def test_evaluate_takes_scenes_options_and_folders(capsys, tmp_path, weights_folder):
    generator = np.random.default_rng(0)
    world = generator.uniform((-2, -2, 4), (2, 2, 9), (30, 3))
    matches = tmp_path / "scene.npz"
    np.savez(
        matches,
        names=np.array(["a.jpg"]),
        K=K.numpy()[None],
        R=np.eye(3)[None],
        t=np.zeros((1, 3)),
        size=np.array([[640, 480]]),
        **{
            "000_world_points": world,
            "000_img_points": world[:, :2] / world[:, 2:] * (800, 810) + (320, 240),
            "000_error_px": np.zeros(30),
        },
    )
    out_file = tmp_path / "results.json"
    solvers = ("opencv-ransac:threshold=5,refine=false", str(weights_folder))
    common = ("evaluate", "--data", matches, "--outliers", "none,1", "--problems", 5, "--out", out_file)
    assert run(capsys, *common, "--solver", *solvers)[0] == 0
    results = load_results(out_file)
    assert list(results["data"]) == ["scene, n = 9, +0 outliers", "scene, n = 9, +1 outlier"]
    assert results["solvers"][solvers[0]]["config"]["refine"] is False
    assert results["rows"][0]["success"]["rate"] == 1.0
    entry = results["data"]["scene, n = 9, +0 outliers"]
    assert (entry["unit"], entry["max_translation"]) == ("m", 0.2)
    assert run(capsys, *common, "--solver", solvers[0], "--arbitrary-unit", "--overwrite")[0] == 0
    entry = load_results(out_file)["data"]["scene, n = 9, +0 outliers"]
    assert entry["unit"] == ""
    assert entry["max_translation"] == pytest.approx(0.005 * np.median(world[:, 2]), rel=0.1)
    code, _, err = run(capsys, *common, "--solver", solvers[0], "--n", 40)
    assert (code, err.count("\n")) == (2, 1)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--data", "nowhere"), "nowhere"),
        (("--outliers", "none,some"), "expected none, uniform, numbers or shares like 50%, with commas, got 'some'"),
        (("--outliers", "none,"), "expected none, uniform, numbers or shares like 50%, with commas, got ''"),
        (("--outliers", "120%"), "got '120%'"),
        (("--outliers", "x%"), "got 'x%'"),
        (("--n", "9,2"), "at least 3 pairs, got 2"),
        (("--n", "20,6", "--outliers", "7"), "7 outliers do not fit into n = 6 pairs"),
        (("--solver", "known-inliers:threshold=3"), "Bound 'known-inliers' does not take these options"),
        (("--outliers", "10"), "10 outliers do not fit into n = 9 pairs"),
        (("--n", "2"), "at least 3 pairs"),
        (("--solver", "nobody"), "No solver 'nobody'"),
    ],
)
def test_evaluate_refuses_in_one_line(capsys, tmp_path, arguments, expected):
    out_file = tmp_path / "results.json"
    code, out, err = run(capsys, "evaluate", "--problems", 5, "--out", out_file, *arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("pnpnet: ")
    assert expected in err
    assert not out_file.exists()


def test_an_error_in_a_solver_says_where(capsys, tmp_path, monkeypatch):
    class Broken(nn.Module):
        def forward(self, *_):
            raise ValueError("a bad\nday")

    monkeypatch.setattr("kornia_pnpnet.cli.main.load_solver", lambda name: Broken())
    arguments = ("--problems", 5, "--outliers", "none", "--solver", "broken", "--out", tmp_path / "results.json")
    code, _, err = run(capsys, "evaluate", *arguments)
    assert (code, err) == (2, "pnpnet: a bad day (broken on synthetic, n = 9, 0 outliers)\n")


def test_bounds_cannot_solve(capsys, csv_file):
    code, out, err = run(capsys, "solve", csv_file, "--intrinsics", CAMERA, "--solver", "known-inliers")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "known-inliers is a bound" in err


def test_figures_prints_what_it_draws(capsys, tmp_path):
    pytest.importorskip("matplotlib")
    out_file, folder = tmp_path / "results.json", tmp_path / "figures"
    solvers = ("identity-lm", "known-inliers")
    run(capsys, "evaluate", "--problems", 5, "--n", "6,9", "--solver", *solvers, "--out", out_file)
    code, out, err = run(capsys, "figures", out_file, "--out", folder)
    assert (code, err) == (0, "")
    drawn = out.splitlines()
    assert drawn
    assert sorted(drawn) == sorted(str(path) for path in folder.iterdir())
    counts = tmp_path / "counts.json"
    save_results({"kind": "complexity", "format": 1, "n": [6, 9], "counts": {"epnp": [1e3, 2e3]}, "ransac": []}, counts)
    assert run(capsys, "figures", counts, "--out", folder)[::2] == (0, "")
    assert len(list(folder.iterdir())) == len(drawn) + 1


def test_figures_refuses_in_one_line(capsys, tmp_path):
    pytest.importorskip("matplotlib")
    no_results, nothing = tmp_path / "other.json", tmp_path / "nothing.json"
    no_results.write_text('{"success": 1}')
    save_results({"format": 1, "environment": {}, "solvers": {}, "data": {}, "rows": []}, nothing)
    for path, expected in (
        (no_results, "is not a results file"),
        (tmp_path / "missing.json", "No such file"),
        (nothing, "no data"),
    ):
        code, out, err = run(capsys, "figures", path, "--out", tmp_path / "figures")
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert expected in err
    assert not (tmp_path / "figures").exists()


def test_list_names_solvers_and_missing_packages(capsys, shipped, monkeypatch):
    code, out, _ = run(capsys, "list")
    assert code == 0
    lines = dict(line.split(None, 1) for line in out.splitlines()[:-2])
    assert {name for name, state in lines.items() if state == "installed"} == set(list_solvers())
    assert {name for name, state in lines.items() if state.startswith("bound: ")} == set(BOUNDS)
    assert out.splitlines()[-1] == "Shipped weights: pnpnet-n9"
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "needs OpenCV: pip install 'kornia_pnpnet[eval]'" in run(capsys, "list")[1]


def test_demo_compares_trains_and_draws(capsys, tmp_path, shipped, monkeypatch):
    pytest.importorskip("matplotlib")
    asked = []

    def train_briefly(seconds, folder):
        asked.append((seconds, folder))
        folder.mkdir(parents=True)
        columns = "update,total,init_rotation,init_translation,refined_rotation,refined_translation,val/none/success"
        (folder / "history.csv").write_text(f"{columns}\n1,1,1,1,1,1,0.25\n2,1,1,1,1,1,\n3,1,1,1,1,1,0.5\n")
        return folder / "history.csv"

    training = ModuleType("kornia_pnpnet.training.loop")
    training.train_briefly = train_briefly
    monkeypatch.setitem(sys.modules, "kornia_pnpnet.training.loop", training)
    folder = tmp_path / "demo"
    code, out, err = run(capsys, "demo", "--out", folder, "--problems", 20, "--train-seconds", 3)
    assert (code, err) == (0, "")
    assert asked == [(3.0, folder / "training")]
    assert "success, outliers none: 25.0 % at update 1 -> 50.0 % at update 3" in out
    results = load_results(folder / "results.json")
    assert {"pnpnet-n9", "opencv-ransac"} <= set(results["solvers"])
    assert {entry["dtype"] for entry in results["data"].values()} == {"float32"}
    assert out.count("| synthetic, n = 9, 0-3 outliers") == len(results["solvers"])
    for name in ("success", "errors", "problem", "training"):
        assert (folder / f"{name}.png").stat().st_size > 10_000
        assert str(folder / f"{name}.png") in out


def test_interrupting_is_one_line(capsys, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("kornia_pnpnet.cli.main.list_solvers", interrupt)
    assert run(capsys, "list") == (130, "", "pnpnet: interrupted\n")


def test_version(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--version"])
    assert stopped.value.code == 0
    assert capsys.readouterr().out == f"pnpnet {kornia_pnpnet.__version__}\n"


def test_the_command_as_a_process(csv_file):
    code = "import sys; from kornia_pnpnet.cli import main; sys.exit(main())"
    arguments = ["solve", str(csv_file), "--intrinsics", CAMERA, "--solver", "identity-lm"]
    command = [sys.executable, "-W", "error", "-c", code, *arguments]
    solved = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert json.loads(solved.stdout)["ok"]
    assert solved.stderr == ""


# -- the measures behind it ------------------------------------------------------------------------------------------


def test_points_behind_the_camera_have_no_reprojection():
    world = torch.tensor([[[0.0, 0, 2], [1, 1, -2], [0, 0, 0]]])
    pixels = reprojections(world, Pose(torch.eye(3)[None], torch.zeros(1, 3)), K.float()[None])
    assert pixels[0, 0].tolist() == [320.0, 240.0]
    assert pixels[0, 1:].isnan().all()


def test_rejection_limit_ignores_what_is_not_finite():
    errors = torch.tensor([10.0, 20.0, 30.0, math.inf, math.nan])
    assert rejection_limit(errors) == pytest.approx(3 * 1.4826 * 20)
    assert rejection_limit(errors[3:]) == 3.0


def test_solvers_may_be_named_in_several_places(tmp_path, capsys):
    arguments = ["--problems", "5", "--outliers", "none", "--out", str(tmp_path / "r.json")]
    assert main(["evaluate", "--solver", "identity-lm", "--solver", "opencv-ransac", *arguments]) == 0
    out = capsys.readouterr().out
    assert "identity-lm" in out
    assert "opencv-ransac" in out


@pytest.mark.parametrize("option", ["refine=no", "refine=False", "iterations=10.5", "seed=abc", "threshold=Infinity"])
def test_wrong_solver_options_end_with_one_line(option, capsys, tmp_path):
    out_file = str(tmp_path / "results.json")
    assert main(["evaluate", "--solver", f"opencv-ransac:{option}", "--problems", "5", "--out", out_file]) == 2
    err = capsys.readouterr().err
    assert err.startswith("pnpnet: ")
    assert err.count("\n") == 1


# -- whatever comes in -------------------------------------------------------------------------------------------------


def problem_file(kind):
    """The bytes of a sound file, and how its name ends."""
    problems = SyntheticProblems(n=9, batch_size=3, seed=0).batch(0)
    arrays = dict(zip(("world_points", "img_points", "intrinsics"), (x.numpy() for x in problems[:3]), strict=True))
    file = io.BytesIO()
    match kind:
        case "csv":
            rows = np.concatenate((arrays["world_points"][0], arrays["img_points"][0]), 1)
            file.write("\n".join(["X,Y,Z,u,v", *(",".join(map(str, row)) for row in rows)]).encode())
        case "npz":
            np.savez(file, **{name: array[0] for name, array in arrays.items()})
        case "shard npz":
            np.savez_compressed(file, **arrays)
        case "shard parquet":
            from pyarrow import parquet, table

            parquet.write_table(table({name: [*array.reshape(3, -1)] for name, array in arrays.items()}), file)
    return file.getvalue(), kind.split()[-1]


def solving(kind, path):
    """The arguments that solve a file."""
    shard = "--batch", "--out", path.parent / "out", "--overwrite"
    return (
        "solve",
        path,
        *(shard if kind.startswith("shard") else ("--intrinsics", "3400,3400,960,540")),
        "--solver",
        "epnp",
    )


@pytest.mark.filterwarnings("ignore")  # of NumPy, about headers and overlapping entries
@pytest.mark.parametrize("kind", ["csv", "npz", "shard npz", "shard parquet"])
def test_damaged_files_are_a_line_and_no_traceback(kind, tmp_path):
    sound, suffix = problem_file(kind)

    @many(150)
    @given(damage(sound))
    def check_file(content):
        path = tmp_path / f"problem.{suffix}"
        path.write_bytes(content)
        code, out, err = run_main(*solving(kind, path))
        assert code in (0, 1, 2)
        if code == 2:
            assert err.startswith(f"pnpnet: {path}")
            assert err.count("\n") == 1
        elif suffix in ("csv", "npz") and not kind.startswith("shard"):
            assert json.loads(out)["n"] >= 3

    path = tmp_path / f"sound.{suffix}"
    path.write_bytes(sound)
    assert run_main(*solving(kind, path))[0] == 0
    check_file()


@many(300)
@given(
    st.lists(
        st.tuples(st.sampled_from(["--intrinsics", "--solver", "--threshold", "--batch-size", "--batch", ""]), WORDS),
        max_size=4,
    ),
    st.one_of(WORDS, st.none()),
)
def test_any_arguments_are_a_line_and_no_traceback(tmp_path_factory, options, file):
    """Of a file that is not there, or of a sound one."""
    sound = tmp_path_factory.getbasetemp() / "sound.csv"
    if not sound.exists():
        sound.write_bytes(problem_file("csv")[0])
    arguments = [x for pair in options for x in pair if x]
    code, out, err = run_main("solve", *arguments, "--", str(sound) if file is None else file)
    if code == 2:
        assert err.startswith("pnpnet: ")
        assert err.count("\n") == 1
    else:
        assert file is None
        assert json.loads(out)["n"] == 9


def test_spoiled_results_are_a_line_and_no_traceback(tmp_path):
    made, costs, path = (tmp_path / f"{name}.json" for name in ("results", "costs", "spoiled"))
    arguments = "evaluate", "--solver", "epnp", "--problems", "20", "--n", "9,12", "--outliers", "none,3", "--out"
    assert run_main(*arguments, made)[0] == 0
    save_results(complexity_results(["epnp"], range(6, 9)), costs)
    both = [json.loads(file.read_text()) for file in (made, costs)]
    both = {kind: (content, list(places_in(content))) for kind, content in zip(("results", "costs"), both, strict=True)}
    codes = Counter()

    @many(60)
    @given(st.sampled_from(sorted(both)), BOOL, st.data())
    def run(kind, plot, data):
        path.write_text(json.dumps(data.draw(spoiled(*both[kind]))))
        more = ("--plot", tmp_path / "plot") if plot else ()
        figures = "figures", path, "--out", tmp_path / "figures"
        code, _, err = run_main(*((*arguments, path, *more) if kind == "results" and plot else figures))
        codes[code] += 1
        assert code in (0, 2)
        if code == 2:
            assert err.startswith("pnpnet: ")
            assert err.count("\n") == 1

    run()
    assert min(codes[0], codes[2]) >= 5


#: What each needs to be quick, and what it can be given.
COMMANDS = {
    "evaluate": (("--solver", "epnp", "--problems", 3), "--solver --data --n --outliers --seed --dtype --plot"),
    "figures": ((), "--out"),
    "export": (("--solver", "p3p-ransac"), "--n"),
    "list": ((), "--x"),
    "demo": (("--problems", 3, "--train-seconds", 0), "--data --problems"),
}


SAID = WORDS | st.sampled_from(
    ["9", "6,9", "none,2", "50%", "uniform", "float64", "gaussian_pose", "p3p-ransac", "1e9"]
)


def test_any_arguments_of_other_commands_are_a_line_and_no_traceback(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    codes = Counter()

    @many(80)
    @given(st.sampled_from(sorted(COMMANDS)), st.data())
    def run(name, data):
        quick, may = COMMANDS[name]
        pairs = data.draw(st.lists(st.tuples(st.sampled_from(may.split()), SAID), max_size=2))
        files = data.draw(st.lists(SAID, max_size=1))
        code, out, err = run_main(name, *quick, *(x for pair in pairs for x in pair), *files)
        codes[name, code] += 1
        assert code in (0, 2)
        if code == 2:
            assert err.startswith("pnpnet: ")
            assert err.count("\n") == 1
        else:
            assert out

    run()
    assert all(codes[name, 2] for name in COMMANDS)
    assert all(codes[name, 0] for name in ("evaluate", "list", "demo"))  # what others need is not among the words
