"""One contender in a process of its own: how long its first calls take, and how much memory a large one.

``python process.py '{"contender": "epnp", "backward": false, "batches": [1000], "memory_batch": 10000}'`` prints JSON.
What it imports at the top must import nothing heavy: the imports are what is timed first.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from pathlib import Path
from typing import Any

# Small batches of different sizes before the large one: whatever a first call does is done then.
_WARM = (64, 65)


def main(request: dict[str, Any]) -> dict[str, Any]:
    """What the request asks for.

    Args:
        request: ``contender``; ``backward``; ``batches``, each called twice, in this order; ``memory_batch``, whose
            memory is measured, or 0; ``device``.

    Returns:
        ``torch_s``, ``package_s`` (without PyTorch), ``make_s``; ``calls``, for each batch ``first_s`` and
        ``second_s``; ``memory``: ``before_bytes`` and ``peak_bytes`` of the process around the call, or ``None``;
        ``warnings`` that the first calls gave.
    """
    start = time.perf_counter()
    import torch  # noqa: F401

    torch_s = time.perf_counter() - start
    start = time.perf_counter()
    import kornia_pnpnet  # noqa: F401

    package_s = time.perf_counter() - start
    import settings
    from contenders import CONTENDERS, OURS
    from harness import peak_bytes, threads

    options = {"device": request["device"]} if request["contender"] in OURS else {}
    start = time.perf_counter()
    contender = CONTENDERS[request["contender"]](**options)
    make_s = time.perf_counter() - start
    calls: list[dict[str, float]] = []
    memory = None
    with threads(1), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for batch in request["batches"]:
            task = contender.task(settings.draw(settings.N, batch), backward=request["backward"])
            calls.append({"batch": batch, "first_s": task.seconds(), "second_s": task.seconds()})
        if request["memory_batch"]:
            for batch in _WARM:
                contender.task(settings.draw(settings.N, batch), backward=request["backward"]).seconds()
            task = contender.task(settings.draw(settings.N, request["memory_batch"]), backward=request["backward"])
            forget_peak()
            before = peak_bytes()
            task.seconds()
            memory = {"batch": request["memory_batch"], "before_bytes": before, "peak_bytes": peak_bytes()}
    return {
        "contender": request["contender"],
        "backward": request["backward"],
        "torch_s": torch_s,
        "package_s": package_s,
        "make_s": make_s,
        "calls": calls,
        "memory": memory,
        "warnings": [
            str(entry.message) for entry in caught if not issubclass(entry.category, DeprecationWarning | FutureWarning)
        ],
    }


def forget_peak() -> None:
    """Let the peak begin again at what the process holds now (Linux)."""
    Path("/proc/self/clear_refs").write_text("5")


if __name__ == "__main__":
    print(json.dumps(main(json.loads(sys.argv[1]))))
