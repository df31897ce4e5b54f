"""The README's Python runs as it stands, and its links lead somewhere."""

import re
from pathlib import Path

import pytest
import torch

REPO = Path(__file__).resolve().parents[1]
PAGES = [REPO / "README.md", *sorted((REPO / "docs").rglob("*.md"))]


def test_python_blocks_run():
    text = (REPO / "README.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, flags=re.S)
    assert len(blocks) == 4
    namespace = {}
    for block in blocks:
        exec(block, namespace)
    assert namespace["result"].rotation.shape == (32, 3, 3)
    assert namespace["result"].ok.float().mean() > 0.5
    assert namespace["img_points"].grad.isfinite().all()
    assert torch.isfinite(namespace["refined"].matrix).all()
    assert namespace["robust"].ok.float().mean() > 0.9
    assert namespace["covariance"][namespace["told"].ok].isfinite().all()
    assert ((namespace["robust"].weights > 0) == namespace["problems"].inliers).float().mean() > 0.9


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPO)))
def test_links_between_files_are_there(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), target
