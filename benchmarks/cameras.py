"""Cameras as people have them: ``cameras.json`` and ``cameras.md`` beside it.

    python benchmarks/cameras.py --out benchmarks/cameras.json --data ../shared/data

*Unknown focal length.* Fields of view of 18 to 100 degrees, depths within 10 to 50 % of their mean, 1 px of noise. A
problem is solved within 1 degree, 5 % of the distance and 5 % of the focal length. pycolmap estimates the focal length
(P4Pf in LO-RANSAC, then refinement; threshold 12 px, the best of 2, 4, 8 and 12 on seed 6); OpenCV's RANSAC runs at 21
focal lengths, as DUSt3R does, and keeps the one with most inliers. The oracle is least squares on the true inliers,
from the true pose and focal length.

*COLMAP's cell.* Half of the pairs are outliers, 1 px of noise: recall, and medians of the errors.

*Real matches.* The raw matches of an image and one other image (`raw/by_image.npz`) with at least 8 right pairs, the
focal length withheld; solved within 1 degree and 1 % of the median depth. Nothing was tuned on them with an unknown
focal length; with a known one they have been looked at.

*Scenes.* Problems of 20 pairs of five reconstructed scenes, without the focal length. The pixel of an outlier is
that of another point, or anywhere in the image. No solver was tuned on the scenes without the focal length.

*Rigs.* Three and six cameras that look in all directions; solved within 1 degree and 5 % of the distance. PoseLib's and
pycolmap's generalised absolute pose with a threshold of 10 px, ours with their defaults.

Times are of one thread, one call for all problems; of the other libraries one call for each problem.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import poselib
import pycolmap
import torch
from harness import Column, Row, by_solver, parser, percent, pivot, recorded, say, share, table, target, threads, write
from tasks import relative_errors
from torch import Tensor, nn

from kornia_pnpnet import Normalize, PnPNet, RobustWeightedLM, create_solver
from kornia_pnpnet.core.trees import map_tensors, take
from kornia_pnpnet.data import CameraProblems, OutlierMix, SceneProblems, load_scene
from kornia_pnpnet.propose.focal import scale_focal
from kornia_pnpnet.result import Pose, Problems

# Used for nothing else. The grid of focal lengths and its threshold were chosen on seed 6 of another generator.
SEED = 20_301_126
OURS = ("pnpnet-set", "p3p-ransac")
SIZES, SHARES = (6, 12, 30, 100), (0.0, 0.25, 0.5, 0.8)
CELL = 1000
RIGS, BASELINES, RIG_SETS = (3, 6), (0.02, 0.1, 0.5), ((6, 0.0), (12, 0.25), (30, 0.4), (60, 0.6), (200, 0.6))
SCENES = (
    *("colmap/lund_door", "colmap/sceaux_castle", "eth3d/courtyard"),
    *("strecha/fountain-P11", "strecha/Herz-Jesus-P25"),
)
SCENE_N, SCENE_OUTLIERS = 20, (0, 5, 10)
# A prior of the focal length that says nothing: the oracle starts from the true one.
_OPEN = 1e3
# Problems that the other libraries solve one by one: with 80 % outliers each takes 25 ms.
FEW = 200
THRESHOLD, RIG_THRESHOLD = 12.0, 10.0
_PEERS = ("PoseLib", "pycolmap")  # of rigs


class Found(NamedTuple):
    """What a solver found: poses, focal lengths, whether it believes them, and µs per problem."""

    pose: Pose
    focal: Tensor
    ok: Tensor
    us: float


def draw(n: int, count: int, seed: int, share: float, **options: Any) -> Problems:
    """Problems of random cameras."""
    options = {"batch_size": count, "seed": SEED + seed, "outlier_share": share, "dtype": torch.float64, **options}
    return CameraProblems(n=n, **options).batch(0)


def first_focal(intrinsics: Tensor) -> Tensor:
    """Focal length of each problem, in a rig that of its first pair, (B,)."""
    return intrinsics[..., 0, 0].double().flatten(1)[:, 0] if intrinsics.ndim == 4 else intrinsics[:, 0, 0].double()


def ours(solver: nn.Module, problems: Problems, *, known: bool = False) -> Found:
    """A solver of this package in one call, in float32, without the focal length unless it is ``known``."""
    intrinsics = problems.intrinsics
    if not known:
        intrinsics = scale_focal(intrinsics, intrinsics[:, 0, 0].reciprocal())
    given = map_tensors(Tensor.float, (problems.world_points, problems.img_points, intrinsics, problems.cam_from_rig))

    def call(inputs: Any) -> Any:
        *inputs, rig = inputs
        return solver(*inputs, **({} if rig is None else {"cam_from_rig": rig}))

    with threads(), torch.no_grad():
        call(take(given, slice(32)))
        start = time.perf_counter()
        result = call(given)
        us = 1e6 * (time.perf_counter() - start) / len(problems.world_points)
    return Found(map_tensors(Tensor.double, result.pose), first_focal(result.intrinsics), result.ok, us)


def oracle(problems: Problems) -> Found:
    """Least squares on the true inliers, from the true pose and focal length."""
    refine = RobustWeightedLM(30, robustness=0.0)
    solver = PnPNet(None, refine, Normalize(order=False), focal="unknown", focal_sigma=_OPEN)
    with threads(), torch.no_grad():
        result = solver(*problems[:3], problems.inliers.double(), init=problems.pose)
    return Found(result.pose, result.intrinsics[:, 0, 0], result.ok, 0.0)


def one_by_one(solve: Callable[..., tuple[np.ndarray, np.ndarray, float] | None], problems: Problems) -> Found:
    """Call a function of world points, pixels, intrinsics and the index for each problem."""
    nothing = np.eye(3), np.zeros(3), 1.0
    arrays = [x.double().numpy() for x in problems[:3]]
    start = time.perf_counter()
    found = [solve(*inputs, i) for i, inputs in enumerate(zip(*arrays, strict=True))]
    us = 1e6 * (time.perf_counter() - start) / len(found)
    columns = zip(*(x or nothing for x in found), strict=True)
    rotation, translation, focal = (torch.from_numpy(np.array(x, dtype=np.float64)) for x in columns)
    return Found(Pose(rotation, translation), focal, torch.tensor([x is not None for x in found]), us)


def colmap_focal(world: np.ndarray, img: np.ndarray, intrinsics: np.ndarray, _: int) -> Any:
    """Pycolmap with ``estimate_focal_length``; the camera's guess is 1.2 times its larger side, as COLMAP's."""
    size = 2.0 * intrinsics[:2, 2]
    guess = [1.2 * size.max(), *intrinsics[:2, 2]]
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=int(size[0]), height=int(size[1]), params=guess)
    estimation: Any = {"estimate_focal_length": True, "ransac": {"max_error": THRESHOLD, "random_seed": 0}}
    refinement: Any = {"refine_focal_length": True}
    found = pycolmap.estimate_and_refine_absolute_pose(img, world, camera, estimation, refinement)
    if found is None:
        return None
    matrix = found["cam_from_world"].matrix()
    return matrix[:, :3], matrix[:, 3], float(found.get("camera", camera).params[0])


def opencv_focals(world: np.ndarray, img: np.ndarray, intrinsics: np.ndarray, _: int) -> Any:
    """OpenCV's RANSAC at 21 focal lengths; the one with most inliers."""
    size, best = 2.0 * intrinsics[:2, 2].max(), None
    for focal in np.geomspace(size / 2, 3 * size, 21):
        camera = np.array([[focal, 0, intrinsics[0, 2]], [0, focal, intrinsics[1, 2]], [0, 0, 1]])
        options: Any = {"reprojectionError": 5.0, "iterationsCount": 100, "flags": cv2.SOLVEPNP_SQPNP}
        try:
            found, rvec, tvec, inliers = cv2.solvePnPRansac(world, img, camera, None, **options)
        except cv2.error:
            continue
        if found and inliers is not None and (best is None or len(inliers) > best[0]):
            best = len(inliers), rvec, tvec, focal
    return None if best is None else (cv2.Rodrigues(best[1])[0], best[2][:, 0], best[3])


#: Solvers of other libraries without the focal length.
FOCAL_PEERS = {
    "pycolmap": partial(one_by_one, colmap_focal),
    "opencv, 21 focals": partial(one_by_one, opencv_focals),
}
BY_FOCAL = (*OURS, *FOCAL_PEERS, "oracle")


def errors(found: Found, problems: Problems) -> dict[str, Tensor]:
    """Errors of rotation in degrees, of the position in distances, of the focal length relative."""
    turn, shift = relative_errors(found.pose, problems)
    focal = (found.focal / first_focal(problems.intrinsics) - 1.0).abs()
    return {"rotation_deg": turn, "position": shift, "focal": focal}


def row(found: Found, problems: Problems, *, focal: float = 0.05) -> dict[str, Any]:
    """Success, the share of poses that are ``ok`` and wrong, medians of the errors, and the time."""
    error = errors(found, problems)
    right = (error["rotation_deg"] < 1.0) & (error["position"] < 0.05) & (error["focal"] < focal)
    medians = {f"median_{name}": x.median().item() for name, x in error.items()}
    rates = {"success": share(right), "wrong_but_ok": share(~right & found.ok), "count": len(right)}
    return {**rates, "us": found.us or None, **medians}


def rows_of_all(problems: Problems, some: int) -> list[dict[str, Any]]:
    """Rows of our solvers, of pycolmap on the first ``some`` problems, of OpenCV on fewer, and of the oracle."""
    found = {name: row(ours(create_solver(name, focal="unknown"), problems), problems) for name in OURS}
    for (name, peer), count in zip(FOCAL_PEERS.items(), (some, FEW // 2), strict=True):
        few = take(problems, slice(count))
        found[name] = row(peer(few), few)
    found["oracle"] = row(oracle(problems), problems)
    return [{"solver": name, **measured} for name, measured in found.items()]


def measure_focal(count: int, sizes: Sequence[int] = SIZES, shares: Sequence[float] = SHARES) -> list[dict[str, Any]]:
    """Success and time of all solvers by number of pairs and share of outliers."""
    rows = []
    for k, (n, outliers) in enumerate(itertools.product(sizes, shares)):
        say(f"unknown focal length, n = {n}, {outliers:.0%} outliers")
        measured = rows_of_all(draw(n, count, k, outliers), FEW if outliers > 0.25 else count)
        rows += [{"n": n, "share": outliers, **found} for found in measured]
    return rows


def measure_cell(count: int, n: int = CELL) -> list[dict[str, Any]]:
    """COLMAP's test: many pairs, half of them outliers."""
    problems = draw(n, count, 100, 0.5)
    found = {name: ours(create_solver(name, focal="unknown"), problems) for name in OURS}
    found["pycolmap"] = FOCAL_PEERS["pycolmap"](problems)
    return [{"solver": name, **row(one, problems)} for name, one in found.items()]


def measure_real(data: Path) -> list[dict[str, Any]]:
    """Raw matches of an image with one other image, the focal length withheld."""
    raw = np.load(data / "raw" / "by_image.npz")
    solvers = {name: partial(ours, create_solver(name, focal="unknown")) for name in OURS} | FOCAL_PEERS
    enough = ((raw["error_px"] < 4.0) & raw["M"]).sum(1) >= 8
    rows = []
    for kind, title in enumerate(("ratio test", "no ratio test")):
        answers: dict[str, list[dict[str, Tensor]]] = {name: [] for name in solvers}
        for i in np.flatnonzero(enough & (raw["kind"] == kind)):
            at = raw["M"][i]
            parts = raw["W"][i][at], raw["I"][i][at], raw["K"][i], raw["R"][i], raw["t"][i]
            world, img, intrinsics, *pose = (torch.from_numpy(x).double()[None] for x in parts)
            problems = Problems(world, img, intrinsics, Pose(*pose), torch.ones_like(world[..., 0]).bool())
            for name, solve in solvers.items():  # in turns, so that a slow minute of the machine hits all of them
                found = solve(problems)
                spent = {"ok": found.ok, "us": torch.tensor([found.us])}
                answers[name].append({**errors(found, problems), **spent})
        for name, each in answers.items():
            all_ = {key: torch.cat([x[key] for x in each]) for key in each[0]}
            turned = all_["rotation_deg"] < 1.0
            far = (all_["rotation_deg"] > 10.0) | (all_["position"] > 0.3)
            found_row = {
                "count": len(turned),
                "success": share(turned & (all_["position"] < 0.01)),
                "success_5": share(turned & (all_["position"] < 0.05) & (all_["focal"] < 0.05)),
                "far_but_ok": share(far & all_["ok"]),
                "median_focal": all_["focal"].median().item(),
                "us": all_["us"].mean().item(),
            }
            rows.append({"kind": title, "solver": name, **found_row})
    return rows


def measure_scenes(data: Path, count: int) -> list[dict[str, Any]]:
    """Success and time on reconstructed scenes by number of outliers, the focal length withheld."""
    rows = []
    for k, (folder, outliers) in enumerate(itertools.product(SCENES, SCENE_OUTLIERS)):
        say(f"{folder}, {outliers} outliers of {SCENE_N}")
        options: dict[str, Any] = {"n": SCENE_N, "batch_size": count, "seed": SEED + 300 + k, "num_spares": SCENE_N}
        problems = SceneProblems(load_scene(data / folder), **options, outliers=OutlierMix(count=outliers)).batch(0)
        place = {"scene": folder.split("/")[1], "outliers": outliers}
        rows += [{**place, **found} for found in rows_of_all(problems, FEW)]
    return rows


def poselib_rig(problems: Problems, cameras: int) -> Found:
    """PoseLib's generalised absolute pose."""
    assert problems.cam_from_rig is not None
    rotation, translation, matrices = (x.numpy() for x in (*problems.cam_from_rig, problems.intrinsics))
    options = {"max_reproj_error": RIG_THRESHOLD, "min_iterations": 100, "max_iterations": 10_000}

    def solve(world: np.ndarray, img: np.ndarray, _: np.ndarray, i: int) -> Any:
        extrinsics, models = [poselib.CameraPose() for _ in range(cameras)], []
        for c, place in enumerate(extrinsics):
            place.R, place.t = rotation[i, c], translation[i, c]
            models.append({"model": "PINHOLE", "width": 2000, "height": 2000, "params": pinhole(matrices[i, c])})
        pairs = [[x[c::cameras] for c in range(cameras)] for x in (img, world)]
        pose, report = poselib.estimate_generalized_absolute_pose(*pairs, extrinsics, models, options, {})
        return (pose.R, pose.t, 1.0) if report["num_inliers"] else None

    return one_by_one(solve, problems)


def pinhole(k: np.ndarray) -> list[float]:
    """Parameters of COLMAP's model PINHOLE."""
    return [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]


def pycolmap_rig(problems: Problems, cameras: int) -> Found:
    """Pycolmap's generalised absolute pose."""
    assert problems.cam_from_rig is not None
    rotation, translation = problems.cam_from_rig
    matrices, places = problems.intrinsics.numpy(), torch.cat((rotation, translation[..., None]), -1).numpy()
    options: Any = {"max_error": RIG_THRESHOLD, "min_num_trials": 100, "random_seed": 0}

    def solve(world: np.ndarray, img: np.ndarray, _: np.ndarray, i: int) -> Any:
        size = {"width": 2000, "height": 2000}
        models = [pycolmap.Camera(model="PINHOLE", **size, params=pinhole(k)) for k in matrices[i, :cameras]]
        rigid = [pycolmap.Rigid3d(x) for x in places[i, :cameras]]
        at = [*(np.arange(len(world)) % cameras)]
        found = pycolmap.estimate_and_refine_generalized_absolute_pose(img, world, at, rigid, models, options)
        if found is None:
            return None
        matrix = found["rig_from_world"].matrix()
        return matrix[:, :3], matrix[:, 3], 1.0

    return one_by_one(solve, problems)


def measure_rigs(count: int, sets: Sequence[tuple[int, float]] = RIG_SETS) -> list[dict[str, Any]]:
    """Success and time by number of cameras, baseline, number of pairs and share of outliers."""
    robust = create_solver("p3p-ransac", threshold=RIG_THRESHOLD)
    solvers = {"pnpnet-set": create_solver("pnpnet-set"), "p3p-ransac:threshold=10": robust}
    rows = []
    for k, (cameras, baseline, (n, outliers)) in enumerate(itertools.product(RIGS, BASELINES, sets)):
        say(f"rig of {cameras}, baseline {baseline}, n = {n}, {outliers:.0%} outliers")
        shape: dict[str, Any] = {"cameras": cameras, "baseline": baseline, "field_of_view": (50.0, 90.0)}
        problems = draw(n, count, 200 + k, outliers, **shape)
        few = take(problems, slice(FEW))
        found = {name: (ours(solver, problems, known=True), problems) for name, solver in solvers.items()}
        found |= {"PoseLib": (poselib_rig(few, cameras), few), "pycolmap": (pycolmap_rig(few, cameras), few)}
        place = {"cameras": cameras, "baseline": baseline, "n": n, "share": outliers}
        rows += [{**place, "solver": name, **row(*one, focal=float("inf"))} for name, one in found.items()]
    return rows


def targets(results: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The targets of the pages of this project, met or not."""
    cells = by_solver(results["focal"], "n", "share")
    twelve = [c for (n, outliers), c in cells.items() if n == 12 and outliers <= 0.5]
    rigs = by_solver(results["rigs"], "cameras", "baseline", "n", "share").values()
    first = results["cell"][0]

    def behind(cells: Any, *peers: str) -> float:
        return max(100 * (max(c[x]["success"] for x in peers) - c["pnpnet-set"]["success"]) for c in cells)

    def faster(cells: Any, peer: str) -> float:
        return min(c[peer]["us"] / c["pnpnet-set"]["us"] for c in cells)

    solvable = [c for c in cells.values() if c["oracle"]["success"] > 0]
    colmap, slowest = behind(cells.values(), "pycolmap"), max(c["pnpnet-set"]["us"] for c in twelve)
    listed: list[tuple[str, float, float, str, bool]] = [  # what, measured, wanted, unit, at most
        ("Unknown focal length: points behind pycolmap in the worst cell", colmap, 0.0, "points", True),
        ("Points behind the oracle in the worst cell", behind(solvable, "oracle"), 5.0, "points", True),
        ("`pnpnet-set`, n = 12, at most 50 % outliers: µs per problem, the slowest cell", slowest, 100.0, "µs", True),
        ("The same: times as fast as pycolmap, the smallest ratio", faster(twelve, "pycolmap"), 10.0, "times", False),
        ("COLMAP's cell: recall", 100 * first["success"], 100.0, "%", False),
        ("COLMAP's cell: median rotation error", first["median_rotation_deg"], 0.015, "degrees", True),
        ("COLMAP's cell: median focal error", 100 * first["median_focal"], 0.034, "%", True),
        (
            "Rigs: points behind the better of PoseLib and pycolmap in the worst cell",
            behind(rigs, *_PEERS),
            0.0,
            "points",
            True,
        ),
        ("Rigs: times as fast as PoseLib, the smallest ratio", faster(rigs, "PoseLib"), 5.0, "times", False),
    ]
    return [target(what, measured, wanted, unit=unit, at_most=most) for what, measured, wanted, unit, most in listed]


def _solved(row: Row) -> str:
    """Success in per cent, and µs where they are measured."""
    return f"{100 * row['success']:.1f}" + ("" if row["us"] is None else f" · {row['us']:,.0f}")


def page(results: Mapping[str, Any]) -> str:
    """The tables as a page."""
    aims: dict[str, Column] = {
        **{"Target": "{what}", "Measured": "{measured:.3g}", "Wanted": "{target:g}"},
        "Met": lambda x: "yes" if x["met"] else "**no**",
    }
    cell: dict[str, Column] = {
        **{
            "Solver": "`{solver}`",
            "recall (%)": percent("success"),
            "median rotation (°)": "{median_rotation_deg:.4f}",
        },
        **{"median focal (%)": percent("median_focal", 4), "µs": "{us:,.0f}"},
    }
    real: dict[str, Column] = {
        **{"Matches": "{kind}", "Solver": "`{solver}`", "problems": "{count}", "solved (%)": percent("success")},
        **{"solved, 5 % (%)": percent("success_5"), "far but ok (%)": percent("far_but_ok")},
        **{"median focal error (%)": percent("median_focal", 2), "ms": lambda x: f"{x['us'] / 1000:,.1f}"},
    }
    absent = "Not measured: the data were not at hand."
    scene_keys = {"scene": "{scene}", f"outliers of {SCENE_N}": "{outliers}"}
    rig_keys = {"cameras": "{cameras}", "baseline": "{baseline}", "n": "{n}", "outliers": "{share:.0%}"}
    where = "{cpu}, {date}".format_map(results["environment"])
    return f"""\
# Cameras: unknown focal lengths and rigs

Written by `benchmarks/cameras.py`, whose first lines say what is measured. {where}. Cells hold the share of solved
problems in per cent, then µs per problem; `pnpnet-set` and `p3p-ransac` solve {results["settings"]["count"]} problems
in a call, the other libraries one.

{table(targets(results), aims)}

## Unknown focal length

{pivot(results["focal"], {"n": "{n}", "outliers": "{share:.0%}"}, BY_FOCAL, _solved)}

## COLMAP's cell

{CELL} pairs, half of them outliers, 1 px.

{table(results["cell"], cell)}

## Real matches without the focal length

*solved*: 1° and 1 % of the median depth; *solved, 5 %*: 1°, 5 % and 5 % of the focal length; *far but ok*: more than
10° or 30 % off, and believed. One problem a call.

{table(results["real"], real) if results["real"] else absent}

## Scenes without the focal length

{pivot(results["scenes"], scene_keys, BY_FOCAL, _solved) if results["scenes"] else absent}

## Rigs

{pivot(results["rigs"], rig_keys, ("pnpnet-set", "p3p-ransac:threshold=10", *_PEERS), _solved)}
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and write the files."""
    command = parser(__doc__)
    command.add_argument(
        "--out", type=Path, required=True, help="the results file (.json); its page goes beside it (.md)"
    )
    command.add_argument("--data", type=Path, help="the folder of the real scenes; without it they are not measured")
    command.add_argument("--count", type=int, default=1000, help="number of problems in a batch")
    options = command.parse_args(arguments)

    def measure() -> dict[str, Any]:
        return {
            "focal": measure_focal(options.count),
            "cell": measure_cell(FEW),
            "real": measure_real(options.data) if options.data else [],
            "scenes": measure_scenes(options.data, options.count) if options.data else [],
            "rigs": measure_rigs(options.count),
        }

    write(options.out, recorded(measure, count=options.count, seed=SEED), page)


if __name__ == "__main__":
    main()
