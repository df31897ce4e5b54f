r"""P3P: the up to four poses from which a camera sees three points where it saw them, for whole batches."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from kornia.core.exceptions import ShapeError, TypeCheckError
from torch import Tensor, nn

from kornia_pnpnet.core.checks import check_like
from kornia_pnpnet.core.linalg import dot
from kornia_pnpnet.geometry import MIN_DEPTH_RATIO
from kornia_pnpnet.init.ransac.law_of_cosines import Triple, distances, turn_to_largest, turned
from kornia_pnpnet.types import Correspondences, Hypotheses, Pose

__all__ = ["P3P", "p3p"]

_T = TypeVar("_T")

# A chunk's component of one value per problem has this many bytes: a few dozen of them fit into a core's caches.
_CHUNK_BYTES = 2**16
# The triangle of a solution differs from the given one by less than this power of the machine epsilon, times distance.
_ERROR_POWER = 2 / 3
# And by less than this share of its longest edge, however far it is.
_LARGEST_ERROR = 0.01
# A triangle is a line when it is less high than this many machine epsilons of its coordinates and its longest edge.
_LINE = 32.0
# A camera is this many longest edges, times the same power, away from each point: from closer by, rounding would decide
# in which direction it sees the point.
_CLOSE = 64.0


def _cross(v: Sequence[Tensor] | Tensor, w: Sequence[Tensor] | Tensor) -> list[Tensor]:
    return [(v[i] * w[j]).addcmul_(v[j], w[i], value=-1.0) for i, j in ((1, 2), (2, 0), (0, 1))]


def _axes(base: list[Tensor], side: list[Tensor]) -> tuple[list[Tensor], list[Tensor], Triple]:
    """Unit vectors along a side of a triangle and along the height over it; both arguments are overwritten.

    Returned after them: one over the length of the base, the other side along the base, and the squared height.
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
    """The three points by components (5, C), in an order in which the longest edge is opposite to the first.

    Returned after them: whether they are numbers with which one can calculate (C,). The others are 0.
    """
    given = torch.cat((world_points.permute(1, 2, 0), plane_points.permute(1, 2, 0)), 1)  # (3, 5, C)
    sound = given.abs().sum((0, 1)) <= torch.finfo(given.dtype).max ** 0.2  # what is larger could overflow
    points = [torch.where(sound, x, 0.0) for x in given]
    edges = [x[:3] - y[:3] for x, y in _ends(points)]
    return [*turned(points, turn_to_largest(*(dot(x, x) for x in edges)))], sound


def _ends(points: Sequence[_T]) -> list[tuple[_T, _T]]:
    """The ends of the edges opposite to each of three points."""
    return [(points[2], points[1]), (points[0], points[2]), (points[1], points[0])]


def _look(plane: list[Tensor]) -> tuple[list[list[Tensor]], Triple, Tensor, Tensor]:
    """Unit rays, three of three (C,), squared differences, squared determinant of them, and whether all see."""
    depths = [(x * x).addcmul_(y, y).add_(1.0).rsqrt_() for x, y in plane]
    rays = [[x * depth, y * depth, depth] for (x, y), depth in zip(plane, depths, strict=True)]
    gaps = [[a - b for a, b in zip(x, y, strict=True)] for x, y in _ends(rays)]
    det = dot(_cross(gaps[1], gaps[2]), rays[0])
    sees = functools.reduce(torch.minimum, depths) > MIN_DEPTH_RATIO
    b1, b2, b3 = (dot(x, x) for x in gaps)
    return rays, (b1, b2, b3), det.mul_(det), sees


def _solve_chunk(world_points: Tensor, plane_points: Tensor) -> tuple[list[Tensor], Tensor]:
    """The twelve components of rotations and translations (2, 2, C), and which are solutions (2, 2, C)."""
    finfo = torch.finfo(world_points.dtype)
    points, sound = _load(world_points, plane_points)
    x1, x2, x3 = (x[:3] for x in points)
    # Component by component: an exporter does not know how to write into parts of a tensor for any number of problems.
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

    # Up to here the longest edge was 1 long.
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
    # No distance is more than dist[0] + 1.
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
    """Components of rotations and translations, (12, 4, B), and which of them are solutions, (4, B).

    In chunks that fit into a core's caches; a compiler's loops need none.
    """
    batch = world_points.shape[0]
    if torch.compiler.is_compiling():
        entries, found = _solve_chunk(world_points, plane_points)
        return torch.stack(entries).flatten(1, 2), found.flatten(0, 1)
    out = world_points.new_empty(12, 2, 2, batch)
    valid = torch.empty(2, 2, batch, dtype=torch.bool, device=world_points.device)
    chunk = _CHUNK_BYTES // world_points.element_size()
    with torch.inference_mode():  # an eighth faster than without gradients only; what is returned is made outside
        for start in range(0, batch, chunk):
            part = slice(start, start + chunk)
            entries, valid[..., part] = _solve_chunk(world_points[part], plane_points[part])
            torch.stack(entries, out=out[..., part])
    return out.flatten(1, 2), valid.flatten(0, 1)


def folded(size: int, in_dims: Sequence[int | None], *tensors: Tensor) -> list[Tensor]:
    """Arguments of a rule for ``torch.func.vmap`` with the mapped dimension made part of the batch, their first one."""
    moved = [
        x.expand(size, *x.shape) if dim is None else x.movedim(dim, 0) for x, dim in zip(tensors, in_dims, strict=True)
    ]
    return [x.flatten(0, 1) for x in moved]


def unfolded(size: int, result: Tensor) -> Tensor:
    """A result of :func:`folded` arguments, the batch last, with the mapped dimension before that again."""
    return result.unflatten(-1, (size, -1))


class _Solve(torch.autograd.Function):
    """:func:`_solve`, which ``torch.func.vmap`` can map: it writes in place what a mapped dimension would not fit."""

    @staticmethod
    def forward(world_points: Tensor, plane_points: Tensor) -> tuple[Tensor, Tensor]:
        return _solve(world_points, plane_points)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, int | None], *points: Tensor
    ) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        components, valid = _Solve.apply(*folded(info.batch_size, in_dims, *points))  # type: ignore[no-untyped-call]
        return (unfolded(info.batch_size, components), unfolded(info.batch_size, valid)), (2, 1)


def p3p(world_points: Tensor, plane_points: Tensor) -> Hypotheses:
    r"""Find all poses from which a camera sees three world points where it saw them, for a batch of problems.

    Convention: ``x_cam = R x_world + t``, the camera looks along +z.

    The poses carry no gradient: which one of them survives is a choice, and what is made of it is refined afterwards on
    all pairs. They are stored by components, as if the batch came last, which suits arithmetic over many of them.

    Args:
        world_points: shape :math:`(B, 3, 3)`, in any unit.
        plane_points: :math:`(x/z, y/z)` of the points in the camera frame, shape :math:`(B, 3, 2)`.

    Returns:
        Four slots for each problem. A slot is valid when its pose is a solution with all three points in front of the
        camera. A double solution fills one slot. The other slots hold finite numbers. No slot is valid for points on a
        line (they have no pose or too many), for NaN and infinity, and where a point is seen further out than
        :data:`~kornia_pnpnet.geometry.MIN_DEPTH_RATIO` allows.

    Raises:
        ShapeError: when the shapes are not these.
        TypeCheckError: for dtypes other than float32 and float64, or two different ones.
        DeviceError: for tensors on two devices.

    Example:
        >>> world_points = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.5]]], dtype=torch.float64)
        >>> cam_points = world_points + torch.tensor([0.0, 0.0, 4.0])
        >>> pose, valid = p3p(world_points, cam_points[..., :2] / cam_points[..., 2:])
        >>> pose.rotation.shape, valid.sum(-1)
        (torch.Size([1, 4, 3, 3]), tensor([2]))
        >>> bool((pose.translation[valid] - torch.tensor([0.0, 0.0, 4.0])).norm(dim=-1).min() < 1e-12)
        True
    """
    KORNIA_CHECK_SHAPE(world_points, ["B", "3", "3"])
    KORNIA_CHECK_SHAPE(plane_points, ["B", "3", "2"])
    batch = world_points.shape[0]
    if plane_points.shape[0] != batch:
        raise ShapeError(
            f"plane_points must be of as many problems as world_points, {batch}, got {plane_points.shape[0]}.",
            actual_shape=tuple(plane_points.shape),
            expected_shape=(batch, 3, 2),
        )
    if world_points.dtype not in (torch.float32, torch.float64):
        raise TypeCheckError(f"world_points must be float32 or float64, got {world_points.dtype}.")
    check_like({"plane_points": plane_points}, world_points)
    solve = _solve if torch.compiler.is_compiling() else _Solve.apply
    components, valid = solve(world_points.detach(), plane_points.detach())
    components = components.permute(2, 1, 0)  # (B, 4, 12)
    rotation, translation = components[..., :9].unflatten(-1, (3, 3)), components[..., 9:]
    return Hypotheses(Pose(rotation, translation), valid.mT)


class P3P(nn.Module):
    r"""Solver of minimal samples of three pairs, for :class:`~kornia_pnpnet.init.RANSAC`: :func:`p3p` as a module.

    Example:
        >>> corr = Correspondences(torch.randn(7, 3, 3), torch.randn(7, 3, 2), torch.ones(7, 3), torch.tensor(1.0))
        >>> P3P().hypotheses(corr).pose.rotation.shape
        torch.Size([7, 4, 3, 3])
    """

    #: Pairs in a sample.
    sample_size = 3

    def __init__(self) -> None:
        super().__init__()
        self.config: dict[str, object] = {}

    def hypotheses(self, corr: Correspondences) -> Hypotheses:
        r"""Solve samples of three pairs.

        Args:
            corr: normalised correspondences with :math:`N = 3`. Their weights do not matter.

        Returns:
            Four slots for each sample, :math:`S = 4`, without gradients.

        Raises:
            ShapeError: when :math:`N` is not 3.
        """
        if corr.world_points.shape[1] != self.sample_size:
            raise ShapeError(
                f"P3P solves samples of 3 pairs, got N = {corr.world_points.shape[1]}.",
                actual_shape=tuple(corr.world_points.shape),
                expected_shape=["B", "3", "3"],
            )
        return p3p(corr.world_points, corr.img_points / corr.focal)
