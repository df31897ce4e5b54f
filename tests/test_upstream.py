"""The patch for Kornia applies to the installed Kornia and passes its tests there; its page shows what was measured."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import kornia
import pytest
import upstream

REPO = Path(__file__).resolve().parents[1]
PATCHES = sorted((REPO / "docs" / "upstream").glob("*.patch"))
INSTALLED = Path(kornia.__file__).parent
CHANGED = Path("kornia") / "geometry" / "calibration"

# What Kornia's tests need of its repository and the wheel does not have, in our words.
CONFTEST = """
import pytest
import torch

@pytest.fixture
def device():
    return torch.device("cpu")

@pytest.fixture(params=[torch.float32, torch.float64], ids=str)
def dtype(request):
    return request.param

@pytest.fixture
def torch_optimizer():
    return lambda function: torch.compile(function, fullgraph=True, backend="eager")

@pytest.fixture(autouse=True)
def names_of_doctests(doctest_namespace):
    doctest_namespace["torch"] = torch
"""
BASE = """
import torch

class BaseTester:
    def assert_close(self, actual, expected, rtol=1e-4, atol=1e-5):
        torch.testing.assert_close(actual, expected, rtol=rtol, atol=atol)

    def gradcheck(self, function, inputs):
        assert torch.autograd.gradcheck(function, [x.double().requires_grad_() for x in inputs], fast_mode=True)
"""


def run(folder, *command, **environment):
    """What a command prints that must succeed."""
    options = {"cwd": folder, "env": {**os.environ, **environment}, "capture_output": True, "text": True}
    done = subprocess.run(command, check=False, **options)
    assert done.returncode == 0, (done.stderr + done.stdout)[-4000:]
    return done.stdout


def apply(folder):
    """Apply the patches in ``folder``; the wheel has no documentation."""
    # Inside a repository git would look for the paths from its top.
    run(folder, "git", "apply", "--exclude=docs/*", *map(str, PATCHES), GIT_CEILING_DIRECTORIES=str(folder.parent))


def test_patch_applies_to_the_installed_kornia(tmp_path):
    shutil.copytree(INSTALLED / "geometry" / "calibration", tmp_path / CHANGED)
    apply(tmp_path)
    assert (tmp_path / CHANGED / "pnp_robust.py").exists()
    assert "solve_pnp_robust" in (tmp_path / CHANGED / "__init__.py").read_text()


@pytest.mark.slow
def test_tests_of_the_patch_pass_in_the_patched_kornia(tmp_path):
    shutil.copytree(INSTALLED, tmp_path / "kornia", ignore=shutil.ignore_patterns("__pycache__"))
    apply(tmp_path)
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "testing").mkdir()
    (tmp_path / "testing" / "base.py").write_text(BASE)
    command = [sys.executable, "-m", "pytest", "-q", "--doctest-modules", "tests", str(CHANGED / "pnp_robust.py")]
    assert "skipped" not in run(tmp_path, *command, PYTHONPATH=str(tmp_path))


@pytest.mark.slow
def test_patch_is_measured_beside_the_others():
    pytest.importorskip("cv2")
    rows = {row["solver"]: row for row in upstream.measure_success(20, ((12, 0.25),))}
    assert rows["solve_pnp_robust"]["success"] > 0.9
    assert rows["solve_pnp_dlt"]["success"] < 0.5
    assert all(row["us"] > 0 for row in upstream.measure_batches((2,)))
    assert all(row["last"] < row["first"] for row in upstream.measure_descent(4, (0.0,)))


def test_tables_of_the_page_are_written_from_the_file():
    results = json.loads((REPO / "benchmarks" / "upstream.json").read_text())
    assert upstream.page(results) in (REPO / "docs" / "upstream.md").read_text(encoding="utf-8")
