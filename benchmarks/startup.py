"""Cold start, the compiler's warm-up and peak memory, each in a process of its own."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from typing import Any

from contenders import ONE, PLAIN, TRAINED, WHOLE
from harness import HERE, run_child, say, target
from settings import Settings, make_contenders

__all__ = ["measure_startup", "targets"]

# The first is the compiler's warm-up; the others show that another batch size does not compile everything anew.
_BATCHES = (1000, 999, 100, 10, 1)
_IMPORTS = 5
COMPILED = f"{TRAINED} compiled"
COLD, CACHED, EAGER = "cold", "cached", "eager"


def measure_startup(settings: Settings) -> dict[str, Any]:
    """Start every contender alone, forward and with gradients, on one thread.

    Compiled ones start with an empty cache of the compiler and then again with the one that the first left.

    Returns:
        ``starts``, one for each process: what ``process.py`` says, and the ``cache``; ``skipped`` and ``targets``.
    """
    made = make_contenders(settings)
    starts = []
    for name, contender in made.contenders.items():
        if name.startswith((PLAIN, ONE)) and name != WHOLE:
            continue  # as TRAINED
        for backward in (False, True) if contender.differentiable and name != WHOLE else (False,):
            say(f"cold start: {name}{', backward' if backward else ''}")
            request: dict[str, Any] = {"contender": name, "backward": backward, "device": settings.device}
            # A loop needs the memory of one problem, and PyPose's takes minutes for so many.
            batch = 0 if contender.loops else settings.memory_batch
            starts += start({**request, "memory_batch": batch}, settings)
    imports = [import_seconds() for _ in range(_IMPORTS)]
    return {"starts": starts, "imports_s": imports, "skipped": made.skipped, "targets": targets(starts, imports)}


def import_seconds() -> float:
    """Seconds that importing the package takes where torch and kornia are imported already, in a new process."""
    code = (
        "import time, torch, kornia; start = time.perf_counter(); import kornia_pnpnet; "
        "print(time.perf_counter() - start)"
    )
    return float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)


def start(request: Mapping[str, Any], settings: Settings) -> list[dict[str, Any]]:
    """Start a contender in processes of its own, one after the other. Only the last measures memory."""
    if "compiled" not in request["contender"]:
        return [{**measure({**request, "batches": [1]}), "cache": EAGER}]
    batches = [min(size, settings.problems) for size in _BATCHES]
    found = []
    for run in range(settings.startup_runs if request["contender"] == COMPILED else 1):
        with tempfile.TemporaryDirectory(prefix="inductor-") as folder:
            for cache in (COLD, CACHED):
                memory = request["memory_batch"] if run == 0 and cache == CACHED else 0
                wanted = {**request, "batches": batches, "memory_batch": memory}
                found.append({**measure(wanted, TORCHINDUCTOR_CACHE_DIR=folder), "cache": cache})
    return found


def measure(request: Mapping[str, Any], **environment: str) -> dict[str, Any]:
    """What ``process.py`` says."""
    found: dict[str, Any] = run_child(HERE / "process.py", json.dumps(request), OMP_NUM_THREADS="1", **environment)
    return found


def warm_ups(starts: Sequence[Mapping[str, Any]], name: str, backward: bool, cache: str) -> list[float]:
    """Seconds of the first call of a contender, one for each run."""
    return [
        entry["make_s"] + entry["calls"][0]["first_s"]
        for entry in starts
        if (entry["contender"], entry["backward"], entry["cache"]) == (name, backward, cache)
    ]


def targets(starts: Sequence[Mapping[str, Any]], imports: Sequence[float]) -> list[dict[str, Any]]:
    """How long the import may take, and making a compiled solver and its first call."""
    what = "`import kornia_pnpnet` after torch and kornia"
    found = [target(what, statistics.median(imports), 0.5, unit="s", at_most=True)] if imports else []
    for backward in (False, True):
        for cache, most in ((COLD, 20.0), (CACHED, 5.0)):
            times = warm_ups(starts, COMPILED, backward, cache)
            compiled = not any(
                "compil" in text for entry in starts if entry["contender"] == COMPILED for text in entry["warnings"]
            )
            if times and compiled:
                what = f"`{COMPILED}`, first call, {'forward+backward' if backward else 'forward'}, {cache}"
                found.append(target(what, statistics.median(times), most, unit="s", at_most=True))
    return found
