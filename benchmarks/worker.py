"""A process that times contenders of another version of the package: ``PYTHONPATH=<its folder> python worker.py``.

It reads one request a line from standard input and writes one answer a line, both JSON. It is kept alive so that its
calls take turns with those of others. See :class:`versions.Worker`.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import torch
from contenders import CONTENDERS
from tasks import Contender, Task

from kornia_pnpnet.types import Pose, Problems


def load_problems(path: str) -> Problems:
    """What :func:`versions.save_problems` wrote."""
    world, img, intrinsics, rotation, translation, inliers = torch.load(path, weights_only=True)
    return Problems(world, img, intrinsics, Pose(rotation, translation), inliers)


def main() -> None:
    """Answer until standard input ends."""
    answers, sys.stdout = sys.stdout, sys.stderr  # nothing else may come between the answers
    made: dict[str, Contender] = {}
    task: Task | None = None
    for line in sys.stdin:
        request: dict[str, Any] = json.loads(line)
        answer: Any = None
        match request["do"]:
            case "threads":
                torch.set_num_threads(request["count"])
            case "task":
                name = request["contender"]
                made[name] = made.get(name) or CONTENDERS[name]()
                task = made[name].task(load_problems(request["path"]), backward=request["backward"])
            case "seconds" if task is not None:
                answer = task.seconds(request["times"])
            case "success" if task is not None:
                answer = task.success()._asdict()
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
