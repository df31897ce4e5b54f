"""The solver as one layer: normalise, guess, refine, undo."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK
from kornia.geometry.camera import PinholeCamera
from torch import Tensor, nn

from kornia_pnpnet.core.checks import check_positive, check_whole
from kornia_pnpnet.core.compilation import Compiled
from kornia_pnpnet.core.linalg import bound_gradient, gate
from kornia_pnpnet.core.performance import in_full_precision, sees_values
from kornia_pnpnet.core.trees import map_tensors, put, take
from kornia_pnpnet.geometry import gate_pose
from kornia_pnpnet.init import RANSAC, MLPInit, SetInit
from kornia_pnpnet.init.alternatives import doubt_mirrored, find_alternatives, is_seen
from kornia_pnpnet.init.focal import (
    MORE_ITERATIONS,
    finds_focal,
    free_focal_in_frame,
    guesses_focal,
    is_doubtful,
    iterate_with_radial,
    scale_focal,
    with_found_focal,
    with_nominal_focal,
)
from kornia_pnpnet.init.ransac import search_on
from kornia_pnpnet.init.rig import guess_of_rig
from kornia_pnpnet.inputs import (
    Inputs,
    check_cameras,
    checked_inputs,
    given_cameras,
    joined,
    restore_leading,
    split_batch,
)
from kornia_pnpnet.normalize import VIEWS, Frame, Normalize
from kornia_pnpnet.pretrained import PretrainedMixin
from kornia_pnpnet.refine import LMStart, LMStep, RobustWeightedLM
from kornia_pnpnet.refine.prior import prior_in_frame
from kornia_pnpnet.refine.scale import larger_sigma
from kornia_pnpnet.types import Alternatives, Correspondences, Guess, Noise, PnPResult, Pose, PosePrior, Status

__all__ = ["PnPNet"]

# Bound of a problem's gradient by normalised coordinates, in which those of a problem that is ok are about 1.
_LONGEST_GRADIENT = 10.0


class _Begun(NamedTuple):
    """What is known before the first iteration."""

    start: LMStart
    frame: Frame
    guess: Guess


class PnPNet(PretrainedMixin):
    r"""Find the pose of a calibrated camera from 2D-3D correspondences with outliers.

    The layer normalises the correspondences, lets ``init`` guess a pose, refines the guess, and expresses the pose in
    the frame of the inputs. All of it is batched and differentiable. A bad problem (non-finite input, fewer than three
    pairs, points on a line, a pose that does not explain the pixels) has ``ok=False``, a ``status`` that says why, a
    finite pose without gradient, and changes no other problem.

    Convention: ``x_cam = R x_world + t``, +z forward, pixels ``u = fx x/z + s y/z + cx`` with the skew ``s``; any
    multiple of a camera matrix is the same camera.

    Precision: the layer computes in float64 when any input tensor is float64, else in float32; results have that dtype.
    Inputs of float16, bfloat16 and integers are converted, because half precision has too few digits for a pixel; each
    input gets its gradient in its own dtype. :class:`torch.autocast` does not change the results.

    Args:
        init: maps :class:`~kornia_pnpnet.types.Correspondences` to a :class:`~kornia_pnpnet.types.Guess`, see
            :mod:`kornia_pnpnet.init`; ``None`` starts from the identity or from the pose given with the call.
        refine: the refiner; classical :class:`~kornia_pnpnet.refine.RobustWeightedLM` when ``None``.
        normalize: the normalisation; the default centres and scales the world and orders the pairs.
        effort: ``"fixed"``, or ``"adaptive"``: where the poses of the initialiser do not suffice, a problem gets as
            many more minimal samples as it needs (``init.ransac.search_on``), and a pose whose mirror image fits as
            well is not ``ok``. Needs an initialiser that estimates the noise, :class:`~kornia_pnpnet.init.SetInit`.
            ``None``: adaptive with such an initialiser and a refinement in evaluation mode, else fixed. Always fixed:
            exported graphs, ``compile(whole=True)``, ``torch.func.vmap`` and the device ``meta``. Rigs and bearings:
            RANSAC, unless the effort is ``"fixed"`` or the solver is compiled.
        gradient: which problems carry a gradient: those that are ``"ok"``, or ``"always"`` every valid problem, to
            train a network that does not predict anything sensible yet. The gradient of each problem to its normalised
            points, pixels and weights is then finite and at most 10 long.
        views: number of guesses for each problem, 1 to 8: one of the problem itself and others of its mirror images
            (see :meth:`~kornia_pnpnet.normalize.Normalize.views`), which a network answers differently. All guesses are
            refined; after seven tenths of the iterations the best one goes on alone.
        focal: ``"known"``, or ``"unknown"``: the focal length is estimated with the pose and returned in the result's
            ``intrinsics``. Those of the call then give the principal point, the aspect ratio and the skew relative to
            the focal length. The refinement starts from a nominal focal length with ``SetInit``; where that does not
            suffice, and with other initialisers, from one that P3P finds. If it stays open by over 15 %: not ``ok``.
        focal_sigma: standard deviation of the logarithm of the focal length in the intrinsics of a call, for example
            0.1 for one that is known to about 10 %; ``None``: the focal length in the intrinsics is ignored.
        radial: number of coefficients of radial distortion, 0 to 2, estimated with an unknown focal length: before the
            refinement, and together with the pose after it. The result has them as ``dist``, with gradients.

    Raises:
        BaseError: when ``views`` is not an integer from 1 to 8, or ``gradient``, ``effort`` or ``focal`` neither of its
            values, or ``focal_sigma`` not positive, or given with a known focal length.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> problems = SyntheticProblems(n=9, batch_size=4, seed=0).batch(0)
        >>> solver = PnPNet(MLPInit(n=9), RobustWeightedLM(m=5))
        >>> result = solver(problems.world_points, problems.img_points, problems.intrinsics)
        >>> result.matrix.shape, result.ok.shape
        (torch.Size([4, 4, 4]), torch.Size([4]))
    """

    def __init__(
        self,
        init: nn.Module | None = None,
        refine: RobustWeightedLM | None = None,
        normalize: Normalize | None = None,
        *,
        views: int = 1,
        gradient: str = "ok",
        effort: str | None = None,
        focal: str = "known",
        focal_sigma: float | None = None,
        radial: int = 0,
    ) -> None:
        super().__init__()
        check_whole(1, len(VIEWS), views=views)
        self.gradient = _checked_gradient(gradient)
        KORNIA_CHECK(effort in (None, "fixed", "adaptive"), f"effort must be 'fixed' or 'adaptive', got {effort!r}.")
        KORNIA_CHECK(focal in ("known", "unknown"), f"focal must be 'known' or 'unknown', got {focal!r}.")
        if focal_sigma is not None:
            check_positive(focal_sigma=focal_sigma)
        check_whole(0, 2, radial=radial)
        fits = focal == "unknown" or (focal_sigma is None and not radial)
        KORNIA_CHECK(fits, "focal_sigma and radial are for focal='unknown'.")
        self.effort, self.focal, self.focal_sigma, self.radial = effort, focal, focal_sigma, int(radial)
        self.views = int(views)
        self.init = init
        self.refine = RobustWeightedLM(learnable=False) if refine is None else refine
        self.normalize = Normalize() if normalize is None else normalize
        # What runs, or what `compile` made of it.
        self._solve: Callable[..., PnPResult] = self._in_parts
        self._first: Callable[..., tuple[Correspondences, Frame, Guess]] = self._first_guess
        self._begin: Callable[..., _Begun] = self._guess
        self._finish: Callable[..., PnPResult] = self._result

    def forward(
        self,
        world_points: Tensor,
        img_points: Tensor,
        intrinsics: Tensor | PinholeCamera | None,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
        init: Pose | None = None,
        *,
        img_sigma: Tensor | float | None = None,
        world_sigma: Tensor | float | None = None,
        img_cov: Tensor | None = None,
        world_cov: Tensor | None = None,
        confidence: Tensor | None = None,
        prior: PosePrior | None = None,
        dist: Tensor | None = None,
        fisheye: Tensor | None = None,
        cam_from_rig: Pose | None = None,
        first_stage_only: bool = False,
        gradient: str | None = None,
        alternatives: int = 0,
    ) -> PnPResult:
        r"""Solve a batch of problems.

        Args:
            world_points: shape :math:`(B, N, 3)`, any unit, floats or integers. Any leading dimensions may stand in
                place of :math:`B`, in all arguments and in the result; a single problem has none.
            img_points: pixels, shape :math:`(B, N, 2)`; or bearings, directions in the camera's frame of any length, as
                those of :func:`~kornia_pnpnet.cameras.bearings`, shape :math:`(B, N, 3)`.
            intrinsics: camera matrices, shape :math:`(B, 3, 3)` or :math:`(3, 3)`, or Kornia's cameras, whose
                extrinsics are ignored; in a rig also one for each pair, :math:`(B, N, 3, 3)`. Bearings need none.
                With intrinsics, the ``img_sigma`` and thresholds of bearings are in pixels, and a radian is as many
                pixels as the focal length; without intrinsics they are in radians.
            weights: weight of each pair, the same for u and v, at least 0, shape :math:`(B, N)`; 1 when ``None``.
            mask: False where a pair is padding, bool, shape :math:`(B, N)`. The numbers of padding do not matter.
            init: a world-to-camera pose, :math:`(B, 3, 3)` and :math:`(B, 3)`. It competes with the poses of the
                initialiser and is refined as they are; without an initialiser the refinement starts from it.
            img_sigma: standard deviation of the noise on each pixel coordinate, a number, :math:`(B,)` or
                :math:`(B, N)`, at least 0; NaN where unknown. With this or ``world_sigma``, residuals and the scales of
                the refinement's kernel count in standard deviations.
            world_sigma: standard deviation of the noise on each world coordinate, in the unit of ``world_points``;
                shapes and NaN as for ``img_sigma``.
            img_cov: covariance of the noise of each pixel in px², in place of ``img_sigma``, shape
                :math:`(B, N, 2, 2)`, symmetric and positive semi-definite. Residuals are whitened by it.
            world_cov: covariance of the noise of each world point, in place of ``world_sigma``, shape
                :math:`(B, N, 3, 3)`.
            confidence: your own belief that a pair is an inlier, in [0, 1], for example a matcher's score, shape
                :math:`(B, N)`; NaN where unknown. :func:`~kornia_pnpnet.confidence.fit_confidence` makes it from raw
                scores. Minimal samples are drawn from likely pairs more often, and a network that was trained with
                confidences sees them. What they are worth may differ between problems.
            prior: what is known of the pose besides the pairs, such as :func:`~kornia_pnpnet.refine.gravity_prior`: a
                term of the refinement and of the choice among poses, to which its pose belongs unless ``init`` is
                given. ``ok`` and ``probability`` are judged by the pairs alone. Unknown noise counts as one pixel.
            dist: distortion of the camera as Kornia and OpenCV have it, 4, 5, 8, 12 or 14 coefficients, shape
                :math:`(B, D)` or :math:`(D,)`. Pixels are undistorted once, and their noise with them. Pairs beyond
                what the coefficients can show are left out.
            fisheye: the four coefficients of ``cv2.fisheye``, in place of ``dist``, shape :math:`(B, 4)` or
                :math:`(4,)`. Pixels more than 85 degrees off the axis are left out; bearings keep them.
            cam_from_rig: for several cameras with one pose, that of their rig: the transform from the rig to the camera
                that sees each pair, :math:`(B, N, 3, 3)` and :math:`(B, N, 3)`.
            first_stage_only: return the first guess unrefined, the paper's "Net", at the cost of ``m=0``.
            gradient: ``"ok"`` or ``"always"``; the solver's own when ``None``.
            alternatives: largest number of other poses to return that explain the pairs nearly as well; they cost as
                much as several solutions.

        Returns:
            The :class:`~kornia_pnpnet.types.PnPResult`, in float64 when any input is, else in float32. Gradients flow
            through pose, intrinsics, dist, weights and cost of problems that are ``ok``, and through the first guess
            of every valid problem. A problem that cannot be solved has the identity as its pose and a cost of the
            square root of the dtype's largest number.

        Raises:
            ShapeError: for shapes that do not fit each other, fewer than 3 pairs, or another N than the initialiser
                was built for.
            TypeCheckError: for arguments that are no tensors, or hold booleans or complex numbers.
            DeviceError: for tensors on different devices, or on another device than a network of the solver.
            ValueCheckError: for both a sigma and a covariance of the pixels, or of the points; for arguments that
                cannot be combined (an unknown focal length with distortion or a rig, a rig with alternatives).
        """
        given = world_points, img_points, intrinsics, weights, mask, init, img_sigma, world_sigma, img_cov, world_cov
        size, inputs = checked_inputs(*given, confidence, prior, dist=dist, fisheye=fisheye, cam_from_rig=cam_from_rig)
        check_whole(0, alternatives=alternatives)
        distorted = dist is not None or fisheye is not None
        check_cameras(inputs, self.focal, distorted=distorted, alternatives=alternatives, init=self.init)
        with in_full_precision(inputs.world_points.device.type):
            always = _checked_gradient(gradient or self.gradient) == "always"
            compiled = [x for x in (self._solve, self._first, self._begin) if isinstance(x, Compiled)]
            any_number = not (compiled or isinstance(self.init, MLPInit))
            single = bool(compiled) and len(inputs.world_points) == 1 and not any(x.failed for x in compiled)
            if compiled:  # a batch of one, and every layout in memory, would be compiled for by itself
                inputs = map_tensors(lambda x: torch.cat((x, x)) if single else x.contiguous(), inputs)
            parts = split_batch(inputs, getattr(self.init, "pairs_at_once", None), any_number)
            results = [self._solve(first_stage_only, always, part.inputs, alternatives) for part in parts]
            result = joined(parts, results)
        result = restore_leading(size, map_tensors(lambda x: x[:1], result) if single else result)
        if inputs.rig is not None:
            result = result._replace(intrinsics=given_cameras(intrinsics, world_points, result.translation))
        return result

    def with_guess(
        self, *args: Any, first_stage_only: bool = False, gradient: str | None = None, **options: Any
    ) -> tuple[PnPResult, Guess]:
        """Solve a batch and return the whole first guess as well (poses, weights and noise), to train it.

        Args:
            args: See forward.
            first_stage_only: See forward.
            gradient: See forward.
            options: the other arguments of ``forward``, except ``alternatives``.

        Returns:
            The result, and the guess in the frame, order and units of the inputs; its ``ok``: is the problem valid.
        """
        size, inputs = checked_inputs(*args, **options)
        with in_full_precision(inputs.world_points.device.type):
            always = _checked_gradient(gradient or self.gradient) == "always"
            begun, _, result = self._parts(first_stage_only, always, inputs)
            return restore_leading(size, (result, self.normalize.undo_guess(begun.guess, begun.frame)))

    def compile(self, mode: str | None = None, *, whole: bool = False) -> None:
        """Compile with ``torch.compile``, in place: what is before, in, and after an iteration, each once.

        The first call then takes some seconds, less where a cache of ``torch.compile`` is on disk; further calls take a
        fraction of the uncompiled time. The batch may change its size; another number of pairs, another dtype and calls
        that record gradients are compiled for when they first come. What cannot be compiled, without a C++ compiler or
        because it is a RANSAC, runs uncompiled after one warning. Copies compile for themselves.

        Args:
            mode: mode of ``torch.compile``; ``"reduce-overhead"`` captures CUDA graphs.
            whole: compile the solver as one graph, with its iterations one after the other. The first call takes
                longer; calls of a few problems, which mostly wait for Python, take half the time. A search is no
                graph: the effort is fixed.
        """
        self._solve = Compiled(self._in_parts, mode) if whole else self._in_parts
        self._first = self._first_guess if whole else Compiled(self._first_guess, mode)
        self._begin = self._guess if whole else Compiled(self._guess, mode)
        self._finish = self._result if whole else Compiled(self._result, mode)
        if not whole:
            self.refine.compile(mode)

    def _in_parts(self, first_stage_only: bool, always: bool, inputs: Inputs, alternatives: int = 0) -> PnPResult:
        begun, zoom, result = self._parts(first_stage_only, always, inputs)
        if not alternatives:
            return result
        start, frame, guess = begun
        pose = self.normalize.apply_to_pose(result.pose, frame)
        corr = start.corr.seen_with(zoom)
        found = find_alternatives(self.refine, corr, guess, pose, frame.valid, alternatives)
        poses = self.normalize.undo_poses(Pose(found.rotation, found.translation), frame)
        translation = torch.where(found.valid[..., None], poses.translation, 0.0)
        return result._replace(alternatives=found._replace(translation=translation))

    def _parts(self, first_stage_only: bool, always: bool, inputs: Inputs) -> tuple[_Begun, Tensor | None, PnPResult]:
        """Before the iterations, the iterations, and after them."""
        given, radial, guessed = inputs, None, False
        if self.focal == "unknown" and inputs.free_focal is None:
            inputs = with_nominal_focal(inputs, self.focal_sigma)
            guessed = not self.radial and guesses_focal(self.init, inputs)
            if not guessed and (self.radial or not finds_focal(self.init)):
                inputs, radial = with_found_focal(inputs, self.radial)
        views = 1 if first_stage_only or self.refine.m == 0 else self.views
        searches = not first_stage_only and self._searches(inputs)
        if not searches:
            begun = self._begin(views, always, inputs)
        else:
            corr, frame, guess = self._first(views, always, inputs, self.focal == "known" and inputs.confidence is None)
            if self.focal == "known":  # an unknown focal length has a search of its own
                guess = search_on(corr, guess, keep_others=inputs.init is not None or inputs.prior is not None)
            begun = _Begun(self.refine.begin(corr, guess), frame, guess)
        m, more = 0 if first_stage_only else None, MORE_ITERATIONS if guessed else 0
        start, end = iterate_with_radial(self.refine, begun.start, radial, m, more)
        begun = begun._replace(start=start)
        result = self._finish(begun, end, always)
        if searches:
            start, frame, guess = begun
            pose = self.normalize.apply_to_pose(result.pose, frame)
            corr = start.corr.seen_with(end.zoom)
            result = doubt_mirrored(self.refine, corr, guess, pose, result, always)
            if guessed:
                result = self._with_searched_focal(always, inputs, result)
            if inputs.noise is None:
                estimate = self.normalize.undo_guess(guess, frame).noise
                result = self._with_more_noise(always, given, inputs, estimate, result)
        return begun, end.zoom, result

    def _with_searched_focal(self, always: bool, inputs: Inputs, result: PnPResult) -> PnPResult:
        """Solve once more, with a searched focal length, the problems whose solution is not convincing."""
        rows = is_doubtful(result).nonzero()[:, 0]
        if not len(rows):
            return result
        solved = self._parts(False, always, with_found_focal(take(inputs, rows))[0])[2]
        better = solved.ok | ~result.ok[rows]
        return put(result, rows[better], take(solved, better))

    def _with_more_noise(
        self, always: bool, given: Inputs, inputs: Inputs, noise: Noise | None, result: PnPResult
    ) -> PnPResult:
        """Solve once more, with the noise that the residuals show, the problems whose noise was underestimated."""
        assert noise is not None
        before = 1.0 if inputs.weights is None else inputs.weights
        assert result.intrinsics is not None
        seen = inputs.world_points, inputs.img_points, result.intrinsics, result.pose
        sigma = larger_sigma(*seen, result.weights / before, noise, inputs.confidence)
        rows = (sigma[:, 0] > 0).nonzero()[:, 0]
        if not len(rows):
            return result
        again = take(given, rows)._replace(noise=Noise(sigma[rows], torch.zeros_like(sigma[rows])))
        return put(result, rows, self._parts(False, always, again)[2])

    def _searches(self, inputs: Inputs) -> bool:
        """Whether the effort is adaptive."""
        if self.effort == "fixed" or inputs.rig is not None or not sees_values(inputs.world_points):
            return False
        can = isinstance(self.init, SetInit) and self.refine.m > 0
        return self.effort == "adaptive" or (can and not self.training)

    def _guess(self, views: int, always: bool, inputs: Inputs) -> _Begun:
        """Everything before the first iteration."""
        corr, frame, guess = self._first_guess(views, always, inputs, False)
        return _Begun(self.refine.begin(corr, guess), frame, guess)

    def _first_guess(
        self, views: int, always: bool, inputs: Inputs, search_follows: bool
    ) -> tuple[Correspondences, Frame, Guess]:
        """Normalise and guess."""
        world_points, img_points, intrinsics, weights, mask, init, noise, confidence, prior, free_focal, rig = inputs
        corr, frame = self.normalize(world_points, img_points, intrinsics, weights, mask, noise, confidence, rig)
        if always:
            world, img, pair_weights = (bound_gradient(x, _LONGEST_GRADIENT) for x in corr[:3])
            corr = corr._replace(world_points=world, img_points=img, weights=pair_weights)
        if prior is not None:
            known, usable = prior_in_frame(prior, frame.centroid, frame.scale, frame.img_scale)
            corr, init = corr._replace(prior=known), prior.pose if init is None else init
            frame = frame._replace(status=torch.where(usable, frame.status, Status.NOT_FINITE.value))
        if free_focal is not None:
            corr = corr._replace(free_focal=free_focal_in_frame(free_focal, frame))
        given = self.normalize.start_pose(init, frame) if self.init is None or init is not None else None
        options = {"search_follows": True} if search_follows and isinstance(self.init, SetInit) else {}
        if self.init is None:
            assert given is not None
            guess = Guess(given, torch.ones_like(corr.weights))
        elif rig is not None and not isinstance(self.init, RANSAC):
            guess = guess_of_rig(corr, given, with_noise=isinstance(self.init, SetInit), fixed=self.effort == "fixed")
        elif isinstance(self.init, RANSAC):
            guess = self.init(corr, given)
        elif views == 1:
            guess = self.init(corr, **options)
        else:
            batch = world_points.shape[0]
            guess = self.init(self.normalize.views(corr, views), **options)
            first, *rest = [x for pose in guess.poses for x in self.normalize.undo_views(pose, views)]
            others = map_tensors(lambda *x: torch.stack(x, 1), *rest)
            # Weights, ok and noise of the first view, whose pairs have the order of the correspondences.
            guess = map_tensors(lambda x: x[:batch], guess)._replace(pose=first, others=others)
        if given is not None and not (self.init is None or isinstance(self.init, RANSAC)):
            others = map_tensors(lambda *x: torch.stack(x, 1), *guess.poses[1:], given)
            guess = guess._replace(others=others, ok=None)
        if corr.near is not None and not getattr(self.init, "weighs_far_pairs", False):
            guess = guess._replace(weights=guess.weights * torch.where(is_seen(guess, corr), 1.0, corr.near))
        return corr, frame, guess

    def _result(self, begun: _Begun, end: LMStep, always: bool) -> PnPResult:
        """Everything after the last iteration."""
        start, frame, guess = begun
        refined = self.refine.finish(start, end)
        pose = self.normalize.undo(refined.pose, frame)
        first = self.normalize.undo(guess.pose, frame)
        # A sum is finite when all its terms are finite. A rotation that is not finite makes its translation not finite,
        # since every entry was multiplied by a coordinate of the centroid.
        finite = frame.valid & (pose.translation.sum(-1) + refined.weights.sum(-1) + refined.cost).isfinite()
        ok = finite & refined.ok if guess.ok is None else finite & refined.ok & guess.ok
        zoom = None if refined.zoom is None else torch.where(finite, refined.zoom, 0.0).exp()
        intrinsics = frame.intrinsics if zoom is None else scale_focal(frame.intrinsics, zoom)
        first_ok = frame.valid & first.translation.sum(-1).isfinite()
        status = torch.where(refined.in_front, Status.NOT_BELIEVED.value, Status.BEHIND.value)
        status = torch.where(ok, Status.SOLVED.value, torch.where(finite, status, Status.DEGENERATE.value))
        # ONNX Runtime chooses among int64, not among int8.
        status = torch.where(frame.valid, status, frame.status).to(torch.int8)
        live = finite if always else ok
        cameras = None if frame.intrinsics.ndim > 3 else gate(intrinsics, live, torch.ones_like(finite), 0.0)
        pose = gate_pose(pose, live, finite)
        none = torch.zeros_like(pose.translation[:, :1]).expand(-1, 4)
        return PnPResult(
            *pose,
            gate(self.normalize.undo_pairs(refined.weights, frame), live, finite, 0.0),
            gate(refined.cost, live, finite, torch.finfo(refined.cost.dtype).max ** 0.5),
            ok,
            gate_pose(first, first_ok, first_ok),
            status,
            torch.where(finite, refined.probability, 0.0),
            Alternatives.none(pose),
            cameras,
            none if end.radial is None else gate(end.radial, live, finite, 0.0),
        )


def _checked_gradient(gradient: str) -> str:
    KORNIA_CHECK(gradient in ("ok", "always"), f"gradient must be 'ok' or 'always', got {gradient!r}.")
    return gradient
