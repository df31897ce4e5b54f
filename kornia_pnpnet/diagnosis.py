"""Find out which mistake in a convention makes the pairs disagree with the expected pose, or with every pose."""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.core.exceptions import ShapeError
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kornia_pnpnet.arguments import checked_inputs
from kornia_pnpnet.core.performance import full_precision
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.frame import Normalize
from kornia_pnpnet.judge.evidence import LEAST_PROBABILITY, Votes, at_pose, evidence, probability
from kornia_pnpnet.problem import State
from kornia_pnpnet.registry import create_solver
from kornia_pnpnet.result import Pose

__all__ = ["Diagnosis", "Trial", "diagnose"]

# Trials are equally good if their evidence per pair differs by less than this number. Pixel noise of 1.28 px
# instead of 1 px causes this difference.
_EQUAL = 0.5


class Trial(NamedTuple):
    """Agreement of the pairs with a pose after one change of the input. Numbers are medians over the batch."""

    change: str  #: Description of the change.
    evidence: float  #: Evidence for the pose, divided by the number of pairs, see :mod:`kornia_pnpnet.judge.evidence`.
    agree: float  #: Share of the pairs that are inliers.
    sigma: float  #: Standard deviation of a pixel coordinate, estimated from the inliers, in pixels.
    ok: bool  #: Whether the pose is believed, see :mod:`kornia_pnpnet.judge.evidence`.


class Diagnosis(NamedTuple):
    """The result of :func:`diagnose`. The ``str`` of the result is one sentence."""

    trials: tuple[Trial, ...]  #: All trials. The first trial is the input as given.
    #: The ``ok`` trials with nearly the largest evidence. If some of them keep the pairs unchanged, only the first one.
    best: tuple[Trial, ...]

    def __str__(self) -> str:
        def text(trial: Trial, of: str = "") -> str:
            return f"{100.0 * trial.agree:.0f} %{of} to {float(f'{abs(trial.sigma):.2g}'):g} px"  # no exponent

        given = self.trials[0]
        before = f"{given.change}: {text(given)}"
        if not self.best:
            return f"no usual mistake explains the pairs ({before})"
        changes = " or ".join(trial.change for trial in self.best)
        found = f"{changes}: {text(self.best[0], ' of the pairs agree')}"
        return found if given in self.best else f"{found} ({before})"


@torch.no_grad()
@full_precision
def diagnose(
    world_points: Tensor, img_points: Tensor, intrinsics: Tensor | PinholeCamera, *, pose: Pose | None = None
) -> Diagnosis:
    """Undo common mistakes in conventions one by one, and tell which change makes the pairs agree with a pose.

    The mistakes are swapped pixel coordinates, a y axis that points up, a left-handed world, an incorrect principal
    point or focal length, the intrinsics of a resized image, normalised coordinates in place of pixels, and a
    camera-to-world pose. The solver ``pnpnet-set`` solves the input after each change, and the evidence for the poses
    is compared. Points in one plane cannot reveal a mirrored world, swapped coordinates or a flipped axis.

    Args:
        world_points: see :meth:`PnPNet.forward <kornia_pnpnet.solver.PnPNet.forward>`. All problems of a batch must
            have the same convention.
        img_points: pixels; see ``PnPNet.forward``.
        intrinsics: see ``PnPNet.forward``. The largest pixel coordinates are used as the size of the image.
        pose: the expected pose. If ``None``, any pose is accepted.

    Raises:
        BaseError: for the reasons of ``PnPNet.forward``, and for bearings.

    Example:
        >>> from kornia_pnpnet.data import SyntheticProblems
        >>> p = SyntheticProblems(n=50, batch_size=1, seed=0).batch(0)
        >>> found = diagnose(p.world_points, p.img_points.flip(-1), p.intrinsics)  # the principal point is 0
        >>> [trial.change for trial in found.best]
        ['swap u and v', 'flip y', 'mirror the world']
    """
    _, inputs = checked_inputs(world_points, img_points, intrinsics, init=pose, init_name="pose")
    if inputs.rig is not None:
        raise ShapeError(f"img_points of diagnose must be pixels (..., N, 2), got the shape {tuple(img_points.shape)}.")
    if not len(inputs.world_points):
        raise ShapeError(f"diagnose needs at least one problem, got world_points of {tuple(world_points.shape)}.")
    given = inputs.world_points, inputs.img_points, inputs.intrinsics / inputs.intrinsics[:, 2:, 2:]
    changed = _changed(*given)
    names, batch = [*changed], tuple(torch.cat(x) for x in zip(*changed.values(), strict=True))
    if inputs.init is not None:
        names = [names[0], "invert the pose", "find another pose", *names[1:]]
    for effort in ("fixed", "adaptive"):  # the adaptive search takes long and is rarely needed
        with world_points.device:
            solver = create_solver("pnpnet-set", effort=effort)
        pairs, poses = batch, solver(batch[0], batch[1], batch[2]).pose
        if inputs.init is not None:
            rotation, translation = inputs.init
            inverse = Pose(rotation.mT, -(rotation.mT @ translation[..., None])[..., 0])
            poses = map_tensors(lambda *x: torch.cat(x), inputs.init, inverse, poses)
            pairs = tuple(torch.cat((x, x, more)) for x, more in zip(given, batch, strict=True))
        trials = _judged(names, pairs, poses)
        believed = [trial for trial in trials if trial.ok]
        if believed:
            break
    least = max((trial.evidence for trial in believed), default=0.0) - _EQUAL
    best = tuple(trial for trial in believed if trial.evidence > least)
    # A change of the pose, or no change, is simpler than a change of the pairs.
    plain = [trial for trial in trials[: len(trials) - len(changed) + 1] if trial in best]
    return Diagnosis(trials, tuple(plain[:1]) or best)


def _judged(names: list[str], pairs: tuple[Tensor, ...], poses: Pose) -> tuple[Trial, ...]:
    """Judge the poses of T named trials. The batch of pairs and poses has T * B problems."""
    problem, frame = Normalize(order=False)(*pairs)
    unknown = torch.zeros_like(problem.weights[:, :1], dtype=torch.bool)
    votes = Votes.of(problem, unknown)
    seen = at_pose(State.of(frame.apply(poses)), problem, votes)
    found = evidence(seen, problem, votes)
    ok = frame.valid & (probability(seen, problem, found, votes) >= LEAST_PROBABILITY)
    sigma = found.sigma * problem.focal / frame.img_scale
    columns = found.log_ratio / problem.weights.shape[1], found.inlier.gt(0.5).to(sigma).mean(1), sigma, ok.to(sigma)
    rows = torch.stack(columns, -1).unflatten(0, (len(names), -1)).median(1).values.tolist()
    return tuple(Trial(name, a, b, c, believed > 0) for name, (a, b, c, believed) in zip(names, rows, strict=True))


def _changed(world: Tensor, pixels: Tensor, cameras: Tensor) -> dict[str, tuple[Tensor, Tensor, Tensor]]:
    """Points (B, N, 3), pixels (B, N, 2) and cameras (B, 3, 3) after each change of the inputs."""
    centre, upright = cameras[:, None, :2, 2], pixels.new_tensor([1.0, -1.0])

    def camera(focal: float, principal: float) -> Tensor:
        return cameras * cameras.new_tensor([[focal, focal, principal], [focal, focal, principal], [1.0, 1.0, 1.0]])

    central = camera(1.0, 0.0)
    central[:, :2, 2] = pixels.nan_to_num(0.0, 0.0, 0.0).amax((0, 1)) / 2.0
    return {
        "as given": (world, pixels, cameras),
        "swap u and v": (world, pixels.flip(-1), cameras),
        "flip y": (world, centre + upright * (pixels - centre), cameras),
        "mirror the world": (world * world.new_tensor([1.0, 1.0, -1.0]), pixels, cameras),
        "set the principal point to 0": (world, pixels, camera(1.0, 0.0)),
        "set the principal point to half the image size": (world, pixels, central),
        "halve the focal length": (world, pixels, camera(0.5, 1.0)),
        "double the focal length": (world, pixels, camera(2.0, 1.0)),
        "halve the intrinsics (resized image)": (world, pixels, camera(0.5, 0.5)),
        "double the intrinsics (resized image)": (world, pixels, camera(2.0, 2.0)),
        "multiply normalised coordinates by the intrinsics": (world, pixels @ cameras[:, :2, :2].mT + centre, cameras),
    }
