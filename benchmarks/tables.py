"""The tables of ``docs/performance.md``: every number comes from the results files."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from contenders import PLAIN
from startup import EAGER
from throughput import BACKWARD, FORWARD
from versions import contender_name

from kornia_pnpnet.metrics import SuccessRate

__all__ = [
    "OUTCOMES",
    "PARTS",
    "gpu_text",
    "latency_table",
    "machine",
    "memory_table",
    "skipped_list",
    "startup_table",
    "targets_table",
    "throughput_table",
    "versions_table",
]

PARTS = ("engine", "throughput", "latency", "startup")
#: What a version is measured by: the contender, the mode and the batch, by the key of its prediction.
OUTCOMES: dict[str, tuple[str, str, int]] = {
    f"{base}{what}": (base, mode, batch)
    for base in ("refinement", PLAIN)
    for what, mode, batch in (("", FORWARD, 1000), (" forward+backward", BACKWARD, 1000), (" alone", FORWARD, 1))
}

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
    versions = ", ".join(f"{name} {version}" for name, version in made["versions"].items() if version)
    runs = "; ".join(f"{part} {_run(results[part])}" for part in PARTS)
    return (
        f"{made['cpu']}, {versions}. Each part was measured for itself, with its day, commit and load average before "
        f"and after: {runs}. Well above the number of threads, something else ran and times are not to be trusted."
    )


def _run(results: Mapping[str, Any]) -> str:
    """When a part was measured, at which commit, beside what."""
    made = results["environment"]
    known = made["commit"] or "unknown"
    commit = known[:9] + ("+ (with changes)" if known.endswith("+") else "")
    before, after = results["load_average"]
    return f"{made['date'][:10]}, {commit}, {before:.1f} and {after:.1f}"


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
        for base in ("refinement", PLAIN)
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
