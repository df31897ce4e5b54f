"""Software versions and a description of the machine, for files of measured results."""

from __future__ import annotations

import datetime
import platform
import subprocess
import sys
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

#: Number of code changes that altered the poses, ``ok`` or ``probability`` of a solver. Raise the number with each such
#: change: a test then finds old results files. Files without a number were measured before the first change.
BEHAVIOUR = 8

# Git paths that affect measured results. A checkout counts as changed only if files at these paths changed.
_MEASURED = ("*.py", "kornia_pnpnet", "conf")
_PACKAGES = ("kornia_pnpnet", "torch", "kornia", "numpy", "opencv", "kornia_rs", "poselib", "pycolmap")
# Distributions of OpenCV on PyPI, the most common distribution first.
_OPENCV = ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python")


def environment() -> dict[str, Any]:
    """Describe the software and the machine of a measurement.

    Returns:
        ``versions`` by package (``None`` if not installed), ``python``, ``platform``, ``cpu``, ``threads`` of PyTorch,
        ``gpu`` (``None`` without a GPU), ``date`` in UTC, ``behaviour`` (``BEHAVIOUR``), and the git ``commit`` of the
        package (``None`` outside a checkout). A final ``+`` means changed Python files, weights or configurations.
    """
    return {
        "versions": {name: _version(name) for name in _PACKAGES},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": _cpu_name(),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "behaviour": BEHAVIOUR,
        "commit": _commit(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def peak_resident_bytes() -> int:
    """Return the peak resident memory of this process; 0 on Windows, where Python has no module ``resource``."""
    if sys.platform == "win32":
        return 0
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _version(package: str) -> str | None:
    for name in _OPENCV if package == "opencv" else (package,):
        with suppress(metadata.PackageNotFoundError):
            return metadata.version(name)
    return None


def _cpu_name() -> str:
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return platform.processor() or platform.machine()


def _commit() -> str | None:
    root = Path(__file__).resolve().parents[2]
    if (root / ".git").exists():
        git = ["git", "-C", str(root)]
        with suppress(OSError, subprocess.SubprocessError):
            quiet: dict[str, Any] = {"text": True, "stderr": subprocess.DEVNULL, "timeout": 10}
            head = subprocess.check_output([*git, "rev-parse", "HEAD"], **quiet).strip()
            changed = subprocess.check_output([*git, "diff", "--name-only", "HEAD", "--", *_MEASURED], **quiet)
            return head + "+" * bool(changed)
    return None
