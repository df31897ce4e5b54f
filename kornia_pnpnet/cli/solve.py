"""Find the pose of one image, or of many problems in files.

The pose of one image is printed as JSON: x_cam = R x_world + t.

  pnpnet solve matches.csv --intrinsics 3400,3400,3024,2016 --plot pose.png

With an unknown focal length only the principal point counts, which is mostly the middle of the image:

  pnpnet solve matches.csv --focal unknown --intrinsics 1,1,3024,2016

With --batch, files of many problems are solved in bounded memory and their poses are written to files. The same command
continues where it was stopped. The files, called shards, are NPZ files with world_points (B, N, 3), img_points
(B, N, 2) and optionally weights, intrinsics, img_sigma and world_sigma, or Parquet files with columns of these names
and one problem per row. Results are Parquet files.

  pnpnet solve --batch shards/ --out poses/

Exit code: 0 when solved, 1 when no pose explains the correspondences, 2 for bad input.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from typing import TYPE_CHECKING

from kornia_pnpnet.cli.arguments import load_solver_without_truth

if TYPE_CHECKING:
    from torch import Tensor, nn

_ADVICE = {
    "too_few_pairs": "a pose needs at least three correspondences that a camera can see",
    "degenerate": "the points lie on a line or coincide",
    "not_finite": "the file has NaN, infinity or a negative weight",
    "camera": "the intrinsics are not those of a pinhole camera that this solver takes",
    "not_believed": "too few correspondences agree with the pose; with many outliers try "
    "--solver p3p-ransac:threshold=PX, and check units, intrinsics and the order of the columns",
    "behind": "the points are behind the camera; check the axes: x to the right, y down, z forward",
}


def run(arguments: argparse.Namespace) -> int:
    """Solve one image, or the shards of ``--batch``."""
    from kornia_pnpnet.cli.correspondence_files import camera_matrix

    if arguments.camera and (arguments.intrinsics or arguments.focal or arguments.batch):
        raise ValueError("--camera stands alone: without --intrinsics, --focal and --batch")
    if arguments.batch and (arguments.plot or arguments.threshold):
        raise ValueError("--plot and --threshold are for one image, not for --batch")
    if not arguments.batch and (len(arguments.file) > 1 or arguments.out):
        raise ValueError("several files and --out need --batch")
    camera = camera_matrix(arguments.intrinsics) if arguments.intrinsics else None
    return _solve_batch(arguments, camera) if arguments.batch else _solve_image(arguments, camera)


def _load_solver(arguments: argparse.Namespace) -> nn.Module:
    from kornia_pnpnet.solver import PnPNet

    solver = load_solver_without_truth(arguments.solver)
    if not arguments.focal:
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
        report = solve_shards(solve, arguments.file, out, name=name, batch=size, overwrite=again, progress=True)
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

    from kornia_pnpnet import Status
    from kornia_pnpnet.cli.correspondence_files import InputError, read_correspondences, reproject

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
    solver, weights = _load_solver(arguments), None if weights is None else weights[None]
    with torch.no_grad():
        result = solver(world_points[None], img_points[None], camera[None], weights)
    camera, ok, status = result.intrinsics[0], bool(result.ok), Status(int(result.status)).name.lower()
    pixels, errors, limit = reproject(world_points, img_points, camera, result.pose, arguments.threshold)
    rejected = ~(errors <= limit) | ~result.ok  # without a pose all correspondences are rejected
    pairs = zip(result.weights[0].tolist(), errors.tolist(), rejected.tolist(), strict=True)
    answer = {
        "solver": name,
        "n": len(world_points),
        "ok": ok,
        "status": status,
        "rotation": result.rotation[0].tolist(),
        "translation": result.translation[0].tolist(),
        "quaternion_wxyz": result.pose.quaternion[0].tolist(),
        "intrinsics": camera.tolist(),
        "cost": result.cost.item(),
        "rejected_above_px": limit,
        "pairs": [
            {"weight": weight, "reprojection_error_px": error if math.isfinite(error) else None, "rejected": bad}
            for weight, error, bad in pairs
        ],
    }
    print(json.dumps(answer, indent=2, allow_nan=False))
    if plot:
        from kornia_pnpnet.evaluation.plots import plot_pose

        plot_pose(plot, img_points, pixels, rejected, name if ok else f"{name}: NOT SOLVED")
    if not ok:
        print(f"pnpnet: not solved ({status}): {_ADVICE[status]}", file=sys.stderr)
    return 0 if ok else 1
