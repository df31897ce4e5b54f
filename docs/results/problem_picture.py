"""The picture of the home page: a house, the pairs that ``pnpnet-set`` rejects, and the pose that it finds.

``house.jpg`` shows the house from the pose below. ``docs/results/house.py`` of commit ccb8600 rendered it.
"""

import itertools
import math
from pathlib import Path

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from matplotlib.image import imread
from torch import Tensor

from kornia_pnpnet import Pose, create_solver, pose_errors
from kornia_pnpnet.cameras import reproject
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.plots import BLUE, GREY, VERMILION, WIDTH, make_figure, save, themed

_PAIRS, _OUTLIERS, _SEED = 48, 20, 3
_KEPT = 0.5  # weights above this count as inliers, as on the page about OpenCV
_HALF_VIEW = 0.31  # tangent of half the field of view that is drawn
_PHOTO = Path(__file__).with_name("house.jpg")
_CAMERA = 4.0  # metres; length of a drawn camera

# A house, 8 m by 6 m and 7 m high, with a gable roof: x to the right, y down, z away; corners in metres.
_CORNERS = torch.tensor(
    [[x, y, z] for y in (0.0, -4.0) for x, z in ((-4.0, -3.0), (4.0, -3.0), (4.0, 3.0), (-4.0, 3.0))]
    + [[-4.0, -7.0, 0.0], [4.0, -7.0, 0.0]],
    dtype=torch.float64,
)
_BOX = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
_EDGES = torch.tensor([*_BOX, (4, 8), (7, 8), (5, 9), (6, 9), (8, 9)])
_IN_SIGHT = _CORNERS[torch.tensor([(0, 1), (1, 2), (0, 4), (1, 5), (2, 6), (4, 5), (4, 8), (5, 9), (6, 9), (8, 9)])]
# Windows and the door, of the side and of the front: their centre, bottom and top. All have one width.
_OPENINGS = (
    [(along, low, low + 1.1) for along in (-1.5, 1.5) for low in (0.9, 2.7)],
    [(along, low, low + 1.1) for along in (-2.5, 0.0, 2.5) for low in (0.9, 2.7) if (along, low) != (0.0, 0.9)]
    + [(0.0, 0.0, 2.1)],
)
_HALF_WIDTH = 0.45
_PLACE = torch.tensor([0.0, 3.2, 21.0], dtype=torch.float64)  # metres; the house in the camera's frame
_TURNS = ((0.2, 0.0, 0.0), (0.0, 0.65, 0.0))  # radians; the camera looks down, and at a corner


def _in_camera(points: Tensor) -> Tensor:
    """Points of the house (..., 3) in the camera's frame."""
    down, around = axis_angle_to_rotation_matrix(torch.tensor(_TURNS, dtype=points.dtype))
    return points @ (down @ around).mT + _PLACE


def _house_points(batch_size: int, n: int, generator: torch.Generator) -> Tensor:
    """Points on the edges in sight of house, windows and door, see :class:`kornia_pnpnet.data.PointPrior`."""
    ends = []
    for front, openings in enumerate(_OPENINGS):
        for centre, bottom, top in openings:
            left, right = centre - _HALF_WIDTH, centre + _HALF_WIDTH
            outline = (left, bottom), (right, bottom), (right, top), (left, top), (left, bottom)
            corners = [(x, -up, -3.0) if front else (4.0, -up, x) for x, up in outline]
            ends += list(itertools.pairwise(corners))
    edges = torch.cat((_IN_SIGHT, torch.tensor(ends, dtype=torch.float64)))  # (E, 2, 3)
    edges = edges[torch.randint(len(edges), (batch_size, n), generator=generator)]  # (B, n, 2, 3)
    along = torch.rand((batch_size, n, 1), generator=generator, dtype=torch.float64)
    return _in_camera(torch.lerp(edges[..., 0, :], edges[..., 1, :], along))


def _frustum(pose: Pose) -> Tensor:
    """A camera in the world as one line, shape (11, 3)."""
    side = _HALF_VIEW * _CAMERA
    a, b, c, d = ((x, y, _CAMERA) for x, y in ((-side, -side), (side, -side), (side, side), (-side, side)))
    centre = (0.0, 0.0, 0.0)
    line = torch.tensor([centre, a, b, centre, c, d, centre, a, d, c, b], dtype=pose.translation.dtype)
    return (line - pose.translation[0]) @ pose.rotation[0]


@themed
def plot_problem(path: str | Path) -> Path:
    """Draw the pairs in the image, kept and rejected, and the points in space with the camera that was found."""
    outliers = OutlierMix(count=_OUTLIERS, mismatch_share=1.0)
    source = SyntheticProblems(n=_PAIRS, batch_size=1, seed=_SEED, points=_house_points, outliers=outliers)
    problem = source.batch(0)
    with torch.no_grad():
        result = create_solver("pnpnet-set")(problem.world_points, problem.img_points, problem.intrinsics)
    errors, kept = pose_errors(result.pose, problem.pose), result.weights[0] > _KEPT
    world, truth = problem.world_points[0], problem.pose
    house = (_in_camera(_CORNERS).to(world) - truth.translation[0]) @ truth.rotation[0]

    def seen(points: Tensor) -> Tensor:
        return reproject(points[None], problem.intrinsics, result.pose)[0]

    def upright(points: Tensor) -> Tensor:
        in_camera = points @ truth.rotation[0].mT + truth.translation[0]
        return in_camera[..., [0, 2, 1]] * in_camera.new_tensor([1.0, 1.0, -1.0])

    figure = make_figure(WIDTH, 3.3)
    image, space = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2, projection="3d")
    pixels, projected, edge = problem.img_points[0], seen(world), _HALF_VIEW * problem.intrinsics[0, 0, 0].item()
    image.imshow(imread(_PHOTO), extent=(-edge, edge, edge, -edge), interpolation="bilinear")
    for start, end in zip(pixels[~kept], projected[~kept], strict=True):
        image.plot(*torch.stack((start, end)).T, color=VERMILION, linewidth=0.8, alpha=0.7)
    image.plot(*pixels[kept].T, "o", color=BLUE, markersize=5.5, markeredgecolor="white")
    image.plot(*pixels[~kept].T, "x", color=VERMILION, markersize=7.5, markeredgewidth=2.2)
    image.set(xlim=(-edge, edge), ylim=(edge, -edge), aspect="equal", xticks=(), yticks=())
    for spine in image.spines.values():
        spine.set(visible=True, color=GREY)
    image.set_title(f"{len(kept)} pairs: {kept.sum()} kept, {(~kept).sum()} rejected", fontsize=11)

    for ends in upright(house)[_EDGES]:
        space.plot(*ends.T, color=GREY, linewidth=1.0)
    space.plot(*upright(world[kept]).T, "o", color=BLUE, markersize=4.5)
    space.plot(*upright(world[~kept]).T, "x", color=VERMILION, markersize=5.5, markeredgewidth=1.8)
    space.plot(*upright(_frustum(truth)).T, color=GREY, linewidth=5.0)
    space.plot(*upright(_frustum(result.pose)).T, color="black", linewidth=1.5)
    drawn = upright(torch.cat((house, _frustum(truth))))
    low, high = drawn.amin(0), drawn.amax(0)
    space.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    space.set_box_aspect((high - low).tolist(), zoom=1.45)
    space.set_axis_off()
    space.view_init(elev=20.0, azim=-60.0)
    angle, shift = errors.rotation_error_deg.item(), 100.0 * errors.translation_error.item()
    space.set_title(f"pose: {angle:.2f}° and {math.ceil(shift)} cm from the truth", fontsize=11)
    return save(figure, path)
