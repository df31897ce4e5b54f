"""The patch for Kornia beside ``solve_pnp_dlt`` and OpenCV: ``upstream.json``, and the tables of ``docs/upstream.md``.

    python benchmarks/upstream.py --out benchmarks/upstream.json

*Success.* Random cameras with fields of view of 18 to 100 degrees, 1 px of noise, outliers uniform in the image. A
problem is solved within 1 degree and 5 % of the median distance of the points. OpenCV's RANSAC (AP3P, at most 1000
iterations) has the same threshold as the patch, 3 px, and refines on its inliers.

*Descent.* 40 steps of Adam on the pixels through a solver, as in training: 12 pairs with 5 px of noise. The loss is the
squared chordal distance of the rotations plus the squared error of the position in median distances.

The patched function runs in float32 in calls of 100 problems, OpenCV problem by problem. Times are those of
one thread.
"""

import os
import re
import runpy
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from contenders import random_cameras, relative_errors
from harness import DOCS, Row, parser, pivot, recorded, render, say, seconds
from kornia.geometry import solve_pnp_dlt
from torch import Tensor

from kornia_pnpnet.core.files import write_json
from kornia_pnpnet.peers import OpenCVRansac
from kornia_pnpnet.result import Pose, Problems

PATCH = DOCS / "upstream" / "0001-Add-solve_pnp_robust.patch"
_FILE = "kornia/geometry/calibration/pnp_robust.py"
# Used for nothing else. The defaults of the patch come from the literature and round numbers; nothing was tuned.
SEED = 20_290_300
CELLS = ((6, 0.0), (9, 0.25), (30, 0.0), (30, 0.25), (30, 0.5), (100, 0.5), (100, 0.8))
THRESHOLD = 3.0
CALL, BATCHES = 100, (1, 10, 100, 1000)
STEPS, RATE = 40, 0.3

Solve = Callable[..., Tensor]


def patched() -> Solve:
    """The matrices (B, 3, 4) of ``solve_pnp_robust`` of the patch, run with the installed Kornia."""
    with tempfile.TemporaryDirectory() as folder:
        ceiling = {**os.environ, "GIT_CEILING_DIRECTORIES": str(Path(folder).parent)}
        subprocess.run(["git", "apply", f"--include={_FILE}", str(PATCH)], cwd=folder, env=ceiling, check=True)
        robust = runpy.run_path(str(Path(folder) / _FILE))["solve_pnp_robust"]
    return lambda *inputs, **options: robust(*inputs, **options)[0]


def _dlt(world_points: Tensor, img_points: Tensor, intrinsics: Tensor) -> Tensor:
    """``solve_pnp_dlt``, which raises for the whole batch: no problem of the batch is solved then."""
    try:
        return solve_pnp_dlt(world_points, img_points, intrinsics)
    except AssertionError:
        return torch.zeros(len(world_points), 3, 4)


def _errors(matrix: Tensor, problems: Problems) -> tuple[Tensor, Tensor]:
    """Rotation error in degrees and error of the position in median distances of the points, both (B,)."""
    matrix = matrix.to(problems.world_points)
    return relative_errors(Pose(matrix[..., :3], matrix[..., 3]), problems)


def _timed(solve: Solve, problems: Problems, call: int) -> tuple[Tensor, float]:
    """Poses (B, 3, 4) and µs per problem, in calls of ``call`` problems after one that is not timed."""
    inputs = [x.float() for x in problems[:3]]
    with torch.no_grad():
        solve(*(x[:call] for x in inputs))
        parts, found = [*zip(*(x.split(call) for x in inputs), strict=True)], list[Tensor]()
        us = 1e6 * seconds(lambda: found.extend(solve(*x) for x in parts))
    return torch.cat(found), us / len(inputs[0])


def _opencv(problems: Problems) -> tuple[Tensor, float]:
    """As :func:`_timed`, of OpenCV's calls alone, on arrays that are prepared."""
    solver = OpenCVRansac(threshold=THRESHOLD)
    solver(*(x[:1] for x in problems[:3]))  # not timed
    found = solver(*problems[:3])
    return found.matrix[:, :3], 1e6 * solver.library_s / len(found.ok)


def measure_success(count: int, cells: Sequence[tuple[int, float]] = CELLS) -> list[dict[str, Any]]:
    """Success, median rotation error and time by number of pairs and share of outliers."""
    robust = patched()
    solvers: dict[str, Solve] = {
        "solve_pnp_robust": robust,
        "solve_pnp_robust, n_samples=512": lambda *inputs: robust(*inputs, n_samples=512),
        "solve_pnp_dlt": _dlt,
    }
    rows = []
    for k, (n, share) in enumerate(cells):
        say(f"success, n = {n}, {share:.0%} outliers")
        problems = random_cameras(n, count, SEED + k, share)
        timed = {name: _timed(solve, problems, CALL) for name, solve in solvers.items()}
        for name, (found, us) in {**timed, "OpenCV RANSAC": _opencv(problems)}.items():
            turn, shift = _errors(found, problems)
            success = ((turn < 1.0) & (shift < 0.05)).double().mean().item()
            median = turn.median().item()
            rows.append({"n": n, "share": share, "solver": name, "success": success, "rotation_deg": median, "us": us})
    return rows


def measure_batches(batches: Sequence[int] = BATCHES) -> list[dict[str, Any]]:
    """Time per problem by batch size, with 30 pairs of which a quarter are outliers."""
    robust = patched()
    problems, rows = random_cameras(30, max(batches), SEED + 50, 0.25), list[dict[str, Any]]()
    opencv_us = _opencv(problems)[1]  # problem by problem, whatever the batch
    for batch in batches:
        say(f"batches of {batch}")
        rows.append({"batch": batch, "us": _timed(robust, problems, batch)[1], "opencv_us": opencv_us})
    return rows


def measure_descent(count: int, shares: Sequence[float] = (0.0, 0.25)) -> list[dict[str, Any]]:
    """Median loss before and after descending through a solver."""
    robust = patched()
    solvers: dict[str, Solve] = {
        "solve_pnp_robust": lambda *inputs: robust(*inputs, inl_th=4 * THRESHOLD),
        "solve_pnp_dlt": _dlt,
    }
    rows = []
    for k, share in enumerate(shares):
        say(f"descent, {share:.0%} outliers")
        problems = random_cameras(12, count, SEED + 60 + k, share, img_sigma=5.0)
        for name, solve in solvers.items():
            pixels = problems.img_points.clone().requires_grad_()
            descent = torch.optim.Adam([pixels], lr=RATE)
            losses = []
            for _ in range(STEPS):
                matrix = solve(problems.world_points, pixels, problems.intrinsics)
                chord = (matrix[..., :3] - problems.pose.rotation).square().sum((1, 2))
                loss = chord + _errors(matrix, problems)[1].square()
                descent.zero_grad()
                loss.sum().backward()
                descent.step()
                losses.append(loss.detach().median().item())
            rows.append({"share": share, "solver": name, "first": losses[0], "last": losses[-1]})
    return rows


def page(results: Row) -> str:
    """The tables of ``docs/upstream.md``."""
    names = list(dict.fromkeys(x["solver"] for x in results["success"]))
    title = {name: name if " " in name and "=" not in name else f"`{name}`" for name in names}
    success = [{**x, "title": title[x["solver"]]} for x in results["success"]]
    keys = {"pairs": "{n}", "outliers": "{share:.0%}"}

    def solved(row: Row) -> str:
        return f"{100 * row['success']:.1f} ({row['us']:,.0f})"

    table = pivot(success, keys, [*title.values()], solved, by="title")
    return render("upstream.md.jinja", results=results, steps=STEPS, success=table)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and write the file and the tables."""
    command = parser(__doc__)
    command.add_argument("--count", type=int, default=400, help="number of problems in a row")
    options = command.parse_args(arguments)

    def measure() -> dict[str, Any]:
        parts = {"success": measure_success(options.count), "batches": measure_batches()}
        return {**parts, "descent": measure_descent(CALL)}

    results = recorded(measure, count=options.count, seed=SEED)
    write_json(options.out, results)
    path = DOCS / "upstream.md"
    tables = f"<!-- measured -->\n\n{page(results)}\n<!-- end -->"
    text = re.sub(r"<!-- measured -->.*<!-- end -->", lambda _: tables, path.read_text(encoding="utf-8"), flags=re.S)
    path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
