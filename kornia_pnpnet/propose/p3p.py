r"""P3P: the up to four poses that project three world points exactly onto three pixels, for whole batches."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Tensor

from kornia_pnpnet.core.checks import check_devices, check_shapes, common_dtype
from kornia_pnpnet.core.configured import Configured
from kornia_pnpnet.core.linalg import dot
from kornia_pnpnet.core.performance import compiling, fold_vmap, unfold_vmap
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.problem import Hypotheses, Problem
from kornia_pnpnet.propose.law_of_cosines import Triple, distances, turn_to_largest, turned
from kornia_pnpnet.propose.minimal import FocalHypotheses
from kornia_pnpnet.propose.sampling import kept_at_once
from kornia_pnpnet.refine.residual import MIN_DEPTH_RATIO
from kornia_pnpnet.result import Pose

__all__ = ["P3P", "p3p"]

_T = TypeVar("_T")

# Bytes. One number per problem of a chunk takes this many: a few dozen of these vectors fit into a core's caches.
_CHUNK_BYTES = 2**16
# Power of the machine epsilon. The triangle of a solution differs from the given triangle, whose longest edge is 1, by
# less than this power times the distance.
_ERROR_POWER = 2 / 3
# Share of the longest edge. The two triangles differ by less than this share at any distance.
_LARGEST_ERROR = 0.01
# Machine epsilons of the coordinates and the longest edge. A triangle less high than this is a line.
_LINE = 32.0
# Number of focal lengths on the grid for an unknown one.
_FOCALS = 12
# Longest edges, times the machine epsilon to the power `_ERROR_POWER`. A camera closer to a point than this is no
# solution: rounding would decide in which direction it sees the point.
_CLOSE = 64.0


def _cross(v: Sequence[Tensor] | Tensor, w: Sequence[Tensor] | Tensor) -> list[Tensor]:
    """The cross product of two vectors by components."""
    return [(v[i] * w[j]).addcmul_(v[j], w[i], value=-1.0) for i, j in ((1, 2), (2, 0), (0, 1))]


def _axes(base: list[Tensor], side: list[Tensor]) -> tuple[list[Tensor], list[Tensor], Triple]:
    """Unit vectors along the base and the height of a triangle, whose two sides are overwritten.

    The third result is: one over the length of the base, the other side along the base, and the squared height.
    """
    tiny = torch.finfo(base[0].dtype).tiny
    inv_base = dot(base, base).clamp_(min=tiny).rsqrt_()
    axis1 = [x.mul_(inv_base) for x in base]
    along = dot(axis1, side)
    axis2 = [x.addcmul_(along, y, value=-1.0) for x, y in zip(side, axis1, strict=True)]
    sq_height = dot(axis2, axis2)
    inv_height = sq_height.clamp(min=tiny).rsqrt_()
    return axis1, [x.mul_(inv_height) for x in axis2], (inv_base, along, sq_height)


def _load(world_points: Tensor, plane_points: Tensor) -> tuple[list[Tensor], Tensor]:
    """The three points by components (5, C), ordered so that the longest edge is opposite to the first point.

    The second result is whether the components are finite and small enough for arithmetic, (C,). The points of other
    problems are 0.
    """
    given = torch.cat((world_points.permute(1, 2, 0), plane_points.permute(1, 2, 0)), 1)  # (3, 5, C)
    sound = given.abs().sum((0, 1)) <= torch.finfo(given.dtype).max ** 0.2  # larger numbers could overflow
    points = [torch.where(sound, x, 0.0) for x in given]
    edges = [x[:3] - y[:3] for x, y in _ends(points)]
    return [*turned(points, turn_to_largest(*(dot(x, x) for x in edges)))], sound


def _ends(points: Sequence[_T]) -> list[tuple[_T, _T]]:
    """The ends of the edges opposite to each of three points."""
    return [(points[2], points[1]), (points[0], points[2]), (points[1], points[0])]


def _look(plane: list[Tensor]) -> tuple[list[list[Tensor]], Triple, Tensor, Tensor]:
    """Three unit rays of three (C,), their squared differences, their squared determinant, whether all are in view."""
    depths = [(x * x).addcmul_(y, y).add_(1.0).rsqrt_() for x, y in plane]
    rays = [[x * depth, y * depth, depth] for (x, y), depth in zip(plane, depths, strict=True)]
    gaps = [[a - b for a, b in zip(x, y, strict=True)] for x, y in _ends(rays)]
    det = dot(_cross(gaps[1], gaps[2]), rays[0])
    sees = functools.reduce(torch.minimum, depths) > MIN_DEPTH_RATIO
    b1, b2, b3 = (dot(x, x) for x in gaps)
    return rays, (b1, b2, b3), det.mul_(det), sees


def _solve_chunk(world_points: Tensor, plane_points: Tensor) -> tuple[list[Tensor], Tensor]:
    """The twelve components of rotations and translations (2, 2, C), and which poses are solutions (2, 2, C)."""
    finfo = torch.finfo(world_points.dtype)
    points, sound = _load(world_points, plane_points)
    x1, x2, x3 = (x[:3] for x in points)
    # Component by component: an exporter cannot write into parts of a tensor for a variable number of problems.
    base, side = ([x - y for x, y in zip(end, x2, strict=True)] for end in (x3, x1))
    axis1, axis2, (inv_base, along, sq_height) = _axes(base, side)
    axis3 = _cross(axis1, axis2)
    inv_sq_base = inv_base * inv_base
    along, sq_height = along.mul_(inv_base), sq_height.mul_(inv_sq_base)
    line = dot(x1, x1).mul_(inv_sq_base).add_(1.0).mul_((_LINE * finfo.eps) ** 2)
    sound = sound.bitwise_and_(sq_height > line).bitwise_and_(inv_sq_base < finfo.tiny**-0.5)
    rest = 1.0 - along
    p, q = (along * along).add_(sq_height), (rest * rest).add_(sq_height)
    r = rest.mul_(along).sub_(sq_height).mul_(2.0)
    rays, b, g, sees = _look([x[3:] for x in points])
    dist = distances(p, q, r, b, g)

    # So far the longest edge had the length 1; from here on lengths are in the unit of the world.
    base_length = inv_base.reciprocal()
    y1, y2, y3 = ([d * x for x in ray] for d, ray in zip([d * base_length for d in dist], rays, strict=True))
    base = [y.sub_(x) for y, x in zip(y3, y2, strict=True)]
    side = [torch.sub(y, x, out=x) for y, x in zip(y1, y2, strict=True)]
    cam1, cam2, (cam_inv_base, cam_along, cam_sq_height) = _axes(base, side)
    # The two triangles differ in the base, the side along it and the squared height, relative to the base.
    base_error = (cam_inv_base * base_length).sub_(1.0)
    along_error = torch.addcmul(-along, cam_along, inv_base)
    height_error = torch.addcmul(-sq_height, cam_sq_height, inv_sq_base)
    sq_error = base_error.mul_(base_error).addcmul_(along_error, along_error).addcmul_(height_error, height_error)
    least = torch.minimum(torch.minimum(dist[0], dist[1]), dist[2])
    bound = sound.bitwise_and_(sees) * least.new_full((), finfo.eps ** (2 * _ERROR_POWER))
    # No distance is more than dist[0] + 1, in longest edges.
    room = least.addcmul_(least, dist[0]).sub_(_CLOSE * finfo.eps**_ERROR_POWER).mul_(bound)
    valid = sq_error < room.clamp_(max=_LARGEST_ERROR**2)

    # R = Σ camera axis · world axisᵀ, the last row from the first two; t = y1 - R x1.
    (a0, a1, a2), (b0, b1, b2) = cam1, cam2
    cam3 = ((a1 * b2).addcmul_(a2, b1, value=-1.0), (a2 * b0).addcmul_(a0, b2, value=-1.0))
    rows = [
        [(cam1[i] * axis1[j]).addcmul_(cam2[i], axis2[j]).addcmul_(cam3[i], axis3[j]) for j in range(3)]
        for i in range(2)
    ]
    rows.append(_cross(*rows))
    back = -x1
    translation = [
        torch.addcmul(y, row[0], back[0]).addcmul_(row[1], back[1]).addcmul_(row[2], back[2])
        for y, row in zip(y1, rows, strict=True)
    ]
    return [*rows[0], *rows[1], *rows[2], *translation], valid


def _solve(world_points: Tensor, plane_points: Tensor) -> tuple[Tensor, Tensor]:
    """Components of rotations and translations, (12, 4, B), and which poses are solutions, (4, B).

    The problems are solved in chunks that fit into a core's caches. The loops of a compiler need no chunks.
    """
    batch = world_points.shape[0]
    if compiling():
        entries, found = _solve_chunk(world_points, plane_points)
        return torch.stack(entries).flatten(1, 2), found.flatten(0, 1)
    out = world_points.new_empty(12, 2, 2, batch)
    valid = torch.empty(2, 2, batch, dtype=torch.bool, device=world_points.device)
    chunk = kept_at_once(_CHUNK_BYTES, world_points) // world_points.element_size()
    with torch.inference_mode():  # an eighth faster than `no_grad`; the results were made outside
        for start in range(0, batch, chunk):
            part = slice(start, start + chunk)
            entries, valid[..., part] = _solve_chunk(world_points[part], plane_points[part])
            torch.stack(entries, out=out[..., part])
    return out.flatten(1, 2), valid.flatten(0, 1)


class _Solve(torch.autograd.Function):
    """:func:`_solve` with a rule for ``torch.func.vmap``, which cannot map operations that write in place."""

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
        components, valid = _Solve.apply(*fold_vmap(info.batch_size, in_dims, *points))  # type: ignore[no-untyped-call]
        return (unfold_vmap(info.batch_size, components), unfold_vmap(info.batch_size, valid)), (2, 1)


def p3p(world_points: Tensor, plane_points: Tensor) -> Hypotheses:
    r"""Find all poses that project three world points exactly onto three image points, for a batch of problems.

    Use this function when there are exactly three pairs. A solver answers with one pose, which most solvers do not
    believe (:attr:`~kornia_pnpnet.result.Status.NOT_BELIEVED`), because no fourth pair confirms it.

    Convention: ``x_cam = R x_world + t``, the camera looks along +z.

    The poses carry no gradient: they are hypotheses, of which one is selected and refined on all pairs. In memory the
    batch is the last dimension, which suits arithmetic over many poses.

    Source: M. Persson and K. Nordberg, "Lambda Twist", ECCV 2018; Y. Ding et al., "Revisiting the P3P Problem", CVPR
    2023; details in ``kornia_pnpnet.propose.law_of_cosines``.

    Args:
        world_points: points in any unit, shape :math:`(B, 3, 3)`. Any leading dimensions may stand in place of
            :math:`B`, in both arguments and in the result; a single problem has none.
        plane_points: :math:`(x/z, y/z)` of the points in the camera frame, shape :math:`(B, 3, 2)`. Kornia's
            ``normalize_points_with_intrinsics`` computes them from pixels.

    Returns:
        Four slots per problem, in float64 when an argument is, else in float32. A slot is valid when its pose is a
        solution with all three points in front of the camera. A double solution fills one slot. Invalid slots are
        finite. No slot is valid for points on a line, which have no pose or infinitely many, for NaN and infinity, and
        where a point is further off the axis than ``MIN_DEPTH_RATIO`` of :mod:`kornia_pnpnet.refine.residual` allows.

    Raises:
        ShapeError: when a tensor has another shape, or the batches differ.
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
    KORNIA_CHECK_SHAPE(world_points, ["*", "3", "3"])
    size = world_points.shape[:-2]
    check_shapes({"plane_points": (plane_points, (*size, 3, 2))}, world_points)
    check_devices({"plane_points": plane_points}, world_points)
    dtype = common_dtype({"world_points": world_points, "plane_points": plane_points})
    solve = _solve if compiling() else _Solve.apply
    components, valid = solve(*(x.detach().to(dtype).reshape(-1, *x.shape[-2:]) for x in (world_points, plane_points)))
    components = components.permute(2, 1, 0).reshape(*size, 4, 12)
    pose = Pose(components[..., :9].unflatten(-1, (3, 3)), components[..., 9:])
    return Hypotheses(pose, valid.mT.reshape(*size, 4))


class P3P(Configured):
    r"""Minimal solver of three pairs for :class:`~kornia_pnpnet.propose.ransac.RANSAC`: :func:`p3p` as a module.

    With an unknown focal length :func:`p3p` solves each sample at focal lengths on a grid, spread evenly in logarithms
    over the range of :class:`~kornia_pnpnet.refine.terms.CameraTerm`. Least squares of all inliers, with the focal
    length as a parameter, then find what lies between the points of the grid.

    Example:
        >>> problem = Problem.of(torch.randn(7, 3, 3), torch.randn(7, 3, 2))
        >>> P3P().hypotheses(problem).pose.rotation.shape
        torch.Size([7, 4, 3, 3])
    """

    #: Number of pairs in a sample.
    sample_size = 3

    def __init__(self) -> None:
        super().__init__(locals())

    def hypotheses(self, problem: Problem) -> Hypotheses | FocalHypotheses:
        r"""Solve samples of three pairs.

        Args:
            problem: samples, :math:`N = 3`. Their weights are ignored.

        Returns:
            Four slots per sample and focal length, without gradients.

        Raises:
            ShapeError: when :math:`N` is not 3.
        """
        plane = problem.img_points / problem.focal
        if problem.free_focal is None:
            return p3p(problem.world_points, plane)
        at = (torch.arange(_FOCALS, device=plane.device) + 0.5) * (2.0 / _FOCALS) - 1.0
        zoom = at[:, None].to(plane) * problem.free_focal.width  # (F, B)
        world = problem.world_points.expand(_FOCALS, -1, -1, -1)
        solved = p3p(world, plane * (-zoom).exp()[..., None, None])

        def slots(x: Tensor) -> Tensor:
            """Of (F, B, 4, ...) the slots of a sample side by side, (B, 4 F, ...); the batch stays last in memory."""
            last = x.movedim((0, 1, 2), (-2, -1, -3)).flatten(-3, -2)
            return last.movedim((-1, -2), (0, 1))

        pose, valid = map_tensors(slots, (solved.pose, solved.valid))
        return FocalHypotheses(pose, valid, zoom.repeat(4, 1).mT)
