r"""P3P: all poses (up to four) that project three world points exactly onto three pixels, for batches.

The unknowns are the distances :math:`\lambda_k` from the camera to the points. Edge :math:`k` of the triangle connects
the points :math:`i` and :math:`j`. Let :math:`a_k` be the squared length of the edge, and :math:`b_k` the squared
length of the difference of the unit rays :math:`i` and :math:`j`. The law of cosines is

.. math:: (\lambda_i - \lambda_j)^2 + b_k \lambda_i \lambda_j = a_k.

If weights :math:`u` satisfy :math:`a \cdot u = 0`, the weighted sum of the three equations is a conic in the ratios of
the distances. Let :math:`s_k` be the squared sine of the angle between the rays :math:`i` and :math:`j`. Let :math:`g`
be the squared determinant of the matrix of the three rays. The conic is a pair of lines when

.. math:: (u_1 u_2 + u_2 u_3 + u_3 u_1)\,(s \cdot u) = g\, u_1 u_2 u_3.

One root of this cubic equation gives two lines. Each line intersects a second conic (other weights) in two points. A
Newton step then refines the ratios of the distances.

The last dimension of every tensor has the C problems of a chunk. Finite values are selected by ``lerp`` with a weight
of 0 or 1, because ``torch.where`` with an unpredictable mask is ten times slower on a CPU.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from kornia_pnpnet.core.checks import check_devices, check_form, check_shapes, common_dtype
from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.core.linalg import signed
from kornia_pnpnet.core.performance import compiling, fold_vmap, kept_at_once, unfold_vmap
from kornia_pnpnet.problem import Hypotheses, Problem
from kornia_pnpnet.propose.scoring import as_pose
from kornia_pnpnet.refine.residual import MIN_DEPTH_RATIO
from kornia_pnpnet.result import Pose

__all__ = ["P3P", "minimal_poses", "p3p"]

# A vector with one number per problem of a chunk has this size in bytes. A core's caches hold a few dozen such vectors.
_CHUNK_BYTES = 2**16
# A candidate is a solution if its triangle differs from the world triangle by less than eps^_ERROR_POWER times the
# distance of the camera, and by less than _LARGEST_ERROR. The longest edge of the world triangle has the length 1.
_ERROR_POWER, _LARGEST_ERROR = 2 / 3, 0.01
# Least distance of the camera from a point. The unit is eps^_ERROR_POWER times the longest edge. At a smaller distance,
# rounding errors would decide the direction of the point's ray.
_CLOSE = 64.0
# A triangle counts as a line when its height is below _LINE * eps * sqrt(b^2 + d^2). Here b is the longest edge, and d
# is the distance of the opposite point from the origin.
_LINE = 32.0
# Number of Newton steps for the root of the cubic. The steps reduce a relative error of 37 % to float64 rounding.
_CUBIC_STEPS = 4
# The Newton step of `_refined` is damped if the squared determinant of its linear system is below eps^_DAMPING_POWER
# times the product of two squared edges. When two solutions nearly coincide, rounding errors would dominate an undamped
# step.
_DAMPING_POWER = 1.25
# Number of focal lengths at which `P3P` solves a sample if the focal length is unknown.
_FOCALS = 12


def _greater(first: Tensor, second: Tensor) -> Tensor:
    """1.0 where the first tensor is greater, else 0.0."""
    return torch.gt(first, second, out=torch.empty_like(first))


def _turn_to_largest(values: Tensor) -> tuple[Tensor, Tensor]:
    """Flags (C,): whether the second of three values (3, C) exceeds the first, and whether the third exceeds both."""
    first, second, third = values
    return _greater(second, first), _greater(third, torch.maximum(first, second))


def _turned(triple: Tensor, turn: tuple[Tensor, Tensor], step: int = 1) -> Tensor:
    """Shift triples (3, *, C) as `_turn_to_largest` says: the largest comes first. With ``step=-1``, undo the shift."""
    return triple.lerp(triple.roll(-step, 0), turn[0]).lerp_(triple.roll(step, 0), turn[1])


def _sqrt(square: Tensor) -> Tensor:
    """Square root of positive numbers. This formula is faster than ``torch.sqrt``."""
    return square.rsqrt().mul_(square)


def _isolated_root(k: Tensor) -> tuple[Tensor, Tensor]:
    """Of a cubic form with coefficients (4, C), find the real root ``u : v`` that is farthest from the other two roots.

    Two nearly equal solutions of P3P give two nearly equal roots. The third root gives a line through both solutions.
    """
    tiny = torch.finfo(k.dtype).tiny
    sizes = k.abs()
    k = k * sizes.amax(0).clamp_(min=tiny).reciprocal_()
    # Swap u and v if two roots could be infinite.
    swap = _greater(sizes[2], sizes[1])
    k3, k2, k1, k0 = k.lerp_(k.flip(0), swap)
    # x = k3 u / v + k2 / 3 solves x³ = 3 p x + 2 q. The root with the largest absolute value has the sign of q.
    third = k2 * (1 / 3)
    k31, sq_third = k3 * k1, third * third
    p = torch.add(sq_third, k31, alpha=-1 / 3)
    q = torch.sub(k31, sq_third, alpha=2).mul_(third).addcmul_(k3 * k3, k0, value=-1.0).mul_(0.5)
    size = q.abs()
    pure = (2.0 * size).pow_(2 / 3).clamp_(min=tiny)  # x² if p = 0
    up = p.clamp(min=0.0)
    x = _sqrt(torch.add(pure, up, alpha=3)).mul_(pure).div_(pure.add_(up.sub_(p), alpha=2.2))  # relative error < 37 %
    for _ in range(_CUBIC_STEPS):
        sq_x = x * x
        x = torch.addcmul(size, sq_x, x).mul_(2 / 3).div_(sq_x.sub_(p).clamp_(min=tiny))
    root = torch.stack((signed(x, q).sub_(third), k3))
    root = root * root.abs().amax(0).clamp_(min=tiny).reciprocal_()
    u, v = root.lerp(root.flip(0), swap)
    return u, v


def _lines(u: Tensor, h: Tensor, pairs: Tensor) -> tuple[Tensor, Tensor]:
    r"""Slopes (2, C) and offsets (2, C) of the two lines of the degenerate conic with the weights ``u`` (3, C).

    The lines are :math:`\lambda_1 - \lambda_3 = \text{slope}\,(\lambda_2 - \lambda_3) + \text{offset}\,\lambda_3`.
    The sum ``u[1] + u[2]`` must not be small. ``h`` (3, C) is 1 minus the cosine of each angle between two rays.
    ``pairs`` (C,) is :math:`u_1 u_2 + u_2 u_3 + u_3 u_1`.
    """
    tiny = torch.finfo(pairs.dtype).tiny
    # The matrix D of the conic has u_2 + u_3, u_3 + u_1, u_1 + u_2 on its diagonal and -u_k cos_k off the diagonal. The
    # lines intersect at m, and m mᵀ = -adj D. The first rows of D + [m]ₓ and of D - [m]ₓ are the two lines.
    e1, e2, e3 = torch.addcmul(u, u, h, value=-1.0)
    u, h = u[1:], h[1:]
    d11 = u.sum(0)
    inv = d11 / (d11 * d11).add_(tiny)
    us = (u * u).mul_(torch.addcmul(2.0 * h, h, h, value=-1.0))
    sq_m2, sq_m3 = (us + pairs).neg_().clamp_(min=tiny)
    large = _sqrt(torch.maximum(sq_m2, sq_m3))
    least = -large  # `least` and `large` are bounds that matter only if the lines are not real
    small = (e1 * d11).addcmul_(e2, e3).neg_().div_(large).clamp_(least, large)
    third = _greater(sq_m3, sq_m2)
    m2, m3 = large.lerp(small, third), small.lerp(large, third)
    # If m_2 and m_3 have the same sign, the difference of their squares gives m_3 - m_2 with less rounding.
    same_sign = _greater(small, torch.zeros_like(small))
    apart = (us[0] - us[1]).div_((m2 + m3).abs_().clamp_(min=tiny**0.5)).clamp_(least, large)
    apart = (m3 - m2).lerp_(apart, same_sign)
    bend = (u * h).sum(0).neg_()
    sign = 1.0 - 2.0 * torch.arange(2, dtype=pairs.dtype, device=pairs.device)[:, None]
    return torch.addcmul(e3, sign, m3).mul_(inv), torch.addcmul(bend, sign, apart).mul_(inv)


def _meet(slope: Tensor, offset: Tensor, v: Tensor, h: Tensor) -> Tensor:
    """Distances (3, 2, 2, C), up to scale, at the intersections of two lines and the conic of the weights ``v`` (3, C).

    Axes: point, intersection, line. If a line touches or misses the conic, its second intersection has distances 0.
    """
    v1, v2, v3 = v
    vh1, vh2, vh3 = v * h
    # The quadratic equation is c2 y² + 2 c1 y + c0 = 0 for y = (λ_2 - λ_3) / λ_3.
    v2_slope, less = slope * v2, slope - 1.0
    c2 = (less * less).mul_(v3).addcmul_(slope, vh3, value=2.0).addcmul_(v2_slope, slope).add_(v1)
    c1 = (slope + offset).add_(1.0).mul_(vh3).addcmul_(less * v3, offset).addcmul_(v2_slope, offset).add_(vh1)
    c1.addcmul_(slope, vh2)
    vh23 = (vh2 + vh3).mul_(2.0)
    c0 = (offset * offset).mul_(v2 + v3).addcmul_(offset, vh23).add_(vh23.add_(vh1, alpha=2.0))
    disc = (c1 * c1).addcmul_(c2, c0, value=-1.0)
    two = _greater(disc, torch.zeros_like(disc))
    z = signed(_sqrt(disc.clamp_(min=torch.finfo(disc.dtype).tiny)), c1).add_(c1).neg_()
    y, dist3 = torch.stack((z, c0.mul_(two))), torch.stack((c2, z * two))
    return torch.stack((torch.addcmul(dist3, slope, y).addcmul_(offset, dist3), y.add_(dist3), dist3))


def _distances(p: Tensor, q: Tensor, r: Tensor, b: Tensor, g: Tensor) -> Tensor:
    """Four candidates (3, 2, 2, C) for the distances of three points. Edge 1 is the longest, and has the length 1.

    ``p`` and ``q`` (C,) are the squared lengths of the edges 3 and 2, and ``r`` is ``1 - p - q`` without rounding. The
    module defines ``b`` (3, C) and ``g`` (C,). All candidates are finite, and their first distance is not negative.
    """
    h = 0.5 * b
    s1, s2, s3 = torch.addcmul(b, h, h, value=-1.0)
    # u_1 = -(p u_3 + q u_2). The unknown of the cubic is u_3 : u_2, and s · u = t_3 u_3 + t_2 u_2.
    t3, t2 = torch.addcmul(s3, p, s1, value=-1.0), torch.addcmul(s2, q, s1, value=-1.0)
    k2, k1 = (r * t3).addcmul_(p, g - t2), (r * t2).addcmul_(q, g - t3)
    u3, u2 = _isolated_root(torch.stack(((p * t3).neg_(), k2, k1, (q * t2).neg_())))
    u = torch.stack(((p * u3).addcmul_(q, u2).neg_(), u2, u3))
    pairs = (u2 * u3).addcmul_(u[0], u2 + u3)
    turn = _turn_to_largest((u.roll(-1, 0) + u.roll(1, 0)).abs_())
    # The weights v of the second conic satisfy a · v = 0, and (v_2, v_3) is orthogonal to (u_2, u_3).
    v = torch.stack(((p * u2).addcmul_(q, u3, value=-1.0), u3, -u2))
    u, v, h = _turned(torch.stack((u, v, h), 1), turn).unbind(1)
    slope, offset = _lines(u, h, pairs)
    dist = _refined(_turned(_meet(slope, offset, v, h), turn, -1), p, q, b)
    dist1, dist2, dist3 = dist
    edge = dist2 - dist3
    sq_edge = edge.mul_(edge).addcmul_(b[0], dist2 * dist3)
    return dist.mul_(signed(sq_edge.clamp_(min=torch.finfo(p.dtype).tiny ** 0.5).rsqrt_(), dist1))


def _refined(candidates: Tensor, p: Tensor, q: Tensor, b: Tensor) -> Tensor:
    """Take one Newton step on the ratios of the distances."""
    dist1, dist2, dist3 = candidates
    h1, h2, h3 = 0.5 * b
    after, before = candidates.roll(-1, 0), candidates.roll(1, 0)
    d = after - before
    # The squared edges have to satisfy e2 = q e1 and e3 = p e1.
    e1, e2, e3 = (d * d).addcmul_(b[:, None, None], after.mul_(before))
    d1, d2, d3 = d
    r2, r3 = torch.addcmul(e2, q, e1, value=-1.0), torch.addcmul(e3, p, e1, value=-1.0)
    # e12 = ½ ∂e1/∂dist2, e13 = -½ ∂e1/∂dist3, e23 = ½ ∂e2/∂dist3, e32 = -½ ∂e3/∂dist2,
    # r22 = -½ ∂r2/∂dist2, r32 = -½ ∂r3/∂dist2, r23 = ½ ∂r2/∂dist3, r33 = ½ ∂r3/∂dist3.
    e12, e13 = torch.addcmul(d1, h1, dist3), torch.addcmul(d1, h1, dist2, value=-1.0)
    e23, e32 = torch.addcmul(d2, h2, dist1), torch.addcmul(d3, h3, dist1, value=-1.0)
    r22, r23 = q * e12, e23.addcmul_(q, e13)
    r32, r33 = e32.addcmul_(p, e12), e13.mul_(p)
    det = (r23 * r32).addcmul_(r22, r33, value=-1.0)
    finfo = torch.finfo(det.dtype)
    inv = det.div_((det * det).addcmul_(e2, e3, value=finfo.eps**_DAMPING_POWER).add_(finfo.tiny))
    step2 = (r2 * r33).addcmul_(r3, r23, value=-1.0)
    step3 = r2.mul_(r32).addcmul_(r3, r22, value=-1.0)
    return torch.stack((dist1, *(torch.stack((dist2, dist3)).addcmul_(torch.stack((step2, step3)), inv, value=-0.5))))


def _dot(v: Tensor, w: Tensor) -> Tensor:
    return (v * w).sum(0)


def _cross(v: Tensor, w: Tensor) -> Tensor:
    """Cross products of vectors (3, *, C); ``torch.linalg.cross`` is several times slower on a CPU."""
    return (v.roll(-1, 0) * w.roll(1, 0)).addcmul_(v.roll(1, 0), w.roll(-1, 0), value=-1.0)


def _axes(base: Tensor, side: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Compute directions and lengths of triangles from a base (3, *, C) and another side (3, *, C).

    Returns five values: the unit vector along the base; the unit vector along the height; the inverse of the base's
    length; the component of the side along the base; the squared height.
    """
    tiny = torch.finfo(base.dtype).tiny
    inv_base = _dot(base, base).clamp_(min=tiny).rsqrt_()
    axis1 = base * inv_base
    along = _dot(axis1, side)
    height = torch.addcmul(side, along, axis1, value=-1.0)
    sq_height = _dot(height, height)
    return axis1, height.mul_(sq_height.clamp(min=tiny).rsqrt_()), inv_base, along, sq_height


def _edges(points: Tensor) -> Tensor:
    """The three edges of a triangle (3, *, C). Edge k is opposite to point k."""
    return points.roll(1, 0) - points.roll(-1, 0)


def _solve_chunk(world_points: Tensor, plane_points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotations (3, 3, 2, 2, C), translations (3, 2, 2, C), and whether each pose is a solution (2, 2, C)."""
    finfo = torch.finfo(world_points.dtype)
    # Shift the three points cyclically, so that the longest edge is opposite to the first point.
    points = torch.cat((world_points.permute(1, 2, 0), plane_points.permute(1, 2, 0)), 1)  # (3, 5, C)
    sound = points.abs().sum((0, 1)) <= finfo.max**0.2  # larger numbers could overflow
    points = torch.where(sound, points, 0.0)
    points = _turned(points, _turn_to_largest(_edges(points[:, :3]).square_().sum(1)))
    (x1, x2, x3), plane = points[:, :3], points[:, 3:]
    axis1, axis2, inv_base, along, sq_height = _axes(x3 - x2, x1 - x2)
    inv_sq_base = inv_base * inv_base
    along, sq_height = along.mul_(inv_base), sq_height.mul_(inv_sq_base)
    line = _dot(x1, x1).mul_(inv_sq_base).add_(1.0).mul_((_LINE * finfo.eps) ** 2)
    sound = sound.bitwise_and_(sq_height > line).bitwise_and_(inv_sq_base < finfo.tiny**-0.5)
    rest = 1.0 - along
    p, q = (along * along).add_(sq_height), (rest * rest).add_(sq_height)
    r = rest.mul_(along).sub_(sq_height).mul_(2.0)
    depths = plane.square().sum(1, keepdim=True).add_(1.0).rsqrt_()
    rays = torch.cat((plane * depths, depths), 1)  # (3, 3, C)
    sound.bitwise_and_(depths.amin((0, 1)) > MIN_DEPTH_RATIO)
    gaps = _edges(rays)
    det = _dot(_cross(gaps[1], gaps[2]), rays[0])
    dist = _distances(p, q, r, gaps.square_().sum(1), det.mul_(det))

    # Up to here, the longest edge has the length 1. From here on, lengths have the unit of the world points.
    base_length = inv_base.reciprocal()
    y1, y2, y3 = (dist * base_length)[:, None] * rays[:, :, None, None]
    cam1, cam2, cam_inv_base, cam_along, cam_sq_height = _axes(y3 - y2, y1 - y2)
    # The errors of the camera triangle are relative to the base of the world triangle.
    base_error = (cam_inv_base * base_length).sub_(1.0)
    along_error = torch.addcmul(-along, cam_along, inv_base)
    height_error = torch.addcmul(-sq_height, cam_sq_height, inv_sq_base)
    sq_error = base_error.mul_(base_error).addcmul_(along_error, along_error).addcmul_(height_error, height_error)
    least = dist.amin(0)
    # No distance exceeds dist[0] + 1, because the longest edge has the length 1.
    room = torch.addcmul(least, least, dist[0]).sub_(_CLOSE * finfo.eps**_ERROR_POWER)
    room.mul_(sound).mul_(finfo.eps ** (2 * _ERROR_POWER)).clamp_(max=_LARGEST_ERROR**2)

    # R = Σ camera axis · world axisᵀ, t = y1 - R x1.
    axis3, cam3 = _cross(axis1, axis2), _cross(cam1, cam2)
    world_axes = [axis[:, None, None] for axis in (axis1, axis2, axis3)]
    rotation = cam1[:, None] * world_axes[0]
    rotation.addcmul_(cam2[:, None], world_axes[1]).addcmul_(cam3[:, None], world_axes[2])
    return rotation, y1 - (rotation * x1[:, None, None]).sum(1), sq_error < room


def _solve(world_points: Tensor, plane_points: Tensor) -> tuple[Tensor, Tensor]:
    """See :func:`minimal_poses`."""
    batch = world_points.shape[0]
    if compiling():
        rotation, translation, found = _solve_chunk(world_points, plane_points)
        return torch.cat((rotation, translation[:, None]), 1).flatten(2, 3).flatten(0, 1), found.flatten(0, 1)
    out = world_points.new_empty(3, 4, 2, 2, batch)
    valid = torch.empty(2, 2, batch, dtype=torch.bool, device=world_points.device)
    chunk = kept_at_once(_CHUNK_BYTES, world_points) // world_points.element_size()
    with torch.inference_mode():  # an eighth faster than `no_grad`
        for start in range(0, batch, chunk):
            part = slice(start, start + chunk)
            rotation, translation, valid[..., part] = _solve_chunk(world_points[part], plane_points[part])
            torch.cat((rotation, translation[:, None]), 1, out=out[..., part])
    return out.view(12, 4, batch), valid.view(4, batch)


class _Solve(torch.autograd.Function):
    """:func:`_solve` with a rule for ``torch.func.vmap``, because ``vmap`` cannot map in-place operations."""

    @staticmethod
    def forward(world_points: Tensor, plane_points: Tensor) -> tuple[Tensor, Tensor]:
        return _solve(world_points, plane_points)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def jvp(ctx: Any, *changes: Tensor) -> tuple[None, None]:
        return None, None

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, int | None], *points: Tensor
    ) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        entries, valid = _Solve.apply(*fold_vmap(info.batch_size, in_dims, *points))  # type: ignore[no-untyped-call]
        return (unfold_vmap(info.batch_size, entries), unfold_vmap(info.batch_size, valid)), (2, 1)


def minimal_poses(world_points: Tensor, plane_points: Tensor) -> tuple[Tensor, Tensor]:
    """Solve P3P for world points (B, 3, 3) and plane points (B, 3, 2) of one dtype, see :func:`p3p`.

    The fifth powers of coordinates must not overflow or underflow. Returns the entries (12, 4, B) of four poses (see
    :func:`~kornia_pnpnet.propose.scoring.as_pose`), and whether each pose is valid, (4, B).
    """
    entries, valid = (_solve if compiling() else _Solve.apply)(world_points.detach(), plane_points.detach())
    return entries, valid


def p3p(world_points: Tensor, plane_points: Tensor) -> Hypotheses:
    r"""Find all poses that project three world points exactly onto three image points, for a batch of problems.

    Use this function for problems of exactly three pairs. Most solvers reject the pose of three pairs, because
    no fourth pair confirms the pose (:attr:`~kornia_pnpnet.result.Status.NOT_BELIEVED`).

    Convention: ``x_cam = R x_world + t``, the camera looks along +z. The poses have no gradient.

    Source: M. Persson and K. Nordberg, "Lambda Twist", ECCV 2018 (one degenerate conic); Y. Ding, J. Yang, V. Larsson,
    C. Olsson and K. Åström, "Revisiting the P3P Problem", CVPR 2023 (the cubic, lines from the adjugate matrix). The
    short form of the cubic, the choice of its root, and the equations of the lines are ours.

    Args:
        world_points: points in any unit, shape :math:`(B, 3, 3)`. Any number of leading dimensions may replace
            :math:`B` in both arguments. The result has the same leading dimensions.
        plane_points: normalised image coordinates :math:`(x/z, y/z)`, shape :math:`(B, 3, 2)`. Kornia's
            ``normalize_points_with_intrinsics`` computes these coordinates from pixels.

    Returns:
        Four slots per problem, float64 if an argument is float64, else float32. A slot is valid when its pose is a
        solution with all three points in front of the camera. Invalid slots contain finite numbers. A double solution
        fills one slot. A problem has no valid slot when the points lie on a line, when a coordinate is not finite, or
        when a ray is nearly orthogonal to the optical axis (``MIN_DEPTH_RATIO`` of
        :mod:`kornia_pnpnet.refine.residual`).

    Raises:
        ShapeError: when a shape is incorrect, or the batches differ.
        TypeCheckError: for booleans or complex numbers.
        DeviceError: for tensors on two devices.

    Example:
        >>> from kornia.geometry.conversions import normalize_points_with_intrinsics
        >>> intrinsics = torch.tensor([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
        >>> img_points = torch.tensor([[320.0, 240.0], [445.0, 240.0], [320.0, 351.11111]])
        >>> world_points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.5]])
        >>> pose, valid = p3p(world_points, normalize_points_with_intrinsics(img_points, intrinsics))
        >>> pose.rotation.shape, valid.sum()
        (torch.Size([4, 3, 3]), tensor(2))
        >>> bool((pose.translation[valid] - torch.tensor([0.0, 0.0, 4.0])).norm(dim=-1).min() < 1e-4)
        True
    """
    check_form(["*", "3", "3"], world_points=world_points)
    size = world_points.shape[:-2]
    check_shapes({"plane_points": (plane_points, (*size, 3, 2))}, world_points)
    check_devices({"plane_points": plane_points}, world_points)
    dtype = common_dtype({"world_points": world_points, "plane_points": plane_points})
    world = world_points.detach().to(dtype)
    largest = world.abs().amax((-2, -1), keepdim=True).clamp(min=torch.finfo(dtype).tiny)
    unit = largest.log2().floor().exp2()  # a power of two avoids rounding, which could separate double solutions
    entries, valid = minimal_poses((world / unit).reshape(-1, 3, 3), plane_points.to(dtype).reshape(-1, 3, 2))
    (rotation, translation), valid = as_pose(entries.permute(2, 1, 0).reshape(*size, 4, 12)), valid.mT.reshape(*size, 4)
    return Hypotheses(Pose(rotation, torch.where(valid[..., None], translation * unit, 0.0)), valid)


class P3P(Configured):
    r"""Minimal solver of three pairs for :class:`~kornia_pnpnet.propose.ransac.RANSAC`: :func:`p3p` as a module.

    If the focal length is unknown, each sample is solved at every focal length of a geometric grid (see
    :class:`~kornia_pnpnet.refine.terms.CameraTerm`). The refinement then finds focal lengths between the grid's values.

    Example:
        >>> problem = Problem.of(torch.randn(7, 3, 3), torch.randn(7, 3, 2))
        >>> P3P().hypotheses(problem).pose.rotation.shape
        torch.Size([7, 4, 3, 3])
    """

    #: Number of pairs in a sample.
    sample_size = 3

    def __init__(self) -> None:
        super().__init__(locals())

    def hypotheses(self, problem: Problem) -> Hypotheses:
        """Four slots for each sample and each tried focal length. See MinimalSolver.hypotheses."""
        world, plane = problem.world_points, problem.img_points / problem.focal
        if problem.free_focal is None:
            entries, valid = minimal_poses(world, plane)
        else:
            at = (torch.arange(_FOCALS, dtype=plane.dtype, device=plane.device) + 0.5) * (2.0 / _FOCALS) - 1.0
            focal = (at[:, None] * problem.free_focal.width).exp()  # (F, B)
            seen = (plane / focal[..., None, None]).flatten(0, 1)
            entries, valid = minimal_poses(world.expand(_FOCALS, -1, -1, -1).flatten(0, 1), seen)
            entries, valid = entries.unflatten(2, focal.shape), valid.unflatten(1, focal.shape).flatten(0, 1)
            entries = torch.cat((entries[:8], entries[8:] * focal.reciprocal())).flatten(1, 2)  # (12, 4 F, B)
        return Hypotheses(as_pose(entries.permute(2, 1, 0)), valid.mT)
