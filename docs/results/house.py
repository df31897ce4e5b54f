"""A photograph of the house of ``problem_picture.py``, by ray tracing: bricks, windows, tiles, grass, sky and a sun."""

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
# The house is where normal · point <= offset for all planes: four walls, two sides of the roof, the ground. y is down.
_NORMALS = np.array([[1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1], [0, -1, 1], [0, -1, -1], [0, 1, 0]], float)
_OFFSETS = np.array([4.0, 4.0, 3.0, 3.0, 7.0, 7.0, 0.0])  # metres
#: Windows and the door, of the sides and of the front: their centre, bottom and top. All have one width.
OPENINGS = (
    [(along, low, low + 1.1) for along in (-1.5, 1.5) for low in (0.9, 2.7)],
    [(along, low, low + 1.1) for along in (-2.5, 0.0, 2.5) for low in (0.9, 2.7) if (along, low) != (0.0, 0.9)]
    + [(0.0, 0.0, 2.1)],
)
HALF_WIDTH = 0.45
_SUN = np.array([-0.45, -0.72, -0.53])  # direction to the sun
_UP = np.array([0.0, -1.0, 0.0])
_AMBIENT = 0.42
_OVERSAMPLED = 3  # rays across a pixel
_TEXELS = 1024  # side of the texture of noise
_RNG = np.random.default_rng(2)
_OCTAVES = [
    weight * cv2.resize(_RNG.random((k, k)), (_TEXELS, _TEXELS), interpolation=cv2.INTER_CUBIC)
    for weight, k in ((0.4, 8), (0.3, 32), (0.2, 128), (0.1, 512))
]
_NOISE = np.sum(_OCTAVES, 0)
_COLOURS = {
    "brick": (0.58, 0.29, 0.20),
    "mortar": (0.66, 0.62, 0.56),
    "tile": (0.34, 0.30, 0.31),
    "frame": (0.90, 0.89, 0.85),
    "glass": (0.16, 0.21, 0.27),
    "door": (0.20, 0.33, 0.28),
    "zenith": (0.28, 0.49, 0.80),
    "horizon": (0.78, 0.87, 0.95),
    "cloud": (0.97, 0.97, 0.97),
    "grass": (0.27, 0.40, 0.15),
    "path": (0.62, 0.58, 0.51),
    "trees": (0.13, 0.22, 0.11),
}
_RGB = {name: np.array(colour) for name, colour in _COLOURS.items()}


def _noise(x: Floats, y: Floats, size: float) -> Floats:
    """Noise in [0, 1] that repeats after ``size``."""
    at = [np.floor(value / size * _TEXELS).astype(int) % _TEXELS for value in (y, x)]
    noise: Floats = _NOISE[at[0], at[1]]
    return noise


def _blend(colour: Floats, name: str, where: NDArray[np.bool_] | Floats) -> Floats:
    share = np.asarray(where, float)[:, None]
    return (1.0 - share) * colour + share * _RGB[name]


def _hits(origins: Floats, rays: Floats) -> tuple[Floats, Floats, NDArray[np.int_]]:
    """Where rays (R, 3) enter and leave the house, in lengths of the ray, and through which plane they enter."""
    slope = rays @ _NORMALS.T
    crossing = (_OFFSETS - origins @ _NORMALS.T) / np.where(slope == 0.0, 1e-12, slope)
    entering = np.where(slope < 0.0, crossing, -np.inf)
    return entering.max(1), np.where(slope < 0.0, np.inf, crossing).min(1), entering.argmax(1)


def _rows_of_blocks(along: Floats, up: Floats, width: float, height: float) -> tuple[Floats, Floats, Floats]:
    """Blocks in rows that are moved by half a block: a random number of each, and the position inside, in metres."""
    row = np.floor(up / height)
    moved = along / width + 0.5 * (row % 2)
    number = _NOISE[(row * 37).astype(int) % _TEXELS, (np.floor(moved) * 61).astype(int) % _TEXELS]
    return number, (moved % 1.0) * width, up - row * height


def _wall(along: Floats, up: Floats, *, front: bool) -> Floats:
    number, x, y = _rows_of_blocks(along, up, 0.5, 0.17)
    colour = _RGB["brick"] * (0.55 + 0.9 * number)[:, None]
    colour = _blend(colour, "mortar", (x < 0.03) | (y < 0.03))
    colour = colour * (0.8 + 0.4 * _noise(along, up, 9.0))[:, None]
    for centre, bottom, top in OPENINGS[front]:
        off = np.maximum(np.abs(along - centre) - HALF_WIDTH, np.maximum(bottom - up, up - top))  # negative: inside
        colour = _blend(colour, "frame", off < 0.09)
        if bottom == 0.0:
            colour = _blend(colour, "door", off < 0.0)
            continue
        bars = (np.abs(along - centre) < 0.03) | (np.abs(up - (bottom + top) / 2.0) < 0.03)
        pane = (off < 0.0) & ~bars
        shine = np.clip((up - bottom) / (top - bottom) + 0.4 * _noise(along, up, 5.0) - 0.5, 0.0, 1.0)  # of the sky
        colour = _blend(colour, "glass", pane) + (0.5 * pane * shine)[:, None]
    return colour * np.clip(0.75 + 0.5 * up, 0.0, 1.0)[:, None]


def _surface(points: Floats, plane: NDArray[np.int_]) -> Floats:
    """Colours of points of the house, before light and shadow."""
    x, y, z = points.T
    number, inside, up = _rows_of_blocks(x, np.abs(z) * 2**0.5, 0.35, 0.3)
    roof = _RGB["tile"] * (0.6 + 0.8 * number)[:, None] * np.clip(0.5 + 3.0 * up, 0.0, 1.0)[:, None]
    roof *= np.where(inside < 0.025, 0.6, 1.0)[:, None]
    side, front = _wall(z, -y, front=False), _wall(x, -y, front=True)
    return np.where((plane < 2)[:, None], side, np.where((plane < 4)[:, None], front, roof))


def _sky(rays: Floats) -> Floats:
    x, y, z = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).T
    height = np.clip(-y, 0.0, 1.0)
    share = np.clip(height * 3.5, 0.0, 1.0)[:, None]
    colour = (1.0 - share) * _RGB["horizon"] + share * _RGB["zenith"]
    clouds = _noise(np.arctan2(x, z) + 0.9, 3.0 * height, 1.9)
    colour = _blend(colour, "cloud", 0.85 * np.clip(5.0 * (clouds - 0.52), 0.0, 1.0))
    crowns = 0.035 + 0.05 * _noise(np.arctan2(x, z), 0.0 * x, 2.0) + 0.012 * _noise(np.arctan2(x, z), 0.0 * x, 0.11)
    trees = _RGB["trees"] * (0.5 + 1.1 * _noise(np.arctan2(x, z), height, 0.13))[:, None]
    return np.where((height < crowns)[:, None], 0.75 * trees + 0.25 * _RGB["horizon"], colour)


def photograph(rotation: Floats, translation: Floats, half_view: float, side: int) -> Floats:
    """Render the house as a camera sees it, whose pose maps points of the house into the camera.

    Returns:
        RGB in [0, 1], shape (side, side, 3), for the tangents from ``-half_view`` to ``half_view``.
    """
    steps = (np.arange(side * _OVERSAMPLED) + 0.5) / (side * _OVERSAMPLED) * 2.0 * half_view - half_view
    across, down = (values.ravel() for values in np.meshgrid(steps, steps))
    rays = np.stack((across, down, np.ones_like(across)), 1) @ rotation
    origin = np.broadcast_to(-translation @ rotation, rays.shape)
    enter, leave, plane = _hits(origin, rays)
    seen = (enter < leave) & (enter > 0.0)
    to_ground = -origin[:, 1] / np.where(rays[:, 1] == 0.0, 1e-12, rays[:, 1])
    ground = ~seen & (to_ground > 0.0)
    points = origin + np.where(seen, enter, np.where(ground, to_ground, 0.0))[:, None] * rays
    x, z = points[:, 0], points[:, 2]

    blades = 0.55 * _noise(x, z, 23.0) + 0.45 * _noise(x, z, 3.1)
    lawn = _RGB["grass"] * (0.35 + 1.3 * blades)[:, None]
    lawn = _blend(lawn, "path", (np.abs(x + 0.15 * np.sin(z)) < 0.7 + 0.15 * blades) & (z < -3.0))
    colour = np.where(seen[:, None], _surface(points, plane), lawn)
    sun = _SUN / np.linalg.norm(_SUN)
    normal = np.where(seen[:, None], _NORMALS[plane], _UP)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    into, out, _ = _hits(points + 1e-6 * normal, np.broadcast_to(sun, points.shape))
    lit = np.where((into < out) & (out > 1e-3) & ~seen, 0.0, np.clip(normal @ sun, 0.0, None))
    colour = colour * (_AMBIENT * np.array([0.85, 0.95, 1.15]) + 1.15 * lit[:, None] * np.array([1.0, 0.95, 0.85]))
    haze = np.clip(to_ground / 400.0, 0.0, 0.3)[:, None]
    colour = np.where(ground[:, None], (1.0 - haze) * colour + haze * _RGB["horizon"] * 0.8, colour)
    colour = np.where((seen | ground)[:, None], colour, _sky(rays))
    colour *= (1.0 - 0.9 * (across**2 + down**2))[:, None]  # vignette
    image = colour.reshape(side * _OVERSAMPLED, side * _OVERSAMPLED, 3)
    image = cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA)
    return np.clip(np.clip(image, 0.0, 1.0) ** 0.85 + 0.012 * _RNG.standard_normal(image.shape), 0.0, 1.0)
