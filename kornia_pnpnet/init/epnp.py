"""EPnP."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from kornia_pnpnet.init.control_points import ControlPoints, control_points, nearest_rotation, _product
from kornia_pnpnet.lm import solve_damped
from kornia_pnpnet.types import Correspondences, Guess, Pose

__all__ = ["EPnP"]

_MAX_SQ_RESIDUAL = 4.0
_PRIOR = 1e-9
_EDGES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_PRODUCTS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (0, 3))
_Parts = Sequence[Tensor]


class _System(NamedTuple):
    first: Tensor  # (4, 4, B)
    second: Tensor
    error: Tensor
    gram: Tensor  # (3, 3, B)
    unit: Tensor  # (B,)


def _dot(a: _Parts, b: _Parts) -> Tensor:
    pairs = zip(a, b, strict=True)
    x, y = next(pairs)
    total = x * y
    for x, y in pairs:
        total = torch.addcmul(total, x, y)
    return total


def _symmetric(entries: dict[tuple[int, int], Tensor], size: int) -> Tensor:
    return torch.stack([entries[min(i, j), max(i, j)] for i in range(size) for j in range(size)], -2).unflatten(
        -2, (size, size)
    )


_PAIRS = [(i, j) for i in range(4) for j in range(i, 4)]


def _system(control: ControlPoints, plane_points: Tensor) -> _System:
    a = control.coordinates.permute(2, 1, 0).unbind(0)[1:]  # (N, B) each
    weights = control.weights.mT
    weighted = [weights, *(weights * x for x in a)]
    scaled = [plane_points, *(plane_points * x for x in a)]  # (2, N, B) each
    moments = {(i, j): (weighted[i] * scaled[j]).sum(1) for i, j in _PAIRS}  # (2, B)
    errors = []
    for j in range(4):
        error = scaled[j] - moments[0, j][:, None]
        for i in range(3):
            error = torch.addcmul(error, a[i], moments[min(i + 1, j), max(i + 1, j)][:, None], value=-1)
        errors.append(error)
    weighted = [weights * x for x in errors]
    error = _symmetric({(i, j): (weighted[i] * errors[j]).sum((0, 1)) for i, j in _PAIRS}, 4)
    first, second = _symmetric(moments, 4).unbind(0)  # (2, 4, 4, B)
    vectors = control.points[:, 1:].permute(2, 1, 0)  # (3 xyz, 3, B)
    gram = _product(vectors.transpose(0, 1), vectors)
    unit = gram[0, 0] + gram[1, 1] + gram[2, 2]
    unit = torch.where(control.ok, unit, 1.0)
    return _System(first, second, error, gram / unit, unit.sqrt())


def _camera(system: _System, depths: Tensor) -> Tensor:
    """(4, *, B) -> (3, 4, *, B)"""
    z = depths.unbind(0)
    shape = (4, *(1,) * (depths.ndim - 2), -1)
    x = _dot([m.view(shape) for m in system.first.unbind(0)], z)
    y = _dot([m.view(shape) for m in system.second.unbind(0)], z)
    return torch.stack((x, y, depths))


def _solve(matrix: Sequence[_Parts], rhs: _Parts, sizes: tuple[int, ...]) -> list[list[Tensor]]:
    n = len(rhs)
    rows = [list(row) for row in matrix]
    rest = list(rhs)
    tolerance = 16 * torch.finfo(rest[0].dtype).eps
    limits = [(tolerance * rows[i][i]).clamp(min=torch.finfo(rest[0].dtype).tiny) for i in range(n)]
    lower, inverse = {}, []
    for k in range(n):
        inverse.append(rows[k][k].maximum(limits[k]).reciprocal())
        for i in range(k + 1, n):
            factor = rows[i][k] * inverse[k]
            lower[i, k] = factor
            for j in range(k + 1, i + 1):
                rows[i][j] = torch.addcmul(rows[i][j], factor, rows[j][k], value=-1)
            rest[i] = torch.addcmul(rest[i], factor, rest[k], value=-1)
    scaled = [x * y for x, y in zip(rest, inverse, strict=True)]
    solutions = []
    for size in sizes:
        solution = scaled[:size]
        for i in range(size - 1, 0, -1):
            for k in range(i):
                solution[k] = torch.addcmul(solution[k], lower[i, k], solution[i], value=-1)
        solutions.append(solution)
    return solutions


def _eigen(matrix: Sequence[_Parts]) -> list[Tensor]:
    """[(4, B)] value and vector, ascending"""
    a = [list(row) for row in matrix]
    one, zero = torch.ones_like(a[0][0]), torch.zeros_like(a[0][0])
    vectors = [torch.stack([one if i == j else zero for i in range(3)]) for j in range(3)]
    tiny = torch.finfo(one.dtype).tiny
    for _ in range(2):
        for p, q, r in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            twice = a[p][q] + a[p][q]
            diff = a[q][q] - a[p][p]
            root = torch.addcmul(diff * diff, twice, twice).sqrt() + tiny
            t = twice / (diff + root.copysign(diff))
            c = torch.addcmul(one, t, t).rsqrt()
            s = t * c
            shift = t * a[p][q]
            a[p][p] = a[p][p] - shift
            a[q][q] = a[q][q] + shift
            rp, rq = a[r][p], a[r][q]
            a[p][q] = a[q][p] = zero
            rp, rq = torch.addcmul(c * rp, s, rq, value=-1), torch.addcmul(c * rq, s, rp)
            a[p][r] = a[r][p] = rp
            a[q][r] = a[r][q] = rq
            vp, vq = vectors[p], vectors[q]
            vectors[p], vectors[q] = torch.addcmul(c * vp, s, vq, value=-1), torch.addcmul(c * vq, s, vp)
    pairs = [torch.cat((a[i][i][None], vectors[i])) for i in range(3)]
    for i, j in ((0, 1), (1, 2), (0, 1)):
        swap = pairs[i][0] > pairs[j][0]
        pairs[i], pairs[j] = torch.where(swap, pairs[j], pairs[i]), torch.where(swap, pairs[i], pairs[j])
    return pairs


def _starts(system: _System, planar: Tensor) -> Tensor:
    """(4, 4 cases, B)"""
    first, second, error, gram, _ = system
    spread = error[0, 0] + (first[0, 1:].square() + second[0, 1:].square()).sum(0)
    eye = torch.eye(3, dtype=gram.dtype, device=gram.device)[..., None]
    inner = torch.addcmul(error[1:, 1:], _PRIOR * spread, 1.1 * eye - gram)
    rows = [list(row.unbind(0)) for row in inner.unbind(0)]
    rows[2][2] = torch.where(planar, spread, rows[2][2])
    floor = torch.finfo(spread.dtype).eps * spread
    usual = torch.zeros_like(first[0, 1:])  # (3, B)
    directions = []
    for pair in _eigen(rows):
        value, direction = pair[0], pair[1:]
        along = _dot(error[0, 1:], direction) / value.maximum(floor)
        usual = torch.addcmul(usual, along, direction, value=-1)
        directions.append(direction)
    one = torch.ones_like(spread)
    zero = torch.zeros_like(spread)
    top = torch.stack((one, zero, zero, zero))
    basis = torch.cat((top[None], torch.stack((usual, *directions), 1)))  # (4, 4 vectors, B)
    camera = _camera(system, basis)[:, 1:]  # (3 c, 3 k, 4 m, B)
    left = camera[:, [k for k, _ in _EDGES]].unbind(2)  # (3, 6, B) each
    right = camera[:, [l for _, l in _EDGES]].unbind(2)
    columns = []
    for m, n in _PRODUCTS:
        column = _dot(left[m], right[n])
        columns.append(column if m == n else column + _dot(left[n], right[m]))  # (6, B)
    double = torch.tensor([1.0, 1.0, 1.0, 2.0, 2.0, 2.0], dtype=gram.dtype, device=gram.device)[:, None]
    entries = torch.stack(columns, 1).unbind(0)  # 6 of (6 columns, B)
    normal = [_dot((double * c).unbind(0), entries).unbind(0) for c in columns]
    target = torch.stack([gram[k, l] for k, l in _EDGES]) * double
    rhs = _dot(target, entries).unbind(0)
    x1, x2, x3, x4 = _solve(normal, rhs, (1, 3, 5, 6))
    leading = torch.stack((x1[0], x2[0], x3[0], x4[0]))  # (4, B)
    sign = leading.sign()
    b1 = leading.abs().clamp(min=torch.finfo(zero.dtype).eps).sqrt()
    mixed = torch.stack((zero, x2[1], x3[1], x4[1])) * sign
    b2 = (torch.stack((zero, x2[2], x3[2], x4[2])) * sign).clamp(min=0).sqrt().copysign(mixed)
    inverse = sign / b1
    b3 = torch.stack((zero, zero, x3[3], x4[3])) * inverse
    b4 = torch.stack((zero, zero, zero, x4[5])) * inverse
    return _dot(basis[:, :, None].unbind(1), (b1, b2, b3, b4))


def _gauss_newton(system: _System, depths: Tensor, weight: float, iterations: int) -> Tensor:
    """(4, *, B)"""
    shape = (4, *(1,) * (depths.ndim - 2), -1)
    first = [x.view(shape) for x in system.first.unbind(0)]
    second = [x.view(shape) for x in system.second.unbind(0)]
    prior = [0.5 * weight * x.view(shape) for x in system.error.unbind(0)]
    first_inner, second_inner = ([x[1:] for x in rows] for rows in (first, second))
    axes = torch.eye(4, dtype=depths.dtype, device=depths.device)[1:].view(3, *shape[:-1], 1)
    target = [[-x for x in row.unbind(0)] for row in system.gram.unbind(0)]
    for _ in range(iterations):
        depth = depths.unbind(0)
        x, y, z = _dot(first_inner, depth).unbind(0), _dot(second_inner, depth).unbind(0), depth[1:]
        normal = list(prior)
        gradient = _dot(prior, depth)
        for k, l in _EDGES:
            misfit = torch.addcmul(target[k][l], x[k], x[l])
            misfit = torch.addcmul(misfit, y[k], y[l])
            misfit = torch.addcmul(misfit, z[k], z[l])
            slope = x[k] * first[l + 1]
            slope = torch.addcmul(slope, y[k], second[l + 1])
            slope = torch.addcmul(slope, z[k], axes[l])
            factor = 2.0
            if k != l:
                slope = torch.addcmul(slope, x[l], first[k + 1])
                slope = torch.addcmul(slope, y[l], second[k + 1])
                slope = torch.addcmul(slope, z[l], axes[k])
                factor = 1.0
            normal = [torch.addcmul(row, s, slope, value=factor) for row, s in zip(normal, slope.unbind(0), strict=True)]
            gradient = torch.addcmul(gradient, slope, misfit)
        (step,) = _solve([row.unbind(0) for row in normal], gradient.unbind(0), (4,))
        depths = depths - torch.stack(step)
    return depths


def _frame(vectors: _Parts) -> list[Tensor]:
    one, two, _ = vectors
    tiny = torch.finfo(one.dtype).tiny
    one = one * (_dot(one, one) + tiny).rsqrt()
    two = torch.addcmul(two, _dot(one, two), one, value=-1)
    two = two * (_dot(two, two) + tiny).rsqrt()
    (a, b, c), (d, e, f) = one.unbind(0), two.unbind(0)
    three = torch.stack([torch.addcmul(p * q, r, s, value=-1) for p, q, r, s in ((b, f, c, e), (c, d, a, f), (a, e, b, d))])
    return [one, two, three]


def _best(system: _System, depths: Tensor, vectors: Tensor, control: ControlPoints, plane_points: Tensor) -> Tensor:
    """camera (3, 4, H, B) -> (B,) index"""
    a = control.coordinates.permute(2, 1, 0).unbind(0)[1:]
    weights = control.weights.mT
    u, v = (-plane_points).unbind(0)
    depths = depths * depths[0].sign()
    camera = _camera(system, depths).unbind(1)  # 4 of (3, H, B)
    axes = _frame(camera[1:])
    world = vectors.unbind(1)
    world_axes = _frame(world)
    turned = [_dot([_dot(axis, vector) for axis in world_axes], axes) for vector in world]  # (3, H, B)
    costs = []
    for h in range(depths.shape[1]):
        origin = camera[0][:, h].unbind(0)
        parts = [t[:, h].unbind(0) for t in turned]
        points = []
        for c in range(3):
            point = torch.addcmul(origin[c], a[0], parts[0][c])
            point = torch.addcmul(point, a[1], parts[1][c])
            points.append(torch.addcmul(point, a[2], parts[2][c]))
        x, y, z = points
        inverse = z.reciprocal()
        x = torch.addcmul(u, x, inverse)
        y = torch.addcmul(v, y, inverse)
        error = torch.addcmul(x * x, y, y).clamp(max=_MAX_SQ_RESIDUAL)
        error = torch.where(z > 0, error, _MAX_SQ_RESIDUAL)
        costs.append((error * weights).sum(0))
    return torch.stack(costs).argmin(0)


def _attach(system: _System, depths: Tensor, weight: float) -> Tensor:
    """Give the depths the gradient of the minimum: one Newton step of size 0."""
    camera = _camera(system, depths)[:, 1:]  # (3, 3 k, B)
    misfit = _product(camera.transpose(0, 1), camera) - system.gram  # (3, 3, B)
    force = 2.0 * _product(camera, misfit)  # (3, 3, B)
    first, second = system.first[1:], system.second[1:]  # (3, 4, B)
    gradient = _dot(force[0], first) + _dot(force[1], second) + weight * _dot(system.error, depths[:, None])
    gradient = gradient + torch.cat((torch.zeros_like(depths[:1]), force[2]))
    with torch.no_grad():
        eye = torch.eye(4, dtype=depths.dtype, device=depths.device)[1:, :, None].expand_as(first)
        slope = torch.stack((first, second, eye))  # (3 c, 3 k, 4, B)
        normal = weight * system.error
        inner = _dot(camera[:, :, None, None], slope[:, None])  # (3 k, 3 l, 4, B): D'T
        both = inner + inner.transpose(0, 1)
        normal = normal + (both[:, :, :, None] * both[:, :, None]).sum((0, 1))
        bent = _dot(misfit[:, :, None, None], slope.transpose(0, 1)[:, None])  # (3 l, 3 c, 4, B)
        normal = normal + 2.0 * (slope.transpose(0, 1)[:, :, :, None] * bent[:, :, None]).sum((0, 1))
    step = solve_damped(normal.permute(2, 0, 1), gradient.mT, torch.zeros((), dtype=depths.dtype, device=depths.device))[0].mT
    return depths - step + step.detach()


class EPnP(nn.Module):
    def __init__(self, *, iterations: int = 2, polish: int = 4, algebraic_weight: float = 0.3, planar_ratio: float = 1e-3) -> None:
        super().__init__()
        self.config = {"iterations": iterations, "polish": polish, "algebraic_weight": algebraic_weight}
        self.iterations = iterations
        self.polish = polish
        self.weight = algebraic_weight
        self.planar_ratio = planar_ratio

    def forward(self, corr: Correspondences) -> Guess:
        control = control_points(corr, planar_ratio=self.planar_ratio)
        plane_points = (corr.img_points.permute(2, 1, 0) / corr.focal).contiguous()  # (2, N, B)
        system = _system(control, plane_points)
        vectors = control.points[:, 1:].permute(2, 1, 0) / system.unit  # (3, 3, B)
        with torch.no_grad():
            candidates = _gauss_newton(system, _starts(system, control.planar), self.weight, self.iterations)
            best = _best(system, candidates, vectors, control, plane_points)
            depths = candidates.gather(1, best.expand(4, 1, -1))[:, 0]
            depths = _gauss_newton(system, depths, self.weight, self.polish)
        if torch.is_grad_enabled() and system.error.requires_grad:
            depths = _attach(system, depths, self.weight)
        camera = _camera(system, torch.where(depths[0] < 0, -depths, depths))
        affine = camera[:, 1:]  # (3, 3, B): columns are vectors
        rotation, unique = nearest_rotation(_product(affine, vectors.transpose(0, 1)))
        size = affine.square().sum((0, 1))
        scale = (_product(rotation, vectors) * affine).sum((0, 1)) / torch.where(size > 0, size, 1.0)
        offset = _dot(rotation.transpose(0, 1), control.points[:, 0].mT)
        translation = camera[:, 0] * (scale * system.unit) - offset
        count = (corr.weights > 0).sum(-1)
        ok = control.ok & unique & (count >= 4)
        pose = Pose(rotation.permute(2, 0, 1).contiguous(), translation.mT.contiguous())
        return Guess(pose, torch.ones_like(corr.weights), ok)
