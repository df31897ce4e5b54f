"""The reprojection residual: projection, noise, normal equations, and the motion of a state along a tangent vector.

The pose maps points by ``x_cam = R x_world + t``. The camera looks along +z. Pixels belong to a camera with a single
focal length and the principal point 0. A point is *in front* when its depth exceeds ``MIN_DEPTH_RATIO`` times its
distance. This test does not depend on the unit of the world.

The dimensions of tensors are coordinates, pairs and problems, in this order, so that operations run over long rows of
memory. Kornia's ``transform_points`` and ``project_points`` compute the same projection (``tests/test_kornia.py``),
but take three times as long for 1000 problems of 9 pairs.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeAlias

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, rotation_matrix_to_axis_angle
from kornia.geometry.liegroup import So3
from torch import Tensor
from torch.nn import functional

from kornia_pnpnet.core.linalg import dot, small_product, solve_positive
from kornia_pnpnet.core.performance import are_few, compiling
from kornia_pnpnet.core.symmetric import Symmetric2
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.problem import Noise, Problem, State
from kornia_pnpnet.result import Pose

__all__ = [
    "MIN_DEPTH_RATIO",
    "NormalEquations",
    "Projection",
    "covariance_at",
    "information",
    "lm_step",
    "moved",
    "normal_equations",
    "pixel_covariance",
    "pixel_variance",
    "project",
    "retract",
    "rotation_angle",
    "tangent",
]

#: A point ``x`` of depth ``z <= MIN_DEPTH_RATIO * |x|`` is behind the camera. Otherwise ``|x / z|`` is below 1000.
MIN_DEPTH_RATIO = 1e-3
# Largest change of the logarithm of the focal length, and of a coefficient of radial distortion, in one step. The
# exponential of a larger change of the logarithm could overflow.
_LARGEST_ZOOM, _LARGEST_RADIAL = 1.0, 0.3
# Lower bound of the denominator 1 + tr(R) in `tangent`. At a half turn, 1 + tr(R) is 0.
_LEAST_DENOMINATOR = 1e-4

# The entries for u and v in one column of the Jacobian. An entry that is the same for all pairs is a Python number.
_Column: TypeAlias = tuple[Any, Any]


class Projection(NamedTuple):
    r"""Points projected at a state, and their residuals. The problems are the last dimension.

    Attributes:
        residual: projection minus measurement in pixels, finite but meaningless behind the camera, :math:`(2, N, B)`.
        front: whether the point is in front of the camera, bool, shape :math:`(N, B)`.
        rotated: the rotated points before translation, :math:`y = R x`, shape :math:`(3, N, B)`.
        plane: :math:`(p, q) = (x/z, y/z)`, 0 for points behind the camera, shape :math:`(2, N, B)`.
        inv_depth: :math:`1/z`, 0 for points behind the camera, shape :math:`(N, B)`.
        scaled: the residual times the depth, shape :math:`(2, N, B)`.
        focal: the focal length in pixels, a scalar or of shape :math:`(B,)`.
        state: the state.
        stretch: :math:`d = 1 + k_1 \rho^2 + k_2 \rho^4` with :math:`\rho^2 = p^2 + q^2`, shape :math:`(N, B)`;
            ``None``: there is no distortion.
        slope: twice the derivative :math:`\partial d / \partial \rho^2`, shape :math:`(N, B)`; ``None``: no distortion.
        lens: if the pixels were undistorted with a known lens, the Jacobian's column of log f has one more term. This
            is the term times z/f, shape :math:`(2, N, B)`; ``None``: the term is 0.
    """

    residual: Tensor
    front: Tensor
    rotated: Tensor
    plane: Tensor
    inv_depth: Tensor
    scaled: Tensor
    focal: Tensor
    state: State
    stretch: Tensor | None = None
    slope: Tensor | None = None
    lens: Tensor | None = None

    @property
    def sq_residual(self) -> Tensor:
        """Squared length of the residual in square pixels, shape :math:`(B, N)`."""
        return self.residual.square().sum(0).mT

    @property
    def in_front(self) -> Tensor:
        """Whether the point is in front of the camera, bool, shape :math:`(B, N)`."""
        return self.front.mT


class NormalEquations(NamedTuple):
    r"""A Gauss-Newton system before damping. The Jacobian :math:`J` is divided by the focal length.

    Attributes:
        matrix: :math:`J^\top W J`, shape :math:`(6 + K, 6 + K, B)`.
        gradient: :math:`J^\top W r`, shape :math:`(6 + K, B)`.
        unit: number by which the weights of a problem were divided, shape :math:`(B, 1)`; ``None``: 1.
    """

    matrix: Tensor
    gradient: Tensor
    unit: Tensor | None = None


def project(state: State, problem: Problem) -> Projection:
    """Project the points of a problem, and subtract their pixels :math:`b`: the residual is :math:`f d (p, q) - b`.

    The depth of points behind the camera counts as infinite, so that values and gradients are finite.

    Example:
        >>> problem = Problem.of(torch.tensor([[[1.0, 2.0, 4.0]]]), torch.zeros(1, 1, 2), 100.0)
        >>> project(State.of(Pose(torch.eye(3)[None], torch.zeros(1, 3))), problem).residual.flatten()
        tensor([25., 50.])
    """
    rotation, world = state.pose.rotation, problem.world_points
    if are_few(world):  # a single call is faster
        rotated = torch.bmm(rotation, world.mT).permute(1, 2, 0)
    else:
        rotated = small_product(rotation.permute(1, 2, 0), world.permute(2, 1, 0))  # (3, N, B)
    points = rotated + state.pose.translation.mT[:, None]
    if problem.rig is not None:
        turned = (problem.rig.rotation.permute(2, 3, 1, 0) * points).sum(1)
        points = turned + problem.rig.translation.permute(2, 1, 0)
    x, y, z = points.unbind()
    least_slope = MIN_DEPTH_RATIO / math.sqrt(1.0 - MIN_DEPTH_RATIO**2)
    smallest = torch.finfo(z.dtype).tiny ** 0.5  # keeps the square of the inverse depth finite
    front = z > (least_slope * torch.addcmul(x * x, y, y).sqrt()).clamp(min=smallest)  # ONNX has no hypot
    inv_depth = torch.where(front, z, torch.inf).reciprocal()
    img = problem.img_points.permute(2, 1, 0)
    focal = problem.focal * state.camera[:, 0].exp() if state.camera.shape[1] else problem.focal
    across = points[:2]
    plane = across * inv_depth
    if state.camera.shape[1] < 2:
        scaled = torch.addcmul(focal * across, img, z, value=-1)
        return Projection(scaled * inv_depth, front, rotated, plane, inv_depth, scaled, focal, state)
    square = plane.square().sum(0)
    stretch, slope = torch.ones_like(square), torch.zeros_like(square)
    for power, coefficient in enumerate(state.radial.unbind(1), 1):
        stretch = stretch + coefficient * square**power
        slope = slope + 2.0 * power * coefficient * square ** (power - 1)
    residual = focal * stretch * plane - img
    scaled = residual * torch.where(front, z, 1.0)
    return Projection(residual, front, rotated, plane, inv_depth, scaled, focal, state, stretch, slope)


def pixel_variance(projection: Projection, noise: Noise) -> Tensor:
    r"""Variance of a pixel coordinate :math:`(B, N)`, from the noise of the pixel and of the world point.

    A shift of the point by :math:`d` in the camera's axes moves its pixel by :math:`J d` with
    :math:`J = \tfrac fz [I_2 \mid -(p, q)^\top]`. The mean of the variances of both coordinates is
    :math:`\sigma_\mathrm{img}^2 + \sigma_\mathrm{world}^2 (f/z)^2 (1 + (p^2 + q^2) / 2)`. A point behind the camera has
    only the noise of its pixel.

    Example:
        >>> problem = Problem.of(torch.tensor([[[0.0, 0.0, 4.0]]]), torch.zeros(1, 1, 2), 100.0)
        >>> projection = project(State.of(Pose(torch.eye(3)[None], torch.zeros(1, 3))), problem)
        >>> pixel_variance(projection, Noise(torch.tensor([[3.0]]), torch.tensor([[0.04]])))
        tensor([[10.]])
    """
    img = noise.img.mT
    moved = (projection.focal * noise.world.mT * projection.inv_depth).square()
    sides = projection.plane.square().sum(0)
    return torch.addcmul(torch.addcmul(moved, img, img), moved, sides, value=0.5).mT


def pixel_covariance(projection: Projection, problem: Problem, noise: Noise) -> Symmetric2:
    """Covariance of each pixel, entries (B, N), see :func:`pixel_variance`."""
    rotation = projection.state.pose.rotation[:, None]
    if problem.rig is not None:
        rotation = problem.rig.rotation @ rotation
    p, q = (x.mT for x in projection.plane.unbind())
    return covariance_at(rotation, p, q, (projection.focal * projection.inv_depth).mT, noise)


def covariance_at(rotation: Tensor, p: Tensor, q: Tensor, scale: Tensor, noise: Noise) -> Symmetric2:
    r"""Covariance of a pixel, from the noise of the pixel and of the world point.

    The covariance is :math:`\Sigma_\mathrm{img} + J R\,\Sigma_\mathrm{world} R^\top J^\top`. See :func:`pixel_variance`
    for :math:`J`. A standard deviation :math:`\sigma` gives :math:`\Sigma = \sigma^2 I`.

    Args:
        rotation: rotation from the world to the camera, :math:`(*, 1, 3, 3)` or :math:`(*, N, 3, 3)`.
        p: :math:`x/z`, shape :math:`(*, N)`.
        q: :math:`y/z`, shape :math:`(*, N)`.
        scale: focal length over depth, shape :math:`(*, N)`.
        noise: noise of each pair.
    """
    if noise.world_cov is None:
        moved = (scale * noise.world).square()
        uu, uv, vv = torch.addcmul(moved, moved * p, p), moved * p * q, torch.addcmul(moved, moved * q, q)
    else:
        first, second, third = (row.unbind(-1) for row in rotation.unbind(-2))
        a = [scale * torch.addcmul(i, p, k, value=-1) for i, k in zip(first, third, strict=True)]
        b = [scale * torch.addcmul(j, q, k, value=-1) for j, k in zip(second, third, strict=True)]
        of_a, of_b = noise.world_cov.times(a), noise.world_cov.times(b)
        uu, uv, vv = dot(a, of_a), dot(b, of_a), dot(b, of_b)
    if noise.img_cov is None:
        return Symmetric2(torch.addcmul(uu, noise.img, noise.img), uv, torch.addcmul(vv, noise.img, noise.img))
    return Symmetric2(uu + noise.img_cov.uu, uv + noise.img_cov.uv, vv + noise.img_cov.vv)


def information(projection: Projection, problem: Problem) -> tuple[Tensor, Tensor | Symmetric2]:
    """Compute squared residuals (B, N) in the unit of the robust kernel, and the information of the pixels.

    If the noise is ``None``, squared residuals are in square pixels, and the information is a 1 of shape (1, 1).
    Otherwise, all sigmas must be known. The information is the inverse covariance of each pixel if the noise has
    covariances, else the inverse variance (B, N). Squared residuals are weighted by the information.
    """
    noise = problem.noise
    if noise is None:
        return projection.sq_residual, problem.weights.new_ones(1, 1)
    if not noise.covariances:
        precision = pixel_variance(projection, noise).reciprocal()
        return projection.sq_residual * precision, precision
    inverse = pixel_covariance(projection, problem, noise).inverse()
    return inverse.form(*projection.residual.mT.unbind()), inverse


def normal_equations(
    projection: Projection, problem: Problem, weights: Tensor | Symmetric2, *, relative: bool = False
) -> NormalEquations:
    """Build the normal equations of the residuals for the pose and the unknown parameters of the camera.

    Args:
        projection: the problem projected at the state.
        problem: the problem.
        weights: the weight :math:`(B, N)` or the weight matrix (entries :math:`(B, N)`) of each pair, in inverse square
            pixels. Points behind the camera have no effect.
        relative: divide the weights of each problem by their largest value or trace, so that products of tiny weights
            do not underflow. The divisor has no gradient.
    """
    unit, sq_inverse = None, projection.inv_depth * projection.inv_depth
    if relative:
        sizes = weights if isinstance(weights, Tensor) else weights.uu + weights.vv
        sizes = sizes.detach() if torch.is_grad_enabled() else sizes
        unit = sizes.amax(1, keepdim=True).clamp(min=torch.finfo(sizes.dtype).tiny ** 0.5)
        weights = map_tensors(lambda w: w / unit, weights)
    weights = map_tensors(lambda w: w.mT * sq_inverse, weights)
    form = _stacked_equations if are_few(projection.inv_depth) else _entrywise_equations
    return NormalEquations(*form(projection, problem, weights), unit)


def _jacobian(projection: Projection, problem: Problem) -> Tensor:
    """The rows of the Jacobian for u and v, times z/f, shape (6 + K, 2, N, B).

    A row holds y × e for the rotation and e for the translation, where y = R x. The vector e is z times the gradient
    of p or q with respect to the point R x + t. Without a rig, the vectors e are (1, 0, -p) and (0, 1, -q).
    """
    plane = projection.plane
    if problem.rig is None:
        axes = torch.eye(3, dtype=plane.dtype, device=plane.device)[..., None, None]
    else:
        axes = problem.rig.rotation.permute(3, 2, 1, 0)
    shifts = torch.addcmul(axes[:, :2], plane, axes[:, 2:], value=-1)
    jacobian = torch.cat((torch.linalg.cross(projection.rotated[:, None], shifts, dim=0), shifts))
    unknown = projection.state.camera.shape[1]
    if not unknown:
        return jacobian
    moved_by = y3 = projection.rotated[2:]  # the depth of the origin grows with f, see `moved`
    if projection.stretch is not None and projection.slope is not None:
        # The Jacobian of the distortion is d I + slope (p, q) (p, q)^T.
        along = projection.slope * (plane * jacobian).sum(1, keepdim=True)
        jacobian = projection.stretch * jacobian + along * plane
        depth = torch.where(projection.front, y3[0] + projection.state.pose.translation[:, 2], 1.0)
        square = plane.square().sum(0)
        zoomed = projection.stretch * y3 - projection.slope * square * (depth - y3)
        moved_by = torch.cat((zoomed, *((depth * square**power)[None] for power in range(1, unknown))))
    camera = plane * moved_by[:, None]
    return torch.cat((jacobian, camera if projection.lens is None else camera + projection.lens))


def _stacked_equations(projection: Projection, problem: Problem, weights: Tensor | Symmetric2) -> tuple[Tensor, Tensor]:
    """Build the normal equations by one product of all columns, for few pairs."""
    jacobian = _jacobian(projection, problem)
    if isinstance(weights, Tensor):
        weighted = jacobian * weights
    else:
        (u, v), (uu, uv, vv) = jacobian.unbind(1), weights
        weighted = torch.stack((uu * u + uv * v, uv * u + vv * v), 1)
    right = torch.cat((jacobian, projection.scaled[None]))
    products = (weighted.flatten(1, 2)[:, None] * right.flatten(1, 2)).sum(2)  # (K, K + 1, B)
    return products[:, :-1], products[:, -1]


def _entrywise_equations(
    projection: Projection, problem: Problem, weights: Tensor | Symmetric2
) -> tuple[Tensor, Tensor]:
    """Build the normal equations entry by entry. The temporary tensors have the shape (N, B) and fit into the cache."""
    columns = _columns(projection, problem)
    uu, uv, vv = (weights, 0.0, weights) if isinstance(weights, Tensor) else weights
    total = uu.sum(0)
    zero = torch.zeros_like(total)
    weighted = [(_plus(_times(u, uu), _times(v, uv)), _plus(_times(u, uv), _times(v, vv))) for u, v in columns]

    def inner(a: _Column, b: _Column) -> Tensor:
        """Inner product (B,) of two columns: the sum over u, v and all pairs."""
        (a_u, a_v), (b_u, b_v) = a, b
        if type(a_u) is type(a_v) is type(b_u) is type(b_v):
            return torch.addcmul(a_u * b_u, a_v, b_v).sum(0)
        products = [x for x in (_times(a_u, b_u), _times(a_v, b_v)) if type(x) is not float]
        if not products:
            return zero
        return total if products[0] is uu else products[0].sum(0)

    # Columns 3 and 4 of `_columns` can be constants. The inner product with a constant column is only a sum.
    size = range(len(columns))
    lower = {
        (i, j): inner(weighted[j], columns[i]) if i < 5 else inner(weighted[i], columns[j])
        for i in size
        for j in size[: i + 1]
    }
    matrix = torch.stack([lower[max(i, j), min(i, j)] for i in size for j in size]).unflatten(0, (len(size), len(size)))
    u, v = projection.scaled
    return matrix, torch.stack([inner(column, (u, v)) for column in weighted])


def _columns(projection: Projection, problem: Problem) -> list[_Column]:
    """The columns of :func:`_jacobian`. Without rig and distortion, two columns are constant, which saves time."""
    if problem.rig is not None or projection.stretch is not None or projection.lens is not None:
        return [(u, v) for u, v in _jacobian(projection, problem)]
    y1, y2, y3 = projection.rotated.unbind()
    p, q = projection.plane.unbind()
    minus_p, minus_q = (-projection.plane).unbind()
    pose: list[_Column] = [
        (minus_p * y2, torch.addcmul(-y3, minus_q, y2)),
        (torch.addcmul(y3, p, y1), q * y1),
        (-y2, y1),
        (1.0, 0.0),
        (0.0, 1.0),
        (minus_p, minus_q),
    ]
    return [*pose, (p * y3, q * y3)] if projection.state.camera.shape[1] else pose


def _cross(a: list[Tensor], b: list[Tensor]) -> list[Tensor]:
    return [torch.addcmul(a[i] * b[j], a[j], b[i], value=-1) for i, j in ((1, 2), (2, 0), (0, 1))]


def _times(a: Any, b: Any) -> Any:
    """The product of two factors, without multiplication if one factor is the Python number 0 or 1."""
    if type(a) is float:
        return b if a == 1.0 else 0.0
    if type(b) is float:
        return a if b == 1.0 else 0.0
    return a * b


def _plus(a: Any, b: Any) -> Any:
    """The sum of two terms, without addition if one term is the Python number 0."""
    return b if type(a) is float else a if type(b) is float else a + b


def lm_step(
    equations: NormalEquations, state: State, focal: Tensor, step: Tensor, damping: Tensor, *, additive: bool
) -> tuple[State, Tensor]:
    r"""Solve the damped normal equations and move the state.

    .. math:: \beta \leftarrow \beta - \gamma\,(J^\top W J + \lambda\,\mathrm{diag}(J^\top W J))^{-1} J^\top W r

    Source: R. Sheffer and A. Wiesel, "PnP-Net: A hybrid Perspective-n-Point Network", 2020, section 3. D. Marquardt
    (1963) proposed the damping by the diagonal.

    The state :math:`\beta`, ``focal``, ``step`` :math:`\gamma` and ``damping`` :math:`\lambda` are those of B problems;
    the last three can be scalars. With ``additive``, the rotation vector is updated as in the paper, instead of by the
    retraction. The second result tells which equations could be solved, bool (B,). The other states do not change.
    """
    if not additive:
        delta, solved = solve_positive(equations.matrix, equations.gradient, damping)
        return moved(state, delta * (-step / focal)), solved
    # The derivative of the tangent vector with respect to the rotation vector is the left Jacobian of SO(3).
    rvec = rotation_matrix_to_axis_angle(state.pose.rotation)
    size, matrix = len(equations.gradient), equations.matrix.permute(2, 0, 1)
    eye = torch.eye(size, dtype=rvec.dtype, device=rvec.device)
    tangent = eye + functional.pad(So3.left_jacobian(rvec) - eye[:3, :3], (0, size - 3, 0, size - 3))
    gradient = (tangent.mT @ equations.gradient.mT[..., None])[..., 0].mT
    delta, solved = solve_positive((tangent.mT @ matrix @ tangent).permute(1, 2, 0), gradient, damping)
    delta = delta * (-step / focal)
    pose = state.pose._replace(rotation=axis_angle_to_rotation_matrix(rvec + delta[:3].mT))
    return moved(State(pose, state.camera), torch.cat((torch.zeros_like(delta[:3]), delta[3:]))), solved


def moved(state: State, delta: Tensor) -> State:
    r"""Move a state along a tangent vector :math:`(\omega, v, c)`, shape :math:`(6 + K, B)`.

    The pose becomes :math:`(\mathrm{cay}(\omega) R,\; t + v)`. With a centred world, a rotation leaves the centroid in
    place, so that rotation and translation are well separated in the normal equations. The Cayley transform
    :math:`\mathrm{cay}(\omega) = (I - \tfrac12[\omega]_\times)^{-1}(I + \tfrac12[\omega]_\times)` agrees with the
    exponential map to second order, and needs no trigonometry. The rotation angle is :math:`2 \arctan(|\omega|/2)`.

    The parameters of the camera change by :math:`c`, which is clipped. A larger focal length also moves the camera away
    (a dolly zoom), so that the origin keeps its pixel and its scale.
    """
    turn, rotation = delta[:3, None], state.pose.rotation.permute(1, 2, 0)
    size = turn.square().sum(0) + 4.0
    if not compiling():
        once = torch.linalg.cross(turn, rotation, dim=0)
        both = torch.add(once, torch.linalg.cross(turn, once, dim=0), alpha=0.5)
        rotation = torch.addcdiv(rotation, both, size, value=4.0)
    else:  # entry by entry, because compiled `linalg.cross` computes `turn` and `size` again for each entry
        columns = [_cross([*turn[:, 0]], [*column]) for column in rotation.unbind(1)]
        twice = [_cross([*turn[:, 0]], column) for column in columns]
        sums = [[x + 0.5 * y for x, y in zip(*pair, strict=True)] for pair in zip(columns, twice, strict=True)]
        rotation = torch.addcmul(rotation, 4.0 / size, torch.stack([torch.stack(x) for x in sums], 1))
    rotation = rotation.permute(2, 0, 1)
    translation = state.pose.translation + delta[3:6].mT
    if not state.camera.shape[1]:
        return State(Pose(rotation, translation), state.camera)
    zoom = delta[6:7].clamp(-_LARGEST_ZOOM, _LARGEST_ZOOM)
    change = zoom
    if state.camera.shape[1] > 1:
        change = torch.cat((zoom, delta[7:].clamp(-_LARGEST_RADIAL, _LARGEST_RADIAL)))
    translation = translation * functional.pad(zoom.mT.exp(), (2, 0), value=1.0)
    return State(Pose(rotation, translation), state.camera + change.mT)


def retract(pose: Pose, delta: Tensor) -> Pose:
    r"""Move a pose along :math:`(\omega, v)`, shape :math:`(B, 6)`, as :func:`moved` does for a known camera.

    Example:
        >>> pose = Pose(torch.eye(3)[None], torch.zeros(1, 3))
        >>> retract(pose, torch.tensor([[0.0, 0.0, 0.0, 1.0, 2.0, 3.0]])).translation
        tensor([[1., 2., 3.]])
    """
    return moved(State.of(pose), delta.mT).pose


def tangent(rotation: Tensor) -> Tensor:
    r"""The vector :math:`\omega` with :math:`\mathrm{cay}(\omega) = R`, :math:`(*, 3)`, bounded near half turns."""
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
    return 2.0 * So3.vee(rotation - rotation.mT) / (1.0 + trace).clamp(min=_LEAST_DENOMINATOR)


def rotation_angle(rotation_a: Tensor, rotation_b: Tensor) -> Tensor:
    r"""Angles in radians, in [0, π], between rotations :math:`(*, 3, 3)`; the result has the shape :math:`(*)`.

    The arctangent is accurate for small angles, unlike the arccosine. The angle is not differentiable at 0. For
    training, use :mod:`kornia_pnpnet.losses`.

    Example:
        >>> quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        >>> torch.rad2deg(rotation_angle(quarter, torch.eye(3)))
        tensor(90.)
    """
    diff = rotation_a @ rotation_b.mT
    sine = 0.5 * So3.vee(diff - diff.mT).norm(dim=-1)
    cosine = 0.5 * (diff.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0)
    return torch.atan2(sine, cosine)
