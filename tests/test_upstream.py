"""The patch for Kornia applies to the installed Kornia and passes its tests there; its page shows what was measured."""

import importlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import kornia
import pytest

REPO = Path(__file__).resolve().parents[1]
PATCHES = sorted((REPO / "docs" / "upstream").glob("*.patch"))
INSTALLED = Path(kornia.__file__).parent
CHANGED = Path("kornia") / "geometry" / "calibration"

# What Kornia's tests need of its repository and the wheel does not have, in our words.
CONFTEST = """
import functools
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
    return functools.partial(torch.compile, fullgraph=True, backend="eager")


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


def apply(folder):
    """Apply the patches in ``folder``; the wheel has no documentation."""
    # Inside a repository git would look for the paths from its top.
    environment = {**os.environ, "GIT_CEILING_DIRECTORIES": str(folder.parent)}
    command = ["git", "apply", "--exclude=docs/*", *map(str, PATCHES)]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


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
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:]
    assert "skipped" not in done.stdout


@pytest.fixture
def upstream():
    pytest.importorskip("cv2")
    return importlib.import_module("upstream")


@pytest.mark.slow
def test_patch_is_measured_beside_the_others(upstream):
    rows = {row["solver"]: row for row in upstream.measure_success(20, ((12, 0.25),))}
    assert rows["solve_pnp_robust"]["success"] > 0.9
    assert rows["solve_pnp_dlt"]["success"] < 0.5
    assert all(row["us"] > 0 for row in upstream.measure_batches((2,)))
    assert all(row["last"] < row["first"] for row in upstream.measure_descent(4, (0.0,)))


def test_tables_of_the_page_are_written_from_the_file(upstream):
    results = json.loads((REPO / "benchmarks" / "upstream.json").read_text())
    assert upstream.page(results) in (REPO / "docs" / "upstream.md").read_text(encoding="utf-8")
