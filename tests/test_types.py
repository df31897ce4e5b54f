"""What a type checker says of a user's script."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import torch

from kornia_pnpnet import PnPNet, PnPResult, create_solver, pose_covariance, solve_pnp

world_points, img_points = torch.rand(8, 12, 3), torch.rand(8, 12, 2)
intrinsics = torch.eye(3)


def solve(name: str) -> PnPResult:
    solver = create_solver(name)
    return solver(world_points, img_points, intrinsics, img_sigma=1.0)


result = solve("pnpnet-set")
matrix: torch.Tensor = result.matrix[result.ok]
inliers: torch.Tensor = result.inliers
covariance = pose_covariance(result.pose, world_points, img_points, intrinsics, img_sigma=result.sigma)
loaded: PnPResult = PnPNet.from_pretrained("pnpnet-set")(world_points, img_points, intrinsics)
peer: PnPResult = create_solver("poselib", threshold=3.0)(world_points, img_points, intrinsics)
matrices: torch.Tensor = solve_pnp(world_points, img_points, intrinsics)
"""
WRONG = """
create_solver("pnpnet-set")(world_points, img_points, intrinsics, sigma=3)
create_solver("poselib")(world_points, img_points, intrinsics, img_sigma=3.0)
create_solver("pnpnet-set")(world_points, img_points, intrinsics).rotations
"""


@pytest.mark.slow
def test_a_script_is_typed_and_wrong_arguments_are_found(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT + WRONG)
    options = "--strict", "--follow-imports=silent", "--cache-dir", str(tmp_path / "cache")
    run = subprocess.run(
        [sys.executable, "-m", "mypy", *options, script.name],
        cwd=tmp_path,
        env={"MYPYPATH": str(Path(__file__).resolve().parents[1])},
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    first = (SCRIPT + WRONG).count("\n") - WRONG.count("\n") + 2
    found = re.findall(r"script.py:(\d+): error: .*?(\"\w+\")", run.stdout)
    assert found == [(str(first), '"sigma"'), (str(first + 1), '"img_sigma"'), (str(first + 2), '"PnPResult"')], run
