"""Find the pose of one image, or of many problems in files.

The pose of one image, x_cam = R x_world + t, is printed as a table. In a pipe or with --json, JSON is printed instead.
The inliers' residuals give the standard deviations. The rotation has one standard deviation per axis of the camera.

  pnpnet solve matches.csv --intrinsics 3400,3400,3024,2016 --plot pose.png

If the focal length is unknown, pass 1,1 in its place. The principal point is usually the middle of the image:

  pnpnet solve matches.csv --focal unknown --intrinsics 1,1,3024,2016

With --batch, the command solves files of many problems in bounded memory and writes the poses to Parquet files. To
continue after a stop, run the same command again. A file of problems, called a shard, is an NPZ or a Parquet file. An
NPZ shard has the arrays world_points (B, N, 3), img_points (B, N, 2) and optionally weights, intrinsics, img_sigma and
world_sigma. A Parquet shard has columns with these names, and one problem per row.

  pnpnet solve --batch shards/ --out poses/

If the focal length is unknown, the files of poses also have the estimated intrinsics and distortion (dist).

Exit code: 0 when solved, 1 when no pose explains the correspondences, 2 for bad input.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from typing import TYPE_CHECKING, Any

from kornia_pnpnet.cli.arguments import load_solver_without_truth

if TYPE_CHECKING:
    from torch import Tensor, nn

_ADVICE = {
    "too_few_pairs": "a pose needs at least three correspondences that a camera can see",
    "degenerate": "the points lie on a line or coincide",
    "not_finite": "the file has NaN, infinity or a negative weight",
    "camera": "the intrinsics are not those of a pinhole camera that this solver takes, or do not fit the pixels",
    "not_believed": "the correspondences are too few or too similar to determine the pose",
    "precision": "the points have large coordinates and small differences: store them as float64, or subtract an "
    "offset before they become float32",
    "behind": "the points are behind the camera; check the axes: x to the right, y down, z forward",
}
# Largest plausible noise, and smallest plausible share of inliers. These limits detect files in another convention.
_MOST_NOISE_PX, _LEAST_SHARE = 10.0, 0.5
_MISTAKES = (
    "swapped columns, another image size, y up? try --diagnose; many outliers? try --solver p3p-ransac:threshold=PX"
)


def run(arguments: argparse.Namespace) -> int:
    """Solve one image, or the shards of ``--batch``."""
    from kornia_pnpnet.cli.correspondence_files import camera_matrix

    if arguments.camera and (arguments.intrinsics or arguments.focal or arguments.batch):
        raise ValueError("--camera stands alone: without --intrinsics, --focal and --batch")
    if arguments.batch and (arguments.plot or arguments.threshold or arguments.json or arguments.diagnose):
        raise ValueError("--plot, --threshold, --json and --diagnose are for one image, not for --batch")
    if not arguments.batch and (len(arguments.file) > 1 or arguments.out):
        raise ValueError("several files and --out need --batch")
    camera = camera_matrix(arguments.intrinsics) if arguments.intrinsics else None
    return _solve_batch(arguments, camera) if arguments.batch else _solve_image(arguments, camera)


def _load_solver(arguments: argparse.Namespace) -> nn.Module:
    from kornia_pnpnet.solver import PnPNet

    solver = load_solver_without_truth(arguments.solver)
    if not arguments.focal or arguments.focal["focal"] == getattr(solver, "focal", "known") == "known":
        return solver
    if not isinstance(solver, PnPNet):
        raise ValueError(f"--focal: {arguments.solver} does not estimate focal lengths")
    return solver.with_options(**arguments.focal).eval()


def _solve_batch(arguments: argparse.Namespace, camera: Tensor | None) -> int:
    from kornia_pnpnet.arrow import Solve
    from kornia_pnpnet.cli.shards import solve_shards

    out, again, name = arguments.out or "outputs/poses", arguments.overwrite, arguments.solver
    solve, size = Solve(_load_solver(arguments), intrinsics=camera), arguments.batch_size
    try:
        report = solve_shards(solve, arguments.file, out, name=name, batch=size, overwrite=again)
    except KeyboardInterrupt:
        same = "the same command without --overwrite" if again else "the same command"
        print(f"pnpnet: interrupted; the shards solved so far are in {out}: {same} solves the others", file=sys.stderr)
        return 130
    for line in report.failed:
        print(f"pnpnet: {line}", file=sys.stderr)
    kept = f"; {report.kept} shards had been solved before" if report.kept else ""
    print(f"{report.solved} of {report.problems} problems in {report.shards} shards solved{kept}")
    return 2 if report.failed else 0


def _solve_image(arguments: argparse.Namespace, camera: Tensor | None) -> int:
    import torch
    from kornia.geometry.calibration import distort_points

    from kornia_pnpnet import Status, diagnose
    from kornia_pnpnet.cameras import reproject
    from kornia_pnpnet.cli.correspondence_files import read_correspondences
    from kornia_pnpnet.core.files import InputError
    from kornia_pnpnet.problem import MIN_PAIRS

    (path,), name, plot = arguments.file, arguments.solver, arguments.plot
    matches = read_correspondences(path)
    if arguments.camera:
        matches = matches.undistorted(arguments.camera)
    world_points, img_points, weights, camera_of_file = matches
    camera = camera_of_file if camera is None else camera
    if camera is None:
        raise InputError(path, "the file has no intrinsics: pass --intrinsics fx,fy,cx,cy")
    if plot and plot.exists() and not arguments.overwrite:
        raise ValueError(f"'{plot}' exists: pass --overwrite to replace it")
    solver, pairs, camera = _load_solver(arguments), (world_points[None], img_points[None]), camera.to(img_points)
    focal = getattr(solver, "focal", "known")
    if arguments.camera and focal == "unknown":
        raise ValueError("--camera needs a solver with a known focal length")
    if arguments.diagnose and focal == "unknown":
        raise ValueError("--diagnose needs a known focal length")
    used = weights > 0
    enough = int(used.sum()) >= MIN_PAIRS
    diagnosis = diagnose(world_points[used], img_points[used], camera) if arguments.diagnose and enough else None
    with torch.no_grad():
        result = solver(*pairs, camera[None], weights[None])
        uncertain = {"focal": focal, "focal_sigma": getattr(solver, "focal_sigma", None)}
        covariance = result.covariance(*pairs, result.intrinsics, **uncertain)
    camera, ok, status = result.intrinsics[0], bool(result.ok), Status(int(result.status)).name.lower()
    pixels = reproject(world_points, camera, result.pose)
    if result.dist.any():
        pixels = distort_points(pixels, result.intrinsics, result.dist)
    pixels = pixels[0]
    errors, limit = (pixels - img_points).norm(dim=-1), arguments.threshold
    inliers, sigma = int(result.inliers.sum()), result.sigma.item()
    rejected = ~(result.inliers[0] if limit is None else errors <= limit) | ~result.ok  # no pose: reject all
    deviations = torch.where(result.ok, covariance[0].diagonal().sqrt(), torch.nan)
    answer = {
        "solver": name,
        "n": len(world_points),
        "ok": ok,
        "status": status,
        "inliers": inliers,
        "sigma_px": sigma,
        "probability": result.probability.item(),
        "rotation": result.rotation[0].tolist(),
        "rotation_sigma_deg": _finite(deviations[:3].rad2deg()),
        "translation": result.translation[0].tolist(),
        "translation_sigma": _finite(deviations[3:6]),
        "quaternion_wxyz": result.pose.quaternion[0].tolist(),
        "intrinsics": camera.tolist(),
        **({"dist": result.dist[0].tolist()} if result.dist.any() else {}),
        **({"focal_sigma_px": _finite(deviations[6:] * camera[0, 0].abs())[0]} if focal == "unknown" else {}),
        **({"diagnosis": str(diagnosis)} if diagnosis else {}),
        "cost": result.cost.item(),
        "rejected_above_px": limit,
        "pairs": [
            {"weight": weight, "reprojection_error_px": error, "rejected": bad}
            for weight, error, bad in zip(result.weights[0].tolist(), _finite(errors), rejected.tolist(), strict=True)
        ],
    }
    if arguments.json or not sys.stdout.isatty():
        print(json.dumps(answer, indent=2, allow_nan=False))
    else:
        print(_table(answer, result.pose.rvec[0].rad2deg().tolist()))
    if plot:
        from kornia_pnpnet.evaluation.plots import plot_pose

        plot_pose(plot, img_points, pixels, rejected, name if ok else f"{name}: NOT SOLVED")
    doubts = []
    if status in ("solved", "not_believed"):
        if inliers < _LEAST_SHARE * int(used.sum()):
            doubts.append(f"only {inliers} of {int(used.sum())} correspondences agree with the pose")
        if sigma > _MOST_NOISE_PX:
            doubts.append(f"the inliers show {sigma:.3g} px of noise, more than {_MOST_NOISE_PX:g}")
    reason = f"{' and '.join(doubts)}: {_MISTAKES}" if doubts else _ADVICE.get(status)
    if reason:
        print(f"pnpnet: {reason}" if ok else f"pnpnet: not solved ({status}): {reason}", file=sys.stderr)
    return 0 if ok else 1


def _finite(values: Tensor) -> list[float | None]:
    """A list for JSON, with ``None`` in place of numbers that are not finite."""
    return [value if math.isfinite(value) else None for value in values.tolist()]


def _table(answer: dict[str, Any], rvec_deg: list[float]) -> str:
    def row(values: list[float], sigmas: list[float | None], unit: str = "") -> str:
        spread = [sigma for sigma in sigmas if sigma is not None]
        least = min(filter(None, spread), default=1e-3)  # two digits of the smallest standard deviation are shown
        digits = min(max(1 - math.floor(math.log10(least)), 0), 9)
        text = [f"{value:.{digits}f}" for value in values] + ["±"] * bool(spread) + [f"{sigma:.2g}" for sigma in spread]
        return " ".join([*text, unit]).rstrip()

    rows = {
        "status": answer["status"],
        "inliers": f"{answer['inliers']} of {answer['n']}",
        "sigma": f"{answer['sigma_px']:.3g} px",
        "probability": f"{answer['probability']:.3f}",
        "rotation": row(rvec_deg, answer["rotation_sigma_deg"], "degrees, axis times angle"),
        "translation": row(answer["translation"], answer["translation_sigma"]),
    }
    if "focal_sigma_px" in answer:
        rows["focal length"] = row([answer["intrinsics"][0][0]], [answer["focal_sigma_px"]], "px")
    if "diagnosis" in answer:
        rows["diagnosis"] = answer["diagnosis"]
    return "\n".join(f"{name:<13} {text}" for name, text in rows.items())
