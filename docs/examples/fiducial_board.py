"""A ChArUco board, detected by OpenCV, with corners mislabelled: ``python docs/examples/fiducial_board.py``.

A camera circles over a drawn board. OpenCV finds the corners and their numbers; a share of the corners then gets the
number of another corner, as happens when markers are misread. `pnpnet-set` and `cv2.solvePnPRansac` solve for the pose
from the same corners. Writes `fiducial_board.json` and `fiducial_board.png` to `--out`.
"""

import math
from typing import Any

import cv2
import numpy as np
import torch
from rendered_hall import look_at
from shared import centre, command, opencv, pose_error, write
from torch.nn.utils.rnn import pad_sequence

from kornia_pnpnet import Pose, create_solver
from kornia_pnpnet.evaluation.plots import BLUE, ORANGE, make_figure, save

SQUARES, SQUARE, MARKER = (7, 5), 0.04, 0.03  # metres
PIXELS_PER_SQUARE, SIZE, FOCAL = 60, (640, 480), 700.0
CAMERA = np.array([[FOCAL, 0.0, SIZE[0] / 2 - 0.5], [0.0, FOCAL, SIZE[1] / 2 - 0.5], [0.0, 0.0, 1.0]])
SHARES = (0.0, 0.2, 0.4)
THRESHOLD_PX = 3.0


def path(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (F, 3, 3) and centres (F, 3) of a camera that circles over the board and looks at its middle."""
    middle = np.array([SQUARES[0] * SQUARE / 2, SQUARES[1] * SQUARE / 2, 0.0])
    turn = np.linspace(0.0, 2.0 * math.pi, count, endpoint=False)
    radius, height = 0.22 + 0.06 * np.sin(3.0 * turn), 0.34 + 0.08 * np.cos(2.0 * turn)
    # z of the board points away from the camera: OpenCV's boards have y down.
    place = middle + np.stack((radius * np.cos(turn), radius * np.sin(turn), -height), -1)
    return look_at(place, middle, np.array([0.0, 1.0, 0.0])), place


def photograph(board: Any, rotation: np.ndarray, place: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What the camera sees of the board."""
    width, height = (PIXELS_PER_SQUARE * x for x in SQUARES)
    drawn = board.generateImage((width, height), marginSize=0)
    drawn = cv2.copyMakeBorder(drawn, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)
    # Pixel u of the drawing has its middle at (u + 0.5 - 40) / PIXELS_PER_SQUARE squares.
    to_board = np.array([[1, 0, -39.5], [0, 1, -39.5], [0, 0, PIXELS_PER_SQUARE / SQUARE]]) * SQUARE / PIXELS_PER_SQUARE
    to_camera = CAMERA @ np.column_stack((rotation[:, 0], rotation[:, 1], -rotation @ place))
    seen = cv2.warpPerspective(drawn, to_camera @ to_board, SIZE, flags=cv2.INTER_AREA, borderValue=150)
    seen = cv2.GaussianBlur(seen, (0, 0), 0.8).astype(float) + rng.normal(0.0, 4.0, SIZE[::-1])
    return seen.clip(0, 255).astype(np.uint8)


def mislabelled(numbers: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """The numbers of the corners with a share of them exchanged among each other."""
    wrong = rng.permutation(len(numbers))[: round(share * len(numbers))]
    labels = numbers.copy()
    labels[wrong] = numbers[np.roll(wrong, 1)]
    return labels


def main() -> None:
    options = command(__doc__, frames=60).parse_args()
    rng = np.random.default_rng(0)
    board = cv2.aruco.CharucoBoard(SQUARES, SQUARE, MARKER, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    corners = np.asarray(board.getChessboardCorners(), dtype=np.float64)
    detector = cv2.aruco.CharucoDetector(board)
    rotations, centres = path(options.frames)
    frames = [photograph(board, *view, rng) for view in zip(rotations, centres, strict=True)]
    seen = []
    for i, frame in enumerate(frames):
        pixels, numbers, _, _ = detector.detectBoard(frame)
        if numbers is not None and len(numbers) >= 6:
            seen.append((i, pixels.reshape(-1, 2).astype(np.float64), numbers.reshape(-1)))
    shown = [i for i, _, _ in seen]
    rotation = torch.from_numpy(rotations[shown])
    truth = Pose(rotation, -(rotation @ torch.from_numpy(centres[shown])[..., None])[..., 0])
    solvers = {"pnpnet-set": create_solver("pnpnet-set"), "cv2.solvePnPRansac": opencv(THRESHOLD_PX)}
    runs: dict[str, dict[str, Any]] = {name: {} for name in solvers}
    paths = {}
    img = pad_sequence([torch.from_numpy(pixels) for _, pixels, _ in seen], batch_first=True)
    mask = torch.arange(img.shape[1]) < torch.tensor([len(pixels) for _, pixels, _ in seen])[:, None]
    for share in SHARES:
        labels = [mislabelled(numbers, share, rng) for _, _, numbers in seen]
        world = pad_sequence([torch.from_numpy(corners[x]) for x in labels], batch_first=True)
        for name, solver in solvers.items():
            with torch.no_grad():
                result = solver(world, img, torch.from_numpy(CAMERA), mask=mask)
            away, angle = pose_error(result.pose, truth)
            median_mm, median_deg = (x[result.ok].median().item() for x in (1000.0 * away, angle))
            within = (result.ok & (away < 0.01)).double().mean().item()
            runs[name][f"{share:.0%}"] = {"median_mm": median_mm, "median_deg": median_deg, "within_10_mm": within}
            paths[name] = centre(result.pose)
    write(options.out / "fiducial_board.json", frames=len(seen), runs=runs)
    figure = make_figure(8.6, 3.4)
    left, right = figure.subplots(1, 2)
    left.imshow(frames[seen[0][0]], cmap="gray")
    left.scatter(*seen[0][1].T, s=9, color=BLUE)
    left.set_axis_off()
    left.set_title("corners of a frame", loc="left")
    right.plot(*centres[:, :2].T, color="black", linewidth=0.8, label="true path")
    for (name, found), colour, mark in zip(paths.items(), (BLUE, ORANGE), ("o", "x"), strict=True):
        right.plot(*found[:, :2].mT, mark, color=colour, markersize=4, fillstyle="none", linestyle="none", label=name)
    x, y = centres[:, :2].mean(0)
    span = 1.3 * np.abs(centres[:, :2] - (x, y)).max()
    right.set(xlim=(x - span, x + span), ylim=(y - span, y + span), xlabel="x (m)", ylabel="y (m)", aspect="equal")
    right.set_title(f"path of the camera, {100 * SHARES[-1]:.0f} % mislabelled", loc="left")
    right.legend(frameon=False, fontsize=7)
    right.grid(color="#dddddd")
    save(figure, options.out / "fiducial_board.png")
    for name, found in runs.items():
        for share, row in found.items():
            within, off = row["within_10_mm"], row["median_mm"]
            print(f"{name}, {share} mislabelled: {within:.0%} within 10 mm, median {off:.2f} mm")


if __name__ == "__main__":
    main()
