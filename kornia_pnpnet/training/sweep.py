"""A Hydra callback that prints a table at the end of a sweep of ``train.py``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback

from kornia_pnpnet.core.files import read_csv
from kornia_pnpnet.core.tables import markdown_table
from kornia_pnpnet.training.card import HOW_IT_RAN
from kornia_pnpnet.training.results import summarize_runs

# The column of a summary that follows the overrides.
_FIRST_RESULT = "update"


class SweepTable(Callback):
    """At the end of a sweep, print the speed and success of each run, and the overrides that differ between runs."""

    def on_multirun_end(self, config: Any, **_: Any) -> None:
        """Print the table, and the path of the summary that the runs have written into the sweep's folder."""
        path = summarize_runs(Path(config.hydra.sweep.dir))  # runs side by side may have overwritten each other's rows
        if path is None:
            return
        rows = list(read_csv(path, ["run", _FIRST_RESULT, "us_per_problem"]).values())
        columns = list(rows[0])
        overrides = columns[1 : columns.index(_FIRST_RESULT)]
        varied = [name for name in overrides if name not in HOW_IT_RAN and len({row[name] for row in rows}) > 1]
        sets = [name.removesuffix("/rate") for name in columns if name.endswith("/rate")]
        lines = []
        for row in sorted(rows, key=lambda row: [_as_sorted(row[name]) for name in varied]):
            rates = ([float(row[f"{name}/{key}"] or "nan") for key in ("rate", "low", "high")] for name in sets)
            cells = (f"{100 * rate:.1f} [{100 * low:.1f}, {100 * high:.1f}]" for rate, low, high in rates)
            lines.append([*(row[name] for name in varied), row["us_per_problem"], *cells])
        print(markdown_table([*varied, "µs per problem", *sets], lines, pad=True))
        print(f"Success in % with 95 % intervals; all columns: {path}")


def _as_sorted(text: str) -> tuple[float, str]:
    """Make a sort key. Numbers are sorted by value and precede all other texts."""
    try:
        return float(text), ""
    except ValueError:
        return math.inf, text
