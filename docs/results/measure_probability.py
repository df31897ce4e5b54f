"""Fit the law of ``PnPResult.probability``, see ``kornia_pnpnet.judge.evidence``. ``make.py`` is the command.

The coefficients go from ``probability.json`` into the code by hand; a test compares them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import torch
from doubtful import INTRINSICS, doubtful
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from kornia.geometry.linalg import transform_points
from omegaconf import OmegaConf
from sklearn.linear_model import LogisticRegression
from torch import Tensor

from kornia_pnpnet import PnPNet, Pose, Problems
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.judge import evidence
from kornia_pnpnet.metrics import pose_errors, reliability, success_rate

#: The solvers of the fit, and other solvers that are only measured.
FITTED, MEASURED = ("pnpnet-set", "p3p-ransac"), ("pnpnet-set:effort=fixed", "epnp-lm", "reppnp-lm")
#: Kinds of problems that the fit leaves out. A test of the noise or of the points decides about them.
LEFT_OUT = ("y up", "left-handed", "row and column", "line", "3 pairs")
PROBLEMS = 500
ARGUMENTS = ("world_points", "img_points", "intrinsics")


@torch.no_grad()
def measure_probability(seed_fit: int, seed_report: int) -> dict[str, Any]:
    """Fit the law on problems of one seed, and measure it on those of another.

    The problems are like real matches (``conf/data/matches.yaml``), of 5 to 150 pairs, those of the protocol, and those
    of ``doubtful.py``. Returns the law, and by solver and kind the share of right and of far-off poses that are ``ok``,
    and the reliability.
    """
    law = fit_law([solved(name, kind) for name in FITTED for kind in kinds(seed_fit) if in_fit(kind)])
    made: dict[str, Any] = {"environment": environment(), "law": law}
    with mock.patch.object(evidence, "LAW", law):
        for name in (*FITTED, *MEASURED):
            rows = {kind.name: (in_fit(kind), solved(name, kind)) for kind in kinds(seed_report)}
            fitted = [row for used, row in rows.values() if used]
            chance, near = (torch.cat([row[key] for row in fitted]) for key in ("probability", "near"))
            curve = reliability(chance, near)._asdict()
            made[name] = {
                "kinds": {kind: rates(row) for kind, (_, row) in rows.items()},
                "reliability": {key: values.nan_to_num(0.0).tolist() for key, values in curve.items()},
            }
    return made


def in_fit(kind: Drawn) -> bool:
    """Whether a kind belongs to the fit."""
    return not any(x in kind.name for x in LEFT_OUT)


class Drawn(NamedTuple):
    """Problems of one kind, and the usual distance of their points from the camera, (B,)."""

    name: str
    inputs: dict[str, Any]
    truth: Pose | None
    distance: Tensor

    @classmethod
    def of(cls, name: str, problems: Problems) -> Drawn:
        """Problems of a source."""
        inputs = dict(zip(ARGUMENTS, problems[:3], strict=True))
        return cls(name, inputs, problems.pose, problems.true_cam_points[..., 2].median(1).values)


def kinds(seed: int) -> Iterator[Drawn]:
    """Every kind of problems."""
    conf = str(Path(__file__).resolve().parents[2] / "conf")
    with initialize_config_dir(conf, version_base=None):
        config = compose("train", overrides=["experiment=set"]).data.validation
    for source, sizes in (("matches_50", (5, 6, 7, 9, 12, 20, 50, 150)), ("uniform", (5, 6, 9, 20, 50))):
        options: Any = OmegaConf.to_container(config[source], resolve=True)
        for n in sizes:
            drawn = {**options, "n": n, "batch_size": PROBLEMS, "seed": seed + n}
            yield Drawn.of(f"{source.split('_')[0]}, {n} pairs", instantiate(drawn, _convert_="all").batch(0))
    for kind in doubtful(PROBLEMS, seed):
        distance = torch.ones(PROBLEMS)
        if kind.truth is not None:
            distance = transform_points(kind.truth.matrix, kind.world_points)[..., 2].median(1).values
        inputs = dict(zip(ARGUMENTS, (kind.world_points, kind.img_points, INTRINSICS), strict=True))
        yield Drawn(kind.name, {**inputs, **kind.given}, kind.truth, distance)


def solved(name: str, kind: Drawn) -> dict[str, Tensor]:
    """Solve problems: the variables of the law, the probability, ``ok``, and which poses are near and right."""
    solver, seen = load_solver(name), []
    original = PnPNet._result

    def listen(self: PnPNet, focal: Tensor, frame: Any, starts: Any, refined: Any, call: Any) -> Any:
        seen.append((refined.evidence.log_ratio, refined.sigma, refined.probability))
        return original(self, focal, frame, starts, refined, call)

    with mock.patch.object(PnPNet, "_result", listen):
        result = solver(**kind.inputs)
    log_ratio, sigma, probability = (torch.cat(x) for x in zip(*seen, strict=True))
    near = right = torch.zeros_like(result.ok)
    if kind.truth is not None:
        turn, shift = errors(result.pose, kind.truth)
        shift = shift / kind.distance
        near, right = (turn <= 10) & (shift <= 0.3), (turn < 2) & (shift < 0.05)
    variables = torch.stack(evidence.clipped(log_ratio, sigma), -1).double()
    # A rival multiplies the probability of the law. The fit leaves out poses that fail a test, and poses with a rival.
    alone = probability >= 0.99 * evidence.probability(log_ratio, sigma)
    found = {"ok": result.ok, "probability": result.probability, "near": near, "right": right}
    return {**found, "variables": variables, "alone": alone & (probability > 0)}


def errors(pose: Pose, truth: Pose) -> tuple[Tensor, Tensor]:
    """Angles of the rotations in degrees, and distances of the camera centres."""
    centres = [-(x.rotation.mT @ x.translation[..., None])[..., 0] for x in (pose, truth)]
    return pose_errors(pose, truth).rotation_error_deg, (centres[0] - centres[1]).norm(dim=-1)


def rates(row: dict[str, Tensor]) -> dict[str, Any]:
    """Shares of the right poses and of the far-off poses that are ``ok``."""
    poses = {"ok_of_right": row["ok"][row["right"]], "ok_of_far": row["ok"][~row["near"]]}
    return {key: success_rate(values)._asdict() for key, values in poses.items() if len(values)}


def fit_law(rows: list[dict[str, Tensor]]) -> list[float]:
    """Logistic regression of "near" on the two variables; every kind counts the same."""
    chosen = [row["alone"] for row in rows]
    variables, near = (
        torch.cat([row[key][x] for row, x in zip(rows, chosen, strict=True)]) for key in ("variables", "near")
    )
    weight = torch.cat([torch.full((int(x.sum()),), 1.0 / len(x)) for x in chosen])
    law = LogisticRegression(C=math.inf, tol=1e-8, max_iter=1000).fit(variables.numpy(), near.numpy(), weight.numpy())
    return [float(f"{x:.4g}") for x in (*law.intercept_, *law.coef_[0])]
