"""The solver as one layer: normalise a problem, propose poses, refine them, and judge the best pose."""

from __future__ import annotations

from contextlib import nullcontext
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK
from kornia.core.exceptions import ValueCheckError
from kornia.geometry.camera import PinholeCamera
from torch import Tensor, nn

from kornia_pnpnet.arguments import checked_inputs, given_cameras, in_parts, restore_leading
from kornia_pnpnet.core.checks import check_numbers, check_whole
from kornia_pnpnet.core.linalg import bound_gradient, gate
from kornia_pnpnet.core.performance import Runner, compiling, in_full_precision, in_turn, needs_graph, sees_values
from kornia_pnpnet.core.trees import iter_tensors, map_tensors, put
from kornia_pnpnet.core.watch import GradientWatch
from kornia_pnpnet.frame import Frame, Normalize
from kornia_pnpnet.pretrained import PretrainedMixin
from kornia_pnpnet.problem import Inputs, Problem, Starts, State
from kornia_pnpnet.propose.alternatives import find_alternatives, reconsider
from kornia_pnpnet.propose.first import propose
from kornia_pnpnet.propose.focal import (
    as_dist,
    distorted,
    find_focal,
    scale_focal,
    with_found_focal,
    with_nominal_focal,
)
from kornia_pnpnet.propose.initialiser import trait
from kornia_pnpnet.propose.ransac import search_on
from kornia_pnpnet.propose.views import VIEWS
from kornia_pnpnet.refine.lm import Refinement, RobustWeightedLM
from kornia_pnpnet.refine.terms import PoseTerm
from kornia_pnpnet.result import Alternatives, PnPResult, Pose, PosePrior, Status, gate_pose

__all__ = ["PnPNet"]

# Limits the gradients of a problem's loss with respect to normalised inputs to this norm. Usual norms are about 1.
_bounded = partial(bound_gradient, limit=10.0)
# Number of additional iterations of the refinement if the focal length starts from a nominal value (see `_with_camera`)
# or distortion is estimated. With 1000 pairs, fewer iterations do not converge (CameraProblems, seeds 4321 and 4322).
# With `m = 0`, only these iterations give the distortion a gradient.
_MORE_ITERATIONS = 4


class _Call(NamedTuple):
    """Options of :meth:`PnPNet.forward`. ``always``: whether every valid problem has a gradient."""

    first_stage_only: bool
    always: bool
    alternatives: int = 0


class _Attempt(NamedTuple):
    """One run of the solver: the problem, its frame, the proposed starts, the refined pose, and the result."""

    problem: Problem
    frame: Frame
    starts: Starts
    refined: Refinement
    result: PnPResult


class PnPNet(PretrainedMixin):
    r"""Find the pose of a calibrated camera from 2D-3D correspondences with outliers.

    The layer normalises the correspondences, lets ``init`` propose poses, refines and judges the poses, and expresses
    the best pose in the frame of the inputs. All steps are batched and differentiable. An unsolvable problem does not
    affect other problems. Its result has ``ok=False``, a ``status`` with the reason (see
    :class:`~kornia_pnpnet.result.Status`), and a finite pose without gradient.

    Convention: ``x_cam = R x_world + t``, +z forward, pixels ``u = fx x/z + s y/z + cx`` with the skew ``s``. All
    multiples of a camera matrix describe the same camera. Focal lengths may be negative, for example ``fy`` if the v
    axis of the image points up.

    Precision: the layer computes in float64 if any input tensor is float64, else in float32. Results have the dtype of
    the computation. Integer inputs are converted. Inputs in float16 or bfloat16 are also converted, because half
    precision has too few digits for a pixel. The gradient of each input has the dtype of the input.
    :class:`torch.autocast` does not change the results. If no tensor requires a gradient, the layer computes in
    :class:`torch.inference_mode` and returns ordinary tensors. Forward hooks of the parts then get
    inference tensors. Forward hooks of ``refine`` are never called.

    Args:
        init: the initialiser, which maps a :class:`~kornia_pnpnet.problem.Problem` to
            :class:`~kornia_pnpnet.problem.Starts`. ``None``: the refinement starts from the call's ``init`` or
            ``prior``, or from the identity if the call has neither.
        refine: the refiner. ``None``: a classical :class:`~kornia_pnpnet.refine.lm.RobustWeightedLM`.
        normalize: the normalisation; the default centres and scales the world and sorts the pairs.
        effort: ``"adaptive"``: a problem gets further minimal samples if the most promising pose of the initialiser
            explains too few pairs or is determined poorly (see :func:`~kornia_pnpnet.propose.ransac.search_on`). The
            initialiser must estimate the noise, as :class:`~kornia_pnpnet.propose.set.SetInit` does. ``"fixed"``: every
            problem gets the same work. ``None``: in evaluation mode, the effort is adaptive if the initialiser
            estimates the noise and the refinement has iterations. Unless the effort is ``"fixed"``, the work varies in
            two more steps: in evaluation mode, poses are compared with rival poses (see
            :func:`~kornia_pnpnet.propose.alternatives.reconsider`); for rigs and bearings, RANSAC chooses the number of
            its samples. The effort is always fixed in exported graphs, with ``compile(whole=True)``, in your own
            ``torch.compile``, in ``torch.func.vmap`` and on the device ``meta``.
        gradient: which problems have a gradient. ``"ok"``: only problems whose result is ``ok``. If no problem of the
            first batches with gradients of the inputs is ``ok``, a ``RuntimeWarning`` is issued. ``"always"``: all
            valid problems, but the gradients of a problem's loss with respect to normalised inputs are limited to a
            norm of 10. To train a network from random weights, use
            :func:`~kornia_pnpnet.likelihood.monte_carlo_pose_loss`.
        views: number of views of each problem, 1 to 8. The views are the problem itself and its rotated or mirrored
            copies. A network proposes a different pose for each view (see :mod:`kornia_pnpnet.propose.views`).
        focal: ``"unknown"``: the focal length is estimated with the pose and returned in the result's ``intrinsics``.
            The intrinsics of the call give the principal point, the aspect ratio, and the ratio of the skew to the
            focal length. With ``SetInit`` the refinement starts from the middle of the range of focal lengths. A search
            with P3P follows if the refined pose is not believed. With another initialiser, a given pose, or ``radial``,
            the search comes first. A problem is not ``ok`` when the standard deviation of log f exceeds 0.15.
        focal_sigma: standard deviation of the logarithm of the caller's focal length, for example 0.1 if the focal
            length is known to about 10 %. ``None``: the caller's focal length is ignored.
        radial: number of coefficients of radial distortion, 0 to 2, that are estimated together with an unknown focal
            length. The result's ``dist`` has the estimates.

    Raises:
        BaseError: when an option has an invalid value, when ``effort="adaptive"`` is given without an initialiser that
            estimates the noise, or when ``focal_sigma`` or ``radial`` is given with a known focal length.

    Example:
        >>> from kornia_pnpnet import MLPInit
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
        KORNIA_CHECK(effort in (None, "fixed", "adaptive"), f"effort must be 'fixed' or 'adaptive', got {effort!r}.")
        KORNIA_CHECK(focal in ("known", "unknown"), f"focal must be 'known' or 'unknown', got {focal!r}.")
        if focal_sigma is not None:
            check_numbers(1e-6, focal_sigma=focal_sigma)
        check_whole(0, 2, radial=radial)
        fits = focal == "unknown" or (focal_sigma is None and not radial)
        KORNIA_CHECK(fits, "focal_sigma and radial are for focal='unknown'.")
        searches = effort != "adaptive" or trait(init, "estimates_noise")
        KORNIA_CHECK(searches, "effort='adaptive' needs an initialiser that estimates the noise.")
        self.views, self.gradient, self.effort = int(views), _checked_gradient(gradient), effort
        self.focal, self.radial = focal, int(radial)
        self.focal_sigma = None if focal_sigma is None else float(focal_sigma)  # JSON has no NumPy numbers
        self.init = init
        self.refine = RobustWeightedLM(learnable=False) if refine is None else refine
        self.normalize = Normalize() if normalize is None else normalize
        self._run, self._whole = Runner(), Runner()
        self._watch = GradientWatch()

    @in_turn
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
            world_points: shape :math:`(B, N, 3)`, any unit, floats or integers. In all arguments and in the result,
                :math:`B` stands for any number of leading dimensions. A single problem needs no leading dimension.
            img_points: pixels, shape :math:`(B, N, 2)`; or bearings, shape :math:`(B, N, 3)`. Bearings are direction
                vectors of any length in the camera's frame (see :func:`~kornia_pnpnet.cameras.bearings`).
            intrinsics: camera matrices, shape :math:`(B, 3, 3)` or :math:`(3, 3)`; or Kornia's cameras, whose
                extrinsics are ignored. In a rig, each pair may have its own matrix, shape :math:`(B, N, 3, 3)`. With
                bearings, intrinsics may be ``None``. Without intrinsics, sigmas and thresholds are in radians. If
                bearings come with intrinsics, sigmas and thresholds are in pixels at the given focal length.
            weights: weight of each pair, for both u and v, at least 0, shape :math:`(B, N)`; ``None``: 1.
            mask: False where a pair is padding, bool, shape :math:`(B, N)`. The values of padding are ignored.
            init: a world-to-camera pose, :math:`(B, 3, 3)` and :math:`(B, 3)`, that is refined in addition to the poses
                of the initialiser; in RANSAC it competes with the poses of the samples. Without an initialiser the
                refinement starts from ``init`` alone. The matrices of ``init``, ``prior`` and ``cam_from_rig`` are
                replaced by the nearest rotations. ``init`` is ignored if it is not finite, or if the determinant of its
                matrix is not positive.
            img_sigma: standard deviation of the noise on each pixel coordinate, at least 0: a number, or a tensor of
                shape :math:`(B,)` or :math:`(B, N)` with NaN where unknown. With ``img_sigma`` or ``world_sigma``,
                residuals and the scales of the refinement's kernel are in standard deviations.
            world_sigma: standard deviation of the noise on each world coordinate, in the unit of ``world_points``. For
                shapes and NaN see ``img_sigma``.
            img_cov: covariance, in px², of each pixel's noise, symmetric and positive semi-definite, shape
                :math:`(B, N, 2, 2)`. Give ``img_cov`` or ``img_sigma``, not both.
            world_cov: covariance of each world point's noise, shape :math:`(B, N, 3, 3)`. Give ``world_cov`` or
                ``world_sigma``, not both.
            confidence: the caller's belief, in [0, 1], that a pair is an inlier, for example a matcher's score, shape
                :math:`(B, N)`; NaN where unknown. Values that leave [0, 1] by less than 0.001 are clipped. A pair with
                any other value outside [0, 1] is left out. Pairs of high confidence are drawn more often for
                minimal samples. Networks that were trained with confidences take confidences as an input. Confidences
                need not be calibrated.
            prior: a prior of the pose, such as :func:`~kornia_pnpnet.refine.terms.gravity_prior`. The prior adds a
                term to the cost, and thus affects the refinement and the choice of the best pose. Unless ``init`` is
                given or the focal length is unknown, the refinement also starts from the prior's pose. The
                evidence for a pose comes from the pairs alone, but ``probability`` compares the pose with rivals by
                pairs and prior. If neither call nor initialiser gives the noise, the noise of pixels is assumed to be
                one pixel, at most 0.01 radians.
            dist: 4, 5, 8, 12 or 14 distortion coefficients, as in Kornia and OpenCV, shape :math:`(B, D)` or
                :math:`(D,)`. Pixels and their noise are undistorted once before solving. Pairs whose pixel cannot be
                undistorted are left out.
            fisheye: the four coefficients of ``cv2.fisheye``, in place of ``dist``, shape :math:`(B, 4)` or
                :math:`(4,)`. Pixels more than 85 degrees off the axis are left out. To keep such pixels, pass bearings.
            cam_from_rig: the transform from the frame of a rig (several cameras) to the frame of each pair's camera,
                :math:`(B, N, 3, 3)` and :math:`(B, N, 3)`. For a rig, the solved pose is the pose of the rig.
            first_stage_only: return the best start without refinement (the paper's "Net"), as solvers with ``m=0`` do.
            gradient: ``"ok"`` or ``"always"``, see :class:`PnPNet`. ``None``: the solver's own option.
            alternatives: largest number of alternative poses to return, see
                :class:`~kornia_pnpnet.result.Alternatives`. The search takes as long as several calls without
                ``alternatives``.

        Returns:
            The :class:`~kornia_pnpnet.result.PnPResult`. Gradients flow through pose, intrinsics, dist, weights and
            cost of problems that are ``ok``, and often through the first guess (see ``init`` there). A
            problem without a finite pose gets the identity as its pose, and the square root of the dtype's largest
            number as its cost.

        Raises:
            ShapeError: for shapes that do not fit each other, fewer than 3 pairs, or a number of pairs that the
                initialiser was not built for.
            TypeCheckError: for arguments that are not tensors, and for tensors of booleans or complex numbers.
            DeviceError: for tensors on different devices, or on another device than a network of the solver.
            ValueCheckError: when a sigma and a covariance are both given for the pixels or for the points, when
                ``dist`` and ``fisheye`` are both given, when an unknown focal length is combined with distortion or
                with a rig, when a rig is combined with distortion or with ``alternatives``, or when neither the solver
                nor the call gives a start for a rig.
            BaseError: when ``alternatives`` is no whole number of at least 0.
        """
        size, inputs = checked_inputs(
            *(world_points, img_points, intrinsics, weights, mask, init),
            img_sigma=img_sigma,
            world_sigma=world_sigma,
            img_cov=img_cov,
            world_cov=world_cov,
            confidence=confidence,
            prior=prior,
            dist=dist,
            fisheye=fisheye,
            cam_from_rig=cam_from_rig,
        )
        check_whole(0, alternatives=alternatives)
        rig = self._is_rig(inputs, dist, fisheye, alternatives)
        call = _Call(first_stage_only, _checked_gradient(gradient or self.gradient) == "always", alternatives)
        compiled = (self._run.compiled or self._whole.compiled) and not compiling()
        plain = not (compiled or needs_graph((*iter_tensors(inputs), *self.parameters())))
        inference = torch.inference_mode() if plain else nullcontext()
        with in_full_precision(inputs.world_points.device.type), inference:
            single = compiled and len(inputs.world_points) == 1 and not (self._run.failed or self._whole.failed)
            if single:  # a batch of one would need a new compilation
                inputs = map_tensors(lambda x: torch.cat((x, x)), inputs)
            any_number = not (compiled or trait(self.init, "fixed_pairs"))
            most = trait(self.init, "pairs_at_once")
            result = in_parts(lambda part: self._whole(self._solve, part, call), inputs, most, any_number)
        if plain:  # copies outside of inference mode can be used where gradients are recorded
            result = map_tensors(torch.clone, result)
        result = restore_leading(size, map_tensors(lambda x: x[:1], result) if single else result)
        if rig:
            result = result._replace(intrinsics=given_cameras(intrinsics, size, result.translation))
        if not (call.always or first_stage_only):
            self._watch.see(result.ok, *iter_tensors(inputs))
        return result

    if TYPE_CHECKING:  # nn.Module.__call__ accepts and returns Any
        __call__ = forward

    def with_starts(
        self, *args: Any, first_stage_only: bool = False, gradient: str | None = None, **options: Any
    ) -> tuple[PnPResult, Starts]:
        """Solve a batch, and also return the starts (proposed poses, weights and noise) for training losses.

        For the arguments, except ``alternatives``, see :meth:`forward`. The starts are in the frame, order and units of
        the inputs. The ``ok`` of the starts says whether the problem is valid.
        """
        size, inputs = checked_inputs(*args, **options)
        rig = self._is_rig(inputs, options.get("dist"), options.get("fisheye"))
        with in_full_precision(inputs.world_points.device.type):
            call = _Call(first_stage_only, _checked_gradient(gradient or self.gradient) == "always")
            attempt = self._attempt(inputs, call)
            starts = attempt.frame.undo_starts(attempt.starts, attempt.problem.focal, inputs.lens_scale)
            result, starts = restore_leading(size, (attempt.result, starts))
            if rig:
                intrinsics = args[2] if len(args) > 2 else options["intrinsics"]
                result = result._replace(intrinsics=given_cameras(intrinsics, size, result.translation))
            return result, starts

    def _is_rig(self, inputs: Inputs, dist: Tensor | None, fisheye: Tensor | None, alternatives: int = 0) -> bool:
        """Refuse arguments that exclude each other, and tell whether the problems are rigs."""
        rig = inputs.rig is not None
        if self.focal == "unknown" and (rig or dist is not None or fisheye is not None):
            raise ValueCheckError("focal='unknown' takes pixels of one camera without dist and fisheye.")
        if rig and (alternatives or (self.init is None and inputs.init is None and inputs.prior is None)):
            raise ValueCheckError(
                "`cam_from_rig` and bearings as `img_points` need an initialiser, `init` or `prior`, and exclude "
                "`alternatives`."
            )
        return rig

    def compile(self, mode: str | None = None, *, whole: bool = False) -> None:
        """Compile the first stage, one iteration and the final stage of the solver in place, with ``torch.compile``.

        The first call compiles for some seconds. A new number of pairs, a new dtype, or the first call with gradients
        causes a new compilation. A new batch size causes no compilation. RANSAC is never compiled. Parts that cannot
        be compiled run uncompiled after one warning. If there is no C++ compiler, or if PyTorch is older than 2.13, all
        parts run uncompiled. A copy of the solver compiles again. If a part of the solver is replaced, the old part and
        its code stay in memory until the next call of ``compile``.

        Args:
            mode: mode of ``torch.compile``; ``"reduce-overhead"`` captures CUDA graphs.
            whole: compile the whole solver as one graph, with fixed effort. The first call takes longer. Later
                calls with few problems take half the time, because less Python code runs.
        """
        self._run, self._whole = Runner(not whole, mode), Runner(whole, mode)

    def _solve(self, inputs: Inputs, call: _Call) -> PnPResult:
        attempt = self._attempt(inputs, call)
        return self._with_alternatives(attempt, call.alternatives) if call.alternatives else attempt.result

    def _with_camera(self, inputs: Inputs) -> tuple[Inputs, bool]:
        """Initialise an unknown focal length, and tell whether the value is *nominal* (the middle of the range)."""
        if self.focal == "known":
            return inputs, False
        inputs = with_nominal_focal(inputs, self.focal_sigma, self.radial)
        # A network's poses fit the nominal focal length, but a caller's pose does not. `find_focal` replaces doubted
        # poses. The iterations that refine the new poses ignore the initialiser's weights (`by_residual`).
        given = inputs.init is not None or inputs.prior is not None
        free = trait(self.init, "estimates_noise") and self.refine.by_residual and not given
        if free and not self.radial:
            return inputs, True
        searched = self.radial or not trait(self.init, "finds_focal")
        return (with_found_focal(inputs, self.radial) if searched else inputs), False

    def _attempt(self, inputs: Inputs, call: _Call) -> _Attempt:
        """Propose poses, refine them, and judge the best pose."""
        inputs, nominal = self._with_camera(inputs)
        fixed = call.first_stage_only or self.effort == "fixed"
        watched = *iter_tensors(inputs), *(self.parameters() if needs_graph(()) else ())  # vmap can be over parameters
        free = not (fixed or self._whole.compiled) and sees_values(*watched)
        can_adapt = trait(self.init, "estimates_noise") and self.refine.m > 0
        adapts = free and (self.effort == "adaptive" or (can_adapt and not self.training))
        compares = free and not self.training
        # Rigs are not searched, and an unknown focal length has another search.
        searches = adapts and self.focal == "known" and inputs.rig is None
        problem, frame, starts = self._run(self._propose, inputs, call, searches)
        rivals = rival = replaced = found = odds = None
        if searches:
            keep_others = inputs.init is not None or inputs.prior is not None or self.views > 1
            starts, rivals = search_on(problem, starts, keep_others=keep_others)
        seen = problem
        if inputs.radial is not None:
            seen = distorted(problem, inputs.radial)
            zoom = torch.zeros_like(inputs.radial[:, :1]) if starts.camera is None else starts.camera[:, :1]
            starts = starts._replace(camera=torch.cat((zoom, inputs.radial), 1))
        plan = self._run(self.refine.begin, seen, starts)
        more = _MORE_ITERATIONS if (nominal or self.radial) and not call.first_stage_only else 0
        plan, now = self.refine.iterate(plan, 0 if call.first_stage_only else None, more=more, run=self._run)
        if compares:
            found = plan.evidence_at(now.state)
            if rivals is not None:
                rival = State.of(put(now.state.pose, *rivals))
            if nominal and adapts:
                doubted = frame.valid & ~self.refine.judge(plan, now, found).ok
                rival, replaced = find_focal(problem, now.state, doubted)
            now, found, odds = reconsider(self.refine, plan, now, found, frame.valid, rival, replaced)
        refined = self._run(self.refine.judge, plan, now, found, odds)
        result = self._run(self._result, problem, frame, starts, refined, call)
        return _Attempt(problem, frame, starts, refined, result)

    def _propose(self, inputs: Inputs, call: _Call, searches: bool) -> tuple[Problem, Frame, Starts]:
        problem, frame = self.normalize(*inputs[:5], inputs.noise, inputs.confidence, inputs.rig)
        init = inputs.init
        if call.always:
            names = "world_points", "img_points", "weights", "noise", "confidence", "rig"
            inner = map_tensors(_bounded, [getattr(problem, name) for name in names])
            problem = problem._replace(**dict(zip(names, inner, strict=True)))
        if inputs.prior is not None:
            term, usable = PoseTerm.of(inputs.prior, frame.centroid, frame.size)
            term = map_tensors(_bounded, term) if call.always else term
            problem, init = problem._replace(pose_terms=(term,)), inputs.prior.pose if init is None else init
            frame = frame._replace(status=torch.where(usable, frame.status, Status.NOT_FINITE.value))
        if inputs.free_focal is not None:
            known = inputs.free_focal.scaled(frame.img_scale)
            problem = problem._replace(free_focal=map_tensors(_bounded, known) if call.always else known)
        if inputs.lens_scale is not None:  # `sigma` is the noise of distorted pixels
            there = (frame.undo_pairs(problem.weights) > 0) & (inputs.lens_scale > 0)
            mean = torch.where(there, inputs.lens_scale, 1.0).log().sum(1) / there.sum(1).clamp(min=1)
            frame = frame._replace(img_scale=frame.img_scale * mean.exp())
        given = None
        if self.init is None or init is not None:
            given, usable = frame.start(init)
            given = map_tensors(_bounded, given) if call.always else given
            if init is not None:
                ignored = torch.zeros_like(frame.status) if frame.ignored is None else frame.ignored
                frame = frame._replace(ignored=torch.where(usable, ignored, Status.INIT.value))
        views = 1 if call.first_stage_only or self.refine.m == 0 else self.views
        fixed, order = self.effort == "fixed" or self._whole.compiled, self.normalize.order
        starts = propose(self.init, problem, given, views=views, order=order, fixed=fixed, search_follows=searches)
        if starts.noise is not None and (inputs.rig is not None or inputs.lens_scale is not None):
            # The estimated noise is that of a mean pixel. The caller's pixels have different sizes here.
            unit = (frame.units(problem.focal, inputs.lens_scale) / frame.img_scale[:, None]).detach()
            unit = unit if frame.order is None else unit.gather(1, frame.order)
            unit = unit if problem.noise is None else torch.where(problem.noise.img.isnan(), unit, 1.0)
            starts = starts._replace(noise=starts.noise._replace(img=starts.noise.img * unit))
        problem = problem._replace(img_scale=frame.img_scale)  # the threshold of RANSAC was in undistorted pixels
        return problem, frame, starts

    def _result(self, problem: Problem, frame: Frame, starts: Starts, refined: Refinement, call: _Call) -> PnPResult:
        """Express the refined state in the caller's world."""
        pose, first = frame.undo(refined.pose), frame.undo(starts.pose)
        # A sum is finite only if all its terms are finite. The translation has the product of rotation and centroid as
        # a term, so the rotation needs no test of its own.
        valid = frame.valid
        finite = valid & (pose.translation.sum(-1) + refined.weights.sum(-1) + refined.cost).isfinite()
        ok = finite & refined.ok if starts.ok is None else finite & refined.ok & starts.ok
        state, intrinsics, found = refined.state, frame.intrinsics, refined.evidence
        if state.camera.shape[1]:
            intrinsics = scale_focal(intrinsics, torch.where(finite, state.camera[:, 0], 0.0).exp())
        first_ok = valid & first.translation.sum(-1).isfinite()
        status = torch.where(refined.in_front, Status.NOT_BELIEVED.value, Status.BEHIND.value)
        status = torch.where(finite, status, Status.DEGENERATE.value)
        if frame.ignored is not None:
            status = torch.where(frame.ignored > 0, frame.ignored, status)
        status = torch.where(ok, Status.SOLVED.value, status)
        # int64 until here, because `where` of ONNX Runtime does not support int8.
        status = torch.where(valid, status, frame.status).to(torch.int8)
        live = finite if call.always else ok
        pose = gate_pose(pose, live, finite)
        with torch.no_grad():
            sigma = torch.where(finite, found.sigma * problem.focal / frame.img_scale, 0.0)
        # In a rig, `forward` replaces `None` by the caller's cameras.
        cameras: Any = None if intrinsics.ndim > 3 else gate(intrinsics, live, torch.ones_like(finite), 0.0)
        return PnPResult(
            *pose,
            gate(frame.undo_pairs(refined.weights), live, finite, 0.0),
            gate(refined.cost, live, finite, torch.finfo(refined.cost.dtype).max ** 0.5),
            ok,
            gate_pose(first, first_ok, first_ok),
            status,
            torch.where(finite, refined.probability, 0.0),
            Alternatives.none(pose),
            cameras,
            gate(as_dist(state.radial), live, finite, 0.0),
            sigma,
            frame.undo_pairs(found.inlier).gt(0.5) & finite[:, None],
        )

    @torch.no_grad()
    def _with_alternatives(self, attempt: _Attempt, most: int) -> PnPResult:
        """Add at most ``most`` alternative poses to the result."""
        problem, frame, starts, refined, result = attempt
        zoom = refined.state.zoom
        starts = starts._replace(noise=problem._replace(noise=starts.noise).seen_with(zoom).noise)
        pose, problem = frame.apply(result.pose), problem.seen_with(zoom)
        found = find_alternatives(self.refine, problem, starts, pose, frame.valid, most)
        poses = frame.undo(Pose(found.rotation, found.translation))
        translation = torch.where(found.valid[..., None], poses.translation, 0.0)
        return result._replace(alternatives=found._replace(translation=translation))


def _checked_gradient(gradient: str) -> str:
    KORNIA_CHECK(gradient in ("ok", "always"), f"gradient must be 'ok' or 'always', got {gradient!r}.")
    return gradient
