"""Write what the Python of the pages prints: ``python docs/outputs.py``, or with the names of pages.

The ``python`` blocks of a page run one after the other. A ``text`` block below a ``python`` block holds what it prints.
"""

import contextlib
import io
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch

HERE = Path(__file__).resolve().parent
_BLOCK = re.compile(r"```python\n(?P<code>.*?)```\n(\n```text\n.*?```\n)?", flags=re.S)


def with_outputs(text: str) -> str:
    """A page whose Python ran, with what it printed. The code runs in the current folder."""
    torch.manual_seed(0)
    namespace: dict[str, Any] = {}

    def ran(match: re.Match[str]) -> str:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(match["code"], namespace)
        shown = f"\n```text\n{printed.getvalue()}```\n" if printed.getvalue() else ""
        return f"```python\n{match['code']}```\n{shown}"

    return _BLOCK.sub(ran, text)


if __name__ == "__main__":
    named = [Path(name).resolve() for name in sys.argv[1:]]
    for page in named or [HERE / "conventions.md", *sorted((HERE / "howto").glob("*.md"))]:
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            page.write_text(with_outputs(page.read_text()))
