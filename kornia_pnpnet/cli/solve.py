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
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kornia_pnpnet.cli.arguments import (
    existing_path,
    load_solver_without_truth,
    picture_path,
    positive_float,
    whole_number,
)

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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``pnpnet solve``."""
    parser.add_argument(
        "file",
        metavar="FILE",
        nargs="+",
        type=existing_path,
        help="CSV with the header X,Y,Z,u,v and optionally weight, or NPZ with world_points (N, 3), img_points (N, 2) "
        "and optionally weights (N,) and intrinsics (3, 3)",
    )
    parser.add_argument(
        "--intrinsics", metavar="fx,fy,cx,cy", help="the camera in pixels; replaces the intrinsics of an NPZ file"
    )
    parser.add_argument(
        "--camera",
        metavar="MODEL,w,h,PARAMS",
        help="a distorted camera as in COLMAP's cameras.txt, in place of --intrinsics, for example "
        "SIMPLE_RADIAL,1920,1080,1500,960,540,-0.02; errors are those of undistorted pixels",
    )
    parser.add_argument(
        "--focal",
        metavar="known|unknown|SIGMA",
        type=_focal,
        help="estimate the focal length; SIGMA: that of the intrinsics is right up to this share, such as 0.1",
    )
    parser.add_argument(
        "--solver",
        metavar="NAME",
        default="pnpnet-set",
        help="a name of `pnpnet list`, or a folder of weights; default: %(default)s",
    )
    parser.add_argument(
        "--plot", metavar="PNG", type=picture_path, help="draw pixels, reprojections and rejected correspondences"
    )
    parser.add_argument(
        "--threshold",
        metavar="PX",
        type=positive_float,
        help="reject correspondences with a larger reprojection error; default: a robust estimate of three standard "
        "deviations, at least 3 px",
    )
    parser.add_argument("--batch", action="store_true", help="FILE are shards of many problems, or folders of shards")
    parser.add_argument("--out", metavar="FOLDER", help="where --batch writes poses; default: outputs/poses")
    parser.add_argument(
        "--batch-size", metavar="B", type=whole_number(1), default=10_000, help="problems per call; default: 10000"
    )
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="replace the picture; with --batch also solve the shards that have results",
    )


def _focal(text: str) -> dict[str, Any]:
    """Options of a solver from ``--focal``."""
    if text in ("known", "unknown"):
        return {"focal": text}
    return {"focal": "unknown", "focal_sigma": positive_float(text)}


def _load_solver(arguments: argparse.Namespace) -> nn.Module:
    from kornia_pnpnet.solver import PnPNet

    solver = load_solver_without_truth(arguments.solver)
    if not arguments.focal:
        return solver
    if not isinstance(solver, PnPNet):
        raise ValueError(f"--focal: {arguments.solver} does not estimate focal lengths")
    options: dict[str, Any] = {"views": solver.views, "gradient": solver.gradient, "effort": solver.effort}
    return PnPNet(solver.init, solver.refine, solver.normalize, **options, **arguments.focal).eval()


def run(arguments: argparse.Namespace) -> int:
    """Solve one image or, with ``--batch``, shards."""
    from kornia_pnpnet.cli.correspondence_files import camera_matrix

    if arguments.camera and (arguments.intrinsics or arguments.focal or arguments.batch):
        raise ValueError("--camera stands alone: without --intrinsics, --focal and --batch")
    if arguments.batch and (arguments.plot or arguments.threshold):
        raise ValueError("--plot and --threshold are for one image, not for --batch")
    if not arguments.batch and (len(arguments.file) > 1 or arguments.out):
        raise ValueError("several files and --out need --batch")
    camera = camera_matrix(arguments.intrinsics) if arguments.intrinsics else None
    return _solve_batch(arguments, camera) if arguments.batch else _solve_image(arguments, camera)


def _solve_batch(arguments: argparse.Namespace, camera: Tensor | None) -> int:
    from kornia_pnpnet.arrow import Solve
    from kornia_pnpnet.cli.shards import solve_shards

    out, again = arguments.out or "outputs/poses", arguments.overwrite
    solve = Solve(_load_solver(arguments), intrinsics=camera)
    options = {"name": arguments.solver, "batch": arguments.batch_size, "overwrite": again, "progress": True}
    try:
        report = solve_shards(solve, arguments.file, out, **options)
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
    from kornia_pnpnet.cli.correspondence_files import InputError, read_correspondences
    from kornia_pnpnet.cli.reprojection import reproject

    (path,) = arguments.file
    matches = read_correspondences(path)
    if arguments.camera:
        matches = matches.undistorted(arguments.camera)
    camera = matches.intrinsics if camera is None else camera
    if camera is None:
        raise InputError(path, "the file has no intrinsics: pass --intrinsics fx,fy,cx,cy")
    if arguments.plot and Path(arguments.plot).exists() and not arguments.overwrite:
        raise ValueError(f"'{arguments.plot}' exists: pass --overwrite to replace it")
    solver, name = _load_solver(arguments), arguments.solver
    weights = None if matches.weights is None else matches.weights[None]
    with torch.no_grad():
        result = solver(matches.world_points[None], matches.img_points[None], camera[None], weights)
    camera, ok, status = result.intrinsics[0], bool(result.ok), Status(int(result.status)).name.lower()
    found = reproject(matches.world_points, matches.img_points, camera, result.pose, arguments.threshold)
    rejected = found.rejected if ok else torch.ones_like(found.rejected)  # without a pose no pair is accepted
    pairs = zip(*(x.tolist() for x in (result.weights[0], found.errors_px, rejected)), strict=True)
    answer = {
        "solver": name,
        "n": len(matches.world_points),
        "ok": ok,
        "status": status,
        "rotation": result.rotation[0].tolist(),
        "translation": result.translation[0].tolist(),
        "quaternion_wxyz": result.pose.quaternion[0].tolist(),
        "intrinsics": camera.tolist(),
        "cost": result.cost.item(),
        "rejected_above_px": found.limit_px,
        "pairs": [
            {"weight": weight, "reprojection_error_px": error if math.isfinite(error) else None, "rejected": bad}
            for weight, error, bad in pairs
        ],
    }
    print(json.dumps(answer, indent=2, allow_nan=False))
    if arguments.plot:
        from kornia_pnpnet.evaluation.plots import plot_pose

        title = name if ok else f"{name}: NOT SOLVED"
        plot_pose(arguments.plot, matches.img_points, found.pixels, rejected, title)
    if not ok:
        print(f"pnpnet: not solved ({status}): {_ADVICE[status]}", file=sys.stderr)
    return 0 if ok else 1
