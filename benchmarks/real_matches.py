"""Pose from real matches: ``real_matches.py make FOLDER A.npz``, ``real_matches.py measure A.npz --solvers NAMES``.

``make`` localises images in a map as a user would. FOLDER holds a COLMAP model with poses of all images (its points are
not used) in ``sparse/0``, ``sparse`` or FOLDER itself, and the images in ``images``. Every fourth image is a query, the
others are the map: SIFT keypoints (OpenCV) with points triangulated from the images of the map alone. A problem is one
query against one image of the map: each keypoint of the query is matched to its nearest neighbour (kind 1), or only
where Lowe's ratio test accepts it (kind 0). The reference pose is the model's.

``measure`` solves the problems of such files with solvers by name, all in turns in the same run on one thread. A name
with ``+ratio`` at the end gets 1 - ratio as the confidence of each pair, one with ``+sigma`` gets sigmas of 1 px and 0.
``--pictures`` draws failures of the first solver: of each scene the far-off pose with the most inliers under the
reference pose, and of these the three with the most.

``cost`` times solvers by share of outliers and number of pairs.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from harness import load, say, threads
from kornia.core.exceptions import BaseError
from numpy.typing import NDArray
from torch import Tensor, nn

from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.files import read_npz
from kornia_pnpnet.core.tables import markdown_table
from kornia_pnpnet.data.colmap import _find_model
from kornia_pnpnet.evaluation.bounds import Bound
from kornia_pnpnet.evaluation.figures.style import BLUE, GREY, ORANGE, WIDTH, make_figure, save
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.evaluation.results import save_results
from kornia_pnpnet.metrics import reliability
from kornia_pnpnet.peers.base import PeerSolver
from kornia_pnpnet.types import PnPResult, Pose
from kornia_pnpnet.types import Problems as SolverProblems

Floats = NDArray[np.float64]
Whole = NDArray[np.int64]
Mask = NDArray[np.bool_]

# A pair is an inlier when its reprojection error under the reference pose is below this many pixels, in images of 1000
# to 1600 pixels. A problem with fewer inliers than MIN_INLIERS does not count in rates.
INLIER_PX, MIN_INLIERS = 8.0, 8
# Upper limits of the rotation error in degrees and of the distance of the camera centres by the median depth of the
# inliers, for a pose to be right; a pose above one of the other two is far off.
RIGHT, FAR = (1.0, 0.01), (10.0, 0.3)
# Shares of outliers by which results are grouped.
SHARES = (0.0, 0.3, 0.6, 0.8, 0.9, 0.95, 1.0)
KINDS = ("ratio test", "no ratio test")
RATIO_TEST = 0.8  # Lowe's value
BATCH = 500
# Points of the map: largest distance to the epipolar line and largest reprojection error in an image of the map, in
# pixels; smallest angle between two of the rays, in degrees.
EPIPOLAR_PX, TRIANGULATION_PX, MIN_ANGLE = 2.0, 2.0, 1.5
# An image of the map can be matched to a query when this share of its points, and at least this number of them, lies
# inside the query.
MIN_OVERLAP, MIN_POINTS = 0.25, 30
# What a solver is told whose name ends with this: 1 - ratio as the confidence of each pair, or sigmas.
CONFIDENCE, SIGMAS = "+ratio", "+sigma"
TOLD_SIGMAS = {"img_sigma": 1.0, "world_sigma": 0.0}
# Limits of the numbers of pairs by which results are grouped.
PAIRS = (0, 25, 50, 100, 200, 400, 501)
PICTURES = 3
# Problems in a batch of `cost`, and problems of a group that has a row.
COST_BATCH, MIN_GROUP = 250, 20
FIELDS = ("world", "pixels", "ratio", "mask", "K", "R", "t", "kind", "error_px")


class View(NamedTuple):
    """One image: its keypoints in undistorted pixels, and its pose ``x_cam = R x_world + t``."""

    name: str
    size: tuple[int, int]  # width, height
    pixels: Floats  # (M, 2)
    descriptors: NDArray[np.float32]  # (M, 128)
    intrinsics: Floats  # (3, 3)
    rotation: Floats  # (3, 3)
    translation: Floats  # (3,)

    @property
    def centre(self) -> Floats:
        """Camera centre in the world, shape (3,)."""
        return -self.rotation.T @ self.translation

    @property
    def projection(self) -> Floats:
        """Matrix from homogeneous world points to pixels, shape (3, 4)."""
        return self.intrinsics @ np.column_stack([self.rotation, self.translation])


class Problems(NamedTuple):
    """Problems of one or several scenes, padded to the same number of pairs."""

    world: Tensor  # (P, N, 3)
    pixels: Tensor  # (P, N, 2)
    ratio: Tensor  # (P, N)
    mask: Tensor  # (P, N)
    intrinsics: Tensor  # (P, 3, 3)
    rotation: Tensor  # (P, 3, 3)
    translation: Tensor  # (P, 3)
    kind: Tensor  # (P,)
    error_px: Tensor  # (P, N)
    scene: tuple[str, ...]  # P names

    @property
    def inliers(self) -> Tensor:
        """Pairs that are right under the reference pose, shape (P, N)."""
        return self.mask & (self.error_px < INLIER_PX)

    @property
    def outlier_share(self) -> Tensor:
        """Share of the pairs that are outliers, shape (P,)."""
        return 1 - self.inliers.sum(1) / self.mask.sum(1)

    @property
    def counts(self) -> Tensor:
        """Problems that count in rates, shape (P,)."""
        return self.inliers.sum(1) >= MIN_INLIERS

    @property
    def depth(self) -> Tensor:
        """Median depth of the inliers, shape (P,); NaN without an inlier."""
        depth = (self.world @ self.rotation.mT + self.translation[:, None])[..., 2]
        return depth.where(self.inliers, torch.nan).nanmedian(1).values


class Solved(NamedTuple):
    """What a solver found for all problems."""

    rotation: Tensor  # (P, 3, 3)
    translation: Tensor  # (P, 3)
    ok: Tensor  # (P,)
    milliseconds: Tensor  # (P,) of the processor, the same for all problems of a batch
    probability: Tensor  # (P,) NaN where the solver has none


# --- Problems of a scene ----------------------------------------------------------------------------------------------


def read_views(folder: Path, features: int) -> list[View]:
    """Detect keypoints in all images of a COLMAP model that have a pose, sorted by name."""
    import cv2
    import pycolmap

    model = pycolmap.Reconstruction(str(_find_model(folder)))
    sift = cv2.SIFT.create(nfeatures=features, enable_precise_upscale=True)
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
        intrinsics = camera.calibration_matrix()
        pixels = camera.cam_from_img(distorted) @ intrinsics[:2, :2].T + intrinsics[:2, 2]
        seen = np.isfinite(pixels).all(1)
        pose = image.cam_from_world().matrix()
        size = (camera.width, camera.height)
        views.append(View(image.name, size, pixels[seen], descriptors[seen], intrinsics, pose[:, :3], pose[:, 3]))
    return views


def nearest(query: NDArray[np.float32], train: NDArray[np.float32]) -> tuple[Whole, Floats]:
    """Nearest neighbour of each descriptor, and the distance to it by the distance to the second nearest."""
    squares = (query**2).sum(1)[:, None] - 2 * query @ train.T + (train**2).sum(1)
    two = np.argpartition(squares, 1, axis=1)[:, :2]
    distances = np.sqrt(np.maximum(np.take_along_axis(squares, two, axis=1), 0.0).astype(np.float64))
    first = distances.argmin(1)
    rows = np.arange(len(query))
    return two[rows, first].astype(np.int64), distances[rows, first] / np.maximum(distances[rows, 1 - first], 1e-9)


def agree(first: View, second: View, pairs: Whole) -> Mask:
    """Whether matched keypoints, shape (M, 2), lie near each other's epipolar line under the poses of the model."""
    rotation = second.rotation @ first.rotation.T
    x, y, z = second.translation - rotation @ first.translation
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    fundamental = np.linalg.inv(second.intrinsics).T @ skew @ rotation @ np.linalg.inv(first.intrinsics)
    ones = np.ones((len(pairs), 1))
    one = np.hstack([first.pixels[pairs[:, 0]], ones])
    two = np.hstack([second.pixels[pairs[:, 1]], ones])
    lines_two, lines_one = one @ fundamental.T, two @ fundamental
    residual = np.abs((two * lines_two).sum(1))
    bound = EPIPOLAR_PX * np.minimum(np.linalg.norm(lines_one[:, :2], axis=1), np.linalg.norm(lines_two[:, :2], axis=1))
    return residual < bound


def tracks(views: Sequence[View]) -> list[Whole]:
    """Label the keypoints of each image by track, -1 where there is none.

    Keypoints are joined that are each other's nearest neighbour, pass the ratio test and fit the epipolar geometry. A
    track with two keypoints in one image is dropped.
    """
    starts = np.cumsum([0, *(len(view.pixels) for view in views)])
    parent = np.arange(starts[-1])

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    for i, j in itertools.combinations(range(len(views)), 2):
        there, ratio = nearest(views[i].descriptors, views[j].descriptors)
        back, _ = nearest(views[j].descriptors, views[i].descriptors)
        mine = np.arange(len(there))
        pairs = np.column_stack([mine, there])[(back[there] == mine) & (ratio < RATIO_TEST)]
        for a, b in pairs[agree(views[i], views[j], pairs)]:
            parent[root(starts[i] + a)] = root(starts[j] + b)
    roots = np.array([root(node) for node in range(starts[-1])])
    size = np.bincount(roots, minlength=starts[-1])
    image = np.repeat(np.arange(len(views)), np.diff(starts))
    keys, times = np.unique(roots * len(views) + image, return_counts=True)
    size[keys[times > 1] // len(views)] = 0
    labels = np.where(size[roots] >= 2, roots, -1)
    return [labels[start:end] for start, end in itertools.pairwise(starts)]


def triangulate(views: Sequence[View], labels: Sequence[Whole]) -> list[Floats]:
    """World point of each keypoint, NaN where it has no track or the point of its track fails a check."""
    kept = [np.flatnonzero(label >= 0) for label in labels]
    names, track = np.unique(
        np.concatenate([lab[at] for lab, at in zip(labels, kept, strict=True)]), return_inverse=True
    )
    view = np.repeat(np.arange(len(views)), [len(at) for at in kept])
    pixels = np.concatenate([v.pixels[at] for v, at in zip(views, kept, strict=True)])
    offset = np.mean([v.centre for v in views], axis=0)
    shift = np.eye(4)
    shift[:3, 3] = offset
    matrices = np.stack([v.projection @ shift for v in views])[view]  # (M, 3, 4)
    focal = np.array([v.intrinsics[0, 0] for v in views])[view]
    rows = (pixels[:, :, None] * matrices[:, 2:] - matrices[:, :2]) / focal[:, None, None]  # (M, 2, 4)
    weight = np.ones(len(track))
    for _ in range(4):  # weights of 1 / depth turn algebraic errors into reprojection errors
        scaled = rows * weight[:, None, None]
        normal, right = np.zeros((len(names), 3, 3)), np.zeros((len(names), 3))
        np.add.at(normal, track, scaled[..., :3].mT @ scaled[..., :3])
        np.add.at(right, track, -(scaled[..., :3].mT @ scaled[..., 3:])[..., 0])
        flat = np.linalg.cond(normal) > 1e12
        normal[flat] = np.eye(3)
        points = np.linalg.solve(normal, right[..., None])[..., 0]
        depth = (matrices[:, 2, :3] * points[track]).sum(1) + matrices[:, 2, 3]
        weight = 1 / np.maximum(np.abs(depth), 1e-6)
    image = (matrices[:, :, :3] @ points[track][..., None])[..., 0] + matrices[:, :, 3]
    error = np.linalg.norm(image[:, :2] / np.where(image[:, 2:] > 0, image[:, 2:], 1e-9) - pixels, axis=1)
    rays = np.stack([v.centre - offset for v in views])[view] - points[track]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    # The angle to the first ray of the track bounds the largest angle from below.
    _, first = np.unique(track, return_index=True)
    cosine = np.ones(len(names))
    np.minimum.at(cosine, track, (rays * rays[first][track]).sum(1))
    worst = np.zeros(len(names))
    np.maximum.at(worst, track, np.where(depth > 0, error, np.inf))
    good = ~flat & (worst < TRIANGULATION_PX) & (cosine < np.cos(np.radians(MIN_ANGLE)))
    points = np.where(good[:, None], points + offset, np.nan)
    found = [np.full((len(label), 3), np.nan) for label in labels]
    for number, at in enumerate(kept):
        found[number][at] = points[track[view == number]]
    return found


def reprojection(view: View, points: Floats, pixels: Floats) -> Floats:
    """Reprojection errors in pixels, infinite behind the camera."""
    camera = points @ view.rotation.T + view.translation
    ahead = camera[:, 2] > 0
    image = camera @ view.intrinsics.T
    error = np.linalg.norm(image[:, :2] / np.where(ahead, image[:, 2], 1.0)[:, None] - pixels, axis=1)
    return np.where(ahead, error, np.inf)


def choose_images(query: View, database: Sequence[View], points: Sequence[Floats], count: int) -> list[int]:
    """Images of the map that see the query's place, from near viewpoints to far ones."""
    distances = {}
    for number, (view, known) in enumerate(zip(database, points, strict=True)):
        world = known[np.isfinite(known[:, 0])]
        if len(world) < MIN_POINTS:
            continue
        camera = world @ query.rotation.T + query.translation
        image = camera @ query.intrinsics.T
        pixels = image[:, :2] / np.where(camera[:, 2:] > 0, image[:, 2:], np.nan)
        inside = ((pixels > 0) & (pixels < np.array(query.size))).all(1)  # False where NaN
        if inside.sum() < max(MIN_POINTS, MIN_OVERLAP * len(world)):
            continue
        mine, theirs = query.centre - world[inside], view.centre - world[inside]
        lengths = np.linalg.norm(mine, axis=1), np.linalg.norm(theirs, axis=1)
        angle = np.arccos(np.clip((mine * theirs).sum(1) / (lengths[0] * lengths[1]), -1, 1))
        distances[number] = float(np.median(angle + np.abs(np.log(lengths[0] / lengths[1]))))
    ranked = sorted(distances, key=lambda number: distances[number])
    at = np.linspace(0, len(ranked) - 1, min(count, len(ranked))).round().astype(int)
    return [ranked[i] for i in at]


def make(folder: Path, out: Path, *, features: int, every: int, views: int, pairs: int, seed: int) -> Problems:
    """Make the problems of one scene and write them to ``out``.

    Args:
        folder: the scene.
        out: the ``.npz`` file.
        features: largest number of keypoints of an image.
        every: every ``every``-th image is a query.
        views: number of images of the map that each query is matched to.
        pairs: largest number of pairs of a problem; of more pairs a random subset is kept.
        seed: seed of the subsets.

    Returns:
        The problems, as :func:`read` reads them.
    """
    found = read_views(folder, features)
    queries, database = found[every // 2 :: every], [v for i, v in enumerate(found) if i % every != every // 2]
    points = triangulate(database, tracks(database))
    known = sum(int(np.isfinite(p[:, 0]).sum()) for p in points)
    say(f"{folder.name}: {len(queries)} queries, {len(database)} images with {known} keypoints with a point")
    generator = np.random.default_rng(seed)
    rows: list[dict[str, Any]] = []
    for query in queries:
        for number in choose_images(query, database, points, views):
            match, ratio = nearest(query.descriptors, database[number].descriptors)
            world = points[number][match]
            for kind in range(len(KINDS)):
                at = np.flatnonzero(np.isfinite(world[:, 0]) & ((ratio < RATIO_TEST) | (kind == 1)))
                if len(at) < MIN_INLIERS:
                    continue
                at = generator.permutation(at)[:pairs]
                error = reprojection(query, world[at], query.pixels[at])
                values = (world[at], query.pixels[at], ratio[at], np.ones(len(at), dtype=bool))
                pose = (query.intrinsics, query.rotation, query.translation, kind, error)
                names = {"query": query.name, "database": database[number].name}
                rows.append({**dict(zip(FIELDS, (*values, *pose), strict=True)), **names})
    if not rows:
        raise ValueError(f"{folder} has no problems.")
    longest = max(len(row["ratio"]) for row in rows)
    for row in rows:
        for name in ("world", "pixels", "ratio", "mask", "error_px"):
            width = [(0, longest - len(row[name]))] + [(0, 0)] * (row[name].ndim - 1)
            row[name] = np.pad(row[name], width, constant_values=np.inf if name == "error_px" else 0)
    arrays = {name: np.stack([row[name] for row in rows]) for name in (*FIELDS, "query", "database")}
    for name in ("ratio", "error_px"):
        arrays[name] = arrays[name].astype(np.float32)
    out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(out, allow_pickle=False, **arrays)
    return read([out])


def read(paths: Sequence[Path]) -> Problems:
    """Read the problems of several files into one batch. A file's name is the name of its scene."""
    files = [read_npz(path) for path in paths]
    longest = max(file["ratio"].shape[1] for file in files)
    columns: dict[str, list[Tensor]] = {name: [] for name in FIELDS}
    for file, name in itertools.product(files, FIELDS):
        values = torch.from_numpy(file[name])
        if name in ("world", "pixels", "ratio", "mask", "error_px"):
            padded = values.new_zeros(len(values), longest, *values.shape[2:])
            padded[:, : values.shape[1]] = values
            values = padded
        columns[name].append(values if values.dtype == torch.bool else values.double())
    scenes = tuple(path.stem for path, file in zip(paths, files, strict=True) for _ in file["kind"])
    return Problems._make([*(torch.cat(columns[name]) for name in FIELDS), scenes])


# --- Solvers on problems ----------------------------------------------------------------------------------------------


def batches(problems: Problems, size: int) -> list[Tensor]:
    """Indices of problems that count, of one kind and with similar numbers of pairs, at most ``size`` of them."""
    pairs = problems.mask.sum(1)
    kinds = ((problems.counts & (problems.kind == kind)).nonzero()[:, 0] for kind in range(len(KINDS)))
    return [part for at in kinds if len(at) for part in at[pairs[at].argsort()].split(size)]


def batch(problems: Problems, at: Tensor, dtype: torch.dtype) -> tuple[SolverProblems, Tensor, Tensor]:
    """Some of the problems without common padding, the ratios, and the points that became the origins.

    A world far from its origin would lose digits in float32. Padding has the ratio 1.
    """
    mask = problems.mask[at]
    longest = int(mask.sum(1).max())
    origin = (problems.world[at] * mask[..., None]).sum(1) / mask.sum(1, keepdim=True)
    world = problems.world[at] - origin[:, None]
    translation = problems.translation[at] + (problems.rotation[at] @ origin[..., None])[..., 0]
    made = SolverProblems(
        world[:, :longest].to(dtype),
        problems.pixels[at][:, :longest].to(dtype),
        problems.intrinsics[at].to(dtype),
        Pose(problems.rotation[at].to(dtype), translation.to(dtype)),
        problems.inliers[at][:, :longest],
    )
    return made, problems.ratio[at].where(mask, 1.0)[:, :longest].to(dtype), origin


def call(solver: nn.Module, spec: str, given: SolverProblems, mask: Tensor, ratio: Tensor) -> PnPResult:
    """Solve a batch; a bound sees the reference poses, and other libraries told the ratio get the best pairs first."""
    if isinstance(solver, Bound):
        return solver.solve_with_truth(given)
    if CONFIDENCE in spec and isinstance(solver, PeerSolver):
        order = ratio.argsort(dim=1, stable=True)
        rows = torch.arange(len(order))[:, None]
        given = given._replace(world_points=given.world_points[rows, order], img_points=given.img_points[rows, order])
        return solver(given.world_points, given.img_points, given.intrinsics, mask=mask.gather(1, order))
    told: dict[str, Any] = {"confidence": 1 - ratio} if CONFIDENCE in spec else {}
    told |= TOLD_SIGMAS if SIGMAS in spec else {}
    return solver(given.world_points, given.img_points, given.intrinsics, mask=mask, **told)


@torch.no_grad()
def solve(solvers: Mapping[str, nn.Module], problems: Problems, dtype: torch.dtype, size: int) -> dict[str, Solved]:
    """Solve all problems that count with all solvers, which take turns on each batch."""
    found = {}
    for spec in solvers:
        zeros = [torch.zeros_like(x) for x in (problems.rotation, problems.translation, problems.counts)]
        found[spec] = Solved(*zeros, *torch.full((2, len(problems.kind)), torch.nan, dtype=torch.float64))
    parts = batches(problems, size)
    for number, at in enumerate(parts):
        given, ratio, origin = batch(problems, at, dtype)
        mask = problems.mask[at][:, : ratio.shape[1]]
        for spec, solver in solvers.items():
            say(f"batch {number + 1} of {len(parts)}: {spec}")
            call(solver, spec, given.map(lambda value: value[:2]), mask[:2], ratio[:2])  # not timed: slower
            start = time.process_time()
            result = call(solver, spec, given, mask, ratio)
            milliseconds = 1e3 * (time.process_time() - start) / len(at)
            one = found[spec]
            one.rotation[at] = result.rotation.double()
            one.translation[at] = result.translation.double() - (one.rotation[at] @ origin[..., None])[..., 0]
            one.ok[at] = result.ok
            one.milliseconds[at] = milliseconds
            if result.probability is not None:
                one.probability[at] = result.probability.double()
    return found


def pose_errors(problems: Problems, rotation: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation errors in degrees and distances of the camera centres by the median depth of the inliers."""
    turned = rotation - problems.rotation  # |A - B| = 2 sqrt(2) sin(angle / 2), also precise for small angles
    angle = 2 * torch.asin((turned.flatten(1).norm(dim=1) / 8**0.5).clamp(max=1)).rad2deg()
    centres = (
        (r.mT @ t[..., None])[..., 0] for r, t in ((rotation, translation), (problems.rotation, problems.translation))
    )
    return angle, (next(centres) - next(centres)).norm(dim=1) / problems.depth


def groups(problems: Problems) -> dict[tuple[str, str], Tensor]:
    """Problems that count, by kind and share of outliers, and by kind and scene."""
    share, found = problems.outlier_share, {}
    for kind, title in enumerate(KINDS):
        chosen = problems.counts & (problems.kind == kind)
        found[title, "all"] = chosen
        for low, high in itertools.pairwise(SHARES):
            found[title, share_title(low, high)] = chosen & (share >= low) & (share < high)
        count = problems.mask.sum(1)
        for least, most in itertools.pairwise(PAIRS):
            found[title, pairs_title(least, most)] = chosen & (count >= least) & (count < most)
        for scene in dict.fromkeys(problems.scene):
            found[title, scene] = chosen & torch.tensor([name == scene for name in problems.scene])
    return found


def pairs_title(least: int, most: int) -> str:
    """Title of a group of numbers of pairs."""
    return f"{least}–{most - 1} pairs"


def share_title(low: float, high: float) -> str:
    """Title of a group of shares of outliers."""
    return f"{100 * low:.0f}–{100 * high:.0f} %"


def rate(values: Tensor) -> float | None:
    """Share of True, ``None`` of nothing."""
    return float(values.double().mean()) if len(values) else None


def measure(
    paths: Sequence[Path],
    specs: Sequence[str],
    dtype: torch.dtype,
    split: str,
    pictures: Path | None = None,
    sizes: Sequence[int] = (BATCH,),
) -> dict[str, Any]:
    """Solve the problems of the files.

    Args:
        paths: files of :func:`make`.
        specs: solvers and bounds as for :func:`load_solver`, with :data:`CONFIDENCE` or :data:`SIGMAS` at the end.
        dtype: dtype that the solvers get.
        split: whether the scenes were seen while choosing, in words.
        pictures: folder for pictures of failures.
        sizes: numbers of problems in a call; all solvers run with each, and other libraries always get one problem.

    Returns:
        ``environment``, ``settings``, ``load_average`` (before and after), ``counts``, ``rows`` (one for each solver,
        kind and group), ``reliability`` by solver, and ``failures`` in the pictures.
    """
    before = load()
    problems = read(paths)
    solvers = {spec: load_solver(spec.partition("+")[0]).to(dtype) for spec in specs}
    with threads():
        solved = {size: solve(solvers, problems, dtype, size) for size in sizes}
    chosen = groups(problems)
    rows = []
    curves: dict[str, Any] = {}
    failures: list[dict[str, Any]] = []
    for size, spec in itertools.product(sizes, specs):
        one = solved[size][spec]
        right, far = judge(problems, one)
        told_chance = problems.counts & one.probability.isfinite()
        if told_chance.any():
            curve = reliability(one.probability[told_chance], ~far[told_chance])._asdict()
            curves[spec] = {name: values.nan_to_num(0.0).tolist() for name, values in curve.items()}
        for (kind, group), at in chosen.items():
            rates = {"success": rate(right[at]), "far": rate(far[at])}
            told = {"ok_of_right": rate(one.ok[at & right]), "ok_of_far": rate(one.ok[at & far])}
            row = {"solver": spec, "kind": kind, "group": group, "batch": size, "count": int(at.sum())}
            rows.append(
                {**row, **rates, **told, "ms_per_problem": float(one.milliseconds[at].mean()) if at.any() else None}
            )
        if pictures is not None and not failures:
            failures = [draw_failure(problems, one, at, pictures) for at in worst_failures(problems, far)]
    limits = {"inlier_px": INLIER_PX, "min_inliers": MIN_INLIERS, "right": RIGHT, "far": FAR}
    settings: dict[str, Any] = {
        "files": [path.name for path in paths],
        "split": split,
        "solvers": list(specs),
        "dtype": str(dtype),
        "batch": list(sizes),
    }
    settings |= {"shares": SHARES, "pairs": PAIRS, "told": TOLD_SIGMAS, **limits}
    made = {"environment": environment(), "settings": settings, "load_average": [before, load()]}
    found = {"counts": describe(problems), "rows": rows, "reliability": curves, "failures": failures}
    return {**made, **found}


@torch.no_grad()
def measure_cost(paths: Sequence[Path], specs: Sequence[str], dtype: torch.dtype) -> dict[str, Any]:
    """Time solvers on the matches without a ratio test, apart for every share of outliers and number of pairs.

    Args:
        paths: files of :func:`make`.
        specs: solvers as for :func:`measure`.
        dtype: dtype that the solvers get.

    Returns:
        ``environment``, ``settings``, ``load_average`` and ``rows``: the milliseconds of a problem in a batch of a
        group's problems, repeated in turns.
    """
    before, problems = load(), read(paths)
    solvers = {spec: load_solver(spec.partition("+")[0]).to(dtype) for spec in specs}
    by_share = [share_title(*limits) for limits in itertools.pairwise(SHARES)]
    by_pairs = [pairs_title(*limits) for limits in itertools.pairwise(PAIRS)]
    chosen, rows = groups(problems), []
    with threads():
        for group in (*by_share, *by_pairs):
            at = chosen[KINDS[1], group].nonzero()[:, 0]
            if len(at) < MIN_GROUP:
                continue
            given, ratio, _ = batch(problems, at[torch.arange(COST_BATCH) % len(at)], dtype)
            mask = problems.mask[at[torch.arange(COST_BATCH) % len(at)]][:, : ratio.shape[1]]
            for spec, solver in solvers.items():
                say(f"{group}: {spec}")
                start = time.process_time()
                call(solver, spec, given, mask, ratio)
                milliseconds = 1e3 * (time.process_time() - start) / COST_BATCH
                rows.append({"solver": spec, "group": group, "ms_per_problem": milliseconds})
    settings = {"files": [path.name for path in paths], "solvers": list(specs), "batch": COST_BATCH}
    settings |= {"shares": SHARES, "pairs": PAIRS}
    return {"environment": environment(), "settings": settings, "load_average": [before, load()], "rows": rows}


def judge(problems: Problems, solved: Solved) -> tuple[Tensor, Tensor]:
    """Which poses are right, and which are far off, bool (P,)."""
    angle, distance = pose_errors(problems, solved.rotation, solved.translation)
    return (angle < RIGHT[0]) & (distance < RIGHT[1]), (angle > FAR[0]) | (distance > FAR[1])


def worst_failures(problems: Problems, far: Tensor) -> list[int]:
    """Of each scene the far-off pose with the most inliers under the reference pose, the most first."""
    inliers = torch.where(problems.counts & far, problems.inliers.sum(1), -1)
    best: dict[str, int] = {}
    for at in inliers.argsort(descending=True, stable=True).tolist():
        if inliers[at] >= 0:
            best.setdefault(problems.scene[at], at)
    return sorted(best.values(), key=lambda at: -int(inliers[at]))[:PICTURES]


def draw_failure(problems: Problems, solved: Solved, at: int, folder: Path) -> dict[str, Any]:
    """Draw the pairs of a problem under the reference pose and under a wrong pose, and tell how many fit each.

    The picture has pixels and projections, no photograph.
    """
    mask = problems.mask[at]
    world, pixels = problems.world[at][mask], problems.pixels[at][mask]
    poses = {
        "reference pose": (problems.rotation[at], problems.translation[at]),
        "pose that was found": (solved.rotation[at], solved.translation[at]),
    }
    figure = make_figure(WIDTH, 3.1)
    panels, fits = figure.subplots(1, 2, sharex=True, sharey=True), []
    for axes, (title, (rotation, translation)) in zip(panels, poses.items(), strict=True):
        cam = world @ rotation.T + translation
        image = cam @ problems.intrinsics[at].T
        seen = image[:, :2] / torch.where(cam[:, 2:] > 0, cam[:, 2:], torch.nan)
        fit = (seen - pixels).norm(dim=1) < INLIER_PX
        fits.append(fit)
        axes.plot(*pixels[~fit].T, ".", color=GREY, markersize=2.5, label="pixels of other pairs")
        axes.plot(*pixels[fit].T, "o", color=BLUE, markersize=3.5, label=f"pixels within {INLIER_PX:g} px")
        axes.plot(*seen[fit].T, "+", color=ORANGE, markersize=6, label="their projections")
        axes.set(title=f"{title}: {int(fit.sum())} of {len(fit)}", aspect="equal")
    axes.invert_yaxis()
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    name = f"real_failure_{problems.scene[at]}.png"
    save(figure, folder / name)
    right, wrong = fits
    spread = [float(pixels[fit].std(0).norm()) if fit.sum() > 1 else 0.0 for fit in (torch.ones_like(right), wrong)]
    points = len(torch.unique(world[wrong], dim=0))
    numbers = {
        "pairs": len(right),
        "right": int(right.sum()),
        "found": int(wrong.sum()),
        "both": int((right & wrong).sum()),
    }
    told = {"ok": bool(solved.ok[at]), "points": points, "spread": spread[1] / spread[0]}
    return {"picture": name, "scene": problems.scene[at], "kind": KINDS[int(problems.kind[at])], **numbers, **told}


def describe(problems: Problems) -> list[dict[str, Any]]:
    """Numbers of problems by scene, kind and share of outliers, and the median reprojection error of the inliers."""
    found = []
    for scene in dict.fromkeys(problems.scene):
        mine = torch.tensor([name == scene for name in problems.scene])
        errors = problems.error_px[mine][problems.inliers[mine]]
        row: dict[str, Any] = {"scene": scene, "median_error_px": float(errors.median()) if len(errors) else None}
        for kind, title in enumerate(KINDS):
            at = mine & (problems.kind == kind)
            share = problems.outlier_share[at & problems.counts]
            bins = [int(((share >= low) & (share < high)).sum()) for low, high in itertools.pairwise(SHARES)]
            pairs = problems.mask[at & problems.counts].sum(1).double()
            middle = float(pairs.median()) if len(pairs) else None
            row[title] = {"problems": int(at.sum()), "counted": len(share), "shares": bins, "median_pairs": middle}
        found.append(row)
    return found


def format_counts(counts: Sequence[Mapping[str, Any]]) -> str:
    """The numbers of problems as a Markdown table."""
    header = ["Scene", "Kind", "error of inliers, px", "problems", "counted", "pairs, median"]
    header += [share_title(low, high) for low, high in itertools.pairwise(SHARES)]
    lines = []
    for row in counts:
        for kind in KINDS:
            one, error = row[kind], row["median_error_px"]
            cells = [
                str(one["problems"]),
                str(one["counted"]),
                "–" if not one["counted"] else f"{one['median_pairs']:.0f}",
            ]
            shown = "–" if error is None else f"{error:.2f}"
            lines.append([row["scene"], kind, shown, *cells, *map(str, one["shares"])])
    return markdown_table(header, lines, align="ll" + "r" * (len(header) - 2), pad=True)


def format_table(rows: Sequence[Mapping[str, Any]], kind: str, groups: Sequence[str]) -> str:
    """Success in percent by solver and group, with time and ``ok``, as a Markdown table."""
    table: dict[str, dict[str, Mapping[str, Any]]] = {}
    for row in rows:
        if row["kind"] == kind:
            table.setdefault(f"`{row['solver']}`, calls of {row['batch']}", {})[row["group"]] = row
    numbers = next(iter(table.values()))

    def percent(value: float | None) -> str:
        return "–" if value is None else f"{100 * value:.1f}"

    def milliseconds(value: float | None) -> str:
        return "–" if value is None else f"{value:.2f}"

    header = [kind, "ms", *(f"{group} ({numbers[group]['count']})" for group in groups), "ok of right", "ok of far off"]
    lines = []
    for spec, found in table.items():
        told = [percent(found["all"][name]) for name in ("ok_of_right", "ok_of_far")]
        rates = [percent(found[group]["success"]) for group in groups]
        lines.append([spec, milliseconds(found["all"]["ms_per_problem"]), *rates, *told])
    return markdown_table(header, lines, pad=True)


def format_results(results: Mapping[str, Any]) -> str:
    """The tables by share of outliers, then by scene."""
    shares = ["all", *(share_title(low, high) for low, high in itertools.pairwise(SHARES))]
    scenes = [row["scene"] for row in results["counts"]]
    return "\n\n".join(format_table(results["rows"], kind, part) for part in (shares, scenes) for kind in KINDS)


def make_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    making = commands.add_parser("make", help="make the problems of one scene")
    making.add_argument("folder", type=Path, help="a COLMAP model with its images in images/")
    making.add_argument("out", type=Path, help="the file of problems (.npz)")
    making.add_argument("--features", type=int, default=2000, help="keypoints of an image")
    making.add_argument("--every", type=int, default=4, help="with 4, every fourth image is a query")
    making.add_argument("--views", type=int, default=6, help="images of the map for each query")
    making.add_argument("--pairs", type=int, default=500, help="largest number of pairs of a problem")
    making.add_argument("--seed", type=int, default=0, help="seed of the subsets of pairs")
    measuring = commands.add_parser("measure", help="solve problems")
    measuring.add_argument("problems", type=Path, nargs="+", help="files of `make`")
    measuring.add_argument(
        "--solvers", nargs="+", required=True, help=f"names, with {CONFIDENCE} or {SIGMAS} at the end"
    )
    measuring.add_argument(
        "--split", default="", help="whether the scenes were seen while choosing, for the results file"
    )
    measuring.add_argument("--pictures", type=Path, help="folder for pictures of failures of the first solver")
    measuring.add_argument("--out", type=Path, help="the results file (.json)")
    measuring.add_argument(
        "--batch", type=int, nargs="+", default=[BATCH], help="problems in a call of a solver of ours"
    )
    measuring.add_argument("--double", action="store_true", help="give the solvers float64")
    timing = commands.add_parser("cost", help="time solvers on groups of problems")
    timing.add_argument("problems", type=Path, nargs="+", help="files of `make`")
    timing.add_argument("--solvers", nargs="+", required=True, help="names as for `measure`")
    timing.add_argument("--out", type=Path, required=True, help="the results file (.json)")
    counting = commands.add_parser("count", help="number of problems by share of outliers; solves nothing")
    counting.add_argument("problems", type=Path, nargs="+", help="files of `make`")
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Make, count or measure, and print the tables."""
    parser = make_parser()
    options = vars(parser.parse_args(arguments))
    command = options.pop("command")
    if command == "make":
        print(format_counts(describe(make(**options))))
    elif command == "count":
        print(format_counts(describe(read(options["problems"]))))
    elif command == "cost":
        save_results(measure_cost(options["problems"], options["solvers"], torch.float32), options["out"])
    else:
        dtype = torch.float64 if options["double"] else torch.float32
        try:
            told = options["split"], options["pictures"], options["batch"]
            results = measure(options["problems"], options["solvers"], dtype, *told)
        except BaseError as error:
            parser.error(str(error))
        if options["out"]:
            save_results(results, options["out"])
        print(format_results(results))


if __name__ == "__main__":
    main()
