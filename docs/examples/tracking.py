"""Track a camera with what it knows already: ``python docs/examples/tracking.py --sequence FOLDER``.

FOLDER is an RGB-D sequence of the TUM benchmark (``rgb.txt``, ``depth.txt``, ``groundtruth.txt``). Every fifteenth
frame is a keyframe: its features have points from its depth and its true pose. Each frame is matched with the last
keyframe, and some of the matches go to the solver: alone, with the last pose as ``prior``, and with gravity, too.
Gravity is that of the true pose with noise, as of an accelerometer; the z axis of the world points up.

Without ``--sequence`` a walk through a hall is rendered first (``rendered_hall.py``). Writes ``tracking.json`` and
``tracking.png``.
"""

import itertools
import math
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import rendered_hall
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from kornia.geometry.liegroup import So3
from localiser import RATIO_TEST, Matches, Photo, Sift, match
from shared import centre, command, pose_error, write
from torch import Tensor, nn

from kornia_pnpnet import PnPNet, Pose, PosePrior, RobustWeightedLM, create_solver, depth_points, gravity_prior
from kornia_pnpnet.evaluation.plots import BLUE, GREEN, ORANGE, VERMILION, make_figure, save, themed

KEYFRAME = 15  # frames from one keyframe to the next
PAIRS = (3, 4, 6, 10, 30, 100)  # matches of a frame that the solver gets
DRAWN = 6  # pairs of the paths in the picture
FREIBURG1 = (517.3, 516.5, 319.1, 255.8)  # pixels; the principal point from the corner of the first pixel
DEPTH_UNIT = 5000.0  # of the depth images, per metre
MOST_LAG = 0.02  # seconds between an image and its depth or its pose
# How far a hand-held camera moves in one frame at 30 frames per second, standard deviations: radians, metres.
MOTION = (math.radians(1.0), 0.04)
GRAVITY = math.radians(0.5)  # standard deviation of the accelerometer's direction
PIXEL = 0.5  # standard deviation of a keypoint, pixels
RIGHT = (0.05, 1.0)  # a frame is right within 5 cm and 1 degree
VARIANTS = ("no prior", "last pose", "last pose and gravity", "refinement alone, both priors")


class Frame(NamedTuple):
    """One frame of a sequence, and its matches with the last keyframe."""

    pose: Pose  # (3, 3), (3,): the true one
    down: Tensor  # (3,) direction of gravity in the camera, measured
    matches: Matches  # in a random order
    covariances: Tensor  # (N, 3, 3) of their world points, because the depth is noisy


def read_table(path: Path) -> dict[float, list[str]]:
    """The rows of a file of the benchmark by time."""
    rows = [line.split() for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    return {float(row[0]): row[1:] for row in rows}


def read_sequence(folder: Path) -> list[tuple[Path, Path, Pose]]:
    """The images, depths and poses of a sequence; an image without depth or pose is left out."""
    images, depths, poses = (read_table(folder / f"{kind}.txt") for kind in ("rgb", "depth", "groundtruth"))
    frames = []
    for moment, (name,) in images.items():
        near = [min(table, key=lambda x: abs(x - moment)) for table in (depths, poses)]
        if max(abs(x - moment) for x in near) > MOST_LAG:
            continue
        *at, x, y, z, w = map(float, poses[near[1]])
        turn = Pose.from_quaternion(torch.tensor([[w, x, y, z]], dtype=torch.float64), torch.zeros(1, 3)).rotation[0]
        place = torch.tensor(at, dtype=torch.float64)
        frames.append((folder / name, folder / depths[near[0]][0], Pose(turn.mT, -turn.mT @ place)))
    return frames


def read_frame(image: Path, depth: Path, pose: Pose, intrinsics: Tensor, detector: Sift) -> Photo:
    """A frame with its features and their points in the world, NaN without depth."""
    picture = cv2.imread(str(image), cv2.IMREAD_COLOR_RGB)
    metres = cv2.imread(str(depth), cv2.IMREAD_UNCHANGED).astype(np.float64) / DEPTH_UNIT
    lafs, descriptors = detector.detect(torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255.0)
    pixels = lafs[0, :, :, 2].double()
    columns, rows = pixels.round().long().T
    far = torch.from_numpy(metres)[rows.clamp(0, len(metres) - 1), columns.clamp(0, metres.shape[1] - 1)]
    points, _ = depth_points(pixels + 0.5, far, intrinsics, pose, depth_sigma=0.0)
    return Photo(image.name, metres.shape, intrinsics, pose, lafs, descriptors, pixels + 0.5, points)


def read_frames(folder: Path, intrinsics: Tensor, seed: int = 0) -> tuple[list[Frame], dict[str, float]]:
    """All frames but the keyframes, and the mean time of each stage in milliseconds."""
    generator = torch.Generator().manual_seed(seed)
    detector, frames, keyframe = Sift(1000), [], None
    down = torch.from_numpy(rendered_hall.DOWN)
    seconds = {"features": 0.0, "matching": 0.0}
    for i, (image, depth, pose) in enumerate(read_sequence(folder)):
        start = time.process_time()
        photo = read_frame(image, depth, pose, intrinsics, detector)
        middle = time.process_time()
        if i % KEYFRAME == 0:
            keyframe = photo
            continue
        matches = match(photo, [keyframe], detector)
        seconds["features"] += middle - start
        seconds["matching"] += time.process_time() - middle
        likely = torch.nonzero(matches.scores < RATIO_TEST)[:, 0]
        order = likely[torch.randperm(len(likely), generator=generator)]
        tilt = GRAVITY * torch.randn(1, 3, generator=generator, dtype=torch.float64)
        felt = axis_angle_to_rotation_matrix(tilt)[0] @ pose.rotation @ down
        matches = Matches(*(x[order] for x in matches))
        frames.append(Frame(pose, felt, matches, depth_covariances(matches.world_points, keyframe.pose)))
    return frames, {stage: 1000.0 * x / len(frames) for stage, x in seconds.items()}


def depth_covariances(points: Tensor, camera: Pose) -> Tensor:
    """Covariances (N, 3, 3) of points (N, 3) that a depth camera saw: its noise is along the rays."""
    cam_points = points @ camera.rotation.mT + camera.translation
    depth = cam_points[:, 2:]
    error = rendered_hall.depth_sigma(depth) / depth * cam_points @ camera.rotation
    return error[:, :, None] * error[:, None]


def motion_prior(last: Pose, frames: int, _: Frame) -> PosePrior:
    """The last pose as a prior. Its uncertainty grows with the number of frames since then."""
    rotation, translation = last
    eye = torch.eye(3, dtype=rotation.dtype)
    # A turn w about the camera and a shift d of its centre change the translation by w x t - R d.
    jacobian = torch.cat((torch.cat((eye, 0.0 * eye), 1), torch.cat((-So3.hat(translation[None])[0], -rotation), 1)))
    variance = torch.tensor([*[MOTION[0] ** 2] * 3, *[MOTION[1] ** 2] * 3], dtype=rotation.dtype) * frames**2
    covariance = jacobian @ variance.diag() @ jacobian.mT
    return PosePrior(Pose(rotation[None], translation[None]), covariance.inverse()[None])


def with_gravity(prior: PosePrior, down: Tensor) -> PosePrior:
    """A prior whose tilt is that of gravity in the camera (3,)."""
    world_down = torch.from_numpy(rendered_hall.DOWN)
    expected = prior.pose.rotation[0] @ world_down
    axis = torch.linalg.cross(expected, down)
    turn = axis_angle_to_rotation_matrix((axis / axis.norm() * torch.atan2(axis.norm(), expected @ down))[None])
    pose = Pose(turn @ prior.pose.rotation, (turn @ prior.pose.translation[..., None])[..., 0])
    return PosePrior(pose, prior.information + gravity_prior(world_down[None], down[None], GRAVITY).information)


def track(
    frames: Sequence[Frame], intrinsics: Tensor, solver: nn.Module, prior: Callable[..., PosePrior | None], pairs: int
) -> dict[str, Any]:
    """Track all frames with the first matches of each frame, from a known place.

    A pose counts when it is ``ok``; with a prior also when the camera can have moved there. Otherwise the frame keeps
    the last pose. ``prior`` makes a prior from the last pose, the number of frames since then, and the frame.
    """
    last, since, path, errors, seconds = frames[0].pose, 1, [], [], []
    for frame in frames:
        world, img, noise = (x[:pairs][None] for x in (*frame.matches[:2], frame.covariances))
        start = time.process_time()
        known = prior(last, since, frame)
        with torch.no_grad():
            result = solver(world, img, intrinsics, img_sigma=PIXEL, world_cov=noise, prior=known)
        seconds.append(time.process_time() - start)
        pose = Pose(result.rotation[0], result.translation[0])
        metres, degrees = pose_error(pose, last)
        possible = degrees < 3.0 * since * math.degrees(MOTION[0]) and metres < 3.0 * since * MOTION[1]
        if result.ok[0] or (known is not None and possible):
            last, since = pose, 1
        else:
            since += 1
        path.append(last)
        errors.append(torch.stack(pose_error(last, frame.pose)))
    metres, degrees = torch.stack(errors).numpy().T
    return {
        "right": float(((metres < RIGHT[0]) & (degrees < RIGHT[1])).mean()),
        "rmse_m": float(np.sqrt((metres**2).mean())),
        "ms": 1000.0 * float(np.median(seconds)),
        "path": places(path),
    }


def places(poses: Iterable[Pose]) -> list[list[float]]:
    """Where cameras are, to a tenth of a millimetre."""
    return [[round(x, 4) for x in centre(pose).tolist()] for pose in poses]


def run(folder: Path, intrinsics: Tensor) -> dict[str, Any]:
    """Track a sequence with each number of pairs, with and without priors."""
    frames, stages = read_frames(folder, intrinsics)
    solver = create_solver("pnpnet-set")
    refiner = PnPNet(None, RobustWeightedLM(m=4))  # the last pose is near: few iterations suffice

    def by_both(last: Pose, since: int, frame: Frame) -> PosePrior:
        return with_gravity(motion_prior(last, since, frame), frame.down)

    ways = ((solver, lambda *_: None), (solver, motion_prior), (solver, by_both), (refiner, by_both))
    for way in ways:
        track(frames[:2], intrinsics, *way, PAIRS[-1])  # the first call of a process takes longer
    runs: dict[str, dict[str, Any]] = {str(pairs): {} for pairs in PAIRS}
    for pairs, (name, way) in itertools.product(PAIRS, zip(VARIANTS, ways, strict=True)):
        runs[str(pairs)][name] = found = track(frames, intrinsics, *way, pairs)
        if pairs != DRAWN:
            del found["path"]
    true = places(frame.pose for frame in frames)
    return {"frames": len(frames), "right": RIGHT, "stages_ms": stages, "path": true, "runs": runs}


@themed
def draw(results: dict[str, Any], path: Path) -> None:
    """The paths with few pairs, seen from above, and the share of right frames against the number of pairs."""
    figure = make_figure(7.2, 2.8)
    above, curves = figure.subplots(1, 2)
    colours, few = dict(zip(VARIANTS, (ORANGE, GREEN, BLUE, VERMILION), strict=True)), str(DRAWN)
    for name in VARIANTS[:1] + VARIANTS[2:3]:
        above.plot(*np.array(results["runs"][few][name]["path"]).T[:2], color=colours[name], linewidth=1.0)
    above.plot(*np.array(results["path"]).T[:2], color="black", linewidth=0.8, linestyle=":")
    above.set_title(f"{few} pairs per frame, from above", fontsize=8)
    above.set(xlabel="x (m)", ylabel="y (m)")
    for name, colour in colours.items():
        shares = [100.0 * results["runs"][str(pairs)][name]["right"] for pairs in PAIRS]
        curves.plot(PAIRS, shares, marker="o", markersize=3.5, color=colour, label=name)
    curves.set_xscale("log")
    curves.set_xticks(PAIRS, map(str, PAIRS))
    curves.set_xlabel("pairs per frame")
    curves.set_title(f"frames within {100 * RIGHT[0]:.0f} cm and {RIGHT[1]:.0f}° (%)", fontsize=8)
    curves.legend(fontsize=7)
    save(figure, path)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command(__doc__)
    parser.add_argument("--sequence", type=Path, help="folder of an RGB-D sequence of the TUM benchmark")
    parser.add_argument("--intrinsics", type=float, nargs=4, help="fx fy cx cy in pixels (default: of freiburg1)")
    parser.add_argument("--frames", type=int, default=100, help="of the sequence that is rendered")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)  # times are those of one thread
    with tempfile.TemporaryDirectory() as temporary:
        folder, (fx, fy, cx, cy) = options.sequence, options.intrinsics or FREIBURG1
        intrinsics = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)
        if folder is None:
            folder = rendered_hall.write_sequence(Path(temporary) / "walk", options.frames)
            intrinsics = torch.from_numpy(rendered_hall.INTRINSICS)
        results = run(folder, intrinsics)
    write(options.out / "tracking.json", **results)
    draw(results, options.out / "tracking.png")
    for pairs, row in results["runs"].items():
        for name, x in row.items():
            share, error = 100 * x["right"], 100 * x["rmse_m"]
            print(f"{pairs} pairs, {name}: {share:.0f} % right, {error:.1f} cm, {x['ms']:.1f} ms")


if __name__ == "__main__":
    main()
