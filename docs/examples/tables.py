"""Write the tables of ``README.md`` and ``clients.md`` from the results: ``python docs/examples/tables.py``."""

import json
import re
import sys
from pathlib import Path
from statistics import median

from jinja2 import Environment, FileSystemLoader

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))
from harness import foot

HERE = Path(__file__).resolve().parent
PAGES = ("README.md", "clients.md")


def page(name: str) -> str:
    """A page with its tables between the comments that name their files; macros of ``tables.md.jinja`` write them."""
    environment = Environment(loader=FileSystemLoader(HERE), trim_blocks=True, autoescape=False)
    environment.filters["median"] = median
    tables = environment.get_template("tables.md.jinja").module

    def table(match: re.Match[str]) -> str:
        results = json.loads((HERE / f"{match[2]}.json").read_text())
        made = foot(results["environment"])
        return f"{match[1]}\n\n{getattr(tables, match[2])(results)}\nMeasured: {made}.\n<!-- end -->"

    return re.sub(r"(<!-- (\w+)\.json, by tables\.py -->).*?<!-- end -->", table, (HERE / name).read_text(), flags=re.S)


if __name__ == "__main__":
    for name in PAGES:
        (HERE / name).write_text(page(name))
