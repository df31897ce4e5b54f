"""Unknown focal lengths and rigs: ``cameras.json`` and ``cameras.md`` beside it.

    python benchmarks/cameras.py --out benchmarks/cameras.json --data ../shared/data

The page says what is measured.
"""

import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import harness
import numpy as np
import poselib
import pycolmap
import torch
from contenders import random_cameras, relative_errors
from harness import Row, pivot, share
from torch import Tensor, nn

from kornia_pnpnet import Normalize, PnPNet, RobustWeightedLM, create_solver
from kornia_pnpnet.core.trees import map_tensors, take
from kornia_pnpnet.data import OutlierMix, SceneProblems, load_scene
from kornia_pnpnet.peers import OpenCVRansac
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
# A prior of the focal length without information: the oracle starts from the true one.
_OPEN = 1e3
THRESHOLD, RIG_THRESHOLD = 12.0, 10.0


class Found(NamedTuple):
    """What a solver found."""

    pose: Pose
    focal: Tensor
    ok: Tensor
    us: float  # per problem


def first_focal(intrinsics: Tensor) -> Tensor:
    """Focal length of each problem, in a rig that of its first pair, (B,)."""
    return intrinsics.double().flatten(1)[:, 0]


def ours(solver: nn.Module, problems: Problems, *, known: bool = False) -> Found:
    """A solver of this package in one call, in float32, without the focal length unless it is ``known``."""
    intrinsics = problems.intrinsics
    if not known:
        intrinsics = scale_focal(intrinsics, intrinsics[:, 0, 0].reciprocal())
    inputs = map_tensors(Tensor.float, (problems.world_points, problems.img_points, intrinsics))
    rig = {} if problems.cam_from_rig is None else {"cam_from_rig": map_tensors(Tensor.float, problems.cam_from_rig)}
    with torch.no_grad():
        solver(*take(inputs, slice(32)), **{name: take(x, slice(32)) for name, x in rig.items()})
        start = time.perf_counter()
        result = solver(*inputs, **rig)
        us = 1e6 * (time.perf_counter() - start) / len(problems.world_points)
    return Found(map_tensors(Tensor.double, result.pose), first_focal(result.intrinsics), result.ok, us)


def oracle(problems: Problems) -> Found:
    """Least squares on the true inliers, from the true pose and focal length."""
    refine = RobustWeightedLM(30, robustness=0.0)
    solver = PnPNet(None, refine, Normalize(order=False), focal="unknown", focal_sigma=_OPEN)
    with torch.no_grad():
        result = solver(*problems[:3], problems.inliers.double(), init=problems.pose)
    return Found(result.pose, result.intrinsics[:, 0, 0], result.ok, 0.0)


def one_by_one(prepare: Callable[..., Callable[[], tuple[np.ndarray, float] | None]], *inputs: Tensor) -> Found:
    """Solve each problem by a call of its own, which returns the pose (3, 4) and the focal length, or ``None``.

    ``prepare`` makes the call of a problem, with the objects that the library needs. Only the calls are timed.
    """
    problems = list(zip(*(x.double().numpy() for x in inputs), strict=True))
    calls = [prepare(*one) for one in problems]
    prepare(*problems[0])()  # not timed
    start = time.perf_counter()
    found = [call() for call in calls]
    us = 1e6 * (time.perf_counter() - start) / len(found)
    columns = zip(*(x or (np.eye(3, 4), 1.0) for x in found), strict=True)
    pose, focal = (torch.from_numpy(np.array(x, dtype=np.float64)) for x in columns)
    return Found(Pose(pose[..., :3], pose[..., 3]), focal, torch.tensor([x is not None for x in found]), us)


def colmap_focal(world: np.ndarray, img: np.ndarray, intrinsics: np.ndarray) -> Any:
    """Pycolmap with ``estimate_focal_length``; the camera's guess is 1.2 times its larger side, as COLMAP's."""
    size = 2.0 * intrinsics[:2, 2]
    guess = [1.2 * size.max(), *intrinsics[:2, 2]]
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=int(size[0]), height=int(size[1]), params=guess)
    estimation: Any = {"estimate_focal_length": True, "ransac": {"max_error": THRESHOLD, "random_seed": 0}}
    refinement: Any = {"refine_focal_length": True}

    def call() -> Any:
        found = pycolmap.estimate_and_refine_absolute_pose(img, world, camera, estimation, refinement)
        return found and (found["cam_from_world"].matrix(), float(found.get("camera", camera).params[0]))

    return call


def opencv_focals(world: np.ndarray, img: np.ndarray, intrinsics: np.ndarray) -> Any:
    """OpenCV's RANSAC at 21 focal lengths; the one with most inliers."""
    size, most, best = 2.0 * intrinsics[:2, 2].max(), 0, None
    solver = OpenCVRansac(threshold=5.0, iterations=100, confidence=0.99, method="SQPNP", refine=False)
    for focal in np.geomspace(size / 2, 3 * size, 21):
        camera = np.array([[focal, 0, intrinsics[0, 2]], [0, focal, intrinsics[1, 2]], [0, 0, 1]])
        found = solver.solve_one(world, img, camera)
        if found and found.inliers.sum() > most:
            most, best = found.inliers.sum(), (np.column_stack(found[:2]), focal)
    return best


#: Solvers without the focal length: ours, and those of other libraries.
FOCAL_SOLVERS: dict[str, Callable[[Problems], Found]] = {
    **{name: partial(ours, create_solver(name, focal="unknown")) for name in OURS},
    "pycolmap": lambda problems: one_by_one(colmap_focal, *problems[:3]),
    "opencv, 21 focals": lambda problems: one_by_one(partial(partial, opencv_focals), *problems[:3]),
}
BY_FOCAL = FOCAL_SOLVERS | {"oracle": oracle}


def pinholes(intrinsics: np.ndarray) -> list[dict[str, Any]]:
    """Cameras (C, 3, 3) in COLMAP's model PINHOLE."""
    params = [[k[0, 0], k[1, 1], k[0, 2], k[1, 2]] for k in intrinsics]
    return [{"model": "PINHOLE", "width": 2000, "height": 2000, "params": x} for x in params]


def poselib_rig(world: np.ndarray, img: np.ndarray, intrinsics: np.ndarray, places: np.ndarray) -> Any:
    """PoseLib's generalised absolute pose; the cameras, whose poses (C, 3, 4) are ``places``, have pairs in turn."""
    options = {"max_reproj_error": RIG_THRESHOLD, "min_iterations": 100, "max_iterations": 10_000}
    cameras, models = len(places), pinholes(intrinsics)
    extrinsics = [poselib.CameraPose() for _ in places]
    for camera, place in zip(extrinsics, places, strict=True):
        camera.R, camera.t = place[:, :3], place[:, 3]
    pairs = [[x[c::cameras] for c in range(cameras)] for x in (img, world)]

    def call() -> Any:
        pose, report = poselib.estimate_generalized_absolute_pose(*pairs, extrinsics, models, options, {})
        return (pose.Rt, 1.0) if report["num_inliers"] else None

    return call


def pycolmap_rig(world: np.ndarray, img: np.ndarray, intrinsics: np.ndarray, places: np.ndarray) -> Any:
    """Pycolmap's generalised absolute pose, see :func:`poselib_rig`."""
    options: Any = {"max_error": RIG_THRESHOLD, "min_num_trials": 100, "random_seed": 0}
    at = [*(np.arange(len(world)) % len(places))]
    cameras = [pycolmap.Camera(**model) for model in pinholes(intrinsics)]
    rigid = [pycolmap.Rigid3d(x) for x in places]

    def call() -> Any:
        found = pycolmap.estimate_and_refine_generalized_absolute_pose(img, world, at, rigid, cameras, options)
        return found and (found["rig_from_world"].matrix(), 1.0)

    return call


#: Solvers of other libraries for rigs.
RIG_PEERS = {"PoseLib": poselib_rig, "pycolmap": pycolmap_rig}


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


def rows_of(problems: Problems, solvers: Mapping[str, Callable[[Problems], Found]] = BY_FOCAL) -> list[dict[str, Any]]:
    """A row of each solver."""
    return [{"solver": name, **row(solve(problems), problems)} for name, solve in solvers.items()]


def measure_focal(count: int, sizes: Sequence[int] = SIZES, shares: Sequence[float] = SHARES) -> list[dict[str, Any]]:
    """Success and time of all solvers by number of pairs and share of outliers."""
    rows = []
    for k, (n, outliers) in enumerate(itertools.product(sizes, shares)):
        harness.say(f"unknown focal length, n = {n}, {outliers:.0%} outliers")
        measured = rows_of(random_cameras(n, count, SEED + k, outliers))
        rows += [{"n": n, "share": outliers, **found} for found in measured]
    return rows


def measure_cell(count: int, n: int = CELL) -> list[dict[str, Any]]:
    """COLMAP's test: many pairs, half of them outliers."""
    some = {name: FOCAL_SOLVERS[name] for name in (*OURS, "pycolmap")}
    return rows_of(random_cameras(n, count, SEED + 100, 0.5), some)


def measure_real(data: Path) -> list[dict[str, Any]]:
    """Raw matches of an image with one other image, the focal length withheld."""
    raw = np.load(data / "raw" / "by_image.npz")
    enough = ((raw["error_px"] < 4.0) & raw["M"]).sum(1) >= 8
    rows = []
    for kind, title in enumerate(("ratio test", "no ratio test")):
        answers: dict[str, list[dict[str, Tensor]]] = {name: [] for name in FOCAL_SOLVERS}
        for i in np.flatnonzero(enough & (raw["kind"] == kind)):
            at = raw["M"][i]
            arrays = raw["W"][i][at], raw["I"][i][at], raw["K"][i], raw["R"][i], raw["t"][i]
            world, img, intrinsics, *pose = (torch.from_numpy(x).double()[None] for x in arrays)
            problems = Problems(world, img, intrinsics, Pose(*pose), torch.ones_like(world[..., 0]).bool())
            for name, solve in FOCAL_SOLVERS.items():  # in turns, so that a slow minute of the machine hits all of them
                found = solve(problems)
                answers[name].append({**errors(found, problems), "ok": found.ok, "us": torch.tensor([found.us])})
        for name, each in answers.items():
            all_ = {key: torch.cat([x[key] for x in each]) for key in each[0]}
            turned, position, focal = all_["rotation_deg"] < 1.0, all_["position"], all_["focal"]
            far = (all_["rotation_deg"] > 10.0) | (position > 0.3)
            exact, near = turned & (position < 0.01), turned & (position < 0.05) & (focal < 0.05)
            rates = {"success": share(exact), "success_5": share(near), "far_but_ok": share(far & all_["ok"])}
            place = {"kind": title, "solver": name, "count": len(turned)}
            rows.append({**place, **rates, "median_focal": focal.median().item(), "us": all_["us"].mean().item()})
    return rows


def measure_scenes(data: Path, count: int) -> list[dict[str, Any]]:
    """Success and time on reconstructed scenes by number of outliers, the focal length withheld."""
    rows = []
    for k, (folder, outliers) in enumerate(itertools.product(SCENES, SCENE_OUTLIERS)):
        harness.say(f"{folder}, {outliers} outliers of {SCENE_N}")
        options: dict[str, Any] = {"n": SCENE_N, "batch_size": count, "seed": SEED + 300 + k, "num_spares": SCENE_N}
        problems = SceneProblems(load_scene(data / folder), **options, outliers=OutlierMix(count=outliers)).batch(0)
        place = {"scene": folder.split("/")[1], "outliers": outliers}
        rows += [{**place, **found} for found in rows_of(problems)]
    return rows


def measure_rigs(count: int, sets: Sequence[tuple[int, float]] = RIG_SETS) -> list[dict[str, Any]]:
    """Success and time by number of cameras, baseline, number of pairs and share of outliers."""
    robust = create_solver("p3p-ransac", threshold=RIG_THRESHOLD)
    solvers = {"pnpnet-set": create_solver("pnpnet-set"), "p3p-ransac:threshold=10": robust}
    rows = []
    for k, (cameras, baseline, (n, outliers)) in enumerate(itertools.product(RIGS, BASELINES, sets)):
        harness.say(f"rig of {cameras}, baseline {baseline}, n = {n}, {outliers:.0%} outliers")
        shape: dict[str, Any] = {"cameras": cameras, "baseline": baseline, "field_of_view": (50.0, 90.0)}
        problems = random_cameras(n, count, SEED + 200 + k, outliers, **shape)
        found = {name: ours(solver, problems, known=True) for name, solver in solvers.items()}
        assert problems.cam_from_rig is not None
        rig = problems.cam_from_rig.matrix[:, :cameras, :3]
        given = *problems[:2], problems.intrinsics[:, :cameras], rig
        found |= {name: one_by_one(estimate, *given) for name, estimate in RIG_PEERS.items()}
        place = {"cameras": cameras, "baseline": baseline, "n": n, "share": outliers}
        rows += [{**place, "solver": name, **row(one, problems, focal=math.inf)} for name, one in found.items()]
    return rows


def _solved(row: Row) -> str:
    """Success in per cent, and µs where they are measured."""
    return f"{100 * row['success']:.1f}" + ("" if row["us"] is None else f" · {row['us']:,.0f}")


def page(results: Row) -> str:
    """The tables as a page."""
    scene_keys = {"scene": "{scene}", f"outliers of {SCENE_N}": "{outliers}"}
    rig_keys = {"cameras": "{cameras}", "baseline": "{baseline}", "n": "{n}", "outliers": "{share:.0%}"}
    focal = pivot(results["focal"], {"n": "{n}", "outliers": "{share:.0%}"}, BY_FOCAL, _solved)
    scenes = pivot(results["scenes"], scene_keys, BY_FOCAL, _solved)
    rigs = pivot(results["rigs"], rig_keys, ("pnpnet-set", "p3p-ransac:threshold=10", *RIG_PEERS), _solved)
    tables = {"focal": focal, "scenes": scenes, "rigs": rigs}
    return harness.render("cameras.md.jinja", results=results, pairs=CELL, **tables)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and write the files."""
    command = harness.parser(__doc__)
    command.add_argument("--data", type=Path, help="the folder of the real scenes; without it they are not measured")
    command.add_argument("--count", type=int, default=400, help="number of problems in a row")
    options = command.parse_args(arguments)

    def measure() -> dict[str, Any]:
        data, count = options.data, options.count
        found = {"focal": measure_focal(count), "cell": measure_cell(count), "real": [], "scenes": []}
        if data:
            found |= {"real": measure_real(data), "scenes": measure_scenes(data, count)}
        return {**found, "rigs": measure_rigs(count)}

    harness.write(options.out, harness.recorded(measure, count=options.count, seed=SEED), page)


if __name__ == "__main__":
    main()
