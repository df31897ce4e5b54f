"""The command line says what the library says; bad and damaged input is one line and the exit code 2."""

import io
import json
import math
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import WORDS, arrays, damage, many, match_arrays, places_in, run_main, spoiled, table
from hypothesis import given
from hypothesis import strategies as st

from kornia_pnpnet import MLPInit, PnPNet, RobustWeightedLM, list_solvers, shipped_weights
from kornia_pnpnet.cameras import reproject
from kornia_pnpnet.cli import COMMANDS, main
from kornia_pnpnet.cli.demo import verdict
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.named_solvers import BOUNDS, default_solvers, load_solver
from kornia_pnpnet.evaluation.results import load_results

CAMERA = "800,810,320,240"
HEADER, GOOD = "X,Y,Z,u,v\n", "1,2,3,4,5\n"
K = torch.tensor([[800.0, 0, 320], [0, 810, 240], [0, 0, 1]], dtype=torch.float64)
#: Contents of files, and the error.
BAD_CSV = [("\n \n", ":1: expected the header X,Y,Z,u,v"), (HEADER + GOOD + "1,2,3,4,5,6\n" + GOOD, ":3: 6 values")]
BAD_CSV += [(f"X,{HEADER}{GOOD}", ":1: expected the header"), (HEADER + '1,2,3,4,"5\n' + GOOD, ":3: not a CSV file")]
BAD_CSV += [("\nX,Z,v\n1,2,3\n", ":2: expected the header X,Y,Z,u,v, each once, found 'X,Z,v'")]
BAD_CSV += [(HEADER + GOOD + GOOD + "1,2,x,4,5\n", ":4: Z must be a finite number, got 'x'")]
BAD_CSV += [(HEADER + "\n" + GOOD + "1,2,,4,5\n", ":4: Z must be a finite number, got ''")]
BAD_CSV += [(HEADER + "1,2,3,nan,5\n" + GOOD, ":2: u must be a finite number, got 'nan'")]
BAD_CSV += [("X,Y,Z,u,v,weights\n1,2,3,4,5,1\n", ": the column weights is not read: pairs of weight 0")]
BAD_CSV += [("X,Y,Z,u,v,img_sigma\n1,2,3,4,5,1\n", ": the column img_sigma is not read")]
BAD_CSV += [("X,Y,Z,u,v,weight\n1,2,3,4,5,-1\n", ":2: weight must be a number of at least 0, got '-1'")]
BAD_CSV += [(HEADER + GOOD * 2, ": a pose needs at least 3 correspondences, got 2")]
BAD_CSV += [(HEADER.encode() + b"\xff\xfe\n", ":2: not a text file in UTF-8")]
BAD_CAMERAS = ("1,2,3", "1,2,3,x", "1,2,3,4,5", "0,800,320,240", "800,0,320,240", "8,8,nan,2")
PINHOLE = "PINHOLE,640,480,800,810,320,240"
SOLVE, EVALUATE = f"solve pairs.csv --intrinsics {CAMERA}", "evaluate --problems 5 --out results.json"
#: Arguments, and what the error names.
BAD = [("", ""), ("fly", "fly"), ("solve", "FILE"), ("export x.onnx --pairs 6,9", "one number of pairs")]
BAD += [(f"solve pairs.csv --intrinsics={camera}", "pnpnet: --intrinsics: ") for camera in BAD_CAMERAS]
BAD += [(f"{SOLVE} --camera {PINHOLE}", "--camera stands alone"), ("solve pairs.csv pairs.csv", "--batch")]
BAD += [("solve pairs.csv --camera PINHOLE,640,480,800", "--camera: expected MODEL")]
BAD += [(f"solve pairs.csv --camera {PINHOLE} --solver epnp:focal=unknown", "a known focal length")]
BAD += [(f"{SOLVE} --threshold 0", "--threshold"), (f"{SOLVE} --focal=-1", "--focal")]
BAD += [(f"{SOLVE} --focal 1200", "--intrinsics 1200,1200,cx,cy"), (f"{SOLVE} --out x", "--out need --batch")]
BAD += [(f"{SOLVE} --focal 0.1 --diagnose", "--diagnose needs a known focal length")]
BAD += [(f"{SOLVE} --focal unknown --solver poselib", "does not estimate focal lengths")]
BAD += [(f"{SOLVE} --batch {option}", "not for --batch") for option in ("--json", "--plot x.png")]
BAD += [(f"{SOLVE} --plot x.txt", "a .pdf, .png or .svg file"), (f"{SOLVE} --plot mine.png", "--overwrite")]
BAD += [(f"{SOLVE} --solver {name}", name) for name in ("nobody", "tests")]
BAD += [(f"{SOLVE} --solver opencv-ransac:{option}=no", option) for option in ("speed", "refine")]
BAD += [(f"solve {path} --intrinsics {CAMERA}", f"{path}: ") for path in ("missing.csv", "sub")]
BAD += [(f"{EVALUATE} --{option} nowhere", "nowhere") for option in ("data", "solver")]
BAD += [(f"{EVALUATE} --outliers none,{word}", repr(word)) for word in ("some", "", "120%", "x%")]
BAD += [(f"{EVALUATE} --n {n}", why) for n, why in (("9,", "--n"), ("20,6 --outliers 7", "n = 6"))]
BAD += [(f"{EVALUATE} --n 9,2", "at least 3 pairs, got 2")]
BAD += [(f"{EVALUATE} --solver known-inliers:threshold=3", "threshold"), (f"{SOLVE} --solver known-inliers", "bound")]
BAD += [(f"export {name}", ".pt2") for name in ("model", "model.pt", "model.so", ".onnx")]
BAD += [("export x.onnx --solver opencv-ransac", "opencv-ransac belongs to another library")]
BAD += [(f"export {name}", "--overwrite") for name in ("mine.onnx", "mine.pt2")]
#: Arguments that keep each command short, and the options that are drawn.
SHORT = {
    "solve": (("sound.csv", "--intrinsics", "3400,3400,0,0"), "--solver --threshold --batch-size --focal --camera"),
    "evaluate": (("--solver", "epnp", "--problems", 3), "--solver --data --n --outliers --seed --dtype --plot"),
    "export": (("--solver", "p3p-ransac"), "--pairs"),
    "list": ((), "--x"),
    "demo": (("--problems", 3, "--train-seconds", 0), "--data --problems"),
}
SETS = ["9", "6,9", "none,2", "50%", "uniform", "float64", "gaussian_pose", "p3p-ransac", "1e9"]
TEXTS = WORDS | st.sampled_from(SETS)


def points(n=9):
    return np.random.default_rng(0).uniform((-2, -2, 4), (2, 2, 9), (n, 3))


def seen(world):
    """Pixels of a camera at the identity."""
    return world[:, :2] / world[:, 2:] * (800, 810) + (320, 240)


@pytest.fixture
def problem():
    """Nine world points and their pixels; the points 1 and 6 are outliers."""
    img = seen(points()) + np.random.default_rng(1).normal(0, 0.3, (9, 2))
    img[[1, 6]] += ((180.0, -90.0), (-150.0, 200.0))
    return points(), img


@pytest.fixture
def csv_file(tmp_path, problem):
    path = tmp_path / "pairs.csv"
    np.savetxt(path, np.concatenate(problem, axis=1), delimiter=",", header="X,Y,Z,u,v", comments="")
    return path


@pytest.fixture
def weights_folder(tmp_path):
    torch.manual_seed(1)
    PnPNet(MLPInit(n=9), RobustWeightedLM(m=5)).save_pretrained(tmp_path / "weights")
    return tmp_path / "weights"


def refused(*arguments) -> str:
    """The only line that a command prints when it ends with the exit code 2."""
    code, out, err = run_main(*arguments)
    assert (code, out) == (2, "")
    return err


def answer(*arguments) -> dict:
    code, out, _ = run_main("solve", *arguments)
    parsed = json.loads(out, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))
    assert code == (0 if parsed["ok"] else 1)
    return parsed


@pytest.mark.parametrize("solver", ["identity-lm", "weights"])
def test_solve_prints_what_the_library_returns(csv_file, problem, weights_folder, solver):
    name = solver if solver == "identity-lm" else str(weights_folder)
    got = answer(csv_file, "--intrinsics", CAMERA, "--solver", name)
    world, img = (torch.from_numpy(part)[None] for part in problem)
    with torch.no_grad():
        result = load_solver(name)(world, img, K)
    known = {"solver": name, "n": 9, "inliers": result.inliers.sum().item(), "sigma_px": result.sigma.item()}
    known |= {key: getattr(result, key).item() for key in ("ok", "cost", "probability")}
    known |= {key: getattr(result, key)[0].tolist() for key in ("rotation", "translation")}
    assert (known | {"quaternion_wxyz": result.pose.quaternion[0].tolist()}).items() <= got.items()
    if got["ok"]:
        sigmas = result.covariance(world, img, K)[0].diagonal().sqrt()
        expected = [math.radians(x) for x in got["rotation_sigma_deg"]] + got["translation_sigma"]
        assert expected == pytest.approx(sigmas.tolist())
    errors = (reproject(world, K, result.pose) - img).norm(dim=-1)[0].tolist()
    errors = [None if math.isnan(error) else pytest.approx(error) for error in errors]
    rejected = [not (got["ok"] and inlier) for inlier in result.inliers[0].tolist()]
    columns = {"weight": result.weights[0].tolist(), "reprojection_error_px": errors, "rejected": rejected}
    assert {name: [pair[name] for pair in got["pairs"]] for name in columns} == columns


def test_solve_rejects_and_draws_outliers(csv_file, tmp_path):
    pytest.importorskip("matplotlib")
    common, picture = ("--intrinsics", CAMERA, "--solver", "identity-lm"), tmp_path / "sub" / "pose.png"
    got = answer(csv_file, *common, "--plot", picture)
    assert [pair["rejected"] for pair in got["pairs"]] == [i in (1, 6) for i in range(9)]
    np.testing.assert_allclose(got["rotation"], np.eye(3), atol=5e-3)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size > 10_000
    csv_file.write_text(csv_file.read_text() + "0.1,0.2,-5,300,200")
    *others, behind = answer(csv_file, *common, "--threshold", "1e6")["pairs"]
    assert behind == {"weight": 0.0, "reprojection_error_px": None, "rejected": True}
    assert not any(pair["rejected"] for pair in others)


def test_implausible_answers_name_a_possible_reason(csv_file):
    common = ("solve", csv_file, "--intrinsics", CAMERA)
    assert run_main(*common)[2] == ""
    world = points(40)
    img = seen(world) + np.random.default_rng(2).normal(0, 0.3, (40, 2))
    img[:22] = np.random.default_rng(6).uniform((0, 0), (640, 480), (22, 2))
    for pixels, expected in ((img, 0), (img[:, ::-1], 1), (seen(world)[:, ::-1], 1)):
        np.savetxt(csv_file, np.concatenate((world, pixels), 1), delimiter=",", header="X,Y,Z,u,v", comments="")
        code, _, err = run_main(*common)
        assert (code, err.count("\n")) == (expected, 1)
        assert "swapped columns" in err
    assert answer(*common[1:], "--diagnose")["diagnosis"].startswith("swap u and v: 100 % of the pairs")


def test_a_terminal_gets_a_table_and_a_pipe_gets_json(capsys, monkeypatch, csv_file):
    common = "solve", str(csv_file), "--intrinsics", CAMERA, "--focal", "unknown"
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    main(common)
    table = capsys.readouterr().out
    main((*common, "--json"))
    got = json.loads(capsys.readouterr().out)
    rows = dict(line.split(None, 1) for line in table.splitlines())
    assert rows["inliers"] == f"{got['inliers']} of 9"
    assert rows["sigma"] == f"{got['sigma_px']:.3g} px"
    assert rows["translation"].count("±") == rows["rotation"].count("±") == rows["focal"].count("±") == 1
    assert got["focal_sigma_px"] > 0


def test_csv_in_any_column_order_and_npz_give_the_same(tmp_path, problem, csv_file):
    (world, img), weights = problem, np.linspace(0.5, 1.5, 9)
    shuffled, archive = tmp_path / "shuffled.csv", tmp_path / "pairs.npz"
    rows = zip(world.tolist(), img.tolist(), weights.tolist(), strict=True)
    lines = [f'{v},{weight},"a, b",{z},{x},{u},{y}' for (x, y, z), (u, v), weight in rows]
    shuffled.write_text("\r\n".join(["v, weight,name,Z,X ,u,Y", *lines, "", "  \n"]), "utf-8-sig", newline="")
    np.savez(archive, world_points=world, img_points=img, weights=weights, intrinsics=K.numpy(), other=np.zeros(2))
    solver = "--solver", "identity-lm"
    from_npz = answer(archive, *solver)
    assert answer(shuffled, "--intrinsics", CAMERA, *solver) == from_npz
    assert answer(csv_file, "--intrinsics", CAMERA, *solver) != from_npz
    other_camera = answer(archive.rename(tmp_path / "pairs.dat"), "--intrinsics", "900,900,320,240", *solver)
    assert other_camera["rotation"] != from_npz["rotation"]


def test_no_pose_is_exit_code_one_with_the_reason(tmp_path):
    path = tmp_path / "line.csv"
    path.write_text(HEADER + "\n".join(f"{i},{2 * i},{5 + i},{10 * i},{7 * i}" for i in range(9)))
    for solver, status in (("identity-lm", "degenerate"), ("opencv-ransac", "not_believed")):
        got = answer(path, "--intrinsics", CAMERA, "--solver", solver)
        assert (got["ok"], got["status"], got["rotation"]) == (False, status, torch.eye(3).tolist())
        assert all(pair["rejected"] for pair in got["pairs"])
    _, _, err = run_main("solve", path, "--intrinsics", CAMERA)
    assert err.startswith("pnpnet: not solved (degenerate)")
    geocentric = {"world_points": 4e6 + points(), "img_points": seen(points())}
    for dtype, reason in (np.float64, ""), (np.float32, "(precision): "):
        np.savez(tmp_path / "far.npz", **{name: array.astype(dtype) for name, array in geocentric.items()})
        code, _, err = run_main("solve", tmp_path / "far.npz", "--intrinsics", CAMERA)
        assert (code, reason in err) == (bool(reason), True)
    assert "float64" in err


@pytest.mark.parametrize(("content", "expected"), BAD_CSV)
def test_bad_csv_files(tmp_path, content, expected):
    path = tmp_path / "bad.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert f"{path}{expected}" in refused("solve", path, "--intrinsics", CAMERA)


def test_bad_npz_files(tmp_path, monkeypatch):
    path = tmp_path / "bad.npz"
    points = {"world_points": np.ones((4, 3)), "img_points": np.ones((4, 2))}
    for changed, expected in (
        ({"img_points": None}, "img_points"),
        ({"img_points": np.ones((5, 2))}, "img_points must hold numbers of the shape (4, 2), got float64 of (5, 2)"),
        ({"world_points": np.ones((1, 4, 3)), "img_points": np.ones((1, 4, 2))}, "pass --batch"),
        ({"world_points": np.ones(())}, "world_points must hold numbers"),
        ({"world_points": np.zeros((4, 3), "f4,f4")}, "world_points must hold numbers"),
        ({"world_points": np.array([{}], dtype=object)}, "not an NPZ file of numbers"),
        ({"world_points": np.ones((0, 3)), "img_points": np.ones((0, 2))}, "at least 3 correspondences, got 0"),
        ({"img_points": np.array([[0, 0], [1, 1], [0, math.nan], [2, 2]])}, "img_points[2] must be finite"),
        ({"weights": np.array([1, 1, -2.0, 1])}, "weights[2] must be finite and at least 0"),
        ({"mask": np.ones(4)}, "the array mask is not read: pairs with 0 in weights"),
        *(({name: np.ones(4)}, f"the array {name} is not read") for name in ("dist", "fisheye", "img_cov")),
        ({"intrinsics": np.diag([1.0, 0.0, 1.0])}, "focal lengths must not be 0, got 1 and 0"),
        ({"intrinsics": np.eye(3) + np.eye(3, k=-1)}, "[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]"),
        ({}, "--intrinsics"),
    ):
        np.savez(path, **{name: array for name, array in (points | changed).items() if array is not None})
        err = refused("solve", path)
        assert err.startswith(f"pnpnet: {path}: ")
        assert expected in err
    monkeypatch.setattr("kornia_pnpnet.core.files.MOST_BYTES", 10**6)
    np.savez_compressed(path, world_points=np.zeros((50_000, 3)), img_points=np.zeros((50_000, 2)))
    assert path.stat().st_size < 10_000
    assert "more than 0.0 GB: split the file" in refused("solve", path, "--intrinsics", CAMERA)


@pytest.mark.parametrize(("arguments", "culprit"), BAD)
def test_bad_arguments(csv_file, tmp_path, monkeypatch, arguments, culprit):
    (tmp_path / "sub").mkdir()
    before = {"mine.onnx": "mine", "mine.pt2": "mine", "mine.png": "mine", "pairs.csv": csv_file.read_text()}
    for name, content in before.items():
        (tmp_path / name).write_text(content)
    monkeypatch.chdir(tmp_path)
    assert culprit in refused(*arguments.split())
    assert {path.name: path.read_text() for path in tmp_path.iterdir() if path.name != "sub"} == before


def test_help_and_version():
    for arguments in (["--help"], ["--version"], *([command, "--help"] for command in COMMANDS)):
        code, out, _ = run_main(*arguments)
        assert (code, "pnpnet" in out) == (0, True)


def test_evaluate_writes_what_it_prints(tmp_path):
    pytest.importorskip("matplotlib")
    out_file, pictures = tmp_path / "results.json", tmp_path / "pictures"
    common = ("evaluate", "--outliers", "none,uniform,2", "--problems", 20, "--out", out_file)
    code, out, err = run_main(*common, "--plot", pictures)
    assert (code, err) == (0, "")
    results = load_results(out_file)
    assert list(results["solvers"]) == default_solvers(9)
    assert [entry["mean_outliers"] for entry in results["data"].values()][::2] == [0.0, 2.0]
    assert out.count("| synthetic, n = 9, 2 outliers") == len(results["solvers"])
    assert sorted(path.name for path in pictures.iterdir()) == ["errors.png", "success.png"]


@pytest.mark.parametrize("name", ["evaluation.comparison.evaluate", "list_solvers"])
def test_interruptions_are_one_line(monkeypatch, name):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"kornia_pnpnet.{name}", interrupt)
    command = "list" if name == "list_solvers" else "evaluate --problems 5 --solver identity-lm --out x"
    code, out, err = run_main(*command.split())
    assert (code, out, err.count("\n")) == (130, "", 1)


def test_evaluate_continues_and_skips_or_refuses_what_does_not_fit(csv_file, tmp_path, weights_folder):
    out_file = tmp_path / "results.json"
    common = ("evaluate", "--problems", 5, "--out", out_file, "--outliers", "none,1", "--dtype", "float64")
    assert run_main(*common, "--n", 6, "--solver", "identity-lm")[0] == 0
    both = (*common, "--n", "6,9", "--solver", weights_folder, "identity-lm")
    code, out, err = run_main(*both)
    assert (code, err.count("\n")) == (0, 1)
    assert "2 of 6 rows" in out.splitlines()[-1]
    assert err.startswith(f"pnpnet: {weights_folder} is skipped on 2 of 4 sets: ")
    assert {entry["dtype"] for entry in load_results(out_file)["data"].values()} == {"float64"}
    assert str(out_file) in refused(*both, "--seed", 7)
    assert "n = 9" in refused(*common, "--overwrite", "--n", 6, "--solver", weights_folder)
    assert run_main(*common, "--solver", "identity-lm", "--seed", 7, "--overwrite")[0] == 0
    assert {entry["description"]["seed"] for entry in load_results(out_file)["data"].values()} == {7}
    csv_file.write_text("\n".join(csv_file.read_text().splitlines()[:-1]))
    err = refused("solve", csv_file, "--intrinsics", CAMERA, "--solver", weights_folder)
    assert "n = 9" in err
    assert "N = 8" in err


def test_evaluate_accepts_scenes_options_and_folders(tmp_path, weights_folder):
    matches, out_file = tmp_path / "scene.npz", tmp_path / "results.json"
    np.savez(matches, **match_arrays(30))
    solvers = ("opencv-ransac:threshold=5,refine=false", str(weights_folder))
    common = ("evaluate", "--data", matches, "--outliers", "none,1", "--problems", 5, "--out", out_file)
    for more, unit in (((), "m"), (("--arbitrary-unit", "--overwrite"), "")):
        assert run_main(*common, *more, "--solver", *solvers)[0] == 0
        results = load_results(out_file)
        assert list(results["data"]) == ["scene, n = 9, +0 outliers", "scene, n = 9, +1 outlier"]
        assert {entry["unit"] for entry in results["data"].values()} == {unit}
    assert results["solvers"][solvers[0]]["config"]["refine"] is False
    assert results["rows"][0]["success"]["rate"] == 1.0
    assert f"{matches}: no image" in refused(*common, "--solver", solvers[0], "--n", 40)


def test_list_names_solvers_and_missing_packages(monkeypatch):
    code, out, _ = run_main("list")
    assert code == 0
    lines = dict(line.split(None, 1) for line in out.splitlines()[:-2])
    assert {name for name, state in lines.items() if "needs" not in state} == set(list_solvers())
    assert {name for name, state in lines.items() if state.startswith("bound: ")} == set(BOUNDS)
    assert out.splitlines()[-1] == f"Shipped weights: {', '.join(shipped_weights())}"
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "needs OpenCV" in run_main("list")[1]


def test_demo_compares_trains_and_draws(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    folder, durations = tmp_path / "demo", []

    def train_briefly(seconds, history):
        durations.append(seconds)
        history.mkdir(parents=True)
        columns = "update,total,init_rotation,init_translation,refined_rotation,refined_translation,val/none/success"
        (history / "history.csv").write_text(f"{columns}\n1,1,1,1,1,1,0.25\n2,1,1,1,1,1,\n3,1,1,1,1,1,0.5\n")
        return history / "history.csv"

    monkeypatch.setattr("kornia_pnpnet.training.loop.train_briefly", train_briefly)
    code, out, err = run_main("demo", "--out", folder, "--problems", 20, "--train-seconds", 3)
    assert (code, err, durations) == (0, "", [3.0])
    assert "25.0 % at update 1 -> 50.0 % at update 3" in out
    results = load_results(folder / "results.json")
    assert list(results["solvers"]) == ["pnpnet-set", "pnpnet-n9", "opencv-ransac", "poselib"]
    assert out.count("| synthetic, n = 9, 0-3 outliers") == len(results["solvers"])
    for name in ("success", "errors", "problem", "training"):
        assert (folder / f"{name}.png").stat().st_size > 10_000
        assert str(folder / f"{name}.png") in out
    assert out.splitlines()[-1] == verdict(results)


def test_the_verdict_names_the_most_successful_and_the_fastest():
    def row(solver, rate, high, time):
        return {"data": "a", "solver": solver, "success": {"rate": rate, "high": high}, "us_per_problem": time}

    rows = [row("x", 0.9, 0.92, 50), row("y", 0.91, 0.93, 90), row("z", 0.5, 0.6, 20)]
    winners, fastest = verdict({"data": {"a": {}}, "rows": rows}).split(" solved the most problems")
    assert "x (90.0 %, 50 µs" in winners  # the 95 % interval of x contains the rate of y
    assert "y (91.0 %, 90 µs" in winners
    assert "z (50.0 %, 20 µs" in fastest


@pytest.mark.parametrize(("words", "code"), [("--help", 0), ("solve missing.csv", 2), ("evaluate --data missing", 2)])
def test_what_needs_no_pytorch_imports_none(words, code):
    script = (
        "import sys\nfrom kornia_pnpnet.cli import main\n"
        "try: code = main()\nexcept SystemExit as end: code = end.code\n"
        "assert not {'torch', 'kornia', 'numpy'} & sys.modules.keys()\nsys.exit(code)"
    )
    command = [sys.executable, "-c", script, *words.split()]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stderr
    assert "missing" in done.stderr or code == 0


def test_solve_estimates_the_focal_length(csv_file):
    got = answer(csv_file, "--focal", "unknown", "--intrinsics", "1,1.0125,320,240")
    assert got["ok"]
    assert got["intrinsics"][0][0] == pytest.approx(800, rel=0.02)
    assert got["intrinsics"][1][1] == pytest.approx(1.0125 * got["intrinsics"][0][0])
    prior = answer(csv_file, "--focal", "0.1", "--intrinsics", "780,790,320,240")
    assert prior["intrinsics"][0][0] == pytest.approx(800, rel=0.02)
    assert answer(csv_file, "--focal", "known", "--intrinsics", CAMERA)["intrinsics"] == K.tolist()


def test_solve_takes_cameras_of_colmap_and_with_skew_scale_and_y_up(csv_file, tmp_path):
    plain = answer(csv_file, "--intrinsics", CAMERA)
    assert answer(csv_file, "--camera", PINHOLE)["translation"] == pytest.approx(plain["translation"], abs=1e-6)
    radial = answer(csv_file, "--camera", "RADIAL,640,480,800,320,240,-0.05,0.01")
    assert radial["intrinsics"][0][0] == 800
    assert radial["translation"] != plain["translation"]
    np.savez(tmp_path / "single.npz", world_points=points().astype("f4"), img_points=seen(points()).astype("f4"))
    assert answer(tmp_path / "single.npz", "--camera", PINHOLE)["ok"]
    camera = 2.0 * np.array([[800.0, 150.0, 320.0], [0.0, -810.0, 240.0], [0.0, 0.0, 1.0]])
    img = points(12) @ camera.T
    np.savez(tmp_path / "skew.npz", world_points=points(12), img_points=img[:, :2] / img[:, 2:], intrinsics=camera)
    assert max(pair["reprojection_error_px"] for pair in answer(tmp_path / "skew.npz")["pairs"]) < 1e-2


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
    places, codes = list(places_in(content)), Counter()

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


def test_any_arguments_are_a_line_and_no_traceback(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("sound.csv").write_bytes(problem_file("csv")[0])
    # No argument changes how a figure is drawn.
    monkeypatch.setattr(pytest.importorskip("matplotlib.figure").Figure, "savefig", lambda *_, **__: None)
    codes = Counter()

    @many(80)
    @given(st.sampled_from(sorted(SHORT)), st.data())
    def run(name, data):
        quick, may = SHORT[name]
        pairs = data.draw(st.lists(st.tuples(st.sampled_from(may.split()), TEXTS), max_size=2))
        files = data.draw(st.lists(TEXTS, max_size=1))
        code, out, _ = run_main(name, *quick, *(x for pair in pairs for x in pair), *files)
        codes[name, code] += 1
        assert code in (0, 1, 2)
        assert out or code == 2

    run()
    assert all(codes[name, 2] for name in SHORT)
    # What `export` needs is not among the words.
    assert all(codes[name, 0] for name in ("solve", "evaluate", "list", "demo"))
