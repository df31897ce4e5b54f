"""Cold start, the compiler's warm-up and peak memory, each in a process of its own."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from typing import Any

from contenders import PLAIN, TRAINED, WHOLE, Settings, make_contenders
from harness import HERE, run_child, say, target

# The first batch size shows the compiler's warm-up, the others whether another size compiles again.
_BATCHES = (1000, 999, 100, 10, 1)
_IMPORTS = 5  # processes; the median counts
COMPILED = f"{TRAINED} compiled"
COLD, CACHED, EAGER = "cold", "cached", "eager"


def measure_startup(settings: Settings) -> dict[str, Any]:
    """Start every contender alone, forward and with gradients, on one thread.

    Compiled contenders start with an empty cache of the compiler, and again with the cache of that first start.
    """
    contenders, skipped = make_contenders(settings)
    starts = []
    for name, contender in contenders.items():
        if name.startswith(PLAIN) and name != WHOLE:
            continue  # as TRAINED
        for backward in (False, True) if contender.differentiable and name != WHOLE else (False,):
            say(f"cold start: {name}{', backward' if backward else ''}")
            # A loop needs the memory of one problem.
            batch = 0 if contender.loops else settings.memory_batch
            request = {"contender": name, "backward": backward, "memory_batch": batch}
            starts += start(request, settings)
    imports = [import_seconds() for _ in range(_IMPORTS)]
    return {"starts": starts, "imports_s": imports, "skipped": skipped, "targets": targets(starts, imports)}


def import_seconds() -> float:
    """Seconds to import the package in a new process that has imported torch and kornia."""
    code = (
        "import time, torch, kornia; start = time.perf_counter(); import kornia_pnpnet; "
        "print(time.perf_counter() - start)"
    )
    return float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)


def start(request: Mapping[str, Any], settings: Settings) -> list[dict[str, Any]]:
    """Start a contender in processes of its own, one after the other. Only the last process measures memory."""
    if "compiled" not in request["contender"]:
        return [{**measure({**request, "batches": [1]}), "cache": EAGER}]
    batches = [min(size, settings.problems) for size in _BATCHES]
    found = []
    with tempfile.TemporaryDirectory(prefix="inductor-") as folder:
        for cache in (COLD, CACHED):
            memory = request["memory_batch"] if cache == CACHED else 0
            wanted = {**request, "batches": batches, "memory_batch": memory}
            found.append({**measure(wanted, TORCHINDUCTOR_CACHE_DIR=folder), "cache": cache})
    return found


def measure(request: Mapping[str, Any], **environment: str) -> dict[str, Any]:
    """Run ``process.py``."""
    found: dict[str, Any] = run_child(HERE / "process.py", json.dumps(request), OMP_NUM_THREADS="1", **environment)
    return found


def targets(starts: Sequence[Mapping[str, Any]], imports: Sequence[float]) -> list[dict[str, Any]]:
    """Most seconds of the import, and of making a compiled solver with its first call."""
    what = "`import kornia_pnpnet` after torch and kornia"
    found = [target(what, statistics.median(imports), 0.5, unit="s", at_most=True)] if imports else []
    compiled = [entry for entry in starts if entry["contender"] == COMPILED]
    if any("compil" in text for entry in compiled for text in entry["warnings"]):
        return found  # there is no compiler
    for entry in sorted(compiled, key=lambda entry: (entry["backward"], entry["cache"] == CACHED)):
        most, mode = 20.0 if entry["cache"] == COLD else 5.0, "forward+backward" if entry["backward"] else "forward"
        what, first = f"`{COMPILED}`, first call, {mode}, {entry['cache']}", entry["calls"][0]["first_s"]
        found.append(target(what, entry["make_s"] + first, most, unit="s", at_most=True))
    return found
