"""The solver as one layer: normalise, guess, refine, undo; and its weights on disk."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK, KORNIA_CHECK_SHAPE
from kornia.core.exceptions import BaseError, ShapeError, TypeCheckError, ValueCheckError
from kornia.geometry.camera import PinholeCamera
from torch import Tensor, nn

from kornia_pnpnet.core.checks import Shapes, check_devices, check_like, check_shapes
from kornia_pnpnet.core.compilation import Compiled
from kornia_pnpnet.geometry import project
from kornia_pnpnet.init import EPnP, MLPInit, REPPnP, SetInit
from kornia_pnpnet.init.ransac.sampling import log_false_alarms
from kornia_pnpnet.init.ransac.scoring import Thresholds, chance_of_inlier, judge
from kornia_pnpnet.normalize import VIEWS, Frame, Normalize
from kornia_pnpnet.pretrained import read_weights, write_weights
from kornia_pnpnet.refine.lm import LMStart, LMStep, RobustWeightedLM
from kornia_pnpnet.types import Correspondences, Guess, Noise, PnPResult, Pose, Refinement, camera_matrices

__all__ = ["PnPNet"]

_INITIALISERS: dict[str, type[nn.Module]] = {
    "EPnP": EPnP,
    "MLPInit": MLPInit,
    "REPPnP": REPPnP,
    "SetInit": SetInit,
}
# Pixels are never known better than to this share of the focal length: weights stay finite.
_LEAST_NOISE = 1e-6
# Pairs that are this many standard deviations off are no evidence for a pose; and how often chance may look like one.
_EVIDENT, _MAX_FALSE_ALARMS = 3.5, 0.01


def check_inputs(
    world_points: Tensor,
    img_points: Tensor,
    intrinsics: Tensor,
    weights: Tensor | None,
    mask: Tensor | None,
    init: Pose | None = None,
) -> None:
    """Check shapes, dtypes and devices; never values, which would stall a GPU and let one problem fail a batch."""
    for name, value in (("world_points", world_points), ("img_points", img_points), ("intrinsics", intrinsics)):
        if not isinstance(value, Tensor):
            raise TypeCheckError(f"{name} must be a tensor, got {type(value).__name__}.")
    KORNIA_CHECK_SHAPE(world_points, ["B", "N", "3"])
    KORNIA_CHECK_SHAPE(img_points, ["B", "N", "2"])
    batch, count = world_points.shape[:2]
    rotation, translation = (None, None) if init is None else init
    shapes: Shapes = {
        "img_points": (img_points, (batch, count, 2)),
        "weights": (weights, (batch, count)),
        "mask": (mask, (batch, count)),
        "intrinsics": (intrinsics, (3, 3) if intrinsics.ndim == 2 else (batch, 3, 3)),
        "init rotation": (rotation, (batch, 3, 3)),
        "init translation": (translation, (batch, 3)),
    }
    check_shapes(shapes, world_points)
    if count < 3:
        raise ShapeError(f"A pose needs at least 3 pairs, got N = {count}.", actual_shape=tuple(world_points.shape))
    floats = {"img_points": img_points, "intrinsics": intrinsics, "weights": weights}
    floats |= {"init rotation": rotation, "init translation": translation}
    check_like(floats, world_points)
    if world_points.dtype not in (torch.float32, torch.float64):
        raise TypeCheckError(
            f"world_points must be float32 or float64, got {world_points.dtype}: cast the inputs with .float()."
        )
    if mask is not None and mask.dtype != torch.bool:
        raise TypeCheckError(f"mask must be bool, got {mask.dtype}.")
    check_devices({"mask": mask}, world_points)


class _Stage(NamedTuple):
    """What is known before the first iteration."""

    start: LMStart
    frame: Frame
    guess: Guess


class PnPNet(nn.Module):
    r"""Find the pose of a calibrated camera from 2D-3D pairs of which some are wrong.

    The layer normalises the pairs, lets ``init`` guess a pose, refines it, and expresses it in the frame that came
    in. All of it is batched and differentiable. One bad problem (non-finite input, fewer than three pairs, points on
    a line, a pose that explains nothing) has ``ok=False``, a finite pose without gradient, and changes no other.

    Convention: ``x_cam = R x_world + t``, +z forward, pixels ``u = fx x/z + cx``; skew must be 0.

    Precision: the layer computes in the dtype of its inputs, float32 or float64, also inside :class:`torch.autocast`,
    which changes no bit of its results. Half precision has too few digits for a pixel: inputs of float16 or bfloat16
    have to be cast with ``.float()``.

    Args:
        init: maps :class:`~kornia_pnpnet.types.Correspondences` to a :class:`~kornia_pnpnet.types.Guess`, see
            :mod:`kornia_pnpnet.init`; ``None`` starts from the identity or from the pose given with the call.
        refine: the refiner; classical :class:`~kornia_pnpnet.refine.lm.RobustWeightedLM` when ``None``.
        normalize: the normalisation; the default centres and scales the world and orders the pairs.
        views: guesses for each problem, 1 to 8: of the problem itself and of what mirrors make of it (see
            :meth:`~kornia_pnpnet.normalize.Normalize.views`), which to a network are other problems. All are refined,
            and after seven tenths of the iterations the best goes on. Costs more and solves more, whatever the number
            was in training.

    Raises:
        BaseError: when ``views`` is not an integer from 1 to 8.

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
    ) -> None:
        super().__init__()
        most = len(VIEWS)
        KORNIA_CHECK(type(views) is int and 1 <= views <= most, f"views must be 1 to {most}, got {views!r}.")
        self.views = views
        self.init = init
        self.refine = RobustWeightedLM(learnable=False) if refine is None else refine
        self.normalize = Normalize() if normalize is None else normalize
        # What runs: these, or what `compile` made of them.
        self._solve: Callable[..., PnPResult] = self._in_parts
        self._begin: Callable[..., _Stage] = self._guess
        self._finish: Callable[..., PnPResult] = self._result

    def forward(
        self,
        world_points: Tensor,
        img_points: Tensor,
        intrinsics: Tensor | PinholeCamera,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
        init: Pose | None = None,
        *,
        img_sigma: Tensor | float | None = None,
        world_sigma: Tensor | float | None = None,
        first_stage_only: bool = False,
    ) -> PnPResult:
        r"""Solve a batch of problems.

        Args:
            world_points: shape :math:`(B, N, 3)`, float32 or float64, any unit.
            img_points: pixels, shape :math:`(B, N, 2)`.
            intrinsics: camera matrices, shape :math:`(B, 3, 3)` or :math:`(3, 3)`, or Kornia's cameras; where they are
                does not matter.
            weights: how much each pair counts, at least 0, shape :math:`(B, N)`; 1 when ``None``.
            mask: False where a pair is padding, bool, shape :math:`(B, N)`. What padding holds does not matter.
            init: world-to-camera pose to start from instead of the initialiser's, :math:`(B, 3, 3)` and
                :math:`(B, 3)`. Where the initialiser weighs pairs, it still does.
            img_sigma: standard deviation of the noise on each pixel coordinate, a number, :math:`(B,)` or
                :math:`(B, N)`, at least 0; NaN where it is not known. With this or ``world_sigma`` the refinement
                counts residuals in standard deviations, and so do the scales of its kernel.
            world_sigma: likewise on each world coordinate, in the unit of ``world_points``.
            first_stage_only: return the first guess unrefined, the paper's "Net"; as with ``m=0``, at that cost.

        Returns:
            The :class:`~kornia_pnpnet.types.PnPResult`. Gradients flow through rotation, translation, weights and cost
            of the problems that are ``ok``, and through the first guess of every sound one. A problem that cannot be
            solved has the identity as its pose and a cost of the square root of the dtype's largest number.

        Raises:
            ShapeError: for shapes that do not fit each other, fewer than 3 pairs, or another N than the initialiser
                was built for.
            TypeCheckError: for dtypes that differ or are not float32 or float64.
            DeviceError: for tensors on different devices, or on another one than a network of the solver.
        """
        inputs = _prepared(world_points, img_points, intrinsics, weights, mask, init, img_sigma, world_sigma)
        portions = self._portions(world_points)
        parts = list(zip(*(_split(x, portions) for x in inputs), strict=True))
        with _in_full_precision(world_points.device.type):
            results = [self._solve(first_stage_only, *part) for part in parts]
        if len(results) == 1:
            return results[0]
        fields = zip(*((*result[:5], *result.init) for result in results), strict=True)
        rotation, translation, pair_weights, cost, ok, *first = map(torch.cat, fields)
        return PnPResult(rotation, translation, pair_weights, cost, ok, Pose(*first))

    def _portions(self, world_points: Tensor) -> int:
        """In how many parts a batch is solved.

        Without gradients, on a CPU, what the initialiser has in hand at once stays in the caches.
        """
        most = getattr(self.init, "pairs_at_once", None)
        on_cpu = world_points.device.type == "cpu"
        if most is None or not on_cpu or torch.is_grad_enabled() or torch.compiler.is_compiling():
            return 1
        batch, count = world_points.shape[:2]
        return max(1, min(batch * count // (most * torch.get_num_threads()), batch // 2))

    def with_guess(
        self,
        world_points: Tensor,
        img_points: Tensor,
        intrinsics: Tensor | PinholeCamera,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
        init: Pose | None = None,
        *,
        img_sigma: Tensor | float | None = None,
        world_sigma: Tensor | float | None = None,
        first_stage_only: bool = False,
    ) -> tuple[PnPResult, Guess]:
        """As a call, and all that the first guess was, to train it: poses, weights and noise.

        Args:
            world_points: as of a call, and so are the others.
            img_points: likewise.
            intrinsics: likewise.
            weights: likewise.
            mask: likewise.
            init: likewise.
            img_sigma: likewise.
            world_sigma: likewise.
            first_stage_only: likewise.

        Returns:
            The result, and the guess in the frame, the order and the units of the inputs; its ``ok`` is whether the
            problem is sound.
        """
        inputs = _prepared(world_points, img_points, intrinsics, weights, mask, init, img_sigma, world_sigma)
        with _in_full_precision(world_points.device.type):
            stage = self._begin(1 if first_stage_only or self.refine.m == 0 else self.views, *inputs)
            end = self.refine.iterate(stage.start, 0 if first_stage_only else None)
            return self._finish(stage, end), self._whole_guess(stage)

    def _in_parts(self, first_stage_only: bool, *inputs: Any) -> PnPResult:
        """What is before the iterations, they themselves, and what is after them; inputs as of :meth:`_guess`."""
        views = 1 if first_stage_only or self.refine.m == 0 else self.views
        stage = self._begin(views, *inputs)
        end = self.refine.iterate(stage.start, 0 if first_stage_only else None)
        return self._finish(stage, end)

    def compile(self, mode: str | None = None, *, whole: bool = False) -> None:
        """Compile with ``torch.compile``, in place: what is before, in, and after an iteration, each once.

        The first call then takes some seconds, less where a cache of ``torch.compile`` is on disk, and each further one
        a fraction of the time. The batch may change its size; a batch of one, another number of pairs, another dtype
        and calls that record gradients are compiled for themselves when they first come. Where a part cannot be
        compiled, for want of a C++ compiler or because it is a RANSAC, that part runs as it is, with one warning.
        Copies and saved weights of the solver are not compiled.

        Args:
            mode: of ``torch.compile``; ``"reduce-overhead"`` captures CUDA graphs.
            whole: compile the solver as one, with its iterations one after the other. The first call takes longer;
                calls of a few problems, which mostly wait for Python, take half the time.
        """
        self._solve = Compiled(self._in_parts, mode) if whole else self._in_parts
        self._begin = self._guess if whole else Compiled(self._guess, mode)
        self._finish = self._result if whole else Compiled(self._result, mode)
        if not whole:
            self.refine.compile(mode)

    def _guess(
        self,
        views: int,
        world_points: Tensor,
        img_points: Tensor,
        intrinsics: Tensor,
        weights: Tensor | None,
        mask: Tensor | None,
        init: Pose | None,
        noise: Noise | None,
    ) -> _Stage:
        """Everything before the first iteration."""
        corr, frame = self.normalize(world_points, img_points, intrinsics, weights, mask)
        if noise is not None:
            corr, frame = self._with_noise(corr, frame, noise)
        if self.init is None or (init is not None and not isinstance(self.init, SetInit)):
            guess = self._given(init, corr.weights, world_points, frame)
        elif init is not None:
            given = self._given(init, corr.weights, world_points, frame).pose
            guess = self.init(corr)._replace(pose=given, others=None)
        elif views == 1:
            guess = self.init(corr)
        else:
            guess = self.init(self.normalize.views(corr, views))
            pose, others = self.normalize.undo_views(guess.pose, views)
            batch = world_points.shape[0]  # of the first view, whose pairs have the order that they came in
            guess = Guess(pose, guess.weights[:batch], None if guess.ok is None else guess.ok[:batch], others)
        if guess.noise is None and corr.noise is not None:  # what is not known does not count
            guess = guess._replace(noise=Noise(*(x.nan_to_num(0.0) for x in corr.noise)))
        if guess.noise is not None:
            least = _LEAST_NOISE * corr.focal
            guess = guess._replace(noise=guess.noise._replace(img=guess.noise.img.maximum(least)))
        return _Stage(self.refine.begin(corr, guess), frame, guess)

    def _with_noise(self, corr: Correspondences, frame: Frame, noise: Noise) -> tuple[Correspondences, Frame]:
        """Noise in the units and the order of the correspondences; where it makes no sense, no problem is valid."""
        usable = torch.stack([((x >= 0) | x.isnan()).all(-1) & ~x.isinf().any(-1) for x in noise]).all(0)
        scales = corr.img_scale, corr.world_scale
        # What is not known is NaN, and would be the gradient of its scale, too.
        parts = [
            x if scale is None else torch.where(x.isnan(), x, x.nan_to_num() * scale[:, None])
            for x, scale in zip(noise, scales, strict=True)
        ]
        if self.normalize.order:
            parts = [x.gather(1, frame.order) for x in parts]
        return corr._replace(noise=Noise(*parts)), frame._replace(valid=frame.valid & usable)

    def _result(self, stage: _Stage, end: LMStep) -> PnPResult:
        """Everything after the last iteration."""
        start, frame, guess = stage
        refined = self.refine.finish(start, end)
        pose = self.normalize.undo(refined.pose, frame)
        first = self.normalize.undo(guess.pose, frame)
        # A sum is finite when all its terms are, and no rotation that is not leaves its translation finite: every entry
        # was multiplied by a coordinate of the centroid.
        finite = frame.valid & (pose.translation.sum(-1) + refined.weights.sum(-1) + refined.cost).isfinite()
        ok = finite & refined.ok if guess.ok is None else finite & refined.ok & guess.ok
        if start.pairs.noise is not None:
            ok = ok & _is_no_chance(start, refined)
        first_ok = frame.valid & first.translation.sum(-1).isfinite()
        pair_weights = refined.weights
        if self.normalize.order:
            pair_weights = torch.zeros_like(pair_weights).scatter(1, frame.order, pair_weights)
        return PnPResult(
            *_gate_pose(pose, ok, finite),
            _gate(pair_weights, ok, finite, 0.0),
            _gate(refined.cost, ok, finite, torch.finfo(refined.cost.dtype).max ** 0.5),
            ok,
            _gate_pose(first, first_ok, first_ok),
        )

    def _whole_guess(self, stage: _Stage) -> Guess:
        """A first guess in the frame, the order and the units of the inputs."""
        start, frame, guess = stage
        others, noise, weights = guess.others, guess.noise, guess.weights
        if others is not None:
            count = others.rotation.shape[1]
            many = Frame(*(x.repeat_interleave(count, 0) for x in frame))
            flat = self.normalize.undo(Pose(*(x.flatten(0, 1) for x in others)), many)
            others = Pose(*(x.unflatten(0, (-1, count)) for x in flat))
        if self.normalize.order:
            weights = torch.zeros_like(weights).scatter(1, frame.order, weights)
        if noise is not None:
            scales = start.corr.img_scale, start.corr.world_scale
            noise = Noise(*(x if s is None else x / s[:, None] for x, s in zip(noise, scales, strict=True)))
            if self.normalize.order:
                noise = Noise(*(torch.zeros_like(x).scatter(1, frame.order, x) for x in noise))
        return Guess(self.normalize.undo(guess.pose, frame), weights, frame.valid, others, noise)

    def _given(self, init: Pose | None, weights: Tensor, world_points: Tensor, frame: Frame) -> Guess:
        """Bring a pose given by hand (or the identity) to the normalised frame."""
        batch = world_points.shape[0]
        if init is None:
            eye = torch.eye(3, dtype=world_points.dtype, device=world_points.device).expand(batch, 3, 3)
            init = Pose(eye, world_points.new_zeros(batch, 3))
        limit = torch.finfo(world_points.dtype).max ** 0.25  # as for points: it can be squared twice
        usable = frame.valid & (torch.cat((init[0].flatten(1), init[1]), 1).abs().amax(-1) < limit)
        given = _gate_pose(Pose(*init), usable, usable)
        return Guess(self.normalize.apply_to_pose(given, frame), torch.ones_like(weights))

    # -- weights on disk ---------------------------------------------------------------------------------------------

    def config(self) -> dict[str, Any]:
        """The constructor arguments of all parts, as plain data."""
        arguments = getattr(self.init, "config", {})
        init = None if self.init is None else {"name": type(self.init).__name__, **arguments}
        parts = {"init": init, "refine": self.refine.config, "normalize": self.normalize.config}
        return {**parts, "views": self.views}

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> PnPNet:
        """Build an untrained solver from what :meth:`config` returned.

        Raises:
            ValueCheckError: when a part or an argument is unknown.
        """
        try:
            if set(config) != {"init", "refine", "normalize", "views"}:
                raise KeyError(f"parts {sorted(config)}")
            init_config = config["init"]
            init = None
            if init_config is not None:
                arguments = {key: value for key, value in init_config.items() if key != "name"}
                init = _INITIALISERS[init_config["name"]](**arguments)
            parts = init, RobustWeightedLM(**config["refine"]), Normalize(**config["normalize"])
            return cls(*parts, views=config["views"])
        except (BaseError, KeyError, TypeError, AttributeError) as error:
            raise ValueCheckError(f"Not a configuration of PnPNet: {error!r}.") from error

    def save_pretrained(self, folder: str | Path) -> None:
        """Write ``config.json`` and ``model.safetensors``.

        Args:
            folder: where to; made when missing.

        Raises:
            ValueCheckError: when the initialiser is not one of the package's.
        """
        config = self.config()
        if self.init is not None and config["init"]["name"] not in _INITIALISERS:
            raise ValueCheckError(f"{config['init']['name']} cannot be saved, only {sorted(_INITIALISERS)} can.")
        write_weights(folder, config, self.state_dict())

    @classmethod
    def from_pretrained(cls, name_or_folder: str | Path) -> PnPNet:
        """Load a trained solver, in evaluation mode.

        Args:
            name_or_folder: the name of shipped weights (see :func:`shipped_weights`), which needs no network; a local
                folder; or a Hugging Face Hub repository id. The first that exists is taken. Nothing is unpickled.

        Returns:
            The solver in float32 on the CPU.

        Raises:
            FileNotFoundError: when there is no such name, folder or repository.
            ValueCheckError: when the files are damaged or of another model.
        """
        config, state = read_weights(name_or_folder)
        model = cls.from_config(config)
        try:
            model.load_state_dict(state)
        except RuntimeError as error:
            raise ValueCheckError(f"The weights {name_or_folder} belong to another model: {error}") from error
        return model.eval()


def _gate(value: Tensor, ok: Tensor, finite: Tensor, fill: float | Tensor) -> Tensor:
    """Keep the gradient of problems that are ok, the value of those that are finite, and fill the others."""
    shape = (-1,) + (1,) * (value.ndim - 1)
    if value.requires_grad:
        value = torch.where(ok.view(shape), value, value.detach())
    return torch.where(finite.view(shape), value, fill).contiguous()


def _gate_pose(pose: Pose, ok: Tensor, finite: Tensor) -> Pose:
    """:func:`_gate` for a pose; the identity fills."""
    eye = torch.eye(3, dtype=pose.rotation.dtype, device=pose.rotation.device)
    return Pose(_gate(pose.rotation, ok, finite, eye), _gate(pose.translation, ok, finite, 0.0))


def _prepared(
    world_points: Tensor,
    img_points: Tensor,
    intrinsics: Tensor | PinholeCamera,
    weights: Tensor | None,
    mask: Tensor | None,
    init: Pose | None,
    img_sigma: Tensor | float | None,
    world_sigma: Tensor | float | None,
) -> tuple[Any, ...]:
    """Checked inputs: a camera for each problem, and the noise of each pair where any of it is known."""
    intrinsics = camera_matrices(intrinsics)
    check_inputs(world_points, img_points, intrinsics, weights, mask, init)
    noise = None
    if img_sigma is not None or world_sigma is not None:
        sigmas = ("img_sigma", img_sigma), ("world_sigma", world_sigma)
        noise = Noise(*(_sigmas(name, sigma, world_points) for name, sigma in sigmas))
    if intrinsics.ndim == 2:
        intrinsics = intrinsics.expand(world_points.shape[0], 3, 3)
    return world_points, img_points, intrinsics, weights, mask, None if init is None else Pose(*init), noise


def _in_full_precision(device: str) -> AbstractContextManager[Any]:
    """Without autocast, where there is such a thing: not for tensors without values (``meta``)."""
    return torch.autocast(device, enabled=False) if torch.amp.is_autocast_available(device) else nullcontext()


def _split(value: Tensor | Pose | Noise | None, count: int) -> list[Any]:
    """In so many parts along the batch."""
    if count == 1 or value is None:
        return [value] * count
    if isinstance(value, Tensor):
        return list(value.tensor_split(count))
    return [type(value)(*part) for part in zip(*(x.tensor_split(count) for x in value), strict=True)]


def _sigmas(name: str, sigma: Tensor | float | None, like: Tensor) -> Tensor:
    """Standard deviations of each pair, (B, N), NaN where they are not known, like the (B, N, 3) world points."""
    batch, count = like.shape[:2]
    if sigma is None or isinstance(sigma, int | float):
        return like.new_full((batch, count), torch.nan if sigma is None else sigma)
    if not isinstance(sigma, Tensor):
        raise TypeCheckError(f"{name} must be a number or a tensor, got {type(sigma).__name__}.")
    check_like({name: sigma}, like)
    if sigma.shape not in ((), (batch,), (batch, count)):
        raise ShapeError(
            f"{name} must be a number or have the shape {(batch,)} or {(batch, count)}, got {tuple(sigma.shape)}.",
            actual_shape=tuple(sigma.shape),
            expected_shape=["B", "N"],
        )
    return (sigma[:, None] if sigma.ndim == 1 else sigma).expand(batch, count)


def _is_no_chance(start: LMStart, refined: Refinement) -> Tensor:
    """Whether pairs without a pose would hardly fit any so well and so often, bool (B,). It needs to know the noise."""
    pose, fixed = Pose(*(x.detach() for x in refined.pose)), start.pairs.map(torch.Tensor.detach)
    assert fixed.noise is not None
    thresholds = Thresholds(*(_EVIDENT * x for x in fixed.noise))
    judged = judge(project(pose, fixed), fixed, thresholds)
    inliers, counts = (judged.weights > 0).sum(-1), (fixed.weights > 0).sum(-1)
    chance = chance_of_inlier(fixed, thresholds, judged)
    return log_false_alarms(counts, inliers, counts, chance) < math.log(_MAX_FALSE_ALARMS)
