"""The documentation: its Python runs, the site builds without warnings, its links lead to pages and sections."""

import re
import subprocess
import sys
import zlib
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlparse

import pytest

import kornia_pnpnet

REPO = Path(__file__).resolve().parents[1]
DOCS = REPO / "docs"
PAGES = [DOCS / "index.md", DOCS / "solvers.md", *sorted((DOCS / "howto").glob("*.md"))]


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_python_blocks_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.S)
    namespace = {}
    for block in blocks:
        exec(block, namespace)
    if "result" in namespace:
        assert namespace["result"].ok.float().mean() > 0.5


class Targets(HTMLParser):
    """The targets of a page's links and pictures, and the ids in the page that links can name."""

    def __init__(self):
        super().__init__()
        self.targets, self.places = [], set()

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.places.add(values.get("id"))
        self.targets += [values[name] for name in ("href", "src") if values.get(name)]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(out)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr[-4000:]
    return out


@pytest.mark.slow
def test_links_and_pictures_of_the_site_are_there(site):
    parsed = {}
    for page in site.rglob("*.html"):
        parsed[page] = Targets()
        parsed[page].feed(page.read_text())
    assert len(parsed) > 20
    broken = []
    for page, found in parsed.items():
        for target in found.targets:
            url = urlparse(target)
            if url.scheme or url.netloc:
                continue
            file = (page.parent / unquote(url.path)).resolve() if url.path else page
            if not file.exists() or (url.fragment and file in parsed and url.fragment not in parsed[file].places):
                broken.append((page.name, target))
    assert not broken


@pytest.mark.slow
def test_every_public_name_is_in_the_reference(site):
    lines = zlib.decompress((site / "objects.inv").read_bytes().split(b"\n", 4)[4]).decode().splitlines()
    documented = {line.split()[0].rpartition(".")[2] for line in lines}
    assert {*kornia_pnpnet.__all__} - documented <= {"__version__"}
