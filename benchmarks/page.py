"""``docs/performance.md`` and its pictures, from the results files: every number of the page comes from them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from contenders import ANY, ONE, PLAIN, TRAINED
from harness import HERE
from tables import (
    PARTS,
    gpu_text,
    latency_table,
    machine,
    memory_table,
    skipped_list,
    startup_table,
    targets_table,
    throughput_table,
    versions_table,
)
from tasks import COARSE_ANGLE_DEG, COARSE_SHIFT
from throughput import BACKWARD, FORWARD
from versions import load_versions

from kornia_pnpnet.core.files import atomic_open

__all__ = ["PAGE", "page", "render"]

PAGE = HERE.parent / "docs" / "performance.md"

_TEXT = """\
# Performance

Written by `benchmarks/performance.py render` from the results files in [benchmarks](../benchmarks/README.md); no number
here is typed but those of predictions, which were made before. {machine}

Contenders: `{trained}` is the whole solver as it is shipped, with checks and normalisation ({shipped}); `{one}` the
same from one guess for each problem; `{plain}` its network, one guess, and {m} iterations, which the times aimed at
were set for, with classical hyperparameters; `refinement` such {m} iterations of robust Levenberg–Marquardt alone, on
normalised pairs and from a pose {angle:g}° and {shift:g} % of the distance off.
`{any}` takes any number of pairs. The others of ours are whole solvers. All of ours are in float32, *compiled* by
`solver.compile()`, *compiled whole* by `solver.compile(whole=True)`; *ONNX* is the same exported for {n} pairs, under
ONNX Runtime, without PyTorch. `opencv-*`, `poselib` and `pycolmap` are the
libraries' calls for one problem after the
other, `kornia-dlt` is `solve_pnp_dlt`.
`pypose-lm` is `pypose.optim.LM` with a robust kernel on the same normalised pairs from the same start, as many
iterations, a few problems at once (its Jacobian is dense over all of them, so more at once take longer); it has no
gradient, so *forward+backward* adds one differentiable step at its result. `pypose-parts` is a batched loop of our own
from PyPose's Lie groups, reprojection error and linear solver with PyTorch's automatic differentiation, differentiated
through all iterations: the best that we know how to make of it. Success is beside every time, because a solver that
gives up early is fast: rotation error below 1°, translation error below 0.2, on problems that nothing was trained or
tuned on.

## Targets

{targets}

## {batch} problems at once

n = 9, 3 of the pairs mismatched. µs per problem, the median over rounds in which all take turns; backward: from the
poses to points, pixels and whatever is learned.

{throughput}

![Time against the batch](performance/batch.png)

![Time against the number of pairs](performance/pairs.png)

A third of the pairs is mismatched at every n; batches of {batch}, fewer where the picture says so. Curves end where a
call would take more than {call_s:g} s.

## One problem at a time

n = 9, none to 3 of the pairs wrong. {calls} calls of different problems, fewer where they take long, some of each
contender in turn. A fixed cost is the claim: the 99th percentile by the median tells. The picture leaves out the
slowest hundredth.

{latency}

![Distribution of the time of one problem](performance/latency.png)

## Cold start

Processes of their own, one thread; where there are several, medians. *Import* is PyTorch and this package; *first
call* includes making the solver, which imports a peer's library, and compiling; cold: with an empty cache of the
compiler, cached: with the one that the process before left. *Next batch sizes* are the first calls at other sizes,
{sizes}, together.

{startup}

## Memory

What one call with {memory_batch} problems of 9 pairs adds to the peak of a process of its own, beyond its inputs. Loops
over problems need next to nothing.

{memory}

## Engine

For each problem and iteration of the refinement, n = {n}: **{operations:,.0f} operations** ({flops:,.0f} with the
costs of [figure 1](results/README.md)) and **{iteration_bytes:,.0f} bytes** to read and write if an iteration is one
kernel, {fused_intensity:.3g} operations a byte. Eager mode moves {eager_bytes:,.0f} bytes in {kernels} kernels,
{excess:.0f} times as many: {intensity:.2g} operations a byte.

{versions}

In brackets: what was predicted before the version was written. Every version is measured in the same run as the others,
those with a commit from a copy of it in a process of its own.

## GPU

{gpu}

## What was left out

{skipped}
"""


def page(
    results: Mapping[str, Mapping[str, Any]],
    versions: Sequence[Mapping[str, Any]],
    measured_on_gpu: Mapping[str, Any] | None = None,
) -> str:
    """The page as Markdown.

    Args:
        results: by their names in ``PARTS``.
        versions: see :func:`versions.load_versions`.
        measured_on_gpu: the throughput there.
    """
    engine, settings = results["engine"], results["throughput"]["settings"]
    operations = sum(engine["operations"].values())
    lists: list[Any] = [entry["calls"] for entry in results["startup"]["starts"] if len(entry["calls"]) > 1]
    return _TEXT.format(
        machine=machine(results),
        trained=TRAINED,
        plain=PLAIN,
        one=ONE,
        any=ANY,
        shipped="{m} iterations, {views} views".format(**engine["shipped"]),
        m=engine["m"],
        n=engine["n"],
        angle=COARSE_ANGLE_DEG,
        shift=100 * COARSE_SHIFT,
        targets=targets_table(results),
        throughput=throughput_table(results["throughput"], settings["problems"]),
        batch=settings["problems"],
        call_s=settings["call_s"],
        calls=results["latency"]["settings"]["latency_calls"],
        latency=latency_table(results["latency"]),
        sizes=", ".join(str(call["batch"]) for call in lists[0][1:]) if lists else "none",
        startup=startup_table(results["startup"]),
        memory_batch=results["startup"]["settings"]["memory_batch"],
        memory=memory_table(results["startup"]),
        operations=operations,
        flops=engine["iteration_flops"],
        iteration_bytes=engine["floor_bytes"]["iteration"],
        eager_bytes=engine["iteration_bytes"],
        kernels=engine["iteration_kernels"],
        excess=engine["iteration_bytes"] / engine["floor_bytes"]["iteration"],
        intensity=operations / engine["iteration_bytes"],
        fused_intensity=operations / engine["floor_bytes"]["iteration"],
        versions=versions_table(results["throughput"], versions),
        gpu=gpu_text(engine, measured_on_gpu),
        skipped=skipped_list(results),
    )


def load_parts(folder: Path) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """The results files, and the one of a GPU if there is one."""
    results = {part: json.loads((folder / f"{part}.json").read_text(encoding="utf-8")) for part in PARTS}
    gpu = folder / "throughput_cuda.json"
    return results, json.loads(gpu.read_text(encoding="utf-8")) if gpu.exists() else None


def render(folder: Path, path: Path) -> None:
    """Write the page and its pictures from the results files of a folder."""
    from kornia_pnpnet.evaluation.figures.performance import plot_latency, plot_times

    results, gpu = load_parts(folder)
    rows = [row for row in results["throughput"]["rows"] if row["threads"] == 1 and "@" not in row["contender"]]
    pictures = path.parent / path.stem
    batches = {mode: [row for row in rows if (row["mode"], row["n"]) == (mode, 9)] for mode in (FORWARD, BACKWARD)}
    size = results["throughput"]["settings"]["problems"]
    pairs = [row for row in rows if row["mode"] == FORWARD and (row["batch"] == size or row["n"] != 9)]
    plot_times(pictures / "batch.png", "n = 9, 3 mismatches, one thread", batches, against="batch", label="problems B")
    fewer = "".join(f" ({b} at n = {n})" for n, b in sorted({(x["n"], x["batch"]) for x in pairs}) if b < size)
    title = f"B = {size}{fewer}, a third of the pairs mismatched, one thread"
    plot_times(pictures / "pairs.png", title, {FORWARD: pairs}, against="n", label="pairs n")
    alone = [row for row in results["latency"]["rows"] if row["threads"] == 1]
    plot_latency(pictures / "latency.png", "One problem at a time, n = 9, 0 to 3 wrong pairs, one thread", alone)
    with atomic_open(path, encoding="utf-8") as file:
        file.write(page(results, load_versions(), gpu))
