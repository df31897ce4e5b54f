"""``docs/performance.md`` and its pictures, from the results files: every number of the page comes from them."""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from contenders import COARSE_ANGLE_DEG, COARSE_SHIFT
from harness import HERE
from startup import EAGER
from throughput import BACKWARD, FORWARD
from versions import contender_name, load_versions

from kornia_pnpnet.files import atomic_open
from kornia_pnpnet.metrics import SuccessRate

__all__ = ["OUTCOMES", "PAGE", "PARTS", "page", "render"]

PAGE = HERE.parent / "docs" / "performance.md"
PARTS = ("engine", "throughput", "latency", "startup")
#: What a version is measured by: the contender, the mode and the batch, by the key of its prediction.
OUTCOMES: dict[str, tuple[str, str, int]] = {
    f"{base}{what}": (base, mode, batch)
    for base in ("refinement", "pnpnet-n9")
    for what, mode, batch in (("", FORWARD, 1000), (" forward+backward", BACKWARD, 1000), (" alone", FORWARD, 1))
}

_TEXT = """\
# Performance

Written by `benchmarks/performance.py render` from the results files in [benchmarks](../benchmarks/README.md); no number
here is typed but those of predictions, which were made before. {machine}

Contenders: `pnpnet-n9` is the whole solver with checks and normalisation, `refinement` its {m} iterations of robust
Levenberg–Marquardt alone, on normalised pairs and from a pose {angle:g}° and {shift:g} % of the distance off; the
others of ours are whole solvers. All of ours are in float32, compiled ones by `solver.compile()`. `opencv-*`,
`poselib` and `pycolmap` are the libraries' calls for one problem after the other, `kornia-dlt` is `solve_pnp_dlt`.
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

A third of the pairs is mismatched at every n; batches of {batch}. Curves end where a call would take more than
{call_s:g} s.

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
_GPU = """\
The floor of one refinement of {m} iterations at n = {n}: {bytes:,.0f} bytes to read and write once, and {flops:,.0f}
operations. An {name} moves {bandwidth:.1f} TB/s and computes {compute:.0f} Tflop/s in float32: at most {by_bytes:.1e}
refinements a second by the first and {by_flops:.1e} by the second.
"""
_NO_GPU = """\
**No GPU was lent to this project's machine, so nothing here was measured on one.** `benchmarks/performance.py measure
--device cuda --parts throughput` measures it where there is one, and this section then has the figures."""


def three_digits(value: float) -> str:
    """Three significant digits, never an exponent."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:#.3g}".rstrip(".")


def table(head: Sequence[str], rows: Iterable[Sequence[str]], *, left: int = 1) -> str:
    """A Markdown table; columns after the first ones are aligned to the right."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * left + "---:|" * (len(head) - left)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def names(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Contenders in the order in which they come."""
    return list(dict.fromkeys(row["contender"] for row in rows))


def machine(results: Mapping[str, Mapping[str, Any]]) -> str:
    """What the numbers were made with and on."""
    made = results["throughput"]["environment"]
    known = made["commit"] or "unknown"
    commit = known[:9] + ("+ (with changes)" if known.endswith("+") else "")
    versions = ", ".join(f"{name} {version}" for name, version in made["versions"].items() if version)
    loads = ", ".join(
        f"{part} {before:.1f} before and {after:.1f} after"
        for part, (before, after) in ((part, results[part]["load_average"]) for part in PARTS)
    )
    return (
        f"{made['cpu']}, {made['date'][:10]}, commit {commit}, {versions}. Load average: "
        f"{loads}; well above the number of threads, something else ran and times are not to be trusted."
    )


def targets_table(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Every target beside what was measured."""
    lines = []
    for part in ("throughput", "latency", "startup"):
        for entry in results[part]["targets"]:
            bound, unit = "at most" if entry["at_most"] else "at least", f" {entry['unit']}".rstrip()
            wanted = f"{bound} {entry['target']:g}{unit}"
            verdict = "met" if entry["met"] else "**missed**"
            lines.append((entry["what"], wanted, f"{three_digits(entry['measured'])}{unit}", verdict))
    return table(("What", "Wanted", "Measured", "Verdict"), lines)


def times(rows: Iterable[Mapping[str, Any]], **wanted: Any) -> dict[str, Mapping[str, Any]]:
    """Rows by contender, of those that have these values."""
    return {row["contender"]: row for row in rows if all(row[key] == value for key, value in wanted.items())}


def throughput_table(results: Mapping[str, Any], batch: int) -> str:
    """One batch on one thread and two, forward and with gradients."""
    rows = [row for row in results["rows"] if (row["n"], row["batch"]) == (9, batch)]
    columns = [times(rows, threads=count, mode=mode) for mode in (FORWARD, BACKWARD) for count in (1, 2)]
    head = ("Contender", "one thread", "two", "forward+backward, one", "two", "success (%)")
    lines = []
    for name in names(rows):
        there = [column.get(name) for column in columns]
        cells = [three_digits(row["median_us"]) if row else "–" for row in there]
        rate = next(row["success"] for row in there if row)
        lines.append((f"`{name}`", *cells, percent(rate)))
    return table(head, lines)


def percent(rate: Mapping[str, Any]) -> str:
    """Success with its interval, without the sign."""
    return str(SuccessRate(**rate)).replace(" %", "")


def latency_table(results: Mapping[str, Any]) -> str:
    """The distributions on one thread, and the median on two."""
    one, two = (times(results["rows"], threads=count) for count in (1, 2))
    head = (
        "Contender",
        "median (ms)",
        "90 %",
        "99 %",
        "largest",
        "99 % by median",
        "median, two threads",
        "success (%)",
    )
    lines = []
    for name, row in one.items():
        cells = [three_digits(row[key] / 1e3) for key in ("median_us", "p90_us", "p99_us", "max_us")]
        other = three_digits(two[name]["median_us"] / 1e3) if name in two else "–"
        lines.append((f"`{name}`", *cells, f"{row['p99_us'] / row['median_us']:.2f}", other, percent(row["success"])))
    return table(head, lines)


def startup_table(results: Mapping[str, Any]) -> str:
    """Cold starts, a line for each contender, mode and cache."""
    groups: dict[tuple[str, bool, str], list[Mapping[str, Any]]] = {}
    for entry in results["starts"]:
        if entry["backward"] and entry["cache"] == EAGER:
            continue  # as without gradients
        groups.setdefault((entry["contender"], entry["backward"], entry["cache"]), []).append(entry)
    lines = []
    for (name, backward, cache), entries in groups.items():
        imports = statistics.median(entry["torch_s"] + entry["package_s"] for entry in entries)
        first = statistics.median(entry["make_s"] + entry["calls"][0]["first_s"] for entry in entries)
        second = statistics.median(entry["calls"][0]["second_s"] for entry in entries)
        later = statistics.median(sum(call["first_s"] for call in entry["calls"][1:]) for entry in entries)
        kind = ", ".join(([BACKWARD] if backward else []) + ([] if cache == EAGER else [cache]))
        shown = three_digits(later) if len(entries[0]["calls"]) > 1 else "–"
        cells = [three_digits(imports), three_digits(first), three_digits(1e3 * second), shown]
        lines.append((f"`{name}`" + (f", {kind}" if kind else ""), *cells))
    head = ("Contender", "import (s)", "first call (s)", "second call (ms)", "next batch sizes (s)")
    return table(head, lines)


def memory_table(results: Mapping[str, Any]) -> str:
    """What calls add to the peak."""
    found: dict[str, dict[bool, str]] = {}
    for entry in results["starts"]:
        if entry["memory"] is None:
            continue
        added = (entry["memory"]["peak_bytes"] - entry["memory"]["before_bytes"]) / 2**20
        found.setdefault(entry["contender"], {})[entry["backward"]] = three_digits(added)
    lines = [(f"`{name}`", cells.get(False, "–"), cells.get(True, "–")) for name, cells in found.items()]
    return table(("Contender", "forward (MiB)", "forward+backward (MiB)"), lines)


def versions_table(results: Mapping[str, Any], versions: Sequence[Mapping[str, Any]]) -> str:
    """What was changed, what was predicted and what came out."""
    heads = {
        f"{base}{what}": f"`{base}`, {title}"
        for base in ("refinement", "pnpnet-n9")
        for what, title in (("", "B = 1000"), (" forward+backward", "forward+backward"), (" alone", "B = 1"))
    }
    lines = []
    for version in versions:
        cells = []
        for key, (base, mode, batch) in OUTCOMES.items():
            row = times(results["rows"], threads=1, n=9, mode=mode, batch=batch).get(
                contender_name(base, dict(version))
            )
            predicted = version["predicted"].get(key)
            expected = "" if predicted is None else f" ({three_digits(predicted)})"
            cells.append((three_digits(row["median_us"]) if row else "–") + expected)
        commit = f" `{version['commit']}`" if version["commit"] else ""
        lines.append((f"**{version['version']}**{commit}: {version['text']}", *cells))
    return table(("Version (µs per problem)", *(heads[key] for key in OUTCOMES)), lines)


def gpu_text(engine: Mapping[str, Any], measured: Mapping[str, Any] | None) -> str:
    """The floor, and what was reached."""
    gpu = engine["gpu"]
    text = _GPU.format(
        m=engine["m"],
        n=engine["n"],
        bytes=engine["floor_bytes"]["solve"],
        flops=engine["solve_flops"],
        name=gpu["name"],
        bandwidth=gpu["bytes_per_second"] / 1e12,
        compute=gpu["flops_per_second"] / 1e12,
        by_bytes=gpu["solves_per_second_by_bytes"],
        by_flops=gpu["solves_per_second_by_operations"],
    )
    if measured is None:
        return f"{text}\n{_NO_GPU}"
    rows = [row for row in measured["rows"] if (row["threads"], row["n"], row["mode"]) == (1, 9, FORWARD)]
    lines = []
    for name in names(rows):
        best = min((row for row in rows if row["contender"] == name), key=lambda row: row["median_us"])
        reached = 1e6 / best["median_us"]
        share = 100 * reached / gpu["solves_per_second_by_bytes"]
        lines.append((f"`{name}`", f"{best['batch']}", f"{reached:.2e}", f"{share:.3g}", percent(best["success"])))
    head = ("Contender", "best batch", "solves a second", "share of the floor's (%)", "success (%)")
    return f"{text}\nMeasured on {measured['environment']['gpu']}:\n\n{table(head, lines)}"


def skipped_list(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Why something has no number, each reason once."""
    found: dict[str, None] = {}
    for part in ("throughput", "latency", "startup"):
        for entry in results[part]["skipped"]:
            place = ", ".join(f"{key} = {entry[key]}" for key in ("n", "batch") if key in entry)
            mode = f", {entry['mode']}" if entry.get("mode") == BACKWARD else ""
            found[f"- `{entry['contender']}`{f' at {place}' if place else ''}{mode}: {entry['why']}."] = None
    return "\n".join(found) or "Nothing."


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
    from kornia_pnpnet.figures.performance import plot_latency, plot_times

    results, gpu = load_parts(folder)
    rows = [row for row in results["throughput"]["rows"] if row["threads"] == 1 and "@" not in row["contender"]]
    pictures = path.parent / path.stem
    batches = {mode: [row for row in rows if (row["mode"], row["n"]) == (mode, 9)] for mode in (FORWARD, BACKWARD)}
    size = results["throughput"]["settings"]["problems"]
    pairs = [row for row in rows if (row["mode"], row["batch"]) == (FORWARD, size)]
    plot_times(pictures / "batch.png", "n = 9, 3 mismatches, one thread", batches, against="batch", label="problems B")
    title = f"B = {size}, a third of the pairs mismatched, one thread"
    plot_times(pictures / "pairs.png", title, {FORWARD: pairs}, against="n", label="pairs n")
    alone = [row for row in results["latency"]["rows"] if row["threads"] == 1]
    plot_latency(pictures / "latency.png", "One problem at a time, n = 9, 0 to 3 wrong pairs, one thread", alone)
    with atomic_open(path, encoding="utf-8") as file:
        file.write(page(results, load_versions(), gpu))
