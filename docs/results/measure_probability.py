"""Fit the law of ``PnPResult.probability``, see ``kornia_pnpnet.judge.belief``. ``make.py`` is the command.

The coefficients go from ``probability.json`` into the code by hand; a test compares them.
"""

from __future__ import annotations

import math
from itertools import product
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf
from sklearn.linear_model import LogisticRegression
from torch import Tensor

from kornia_pnpnet import solver as solver_module
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.judge import belief
from kornia_pnpnet.metrics import pose_errors, reliability, success_rate
from kornia_pnpnet.refine.information import larger_sigma
from kornia_pnpnet.result import PnPResult, Problems

#: By law the solvers that it is fitted to.
FITTED = {"sigmas": ("pnpnet-set:effort=fixed", "pnpnet-set:effort=adaptive"), "residuals": ("p3p-ransac",)}


@torch.no_grad()
def measure_probability(seed_fit: int, seed_report: int) -> dict[str, Any]:
    """Fit the law on problems of one seed, and measure it on those of another.

    Most problems are like real matches (``conf/data/matches.yaml``), of 5 to 250 pairs; others are the protocol's.
    Returns the laws, and by solver the share of right and of far-off poses that are ``ok``, and the reliability.
    """
    conf = str(Path(__file__).resolve().parents[2] / "conf")
    with initialize_config_dir(conf, version_base=None):
        config = compose("train", overrides=["experiment=set"]).data.validation
    matches: Any = OmegaConf.to_container(config.matches_50, resolve=True)
    protocol: Any = OmegaConf.to_container(config.uniform, resolve=True)
    sizes = [(matches, n) for n in (5, 6, 7, 9, 12, 24, 50, 120, 250)] + [(protocol, n) for n in (6, 9, 20)]
    solvers = {name: load_solver(name) for names in FITTED.values() for name in names}
    found: dict[str, dict[str, list[Tensor]]] = {name: {"fit": [], "report": []} for name in solvers}
    law, features = belief.probability, []

    def listen(alarms: Tensor, sigma: Tensor, name: str) -> Tensor:
        features.append(torch.stack(belief.clipped(alarms, sigma), -1))
        return law(alarms, sigma, name)

    for (part, seed), (source, n) in product((("fit", seed_fit), ("report", seed_report)), sizes):
        drawn = {**source, "n": n, "batch_size": 3000 if n < 100 else 1000, "seed": seed + n}
        problems = instantiate(drawn, _convert_="all").batch(0)
        for name, solver in solvers.items():
            features.clear()
            # While the law is fitted, nothing is solved once more, so that each problem has one row.
            larger = larger_sigma if part == "report" else lambda x, *_: x.new_zeros(x.shape[:2])
            with (
                mock.patch.object(belief, "probability", listen),
                mock.patch.object(solver_module, "larger_sigma", larger),
            ):
                result = solver(problems.world_points, problems.img_points, problems.intrinsics)
            far, right = far_and_right(result, problems)
            columns = far, right, result.ok, result.probability, torch.full_like(result.probability, 1 / len(far))
            seen = torch.cat(features) if part == "fit" else torch.zeros(len(far), 2)
            found[name][part].append(torch.cat((seen, torch.stack(columns, -1)), -1).double())
    tables = {name: {part: torch.cat(rows) for part, rows in parts.items()} for name, parts in found.items()}
    laws = {law: fit_law(torch.cat([tables[name]["fit"] for name in names])) for law, names in FITTED.items()}
    made: dict[str, Any] = {"environment": environment(), "laws": laws}
    for name, parts in tables.items():
        _, _, far, right, ok, chance, _ = parts["report"].unbind(-1)
        curve = reliability(chance, far == 0)._asdict()
        rates = {"ok_of_right": ok[right > 0], "ok_of_far": ok[far > 0]}
        made[name] = {key: success_rate(values > 0)._asdict() for key, values in rates.items()}
        made[name]["reliability"] = {key: values.nan_to_num(0.0).tolist() for key, values in curve.items()}
    return made


def far_and_right(result: PnPResult, problems: Problems) -> tuple[Tensor, Tensor]:
    """Which poses are far off, and which are right, by rotation and by the camera's centre."""
    angle = pose_errors(result.pose, problems.pose).rotation_error_deg
    depth = problems.true_cam_points[..., 2].median(1).values
    centres = [-(pose.rotation.mT @ pose.translation[..., None])[..., 0] for pose in (result.pose, problems.pose)]
    distance = (centres[0] - centres[1]).norm(dim=-1) / depth
    return (angle > 10) | (distance > 0.3), (angle < 1) & (distance < 0.02)


def fit_law(rows: Tensor) -> list[float]:
    """Logistic regression of "not far off" on the two features; every data set counts the same."""
    features, target, weight = (x.numpy() for x in (rows[:, :2], 1 - rows[:, 2], rows[:, -1]))
    law = LogisticRegression(C=math.inf, tol=1e-8, max_iter=1000).fit(features, target, sample_weight=weight)
    return [float(f"{x:.5g}") for x in (*law.intercept_, *law.coef_[0])]
