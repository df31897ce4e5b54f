"""The input features of the set network. They are invariant to units and to most rotations of world and camera."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from kornia_pnpnet.core.linalg import solve_symmetric
from kornia_pnpnet.judge.evidence import copies
from kornia_pnpnet.problem import Problem

__all__ = ["LEAST_NOISE", "LOG_NOISE", "View", "repeats"]

# Ridge of the affine camera, relative to the mean square of the world points, so that it is unique for planar points.
_RIDGE = 0.02
# Features are clipped to this absolute value, so that no pair dominates the network.
_MOST = 8.0
#: Logarithm of the noise at the centre of its range. The unit of noise is the spread of the pixels or world points.
LOG_NOISE = -5.0
#: Least noise, as a share of the spread. Scores divide by the variance, which must not be 0.
LEAST_NOISE = 1e-6
# Least confidence, and least distance of a confidence from 1.
_LEAST_CONFIDENCE = 1e-3


class View:
    r"""The network's input.

    The features are invariant to units, to rotations of the world, and to rotations of the camera except the roll: the
    camera is rotated to the mean of the rays, and zoomed so that their spread is 1. The world is rotated to the axes of
    an affine camera, which ridge regression fits to the pairs.

    Attributes:
        there: 1 for pairs of normal scale with a weight above 0, and 0 for other pairs, shape :math:`(B, N)`.
        rays: unit rays in the frame of the original camera, shape :math:`(B, N, 3)`.
        log_spread: logarithm of the spread of the rays, shape :math:`(B, 1)`. The spread is the root mean square sine
            of the angles between the rays and the mean ray.
        unit: spread of the pixels, and spread of the world points, shape :math:`(B, 2)`.
        height: third coordinates of the rotated world points, shape :math:`(B, N)`.
        features: the network's input, shape :math:`(B, N, C)`.
    """

    def __init__(self, problem: Problem, confidence: bool, repeats: Tensor | None) -> None:
        world = problem.world_points.contiguous()
        eye = torch.eye(3, dtype=world.dtype, device=world.device)
        self.there = (problem.usual_weights > 0).to(world.dtype)
        share = (self.there / self.there.sum(1, keepdim=True).clamp(min=1.0))[..., None]  # (B, N, 1)
        plane = functional.pad(problem.img_points / problem.focal, (0, 1), value=1.0)
        self.rays = functional.normalize(plane, dim=-1)
        mean = functional.normalize((share * self.rays).sum(1), dim=-1)
        # Two reflections rotate the mean ray to the z axis: first to the negative z axis, then z is negated.
        half = mean + eye[2]
        mirror = 1.0 - 2.0 * eye[2]
        turn = (half * mirror)[..., None] * (half / half[:, 2:])[:, None]
        across = torch.bmm(self.rays, (eye * mirror - turn)[:, :2].mT)
        spread = ((share * across.square()).sum((1, 2)) + 1e-12).sqrt()[:, None]
        seen = across / spread[..., None]
        seen = seen - (share * seen).sum(1, keepdim=True)

        moment, cross = torch.bmm(world.mT, share * torch.cat((world, seen), -1)).split((3, 2), -1)
        affine = solve_symmetric(moment + _RIDGE * eye, cross).mT  # (B, 2, 3)
        squares = affine.square().sum(-1)  # (B, 2)
        points = torch.bmm(world, _frame(affine, squares).mT)
        residual = torch.baddbmm(seen, world, affine.mT, alpha=-1)
        self.height = points[..., 2]
        self.log_spread = spread.log()
        self.unit = torch.cat((problem.focal * spread, torch.ones_like(spread)), -1)
        of_problem = torch.cat((self.log_spread, 0.5 * (squares + 1e-3).log()), -1)
        parts = [points, seen, residual, of_problem[:, None].expand(-1, world.shape[1], -1), self._noise(problem)]
        if confidence:
            given = torch.full_like(problem.weights, torch.nan) if problem.confidence is None else problem.confidence
            believed = given.nan_to_num(0.5).clamp(_LEAST_CONFIDENCE, 1.0 - _LEAST_CONFIDENCE)
            parts.append(torch.stack((believed.logit(), (~given.isnan()).to(world.dtype)), -1))
        if repeats is not None:
            parts.append(repeats)
        self.features = torch.cat(parts, -1).clamp(-_MOST, _MOST)

    def _noise(self, problem: Problem) -> Tensor:
        """Logarithms of the noise of pixels and points over their spread, and whether the noise is known, (B, N, 4)."""
        if problem.noise is None:
            return torch.zeros_like(problem.weights)[..., None].expand(-1, -1, 4)
        sigmas = torch.stack((problem.noise.img, problem.noise.world), -1)  # (B, N, 2)
        known = sigmas.isfinite()
        # Unknown sigmas are NaN. They are replaced before the division, because `unit` would have the gradient NaN.
        relative = torch.where(known, sigmas, 1.0) / torch.where(known, self.unit[:, None], 1.0)
        logs = torch.where(known, relative.clamp(min=LEAST_NOISE).log() - LOG_NOISE, 0.0)
        return torch.cat((logs, known.to(logs.dtype)), -1)


@torch.no_grad()
def repeats(problem: Problem) -> Tensor:
    """Logarithms (B, N, 2) of the number of pairs with the same pixel, and the number of pairs with the same point."""
    there = problem.usual_weights > 0
    return torch.stack([copies(x, there) for x in (problem.img_points, problem.world_points)], -1).log()


def _frame(affine: Tensor, squares: Tensor) -> Tensor:
    """The rotation (B, 3, 3) whose first two rows are closest to ``affine`` (B, 2, 3) with the lengths² ``squares``."""
    p, q = affine.unbind(1)
    product = (p * q).sum(-1, keepdim=True)  # (B, 1)
    # The closest orthonormal rows are S^-1/2 times the rows, where S is the Gram matrix of the rows. S^-1/2 is
    # proportional to the adjugate of S + sqrt(det S) I.
    raised = squares + (1e-3 * squares.sum(-1, keepdim=True) + 1e-6)
    first, second = raised.split(1, -1)  # the gradient of `prod` would wait for a GPU
    root = (first * second - product.square()).clamp(min=1e-12).sqrt()
    diagonal = raised.flip(-1) + root
    u, v = (diagonal[..., None] * affine - product[..., None] * affine.flip(1)).unbind(1)
    eye = torch.eye(3, dtype=u.dtype, device=u.device)
    u = functional.normalize(u + 1e-6 * eye[0], dim=-1)
    # A reflection maps the z axis to u or to -u. The same reflection maps the x axis to a vector orthogonal to u.
    sign = torch.where(u[:, 2:] < 0, u.new_full((), -1.0), 1.0)
    orthogonal = eye[0] - (u[:, :1] / (1.0 + sign * u[:, 2:])) * (u + sign * eye[2])
    v = functional.normalize(v - (u * v).sum(-1, keepdim=True) * u + 1e-6 * orthogonal, dim=-1)
    return torch.stack((u, v, torch.linalg.cross(u, v)), 1)
