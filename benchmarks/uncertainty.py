"""What is told of uncertainty, and what is said of it: ``uncertainty.json`` and ``uncertainty.md`` beside it.

    python benchmarks/uncertainty.py --out benchmarks/uncertainty.json

*Errors.* The problems of uncertain PnP (Vakhitov et al., arXiv 2107.03890): points and pixels with noise of ten sizes
and random axes. A solver is told the covariances, the standard deviations of isotropic noise of the same trace, or
nothing; the solvers of other libraries take neither. Errors are medians, relative to those of maximum likelihood on the
true inliers with the covariances, started from the truth; all solve the same problems.

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
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from harness import in_turns, ratio, summary, target, threads
from kornia.geometry.liegroup import So3
from torch import Tensor, nn
from uncertain_problems import GRAVITY, SHIFT, TURN, gravity, last_pose, sigmas_of_same_trace, squares, uncertain_pnp

from kornia_pnpnet import PnPNet, PnPResult, RobustWeightedLM, create_solver, pose_covariance, pose_errors, success
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.files import write_json
from kornia_pnpnet.core.tables import markdown_table
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.bounds import KnownInliersAndNoise
from kornia_pnpnet.peers import OpenCVPnP, PeerSolver, PoseLib
from kornia_pnpnet.result import Pose, Problems

__all__ = [
    "main",
    "measure_credibility",
    "measure_errors",
    "measure_priors",
    "measure_squares",
    "measure_times",
    "page",
    "targets",
]

SOLVER = "pnpnet-set"
# Used for nothing else.
SEED = 20_270_925
AXIS_RATIO = 5.0
#: Of uncertain PnP: pairs of a problem, and shares of outliers.
SIZES, SHARES = (10, 30, 50, 110), (0.0, 0.3, 0.5)
# Pixels. The best of 8, 12, 16, 20, 25, 30 and 40 on problems of uncertain PnP of another seed.
THRESHOLD = 20.0
#: Solvers of other libraries. The first two take no outliers.
PEERS: dict[str, Callable[[], PeerSolver]] = {
    "EPnP": lambda: OpenCVPnP(method="EPNP"),
    "SQPnP": lambda: OpenCVPnP(method="SQPNP"),
    "PoseLib": lambda: PoseLib(threshold=THRESHOLD),
}
#: For covariances of poses and for priors: pairs of a problem, and how many of them are outliers.
CREDIBLE = ((9, 0), (9, 2), (9, 4), (20, 0), (20, 10), (50, 0), (50, 25), (200, 0), (200, 100))
FEW = ((3, 0), (4, 0), (4, 1), (5, 1), (6, 0), (6, 2), (9, 3), (12, 4))
#: Below this the squared error of six Gaussian numbers is in 95 % of all cases.
LIMIT = 12.592
#: Degrees between the normal of a planar target and the camera's axis.
TILTS = (0.0, 15.0, 30.0, 45.0, 60.0)
#: Standard deviations by which a wrong prior is off.
WRONG = 10.0
#: Of timed batches: pairs of a problem; problems; rounds.
TIMED, BATCH, ROUNDS = (9, 50), 1000, 15
#: Most that errors may be above those of maximum likelihood, without and with outliers; that covariances may cost.
MOST_CLEAN, MOST_ROBUST, MOST_TIME = 1.05, 1.10, 1.6


def medians(result: PnPResult, problems: Problems) -> Tensor:
    """Median rotation and translation error."""
    return torch.stack(list(pose_errors(result.pose, problems.pose))).median(1).values


@torch.no_grad()
def measure_errors(solver: nn.Module, count: int) -> list[dict[str, Any]]:
    """Median errors relative to those of maximum likelihood, of each kind of pixels, size and share of outliers."""
    bound = KnownInliersAndNoise()
    peers = {name: make() for name, make in PEERS.items()}
    rows = []
    for turned in (False, True):
        for n in SIZES:
            for share in SHARES:
                problems = uncertain_pnp(n, share, count, turned=turned, seed=SEED)
                answers = {
                    "covariances": solver(*problems[:3], **problems.known),
                    "sigmas": solver(*problems[:3], **sigmas_of_same_trace(problems)),
                    "nothing": solver(*problems[:3]),
                    **{name: peer(*problems[:3]) for name, peer in peers.items()},
                }
                best = medians(bound.solve_with_truth(problems), problems)
                row = {"pixels": "turned" if turned else "round", "n": n, "outliers": share, "bound": best.tolist()}
                relative = {name: (medians(x, problems) / best).tolist() for name, x in answers.items()}
                rows.append(row | relative)
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
    kinds = ("isotropic", 1.0, True), ("covariances", AXIS_RATIO, True), ("unknown", 1.0, False)
    for noise, axis_ratio, is_told in kinds:
        for n, outliers in CREDIBLE:
            problems = SyntheticProblems(
                n=n,
                batch_size=count,
                seed=SEED + 1,
                outliers=OutlierMix(count=outliers),
                axis_ratio=axis_ratio,
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
            problems = squares(tilt, sigma, count, seed=SEED + 3)

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
def measure_times(solver: nn.Module) -> list[dict[str, Any]]:
    """Processor time of a problem in float32 with standard deviations, and with covariances relative to that."""
    rows = []
    for n in TIMED:
        problems = SyntheticProblems(n=n, batch_size=BATCH, seed=SEED, axis_ratio=AXIS_RATIO, known_noise=1.0).batch(0)
        told: dict[str, dict[str, Any]] = {
            "sigmas": {"img_sigma": torch.full((BATCH,), 1.0), "world_sigma": torch.full((BATCH,), 0.05)},
            "covariances": problems.known,
        }

        def us_per_problem(problems: Problems, known: dict[str, Any]) -> float:
            start = time.process_time()
            solver(*problems[:3], **known)
            return 1e6 * (time.process_time() - start) / BATCH

        timers = {name: functools.partial(us_per_problem, problems, known) for name, known in told.items()}
        in_turns(timers, 2)  # to warm up
        times = {name: summary(rounds) for name, rounds in in_turns(timers, ROUNDS).items()}
        rows.append({"n": n, **times, "ratio": ratio(times["sigmas"], times["covariances"])})
    return rows


def targets(results: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The largest measurements beside what was wanted."""
    found = []
    for share in SHARES:
        worst = max(max(row["covariances"]) for row in results["rows"] if row["outliers"] == share)
        what = f"Largest relative error with {100 * share:.0f} % outliers"
        found.append(target(what, worst, MOST_ROBUST if share else MOST_CLEAN, unit="", at_most=True))
    slowest = max(row["ratio"] for row in results["times"])
    return [*found, target("Time with covariances by time with sigmas", slowest, MOST_TIME, unit="", at_most=True)]


def shares_of(rows: Sequence[Mapping[str, Any]], *keys: str) -> tuple[list[str], list[list[str]]]:
    """The columns of rows that are shares, without the keys that identify a row, and their cells."""
    columns = [key for key in rows[0] if key not in keys]
    return columns, [[f"{100 * row[column]:.1f} %" for column in columns] for row in rows]


def page(results: Mapping[str, Any]) -> str:
    """The page of the results."""
    wanted = [
        [x["what"], f"{x['measured']:.3f}", f"{x['target']:.2f}", "yes" if x["met"] else "no"]
        for x in results["targets"]
    ]
    columns = ("covariances", "sigmas", "nothing", *PEERS)
    errors = [
        [
            row["pixels"],
            f"{row['n']}",
            f"{100 * row['outliers']:.0f} %",
            *(" ".join(f"{x:.3g}" if x > 10 else f"{x:.3f}" for x in row[c]) for c in columns),
        ]
        for row in results["rows"]
    ]
    times = [
        [f"{row['n']}", *(f"{row[name]['median_us']:.1f}" for name in ("sigmas", "covariances")), f"{row['ratio']:.2f}"]
        for row in results["times"]
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
    kinds, successes = shares_of(results["priors"], "n", "outliers")
    priors = [
        [f"{row['n']}", f"{row['outliers']}", *cells] for row, cells in zip(results["priors"], successes, strict=True)
    ]
    found, right = shares_of(results["squares"], "tilt", "sigma")
    planar = [
        [f"{row['tilt']:.0f}°", f"{row['sigma']:.1f} px", *cells]
        for row, cells in zip(results["squares"], right, strict=True)
    ]
    return f"""# Uncertainty

Written by `benchmarks/uncertainty.py`, whose first lines say what is measured; `{results["solver"]}`,
{results["problems"]} problems in each row.

{markdown_table(["Target", "Measured", "At most", "Met"], wanted)}

## Noise that differs between pairs and directions

Median rotation and translation error on the problems of uncertain PnP, relative to maximum likelihood on the true
inliers. *Pixels*: whether their noise is round or has axes.

{markdown_table(["Pixels", "n", "Outliers", *columns], errors)}

Processor time of a problem in µs (float32, {BATCH} problems at once, one thread), and the median ratio of a round:

{markdown_table(["n", "sigmas", "covariances", "Ratio"], times, align="rrrr")}

## Is the covariance of the pose right

Mean squared error by the covariance (right: 6), and how often it is below the 95 % limit. The covariance knows the
noise; *unknown*: the solver did not.

{markdown_table(["Noise", "n", "Outliers", "Mean", "Below the limit", "Problems used"], credible)}

## What is known before

Success. Gravity is known to {GRAVITY}°, the last pose to {TURN}° and {100 * SHIFT:.0f} % of the distance; *wrong*: off
by {WRONG:.0f} standard deviations more.

{markdown_table(["n", "Outliers", *kinds], priors)}

## Planar targets

{markdown_table(["Tilt", "Noise", *found], planar)}
"""


def main() -> None:
    """Measure and write the file and its page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/bench/uncertainty.json"))
    parser.add_argument("--count", type=int, default=4000, help="problems of each noise and size (default: 4000)")
    arguments = parser.parse_args()
    solver = create_solver(SOLVER).double()
    with threads():
        results = {
            "environment": environment(),
            **{"solver": SOLVER, "seed": SEED, "axis_ratio": AXIS_RATIO, "problems": arguments.count},
            "times": measure_times(create_solver(SOLVER)),
            "rows": measure_errors(solver, arguments.count),
            "covariances": measure_credibility(solver, arguments.count),
            "priors": measure_priors(solver, arguments.count),
            "squares": measure_squares(solver, arguments.count),
        }
    results["targets"] = targets(results)
    write_json(arguments.out, results)
    text = page(results)
    arguments.out.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
