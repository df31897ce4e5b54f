"""The examples of the documentation run, and show what they say."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "docs" / "examples"


@pytest.mark.slow
def test_keypoint_offsets_are_learned_through_the_pose(tmp_path):
    script = EXAMPLES / "keypoint_offsets.py"
    subprocess.run([sys.executable, script, "--steps", "300", "--out", tmp_path], check=True)
    runs = json.loads((tmp_path / "keypoint_offsets.json").read_text())["runs"]
    assert (tmp_path / "keypoint_offsets.png").stat().st_size > 0
    ours, *others = (run["error_px"] for run in runs.values())
    assert ours[-1] < ours[0] / 10
    assert all(errors[-1] > errors[0] / 2 for errors in others)
    assert runs["pnpnet-set"]["steps_without_finite_gradient"] == 0
