"""The package from outside: wheel and archive, the first example with the wheel alone, the types of a script."""

import itertools
import os
import re
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

import kornia_pnpnet
from kornia_pnpnet import shipped_weights

REPO = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The wheel and the source archive that the wheel is built from."""
    out = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-m", "build", "--outdir", str(out), str(REPO)], check=True)
    (wheel,), (archive,) = out.glob("*.whl"), out.glob("*.tar.gz")
    return wheel, archive


def test_contents(built):
    wheel, archive = built
    assert wheel.stat().st_size < 5e6
    names = zipfile.ZipFile(wheel).namelist()
    metadata = f"kornia_pnpnet-{kornia_pnpnet.__version__}.dist-info"
    assert {name.partition("/")[0] for name in names} == {"kornia_pnpnet", metadata}
    files = itertools.product(shipped_weights(), ("config.json", "model.safetensors", "README.md"))
    wanted = {"kornia_pnpnet/py.typed", f"{metadata}/licenses/LICENSE"}
    assert wanted | {f"kornia_pnpnet/weights/{weights}/{file}" for weights, file in files} <= set(names)
    with tarfile.open(archive) as file:
        inside = {name.partition("/")[2] for name in file.getnames()}
    assert {"LICENSE", "CHANGELOG.md", "CITATION.cff", "train.py", "conf/train.yaml", "tests/test_release.py"} <= inside
    assert not any(name.startswith(("outputs/", "site/", ".venv/", "shared/")) for name in inside)


def test_the_quick_start_in_an_empty_environment(built, tmp_path):
    wheel, _ = built
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    plain = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}

    def run(*command):
        return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, cwd=tmp_path, env=plain).stdout

    run(python, "-m", "pip", "install", "-q", str(wheel), "-c", str(REPO / "constraints.txt"))
    quick_start = re.search(r"```python\n(.*?)```", (REPO / "README.md").read_text(), flags=re.S)[1]
    where = "\nimport kornia_pnpnet; print(kornia_pnpnet.__file__, float(result.ok.float().mean()))"
    path, ok = run(python, "-c", quick_start + where).splitlines()[-1].split()
    assert Path(path).is_relative_to(tmp_path)
    assert float(ok) > 0.9
    command = python.with_name("pnpnet")
    assert kornia_pnpnet.__version__ in run(command, "--version")
    assert "pnpnet-set" in run(command, "list")


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


def test_a_script_is_typed_and_wrong_arguments_are_found(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT + WRONG)
    options = "--strict", "--follow-imports=silent", "--cache-dir", str(tmp_path / "cache")
    command, path = [sys.executable, "-m", "mypy", *options, script.name], {"MYPYPATH": str(REPO)}
    run = subprocess.run(command, cwd=tmp_path, env=path, stdout=subprocess.PIPE, text=True, check=False)
    first = SCRIPT.count("\n") + 2
    found = re.findall(r"script.py:(\d+): error: .*?(\"\w+\")", run.stdout)
    assert found == [(str(first), '"sigma"'), (str(first + 1), '"img_sigma"'), (str(first + 2), '"PnPResult"')], run
