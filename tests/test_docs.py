"""The documentation: its Python runs as it stands, the site builds without a warning, no link leads nowhere."""

import functools
import http.server
import importlib
import json
import pkgutil
import queue
import re
import shutil
import subprocess
import sys
import threading
import zlib
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlparse

import pytest

import kornia_pnpnet

REPO = Path(__file__).resolve().parents[1]
DOCS = REPO / "docs"
PAGES = [DOCS / "index.md", *sorted((DOCS / "howto").glob("*.md"))]


def reference_modules():
    """Names of the modules that have a place in the reference."""
    text = "\n".join(page.read_text() for page in (DOCS / "api").glob("*.md"))
    return sorted(set(re.findall(r"automodule:: ([\w.]+)", text)))


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


BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)

# A page that opens all of the site's one after the other, as wide as a phone and as a desktop, and posts what is wrong.
# Furo's column of text scrolls in place of the page where that is narrow, so what holds the heading must not scroll.
OPENS_ALL = """<link rel="icon" href="data:,"><script>
async function open(page, width) {
  const frame = document.createElement("iframe");
  frame.style = `border: 0; width: ${width}px; height: 800px`;
  frame.src = `site/${page}`;
  const loaded = new Promise(done => frame.onload = done);
  document.body.append(frame);
  const late = new Promise(done => setTimeout(done, 20000, "late"));
  if (await Promise.race([loaded, late]) === "late") return [`${page} at ${width} px: does not load`];
  const shown = frame.contentDocument, pictures = [...shown.images];
  pictures.forEach(picture => picture.loading = "eager");
  await Promise.allSettled(pictures.map(picture => picture.decode()));
  await new Promise(done => setTimeout(done, 50));  // scripts go on
  const broken = pictures.filter(picture => !picture.complete || !picture.naturalWidth);
  const heading = shown.querySelector("h1, h2"), boxes = [];
  for (let box = heading; box; box = box.parentElement)
    if (box === shown.scrollingElement || getComputedStyle(box).overflowX !== "visible") boxes.push(box);
  const wrong = [
    ...broken.map(picture => `picture ${picture.getAttribute("src")} is broken`),
    ...boxes.filter(box => box.scrollWidth > box.clientWidth).map(box => `${box.scrollWidth} px are too wide`),
    ...(heading?.offsetHeight ? [] : ["no heading"]),
    ...(parseFloat(getComputedStyle(shown.body).fontSize) < 14 ? ["small letters"] : []),
  ];
  frame.remove();
  return wrong.map(what => `${page} at ${width} px: ${what}`);
}
async function openAll() {
  const wrong = [];
  for (const page of PAGES) for (const width of [390, 1280]) wrong.push(...await open(page, width));
  return wrong;
}
const post = wrong => fetch("wrong", {method: "POST", body: JSON.stringify(wrong)});
onload = () => openAll().then(post, error => post([String(error)]));
</script>"""


class Served(http.server.SimpleHTTPRequestHandler):
    """Serves files, keeps what was asked for and is not there, and takes one answer."""

    missing, answers = [], queue.Queue()

    def do_POST(self):
        self.answers.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        self.send_response(204)
        self.end_headers()

    def log_error(self, *args):
        self.missing.append(self.path)

    def log_request(self, *args):
        pass


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason=f"needs a browser on the PATH: one of {', '.join(BROWSERS)}")
def test_pages_look_right_in_a_browser(site, tmp_path):
    pages = sorted(str(page.relative_to(site)) for page in site.rglob("*.html"))
    pages[pages.index("search.html")] += "?q=pose"  # without a question it is empty
    (tmp_path / "site").symlink_to(site)
    (tmp_path / "all.html").write_text(OPENS_ALL.replace("PAGES", json.dumps(pages)))
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
    command.append(f"--user-data-dir={tmp_path / 'profile'}")
    handler = functools.partial(Served, directory=tmp_path)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, (tmp_path / "log").open("w") as log:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser = subprocess.Popen([*command, f"http://127.0.0.1:{server.server_port}/all.html"], stderr=log)
        try:
            wrong = Served.answers.get(timeout=300)
        finally:
            browser.terminate()
            browser.wait()
            server.shutdown()
    said = [line for line in (tmp_path / "log").read_text().splitlines() if ":CONSOLE" in line]
    assert wrong + Served.missing + said == []


@pytest.mark.slow
def test_every_public_name_is_in_the_reference(site):
    lines = zlib.decompress((site / "objects.inv").read_bytes().split(b"\n", 4)[4]).decode().splitlines()
    documented = {line.split()[0] for line in lines}
    modules = reference_modules()
    wanted = [("kornia_pnpnet", name) for name in kornia_pnpnet.__all__]
    wanted += [(module, name) for module in modules for name in importlib.import_module(module).__all__]
    missing = {x for x in wanted if not any(y.startswith(f"{x[0]}.") and y.endswith(f".{x[1]}") for y in documented)}
    assert missing <= {("kornia_pnpnet", "__version__")}
    assert {f"kornia_pnpnet.{x.name}" for x in pkgutil.iter_modules(kornia_pnpnet.__path__)} - set(modules) <= INTERNAL


# How the package does what it does, and the command line, which has a page of its own.
INTERNAL = {
    f"kornia_pnpnet.{name}"
    for name in (
        "arguments",
        "checks",
        "choices",
        "cli",
        "compilation",
        "demo",
        "environment",
        "files",
        "pairs",
        "readers",
        "results",
    )
} | {"kornia_pnpnet.training.checkpoint", "kornia_pnpnet.core.linalg"}
