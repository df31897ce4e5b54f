"""One contender in a process of its own: seconds of its first calls, and memory of a large call.

``python process.py '{"contender": "epnp-lm", "backward": false, "batches": [1000], "memory_batch": 0}'`` prints JSON.
The top of this file must not import PyTorch: the imports are timed.
"""

import json
import sys
import time
import warnings
from pathlib import Path
from typing import Any

# Batch sizes of the calls before the memory measurement: they do the work of first calls.
_WARM = (64, 65)


def main(request: dict[str, Any]) -> dict[str, Any]:
    """Measure one contender: imports, making it, two calls of each of the ``batches``, and memory.

    ``memory_batch`` is the batch size of the memory measurement, 0 for none.
    """
    clock = [time.perf_counter()]
    import torch  # noqa: F401

    clock.append(time.perf_counter())
    import kornia_pnpnet  # noqa: F401

    clock.append(time.perf_counter())
    from contenders import CONTENDERS, N, draw
    from harness import peak_bytes, threads

    start = time.perf_counter()
    contender = CONTENDERS[request["contender"]]()
    make_s = time.perf_counter() - start
    calls: list[dict[str, float]] = []
    memory = None

    def task(batch: int) -> Any:
        return contender.task(draw(N, batch), backward=request["backward"])

    with threads(1), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for batch in request["batches"]:
            made = task(batch)
            calls.append({"batch": batch, "first_s": made.seconds(), "second_s": made.seconds()})
        if request["memory_batch"]:
            for batch in _WARM:
                task(batch).seconds()
            made = task(request["memory_batch"])
            Path("/proc/self/clear_refs").write_text("5")  # Linux: the peak begins again at the present memory
            before = peak_bytes()
            made.seconds()
            memory = {"batch": request["memory_batch"], "before_bytes": before, "peak_bytes": peak_bytes()}
    ignored = DeprecationWarning | FutureWarning
    return {
        **{key: request[key] for key in ("contender", "backward")},
        **{"torch_s": clock[1] - clock[0], "package_s": clock[2] - clock[1], "make_s": make_s},
        **{"calls": calls, "memory": memory},
        "warnings": [str(entry.message) for entry in caught if not issubclass(entry.category, ignored)],
    }


if __name__ == "__main__":
    print(json.dumps(main(json.loads(sys.argv[1]))))
