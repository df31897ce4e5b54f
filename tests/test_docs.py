"""The documentation: its Python runs as it stands, the site builds without a warning, no link leads nowhere."""

import importlib
import json
import pkgutil
import re
import runpy
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
PAGES = [DOCS / "index.md", *sorted((DOCS / "howto").glob("*.md"))]


def named(page):
    return str(page.relative_to(DOCS))


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=named)
def test_python_blocks_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.S)
    namespace = {}
    for block in blocks:
        exec(block, namespace)
    if "result" in namespace:
        assert namespace["result"].ok.float().mean() > 0.5


def test_every_page_is_in_the_table_of_contents():
    listed = set(re.findall(r"^[\w/-]+$", (DOCS / "index.md").read_text(), flags=re.M))
    pages = {named(page)[:-3] for page in DOCS.rglob("*.md") if "_build" not in page.parts} - {"index"}
    assert pages <= listed, pages - listed


class Targets(HTMLParser):
    """What a page links to and shows, and the places in it that can be linked to."""

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
    documented = {line.split()[0] for line in lines}
    text = " ".join(page.read_text() for page in (DOCS / "api").glob("*.md"))
    modules = re.findall(r"automodule:: ([\w.]+)", text)
    wanted = [("kornia_pnpnet", name) for name in kornia_pnpnet.__all__]
    wanted += [(module, name) for module in modules for name in importlib.import_module(module).__all__]
    missing = {x for x in wanted if not any(y.startswith(f"{x[0]}.") and y.endswith(f".{x[1]}") for y in documented)}
    assert missing <= {("kornia_pnpnet", "__version__")}
    assert {f"kornia_pnpnet.{x.name}" for x in pkgutil.iter_modules(kornia_pnpnet.__path__)} - set(modules) <= INTERNAL


# How the package does what it does, and the command line, which has a page of its own.
INTERNAL = {
    f"kornia_pnpnet.{name}"
    for name in ("arguments", "choices", "cli", "compilation", "demo", "environment", "files", "pairs", "results")
} | {"kornia_pnpnet.runstate", "kornia_pnpnet.small"}


def test_the_page_on_hardening_is_of_its_results():
    made = runpy.run_path(str(DOCS / "hardening.py"))
    assert made["PAGE"].read_text() == made["page"](json.loads(made["RESULTS"].read_text()))
