"""Solvers that know the noise, and the noise that solvers report: ``uncertainty.json`` and ``uncertainty.md``.

    python benchmarks/uncertainty.py --out benchmarks/uncertainty.json

The page says what is measured.
"""

import itertools
import math
import time
from functools import partial
from pathlib import Path
from typing import Any

import harness
import numpy as np
import torch
from harness import share
from torch import Tensor, nn

from kornia_pnpnet import PnPNet, PosePrior, RobustWeightedLM, create_solver, gravity_prior, pose_covariance
from kornia_pnpnet.cameras import reproject
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.data.points import BoxPoints
from kornia_pnpnet.evaluation.bounds import KnownInliersAndNoise
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.metrics import pose_errors, success
from kornia_pnpnet.refine.residual import retract, tangent
from kornia_pnpnet.result import PnPResult, Pose, Problems

SOLVER = "pnpnet-set"
# Used for nothing else.
SEED = 20_270_925
AXIS_RATIO = 5.0
#: Of uncertain PnP: pairs of a problem, and shares of outliers.
SIZES, SHARES = (10, 30, 50, 110), (0.0, 0.3, 0.5)
# Threshold of PoseLib in pixels, the best of 8, 12, 16, 20, 25, 30 and 40 on problems of another seed.
THRESHOLD = 20.0
#: Solvers of other libraries. The first two take no outliers.
PEERS = {"EPnP": "opencv-epnp", "SQPnP": "opencv-sqpnp", "PoseLib": f"poselib:threshold={THRESHOLD:g}"}
#: For covariances of poses and for priors: number of pairs, and number of outliers among them.
CREDIBLE = ((9, 0), (9, 2), (9, 4), (20, 0), (20, 10), (50, 0), (50, 25), (200, 0), (200, 100))
FEW = ((3, 0), (4, 0), (4, 1), (5, 1), (6, 0), (6, 2), (9, 3), (12, 4))
#: Standard deviations in degrees of gravity and of the last rotation; of the last position, relative to the distance.
GRAVITY, TURN, SHIFT = 0.5, 1.0, 0.02
# Grades of noise in uncertain PnP; standard deviations of grade 1 in pixels and in the unit of the world.
_GRADES, _PIXEL, _POINT = 10, 1.0, 0.01
#: 95 % quantile of the chi-square distribution with 6 degrees of freedom.
LIMIT = 12.592
#: Degrees between the normal of a planar target and the camera's axis.
TILTS = (0.0, 15.0, 30.0, 45.0, 60.0)
#: Additional error of a wrong prior, in standard deviations.
WRONG = 10.0
#: Of timed batches: pairs of a problem; problems; rounds.
TIMED, BATCH, ROUNDS = (9, 50), 1000, 15


def uncertain_pnp(n: int, share: float, count: int, *, turned: bool, seed: int) -> Problems:
    """Problems of the protocol of uncertain PnP (Vakhitov et al., CVPR 2021, arXiv 2107.03890, section 4.1).

    Points lie in a box in front of a camera of 800 px; their centre is the origin of the world. Pairs have grades 1, 2,
    ..., 10 in turn. The grade is the standard deviation along the longest axis, in pixels and in hundredths of a unit.
    The standard deviations of the other axes are uniform between 0 and that of the longest; the axes have random
    directions. Half of the outliers are mismatches, half have a random pixel. The noise of pixels has axes if
    ``turned``, and is isotropic otherwise, as in most of the protocol.
    """
    options: dict[str, Any] = {"batch_size": count, "seed": seed, "dtype": torch.float64, "max_angle": math.pi}
    exact = SyntheticProblems(
        n=n,
        **{"focal": 800.0, "half_image": 400.0, "img_sigma": 0.0, "world_sigma": 0.0, **options},
        points=BoxPoints(half_width=2.0, z_near=4.0, depth=4.0),
        outliers=OutlierMix(count=round(share * n)),
    ).batch(0)
    rotation, translation = exact.pose
    middle = exact.world_points.mean(1, keepdim=True)
    generator = torch.Generator().manual_seed(seed)
    grade = 1.0 + torch.arange(n, dtype=torch.float64).remainder(_GRADES).expand(count, n)
    img_noise, img_cov = _noise(_PIXEL * grade, 2, generator, turned=turned)
    world_noise, world_cov = _noise(_POINT * grade, 3, generator, turned=True)
    return exact._replace(
        world_points=exact.world_points - middle + world_noise,
        img_points=exact.img_points + img_noise,
        pose=Pose(rotation, translation + (middle @ rotation.mT)[:, 0]),
        img_cov=img_cov,
        world_cov=world_cov,
    )


def _noise(sigma: Tensor, size: int, generator: torch.Generator, *, turned: bool) -> tuple[Tensor, Tensor]:
    """Noise (B, N, D) with the standard deviation of the longest axis, (B, N), and its covariance."""
    ratio = torch.rand(*sigma.shape, size, generator=generator, dtype=sigma.dtype)
    ratio[..., 0] = 1.0
    axes = sigma[..., None] * (ratio if turned else torch.ones_like(ratio))
    normal = torch.randn(*sigma.shape, size, size + 1, generator=generator, dtype=sigma.dtype)
    factor = torch.linalg.qr(normal[..., :size]).Q * axes[..., None, :]
    return (factor @ normal[..., size:])[..., 0], factor @ factor.mT


def last_pose(problems: Problems, generator: torch.Generator, wrong: float) -> PosePrior:
    """The pose of the frame before, with ``wrong`` additional standard deviations of error."""
    distance = problems.pose.translation.norm(dim=-1, keepdim=True)
    sigma = torch.cat((torch.full_like(distance, math.radians(TURN)).repeat(1, 3), SHIFT * distance.repeat(1, 3)), -1)
    noise, direction = torch.randn(2, *sigma.shape, generator=generator, dtype=sigma.dtype)
    error = sigma * (noise + wrong * nn.functional.normalize(direction, dim=-1))
    return PosePrior(retract(problems.pose, error), torch.diag_embed(sigma**-2))


def gravity(problems: Problems, generator: torch.Generator, wrong: float) -> PosePrior:
    """The direction of gravity, which is any direction in the world. For ``wrong`` see :func:`last_pose`."""
    like, sigma = problems.pose.translation, math.radians(GRAVITY)
    down, noise, side = torch.randn(3, *like.shape, generator=generator, dtype=like.dtype)
    down = nn.functional.normalize(down, dim=-1)
    truth = (problems.pose.rotation @ down[..., None])[..., 0]
    across = nn.functional.normalize(torch.linalg.cross(truth, side), dim=-1)
    return gravity_prior(down, truth + torch.linalg.cross(sigma * (noise + wrong * across), truth), sigma)


def squares(tilt: float, sigma: float, count: int, *, seed: int) -> Problems:
    """Squares of four points under a tilt in degrees, with noise of the pixels."""
    generator = torch.Generator().manual_seed(seed)
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
    pixels = reproject(world, camera, pose)
    pixels = pixels + sigma * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    return Problems(world, pixels, camera.expand(count, 3, 3), pose, torch.ones(count, 4, dtype=torch.bool))


def draw(n: int, outliers: int, count: int, seed: int, **options: Any) -> Problems:
    """Problems of the protocol's data in float64."""
    mix = OutlierMix(count=outliers)
    options = {"batch_size": count, "seed": SEED + seed, "outliers": mix, "dtype": torch.float64, **options}
    return SyntheticProblems(n=n, **options).batch(0)


def medians(result: PnPResult, problems: Problems) -> Tensor:
    """Median rotation and translation error."""
    return torch.stack(list(pose_errors(result.pose, problems.pose))).median(1).values


@torch.no_grad()
def measure_errors(solver: nn.Module, count: int) -> list[dict[str, Any]]:
    """Median errors relative to those of maximum likelihood, of each kind of pixels, size and share of outliers."""
    bound = KnownInliersAndNoise()
    peers = {name: load_solver(spec) for name, spec in PEERS.items()}
    rows = []
    for turned, n, outliers in itertools.product((False, True), SIZES, SHARES):
        problems = uncertain_pnp(n, outliers, count, turned=turned, seed=SEED)
        covariances: dict[str, Any] = {"img": problems.img_cov, "world": problems.world_cov}
        of_same_trace = {f"{k}_sigma": x.diagonal(dim1=-2, dim2=-1).mean(-1).sqrt() for k, x in covariances.items()}
        answers = {
            "covariances": solver(*problems[:3], **problems.known),
            "sigmas": solver(*problems[:3], **of_same_trace),
            "nothing": solver(*problems[:3]),
            **{name: peer(*problems[:3]) for name, peer in peers.items()},
        }
        best = medians(bound.solve_with_truth(problems), problems)
        row = {"pixels": "turned" if turned else "round", "n": n, "outliers": outliers, "bound": best.tolist()}
        rows.append(row | {name: (medians(x, problems) / best).tolist() for name, x in answers.items()})
    return rows


@torch.no_grad()
def measure_credibility(solver: nn.Module, count: int) -> list[dict[str, Any]]:
    """Compare the errors of poses with their covariances, for each kind of noise and number of pairs."""
    rows = []
    kinds = ("isotropic", 1.0, True), ("covariances", AXIS_RATIO, True), ("unknown", 1.0, False)
    for (noise, axis_ratio, is_known), (n, outliers) in itertools.product(kinds, CREDIBLE):
        problems = draw(n, outliers, count, 1, axis_ratio=axis_ratio, known_noise=1.0)
        known: dict[str, Any] = dict(problems.known)
        result = solver(*problems[:3], **(known if is_known else {}))
        covariance = pose_covariance(result.pose, *problems[:3], **known, weights=result.weights)
        errors, distance = pose_errors(result.pose, problems.pose), problems.pose.translation.norm(dim=-1)
        near = (errors.rotation_error_deg < 10.0) & (errors.translation_error < 0.3 * distance)
        used = result.ok & near & covariance.isfinite().all((1, 2))
        turn, shift = result.rotation @ problems.pose.rotation.mT, result.translation - problems.pose.translation
        error = torch.cat((tangent(turn), shift), -1)
        squared = (error * torch.linalg.solve(covariance, error)).sum(-1)[used]
        row = {"noise": noise, "n": n, "outliers": outliers, "used": share(used)}
        rows.append(row | {"mean": squared.mean().item(), "below": share(squared < LIMIT)})
    return rows


@torch.no_grad()
def measure_priors(solver: nn.Module, count: int) -> list[dict[str, Any]]:
    """Success with and without priors, of each size, with known noise."""
    bound = PnPNet(None, RobustWeightedLM(30, kernel="huber", robustness=1e4, learnable=False))
    sigmas = {"img_sigma": 1.0, "world_sigma": 0.05}
    rows = []
    for n, outliers in FEW:
        problems, generator = draw(n, outliers, count, 2), torch.Generator().manual_seed(SEED)
        priors: dict[str, PosePrior | None] = {"nothing": None}
        makers = {"gravity": gravity, "last pose": last_pose}
        for (name, make), wrong in itertools.product(makers.items(), (0.0, WRONG)):
            priors[f"{name}, wrong" if wrong else name] = make(problems, generator, wrong)
        row: dict[str, Any] = {"n": n, "outliers": outliers}
        for name, prior in priors.items():
            known: dict[str, Any] = {**sigmas, "prior": prior}
            results = {name: solver(*problems[:3], **known)}
            if "wrong" not in name:
                results[f"{name}, bound"] = bound(*problems[:3], problems.inliers.double(), **known, init=problems.pose)
            row |= {key: share(success(pose_errors(x.pose, problems.pose))) for key, x in results.items()}
        rows.append(row)
    return rows


def ippe(problems: Problems) -> Pose:
    """OpenCV's two poses of each problem, (B, 2, 3, 3) and (B, 2, 3); the only pose twice where there is one."""
    import cv2

    found = []
    for world, img, camera in zip(*(x.numpy() for x in problems[:3]), strict=True):
        _, turns, shifts, _ = cv2.solvePnPGeneric(world, img[:, None], camera, None, flags=cv2.SOLVEPNP_IPPE)
        found.append([(turns[i][:, 0], shifts[i][:, 0]) for i in (0, -1)])
    turn, shift = torch.from_numpy(np.array(found)).unbind(2)  # (B, 2, 3) each
    pose = Pose.from_rvec(turn.flatten(0, 1), shift.flatten(0, 1))
    return Pose(*(x.unflatten(0, (-1, 2)) for x in pose))


def close(rotation: Tensor, translation: Tensor, problems: Problems, sigma: float) -> Tensor:
    """Which of several poses of each planar target are right, (B, K)."""
    most = 0.1 * problems.pose.translation.norm(dim=-1)
    poses = (Pose(*x) for x in zip(rotation.unbind(1), translation.unbind(1), strict=True))
    return torch.stack([success(pose_errors(pose, problems.pose), 5.0 + 5.0 * sigma, most) for pose in poses], 1)


@torch.no_grad()
def measure_squares(solver: nn.Module, count: int) -> list[dict[str, Any]]:
    """How often the right pose of a planar target is the pose, or among the alternatives."""
    rows = []
    for tilt, sigma in itertools.product(TILTS, (0.5, 1.0, 3.0)):
        problems = squares(tilt, sigma, count, seed=SEED + 3)
        result = solver(*problems[:3], img_sigma=sigma, world_sigma=0.0, alternatives=2)
        found = result.alternatives
        first = close(result.rotation[:, None], result.translation[:, None], problems, sigma)[:, 0]
        others = found.valid & close(found.rotation, found.translation, problems, sigma)
        theirs = close(*ippe(problems), problems, sigma)
        shares = {
            "pose": first,
            "pose or alternatives": first | others.any(1),
            "IPPE's first": theirs[:, 0],
            "IPPE's two": theirs.any(1),
            "problems with alternatives": found.valid.any(1),
        }
        rows.append({"tilt": tilt, "sigma": sigma, **{name: share(x) for name, x in shares.items()}})
    return rows


@torch.no_grad()
def measure_times(solver: nn.Module) -> list[dict[str, Any]]:
    """Processor time of a problem in float32 with standard deviations, and with covariances relative to that."""
    rows = []
    for n in TIMED:
        problems = SyntheticProblems(n=n, batch_size=BATCH, seed=SEED, axis_ratio=AXIS_RATIO, known_noise=1.0).batch(0)
        given: dict[str, Any] = {
            "sigmas": {"img_sigma": torch.full((BATCH,), 1.0), "world_sigma": torch.full((BATCH,), 0.05)},
            "covariances": problems.known,
        }
        calls = {name: partial(solver, *problems[:3], **known) for name, known in given.items()}
        timers = {name: partial(harness.seconds, call, clock=time.process_time) for name, call in calls.items()}
        harness.in_turns(timers, 2)  # to warm up
        rounds = harness.in_turns(timers, ROUNDS)
        times = {name: harness.summary([1e6 * x / BATCH for x in seconds]) for name, seconds in rounds.items()}
        ratios = np.divide(rounds["covariances"], rounds["sigmas"])  # of the same rounds
        rows.append({"n": n, **times, "ratio": float(np.median(ratios))})
    return rows


def page(results: harness.Row) -> str:
    """The page of the results."""
    answers = ("covariances", "sigmas", "nothing", *PEERS)
    losses = sum(row["PoseLib"][0] < row["nothing"][0] for row in results["rows"] if "PoseLib" in row)
    facts = {"losses": losses, "batch": BATCH, "gravity": GRAVITY, "turn": TURN, "shift": SHIFT, "wrong": WRONG}
    return harness.render("uncertainty.md.jinja", results=results, answers=answers, **facts)


def main() -> None:
    """Measure and write the file and its page."""
    command = harness.parser(__doc__, Path("outputs/bench/uncertainty.json"))
    command.add_argument("--count", type=int, default=4000, help="problems of each noise and size (default: 4000)")
    options = command.parse_args()
    solver = create_solver(SOLVER).double()

    parts = {"rows": measure_errors, "covariances": measure_credibility}
    parts |= {"priors": measure_priors, "squares": measure_squares}

    def measure() -> dict[str, Any]:
        times = measure_times(create_solver(SOLVER))
        return {"times": times, **{name: part(solver, options.count) for name, part in parts.items()}}

    results = harness.recorded(measure, seed=SEED, axis_ratio=AXIS_RATIO)
    results |= {"solver": SOLVER, "problems": options.count}
    harness.write(options.out, results, page)
    print(page(results))


if __name__ == "__main__":
    main()
