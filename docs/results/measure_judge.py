"""Fit the law of ``PnPResult.probability``, and measure the effect of each part of the judge. ``make.py`` calls this.

See ``kornia_pnpnet.judge.evidence``. The coefficients ``fitted`` of ``probability.json`` go into the code by
hand; a test compares the two laws.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from doubtful import Kind, doubtful
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch import Tensor
from torch.nn import functional

from kornia_pnpnet import Pose
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.data import ObjectPoints, OutlierMix, SceneProblems, SyntheticProblems, load_scene
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.judge import evidence
from kornia_pnpnet.metrics import pose_errors, reliability, success_rate
from kornia_pnpnet.propose import alternatives
from kornia_pnpnet.refine.lm import RobustWeightedLM

#: The solvers of the fit, and other solvers that are only measured.
FITTED, MEASURED = ("pnpnet-set", "p3p-ransac", "pnpnet-set:effort=fixed"), ("epnp-lm", "reppnp-lm")
#: Kinds of problems that the fit leaves out. A test of the noise or of the points decides about them.
LEFT_OUT = ("y up", "left-handed", "row and column", "line", "2 tags", "3 pairs")
PROBLEMS = 500


@torch.no_grad()
def measure_probability(seed_fit: int, seed_report: int) -> dict[str, Any]:
    """Fit a law on problems of one seed, and measure the law of the package on those of another.

    The problems are like real matches (``conf/data/matches.yaml``), of 5 to 150 pairs, those of the protocol, and those
    of ``doubtful.py``. Returns both laws, and by solver and kind the shares of right and of far-off poses that are
    ``ok``, and the reliability.
    """
    law = fit_law([solved(name, kind) for name in FITTED for kind in kinds(seed_fit) if in_fit(kind.name)])
    made: dict[str, Any] = {"environment": environment(), "law": list(evidence.LAW), "fitted": law}
    for name in (*FITTED, *MEASURED):
        rows = {kind.name: solved(name, kind) for kind in kinds(seed_report)}
        fitted = [row for kind, row in rows.items() if in_fit(kind)]
        chance, near = (torch.cat([row[key] for row in fitted]) for key in ("probability", "near"))
        curve = {key: x.nan_to_num(0.0).tolist() for key, x in reliability(chance, near)._asdict().items()}
        made[name] = {"kinds": {kind: rates(row) for kind, row in rows.items()}, "reliability": curve}
    return made


def in_fit(kind: str) -> bool:
    """Whether a kind of problems belongs to the fit."""
    return not any(x in kind for x in LEFT_OUT)


def kinds(seed: int) -> Iterator[Kind]:
    """Every kind of problems."""
    conf = str(Path(__file__).resolve().parents[2] / "conf")
    with initialize_config_dir(conf, version_base=None):
        config = compose("train", overrides=["experiment=set"]).data.validation
    for source, sizes in (("matches_50", (5, 6, 7, 9, 12, 20, 50, 150)), ("uniform", (5, 6, 9, 20, 50))):
        options: Any = OmegaConf.to_container(config[source], resolve=True)
        for n in sizes:
            drawn = {**options, "n": n, "batch_size": PROBLEMS, "seed": seed + n}
            problems = instantiate(drawn, _convert_="all").batch(0)
            yield Kind(f"{source.split('_')[0]}, {n} pairs", *problems[:2], problems.pose, {}, problems.intrinsics)
    yield from doubtful(PROBLEMS, seed)


def solved(name: str, kind: Kind) -> dict[str, Tensor]:
    """Solve problems: what the fit needs, the probability, ``ok``, and which poses are near and right."""
    solver, sigmas, seen = load_solver(name), [], []
    pose_sigma, judge = evidence.pose_sigma, RobustWeightedLM.judge

    def watched_sigma(*arguments: Any) -> Tensor:
        sigmas.append(pose_sigma(*arguments))
        return sigmas[-1]

    def watched_judge(
        self: RobustWeightedLM, plan: Any, now: Any, found: Any = None, odds: Tensor | None = None
    ) -> Any:
        refined = judge(self, plan, now, found, odds)
        factor = evidence.within_limits(sigmas[-1]) * (1.0 if odds is None else odds.sigmoid())
        variable = refined.evidence.log_ratio.clamp(*evidence.LAW_RANGE)
        seen.append((variable.double(), refined.probability > 0, factor.double()))
        return refined

    patch = mock.patch.object
    with patch(evidence, "pose_sigma", watched_sigma), patch(RobustWeightedLM, "judge", watched_judge):
        result = solver(**kind.inputs)
    variable, usable, factor = (torch.cat(x) for x in zip(*seen, strict=True))
    near = right = torch.zeros_like(result.ok)
    if kind.truth is not None:
        turn, shift = errors(result.pose, kind.truth)
        shift = shift / kind.distance
        near, right = (turn <= 10) & (shift <= 0.3), (turn < 2) & (shift < 0.05)
    found = {"ok": result.ok, "probability": result.probability, "near": near, "right": right, "usable": usable}
    return {**found, "variable": variable, "factor": factor}


def errors(pose: Pose, truth: Pose) -> tuple[Tensor, Tensor]:
    """Angles of the rotations in degrees, and distances of the camera centres."""
    centres = [-(x.rotation.mT @ x.translation[..., None])[..., 0] for x in (pose, truth)]
    return pose_errors(pose, truth).rotation_error_deg, (centres[0] - centres[1]).norm(dim=-1)


def rates(row: dict[str, Tensor]) -> dict[str, Any]:
    """Shares of the right poses and of the far-off poses that are ``ok``."""
    poses = {"ok_of_right": row["ok"][row["right"]], "ok_of_far": row["ok"][~row["near"]]}
    return {key: success_rate(values)._asdict() for key, values in poses.items() if len(values)}


def fit_law(rows: list[dict[str, Tensor]]) -> list[float]:
    """Fit the law by maximum likelihood; every kind counts the same. Poses that fail a test are left out.

    The probability of "near" is that of the law, multiplied by the probabilities of a small error and of no rival.
    """
    parts = [tuple(row[key][row["usable"]] for key in ("variable", "factor", "near")) for row in rows]
    variable, factor, near = (torch.cat(x) for x in zip(*parts, strict=True))
    weight = torch.cat([torch.full(x[1].shape, 1.0 / len(row["near"])) for x, row in zip(parts, rows, strict=True)])
    law = torch.zeros(2, dtype=torch.double, requires_grad=True)
    optimiser = torch.optim.LBFGS([law], max_iter=1000, tolerance_change=1e-12, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        probability = torch.sigmoid(law[0] + law[1] * variable) * factor
        value = functional.binary_cross_entropy(probability, near.double(), weight.double(), reduction="sum")
        value.backward()
        return value

    with torch.enable_grad():
        optimiser.step(loss)
    return [float(f"{x:.4g}") for x in law.tolist()]


_SYNTHETIC = ("matches, 9 pairs", "matches, 50 pairs", "uniform, 9 pairs")
_AT_ONCE = 60  # problems of real matches in a call


def _keeps_noise(self: RobustWeightedLM, plan: Any, now: Any) -> Any:
    """The estimated noise of the points stays."""
    return plan, now._replace(mixture=plan.evidence_at(now.state).mixture)


#: Each part of the judge: the object, the name in the object, and the value that switches the part off.
PARTS: dict[str, tuple[Any, str, Any]] = {
    "wide inliers": (evidence, "_TAIL", 0.0),
    "votes of copies": (evidence, "totals", lambda group, values: torch.ones_like(values)),  # no pair is a copy
    "choice of the points' noise": (RobustWeightedLM, "shown", _keeps_noise),
    "rival of larger noise": (alternatives, "_GAP", -math.inf),
    "rival of the search": (alternatives, "_APART", math.inf),
    "rival of the mirror image": (alternatives, "_NEAR_MIRROR", 0.0),
    "standard deviation of the pose": (evidence, "within_limits", torch.ones_like),
    "limit of the noise": (evidence, "_MOST_NOISE", math.inf),
    "points off a line": (evidence, "_leave_a_line", lambda projection, problem, inliers, sigma: inliers.any(-1)),
}


#: Problems, and the largest errors of a solved problem in degrees and in the unit of the world or, if true, distances.
Set = tuple[Kind, tuple[float, float], bool]


def sets(scenes: Path, seed: int) -> Iterator[Set]:
    """Synthetic problems, a clean scene, outdoor matches, indoor matches with depth maps, and keypoints of objects."""
    for kind in kinds(seed):
        if kind.name in _SYNTHETIC:
            yield kind._replace(name=f"synthetic, {kind.name}"), (2.0, 0.05), True
    noise: dict[str, Any] = {"img_sigma": (2.0, 20.0), "world_sigma": 0.0, "degrees": (2.0, 8.0)}
    noise |= {"outliers": OutlierMix(max_ratio=0.4, mismatch_share=0.5), "points": ObjectPoints(), "half_image": None}
    objects = SyntheticProblems(n=12, batch_size=500, seed=seed, **noise).batch(0)
    yield Kind("keypoints, synthetic", *objects[:2], objects.pose, {}, objects.intrinsics), (5.0, 0.05), True
    door = SceneProblems(load_scene(scenes / "colmap" / "lund_door"), n=9, batch_size=1000, seed=seed).batch(0)
    yield Kind("lund_door, 9 pairs", *door[:2], door.pose, {}, door.intrinsics), (1.0, 0.005), True
    for name, file, limits, relative in (
        ("outdoor matches", "raw/by_image.npz", (1.0, 0.01), True),
        ("indoor matches, RGB-D", "rgbd/indoor.npz", (5.0, 0.05), False),
    ):
        read = np.load(scenes / file)
        x = {key: torch.from_numpy(read[key]) for key in ("W", "I", "M", "K", "R", "t", "kind")}
        for number, label in ((0, "ratio test"), (1, "no ratio test")):
            mask, *rest = (x[key][x["kind"] == number] for key in "MWIKRt")
            world, img, cameras, rotation, translation = (value.float() for value in rest)
            drawn = Kind(f"{name}, {label}", world, img, Pose(rotation, translation), {"mask": mask}, cameras)
            yield drawn, limits, relative


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
    size = len(drawn.inputs["img_points"])
    at_once = _AT_ONCE if "mask" in drawn.inputs else size
    results = [solver(**{key: x[i : i + at_once] for key, x in drawn.inputs.items()}) for i in range(0, size, at_once)]
    result = map_tensors(lambda *x: torch.cat(x), *results)
    assert drawn.truth is not None
    turn, shift = errors(result.pose, drawn.truth)
    right = (turn < limits[0]) & (shift < limits[1] * (drawn.distance if relative else 1.0))
    far = (turn > 10.0) | (shift > 0.3 * drawn.distance)
    return {"right": right, "far": far, "ok": result.ok}


def summary(whole: dict[str, Tensor], found: dict[str, Tensor]) -> dict[str, float]:
    """Shares of solved problems and of far-off poses that are ``ok``; the standard error compares with the whole."""
    right, count = found["right"], len(found["right"])
    return {
        "success": right.double().mean().item(),
        "error": (right != whole["right"]).sum().item() ** 0.5 / count,
        "far_ok": (found["far"] & found["ok"]).double().mean().item(),
    }
