"""Localise photos in a COLMAP model: ``python docs/examples/localiser.py --images FOLDER --model FOLDER``.

Every fifth image of the model is a query whose observations are ignored, the others are the map (if images of the model
have no points, these are the queries). Kornia finds features in all images; a feature of the map that lies on an
observation of the model gets its point. Each query is matched with the images of the map that look most like it. Scores
of matches become confidences, which are fitted on matches between images of the map. ``pnpnet-set`` solves the queries
in batches, from the likeliest pairs of each. COLMAP's estimator (pycolmap) gets the same pairs, those that pass the
ratio test, and all matches, one query after the other.

Without ``--images`` and ``--model`` a hall is rendered first (``rendered_hall.py``). ``--features disk`` takes Kornia's
DISK and LightGlue, whose weights Kornia downloads unless they are in the cache of ``torch.hub``. Writes
``localiser.json`` with all errors, and the picture ``localiser.png``. ``localise_photo.py`` is the same in short.
"""

import tempfile
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pycolmap
import rendered_hall
import torch
from kornia.feature import DISK, LightGlueMatcher, SIFTFeatureScaleSpace, laf_from_center_scale_ori, match_snn
from kornia.feature.laf import get_laf_center, laf_is_filled
from shared import command, pose_error, write
from sklearn.isotonic import IsotonicRegression
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from kornia_pnpnet import PnPResult, Pose, create_solver
from kornia_pnpnet.cameras import reproject
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.evaluation.plots import BLUE, make_figure, save, themed
from kornia_pnpnet.peers import PyColmap

LONGEST = 1600  # pixels; larger images are shrunk for the features
EVERY = 5  # every fifth image of a model is a query
REFERENCES = 5  # images of the map that a query is matched with
VOTERS = 256  # features of a query that choose them
SNAP_PX = 2.0  # largest distance of a feature to the observation whose point it gets
INLIER_PX = 8.0  # largest reprojection error of an inlier, for the confidences and the picture
MOST_PAIRS = 200  # the likeliest pairs of a query that are solved
RATIO_TEST = 0.8  # Lowe's value
OURS = "pnpnet-set, likeliest pairs"
# The usual limits of visual localisation (T. Sattler et al., "Benchmarking 6DOF Outdoor Visual Localization in Changing
# Conditions", CVPR 2018) and a finer one: distance of the camera in metres, rotation in degrees.
LIMITS = ((0.05, 0.5), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))


class Photo(NamedTuple):
    """An image, its features and its pose."""

    name: str
    shape: tuple[int, int]  # height and width of the image in which features were found
    intrinsics: Tensor  # (3, 3)
    pose: Pose  # (3, 3), (3,): of the model
    lafs: Tensor  # (1, M, 2, 3)
    descriptors: Tensor  # (M, D)
    pixels: Tensor  # (M, 2), undistorted
    points: Tensor  # (M, 3), NaN where a feature has no point


class Matches(NamedTuple):
    """Pairs of one query with the map."""

    world_points: Tensor  # (N, 3)
    img_points: Tensor  # (N, 2)
    scores: Tensor  # (N,)


class Sift:
    """Kornia's SIFT; the score of a match is the ratio of the distances to the nearest two features."""

    def __init__(self, count: int) -> None:
        self.network = SIFTFeatureScaleSpace(count, descriptor_backend="pyramid")

    def detect(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Local affine frames (1, M, 2, 3) and descriptors (M, D) of an image (1, 3, H, W)."""
        lafs, _, descriptors = self.network(image.mean(1, keepdim=True))
        filled = laf_is_filled(lafs)[0]
        return lafs[:, filled], descriptors[0, filled]

    def match(self, query: Photo, reference: Photo) -> tuple[Tensor, Tensor]:
        """Scores (K,) of matches, and the numbers (K, 2) of their features in both images."""
        ratios, pairs = match_snn(query.descriptors, reference.descriptors, th=1.0)
        return ratios[:, 0], pairs


class DiskLightGlue:
    """Kornia's DISK and LightGlue; Kornia downloads their weights unless they are in its cache."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.network = DISK.from_pretrained("depth")
        self.matcher = LightGlueMatcher("disk")

    def detect(self, image: Tensor) -> tuple[Tensor, Tensor]:
        found = self.network(image, self.count, pad_if_not_divisible=True)[0]
        return laf_from_center_scale_ori(found.keypoints[None]), found.descriptors

    def match(self, query: Photo, reference: Photo) -> tuple[Tensor, Tensor]:
        lafs = query.lafs, reference.lafs
        scores, pairs = self.matcher(query.descriptors, reference.descriptors, *lafs, query.shape, reference.shape)
        return scores[:, 0], pairs


Detector = Sift | DiskLightGlue
DETECTORS = {"sift": Sift, "disk": DiskLightGlue}


def read_image(path: Path) -> tuple[np.ndarray, float]:
    """An image (H, W, 3), shrunk to a longer side of at most ``LONGEST`` pixels, and the factor."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    if picture is None:
        raise SystemExit(f"no image {path}")
    scale = min(1.0, LONGEST / max(picture.shape))
    return cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), scale


def read_photo(image: pycolmap.Image, world: dict[int, np.ndarray], folder: Path, detector: Detector) -> Photo:
    """Find the features of an image of a model, whose points are ``world`` by number: none for a query."""
    picture, scale = read_image(folder / image.name)
    lafs, descriptors = detector.detect(torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255.0)
    # COLMAP's first pixel has its middle at (0.5, 0.5).
    pixels = (get_laf_center(lafs)[0].double() + 0.5) / scale
    points = torch.full((len(pixels), 3), torch.nan, dtype=torch.float64)
    seen = [x for x in image.points2D if x.has_point3D() and x.point3D_id in world]
    if seen:
        observed = torch.from_numpy(np.array([x.xy for x in seen]))
        distance, nearest = torch.cdist(pixels, observed).min(1)
        known = distance < SNAP_PX / scale
        points[known] = torch.from_numpy(np.array([world[x.point3D_id] for x in seen]))[nearest[known]]
    intrinsics = torch.from_numpy(image.camera.calibration_matrix())
    pixels = torch.from_numpy(image.camera.cam_from_img(pixels.numpy())) @ intrinsics[:2, :2].mT + intrinsics[:2, 2]
    matrix = torch.from_numpy(image.cam_from_world().matrix())
    pose = Pose(matrix[:, :3], matrix[:, 3])
    return Photo(image.name, picture.shape[:2], intrinsics, pose, lafs, descriptors, pixels, points)


def most_alike(query: Photo, references: Sequence[Photo]) -> list[Photo]:
    """The images of the map with most nearest neighbours of the query's strongest features."""
    owner = torch.repeat_interleave(torch.tensor([len(x.descriptors) for x in references]))
    nearest = torch.cdist(query.descriptors[:VOTERS], torch.cat([x.descriptors for x in references])).argmin(1)
    votes = owner[nearest].bincount(minlength=len(references))
    return [references[i] for i in votes.argsort(descending=True)[:REFERENCES]]


def match(query: Photo, references: Sequence[Photo], detector: Detector) -> Matches:
    """Match a query with images of the map; a feature may have several points."""
    found = []
    for reference in references:
        scores, pairs = detector.match(query, reference)
        points = reference.points[pairs[:, 1]]
        known = points.isfinite().all(1) & query.pixels[pairs[:, 0]].isfinite().all(1)
        found.append(Matches(points[known], query.pixels[pairs[known, 0]], scores[known].double()))
    return Matches(*(torch.cat(x) for x in zip(*found, strict=True)))


def errors_px(matches: Matches, photo: Photo) -> Tensor:
    """Reprojection errors (N,) of matches under the pose of the model, infinite behind the camera."""
    pixels = reproject(matches.world_points[None], photo.intrinsics, map_tensors(lambda x: x[None], photo.pose))[0]
    return (pixels - matches.img_points).norm(dim=1).nan_to_num(torch.inf)


def fit_scores(references: Sequence[Photo], detector: Detector) -> IsotonicRegression:
    """Fit confidences on every fourth image of the map, matched with the rest of the map."""
    scores, inliers = [], []
    for i in range(0, len(references), 4):
        others = [x for j, x in enumerate(references) if j != i]
        matches = match(references[i], most_alike(references[i], others), detector)
        scores.append(matches.scores)
        inliers.append(errors_px(matches, references[i]) < INLIER_PX)
    calibration = IsotonicRegression(y_min=0.01, y_max=0.99, increasing="auto", out_of_bounds="clip")
    return calibration.fit(torch.cat(scores).numpy(), torch.cat(inliers).numpy())


def choose(matches: Matches, calibration: IsotonicRegression) -> Matches:
    """The likeliest pairs of a query, with confidences as their scores."""
    if not len(matches.scores):
        return matches
    confidence = torch.from_numpy(calibration.predict(matches.scores.numpy()))
    top = confidence.topk(min(MOST_PAIRS, len(confidence))).indices
    return Matches(*(x[top] for x in matches[:2]), confidence[top])


@torch.no_grad()
def solve(solver: nn.Module, photos: Sequence[Photo], chosen: Sequence[Matches], batch: int) -> PnPResult:
    """Solve queries in batches, padded with pairs without confidence."""
    world, img, confidence = (pad_sequence(list(x), batch_first=True) for x in zip(*chosen, strict=True))
    inputs = world, img, torch.stack([photo.intrinsics for photo in photos]), confidence
    parts = zip(*(x.split(batch) for x in inputs), strict=True)
    return map_tensors(lambda *x: torch.cat(x), *(solver(*p, mask=c > 0, confidence=c) for *p, c in parts))


def solve_by_colmap(photos: Sequence[Photo], matches: Sequence[Matches]) -> tuple[Pose, Tensor]:
    """COLMAP's estimator with its default options, as hloc calls it. Poses, and which were found."""
    solver = PyColmap(threshold=12.0, loss_scale=1.0, confidence=0.99999)
    found = [
        solver.solve_one(pairs.world_points.numpy(), pairs.img_points.numpy(), photo.intrinsics.numpy())
        for photo, pairs in zip(photos, matches, strict=True)
    ]
    poses = [(x.rotation, x.translation) if x else (np.eye(3), np.zeros(3)) for x in found]
    pose = Pose(*(torch.tensor(np.array(x)) for x in zip(*poses, strict=True)))
    return pose, torch.tensor([x is not None for x in found])


def errors(pose: Pose, found: Tensor, photos: Sequence[Photo], metre: float) -> list[dict[str, float] | None]:
    """Distance of the cameras in metres and angle of the rotations in degrees; None without a pose."""
    distance, angle = pose_error(pose, map_tensors(lambda *x: torch.stack(x), *(photo.pose for photo in photos)))
    rows = zip((distance * metre).tolist(), angle.tolist(), found.tolist(), strict=True)
    return [{"metres": metres, "degrees": degrees} if there else None for metres, degrees, there in rows]


def summary(errors: Sequence[dict[str, Any] | None], ms: float) -> dict[str, Any]:
    """Recall at each limit, median errors of the poses found, and milliseconds of the processor for each query."""
    found = [x for x in errors if x]
    recall = [sum(x["metres"] < near and x["degrees"] < turn for x in found) / len(errors) for near, turn in LIMITS]
    medians = {key: float(np.median([x[key] for x in found])) if found else None for key in ("metres", "degrees")}
    return {"recall": recall, "median": medians, "ms": ms}


def run(
    images: Path, model: pycolmap.Reconstruction, detector: Detector, *, batch: int, metre: float
) -> tuple[dict[str, Any], list[tuple[Matches, Tensor, dict[str, Any]]]]:
    """Localise the queries of a model; the results, and of each query its pairs, which of them count, and its row."""
    marks = [("start", time.process_time())]

    def lap(stage: str) -> None:
        marks.append((stage, time.process_time()))

    posed = sorted((x for x in model.images.values() if x.has_pose), key=lambda x: x.name)
    pointed = [x for x in posed if x.num_points3D]
    # A model may have images with poses and without points, as the hall that is rendered: these are the queries.
    queried = [x for x in posed if not x.num_points3D] or pointed[EVERY // 2 :: EVERY]
    names = {x.name for x in queried}
    world = {number: point.xyz for number, point in model.points3D.items()}
    references = [read_photo(x, world, images, detector) for x in pointed if x.name not in names]
    if not (queried and references):
        raise SystemExit("too few images of the model have a pose and points")
    calibration = fit_scores(references, detector)
    solver = create_solver("pnpnet-set")
    lap("map")
    photos = [read_photo(x, {}, images, detector) for x in queried]
    lap("features")
    alike = [most_alike(x, references) for x in photos]
    lap("retrieval")
    matched = [match(x, others, detector) for x, others in zip(photos, alike, strict=True)]
    lap("matching")
    kept = [choose(x, calibration) for x in matched]
    lap("confidence")
    solve(solver, photos[:1], kept[:1], batch)  # the first calls of a process take longer
    solve_by_colmap(photos[:1], kept[:1])
    lap("preparation")
    result = solve(solver, photos, kept, batch)
    lap(OURS)
    found = {OURS: errors(result.pose, result.ok, photos, metre)}
    theirs = {"pycolmap, the same pairs": kept}
    if isinstance(detector, Sift):
        theirs["pycolmap, ratio test"] = [Matches(*(x[m.scores < RATIO_TEST] for x in m)) for m in matched]
    theirs["pycolmap, all matches"] = matched
    for name, pairs in theirs.items():
        lap("errors")
        poses = solve_by_colmap(photos, pairs)
        lap(name)
        found[name] = errors(*poses, photos, metre)

    rows, drawn = [], []
    for i, photo in enumerate(photos):
        outlier, of_all = (errors_px(x[i], photo) > INLIER_PX for x in (kept, matched))
        row: dict[str, Any] = {"image": photo.name, "matches": len(of_all), "pairs": len(outlier)}
        shares = {"outliers": outlier, "outliers_of_all": of_all}  # 0 without pairs
        row |= {name: x.double().mean().nan_to_num().item() for name, x in shares.items()}
        rows.append(row | {name: of_queries[i] for name, of_queries in found.items()})
        drawn.append((kept[i], result.inliers[i, : len(outlier)], rows[-1]))
    ms = {stage: 1000.0 * (end - begin) / len(photos) for (_, begin), (stage, end) in pairwise(marks)}
    stages = {stage: ms[stage] for stage in ("features", "retrieval", "matching", "confidence")}
    solvers = {name: summary(x, ms[name]) for name, x in found.items()}
    settings = {"references": len(references), "matched_with": REFERENCES, "pairs": MOST_PAIRS, "batch": batch}
    return {"settings": settings, "limits": LIMITS, "images": rows, "stages_ms": stages, "solvers": solvers}, drawn


@themed
def draw(drawn: Sequence[tuple[Matches, Tensor, dict[str, Any]]], images: Path, path: Path) -> None:
    """Draw the kept and the rejected pairs on queries with few, some and many outliers."""
    ranked = sorted(drawn, key=lambda x: x[2]["outliers"])
    figure = make_figure(7.2, 2.3)
    places = (len(ranked) // 2, 9 * len(ranked) // 10, -1)
    for axes, (matches, inlier, row) in zip(figure.subplots(1, 3), [ranked[i] for i in places], strict=True):
        picture, scale = read_image(images / row["image"])
        axes.imshow(picture, extent=(0, picture.shape[1] / scale, picture.shape[0] / scale, 0))
        axes.scatter(*matches.img_points[~inlier].mT, s=5, color="red", marker="x", linewidths=0.5)
        axes.scatter(*matches.img_points[inlier].mT, s=4, color=BLUE)
        axes.set_axis_off()
        error = row[OURS]
        off = f"{100 * error['metres']:.1f} cm off" if error else "no pose"
        axes.set_title(f"{100 * row['outliers']:.0f} % outliers: {off}", fontsize=8)
    save(figure, path)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command(__doc__)
    parser.add_argument("--images", type=Path, help="folder of the images")
    parser.add_argument("--model", type=Path, help="folder of the COLMAP model, text or binary")
    parser.add_argument("--metre", type=float, default=1.0, help="metres in a unit of the model")
    parser.add_argument("--features", choices=DETECTORS, default="sift")
    parser.add_argument("--count", type=int, default=1500, help="features of an image")
    parser.add_argument("--batch", type=int, default=64, help="queries that are solved in one call")
    parser.add_argument("--rendered", type=int, nargs=2, default=(20, 60), help="images of the map and queries")
    options = parser.parse_args(arguments)
    if (options.images is None) != (options.model is None):
        parser.error("--images and --model belong together")
    torch.set_num_threads(1)  # times are those of one thread
    with tempfile.TemporaryDirectory() as temporary:
        images, folder = options.images, options.model
        if images is None:
            scene = rendered_hall.make_scene(Path(temporary) / "hall", *options.rendered)
            images, folder = scene / "images", scene / "sparse"
        detector = DETECTORS[options.features](options.count)
        model = pycolmap.Reconstruction(str(folder))
        found, drawn = run(images, model, detector, batch=options.batch, metre=options.metre)
        options.out.mkdir(parents=True, exist_ok=True)
        draw(drawn, images, options.out / "localiser.png")
    write(options.out / "localiser.json", features=options.features, count=options.count, **found)
    for name, x in found["solvers"].items():
        recall = ", ".join(f"{100 * share:.0f} %" for share in x["recall"])
        print(f"{name}: recall {recall}, {x['ms']:.1f} ms for a query")


if __name__ == "__main__":
    main()
