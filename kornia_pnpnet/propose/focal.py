r"""An unknown focal length: where to look for it, and a first estimate of it together with a pose."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from kornia_pnpnet.cameras import undistort
from kornia_pnpnet.core.performance import ranked
from kornia_pnpnet.propose import P3P, RANSAC
from kornia_pnpnet.propose.set import SetInit
from kornia_pnpnet.inputs import Inputs, with_undistorted
from kornia_pnpnet.frame import Frame, Normalize
from kornia_pnpnet.refine import LMStart, LMStep, RobustWeightedLM
from kornia_pnpnet.refine.radial import distorted, estimate_radial, refine_radial, rescaled
from kornia_pnpnet.types import Problem, FreeFocal, PnPResult, Pose

__all__ = [
    "MORE_ITERATIONS",
    "find_focal",
    "finds_focal",
    "free_focal_in_frame",
    "guesses_focal",
    "is_doubtful",
    "iterate_with_radial",
    "scale_focal",
    "with_found_focal",
    "with_nominal_focal",
]

#: Further iterations from the nominal focal length: the least that converge with 1000 pairs. With 2, 4 and 8 of them
#: the median error of the focal length is 0.037, 0.029 and 0.030 % (CameraProblems, seeds 4321, 4322, half outliers).
MORE_ITERATIONS = 4
# Half widths of the image: the focal lengths of fields of view from 118 to 14 degrees, which are searched.
_SHORTEST, _LONGEST = 0.6, 8.0
# Half of this range in logarithms.
_WIDTH = 0.5 * math.log(_LONGEST / _SHORTEST)
# Half the width of a square over the median distance, in the maximum norm, of a point in it from its middle.
_HALF_WIDTH = math.sqrt(2.0)
# Standard deviations of an expected focal length that are searched on either side.
_SEARCHED = 2.0
# Pixels of a camera whose focal length is in the middle of the range: 0.65 % of half the width of the image. The least
# threshold of an inlier; near the right focal length on the grid of the search, inliers have larger residuals.
_THRESHOLD = 10.0
# Least probability of a pose that started with the nominal focal length. Of problems with 50 % outliers (n = 12, seeds
# 7700 to 7709 of CameraProblems), 0.4 to 0.6 % have more and are wrong, as are 0.6 % of those of the oracle.
_CONVINCING = 0.97
_FINDER = RANSAC(P3P(), threshold=_THRESHOLD, min_samples=16, confidence=0.99)


def finds_focal(init: object) -> bool:
    """Whether an initialiser estimates an unknown focal length itself."""
    return isinstance(init, RANSAC) and isinstance(init.minimal, P3P)


def guesses_focal(init: object, inputs: Inputs) -> bool:
    """Whether the refinement can correct a nominal focal length.

    The poses of a network with a nominal focal length are near enough. A caller's pose does not fit the focal length.
    """
    return isinstance(init, SetInit) and inputs.init is None and inputs.prior is None


def is_doubtful(result: PnPResult) -> Tensor:
    """Whether a solution that started with the nominal focal length is not convincing, bool (B,)."""
    assert result.probability is not None
    return ~result.ok | (result.probability < _CONVINCING)


def with_nominal_focal(inputs: Inputs, sigma: float | None) -> Inputs:
    """Give the cameras the focal length in the middle of the range in which theirs is searched.

    The range is that of the caller's focal length and its ``sigma`` where there is one. Otherwise it follows from the
    size of the image, which is twice the principal point, or what the pixels cover where this is more.

    Args:
        inputs: the problems.
        sigma: standard deviation of the logarithm of the focal length in the intrinsics; ``None``: ignore it.

    Returns:
        The problems with other cameras and ``free_focal``. The aspect ratio of the pixels is kept.
    """
    camera = inputs.intrinsics / inputs.intrinsics[:, 2:, 2:]
    given = (camera[:, 0, 0] * camera[:, 1, 1]).sqrt()  # (B,)
    if sigma is None:
        with torch.no_grad():
            principal_point = camera[:, None, :2, 2]
            away = (inputs.img_points - principal_point).abs().amax(-1)  # (B, N)
            there = away < torch.inf  # NaN compares false
            there = there if inputs.mask is None else there & inputs.mask
            there = there if inputs.weights is None else there & (inputs.weights > 0)
            median = ranked(torch.where(there, away, torch.inf).mT[None], (there.sum(1) - 1) // 2)[0]
            half = (_HALF_WIDTH * median).maximum(principal_point[:, 0].abs().amax(-1))
            half = torch.where(half.isfinite() & (half > 0), half, 1.0)
        nominal = math.sqrt(_SHORTEST * _LONGEST) * half
        width = torch.full_like(nominal, _WIDTH)
        known = FreeFocal(nominal, torch.zeros_like(nominal), width, torch.ones_like(nominal))
    else:
        nominal = given.detach()
        width = torch.full_like(nominal, min(_SEARCHED * sigma, _WIDTH))
        known = FreeFocal(given, torch.full_like(nominal, sigma**-2), width, torch.ones_like(nominal))
    return inputs._replace(intrinsics=scale_focal(camera, nominal / given), free_focal=known)


def scale_focal(intrinsics: Tensor, factor: Tensor) -> Tensor:
    """Multiply the focal lengths and the skew of camera matrices (B, 3, 3) by a factor (B,)."""
    first, rest = intrinsics.split((2, 1), 1)
    linear, principal_point = first.split((2, 1), 2)
    return torch.cat((torch.cat((linear * factor[:, None, None], principal_point), 2), rest), 1)


def free_focal_in_frame(free: FreeFocal, frame: Frame) -> FreeFocal:
    """What is known of focal lengths, in the pixels of normalised correspondences."""
    return free._replace(expected=free.expected * frame.img_scale, pixel=frame.img_scale.detach())


@torch.no_grad()
def find_focal(inputs: Inputs) -> tuple[Pose, Tensor]:
    """Estimate focal lengths and poses by P3P at focal lengths on a grid, and least squares of the inliers.

    Args:
        inputs: the problems, with a nominal focal length, see :func:`with_nominal_focal`.

    Returns:
        The poses in the world of the inputs, and the logarithm of the focal lengths over the nominal ones, (B,).
    """
    assert inputs.free_focal is not None
    normalize = Normalize(order=False)
    corr, frame = normalize(*inputs[:5], confidence=inputs.confidence)
    corr = corr._replace(img_scale=None, free_focal=free_focal_in_frame(inputs.free_focal, frame))
    guess = _FINDER(corr)
    assert guess.zoom is not None
    return normalize.undo(guess.pose, frame), torch.where(guess.zoom.isfinite(), guess.zoom, 0.0)


def with_found_focal(inputs: Inputs, radial: int = 0) -> tuple[Inputs, Tensor | None]:
    """Give the cameras an estimate of their focal length, and the problems a pose to start from unless they have one.

    Args:
        inputs: See find_focal.
        radial: number of coefficients of radial distortion to estimate, too.

    Returns:
        The problems, their pixels undistorted where ``radial`` is not 0; the coefficients, (B, radial), then.
    """
    pose, zoom = find_focal(inputs)
    cameras, coefficients = scale_focal(inputs.intrinsics, zoom.exp()), None
    if radial:
        normalize = Normalize(order=False)
        with torch.no_grad():
            corr, frame = normalize(*inputs._replace(intrinsics=cameras)[:5])
            found = estimate_radial(corr, normalize.apply_to_pose(pose, frame), radial)
            assert found.zoom is not None
            assert found.radial is not None
            finite = frame.valid & (found.pose.translation.sum(-1) + found.zoom + found.radial.sum(-1)).isfinite()
            better = normalize.undo(found.pose, frame)
            pose = Pose(
                torch.where(finite[:, None, None], better.rotation, pose.rotation),
                torch.where(finite[:, None], better.translation, pose.translation),
            )
            zoom = torch.where(finite, found.zoom, 0.0)
            coefficients = torch.where(finite[:, None], found.radial, 0.0)
        cameras = scale_focal(cameras, zoom.exp())
        inputs = with_undistorted(inputs._replace(intrinsics=cameras), _as_dist(coefficients), None)
    return inputs._replace(intrinsics=cameras, init=pose if inputs.init is None else inputs.init), coefficients


def iterate_with_radial(
    refine: RobustWeightedLM, start: LMStart, coefficients: Tensor | None, m: int | None, more: int = 0
) -> tuple[LMStart, LMStep]:
    """Run the iterations, then refine the distortion of the pixels together with the pose and the focal length.

    Args:
        refine: the refinement.
        start: what it starts from, with undistorted pixels.
        coefficients: their distortion, (B, K), a constant; ``None``: there is none, and none is sought.
        m: See RobustWeightedLM.iterate. With 0 the guess stays as it is, and so does the distortion.
        more: See RobustWeightedLM.iterate.

    Returns:
        The start with the pixels of the distortion that was found, and the end with that distortion, (B, 4).
    """
    if coefficients is None:
        return start, refine.iterate(start, m, more=more)
    with torch.set_grad_enabled(torch.is_grad_enabled() and m == 0):  # the gradient is that of the last minimum
        end = refine.iterate(start, m)
    assert end.zoom is not None
    radial = rescaled(coefficients, end.zoom)
    if m == 0:
        return start, end._replace(radial=_as_dist(radial))
    seen = distorted(start.corr, coefficients)
    pairs = start.by_residual._replace(img_points=seen.img_points, noise=seen.noise)
    end = refine_radial(start._replace(by_residual=pairs), end._replace(radial=radial), refine.kernel.weight)
    assert end.zoom is not None
    assert end.radial is not None
    focal = start.corr.focal * end.zoom.exp()
    camera = torch.stack((focal, focal, torch.ones_like(focal)), -1).diag_embed()
    dist = _as_dist(end.radial)
    pixels, found, noise = undistort(seen.img_points, camera, dist, None, seen.noise)

    def changed(corr: Problem) -> Problem:
        return corr._replace(img_points=pixels, noise=noise, weights=torch.where(found, corr.weights, 0.0))

    corr, guided, by_residual = (changed(x) for x in (start.corr, start.guided, start.by_residual))
    prior = torch.where(found, start.prior, 0.0)
    start = start._replace(corr=corr, guided=guided, by_residual=by_residual, prior=prior)
    return start, end._replace(radial=dist)


def _as_dist(coefficients: Tensor) -> Tensor:
    """Coefficients (B, K) of radial distortion as (k1, k2, 0, 0), (B, 4)."""
    return functional.pad(coefficients, (0, 4 - coefficients.shape[1]))
