"""Real scenes: the images of a scene with their poses, and random problems from these images.

Convention: ``x_cam = R x_world + t``. Pixels and camera matrices follow COLMAP: the centre of the top-left pixel is
(0.5, 0.5). The tensors of a scene are in float64 on the CPU.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from kornia.core.check import KORNIA_CHECK
from torch import Tensor

from kornia_pnpnet.core.checks import check_whole
from kornia_pnpnet.data.draws import RandomProblems, random_poses, unit
from kornia_pnpnet.data.outliers import OutlierKind, OutlierMix
from kornia_pnpnet.result import Problems

__all__ = ["Scene", "SceneProblems", "View"]


@dataclass(frozen=True, eq=False)
class View:
    r"""One image of a scene: its observations and its pose.

    Attributes:
        name: the image's name, including sub-folders.
        world_points: the observed points in the unit of the scene, shape :math:`(M, 3)`, float64.
        img_points: undistorted pixels of the points, shape :math:`(M, 2)`, float64.
        intrinsics: pinhole camera matrix in pixels, shape :math:`(3, 3)`.
        rotation: world-to-camera rotation, shape :math:`(3, 3)`.
        translation: world-to-camera translation, shape :math:`(3,)`.
        width: image width in pixels.
        height: image height in pixels.
        inliers: whether a pair is an inlier, bool, shape :math:`(M,)`.

    Raises:
        ValueError: if a shape is unexpected, a value is not finite, or ``rotation`` is not a rotation matrix.
    """

    name: str
    world_points: Tensor
    img_points: Tensor
    intrinsics: Tensor
    rotation: Tensor
    translation: Tensor
    width: int
    height: int
    inliers: Tensor

    def __post_init__(self) -> None:
        m = len(self.world_points)
        of_pairs = {"world_points": (m, 3), "img_points": (m, 2), "inliers": (m,)}
        for name, shape in {**of_pairs, "intrinsics": (3, 3), "rotation": (3, 3), "translation": (3,)}.items():
            value: Tensor = getattr(self, name)
            if value.shape != shape:
                raise ValueError(f"image '{self.name}': {name} has shape {tuple(value.shape)}, expected {shape}")
            if not value.isfinite().all():
                raise ValueError(f"image '{self.name}': {name} has values that are not finite")
        eye = torch.eye(3, dtype=self.rotation.dtype, device=self.rotation.device)
        deviation = (self.rotation @ self.rotation.mT - eye).abs().max()
        if deviation > 1e-3 or self.rotation.det() < 0:
            raise ValueError(f"image '{self.name}': rotation is not a rotation matrix")

    @property
    def cam_points(self) -> Tensor:
        """The observed points in the camera's frame, shape :math:`(M, 3)`."""
        return self.world_points @ self.rotation.mT + self.translation


@dataclass(frozen=True, eq=False)
class Scene:
    """The images of one scene.

    Attributes:
        name: the scene's name.
        views: the images that observe enough points, sorted by name.
        skipped: names of the images that were left out because the images observe too few points.
        metric: whether the unit of the scene is the metre. Otherwise the unit is arbitrary.
    """

    name: str
    views: tuple[View, ...]
    skipped: tuple[str, ...] = ()
    metric: bool = True

    @property
    def median_depth(self) -> float:
        """Median depth of the inliers of all images, in the unit of the scene."""
        return torch.cat([view.cam_points[view.inliers, 2] for view in self.views]).median().item()


@dataclass(kw_only=True, eq=False)
class SceneProblems(RandomProblems):
    r"""Random problems of a scene, endless and reproducible.

    Each problem consists of ``n`` random points of a random image and their pixels. ``outliers`` changes the pixels of
    some pairs. A *mismatch* gets the pixel of a spare point. Spare points are points of the same image that are in no
    pair. A *sensing* outlier gets a uniform pixel. For real data with outliers, the protocol uses
    ``outliers=OutlierMix(count=2)``. Points and poses do not depend on ``outliers``.

    As in the paper, a pose :math:`(R^*, t^*)` is drawn from the protocol's distribution. The world is moved so that
    this pose is the true pose: :math:`x' = R^{*\top}(R x + t - t^*)`, where :math:`(R, t)` is the image's pose.

    Args:
        scene: the scene. Images with fewer than ``n + num_spares`` points are not used.
        n: number of pairs per problem. For ``batch_size``, ``seed``, ``dtype`` and ``device`` see
            :class:`SyntheticProblems`.
        outliers: number of outliers and share of mismatches. ``None`` adds no outliers, but scenes of raw matches
            already contain outliers.
        num_spares: number of spare points per problem. Mismatches get the pixels of the spare points in turn. With one
            spare point, as in the protocol, all mismatches of a problem share a pixel.

    Raises:
        BaseError: when ``outliers`` asks for *near* outliers, *structured* outliers or crowds.
        ValueError: if no image has enough points.
    """

    scene: Scene = field(kw_only=False, repr=False)
    outliers: OutlierMix | None = None
    num_spares: int = 1
    dtype: torch.dtype = torch.float64

    def __post_init__(self) -> None:
        super().__post_init__()
        check_whole(1, num_spares=self.num_spares)
        for name in ("near_share", "structured_share", "crowd_share"):
            share = getattr(self.outliers, name, 0.0)
            KORNIA_CHECK(share == 0, f"SceneProblems has no near or structured outliers and no crowds: {name}={share}.")
        need = self.n + self.num_spares
        self.views = views = tuple(view for view in self.scene.views if len(view.world_points) >= need)
        if not views:
            wanted = f"n = {self.n} and num_spares = {self.num_spares}"
            raise ValueError(f"no image of '{self.scene.name}' has the {need} points for {wanted}")
        # The pairs of all views are joined, so that one index operation gathers the pairs of a batch.
        pairs = zip(*((view.cam_points, view.img_points, view.inliers) for view in views), strict=True)
        self._pairs = [torch.cat(parts) for parts in pairs]
        self._intrinsics = torch.stack([view.intrinsics for view in views])
        self._size = torch.tensor([[view.width, view.height] for view in views], dtype=torch.float64, device="cpu")
        self._counts = torch.tensor([len(view.world_points) for view in views], device="cpu")

    @property
    def max_translation(self) -> float:
        """Limit of the translation error of a success: 0.2 m, or 0.5 % of the median depth if the unit is arbitrary."""
        return 0.2 if self.scene.metric else 0.005 * self.scene.median_depth

    def _draw(self, generator: torch.Generator) -> Problems:
        # Draws for `outliers` come last, so that points and poses do not depend on `outliers`.
        view = torch.randint(len(self.views), (self.batch_size,), generator=generator)
        rows = _choose(self._counts[view], self.n + self.num_spares, generator)
        rows += (self._counts.cumsum(0) - self._counts)[view, None]
        rows, spare_rows = rows[:, : self.n], rows[:, self.n :]  # (B, N), (B, num_spares)
        pose = random_poses(self.batch_size, generator)
        anywhere = unit((self.batch_size, self.n, 2), generator) * self._size[view, None]
        kind = (self.outliers or OutlierMix(count=0)).draw(self.batch_size, self.n, generator)  # (B, N)

        cam_points, img_points, inliers = self._pairs
        world_points = (cam_points[rows] - pose.translation[:, None]) @ pose.rotation  # (B, N, 3)
        mismatch = kind == OutlierKind.MISMATCH
        turn = (mismatch.cumsum(1) - 1) % self.num_spares  # (B, N), only mismatches use `turn`
        pixels = img_points[torch.where(mismatch, spare_rows.gather(1, turn), rows)]
        pixels = torch.where((kind == OutlierKind.SENSING)[..., None], anywhere, pixels)
        inliers = inliers[rows] & (kind == OutlierKind.INLIER)
        return Problems(world_points, pixels, self._intrinsics[view], pose, inliers)


def _choose(counts: Tensor, k: int, generator: torch.Generator) -> Tensor:
    """For each of the B ``counts``, draw k different integers from 0 to count - 1 by Floyd's algorithm, (B, k)."""
    draws = unit((len(counts), k), generator)
    chosen = torch.empty((len(counts), k), dtype=torch.int64)
    for i in range(k):
        last = counts - k + i  # `last` grows with i, so `last` was not chosen before
        candidate = (draws[:, i] * (last + 1)).long()
        chosen_before = (chosen[:, :i] == candidate[:, None]).any(1)
        chosen[:, i] = torch.where(chosen_before, last, candidate)
    # The algorithm draws a uniformly random set, but the order of the integers is not uniform. So rows are shuffled.
    return chosen.gather(1, unit((len(counts), k), generator).argsort(1))
