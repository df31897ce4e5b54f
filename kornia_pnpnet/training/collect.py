"""Files over several runs: the folder that is shipped with trained weights, and the summary of a sweep."""

from __future__ import annotations

import csv
import shutil
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from kornia_pnpnet.core.files import atomic_open, write_json
from kornia_pnpnet.core.schema import read_column, read_rows, to_json
from kornia_pnpnet.pretrained import CONFIG_NAME, WEIGHTS_NAME
from kornia_pnpnet.solver import PnPNet
from kornia_pnpnet.training.card import write_model_card
from kornia_pnpnet.training.checkpoint import HISTORY_NAME
from kornia_pnpnet.training.results import RESULTS_NAME, load_run

__all__ = ["collect_weights", "summarize_runs"]

_MOST_ROWS = 100


def collect_weights(runs: Sequence[str | Path], folder: str | Path) -> None:
    """Gather weights, results, model card and learning curves of successive runs in one folder.

    Of each run's learning curves at most 100 rows are kept, all with a validation. The name of the folder becomes the
    name of the weights.

    Args:
        runs: folders of ``train.py``. Each run but the first began with the weights of the run before.
        folder: the destination.

    Raises:
        BaseError: when weights are damaged or incomplete.
        FileNotFoundError: when another file is missing.
        ValueError: when there is no run, or another file is damaged. After any of these errors nothing is written.
    """
    if not runs:
        raise ValueError("collect_weights needs at least one run, got none.")
    folder, last = Path(folder), Path(runs[-1])
    rows: list[dict[str, str]] = []
    for run in runs:
        rows += _validated_rows(Path(run) / HISTORY_NAME, int(rows[-1]["update"]) if rows else 0)
    results = load_run(last / RESULTS_NAME)
    PnPNet.from_pretrained(last / "weights")
    folder.mkdir(parents=True, exist_ok=True)
    for name in (CONFIG_NAME, WEIGHTS_NAME):
        shutil.copyfile(last / "weights" / name, folder / name)
    write_json(folder / RESULTS_NAME, to_json(results))
    write_model_card(folder, results, name=folder.name)
    _write_rows(folder / HISTORY_NAME, rows)


def _validated_rows(path: Path, start: int) -> list[dict[str, str]]:
    """Evenly spaced rows with a validation, the last one included; updates count from ``start``."""
    rows = read_rows(path)
    updates = map(int, read_column(path, rows, "update", int))
    validated = [
        {**row, "update": str(start + update)}
        for row, update in zip(rows, updates, strict=True)
        if any(value for key, value in row.items() if key.startswith("val/"))
    ]
    if not validated:
        raise ValueError(f"'{path}' has no row with a validation.")
    return validated[::-1][:: -(-len(validated) // _MOST_ROWS)][::-1]


def summarize_runs(folder: str | Path) -> Path | None:
    """Write ``summary.csv``: one row for each run of a sweep, with its overrides, speed and success.

    The runs are in sub-folders of the sweep. A results file that cannot be read is left out with a warning.

    Returns:
        Path of the summary, or ``None`` when no run has results.

    Raises:
        OSError: when the summary cannot be written.
    """
    folder = Path(folder)
    rows = []
    for path in sorted(folder.glob(f"**/{RESULTS_NAME}")):
        try:
            results = load_run(path)
        except ValueError as error:
            warnings.warn(f"Left out of the summary: {error}", stacklevel=2)
            continue
        row: dict[str, Any] = {"run": str(path.parent.relative_to(folder))}
        overrides = (override.lstrip("+").partition("=") for override in results.overrides)
        row |= {key: value for key, _, value in overrides}
        for key in ("update", "skipped", "updates_per_second", "peak_memory_mib"):
            row[key] = getattr(results.run, key)
        row["us_per_problem"] = f"{results.us_per_problem:.4g}"
        for name, entry in results.validation.items():
            row |= {f"{name}/{bound}": f"{getattr(entry.success, bound):.4f}" for bound in ("rate", "low", "high")}
        rows.append(row)
    if not rows:
        return None
    _write_rows(folder / "summary.csv", rows)
    return folder / "summary.csv"


def _write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a CSV file in one piece, since runs of a parallel launcher may end at the same time."""
    with atomic_open(path, newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)), restval="")
        writer.writeheader()
        writer.writerows(rows)
