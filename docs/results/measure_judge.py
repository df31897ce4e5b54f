"""Measure what each part of the judge is worth: every part is switched off in turn. ``make.py`` is the command."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from measure_probability import ARGUMENTS, Drawn, errors, kinds
from torch import Tensor

from kornia_pnpnet import Pose
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.data import ObjectPoints, OutlierMix, SceneProblems, SyntheticProblems, load_scene
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.judge import evidence
from kornia_pnpnet.propose import alternatives
from kornia_pnpnet.refine.lm import RobustWeightedLM

_SYNTHETIC = ("matches, 9 pairs", "matches, 50 pairs", "uniform, 9 pairs")
_AT_ONCE = 60  # problems of real matches in a call


def _one_of_each(rows: Tensor, there: Tensor) -> Tensor:
    """No pair is a copy."""
    return torch.ones_like(rows[..., 0])


def _keeps_noise(self: RobustWeightedLM, plan: Any, now: Any) -> Any:
    """The estimated noise of the points stays."""
    return plan, now._replace(mixture=plan.evidence_at(now.state).mixture)


def _any_points(world_points: Tensor, inliers: Tensor) -> Tensor:
    return inliers.any(-1)


#: Each part of the judge: the object, the name in the object, and the value that switches the part off.
PARTS: dict[str, tuple[Any, str, Any]] = {
    "wide inliers": (evidence, "_TAIL", 0.0),
    "votes of copies": (evidence, "copies", _one_of_each),
    "choice of the points' noise": (RobustWeightedLM, "shown", _keeps_noise),
    "rival of larger noise": (alternatives, "_GAP", -math.inf),
    "rival of the search": (alternatives, "_APART", math.inf),
    "rival of the mirror image": (alternatives, "_NEAR_MIRROR", 0.0),
    "limit of the pose's standard deviation": (evidence, "_OPEN", math.inf),
    "limit of the noise": (evidence, "_MOST_NOISE", math.inf),
    "points off a line": (evidence, "_leave_a_line", _any_points),
}


#: Problems, and the largest errors of a solved problem in degrees and in the unit of the world or, if true, distances.
Set = tuple[Drawn, tuple[float, float], bool]


def sets(scenes: Path, seed: int) -> Iterator[Set]:
    """Synthetic problems, a clean scene, outdoor matches, indoor matches with depth maps, and keypoints of objects."""
    for kind in kinds(seed):
        if kind.name in _SYNTHETIC:
            yield kind._replace(name=f"synthetic, {kind.name}"), (2.0, 0.05), True
    objects = SyntheticProblems(
        n=12,
        batch_size=500,
        seed=seed,
        points=ObjectPoints(),
        outliers=OutlierMix(max_ratio=0.4, mismatch_share=0.5),
        half_image=None,
        img_sigma=(2.0, 20.0),
        world_sigma=0.0,
        degrees=(2.0, 8.0),
    )
    yield Drawn.of("keypoints, synthetic", objects.batch(0)), (5.0, 0.05), True
    door = SceneProblems(load_scene(scenes / "colmap" / "lund_door"), n=9, batch_size=1000, seed=seed)
    yield Drawn.of("lund_door, 9 pairs", door.batch(0)), (1.0, 0.005), True
    for name, file, limits, relative in (
        ("outdoor matches", "raw/by_image.npz", (1.0, 0.01), True),
        ("indoor matches, RGB-D", "rgbd/indoor.npz", (5.0, 0.05), False),
    ):
        read = np.load(scenes / file)
        x = {key: torch.from_numpy(read[key]) for key in ("W", "I", "M", "K", "R", "t", "kind")}
        for number, label in ((0, "ratio test"), (1, "no ratio test")):
            mask, *rest = (x[key][x["kind"] == number] for key in "MWIKRt")
            world, img, cameras, rotation, translation = (value.float() for value in rest)
            inputs = {**dict(zip(ARGUMENTS, (world, img, cameras), strict=True)), "mask": mask}
            depth = (world @ rotation.mT + translation[:, None])[..., 2]
            distance = depth.where(mask, torch.nan).nanmedian(1).values
            yield Drawn(f"{name}, {label}", inputs, Pose(rotation, translation), distance), limits, relative


@torch.no_grad()
def measure_judge(scenes: Path, seed: int) -> dict[str, Any]:
    """Solved problems, and far-off poses that are ``ok``, with the whole judge and without each part."""
    made: dict[str, Any] = {"environment": environment(), "sets": {}}
    for one in sets(scenes, seed):
        whole = judged(one)
        rows = {"": summary(whole, whole)}
        for part, (owner, name, value) in PARTS.items():
            with mock.patch.object(owner, name, value):
                rows[part] = summary(whole, judged(one))
        made["sets"][one[0].name] = rows
        print(one[0].name, rows[""], flush=True)
    return made


def judged(one: Set) -> dict[str, Tensor]:
    """Solve a set: which poses are right, far off, and ``ok``."""
    solver, (drawn, limits, relative) = load_solver("pnpnet-set"), one
    size = len(drawn.distance)
    at_once = _AT_ONCE if "mask" in drawn.inputs else size
    results = [solver(**{key: x[i : i + at_once] for key, x in drawn.inputs.items()}) for i in range(0, size, at_once)]
    pose = Pose(*(torch.cat([getattr(x, key) for x in results]) for key in ("rotation", "translation")))
    assert drawn.truth is not None
    turn, shift = errors(pose, drawn.truth)
    right = (turn < limits[0]) & (shift < limits[1] * (drawn.distance if relative else 1.0))
    far = (turn > 10.0) | (shift > 0.3 * drawn.distance)
    return {"right": right, "far": far, "ok": torch.cat([x.ok for x in results])}


def summary(whole: dict[str, Tensor], found: dict[str, Tensor]) -> dict[str, float]:
    """Shares of solved problems and of far-off poses that are ``ok``; the standard error compares with the whole."""
    right, count = found["right"], len(found["right"])
    return {
        "count": count,
        "success": right.double().mean().item(),
        "error": (right != whole["right"]).sum().item() ** 0.5 / count,
        "far_ok": (found["far"] & found["ok"]).double().mean().item(),
        "ok_of_right": found["ok"][right].double().mean().item(),
    }
