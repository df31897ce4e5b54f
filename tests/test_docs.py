"""The documentation: its Python runs and prints what pages show, links lead to places, and the site fits its window."""

import html
import json
import re
import runpy
import shutil
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

import kornia_pnpnet

REPO = Path(__file__).resolve().parents[1]
DOCS = REPO / "docs"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
CHROMIUM_OPTIONS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--allow-file-access-from-files", "--dump-dom"),
)
# Opens what is folded on every page, and lists pages that are wider than their frame, and what is cut without a hint.
FIND_WIDE = """
addEventListener("load", () => {
  const wide = [];
  for (const frame of document.querySelectorAll("iframe")) {
    const page = frame.contentDocument, root = page.documentElement, name = frame.getAttribute("src");
    for (const folded of page.querySelectorAll("details")) folded.open = true;
    frame.contentWindow.mark();
    if (root.scrollWidth > root.clientWidth) wide.push(`${name}: ${root.scrollWidth} px`);
    for (const box of page.querySelectorAll("article *")) {
      const hides = frame.contentWindow.getComputedStyle(box).overflowX !== "visible";
      if (hides && box.clientWidth && box.scrollWidth > box.clientWidth + 1 && !box.classList.contains("scrolls"))
        wide.push(`${name}: ${box.textContent.slice(0, 60)}`);
    }
  }
  document.body.textContent = JSON.stringify(wide);
});
"""
PAGES = [*(DOCS / f"{name}.md" for name in ("index", "solvers", "conventions")), *sorted((DOCS / "howto").glob("*.md"))]
COMPILE = {"compile", "export"}
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def test_all_files_name_the_same_version():
    version = kornia_pnpnet.__version__
    changelog, citation, readme = ((REPO / name).read_text() for name in ("CHANGELOG.md", "CITATION.cff", "README.md"))
    released = re.findall(r"^## \[(\d\S*)\] - \d{4}-\d\d-\d\d$", changelog, flags=re.M)
    assert released[0] == version
    assert f"\nversion: {version}\n" in citation
    assert f"version={{{version}}}" in readme


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, id=page.stem, marks=[pytest.mark.slow] * (page.stem in COMPILE)) for page in PAGES],
)
def test_python_prints_what_the_page_shows(page, tmp_path, monkeypatch):
    """Numbers may differ a little: processors round differently."""
    monkeypatch.chdir(tmp_path)
    shown = page.read_text()
    printed = runpy.run_path(str(DOCS / "outputs.py"))["with_outputs"](shown)
    assert NUMBER.sub("#", printed).split() == NUMBER.sub("#", shown).split()
    numbers = [float(number) for number in NUMBER.findall(shown)]
    assert [float(number) for number in NUMBER.findall(printed)] == pytest.approx(numbers, rel=0.05, abs=0.05)


def test_python_of_the_readme_runs():
    names = {}
    for block in re.findall(r"```python\n(.*?)```", (REPO / "README.md").read_text(), flags=re.S):
        exec(block, names)
    assert names["result"].ok.float().mean() > 0.9
    assert names["robust"].ok.float().mean() > 0.9
    for value in (names["img_points"].grad, names["refined"].matrix, names["covariance"][names["result"].ok]):
        assert value.isfinite().all()


@pytest.mark.parametrize("page", [REPO / "README.md", *sorted(DOCS.rglob("*.md"))], ids=lambda page: page.stem)
def test_links_between_files_are_there(page):
    links = re.findall(r"\]\(([^)#]+)\)", page.read_text())
    assert [x for x in links if "://" not in x and not (page.parent / x).exists()] == []


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site. Links and pictures that lead nowhere are warnings of Sphinx, and warnings are errors."""
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(out)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr[-4000:]
    return out


@pytest.mark.slow
def test_every_public_name_is_in_the_reference(site):
    lines = zlib.decompress((site / "objects.inv").read_bytes().split(b"\n", 4)[4]).decode().splitlines()
    documented = {line.split()[0].rpartition(".")[2] for line in lines}
    assert {*kornia_pnpnet.__all__} - documented <= {"__version__"}


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
@pytest.mark.parametrize("width", [390, 1280])
def test_pages_fit_into_the_window_and_wide_tables_say_that_they_scroll(site, tmp_path, width):
    pages = [page.as_uri() for page in site.rglob("*.html") if "_modules" not in page.parts]
    frames = "".join(f'<iframe src="{page}" width="{width}" height="800"></iframe>' for page in pages)
    everything = tmp_path / "all.html"
    everything.write_text(f"<meta charset=utf-8><body>{frames}<script>{FIND_WIDE}</script></body>")
    command = [CHROMIUM, *CHROMIUM_OPTIONS, f"--user-data-dir={tmp_path / 'profile'}", everything.as_uri()]
    dumped = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300).stdout
    assert json.loads(html.unescape(re.search(r"<body>(.*)</body>", dumped, flags=re.S)[1])) == []
