"""The table at the end of a sweep of ``train.py``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback

from kornia_pnpnet.core.files import read_csv
from kornia_pnpnet.core.tables import markdown_table
from kornia_pnpnet.training.card import HOW_IT_RAN

__all__ = ["SweepTable", "sweep_table"]

# Overrides precede this column of a summary.
_FIRST_RESULT = "update"


class SweepTable(Callback):
    """Print :func:`sweep_table` and the path of the summary when all runs have ended."""

    def on_multirun_end(self, config: Any, **_: Any) -> None:
        """Print the table of the sweep's folder."""
        path = Path(config.hydra.sweep.dir) / "summary.csv"
        if path.is_file():
            print(f"{sweep_table(path)}\nSuccess in % with 95 % intervals; all columns: {path}")


def sweep_table(summary_csv: str | Path) -> str:
    """Write the overrides that differ between runs, speed and success of each run as a Markdown table.

    Args:
        summary_csv: summary of a sweep, see :func:`~kornia_pnpnet.training.results.summarize_runs`.

    Raises:
        InputError: when the file is not a summary.
    """
    rows = list(read_csv(summary_csv, ["run", _FIRST_RESULT, "us_per_problem"]).values())
    columns = list(rows[0])
    overrides = columns[1 : columns.index(_FIRST_RESULT)]
    varied = [name for name in overrides if name not in HOW_IT_RAN and len({row[name] for row in rows}) > 1]
    sets = [name.removesuffix("/rate") for name in columns if name.endswith("/rate")]
    lines = []
    for row in sorted(rows, key=lambda row: [_as_sorted(row[name]) for name in varied]):
        rates = ([float(row[f"{name}/{key}"] or "nan") for key in ("rate", "low", "high")] for name in sets)
        cells = (f"{100 * rate:.1f} [{100 * low:.1f}, {100 * high:.1f}]" for rate, low, high in rates)
        lines.append([*(row[name] for name in varied), row["us_per_problem"], *cells])
    return markdown_table([*varied, "µs per problem", *sets], lines, pad=True)


def _as_sorted(text: str) -> tuple[float, str]:
    """Sort numbers by value, before all other texts."""
    try:
        return float(text), ""
    except ValueError:
        return math.inf, text
