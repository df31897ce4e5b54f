"""Where was a photo taken: ``python docs/examples/localisation.py --scene FOLDER``.

Takes a COLMAP model with the images beside it (`images/`), undistorted. Each image in turn is the one to be localised:
its SIFT features are matched with those of all others that see a point of the model, nearest neighbour by nearest
neighbour, with no ratio test, so that many matches are wrong. From these raw matches `pnpnet-set` and
`cv2.solvePnPRansac` find the pose; what each of them took for wrong is drawn. Without `--scene` a small scene is made
first: a room's corner with repeated patterns, seen from twelve places. Writes `localisation.json` and
`localisation.png` to `--out`.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from kornia_pnpnet import Pose, create_solver
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.data import View, load_scene
from kornia_pnpnet.evaluation.figures.style import BLUE, ORANGE, make_figure, save
from kornia_pnpnet.evaluation.results import save_results
from kornia_pnpnet.geometry import rotation_angle

SIZE, FOCAL = (480, 360), 420.0
THRESHOLD_PX, SNAP_PX = 8.0, 2.0
SOLVERS = ("pnpnet-set", "cv2.solvePnPRansac")


def wall(rng: np.random.Generator) -> np.ndarray:
    """A pattern of 800 x 800 pixels: shapes of all sizes, and a window that is there sixteen times."""
    drawn = np.full((800, 800), 128, np.uint8)
    for _ in range(700):
        (x, y), size = rng.integers(0, 800, 2).tolist(), int(rng.integers(4, 40))
        shade = int(rng.integers(0, 256))
        if rng.random() < 0.5:
            cv2.circle(drawn, (x, y), size // 2, shade, -1)
        else:
            cv2.rectangle(drawn, (x, y), (x + size, y + int(rng.integers(4, 40))), shade, -1)
    window = cv2.resize(rng.integers(0, 256, (6, 6), dtype=np.uint8), (70, 70), interpolation=cv2.INTER_NEAREST)
    for x in range(60, 800, 200):
        for y in range(60, 800, 200):
            drawn[y : y + 70, x : x + 70] = window
    return cv2.GaussianBlur(drawn, (0, 0), 1.0)


def make_scene(folder: Path, views: int = 12) -> Path:
    """Images of a room's corner and a COLMAP text model of them, its points seen in two images or more."""
    rng = np.random.default_rng(5)
    walls = [wall(rng) for _ in range(3)]
    sift = cv2.SIFT_create(nfeatures=700)
    (folder / "images").mkdir(parents=True)
    K = np.array([[FOCAL, 0.0, SIZE[0] / 2], [0.0, FOCAL, SIZE[1] / 2], [0.0, 0.0, 1.0]])
    poses, found = [], []
    for i in range(views):
        turn = math.radians(20.0 + 50.0 * i / (views - 1))
        centre = np.array([math.cos(turn), math.sin(turn), 0.55]) * 5.5 + rng.normal(0.0, 0.25, 3)
        forward = np.array([1.2, 1.2, 1.2]) + rng.normal(0.0, 0.15, 3) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack((right, np.cross(forward, right), forward))
        image = photograph(walls, rotation, centre, K) + rng.normal(0.0, 3.0, SIZE[::-1])
        image = image.clip(0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / "images" / f"{i:02}.png"), image)
        points, features = sift.detectAndCompute(image, None)
        pixels = np.array([x.pt for x in points]) + 0.5  # COLMAP's first pixel has its middle at (0.5, 0.5)
        poses.append((rotation, centre))
        found.append((pixels, features, hits(pixels, rotation, centre, K)[0]))

    # A point for each pair of features of two images that lie at the same place; its place is the mean of theirs.
    worlds, tracks = [], []
    taken: list[dict[int, int]] = [{} for _ in range(views)]
    for i, j in ((k, m) for k in range(views) for m in range(k + 1, min(k + 4, views))):
        gaps = np.linalg.norm(found[i][2][:, None] - found[j][2][None], axis=-1)
        for a in np.flatnonzero(gaps.min(1) < 0.012):
            b = int(gaps[a].argmin())
            number = taken[i].get(int(a), taken[j].get(b))
            if number is None:
                number = len(worlds)
                worlds.append(0.5 * (found[i][2][a] + found[j][2][b]))
                tracks.append({})
            for view, feature in ((i, int(a)), (j, b)):
                if view not in tracks[number] and feature not in taken[view]:
                    tracks[number][view] = feature
                    taken[view][feature] = number
    write_model(folder / "sparse", K, poses, [x for x, _, _ in found], worlds, tracks, taken)
    return folder


def hits(pixels: np.ndarray, rotation: np.ndarray, centre: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points of the three walls x = 0, y = 0, z = 0 that pixels (P, 2) show, and which walls."""
    rays = np.column_stack((pixels, np.ones(len(pixels)))) @ np.linalg.inv(K).T @ rotation
    with np.errstate(divide="ignore"):
        reach = -centre / rays
    reach[reach <= 0] = np.inf
    side = reach.argmin(1)  # the nearest: from inside a corner nothing is hidden
    return centre + rays * reach[np.arange(len(rays)), side, None], side


def photograph(walls: list[np.ndarray], rotation: np.ndarray, centre: np.ndarray, K: np.ndarray) -> np.ndarray:
    """What a camera sees of the walls, each four metres wide."""
    columns, rows = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    points, side = hits(np.column_stack((columns.ravel(), rows.ravel())), rotation, centre, K)
    image = np.zeros(len(points))
    for i, drawn in enumerate(walls):
        across = points[:, [j for j in range(3) if j != i]] * 200.0 - 0.5
        seen = cv2.remap(drawn, *across.astype(np.float32).reshape(*SIZE[::-1], 2).transpose(2, 0, 1), cv2.INTER_LINEAR)
        image = np.where(side == i, seen.ravel(), image)
    return image.reshape(SIZE[::-1])


def write_model(
    folder: Path,
    K: np.ndarray,
    poses: list[tuple[np.ndarray, np.ndarray]],
    pixels: list[np.ndarray],
    worlds: list[np.ndarray],
    tracks: list[dict[int, int]],
    taken: list[dict[int, int]],
) -> None:
    """A COLMAP model as text."""
    from kornia.geometry.conversions import rotation_matrix_to_quaternion

    folder.mkdir(parents=True)
    camera = f"1 PINHOLE {SIZE[0]} {SIZE[1]} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n"
    (folder / "cameras.txt").write_text(camera)
    lines = []
    for i, (rotation, centre) in enumerate(poses):
        quaternion = rotation_matrix_to_quaternion(torch.from_numpy(rotation)).tolist()
        numbers = " ".join(map(repr, [*quaternion, *(-rotation @ centre).tolist()]))
        seen = " ".join(f"{x} {y} {taken[i].get(j, -2) + 1}" for j, (x, y) in enumerate(pixels[i]))
        lines += [f"{i + 1} {numbers} 1 {i:02}.png", seen]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [
        f"{i + 1} {world[0]} {world[1]} {world[2]} 128 128 128 0.5 "
        + " ".join(f"{view + 1} {feature}" for view, feature in track.items())
        for i, (world, track) in enumerate(zip(worlds, tracks, strict=True))
    ]
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")


def described(view: View, folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pixels and SIFT features of an image, and of those at points of the model the points."""
    image = cv2.imread(str(folder / view.name), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise SystemExit(f"no image {folder / view.name}")
    points, features = cv2.SIFT_create(nfeatures=4000).detectAndCompute(image, None)
    pixels = np.array([x.pt for x in points]) + 0.5
    gaps = np.linalg.norm(pixels[:, None] - view.img_points.numpy()[None], axis=-1)
    known = gaps.min(1) < SNAP_PX
    return pixels, features, np.flatnonzero(known), view.world_points.numpy()[gaps.argmin(1)[known]]


def raw_matches(found: Mapping[str, Any], name: str) -> tuple[Tensor, Tensor]:
    """Points of the model (N, 3) and pixels of an image (N, 2) whose features are nearest to each other."""
    pixels, features, _, _ = found[name]
    others = [x for other, x in found.items() if other != name]
    database = np.concatenate([x[1][x[2]] for x in others])
    world = np.concatenate([x[3] for x in others])
    matches = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(features, database)
    points = torch.from_numpy(world[[x.trainIdx for x in matches]])
    return points, torch.from_numpy(pixels[[x.queryIdx for x in matches]])


def main() -> None:
    """Localise every image of a scene, write what came out and draw some."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, help="a COLMAP model, its images in the folder images")
    parser.add_argument("--arbitrary-unit", action="store_true", help="the scene is not in metres")
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.scene or make_scene(Path(temporary) / "scene")
        scene = load_scene(folder, metric=not options.arbitrary_unit)
        found = {view.name: described(view, folder / "images") for view in scene.views}
        images = {x.name: cv2.imread(str(folder / "images" / x.name), cv2.IMREAD_GRAYSCALE) for x in scene.views}
    solver = create_solver("pnpnet-set")
    unit = 1.0 if scene.metric else scene.median_depth
    rows: list[dict[str, Any]] = []
    drawn = []
    for view in scene.views:
        points, img = raw_matches(found, view.name)
        with torch.no_grad():
            result = solver(points[None], img[None], view.intrinsics)
        ok, turn, shift, kept = cv2.solvePnPRansac(
            points.numpy(), img.numpy(), view.intrinsics.numpy(), None, reprojectionError=THRESHOLD_PX
        )
        theirs = Pose(torch.from_numpy(cv2.Rodrigues(turn)[0]), torch.from_numpy(shift[:, 0])) if ok else None
        row: dict[str, Any] = {"image": view.name, "matches": len(points)}
        for name, pose in zip(SOLVERS, (Pose(result.rotation[0], result.translation[0]), theirs), strict=True):
            if pose is None:
                row[name] = None
                continue
            angle = torch.rad2deg(rotation_angle(pose.rotation, view.rotation)).item()
            centre = -pose.rotation.mT @ pose.translation + view.rotation.mT @ view.translation
            row[name] = {"rotation_deg": angle, "centre": centre.norm().item() / unit}
        cam = points @ view.rotation.mT + view.translation
        off = ((cam @ view.intrinsics.mT)[:, :2] / cam[:, 2:] - img).norm(dim=-1)
        row["wrong"] = (off > THRESHOLD_PX).double().mean().item()
        rows.append(row)
        inliers = np.zeros(len(points), bool)
        if kept is not None:
            inliers[kept[:, 0]] = True
        drawn.append((row, img, (result.weights[0].numpy() > 0.5, inliers)))
    limit, name_of_unit = (0.05, "m") if scene.metric else (0.01, "depths")
    summary = {
        name: {
            "within_1_deg_and_limit": sum(
                row[name] is not None and row[name]["rotation_deg"] < 1.0 and row[name]["centre"] < limit
                for row in rows
            ),
            "median_centre": float(np.median([row[name]["centre"] if row[name] else math.inf for row in rows])),
        }
        for name in SOLVERS
    }
    results = {"environment": environment(), "images": rows, "limit": limit, "unit": name_of_unit, "solvers": summary}
    options.out.mkdir(parents=True, exist_ok=True)
    save_results(results, options.out / "localisation.json")
    figure = make_figure(9.0, 4.6)
    chosen = drawn[:: max(1, len(drawn) // 3)][:3]
    for column, (row, img, both) in zip(figure.subplots(2, 3).T, chosen, strict=False):
        for axes, kept, colour, who in zip(column, both, (BLUE, ORANGE), SOLVERS, strict=True):
            axes.imshow(images[row["image"]], cmap="gray")
            axes.scatter(*img[torch.from_numpy(kept)].mT, s=6, color=colour)
            axes.scatter(*img[torch.from_numpy(~kept)].mT, s=8, color="red", marker="x", linewidths=0.6)
            axes.set_axis_off()
            off = f"{row[who]['centre']:.4f} {name_of_unit} off" if row[who] else "no pose"
            axes.set_title(f"{who}: {row['image']}, {off}", loc="left", fontsize=8)
    save(figure, options.out / "localisation.png")
    for name, found_by in summary.items():
        count, median = found_by.values()
        within = f"{count} of {len(rows)} images within 1° and {limit} {name_of_unit}"
        print(f"{name}: {within}, camera centres {median:.4f} {name_of_unit} off (median)")


if __name__ == "__main__":
    main()
