"""Earlier versions of the package, measured in the same run: each in a process of its own that takes turns."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from contenders import PLAIN
from tasks import Contender, Task

from kornia_pnpnet.metrics import SuccessRate
from kornia_pnpnet.types import Problems

__all__ = ["VERSIONS_FILE", "Version", "Worker", "contender_name", "load_versions"]

HERE = Path(__file__).resolve().parent
VERSIONS_FILE = HERE / "versions.json"


def load_versions() -> list[dict[str, Any]]:
    """The versions of the engine, oldest first.

    Each has a ``version`` (its name), ``commit`` (``null``: the code as it is), ``compiled`` (how: the end of a
    contender's name, or empty), ``text`` (what was changed) and ``predicted``: what was expected before it was written,
    in µs per problem by a key of ``tables.OUTCOMES``.
    """
    versions: list[dict[str, Any]] = json.loads(VERSIONS_FILE.read_text(encoding="utf-8"))
    return versions


def contender_name(base: str, version: dict[str, Any]) -> str:
    """What a version's contender is called: ``refinement compiled`` or ``refinement @1576bce``."""
    name = f"{base} {version['compiled']}" if version["compiled"] else base
    return f"{name} @{version['commit']}" if version["commit"] else name


def extract(commit: str, folder: Path) -> None:
    """Write the package as it was at a commit.

    Raises:
        ImportError: when there is no git, or no such commit.
    """
    archive = folder / "package.tar"
    command = ["git", "-C", str(HERE.parent), "archive", "--output", str(archive), commit, "kornia_pnpnet"]
    try:
        subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise ImportError(f"Version {commit} cannot be measured: {getattr(error, 'stderr', error)}".strip()) from error
    with tarfile.open(archive) as file:
        file.extractall(folder, filter="data")


def save_problems(problems: Problems, path: Path) -> None:
    """Write problems for a worker: an earlier version may draw others from the same seed."""
    torch.save([*problems[:3], *problems.pose, problems.inliers], path)


class Worker:
    """A process with the package of a commit. It is started by the first request.

    Raises:
        ImportError: when there is no such commit here.
    """

    def __init__(self, commit: str) -> None:
        self.temporary = tempfile.TemporaryDirectory(prefix="kornia_pnpnet-")
        self.folder = Path(self.temporary.name)
        try:
            extract(commit, self.folder)
        except ImportError:
            self.temporary.cleanup()
            raise
        self.process: subprocess.Popen[str] | None = None
        self.current: object = None

    def ask(self, **request: Any) -> Any:
        """One answer for one request."""
        if self.process is None:
            command = [sys.executable, str(HERE / "worker.py")]
            variables = {**os.environ, "PYTHONPATH": str(self.folder)}
            pipe = subprocess.PIPE
            self.process = subprocess.Popen(command, text=True, env=variables, stdin=pipe, stdout=pipe)
            self.ask(do="threads", count=torch.get_num_threads())
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(json.dumps(request), file=self.process.stdin, flush=True)
        answer = self.process.stdout.readline()
        if not answer:
            raise RuntimeError(f"The worker ended at {request}; what it said is above.")
        return json.loads(answer)

    def close(self) -> None:
        """End the process and remove its files."""
        if self.process is not None:
            self.process.communicate()  # its input ends, and so does it
        self.temporary.cleanup()


class VersionTask(Task):
    """A task in a worker. It is made anew there when the worker had another one in between."""

    def __init__(self, worker: Worker, contender: str, problems: Problems, backward: bool) -> None:
        super().__init__(lambda: None, lambda: problems.pose, problems)
        self.worker, self.path = worker, worker.folder / f"{id(self)}.pt"
        self.request = {"contender": contender, "path": str(self.path), "backward": backward}
        save_problems(problems, self.path)

    def ask(self, do: str, **more: Any) -> Any:
        """Ask about this task."""
        if self.worker.current is not self:
            self.worker.ask(do="task", **self.request)
            self.worker.current = self
            self.worker.ask(do="seconds", times=2)
        return self.worker.ask(do=do, **more)

    def seconds(self, times: int = 1) -> float:
        """As the worker measured them."""
        return float(self.ask("seconds", times=times))

    def success(self) -> SuccessRate:
        """As the worker counted."""
        return SuccessRate(**self.ask("success"))


class Version(Contender):
    """A contender of ``contenders.py`` with the package of a commit."""

    def __init__(self, contender: str, commit: str) -> None:
        self.contender = contender
        self.worker = Worker(commit)

    def takes(self, n: int) -> bool:
        """Versions are compared where the targets are."""
        return n == 9

    def task(self, problems: Problems, *, backward: bool = False) -> VersionTask:
        """The same task in the worker."""
        return VersionTask(self.worker, self.contender, problems, backward)

    def close(self) -> None:
        """End the worker."""
        self.worker.close()


def version_contenders() -> dict[str, Callable[[], Contender]]:
    """Contenders of the versions that have a commit, by name."""

    def maker(contender: str, commit: str) -> Callable[[], Contender]:
        return lambda: Version(contender, commit)

    return {
        contender_name(base, version): maker(contender_name(base, {**version, "commit": None}), version["commit"])
        for version in load_versions()
        if version["commit"]
        for base in (PLAIN, "refinement")
    }
