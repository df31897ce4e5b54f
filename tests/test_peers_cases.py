"""Our solvers on the test cases of other libraries' public suites, beside those libraries.

The problems are drawn anew from the parameters of each suite; no test data is taken from it. A peer is what its own users
call: every test asserts that each of our solvers solves at least as many problems as the best peer, minus a margin.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from kornia.geometry import solve_pnp_dlt
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from kornia_pnpnet import Pose, Problems, Status, create_solver, pose_errors, solve_pnp, success
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.peers import OpenCVPnP, OpenCVRansac, PoseLib, PyColmap

cv2 = pytest.importorskip("cv2")
pytest.importorskip("poselib")
pytest.importorskip("pycolmap")

DTYPES = (torch.float32, torch.float64)
both_dtypes = pytest.mark.parametrize("dtype", DTYPES, ids=("float32", "float64"))
OURS = ("pnpnet-set", "p3p-ransac", "epnp-lm", "epnp")
#: README: problems with noise of the 3D points need a threshold for it, here three standard deviations of both noises.
OPTIONS = {"p3p-ransac": {"threshold": 3.0, "world_threshold": 0.15}}
#: Errors (radians, units of the world) that OpenCV's suite allows, and what float32 leaves of them.
LIMIT = {torch.float64: 1e-6, torch.float32: 1e-4}
OPENCV_PNP = ("ITERATIVE", "EPNP", "SQPNP")


def problems_of(world: Tensor, img: Tensor, intrinsics: Tensor, rotation: Tensor, translation: Tensor) -> Problems:
    inliers = torch.ones(img.shape[:2], dtype=torch.bool)
    return Problems(world, img, intrinsics.expand(len(world), 3, 3), Pose(rotation, translation), inliers)


def project(world: Tensor, rotation: Tensor, translation: Tensor, intrinsics: Tensor) -> Tensor:
    """Pixels, also of points behind the camera, as ``cv2.projectPoints`` returns them."""
    seen = (world @ rotation.mT + translation[:, None]) @ intrinsics.mT
    return seen[..., :2] / seen[..., 2:]


def solve(solver, p: Problems, dtype: torch.dtype = torch.float64, **extra):
    with torch.no_grad():
        result = solver(p.world_points.to(dtype), p.img_points.to(dtype), p.intrinsics.to(dtype), **extra)
    return result._replace(rotation=result.rotation.double(), translation=result.translation.double())


def count(solver, p: Problems, limit: float, dtype: torch.dtype = torch.float64) -> int:
    """Problems whose rotation and translation are right up to a limit, in radians and units of the world."""
    result = solve(solver, p, dtype)
    return int((success(pose_errors(result.pose, p.pose), math.degrees(limit), limit) & result.ok).sum())


def best_of_opencv(p: Problems, limit: float, *methods: str) -> int:
    return max(count(OpenCVPnP(method=method), p, limit) for method in methods)


# ---- OpenCV: modules/3d/test/test_solvepnp_ransac.cpp ----------------------------------------------------------------


def opencv_poses(world: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """The first of ten poses (rotation vector in (0.001, 1), depth in (0.01, 1)) that sees all points, else the last."""
    vector = torch.rand(len(world), 10, 3, generator=generator, dtype=torch.float64) * 0.999 + 1e-3
    shift = torch.rand(len(world), 10, 3, generator=generator, dtype=torch.float64) * 2.0 - 1.0
    shift[..., 2] = 0.01 + 0.99 * torch.rand(len(world), 10, generator=generator, dtype=torch.float64)
    rotation = axis_angle_to_rotation_matrix(vector.flatten(0, 1)).unflatten(0, (-1, 10))
    seen = ((world[:, None] @ rotation.mT + shift[:, :, None])[..., 2] > 0).all(-1)
    chosen = torch.where(seen.any(1), seen.int().argmax(1), 9)
    rows = torch.arange(len(world))
    return rotation[rows, chosen], shift[rows, chosen]


def opencv_scenes(kind: str, n: int, seed: int, batch: int = 50, distorted: bool = False):
    """Random clouds, planes in space or square tags; focal lengths and principal point in (0.001, 100) px.

    Points and pixels are rounded to float32, as in the suite. Returns the problems, and the coefficients of distortion.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(batch, *shape, generator=generator, dtype=torch.float64)

    if kind == "cloud":
        world = torch.tensor([-1.0, -1, 5]) + uniform(n, 3) * torch.tensor([2.0, 2, 5])
    elif kind == "plane":
        world = torch.cat((2.0 * uniform(n, 2) - 1.0, torch.zeros(batch, n, 1)), -1)
        rotation, translation = opencv_poses(torch.zeros(batch, 1, 3).double(), generator)
        world = world @ rotation.mT + translation[:, None]
    else:
        corners = torch.tensor([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], dtype=torch.float64)
        world = corners * (0.01 + 0.99 * uniform(1, 1)) / 2
    world = world.float().double()
    intrinsics = torch.eye(3, dtype=torch.float64).repeat(batch, 1, 1)
    intrinsics[:, (0, 1, 0, 1), (0, 1, 2, 2)] = 1e-3 + 99.999 * uniform(4)
    rotation, translation = opencv_poses(world, generator)
    distortion = np.zeros((batch, 4))
    if distorted:
        distortion[:, :3] = 1e-6 * uniform(3).numpy()
        vectors = [cv2.Rodrigues(r)[0] for r in rotation.numpy()]
        parts = zip(world.numpy(), vectors, translation.numpy(), intrinsics.numpy(), distortion, strict=True)
        img = torch.from_numpy(np.stack([cv2.projectPoints(*part)[0][:, 0] for part in parts]))
    else:
        img = project(world, rotation, translation, intrinsics)
    return problems_of(world, img.float().double(), intrinsics, rotation, translation), distortion


@both_dtypes
@pytest.mark.parametrize("name", OURS)
@pytest.mark.parametrize(("kind", "n"), [("cloud", 100), ("plane", 30), ("tag", 4)])
def test_opencv_scenes_without_outliers(kind, n, name, dtype):
    """``CV_solvePnP_Test``: random clouds, planes and tags without noise; at least 70 % must be solved."""
    problems, _ = opencv_scenes(kind, n, seed=1)
    methods = {"cloud": OPENCV_PNP, "plane": (*OPENCV_PNP, "IPPE"), "tag": ("IPPE_SQUARE", "IPPE", "SQPNP")}[kind]
    ours = count(create_solver(name), problems, LIMIT[dtype], dtype)
    assert ours >= max(35, best_of_opencv(problems, LIMIT[dtype], *methods) - 2)
