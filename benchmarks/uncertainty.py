"""What is told of uncertainty, and what is said of it: ``uncertainty.json`` and ``uncertainty.md`` beside it.

    python benchmarks/uncertainty.py --out benchmarks/uncertainty.json

*Errors.* The noise of each pixel and of each point has random axes, the largest five times as long as the smallest. A
solver is told the covariances, the standard deviations of isotropic noise of the same trace, or nothing. Errors are
medians, relative to those of maximum likelihood on the true inliers with the covariances, started from the truth; all
solve the same problems.

*Covariances of poses.* The squared error of a pose by its covariance (Mahalanobis) has the mean 6 and is below 12.59
for 95 % when the covariance is right. Poses that are not ``ok`` or far off (10 degrees or 30 % of the distance) are
left out.

*Planar targets.* A square of four points, 0.2 units wide, 1 to 2 units away, tilted against the camera's axis, noise
told: how often the pose, or the pose or one of two alternatives, is right (5 degrees and 5 degrees for each pixel of
noise, a tenth of the distance), beside the two poses of OpenCV's IPPE.

*Priors.* Success (1 degree, 0.2 units) with what is known of the pose: the direction of gravity or the last pose, right
or wrong by ten standard deviations more. The bound is least squares on the true inliers with the same prior, from the
truth.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from kornia.geometry.liegroup import So3
from torch import Tensor, nn

from kornia_pnpnet import (
    PnPNet,
    PnPResult,
    PosePrior,
    RobustWeightedLM,
    create_solver,
    gravity_prior,
    pose_covariance,
    pose_errors,
    success,
)
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.files import write_json
from kornia_pnpnet.core.tables import markdown_table
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.bounds import KnownInliersAndNoise
from kornia_pnpnet.geometry import retract, transform
from kornia_pnpnet.types import Pose, Problems

__all__ = [
    "main",
    "measure_credibility",
    "measure_errors",
    "measure_priors",
    "measure_squares",
    "measure_times",
    "page",
]

SOLVER = "pnpnet-set"
# Used for nothing else.
SEED = 20_261_250
AXIS_RATIO = 5.0
#: Pairs of a problem, and how many of them are outliers.
SIZES = ((9, 0), (20, 0), (50, 0), (20, 6), (50, 15), (50, 25))
#: Standard deviations of pixels and, in metres, of points; the last ones are exact.
NOISES = {"protocol": (1.0, 0.05), "mixed": (3.0, 0.01), "pixels": (5.0, 0.0)}
#: For covariances of poses and for priors: pairs of a problem, and how many of them are outliers.
CREDIBLE = ((9, 0), (9, 2), (9, 4), (20, 0), (20, 10), (50, 0), (50, 25), (200, 0), (200, 100))
FEW = ((3, 0), (4, 0), (4, 1), (5, 1), (6, 0), (6, 2), (9, 3), (12, 4))
#: Below this the squared error of six Gaussian numbers is in 95 % of all cases.
LIMIT = 12.592
#: Standard deviations in degrees of gravity and of the last rotation; of the last position, relative to the distance.
GRAVITY, TURN, SHIFT = 0.5, 1.0, 0.02
#: Degrees between the normal of a planar target and the camera's axis.
TILTS = (0.0, 15.0, 30.0, 45.0, 60.0)
#: Standard deviations by which a wrong prior is off.
WRONG = 10.0
# Of a timed batch, as in the table of throughput: problems, pairs, repeats.
TIMED = (500, 9, 41)


def told(problems: Problems, img_sigma: float, world_sigma: float) -> dict[str, dict[str, Any]]:
    """What a solver may be told of the noise."""
    sigmas = {"img_sigma": img_sigma, "world_sigma": world_sigma}
    return {"covariances": problems.known, "sigmas": sigmas, "nothing": {}}


def medians(result: PnPResult, problems: Problems) -> Tensor:
    """Median rotation and translation error."""
    return torch.stack(list(pose_errors(result.pose, problems.pose))).median(1).values


@torch.no_grad()
def measure_errors(solver: nn.Module, count: int) -> list[dict[str, Any]]:
    """Median errors relative to the bound, of each noise and size."""
    rows = []
    for noise, (img_sigma, world_sigma) in NOISES.items():
        bound = KnownInliersAndNoise(img_sigma=img_sigma, world_sigma=world_sigma)
        for n, outliers in SIZES:
            problems = SyntheticProblems(
                n=n,
                batch_size=count,
                seed=SEED,
                outliers=OutlierMix(count=outliers),
                axis_ratio=AXIS_RATIO,
                img_sigma=img_sigma,
                world_sigma=world_sigma,
                known_noise=1.0,
                dtype=torch.float64,
            ).batch(0)
            best = medians(bound.solve_with_truth(problems), problems)
            isotropic = bound.solve_with_truth(problems._replace(img_cov=None, world_cov=None))
            row: dict[str, Any] = {"noise": noise, "n": n, "outliers": outliers, "bound": best.tolist()}
            row["bound, sigmas"] = (medians(isotropic, problems) / best).tolist()
            for name, known in told(problems, img_sigma, world_sigma).items():
                row[name] = (medians(solver(*problems[:3], **known), problems) / best).tolist()
            rows.append(row)
    return rows


def squared_errors(result: PnPResult, problems: Problems, covariance: Tensor) -> Tensor:
    """Squared error of each pose by its covariance, (B,)."""
    turn = result.rotation @ problems.pose.rotation.mT
    trace = turn.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
    omega = 2.0 * So3.vee(turn - turn.mT) / (1.0 + trace)  # Cayley's rotation vector
    error = torch.cat((omega, result.translation - problems.pose.translation), -1)
    return (error * torch.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1)


@torch.no_grad()
def measure_credibility(solver: nn.Module, count: int) -> list[dict[str, Any]]:
    """How the errors of poses compare with their covariances, of each kind of noise and size."""
    rows = []
    for noise, ratio, is_told in (("isotropic", 1.0, True), ("covariances", AXIS_RATIO, True), ("unknown", 1.0, False)):
        for n, outliers in CREDIBLE:
            problems = SyntheticProblems(
                n=n,
                batch_size=count,
                seed=SEED + 1,
                outliers=OutlierMix(count=outliers),
                axis_ratio=ratio,
                known_noise=1.0,
                dtype=torch.float64,
            ).batch(0)
            known: dict[str, Any] = dict(problems.known)
            result = solver(*problems[:3], **(known if is_told else {}))
            covariance = pose_covariance(result.pose, *problems[:3], **known, weights=result.weights)
            errors, distance = pose_errors(result.pose, problems.pose), problems.pose.translation.norm(dim=-1)
            near = (errors.rotation_error_deg < 10.0) & (errors.translation_error < 0.3 * distance)
            used = result.ok & near & covariance.isfinite().all((1, 2))
            squared = squared_errors(result, problems, covariance)[used]
            row = {"noise": noise, "n": n, "outliers": outliers, "used": used.double().mean().item()}
            rows.append(row | {"mean": squared.mean().item(), "below": (squared < LIMIT).double().mean().item()})
    return rows


def last_pose(problems: Problems, generator: torch.Generator, wrong: float) -> PosePrior:
    """The pose of the frame before."""
    distance = problems.pose.translation.norm(dim=-1, keepdim=True)
    sigma = torch.cat((torch.full_like(distance, math.radians(TURN)).repeat(1, 3), SHIFT * distance.repeat(1, 3)), -1)
    noise, direction = torch.randn(2, *sigma.shape, generator=generator, dtype=sigma.dtype)
    error = sigma * (noise + wrong * nn.functional.normalize(direction, dim=-1))
    return PosePrior(retract(problems.pose, error), torch.diag_embed(sigma**-2))


def gravity(problems: Problems, generator: torch.Generator, wrong: float) -> PosePrior:
    """The direction of gravity, which is any direction in the world."""
    like, sigma = problems.pose.translation, math.radians(GRAVITY)
    down, noise, side = torch.randn(3, *like.shape, generator=generator, dtype=like.dtype)
    down = nn.functional.normalize(down, dim=-1)
    truth = (problems.pose.rotation @ down[..., None])[..., 0]
    across = nn.functional.normalize(torch.linalg.cross(truth, side), dim=-1)
    return gravity_prior(down, truth + torch.linalg.cross(sigma * (noise + wrong * across), truth), sigma)


@torch.no_grad()
def measure_priors(solver: nn.Module, count: int) -> list[dict[str, Any]]:
    """Success with and without priors, of each size, with the noise told."""
    least_squares = PnPNet(None, RobustWeightedLM(30, kernel="huber", robustness=1e4, learnable=False))
    sigmas = {"img_sigma": 1.0, "world_sigma": 0.05}
    rows = []
    for n, outliers in FEW:
        source = SyntheticProblems(
            n=n, batch_size=count, seed=SEED + 2, outliers=OutlierMix(count=outliers), dtype=torch.float64
        )
        problems, generator = source.batch(0), torch.Generator().manual_seed(SEED)
        priors = {
            "nothing": None,
            "gravity": gravity(problems, generator, 0.0),
            "gravity, wrong": gravity(problems, generator, WRONG),
            "last pose": last_pose(problems, generator, 0.0),
            "last pose, wrong": last_pose(problems, generator, WRONG),
        }
        row: dict[str, Any] = {"n": n, "outliers": outliers}
        inliers = problems.inliers.double()
        for name, prior in priors.items():
            answers = {name: solver(*problems[:3], **sigmas, prior=prior)}
            if "wrong" not in name:
                bound = least_squares(*problems[:3], inliers, init=problems.pose, **sigmas, prior=prior)
                answers[f"{name}, bound"] = bound
            for key, result in answers.items():
                row[key] = success(pose_errors(result.pose, problems.pose)).double().mean().item()
        rows.append(row)
    return rows


def square(tilt: float, sigma: float, count: int) -> Problems:
    """Squares of four points under a tilt in degrees, with noise of the pixels."""
    generator = torch.Generator().manual_seed(SEED + 3)
    azimuth, roll, x, y, z = torch.rand(5, count, generator=generator, dtype=torch.float64)
    azimuth, roll = 2.0 * math.pi * azimuth, 2.0 * math.pi * roll
    zero = torch.zeros_like(roll)
    axis = torch.stack((azimuth.cos(), azimuth.sin(), zero), -1) * math.radians(tilt)
    translation = torch.stack((0.4 * x - 0.2, 0.4 * y - 0.2, 1.0 + z), -1)
    turns = [Pose.from_rvec(v, translation).rotation for v in (axis, torch.stack((zero, zero, roll), -1))]
    front = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    pose = Pose(turns[0] @ turns[1] @ front, translation)
    corners = [[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]]
    world = torch.tensor(corners, dtype=torch.float64).expand(count, 4, 3)
    camera = torch.tensor([[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    seen = transform(pose, world) @ camera.mT
    pixels = seen[..., :2] / seen[..., 2:]
    pixels = pixels + sigma * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    return Problems(world, pixels, camera.expand(count, 3, 3), pose, torch.ones(count, 4, dtype=torch.bool))


def ippe(problems: Problems) -> Pose:
    """OpenCV's two poses of each problem, (B, 2, 3, 3) and (B, 2, 3)."""
    import cv2

    found = []
    for world, img, camera in zip(*(x.numpy() for x in problems[:3]), strict=True):
        _, turns, shifts, _ = cv2.solvePnPGeneric(world, img[:, None], camera, None, flags=cv2.SOLVEPNP_IPPE)
        both = [(torch.from_numpy(turns[i % len(turns)]), torch.from_numpy(shifts[i % len(turns)])) for i in (0, 1)]
        found.append([torch.cat((turn, shift))[:, 0] for turn, shift in both])
    rows = torch.stack([torch.stack(pair) for pair in found])
    pose = Pose.from_rvec(rows[..., :3].flatten(0, 1), rows[..., 3:].flatten(0, 1))
    return Pose(pose.rotation.unflatten(0, (-1, 2)), pose.translation.unflatten(0, (-1, 2)))


@torch.no_grad()
def measure_squares(solver: nn.Module, count: int) -> list[dict[str, Any]]:
    """How often the right pose of a planar target is the pose, or among the alternatives."""
    rows = []
    for tilt in TILTS:
        for sigma in (0.5, 1.0, 3.0):
            problems = square(tilt, sigma, count)

            def right(
                rotation: Tensor, translation: Tensor, truth: Pose = problems.pose, sigma: float = sigma
            ) -> Tensor:
                errors, distance = pose_errors(Pose(rotation, translation), truth), truth.translation.norm(dim=-1)
                return (errors.rotation_error_deg < 5.0 + 5.0 * sigma) & (errors.translation_error < 0.1 * distance)

            result = solver(*problems[:3], img_sigma=sigma, world_sigma=0.0, alternatives=2)
            others, theirs = result.alternatives, ippe(problems)
            first, any_right = (right(result.rotation, result.translation) for _ in range(2))
            for i in (0, 1):
                any_right |= others.valid[:, i] & right(others.rotation[:, i], others.translation[:, i])
            of_theirs = [right(theirs.rotation[:, i], theirs.translation[:, i]) for i in (0, 1)]
            shares = {
                "pose": first,
                "pose or alternatives": any_right,
                "IPPE's first": of_theirs[0],
                "IPPE's two": of_theirs[0] | of_theirs[1],
                "problems with alternatives": others.valid.any(1),
            }
            row: dict[str, Any] = {"tilt": tilt, "sigma": sigma}
            rows.append(row | {name: share.double().mean().item() for name, share in shares.items()})
    return rows


@torch.no_grad()
def measure_times(solver: nn.Module) -> dict[str, float]:
    """Processor time of a problem in µs in float32, medians; what is told takes turns."""
    batch, n, repeats = TIMED
    source = SyntheticProblems(n=n, batch_size=batch, seed=SEED, axis_ratio=AXIS_RATIO, known_noise=1.0)
    problems = source.batch(0)
    kinds = told(problems, 1.0, 0.05)
    seconds: Mapping[str, list[float]] = {name: [] for name in kinds}
    for _ in range(repeats):
        for name, known in kinds.items():
            start = time.process_time()
            solver(*problems[:3], **known)
            seconds[name].append(time.process_time() - start)
    return {name: 1e6 * statistics.median(values[1:]) / batch for name, values in seconds.items()}


def page(results: Mapping[str, Any]) -> str:
    """The page of the results."""
    columns = ("covariances", "sigmas", "nothing", "bound, sigmas")
    errors = [
        [row["noise"], f"{row['n']}", f"{row['outliers']}", *(" ".join(f"{x:.3f}" for x in row[c]) for c in columns)]
        for row in results["rows"]
    ]
    credible = [
        [
            row["noise"],
            f"{row['n']}",
            f"{row['outliers']}",
            f"{row['mean']:.2f}",
            f"{100 * row['below']:.1f} %",
            f"{100 * row['used']:.1f} %",
        ]
        for row in results["covariances"]
    ]
    kinds = [key for key in results["priors"][0] if key not in ("n", "outliers")]
    priors = [
        [f"{row['n']}", f"{row['outliers']}", *(f"{100 * row[kind]:.1f} %" for kind in kinds)]
        for row in results["priors"]
    ]
    found = [key for key in results["squares"][0] if key not in ("tilt", "sigma")]
    squares = [
        [f"{row['tilt']:.0f}°", f"{row['sigma']:.1f} px", *(f"{100 * row[kind]:.1f} %" for kind in found)]
        for row in results["squares"]
    ]
    times = ", ".join(f"{name} {value:.1f}" for name, value in results["us_per_problem"].items())
    return f"""# Uncertainty

Written by `benchmarks/uncertainty.py`, whose first lines say what is measured; `{results["solver"]}`,
{results["problems"]} problems in each row.

## Noise that differs between directions

Median rotation and translation error, relative to maximum likelihood on the true inliers. *Bound, sigmas*: the same
with isotropic noise of the same trace.

{markdown_table(["Noise", "n", "Outliers", *columns], errors)}

Processor time of a problem in µs by what is told: {times}.

## Is the covariance of the pose right

Mean squared error by the covariance (right: 6), and how often it is below the 95 % limit. The covariance knows the
noise; *unknown*: the solver did not.

{markdown_table(["Noise", "n", "Outliers", "Mean", "Below the limit", "Problems used"], credible)}

## What is known before

Success. Gravity is known to {GRAVITY}°, the last pose to {TURN}° and {100 * SHIFT:.0f} % of the distance; *wrong*: off
by {WRONG:.0f} standard deviations more.

{markdown_table(["n", "Outliers", *kinds], priors)}

## Planar targets

{markdown_table(["Tilt", "Noise", *found], squares)}
"""


def main() -> None:
    """Measure and write the file and its page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/bench/uncertainty.json"))
    parser.add_argument("--count", type=int, default=4000, help="problems of each noise and size (default: 4000)")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    solver = create_solver(SOLVER).double()
    results = {
        "environment": environment(),
        **{"solver": SOLVER, "seed": SEED, "axis_ratio": AXIS_RATIO, "problems": arguments.count, "noises": NOISES},
        "us_per_problem": measure_times(create_solver(SOLVER)),
        "rows": measure_errors(solver, arguments.count),
        "covariances": measure_credibility(solver, arguments.count),
        "priors": measure_priors(solver, arguments.count),
        "squares": measure_squares(solver, arguments.count),
    }
    write_json(arguments.out, results)
    text = page(results)
    arguments.out.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
