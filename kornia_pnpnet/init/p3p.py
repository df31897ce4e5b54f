r"""P3P: the up to four poses that see three points where they were seen, for whole batches at once."""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from kornia.core.exceptions import ShapeError
from torch import Tensor, nn

from kornia_pnpnet.types import Correspondences, Hypotheses, Pose

__all__ = ["P3P", "p3p"]

# Problems that are solved together: what they need stays in a core's second-level cache.
_CHUNK = 4096


def _select(first: Tensor, second: Tensor, is_second: Tensor) -> Tensor:
    """`torch.where` for finite values and a mask of zeros and ones, which is several times faster on a CPU."""
    return torch.lerp(first, second, is_second)


def _cycle(shift1: Tensor, shift2: Tensor, items: tuple[Tensor, ...]) -> list[Tensor]:
    a, b, c = items
    return [_select(_select(x, y, shift1), z, shift2) for x, y, z in ((a, b, c), (b, c, a), (c, a, b))]


def _sq_norm(v: list[Tensor]) -> Tensor:
    return torch.addcmul(torch.addcmul(v[0] * v[0], v[1], v[1]), v[2], v[2])


def _dot(v: list[Tensor], w: list[Tensor]) -> Tensor:
    return torch.addcmul(torch.addcmul(v[0] * w[0], v[1], w[1]), v[2], w[2])


def _cross(v: list[Tensor], w: list[Tensor]) -> list[Tensor]:
    return [torch.addcmul(v[i] * w[j], v[j], w[i], value=-1) for i, j in ((1, 2), (2, 0), (0, 1))]


def _sub(v: list[Tensor], w: list[Tensor]) -> list[Tensor]:
    return [a - b for a, b in zip(v, w, strict=True)]


def _largest(values: list[Tensor], dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    is1 = (values[1] > values[0]).to(dtype)
    most = torch.maximum(values[0], values[1])
    is2 = (values[2] > most).to(dtype)
    return is1, is2


def _isolated_root(k3: Tensor, k2: Tensor, k1: Tensor, k0: Tensor) -> tuple[Tensor, Tensor]:
    tiny = torch.finfo(k3.dtype).tiny
    high, low = torch.maximum(k3.abs(), k2.abs()), torch.maximum(k0.abs(), k1.abs())
    swap = (low > high).to(k3.dtype)
    inv = torch.maximum(high, low).clamp(min=tiny).reciprocal()
    k3, k0 = _select(k3, k0, swap) * inv, _select(k0, k3, swap) * inv
    k2, k1 = _select(k2, k1, swap) * inv, _select(k1, k2, swap) * inv
    h = k2 * (1 / 3)
    k13 = k1 * k3
    H = h * h - k13 * (1 / 3)
    R = -0.5 * (h * (2 * h * h - k13) + k0 * k3 * k3)
    absR = R.abs()
    disc = R * R - H * H * H
    root = disc.abs().sqrt()
    A = (absR + disc.clamp(min=0).sqrt()).clamp(min=tiny).pow(1 / 3)
    one = A + H / A
    three = 2 * H.clamp(min=0).sqrt() * (torch.atan2(root, absR) * (1 / 3)).cos()
    y = torch.where(disc < 0, three, one)
    x = torch.copysign(y, R)
    u, v = x - h, k3
    inv = torch.maximum(u.abs(), v.abs()).clamp(min=tiny).reciprocal()
    u, v = u * inv, v * inv
    k2v, k1v, k0v = k2 * v, k1 * v * v, k0 * v * v * v
    for _ in range(2):
        f = ((k3 * u + k2v) * u + k1v) * u + k0v
        df = (3 * k3 * u + 2 * k2v) * u + k1v
        safe = df.abs() > tiny
        u = u - torch.where(safe, f / torch.where(safe, df, 1.0), 0.0)
    return _select(u, v, swap), _select(v, u, swap)


def _depth_ratios(a, s, G, C):
    """Four candidates for the ratios of the depths."""
    dtype = G.dtype
    tiny = torch.finfo(dtype).tiny
    a1, a2, a3 = a
    s1, s2, s3 = s
    p, q = a3 / a1, a2 / a1
    r = 1 - p - q
    l1, l2 = s3 - p * s1, s2 - q * s1
    k3, k0 = -p * l1, -q * l2
    k2 = r * l1 + p * (G - l2)
    k1 = r * l2 + q * (G - l1)
    u, v = _isolated_root(k3, k2, k1, k0)
    scale = torch.maximum(u.abs(), v.abs()).clamp(min=tiny).reciprocal()
    u, v = u * scale, v * scale
    w = -(p * u + q * v)
    e2 = r * u * v - p * u * u - q * v * v
    U, V = (w, v, u), (p * v - q * u, u, -v)
    shift = _largest([(U[1] + U[2]).abs(), (U[2] + U[0]).abs(), (U[0] + U[1]).abs()], dtype)
    U = _cycle(*shift, U)
    V = _cycle(*shift, V)
    C = _cycle(*shift, C)
    inv_dii = (U[1] + U[2]).reciprocal()
    inv_dii = torch.where(inv_dii.isfinite(), inv_dii, 0.0)
    E = [U[i] * C[i] for i in range(3)]
    Bjj = (U[1] * U[1] * (C[1] * C[1] - 1) - e2).clamp(min=0)
    Bkk = (U[2] * U[2] * (C[2] * C[2] - 1) - e2).clamp(min=0)
    Bjk = -(E[0] * (U[1] + U[2]) + E[1] * E[2])
    P = torch.maximum(Bjj, Bkk).sqrt()
    Q = Bjk / P.clamp(min=tiny**0.5)
    kbig = (Bkk > Bjj).to(dtype)
    pj, pk = _select(P, Q, kbig), _select(Q, P, kbig)
    gj = torch.stack((E[2] + pk, E[2] - pk)) * inv_dii  # (2, C)
    gk = torch.stack((E[1] - pj, E[1] + pj)) * inv_dii
    Fi, Fj, Fk = (V[i] * C[i] for i in range(3))
    Dii, Djj, Dkk = V[1] + V[2], V[2] + V[0], V[0] + V[1]
    Ajj = (Dii * gj - 2 * Fk) * gj + Djj
    Akk = (Dii * gk - 2 * Fj) * gk + Dkk
    Ajk = (Dii * gj - Fk) * gk - Fj * gj - Fi
    disc = Ajk * Ajk - Ajj * Akk
    z = -(Ajk + torch.copysign(disc.clamp(min=0).sqrt(), Ajk))
    lj, lk = torch.cat((z, Akk)), torch.cat((Ajj, z))  # (4, C)
    li = torch.cat((gj, gj)) * lj + torch.cat((gk, gk)) * lk
    sign = torch.copysign(torch.ones_like(lj), lj)
    lam = _cycle(shift[0], shift[1], (li, lj, lk))
    # undo the cycle: shifting by 1 is undone by 2
    li, lj, lk = li * sign, lj * sign, lk * sign
    lam = [
        _select(_select(x, y, shift[0] * (1 - shift[1])), zz, shift[1])
        for x, y, zz in ((li, lk, lj), (lj, li, lk), (lk, lj, li))
    ]
    real = disc > -1e-9 * Ajk * Ajk
    real = torch.cat((real, disc > 0))
    return lam, real


def _newton(lam, a, b):
    l1, l2, l3 = lam
    d1, d2, d3 = l2 - l3, l3 - l1, l1 - l2
    r1 = torch.addcmul(d1 * d1 - a[0], b[0], l2 * l3)
    r2 = torch.addcmul(d2 * d2 - a[1], b[1], l3 * l1)
    r3 = torch.addcmul(d3 * d3 - a[2], b[2], l1 * l2)
    h1, h2, h3 = (0.5 * x for x in b)
    A1, B1 = torch.addcmul(d1, h1, l3), torch.addcmul(-d1, h1, l2)
    A2, B2 = torch.addcmul(d2, h2, l1), torch.addcmul(-d2, h2, l3)
    A3, B3 = torch.addcmul(d3, h3, l2), torch.addcmul(-d3, h3, l1)
    A12, A23, A31 = A1 * A2, A2 * A3, A3 * A1
    B12, B23, B31 = B1 * B2, B2 * B3, B3 * B1
    det = A12 * A3 + B12 * B3
    safe = det.abs() > torch.finfo(det.dtype).tiny ** 0.5
    inv = torch.where(safe, 0.5 / torch.where(safe, det, 1.0), 0.0)
    x1 = B31 * r2 + A12 * r3 - A2 * B3 * r1
    x2 = B12 * r3 + A23 * r1 - A3 * B1 * r2
    x3 = B23 * r1 + A31 * r2 - A1 * B2 * r3
    return [l1 - x1 * inv, l2 - x2 * inv, l3 - x3 * inv], (r1, r2, r3)


def _frame(y1, y2, y3):
    base, side = _sub(y3, y2), _sub(y1, y2)
    normal = _cross(base, side)
    tiny = torch.finfo(y1[0].dtype).tiny
    i1, i3 = _sq_norm(base).clamp(min=tiny).rsqrt(), _sq_norm(normal).clamp(min=tiny).rsqrt()
    e1, e3 = [x * i1 for x in base], [x * i3 for x in normal]
    return e1, _cross(e3, e1), e3


def _solve_chunk(world: Tensor, plane: Tensor, out: Tensor) -> Tensor:
    """World (C, 3, 3), plane (C, 3, 2); writes (12, 4, C) and returns valid (4, C)."""
    dtype = world.dtype
    eps = torch.finfo(dtype).eps
    soa = torch.cat((world, plane), -1).permute(1, 2, 0).contiguous()  # (3, 5, C)
    good = (soa * 0).sum((0, 1)) == 0
    soa = torch.where(good, soa, 0.0)
    pts = soa.unbind(0)
    edge = [pts[2][:3] - pts[1][:3], pts[0][:3] - pts[2][:3], pts[1][:3] - pts[0][:3]]
    a = [e.square().sum(0) for e in edge]
    shift = _largest(a, dtype)
    pts = _cycle(*shift, tuple(pts))
    a = _cycle(*shift, tuple(a))
    size = a[0]
    sound = good & (size > torch.finfo(dtype).tiny ** 0.5)
    a1 = torch.where(sound, size, 1.0)
    a = [torch.ones_like(a1), a[1] / a1, a[2] / a1]
    X = [list(p[:3].unbind(0)) for p in pts]
    rays = []
    for p in pts:
        x, y = p[3:].unbind(0)
        inv = torch.addcmul(torch.addcmul(torch.ones_like(x), x, x), y, y).rsqrt()
        rays.append([x * inv, y * inv, inv])
    b = [_sq_norm(_sub(rays[j], rays[k])) for j, k in ((1, 2), (2, 0), (0, 1))]
    cr = [_cross(rays[j], rays[k]) for j, k in ((1, 2), (2, 0), (0, 1))]
    s = [_sq_norm(c) for c in cr]
    G = _dot(cr[0], rays[0]).square()
    C = [1 - 0.5 * x for x in b]
    lam, real = _depth_ratios(a, s, G, C)
    l1, l2, l3 = lam
    Q = (
        (l2 - l3).square()
        + b[0] * l2 * l3
        + (l3 - l1).square()
        + b[1] * l3 * l1
        + (l1 - l2).square()
        + b[2] * l1 * l2
    )
    positive = (l1 > 0) & (l2 > 0) & (l3 > 0) & real & sound
    scale = ((a[0] + a[1] + a[2]) / torch.where(positive, Q, 1.0)).sqrt()
    lam = [torch.where(positive, x * scale, 1.0) for x in lam]
    for _ in range(2):
        lam, _ = _newton(lam, a, b)
    _, (r1, r2, r3) = _newton(lam, a, b)
    tol = eps**0.75
    res = r1 * r1 / a[0].clamp(min=eps * eps) + r2 * r2 / a[1].clamp(min=eps * eps) + r3 * r3 / a[2].clamp(min=eps * eps)
    total = lam[0] + lam[1] + lam[2]
    valid = positive & (lam[0] > 0) & (lam[1] > 0) & (lam[2] > 0) & (res <= tol * tol * total * total)
    unit = a1.sqrt()
    lam = [torch.where(valid, x * unit, 1.0) for x in lam]
    Y = [[x * c for c in ray] for x, ray in zip(lam, rays, strict=True)]
    E, F = _frame(*Y), _frame(*X)
    for i in range(3):
        for j in range(3):
            torch.addcmul(torch.addcmul(E[0][i] * F[0][j], E[1][i], F[1][j]), E[2][i], F[2][j], out=out[3 * i + j])
    for i in range(3):
        ti = Y[0][i]
        for j in range(3):
            ti = torch.addcmul(ti, out[3 * i + j], X[0][j], value=-1)
        out[9 + i] = ti
    return valid


@torch.no_grad()
def p3p(world_points: Tensor, plane_points: Tensor) -> Hypotheses:
    r"""Solve minimal problems of three points each.

    Args:
        world_points: shape :math:`(B, 3, 3)`.
        plane_points: :math:`(x/z, y/z)` of the three points in the camera, shape :math:`(B, 3, 2)`.

    Returns:
        Four slots for each problem.
    """
    KORNIA_CHECK_SHAPE(world_points, ["B", "3", "3"])
    KORNIA_CHECK_SHAPE(plane_points, ["B", "3", "2"])
    batch = world_points.shape[0]
    out = world_points.new_empty(12, 4, batch)
    valid = torch.empty(4, batch, dtype=torch.bool, device=world_points.device)
    for start in range(0, batch, _CHUNK):
        part = slice(start, start + _CHUNK)
        valid[:, part] = _solve_chunk(world_points[part], plane_points[part], out[:, :, part])
    rotation = out[:9].unflatten(0, (3, 3)).permute(3, 2, 0, 1)
    return Hypotheses(Pose(rotation, out[9:].permute(2, 1, 0)), valid.mT)


class P3P(nn.Module):
    """Solver of minimal samples of three pairs."""

    sample_size = 3

    def __init__(self) -> None:
        super().__init__()
        self.config: dict[str, object] = {}

    def hypotheses(self, corr: Correspondences) -> Hypotheses:
        """Return the poses of samples of three pairs each."""
        if corr.world_points.shape[1] != self.sample_size:
            raise ShapeError(
                f"P3P needs three pairs, got N = {corr.world_points.shape[1]}.",
                actual_shape=tuple(corr.world_points.shape),
                expected_shape=["B", "3", "3"],
            )
        return p3p(corr.world_points, corr.img_points / corr.focal)
