"""The documentation: its Python prints what pages show, its examples run, links lead to places, the site fits."""

import html
import json
import re
import runpy
import shutil
import subprocess
import sys
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

import kornia_pnpnet
from kornia_pnpnet import Pose, create_solver
from kornia_pnpnet.data import SyntheticProblems

REPO = Path(__file__).resolve().parents[1]
DOCS = REPO / "docs"
EXAMPLES = DOCS / "examples"
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
FILES = [*(DOCS / f"{name}.md" for name in ("index", "solvers", "conventions")), *sorted((DOCS / "howto").glob("*.md"))]
PAGES = [pytest.param(x, id=x.stem, marks=[pytest.mark.slow] * (x.stem in ("compile", "export"))) for x in FILES]
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def test_all_files_name_the_same_version():
    version = kornia_pnpnet.__version__
    changelog, citation, readme = ((REPO / name).read_text() for name in ("CHANGELOG.md", "CITATION.cff", "README.md"))
    released = re.findall(r"^## \[(\d\S*)\] - \d{4}-\d\d-\d\d$", changelog, flags=re.M)
    assert released[0] == version
    assert f"\nversion: {version}\n" in citation
    assert f"version={{{version}}}" in readme


@pytest.mark.parametrize("page", PAGES)
def test_python_prints_what_the_page_shows(page, tmp_path, monkeypatch):
    """Numbers may differ a little: processors round differently."""
    monkeypatch.chdir(tmp_path)
    shown = page.read_text()
    printed = runpy.run_path(str(DOCS / "outputs.py"))["with_outputs"](shown)
    assert NUMBER.sub("#", printed).split() == NUMBER.sub("#", shown).split()
    for one, two in zip(NUMBER.findall(printed), NUMBER.findall(shown), strict=True):
        decimals = len(two.partition(".")[2])  # two units of the last digit
        assert float(one) == pytest.approx(float(two), rel=0.05, abs=2 * 10.0**-decimals if decimals else 0.05)


def test_python_of_the_readme_runs():
    names = {}
    for block in re.findall(r"```python\n(.*?)```", (REPO / "README.md").read_text(), flags=re.S):
        exec(block, names)
    assert all(names[name].ok.float().mean() > 0.9 for name in ("result", "robust"))
    for value in (names["img_points"].grad, names["refined"].matrix, names["covariance"][names["result"].ok]):
        assert value.isfinite().all()


@pytest.mark.parametrize("page", [*REPO.glob("*.md"), *sorted(DOCS.rglob("*.md"))], ids=lambda page: page.stem)
def test_links_between_files_are_there(page):
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text())
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


def run(tmp_path, name, *arguments, results=None):
    """The results of an example that writes to ``tmp_path``; its pictures are not empty."""
    subprocess.run([sys.executable, EXAMPLES / f"{name}.py", *map(str, arguments), "--out", tmp_path], check=True)
    assert all(picture.stat().st_size > 0 for picture in tmp_path.glob("*.png"))
    return json.loads((tmp_path / f"{results or name}.json").read_text())


def printed(tmp_path, name, *arguments):
    command = [sys.executable, EXAMPLES / f"{name}.py", *map(str, arguments)]
    return subprocess.run(command, check=True, cwd=tmp_path, stdout=subprocess.PIPE, text=True).stdout


def test_your_data_are_evaluated_with_and_without_padding_and_poselib(tmp_path, monkeypatch):
    (tmp_path / "poselib.py").write_text("raise ImportError")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    shown = printed(tmp_path, "evaluate_your_data")
    rows = {line.split()[0]: line for line in shown.splitlines()[2:]}
    assert "left out: " in rows["poselib"]
    assert all(float(rows[name].split()[1]) > 90.0 for name in ("pnpnet-set", "p3p-ransac"))
    arrays = dict(np.load(tmp_path / "outputs" / "examples" / "pairs.npz"))
    arrays["mask"] = np.arange(50) < np.arange(500)[:, None] % 20 + 30
    arrays["img_points"][~arrays["mask"]] = 0.0
    np.savez(tmp_path / "padded.npz", **arrays)
    assert "40 pairs on average" in printed(tmp_path, "evaluate_your_data", "padded.npz")


@pytest.mark.slow
def test_one_photo_is_localised(tmp_path):
    pytest.importorskip("cv2")
    shown = printed(tmp_path, "localise_photo")
    assert "ok: True" in shown
    assert float(re.search(r"([\d.]+) cm", shown)[1]) < 5.0


@pytest.mark.slow
def test_a_sweep_is_read_from_its_table_and_continued(tmp_path):
    pytest.importorskip("hydra")
    small = ("--updates", 2, "model.n=6", "validation_size=200")
    assert "best: model.n=6, validation_size=200, model.m=1" in printed(tmp_path, "sweep", *small, "model.m=1")
    assert "of the 1 others" in printed(tmp_path, "sweep", *small, "model.m=1,2")


@pytest.mark.slow
def test_keypoint_offsets_are_learned_through_the_pose(tmp_path):
    runs = run(tmp_path, "keypoint_offsets", "--steps", 300)["runs"]
    ours, *others = (found["error_px"] for found in runs.values())
    assert ours[-1] < ours[0] / 10
    assert all(errors[-1] > errors[0] / 2 for errors in others)
    assert runs["pnpnet-set"]["steps_without_finite_gradient"] == 0


@pytest.mark.slow
def test_a_boards_mislabelled_corners_do_not_matter(tmp_path):
    rows = run(tmp_path, "fiducial_board", "--frames", 20)["runs"]["pnpnet-set"].values()
    assert all(row["within_10_mm"] == 1.0 and row["median_mm"] < 2.0 for row in rows)


@pytest.mark.slow
@pytest.mark.parametrize(("references", "queries"), [(14, 4), (15, 0)])
def test_queries_of_a_folder_and_a_model_are_localised(tmp_path, references, queries):
    """The queries are the images without points, or every fifth image where all have points."""
    scene = pytest.importorskip("rendered_hall").make_scene(tmp_path / "hall", references, queries)
    results = run(tmp_path, "localiser", "--images", scene / "images", "--model", scene / "sparse")
    assert len(results["images"]) == (queries or references // 5)
    ours, *_ = results["solvers"].values()
    assert ours["recall"][1] == 1.0  # 0.25 m, 2 degrees
    assert all(row["outliers"] < row["outliers_of_all"] for row in results["images"])


def test_disk_and_lightglue_fit_the_localiser(monkeypatch):
    """An untrained network and a matcher of nearest neighbours, because the weights would be downloaded."""
    pytest.importorskip("sklearn")
    import localiser
    from kornia.feature import match_mnn

    monkeypatch.setattr(localiser.DISK, "from_pretrained", lambda checkpoint: localiser.DISK().eval())
    monkeypatch.setattr(localiser, "LightGlueMatcher", lambda name: lambda a, b, *lafs_and_sizes: match_mnn(a, b))
    detector = localiser.DiskLightGlue(50)
    with torch.no_grad():
        lafs, descriptors = detector.detect(torch.rand(1, 3, 90, 120))
    assert 0 < len(descriptors) <= 50
    pose = Pose(torch.eye(3).double(), torch.zeros(3).double())
    pixels = lafs[0, :, :, 2].double()
    points = torch.cat((pixels, torch.ones_like(pixels[:, :1])), 1)
    photo = localiser.Photo("", (90, 120), torch.eye(3).double(), pose, lafs, descriptors, pixels, points)
    found = localiser.match(photo, [photo, photo], detector)
    assert len(found.scores) == 2 * len(pixels)
    assert (localiser.errors_px(found, photo) == 0).all()


def test_a_server_solves_waiting_problems_of_any_size_together():
    import serve

    problems = [SyntheticProblems(n=n, batch_size=1, seed=n).batch(0)[:3] for n in (6, 9, 20, 50)] * 4
    pairs, calls, solver = [[x[0] for x in p] for p in problems], [], create_solver("epnp-lm")

    def solve(world, *inputs, **options):
        calls.append(len(world))
        return solver(world, *inputs, **options)

    server = serve.Server(solve)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda x: server(*x), pairs))
    assert sum(calls) == len(pairs) > len(calls)
    for result, inputs in zip(found, pairs, strict=True):
        torch.testing.assert_close(result.translation, solver(*inputs).translation, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_priors_help_to_track_with_few_pairs(tmp_path):
    sequence = pytest.importorskip("rendered_hall").write_sequence(tmp_path / "walk", 30)
    results = run(tmp_path, "tracking", "--sequence", sequence, "--intrinsics", 500, 500, 320, 240)
    assert results["frames"] == 28
    assert all(found["right"] == 1.0 for found in results["runs"]["100"].values())
    alone, *known = (found["right"] for found in results["runs"]["4"].values())
    assert all(right > alone for right in known)


@pytest.mark.slow
def test_images_become_poses_end_to_end_and_networks_predict_each_kind_of_noise(tmp_path):
    few = ("--seeds", 1, "--batches", 1, "--updates", 60)
    found = run(tmp_path, "keypoint_pipeline", *few)["seeds"]["0"]
    losses = found["keypoints first"]["curves"]["keypoint_loss"]
    assert losses[-1] < 0.9 * losses[0]
    results = run(tmp_path, "keypoint_pipeline", *few, "--covariances", results="keypoint_covariances")
    _, *kinds = results["seeds"]["0"].values()
    assert len(kinds) == 3
    assert all(0.0 < x["mean_distance"] <= 1.0 for x in (found["end to end"], *kinds))


@pytest.mark.slow
def test_an_incremental_map_registers_its_images(tmp_path):
    theirs, ours = run(tmp_path, "incremental_map", "--scenes", 4)["runs"].values()
    assert ours["5%"]["within_1_deg"] > 0.7  # the map drifts without bundle adjustment
    assert ours["20%"]["within_1_deg"] > 2.0 * theirs["20%"]["within_1_deg"]


@pytest.mark.slow
def test_a_pose_network_learns_from_nothing(tmp_path):
    start, *_, end = run(tmp_path, "pose_network", "--steps", 100, "--seeds", 1)["curves"][0]
    assert start["rotation_deg"] > 60.0
    assert start["ok"] == 0.0
    assert end["rotation_deg"] < 30.0
    assert end["pixels"] < 0.5 * start["pixels"]


def test_the_tables_of_the_page_are_of_the_results():
    made = runpy.run_path(str(EXAMPLES / "tables.py"))
    for name in made["PAGES"]:
        assert made["page"](name) == (EXAMPLES / name).read_text()


def test_keypoints_are_visible_where_nothing_is_before_them():
    import keypoint_pipeline as pipeline

    pose = pipeline.draw(3, 0).pose
    eye = -(pose.translation[:, None] @ pose.rotation)
    rays = pipeline.KEYPOINTS - eye  # (B, 14, 3), hit the box first where they meet its slabs
    first = ((-pipeline.HALF * rays.sign() - eye) / rays).amax(-1) > 1.0 - 1e-4
    assert (first == pipeline.outside(pose)).all()
    assert 0 < first.sum() < first.numel()
