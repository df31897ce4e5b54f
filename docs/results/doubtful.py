"""Problems that a solver must not believe, and small or flat objects that it must believe where it is right.

:func:`doubtful` draws one batch of every kind. ``measure_judge.py`` measures ``ok`` on them, and
``tests/test_judge.py`` tests it.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from kornia.geometry.linalg import transform_points
from torch import Tensor
from torch.nn.functional import normalize

from kornia_pnpnet import Pose
from kornia_pnpnet.cameras import reproject

#: Focal length 800, image of 1280 x 720 pixels.
INTRINSICS = torch.tensor([[800.0, 0.0, 640.0], [0.0, 800.0, 360.0], [0.0, 0.0, 1.0]])
IMAGE = torch.tensor([1280.0, 720.0])
#: The edge of a tag.
EDGE = 0.1


class Kind(NamedTuple):
    """Problems of one kind: points, pixels, the true pose (``None``: no pose is right), what else a solver is given."""

    name: str
    world_points: Tensor
    img_points: Tensor
    truth: Pose | None
    given: dict[str, Any]
    intrinsics: Tensor = INTRINSICS

    @property
    def inputs(self) -> dict[str, Any]:
        """The arguments of a solver."""
        pairs = {"world_points": self.world_points, "img_points": self.img_points}
        return {**pairs, "intrinsics": self.intrinsics, **self.given}

    @property
    def distance(self) -> Tensor:
        """Median depth of the points of each problem under the true pose, (B,)."""
        assert self.truth is not None
        depth = transform_points(self.truth.matrix, self.world_points)[..., 2]
        return depth.where(self.given.get("mask", depth.isfinite()), torch.nan).nanmedian(1).values


def doubtful(count: int, seed: int) -> Iterator[Kind]:
    """Batches of ``count`` problems: random pairs, copies, wrong conventions, lines, and square tags."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=generator)

    def anywhere(pairs: int) -> Tensor:
        return IMAGE * torch.rand(count, pairs, 2, generator=generator)

    def pose(depth: float, tilt: float = 0.5) -> Pose:
        shift = 0.07 * depth * normal(3) * torch.tensor([1.0, 1.0, 0.3])
        return Pose.from_rvec(tilt * normal(3), torch.tensor([0.0, 0.0, depth]) + shift)

    def seen(points: Tensor, pose: Pose, sigma: float) -> Tensor:
        return reproject(points, INTRINSICS, pose) + sigma * normal(points.shape[1], 2)

    for pairs, copied in ((20, 0), (60, 0), (200, 0), (60, 9), (200, 10), (200, 20)):
        points, pixels = normal(pairs, 3), anywhere(pairs)
        if copied:
            points[:, -copied:], pixels[:, -copied:] = points[:, :copied], pixels[:, :copied]
        yield Kind(f"{pairs} random pairs" + f", {copied} listed twice" * (copied > 0), points, pixels, None, {})
    points, pixels = normal(40, 3).repeat(1, 3, 1), anywhere(40).repeat(1, 3, 1)
    yield Kind("40 random pairs in 3 frames, 1 px apart", points, pixels + normal(120, 2), None, {})
    for copies in (2, 50):
        points, truth = normal(3, 3), pose(6.0)
        pixels = seen(points, truth, 0.0)
        yield Kind(f"3 pairs, {copies} copies", points.repeat(1, copies, 1), pixels.repeat(1, copies, 1), None, {})
    for pairs in (20, 60):
        points = normal(pairs, 3)
        pixels = seen(points, pose(6.0), 0.5)
        flipped = pixels * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 720.0])
        yield Kind(f"{pairs} pairs, y up", points, flipped, None, {})
        yield Kind(f"{pairs} pairs, left-handed world", points * torch.tensor([1.0, 1.0, -1.0]), pixels, None, {})
        yield Kind(f"{pairs} pairs, row and column", points, pixels.flip(-1), None, {})
    for pairs, wrong in ((30, 0), (30, 3), (30, 10), (8, 1)):
        line = torch.linspace(-1.0, 1.0, pairs)[:, None] * normalize(normal(1, 3), dim=-1)
        points, truth = torch.cat((line, 0.8 * normal(wrong, 3)), 1), pose(5.0)
        pixels = seen(points, truth, 0.5)
        pixels[:, pairs:] = anywhere(wrong)
        given = {"img_sigma": 0.5, "world_sigma": 0.0}
        yield Kind(f"{pairs} pairs on a line, {wrong} outliers", points, pixels, truth, given)
    corners = 0.5 * EDGE * torch.tensor([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
    for size, sigma in ((20, 0.3), (60, 1.0), (60, 0.3), (100, 0.3), (400, 0.5)):
        turn = 0.6 * normal(3) * torch.tensor([1.0, 1.0, 0.0])
        truth = Pose.from_rvec(turn, torch.tensor([0.0, 0.0, 80.0 / size]).expand(count, 3))
        points = corners.expand(count, 4, 3).clone()
        given = {"img_sigma": sigma, "world_sigma": 0.0}
        yield Kind(f"tag of {size} px, {sigma} px", points, seen(points, truth, sigma), truth, given)
    points, truth = torch.cat([points + x * torch.tensor([2.0, 0.0, 0.0]) for x in (-1, 1)], 1), pose(8.0, 0.3)
    yield Kind("2 tags of 10 px, 400 px apart, 0.3 px", points, seen(points, truth, 0.3), truth, {})
