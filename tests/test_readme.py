"""The README's Python runs, and the links of all pages lead to files."""

import re
from pathlib import Path

import torch

REPO = Path(__file__).resolve().parents[1]
PAGES = [REPO / "README.md", *sorted((REPO / "docs").rglob("*.md"))]


def test_python_blocks_run():
    namespace = {}
    for block in re.findall(r"```python\n(.*?)```", (REPO / "README.md").read_text(), flags=re.S):
        exec(block, namespace)
    assert namespace["result"].ok.float().mean() > 0.9
    assert namespace["img_points"].grad.isfinite().all()
    assert torch.isfinite(namespace["refined"].matrix).all()
    assert namespace["robust"].ok.float().mean() > 0.9
    assert namespace["covariance"][namespace["result"].ok].isfinite().all()


def test_links_between_files_are_there():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            assert "://" in target or (page.parent / target).exists(), f"{page}: {target}"
