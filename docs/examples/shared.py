"""What the examples share: command lines, results files, and errors of poses."""

import argparse
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from kornia_pnpnet import Pose, create_solver
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.evaluation.results import save_results
from kornia_pnpnet.refine.residual import rotation_angle


def command(description: str | None, **counts: int) -> argparse.ArgumentParser:
    """The command line of an example, whose help shows the description as it is written.

    It has an option for each of the ``counts``, whole numbers with these defaults.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"), help="folder of results and pictures")
    for name, default in counts.items():
        parser.add_argument(f"--{name}", type=int, default=default, help="default: %(default)s")
    return parser


def write(path: Path, /, **results: Any) -> None:
    """Write a results file with the environment, and make a missing folder."""
    save_results({"environment": environment(), **results}, path)


def centre(pose: Pose) -> Tensor:
    """The centre of each camera in the world, (..., 3)."""
    return -(pose.rotation.mT @ pose.translation[..., None])[..., 0]


def pose_error(found: Pose, truth: Pose) -> tuple[Tensor, Tensor]:
    """Distances of the cameras in the unit of the world, and angles of the rotations in degrees."""
    angle = torch.rad2deg(rotation_angle(found.rotation, truth.rotation))
    return (centre(found) - centre(truth)).norm(dim=-1), angle


def opencv(threshold: float) -> nn.Module:
    """``cv2.solvePnPRansac`` with a threshold in pixels and OpenCV's defaults, called like a solver of ours."""
    defaults = {"iterations": 100, "confidence": 0.99, "method": "ITERATIVE", "refine": False}
    return create_solver("opencv-ransac", threshold=threshold, **defaults)
