"""A hall with textured walls and boxes, rendered with known poses: the images of ``localiser.py`` and ``tracking.py``.

Wallpaper and floor repeat a few tiles and three boxes look alike, so that many matches between images are wrong.
The world is in metres, its z axis points up. A pose is world-to-camera, pixels are COLMAP's (the centre of the first
pixel is (0.5, 0.5)).
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from kornia_pnpnet import Pose, depth_points

Floats = NDArray[np.float64]
WIDTH, HEIGHT, FOCAL = 640, 480, 500.0
INTRINSICS = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
DOWN = np.array([0.0, 0.0, -1.0])  # gravity
SIZE = np.array([12.0, 9.0, 4.0])  # of the hall, in metres
TEXELS = 100  # of a texture on a metre
SUPERSAMPLING = 2  # rays across a pixel
MAX_DEPTH = 8.0  # metres, of the depth images
FEATURES = 1500  # of an image of the map


class View(NamedTuple):
    """What one camera sees."""

    rotation: Floats  # (3, 3)
    translation: Floats  # (3,)
    image: NDArray[np.uint8]  # (HEIGHT, WIDTH)
    depth: NDArray[np.float32]  # (HEIGHT, WIDTH), metres along the optical axis, infinite where nothing is


class Plane(NamedTuple):
    """A textured rectangle."""

    corner: Floats  # (3,)
    along: Floats  # (3,) unit vector of the texture's columns
    up: Floats  # (3,) unit vector of the texture's rows
    texture: NDArray[np.uint8]


def make_texture(rng: np.random.Generator, width: float, height: float, tiles: Sequence[Any] = ()) -> NDArray[np.uint8]:
    """A rectangle with sides in metres: shapes of all sizes, or tiles in a random order and a few shapes."""
    rows, columns = round(height * TEXELS), round(width * TEXELS)
    drawn = np.full((rows, columns), int(rng.integers(90, 170)), np.uint8)
    density, largest = (6.0, 25) if tiles else (90.0, 40)  # shapes on a square metre, texels
    if tiles:
        step = len(tiles[0])
        order = rng.integers(len(tiles), size=(-(-rows // step), -(-columns // step)))
        drawn = np.block([[tiles[k] for k in row] for row in order])[:rows, :columns].copy()
    for _ in range(round(density * rows * columns / TEXELS**2)):
        x, y = int(rng.integers(columns)), int(rng.integers(rows))
        across, high = (int(s) for s in rng.integers(3, largest, 2))
        shade = int(rng.integers(256))
        if rng.random() < 0.5:
            cv2.ellipse(drawn, (x, y), (across, high), float(rng.uniform(0, 180)), 0, 360, shade, -1)
        else:
            cv2.rectangle(drawn, (x, y), (x + across, y + high), shade, -1)
    return cv2.GaussianBlur(drawn, (0, 0), 0.8)


def make_hall(seed: int = 0) -> list[Plane]:
    """A tiled floor, four papered walls, and eight boxes."""
    rng = np.random.default_rng(seed)
    x, y, z = np.eye(3)
    floor, paper = ([make_texture(rng, size, size) for _ in range(4)] for size in (0.5, 1.0))
    planes = [Plane(np.zeros(3), x, y, make_texture(rng, SIZE[0], SIZE[1], floor))]
    for corner, along in ((0 * x, x), (SIZE[0] * x, y), (SIZE * [1, 1, 0], -x), (SIZE[1] * y, -y)):
        planes.append(Plane(corner, along, z, make_texture(rng, float(abs(along @ SIZE)), SIZE[2], paper)))
    twin = [make_texture(rng, 0.8, 0.8) for _ in range(5)]
    for i in range(8):
        place = np.array([2.0 + 2.6 * (i % 4), 2.5 + 4.0 * (i // 4), 0.0])
        place[:2] += rng.uniform(-0.5, 0.5, 2)
        size = rng.uniform(0.6, 1.2, 3) if i % 3 else np.full(3, 0.8)  # boxes 0, 3 and 6 look alike
        turn = rng.uniform(0.0, math.pi)
        a, b = np.array([math.cos(turn), math.sin(turn), 0.0]), np.array([-math.sin(turn), math.cos(turn), 0.0])
        sides = [(place, a, z, 0, 2), (place + a * size[0], b, z, 1, 2), (place, b, z, 1, 2)]
        sides += [(place + b * size[1], a, z, 0, 2), (place + z * size[2], a, b, 0, 1)]
        for j, (corner, along, up, wide, high) in enumerate(sides):
            texture = make_texture(rng, size[wide], size[high]) if i % 3 else twin[j]
            planes.append(Plane(corner, along, up, texture))
    return planes


def look_at(centre: Floats, target: Floats, down: Floats) -> Floats:
    """Rotations (..., 3, 3) of level cameras that look from centres (..., 3) to a target."""
    forward = (target - centre) / np.linalg.norm(target - centre, axis=-1, keepdims=True)
    right = np.cross(down, forward)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack((right, np.cross(forward, right), forward), -2)


def photograph(hall: list[Plane], centre: Floats, target: Floats) -> View:
    """Render what a level camera sees from a place to a target by casting rays: image and smallest depths."""
    rotation = look_at(centre, target, DOWN)
    translation = -rotation @ centre
    size = np.array([WIDTH, HEIGHT]) * SUPERSAMPLING
    columns, rows = np.meshgrid(*((np.arange(n) + 0.5) / SUPERSAMPLING for n in size))
    rays = np.stack((columns, rows, np.ones_like(rows)), -1) @ np.linalg.inv(INTRINSICS).T @ rotation  # depth 1
    rays = rays.astype(np.float32)
    nearest = np.full(rays.shape[:2], np.inf, np.float32)
    image = np.zeros(rays.shape[:2], np.uint8)
    for corner, along, up, texture in hall:
        normal = np.cross(along, up)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.float32((corner - centre) @ normal) / (rays @ normal.astype(np.float32))
            a, b = (
                depth * (rays @ axis.astype(np.float32)) + np.float32((centre - corner) @ axis) for axis in (along, up)
            )
        high, wide = texture.shape
        seen = (depth > 0.05) & (depth < nearest) & (a >= 0) & (b >= 0) & (a * TEXELS < wide) & (b * TEXELS < high)
        place = [x[seen][:, None] * np.float32(TEXELS) - np.float32(0.5) for x in (a, b)]
        if len(place[0]):
            blocks = [np.array_split(x, math.ceil(len(x) / 32_000)) for x in place]  # OpenCV's limit of rows
            colours = [
                cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                for u, v in zip(*blocks, strict=True)
            ]
            image[seen], nearest[seen] = np.concatenate(colours)[:, 0], depth[seen]
    small = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    corners = nearest.reshape(HEIGHT, SUPERSAMPLING, WIDTH, SUPERSAMPLING)
    return View(rotation, translation, small, corners.min((1, 3)))


def expose(view: View, rng: np.random.Generator, *, blur: float, noise: float, gain: float) -> View:
    """The view as a camera takes it: blurred (pixels), brighter or darker, with noise (grey levels)."""
    image = cv2.GaussianBlur(view.image, (0, 0), blur).astype(np.float64)
    image = 128.0 + gain * (image - 128.0) + rng.normal(0.0, noise, image.shape)
    return view._replace(image=image.clip(0, 255).astype(np.uint8))


def reference_views(hall: list[Plane], count: int, seed: int = 1) -> list[View]:
    """Sharp images from a round through the hall, each to the far side."""
    rng = np.random.default_rng(seed)
    views = []
    for i in range(count):
        turn = 2.0 * math.pi * i / count
        round_trip = np.array([math.cos(turn), math.sin(turn), 0.0])
        centre = SIZE * [0.5, 0.5, 0.0] + round_trip * [4.2, 3.0, 0.0] + [0.0, 0.0, rng.uniform(1.5, 2.0)]
        across = turn + math.pi + math.radians(50.0) * (-1.0) ** i
        target = centre + 4.0 * np.array([math.cos(across), math.sin(across), rng.uniform(-0.25, 0.0)])
        views.append(expose(photograph(hall, centre, target), rng, blur=0.6, noise=2.0, gain=1.0))
    return views


def query_views(hall: list[Plane], count: int, seed: int = 2) -> Iterator[View]:
    """Images from anywhere in the hall to anywhere, some of them blurred, dark or noisy."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        centre = rng.uniform([1.0, 1.0, 1.4], [*(SIZE[:2] - 1.0), 2.2])
        turn = rng.uniform(0.0, 2.0 * math.pi)
        target = centre + 4.0 * np.array([math.cos(turn), math.sin(turn), rng.uniform(-0.35, 0.1)])
        view = photograph(hall, centre, target)
        yield expose(view, rng, blur=rng.uniform(0.5, 2.5), noise=rng.uniform(2.0, 16.0), gain=rng.uniform(0.2, 1.0))


def make_scene(folder: Path, references: int = 20, queries: int = 60, seed: int = 0) -> Path:
    """Write a folder of images and a COLMAP text model of them, as COLMAP leaves it: `images` and `sparse`.

    The model's points are SIFT features of the reference images (`reference00.png` and so on) with their depths;
    the queries (`query00.png` and so on) only have poses.
    """
    import pycolmap

    hall, sift = make_hall(seed), cv2.SIFT_create(nfeatures=FEATURES, enable_precise_upscale=True)
    views = {f"reference{i:02}.png": view for i, view in enumerate(reference_views(hall, references))}
    views |= {f"query{i:02}.png": view for i, view in enumerate(query_views(hall, queries))}
    for name in ("images", "sparse"):
        (folder / name).mkdir(parents=True)
    model, pinhole = pycolmap.Reconstruction(), [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
    camera = pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=pinhole, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    for i, (name, view) in enumerate(views.items(), start=1):
        cv2.imwrite(str(folder / "images" / name), view.image)
        found = sift.detect(view.image) if i <= references else []
        keypoints = np.array([x.pt for x in found], dtype=np.float64).reshape(-1, 2) + 0.5
        image = pycolmap.Image(name=name, keypoints=keypoints, camera_id=1, image_id=i)
        pose = np.column_stack((view.rotation, view.translation))
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        points = seen_points(view, keypoints)
        for k in np.flatnonzero(np.isfinite(points[:, 0])):
            track = pycolmap.Track()
            track.add_element(i, k)
            model.add_point3D(points[k], track)
    model.write_text(folder / "sparse")
    return folder


def seen_points(view: View, pixels: Floats) -> Floats:
    """The points (K, 3) of the hall in pixels (K, 2) of a view, NaN where there is nothing."""
    columns, rows = pixels.astype(int).T
    tensors = map(torch.from_numpy, (pixels, view.depth[rows, columns], INTRINSICS, view.rotation, view.translation))
    img_points, depth, intrinsics, *pose = tensors
    return depth_points(img_points, depth, intrinsics, Pose(*pose), depth_sigma=0.0)[0].numpy()


def depth_sigma(depth: Any) -> Any:
    """Standard deviation of a depth camera's noise in metres, at depths in metres.

    C. Nguyen, S. Izadi and D. Lovell, "Modeling Kinect Sensor Noise for Improved 3D Reconstruction and Tracking", 2012.
    """
    return 0.0012 + 0.0019 * (depth - 0.4) ** 2


def write_sequence(folder: Path, frames: int = 100, seed: int = 3) -> Path:
    """Write an RGB-D sequence of a camera carried around a corner of the hall, in the format of the TUM benchmark.

    The camera walks at 0.8 m/s, 30 frames per second, and shakes. Depths have 16 bits, 5000 per metre.
    """
    import pycolmap

    hall, rng = make_hall(0), np.random.default_rng(seed)
    lines: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for i in range(frames):
        time, turn = i / 30.0, 0.8 * i / 30.0 / 3.2  # on a circle of 3.2 m
        centre = np.array([6.0 + 3.2 * math.cos(turn), 4.5 + 3.2 * math.sin(turn), 1.6])
        centre += 0.03 * np.sin(time * np.array([5.0, 7.0, 11.0]))
        ahead = turn + math.pi + 0.4 * math.sin(0.9 * time)
        target = centre + 4.0 * np.array([math.cos(ahead), math.sin(ahead), -0.1 + 0.03 * math.sin(9.0 * time)])
        view = expose(photograph(hall, centre, target), rng, blur=1.0, noise=5.0, gain=0.8)
        near = np.where(view.depth < MAX_DEPTH, view.depth, 0.0)
        noise = depth_sigma(near) * rng.normal(size=near.shape)
        depth = np.where(near > 0, (near + noise) * 5000.0, 0.0).round().astype(np.uint16)
        for kind, image in (("rgb", view.image), ("depth", depth)):
            cv2.imwrite(str(folder / kind / f"{i:04}.png"), image)
            lines[kind].append(f"{time:.4f} {kind}/{i:04}.png")
        turn = pycolmap.Rigid3d(np.column_stack((view.rotation.T, centre))).rotation.quat
        lines["groundtruth"].append(" ".join(map(str, (f"{time:.4f}", *centre, *turn))))
    for kind, rows in lines.items():
        (folder / f"{kind}.txt").write_text("\n".join(rows) + "\n")
    return folder
