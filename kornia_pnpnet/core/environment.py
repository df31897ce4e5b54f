"""Versions and machine, for files that hold measured numbers."""

from __future__ import annotations

import datetime
import platform
import subprocess
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

__all__ = ["environment"]

# Distributions that contain each package, the most common first.
_OPENCV = tuple(f"opencv-{kind}" for kind in ("python-headless", "python", "contrib-python-headless", "contrib-python"))
_PACKAGES: dict[str, tuple[str, ...]] = {name: (name,) for name in ("kornia_pnpnet", "torch", "kornia", "numpy")}
_PACKAGES |= {"opencv": _OPENCV, **{name: (name,) for name in ("kornia_rs", "poselib", "pycolmap")}}


def environment() -> dict[str, Any]:
    """Describe the versions and the machine that numbers are measured with.

    Returns:
        ``versions`` of the packages (``None``: not installed), ``python``, ``platform``, ``cpu``, ``threads`` of
        PyTorch, ``gpu``, ``commit`` of the checkout that the package runs from (``+`` at the end: with changed files;
        ``None``: outside a checkout) and the ``date`` in UTC.
    """
    return {
        "versions": {name: _version(*distributions) for name, distributions in _PACKAGES.items()},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": _cpu_name(),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "commit": _commit(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def _version(*distributions: str) -> str | None:
    for name in distributions:
        with suppress(metadata.PackageNotFoundError):
            return metadata.version(name)
    return None


def _cpu_name() -> str:
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return platform.processor() or platform.machine()


def _commit() -> str | None:
    """The commit of the checkout that this file belongs to, not of a checkout with an installed copy."""
    root = Path(__file__).resolve().parents[2]

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    with suppress(OSError, subprocess.SubprocessError):
        if Path(git("rev-parse", "--show-toplevel")).resolve() == root:
            changed = git("status", "--porcelain", "--untracked-files=no")
            return git("rev-parse", "HEAD") + ("+" if changed else "")
    return None
