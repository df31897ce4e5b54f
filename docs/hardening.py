"""What was thrown at the package, counted: ``python docs/hardening.py measure`` and ``... render``.

``measure`` runs the tests named in ``TESTS``, which count their cases, with ten times their examples, and writes
``results/hardening.json`` if all of them pass; ``render`` makes the page of it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.training.results import write_json

HERE = Path(__file__).resolve().parent
RESULTS, PAGE = HERE / "results" / "hardening.json", HERE / "hardening.md"
TESTS = "test_hardening.py", "test_hardening_parts.py", "test_hardening_tools.py", "test_interruptions.py"
#: Headings, and what the cases under them have in common.
PARTS = {
    "batches": (
        "Any batch, by solver",
        "Hypothesis draws batches of 0 to 4 problems of 4 to 12 pairs: float32 and float64, contiguous, transposed\n"
        "and strided, with and without gradients, masks and weights, worlds times 10⁻⁶ to 10⁶, each problem with one\n"
        "of the faults below. Poses, weights, costs and gradients are finite, rotations are rotations, what cannot\n"
        "have a pose is not `ok`.",
        "Solver | Batches",
    ),
    "problems": ("Their problems, by fault", "Of the batches above.", "Fault | Problems"),
    "calls": ("Other calls", "", "What, and what has to come of it | Cases"),
    "parts": (
        "Parts, metrics and losses",
        "The parts that solvers are made of, called by themselves, and what poses are judged by.",
        "What, and what has to come of it | Cases",
    ),
    "options": (
        "Options",
        "Up to two sound values are replaced: by numbers of any size, none, infinite, negative, or by any text. What\n"
        "can be made has to work, to finite results; the rest is refused with an error that says so.",
        "What | Works | Refused",
    ),
    "files": ("Files and arguments", "", "What, and what has to come of it | Cases"),
    "processes": ("Dying processes and full disks", "", "What, and what has to come of it | Cases"),
}


def measure() -> None:
    """Run the tests and count."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tally"
        tests = [str(HERE.parent / "tests" / name) for name in TESTS]
        command = [sys.executable, "-m", "pytest", "-q", "-n", "2", "-m", "", *tests]
        subprocess.run(
            command, check=True, cwd=HERE.parent, env={**os.environ, "PNPNET_TALLY": str(path), "PNPNET_EXAMPLES": "10"}
        )
        lines = Counter(path.read_text().splitlines())
    counts: dict[str, dict[str, int]] = {part: {} for part in PARTS}
    for line, count in lines.items():
        part, what = line.split("\t")
        counts[part][what] = count
    write_json(RESULTS, {"environment": environment(), "counts": counts})


def page(results: dict[str, Any]) -> str:
    """The page of the results."""
    counts = results["counts"]
    total = sum(count for part, found in counts.items() if part != "problems" for count in found.values())
    tests = ", ".join(f"`tests/{name}`" for name in TESTS)
    lines = [
        "# What it withstands",
        "",
        f"{total} cases, all as they should be, counted by the tests themselves ({tests};",
        "`make test-all` runs most with fewer cases). One of them asks that every public function and class is",
        "named in these, or listed with where it is called. Written by `docs/hardening.py` from",
        "`results/hardening.json`.",
    ]
    for part, (heading, text, head) in PARTS.items():
        lines += ["", f"## {heading}", ""] + ([text, ""] if text else []) + [f"| {head} |"]
        rows = sorted(counts[part].items())
        if part == "options":  # both outcomes of what was made in one row
            found = dict.fromkeys(what.rpartition(": ")[0] for what, _ in rows)
            rows = [
                (what, " | ".join(str(counts[part][f"{what}: {x}"]) for x in ("works", "refused"))) for what in found
            ]
        lines += ["|" + head.count("|") * "---|" + "---|", *(f"| {what} | {count} |" for what, count in rows)]
    made = results["environment"]
    lines += ["", f"Commit {made['commit']}, {made['cpu']}, torch {made['versions']['torch']}."]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure or render."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=("measure", "render"))
    if parser.parse_args().step == "measure":
        measure()
    PAGE.write_text(page(json.loads(RESULTS.read_text())))


if __name__ == "__main__":
    main()
