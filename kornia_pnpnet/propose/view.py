"""What the set network sees of a problem: features that do not depend on where world and camera are, nor on units."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from kornia_pnpnet.core.linalg import dot, solve_symmetric
from kornia_pnpnet.types import Problem

__all__ = ["LEAST_NOISE", "LOG_NOISE", "View", "repeats"]

# Ridge of the affine camera, relative to the mean square of the world points. It makes the fit unique for planar
# points.
_RIDGE = 0.02
# Features are clipped at this many times the spread of their kind, so that a wild pair does not dominate the network.
_MOST = 8.0
#: Centre of the logarithm of the estimated noise, relative to the spread of the pixels and of the world.
LOG_NOISE = -5.0
#: Noise of less than this share of the spread counts as this share: scores divide by the variance.
LEAST_NOISE = 1e-6
# Confidences are clipped to this distance from 0 and from 1.
_LEAST_CONFIDENCE = 1e-3
# Points are sorted by their first coordinate plus the others times these factors, so that equal points are neighbours;
# the factors are irrational, so that the points of a grid have different keys.
_KEY = 0.7548776662, 0.5698402910


class View:
    r"""The network's input: invariant to rotations of world and camera and to their units.

    The camera is rotated so that the mean of the rays is its axis, and zoomed until the spread of the rays is 1. The
    world, already centred and scaled, is rotated to the axes of the affine camera that fits the pairs best (by ridge
    regression).
    """

    def __init__(self, corr: Problem, confidence: bool, repeats: Tensor | None) -> None:
        world = corr.world_points.contiguous()
        there = (corr.usual_weights > 0).to(world.dtype)
        share = (there / there.sum(1, keepdim=True).clamp(min=1.0))[..., None]  # (B, N, 1)
        plane = corr.img_points / corr.focal
        rays = functional.normalize(torch.cat((plane, torch.ones_like(plane[..., :1])), -1), dim=-1)
        mean = torch.stack([(share[..., 0] * ray).sum(1) for ray in rays.unbind(-1)], -1)
        x, y, z = functional.normalize(mean, dim=-1).unbind(-1)  # z > 0
        k = (1.0 + z).reciprocal()
        rows = (1.0 - k * x * x, -k * x * y, -x, -k * x * y, 1.0 - k * y * y, -y, x, y, z)
        self.there = there
        self.camera = torch.stack(rows, -1).unflatten(-1, (3, 3))  # (B, 3, 3), the smallest such rotation
        self.rays = rays @ self.camera.mT  # (B, N, 3)
        tiny = 1e-12
        self.spread = ((share * self.rays[..., :2].square()).sum((1, 2)) + tiny).sqrt()  # (B,)
        seen = self.rays[..., :2] / self.spread[:, None, None]
        seen = seen - (share * seen).sum(1, keepdim=True)

        moment = world.mT @ (share * world) + _RIDGE * torch.eye(3, dtype=world.dtype, device=world.device)
        affine = solve_symmetric(moment, world.mT @ (share * seen)).mT  # (B, 2, 3)
        self.world = _frame(affine)  # (B, 3, 3)
        self.points = world @ self.world.mT  # (B, N, 3)
        residual = seen - world @ affine.mT
        sizes = 0.5 * (affine.square().sum(-1) + 1e-3).log()  # (B, 2)
        self.log_spread = self.spread.log()
        problem = torch.cat((self.log_spread[:, None], sizes), -1)[:, None].expand(-1, world.shape[1], -1)
        self.known = self._known(corr)
        noise = [torch.where(known, log - LOG_NOISE, 0.0) for log, known in self.known]
        flags = [known.to(world.dtype) for _, known in self.known]
        if confidence:
            given = torch.full_like(corr.weights, torch.nan) if corr.confidence is None else corr.confidence
            believed = given.nan_to_num(0.5).clamp(_LEAST_CONFIDENCE, 1.0 - _LEAST_CONFIDENCE)
            flags += [believed.logit(), (~given.isnan()).to(world.dtype)]
        if repeats is not None:
            flags += repeats.unbind(-1)
        parts = self.points, seen, residual, problem, *(x[..., None] for x in (*noise, *flags))
        self.features = torch.cat(parts, -1).clamp(-_MOST, _MOST)

    def _known(self, corr: Problem) -> list[tuple[Tensor, Tensor]]:
        """Logarithms of the noise of pixels and of points relative to their spread, and whether the noise is known."""
        if corr.noise is None:
            no = torch.zeros_like(corr.weights, dtype=torch.bool)
            return [(torch.zeros_like(corr.weights), no)] * 2
        units = corr.focal * self.spread[:, None], torch.ones_like(self.spread[:, None])
        sigmas = corr.noise.img, corr.noise.world
        known = [torch.isfinite(x) for x in sigmas]
        logs = []
        for sigma, unit, is_known in zip(sigmas, units, known, strict=True):
            # Unknown sigmas are NaN. Replace them before dividing, or the gradient of the unit becomes NaN.
            relative = torch.where(is_known, sigma, 1.0) / torch.where(is_known, unit, 1.0)
            logs.append(relative.clamp(min=LEAST_NOISE).log())
        return list(zip(logs, known, strict=True))


@torch.no_grad()
def repeats(corr: Problem) -> Tensor:
    """Logarithms of the numbers of pairs with the same pixel and with the same point, (B, N, 2)."""
    there = (corr.usual_weights > 0).to(corr.weights)
    return torch.stack([_same(x, there).log() for x in (corr.img_points, corr.world_points)], -1)


@torch.no_grad()
def _same(points: Tensor, there: Tensor) -> Tensor:
    """Number of pairs of the problem whose point is exactly the same, at least 1; ``points`` (B, N, K), (B, N)."""
    key, *others = points.unbind(-1)
    for x, factor in zip(others, _KEY, strict=False):
        key = key + factor * x
    order = key.argsort(1)  # equal points are neighbours
    ordered = points.gather(1, order[..., None].expand_as(points))
    # Numbers, not booleans, of which PyTorch 2.13 makes code that does not compile.
    new = (ordered[:, 1:] != ordered[:, :-1]).long().amax(-1)
    run = functional.pad(new.cumsum(1), (1, 0))
    sizes = torch.zeros_like(there).scatter_add(1, run, there.gather(1, order))
    return torch.empty_like(there).scatter(1, order, sizes.gather(1, run)).clamp(min=1.0)


def _frame(affine: Tensor) -> Tensor:
    """The rotation whose first two rows are nearest the rows of an affine camera (B, 2, 3); any rotation if it is 0."""
    p, q = affine.unbind(1)
    pp, pq, qq = dot(p.unbind(-1), p.unbind(-1)), dot(p.unbind(-1), q.unbind(-1)), dot(q.unbind(-1), q.unbind(-1))
    # The inverse square root of [[pp, pq], [pq, qq]], up to a factor: (S + sqrt(det S) I)^-1.
    ridge = 1e-3 * (pp + qq) + 1e-6
    root = ((pp + ridge) * (qq + ridge) - pq * pq).clamp(min=1e-12).sqrt()
    u = (qq + ridge + root)[:, None] * p - pq[:, None] * q
    axis = torch.eye(3, dtype=u.dtype, device=u.device)[0]
    u = functional.normalize(u + 1e-6 * axis, dim=-1)
    v = (pp + ridge + root)[:, None] * q - pq[:, None] * p
    v = v - (u * v).sum(-1, keepdim=True) * u + 1e-6 * _orthogonal(u)
    v = functional.normalize(v, dim=-1)
    return torch.stack((u, v, torch.linalg.cross(u, v)), 1)


def _orthogonal(unit: Tensor) -> Tensor:
    """A unit vector orthogonal to each, (B, 3)."""
    x, y, z = unit.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0)
    a = -(sign + z).reciprocal()
    return torch.stack((1.0 + sign * x * x * a, sign * x * y * a, -sign * x), -1)
