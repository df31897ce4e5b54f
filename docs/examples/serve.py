"""Serve single problems from several threads, one by one or gathered into batches: ``python docs/examples/serve.py``.

Clients call a server at the same time. ``Server`` solves all waiting problems in one call. Compares its latencies with
clients that call the solver or, with `--package`, a package themselves. Writes `serve.json` to `--out`.
"""

import itertools
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from threading import Thread, local
from typing import Any

import torch
from shared import command, write
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from kornia_pnpnet import PnPResult, create_solver
from kornia_pnpnet.core.trees import map_tensors
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.export import load_package

Solve = Callable[..., Any]


class Server:
    """Solves problems of any number of pairs. All problems that wait are solved in one call."""

    def __init__(self, solver: Solve, most: int = 64) -> None:
        self.solver, self.most = solver, most
        self.waiting: SimpleQueue[tuple[tuple[Tensor, ...], Future[PnPResult]]] = SimpleQueue()
        Thread(target=self._run, daemon=True).start()

    def __call__(self, world_points: Tensor, img_points: Tensor, intrinsics: Tensor) -> PnPResult:
        """Wait for the result of one problem in float32: (N, 3), (N, 2) and (3, 3)."""
        future: Future[PnPResult] = Future()
        pairs = len(world_points)
        if (world_points.shape, img_points.shape, intrinsics.shape) != ((pairs, 3), (pairs, 2), (3, 3)):
            raise ValueError("expected shapes (N, 3), (N, 2) and (3, 3)")
        self.waiting.put((tuple(x.to("cpu", torch.float32) for x in (world_points, img_points, intrinsics)), future))
        return future.result()

    def _run(self) -> None:
        torch.set_grad_enabled(False)
        while True:
            batch = [self.waiting.get()]
            while len(batch) < self.most and not self.waiting.empty():  # nobody else takes problems
                batch.append(self.waiting.get())
            try:
                world, img, cameras = zip(*(pairs for pairs, _ in batch), strict=True)
                mask = pad_sequence([torch.ones(len(x), dtype=torch.bool) for x in world], batch_first=True)
                padded = (pad_sequence(list(x), batch_first=True) for x in (world, img))
                results = self.solver(*padded, torch.stack(cameras), mask=mask)
                for i, (_, future) in enumerate(batch):
                    one, n = map_tensors(lambda x, i=i: x[i], results), len(world[i])
                    future.set_result(one._replace(weights=one.weights[:n], inliers=one.inliers[:n]))
            except Exception as error:  # no error may end the thread
                for _, future in batch:
                    future.set_exception(error)


class Packaged(local):
    """A package of one problem per call. Each thread loads it once."""

    def __init__(self, path: Path) -> None:
        self.solver = load_package(path)

    def __call__(self, *pairs: Tensor) -> Any:
        """Solve one problem."""
        return self.solver(*(x[None] for x in pairs))


def latencies(solve: Solve, problems: list[tuple[Tensor, ...]], clients: int) -> dict[str, float]:
    """Milliseconds of a call, and problems per second, with clients that call at the same time."""

    def call(pairs: tuple[Tensor, ...]) -> float:
        start = time.perf_counter()
        with torch.no_grad():
            solve(*pairs)
        return 1e3 * (time.perf_counter() - start)

    with ThreadPoolExecutor(clients) as pool:
        list(pool.map(call, problems[: 2 * clients]))
        start = time.perf_counter()
        times = torch.tensor(list(pool.map(call, problems)))
        per_second = len(problems) / (time.perf_counter() - start)
    levels = zip(("p50", "p90", "p99"), times.quantile(torch.tensor([0.5, 0.9, 0.99])).tolist(), strict=True)
    return {**dict(levels), "per_second": per_second}


def main() -> None:
    parser = command(__doc__, requests=256)
    parser.add_argument("--package", type=Path, help="of `pnpnet export set.pt2 --pairs 50 --batch 1`")
    options = parser.parse_args()
    p = SyntheticProblems(n=50, batch_size=options.requests, outliers=OutlierMix(max_ratio=0.4)).batch(0)
    problems, solver = list(zip(*p[:3], strict=True)), create_solver("pnpnet-set")
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    ways: dict[str, Solve] = {"solver": solver, "Server": Server(solver)}
    if options.package:
        ways["package"] = Packaged(options.package)
    for clients, (name, solve) in itertools.product((1, 4, 16), ways.items()):
        rows.append({"clients": clients, "solve": name, **latencies(solve, problems, clients)})
        print(rows[-1], flush=True)
    write(options.out / "serve.json", requests=options.requests, rows=rows)


if __name__ == "__main__":
    main()
