"""Pose from real matches: ``real_matches.py make FOLDER A.npz``, ``real_matches.py measure A.npz --solvers NAMES``.

``make`` localises images in a map as a user would. FOLDER holds a COLMAP model with poses of all images (its points are
not used) in ``sparse/0``, ``sparse`` or FOLDER itself, and the images in ``images``. Every fourth image is a query, the
others are the map: SIFT keypoints (OpenCV), whose points pycolmap triangulates from the images of the map alone. A
problem is one query against one image of the map: each keypoint of the query is matched to its nearest neighbour
(kind 1), or only where Lowe's ratio test accepts it (kind 0). The reference pose is the model's.

``measure`` solves the problems of such files with solvers by name, all in turns in the same run on one thread. A name
with ``+ratio`` at the end gets 1 - ratio as the confidence of each pair.
``--pictures`` draws failures of the first solver: of each scene the far-off pose with the most inliers under the
reference pose, and of these the three with the most. ``--batch`` gives the numbers of problems in a call.

``cost`` times solvers by share of outliers and number of pairs.
"""

import argparse
import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from harness import Row, pivot, recorded, say, share
from kornia.geometry import epipolar
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from kornia_pnpnet import pose_errors
from kornia_pnpnet.cameras import reproject
from kornia_pnpnet.core.files import read_npz
from kornia_pnpnet.core.trees import map_tensors, take
from kornia_pnpnet.data.colmap import _find_model, _pinhole
from kornia_pnpnet.evaluation import SeesTruth
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.evaluation.plots import BLUE, GREY, ORANGE, WIDTH, make_figure, save
from kornia_pnpnet.evaluation.results import save_results
from kornia_pnpnet.metrics import reliability
from kornia_pnpnet.peers import PeerSolver
from kornia_pnpnet.result import PnPResult, Pose, Problems

Floats = NDArray[np.float64]
Whole = NDArray[np.int64]

# Upper limit of the reprojection error of an inlier under the reference pose, in pixels; images have 1000 to 1600. A
# problem with fewer inliers than MIN_INLIERS does not count in rates.
INLIER_PX, MIN_INLIERS = 8.0, 8
# Upper limits of the rotation error in degrees and of the distance of the camera centres by the median depth of the
# inliers, for a pose to be right; a pose above one of the other two is far off.
RIGHT, FAR = (1.0, 0.01), (10.0, 0.3)
# Shares of outliers by which results are grouped.
SHARES = (0.0, 0.3, 0.6, 0.8, 0.9, 0.95, 1.0)
KINDS = ("ratio test", "no ratio test")
RATIO_TEST = 0.8  # Lowe's value
BATCH = 500
FEATURES = 2000  # keypoints of an image
EVERY = 4  # every fourth image is a query
VIEWS = 6  # images of the map for each query
MOST_PAIRS = 500  # of a problem
SEED = 0  # of the subsets of pairs
# Points of the map: largest distance to the epipolar line and largest reprojection error in an image of the map, in
# pixels; smallest angle between two of the rays, in degrees.
EPIPOLAR_PX, TRIANGULATION_PX, MIN_ANGLE = 2.0, 2.0, 1.5
# An image of the map can be matched to a query when this fraction of its points, and at least this number of them, lies
# inside the query.
MIN_OVERLAP, MIN_POINTS = 0.25, 30
# End of the names of solvers that get 1 - ratio as the confidence of each pair.
CONFIDENCE = "+ratio"
# Limits of the numbers of pairs by which results are grouped.
PAIRS = (0, 25, 50, 100, 200, 400, 501)
PICTURES = 3
# Problems in a batch of `cost`, and problems of a group that has a row.
COST_BATCH, MIN_GROUP = 250, 20
# Arrays of a file: of pairs (P, N, ...), and of problems (P, ...).
OF_PAIRS, OF_PROBLEMS = ("world", "pixels", "ratio", "mask", "error_px"), ("K", "R", "t", "kind")


class View(NamedTuple):
    """One image: its keypoints in undistorted pixels, and its pose ``x_cam = R x_world + t``."""

    name: str
    size: tuple[int, int]  # width, height
    pixels: Floats  # (M, 2)
    descriptors: NDArray[np.float32]  # (M, 128)
    intrinsics: Floats  # (3, 3)
    pose: Floats  # (3, 4)

    @property
    def centre(self) -> Floats:
        """Camera centre in the world, shape (3,)."""
        return -self.pose[:, :3].T @ self.pose[:, 3]

    def project(self, points: Floats) -> Floats:
        """Pixels (M, 2) of world points (M, 3), NaN behind the camera."""
        image = (points @ self.pose[:, :3].T + self.pose[:, 3]) @ self.intrinsics.T
        return image[:, :2] / np.where(image[:, 2:] > 0, image[:, 2:], np.nan)


class Matches(NamedTuple):
    """Problems of one or several scenes, padded to the same number of pairs."""

    problems: Problems  # with the reference poses; inliers have an error below INLIER_PX under them
    mask: Tensor  # (P, N)
    ratio: Tensor  # (P, N)
    error_px: Tensor  # (P, N)
    kind: Tensor  # (P,)
    scene: tuple[str, ...]  # P names

    @property
    def outlier_share(self) -> Tensor:
        """Share of the pairs that are outliers, shape (P,)."""
        return 1 - self.problems.inliers.sum(1) / self.mask.sum(1)

    @property
    def counts(self) -> Tensor:
        """Problems that count in rates, shape (P,)."""
        return self.problems.inliers.sum(1) >= MIN_INLIERS

    def of_scene(self, name: str) -> Tensor:
        """Whether a problem belongs to a scene, shape (P,)."""
        return torch.tensor([scene == name for scene in self.scene])


class Solved(NamedTuple):
    """What a solver found, for problems (P,)."""

    pose: Pose
    ok: Tensor
    milliseconds: Tensor  # elapsed, the same for all problems of a batch
    probability: Tensor  # NaN for problems that do not count


def read_views(folder: Path) -> list[View]:
    """Detect keypoints in all images of a COLMAP model that have a pose, sorted by name."""
    import cv2
    import pycolmap

    model = pycolmap.Reconstruction(str(_find_model(folder)))
    sift = cv2.SIFT.create(nfeatures=FEATURES, enable_precise_upscale=True)
    views = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        picture = cv2.imread(str(folder / "images" / image.name), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        if picture is None or not image.has_pose:
            say(f"{image.name}: no picture or no pose")
            continue
        camera = image.camera
        if picture.shape != (camera.height, camera.width):
            raise ValueError(f"{image.name} has the shape {picture.shape}, its camera {camera.height, camera.width}.")
        keypoints, descriptors = sift.detectAndCompute(picture, None)
        if descriptors is None:
            continue
        # OpenCV counts from the centre of the first pixel, COLMAP from its corner.
        distorted = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64) + 0.5
        intrinsics, pixels = _pinhole(camera, distorted)
        seen = np.isfinite(pixels).all(1)
        size, pose = (camera.width, camera.height), image.cam_from_world().matrix()
        views.append(View(image.name, size, pixels[seen], descriptors[seen], intrinsics, pose))
    return views


def nearest(query: NDArray[np.float32], train: NDArray[np.float32]) -> tuple[Whole, Floats]:
    """Nearest neighbour of each descriptor, and the distance to it by the distance to the second nearest."""
    two = torch.cdist(torch.from_numpy(query), torch.from_numpy(train)).topk(2, largest=False)
    distances = two.values.double().numpy()
    return two.indices[:, 0].numpy(), distances[:, 0] / np.maximum(distances[:, 1], 1e-9)


def agree(first: View, second: View, pairs: Whole) -> NDArray[np.bool_]:
    """Whether matched keypoints (M, 2) lie close to each other's epipolar line under the poses of the model."""
    views = first, second
    fundamental = epipolar.fundamental_from_projections(
        *(torch.from_numpy(view.intrinsics @ view.pose)[None] for view in views)
    )
    one, two = (torch.from_numpy(view.pixels[at])[None] for view, at in zip(views, pairs.T, strict=True))
    right = epipolar.left_to_right_epipolar_distance(one, two, fundamental)
    left = epipolar.right_to_left_epipolar_distance(one, two, fundamental)
    return ((right < EPIPOLAR_PX) & (left < EPIPOLAR_PX))[0].numpy()


def tracks(views: Sequence[View]) -> list[Whole]:
    """Keypoints of the same point, as rows of the number of a view and the number of a keypoint in this view.

    A match joins two keypoints when each is the nearest neighbour of the other, the ratio test accepts it, and it fits
    the epipolar geometry. A track with two keypoints in one image is dropped.
    """
    starts = np.cumsum([0, *(len(view.pixels) for view in views)])
    edges = [np.zeros((0, 2), dtype=np.int64)]
    for i, j in itertools.combinations(range(len(views)), 2):
        there, ratio = nearest(views[i].descriptors, views[j].descriptors)
        back, _ = nearest(views[j].descriptors, views[i].descriptors)
        mine = np.arange(len(there))
        pairs = np.column_stack([mine, there])[(back[there] == mine) & (ratio < RATIO_TEST)]
        edges.append(pairs[agree(views[i], views[j], pairs)] + [starts[i], starts[j]])
    ends = np.concatenate(edges).T
    graph = coo_array((np.ones(ends.shape[1]), (ends[0], ends[1])), shape=(starts[-1], starts[-1]))
    _, track = connected_components(graph, directed=False)
    order = track.argsort(kind="stable")
    view = np.searchsorted(starts, order, side="right") - 1
    members = np.column_stack([view, order - starts[view]])
    groups = np.split(members, np.flatnonzero(np.diff(track[order])) + 1)
    return [group for group in groups if 1 < len(group) == len(np.unique(group[:, 0]))]


def triangulate(views: Sequence[View]) -> list[Floats]:
    """World point of each keypoint, NaN where it has no track or a keypoint of its track does not fit the point."""
    import pycolmap

    residual = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    options = pycolmap.EstimateTriangulationOptions(residual_type=residual, min_tri_angle=math.radians(MIN_ANGLE))
    options.ransac.max_error, options.ransac.random_seed = TRIANGULATION_PX, 0
    poses, cameras = [pycolmap.Rigid3d(view.pose) for view in views], []
    for view in views:
        (width, height), params = view.size, view.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
        cameras.append(pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params))
    found = [np.full((len(view.pixels), 3), np.nan) for view in views]
    for track in tracks(views):
        pixels = np.array([views[i].pixels[at] for i, at in track])
        chosen = [[x[i] for i, _ in track] for x in (poses, cameras)]
        made = pycolmap.estimate_triangulation(pixels, chosen[0], chosen[1], options)
        if made is not None and all(made["inliers"]):
            for i, at in track:
                found[i][at] = made["xyz"]
    return found


def choose_images(query: View, database: Sequence[View], points: Sequence[Floats]) -> list[int]:
    """Images of the map that see the query's place, from near viewpoints to far ones."""
    distances = {}
    for number, (view, known) in enumerate(zip(database, points, strict=True)):
        world = known[np.isfinite(known[:, 0])]
        pixels = query.project(world)
        inside = ((pixels > 0) & (pixels < np.array(query.size))).all(1)  # False where NaN
        if inside.sum() < max(MIN_POINTS, MIN_OVERLAP * len(world)):
            continue
        mine, theirs = query.centre - world[inside], view.centre - world[inside]
        lengths = np.linalg.norm(mine, axis=1), np.linalg.norm(theirs, axis=1)
        angle = np.arccos(np.clip((mine * theirs).sum(1) / (lengths[0] * lengths[1]), -1, 1))
        distances[number] = float(np.median(angle + np.abs(np.log(lengths[0] / lengths[1]))))
    ranked = sorted(distances, key=lambda number: distances[number])
    at = np.linspace(0, len(ranked) - 1, min(VIEWS, len(ranked))).round().astype(int)
    return [ranked[i] for i in at]


def make(folder: Path, out: Path) -> Matches:
    """Make the problems of one scene, write them and read them again."""
    views = read_views(folder)
    queries = views[EVERY // 2 :: EVERY]
    database = [view for i, view in enumerate(views) if i % EVERY != EVERY // 2]
    points = triangulate(database)
    known = sum(int(np.isfinite(p[:, 0]).sum()) for p in points)
    say(f"{folder.name}: {len(queries)} queries, {len(database)} images with {known} keypoints with a point")
    generator = np.random.default_rng(SEED)
    rows: list[dict[str, Any]] = []
    for query in queries:
        for number in choose_images(query, database, points):
            match, ratio = nearest(query.descriptors, database[number].descriptors)
            world = points[number][match]
            for kind in range(len(KINDS)):
                at = np.flatnonzero(np.isfinite(world[:, 0]) & ((ratio < RATIO_TEST) | (kind == 1)))
                if len(at) < MIN_INLIERS:
                    continue
                at = generator.permutation(at)[:MOST_PAIRS]
                error = np.linalg.norm(query.project(world[at]) - query.pixels[at], axis=1)
                error = np.where(np.isnan(error), np.inf, error).astype(np.float32)
                row = {"world": world[at], "pixels": query.pixels[at], "ratio": ratio[at].astype(np.float32)}
                row |= {"error_px": error, "mask": np.ones(len(at), dtype=bool), "kind": kind, "K": query.intrinsics}
                row |= {"R": query.pose[:, :3], "t": query.pose[:, 3]}
                rows.append(row | {"query": query.name, "database": database[number].name})
    if not rows:
        raise ValueError(f"{folder} has no problems.")
    arrays: dict[str, Any] = {name: np.stack([row[name] for row in rows]) for name in rows[0] if name not in OF_PAIRS}
    for name in OF_PAIRS:
        filling = np.inf if name == "error_px" else 0
        arrays[name] = pad_sequence([torch.from_numpy(row[name]) for row in rows], True, filling).numpy()
    out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(out, allow_pickle=False, **arrays)
    return read([out])


def read(paths: Sequence[Path]) -> Matches:
    """Read the problems of several files into one batch. A file's name is the name of its scene."""
    files = [read_npz(path, OF_PAIRS + OF_PROBLEMS) for path in paths]
    rows = {name: [torch.from_numpy(row) for file in files for row in file[name]] for name in OF_PAIRS}
    one = {name: pad_sequence(x, batch_first=True) for name, x in rows.items()}
    one |= {name: torch.from_numpy(np.concatenate([file[name] for file in files])) for name in OF_PROBLEMS}
    one |= {name: x.double() for name, x in one.items() if name != "mask"}
    pose, inliers = Pose(one["R"], one["t"]), one["mask"] & (one["error_px"] < INLIER_PX)
    problems = Problems(one["world"], one["pixels"], one["K"], pose, inliers)
    scenes = tuple(path.stem for path, file in zip(paths, files, strict=True) for _ in file["kind"])
    return Matches(problems, one["mask"], one["ratio"], one["error_px"], one["kind"], scenes)


def batches(matches: Matches, size: int) -> list[Tensor]:
    """Indices of problems that count, of one kind and with similar numbers of pairs, at most ``size`` of them."""
    pairs = matches.mask.sum(1)
    kinds = ((matches.counts & (matches.kind == kind)).nonzero()[:, 0] for kind in range(len(KINDS)))
    return [part for at in kinds if len(at) for part in at[pairs[at].argsort()].split(size)]


def batch(matches: Matches, at: Tensor) -> tuple[tuple[Problems, Tensor, Tensor], Tensor]:
    """Some of the problems in float32 without common padding, their masks and ratios, and their origins.

    A world far from its origin would lose digits in float32. Padding has the ratio 1.
    """
    problems, mask, ratio = take((matches.problems, matches.mask, matches.ratio), at)
    rotation, translation = problems.pose
    origin = (problems.world_points * mask[..., None]).sum(1) / mask.sum(1, keepdim=True)
    pose = Pose(rotation, translation + (rotation @ origin[..., None])[..., 0])
    of_pairs = problems.world_points - origin[:, None], problems.img_points, problems.inliers, ratio.where(mask, 1.0)
    longest = int(mask.sum(1).max())
    world, img, inliers, ratio, mask = (x[:, :longest] for x in (*of_pairs, mask))
    given = (Problems(world, img, problems.intrinsics, pose, inliers), mask, ratio)
    return map_tensors(lambda x: x if x.dtype == torch.bool else x.float(), given), origin


def call(
    solver: Any, spec: str, given: Problems, mask: Tensor, ratio: Tensor, times: int = 1
) -> tuple[PnPResult, float]:
    """Solve a batch; the result, and milliseconds for a problem, the median of some ``times``.

    A bound sees the reference poses. Peers with a ratio get the best pairs first; only their own calls are timed.
    """
    known: dict[str, Any] = {}
    if CONFIDENCE in spec and isinstance(solver, PeerSolver):
        order = ratio.argsort(dim=1, stable=True)
        world, img = (x.take_along_dim(order[..., None], 1) for x in given[:2])
        given, mask = given._replace(world_points=world, img_points=img), mask.gather(1, order)
    elif CONFIDENCE in spec:
        known = {"confidence": 1 - ratio}
    bound, seconds = isinstance(solver, SeesTruth), []
    for _ in range(times):
        start = time.perf_counter()
        result = solver.solve_with_truth(given) if bound else solver(*given[:3], mask=mask, **known)
        seconds.append(solver.library_s if isinstance(solver, PeerSolver) else time.perf_counter() - start)
    return result, 1e3 * float(np.median(seconds)) / len(mask)


@torch.no_grad()
def solve(solvers: Mapping[str, nn.Module], matches: Matches, size: int, times: int) -> dict[str, Solved]:
    """Solve all problems that count with all solvers, which take turns on each batch. See :func:`measure`."""
    found = {}
    for spec in solvers:
        pose, ok = map_tensors(torch.zeros_like, (matches.problems.pose, matches.counts))
        found[spec] = Solved(pose, ok, *torch.full((2, len(ok)), torch.nan, dtype=torch.float64))
    parts = batches(matches, size)
    for number, at in enumerate(parts):
        given, origin = batch(matches, at)
        for spec, solver in solvers.items():
            say(f"batch {number + 1} of {len(parts)}: {spec}")
            call(solver, spec, *take(given, slice(2)))  # not timed: slower
            one = found[spec]
            result, one.milliseconds[at] = call(solver, spec, *given, times=times if size > 1 else 1)
            one.pose.rotation[at] = rotation = result.rotation.double()
            one.pose.translation[at] = result.translation.double() - (rotation @ origin[..., None])[..., 0]
            one.ok[at] = result.ok
            one.probability[at] = result.probability.double()
    return found


#: Ranges of the share of outliers and of the number of pairs, by their titles.
BY_SHARE = {f"{100 * low:.0f}–{100 * high:.0f} %": (low, high) for low, high in itertools.pairwise(SHARES)}
BY_PAIRS = {f"{low}–{high - 1} pairs": (low, high) for low, high in itertools.pairwise(PAIRS)}


def groups(matches: Matches) -> dict[tuple[str, str], Tensor]:
    """Problems that count, by kind and share of outliers, by kind and number of pairs, and by kind and scene."""
    found = {}
    for kind, title in enumerate(KINDS):
        found[title, "all"] = chosen = matches.counts & (matches.kind == kind)
        for values, limits in ((matches.outlier_share, BY_SHARE), (matches.mask.sum(1), BY_PAIRS)):
            for name, (low, high) in limits.items():
                found[title, name] = chosen & (values >= low) & (values < high)
        for scene in dict.fromkeys(matches.scene):
            found[title, scene] = chosen & matches.of_scene(scene)
    return found


def load_solvers(specs: Sequence[str]) -> dict[str, nn.Module]:
    """Solvers and bounds as for :func:`load_solver`, in float32, with CONFIDENCE at the end."""
    return {spec: load_solver(spec.partition("+")[0]).float() for spec in specs}


def measure(
    matches: Matches, specs: Sequence[str], pictures: Path | None, sizes: Sequence[int], times: int
) -> dict[str, Any]:
    """Solve the problems with all solvers, with each of the ``sizes`` of a call; draw failures into ``pictures``.

    The time of a batch is the median of ``times`` calls. Times of single calls are means over all problems.
    """
    solvers, chosen = load_solvers(specs), groups(matches)
    solved = {size: solve(solvers, matches, size, times) for size in sizes}
    rows: list[dict[str, Any]] = []
    curves: dict[str, Any] = {}
    failures: list[dict[str, Any]] = []
    for size, spec in itertools.product(sizes, specs):
        one = solved[size][spec]
        right, far = judge(matches, one.pose)
        predicted = matches.counts & one.probability.isfinite()
        if predicted.any():
            curve = reliability(one.probability[predicted], ~far[predicted])._asdict()
            curves.setdefault(spec, {name: values.nan_to_num(0.0).tolist() for name, values in curve.items()})
        for (kind, group), at in chosen.items():
            place = {"solver": spec, "kind": kind, "group": group, "batch": size, "count": int(at.sum())}
            rates = {"success": share(right[at]), "far": share(far[at])}
            oks = {"ok_of_right": share(one.ok[at & right]), "ok_of_far": share(one.ok[at & far])}
            ms = float(one.milliseconds[at].mean()) if at.any() else None
            rows.append({**place, **rates, **oks, "ms_per_problem": ms})
        if pictures is not None and (size, spec) == (sizes[0], specs[0]):
            failures = [draw_failure(matches, one, at, pictures) for at in worst_failures(matches, far)]
    return {"counts": describe(matches), "rows": rows, "reliability": curves, "failures": failures}


@torch.no_grad()
def measure_cost(matches: Matches, specs: Sequence[str], times: int) -> dict[str, Any]:
    """Time solvers on matches without a ratio test, by share of outliers and by number of pairs, in full batches."""
    solvers, chosen, rows = load_solvers(specs), groups(matches), []
    for group in (*BY_SHARE, *BY_PAIRS):
        at = chosen[KINDS[1], group].nonzero()[:, 0]
        if len(at) < MIN_GROUP:
            continue
        given, _ = batch(matches, at[torch.arange(COST_BATCH) % len(at)])
        for spec, solver in solvers.items():
            say(f"{group}: {spec}")
            call(solver, spec, *take(given, slice(2)))  # not timed: slower
            rows.append({"solver": spec, "group": group, "ms_per_problem": call(solver, spec, *given, times)[1]})
    return {"rows": rows}


def judge(matches: Matches, pose: Pose) -> tuple[Tensor, Tensor]:
    """Which poses are right, and which are far off, bool (P,)."""
    problems = matches.problems
    centres = [(x.rotation.mT @ x.translation[..., None])[..., 0] for x in (pose, problems.pose)]
    depth = problems.true_cam_points[..., 2].where(problems.inliers, torch.nan).nanmedian(1).values
    angle, distance = pose_errors(pose, problems.pose).rotation_error_deg, (centres[0] - centres[1]).norm(dim=1) / depth
    return (angle < RIGHT[0]) & (distance < RIGHT[1]), (angle > FAR[0]) | (distance > FAR[1])


def worst_failures(matches: Matches, far: Tensor) -> list[int]:
    """Of each scene the far-off pose with the most inliers under the reference pose, the most first."""
    inliers = matches.problems.inliers.sum(1).tolist()
    best: dict[str, int] = {}
    for at in sorted((matches.counts & far).nonzero()[:, 0].tolist(), key=lambda at: -inliers[at]):
        best.setdefault(matches.scene[at], at)
    return list(best.values())[:PICTURES]


def draw_failure(matches: Matches, solved: Solved, at: int, folder: Path) -> dict[str, Any]:
    """Draw the pairs of a problem under the reference pose and under a wrong pose, and count how many fit each."""
    mask, problem = matches.mask[at], take(matches.problems, torch.tensor(at))
    world, pixels = problem.world_points[mask], problem.img_points[mask]
    poses = {"reference pose": problem.pose, "pose that was found": take(solved.pose, torch.tensor(at))}
    figure = make_figure(WIDTH, 3.4)
    figure.set_layout_engine("compressed")  # for axes of equal aspect
    panels, fits = figure.subplots(1, 2, sharex=True, sharey=True), []
    for axes, (title, pose) in zip(panels, poses.items(), strict=True):
        seen = reproject(world[None], problem.intrinsics, map_tensors(lambda x: x[None], pose))[0]
        fit = (seen - pixels).norm(dim=1) < INLIER_PX
        fits.append(fit)
        axes.plot(*pixels[~fit].T, ".", color=GREY, markersize=2.5, label="pixels of other pairs")
        axes.plot(*pixels[fit].T, "o", color=BLUE, markersize=3.5, label=f"pixels within {INLIER_PX:g} px")
        axes.plot(*seen[fit].T, "+", color=ORANGE, markersize=6, label="their projections")
        axes.set(title=f"{title}:\n{int(fit.sum())} of {len(fit)}", aspect="equal")
    axes.invert_yaxis()
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    name = f"real_failure_{matches.scene[at]}.png"
    save(figure, folder / name)
    right, wrong = fits
    spread = float(pixels[wrong].std(0).norm() / pixels.std(0).norm()) if wrong.sum() > 1 else 0.0
    numbers = {"right": int(right.sum()), "found": int(wrong.sum()), "both": int((right & wrong).sum())}
    place = {"picture": name, "scene": matches.scene[at], "kind": KINDS[int(matches.kind[at])], "pairs": len(right)}
    return {**place, **numbers, "ok": bool(solved.ok[at]), "spread": spread}


def describe(matches: Matches) -> list[dict[str, Any]]:
    """Numbers of problems by scene, kind and share of outliers, and the median reprojection error of the inliers."""
    found, chosen = [], groups(matches)
    for scene in dict.fromkeys(matches.scene):
        mine = matches.of_scene(scene)
        errors = matches.error_px[mine][matches.problems.inliers[mine]]
        row: dict[str, Any] = {"scene": scene, "median_error_px": float(errors.median()) if len(errors) else None}
        for kind, title in enumerate(KINDS):
            shares = [int((chosen[title, name] & mine).sum()) for name in BY_SHARE]
            number = int((mine & (matches.kind == kind)).sum())
            row[title] = {"problems": number, "counted": int(chosen[title, scene].sum()), "shares": shares}
        found.append(row)
    return found


def format_results(results: Mapping[str, Any]) -> str:
    """Success in per cent and milliseconds of a problem by share of outliers, then by scene."""
    scenes = [row["scene"] for row in results["counts"]]

    def cell(row: Row) -> str:
        return f"{100 * row['success']:.1f}, {row['ms_per_problem']:.2f} ms" if row["count"] else "–"

    tables = []
    for columns, kind in itertools.product((["all", *BY_SHARE], scenes), KINDS):
        rows = [row for row in results["rows"] if row["kind"] == kind]
        tables.append(pivot(rows, {kind: "`{solver}`, calls of {batch}"}, columns, cell, by="group", pad=True))
    return "\n\n".join(tables)


def main(arguments: Sequence[str] | None = None) -> None:
    """Make or measure problems, and print what was found."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = command.add_subparsers(dest="command", required=True)
    making = commands.add_parser("make", help="make the problems of one scene")
    making.add_argument("folder", type=Path, help="a COLMAP model with its images in images/")
    making.add_argument("out", type=Path, help="the file of problems (.npz)")
    measuring = commands.add_parser("measure", help="solve problems")
    timing = commands.add_parser("cost", help="time solvers on groups of problems")
    for one in (measuring, timing):
        one.add_argument("problems", type=Path, nargs="+", help="files of `make`")
        one.add_argument("--solvers", nargs="+", required=True, help=f"names, with {CONFIDENCE} at the end")
        one.add_argument("--out", type=Path, required=True, help="the results file (.json)")
        one.add_argument("--times", type=int, default=1, help="calls of a batch: their median counts")
    measuring.add_argument("--split", default="", help="whether the scenes were seen while choosing, in words")
    measuring.add_argument("--pictures", type=Path, help="folder for pictures of failures of the first solver")
    measuring.add_argument("--batch", type=int, nargs="+", default=[BATCH], help="problems in a call of ours")
    options = command.parse_args(arguments)
    if options.command == "make":
        print(*describe(make(options.folder, options.out)), sep="\n")
        return
    matches = read(options.problems)
    settings: dict[str, Any] = {"files": [path.name for path in options.problems], "solvers": options.solvers}
    settings |= {"shares": SHARES, "pairs": PAIRS, "batch": COST_BATCH, "times": options.times}
    run: Callable[[], dict[str, Any]] = partial(measure_cost, matches, options.solvers, options.times)
    if options.command == "measure":
        settings |= {"split": options.split, "batch": options.batch, "dtype": "torch.float32"}
        settings |= {"inlier_px": INLIER_PX, "min_inliers": MIN_INLIERS, "right": RIGHT, "far": FAR}
        run = partial(measure, matches, options.solvers, options.pictures, options.batch, options.times)
    results = recorded(run, **settings)
    if options.command == "measure":
        print(format_results(results))
    save_results(results, options.out)


if __name__ == "__main__":
    main()
