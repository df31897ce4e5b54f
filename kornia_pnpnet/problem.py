"""The data in a solver's frame: problems, noise, states, prior terms, and starts of the refinement.

Tensors of pairs have the shapes ``(B, N)`` and ``(B, N, C)``. In memory the batch is the last dimension, see
``kornia_pnpnet.core.performance.problems_last``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from kornia_pnpnet.core.symmetric import Symmetric2, Symmetric3
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.result import Pose, PosePrior

__all__ = [
    "LEAST_DEPTH",
    "LEAST_NOISE",
    "MIN_PAIRS",
    "Hypotheses",
    "Inputs",
    "Linear",
    "Noise",
    "Problem",
    "Starts",
    "State",
    "Term",
]

#: Least standard deviation of a pixel, in focal lengths. This bound keeps the weights of exact pixels finite.
LEAST_NOISE = 1e-6
#: Least number of pairs that determine a pose up to a few solutions.
MIN_PAIRS = 3
#: Least depth, in units of the normalised world, at which the noise of points is converted to pixels.
LEAST_DEPTH = 0.5


class State(NamedTuple):
    r"""The unknowns that a refinement estimates.

    Attributes:
        pose: world-to-camera poses.
        camera: unknown parameters of the camera. :attr:`zoom` comes first, then the coefficients :math:`k_1, k_2` of
            radial distortion, shape :math:`(B, K)`; :math:`K = 0` for a known camera.
    """

    pose: Pose
    camera: Tensor

    @classmethod
    def of(cls, pose: Pose) -> State:
        """The state of poses with known cameras."""
        return cls(pose, pose.translation[:, :0])

    @property
    def zoom(self) -> Tensor:
        """The logarithm of f / ``Problem.focal`` for a focal length f, :math:`(B, 1)`; :math:`(B, 0)` if f is known."""
        return self.camera[:, :1]

    @property
    def radial(self) -> Tensor:
        """Coefficients of radial distortion, shape :math:`(B, 0)` to :math:`(B, 2)`."""
        return self.camera[:, 1:]


class Noise(NamedTuple):
    r"""The noise of each pair: isotropic standard deviations, and the covariances that the caller gave.

    Attributes:
        img: standard deviation of each pixel coordinate, NaN where unknown, shape :math:`(B, N)`. If ``img_cov``
            is given, ``img`` is the sigma of isotropic noise with the same trace. Networks ignore ``img_cov``.
        world: standard deviation of each world coordinate; see ``img``.
        img_cov: covariance of the pixel, each entry of shape :math:`(B, N)`. ``None``: the noise is isotropic.
        world_cov: covariance of the world point; see ``img_cov``.
    """

    img: Tensor
    world: Tensor
    img_cov: Symmetric2 | None = None
    world_cov: Symmetric3 | None = None

    def bounded(self, focal: Tensor) -> Noise:
        """Raise the sigma of each pixel to at least :data:`LEAST_NOISE` times the focal length."""
        return self._replace(img=self.img.maximum(LEAST_NOISE * focal))

    @property
    def sigmas(self) -> Noise:
        """A copy whose covariances are ``None``."""
        return self._replace(img_cov=None, world_cov=None)

    @property
    def covariances(self) -> list[Symmetric2 | Symmetric3]:
        """The covariances that are not ``None``."""
        return [x for x in (self.img_cov, self.world_cov) if x is not None]


class Inputs(NamedTuple):
    """The arguments of :meth:`~kornia_pnpnet.solver.PnPNet.forward` as one batch in one dtype.

    Attributes:
        intrinsics: in a rig, a camera matrix for each pair, :math:`(B, N, 3, 3)`.
        noise: noise of every pair, NaN where unknown; ``None``: the caller gave no noise.
        rig: the transform from the rig to the camera of each pair.
        free_focal: range and prior of an unknown focal length in the caller's pixels, see :class:`Problem`.
        radial: coefficients of the radial distortion that ``with_found_focal`` estimated and removed from the pixels.
        lens_scale: number of undistorted pixels per distorted pixel at each pair, without gradient, shape
            :math:`(B, N)`; ``None``: the refinement fits the caller's pixels.
    """

    world_points: Tensor
    img_points: Tensor
    intrinsics: Tensor
    weights: Tensor | None = None
    mask: Tensor | None = None
    init: Pose | None = None
    noise: Noise | None = None
    confidence: Tensor | None = None
    prior: PosePrior | None = None
    rig: Pose | None = None
    free_focal: Any = None
    radial: Tensor | None = None
    lens_scale: Tensor | None = None


class Linear(NamedTuple):
    r"""A term linearised at a state. The loss of the term is about :math:`w (r + J \delta)^\top \Omega (r + J \delta)`.

    Attributes:
        residual: :math:`r`, shape :math:`(B, D)`.
        jacobian: :math:`J`, the derivative of :math:`r` with respect to the tangent vector :math:`\delta` of
            :func:`~kornia_pnpnet.refine.residual.moved`, shape :math:`(B, D, 6 + K)`.
        information: :math:`\Omega`, shape :math:`(B, D, D)`.
        weight: robust weight :math:`w`, shape :math:`(B,)`.
    """

    residual: Tensor
    jacobian: Tensor
    information: Tensor
    weight: Tensor


class Term(Protocol):
    """A prior of the pose or of the camera. A term is a tuple of tensors whose first dimension is the batch."""

    def linearise(self, state: State) -> Linear:
        """Linearise the term at a state."""

    def loss(self, state: State) -> Tensor:
        """Robust loss in squared standard deviations, shape (B,)."""

    def disagreement(self, pose: Pose) -> Tensor:
        """Penalty for a pose's difference from the prior, added to the loss in searches. The unit is an outlier's loss.

        The batch of the poses, for example :math:`(H, B)` or :math:`(P, H)`, broadcasts with the batch of the term.
        """


class Problem(NamedTuple):
    r"""A batch of problems in the solver's frame, made by :class:`~kornia_pnpnet.frame.Normalize`.

    Attributes:
        world_points: points of the (possibly centred and scaled) world, shape :math:`(B, N, 3)`.
        img_points: pixels of a camera with focal length ``focal`` and principal point 0, shape :math:`(B, N, 2)`.
        weights: weight of each pair, at least 0, and 0 for padding, shape :math:`(B, N)`.
        focal: the focal length in pixels (if unknown, the initial value), a scalar that all problems share.
        img_scale: number of pixels of ``img_points`` per pixel of the caller, shape :math:`(B,)`.
        world_scale: number of units of ``world_points`` per unit of the caller's world, shape :math:`(B,)`.
        usual: 1 for usual pairs (see :class:`~kornia_pnpnet.frame.Normalize`), else 0, shape :math:`(B, N)`.
        noise: noise of each pair in the units of ``img_points`` and ``world_points``, NaN where unknown.
        confidence: the caller's belief, in [0, 1], that a pair is an inlier, NaN where unknown, shape :math:`(B, N)`.
        rig: the transform from the rig to the camera of each pair, :math:`(B, N, 3, 3)` and :math:`(B, N, 3)`. The pose
            of the problem is then the pose of the rig. ``None``: one camera.
        pose_terms: priors of the pose, such as :class:`~kornia_pnpnet.refine.terms.PoseTerm`.
        free_focal: range and prior of an unknown focal length, a :class:`~kornia_pnpnet.refine.terms.CameraTerm`.
            ``None``: the focal length is known.
    """

    world_points: Tensor
    img_points: Tensor
    weights: Tensor
    focal: Tensor
    img_scale: Tensor
    world_scale: Tensor
    usual: Tensor
    noise: Noise | None = None
    confidence: Tensor | None = None
    rig: Pose | None = None
    pose_terms: tuple[Term, ...] = ()
    free_focal: Any = None

    @classmethod
    def of(cls, world_points: Tensor, img_points: Tensor, focal: Tensor | float = 1.0, **more: Any) -> Problem:
        """A problem without normalisation. Weights, ``usual`` and scales are 1 unless given in ``more``."""
        one = torch.ones_like(world_points[..., 0])
        scale = one.new_ones(one.shape[0])
        given = {"weights": one, "usual": one, "img_scale": scale, "world_scale": scale, **more}
        return cls(world_points, img_points, focal=torch.as_tensor(focal).to(one), **given)

    @property
    def terms(self) -> tuple[Term, ...]:
        """The priors of pose and camera, which the refinement adds to its loss."""
        return self.pose_terms + self.camera_terms

    @property
    def camera_terms(self) -> tuple[Term, ...]:
        """The prior of the camera; empty if neither ``focal_sigma`` nor ``radial`` is given."""
        known = self.free_focal is not None and self.free_focal.information is not None
        return (self.free_focal,) if known else ()

    @property
    def usual_weights(self) -> Tensor:
        """Weights for non-robust initialisers, 0 for unusual pairs, shape :math:`(B, N)`."""
        return self.weights * self.usual

    @property
    def places(self) -> Tensor:
        """The pixel of each pair, (B, N, 2); in a rig, its ray of length ``focal`` in the rig's frame, (B, N, 3)."""
        if self.rig is None:
            return self.img_points
        plane_points = self.img_points / self.focal
        rays = torch.cat((plane_points, torch.ones_like(plane_points[..., :1])), -1)
        rays = self.focal * torch.nn.functional.normalize(rays, dim=-1)
        return (self.rig.rotation * rays[..., None]).sum(-2)

    @property
    def centres(self) -> Tensor:
        """The centre of each pair's camera in the frame of the rig, :math:`(B, N, 3)`."""
        assert self.rig is not None
        return -(self.rig.rotation * self.rig.translation[..., None]).sum(-2)

    def seen_with(self, zoom: Tensor) -> Problem:
        """The same pairs with the known focal length ``focal * exp(zoom)``. ``zoom`` has the shape (B, 1) or (B, 0)."""
        # All problems share `focal`, so exp(zoom) divides pixels and their noise instead.
        if not zoom.shape[1]:
            return self
        factor = (-zoom).exp()
        noise = self.noise
        if noise is not None:
            cov = None if noise.img_cov is None else noise.img_cov.mapped(factor, torch.zeros_like(factor), factor)
            noise = noise._replace(img=noise.img * factor, img_cov=cov)
        pixels, scale = self.img_points * factor[..., None], self.img_scale * factor[:, 0]
        return self._replace(img_points=pixels, noise=noise, img_scale=scale, free_focal=None)

    def map(self, function: Callable[[Tensor], Tensor]) -> Problem:
        """Apply a function to every tensor."""
        return map_tensors(function, self)


class Starts(NamedTuple):
    r"""The result of an initialiser: poses to refine, and weights and noise of the pairs.

    Attributes:
        pose: a coarse pose in the frame of the :class:`Problem`.
        weights: factor, at least 0, that multiplies the weight of each pair, shape :math:`(B, N)`.
        ok: whether a pose was found (degenerate pairs may have no pose), bool, shape :math:`(B,)`; ``None``: all true.
        others: more poses, rotations :math:`(B, S, 3, 3)` and translations :math:`(B, S, 3)`; ``None``: no others.
        noise: noise of each pair in the units of the problem, without covariances. The initialiser estimates the noise
            that the caller did not give. ``None``: the initialiser does not estimate noise.
        camera: initial camera parameters for all poses, see :class:`State`; ``None``: zeros.
    """

    pose: Pose
    weights: Tensor
    ok: Tensor | None = None
    others: Pose | None = None
    noise: Noise | None = None
    camera: Tensor | None = None

    @property
    def poses(self) -> list[Pose]:
        """``pose`` and ``others`` in one list, each pose with the shapes :math:`(B, 3, 3)` and :math:`(B, 3)`."""
        if self.others is None:
            return [self.pose]
        return [self.pose, *map(Pose, self.others.rotation.unbind(-3), self.others.translation.unbind(-2))]

    def with_others(self, *more: Pose) -> Starts:
        """Add more poses to ``others``."""
        every = [*self.poses[1:], *more]
        return self._replace(others=map_tensors(lambda *x: torch.stack(x, 1), *every)) if every else self


class Hypotheses(NamedTuple):
    r"""The result of a minimal solver: up to :math:`S` poses for each sample.

    Attributes:
        pose: rotations :math:`(B, S, 3, 3)` and translations :math:`(B, S, 3)` in the frame of the sample.
        valid: which slots hold a solution, bool, shape :math:`(B, S)`. Empty slots have finite values.
    """

    pose: Pose
    valid: Tensor
