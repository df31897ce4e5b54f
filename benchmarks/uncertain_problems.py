"""The problems of ``uncertainty.py``: pairs with covariances, what is known of a pose before, planar targets."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from kornia_pnpnet import PosePrior, gravity_prior
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.data.points import BoxPoints
from kornia_pnpnet.geometry import transform
from kornia_pnpnet.refine.residual import retract
from kornia_pnpnet.result import Pose, Problems

__all__ = [
    "GRAVITY",
    "SHIFT",
    "TURN",
    "gravity",
    "last_pose",
    "sigmas_of_same_trace",
    "squares",
    "uncertain_pnp",
]

#: Standard deviations in degrees of gravity and of the last rotation; of the last position, relative to the distance.
GRAVITY, TURN, SHIFT = 0.5, 1.0, 0.02
# Grades of noise in uncertain PnP; standard deviations of grade 1 in pixels and in the unit of the world.
_GRADES, _PIXEL, _POINT = 10, 1.0, 0.01


def uncertain_pnp(n: int, share: float, count: int, *, turned: bool, seed: int) -> Problems:
    """Problems of the protocol of uncertain PnP (Vakhitov et al., CVPR 2021, arXiv 2107.03890, section 4.1).

    Points lie in a box in front of a camera of 800 px, their centre is the origin of the world. A tenth of the pairs
    each has grade 1, 2, ..., 10: the standard deviation along the longest axis, in pixels and in hundredths
    of a unit. Those of the other axes are uniform between 0 and that; the axes have a random direction.

    Args:
        n: number of pairs.
        share: share of outliers: half are mismatches, half have a random pixel.
        count: number of problems.
        turned: whether the noise of pixels has axes as well. It is isotropic otherwise, as in most of the protocol.
        seed: seed of the problems.
    """
    exact = SyntheticProblems(
        n=n,
        batch_size=count,
        seed=seed,
        points=BoxPoints(half_width=2.0, z_near=4.0, depth=4.0),
        outliers=OutlierMix(count=round(share * n)),
        max_angle=math.pi,
        focal=800.0,
        half_image=400.0,
        img_sigma=0.0,
        world_sigma=0.0,
        dtype=torch.float64,
    ).batch(0)
    rotation, translation = exact.pose
    middle = exact.world_points.mean(1, keepdim=True)
    generator = torch.Generator().manual_seed(seed)
    grade = 1.0 + torch.arange(n, dtype=torch.float64).remainder(_GRADES).expand(count, n)
    img_noise, img_cov = _noise(_PIXEL * grade, 2, generator, turned=turned)
    world_noise, world_cov = _noise(_POINT * grade, 3, generator, turned=True)
    return exact._replace(
        world_points=exact.world_points - middle + world_noise,
        img_points=exact.img_points + img_noise,
        pose=Pose(rotation, translation + (middle @ rotation.mT)[:, 0]),
        img_cov=img_cov,
        world_cov=world_cov,
    )


def _noise(sigma: Tensor, size: int, generator: torch.Generator, *, turned: bool) -> tuple[Tensor, Tensor]:
    """Noise (B, N, D) with the standard deviation of the longest axis, (B, N), and its covariance."""
    ratio = torch.rand(*sigma.shape, size, generator=generator, dtype=sigma.dtype)
    ratio[..., 0] = 1.0
    axes = sigma[..., None] * (ratio if turned else torch.ones_like(ratio))
    normal = torch.randn(*sigma.shape, size, size + 1, generator=generator, dtype=sigma.dtype)
    factor = torch.linalg.qr(normal[..., :size]).Q * axes[..., None, :]
    return (factor @ normal[..., size:])[..., 0], factor @ factor.mT


def sigmas_of_same_trace(problems: Problems) -> dict[str, Tensor]:
    """Standard deviations (B, N) of isotropic noise with the traces of the covariances, as arguments of a solver."""
    return {
        f"{name}_sigma": covariance.diagonal(dim1=-2, dim2=-1).mean(-1).sqrt()
        for name, covariance in (("img", problems.img_cov), ("world", problems.world_cov))
        if covariance is not None
    }


def last_pose(problems: Problems, generator: torch.Generator, wrong: float) -> PosePrior:
    """The pose of the frame before."""
    distance = problems.pose.translation.norm(dim=-1, keepdim=True)
    sigma = torch.cat((torch.full_like(distance, math.radians(TURN)).repeat(1, 3), SHIFT * distance.repeat(1, 3)), -1)
    noise, direction = torch.randn(2, *sigma.shape, generator=generator, dtype=sigma.dtype)
    error = sigma * (noise + wrong * nn.functional.normalize(direction, dim=-1))
    return PosePrior(retract(problems.pose, error), torch.diag_embed(sigma**-2))


def gravity(problems: Problems, generator: torch.Generator, wrong: float) -> PosePrior:
    """The direction of gravity, which is any direction in the world."""
    like, sigma = problems.pose.translation, math.radians(GRAVITY)
    down, noise, side = torch.randn(3, *like.shape, generator=generator, dtype=like.dtype)
    down = nn.functional.normalize(down, dim=-1)
    truth = (problems.pose.rotation @ down[..., None])[..., 0]
    across = nn.functional.normalize(torch.linalg.cross(truth, side), dim=-1)
    return gravity_prior(down, truth + torch.linalg.cross(sigma * (noise + wrong * across), truth), sigma)


def squares(tilt: float, sigma: float, count: int, *, seed: int) -> Problems:
    """Squares of four points under a tilt in degrees, with noise of the pixels."""
    generator = torch.Generator().manual_seed(seed)
    azimuth, roll, x, y, z = torch.rand(5, count, generator=generator, dtype=torch.float64)
    azimuth, roll = 2.0 * math.pi * azimuth, 2.0 * math.pi * roll
    zero = torch.zeros_like(roll)
    axis = torch.stack((azimuth.cos(), azimuth.sin(), zero), -1) * math.radians(tilt)
    translation = torch.stack((0.4 * x - 0.2, 0.4 * y - 0.2, 1.0 + z), -1)
    turns = [Pose.from_rvec(v, translation).rotation for v in (axis, torch.stack((zero, zero, roll), -1))]
    front = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    pose = Pose(turns[0] @ turns[1] @ front, translation)
    corners = [[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]]
    world = torch.tensor(corners, dtype=torch.float64).expand(count, 4, 3)
    camera = torch.tensor([[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    seen = transform(pose, world) @ camera.mT
    pixels = seen[..., :2] / seen[..., 2:]
    pixels = pixels + sigma * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    return Problems(world, pixels, camera.expand(count, 3, 3), pose, torch.ones(count, 4, dtype=torch.bool))
