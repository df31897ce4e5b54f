"""Find the range of an unknown focal length, and a first estimate of focal length and pose."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from kornia_pnpnet.cameras import pinholes, with_undistorted
from kornia_pnpnet.core.linalg import relative
from kornia_pnpnet.core.performance import ranked
from kornia_pnpnet.core.trees import map_tensors, put, take
from kornia_pnpnet.frame import F_CONST, Normalize, focal_length, may_be_confidence
from kornia_pnpnet.problem import MIN_PAIRS, Inputs, Problem, State
from kornia_pnpnet.propose.p3p import P3P
from kornia_pnpnet.propose.ransac import RANSAC
from kornia_pnpnet.propose.scoring import as_entries
from kornia_pnpnet.propose.search import CAUCHY, cauchy_scale, least_squares
from kornia_pnpnet.refine.residual import project
from kornia_pnpnet.refine.terms import CameraTerm
from kornia_pnpnet.result import Pose

__all__ = ["as_dist", "distorted", "find_focal", "scale_focal", "with_found_focal", "with_nominal_focal"]

# Shortest and longest focal length of the search, in half image widths. The fields of view are 118 and 14 degrees.
_SHORTEST, _LONGEST = 0.6, 8.0
# Half the range of log f.
_WIDTH = 0.5 * math.log(_LONGEST / _SHORTEST)
# Ratio of half the image width to the median distance (maximum norm) of the pixels from the centre. The ratio is exact
# for pixels that are uniformly distributed in a square image.
_HALF_WIDTH = math.sqrt(2.0)
# If the caller expects a focal length, half the range of log f is this number of standard deviations.
_SEARCHED = 2.0
# Inlier threshold in pixels of the normalised camera: 0.65 % of half the image width at the middle focal length.
_THRESHOLD = 10.0
_FINDER = RANSAC(P3P(), threshold=_THRESHOLD, confidence=0.99, final_steps=3)
# RANSAC for problems that the refinement did not solve. Further iterations of the refinement follow.
_FURTHER = RANSAC(P3P(), threshold=_THRESHOLD, confidence=0.99, min_samples=64, final_steps=1)
# Number of steps of `_with_distortion`.
_STEPS = 14
# Lower bound, in focal lengths, of the kernel's scale in the first step. For example, a distortion of k1 = 0.2 shifts a
# pixel at a radius of 0.7 by 0.2 * 0.7^3 = 0.07.
_WIDE = 0.07
# After each step, the lower bound of the scale is multiplied by _SHRINK, but never falls below _LEAST.
_SHRINK, _LEAST = 0.6, 1e-5


def with_nominal_focal(inputs: Inputs, sigma: float | None, radial: int) -> Inputs:
    """Replace each focal length by the middle of the searched range, and describe this range in ``free_focal``.

    If ``sigma`` (the standard deviation of log f) is given, the range lies around the caller's focal length. Otherwise
    the range is proportional to the size of the image. The size is the larger of two estimates: twice the principal
    point, and a multiple of the median distance of the pixels from the principal point. The aspect ratio and the signs
    of fx and fy are kept. Matrices that are not pinhole cameras become NaN. ``radial`` is the number of coefficients of
    radial distortion to estimate.
    """
    camera, is_pinhole = pinholes(inputs.intrinsics)
    given = focal_length(camera)  # (B,)
    if sigma is None:
        with torch.no_grad():
            principal_point = camera[:, None, :2, 2]
            away = (inputs.img_points - principal_point).abs().amax(-1)  # (B, N)
            there = away < torch.inf  # NaN compares false
            for given_pairs in (inputs.mask, inputs.weights):
                there = there if given_pairs is None else there & (given_pairs > 0)
            there = there if inputs.confidence is None else there & may_be_confidence(inputs.confidence)
            median = ranked(torch.where(there, away, torch.inf).mT[None], (there.sum(1) - 1) // 2)[0]
            half = (_HALF_WIDTH * median).maximum(principal_point[:, 0].abs().amax(-1))
            half = torch.where(half.isfinite() & (half > 0), half, 1.0)
        nominal = expected = math.sqrt(_SHORTEST * _LONGEST) * half
        width, precision = _WIDTH, 0.0 if radial else None  # with `None`, the distortion would have no prior
    else:
        nominal, expected = given.detach(), given
        width, precision = min(_SEARCHED * sigma, _WIDTH), sigma**-2
    information = None if precision is None else torch.full_like(nominal, precision)
    known = CameraTerm(expected, information, torch.full_like(nominal, width), nominal)
    camera = scale_focal(camera, nominal / given)
    return inputs._replace(intrinsics=torch.where(is_pinhole[:, None, None], camera, torch.nan), free_focal=known)


def scale_focal(intrinsics: Tensor, factor: Tensor) -> Tensor:
    """Multiply the focal lengths and the skew of camera matrices (B, 3, 3) by a factor (B,)."""
    return intrinsics * functional.pad(factor[:, None, None].expand(-1, 2, 2), (0, 1, 0, 1), value=1.0)


def with_found_focal(inputs: Inputs, radial: int) -> Inputs:
    """Estimate the focal lengths. If the caller gave no poses, also estimate the poses.

    RANSAC tries P3P at the focal lengths of a grid. Least squares on the inliers improve pose and focal length. If
    ``radial`` is not 0, distortion is also estimated and removed. ``inputs`` come from :func:`with_nominal_focal`.
    """
    normalize, known = Normalize(order=False), inputs.free_focal
    with torch.no_grad():
        problem, frame = normalize(*inputs[:5], confidence=inputs.confidence)
        one = torch.ones_like(problem.img_scale)
        found = _FINDER(problem._replace(img_scale=one, free_focal=known.scaled(frame.img_scale)))
        zoom = torch.where(found.camera[:, 0].isfinite(), found.camera[:, 0], 0.0)
    pose = frame.undo(found.pose)
    inputs = _zoomed(inputs, zoom)
    if radial:
        with torch.no_grad():
            problem, frame = normalize(*inputs[:5], confidence=inputs.confidence)
            # `_with_distortion` uses only the prior of the distortion. The refinement also uses the prior of log f.
            known = known._replace(information=torch.zeros_like(zoom)).scaled(frame.img_scale)
            weights = relative(problem.weights, problem.weights)
            at = _with_distortion(problem._replace(weights=weights, free_focal=known), frame.apply(pose), radial)
            finite = frame.valid & (at.pose.translation.sum(-1) + at.camera.sum(-1)).isfinite()
            rows = finite.nonzero()[:, 0]
            pose = put(pose, rows, take(frame.undo(at.pose), rows))
            camera = torch.where(finite[:, None], at.camera, 0.0)
        inputs = _zoomed(inputs, camera[:, 0])
        inputs = with_undistorted(inputs, as_dist(camera[:, 1:]), None)
        inputs = inputs._replace(radial=camera[:, 1:], lens_scale=None)  # the refinement distorts the pixels again
    if inputs.init is not None:  # a given pose that is not finite is ignored
        sound = as_entries(inputs.init).isfinite().all(-1)
        pose = map_tensors(lambda x, y: torch.where(sound.view(-1, *(1,) * (x.ndim - 1)), x, y), inputs.init, pose)
    return inputs._replace(init=pose)


@torch.no_grad()
def find_focal(problem: Problem, state: State, doubted: Tensor) -> tuple[State, Tensor]:
    """Run RANSAC where ``doubted``, bool (B,), is true, and replace the states for which RANSAC finds a pose.

    A problem is doubted if its refined pose is not ``ok``. Also returns whether RANSAC found a pose, bool (B,).
    """
    rows = doubted.nonzero()[:, 0]
    if not len(rows):
        return state, doubted
    some = take(problem, rows)
    found = _FURTHER(some._replace(img_scale=(some.focal / F_CONST).expand(len(rows))))
    usable = found.ok & found.camera.isfinite().all(1)
    state = put(state, rows[usable], take(State(found.pose, found.camera), usable))
    return state, doubted.index_put((rows,), usable)


def _zoomed(inputs: Inputs, zoom: Tensor) -> Inputs:
    """Multiply the focal lengths of the inputs by the exponential of ``zoom`` (B,)."""
    known = inputs.free_focal._replace(focal=inputs.free_focal.focal * zoom.exp())
    return inputs._replace(intrinsics=scale_focal(inputs.intrinsics, zoom.exp()), free_focal=known)


def distorted(problem: Problem, coefficients: Tensor) -> Problem:
    """Apply radial distortion with the coefficients (B, K) to undistorted pixels and to their noise."""
    p, q = (problem.img_points / problem.focal).unbind(-1)
    square = torch.addcmul(p * p, q, q)
    stretch, slope = torch.ones_like(square), torch.zeros_like(square)
    for power, k in enumerate(coefficients.unbind(1)):
        stretch = stretch + k[:, None] * square ** (power + 1)
        slope = slope + 2.0 * (power + 1) * k[:, None] * square**power
    noise = problem.noise
    if noise is not None:
        with torch.no_grad():
            along = stretch + slope * square
            growth = (0.5 * (stretch**-2 + along**-2)).sqrt()  # `cameras.undistort` multiplies sigma by this factor
            turned = stretch + slope * p * p, slope * p * q, stretch + slope * q * q, slope * p * q
        cov = None if noise.img_cov is None else noise.img_cov.mapped(*turned)
        noise = noise._replace(img=noise.img / growth, img_cov=cov)
    return problem._replace(img_points=stretch[..., None] * problem.img_points, noise=noise)


def as_dist(coefficients: Tensor) -> Tensor:
    """Pad the coefficients (B, K) of radial distortion to (k1, k2, 0, 0), shape (B, 4)."""
    return functional.pad(coefficients, (0, 4 - coefficients.shape[1]))


def _with_distortion(problem: Problem, pose: Pose, radial: int) -> State:
    """Estimate pose, focal length and radial distortion by Gauss-Newton steps with a Cauchy kernel.

    The scale of the kernel is proportional to the median residual, with a lower bound that shrinks at each step.
    """
    state = State(pose, problem.weights.new_zeros(problem.weights.shape[0], 1 + radial))
    limit = _WIDE
    for _ in range(_STEPS):
        projection = project(state, problem)
        seen, sq_residual = projection.in_front & (problem.weights > 0), projection.sq_residual
        sq_limit = (limit * projection.focal).square()[:, None]
        sq_scale = cauchy_scale(sq_residual, seen & (sq_residual <= CAUCHY**2 * sq_limit), MIN_PAIRS + 1)
        sq_scale = sq_scale.nan_to_num(posinf=0.0).maximum(sq_limit)
        weights = torch.where(seen, 1.0 / (1.0 + sq_residual / sq_scale), 0.0)
        state = least_squares(problem, projection, weights, sq_scale / CAUCHY**2)
        limit = max(_SHRINK * limit, _LEAST)
    return state
