"""The contents of the wheel and the source archive, and the README's first example with the wheel alone."""

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
    command = [sys.executable, "-m", "build", "--outdir", str(out), str(REPO)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    (wheel,), (archive,) = out.glob("*.whl"), out.glob("*.tar.gz")
    return wheel, archive


def test_contents(built):
    wheel, archive = built
    assert wheel.stat().st_size < 5e6
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.partition("/")[0] for name in names}
    assert tops == {"kornia_pnpnet", f"kornia_pnpnet-{kornia_pnpnet.__version__}.dist-info"}
    for weights in shipped_weights():
        for file in ("config.json", "model.safetensors", "README.md"):
            assert f"kornia_pnpnet/weights/{weights}/{file}" in names
    assert "kornia_pnpnet/py.typed" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    with tarfile.open(archive) as file:
        inside = {"/".join(name.split("/")[1:]) for name in file.getnames()}
    for path in ("LICENSE", "CHANGELOG.md", "CITATION.cff", "train.py", "conf/train.yaml", "tests/test_release.py"):
        assert path in inside
    assert not any(name.startswith(("outputs/", "site/", ".venv/", "shared/")) for name in inside)


def test_the_quick_start_in_an_empty_environment(built, tmp_path):
    wheel, _ = built
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    plain = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}

    def run(*command):
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=plain)
        assert done.returncode == 0, done.stderr[-3000:]
        return done.stdout

    run(python, "-m", "pip", "install", "-q", str(wheel), "-c", str(REPO / "constraints.txt"))
    quick_start = re.search(r"```python\n(.*?)```", (REPO / "README.md").read_text(), flags=re.S)[1]
    where = "\nimport kornia_pnpnet; print(kornia_pnpnet.__file__, float(result.ok.float().mean()))"
    path, ok = run(python, "-c", quick_start + where).splitlines()[-1].split()
    assert Path(path).is_relative_to(tmp_path)
    assert float(ok) > 0.9
    assert kornia_pnpnet.__version__ in run(tmp_path / "venv" / "bin" / "pnpnet", "--version")
    assert "pnpnet-set" in run(tmp_path / "venv" / "bin" / "pnpnet", "list")
