r"""The distances of three points from a camera that sees the directions to them, for whole batches.

The unknowns are the distances :math:`\lambda_k` of the points along their unit rays. The law of cosines for the edge
:math:`k`, the one opposite to point :math:`k` with the ends :math:`i` and :math:`j`, is

.. math:: (\lambda_i - \lambda_j)^2 + b_k \lambda_i \lambda_j = a_k,

with the squared length :math:`a_k` of the edge and the squared length :math:`b_k` of the difference of the two rays.
(:math:`b_k` keeps the digits that :math:`2 - 2\cos` loses between rays close to each other.) A sum of the three
equations with weights :math:`u` such that :math:`a \cdot u = 0` is a conic in the ratios of the distances. The conic
is a pair of lines when

.. math:: (u_1 u_2 + u_2 u_3 + u_3 u_1)\,(s \cdot u) = g\, u_1 u_2 u_3,

with the squared sine :math:`s_k` of the angle of two rays and the squared determinant :math:`g` of all three rays. One
root of this cubic gives two lines, and each line meets the other conics in two points. A Newton step then refines the
ratios.

Sources: M. Persson and K. Nordberg, "Lambda Twist", ECCV 2018, for the route by one degenerate conic; Y. Ding, J. Yang,
V. Larsson, C. Olsson and K. Åström, "Revisiting the P3P Problem", CVPR 2023, for how the roots of the cubic determine
the solutions and for the lines from the adjugate matrix. The short form of the cubic, the choice of its root and the
lines in differences of distances are ours.

Everything is computed by components, (C,) numbers at a time. A choice between two finite values is a ``lerp`` with a
weight of exactly 0 or 1, which returns exactly one of the values: with an unpredictable mask, ``where`` takes a CPU ten
times as long.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TypeAlias

import torch
from torch import Tensor

from kornia_pnpnet.core.performance import exporting

__all__ = ["Triple", "Turn", "distances", "greater", "turn_to_largest", "turned"]

# Number of Newton steps for the root of the cubic: from an error of a tenth at the start to rounding in float64.
_CUBIC_STEPS = 4
# Power of the machine epsilon. The last Newton step fades out where its squared determinant is less than this power, in
# squared edges: there two solutions meet, and the step would be noise.
_DAMPING_POWER = 1.25

#: One number per point or edge, (*, C) each.
Triple: TypeAlias = tuple[Tensor, Tensor, Tensor]
#: Weights 0.0 or 1.0 (C,): whether to rotate a triple by one place, and by two places.
Turn: TypeAlias = tuple[Tensor, Tensor]


def greater(first: Tensor, second: Tensor) -> Tensor:
    """1.0 where the first is greater, else 0.0."""
    return torch.gt(first, second, out=torch.empty_like(first))


def turn_to_largest(first: Tensor, second: Tensor, third: Tensor) -> Turn:
    """The turn that brings the largest of three numbers (C,) to the front."""
    return greater(second, first), greater(third, torch.maximum(first, second))


def turned(triple: Sequence[Tensor], turn: Turn) -> Triple:
    """Turn the triple of each problem."""
    x, y, z = triple
    by1, by2 = turn
    return x.lerp(y, by1).lerp_(z, by2), y.lerp(z, by1).lerp_(x, by2), z.lerp(x, by1).lerp_(y, by2)


def _turned_back(triple: Triple, turn: Turn) -> Triple:
    """Undo :func:`turned`."""
    x, z, y = turned((triple[0], triple[2], triple[1]), turn)
    return x, y, z


def _sqrt(square: Tensor) -> Tensor:
    """The square root of a positive number, faster than ``torch.sqrt``."""
    return square.rsqrt().mul_(square)


def _signed(size: Tensor, sign: Tensor) -> Tensor:
    """Give a positive number, which is overwritten, the sign of another number."""
    if exporting():  # ONNX has no `copysign`
        return torch.where(sign < 0, -size, size)
    return size.copysign_(sign)


def _isolated_root(k3: Tensor, k2: Tensor, k1: Tensor, k0: Tensor) -> tuple[Tensor, Tensor]:
    """The real root, as a ratio ``u : v``, of a cubic form (C,) that is farthest from the other two roots.

    Where two solutions of the P3P problem are close, two roots are close, too. The third root, which is returned, then
    has both solutions on one of its lines.
    """
    tiny = torch.finfo(k3.dtype).tiny
    k = k3, k2, k1, k0
    sizes = [x.abs() for x in k]
    inv = functools.reduce(torch.maximum, sizes).clamp_(min=tiny).reciprocal_()
    k3, k2, k1, k0 = (x * inv for x in k)
    # Swap u and v where two roots could be at infinity.
    swap = greater(sizes[2], sizes[1])
    k3, k0 = k3.lerp(k0, swap), k0.lerp(k3, swap)
    k2, k1 = k2.lerp(k1, swap), k1.lerp(k2, swap)
    # x = k3 u / v + k2 / 3 solves x³ = 3 p x + 2 q. The root is the outermost one, of the sign of q.
    third = k2 * (1 / 3)
    k31, sq_third = k3 * k1, third * third
    p = torch.add(sq_third, k31, alpha=-1 / 3)
    q = torch.sub(k31, sq_third, alpha=2).mul_(third).addcmul_(k3 * k3, k0, value=-1.0).mul_(0.5)
    size = q.abs()
    pure = (2.0 * size).pow_(2 / 3).clamp_(min=tiny)  # x² if p were 0
    up = p.clamp(min=0.0)
    x = _sqrt(torch.add(pure, up, alpha=3)).mul_(pure).div_(pure.add_(up.sub_(p), alpha=2.2))  # within a tenth
    for _ in range(_CUBIC_STEPS):
        sq_x = x * x
        x = torch.addcmul(size, sq_x, x).mul_(2 / 3).div_(sq_x.sub_(p).clamp_(min=tiny))
    u, v = _signed(x, q).sub_(third), k3
    inv = torch.maximum(u.abs(), v.abs()).clamp_(min=tiny).reciprocal_()
    u, v = u.mul_(inv), v * inv
    return u.lerp(v, swap), v.lerp(u, swap)


def _lines(u: Triple, h: Triple, pairs: Tensor) -> tuple[Tensor, Tensor]:
    r"""The two lines (2, C) that form the conic with the weights ``u``, of which ``u[1] + u[2]`` is not small.

    The lines are :math:`\lambda_1 - \lambda_3 = \text{slope}\,(\lambda_2 - \lambda_3) + \text{offset}\,\lambda_3`.

    Args:
        u: root of the cubic, (C,) each.
        h: :math:`1 - \cos` of the angles between the rays, (C,) each.
        pairs: first factor of the cubic, :math:`u_1 u_2 + u_2 u_3 + u_3 u_1`, (C,).
    """
    u1, u2, u3 = u
    h1, h2, h3 = h
    tiny = torch.finfo(pairs.dtype).tiny
    # The matrix D of the conic has u_2 + u_3, u_3 + u_1, u_1 + u_2 on its diagonal and -u_k cos_k beside it. The lines
    # cross in m with m mᵀ = -adj D. The matrices D + [m]ₓ and D - [m]ₓ have rank one; their first rows are the lines.
    uh2, uh3 = u2 * h2, u3 * h3
    e1, e2, e3 = torch.addcmul(u1, u1, h1, value=-1.0), u2 - uh2, u3 - uh3
    d11 = u2 + u3
    inv = d11 / (d11 * d11).add_(tiny)
    us2 = (u2 * u2).mul_(torch.addcmul(2.0 * h2, h2, h2, value=-1.0))
    us3 = (u3 * u3).mul_(torch.addcmul(2.0 * h3, h3, h3, value=-1.0))
    sq_m2, sq_m3 = ((us + pairs).neg_().clamp_(min=tiny) for us in (us2, us3))
    large = _sqrt(torch.maximum(sq_m2, sq_m3))
    # The bound matters where the lines are not real.
    least = -large
    small = (e1 * d11).addcmul_(e2, e3).neg_().div_(large).clamp_(least, large)
    third = greater(sq_m3, sq_m2)
    m2, m3 = large.lerp(small, third), small.lerp(large, third)
    # m_3 - m_2 from the difference of the squares, which keeps more digits, unless the signs differ.
    same_sign = greater(small, torch.zeros_like(small))
    apart = us2.sub_(us3).div_((m2 + m3).abs_().clamp_(min=tiny**0.5)).clamp_(least, large)
    apart = (m3 - m2).lerp_(apart, same_sign)
    bend = uh2.add_(uh3).neg_()
    sign = 1.0 - 2.0 * torch.arange(2, dtype=pairs.dtype, device=pairs.device)[:, None]
    return torch.addcmul(e3, sign, m3).mul_(inv), torch.addcmul(bend, sign, apart).mul_(inv)


def _meet(slope: Tensor, offset: Tensor, v: Triple, h: Triple) -> Triple:
    """The points where lines (2, C) meet the conic with the weights ``v`` (C,): distances (2, 2, C) up to scale.

    A line that misses the conic counts as touching it. Where a line touches the conic, the second point is 0.
    """
    v1, v2, v3 = v
    h1, h2, h3 = h
    # Coefficients of y², 2 y and 1 in y = (λ_2 - λ_3) / λ_3.
    v2_slope, less = slope * v2, slope - 1.0
    c2 = (less * less).addcmul_(slope, h3, value=2.0).mul_(v3).addcmul_(v2_slope, slope).add_(v1)
    c1 = (slope + offset).mul_(h3).add_(h3).addcmul_(less, offset).mul_(v3)
    c1.addcmul_(v2_slope, offset + h2).addcmul_(v1, h1)
    vh23 = (v2 * h2).addcmul_(v3, h3).mul_(2.0)
    c0 = (offset * offset).mul_(v2 + v3).addcmul_(offset, vh23).add_(vh23.addcmul_(v1, h1, value=2.0))
    disc = (c1 * c1).addcmul_(c2, c0, value=-1.0)
    two = greater(disc, torch.zeros_like(disc))
    z = _signed(_sqrt(disc.clamp_(min=torch.finfo(disc.dtype).tiny)), c1).add_(c1).neg_()
    second = torch.arange(2, dtype=z.dtype, device=z.device)[:, None, None]
    y, dist3 = z.lerp(c0.mul_(two), second), c2.lerp(z * two, second)
    dist1 = torch.addcmul(dist3, slope, y).addcmul_(offset, dist3)
    return dist1, y.add_(dist3), dist3


def _candidates(p: Tensor, q: Tensor, r: Tensor, b: Triple, g: Tensor) -> Triple:
    """Solutions of the equations of :func:`distances` up to rounding."""
    h1, h2, h3 = (0.5 * x for x in b)
    s1, s2, s3 = (torch.addcmul(x, y, y, value=-1.0) for x, y in zip(b, (h1, h2, h3), strict=True))
    # With u_1 = -(p u_3 + q u_2) the cubic is one in u_3 : u_2, and s · u = t_3 u_3 + t_2 u_2.
    t3, t2 = s3.addcmul_(p, s1, value=-1.0), s2.addcmul_(q, s1, value=-1.0)
    k2, k1 = (r * t3).addcmul_(p, g - t2), (r * t2).addcmul_(q, g - t3)
    u3, u2 = _isolated_root((p * t3).neg_(), k2, k1, (q * t2).neg_())
    u1 = (p * u3).addcmul_(q, u2).neg_()
    pairs = (u2 * u3).addcmul_(u1, u2 + u3)
    turn = turn_to_largest((u2 + u3).abs_(), (u3 + u1).abs_(), (u1 + u2).abs_())
    # Intersect the lines with the conic whose weights are orthogonal to u: (p u_2 - q u_3, u_3, -u_2).
    v = (p * u2).addcmul_(q, u3, value=-1.0), u3, -u2
    u, v, h = (turned(x, turn) for x in ((u1, u2, u3), v, (h1, h2, h3)))
    slope, offset = _lines(u, h, pairs)
    return _turned_back(_meet(slope, offset, v, h), turn)


def _refined(candidates: Triple, p: Tensor, q: Tensor, b: Triple) -> Triple:
    """Take one Newton step on the ratios of the distances."""
    dist1, dist2, dist3 = candidates
    h1, h2, h3 = (0.5 * x for x in b)
    d1, d2, d3 = dist2 - dist3, dist3 - dist1, dist1 - dist2
    # The squared edges e; the equations are e2 = q e1 and e3 = p e1.
    e1 = (d1 * d1).addcmul_(b[0], dist2 * dist3)
    e2 = (d2 * d2).addcmul_(b[1], dist3 * dist1)
    e3 = (d3 * d3).addcmul_(b[2], dist1 * dist2)
    r2, r3 = torch.addcmul(e2, q, e1, value=-1.0), torch.addcmul(e3, p, e1, value=-1.0)
    # Half the derivatives: of e1 by dist2, of -e1 by dist3, of e2 by dist3, of -e3 by dist2; from these, of -r2 and -r3
    # by dist2 (r22, r32), and of r2 and r3 by dist3 (r23, r33).
    e12, e13 = torch.addcmul(d1, h1, dist3), d1.addcmul_(h1, dist2, value=-1.0)
    e23, e32 = d2.addcmul_(h2, dist1), d3.addcmul_(h3, dist1, value=-1.0)
    r22, r23 = q * e12, e23.addcmul_(q, e13)
    r32, r33 = e32.addcmul_(p, e12), e13.mul_(p)
    det = (r23 * r32).addcmul_(r22, r33, value=-1.0)
    finfo = torch.finfo(det.dtype)
    inv = det.div_((det * det).addcmul_(e2, e3, value=finfo.eps**_DAMPING_POWER).add_(finfo.tiny))
    step2 = (r2 * r33).addcmul_(r3, r23, value=-1.0)
    step3 = r2.mul_(r32).addcmul_(r3, r22, value=-1.0)
    return dist1, torch.addcmul(dist2, step2, inv, value=-0.5), torch.addcmul(dist3, step3, inv, value=-0.5)


def distances(p: Tensor, q: Tensor, r: Tensor, b: Triple, g: Tensor) -> Triple:
    r"""Solve the law of cosines for a triangle whose edge 1 is the longest edge and has the length 1.

    Args:
        p: squared edge 3, shape :math:`(C,)`.
        q: squared edge 2, shape :math:`(C,)`.
        r: :math:`1 - p - q`, which the caller may know with more digits, shape :math:`(C,)`.
        b: squared difference of the two rays to the ends of each edge, three of shape :math:`(C,)`.
        g: squared determinant of the three rays, shape :math:`(C,)`.

    Returns:
        Four candidates for the distances, :math:`(2, 2, C)` for each point. The first distance is not negative. A
        candidate that is no solution with positive distances is finite.

    Example:
        >>> one = torch.ones(1, dtype=torch.float64)  # the camera at the corner of a cube, points at its neighbours
        >>> first, second, third = distances(one, one, -one, (2.0 * one,) * 3, one)
        >>> torch.stack((first, second, third)).amax((1, 2)).round(decimals=6).flatten()
        tensor([0.7071, 0.7071, 0.7071], dtype=torch.float64)
    """
    dist1, dist2, dist3 = _refined(_candidates(p, q, r, b, g), p, q, b)
    edge = dist2 - dist3
    sq_edge = edge.mul_(edge).addcmul_(b[0], dist2 * dist3)
    scale = _signed(sq_edge.clamp_(min=torch.finfo(p.dtype).tiny ** 0.5).rsqrt_(), dist1)
    return dist1 * scale, dist2.mul_(scale), dist3.mul_(scale)
